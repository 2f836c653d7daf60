//! Scenes made by code: those with a closed form ([`crate::closed_forms`]), a few for hard cases, and the demo.
//!
//! A scene is asked for as `procedural:NAME?key=value&key=value`. Lights hang above the receiver and face down; the receiver
//! is the plane y = 0 but for a tilted one. Where an answer is known, [`Procedural::truth`] gives it at any world position of
//! the receiver, worked out from the `f32` vertices that the scene really holds. Most scenes stand still; [`load_animated`]
//! gives the one that moves at any time.

mod demo;
mod motion;
mod moving;
mod shapes;

use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};
use std::fmt;

use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3};

pub(super) use self::motion::Moving;
use self::motion::{Mover, Part, Placement};
use self::shapes::Surface;
use super::additions::parse_vector;
use super::animation::{Animated, Clip};
use super::camera::{Camera, Projection, look_at};
use super::light::{AreaLight, Domain, Emission, Emitter, Shape};
use super::{Instance, Material, Mesh, Node, Scene};
use crate::closed_forms::{
    clip_polygon, disk_edge_fraction, lambert_form_factor, polygon_area, polygon_in_unit_disc_area, rect_edge_fraction,
};
use crate::{Error, Result};

/// A procedural scene with what is known about it.
#[derive(Debug, Clone)]
pub struct Procedural {
    /// The scene, rebased.
    pub scene: Scene,
    /// The exact answer, where there is a closed form.
    pub truth: Option<Truth>,
}

/// One kind of procedural scene.
#[derive(Debug)]
pub struct Entry {
    /// Name after `procedural:`.
    pub name: &'static str,
    /// What it shows, in one line.
    pub about: &'static str,
    /// Its parameters beside [`COMMON_PARAMETERS`].
    pub parameters: &'static [Parameter],
    build: fn(&Values) -> Result<Draft>,
}

/// One parameter of a scene.
#[derive(Debug, Clone, Copy)]
pub struct Parameter {
    /// Key.
    pub name: &'static str,
    /// Type, default and range.
    pub kind: Kind,
    /// What it is, with its unit.
    pub meaning: &'static str,
}

/// Type, default and range of a parameter. Numbers may be written as `2^k`.
#[derive(Debug, Clone, Copy)]
pub enum Kind {
    /// From [`LEAST`] to [`MOST`].
    Positive(f64),
    /// At most [`MOST`] in magnitude.
    Number(f64),
    /// A whole number between two, inclusive.
    Count {
        /// Taken when it is not given.
        default: u32,
        /// Lowest allowed.
        min: u32,
        /// Highest allowed.
        max: u32,
    },
    /// `X/Y/Z`, each at most 2²⁴ in magnitude (beyond it vertices of `f32` are more than a metre apart); default zero.
    Vector,
    /// From 2⁻³⁰ to 2³⁰; default 1.
    Scale,
    /// One of several words, the first by default.
    Choice(&'static [&'static str]),
}

/// The largest number that a parameter takes: sizes made from it stay far inside the range of `f32`.
pub const MOST: f64 = 1e6;

/// The smallest positive number that a parameter takes: its square is still far inside the range of `f64`.
pub const LEAST: f64 = 1e-30;

const MOST_SHIFT: f64 = 16_777_216.0;
const MOST_SCALE: f64 = 1_073_741_824.0;

const fn parameter(name: &'static str, kind: Kind, meaning: &'static str) -> Parameter {
    Parameter { name, kind, meaning }
}

const LIGHT: Parameter = parameter("light", Kind::Positive(1.0), "half the side or the radius of the light, m");
const HEIGHT: Parameter = parameter("height", Kind::Positive(5.0), "height of the light, m");
const LIFT: Parameter = parameter("lift", Kind::Positive(2.0), "height of the occluder, m; less than the light's");
const VIEW: Parameter = parameter("view", Kind::Positive(2.0), "half the height of the camera's view, m");
const ANGLE: Parameter = parameter("angle", Kind::Number(0.0), "turn of the occluder about +Y, degrees");
const SHAPE: Parameter = parameter(
    "shape",
    Kind::Choice(&["rect", "disk", "sphere", "tube", "sun", "point"]),
    "shape of the light; a tube is 2·light long with the radius light/8, a sun subtends what the disk does from below",
);
const DISK_SHAPE: Parameter =
    Parameter { kind: Kind::Choice(&["disk", "rect", "sphere", "tube", "sun", "point"]), ..SHAPE };

/// What every scene takes.
pub const COMMON_PARAMETERS: [Parameter; 2] = [
    parameter(
        "shift",
        Kind::Vector,
        "moves all of the scene in the world, m; vertices are rounded to f32 where they land",
    ),
    parameter("scale", Kind::Scale, "multiplies every length; a power of two changes no digit"),
];

/// All procedural scenes.
pub const ENTRIES: &[Entry] = &[
    Entry {
        name: "demo",
        about: "the default scene: a slatted screen, a sphere on a plinth, a wheel, a ring, blocks and a plant",
        parameters: &[parameter("light", Kind::Positive(0.7), "side of the key light, m; at most 4")],
        build: demo::build,
    },
    Entry {
        name: "square",
        about: "C1, C6: a square occluder parallel to the light",
        parameters: &[
            LIGHT,
            HEIGHT,
            LIFT,
            parameter("occluder", Kind::Positive(0.5), "half the side of the occluder, m"),
            parameter("x", Kind::Number(0.1), "centre of the occluder along X, m"),
            parameter("z", Kind::Number(-0.2), "centre of the occluder along Z, m"),
            SHAPE,
            VIEW,
        ],
        build: square,
    },
    Entry {
        name: "edge",
        about: "C2, C3, C4: a half-plane; at angle 0 it occupies all below x",
        parameters: &[
            LIGHT,
            HEIGHT,
            LIFT,
            parameter("x", Kind::Number(0.0), "where the edge crosses the X axis, m"),
            ANGLE,
            SHAPE,
            VIEW,
        ],
        build: edge,
    },
    Entry {
        name: "disks",
        about: "C5: a regular polygon that stands for a disc, under a disk light",
        parameters: &[
            LIGHT,
            HEIGHT,
            LIFT,
            parameter("radius", Kind::Positive(0.5), "radius of the occluder's corners, m"),
            parameter("segments", Kind::Count { default: 256, min: 3, max: 4096 }, "corners of the occluder"),
            parameter("x", Kind::Number(0.0), "centre of the occluder along X, m"),
            parameter("z", Kind::Number(0.0), "centre of the occluder along Z, m"),
            DISK_SHAPE,
            VIEW,
        ],
        build: disks,
    },
    Entry {
        name: "strip",
        about: "C7: a strip as long as the view and longer",
        parameters: &[
            LIGHT,
            HEIGHT,
            LIFT,
            parameter("width", Kind::Positive(0.01), "width of the strip, m"),
            parameter("x", Kind::Number(0.0), "where the middle of the strip crosses the X axis, m"),
            ANGLE,
            SHAPE,
            VIEW,
        ],
        build: strip,
    },
    Entry {
        name: "corner",
        about: "C8, C9: a light with one corner straight above the origin, for irradiance",
        parameters: &[
            LIGHT,
            HEIGHT,
            LIFT,
            parameter("occluder", Kind::Number(0.0), "half the side of a square occluder, m; 0 for none"),
            parameter("x", Kind::Number(0.5), "centre of the occluder along X, m"),
            parameter("z", Kind::Number(0.5), "centre of the occluder along Z, m"),
            SHAPE,
            VIEW,
        ],
        build: corner,
    },
    Entry {
        name: "two-edges",
        about: "two half-planes at different heights, whose shadows overlap: blocked parts must be united, not multiplied",
        parameters: &[
            LIGHT,
            HEIGHT,
            parameter("lift", Kind::Positive(1.0), "height of the lower half-plane, m"),
            parameter("x", Kind::Number(0.0), "edge of the lower half-plane, m"),
            parameter("lift2", Kind::Positive(3.0), "height of the upper half-plane, m"),
            parameter("x2", Kind::Number(0.2), "edge of the upper half-plane, m"),
            ANGLE,
            SHAPE,
            VIEW,
        ],
        build: two_edges,
    },
    Entry {
        name: "wall",
        about: "a wall beside a wide light, or through it: from either side only the part of the light on that side is seen",
        parameters: &[
            parameter("light", Kind::Positive(2.0), LIGHT.meaning),
            parameter("height", Kind::Positive(1.0), HEIGHT.meaning),
            parameter("x", Kind::Number(2.1), "where the wall stands along X, m"),
            SHAPE,
            parameter("view", Kind::Positive(4.0), VIEW.meaning),
        ],
        build: wall,
    },
    Entry {
        name: "wire",
        about: "a thin wire far above the receiver, close to the light",
        parameters: &[
            parameter("light", Kind::Positive(0.1), LIGHT.meaning),
            HEIGHT,
            parameter("lift", Kind::Positive(4.0), LIFT.meaning),
            parameter("diameter", Kind::Positive(0.002), "thickness of the wire, m"),
            SHAPE,
            VIEW,
        ],
        build: wire,
    },
    Entry {
        name: "contact",
        about: "a box that stands on the floor",
        parameters: &[
            parameter("light", Kind::Positive(0.5), LIGHT.meaning),
            parameter("height", Kind::Positive(4.0), HEIGHT.meaning),
            parameter("gap", Kind::Number(0.0), "way between box and floor, m; not negative"),
            SHAPE,
        ],
        build: contact,
    },
    Entry {
        name: "sphere",
        about: "a tessellated sphere with smooth normals over the floor",
        parameters: &[
            parameter("light", Kind::Positive(0.5), LIGHT.meaning),
            HEIGHT,
            parameter("lift", Kind::Positive(1.0), "height of the sphere's centre, m"),
            parameter("radius", Kind::Positive(0.5), "radius of the sphere, m; at most its lift"),
            parameter("subdivisions", Kind::Count { default: 4, min: 0, max: 8 }, "n, for 20·4^n triangles"),
            SHAPE,
        ],
        build: sphere,
    },
    Entry {
        name: "instances",
        about: "a square of instances of one mesh, turned and stretched",
        parameters: &[
            parameter("count", Kind::Count { default: 8, min: 1, max: 1000 }, "instances along either side"),
            parameter("subdivisions", Kind::Count { default: 3, min: 0, max: 8 }, "n, for 20·4^n triangles"),
            SHAPE,
        ],
        build: instances,
    },
    Entry {
        name: "tilt",
        about: "a half-plane over a receiver that tilts down from below its edge: the penumbra grows with the angle",
        parameters: &[
            parameter("light", Kind::Positive(0.25), LIGHT.meaning),
            HEIGHT,
            LIFT,
            parameter("angle", Kind::Number(0.0), "tilt of the receiver, degrees; 0 to 80"),
            parameter("distance", Kind::Positive(1.0), "from the camera to the penumbra's middle, in units of 4 m"),
            SHAPE,
        ],
        build: tilt,
    },
    Entry {
        name: "moving",
        about: "a room whose parts move, one by one or together, on a loop of 2 s (--frames 0-47)",
        parameters: &[
            parameter("camera", switch(1), "whether the camera walks"),
            parameter("light", switch(0), "whether the light slides"),
            parameter("caster", switch(0), "whether the hoop flies"),
            parameter("receiver", switch(0), "whether the board slides and turns"),
            parameter("light_size", Kind::Positive(0.8), "width of the light, m; at most 2"),
            parameter("aspect", Kind::Positive(1.0), "width of the light over its height; a large one makes it a line"),
            parameter("speed", Kind::Positive(1.0), "the loop takes 2 s over this"),
        ],
        build: moving::build,
    },
];

/// 0 or 1.
const fn switch(default: u32) -> Kind {
    Kind::Count { default, min: 0, max: 1 }
}

/// Makes the scene that `spec` (`NAME?key=value&key=value`, with or without `procedural:` before it) asks for.
pub fn load(spec: &str) -> Result<Scene> {
    build(spec).map(|procedural| procedural.scene)
}

/// [`load`], with the loop that the scene has, if it moves. At its time 0 the scene is what [`load`] makes.
pub fn load_animated(spec: &str) -> Result<Animated> {
    let (Procedural { scene, .. }, motion) = make(spec)?;
    Ok(match motion {
        Some((parts, placement, clip)) => Animated::procedural(Moving::new(scene, parts, placement), clip),
        None => Animated::still(scene),
    })
}

/// [`load`], with what is known about the scene.
pub fn build(spec: &str) -> Result<Procedural> {
    make(spec).map(|(procedural, _)| procedural)
}

/// What moves in a scene: parts by node, and how.
type Motion = (BTreeMap<usize, Part>, Placement, Clip);

fn make(spec: &str) -> Result<(Procedural, Option<Motion>)> {
    let spec = spec.strip_prefix("procedural:").unwrap_or(spec);
    let (name, query) = spec.split_once('?').unwrap_or((spec, ""));
    let Some(entry) = ENTRIES.iter().find(|entry| entry.name == name) else {
        let names: Vec<&str> = ENTRIES.iter().map(|entry| entry.name).collect();
        let expected = names.join(", ");
        return Err(Error::usage("procedural", format!("expected one of {expected}, found {name:?}")));
    };
    let values = Values::parse(entry, query)?;
    let draft = (entry.build)(&values)?;
    draft.finish(&values, format!("procedural:{spec}"))
}

// ---------------------------------------------------------------------------------------------------------------- truth

/// The exact answer of a scene: its light and casters in world space, as stored.
#[derive(Debug, Clone)]
pub struct Truth {
    light_world: AreaLight,
    casters: Casters,
}

/// What stands between the receiver and the light.
#[derive(Debug, Clone)]
enum Casters {
    /// Half-planes, united.
    HalfPlanes(Vec<HalfPlane>),
    /// A convex polygon.
    Convex(Vec<DVec3>),
}

/// All on one side of an edge, so far out that what is beyond matters to no receiver in view.
#[derive(Debug, Clone, Copy)]
struct HalfPlane {
    edge: [DVec3; 2],
    /// A point of it off the edge.
    inside: DVec3,
}

impl Truth {
    /// V at a point of the receiver plane, world space.
    pub fn visibility(&self, position_world: DVec3) -> f64 {
        let Some(emitter) = self.light_world.emitter(position_world) else { return 0.0 };
        if let Casters::HalfPlanes(planes) = &self.casters
            && let [plane] = planes.as_slice()
        {
            return beyond_edge(&emitter, plane.normal_from(position_world));
        }
        if emitter.domain == Domain::Point {
            return if self.blocks(emitter.center, position_world) { 0.0 } else { 1.0 };
        }
        let (polygon, blocked) = self.polygon(&emitter, position_world);
        let fraction = match emitter.domain {
            Domain::Disk => polygon_in_unit_disc_area(&polygon) / PI,
            _ => polygon_area(&polygon) / 4.0,
        };
        if blocked { 1.0 - fraction } else { fraction }
    }

    /// Form factors of the whole light and of its visible part, for a receiver that faces up: irradiance is π times radiance
    /// times these. Known for rect lights alone.
    pub fn form_factors(&self, position_world: DVec3) -> Option<[f64; 2]> {
        if !matches!(self.light_world.shape, Shape::Rect { .. }) {
            return None;
        }
        let Some(emitter) = self.light_world.emitter(position_world) else { return Some([0.0; 2]) };
        let factor = |polygon: &[DVec2]| {
            let vertices: Vec<DVec3> = polygon.iter().map(|&uv| emitter.at(uv)).collect();
            lambert_form_factor(&vertices, DVec3::Y)
        };
        let full = factor(&DOMAIN);
        let (polygon, blocked) = self.polygon(&emitter, position_world);
        let part = factor(&polygon);
        Some([full, if blocked { full - part } else { part }])
    }

    /// The blocked part (true) or the visible part (false) of the square around the emitter's domain, whichever is convex.
    fn polygon(&self, emitter: &Emitter, position: DVec3) -> (Vec<DVec2>, bool) {
        let clip = |polygon: &[DVec2], normal: DVec3| clip_polygon(polygon, |uv| normal.dot(emitter.at(uv)));
        match &self.casters {
            Casters::HalfPlanes(planes) => {
                let visible =
                    planes.iter().fold(DOMAIN.to_vec(), |left, plane| clip(&left, -plane.normal_from(position)));
                (visible, false)
            }
            Casters::Convex(corners) => {
                let blocked = cone(corners, position).fold(DOMAIN.to_vec(), |left, normal| clip(&left, normal));
                (blocked, true)
            }
        }
    }

    /// Whether a direction from a point of the receiver plane (world space) is blocked.
    pub fn blocks(&self, direction: DVec3, position: DVec3) -> bool {
        match &self.casters {
            Casters::HalfPlanes(planes) => planes.iter().any(|plane| plane.normal_from(position).dot(direction) > 0.0),
            Casters::Convex(corners) => cone(corners, position).all(|normal| normal.dot(direction) > 0.0),
        }
    }
}

/// The domain of a rect; of a disk, the square around it.
const DOMAIN: [DVec2; 4] = [DVec2::NEG_ONE, DVec2::new(1.0, -1.0), DVec2::ONE, DVec2::new(-1.0, 1.0)];

/// The fraction of an emitter on the negative side of a plane through the receiver (C2, C4).
fn beyond_edge(emitter: &Emitter, normal: DVec3) -> f64 {
    let distance = -normal.dot(emitter.center);
    let slopes = DVec2::new(normal.dot(emitter.half_u), normal.dot(emitter.half_v));
    let support = slopes.length();
    if emitter.domain == Domain::Disk && support > 0.0 {
        disk_edge_fraction(distance / support)
    } else {
        rect_edge_fraction(distance, slopes.abs())
    }
}

/// Normals of the planes through the receiver and a convex polygon's sides, which point inwards.
fn cone(corners: &[DVec3], position: DVec3) -> impl Iterator<Item = DVec3> + '_ {
    let middle = corners.iter().sum::<DVec3>() / corners.len() as f64;
    (0..corners.len()).map(move |i| plane_through([corners[i], corners[(i + 1) % corners.len()]], middle, position))
}

/// Normal of the plane through the receiver and an edge, towards `inside`.
fn plane_through([a, b]: [DVec3; 2], inside: DVec3, position: DVec3) -> DVec3 {
    // The edge's own vector, not the difference of two long ones (algorithms.md, 2.1).
    let normal = (a - position).cross(b - a);
    if normal.dot(inside - position) < 0.0 { -normal } else { normal }
}

impl HalfPlane {
    fn normal_from(&self, position: DVec3) -> DVec3 {
        plane_through(self.edge, self.inside, position)
    }
}

// ---------------------------------------------------------------------------------------------------------------- draft

/// A scene in double precision, before `scale` and `shift`.
struct Draft {
    objects: Vec<Object>,
    materials: Vec<Material>,
    lights: Vec<AreaLight>,
    cameras: Vec<Camera>,
    movers: Vec<Mover>,
    truth: Option<Answer>,
}

/// One mesh and where it stands.
struct Object {
    name: &'static str,
    surface: Surface,
    material: Option<usize>,
    /// Rotation, stretch and translation of each instance; none: the vertices themselves are in place, and take the shift.
    instances: Vec<DAffine3>,
}

/// Which objects are the casters of a scene with a closed form.
enum Answer {
    /// Objects whose first two vertices are the edge.
    HalfPlanes(Vec<usize>),
    /// An object whose vertices are the corners, in order.
    Convex(usize),
    /// Nothing.
    Lit,
}

impl Object {
    /// In place, without a material.
    fn plain(name: &'static str, surface: Surface) -> Self {
        Self { name, surface, material: None, instances: Vec::new() }
    }
}

impl Draft {
    /// A scene of one light.
    fn lit_by(light: AreaLight, camera: Camera, objects: Vec<Object>) -> Self {
        Self {
            objects,
            materials: Vec::new(),
            lights: vec![light],
            cameras: vec![camera],
            movers: Vec::new(),
            truth: None,
        }
    }

    fn with_truth(self, truth: Answer) -> Self {
        Self { truth: Some(truth), ..self }
    }

    /// Scales, shifts, rounds the vertices and rebases.
    fn finish(self, values: &Values, name: String) -> Result<(Procedural, Option<Motion>)> {
        let (shift, scale) = (values.vector("shift"), values.number("scale"));
        let placement = Placement { scale, shift };
        let moved = |transform: &DAffine3| placement.placed(transform, DVec3::ZERO);
        let mut scene = Scene { name, materials: self.materials, ..Scene::default() };
        for object in self.objects {
            let in_place = object.instances.is_empty();
            let offset = if in_place { shift } else { DVec3::ZERO };
            let mesh = Mesh {
                name: object.name.into(),
                positions: object.surface.positions.iter().map(|p| (*p * scale + offset).as_vec3()).collect(),
                normals: object
                    .surface
                    .normals
                    .map(|normals| normals.iter().map(|normal| unit(normal.as_vec3())).collect()),
                uvs: None,
                triangles: object.surface.triangles,
                material: object.material,
            };
            let flat = |triangle: usize| {
                let [a, b, c] = mesh.corners(triangle);
                (b - a).cross(c - a) == DVec3::ZERO
            };
            if (0..mesh.triangles.len()).any(flat) {
                let message = "its vertices coincide in f32 here: make it larger, or move it less far from the origin";
                return Err(values.error(object.name, message));
            }
            scene.nodes.push(Node { name: object.name.into(), parent: None });
            scene.meshes.push(mesh);
            let (mesh, node) = (scene.meshes.len() - 1, scene.nodes.len() - 1);
            if in_place {
                scene.instances.push(Instance { mesh, node, scene_from_mesh: DAffine3::IDENTITY });
            }
            scene.instances.extend(object.instances.iter().map(|transform| Instance {
                mesh,
                node,
                scene_from_mesh: moved(transform),
            }));
        }
        for light in self.lights {
            scene.add_light(AreaLight {
                scene_from_light: moved(&light.scene_from_light),
                shape: scaled_shape(light.shape, scale),
                emission: scaled_emission(light.emission, scale),
                ..light
            });
        }
        scene.cameras = self
            .cameras
            .into_iter()
            .map(|camera| Camera {
                scene_from_camera: moved(&camera.scene_from_camera),
                projection: match camera.projection {
                    Projection::Orthographic { half_height } => {
                        Projection::Orthographic { half_height: half_height * scale }
                    }
                    perspective => perspective,
                },
                ..camera
            })
            .collect();
        let movers = self.movers.into_iter().map(|mover| scene_mover(&mut scene, mover)).collect();
        let (parts, clip) = motion::place(&mut scene, movers, placement);
        let truth = self.truth.map(|answer| truth(&answer, &scene));
        scene.rebase();
        Ok((Procedural { scene, truth }, clip.map(|clip| (parts, placement, clip))))
    }
}

/// A mover with its node: an object's own, or a new one that stands for a light or a camera.
fn scene_mover(scene: &mut Scene, mover: Mover) -> (usize, Mover) {
    let name = match mover.part {
        Part::Object(object) => {
            // The draft's objects are the scene's meshes and nodes.
            let instance = scene.instances.iter().position(|instance| instance.node == object);
            return (object, Mover { part: Part::Object(instance.expect("each object has an instance")), ..mover });
        }
        Part::Light(light) => scene.lights[light].name.clone(),
        Part::Camera(camera) => scene.cameras[camera].name.clone(),
    };
    scene.nodes.push(Node { name, parent: None });
    (scene.nodes.len() - 1, mover)
}

/// Unit again after rounding, as far as `f32` goes.
fn unit(normal: Vec3) -> Vec3 {
    normal.normalize()
}

fn scaled_shape(shape: Shape, scale: f64) -> Shape {
    match shape {
        Shape::Rect { size } => Shape::Rect { size: size * scale },
        Shape::Disk { size } => Shape::Disk { size: size * scale },
        Shape::Sphere { radius, facing } => Shape::Sphere { radius: radius * scale, facing },
        Shape::Tube { length, radius } => Shape::Tube { length: length * scale, radius: radius * scale },
        Shape::Sun { .. } | Shape::Point => shape,
    }
}

/// So that the irradiance stays: radiance does by itself, a point's intensity goes with the distance squared.
fn scaled_emission(emission: Emission, scale: f64) -> Emission {
    match emission {
        Emission::Intensity(intensity) => Emission::Intensity(intensity * (scale * scale)),
        _ => emission,
    }
}

/// Reads the casters off a scene that is still in world space.
fn truth(answer: &Answer, scene: &Scene) -> Truth {
    let vertices = |object: usize| scene.meshes[object].positions.iter().map(|position| position.as_dvec3());
    let casters = match answer {
        Answer::HalfPlanes(objects) => Casters::HalfPlanes(
            objects
                .iter()
                .map(|&object| {
                    let corners: Vec<DVec3> = vertices(object).collect();
                    HalfPlane { edge: [corners[0], corners[1]], inside: corners[2] }
                })
                .collect(),
        ),
        Answer::Convex(object) => Casters::Convex(vertices(*object).collect()),
        Answer::Lit => Casters::HalfPlanes(Vec::new()),
    };
    Truth { light_world: scene.lights[0].clone(), casters }
}

// --------------------------------------------------------------------------------------------------------------- scenes

/// How far receivers can be from the middle of the view, in its half heights: an image 8 times as wide as it is high.
const VIEW_REACH: f64 = 8.0;

/// The light of a scene, above `over` and facing down, with a radiance that gives about π below it whatever its size.
fn light_above(values: &Values, over: DVec2) -> Result<AreaLight> {
    let (half, height) = (values.number("light"), values.number("height"));
    light_of(values, half, DVec3::new(over.x, height, over.y), DVec3::new(over.x, 0.0, over.y))
}

/// The light of a scene at `at`, aimed at `target`.
fn light_of(values: &Values, half: f64, at: DVec3, target: DVec3) -> Result<AreaLight> {
    let (shape, distance) = (values.choice("shape"), at.distance(target));
    let shape = match shape {
        "rect" => Shape::Rect { size: DVec2::splat(2.0 * half) },
        "disk" => Shape::Disk { size: DVec2::splat(2.0 * half) },
        "sphere" => Shape::Sphere { radius: half, facing: false },
        "tube" => Shape::Tube { length: 2.0 * half, radius: 0.125 * half },
        "sun" => Shape::Sun { angle: 2.0 * (half / distance).atan() },
        _ => Shape::Point,
    };
    // The sphere is the widest that hangs below its centre.
    if matches!(shape, Shape::Sphere { .. } | Shape::Tube { .. }) && half >= at.y {
        return Err(values.error("light", format!("expected less than the height {}, found {half}", at.y)));
    }
    let name = if matches!(shape, Shape::Sun { .. }) { "Sun" } else { "Key" };
    let light = AreaLight::new(name, look_at(at, target, DVec3::Y), shape);
    // A disk of the same area (a tube's and a sphere's as seen) on the axis has the form factor A/(A + π·d²).
    let emission = match shape {
        Shape::Point => Emission::Intensity(DVec3::splat(PI * distance * distance)),
        Shape::Sun { .. } => Emission::Irradiance(DVec3::splat(PI)),
        _ => {
            let area = match shape {
                Shape::Rect { .. } => 4.0 * half * half,
                Shape::Tube { length, radius } => 2.0 * length * radius,
                _ => PI * half * half,
            };
            Emission::Radiance(DVec3::splat(1.0 + PI * distance * distance / area))
        }
    };
    Ok(AreaLight { emission, ..light })
}

/// The camera of a closed form: straight down at the receiver from below the lowest caster, so that nothing is in its way.
fn receiver_camera(values: &Values, lowest_caster: f64) -> Camera {
    let at = DVec3::new(0.0, 0.5 * lowest_caster, 0.0);
    Camera {
        name: "receiver".into(),
        scene_from_camera: look_at(at, DVec3::ZERO, DVec3::Y),
        projection: Projection::Orthographic { half_height: values.number("view") },
        near: 0.0,
        far: f64::INFINITY,
    }
}

/// A camera with the field of view of a 40 mm lens on full frame.
fn view_camera(eye: DVec3, target: DVec3) -> Camera {
    Camera {
        name: "view".into(),
        scene_from_camera: look_at(eye, target, DVec3::Y),
        projection: Projection::Perspective { fov_y: 2.0 * (12f64 / 40.0).atan() },
        near: 0.0,
        far: f64::INFINITY,
    }
}

/// The receiver under a closed form.
fn receiver(values: &Values) -> Object {
    let half = VIEW_REACH * values.number("view");
    Object::plain("receiver", shapes::horizontal_rect(DVec2::ZERO, DVec2::splat(half), 0.0))
}

/// The height of a caster: below every point of the light.
fn caster_height(values: &Values, key: &str) -> Result<f64> {
    let (lift, height) = (values.number(key), values.number("height"));
    let hangs = if matches!(values.choice("shape"), "sphere" | "tube") { values.number("light") } else { 0.0 };
    if lift < height - hangs {
        return Ok(lift);
    }
    Err(values
        .error(key, format!("expected less than the lowest point of the light, {}, found {lift}", height - hangs)))
}

/// How far a half-plane or strip must go so that no receiver in view sees the light beyond its far sides: an image of its
/// end lies outside the light once the end is farther than receiver and light together (the image is farther out still).
fn reach(values: &Values, offset: f64) -> f64 {
    2.0 * (2f64.sqrt() * (VIEW_REACH * values.number("view") + values.number("light")) + offset.abs())
}

/// Turned about +Y through the origin, so that an edge along Z at `x` has the normal (cos, sin) in X and Z.
fn turned(values: &Values, [x0, x1]: [f64; 2], reach: f64, height: f64) -> Surface {
    let (sin, cos) = values.number("angle").to_radians().sin_cos();
    let corner = |across: f64, along: f64| DVec3::new(across * cos - along * sin, height, across * sin + along * cos);
    shapes::polygon(&[corner(x1, reach), corner(x1, -reach), corner(x0, -reach), corner(x0, reach)])
}

fn square(values: &Values) -> Result<Draft> {
    let (lift, half) = (caster_height(values, "lift")?, values.number("occluder"));
    let center = DVec2::new(values.number("x"), values.number("z"));
    let occluder = Object::plain("occluder", shapes::horizontal_rect(center, DVec2::splat(half), lift));
    let light = light_above(values, DVec2::ZERO)?;
    let draft = Draft::lit_by(light, receiver_camera(values, lift), vec![receiver(values), occluder]);
    Ok(draft.with_truth(Answer::Convex(1)))
}

fn half_plane(values: &Values, name: &'static str, x: f64, height: f64) -> Object {
    let reach = reach(values, x);
    Object::plain(name, turned(values, [-reach, x], reach, height))
}

fn edge(values: &Values) -> Result<Draft> {
    let lift = caster_height(values, "lift")?;
    let occluder = half_plane(values, "half-plane", values.number("x"), lift);
    let light = light_above(values, DVec2::ZERO)?;
    let draft = Draft::lit_by(light, receiver_camera(values, lift), vec![receiver(values), occluder]);
    Ok(draft.with_truth(Answer::HalfPlanes(vec![1])))
}

fn two_edges(values: &Values) -> Result<Draft> {
    let (lift, lift2) = (caster_height(values, "lift")?, caster_height(values, "lift2")?);
    let objects = vec![
        receiver(values),
        half_plane(values, "lower half-plane", values.number("x"), lift),
        half_plane(values, "upper half-plane", values.number("x2"), lift2),
    ];
    let draft = Draft::lit_by(light_above(values, DVec2::ZERO)?, receiver_camera(values, lift.min(lift2)), objects);
    Ok(draft.with_truth(Answer::HalfPlanes(vec![1, 2])))
}

fn wall(values: &Values) -> Result<Draft> {
    let x = values.number("x");
    // No light is seen over it.
    let reach = reach(values, x);
    let corners = [(0.0, -1.0), (0.0, 1.0), (1.0, 1.0), (1.0, -1.0)];
    let wall = shapes::polygon(&corners.map(|(up, along)| DVec3::new(x, up * reach, along * reach)));
    let camera = receiver_camera(values, values.number("height"));
    Ok(Draft::lit_by(light_above(values, DVec2::ZERO)?, camera, vec![receiver(values), Object::plain("wall", wall)]))
}

fn disks(values: &Values) -> Result<Draft> {
    let (lift, radius, segments) = (caster_height(values, "lift")?, values.number("radius"), values.count("segments"));
    let center = DVec3::new(values.number("x"), lift, values.number("z"));
    let corners: Vec<DVec3> = shapes::circle(radius, segments).iter().map(|corner| center + corner).collect();
    let occluder = Object::plain("disc", shapes::polygon(&corners));
    let light = light_above(values, DVec2::ZERO)?;
    let draft = Draft::lit_by(light, receiver_camera(values, lift), vec![receiver(values), occluder]);
    Ok(draft.with_truth(Answer::Convex(1)))
}

fn strip(values: &Values) -> Result<Draft> {
    let (lift, x, half) = (caster_height(values, "lift")?, values.number("x"), 0.5 * values.number("width"));
    let occluder = Object::plain("strip", turned(values, [x - half, x + half], reach(values, x), lift));
    let light = light_above(values, DVec2::ZERO)?;
    let draft = Draft::lit_by(light, receiver_camera(values, lift), vec![receiver(values), occluder]);
    Ok(draft.with_truth(Answer::Convex(1)))
}

fn corner(values: &Values) -> Result<Draft> {
    let (lift, half) = (caster_height(values, "lift")?, values.number("occluder"));
    if half < 0.0 {
        return Err(values.error("occluder", format!("expected 0 or more, found {half}")));
    }
    let light = light_above(values, DVec2::splat(values.number("light")))?;
    let draft = Draft::lit_by(light, receiver_camera(values, lift), vec![receiver(values)]);
    if half == 0.0 {
        return Ok(draft.with_truth(Answer::Lit));
    }
    let center = DVec2::new(values.number("x"), values.number("z"));
    let occluder = Object::plain("occluder", shapes::horizontal_rect(center, DVec2::splat(half), lift));
    let objects = draft.objects.into_iter().chain([occluder]).collect();
    Ok(Draft { objects, truth: Some(Answer::Convex(1)), ..draft })
}

fn wire(values: &Values) -> Result<Draft> {
    let (lift, radius) = (caster_height(values, "lift")?, 0.5 * values.number("diameter"));
    if radius >= lift {
        return Err(values.error("diameter", format!("expected less than twice the lift {lift}")));
    }
    let reach = reach(values, 0.0);
    let path = [DVec3::new(0.0, lift, -reach), DVec3::new(0.0, lift, reach)];
    let occluder = Object::plain("wire", shapes::tube(&path, radius, 6, false));
    let light = light_above(values, DVec2::ZERO)?;
    Ok(Draft::lit_by(light, receiver_camera(values, lift - radius), vec![receiver(values), occluder]))
}

/// A floor of twenty times a size.
fn floor(size: f64) -> Object {
    Object::plain("floor", shapes::horizontal_rect(DVec2::ZERO, DVec2::splat(10.0 * size), 0.0))
}

fn contact(values: &Values) -> Result<Draft> {
    let (gap, height) = (values.number("gap"), values.number("height"));
    if gap < 0.0 {
        return Err(values.error("gap", format!("expected 0 or more, found {gap}")));
    }
    let block = shapes::cuboid(DVec3::new(-0.4, gap, -0.4), DVec3::new(0.4, gap + 1.0, 0.4))
        .moved(&DAffine3::from_rotation_y(0.5));
    let light = light_of(values, values.number("light"), DVec3::new(-1.5, height, -1.0), DVec3::ZERO)?;
    let camera = view_camera(DVec3::new(1.2, 2.6, 4.6), DVec3::new(0.3, 0.35, 0.1));
    Ok(Draft::lit_by(light, camera, vec![floor(1.0), Object::plain("box", block)]))
}

fn sphere(values: &Values) -> Result<Draft> {
    let (lift, radius) = (values.number("lift"), values.number("radius"));
    if radius > lift {
        return Err(values.error("radius", format!("expected at most the lift {lift}, found {radius}")));
    }
    let object = shapes::icosphere(radius, values.count("subdivisions"));
    let light = light_of(values, values.number("light"), DVec3::new(-1.0, values.number("height"), -1.0), DVec3::ZERO)?;
    let size = lift + radius;
    let camera = view_camera(size * DVec3::new(0.8, 1.9, 3.8), size * DVec3::new(0.15, 0.3, 0.1));
    let instances = vec![DAffine3::from_translation(DVec3::new(0.0, lift, 0.0))];
    let ball = Object { name: "sphere", surface: object, material: None, instances };
    Ok(Draft::lit_by(light, camera, vec![floor(size), ball]))
}

fn instances(values: &Values) -> Result<Draft> {
    let (count, subdivisions) = (values.count("count"), values.count("subdivisions"));
    let side = f64::from(count);
    let instances = (0..count * count)
        .map(|i| {
            let (row, column) = (f64::from(i / count), f64::from(i % count));
            // Golden-ratio steps: no two neighbours alike, every run the same.
            let vary = |step: f64| (f64::from(i) * step).fract();
            let stretch = DVec3::new(0.5 + vary(0.754_877), 0.6 + vary(0.569_840), 0.5 + vary(0.618_034));
            // Every third one is mirrored.
            let mirror = if i % 3 == 0 { DVec3::new(-1.0, 1.0, 1.0) } else { DVec3::ONE };
            DAffine3 {
                matrix3: DMat3::from_rotation_y(TAU * vary(0.618_034)) * DMat3::from_diagonal(mirror * stretch),
                translation: DVec3::new(column - 0.5 * (side - 1.0), 0.5 * stretch.y, row - 0.5 * (side - 1.0)),
            }
        })
        .collect();
    let pebble = Object { name: "instances", surface: shapes::icosphere(0.3, subdivisions), material: None, instances };
    let light = light_of(values, 0.15 * side, side * DVec3::new(-0.7, 1.2, -0.4), DVec3::ZERO)?;
    let camera = view_camera(DVec3::new(0.3, 1.3, 1.9) * (side + 1.0), DVec3::ZERO);
    Ok(Draft::lit_by(light, camera, vec![floor(side), pebble]))
}

/// The steepest tilt, degrees: steeper ones see the light at a grazing angle.
const MOST_TILT: f64 = 80.0;

/// How far the tilted receiver goes from the origin, m.
const TILT_REACH: f64 = 20.0;

/// From the camera to what it looks at when `distance` is 1, m.
const TILT_VIEW: f64 = 4.0;

/// Schwärzler et al. 2009, "Fast accurate soft shadows with adaptive light source sampling", Fig. 4. The receiver goes through
/// the origin, below the edge, and falls towards +X; the half-plane is over its upper part.
fn tilt(values: &Values) -> Result<Draft> {
    let (lift, half, height) = (caster_height(values, "lift")?, values.number("light"), values.number("height"));
    let (degrees, distance) = (values.number("angle"), values.number("distance"));
    if !(0.0..=MOST_TILT).contains(&degrees) {
        return Err(values.error("angle", format!("expected 0 to {MOST_TILT}, found {degrees}")));
    }
    if !(1e-3..=1e3).contains(&distance) {
        return Err(values.error("distance", format!("expected 0.001 to 1000, found {distance}")));
    }
    let (sin, cos) = degrees.to_radians().sin_cos();
    // All of it in front of the receiver, or a part of it would be hidden by no occluder.
    if half >= height * cos {
        let message = format!("expected less than {} at this height and angle, found {half}", height * cos);
        return Err(values.error("light", message));
    }
    let (downhill, normal) = (DVec3::new(cos, -sin, 0.0), DVec3::new(sin, cos, 0.0));
    // The receiver ends before it comes up to the half-plane.
    let uphill = if TILT_REACH * sin < 0.95 * lift { TILT_REACH } else { 0.95 * lift / sin };
    let receiver = [(-uphill, 1.0), (TILT_REACH, 1.0), (TILT_REACH, -1.0), (-uphill, -1.0)]
        .map(|(along, side)| along * downhill + side * TILT_REACH * DVec3::Z);
    let reach = 2.0 * (TILT_REACH + half);
    let occluder =
        [(0.0, 1.0), (0.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)].map(|(x, z)| DVec3::new(x * reach, lift, z * reach));

    // How far down the receiver the line from an end of the light over the edge meets it.
    let meets = |end: f64| {
        let slope = end / (height - lift);
        let closing = cos - slope * sin;
        if closing > 0.0 { slope * lift / closing } else { TILT_REACH }
    };
    let middle = 0.5 * (meets(half).min(TILT_REACH) + meets(-half).max(-uphill)) * downhill;
    // From down the slope, so that the half-plane is not in the way.
    let (sin, cos) = 35f64.to_radians().sin_cos();
    let eye = middle + TILT_VIEW * distance * (cos * normal + sin * downhill);
    let camera = Camera { scene_from_camera: look_at(eye, middle, -downhill), ..view_camera(eye, middle) };
    let objects = vec![
        Object::plain("receiver", shapes::polygon(&receiver)),
        Object::plain("half-plane", shapes::polygon(&occluder)),
    ];
    Ok(Draft::lit_by(light_above(values, DVec2::ZERO)?, camera, objects).with_truth(Answer::HalfPlanes(vec![1])))
}

// --------------------------------------------------------------------------------------------------------------- values

/// The parameters of one scene, each given or by default.
struct Values {
    scene: &'static str,
    values: Vec<(&'static str, Value)>,
}

#[derive(Debug, Clone, Copy)]
enum Value {
    Number(f64),
    Count(u32),
    Vector(DVec3),
    Choice(&'static str),
}

impl Values {
    fn parse(entry: &'static Entry, query: &str) -> Result<Self> {
        let parameters = || entry.parameters.iter().chain(&COMMON_PARAMETERS);
        let mut values =
            Self { scene: entry.name, values: parameters().map(|p| (p.name, p.kind.default_value())).collect() };
        let mut given: Vec<&str> = Vec::new();
        for pair in query.split('&').filter(|pair| !pair.is_empty()) {
            let Some((key, text)) = pair.split_once('=') else {
                return Err(values.error(pair, "expected key=value"));
            };
            let Some(at) = parameters().position(|parameter| parameter.name == key) else {
                let names: Vec<&str> = parameters().map(|parameter| parameter.name).collect();
                return Err(values.error(key, format!("expected one of {}", names.join(", "))));
            };
            if given.contains(&key) {
                return Err(values.error(key, "given twice"));
            }
            given.push(key);
            let kind = values.kind(entry, at);
            let Some(value) = kind.value(text) else {
                return Err(values.error(key, format!("expected {kind}, found {text:?}")));
            };
            values.values[at].1 = value;
        }
        Ok(values)
    }

    fn kind(&self, entry: &'static Entry, at: usize) -> Kind {
        entry.parameters.get(at).unwrap_or_else(|| &COMMON_PARAMETERS[at - entry.parameters.len()]).kind
    }

    fn error(&self, key: &str, message: impl Into<String>) -> Error {
        Error::usage(format!("procedural:{}: {key}", self.scene), message)
    }

    fn get(&self, key: &str) -> Value {
        match self.values.iter().find(|(name, _)| *name == key) {
            Some((_, value)) => *value,
            None => panic!("procedural:{} has no parameter {key}", self.scene),
        }
    }

    fn number(&self, key: &str) -> f64 {
        match self.get(key) {
            Value::Number(number) => number,
            other => panic!("{key} is {other:?}"),
        }
    }

    fn count(&self, key: &str) -> u32 {
        match self.get(key) {
            Value::Count(count) => count,
            other => panic!("{key} is {other:?}"),
        }
    }

    fn vector(&self, key: &str) -> DVec3 {
        match self.get(key) {
            Value::Vector(vector) => vector,
            other => panic!("{key} is {other:?}"),
        }
    }

    fn choice(&self, key: &str) -> &'static str {
        match self.get(key) {
            Value::Choice(choice) => choice,
            other => panic!("{key} is {other:?}"),
        }
    }
}

impl Kind {
    /// The default as it would be given.
    pub fn default_text(&self) -> String {
        match self {
            Self::Positive(default) | Self::Number(default) => default.to_string(),
            Self::Count { default, .. } => default.to_string(),
            Self::Vector => "0/0/0".into(),
            Self::Scale => "1".into(),
            Self::Choice(among) => among[0].into(),
        }
    }

    fn default_value(&self) -> Value {
        match *self {
            Self::Positive(default) | Self::Number(default) => Value::Number(default),
            Self::Count { default, .. } => Value::Count(default),
            Self::Vector => Value::Vector(DVec3::ZERO),
            Self::Scale => Value::Number(1.0),
            Self::Choice(among) => Value::Choice(among[0]),
        }
    }

    /// A value given as text, if it is of this kind and in range.
    fn value(&self, text: &str) -> Option<Value> {
        let number = || match text.strip_prefix("2^") {
            Some(exponent) => exponent.parse().ok().map(|exponent| 2f64.powi(exponent)),
            None => text.parse::<f64>().ok(),
        };
        match *self {
            Self::Positive(_) => number().filter(|value| (LEAST..=MOST).contains(value)).map(Value::Number),
            Self::Number(_) => number().filter(|value| value.abs() <= MOST).map(Value::Number),
            Self::Count { min, max, .. } => {
                text.parse().ok().filter(|count| (min..=max).contains(count)).map(Value::Count)
            }
            Self::Vector => {
                parse_vector(text).filter(|vector| vector.abs().max_element() <= MOST_SHIFT).map(Value::Vector)
            }
            Self::Scale => number().filter(|value| (1.0 / MOST_SCALE..=MOST_SCALE).contains(value)).map(Value::Number),
            Self::Choice(among) => among.iter().find(|word| **word == text).map(|word| Value::Choice(word)),
        }
    }
}

/// The range, as messages and `penumbra list` show it.
impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Positive(_) => write!(f, "{LEAST:e} to {MOST:e}"),
            Self::Number(_) => write!(f, "-{MOST:e} to {MOST:e}"),
            Self::Count { min, max, .. } => write!(f, "a whole number from {min} to {max}"),
            Self::Vector => write!(f, "X/Y/Z, each -{MOST_SHIFT} to {MOST_SHIFT}"),
            Self::Scale => write!(f, "2^-30 to 2^30"),
            Self::Choice(among) => write!(f, "{}", among.join("|")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::closed_forms::{
        lens_area, rect_form_factor, rect_occluder_form_factor, rect_occluder_visibility, strip_blocked_fraction,
    };
    use crate::scene::Bounds;

    fn made(spec: &str) -> (Scene, Truth) {
        let procedural = build(spec).unwrap();
        (procedural.scene, procedural.truth.unwrap())
    }

    #[track_caller]
    fn close(value: f64, expected: f64, tolerance: f64) {
        assert!((value - expected).abs() <= tolerance, "{value} is not {expected} ± {tolerance:e}");
    }

    fn on_floor(x: f64, z: f64) -> DVec3 {
        DVec3::new(x, 0.0, z)
    }

    const SPOTS: [(f64, f64); 7] =
        [(0.0, 0.0), (0.31, -0.2), (-0.7, 0.4), (1.3, -0.9), (0.05, 1.9), (-2.6, 1.0), (3.0, 2.0)];

    /// V by counting the grid points of the emitter that the scene's triangles leave visible.
    fn counted(scene: &Scene, position_world: DVec3, n: u32) -> f64 {
        let position = position_world - scene.origin_world;
        let emitter = scene.lights[0].emitter(position).unwrap();
        let mut triangles = Vec::new();
        for instance in &scene.instances[1..] {
            let mesh = &scene.meshes[instance.mesh];
            for triangle in 0..mesh.triangles.len() {
                triangles.push(mesh.corners(triangle).map(|p| instance.scene_from_mesh.transform_point3(p) - position));
            }
        }
        let blocked = |to: DVec3| {
            triangles.iter().any(|[a, b, c]| {
                let side = |a: &DVec3, b: &DVec3| a.cross(*b).dot(to);
                let (p, q, r) = (side(a, b), side(b, c), side(c, a));
                let normal = (b - a).cross(c - a);
                let t = normal.dot(*a) / normal.dot(to);
                ((p > 0.0) == (q > 0.0) && (q > 0.0) == (r > 0.0)) && t > 0.0 && (t < 1.0 || emitter.distant)
            })
        };
        let at = |i: u32| (2.0 * f64::from(i) + 1.0) / f64::from(n) - 1.0;
        let points: Vec<DVec2> = (0..n * n)
            .map(|i| DVec2::new(at(i % n), at(i / n)))
            .filter(|uv| emitter.domain == Domain::Rect || uv.length_squared() <= 1.0)
            .collect();
        let visible = points.iter().filter(|&&uv| !blocked(emitter.at(uv))).count();
        visible as f64 / points.len() as f64
    }

    #[test]
    fn every_scene_is_whole() {
        for entry in ENTRIES {
            let Procedural { scene, .. } = build(entry.name).unwrap();
            assert_eq!(scene.name, format!("procedural:{}", entry.name));
            assert!(!scene.lights.is_empty() && !scene.cameras.is_empty(), "{}", entry.name);
            assert!(scene.bounds().min.abs().max_element() < 1e-6, "{} is rebased", entry.name);
            for mesh in &scene.meshes {
                let count = mesh.positions.len();
                assert!(mesh.triangles.as_flattened().iter().all(|&index| (index as usize) < count));
                assert!(mesh.normals.as_ref().is_none_or(|normals| normals.len() == count));
                assert!(mesh.material.is_none_or(|material| material < scene.materials.len()));
            }
            for instance in &scene.instances {
                assert!(instance.scene_from_mesh.matrix3.determinant() != 0.0);
            }
            // Every parameter takes its own default.
            for parameter in entry.parameters.iter().chain(&COMMON_PARAMETERS) {
                let spec = format!("procedural:{}?{}={}", entry.name, parameter.name, parameter.kind.default_text());
                let again = load(&spec).unwrap();
                assert_eq!(again.triangle_count(), scene.triangle_count(), "{spec}");
            }
        }
    }

    #[test]
    fn wrong_specs_are_refused_in_one_line() {
        for (spec, expected) in [
            ("none", "procedural: expected one of demo, square, edge, disks"),
            ("square?size=1", "procedural:square: size: expected one of light, height, lift, occluder, x, z, shape"),
            ("square?light=0", "light: expected 1e-30 to 1e6, found \"0\""),
            ("square?light=nan", "found \"nan\""),
            ("square?x=inf", "x: expected -1e6 to 1e6"),
            ("square?light", "light: expected key=value"),
            ("square?light=1&light=2", "light: given twice"),
            ("square?shape=cube", "shape: expected rect|disk|sphere|tube|sun|point, found \"cube\""),
            ("square?lift=5", "lift: expected less than the lowest point of the light, 5, found 5"),
            ("square?shape=sphere&lift=4", "lowest point of the light, 4"),
            ("sphere?subdivisions=9", "subdivisions: expected a whole number from 0 to 8"),
            ("sphere?radius=2", "radius: expected at most the lift 1"),
            ("contact?gap=-1", "gap: expected 0 or more"),
            ("demo?shift=1/2", "shift: expected X/Y/Z"),
            ("demo?scale=2^31", "scale: expected 2^-30 to 2^30"),
            ("demo?scale=2^-99999999999", "scale: expected 2^-30 to 2^30"),
            ("strip?x=0.3&width=1e-12", "strip: its vertices coincide in f32"),
            ("square?shift=16777216/0/0", "occluder: its vertices coincide in f32"),
        ] {
            let message = load(spec).unwrap_err().to_string();
            assert!(message.contains(expected) && !message.contains('\n'), "{spec}: {message}");
        }
    }

    #[test]
    fn truth_agrees_with_its_own_triangles() {
        let n = 160;
        for (name, parameters) in [
            ("square", "lift=1.5"),
            ("edge", "angle=33&x=0.2"),
            ("disks", "x=0.3&segments=7&radius=1.2"),
            ("strip", "width=0.4&angle=-20"),
            ("corner", "occluder=0.7"),
            ("two-edges", "angle=10"),
        ] {
            for shape in ["rect", "disk", "sphere", "tube", "sun"] {
                let (scene, truth) = made(&format!("{name}?{parameters}&shape={shape}&shift=3/-2/10"));
                for (x, z) in SPOTS.into_iter().chain([(15.9, 2.0), (-15.9, -2.0)]) {
                    let position = on_floor(x, z) + DVec3::new(3.0, -2.0, 10.0);
                    let visibility = truth.visibility(position);
                    // A convex outline crosses at most 4n cells of n², a disk is π/4 of them and has an outline itself; two
                    // edges have two outlines.
                    let tolerance = 2.0 * 4.0 / f64::from(n) * 4.0 / PI;
                    let expected = counted(&scene, position, n);
                    assert!(
                        (visibility - expected).abs() < tolerance,
                        "{name} {shape} {x} {z}: {visibility} {expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn square_is_c1() {
        let (_, truth) = made("square?x=0.125&z=-0.25&shape=rect");
        for (x, z) in SPOTS {
            let closed = rect_occluder_visibility(
                DVec2::new(x, z),
                DVec2::new(0.125, -0.25),
                DVec2::splat(0.5),
                2.0,
                DVec2::ONE,
                5.0,
            );
            close(truth.visibility(on_floor(x, z)), closed, 1e-14);
        }
    }

    #[test]
    fn edge_is_c2_c3_and_c4() {
        let (_, truth) = made("edge?x=0.25");
        let (_, disk) = made("edge?x=0.25&shape=disk");
        for (x, z) in SPOTS {
            let image = crate::closed_forms::occluder_image(x, 0.25, 2.0, 5.0);
            close(truth.visibility(on_floor(x, z)), rect_edge_fraction(-image, DVec2::X), 1e-14);
            close(disk.visibility(on_floor(x, z)), disk_edge_fraction(-image), 1e-14);
        }
        // The turned edge's vertices are rounded: the closed form with the nominal angle holds to their rounding.
        for angle in [1e-9, 30.0, 45.0, 137.0] {
            let (scene, truth) = made(&format!("edge?x=0.25&angle={angle}"));
            let normal = DVec2::from_angle(f64::to_radians(angle));
            let rounding = scene.bounds().max.max_element() * f64::from(f32::EPSILON);
            for (x, z) in SPOTS {
                let distance = (0.25 - normal.dot(DVec2::new(x, z))) * 2.5 + normal.dot(DVec2::new(x, z));
                let closed = rect_edge_fraction(-distance, normal.abs());
                // V changes by at most H/h/2l per metre of the edge.
                close(truth.visibility(on_floor(x, z)), closed, 1.25 * rounding);
            }
        }
    }

    #[test]
    fn disks_tend_to_c5() {
        let segments = 4096;
        let (_, truth) = made(&format!("disks?segments={segments}&x=0.125&z=0.5"));
        for (x, z) in SPOTS {
            let image = DVec2::new(x, z) + (DVec2::new(0.125, 0.5) - DVec2::new(x, z)) * 2.5;
            let closed = 1.0 - lens_area(1.0, 1.25, image.length()) / PI;
            // An inscribed n-gon lacks the share 2π²/3n² of its disc; vertices are rounded to 2^-24.
            let lack = 1.25f64.powi(2) * 2.0 * PI * PI / (3.0 * f64::from(segments).powi(2));
            close(truth.visibility(on_floor(x, z)), closed, lack + 1e-6);
        }
    }

    #[test]
    fn strip_is_c7_however_thin() {
        for exponent in [-3, -20, -40] {
            let width = 2f64.powi(exponent);
            let (_, truth) = made(&format!("strip?width=2^{exponent}"));
            for (x, z) in SPOTS {
                let closed = 1.0 - strip_blocked_fraction(x, 0.0, width, 2.0, 1.0, 5.0);
                close(truth.visibility(on_floor(x, z)), closed, 1e-14);
            }
        }
    }

    #[test]
    fn corner_is_c8_and_c9() {
        let (_, lit) = made("corner");
        let (_, occluded) = made("corner?occluder=0.25&lift=2");
        for (x, z) in SPOTS {
            let position = DVec2::new(x, z);
            let full = rect_form_factor(-position / 5.0, (DVec2::splat(2.0) - position) / 5.0);
            close(lit.form_factors(on_floor(x, z)).unwrap()[0], full, 1e-15);
            close(lit.form_factors(on_floor(x, z)).unwrap()[1], full, 1e-15);
            assert_eq!(lit.visibility(on_floor(x, z)), 1.0);
            let (receiver, center) = (position - 1.0, DVec2::splat(-0.5));
            let hidden = rect_occluder_form_factor(receiver, center, DVec2::splat(0.25), 2.0, DVec2::ONE, 5.0);
            close(occluded.form_factors(on_floor(x, z)).unwrap()[1], full - hidden, 1e-15);
        }
        let expected = crate::closed_forms::corner_form_factor(0.4, 0.4);
        close(lit.form_factors(DVec3::ZERO).unwrap()[0], expected, 1e-15);
    }

    #[test]
    fn overlapping_edges_unite() {
        let (_, truth) = made("two-edges");
        // algorithms.md, section 4: .333, not the product .167 nor the sum 0; 0.2 is rounded to f32.
        close(truth.visibility(DVec3::ZERO), 1.0 / 3.0, 1e-8);
    }

    #[test]
    fn vanishing_light_casts_the_hard_shadow_of_a_point() {
        let (_, point) = made("square?shape=point");
        for spec in ["square?light=1e-30", "square?light=1e-30&shape=disk", "square?light=1e-30&shape=sphere"] {
            let (_, truth) = made(spec);
            for (x, z) in SPOTS {
                let position = on_floor(x, z);
                assert_eq!(truth.visibility(position), point.visibility(position), "{spec} {x} {z}");
            }
        }
    }

    #[test]
    fn power_of_two_scale_changes_no_digit() {
        let base = made("edge?angle=33&shape=disk");
        for exponent in [-20, 20] {
            let factor = 2f64.powi(exponent);
            let (scene, truth) = made(&format!("edge?angle=33&shape=disk&scale=2^{exponent}"));
            for (mesh, original) in scene.meshes.iter().zip(&base.0.meshes) {
                for (position, original) in mesh.positions.iter().zip(original.positions.iter()) {
                    assert_eq!(*position, *original * factor as f32);
                }
            }
            for (x, z) in SPOTS {
                let position = on_floor(x, z);
                assert_eq!(truth.visibility(position * factor), base.1.visibility(position));
            }
        }
    }

    #[test]
    fn exactly_representable_shift_changes_no_digit() {
        let parameters = "x=0.125&z=-0.25";
        let base = made(&format!("square?{parameters}"));
        let shift = DVec3::new(1_048_576.0, -524_288.0, 65_536.0);
        let (scene, truth) = made(&format!("square?{parameters}&shift=1048576/-524288/65536"));
        assert_eq!(scene.origin_world, base.0.origin_world + shift);
        for (x, z) in SPOTS.map(|(x, z)| ((x * 8.0f64).round() / 8.0, (z * 8.0f64).round() / 8.0)) {
            let position = on_floor(x, z);
            assert_eq!(truth.visibility(position + shift), base.1.visibility(position));
        }
    }

    #[test]
    fn receiver_camera_looks_under_the_occluder() {
        for (spec, lowest) in
            [("square?lift=1e-6", 1e-6f32), ("two-edges", 1.0), ("wire", 3.999), ("disks", 2.0), ("strip", 2.0)]
        {
            let scene = load(spec).unwrap();
            let camera = &scene.cameras[0];
            for at in [DVec2::ZERO, DVec2::new(320.0, 240.0), DVec2::new(640.0, 480.0)] {
                let ray = camera.ray(at, [640, 480]);
                let height = ray.origin.y + scene.origin_world.y;
                assert!(ray.direction == DVec3::NEG_Y && height > 0.0 && height < f64::from(lowest), "{spec}");
            }
            close(camera.ray(DVec2::ZERO, [640, 480]).origin.x + scene.origin_world.x, -4.0 * 2.0 / 3.0, 1e-14);
        }
    }

    #[test]
    fn light_below_gives_about_pi_on_its_axis() {
        let (scene, truth) = made("corner?light=20");
        let Emission::Radiance(radiance) = scene.lights[0].emission else { panic!() };
        let [full, _] = truth.form_factors(on_floor(20.0, 20.0)).unwrap();
        close(radiance.x * full, 1.0, 0.05);
    }

    #[test]
    fn instances_share_one_mesh() {
        let scene = load("instances?count=30&subdivisions=1").unwrap();
        assert_eq!((scene.meshes.len(), scene.instances.len()), (2, 901));
        assert_eq!(scene.triangle_count(), 900 * 80 + 2);
        assert!(scene.instances.iter().any(|instance| instance.scene_from_mesh.matrix3.determinant() < 0.0));
    }

    #[test]
    fn demo_stands_on_its_floor_in_front_of_its_camera() {
        let scene = load("demo").unwrap();
        assert!((5_000..=60_000).contains(&scene.triangle_count()), "{}", scene.triangle_count());
        assert_eq!(scene.lights.iter().map(|light| light.name.as_str()).collect::<Vec<_>>(), ["Key", "Rim"]);
        let camera_from_scene = scene.cameras[0].scene_from_camera.inverse();
        let slope = (12f64 / 40.0) * 4.0 / 3.0;
        for (instance, bounds) in scene.instances.iter().zip(scene.instance_bounds()).skip(1) {
            let name = &scene.nodes[instance.node].name;
            // Nothing sinks into the floor by more than a rounding.
            assert!(bounds.min.y + scene.origin_world.y > -1e-6, "{name}");
            let at = camera_from_scene.transform_point3(bounds.center());
            assert!(at.z < 0.0 && at.x.abs() < -slope * at.z && at.y.abs() < 0.75 * -slope * at.z, "{name}");
        }
        // No light touches the objects, and all of their tops see its front.
        let objects = scene.instance_bounds().into_iter().skip(1).fold(Bounds::EMPTY, Bounds::union);
        for light in &scene.lights {
            assert!(light.scene_from_light.translation.y > objects.max.y + 1.0);
            assert!(light.emitter(objects.center()).is_some());
        }
    }
}
