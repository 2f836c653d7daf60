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

/// Pixels to where the shadow of a blocker that is `gap` before a receiver goes as a point of the light goes to `uv` from the
/// light's centre: on the receiver's plane, along the light.
fn shadow_shift_px(position: vec3<f32>, normal: vec3<f32>, depth: f32, at_px: vec2<f32>, gap: f32, uv: vec2<f32>) -> vec2<f32> {
    let to = select(emitter.center - position, emitter.center, emitter.distant == 1u);
    let across = widening(gap, position) * (uv.x * emitter.half_u + uv.y * emitter.half_v);
    let cosine = max(dot(normal, to), LEAST_COSINE * length(to));
    let shift = across - to * (dot(normal, across) / cosine);
    let ahead = select(dot(screen.forward, shift), 0.0, screen.orthographic == 1u);
    let moved = screen.focal * vec2(dot(screen.right, shift), -dot(screen.up, shift)) - (at_px - screen.center_px) * ahead;
    return moved / (select(depth, 1.0, screen.orthographic == 1u) + ahead);
}

/// The pixel at a place of the screen, or none.
fn pixel_at(at_px: vec2<f32>) -> vec2<i32> {
    return vec2<i32>(floor(clamp(at_px, vec2(-1.0), vec2<f32>(screen.size) + 1.0)));
}

fn is_on_screen(pixel: vec2<i32>) -> bool {
    return all(pixel >= vec2(0)) && all(pixel < vec2<i32>(screen.size));
}
