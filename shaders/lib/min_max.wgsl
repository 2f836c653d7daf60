// A min-max pyramid over a shadow map. "Soft Shadows" (NVIDIA), section "How It Works": a node of level l bounds the depths of the
// 2^l x 2^l texels below it.
//
// A node may bound them between two parallel planes rather than between two depths, where it is no wider so: a surface that is
// tilted in the map is then as thin in every node as it is in one texel. Depth in a map is affine in the texel for any plane.

#import "lib/shadow_map.wgsl"

/// Level l is mip l - 1, of a power of two of nodes a side: slope.x, slope.y, low, high.
@group(0) @binding(6) var pyramid: texture_2d_array<f32>;

/// Depths d of texels i: low <= d - slope . (i - first) <= high. Of no texels: low > high.
struct Node {
    /// Per texel.
    slope: vec2<f32>,
    low: f32,
    high: f32,
}

/// Where a traversal of the pyramid is.
struct Cursor {
    level: u32,
    /// Of the node, counted in nodes of its level.
    place: vec2<i32>,
}

fn node_at(layer: u32, cursor: Cursor) -> Node {
    let texel = textureLoad(pyramid, cursor.place, layer, i32(cursor.level) - 1);
    return Node(texel.xy, texel.z, texel.w);
}

/// The coarsest level, of 2 x 2 nodes (of one, in a map of two texels).
fn coarsest_level() -> u32 {
    return max(textureNumLevels(pyramid) - 1u, 1u);
}

/// The finest level whose nodes have at least so many texels a side, if there is one.
fn level_of(texels: u32) -> u32 {
    return min(32u - countLeadingZeros(max(texels, 1u) - 1u), coarsest_level());
}

/// The node's first child.
fn down(cursor: Cursor) -> Cursor {
    return Cursor(cursor.level - 1u, 2 * cursor.place);
}

/// What follows a node and all below it, in the order of a Z: its next sibling, or that of the nearest parent that has one; at the
/// level `top` once the whole root is done. So no stack is needed, and no node comes twice.
fn after(cursor: Cursor, top: u32) -> Cursor {
    // A last sibling is odd on both axes: as many levels up as both places end in ones.
    let levels = min(countTrailingZeros(~u32(cursor.place.x & cursor.place.y)), top - cursor.level);
    let level = cursor.level + levels;
    let place = cursor.place >> vec2(levels);
    let sibling = place + select(vec2(-1, 1), vec2(1, 0), (place.x & 1) == 0);
    return Cursor(level, select(sibling, place, level == top));
}

/// What a correctly rounded operation adds, relative to its result, whichever way it rounds.
const ULP: f32 = 0x1p-23;

/// `unblocked_depth` at some texels: affine in the texel, but for roundings.
struct Threshold {
    /// At the first of them.
    at_first: f32,
    /// Per texel.
    slope: vec2<f32>,
    /// How far `unblocked_depth` as it is computed may be from this; beyond 1 where it is not known.
    slack: f32,
    /// How far this may be from what is meant.
    rounding: f32,
}

/// Bounds in real numbers what `unblocked_depth` computes.
///
/// With t the tilt, r = rise/offset, A = far - along, s = depth_scale: behind = z (r - t)/(1 + t), and so
/// depth = s (A - behind)/(z + behind) = s (A - z r + (A + z) t)/(z (1 + r)), in which t is affine in the texel.
/// Roundings of u each, WGSL's quotients of 2.5 u: a place is off by e = 2.5 u of the map's width and 3.6 u of its own size; t by
/// |z/offset| |n| e + 6.5 u |t|; behind by u z (2.5 |r| + 5.5 |r - t|)/(1 + t), which depth has 1/(1 + r) times, (1 + t) times
/// S = s (A + z)/(z (1 + r)); the rest is at most 6 u S (1 + |r| + |t|). With m = 1 + |r| + |t| at most this is
/// S (|z/offset| |n| e + u (6.5 m + 12 m m/(1 + r))), and no more again for what is computed here: 48 u S m m/(1 + r) and the places'.
/// The latter alone, of sums of terms each a few roundings off, is at most 24 u S m/(1 + r), and the places'.
/// To first order in the rounding of z + behind, u (2.5 |r| + 5.5 |r - t|)/(1 + r): where that is above 2^-4 nothing is claimed.
fn threshold_of(face: Face, seen: OnFace, whole: Texels) -> Threshold {
    let first = texel_center(face, whole.first);
    let last = texel_center(face, whole.last);
    let width = abs(1.0 / face.window.xy);
    let step = 1.0 / (face.window.xy * vec2<f32>(textureDimensions(shadow_depth)));
    let off = ULP * (2.5 * width + 3.6 * max(abs(first), abs(last)));
    let farthest = max(abs(first - seen.at), abs(last - seen.at));
    let delta = dot(seen.normal.xy, first - seen.at);
    let most = dot(abs(seen.normal.xy), farthest);
    let moved = 2.0 * dot(abs(seen.normal.xy), off);
    let before = face.far - seen.view.along;
    if (face.distant == 1u) {
        // depth = s (far - along - (rise - delta)/n.z): the places' roundings, those of the quotient, and those of the sums.
        let per_delta = face.depth_scale / seen.normal.z;
        let sums = abs(face.far) + abs(seen.view.along);
        let slack = abs(per_delta) * (moved + 24.0 * ULP * (seen.rise + most)) + 12.0 * ULP * face.depth_scale * sums;
        let at_first = face.depth_scale * before - per_delta * (seen.rise - delta);
        return Threshold(at_first, per_delta * seen.normal.xy * step, slack, slack);
    }
    let offset = dot(seen.normal, vec3(seen.view.across, seen.view.z));
    let r = seen.rise / offset;
    let per_delta = seen.view.z / offset;
    let per_tilt = face.depth_scale * (before + seen.view.z) / (seen.view.z * (1.0 + r));
    let at_seen = face.depth_scale * (before - seen.view.z * r) / (seen.view.z * (1.0 + r));
    let m = 1.0 + abs(r) + abs(per_delta) * most;
    let size = face.depth_scale * (abs(before) + seen.view.z) / (seen.view.z * (1.0 + r));
    let slack = size * (abs(per_delta) * moved + 48.0 * ULP * m * m / (1.0 + r));
    let rounding = size * (abs(per_delta) * moved + 24.0 * ULP * m / (1.0 + r));
    let is_known = 8.0 * ULP * m < 0x1p-4 * (1.0 + r);
    return Threshold(
        at_seen + per_tilt * per_delta * delta,
        per_tilt * per_delta * seen.normal.xy * step,
        select(2.0, slack, is_known),
        rounding,
    );
}

const MIXED = 0u;
const UNBLOCKED = 1u;
const BLOCKED = 2u;

/// What holds for all of a node's texels that are `within` the `whole` that the threshold is of, which is so far off at most;
/// `first` is the node's first.
fn decide(node: Node, first: vec2<i32>, within: Texels, whole: Texels, threshold: Threshold, off: f32) -> u32 {
    if (!(off <= 1.0)) {
        return MIXED;
    }
    // Depth in the map less the threshold, at the first of the texels and how it changes to the last.
    let into_node = vec2<f32>(within.first - first);
    let into_whole = vec2<f32>(within.first - whole.first);
    let steps = vec2<f32>(within.last - within.first);
    let rise = dot(node.slope, into_node);
    let limit = threshold.at_first + dot(threshold.slope, into_whole);
    let change = (node.slope - threshold.slope) * steps;
    let fall = min(change.x, 0.0) + min(change.y, 0.0);
    let gain = max(change.x, 0.0) + max(change.y, 0.0);
    // The roundings of these, at most nine of each.
    let reach = dot(abs(node.slope), into_node + steps) + dot(abs(threshold.slope), into_whole + steps);
    let size = max(abs(node.low), abs(node.high)) + abs(threshold.at_first) + reach;
    let slack = off + 12.0 * ULP * size;
    // Of the depths alone: what holds nothing is at depth 0, which blocks nothing.
    let bend = node.slope * steps;
    let lowest = node.low + rise + min(bend.x, 0.0) + min(bend.y, 0.0);
    let highest = node.high + rise + max(bend.x, 0.0) + max(bend.y, 0.0);
    if ((node.low + rise) - limit + fall > slack && lowest > select(12.0 * ULP * size, 0.0, all(node.slope == vec2(0.0)))) {
        return BLOCKED;
    }
    if ((node.high + rise) - limit + gain < -slack || (highest <= 0.0 && all(node.slope == vec2(0.0)))) {
        return UNBLOCKED;
    }
    return MIXED;
}
