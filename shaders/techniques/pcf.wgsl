// Percentage-closer filtering. Reeves, Salesin and Cook 1987, "Rendering Antialiased Shadows with Depth Maps": the unblocked share
// of the kernel of texels around the receiver's own, each held against the receiver's tangent plane there.

#import "lib/shadow_map.wgsl"
#import "lib/counter.wgsl"

@group(0) @binding(4) var<storage, read_write> visibility: array<f32>;

/// Texels a side of the kernel; odd.
override kernel: u32;

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
    let middle = texel_at(face, seen.at);
    let radius = i32(kernel / 2u);
    // Beyond the edge of a cube's face the kernel takes the face's last texels.
    let last = vec2<i32>(textureDimensions(shadow_depth)) - 1;
    var unblocked = 0u;
    for (var y = -radius; y <= radius; y++) {
        for (var x = -radius; x <= radius; x++) {
            let texel = clamp(middle + vec2(x, y), vec2(0), last);
            unblocked += select(1u, 0u, is_blocked(face, index, seen, texel));
        }
    }
    count(kernel * kernel);
    visibility[id.x] = f32(unblocked) / f32(kernel * kernel);
}
