// A square kernel of texels around a receiver's place in a map. What of it lies beyond the map's edge takes the map's last texels.

#import "lib/shadow_map.wgsl"

/// Texels a side of the kernel.
override kernel: u32;

/// The kernel's texels: around the texel that holds the place, or, where they are even, around the corner of texels nearest to it.
fn kernel_texels(face: Face, at: vec2<f32>) -> Texels {
    let size = vec2<f32>(textureDimensions(shadow_depth));
    var middle = texel_at(face, at);
    if (kernel % 2u == 0u) {
        middle = vec2<i32>(clamp(floor((at * face.window.xy + face.window.zw) * size + 0.5), vec2(0.0), size));
    }
    let first = middle - i32(kernel / 2u);
    return Texels(first, first + i32(kernel) - 1);
}

/// How many of a kernel's texels those of the map between `first` and `last` stand for.
fn kernel_share(whole: Texels, within: Texels) -> u32 {
    let first = select(max(within.first, whole.first), whole.first, within.first <= vec2(0));
    let last = select(min(within.last, whole.last), whole.last, within.last >= map_last());
    let count = max(last - first + 1, vec2(0));
    return u32(count.x * count.y);
}
