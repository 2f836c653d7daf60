// A kernel of a map's texels around a receiver's place, each held against its tangent plane there: how many let the point of the
// light through, and how far what blocks is before the receiver.

#import "lib/shadow_map.wgsl"
#import "lib/emission.wgsl"
#import "lib/emitter.wgsl"

@group(0) @binding(15) var<uniform> emission: Emission;

/// Texels a side of the kernel.
override kernel: u32;
/// Whether emission is asked for.
override irradiance: bool;

/// What a map tells a receiver.
struct LookedUp {
    /// How many texels of the kernel around its place let the point through; none below its horizon.
    unblocked: u32,
    /// How far the blockers are before it, along the light's normal, added up; and how many there are.
    gaps: vec2<f32>,
}

fn looked_up(light_point: LightPoint, receiver: Receiver) -> LookedUp {
    let index = face_toward(light_point, receiver.position - light_point.position);
    let face = faces[index];
    let to = to_light(light_point, receiver.position, face.distant == 1u);
    if (dot(receiver.normal, to) <= 0.0) {
        return LookedUp(0u, vec2(0.0));
    }
    let seen = on_face(face, receiver.position, receiver.normal);
    let last = vec2<i32>(textureDimensions(shadow_depth)) - 1;
    let at = (seen.at * face.window.xy + face.window.zw) * vec2<f32>(textureDimensions(shadow_depth));
    // The kernel's middle is as near to the receiver's place as texels allow.
    let low = vec2<i32>(floor(at - 0.5 * f32(kernel) + 0.5));
    var found = LookedUp(0u, vec2(0.0));
    for (var y = 0; y < i32(kernel); y++) {
        for (var x = 0; x < i32(kernel); x++) {
            // Beyond the edge of a cube's face the kernel takes the face's last texels.
            let texel = clamp(low + vec2(x, y), vec2(0), last);
            let at = texel_center(face, texel);
            let stored = textureLoad(shadow_depth, texel, index, 0);
            if (stored > max(unblocked_depth(face, seen, at), 0.0)) {
                let gap = dot(emitter.normal, receiver.position - stored_position(face, at, stored));
                found.gaps += vec2(max(gap, 0.0), 1.0);
            } else {
                found.unblocked += 1u;
            }
        }
    }
    return found;
}

/// What light points on a light emit: weight, and weight times emission.
fn weighed(receiver: Receiver, normal: vec3<f32>, to: vec3<f32>, weight: f32) -> vec2<f32> {
    if (!irradiance) {
        return vec2(weight, 0.0);
    }
    return vec2(weight, weight * sample_weight(emission, normal, receiver.normal, receiver.shading_normal, to));
}
