//! Lights: `PENUMBRA_lights`, `EXT_lights_area`, `KHR_lights_punctual` and emissive rectangles.
//!
//! An emissive rectangle is a light where its material has `KHR_materials_emissive_strength`: without it, emission is a glow of
//! at most one nit that isn't meant to light anything. A two-sided one emits from the side that faces the scene's centre: the
//! other side is one more light to pay for, mostly of the wall behind it.
//!
//! A node has one light: the first of these that it has. A light on a node with an emissive mesh is that mesh's light, which
//! is then none of its own and never blocks it.

use std::cell::LazyCell;
use std::collections::{BTreeMap, HashSet};
use std::f64::consts::PI;

use glam::{DMat3, DVec2, DVec3};
use gltf::json::Root;
use gltf::json::extensions::scene::khr_lights_punctual as punctual;
use gltf::json::validation::Checked;
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::Value;

use super::document::{Parsed, extension, fault, item, one_line, quoted};
use super::hierarchy::{Hierarchy, direction};
use super::materials::Source;
use super::{Warnings, name_or};
use crate::scene::additions::{MAX_EMISSION, MAX_NAME_BYTES, resolved_angle};
use crate::scene::{AreaLight, Cone, Emission, Instance, MAX_COORDINATE, Mesh, Scene, Shape};

/// Each light is a layer of the image: a file with more of them is no scene.
const MAX_LIGHTS: usize = 1 << 16;

/// Lumens of a watt, as glTF exporters convert: nits = 683 · W/(m²·sr).
const LUMENS_PER_WATT: f64 = 683.0;

/// `EXT_lights_area` at the root.
#[derive(Deserialize)]
struct AreaLights {
    lights: Vec<ExtLight>,
}

/// A light of `EXT_lights_area`.
#[derive(Deserialize)]
struct ExtLight {
    name: Option<String>,
    #[serde(rename = "type")]
    kind: String,
    #[serde(default = "white")]
    color: [f64; 3],
    /// Nits.
    #[serde(default = "thousand")]
    intensity: f64,
    /// Height of a rect, diameter of a disk; in the node's units.
    #[serde(default = "one")]
    size: f64,
    rect: Option<ExtRect>,
}

/// What only a rect of `EXT_lights_area` has.
#[derive(Deserialize)]
struct ExtRect {
    /// Width over height.
    #[serde(default = "one")]
    aspect: f64,
}

/// `EXT_lights_area` at a node.
#[derive(Deserialize)]
struct ExtNode {
    light: u32,
}

fn white() -> [f64; 3] {
    [1.0; 3]
}

fn thousand() -> f64 {
    1000.0
}

fn one() -> f64 {
    1.0
}

fn yes() -> bool {
    true
}

/// `PENUMBRA_lights` at a node, version 1. Lengths in world metres, angles in radians.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PenumbraLight {
    #[serde(rename = "version")]
    _version: f64,
    shape: String,
    width: Option<f64>,
    height: Option<f64>,
    radius: Option<f64>,
    length: Option<f64>,
    angle: Option<f64>,
    radiance: Option<[f64; 3]>,
    intensity: Option<[f64; 3]>,
    irradiance: Option<[f64; 3]>,
    #[serde(default)]
    facing: bool,
    spread: Option<f64>,
    inner_cone: Option<f64>,
    outer_cone: Option<f64>,
    #[serde(default = "yes")]
    casts_shadow: bool,
    #[serde(default)]
    light_exclude: Vec<String>,
    #[serde(default)]
    shadow_exclude: Vec<String>,
    #[serde(rename = "extras")]
    _extras: Option<IgnoredAny>,
    #[serde(rename = "extensions")]
    _extensions: Option<IgnoredAny>,
}

/// The lights that nodes refer to by index.
struct Listed<'a> {
    area: Vec<ExtLight>,
    punctual: Vec<(&'a punctual::Light, Extra)>,
}

impl<'a> Listed<'a> {
    fn new(root: &'a Root) -> Parsed<Self> {
        let mut listed = Self { area: Vec::new(), punctual: Vec::new() };
        let Some(extensions) = &root.extensions else { return Ok(listed) };
        if let Some(value) = extensions.others.get("EXT_lights_area") {
            listed.area = extension::<AreaLights>(value, "extensions.EXT_lights_area")?.lights;
        }
        for (index, light) in extensions.khr_lights_punctual.iter().flat_map(|khr| &khr.lights).enumerate() {
            let place = format!("extensions.KHR_lights_punctual.lights[{index}].extras");
            listed.punctual.push((light, Extra::new(&light.extras, place)));
        }
        Ok(listed)
    }
}

/// Which two-sided rectangles emit from their back: by node and number of the rectangle there. Decided once, in the file's own
/// pose, lest a light turn over in the middle of an animation.
pub(super) type Sides = BTreeMap<(usize, usize), bool>;

/// The lights of the scene's nodes, in file order. `scene` has its nodes, meshes and instances, in world space.
pub(super) fn load(
    root: &Root,
    hierarchy: &Hierarchy,
    materials: &[Source],
    scene: &Scene,
    sides: &mut Sides,
    warnings: &mut Warnings,
) -> Parsed<Vec<AreaLight>> {
    let listed = Listed::new(root)?;
    let node_names: HashSet<&str> = scene.nodes.iter().map(|node| node.name.as_str()).collect();
    let center = LazyCell::new(|| scene.bounds().center());
    let mut lights = Vec::new();
    for &node in &hierarchy.shown {
        // Instances are in the order of their nodes.
        let first = scene.instances.partition_point(|instance| instance.node < node);
        let end = scene.instances.partition_point(|instance| instance.node <= node);
        let emissive = (first..end).filter_map(|instance| {
            let material = scene.meshes[scene.instances[instance].mesh].material?;
            Some((instance, &materials[material], materials[material].emission?))
        });
        if let Some(mut light) = explicit(root, hierarchy, &listed, node)? {
            light.own_instance = emissive.map(|(instance, ..)| instance).next();
            for name in light.light_exclude.iter().chain(&light.shadow_exclude) {
                if !node_names.contains(name.as_str()) {
                    warnings.add("a light's exclusion list names what no node is called", name);
                }
            }
            add(&mut lights, light, node)?;
            continue;
        }
        for (instance, source, nits) in emissive {
            let mesh = &scene.meshes[scene.instances[instance].mesh];
            if !source.emissive_strength {
                warnings.add("emissive but no light, for it has no KHR_materials_emissive_strength", &mesh.name);
                continue;
            }
            if source.emissive_texture {
                warnings.add("emissive but no light, for it has an emissive texture", &mesh.name);
                continue;
            }
            let Some((world_from_light, size)) = rectangle(mesh, &scene.instances[instance]) else {
                warnings.add("emissive but no light, for it isn't a flat rectangle of two triangles", &mesh.name);
                continue;
            };
            let name = one_line(&scene.nodes[node].name, 200);
            let mut light = AreaLight::new(name, world_from_light, Shape::Rect { size });
            if source.double_sided {
                warnings.add(
                    "emits from both sides, of which only the one towards the scene's centre is taken",
                    &light.name,
                );
                let faces_away = || light.axis().dot(*center - light.scene_from_light.translation) < 0.0;
                if *sides.entry((node, instance - first)).or_insert_with(faces_away) {
                    let turned = DMat3::from_diagonal(DVec3::new(-1.0, 1.0, -1.0));
                    light.scene_from_light.matrix3 *= turned;
                }
            }
            light.emission = Emission::Radiance(nits.as_dvec3() / LUMENS_PER_WATT);
            light.own_instance = Some(instance);
            add(&mut lights, light, node)?;
        }
    }
    Ok(lights)
}

fn add(lights: &mut Vec<AreaLight>, mut light: AreaLight, node: usize) -> Parsed<()> {
    if lights.len() == MAX_LIGHTS {
        return Err(fault(format!("nodes[{node}]"), format!("{MAX_LIGHTS} lights come before it, which is the most")));
    }
    light.name.truncate(light.name.floor_char_boundary(MAX_NAME_BYTES));
    lights.push(light);
    Ok(())
}

/// The light that a node's extensions describe.
fn explicit(root: &Root, hierarchy: &Hierarchy, listed: &Listed, node: usize) -> Parsed<Option<AreaLight>> {
    let json = &root.nodes[node];
    let Some(extensions) = &json.extensions else { return Ok(None) };
    let place = |name: &str| format!("nodes[{node}].extensions.{name}");
    let ext = match extensions.others.get("EXT_lights_area") {
        Some(value) => {
            let index = extension::<ExtNode>(value, &place("EXT_lights_area"))?.light as usize;
            let light =
                item(&listed.area, "extensions.EXT_lights_area.lights", index, || place("EXT_lights_area.light"))?;
            Some((index, light))
        }
        None => None,
    };
    let khr = match &extensions.khr_lights_punctual {
        Some(khr) => {
            let index = khr.light.value();
            let place = || place("KHR_lights_punctual.light");
            Some((index, item(&listed.punctual, "extensions.KHR_lights_punctual.lights", index, place)?))
        }
        None => None,
    };
    let names =
        [ext.and_then(|(_, light)| light.name.as_deref()), khr.and_then(|(_, (light, _))| light.name.as_deref())];
    let light_name = names.into_iter().flatten().find(|name| !name.is_empty());

    let mut light = if let Some(value) = extensions.others.get("PENUMBRA_lights") {
        penumbra(value, &place("PENUMBRA_lights"))?
    } else if let Some((index, light)) = ext {
        let linear = hierarchy.world(node)?.matrix3;
        let scale = [linear.x_axis, linear.y_axis, linear.z_axis].map(DVec3::length).into_iter().fold(0.0, f64::max);
        area(light, scale, &format!("extensions.EXT_lights_area.lights[{index}]"))?
    } else if let Some((index, (light, of_light))) = khr {
        let of_node = Extra::new(&json.extras, format!("nodes[{node}].extras"));
        punctual(light, [&of_node, of_light], &format!("extensions.KHR_lights_punctual.lights[{index}]"))?
    } else {
        return Ok(None);
    };
    // Names become layer names of images.
    light.name = name_or(light_name.or(json.name.as_deref()), "node", node);
    light.scene_from_light = hierarchy.rigid(node)?;
    Ok(Some(light))
}

/// A light of unit emission at the origin.
fn unplaced(shape: Shape) -> AreaLight {
    AreaLight::new("", glam::DAffine3::IDENTITY, shape)
}

fn area(json: &ExtLight, scale: f64, place: &str) -> Parsed<AreaLight> {
    let size = length(Some(json.size), &format!("{place}.size"))?;
    let size = length(Some(size * scale), &format!("{place}.size (times the node's scale)"))?;
    let mut light = unplaced(match json.kind.as_str() {
        "rect" => {
            let aspect = json.rect.as_ref().map_or(1.0, |rect| rect.aspect);
            let width = length(Some(size * aspect), &format!("{place}.rect.aspect"))?;
            Shape::Rect { size: DVec2::new(width, size) }
        }
        "disk" => Shape::Disk { size: DVec2::splat(size) },
        other => return Err(fault(format!("{place}.type"), format!("expected rect or disk, found {}", quoted(other)))),
    });
    let nits = color(Some(json.color.map(|c| c * json.intensity)), &format!("{place}.color, intensity"))?;
    light.emission = Emission::Radiance(nits / LUMENS_PER_WATT);
    Ok(light)
}

/// The numbers `radius` and `angle` of an object's extras, and where they are.
struct Extra {
    radius: Option<f64>,
    angle: Option<f64>,
    place: String,
}

impl Extra {
    fn new(extras: &gltf::json::Extras, place: String) -> Self {
        // Extras may be any JSON: what isn't ours is passed over.
        let value: Value = extras.as_ref().and_then(|e| serde_json::from_str(e.get()).ok()).unwrap_or_default();
        let number = |name: &str| value.get(name).and_then(Value::as_f64);
        Self { radius: number("radius"), angle: number("angle"), place }
    }
}

fn punctual(json: &punctual::Light, extras: [&Extra; 2], place: &str) -> Parsed<AreaLight> {
    let watts = f64::from(json.intensity) / LUMENS_PER_WATT;
    let emitted = color(Some(json.color.map(|c| f64::from(c) * watts)), &format!("{place}.color, intensity"))?;
    let radius = || {
        let extra = extras.iter().find(|extra| extra.radius.is_some());
        extra.map_or(Ok(0.0), |extra| length_or_zero(extra.radius, &format!("{}.radius", extra.place)))
    };
    match json.type_ {
        Checked::Valid(punctual::Type::Point) => round(radius()?, emitted, place),
        Checked::Valid(punctual::Type::Spot) => {
            let Some(spot) = &json.spot else { return Err(fault(format!("{place}.spot"), "missing")) };
            let mut light = round(radius()?, emitted, place)?;
            let (inner, outer) = (f64::from(spot.inner_cone_angle), f64::from(spot.outer_cone_angle));
            light.cone = Some(cone(inner, outer, &format!("{place}.spot"))?);
            Ok(light)
        }
        Checked::Valid(punctual::Type::Directional) => {
            let extra = extras.iter().find(|extra| extra.angle.is_some());
            let angle = extra.map_or(Ok(0.0), |extra| sun_angle(extra.angle, &format!("{}.angle", extra.place)))?;
            let mut light = unplaced(Shape::Sun { angle });
            light.emission = Emission::Irradiance(emitted);
            Ok(light)
        }
        Checked::Invalid => Err(fault(format!("{place}.type"), "expected point, spot or directional")),
    }
}

/// A sphere, or a point when it has no radius, of the given intensity, W/sr: a sphere shows everyone the disc π r².
fn round(radius: f64, intensity: DVec3, place: &str) -> Parsed<AreaLight> {
    if radius == 0.0 {
        let mut light = unplaced(Shape::Point);
        light.emission = Emission::Intensity(intensity);
        return Ok(light);
    }
    let radiance = intensity / (PI * radius * radius);
    if radiance.max_element() > MAX_EMISSION {
        return Err(fault(place, format!("a radius of {radius} is too small for its intensity")));
    }
    let mut light = unplaced(Shape::Sphere { radius, facing: false });
    light.emission = Emission::Radiance(radiance);
    Ok(light)
}

fn penumbra(value: &Value, place: &str) -> Parsed<AreaLight> {
    if let Some(version) = value.get("version").filter(|version| version.as_f64() != Some(1.0)) {
        return Err(fault(format!("{place}.version"), format!("expected 1, found {version}")));
    }
    let json: PenumbraLight = extension(value, place)?;
    let at = |member: &str| format!("{place}.{member}");
    let length_of = |value, member: &str| length(value, &at(member));
    let radiance = || Ok(Emission::Radiance(color(json.radiance, &at("radiance"))?));
    let mut light = match json.shape.as_str() {
        "rect" => {
            let size = DVec2::new(length_of(json.width, "width")?, length_of(json.height, "height")?);
            AreaLight { emission: radiance()?, ..unplaced(Shape::Rect { size }) }
        }
        "disk" => {
            let width = length_of(json.width, "width")?;
            let size = DVec2::new(width, length_of(json.height.or(json.width), "height")?);
            AreaLight { emission: radiance()?, ..unplaced(Shape::Disk { size }) }
        }
        "tube" => {
            let (length, radius) = (length_of(json.length, "length")?, length_of(json.radius, "radius")?);
            AreaLight { emission: radiance()?, ..unplaced(Shape::Tube { length, radius }) }
        }
        "sun" => {
            let angle = sun_angle(json.angle.or(Some(0.0)), &at("angle"))?;
            let emission = Emission::Irradiance(color(json.irradiance, &at("irradiance"))?);
            AreaLight { emission, ..unplaced(Shape::Sun { angle }) }
        }
        "sphere" | "point" | "spot" => match (json.radiance, json.intensity) {
            (Some(_), None) if json.shape != "point" => {
                let radius = length_of(json.radius, "radius")?;
                AreaLight { emission: radiance()?, ..unplaced(Shape::Sphere { radius, facing: false }) }
            }
            (_, intensity) => {
                let radius = if json.shape == "sphere" { json.radius } else { json.radius.or(Some(0.0)) };
                round(length_or_zero(radius, &at("radius"))?, color(intensity, &at("intensity"))?, place)?
            }
        },
        other => {
            let message = format!("expected rect, disk, sphere, tube, sun, point or spot, found {}", quoted(other));
            return Err(fault(at("shape"), message));
        }
    };
    if let Shape::Sphere { facing, .. } = &mut light.shape {
        *facing = json.facing;
    }
    if json.shape == "spot" {
        let outer = json.outer_cone.ok_or_else(|| fault(at("outer_cone"), "missing"))?;
        light.cone = Some(cone(json.inner_cone.unwrap_or(0.0), outer, place)?);
    }
    light.spread = json.spread.unwrap_or(PI);
    if !(light.spread > 0.0 && light.spread <= PI) {
        return Err(fault(at("spread"), format!("expected more than 0 and at most π, found {}", light.spread)));
    }
    light.casts_shadow = json.casts_shadow;
    light.light_exclude = json.light_exclude;
    light.shadow_exclude = json.shadow_exclude;
    Ok(light)
}

/// A length whose square neither vanishes nor overflows.
fn length(value: Option<f64>, place: &str) -> Parsed<f64> {
    match value {
        Some(length) if length * length > 0.0 && (0.0..=MAX_COORDINATE).contains(&length) => Ok(length),
        Some(length) => Err(fault(
            place,
            format!("the light has no area: expected a positive length up to {MAX_COORDINATE:e}, found {length}"),
        )),
        None => Err(fault(place, "missing")),
    }
}

fn length_or_zero(value: Option<f64>, place: &str) -> Parsed<f64> {
    if value == Some(0.0) { Ok(0.0) } else { length(value, place) }
}

fn sun_angle(value: Option<f64>, place: &str) -> Parsed<f64> {
    match value {
        Some(angle) if (0.0..PI).contains(&angle) => Ok(resolved_angle(angle)),
        Some(angle) => Err(fault(place, format!("expected at least 0 and less than π, found {angle}"))),
        None => Err(fault(place, "missing")),
    }
}

fn color(value: Option<[f64; 3]>, place: &str) -> Parsed<DVec3> {
    match value.map(DVec3::from) {
        Some(color) if color.is_finite() && color.min_element() >= 0.0 => {
            let most = color.max_element();
            if most > MAX_EMISSION {
                return Err(fault(place, format!("expected at most {MAX_EMISSION:e}, found {most:e}")));
            }
            Ok(color)
        }
        Some(color) => {
            let [r, g, b] = color.to_array();
            Err(fault(place, format!("expected finite numbers of at least 0, found {r}, {g}, {b}")))
        }
        None => Err(fault(place, "missing")),
    }
}

fn cone(inner: f64, outer: f64, place: &str) -> Parsed<Cone> {
    if 0.0 <= inner && inner <= outer && 0.0 < outer && outer <= 0.5 * PI {
        return Ok(Cone { inner, outer });
    }
    Err(fault(
        place,
        format!("expected cone angles with 0 <= inner <= outer <= π/2 and outer > 0, found {inner} and {outer}"),
    ))
}

/// The frame and full size of a mesh that is a flat rectangle of two triangles, as an instance shows it; its front is −Z.
fn rectangle(mesh: &Mesh, instance: &Instance) -> Option<(glam::DAffine3, DVec2)> {
    let [first, second] = &mesh.triangles[..] else { return None };
    let corners = |triangle: &[u32; 3]| triangle.map(|index| mesh.positions[index as usize].as_dvec3());
    let (first, second) = (corners(first), corners(second));
    // The corner that only one of the triangles has; its neighbours are the diagonal.
    let alone = |of: &[DVec3; 3], other: &[DVec3; 3]| {
        let mut alone = (0..3).filter(|&i| !other.contains(&of[i]));
        alone.next().filter(|_| alone.next().is_none())
    };
    let (at, other_at) = (alone(&first, &second)?, alone(&second, &first)?);
    // Counter-clockwise from the first triangle's own corner; the second one runs along the diagonal the other way.
    let quad = [first[at], first[(at + 1) % 3], second[other_at], first[(at + 2) % 3]];
    if second[(other_at + 2) % 3] != quad[1] {
        return None;
    }
    let quad = quad.map(|corner| instance.scene_from_mesh.transform_point3(corner));
    let center = 0.25 * (quad[0] + quad[1] + quad[2] + quad[3]);
    let (across, up) = (0.5 * (quad[1] - quad[0] + quad[2] - quad[3]), 0.5 * (quad[3] - quad[0] + quad[2] - quad[1]));
    let (width, height) = (across.length(), up.length());
    // A file's f32 corners are off by half a unit in the last place of the largest coordinate, before and after a transform
    // that an exporter applied; beyond that a ten-thousandth of the size, which no shadow shows.
    let largest = first.iter().chain(&second).fold(0.0f64, |most, p| p.abs().max_element().max(most));
    let linear = instance.scene_from_mesh.matrix3;
    let stretch = [linear.x_axis, linear.y_axis, linear.z_axis].map(DVec3::length).into_iter().fold(0.0, f64::max);
    let tolerance = 1e-4 * width.min(height) + 4.0 * f64::from(f32::EPSILON) * largest * stretch;
    let off_parallelogram = (quad[0] + quad[2] - quad[1] - quad[3]).length();
    let off_square = direction(across).dot(direction(up)).abs() * width.min(height);
    if !(width * height > 0.0 && off_parallelogram <= tolerance && off_square <= tolerance) {
        return None;
    }
    // A mirroring transform turns the winding, not the front (glTF 2.0, 3.7.4).
    let mirror = instance.scene_from_mesh.matrix3.determinant().signum();
    let front = mirror * direction(direction(across).cross(direction(up)));
    let (y, z) = (direction(up), -front);
    let x = direction(y.cross(z));
    let matrix3 = DMat3::from_cols(x, z.cross(x), z);
    Some((glam::DAffine3 { matrix3, translation: center }, DVec2::new(width, height)))
}
