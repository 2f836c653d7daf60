// Counts over a whole dispatch, by atomics.

/// Low and high word.
@group(0) @binding(7) var<storage, read_write> counted: array<atomic<u32>, 2>;

fn count(more: u32) {
    let before = atomicAdd(&counted[0], more);
    // The low word has gone once around.
    if (before + more < before) {
        atomicAdd(&counted[1], 1u);
    }
}
