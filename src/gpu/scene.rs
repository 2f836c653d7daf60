//! A scene's geometry on the GPU, and lists of what to draw of it.

use std::collections::{BTreeSet, HashMap};
use std::sync::Arc;

use glam::{DAffine3, DVec3, Vec2, Vec3, Vec4};

use super::Gpu;
use super::shader::{Pipeline, Targets};
use crate::geometry::bvh::{exponent_of, power_of_two};
use crate::gpu_struct;
use crate::scene::{Bounds, Cutout, Mesh, Scene, Wrap};
use crate::{Error, Result};

/// Geometry of the meshes, each stored once.
#[derive(Debug)]
pub struct SceneBuffers {
    positions: wgpu::Buffer,
    uvs: wgpu::Buffer,
    indices: wgpu::Buffer,
    meshes: Vec<MeshRange>,
    /// What materials look like; the first is solid.
    cutouts: Vec<CutoutBuffers>,
}

/// Where a mesh's data lie.
#[derive(Debug)]
struct MeshRange {
    first_index: u32,
    index_count: u32,
    base_vertex: i32,
    space: MeshSpace,
    cutout: usize,
    /// Mesh space.
    bounds: Bounds,
    /// Bounds of each [`CHUNK`] of its triangles, mesh space.
    chunks: Vec<Bounds>,
}

/// Triangles that are drawn or left out together. They are neighbours in their file, and mostly in space.
const CHUNK: usize = 512;

/// What stored positions are relative to: the middle of all that share them, in units of a power of two that takes them into
/// [−1, 1]. A mesh far from its own origin thus keeps its precision, and coordinates of any size stay within `f32`.
#[derive(Debug, Clone, Copy)]
struct MeshSpace {
    anchor: DVec3,
    unit: f64,
}

/// The space that a pass draws in: scene space relative to an origin, in units.
#[derive(Debug, Clone, Copy)]
pub struct DrawSpace {
    /// Scene space. What is near it keeps its precision.
    pub origin: DVec3,
    /// A power of two, m: about the largest distance that is drawn, so that `f32` holds scenes of any size.
    pub unit: f64,
}

/// The least power of two above a length, m; 2 for a length of zero.
pub fn unit_above(length: f64) -> f64 {
    power_of_two(exponent_of(length) + 1)
}

#[derive(Debug)]
struct CutoutBuffers {
    parameters: wgpu::Buffer,
    alpha: wgpu::TextureView,
}

gpu_struct! {
    /// Twin of `Cutout` in `lib/cutout.wgsl`.
    struct CutoutParameters as Cutout {
        pub cutoff: f32,
        pub factor: f32,
        pub nearest: u32,
        pub padding: u32,
        pub wrap: [u32; 2],
    }
}

/// An instance as a vertex buffer holds it: rows of the transform from a mesh's space to that of the pass, and its number.
#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C)]
struct InstanceRow {
    rows: [Vec4; 3],
    number: u32,
    padding: [u32; 3],
}

/// What of a mesh is drawn or left out together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// All of it.
    Whole,
    /// A few hundred triangles.
    Chunk,
}

impl MeshRange {
    /// Indices and bounds (mesh space) of its parts.
    fn parts(&self, part: Part) -> impl Iterator<Item = ([u32; 2], &Bounds)> {
        let (bounds, step) = match part {
            Part::Whole => (std::slice::from_ref(&self.bounds), self.index_count),
            Part::Chunk => (&self.chunks[..], 3 * CHUNK as u32),
        };
        let end = self.first_index + self.index_count;
        (0..).zip(bounds).map(move |(at, bounds)| {
            let first = self.first_index + at * step;
            ([first, end.min(first + step)], bounds)
        })
    }
}

impl InstanceRow {
    /// A mesh in its own space, placed in the space of a pass.
    fn new(placed: &DAffine3, number: u32, mesh: MeshSpace, space: DrawSpace) -> Self {
        let matrix = placed.matrix3 * (mesh.unit / space.unit);
        let translation = (placed.transform_point3(mesh.anchor) - space.origin) / space.unit;
        let rows = [0, 1, 2].map(|axis| {
            // A flat mesh's transform may be anything across it; 0 · ∞ would be no number.
            let row = matrix.row(axis).clamp(DVec3::splat(f32::MIN.into()), DVec3::splat(f32::MAX.into()));
            row.extend(translation[axis]).as_vec4()
        });
        Self { rows, number, padding: [0; 3] }
    }
}

/// Some of a scene's triangles, ready to be drawn.
#[derive(Debug)]
pub struct DrawList {
    instances: wgpu::Buffer,
    /// By row of it, which of the scene's instances that is.
    numbers: Vec<u32>,
    /// By mesh, chunk and instance.
    units: Vec<Unit>,
}

/// A chunk of a mesh in one of its instances.
#[derive(Debug, Clone, Copy)]
struct Unit {
    mesh: u32,
    /// Row of the instance buffer.
    instance: u32,
    indices: [u32; 2],
    /// As the list's instances are placed.
    bounds: Bounds,
}

/// Indices of a mesh, drawn for some instances.
#[derive(Debug, Clone, Copy)]
pub struct Draw {
    mesh: u32,
    indices: [u32; 2],
    instances: [u32; 2],
}

impl DrawList {
    /// What to draw of it: all whose bounds are wanted.
    pub fn draws(&self, wanted: impl Fn(&Bounds) -> bool) -> Vec<Draw> {
        let mut draws: Vec<Draw> = Vec::new();
        for unit in self.units.iter().filter(|unit| wanted(&unit.bounds)) {
            let Unit { mesh, instance, indices, .. } = *unit;
            match draws.last_mut() {
                Some(last) if last.mesh == mesh && last.indices == indices && last.instances[1] == instance => {
                    last.instances[1] += 1;
                }
                Some(last)
                    if last.mesh == mesh
                        && last.indices[1] == indices[0]
                        && last.instances == [instance, instance + 1] =>
                {
                    last.indices[1] = indices[1];
                }
                _ => draws.push(Draw { mesh, indices, instances: [instance, instance + 1] }),
            }
        }
        draws
    }

    /// Those of its parts whose instances are wanted.
    pub fn only(&self, wanted: impl Fn(usize) -> bool) -> Self {
        let is_wanted = |unit: &&Unit| wanted(self.numbers[unit.instance as usize] as usize);
        Self {
            instances: self.instances.clone(),
            numbers: self.numbers.clone(),
            units: self.units.iter().filter(is_wanted).copied().collect(),
        }
    }

    /// The scene's instances of which it has parts, in their order.
    pub fn instances(&self) -> BTreeSet<usize> {
        self.units.iter().map(|unit| self.numbers[unit.instance as usize] as usize).collect()
    }

    /// Whether it holds nothing.
    pub fn is_empty(&self) -> bool {
        self.units.is_empty()
    }

    /// Bounds of its parts, as its instances are placed.
    pub fn parts(&self) -> impl Iterator<Item = Bounds> {
        self.units.iter().map(|unit| unit.bounds)
    }

    /// Bounds of what it holds, as its instances are placed.
    pub fn bounds(&self) -> Bounds {
        self.parts().fold(Bounds::EMPTY, Bounds::union)
    }
}

/// A scene pass's pipelines: solid surfaces don't pay for cut-outs.
#[derive(Debug)]
pub struct ScenePipelines {
    solid: Arc<Pipeline<wgpu::RenderPipeline>>,
    cut_out: Arc<Pipeline<wgpu::RenderPipeline>>,
}

impl ScenePipelines {
    /// Those of a shader that discards holes where its constant `cut_out` is set.
    pub fn new(gpu: &Gpu, path: &str, targets: Targets) -> Self {
        let solid = gpu.render_pipeline(path, &targets, &[("cut_out", 0.0)]);
        let cut_out = gpu.render_pipeline(path, &Targets { fragment: true, ..targets }, &[("cut_out", 1.0)]);
        Self { solid, cut_out }
    }

    /// The pipeline of a kind of cut-out; the first is solid.
    fn of(&self, cutout: usize) -> &Pipeline<wgpu::RenderPipeline> {
        if cutout == 0 { &self.solid } else { &self.cut_out }
    }
}

/// The vertex buffers that every scene pass draws from: positions, instances, texture coordinates.
pub const VERTEX_BUFFERS: [Option<wgpu::VertexBufferLayout>; 3] = [
    Some(wgpu::VertexBufferLayout {
        array_stride: 12,
        step_mode: wgpu::VertexStepMode::Vertex,
        attributes: &wgpu::vertex_attr_array![0 => Float32x3],
    }),
    Some(wgpu::VertexBufferLayout {
        array_stride: size_of::<InstanceRow>() as u64,
        step_mode: wgpu::VertexStepMode::Instance,
        attributes: &wgpu::vertex_attr_array![1 => Float32x4, 2 => Float32x4, 3 => Float32x4, 4 => Uint32],
    }),
    Some(wgpu::VertexBufferLayout {
        array_stride: 8,
        step_mode: wgpu::VertexStepMode::Vertex,
        attributes: &wgpu::vertex_attr_array![5 => Float32x2],
    }),
];

impl SceneBuffers {
    /// Uploads a scene's meshes.
    ///
    /// # Errors
    /// [`Error::Gpu`] where they don't fit.
    pub fn new(gpu: &Gpu, scene: &Scene) -> Result<Self> {
        let (mut positions, mut uvs, mut indices) = (Vec::new(), Vec::new(), Vec::new());
        let mut cutouts = vec![CutoutBuffers::new(gpu, None)?];
        let mut cutout_of_material = HashMap::new();
        // Meshes that share their vertices store them once, around the middle of all that they use of them.
        let key_of = |mesh: &Mesh| (mesh.positions.as_ptr(), mesh.uvs.as_ref().map(|uvs| uvs.as_ptr()));
        let mut bounds = HashMap::new();
        for mesh in &scene.meshes {
            let around = bounds.entry(key_of(mesh)).or_insert(Bounds::EMPTY);
            *around = around.union(mesh.bounds());
        }
        let mut stored = HashMap::new();
        let mut meshes = Vec::with_capacity(scene.meshes.len());
        for mesh in &scene.meshes {
            let key = key_of(mesh);
            let (base_vertex, space) = *stored.entry(key).or_insert_with(|| {
                let base = positions.len();
                let space = MeshSpace::of(&bounds[&key]);
                positions.extend(mesh.positions.iter().map(|&position| space.stored(position)));
                match &mesh.uvs {
                    Some(given) => uvs.extend_from_slice(given),
                    None => uvs.resize(positions.len(), Vec2::ZERO),
                }
                (base as i32, space)
            });
            let cutout = match mesh.material.filter(|&m| scene.materials[m].cutout.is_some()) {
                None => 0,
                Some(material) => match cutout_of_material.get(&material) {
                    Some(&cutout) => cutout,
                    None => {
                        cutouts.push(CutoutBuffers::new(gpu, scene.materials[material].cutout.as_ref())?);
                        cutout_of_material.insert(material, cutouts.len() - 1);
                        cutouts.len() - 1
                    }
                },
            };
            meshes.push(MeshRange {
                first_index: indices.len() as u32,
                index_count: 3 * mesh.triangles.len() as u32,
                base_vertex,
                space,
                cutout,
                bounds: mesh.bounds(),
                chunks: (0..mesh.triangles.len()).step_by(CHUNK).map(|first| mesh.bounds_of(first, CHUNK)).collect(),
            });
            indices.extend_from_slice(mesh.triangles.as_flattened());
        }
        if positions.len() > i32::MAX as usize || indices.len() > u32::MAX as usize {
            let message = format!("{}: the scene has too many vertices for 32-bit numbers", gpu.adapter.name);
            return Err(Error::Gpu(message));
        }
        Ok(Self {
            positions: gpu.buffer("the scene's vertices", &positions, wgpu::BufferUsages::VERTEX)?,
            uvs: gpu.buffer("the scene's texture coordinates", &uvs, wgpu::BufferUsages::VERTEX)?,
            indices: gpu.buffer("the scene's indices", &indices, wgpu::BufferUsages::INDEX)?,
            meshes,
            cutouts,
        })
    }

    /// The parts of instances that `wanted` selects by instance and bounds (scene space), placed in the space of a pass.
    ///
    /// # Errors
    /// [`Error::Gpu`] where they don't fit.
    pub fn draw_list(
        &self,
        gpu: &Gpu,
        scene: &Scene,
        space: DrawSpace,
        part: Part,
        wanted: impl Fn(usize, &Bounds) -> bool,
    ) -> Result<DrawList> {
        // By mesh, chunk and instance: what can be drawn together is together.
        let mut chosen: Vec<(usize, [u32; 2], u32, &Bounds)> = Vec::new();
        for (i, instance) in (0..).zip(&scene.instances) {
            let parts = self.meshes[instance.mesh].parts(part);
            let wanted = parts.filter(|(_, bounds)| wanted(i as usize, &bounds.transformed(&instance.scene_from_mesh)));
            chosen.extend(wanted.map(|(indices, bounds)| (instance.mesh, indices, i, bounds)));
        }
        chosen.sort_unstable_by_key(|&(mesh, indices, number, _)| (mesh, indices, number));
        let mut row_of = HashMap::new();
        let mut rows: Vec<InstanceRow> = Vec::new();
        let mut units = Vec::with_capacity(chosen.len());
        for (mesh, indices, number, bounds) in chosen {
            let range = &self.meshes[mesh];
            let placed = &scene.instances[number as usize].scene_from_mesh;
            let instance = *row_of.entry(number).or_insert_with(|| {
                rows.push(InstanceRow::new(placed, number, range.space, space));
                rows.len() as u32 - 1
            });
            let bounds = bounds.transformed(placed);
            let bounds =
                Bounds { min: (bounds.min - space.origin) / space.unit, max: (bounds.max - space.origin) / space.unit };
            units.push(Unit { mesh: mesh as u32, instance, indices, bounds });
        }
        let instances = gpu.buffer("the scene's instances", &rows, wgpu::BufferUsages::VERTEX)?;
        let numbers = rows.iter().map(|row| row.number).collect();
        Ok(DrawList { instances, numbers, units })
    }

    /// A pass's own resources, bound beside those of each kind of cut-out.
    pub fn bind_groups<'a>(
        &self,
        gpu: &Gpu,
        pipelines: &ScenePipelines,
        resources: &[(&'a str, wgpu::BindingResource<'a>)],
    ) -> Vec<Option<wgpu::BindGroup>> {
        let of_cutout = |(i, cutout): (usize, &CutoutBuffers)| {
            let mut all = resources.to_vec();
            all.push(("cutout", cutout.parameters.as_entire_binding()));
            all.push(("cutout_alpha", wgpu::BindingResource::TextureView(&cutout.alpha)));
            pipelines.of(i).bind_group(gpu, &all)
        };
        self.cutouts.iter().enumerate().map(of_cutout).collect()
    }

    /// Records draws of a list.
    pub fn draw(
        &self,
        pass: &mut wgpu::RenderPass,
        pipelines: &ScenePipelines,
        groups: &[Option<wgpu::BindGroup>],
        list: &DrawList,
        draws: &[Draw],
    ) {
        pass.set_vertex_buffer(0, self.positions.slice(..));
        pass.set_vertex_buffer(1, list.instances.slice(..));
        pass.set_vertex_buffer(2, self.uvs.slice(..));
        pass.set_index_buffer(self.indices.slice(..), wgpu::IndexFormat::Uint32);
        let mut bound = usize::MAX;
        for draw in draws {
            let mesh = &self.meshes[draw.mesh as usize];
            if bound != mesh.cutout {
                bound = mesh.cutout;
                pass.set_pipeline(&pipelines.of(bound).raw);
                if let Some(group) = &groups[bound] {
                    pass.set_bind_group(0, group, &[]);
                }
            }
            let [indices, instances] = [draw.indices, draw.instances].map(|[first, end]| first..end);
            pass.draw_indexed(indices, mesh.base_vertex, instances);
        }
    }
}

impl MeshSpace {
    fn of(bounds: &Bounds) -> Self {
        if bounds.is_empty() {
            return Self { anchor: DVec3::ZERO, unit: 1.0 };
        }
        Self { anchor: bounds.center(), unit: unit_above(0.5 * bounds.size().max_element()) }
    }

    /// A position, mesh space, as it is stored: rounded once.
    fn stored(&self, position: Vec3) -> Vec3 {
        ((position.as_dvec3() - self.anchor) / self.unit).as_vec3()
    }
}

impl CutoutBuffers {
    fn new(gpu: &Gpu, cutout: Option<&Cutout>) -> Result<Self> {
        let texture = cutout.and_then(|cutout| cutout.texture.as_deref());
        let wrap = |wrap: Wrap| match wrap {
            Wrap::Repeat => 0,
            Wrap::MirroredRepeat => 1,
            Wrap::ClampToEdge => 2,
        };
        let parameters = CutoutParameters {
            cutoff: cutout.map_or(0.0, |cutout| cutout.cutoff),
            factor: cutout.map_or(1.0, |cutout| cutout.factor),
            nearest: u32::from(texture.is_some_and(|texture| texture.nearest)),
            padding: 0,
            wrap: texture.map_or([0; 2], |texture| texture.wrap.map(wrap)),
        };
        let [width, height] = texture.map_or([1, 1], |texture| texture.size);
        let usage = wgpu::TextureUsages::TEXTURE_BINDING | wgpu::TextureUsages::COPY_DST;
        let alpha = gpu.texture("alpha", [width, height, 1], wgpu::TextureFormat::R8Unorm, usage)?;
        let texels: &[u8] = texture.map_or(&[255], |texture| texture.texels.as_flattened());
        gpu.queue.write_texture(
            alpha.as_image_copy(),
            texels,
            wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(width), rows_per_image: Some(height) },
            alpha.size(),
        );
        Ok(Self {
            parameters: gpu.buffer("cutout", &[parameters], wgpu::BufferUsages::UNIFORM)?,
            alpha: alpha.create_view(&wgpu::TextureViewDescriptor::default()),
        })
    }
}
