//! The demo scene: a small set on a swept backdrop, lit from behind on the left so that its shadows fall towards the viewer.
//!
//! A slatted screen shows an edge soften with its distance from the floor, blocks and wheel a contact, spokes and a wire thin
//! casters, the ring and the leaves casters at several heights, the sphere a terminator.

use std::f64::consts::{PI, TAU};

use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3};

use super::shapes::{self, Surface};
use super::{Draft, Object, Values, view_camera};
use crate::Result;
use crate::scene::Material;
use crate::scene::camera::look_at;
use crate::scene::light::{AreaLight, Emission, Shape};

/// Name, linear base colour and roughness; the place in the list is the material's index.
const MATERIALS: [(&str, Vec3, f32); 8] = [
    ("plaster", Vec3::new(0.78, 0.72, 0.64), 0.9),
    ("cedar", Vec3::new(0.50, 0.27, 0.13), 0.5),
    ("limestone", Vec3::new(0.66, 0.61, 0.53), 0.8),
    ("porcelain", Vec3::new(0.86, 0.83, 0.77), 0.2),
    ("bronze", Vec3::new(0.24, 0.17, 0.11), 0.3),
    ("terracotta", Vec3::new(0.62, 0.24, 0.12), 0.7),
    ("leaf", Vec3::new(0.20, 0.33, 0.10), 0.5),
    ("ochre", Vec3::new(0.72, 0.45, 0.14), 0.4),
];
const PLASTER: usize = 0;
const CEDAR: usize = 1;
const LIMESTONE: usize = 2;
const PORCELAIN: usize = 3;
const BRONZE: usize = 4;
const TERRACOTTA: usize = 5;
const LEAF: usize = 6;
const OCHRE: usize = 7;

/// Where the key light hangs and what it aims at, m.
const KEY_AT: DVec3 = DVec3::new(-4.2, 6.0, -2.7);
const KEY_TARGET: DVec3 = DVec3::new(-1.9, 0.0, -0.8);
/// The rim light: small, far and cool.
const RIM_AT: DVec3 = DVec3::new(8.0, 6.5, 3.5);
const RIM_TARGET: DVec3 = DVec3::new(0.5, 0.4, 0.0);
const RIM_DIAMETER: f64 = 0.8;

pub(super) fn build(values: &Values) -> Result<Draft> {
    let side = values.number("light");
    if side > 4.0 {
        return Err(values.error("light", format!("expected at most 4, found {side}")));
    }
    let mut objects = vec![
        object("backdrop", PLASTER, backdrop()),
        object("screen", CEDAR, screen().moved(&placed(DVec3::new(-1.75, 0.0, -0.75), 24.0))),
        object("plinth", LIMESTONE, plinth().moved(&placed(DVec3::new(1.35, 0.0, -0.75), -28.0))),
        object("sphere", PORCELAIN, shapes::icosphere(0.42, 4).moved(&placed(DVec3::new(1.35, 1.36, -0.75), 0.0))),
        object("wheel", BRONZE, wheel().moved(&placed(DVec3::new(0.1, 0.0, 0.15), 35.0))),
        object("ring", OCHRE, ring()),
        object("blocks", TERRACOTTA, blocks().moved(&placed(DVec3::new(1.75, 0.0, 1.0), 18.0))),
        object("wire", BRONZE, wire().moved(&placed(DVec3::new(2.75, 0.0, -0.35), 0.0))),
        object("pot", TERRACOTTA, pot().moved(&placed(POT_AT, 0.0))),
        object("stems", LEAF, stems().moved(&placed(POT_AT, 0.0))),
    ];
    objects.push(Object { instances: leaves(), ..object("leaves", LEAF, shapes::leaf(1.0, 0.34, 1.1, 10)) });

    let materials = MATERIALS
        .iter()
        .map(|&(name, base_color, roughness)| Material {
            name: name.into(),
            base_color,
            roughness,
            ..Material::default()
        })
        .collect();
    let key = Shape::Rect { size: DVec2::splat(side) };
    let rim = Shape::Disk { size: DVec2::splat(RIM_DIAMETER) };
    Ok(Draft {
        objects,
        materials,
        lights: vec![
            light("Key", key, side * side, KEY_AT, KEY_TARGET, DVec3::new(1.50, 1.33, 1.11)),
            light("Rim", rim, 0.25 * PI * RIM_DIAMETER.powi(2), RIM_AT, RIM_TARGET, DVec3::new(0.16, 0.20, 0.26)),
        ],
        cameras: vec![view_camera(DVec3::new(1.2, 4.1, 8.3), DVec3::new(0.3, 0.6, 0.15))],
        movers: Vec::new(),
        truth: None,
    })
}

/// A light whose irradiance at its target, facing up, is π times `color`.
pub(super) fn light(name: &str, shape: Shape, area: f64, at: DVec3, target: DVec3, color: DVec3) -> AreaLight {
    let way = at - target;
    let cosine = way.y / way.length();
    let radiance = color * (PI * way.length_squared() / (area * cosine));
    AreaLight { emission: Emission::Radiance(radiance), ..AreaLight::new(name, look_at(at, target, DVec3::Y), shape) }
}

pub(super) fn object(name: &'static str, material: usize, surface: Surface) -> Object {
    Object { material: Some(material), ..Object::plain(name, surface) }
}

/// At a place, turned about +Y by degrees.
pub(super) fn placed(at: DVec3, degrees: f64) -> DAffine3 {
    DAffine3 { matrix3: DMat3::from_rotation_y(degrees.to_radians()), translation: at }
}

/// A floor that sweeps up into a wall behind the set.
fn backdrop() -> Surface {
    let (front, back, radius, top, half_width) = (14.0, -7.5, 2.5, 8.0, 24.0);
    let arc = (0..=24).map(|i| {
        let (sin, cos) = (0.5 * PI * f64::from(i) / 24.0).sin_cos();
        DVec2::new(back + radius - radius * sin, radius - radius * cos)
    });
    let profile: Vec<DVec2> = [DVec2::new(front, 0.0)].into_iter().chain(arc).chain([DVec2::new(back, top)]).collect();
    shapes::extruded(&profile, half_width)
}

/// A box of some size that stands on the floor, its foot's middle at a place.
pub(super) fn standing(foot: DVec3, size: DVec3) -> Surface {
    let half = DVec3::new(0.5 * size.x, 0.0, 0.5 * size.z);
    shapes::cuboid(foot - half, foot + half + DVec3::Y * size.y)
}

/// Upright slats under an arch, between two posts; 2.3 m wide.
fn screen() -> Surface {
    let (half_width, rise, spring) = (1.15, 0.62, 1.55);
    let arch = |x: f64| spring + rise * (1.0 - (x / half_width).powi(2)).max(0.0).sqrt();
    let slats = (-5..=5).map(|i| {
        let x = 0.19 * f64::from(i);
        standing(DVec3::new(x, 0.0, 0.0), DVec3::new(0.09, arch(x) + 0.02, 0.025))
    });
    let posts = [-half_width, half_width].map(|x| standing(DVec3::new(x, 0.0, 0.0), DVec3::new(0.1, spring, 0.1)));
    let rails = [0.28, 1.35].map(|y| standing(DVec3::new(0.0, y, 0.032), DVec3::new(2.0 * half_width, 0.07, 0.03)));
    // The arch as short blocks, each turned along the curve.
    let steps = 28;
    let bow = (0..steps).map(|i| {
        let angle = |i: i32| PI * f64::from(i) / f64::from(steps);
        let point = |angle: f64| DVec3::new(-half_width * angle.cos(), spring + rise * angle.sin(), 0.0);
        let (a, b) = (point(angle(i)), point(angle(i + 1)));
        let along = b - a;
        let turn = DMat3::from_rotation_z(along.y.atan2(along.x));
        let half = DVec3::new(0.5 * along.length() + 0.01, 0.045, 0.05);
        shapes::cuboid(-half, half).moved(&DAffine3 { matrix3: turn, translation: 0.5 * (a + b) })
    });
    Surface::joined(slats.chain(posts).chain(rails).chain(bow))
}

/// A shaft between a foot and a slab.
fn plinth() -> Surface {
    Surface::joined([
        standing(DVec3::ZERO, DVec3::new(0.74, 0.09, 0.74)),
        standing(DVec3::new(0.0, 0.09, 0.0), DVec3::new(0.56, 0.77, 0.56)),
        standing(DVec3::new(0.0, 0.86, 0.0), DVec3::new(0.7, 0.08, 0.7)),
    ])
}

/// A spoked wheel that stands on the floor, tilted back a little.
fn wheel() -> Surface {
    let (radius, rim, spokes) = (0.56, 0.028, 18);
    let spoke = |i: i32| {
        let (sin, cos) = (TAU * f64::from(i) / f64::from(spokes)).sin_cos();
        // Spokes start on either end of the hub by turns.
        let start = DVec3::new(0.04 * cos, if i % 2 == 0 { 0.05 } else { -0.05 }, 0.04 * sin);
        shapes::tube(&[start, DVec3::new(radius * cos, 0.0, radius * sin)], 0.006, 6, false)
    };
    let hub = shapes::tube(&[DVec3::Y * -0.09, DVec3::Y * 0.09], 0.045, 20, false);
    let flat = Surface::joined([shapes::torus(radius, rim, 96, 12), hub].into_iter().chain((0..spokes).map(spoke)));
    let lean = 0.14f64;
    let upright = DMat3::from_rotation_x(0.5 * PI - lean);
    flat.moved(&DAffine3 { matrix3: upright, translation: DVec3::Y * (radius * lean.cos() + rim) })
}

/// A ring in mid-air, tilted.
fn ring() -> Surface {
    let tilt = DMat3::from_rotation_z(-0.35) * DMat3::from_rotation_x(0.3);
    shapes::torus(0.4, 0.045, 96, 20).moved(&DAffine3 { matrix3: tilt, translation: DVec3::new(-0.15, 1.75, 0.55) })
}

/// Two stacked blocks, one beside them and a board that leans on the stack.
fn blocks() -> Surface {
    let turned = |surface: Surface, degrees: f64| surface.moved(&placed(DVec3::ZERO, degrees));
    // The board's foot is on the floor and its back on the upper block's edge.
    let board = shapes::cuboid(DVec3::new(-0.035, 0.0, -0.14), DVec3::new(0.0, 0.86, 0.14));
    let lean = DMat3::from_rotation_z(-0.42);
    Surface::joined([
        standing(DVec3::ZERO, DVec3::new(0.62, 0.26, 0.4)),
        turned(standing(DVec3::new(0.0, 0.26, 0.0), DVec3::new(0.34, 0.24, 0.3)), 31.0),
        standing(DVec3::new(0.2, 0.0, 0.52), DVec3::new(0.2, 0.2, 0.2)),
        board.moved(&DAffine3 { matrix3: lean, translation: DVec3::new(-0.447, 0.0, 0.02) }),
    ])
}

/// A bent wire: a helix that rises from the floor and tapers.
fn wire() -> Surface {
    let steps = 220;
    let path: Vec<DVec3> = (0..=steps)
        .map(|i| {
            let t = f64::from(i) / f64::from(steps);
            let (sin, cos) = (3.5 * TAU * t).sin_cos();
            let radius = 0.3 * (1.0 - 0.75 * t);
            DVec3::new(radius * cos, 0.008 + 1.5 * t.powf(1.15), radius * sin)
        })
        .collect();
    shapes::tube(&path, 0.008, 6, false)
}

const POT_AT: DVec3 = DVec3::new(-1.85, 0.0, 1.55);

/// A flower pot with earth in it.
fn pot() -> Surface {
    let profile =
        [(0.0, 0.0), (0.15, 0.0), (0.21, 0.3), (0.235, 0.3), (0.24, 0.36), (0.2, 0.36), (0.19, 0.31), (0.0, 0.31)];
    shapes::lathe(&profile.map(|(radius, height)| DVec2::new(radius, height)), 48)
}

/// The stems: direction they lean to (radians), how far out and how high they end, m.
const STEMS: [[f64; 3]; 9] = [
    [0.2, 0.10, 1.30],
    [1.0, 0.24, 1.05],
    [1.8, 0.15, 1.18],
    [2.5, 0.30, 0.92],
    [3.3, 0.22, 1.10],
    [4.0, 0.30, 0.80],
    [4.7, 0.20, 0.98],
    [5.4, 0.32, 0.74],
    [6.0, 0.27, 0.88],
];

/// A stem's course from the earth to its end.
fn stem_at([direction, out, height]: [f64; 3], t: f64) -> DVec3 {
    let (sin, cos) = direction.sin_cos();
    let reach = 0.04 + out * t * t;
    DVec3::new(reach * cos, 0.3 + (height - 0.3) * t, reach * sin)
}

fn stems() -> Surface {
    Surface::joined(STEMS.map(|stem| {
        let path: Vec<DVec3> = (0..=10).map(|i| stem_at(stem, f64::from(i) / 10.0)).collect();
        shapes::tube(&path, 0.008, 6, false)
    }))
}

/// Leaves along the upper part of each stem, turned by the golden angle from one to the next.
fn leaves() -> Vec<DAffine3> {
    let golden_angle = PI * (3.0 - 5f64.sqrt());
    STEMS
        .iter()
        .enumerate()
        .flat_map(|(i, &stem)| {
            [0.45, 0.62, 0.78, 0.9, 1.0].into_iter().enumerate().map(move |(j, t)| {
                let turn = stem[0] + golden_angle * (i + 3 * j) as f64;
                let size = 0.46 - 0.2 * t;
                DAffine3 {
                    // Up at first; the leaf bends down by itself.
                    matrix3: DMat3::from_rotation_y(turn) * DMat3::from_rotation_x(-0.5) * size,
                    translation: POT_AT + stem_at(stem, t),
                }
            })
        })
        .collect()
}
