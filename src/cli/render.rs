//! `penumbra render`.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::{Args, ValueEnum};
use serde_json::Value;

use super::frames::{FrameOptions, Job};
use super::report::{Aov, Origin, Quantity, finish, is_png};
use super::scene_options::{LoadedScene, SceneOptions};
use super::{print_warnings, with_bar};
use crate::output;
use crate::progress::{Progress, ms_since};
use crate::render::{self, Request};
use crate::scene::LoadOptions;
use crate::shading::Shading;
use crate::techniques::{BEST, Context, Entry, Needs, Parameters, parse_setting};
use crate::{Error, Result};

/// Options of `render`.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneOptions,
    #[command(flatten)]
    image: ImageOptions,
    #[command(flatten)]
    frames: FrameOptions,
    /// How visibility is found (see `penumbra list`)
    #[arg(long, value_name = "NAME", default_value = "rays")]
    technique: String,
    /// The technique's settings to start from (see `penumbra list`): `best`, or those of a paper
    #[arg(long, value_name = "NAME", default_value = BEST)]
    preset: String,
    /// Sets a parameter of the technique; repeatable
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = parse_setting)]
    settings: Vec<(String, Value)>,
    /// Reads parameters of the technique from a TOML file; `--set` wins
    #[arg(long, value_name = "FILE.toml")]
    config: Option<PathBuf>,
    /// What to run on: each technique runs on the processor or on a GPU (see `penumbra list`), and is refused on the other
    #[arg(long, value_enum, default_value_t = Device::Auto)]
    device: Device,
    /// Holds the visibility against the exact answer at N random receivers, and reports the error: its RMSE over the image with a
    /// 95 % interval, and the largest seen
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1 << 24))]
    verify: Option<u32>,
    #[command(flatten)]
    not_yet: NotYet,
}

/// Options of the command line's contract that this version can't serve: refused by name rather than unknown.
#[derive(Debug, Args)]
struct NotYet {
    /// Largest error that `auto` may make
    #[arg(long, value_name = "E", hide = true)]
    max_error: Option<String>,
    /// Time that `auto` may take
    #[arg(long, value_name = "MS", hide = true)]
    budget: Option<String>,
}

impl NotYet {
    fn refuse(&self) -> Result<()> {
        let options = [
            ("--max-error", &self.max_error, "there is no technique `auto` yet"),
            ("--budget", &self.budget, "there is no technique `auto` yet"),
        ];
        match options.into_iter().find(|(_, given, _)| given.is_some()) {
            Some((option, _, reason)) => Err(Error::usage(option, reason)),
            None => Ok(()),
        }
    }
}

/// Options of the image, shared by `render` and `reference`.
#[derive(Debug, Args)]
pub struct ImageOptions {
    /// Image to write: .exr (float, all layers) or .png (visibility or shaded, one file a light)
    #[arg(short, long, value_name = "OUT.exr|OUT.png")]
    pub output: PathBuf,
    /// What the image shows
    #[arg(long, value_enum, default_value_t = Quantity::Visibility)]
    pub quantity: Quantity,
    /// How surfaces reflect in a shaded image
    #[arg(long, value_enum, default_value_t = Shading::Lambert)]
    pub shading: Shading,
    /// N×N receivers a pixel for irradiance and shaded; visibility is always that of pixel centres
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=16))]
    pub aa: u32,
    /// Layers beside the lights', in an EXR
    #[arg(long, value_enum, value_delimiter = ',', value_name = "LAYER,...")]
    pub aov: Vec<Aov>,
    /// Prints a JSON record of the run
    #[arg(long)]
    pub json: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Device {
    /// What the technique needs
    Auto,
    /// A GPU or nothing
    Gpu,
    /// The processor
    Cpu,
}

impl ImageOptions {
    /// What this asks of the renderer.
    pub fn request(&self, size: [u32; 2]) -> Request {
        Request {
            size,
            irradiance: self.quantity == Quantity::Irradiance,
            shaded: (self.quantity == Quantity::Shaded).then_some(self.shading),
            antialiasing: self.aa,
            verify: None,
        }
    }

    /// What this asks of the loader.
    pub fn load_options(&self) -> LoadOptions {
        LoadOptions {
            base_color_textures: self.quantity == Quantity::Shaded,
            highlights: self.shading == Shading::Phong,
        }
    }

    /// Refuses what can't be written, before anything is computed.
    pub fn check(&self) -> Result<()> {
        let png = is_png(&self.output)?;
        if png && self.quantity == Quantity::Irradiance {
            return Err(Error::usage(
                "--quantity irradiance",
                "a PNG holds visibility or shaded; write irradiance to an .exr",
            ));
        }
        if png && !self.aov.is_empty() {
            return Err(Error::usage("--aov", "a PNG has no layers; write an .exr"));
        }
        if self.aa > 1 && self.quantity == Quantity::Visibility {
            return Err(Error::usage("--aa", "visibility is always that of pixel centres; use irradiance or shaded"));
        }
        if self.shading != Shading::Lambert && self.quantity != Quantity::Shaded {
            return Err(Error::usage("--shading", "only a shaded image has it; use --quantity shaded"));
        }
        output::check(&self.output).map(|_| ())
    }
}

/// Runs the command.
pub fn run(arguments: &Arguments, progress: &Progress) -> anyhow::Result<()> {
    let start = Instant::now();
    arguments.not_yet.refuse()?;
    arguments.image.check()?;
    let frames = arguments.frames.plan(&arguments.image.output)?;
    let entry = Entry::find(&arguments.technique)?;
    match (arguments.device, entry.needs) {
        (Device::Gpu, Needs::Cpu) => {
            return Err(Error::usage("--device gpu", format!("{} runs on the processor", entry.name)).into());
        }
        (Device::Cpu, Needs::Gpu) => {
            return Err(Error::usage("--device cpu", format!("{} runs on a GPU", entry.name)).into());
        }
        _ => {}
    }
    let technique = (entry.build)(&Context::default(), &arguments.parameters(entry)?)?;

    if let Some(frames) = frames {
        let (scene, image, options) = (&arguments.scene, &arguments.image, &arguments.frames);
        let (name, technique, verify) = (entry.name, technique.as_ref(), arguments.verify);
        return Job { scene, image, options, name, technique, verify }.run(&frames, start, progress);
    }
    let mut loaded = arguments.scene.load(arguments.image.load_options())?;
    let load_ms = ms_since(start);
    loaded.note_framing();
    print_warnings(&loaded.scene.warnings);
    let LoadedScene { scene, camera, .. } = &loaded;
    let request = Request { verify: arguments.verify, ..arguments.image.request(arguments.scene.size) };
    let rendering =
        with_bar(entry.name, progress, || render::render(scene, camera, technique.as_ref(), &request, progress))?;
    let origin = Origin { technique: entry.name, parameters: technique.parameters() };
    finish(&arguments.image, scene, rendering, origin, start, load_ms)
}

impl Arguments {
    fn parameters(&self, entry: &Entry) -> Result<Parameters> {
        let mut parameters = entry.preset(&self.preset)?;
        if let Some(path) = &self.config {
            parameters.extend(read_config(path)?);
        }
        parameters.extend(self.settings.iter().cloned());
        Ok(parameters)
    }
}

/// Largest parameter file that is read, bytes: a technique has a handful of parameters.
const MAX_CONFIG_BYTES: u64 = 1 << 20;

fn read_config(path: &Path) -> Result<Parameters> {
    let mut text = String::new();
    std::fs::File::open(path)
        .and_then(|file| file.take(MAX_CONFIG_BYTES).read_to_string(&mut text))
        .map_err(|cause| Error::io(path, cause))?;
    toml::from_str(&text).map_err(|error| {
        let line = error.span().map_or(1, |span| 1 + text[..span.start].matches('\n').count());
        Error::usage(format!("{}, line {line}", path.display()), error.message().replace('\n', " "))
    })
}
