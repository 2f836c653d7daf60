//! Percentage-closer soft shadows: the mean depth of the blockers that one map shows gives the width of the penumbra. Fernando
//! 2005, "Percentage-Closer Soft Shadows".
//!
//! Where one planar occluder parallel to the light is all there is, a dense kernel converges to the truth. Blockers at several
//! depths share one mean, and what the light's centre does not see blocks nothing: errors that no number of taps cures.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Context, Entry, Frame, LightImage, Needs, Parameters, Technique, parse_parameters, schema_of};
use crate::Result;
use crate::gpu::Gpu;
use crate::gpu::center_map::{self, Settings};
use crate::sampling::{Pattern, grid_of};
use crate::scene::AreaLight;

/// Registered as `pcss`.
pub const ENTRY: Entry = Entry {
    name: "pcss",
    paper: "Fernando 2005, \"Percentage-Closer Soft Shadows\"",
    summary: "one shadow map from the light's centre; blockers found around a receiver set the width of its filter",
    needs: Needs::Gpu,
    schema: schema_of::<Pcss>,
    presets: &[
        ("paper", "search_taps=16 filter_taps=16 map_size=1024"),
        ("16/16", "search_taps=16 filter_taps=16"),
        ("32/32", "search_taps=32 filter_taps=32"),
        ("dense", "dense=true"),
    ],
    demo: &["search_taps=16 filter_taps=16", "search_taps=32 filter_taps=32"],
    build,
};

/// Parameters of `pcss`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Pcss {
    /// Where the search for blockers begins, as a fraction of the way from the light to the receiver: the paper's near plane.
    /// What blocks from nearer to the light is found by chance.
    #[schemars(range(min = 0.001, max = 1))]
    pub near: f64,
    /// Texels looked at for blockers.
    #[schemars(range(min = 1, max = 4096))]
    pub search_taps: u32,
    /// Texels filtered.
    #[schemars(range(min = 1, max = 4096))]
    pub filter_taps: u32,
    /// Every texel of both kernels, up to 64 x 64 places in each, instead of so many taps.
    pub dense: bool,
    /// How taps are spread over a kernel.
    pub pattern: Pattern,
    /// Texels a side of the shadow map.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
}

impl Default for Pcss {
    fn default() -> Self {
        Self { near: 0.5, search_taps: 32, filter_taps: 32, dense: false, pattern: Pattern::Sobol, map_size: 1024 }
    }
}

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<Pcss>(&ENTRY, given)?;
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: Pcss,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let Pcss { near, search_taps, filter_taps, dense, pattern, map_size } = self.parameters;
        let settings = Settings {
            shader: "techniques/pcss.wgsl",
            constants: &[
                ("dense", f64::from(u8::from(dense))),
                ("near", near),
                ("search_taps", search_taps.into()),
                ("filter_taps", filter_taps.into()),
                ("pattern", pattern.on_gpu().into()),
                ("search_columns", grid_of(search_taps).0.into()),
                ("filter_columns", grid_of(filter_taps).0.into()),
            ],
            map_size,
            margin: 1,
            nearest: near,
            filters: true,
        };
        center_map::render(&self.gpu, frame, light, &settings)
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(&self.parameters).expect("parameters are numbers and names")
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(&self.gpu)
    }
}
