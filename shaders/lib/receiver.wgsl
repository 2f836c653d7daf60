// Where visibility is asked for. Lengths are in the unit of `LightView`, positions relative to its origin.

/// A receiver. Twin of `Receiver` in `gpu/light_view.rs`.
struct Receiver {
    position: vec3<f32>,
    /// Of its pixel.
    number: u32,
    /// Geometric, unit, on the camera's side.
    normal: vec3<f32>,
    /// What it lies on.
    instance: u32,
    shading_normal: vec3<f32>,
    padding_2: u32,
}

@group(0) @binding(2) var<storage, read> receivers: array<Receiver>;
