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

#import "lib/back_projection.wgsl"
#import "lib/counter.wgsl"

@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;

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

/// The largest patch that is no rectangle and is taken as one, in half sides of the light: 1/8 of it, as fine as the tolerance is.
const MOST_SLANTED: f32 = 0.25;

const PI: f32 = 3.14159265358979;

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

/// What a node hides of the light, below 0 where that can't be told without those below it.
fn judge(face: Face, layer: u32, gaze: Gaze, seen: OnFace, cursor: Cursor, within: Texels, last: vec2<i32>) -> Patch {
    let first = cursor.place << vec2(cursor.level);
    let low = texel_edge(face, first);
    let high = texel_edge(face, last + 1);
    if (is_behind_light(gaze, seen, low, high)) {
        return Patch(0.0, 0u);
    }
    let node = node_at(layer, cursor);
    let threshold = threshold_of(face, seen, within);
    let found = decide(node, first, within, within, threshold, threshold.rounding);
    if (found == UNBLOCKED) {
        return Patch(0.0, 0u);
    }
    let depths = depths_of(node, first, within);
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
        let nearest = nearest_in(layer, window);
        fetches += u32(nearest.y);
        let shrunk = window_of(face, gaze, seen, ray_at(face, gaze, seen, seen.at, nearest.x).scale);
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
