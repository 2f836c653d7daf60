// Cascaded soft shadow maps: maps of fewer points, and with smaller kernels, the farther from the camera, split by split ("Cascaded
// Soft Shadow Maps" with several PCF kernels). What a split sees of the light is shown with its weight, so that splits may blend.

#import "lib/look_up.wgsl"
#import "lib/smooth.wgsl"

/// Receivers of a split, tile by tile.
@group(0) @binding(4) var<storage, read> members: array<Member>;
@group(0) @binding(6) var<uniform> job: SplitJob;
/// Tiles to work on: their first member, how many they have, and their number.
@group(0) @binding(8) var<storage, read> work_tiles: array<vec4<u32>>;
/// By tile: whether a point is seen there (1), whether one is not (2), and at how many receivers both.
@group(0) @binding(9) var<storage, read_write> tallies: array<array<atomic<u32>, 2>>;
/// Of each member: weights of the points seen and of all above the horizon, and those weights times what the points emit towards it.
@group(0) @binding(10) var<storage, read_write> sums: array<vec4<f32>>;
/// Of each receiver: how far its blockers are before it, added up, and how many they are.
@group(0) @binding(16) var<storage, read_write> blockers: array<vec2<f32>>;
/// Of each receiver: the side of the cells that its points stand for, as a part of the light's; 0 where nothing is to be smoothed.
@group(0) @binding(12) var<storage, read_write> cells: array<f32>;
/// Of each receiver: V and E/E₀ smoothed.
@group(0) @binding(18) var<storage, read_write> smoothed: array<vec2<f32>>;

/// A receiver in a split.
struct Member {
    /// Which one.
    receiver: u32,
    /// The share of the split in what it sees.
    weight: f32,
}

/// What a dispatch over a split works on. Twin of `SplitJob` in `techniques/cascaded.rs`.
struct SplitJob {
    /// Of the image, pixels.
    width: u32,
    tile_columns: u32,
    /// Points looked up.
    points: f32,
    /// The side of a point's cell, as a part of the light's; 0 outside the penumbra.
    cell: f32,
}

/// Whether the mean blocker is kept.
override filters: bool;
/// Sides of tiles, pixels.
override tile_side: u32;

fn tile_of(number: u32) -> u32 {
    return number / job.width / tile_side * job.tile_columns + number % job.width / tile_side;
}

/// The member that an invocation works on, four workgroups a tile; none beyond the last.
fn member_at(tile: vec4<u32>, group: u32, lane: u32) -> u32 {
    let place = group % 4u * 64u + lane;
    return select(NONE, tile.x + place, place < tile.y);
}

const NONE: u32 = 0xffffffffu;

/// Adds up what the points of a batch are to members.
@compute @workgroup_size(64)
fn look_up(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let id = member_at(work_tiles[group.x / 4u], group.x, lane);
    if (id == NONE) {
        return;
    }
    let receiver = receivers[members[id].receiver];
    var sum = sums[id];
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
    sums[id] = sum;
    if (filters) {
        blockers[members[id].receiver] += gaps;
    }
}

/// Notes where the points differ.
@compute @workgroup_size(64)
fn tally(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = work_tiles[group.x / 4u];
    let id = member_at(tile, group.x, lane);
    if (id == NONE) {
        return;
    }
    let seen = sums[id].x;
    let state = select(0u, 1u, seen > 0.0) | select(0u, 2u, seen < job.points);
    atomicOr(&tallies[tile.z][0], state);
    if (state == 3u) {
        atomicAdd(&tallies[tile.z][1], 1u);
    }
}

/// Shows what members see of the light; with the filter, of what is above their horizons.
@compute @workgroup_size(64)
fn show(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let tile = work_tiles[group.x / 4u];
    let id = member_at(tile, group.x, lane);
    if (id == NONE) {
        return;
    }
    let member = members[id];
    let receiver = receivers[member.receiver];
    let sum = sums[id];
    // E = E₀ where nothing above the horizon is hidden; where all points miss what emits this way, as V is.
    let share = select(select(sum.x / sum.z, sum.y / sum.w, sum.w > 0.0), 1.0, sum.x == sum.z);
    // A sliver over the horizon without a point: nothing leaks.
    let above = select(sum.x / sum.z, 0.0, sum.z == 0.0);
    let seen = member.weight * vec2(select(min(sum.x / job.points, 1.0), above, filters), share);
    let before = shown[receiver.number].xy;
    shown[receiver.number] = vec4(before + seen, depth_of(receiver.position), bitcast<f32>(receiver.instance + 1u));
    cells[member.receiver] += member.weight * job.cell;
    note_gap(tile.z, blockers[member.receiver]);
}

/// Averages V over what the points' cells stand for, in the penumbra.
@compute @workgroup_size(64)
fn smooth_out(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    smoothed[id.x] = shown[receiver.number].xy;
    let gap = gap_at(tile_of(receiver.number), blockers[id.x]);
    if (filters && cells[id.x] > 0.0 && gap >= 0.0) {
        // An edge hides the light row by row of points: what differs by more than one and half another is no step between them.
        smoothed[id.x] = smooth_over(receiver, gap, vec2(cells[id.x]), 1.5 * cells[id.x]);
    }
}
