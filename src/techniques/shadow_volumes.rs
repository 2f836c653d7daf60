//! Soft shadow volumes: the outline of the casters as the light's centre sees it, and what each of its edges hides of the light.
//! Assarsson and Akenine-Möller 2003, "A Geometry-based Soft Shadow Volume Algorithm using Graphics Hardware"; the rival in Atty 2006.
//!
//! No texels, no bias: where the outline that the light's centre sees is the one that all of the light sees, and nothing is hidden
//! twice, V is exact to the roundings of `f32`. So it is for flat plates, edges, and boxes that show the light one face.
//!
//! # How
//! Of closed surfaces, the triangles that face the light's centre are sheets that hide it; of open ones, all are. An edge is on the
//! outline as often as sheets end at it, whatever number of faces meet there. For each receiver, edges that it sees before the light are
//! projected onto it, and the sector of the light beyond each is added or taken away in closed form (rectangles and ellipses as
//! they are) from the number of sheets before the light's centre. That number is found by the paper in a stencil buffer, by volumes
//! between the camera and the receiver, which asks for a camera and a first volume count. Here the way from the receiver to the
//! light's centre is held against the sheets themselves: by the very signs that outline edges have, so that a pixel at which
//! the centre is just hidden is not half hidden too much. A shadow map would not agree with the edges to a texel.
//!
//! Tiles of 16 × 16 pixels list the edges of which their receivers may see something before the light (in the paper: whose wedges
//! they are in), and the sheets that may hide its centre, in an order of their own: the same sums on every run.
//!
//! # Its faults
//! - What two casters hide counts twice (the paper; V ends at 0). `points` on the light tell how often each of them is hidden, and what
//!   is too much on them is taken back: of what nothing hides twice, nothing is, so that exact answers stay exact.
//! - One outline stands for those that other points of the light see. Seen from the side, a ball's shadow lacks what the light's rim
//!   sees of it, a box's what its sides hide. What is edge on to the centre, a wall below it, hides nothing.
//! - A caster through the light itself, or through the receiver's tangent plane within the rounding of its place, is cut off there without
//!   an outline.
//! - Surfaces that are closed but for a hole, or whose triangles do not agree which side is the front, are open: what is between their
//!   front and back is hidden twice.
//! - Where the tangent plane of a receiver has the light's centre behind it, the paper's choices let all that is before the receiver hide
//!   it. With `points` sheets are counted from a point above the plane, and V is the share of the points there that nothing hides:
//!   exact where nothing or all is hidden, else to the points' spacing.
//! - Spheres and tubes are the disc or rectangle that they are for the middle of the receivers, turned to each.
//! - A smooth mesh of many small triangles costs more than a map: a tile looks at all sheets before it, one by one.
//! - Cut-outs have no edges: refused.

use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use glam::{DVec3, Vec3, Vec4};
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::min_max_backprojection::turns;
use super::{
    Context, Entry, Frame, LightImage, Needs, Parameters, Pass, Technique, add_passes, parse_parameters, schema_of,
};
use crate::geometry::shaft::Shaft;
use crate::geometry::surface::Surface;
use crate::gpu::Gpu;
use crate::gpu::center_map::emitter_of;
use crate::gpu::light_view::{self, Chunk, LightView, TILE, WORKGROUP, fraction_above};
use crate::gpu::pass::Frame as GpuFrame;
use crate::gpu::shader::Pipeline;
use crate::gpu_struct;
use crate::progress::ms_since;
use crate::sampling::{Pattern, Sampler, on_domain};
use crate::scene::light::Domain;
use crate::scene::{AreaLight, Bounds};
use crate::{Error, Result};

/// Registered as `shadow-volumes`.
pub const ENTRY: Entry = Entry {
    name: "shadow-volumes",
    paper: "Assarsson, Akenine-Möller 2003, \"A Geometry-based Soft Shadow Volume Algorithm using Graphics Hardware\"",
    summary: "the outline of casters from the light's centre; what each of its edges hides of the light in closed form, without a map",
    needs: Needs::Gpu,
    schema: schema_of::<ShadowVolumes>,
    presets: &[("paper", "points=0")],
    demo: &["points=0", ""],
    build,
};

/// Parameters of `shadow-volumes`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ShadowVolumes {
    /// Points of the light, a multiple of 4, on which what several casters hide counts once. 0: it counts as often as it is hidden
    /// (the paper).
    #[schemars(range(min = 0, max = 256))]
    pub points: u32,
}

impl Default for ShadowVolumes {
    fn default() -> Self {
        Self { points: 64 }
    }
}

gpu_struct! {
    /// Twin of `Portion` in `techniques/shadow_volumes.wgsl`.
    struct Portion {
        pub first_tile: u32,
        pub tiles: u32,
        pub chunks: u32,
        pub first: u32,
        pub most: u32,
        pub is_last: u32,
        pub padding: [u32; 2],
    }
}

gpu_struct! {
    /// Twin of `Tile` in `techniques/shadow_volumes.wgsl`.
    struct Tile {
        pub first_plane: u32,
        pub planes: u32,
        pub first: u32,
        pub count: u32,
        pub receivers_begin: u32,
        pub receivers_end: u32,
        pub padding: [u32; 2],
    }
}

gpu_struct! {
    /// Twin of `Sum` in `techniques/shadow_volumes.wgsl`.
    struct Sum {
        pub layers: i32,
        pub share: f32,
        pub edges: u32,
        pub padding: u32,
    }
}

/// Points of a light in the shader's constants.
const MOST_POINTS: usize = 256;

/// Items whose bounds tiles look at together.
const CHUNK: usize = 64;

/// Rounds of loops that an invocation takes: software GPUs end them after 2^16.
const MOST_ROUNDS: u32 = 60_000;

/// Triangles, and edges on the outline, that tiles can look at: all chunks of them in one loop.
const MOST_ITEMS: usize = CHUNK * MOST_ROUNDS as usize;

/// Counts by tile and chunk that are held at a time.
const MOST_COUNTS: usize = 1 << 23;

/// Entries of lists that are held at a time.
const MOST_LISTED: u64 = 1 << 24;

/// Workgroups along one axis of a dispatch, in any implementation of WebGPU.
const MOST_GROUPS: u32 = 65_535;

/// How far a receiver, a vertex or the light's centre may be from where the planes around a tile know it to be, relative to what is
/// farthest from the origin: a handful of roundings of 2^-24.
const ROUNDING: f64 = 1.0 / (1 << 21) as f64;

const SHADER: &str = "techniques/shadow_volumes.wgsl";

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<ShadowVolumes>(&ENTRY, given)?;
    if !parameters.points.is_multiple_of(4) {
        let message = format!("expected a multiple of 4, found {}", parameters.points);
        return Err(Error::usage("parameter points of shadow-volumes", message));
    }
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: ShadowVolumes,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let gpu = &*self.gpu;
        // Between portions, each receiver has its sum and its points' counts.
        let bytes = size_of::<Sum>() as u64 + 4 * u64::from(self.parameters.points);
        let Some(view) = LightView::in_chunks(gpu, frame, light, bytes, light_view::Work::All)? else {
            frame.progress.advance(u64::from(frame.receivers.size[1]))?;
            return Ok(LightView::image(None, frame, light, |_, _, _| (0.0, 0.0)));
        };
        let mut passes = Vec::new();
        let casters = Casters::new(&view, frame, light, &mut passes)?;
        let work = Work { built: self, view: &view, frame, light, casters: &casters };
        let visibility: Vec<Vec<f32>> =
            view.chunks.iter().map(|chunk| work.visibility(chunk, &mut passes)).collect::<Result<_>>()?;
        let image = LightView::image(Some(&view), frame, light, |chunk, i, receiver| {
            // The paper's choices do not cut a light whose centre is behind the horizon.
            let seen = f64::from(visibility[chunk][i]).min(fraction_above(light, receiver));
            (seen, seen)
        });
        frame.progress.advance(u64::from(frame.receivers.size[1]))?;
        Ok(LightImage { samples: self.parameters.points.max(1), approximate: true, passes, ..image })
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(&self.parameters).expect("parameters are numbers")
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(&self.gpu)
    }
}

// ---------------------------------------------------------------------------------------------------------------- casters

/// What hides a light's centre, and its outline.
struct Casters {
    emitter: wgpu::Buffer,
    positions: wgpu::Buffer,
    sheets: Items,
    outline: Items,
}

/// Triangles or edges, as tiles list them.
struct Items {
    count: usize,
    /// Corners, and how often it counts; an edge's second end twice.
    items: wgpu::Buffer,
    /// Around each [`CHUNK`] of them: least and largest.
    bounds: wgpu::Buffer,
}

impl Casters {
    fn new(view: &LightView, frame: &Frame, light: &AreaLight, passes: &mut Vec<Pass>) -> Result<Self> {
        let (gpu, scene) = (view.gpu, frame.scene);
        let instances = view.casters.instances();
        let of = |&instance: &usize| &scene.meshes[scene.instances[instance].mesh];
        for instance in &instances {
            let is_cut_out = of(instance).material.is_some_and(|at| scene.materials[at].cutout.is_some());
            if is_cut_out {
                let node = &scene.nodes[scene.instances[*instance].node].name;
                let what = format!("shadow-volumes of light {:?}", light.name);
                return Err(Error::usage(what, format!("{node:?} has cut-outs (alphaMode MASK), which have no edges")));
            }
        }
        let count: usize = instances.iter().map(|instance| of(instance).triangles.len()).sum();
        if count > MOST_ITEMS {
            let what = format!("shadow-volumes of light {:?}", light.name);
            return Err(Error::usage(what, format!("{count} triangles may hide it, and {MOST_ITEMS} are allowed")));
        }

        let start = Instant::now();
        let mut meshes: Vec<usize> = instances.iter().map(|&instance| scene.instances[instance].mesh).collect();
        meshes.sort_unstable();
        meshes.dedup();
        let surfaces: FxHashMap<usize, Surface> =
            meshes.into_par_iter().map(|mesh| (mesh, Surface::of(&scene.meshes[mesh]))).collect();
        frame.progress.check()?;
        let mut positions: Vec<Vec4> = Vec::new();
        let (mut triangles, mut edges, mut sides) = (Vec::new(), Vec::new(), Vec::new());
        for &instance in &instances {
            let instance = &scene.instances[instance];
            let surface = &surfaces[&instance.mesh];
            let (vertex, triangle, side) = (positions.len() as u32, triangles.len() as u32, sides.len() as u32);
            let placed = |position: &Vec3| {
                let position_scene = instance.scene_from_mesh.transform_point3(position.as_dvec3());
                ((position_scene - view.space.origin) / view.space.unit).as_vec3().extend(0.0)
            };
            positions.par_extend(surface.positions.par_iter().map(placed));
            triangles.extend(surface.triangles.iter().map(|of| {
                let [a, b, c] = of.corners.map(|corner| vertex + corner);
                [a, b, c, u32::from(of.is_closed)]
            }));
            edges.extend(surface.edges.iter().map(|edge| {
                let [from, to] = edge.ends.map(|end| vertex + end);
                [from, to, side + edge.first, edge.count]
            }));
            sides.extend(surface.sides.iter().map(|of| 2 * (triangle + of.triangle) + u32::from(of.is_reversed)));
        }
        note(passes, "surfaces", start);

        let storage = wgpu::BufferUsages::STORAGE;
        let emitter = gpu.buffer("emitter", &[emitter_of(view)], wgpu::BufferUsages::UNIFORM)?;
        let vertices = gpu.buffer("the casters' vertices", &positions, storage)?;
        let [sheets, outline] =
            [&triangles, &edges].map(|items| gpu.empty_buffer("the casters' outline", 4 * items.len() as u64, storage));
        let (sheets, outline) = (sheets?, outline?);
        if !triangles.is_empty() {
            let corners = gpu.buffer("the casters' triangles", &triangles, storage)?;
            let ends = gpu.buffer("the casters' edges", &edges, storage)?;
            let sides = gpu.buffer("the sides of the casters' edges", &sides, storage)?;
            let mut recorded = GpuFrame::new(gpu);
            recorded
                .compute("outline", &gpu.compute_pipeline(SHADER, "find_sheets", &[]))
                .bind("positions", &vertices)
                .bind("triangles", &corners)
                .bind("emitter", &emitter)
                .bind("sheets", &sheets)
                .dispatch(groups(triangles.len()));
            recorded
                .compute("outline", &gpu.compute_pipeline(SHADER, "find_outline", &[]))
                .bind("edges", &ends)
                .bind("sides", &sides)
                .bind("sheets", &sheets)
                .bind("outline", &outline)
                .dispatch(groups(edges.len()));
            add_passes(passes, recorded.finish()?);
        }
        frame.progress.check()?;
        let start = Instant::now();
        let (mut on_sheets, mut on_outline): (Vec<i32>, Vec<i32>) =
            (gpu.read_buffer(&sheets)?, gpu.read_buffer(&outline)?);
        // Buffers are never empty.
        on_sheets.truncate(triangles.len());
        on_outline.truncate(edges.len());
        let weighed = |[a, b, c]: [u32; 3], times: i32| (times != 0).then_some([a, b, c, times.cast_unsigned()]);
        let sheets = triangles.iter().zip(&on_sheets).filter_map(|(&[a, b, c, _], &times)| weighed([a, b, c], times));
        let outline = edges.iter().zip(&on_outline).filter_map(|(&[a, b, ..], &times)| weighed([a, b, b], times));
        let outline: Vec<[u32; 4]> = outline.collect();
        if outline.len() > MOST_ITEMS {
            let what = format!("shadow-volumes of light {:?}", light.name);
            let message = format!("{} edges may hide it, and {MOST_ITEMS} are allowed", outline.len());
            return Err(Error::usage(what, message));
        }
        // A point has no penumbra.
        let outline = if view.emitter.domain == Domain::Point { Vec::new() } else { outline };
        let casters = Self {
            emitter,
            sheets: Items::new(gpu, &positions, sheets.collect())?,
            outline: Items::new(gpu, &positions, outline)?,
            positions: vertices,
        };
        note(passes, "surfaces", start);
        Ok(casters)
    }
}

impl Items {
    fn new(gpu: &Gpu, positions: &[Vec4], mut items: Vec<[u32; 4]>) -> Result<Self> {
        // Neighbours in space are neighbours in chunks.
        items.par_sort_by_cached_key(|item| morton(positions[item[0] as usize].truncate()));
        let around = |chunk: &[[u32; 4]]| {
            let corners = chunk.iter().flat_map(|[a, b, c, _]| [a, b, c]).map(|&corner| positions[corner as usize]);
            let empty = (Vec4::INFINITY, Vec4::NEG_INFINITY);
            let (low, high) = corners.fold(empty, |(low, high), at| (low.min(at), high.max(at)));
            [low, high]
        };
        let bounds: Vec<[Vec4; 2]> = items.par_chunks(CHUNK).map(around).collect();
        let storage = wgpu::BufferUsages::STORAGE;
        Ok(Self {
            count: items.len(),
            items: gpu.buffer("the casters' outline", &items, storage)?,
            bounds: gpu.buffer("bounds of the casters' outline", &bounds, storage)?,
        })
    }
}

/// The place of a position, within 1 of the origin along each axis, on a curve that keeps neighbours together (Morton 1966).
fn morton(position: Vec3) -> u32 {
    let spread = |x: f32| {
        let cell = (512.0 * (x + 1.0)).clamp(0.0, 1023.0) as u32;
        (0..10).fold(0, |bits, at| bits | (cell >> at & 1) << (3 * at))
    };
    spread(position.x) | spread(position.y) << 1 | spread(position.z) << 2
}

/// Adds the time since `start` to a pass's.
fn note(passes: &mut Vec<Pass>, name: &'static str, start: Instant) {
    add_passes(passes, vec![Pass { name, ms: ms_since(start) }]);
}

/// Workgroups for so many invocations.
fn groups(count: usize) -> [u32; 3] {
    let all = (count as u32).div_ceil(WORKGROUP);
    [all.min(MOST_GROUPS), all.div_ceil(MOST_GROUPS), 1]
}

// ---------------------------------------------------------------------------------------------------------------- tiles

/// All that V of a chunk of receivers is found from.
struct Work<'a> {
    built: &'a Built,
    view: &'a LightView<'a>,
    frame: &'a Frame<'a>,
    light: &'a AreaLight,
    casters: &'a Casters,
}

/// Receivers of a tile and the planes around what may matter to them.
struct Bounded {
    receivers: Range<u32>,
    planes: Vec<Vec4>,
}

/// Tiles whose lists are on the GPU, ready for what reads them.
struct Listed<'a> {
    items: &'a Items,
    tiles: &'a wgpu::Buffer,
    listed: &'a wgpu::Buffer,
    /// The longest list of a tile.
    longest: u32,
    range: Range<u32>,
}

impl Work<'_> {
    fn pipeline(&self, entry_point: &str) -> Arc<Pipeline<wgpu::ComputePipeline>> {
        let constants = [("turns", turns(self.light.shape)), ("point_count", f64::from(self.built.parameters.points))];
        self.view.gpu.compute_pipeline(SHADER, entry_point, &constants)
    }

    fn portion(&self, portion: Portion) -> Result<wgpu::Buffer> {
        self.view.gpu.buffer("portion", &[portion], wgpu::BufferUsages::UNIFORM)
    }

    /// V of receivers.
    fn visibility(&self, chunk: &Chunk, passes: &mut Vec<Pass>) -> Result<Vec<f32>> {
        let gpu = self.view.gpu;
        let count = chunk.pixels.len() as u64;
        let storage = wgpu::BufferUsages::STORAGE;
        let sums = gpu.empty_buffer("sums", size_of::<Sum>() as u64 * count, storage)?;
        let visibility = gpu.empty_buffer("visibility", 4 * count, storage)?;

        let layers = self.pipeline("count_layers");
        self.each_list(&self.casters.sheets, &self.tiles(chunk, true), passes, |lists, passes| {
            self.each_portion(lists, MOST_ROUNDS, passes, |recorded, portion, groups| {
                recorded
                    .compute("sheets", &layers)
                    .bind("portion", portion)
                    .bind("emitter", &self.casters.emitter)
                    .bind("positions", &self.casters.positions)
                    .bind("receivers", &chunk.buffer)
                    .bind("tiles", lists.tiles)
                    .bind("items", &lists.items.items)
                    .bind("listed", lists.listed)
                    .bind("sums", &sums)
                    .dispatch(groups);
            })
        })?;

        let points = self.built.parameters.points;
        let light_points = gpu.buffer("points of the light", &self.points(), wgpu::BufferUsages::UNIFORM)?;
        let cover = self.pipeline("cover");
        self.each_list(&self.casters.outline, &self.tiles(chunk, false), passes, |lists, passes| {
            let rounds = MOST_ROUNDS / (1 + points / 4);
            // Where one portion is all, nothing is kept.
            let kept = if lists.longest > rounds { 4 * u64::from(points) * count } else { 16 };
            let kept_layers = gpu.empty_buffer("counts of points", kept.max(16), storage)?;
            self.each_portion(lists, rounds, passes, |recorded, portion, groups| {
                let pass = recorded
                    .compute("visibility", &cover)
                    .bind("portion", portion)
                    .bind("emitter", &self.casters.emitter)
                    .bind("positions", &self.casters.positions)
                    .bind("receivers", &chunk.buffer)
                    .bind("tiles", lists.tiles)
                    .bind("items", &lists.items.items)
                    .bind("listed", lists.listed)
                    .bind("sums", &sums)
                    .bind("light_points", &light_points)
                    .bind("kept_layers", &kept_layers)
                    .bind("visibility", &visibility);
                pass.dispatch(groups);
            })
        })?;
        gpu.read_buffer(&visibility)
    }

    /// Points of the light: four u, then four v, …
    fn points(&self) -> [[f32; 4]; MOST_POINTS / 2] {
        let mut points = [[0.0; 4]; MOST_POINTS / 2];
        let count = self.built.parameters.points;
        // Their projections onto any axis are spread evenly too, so that edges along one are as good as any.
        let sampler = Sampler::new(Pattern::Sobol, count.max(1), 0, 0);
        for i in 0..count as usize {
            let at = on_domain(self.view.emitter.domain, sampler.unit_square(i as u32)).as_vec2();
            points[2 * (i / 4)][i % 4] = at.x;
            points[2 * (i / 4) + 1][i % 4] = at.y;
        }
        points
    }

    /// The tiles of a chunk, with what is around all ways from their receivers to the light, or to its centre.
    fn tiles(&self, chunk: &Chunk, to_center: bool) -> Vec<Bounded> {
        let view = self.view;
        let drawn = view.caster_bounds.union(view.receiver_bounds);
        let reach = if drawn.is_empty() { 1.0 } else { drawn.min.abs().max(drawn.max.abs()).max_element() };
        let bounded = |(number, receivers): &(u32, Range<u32>)| {
            let at = view.tile_numbers.binary_search(number).expect("tiles of receivers have bounds");
            let pad = DVec3::splat(ROUNDING * reach);
            let bounds = Bounds { min: view.tiles[at].min - pad, max: view.tiles[at].max + pad };
            let is_hidden = |i: u32| self.is_center_hidden(chunk.pixels[i as usize]);
            let starts_at_center =
                to_center && (self.built.parameters.points == 0 || !receivers.clone().any(is_hidden));
            let shaft =
                if starts_at_center { self.to_center(&bounds, &drawn) } else { view.shaft(self.light, &bounds) };
            let plane = |(normal, offset): (DVec3, f64)| {
                let unit = normal / normal.abs().max_element();
                // The vertices', the centre's and the plane's own rounding.
                let offset = offset / normal.abs().max_element();
                let slack = ROUNDING * (3.0 * reach + offset.abs());
                unit.extend(offset + slack).as_vec4()
            };
            Bounded { receivers: receivers.clone(), planes: shaft.planes().map(plane).collect() }
        };
        chunk.tiles.par_iter().map(bounded).collect()
    }

    /// Whether the light's centre is behind the horizon of a pixel's receiver, or within rounding of it.
    fn is_center_hidden(&self, pixel: u32) -> bool {
        let receiver = self.frame.receivers.pixels[pixel as usize].as_ref().expect("only hits face the light");
        let emitter = self.light.emitter(receiver.position).expect("the light faces this receiver");
        // Heights on the GPU are products of three terms, of positions that are off by a few roundings.
        let unit = if emitter.distant { 1.0 } else { self.view.space.unit };
        receiver.normal.dot(emitter.center) <= 8.0 * ROUNDING * unit
    }

    /// What is around all ways from receivers to the light's centre, as far as anything is drawn.
    fn to_center(&self, receivers: &Bounds, drawn: &Bounds) -> Shaft {
        let emitter = &self.view.emitter;
        if emitter.distant {
            let offset = 2.0 * drawn.union(*receivers).size().length() * emitter.center;
            return Shaft::between(receivers, &Bounds { min: receivers.min + offset, max: receivers.max + offset });
        }
        Shaft::between(receivers, &Bounds { min: emitter.center, max: emitter.center })
    }

    /// Has the tiles' lists of items made, as many at a time as may be, and does `work` with them.
    fn each_list(
        &self,
        items: &Items,
        tiles: &[Bounded],
        passes: &mut Vec<Pass>,
        mut work: impl FnMut(&Listed, &mut Vec<Pass>) -> Result<()>,
    ) -> Result<()> {
        let gpu = self.view.gpu;
        let chunks = items.count.div_ceil(CHUNK);
        let most = (MOST_COUNTS / chunks.max(1)).clamp(1, MOST_GROUPS as usize);
        for tiles in tiles.chunks(most) {
            self.frame.progress.check()?;
            let storage = wgpu::BufferUsages::STORAGE;
            let planes: Vec<Vec4> = tiles.iter().flat_map(|tile| tile.planes.iter().copied()).collect();
            let planes = gpu.buffer("planes of tiles", &planes, storage)?;
            let mut first_plane = 0;
            let mut data: Vec<Tile> = Vec::with_capacity(tiles.len());
            for tile in tiles {
                let planes = tile.planes.len() as u32;
                let Range { start: receivers_begin, end: receivers_end } = tile.receivers;
                data.push(Tile {
                    first_plane,
                    planes,
                    first: 0,
                    count: 0,
                    receivers_begin,
                    receivers_end,
                    padding: [0; 2],
                });
                first_plane += planes;
            }
            let counts = gpu.empty_buffer("counts of tiles", 4 * (tiles.len() * chunks) as u64, storage)?;
            if chunks > 0 {
                let unlisted = gpu.buffer("tiles", &data, storage)?;
                let totals = gpu.empty_buffer("lengths of lists", 4 * tiles.len() as u64, storage)?;
                let portion = self.portion(whole(0..tiles.len() as u32, chunks))?;
                let mut recorded = GpuFrame::new(gpu);
                recorded
                    .compute("tiles", &self.pipeline("count_items"))
                    .bind("portion", &portion)
                    .bind("positions", &self.casters.positions)
                    .bind("tiles", &unlisted)
                    .bind("planes", &planes)
                    .bind("items", &items.items)
                    .bind("bounds", &items.bounds)
                    .bind("counts", &counts)
                    .dispatch([(chunks as u32).div_ceil(WORKGROUP), tiles.len() as u32, 1]);
                recorded
                    .compute("tiles", &self.pipeline("scan_counts"))
                    .bind("portion", &portion)
                    .bind("counts", &counts)
                    .bind("totals", &totals)
                    .dispatch([(tiles.len() as u32).div_ceil(WORKGROUP), 1, 1]);
                add_passes(passes, recorded.finish()?);
                let totals: Vec<u32> = gpu.read_buffer(&totals)?;
                for (tile, total) in data.iter_mut().zip(totals) {
                    tile.count = total;
                }
            }
            for range in batches(&mut data).map_err(|count| self.too_long(count))? {
                let lists = gpu.buffer("tiles", &data, storage)?;
                let of_range = &data[range.start as usize..range.end as usize];
                let listed: u64 = of_range.iter().map(|tile| u64::from(tile.count)).sum();
                let longest = of_range.iter().map(|tile| tile.count).max().unwrap_or(0);
                let listed_items = gpu.empty_buffer("lists of tiles", 4 * listed, storage)?;
                if listed > 0 {
                    let portion = self.portion(whole(range.clone(), chunks))?;
                    let mut recorded = GpuFrame::new(gpu);
                    recorded
                        .compute("tiles", &self.pipeline("list_items"))
                        .bind("portion", &portion)
                        .bind("positions", &self.casters.positions)
                        .bind("tiles", &lists)
                        .bind("planes", &planes)
                        .bind("items", &items.items)
                        .bind("bounds", &items.bounds)
                        .bind("counts", &counts)
                        .bind("listed", &listed_items)
                        .dispatch([(chunks as u32).div_ceil(WORKGROUP), range.len() as u32, 1]);
                    add_passes(passes, recorded.finish()?);
                }
                work(&Listed { items, tiles: &lists, listed: &listed_items, longest, range }, passes)?;
                self.frame.progress.check()?;
            }
        }
        Ok(())
    }

    fn too_long(&self, count: u32) -> Error {
        let message = format!("{count} triangles or edges may matter to one tile, and {MOST_LISTED} are allowed");
        Error::usage(format!("shadow-volumes of light {:?}", self.light.name), message)
    }

    /// Does `record` with each portion of so many items of every list; at least with one, the last.
    fn each_portion(
        &self,
        lists: &Listed,
        most: u32,
        passes: &mut Vec<Pass>,
        mut record: impl FnMut(&mut GpuFrame, &wgpu::Buffer, [u32; 3]),
    ) -> Result<()> {
        let portions = lists.longest.div_ceil(most).max(1);
        for at in 0..portions {
            let portion = Portion {
                first: at * most,
                most,
                is_last: u32::from(at + 1 == portions),
                ..whole(lists.range.clone(), 0)
            };
            let portion = self.portion(portion)?;
            let mut recorded = GpuFrame::new(self.view.gpu);
            record(&mut recorded, &portion, [lists.range.len() as u32, TILE * TILE / WORKGROUP, 1]);
            add_passes(passes, recorded.finish()?);
            self.frame.progress.check()?;
        }
        Ok(())
    }
}

/// A portion of some tiles, of all that they list.
fn whole(tiles: Range<u32>, chunks: usize) -> Portion {
    Portion {
        first_tile: tiles.start,
        tiles: tiles.len() as u32,
        chunks: chunks as u32,
        first: 0,
        most: 0,
        is_last: 0,
        padding: [0; 2],
    }
}

/// Ranges of tiles whose lists fit together, with the place of each list among those of its range; or the length of one that does not
/// fit.
fn batches(tiles: &mut [Tile]) -> std::result::Result<Vec<Range<u32>>, u32> {
    let mut ranges: Vec<Range<u32>> = Vec::new();
    let mut listed = 0;
    for (i, tile) in (0..).zip(tiles) {
        let count = u64::from(tile.count);
        if count > MOST_LISTED {
            return Err(tile.count);
        }
        match ranges.last_mut() {
            Some(range) if listed + count <= MOST_LISTED => range.end = i + 1,
            _ => {
                ranges.push(i..i + 1);
                listed = 0;
            }
        }
        tile.first = listed as u32;
        listed += count;
    }
    Ok(ranges)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tile(count: u32) -> Tile {
        Tile {
            first_plane: 0,
            planes: 0,
            first: u32::MAX,
            count,
            receivers_begin: 0,
            receivers_end: 0,
            padding: [0; 2],
        }
    }

    #[test]
    fn lists_are_made_as_many_at_a_time_as_fit() {
        let most = MOST_LISTED as u32;
        let mut tiles = [1, most - 1, 0, 1, 2, most, 0].map(tile);
        assert_eq!(batches(&mut tiles), Ok(vec![0..3, 3..5, 5..7]));
        assert_eq!(tiles.map(|tile| tile.first), [0, 1, most, 0, 1, 0, most]);
        assert_eq!(batches(&mut [1, most + 1].map(tile)), Err(most + 1));
        assert_eq!(batches(&mut []), Ok(Vec::new()));
    }
}
