//! Hard shadows: one shadow map, seen from the light's centre. Williams 1978, "Casting Curved Shadows on Curved Surfaces".
//!
//! The limit of every other technique as the light shrinks.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Context, Entry, Frame, LightImage, Needs, Parameters, Technique, parse_parameters, schema_of};
use crate::Result;
use crate::gpu::Gpu;
use crate::gpu::center_map::{self, Settings};
use crate::scene::AreaLight;

/// Registered as `hard`.
pub const ENTRY: Entry = Entry {
    name: "hard",
    paper: "Williams 1978, \"Casting Curved Shadows on Curved Surfaces\"",
    summary: "one shadow map from the light's centre; no penumbra",
    needs: Needs::Gpu,
    schema: schema_of::<Hard>,
    presets: &[],
    demo: &[""],
    build,
};

/// Parameters of `hard`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Hard {
    /// Texels a side of the shadow map.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
}

impl Default for Hard {
    fn default() -> Self {
        Self { map_size: 1024 }
    }
}

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<Hard>(&ENTRY, given)?;
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: Hard,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let settings = Settings {
            shader: "techniques/hard.wgsl",
            constants: &[],
            map_size: self.parameters.map_size,
            margin: 1,
            nearest: 1.0,
            filters: false,
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
