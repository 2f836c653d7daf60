//! What `render` and `reference` write and print: the image, its header, the JSON record.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::ValueEnum;
use glam::DVec3;
use serde::Serialize;
use serde_json::{Map, Value, json};

use super::frames::Frame;
use super::render::ImageOptions;
use super::{print, print_json};
use crate::gpu::Adapter;
use crate::image::{Image, png_paths, write_exr, write_png, write_pngs};
use crate::progress::ms_since;
use crate::receivers::{Receiver, Receivers};
use crate::reference::verify::Verified;
use crate::render::{Counters, Rendering};
use crate::scene::{AreaLight, Scene};
use crate::techniques::Pass;
use crate::{Error, Result};

/// What the image is to show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Quantity {
    /// Fraction of the light's area that is seen, at pixel centres
    Visibility,
    /// W/m² on the surface
    Irradiance,
    /// Surfaces with their base colour, lit by all lights
    Shaded,
}

/// Extra layers of an EXR file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
pub enum Aov {
    /// World position, m
    Position,
    /// World geometric normal
    Normal,
    /// World interpolated normal
    ShadingNormal,
    /// Along the view axis, m
    Depth,
    /// 1 where a receiver was hit (always written)
    Coverage,
}

/// What made an image, for its header and the JSON record.
#[derive(Debug)]
pub struct Origin<'a> {
    /// Technique or reference method.
    pub technique: &'a str,
    /// Its parameters.
    pub parameters: Value,
}

/// The rendering as an image with named channels; takes the pixels out of it.
pub fn image_of(scene: &Scene, rendering: &mut Rendering, origin: &Origin, quantity: Quantity, aovs: &[Aov]) -> Image {
    let receivers = &rendering.receivers;
    let mut image = Image::new(receivers.size);
    for (light, seen) in scene.lights.iter().zip(&mut rendering.lights) {
        image.add(format!("{}.visibility", light.name), std::mem::take(&mut seen.visibility));
        let facing = seen.facing.iter().zip(&receivers.pixels);
        // Where nothing was hit there is nothing to turn away either.
        let facing = facing.map(|(&facing, pixel)| if facing || pixel.is_none() { 1.0 } else { 0.0 }).collect();
        image.add(format!("{}.facing", light.name), facing);
        if !seen.sampled.is_empty() {
            let sampled = seen.sampled.iter().map(|&sampled| f32::from(u8::from(sampled)));
            image.add(format!("{}.sampled", light.name), sampled.collect());
        }
        if quantity == Quantity::Irradiance {
            add_rgb(&mut image, &format!("{}.irradiance", light.name), &seen.irradiance);
            if !seen.irradiance_ratio.is_empty() {
                image.add(format!("{}.irradiance_ratio", light.name), std::mem::take(&mut seen.irradiance_ratio));
            }
        }
    }
    if quantity == Quantity::Shaded {
        add_rgb(&mut image, "shaded", &rendering.shaded);
    }
    add_aovs(&mut image, scene.origin_world, receivers, aovs);
    let attributes = [
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
        ("technique", origin.technique.to_owned()),
        ("parameters", origin.parameters.to_string()),
        ("adapter", rendering.adapter.to_string()),
        ("scene", scene.name.clone()),
    ];
    image.attributes.extend(attributes.map(|(name, value)| (format!("penumbra:{name}"), value)));
    if quantity != Quantity::Visibility && rendering.lights.iter().any(|light| light.approximate) {
        image
            .attributes
            .insert("penumbra:approximate".into(), "irradiance is V times the unshadowed irradiance".into());
    }
    if !rendering.verified.is_empty() {
        let by_light: Map<String, Value> =
            scene.lights.iter().zip(&rendering.verified).map(|(light, v)| (light.name.clone(), json!(v))).collect();
        image.attributes.insert("penumbra:verified".into(), Value::Object(by_light).to_string());
    }
    image
}

fn add_rgb(image: &mut Image, layer: &str, values: &[[f32; 3]]) {
    for (channel, name) in ["R", "G", "B"].iter().enumerate() {
        image.add(format!("{layer}.{name}"), values.iter().map(|rgb| rgb[channel]).collect());
    }
}

fn add_aovs(image: &mut Image, origin_world: DVec3, receivers: &Receivers, aovs: &[Aov]) {
    let mut add_vector = |layer: &str, value: &dyn Fn(&Receiver) -> DVec3| {
        for (axis, name) in ["X", "Y", "Z"].iter().enumerate() {
            let samples = receivers.pixels.iter().map(|pixel| pixel.as_ref().map_or(0.0, |r| value(r)[axis] as f32));
            image.add(format!("{layer}.{name}"), samples.collect());
        }
    };
    if aovs.contains(&Aov::Position) {
        add_vector("position", &|receiver| receiver.position + origin_world);
    }
    if aovs.contains(&Aov::Normal) {
        add_vector("normal", &|receiver| receiver.normal);
    }
    if aovs.contains(&Aov::ShadingNormal) {
        add_vector("shading_normal", &|receiver| receiver.shading_normal);
    }
    let pixels = receivers.pixels.iter();
    if aovs.contains(&Aov::Depth) {
        let depth = pixels.clone().map(|pixel| pixel.as_ref().map_or(0.0, |receiver| receiver.depth as f32));
        image.add("depth.Z", depth.collect());
    }
    image.add("coverage.A", pixels.map(|pixel| if pixel.is_some() { 1.0 } else { 0.0 }).collect());
}

/// Whether an output path asks for PNG rather than EXR.
///
/// # Errors
/// Another extension.
pub fn is_png(path: &Path) -> Result<bool> {
    match path.extension().and_then(|extension| extension.to_str()).map(str::to_lowercase).as_deref() {
        Some("exr") => Ok(false),
        Some("png") => Ok(true),
        _ => Err(Error::usage(format!("-o {}", path.display()), "expected a name that ends in .exr or .png")),
    }
}

/// Writes an image as its path's extension asks; returns the files written.
pub fn write(path: &Path, image: &Image, quantity: Quantity) -> Result<Vec<PathBuf>> {
    if !is_png(path)? {
        write_exr(path, image)?;
        return Ok(vec![path.to_path_buf()]);
    }
    if quantity == Quantity::Shaded {
        let picture = image.rgb_png("shaded").expect("a shaded rendering has that layer");
        write_png(path, picture)?;
        return Ok(vec![path.to_path_buf()]);
    }
    let lights = image.light_names();
    let paths = png_paths(path, &lights);
    let picture = |light: &String| image.visibility_png(light).expect("every light has visibility");
    write_pngs(paths.iter().zip(lights.iter().map(picture)))?;
    Ok(paths)
}

/// Writes what was rendered and prints the record that was asked for.
pub fn finish(
    options: &ImageOptions,
    scene: &Scene,
    rendering: Rendering,
    origin: Origin,
    start: Instant,
    load_ms: f64,
) -> anyhow::Result<()> {
    finish_frame(options, scene, rendering, origin, None, start, load_ms)
}

/// As [`finish`], for a frame of an animation: its record is one line and has the frame's number and time.
pub fn finish_frame(
    options: &ImageOptions,
    scene: &Scene,
    mut rendering: Rendering,
    origin: Origin,
    frame: Option<&Frame>,
    start: Instant,
    load_ms: f64,
) -> anyhow::Result<()> {
    let write_start = Instant::now();
    let image = image_of(scene, &mut rendering, &origin, options.quantity, &options.aov);
    let output = frame.map_or(&options.output, |frame| &frame.output);
    let outputs = write(output, &image, options.quantity)?;
    if options.json {
        let time_ms = TimeRecord {
            load: load_ms,
            build: rendering.build_ms,
            render: rendering.render_ms,
            verify: rendering.verify_ms,
            write: ms_since(write_start),
            total: ms_since(start),
        };
        let record = Record::new(scene, &rendering, origin, &outputs, time_ms);
        match frame {
            None => print_json(&record)?,
            Some(frame) => {
                let record = Record { frame: Some(frame.number), seconds: Some(frame.seconds), ..record };
                print(&serde_json::to_string(&record)?)?;
            }
        }
    } else if !rendering.verified.is_empty() {
        let prefix = frame.map_or_else(String::new, |frame| format!("frame {}, ", frame.number));
        print(&verified_table(scene, &rendering.verified, &prefix))?;
    }
    Ok(())
}

/// The measured errors for people, a line a light, each after `prefix`.
fn verified_table(scene: &Scene, verified: &[Verified], prefix: &str) -> String {
    let line = |(light, v): (&AreaLight, &Verified)| {
        if v.receivers == 0 {
            return format!("{prefix}{}: faces no receiver: nothing to verify", light.name);
        }
        let [low, high] = v.rmse_ci95;
        let sampled = if v.sampled > 0 { format!(", {} of them sampled", v.sampled) } else { String::new() };
        let error = if v.max == 0.0 {
            format!("no error of visibility seen, RMSE at most {high:.5} (95 %)")
        } else {
            format!(
                "RMSE of visibility {:.5}, between {low:.5} and {high:.5} (95 %); largest error {:.5}",
                v.rmse, v.max
            )
        };
        let receivers = if v.receivers == 1 { "1 receiver".into() } else { format!("{} receivers", v.receivers) };
        format!("{prefix}{}: {error}; {receivers}{sampled}", light.name)
    };
    scene.lights.iter().zip(verified).map(line).collect::<Vec<_>>().join("\n")
}

/// The record that `--json` prints.
#[derive(Debug, Serialize)]
pub struct Record {
    /// Of an animation.
    #[serde(skip_serializing_if = "Option::is_none")]
    frame: Option<u32>,
    #[serde(skip_serializing_if = "Option::is_none")]
    seconds: Option<f64>,
    output: String,
    outputs: Vec<String>,
    scene: SceneRecord,
    size: [u32; 2],
    technique: String,
    parameters: Value,
    adapter: Adapter,
    lights: Vec<LightRecord>,
    time_ms: TimeRecord,
    /// What a GPU timed of the time to build.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    build_passes: Vec<Pass>,
    memory_mb: MemoryRecord,
    counters: Counters,
    warnings: Vec<String>,
}

#[derive(Debug, Serialize)]
struct SceneRecord {
    path: String,
    triangles: u64,
    instances: usize,
    lights: usize,
}

#[derive(Debug, Serialize)]
struct LightRecord {
    name: String,
    samples: u32,
    rays: u64,
    shadow_maps: u32,
    /// Of shadow maps, read.
    texels: u64,
    /// Irradiance is V · E₀.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    approximate: bool,
    /// Receivers whose exact answer had to be sampled.
    #[serde(skip_serializing_if = "Option::is_none")]
    sampled_receivers: Option<usize>,
    time_ms: LightTimeRecord,
    #[serde(skip_serializing_if = "Option::is_none")]
    verified: Option<Verified>,
}

#[derive(Debug, Serialize)]
struct LightTimeRecord {
    total: f64,
    passes: Vec<Pass>,
}

/// Wall times of a run.
#[derive(Debug, Default, Clone, Copy, Serialize)]
pub struct TimeRecord {
    /// Reading the scene.
    pub load: f64,
    /// Hierarchies and receivers.
    pub build: f64,
    /// The technique.
    pub render: f64,
    /// The exact answers that the image was held against.
    pub verify: f64,
    /// Writing the output.
    pub write: f64,
    /// All of it.
    pub total: f64,
}

#[derive(Debug, Serialize)]
struct MemoryRecord {
    peak_rss: Option<f64>,
    gpu: f64,
}

impl Record {
    /// The record of a finished run.
    pub fn new(scene: &Scene, rendering: &Rendering, origin: Origin, outputs: &[PathBuf], time_ms: TimeRecord) -> Self {
        let outputs: Vec<String> = outputs.iter().map(|path| path.display().to_string()).collect();
        let lights =
            scene.lights.iter().zip(&rendering.lights).enumerate().map(|(index, (light, image))| LightRecord {
                name: light.name.clone(),
                samples: image.samples,
                rays: image.rays,
                shadow_maps: image.shadow_maps,
                texels: image.texels,
                approximate: image.approximate,
                sampled_receivers: (!image.sampled.is_empty()).then(|| image.sampled.iter().filter(|&&s| s).count()),
                verified: rendering.verified.get(index).copied(),
                time_ms: LightTimeRecord {
                    total: image.passes.iter().map(|pass| pass.ms).sum(),
                    passes: image.passes.clone(),
                },
            });
        Self {
            frame: None,
            seconds: None,
            output: outputs.first().cloned().unwrap_or_default(),
            outputs,
            scene: SceneRecord {
                path: scene.name.clone(),
                triangles: scene.triangle_count(),
                instances: scene.instances.len(),
                lights: scene.lights.len(),
            },
            size: rendering.receivers.size,
            technique: origin.technique.to_owned(),
            parameters: origin.parameters,
            adapter: rendering.adapter.clone(),
            lights: lights.collect(),
            time_ms,
            build_passes: rendering.build_passes.clone(),
            memory_mb: MemoryRecord { peak_rss: peak_rss_mb(), gpu: rendering.gpu_bytes as f64 / 1e6 },
            counters: rendering.counters,
            warnings: scene.warnings.clone(),
        }
    }
}

/// The largest resident size of this process so far, MB, where the system tells (Linux).
pub fn peak_rss_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: f64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kibibytes * 1024.0 / 1e6)
}
