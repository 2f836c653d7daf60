// Soft bilateral filtering shadows, a reconstruction of Ali et al.'s SBFS, whose parameters are not available: the mean of the maps
// of a grid of points, and over neighbours on the screen, in the penumbra, a joint bilateral filter: nearer ones count more, and those
// whose depth, normal or shadow differ less.

#import "lib/look_up.wgsl"
#import "lib/smooth.wgsl"

/// Of each receiver: weights of the points seen and of all above the horizon, and those weights times what the points emit towards it.
@group(0) @binding(10) var<storage, read_write> sums: array<vec4<f32>>;
/// Of each receiver: how far its blockers are before it, added up, and how many they are.
@group(0) @binding(16) var<storage, read_write> blockers: array<vec2<f32>>;
/// By pixel: the receiver's normal.
@group(0) @binding(9) var<storage, read_write> normals: array<vec4<f32>>;
/// Of each receiver: V and E/E₀ filtered.
@group(0) @binding(18) var<storage, read_write> smoothed: array<vec2<f32>>;
@group(0) @binding(6) var<uniform> job: FilterJob;

/// Twin of `FilterJob` in `techniques/bilateral.rs`.
struct FilterJob {
    /// Of the image, pixels.
    width: u32,
    tile_columns: u32,
    /// Of the grid.
    points: f32,
    /// The sides of a point's cell, as a part of the light's.
    cell: f32,
    /// Standard deviations, of the distance in radii of the window, of the angle between normals, of V.
    sigmas: vec3<f32>,
    padding: u32,
}

/// Sides of tiles, pixels.
override tile_side: u32;
/// Taps along a side of the window; odd.
override taps: u32;
/// Whether neighbours are averaged.
override filters: bool;

fn tile_of(number: u32) -> u32 {
    return number / job.width / tile_side * job.tile_columns + number % job.width / tile_side;
}

/// Adds up what the points of a batch are to receivers.
@compute @workgroup_size(64)
fn look_up(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    var sum = sums[id.x];
    var gaps = vec2(0.0);
    for (var i = 0u; i < arrayLength(&points); i++) {
        let light_point = points[i];
        let to = to_light(light_point, receiver.position, emitter.distant == 1u);
        if (dot(receiver.normal, to) <= 0.0) {
            continue;
        }
        let all = weighed(receiver, light_point.normal, to, light_point.weight);
        let found = looked_up(light_point, receiver);
        sum += vec4(f32(found.unblocked) / f32(kernel * kernel) * all, all);
        gaps += found.gaps;
    }
    sums[id.x] = sum;
    blockers[id.x] += gaps;
}

/// Shows every receiver's V and E/E₀ to its neighbours.
@compute @workgroup_size(64)
fn show(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    let sum = sums[id.x];
    // E = E₀ where nothing above the horizon is hidden; where all points miss what emits this way, as V is.
    let share = select(select(sum.x / sum.z, sum.y / sum.w, sum.w > 0.0), 1.0, sum.x == sum.z);
    let seen = min(sum.x / job.points, 1.0);
    shown[receiver.number] = vec4(seen, share, depth_of(receiver.position), bitcast<f32>(receiver.instance + 1u));
    normals[receiver.number] = vec4(receiver.normal, 0.0);
    note_gap(tile_of(receiver.number), blockers[id.x]);
}

/// The joint bilateral filter, as wide as a point's cell of the light moves shadows.
@compute @workgroup_size(64)
fn smooth_out(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    let own = shown[receiver.number];
    smoothed[id.x] = own.xy;
    let gap = gap_at(tile_of(receiver.number), blockers[id.x]);
    if (!filters || gap < 0.0) {
        return;
    }
    let own_px = middle_px(receiver.number);
    let slope = slope_of(receiver.normal, own_px);
    // What the corners of a cell, as far from its middle as they are, move the shadow by.
    let shift = shadow_shift(receiver.position, receiver.normal, own.z, own_px, gap);
    let reach_px = abs(shift_px(shift, vec2(job.cell, 0.0))) + abs(shift_px(shift, vec2(0.0, job.cell)));
    let middle = f32(taps / 2u);
    var sum = vec2(0.0);
    var whole = 0.0;
    for (var y = 0u; y < taps; y++) {
        for (var x = 0u; x < taps; x++) {
            let place = (vec2(f32(x), f32(y)) - middle) / max(middle, 1.0);
            let pixel = pixel_at(own_px + place * reach_px);
            if (!is_on_screen(pixel)) {
                continue;
            }
            let number = u32(pixel.y) * screen.size.x + u32(pixel.x);
            let tap = shown[number];
            if (!is_same_surface(tap, pixel, receiver, own.z, own_px, slope)) {
                continue;
            }
            let turned = length(normals[number].xyz - receiver.normal);
            let apart = vec3(length(place), turned, abs(tap.x - own.x)) / job.sigmas;
            let weight = exp(-0.5 * dot(apart, apart));
            sum += weight * tap.xy;
            whole += weight;
        }
    }
    smoothed[id.x] = sum / whole;
}
