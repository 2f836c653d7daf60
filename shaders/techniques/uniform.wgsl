// Uniform light sampling: a map from each of N points of the light, their answers averaged. Heckbert and Herf 1997, "Simulating
// Soft Shadows with Graphics Hardware", with shadow maps for their projected polygons.

#import "lib/shadow_map.wgsl"
#import "lib/counter.wgsl"
#import "lib/emission.wgsl"

/// Weights of the points seen and of all above the horizon, and those weights times what the points emit towards the receiver.
@group(0) @binding(4) var<storage, read_write> sums: array<vec4<f32>>;
@group(0) @binding(5) var<uniform> emission: Emission;

/// Whether emission is asked for.
override irradiance: bool;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= arrayLength(&receivers)) {
        return;
    }
    let receiver = receivers[id.x];
    var texels = 0u;
    var sum = sums[id.x];
    for (var i = 0u; i < arrayLength(&points); i++) {
        let light_point = points[i];
        let index = face_toward(light_point, receiver.position - light_point.position);
        let face = faces[index];
        let to = to_light(light_point, receiver.position, face.distant == 1u);
        if (dot(receiver.normal, to) <= 0.0) {
            continue;
        }
        var weights = vec2(light_point.weight, 0.0);
        if (irradiance) {
            weights.y = weights.x
                * sample_weight(emission, light_point.normal, receiver.normal, receiver.shading_normal, to);
        }
        let seen = on_face(face, receiver.position, receiver.normal);
        texels += 1u;
        let is_seen = !is_blocked(face, index, seen, texel_at(face, seen.at));
        sum += vec4(select(vec2(0.0), weights, is_seen), weights);
    }
    count(texels);
    sums[id.x] = sum;
}
