//! What all commands that take a scene share.

use std::ffi::OsString;
use std::path::Path;

use clap::Args;

use crate::scene::additions::{LIGHT_HELP, LightSpec, add_floor, add_light, parse_light};
use crate::scene::{Camera, LoadOptions, Scene, gltf, procedural};
use crate::{Error, Result};

/// Options that pick and complete a scene.
#[derive(Debug, Args)]
pub struct SceneOptions {
    /// Scene: a .gltf or .glb file, or procedural:NAME[?key=value&...] (see `penumbra list`)
    #[arg(value_name = "SCENE")]
    pub scene: String,
    /// Camera to look through, by name [default: the first; without any, one that frames the scene]
    #[arg(long, value_name = "NAME")]
    pub camera: Option<String>,
    /// Light to render, by name; repeatable [default: all]
    #[arg(long = "light", value_name = "NAME")]
    pub lights: Vec<String>,
    /// Adds a light; repeatable. `auto` fits a rect key light to the scene
    #[arg(long, value_name = "SHAPE:KEY=VALUE,...", value_parser = parse_light, long_help = LIGHT_HELP)]
    pub add_light: Vec<LightSpec>,
    /// Puts a large square receiver under the scene, at HEIGHT or at its lowest point
    #[arg(
        long,
        value_name = "HEIGHT",
        num_args = 0..=1,
        default_missing_value = LOWEST,
        allow_negative_numbers = true,
        value_parser = parse_floor
    )]
    pub add_floor: Option<Floor>,
    /// Width and height of the image, pixels
    #[arg(long, value_name = "WxH", default_value = "1024x768", value_parser = parse_size)]
    pub size: [u32; 2],
}

/// Where `--add-floor` puts it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Floor {
    /// At the scene's lowest point.
    Lowest,
    /// At a world height, m.
    At(f64),
}

/// The value of `--add-floor` without a height.
const LOWEST: &str = "lowest";

fn parse_floor(text: &str) -> Result<Floor, String> {
    if text == LOWEST {
        return Ok(Floor::Lowest);
    }
    match text.parse() {
        Ok(height) if f64::is_finite(height) => Ok(Floor::At(height)),
        _ => Err("expected a height, or nothing for the scene's lowest point".into()),
    }
}

/// Gives a bare `--add-floor` its value, so that it does not take the argument after it for a height.
pub fn with_floor_spelled_out(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let arguments: Vec<_> = arguments.collect();
    let is_height =
        |next: Option<&OsString>| next.and_then(|next| next.to_str()).is_some_and(|text| parse_floor(text).is_ok());
    let spelled_out = arguments.iter().enumerate().map(|(i, argument)| {
        let is_bare = argument == "--add-floor" && !is_height(arguments.get(i + 1));
        if is_bare { format!("--add-floor={LOWEST}").into() } else { argument.clone() }
    });
    spelled_out.collect()
}

/// A scene, and the camera that looks at it.
#[derive(Debug)]
pub struct LoadedScene {
    /// With the added lights and floor.
    pub scene: Scene,
    /// Chosen or framed.
    pub camera: Camera,
    is_framed: bool,
}

impl LoadedScene {
    /// Warns where the camera is not one of the scene's.
    pub fn note_framing(&mut self) {
        if self.is_framed {
            self.scene.warnings.push("no camera in the scene: one that frames its bounds is used".into());
        }
    }
}

impl SceneOptions {
    /// Loads the scene, picks the camera, adds lights and floor, drops the lights that are not asked for.
    pub fn load(&self, load: LoadOptions) -> Result<LoadedScene> {
        let mut scene = load_scene(&self.scene, load)?;
        if scene.triangle_count() == 0 {
            let reason = scene.warnings.first().map_or_else(String::new, |warning| format!(" ({warning})"));
            return Err(Error::Scene {
                path: self.scene.clone().into(),
                place: "scene".into(),
                message: format!("no triangles to render{reason}"),
            });
        }
        let (camera, is_framed) = self.pick_camera(&scene)?;
        for spec in &self.add_light {
            add_light(&mut scene, spec, Some(&camera))?;
        }
        match self.add_floor {
            None => {}
            Some(Floor::Lowest) => add_floor(&mut scene, None)?,
            Some(Floor::At(height_world)) => add_floor(&mut scene, Some(height_world))?,
        }
        for name in &self.lights {
            if !scene.lights.iter().any(|light| light.name == *name) {
                let names = scene.lights.iter().map(|light| light.name.as_str());
                return Err(unknown("--light", name, names));
            }
        }
        if !self.lights.is_empty() {
            scene.lights.retain(|light| self.lights.contains(&light.name));
        }
        Ok(LoadedScene { scene, camera, is_framed })
    }

    /// The camera, and whether it is one that frames the scene.
    fn pick_camera(&self, scene: &Scene) -> Result<(Camera, bool)> {
        if let Some(name) = &self.camera {
            let found = scene.cameras.iter().find(|camera| camera.name == *name);
            return found
                .map(|camera| (camera.clone(), false))
                .ok_or_else(|| unknown("--camera", name, scene.cameras.iter().map(|camera| camera.name.as_str())));
        }
        if let Some(first) = scene.cameras.first() {
            return Ok((first.clone(), false));
        }
        let aspect = f64::from(self.size[0]) / f64::from(self.size[1]);
        Ok((Camera::framing(&scene.bounds(), aspect), true))
    }
}

/// Loads a scene by path or `procedural:` name.
pub fn load_scene(name: &str, options: LoadOptions) -> Result<Scene> {
    if name.starts_with("procedural:") {
        return procedural::load(name);
    }
    let path = Path::new(name);
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default().to_lowercase();
    match extension.as_str() {
        "gltf" | "glb" => gltf::load(path, options),
        "usd" | "usda" | "usdc" | "usdz" => Err(Error::usage(
            name,
            "USD scenes are not read yet; convert it to .glb (Blender and other tools export it)",
        )),
        _ => Err(Error::usage(name, "expected a .gltf or .glb file, or procedural:NAME")),
    }
}

fn unknown<'a>(option: &str, name: &str, known: impl Iterator<Item = &'a str>) -> Error {
    let known: Vec<_> = known.collect();
    let message = if known.is_empty() {
        format!("{name:?} is not there; the scene has none")
    } else {
        format!("{name:?} is not there; the scene has {}", known.join(", "))
    };
    Error::usage(option, message)
}

/// Most pixels of an image: receivers take about 130 bytes each.
const MAX_PIXELS: u64 = 1 << 26;

fn parse_size(text: &str) -> Result<[u32; 2], String> {
    let sides: Option<[u32; 2]> = text
        .split_once(['x', 'X'])
        .and_then(|(width, height)| Some([width.trim().parse().ok()?, height.trim().parse().ok()?]));
    match sides {
        Some([width, height]) if width > 0 && height > 0 && u64::from(width) * u64::from(height) <= MAX_PIXELS => {
            Ok([width, height])
        }
        Some(_) => Err(format!("expected 1x1 to {MAX_PIXELS} pixels in all")),
        None => Err("expected WxH, such as 1024x768".into()),
    }
}
