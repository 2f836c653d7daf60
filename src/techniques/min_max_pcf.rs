//! Percentage-closer filtering over a min–max pyramid: the answer of `pcf`, bit for bit, from a fraction of its fetches. "Soft
//! Shadows" (NVIDIA), section "Fast Algorithm".
//!
//! The paper holds whole nodes against the receiver's one depth. `pcf` holds each texel against the receiver's tangent plane there,
//! and so a node is decided by bounds on that plane's depth over its texels in the kernel, roundings included; where they don't
//! decide, what lies below does.
//!
//! On a lit surface that is tilted in the map every node is as deep as the surface is: two depths can't tell it from what blocks,
//! and the paper's pyramid descends to every texel. Nodes that bound depths between two tilted planes can.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Context, Entry, Frame, LightImage, Needs, Parameters, Technique, parse_parameters, schema_of};
use crate::Result;
use crate::gpu::Gpu;
use crate::gpu::center_map::{self, Pyramid, Settings};
use crate::gpu::min_max::Bounded;
use crate::scene::AreaLight;

/// Registered as `min-max-pcf`.
pub const ENTRY: Entry = Entry {
    name: "min-max-pcf",
    paper: "NVIDIA, \"Soft Shadows\", fast algorithm",
    summary: "what pcf answers, bit for bit, at a fraction of its fetches: whole nodes of a min-max pyramid decide at once",
    needs: Needs::Gpu,
    schema: schema_of::<MinMaxPcf>,
    presets: &[("paper", "slopes=false from_top=true")],
    demo: &["kernel=9", "kernel=31"],
    build,
};

/// Parameters of `min-max-pcf`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MinMaxPcf {
    /// Texels a side of the shadow map.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
    /// Texels a side of the kernel: the width of the penumbra.
    #[schemars(range(min = 1, max = 255))]
    pub kernel: u32,
    /// Nodes bound depths between two tilted planes, where those are closer, rather than between two depths. The answer is the
    /// same.
    pub slopes: bool,
    /// The search begins at the coarsest level, of 2 x 2 nodes, rather than at nodes as large as the kernel. The answer is the
    /// same.
    pub from_top: bool,
}

impl Default for MinMaxPcf {
    fn default() -> Self {
        Self { map_size: 1024, kernel: 9, slopes: true, from_top: false }
    }
}

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<MinMaxPcf>(&ENTRY, given)?;
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: MinMaxPcf,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let MinMaxPcf { map_size, kernel, slopes, from_top } = self.parameters;
        let settings = Settings {
            shader: "techniques/min_max_pcf.wgsl",
            constants: &[("kernel", kernel.into()), ("from_top", f64::from(u8::from(from_top)))],
            map_size,
            margin: kernel / 2 + 1,
            nearest: 1.0,
            filters: true,
        };
        let pyramid = Pyramid { bounded: Bounded { slopes, neighbours: false }, along_light: false };
        center_map::render_over_pyramid(&self.gpu, frame, light, &settings, pyramid)
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(&self.parameters).expect("parameters are numbers and names")
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(&self.gpu)
    }
}
