// Receivers as neighbours on the screen: where a step along a receiver's surface leads, and what lies on the same surface there.

#import "lib/emitter.wgsl"

/// The camera. Twin of `Screen` in `gpu/screen.rs`.
struct Screen {
    /// Its axes, scene space.
    right: vec3<f32>,
    /// Pixels a unit at depth 1, or at any depth of an orthographic camera.
    focal: f32,
    up: vec3<f32>,
    orthographic: u32,
    forward: vec3<f32>,
    /// Depth of the origin.
    depth: f32,
    /// Pixel on the axis.
    center_px: vec2<f32>,
    /// Pixels, the border's included.
    size: vec2<u32>,
    /// How far depths of one surface may differ: times the depth, and at any depth.
    tolerance: vec2<f32>,
    padding: vec2<u32>,
}

@group(0) @binding(11) var<uniform> screen: Screen;

/// How grazing a surface may be before kernels on it grow no longer: its cosine to the light.
const LEAST_COSINE: f32 = 0.25;

fn depth_of(position: vec3<f32>) -> f32 {
    return dot(screen.forward, position) + screen.depth;
}

/// The middle of a pixel.
fn middle_px(number: u32) -> vec2<f32> {
    return vec2(f32(number % screen.size.x), f32(number / screen.size.x)) + 0.5;
}

/// The plane through a receiver at a pixel: how the inverse of its depth (its depth, orthographic) changes a pixel, relative to it.
fn slope_of(normal: vec3<f32>, at_px: vec2<f32>) -> vec2<f32> {
    let is_orthographic = screen.orthographic == 1u;
    let from_center = (at_px - screen.center_px) / screen.focal;
    let ray = screen.forward + select(from_center.x * screen.right - from_center.y * screen.up, vec3(0.0), is_orthographic);
    let slope = vec2(dot(normal, screen.right), -dot(normal, screen.up)) / (screen.focal * dot(normal, ray));
    return select(slope, -slope, is_orthographic);
}

/// Whether a depth is that of the plane through a receiver, so many pixels away.
fn is_on_plane(depth: f32, own_depth: f32, slope: vec2<f32>, away_px: vec2<f32>) -> bool {
    let along = dot(slope, away_px);
    let expected = select(own_depth / (1.0 + along), own_depth + along, screen.orthographic == 1u);
    return abs(depth - expected) <= screen.tolerance.x * expected + screen.tolerance.y;
}

/// Where the shadow of a blocker that is `gap` before a receiver goes on the receiver's plane as a point of the light goes from the
/// light's centre along its half axes: pixels times depth, and depth.
struct ShadowShift {
    along_u: vec3<f32>,
    along_v: vec3<f32>,
    /// Of the receiver; 1 where pixels do not depend on it.
    depth: f32,
}

fn shadow_shift(position: vec3<f32>, normal: vec3<f32>, depth: f32, at_px: vec2<f32>, gap: f32) -> ShadowShift {
    let to = select(emitter.center - position, emitter.center, emitter.distant == 1u);
    let wide = widening(gap, position);
    let tilt = normal / max(dot(normal, to), LEAST_COSINE * length(to));
    let u = wide * emitter.half_u;
    let v = wide * emitter.half_v;
    let is_orthographic = screen.orthographic == 1u;
    let from_center_px = select(at_px - screen.center_px, vec2(0.0), is_orthographic);
    return ShadowShift(
        moved_on_screen(u - to * dot(tilt, u), from_center_px, is_orthographic),
        moved_on_screen(v - to * dot(tilt, v), from_center_px, is_orthographic),
        select(depth, 1.0, is_orthographic),
    );
}

fn moved_on_screen(shift: vec3<f32>, from_center_px: vec2<f32>, is_orthographic: bool) -> vec3<f32> {
    let ahead = select(dot(screen.forward, shift), 0.0, is_orthographic);
    return vec3(screen.focal * vec2(dot(screen.right, shift), -dot(screen.up, shift)) - from_center_px * ahead, ahead);
}

/// Pixels to where the shadow goes as the point goes to `uv`.
fn shift_px(shift: ShadowShift, uv: vec2<f32>) -> vec2<f32> {
    let moved = uv.x * shift.along_u + uv.y * shift.along_v;
    return moved.xy / (shift.depth + moved.z);
}

/// The pixel at a place of the screen, or none.
fn pixel_at(at_px: vec2<f32>) -> vec2<i32> {
    return vec2<i32>(floor(clamp(at_px, vec2(-1.0), vec2<f32>(screen.size) + 1.0)));
}

fn is_on_screen(pixel: vec2<i32>) -> bool {
    return all(pixel >= vec2(0)) && all(pixel < vec2<i32>(screen.size));
}
