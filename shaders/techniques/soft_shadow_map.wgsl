// Soft shadow maps. Atty, Holzschuch, Lapierre, Hasenfratz, Hansen and Sillion 2006, "Soft Shadow Maps: Efficient Sampling of Light
// Source Visibility": each texel of a map of occluders is a micro-patch parallel to the light, whose shadow is added up.
//
// All of it happens in the map. Of a finite light its coordinates are slopes x/z from the light's centre, and depths are linear in
// 1/z; of a distant one, lengths across and along. Seen from a receiver at slope s_r and depth z_r, what lies at slope s and depth z
// falls onto the light at x = (s − s_r)/(1/z − 1/z_r): the light is as wide in the map as `spread` times the difference of depths,
// around the receiver's own place, and a patch hides of it what it covers there. This is Fig. 9 of the paper without its apex, so
// patches and lights of any aspect will do.

#import "lib/shadow_map.wgsl"
#import "lib/screen.wgsl"
#import "lib/counter.wgsl"
#import "lib/arctangent.wgsl"

/// Twin of `Splat` in `techniques/soft_shadow_map.rs`.
struct Splat {
    /// From texels of the occluders' maps to those of the soft shadow map: scale, then offset.
    ssm_from_map: vec4<f32>,
    /// Half the light's width in the occluders' maps by difference of depth, texels; 0 of a point.
    spread: vec2<f32>,
    /// Texels a side of all maps.
    size: u32,
    /// The first patch that is drawn.
    first: u32,
}

@group(0) @binding(4) var<uniform> splat: Splat;

/// The occluders' map that is worked on: 0 nearest surfaces, 1 farthest.
override side: u32 = 0;

/// Least half width of a light, texels: what a point is.
const LEAST_HALF: f32 = 1.0e-30;

/// Whether a map of occluders holds something: it is cleared to 0 where the nearest is kept, to 1 where the farthest is.
fn is_occupied(depth: f32) -> bool {
    return depth > 0.0 && depth < 1.0;
}

/// Half the light's width as seen in the map between two depths, texels; the nearer one is greater.
fn half_width(nearer: f32, farther: f32) -> vec2<f32> {
    return max(splat.spread * (nearer - farther), vec2(LEAST_HALF));
}

/// Integral over [a, b] of y, limited to the unit disk: clamp(y, −h, h) with h = √(1 − x²).
fn disk_below(a: f32, b: f32, y: f32) -> f32 {
    let level = min(abs(y), 1.0);
    let turn = sqrt((1.0 - level) * (1.0 + level));
    let inner = clamp(vec2(a, b), vec2(-turn), vec2(turn));
    let flat_part = level * (inner.y - inner.x);
    return sign(y) * (flat_part + (half_disk(b) - half_disk(inner.y)) - (half_disk(a) - half_disk(inner.x)));
}

/// Antiderivative of √(1 − x²).
fn half_disk(x: f32) -> f32 {
    let turn = sqrt(max((1.0 - x) * (1.0 + x), 0.0));
    return 0.5 * (x * turn + 2.0 * arctangent(x / (1.0 + turn)));
}

/// The share of the unit disk that a rectangle covers.
fn disk_share(low: vec2<f32>, high: vec2<f32>) -> f32 {
    let a = clamp(low, vec2(-1.0), vec2(1.0));
    let b = clamp(high, vec2(-1.0), vec2(1.0));
    let farthest = max(abs(a), abs(b));
    if (dot(farthest, farthest) <= 1.0) {
        return (b.x - a.x) * (b.y - a.y) / PI;
    }
    let nearest = clamp(vec2(0.0), a, b);
    if (dot(nearest, nearest) >= 1.0) {
        return 0.0;
    }
    return max(disk_below(a.x, b.x, b.y) - disk_below(a.x, b.x, a.y), 0.0) / PI;
}

/// The share of the light that a patch hides, from `low` to `high` around a receiver's own place in the map, where the light is
/// `half` wide to either side.
fn hidden_share(low: vec2<f32>, high: vec2<f32>, half: vec2<f32>) -> f32 {
    let a = clamp(low, -half, half);
    let b = clamp(high, -half, half);
    if (any(b <= a)) {
        return 0.0;
    }
    if (emitter.domain == 1u) {
        return disk_share(a / half, b / half);
    }
    let share = (b - a) / (2.0 * half);
    return share.x * share.y;
}

// ------------------------------------------------------------------------------------------- from texels to patches

/// Patches of each block of texels; then, of all blocks before.
@group(0) @binding(8) var<storage, read_write> block_sums: array<u32>;
/// Texels that hold something, row by row: y · size + x.
@group(0) @binding(9) var<storage, read_write> patches: array<u32>;
/// Of an indirect draw of each slice: vertices, instances, first vertex, first instance.
@group(0) @binding(10) var<storage, read_write> arguments: array<vec4<u32>>;

/// Patches of a slice.
override slice: u32 = 1;

const THREADS: u32 = 256u;
const TEXELS_A_THREAD: u32 = 4u;

var<workgroup> partial: array<u32, 256>;

/// How many of a thread's texels hold something, as bits.
fn occupied_texels(first: u32) -> u32 {
    var bits = 0u;
    for (var i = 0u; i < TEXELS_A_THREAD; i++) {
        let at = first + i;
        if (at < splat.size * splat.size) {
            let texel = vec2(at % splat.size, at / splat.size);
            if (is_occupied(textureLoad(shadow_depth, texel, side, 0))) {
                bits |= 1u << i;
            }
        }
    }
    return bits;
}

/// The sum of a value over the threads of a workgroup up to this one.
fn inclusive_sum(thread: u32, value: u32) -> u32 {
    partial[thread] = value;
    workgroupBarrier();
    for (var step = 1u; step < THREADS; step *= 2u) {
        var before = 0u;
        if (thread >= step) {
            before = partial[thread - step];
        }
        workgroupBarrier();
        partial[thread] += before;
        workgroupBarrier();
    }
    return partial[thread];
}

@compute @workgroup_size(256)
fn count_patches(@builtin(workgroup_id) block: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let first = (block.x * THREADS + thread) * TEXELS_A_THREAD;
    let sum = inclusive_sum(thread, countOneBits(occupied_texels(first)));
    if (thread == THREADS - 1u) {
        block_sums[block.x] = sum;
    }
}

/// One workgroup: sums over blocks, and what is drawn of each slice.
@compute @workgroup_size(256)
fn scan_blocks(@builtin(local_invocation_index) thread: u32) {
    let blocks = arrayLength(&block_sums);
    var before = 0u;
    for (var first = 0u; first < blocks; first += THREADS) {
        let block = first + thread;
        var own = 0u;
        if (block < blocks) {
            own = block_sums[block];
        }
        let sum = inclusive_sum(thread, own);
        if (block < blocks) {
            block_sums[block] = before + sum - own;
        }
        before += partial[THREADS - 1u];
        workgroupBarrier();
    }
    for (var i = thread; i < arrayLength(&arguments); i += THREADS) {
        let first = i * slice;
        arguments[i] = vec4(6u * min(select(before - first, 0u, before < first), slice), 1u, 0u, 0u);
    }
    if (thread == 0u) {
        count(before);
    }
}

@compute @workgroup_size(256)
fn place_patches(@builtin(workgroup_id) block: vec3<u32>, @builtin(local_invocation_index) thread: u32) {
    let first = (block.x * THREADS + thread) * TEXELS_A_THREAD;
    let bits = occupied_texels(first);
    var place = block_sums[block.x] + inclusive_sum(thread, countOneBits(bits)) - countOneBits(bits);
    for (var i = 0u; i < TEXELS_A_THREAD; i++) {
        if ((bits & (1u << i)) != 0u) {
            patches[place] = first + i;
            place++;
        }
    }
}

// ------------------------------------------------------------------------------------------- the soft shadow map

/// The same buffer, as the draw reads it.
@group(0) @binding(12) var<storage, read> drawn_patches: array<u32>;
/// Nearest receivers, at the texels of the soft shadow map; 0 where there are none.
@group(0) @binding(13) var receiver_depth: texture_depth_2d;
/// Occlusion of each texel in 1/FIXED_ONE.
@group(0) @binding(14) var<storage, read_write> fixed_sums: array<atomic<u32>>;

/// Whether sums are whole numbers, whose order doesn't matter.
override fixed_point: bool = false;

/// Of a texel at a distance of n patches at least 1/(4n²) is visible past a patch there: overlapping patches add up to less than
/// 1 + Σ 2πn/4n² ≈ 14 for maps of 4096 texels, below the 32 that this leaves.
const FIXED_ONE: f32 = 0x1p27;

struct Varying {
    @builtin(position) position_clip: vec4<f32>,
    @location(0) @interpolate(flat) texel: vec2<f32>,
    @location(1) @interpolate(flat) depth: f32,
}

/// The penumbra of a patch on the plane of the farthest receiver, a rectangle: nearer receivers see less of it.
@vertex
fn vertex(@builtin(vertex_index) index: u32) -> Varying {
    let at = drawn_patches[splat.first + index / 6u];
    let texel = vec2(at % splat.size, at / splat.size);
    let depth = textureLoad(shadow_depth, texel, side, 0);
    let corner = vec2<f32>(vec2(select(0u, 1u, index % 6u == 1u || index % 6u == 2u || index % 6u == 4u),
        select(0u, 1u, index % 6u == 2u || index % 6u == 4u || index % 6u == 5u)));
    // Half a texel of the soft shadow map more: no rounding of the rasteriser's loses a texel that is touched.
    let reach = half_width(depth, 0.0) * splat.ssm_from_map.xy + 0.5;
    let patch_corner = (vec2<f32>(texel) + corner) * splat.ssm_from_map.xy + splat.ssm_from_map.zw;
    let size = f32(splat.size);
    let place = clamp(patch_corner + (2.0 * corner - 1.0) * reach, vec2(-1.0), vec2(size + 1.0)) / size;
    var out: Varying;
    out.position_clip = vec4(2.0 * place.x - 1.0, 1.0 - 2.0 * place.y, 0.0, 1.0);
    out.texel = vec2<f32>(texel);
    out.depth = depth;
    return out;
}

@fragment
fn fragment(in: Varying) -> @location(0) f32 {
    let texel = vec2<u32>(in.position_clip.xy);
    let farther = textureLoad(receiver_depth, texel, 0);
    if (in.depth <= farther) {
        return 0.0;
    }
    let own = (in.position_clip.xy - splat.ssm_from_map.zw) / splat.ssm_from_map.xy;
    let low = in.texel - own;
    let share = hidden_share(low, low + 1.0, half_width(in.depth, farther));
    if (fixed_point) {
        atomicAdd(&fixed_sums[texel.y * splat.size + texel.x], u32(round(share * FIXED_ONE)));
    }
    return share;
}

/// Occlusion at the texels of the soft shadow map, the greater one of both sides.
@group(0) @binding(15) var<storage, read_write> occlusion: array<f32>;
@group(0) @binding(16) var blended_sums: texture_2d<f32>;

@compute @workgroup_size(64)
fn merge_blended(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x < splat.size && id.y < splat.size) {
        merge(id.xy, textureLoad(blended_sums, id.xy, 0).r);
    }
}

@compute @workgroup_size(64)
fn merge_fixed(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x < splat.size && id.y < splat.size) {
        merge(id.xy, f32(atomicLoad(&fixed_sums[id.y * splat.size + id.x])) / FIXED_ONE);
    }
}

fn merge(texel: vec2<u32>, sum: f32) {
    let at = texel.y * splat.size + texel.x;
    occlusion[at] = max(occlusion[at], min(sum, 1.0));
}

@group(0) @binding(6) var<storage, read_write> visibility: array<f32>;

/// Beyond the map lies what its outermost texels see, no receiver or no penumbra.
fn occlusion_at(texel: vec2<f32>) -> f32 {
    let at = vec2<u32>(clamp(texel, vec2(0.0), vec2(f32(splat.size - 1u))));
    return occlusion[at.y * splat.size + at.x];
}

/// The soft shadow map, projected onto the receivers from the light's centre.
@compute @workgroup_size(64)
fn project(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let face = faces[0];
    let at = seen_at(in_view(face, receivers[id.x].position)) * face.window.xy + face.window.zw;
    let corner = at * f32(splat.size) - 0.5;
    let texel = floor(corner);
    let part = corner - texel;
    let upper = mix(occlusion_at(texel), occlusion_at(texel + vec2(1.0, 0.0)), part.x);
    let lower = mix(occlusion_at(texel + vec2(0.0, 1.0)), occlusion_at(texel + 1.0), part.x);
    visibility[id.x] = 1.0 - mix(upper, lower, part.y);
}

// ------------------------------------------------------------------------------------------- patches at the receivers

/// Patches across each of the windows around a receiver; a multiple of 4.
override across: i32 = 8;
/// Maps of occluders.
override sides: u32 = 1;
/// The farther side alone where it is the only one asked for.
override first_side: u32 = 0;
/// Whether the camera is known.
override has_camera: bool = false;

/// Patches a pixel, at least: a smaller one moves an edge by less than an eighth of a pixel.
const PATCHES_A_PIXEL: f32 = 4.0;

/// No window grows beyond this power of two, which is more than any map has texels.
const MOST_LEVELS: i32 = 16;

/// The level of the smallest patches that a pixel can show.
fn finest_level(face: Face, receiver: Receiver, z: f32) -> i32 {
    if (!has_camera) {
        return 0;
    }
    let depth = select(depth_of(receiver.position), 1.0, screen.orthographic == 1u);
    let pixel = vec2(depth / screen.focal / z) * face.window.xy * f32(splat.size);
    let texels = min(pixel.x, pixel.y) / PATCHES_A_PIXEL;
    return clamp(i32(floor(log2(max(texels, 1.0)))), 0, MOST_LEVELS);
}

/// What a patch hides, from one texel to another one that it does not hold.
fn hidden_by(face: Face, layer: u32, seen: OnFace, own: f32, at: vec2<f32>, low: vec2<i32>, high: vec2<i32>) -> f32 {
    // Its middle lies between texels: one before and one beyond it by turns, so that no edge is moved on the whole.
    let size = high - low;
    let texel = low + (size - select(vec2(0), low.yx / size.yx & vec2(1), size > vec2(1))) / 2;
    let depth = textureLoad(shadow_depth, texel, layer, 0);
    if (!is_occupied(depth) || depth <= own) {
        return 0.0;
    }
    let half = half_width(depth, own);
    let share = hidden_share(vec2<f32>(low) - at, vec2<f32>(high) - at, half);
    if (share == 0.0 || depth <= unblocked_depth(face, seen, texel_center(face, texel))) {
        return 0.0;
    }
    return share;
}

/// The share of the light that patches hide from a receiver.
///
/// What lies so far from the receiver's own place in the map hides the light only where its penumbra is that wide. So patches grow
/// with that distance: `across` of them around the receiver, then as many of twice the size around these, until no occluder's
/// penumbra is wider.
fn hidden_from(face: Face, layer: u32, seen: OnFace, own: f32, at: vec2<f32>, finest: i32) -> vec2<f32> {
    let size = i32(splat.size);
    // No occluder is nearer to the light than depth 1.
    let widest = half_width(1.0, own);
    // A texel that is touched is within, however little of the light reaches into it.
    let begin = max(vec2<i32>(ceil(clamp(at - widest, vec2(0.0), vec2(f32(size) + 1.0)))) - 1, vec2(0));
    let end = min(vec2<i32>(floor(clamp(at + widest, vec2(-1.0), vec2(f32(size))))) + 1, vec2(size));
    var sum = 0.0;
    var taken = 0u;
    var inner_low = vec2(0);
    var inner_high = vec2(0);
    for (var level = finest; level < MOST_LEVELS; level++) {
        // In patches of this level; even, so that the window is made of whole patches of the next one.
        let middle = 2 * vec2<i32>(round(clamp(at, vec2(-1.0e6), vec2(1.0e6)) / f32(2 << u32(level))));
        let window_low = middle - across / 2;
        let window_high = middle + across / 2;
        let first = max(window_low, begin >> vec2(u32(level)));
        let last = min(window_high, (end + ((1 << u32(level)) - 1)) >> vec2(u32(level)));
        // Row by row: a sum of sums has few roundings.
        var window = 0.0;
        for (var y = first.y; y < last.y; y++) {
            var row = 0.0;
            for (var x = first.x; x < last.x; x++) {
                if (y >= inner_low.y && y < inner_high.y && x >= inner_low.x && x < inner_high.x) {
                    // To the end of what smaller patches have covered.
                    x = inner_high.x - 1;
                    continue;
                }
                let low = vec2(x, y) << vec2(u32(level));
                let high = min(low + (1 << u32(level)), vec2(size));
                row += hidden_by(face, layer, seen, own, at, low, high);
                taken += 1u;
            }
            window += row;
        }
        sum += window;
        if (all((window_low << vec2(u32(level))) <= begin) && all((window_high << vec2(u32(level))) >= end)) {
            break;
        }
        inner_low = window_low / 2;
        inner_high = window_high / 2;
    }
    return vec2(sum, f32(taken));
}

@compute @workgroup_size(64)
fn gather(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    let face = faces[0];
    let to = select(emitter.center - receiver.position, emitter.center, emitter.distant == 1u);
    let seen = on_face(face, receiver.position, plane_normal(receiver.normal, to));
    let at = (seen.at * face.window.xy + face.window.zw) * f32(splat.size);
    let own = face.depth_scale * (face.far - seen.view.along) / seen.view.z;
    let finest = finest_level(face, receiver, seen.view.z);
    var hidden = 0.0;
    var taken = 0.0;
    for (var i = 0u; i < sides; i++) {
        let found = hidden_from(face, first_side + i, seen, own, at, finest);
        hidden = max(hidden, found.x);
        taken += found.y;
    }
    count(u32(taken));
    // Of a light that is hidden as a whole, no more is lost than roundings: those of rows and of their sums, and some of each share.
    let lost = f32(2 * across + MOST_LEVELS) * 0x1p-24;
    visibility[id.x] = select(1.0 - hidden, 0.0, hidden >= 1.0 - lost);
}
