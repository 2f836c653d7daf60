// Hard shadows. Williams 1978, "Casting Curved Shadows on Curved Surfaces": one map, seen from the light's centre, one texel of it.

#import "lib/shadow_map.wgsl"
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
    let is_above = dot(receiver.normal, to_light(light_point, receiver.position, face.distant == 1u)) > 0.0;
    let seen = on_face(face, receiver.position, receiver.normal);
    let is_seen = is_above && !is_blocked(face, index, seen, texel_at(face, seen.at));
    count(1u);
    visibility[id.x] = select(0.0, 1.0, is_seen);
}
