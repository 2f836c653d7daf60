//! Numerical extremes: what the techniques with shadow maps must return at the edges of floating-point, size and shape.

mod common;
#[path = "common/drawn.rs"]
mod drawn;

use std::f64::consts::PI;

use common::*;
use drawn::*;
use glam::{DMat3, DVec2, DVec3, Vec3};
use penumbra::gpu::shadow_map::BIAS_TEXELS;
use penumbra::scene::{Mesh, Shape};
use penumbra::techniques::LightImage;

// ----------------------------------------------------------------------------------------------------------- size of the light

#[test]
fn a_light_too_small_for_f32_is_a_point() {
    let points = line(-2.0, 2.0, 200);
    for half in [1e-12, 1e-30, 1e-300] {
        for shape in [Shape::Rect { size: DVec2::splat(2.0 * half) }, Shape::Sphere { radius: half, facing: false }] {
            let scene = square_under(light_down(shape, [0.0, 5.0, 0.0]));
            for name in MAPPED {
                // C3: the step is at ½ · H/(H − h); the map and its kernel put it a texel (of 4 m/60) and the kernel off at most.
                let band = (if name.ends_with("pcf") { 1.0 + f64::from(PCF_RADIUS) } else { 1.0 }) * 4.0 / 60.0;
                for (point, v) in points.iter().zip(drawn(&scene, &points, mapped(name, 64).as_ref())) {
                    let step = 0.5 * 5.0 / 3.0;
                    if (point.x.abs() - step).abs() > band {
                        assert_eq!(v == 0.0, point.x.abs() < step, "{name} {shape:?}: {v} at {}", point.x);
                    }
                }
            }
        }
    }
}

#[test]
fn a_light_of_endless_size_is_sampled_far_away() {
    // The square's image is a millionth of the light's side: no point of 16 is in it, and all graze the floor at 4e-6 and less. What
    // one map from the middle makes of such a light is a number between 0 and 1, no more.
    let scene = square_under(square_light(5e6, 5.0));
    let points = line(-0.1, 0.1, 20);
    assert!(drawn(&scene, &points, mapped("uniform", 64).as_ref()).iter().all(|&v| v == 1.0));
    for name in DRAWN {
        draw(&scene, &points, mapped(name, 64).as_ref());
    }
}

// --------------------------------------------------------------------------------------------------------------- near and far

#[test]
fn an_occluder_approaching_the_light_hides_its_own_share() {
    // C1 from straight below: the image's half side is ¼ · H/h, between the second column of points from the middle and the third:
    // at 7/32 and 9/32 of a light 1 m wide. So hidden are 8 × 8 of 16 × 16.
    // Receivers within 5 cm and texels of 4 m/32 move what is hidden by less than 0.15 m/16: less than the hundredth of a metre from an
    // edge to the nearest column. 2^-16 is as near as maps see.
    let points = line(-2.0, 2.0, 200);
    let near: Vec<usize> = (0..points.len()).filter(|&i| points[i].x.abs() < 0.05).collect();
    for k in [4, 10, 15] {
        let height = 5.0 * (1.0 - 2f32.powi(-k));
        let scene = scene(vec![mesh(&quad([-0.25, 0.25], height, [-0.25, 0.25]))], vec![square_light(0.5, 5.0)]);
        let found = drawn(&scene, &points, technique("uniform", "samples=256 map_size=32").as_ref());
        assert!(near.iter().all(|&i| found[i] == 0.75), "h = H(1 - 2^-{k}): {found:?}");
        // The light's centre is behind it.
        let found = drawn(&scene, &points, mapped("hard", 32).as_ref());
        assert!(near.iter().all(|&i| found[i] == 0.0), "h = H(1 - 2^-{k}): {found:?}");
    }
}

#[test]
fn an_occluder_in_the_plane_of_the_light_does_not_block() {
    let points = line(-2.0, 2.0, 50);
    let at_light = scene(vec![mesh(&quad([-9.0, 9.0], 5.0, [-9.0, 9.0]))], vec![square_light(1.0, 5.0)]);
    for name in DRAWN {
        let found = drawn(&at_light, &points, mapped(name, 64).as_ref());
        assert!(found.iter().all(|&v| v == 1.0), "{name}: {found:?}");
    }
}

/// How high something must be over receivers along x, straight below a point light, to block: the bias of a map of `size`.
fn rise(points: &[DVec3], size: u32) -> f64 {
    // The width of the receivers over the texels that are left to them, as the plane of the receivers is seen head on.
    BIAS_TEXELS * (points[points.len() - 1].x - points[0].x) / f64::from(size - 2)
}

#[test]
fn an_occluder_that_touches_blocks_from_a_quarter_of_a_texel_on() {
    // What is lower is taken for the receivers' own relief: a known limit, and where it lies is known.
    let points = line(-0.2, 0.2, 20);
    for size in [32, 128, 1024] {
        let rise = rise(&points, size);
        for (height, expected) in [(0.0, 1.0), (0.9 * rise, 1.0), (1.1 * rise, 0.0), (4.0 * rise, 0.0)] {
            let cover = scene(
                vec![mesh(&quad([-2.0, 2.0], height as f32, [-2.0, 2.0]))],
                vec![light_down(Shape::Point, [0.0, 5.0, 0.0137])],
            );
            let found = drawn(&cover, &points, technique("hard", &format!("map_size={size}")).as_ref());
            assert!(found.iter().all(|&v| v == expected), "{height} m with {size} texels: {found:?}");
        }
    }
}

#[test]
fn depth_keeps_parallel_planes_apart_as_far_as_the_bias_does() {
    // 100 m below the light, where a half step of an f32 depth is 4e-6 m: the bias of a millimetre's receivers decides, not depth.
    for half in [0.5, 0.05, 0.005] {
        let points = line(-half, half, 20);
        let rise = rise(&points, 256);
        for (gap, expected) in [(0.8 * rise, 1.0), (1.25 * rise, 0.0)] {
            let light = light_down(Shape::Point, [0.0, 100.0, 0.0137]);
            let planes = [quad([-1.0, 1.0], gap as f32, [-1.0, 1.0]), quad([-1.0, 1.0], 0.0, [-1.0, 1.0])];
            let scene = scene(planes.map(|plane| mesh(&plane)).to_vec(), vec![light]);
            let found = drawn(&scene, &points, technique("hard", "map_size=256").as_ref());
            assert!(found.iter().all(|&v| v == expected), "{gap} m over {half}: {found:?}");
        }
    }
}

// ------------------------------------------------------------------------------------------------------------ place and scale

#[test]
fn visibility_does_not_change_with_scale() {
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 100);
    for name in DRAWN {
        let found = draw(&scene, &points, mapped(name, 64).as_ref());
        for exponent in [-30, -20, 20, 30] {
            let factor = 2f64.powi(exponent);
            let moved: Vec<DVec3> = points.iter().map(|&point| point * factor).collect();
            let rescaled = draw(&scaled(&scene, factor), &moved, mapped(name, 64).as_ref());
            same_bits(&format!("{name} × 2^{exponent}"), &found, &rescaled);
        }
    }
}

#[test]
fn a_shift_that_keeps_coordinates_exact_keeps_every_bit() {
    // All coordinates are multiples of 2^-6 (the spacing of floats up to 2^18 allows that), and so is the shift; up to 2^20 they are
    // multiples of 2^-3.
    let at = |name: &str, step: f64, shift: Vec3| {
        let snap = |mesh: &Mesh| Mesh {
            positions: mesh.positions.iter().map(|&p| (p * step as f32).round() / step as f32 + shift).collect(),
            ..mesh.clone()
        };
        let mut lights = lights_of_every_shape();
        for light in &mut lights {
            light.scene_from_light.translation =
                (light.scene_from_light.translation * step).round() / step + shift.as_dvec3();
        }
        let scene = scene(bumpy(Vec::new()).meshes.iter().map(snap).collect(), lights);
        let points = line(-1.5, 1.5, 96);
        let points: Vec<DVec3> = points.iter().map(|p| (p * step).round() / step + shift.as_dvec3()).collect();
        draw(&scene, &points, mapped(name, 64).as_ref())
    };
    for name in DRAWN {
        let found = at(name, 64.0, Vec3::ZERO);
        for shift in [Vec3::new(1e5, -7e4, 3e4), Vec3::new(-65_536.25, 131_072.5, 0.0)] {
            same_bits(&format!("{name} + {shift}"), &found, &at(name, 64.0, shift));
        }
        let shift = Vec3::new(1e6, -1e6, 5e5);
        same_bits(&format!("{name} + {shift}"), &at(name, 8.0, Vec3::ZERO), &at(name, 8.0, shift));
    }
}

// ---------------------------------------------------------------------------------------------------------- grazing and horizon

#[test]
fn a_lit_plane_has_no_acne_however_it_is_tilted() {
    // The light is small enough to stay above the horizon: at 89.9° its centre is 5 m · cos = 8.7 mm above the plane.
    let tilts = [0.1f64, 15.0, 45.0, 75.0, 85.0, 89.0, 89.9];
    // Towards all sides of the maps' texels.
    let all_tilts = [0.0f64, 100.0, 190.0, 280.0].iter().flat_map(|side| tilts.map(|degrees| (*side, degrees)));
    for (side, degrees) in all_tilts {
        let turn = DMat3::from_rotation_y(side.to_radians()) * DMat3::from_rotation_z(degrees.to_radians());
        let corner = |x: f64, z: f64| (turn * DVec3::new(x, 0.0, z)).as_vec3().to_array();
        let [a, b, c, d] = [corner(-4.0, -4.0), corner(4.0, -4.0), corner(4.0, 4.0), corner(-4.0, 4.0)];
        let lights = [
            light_down(Shape::Rect { size: DVec2::splat(2e-3) }, [0.0, 5.0, 0.0]),
            light_down(Shape::Sphere { radius: 1e-3, facing: false }, [0.0, 5.0, 0.0]),
            light_down(Shape::Point, [0.0, 5.0, 0.0]),
            light_down(Shape::Sun { angle: 1e-3 }, [0.0; 3]),
            light_down(Shape::Sun { angle: 0.0 }, [0.0; 3]),
        ];
        let scene = scene(vec![mesh(&[[a, c, b], [a, d, c]])], lights.to_vec());
        let mut random = Random(81);
        let points: Vec<DVec3> =
            (0..200).map(|_| turn * DVec3::new(random.between(-2.0, 2.0), 0.0, random.between(-2.0, 2.0))).collect();
        for name in DRAWN {
            for size in [64, 256] {
                let receivers = receivers(&scene, &points, turn * DVec3::Y);
                for (light, image) in
                    scene.lights.iter().zip(draw_receivers(&scene, receivers, mapped(name, size).as_ref()))
                {
                    let what = format!("{name} {size} {:?} at {degrees}° towards {side}°", light.shape);
                    let (lit, lowest) = (
                        image.visibility.iter().filter(|&&v| v == 1.0).count(),
                        image.visibility.iter().copied().fold(1.0, f32::min),
                    );
                    assert!(lit == points.len(), "{what}: {lit} of {} are lit, the least by {lowest}", points.len());
                }
            }
        }
    }
}

#[test]
fn a_light_in_the_plane_of_its_receiver_is_in_no_mask() {
    for tilt in [0.0, 0.3, 1.2] {
        let mut light = square_light(0.5, 0.0);
        let turn = DMat3::from_rotation_x(tilt);
        light.scene_from_light.matrix3 = turn * light.scene_from_light.matrix3;
        light.scene_from_light.translation = turn * DVec3::new(3.0, 0.0, 0.7);
        let scene = scene(vec![mesh(&quad([-9.0, 9.0], -8.0, [-9.0, 9.0]))], vec![light]);
        for name in DRAWN {
            let receivers = receivers(&scene, &[DVec3::ZERO], turn * DVec3::Y);
            let image = draw_receivers(&scene, receivers, mapped(name, 64).as_ref()).swap_remove(0);
            assert_eq!(
                (image.visibility[0], image.irradiance[0], image.facing[0]),
                (0.0, [0.0; 3], false),
                "{name} {tilt}"
            );
        }
    }
}

#[test]
fn half_of_a_light_that_the_horizon_halves_is_seen() {
    let scene = scene(vec![mesh(&quad([-9.0, 9.0], -1.0, [-9.0, 9.0]))], vec![square_light(0.5, 2.0)]);
    let seen = |name: &str, degrees: f64| {
        let normal = DMat3::from_rotation_z(degrees.to_radians()) * DVec3::Y;
        let receivers = receivers(&scene, &[DVec3::ZERO], normal);
        draw_receivers(&scene, receivers, mapped(name, 64).as_ref()).swap_remove(0)
    };
    for name in ["pcf", "pcss", "uniform"] {
        let half = seen(name, 90.0);
        // f64 turns by 90° to within 1e-16.
        assert_eq!((half.visibility[0], half.facing[0]), (0.5, true), "{name}");
        let sunk = seen(name, 135.0);
        assert_eq!((sunk.visibility[0], sunk.irradiance[0], sunk.facing[0]), (0.0, [0.0; 3], false), "{name}");
    }
}

#[test]
fn a_tessellated_sphere_is_lit_up_to_its_terminator_and_not_beyond() {
    // A convex body lies below each of its facets' planes: V of a facet that faces the light is 1, of any other 0, in any map. Against
    // the smooth sphere those facets are wrong that straddle its terminator, a band that narrows as they shrink.
    for (shape, at) in [(Shape::Sun { angle: 0.0 }, [0.0; 3]), (Shape::Point, [0.0, 4.0, 0.0])] {
        let mut last = f64::INFINITY;
        for subdivisions in [8u32, 16, 32] {
            let triangles = sphere(subdivisions);
            let ball = scene(vec![mesh(&triangles)], vec![light_down(shape, at)]);
            let mut facets = Vec::new();
            for [a, b, c] in triangles.iter().map(|t| t.map(|p| Vec3::from(p).as_dvec3())) {
                let normal = (b - a).cross(c - a);
                // Facets at the poles are flat lines.
                if normal.length() > 1e-9 {
                    let center = (a + b + c) / 3.0;
                    facets.push((center, normal.normalize() * normal.dot(center).signum()));
                }
            }
            let mut found = receivers(&ball, &facets.iter().map(|(center, _)| *center).collect::<Vec<_>>(), DVec3::Y);
            for (pixel, (_, normal)) in found.pixels.iter_mut().zip(&facets) {
                let receiver = pixel.as_mut().expect("all are there");
                (receiver.normal, receiver.shading_normal) = (*normal, *normal);
            }
            for name in MAPPED {
                for size in [32, 256] {
                    let image = draw_receivers(&ball, found.clone(), mapped(name, size).as_ref()).swap_remove(0);
                    let mut wrong = 0.0f64;
                    for ((center, normal), v) in facets.iter().zip(image.visibility) {
                        let to = if let Shape::Sun { .. } = shape { DVec3::Y } else { DVec3::from(at) - center };
                        // What is edge-on to within f32 may be either.
                        if normal.dot(to).abs() < 1e-5 {
                            continue;
                        }
                        let expected = if normal.dot(to) > 0.0 { 1.0 } else { 0.0 };
                        assert_eq!(v, expected, "{name} {size} {shape:?}: facet at {center}, {subdivisions}");
                        let smooth = if center.dot(to) > 0.0 { 1.0 } else { 0.0 };
                        if v != smooth {
                            wrong = wrong.max(center.normalize().dot(to.normalize()).abs());
                        }
                    }
                    let facet = PI / f64::from(subdivisions);
                    assert!(wrong <= facet, "facets of {facet} are wrong up to {wrong}");
                    // Of a sun the terminator is the equator, which facets' middles approach as they shrink.
                    if (name, size, shape) == ("hard", 256, Shape::Sun { angle: 0.0 }) {
                        assert!(wrong <= last);
                        last = wrong;
                    }
                }
            }
        }
    }
}

// ------------------------------------------------------------------------------------------------------------- odd geometry

#[test]
fn triangles_without_area_and_triangles_twice_change_nothing() {
    let square = quad([-0.5, 0.5], 2.0, [-0.5, 0.5]);
    let (a, b) = ([-0.5f32, 2.0, -0.5], [0.5f32, 2.0, 0.5]);
    let mut odd = square.clone();
    odd.extend(square.clone());
    // A point, a line, a line with a corner in its middle, and a triangle of the least width that f32 has there.
    odd.extend([[a, a, a], [a, b, b], [a, [0.0, 2.0, 0.0], b], [a, b, [0.0f32.next_up(), 2.0, 0.0]]]);
    // The other way around.
    odd.extend(square.iter().map(|&[a, b, c]| [a, c, b]));
    let points = line(-2.0, 2.0, 150);
    for name in DRAWN {
        let of = |triangles: &[[[f32; 3]; 3]]| {
            draw(&scene(vec![mesh(triangles)], lights_of_every_shape()), &points, mapped(name, 64).as_ref())
        };
        let [found, expected] = [of(&odd), of(&square)];
        if MAPPED.contains(&name) {
            same_bits(name, &expected, &found);
            continue;
        }
        // What adds up areas up to stored depths: of the same square turned over these may round otherwise. Sheets that are there twice
        // hide the same twice, which the points of the light take back in the mean: a limit of that technique, up to a tenth here.
        let bound = if name == "shadow-volumes" { 0.1 } else { 1e-5 };
        for (found, expected) in found.iter().zip(&expected) {
            for (v, expected) in found.visibility.iter().zip(&expected.visibility) {
                assert!((v - expected).abs() <= bound, "{name}: {v} for {expected}");
            }
        }
    }
}

#[test]
fn a_sliver_alone_blocks_at_most_a_row_of_texels() {
    // 1e-12 m wide: whether a row of texels' centres lies on it is chance, and there is one such row at most.
    let sliver =
        scene(vec![mesh(&quad([0.3, 0.3 + 3e-8], 2.0, [-1.0, 1.0]))], vec![light_down(Shape::Point, [0.0, 5.0, 0.0])]);
    for size in [32, 64, 128] {
        let points = line(-2.0, 2.0, 400);
        let found = drawn(&sliver, &points, technique("hard", &format!("map_size={size}")).as_ref());
        let blocked = found.iter().filter(|&&v| v == 0.0).count();
        // Receivers in a texel along x, however the map is turned: its diagonal.
        assert!(blocked as f64 <= 2f64.sqrt() * 400.0 / f64::from(size - 2) + 1.0, "{size}: {blocked}");
    }
}

#[test]
fn a_wire_thinner_than_a_texel_keeps_its_shadow_in_the_mean_over_placements() {
    // C7 for a light at infinity: ∫ψ dx = w. A map has it or misses it; over maps placed a 32nd of a texel apart the mean is right.
    let (width, size, placements) = (0.02, 64, 32);
    let light = light_down(Shape::Sun { angle: 0.0 }, [0.0; 3]);
    let strip = scene(vec![mesh(&quad([0.1, 0.1 + width as f32], 2.0, [-9.0, 9.0]))], vec![light]);
    let texel = 4.0 / f64::from(size - 2);
    let per_texel = 25;
    let count = per_texel * (size as usize - 2);
    let (mut sum, mut missed) = (0.0, 0);
    for i in 0..placements {
        // Receivers, and with them the map: their bounds are those of the first and the last.
        let offset = texel * f64::from(i) / f64::from(placements);
        let points = line(-2.0 + offset, 2.0 + offset, count);
        let found = drawn(&strip, &points, technique("hard", &format!("map_size={size}")).as_ref());
        let mass = found.iter().map(|&v| 1.0 - f64::from(v)).sum::<f64>() * 4.0 / count as f64;
        missed += u32::from(mass == 0.0);
        sum += mass;
    }
    let (mean, expected) = (sum / f64::from(placements), width);
    // The share of placements that see it is right to one of them, worth a texel; a texel holds 25 receivers give or take one.
    let bound = texel / f64::from(placements) + expected / per_texel as f64 + expected * 1e-2;
    assert!((mean - expected).abs() <= bound, "{mean} for {expected} ± {bound}");
    // As many miss it as a texel is wider than the shadow: 1 − 0.02/0.0645, give or take one.
    let expected = f64::from(placements) * (1.0 - expected / texel);
    assert!((f64::from(missed) - expected).abs() <= 1.5, "{missed} of {placements} miss it, expected {expected}");
}

#[test]
fn overlapping_shadows_are_united() {
    // Edges at 0 (1 m up) and at 0.2 m (3 m up) under a light at 5 m, seen from 0: they hide the light up to 0 and up to 1/3 of its half
    // side: of 6 × 6 points the columns at −5/6, −½, −1/6 and 1/6. The product of the two would be 1/6, the sum nothing.
    let lower = quad([-90.0, 0.0], 1.0, [-90.0, 90.0]);
    let upper = quad([-90.0, 0.2], 3.0, [-90.0, 90.0]);
    let scene = scene(vec![mesh(&lower), mesh(&upper)], vec![square_light(1.0, 5.0)]);
    // What is hidden moves by 4 m a metre: with receivers within 2 cm and half a texel's diagonal of 4 m/256, 0.125 m, less than the
    // half column of 1/6.
    let points = line(-2.0, 2.0, 400);
    let found = drawn(&scene, &points, technique("uniform", "samples=36 map_size=256").as_ref());
    let near: Vec<f32> = points.iter().zip(found).filter(|(point, _)| point.x.abs() < 0.02).map(|(_, v)| v).collect();
    assert_eq!(near, [(1.0f64 / 3.0) as f32; 4]);
}

// ---------------------------------------------------------------------------------------------------------- sums and repetition

#[test]
fn thousands_of_points_are_counted_exactly() {
    let scene = square_under(square_light(0.5, 5.0));
    let points = line(-2.0, 2.0, 200);
    let samples = 4096;
    let found = drawn(&scene, &points, technique("uniform", &format!("samples={samples} map_size=16")).as_ref());
    let mut partly = 0;
    for (point, v) in points.iter().zip(found) {
        // A share of 2^12 is exact in f32.
        assert_eq!((f64::from(v) * f64::from(samples)).fract(), 0.0, "{v} at {point}");
        partly += usize::from(0.0 < v && v < 1.0);
    }
    assert!(partly > 10, "{partly}");
}

#[test]
fn the_same_is_drawn_twice_and_on_any_number_of_threads() {
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 200);
    let strip = |images: Vec<LightImage>| -> Vec<LightImage> {
        images.into_iter().map(|image| LightImage { passes: Vec::new(), ..image }).collect()
    };
    for name in DRAWN {
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| strip(draw(&scene, &points, mapped(name, 64).as_ref())))
        };
        let one = on(1);
        assert_eq!(one, on(1), "{name}");
        assert_eq!(one, on(3), "{name}");
        assert_eq!(one, on(8), "{name}");
    }
}

#[test]
fn nothing_is_ever_not_a_number() {
    // Coordinates over sixty orders of magnitude, receivers on top of everything; what is drawn is checked as it is drawn.
    let magnitudes = [0.0f32, 1e-38, 1e-20, 1e-6, 1.0, 1e6, 1e17];
    for &size in &magnitudes {
        for &height in &magnitudes {
            let meshes = vec![
                mesh(&quad([-size, size], height, [-1.0, 1.0])),
                mesh(&[[[0.0; 3], [size, height, 0.0], [1.0; 3]]]),
            ];
            let points: Vec<DVec3> = magnitudes.iter().map(|&x| DVec3::new(x.into(), 0.0, 0.0)).collect();
            for name in DRAWN {
                let settings = match name {
                    "uniform" => "samples=4 map_size=8",
                    "shadow-volumes" => "",
                    _ => "map_size=8",
                };
                let technique = technique(name, settings);
                // Its maps look one way: one light may be refused, others not.
                let lights = lights_of_every_shape();
                let groups = if name == "soft-shadow-map" { lights.chunks(1) } else { lights.chunks(lights.len()) };
                let mut refused = 0;
                for lights in groups {
                    let scene = scene(meshes.clone(), lights.to_vec());
                    match try_draw(&scene, &points, technique.as_ref()) {
                        Ok(images) => assert_eq!(images.len(), lights.len(), "{name} {size} {height}"),
                        Err(error) => {
                            assert!(error.to_string().contains("looks one way"), "{name} {size} {height}: {error}");
                            refused += 1;
                        }
                    }
                }
                assert!(refused == 0 || (name == "soft-shadow-map" && refused < lights.len()), "{name} {refused}");
            }
        }
    }
}

#[test]
fn maps_of_one_texel_answer() {
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 50);
    for name in MAPPED {
        for size in [1, 2, 3] {
            let images = draw(&scene, &points, mapped(name, size).as_ref());
            assert!(images.iter().all(|image| image.visibility.len() == points.len()), "{name} {size}");
        }
    }
}
