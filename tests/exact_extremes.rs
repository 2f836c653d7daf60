//! Numerical extremes: what the exact reference must return at the edges of floating-point, size and shape. Scale, threads and
//! geometry told differently: `exact_invariance`.

mod common;

use std::f64::consts::PI;

use common::*;
use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3};
use penumbra::closed_forms::{
    clip_polygon, half_plane_visibility, lambert_form_factor, penumbra_width, polygon_area, rect_form_factor,
    rect_occluder_form_factor, rect_occluder_visibility,
};
use penumbra::geometry::bvh::SceneBvh;
use penumbra::geometry::irradiance::unshadowed;
use penumbra::progress::Progress;
use penumbra::receivers::{Receiver, Receivers};
use penumbra::reference::exact::Answer;
use penumbra::scene::camera::{Camera, Projection, look_at};
use penumbra::scene::{AreaLight, Mesh, Scene, Shape};

/// The answers of a scene's first light.
fn answers(scene: &Scene, positions: &[DVec3], normal: DVec3) -> Vec<Answer> {
    exact(scene, &receivers(scene, positions, normal)).swap_remove(0)
}

fn answer(scene: &Scene, position: DVec3) -> Answer {
    answers(scene, &[position], DVec3::Y)[0]
}

#[track_caller]
fn close(found: f64, expected: f64, tolerance: f64, what: &str) {
    assert!((found - expected).abs() <= tolerance, "{what}: {found} for {expected}, off by {:e}", found - expected);
}

/// V is a fraction, E a number of at most E₀, and neither is anything without the other. A huge light's V may round to 1 though
/// what is hidden matters to E.
#[track_caller]
fn is_sound(answer: &Answer, whole: DVec3, what: &str) {
    let Answer { visibility, irradiance, .. } = *answer;
    assert!((0.0..=1.0).contains(&visibility), "{what}: {answer:?}");
    assert!(irradiance.is_finite() && irradiance.cmpge(DVec3::ZERO).all(), "{what}: {answer:?}");
    assert!(irradiance.cmple(whole).all(), "{what}: {answer:?} above E₀ = {whole}");
    if visibility == 0.0 {
        assert_eq!(irradiance, DVec3::ZERO, "{what}: {answer:?} is dark");
    }
    if answer.triangles == 0 && answer.rays == 0 {
        assert_eq!(irradiance, whole, "{what}: {answer:?} is lit");
    }
}

#[test]
fn a_light_of_no_size_casts_the_hard_shadow() {
    let points = line(-2.0, 2.0, 400);
    // C3: the shadow's edge is at ½ · H/(H − h), which no point is near.
    let hard: Vec<f64> = points.iter().map(|p| if p.x.abs() < 0.5 * 5.0 / 3.0 { 0.0 } else { 1.0 }).collect();
    let at = [0.0, 5.0, 0.0];
    assert_eq!(exact_visibility(&square_under(light_down(Shape::Point, at)), &points), hard);
    for half in [0.0, 1e-300, 1e-30, 1e-15, 1e-12] {
        let size = DVec2::splat(2.0 * half);
        let shapes = [
            Shape::Rect { size },
            Shape::Disk { size },
            Shape::Rect { size: DVec2::new(0.0, size.y) },
            Shape::Disk { size: DVec2::new(size.x, 0.0) },
            Shape::Sphere { radius: half, facing: false },
            Shape::Sphere { radius: half, facing: true },
            Shape::Tube { length: 2.0 * half, radius: half },
        ];
        for shape in shapes {
            let scene = square_under(light_down(shape, at));
            assert_eq!(exact_visibility(&scene, &points), hard, "{shape:?}");
            for (receiver, answer) in
                receivers(&scene, &points, DVec3::Y).hits().zip(answers(&scene, &points, DVec3::Y))
            {
                assert!(answer.facing);
                is_sound(&answer, unshadowed(&scene.lights[0], receiver), &format!("{shape:?}"));
            }
        }
        // A sun's shadow is as wide as its caster.
        let scene = square_under(light_down(Shape::Sun { angle: 2.0 * half }, [0.0; 3]));
        let hard: Vec<f64> = points.iter().map(|p| if p.x.abs() < 0.5 { 0.0 } else { 1.0 }).collect();
        assert_eq!(exact_visibility(&scene, &points), hard, "sun of {half}");
    }
}

#[test]
fn a_light_of_no_width_is_a_line() {
    // C3 along the line: a rect or tube without width has no area, but V is the fraction of what there is.
    for width in [0.0, 1e-300, 1e-20, 1e-9] {
        for shape in [Shape::Rect { size: DVec2::new(1.0, width) }, Shape::Tube { length: 1.0, radius: 0.5 * width }] {
            let scene =
                scene(vec![mesh(&quad([-9.0, 0.0], 2.0, [-9.0, 9.0]))], vec![light_down(shape, [0.0, 5.0, 0.0])]);
            for x in [-0.5, -0.2, -0.1, 0.0, 0.125, 0.3, 0.5] {
                let found = answer(&scene, DVec3::new(x, 0.0, 0.0));
                close(found.visibility, half_plane_visibility(x, 0.0, 2.0, 0.5, 5.0), 1e-14, &format!("{shape:?}"));
                let receiver = *receivers(&scene, &[DVec3::new(x, 0.0, 0.0)], DVec3::Y).hits().next().expect("one");
                is_sound(&found, unshadowed(&scene.lights[0], &receiver), &format!("{shape:?} at {x}"));
            }
        }
    }
}

#[test]
fn a_light_of_endless_size_is_blocked_by_its_share() {
    let (caster, height, lift) = (DVec2::splat(0.5), 5.0, 2.0);
    for half in [5e3, 5e6, 5e9] {
        let scene = square_under(square_light(half, height));
        for x in [0.0, 0.3, 2.0] {
            let found = answer(&scene, DVec3::new(x, 0.0, 0.0));
            let (at, light_half) = (DVec2::new(x, 0.0), DVec2::splat(half));
            let expected = rect_occluder_visibility(at, DVec2::ZERO, caster, lift, light_half, height);
            close(found.visibility, expected, 2.0 * f64::EPSILON, &format!("V of {half} at {x}"));
            // C8 less C9: the light's horizon gives π, the caster what is its own, however little of the light it is.
            let whole = rect_form_factor((-light_half - at) / height, (light_half - at) / height);
            let hidden = rect_occluder_form_factor(at, DVec2::ZERO, caster, lift, light_half, height);
            assert!(hidden > 0.01);
            close(found.irradiance.x, PI * (whole - hidden), 1e-9 * PI, &format!("E of {half} at {x}"));
        }
    }
}

#[test]
fn an_occluder_in_the_plane_of_the_light_does_not_block() {
    let points = line(-2.0, 2.0, 50);
    for shape in [Shape::Rect { size: DVec2::splat(2.0) }, Shape::Disk { size: DVec2::new(2.0, 1.0) }] {
        let lid_at = |height: f32| {
            scene(vec![mesh(&quad([-9.0, 9.0], height, [-9.0, 9.0]))], vec![light_down(shape, [0.0, 5.0, 0.0])])
        };
        let open = lid_at(-1.0);
        assert_eq!(answers(&lid_at(5.0), &points, DVec3::Y).len(), 50);
        for (a, b) in answers(&lid_at(5.0), &points, DVec3::Y).iter().zip(answers(&open, &points, DVec3::Y)) {
            assert_eq!((a.visibility, a.irradiance), (1.0, b.irradiance));
        }
        // A float above it neither; one below it blocks all.
        assert!(exact_visibility(&lid_at(5f32.next_up()), &points).iter().all(|&v| v == 1.0));
        assert!(exact_visibility(&lid_at(5f32.next_down()), &points).iter().all(|&v| v == 0.0));
    }
}

#[test]
fn an_occluder_in_the_plane_of_a_tilted_light_does_not_block() {
    // Placed by the light's own transform, it is in its plane but for the rounding of that.
    let mut random = Random(3);
    for case in 0..200 {
        let mut light = random.light(["rect", "disk", "ellipse"][case % 3]);
        light.scene_from_light.translation = DVec3::new(0.3, 4.0, 0.1) + random.in_cube(0.5);
        let pose = DAffine3 {
            matrix3: penumbra::scene::camera::aimed(DVec3::NEG_Y + random.in_cube(0.5), random.direction()),
            translation: light.scene_from_light.translation,
        };
        light.scene_from_light = pose;
        let square = [[-3.0, -3.0, 0.0], [3.0, -3.0, 0.0], [3.0, 3.0, 0.0], [-3.0, 3.0, 0.0f32]];
        let caster = mesh(&[[square[0], square[1], square[2]], [square[0], square[2], square[3]]]);
        let scene = placed_scene(vec![caster], pose, vec![light]);
        let points: Vec<DVec3> = (0..10).map(|_| DVec3::new(0.0, -0.2, 0.0) + random.in_cube(0.5)).collect();
        for (receiver, found) in receivers(&scene, &points, DVec3::Y).hits().zip(answers(&scene, &points, DVec3::Y)) {
            assert_eq!(found.visibility, 1.0, "case {case}");
            assert_eq!(found.irradiance, unshadowed(&scene.lights[0], receiver), "case {case}");
        }
    }
}

#[test]
fn an_occluder_approaching_the_light_hides_its_own_share() {
    for k in 2..=22 {
        let height = 5.0 * (1.0 - 2f32.powi(-k));
        let scene = scene(vec![mesh(&quad([-0.25, 0.25], height, [-0.125, 0.375]))], vec![square_light(0.5, 5.0)]);
        for x in [0.0, 0.2, 1.0] {
            let (at, center) = (DVec2::new(x, 0.1), DVec2::new(0.0, 0.125));
            let expected =
                rect_occluder_visibility(at, center, DVec2::splat(0.25), f64::from(height), DVec2::splat(0.5), 5.0);
            let found = answer(&scene, DVec3::new(x, 0.0, 0.1)).visibility;
            close(found, expected, 1e-14, &format!("h = H(1 − 2^−{k})"));
        }
    }
}

#[test]
fn under_an_occluder_that_touches_it_a_receiver_is_dark() {
    let points: Vec<DVec3> = line(-0.4, 0.4, 40);
    for light in lights_of_every_shape() {
        let name = format!("{:?}", light.shape);
        for height in [1e-6f32, 1e-12, 1e-30, f32::MIN_POSITIVE, 1e-45] {
            let scene = scene(vec![mesh(&quad([-0.5, 0.5], height, [-0.5, 0.5]))], vec![light.clone()]);
            assert!(exact_visibility(&scene, &points).iter().all(|&v| v == 0.0), "{name}, height {height:e}");
        }
        // In the receiver's own plane it blocks nothing.
        let touching = scene(vec![mesh(&quad([-0.5, 0.5], 0.0, [-0.5, 0.5]))], vec![light]);
        assert!(exact_visibility(&touching, &points).iter().all(|&v| v == 1.0), "{name}");
    }
}

#[test]
fn the_penumbra_narrows_with_the_height_of_its_caster() {
    // C3: its width is 2 l h/(H − h). At h = 1e-6 H it is resolved as at any other.
    for lift in [0.5f32, 5e-3, 5e-6, 5e-9] {
        let scene = scene(vec![mesh(&quad([-4.0, 0.0], lift, [-4.0, 4.0]))], vec![square_light(0.5, 5.0)]);
        let width = penumbra_width(0.5, f64::from(lift), 5.0);
        for share in [-0.7, -0.5, -0.4, -0.1, 0.0, 0.2, 0.45, 0.5, 0.7] {
            let x = share * width;
            let found = answer(&scene, DVec3::new(x, 0.0, 0.0)).visibility;
            let expected = half_plane_visibility(x, 0.0, f64::from(lift), 0.5, 5.0);
            // Positions are relative to the caster's corner 4 m off, good to half an ulp there, and a corner to as much.
            let rounding = 4.0 * f64::EPSILON / width;
            close(found, expected, rounding + 1e-14, &format!("h = {lift:e}, {share} of the width"));
        }
    }
}

/// Casters with coordinates in sixty-fourths.
fn in_sixty_fourths() -> Mesh {
    let mut random = Random(8);
    let triangles: Vec<_> = (0..40)
        .map(|_| {
            let middle = DVec3::new(random.between(-1.0, 1.0), random.between(0.7, 3.0), random.between(-1.0, 1.0));
            [(); 3].map(|()| (((middle + random.in_cube(0.5)) * 64.0).round() / 64.0).as_vec3().to_array())
        })
        .collect();
    mesh(&triangles)
}

#[test]
fn a_shift_that_keeps_coordinates_exact_keeps_every_bit() {
    // Floats up to 2^18 hold sixty-fourths, and so does every shift.
    let caster = in_sixty_fourths();
    let points: Vec<DVec3> = line(-1.5, 1.5, 96).iter().map(|p| (p * 64.0).round() / 64.0).collect();
    let at = |shift: Vec3| {
        let lights = lights_in_sixty_fourths(shift.as_dvec3());
        let moved = Mesh { positions: caster.positions.iter().map(|&p| p + shift).collect(), ..caster.clone() };
        let scene = scene(vec![moved], lights);
        let points: Vec<DVec3> = points.iter().map(|&point| point + shift.as_dvec3()).collect();
        exact(&scene, &receivers(&scene, &points, DVec3::Y))
    };
    let found = at(Vec3::ZERO);
    for shift in [Vec3::new(1e5, -7e4, 3e4), Vec3::new(-65_536.25, 131_072.5, 0.0)] {
        assert_eq!(found, at(shift), "{shift}");
    }
}

#[test]
fn a_shift_by_a_node_costs_what_doubles_round() {
    let caster = in_sixty_fourths();
    let points = line(-1.5, 1.5, 150);
    let at = |shift: DVec3| {
        let mut lights = lights_of_every_shape();
        lights.pop();
        for light in &mut lights {
            light.scene_from_light.translation += shift;
        }
        let scene = placed_scene(vec![caster.clone()], DAffine3::from_translation(shift), lights);
        let points: Vec<DVec3> = points.iter().map(|&point| point + shift).collect();
        exact(&scene, &receivers(&scene, &points, DVec3::Y))
    };
    let found = at(DVec3::ZERO);
    for shift in [1e5, 1e6] {
        for (a, b) in found.iter().flatten().zip(at(DVec3::new(shift, shift, -shift)).iter().flatten()) {
            // Receiver, caster and light each move by half an ulp. An edge's image moves by up to 5 (H/h) as much, in units of
            // the narrowest light's half side 0.1; it is as long as the light, which is half as wide as the sum of all.
            let ulp = shift * f64::EPSILON;
            let bound = 3.0 * ulp * 5.0 / 0.1 * 8.0;
            close(a.visibility, b.visibility, bound, &format!("shift {shift:e}"));
        }
    }
}

#[test]
fn a_shift_that_rounds_corners_is_exact_for_the_rounded_ones() {
    // At 1e6 floats are a sixteenth apart: C1 of the corners as they are.
    for shift in [1e5f32, 1e6, -3e6] {
        let x = [shift - 0.43, shift + 0.51];
        let z = [-0.43, 0.51];
        let mut light = square_light(0.5, 5.0);
        light.scene_from_light.translation.x += f64::from(shift);
        let scene = scene(vec![mesh(&quad(x, 2.0, z))], vec![light]);
        let [low, high] = x.map(|x| f64::from(x) - f64::from(shift));
        let [z_low, z_high] = z.map(f64::from);
        let (center, half) =
            (DVec2::new(low + high, z_low + z_high) / 2.0, DVec2::new(high - low, z_high - z_low) / 2.0);
        for at in [0.0, 0.25, 0.7, -0.8] {
            let found = answer(&scene, DVec3::new(f64::from(shift) + at, 0.0, 0.0)).visibility;
            let exact_at = f64::from(shift) + at - f64::from(shift);
            let expected =
                rect_occluder_visibility(DVec2::new(exact_at, 0.0), center, half, 2.0, DVec2::splat(0.5), 5.0);
            close(found, expected, 1e-14, &format!("shift {shift}, {at}"));
        }
    }
}

/// V and E of a square light of half side ½ at height 5 behind the square at height 2, for any normals, from closed forms:
/// the light's square clipped by the horizon, by the shading plane, by the caster's image.
fn by_clipping(position: DVec3, normal: DVec3, shading_normal: DVec3) -> (f64, f64) {
    let square = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)].map(DVec2::from).to_vec();
    let on_light = |p: DVec2| DVec3::new(p.x, 5.0, p.y) - position;
    let above = |polygon: &[DVec2], normal: DVec3| clip_polygon(polygon, |p| normal.dot(on_light(p)));
    let foot = DVec2::new(position.x, position.z);
    let [low, high] = [-0.5, 0.5].map(|o| foot + (DVec2::splat(o) - foot) * 2.5);
    let hidden = |polygon: &[DVec2]| {
        let left = clip_polygon(polygon, |p| p.x - low.x);
        let right = clip_polygon(&left, |p| high.x - p.x);
        let near = clip_polygon(&right, |p| p.y - low.y);
        clip_polygon(&near, |p| high.y - p.y)
    };
    let seen = above(&square, normal);
    let area = polygon_area(&seen) - polygon_area(&hidden(&seen));
    let shaded = above(&seen, shading_normal);
    let factor = |polygon: &[DVec2]| {
        let corners: Vec<DVec3> = polygon.iter().map(|&p| on_light(p)).collect();
        lambert_form_factor(&corners, shading_normal)
    };
    (area, PI * (factor(&shaded) - factor(&hidden(&shaded))))
}

#[test]
fn a_receiver_turned_away_loses_what_its_horizon_hides() {
    let scene = square_under(square_light(0.5, 5.0));
    for x in [0.9, 1.2, -1.1, 3.0] {
        let position = DVec3::new(x, 0.0, 0.0137);
        let upright = answers(&scene, &[position], DVec3::Y)[0].visibility;
        let mut partly = 0;
        for step in 0..=720 {
            let turn = DMat3::from_rotation_z((0.5 * f64::from(step)).to_radians());
            let normal = turn * DMat3::from_rotation_x(0.1) * DVec3::Y;
            let found = answers(&scene, &[position], normal)[0];
            let (visibility, irradiance) = by_clipping(position, normal, normal);
            close(found.visibility, visibility, 1e-14, &format!("V at {x}, step {step}"));
            close(found.irradiance.x, irradiance, 1e-14, &format!("E at {x}, step {step}"));
            let heights = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
                .map(|(u, v)| normal.dot(DVec3::new(u, 5.0, v) - position));
            let is_above = heights.iter().all(|&h| h > 0.0);
            if is_above {
                assert_eq!(found.visibility, upright, "a grazing receiver keeps its visibility");
            } else if heights.iter().all(|&h| h < 0.0) {
                assert_eq!((found.visibility, found.irradiance, found.facing), (0.0, DVec3::ZERO, false));
            } else {
                partly += 1;
                assert!(found.facing);
            }
        }
        assert!(partly > 10, "only {partly} steps cut the light");
    }
}

#[test]
fn a_light_halved_by_the_horizon_is_half_seen() {
    // Every shape, its centre in the receiver's plane, which lies across the line of sight.
    for light in lights_of_every_shape() {
        if light.shape.is_point() {
            continue;
        }
        let open = scene(vec![mesh(&quad([-9.0, 9.0], -1.0, [-9.0, 9.0]))], vec![light]);
        let emitter = open.lights[0].emitter(DVec3::ZERO - open.origin_world).expect("faces");
        for normal in [emitter.center.cross(DVec3::X), emitter.center.cross(DVec3::new(0.3, 0.2, 0.7))] {
            let found = answers(&open, &[DVec3::ZERO], normal.normalize())[0];
            close(found.visibility, 0.5, 1e-14, &format!("{:?}", open.lights[0].shape));
            assert!(found.facing && found.irradiance.x > 0.0);
        }
    }
}

#[test]
fn a_light_in_the_plane_of_its_receiver_is_in_no_mask() {
    for shape in [Shape::Rect { size: DVec2::ONE }, Shape::Disk { size: DVec2::ONE }] {
        for tilt in [0.0, 0.3, 1.2] {
            // The light's plane holds the receiver, which faces across it or along it.
            let turn = DMat3::from_rotation_x(tilt);
            let mut light = light_down(shape, [0.0; 3]);
            light.scene_from_light.matrix3 = turn * light.scene_from_light.matrix3;
            light.scene_from_light.translation = turn * DVec3::new(3.0, 0.0, 0.7);
            let scene = scene(vec![mesh(&quad([-9.0, 9.0], -8.0, [-9.0, 9.0]))], vec![light]);
            for normal in [turn * DVec3::Y, DVec3::X] {
                let found = answers(&scene, &[DVec3::ZERO], normal)[0];
                assert_eq!((found.visibility, found.irradiance, found.facing), (0.0, DVec3::ZERO, false), "{tilt}");
            }
        }
    }
}

#[test]
fn degenerate_triangles_block_nothing() {
    let straight = [[-1.0, 2.0, 0.0], [0.1, 2.0, 0.0], [1.0, 2.0, 0.0]];
    let skew = [[-0.3, 1.1, 0.7], [0.1, 2.3, -0.9], [-0.3, 1.1, 0.7]];
    let point = [[0.0, 2.0, 0.0]; 3];
    let scene = scene(vec![mesh(&[straight, skew, point])], lights_of_every_shape());
    let points = line(-1.0, 1.0, 64);
    let receivers = receivers(&scene, &points, DVec3::Y);
    for (light, found) in scene.lights.iter().zip(exact(&scene, &receivers)) {
        for (receiver, found) in receivers.hits().zip(found) {
            assert_eq!(found.visibility, 1.0, "{:?}", light.shape);
            assert_eq!(found.irradiance, unshadowed(light, receiver), "{:?}", light.shape);
        }
    }
}

#[test]
fn a_triangle_seen_edge_on_blocks_nothing() {
    // Its plane holds the receiver.
    let upright = [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 3.0, 0.0]];
    let scene = scene(vec![mesh(&[upright])], vec![square_light(1.0, 5.0)]);
    let found = answer(&scene, DVec3::new(0.3, 0.0, 0.0));
    assert_eq!(found.visibility, 1.0);
}

#[test]
fn a_sliver_blocks_in_proportion() {
    // C7: the image of a strip of width w is w · H/h wide on a light of side 2. As two triangles, and as one of a needle's
    // shape, whose image crosses the light from side to side: from width w · 5/2 · (½ ± 1/10) on average half of it.
    for exponent in 1..=13 {
        let width = 10f32.powi(-exponent);
        let strip = quad([-0.5 * width, 0.5 * width], 2.0, [-5.0, 5.0]);
        let needle = [[-width, 2.0, -5.0], [width, 2.0, -5.0], [0.0, 2.0, 5.0]];
        for (what, triangles) in [("strip", strip), ("needle", vec![needle])] {
            let scene = scene(vec![mesh(&triangles)], vec![square_light(1.0, 5.0)]);
            let blocked = 1.0 - answer(&scene, DVec3::new(0.1, 0.0, 0.0)).visibility;
            let expected = f64::from(width) * 2.5 / 2.0;
            close(blocked, expected, 4.0 * f64::EPSILON, &format!("{what} of {width:e}"));
        }
    }
}

#[test]
fn a_caster_that_dips_below_the_receiver_covers_what_it_covers() {
    // One corner below the receivers' plane, two above the light: the plane y = x + 2.
    let triangle = [[-10.0, -8.0, 0.0], [10.0, 12.0, 30.0], [10.0, 12.0, -30.0]];
    // Its half beyond z = 0.
    let half = [[-10.0, -8.0, 0.0], [10.0, 12.0, 0.0], [10.0, 12.0, -60.0]];
    for light in lights_of_every_shape() {
        let mut light = light;
        light.scene_from_light.translation = DVec3::new(0.0, 4.0, 0.0);
        let name = format!("{:?}", light.shape);
        if matches!(light.shape, Shape::Sun { .. }) {
            light.scene_from_light.matrix3 = light_down(light.shape, [0.0; 3]).scene_from_light.matrix3;
        }
        let under = DVec3::new(1.0, 0.0, 0.0);
        let covering = scene(vec![mesh(&[triangle])], vec![light.clone()]);
        assert_eq!(answer(&covering, under).visibility, 0.0, "{name}");
        assert_eq!(answer(&covering, DVec3::new(-4.0, 0.0, 0.0)).visibility, 1.0, "{name}");
        if !light.shape.is_point() {
            let halving = scene(vec![mesh(&[half])], vec![light]);
            close(answer(&halving, under).visibility, 0.5, 1e-14, &name);
        }
    }
}

#[test]
fn a_wire_thinner_than_anything_hides_its_width() {
    // C7 of a prism of six sides: its image is the range of its corners' images.
    for exponent in [-2, -4, -6] {
        let radius = 10f64.powi(exponent);
        let corner = |i: u32, z: f32| {
            let at = radius * DVec2::from_angle(PI * f64::from(i % 6) / 3.0);
            [at.x as f32, (2.0 + at.y) as f32, z]
        };
        let mut triangles = Vec::new();
        for i in 0..6 {
            let [a, b, c, d] = [corner(i, -50.0), corner(i + 1, -50.0), corner(i + 1, 50.0), corner(i, 50.0)];
            triangles.extend([[a, b, c], [a, c, d]]);
        }
        let scene = scene(vec![mesh(&triangles)], vec![square_light(1.0, 5.0)]);
        for point in line(-0.5, 0.5, 100) {
            let images = (0..6).map(|i| {
                let [x, y, _] = corner(i, 0.0).map(f64::from);
                point.x + (x - point.x) * (5.0 / y)
            });
            let (low, high) = images.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
            let expected = (high.min(1.0) - low.max(-1.0)) / 2.0;
            let found = answer(&scene, point).visibility;
            close(1.0 - found, expected, 1e-14, &format!("radius {radius:e} at {point}"));
        }
    }
}

/// A sphere of radius 1 around `middle`: an octahedron whose triangles are divided in four `n` times.
fn sphere(middle: DVec3, n: u32) -> Mesh {
    let mut triangles = Vec::new();
    for i in 0..8 {
        let sign = |bit: u32| if i & bit == 0 { 1.0 } else { -1.0 };
        let corners = [DVec3::X * sign(1), DVec3::Y * sign(2), DVec3::Z * sign(4)];
        triangles.push(corners);
    }
    for _ in 0..n {
        triangles = triangles
            .iter()
            .flat_map(|&[a, b, c]| {
                let [ab, bc, ca] = [a + b, b + c, c + a].map(DVec3::normalize);
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            })
            .collect();
    }
    // Turned, so that planes are skew.
    let turn = DMat3::from_axis_angle(DVec3::new(0.36, 0.48, 0.8), 0.7);
    let corners: Vec<_> = triangles.iter().map(|t| t.map(|p| (middle + turn * p).as_vec3().to_array())).collect();
    mesh(&corners)
}

/// The receivers that a camera sees of a scene.
fn seen_from(scene: &Scene, eye: DVec3, target: DVec3, size: u32) -> Receivers {
    let camera = Camera {
        name: "view".into(),
        scene_from_camera: look_at(eye - scene.origin_world, target - scene.origin_world, DVec3::Y),
        projection: Projection::Perspective { fov_y: 0.8 },
        near: 0.0,
        far: f64::INFINITY,
    };
    let mut bvh = SceneBvh::new(scene);
    bvh.add(|_| true);
    Receivers::find(&bvh, &camera, [size; 2], DVec2::splat(0.5), &Progress::default()).expect("found")
}

#[test]
fn a_convex_body_shadows_itself_by_its_horizon_alone() {
    // Whatever a facet of a sphere sees of a light is what lies above its own plane, as if nothing else were there. From the
    // light's side, from the back, and across the terminator.
    for n in [1, 3, 5] {
        let middle = DVec3::new(0.31, 0.17, -0.23);
        let scene = scene(vec![sphere(middle, n)], lights_of_every_shape());
        let mut open = scene.clone();
        open.instances.clear();
        let (mut cut, mut facing) = (0, 0);
        for eye in [DVec3::new(4.0, 1.0, 2.0), DVec3::new(-1.0, 5.0, 1.0), DVec3::new(0.5, -4.0, -2.0)] {
            let receivers = seen_from(&scene, eye, middle, 40);
            let [found, expected] = [&scene, &open].map(|scene| exact(scene, &receivers));
            for (light, (found, expected)) in found.iter().zip(&expected).enumerate() {
                for (receiver, (a, b)) in receivers.hits().zip(found.iter().zip(expected)) {
                    facing += u32::from(b.facing);
                    cut += u32::from(b.visibility > 0.0 && b.visibility < 1.0);
                    // A receiver is off its facet by 1e-16, and 1e-4 at the least from the next: what rises above its horizon
                    // there rises by 1e-12 of the way.
                    close(a.visibility, b.visibility, 1e-11, &format!("{n}, light {light}, {receiver:?}"));
                    assert_eq!(a.facing, b.facing);
                }
            }
        }
        assert!(facing > 2000 && cut > 200, "{facing} face a light, {cut} in part");
    }
}

#[test]
fn the_terminator_of_a_sphere_approaches_the_smooth_one() {
    // V against a directional light from above at facets' centres: wrong, against the smooth sphere, only in a band of a
    // facet's height.
    for n in [2, 3, 4, 5] {
        let scene = scene(vec![sphere(DVec3::ZERO, n)], vec![light_down(Shape::Sun { angle: 0.0 }, [0.0; 3])]);
        let mesh = &scene.meshes[0];
        let centers: Vec<DVec3> = mesh
            .triangles
            .iter()
            .map(|triangle| triangle.iter().map(|&i| mesh.positions[i as usize].as_dvec3()).sum::<DVec3>() / 3.0)
            .collect();
        let mut receivers = receivers(&scene, &centers, DVec3::Y);
        for (number, receiver) in receivers.pixels.iter_mut().flatten().enumerate() {
            let [a, b, c] = mesh.triangles[number].map(|i| mesh.positions[i as usize].as_dvec3());
            let normal = (b - a).cross(c - a).normalize();
            let normal = normal * normal.dot(centers[number]).signum();
            *receiver = Receiver {
                position_error: 1e-15,
                normal,
                shading_normal: normal,
                instance: 0,
                triangle: number as u32,
                ..*receiver
            };
        }
        // A facet reaches over less than this angle.
        let facet = PI / f64::from(1 << n);
        for (center, (receiver, found)) in centers.iter().zip(receivers.hits().zip(&exact(&scene, &receivers)[0])) {
            // A facet of a convex body is lit where it faces the light.
            let height = receiver.normal.y;
            assert!(height.abs() > 1e-12, "a facet is edge-on");
            assert_eq!(found.visibility, if height > 0.0 { 1.0 } else { 0.0 }, "n = {n}, {receiver:?}");
            let smooth = if center.y > 0.0 { 1.0 } else { 0.0 };
            assert!(found.visibility == smooth || center.normalize().y.abs() < facet, "n = {n}, {receiver:?}");
        }
    }
}

#[test]
fn overlapping_occluders_block_their_union() {
    // Edges at x = 0 (height 1) and x = 0.2 (height 3) under a light at height 5, half side 1: ⅓ is seen from x = 0, not the
    // product of ½ and ⅔·½, nor 0. Images on the light of what lies at x < edge: u < 0 and u < 0.2 · 5/3.
    let edge = |x: f32, height: f32| mesh(&quad([-90.0, x], height, [-90.0, 90.0]));
    let alone = |mesh: Mesh| answer(&scene(vec![mesh], vec![square_light(1.0, 5.0)]), DVec3::ZERO).visibility;
    let upper = 0.5 * (1.0 - f64::from(0.2f32) * 5.0 / 3.0);
    close(alone(edge(0.0, 1.0)), 0.5, 1e-14, "the lower");
    close(alone(edge(0.2, 3.0)), upper, 1e-14, "the upper");
    let both = scene(vec![edge(0.0, 1.0), edge(0.2, 3.0)], vec![square_light(1.0, 5.0)]);
    let found = answer(&both, DVec3::ZERO).visibility;
    close(found, upper, 1e-14, "both");
    close(found, 1.0 / 3.0, 1e-8, "both");
}

#[test]
fn every_shape_is_blocked_by_a_lid_and_seen_without_it() {
    let points = line(-0.5, 0.5, 40);
    for light in lights_of_every_shape() {
        let name = format!("{:?}", light.shape);
        for lid in [[2.0, 90.0], [2.0, 9.0], [3.0, 3.0], [0.1, 1e6], [1e-3, 1e9]] {
            let [height, reach] = lid.map(|x| x as f32);
            let lid = scene(vec![mesh(&quad([-reach, reach], height, [-reach, reach]))], vec![light.clone()]);
            for found in answers(&lid, &points, DVec3::Y) {
                assert_eq!((found.visibility, found.irradiance), (0.0, DVec3::ZERO), "{name} {height} {reach}");
            }
        }
        let open = scene(vec![mesh(&quad([-90.0, 90.0], -2.0, [-90.0, 90.0]))], vec![light]);
        let receivers = receivers(&open, &points, DVec3::Y);
        for (receiver, found) in receivers.hits().zip(&exact(&open, &receivers)[0]) {
            assert_eq!(found.visibility, 1.0, "{name}");
            assert_eq!(found.irradiance, unshadowed(&open.lights[0], receiver), "{name}");
        }
    }
}

#[test]
fn a_lid_of_many_pieces_leaves_no_gap() {
    // A bumpy lid of one mesh, of an instance a row, of triangles with as much as doubles can differ; lights from a metre to a
    // tenth of a millimetre.
    let mut random = Random(21);
    for case in 0..60 {
        let count = 2 + random.below(14);
        let reach = random.between(4.0, 40.0);
        let turn = DMat3::from_rotation_y(random.between(0.0, 3.0));
        let heights: Vec<f64> = (0..=(count + 1) * (count + 1)).map(|_| random.between(1.0, 2.0)).collect();
        let at = |i: usize, j: usize| {
            let across = |i: usize| reach * (2.0 * i as f64 / count as f64 - 1.0);
            (turn * DVec3::new(across(i), heights[i * (count + 1) + j], across(j))).as_vec3().to_array()
        };
        let row = |i: usize| -> Vec<[[f32; 3]; 3]> {
            (0..count)
                .flat_map(|j| {
                    let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                    [[a, b, c], [a, c, d]]
                })
                .collect()
        };
        let whole = mesh(&(0..count).flat_map(row).collect::<Vec<_>>());
        let rows = (0..count).map(|i| mesh(&row(i))).collect();
        let size = 10f64.powf(random.between(-4.0, 0.0));
        let lights: Vec<AreaLight> = lights_of_every_shape()
            .into_iter()
            .map(|mut light| {
                light.shape = match light.shape {
                    Shape::Rect { size: old } => Shape::Rect { size: old * size },
                    Shape::Disk { size: old } => Shape::Disk { size: old * size },
                    Shape::Sphere { radius, facing } => Shape::Sphere { radius: radius * size, facing },
                    Shape::Tube { length, radius } => Shape::Tube { length: length * size, radius: radius * size },
                    Shape::Sun { angle } => Shape::Sun { angle: angle * size },
                    Shape::Point => Shape::Point,
                };
                light
            })
            .collect();
        let points: Vec<DVec3> =
            (0..20).map(|_| DVec3::new(random.between(-1.0, 1.0), 0.0, random.between(-1.0, 1.0))).collect();
        for (what, meshes) in [("one mesh", vec![whole]), ("rows", rows)] {
            let scene = scene(meshes, lights.clone());
            for (light, found) in exact(&scene, &receivers(&scene, &points, DVec3::Y)).iter().enumerate() {
                for found in found {
                    let Answer { visibility, .. } = found;
                    assert_eq!(*visibility, 0.0, "case {case}, {what}, light {light} of {size:e}, reach {reach}");
                }
            }
        }
    }
}

#[test]
fn irradiance_is_never_above_the_unshadowed_and_equals_it_where_nothing_blocks() {
    let mut random = Random(30);
    let (mut lit, mut partial, mut touched) = (0, 0, 0);
    for case in 0..400 {
        let light = random.light(SHAPES[case % SHAPES.len()]);
        let casters: Vec<_> = (0..1 + random.below(4))
            .map(|_| {
                let middle = random.in_cube(2.0);
                [(); 3].map(|()| (middle + random.in_cube(0.4)).as_vec3().to_array())
            })
            .collect();
        let scene = scene(vec![mesh(&casters)], vec![light]);
        let points: Vec<DVec3> = (0..20).map(|_| random.in_cube(1.0)).collect();
        let mut receivers = receivers(&scene, &points, random.direction());
        for receiver in receivers.pixels.iter_mut().flatten() {
            receiver.shading_normal = penumbra::receivers::toward(random.direction(), receiver.normal);
        }
        for (receiver, found) in receivers.hits().zip(&exact(&scene, &receivers)[0]) {
            if !found.facing {
                assert_eq!((found.visibility, found.irradiance), (0.0, DVec3::ZERO));
                continue;
            }
            let what = format!("case {case}, {:?}, {} triangles, {receiver:?}", scene.lights[0].shape, found.triangles);
            let whole = unshadowed(&scene.lights[0], receiver);
            is_sound(found, whole, &what);
            if found.visibility == 1.0 {
                assert_eq!(found.irradiance, whole, "{what}");
            }
            lit += u32::from(found.visibility == 1.0);
            touched += u32::from(found.visibility == 1.0 && found.triangles > 0);
            partial += u32::from(found.visibility > 0.0 && found.visibility < 1.0);
        }
    }
    assert!(lit > 500 && partial > 500, "{lit} lit ({touched} with triangles near), {partial} in part");
}

#[test]
fn triangles_beside_a_disc_take_nothing_from_it() {
    // In the corners of the square around it, and just outside its rim.
    let mut random = Random(31);
    let mut near = 0;
    for case in 0..500 {
        let shape = [
            Shape::Disk { size: DVec2::splat(2.0) },
            Shape::Disk { size: DVec2::new(2.0, 1.0) },
            Shape::Sphere { radius: 1.0, facing: true },
            Shape::Sun { angle: 0.4 },
        ][case % 4];
        let light = light_down(shape, [0.0, 5.0, 0.0]);
        let position = DVec3::new(random.between(-0.5, 0.5), 0.0, random.between(-0.5, 0.5));
        let emitter = light.emitter(position).expect("faces");
        // A triangle between two tangents and their corner, pulled in from the rim by a hundredth.
        let angle = random.between(0.0, 2.0 * PI);
        let spread = random.between(0.05, 0.6);
        let rim = |a: f64, r: f64| emitter.at(r * DVec2::from_angle(a));
        let corners = [rim(angle - spread, 1.01), rim(angle + spread, 1.01), rim(angle, 1.0 / spread.cos())];
        // Chords cut into the disc, so its short side must be short.
        let corners =
            if spread.cos() * 1.01 < 1.0 { [corners[2], rim(angle, 1.02), rim(angle + 1e-3, 1.02)] } else { corners };
        let triangle = corners.map(|corner| (position + 0.4 * corner).as_vec3().to_array());
        let scene = scene(vec![mesh(&[triangle])], vec![light]);
        let receiver = *receivers(&scene, &[position], DVec3::Y).hits().next().expect("one");
        let found = answer(&scene, position);
        assert_eq!(found.visibility, 1.0, "case {case}");
        assert_eq!(found.irradiance, unshadowed(&scene.lights[0], &receiver), "case {case}");
        near += u32::from(found.triangles > 0);
    }
    assert!(near > 100, "only {near} had a triangle near the disc");
}

#[test]
fn a_shading_normal_cuts_irradiance_and_not_visibility() {
    let scene = square_under(square_light(0.5, 5.0));
    let mut random = Random(33);
    let (mut cut, mut dark) = (0, 0);
    for case in 0..1000 {
        let position = DVec3::new(random.between(-1.5, 1.5), 0.0, random.between(-1.5, 1.5));
        let normal = (DVec3::Y + random.in_cube([0.0, 1.5][case % 2])).normalize();
        let shading_normal = penumbra::receivers::toward(random.direction(), normal);
        let mut receivers = receivers(&scene, &[position], normal);
        let plain = exact(&scene, &receivers)[0][0];
        receivers.pixels[0].as_mut().expect("one receiver").shading_normal = shading_normal;
        let found = exact(&scene, &receivers)[0][0];
        assert_eq!((found.visibility, found.facing), (plain.visibility, plain.facing), "case {case}");
        let (visibility, irradiance) = by_clipping(position, normal, shading_normal);
        close(found.visibility, visibility, 1e-14, &format!("V of case {case}"));
        close(found.irradiance.x, irradiance, 1e-14, &format!("E of case {case}"));
        if visibility > 0.0 {
            let heights = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
                .map(|(u, v)| shading_normal.dot(DVec3::new(u, 5.0, v) - position));
            dark += u32::from(heights.iter().all(|&h| h <= 0.0));
            cut += u32::from(heights.iter().any(|&h| h < 0.0) && heights.iter().any(|&h| h > 0.0));
        }
    }
    assert!(cut > 20 && dark > 50, "{cut} cut, {dark} dark");
}

#[test]
fn nothing_is_ever_not_a_number() {
    // Coordinates over sixty orders of magnitude, receivers on top of everything.
    let magnitudes = [0.0f32, 1e-45, 1e-38, 1e-30, 1e-20, 1e-10, 1e-6, 1.0, 1e6, 1e12, 1e17];
    for &size in &magnitudes {
        for &height in &magnitudes {
            let meshes = vec![
                mesh(&quad([-size, size], height, [-1.0, 1.0])),
                mesh(&[[[0.0; 3], [size, height, 0.0], [1.0; 3]], [[size; 3], [0.0; 3], [-size, height, size]]]),
            ];
            let scene = scene(meshes, lights_of_every_shape());
            let points: Vec<DVec3> =
                magnitudes.iter().map(|&x| DVec3::new(x.into(), 0.0, f64::from(x) * 1e-3)).collect();
            let receivers = receivers(&scene, &points, DVec3::Y);
            for (light, found) in scene.lights.iter().zip(exact(&scene, &receivers)) {
                for (receiver, found) in receivers.hits().zip(found) {
                    let what = format!("{size:e} {height:e} {:?} {}", light.shape, receiver.position);
                    is_sound(&found, unshadowed(light, receiver), &what);
                }
            }
        }
    }
}

#[test]
fn tiny_and_huge_lights_and_places_are_sound() {
    let mut random = Random(40);
    for case in 0..600 {
        let power = |random: &mut Random| 10f64.powf(random.between(-30.0, 15.0));
        let scale = power(&mut random);
        let mut light = random.light(SHAPES[case % SHAPES.len()]);
        let size = if random.chance(0.5) { scale } else { power(&mut random) };
        light.shape = match light.shape {
            Shape::Rect { size: old } => Shape::Rect { size: old * size },
            Shape::Disk { size: old } => Shape::Disk { size: DVec2::new(old.x * size, old.y * scale) },
            Shape::Sphere { radius, facing } => Shape::Sphere { radius: radius * size, facing },
            Shape::Tube { length, radius } => Shape::Tube { length: length * scale, radius: radius * size },
            shape @ (Shape::Sun { .. } | Shape::Point) => shape,
        };
        light.scene_from_light.translation *= scale;
        let casters: Vec<_> = (0..6)
            .map(|_| {
                let middle = random.in_cube(2.0 * scale);
                let size = if random.chance(0.5) { scale } else { power(&mut random) };
                [(); 3].map(|()| (middle + random.in_cube(size)).as_vec3().to_array())
            })
            .collect();
        let scene = scene(vec![mesh(&casters)], vec![light]);
        let points: Vec<DVec3> = (0..8).map(|_| random.in_cube(scale)).collect();
        let receivers = receivers(&scene, &points, random.direction());
        for (receiver, found) in receivers.hits().zip(&exact(&scene, &receivers)[0]) {
            let what = format!("case {case}, scale {scale:e}, {:?}", scene.lights[0].shape);
            is_sound(found, unshadowed(&scene.lights[0], receiver), &what);
        }
    }
}

#[test]
fn the_same_question_has_the_same_answer() {
    let scene = scene(vec![in_sixty_fourths()], lights_of_every_shape());
    let receivers = receivers(&scene, &line(-1.5, 1.5, 200), DVec3::Y);
    assert_eq!(exact(&scene, &receivers), exact(&scene, &receivers));
}
