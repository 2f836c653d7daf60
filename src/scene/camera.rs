//! Cameras.

use glam::{DAffine3, DMat3, DVec2, DVec3};

use super::Bounds;

/// A camera: looks along local −Z, +Y up.
#[derive(Debug, Clone)]
pub struct Camera {
    /// Name, as `--camera` takes it.
    pub name: String,
    /// Rotation and translation only.
    pub scene_from_camera: DAffine3,
    /// Perspective or orthographic.
    pub projection: Projection,
    /// Nothing nearer than this along the view axis is seen, m.
    pub near: f64,
    /// Nothing farther than this along the view axis is seen, m; may be infinite.
    pub far: f64,
}

/// How a camera maps the view to the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Projection {
    /// A pinhole.
    Perspective {
        /// Full vertical field of view, radians.
        fov_y: f64,
    },
    /// Parallel rays.
    Orthographic {
        /// Half the height of the view, m; the width follows the image's aspect.
        half_height: f64,
    },
}

/// A camera ray in scene space: `origin + t · direction`, where `t` is depth along the view axis.
#[derive(Debug, Clone, Copy)]
pub struct CameraRay {
    /// Where `t` is zero.
    pub origin: DVec3,
    /// Not unit: its component along the view axis is 1.
    pub direction: DVec3,
}

impl Camera {
    /// The ray through image position `at_px` (pixels from the top-left corner; pixel centres at half-integers).
    pub fn ray(&self, at_px: DVec2, size: [u32; 2]) -> CameraRay {
        let [width, height] = size.map(f64::from);
        // [-1, 1] along the image's height, +Y up; square pixels.
        let x = (2.0 * at_px.x - width) / height;
        let y = (height - 2.0 * at_px.y) / height;
        let (origin_camera, direction_camera) = match self.projection {
            Projection::Perspective { fov_y } => {
                let slope = (0.5 * fov_y).tan();
                (DVec3::ZERO, DVec3::new(x * slope, y * slope, -1.0))
            }
            Projection::Orthographic { half_height } => {
                (DVec3::new(x * half_height, y * half_height, 0.0), DVec3::NEG_Z)
            }
        };
        CameraRay {
            origin: self.scene_from_camera.transform_point3(origin_camera),
            direction: self.scene_from_camera.transform_vector3(direction_camera),
        }
    }

    /// This camera with a view that shows so many pixels more on either side, and above and below, of an image of `size`.
    pub fn widened(&self, size: [u32; 2], border: [u32; 2]) -> Self {
        if border[1] == 0 {
            return self.clone();
        }
        let growth = f64::from(size[1] + 2 * border[1]) / f64::from(size[1]);
        let projection = match self.projection {
            Projection::Perspective { fov_y } => {
                Projection::Perspective { fov_y: 2.0 * (growth * (0.5 * fov_y).tan()).atan() }
            }
            Projection::Orthographic { half_height } => Projection::Orthographic { half_height: growth * half_height },
        };
        Self { projection, ..self.clone() }
    }

    /// The world width of a pixel at `depth` along the view axis, m.
    pub fn pixel_footprint(&self, depth: f64, size: [u32; 2]) -> f64 {
        let height = f64::from(size[1]);
        match self.projection {
            Projection::Perspective { fov_y } => 2.0 * (0.5 * fov_y).tan() * depth / height,
            Projection::Orthographic { half_height } => 2.0 * half_height / height,
        }
    }

    /// A camera that sees all of `bounds` from the front, the right and above.
    pub fn framing(bounds: &Bounds, aspect: f64) -> Self {
        let fov_y = 40f64.to_radians();
        let radius = 0.5 * bounds.size().length();
        // Fit the bounding sphere into the narrower of the two fields of view.
        let half_fov = (0.5 * fov_y).min(((0.5 * fov_y).tan() * aspect).atan());
        let distance = radius / half_fov.sin();
        let from = DVec3::new(0.55, 0.5, 1.0).normalize();
        Self {
            name: "framed".into(),
            scene_from_camera: look_at(bounds.center() + from * distance, bounds.center(), DVec3::Y),
            projection: Projection::Perspective { fov_y },
            near: 0.0,
            far: f64::INFINITY,
        }
    }
}

/// The rigid transform that puts local −Z on the way from `eye` to `target`, local +Y as near to `up` as can be (world −Z
/// where the two are parallel).
pub fn look_at(eye: DVec3, target: DVec3, up: DVec3) -> DAffine3 {
    DAffine3 { matrix3: aimed(target - eye, up), translation: eye }
}

/// The rotation that puts local −Z along `direction` and local +Y on the projection of `up` across it; world −Z serves as
/// `up` where the two are parallel (`contract.md`, roll 0).
pub fn aimed(direction: DVec3, up: DVec3) -> DMat3 {
    let z = -direction.normalize();
    let mut y = up - up.dot(z) * z;
    // Parallel to within rounding: the projection is noise.
    if y.length() < 1e-7 {
        y = DVec3::NEG_Z - DVec3::NEG_Z.dot(z) * z;
    }
    let y = y.normalize();
    DMat3::from_cols(y.cross(z), y, z)
}
