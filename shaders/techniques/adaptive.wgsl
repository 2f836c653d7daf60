// Adaptive light sampling. Schwärzler 2009, "Fast Accurate Soft Shadows with Adaptive Light Source Sampling": where the maps of few
// points of the light differ as the camera sees them, the light is divided, and more maps are rendered.
//
// What a point of the light is to a receiver is kept in a byte, so that a map is read once and need not be kept: how many of the
// kernel's texels let it through, four points in a word.

#import "lib/look_up.wgsl"
#import "lib/smooth.wgsl"

/// By plane and receiver: four points' bytes.
@group(0) @binding(4) var<storage, read_write> planes: array<u32>;
/// By point and receiver: where along the light's normal what the point sees there is, from the origin.
@group(0) @binding(14) var<storage, read_write> depths: array<f32>;
@group(0) @binding(6) var<uniform> job: Job;
/// Tiles to work on: their first receiver, how many they have, and a bit for each of the job's points that they need.
@group(0) @binding(8) var<storage, read> needed: array<vec4<u32>>;
/// By cell, pair of its corners, and tile: how much they differ.
@group(0) @binding(9) var<storage, read_write> differences: array<atomic<u32>>;
/// Weights of the points seen and of all above the horizon, and those weights times what the points emit towards the receiver.
@group(0) @binding(10) var<storage, read_write> sums: array<vec4<f32>>;
/// Of each point of a batch.
@group(0) @binding(12) var<storage, read> weights: array<f32>;
/// What the light's centre sees: the receivers of a comparison there.
@group(0) @binding(13) var<storage, read_write> seen_by_center: array<Receiver>;

/// Of each receiver: how far its blockers are before it, added up, and how many were seen.
@group(0) @binding(16) var<storage, read_write> blockers: array<vec2<f32>>;
/// By tile: the side of the cells that the light is divided in for it, as a fraction of its own.
@group(0) @binding(20) var<storage, read> sides: array<f32>;
/// Of all points.
@group(0) @binding(21) var<storage, read> places: array<Place>;
/// Of each of the job's points: the point whose bytes stand for it where it is not looked up, or SEEN_WHOLE.
@group(0) @binding(22) var<storage, read> inherited: array<u32>;
/// Those to compare.
@group(0) @binding(23) var<storage, read> cells: array<CellPoints>;
/// Of each receiver: V, as a part of the light above its horizon, and E/E₀ smoothed.
@group(0) @binding(18) var<storage, read_write> smoothed: array<vec2<f32>>;

/// What a dispatch works on. Twin of `Job` in `techniques/adaptive.rs`.
struct Job {
    /// Points of the batch: the first, and how many.
    first: u32,
    count: u32,
    /// The number of the first of them among all points.
    number: u32,
    /// Of the image, pixels.
    width: u32,
    /// Tiles a row, and in all.
    tile_columns: u32,
    tiles: u32,
    /// 1: the light is at infinity.
    distant: u32,
    padding: u32,
    /// The light's normal, along which depths are.
    normal: vec3<f32>,
    /// From a place's depth from the origin to that from the light.
    depth_offset: f32,
    /// Whether the light's axes u and v are divided.
    divided: vec4<f32>,
}

/// Points of a cell to compare. Twin of `CellPoints` in `techniques/adaptive.rs`.
struct CellPoints {
    /// Its corners: the first with the last, and the others; or those around its middle.
    others: vec4<u32>,
    /// Its middle, or another of its points.
    middle: u32,
    padding: u32,
    padding_2: vec2<u32>,
}

/// A point of the light: where it is, relative to the origin (its direction from a distant light), and what it counts. Twin of `Place`
/// in `techniques/adaptive.rs`.
struct Place {
    position: vec3<f32>,
    weight: f32,
}

/// Whether the mean blocker is kept.
override filters: bool;

/// Whether depths are compared by their ratio.
override relative: bool;
/// Depths that differ by less are the same, on the GPU's scale; or ratios by less than this from 1.
override tolerance: f32;
/// Sides of tiles, pixels.
override tile_side: u32;

fn tile_of(number: u32) -> u32 {
    return number / job.width / tile_side * job.tile_columns + number % job.width / tile_side;
}

/// What a point is to a receiver whose byte is kept.
fn kept(point: u32, id: u32) -> u32 {
    return extractBits(planes[point / 4u * arrayLength(&receivers) + id], 8u * (point % 4u), 8u);
}

/// Keeps what the job's points are to a receiver, of those in `wanted`: a bit each.
fn keep(id: u32, found: vec4<u32>, wanted: u32) {
    let bits = (vec4(wanted) >> vec4(0u, 1u, 2u, 3u)) & vec4(1u);
    let masks = (255u * bits) << BYTE;
    let bytes = (found << BYTE) & masks;
    let mask = masks.x | masks.y | masks.z | masks.w;
    let all = bytes.x | bytes.y | bytes.z | bytes.w;
    let at = job.number / 4u * arrayLength(&receivers) + id;
    let shift = 8u * (job.number % 4u);
    planes[at] = (planes[at] & ~(mask << shift)) | (all << shift);
    // Those that the first word has no room for.
    if (shift > 0u && (mask >> (32u - shift)) > 0u) {
        let next = at + arrayLength(&receivers);
        planes[next] = (planes[next] & ~(mask >> (32u - shift))) | (all >> (32u - shift));
    }
}

const BYTE: vec4<u32> = vec4(0u, 8u, 16u, 24u);

fn note_blockers(id: u32, found: LookedUp) {
    if (filters) {
        blockers[id] += found.gaps;
    }
}

/// No point stands for one: what does not look it up sees it whole. Twin of `SEEN_WHOLE` in `techniques/adaptive.rs`.
const SEEN_WHOLE: u32 = 0xffffffffu;

/// No receiver of a tile.
const NO_RECEIVER: u32 = 0xffffffffu;

/// The receiver that an invocation stands for, where four workgroups each work on a tile.
fn receiver_in_tile(group: u32, lane: u32) -> u32 {
    let tile = needed[group / 4u];
    let place = group % 4u * 64u + lane;
    return select(NO_RECEIVER, tile.x + place, place < tile.y);
}

/// Takes the job's points for what others are to the tiles' receivers: those that are not looked up there stay so.
@compute @workgroup_size(64)
fn inherit(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let id = receiver_in_tile(group.x, lane);
    if (id == NO_RECEIVER) {
        return;
    }
    let last = job.number + job.count;
    for (var word = job.number / 4u; 4u * word < last; word++) {
        let at = word * arrayLength(&receivers) + id;
        var bytes = planes[at];
        for (var i = 0u; i < 4u; i++) {
            let point = 4u * word + i;
            if (point >= job.number && point < last) {
                let other = inherited[point - job.number];
                let is_whole = other == SEEN_WHOLE;
                let found = select(kept(select(other, 0u, is_whole), id), kernel * kernel, is_whole);
                bytes = insertBits(bytes, found, 8u * i, 8u);
            }
        }
        planes[at] = bytes;
    }
}

/// Looks the job's points up in the tiles that need them.
@compute @workgroup_size(64)
fn look_up(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let id = receiver_in_tile(group.x, lane);
    if (id == NO_RECEIVER) {
        return;
    }
    let wanted = needed[group.x / 4u].z;
    let receiver = receivers[id];
    var unblocked = vec4(0u);
    var gaps = vec2(0.0);
    for (var i = 0u; i < job.count; i++) {
        if (extractBits(wanted, i, 1u) == 1u) {
            let found = looked_up(points[job.first + i], receiver);
            unblocked[i] = found.unblocked;
            gaps += found.gaps;
        }
    }
    keep(id, unblocked, wanted);
    if (filters) {
        blockers[id] += gaps;
    }
}

/// Where along the light's normal what the job's points see in the direction of each receiver is; nothing there is the receiver itself.
@compute @workgroup_size(64)
fn measure(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let position = receivers[id.x].position;
    for (var i = 0u; i < job.count; i++) {
        let light_point = points[job.first + i];
        let index = face_toward(light_point, position - light_point.position);
        let face = faces[index];
        let texel = texel_at(face, seen_at(in_view(face, position)));
        let stored = textureLoad(shadow_depth, texel, index, 0);
        var place = position;
        if (stored > 0.0) {
            place = stored_position(face, texel_center(face, texel), stored);
        }
        depths[(job.number + i) * arrayLength(&receivers) + id.x] = dot(job.normal, place);
    }
}

/// Adds the job's points up as they come: all count the same.
@compute @workgroup_size(64)
fn accumulate(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    for (var i = 0u; i < job.count; i++) {
        sums[id.x] += of_point(points[job.first + i], id.x, 1.0);
    }
}

/// Adds up all points of a batch, each by its weight.
@compute @workgroup_size(64)
fn evaluate(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    var sum = sums[id.x];
    for (var i = 0u; i < arrayLength(&points); i++) {
        sum += of_point(points[i], id.x, weights[i]);
    }
    sums[id.x] = sum;
}

/// What a point adds to the sums.
fn of_point(light_point: LightPoint, id: u32, weight: f32) -> vec4<f32> {
    let receiver = receivers[id];
    let distant = faces[light_point.first_face].distant == 1u;
    let to = to_light(light_point, receiver.position, distant);
    if (dot(receiver.normal, to) <= 0.0) {
        return vec4(0.0);
    }
    let all = weighed(receiver, light_point.normal, to, weight);
    let found = looked_up(light_point, receiver);
    note_blockers(id, found);
    let share = f32(found.unblocked) / f32(kernel * kernel);
    return vec4(share * all, all);
}

/// Adds up the points from their bytes, for the tiles' receivers.
@compute @workgroup_size(64)
fn sum(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let id = receiver_in_tile(group.x, lane);
    if (id == NO_RECEIVER) {
        return;
    }
    let receiver = receivers[id];
    var sum = vec4(0.0);
    var word = 0u;
    for (var i = 0u; i < arrayLength(&places); i++) {
        if (i % 4u == 0u) {
            word = planes[i / 4u * arrayLength(&receivers) + id];
        }
        let found = word & 255u;
        word >>= 8u;
        let place = places[i];
        let to = select(place.position - receiver.position, place.position, job.distant == 1u);
        if (dot(receiver.normal, to) <= 0.0) {
            continue;
        }
        let all = weighed(receiver, job.normal, to, place.weight);
        let share = f32(found) / f32(kernel * kernel);
        sum += vec4(share * all, all);
    }
    sums[id] = sum;
}

/// Counts, tile by tile, how much of a receiver some point of each cell or around it sees and another does not.
@compute @workgroup_size(64)
fn compare_visibility(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let id = receiver_in_tile(group.x, lane);
    if (id == NO_RECEIVER) {
        return;
    }
    let tile = tile_of(receivers[id].number);
    for (var cell = 0u; cell < arrayLength(&cells); cell++) {
        let points = cells[cell];
        var most = kept(points.middle, id);
        var least = most;
        for (var i = 0u; i < 4u; i++) {
            let seen = kept(points.others[i], id);
            most = max(most, seen);
            least = min(least, seen);
        }
        if (most > least) {
            atomicAdd(&differences[2u * cell * job.tiles + tile], most - least);
        }
    }
}

/// Counts, tile by tile and for either diagonal of each cell, where its ends see different depths.
@compute @workgroup_size(64)
fn compare_depths(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let tile = tile_of(receivers[id.x].number);
    for (var cell = 0u; cell < arrayLength(&cells); cell++) {
        let first = 2u * cell * job.tiles + tile;
        let at = cells[cell].others * arrayLength(&receivers) + id.x;
        if (differ(depths[at.x], depths[at.w])) {
            atomicAdd(&differences[first], 1u);
        }
        if (differ(depths[at.y], depths[at.z])) {
            atomicAdd(&differences[first + job.tiles], 1u);
        }
    }
}

fn differ(a: f32, b: f32) -> bool {
    if (!relative) {
        return abs(a - b) >= tolerance;
    }
    // |1 - a/b| with both from the light.
    return abs(b - a) >= tolerance * (b + job.depth_offset);
}

/// Shows every receiver's V, as a part of the light above its horizon, and E/E₀ to its neighbours.
@compute @workgroup_size(64)
fn show(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    let sum = sums[id.x];
    // A sliver over the horizon without a point: nothing leaks.
    let seen = select(sum.x / sum.z, 0.0, sum.z == 0.0);
    let share = select(select(seen, sum.y / sum.w, sum.w > 0.0), 1.0, sum.x == sum.z);
    shown[receiver.number] = vec4(seen, share, depth_of(receiver.position), bitcast<f32>(receiver.instance + 1u));
    note_gap(tile_of(receiver.number), blockers[id.x]);
}

/// Averages V over what a cell of the light stands for.
@compute @workgroup_size(64)
fn smooth_out(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    let tile = tile_of(receiver.number);
    smoothed[id.x] = shown[receiver.number].xy;
    let gap = gap_at(tile, blockers[id.x]);
    if (gap >= 0.0) {
        // An axis that is not divided is whole.
        let cell = select(vec2(1.0), vec2(sides[tile]), job.divided.xy == vec2(1.0));
        // As in `cascaded.wgsl`: an edge hides the light row by row of points.
        smoothed[id.x] = smooth_over(receiver, gap, cell, 1.5 * sides[tile]);
    }
}

/// The receivers of a comparison in the light centre's view: what a face of its map sees at each texel.
@compute @workgroup_size(8, 8)
fn unproject(@builtin(global_invocation_id) id: vec3<u32>) {
    let size = textureDimensions(shadow_depth);
    if (any(id.xy >= size)) {
        return;
    }
    let face = faces[job.first];
    let texel = vec2<i32>(id.xy);
    let stored = textureLoad(shadow_depth, texel, job.first, 0);
    var receiver: Receiver;
    // Where there is nothing: the far end, which every point sees alike.
    receiver.position = stored_position(face, texel_center(face, texel), stored);
    receiver.number = id.y * size.x + id.x;
    seen_by_center[receiver.number] = receiver;
}
