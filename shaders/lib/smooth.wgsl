// Means of V over the neighbours on the screen that the shadows' edges would pass if each point of the light went through its cell:
// what a point of the light stands for. For parallel plates the steps between points become the ramps that they stand for.

#import "lib/shadow_map.wgsl"
#import "lib/sampling.wgsl"
#import "lib/screen.wgsl"

/// By pixel: V, E/E₀, the receiver's depth in the camera, and one more than what it lies on; 0 where there is none.
@group(0) @binding(17) var<storage, read_write> shown: array<vec4<f32>>;
/// By tile: gaps of receivers' blockers, added up in 2^-14 units, and of how many receivers.
@group(0) @binding(19) var<storage, read_write> tile_gaps: array<array<atomic<u32>, 2>>;

const GAP_SCALE: f32 = 0x1p14;

/// Taps of the filter.
const TAPS: u32 = 16u;

/// Where a tap is in a cell, from -1 to 1 along each side: a lattice of which each row and each column has one tap, for an edge along
/// a side of the light passes them row by row. It is symmetric about the middle.
fn tap_at(i: u32) -> vec2<f32> {
    return 2.0 * fract((f32(i) * vec2(1.0, 5.0) + vec2(0.5, 2.5)) / f32(TAPS)) - 1.0;
}

/// Notes how far a receiver's blockers are before it: their gaps added up, and how many they are.
fn note_gap(tile: u32, found: vec2<f32>) {
    if (found.y > 0.0) {
        // A tile's 256 receivers stay below 2^32.
        atomicAdd(&tile_gaps[tile][0], u32(min(found.x / found.y, 4.0) * GAP_SCALE));
        atomicAdd(&tile_gaps[tile][1], 1u);
    }
}

/// How far blockers are before a receiver: its own, or, where all that it was tested against let it see the light, those of its
/// tile, for what blocks its neighbours is near its penumbra; below 0 without any.
fn gap_at(tile: u32, found: vec2<f32>) -> f32 {
    if (found.y > 0.0) {
        return found.x / found.y;
    }
    let count = atomicLoad(&tile_gaps[tile][1]);
    if (count == 0u) {
        return -1.0;
    }
    return f32(atomicLoad(&tile_gaps[tile][0])) / (GAP_SCALE * f32(count));
}

/// Whether what is shown at a pixel lies on the plane and the instance of a receiver.
fn is_same_surface(tap: vec4<f32>, pixel: vec2<i32>, receiver: Receiver, own_depth: f32, own_px: vec2<f32>, slope: vec2<f32>) -> bool {
    // At a contact depths alone are no telling.
    let is_same = bitcast<u32>(tap.w) == receiver.instance + 1u;
    return is_same && is_on_plane(tap.z, own_depth, slope, vec2<f32>(pixel) + 0.5 - own_px);
}

/// The mean of V and E/E₀ over the receivers around one that a blocker's shadow passes as a point goes through a cell of the light,
/// so large a part of its sides. Neighbours whose V differs by more than `most_apart` do not count.
fn smooth_over(receiver: Receiver, gap: f32, cell: vec2<f32>, most_apart: f32) -> vec2<f32> {
    let own = shown[receiver.number];
    let own_px = middle_px(receiver.number);
    let slope = slope_of(receiver.normal, own_px);
    let shift = shadow_shift(receiver.position, receiver.normal, own.z, own_px, gap);
    var sum = vec2(0.0);
    var used = 0.0;
    for (var i = 0u; i < TAPS; i++) {
        let tap = tap_at(i);
        let uv = cell * select(tap, disk_from_square(0.5 * tap + 0.5), emitter.domain == 1u);
        let pixel = pixel_at(own_px + shift_px(shift, uv));
        if (!is_on_screen(pixel)) {
            continue;
        }
        let seen = shown[u32(pixel.y) * screen.size.x + u32(pixel.x)];
        if (abs(seen.x - own.x) <= most_apart && is_same_surface(seen, pixel, receiver, own.z, own_px, slope)) {
            sum += seen.xy;
            used += 1.0;
        }
    }
    return select(own.xy, sum / used, used > 0.0);
}
