//! Suites: what a TOML file asks to be measured, checked and multiplied out.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;
use std::fs;
use std::io::Read;
use std::ops::Range;
use std::path::{Path, PathBuf};

use blake3::Hasher;
use serde::Deserialize;
use serde_json::Value;
use toml::Spanned;

use super::results::{LightRecord, Machine};
use crate::cli::frames::{parse_fps, parse_frames};
use crate::cli::scene_options::{Floor, LoadedScene, SceneOptions, Sequence, parse_floor, parse_size};
use crate::gpu::Adapter;
use crate::progress::Progress;
use crate::reference::cache::hash_scene;
use crate::scene::additions::{LightSpec, parse_light};
use crate::scene::{LoadOptions, Scene};
use crate::techniques::{ALL, BEST, Context, Entry, Linking, Needs, Parameters, parse_settings};
use crate::{Error, Result};

/// Suites that come with the binary, by name.
pub const BUILT_IN: [(&str, &str); 3] = [
    ("quick", include_str!("../../scripts/suites/quick.toml")),
    ("scaling", include_str!("../../scripts/suites/scaling.toml")),
    ("papers", include_str!("../../scripts/suites/papers.toml")),
];

/// Part of every key: raised whenever what is measured, or how, changes.
const REVISION: u32 = 2;

/// Largest suite file that is read, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// Most configurations of a suite: at the least time that each may take, a day's work.
const MAX_CONFIGURATIONS: usize = 10_000;

/// Most frames of all configurations together: a record of one takes some 600 bytes in a file of at most
/// [`super::results::MAX_FILE_BYTES`].
const MAX_FRAMES: usize = 250_000;

/// Frames a second, where a scene does not say.
const FPS: f64 = 24.0;

/// Stands for every registered technique, or for all presets of one.
const EVERY: &str = "all";

/// Stands for the settings that `penumbra demo` shows.
const DEMO: &str = "demo";

/// A suite as written: every technique with each of its settings, on every scene, under each of its lights, at every size.
/// Either scenes and techniques, or experiments that have their own.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Suite {
    /// What it is for; the report shows it.
    #[serde(default)]
    pub about: String,
    /// How long is measured.
    pub timing: Option<Spanned<Timing>>,
    /// Image sizes, each `"WxH"`.
    #[serde(default)]
    pub sizes: Vec<Size>,
    /// What is rendered.
    #[serde(default)]
    pub scenes: Vec<SceneEntry>,
    /// By what.
    #[serde(default)]
    pub techniques: Vec<TechniqueEntry>,
    /// In place of scenes and techniques.
    #[serde(default)]
    pub experiments: Vec<ExperimentEntry>,
}

/// Scenes and techniques that answer one question.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExperimentEntry {
    /// What it shows; `--only` picks by it.
    title: Spanned<String>,
    /// What a paper says about it; the report puts it beside the figures.
    #[serde(default)]
    paper: String,
    /// Takes the place of the suite's sizes.
    sizes: Option<Vec<Size>>,
    /// At least one.
    scenes: Vec<SceneEntry>,
    /// At least one.
    techniques: Vec<TechniqueEntry>,
    /// The technique in the one setting to whose time the others' are told; measured too if it is not one of them.
    baseline: Option<TechniqueEntry>,
    /// What the report draws it against: a parameter of a technique, or one of the procedural scenes.
    x: Option<Spanned<String>>,
}

/// How many times each configuration is run. Before them, one run warms up.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Timing {
    /// Runs of a configuration, at least [`LEAST_RUNS`].
    pub runs: u32,
    /// No run is begun after this many seconds of them, once there are [`LEAST_RUNS`].
    pub seconds: f64,
}

/// Runs that a median takes at least.
pub const LEAST_RUNS: u32 = 5;

impl Default for Timing {
    fn default() -> Self {
        Self { runs: 21, seconds: 10.0 }
    }
}

/// An image size as `--size` takes it.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(try_from = "String")]
pub struct Size(pub [u32; 2]);

impl TryFrom<String> for Size {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        parse_size(&text).map(Self)
    }
}

/// A light as `--add-light` takes it.
#[derive(Debug, Clone, Deserialize)]
#[serde(try_from = "String")]
pub struct AddedLight(LightSpec);

impl TryFrom<String> for AddedLight {
    type Error = Error;

    fn try_from(text: String) -> Result<Self> {
        parse_light(&text).map(Self)
    }
}

/// A floor as `--add-floor` takes it: `true` for the scene's lowest point, or a height, m.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
#[serde(try_from = "toml::Value")]
pub struct AddedFloor(Option<Floor>);

impl TryFrom<toml::Value> for AddedFloor {
    type Error = String;

    fn try_from(value: toml::Value) -> Result<Self, String> {
        match value {
            toml::Value::Boolean(false) => Ok(Self(None)),
            toml::Value::Boolean(true) => Ok(Self(Some(Floor::Lowest))),
            toml::Value::Integer(_) | toml::Value::Float(_) => parse_floor(&value.to_string()).map(|at| Self(Some(at))),
            _ => Err("expected true or a height".into()),
        }
    }
}

/// A scene with the options that the command line has for it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneEntry {
    /// A .gltf or .glb file, relative to the suite's, or `procedural:NAME[?key=value&…]`.
    scene: Spanned<String>,
    /// Name in the results; without it, the scene's own.
    name: Option<String>,
    /// Scenes of one family differ in size alone: the report draws them against their triangles.
    family: Option<String>,
    /// Camera to look through, as `--camera`.
    camera: Option<String>,
    /// As `--add-floor`.
    #[serde(default)]
    add_floor: AddedFloor,
    /// Lights, each as `--add-light`.
    #[serde(default)]
    add_light: Vec<AddedLight>,
    /// Lights to measure, by name, as `--light`; without it, all. Each is measured on its own.
    #[serde(default)]
    light: Vec<String>,
    /// A sweep over lights: each entry takes the place of `add_light` and `light`.
    #[serde(default)]
    lights: Vec<LightEntry>,
    /// Takes the place of the suite's sizes.
    sizes: Option<Vec<Size>>,
    /// Frames of its animation, as `--frames`: they are rendered one after the other.
    frames: Option<Spanned<String>>,
    /// As `--fps`.
    fps: Option<f64>,
    /// Animation to play, as `--animation`.
    animation: Option<String>,
    /// Frames whose error and picture the report shows; without it, the last one's.
    #[serde(default)]
    show: Vec<u32>,
}

/// A light, or several, of a sweep.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LightEntry {
    /// Name in the results.
    name: String,
    /// Lights, each as `--add-light`.
    #[serde(default)]
    add_light: Vec<AddedLight>,
    /// Lights to measure, by name; without it, those that `add_light` adds or, where it adds none, all.
    #[serde(default)]
    light: Vec<String>,
}

/// A technique with its settings.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TechniqueEntry {
    /// Its name, or `all` for every one that there is.
    technique: Spanned<String>,
    /// A preset or a list of them: `best` (the default), those of papers, `all` for each of these, `demo` for the settings
    /// that `penumbra demo` shows.
    preset: Option<Spanned<Value>>,
    /// Parameters over the preset's: each a value, or a list of values that is multiplied out.
    #[serde(default)]
    set: BTreeMap<String, Spanned<Value>>,
}

/// All that a suite comes to, checked.
#[derive(Debug)]
pub struct Plan {
    /// The suite's name: its file's stem.
    pub name: String,
    /// What it is for.
    pub about: String,
    /// How long is measured.
    pub timing: Timing,
    /// At least one; that of a suite without experiments has no title.
    pub experiments: Vec<Experiment>,
    /// What is compared with each other, in the order of the experiments. Two experiments may have the same.
    pub groups: Vec<Group>,
    /// In the order of the groups.
    pub configurations: Vec<Configuration>,
}

/// Groups that answer one question.
#[derive(Debug)]
pub struct Experiment {
    /// What it shows; empty where the suite has no experiments.
    pub title: String,
    /// What a paper says about it; may be empty.
    pub paper: String,
    /// What others' times are told against.
    pub baseline: Option<Setting>,
    /// What it is drawn against.
    pub x: Option<Sweep>,
    /// Indices into [`Plan::groups`].
    pub groups: Range<usize>,
}

/// A technique in one setting.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    /// For people.
    pub name: String,
    /// The technique.
    pub technique: &'static str,
    /// All parameters in force.
    pub parameters: Value,
}

/// What varies in an experiment.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Sweep {
    /// A parameter of a technique.
    Parameter(String),
    /// A parameter of the procedural scenes.
    Scene(String),
}

/// The frames of a sequence.
#[derive(Debug, Clone, PartialEq)]
pub struct Frames {
    /// At least one, ascending.
    pub numbers: Vec<u32>,
    /// Frames a second: number `n` is at `n / fps` seconds.
    pub fps: f64,
    /// Those that the report shows.
    pub shown: Vec<u32>,
    animation: Option<String>,
}

/// A light of a scene at one image size, or in a sequence: what techniques are compared on.
#[derive(Debug)]
pub struct Group {
    /// Hash of all that its answer depends on.
    pub key: String,
    /// The scene's name in the suite.
    pub scene: String,
    /// The scene as the suite gives it.
    pub source: String,
    /// Scenes of which this is one, that differ in size alone.
    pub family: Option<String>,
    /// Triangles, instances counted each.
    pub triangles: u64,
    /// The light.
    pub light: LightRecord,
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Those of a sequence; none of a single image.
    pub frames: Option<Frames>,
    options: SceneOptions,
    wanted: Wanted,
    index: usize,
}

/// Which of a loaded scene's lights are measured.
#[derive(Debug, Clone, Copy)]
enum Wanted {
    All,
    /// The last ones, which were added.
    Last(usize),
}

/// A technique with its settings, to be measured in a group.
#[derive(Debug)]
pub struct Configuration {
    /// Hash of all that its record depends on.
    pub key: String,
    /// Index into [`Plan::groups`].
    pub group: usize,
    /// Titles of the experiments that ask for it.
    pub experiments: Vec<String>,
    /// The technique.
    pub entry: &'static Entry,
    /// The preset that it starts from.
    pub preset: String,
    /// What is set, preset included.
    pub settings: Parameters,
    /// All parameters in force.
    pub parameters: Value,
    /// What it would run on; none where it can't.
    pub adapter: Option<Adapter>,
    /// Why this machine can't run it.
    pub skipped: Option<String>,
}

impl Configuration {
    /// Its settings for people; the preset's name where nothing is set.
    pub fn label(&self) -> String {
        label(self.entry.name, &self.preset, &self.settings)
    }
}

/// Settings for people: the preset's name, and what is set over it.
pub fn label(technique: &str, preset: &str, settings: &Parameters) -> String {
    let shown = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let preset_settings = Entry::find(technique).and_then(|entry| entry.preset(preset)).unwrap_or_default();
    let over = settings.iter().filter(|(key, value)| preset_settings.get(*key) != Some(*value));
    let set: Vec<String> = over.map(|(key, value)| format!("{key}={}", shown(value))).collect();
    match (preset, set.is_empty()) {
        (_, true) => preset.to_owned(),
        (BEST | DEMO, false) => set.join(" "),
        (_, false) => format!("{preset}: {}", set.join(" ")),
    }
}

impl Group {
    /// Its scene with its light alone, and the camera: of a sequence, in the first frame.
    ///
    /// # Errors
    /// What is wrong with the scene or the options.
    pub fn load(&self) -> Result<LoadedScene> {
        self.posed(&self.poses()?, 0)
    }

    /// Its scene at any frame.
    ///
    /// # Errors
    /// What is wrong with the scene or the options.
    pub fn poses(&self) -> Result<Poses<'_>> {
        Poses::new(&self.options, self.wanted, self.frames.as_ref())
    }

    /// The scene of a frame, by its place in the sequence, with its light alone, and the camera.
    ///
    /// # Errors
    /// What is wrong with the scene in this pose.
    pub fn posed(&self, poses: &Poses, frame: usize) -> Result<LoadedScene> {
        let mut loaded = poses.at(frame)?;
        let light = loaded.scene.lights.swap_remove(self.index);
        loaded.scene.lights = vec![light];
        Ok(loaded)
    }

    /// What it is called.
    pub fn label(&self) -> String {
        let [width, height] = self.size;
        let frames = self.frames.as_ref().map_or_else(String::new, Frames::label);
        format!("{}, {}, {width}x{height}{frames}", self.scene, self.light.name)
    }

    /// The value of a parameter in the name of its procedural scene.
    pub fn scene_value(&self, parameter: &str) -> Option<f64> {
        scene_value(&self.source, parameter)
    }
}

impl Frames {
    fn label(&self) -> String {
        match self.numbers[..] {
            [only] => format!(", frame {only}"),
            _ => format!(", frames {} to {}", self.numbers[0], self.numbers[self.numbers.len() - 1]),
        }
    }

    /// When a frame is, s, by its place.
    pub fn seconds(&self, frame: usize) -> f64 {
        f64::from(self.numbers[frame]) / self.fps
    }
}

fn scene_value(source: &str, parameter: &str) -> Option<f64> {
    let (_, query) = source.strip_prefix("procedural:")?.split_once('?')?;
    let pairs = query.split('&').filter_map(|pair| pair.split_once('='));
    pairs.into_iter().find(|(key, _)| *key == parameter)?.1.parse().ok()
}

/// A group's scene at the times of its frames; a single image is a frame too.
#[derive(Debug)]
pub struct Poses<'a> {
    options: &'a SceneOptions,
    wanted: Wanted,
    moving: Option<(Sequence<'a>, &'a Frames)>,
}

impl<'a> Poses<'a> {
    fn new(options: &'a SceneOptions, wanted: Wanted, frames: Option<&'a Frames>) -> Result<Self> {
        let moving = frames
            .map(|frames| Ok::<_, Error>((options.load_sequence(LOAD, frames.animation.as_deref())?, frames)))
            .transpose()?;
        Ok(Self { options, wanted, moving })
    }

    /// How many frames there are.
    pub fn count(&self) -> usize {
        self.moving.as_ref().map_or(1, |(_, frames)| frames.numbers.len())
    }

    /// The scene of a frame, by its place, with all lights that are wanted.
    fn at(&self, frame: usize) -> Result<LoadedScene> {
        let mut loaded = match &self.moving {
            None => self.options.load(LOAD)?,
            Some((sequence, frames)) => sequence.at(frames.seconds(frame))?,
        };
        let lights = &mut loaded.scene.lights;
        if let Wanted::Last(count) = self.wanted {
            lights.drain(..lights.len() - count);
        }
        if lights.is_empty() {
            return Err(crate::render::no_light(&loaded.scene));
        }
        Ok(loaded)
    }
}

/// Visibility needs no colours.
const LOAD: LoadOptions = LoadOptions { base_color_textures: false, highlights: false };

/// A suite's text, for messages that name the line.
struct Source<'a> {
    path: &'a Path,
    text: &'a str,
}

impl Source<'_> {
    fn error(&self, span: Range<usize>, message: impl Display) -> Error {
        let line = 1 + self.text[..span.start.min(self.text.len())].matches('\n').count();
        Error::usage(format!("{}, line {line}", self.path.display()), message.to_string().replace('\n', " "))
    }

    /// An error of what is written at a place; a request to stop stays one.
    fn wrap(&self, span: Range<usize>) -> impl Fn(Error) -> Error {
        move |error| if matches!(error, Error::Cancelled) { error } else { self.error(span.clone(), error) }
    }
}

impl Plan {
    /// Reads a suite and checks all of it: every scene is loaded, every technique made. With `only`, of a suite's experiments
    /// those whose titles hold one of these texts.
    ///
    /// # Errors
    /// One line that names the place in the file; [`Error::Cancelled`].
    pub fn read(path: &Path, only: &[String], machine: &Machine, progress: &Progress) -> Result<Self> {
        let built_in = BUILT_IN.iter().find(|(name, _)| Path::new(name) == path && !path.exists());
        let text = match built_in {
            Some((_, text)) => (*text).to_owned(),
            None => read(path)?,
        };
        let source = Source { path, text: &text };
        let suite: Suite =
            toml::from_str(&text).map_err(|error| source.error(error.span().unwrap_or(0..0), error.message()))?;
        let timing = suite.timing.as_ref().map_or_else(Timing::default, |timing| *timing.get_ref());
        if timing.runs < LEAST_RUNS || !(timing.seconds >= 0.0 && timing.seconds.is_finite()) {
            let message = format!("timing: expected runs of at least {LEAST_RUNS} and seconds of 0 or more");
            return Err(source.error(suite.timing.map_or(0..0, |timing| timing.span()), message));
        }
        let about = suite.about.clone();
        let asked = only_of(suite.into_experiments(&source)?, only)?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let mut plan =
            Self { name, about, timing, experiments: Vec::new(), groups: Vec::new(), configurations: Vec::new() };
        for entry in asked {
            plan.add(entry, &source, built_in.is_some(), machine, progress)?;
        }
        plan.name_experiments();
        Ok(plan)
    }

    /// Multiplies an experiment out.
    fn add(
        &mut self,
        entry: ExperimentEntry,
        source: &Source,
        built_in: bool,
        machine: &Machine,
        progress: &Progress,
    ) -> Result<()> {
        let mut techniques = techniques(&entry.techniques, source, progress)?;
        let baseline = entry.baseline.as_ref().map(|baseline| Made::only(baseline, source, progress)).transpose()?;
        let baseline = baseline.map(|made| {
            let setting = made.setting();
            techniques.push(made);
            setting
        });
        let sizes = entry.sizes.as_deref().unwrap_or_default();
        let first = self.groups.len();
        let mut names = BTreeSet::new();
        for scene in &entry.scenes {
            let name = scene.name.clone().unwrap_or_else(|| default_name(scene.scene.get_ref()));
            if !names.insert(name.clone()) {
                let message = format!("two scenes are called {name:?}; give one another `name`");
                return Err(source.error(scene.scene.span(), message));
            }
            let frames = scene.frames(source)?;
            let frame_count = frames.as_ref().map_or(0, |frames| frames.numbers.len());
            for (options, wanted, light_name) in scene.variants(built_in, sizes, source)? {
                progress.check()?;
                // Before all its poses are looked at.
                self.check_size(first, frame_count, techniques.len())
                    .map_err(|message| source.error(scene.scene.span(), message))?;
                let found = scene.groups(&name, &options, wanted, frames.as_ref(), light_name.as_deref(), progress);
                // Sweeps may meet.
                for group in found.map_err(source.wrap(scene.scene.span()))? {
                    if !self.groups[first..].iter().any(|other| other.key == group.key) {
                        self.groups.push(group);
                    }
                }
                self.check_size(first, 0, techniques.len())
                    .map_err(|message| source.error(scene.scene.span(), message))?;
            }
        }
        let groups = first..self.groups.len();
        let mut keys = BTreeSet::new();
        for group_index in groups.clone() {
            let group = &self.groups[group_index];
            for technique in &techniques {
                let adapter = technique.adapter.as_ref().map(|adapter| &adapter.name);
                let header = format!(
                    "{REVISION} {} {} {} {machine:?} {adapter:?}",
                    group.key, technique.entry.name, technique.parameters
                );
                let key = short_key(&mut Hasher::new().update(header.as_bytes()).clone());
                // So may presets and sweeps.
                if keys.insert(key.clone()) {
                    self.configurations.push(technique.in_group(key, group_index));
                }
            }
        }
        let x = entry.x.as_ref().map(|x| sweep(x, &techniques, &self.groups[groups.clone()], source)).transpose()?;
        self.experiments.push(Experiment {
            title: entry.title.into_inner(),
            paper: entry.paper.trim().to_owned(),
            baseline,
            x,
            groups,
        });
        Ok(())
    }

    /// Refuses what can't be measured within reason: with the experiment that begins at group `first`, and `more` frames in it.
    fn check_size(&self, first: usize, more: usize, techniques: usize) -> Result<(), String> {
        let frames_of = |group: &Group| group.frames.as_ref().map_or(0, |frames| frames.numbers.len());
        let planned: usize = self.configurations.iter().map(|planned| frames_of(&self.groups[planned.group])).sum();
        let groups = &self.groups[first..];
        if planned + (groups.iter().map(frames_of).sum::<usize>() + more) * techniques > MAX_FRAMES {
            return Err(format!("more than {MAX_FRAMES} frames; make it several suites"));
        }
        if self.configurations.len() + groups.len() * techniques > MAX_CONFIGURATIONS {
            return Err(format!("more than {MAX_CONFIGURATIONS} configurations; make it several suites"));
        }
        Ok(())
    }

    /// Whether it has an experiment of this title.
    pub fn holds(&self, title: &str) -> bool {
        self.experiments.iter().any(|experiment| experiment.title == title)
    }

    /// Tells each configuration all experiments that ask for it.
    fn name_experiments(&mut self) {
        let mut titles: BTreeMap<String, Vec<String>> = BTreeMap::new();
        for configuration in &self.configurations {
            let asks = self.experiments.iter().find(|experiment| experiment.groups.contains(&configuration.group));
            let title = &asks.expect("every group has one").title;
            let titles = titles.entry(configuration.key.clone()).or_default();
            if !title.is_empty() && !titles.contains(title) {
                titles.push(title.clone());
            }
        }
        for configuration in &mut self.configurations {
            configuration.experiments.clone_from(&titles[&configuration.key]);
        }
    }
}

impl Suite {
    /// Its experiments, or its scenes and techniques as one without title.
    fn into_experiments(self, source: &Source) -> Result<Vec<ExperimentEntry>> {
        let Self { sizes, scenes, techniques, experiments, .. } = self;
        if experiments.is_empty() {
            for (what, is_empty) in
                [("sizes", sizes.is_empty()), ("scenes", scenes.is_empty()), ("techniques", techniques.is_empty())]
            {
                if is_empty {
                    return Err(source.error(0..0, format!("{what} is empty; expected at least one")));
                }
            }
            let title = Spanned::new(0..0, String::new());
            let sizes = Some(sizes);
            let (paper, baseline, x) = (String::new(), None, None);
            return Ok(vec![ExperimentEntry { title, paper, sizes, scenes, techniques, baseline, x }]);
        }
        if !(scenes.is_empty() && techniques.is_empty()) {
            let message = "a suite with `experiments` has its scenes and techniques in them; expected none beside them";
            let span = scenes.first().map(|scene| &scene.scene).or(techniques.first().map(|entry| &entry.technique));
            return Err(source.error(span.map_or(0..0, Spanned::span), message));
        }
        let mut titles = BTreeSet::new();
        let mut experiments = experiments;
        for experiment in &mut experiments {
            let span = experiment.title.span();
            let title = experiment.title.get_ref();
            if title.trim().is_empty() || !titles.insert(title.clone()) {
                return Err(source.error(span, "expected a title that no other experiment has"));
            }
            let sizes = experiment.sizes.get_or_insert_with(|| sizes.clone());
            let has_sizes = !sizes.is_empty() || experiment.scenes.iter().all(|scene| scene.sizes.is_some());
            for (what, is_empty) in [
                ("sizes", !has_sizes),
                ("scenes", experiment.scenes.is_empty()),
                ("techniques", experiment.techniques.is_empty()),
            ] {
                if is_empty {
                    return Err(source.error(span, format!("{what} is empty; expected at least one")));
                }
            }
        }
        Ok(experiments)
    }
}

/// The experiments whose titles hold one of some texts, in any case; all without a text.
fn only_of(experiments: Vec<ExperimentEntry>, only: &[String]) -> Result<Vec<ExperimentEntry>> {
    let holds = |experiment: &ExperimentEntry, part: &String| {
        experiment.title.get_ref().to_lowercase().contains(&part.to_lowercase())
    };
    for part in only {
        if !experiments.iter().any(|experiment| holds(experiment, part)) {
            let titles: Vec<&str> = experiments.iter().map(|experiment| experiment.title.get_ref().as_str()).collect();
            let there =
                if titles == [""] { "the suite has none".into() } else { format!("there is {}", titles.join("; ")) };
            return Err(Error::usage(
                format!("--only {part}"),
                format!("no experiment has this in its title; {there}"),
            ));
        }
    }
    let wanted = |experiment: &ExperimentEntry| only.is_empty() || only.iter().any(|part| holds(experiment, part));
    Ok(experiments.into_iter().filter(wanted).collect())
}

/// What an experiment is drawn against.
fn sweep(x: &Spanned<String>, techniques: &[Made], groups: &[Group], source: &Source) -> Result<Sweep> {
    let name = x.get_ref();
    if techniques.iter().any(|technique| technique.parameters[name.as_str()].is_number()) {
        return Ok(Sweep::Parameter(name.clone()));
    }
    if groups.iter().any(|group| group.scene_value(name).is_some()) {
        return Ok(Sweep::Scene(name.clone()));
    }
    Err(source.error(
        x.span(),
        "x: expected a parameter that is a number, of a technique or in the name of a procedural scene",
    ))
}

fn read(path: &Path) -> Result<String> {
    let mut text = String::new();
    let file = fs::File::open(path).map_err(|cause| {
        let names: Vec<&str> = BUILT_IN.iter().map(|(name, _)| *name).collect();
        let message = format!("{cause} (built in are {})", names.join(", "));
        Error::io(path, std::io::Error::new(cause.kind(), message))
    })?;
    file.take(MAX_FILE_BYTES).read_to_string(&mut text).map_err(|cause| Error::io(path, cause))?;
    Ok(text)
}

fn default_name(scene: &str) -> String {
    match scene.strip_prefix("procedural:") {
        Some(name) => name.to_owned(),
        None => Path::new(scene).file_stem().unwrap_or_default().to_string_lossy().into_owned(),
    }
}

/// Half of a hash: two of a suite's would meet once in 10³⁰.
fn short_key(hasher: &mut Hasher) -> String {
    hasher.finalize().to_hex()[..32].to_owned()
}

impl SceneEntry {
    /// The options of each light of the sweep at each size, with the light's name in the results.
    fn variants(
        &self,
        built_in: bool,
        sizes: &[Size],
        source: &Source,
    ) -> Result<Vec<(SceneOptions, Wanted, Option<String>)>> {
        let sizes = self.sizes.as_deref().unwrap_or(sizes);
        if sizes.is_empty() {
            return Err(source.error(self.scene.span(), "sizes is empty; expected at least one"));
        }
        let swept = !self.lights.is_empty();
        if swept && !(self.add_light.is_empty() && self.light.is_empty()) {
            let message = "`lights` takes the place of `add_light` and `light`; give the one or the others";
            return Err(source.error(self.scene.span(), message));
        }
        let own = LightEntry { name: String::new(), add_light: self.add_light.clone(), light: self.light.clone() };
        let lights: Vec<&LightEntry> = if swept { self.lights.iter().collect() } else { vec![&own] };
        let mut names = BTreeSet::new();
        if let Some(twice) = lights.iter().find(|light| !names.insert(&light.name)) {
            return Err(source.error(self.scene.span(), format!("two of its lights are called {:?}", twice.name)));
        }
        let written = self.scene.get_ref();
        let scene = if written.starts_with("procedural:") || built_in {
            written.clone()
        } else {
            source
                .path
                .parent()
                .map_or_else(PathBuf::new, Path::to_path_buf)
                .join(written)
                .to_string_lossy()
                .into_owned()
        };
        let mut variants = Vec::new();
        for light in lights {
            let only_added = swept && light.light.is_empty() && !light.add_light.is_empty();
            let wanted = if only_added { Wanted::Last(light.add_light.len()) } else { Wanted::All };
            for size in sizes {
                let options = SceneOptions {
                    scene: scene.clone(),
                    camera: self.camera.clone(),
                    lights: light.light.clone(),
                    add_light: light.add_light.iter().map(|added| added.0.clone()).collect(),
                    add_floor: self.add_floor.0,
                    size: size.0,
                };
                variants.push((options, wanted, swept.then(|| light.name.clone())));
            }
        }
        Ok(variants)
    }

    /// The frames that are asked for.
    fn frames(&self, source: &Source) -> Result<Option<Frames>> {
        let Some(frames) = &self.frames else {
            if self.fps.is_some() || self.animation.is_some() || !self.show.is_empty() {
                let message = "`fps`, `animation` and `show` are for a scene with `frames`";
                return Err(source.error(self.scene.span(), message));
            }
            return Ok(None);
        };
        let failed = |message: String| source.error(frames.span(), message);
        let numbers: Vec<u32> =
            parse_frames(frames.get_ref()).map_err(|message| failed(format!("frames: {message}")))?.numbers().collect();
        let fps = self.fps.map_or(Ok(FPS), |fps| parse_fps(&fps.to_string()));
        let fps = fps.map_err(|message| failed(format!("fps: {message}")))?;
        if let Some(missing) = self.show.iter().find(|number| !numbers.contains(number)) {
            return Err(failed(format!("show: {missing} is not one of the frames")));
        }
        let shown = if self.show.is_empty() { numbers[numbers.len() - 1..].to_vec() } else { self.show.clone() };
        Ok(Some(Frames { numbers, fps, shown, animation: self.animation.clone() }))
    }

    /// A group for each light that the options leave.
    fn groups(
        &self,
        name: &str,
        options: &SceneOptions,
        wanted: Wanted,
        frames: Option<&Frames>,
        sweep: Option<&str>,
        progress: &Progress,
    ) -> Result<Vec<Group>> {
        let poses = Poses::new(options, wanted, frames)?;
        let loaded = poses.at(0)?;
        let scene = &loaded.scene;
        let mut hashers = vec![Hasher::new(); scene.lights.len()];
        hash_pose(&mut hashers, &loaded, options.size);
        for frame in 1..poses.count() {
            progress.check()?;
            hash_pose(&mut hashers, &poses.at(frame)?, options.size);
        }
        let single = scene.lights.len() == 1;
        let groups = scene.lights.iter().zip(hashers).enumerate().map(|(index, (light, mut hasher))| {
            let light_name = match sweep {
                None => light.name.clone(),
                Some(sweep) if single => sweep.to_owned(),
                Some(sweep) => format!("{sweep}/{}", light.name),
            };
            if let Some(frames) = frames {
                hasher.update(format!("{frames:?}").as_bytes());
            }
            Group {
                key: short_key(&mut hasher),
                scene: name.to_owned(),
                source: self.scene.get_ref().clone(),
                family: self.family.clone(),
                triangles: scene.triangle_count(),
                light: LightRecord {
                    name: light_name,
                    shape: light.shape.name().to_owned(),
                    extent: extent(scene, index),
                },
                size: options.size,
                frames: frames.cloned(),
                options: options.clone(),
                wanted,
                index,
            }
        });
        Ok(groups.collect())
    }
}

/// Adds all that the answers of each light depend on.
fn hash_pose(hashers: &mut [Hasher], loaded: &LoadedScene, size: [u32; 2]) {
    let LoadedScene { scene, camera, .. } = loaded;
    for (hasher, light) in hashers.iter_mut().zip(&scene.lights) {
        let linking = Linking::of(scene, light);
        let version = env!("CARGO_PKG_VERSION");
        hasher.update(format!("{version} {size:?} {camera:?} {light:?} {linking:?}").as_bytes());
        hash_scene(hasher, scene);
    }
}

/// How large a light looks from the middle of the scene: the square root of the area over the distance to it.
fn extent(scene: &Scene, light: usize) -> Option<f64> {
    let center = scene.bounds().center();
    let emitter = scene.lights[light].emitter(center)?;
    let distance = emitter.center.length();
    (distance > 0.0).then(|| emitter.area().sqrt() / distance)
}

/// A technique with its settings, made once to see that it can be.
struct Made {
    entry: &'static Entry,
    preset: String,
    settings: Parameters,
    parameters: Value,
    adapter: Option<Adapter>,
    skipped: Option<String>,
}

impl Made {
    /// What comes of an entry that stands for one setting.
    fn only(entry: &TechniqueEntry, source: &Source, progress: &Progress) -> Result<Self> {
        let mut made = techniques(std::slice::from_ref(entry), source, progress)?;
        match (made.pop(), made.len()) {
            (Some(only), 0) => Ok(only),
            (_, more) => {
                let message = format!("baseline: expected one setting, found {}", more + 1);
                Err(source.error(entry.technique.span(), message))
            }
        }
    }

    fn setting(&self) -> Setting {
        let name = format!("{} {}", self.entry.name, label(self.entry.name, &self.preset, &self.settings));
        Setting { name, technique: self.entry.name, parameters: self.parameters.clone() }
    }

    fn in_group(&self, key: String, group: usize) -> Configuration {
        Configuration {
            key,
            group,
            experiments: Vec::new(),
            entry: self.entry,
            preset: self.preset.clone(),
            settings: self.settings.clone(),
            parameters: self.parameters.clone(),
            adapter: self.adapter.clone(),
            skipped: self.skipped.clone(),
        }
    }
}

/// Every technique with every one of its settings.
fn techniques(entries: &[TechniqueEntry], source: &Source, progress: &Progress) -> Result<Vec<Made>> {
    let context = Context::default();
    let mut techniques = Vec::new();
    for asked in entries {
        let span = asked.technique.span();
        let name = asked.technique.get_ref();
        let found: Vec<&'static Entry> = if name == EVERY {
            ALL.iter().collect()
        } else {
            vec![Entry::find(name).map_err(source.wrap(span.clone()))?]
        };
        if name == EVERY && !asked.set.is_empty() {
            return Err(source.error(span, "`set` is for one technique, by its name"));
        }
        let presets = match &asked.preset {
            None => vec![BEST.to_owned()],
            Some(preset) => names(preset.get_ref()).map_err(|message| source.error(preset.span(), message))?,
        };
        let preset_span = asked.preset.as_ref().map_or(span.clone(), Spanned::span);
        for preset in &presets {
            let mut settings: Vec<(&'static Entry, String, Parameters)> = Vec::new();
            let mut refusal = None;
            for &entry in &found {
                match preset_settings(entry, preset) {
                    Ok(found) => settings.extend(found.into_iter().map(|(name, set)| (entry, name, set))),
                    Err(error) => refusal = Some(error),
                }
            }
            // Of all techniques, those that have the preset are meant.
            if let (true, Some(refusal)) = (settings.is_empty(), refusal) {
                return Err(source.error(preset_span, refusal));
            }
            for (entry, preset, base) in settings {
                for swept in product(&asked.set, source)? {
                    progress.check()?;
                    let mut settings = base.clone();
                    settings.extend(swept);
                    let place = |error: &Error| {
                        let message = error.to_string();
                        let named = asked.set.iter().find(|(key, _)| message.contains(&format!("parameter {key} of")));
                        named.map_or(span.clone(), |(_, value)| value.span())
                    };
                    let made = make(&context, entry, preset.clone(), settings);
                    techniques.push(made.map_err(|error| source.error(place(&error), error))?);
                }
            }
        }
    }
    Ok(techniques)
}

fn make(context: &Context, entry: &'static Entry, preset: String, settings: Parameters) -> Result<Made> {
    let (parameters, adapter, skipped) = match (entry.build)(context, &settings) {
        Ok(technique) => {
            let adapter = technique.gpu().map_or_else(Adapter::cpu, |gpu| gpu.adapter.clone());
            (technique.parameters(), Some(adapter), None)
        }
        Err(error @ Error::Gpu(_)) if entry.needs == Needs::Gpu => {
            (Value::Object(settings.clone()), None, Some(error.to_string()))
        }
        Err(error) => return Err(error),
    };
    Ok(Made { entry, preset, settings, parameters, adapter, skipped })
}

/// The settings of a preset, by the name that it has in the results.
fn preset_settings(entry: &Entry, preset: &str) -> Result<Vec<(String, Parameters)>> {
    match preset {
        EVERY => std::iter::once(BEST)
            .chain(entry.presets.iter().map(|(name, _)| *name))
            .map(|name| Ok((name.to_owned(), entry.preset(name)?)))
            .collect(),
        DEMO => entry.demo.iter().map(|settings| Ok((DEMO.to_owned(), parse_settings(settings)?))).collect(),
        _ => Ok(vec![(preset.to_owned(), entry.preset(preset)?)]),
    }
}

/// A name or a list of names.
fn names(value: &Value) -> Result<Vec<String>, String> {
    let name = |value: &Value| value.as_str().map(str::to_owned);
    let names: Option<Vec<String>> = list(value).iter().map(name).collect();
    names.filter(|names| !names.is_empty()).ok_or_else(|| "expected the name of a preset, or a list of them".into())
}

/// A value, or the values of a list.
fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(std::slice::from_ref(value), Vec::as_slice)
}

/// Every combination of the values.
fn product(set: &BTreeMap<String, Spanned<Value>>, source: &Source) -> Result<Vec<Parameters>> {
    let mut combinations = vec![Parameters::new()];
    for (key, values) in set {
        let (span, values) = (values.span(), list(values.get_ref()));
        if values.is_empty() {
            return Err(source.error(span, format!("{key}: expected a value or a list of values, found an empty list")));
        }
        if combinations.len() * values.len() > MAX_CONFIGURATIONS {
            return Err(source.error(span, format!("more than {MAX_CONFIGURATIONS} combinations")));
        }
        let with = |combination: &Parameters| {
            let combination = combination.clone();
            values.iter().map(move |value| {
                let mut longer = combination.clone();
                longer.insert(key.clone(), value.clone());
                longer
            })
        };
        combinations = combinations.iter().flat_map(with).collect();
    }
    Ok(combinations)
}
