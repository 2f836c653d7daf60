// Soft shadows by back-projection over a min-max pyramid. "Soft Shadows" (NVIDIA), section "Accurate Algorithm"; gaps and the search
// window after Guennebaud, Barthe and Paulin 2006, "Real-Time Soft Shadow Mapping by Backprojection".
//
// A texel of the map is a patch parallel to the light's plane. Seen from a receiver it hides a rectangle of the light, and the
// areas of these are added up. In the light's frame, with its centre (the map's own) at the origin, the point of a map's ray of
// tangents a at the depth z is seen by the receiver of tangents b at the depth y before
//     q = s (a - b), s = z y/(y - z), of a light at infinity a - b over the length y - z,
// where s grows with z: what is nearest to the light hides the smallest and innermost rectangle. So a node none of whose texels is
// before the receiver, or whose nearest rectangle misses the light, hides nothing, which is exact; and one whose texels are all
// before the receiver and whose nearest rectangle holds the light is taken to hide all of it, though it may have gaps; so are all
// texels of the search window together, whichever nodes they are in.

#import "lib/min_max.wgsl"
#import "lib/emitter.wgsl"
#import "lib/counter.wgsl"

@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;

/// How the light turns to its receivers: 0 not at all, 1 about its centre, 2 about its axis u.
override turns: u32;
/// Whether a texel's rectangle is drawn out to those of its neighbours.
override fill_gaps: bool;
/// How often the search window is shrunk to the nearest depth in it; 0: the whole map is searched.
override shrink: u32;
/// Texels along a side of the search window, at most: of a larger one every second, fourth, … texel is taken.
override window_texels: f32;

/// By how much of itself what a node hides at its nearest and at its farthest depth may differ for it to be taken as one patch; 0: no
/// node is.
override tolerance: f32;

/// Nodes that an invocation looks into, at most; the rest are taken as they are. Some drivers end an invocation after 2^16 turns.
const MOST_VISITS: u32 = 40000u;

/// What 2^15 areas that make up the light may lack when they are added up, each sum rounded by 2^-25.
const SUM_ROUNDING: f32 = 0x1p-10;

var<private> visits: u32;

/// The least half side of a light: smaller ones are points, on any scale that positions have.
const LEAST_HALF: f32 = 1.0e-18;

/// Where s is as good as infinite: beside it no light has a size.
const MOST_SCALE: f32 = 1.0e12;

/// The largest patch that is no rectangle and is taken as one, in half sides of the light: 1/8 of it, as fine as the tolerance is.
const MOST_SLANTED: f32 = 0.25;

const PI: f32 = 3.14159265358979;

/// A light and a receiver, in a face's view.
struct Gaze {
    /// Of the receiver, from the light's plane; 1 of a distant light.
    depth: f32,
    /// (a - b) (ahead + turn . (x, y)) in half sides of the light, of a place (x, y) beside the receiver's own, is
    /// across_x x + across_y y.
    across_x: vec2<f32>,
    across_y: vec2<f32>,
    /// How far rays lead along the light's normal, over the map's.
    ahead: f32,
    turn: vec2<f32>,
    /// Whether texels are rectangles of the light: the map looks along the light's normal.
    is_aligned: bool,
}

fn gaze_of(face: Face, seen: OnFace, light_point: LightPoint, position: vec3<f32>) -> Gaze {
    let to_receiver = position - light_point.position;
    var normal = emitter.normal;
    let half = max(vec2(length(emitter.half_u), length(emitter.half_v)), vec2(LEAST_HALF));
    var unit_u = emitter.half_u / half.x;
    if (turns == 1u) {
        normal = normalize(to_receiver);
        unit_u = vec3(0.0);
    } else if (turns == 2u) {
        normal = normalize(to_receiver - dot(unit_u, to_receiver) * unit_u);
    }
    // What is round, or a point, has no axes of its own.
    if (dot(unit_u, unit_u) < 0.25) {
        let up = cross(normal, face.up.xyz);
        unit_u = normalize(select(cross(normal, face.right.xyz), up, dot(up, up) > 0.25));
    }
    let unit_v = cross(normal, unit_u);
    let n = turned(face, normal);
    let u = turned(face, unit_u);
    let v = turned(face, unit_v);
    if (face.distant == 1u) {
        return Gaze(1.0, vec2(u.x, v.x) / half, vec2(u.y, v.y) / half, 1.0, vec2(0.0), true);
    }
    let depth = dot(normal, to_receiver);
    let own = vec2(dot(unit_u, to_receiver), dot(unit_v, to_receiver)) / depth;
    let ahead = depth / seen.view.z;
    let is_aligned = turns == 0u && max(abs(n.x), abs(n.y)) < 0x1p-16;
    return Gaze(
        depth,
        (vec2(u.x, v.x) - own * n.x) / half,
        (vec2(u.y, v.y) - own * n.y) / half,
        ahead,
        select(n.xy, vec2(0.0), is_aligned),
        is_aligned,
    );
}

/// A place of the view, at the depth of what a map holds there, on its way to the light's plane.
struct Ray {
    /// (a - b) over the length of its ray along the light's normal, in half sides of the light.
    across: vec2<f32>,
    /// What makes that the point of the light's plane: s times that length. As good as infinite at the receiver's depth and behind.
    scale: f32,
    /// Whether it is on the emitting side of the light's plane.
    is_before: bool,
}

fn ray_at(face: Face, gaze: Gaze, seen: OnFace, at: vec2<f32>, stored: f32) -> Ray {
    let off = at - seen.at;
    let across = off.x * gaze.across_x + off.y * gaze.across_y;
    if (face.distant == 1u) {
        let gap = stored / face.depth_scale - (face.far - seen.view.along);
        return Ray(across, select(MOST_SCALE, min(1.0 / gap, MOST_SCALE), gap > 0.0), true);
    }
    // As `stored_position` has it; the gap from the receiver's own depth, which keeps its digits far from the light.
    let along = (face.depth_scale * face.far - stored * face.forward.w) / (face.depth_scale + stored);
    let z = along + face.forward.w;
    let turn = dot(gaze.turn, off);
    let gap = (seen.view.along - along) * gaze.ahead - z * turn;
    let scale = select(MOST_SCALE, min(z * gaze.depth / gap, MOST_SCALE), gap > 0.0);
    return Ray(across, scale, z * (gaze.ahead + turn) > 0.0);
}

/// A rectangle of the light's plane, in half sides of the light.
struct Rectangle {
    low: vec2<f32>,
    high: vec2<f32>,
}

const EVERYTHING = Rectangle(vec2(-MOST_SCALE), vec2(MOST_SCALE));

fn united(a: Rectangle, b: Rectangle) -> Rectangle {
    return Rectangle(min(a.low, b.low), max(a.high, b.high));
}

fn between(a: vec2<f32>, b: vec2<f32>) -> Rectangle {
    return Rectangle(min(a, b), max(a, b));
}

/// How far the texels on the edge of a light point's only map reach, in its widths: nothing is known of what lies beyond, and as
/// kernels do, it is taken for what is on the edge. A cube's faces go on in others.
const BEYOND: f32 = 1024.0;

/// Where a face's view has the lower edges of a texel.
fn texel_edge(face: Face, texel: vec2<i32>) -> vec2<f32> {
    let size = vec2<i32>(textureDimensions(shadow_depth));
    let beyond = select(vec2(0.0), select(vec2(0.0), vec2(BEYOND), texel >= size) - select(vec2(0.0), vec2(BEYOND), texel <= vec2(0)),
        points[0].cube_faces == 0u);
    return (vec2<f32>(texel) / vec2<f32>(size) + beyond - face.window.zw) / face.window.xy;
}

/// What the plane of a depth hides between two places of the view.
struct Shadow {
    bounds: Rectangle,
    /// What is hidden of the square around the light, in what its bounds would hide.
    share: f32,
    /// Whether all of it is before the receiver, and whether none.
    is_before: bool,
    is_behind: bool,
}

/// Area of the light's square below an edge, signed by its direction; summed around a polygon, what that hides.
fn below(a: vec2<f32>, b: vec2<f32>) -> f32 {
    let first = clamp(a.x, -1.0, 1.0);
    let last = clamp(b.x, -1.0, 1.0);
    if (first == last) {
        return 0.0;
    }
    let slope = (b.y - a.y) / (b.x - a.x);
    let low = a.y + slope * (first - a.x);
    let high = a.y + slope * (last - a.x);
    // The mean of the clamped height; where the edge is level, its own.
    let rise = high - low;
    let level = clamp(0.5 * (low + high), -1.0, 1.0);
    let mean = select((integral_of_clamped(high) - integral_of_clamped(low)) / rise, level, abs(rise) < 0x1p-10);
    return (last - first) * mean;
}

fn integral_of_clamped(x: f32) -> f32 {
    let size = abs(x);
    return select(size - 0.5, 0.5 * x * x, size <= 1.0);
}

fn shadow_of(face: Face, gaze: Gaze, seen: OnFace, first: vec2<f32>, last: vec2<f32>, stored: f32) -> Shadow {
    let a = ray_at(face, gaze, seen, first, stored);
    let c = ray_at(face, gaze, seen, last, stored);
    let least = min(a.scale, c.scale);
    let most = max(a.scale, c.scale);
    let p = a.scale * a.across;
    let r = c.scale * c.across;
    if (gaze.is_aligned) {
        return Shadow(between(p, r), 1.0, (most < MOST_SCALE), (least >= MOST_SCALE));
    }
    let b = ray_at(face, gaze, seen, vec2(last.x, first.y), stored);
    let d = ray_at(face, gaze, seen, vec2(first.x, last.y), stored);
    let q = b.scale * b.across;
    let t = d.scale * d.across;
    let bounds = united(between(p, r), between(q, t));
    let is_before = max(most, max(b.scale, d.scale)) < MOST_SCALE;
    let is_inside = all(max(abs(bounds.low), abs(bounds.high)) <= vec2(1.0));
    let side = clamp(bounds.high, vec2(-1.0), vec2(1.0)) - clamp(bounds.low, vec2(-1.0), vec2(1.0));
    let diagonals = 0.5 * ((r.x - p.x) * (t.y - q.y) - (r.y - p.y) * (t.x - q.x));
    let edges = below(p, q) + below(q, r) + below(r, t) + below(t, p);
    let share = clamp(abs(select(edges, diagonals, is_inside)) / max(side.x * side.y, 1.0e-37), 0.0, 1.0);
    return Shadow(bounds, share, is_before, min(least, min(b.scale, d.scale)) >= MOST_SCALE);
}

/// Area of the unit disk left of x and below y.
fn disk_corner(x: f32, y: f32) -> f32 {
    // Below the chord at y, left of x: integrals of the arc, 1/2 (x w + asin x), between where it is cut.
    let height = clamp(y, -1.0, 1.0);
    let reach = sqrt(max(1.0 - height * height, 0.0));
    let to = clamp(x, -1.0, 1.0);
    if (height >= 0.0) {
        // The whole column outside the chord's ends, up to the chord between them.
        let inside = clamp(to, -reach, reach);
        return 2.0 * (arc(min(to, -reach)) - arc(-1.0)) + (arc(inside) - arc(-reach)) + height * (inside + reach)
            + 2.0 * (arc(max(to, reach)) - arc(reach));
    }
    let inside = clamp(to, -reach, reach);
    return (arc(inside) - arc(-reach)) + height * (inside + reach);
}

/// Integral of the half chord of the unit disk.
fn arc(x: f32) -> f32 {
    return 0.5 * (x * sqrt(max(1.0 - x * x, 0.0)) + asin(x));
}

/// The fraction of the light that lies within a rectangle.
fn fraction_within(rectangle: Rectangle) -> f32 {
    let low = clamp(rectangle.low, vec2(-1.0), vec2(1.0));
    let high = clamp(rectangle.high, vec2(-1.0), vec2(1.0));
    let side = high - low;
    if (side.x <= 0.0 || side.y <= 0.0) {
        return 0.0;
    }
    let farthest = max(abs(low), abs(high));
    if (emitter.domain != 1u) {
        return 0.25 * side.x * side.y;
    }
    if (dot(farthest, farthest) <= 1.0) {
        return side.x * side.y / PI;
    }
    if (side.x == 2.0 && side.y == 2.0) {
        return 1.0;
    }
    let area = (disk_corner(high.x, high.y) - disk_corner(low.x, high.y))
        - (disk_corner(high.x, low.y) - disk_corner(low.x, low.y));
    return clamp(area, 0.0, side.x * side.y) / PI;
}

/// What a texel, or one that stands for the node around it, hides of the light.
struct Patch {
    hidden: f32,
    fetches: u32,
}

/// Depth of the texel that stands for a node, if it is before the receiver; negative if not, and where there is none.
fn blocker_at(face: Face, layer: u32, gaze: Gaze, seen: OnFace, cursor: Cursor) -> f32 {
    let first = cursor.place << vec2(cursor.level);
    if (any(first > map_last())) {
        return -1.0;
    }
    let texel = min(first + (1 << cursor.level) / 2, map_last());
    let at = texel_center(face, texel);
    let stored = textureLoad(shadow_depth, texel, layer, 0);
    let ray = ray_at(face, gaze, seen, at, stored);
    let is_blocker = stored > max(unblocked_depth(face, seen, at), 0.0) && ray.is_before && ray.scale < MOST_SCALE;
    return select(-1.0, stored, is_blocker);
}

/// A rectangle drawn out to where a neighbour of this depth has the edge, from a to b, that they share.
fn drawn_out(rectangle: Rectangle, face: Face, gaze: Gaze, seen: OnFace, stored: f32, a: vec2<f32>, b: vec2<f32>) -> Rectangle {
    if (stored < 0.0) {
        return rectangle;
    }
    let p = ray_at(face, gaze, seen, a, stored);
    let q = ray_at(face, gaze, seen, b, stored);
    return united(rectangle, between(p.scale * p.across, q.scale * q.across));
}

fn patch_at(face: Face, layer: u32, gaze: Gaze, seen: OnFace, cursor: Cursor) -> Patch {
    let stored = blocker_at(face, layer, gaze, seen, cursor);
    if (stored < 0.0) {
        return Patch(0.0, 1u);
    }
    let first = cursor.place << vec2(cursor.level);
    let low = texel_edge(face, first);
    let high = texel_edge(face, min(first + (1 << cursor.level) - 1, map_last()) + 1);
    let shadow = shadow_of(face, gaze, seen, low, high, stored);
    if (!fill_gaps) {
        return Patch(shadow.share * fraction_within(shadow.bounds), 1u);
    }
    // The edges shared with the neighbours to the right and above, as those have them.
    let right = blocker_at(face, layer, gaze, seen, Cursor(cursor.level, cursor.place + vec2(1, 0)));
    let above = blocker_at(face, layer, gaze, seen, Cursor(cursor.level, cursor.place + vec2(0, 1)));
    var rectangle = drawn_out(shadow.bounds, face, gaze, seen, right, vec2(high.x, low.y), high);
    rectangle = drawn_out(rectangle, face, gaze, seen, above, vec2(low.x, high.y), high);
    return Patch(shadow.share * fraction_within(rectangle), 3u);
}

/// The bounds on the depths of some of a node's texels.
fn depths_of(node: Node, first: vec2<i32>, within: Texels) -> vec2<f32> {
    let a = node.slope * vec2<f32>(within.first - first);
    let b = node.slope * vec2<f32>(within.last - first);
    let low = min(a, b);
    let high = max(a, b);
    return vec2(max(node.low + low.x + low.y, 0.0), min(node.high + high.x + high.y, 1.0));
}

/// Texels of the map that may hide some of the light, where nothing is nearer to the light than the depth of this scale; a guess,
/// where texels are not rectangles of the light.
fn window_of(face: Face, gaze: Gaze, seen: OnFace, least: f32) -> Texels {
    // |a - b| <= 1/s on both axes, as places of the view; half a texel more against roundings.
    let size = vec2<f32>(textureDimensions(shadow_depth));
    let determinant = gaze.across_x.x * gaze.across_y.y - gaze.across_x.y * gaze.across_y.x;
    let spread = vec2(abs(gaze.across_y.y) + abs(gaze.across_y.x), abs(gaze.across_x.y) + abs(gaze.across_x.x));
    let half = spread / max(abs(determinant) * least, 1.0e-37);
    let at = (seen.at * face.window.xy + face.window.zw) * size;
    let reach = min(half * abs(face.window.xy) * size + 0.5, 2.0 * size);
    let last = size - 1.0;
    return Texels(vec2<i32>(clamp(floor(at - reach), vec2(0.0), last)), vec2<i32>(clamp(floor(at + reach), vec2(0.0), last)));
}

/// Whether all of the search window is before the receiver: then the nearest rectangle of all its texels holds the light.
fn is_whole(face: Face, layer: u32, seen: OnFace, window: Texels) -> bool {
    let is_within_map = all(window.first > vec2(0)) && all(window.last < map_last());
    // Beyond the edge of a cube's face another goes on.
    if (points[0].cube_faces != 0u && !is_within_map) {
        return false;
    }
    let level = max(level_of((longer_side(window) + 1u) / 2u), 1u);
    let first_node = window.first >> vec2(level);
    let last_node = window.last >> vec2(level);
    for (var y = first_node.y; y <= last_node.y; y++) {
        for (var x = first_node.x; x <= last_node.x; x++) {
            let first = vec2(x, y) << vec2(level);
            let within = Texels(max(first, window.first), min(first + (1 << level) - 1, window.last));
            let threshold = threshold_of(face, seen, within);
            let node = node_at(layer, Cursor(level, vec2(x, y)));
            visits += 1u;
            if (decide(node, first, within, within, threshold, threshold.rounding) != BLOCKED) {
                return false;
            }
        }
    }
    return true;
}

fn longer_side(texels: Texels) -> u32 {
    let side = texels.last - texels.first + 1;
    return u32(max(side.x, side.y));
}

/// What a node hides of the light, below 0 where that can't be told without those below it.
fn judge(face: Face, layer: u32, gaze: Gaze, seen: OnFace, cursor: Cursor, within: Texels, last: vec2<i32>) -> Patch {
    let node = node_at(layer, cursor);
    let first = cursor.place << vec2(cursor.level);
    let threshold = threshold_of(face, seen, within);
    let found = decide(node, first, within, within, threshold, threshold.rounding);
    if (found == UNBLOCKED) {
        return Patch(0.0, 0u);
    }
    let depths = depths_of(node, first, within);
    let low = texel_edge(face, first);
    let high = texel_edge(face, last + 1);
    let nearest = shadow_of(face, gaze, seen, low, high, depths.y);
    let farthest = shadow_of(face, gaze, seen, low, high, depths.x);
    if (nearest.is_behind) {
        return Patch(0.0, 0u);
    }
    if (!nearest.is_before) {
        return Patch(-1.0, 0u);
    }
    let reached = united(nearest.bounds, farthest.bounds);
    if (any(reached.low >= vec2(1.0)) || any(reached.high <= vec2(-1.0))) {
        return Patch(0.0, 0u);
    }
    if (found != BLOCKED || !farthest.is_before) {
        return Patch(-1.0, 0u);
    }
    if (gaze.is_aligned && all(nearest.bounds.low <= vec2(-1.0)) && all(nearest.bounds.high >= vec2(1.0))) {
        return Patch(1.0, 0u);
    }
    // As one patch, where its depth makes no odds; the texels outside of the window touch no light.
    // Of what is no rectangle, only what is small beside the light is told by its area alone.
    let least = nearest.share * fraction_within(nearest.bounds);
    let most = farthest.share * fraction_within(farthest.bounds);
    let is_like_one = gaze.is_aligned || all(farthest.bounds.high - farthest.bounds.low <= vec2(MOST_SLANTED));
    let is_one = is_like_one && abs(most - least) <= tolerance * min(least, most) && tolerance > 0.0;
    return Patch(select(-1.0, min(0.5 * (least + most), 0.999999), is_one), 0u);
}

/// What a face's map hides of the light.
fn hidden_by(face: Face, layer: u32, light_point: LightPoint, receiver: Receiver) -> Patch {
    let to = to_light(light_point, receiver.position, face.distant == 1u);
    let seen = on_face(face, receiver.position, plane_normal(receiver.normal, to));
    if (seen.view.z <= 0.0 || passes_light(face, seen)) {
        return Patch(0.0, 0u);
    }
    let gaze = gaze_of(face, seen, light_point, receiver.position);
    if (gaze.depth <= 0.0) {
        return Patch(0.0, 0u);
    }
    var fetches = 0u;
    // The search window: the light, projected from the receiver onto the plane of the nearest depth.
    var window = window_of(face, gaze, seen, ray_at(face, gaze, seen, seen.at, 1.0).scale);
    for (var i = 0u; i < shrink; i++) {
        let level = max(level_of((longer_side(window) + 1u) / 2u), 1u);
        var nearest = 0.0;
        for (var y = window.first.y >> level; y <= window.last.y >> level; y++) {
            for (var x = window.first.x >> level; x <= window.last.x >> level; x++) {
                let first = vec2(x, y) << vec2(level);
                let within = Texels(max(first, window.first), min(first + (1 << level) - 1, window.last));
                nearest = max(nearest, depths_of(node_at(layer, Cursor(level, vec2(x, y))), first, within).y);
                fetches += 1u;
            }
        }
        let shrunk = window_of(face, gaze, seen, ray_at(face, gaze, seen, seen.at, nearest).scale);
        window = Texels(max(window.first, shrunk.first), min(window.last, shrunk.last));
    }
    let side = f32(longer_side(window));
    var finest = 0u;
    while (side > window_texels * f32(1u << finest)) {
        finest += 1u;
    }
    let visits_before = visits;
    let all_blocked = is_whole(face, layer, seen, window);
    fetches += visits - visits_before;
    if (all_blocked) {
        return Patch(1.0, fetches);
    }
    let top = coarsest_level();
    finest = min(finest, top - 1u);
    var whole = Texels(vec2(0), map_last());
    if (shrink > 0u && gaze.is_aligned) {
        whole = window;
    }
    let first_root = whole.first >> vec2(top);
    let last_root = whole.last >> vec2(top);
    var hidden = 0.0;
    for (var y = first_root.y; y <= last_root.y; y++) {
        for (var x = first_root.x; x <= last_root.x; x++) {
            var cursor = Cursor(top, vec2(x, y));
            loop {
                let first = cursor.place << vec2(cursor.level);
                let last = min(first + (1 << cursor.level) - 1, map_last());
                let within = Texels(max(first, whole.first), min(last, whole.last));
                var is_open = false;
                if (all(within.first <= within.last)) {
                    fetches += 1u;
                    visits += 1u;
                    let found = judge(face, layer, gaze, seen, cursor, within, last);
                    hidden += max(found.hidden, 0.0);
                    if (hidden >= 1.0) {
                        return Patch(1.0, fetches);
                    }
                    is_open = found.hidden < 0.0;
                }
                if (is_open && cursor.level > finest + 1u && visits < MOST_VISITS) {
                    cursor = down(cursor);
                    continue;
                }
                if (is_open) {
                    let child = down(cursor);
                    let a = patch_at(face, layer, gaze, seen, child);
                    let b = patch_at(face, layer, gaze, seen, Cursor(child.level, child.place + vec2(1, 0)));
                    let c = patch_at(face, layer, gaze, seen, Cursor(child.level, child.place + vec2(0, 1)));
                    let d = patch_at(face, layer, gaze, seen, Cursor(child.level, child.place + vec2(1, 1)));
                    hidden += a.hidden + b.hidden + c.hidden + d.hidden;
                    fetches += a.fetches + b.fetches + c.fetches + d.fetches;
                }
                cursor = after(cursor, top);
                if (cursor.level == top) {
                    break;
                }
            }
        }
    }
    return Patch(hidden, fetches);
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let light_point = points[0];
    // The light reaches over the edges of a cube's faces.
    let last = light_point.first_face + max(countOneBits(light_point.cube_faces), 1u);
    var hidden = 0.0;
    var fetches = 0u;
    for (var index = light_point.first_face; index < last && hidden < 1.0; index++) {
        let found = hidden_by(faces[index], index, light_point, receivers[id.x]);
        hidden += found.hidden;
        fetches += found.fetches;
    }
    count(fetches);
    visibility[id.x] = select(clamp(1.0 - hidden, 0.0, 1.0), 0.0, hidden >= 1.0 - SUM_ROUNDING);
}
