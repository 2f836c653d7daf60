//! Bitmask soft shadows: the texels of one map, projected back onto a light that is a grid of bits. Schwarz and Stamminger 2007,
//! "Bitmask Soft Shadows".
//!
//! A bit that two patches hide is hidden once: occluders at several depths, which add up to too much where areas do, cost nothing.
//! What the light's centre does not see blocks nothing, as with every technique of one map, nor does what is nearer to the receiver
//! than the map's bias, about two texels. A straight edge is off by half a row of bits at most, 1/16 of the light with 64 bits and
//! 1/32 with 256; where it is parallel to the rows the steps show.
//!
//! The paper has a square light. Here it is of any shape: of a disk the bits within it count, spheres and tubes turn to each
//! receiver. Where all texels of the search window are before the receiver it is in the umbra, whatever gaps their patches have.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::min_max_backprojection::turns;
use super::{Context, Entry, Frame, LightImage, Needs, Parameters, Technique, parse_parameters, schema_of};
use crate::Result;
use crate::gpu::Gpu;
use crate::gpu::center_map::{self, Pyramid, Settings};
use crate::gpu::min_max::Bounded;
use crate::scene::AreaLight;

/// Registered as `bitmask`.
pub const ENTRY: Entry = Entry {
    name: "bitmask",
    paper: "Schwarz, Stamminger 2007, \"Bitmask Soft Shadows\"",
    summary: "one shadow map from the light's centre; its texels set the bits of the light that they hide, so that nothing counts \
              twice",
    needs: Needs::Gpu,
    schema: schema_of::<Bitmask>,
    presets: &[("paper", "search=8 side=8 patches=texels"), ("12x12", "search=12 side=16 patches=texels")],
    demo: &["map_size=512", "search=8 side=8 patches=texels"],
    build,
};

/// Parameters of `bitmask`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Bitmask {
    /// Texels a side of the shadow map.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
    /// Where the map begins to hold all that may block a receiver, as a fraction of the way from the light to it. What blocks from
    /// nearer to the light is seen as far as the map reaches to the sides.
    #[schemars(range(min = 0.001, max = 1))]
    pub near: f64,
    /// Bits along a side of the light: 64 or 256 of them in the paper.
    #[schemars(range(min = 1, max = 16))]
    pub side: u32,
    /// Texels along a side of the search window, at most: of a larger one every second, third, … texel is taken. More than 96 would
    /// not end on every driver.
    #[schemars(range(min = 1, max = 96))]
    pub search: u32,
    /// How often the search window, the light as seen through the plane of the nearest depth, is shrunk to the nearest depth in it.
    #[schemars(range(min = 0, max = 8))]
    pub shrink: u32,
    /// What hides the light.
    pub patches: Patches,
}

/// What a texel of the map stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Patches {
    /// A patch of its own size, parallel to the map: gaps open between those of different depths.
    Texels,
    /// The surface between the middles of four texels, where all of them block: no gaps, but edges lie half a texel too far in,
    /// what is thinner than two texels is lost, and what is far behind hangs together with what is before it.
    Quads,
    /// Both: neither gaps nor losses.
    Joined,
}

impl Default for Bitmask {
    fn default() -> Self {
        Self { map_size: 1024, near: 0.5, side: 16, search: 96, shrink: 2, patches: Patches::Joined }
    }
}

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<Bitmask>(&ENTRY, given)?;
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: Bitmask,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let Bitmask { map_size, near, side, search, shrink, patches } = self.parameters;
        let settings = Settings {
            shader: "techniques/bitmask.wgsl",
            constants: &[
                ("turns", turns(light.shape)),
                ("light_side", side.into()),
                ("search", search.into()),
                ("shrink", shrink.into()),
                ("texels", f64::from(u8::from(patches != Patches::Quads))),
                ("quads", f64::from(u8::from(patches != Patches::Texels))),
            ],
            map_size,
            margin: 1,
            nearest: near,
            filters: true,
        };
        let pyramid = Pyramid { bounded: Bounded { slopes: true, neighbours: false }, along_light: true };
        let image = center_map::render_over_pyramid(&self.gpu, frame, light, &settings, pyramid)?;
        Ok(LightImage { samples: side * side, ..image })
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(&self.parameters).expect("parameters are numbers and names")
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(&self.gpu)
    }
}
