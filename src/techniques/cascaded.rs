//! Cascaded soft shadow maps: the view is split by distance, and the farther a split the fewer points of the light have maps for it,
//! with fewer texels and smaller kernels. After "Cascaded Soft Shadow Maps", which samples a light anew for each part of Engel's
//! "Cascaded Shadow Maps" and filters each by a PCF kernel of its own.
//!
//! What the paper leaves open or gets wrong is a choice here:
//! - its Eq. 5 for the planes of splits has (f − n)^(i/m) where Zhang's practical scheme, which it cites, has n + (f − n) i/m: the
//!   splits crowd at the near plane, lie elsewhere where lengths are in other units, and the first begins at n + ½.
//!   `planes=printed` is Eq. 5, `planes=practical` what it stands for;
//! - it splits the camera's frustum, however little of it is in view; `range=receivers` splits what is seen;
//! - points at the light's corners, all weighted alike, take half of what they stand for from beyond its edge. `placement=grid` are
//!   the middles of cells;
//! - where the count of points changes there is a seam; `blend` fades splits into each other;
//! - it divides all of a split for a single pixel at which the first four points differ; and names as future work what
//!   `refine=tile` does: more look-ups, and filters, in the penumbra alone;
//! - its kernels are as wide as texels are, whatever the penumbra; `filter` averages V over the neighbours that a point's cell of the
//!   light would move shadows by, as `adaptive` does, but of those alone that differ by no more than a row of points.
//!
//! The paper tells neither the resolution of its maps, for whose high, medium and low 1024, 512 and 256 stand, nor its near and far
//! planes, for which the nearest and the farthest receiver do.
//!
//! Given receivers are split by their own depths, and all in the first split if they have none; nothing is known of neighbours then,
//! so that no look-up is left out and no neighbour averaged.

use std::ops::Range;
use std::sync::Arc;

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{
    Context, Entry, Frame, LightImage, Needs, Parameters, Pass, Technique, add_passes, parse_parameters, schema_of,
};
use crate::gpu::center_map::emitter_of;
use crate::gpu::emission::Emission;
use crate::gpu::light_view::{self, Chunk, GpuReceiver, LightView, TILE, WORKGROUP, around, by_tile, fraction_above};
use crate::gpu::screen::{SAME_SURFACE, Screen};
use crate::gpu::shader::Pipeline;
use crate::gpu::shadow_map::{self, Keep, MapPoint, ShadowMaps};
use crate::gpu::{self, Gpu};
use crate::receivers::Receiver;
use crate::scene::light::Domain;
use crate::scene::{AreaLight, Bounds};
use crate::{Error, Result, gpu_struct};

/// Registered as `cascaded`.
pub const ENTRY: Entry = Entry {
    name: "cascaded",
    paper: "\"Cascaded Soft Shadow Maps\" with several PCF kernels, after Engel's cascaded shadow maps",
    summary: "averages shadow maps from fewer points of the light, the farther from the camera",
    needs: Needs::Gpu,
    schema: schema_of::<Cascaded>,
    presets: &[("paper", PAPER), ("paper-25/9/4", PAPER_25), ("25/9/4", "points=25/9/4")],
    demo: &["", "points=25/9/4"],
    build,
};

/// The paper's results.
const PAPER: &str = "points=16/9/4 placement=corners planes=printed refine=split blend=0 filter=false kernels=5/3/2 \
                     map_size=1024/512/256";

/// The paper's Figure 1.
const PAPER_25: &str = "points=25/9/4 placement=corners planes=printed refine=split blend=0 filter=false \
                        kernels=5/3/2 map_size=1024/512/256";

/// Splits at most.
pub const MOST_SPLITS: usize = 8;

/// Parameters of `cascaded`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Cascaded {
    /// Points on the light for each split from near to far, squares up to 1024, as 16/9/4: as many splits as there are numbers, up to
    /// eight.
    #[schemars(with = "String")]
    pub points: PerSplit,
    /// How the points are placed on the light.
    pub placement: Placement,
    /// Where the splits begin.
    pub planes: Planes,
    /// What is split.
    pub range: Span,
    /// Where all points of a split are looked up.
    pub refine: Refine,
    /// How much of a split, at either end, fades into the next one: 1 is up to its middle.
    #[schemars(range(min = 0, max = 1))]
    pub blend: f64,
    /// Whether the steps between points are smoothed out: V is averaged over neighbours on the screen, as far as a point's cell of the
    /// light moves a shadow, and what of the light is below a receiver's horizon is not told by points.
    pub filter: bool,
    /// Texels a side of the kernel by which maps are read, up to 15, for each split; the last number for those beyond.
    #[schemars(with = "String")]
    pub kernels: PerSplit,
    /// Texels a side of each map, up to 16384, for each split; the last number for those beyond.
    #[schemars(with = "String")]
    pub map_size: PerSplit,
}

/// A whole number for each split, near to far, as `16/9/4`; the last one holds for those beyond.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Value", into = "Value")]
pub struct PerSplit(pub Vec<u32>);

impl TryFrom<Value> for PerSplit {
    type Error = String;

    fn try_from(value: Value) -> Result<Self, String> {
        let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
        let numbers = text.split('/').map(|number| number.parse().ok()).collect::<Option<Vec<u32>>>();
        numbers.map(Self).ok_or_else(|| format!("expected whole numbers as 16/9/4, found {value}"))
    }
}

impl From<PerSplit> for Value {
    fn from(PerSplit(numbers): PerSplit) -> Self {
        match numbers[..] {
            [number] => number.into(),
            _ => numbers.iter().map(u32::to_string).collect::<Vec<_>>().join("/").into(),
        }
    }
}

/// How points are placed on a light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Placement {
    /// Centres of a grid of cells.
    Grid,
    /// Corners of a grid of cells, on the light's edges too (the paper's Eq. 7).
    Corners,
}

/// Where the splits begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Planes {
    /// Half way between even steps of depth and even ratios of it (Zhang et al. 2006, their practical scheme).
    Practical,
    /// The paper's Eq. 5 as printed, with depths in metres.
    Printed,
}

/// What is split.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Span {
    /// From the nearest receiver in view to the farthest.
    Receivers,
    /// From the camera's near to its far plane; to the farthest receiver where it has none.
    Camera,
}

/// Where all points of a split are looked up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Refine {
    /// Everywhere.
    All,
    /// In splits where the first four points, near the light's corners, differ at some pixel (the paper).
    Split,
    /// In the 16 x 16 pixels where the first four points differ, and in those around.
    Tile,
}

impl Default for Cascaded {
    fn default() -> Self {
        Self {
            points: PerSplit(vec![16, 9, 4]),
            placement: Placement::Grid,
            planes: Planes::Practical,
            range: Span::Receivers,
            refine: Refine::Tile,
            blend: 0.25,
            filter: true,
            kernels: PerSplit(vec![1]),
            map_size: PerSplit(vec![768, 768, 512]),
        }
    }
}

/// Depths Z₀ to Z_m of the planes between which `count` splits of what is between `near` and `far` lie.
pub fn planes(planes: Planes, near: f64, far: f64, count: usize) -> Vec<f64> {
    let plane = |i: usize| {
        let share = i as f64 / count as f64;
        let even_ratio = if near > 0.0 { near * (far / near).powf(share) } else { far * share.floor() };
        match planes {
            Planes::Practical => 0.5 * (even_ratio + (near + (far - near) * share)),
            // Eq. 5.
            Planes::Printed => 0.5 * (even_ratio + near + (far - near).powf(share)),
        }
    };
    let mut all: Vec<f64> = (0..=count).map(plane).collect();
    // Within a metre the printed powers decrease.
    all.sort_by(f64::total_cmp);
    all
}

/// The splits that a depth is in, and the share of each: one, or two where they blend.
pub fn shares(planes: &[f64], blend: f64, depth: f64) -> [(usize, f32); 2] {
    let last = planes.len() - 2;
    let split = planes[1..=last].iter().filter(|&&plane| depth > plane).count();
    // How far beyond a plane, in widths of its band.
    let beyond = |plane: usize| {
        let width = blend * (planes[plane] - planes[plane - 1]).min(planes[plane + 1] - planes[plane]);
        let at = 0.5 + (depth - planes[plane]) / width;
        (width > 0.0 && 0.0 < at && at < 1.0).then_some(at as f32)
    };
    let before = if split > 0 { beyond(split).map(|at| (split - 1, at)) } else { None };
    let blended = before.or_else(|| if split < last { beyond(split + 1).map(|at| (split, at)) } else { None });
    match blended {
        // 1 − a, rounded, and a add up to 1 in f32.
        Some((split, at)) => [(split, 1.0 - at), (split + 1, at)],
        None => [(split, 1.0), (split, 0.0)],
    }
}

gpu_struct! {
    /// Twin of `Member` in `techniques/cascaded.wgsl`.
    struct Member {
        pub receiver: u32,
        pub weight: f32,
    }
}

gpu_struct! {
    /// Twin of `SplitJob` in `techniques/cascaded.wgsl`.
    struct SplitJob {
        pub width: u32,
        pub tile_columns: u32,
        pub points: f32,
        pub cell: f32,
    }
}

/// Workgroups that read a tile.
const GROUPS_A_TILE: u32 = TILE * TILE / WORKGROUP;

/// Ranges of depths below this share of them are roundings, and not split.
const LEAST_RANGE: f64 = 1.0 / (1 << 16) as f64;

/// A tile's tally where all points are seen.
const SEEN: u32 = 1;

/// Where some point is seen and some is not.
const DIFFERENT: u32 = 3;

/// Points that are looked up first, one near each corner.
const FIRST: usize = 4;

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<Cascaded>(&ENTRY, given)?;
    let refuse =
        |parameter: &str, message: String| Err(Error::usage(format!("parameter {parameter} of cascaded"), message));
    let PerSplit(points) = &parameters.points;
    let is_square = |&number: &u32| (1..=1024).contains(&number) && number.isqrt().pow(2) == number;
    if points.len() > MOST_SPLITS || !points.iter().all(is_square) {
        let message = format!("expected up to {MOST_SPLITS} squares of 1 to 32, found {}", text(&parameters.points));
        return refuse("points", message);
    }
    let lists = [("kernels", &parameters.kernels, 15), ("map_size", &parameters.map_size, 16_384)];
    for (name, list, most) in lists {
        if !list.0.iter().all(|number| (1..=most).contains(number)) {
            return refuse(name, format!("expected 1 to {most}, found {}", text(list)));
        }
    }
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

/// A list as it is given.
fn text(list: &PerSplit) -> String {
    let value = Value::from(list.clone());
    value.as_str().map_or_else(|| value.to_string(), str::to_owned)
}

impl PerSplit {
    fn of(&self, split: usize) -> u32 {
        self.0[split.min(self.0.len() - 1)]
    }
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: Cascaded,
}

impl Cascaded {
    /// The points of a split on the unit square, those near its corners first.
    fn places(&self, split: usize) -> Vec<DVec2> {
        let side = self.points.of(split).isqrt();
        let place = |at: u32| match self.placement {
            // A single point is in the middle.
            Placement::Corners if side > 1 => f64::from(at) / f64::from(side - 1),
            Placement::Corners | Placement::Grid => (f64::from(at) + 0.5) / f64::from(side),
        };
        let is_inner = |at: u32| at > 0 && at + 1 < side;
        let mut cells: Vec<[u32; 2]> = (0..side * side).map(|index| [index % side, index / side]).collect();
        cells.sort_by_key(|&[x, y]| is_inner(x) || is_inner(y));
        cells.into_iter().map(|cell| cell.map(place).into()).collect()
    }

    /// Where the splits of what a frame shows begin and end.
    fn planes_of(&self, frame: &Frame) -> Vec<f64> {
        let widen = |[nearest, farthest]: [f64; 2], depth: f64| [nearest.min(depth), farthest.max(depth)];
        let depths = frame.receivers.hits().map(|receiver| receiver.depth);
        let [nearest, farthest] = depths.fold([f64::INFINITY, 0.0], widen);
        let (near, far) = match frame.shot {
            Some(shot) if self.range == Span::Camera => {
                (shot.camera.near, if shot.camera.far.is_finite() { shot.camera.far } else { farthest })
            }
            _ => (nearest, farthest),
        };
        let (near, far) = (near.clamp(0.0, far.max(0.0)), far.max(0.0));
        if far - near <= LEAST_RANGE * far {
            return vec![near, far];
        }
        planes(self.planes, near, far, self.points.0.len())
    }
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let rows = u64::from(frame.receivers.size[1]);
        let which =
            if self.parameters.refine == Refine::All { light_view::Work::All } else { light_view::Work::Shadowed };
        let view = LightView::in_chunks(&self.gpu, frame, light, size_of::<GpuReceiver>() as u64, which)?;
        let Some(view) = view else {
            frame.progress.advance(rows)?;
            return Ok(LightView::image(None, frame, light, |_, _, _| (0.0, 0.0)));
        };
        let mut work = Work::new(&self.parameters, frame, light, &view)?;
        for split in 0..self.parameters.points.0.len() {
            work.begin(split)?;
        }
        let refined = work.refine()?;
        let image = work.finish(&refined)?;
        frame.progress.advance(rows)?;
        Ok(image)
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(&self.parameters).expect("parameters are numbers and names")
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(&self.gpu)
    }
}

/// One light on its way.
struct Work<'a> {
    parameters: &'a Cascaded,
    frame: &'a Frame<'a>,
    light: &'a AreaLight,
    view: &'a LightView<'a>,
    /// Of the splits.
    planes: Vec<f64>,
    /// Those that hold receivers.
    splits: Vec<Split>,
    emitter: wgpu::Buffer,
    emission: wgpu::Buffer,
    /// Of each chunk's receivers: their blockers, and the cells of the points that they have seen.
    blockers: Vec<[wgpu::Buffer; 2]>,
    texels: u64,
    shadow_maps: u32,
    passes: Vec<Pass>,
}

/// A split with its receivers.
struct Split {
    number: usize,
    /// Those near the light's corners first.
    points: Vec<MapPoint>,
    /// How many of these are looked up first.
    first: usize,
    /// Bounds of its receivers, by tile and chunk.
    boxes: Vec<Bounds>,
    /// Of each chunk.
    parts: Vec<Part>,
    /// By tile: what the first points see there, and at how many receivers they differ.
    tallies: wgpu::Buffer,
}

/// The receivers of a chunk that are in a split.
struct Part {
    /// Which of them are in which tile, by its number.
    tiles: Vec<(u32, Range<u32>)>,
    members: wgpu::Buffer,
    sums: wgpu::Buffer,
}

impl<'a> Work<'a> {
    fn new(
        parameters: &'a Cascaded,
        frame: &'a Frame<'a>,
        light: &'a AreaLight,
        view: &'a LightView<'a>,
    ) -> Result<Self> {
        let gpu = view.gpu;
        let of_chunk = |chunk: &Chunk| {
            let of =
                |label, bytes| gpu.empty_buffer(label, bytes * chunk.pixels.len() as u64, wgpu::BufferUsages::STORAGE);
            Ok([of("blockers", 8)?, of("cells", 4)?])
        };
        Ok(Self {
            parameters,
            frame,
            light,
            view,
            planes: parameters.planes_of(frame),
            splits: Vec::new(),
            emitter: gpu.buffer("emitter", &[emitter_of(view)], wgpu::BufferUsages::UNIFORM)?,
            emission: gpu.buffer("emission", &[Emission::of(light)], wgpu::BufferUsages::UNIFORM)?,
            blockers: view.chunks.iter().map(of_chunk).collect::<Result<_>>()?,
            texels: 0,
            shadow_maps: 0,
            passes: Vec::new(),
        })
    }

    /// Whether V is smoothed: there must be neighbours, and points that stand for some of the light.
    fn filters(&self) -> bool {
        self.parameters.filter && self.frame.shot.is_some() && self.view.emitter.domain != Domain::Point
    }

    /// Where all points are looked up: without an image, tiles are not of neighbours.
    fn refinement(&self) -> Refine {
        match self.parameters.refine {
            Refine::Tile if self.frame.shot.is_none() => Refine::All,
            refine => refine,
        }
    }

    /// A shader's entry point, for a split.
    fn pipeline(&self, entry_point: &str, split: usize) -> Arc<Pipeline<wgpu::ComputePipeline>> {
        let own: [(&str, f64); 4] = [
            ("kernel", self.parameters.kernels.of(split).into()),
            ("irradiance", f64::from(u8::from(self.frame.irradiance))),
            ("filters", f64::from(u8::from(self.filters()))),
            ("tile_side", TILE.into()),
        ];
        let constants = [shadow_map::CONSTANTS, &own].concat();
        self.view.gpu.compute_pipeline("techniques/cascaded.wgsl", entry_point, &constants)
    }

    fn job(&self) -> SplitJob {
        let width = self.frame.receivers.size[0];
        SplitJob { width, tile_columns: width.div_ceil(TILE), points: 0.0, cell: 0.0 }
    }

    /// Tiles of the image.
    fn tiles(&self) -> u32 {
        let [width, height] = self.frame.receivers.size;
        width.div_ceil(TILE) * height.div_ceil(TILE)
    }

    /// Finds the receivers of a split and looks its first points up; does nothing for a split without receivers.
    fn begin(&mut self, number: usize) -> Result<()> {
        let gpu = self.view.gpu;
        let mut boxes = Vec::new();
        let mut parts = Vec::new();
        for chunk in &self.view.chunks {
            let (part, bounds) = self.part(number, chunk)?;
            parts.push(part);
            boxes.extend(bounds);
        }
        if boxes.is_empty() {
            return Ok(());
        }
        // Maps hold all receivers, so that what is not looked up changes no texel of theirs.
        let lit = by_tile(&self.view.lit, self.frame.receivers.size[0]);
        let bounds_of = |(_, range): (u32, Range<u32>)| -> Bounds {
            let lit = &self.view.lit[range.start as usize..range.end as usize];
            lit.iter().filter(|&&pixel| self.share(number, pixel).is_some()).map(|&pixel| self.on_gpu(pixel)).collect()
        };
        boxes.par_extend(lit.into_par_iter().map(bounds_of).filter(|bounds| !bounds.is_empty()));
        let emitter = &self.view.emitter;
        let place = |square| MapPoint { position: self.view.point_on(self.light, square), weight: 1.0 };
        let mut points: Vec<MapPoint> = self.parameters.places(number).into_iter().map(place).collect();
        if emitter.domain == Domain::Point {
            points.truncate(1);
        }
        let first = if self.refinement() == Refine::All { points.len() } else { points.len().min(FIRST) };
        let tallies = gpu.empty_buffer("tallies", 8 * u64::from(self.tiles()), wgpu::BufferUsages::STORAGE)?;
        let split = Split { number, points, first, boxes, parts, tallies };
        self.look_up(&split, 0..first, |_| true)?;
        if self.refinement() != Refine::All {
            let mut frame = gpu::pass::Frame::new(gpu);
            let job = SplitJob { points: first as f32, ..self.job() };
            let job = gpu.buffer("job", &[job], wgpu::BufferUsages::UNIFORM)?;
            let pipeline = self.pipeline("tally", number);
            self.each_tile(
                &split,
                |_| true,
                |part, _, tiles, groups| {
                    frame
                        .compute("comparison", &pipeline)
                        .bind("work_tiles", tiles)
                        .bind("sums", &part.sums)
                        .bind("job", &job)
                        .bind("tallies", &split.tallies)
                        .dispatch(groups);
                },
            )?;
            add_passes(&mut self.passes, frame.finish()?);
        }
        self.splits.push(split);
        Ok(())
    }

    /// The receiver at a pixel.
    fn receiver(&self, pixel: u32) -> &Receiver {
        self.frame.receivers.pixels[pixel as usize].as_ref().expect("only hits face the light")
    }

    /// Where the receiver at a pixel is.
    fn on_gpu(&self, pixel: u32) -> DVec3 {
        (self.receiver(pixel).position - self.view.space.origin) / self.view.space.unit
    }

    /// How much of the receiver at a pixel a split has, if any.
    fn share(&self, split: usize, pixel: u32) -> Option<f32> {
        let shares = shares(&self.planes, self.parameters.blend, self.receiver(pixel).depth);
        shares.into_iter().find(|&(other, share)| other == split && share > 0.0).map(|(_, share)| share)
    }

    /// The receivers of a chunk that are in a split, and their bounds by tile.
    fn part(&self, number: usize, chunk: &Chunk) -> Result<(Part, Vec<Bounds>)> {
        let gpu = self.view.gpu;
        let in_tile = |(tile, range): &(u32, Range<u32>)| {
            let mut bounds = Bounds::EMPTY;
            let mut members = Vec::new();
            for receiver in range.clone() {
                let pixel = chunk.pixels[receiver as usize];
                if let Some(weight) = self.share(number, pixel) {
                    members.push(Member { receiver, weight });
                    let at = self.on_gpu(pixel);
                    bounds = bounds.union(Bounds { min: at, max: at });
                }
            }
            (*tile, members, bounds)
        };
        let found: Vec<_> = chunk.tiles.par_iter().map(in_tile).filter(|(_, members, _)| !members.is_empty()).collect();
        let mut all = Vec::new();
        let (mut tiles, mut boxes) = (Vec::new(), Vec::new());
        for (tile, members, bounds) in found {
            let first = all.len() as u32;
            all.extend(members);
            tiles.push((tile, first..all.len() as u32));
            boxes.push(bounds);
        }
        let storage = wgpu::BufferUsages::STORAGE;
        let sums = gpu.empty_buffer("sums", 16 * all.len() as u64, storage)?;
        Ok((Part { tiles, members: gpu.buffer("members", &all, storage)?, sums }, boxes))
    }

    /// Records something for each part of a split and those of its tiles that are wanted, as many at once as may be dispatched.
    fn each_tile(
        &self,
        split: &Split,
        wanted: impl Fn(u32) -> bool,
        mut record: impl FnMut(&Part, usize, &wgpu::Buffer, [u32; 3]),
    ) -> Result<()> {
        let gpu = self.view.gpu;
        let most = gpu.device.limits().max_compute_workgroups_per_dimension / GROUPS_A_TILE;
        for (at, part) in split.parts.iter().enumerate() {
            let of_tile = |(tile, range): &(u32, Range<u32>)| [range.start, range.len() as u32, *tile, 0];
            let tiles: Vec<[u32; 4]> = part.tiles.iter().filter(|(tile, _)| wanted(*tile)).map(of_tile).collect();
            for tiles in tiles.chunks(most as usize) {
                let buffer = gpu.buffer("tiles", tiles, wgpu::BufferUsages::STORAGE)?;
                record(part, at, &buffer, [GROUPS_A_TILE * tiles.len() as u32, 1, 1]);
            }
        }
        Ok(())
    }

    /// Renders the maps of some points of a split, which hold all its receivers, and looks them up in the tiles wanted.
    fn look_up(&mut self, split: &Split, range: Range<usize>, wanted: impl Fn(u32) -> bool) -> Result<()> {
        let gpu = self.view.gpu;
        let Cascaded { kernels, map_size, .. } = self.parameters;
        let (kernel, size) = (kernels.of(split.number), map_size.of(split.number));
        let margin = if kernel > 1 { kernel / 2 + 1 } else { 0 };
        let points = &split.points[range];
        let maps = ShadowMaps::of(self.view, &self.view.casters, points, &split.boxes, [size, margin], Keep::One)?;
        let pipeline = self.pipeline("look_up", split.number);
        for batch in 0..maps.batches() {
            let mut frame = gpu::pass::Frame::new(gpu);
            let rendered = maps.render(&mut frame, batch)?;
            self.each_tile(split, &wanted, |part, at, tiles, groups| {
                frame
                    .compute("look-ups", &pipeline)
                    .bind("faces", &rendered.faces)
                    .bind("points", &rendered.points)
                    .bind("receivers", &self.view.chunks[at].buffer)
                    .bind("shadow_depth", &rendered.depth)
                    .bind("emitter", &self.emitter)
                    .bind("emission", &self.emission)
                    .bind("members", &part.members)
                    .bind("work_tiles", tiles)
                    .bind("sums", &part.sums)
                    .bind("blockers", &self.blockers[at][0])
                    .dispatch(groups);
            })?;
            add_passes(&mut self.passes, frame.finish()?);
            self.frame.progress.check()?;
        }
        let tiles = split.parts.iter().flat_map(|part| &part.tiles).filter(|(tile, _)| wanted(*tile));
        let members: u64 = tiles.map(|(_, members)| members.len() as u64).sum();
        self.texels += members * points.len() as u64 * u64::from(kernel.pow(2));
        self.shadow_maps += maps.count;
        Ok(())
    }

    /// Looks the other points of each split up where the first ones differ; tells for each split in which tiles.
    fn refine(&mut self) -> Result<Vec<Vec<bool>>> {
        let refinement = self.refinement();
        let splits = std::mem::take(&mut self.splits);
        let tallies = |split: &Split| self.view.gpu.read_buffer::<[u32; 2]>(&split.tallies);
        let tallies: Vec<Vec<[u32; 2]>> = splits.iter().map(tallies).collect::<Result<_>>()?;
        let mut states = vec![0; self.tiles() as usize];
        for tile in self.view.lit_tiles() {
            states[tile as usize] = SEEN;
        }
        for tallies in &tallies {
            for (state, [own, _]) in states.iter_mut().zip(tallies) {
                *state |= own;
            }
        }
        let columns = self.job().tile_columns;
        let seen = |tile: u32| around(tile, columns, self.tiles()).fold(0, |all, tile| all | states[tile as usize]);
        let in_penumbra: Vec<bool> = (0..self.tiles()).map(|tile| seen(tile) == DIFFERENT).collect();
        let mut refined = Vec::new();
        for (split, tallies) in splits.iter().zip(&tallies) {
            let tiles = match refinement {
                Refine::All => vec![true; in_penumbra.len()],
                Refine::Split => vec![tallies.iter().any(|[_, differing]| *differing > 0); in_penumbra.len()],
                Refine::Tile => in_penumbra.clone(),
            };
            if split.first < split.points.len() && tiles.contains(&true) {
                self.look_up(split, split.first..split.points.len(), |tile| tiles[tile as usize])?;
            }
            refined.push(tiles);
        }
        self.splits = splits;
        Ok(refined)
    }

    /// Shows what all splits have seen, and smooths it in the tiles that were refined.
    fn finish(mut self, refined: &[Vec<bool>]) -> Result<LightImage> {
        let gpu = self.view.gpu;
        let storage = wgpu::BufferUsages::STORAGE;
        let size = self.frame.receivers.size;
        let tile_gaps = gpu.empty_buffer("blockers by tile", 8 * u64::from(self.tiles()), storage)?;
        let (screen, shown) = match self.frame.shot {
            Some(shot) => {
                let screen = Screen::new(shot, size, self.view, SAME_SURFACE);
                (gpu.buffer("screen", &[screen], wgpu::BufferUsages::UNIFORM)?, screen.show_lit(self.frame, self.view)?)
            }
            None => (
                gpu.empty_buffer("screen", size_of::<Screen>() as u64, wgpu::BufferUsages::UNIFORM)?,
                gpu.empty_buffer("what is seen", 16 * u64::from(size[0]) * u64::from(size[1]), storage)?,
            ),
        };
        let mut frame = gpu::pass::Frame::new(gpu);
        for (split, refined) in self.splits.iter().zip(refined) {
            let pipeline = self.pipeline("show", split.number);
            let all = split.points.len();
            let side = (all as f32).sqrt();
            for (is_refined, points, cell) in [(true, all, 1.0 / side), (false, split.first, 0.0)] {
                let job = SplitJob { points: points as f32, cell, ..self.job() };
                let job = gpu.buffer("job", &[job], wgpu::BufferUsages::UNIFORM)?;
                self.each_tile(
                    split,
                    |tile| refined[tile as usize] == is_refined,
                    |part, at, tiles, groups| {
                        let [blockers, cells] = &self.blockers[at];
                        frame
                            .compute("visibility", &pipeline)
                            .bind("receivers", &self.view.chunks[at].buffer)
                            .bind("members", &part.members)
                            .bind("work_tiles", tiles)
                            .bind("sums", &part.sums)
                            .bind("job", &job)
                            .bind("screen", &screen)
                            .bind("shown", &shown)
                            .bind("blockers", blockers)
                            .bind("cells", cells)
                            .bind("tile_gaps", &tile_gaps)
                            .dispatch(groups);
                    },
                )?;
            }
        }
        let answers = |chunk: &Chunk| gpu.empty_buffer("visibility", 8 * chunk.pixels.len() as u64, storage);
        let answers: Vec<wgpu::Buffer> = self.view.chunks.iter().map(answers).collect::<Result<_>>()?;
        let job = gpu.buffer("job", &[self.job()], wgpu::BufferUsages::UNIFORM)?;
        let pipeline = self.pipeline("smooth_out", 0);
        for ((chunk, [blockers, cells]), answers) in self.view.chunks.iter().zip(&self.blockers).zip(&answers) {
            frame
                .compute("filter", &pipeline)
                .bind("receivers", &chunk.buffer)
                .bind("blockers", blockers)
                .bind("cells", cells)
                .bind("tile_gaps", &tile_gaps)
                .bind("job", &job)
                .bind("screen", &screen)
                .bind("emitter", &self.emitter)
                .bind("shown", &shown)
                .bind("smoothed", answers)
                .dispatch([(chunk.pixels.len() as u32).div_ceil(WORKGROUP), 1, 1]);
        }
        add_passes(&mut self.passes, frame.finish()?);
        self.frame.progress.check()?;
        let answers: Vec<Vec<[f32; 2]>> =
            answers.iter().map(|answers| gpu.read_buffer(answers)).collect::<Result<_>>()?;
        let image = LightView::image(Some(self.view), self.frame, self.light, |chunk, i, receiver| {
            let [seen, share] = answers[chunk][i].map(f64::from);
            (if self.filters() { seen * fraction_above(self.light, receiver) } else { seen }, share)
        });
        Ok(LightImage {
            samples: self.splits.iter().map(|split| split.points.len() as u32).max().unwrap_or(0),
            shadow_maps: self.shadow_maps,
            texels: self.texels,
            passes: self.passes,
            ..image
        })
    }
}
