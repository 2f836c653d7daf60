//! Soft bilateral filtering shadows: the mean of the maps of a few points of the light, smoothed in the penumbra by a joint bilateral
//! filter on the screen.
//!
//! A reconstruction of Ali et al.'s SBFS, the rival that "Cascaded Soft Shadow Maps" measures itself by: of it only the outline is
//! available, 25 maps and a bilateral filter of the penumbra. What it does not tell is derived or measured here:
//! - the window is as wide as a point's cell of the light moves the shadow of the blockers found, so that it covers a step between two
//!   points and no more;
//! - depths are held against the receiver's plane, and other instances are left out;
//! - the standard deviations of distance (½, 1 and none tried) and V (0.1, 0.2 and 0.4) are those of the least geometric mean of errors
//!   on the scenes demo, contact, tilt and two-edges; that of normals, 6°, leaves curved surfaces whole.

use std::sync::Arc;

use glam::Vec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::uniform::{Placement, Uniform, Weights};
use super::{Context, Entry, Frame, LightImage, Needs, Parameters, Technique, add_passes, parse_parameters, schema_of};
use crate::gpu::center_map::emitter_of;
use crate::gpu::emission::Emission;
use crate::gpu::light_view::{Chunk, LightView, TILE, WORKGROUP};
use crate::gpu::screen::{SAME_SURFACE, Screen};
use crate::gpu::shadow_map::{self, MapPoint, RenderedMaps, ShadowMaps};
use crate::gpu::{self, Gpu};
use crate::scene::AreaLight;
use crate::scene::light::Domain;
use crate::{Error, Result, gpu_struct};

/// Registered as `bilateral`.
pub const ENTRY: Entry = Entry {
    name: "bilateral",
    paper: "a reconstruction of Ali et al.'s \"Soft Bilateral Filtering Shadows\" (SBFS), whose parameters are not available",
    summary: "averages shadow maps from 25 points of the light, then neighbours of like depth, normal and shadow",
    needs: Needs::Gpu,
    schema: schema_of::<Bilateral>,
    presets: &[("paper", "placement=corners")],
    demo: &[""],
    build,
};

/// Parameters of `bilateral`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Bilateral {
    /// Points on the light, a shadow map each.
    #[schemars(range(min = 1, max = 1024))]
    pub points: u32,
    /// How the points are placed on the light.
    pub placement: Placement,
    /// Taps of the filter along each side of its window, an odd number; 1: none.
    #[schemars(range(min = 1, max = 31))]
    pub taps: u32,
    /// Standard deviation of the distance of neighbours, in halves of the window.
    #[schemars(range(min = 0.01, max = 1000))]
    pub sigma_distance: f64,
    /// Standard deviation of their normals, which are 2 sin(angle/2) apart.
    #[schemars(range(min = 0.001, max = 1000))]
    pub sigma_normal: f64,
    /// Standard deviation of their V.
    #[schemars(range(min = 0.001, max = 1000))]
    pub sigma_visibility: f64,
    /// Texels a side of each map.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
}

impl Default for Bilateral {
    fn default() -> Self {
        Self {
            points: 25,
            placement: Placement::Grid,
            taps: 5,
            sigma_distance: 1.0,
            sigma_normal: 0.1,
            sigma_visibility: 0.4,
            map_size: 1024,
        }
    }
}

gpu_struct! {
    /// Twin of `FilterJob` in `techniques/bilateral.wgsl`.
    struct FilterJob {
        pub width: u32,
        pub tile_columns: u32,
        pub points: f32,
        pub cell: f32,
        pub sigmas: Vec3,
        pub padding: u32,
    }
}

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<Bilateral>(&ENTRY, given)?;
    if parameters.taps.is_multiple_of(2) {
        let message = format!("expected an odd number, found {}", parameters.taps);
        return Err(Error::usage("parameter taps of bilateral", message));
    }
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: Bilateral,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let gpu = &*self.gpu;
        let Some(view) = LightView::new(gpu, frame, light)? else {
            frame.progress.advance(u64::from(frame.receivers.size[1]))?;
            return Ok(LightView::image(None, frame, light, |_, _, _| (0.0, 0.0)));
        };
        let Bilateral { points, placement, taps, map_size, .. } = self.parameters;
        let grid = Uniform { samples: points, placement, weights: Weights::Equal, ..Uniform::default() };
        let is_point = view.emitter.domain == Domain::Point;
        let place = |(square, _)| MapPoint { position: view.point_on(light, square), weight: 1.0 };
        let points: Vec<MapPoint> =
            grid.points().into_iter().take(if is_point { 1 } else { usize::MAX }).map(place).collect();
        // There must be neighbours, and points that stand for some of the light.
        let shot = frame.shot.filter(|_| taps > 1 && !is_point);
        let own: [(&str, f64); 5] = [
            ("kernel", 1.0),
            ("irradiance", f64::from(u8::from(frame.irradiance))),
            ("filters", f64::from(u8::from(shot.is_some()))),
            ("taps", taps.into()),
            ("tile_side", TILE.into()),
        ];
        let constants = [shadow_map::CONSTANTS, &own].concat();
        let pipeline = |entry_point| gpu.compute_pipeline("techniques/bilateral.wgsl", entry_point, &constants);
        let emitter = gpu.buffer("emitter", &[emitter_of(&view)], wgpu::BufferUsages::UNIFORM)?;
        let emission = gpu.buffer("emission", &[Emission::of(light)], wgpu::BufferUsages::UNIFORM)?;
        let known: Vec<Known> = view.chunks.iter().map(|chunk| Known::new(gpu, chunk)).collect::<Result<_>>()?;

        // The mean of the maps.
        let maps = ShadowMaps::new(&view, &points, &view.tiles, map_size, 0)?;
        let look_up = pipeline("look_up");
        let record = |frame: &mut gpu::pass::Frame, maps: &RenderedMaps| {
            for known in &known {
                frame
                    .compute("look-ups", &look_up)
                    .bind("faces", &maps.faces)
                    .bind("points", &maps.points)
                    .bind("receivers", &known.chunk.buffer)
                    .bind("shadow_depth", &maps.depth)
                    .bind("emitter", &emitter)
                    .bind("emission", &emission)
                    .bind("sums", &known.sums)
                    .bind("blockers", &known.blockers)
                    .dispatch(known.groups());
            }
        };
        let mut passes = Vec::new();
        maps.each_batch(record, |timed| {
            add_passes(&mut passes, timed);
            frame.progress.check()
        })?;

        // The filter.
        let storage = wgpu::BufferUsages::STORAGE;
        let [width, height] = frame.receivers.size;
        let pixels = 16 * u64::from(width) * u64::from(height);
        let [shown, normals] =
            [gpu.empty_buffer("what neighbours see", pixels, storage)?, gpu.empty_buffer("normals", pixels, storage)?];
        let tiles = u64::from(width.div_ceil(TILE)) * u64::from(height.div_ceil(TILE));
        let tile_gaps = gpu.empty_buffer("blockers by tile", 8 * tiles, storage)?;
        let screen = match shot {
            Some(shot) => {
                let screen = Screen::new(shot, [width, height], &view, SAME_SURFACE);
                gpu.buffer("screen", &[screen], wgpu::BufferUsages::UNIFORM)?
            }
            None => gpu.empty_buffer("screen", size_of::<Screen>() as u64, wgpu::BufferUsages::UNIFORM)?,
        };
        let Bilateral { sigma_distance, sigma_normal, sigma_visibility, .. } = self.parameters;
        let job = FilterJob {
            width,
            tile_columns: width.div_ceil(TILE),
            points: points.len() as f32,
            cell: 1.0 / (points.len() as f32).sqrt(),
            sigmas: Vec3::new(sigma_distance as f32, sigma_normal as f32, sigma_visibility as f32),
            padding: 0,
        };
        let job = gpu.buffer("job", &[job], wgpu::BufferUsages::UNIFORM)?;
        let mut gpu_frame = gpu::pass::Frame::new(gpu);
        let (show, smooth_out) = (pipeline("show"), pipeline("smooth_out"));
        for known in &known {
            gpu_frame
                .compute("filter", &show)
                .bind("receivers", &known.chunk.buffer)
                .bind("sums", &known.sums)
                .bind("blockers", &known.blockers)
                .bind("job", &job)
                .bind("screen", &screen)
                .bind("shown", &shown)
                .bind("normals", &normals)
                .bind("tile_gaps", &tile_gaps)
                .dispatch(known.groups());
        }
        for known in &known {
            gpu_frame
                .compute("filter", &smooth_out)
                .bind("receivers", &known.chunk.buffer)
                .bind("blockers", &known.blockers)
                .bind("job", &job)
                .bind("screen", &screen)
                .bind("emitter", &emitter)
                .bind("shown", &shown)
                .bind("normals", &normals)
                .bind("tile_gaps", &tile_gaps)
                .bind("smoothed", &known.answers)
                .dispatch(known.groups());
        }
        add_passes(&mut passes, gpu_frame.finish()?);
        frame.progress.check()?;
        let answers: Vec<Vec<[f32; 2]>> =
            known.iter().map(|known| gpu.read_buffer(&known.answers)).collect::<Result<_>>()?;
        let image = LightView::image(Some(&view), frame, light, |chunk, i, _| answers[chunk][i].map(f64::from).into());
        frame.progress.advance(u64::from(height))?;
        let receivers: u64 = view.chunks.iter().map(|chunk| chunk.pixels.len() as u64).sum();
        Ok(LightImage {
            samples: points.len() as u32,
            shadow_maps: maps.count,
            texels: points.len() as u64 * receivers,
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

/// What is known of a chunk of receivers.
struct Known<'a> {
    chunk: &'a Chunk,
    sums: wgpu::Buffer,
    blockers: wgpu::Buffer,
    answers: wgpu::Buffer,
}

impl<'a> Known<'a> {
    fn new(gpu: &Gpu, chunk: &'a Chunk) -> Result<Self> {
        let of = |label, bytes| gpu.empty_buffer(label, bytes * chunk.pixels.len() as u64, wgpu::BufferUsages::STORAGE);
        Ok(Self { chunk, sums: of("sums", 16)?, blockers: of("blockers", 8)?, answers: of("visibility", 8)? })
    }

    /// Workgroups for its receivers.
    fn groups(&self) -> [u32; 3] {
        [(self.chunk.pixels.len() as u32).div_ceil(WORKGROUP), 1, 1]
    }
}
