//! The exact reference against the closed forms C1 to C9, worked out from the `f32` vertices that the scene holds and the
//! receiver that was asked.

mod common;

use std::f64::consts::PI;
use std::path::Path;

use assert_cmd::Command;
use common::*;
use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3};
use penumbra::closed_forms::{
    centered_rect_solid_angle, disk_edge_fraction, lambert_form_factor, lens_area, polygon_in_unit_disc_area,
    rect_edge_fraction, rect_form_factor, rect_occluder_form_factor, rect_occluder_visibility, shadow_mass,
    strip_blocked_fraction, strip_mass,
};
use penumbra::geometry::bvh::SceneBvh;
use penumbra::image::read_exr;
use penumbra::progress::Progress;
use penumbra::receivers::Receivers;
use penumbra::reference::exact::Answer;
use penumbra::scene::camera::aimed;
use penumbra::scene::light::{Domain, Emitter};
use penumbra::scene::procedural::build;
use penumbra::scene::{AreaLight, Emission, Scene, Shape};

/// What rounding may leave of V: coordinates in units of the light's half side are good to some 1e-16 · (scene/light) · (H/h),
/// here at most 10 · 10, and a few of them add up. Found: 5e-15; with edges of 60 m, 4e-14.
const ROUNDING: f64 = 1e-13;

/// A light, what hides it, and one receiver on the floor that looks up.
struct Setup {
    scene: Scene,
    /// The receiver, world space.
    position: DVec3,
    /// What was found.
    answer: Answer,
}

impl Setup {
    fn new(light: AreaLight, triangles: &[[[f32; 3]; 3]], position: DVec3) -> Self {
        let scene = scene(vec![mesh(triangles)], vec![light]);
        let answer = exact(&scene, &receivers(&scene, &[position], DVec3::Y))[0][0];
        assert!(!answer.sampled);
        Self { scene, position, answer }
    }

    /// The light as the receiver sees it.
    fn emitter(&self) -> Emitter {
        self.scene.lights[0].emitter(self.position - self.scene.origin_world).expect("faces the receiver")
    }

    /// A corner of the caster as the receiver sees it.
    fn to(&self, corner: [f32; 3]) -> DVec3 {
        Vec3::from(corner).as_dvec3() - self.position
    }

    /// The share of the way to the light's plane at which a corner lies; of a sun's, only its sign counts.
    fn share(&self, emitter: &Emitter, corner: [f32; 3]) -> f64 {
        emitter.normal.dot(self.to(corner)) / emitter.normal.dot(emitter.center)
    }

    /// Whether a corner lies strictly between the receiver and the light's plane.
    fn is_between(&self, emitter: &Emitter, corner: [f32; 3]) -> bool {
        let share = self.share(emitter, corner);
        share > 0.0 && (emitter.distant || share < 1.0)
    }

    /// The image of a polygon on the light, in its half axes, where that is convex and whole: corners that floats bend out of
    /// their plane are not when seen edge-on.
    fn convex_image(&self, emitter: &Emitter, corners: &[[f32; 3]]) -> Option<Vec<DVec2>> {
        if !corners.iter().all(|&corner| self.is_between(emitter, corner)) {
            return None;
        }
        let image = |&corner: &[f32; 3]| {
            let offset = self.to(corner) / self.share(emitter, corner) - emitter.center;
            let along = |half: DVec3| offset.dot(half) / half.length_squared();
            DVec2::new(along(emitter.half_u), along(emitter.half_v))
        };
        let polygon: Vec<DVec2> = corners.iter().map(image).collect();
        let at = |i: usize| polygon[i % polygon.len()];
        let turn = |i: usize| (at(i + 1) - at(i)).perp_dot(at(i + 2) - at(i + 1));
        let is_convex = (0..polygon.len()).all(|i| turn(i) * turn(0) > 0.0);
        is_convex.then_some(polygon)
    }

    /// The plane through the receiver and two corners: V of what it leaves of the light on the side away from `inside`, which
    /// is C2 for a rectangle and C4 for a disk.
    fn beyond_edge(&self, emitter: &Emitter, [a, b]: [[f32; 3]; 2], inside: [f32; 3]) -> f64 {
        let along = Vec3::from(b).as_dvec3() - Vec3::from(a).as_dvec3();
        let normal = self.to(a).cross(along);
        let normal = if normal.dot(self.to(inside)) > 0.0 { normal } else { -normal };
        let support = DVec2::new(normal.dot(emitter.half_u), normal.dot(emitter.half_v));
        let distance = -normal.dot(emitter.center);
        match emitter.domain {
            Domain::Disk => disk_edge_fraction(distance / support.length()),
            _ => rect_edge_fraction(distance, support.abs()),
        }
    }
}

#[track_caller]
fn close(found: f64, expected: f64, tolerance: f64, what: &str) {
    assert!((found - expected).abs() <= tolerance, "{what}: {found} for {expected}, off by {:e}", found - expected);
}

/// A number, as the float nearest to it.
fn rounded(random: &mut Random, low: f64, high: f64) -> f32 {
    random.between(low, high) as f32
}

/// Two triangles over the corners of a quadrangle.
fn two_triangles([a, b, c, d]: [[f32; 3]; 4]) -> [[[f32; 3]; 3]; 2] {
    [[a, b, c], [a, c, d]]
}

/// A rectangle above the floor that faces straight down: half sides, height.
fn level_rect(random: &mut Random) -> (AreaLight, DVec2, f64) {
    let half = DVec2::new(random.between(0.2, 2.0), random.between(0.2, 2.0));
    let height = random.between(3.0, 8.0);
    (light_down(Shape::Rect { size: 2.0 * half }, [0.0, height, 0.0]), half, height)
}

/// A flat light above the floor, tilted by up to some 45°, or a sun.
fn tilted(random: &mut Random, shape: &str) -> AreaLight {
    let size = DVec2::new(random.between(0.4, 4.0), random.between(0.4, 4.0));
    let shape = match shape {
        "rect" => Shape::Rect { size },
        "disk" => Shape::Disk { size: DVec2::splat(size.x) },
        "ellipse" => Shape::Disk { size },
        "sphere" => Shape::Sphere { radius: 0.5 * size.x, facing: false },
        "facing sphere" => Shape::Sphere { radius: 0.5 * size.x, facing: true },
        "tube" => Shape::Tube { length: size.x, radius: 0.25 * size.y },
        _ => Shape::Sun { angle: 0.2 * size.x },
    };
    let at = DVec3::new(random.between(-1.0, 1.0), random.between(5.0, 8.0), random.between(-1.0, 1.0));
    let axis = DVec3::NEG_Y + random.in_cube(0.5);
    AreaLight::new("light", DAffine3 { matrix3: aimed(axis, random.direction()), translation: at }, shape)
}

const RECTS: [&str; 2] = ["rect", "tube"];
const DISKS: [&str; 5] = ["disk", "ellipse", "sphere", "facing sphere", "sun"];

fn on_floor(random: &mut Random, reach: f64) -> DVec3 {
    DVec3::new(random.between(-reach, reach), 0.0, random.between(-reach, reach))
}

/// An axis-aligned rectangle of rounded corners: centre and half sides are those of the floats.
fn level_caster(random: &mut Random, height: f64) -> (Vec<[[f32; 3]; 3]>, DVec2, DVec2, f64) {
    let mut range = || {
        let middle = random.between(-0.5, 0.5);
        let half = random.between(0.02, 0.8);
        [(middle - half) as f32, (middle + half) as f32]
    };
    let (x, z) = (range(), range());
    let lift = (height * random.between(0.1, 0.9)) as f32;
    let middle = |[low, high]: [f32; 2]| 0.5 * (f64::from(low) + f64::from(high));
    let half = |[low, high]: [f32; 2]| 0.5 * (f64::from(high) - f64::from(low));
    (quad(x, lift, z), DVec2::new(middle(x), middle(z)), DVec2::new(half(x), half(z)), f64::from(lift))
}

#[test]
fn a_rectangle_behind_a_rectangle_is_c1_and_c9() {
    let mut random = Random(1);
    let (mut partial, mut worst) = (0, 0.0f64);
    for case in 0..2000 {
        let (light, half, height) = level_rect(&mut random);
        let (caster, center, caster_half, lift) = level_caster(&mut random, height);
        let position = on_floor(&mut random, 1.5);
        let setup = Setup::new(light, &caster, position);
        let on_plane = DVec2::new(position.x, position.z);
        let expected = rect_occluder_visibility(on_plane, center, caster_half, lift, half, height);
        close(setup.answer.visibility, expected, ROUNDING, &format!("V of case {case}"));
        worst = worst.max((setup.answer.visibility - expected).abs());
        partial += u32::from(expected > 0.0 && expected < 1.0);
        // C8 less C9, of radiance 1.
        let whole = rect_form_factor((-half - on_plane) / height, (half - on_plane) / height);
        let hidden = rect_occluder_form_factor(on_plane, center, caster_half, lift, half, height);
        close(setup.answer.irradiance.x, PI * (whole - hidden), 1e-12, &format!("E of case {case}"));
        // A ratio of two sums, each good to 1e-12 of π.
        let tolerance = 1e-12 / whole;
        close(setup.answer.irradiance_ratio, 1.0 - hidden / whole, tolerance, &format!("E/E₀ of case {case}"));
    }
    assert!(partial > 1000, "only {partial} in a penumbra");
    assert!(worst > 0.0, "as if the closed form were compared with itself");
}

#[test]
fn an_unhidden_rectangle_is_c8() {
    let mut random = Random(2);
    for case in 0..500 {
        let (light, half, height) = level_rect(&mut random);
        let position = on_floor(&mut random, 6.0);
        let setup = Setup::new(light, &quad([-9.0, 9.0], -1.0, [-9.0, 9.0]), position);
        let on_plane = DVec2::new(position.x, position.z);
        let expected = PI * rect_form_factor((-half - on_plane) / height, (half - on_plane) / height);
        assert_eq!(setup.answer.visibility, 1.0);
        close(setup.answer.irradiance.x, expected, 1e-14, &format!("case {case}"));
    }
}

/// Half of a tilted plane behind an edge of any direction, so far out that its other sides hide nothing more: corners of its
/// edge, then of its far side.
fn half_plane(random: &mut Random, height: f64) -> [[f32; 3]; 4] {
    const REACH: f64 = 60.0;
    let normal = (DVec3::Y + random.in_cube(0.3)).normalize();
    let along = normal.cross(random.direction()).normalize();
    let across = normal.cross(along);
    let middle = DVec3::Y * height + random.in_cube(0.3);
    let corner = |a: f64, b: f64| (middle + a * along + b * across).as_vec3().to_array();
    [corner(-REACH, 0.0), corner(REACH, 0.0), corner(REACH, -REACH), corner(-REACH, -REACH)]
}

#[test]
fn a_half_plane_at_any_angle_leaves_c2_c3_and_c4() {
    let mut random = Random(3);
    for shape in RECTS.iter().chain(&DISKS) {
        let mut partial = 0;
        for case in 0..200 {
            let light = tilted(&mut random, shape);
            let lift = random.between(0.6, 1.5);
            let caster = half_plane(&mut random, lift);
            let setup = Setup::new(light, &two_triangles(caster), on_floor(&mut random, 0.7));
            let emitter = setup.emitter();
            // The other three sides must lie beyond the light, or the closed form is of something else.
            let inside = (caster.iter().map(|&corner| Vec3::from(corner)).sum::<Vec3>() / 4.0).to_array();
            let sides = [[caster[1], caster[2]], [caster[2], caster[3]], [caster[3], caster[0]]];
            if sides.into_iter().any(|side| setup.beyond_edge(&emitter, side, inside) > 0.0) {
                continue;
            }
            let expected = setup.beyond_edge(&emitter, [caster[0], caster[1]], caster[2]);
            // Edges reach 60 m, some 300 times the smallest light's half side, and are seen 13 times as large.
            close(setup.answer.visibility, expected, 10.0 * ROUNDING, &format!("{shape} {case}"));
            partial += u32::from(expected > 0.0 && expected < 1.0);
        }
        assert!(partial > 40, "{shape}: only {partial} in a penumbra");
    }
}

#[test]
fn a_half_plane_along_the_light_is_c3() {
    let mut random = Random(4);
    for case in 0..300 {
        let (light, half, height) = level_rect(&mut random);
        let (edge, lift) = (rounded(&mut random, -0.5, 0.5), (height * random.between(0.1, 0.9)) as f32);
        let position = on_floor(&mut random, 1.0);
        let setup = Setup::new(light, &quad([-200.0, edge], lift, [-200.0, 200.0]), position);
        let expected =
            penumbra::closed_forms::half_plane_visibility(position.x, f64::from(edge), f64::from(lift), half.x, height);
        close(setup.answer.visibility, expected, ROUNDING, &format!("case {case}"));
    }
}

#[test]
fn a_strip_however_thin_is_c7() {
    let mut random = Random(5);
    for case in 0..500 {
        let (light, half, height) = level_rect(&mut random);
        let width = 10f64.powf(random.between(-7.0, 0.0));
        let middle = random.between(-0.3, 0.3);
        // Floats around zero are dense enough for any width.
        let x = [(middle - 0.5 * width) as f32, (middle + 0.5 * width) as f32];
        let lift = (height * random.between(0.2, 0.9)) as f32;
        let position = on_floor(&mut random, 0.5);
        let setup = Setup::new(light, &quad(x, lift, [-200.0, 200.0]), position);
        let [low, high] = x.map(f64::from);
        let blocked = strip_blocked_fraction(position.x, 0.5 * (low + high), high - low, lift.into(), half.x, height);
        close(1.0 - setup.answer.visibility, blocked, ROUNDING, &format!("case {case}, width {width:e}"));
    }
}

#[test]
fn a_tilted_strip_is_the_difference_of_two_edges() {
    let mut random = Random(6);
    for shape in RECTS.iter().chain(&DISKS) {
        let mut partial = 0;
        for case in 0..100 {
            let light = tilted(&mut random, shape);
            let middle = DVec3::new(0.0, random.between(0.7, 1.5), 0.0) + random.in_cube(0.3);
            let along = DVec3::new(random.between(-1.0, 1.0), 0.0, random.between(-1.0, 1.0)).normalize();
            let across = along.cross(DVec3::Y + random.in_cube(0.3)).normalize();
            let half = 10f64.powf(random.between(-4.0, -0.5));
            let corner = |a: f64, b: f64| (middle + a * along + b * half * across).as_vec3().to_array();
            let caster = [corner(-60.0, -1.0), corner(60.0, -1.0), corner(60.0, 1.0), corner(-60.0, 1.0)];
            let setup = Setup::new(light, &two_triangles(caster), on_floor(&mut random, 0.7));
            let emitter = setup.emitter();
            let [a, b, c, d] = caster;
            // Seen from either edge the strip lies inside; what is left beyond both is what is seen.
            let expected = setup.beyond_edge(&emitter, [a, b], c) + setup.beyond_edge(&emitter, [c, d], a);
            close(setup.answer.visibility, expected, 10.0 * ROUNDING, &format!("{shape} {case}"));
            partial += u32::from(expected < 1.0 && expected > 0.0);
        }
        assert!(partial > 30, "{shape}: only {partial} in a penumbra");
    }
}

#[test]
fn a_disc_behind_a_polygon_is_its_own_lens() {
    let mut random = Random(7);
    for shape in DISKS {
        let mut partial = 0;
        for case in 0..150 {
            let light = tilted(&mut random, shape);
            let count = 3 + random.below(60);
            let (radius, phase) = (random.between(0.05, 0.6), random.between(0.0, 1.0));
            let middle = DVec3::new(0.0, random.between(0.7, 2.5), 0.0) + random.in_cube(0.3);
            let [e1, e2] = {
                let normal = (DVec3::Y + random.in_cube(0.7)).normalize();
                let (a, b) = normal.any_orthonormal_pair();
                [a, b]
            };
            let corner = |i: usize| {
                let at = DVec2::from_angle(2.0 * PI * (i as f64 + phase) / count as f64);
                (middle + radius * (at.x * e1 + at.y * e2)).as_vec3().to_array()
            };
            let fan: Vec<_> = (1..count - 1).map(|i| [corner(0), corner(i), corner(i + 1)]).collect();
            let setup = Setup::new(light, &fan, on_floor(&mut random, 0.7));
            let emitter = setup.emitter();
            let corners: Vec<_> = (0..count).map(corner).collect();
            let Some(image) = setup.convex_image(&emitter, &corners) else { continue };
            let expected = 1.0 - polygon_in_unit_disc_area(&image) / PI;
            close(setup.answer.visibility, expected, ROUNDING, &format!("{shape} {case}"));
            partial += u32::from(expected < 1.0 && expected > 0.0);
        }
        assert!(partial > 40, "{shape}: only {partial} in a penumbra");
    }
}

#[test]
fn a_disc_behind_a_polygon_of_many_corners_tends_to_c5() {
    let (radius, lift, height, light_radius) = (0.5, 2.0, 5.0, 1.0);
    let light = light_down(Shape::Disk { size: DVec2::splat(2.0 * light_radius) }, [0.0, height, 0.0]);
    let count = 1 << 14;
    let corner = |i: usize| {
        let at = DVec2::from_angle(2.0 * PI * i as f64 / f64::from(count));
        (radius * DVec3::new(at.x, lift / radius, at.y)).as_vec3().to_array()
    };
    let fan: Vec<_> = (1..count as usize - 1).map(|i| [corner(0), corner(i), corner(i + 1)]).collect();
    for x in [0.0, 0.1, 0.4, 0.8, 1.2, 1.45] {
        let setup = Setup::new(light.clone(), &fan, DVec3::new(x, 0.0, 0.1));
        let k = height / lift;
        let offset = DVec2::new(x, 0.1).length() * (k - 1.0);
        let expected = 1.0 - lens_area(light_radius, radius * k, offset) / (PI * light_radius * light_radius);
        // The n-gon lacks 2π²/3n² of its disc, which is (2.5/2)² of the light; corners are rounded by 2⁻²⁵, their images
        // reach k/R times as far, around π of the light's area at the most.
        let lack = (radius * k).powi(2) * 2.0 * PI * PI / (3.0 * f64::from(count).powi(2));
        let rounding = 2.0 * k * radius * k * 2f64.powi(-25);
        close(setup.answer.visibility, expected, lack + rounding, &format!("x = {x}"));
    }
}

#[test]
fn irradiance_of_any_receiver_is_lamberts_polygon() {
    // Rect lights, tilted as they come, behind a tilted quadrangle: the hidden polygon's form factor less the whole one's.
    let mut random = Random(8);
    let mut partial = 0;
    for case in 0..500 {
        let light = tilted(&mut random, "rect");
        let middle = DVec3::new(0.0, random.between(0.7, 2.5), 0.0) + random.in_cube(0.3);
        let (u, v) = (DVec3::Y + random.in_cube(0.7)).normalize().any_orthonormal_pair();
        let half = random.between(0.05, 0.6);
        let corner = |a: f64, b: f64| (middle + half * (a * u + b * v)).as_vec3().to_array();
        let caster = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
        let setup = Setup::new(light, &two_triangles(caster), on_floor(&mut random, 0.7));
        let emitter = setup.emitter();
        let Some(image) = setup.convex_image(&emitter, &caster) else { continue };
        let turn = (image[1] - image[0]).perp_dot(image[2] - image[1]).signum();
        // The square clipped to each side of the image.
        let square = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(DVec2::from).to_vec();
        let hidden = (0..4).fold(square.clone(), |polygon, i| {
            let (a, b) = (image[i], image[(i + 1) % 4]);
            penumbra::closed_forms::clip_polygon(&polygon, |uv| turn * (b - a).perp_dot(uv - a))
        });
        let factor = |polygon: &[DVec2]| {
            let corners: Vec<DVec3> = polygon.iter().map(|&uv| emitter.at(uv)).collect();
            lambert_form_factor(&corners, DVec3::Y)
        };
        let expected = PI * (factor(&square) - factor(&hidden));
        close(setup.answer.irradiance.x, expected, 1e-12, &format!("case {case}"));
        partial += u32::from(hidden.len() > 2 && expected > 0.0);
    }
    assert!(partial > 200, "only {partial} hidden in part");
}

#[test]
fn the_emitter_of_a_rectangle_has_its_solid_angle() {
    // Van Oosterom and Strackee 1983, "The solid angle of a plane triangle".
    let triangle = |[a, b, c]: [DVec3; 3]| {
        let (la, lb, lc) = (a.length(), b.length(), c.length());
        let below = la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb;
        2.0 * a.dot(b.cross(c)).abs().atan2(below)
    };
    let mut random = Random(9);
    for case in 0..500 {
        let half = DVec2::new(random.between(0.01, 20.0), random.between(0.01, 20.0));
        let height = random.between(0.5, 8.0);
        let turn = random.rotation();
        let at = random.in_cube(5.0);
        let light =
            AreaLight::new("light", DAffine3 { matrix3: turn, translation: at }, Shape::Rect { size: 2.0 * half });
        let emitter = light.emitter(at - height * turn.z_axis).expect("faces the receiver");
        let [a, b, c, d] = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|uv| emitter.at(uv.into()));
        let found = triangle([a, b, c]) + triangle([a, c, d]);
        close(found, centered_rect_solid_angle(half, height), 1e-12, &format!("case {case}"));
    }
}

/// The sum of 1 − V over a grid of receivers around the origin, times a cell.
fn mass(scene: &Scene, [reach_x, reach_z]: [f64; 2], [columns, rows]: [usize; 2]) -> f64 {
    let at = |i: usize, count: usize, reach: f64| reach * ((2.0 * i as f64 + 1.0) / count as f64 - 1.0);
    let points: Vec<DVec3> = (0..columns * rows)
        .map(|i| DVec3::new(at(i % columns, columns, reach_x), 0.0, at(i / columns, rows, reach_z)))
        .collect();
    let cell = 4.0 * reach_x * reach_z / (columns * rows) as f64;
    exact_visibility(scene, &points).iter().map(|v| 1.0 - v).sum::<f64>() * cell
}

#[test]
fn the_mass_of_a_shadow_is_c6_for_every_light_parallel_to_it() {
    let mut random = Random(10);
    let (lift, height) = (2.0f32, 5.0);
    // A triangle and a quadrangle that overlap in nothing.
    let caster = [
        [[0.1, lift, 0.0], [0.9, lift, 0.2], [0.3, lift, 0.8]],
        [[-0.8, lift, -0.5], [-0.1, lift, -0.7], [-0.2, lift, 0.4]],
    ];
    let area: f64 = caster
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|p| Vec3::from(p).as_dvec3());
            0.5 * (b - a).cross(c - a).length()
        })
        .sum();
    let flat = [
        Shape::Rect { size: DVec2::new(1.3, 0.8) },
        Shape::Rect { size: DVec2::splat(0.4) },
        Shape::Disk { size: DVec2::splat(1.1) },
        Shape::Disk { size: DVec2::new(0.6, 1.4) },
    ];
    for shape in flat {
        let mut light = light_down(shape, [0.05, height, -0.03]);
        let turn = DMat3::from_rotation_y(random.between(0.0, 3.0));
        light.scene_from_light.matrix3 = turn * light.scene_from_light.matrix3;
        let found = mass(&scene(vec![mesh(&caster)], vec![light]), [3.0; 2], [300; 2]);
        let expected = shadow_mass(area, f64::from(lift), height);
        close(found / expected, 1.0, 1e-4, &format!("{shape:?}"));
    }
    // From a sun, however low, the mass is the caster's area: each of its directions casts as much.
    for (angle, tilt) in [(0.2, 0.0), (0.3, 0.4)] {
        let mut light = light_down(Shape::Sun { angle }, [0.0; 3]);
        light.scene_from_light.matrix3 = DMat3::from_rotation_z(tilt) * light.scene_from_light.matrix3;
        let found = mass(&scene(vec![mesh(&caster)], vec![light]), [3.0; 2], [300; 2]);
        close(found / area, 1.0, 1e-4, &format!("sun of {angle} at {tilt}"));
    }
    // A tilted light is parallel to nothing, but each of its points casts C6 for its own height H: over a square of half side
    // l tilted by t, H² / (H − h)² is averaged over H ± l sin t.
    let (half, tilt) = (0.6, 0.5f64);
    let mut light = square_light(half, height);
    light.scene_from_light.matrix3 = DMat3::from_rotation_z(tilt) * light.scene_from_light.matrix3;
    let found = mass(&scene(vec![mesh(&caster)], vec![light]), [3.0; 2], [300; 2]);
    let (low, high) = (height - half * tilt.sin(), height + half * tilt.sin());
    // ∫H²/(H − h)² dH = H + 2h·ln(H − h) − h²/(H − h).
    let h = f64::from(lift);
    let integral = |x: f64| x + 2.0 * h * (x - h).ln() - h * h / (x - h);
    close(found / (area * (integral(high) - integral(low)) / (high - low)), 1.0, 1e-4, "tilted");
}

#[test]
fn the_mass_of_a_strip_does_not_depend_on_its_thinness() {
    // Per length, along a line of receivers across it. The steps are a whole number of the light's image's 1000th part.
    for width in [0.3f32, 1e-3, 1e-6] {
        let x = [-0.5 * width, 0.5 * width];
        let scene = scene(vec![mesh(&quad(x, 2.0, [-90.0, 90.0]))], vec![square_light(0.5, 5.0)]);
        let (reach, count) = (1.0, 20_000);
        let points: Vec<DVec3> = (0..count)
            .map(|i| DVec3::new(reach * ((2.0 * f64::from(i) + 1.0) / f64::from(count) - 1.0), 0.0, 0.01))
            .collect();
        let step = 2.0 * reach / f64::from(count);
        let found: f64 = exact_visibility(&scene, &points).iter().map(|v| (1.0 - v) * step).sum();
        let expected = strip_mass(f64::from(width), 2.0, 5.0);
        // A thin strip's ψ is a box of width 2l·h/(H − h) = ⅔: either end errs by half a step.
        close(found / expected, 1.0, step / (2.0 / 3.0) + 1e-4, &format!("width {width:e}"));
    }
}

/// Runs the exact reference; the image it writes.
fn reference(spec: &str, directory: &Path) -> penumbra::image::Image {
    let path = directory.join("exact.exr");
    let mut command = Command::cargo_bin("penumbra").expect("the binary");
    command.args(["reference", spec, "--method", "exact", "--size", "24x20", "--quantity", "irradiance"]);
    command.arg("-o").arg(&path).current_dir(directory).assert().success();
    read_exr(&path).expect("an image")
}

#[test]
fn the_image_that_the_command_line_writes_holds_the_closed_forms() {
    let directory = tempfile::tempdir().expect("a directory");
    let specs = [
        "square?x=0.1&z=-0.2&shape=SHAPE",
        "edge?angle=20&x=0.013&shape=SHAPE",
        "disks?x=0.013&z=0.007&shape=SHAPE",
        "strip?width=0.2&angle=30&shape=SHAPE",
        "strip?width=0.001&angle=70&shape=SHAPE",
        "two-edges?x=0.013&shape=SHAPE",
        "square?light=2.5&view=6&shape=SHAPE",
        "corner?occluder=0.2",
        "corner?occluder=0.7&light=4",
    ];
    for spec in specs {
        let shapes: &[&str] = if spec.contains("SHAPE") { &["rect", "disk", "sphere", "tube", "sun"] } else { &[""] };
        for shape in shapes {
            let spec = format!("procedural:{}", spec.replace("SHAPE", shape));
            let image = reference(&spec, directory.path());
            let procedural = build(spec.trim_start_matches("procedural:")).expect("builds");
            let scene = &procedural.scene;
            let truth = procedural.truth.as_ref().expect("has a truth");
            let mut bvh = SceneBvh::new(scene);
            bvh.add(|_| true);
            let middle = DVec2::splat(0.5);
            let receivers =
                Receivers::find(&bvh, &scene.cameras[0], [24, 20], middle, &Progress::default()).expect("found");
            let light = &image.light_names()[0];
            let visibility = image.visibility(light).expect("V");
            let irradiance = image.irradiance(light).expect("E");
            let mut partial = 0;
            for (i, receiver) in receivers.pixels.iter().enumerate() {
                let position_world =
                    receiver.as_ref().expect("the receiver fills the view").position + scene.origin_world;
                let expected = truth.visibility(position_world);
                close(f64::from(visibility[i]), expected, 2e-6, &format!("V of {spec}, pixel {i}"));
                partial += u32::from(expected > 0.0 && expected < 1.0);
                if let Some([_, visible]) = truth.form_factors(position_world) {
                    let Emission::Radiance(radiance) = scene.lights[0].emission else { panic!("a rect has radiance") };
                    for channel in 0..3 {
                        let expected = PI * radiance[channel] * visible;
                        // The light gives about π, so that this is relative to what is not hidden.
                        close(
                            f64::from(irradiance[channel][i]),
                            expected,
                            2e-6 * PI,
                            &format!("E of {spec}, pixel {i}"),
                        );
                    }
                }
            }
            assert!(partial > 10, "{spec}: only {partial} in a penumbra");
            assert!(image.sampled(light).expect("a layer").iter().all(|&sampled| sampled == 0.0));
        }
    }
}
