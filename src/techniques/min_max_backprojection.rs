//! Back-projection over a min–max pyramid: what the texels of one map hide of the light, as rectangles of its plane, added up.
//! "Soft Shadows" (NVIDIA), section "Accurate Algorithm"; gaps and the search window after Guennebaud, Barthe and Paulin 2006,
//! "Real-Time Soft Shadow Mapping by Backprojection".
//!
//! Where one occluder parallel to the light is all there is, the rectangles tile its image and the answer is the truth, to the
//! texel. Occluders at several depths overlap in the light's plane and count twice, and between them are gaps: errors of the
//! paper's that no map cures. What the light's centre does not see blocks nothing. A node whose rectangle at its nearest depth
//! holds the light hides all of it, gaps or not.
//!
//! The paper has a square light and a map along its normal. Here the light is of any shape: a disk's share of a rectangle is its
//! own, spheres and tubes turn to each receiver. Where the map can't look along the normal (a cube's faces, lights that turn), a
//! texel is the rectangle of its patch's area and proportions.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Context, Entry, Frame, LightImage, Needs, Parameters, Technique, parse_parameters, schema_of};
use crate::Result;
use crate::gpu::Gpu;
use crate::gpu::center_map::{self, Pyramid, Settings};
use crate::gpu::min_max::Bounded;
use crate::scene::{AreaLight, Shape};

/// Registered as `min-max-backprojection`.
pub const ENTRY: Entry = Entry {
    name: "min-max-backprojection",
    paper: "NVIDIA, \"Soft Shadows\", accurate algorithm; Guennebaud, Barthe, Paulin 2006, \"Real-Time Soft Shadow Mapping by \
            Backprojection\"",
    summary: "one shadow map from the light's centre; the areas that its texels hide of the light are added up, whole nodes of a \
              min-max pyramid at once",
    needs: Needs::Gpu,
    schema: schema_of::<MinMaxBackprojection>,
    presets: &[
        ("paper", "slopes=false shrink=0 fill_gaps=false tolerance=0"),
        ("guennebaud", "slopes=false fill_gaps=true tolerance=0"),
    ],
    demo: &["map_size=512"],
    build,
};

/// Parameters of `min-max-backprojection`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MinMaxBackprojection {
    /// Texels a side of the shadow map.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
    /// Where the map begins to hold all that may block a receiver, as a fraction of the way from the light to it. What blocks from
    /// nearer to the light is seen as far as the map reaches to the sides.
    #[schemars(range(min = 0.001, max = 1))]
    pub near: f64,
    /// A texel's rectangle is drawn out to those of its neighbours that block too: no light leaks between them. What is hidden
    /// twice counts twice all the same.
    pub fill_gaps: bool,
    /// How often the search window, the light as seen through the plane of the nearest depth, is shrunk to the nearest depth in it;
    /// 0: the whole map is searched.
    #[schemars(range(min = 0, max = 8))]
    pub shrink: u32,
    /// Texels along a side of the search window, at most: of a larger one every second, fourth, … texel is taken. Bounds the work
    /// below large lights: more would not end on every driver.
    #[schemars(range(min = 1, max = 256))]
    pub window: u32,
    /// A node is taken as one patch where what it hides at its nearest and at its farthest depth differ by no more than this fraction
    /// of it; 0: texels alone are.
    #[schemars(range(min = 0, max = 1))]
    pub tolerance: f64,
    /// Nodes bound depths between two tilted planes, where those are closer, rather than between two depths.
    pub slopes: bool,
}

impl Default for MinMaxBackprojection {
    fn default() -> Self {
        Self { map_size: 1024, near: 0.5, fill_gaps: false, shrink: 2, window: 256, tolerance: 0.02, slopes: true }
    }
}

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<MinMaxBackprojection>(&ENTRY, given)?;
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: MinMaxBackprojection,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let MinMaxBackprojection { map_size, near, fill_gaps, shrink, window, tolerance, slopes } = self.parameters;
        let settings = Settings {
            shader: "techniques/min_max_backprojection.wgsl",
            constants: &[
                ("turns", turns(light.shape)),
                ("fill_gaps", f64::from(u8::from(fill_gaps))),
                ("shrink", shrink.into()),
                ("window_texels", window.into()),
                ("tolerance", tolerance),
            ],
            map_size,
            margin: 1,
            nearest: near,
            filters: true,
        };
        let pyramid = Pyramid { bounded: Bounded { slopes, neighbours: fill_gaps }, along_light: true };
        center_map::render_over_pyramid(&self.gpu, frame, light, &settings, pyramid)
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(&self.parameters).expect("parameters are numbers and names")
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(&self.gpu)
    }
}

/// How a light turns to its receivers, as `lib/back_projection.wgsl` has it.
pub fn turns(shape: Shape) -> f64 {
    match shape {
        Shape::Sphere { .. } | Shape::Point => 1.0,
        Shape::Tube { .. } => 2.0,
        Shape::Rect { .. } | Shape::Disk { .. } | Shape::Sun { .. } => 0.0,
    }
}
