//! Numerical extremes: what `rays` must return at the edges of floating-point, size and shape.

mod common;

use std::f64::consts::PI;

use common::*;
use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3};
use penumbra::geometry::irradiance::unshadowed;
use penumbra::sampling::Pattern;
use penumbra::scene::{AreaLight, Mesh, Shape};
use penumbra::techniques::LightImage;

#[test]
fn a_light_of_no_size_casts_the_hard_shadow() {
    let points = line(-2.0, 2.0, 400);
    let hard = visibility(&square_under(light_down(Shape::Point, [0.0, 5.0, 0.0])), &points, 16);
    assert!(hard.iter().all(|&v| v == 0.0 || v == 1.0));
    // C3: the shadow's edge is at ½ · H/(H − h).
    for (point, &v) in points.iter().zip(&hard) {
        assert_eq!(v == 0.0, point.x.abs() < 0.5 * 5.0 / 3.0, "{point}");
    }
    for half in [0.0, 1e-300, 1e-30, 1e-12] {
        assert_eq!(visibility(&square_under(square_light(half, 5.0)), &points, 16), hard, "half side {half}");
        let disk = light_down(Shape::Disk { size: DVec2::splat(2.0 * half) }, [0.0, 5.0, 0.0]);
        assert_eq!(visibility(&square_under(disk), &points, 16), hard, "disk of radius {half}");
        let sphere = light_down(Shape::Sphere { radius: half, facing: false }, [0.0, 5.0, 0.0]);
        assert_eq!(visibility(&square_under(sphere), &points, 16), hard, "sphere of radius {half}");
    }
    let directional = light_down(Shape::Sun { angle: 0.0 }, [0.0; 3]);
    for (point, v) in points.iter().zip(visibility(&square_under(directional), &points, 16)) {
        assert_eq!(v == 0.0, point.x.abs() < 0.5, "{point}");
    }
}

#[test]
fn a_light_of_endless_size_is_blocked_by_its_share() {
    // The square's image on the light has half side (5/2) · ½: a millionth of the light's side.
    let scene = square_under(square_light(5e6, 5.0));
    let image = &trace(&scene, &[DVec3::ZERO], &rays(Pattern::Grid, 4096)).lights[0];
    assert_eq!(image.visibility, [1.0]);
    // E₀ of a plane without end is π L.
    assert!((f64::from(image.irradiance[0][0]) - PI).abs() < 1e-6 * PI, "{:?}", image.irradiance);
}

#[test]
fn a_narrow_spread_loses_nothing_where_nothing_is_hidden() {
    // However few samples meet the little of the light that emits towards the receiver, an open floor gets E₀.
    for spread in [PI, 0.5, 0.05, 1e-3] {
        let light = AreaLight { spread, ..square_light(0.5, 1.0) };
        let scene = scene(vec![mesh(&quad([-9.0, 9.0], -1.0, [-9.0, 9.0]))], vec![light]);
        let points = line(-0.4, 0.4, 50);
        let image = &trace(&scene, &points, &rays(Pattern::Sobol, 64)).lights[0];
        for (receiver, irradiance) in receivers(&scene, &points, DVec3::Y).hits().zip(&image.irradiance) {
            let expected = unshadowed(&scene.lights[0], receiver).as_vec3().to_array();
            assert!(expected[0] > 0.0);
            assert_eq!(*irradiance, expected, "spread {spread}");
        }
    }
}

#[test]
fn an_occluder_in_the_plane_of_the_light_does_not_block() {
    let points = line(-2.0, 2.0, 50);
    let at_light = scene(vec![mesh(&quad([-9.0, 9.0], 5.0, [-9.0, 9.0]))], vec![square_light(1.0, 5.0)]);
    assert!(visibility(&at_light, &points, 64).iter().all(|&v| v == 1.0));
    // A float below it blocks all.
    let below = scene(vec![mesh(&quad([-9.0, 9.0], 5f32.next_down(), [-9.0, 9.0]))], vec![square_light(1.0, 5.0)]);
    assert!(visibility(&below, &points, 64).iter().all(|&v| v == 0.0));
}

#[test]
fn an_occluder_approaching_the_light_hides_its_own_share() {
    for k in [4, 12, 20] {
        let height = 5.0 * (1.0 - 2f32.powi(-k));
        let scene = scene(vec![mesh(&quad([-0.25, 0.25], height, [-0.25, 0.25]))], vec![square_light(0.5, 5.0)]);
        // C1 from straight below: the image's half side is ¼ · H/h.
        let expected = 1.0 - (0.25 * 5.0 / f64::from(height)).powi(2) / 0.25;
        let found = f64::from(visibility(&scene, &[DVec3::ZERO], 65_536)[0]);
        // One row of cells of 256 along each of four edges.
        assert!((found - expected).abs() < 4.0 / 256.0, "h = H(1 - 2^-{k}): {found} for {expected}");
    }
}

#[test]
fn under_an_occluder_that_touches_it_a_receiver_is_dark() {
    let points: Vec<DVec3> = line(-0.4, 0.4, 40);
    for height in [1e-6f32, 1e-12, 1e-30] {
        let scene = scene(vec![mesh(&quad([-0.5, 0.5], height, [-0.5, 0.5]))], vec![square_light(0.5, 5.0)]);
        assert!(visibility(&scene, &points, 64).iter().all(|&v| v == 0.0), "height {height}");
    }
    // In the receiver's own plane it blocks nothing.
    let touching = scene(vec![mesh(&quad([-0.5, 0.5], 0.0, [-0.5, 0.5]))], vec![square_light(0.5, 5.0)]);
    assert!(visibility(&touching, &points, 64).iter().all(|&v| v == 1.0));
}

#[test]
fn the_penumbra_vanishes_towards_the_line_of_contact() {
    // C3: the width is 2 l h/(H − h): at h = 1e-6 H a ten-thousandth beyond the edge is lit, as much within is dark.
    let scene = scene(vec![mesh(&quad([-5.0, 0.0], 5e-6, [-50.0, 50.0]))], vec![square_light(0.5, 5.0)]);
    let beside = |x: f64| visibility(&scene, &[DVec3::new(x, 0.0, 0.0)], 256)[0];
    assert_eq!([beside(-1e-5), beside(1e-5)], [0.0, 1.0]);
}

#[test]
fn visibility_does_not_change_with_scale() {
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 150);
    let found = trace(&scene, &points, &rays(Pattern::Sobol, 64));
    for exponent in [-20, -7, 20] {
        let factor = 2f64.powi(exponent);
        let moved: Vec<DVec3> = points.iter().map(|&point| point * factor).collect();
        let rescaled = trace(&scaled(&scene, factor), &moved, &rays(Pattern::Sobol, 64));
        same_bits("rays", &found.lights, &rescaled.lights);
        // Area lights keep their irradiance.
        for light in 0..6 {
            assert_eq!(
                found.lights[light].irradiance, rescaled.lights[light].irradiance,
                "light {light}, 2^{exponent}"
            );
        }
    }
}

#[test]
fn a_shift_that_keeps_coordinates_exact_keeps_every_bit() {
    // All coordinates are multiples of 2^-6 (the spacing of floats up to 2^18 allows that), and so is the shift.
    let snap = |mesh: &Mesh, shift: Vec3| Mesh {
        positions: mesh.positions.iter().map(|&p| (p * 64.0).round() / 64.0 + shift).collect(),
        ..mesh.clone()
    };
    let unshifted = bumpy(Vec::new());
    let points: Vec<DVec3> = line(-1.5, 1.5, 96).iter().map(|p| (p * 64.0).round() / 64.0).collect();
    let at = |shift: Vec3| {
        let lights = lights_in_sixty_fourths(shift.as_dvec3());
        let scene = scene(unshifted.meshes.iter().map(|mesh| snap(mesh, shift)).collect(), lights);
        let points: Vec<DVec3> = points.iter().map(|&point| point + shift.as_dvec3()).collect();
        trace(&scene, &points, &rays(Pattern::Sobol, 64))
    };
    let found = at(Vec3::ZERO);
    for shift in [Vec3::new(1e5, -7e4, 3e4), Vec3::new(-65_536.25, 131_072.5, 0.0)] {
        same_bits("rays", &found.lights, &at(shift).lights);
    }
}

#[test]
fn a_scene_moved_by_its_node_loses_nothing() {
    let meshes = bumpy(Vec::new()).meshes;
    let points = line(-1.5, 1.5, 150);
    let at = |shift: DVec3| {
        let mut lights = lights_of_every_shape();
        for light in &mut lights {
            light.scene_from_light.translation += shift;
        }
        let scene = placed_scene(meshes.clone(), DAffine3::from_translation(shift), lights);
        let points: Vec<DVec3> = points.iter().map(|&point| point + shift).collect();
        trace(&scene, &points, &rays(Pattern::Grid, 256))
    };
    let found = at(DVec3::ZERO);
    for shift in [1e5, 1e6] {
        let moved = at(DVec3::new(shift, shift, -shift));
        for (a, b) in found.lights.iter().zip(&moved.lights) {
            // A double at 1e6 is good to 1e-10: no sample of 256 is that near to an edge but by bad luck.
            let differing = a.visibility.iter().zip(&b.visibility).filter(|(a, b)| a != b).count();
            assert!(differing <= 1, "{differing} receivers differ at {shift}");
        }
    }
}

#[test]
fn a_grazing_receiver_keeps_its_visibility_and_loses_its_irradiance() {
    let scene = square_under(square_light(0.25, 5.0));
    let upright = f64::from(visibility(&scene, &[DVec3::new(0.9, 0.0, 0.0)], 1024)[0]);
    let mut last = f64::INFINITY;
    for degrees in [0.0, 30.0, 60.0, 80.0, 85.0] {
        // Turned away from the light about z; all of the light stays above the horizon.
        let normal = DMat3::from_rotation_z(f64::to_radians(-degrees)) * DVec3::Y;
        let receivers = receivers(&scene, &[DVec3::new(0.9, 0.0, 0.0)], normal);
        let image = &trace_receivers(&scene, receivers, &rays(Pattern::Grid, 1024)).lights[0];
        let above = if degrees < 75.0 { upright } else { f64::from(image.visibility[0]) };
        assert_eq!(f64::from(image.visibility[0]), above, "{degrees} degrees");
        let irradiance = f64::from(image.irradiance[0][0]);
        assert!(irradiance <= last && irradiance >= 0.0, "{degrees} degrees");
        last = irradiance;
    }
}

#[test]
fn a_light_below_the_horizon_gives_nothing() {
    let scene = scene(vec![mesh(&quad([-9.0, 9.0], -1.0, [-9.0, 9.0]))], vec![square_light(0.5, 2.0)]);
    let seen = |degrees: f64| {
        let normal = DMat3::from_rotation_z(degrees.to_radians()) * DVec3::Y;
        let receivers = receivers(&scene, &[DVec3::ZERO], normal);
        let mut lights = trace_receivers(&scene, receivers, &rays(Pattern::Grid, 4096)).lights;
        lights.swap_remove(0)
    };
    // Turned by 90° the horizon halves the light; V is the fraction above it.
    let half = seen(90.0);
    assert_eq!(half.visibility, [0.5]);
    assert!(half.facing[0]);
    let sunk = seen(135.0);
    assert_eq!((sunk.visibility[0], sunk.irradiance[0], sunk.facing[0]), (0.0, [0.0; 3], false));
}

#[test]
fn a_light_in_the_plane_of_its_receiver_is_in_no_mask() {
    for tilt in [0.0, 0.3, 1.2] {
        // The light's plane holds the receiver, which faces across it or along it.
        let mut light = square_light(0.5, 0.0);
        let turn = DMat3::from_rotation_x(tilt);
        light.scene_from_light.matrix3 = turn * light.scene_from_light.matrix3;
        light.scene_from_light.translation = turn * DVec3::new(3.0, 0.0, 0.7);
        let scene = scene(vec![mesh(&quad([-9.0, 9.0], -8.0, [-9.0, 9.0]))], vec![light]);
        for normal in [turn * DVec3::Y, DVec3::X] {
            let receivers = receivers(&scene, &[DVec3::ZERO], normal);
            let image = &trace_receivers(&scene, receivers, &rays(Pattern::Grid, 64)).lights[0];
            assert_eq!((image.visibility[0], image.irradiance[0], image.facing[0]), (0.0, [0.0; 3], false), "{tilt}");
        }
    }
}

#[test]
fn degenerate_triangles_block_nothing() {
    let line_ = [[-1.0, 2.0, 0.0], [0.1, 2.0, 0.0], [1.0, 2.0, 0.0]];
    let point = [[0.0, 2.0, 0.0]; 3];
    let scene = scene(vec![mesh(&[line_, point])], vec![square_light(1.0, 5.0)]);
    assert!(visibility(&scene, &line(-1.0, 1.0, 64), 1024).iter().all(|&v| v == 1.0));
}

#[test]
fn a_sliver_blocks_in_proportion() {
    // C7 in the mean over jitter: the image of a strip of width w is w · H/h wide on a light of side 2.
    for width in [1e-2f32, 1e-3] {
        let scene =
            scene(vec![mesh(&quad([-0.5 * width, 0.5 * width], 2.0, [-9.0, 9.0]))], vec![square_light(1.0, 5.0)]);
        let points = line(-0.3, 0.3, 4000);
        let found = trace(&scene, &points, &rays(Pattern::Jittered, 64)).lights.swap_remove(0).visibility;
        let mean = 1.0 - found.iter().map(|&v| f64::from(v)).sum::<f64>() / found.len() as f64;
        let expected = f64::from(width) * 2.5 / 2.0;
        // 256,000 jittered samples; each is blocked with probability `expected` at the most independently.
        let deviation = (expected / 256_000.0).sqrt();
        assert!((mean - expected).abs() < 4.0 * deviation, "{mean} for {expected}");
    }
}

#[test]
fn a_scene_laid_over_itself_changes_nothing() {
    let once = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 200);
    let found = trace(&once, &points, &rays(Pattern::Sobol, 64));
    let twice = scene(once.meshes.iter().chain(&once.meshes).cloned().collect(), lights_of_every_shape());
    same_bits("rays", &found.lights, &trace(&twice, &points, &rays(Pattern::Sobol, 64)).lights);
    let mut instanced = once.clone();
    instanced.instances.extend(once.instances.iter().cloned());
    same_bits("rays", &found.lights, &trace(&instanced, &points, &rays(Pattern::Sobol, 64)).lights);
}

#[test]
fn the_order_of_triangles_and_corners_does_not_matter() {
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 200);
    let found = trace(&scene, &points, &rays(Pattern::Sobol, 64));
    let mut permuted = scene.clone();
    for mesh in &mut permuted.meshes {
        mesh.triangles.reverse();
        for (i, [a, b, c]) in mesh.triangles.iter_mut().enumerate() {
            (*a, *b, *c) = if i % 2 == 0 { (*b, *c, *a) } else { (*c, *b, *a) };
        }
    }
    same_bits("rays", &found.lights, &trace(&permuted, &points, &rays(Pattern::Sobol, 64)).lights);
}

#[test]
fn a_caster_that_dips_below_the_receiver_covers_what_it_covers() {
    // One corner below the receivers' plane, two above the light: the plane y = x + 2.
    let triangle = [[-10.0, -8.0, 0.0], [10.0, 12.0, 30.0], [10.0, 12.0, -30.0]];
    let covering = scene(vec![mesh(&[triangle])], vec![square_light(0.5, 5.0)]);
    assert_eq!(visibility(&covering, &[DVec3::new(1.0, 0.0, 0.0)], 256), [0.0]);
    assert_eq!(visibility(&covering, &[DVec3::new(-4.0, 0.0, 0.0)], 256), [1.0]);
}

#[test]
fn overlapping_occluders_block_their_union() {
    // Edges at x = 0 (height 1) and x = 0.2 (height 3) under a light at height 5, half side 1: ⅓ is seen from x = 0.
    // Images on the light of what lies at x < edge: u < 0 and u < 0.2 · 5/3.
    let meshes =
        vec![mesh(&quad([-900.0, 0.0], 1.0, [-900.0, 900.0])), mesh(&quad([-900.0, 0.2], 3.0, [-900.0, 900.0]))];
    let found = visibility(&scene(meshes, vec![square_light(1.0, 5.0)]), &[DVec3::ZERO], 360_000)[0];
    assert!((f64::from(found) - 1.0 / 3.0).abs() <= 1.0 / 600.0, "{found}");
}

#[test]
fn every_shape_is_blocked_by_a_lid_and_seen_without_it() {
    for light in lights_of_every_shape() {
        let points = line(-0.5, 0.5, 20);
        let name = format!("{:?}", light.shape);
        let lid = scene(vec![mesh(&quad([-90.0, 90.0], 2.0, [-90.0, 90.0]))], vec![light.clone()]);
        assert!(visibility(&lid, &points, 64).iter().all(|&v| v == 0.0), "{name}");
        let open = scene(vec![mesh(&quad([-90.0, 90.0], -2.0, [-90.0, 90.0]))], vec![light]);
        assert!(visibility(&open, &points, 64).iter().all(|&v| v == 1.0), "{name}");
    }
}

#[test]
fn the_terminator_of_a_sphere_approaches_the_smooth_one() {
    // V at facet centres of a sphere lit by a far sun: 1 on the lit side, 0 beyond the terminator; facets that straddle it are
    // a band that narrows as they shrink.
    let mut last = f64::INFINITY;
    for subdivisions in [8u32, 16, 32] {
        let triangles = sphere(subdivisions);
        let sun = light_down(Shape::Sun { angle: 0.0 }, [0.0; 3]);
        let scene = scene(vec![mesh(&triangles)], vec![sun]);
        let mut wrong = 0.0f64;
        for [a, b, c] in triangles.iter().map(|t| t.map(|p| Vec3::from(p).as_dvec3())) {
            let normal = (b - a).cross(c - a);
            if normal.length() == 0.0 {
                continue;
            }
            let center = (a + b + c) / 3.0;
            let normal = normal.normalize() * normal.dot(center).signum();
            let receivers = {
                let mut receivers = receivers(&scene, &[center], normal);
                let receiver = receivers.pixels[0].as_mut().expect("one receiver");
                receiver.position_error = 1e-15;
                receivers
            };
            let v = f64::from(trace_receivers(&scene, receivers, &rays(Pattern::Grid, 1)).lights[0].visibility[0]);
            let smooth = if center.y > 0.0 { 1.0 } else { 0.0 };
            if v != smooth {
                wrong = wrong.max(center.normalize().y.abs());
            }
        }
        let facet = PI / f64::from(subdivisions);
        assert!(wrong <= facet, "facets of {facet} are wrong up to height {wrong}");
        assert!(wrong <= last);
        last = wrong;
    }
}

#[test]
fn the_number_of_threads_does_not_matter() {
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 300);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| trace(&scene, &points, &rays(Pattern::Sobol, 64)).lights)
    };
    let strip = |images: Vec<LightImage>| -> Vec<LightImage> {
        images.into_iter().map(|image| LightImage { passes: Vec::new(), ..image }).collect()
    };
    let one = strip(on(1));
    assert_eq!(one, strip(on(3)));
    assert_eq!(one, strip(on(8)));
}

#[test]
fn nothing_is_ever_not_a_number() {
    // Coordinates over sixty orders of magnitude, receivers on top of everything.
    let magnitudes = [0.0f32, 1e-38, 1e-30, 1e-20, 1e-6, 1.0, 1e6, 1e12, 1e17];
    for &size in &magnitudes {
        for &height in &magnitudes {
            let meshes = vec![
                mesh(&quad([-size, size], height, [-1.0, 1.0])),
                mesh(&[[[0.0; 3], [size, height, 0.0], [1.0; 3]]]),
            ];
            let scene = scene(meshes, lights_of_every_shape());
            let points: Vec<DVec3> = magnitudes.iter().map(|&x| DVec3::new(x.into(), 0.0, 0.0)).collect();
            for light in trace(&scene, &points, &rays(Pattern::Sobol, 4)).lights {
                assert!(light.visibility.iter().all(|v| (0.0..=1.0).contains(v)), "{size} {height}");
                assert!(light.irradiance.iter().flatten().all(|e| e.is_finite() && *e >= 0.0), "{size} {height}");
            }
        }
    }
}
