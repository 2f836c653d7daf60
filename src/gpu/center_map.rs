//! Techniques that read a single shadow map, seen from the light's centre.

use glam::{DVec3, Vec3};

use super::Gpu;
use super::light_view::{LightView, WORKGROUP, fraction_above};
use super::min_max::{Bounded, MinMax};
use super::shader::Constants;
use super::shadow_map::{self, MapPoint, ShadowMaps};
use crate::Result;
use crate::gpu_struct;
use crate::scene::light::Domain;
use crate::scene::{AreaLight, Bounds};
use crate::techniques::{Frame, LightImage};

gpu_struct! {
    /// Twin of `Emitter` in `lib/emitter.wgsl`.
    struct Emitter {
        pub center: Vec3,
        pub domain: u32,
        pub half_u: Vec3,
        pub distant: u32,
        pub half_v: Vec3,
        pub nearest: f32,
        pub normal: Vec3,
        pub padding: u32,
    }
}

/// What such a technique does with its map.
#[derive(Debug)]
pub struct Settings<'a> {
    /// Below `shaders/`; its `main` writes `visibility` for each of `receivers`.
    pub shader: &'a str,
    /// Its constants.
    pub constants: Constants<'a>,
    /// Texels a side of the map.
    pub map_size: u32,
    /// Texels that the shader reads beyond what it is to hold.
    pub margin: u32,
    /// Where the shader's kernels may lie: between the receivers and this fraction of the way from the light to them, around any
    /// ray from one to the other; 1 for what reads the receivers' own surroundings alone.
    pub nearest: f64,
    /// Whether V is limited to the fraction of the light above the tangent plane: one map knows nothing of it.
    pub filters: bool,
}

/// The min–max pyramid over such a map.
#[derive(Debug, Clone, Copy)]
pub struct Pyramid {
    /// What its nodes bound.
    pub bounded: Bounded,
    /// Whether the map looks along the light's normal, where it can, rather than towards the middle of the receivers.
    pub along_light: bool,
}

/// The image of a light.
///
/// # Errors
/// What does not fit the GPU, and cancellation.
pub fn render(gpu: &Gpu, frame: &Frame, light: &AreaLight, settings: &Settings) -> Result<LightImage> {
    render_over(gpu, frame, light, settings, None)
}

/// [`render`], of a shader that also reads the map's min–max `pyramid`.
///
/// # Errors
/// As [`render`].
pub fn render_over_pyramid(
    gpu: &Gpu,
    frame: &Frame,
    light: &AreaLight,
    settings: &Settings,
    pyramid: Pyramid,
) -> Result<LightImage> {
    render_over(gpu, frame, light, settings, Some(pyramid))
}

fn render_over(
    gpu: &Gpu,
    frame: &Frame,
    light: &AreaLight,
    settings: &Settings,
    pyramid: Option<Pyramid>,
) -> Result<LightImage> {
    let Some(view) = LightView::new(gpu, frame, light)? else {
        frame.progress.advance(u64::from(frame.receivers.size[1]))?;
        return Ok(LightView::image(None, frame, light, |_, _, _| (0.0, 0.0)));
    };
    let points = [MapPoint { position: view.emitter.center, weight: 1.0 }];
    let (boxes, size) = (kernels(&view, settings.nearest), [settings.map_size, settings.margin]);
    let maps = match pyramid {
        Some(Pyramid { along_light: true, .. }) => ShadowMaps::along_light(&view, &points, &boxes, size)?,
        _ => ShadowMaps::new(&view, &points, &boxes, settings.map_size, settings.margin)?,
    };
    // The faces of a point are rendered together, and all stay.
    let pyramid =
        pyramid.map(|pyramid| MinMax::new(gpu, settings.map_size, maps.count.max(1), pyramid.bounded)).transpose()?;
    let constants: Vec<_> = [shadow_map::CONSTANTS, settings.constants].concat();
    let pipeline = gpu.compute_pipeline(settings.shader, "main", &constants);
    let answers: Vec<wgpu::Buffer> = view
        .chunks
        .iter()
        .map(|chunk| gpu.empty_buffer("visibility", 4 * chunk.pixels.len() as u64, wgpu::BufferUsages::STORAGE))
        .collect::<Result<_>>()?;
    let emitter = gpu.buffer("emitter", &[emitter_of(&view)], wgpu::BufferUsages::UNIFORM)?;
    let counter = gpu.counter()?;
    let mut passes = Vec::new();
    let record = |frame: &mut super::pass::Frame, maps: &shadow_map::RenderedMaps| {
        if let Some(pyramid) = &pyramid {
            pyramid.build(frame, &maps.depth);
        }
        for (chunk, answer) in view.chunks.iter().zip(&answers) {
            let mut pass = frame
                .compute("visibility", &pipeline)
                .bind("faces", &maps.faces)
                .bind("points", &maps.points)
                .bind("receivers", &chunk.buffer)
                .bind("shadow_depth", &maps.depth)
                .bind("visibility", answer)
                .bind("counted", &counter);
            if pipeline.bindings.contains_key("emitter") {
                pass = pass.bind("emitter", &emitter);
            }
            if let Some(pyramid) = &pyramid {
                pass = pass.bind("pyramid", &pyramid.nodes);
            }
            pass.dispatch([(chunk.pixels.len() as u32).div_ceil(WORKGROUP), 1, 1]);
        }
    };
    maps.each_batch(record, |timed| {
        passes = timed;
        frame.progress.check()
    })?;
    let visibility: Vec<Vec<f32>> = answers.iter().map(|answer| gpu.read_buffer(answer)).collect::<Result<_>>()?;
    let image = LightView::image(Some(&view), frame, light, |chunk, i, receiver| {
        let mut seen = f64::from(visibility[chunk][i]);
        if settings.filters {
            seen = seen.min(fraction_above(light, receiver));
        }
        (seen, seen)
    });
    frame.progress.advance(u64::from(frame.receivers.size[1]))?;
    Ok(LightImage {
        samples: 1,
        shadow_maps: maps.count,
        texels: gpu.count(&counter)?,
        approximate: true,
        passes,
        ..image
    })
}

/// Boxes around all places between receivers and the light where kernels may lie, as [`Settings::nearest`] bounds them.
pub fn kernels(view: &LightView, nearest: f64) -> Vec<Bounds> {
    let emitter = &view.emitter;
    let spread = emitter.half_u.abs() + emitter.half_v.abs();
    let casters = view.caster_bounds.union(view.receiver_bounds);
    let caster_depth = nearest_along(view) - emitter.normal.dot(emitter.center);
    let kernel = |tile: &Bounds| {
        if emitter.distant {
            // Up to the nearest caster.
            let [low, high] = [tile, &casters].map(|b| b.corners().map(|c| emitter.center.dot(c)));
            let most = high.into_iter().fold(0.0, f64::max) - low.into_iter().fold(f64::INFINITY, f64::min);
            let reach = (1.0 - nearest) * most.max(0.0);
            let [near, far] = [emitter.center - spread, emitter.center + spread].map(|to| reach * to);
            return tile.union(Bounds { min: tile.min + near, max: tile.max + far });
        }
        // Up to the nearest caster too: from far away that is much less of the way.
        let depths = tile.corners().map(|corner| emitter.normal.dot(corner - emitter.center));
        let is_before = depths.iter().all(|&depth| depth > 0.0);
        let deepest = depths.into_iter().fold(0.0, f64::max);
        let nearest = if is_before { nearest.max((caster_depth / deepest).min(1.0)) } else { nearest };
        let toward = |corner: DVec3, light: DVec3| nearest * corner + (1.0 - nearest) * light;
        tile.union(Bounds {
            min: toward(tile.min, emitter.center - spread),
            max: toward(tile.max, emitter.center + spread),
        })
    };
    view.tiles.iter().map(kernel).collect()
}

/// Where the nearest caster may begin, from the origin along the light's normal; 0 without casters.
fn nearest_along(view: &LightView) -> f64 {
    if view.caster_bounds.is_empty() {
        return 0.0;
    }
    view.caster_bounds.corners().map(|corner| view.emitter.normal.dot(corner)).into_iter().fold(f64::INFINITY, f64::min)
}

/// A light's emitter as shaders read it.
pub fn emitter_of(view: &LightView) -> impl bytemuck::Pod {
    let emitter = &view.emitter;
    Emitter {
        center: emitter.center.as_vec3(),
        domain: match emitter.domain {
            Domain::Rect => 0,
            Domain::Disk => 1,
            Domain::Point => 2,
        },
        half_u: emitter.half_u.as_vec3(),
        distant: u32::from(emitter.distant),
        half_v: emitter.half_v.as_vec3(),
        nearest: nearest_along(view) as f32,
        normal: emitter.normal.as_vec3(),
        padding: 0,
    }
}
