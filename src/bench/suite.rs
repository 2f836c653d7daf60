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
use crate::cli::scene_options::{Floor, LoadedScene, SceneOptions, parse_floor, parse_size};
use crate::gpu::Adapter;
use crate::progress::Progress;
use crate::reference::cache::hash_scene;
use crate::scene::additions::{LightSpec, parse_light};
use crate::scene::{LoadOptions, Scene};
use crate::techniques::{ALL, BEST, Context, Entry, Linking, Needs, Parameters, parse_settings};
use crate::{Error, Result};

/// Suites that come with the binary, by name.
pub const BUILT_IN: [(&str, &str); 2] = [
    ("quick", include_str!("../../scripts/suites/quick.toml")),
    ("scaling", include_str!("../../scripts/suites/scaling.toml")),
];

/// Part of every key: raised whenever what is measured, or how, changes.
const REVISION: u32 = 1;

/// Largest suite file that is read, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// Most configurations of a suite: at the least time that each may take, a day's work.
const MAX_CONFIGURATIONS: usize = 10_000;

/// Stands for every registered technique, or for all presets of one.
const EVERY: &str = "all";

/// Stands for the settings that `penumbra demo` shows.
const DEMO: &str = "demo";

/// A suite as written: every technique with each of its settings, on every scene, under each of its lights, at every size.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Suite {
    /// What it is for; the report shows it.
    #[serde(default)]
    pub about: String,
    /// How long is measured.
    pub timing: Option<Spanned<Timing>>,
    /// Image sizes, each `"WxH"`.
    pub sizes: Vec<Size>,
    /// At least one.
    pub scenes: Vec<SceneEntry>,
    /// At least one.
    pub techniques: Vec<TechniqueEntry>,
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
    /// What is compared with each other.
    pub groups: Vec<Group>,
    /// In the order of the groups.
    pub configurations: Vec<Configuration>,
}

/// A light of a scene at one image size: what techniques are compared on.
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
        label(&self.preset, &self.settings)
    }
}

/// Settings for people; the preset's name where nothing is set.
pub fn label(preset: &str, settings: &Parameters) -> String {
    let shown = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let set: Vec<String> = settings.iter().map(|(key, value)| format!("{key}={}", shown(value))).collect();
    match (preset, set.is_empty()) {
        (_, true) => preset.to_owned(),
        (BEST | DEMO, false) => set.join(" "),
        (_, false) => format!("{preset}: {}", set.join(" ")),
    }
}

impl Group {
    /// Its scene with its light alone, and the camera.
    ///
    /// # Errors
    /// What is wrong with the scene or the options.
    pub fn load(&self) -> Result<LoadedScene> {
        let mut loaded = load(&self.options, self.wanted)?;
        let light = loaded.scene.lights.swap_remove(self.index);
        loaded.scene.lights = vec![light];
        Ok(loaded)
    }

    /// What it is called.
    pub fn label(&self) -> String {
        let [width, height] = self.size;
        format!("{}, {}, {width}x{height}", self.scene, self.light.name)
    }
}

fn load(options: &SceneOptions, wanted: Wanted) -> Result<LoadedScene> {
    let mut loaded = options.load(LoadOptions { base_color_textures: false })?;
    let lights = &mut loaded.scene.lights;
    if let Wanted::Last(count) = wanted {
        lights.drain(..lights.len() - count);
    }
    if lights.is_empty() {
        return Err(crate::render::no_light(&loaded.scene));
    }
    Ok(loaded)
}

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
    /// Reads a suite and checks all of it: every scene is loaded, every technique made.
    ///
    /// # Errors
    /// One line that names the place in the file; [`Error::Cancelled`].
    pub fn read(path: &Path, machine: &Machine, progress: &Progress) -> Result<Self> {
        let built_in = BUILT_IN.iter().find(|(name, _)| Path::new(name) == path && !path.exists());
        let text = match built_in {
            Some((_, text)) => (*text).to_owned(),
            None => read(path)?,
        };
        let source = Source { path, text: &text };
        let suite: Suite =
            toml::from_str(&text).map_err(|error| source.error(error.span().unwrap_or(0..0), error.message()))?;
        for (what, is_empty) in [
            ("sizes", suite.sizes.is_empty()),
            ("scenes", suite.scenes.is_empty()),
            ("techniques", suite.techniques.is_empty()),
        ] {
            if is_empty {
                return Err(source.error(0..0, format!("{what} is empty; expected at least one")));
            }
        }
        let timing = suite.timing.as_ref().map_or_else(Timing::default, |timing| *timing.get_ref());
        if timing.runs < LEAST_RUNS || !(timing.seconds >= 0.0 && timing.seconds.is_finite()) {
            let message = format!("timing: expected runs of at least {LEAST_RUNS} and seconds of 0 or more");
            return Err(source.error(suite.timing.map_or(0..0, |timing| timing.span()), message));
        }
        let techniques = techniques(&suite.techniques, &source, progress)?;
        let mut groups: Vec<Group> = Vec::new();
        let mut names = BTreeSet::new();
        for entry in &suite.scenes {
            let name = entry.name.clone().unwrap_or_else(|| default_name(entry.scene.get_ref()));
            if !names.insert(name.clone()) {
                let message = format!("two scenes are called {name:?}; give one another `name`");
                return Err(source.error(entry.scene.span(), message));
            }
            for (options, wanted, light_name) in entry.variants(path, built_in.is_some(), &suite.sizes, &source)? {
                progress.check()?;
                let found = entry.groups(&name, &options, wanted, light_name.as_deref());
                // Sweeps may meet.
                for group in found.map_err(source.wrap(entry.scene.span()))? {
                    if !groups.iter().any(|other| other.key == group.key) {
                        groups.push(group);
                    }
                }
                if groups.len() * techniques.len() > MAX_CONFIGURATIONS {
                    let message = format!("more than {MAX_CONFIGURATIONS} configurations; make it several suites");
                    return Err(source.error(entry.scene.span(), message));
                }
            }
        }
        let mut configurations = Vec::new();
        let mut keys = BTreeSet::new();
        for (group_index, group) in groups.iter().enumerate() {
            for technique in &techniques {
                let adapter = technique.adapter.as_ref().map(|adapter| &adapter.name);
                let header = format!(
                    "{REVISION} {} {} {} {machine:?} {adapter:?}",
                    group.key, technique.entry.name, technique.parameters
                );
                let key = short_key(&mut Hasher::new().update(header.as_bytes()).clone());
                // So may presets and sweeps.
                if keys.insert(key.clone()) {
                    configurations.push(technique.in_group(key, group_index));
                }
            }
        }
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self { name, about: suite.about, timing, groups, configurations })
    }
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
        suite: &Path,
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
            suite.parent().map_or_else(PathBuf::new, Path::to_path_buf).join(written).to_string_lossy().into_owned()
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

    /// A group for each light that the options leave.
    fn groups(&self, name: &str, options: &SceneOptions, wanted: Wanted, sweep: Option<&str>) -> Result<Vec<Group>> {
        let loaded = load(options, wanted)?;
        let LoadedScene { scene, camera, .. } = &loaded;
        let single = scene.lights.len() == 1;
        let groups = scene.lights.iter().enumerate().map(|(index, light)| {
            let light_name = match sweep {
                None => light.name.clone(),
                Some(sweep) if single => sweep.to_owned(),
                Some(sweep) => format!("{sweep}/{}", light.name),
            };
            let linking = Linking::of(scene, light);
            let mut hasher = Hasher::new();
            let version = env!("CARGO_PKG_VERSION");
            hasher.update(format!("{version} {:?} {camera:?} {light:?} {linking:?}", options.size).as_bytes());
            hash_scene(&mut hasher, scene);
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
                options: options.clone(),
                wanted,
                index,
            }
        });
        Ok(groups.collect())
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
    fn in_group(&self, key: String, group: usize) -> Configuration {
        Configuration {
            key,
            group,
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
