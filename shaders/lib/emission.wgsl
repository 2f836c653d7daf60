// How much of a light point's emission reaches a receiver. Twin of `irradiance::sample_weight`.

/// How a light emits, the same for all receivers.
struct Emission {
    /// Unit axis −Z of the light, scene space.
    axis: vec3<f32>,
    /// 0 an area, a sun's disc at distance 1 included; 1 a point; 2 a point at infinity.
    kind: u32,
    /// 1 − cos of the cone's inner and outer angle; 3 and 4 without a cone.
    versine_inner: f32,
    versine_outer: f32,
    /// tan h and tan h − h for h = spread/2; −1 twice without spread.
    spread_tan: f32,
    spread_norm: f32,
}

/// The weight w ≥ 0 of the light point at `to_light` (from the receiver, in any unit in which its length is within 2^±60): per
/// radiance and area, 1/unit². `emitter_normal` is the unit normal on the emitting side as the receiver sees it.
///
/// Without spread and cone it is off by at most 48 · 2^-24/r²: products of three terms (3 · 2^-24 each), a root (9), four
/// quotients (5 each, WGSL's 2.5 ulp), for two cosines of at most 1.
fn sample_weight(
    emission: Emission,
    emitter_normal: vec3<f32>,
    normal: vec3<f32>,
    shading_normal: vec3<f32>,
    to_light: vec3<f32>,
) -> f32 {
    let height = dot(shading_normal, to_light);
    if (dot(normal, to_light) <= 0.0 || height <= 0.0) {
        return 0.0;
    }
    let squared = dot(to_light, to_light);
    let distance = sqrt(squared);
    if (emission.kind != 0u) {
        let falloff = select(squared, 1.0, emission.kind == 2u);
        return cone_factor(emission, to_light / distance) * (height / distance) / falloff;
    }
    let depth = -dot(emitter_normal, to_light);
    if (depth <= 0.0) {
        return 0.0;
    }
    let factor = cone_factor(emission, to_light / distance) * spread_factor(emission, emitter_normal, to_light, depth);
    return factor * (height / distance) * (depth / distance) / squared;
}

/// Emission relative to the axis (KHR_lights_punctual) for light that arrives from `direction`, a unit vector. The difference of
/// unit vectors keeps the precision that cosines of small angles lose.
fn cone_factor(emission: Emission, direction: vec3<f32>) -> f32 {
    let across = direction + emission.axis;
    let versine = 0.5 * dot(across, across);
    if (versine <= emission.versine_inner) {
        return 1.0;
    }
    if (versine >= emission.versine_outer) {
        return 0.0;
    }
    let linear = (emission.versine_outer - versine) / (emission.versine_outer - emission.versine_inner);
    return linear * linear;
}

/// (tan h − tan θ)/(tan h − h), which keeps the total power (Cycles' rule); nothing within a spread of nothing.
fn spread_factor(emission: Emission, emitter_normal: vec3<f32>, to_light: vec3<f32>, depth: f32) -> f32 {
    if (emission.spread_norm < 0.0) {
        return 1.0;
    }
    if (emission.spread_norm == 0.0) {
        return 0.0;
    }
    let tan_theta = length(to_light + depth * emitter_normal) / depth;
    return max(emission.spread_tan - tan_theta, 0.0) / emission.spread_norm;
}
