//! Receivers: the points at which visibility is asked for, one a pixel.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use crate::Result;
use crate::geometry::bvh::{Hit, SceneBvh, Scratch};
use crate::progress::Progress;
use crate::scene::camera::CameraRay;
use crate::scene::{Bounds, Camera};

/// No instance or triangle: a receiver read from an image.
pub const UNKNOWN: u32 = u32::MAX;

/// A point on a surface, seen from the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Receiver {
    /// Scene space.
    pub position: DVec3,
    /// Bound on the distance of `position` from the surface it stands for, m: the rounding of its own computation.
    pub position_error: f64,
    /// Unit geometric normal on the camera's side; the horizon.
    pub normal: DVec3,
    /// Unit interpolated normal on the camera's side; the cosine of irradiance.
    pub shading_normal: DVec3,
    /// Along the view axis, m.
    pub depth: f64,
    /// Index into [`crate::scene::Scene::instances`], or [`UNKNOWN`].
    pub instance: u32,
    /// Index into the mesh's triangles, or [`UNKNOWN`].
    pub triangle: u32,
    /// Weights of the triangle's second and third corner.
    pub barycentric: [f32; 2],
}

/// The receivers of an image.
#[derive(Debug, Clone)]
pub struct Receivers {
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Row-major from the top-left pixel; none where the camera sees no surface.
    pub pixels: Vec<Option<Receiver>>,
}

impl Receivers {
    /// Finds the receivers of an image: the first surface along the camera ray through `offset_px` of each pixel (0.5, 0.5 is
    /// the centre).
    ///
    /// # Errors
    /// [`crate::Error::Cancelled`] when the user asks to stop.
    pub fn find(
        bvh: &SceneBvh,
        camera: &Camera,
        size: [u32; 2],
        offset_px: DVec2,
        progress: &Progress,
    ) -> Result<Self> {
        let mut pixels = vec![None; size[0] as usize * size[1] as usize];
        pixels.par_chunks_mut(size[0] as usize).enumerate().try_for_each_init(
            Scratch::default,
            |scratch, (y, row)| {
                for (x, pixel) in row.iter_mut().enumerate() {
                    let ray = camera.ray(DVec2::new(x as f64, y as f64) + offset_px, size);
                    *pixel = receiver_at(bvh, camera, ray, scratch);
                }
                progress.advance(1)
            },
        )?;
        Ok(Self { size, pixels })
    }

    /// The receivers that are there.
    pub fn hits(&self) -> impl Iterator<Item = &Receiver> {
        self.pixels.iter().flatten()
    }

    /// Those of an image within a border of so many pixels on either side, and above and below.
    pub fn within(&self, border: [u32; 2]) -> Self {
        Self { size: [0, 1].map(|i| self.size[i] - 2 * border[i]), pixels: within(&self.pixels, self.size, border) }
    }

    /// Bounds of the receivers, scene space.
    pub fn bounds(&self) -> Bounds {
        self.hits().map(|receiver| receiver.position).collect()
    }
}

/// The pixels of an image of `size` within a border; those of an image that holds none are none.
pub fn within<T: Copy>(pixels: &[T], [width, _]: [u32; 2], [left, above]: [u32; 2]) -> Vec<T> {
    let (width, left, above) = (width as usize, left as usize, above as usize);
    let rows = pixels.chunks_exact(width);
    let height = rows.len();
    rows.take(height.saturating_sub(above)).skip(above).flat_map(|row| &row[left..width - left]).copied().collect()
}

/// A shading normal on the side of the geometric one.
pub fn toward(shading_normal: DVec3, normal: DVec3) -> DVec3 {
    if shading_normal.dot(normal) < 0.0 { -shading_normal } else { shading_normal }
}

fn receiver_at(bvh: &SceneBvh, camera: &Camera, ray: CameraRay, scratch: &mut Scratch) -> Option<Receiver> {
    let hit = bvh.first_hit(ray.origin, ray.direction, camera.near, camera.far, scratch)?;
    Some(receiver_of(bvh, ray, &hit))
}

/// The receiver where a camera ray meets the plane of a triangle that it is known to see, to within rounding at its edges; none
/// beyond the camera's range.
pub fn receiver_on(bvh: &SceneBvh, camera: &Camera, ray: CameraRay, instance: u32, triangle: u32) -> Option<Receiver> {
    let crossing = bvh.plane_crossing(instance, triangle, ray.origin, ray.direction)?;
    let is_in_range = crossing.t >= camera.near && crossing.t <= camera.far;
    is_in_range.then(|| receiver_of(bvh, ray, &Hit { instance, triangle, crossing }))
}

fn receiver_of(bvh: &SceneBvh, ray: CameraRay, hit: &Hit) -> Receiver {
    let point = bvh.surface_point(hit.instance, hit.triangle, hit.crossing.barycentric);
    let normal = if point.normal.dot(ray.direction) > 0.0 { -point.normal } else { point.normal };
    let shading_normal = bvh.shading_normal(hit.instance, hit.triangle, hit.crossing.barycentric).unwrap_or(normal);
    Receiver {
        position: point.position,
        position_error: point.error,
        normal,
        shading_normal: toward(shading_normal, normal),
        depth: hit.crossing.t,
        instance: hit.instance,
        triangle: hit.triangle,
        barycentric: hit.crossing.barycentric.map(|weight| weight as f32),
    }
}
