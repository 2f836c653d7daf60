//! Shadow maps: depth as seen from points of a light, fitted to what receives.
//!
//! A point's map is one frustum towards the middle of the receivers, as wide as they ask for; where they surround the point, or
//! lie so far to its sides that a frustum's texels would be wasted, the six faces of a cube stand in, as many as hold receivers.
//! A face is as deep as the nearest caster and the farthest receiver.
//!
//! # Bias
//! Nothing is tuned. A receiver is held not against its own depth but against that of its tangent plane at the texel's centre,
//! where the map's depth was taken: a plane never shadows itself, however steep. What is left is
//! - the rounding of positions in `f32`, known ([`POSITION_ROUNDING` in `lib/shadow_map.wgsl`]);
//! - the rasteriser's grid of 1/256 of a texel;
//! - the surface's own relief within a texel. What the map resolves has no radius of curvature below a texel, and so rises less
//!   than [`BIAS_TEXELS`] above the tangent plane within half a texel's diagonal, and along the light less than the circle's
//!   diameter of two texels, however it grazes. By so much the plane is moved towards the light; what blocks from lower is lost,
//!   which takes less than a texel (as it falls on the receiver) from the shadow at a contact.

use std::ops::Range;

use glam::{DMat3, DVec2, DVec3, DVec4, Vec3, Vec4};
use rayon::prelude::*;

use super::Gpu;
use super::gbuffer::DEPTH;
use super::light_view::LightView;
use super::pass::Frame;
use super::scene::{Draw, DrawList, ScenePipelines, VERTEX_BUFFERS};
use super::shader::{Constants, Targets};
use crate::Result;
use crate::gpu_struct;
use crate::scene::Bounds;

gpu_struct! {
    /// Twin of `Face` in `lib/face.wgsl`.
    pub struct Face {
        /// Unit, and minus the light point's component along it.
        pub right: Vec4,
        /// As `right`.
        pub up: Vec4,
        /// As `right`; away from the light.
        pub forward: Vec4,
        /// From the view to texture coordinates: scale, then offset.
        pub window: Vec4,
        /// Farthest receiver, along `forward` from the origin.
        pub far: f32,
        /// Of depth, which is 1 at the nearest caster.
        pub depth_scale: f32,
        /// Larger side of a texel in the view.
        pub texel: f32,
        /// 1: the light is at infinity.
        pub distant: u32,
    }
}

gpu_struct! {
    /// Twin of `LightPoint` in `lib/shadow_map.wgsl`.
    struct LightPoint {
        pub position: Vec3,
        pub weight: f32,
        pub normal: Vec3,
        pub first_face: u32,
        pub cube_faces: u32,
        pub padding: u32,
        pub padding_2: [u32; 2],
    }
}

/// How far a surface may rise above a receiver's tangent plane before it blocks, in texels: what a circle of radius 1 rises above
/// its tangent within half a texel's diagonal r = √½, r²/2.
pub const BIAS_TEXELS: f64 = 0.25;

/// What a frustum may be.
#[derive(Debug, Clone, Copy)]
struct Limits {
    /// Tangent of the widest angle off its axis.
    tangent: f64,
    /// How far beside its axis it may look, in its own widths.
    widths_aside: f64,
}

/// Towards the middle of the receivers. Beyond this tangent, texels in the middle would be over twice as wide as those of a cube's
/// face with as many.
const TO_RECEIVERS: Limits = Limits { tangent: 2.0, widths_aside: f64::INFINITY };

/// Along the light's normal. On receivers parallel to the light texels are all of one size, however far to the side; on others they
/// widen as the square of the tangent at worst, 17-fold here. Farther aside, places lose more than six of the 24 bits of `f32`.
const ALONG_LIGHT: Limits = Limits { tangent: 4.0, widths_aside: 64.0 };

/// Nearest depth relative to the farthest: casters nearer to the light point are not seen. Depth is a float, reversed, and keeps
/// its relative precision from here on; so near, what a triangle is cut to is still known to 2^-8.
pub const NEAREST: f64 = 1.0 / (1 << 16) as f64;

/// Nearest depth relative to the largest coordinate: sixteen roundings of `f32`. A surface in the light's own plane comes out as
/// near as a few of them, on either side, and must not be seen.
pub const ROUNDING: f64 = 1.0 / (1 << 20) as f64;

/// Bytes of depth that are rendered at once; a point's faces are together, however large.
const BATCH_BYTES: u64 = 256 << 20;

/// A point of a light, on the GPU's scale.
#[derive(Debug, Clone, Copy)]
pub struct MapPoint {
    /// Relative to the view's origin; a direction towards the light of a distant one.
    pub position: DVec3,
    /// What its answer counts.
    pub weight: f64,
}

/// The maps of some points, rendered together.
#[derive(Debug, Default)]
struct Batch {
    points: Vec<LightPoint>,
    faces: Vec<Face>,
}

/// The maps of points of a light: where they look, and the texture that holds as many of them as are rendered at once.
#[derive(Debug)]
pub struct ShadowMaps<'a> {
    view: &'a LightView<'a>,
    casters: &'a DrawList,
    batches: Vec<Batch>,
    /// One for all batches, or one for each.
    depth: Vec<wgpu::Texture>,
    /// Maps of all batches.
    pub count: u32,
}

/// Whether maps stay after they have been read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keep {
    /// Each batch is drawn over the one before.
    One,
    /// Each batch has a texture array of its own.
    All,
}

/// Which of the surfaces behind one another a map keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kept {
    /// That nearest to the light; the map holds 0 where there is none.
    Nearest,
    /// That farthest from it; the map holds 1 where there is none.
    Farthest,
}

/// Maps that have been rendered, to be read by a technique.
#[derive(Debug)]
pub struct RenderedMaps {
    /// Which of the points given these are.
    pub range: Range<usize>,
    /// `array<Face>`.
    pub faces: wgpu::Buffer,
    /// `array<LightPoint>`.
    pub points: wgpu::Buffer,
    /// `texture_depth_2d_array`.
    pub depth: wgpu::TextureView,
}

/// The shader constants that maps need.
pub const CONSTANTS: Constants = &[("bias_texels", BIAS_TEXELS)];

impl<'a> ShadowMaps<'a> {
    /// Maps of `size` texels a side for these points, which hold what lies in any of `boxes` (on the GPU's scale) and see
    /// `margin` texels more on every side.
    ///
    /// # Errors
    /// [`crate::Error::Gpu`] where maps of that size don't fit.
    pub fn new(view: &'a LightView, points: &[MapPoint], boxes: &[Bounds], size: u32, margin: u32) -> Result<Self> {
        Self::of(view, &view.casters, points, boxes, [size, margin], Keep::One)
    }

    /// [`ShadowMaps::new`], of some of the casters alone, or maps that all stay; they see what those of all casters see, as deep.
    ///
    /// # Errors
    /// As [`ShadowMaps::new`].
    pub fn of(
        view: &'a LightView,
        casters: &'a DrawList,
        points: &[MapPoint],
        boxes: &[Bounds],
        [size, margin]: [u32; 2],
        keep: Keep,
    ) -> Result<Self> {
        let fit = Fit { view, boxes, size, margin, along_light: false };
        Self::fitted(view, casters, points, &fit, keep)
    }

    /// [`ShadowMaps::new`], of maps that look along the light's normal where they can hold the boxes so, and else are the faces of
    /// a cube along the light's axes, which `face_toward` does not know.
    ///
    /// # Errors
    /// As [`ShadowMaps::new`].
    pub fn along_light(
        view: &'a LightView,
        points: &[MapPoint],
        boxes: &[Bounds],
        [size, margin]: [u32; 2],
    ) -> Result<Self> {
        let fit = Fit { view, boxes, size, margin, along_light: true };
        Self::fitted(view, &view.casters, points, &fit, Keep::One)
    }

    fn fitted(view: &'a LightView, casters: &'a DrawList, points: &[MapPoint], fit: &Fit, keep: Keep) -> Result<Self> {
        let size = fit.size;
        let fitted: Vec<(u32, Vec<Face>)> = points.par_iter().map(|point| fit.point(point)).collect();
        let most = most_faces(&view.gpu.device.limits(), size);
        let mut batches: Vec<Batch> = Vec::new();
        for (point, (cube_faces, faces)) in points.iter().zip(fitted) {
            if batches.last().is_none_or(|batch| batch.faces.len() + faces.len() > most) {
                batches.push(Batch::default());
            }
            let batch = batches.last_mut().expect("just pushed");
            batch.points.push(LightPoint {
                position: point.position.as_vec3(),
                weight: point.weight as f32,
                normal: view.emitter.normal.as_vec3(),
                first_face: batch.faces.len() as u32,
                cube_faces,
                padding: 0,
                padding_2: [0; 2],
            });
            batch.faces.extend(faces);
        }
        let layers = batches.iter().map(|batch| batch.faces.len().max(1) as u32);
        let layers = match keep {
            Keep::One => vec![layers.max().unwrap_or(1)],
            Keep::All => layers.collect(),
        };
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING;
        let texture = |layers| view.gpu.texture("shadow maps", [size, size, layers], DEPTH, usage);
        let depth = layers.into_iter().map(texture).collect::<Result<_>>()?;
        let count = batches.iter().map(|batch| batch.faces.len() as u32).sum();
        Ok(Self { view, casters, batches, depth, count })
    }

    /// Renders batch after batch and gives each to `evaluate`, which records what reads it; `done` takes what a batch's passes
    /// took, and may stop the work.
    ///
    /// # Errors
    /// Those of `done`.
    pub fn each_batch(
        &self,
        mut evaluate: impl FnMut(&mut Frame, &RenderedMaps),
        done: impl FnMut(Vec<crate::techniques::Pass>) -> Result<()>,
    ) -> Result<()> {
        self.each_batch_beside(None, |frame, maps, _| evaluate(frame, maps), done)
    }

    /// [`ShadowMaps::each_batch`], with the maps of other casters from the same points beside them.
    ///
    /// # Errors
    /// Those of `done`.
    pub fn each_batch_beside(
        &self,
        beside: Option<&Self>,
        mut evaluate: impl FnMut(&mut Frame, &RenderedMaps, Option<&RenderedMaps>),
        mut done: impl FnMut(Vec<crate::techniques::Pass>) -> Result<()>,
    ) -> Result<()> {
        for batch in 0..self.batches.len() {
            let mut frame = Frame::new(self.view.gpu);
            let maps = self.render(&mut frame, batch)?;
            let beside = beside.map(|maps| maps.render(&mut frame, batch)).transpose()?;
            evaluate(&mut frame, &maps, beside.as_ref());
            done(frame.finish()?)?;
        }
        Ok(())
    }

    /// How many batches there are.
    pub fn batches(&self) -> usize {
        self.batches.len()
    }

    /// Records the rendering of a batch.
    ///
    /// # Errors
    /// [`crate::Error::Gpu`] where what the maps need does not fit.
    pub fn render(&self, frame: &mut Frame, batch: usize) -> Result<RenderedMaps> {
        let gpu = self.view.gpu;
        let texture = &self.depth[batch.min(self.depth.len() - 1)];
        let first: usize = self.batches[..batch].iter().map(|batch| batch.points.len()).sum();
        let batch = &self.batches[batch];
        self.draw(frame, &pipelines(gpu, Kept::Nearest), texture, batch)?;
        Ok(RenderedMaps {
            range: first..first + batch.points.len(),
            faces: gpu.buffer("faces", &batch.faces, wgpu::BufferUsages::STORAGE)?,
            points: gpu.buffer("light points", &batch.points, wgpu::BufferUsages::STORAGE)?,
            depth: texture.create_view(&wgpu::TextureViewDescriptor {
                dimension: Some(wgpu::TextureViewDimension::D2Array),
                ..wgpu::TextureViewDescriptor::default()
            }),
        })
    }

    fn draw(
        &self,
        frame: &mut Frame,
        pipelines: &ScenePipelines,
        texture: &wgpu::Texture,
        Batch { faces, .. }: &Batch,
    ) -> Result<()> {
        let LightView { gpu, buffers, .. } = self.view;
        let casters = self.casters;
        let draws: Vec<Vec<Draw>> =
            faces.par_iter().map(|face| casters.draws(|bounds| is_in_view(face, bounds))).collect();
        let stride = face_stride(&gpu.device.limits());
        let mut bytes = vec![0u8; stride * faces.len()];
        for (slot, face) in bytes.chunks_exact_mut(stride).zip(faces) {
            slot[..size_of::<Face>()].copy_from_slice(bytemuck::bytes_of(face));
        }
        let uniforms = gpu.buffer("faces", &bytes, wgpu::BufferUsages::UNIFORM)?;
        for (layer, draws) in draws.iter().enumerate() {
            let face = wgpu::BindingResource::Buffer(wgpu::BufferBinding {
                buffer: &uniforms,
                offset: (stride * layer) as u64,
                size: wgpu::BufferSize::new(size_of::<Face>() as u64),
            });
            let groups = buffers.bind_groups(gpu, pipelines, &[("face", face)]);
            let target = layer_of(texture, layer as u32);
            let depth = attachment(&target, Kept::Nearest);
            frame
                .render("shadow maps", &[], Some(depth), |pass| buffers.draw(pass, pipelines, &groups, casters, draws));
        }
        Ok(())
    }
}

/// What maps like those of [`ShadowMaps::new`] show, a list a map: which way it looks (a unit vector), and how much of the view it
/// holds, in squared tangents, from a distant light in squared lengths on the GPU's scale.
pub fn shown_areas(
    view: &LightView,
    points: &[MapPoint],
    boxes: &[Bounds],
    [size, margin]: [u32; 2],
) -> Vec<(Vec3, f64)> {
    let fit = Fit { view, boxes, size, margin, along_light: false };
    let faces: Vec<Vec<Face>> = points.par_iter().map(|point| fit.point(point).1).collect();
    let area = |face: &Face| 1.0 / (f64::from(face.window.x) * f64::from(face.window.y));
    faces.iter().flatten().map(|face| (face.forward.truncate(), area(face))).collect()
}

fn pipelines(gpu: &Gpu, kept: Kept) -> ScenePipelines {
    let targets = Targets {
        vertices: &VERTEX_BUFFERS,
        fragment: false,
        colors: &[],
        depth: Some(wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(true),
            depth_compare: Some(match kept {
                Kept::Nearest => wgpu::CompareFunction::Greater,
                Kept::Farthest => wgpu::CompareFunction::Less,
            }),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
    };
    ScenePipelines::new(gpu, "passes/shadow_map.wgsl", targets)
}

/// Bytes from one face's uniform to the next: each is where a binding may start.
fn face_stride(limits: &wgpu::Limits) -> usize {
    size_of::<Face>().next_multiple_of(limits.min_uniform_buffer_offset_alignment.next_multiple_of(16) as usize)
}

/// How many maps of `size` texels a side are rendered at once, unless a single point has more.
fn most_faces(limits: &wgpu::Limits, size: u32) -> usize {
    let by_memory = BATCH_BYTES / (4 * u64::from(size).pow(2));
    let by_uniforms = limits.max_uniform_buffer_binding_size / face_stride(limits) as u64;
    let by_layers = u64::from(limits.max_texture_array_layers);
    by_memory.min(by_uniforms).min(by_layers).max(1) as usize
}

/// What maps are to hold.
struct Fit<'a> {
    view: &'a LightView<'a>,
    /// On the GPU's scale.
    boxes: &'a [Bounds],
    /// Of a map, texels.
    size: u32,
    /// Around the boxes, texels.
    margin: u32,
    /// Whether maps look along the light's normal where they can, rather than towards the middle of the receivers.
    along_light: bool,
}

/// How far beyond the farthest receiver a map sees, relative to its depth or, from far away, to the extent of all that is drawn,
/// which is about 1: enough for roundings of `f32`.
pub const BEYOND: f64 = 1e-3;

impl Fit<'_> {
    /// The maps of a point: which faces of a cube they are, and where each looks.
    fn point(&self, point: &MapPoint) -> (u32, Vec<Face>) {
        if self.view.emitter.distant {
            return (0, vec![self.distant(&self.axes(-point.position.normalize()))]);
        }
        let middle = self.view.receiver_bounds.center() - point.position;
        let toward = |forward, limits| self.frustum(point, &self.axes(forward), limits);
        let along_light = if self.along_light { toward(self.view.emitter.normal, ALONG_LIGHT) } else { None };
        let frustum = along_light.or_else(|| middle.try_normalize().and_then(|forward| toward(forward, TO_RECEIVERS)));
        if let Some(face) = frustum {
            return (0, vec![face]);
        }
        let mut faces = Vec::new();
        let mut held = 0;
        for index in 0..6 {
            if let Some(face) = self.cube_face(point, index) {
                held |= 1 << index;
                faces.push(face);
            }
        }
        (held, faces)
    }

    /// Right, up and forward as columns; up as near to the light's own as can be.
    fn axes(&self, forward: DVec3) -> DMat3 {
        let up = self.view.emitter.half_v.reject_from_normalized(forward);
        let up = up.try_normalize().unwrap_or_else(|| forward.any_orthonormal_vector());
        DMat3::from_cols(up.cross(forward), up, forward)
    }

    fn distant(&self, axes: &DMat3) -> Face {
        let (mut low, mut high, mut farthest) = (DVec2::INFINITY, DVec2::NEG_INFINITY, f64::NEG_INFINITY);
        for corner in self.boxes.iter().flat_map(Bounds::corners) {
            let seen = axes.transpose() * corner;
            (low, high, farthest) = (low.min(seen.truncate()), high.max(seen.truncate()), farthest.max(seen.z));
        }
        let casters = self.view.caster_bounds.union(self.view.receiver_bounds);
        let nearest = lowest(&casters, axes.z_axis);
        let depth = (farthest - nearest).max(f64::from(f32::EPSILON));
        let depths = [farthest - (1.0 + BEYOND) * depth, farthest + BEYOND * depth];
        self.face(axes, DVec3::ZERO, [low, high], depths)
    }

    /// The frustum towards the receivers, if one can hold the boxes.
    fn frustum(&self, point: &MapPoint, axes: &DMat3, limits: Limits) -> Option<Face> {
        let (mut low, mut high, mut farthest) = (DVec2::INFINITY, DVec2::NEG_INFINITY, 0.0f64);
        for corner in self.boxes.iter().flat_map(Bounds::corners) {
            let seen = axes.transpose() * (corner - point.position);
            if seen.z <= 0.0 || seen.truncate().abs().max_element() > limits.tangent * seen.z {
                return None;
            }
            let at = seen.truncate() / seen.z;
            (low, high, farthest) = (low.min(at), high.max(at), farthest.max(seen.z));
        }
        if low.abs().max(high.abs()).max_element() > limits.widths_aside * (high - low).max_element() {
            return None;
        }
        Some(self.face(axes, point.position, [low, high], self.depths(axes, point, farthest)))
    }

    /// A face of the cube around a point, if some of the boxes may lie in it.
    fn cube_face(&self, point: &MapPoint, index: usize) -> Option<Face> {
        let cube = if self.along_light { self.axes(self.view.emitter.normal) } else { DMat3::IDENTITY };
        let forward = cube.col(index / 2) * if index % 2 == 1 { 1.0 } else { -1.0 };
        let axes = DMat3::from_cols(cube.col((index / 2 + 1) % 3), cube.col((index / 2 + 2) % 3), forward);
        let (mut low, mut high, mut farthest) = (DVec2::INFINITY, DVec2::NEG_INFINITY, 0.0f64);
        for bounds in self.boxes {
            let corners = bounds.corners().map(|corner| axes.transpose() * (corner - point.position));
            // Beyond one of the face's four planes.
            let is_beyond = |distance: &dyn Fn(DVec3) -> f64| corners.iter().all(|&corner| distance(corner) > corner.z);
            if is_beyond(&|c| c.x) || is_beyond(&|c| -c.x) || is_beyond(&|c| c.y) || is_beyond(&|c| -c.y) {
                continue;
            }
            farthest = corners.iter().map(|corner| corner.z).fold(farthest, f64::max);
            // What reaches behind the point may be seen anywhere.
            let is_before = corners.iter().all(|corner| corner.z > 0.0);
            for corner in corners {
                let at = corner.truncate() / corner.z;
                low = low.min(if is_before { at.max(DVec2::NEG_ONE) } else { DVec2::NEG_ONE });
                high = high.max(if is_before { at.min(DVec2::ONE) } else { DVec2::ONE });
            }
        }
        (farthest > 0.0).then(|| self.face(&axes, point.position, [low, high], self.depths(&axes, point, farthest)))
    }

    /// Depths of the nearest caster and of the farthest receiver.
    fn depths(&self, axes: &DMat3, point: &MapPoint, farthest: f64) -> [f64; 2] {
        let farthest = farthest + BEYOND * farthest.min(1.0);
        let casters = &self.view.caster_bounds;
        let nearest = if casters.is_empty() {
            farthest
        } else {
            let nearest = lowest(casters, axes.z_axis) - axes.z_axis.dot(point.position);
            nearest - BEYOND * nearest.min(1.0)
        };
        let coordinates = casters.min.abs().max(casters.max.abs()).max(point.position.abs()).max_element();
        let known = if casters.is_empty() { 0.0 } else { ROUNDING * coordinates };
        // Some depth is left to a map without casters.
        [nearest.max(known).max(NEAREST * farthest).min(0.5 * farthest), farthest]
    }

    /// A face that sees from `low` to `high`, and from the depth of the nearest caster to that of the farthest receiver, both from
    /// the light point (from the origin for a distant light).
    fn face(&self, axes: &DMat3, position: DVec3, window: [DVec2; 2], depths: [f64; 2]) -> Face {
        Face::new(axes, position, self.view.emitter.distant, window, depths, [self.size, self.margin])
    }
}

impl Face {
    /// A map of `size` texels a side, `margin` more than what it is to hold on every side, that sees from `low` to `high` and from
    /// `nearest` to `farthest` along the axes right, up and forward from a position (from the origin for a distant light).
    pub fn new(
        axes: &DMat3,
        position: DVec3,
        distant: bool,
        [low, high]: [DVec2; 2],
        [nearest, farthest]: [f64; 2],
        [size, margin]: [u32; 2],
    ) -> Self {
        let inner = f64::from(size.saturating_sub(2 * margin).max(1)) / f64::from(size);
        // What lies on a line or in a point is given some width.
        let least = (1e-3 * (high - low).max_element()).max(1e-9);
        let width = (high - low).max(DVec2::splat(least)) / inner;
        let corner = 0.5 * (low + high) - 0.5 * width;
        let (scale, offset) = (1.0 / width, -corner / width);
        let (far, depth_scale) = if distant {
            (farthest, 1.0 / (farthest - nearest))
        } else {
            (farthest + axes.z_axis.dot(position), nearest / (farthest - nearest))
        };
        let row = |axis: DVec3| axis.extend(if distant { 0.0 } else { -axis.dot(position) }).as_vec4();
        Self {
            right: row(axes.x_axis),
            up: row(axes.y_axis),
            forward: row(axes.z_axis),
            window: Vec4::new(scale.x as f32, scale.y as f32, offset.x as f32, offset.y as f32),
            far: far as f32,
            depth_scale: depth_scale as f32,
            texel: (width.max_element() / f64::from(size)) as f32,
            distant: u32::from(distant),
        }
    }

    /// From where to where it sees, in its view.
    pub fn shown(&self) -> [DVec2; 2] {
        let [scale_x, scale_y, offset_x, offset_y] = self.window.as_dvec4().to_array();
        let (scale, offset) = (DVec2::new(scale_x, scale_y), DVec2::new(offset_x, offset_y));
        [-offset / scale, (1.0 - offset) / scale]
    }
}

/// Records a single map of part of the scene into a layer of a texture.
///
/// # Errors
/// [`crate::Error::Gpu`] where what it needs does not fit.
pub fn draw_face(
    frame: &mut Frame,
    name: &'static str,
    view: &LightView,
    list: &DrawList,
    (face, kept): (&Face, Kept),
    (texture, layer): (&wgpu::Texture, u32),
) -> Result<()> {
    let uniform = view.gpu.buffer("face", std::slice::from_ref(face), wgpu::BufferUsages::UNIFORM)?;
    let pipelines = pipelines(view.gpu, kept);
    let groups = view.buffers.bind_groups(view.gpu, &pipelines, &[("face", uniform.as_entire_binding())]);
    let target = layer_of(texture, layer);
    let draws = list.draws(|bounds| is_in_view(face, bounds));
    frame.render(name, &[], Some(attachment(&target, kept)), |pass| {
        view.buffers.draw(pass, &pipelines, &groups, list, &draws);
    });
    Ok(())
}

/// A layer to be drawn into.
fn layer_of(texture: &wgpu::Texture, layer: u32) -> wgpu::TextureView {
    texture.create_view(&wgpu::TextureViewDescriptor {
        dimension: Some(wgpu::TextureViewDimension::D2),
        base_array_layer: layer,
        array_layer_count: Some(1),
        ..wgpu::TextureViewDescriptor::default()
    })
}

fn attachment(target: &wgpu::TextureView, kept: Kept) -> wgpu::RenderPassDepthStencilAttachment<'_> {
    let nothing = match kept {
        Kept::Nearest => 0.0,
        Kept::Farthest => 1.0,
    };
    wgpu::RenderPassDepthStencilAttachment {
        view: target,
        depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(nothing), store: wgpu::StoreOp::Store }),
        stencil_ops: None,
    }
}

/// The lowest coordinate along an axis.
fn lowest(bounds: &Bounds, axis: DVec3) -> f64 {
    bounds.corners().map(|corner| axis.dot(corner)).into_iter().fold(f64::INFINITY, f64::min)
}

/// Whether a face may see some of what lies within bounds.
fn is_in_view(face: &Face, bounds: &Bounds) -> bool {
    let rows = [face.right, face.up, face.forward].map(Vec4::as_dvec4);
    let along = rows[2].with_w(0.0);
    let z = if face.distant == 1 { DVec4::W } else { rows[2] };
    let [scale_x, scale_y, offset_x, offset_y] = face.window.as_dvec4().to_array();
    // Each is negative on one side of a plane of the view, of all that is outside: left, right, top, bottom, behind the farthest
    // receiver, behind the light.
    let (x, y) = (scale_x * rows[0] + offset_x * z, scale_y * rows[1] + offset_y * z);
    let far = DVec4::W * f64::from(face.far) - along;
    let (center, half) = (bounds.center().extend(1.0), (0.5 * bounds.size()).extend(0.0));
    [x, z - x, y, z - y, far, z].iter().all(|plane| {
        let magnitude = (plane.abs() * (center.abs() + half)).element_sum();
        plane.dot(center) + plane.abs().dot(half) >= -4.0 * f64::from(f32::EPSILON) * magnitude
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_batch_fits_memory_and_bindings() {
        let limits = wgpu::Limits::default();
        // 1 GiB each.
        assert_eq!(most_faces(&limits, 16_384), 1);
        assert_eq!(most_faces(&limits, 1024), 64);
        let most = most_faces(&limits, 1);
        assert!(most > 1 && most <= limits.max_texture_array_layers as usize);
        assert!((most * face_stride(&limits)) as u64 <= limits.max_uniform_buffer_binding_size);
    }
}
