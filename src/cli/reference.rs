//! `penumbra reference`.

use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::{Args, ValueEnum};
use glam::DVec3;

use super::frames::{FrameOptions, Job};
use super::render::ImageOptions;
use super::report::{Origin, Quantity, finish};
use super::scene_options::{LoadedScene, SceneOptions};
use super::{print_warnings, with_bar};
use crate::image::{Image, read_exr};
use crate::progress::{Progress, ms_since};
use crate::receivers::{Receiver, Receivers, UNKNOWN, toward};
use crate::reference::cache::Cached;
use crate::reference::exact::{Exact, REFERENCE_SEED};
use crate::render;
use crate::sampling::Pattern;
use crate::techniques::Technique;
use crate::techniques::rays::Rays;
use crate::{Error, Result};

/// Options of `reference`.
#[derive(Debug, Args)]
pub struct Arguments {
    #[command(flatten)]
    scene: SceneOptions,
    #[command(flatten)]
    image: ImageOptions,
    #[command(flatten)]
    frames: FrameOptions,
    /// How the reference is found
    #[arg(long, value_enum, default_value_t = Method::Exact)]
    method: Method,
    /// Light samples a receiver with `--method rays` (default: 4096)
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1 << 24))]
    samples: Option<u32>,
    /// Answers at the position and normal layers of this image instead of a camera's receivers; the size is then that image's.
    ///
    /// Positions of another renderer may be some way off their surfaces, which must not shadow them: the header says how far, in
    /// metres, as `penumbra:position_error`.
    #[arg(long, value_name = "IN.exr", conflicts_with_all = ["aa", "frames"])]
    receivers: Option<PathBuf>,
    /// Keeps answers in this directory and finds them there again, as long as nothing that they depend on has changed
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Method {
    /// The area that is left of each light, without sampling; where it had to sample after all, the layer `sampled` is 1
    Exact,
    /// Owen-scrambled Sobol' samples of the light, a ray each
    Rays,
}

/// Samples of `--method rays`: ten times below the error of 256 of any pattern.
const DEFAULT_SAMPLES: u32 = 4096;

/// Header attribute of an image whose positions are not the rounded truth: how far they may be from their surface, m.
const POSITION_ERROR: &str = "penumbra:position_error";

/// Runs the command.
pub fn run(arguments: &Arguments, progress: &Progress) -> anyhow::Result<()> {
    let start = Instant::now();
    arguments.image.check()?;
    let frames = arguments.frames.plan(&arguments.image.output)?;
    if arguments.method == Method::Exact && arguments.samples.is_some() {
        return Err(Error::usage("--samples", "the exact answer takes none; add --method rays").into());
    }
    let samples = arguments.samples.unwrap_or(DEFAULT_SAMPLES);
    let rays = Rays { samples, pattern: Pattern::Sobol, seed: REFERENCE_SEED };
    let (name, technique): (_, &dyn Technique) = match arguments.method {
        Method::Exact => ("reference-exact", &Exact),
        Method::Rays => ("reference-rays", &rays),
    };
    let cached = arguments.cache.as_deref().map(|directory| Cached::new(technique, name, directory)).transpose()?;
    let technique = cached.as_ref().map_or(technique, |cached| cached);

    if let Some(frames) = frames {
        let (scene, image, options) = (&arguments.scene, &arguments.image, &arguments.frames);
        Job { scene, image, options, name, technique, verify: None }.run(&frames, start, progress)?;
        print_warnings(&cached.as_ref().map(Cached::warnings).unwrap_or_default());
        return Ok(());
    }
    let mut loaded = arguments.scene.load(arguments.image.load_options())?;
    let load_ms = ms_since(start);
    let rendering = match &arguments.receivers {
        None => {
            loaded.note_framing();
            print_warnings(&loaded.scene.warnings);
            let LoadedScene { scene, camera, .. } = &loaded;
            let request = arguments.image.request(arguments.scene.size);
            with_bar("reference", progress, || render::render(scene, camera, technique, &request, progress))?
        }
        Some(path) => {
            if arguments.image.quantity == Quantity::Shaded {
                let message = "the image's receivers have no material; use visibility or irradiance";
                return Err(Error::usage("--receivers", message).into());
            }
            let scene = &mut loaded.scene;
            if scene.lights.iter().any(|light| !light.light_exclude.is_empty()) {
                let warning = "light_exclude is not applied: an image does not say whose its receivers are";
                scene.warnings.push(warning.into());
            }
            print_warnings(&scene.warnings);
            let receivers = receivers_of(path, &read_exr(path)?, scene.origin_world)?;
            let irradiance = arguments.image.quantity == Quantity::Irradiance;
            let work = || render::render_receivers(scene, receivers, technique, irradiance, progress);
            with_bar("reference", progress, work)?
        }
    };
    print_warnings(&cached.as_ref().map(Cached::warnings).unwrap_or_default());
    let origin = Origin { technique: name, parameters: technique.parameters() };
    finish(&arguments.image, &loaded.scene, rendering, origin, start, load_ms)
}

/// The receivers of an image: its `position` and `normal` layers where `coverage` is 1 (without that layer: where the normal
/// is not zero).
fn receivers_of(path: &Path, image: &Image, origin_world: DVec3) -> Result<Receivers> {
    let layer = |name: &str| {
        image.xyz(name).ok_or_else(|| Error::Image {
            path: path.to_path_buf(),
            message: format!("no layer {name}.X, {name}.Y, {name}.Z; render it with --aov position,normal"),
        })
    };
    let (positions, normals) = (layer("position")?, layer("normal")?);
    let shading_normals = image.xyz("shading_normal");
    let error = match image.attributes.get(POSITION_ERROR) {
        None => 0.0,
        Some(text) => match text.parse::<f64>() {
            Ok(error) if error >= 0.0 && error.is_finite() => error,
            _ => {
                let message =
                    format!("{POSITION_ERROR} in the header: expected a length of at least 0, m, found {text:?}");
                return Err(Error::Image { path: path.to_path_buf(), message });
            }
        },
    };
    let coverage = image.channel("coverage.A");
    let depths = image.channel("depth.Z");
    let pixel = |i: usize| {
        let vector = |layer: [&[f32]; 3]| DVec3::new(layer[0][i].into(), layer[1][i].into(), layer[2][i].into());
        let normal = vector(normals).try_normalize();
        let position_world = vector(positions);
        if coverage.is_some_and(|coverage| coverage[i] < 1.0) || !position_world.is_finite() {
            return None;
        }
        let normal = normal?;
        let shading_normal = shading_normals.and_then(|layer| vector(layer).try_normalize()).unwrap_or(normal);
        Some(Receiver {
            position: position_world - origin_world,
            // A float's own rounding, and what its renderer says about how it came by it.
            position_error: f64::from(f32::EPSILON) * position_world.abs().max_element() + error,
            normal,
            shading_normal: toward(shading_normal, normal),
            depth: depths.map_or(0.0, |depth| depth[i].into()),
            instance: UNKNOWN,
            triangle: UNKNOWN,
            barycentric: [0.0; 2],
        })
    };
    Ok(Receivers { size: image.size, pixels: (0..image.pixel_count()).map(pixel).collect() })
}
