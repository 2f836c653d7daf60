// Shadow maps: depth as seen from points of the light, and how receivers are held against it. Lengths are in the unit of
// `LightView`, positions relative to its origin.

#import "lib/face.wgsl"
#import "lib/receiver.wgsl"

/// A point of the light (the direction to it of a distant one). Twin of `LightPoint` in `gpu/shadow_map.rs`.
struct LightPoint {
    position: vec3<f32>,
    weight: f32,
    /// Unit, on the emitting side.
    normal: vec3<f32>,
    /// Of its maps.
    first_face: u32,
    /// Which faces of a cube have maps: x, y, z, negative before positive; 0: one map that holds every receiver.
    cube_faces: u32,
    padding: u32,
    padding_2: vec2<u32>,
}

@group(0) @binding(0) var<storage, read> faces: array<Face>;
@group(0) @binding(1) var<storage, read> points: array<LightPoint>;
@group(0) @binding(3) var shadow_depth: texture_depth_2d_array;

/// How far a surface may rise above a receiver's tangent plane before it blocks, in texels: see `gpu/shadow_map.rs`.
override bias_texels: f32;

/// How far that is along the light at most, in texels: the diameter of the circle whose relief it is.
const MOST_SHIFT_TEXELS: f32 = 2.0;

/// Rasterisers move vertices to 1/256 of a texel.
const SNAP_TEXELS: f32 = 0x1p-8;

/// Rounding of f32 positions, relative to their magnitude: a handful of roundings of 2^-24.
const POSITION_ROUNDING: f32 = 0x1p-21;

/// To a light point.
fn to_light(light_point: LightPoint, position: vec3<f32>, distant: bool) -> vec3<f32> {
    return select(light_point.position - position, light_point.position, distant);
}

/// Where a face sees a position of its view.
fn seen_at(view: InView) -> vec2<f32> {
    return view.across / view.z;
}

/// The map of a light point that sees what lies in a direction from it; any direction, where there is but one.
fn face_toward(light_point: LightPoint, direction: vec3<f32>) -> u32 {
    if (light_point.cube_faces == 0u) {
        return light_point.first_face;
    }
    let size = abs(direction);
    let axis = select(select(2u, 1u, size.y >= size.z), 0u, size.x >= max(size.y, size.z));
    let face = 2u * axis + select(0u, 1u, direction[axis] >= 0.0);
    return light_point.first_face + countOneBits(light_point.cube_faces & ((1u << face) - 1u));
}

/// Texel of a face that holds a place of its view, within the map.
fn texel_at(face: Face, at: vec2<f32>) -> vec2<i32> {
    let size = vec2<f32>(textureDimensions(shadow_depth));
    return vec2<i32>(clamp(floor((at * face.window.xy + face.window.zw) * size), vec2(0.0), size - 1.0));
}

/// Texels of a map, from the first to the last of each axis.
struct Texels {
    first: vec2<i32>,
    last: vec2<i32>,
}

/// The last texel of a map.
fn map_last() -> vec2<i32> {
    return vec2<i32>(textureDimensions(shadow_depth)) - 1;
}

/// Where a face's view sees a texel's centre.
fn texel_center(face: Face, texel: vec2<i32>) -> vec2<f32> {
    let size = vec2<f32>(textureDimensions(shadow_depth));
    return ((vec2<f32>(texel) + 0.5) / size - face.window.zw) / face.window.xy;
}

/// A receiver as a face sees it.
struct OnFace {
    view: InView,
    at: vec2<f32>,
    normal: vec3<f32>,
    /// How far its tangent plane is moved towards the light.
    rise: f32,
}

fn on_face(face: Face, position: vec3<f32>, normal: vec3<f32>) -> OnFace {
    let view = in_view(face, position);
    let facing = turned(face, normal);
    let cosine = -select(dot(facing, normalize(vec3(view.across, view.z))), facing.z, face.distant == 1u);
    let texels = clamp(MOST_SHIFT_TEXELS * cosine, 0.0, bias_texels) + SNAP_TEXELS;
    let rise = texels * face.texel * view.z + POSITION_ROUNDING * length(position);
    return OnFace(view, seen_at(view), facing, rise);
}

/// Normal of the plane that kernels hold a receiver against: its own, or, where that hides the light point, straight towards the
/// light, for then nothing tells its surroundings from what blocks.
fn plane_normal(normal: vec3<f32>, to: vec3<f32>) -> vec3<f32> {
    return select(normalize(to), normal, dot(normal, to) > 0.0);
}

/// Whether a receiver's tangent plane, moved towards the light, passes the light point: then nothing blocks.
fn passes_light(face: Face, seen: OnFace) -> bool {
    let offset = dot(seen.normal, vec3(seen.view.across, seen.view.z));
    return select(offset + seen.rise, seen.normal.z, face.distant == 1u) >= 0.0;
}

/// Depth in the map up to which nothing at a place of the view blocks a receiver: that of its tangent plane there, moved
/// towards the light. Where the plane so moved passes the light point, nothing does.
fn unblocked_depth(face: Face, seen: OnFace, at: vec2<f32>) -> f32 {
    let delta = dot(seen.normal.xy, at - seen.at);
    if (face.distant == 1u) {
        // n . (x, y, along) is constant on the plane; n.z < 0 where it faces the light.
        let along = seen.view.along + (seen.rise - delta) / seen.normal.z;
        return select(face.depth_scale * (face.far - along), 1.0e30, passes_light(face, seen));
    }
    // z n . (x/z, y/z, 1) is constant on the plane: `offset`, negative where it faces the light. All relative to the receiver,
    // so that no digits are lost far from the light.
    let offset = dot(seen.normal, vec3(seen.view.across, seen.view.z));
    let tilt = seen.view.z * delta / offset;
    let z = seen.view.z / (1.0 + tilt);
    let behind = z * (seen.rise / offset - tilt);
    let depth = face.depth_scale * (face.far - seen.view.along - behind) / (seen.view.z + behind);
    // A plane that this ray of the map misses is beyond all that the map sees.
    return select(select(depth, 0.0, tilt <= -1.0), 1.0e30, passes_light(face, seen));
}

/// Depth in the map of what is so far behind a receiver, which the face may not see: then beyond all.
fn own_depth(face: Face, view: InView, behind: f32) -> f32 {
    if (face.distant == 1u) {
        return face.depth_scale * (face.far - view.along - behind);
    }
    return select(0.0, face.depth_scale * (face.far - view.along - behind) / (view.z + behind), view.z > 0.0);
}

/// Whether the map holds something between the light point and a receiver at a texel.
fn is_blocked(face: Face, layer: u32, seen: OnFace, texel: vec2<i32>) -> bool {
    let stored = textureLoad(shadow_depth, texel, layer, 0);
    return stored > max(unblocked_depth(face, seen, texel_center(face, texel)), 0.0);
}

/// Where what a map holds at a place of its view is.
fn stored_position(face: Face, at: vec2<f32>, stored: f32) -> vec3<f32> {
    // depth = depth_scale (far - along) / (along + forward.w), solved for along.
    let along = select(
        (face.depth_scale * face.far - stored * face.forward.w) / (face.depth_scale + stored),
        face.far - stored / face.depth_scale,
        face.distant == 1u,
    );
    let z = select(along + face.forward.w, 1.0, face.distant == 1u);
    let across = at * z - vec2(face.right.w, face.up.w);
    return across.x * face.right.xyz + across.y * face.up.xyz + along * face.forward.xyz;
}
