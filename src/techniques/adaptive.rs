//! Adaptive light sampling: maps from few points of the light, and more of them only where these differ. Schwärzler 2009, "Fast
//! Accurate Soft Shadows with Adaptive Light Source Sampling".
//!
//! A line is bisected, a square divided in four (Section 3.3.5). What the paper leaves open or gets wrong is a choice here:
//! - two maps differ, in the paper, where the depths that they hold towards a pixel differ (Eq. 3, 7): also where both block it, and
//!   not where a caster is nearer to its receiver than the tolerance. `test=visibility` compares what they see of the pixel;
//! - the paper divides by the share of differing pixels in all of the view (Eq. 4, and over the texels of a map instead of the
//!   pixels of the view): a small shadow is never divided, a leak never seen. `metric=tile` lets each 16 x 16 pixels decide for
//!   themselves;
//! - its weights (Eq. 5, 6) are off where a tree is uneven; `weights=trapezoid` are right;
//! - corners take half of what they stand for from beyond the light's edge. `points=centers` are the middles of cells, divided in
//!   three along each side, so that a middle stays one;
//! - with `evaluation=once` a point's answer is kept rather than its map, so that each map is read once, weights are known before they
//!   are needed, and where a tile asks for no division nothing is looked up: maps of a division hold no more than the tiles that do,
//!   at the same size of texels. Tiles that nothing can shadow are not looked up at all;
//! - `filter` averages V over the neighbours that a point's cell of the light would move shadows by, as far as the blockers found tell:
//!   steps between points become the ramps that they stand for, where a wider kernel of texels (Section 3.4.3) would blur contacts.
//!   What of the light is below a receiver's horizon is known then; points tell of the rest.

mod tree;

use std::ops::Range;
use std::sync::Arc;

use glam::{DVec2, DVec3, Vec3, Vec4};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use self::tree::{Added, Cell, Tree};
use super::{
    Context, Entry, Frame, LightImage, Needs, Parameters, Pass, Technique, add_passes, parse_parameters, schema_of,
};
use crate::gpu::center_map::emitter_of;
use crate::gpu::emission::Emission;
use crate::gpu::light_view::{self, Chunk, GpuReceiver, LightView, TILE, WORKGROUP, around, fraction_above, seen_of};
use crate::gpu::pass::Compute;
use crate::gpu::screen::{SAME_SURFACE, Screen};
use crate::gpu::shader::Pipeline;
use crate::gpu::shadow_map::{self, Keep, MapPoint, RenderedMaps, ShadowMaps, shown_areas};
use crate::gpu::{self, Gpu};
use crate::history::Shot;
use crate::receivers::Receiver;
use crate::scene::light::{Domain, Emitter};
use crate::scene::{AreaLight, Bounds, Shape};
use crate::{Error, Result, gpu_struct};

pub use self::tree::{Nodes, Weights};

/// Registered as `adaptive`.
pub const ENTRY: Entry = Entry {
    name: "adaptive",
    paper: "Schwärzler 2009, \"Fast Accurate Soft Shadows with Adaptive Light Source Sampling\"",
    summary: "averages shadow maps from as many points of the light as what the camera sees asks for",
    needs: Needs::Gpu,
    schema: schema_of::<Adaptive>,
    presets: &[("paper", PAPER), ("paper-line", PAPER_LINE), ("9", "max_depth=1")],
    demo: &["max_depth=1", "max_depth=2"],
    build,
};

/// The paper's area light (DirectX 10): ratios of depths, Eq. 6, texture arrays, 2 x 2 texels, maps of 512. Its thresholds are not
/// told: this one gives 14 to 25 maps of an area light on the scenes that the suite `papers` takes for theirs.
const PAPER: &str = "points=corners test=relative metric=printed epsilon=0.2 min_depth=0 max_depth=4 weights=paper \
                     evaluation=array filter=false kernel=2 map_size=512";

/// The paper's linear light (DirectX 9): differences of depths, all maps alike, added up as they come.
const PAPER_LINE: &str = "points=corners split=line test=absolute metric=printed epsilon=0.06 min_depth=0 max_depth=6 weights=equal \
                          evaluation=accumulation filter=false kernel=2 map_size=512";

/// Parameters of `adaptive`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Adaptive {
    /// Where the points of cells are.
    pub points: Nodes,
    /// How a light is divided.
    pub split: Split,
    /// What makes two maps differ at a pixel.
    pub test: Test,
    /// Depths along the light's normal that differ by this much are different, m (`test=absolute`).
    #[schemars(range(min = 0, max = 1e9))]
    pub gamma: f64,
    /// Depths whose ratio differs from 1 by this much are different (`test=relative`).
    #[schemars(range(min = 0, max = 1))]
    pub gamma_relative: f64,
    /// What the differing pixels are a share of.
    pub metric: Metric,
    /// A cell of the light is divided where a larger share of the pixels differs.
    #[schemars(range(min = 0, max = 1))]
    pub epsilon: f64,
    /// Where maps are compared.
    pub compare: View,
    /// Divisions that are made in any case: what few points of the light miss is found by those between.
    #[schemars(range(min = 0, max = 4))]
    pub min_depth: u32,
    /// Divisions at most: 3^d points a side, or 2^d + 1 with corners.
    #[schemars(range(min = 0, max = 6))]
    pub max_depth: u32,
    /// Points of the light at most, which keeps the time of a frame steady; where more are asked for, cells in which most pixels
    /// differ come first.
    #[schemars(range(min = 4, max = 6561))]
    pub max_maps: u32,
    /// What each map counts.
    pub weights: Weights,
    /// How maps are read.
    pub evaluation: Evaluation,
    /// Whether the steps between points are smoothed out: V is averaged over neighbours on the screen, as far as a point's cell of the
    /// light moves a shadow, and what of the light is below a receiver's horizon is not told by points.
    pub filter: bool,
    /// Texels a side of the kernel by which maps are read.
    #[schemars(range(min = 1, max = 15))]
    pub kernel: u32,
    /// Texels a side of each map that holds all receivers.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
}

/// How a light is divided.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Tubes as lines, all others as areas.
    Auto,
    /// Along the longer axis of a rectangle or tube alone, as if it had no width: in three, or by halves with corners.
    Line,
    /// Along both axes.
    Area,
}

/// What makes two maps differ at a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Test {
    /// One sees it and the other does not: any two of a cell's corners, or of its middle and those beside it.
    Visibility,
    /// Depths towards it differ by `gamma` (the paper's Eq. 3): at diagonally opposed corners, or
    /// at the middles of cells on opposite sides.
    Absolute,
    /// Depths towards it, from the plane of the light (of a sun, from that of the nearest caster), have a ratio that differs from 1 by
    /// `gamma_relative` (Eq. 7).
    Relative,
}

/// What the differing pixels are a share of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Metric {
    /// The receivers in 16 x 16 pixels: a cell is divided if in a tile where it differs some cell differs enough.
    Tile,
    /// All pixels of the view, those without receiver too.
    Image,
    /// The texels of a map, as the paper's Eq. 4 has it: more than 1 where the image has more pixels.
    Printed,
}

/// Where maps are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum View {
    /// At the camera's pixels.
    Camera,
    /// As the light's centre sees them, 256 x 256, wherever the camera stands; by depth alone.
    Light,
}

/// How maps are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Evaluation {
    /// Each once, its answers kept.
    Once,
    /// All at the end, from texture arrays (the paper's Section 3.4.2).
    Array,
    /// Each as it comes, added to an accumulation buffer (Section 3.4.1): weights must be equal.
    Accumulation,
}

impl Default for Adaptive {
    fn default() -> Self {
        Self {
            points: Nodes::Centers,
            split: Split::Auto,
            test: Test::Visibility,
            gamma: 0.1,
            gamma_relative: 0.01,
            metric: Metric::Tile,
            epsilon: 0.02,
            compare: View::Camera,
            min_depth: 1,
            max_depth: 2,
            max_maps: 81,
            weights: Weights::Trapezoid,
            evaluation: Evaluation::Once,
            filter: true,
            kernel: 1,
            map_size: 1024,
        }
    }
}

gpu_struct! {
    /// Twin of `Job` in `techniques/adaptive.wgsl`.
    struct Job {
        pub first: u32,
        pub count: u32,
        pub number: u32,
        pub width: u32,
        pub tile_columns: u32,
        pub tiles: u32,
        pub distant: u32,
        pub padding: u32,
        pub normal: Vec3,
        pub depth_offset: f32,
        pub divided: Vec4,
    }
}

gpu_struct! {
    /// Twin of `CellPoints` in `techniques/adaptive.wgsl`.
    struct CellPoints {
        pub others: [u32; 4],
        pub middle: u32,
        pub padding: u32,
        pub padding_2: [u32; 2],
    }
}

gpu_struct! {
    /// Twin of `Place` in `techniques/adaptive.wgsl`.
    struct Place {
        pub position: Vec3,
        pub weight: f32,
    }
}

/// Workgroups that read a tile.
const GROUPS_A_TILE: u32 = TILE * TILE / WORKGROUP;

/// Texels a side of the light centre's view.
const CENTER_SIZE: u32 = 256;

/// What points' answers, and maps that are kept, may take of the GPU's memory, bytes.
const MOST_BYTES: u64 = 4 << 30;

/// Cells that are compared in one go: their counts are read back together.
const CELLS_AT_ONCE: usize = 64;

/// Points whose bytes share a word; points of a dispatch.
const IN_WORD: usize = 4;

/// Cosine from which two maps look the same way.
const LOOKS_ALIKE: f32 = 0.99;

/// Sides of maps are multiples of it, texels: divisions ask for many sizes.
const SIZE_STEP: u32 = 32;

/// Twin of `SEEN_WHOLE` in `techniques/adaptive.wgsl`.
const SEEN_WHOLE: u32 = u32::MAX;

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<Adaptive>(&ENTRY, given)?;
    let refuse =
        |parameter: &str, message: &str| Err(Error::usage(format!("parameter {parameter} of adaptive"), message));
    if parameters.evaluation == Evaluation::Accumulation && parameters.weights != Weights::Equal {
        return refuse(
            "weights",
            "maps are added up before the weights are known; expected equal with evaluation=accumulation",
        );
    }
    if parameters.compare == View::Light && parameters.test == Test::Visibility {
        return refuse("test", "the light's centre sees no pixels; expected absolute or relative with compare=light");
    }
    if parameters.weights == Weights::Paper && parameters.points == Nodes::Centers {
        return refuse("weights", "the paper's are those of corners; expected trapezoid or equal with points=centers");
    }
    if parameters.min_depth > parameters.max_depth {
        return refuse("min_depth", "expected at most max_depth");
    }
    let least =
        Tree::new(parameters.points, parameters.split == Split::Line, parameters.min_depth, parameters.max_depth).len();
    if least > parameters.max_maps as usize {
        return refuse("max_maps", &format!("min_depth={} alone has {least} points", parameters.min_depth));
    }
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: Adaptive,
}

impl Adaptive {
    /// Whether a light is divided as a line.
    fn is_line(&self, light: &AreaLight) -> Result<bool> {
        let has_axis = matches!(light.shape, Shape::Rect { .. } | Shape::Tube { .. });
        match self.split {
            Split::Area => Ok(false),
            Split::Auto => Ok(matches!(light.shape, Shape::Tube { .. })),
            Split::Line if has_axis || light.shape.is_point() => Ok(has_axis),
            Split::Line => {
                let message =
                    format!("{:?} is a {}; only a rect or a tube is divided as a line", light.name, light.shape.name());
                Err(Error::usage("parameter split of adaptive", message))
            }
        }
    }

    /// Whether points' answers are kept.
    fn keeps_bytes(&self) -> bool {
        self.evaluation == Evaluation::Once || self.test == Test::Visibility
    }

    /// Whether points of a division are looked up in the tiles alone that want it.
    fn skips(&self) -> bool {
        self.evaluation == Evaluation::Once && self.test == Test::Visibility
    }

    /// Bytes that are kept of a receiver of the camera's.
    fn bytes_a_receiver(&self) -> u64 {
        let words = u64::from(self.max_maps).div_ceil(IN_WORD as u64);
        let depths =
            if self.test != Test::Visibility && self.compare == View::Camera { u64::from(self.max_maps) } else { 0 };
        4 * words.max(depths)
    }
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let parameters = &self.parameters;
        let is_line = parameters.is_line(light)?;
        let which = if parameters.skips() { light_view::Work::Shadowed } else { light_view::Work::All };
        let view = LightView::in_chunks(&self.gpu, frame, light, parameters.bytes_a_receiver(), which)?;
        let rows = u64::from(frame.receivers.size[1]);
        let Some(view) = view else {
            frame.progress.advance(rows)?;
            return Ok(LightView::image(None, frame, light, |_, _, _| (0.0, 0.0)));
        };
        let is_point = view.emitter.domain == Domain::Point;
        let (min_depth, max_depth) = if is_point { (0, 0) } else { (parameters.min_depth, parameters.max_depth) };
        let mut tree = Tree::new(parameters.points, is_line, min_depth, max_depth);
        if view.chunks.is_empty() {
            frame.progress.advance(rows)?;
            return Ok(LightView::image(Some(&view), frame, light, |_, _, _| (1.0, 1.0)));
        }
        let mut work = Work::new(parameters, frame, light, &view)?;
        let first: Vec<Added> =
            (0..if is_point { 1 } else { tree.len() }).map(|point| Added { point, cells: Vec::new() }).collect();
        work.add(&tree, &first, &[])?;
        let mut cells: Vec<Cell> = if is_point { Vec::new() } else { tree.leaves().to_vec() };
        loop {
            cells.retain(|cell| tree.is_divisible(cell));
            if cells.is_empty() {
                break;
            }
            let compared = work.compare(&tree, &cells)?;
            let chosen = choose(&tree, &compared, parameters);
            if chosen.is_empty() {
                break;
            }
            let divided: Vec<Cell> = chosen.iter().map(|compared| compared.cell).collect();
            let (parts, added) = tree.divide(&divided);
            work.add(&tree, &added, &chosen)?;
            if parameters.skips() {
                work.deepen(&compared, &divided);
            }
            cells = parts;
        }
        let weights = if is_point { vec![1.0] } else { tree.weights(parameters.weights) };
        let image = work.finish(&tree, &weights)?;
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

/// Which of the compared cells are divided: all that differ by more than allowed, and as many of them as there may be
/// points for, those first in which most pixels differ.
fn choose(tree: &Tree, compared: &[Compared], parameters: &Adaptive) -> Vec<Compared> {
    let mut wanted: Vec<&Compared> = compared.iter().filter(|compared| compared.share > parameters.epsilon).collect();
    let mut room = parameters.max_maps as usize - tree.len();
    let needs: usize = wanted.iter().map(|compared| tree.cost(&compared.cell)).sum();
    if needs > room {
        // Stable: of equals the first.
        wanted.sort_by_key(|compared| std::cmp::Reverse(compared.differing));
        wanted.retain(|compared| {
            // Middles of shared sides are counted twice, so that the room is never exceeded.
            let cost = tree.cost(&compared.cell);
            let fits = cost <= room;
            room -= if fits { cost } else { 0 };
            fits
        });
    }
    wanted.into_iter().cloned().collect()
}

/// A cell, and how its points differ, or those around it.
#[derive(Debug, Clone)]
struct Compared {
    cell: Cell,
    /// By the metric.
    share: f64,
    /// How much, in all.
    differing: u64,
    /// By tile, whether something differs in it or in one of those around it.
    tiles: Vec<bool>,
}

/// One light on its way.
struct Work<'a> {
    parameters: &'a Adaptive,
    frame: &'a Frame<'a>,
    light: &'a AreaLight,
    view: &'a LightView<'a>,
    /// By number.
    points: Vec<MapPoint>,
    /// The light centre's view, where maps are compared there: the texels of each face.
    center: Vec<Chunk>,
    /// Bounds of all that is in it.
    surfaces: Bounds,
    /// What is known of the receivers, by chunk.
    known: Vec<Known<'a>>,
    /// Of each chunk of what compares: depths.
    depths: Vec<Planes>,
    emitter: wgpu::Buffer,
    /// Maps that are kept.
    arrays: Vec<RenderedMaps>,
    emission: wgpu::Buffer,
    /// Texels read.
    texels: u64,
    /// By tile of the camera's, whether it is worked on.
    tiles: Vec<bool>,
    /// How often the light has been divided for each tile of the camera's.
    tile_depths: Vec<u32>,
    shadow_maps: u32,
    passes: Vec<Pass>,
}

/// What is known of a chunk of receivers.
struct Known<'a> {
    chunk: &'a Chunk,
    /// Its tiles in which something may hide some of the light.
    tiles: Vec<TileList>,
    /// Bytes of what each point is to them.
    planes: Planes,
    sums: wgpu::Buffer,
    blockers: wgpu::Buffer,
}

/// Tiles that are worked on in one dispatch: `array<vec4<u32>>` of their first receivers, how many they have, and bits of points.
struct TileList {
    buffer: wgpu::Buffer,
    /// Workgroups.
    groups: [u32; 3],
}

/// Lists of tiles, as long as a dispatch may be.
fn tile_lists(gpu: &Gpu, tiles: &[[u32; 4]]) -> Result<Vec<TileList>> {
    let most = gpu.device.limits().max_compute_workgroups_per_dimension / GROUPS_A_TILE;
    let list = |tiles: &[[u32; 4]]| {
        let buffer = gpu.buffer("needed", tiles, wgpu::BufferUsages::STORAGE)?;
        Ok(TileList { buffer, groups: [GROUPS_A_TILE * tiles.len() as u32, 1, 1] })
    };
    tiles.chunks(most as usize).map(list).collect()
}

/// A buffer of planes that grows as points are added: a value a receiver in each.
struct Planes {
    buffer: wgpu::Buffer,
    /// Bytes of a plane.
    plane: u64,
}

impl Planes {
    fn new(gpu: &Gpu, receivers: usize) -> Result<Self> {
        let plane = 4 * receivers as u64;
        Ok(Self { buffer: gpu.empty_buffer("answers", plane, wgpu::BufferUsages::STORAGE)?, plane })
    }

    /// Makes room for so many planes; what is recorded before, and not submitted, is lost.
    fn hold(&mut self, gpu: &Gpu, planes: usize) -> Result<()> {
        let needed = self.plane * planes as u64;
        if self.buffer.size() < needed {
            let larger = gpu.empty_buffer("answers", needed.max(2 * self.buffer.size()), wgpu::BufferUsages::STORAGE);
            // Twice as much may be more than there may be.
            let larger = larger.or_else(|_| gpu.empty_buffer("answers", needed, wgpu::BufferUsages::STORAGE))?;
            let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
            encoder.copy_buffer_to_buffer(&self.buffer, 0, &larger, 0, self.buffer.size());
            gpu.queue.submit([encoder.finish()]);
            self.buffer = larger;
        }
        Ok(())
    }
}

impl<'a> Work<'a> {
    fn new(
        parameters: &'a Adaptive,
        frame: &'a Frame<'a>,
        light: &'a AreaLight,
        view: &'a LightView<'a>,
    ) -> Result<Self> {
        let gpu = view.gpu;
        let known = |chunk: &'a Chunk| {
            let of_bytes =
                |label, bytes| gpu.empty_buffer(label, bytes * chunk.pixels.len() as u64, wgpu::BufferUsages::STORAGE);
            let (sums, blockers) = (of_bytes("sums", 16)?, of_bytes("blockers", 8)?);
            let of_tile = |(_, range): &(u32, Range<u32>)| [range.start, range.len() as u32, 0, 0];
            let tiles = tile_lists(gpu, &chunk.tiles.iter().map(of_tile).collect::<Vec<_>>())?;
            Ok(Known { chunk, tiles, planes: Planes::new(gpu, chunk.pixels.len())?, sums, blockers })
        };
        let mut work = Self {
            parameters,
            frame,
            light,
            view,
            points: Vec::new(),
            center: Vec::new(),
            surfaces: Bounds::EMPTY,
            known: view.chunks.iter().map(known).collect::<Result<_>>()?,
            depths: Vec::new(),
            emitter: gpu.buffer("emitter", &[emitter_of(view)], wgpu::BufferUsages::UNIFORM)?,
            arrays: Vec::new(),
            emission: gpu.buffer("emission", &[Emission::of(light)], wgpu::BufferUsages::UNIFORM)?,
            texels: 0,
            tiles: Vec::new(),
            tile_depths: Vec::new(),
            shadow_maps: 0,
            passes: Vec::new(),
        };
        let tiles = work.job(frame.receivers.size).tiles as usize;
        work.tile_depths = vec![parameters.min_depth; tiles];
        work.tiles = vec![false; tiles];
        for (tile, _) in view.chunks.iter().flat_map(|chunk| &chunk.tiles) {
            work.tiles[*tile as usize] = true;
        }
        if parameters.compare == View::Light {
            work.center = work.center_view()?;
        }
        if parameters.test != Test::Visibility {
            let depths = |chunk: &Chunk| Planes::new(gpu, chunk.pixels.len());
            work.depths = work.compared().1.iter().map(depths).collect::<Result<_>>()?;
        }
        Ok(work)
    }

    /// What is compared: the size of its image, and its receivers.
    fn compared(&self) -> ([u32; 2], &[Chunk]) {
        match self.parameters.compare {
            View::Camera => (self.frame.receivers.size, &self.view.chunks),
            View::Light => ([CENTER_SIZE; 2], &self.center),
        }
    }

    /// A shader's entry point.
    fn pipeline(&self, entry_point: &str) -> Arc<Pipeline<wgpu::ComputePipeline>> {
        let Adaptive { test, gamma, gamma_relative, kernel, .. } = *self.parameters;
        let is_relative = test == Test::Relative;
        let tolerance = if is_relative { gamma_relative } else { gamma / self.view.space.unit };
        let own: [(&str, f64); 6] = [
            ("kernel", kernel.into()),
            ("irradiance", f64::from(u8::from(self.frame.irradiance))),
            ("relative", f64::from(u8::from(is_relative))),
            ("filters", f64::from(u8::from(self.filters()))),
            ("tolerance", tolerance.min(f32::MAX.into())),
            ("tile_side", TILE.into()),
        ];
        let constants = [shadow_map::CONSTANTS, &own].concat();
        self.view.gpu.compute_pipeline("techniques/adaptive.wgsl", entry_point, &constants)
    }

    /// Notes for which tiles all the cells that they want have been divided.
    fn deepen(&mut self, compared: &[Compared], divided: &[Cell]) {
        let mut wanted = vec![false; self.tile_depths.len()];
        let mut refused = wanted.clone();
        for compared in compared {
            let is_divided = divided.contains(&compared.cell);
            for (tile, _) in compared.tiles.iter().enumerate().filter(|(_, differs)| **differs) {
                wanted[tile] = true;
                refused[tile] |= !is_divided;
            }
        }
        for ((depth, wanted), refused) in self.tile_depths.iter_mut().zip(wanted).zip(refused) {
            *depth += u32::from(wanted && !refused);
        }
    }

    /// Whether V is smoothed: there must be neighbours, and points that stand for some of the light.
    fn filters(&self) -> bool {
        self.parameters.filter && self.frame.shot.is_some() && self.view.emitter.domain != Domain::Point
    }

    /// What a dispatch over an image works on.
    fn job(&self, [width, height]: [u32; 2]) -> Job {
        let emitter = &self.view.emitter;
        let along = |position: DVec3| emitter.normal.dot(position);
        // A sun's depths are those from the nearest caster.
        let nearest = self.view.caster_bounds.corners().map(along).into_iter().fold(f64::INFINITY, f64::min);
        let from = match emitter.distant {
            true if nearest.is_finite() => nearest,
            true => 0.0,
            false => along(emitter.center),
        };
        let tile_columns = width.div_ceil(TILE);
        Job {
            first: 0,
            count: 0,
            number: 0,
            width,
            tile_columns,
            tiles: tile_columns * height.div_ceil(TILE),
            distant: u32::from(emitter.distant),
            padding: 0,
            normal: emitter.normal.as_vec3(),
            depth_offset: -from as f32,
            divided: Vec4::ZERO,
        }
    }

    fn uniform(&self, job: Job) -> Result<wgpu::Buffer> {
        self.view.gpu.buffer("job", &[job], wgpu::BufferUsages::UNIFORM)
    }

    /// Places what all receivers, or all that the light may reach, lies in.
    fn whole(&self) -> Vec<Bounds> {
        match self.parameters.compare {
            View::Camera => self.view.tiles.clone(),
            View::Light => vec![self.surfaces],
        }
    }

    /// The places that the light's centre sees.
    fn center_view(&mut self) -> Result<Vec<Chunk>> {
        let gpu = self.view.gpu;
        let center = [MapPoint { position: self.view.emitter.center, weight: 1.0 }];
        let surfaces = self.view.surfaces(self.frame, self.light)?;
        self.surfaces = surfaces.bounds().union(self.view.receiver_bounds);
        let maps = ShadowMaps::of(self.view, &surfaces, &center, &self.whole(), [CENTER_SIZE, 0], Keep::One)?;
        let count = CENTER_SIZE.pow(2);
        let bytes = u64::from(count) * size_of::<GpuReceiver>() as u64;
        let pipeline = self.pipeline("unproject");
        let mut frame = gpu::pass::Frame::new(gpu);
        let rendered = maps.render(&mut frame, 0)?;
        let mut faces = Vec::new();
        for first in 0..maps.count {
            let buffer = gpu.empty_buffer("the light centre's view", bytes, wgpu::BufferUsages::STORAGE)?;
            let uniform = self.uniform(Job { first, ..self.job([CENTER_SIZE; 2]) })?;
            frame
                .compute("comparison", &pipeline)
                .bind("faces", &rendered.faces)
                .bind("shadow_depth", &rendered.depth)
                .bind("job", &uniform)
                .bind("seen_by_center", &buffer)
                .dispatch([CENTER_SIZE / 8, CENTER_SIZE / 8, 1]);
            faces.push(Chunk::new((0..count).collect(), CENTER_SIZE, buffer));
        }
        add_passes(&mut self.passes, frame.finish()?);
        self.frame.progress.check()?;
        self.shadow_maps += maps.count;
        Ok(faces)
    }

    /// Where on the light a point of the tree is.
    fn map_point(&self, tree: &Tree, point: usize) -> MapPoint {
        let emitter = &self.view.emitter;
        let mut square = tree.place(point);
        if tree.is_line() && is_upright(emitter) {
            square = DVec2::new(square.y, square.x);
        }
        MapPoint { position: self.view.point_on(self.light, square), weight: 1.0 }
    }

    /// Renders the maps of new points and reads them, in the tiles alone that something may shadow; of those that a division has
    /// added, where the divided cells differ.
    fn add(&mut self, tree: &Tree, added: &[Added], divided: &[Compared]) -> Result<()> {
        let Adaptive { kernel, map_size, evaluation, .. } = *self.parameters;
        let gpu = self.view.gpu;
        let points: Vec<MapPoint> = added.iter().map(|added| self.map_point(tree, added.point)).collect();
        let margin = if kernel > 1 { kernel / 2 + 1 } else { 0 };
        let skips = self.parameters.skips();
        // Of each point: by tile, whether it is needed there, if that is asked.
        let needed = |added: &Added| -> Vec<bool> {
            let differs = |tile: usize| divided.is_empty() || added.cells.iter().any(|&cell| divided[cell].tiles[tile]);
            self.tiles.iter().enumerate().map(|(tile, &is_worked_on)| is_worked_on && differs(tile)).collect()
        };
        let needed: Vec<Vec<bool>> = added.iter().filter(|_| skips).map(needed).collect();
        let (boxes, size) = if skips { self.cropped(&points, &needed, margin) } else { (self.whole(), map_size) };
        self.check_memory(points.len(), size)?;
        self.count(added.len(), skips.then_some(&needed[..]));
        let keep = if evaluation == Evaluation::Array { Keep::All } else { Keep::One };
        let maps = ShadowMaps::of(self.view, &self.view.casters, &points, &boxes, [size, margin], keep)?;
        let first = self.points.len();
        self.points.extend(points);
        for known in self.known.iter_mut().filter(|_| self.parameters.keeps_bytes()) {
            known.planes.hold(gpu, self.points.len().div_ceil(IN_WORD))?;
        }
        for depths in &mut self.depths {
            depths.hold(gpu, self.points.len())?;
        }
        self.shadow_maps += maps.count;
        if skips && !divided.is_empty() {
            self.inherit(first, added, &needed, divided)?;
        }
        for batch in 0..maps.batches() {
            let mut frame = gpu::pass::Frame::new(gpu);
            let rendered = maps.render(&mut frame, batch)?;
            for group in rendered.range.clone().collect::<Vec<_>>().chunks(IN_WORD) {
                let job = Job {
                    first: (group[0] - rendered.range.start) as u32,
                    count: group.len() as u32,
                    number: (first + group[0]) as u32,
                    ..self.job(self.frame.receivers.size)
                };
                let needed = if skips { Some(&needed[group[0]..group[0] + group.len()]) } else { None };
                self.read_group(&mut frame, &rendered, job, needed)?;
            }
            add_passes(&mut self.passes, frame.finish()?);
            self.frame.progress.check()?;
            if evaluation == Evaluation::Array {
                self.arrays.push(rendered);
            }
        }
        Ok(())
    }

    /// Takes new points, numbered from `first`, for what others are where they are not looked up.
    fn inherit(&mut self, first: usize, added: &[Added], needed: &[Vec<bool>], divided: &[Compared]) -> Result<()> {
        let gpu = self.view.gpu;
        let other = |added: &Added| added.cells.first().map_or(SEEN_WHOLE, |&cell| divided[cell].cell.points[0] as u32);
        let others: Vec<u32> = added.iter().map(other).collect();
        let others = gpu.buffer("inherited", &others, wgpu::BufferUsages::STORAGE)?;
        let job = Job { number: first as u32, count: added.len() as u32, ..self.job(self.frame.receivers.size) };
        let job = self.uniform(job)?;
        let mut frame = gpu::pass::Frame::new(gpu);
        for known in &self.known {
            let lacks_some = |tile: u32| needed.iter().any(|needed| !needed[tile as usize]);
            let tiles = known.chunk.tiles.iter().filter(|(tile, _)| lacks_some(*tile));
            let tiles: Vec<[u32; 4]> = tiles.map(|(_, range)| [range.start, range.len() as u32, 0, 0]).collect();
            for tiles in tile_lists(gpu, &tiles)? {
                frame
                    .compute("inheritance", &self.pipeline("inherit"))
                    .bind("planes", &known.planes.buffer)
                    .bind("receivers", &known.chunk.buffer)
                    .bind("job", &job)
                    .bind("inherited", &others)
                    .bind("needed", &tiles.buffer)
                    .dispatch(tiles.groups);
            }
        }
        add_passes(&mut self.passes, frame.finish()?);
        Ok(())
    }

    /// Where the tiles are that need some of the points, and how large maps of them are: with texels no larger than
    /// where all receivers are held, in the map that looks the same way, or, if a crop has a view of its own, in the coarsest.
    fn cropped(&self, points: &[MapPoint], needed: &[Vec<bool>], margin: u32) -> (Vec<Bounds>, u32) {
        let size = self.parameters.map_size;
        let is_needed = |tile: &u32| needed.iter().any(|needed| needed[*tile as usize]);
        let tiles = self.view.tile_numbers.iter().zip(&self.view.tiles);
        let boxes: Vec<Bounds> = tiles.filter(|(tile, _)| is_needed(tile)).map(|(_, bounds)| *bounds).collect();
        if boxes.len() == self.view.tiles.len() {
            return (boxes, size);
        }
        // Points of one light see much the same: few of them tell how fine maps of all receivers are.
        let few = &points[..points.len().min(4)];
        let whole = shown_areas(self.view, few, &self.whole(), [size, margin]);
        let largest = |areas: &mut dyn Iterator<Item = f64>| areas.fold(0.0, f64::max);
        let coarsest = largest(&mut whole.iter().map(|(_, area)| *area));
        let areas = shown_areas(self.view, points, &boxes, [size, margin]);
        let finer = areas.iter().map(|(forward, area)| {
            let alike = whole.iter().filter(|(other, _)| other.dot(*forward) > LOOKS_ALIKE).map(|(_, area)| *area);
            let alike = largest(&mut alike.into_iter());
            area / if alike > 0.0 { alike } else { coarsest }
        });
        let same = (f64::from(size) * largest(&mut finer.into_iter()).sqrt()).ceil() as u32;
        // One map may stand for the four faces of a cube that hold all, but they have no more texels.
        let maps_a_point = [whole.len() as f64 / few.len() as f64, areas.len() as f64 / points.len() as f64];
        let most = (f64::from(size) * (maps_a_point[0] / maps_a_point[1]).max(1.0).sqrt()) as u32;
        (boxes, same.next_multiple_of(SIZE_STEP).min(most).min(self.view.gpu.device.limits().max_texture_dimension_2d))
    }

    /// Records what reads the maps of a job's points; `needed` are the tiles that need each of them, if not all do.
    fn read_group(
        &self,
        frame: &mut gpu::pass::Frame,
        maps: &RenderedMaps,
        job: Job,
        needed: Option<&[Vec<bool>]>,
    ) -> Result<()> {
        let gpu = self.view.gpu;
        let uniform = self.uniform(job)?;
        let all = (1 << job.count) - 1;
        let bits = |tile: u32| match needed {
            None => all,
            Some(needed) => (0..).zip(needed).map(|(i, needed)| u32::from(needed[tile as usize]) << i).sum(),
        };
        for known in self.known.iter().filter(|_| self.parameters.keeps_bytes()) {
            let of_tile = |(tile, range): &(u32, Range<u32>)| [range.start, range.len() as u32, bits(*tile), 0];
            let tiles = known.chunk.tiles.iter().map(of_tile).filter(|[.., bits, _]| *bits > 0);
            for tiles in tile_lists(gpu, &tiles.collect::<Vec<_>>())? {
                self.read(frame.compute("look-ups", &self.pipeline("look_up")), known, maps, &uniform)
                    .bind("planes", &known.planes.buffer)
                    .bind("needed", &tiles.buffer)
                    .dispatch(tiles.groups);
            }
        }
        for known in self.known.iter().filter(|_| self.parameters.evaluation == Evaluation::Accumulation) {
            self.read(frame.compute("visibility", &self.pipeline("accumulate")), known, maps, &uniform)
                .bind("sums", &known.sums)
                .bind("emission", &self.emission)
                .dispatch(groups(known.chunk));
        }
        let (size, compared) = self.compared();
        let Job { first, count, number, .. } = job;
        let uniform = self.uniform(Job { first, count, number, ..self.job(size) })?;
        for (chunk, depths) in compared.iter().zip(&self.depths) {
            frame
                .compute("look-ups", &self.pipeline("measure"))
                .bind("faces", &maps.faces)
                .bind("points", &maps.points)
                .bind("receivers", &chunk.buffer)
                .bind("shadow_depth", &maps.depth)
                .bind("job", &uniform)
                .bind("depths", &depths.buffer)
                .dispatch(groups(chunk));
        }
        Ok(())
    }

    /// Refuses what so many more points and their maps would take beyond [`MOST_BYTES`].
    fn check_memory(&self, added: usize, size: u32) -> Result<()> {
        let points = (self.points.len() + added) as u64;
        let bytes = if self.parameters.keeps_bytes() { receivers(&self.view.chunks) } else { 0 };
        let depths = if self.parameters.test == Test::Visibility { 0 } else { 4 * receivers(self.compared().1) };
        // A point has one map at least.
        let map = if self.parameters.evaluation == Evaluation::Array { 4 * u64::from(size).pow(2) } else { 0 };
        if points.saturating_mul(bytes + depths + map) <= MOST_BYTES {
            return Ok(());
        }
        let message = format!("{points} points of {:?} would take more than {} GB", self.light.name, MOST_BYTES >> 30);
        Err(Error::usage("parameter max_maps of adaptive", message))
    }

    /// Counts the texels that so many new points are read at, or those that are needed in some tiles alone.
    fn count(&mut self, points: usize, needed: Option<&[Vec<bool>]>) {
        let points = points as u64;
        let kernel = u64::from(self.parameters.kernel.pow(2));
        let own = receivers(&self.view.chunks);
        let population = population(self.job(self.frame.receivers.size).tiles as usize, &self.view.chunks);
        let in_tiles = |needed: &Vec<bool>| -> u64 {
            needed.iter().zip(&population).filter(|(needed, _)| **needed).map(|(_, &count)| u64::from(count)).sum()
        };
        if self.parameters.keeps_bytes() {
            self.texels += kernel * needed.map_or(points * own, |needed| needed.iter().map(in_tiles).sum());
        }
        if self.parameters.evaluation != Evaluation::Once {
            self.texels += kernel * points * own;
        }
        if self.parameters.test != Test::Visibility {
            self.texels += points * receivers(self.compared().1);
        }
    }

    /// Binds what reads maps.
    fn read<'f, 'g, 'r>(
        &'r self,
        pass: Compute<'f, 'g, 'r>,
        known: &'r Known,
        maps: &'r RenderedMaps,
        job: &'r wgpu::Buffer,
    ) -> Compute<'f, 'g, 'r> {
        pass.bind("faces", &maps.faces)
            .bind("points", &maps.points)
            .bind("receivers", &known.chunk.buffer)
            .bind("shadow_depth", &maps.depth)
            .bind("job", job)
            .bind("emitter", &self.emitter)
            .bind("blockers", &known.blockers)
    }

    /// How cells differ.
    fn compare(&mut self, tree: &Tree, cells: &[Cell]) -> Result<Vec<Compared>> {
        let gpu = self.view.gpu;
        let by_visibility = self.parameters.test == Test::Visibility;
        let pipeline = self.pipeline(if by_visibility { "compare_visibility" } else { "compare_depths" });
        let (size, chunks) = self.compared();
        let job = self.job(size);
        let uniform = self.uniform(self.job(size))?;
        let tiles = job.tiles as usize;
        let population = population(tiles, chunks);
        let faces = if self.parameters.compare == View::Light { chunks.len() } else { 1 };
        let all = f64::from(size[0]) * f64::from(size[1]) * faces as f64;
        let Adaptive { metric, map_size, kernel, .. } = *self.parameters;
        // What a receiver adds at most.
        let most = if by_visibility { f64::from(kernel.pow(2)) } else { 1.0 };
        let mut found = Vec::with_capacity(cells.len());
        // Of the cell that differs most there.
        let mut tile_shares = vec![0.0f64; tiles];
        for cells in cells.chunks(CELLS_AT_ONCE) {
            let bytes = 8 * (cells.len() * tiles) as u64;
            let differences = gpu.empty_buffer("differences", bytes, wgpu::BufferUsages::STORAGE)?;
            let points = |cell: &Cell| CellPoints {
                others: tree.around(cell).map(|point| point as u32),
                middle: cell.points[0] as u32,
                padding: 0,
                padding_2: [0; 2],
            };
            let points: Vec<CellPoints> = cells.iter().map(points).collect();
            let points = gpu.buffer("cells", &points, wgpu::BufferUsages::STORAGE)?;
            let mut frame = gpu::pass::Frame::new(gpu);
            for (chunk, depths) in self.compared().1.iter().zip(&self.depths) {
                frame
                    .compute("comparison", &pipeline)
                    .bind("receivers", &chunk.buffer)
                    .bind("depths", &depths.buffer)
                    .bind("job", &uniform)
                    .bind("cells", &points)
                    .bind("differences", &differences)
                    .dispatch(groups(chunk));
            }
            for known in self.known.iter().filter(|_| by_visibility) {
                for tiles in &known.tiles {
                    frame
                        .compute("comparison", &pipeline)
                        .bind("receivers", &known.chunk.buffer)
                        .bind("planes", &known.planes.buffer)
                        .bind("job", &uniform)
                        .bind("cells", &points)
                        .bind("needed", &tiles.buffer)
                        .bind("differences", &differences)
                        .dispatch(tiles.groups);
                }
            }
            add_passes(&mut self.passes, frame.finish()?);
            self.frame.progress.check()?;
            let counts: Vec<u32> = gpu.read_buffer(&differences)?;
            for (cell, counts) in cells.iter().zip(counts.chunks_exact(2 * tiles)) {
                let (one, other) = counts.split_at(tiles);
                let sum = |pair: &[u32]| pair.iter().map(|&count| u64::from(count)).sum::<u64>();
                let differing = sum(one).max(sum(other));
                let counts: Vec<u32> = one.iter().zip(other).map(|(&a, &b)| a.max(b)).collect();
                for ((share, &count), &of) in tile_shares.iter_mut().zip(&counts).zip(&population) {
                    *share = share.max(f64::from(count) / (most * f64::from(of.max(1))));
                }
                found.push((*cell, differing, counts));
            }
        }
        let share_of = |(cell, differing, counts): (Cell, u64, Vec<u32>)| {
            let mut near = vec![false; counts.len()];
            for tile in (0..job.tiles).filter(|&tile| counts[tile as usize] > 0) {
                around(tile, job.tile_columns, job.tiles).for_each(|tile| near[tile as usize] = true);
            }
            let share = match metric {
                Metric::Tile => {
                    let of_tile = |(&count, &share): (&u32, &f64)| if count > 0 { share } else { 0.0 };
                    counts.iter().zip(&tile_shares).map(of_tile).fold(0.0, f64::max)
                }
                // A map of the light centre's view has its own number of texels.
                Metric::Printed if self.parameters.compare == View::Camera => {
                    differing as f64 / (most * f64::from(map_size).powi(2))
                }
                Metric::Printed | Metric::Image => differing as f64 / (most * all),
            };
            Compared { cell, share, differing, tiles: near }
        };
        Ok(found.into_iter().map(share_of).collect())
    }

    /// Adds all points up by what they count.
    fn finish(mut self, tree: &Tree, weights: &[f64]) -> Result<LightImage> {
        let gpu = self.view.gpu;
        let weights: Vec<f32> = weights.iter().map(|&weight| weight as f32).collect();
        // Added up in the order of the shader, so that what is seen whole comes out as 1.
        let whole = f64::from(weights.iter().fold(0.0, |sum, weight| sum + weight));
        let mut frame = gpu::pass::Frame::new(gpu);
        match self.parameters.evaluation {
            // All is added up already.
            Evaluation::Accumulation => {}
            Evaluation::Array => {
                let pipeline = self.pipeline("evaluate");
                let uniform = self.uniform(self.job(self.frame.receivers.size))?;
                let mut first = 0;
                for maps in &self.arrays {
                    let counts = &weights[first..first + maps.range.len()];
                    first += maps.range.len();
                    let counts = gpu.buffer("weights", counts, wgpu::BufferUsages::STORAGE)?;
                    for known in &self.known {
                        self.read(frame.compute("visibility", &pipeline), known, maps, &uniform)
                            .bind("sums", &known.sums)
                            .bind("weights", &counts)
                            .bind("emission", &self.emission)
                            .dispatch(groups(known.chunk));
                    }
                }
            }
            Evaluation::Once => {
                let place = |(point, &weight): (&MapPoint, &f32)| Place { position: point.position.as_vec3(), weight };
                let places: Vec<Place> = self.points.iter().zip(&weights).map(place).collect();
                let places = gpu.buffer("points", &places, wgpu::BufferUsages::STORAGE)?;
                let uniform = self.uniform(self.job(self.frame.receivers.size))?;
                for known in &self.known {
                    for tiles in &known.tiles {
                        frame
                            .compute("visibility", &self.pipeline("sum"))
                            .bind("receivers", &known.chunk.buffer)
                            .bind("planes", &known.planes.buffer)
                            .bind("places", &places)
                            .bind("needed", &tiles.buffer)
                            .bind("job", &uniform)
                            .bind("sums", &known.sums)
                            .bind("emission", &self.emission)
                            .dispatch(tiles.groups);
                    }
                }
            }
        }
        add_passes(&mut self.passes, frame.finish()?);
        self.frame.progress.check()?;
        let image = match self.frame.shot.filter(|_| self.filters()) {
            None => {
                let read = |known: &Known| gpu.read_buffer(&known.sums);
                let sums: Vec<Vec<[f32; 4]>> = self.known.iter().map(read).collect::<Result<_>>()?;
                self.image(|chunk, i, _| seen_of(sums[chunk][i], whole))
            }
            Some(shot) => {
                let smoothed = self.smoothed(shot, tree)?;
                self.image(|chunk, i, receiver| {
                    let [seen, share] = smoothed[chunk][i].map(f64::from);
                    (seen * fraction_above(self.light, receiver), share)
                })
            }
        };
        Ok(LightImage {
            samples: self.points.len() as u32,
            shadow_maps: self.shadow_maps,
            texels: self.texels,
            passes: self.passes,
            ..image
        })
    }
}

impl Work<'_> {
    /// The light's image by V and E/E₀ of the receivers of chunks.
    fn image(&self, answer: impl Fn(usize, usize, &Receiver) -> (f64, f64) + Sync) -> LightImage {
        LightView::image(Some(self.view), self.frame, self.light, answer)
    }

    /// V, as a part of the light above their horizons, and E/E₀ of each chunk's receivers, averaged over what a cell of the light moves
    /// shadows by.
    fn smoothed(&mut self, shot: &Shot, tree: &Tree) -> Result<Vec<Vec<[f32; 2]>>> {
        let gpu = self.view.gpu;
        let size = self.frame.receivers.size;
        let storage = wgpu::BufferUsages::STORAGE;
        let screen = Screen::new(shot, size, self.view, SAME_SURFACE);
        let shown = screen.show_lit(self.frame, self.view)?;
        let screen = gpu.buffer("screen", &[screen], wgpu::BufferUsages::UNIFORM)?;
        let Job { tile_columns, tiles, .. } = self.job(size);
        let finest = |tile: u32| {
            let near = around(tile, tile_columns, tiles);
            near.map(|tile| self.tile_depths[tile as usize]).max().expect("the tile itself")
        };
        let sides: Vec<f32> = match self.parameters.skips() {
            // A kernel reaches into the tiles around.
            true => (0..tiles).map(|tile| tree.side_at(finest(tile)) as f32).collect(),
            false => vec![tree.side_at(tree.depth()) as f32; self.tile_depths.len()],
        };
        let sides = gpu.buffer("sides", &sides, storage)?;
        let is_upright = is_upright(&self.view.emitter);
        let divided = [!tree.is_line() || !is_upright, !tree.is_line() || is_upright].map(|is| f32::from(u8::from(is)));
        let divided = Vec4::new(divided[0], divided[1], 0.0, 0.0);
        let uniform = self.uniform(Job { divided, ..self.job(size) })?;
        let answers = |known: &Known| gpu.empty_buffer("visibility", 8 * known.chunk.pixels.len() as u64, storage);
        let answers: Vec<wgpu::Buffer> = self.known.iter().map(answers).collect::<Result<_>>()?;
        let tile_gaps = gpu.empty_buffer("blockers by tile", 8 * u64::from(tiles), storage)?;
        let mut frame = gpu::pass::Frame::new(gpu);
        for known in &self.known {
            frame
                .compute("filter", &self.pipeline("show"))
                .bind("blockers", &known.blockers)
                .bind("tile_gaps", &tile_gaps)
                .bind("receivers", &known.chunk.buffer)
                .bind("sums", &known.sums)
                .bind("job", &uniform)
                .bind("screen", &screen)
                .bind("shown", &shown)
                .dispatch(groups(known.chunk));
        }
        for (known, answers) in self.known.iter().zip(&answers) {
            frame
                .compute("filter", &self.pipeline("smooth_out"))
                .bind("receivers", &known.chunk.buffer)
                .bind("blockers", &known.blockers)
                .bind("tile_gaps", &tile_gaps)
                .bind("sides", &sides)
                .bind("job", &uniform)
                .bind("screen", &screen)
                .bind("emitter", &self.emitter)
                .bind("shown", &shown)
                .bind("smoothed", answers)
                .dispatch(groups(known.chunk));
        }
        add_passes(&mut self.passes, frame.finish()?);
        answers.iter().map(|answers| gpu.read_buffer(answers)).collect()
    }
}

/// Whether the longer axis of a light runs along v.
fn is_upright(emitter: &Emitter) -> bool {
    emitter.half_v.length() > emitter.half_u.length()
}

/// Receivers by tile of an image.
fn population(tiles: usize, chunks: &[Chunk]) -> Vec<u32> {
    let mut population = vec![0; tiles];
    for (tile, range) in chunks.iter().flat_map(|chunk| &chunk.tiles) {
        population[*tile as usize] += range.len() as u32;
    }
    population
}

/// Receivers of all chunks.
fn receivers(chunks: &[Chunk]) -> u64 {
    chunks.iter().map(|chunk| chunk.pixels.len() as u64).sum()
}

/// Workgroups for a chunk.
fn groups(chunk: &Chunk) -> [u32; 3] {
    [(chunk.pixels.len() as u32).div_ceil(WORKGROUP), 1, 1]
}
