//! What a user adds to a scene from outside: `--add-light` and `--add-floor`.

use std::f64::consts::PI;
use std::sync::Arc;

use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3};
use rayon::prelude::*;

use super::camera::{aimed, look_at};
use super::light::{AreaLight, Emission, Shape};
use super::{Bounds, Camera, Instance, MAX_COORDINATE, Mesh, Node, Scene};
use crate::closed_forms::{corner_form_factor, rect_form_factor};
use crate::{Error, Result};

/// The most that a light may emit in any unit. Images hold `f32`: a light of radiance L gives an irradiance of at most π·L,
/// which stays below `f32::MAX` = 3.4e38 for π·1e37, and so does the sum over ten such lights.
pub(super) const MAX_EMISSION: f64 = 1e37;

/// The longest light name, bytes: OpenEXR's channel names have at most 255, and to a light's name come the number that makes
/// it unique and the channel's suffix.
pub(super) const MAX_NAME_BYTES: usize = 255 - "#65536".len() - ".irradiance_ratio".len();

/// A sun's full angle, radians; 0 (directional) where the square of half of it, which its solid angle is a multiple of, is no
/// normal `f64`.
pub(super) fn resolved_angle(angle: f64) -> f64 {
    if (0.5 * angle).powi(2) < f64::MIN_POSITIVE { 0.0 } else { angle }
}

/// Help for `--add-light`.
pub const LIGHT_HELP: &str = "\
Add a light: SHAPE:key=value,… with lengths in scene units, vectors as X/Y/Z (world), sizes as WxH, angles in degrees.
  rect:at=0/3/0,to=0/0/0,size=1x0.5      emits towards `to`; default straight down, 1x1
  disk:at=0/3/0,to=0/0/0,size=1          diameter, or 1x0.5 for an ellipse; default straight down, 1
  sphere:at=0/3/0,radius=0.3             default radius 0.1
  tube:at=0/3/0,length=1,radius=0.05     along its local X, which `to` and `roll` turn; the defaults are shown
  sun:to=-1/-2/0,angle=0.53              direction of travel and full angle; default straight down, 0.53
  point:at=0/3/0
  auto                                   a rect key light fitted to the scene: above it to one side, or under the ceiling
                                         where the camera stands in a closed room
Any shape takes name= (default: the shape) and roll= (degrees, counter-clockwise about local +Z). Emission is a number or
R/G/B, default 1: radiance= in W/(m²·sr); a point takes intensity= in W/sr instead; a sun radiance=, or irradiance= in W/m²
at normal incidence.";

/// What `--add-light` asks for.
#[derive(Debug, Clone, PartialEq)]
pub enum LightSpec {
    /// `auto`: a rect key light fitted to the scene.
    Auto,
    /// A light with everything said.
    Given(GivenLight),
}

/// A light as `--add-light` describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct GivenLight {
    /// Name; `#2` is appended when it is taken.
    pub name: String,
    /// Its shape and size.
    pub shape: Shape,
    /// How much it emits.
    pub emission: Emission,
    /// Where it is, world space (the origin for a sun).
    pub at_world: DVec3,
    /// Its rotation: local −Z is the direction that `to` asks for.
    pub world_from_light: DMat3,
}

/// The keys of each shape beside `name` and `roll`.
const SHAPES: [(&str, &[&str]); 6] = [
    ("rect", &["at", "to", "size", "radiance"]),
    ("disk", &["at", "to", "size", "radiance"]),
    ("sphere", &["at", "to", "radius", "radiance"]),
    ("tube", &["at", "to", "length", "radius", "radiance"]),
    ("sun", &["at", "to", "angle", "radiance", "irradiance"]),
    ("point", &["at", "to", "intensity"]),
];

/// Keys that every shape takes.
const COMMON_KEYS: [&str; 2] = ["name", "roll"];

/// Reads the value of `--add-light`.
pub fn parse_light(spec: &str) -> Result<LightSpec> {
    if spec == "auto" {
        return Ok(LightSpec::Auto);
    }
    let (shape_name, pairs) = spec.split_once(':').unwrap_or((spec, ""));
    let Some((shape_name, keys)) = SHAPES.iter().find(|(name, _)| *name == shape_name) else {
        let names: Vec<&str> = SHAPES.iter().map(|(name, _)| *name).collect();
        return Err(Error::usage(
            "--add-light",
            format!("expected auto or one of the shapes {}, found {shape_name:?}", names.join(", ")),
        ));
    };
    let values = Values::parse(shape_name, keys, pairs)?;

    let to = values.vector("to")?;
    let (at_world, direction) = if *shape_name == "sun" {
        (DVec3::ZERO, to.unwrap_or(DVec3::NEG_Y))
    } else {
        let Some(at) = values.vector("at")? else {
            return Err(values.error("at", "a position is needed, such as at=0/3/0"));
        };
        (at, to.map_or(DVec3::NEG_Y, |to| to - at))
    };
    // Scaled before it is squared: a denormal or huge direction is still one.
    let Some(direction) = (direction / direction.abs().max_element()).try_normalize() else {
        let expected = if *shape_name == "sun" { "a direction other than 0/0/0" } else { "a point other than `at`" };
        return Err(values.error("to", expected));
    };
    let roll = values.number("roll", 0.0)?.to_radians();

    let shape = match *shape_name {
        "rect" => Shape::Rect { size: values.size()? },
        "disk" => Shape::Disk { size: values.size()? },
        "sphere" => Shape::Sphere { radius: values.positive("radius", 0.1)?, facing: false },
        "tube" => Shape::Tube { length: values.positive("length", 1.0)?, radius: values.positive("radius", 0.05)? },
        "sun" => {
            let angle = values.number("angle", 0.53)?;
            if !(0.0..180.0).contains(&angle) {
                return Err(values.error("angle", format!("expected degrees from 0 to below 180, found {angle}")));
            }
            Shape::Sun { angle: resolved_angle(angle.to_radians()) }
        }
        _ => Shape::Point,
    };
    Ok(LightSpec::Given(GivenLight {
        name: values.name()?,
        emission: values.emission(shape)?,
        shape,
        at_world,
        world_from_light: aimed(direction, DVec3::Y) * DMat3::from_rotation_z(roll),
    }))
}

/// Adds a light. `camera` (scene space) is the one that will be rendered: with [`LightSpec::Auto`] a camera that stands in
/// a closed room gets its light inside. Add lights before a floor: the automatic one is fitted to the bounds as they are.
pub fn add_light(scene: &mut Scene, spec: &LightSpec, camera: Option<&Camera>) -> Result<()> {
    let bounds = scene.bounds();
    add_light_within(scene, spec, camera, &bounds)
}

/// As [`add_light`], fitted to other bounds than the scene's: those of an animation, say.
pub fn add_light_within(scene: &mut Scene, spec: &LightSpec, camera: Option<&Camera>, bounds: &Bounds) -> Result<()> {
    let light = match spec {
        LightSpec::Given(given) => {
            let translation = if matches!(given.shape, Shape::Sun { .. }) {
                DVec3::ZERO
            } else {
                given.at_world - scene.origin_world
            };
            let scene_from_light = DAffine3 { matrix3: given.world_from_light, translation };
            AreaLight { emission: given.emission, ..AreaLight::new(given.name.clone(), scene_from_light, given.shape) }
        }
        LightSpec::Auto => {
            if bounds.size() == DVec3::ZERO {
                return Err(Error::usage(
                    "--add-light auto",
                    "the scene has no geometry of any size to fit a light to",
                ));
            }
            let in_room = camera.and_then(|camera| ceiling_light(scene, bounds, camera));
            in_room.unwrap_or_else(|| outside_light(bounds))
        }
    };
    scene.add_light(light);
    Ok(())
}

/// Puts a square receiver of two triangles under the scene, at `height_world` or at the lowest point of the geometry. Its
/// node is named `floor`, its side 20 times the horizontal diagonal of the bounds. The scene's origin stays where it is.
///
/// It widens [`Scene::bounds`]: whoever frames a camera or fits a light takes the bounds before.
pub fn add_floor(scene: &mut Scene, height_world: Option<f64>) -> Result<()> {
    let bounds = scene.bounds();
    add_floor_within(scene, height_world, &bounds)
}

/// As [`add_floor`], under other bounds than the scene's.
pub fn add_floor_within(scene: &mut Scene, height_world: Option<f64>, bounds: &Bounds) -> Result<()> {
    let size = bounds.size();
    if size == DVec3::ZERO {
        return Err(Error::usage("--add-floor", "the scene has no geometry of any size to put a floor under"));
    }
    let height = match height_world {
        Some(height) if height.is_finite() && height.abs() <= MAX_COORDINATE => height - scene.origin_world.y,
        Some(height) => return Err(Error::usage("--add-floor", format!("expected a finite height, found {height}"))),
        None => lowest_point(scene),
    };
    let diagonal = size.x.hypot(size.z);
    let half_side = (10.0 * if diagonal > 0.0 { diagonal } else { size.y }).min(MAX_COORDINATE);
    // The size is the instance's: in f64 it neither vanishes nor overflows.
    let corner = |x: f32, z: f32| Vec3::new(x, 0.0, z);

    scene.nodes.push(Node { name: "floor".into(), parent: None });
    scene.meshes.push(Mesh {
        name: "floor".into(),
        positions: Arc::new([corner(-1.0, 1.0), corner(1.0, 1.0), corner(1.0, -1.0), corner(-1.0, -1.0)]),
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..Mesh::default()
    });
    let center = bounds.center();
    scene.instances.push(Instance {
        mesh: scene.meshes.len() - 1,
        node: scene.nodes.len() - 1,
        scene_from_mesh: DAffine3 {
            matrix3: DMat3::from_diagonal(DVec3::splat(half_side)),
            translation: DVec3::new(center.x, height, center.z),
        },
    });
    Ok(())
}

/// The height of the lowest vertex that a triangle uses, scene space; exact, where bounds of turned instances are not.
pub fn lowest_point(scene: &Scene) -> f64 {
    let mut by_bound: Vec<(f64, &Instance)> =
        scene.instance_bounds().iter().map(|bounds| bounds.min.y).zip(&scene.instances).collect();
    by_bound.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut lowest = f64::INFINITY;
    for (bound, instance) in by_bound {
        if bound >= lowest {
            break;
        }
        let mesh = &scene.meshes[instance.mesh];
        let found = mesh
            .triangles
            .as_flattened()
            .par_iter()
            .map(|&index| instance.scene_from_mesh.transform_point3(mesh.positions[index as usize].as_dvec3()).y)
            .reduce(|| f64::INFINITY, f64::min);
        lowest = lowest.min(found);
    }
    lowest
}

/// A rect key light from the left, above and in front, outside the bounding sphere, at twice its radius. A white floor
/// through the middle of the bounds gets the irradiance π there: it looks like radiance 1.
fn outside_light(bounds: &Bounds) -> AreaLight {
    let center = bounds.center();
    let radius = 0.5 * bounds.size().length();
    let direction = DVec3::new(-0.6, 1.0, 0.45).normalize();
    let (distance, half) = (2.0 * radius, 0.3 * radius);
    // Level, so that its plane stays above all there is and no floor, however wide, lies behind it.
    let offset = direction * distance;
    let nearest = DVec2::new(offset.x, offset.z);
    let form_factor = rect_form_factor((nearest - half) / offset.y, (nearest + half) / offset.y);
    key_light(DAffine3 { matrix3: aimed(DVec3::NEG_Y, DVec3::Y), translation: center + offset }, half, form_factor)
}

/// A light under the ceiling for a camera that stands in a room: inside the bounds, with something above it and on most
/// sides. It hangs half-way to what the camera looks at, a twentieth of the room's height below what is above that point,
/// and is as large as a quarter of the height and half of the free way around it allow. The floor below it gets π.
fn ceiling_light(scene: &Scene, bounds: &Bounds, camera: &Camera) -> Option<AreaLight> {
    let eye = camera.scene_from_camera.translation;
    let inside = eye.cmpgt(bounds.min).all() && eye.cmplt(bounds.max).all();
    if !inside {
        return None;
    }
    let boxes = &scene.instance_bounds();
    let above_eye = first_hit(scene, boxes, eye, DVec3::Y)?;
    if walls(scene, boxes, eye).count() <= HORIZONTAL_DIRECTIONS as usize / 2 {
        return None;
    }
    let forward = -camera.scene_from_camera.matrix3.z_axis;
    let ahead = first_hit(scene, boxes, eye, forward).map(|distance| eye + 0.5 * distance * forward);
    let (center, above) = ahead
        .and_then(|center| first_hit(scene, boxes, center, DVec3::Y).map(|above| (center, above)))
        .unwrap_or((eye, above_eye));
    let below = first_hit(scene, boxes, center, DVec3::NEG_Y).unwrap_or(center.y - bounds.min.y);
    let room_height = above + below;
    let drop = (0.05 * room_height).min(0.5 * above);
    let at = center + DVec3::Y * (above - drop);

    let free = walls(scene, boxes, at).fold(room_height, f64::min);
    // A square's corner is √2 half sides away.
    let half = (0.125 * room_height).min(0.5 * free / 2f64.sqrt());
    let height = room_height - drop;
    let form_factor = 4.0 * corner_form_factor(half / height, half / height);
    (half > 0.0).then(|| key_light(look_at(at, at - DVec3::Y, DVec3::Y), half, form_factor))
}

/// Enough to notice a chair's leg beside a light; a few windows and doors are no matter.
const HORIZONTAL_DIRECTIONS: u32 = 16;

/// Distances to what stands around a point, at its height.
fn walls<'a>(scene: &'a Scene, boxes: &'a [Bounds], from: DVec3) -> impl Iterator<Item = f64> + 'a {
    (0..HORIZONTAL_DIRECTIONS).filter_map(move |i| {
        let angle = 2.0 * PI * f64::from(i) / f64::from(HORIZONTAL_DIRECTIONS);
        first_hit(scene, boxes, from, DVec3::new(angle.cos(), 0.0, angle.sin()))
    })
}

/// A square light named `Key` whose radiance gives the irradiance π through `form_factor`.
fn key_light(scene_from_light: DAffine3, half: f64, form_factor: f64) -> AreaLight {
    AreaLight {
        emission: Emission::Radiance(DVec3::splat(1.0 / form_factor)),
        ..AreaLight::new("Key", scene_from_light, Shape::Rect { size: DVec2::splat(2.0 * half) })
    }
}

/// The distance to the first triangle along a unit direction, by trying every triangle of the instances whose `boxes` are on
/// the way: a few such rays place a light, and no acceleration structure is there yet.
fn first_hit(scene: &Scene, boxes: &[Bounds], origin: DVec3, direction: DVec3) -> Option<f64> {
    let nearest = boxes
        .par_iter()
        .zip(&scene.instances)
        .filter(|(bounds, _)| meets(bounds, origin, direction))
        .map(|(_, instance)| {
            let mesh_from_scene = instance.scene_from_mesh.inverse();
            let origin_mesh = mesh_from_scene.transform_point3(origin);
            let direction_mesh = mesh_from_scene.transform_vector3(direction);
            let mesh = &scene.meshes[instance.mesh];
            (0..mesh.triangles.len())
                .into_par_iter()
                .filter_map(|triangle| triangle_hit(mesh.corners(triangle), origin_mesh, direction_mesh))
                .reduce(|| f64::INFINITY, f64::min)
        })
        .reduce(|| f64::INFINITY, f64::min);
    nearest.is_finite().then_some(nearest)
}

/// Whether a ray meets a box (Williams et al. 2005); a ray within a face may be missed or not.
fn meets(bounds: &Bounds, origin: DVec3, direction: DVec3) -> bool {
    let (a, b) = ((bounds.min - origin) / direction, (bounds.max - origin) / direction);
    let (enter, leave) = (a.min(b).max_element().max(0.0), a.max(b).min_element());
    // A NaN (0/0, within a face) must not lose the box.
    enter <= leave || enter.is_nan() || leave.is_nan()
}

/// Distance along a ray to a triangle, from either side (Möller and Trumbore 1997).
fn triangle_hit([a, b, c]: [DVec3; 3], origin: DVec3, direction: DVec3) -> Option<f64> {
    let (ab, ac, from) = (b - a, c - a, origin - a);
    let p = direction.cross(ac);
    let determinant = ab.dot(p);
    let q = from.cross(ab);
    let (u, v, t) = (from.dot(p) / determinant, direction.dot(q) / determinant, ac.dot(q) / determinant);
    // Comparisons fail on the NaN of a degenerate or parallel triangle.
    (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0).then_some(t)
}

/// The `key=value` pairs of one light.
struct Values<'a> {
    shape: &'a str,
    pairs: Vec<(&'a str, &'a str)>,
}

impl<'a> Values<'a> {
    fn parse(shape: &'a str, keys: &[&str], text: &'a str) -> Result<Self> {
        let mut values = Self { shape, pairs: Vec::new() };
        for pair in text.split(',').filter(|pair| !pair.is_empty()) {
            let Some((key, value)) = pair.split_once('=') else {
                return Err(values.error(pair, "expected key=value"));
            };
            if !keys.contains(&key) && !COMMON_KEYS.contains(&key) {
                let valid: Vec<&str> = keys.iter().chain(&COMMON_KEYS).copied().collect();
                return Err(values.error(key, format!("not a key of {shape}, which takes {}", valid.join(", "))));
            }
            if values.get(key).is_some() {
                return Err(values.error(key, "given twice"));
            }
            values.pairs.push((key, value));
        }
        Ok(values)
    }

    fn get(&self, key: &str) -> Option<&'a str> {
        self.pairs.iter().find(|(name, _)| *name == key).map(|(_, value)| *value)
    }

    fn error(&self, key: &str, message: impl Into<String>) -> Error {
        Error::usage(format!("--add-light {}: {key}", self.shape), message)
    }

    fn name(&self) -> Result<String> {
        match self.get("name") {
            Some("") => Err(self.error("name", "expected a name, found nothing")),
            Some(name) if name.chars().any(char::is_control) => {
                Err(self.error("name", format!("expected printable characters, found {name:?}")))
            }
            Some(name) if name.len() > MAX_NAME_BYTES => {
                Err(self.error("name", format!("expected at most {MAX_NAME_BYTES} bytes, found {}", name.len())))
            }
            name => Ok(name.unwrap_or(self.shape).to_owned()),
        }
    }

    fn number(&self, key: &str, default: f64) -> Result<f64> {
        let Some(text) = self.get(key) else { return Ok(default) };
        finite(text).ok_or_else(|| self.error(key, format!("expected a finite number, found {text:?}")))
    }

    fn positive(&self, key: &str, default: f64) -> Result<f64> {
        let value = self.number(key, default)?;
        if value > 0.0 { Ok(value) } else { Err(self.error(key, format!("expected more than 0, found {value}"))) }
    }

    fn vector(&self, key: &str) -> Result<Option<DVec3>> {
        let Some(text) = self.get(key) else { return Ok(None) };
        match parse_vector(text) {
            Some(vector) => Ok(Some(vector)),
            None => Err(self.error(key, format!("expected three finite numbers X/Y/Z, found {text:?}"))),
        }
    }

    /// `WxH`, or one number for both.
    fn size(&self) -> Result<DVec2> {
        let Some(text) = self.get("size") else { return Ok(DVec2::ONE) };
        let (width, height) = text.split_once('x').unwrap_or((text, text));
        match (finite(width), finite(height)) {
            (Some(width), Some(height)) if width > 0.0 && height > 0.0 => Ok(DVec2::new(width, height)),
            _ => Err(self.error("size", format!("expected WxH or one number, more than 0, found {text:?}"))),
        }
    }

    /// Whichever of the emission keys is given, in the unit that belongs to the shape.
    fn emission(&self, shape: Shape) -> Result<Emission> {
        let color = |key: &str| -> Result<Option<DVec3>> {
            let Some(text) = self.get(key) else { return Ok(None) };
            let emitted = |text: &str| text.parse().ok().filter(|value| (0.0..=MAX_EMISSION).contains(value));
            match emitted(text).map(DVec3::splat).or_else(|| three(text, emitted)) {
                Some(color) => Ok(Some(color)),
                None => {
                    let expected = format!("expected a number or R/G/B, not negative and at most {MAX_EMISSION:e}");
                    Err(self.error(key, format!("{expected}, found {text:?}")))
                }
            }
        };
        let radiance = color("radiance")?;
        Ok(match shape {
            Shape::Point => Emission::Intensity(color("intensity")?.unwrap_or(DVec3::ONE)),
            Shape::Sun { angle } => match (radiance, color("irradiance")?) {
                (Some(_), Some(_)) => return Err(self.error("irradiance", "give either this or radiance, not both")),
                (Some(_), None) if angle == 0.0 => {
                    return Err(self.error("radiance", "a sun of angle 0 has none; give irradiance"));
                }
                // A uniform cone of half angle θ around the normal: E = π·sin²θ·L.
                (Some(radiance), None) => Emission::Irradiance(PI * (0.5 * angle).sin().powi(2) * radiance),
                (None, irradiance) => Emission::Irradiance(irradiance.unwrap_or(DVec3::ONE)),
            },
            _ => Emission::Radiance(radiance.unwrap_or(DVec3::ONE)),
        })
    }
}

/// A number within the range of coordinates.
fn finite(text: &str) -> Option<f64> {
    text.parse().ok().filter(|value: &f64| value.abs() <= MAX_COORDINATE)
}

/// `X/Y/Z`, each finite.
pub(super) fn parse_vector(text: &str) -> Option<DVec3> {
    three(text, finite)
}

/// Three numbers between slashes.
fn three(text: &str, number: impl Fn(&str) -> Option<f64>) -> Option<DVec3> {
    let mut parts = text.split('/').map(number);
    let vector = DVec3::new(parts.next()??, parts.next()??, parts.next()??);
    parts.next().is_none().then_some(vector)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn given(spec: &str) -> GivenLight {
        match parse_light(spec).unwrap() {
            LightSpec::Given(light) => light,
            LightSpec::Auto => panic!("auto"),
        }
    }

    fn message(spec: &str) -> String {
        let message = parse_light(spec).unwrap_err().to_string();
        assert!(!message.contains('\n'), "{message}");
        message
    }

    /// A box between two corners, seen from outside or in (casters block from both sides).
    fn room(min: Vec3, max: Vec3) -> Scene {
        let corner = |i: usize| {
            Vec3::new(
                if i & 1 == 0 { min.x } else { max.x },
                if i & 2 == 0 { min.y } else { max.y },
                if i & 4 == 0 { min.z } else { max.z },
            )
        };
        let sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];
        let mut scene = Scene {
            nodes: vec![Node { name: "room".into(), parent: None }],
            meshes: vec![Mesh {
                positions: (0..8).map(corner).collect(),
                triangles: sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect(),
                ..Mesh::default()
            }],
            instances: vec![Instance { mesh: 0, node: 0, scene_from_mesh: DAffine3::IDENTITY }],
            ..Scene::default()
        };
        scene.rebase();
        scene
    }

    fn camera_at(scene: &Scene, eye_world: DVec3, target_world: DVec3) -> Camera {
        Camera {
            name: "camera".into(),
            scene_from_camera: look_at(eye_world - scene.origin_world, target_world - scene.origin_world, DVec3::Y),
            projection: crate::scene::Projection::Perspective { fov_y: 1.0 },
            near: 0.0,
            far: f64::INFINITY,
        }
    }

    #[test]
    fn examples_of_the_contract_parse() {
        let rect = given("rect:at=0/3/0,to=0/0/0,size=1x0.5");
        assert_eq!(rect.shape, Shape::Rect { size: DVec2::new(1.0, 0.5) });
        assert_eq!((rect.name.as_str(), rect.emission), ("rect", Emission::Radiance(DVec3::ONE)));
        assert_eq!(given("disk:at=0/3/0,size=1").shape, Shape::Disk { size: DVec2::ONE });
        assert_eq!(given("disk:at=0/3/0,size=1x0.5").shape, Shape::Disk { size: DVec2::new(1.0, 0.5) });
        assert_eq!(given("sphere:at=1/2/3,radius=0.3").shape, Shape::Sphere { radius: 0.3, facing: false });
        let tube = given("tube:at=1/2/3,to=0/0/0,length=1,radius=0.05");
        assert_eq!(tube.shape, Shape::Tube { length: 1.0, radius: 0.05 });
        let sun = given("sun:to=-1/-2/0,angle=0.53");
        assert_eq!(sun.shape, Shape::Sun { angle: 0.53f64.to_radians() });
        assert!((sun.world_from_light * DVec3::NEG_Z).distance(DVec3::new(-1.0, -2.0, 0.0).normalize()) < 1e-15);
        let point = given("point:at=-1e3/2/3,name=Lamp 1.a,intensity=1/2/3");
        assert_eq!(point.emission, Emission::Intensity(DVec3::new(1.0, 2.0, 3.0)));
        assert_eq!((point.name.as_str(), point.at_world), ("Lamp 1.a", DVec3::new(-1e3, 2.0, 3.0)));
        assert_eq!(parse_light("auto").unwrap(), LightSpec::Auto);
    }

    #[test]
    fn without_roll_local_y_is_world_y_or_away() {
        // Straight down: local +Y is world −Z.
        let down = given("rect:at=0/3/0");
        assert_eq!(down.world_from_light, DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y));
        let level = given("rect:at=0/3/0,to=0/3/-5");
        assert_eq!(level.world_from_light, DMat3::IDENTITY);
        // A quarter turn about its own axis: local X goes where local Y was.
        let rolled = given("rect:at=0/3/0,to=0/3/-5,roll=90");
        assert!((rolled.world_from_light * DVec3::X).distance(DVec3::Y) < 1e-15);
        assert!((rolled.world_from_light * DVec3::NEG_Z).distance(DVec3::NEG_Z) < 1e-15);
    }

    #[test]
    fn wrong_values_are_named_in_one_line() {
        for (spec, expected) in [
            ("cube:at=0/1/0", "rect, disk, sphere, tube, sun, point"),
            ("", "expected auto"),
            ("rect", "at: a position is needed"),
            ("rect:at=0/1", "at: expected three finite numbers X/Y/Z, found \"0/1\""),
            ("rect:at=0/1/2/3", "X/Y/Z"),
            ("rect:at=0/nan/0", "X/Y/Z"),
            ("rect:at=0/1e999/0", "X/Y/Z"),
            ("rect:at=0/1/0,to=0/1/0", "to: a point other than `at`"),
            ("sun:to=0/0/0", "to: a direction other than 0/0/0"),
            ("rect:at=0/1/0,size=0", "size: expected WxH"),
            ("rect:at=0/1/0,size=1x-1", "size: expected WxH"),
            ("rect:at=0/1/0,size=infx1", "size: expected WxH"),
            ("rect:at=0/1/0,radius=1", "not a key of rect, which takes at, to, size, radiance, name, roll"),
            ("rect:at=0/1/0,at=0/1/0", "at: given twice"),
            ("rect:at", "at: expected key=value"),
            ("rect:at=0/1/0,radiance=-1", "radiance: expected a number or R/G/B, not negative"),
            ("rect:at=0/1/0,roll=x", "roll: expected a finite number, found \"x\""),
            ("rect:at=0/1/0,name=", "name: expected a name"),
            ("sphere:at=0/1/0,radius=0", "radius: expected more than 0, found 0"),
            ("tube:at=0/1/0,length=-2", "length: expected more than 0, found -2"),
            ("sun:angle=180", "angle: expected degrees from 0 to below 180, found 180"),
            ("sun:angle=0,radiance=1", "radiance: a sun of angle 0 has none"),
            ("sun:irradiance=1,radiance=1", "not both"),
            ("point:at=0/1/0,radiance=1", "not a key of point, which takes at, to, intensity, name, roll"),
        ] {
            let message = message(spec);
            assert!(message.contains(expected), "{spec}: {message}");
        }
    }

    #[test]
    fn radiance_of_a_sun_becomes_its_irradiance() {
        let Emission::Irradiance(irradiance) = given("sun:angle=90,radiance=2").emission else { panic!() };
        assert!((irradiance.x - PI).abs() < 1e-15);
    }

    #[test]
    fn given_light_is_placed_in_the_world() {
        let mut scene = room(Vec3::new(100.0, 200.0, 300.0), Vec3::new(101.0, 202.0, 303.0));
        for _ in 0..2 {
            add_light(&mut scene, &parse_light("sphere:at=100.5/205/301,radius=0.5").unwrap(), None).unwrap();
        }
        assert_eq!(scene.lights[0].scene_from_light.translation, DVec3::new(0.5, 5.0, 1.0));
        assert_eq!((scene.lights[0].name.as_str(), scene.lights[1].name.as_str()), ("sphere", "sphere#2"));
    }

    #[test]
    fn automatic_light_stays_outside_and_exposes_a_white_floor_well() {
        for (min, max) in [
            (Vec3::splat(-1.0), Vec3::ONE),
            (Vec3::ZERO, Vec3::new(1e-3, 1e-5, 2e-3)),
            (Vec3::new(0.0, -1e6, 0.0), Vec3::new(1.0, 1e6, 1.0)),
        ] {
            let mut scene = room(min, max);
            add_light(&mut scene, &LightSpec::Auto, None).unwrap();
            let (light, bounds) = (&scene.lights[0], scene.bounds());
            assert_eq!(light.name, "Key");
            let Shape::Rect { size } = light.shape else { panic!() };
            let nearest = (light.scene_from_light.translation - bounds.center()).length();
            assert!(nearest > 0.5 * bounds.size().length() * 1.9 && size.x > 0.0);
            // Irradiance of the floor through the middle, by the light's polygon.
            let emitter = light.emitter(bounds.center()).unwrap();
            let corners =
                [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(u, v)| emitter.at(DVec2::new(u, v)));
            let form_factor = crate::closed_forms::lambert_form_factor(&corners, DVec3::Y);
            let Emission::Radiance(radiance) = light.emission else { panic!() };
            assert!((radiance.x * form_factor - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn camera_in_a_room_gets_its_light_under_the_ceiling() {
        let mut scene = room(Vec3::new(-4.0, 10.0, -3.0), Vec3::new(4.0, 13.0, 3.0));
        let camera = camera_at(&scene, DVec3::new(3.5, 11.5, 2.5), DVec3::new(0.0, 11.0, 0.0));
        add_light(&mut scene, &LightSpec::Auto, Some(&camera)).unwrap();
        let light = &scene.lights[0];
        let at = light.scene_from_light.translation + scene.origin_world;
        assert!((at.y - (13.0 - 0.15)).abs() < 1e-12 && at.x.abs() < 3.5 && at.z.abs() < 2.5, "{at}");
        assert!(light.axis().distance(DVec3::NEG_Y) < 1e-15);
        let Shape::Rect { size } = light.shape else { panic!() };
        assert!(size.x > 0.1 && size.x <= 0.75, "{size}");

        // From outside, or without a ceiling, the light is outside too.
        let outside = camera_at(&scene, DVec3::new(30.0, 11.5, 2.5), DVec3::ZERO);
        add_light(&mut scene, &LightSpec::Auto, Some(&outside)).unwrap();
        assert!(scene.lights[1].scene_from_light.translation.y > scene.bounds().max.y);
        scene.meshes[0].triangles.retain(|triangle| triangle.iter().any(|index| index & 2 == 0));
        add_light(&mut scene, &LightSpec::Auto, Some(&camera)).unwrap();
        assert!(scene.lights[2].scene_from_light.translation.y > scene.bounds().max.y);
    }

    #[test]
    fn floor_lies_under_the_lowest_vertex() {
        let mut scene = room(Vec3::new(-1.0, 5.0, -1.0), Vec3::new(1.0, 7.0, 1.0));
        // On its corner the box reaches √3 from its centre; so does its bounds' box, turned, farther.
        let turn = DMat3::from_quat(glam::DQuat::from_rotation_arc(DVec3::ONE.normalize(), DVec3::Y));
        scene.instances[0].scene_from_mesh = DAffine3 { matrix3: turn, translation: DVec3::ZERO };
        let expected = scene.meshes[0].positions.iter().map(|p| (turn * p.as_dvec3()).y).fold(f64::INFINITY, f64::min);
        add_floor(&mut scene, None).unwrap();
        let floor = scene.instances.last().unwrap();
        assert_eq!(floor.scene_from_mesh.translation.y, expected);
        assert_eq!(scene.nodes[floor.node].name, "floor");
    }

    #[test]
    fn floor_keeps_the_origin_and_its_height_far_away() {
        let mut scene = room(Vec3::new(1e6, 1e6, 1e6), Vec3::new(1e6 + 1.0, 1e6 + 1.0, 1e6 + 1.0));
        let origin = scene.origin_world;
        add_floor(&mut scene, Some(1e6 - 0.1)).unwrap();
        assert_eq!(scene.origin_world, origin);
        let floor = scene.instances.last().unwrap();
        assert!((floor.scene_from_mesh.translation.y + 0.1).abs() < 1e-9);
        let bounds = scene.bounds();
        let side = bounds.size().x;
        assert!((side / (20.0 * 2f64.sqrt()) - 1.0).abs() < 1e-6, "{side}");
        assert!(bounds.center().distance(DVec3::new(0.5, 0.45, 0.5)) < 1e-6);
    }

    #[test]
    fn floor_of_a_scene_of_any_size_is_the_same_but_for_its_scale() {
        let floor = |exponent: i32| {
            let mut scene = room(Vec3::ZERO, Vec3::new(1.0, 2.0, 0.5));
            let scale = 2f64.powi(exponent);
            scene.instances[0].scene_from_mesh.matrix3 *= scale;
            add_floor(&mut scene, None).unwrap();
            let floor = scene.instance_bounds()[1];
            (floor.min / scale, floor.max / scale)
        };
        assert!(floor(0).1.x > 10.0);
        for exponent in [-270, -133, -60, 50] {
            assert_eq!(floor(exponent), floor(0), "2^{exponent}");
        }
    }

    #[test]
    fn longest_name_leaves_room_for_number_and_channel() {
        let longest = "é".repeat(MAX_NAME_BYTES / 2);
        let name = given(&format!("point:at=0/1/0,name={longest}")).name;
        assert_eq!(name, longest);
        for suffix in crate::image::LIGHT_SUFFIXES {
            assert!(format!("{name}#65536{suffix}").len() <= 255);
        }
        let message = message(&format!("point:at=0/1/0,name={longest}é"));
        assert!(message.ends_with("name: expected at most 232 bytes, found 234"), "{message}");
    }

    #[test]
    fn emission_that_no_image_holds_is_refused() {
        let Emission::Radiance(radiance) = given("rect:at=0/1/0,radiance=1e37/0/1e20").emission else { panic!() };
        assert!(((PI * radiance.x) as f32).is_finite());
        for spec in [
            "rect:at=0/1/0,radiance=1.1e37",
            "point:at=0/1/0,intensity=0/1e300/0",
            "sun:irradiance=inf",
            "sun:radiance=1e38",
        ] {
            let message = message(spec);
            assert!(message.contains("not negative and at most 1e37, found"), "{message}");
        }
    }

    #[test]
    fn sun_whose_solid_angle_vanishes_is_directional() {
        for (degrees, directional) in [(1e-160, true), (1e-152, true), (1e-150, false), (1e-7, false)] {
            let Shape::Sun { angle } = given(&format!("sun:angle={degrees:e}")).shape else { panic!() };
            assert_eq!(angle == 0.0, directional, "{degrees:e}");
        }
    }

    #[test]
    fn nothing_fits_an_empty_scene() {
        let mut scene = Scene::default();
        assert!(add_light(&mut scene, &LightSpec::Auto, None).is_err());
        assert!(add_floor(&mut scene, None).is_err());
        let mut scene = room(Vec3::ZERO, Vec3::ONE);
        assert!(add_floor(&mut scene, Some(f64::NAN)).is_err());
        assert_eq!(scene.instances.len(), 1);
    }
}
