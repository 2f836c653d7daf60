//! The camera as shaders read it, for techniques that look at a receiver's neighbours on the screen.

use glam::{DVec2, Vec2, Vec3};
use rayon::prelude::*;

use super::light_view::LightView;
use crate::history::Shot;
use crate::receivers::Receiver;
use crate::scene::{Camera, Projection};
use crate::techniques::Frame;
use crate::{Result, gpu_struct};

/// How far depths of one surface may differ, as a fraction of the view's height there.
pub const SAME_SURFACE: f64 = 0.005;

gpu_struct! {
    /// Twin of `Screen` in `lib/screen.wgsl`.
    pub struct Screen {
        /// Axis, scene space.
        pub right: Vec3,
        /// See [`focal`].
        pub focal: f32,
        /// Axis, scene space.
        pub up: Vec3,
        /// Whether rays are parallel.
        pub orthographic: u32,
        /// Axis, scene space.
        pub forward: Vec3,
        /// Of the GPU's origin.
        pub depth: f32,
        /// See [`center_px`].
        pub center_px: Vec2,
        /// Pixels, the border's included.
        pub size: [u32; 2],
        /// See [`tolerance`].
        pub tolerance: Vec2,
        /// None.
        pub padding: [u32; 2],
    }
}

impl Screen {
    /// The camera of a shot, whose receivers are an image of `size`; `epsilon` as of [`tolerance`].
    pub fn new(shot: &Shot, size: [u32; 2], view: &LightView, epsilon: f64) -> Self {
        let camera = shot.camera;
        let axes = &camera.scene_from_camera.matrix3;
        let forward = -axes.z_axis;
        Self {
            right: axes.x_axis.as_vec3(),
            focal: focal(camera, shot.size, view.space.unit) as f32,
            up: axes.y_axis.as_vec3(),
            orthographic: u32::from(is_orthographic(camera)),
            forward: forward.as_vec3(),
            depth: (forward.dot(view.space.origin - camera.scene_from_camera.translation) / view.space.unit) as f32,
            center_px: center_px(shot).as_vec2(),
            size,
            tolerance: tolerance(camera, epsilon, view.space.unit),
            padding: [0; 2],
        }
    }

    /// What receivers that see the light whole show to their neighbours, by pixel: V, E/E₀, depth and one more than the instance,
    /// as in `lib/smooth.wgsl`; zeros elsewhere, for what is worked on to be shown.
    ///
    /// # Errors
    /// [`crate::Error::Gpu`] where they don't fit.
    pub fn show_lit(&self, frame: &Frame, view: &LightView) -> Result<wgpu::Buffer> {
        let storage = wgpu::BufferUsages::STORAGE;
        let label = "what neighbours see";
        if view.lit.is_empty() {
            return view.gpu.empty_buffer(label, 16 * frame.receivers.pixels.len() as u64, storage);
        }
        let show = |(receiver, &is_facing): (&Option<Receiver>, &bool)| {
            receiver.as_ref().filter(|_| is_facing).map_or([0.0; 4], |receiver| {
                let position = ((receiver.position - view.space.origin) / view.space.unit).as_vec3();
                [1.0, 1.0, self.forward.dot(position) + self.depth, f32::from_bits(receiver.instance + 1)]
            })
        };
        let mut shown: Vec<[f32; 4]> =
            frame.receivers.pixels.par_iter().zip(&view.facing).with_min_len(1024).map(show).collect();
        for &pixel in view.chunks.iter().flat_map(|chunk| &chunk.pixels) {
            shown[pixel as usize] = [0.0; 4];
        }
        view.gpu.buffer(label, &shown, storage)
    }
}

/// Whether a camera's rays are parallel.
pub fn is_orthographic(camera: &Camera) -> bool {
    matches!(camera.projection, Projection::Orthographic { .. })
}

/// Pixels a metre at a depth of a metre; of an orthographic camera pixels a unit, at any depth.
pub fn focal(camera: &Camera, size: [u32; 2], unit: f64) -> f64 {
    let half_height = 0.5 * f64::from(size[1]);
    match camera.projection {
        Projection::Perspective { fov_y } => half_height / (0.5 * fov_y).tan(),
        Projection::Orthographic { half_height: metres } => half_height / (metres / unit),
    }
}

/// Where the camera's axis meets an image with its border, as if its receivers lay in the middles of pixels.
pub fn center_px(shot: &Shot) -> DVec2 {
    let axis = DVec2::from([0, 1].map(|i| 0.5 * f64::from(shot.size[i]) + f64::from(shot.border[i])));
    axis + 0.5 - shot.offset_px
}

/// How far depths of one surface may differ, times the depth and at any depth, in units: `epsilon` of the view's height there.
pub fn tolerance(camera: &Camera, epsilon: f64, unit: f64) -> Vec2 {
    match camera.projection {
        Projection::Perspective { fov_y } => Vec2::new((epsilon * 2.0 * (0.5 * fov_y).tan()) as f32, 0.0),
        Projection::Orthographic { half_height } => Vec2::new(0.0, (epsilon * 2.0 * half_height / unit) as f32),
    }
}
