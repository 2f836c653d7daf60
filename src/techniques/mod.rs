//! The techniques: everything that estimates visibility, behind one trait, in one table.
//!
//! A technique is one file with an [`Entry`] in it; the command line, the demo and the tests iterate [`ALL`].

pub mod adaptive;
pub mod bilateral;
pub mod bitmask;
pub mod cascaded;
pub mod hard;
pub mod min_max_backprojection;
pub mod min_max_pcf;
pub mod pcf;
pub mod pcss;
pub mod rays;
pub mod shadow_volumes;
pub mod soft_shadow_map;
pub mod temporal;
pub mod uniform;

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use glam::DVec3;
use schemars::{JsonSchema, SchemaGenerator};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::geometry::bvh::SceneBvh;
use crate::gpu::Gpu;
use crate::gpu::scene::SceneBuffers;
use crate::history::Shot;
use crate::progress::{Progress, ms_since};
use crate::receivers::{Receiver, Receivers};
use crate::scene::{AreaLight, Scene};
use crate::{Error, Result};

/// All techniques, in the order in which they are shown.
pub const ALL: &[Entry] = &[
    rays::ENTRY,
    hard::ENTRY,
    pcf::ENTRY,
    min_max_pcf::ENTRY,
    pcss::ENTRY,
    min_max_backprojection::ENTRY,
    bitmask::ENTRY,
    soft_shadow_map::ENTRY,
    shadow_volumes::ENTRY,
    uniform::ENTRY,
    adaptive::ENTRY,
    temporal::ENTRY,
    cascaded::ENTRY,
    bilateral::ENTRY,
];

/// A technique's place in the registry.
#[derive(Debug)]
pub struct Entry {
    /// Name on the command line and in reports; the file's stem, with `-` for `_`.
    pub name: &'static str,
    /// Where it comes from.
    pub paper: &'static str,
    /// One line on what it does.
    pub summary: &'static str,
    /// What it runs on.
    pub needs: Needs,
    /// JSON schema of its parameters: defaults, ranges and meanings come from here alone.
    pub schema: fn() -> Value,
    /// Settings by name beside `best`, which is the parameters' defaults; each as [`parse_settings`] reads it.
    pub presets: &'static [(&'static str, &'static str)],
    /// Settings that `demo` shows, each as [`parse_settings`] reads it.
    pub demo: &'static [&'static str],
    /// Makes it with the given parameters, checked against the schema.
    pub build: fn(&Context, &Parameters) -> Result<Box<dyn Technique>>,
}

/// The settings that every technique has: the defaults of its parameters.
pub const BEST: &str = "best";

/// What techniques are made with.
#[derive(Debug, Default)]
pub struct Context {
    gpu: Mutex<Option<Arc<Gpu>>>,
}

impl From<Gpu> for Context {
    /// With a GPU that is open already.
    fn from(gpu: Gpu) -> Self {
        Self { gpu: Mutex::new(Some(Arc::new(gpu))) }
    }
}

impl Context {
    /// The GPU, opened when it is first asked for.
    ///
    /// # Errors
    /// As [`Gpu::open`].
    pub fn gpu(&self) -> Result<Arc<Gpu>> {
        let mut gpu = self.gpu.lock().unwrap_or_else(PoisonError::into_inner);
        if gpu.is_none() {
            *gpu = Some(Arc::new(Gpu::open()?));
        }
        Ok(Arc::clone(gpu.as_ref().expect("just opened")))
    }
}

/// What a technique runs on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Needs {
    /// The processor.
    Cpu,
    /// A GPU, which may be a software one.
    Gpu,
}

/// Parameters by name, as given by `--set` and `--config`.
pub type Parameters = Map<String, Value>;

/// What a technique works on.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    /// The scene.
    pub scene: &'a Scene,
    /// Hierarchy over all that can block the light; of what is drawn by a GPU, it holds nothing.
    pub bvh: &'a SceneBvh<'a>,
    /// Where visibility is asked for.
    pub receivers: &'a Receivers,
    /// Whether irradiance is asked for beside visibility.
    pub irradiance: bool,
    /// Progress, in image rows, and cancellation.
    pub progress: &'a Progress,
    /// The scene on the GPU, for techniques that have one.
    pub buffers: Option<&'a SceneBuffers>,
    /// The image that the receivers are the pixels of; none for given receivers.
    pub shot: Option<&'a Shot<'a>>,
}

/// What a technique finds out about one light, a value a pixel; pixels without receiver hold V = 1 and E = 0.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LightImage {
    /// V, in [0, 1].
    pub visibility: Vec<f32>,
    /// E, W/m², RGB; empty unless asked for.
    pub irradiance: Vec<[f32; 3]>,
    /// E/E₀, the share of the unshadowed irradiance, in [0, 1]; 0 where E₀ is. Empty unless E is asked for at pixel centres.
    pub irradiance_ratio: Vec<f32>,
    /// Whether some of the light lies above the receiver's tangent plane and emits towards it. Where not, V is 0 and the pixel
    /// is in no mask.
    pub facing: Vec<bool>,
    /// Where the exact reference had to sample; empty for what always does.
    pub sampled: Vec<bool>,
    /// Light samples a receiver.
    pub samples: u32,
    /// Occlusion rays traced.
    pub rays: u64,
    /// Shadow maps rendered, each face of a light point counted.
    pub shadow_maps: u32,
    /// Texels of shadow maps read.
    pub texels: u64,
    /// Whether the irradiance is V · E₀ rather than weighted sample by sample.
    pub approximate: bool,
    /// Time of each pass.
    pub passes: Vec<Pass>,
}

/// Which instances a light lights, and which block it.
#[derive(Debug)]
pub struct Linking {
    /// By instance; shorter where nothing is excluded.
    transparent: Vec<bool>,
    unlit: Vec<bool>,
}

impl Linking {
    /// What a light's exclusions name, and its own geometry.
    pub fn of(scene: &Scene, light: &AreaLight) -> Self {
        let under = |names: &[String]| if names.is_empty() { Vec::new() } else { scene.instances_under(names) };
        let mut transparent = under(&light.shadow_exclude);
        if let Some(own) = light.own_instance {
            transparent.resize(scene.instances.len(), false);
            transparent[own] = true;
        }
        Self { transparent, unlit: under(&light.light_exclude) }
    }

    /// Whether an instance may block the light.
    pub fn blocks(&self, instance: u32) -> bool {
        self.transparent.get(instance as usize) != Some(&true)
    }

    /// Whether the light lights a receiver.
    pub fn lights(&self, receiver: &Receiver) -> bool {
        self.unlit.get(receiver.instance as usize) != Some(&true)
    }
}

impl LightImage {
    /// Adds a pixel: V, E with E/E₀ if asked for, and whether the light faces it.
    pub fn push(&mut self, visibility: f64, irradiance: Option<(DVec3, f64)>, facing: bool) {
        self.visibility.push(visibility as f32);
        self.facing.push(facing);
        if let Some((rgb, ratio)) = irradiance {
            self.irradiance.push(rgb.as_vec3().to_array());
            self.irradiance_ratio.push(ratio as f32);
        }
    }
}

/// Time of one pass of a technique.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Pass {
    /// What it does.
    pub name: &'static str,
    /// Wall time, ms.
    pub ms: f64,
}

/// Adds the times of passes to those of the same names.
pub fn add_passes(passes: &mut Vec<Pass>, more: Vec<Pass>) {
    for pass in more {
        match passes.iter_mut().find(|known| known.name == pass.name) {
            Some(known) => known.ms += pass.ms,
            None => passes.push(pass),
        }
    }
}

/// Anything that estimates the visibility of a light from receivers.
pub trait Technique: std::fmt::Debug + Send + Sync {
    /// The estimate for one light.
    ///
    /// # Errors
    /// [`Error::Cancelled`] when the user asks to stop; else what the technique can't do with this light or scene.
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage>;

    /// The parameters in force, defaults included.
    fn parameters(&self) -> Value;

    /// Pixels that it wants to see beyond an image of `size`, left and right, above and below; of those on a GPU.
    fn border_px(&self, _size: [u32; 2]) -> [u32; 2] {
        [0; 2]
    }

    /// What it runs on, where that is not the processor.
    fn gpu(&self) -> Option<&Gpu> {
        None
    }
}

impl Entry {
    /// The entry of a name.
    ///
    /// # Errors
    /// One line that lists the names there are.
    pub fn find(name: &str) -> Result<&'static Self> {
        ALL.iter().find(|entry| entry.name == name).ok_or_else(|| {
            let names: Vec<_> = ALL.iter().map(|entry| entry.name).collect();
            Error::usage(format!("technique {name:?}"), format!("unknown; there is {}", names.join(", ")))
        })
    }

    /// The settings of a preset.
    ///
    /// # Errors
    /// One line that lists the presets there are.
    pub fn preset(&self, name: &str) -> Result<Parameters> {
        if name == BEST {
            return Ok(Parameters::new());
        }
        match self.presets.iter().find(|(preset, _)| *preset == name) {
            Some((_, settings)) => parse_settings(settings),
            None => {
                let names: Vec<_> = std::iter::once(BEST).chain(self.presets.iter().map(|(name, _)| *name)).collect();
                let message = format!("{} has no such settings; there is {}", self.name, names.join(", "));
                Err(Error::usage(format!("--preset {name}"), message))
            }
        }
    }

    /// Its parameters, in the order of its source.
    pub fn parameters(&self) -> Vec<Parameter> {
        let schema = (self.schema)();
        let properties = schema["properties"].as_object().cloned().unwrap_or_default();
        properties.into_iter().map(|(name, property)| Parameter::from_schema(name, &property, &schema)).collect()
    }
}

/// A parameter as `penumbra list` shows it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Parameter {
    /// Its key for `--set`.
    pub name: String,
    /// What it means.
    pub meaning: String,
    /// Value when not set.
    pub default: Value,
    /// Smallest value, for a number.
    pub minimum: Option<f64>,
    /// Largest value, for a number.
    pub maximum: Option<f64>,
    /// The values there are, for a choice, each with its meaning.
    pub choices: Vec<(String, String)>,
}

impl Parameter {
    fn from_schema(name: String, property: &Value, schema: &Value) -> Self {
        let text = |value: &Value| value["description"].as_str().unwrap_or_default().replace('\n', " ");
        let definition =
            property["$ref"].as_str().and_then(|reference| schema.pointer(reference.trim_start_matches('#')));
        let choices =
            definition.and_then(|definition| definition["oneOf"].as_array()).map_or_else(Vec::new, |variants| {
                variants
                    .iter()
                    .map(|variant| (variant["const"].as_str().unwrap_or_default().to_owned(), text(variant)))
                    .collect()
            });
        Self {
            name,
            meaning: text(property),
            default: property["default"].clone(),
            minimum: property["minimum"].as_f64(),
            maximum: property["maximum"].as_f64(),
            choices,
        }
    }
}

/// The schema of a technique's parameters.
pub fn schema_of<T: JsonSchema>() -> Value {
    SchemaGenerator::default().into_root_schema_for::<T>().to_value()
}

/// Reads a technique's parameters: unknown names, wrong types and values out of range are errors.
pub fn parse_parameters<T: JsonSchema + DeserializeOwned>(entry: &Entry, given: &Parameters) -> Result<T> {
    let known = entry.parameters();
    for (key, value) in given {
        let what = format!("parameter {key} of {}", entry.name);
        let Some(parameter) = known.iter().find(|parameter| parameter.name == *key) else {
            let names: Vec<_> = known.iter().map(|parameter| parameter.name.as_str()).collect();
            return Err(Error::usage(what, format!("unknown; there is {}", names.join(", "))));
        };
        if let Some(number) = value.as_f64() {
            let minimum = parameter.minimum.unwrap_or(f64::NEG_INFINITY);
            let maximum = parameter.maximum.unwrap_or(f64::INFINITY);
            if !(minimum..=maximum).contains(&number) {
                return Err(Error::usage(what, format!("expected {minimum} to {maximum}, found {number}")));
            }
        }
        let is_choice = |(choice, _): &(String, String)| value.as_str() == Some(choice);
        if !parameter.choices.is_empty() && !parameter.choices.iter().any(is_choice) {
            let names: Vec<_> = parameter.choices.iter().map(|(choice, _)| choice.as_str()).collect();
            return Err(Error::usage(what, format!("expected one of {}, found {value}", names.join(", "))));
        }
    }
    serde_path_to_error::deserialize(Value::Object(given.clone())).map_err(|error| {
        Error::usage(format!("parameter {} of {}", error.path(), entry.name), error.inner().to_string())
    })
}

/// Reads settings, `key=value` separated by spaces.
pub fn parse_settings(text: &str) -> Result<Parameters> {
    text.split_whitespace().map(parse_setting).collect()
}

/// Reads one `key=value`: a number (1e3 is a whole one), true or false where it reads as one, else text.
pub fn parse_setting(text: &str) -> Result<(String, Value)> {
    let Some((key, value)) = text.split_once('=') else {
        return Err(Error::usage(text, "expected KEY=VALUE"));
    };
    let value: Value = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.to_owned()));
    // Exact as a whole number up to 2^53.
    let whole = value.as_f64().filter(|number| value.is_f64() && number.fract() == 0.0 && number.abs() < 2f64.powi(53));
    let value = whole.map_or(value, |number| Value::from(number as i64));
    Ok((key.to_owned(), value))
}

/// Runs a pass and notes how long it took.
pub fn timed<T>(passes: &mut Vec<Pass>, name: &'static str, pass: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let result = pass();
    passes.push(Pass { name, ms: ms_since(start) });
    result
}
