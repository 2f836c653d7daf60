//! Measures one technique over the frames of one group: each frame as a single image is, and how it follows on the one before.

use std::path::Path;

use super::analysis::Spread;
use super::measure::{BASELINE, Run, image, median_passes, request, reset_peak_rss};
use super::motion::{Seen, came_from};
use super::results::{Baseline, FrameRecord, Measured, Memory, ReferenceRecord, SequenceRecord, Times};
use super::suite::{Frames, Group, Poses, Timing};
use crate::Result;
use crate::cli::report::peak_rss_mb;
use crate::cli::scene_options::LoadedScene;
use crate::image::Image;
use crate::metrics::{self, Change, LightReport, Mask, PixelCounts, SequenceMeter, pool};
use crate::progress::Progress;
use crate::receivers::Receivers;
use crate::reference::cache::Cached;
use crate::reference::exact::Exact;
use crate::render::{self, render};
use crate::techniques::Technique;

/// Passes through a sequence that a frame's median takes at least.
const LEAST_PASSES: u32 = 3;

/// A group's frames, and where their exact answers are.
#[derive(Debug)]
pub struct MovingSubject<'a> {
    group: &'a Group,
    frames: &'a Frames,
    poses: Poses<'a>,
    exact: Cached<'static>,
}

/// A frame with its exact answer.
struct Truth {
    loaded: LoadedScene,
    image: Image,
    receivers: Receivers,
    came_from: Vec<Option<u32>>,
    sampled: u64,
}

/// What the pass that warms up finds out about a frame.
struct Seeing {
    samples: u32,
    rays: u64,
    shadow_maps: u32,
    texels: u64,
    errors: LightReport,
    change: Change,
}

/// A frame that the report shows, with its number.
pub struct Shown {
    /// Its number.
    pub frame: u32,
    /// The technique's answer.
    pub image: Image,
    /// The exact one.
    pub reference: Image,
}

impl<'a> MovingSubject<'a> {
    /// Finds the exact answers of all frames, in `cache` if they are there; what could not be kept there. `show` gets those that
    /// the report shows.
    ///
    /// # Errors
    /// As [`render()`].
    pub fn new(
        group: &'a Group,
        frames: &'a Frames,
        cache: &Path,
        progress: &Progress,
        mut show: impl FnMut(u32, &Image) -> Result<()>,
    ) -> Result<(Self, Vec<String>)> {
        let exact = Cached::new(&Exact, "reference-exact", cache)?;
        let subject = Self { group, frames, poses: group.poses()?, exact };
        for (frame, number) in frames.numbers.iter().enumerate() {
            let truth = subject.truth(frame, None, progress)?;
            if frames.shown.contains(number) {
                show(*number, &truth.image)?;
            }
        }
        let mut warnings = subject.exact.warnings();
        warnings.dedup();
        Ok((subject, warnings))
    }

    /// The exact answer of a frame: kept on disk rather than in memory, which would not hold a long sequence's.
    fn truth(&self, frame: usize, before: Option<&Truth>, progress: &Progress) -> Result<Truth> {
        progress.check()?;
        let loaded = self.group.posed(&self.poses, frame)?;
        let LoadedScene { scene, camera, .. } = &loaded;
        let mut rendering = render(scene, camera, &self.exact, &request(self.group.size), progress)?;
        let sampled = rendering.lights[0].sampled.iter().filter(|&&sampled| sampled).count() as u64;
        let image = image(&loaded, &mut rendering, &self.exact);
        let receivers = rendering.receivers;
        let came_from = match before {
            None => vec![None; receivers.pixels.len()],
            Some(Truth { loaded: LoadedScene { scene: then, camera: eye, .. }, receivers: seen, .. }) => came_from(
                Seen { scene, camera, receivers: &receivers },
                Seen { scene: then, camera: eye, receivers: seen },
            ),
        };
        Ok(Truth { loaded, image, receivers, came_from, sampled })
    }

    /// Measures a technique; the frames that the report shows too.
    ///
    /// # Errors
    /// As [`render()`].
    pub fn measure(
        &self,
        technique: &dyn Technique,
        timing: Timing,
        progress: &Progress,
    ) -> Result<(Measured, Vec<Shown>)> {
        // The pass that warms up tells memory and gives the images: all others give the same ones.
        let mut drawn = render::Sequence::new(technique);
        let mut meter = SequenceMeter::default();
        let (mut before, mut seen, mut shown): (Option<Truth>, Vec<Seeing>, Vec<Shown>) =
            (None, Vec::new(), Vec::new());
        let (mut peak_rss, mut gpu_bytes): (Option<f64>, u64) = (None, 0);
        let (mut pixels, mut notes, mut sampled) = (PixelCounts::default(), Vec::new(), 0);
        for (frame, &number) in self.frames.numbers.iter().enumerate() {
            let truth = self.truth(frame, before.as_ref(), progress)?;
            let LoadedScene { scene, camera, .. } = &truth.loaded;
            let resets = reset_peak_rss();
            let mut rendering = drawn.frame(scene, camera, &request(self.group.size), progress)?;
            if resets {
                peak_rss = peak_rss.into_iter().chain(peak_rss_mb()).reduce(f64::max);
            }
            gpu_bytes = gpu_bytes.max(rendering.gpu_bytes);
            sampled += truth.sampled;
            let image = image(&truth.loaded, &mut rendering, technique);
            let mut report = metrics::compare(&image, &truth.image, &Mask::ALL)?;
            pixels = pixels + report.pixels;
            report.notes.retain(|note| !notes.contains(note));
            notes.append(&mut report.notes);
            let light = &rendering.lights[0];
            seen.push(Seeing {
                samples: light.samples,
                rays: light.rays,
                shadow_maps: light.shadow_maps,
                texels: light.texels,
                errors: report.lights.swap_remove(0),
                change: meter.add(&image, &truth.image, &truth.came_from)?,
            });
            if self.frames.shown.contains(&number) {
                shown.push(Shown { frame: number, image, reference: truth.image.clone() });
            }
            before = Some(truth);
        }

        let [runs, baselines] = self.passes(technique, timing, progress)?;
        let frames: Vec<FrameRecord> =
            seen.iter().enumerate().map(|(frame, seen)| self.record(frame, seen, &runs, &baselines)).collect();
        let max_over_median = |of: fn(&FrameRecord) -> f64| {
            let times = || frames.iter().map(of);
            times().fold(0.0, f64::max) / spread(times()).median
        };
        let sequence = SequenceRecord {
            fps: self.frames.fps,
            wall_max_over_median: max_over_median(|frame| frame.wall_ms),
            render_max_over_median: max_over_median(|frame| frame.render_ms),
            stability: meter.finish(),
            frames,
        };
        let measured = Measured {
            time: times(&sequence.frames, &runs, &baselines),
            memory_mb: Memory { peak_rss, gpu: gpu_bytes as f64 / 1e6 },
            samples: middle(seen.iter().map(|seen| seen.samples)),
            rays: middle(seen.iter().map(|seen| seen.rays)),
            shadow_maps: middle(seen.iter().map(|seen| seen.shadow_maps)),
            texels: middle(seen.iter().map(|seen| seen.texels)),
            reference: ReferenceRecord { method: "exact".into(), sampled_receivers: sampled },
            pixels,
            errors: pool(&seen.into_iter().map(|seen| seen.errors).collect::<Vec<_>>()),
            notes,
            sequence: Some(sequence),
        };
        Ok((measured, shown))
    }

    /// Times passes through the sequence, each from its start, with a run of the baseline for each frame: by pass, then by frame,
    /// of the technique and of the baseline.
    fn passes(&self, technique: &dyn Technique, timing: Timing, progress: &Progress) -> Result<[Vec<Vec<Run>>; 2]> {
        let has_time = |passes: &[Vec<Run>]| {
            let spent = passes.iter().flatten().map(|run| run.wall).sum::<f64>();
            passes.len() < LEAST_PASSES as usize || spent < 1e3 * timing.seconds
        };
        let (mut passes, mut baselines): (Vec<Vec<Run>>, Vec<Vec<Run>>) = (Vec::new(), Vec::new());
        while passes.len() < timing.runs as usize && has_time(&passes) {
            let paired = has_time(&baselines);
            let mut drawn = render::Sequence::new(technique);
            let (mut runs, mut partners) = (Vec::new(), Vec::new());
            for frame in 0..self.frames.numbers.len() {
                progress.check()?;
                let LoadedScene { scene, camera, .. } = &self.group.posed(&self.poses, frame)?;
                let request = request(self.group.size);
                let baseline_first = (passes.len() + frame) % 2 == 0;
                let baseline = || Run::of(|| render(scene, camera, &BASELINE, &request, progress));
                if paired && baseline_first {
                    partners.push(baseline()?);
                }
                runs.push(Run::of(|| drawn.frame(scene, camera, &request, progress))?);
                if paired && !baseline_first {
                    partners.push(baseline()?);
                }
            }
            passes.push(runs);
            if paired {
                baselines.push(partners);
            }
        }
        Ok([passes, baselines])
    }

    fn record(&self, frame: usize, seen: &Seeing, runs: &[Vec<Run>], baselines: &[Vec<Run>]) -> FrameRecord {
        let median =
            |passes: &[Vec<Run>], of: fn(&Run) -> f64| spread(passes.iter().map(|pass| of(&pass[frame]))).median;
        let ratio = |of: fn(&Run) -> f64| {
            spread(runs.iter().zip(baselines).map(|(run, baseline)| of(&run[frame]) / of(&baseline[frame]))).median
        };
        let errors = |mask: Mask| seen.errors.masks.get(&mask).copied().unwrap_or_default();
        let penumbra = errors(Mask::Penumbra);
        FrameRecord {
            frame: self.frames.numbers[frame],
            seconds: self.frames.seconds(frame),
            wall_ms: median(runs, |run| run.wall),
            build_ms: median(runs, |run| run.build),
            render_ms: median(runs, |run| run.render),
            baseline_wall_ms: median(baselines, |run| run.wall),
            baseline_render_ms: median(baselines, |run| run.render),
            wall_ratio: ratio(|run| run.wall),
            render_ratio: ratio(|run| run.render),
            samples: seen.samples,
            rays: seen.rays,
            shadow_maps: seen.shadow_maps,
            penumbra: penumbra.count,
            rmse: penumbra.rmse,
            flip: penumbra.flip,
            rmse_all: errors(Mask::All).rmse,
            flicker: seen.change.flicker,
            ghost_area: seen.change.ghost_area,
        }
    }
}

/// The spread over the frames of what each takes in the median.
fn times(frames: &[FrameRecord], runs: &[Vec<Run>], baselines: &[Vec<Run>]) -> Times {
    let over = |of: fn(&FrameRecord) -> f64| spread(frames.iter().map(of));
    let all: Vec<&Run> = runs.iter().flatten().collect();
    Times {
        runs: runs.len() as u32,
        wall_ms: over(|frame| frame.wall_ms),
        build_ms: over(|frame| frame.build_ms),
        render_ms: over(|frame| frame.render_ms),
        build_passes: median_passes(&all, |run| &run.build_passes),
        passes: median_passes(&all, |run| &run.passes),
        baseline: Baseline {
            runs: baselines.len() as u32,
            wall_ms: over(|frame| frame.baseline_wall_ms),
            render_ms: over(|frame| frame.baseline_render_ms),
            wall_ratio: over(|frame| frame.wall_ratio),
            render_ratio: over(|frame| frame.render_ratio),
        },
    }
}

fn spread(values: impl Iterator<Item = f64>) -> Spread {
    Spread::of(values.collect()).expect("at least one frame and pass")
}

/// The value in the middle by size, the lower of two.
fn middle<T: Ord>(values: impl Iterator<Item = T>) -> T {
    let mut values: Vec<T> = values.collect();
    let middle = (values.len() - 1) / 2;
    values.select_nth_unstable(middle);
    values.swap_remove(middle)
}
