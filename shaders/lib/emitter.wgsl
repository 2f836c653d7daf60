// The surface that stands for the light.

@group(0) @binding(5) var<uniform> emitter: Emitter;

/// Twin of `Emitter` in `gpu/center_map.rs`.
struct Emitter {
    center: vec3<f32>,
    /// 0 rect, 1 disk, 2 point.
    domain: u32,
    half_u: vec3<f32>,
    /// 1: at infinity; positions on it are directions.
    distant: u32,
    half_v: vec3<f32>,
    /// The nearest caster, along `normal` from the origin: keeps its digits however far the light is.
    nearest: f32,
    normal: vec3<f32>,
    padding: u32,
}

/// How much larger than the light the penumbra is of what is `gap` before a position: (r − b)/b; of a distant light its length a
/// tangent.
fn widening(gap: f32, position: vec3<f32>) -> f32 {
    let depth = dot(emitter.normal, position - emitter.center);
    return select(gap / max(depth - gap, 0x1p-20 * depth), gap, emitter.distant == 1u);
}
