//! How a light emits, for shaders.

use glam::Vec3;

use crate::geometry::irradiance::spread_slopes;
use crate::gpu_struct;
use crate::scene::{AreaLight, Shape};

gpu_struct! {
    /// Twin of `Emission` in `lib/emission.wgsl`: what a light point's weight depends on besides the receiver.
    pub struct Emission {
        /// Unit axis −Z of the light, scene space.
        pub axis: Vec3,
        /// 0 an area, a sun's disc included; 1 a point; 2 a point at infinity.
        pub kind: u32,
        /// 1 − cos of the cone's inner angle; 3 without a cone.
        pub versine_inner: f32,
        /// The same of the outer angle; 4 without a cone.
        pub versine_outer: f32,
        /// tan h for h = spread/2; −1 without spread.
        pub spread_tan: f32,
        /// tan h − h; −1 without spread.
        pub spread_norm: f32,
    }
}

impl Emission {
    /// How a light emits.
    pub fn of(light: &AreaLight) -> Self {
        let kind = match light.shape {
            shape if !shape.is_point() => 0,
            Shape::Sun { .. } => 2,
            _ => 1,
        };
        // 1 − cos without its cancellation.
        let versine = |angle: f64| (2.0 * (0.5 * angle).sin().powi(2)) as f32;
        let [versine_inner, versine_outer] =
            light.cone.map_or([3.0, 4.0], |cone| [versine(cone.inner), versine(cone.outer)]);
        let (tan, norm) = spread_slopes(light).unwrap_or((-1.0, -1.0));
        Self {
            axis: light.axis().as_vec3(),
            kind,
            versine_inner,
            versine_outer,
            spread_tan: tan as f32,
            spread_norm: norm as f32,
        }
    }
}
