// Percentage-closer filtering over a min-max pyramid. "Soft Shadows" (NVIDIA), section "Fast Algorithm".
//
// The paper holds a node against the receiver's one depth Zf. Here each texel is held against the receiver's tangent plane at that
// texel, as `pcf` does, which is the plane's depth that no longer shadows itself; and what decides a node is a bound on that depth
// over the node's texels in the kernel. So the answer is that of every texel, bit for bit. Depth is reversed: what is near is large.

#import "lib/kernel.wgsl"
#import "lib/min_max.wgsl"
#import "lib/counter.wgsl"

@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;

/// Whether the search begins at the coarsest nodes, rather than at those that are as large as the kernel.
override from_top: bool;

/// How many of a kernel's texels one of the map stands for, if it is not blocked; none where it lies outside of the kernel.
fn unblocked_at(face: Face, layer: u32, seen: OnFace, texel: vec2<i32>, whole: Texels, inner: Texels) -> u32 {
    if (any(texel < inner.first) || any(texel > inner.last) || is_blocked(face, layer, seen, texel)) {
        return 0u;
    }
    return kernel_share(whole, Texels(texel, texel));
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    let light_point = points[0];
    let index = face_toward(light_point, receiver.position - light_point.position);
    let face = faces[index];
    let to = to_light(light_point, receiver.position, face.distant == 1u);
    let seen = on_face(face, receiver.position, plane_normal(receiver.normal, to));
    if (passes_light(face, seen)) {
        visibility[id.x] = 1.0;
        return;
    }
    let whole = kernel_texels(face, seen.at);
    let inner = Texels(clamp(whole.first, vec2(0), map_last()), clamp(whole.last, vec2(0), map_last()));
    let threshold = threshold_of(face, seen, inner);
    let top = select(max(level_of(kernel), 1u), coarsest_level(), from_top);
    let first_root = inner.first >> vec2(top);
    let last_root = inner.last >> vec2(top);
    var unblocked = 0u;
    var fetches = 0u;
    for (var y = first_root.y; y <= last_root.y; y++) {
        for (var x = first_root.x; x <= last_root.x; x++) {
            var cursor = Cursor(top, vec2(x, y));
            loop {
                let first = cursor.place << vec2(cursor.level);
                let last = first + (1 << cursor.level) - 1;
                let within = Texels(max(first, inner.first), min(last, inner.last));
                var found = BLOCKED;
                if (all(within.first <= within.last)) {
                    fetches += 1u;
                    found = decide(node_at(index, cursor), first, within, inner, threshold, threshold.slack);
                    if (found == UNBLOCKED) {
                        unblocked += kernel_share(whole, within);
                    }
                }
                if (found == MIXED && cursor.level > 1u) {
                    cursor = down(cursor);
                    continue;
                }
                if (found == MIXED) {
                    let texels = vec2<u32>(within.last - within.first + 1);
                    fetches += texels.x * texels.y;
                    // Not in a loop: some drivers allow an invocation 2^16 turns in all.
                    unblocked += unblocked_at(face, index, seen, first, whole, inner)
                        + unblocked_at(face, index, seen, first + vec2(1, 0), whole, inner)
                        + unblocked_at(face, index, seen, first + vec2(0, 1), whole, inner)
                        + unblocked_at(face, index, seen, first + vec2(1, 1), whole, inner);
                }
                cursor = after(cursor, top);
                if (cursor.level == top) {
                    break;
                }
            }
        }
    }
    count(fetches);
    visibility[id.x] = f32(unblocked) / f32(kernel * kernel);
}
