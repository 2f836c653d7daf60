//! From a scene and a camera to images: receivers, the hierarchy that they need, a technique for each light.

use std::time::Instant;

use glam::DVec2;

use crate::geometry::bvh::{SceneBvh, is_out_of_view};
use crate::geometry::shaft::{Shaft, light_bounds};
use crate::gpu::scene::SceneBuffers;
use crate::gpu::{Adapter, Gpu, gbuffer};
use crate::history::{History, Shot};
use crate::progress::{Progress, ms_since};
use crate::receivers::{Receivers, within};
use crate::reference::verify::{self, Verified};
use crate::scene::{AreaLight, Bounds, Camera, Scene, Shape};
use crate::shading::{Shading, add_radiance};
use crate::techniques::{Frame, LightImage, Pass, Technique, add_passes};
use crate::{Error, Result};

/// What is asked for.
#[derive(Debug, Clone)]
pub struct Request {
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Irradiance beside visibility.
    pub irradiance: bool,
    /// The shaded image, which needs irradiance, and how surfaces reflect in it.
    pub shaded: Option<Shading>,
    /// Sub-pixels a side for irradiance and the shaded image; visibility is always that of the pixel's centre.
    pub antialiasing: u32,
    /// Receivers at which each light's visibility is held against the exact answer; none to leave it.
    pub verify: Option<u32>,
}

/// What was done and what was not needed: what a scene lacks costs nothing, and this is how that is checked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize)]
pub struct Counters {
    /// Triangles put into hierarchies; those neither seen nor able to block a light are not.
    pub stored_triangles: u64,
    /// Bytes of the hierarchies.
    pub hierarchy_bytes: u64,
    /// Occlusion rays traced.
    pub rays: u64,
    /// Lights that took a pass.
    pub lights_traced: u32,
    /// Lights that reach no receiver and took none.
    pub lights_skipped: u32,
}

/// A finished image.
#[derive(Debug, Clone)]
pub struct Rendering {
    /// The receivers at pixel centres.
    pub receivers: Receivers,
    /// One for each of the scene's lights.
    pub lights: Vec<LightImage>,
    /// Radiance towards the camera, W/(m²·sr), RGB; empty unless asked for.
    pub shaded: Vec<[f32; 3]>,
    /// The measured error of each light; empty unless asked for.
    pub verified: Vec<Verified>,
    /// What it took.
    pub counters: Counters,
    /// What the technique ran on.
    pub adapter: Adapter,
    /// Memory of the GPU that was held at most, bytes.
    pub gpu_bytes: u64,
    /// Building receivers and hierarchies or, on a GPU, its buffers, ms.
    pub build_ms: f64,
    /// The passes of it that a GPU timed.
    pub build_passes: Vec<Pass>,
    /// The technique, ms.
    pub render_ms: f64,
    /// The exact answers that the image was held against, ms.
    pub verify_ms: f64,
}

/// Renders the scene's lights from a camera.
///
/// # Errors
/// [`Error::NoLight`] without a light; [`Error::Cancelled`]; what the technique can't do.
pub fn render(
    scene: &Scene,
    camera: &Camera,
    technique: &dyn Technique,
    request: &Request,
    progress: &Progress,
) -> Result<Rendering> {
    render_after(None, scene, camera, technique, request, progress)
}

/// [`render`], after the frames of a history.
fn render_after(
    history: Option<&History>,
    scene: &Scene,
    camera: &Camera,
    technique: &dyn Technique,
    request: &Request,
    progress: &Progress,
) -> Result<Rendering> {
    if scene.lights.is_empty() {
        return Err(no_light(scene));
    }
    let border = technique.border_px(request.size);
    let seen_size = [0, 1].map(|i| u64::from(request.size[i]) + 2 * u64::from(border[i]));
    check_memory(scene, seen_size[0] * seen_size[1])?;
    let passes = if request.irradiance || request.shaded.is_some() { request.antialiasing.pow(2) } else { 0 };
    let rows = seen_size[1];
    let lights = scene.lights.len() as u64;
    let verify_steps = lights * request.verify.map_or(0, verify::steps);
    progress.begin(rows * u64::from(1 + passes) * (1 + lights) + verify_steps);

    let shot = Shot { camera, size: request.size, border, pass: 0, offset_px: DVec2::splat(0.5), history };
    let mut view = View::new(scene, shot, technique.gpu())?;
    let seen = view.receivers(DVec2::splat(0.5), progress)?;
    let inner = (border != [0; 2]).then(|| seen.within(border));
    let receivers = inner.as_ref().unwrap_or(&seen);
    // With one receiver a pixel, the centre serves both quantities.
    let at_centers = passes <= 1;
    let mut lights = view.lights(&seen, technique, at_centers && passes == 1, progress)?;
    let mut shaded = if request.shaded.is_some() { vec![[0.0; 3]; receivers.pixels.len()] } else { Vec::new() };
    if at_centers {
        if let Some(shading) = request.shaded {
            add_radiance(&mut shaded, shading, (scene, receivers), &lights, &shot);
        }
    } else {
        let n = request.antialiasing;
        let share = 1.0 / f64::from(passes);
        let mut sums = vec![vec![[0f64; 3]; receivers.pixels.len()]; scene.lights.len()];
        let mut shaded_sum = vec![[0f64; 3]; shaded.len()];
        for i in 0..passes {
            let offset = DVec2::new(f64::from(i % n) + 0.5, f64::from(i / n) + 0.5) / f64::from(n);
            let shot = Shot { pass: 1 + i, offset_px: offset, ..shot };
            view.shot = Some(shot);
            let seen = view.receivers(offset, progress)?;
            let lights = view.lights(&seen, technique, true, progress)?;
            let receivers = seen.within(border);
            for (sum, light) in sums.iter_mut().zip(&lights) {
                accumulate(sum, &light.irradiance, share);
            }
            if let Some(shading) = request.shaded {
                let mut pass = vec![[0.0; 3]; shaded.len()];
                add_radiance(&mut pass, shading, (scene, &receivers), &lights, &shot);
                accumulate(&mut shaded_sum, &pass, share);
            }
        }
        for (light, sum) in lights.iter_mut().zip(sums) {
            // Irradiance is a surface's: a pixel whose centre has none holds none, whatever its corners hold.
            let covered = sum.into_iter().zip(&receivers.pixels);
            light.irradiance =
                covered.map(|(rgb, pixel)| if pixel.is_some() { rgb.map(|x| x as f32) } else { [0.0; 3] }).collect();
        }
        shaded = shaded_sum.into_iter().map(|rgb| rgb.map(|x| x as f32)).collect();
    }
    let verify_start = Instant::now();
    let mut verified = Vec::new();
    if let Some(count) = request.verify {
        view.add_blockers(&view.reaching(&receivers.bounds()), &receivers.bounds());
        for pair in scene.lights.iter().zip(&lights) {
            verified.push(verify::verify(scene, &view.bvh, receivers, pair, count, progress)?);
        }
    }
    let verify_ms = ms_since(verify_start);
    Ok(Rendering { shaded, verified, verify_ms, ..view.finish(inner.unwrap_or(seen), lights) })
}

/// Frames that follow each other: what a technique keeps from one for the next.
#[derive(Debug)]
pub struct Sequence<'t> {
    technique: &'t dyn Technique,
    history: History,
}

impl<'t> Sequence<'t> {
    /// Before its first frame.
    pub fn new(technique: &'t dyn Technique) -> Self {
        Self { technique, history: History::default() }
    }

    /// The next frame: as [`render`], but that a technique may go on from the frames before.
    ///
    /// # Errors
    /// As [`render`].
    pub fn frame(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        request: &Request,
        progress: &Progress,
    ) -> Result<Rendering> {
        let rendering = render_after(Some(&self.history), scene, camera, self.technique, request, progress);
        match &rendering {
            Ok(_) => self.history.advance(scene, camera, request.size),
            // What was kept so far is of no frame.
            Err(_) => self.history = History::default(),
        }
        rendering
    }
}

/// Evaluates the scene's lights at given receivers.
///
/// # Errors
/// As [`render`].
pub fn render_receivers(
    scene: &Scene,
    receivers: Receivers,
    technique: &dyn Technique,
    irradiance: bool,
    progress: &Progress,
) -> Result<Rendering> {
    if scene.lights.is_empty() {
        return Err(no_light(scene));
    }
    check_memory(scene, receivers.pixels.len() as u64)?;
    progress.begin(u64::from(receivers.size[1]) * scene.lights.len() as u64);
    let mut view = View::without_camera(scene, technique.gpu())?;
    let lights = view.lights(&receivers, technique, irradiance, progress)?;
    Ok(view.finish(receivers, lights))
}

/// Most values of visibility, lights times pixels: with irradiance they take some 4 GB.
const MAX_VALUES: u64 = 1 << 27;

/// Refuses what would not fit, before anything is computed.
fn check_memory(scene: &Scene, pixels: u64) -> Result<()> {
    let lights = scene.lights.len() as u64;
    if lights.saturating_mul(pixels) <= MAX_VALUES {
        return Ok(());
    }
    let message = format!(
        "{lights} lights at {pixels} pixels are more than {MAX_VALUES} values; name fewer lights (--light) or take a smaller \
         --size"
    );
    Err(Error::usage(scene.name.clone(), message))
}

/// The error for a scene without light.
pub fn no_light(scene: &Scene) -> Error {
    let found = format!(
        "{} triangles, {} instances, {} cameras",
        scene.triangle_count(),
        scene.instances.len(),
        scene.cameras.len()
    );
    Error::NoLight { scene: scene.name.clone(), found }
}

/// A scene with the hierarchy that its view needs so far, or as a GPU holds it.
struct View<'a> {
    scene: &'a Scene,
    shot: Option<Shot<'a>>,
    gpu: Option<(&'a Gpu, SceneBuffers)>,
    bvh: SceneBvh<'a>,
    counters: Counters,
    build_ms: f64,
    build_passes: Vec<Pass>,
    render_ms: f64,
}

impl<'a> View<'a> {
    fn new(scene: &'a Scene, shot: Shot<'a>, gpu: Option<&'a Gpu>) -> Result<Self> {
        let Shot { camera, size, .. } = shot;
        let mut view = Self { shot: Some(shot), ..Self::without_camera(scene, gpu)? };
        if gpu.is_none() {
            let start = Instant::now();
            let bounds: Vec<Bounds> = (0..scene.instances.len()).map(|i| view.bvh.instance_bounds(i)).collect();
            view.bvh.add(|i| !is_out_of_view(&bounds[i], camera, size));
            view.build_ms += ms_since(start);
        }
        Ok(view)
    }

    fn without_camera(scene: &'a Scene, gpu: Option<&'a Gpu>) -> Result<Self> {
        let start = Instant::now();
        let bvh = SceneBvh::new(scene);
        let gpu = gpu.map(|gpu| Ok::<_, Error>((gpu, SceneBuffers::new(gpu, scene)?))).transpose()?;
        let (counters, build_passes) = (Counters::default(), Vec::new());
        Ok(Self { scene, shot: None, gpu, bvh, counters, build_ms: ms_since(start), build_passes, render_ms: 0.0 })
    }

    fn finish(self, receivers: Receivers, lights: Vec<LightImage>) -> Rendering {
        let Self { mut counters, build_ms, build_passes, render_ms, bvh, gpu, .. } = self;
        counters.stored_triangles = bvh.stored_triangles;
        counters.hierarchy_bytes = bvh.bytes() as u64;
        Rendering {
            receivers,
            lights,
            shaded: Vec::new(),
            verified: Vec::new(),
            counters,
            adapter: gpu.as_ref().map_or_else(Adapter::cpu, |(gpu, _)| gpu.adapter.clone()),
            gpu_bytes: gpu.as_ref().map_or(0, |(gpu, _)| gpu.peak_bytes()),
            build_ms,
            build_passes,
            render_ms,
            verify_ms: 0.0,
        }
    }

    fn receivers(&mut self, offset_px: DVec2, progress: &Progress) -> Result<Receivers> {
        let start = Instant::now();
        let Shot { camera, size, border, .. } = self.shot.expect("receivers come from a camera");
        let receivers = match &self.gpu {
            None => Receivers::find(&self.bvh, camera, size, offset_px, progress)?,
            Some((gpu, buffers)) => {
                let (receivers, passes) =
                    gbuffer::receivers(gpu, (self.scene, buffers, &self.bvh), camera, (size, border), offset_px)?;
                add_passes(&mut self.build_passes, passes);
                progress.advance(u64::from(receivers.size[1]))?;
                receivers
            }
        };
        self.build_ms += ms_since(start);
        Ok(receivers)
    }

    fn lights(
        &mut self,
        receivers: &Receivers,
        technique: &dyn Technique,
        irradiance: bool,
        progress: &Progress,
    ) -> Result<Vec<LightImage>> {
        let receiver_bounds = receivers.bounds();
        let border = self.shot.map_or([0; 2], |shot| shot.border);
        let reaching = self.reaching(&receiver_bounds);
        if self.gpu.is_none() {
            self.add_blockers(&reaching, &receiver_bounds);
        }
        let mut images = Vec::with_capacity(reaching.len());
        for (light, reaches) in self.scene.lights.iter().zip(reaching) {
            if !reaches {
                self.counters.lights_skipped += 1;
                progress.advance(u64::from(receivers.size[1]))?;
                images.push(unlit(&receivers.within(border), irradiance));
                continue;
            }
            let start = Instant::now();
            let buffers = self.gpu.as_ref().map(|(_, buffers)| buffers);
            let shot = self.shot.as_ref();
            let frame = Frame { scene: self.scene, bvh: &self.bvh, receivers, irradiance, progress, buffers, shot };
            let image = technique.render(&frame, light)?;
            self.render_ms += ms_since(start);
            self.counters.lights_traced += 1;
            self.counters.rays += image.rays;
            images.push(if border == [0; 2] { image } else { image_within(image, receivers.size, border) });
        }
        Ok(images)
    }

    /// Which lights may reach receivers within bounds.
    fn reaching(&self, receiver_bounds: &Bounds) -> Vec<bool> {
        self.scene.lights.iter().map(|light| reaches_any(light, receiver_bounds)).collect()
    }

    /// Adds what lies between the receivers and the lights that reach them.
    fn add_blockers(&mut self, reaching: &[bool], receiver_bounds: &Bounds) {
        let start = Instant::now();
        let bounds: Vec<Bounds> = (0..self.scene.instances.len()).map(|i| self.bvh.instance_bounds(i)).collect();
        let scene_bounds = bounds.iter().copied().fold(Bounds::EMPTY, Bounds::union);
        let shafts: Vec<Shaft> = self
            .scene
            .lights
            .iter()
            .zip(reaching)
            .filter(|(light, reaches)| **reaches && light.casts_shadow)
            .map(|(light, _)| Shaft::between(receiver_bounds, &light_bounds(light, receiver_bounds, &scene_bounds)))
            .collect();
        self.bvh.add(|i| shafts.iter().any(|shaft| !shaft.excludes(&bounds[i])));
        self.build_ms += ms_since(start);
    }
}

/// Whether some receiver may lie on the emitting side of a light.
fn reaches_any(light: &AreaLight, receivers: &Bounds) -> bool {
    if receivers.is_empty() {
        return false;
    }
    match light.shape {
        Shape::Rect { .. } | Shape::Disk { .. } => {
            let center = light.scene_from_light.translation;
            receivers.corners().iter().any(|corner| light.axis().dot(*corner - center) > 0.0)
        }
        Shape::Sphere { .. } | Shape::Tube { .. } | Shape::Sun { .. } | Shape::Point => true,
    }
}

/// A light's image within a border.
fn image_within(image: LightImage, size: [u32; 2], border: [u32; 2]) -> LightImage {
    LightImage {
        visibility: within(&image.visibility, size, border),
        irradiance: within(&image.irradiance, size, border),
        irradiance_ratio: within(&image.irradiance_ratio, size, border),
        facing: within(&image.facing, size, border),
        sampled: within(&image.sampled, size, border),
        ..image
    }
}

/// What a light that reaches no receiver leaves.
fn unlit(receivers: &Receivers, irradiance: bool) -> LightImage {
    let pixels = &receivers.pixels;
    let missed: Vec<f32> = pixels.iter().map(|pixel| if pixel.is_some() { 0.0 } else { 1.0 }).collect();
    LightImage {
        visibility: missed.clone(),
        irradiance: if irradiance { vec![[0.0; 3]; pixels.len()] } else { Vec::new() },
        irradiance_ratio: if irradiance { missed.clone() } else { Vec::new() },
        facing: vec![false; pixels.len()],
        ..LightImage::default()
    }
}

fn accumulate(sum: &mut [[f64; 3]], values: &[[f32; 3]], share: f64) {
    for (sum, value) in sum.iter_mut().zip(values) {
        for channel in 0..3 {
            sum[channel] += share * f64::from(value[channel]);
        }
    }
}
