//! One shadow map a frame, each from another point of the light; what a receiver's tests found in the frames before is fetched
//! from where it was on the screen then. Scherzer, Schwärzler, Mattausch and Wimmer 2009, "Real-Time Soft Shadows Using Temporal
//! Coherence".
//!
//! A still image is as many frames of the same view; frames that follow each other add one map each.
//!
//! # What differs from the paper
//! `paper` has its choices, and its faults as they are printed. Mended by default:
//! - Eq. 4 compares depths of two cameras. Here a receiver's plane, as it lay in the frame before (moving instances by their own
//!   transforms), is held against the sixteen pixels around where it was, of the same instance, and these are weighted.
//! - Eq. 3 is 0/0 for one sample and certain of equal ones. Here the error is that of the posterior to Jeffreys' prior.
//! - PCSS and tests are kept apart: the one's weight falls as 1/n beside n tests, as inverse squared errors ask, and the filter, which
//!   stands for the light that n tests have left out, widens nothing that PCSS has widened already.
//! - Eq. 6's disk, the same on all surfaces, blurs as much after a hundred samples as after one. Here the filter is the light's own
//!   shape, cast through the mean blocker onto the receiver's plane, and shrinks as n^-¾, as what n samples leave to be filled. A
//!   grid of samples with a kernel of one of its cells is the exact ramp of any parallel planar blocker.
//! - Eq. 7 averages all depths and drifts to the receiver's own. Here it takes blockers alone.
//! - Counts in FP16 stick at 2048, after which ψ grows to 1.
//! - What moves resets all that it shadows. Here the history knows still casters alone, and a second map from the light's centre the
//!   moving ones, by PCSS. The two shares are taken for independent. Where an instance stops or starts, what it may have shadowed is
//!   begun anew.
//! - Under moving lights, on moving receivers, and where a penumbra a few pixels wide would be blurred by being fetched again and
//!   again, older samples count less, and PCSS is begun anew in every frame.
//! - While the camera moves the filter rests: what is fetched from between pixels has been averaged, and PCSS is smooth.
//! - What of the light is below a receiver's horizon is known: tests of points there are left out, and V is the share of the rest that
//!   is seen, times the part of the light that is above.
//! - Receivers that nothing can shadow, by the bounds of what casts shadows, take no part.

use std::sync::Arc;

use glam::{DVec2, DVec3, Vec2, Vec3};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{
    Context, Entry, Frame, LightImage, Linking, Needs, Parameters, Technique, add_passes, parse_parameters, schema_of,
};
use crate::Result;
use crate::gpu::Gpu;
use crate::gpu::center_map::{emitter_of, kernels};
use crate::gpu::light_view::{Chunk, GpuReceiver, LightView, WORKGROUP, Work, fraction_above, most_receivers};
use crate::gpu::pass::Frame as GpuFrame;
use crate::gpu::scene::DrawList;
use crate::gpu::screen::{Screen, center_px, focal, is_orthographic, tolerance};
use crate::gpu::shader::Pipeline;
use crate::gpu::shadow_map::{self, Keep, MapPoint, RenderedMaps, ShadowMaps};
use crate::gpu_struct;
use crate::history::{Pose, Shot};
use crate::receivers::Receiver;
use crate::sampling::{self, Pattern, Sampler, grid_of};
use crate::scene::light::Domain;
use crate::scene::{AreaLight, Bounds, Camera};

/// Registered as `temporal`.
pub const ENTRY: Entry = Entry {
    name: "temporal",
    paper: "Scherzer, Schwärzler, Mattausch, Wimmer 2009, \"Real-Time Soft Shadows Using Temporal Coherence\"",
    summary: "one shadow map a frame from changing points of the light, added to the frames before; converges to the truth",
    needs: Needs::Gpu,
    schema: schema_of::<Temporal>,
    presets: &[
        (
            "paper",
            "points=halton start_weight=1 start_taps=16 error=binomial kernel=disk blockers=all reprojection=printed \
             moving=reset history=fp16 overscan=0.05 aging=false",
        ),
        (
            "paper-unfiltered",
            "points=halton start_weight=1 start_taps=16 error=binomial kernel=disk blockers=all reprojection=printed \
             moving=reset history=fp16 overscan=0.05 aging=false threshold=1",
        ),
    ],
    demo: &["frames=1", "frames=16", "frames=64"],
    build,
};

/// Parameters of `temporal`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Temporal {
    /// Frames that a still image takes, a shadow map each. Each frame of an animation (--frames) takes one.
    #[schemars(range(min = 1, max = 1_000_000))]
    pub frames: u32,
    /// How the frames' points are placed on the light.
    pub points: Points,
    /// Samples that PCSS counts as where a receiver comes into view (an nth of it after n frames, with kernel=light); 0: it only looks
    /// for blockers.
    #[schemars(range(min = 0, max = 1024))]
    pub start_weight: f64,
    /// Texels that PCSS reads for each of its two kernels.
    #[schemars(range(min = 1, max = 4096))]
    pub start_taps: u32,
    /// Where its search for blockers begins, as a fraction of the way from the light to the receiver.
    #[schemars(range(min = 0.001, max = 1))]
    pub near: f64,
    /// Standard error above which neighbours are averaged; 1: none are. With `reprojection=exact` none are while the camera moves, when
    /// being fetched from between pixels averages them.
    #[schemars(range(min = 0, max = 1))]
    pub threshold: f64,
    /// How the standard error is estimated.
    pub error: StandardError,
    /// The neighbours that are averaged, by 16 taps.
    pub kernel: Kernel,
    /// Which depths the mean blocker is made of.
    pub blockers: Blockers,
    /// How a receiver's past is found.
    pub reprojection: Reprojection,
    /// How far depths of one surface may differ from a frame to the next, as a fraction of the view's height there.
    #[schemars(range(min = 1e-6, max = 1))]
    pub epsilon: f64,
    /// How much larger than the image the view is that the history knows, as a fraction of it.
    #[schemars(range(min = 0, max = 1))]
    pub overscan: f64,
    /// What becomes of the shadows of what moves.
    pub moving: Moving,
    /// Whether samples count less as the light or a receiver moves, and where penumbrae a few pixels wide are fetched from between
    /// pixels, and PCSS begins anew there; the latter, and a receiver's own motion, with `reprojection=exact` alone.
    pub aging: bool,
    /// How the history is stored.
    pub history: Precision,
    /// Texels a side of each map.
    #[schemars(range(min = 1, max = 16_384))]
    pub map_size: u32,
    /// Chooses another set of points.
    pub seed: u32,
}

/// How the points of frames are placed on a light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Points {
    /// Halton (2, 3).
    Halton,
    /// Owen-scrambled Sobol'.
    Sobol,
    /// Multiples of the powers of the plastic number (Roberts 2018).
    R2,
    /// Independent of each other.
    Random,
}

/// Estimates of the standard error of n samples of which a share is in shadow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum StandardError {
    /// Eq. 3 of the paper; 0 for one sample and for equal ones.
    Binomial,
    /// Of the posterior to Jeffreys' prior: never certain.
    Jeffreys,
}

/// Kernels of the filter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Kernel {
    /// A disk on the screen as wide as the penumbra, over PCSS and samples alike (the paper's Eq. 6).
    Disk,
    /// The light's shape on the receiver's plane, smaller as samples come, over samples alone.
    Light,
}

/// Depths of which the mean blocker is made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Blockers {
    /// All, lit or not (the paper's Eq. 7 as printed).
    All,
    /// Those that block.
    Blocking,
}

/// Ways to find a receiver's past.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Reprojection {
    /// The nearest pixel to where the point would have been if it had not moved, by its depth now (the paper's Eq. 4 as printed).
    Printed,
    /// Sixteen pixels around where the point was (four at the edges of surfaces), by its plane's depth then.
    Exact,
}

/// What becomes of the shadows of what moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Moving {
    /// They are added like others, and leave ghosts.
    Ignore,
    /// What they fall on is begun anew (the paper).
    Reset,
    /// They come from a map of their own, seen from the light's centre.
    Apart,
}

/// Floats of the history.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Halves (the paper): counts stick at 2048 frames. Depths differ by 2^-10 of themselves: `epsilon` must exceed that.
    Fp16,
    /// Exact counts.
    Fp32,
}

impl Default for Temporal {
    fn default() -> Self {
        Self {
            frames: 64,
            points: Points::Sobol,
            start_weight: 32.0,
            start_taps: 32,
            near: 0.5,
            threshold: 0.02,
            error: StandardError::Jeffreys,
            kernel: Kernel::Light,
            blockers: Blockers::Blocking,
            reprojection: Reprojection::Exact,
            epsilon: 0.005,
            overscan: 0.0,
            moving: Moving::Apart,
            aging: true,
            history: Precision::Fp32,
            map_size: 1024,
            seed: 0,
        }
    }
}

gpu_struct! {
    /// Twin of `Step` in `techniques/temporal.wgsl`.
    struct Step {
        pub source: u32,
        pub most: f32,
        pub rescale: f32,
        pub is_wide: u32,
        pub size: [u32; 2],
        pub past_tolerance: Vec2,
    }
}

gpu_struct! {
    /// Twin of `Arrival` in `techniques/temporal.wgsl`.
    struct Arrival {
        pub at_px: Vec2,
        pub slope: Vec2,
        pub motion: Vec3,
        pub depth: f32,
    }
}

gpu_struct! {
    /// Twin of `Lit` in `techniques/temporal.wgsl`.
    struct Lit {
        pub number: u32,
        pub instance: u32,
        pub depth: f32,
        pub count: f32,
    }
}

/// Twin of that in the shader: it scatters any count of workgroups that is not a multiple of it.
const SCATTER: u32 = 40507;

/// Workgroups that may begin some of so many receivers: those without past have workgroups of their own.
fn groups_to_begin(receivers: u32) -> u32 {
    let groups = receivers.div_ceil(WORKGROUP) + 1;
    groups + u32::from(groups == SCATTER)
}

/// Samples that a receiver that sees the whole light is taken to have at most, as the shader halves those beyond.
const MOST_LIT: u32 = 32_768;

/// Where a receiver's past lies: [`Step::source`].
const NOWHERE: u32 = 0;
const OWN_PIXEL: u32 = 1;
const ARRIVALS: u32 = 2;

impl Arrival {
    /// Of a receiver without past.
    const NONE: Self = Self { at_px: Vec2::NEG_INFINITY, slope: Vec2::ZERO, motion: Vec3::ZERO, depth: 0.0 };
}

/// What is kept of a light from one frame for the next.
#[derive(Debug)]
struct Memory {
    /// The history, and the one before, to be written over.
    histories: [wgpu::Buffer; 2],
    /// Frames so far.
    frames: u32,
    /// Metres a unit on the GPU.
    unit: f64,
    /// By instance, whether its shadow was kept apart.
    apart: Vec<bool>,
}

/// What happens to a light's history in a frame.
struct Change {
    source: u32,
    arrivals: Vec<Vec<Arrival>>,
    most: f64,
    rescale: f64,
    past_tolerance: Vec2,
    /// Whether pixels are fetched from between those of a camera that was elsewhere, which averages them already.
    is_resampled: bool,
}

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<Temporal>(&ENTRY, given)?;
    Ok(Box::new(Built { gpu: context.gpu()?, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: Temporal,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let gpu = &*self.gpu;
        let bytes = size_of::<GpuReceiver>() as u64;
        let Some(view) = LightView::in_chunks(gpu, frame, light, bytes, Work::Shadowed)? else {
            frame.progress.advance(u64::from(frame.receivers.size[1]))?;
            return Ok(LightView::image(None, frame, light, |_, _, _| (0.0, 0.0)));
        };
        let history = frame.shot.and_then(|shot| shot.history);
        let kept = frame.shot.zip(history).and_then(|(shot, history)| history.take(shot.pass, &light.name));
        let previous = history.and_then(|history| history.previous.as_ref()).filter(|pose| pose.is_of(frame.scene));
        let moving = previous.map_or_else(Vec::new, |pose| pose.moved(frame.scene));
        let is_moving = |instance: usize| moving.get(instance) == Some(&true);

        let (change, [past, mut next], first) = self.change(&view, frame, light, (previous, kept), &moving)?;
        // The map that is accumulated, and beside it what moves.
        let movers = (self.parameters.moving != Moving::Ignore).then(|| view.casters.only(is_moving));
        let movers = movers.filter(|movers| !movers.is_empty());
        let stills = movers.as_ref().filter(|_| self.parameters.moving == Moving::Apart);
        let stills = stills.map(|_| view.casters.only(|instance| !is_moving(instance)));
        let maps = Maps { view: &view, casters: stills.as_ref().unwrap_or(&view.casters), movers: movers.as_ref() };

        let points = self.points(&view, light, first, history.is_some());
        let mut done = Done::new(gpu)?;
        let threshold = if change.is_resampled { 1.0 } else { self.parameters.threshold };
        let (mut past, mut step) = (past, change);
        let mut frames = first;
        for points in maps.steps(&points) {
            frames += points.len() as u32;
            self.accumulate(&maps, frame, (points, frames), &step, [&mut past, &mut next], &mut done)?;
            step = Change { source: OWN_PIXEL, arrivals: Vec::new(), most: f64::INFINITY, rescale: 1.0, ..step };
        }
        let seen = self.shown(&view, frame, &past, threshold, &mut done)?;
        let beside = match &movers {
            Some(movers) if self.parameters.moving == Moving::Apart => {
                self.beside(&view, movers, (frame, light), &mut done)?
            }
            _ => Vec::new(),
        };
        if let (Some(history), Some(shot)) = (history, frame.shot) {
            let apart = if self.parameters.moving == Moving::Apart { moving } else { Vec::new() };
            let memory = Memory { histories: [past, next], frames: first + 1, unit: view.space.unit, apart };
            history.keep(shot.pass, &light.name, memory);
        }
        let image = LightView::image(Some(&view), frame, light, |chunk, i, receiver| {
            let beside = beside.get(chunk).map_or(1.0, |beside| beside[i]);
            let seen = f64::from(seen[chunk][i] * beside) * fraction_above(light, receiver);
            (seen, seen)
        });
        frame.progress.advance(u64::from(frame.receivers.size[1]))?;
        Ok(LightImage {
            samples: points.len() as u32,
            shadow_maps: done.maps,
            texels: gpu.count(&done.counter)?,
            approximate: true,
            passes: done.passes,
            ..image
        })
    }

    fn border_px(&self, size: [u32; 2]) -> [u32; 2] {
        size.map(|side| (0.5 * self.parameters.overscan * f64::from(side)).ceil() as u32)
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(&self.parameters).expect("parameters are numbers and names")
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(&self.gpu)
    }
}

/// What has been done, for the record.
struct Done {
    passes: Vec<super::Pass>,
    maps: u32,
    counter: wgpu::Buffer,
}

impl Done {
    fn new(gpu: &Gpu) -> Result<Self> {
        Ok(Self { passes: Vec::new(), maps: 0, counter: gpu.counter()? })
    }
}

/// What a frame's maps are made of.
struct Maps<'a> {
    view: &'a LightView<'a>,
    casters: &'a DrawList,
    movers: Option<&'a DrawList>,
}

impl Maps<'_> {
    /// The frames' points: the first one alone, for PCSS reads more of its map than others show.
    fn steps<'p>(&self, points: &'p [MapPoint]) -> impl Iterator<Item = &'p [MapPoint]> {
        let (first, others) = points.split_at(1.min(points.len()));
        [first, others].into_iter().filter(|points| !points.is_empty())
    }
}

impl Built {
    /// The points of this frame, or of all frames of a still image.
    fn points(&self, view: &LightView, light: &AreaLight, first: u32, is_one: bool) -> Vec<MapPoint> {
        let seed = self.parameters.seed;
        let of = |pattern: Pattern| Sampler::new(pattern, u32::MAX, 0, seed);
        let (halton, sobol) = (of(Pattern::Halton), of(Pattern::Sobol));
        let square = |index: u32| match self.parameters.points {
            Points::Halton => halton.unit_square(index),
            Points::Sobol => sobol.unit_square(index),
            Points::R2 => sampling::r2(index, seed),
            Points::Random => sampling::random(index, seed),
        };
        let count = if is_one || view.emitter.domain == Domain::Point { 1 } else { self.parameters.frames };
        let place = |index: u32| MapPoint { position: view.point_on(light, square(index)), weight: 1.0 };
        // The sequence ends before u32 does.
        (0..count).map(|i| place((first + i) % (u32::MAX - 1))).collect()
    }

    /// Whether receivers without past are searched for blockers.
    fn starts(&self) -> bool {
        self.parameters.start_weight > 0.0 || self.parameters.threshold < 1.0
    }

    fn pipeline(&self, entry_point: &str, resets: bool, threshold: f64) -> Arc<Pipeline<wgpu::ComputePipeline>> {
        let Temporal { start_taps, near, .. } = self.parameters;
        let is = |condition: bool| f64::from(u8::from(condition));
        let constants = [
            shadow_map::CONSTANTS,
            &[
                ("dense", 0.0),
                ("near", near),
                ("search_taps", start_taps.into()),
                ("filter_taps", start_taps.into()),
                ("pattern", Pattern::Sobol.on_gpu().into()),
                ("search_columns", grid_of(start_taps).0.into()),
                ("filter_columns", grid_of(start_taps).0.into()),
            ],
        ]
        .concat();
        let own = [
            ("start_weight", self.parameters.start_weight),
            ("starts", is(self.starts())),
            ("threshold", threshold),
            ("filters", is(threshold < 1.0)),
            ("binomial", is(self.parameters.error == StandardError::Binomial)),
            ("screen_disk", is(self.parameters.kernel == Kernel::Disk)),
            ("all_depths", is(self.parameters.blockers == Blockers::All)),
            ("printed", is(self.parameters.reprojection == Reprojection::Printed)),
            ("half_floats", is(self.parameters.history == Precision::Fp16)),
            ("resets", is(resets)),
            ("aging", is(self.parameters.aging)),
        ];
        self.gpu.compute_pipeline("techniques/temporal.wgsl", entry_point, &[constants, own.to_vec()].concat())
    }

    /// The history's buffers, for an image with its border.
    fn histories(&self, [width, height]: [u32; 2]) -> Result<[wgpu::Buffer; 2]> {
        let words = if self.parameters.history == Precision::Fp16 { 5 } else { 8 };
        let bytes = 4 * words * u64::from(width) * u64::from(height);
        let empty = || self.gpu.empty_buffer("the shadows' history", bytes, wgpu::BufferUsages::STORAGE);
        Ok([empty()?, empty()?])
    }

    /// What happens to a light's history, its buffers, and the number of the first frame from here on.
    fn change(
        &self,
        view: &LightView,
        frame: &Frame,
        light: &AreaLight,
        (previous, kept): (Option<&Pose>, Option<Memory>),
        moving: &[bool],
    ) -> Result<(Change, [wgpu::Buffer; 2], u32)> {
        let anew = Change {
            source: NOWHERE,
            arrivals: Vec::new(),
            most: f64::INFINITY,
            rescale: 1.0,
            past_tolerance: Vec2::ZERO,
            is_resampled: false,
        };
        let size = frame.receivers.size;
        let (Some(pose), Some(memory), Some(shot)) = (previous, kept, frame.shot) else {
            return Ok((anew, self.histories(size)?, 0));
        };
        let past_light = pose.light_in(frame.scene, &light.name);
        let shift = past_light.and_then(|past| shift_of(&past, light, view));
        let Some(shift) = shift.filter(|_| pose.size == shot.size) else {
            return Ok((anew, self.histories(size)?, 0));
        };
        let most = if self.parameters.aging { most_samples(shift) } else { f64::INFINITY };
        let rescale = memory.unit / view.space.unit;
        let camera = pose.camera_in(frame.scene);
        let past_tolerance = tolerance(&camera, self.parameters.epsilon, memory.unit);
        let turned = self.turned(frame, light, pose, &memory.apart, moving);
        let has_camera = pose.has_camera(frame.scene, shot.camera, shot.size);
        let is_still = moving.iter().all(|moving| !moving) && has_camera;
        let (source, arrivals) = if most < 1.0 {
            (NOWHERE, Vec::new())
        } else if is_still && turned.is_empty() && shift == 0.0 {
            (OWN_PIXEL, Vec::new())
        } else {
            let screen = PastScreen::new(&camera, shot, memory.unit);
            let is_lost = |receiver: &Receiver| turned.iter().any(|sphere| sphere.may_block(light, receiver.position));
            let arrival = |number: &u32| {
                let receiver = frame.receivers.pixels[*number as usize].as_ref().expect("only hits face the light");
                if is_lost(receiver) {
                    return Arrival::NONE;
                }
                let is_followed = self.parameters.reprojection == Reprojection::Exact
                    && moving.get(receiver.instance as usize) == Some(&true);
                let (position, normal) = if is_followed {
                    pose.receiver(frame.scene, receiver)
                } else {
                    (receiver.position, receiver.normal)
                };
                let motion = (receiver.position - position) / view.space.unit;
                Arrival { motion: motion.as_vec3(), ..screen.arrival(position, normal) }
            };
            let of_chunk = |chunk: &Chunk| chunk.pixels.par_iter().map(arrival).collect();
            (ARRIVALS, view.chunks.iter().map(of_chunk).collect())
        };
        let is_resampled = source == ARRIVALS && !has_camera && self.parameters.reprojection == Reprojection::Exact;
        let change = Change { source, arrivals, most, rescale, past_tolerance, is_resampled };
        let frames = memory.frames % (u32::MAX - 1);
        Ok((change, memory.histories, frames))
    }

    /// Balls around what has begun or ceased to move: its shadow goes from one map to the other.
    fn turned(&self, frame: &Frame, light: &AreaLight, pose: &Pose, apart: &[bool], moving: &[bool]) -> Vec<Ball> {
        if self.parameters.moving != Moving::Apart {
            return Vec::new();
        }
        let linking = Linking::of(frame.scene, light);
        let has_turned =
            |&i: &usize| light.casts_shadow && linking.blocks(i as u32) && moving[i] != (apart.get(i) == Some(&true));
        let ball = |i: usize| Ball::around(frame.bvh.instance_bounds(i).union(pose.bounds_in(frame.scene, i)));
        (0..moving.len()).filter(has_turned).map(ball).collect()
    }

    /// Adds the tests of some frames' maps, `frames` with them; the buffers change places.
    fn accumulate(
        &self,
        maps: &Maps,
        frame: &Frame,
        (points, frames): (&[MapPoint], u32),
        change: &Change,
        [past, next]: [&mut wgpu::Buffer; 2],
        done: &mut Done,
    ) -> Result<()> {
        let (gpu, view) = (&*self.gpu, maps.view);
        let size = [self.parameters.map_size, 1];
        // Kernels reach beyond the receivers; where all of them have a past nothing else is read.
        let wide = self.starts() && (change.source != OWN_PIXEL || maps.movers.is_some());
        let boxes = if wide { kernels(view, self.parameters.near) } else { Vec::new() };
        let boxes = if wide { &boxes } else { &view.tiles };
        let of = |casters, size: [u32; 2]| ShadowMaps::of(view, casters, points, boxes, size, Keep::One);
        let all = of(maps.casters, [size[0], u32::from(wide)])?;
        let resets = self.parameters.moving == Moving::Reset && maps.movers.is_some();
        let movers = maps.movers.filter(|_| resets).map(|movers| of(movers, [size[0], u32::from(wide)])).transpose()?;
        let [accumulate, begin] = ["accumulate", "begin"].map(|entry_point| self.pipeline(entry_point, resets, 1.0));
        let uniform = wgpu::BufferUsages::UNIFORM;
        let emitter = gpu.buffer("emitter", &[emitter_of(view)], uniform)?;
        let screen = gpu.buffer("screen", &[self.screen(view, frame)], uniform)?;
        let step = |source| Step {
            source,
            most: change.most as f32,
            rescale: change.rescale as f32,
            is_wide: wide.into(),
            size: frame.receivers.size,
            past_tolerance: change.past_tolerance,
        };
        let first = gpu.buffer("step", &[step(change.source)], uniform)?;
        let further = gpu.buffer("step", &[Step { most: f32::INFINITY, rescale: 1.0, ..step(OWN_PIXEL) }], uniform)?;
        let arrivals: Vec<wgpu::Buffer> = (0..view.chunks.len())
            .map(|i| {
                let arrivals = change.arrivals.get(i).map_or(&[][..], |arrivals| arrivals);
                gpu.buffer("arrivals", arrivals, wgpu::BufferUsages::STORAGE)
            })
            .collect::<Result<_>>()?;
        let beginning: Vec<wgpu::Buffer> = view
            .chunks
            .iter()
            .map(|chunk| if wide { 4 * (2 + chunk.pixels.len() as u64) } else { 8 })
            .map(|bytes| gpu.empty_buffer("receivers that begin", bytes, wgpu::BufferUsages::STORAGE))
            .collect::<Result<_>>()?;
        let lit = self.lit(view, frame, frames)?;
        let keep_lit = self.pipeline("keep_lit", false, 1.0);
        let mut step = &first;
        let record = |recorded: &mut GpuFrame, maps: &RenderedMaps, moving: Option<&RenderedMaps>| {
            // What is not written holds no past.
            recorded.encoder().clear_buffer(next, 0, None);
            for (count, lit) in &lit {
                recorded.compute("history", &keep_lit).bind("lit", lit).bind("next_history", &*next).dispatch([
                    count.div_ceil(WORKGROUP),
                    1,
                    1,
                ]);
            }
            for ((chunk, arrivals), beginning) in view.chunks.iter().zip(&arrivals).zip(&beginning) {
                let groups = [(chunk.pixels.len() as u32).div_ceil(WORKGROUP), 1, 1];
                recorded
                    .compute("history", &accumulate)
                    .bind("faces", &maps.faces)
                    .bind("points", &maps.points)
                    .bind("receivers", &chunk.buffer)
                    .bind("shadow_depth", &maps.depth)
                    .bind("moving_depth", &moving.unwrap_or(maps).depth)
                    .bind("counted", &done.counter)
                    .bind("emitter", &emitter)
                    .bind("history", &*past)
                    .bind("next_history", &*next)
                    .bind("step", step)
                    .bind("arrivals", arrivals)
                    .bind("screen", &screen)
                    .bind("beginning", beginning)
                    .dispatch(groups);
                if wide {
                    recorded
                        .compute("start", &begin)
                        .bind("faces", &maps.faces)
                        .bind("points", &maps.points)
                        .bind("receivers", &chunk.buffer)
                        .bind("shadow_depth", &maps.depth)
                        .bind("moving_depth", &moving.unwrap_or(maps).depth)
                        .bind("counted", &done.counter)
                        .bind("emitter", &emitter)
                        .bind("next_history", &*next)
                        .bind("screen", &screen)
                        .bind("beginning", beginning)
                        .dispatch([groups_to_begin(chunk.pixels.len() as u32), 1, 1]);
                }
            }
            std::mem::swap(past, next);
            step = &further;
        };
        let mut passes = Vec::new();
        all.each_batch_beside(movers.as_ref(), record, |timed| {
            add_passes(&mut passes, timed);
            frame.progress.check()
        })?;
        add_passes(&mut done.passes, passes);
        done.maps += all.count + movers.map_or(0, |movers| movers.count);
        Ok(())
    }

    /// 1 − ψ as it is shown, filtered where it is not known well, by chunk.
    fn shown(
        &self,
        view: &LightView,
        frame: &Frame,
        history: &wgpu::Buffer,
        threshold: f64,
        done: &mut Done,
    ) -> Result<Vec<Vec<f32>>> {
        let gpu = &*self.gpu;
        let pipeline = self.pipeline("show", false, threshold);
        let uniform = wgpu::BufferUsages::UNIFORM;
        let emitter = gpu.buffer("emitter", &[emitter_of(view)], uniform)?;
        let screen = gpu.buffer("screen", &[self.screen(view, frame)], uniform)?;
        let answers = answers(gpu, view)?;
        let mut recorded = GpuFrame::new(gpu);
        for (chunk, answer) in view.chunks.iter().zip(&answers) {
            recorded
                .compute("filter", &pipeline)
                .bind("receivers", &chunk.buffer)
                .bind("emitter", &emitter)
                .bind("history", history)
                .bind("screen", &screen)
                .bind("visibility", answer)
                .dispatch([(chunk.pixels.len() as u32).div_ceil(WORKGROUP), 1, 1]);
        }
        add_passes(&mut done.passes, recorded.finish()?);
        answers.iter().map(|answer| gpu.read_buffer(answer)).collect()
    }

    /// The receivers that see the whole light, in buffers, and how many there are in each.
    fn lit(&self, view: &LightView, frame: &Frame, frames: u32) -> Result<Vec<(u32, wgpu::Buffer)>> {
        let Some(shot) = frame.shot.filter(|_| !view.lit.is_empty()) else { return Ok(Vec::new()) };
        let camera = &shot.camera.scene_from_camera;
        let of = |&number: &u32| {
            let receiver = frame.receivers.pixels[number as usize].as_ref().expect("only hits face the light");
            let depth = -camera.matrix3.z_axis.dot(receiver.position - camera.translation) / view.space.unit;
            Lit { number, instance: receiver.instance, depth: depth as f32, count: frames.min(MOST_LIT) as f32 }
        };
        let lit: Vec<Lit> = view.lit.par_iter().map(of).collect();
        let most = most_receivers(&self.gpu, size_of::<Lit>() as u64);
        lit.chunks(most)
            .map(|lit| Ok((lit.len() as u32, self.gpu.buffer("lit receivers", lit, wgpu::BufferUsages::STORAGE)?)))
            .collect()
    }

    /// What the moving casters alone leave of the light that is above the receivers' horizons, by PCSS from its centre: by chunk.
    fn beside(
        &self,
        view: &LightView,
        movers: &DrawList,
        (frame, light): (&Frame, &AreaLight),
        done: &mut Done,
    ) -> Result<Vec<Vec<f32>>> {
        let gpu = &*self.gpu;
        let points = [MapPoint { position: view.emitter.center, weight: 1.0 }];
        let boxes = kernels(view, self.parameters.near);
        let maps = ShadowMaps::of(view, movers, &points, &boxes, [self.parameters.map_size, 1], Keep::One)?;
        let pipeline = self.pipeline("beside", false, 1.0);
        let emitter = gpu.buffer("emitter", &[emitter_of(view)], wgpu::BufferUsages::UNIFORM)?;
        let is_reached = view.behind(movers, frame, light);
        let reached: Vec<Vec<u32>> = view
            .chunks
            .iter()
            .map(|chunk| {
                let tiles = chunk.tiles.iter().filter(|(tile, _)| is_reached[*tile as usize]);
                tiles.flat_map(|(_, range)| range.clone()).collect()
            })
            .collect();
        let storage = wgpu::BufferUsages::STORAGE;
        let buffers: Vec<[wgpu::Buffer; 2]> = reached
            .iter()
            .map(|reached| {
                let answers = gpu.empty_buffer("visibility", 4 * reached.len() as u64, storage)?;
                Ok([gpu.buffer("reached", reached, storage)?, answers])
            })
            .collect::<Result<_>>()?;
        let record = |recorded: &mut GpuFrame, maps: &RenderedMaps| {
            let chunks = view.chunks.iter().zip(&reached).zip(&buffers).filter(|((_, reached), _)| !reached.is_empty());
            for ((chunk, reached), [numbers, answers]) in chunks {
                recorded
                    .compute("moving shadows", &pipeline)
                    .bind("faces", &maps.faces)
                    .bind("points", &maps.points)
                    .bind("receivers", &chunk.buffer)
                    .bind("shadow_depth", &maps.depth)
                    .bind("visibility", answers)
                    .bind("reached", numbers)
                    .bind("counted", &done.counter)
                    .bind("emitter", &emitter)
                    .dispatch([(reached.len() as u32).div_ceil(WORKGROUP), 1, 1]);
            }
        };
        let mut passes = Vec::new();
        maps.each_batch(record, |timed| {
            passes = timed;
            Ok(())
        })?;
        add_passes(&mut done.passes, passes);
        done.maps += maps.count;
        let whole = |((chunk, reached), [_, answers]): ((&Chunk, &Vec<u32>), &[wgpu::Buffer; 2])| {
            let mut all = vec![1.0; chunk.pixels.len()];
            if !reached.is_empty() {
                for (&i, seen) in reached.iter().zip(gpu.read_buffer::<f32>(answers)?) {
                    all[i as usize] = seen;
                }
            }
            Ok(all)
        };
        view.chunks.iter().zip(&reached).zip(&buffers).map(whole).collect()
    }

    /// The camera as shaders read it; one without pixels where there is none.
    fn screen(&self, view: &LightView, frame: &Frame) -> Screen {
        let of_shot = |shot| Screen::new(shot, frame.receivers.size, view, self.parameters.epsilon);
        frame.shot.map_or_else(bytemuck::Zeroable::zeroed, of_shot)
    }
}

/// Buffers for a value of each receiver, by chunk.
fn answers(gpu: &Gpu, view: &LightView) -> Result<Vec<wgpu::Buffer>> {
    let of = |chunk: &Chunk| gpu.empty_buffer("visibility", 4 * chunk.pixels.len() as u64, wgpu::BufferUsages::STORAGE);
    view.chunks.iter().map(of).collect()
}

/// The camera of the frame before.
struct PastScreen<'a> {
    camera: &'a Camera,
    /// See [`is_orthographic`].
    orthographic: bool,
    /// See [`focal`].
    focal: f64,
    /// See [`center_px`].
    center_px: DVec2,
    /// Metres a unit on the GPU.
    unit: f64,
}

impl<'a> PastScreen<'a> {
    /// That of a camera whose image has the size and border of this shot.
    fn new(camera: &'a Camera, shot: &Shot, unit: f64) -> Self {
        Self {
            camera,
            orthographic: is_orthographic(camera),
            focal: focal(camera, shot.size, unit),
            center_px: center_px(shot),
            unit,
        }
    }

    /// Where a point of a plane was on the screen.
    fn arrival(&self, position: DVec3, normal: DVec3) -> Arrival {
        let axes = &self.camera.scene_from_camera.matrix3;
        let seen = axes.transpose() * (position - self.camera.scene_from_camera.translation);
        let depth = -seen.z;
        let [right, up, forward] = [axes.x_axis, axes.y_axis, -axes.z_axis].map(|axis| normal.dot(axis));
        // As `smoothed` in the shader has it.
        let (at, ray, sign) = if self.orthographic {
            (self.focal / self.unit * seen.truncate(), forward, -1.0)
        } else {
            let at = seen.truncate() / depth;
            (self.focal * at, forward + at.x * right + at.y * up, 1.0)
        };
        let at_px = self.center_px + DVec2::new(at.x, -at.y);
        let slope = sign * DVec2::new(right, -up) / (self.focal * ray);
        // Behind the camera there is nothing; where the plane is seen edge-on, nothing of it.
        if !(at_px.is_finite() && slope.is_finite() && (depth > 0.0 || sign < 0.0)) {
            return Arrival::NONE;
        }
        Arrival {
            at_px: at_px.as_vec2(),
            slope: slope.as_vec2(),
            motion: Vec3::ZERO,
            depth: (depth / self.unit) as f32,
        }
    }
}

/// How far a light has moved since, in penumbra widths of any shadow: that is, relative to the light. None where it is another
/// light altogether.
fn shift_of(past: &AreaLight, light: &AreaLight, view: &LightView) -> Option<f64> {
    let middle = view.space.origin;
    let [past, now] = [past.emitter(middle), light.emitter(middle)];
    let (past, now) = match (past, now) {
        (Some(past), Some(now)) => (past, now),
        // From behind nothing is known of it, nor asked.
        _ => return None,
    };
    if past.domain != now.domain {
        return None;
    }
    let corners = match now.domain {
        Domain::Point => vec![DVec2::ZERO],
        _ => vec![DVec2::NEG_ONE, DVec2::new(-1.0, 1.0), DVec2::new(1.0, -1.0), DVec2::ONE],
    };
    // Along its normal a light's move changes the shadow's scale.
    let depth = now.normal.dot(now.center).abs();
    let shift = |&uv: &DVec2| {
        let moved = now.at(uv) - past.at(uv);
        let magnitude = light.scene_from_light.translation.abs() + now.at(uv).abs();
        if moved.abs().cmple(ROUNDING * magnitude).all() {
            return 0.0;
        }
        let along = |half: DVec3| moved.dot(half) / (2.0 * half.length_squared());
        let shift = DVec3::new(along(now.half_u), along(now.half_v), now.normal.dot(moved) / depth).length();
        if shift.is_finite() { shift } else { f64::INFINITY }
    };
    Some(corners.iter().map(shift).fold(0.0, f64::max))
}

/// How far roundings of a light that stands still may go, relative to what is added.
const ROUNDING: f64 = 1e-12;

/// Samples that are kept when each of them is `shift` penumbra widths off the next. Twin of `most_samples` in the shader.
fn most_samples(shift: f64) -> f64 {
    if shift == 0.0 {
        f64::INFINITY
    } else if shift < 0.5 {
        (0.75 / (shift * shift)).powf(2.0 / 7.0).max(1.0)
    } else {
        0.0
    }
}

/// A ball in scene space.
#[derive(Debug, Clone, Copy)]
struct Ball {
    center: DVec3,
    radius: f64,
}

impl Ball {
    fn around(bounds: Bounds) -> Self {
        Self { center: bounds.center(), radius: 0.5 * bounds.size().length() }
    }

    /// Whether some of it may lie between a position and a light. What lies between is within a cone around the segment to the
    /// light's middle: R t from it at the fraction t of the way, for a light of radius R.
    fn may_block(&self, light: &AreaLight, position: DVec3) -> bool {
        let Some(emitter) = light.emitter(position) else { return false };
        let (way, radius) = (emitter.center, emitter.half_u.length() + emitter.half_v.length());
        let to_ball = self.center - position;
        let squared = way.length_squared();
        let nearest = way.dot(to_ball) / squared;
        // No point of the ball is farther along.
        let most = nearest + self.radius / squared.sqrt();
        let farthest = if emitter.distant { most } else { most.min(1.0) };
        let t = if emitter.distant { nearest.max(0.0) } else { nearest.clamp(0.0, 1.0) };
        farthest >= 0.0 && (to_ball - t * way).length() <= self.radius + radius * farthest
    }
}
