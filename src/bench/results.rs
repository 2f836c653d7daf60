//! What was measured, as `results.json` and `results.csv` hold it (`docs/bench.md` has the schema).

use std::fs;
use std::io::Read;
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::analysis::Spread;
use super::suite::{Configuration, Group};
use crate::gpu::Adapter;
use crate::metrics::{LightReport, Mask, PixelCounts, SMALL_ERRORS, Since, Stability};
use crate::output::write_atomically;
use crate::techniques::Parameters;
use crate::{Error, Result};

/// [`Results::version`] of the files that this version writes and reads.
const VERSION: u32 = 3;

/// Largest file that is read, bytes: a record takes some 5 kB, and a suite has at most 10,000; each frame of a sequence takes
/// some 600 bytes more.
pub const MAX_FILE_BYTES: u64 = 1 << 28;

/// A file of results.
#[derive(Debug, Serialize, Deserialize)]
pub struct Results {
    /// Of the file's layout.
    pub version: u32,
    /// The suite that was last run.
    pub suite: String,
    /// One a configuration: those of the suite in its order, then those that earlier suites have left.
    pub records: Vec<Record>,
}

/// What is known about one configuration.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Record {
    /// Hash of what was measured, the version of Penumbra, and the machine.
    pub key: String,
    /// Titles of the experiments that ask for it.
    pub experiments: Vec<String>,
    /// The scene's name in the suite.
    pub scene: String,
    /// The scene as the suite gives it.
    pub source: String,
    /// Triangles, instances counted each.
    pub triangles: u64,
    /// The light.
    pub light: LightRecord,
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Frames of a sequence; none of a single image.
    pub frames: Option<u32>,
    /// The technique.
    pub technique: String,
    /// The preset that it starts from.
    pub preset: String,
    /// What is set, preset included.
    pub settings: Parameters,
    /// All parameters in force.
    pub parameters: Value,
    /// The version of Penumbra.
    pub penumbra: String,
    /// Where it ran.
    pub machine: Machine,
    /// What it ran on; none where it could not.
    pub adapter: Option<AdapterRecord>,
    /// When, UTC.
    pub date: String,
    /// What came of it.
    pub outcome: Outcome,
}

/// A light.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LightRecord {
    /// Its name, or that of its place in a sweep.
    pub name: String,
    /// `rect`, `disk`, …
    pub shape: String,
    /// How large it looks from the middle of the scene: the square root of its area over the distance; none where it faces away.
    pub extent: Option<f64>,
}

/// What a processor technique's time depends on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Machine {
    /// As the system names it.
    pub processor: String,
    /// Operating system and architecture.
    pub system: String,
    /// Threads of Penumbra.
    pub threads: usize,
}

/// [`Adapter`] as a file holds it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct AdapterRecord {
    /// As the driver says; `CPU` for what needs no GPU.
    pub name: String,
    /// `vulkan`, `metal`, `dx12` or `cpu`.
    pub backend: String,
    /// Whether a processor does the work: its times are read as ratios.
    pub software: bool,
}

impl From<&Adapter> for AdapterRecord {
    fn from(adapter: &Adapter) -> Self {
        let Adapter { name, backend, software } = adapter.clone();
        Self { name, backend, software }
    }
}

/// What came of a configuration.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(tag = "status", rename_all = "lowercase")]
pub enum Outcome {
    /// It was measured.
    Done(Box<Measured>),
    /// It can't be done, and why.
    Failed {
        /// One line.
        message: String,
    },
    /// This machine can't run it, and why.
    Skipped {
        /// One line.
        message: String,
    },
}

/// Times and errors. Of a sequence: times are spreads over its frames, counts those of the middle frame in order of size, errors
/// those of all frames' pixels together.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Measured {
    /// Times.
    pub time: Times,
    /// Memory.
    pub memory_mb: Memory,
    /// Light samples a receiver.
    pub samples: u32,
    /// Occlusion rays.
    pub rays: u64,
    /// Shadow maps, each face counted.
    pub shadow_maps: u32,
    /// Texels of shadow maps, or of their pyramids, that were read; 0 of a technique that does not count them.
    pub texels: u64,
    /// What it was held against.
    pub reference: ReferenceRecord,
    /// How many pixels could be compared.
    pub pixels: PixelCounts,
    /// Errors of visibility.
    pub errors: LightReport,
    /// What a reader should know about the comparison.
    pub notes: Vec<String>,
    /// Of a sequence.
    pub sequence: Option<SequenceRecord>,
}

/// What a sequence has beside a single image.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct SequenceRecord {
    /// Frames a second.
    pub fps: f64,
    /// The slowest frame's wall clock over the median frame's.
    pub wall_max_over_median: f64,
    /// The slowest frame's technique over the median frame's.
    pub render_max_over_median: f64,
    /// Flicker, ghosts, frames to an error.
    pub stability: Stability,
    /// Frame by frame.
    pub frames: Vec<FrameRecord>,
}

/// A frame of a sequence. Times are medians over the passes through the sequence, ms.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FrameRecord {
    /// Its number.
    pub frame: u32,
    /// Its time in the animation, s.
    pub seconds: f64,
    /// As [`Times::wall_ms`].
    pub wall_ms: f64,
    /// As [`Times::build_ms`].
    pub build_ms: f64,
    /// As [`Times::render_ms`].
    pub render_ms: f64,
    /// As [`Baseline::wall_ms`].
    pub baseline_wall_ms: f64,
    /// As [`Baseline::render_ms`].
    pub baseline_render_ms: f64,
    /// As [`Baseline::wall_ratio`].
    pub wall_ratio: f64,
    /// As [`Baseline::render_ratio`].
    pub render_ratio: f64,
    /// Light samples a receiver.
    pub samples: u32,
    /// Occlusion rays.
    pub rays: u64,
    /// Shadow maps, each face counted.
    pub shadow_maps: u32,
    /// Pixels in the penumbra.
    pub penumbra: u64,
    /// RMSE over the penumbra; none without one.
    pub rmse: Option<f64>,
    /// Mean FLIP over the penumbra; none without one.
    pub flip: Option<f64>,
    /// RMSE over the mask `all`.
    pub rmse_all: Option<f64>,
    /// See [`crate::metrics::Change::flicker`].
    pub flicker: Option<f64>,
    /// See [`crate::metrics::Change::ghost_area`].
    pub ghost_area: Option<f64>,
}

/// The reference of a configuration.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ReferenceRecord {
    /// `exact`.
    pub method: String,
    /// Receivers at which it had to sample after all, with 65,536 samples.
    pub sampled_receivers: u64,
}

/// Times of a configuration, ms.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Times {
    /// Runs that were timed.
    pub runs: u32,
    /// Wall clock of a whole frame: receivers, hierarchies or uploads, the technique, reading back. Not the scene's loading.
    pub wall_ms: Spread,
    /// Its part before the technique: receivers and hierarchies or, on a GPU, buffers and G-buffer.
    pub build_ms: Spread,
    /// The technique's part.
    pub render_ms: Spread,
    /// Passes of the first part that a GPU timed, medians.
    pub build_passes: Vec<PassTime>,
    /// Passes of the technique, medians.
    pub passes: Vec<PassTime>,
    /// What was run in turn with it.
    pub baseline: Baseline,
}

/// A pass, as [`crate::techniques::Pass`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PassTime {
    /// What it does.
    pub name: String,
    /// ms.
    pub ms: f64,
}

/// `rays` with 64 samples on the same scene, light and size, run in turn with the configuration: on a shared machine both meet
/// the same load, and the ratios are what holds.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Baseline {
    /// Pairs of runs.
    pub runs: u32,
    /// Wall clock of its whole frame, ms.
    pub wall_ms: Spread,
    /// Its technique's part, ms.
    pub render_ms: Spread,
    /// The configuration's wall clock over the baseline's, pair by pair.
    pub wall_ratio: Spread,
    /// The configuration's technique over the baseline's, pair by pair.
    pub render_ratio: Spread,
}

/// Memory of a configuration, MB (10⁶ bytes).
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Memory {
    /// Largest resident size of the process during one run, with scene and reference; none where the system does not tell.
    pub peak_rss: Option<f64>,
    /// Most memory of the GPU that was held.
    pub gpu: f64,
}

impl Machine {
    /// The one this runs on.
    pub fn this() -> Self {
        let about = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
        let model = about.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
        let architecture = std::env::consts::ARCH;
        Self {
            processor: model.map_or(architecture, |(_, name)| name.trim()).to_owned(),
            system: format!("{} {architecture}", std::env::consts::OS),
            threads: rayon::current_num_threads(),
        }
    }
}

impl Record {
    /// A configuration's, of now.
    pub fn new(configuration: &Configuration, group: &Group, machine: &Machine, outcome: Outcome) -> Self {
        Self {
            key: configuration.key.clone(),
            experiments: configuration.experiments.clone(),
            scene: group.scene.clone(),
            source: group.source.clone(),
            triangles: group.triangles,
            light: group.light.clone(),
            size: group.size,
            frames: group.frames.as_ref().map(|frames| frames.numbers.len() as u32),
            technique: configuration.entry.name.to_owned(),
            preset: configuration.preset.clone(),
            settings: configuration.settings.clone(),
            parameters: configuration.parameters.clone(),
            penumbra: env!("CARGO_PKG_VERSION").to_owned(),
            machine: machine.clone(),
            adapter: configuration.adapter.as_ref().map(AdapterRecord::from),
            date: humantime::format_rfc3339_seconds(std::time::SystemTime::now()).to_string(),
            outcome,
        }
    }

    /// What was measured, if it was.
    pub fn measured(&self) -> Option<&Measured> {
        match &self.outcome {
            Outcome::Done(measured) => Some(measured),
            Outcome::Failed { .. } | Outcome::Skipped { .. } => None,
        }
    }

    /// The columns of `results.csv`, with this record's values; empty where there is none.
    fn cells(&self) -> Vec<(String, String)> {
        let mut cells: Vec<(String, String)> = Vec::new();
        let mut add = |name: &str, value: String| cells.push((name.to_owned(), value));
        let [status, message] = match &self.outcome {
            Outcome::Done(_) => ["done", ""],
            Outcome::Failed { message } => ["failed", message],
            Outcome::Skipped { message } => ["skipped", message],
        };
        let adapter = self.adapter.as_ref();
        add("experiments", self.experiments.join("; "));
        add("scene", self.scene.clone());
        add("source", self.source.clone());
        add("triangles", self.triangles.to_string());
        add("light", self.light.name.clone());
        add("light_shape", self.light.shape.clone());
        add("light_extent", number(self.light.extent));
        add("width", self.size[0].to_string());
        add("height", self.size[1].to_string());
        add("frames", self.frames.map_or_else(String::new, |frames| frames.to_string()));
        add("technique", self.technique.clone());
        add("preset", self.preset.clone());
        add("settings", Value::Object(self.settings.clone()).to_string());
        add("parameters", self.parameters.to_string());
        add("status", status.to_owned());
        add("message", message.to_owned());
        let measured = self.measured();
        let time = measured.map(|measured| &measured.time);
        let mut add_spread = |name: &str, of: &dyn Fn(&Times) -> Spread| {
            let spread = time.map(of);
            add(name, number(spread.map(|spread| spread.median)));
            add(&format!("{name}_q1"), number(spread.map(|spread| spread.q1)));
            add(&format!("{name}_q3"), number(spread.map(|spread| spread.q3)));
        };
        add_spread("wall_ms", &|time| time.wall_ms);
        add_spread("build_ms", &|time| time.build_ms);
        add_spread("render_ms", &|time| time.render_ms);
        add_spread("baseline_wall_ms", &|time| time.baseline.wall_ms);
        add_spread("baseline_render_ms", &|time| time.baseline.render_ms);
        add_spread("wall_ratio", &|time| time.baseline.wall_ratio);
        add_spread("render_ratio", &|time| time.baseline.render_ratio);
        let text = |value: Option<String>| value.unwrap_or_default();
        add("runs", text(time.map(|time| time.runs.to_string())));
        add("baseline_runs", text(time.map(|time| time.baseline.runs.to_string())));
        add("peak_rss_mb", number(measured.and_then(|measured| measured.memory_mb.peak_rss)));
        add("gpu_mb", number(measured.map(|measured| measured.memory_mb.gpu)));
        add("samples", text(measured.map(|measured| measured.samples.to_string())));
        add("rays", text(measured.map(|measured| measured.rays.to_string())));
        add("shadow_maps", text(measured.map(|measured| measured.shadow_maps.to_string())));
        add("texels", text(measured.map(|measured| measured.texels.to_string())));
        for mask in Mask::ALL {
            let errors = measured.and_then(|measured| measured.errors.masks.get(&mask));
            let name = mask.name();
            add(&format!("{name}_count"), text(errors.map(|errors| errors.count.to_string())));
            let values = errors.map(|e| [e.rmse, e.mae, e.p99, e.max, e.bias, e.ssim, e.flip]).unwrap_or_default();
            for (measure, value) in ["rmse", "mae", "p99", "max", "bias", "ssim", "flip"].iter().zip(values) {
                add(&format!("{name}_{measure}"), number(value));
            }
        }
        let errors = measured.map(|measured| &measured.errors);
        for (name, outliers) in [
            ("false_umbra", errors.and_then(|errors| errors.false_umbra)),
            ("false_light", errors.and_then(|errors| errors.false_light)),
        ] {
            add(&format!("{name}_count"), text(outliers.map(|outliers| outliers.count.to_string())));
            add(&format!("{name}_rmse"), number(outliers.and_then(|outliers| outliers.rmse)));
        }
        let sequence = measured.and_then(|measured| measured.sequence.as_ref());
        let stability = sequence.map(|sequence| &sequence.stability);
        add("wall_max_over_median", number(sequence.map(|sequence| sequence.wall_max_over_median)));
        add("render_max_over_median", number(sequence.map(|sequence| sequence.render_max_over_median)));
        add("flicker", number(stability.and_then(|stability| stability.flicker)));
        add("ghost_area", number(stability.and_then(|stability| stability.ghost_area)));
        for (since, since_name) in [(Since::Start, "start"), (Since::Disocclusion, "disocclusion")] {
            for (error, error_name) in SMALL_ERRORS.iter().zip(["8bit", "0.01"]) {
                let found = stability.and_then(|stability| stability.settling(since, *error));
                let name = |measure: &str| format!("{since_name}_frames_to_{error_name}_{measure}");
                add(&name("points"), text(found.map(|found| found.points.to_string())));
                add(&name("median"), text(found.and_then(|found| found.median).map(|frames| frames.to_string())));
                add(&name("p95"), text(found.and_then(|found| found.p95).map(|frames| frames.to_string())));
                add(&name("never"), number(found.map(|found| found.never)));
            }
        }
        add("banding_rmse_per_px", number(errors.and_then(|errors| errors.banding_rmse_per_px)));
        add("compared_pixels", text(measured.map(|measured| measured.pixels.compared.to_string())));
        add("reference_sampled", text(measured.map(|measured| measured.reference.sampled_receivers.to_string())));
        add("adapter", text(adapter.map(|adapter| adapter.name.clone())));
        add("backend", text(adapter.map(|adapter| adapter.backend.clone())));
        add("software", text(adapter.map(|adapter| adapter.software.to_string())));
        add("processor", self.machine.processor.clone());
        add("system", self.machine.system.clone());
        add("threads", self.machine.threads.to_string());
        add("penumbra", self.penumbra.clone());
        add("date", self.date.clone());
        add("key", self.key.clone());
        cells
    }
}

fn number(value: Option<f64>) -> String {
    value.map_or_else(String::new, |value| value.to_string())
}

impl Results {
    /// What a file holds; nothing where there is none.
    ///
    /// # Errors
    /// A file that is not one of results, or of another version's layout.
    pub fn read(path: &Path) -> Result<Self> {
        let mut text = String::new();
        match fs::File::open(path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                return Ok(Self { version: VERSION, suite: String::new(), records: Vec::new() });
            }
            file => file
                .and_then(|file| file.take(MAX_FILE_BYTES).read_to_string(&mut text))
                .map_err(|cause| Error::io(path, cause))?,
        };
        let failed = |message: String| {
            Error::usage(path.display().to_string(), format!("{message}; choose another directory or remove the file"))
        };
        let value: Value = serde_json::from_str(&text).map_err(|error| failed(error.to_string()))?;
        let version = &value["version"];
        if *version != VERSION {
            return Err(failed(format!("expected results of version {VERSION}, found {version}")));
        }
        serde_path_to_error::deserialize(value).map_err(|error| failed(error.to_string()))
    }

    /// The record of a configuration.
    pub fn find(&self, key: &str) -> Option<&Record> {
        self.records.iter().find(|record| record.key == key)
    }

    /// Adds a record; one of the same key makes place.
    pub fn put(&mut self, record: Record) {
        match self.records.iter_mut().find(|old| old.key == record.key) {
            Some(old) => *old = record,
            None => self.records.push(record),
        }
    }

    /// Brings the records of these configurations to the front, in their order.
    pub fn sort(&mut self, configurations: &[Configuration]) {
        let place = |record: &Record| configurations.iter().position(|c| c.key == record.key);
        self.records.sort_by_cached_key(|record| place(record).unwrap_or(usize::MAX));
    }

    /// Writes the file as JSON.
    pub fn write(&self, path: &Path) -> Result<()> {
        let mut text = serde_json::to_string_pretty(self).expect("results are numbers and text");
        text.push('\n');
        write_atomically(path, |file| file.write_all(text.as_bytes()).map_err(|cause| Error::io(path, cause)))
    }

    /// Writes a table, a line a record.
    pub fn write_csv(&self, path: &Path) -> Result<()> {
        write_atomically(path, |file| {
            let mut writer = csv::Writer::from_writer(file);
            let mut write =
                |cells: Vec<String>| writer.write_record(cells).map_err(|error| Error::io(path, error.into()));
            for (i, record) in self.records.iter().enumerate() {
                let (names, values) = record.cells().into_iter().unzip();
                if i == 0 {
                    write(names)?;
                }
                write(values)?;
            }
            writer.flush().map_err(|cause| Error::io(path, cause))
        })
    }
}
