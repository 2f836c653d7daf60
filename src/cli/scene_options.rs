//! What all commands that take a scene share.

use std::ffi::OsString;
use std::path::Path;

use clap::Args;
use glam::{DAffine3, DVec3};

use crate::scene::additions::{LIGHT_HELP, LightSpec, add_floor_within, add_light_within, lowest_point, parse_light};
use crate::scene::animation::Animated;
use crate::scene::{AreaLight, Bounds, Camera, Instance, LoadOptions, Mesh, Node, Scene, gltf, procedural};
use crate::{Error, Result};

/// Options that pick and complete a scene.
#[derive(Debug, Clone, Args)]
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

/// Reads the value of `--add-floor`.
pub fn parse_floor(text: &str) -> Result<Floor, String> {
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
        self.expect_triangles(&scene)?;
        let bounds = scene.bounds();
        let (camera, is_framed) = self.pick_camera(&scene, &bounds)?;
        self.add(&mut scene, &camera, &bounds, None)?;
        self.keep_lights(&mut scene)?;
        Ok(LoadedScene { scene, camera, is_framed })
    }

    /// Loads the scene with its animations and fits what is added to the one that is played: by name, else the first.
    pub fn load_sequence(&self, load: LoadOptions, animation: Option<&str>) -> Result<Sequence<'_>> {
        let animated = load_animated(&self.scene, load)?;
        let clips = &animated.clips;
        let clip = match animation {
            Some(name) => match clips.iter().position(|clip| clip.name == name) {
                Some(clip) => Some(clip),
                None => return Err(unknown("--animation", name, clips.iter().map(|clip| clip.name.as_str()))),
            },
            None => (!clips.is_empty()).then_some(0),
        };
        let mut sequence = Sequence { options: self, animated, clip, fixtures: Fixtures::default() };
        sequence.fixtures = sequence.fit()?;
        Ok(sequence)
    }

    fn expect_triangles(&self, scene: &Scene) -> Result<()> {
        if scene.triangle_count() > 0 {
            return Ok(());
        }
        let reason = scene.warnings.first().map_or_else(String::new, |warning| format!(" ({warning})"));
        Err(Error::Scene {
            path: self.scene.clone().into(),
            place: "scene".into(),
            message: format!("no triangles to render{reason}"),
        })
    }

    /// Adds lights and floor, fitted to bounds and lowest point (world; none: the scene's).
    fn add(&self, scene: &mut Scene, camera: &Camera, bounds: &Bounds, lowest_world: Option<f64>) -> Result<()> {
        for spec in &self.add_light {
            add_light_within(scene, spec, Some(camera), bounds)?;
        }
        match self.add_floor {
            None => Ok(()),
            Some(Floor::Lowest) => add_floor_within(scene, lowest_world, bounds),
            Some(Floor::At(height_world)) => add_floor_within(scene, Some(height_world), bounds),
        }
    }

    /// Drops the lights that are not asked for.
    fn keep_lights(&self, scene: &mut Scene) -> Result<()> {
        for name in &self.lights {
            if !scene.lights.iter().any(|light| light.name == *name) {
                let names = scene.lights.iter().map(|light| light.name.as_str());
                return Err(unknown("--light", name, names));
            }
        }
        if !self.lights.is_empty() {
            scene.lights.retain(|light| self.lights.contains(&light.name));
        }
        Ok(())
    }

    /// The camera, and whether it is one that frames the bounds.
    fn pick_camera(&self, scene: &Scene, bounds: &Bounds) -> Result<(Camera, bool)> {
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
        Ok((Camera::framing(bounds, aspect), true))
    }
}

/// A scene with the lights, floor and camera that its options ask for, at any time.
#[derive(Debug)]
pub struct Sequence<'a> {
    options: &'a SceneOptions,
    animated: Animated,
    /// Index into the animations; none: the scene stands still.
    clip: Option<usize>,
    fixtures: Fixtures,
}

/// What is added to a scene and stays where it is while the scene moves. In the scene space that `origin_world` says.
#[derive(Debug, Default)]
struct Fixtures {
    origin_world: DVec3,
    lights: Vec<AreaLight>,
    floor: Option<(Mesh, Instance)>,
    /// The camera that frames all of the animation, where the scene has none.
    camera: Option<Camera>,
}

/// Poses of an animation that added lights, floor and camera are fitted to, at equal steps from its first key to its last: a
/// foot that comes down in a cycle of a second is lowest within 16 ms of one of them.
const FITTED_POSES: u32 = 33;

impl Sequence<'_> {
    /// The scene at a time, completed.
    pub fn at(&self, seconds: f64) -> Result<LoadedScene> {
        let mut scene = self.pose(seconds)?;
        let (camera, is_framed) = match &self.fixtures.camera {
            Some(camera) => (self.fixed_camera(camera, &scene), true),
            None => self.options.pick_camera(&scene, &Bounds::EMPTY)?,
        };
        let scene_from_fixtures = self.fixtures.origin_world - scene.origin_world;
        if let Some((mesh, instance)) = &self.fixtures.floor {
            scene.nodes.push(Node { name: mesh.name.clone(), parent: None });
            scene.meshes.push(mesh.clone());
            let mut instance =
                Instance { mesh: scene.meshes.len() - 1, node: scene.nodes.len() - 1, ..instance.clone() };
            instance.scene_from_mesh.translation += scene_from_fixtures;
            scene.instances.push(instance);
        }
        let lights = self.fixtures.lights.iter().cloned().map(|mut light| {
            light.scene_from_light.translation += scene_from_fixtures;
            light
        });
        scene.add_lights(lights);
        self.options.expect_triangles(&scene)?;
        self.options.keep_lights(&mut scene)?;
        Ok(LoadedScene { scene, camera, is_framed })
    }

    fn fixed_camera(&self, camera: &Camera, scene: &Scene) -> Camera {
        let mut camera = camera.clone();
        camera.scene_from_camera.translation += self.fixtures.origin_world - scene.origin_world;
        camera
    }

    fn pose(&self, seconds: f64) -> Result<Scene> {
        match self.clip {
            Some(clip) => self.animated.pose(clip, seconds),
            None => self.animated.rest(),
        }
    }

    /// Fits what is added to the whole of the animation: the same for each frame, whichever frames are rendered.
    fn fit(&self) -> Result<Fixtures> {
        let options = self.options;
        let clip = self.clip.map(|clip| &self.animated.clips[clip]);
        let start = clip.map_or(0.0, |clip| clip.start());
        let mut scene = self.pose(start)?;
        options.expect_triangles(&scene)?;
        let is_fitted = options.add_floor.is_some() || options.add_light.contains(&LightSpec::Auto);
        let (mut bounds, mut lowest_world) = (scene.bounds(), None);
        if let Some(clip) = clip.filter(|_| is_fitted || scene.cameras.is_empty()) {
            let mut lowest = f64::INFINITY;
            for i in 0..FITTED_POSES {
                let share = f64::from(i) / f64::from(FITTED_POSES - 1);
                let pose = self.pose(start + share * (clip.end() - start))?;
                let offset = pose.origin_world - scene.origin_world;
                bounds = bounds.union(pose.bounds().transformed(&DAffine3::from_translation(offset)));
                lowest = lowest.min(lowest_point(&pose) + pose.origin_world.y);
            }
            lowest_world = Some(lowest);
        }
        let (camera, is_framed) = options.pick_camera(&scene, &bounds)?;
        let (lights, meshes) = (scene.lights.len(), scene.meshes.len());
        options.add(&mut scene, &camera, &bounds, lowest_world)?;
        let floor = scene.meshes.drain(meshes..).zip(scene.instances.pop()).next();
        Ok(Fixtures {
            origin_world: scene.origin_world,
            lights: scene.lights.split_off(lights),
            floor,
            camera: is_framed.then_some(camera),
        })
    }
}

/// Loads a scene by path or `procedural:` name.
pub fn load_scene(name: &str, options: LoadOptions) -> Result<Scene> {
    match file_of(name)? {
        Some(path) => gltf::load(path, options),
        None => procedural::load(name),
    }
}

/// Loads a scene with its animations by path or `procedural:` name.
pub fn load_animated(name: &str, options: LoadOptions) -> Result<Animated> {
    match file_of(name)? {
        Some(path) => gltf::load_animated(path, options),
        None => procedural::load_animated(name),
    }
}

/// The file of a scene; none: it is procedural.
fn file_of(name: &str) -> Result<Option<&Path>> {
    if name.starts_with("procedural:") {
        return Ok(None);
    }
    let path = Path::new(name);
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default().to_lowercase();
    match extension.as_str() {
        "gltf" | "glb" => Ok(Some(path)),
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

/// Reads the value of `--size`.
pub fn parse_size(text: &str) -> Result<[u32; 2], String> {
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
