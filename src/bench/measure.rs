//! One configuration: how long it takes and how far off it is.

use std::path::Path;
use std::time::Instant;

use super::analysis::Spread;
use super::results::{Baseline, Measured, Memory, PassTime, ReferenceRecord, Times};
use super::suite::{LEAST_RUNS, Timing};
use crate::Result;
use crate::cli::report::{Aov, Origin, Quantity, image_of, peak_rss_mb};
use crate::cli::scene_options::LoadedScene;
use crate::image::Image;
use crate::metrics::{self, Mask};
use crate::progress::{Progress, ms_since};
use crate::reference::cache::Cached;
use crate::reference::exact::Exact;
use crate::render::{Rendering, Request, render};
use crate::sampling::Pattern;
use crate::techniques::rays::Rays;
use crate::techniques::{Pass, Technique};

/// What every configuration's time is held against.
pub const BASELINE: Rays = Rays { samples: 64, pattern: Pattern::Sobol, seed: 0 };

/// A scene with one light, its camera and the exact answer.
#[derive(Debug)]
pub struct Subject {
    loaded: LoadedScene,
    request: Request,
    /// The exact answer, with positions.
    pub reference: Image,
    sampled: u64,
}

/// A run with its times, ms.
pub(super) struct Run {
    pub wall: f64,
    pub build: f64,
    pub render: f64,
    pub build_passes: Vec<Pass>,
    pub passes: Vec<Pass>,
}

impl Run {
    /// Times what renders one light.
    pub fn of(work: impl FnOnce() -> Result<Rendering>) -> Result<Self> {
        let start = Instant::now();
        let mut rendering = work()?;
        Ok(Self {
            wall: ms_since(start),
            build: rendering.build_ms,
            render: rendering.render_ms,
            build_passes: std::mem::take(&mut rendering.build_passes),
            passes: std::mem::take(&mut rendering.lights[0].passes),
        })
    }
}

/// What is asked of every technique.
pub(super) fn request(size: [u32; 2]) -> Request {
    Request { size, irradiance: false, shaded: None, antialiasing: 1, verify: None }
}

impl Subject {
    /// Finds the exact answer, in `cache` if it is there; what could not be kept there.
    ///
    /// # Errors
    /// As [`render`].
    pub fn new(loaded: LoadedScene, size: [u32; 2], cache: &Path, progress: &Progress) -> Result<(Self, Vec<String>)> {
        let request = request(size);
        let cached = Cached::new(&Exact, "reference-exact", cache)?;
        let mut rendering = render(&loaded.scene, &loaded.camera, &cached, &request, progress)?;
        let sampled = rendering.lights[0].sampled.iter().filter(|&&sampled| sampled).count() as u64;
        let reference = image(&loaded, &mut rendering, &cached);
        Ok((Self { loaded, request, reference, sampled }, cached.warnings()))
    }

    /// Measures a technique; its image too.
    ///
    /// # Errors
    /// As [`render`].
    pub fn measure(&self, technique: &dyn Technique, timing: Timing, progress: &Progress) -> Result<(Measured, Image)> {
        // The run that warms up tells memory and gives the image: all others give the same one.
        let resets = reset_peak_rss();
        let mut rendering = self.run(technique, progress)?;
        let peak_rss = if resets { peak_rss_mb() } else { None };
        let image = image(&self.loaded, &mut rendering, technique);
        let report = metrics::compare(&image, &self.reference, &Mask::ALL)?;
        self.run(&BASELINE, progress)?;

        let time = self.time(technique, timing, progress)?;
        let light = &rendering.lights[0];
        let mut lights = report.lights;
        let measured = Measured {
            time,
            memory_mb: Memory { peak_rss, gpu: rendering.gpu_bytes as f64 / 1e6 },
            samples: light.samples,
            rays: light.rays,
            shadow_maps: light.shadow_maps,
            texels: light.texels,
            reference: ReferenceRecord { method: "exact".into(), sampled_receivers: self.sampled },
            pixels: report.pixels,
            errors: lights.swap_remove(0),
            notes: report.notes,
            sequence: None,
        };
        Ok((measured, image))
    }

    fn run(&self, technique: &dyn Technique, progress: &Progress) -> Result<Rendering> {
        render(&self.loaded.scene, &self.loaded.camera, technique, &self.request, progress)
    }

    fn timed_run(&self, technique: &dyn Technique, progress: &Progress) -> Result<Run> {
        Run::of(|| self.run(technique, progress))
    }

    /// Runs the technique and the baseline in turn.
    fn time(&self, technique: &dyn Technique, timing: Timing, progress: &Progress) -> Result<Times> {
        let has_time = |runs: &[Run]| {
            runs.len() < LEAST_RUNS as usize || runs.iter().map(|run| run.wall).sum::<f64>() < 1e3 * timing.seconds
        };
        let (mut runs, mut baselines): (Vec<Run>, Vec<Run>) = (Vec::new(), Vec::new());
        while runs.len() < timing.runs as usize && has_time(&runs) {
            // Only the first runs have a partner where the baseline is much the slower one. Which of a pair goes first alternates:
            // what changes steadily over time then favours neither.
            let paired = has_time(&baselines);
            let baseline_first = runs.len() % 2 == 0;
            if paired && baseline_first {
                baselines.push(self.timed_run(&BASELINE, progress)?);
            }
            runs.push(self.timed_run(technique, progress)?);
            if paired && !baseline_first {
                baselines.push(self.timed_run(&BASELINE, progress)?);
            }
        }
        let spread =
            |runs: &[Run], of: fn(&Run) -> f64| Spread::of(runs.iter().map(of).collect()).expect("at least one run");
        let ratio = |of: fn(&Run) -> f64| {
            let ratios = runs.iter().zip(&baselines).map(|(run, baseline)| of(run) / of(baseline)).collect();
            Spread::of(ratios).expect("at least one pair")
        };
        let all: Vec<&Run> = runs.iter().collect();
        Ok(Times {
            runs: runs.len() as u32,
            wall_ms: spread(&runs, |run| run.wall),
            build_ms: spread(&runs, |run| run.build),
            render_ms: spread(&runs, |run| run.render),
            build_passes: median_passes(&all, |run| &run.build_passes),
            passes: median_passes(&all, |run| &run.passes),
            baseline: Baseline {
                runs: baselines.len() as u32,
                wall_ms: spread(&baselines, |run| run.wall),
                render_ms: spread(&baselines, |run| run.render),
                wall_ratio: ratio(|run| run.wall),
                render_ratio: ratio(|run| run.render),
            },
        })
    }
}

/// The rendering of one light as an image that can be compared.
pub(super) fn image(loaded: &LoadedScene, rendering: &mut Rendering, technique: &dyn Technique) -> Image {
    let origin = Origin { technique: "bench", parameters: technique.parameters() };
    image_of(&loaded.scene, rendering, &origin, Quantity::Visibility, &[Aov::Position])
}

/// Median over the runs of each pass that all of them have; passes of one name count together.
pub(super) fn median_passes(runs: &[&Run], of: fn(&Run) -> &Vec<Pass>) -> Vec<PassTime> {
    let mut names: Vec<&'static str> = Vec::new();
    for pass in runs.iter().flat_map(|run| of(run)) {
        if !names.contains(&pass.name) {
            names.push(pass.name);
        }
    }
    let total =
        |run: &Run, name: &str| of(run).iter().filter(|pass| pass.name == name).map(|pass| pass.ms).sum::<f64>();
    names
        .into_iter()
        .filter_map(|name| {
            let spread = Spread::of(runs.iter().map(|run| total(run, name)).collect())?;
            Some(PassTime { name: name.to_owned(), ms: spread.median })
        })
        .collect()
}

/// Lets the system count the process's largest resident size anew (Linux; proc(5), clear_refs); whether it does.
pub(super) fn reset_peak_rss() -> bool {
    cfg!(target_os = "linux") && std::fs::write("/proc/self/clear_refs", "5").is_ok()
}
