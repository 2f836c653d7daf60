// Back-projection: where what the texels of a map hold falls onto the light, as seen from a receiver.
//
// In the light's frame, with its centre (the map's own) at the origin, the point of a map's ray of tangents a at the depth z is seen
// by the receiver of tangents b at the depth y before
//     q = s (a - b), s = z y/(y - z), of a light at infinity a - b over the length y - z,
// where s grows with z: what is nearest to the light hides the smallest and innermost part of it.

#import "lib/min_max.wgsl"
#import "lib/emitter.wgsl"

/// How the light turns to its receivers: 0 not at all, 1 about its centre, 2 about its axis u.
override turns: u32;

/// Nodes looked into so far.
var<private> visits: u32;

/// The least half side of a light: smaller ones are points, on any scale that positions have.
const LEAST_HALF: f32 = 1.0e-18;

/// Where s is as good as infinite: beside it no light has a size.
const MOST_SCALE: f32 = 1.0e12;

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
    /// Half axes of the light in the view, as it turns to the receiver.
    half_u: vec3<f32>,
    half_v: vec3<f32>,
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
        return Gaze(1.0, vec2(u.x, v.x) / half, vec2(u.y, v.y) / half, 1.0, vec2(0.0), true, half.x * u, half.y * v);
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
        half.x * u,
        half.y * v,
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

/// Whether what the view holds between two places, the first one's coordinates below the other's, is behind the light's plane.
fn is_behind_light(gaze: Gaze, seen: OnFace, low: vec2<f32>, high: vec2<f32>) -> bool {
    return gaze.ahead + dot(gaze.turn, select(low, high, gaze.turn > vec2(0.0)) - seen.at) <= 0.0;
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
    return (points[0].cube_faces == 0u || is_within_map) && is_all(face, layer, seen, window, BLOCKED);
}

/// Whether the pyramid tells of all these texels that they are blocked, or unblocked.
fn is_all(face: Face, layer: u32, seen: OnFace, window: Texels, what: u32) -> bool {
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
            if (decide(node, first, within, within, threshold, threshold.rounding) != what) {
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

/// The nearest depth in some texels of the map, by its pyramid, and how many nodes told.
fn nearest_in(layer: u32, texels: Texels) -> vec2<f32> {
    let level = max(level_of((longer_side(texels) + 1u) / 2u), 1u);
    var found = vec2(0.0);
    for (var y = texels.first.y >> level; y <= texels.last.y >> level; y++) {
        for (var x = texels.first.x >> level; x <= texels.last.x >> level; x++) {
            let first = vec2(x, y) << vec2(level);
            let within = Texels(max(first, texels.first), min(first + (1 << level) - 1, texels.last));
            let nearest = depths_of(node_at(layer, Cursor(level, vec2(x, y))), first, within).y;
            found = vec2(max(found.x, nearest), found.y + 1.0);
        }
    }
    return found;
}
