//! Uniform light sampling: a shadow map from each of N points of the light, the same for every receiver, their answers averaged.
//! Heckbert and Herf 1997, "Simulating Soft Shadows with Graphics Hardware", with shadow maps for their projected polygons.
//!
//! Converges to the truth as points and texels grow. The errors are those of the light's sampling, the same points at every
//! receiver, which shows as bands, and of the maps' texels.

use std::sync::Arc;

use glam::DVec2;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Context, Entry, Frame, LightImage, Needs, Parameters, Technique, add_passes, parse_parameters, schema_of};
use crate::Result;
use crate::gpu::emission::Emission;
use crate::gpu::light_view::{LightView, WORKGROUP, seen_of};
use crate::gpu::shadow_map::{self, MapPoint, RenderedMaps, ShadowMaps};
use crate::gpu::{self, Gpu};
use crate::sampling::{Pattern, Sampler, grid_of};
use crate::scene::AreaLight;
use crate::scene::light::Domain;

/// Registered as `uniform`.
pub const ENTRY: Entry = Entry {
    name: "uniform",
    paper: "Heckbert, Herf 1997, \"Simulating Soft Shadows with Graphics Hardware\"",
    summary: "averages shadow maps from N fixed points of the light; converges to the truth",
    needs: Needs::Gpu,
    schema: schema_of::<Uniform>,
    presets: &[
        ("paper", "placement=corners weights=equal samples=256 map_size=512"),
        ("81", "samples=81"),
        ("128", "samples=128"),
        ("256", "samples=256"),
    ],
    demo: &["samples=16", "samples=81", "samples=256"],
    build,
};

/// Parameters of `uniform`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Uniform {
    /// Points on the light, a shadow map each (six where receivers surround the light).
    #[schemars(range(min = 1, max = 65_536))]
    pub samples: u32,
    /// How the points are placed on the light.
    pub placement: Placement,
    /// What each point counts, on `corners`.
    pub weights: Weights,
    /// Texels a side of each map.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
    /// Chooses another set of points.
    pub seed: u32,
}

/// How points are placed on a light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Placement {
    /// Centres of a grid of cells.
    Grid,
    /// Corners of a grid of cells, on the light's edges too.
    Corners,
    /// One random point in each cell of a grid.
    Jittered,
    /// Halton (2, 3).
    Halton,
    /// Owen-scrambled Sobol'.
    Sobol,
}

/// What the corners of a grid count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Weights {
    /// All the same, which gives the light's edge too much.
    Equal,
    /// Each the area that is nearest to it: half inside an edge, a quarter at a corner of the light.
    Trapezoid,
}

impl Default for Uniform {
    fn default() -> Self {
        Self { samples: 81, placement: Placement::Grid, weights: Weights::Trapezoid, map_size: 1024, seed: 0 }
    }
}

impl Uniform {
    /// The points, on the unit square, and the whole number that each counts.
    pub fn points(&self) -> Vec<(DVec2, u32)> {
        let pattern = match self.placement {
            Placement::Grid => Pattern::Grid,
            Placement::Jittered => Pattern::Jittered,
            Placement::Halton => Pattern::Halton,
            Placement::Sobol => Pattern::Sobol,
            Placement::Corners => return self.corners(),
        };
        let sampler = Sampler::new(pattern, self.samples, 0, self.seed);
        (0..self.samples).map(|index| (sampler.unit_square(index), 1)).collect()
    }

    fn corners(&self) -> Vec<(DVec2, u32)> {
        let (columns, rows) = grid_of(self.samples);
        // A single column or row runs through the middle.
        let place = |at: u32, count: u32| if count == 1 { 0.5 } else { f64::from(at) / f64::from(count - 1) };
        let inside = |at: u32, count: u32| count > 1 && at > 0 && at + 1 < count;
        let point = |index: u32| {
            let (x, y) = (index % columns, index / columns);
            let weight = match self.weights {
                Weights::Equal => 1,
                Weights::Trapezoid => (1 + u32::from(inside(x, columns))) * (1 + u32::from(inside(y, rows))),
            };
            (DVec2::new(place(x, columns), place(y, rows)), weight)
        };
        (0..self.samples).map(point).collect()
    }
}

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<Uniform>(&ENTRY, given)?;
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: Uniform,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let gpu = &*self.gpu;
        let Some(view) = LightView::new(gpu, frame, light)? else {
            frame.progress.advance(u64::from(frame.receivers.size[1]))?;
            return Ok(LightView::image(None, frame, light, |_, _, _| (0.0, 0.0)));
        };
        let place = |(square, weight): (DVec2, u32)| MapPoint {
            position: view.point_on(light, square),
            weight: f64::from(weight),
        };
        let mut points: Vec<MapPoint> = self.parameters.points().into_iter().map(place).collect();
        if view.emitter.domain == Domain::Point {
            points.truncate(1);
        }
        let whole: f64 = points.iter().map(|point| point.weight).sum();
        let maps = ShadowMaps::new(&view, &points, &view.tiles, self.parameters.map_size, 0)?;
        let constants = [shadow_map::CONSTANTS, &[("irradiance", f64::from(u8::from(frame.irradiance)))]].concat();
        let pipeline = gpu.compute_pipeline("techniques/uniform.wgsl", "main", &constants);
        let emission = gpu.buffer("emission", &[Emission::of(light)], wgpu::BufferUsages::UNIFORM)?;
        let sums: Vec<wgpu::Buffer> = view
            .chunks
            .iter()
            .map(|chunk| gpu.empty_buffer("sums", 16 * chunk.pixels.len() as u64, wgpu::BufferUsages::STORAGE))
            .collect::<Result<_>>()?;
        let counter = gpu.counter()?;
        let record = |frame: &mut gpu::pass::Frame, maps: &RenderedMaps| {
            for (chunk, sums) in view.chunks.iter().zip(&sums) {
                frame
                    .compute("visibility", &pipeline)
                    .bind("faces", &maps.faces)
                    .bind("points", &maps.points)
                    .bind("receivers", &chunk.buffer)
                    .bind("shadow_depth", &maps.depth)
                    .bind("sums", sums)
                    .bind("counted", &counter)
                    .bind("emission", &emission)
                    .dispatch([(chunk.pixels.len() as u32).div_ceil(WORKGROUP), 1, 1]);
            }
        };
        let mut passes = Vec::new();
        maps.each_batch(record, |timed| {
            add_passes(&mut passes, timed);
            frame.progress.check()
        })?;
        let sums: Vec<Vec<[f32; 4]>> = sums.iter().map(|sums| gpu.read_buffer(sums)).collect::<Result<_>>()?;
        let image = LightView::image(Some(&view), frame, light, |chunk, i, _| seen_of(sums[chunk][i], whole));
        frame.progress.advance(u64::from(frame.receivers.size[1]))?;
        Ok(LightImage {
            samples: points.len() as u32,
            shadow_maps: maps.count,
            texels: gpu.count(&counter)?,
            passes,
            ..image
        })
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(&self.parameters).expect("parameters are numbers and names")
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(&self.gpu)
    }
}
