enable primitive_index;

// Which triangle each pixel sees: the number of the instance and of the triangle, each plus one. Positions and normals follow
// from these and the pixel's ray, in double precision, on the processor.

#import "lib/instance.wgsl"
#import "lib/cutout.wgsl"

struct View {
    clip_from_scene: mat4x4<f32>,
}

@group(0) @binding(0) var<uniform> view: View;

/// Whether surfaces have holes.
override cut_out: bool;

struct Varying {
    @builtin(position) position_clip: vec4<f32>,
    @location(0) @interpolate(flat) instance: u32,
    @location(1) uv: vec2<f32>,
}

@vertex
fn vertex(@location(0) position_mesh: vec3<f32>, @location(5) uv: vec2<f32>, instance: InstanceInput) -> Varying {
    var out: Varying;
    out.position_clip = view.clip_from_scene * vec4(to_scene(instance, position_mesh), 1.0);
    out.instance = instance.number;
    out.uv = uv;
    return out;
}

@fragment
fn fragment(in: Varying, @builtin(primitive_index) triangle: u32) -> @location(0) vec2<u32> {
    if (cut_out && is_hole(in.uv)) {
        discard;
    }
    return vec2(in.instance + 1u, triangle + 1u);
}
