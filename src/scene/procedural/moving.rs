//! A room with parts that move, each alone or together: the camera walks, the light slides, a hoop flies between the light and
//! shadows that stand still, a board slides and turns below others.
//!
//! A canopy close to the light gives wide penumbrae, a screen some that widen with its height, blocks and a plinth narrow ones.

use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3};

use super::demo::{light, object, placed, standing};
use super::motion::{Mover, Part, curve, rotation_curve};
use super::shapes::{self, Surface};
use super::{Draft, Object, Values, view_camera};
use crate::Result;
use crate::scene::Material;
use crate::scene::camera::look_at;
use crate::scene::light::Shape;

/// Name, linear base colour and roughness; the place in the list is the material's index.
const MATERIALS: [(&str, Vec3, f32); 6] = [
    ("plaster", Vec3::new(0.74, 0.71, 0.66), 0.9),
    ("cedar", Vec3::new(0.50, 0.27, 0.13), 0.5),
    ("limestone", Vec3::new(0.66, 0.61, 0.53), 0.8),
    ("porcelain", Vec3::new(0.86, 0.83, 0.77), 0.2),
    ("ochre", Vec3::new(0.72, 0.45, 0.14), 0.4),
    ("slate", Vec3::new(0.30, 0.38, 0.44), 0.5),
];
const PLASTER: usize = 0;
const CEDAR: usize = 1;
const LIMESTONE: usize = 2;
const PORCELAIN: usize = 3;
const OCHRE: usize = 4;
const SLATE: usize = 5;

/// Length of the loop at speed 1, s.
const LOOP_SECONDS: f64 = 2.0;
/// The longest side that the light can have without touching anything, m.
const MOST_LIGHT: f64 = 2.0;
/// Where the light hangs when it begins and what it aims at, m.
const KEY_AT: DVec3 = DVec3::new(-3.9, 4.7, 1.2);
const KEY_TARGET: DVec3 = DVec3::new(0.3, 0.2, -0.5);

pub(super) fn build(values: &Values) -> Result<Draft> {
    let (width, aspect) = (values.number("light_size"), values.number("aspect"));
    let size = DVec2::new(width, width / aspect);
    if size.max_element() > MOST_LIGHT {
        let key = if width > MOST_LIGHT { "light_size" } else { "aspect" };
        let message = format!("expected a light of at most {MOST_LIGHT} m a side, found {} x {}", size.x, size.y);
        return Err(values.error(key, message));
    }
    let objects = vec![
        object("room", PLASTER, room()),
        object("screen", CEDAR, screen().moved(&placed(DVec3::new(-1.45, 0.0, -0.75), -53.0))),
        object("canopy", SLATE, canopy()),
        object("plinth", LIMESTONE, standing(DVec3::new(0.35, 0.0, -1.35), DVec3::new(0.6, 0.8, 0.6))),
        object("sphere", PORCELAIN, shapes::icosphere(0.36, 4).moved(&placed(DVec3::new(0.35, 1.16, -1.35), 0.0))),
        object("blocks", OCHRE, blocks().moved(&placed(DVec3::new(1.9, 0.0, -1.2), 20.0))),
        movable("hoop", OCHRE, hoop()),
        movable("board", SLATE, shapes::cuboid(DVec3::new(-0.65, -0.03, -0.45), DVec3::new(0.65, 0.03, 0.45))),
    ];
    let (hoop, board) = (objects.len() - 2, objects.len() - 1);

    let seconds = LOOP_SECONDS / values.number("speed");
    let switch = |key: &str| values.count(key) == 1;
    let translation = |at: fn(f64) -> DVec3| curve(seconds, move |angle| at(angle).to_array());
    let turning = |part, key, at: fn(f64) -> DVec3, rotation: fn(f64) -> DMat3| Mover {
        part,
        moves: switch(key),
        translation: translation(at),
        rotation: Some(rotation_curve(seconds, rotation)),
    };
    let movers = vec![
        turning(Part::Camera(0), "camera", eye, |angle| look_at(eye(angle), target(angle), DVec3::Y).matrix3),
        Mover { part: Part::Light(0), moves: switch("light"), translation: translation(key_at), rotation: None },
        turning(Part::Object(hoop), "caster", hoop_at, hoop_turn),
        turning(Part::Object(board), "receiver", board_at, board_turn),
    ];
    let materials = MATERIALS
        .iter()
        .map(|&(name, base_color, roughness)| Material {
            name: name.into(),
            base_color,
            roughness,
            ..Material::default()
        })
        .collect();
    let key = light("Key", Shape::Rect { size }, size.x * size.y, KEY_AT, KEY_TARGET, DVec3::new(0.95, 0.88, 0.78));
    let camera = view_camera(eye(0.0), target(0.0));
    Ok(Draft { objects, materials, lights: vec![key], cameras: vec![camera], movers, truth: None })
}

/// An object around its own origin; a mover says where it is.
fn movable(name: &'static str, material: usize, surface: Surface) -> Object {
    Object { instances: vec![DAffine3::IDENTITY], ..object(name, material, surface) }
}

/// The camera walks to one side and back to the other, nearer in between, and turns against it.
fn eye(angle: f64) -> DVec3 {
    DVec3::new(0.7 + 0.9 * angle.sin(), 2.9 + 0.12 * (2.0 * angle).sin(), 6.5 + 0.4 * angle.cos())
}

fn target(angle: f64) -> DVec3 {
    DVec3::new(-0.05 - 0.3 * angle.sin(), 0.6, -0.3)
}

/// The light slides along the room.
fn key_at(angle: f64) -> DVec3 {
    KEY_AT + DVec3::new(0.25 * angle.sin(), 0.0, -0.8 * angle.sin())
}

/// The hoop flies round between the light and the canopy's shadow: its penumbra passes over one that stands still.
fn hoop_at(angle: f64) -> DVec3 {
    DVec3::new(-0.2 - 0.9 * angle.cos(), 1.65 + 0.2 * (2.0 * angle).sin(), 0.55 + 0.6 * angle.sin())
}

fn hoop_turn(angle: f64) -> DMat3 {
    DMat3::from_rotation_y(0.9 * angle.sin()) * DMat3::from_rotation_z(0.5 * angle.cos()) * DMat3::from_rotation_x(0.9)
}

/// The board slides below the shadows of screen and canopy and turns.
fn board_at(angle: f64) -> DVec3 {
    DVec3::new(1.15 + 0.45 * angle.sin(), 0.34, 0.75 + 0.25 * angle.cos())
}

fn board_turn(angle: f64) -> DMat3 {
    DMat3::from_rotation_y(0.3 + 0.5 * angle.cos()) * DMat3::from_rotation_x(0.4)
}

/// A floor, a wall behind and one on the right.
fn room() -> Surface {
    let (left, right, back, front, height) = (-8.0, 4.6, -3.4, 10.0, 6.0);
    let corner = |x: f64, y: f64, z: f64| DVec3::new(x, y, z);
    Surface::joined([
        shapes::polygon(&[
            corner(left, 0.0, front),
            corner(right, 0.0, front),
            corner(right, 0.0, back),
            corner(left, 0.0, back),
        ]),
        shapes::polygon(&[
            corner(left, 0.0, back),
            corner(right, 0.0, back),
            corner(right, height, back),
            corner(left, height, back),
        ]),
        shapes::polygon(&[
            corner(right, 0.0, back),
            corner(right, 0.0, front),
            corner(right, height, front),
            corner(right, height, back),
        ]),
    ])
}

/// Upright slats between two rails.
fn screen() -> Surface {
    let slats = (-4..=4).map(|i| standing(DVec3::new(0.21 * f64::from(i), 0.0, 0.0), DVec3::new(0.1, 1.7, 0.03)));
    let rails = [0.2, 1.5].map(|y| standing(DVec3::new(0.0, y, 0.03), DVec3::new(1.85, 0.08, 0.03)));
    Surface::joined(slats.chain(rails))
}

/// A plate with a gap on two posts.
fn canopy() -> Surface {
    let plate = |z: f64| standing(DVec3::new(-1.65, 2.2, z), DVec3::new(0.7, 0.05, 0.4));
    let posts = [0.18, 1.32].map(|z| standing(DVec3::new(-1.95, 0.0, z), DVec3::new(0.06, 2.2, 0.06)));
    Surface::joined([plate(0.4), plate(1.1)].into_iter().chain(posts))
}

/// Two stacked blocks and one beside them.
fn blocks() -> Surface {
    let turned = standing(DVec3::new(0.0, 0.4, 0.0), DVec3::new(0.4, 0.35, 0.4)).moved(&placed(DVec3::ZERO, 31.0));
    Surface::joined([
        standing(DVec3::ZERO, DVec3::new(0.75, 0.4, 0.55)),
        turned,
        standing(DVec3::new(0.25, 0.0, 0.75), DVec3::new(0.28, 0.28, 0.28)),
    ])
}

/// A ring with a cross in it.
fn hoop() -> Surface {
    let radius = 0.42;
    let bar = |along: DVec3| shapes::tube(&[-along * radius, along * radius], 0.03, 12, false);
    Surface::joined([shapes::torus(radius, 0.055, 64, 16), bar(DVec3::X), bar(DVec3::Z)])
}
