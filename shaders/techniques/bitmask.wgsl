// Bitmask soft shadows. Schwarz and Stamminger 2007, "Bitmask Soft Shadows".
//
// Texels of the search window, the light as seen from the receiver through the plane of the nearest depth, are patches that are
// projected back onto the light. The light is a grid of bits, each a sample at the middle of its cell: a patch sets those that it
// hides, in a row all between two columns. However often a bit is set it counts once.

#import "lib/back_projection.wgsl"
#import "lib/counter.wgsl"

@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;

/// Bits along a side of the light, 16 at most.
override light_side: f32;
/// Texels taken along a side of the search window, at most; 96 x 96 of six faces end before some drivers end an invocation, after
/// 2^16 turns.
override search: u32;
/// How often the search window is shrunk to the nearest depth in it.
override shrink: u32;
/// Whether texels hide what patches of their own size do, parallel to the map.
override texels: bool;
/// Whether they hide what lies between the middles of four of them that block.
override quads: bool;

/// A bit for each sample of the light, 16 a row: of four rows in the low halves, and in the high halves of the four above them.
struct Bits {
    first: vec4<u32>,
    second: vec4<u32>,
}

/// What is hidden, and all that is light.
var<private> covered: Bits;
var<private> lit: Bits;

/// Where samples are in rows 4k to 4k + 3, in half sides of the light; beyond the light where it has fewer rows.
fn rows_at(k: f32) -> vec4<f32> {
    return (2.0 * (4.0 * k + vec4(0.0, 1.0, 2.0, 3.0)) + 1.0) / light_side - 1.0;
}

/// Bits of samples in [low, high), row by row.
fn between_columns(low: vec4<f32>, high: vec4<f32>) -> vec4<u32> {
    let first = vec4<u32>(clamp(ceil(0.5 * light_side * (low + 1.0) - 0.5), vec4(0.0), vec4(light_side)));
    let last = vec4<u32>(clamp(ceil(0.5 * light_side * (high + 1.0) - 0.5), vec4(0.0), vec4(light_side)));
    return ((vec4(1u) << last) - 1u) & ~((vec4(1u) << first) - 1u);
}

/// Bits of all samples of the light.
fn lit_bits() -> Bits {
    return Bits(lit_rows(0.0) | (lit_rows(1.0) << vec4(16u)), lit_rows(2.0) | (lit_rows(3.0) << vec4(16u)));
}

fn lit_rows(k: f32) -> vec4<u32> {
    let v = rows_at(k);
    let chord = select(vec4(1.0), sqrt(max(1.0 - v * v, vec4(0.0))), emitter.domain == 1u);
    return select(vec4(0u), between_columns(-chord, chord), v < vec4(1.0));
}

fn count_of(bits: Bits) -> u32 {
    let ones = countOneBits(bits.first) + countOneBits(bits.second);
    return ones.x + ones.y + ones.z + ones.w;
}

/// Whether nothing is left to hide.
fn is_full() -> bool {
    return all((lit.first & ~covered.first) == vec4(0u)) && all((lit.second & ~covered.second) == vec4(0u));
}

fn rows_of(k: f32, columns: vec4<u32>, rectangle: Rectangle) -> vec4<u32> {
    let rows = rows_at(k);
    return select(vec4(0u), columns, (rows >= vec4(rectangle.low.y)) & (rows < vec4(rectangle.high.y)));
}

/// Hides what lies within a rectangle.
fn cover_rectangle(rectangle: Rectangle) {
    let columns = between_columns(vec4(rectangle.low.x), vec4(rectangle.high.x));
    covered.first |= rows_of(0.0, columns, rectangle) | (rows_of(1.0, columns, rectangle) << vec4(16u));
    covered.second |= rows_of(2.0, columns, rectangle) | (rows_of(3.0, columns, rectangle) << vec4(16u));
}

/// Columns of four rows.
struct Span {
    low: vec4<f32>,
    high: vec4<f32>,
}

/// A span widened to where an edge crosses its rows; the same bits in either direction of the edge.
fn widened(span: Span, rows: vec4<f32>, start: vec2<f32>, end: vec2<f32>) -> Span {
    let a = select(start, end, start.y > end.y);
    let b = select(end, start, start.y > end.y);
    let rise = b.y - a.y;
    let x = a.x + (rows - a.y) / select(rise, 1.0, rise == 0.0) * (b.x - a.x);
    let crosses = (vec4(a.y) <= rows) & (rows < vec4(b.y));
    return Span(select(span.low, min(span.low, x), crosses), select(span.high, max(span.high, x), crosses));
}

fn rows_within(k: f32, a: vec2<f32>, b: vec2<f32>, c: vec2<f32>, d: vec2<f32>) -> vec4<u32> {
    let rows = rows_at(k);
    var span = Span(vec4(2.0), vec4(-2.0));
    span = widened(span, rows, a, b);
    span = widened(span, rows, b, c);
    span = widened(span, rows, c, d);
    span = widened(span, rows, d, a);
    return between_columns(span.low, span.high);
}

/// Hides what lies within a convex quadrilateral; of another, in each row all between its outermost edges.
fn cover_quadrilateral(a: vec2<f32>, b: vec2<f32>, c: vec2<f32>, d: vec2<f32>) {
    let bounds = united(between(a, c), between(b, d));
    if (any(bounds.low >= vec2(1.0)) || any(bounds.high <= vec2(-1.0))) {
        return;
    }
    covered.first |= rows_within(0.0, a, b, c, d) | (rows_within(1.0, a, b, c, d) << vec4(16u));
    covered.second |= rows_within(2.0, a, b, c, d) | (rows_within(3.0, a, b, c, d) << vec4(16u));
}

/// Texels that may hide some of the light, where nothing is nearer to the light than a depth of the map.
fn window_before(face: Face, gaze: Gaze, seen: OnFace, stored: f32) -> Texels {
    if (gaze.is_aligned) {
        return window_of(face, gaze, seen, ray_at(face, gaze, seen, seen.at, stored).scale);
    }
    // Around the receiver's place, and where the ways to the light's corners come to that depth, or end.
    let along = (face.depth_scale * face.far - stored * face.forward.w) / (face.depth_scale + stored);
    let nearest = along + face.forward.w;
    let own = vec3(seen.view.across, seen.view.z);
    var reached = Rectangle(seen.at, seen.at);
    for (var i = 0u; i < 4u; i++) {
        let corner = select(-1.0, 1.0, (i & 1u) == 1u) * gaze.half_u + select(-1.0, 1.0, i > 1u) * gaze.half_v;
        let fraction = clamp((own.z - nearest) / max(own.z - corner.z, 1.0e-37), 0.0, 1.0);
        let at = mix(own, corner, fraction);
        reached = united(reached, Rectangle(at.xy / at.z, at.xy / at.z));
    }
    let size = vec2<f32>(textureDimensions(shadow_depth));
    let first = (reached.low * face.window.xy + face.window.zw) * size;
    let last = (reached.high * face.window.xy + face.window.zw) * size;
    let low = clamp(floor(min(first, last) - 0.5), vec2(0.0), size - 1.0);
    return Texels(vec2<i32>(low), vec2<i32>(clamp(floor(max(first, last) + 0.5), vec2(0.0), size - 1.0)));
}

/// What a texel's middle holds, and where that is seen on the light.
struct Blocker {
    place: vec2<f32>,
    stored: f32,
    is_blocker: bool,
}

fn blocker_at(face: Face, layer: u32, gaze: Gaze, seen: OnFace, texel: vec2<i32>) -> Blocker {
    // What lies beyond the map is taken for what is on its edge.
    let held = clamp(texel, vec2(0), map_last());
    let stored = textureLoad(shadow_depth, held, layer, 0);
    let middle = texel_center(face, held);
    let is_before = stored > max(unblocked_depth(face, seen, middle), 0.0);
    let at = select(texel_edge(face, select(held, held + 1, texel > held)), middle, texel == held);
    let ray = ray_at(face, gaze, seen, at, stored);
    return Blocker(ray.scale * ray.across, stored, is_before && ray.is_before && ray.scale < MOST_SCALE);
}

/// Hides what the texels around one stand for, from `first` on.
fn cover_texels(face: Face, layer: u32, gaze: Gaze, seen: OnFace, first: vec2<i32>, stride: vec2<i32>) {
    let blocker = blocker_at(face, layer, gaze, seen, clamp(first + stride / 2, vec2(0), map_last()));
    if (!blocker.is_blocker) {
        return;
    }
    let low = texel_edge(face, max(first, vec2(0)));
    let high = texel_edge(face, min(first + stride - 1, map_last()) + 1);
    let a = ray_at(face, gaze, seen, low, blocker.stored);
    let c = ray_at(face, gaze, seen, high, blocker.stored);
    if (gaze.is_aligned) {
        cover_rectangle(between(a.scale * a.across, c.scale * c.across));
        return;
    }
    let b = ray_at(face, gaze, seen, vec2(high.x, low.y), blocker.stored);
    let d = ray_at(face, gaze, seen, vec2(low.x, high.y), blocker.stored);
    cover_quadrilateral(a.scale * a.across, b.scale * b.across, c.scale * c.across, d.scale * d.across);
}

/// Hides what a face's map shows of what blocks; gives how many texels and nodes were read.
fn cover_by(face: Face, layer: u32, light_point: LightPoint, receiver: Receiver) -> u32 {
    let to = to_light(light_point, receiver.position, face.distant == 1u);
    let seen = on_face(face, receiver.position, plane_normal(receiver.normal, to));
    if (seen.view.z <= 0.0 || passes_light(face, seen)) {
        return 0u;
    }
    let gaze = gaze_of(face, seen, light_point, receiver.position);
    if (gaze.depth <= 0.0) {
        return 0u;
    }
    var fetches = 0u;
    var window = window_before(face, gaze, seen, 1.0);
    for (var i = 0u; i < shrink; i++) {
        let nearest = nearest_in(layer, window);
        fetches += u32(nearest.y);
        let shrunk = window_before(face, gaze, seen, nearest.x);
        window = Texels(max(window.first, shrunk.first), min(window.last, shrunk.last));
    }
    let visits_before = visits;
    let is_whole = is_whole(face, layer, seen, window);
    if (is_whole) {
        covered = lit;
    }
    let is_done = is_whole || is_all(face, layer, seen, window, UNBLOCKED);
    fetches += visits - visits_before;
    if (is_done) {
        return fetches;
    }
    // Every texel of a small window, every so many of a large one.
    let side = window.last - window.first + 1;
    let stride = (side + i32(search) - 1) / i32(search);
    let count = (side + stride - 1) / stride;
    let first = window.first - (count * stride - side) / 2;
    if (quads) {
        let middle = first + stride / 2;
        for (var y = -1; y < count.y && !is_full(); y++) {
            var a = blocker_at(face, layer, gaze, seen, middle + vec2(-1, y) * stride);
            var d = blocker_at(face, layer, gaze, seen, middle + vec2(-1, y + 1) * stride);
            for (var x = 0; x <= count.x; x++) {
                let b = blocker_at(face, layer, gaze, seen, middle + vec2(x, y) * stride);
                let c = blocker_at(face, layer, gaze, seen, middle + vec2(x, y + 1) * stride);
                if (a.is_blocker && b.is_blocker && c.is_blocker && d.is_blocker) {
                    cover_quadrilateral(a.place, b.place, c.place, d.place);
                }
                a = b;
                d = c;
            }
            fetches += 2u * u32(count.x + 2);
        }
    }
    for (var y = 0; texels && y < count.y && !is_full(); y++) {
        for (var x = 0; x < count.x; x++) {
            cover_texels(face, layer, gaze, seen, first + vec2(x, y) * stride, stride);
        }
        fetches += u32(count.x);
    }
    return fetches;
}

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let light_point = points[0];
    lit = lit_bits();
    var fetches = 0u;
    // The light reaches over the edges of a cube's faces.
    let last = light_point.first_face + max(countOneBits(light_point.cube_faces), 1u);
    for (var index = light_point.first_face; index < last; index++) {
        fetches += cover_by(faces[index], index, light_point, receivers[id.x]);
    }
    count(fetches);
    let hidden = Bits(covered.first & lit.first, covered.second & lit.second);
    visibility[id.x] = 1.0 - f32(count_of(hidden)) / f32(count_of(lit));
}
