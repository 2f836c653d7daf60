//! Percentage-closer filtering: the unblocked share of a kernel of texels. Reeves, Salesin and Cook 1987, "Rendering Antialiased
//! Shadows with Depth Maps".
//!
//! Its penumbra is as wide as the kernel, whatever the light: right at one distance of occluder and receiver alone.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Context, Entry, Frame, LightImage, Needs, Parameters, Technique, parse_parameters, schema_of};
use crate::Result;
use crate::gpu::Gpu;
use crate::gpu::center_map::{self, Settings};
use crate::scene::AreaLight;

/// Registered as `pcf`.
pub const ENTRY: Entry = Entry {
    name: "pcf",
    paper: "Reeves, Salesin, Cook 1987, \"Rendering Antialiased Shadows with Depth Maps\"",
    summary: "one shadow map from the light's centre, blurred by a kernel of fixed size",
    needs: Needs::Gpu,
    schema: schema_of::<Pcf>,
    presets: &[],
    demo: &["kernel=9"],
    build,
};

/// Parameters of `pcf`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Pcf {
    /// Texels a side of the shadow map.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
    /// Texels a side of the kernel: the width of the penumbra.
    #[schemars(range(min = 1, max = 255))]
    pub kernel: u32,
}

impl Default for Pcf {
    fn default() -> Self {
        Self { map_size: 1024, kernel: 9 }
    }
}

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<Pcf>(&ENTRY, given)?;
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: Pcf,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let settings = Settings {
            shader: "techniques/pcf.wgsl",
            constants: &[("kernel", f64::from(self.parameters.kernel))],
            map_size: self.parameters.map_size,
            margin: self.parameters.kernel / 2 + 1,
            nearest: 1.0,
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
