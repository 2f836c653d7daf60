// Percentage-closer filtering. Reeves, Salesin and Cook 1987, "Rendering Antialiased Shadows with Depth Maps": the unblocked share
// of the kernel of texels around the receiver's own, each held against the receiver's tangent plane there.

#import "lib/kernel.wgsl"
#import "lib/counter.wgsl"

@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    let light_point = points[0];
    let index = face_toward(light_point, receiver.position - light_point.position);
    let face = faces[index];
    let to = to_light(light_point, receiver.position, face.distant == 1u);
    let seen = on_face(face, receiver.position, plane_normal(receiver.normal, to));
    let texels = kernel_texels(face, seen.at);
    var unblocked = 0u;
    for (var y = texels.first.y; y <= texels.last.y; y++) {
        for (var x = texels.first.x; x <= texels.last.x; x++) {
            let texel = clamp(vec2(x, y), vec2(0), map_last());
            unblocked += select(1u, 0u, is_blocked(face, index, seen, texel));
        }
    }
    count(kernel * kernel);
    visibility[id.x] = f32(unblocked) / f32(kernel * kernel);
}
