// One shadow map: how what it sees falls onto it.

/// One map. Twin of `Face` in `gpu/shadow_map.rs`.
struct Face {
    /// Axes of the view, unit; w: what is added to a position's component along them. `forward` leads away from the light.
    right: vec4<f32>,
    up: vec4<f32>,
    forward: vec4<f32>,
    /// From the view (x/z, y/z; x, y of a distant light) to texture coordinates: scale, then offset.
    window: vec4<f32>,
    /// Farthest receiver, along `forward` from the origin.
    far: f32,
    /// Depth is depth_scale (far - along) / z, 1 at the nearest caster, 0 at `far`; z is 1 of a distant light.
    depth_scale: f32,
    /// Larger side of a texel in the view.
    texel: f32,
    /// 1: the light is at infinity.
    distant: u32,
}

/// A position in a face's view.
struct InView {
    /// Across, from the light point.
    across: vec2<f32>,
    /// Along `forward`, from the origin: keeps its digits however far the light is.
    along: f32,
    /// Along `forward`, from the light point; 1 of a distant light.
    z: f32,
}

/// A direction's components in a face's view.
fn turned(face: Face, direction: vec3<f32>) -> vec3<f32> {
    return vec3(dot(face.right.xyz, direction), dot(face.up.xyz, direction), dot(face.forward.xyz, direction));
}

fn in_view(face: Face, position: vec3<f32>) -> InView {
    let view = turned(face, position);
    let z = select(view.z + face.forward.w, 1.0, face.distant == 1u);
    return InView(view.xy + vec2(face.right.w, face.up.w), view.z, z);
}
