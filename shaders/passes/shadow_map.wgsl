// Depth from a point of the light.

#import "lib/instance.wgsl"
#import "lib/cutout.wgsl"
#import "lib/face.wgsl"

@group(0) @binding(0) var<uniform> face: Face;

/// Whether surfaces have holes.
override cut_out: bool;

struct Varying {
    @builtin(position) position_clip: vec4<f32>,
    @location(0) uv: vec2<f32>,
}

@vertex
fn vertex(@location(0) position_mesh: vec3<f32>, @location(5) uv: vec2<f32>, instance: InstanceInput) -> Varying {
    let view = in_view(face, to_scene(instance, position_mesh));
    let at = view.across * face.window.xy + view.z * face.window.zw;
    var out: Varying;
    // Texture coordinates run down the image, clip space runs up.
    out.position_clip = vec4(2.0 * at.x - view.z, view.z - 2.0 * at.y, face.depth_scale * (face.far - view.along), view.z);
    out.uv = uv;
    return out;
}

@fragment
fn fragment(in: Varying) {
    if (cut_out && is_hole(in.uv)) {
        discard;
    }
}
