//! What each pixel sees, rasterised: instance and triangle. Position and normals follow from these and the pixel's ray by the
//! formula that rays use, in double precision.

use glam::{DMat3, DMat4, DVec2, DVec3, DVec4, Mat4};
use rayon::prelude::*;

use super::Gpu;
use super::pass::Frame;
use super::scene::{DrawSpace, Part, SceneBuffers, ScenePipelines, VERTEX_BUFFERS, unit_above};
use super::shader::Targets;
use crate::Result;
use crate::geometry::bvh::{SceneBvh, is_out_of_view};
use crate::gpu_struct;
use crate::receivers::{Receiver, Receivers, receiver_on};
use crate::scene::{Camera, Projection, Scene};
use crate::techniques::Pass;

gpu_struct! {
    /// Twin of `View` in `passes/gbuffer.wgsl`.
    struct View {
        pub clip_from_scene: Mat4,
    }
}

/// Depth of scene passes: reversed, so that f32's precision follows the distance.
pub const DEPTH: wgpu::TextureFormat = wgpu::TextureFormat::Depth32Float;

/// Numbers of instance and triangle, plus one; zero for none.
const IDS: wgpu::TextureFormat = wgpu::TextureFormat::Rg32Uint;

fn pipelines(gpu: &Gpu) -> ScenePipelines {
    let targets = Targets {
        vertices: &VERTEX_BUFFERS,
        fragment: true,
        colors: &[Some(IDS.into())],
        depth: Some(wgpu::DepthStencilState {
            format: DEPTH,
            depth_write_enabled: Some(true),
            depth_compare: Some(wgpu::CompareFunction::Greater),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
    };
    ScenePipelines::new(gpu, "passes/gbuffer.wgsl", targets)
}

/// The receivers of an image and of a border around it, and the times of the passes; `offset_px` as of [`Receivers::find`].
///
/// # Errors
/// [`crate::Error::Gpu`] where the image does not fit.
pub fn receivers(
    gpu: &Gpu,
    (scene, buffers, bvh): (&Scene, &SceneBuffers, &SceneBvh),
    camera: &Camera,
    (size, border): ([u32; 2], [u32; 2]),
    offset_px: DVec2,
) -> Result<(Receivers, Vec<Pass>)> {
    let inner_size = size;
    let size = [0, 1].map(|i| size[i] + 2 * border[i]);
    let [width, height] = size;
    // The image with its border, as a camera of a wider view sees it.
    let inner_camera = camera;
    let camera = &camera.widened(inner_size, border);
    let usage = wgpu::TextureUsages::RENDER_ATTACHMENT;
    let ids = gpu.texture("G-buffer", [width, height, 1], IDS, usage | wgpu::TextureUsages::COPY_SRC)?;
    let depth = gpu.texture("G-buffer's depth", [width, height, 1], DEPTH, usage)?;
    let bounds: Vec<_> = (0..scene.instances.len()).map(|i| bvh.instance_bounds(i)).collect();
    let origin = camera.scene_from_camera.translation;
    let farthest = bounds
        .iter()
        .filter(|b| !b.is_empty())
        .flat_map(|b| b.corners())
        .map(|corner| (corner - origin).length())
        .fold(0.0, f64::max);
    let space = DrawSpace { origin, unit: unit_above(farthest) };
    // Triangles are numbered from the start of a draw: meshes are drawn whole.
    let list = buffers.draw_list(gpu, scene, space, Part::Whole, |_, bounds| !is_out_of_view(bounds, camera, size))?;
    let view = View { clip_from_scene: clip_from_scene(camera, size, offset_px, farthest, space.unit) };
    let view = gpu.buffer("view", &[view], wgpu::BufferUsages::UNIFORM)?;
    let pipelines = pipelines(gpu);
    let groups = buffers.bind_groups(gpu, &pipelines, &[("view", view.as_entire_binding())]);

    let mut frame = Frame::new(gpu);
    let (ids_view, depth_view) = (ids.create_view(&Default::default()), depth.create_view(&Default::default()));
    let color = wgpu::RenderPassColorAttachment {
        view: &ids_view,
        depth_slice: None,
        resolve_target: None,
        ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store },
    };
    let depth_attachment = wgpu::RenderPassDepthStencilAttachment {
        view: &depth_view,
        depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Discard }),
        stencil_ops: None,
    };
    frame.render("G-buffer", &[Some(color)], Some(depth_attachment), |pass| {
        buffers.draw(pass, &pipelines, &groups, &list, &list.draws(|_| true));
    });
    let (padded, buffer) = gpu.copy_of(&ids, frame.encoder())?;
    let passes = frame.finish()?;
    let words: Vec<u32> = gpu.read_buffer(&buffer)?;
    let row_words = padded as usize / 4;
    let pixel = |index: usize| {
        let (x, y) = (index % width as usize, index / width as usize);
        let at = y * row_words + 2 * x;
        let (instance, triangle) = (words[at].checked_sub(1)?, words[at + 1].checked_sub(1)?);
        // The ray of the image alone: to the bit what it is without a border.
        let at_px = DVec2::new(x as f64 - f64::from(border[0]), y as f64 - f64::from(border[1]));
        let ray = inner_camera.ray(at_px + offset_px, inner_size);
        receiver_on(bvh, inner_camera, ray, instance, triangle)
    };
    let pixels: Vec<Option<Receiver>> =
        (0..width as usize * height as usize).into_par_iter().with_min_len(1024).map(pixel).collect();
    Ok((Receivers { size, pixels }, passes))
}

/// From scene space, relative to the camera's place and in units, to clip space, depth reversed: 1 at the nearest, 0 at the
/// farthest.
fn clip_from_scene(camera: &Camera, size: [u32; 2], offset_px: DVec2, farthest: f64, unit: f64) -> Mat4 {
    let [width, height] = size.map(f64::from);
    let camera_from_scene: DMat3 = camera.scene_from_camera.matrix3.transpose();
    let (camera_near, farthest) = (camera.near / unit, farthest / unit);
    // A receiver nearer than a millionth of the scene has no depth of its own; rays that start at the pinhole see it.
    let near = camera_near.max(1e-6 * farthest).max(f64::from(f32::MIN_POSITIVE));
    let projection = match camera.projection {
        Projection::Perspective { fov_y } => {
            let slope = (0.5 * fov_y).tan();
            DMat4::from_cols(
                DVec4::new(height / (width * slope), 0.0, 0.0, 0.0),
                DVec4::new(0.0, 1.0 / slope, 0.0, 0.0),
                DVec4::new(0.0, 0.0, 0.0, -1.0),
                DVec4::new(0.0, 0.0, near, 0.0),
            )
        }
        Projection::Orthographic { half_height } => {
            let half_height = half_height / unit;
            // Seen from camera.near on: z from there to the farthest, reversed.
            let depth = (farthest - camera_near).max(f64::from(f32::MIN_POSITIVE));
            DMat4::from_cols(
                DVec4::new(height / (width * half_height), 0.0, 0.0, 0.0),
                DVec4::new(0.0, 1.0 / half_height, 0.0, 0.0),
                DVec4::new(0.0, 0.0, 1.0 / depth, 0.0),
                DVec4::new(0.0, 0.0, farthest / depth, 1.0),
            )
        }
    };
    // The rasteriser samples pixel centres.
    let shift = DVec3::new((1.0 - 2.0 * offset_px.x) / width, (2.0 * offset_px.y - 1.0) / height, 0.0);
    (DMat4::from_translation(shift) * projection * DMat4::from_mat3(camera_from_scene)).as_mat4()
}
