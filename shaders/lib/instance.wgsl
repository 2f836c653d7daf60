// One use of a mesh, as a vertex sees it.

/// Rows of scene_from_mesh, and the instance's number in the scene.
struct InstanceInput {
    @location(1) row_x: vec4<f32>,
    @location(2) row_y: vec4<f32>,
    @location(3) row_z: vec4<f32>,
    @location(4) number: u32,
}

/// Scene space, metres, relative to what the rows are relative to.
fn to_scene(instance: InstanceInput, position_mesh: vec3<f32>) -> vec3<f32> {
    let p = vec4(position_mesh, 1.0);
    return vec3(dot(instance.row_x, p), dot(instance.row_y, p), dot(instance.row_z, p));
}
