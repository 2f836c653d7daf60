// Soft shadow volumes. Assarsson and Akenine-Möller 2003, "A Geometry-based Soft Shadow Volume Algorithm using Graphics Hardware".
//
// As seen from a receiver, casters are replaced by the sheets of their surfaces that face the light's centre c. How many sheets w(q)
// hide a point q of the light changes only at their outline: along the way from c to q by the sign of each edge that it crosses. So
//     ∫ w = w(c) |light| − Σ ± |{q: the way from c to q crosses the edge}|,
// where an edge takes part only as far as it is seen before the light: in the paper, by receivers in its wedge. A receiver whose horizon
// hides c counts from another point of the light instead, and on points of it alone.
//
// On the light, c is the origin and the light's half axes are the units.

#import "lib/receiver.wgsl"
#import "lib/emitter.wgsl"
#import "lib/arctangent.wgsl"

/// Vertices of all casters.
@group(0) @binding(0) var<storage, read> positions: array<vec4<f32>>;

/// Twin of `Portion` in `techniques/shadow_volumes.rs`.
struct Portion {
    /// Tiles and chunks that are worked on.
    first_tile: u32,
    tiles: u32,
    chunks: u32,
    /// Of what each tile lists, where this portion begins, and how much it is.
    first: u32,
    most: u32,
    /// 1: nothing is left after this portion.
    is_last: u32,
    padding: vec2<u32>,
}

@group(0) @binding(1) var<uniform> portion: Portion;

// ------------------------------------------------------------------------------------------- outlines

/// Corners, and 1 where its surface is closed.
@group(0) @binding(3) var<storage, read> triangles: array<vec4<u32>>;
/// Ends, first side, count of sides.
@group(0) @binding(4) var<storage, read> edges: array<vec4<u32>>;
/// Triangles at edges: twice the number, and 1 where it runs from the edge's second end to its first.
@group(0) @binding(6) var<storage, read> sides: array<u32>;
/// How often a triangle, in the order of its corners, is a sheet: −1 in the other order. Of a closed surface, what faces away from
/// the light's centre is none: it would hide what the front does once more.
@group(0) @binding(7) var<storage, read_write> sheets: array<i32>;
/// How often an edge, from its first end to its second, is on the outline of all sheets.
@group(0) @binding(8) var<storage, read_write> outline: array<i32>;

fn index_of(id: vec3<u32>, groups: vec3<u32>) -> u32 {
    return id.y * groups.x * 64u + id.x;
}

@compute @workgroup_size(64)
fn find_sheets(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = index_of(id, groups);
    if (i >= arrayLength(&sheets)) {
        return;
    }
    let corners = triangles[i];
    let a = positions[corners.x].xyz;
    let to = select(emitter.center - a, emitter.center, emitter.distant == 1u);
    let is_front = dot(cross(positions[corners.y].xyz - a, positions[corners.z].xyz - a), to) > 0.0;
    sheets[i] = select(select(-1, 0, corners.w == 1u), 1, is_front);
}

@compute @workgroup_size(64)
fn find_outline(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let i = index_of(id, groups);
    if (i >= arrayLength(&outline)) {
        return;
    }
    let edge = edges[i];
    var sum = 0;
    for (var side = edge.z; side < edge.z + edge.w; side++) {
        sum += sheets[sides[side] >> 1u] * select(1, -1, (sides[side] & 1u) == 1u);
    }
    outline[i] = sum;
}

// ------------------------------------------------------------------------------------------- what matters to a tile

/// Receivers of 16 x 16 pixels. Twin of `Tile` in `techniques/shadow_volumes.rs`.
struct Tile {
    /// Planes around all ways from them to the light.
    first_plane: u32,
    planes: u32,
    /// What may be in between, in `listed`.
    first: u32,
    count: u32,
    receivers_begin: u32,
    receivers_end: u32,
    padding: vec2<u32>,
}

@group(0) @binding(9) var<storage, read> tiles: array<Tile>;
/// Outward normal; what lies farther along it than w is outside.
@group(0) @binding(10) var<storage, read> planes: array<vec4<f32>>;
/// Triangles: corners, and how often they are sheets. Edges: first end, second end twice, how often they are on the outline.
@group(0) @binding(11) var<storage, read> items: array<vec4<u32>>;
/// Around each 64 of them: least and largest.
@group(0) @binding(12) var<storage, read> bounds: array<vec4<f32>>;
/// By tile and chunk of 64 items, how many the tile lists; once scanned, how many of earlier chunks.
@group(0) @binding(13) var<storage, read_write> counts: array<u32>;
@group(0) @binding(14) var<storage, read_write> totals: array<u32>;
/// Numbers of items, tile by tile, in their order.
@group(0) @binding(15) var<storage, read_write> listed: array<u32>;

fn holds_box(tile: Tile, low: vec3<f32>, high: vec3<f32>) -> bool {
    for (var i = tile.first_plane; i < tile.first_plane + tile.planes; i++) {
        let plane = planes[i];
        let least = min(plane.xyz * low, plane.xyz * high);
        if (least.x + least.y + least.z > plane.w) {
            return false;
        }
    }
    return true;
}

fn holds_item(tile: Tile, item: vec4<u32>) -> bool {
    let a = positions[item.x].xyz;
    let b = positions[item.y].xyz;
    let c = positions[item.z].xyz;
    for (var i = tile.first_plane; i < tile.first_plane + tile.planes; i++) {
        let plane = planes[i];
        if (min(min(dot(plane.xyz, a), dot(plane.xyz, b)), dot(plane.xyz, c)) > plane.w) {
            return false;
        }
    }
    return true;
}

@compute @workgroup_size(64)
fn count_items(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= portion.chunks) {
        return;
    }
    let tile = tiles[portion.first_tile + id.y];
    var found = 0u;
    if (holds_box(tile, bounds[2u * id.x].xyz, bounds[2u * id.x + 1u].xyz)) {
        let end = min(64u * id.x + 64u, arrayLength(&items));
        for (var i = 64u * id.x; i < end; i++) {
            found += select(0u, 1u, holds_item(tile, items[i]));
        }
    }
    counts[(portion.first_tile + id.y) * portion.chunks + id.x] = found;
}

@compute @workgroup_size(64)
fn scan_counts(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= portion.tiles) {
        return;
    }
    var sum = 0u;
    for (var i = id.x * portion.chunks; i < (id.x + 1u) * portion.chunks; i++) {
        let found = counts[i];
        counts[i] = sum;
        sum += found;
    }
    totals[id.x] = sum;
}

@compute @workgroup_size(64)
fn list_items(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= portion.chunks) {
        return;
    }
    let tile = tiles[portion.first_tile + id.y];
    var at = tile.first + counts[(portion.first_tile + id.y) * portion.chunks + id.x];
    if (holds_box(tile, bounds[2u * id.x].xyz, bounds[2u * id.x + 1u].xyz)) {
        let end = min(64u * id.x + 64u, arrayLength(&items));
        for (var i = 64u * id.x; i < end; i++) {
            if (holds_item(tile, items[i])) {
                listed[at] = i;
                at += 1u;
            }
        }
    }
}

// ------------------------------------------------------------------------------------------- a receiver and the light

/// How the light turns to its receivers: 0 not at all, 1 about its centre, 2 about its axis u.
override turns: u32 = 0;
/// Points of the light, a multiple of 4, that tell how often each is hidden.
override point_count: u32 = 0;

/// The least half side of a light: smaller ones are points. Its square, magnified by `LEAST_HEIGHT`, is still a number.
const LEAST_HALF: f32 = 1.0e-12;

/// Heights over a receiver that are none, as a fraction of the light's: what lies there is within the rounding of its place.
const LEAST_HEIGHT: f32 = 0x1p-24;

/// How far a vertex in a receiver's tangent plane may be off it: positions, of at most 1, are off by 2^-25 along each axis; the product
/// of the normal and an offset of at most the cube's diagonal, by four roundings of that.
const PLANE_ROUNDING: f32 = 0x1p-20;

/// Roundings of the share that one edge hides: a sector and a triangle of at most half the light, from coordinates of a few
/// roundings each.
const SHARE_ROUNDING: f32 = 0x1p-21;

struct Gaze {
    position: vec3<f32>,
    /// Away from the light, unit.
    normal: vec3<f32>,
    /// Axes of the light over their half lengths.
    u: vec3<f32>,
    v: vec3<f32>,
    /// Height of the light over the receiver; 1 of a distant one.
    height: f32,
    /// The point of the light from which sheets are counted: its centre, or one above the horizon where that is not.
    start: vec2<f32>,
    /// How far the way there leads along u and v, over its height.
    slope: vec2<f32>,
    /// What lies along it by no more than `rise` hides nothing.
    plane: vec3<f32>,
    rise: f32,
    /// (u, v) of the light is over the horizon where x + y u + z v > 0; 0 where all of it is taken to be.
    horizon: vec3<f32>,
    /// Whether the light's centre is behind the horizon, and what hides the rest is told by points.
    is_by_points: bool,
}

fn gaze_of(receiver: Receiver) -> Gaze {
    let to = select(emitter.center - receiver.position, emitter.center, emitter.distant == 1u);
    let half = max(vec2(length(emitter.half_u), length(emitter.half_v)), vec2(LEAST_HALF));
    var normal = emitter.normal;
    var unit_u = emitter.half_u / half.x;
    if (turns == 1u) {
        normal = -normalize(to);
    } else if (turns == 2u) {
        normal = -normalize(to - dot(unit_u, to) * unit_u);
    }
    // What is round, or a point, has no axes of its own.
    if (turns == 1u || dot(unit_u, unit_u) < 0.25) {
        let size = abs(normal);
        let axis = select(select(vec3(0.0, 0.0, 1.0), vec3(0.0, 1.0, 0.0), size.y <= size.z), vec3(1.0, 0.0, 0.0),
            size.x <= min(size.y, size.z));
        unit_u = normalize(cross(axis, normal));
    }
    // So that what goes around counter-clockwise as the light sees it does so in u and v.
    let unit_v = cross(unit_u, normal);
    let u = unit_u / half.x;
    let v = unit_v / half.y;
    let height = -dot(normal, to);
    let above = dot(receiver.normal, to);
    let tilt = vec2(dot(receiver.normal, unit_u), dot(receiver.normal, unit_v)) * half;
    let is_round = emitter.domain == 1u;
    let reach = select(abs(tilt.x) + abs(tilt.y), length(tilt), is_round);
    // In the paper, a light whose centre is behind the horizon is not cut, and what is before the receiver hides it.
    let is_cut = abs(above) < reach && (above > 0.0 || point_count > 0u);
    let is_by_points = is_cut && above <= 0.0;
    var start = vec2(0.0);
    if (is_by_points) {
        // Half way from the horizon to the light's highest point.
        start = 0.5 * (1.0 - above / reach) * select(sign(tilt), tilt / reach, is_round);
    }
    return Gaze(
        receiver.position,
        normal,
        u,
        v,
        height,
        start,
        (vec2(dot(u, to), dot(v, to)) + start) / height,
        select(normalize(to), receiver.normal, above > 0.0 || is_by_points),
        PLANE_ROUNDING,
        select(vec3(0.0), vec3(above, tilt), is_cut),
        is_by_points,
    );
}

/// A vertex as a receiver sees it.
struct Seen {
    /// Beside the way to where counting starts, at its own height.
    at: vec2<f32>,
    height: f32,
    /// How far it is over the plane of what hides nothing.
    above: f32,
}

fn seen(gaze: Gaze, vertex: u32) -> Seen {
    let offset = positions[vertex].xyz - gaze.position;
    let height = -dot(gaze.normal, offset);
    let at = vec2(dot(gaze.u, offset), dot(gaze.v, offset)) - height * gaze.slope;
    return Seen(at, height, dot(gaze.plane, offset) - gaze.rise);
}

fn cross_2d(a: vec2<f32>, b: vec2<f32>) -> f32 {
    return a.x * b.y - a.y * b.x;
}

/// 1 where a way from a to b turns counter-clockwise around the origin, −1 where clockwise. Of what goes through it, as if the
/// origin were a little to the right and by less still below: so every way has a turn, which agrees with `crossing`.
fn turn_of(a: vec2<f32>, b: vec2<f32>) -> f32 {
    let area = cross_2d(a, b);
    let along = b - a;
    let is_left = area > 0.0 || (area == 0.0 && (along.y < 0.0 || (along.y == 0.0 && along.x < 0.0)));
    return select(-1.0, 1.0, is_left);
}

/// How a triangle's edge crosses the ray from the origin to the right: 1 upwards, −1 downwards. An edge turns the same way in
/// both of its triangles and on the outline: from its lesser vertex to the greater.
fn crossing(first: u32, a: vec2<f32>, second: u32, b: vec2<f32>) -> i32 {
    let is_upward = a.y < 0.0;
    if (is_upward == (b.y < 0.0)) {
        return 0;
    }
    let turn = select(turn_of(a, b), -turn_of(b, a), first > second);
    return select(0, select(-1, 1, is_upward), (turn > 0.0) == is_upward);
}

// ------------------------------------------------------------------------------------------- sheets before the centre

/// What is known of a receiver so far. Twin of `Sum` in `techniques/shadow_volumes.rs`.
struct Sum {
    /// Sheets before the light's centre.
    layers: i32,
    /// What edges add to their share of the light.
    share: f32,
    /// Edges that are seen before the light.
    edges: u32,
    padding: u32,
}

@group(0) @binding(16) var<storage, read_write> sums: array<Sum>;

/// The receiver of an invocation; none beyond its tile's.
fn receiver_at(tile: Tile, group: vec3<u32>, local: u32) -> u32 {
    return tile.receivers_begin + group.y * 64u + local;
}

/// A triangle's part of the sheets that the way to the light's centre goes through.
fn layers_of(gaze: Gaze, item: vec4<u32>) -> i32 {
    let a = seen(gaze, item.x);
    let b = seen(gaze, item.y);
    let c = seen(gaze, item.z);
    let winding = crossing(item.x, a.at, item.y, b.at) + crossing(item.y, b.at, item.z, c.at)
        + crossing(item.z, c.at, item.x, a.at);
    if (winding == 0) {
        return 0;
    }
    var weights = abs(vec3(cross_2d(b.at, c.at), cross_2d(c.at, a.at), cross_2d(a.at, b.at)));
    let whole = weights.x + weights.y + weights.z;
    weights = select(vec3(1.0 / 3.0), weights / whole, whole > 0.0);
    let above = dot(weights, vec3(a.above, b.above, c.above));
    let height = dot(weights, vec3(a.height, b.height, c.height));
    let is_between = above > 0.0 && (emitter.distant == 1u || height < gaze.height);
    return select(0, winding * bitcast<i32>(item.w), is_between);
}

@compute @workgroup_size(64)
fn count_layers(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let tile = tiles[portion.first_tile + group.x];
    let i = receiver_at(tile, group, local);
    if (i >= tile.receivers_end) {
        return;
    }
    let gaze = gaze_of(receivers[i]);
    var layers = 0;
    let end = min(portion.first + portion.most, tile.count);
    for (var at = portion.first; at < end; at++) {
        layers += layers_of(gaze, items[listed[tile.first + at]]);
    }
    sums[i].layers += layers;
}

// ------------------------------------------------------------------------------------------- edges before the light

/// Points of the light: four u, then four v.
@group(0) @binding(17) var<uniform> light_points: array<vec4<f32>, 128>;
/// How many sheets more than the light's centre each of them has before it, between portions.
@group(0) @binding(18) var<storage, read_write> kept_layers: array<vec4<i32>>;
@group(0) @binding(19) var<storage, read_write> visibility: array<f32>;

var<private> layers: array<vec4<i32>, 64>;

/// Where a + t (b − a) > 0, of an interval of t; empty ones end before they begin.
fn clipped(t: vec2<f32>, a: f32, b: f32) -> vec2<f32> {
    if (a <= 0.0 && b <= 0.0) {
        return vec2(1.0, 0.0);
    }
    if (a > 0.0 && b > 0.0) {
        return t;
    }
    let at = a / (a - b);
    return select(vec2(t.x, min(t.y, at)), vec2(max(t.x, at), t.y), b > a);
}

/// A way on the light.
struct Way {
    begin: vec2<f32>,
    end: vec2<f32>,
    is_empty: bool,
}

fn part_of(way: Way, t: vec2<f32>) -> Way {
    let along = way.end - way.begin;
    let begin = select(way.begin + t.x * along, way.begin, t.x == 0.0);
    let end = select(way.begin + t.y * along, way.end, t.y == 1.0);
    return Way(begin, end, way.is_empty || t.x >= t.y);
}

/// What of a way is on the light.
fn on_light(way: Way) -> Way {
    var t = vec2(0.0, 1.0);
    if (emitter.domain == 1u) {
        let along = way.end - way.begin;
        let length_2 = dot(along, along);
        let area = cross_2d(way.begin, way.end);
        // Half the chord, squared.
        let half_2 = 1.0 - area * area / length_2;
        if (!(length_2 > 0.0) || half_2 <= 0.0) {
            return Way(way.begin, way.end, true);
        }
        let middle = -dot(way.begin, along) / length_2;
        let half = sqrt(half_2 / length_2);
        t = vec2(max(middle - half, 0.0), min(middle + half, 1.0));
        return part_of(way, t);
    }
    t = clipped(t, 1.0 - way.begin.x, 1.0 - way.end.x);
    t = clipped(t, 1.0 + way.begin.x, 1.0 + way.end.x);
    t = clipped(t, 1.0 - way.begin.y, 1.0 - way.end.y);
    t = clipped(t, 1.0 + way.begin.y, 1.0 + way.end.y);
    let part = part_of(way, t);
    return Way(clamp(part.begin, vec2(-1.0), vec2(1.0)), clamp(part.end, vec2(-1.0), vec2(1.0)), part.is_empty);
}

/// What an edge is seen before of the light, or nothing.
fn way_of(gaze: Gaze, a: Seen, b: Seen) -> Way {
    var t = clipped(vec2(0.0, 1.0), a.above, b.above);
    let least = LEAST_HEIGHT * gaze.height;
    t = clipped(t, a.height - least, b.height - least);
    if (emitter.distant == 0u) {
        t = clipped(t, gaze.height - a.height, gaze.height - b.height);
    }
    let nothing = Way(vec2(0.0), vec2(0.0), true);
    if (t.x >= t.y) {
        return nothing;
    }
    let begin = select(a.at + t.x * (b.at - a.at), a.at, t.x == 0.0);
    let end = select(a.at + t.y * (b.at - a.at), b.at, t.y == 1.0);
    let begin_height = max(select(a.height + t.x * (b.height - a.height), a.height, t.x == 0.0), least);
    let end_height = max(select(a.height + t.y * (b.height - a.height), b.height, t.y == 1.0), least);
    let way = Way(gaze.start + begin * (gaze.height / begin_height), gaze.start + end * (gaze.height / end_height), false);
    if (any(max(way.begin, way.end) <= vec2(-1.0)) || any(min(way.begin, way.end) >= vec2(1.0))) {
        return nothing;
    }
    var part = on_light(way);
    if (!part.is_empty && any(gaze.horizon != vec3(0.0))) {
        part = part_of(part, clipped(vec2(0.0, 1.0), over_horizon(gaze, part.begin), over_horizon(gaze, part.end)));
    }
    return part;
}

fn over_horizon(gaze: Gaze, at: vec2<f32>) -> f32 {
    return gaze.horizon.x + dot(gaze.horizon.yz, at);
}

/// A direction from the light's centre; of the centre itself as `turn_of` has it.
fn direction_of(at: vec2<f32>) -> vec2<f32> {
    return select(at, vec2(-1.0e-10, 0.0), all(at == vec2(0.0)));
}

/// Area of the square of half side 1 from the right up to a direction, counter-clockwise: 4 all around.
fn swept(direction: vec2<f32>) -> f32 {
    let d = direction;
    if (abs(d.x) >= abs(d.y)) {
        return select(2.0, 0.0, d.x > 0.0) + 0.5 * d.y / d.x;
    }
    return select(3.0, 1.0, d.y > 0.0) - 0.5 * d.x / d.y;
}

/// The angle of a vector with a component across of at least 0.
fn angle_of(along: f32, across: f32) -> f32 {
    if (across > abs(along)) {
        return 0.5 * PI - arctangent(along / across);
    }
    let angle = arctangent(across / max(abs(along), 1.0e-37));
    return select(PI - angle, angle, along >= 0.0);
}

/// The share of the light that lies behind a way on it, as seen from its centre: the sector of the light less the triangle before the
/// way. `turn` is 1 where that goes counter-clockwise around the centre, else −1.
fn share_beyond(way: Way, turn: f32) -> f32 {
    let begin = direction_of(way.begin);
    let end = direction_of(way.end);
    let area = max(turn * cross_2d(begin, end), 0.0);
    if (emitter.domain == 1u) {
        return max(angle_of(dot(begin, end), area) - area, 0.0) / (2.0 * PI);
    }
    // Half of the square at most, but for rounding.
    var sector = turn * (swept(end) - swept(begin));
    sector += select(0.0, 4.0, sector < -1.0) - select(0.0, 4.0, sector > 3.0);
    return max(sector - 0.5 * area, 0.0) / 4.0;
}

/// The horizon on the light, counter-clockwise.
fn horizon_of(gaze: Gaze) -> Way {
    let tilt = gaze.horizon.yz;
    let steepness = length(tilt);
    if (steepness == 0.0) {
        return Way(vec2(0.0), vec2(0.0), true);
    }
    let across = tilt / steepness;
    let foot = -gaze.horizon.x / steepness * across;
    let along = vec2(across.y, -across.x);
    return on_light(Way(foot - 2.0 * along, foot + 2.0 * along, false));
}

/// The share of the light behind a way on it and over the horizon.
fn share_of(horizon: Way, way: Way, turn: f32) -> f32 {
    let share = share_beyond(way, turn);
    if (horizon.is_empty) {
        return share;
    }
    let first = select(way.end, way.begin, turn > 0.0);
    let last = select(way.begin, way.end, turn > 0.0);
    var t = clipped(vec2(0.0, 1.0), cross_2d(first, horizon.begin), cross_2d(first, horizon.end));
    t = clipped(t, cross_2d(horizon.begin, last), cross_2d(horizon.end, last));
    let below = part_of(horizon, t);
    return share - select(share_beyond(below, 1.0), 0.0, below.is_empty);
}

/// Takes note of points that a way parts from where counting starts.
fn count_points(way: Way, start: vec2<f32>, turn: f32, sheets_less: i32) {
    let along = way.end - way.begin;
    let begin = way.begin - start;
    let end = way.end - start;
    for (var i = 0u; i < point_count / 4u; i++) {
        let x = light_points[2u * i] - start.x;
        let y = light_points[2u * i + 1u] - start.y;
        let is_parted = (turn * (begin.x * y - begin.y * x) >= vec4(0.0))
            & (turn * (end.x * y - end.y * x) < vec4(0.0))
            & (turn * (along.x * (y - begin.y) - along.y * (x - begin.x)) < vec4(0.0));
        layers[i] -= select(vec4(0), vec4(sheets_less), is_parted);
    }
}

@compute @workgroup_size(64)
fn cover(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) local: u32) {
    let tile = tiles[portion.first_tile + group.x];
    let i = receiver_at(tile, group, local);
    if (i >= tile.receivers_end) {
        return;
    }
    let gaze = gaze_of(receivers[i]);
    let horizon = horizon_of(gaze);
    var sum = sums[i];
    if (portion.first > 0u) {
        for (var k = 0u; k < point_count / 4u; k++) {
            layers[k] = kept_layers[i * (point_count / 4u) + k];
        }
    }
    let end = min(portion.first + portion.most, tile.count);
    for (var at = portion.first; at < end; at++) {
        let item = items[listed[tile.first + at]];
        let a = seen(gaze, item.x);
        let b = seen(gaze, item.y);
        let way = way_of(gaze, a, b);
        if (!way.is_empty) {
            let turn = turn_of(a.at, b.at);
            let times = bitcast<i32>(item.w) * i32(turn);
            if (!gaze.is_by_points) {
                sum.share += f32(times) * share_of(horizon, way, turn);
            }
            sum.edges += 1u;
            count_points(way, gaze.start, turn, times);
        }
    }
    if (portion.is_last == 0u) {
        sums[i] = sum;
        for (var k = 0u; k < point_count / 4u; k++) {
            kept_layers[i * (point_count / 4u) + k] = layers[k];
        }
        return;
    }
    visibility[i] = visible_share(gaze, horizon, sum);
}

/// V, of all that is known.
fn visible_share(gaze: Gaze, horizon: Way, sum: Sum) -> f32 {
    if (gaze.height <= 0.0) {
        return 0.0;
    }
    if (gaze.is_by_points) {
        return visible_share_by_points(gaze, horizon, sum.layers);
    }
    let above = 1.0 - select(share_beyond(horizon, 1.0), 0.0, horizon.is_empty);
    var hidden = f32(sum.layers) * above - sum.share;
    // What several sheets hide is hidden once: as many points tell how much that is too much.
    if (point_count > 0u && sum.edges > 0u) {
        var more = vec4(0);
        for (var i = 0u; i < point_count / 4u; i++) {
            let sheets_before = layers[i] + sum.layers;
            let x = light_points[2u * i];
            let y = light_points[2u * i + 1u];
            let is_over = gaze.horizon.x + gaze.horizon.y * x + gaze.horizon.z * y > vec4(0.0);
            let once = select(vec4(0), vec4(1), sheets_before != vec4(0)) - sheets_before;
            more += select(vec4(0), once, is_over | vec4(horizon.is_empty));
        }
        hidden += f32(more.x + more.y + more.z + more.w) / f32(point_count);
    }
    // A light that is hidden, or seen, but for rounding is so as a whole.
    let lost = f32(sum.edges) * SHARE_ROUNDING;
    if (hidden <= lost) {
        return above;
    }
    return select(above - hidden, 0.0, hidden >= above - lost);
}

/// V where the light's centre is behind the horizon: the part of the light that is not, times the share of the points there that nothing
/// hides.
fn visible_share_by_points(gaze: Gaze, horizon: Way, sheets_at_start: i32) -> f32 {
    var over = vec4(0u);
    var seen = vec4(0u);
    for (var i = 0u; i < point_count / 4u; i++) {
        let is_over = gaze.horizon.x + gaze.horizon.y * light_points[2u * i] + gaze.horizon.z * light_points[2u * i + 1u] > vec4(0.0);
        let is_seen = layers[i] + sheets_at_start == vec4(0);
        over += select(vec4(0u), vec4(1u), is_over);
        seen += select(vec4(0u), vec4(1u), is_over & is_seen);
    }
    let count = f32(over.x + over.y + over.z + over.w);
    // Of less than what a point stands for, where counting starts tells.
    let share = select(f32(seen.x + seen.y + seen.z + seen.w) / count, select(0.0, 1.0, sheets_at_start == 0), count == 0.0);
    return share * select(share_beyond(horizon, -1.0), 0.0, horizon.is_empty);
}
