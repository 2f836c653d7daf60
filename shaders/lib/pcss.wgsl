// Percentage-closer soft shadows: the mean depth of the blockers around a receiver gives the width of its penumbra, and that the
// kernel of a percentage-closer filter. Fernando 2005, "Percentage-Closer Soft Shadows".
//
// The kernels are the light's own shape, projected from the receiver onto a plane parallel to it: x = p + t (q - p) for the points
// q of the light, with the planar depths z from the light's plane in t = (z_receiver - z_plane) / z_receiver. In the map this is the
// w_light (z_r - z_b) / z_b of the paper for any place and any map, the faces of a cube included, and for a map of any point of the
// light: it shows a planar blocker in the kernel as the light's centre would.

#import "lib/emitter.wgsl"
#import "lib/shadow_map.wgsl"
#import "lib/counter.wgsl"
#import "lib/sampling.wgsl"

/// 1: every texel of the kernels, as far as MOST_TEXELS go, instead of so many taps.
override dense: bool;
override search_taps: u32;
override filter_taps: u32;
override pattern: u32;
override search_columns: u32;
override filter_columns: u32;

/// A side of a dense kernel, at most.
const MOST_TEXELS: f32 = 64.0;

/// Where the search begins, as a fraction of the way from the light to the receiver.
override near: f32;

/// What a tap finds.
struct Tap {
    blocked: bool,
    /// How far the blocker is before the receiver: along the light's normal, or the direction of a distant one.
    gap: f32,
}

/// How far a kernel's plane lies before the receiver: a fraction of the way to the light's plane, or a distance.
fn kernel_point(position: vec3<f32>, uv: vec2<f32>, reach: f32) -> vec3<f32> {
    let on_light = emitter.center + uv.x * emitter.half_u + uv.y * emitter.half_v;
    return position + reach * select(on_light - position, on_light, emitter.distant == 1u);
}

fn tap(light_point: LightPoint, receiver: Receiver, uv: vec2<f32>, reach: f32) -> Tap {
    let place = kernel_point(receiver.position, uv, reach);
    let index = face_toward(light_point, place - light_point.position);
    let face = faces[index];
    let to = to_light(light_point, receiver.position, face.distant == 1u);
    let seen = on_face(face, receiver.position, plane_normal(receiver.normal, to));
    let texel = texel_at(face, seen_at(in_view(face, place)));
    let at = texel_center(face, texel);
    let stored = textureLoad(shadow_depth, texel, index, 0);
    var found: Tap;
    found.gap = gap_of(face, at, stored, receiver.position);
    // A plane seen at a grazing angle is far beyond the receiver elsewhere in the kernel: what lies between blocks nothing either.
    let own = own_depth(face, seen.view, MOST_SHIFT_TEXELS * face.texel * seen.view.z);
    found.blocked = stored > max(unblocked_depth(face, seen, at), max(own, 0.0));
    return found;
}

/// How far what a map holds at a place of its view is before a position, along the light's normal.
fn gap_of(face: Face, at: vec2<f32>, stored: f32, position: vec3<f32>) -> f32 {
    return dot(emitter.normal, position - stored_position(face, at, stored));
}

/// Texels along a side of the kernel.
fn side(light_point: LightPoint, position: vec3<f32>, half_axis: vec3<f32>, reach: f32) -> f32 {
    let place = kernel_point(position, vec2(0.0), reach);
    let face = faces[face_toward(light_point, place - light_point.position)];
    let texel = face.texel * in_view(face, place).z;
    return clamp(ceil(2.0 * reach * length(half_axis) / texel), 1.0, MOST_TEXELS);
}

/// Sums over a kernel.
struct Sums {
    taps: f32,
    /// Of all taps, and their gaps.
    blockers: f32,
    gaps: f32,
    /// Taps at points of the light above the receiver's horizon, and those of them that are blocked.
    above: f32,
    hidden: f32,
}

/// Adds what a place of a kernel finds.
fn add_tap(sums: ptr<function, Sums>, light_point: LightPoint, receiver: Receiver, uv: vec2<f32>, reach: f32) {
    let found = tap(light_point, receiver, uv, reach);
    let on_light = emitter.center + uv.x * emitter.half_u + uv.y * emitter.half_v;
    let to = select(on_light - receiver.position, on_light, emitter.distant == 1u);
    let blocked = select(0.0, 1.0, found.blocked);
    let above = select(0.0, 1.0, dot(receiver.normal, to) > 0.0);
    (*sums).taps += 1.0;
    (*sums).blockers += blocked;
    (*sums).gaps += blocked * found.gap;
    (*sums).above += above;
    (*sums).hidden += above * blocked;
}

fn kernel(light_point: LightPoint, receiver: Receiver, reach: f32, taps: u32, columns: u32, seed: u32) -> Sums {
    var sums = Sums();
    if (dense) {
        let columns = side(light_point, receiver.position, emitter.half_u, reach);
        let rows = side(light_point, receiver.position, emitter.half_v, reach);
        for (var y = 0.5; y < rows; y += 1.0) {
            for (var x = 0.5; x < columns; x += 1.0) {
                let uv = 2.0 * vec2(x / columns, y / rows) - 1.0;
                if (emitter.domain == 1u && dot(uv, uv) > 1.0) {
                    continue;
                }
                add_tap(&sums, light_point, receiver, uv, reach);
            }
        }
        return sums;
    }
    let sampler = sampler_of(pattern, vec2(columns, max(taps / columns, 1u)), receiver.number, seed);
    for (var i = 0u; i < taps; i++) {
        let square = unit_square(sampler, i);
        let uv = select(2.0 * square - 1.0, disk_from_square(square), emitter.domain == 1u);
        add_tap(&sums, light_point, receiver, uv, reach);
    }
    return sums;
}

/// What a receiver sees of the light.
struct Penumbra {
    visibility: f32,
    /// What is hidden of the part of the light that is above its horizon.
    occlusion: f32,
    /// Mean of the blockers' gaps; 0 without any.
    gap: f32,
    /// Blockers found by the search.
    blockers: f32,
    /// Texels read.
    texels: u32,
}

fn percentage_closer(light_point: LightPoint, receiver: Receiver) -> Penumbra {
    return percentage_closer_from(light_point, receiver, -1.0);
}

/// Where the blockers' mean gap is known already, if it is not below 0: they are not searched for then, and half of the taps do beside
/// what else is known.
fn percentage_closer_from(light_point: LightPoint, receiver: Receiver, known_gap: f32) -> Penumbra {
    let distant = emitter.distant == 1u;
    // How far the receiver is from the light's plane, and beyond the nearest caster.
    let depth = dot(emitter.normal, receiver.position - emitter.center);
    let beyond = max(dot(emitter.normal, receiver.position) - emitter.nearest, 0.0);
    let search = select(select(1.0 - near, min(beyond / depth, 1.0 - near), depth > 0.0), (1.0 - near) * beyond, distant);
    let taps = select(search_taps, 0u, known_gap >= 0.0);
    let blockers = kernel(light_point, receiver, search, taps, search_columns, 0u);
    if (known_gap < 0.0 && blockers.blockers == 0.0) {
        return Penumbra(1.0, 0.0, 0.0, 0.0, u32(blockers.taps));
    }
    let gap = select(max(blockers.gaps / blockers.blockers, 0.0), known_gap, known_gap >= 0.0);
    let reach = select(min(gap / depth, 1.0 - near), gap, distant);
    let kept = select(filter_taps, (filter_taps + 1u) / 2u, known_gap >= 0.0);
    let filtered = kernel(light_point, receiver, reach, kept, filter_columns, 1u);
    // What is below the horizon is blocked, by nothing that has a depth.
    let unseen = filtered.taps - filtered.above + filtered.hidden;
    return Penumbra(
        1.0 - unseen / filtered.taps,
        select(filtered.hidden / filtered.above, 0.0, filtered.above == 0.0),
        gap,
        blockers.blockers,
        u32(blockers.taps + filtered.taps),
    );
}
