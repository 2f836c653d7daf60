// Soft shadows from one shadow map a frame. Scherzer, Schwärzler, Mattausch and Wimmer 2009, "Real-Time Soft Shadows Using Temporal
// Coherence": each frame's map is seen from another point of the light, and its tests are added to those of the frames before,
// fetched from where the receiver was on the screen.

#import "lib/pcss.wgsl"
#import "lib/screen.wgsl"

/// What is seen of the part of the light that is above a receiver's horizon: 1 − ψ as it is shown.
@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;
/// What the frame before has left and what this one leaves, by pixel: `Past` in words.
@group(0) @binding(6) var<storage, read> history: array<u32>;
@group(0) @binding(8) var<storage, read_write> next_history: array<u32>;
@group(0) @binding(9) var<uniform> step: Step;
@group(0) @binding(10) var<storage, read> arrivals: array<Arrival>;
/// The moving casters alone, as the faces see them.
@group(0) @binding(12) var moving_depth: texture_depth_2d_array;
/// Receivers, by index, that `accumulate` leaves to `begin`: how many have no past and how many have one, then the former from the
/// front and the latter from the back.
@group(0) @binding(13) var<storage, read_write> beginning: array<atomic<u32>>;
/// Receivers, by index, that moving casters may shadow.
@group(0) @binding(14) var<storage, read> reached: array<u32>;
/// Receivers from which nothing can hide any of the light.
@group(0) @binding(15) var<storage, read> lit: array<Lit>;

/// What happens from one frame to the next. Twin of `Step` in `techniques/temporal.rs`.
struct Step {
    /// Where a receiver's past lies: 0 it has none, 1 at its own pixel, 2 where its `Arrival` says.
    source: u32,
    /// Samples that are kept at most, as far as the light moves.
    most: f32,
    /// Lengths of the frame before in this one's unit.
    rescale: f32,
    /// Whether the maps reach as far as kernels do, so that PCSS may begin with them.
    is_wide: u32,
    /// Of the frame before, pixels.
    size: vec2<u32>,
    /// How far depths of one surface may differ: times the depth, and at any depth.
    past_tolerance: vec2<f32>,
}

/// Where a receiver was in the frame before. Twin of `Arrival` in `techniques/temporal.rs`.
struct Arrival {
    /// On the screen; far outside where it has no past.
    at_px: vec2<f32>,
    /// How its surface's plane goes on there: relative change of the inverse of its depth a pixel (of its depth, orthographic).
    slope: vec2<f32>,
    /// How far it has moved since.
    motion: vec3<f32>,
    /// Its depth there.
    depth: f32,
}

/// A receiver that sees the whole light. Twin of `Lit` in `techniques/temporal.rs`.
struct Lit {
    /// Of its pixel.
    number: u32,
    instance: u32,
    depth: f32,
    /// Frames so far.
    count: f32,
}

override start_weight: f32;
/// Whether blockers are searched for where a receiver has no past.
override starts: bool;
/// Error above which neighbours are averaged, where any are.
override threshold: f32;
override filters: bool;
/// 1: the paper's formulas and choices, each.
override binomial: bool;
override screen_disk: bool;
override all_depths: bool;
override printed: bool;
override half_floats: bool;
override resets: bool;
override aging: bool;

/// Tests that a receiver has been through.
struct Past {
    /// Those that found it in shadow, and all.
    shadowed: f32,
    count: f32,
    /// Mean gap between it and its blockers, and what that mean weighs.
    gap: f32,
    blockers: f32,
    /// What PCSS took the occlusion for when it came into view, and what that weighs.
    seed: f32,
    seed_weight: f32,
    depth: f32,
    /// Plus one.
    instance: u32,
}

const NO_PAST = Past(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0u);

/// Samples are halved here: below 2^24 f32 counts exactly, and so do halves of counts below 2^16.
const MOST_SAMPLES: f32 = 65536.0;

fn words() -> u32 {
    return select(8u, 5u, half_floats);
}

/// What tells whether a pixel's surface is the receiver's, and its tests: the first words of a past.
struct Brief {
    shadowed: f32,
    count: f32,
    depth: f32,
    instance: u32,
}

fn brief_of(first: vec4<u32>) -> Brief {
    if (half_floats) {
        let tests = unpack2x16float(first.x);
        return Brief(tests.x, tests.y, unpack2x16float(first.y).x, first.z);
    }
    return Brief(bitcast<f32>(first.x), bitcast<f32>(first.y), bitcast<f32>(first.z), first.w);
}

/// A past of its first words, and of those that follow.
fn past_from(first: vec4<u32>, rest: vec4<u32>) -> Past {
    let brief = brief_of(first);
    if (half_floats) {
        let blockers = unpack2x16float(first.w);
        let seed = unpack2x16float(rest.x);
        return Past(brief.shadowed, brief.count, blockers.x, blockers.y, seed.x, seed.y, brief.depth, brief.instance);
    }
    let others = bitcast<vec4<f32>>(rest);
    return Past(brief.shadowed, brief.count, others.x, others.y, others.z, others.w, brief.depth, brief.instance);
}

fn stored_brief(number: u32) -> Brief {
    let i = number * words();
    return brief_of(vec4(history[i], history[i + 1u], history[i + 2u], history[i + 3u]));
}

/// What a pixel of the frame before has left.
fn stored(number: u32) -> Past {
    let i = number * words();
    let first = vec4(history[i], history[i + 1u], history[i + 2u], history[i + 3u]);
    if (half_floats) {
        return past_from(first, vec4(history[i + 4u], 0u, 0u, 0u));
    }
    return past_from(first, vec4(history[i + 4u], history[i + 5u], history[i + 6u], history[i + 7u]));
}

/// What a pixel leaves so far.
fn left(number: u32) -> Past {
    let i = number * words();
    let first = vec4(next_history[i], next_history[i + 1u], next_history[i + 2u], next_history[i + 3u]);
    if (half_floats) {
        return past_from(first, vec4(next_history[i + 4u], 0u, 0u, 0u));
    }
    return past_from(first, vec4(next_history[i + 4u], next_history[i + 5u], next_history[i + 6u], next_history[i + 7u]));
}

fn store(number: u32, past: Past) {
    let i = number * words();
    if (half_floats) {
        next_history[i] = pack2x16float(vec2(past.shadowed, past.count));
        next_history[i + 1u] = pack2x16float(vec2(past.depth, 0.0));
        next_history[i + 2u] = past.instance;
        next_history[i + 3u] = pack2x16float(vec2(past.gap, past.blockers));
        next_history[i + 4u] = pack2x16float(vec2(past.seed, past.seed_weight));
        return;
    }
    next_history[i] = bitcast<u32>(past.shadowed);
    next_history[i + 1u] = bitcast<u32>(past.count);
    next_history[i + 2u] = bitcast<u32>(past.depth);
    next_history[i + 3u] = past.instance;
    next_history[i + 4u] = bitcast<u32>(past.gap);
    next_history[i + 5u] = bitcast<u32>(past.blockers);
    next_history[i + 6u] = bitcast<u32>(past.seed);
    next_history[i + 7u] = bitcast<u32>(past.seed_weight);
}

/// The number of a pixel of the frame before, or none.
fn past_number(pixel: vec2<i32>) -> i32 {
    if (any(pixel < vec2(0)) || any(pixel >= vec2<i32>(step.size))) {
        return -1;
    }
    return pixel.y * i32(step.size.x) + pixel.x;
}

/// Whether what is stored at a pixel of the frame before is of the receiver's surface: its plane, as deep as that is there.
fn is_own(arrival: Arrival, receiver: Receiver, pixel: vec2<i32>, past: Brief) -> bool {
    let along = dot(arrival.slope, vec2<f32>(pixel) + 0.5 - arrival.at_px);
    let depth = select(arrival.depth / (1.0 + along), arrival.depth + along, screen.orthographic == 1u);
    let is_near = abs(depth - past.depth) <= step.past_tolerance.x * depth + step.past_tolerance.y;
    return is_near && past.count > 0.0 && past.instance == receiver.instance + 1u;
}

/// The past at the nearest pixel, by Eq. 4: |d_k − d_{k−1}| < ε, with d_k as it is now.
fn past_as_printed(arrival: Arrival, receiver: Receiver) -> Past {
    let number = past_number(vec2<i32>(floor(arrival.at_px)));
    if (number < 0) {
        return NO_PAST;
    }
    var past = stored(u32(number));
    let depth = depth_of(receiver.position);
    let is_same = abs(depth - past.depth * step.rescale) < step.past_tolerance.x * depth + step.past_tolerance.y;
    if (past.count == 0.0 || !is_same) {
        return NO_PAST;
    }
    past.gap *= step.rescale;
    return past;
}

/// Weights of four pixels in a row for a place between the middle two (Catmull and Rom 1974).
fn cubic(t: f32) -> vec4<f32> {
    let squared = t * t;
    let cubed = squared * t;
    return vec4(
        squared - 0.5 * (t + cubed),
        1.0 - 2.5 * squared + 1.5 * cubed,
        0.5 * t + 2.0 * squared - 1.5 * cubed,
        0.5 * (cubed - squared),
    );
}

/// A receiver's past as it is fetched.
struct Fetched {
    past: Past,
    /// Least and largest share of tests in shadow around it.
    shares: vec2<f32>,
    /// Samples that it may hold.
    most: f32,
}

/// What is known of a receiver from the frames before, in this frame's unit. A light without size asks nothing of it: one test
/// tells all.
fn past_of(index: u32, receiver: Receiver) -> Fetched {
    if (step.source == 0u || emitter.domain == 2u) {
        return Fetched(NO_PAST, vec2(0.0), MOST_SAMPLES);
    }
    if (step.source == 1u) {
        var past = stored(receiver.number);
        past.gap *= step.rescale;
        return Fetched(past, vec2(0.0), MOST_SAMPLES);
    }
    let arrival = arrivals[index];
    if (printed) {
        return Fetched(past_as_printed(arrival, receiver), vec2(0.0), MOST_SAMPLES);
    }
    let corner = floor(arrival.at_px - 0.5);
    let between = arrival.at_px - 0.5 - corner;
    let linear_x = vec2(1.0 - between.x, between.x);
    let linear_y = vec2(1.0 - between.y, between.y);
    let cubic_x = cubic(between.x);
    let cubic_y = cubic(between.y);
    var sum = NO_PAST;
    var whole = 0.0;
    var shares = 0.0;
    var range = vec2(1.0, 0.0);
    var is_whole = true;
    // The four around it.
    for (var i = 0u; i < 4u; i++) {
        let offset = vec2(i & 1u, i >> 1u);
        let weight = linear_x[offset.x] * linear_y[offset.y];
        if (weight == 0.0) {
            continue;
        }
        let pixel = vec2<i32>(corner) + vec2<i32>(offset);
        let number = past_number(pixel);
        let past = stored(u32(max(number, 0)));
        if (number < 0 || !is_own(arrival, receiver, pixel, Brief(past.shadowed, past.count, past.depth, past.instance))) {
            is_whole = false;
            continue;
        }
        let share = past.shadowed / past.count;
        shares += cubic_x[offset.x + 1u] * cubic_y[offset.y + 1u] * share;
        range = vec2(min(range.x, share), max(range.y, share));
        whole += weight;
        sum.shadowed += weight * past.shadowed;
        sum.count += weight * past.count;
        sum.gap += weight * past.blockers * past.gap;
        sum.blockers += weight * past.blockers;
        sum.seed += weight * past.seed_weight * past.seed;
        sum.seed_weight += weight * past.seed_weight;
    }
    // The twelve around these.
    for (var i = 0u; i < 12u; i++) {
        let offset = select(vec2(3u * (i & 1u), 1u + ((i >> 1u) & 1u)), vec2(i & 3u, 3u * ((i >> 2u) & 1u)), i < 8u);
        let cubic_weight = cubic_x[offset.x] * cubic_y[offset.y];
        if (cubic_weight == 0.0) {
            continue;
        }
        let pixel = vec2<i32>(corner) + vec2<i32>(offset) - 1;
        let number = past_number(pixel);
        let past = stored_brief(u32(max(number, 0)));
        if (number < 0 || !is_own(arrival, receiver, pixel, past)) {
            is_whole = false;
            continue;
        }
        let share = past.shadowed / past.count;
        shares += cubic_weight * share;
        range = vec2(min(range.x, share), max(range.y, share));
    }
    // Past the border of what was seen the nearest pixels would be drawn along, a little farther each frame.
    if (whole < 0.999) {
        return Fetched(NO_PAST, vec2(0.0), MOST_SAMPLES);
    }
    sum.count /= whole;
    // Linear weights blur a little more each frame, cubic ones keep edges; where one of the pixels is not of this surface there are
    // only the former.
    sum.shadowed = select(sum.shadowed / whole, sum.count * clamp(shares, 0.0, 1.0), is_whole);
    sum.gap = step.rescale * select(sum.gap / sum.blockers, 0.0, sum.blockers == 0.0);
    sum.blockers /= whole;
    sum.seed = select(sum.seed / sum.seed_weight, 0.0, sum.seed_weight == 0.0);
    sum.seed_weight /= whole;
    let most = min(most_aged(sum, receiver, arrival.motion), most_resampled(sum, receiver, between));
    return Fetched(limited(sum, most), range, most);
}

/// Penumbra widths by which the shadow of what is `gap` before a receiver moves across it when it moves, relative to the light.
fn shift_of(gap: f32, receiver: Receiver, motion: vec3<f32>) -> f32 {
    let distant = emitter.distant == 1u;
    let to = select(emitter.center - receiver.position, emitter.center, distant);
    let toward = dot(emitter.normal, to);
    // Along the light's rays nothing changes but the scale of the shadow: what is left is across.
    let across = motion - to * (dot(emitter.normal, motion) / toward);
    let reach = widening(gap, receiver.position);
    let squared = vec2(dot(emitter.half_u, emitter.half_u), dot(emitter.half_v, emitter.half_v));
    let shift = vec2(dot(across, emitter.half_u), dot(across, emitter.half_v)) / (2.0 * reach * squared);
    return length(shift);
}

/// Samples that a past may hold when each of them is `shift` penumbra widths off the next: the error of n samples is about
/// ½ n^-¾, that of what they lag behind n·shift/2; the sum of their squares is least where n^3.5 = ¾/shift². From half a width on
/// that is less than two samples, and none of them is of use.
fn most_samples(shift: f32) -> f32 {
    if (!(shift < 0.5)) {
        return 0.0;
    }
    return max(pow(0.75 / (shift * shift), 2.0 / 7.0), 1.0);
}

/// A past whose shadows have moved is worth less: samples that it may hold.
fn most_aged(past: Past, receiver: Receiver, motion: vec3<f32>) -> f32 {
    if (!aging) {
        return MOST_SAMPLES;
    }
    if (any(motion != vec3(0.0))) {
        // Where no blocker is known there is no telling how near a shadow is.
        return min(step.most, select(most_samples(shift_of(past.gap, receiver, motion)), 0.0, past.blockers == 0.0));
    }
    return step.most;
}

/// Samples that a past may hold that is fetched from `between` pixels: what is a few of them wide is blurred a little more by each
/// fetch.
fn most_resampled(past: Past, receiver: Receiver, between: vec2<f32>) -> f32 {
    // Where no blocker is known there is no penumbra.
    if (!aging || past.blockers == 0.0 || all(min(between, 1.0 - between) < vec2(1.0e-3))) {
        return MOST_SAMPLES;
    }
    let light_size = 2.0 * min(length(emitter.half_u), length(emitter.half_v));
    let depth = select(depth_of(receiver.position), 1.0, screen.orthographic == 1u);
    let width_px = light_size * widening(past.gap, receiver.position) * screen.focal / depth;
    return clamp(RESAMPLED * width_px * width_px * width_px, 1.0, MOST_SAMPLES);
}

/// By measurement, a cubed pixel.
const RESAMPLED: f32 = 0.25;

/// Where a past may hold no more samples than these, PCSS is begun anew in every frame.
const MOST_REFRESHED: f32 = 8.0;

fn limited(past: Past, most: f32) -> Past {
    let whole = past.count + past.seed_weight;
    if (most < 1.0) {
        return NO_PAST;
    }
    if (whole <= most) {
        return past;
    }
    let kept = most / whole;
    var limited = past;
    limited.shadowed *= kept;
    limited.count *= kept;
    limited.seed_weight *= kept;
    limited.blockers *= kept;
    return limited;
}

/// One test of a map.
struct Test {
    /// Whether its point of the light is above the receiver's horizon; what is below tells nothing of blockers.
    above: bool,
    blocked: bool,
    /// Whether what blocks moves.
    moving: bool,
    gap: f32,
}

fn test_of(light_point: LightPoint, receiver: Receiver) -> Test {
    let index = face_toward(light_point, receiver.position - light_point.position);
    let face = faces[index];
    let to = to_light(light_point, receiver.position, face.distant == 1u);
    if (dot(receiver.normal, to) <= 0.0) {
        return Test(false, false, false, 0.0);
    }
    let seen = on_face(face, receiver.position, receiver.normal);
    let texel = texel_at(face, seen.at);
    let at = texel_center(face, texel);
    let depth = textureLoad(shadow_depth, texel, index, 0);
    let blocked = depth > max(unblocked_depth(face, seen, at), 0.0);
    // The same triangles through the same pipeline give the same depth, so the nearest moves if it is no nearer than what moves.
    let moving = resets && blocked && textureLoad(moving_depth, texel, index, 0) >= depth;
    return Test(true, blocked, moving, gap_of(face, at, depth, receiver.position));
}

/// A receiver without past, by what PCSS finds in this frame's map.
fn begun(found: Penumbra) -> Past {
    var past = NO_PAST;
    past.gap = found.gap;
    past.blockers = found.blockers;
    past.seed = found.occlusion;
    past.seed_weight = start_weight;
    if (screen_disk) {
        // As the paper has it, PCSS counts as so many samples.
        past.shadowed = past.seed * start_weight;
        past.count = start_weight;
        past.seed_weight = 0.0;
        past.blockers = select(found.blockers, f32(search_taps), all_depths);
    }
    return past;
}

/// A past with one more test in it.
fn with_test(before: Past, test: Test) -> Past {
    var past = before;
    if (past.count >= MOST_SAMPLES) {
        past.shadowed *= 0.5;
        past.count *= 0.5;
        past.seed_weight *= 0.5;
    }
    past.count += 1.0;
    past.shadowed += select(0.0, 1.0, test.blocked);
    // Eq. 7 over what blocks; as it is printed it takes every depth, and drifts to the receiver's own.
    if (test.blocked || all_depths) {
        past.blockers = min(past.blockers + 1.0, MOST_SAMPLES);
        past.gap += (test.gap - past.gap) / past.blockers;
    }
    return as_stored(past);
}

/// A past as a frame leaves it to the next: several frames of a still image round as often as they would one by one.
fn as_stored(before: Past) -> Past {
    if (!half_floats) {
        return before;
    }
    var past = before;
    let tests = unpack2x16float(pack2x16float(vec2(past.shadowed, past.count)));
    let blockers = unpack2x16float(pack2x16float(vec2(past.gap, past.blockers)));
    let seed = unpack2x16float(pack2x16float(vec2(past.seed, past.seed_weight)));
    past.shadowed = tests.x;
    past.count = tests.y;
    past.gap = blockers.x;
    past.blockers = blockers.y;
    past.seed = seed.x;
    past.seed_weight = seed.y;
    return past;
}

/// Adds the tests of the frames from the `first` on to a past, and leaves it to the next frame.
fn finish(receiver: Receiver, before: Past, first: u32) {
    var past = before;
    var texels = 0u;
    for (var i = first; i < arrayLength(&points); i++) {
        let test = test_of(points[i], receiver);
        if (!test.above) {
            continue;
        }
        texels += 1u;
        past = with_test(past, test);
    }
    count(texels);
    leave(receiver, past);
}

fn leave(receiver: Receiver, before: Past) {
    var past = before;
    past.depth = depth_of(receiver.position);
    past.instance = receiver.instance + 1u;
    store(receiver.number, past);
}

@compute @workgroup_size(64)
fn accumulate(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    let fetched = past_of(id.x, receiver);
    var past = fetched.past;
    if (starts && step.is_wide == 1u && emitter.domain != 2u) {
        // There is one map.
        let test = test_of(points[0], receiver);
        if (test.moving) {
            past = NO_PAST;
        }
        let tested = select(0.0, 1.0, test.blocked);
        let is_even = fetched.shares.x == tested && fetched.shares.y == tested;
        let is_new = past.count == 0.0;
        if (test.above && (is_new || (fetched.most < MOST_REFRESHED && !is_even))) {
            let place = atomicAdd(&beginning[select(1u, 0u, is_new)], 1u);
            atomicStore(&beginning[select(arrayLength(&beginning) - 1u - place, 2u + place, is_new)], id.x);
            leave(receiver, past);
            return;
        }
    }
    finish(receiver, past, 0u);
}

/// A prime: multiples of it, modulo another number, are that number's remainders in another order.
const SCATTER: u32 = 40507u;

/// Receivers without past, or with little: PCSS takes so long that those who have one would wait for them, and those who know their
/// blockers for those who search for them.
@compute @workgroup_size(64)
fn begin(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    // Few of the workgroups have work, and some drivers give each processor a row of them.
    let number = group.x * SCATTER % groups.x;
    let count_new = atomicLoad(&beginning[0]);
    let groups_new = (count_new + 63u) / 64u;
    let is_new = number < groups_new;
    let place = 64u * select(number - groups_new, number, is_new) + local;
    if (place >= select(atomicLoad(&beginning[1]), count_new, is_new)) {
        return;
    }
    let receiver = receivers[atomicLoad(&beginning[select(arrayLength(&beginning) - 1u - place, 2u + place, is_new)])];
    let before = left(receiver.number);
    let has_past = before.count > 0.0;
    let known_gap = select(-1.0, before.gap, has_past && before.blockers > 0.0);
    let found = percentage_closer_from(points[0], receiver, known_gap);
    count(found.texels);
    var past = as_stored(begun(found));
    if (has_past) {
        past = before;
        past.seed = found.occlusion;
        past.seed_weight = start_weight;
        past.gap = found.gap;
        past.blockers = max(past.blockers, found.blockers);
    }
    // In the paper PCSS is this frame's test.
    finish(receiver, past, select(0u, 1u, !has_past && past.count > 0.0));
}

/// Receivers that see the whole light, for those that come from there.
@compute @workgroup_size(64)
fn keep_lit(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&lit)) {
        return;
    }
    let own = lit[id.x];
    var past = NO_PAST;
    past.count = own.count;
    past.depth = own.depth;
    past.instance = own.instance + 1u;
    store(own.number, as_stored(past));
}

/// What the moving casters alone leave of the light, by PCSS from its centre.
@compute @workgroup_size(64)
fn beside(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&reached)) {
        return;
    }
    let found = percentage_closer(points[0], receivers[reached[id.x]]);
    count(found.texels);
    visibility[id.x] = 1.0 - found.occlusion;
}

/// Standard error of the share of samples in shadow.
fn standard_error(past: Past) -> f32 {
    if (binomial) {
        // Eq. 3, 0/0 for a single sample, which table 1 makes 0; equal samples pass for certain.
        let share = past.shadowed / past.count;
        return select(sqrt(max(share * (1.0 - share), 0.0) / (past.count - 1.0)), 0.0, past.count <= 1.0);
    }
    // Of the posterior to Jeffreys' prior, beta(½, ½).
    let a = past.shadowed + 0.5;
    let b = past.count - past.shadowed + 0.5;
    let whole = a + b;
    return sqrt(a * b / (whole + 1.0)) / whole;
}

/// A Poisson disk: the largest least distance that a search has found, 0.52.
const POISSON = array<vec2<f32>, 16>(
    vec2(-0.403, -0.915),
    vec2(-0.221, 0.968),
    vec2(0.966, 0.257),
    vec2(-0.993, -0.045),
    vec2(-0.003, 0.048),
    vec2(0.674, 0.734),
    vec2(0.641, -0.757),
    vec2(-0.834, -0.549),
    vec2(-0.705, 0.700),
    vec2(-0.334, -0.361),
    vec2(0.196, -0.447),
    vec2(-0.512, 0.183),
    vec2(0.515, -0.016),
    vec2(0.137, -0.990),
    vec2(0.158, 0.575),
    vec2(0.940, -0.323),
);
const TAPS: u32 = 16u;

/// Samples of the last net of the sequence that is whole, a power of two: those beyond it lie unevenly, and lower the error by little.
fn whole_net(samples: f32) -> f32 {
    return exp2(floor(log2(max(samples, 1.0)) + 1.0e-3));
}

/// Size of the kernel after n samples, relative to the light: n^-¾, as the error of n points of the sequence falls, times this; by
/// measurement (1/√n blurs the ends of penumbrae more than the points leave to be filled, n^-¾ alone leaves their steps).
const KERNEL: f32 = 1.5;

/// Where on the light's kernel, from its centre, a tap of the filter is: half axes in u and v.
fn kernel_uv(sampler: Sampler, i: u32) -> vec2<f32> {
    let square = unit_square(sampler, i);
    return select(2.0 * square - 1.0, disk_from_square(square), emitter.domain == 1u);
}

/// A share of tests in shadow, and how many pixels it is of.
struct Smoothed {
    share: f32,
    pixels: f32,
}

/// The mean of the neighbours' shares, by 16 taps; the receiver's own where none of them is of its surface.
fn smoothed(receiver: Receiver, past: Past) -> Smoothed {
    let own_px = middle_px(receiver.number);
    let own = past.shadowed / past.count;
    // The paper's filter takes surfaces for flat on the screen.
    let slope = select(slope_of(receiver.normal, own_px), vec2(0.0), screen_disk);
    let sampler = sampler_of(3u, vec2(4u, 4u), receiver.number, 2u);
    let light_size = 2.0 * max(length(emitter.half_u), length(emitter.half_v));
    let shift = shadow_shift(receiver.position, receiver.normal, past.depth, own_px, past.gap);
    // The light's shape, as much smaller as the samples leave out of it.
    let size = min(KERNEL * pow(whole_net(past.count), -0.75), 1.0);
    var sum = 0.0;
    var used = 0.0;
    var others = 0.0;
    for (var i = 0u; i < TAPS; i++) {
        var offset_px: vec2<f32>;
        if (screen_disk) {
            // Eq. 6: the penumbra's width, as it is seen at the fragment's depth.
            let reach = widening(past.gap, receiver.position);
            let width_px = light_size * reach * screen.focal / select(past.depth, 1.0, screen.orthographic == 1u);
            offset_px = 0.5 * width_px * POISSON[i];
        } else {
            offset_px = shift_px(shift, size * kernel_uv(sampler, i));
        }
        let pixel = pixel_at(own_px + offset_px);
        if (!is_on_screen(pixel)) {
            continue;
        }
        let tap = stored_brief(u32(pixel.y) * screen.size.x + u32(pixel.x));
        if (tap.count == 0.0) {
            continue;
        }
        // At a contact depths alone are no telling.
        let is_other = !screen_disk && tap.instance != past.instance;
        if (is_other || !is_on_plane(tap.depth, past.depth, slope, vec2<f32>(pixel) + 0.5 - own_px)) {
            continue;
        }
        sum += tap.shadowed / tap.count;
        used += 1.0;
        others += select(0.0, 1.0, any(pixel != vec2<i32>(floor(own_px))));
    }
    return Smoothed(select(sum / used, own, used == 0.0), max(others, 1.0));
}

@compute @workgroup_size(64)
fn show(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    let past = stored(receiver.number);
    if (past.count + past.seed_weight == 0.0) {
        // No point of the light that it could see has been tested yet.
        visibility[id.x] = 1.0;
        return;
    }
    var shown = Smoothed(past.shadowed / past.count, f32(TAPS));
    // Where no blocker is known there is no penumbra; a light without size has none.
    let has_penumbra = past.blockers > 0.0 && emitter.domain != 2u;
    if (filters && has_penumbra && screen.size.x > 0u && standard_error(past) > threshold) {
        shown = smoothed(receiver, past);
    }
    // The squared error of PCSS stays, that of n tests falls as n^-2 where edges run along the light's: inverse to these, PCSS weighs
    // 1/n beside n. It falls with the pixels that it is smoothed over too, though neighbours err alike: by their root. Beside one test
    // PCSS is all that is worth showing.
    let seed_weight = past.seed_weight * sqrt(f32(TAPS) / shown.pixels) / whole_net(past.count);
    let weighted = (shown.share * past.count + past.seed * seed_weight) / (past.count + seed_weight);
    let occluded = select(weighted, past.seed, past.count <= 1.0 && past.seed_weight > 0.0);
    visibility[id.x] = clamp(1.0 - occluded, 0.0, 1.0);
}
