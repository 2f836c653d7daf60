//! `penumbra info`.

use std::fmt::Write;

use clap::Args;
use glam::DVec3;
use serde::Serialize;

use super::scene_options::load_animated;
use super::{print, print_json};
use crate::scene::animation::{Clip, Property};
use crate::scene::{AreaLight, Emission, LoadOptions, Projection, Scene, Shape};

/// Options of `info`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Scene: a .gltf or .glb file, or procedural:NAME[?key=value&...]
    #[arg(value_name = "SCENE")]
    scene: String,
    /// Prints JSON
    #[arg(long)]
    json: bool,
}

/// What a scene holds.
#[derive(Debug, Serialize)]
struct Info {
    path: String,
    triangles: u64,
    unique_triangles: u64,
    instances: usize,
    meshes: usize,
    materials: usize,
    cutouts: usize,
    bounds_world: Option<[DVec3; 2]>,
    lights: Vec<LightInfo>,
    cameras: Vec<CameraInfo>,
    animations: Vec<AnimationInfo>,
    warnings: Vec<String>,
}

#[derive(Debug, Serialize)]
struct LightInfo {
    name: String,
    shape: &'static str,
    /// Lengths in metres, angles in degrees.
    size: String,
    emission: String,
    position_world: DVec3,
    direction_world: DVec3,
    casts_shadow: bool,
    #[serde(skip_serializing_if = "Option::is_none")]
    spread_degrees: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cone_degrees: Option<[f64; 2]>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    light_exclude: Vec<String>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    shadow_exclude: Vec<String>,
}

#[derive(Debug, Serialize)]
struct CameraInfo {
    name: String,
    projection: String,
    position_world: DVec3,
}

#[derive(Debug, Serialize)]
struct AnimationInfo {
    name: String,
    /// Of the first key and the last.
    start_seconds: f64,
    end_seconds: f64,
    channels: Vec<ChannelInfo>,
}

#[derive(Debug, Serialize)]
struct ChannelInfo {
    node: String,
    property: Property,
    keys: usize,
}

/// Runs the command.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let animated = load_animated(&arguments.scene, LoadOptions::default())?;
    let info = describe(&animated.rest()?, &animated.clips);
    if arguments.json { print_json(&info) } else { print(&table(&info)) }
}

fn describe(scene: &Scene, clips: &[Clip]) -> Info {
    let bounds = scene.bounds();
    let position_world = |position: DVec3| position + scene.origin_world;
    Info {
        path: scene.name.clone(),
        triangles: scene.triangle_count(),
        unique_triangles: scene.meshes.iter().map(|mesh| mesh.triangles.len() as u64).sum(),
        instances: scene.instances.len(),
        meshes: scene.meshes.len(),
        materials: scene.materials.len(),
        cutouts: scene.materials.iter().filter(|material| material.cutout.is_some()).count(),
        bounds_world: (!bounds.is_empty()).then(|| [position_world(bounds.min), position_world(bounds.max)]),
        lights: scene.lights.iter().map(|light| describe_light(light, scene.origin_world)).collect(),
        cameras: scene
            .cameras
            .iter()
            .map(|camera| CameraInfo {
                name: camera.name.clone(),
                projection: match camera.projection {
                    Projection::Perspective { fov_y } => format!("perspective, {:.4}° high", fov_y.to_degrees()),
                    Projection::Orthographic { half_height } => format!("orthographic, {} m high", 2.0 * half_height),
                },
                position_world: position_world(camera.scene_from_camera.translation),
            })
            .collect(),
        animations: clips.iter().map(|clip| describe_clip(clip, scene)).collect(),
        warnings: scene.warnings.clone(),
    }
}

fn describe_clip(clip: &Clip, scene: &Scene) -> AnimationInfo {
    let channels = clip.channels.iter().map(|channel| ChannelInfo {
        node: scene.nodes[channel.node].name.clone(),
        property: channel.property,
        keys: channel.curve.times.len(),
    });
    let channels = channels.collect();
    AnimationInfo { name: clip.name.clone(), start_seconds: clip.start(), end_seconds: clip.end(), channels }
}

fn describe_light(light: &AreaLight, origin_world: DVec3) -> LightInfo {
    let size = match light.shape {
        Shape::Rect { size } | Shape::Disk { size } => format!("{} x {} m", size.x, size.y),
        Shape::Sphere { radius, facing } => format!("radius {radius} m{}", if facing { ", facing" } else { "" }),
        Shape::Tube { length, radius } => format!("length {length} m, radius {radius} m"),
        Shape::Sun { angle } => format!("{}°", angle.to_degrees()),
        Shape::Point => "-".into(),
    };
    let rgb = |x: DVec3| if x == DVec3::splat(x.x) { x.x.to_string() } else { format!("{}/{}/{}", x.x, x.y, x.z) };
    let emission = match light.emission {
        Emission::Radiance(x) => format!("{} W/(m²·sr)", rgb(x)),
        Emission::Intensity(x) => format!("{} W/sr", rgb(x)),
        Emission::Irradiance(x) => format!("{} W/m²", rgb(x)),
    };
    LightInfo {
        name: light.name.clone(),
        shape: light.shape.name(),
        size,
        emission,
        position_world: light.scene_from_light.translation + origin_world,
        direction_world: light.axis(),
        casts_shadow: light.casts_shadow,
        spread_degrees: (light.spread < std::f64::consts::PI).then(|| light.spread.to_degrees()),
        cone_degrees: light.cone.map(|cone| [cone.inner.to_degrees(), cone.outer.to_degrees()]),
        light_exclude: light.light_exclude.clone(),
        shadow_exclude: light.shadow_exclude.clone(),
    }
}

fn table(info: &Info) -> String {
    let mut text = String::new();
    let vector = |v: DVec3| format!("({:.6}, {:.6}, {:.6})", v.x, v.y, v.z);
    let mut line = |label: &str, value: String| {
        writeln!(text, "{label:<10} {value}").expect("a string takes all");
    };
    line("scene", info.path.clone());
    line(
        "triangles",
        format!(
            "{} in {} instances of {} meshes ({} stored)",
            info.triangles, info.instances, info.meshes, info.unique_triangles
        ),
    );
    line("materials", format!("{}, {} of them cut-outs", info.materials, info.cutouts));
    match info.bounds_world {
        Some([min, max]) => line("bounds", format!("{} to {} m", vector(min), vector(max))),
        None => line("bounds", "empty".into()),
    }
    for light in &info.lights {
        let LightInfo { name, shape, size, emission, .. } = light;
        let mut details = format!("{name}: {shape}, {size}, {emission}");
        if *shape != "sun" {
            write!(details, ", at {}", vector(light.position_world)).expect("a string takes all");
        }
        if *shape != "sphere" && *shape != "point" {
            write!(details, ", towards {}", vector(light.direction_world)).expect("a string takes all");
        }
        if let Some(spread) = light.spread_degrees {
            write!(details, ", spread {spread}°").expect("a string takes all");
        }
        if let Some([inner, outer]) = light.cone_degrees {
            write!(details, ", spot of {inner}° to {outer}° from its axis").expect("a string takes all");
        }
        if !light.casts_shadow {
            details.push_str(", casts no shadow");
        }
        for (names, what) in [(&light.light_exclude, "does not light"), (&light.shadow_exclude, "is not blocked by")] {
            if !names.is_empty() {
                write!(details, ", {what} {}", names.join(", ")).expect("a string takes all");
            }
        }
        line("light", details);
    }
    if info.lights.is_empty() {
        line("lights", "none; add one with --add-light".into());
    }
    for camera in &info.cameras {
        line("camera", format!("{}: {}, at {}", camera.name, camera.projection, vector(camera.position_world)));
    }
    for animation in &info.animations {
        let AnimationInfo { name, start_seconds, end_seconds, channels } = animation;
        let channels = if channels.len() == 1 { "1 channel".into() } else { format!("{} channels", channels.len()) };
        line("animation", format!("{name}: {start_seconds:.4} s to {end_seconds:.4} s, {channels}"));
    }
    for warning in &info.warnings {
        line("warning", warning.clone());
    }
    text
}
