//! A light and the receivers that it faces, as shadow maps see them: in one frame around the light, in `f32`.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::PI;
use std::ops::Range;

use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

use super::Gpu;
use super::scene::{DrawList, DrawSpace, Part, SceneBuffers, unit_above};
use crate::Result;
use crate::closed_forms::{disk_edge_fraction, rect_edge_fraction};
use crate::geometry::irradiance;
use crate::geometry::shaft::{Shaft, light_bounds};
use crate::gpu_struct;
use crate::receivers::Receiver;
use crate::sampling::on_domain;
use crate::scene::light::{Domain, Emitter};
use crate::scene::{AreaLight, Bounds, Shape};
use crate::techniques::{Frame, LightImage, Linking};

gpu_struct! {
    /// Twin of `Receiver` in `lib/receiver.wgsl`.
    pub struct GpuReceiver as Receiver {
        /// On the GPU's scale.
        pub position: Vec3,
        /// Of its pixel.
        pub number: u32,
        /// Geometric.
        pub normal: Vec3,
        /// What it lies on.
        pub instance: u32,
        /// Interpolated.
        pub shading_normal: Vec3,
        /// None.
        pub padding_2: u32,
    }
}

/// Sides of the tiles of pixels whose receivers are bounded together, pixels.
pub const TILE: u32 = 16;

/// A tile of an image of so many and those around it: an edge that the points of a tile miss may be seen by its neighbours'.
pub fn around(tile: u32, columns: u32, count: u32) -> impl Iterator<Item = u32> {
    let near = |at: u32, count: u32| at.saturating_sub(1)..(at + 2).min(count);
    let (x, y) = (tile % columns, tile / columns);
    near(y, count / columns).flat_map(move |y| near(x, columns).map(move |x| y * columns + x))
}

/// Sides of the blocks of tiles that are held against all casters, tiles.
const TILES_A_BLOCK: u32 = 8;

/// A light with all that its maps need.
#[derive(Debug)]
pub struct LightView<'a> {
    /// Where the work is done.
    pub gpu: &'a Gpu,
    /// The scene's geometry.
    pub buffers: &'a SceneBuffers,
    /// The surface that stands for the light, as it faces the middle of the receivers; on the GPU's scale and relative to its
    /// origin.
    pub emitter: Emitter,
    /// Where positions on the GPU lie in the scene.
    pub space: DrawSpace,
    /// What can lie between. Positions on the GPU are relative to the middle of the receivers, in units in which nothing is far
    /// beyond 1.
    pub casters: DrawList,
    /// Bounds of what can lie between, on the GPU.
    pub caster_bounds: Bounds,
    /// Bounds of the receivers, on the GPU.
    pub receiver_bounds: Bounds,
    /// Bounds of receivers by tile, on the GPU; of those tiles that hold some.
    pub tiles: Vec<Bounds>,
    /// The number of each of these tiles, row by row.
    pub tile_numbers: Vec<u32>,
    /// The receivers that are worked on, in as many buffers as the adapter's limits ask for.
    pub chunks: Vec<Chunk>,
    /// Pixels of the other receivers that the light faces: nothing hides any of it from them.
    pub lit: Vec<u32>,
    /// By pixel, whether the light faces its receiver.
    pub facing: Vec<bool>,
}

/// A tile with receivers that the light faces.
struct FacingTile {
    number: u32,
    /// Those receivers' pixels.
    pixels: Vec<u32>,
    /// Of those receivers, scene space.
    bounds: Bounds,
}

/// The receivers that a technique works on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Work {
    /// Those that the light faces.
    All,
    /// Of these, those in tiles in which something may hide some of the light.
    Shadowed,
}

/// Some of the receivers, tile by tile.
#[derive(Debug)]
pub struct Chunk {
    /// Their pixels.
    pub pixels: Vec<u32>,
    /// The tiles that they are in, by number, and which of the receivers are in each.
    pub tiles: Vec<(u32, Range<u32>)>,
    /// Their data: `array<Receiver>`.
    pub buffer: wgpu::Buffer,
}

impl Chunk {
    /// Those of an image `width` pixels wide, tile by tile.
    pub fn new(pixels: Vec<u32>, width: u32, buffer: wgpu::Buffer) -> Self {
        Self { tiles: by_tile(&pixels, width), pixels, buffer }
    }
}

/// The tiles that pixels of an image are in, and which of them: pixels of a tile are in a row.
pub fn by_tile(pixels: &[u32], width: u32) -> Vec<(u32, Range<u32>)> {
    let mut tiles: Vec<(u32, Range<u32>)> = Vec::new();
    for (i, &pixel) in (0..).zip(pixels) {
        match tiles.last_mut() {
            Some((tile, range)) if *tile == tile_of(pixel, width) => range.end = i + 1,
            _ => tiles.push((tile_of(pixel, width), i..i + 1)),
        }
    }
    tiles
}

/// The tile that a pixel of an image is in.
fn tile_of(pixel: u32, width: u32) -> u32 {
    pixel / width / TILE * width.div_ceil(TILE) + pixel % width / TILE
}

/// Its products with the points of grids of 3 × 3 to 27 × 27 are spread well, as is what other receivers see of them: the best of
/// thousands of random ones.
const SPREAD: DVec2 = DVec2::new(66.335_632_42, 22.223_458_3);

/// Receivers of one workgroup in a technique's shader.
pub const WORKGROUP: u32 = 64;

impl<'a> LightView<'a> {
    /// What a light's maps need; none where the light faces no receiver.
    ///
    /// # Errors
    /// [`crate::Error::Gpu`] where the receivers don't fit.
    pub fn new(gpu: &'a Gpu, frame: &'a Frame, light: &AreaLight) -> Result<Option<Self>> {
        Self::in_chunks(gpu, frame, light, size_of::<GpuReceiver>() as u64, Work::All)
    }

    /// [`LightView::new`] for what keeps up to so many bytes a receiver in a buffer: no chunk has more than fit.
    ///
    /// # Errors
    /// As [`LightView::new`].
    pub fn in_chunks(
        gpu: &'a Gpu,
        frame: &'a Frame,
        light: &AreaLight,
        bytes_a_receiver: u64,
        work: Work,
    ) -> Result<Option<Self>> {
        let buffers = frame.buffers.expect("a technique with a GPU is given the scene on it");
        let linking = Linking::of(frame.scene, light);
        let pixels = &frame.receivers.pixels;
        let is_facing = |receiver: &Receiver| {
            linking.lights(receiver)
                && light.emitter(receiver.position).is_some_and(|emitter| irradiance::reaches(&emitter, receiver))
        };
        let facing: Vec<bool> =
            pixels.par_iter().with_min_len(1024).map(|pixel| pixel.as_ref().is_some_and(is_facing)).collect();
        let lit = |number: usize| pixels[number].as_ref().filter(|_| facing[number]);

        let [width, height] = frame.receivers.size;
        let columns = width.div_ceil(TILE);
        // Neighbours in the image are neighbours on the GPU, and read the same texels.
        let in_tile = |tile: u32| {
            let (x, y) = (tile % columns * TILE, tile / columns * TILE);
            let rows = y..(y + TILE).min(height);
            let numbers = rows.flat_map(|y| (x..(x + TILE).min(width)).map(move |x| y * width + x));
            let pixels: Vec<u32> = numbers.filter(|&number| facing[number as usize]).collect();
            let positions = pixels.iter().filter_map(|&number| lit(number as usize)).map(|receiver| receiver.position);
            FacingTile { number: tile, bounds: positions.collect(), pixels }
        };
        let facing_tiles: Vec<FacingTile> = (0..columns * height.div_ceil(TILE))
            .into_par_iter()
            .map(in_tile)
            .filter(|tile| !tile.pixels.is_empty())
            .collect();
        let receiver_bounds = facing_tiles.iter().fold(Bounds::EMPTY, |all, tile| all.union(tile.bounds));
        let Some(first) = (0..pixels.len()).find_map(lit) else { return Ok(None) };
        let origin = receiver_bounds.center();
        // From the middle a light may be seen from behind, or from within; every receiver that it faces sees it.
        let (seen_from, emitter) = [origin, first.position]
            .into_iter()
            .find_map(|position| Some((position, light.emitter(position)?)))
            .expect("the light faces the first receiver");

        let bounds: Vec<Bounds> = (0..frame.scene.instances.len()).map(|i| frame.bvh.instance_bounds(i)).collect();
        let scene_bounds = bounds.iter().copied().fold(Bounds::EMPTY, Bounds::union);
        let shaft = Shaft::between(&receiver_bounds, &light_bounds(light, &receiver_bounds, &scene_bounds));
        let blocks: Vec<bool> = (0..bounds.len() as u32).map(|i| linking.blocks(i)).collect();
        let is_caster = |i: usize, bounds: &Bounds| light.casts_shadow && blocks[i] && !shaft.holds_nothing_of(bounds);
        let caster_bounds =
            (0..bounds.len()).filter(|&i| is_caster(i, &bounds[i])).fold(Bounds::EMPTY, |all, i| all.union(bounds[i]));
        let corners = caster_bounds.union(receiver_bounds).corners();
        let reach = corners.iter().map(|&corner| (corner - origin).abs().max_element()).fold(0.0, f64::max);
        let space = DrawSpace { origin, unit: unit_above(reach) };
        let on_gpu = |position: DVec3| (position - origin) / space.unit;
        let bounds_on_gpu = |bounds: &Bounds| Bounds { min: on_gpu(bounds.min), max: on_gpu(bounds.max) };
        let casters = buffers.draw_list(gpu, frame.scene, space, Part::Chunk, is_caster)?;
        // A distant emitter is made of directions, which have no scale.
        let emitter = if emitter.distant {
            emitter
        } else {
            Emitter {
                center: on_gpu(seen_from + emitter.center),
                half_u: emitter.half_u / space.unit,
                half_v: emitter.half_v / space.unit,
                ..emitter
            }
        };
        let mut view = Self {
            gpu,
            buffers,
            emitter,
            space,
            caster_bounds: casters.bounds(),
            casters,
            receiver_bounds: bounds_on_gpu(&receiver_bounds),
            tiles: facing_tiles.iter().map(|tile| bounds_on_gpu(&tile.bounds)).collect(),
            tile_numbers: facing_tiles.iter().map(|tile| tile.number).collect(),
            chunks: Vec::new(),
            lit: Vec::new(),
            facing,
        };
        let mut numbers: Vec<u32> = Vec::with_capacity(pixels.len());
        let shadowed = (work == Work::Shadowed).then(|| view.shadowed_tiles(frame, light, &facing_tiles));
        for tile in &facing_tiles {
            let is_worked_on = shadowed.as_ref().is_none_or(|shadowed| shadowed[tile.number as usize]);
            if is_worked_on { &mut numbers } else { &mut view.lit }.extend(&tile.pixels);
        }
        view.chunks = numbers
            .chunks(most_receivers(gpu, bytes_a_receiver))
            .map(|numbers| {
                let receiver = |&number: &u32| {
                    let receiver = pixels[number as usize].as_ref().expect("only hits face the light");
                    GpuReceiver {
                        position: on_gpu(receiver.position).as_vec3(),
                        number,
                        normal: receiver.normal.as_vec3(),
                        instance: receiver.instance,
                        shading_normal: receiver.shading_normal.as_vec3(),
                        padding_2: 0,
                    }
                };
                let data: Vec<GpuReceiver> = numbers.par_iter().map(receiver).collect();
                let buffer = gpu.buffer("receivers", &data, wgpu::BufferUsages::STORAGE)?;
                Ok(Chunk::new(numbers.to_vec(), width, buffer))
            })
            .collect::<Result<_>>()?;
        Ok(Some(view))
    }

    /// Casters, and what they could be but for the receivers all lying on it.
    ///
    /// # Errors
    /// [`crate::Error::Gpu`] where it doesn't fit.
    pub fn surfaces(&self, frame: &Frame, light: &AreaLight) -> Result<DrawList> {
        let linking = Linking::of(frame.scene, light);
        let shaft = self.shaft(light, &self.receiver_bounds);
        let is_reached = |i: usize, bounds: &Bounds| linking.blocks(i as u32) && !shaft.excludes(&self.on_gpu(bounds));
        self.buffers.draw_list(self.gpu, frame.scene, self.space, Part::Chunk, is_reached)
    }

    /// A box of the scene's on the GPU's scale.
    fn on_gpu(&self, bounds: &Bounds) -> Bounds {
        let DrawSpace { origin, unit } = self.space;
        Bounds { min: (bounds.min - origin) / unit, max: (bounds.max - origin) / unit }
    }

    /// By tile, whether one of some casters may hide some of the light from its receivers: one in the hull of those and the light.
    pub fn behind(&self, casters: &DrawList, frame: &Frame, light: &AreaLight) -> Vec<bool> {
        let [width, height] = frame.receivers.size;
        let columns = width.div_ceil(TILE);
        // Blocks of tiles first: most casters are nowhere near most tiles.
        let mut blocks: BTreeMap<[u32; 2], Vec<(u32, Bounds)>> = BTreeMap::new();
        for (&tile, &bounds) in self.tile_numbers.iter().zip(&self.tiles) {
            blocks
                .entry([tile % columns / TILES_A_BLOCK, tile / columns / TILES_A_BLOCK])
                .or_default()
                .push((tile, bounds));
        }
        let blocks: Vec<_> = blocks.into_values().collect();
        let behind = blocks.par_iter().flat_map_iter(|tiles| {
            let shaft = self.shaft(light, &tiles.iter().map(|(_, bounds)| *bounds).fold(Bounds::EMPTY, Bounds::union));
            let near: Vec<Bounds> = casters.parts().filter(|bounds| !shaft.holds_nothing_of(bounds)).collect();
            let is_behind = move |(_, bounds): &&(u32, Bounds)| {
                let shaft = self.shaft(light, bounds);
                near.iter().any(|caster| !shaft.holds_nothing_of(caster))
            };
            tiles.iter().filter(is_behind).map(|(tile, _)| *tile)
        });
        let mut found = vec![false; (columns * height.div_ceil(TILE)) as usize];
        for tile in behind.collect::<Vec<u32>>() {
            found[tile as usize] = true;
        }
        found
    }

    /// By tile, whether in it something may hide some of the light from one of its receivers: a caster, or a
    /// receiver's own tangent plane. All other receivers see it whole.
    fn shadowed_tiles(&self, frame: &Frame, light: &AreaLight, tiles: &[FacingTile]) -> Vec<bool> {
        let mut shadowed = self.behind(&self.casters, frame, light);
        let is_cut = |&number: &u32| {
            let receiver = frame.receivers.pixels[number as usize].as_ref().expect("only hits face the light");
            let Emitter { center, half_u, half_v, distant, .. } = self.emitter;
            let from = if distant { DVec3::ZERO } else { (receiver.position - self.space.origin) / self.space.unit };
            let normal = receiver.normal;
            normal.dot(center - from) < normal.dot(half_u).abs() + normal.dot(half_v).abs()
        };
        let cut: Vec<u32> =
            tiles.par_iter().filter(|tile| tile.pixels.iter().any(is_cut)).map(|tile| tile.number).collect();
        for tile in cut {
            shadowed[tile as usize] = true;
        }
        shadowed
    }

    /// Tiles, by number, whose receivers the light faces and that are not worked on.
    pub fn lit_tiles(&self) -> Vec<u32> {
        let worked_on: BTreeSet<u32> =
            self.chunks.iter().flat_map(|chunk| &chunk.tiles).map(|(tile, _)| *tile).collect();
        self.tile_numbers.iter().copied().filter(|tile| !worked_on.contains(tile)).collect()
    }

    /// Where a point of the unit square is on the light, on the GPU's scale.
    ///
    /// What turns to each receiver is more than the surface that the middle of the receivers sees: points before and behind that, as
    /// dense as 1/√(1 − r²) at r half widths from the middle, are spread over what any other receiver sees as evenly as over it.
    pub fn point_on(&self, light: &AreaLight, square: DVec2) -> DVec3 {
        let emitter = &self.emitter;
        let uv = on_domain(emitter.domain, square);
        let on_surface = emitter.at(uv);
        let (half, radius, across) = match light.shape {
            Shape::Sphere { radius, .. } => (emitter.half_u.length(), radius / self.space.unit, uv.length()),
            Shape::Tube { radius, .. } => (radius / self.space.unit, radius / self.space.unit, uv.y.abs()),
            Shape::Rect { .. } | Shape::Disk { .. } | Shape::Sun { .. } | Shape::Point => return on_surface,
        };
        if half <= 0.0 {
            return on_surface;
        }
        // The disc of a silhouette is before the sphere's middle, and smaller; through that middle the same cone is as much larger,
        // without bounds for receivers at the sphere itself.
        let behind = (radius * radius - half * half).max(0.0).sqrt();
        let larger = radius / half * (radius / half).min(1.5);
        let beside = on_surface - emitter.center;
        let spread = (0.5 + SPREAD.dot(square)).fract();
        let before = larger * half * (1.0 - across * across).max(0.0).sqrt() * (PI * (spread - 0.5)).sin();
        emitter.center + larger * beside + (before - behind) * emitter.normal
    }

    /// The hull of the light and a box, both on the GPU's scale.
    pub fn shaft(&self, light: &AreaLight, receivers: &Bounds) -> Shaft {
        let DrawSpace { origin, unit } = self.space;
        let in_scene = |bounds: &Bounds| Bounds { min: origin + unit * bounds.min, max: origin + unit * bounds.max };
        // A sun's box is beyond all that can block it.
        let drawn = in_scene(&self.caster_bounds.union(self.receiver_bounds));
        let mut lit_from = self.on_gpu(&light_bounds(light, &in_scene(receivers), &drawn));
        let Emitter { center, half_u, half_v, distant, .. } = self.emitter;
        if !distant {
            let half = half_u.abs() + half_v.abs();
            lit_from = lit_from.union(Bounds { min: center - half, max: center + half });
        }
        Shaft::between(receivers, &lit_from)
    }

    /// The image of a light: `answer` gives V and, if asked for, E/E₀ of the `i`th receiver of a chunk; where the light faces
    /// nothing V is 0, and 1 where it faces what is not worked on.
    pub fn image(
        view: Option<&Self>,
        frame: &Frame,
        light: &AreaLight,
        answer: impl Fn(usize, usize, &Receiver) -> (f64, f64) + Sync,
    ) -> LightImage {
        let pixels = &frame.receivers.pixels;
        let missed = |pixel: &Option<Receiver>| if pixel.is_some() { 0.0 } else { 1.0 };
        let mut visibility: Vec<f32> = pixels.iter().map(missed).collect();
        let mut ratio = visibility.clone();
        let mut irradiance = vec![[0.0f32; 3]; if frame.irradiance { pixels.len() } else { 0 }];
        let mut add = |numbers: &[u32], answer: &(dyn Fn(usize, &Receiver) -> (f64, f64) + Sync)| {
            let of = |(i, &number): (usize, &u32)| {
                let receiver = pixels[number as usize].as_ref().expect("only hits face the light");
                let (seen, share) = answer(i, receiver);
                let rgb = if frame.irradiance && share > 0.0 {
                    share * irradiance::unshadowed(light, receiver)
                } else {
                    DVec3::ZERO
                };
                (
                    number as usize,
                    seen as f32,
                    rgb.as_vec3().to_array(),
                    if rgb == DVec3::ZERO { 0.0 } else { share as f32 },
                )
            };
            let answers: Vec<_> = numbers.par_iter().enumerate().with_min_len(1024).map(of).collect();
            for (number, seen, rgb, share) in answers {
                visibility[number] = seen;
                ratio[number] = share;
                if frame.irradiance {
                    irradiance[number] = rgb;
                }
            }
        };
        if let Some(view) = view {
            add(&view.lit, &|_, _| (1.0, 1.0));
            for (at, chunk) in view.chunks.iter().enumerate() {
                add(&chunk.pixels, &|i, receiver| answer(at, i, receiver));
            }
        }
        LightImage {
            visibility,
            irradiance,
            irradiance_ratio: if frame.irradiance { ratio } else { Vec::new() },
            facing: view.map_or_else(|| vec![false; pixels.len()], |view| view.facing.clone()),
            ..LightImage::default()
        }
    }
}

/// V and E/E₀ from the weights of the points seen and of all above the horizon, and those times what the points emit towards the
/// receiver; `whole` is the weight of all points.
pub fn seen_of(sums: [f32; 4], whole: f64) -> (f64, f64) {
    let [seen, seen_weight, above, weight] = sums.map(f64::from);
    // E = E₀ where nothing above the horizon is hidden, however the weights lie; where all points miss what little of the light
    // emits this way, the seen share of the area stands for that of the weights.
    let share = if seen == above {
        1.0
    } else if weight > 0.0 {
        seen_weight / weight
    } else {
        seen / above
    };
    ((seen / whole).min(1.0), share)
}

/// How many receivers one buffer may hold, and one dispatch may take.
pub fn most_receivers(gpu: &Gpu, bytes_a_receiver: u64) -> usize {
    let limits = gpu.device.limits();
    let bytes = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
    let by_memory = (bytes / bytes_a_receiver.max(size_of::<GpuReceiver>() as u64)).max(1);
    let by_dispatch = u64::from(limits.max_compute_workgroups_per_dimension) * u64::from(WORKGROUP);
    by_memory.min(by_dispatch) as usize
}

/// The fraction of a light's area above the tangent plane of a receiver that it faces.
///
/// # Panics
/// If it does not face it.
pub fn fraction_above(light: &AreaLight, receiver: &Receiver) -> f64 {
    let emitter = light.emitter(receiver.position).expect("the light faces the receiver");
    // n · (center + u half_u + v half_v) > 0, over the domain of u and v.
    let support = DVec2::new(receiver.normal.dot(emitter.half_u).abs(), receiver.normal.dot(emitter.half_v).abs());
    let height = receiver.normal.dot(emitter.center);
    match emitter.domain {
        Domain::Disk => disk_edge_fraction(height / support.length()),
        Domain::Rect | Domain::Point => rect_edge_fraction(height, support),
    }
}
