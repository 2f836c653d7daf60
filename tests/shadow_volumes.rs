//! `shadow-volumes`: exact where the light's centre sees the outline that all of the light sees, and its faults as stated.

mod common;
#[expect(dead_code, reason = "its settings for tests are not needed")]
#[path = "common/drawn.rs"]
mod drawn;

use std::f64::consts::PI;

use common::*;
use drawn::{CONTEXT, draw, draw_receivers, drawn, technique};
use glam::{DAffine3, DVec2, DVec3};
use penumbra::closed_forms::{disk_edge_fraction, occluder_image};
use penumbra::gpu::Gpu;
use penumbra::progress::Progress;
use penumbra::receivers::Receivers;
use penumbra::reference::exact::Exact;
use penumbra::render::{Request, render, render_receivers};
use penumbra::scene::{AreaLight, Cutout, Material, Mesh, Scene, Shape, procedural};
use penumbra::techniques::{Context, Entry, Technique, parse_settings};

const NAME: &str = "shadow-volumes";

fn volumes(settings: &str) -> Box<dyn Technique> {
    technique(NAME, settings)
}

/// Both presets.
const PRESETS: [&str; 2] = ["points=0", ""];

/// How far V may be off where so many edges are before a light of half side `half`, as far above its casters' edges as `ratio` of its
/// height over theirs says, in a scene no larger than `reach` metres.
///
/// A vertex and a receiver are rounded by √3 · 2^-25 of the reach each, their difference, three products and two sums for each
/// coordinate by 2^-24 each: 10 · 2^-24 together, magnified by the ratio. An edge that moves by so much of the half side changes V by
/// 2/π of that at most, on a disk; the share itself has 2^-21.
fn rounding(edges: f64, reach: f64, ratio: f64, half: f64) -> f64 {
    edges * (10.0 * 2f64.powi(-24) * reach * ratio / half * 2.0 / PI + 2f64.powi(-21))
}

fn assert_close(what: &str, found: &[f32], truth: &[f64], tolerance: f64) {
    for (i, (&v, &truth)) in found.iter().zip(truth).enumerate() {
        assert!((f64::from(v) - truth).abs() <= tolerance, "{what}: {v} for {truth} at {i}, {tolerance} allowed");
    }
}

/// [`assert_close`], and exact where all of the light is seen or none of it, but for the very border of a penumbra.
fn assert_near(what: &str, found: &[f32], truth: &[f64], tolerance: f64) {
    assert_close(what, found, truth, tolerance);
    for (i, (&v, &expected)) in found.iter().zip(truth).enumerate() {
        let alone = truth[i.saturating_sub(1)..truth.len().min(i + 2)].iter().all(|&other| other == expected);
        assert!(!(alone && (expected == 0.0 || expected == 1.0)) || f64::from(v) == expected, "{what}: {v} at {i}");
    }
}

/// A closed box, its front outwards.
fn solid([x0, x1]: [f32; 2], [y0, y1]: [f32; 2], [z0, z1]: [f32; 2]) -> Vec<[[f32; 3]; 3]> {
    let at = |i: usize| [[x0, x1][i & 1], [y0, y1][i >> 1 & 1], [z0, z1][i >> 2 & 1]];
    let faces = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    faces.iter().flat_map(|&[a, b, c, d]| [[at(a), at(b), at(c)], [at(a), at(c), at(d)]]).collect()
}

fn floor() -> Mesh {
    mesh(&quad([-2.5, 2.5], 0.0, [-2.5, 2.5]))
}

// ----------------------------------------------------------------------------------------------------------- closed forms

#[test]
fn an_edge_hides_what_lies_beyond_it() {
    // Long enough to be a half-plane, as seen by all receivers, before a light 1 m wide.
    let caster = mesh(&quad([-4.0, 0.0], 2.0, [-4.0, 4.0]));
    let half = 0.5;
    let shapes = [
        Shape::Rect { size: DVec2::splat(1.0) },
        Shape::Rect { size: DVec2::new(1.0, 0.25) },
        Shape::Disk { size: DVec2::splat(1.0) },
        Shape::Disk { size: DVec2::new(1.0, 0.25) },
    ];
    // C3 and C4, by where the edge is seen on the light, in half sides.
    let seen = |shape: Shape, t: f64| match shape {
        Shape::Disk { .. } => disk_edge_fraction(-t),
        _ => ((1.0 - t) / 2.0).clamp(0.0, 1.0),
    };
    let points = line(-2.0, 2.0, 401);
    for shape in shapes {
        let scene = scene(vec![caster.clone(), floor()], vec![light_down(shape, [0.0, 5.0, 0.0])]);
        let truth: Vec<f64> = points.iter().map(|p| seen(shape, occluder_image(p.x, 0.0, 2.0, 5.0) / half)).collect();
        for preset in PRESETS {
            let found = drawn(&scene, &points, volumes(preset).as_ref());
            assert_near(&format!("{shape:?} {preset}"), &found, &truth, rounding(1.0, 8.0, 2.5, half));
        }
    }
    // The edge right before the centre: from any side of the tie, half of the light.
    let scene = scene(vec![caster], vec![square_light(half, 5.0)]);
    let found = drawn(&scene, &[DVec3::ZERO, DVec3::new(0.0, 0.0, 1.0)], volumes("").as_ref());
    assert_near("at the centre", &found, &[0.5; 2], rounding(1.0, 8.0, 2.5, half));
}

#[test]
fn a_plate_is_exact_before_lights_of_every_shape() {
    // A square with a square hole: an outline of two loops.
    let ring = [
        quad([-0.5, 0.5], 2.0, [-0.5, -0.2]),
        quad([-0.5, 0.5], 2.0, [0.2, 0.5]),
        quad([-0.5, -0.2], 2.0, [-0.2, 0.2]),
        quad([0.2, 0.5], 2.0, [-0.2, 0.2]),
    ];
    let scene = scene(vec![mesh(&ring.concat()), floor()], lights_of_every_shape());
    let points = line(-2.0, 2.0, 200);
    let truth = exact(&scene, &receivers(&scene, &points, DVec3::Y));
    for preset in PRESETS {
        let found = draw(&scene, &points, volumes(preset).as_ref());
        for ((light, truth), found) in scene.lights.iter().zip(&truth).zip(&found) {
            let truth: Vec<f64> = truth.iter().map(|answer| answer.visibility).collect();
            // Twelve edges and where loops touch; the narrowest half axes are 0.1 m, the sun's 0.05 at distance 1, where heights are
            // not magnified but divided by.
            let ratio = if matches!(light.shape, Shape::Sun { .. }) { 1.0 / 2.0 } else { 2.0 };
            let half = if matches!(light.shape, Shape::Sun { .. }) { 0.05 } else { 0.1 };
            let tolerance = rounding(16.0, 4.0, ratio, half);
            let what = format!("{:?} {preset}", light.shape);
            if let Shape::Sphere { facing: false, .. } = light.shape {
                // The silhouette's radius is that of the middle of the receivers, r √(1 − r²/d²): off by less than r²/2d² of itself
                // for d from 3.9 m; at most eight edges within a radius, 2/π of V each.
                let of_size = 8.0 * 2.0 / PI * 0.5 * (0.5f64 / 3.9).powi(2);
                assert_close(&what, &found.visibility, &truth, tolerance + of_size);
            } else {
                assert_near(&what, &found.visibility, &truth, tolerance);
            }
        }
    }
}

#[test]
fn a_box_that_shows_the_whole_light_its_top_alone_is_exact() {
    // The light is within the column over the box, so that what is hidden is hidden by the top.
    let block = solid([-0.6, 0.5], [1.0, 2.0], [-0.5, 0.7]);
    let inward: Vec<_> = block.iter().map(|&[a, b, c]| [a, c, b]).collect();
    let light = || light_down(Shape::Rect { size: DVec2::new(0.8, 0.6) }, [0.0, 4.0, 0.1]);
    let points = line(-2.4, 2.4, 301);
    for (what, block) in [("outward", block), ("inward", inward)] {
        let scene = scene(vec![mesh(&block), floor()], vec![light()]);
        let truth = exact_visibility(&scene, &points);
        assert!(truth.contains(&0.0) && truth.contains(&1.0) && truth.iter().any(|v| (0.1..0.9).contains(v)));
        for preset in PRESETS {
            let found = drawn(&scene, &points, volumes(preset).as_ref());
            assert_near(&format!("{what} {preset}"), &found, &truth, rounding(4.0, 4.0, 2.0, 0.3));
        }
    }
}

/// Receivers that lean away from a light 4 m up until it is all but gone, its centre as far over their horizons.
fn leaning(scene: &Scene, centre_over: std::ops::Range<f64>) -> Receivers {
    let mut places = Receivers { size: [0, 1], pixels: Vec::new() };
    for i in 0..40 {
        let angle = 0.9 + 0.8 * f64::from(i) / 40.0;
        for axis in [DVec3::new(1.0, 0.0, 0.3), DVec3::new(-0.7, 0.0, 1.0)] {
            let normal = (angle.cos() * DVec3::Y + angle.sin() * axis.normalize()).normalize();
            let is_taken = |p: &DVec3| centre_over.contains(&normal.dot(DVec3::new(0.0, 4.0, 0.0) - *p));
            let positions: Vec<DVec3> = line(-1.0, 1.0, 20).into_iter().filter(is_taken).collect();
            places.pixels.extend(receivers(scene, &positions, normal).pixels);
        }
    }
    places.size[0] = places.pixels.len() as u32;
    places
}

fn exact_at(scene: &Scene, places: &Receivers) -> Vec<f64> {
    exact(scene, places)[0].iter().map(|answer| answer.visibility).collect()
}

#[test]
fn a_point_lights_all_around() {
    // From some places of the floor it is seen by more than a right angle from where the middle sees it.
    let scene = scene(
        vec![mesh(&quad([-0.2, 0.3], 0.7, [-0.4, 0.5])), mesh(&quad([-30.0, 30.0], 0.0, [-30.0, 30.0]))],
        vec![light_down(Shape::Point, [0.1, 1.1, 0.0])],
    );
    let points = line(-25.0, 3.0, 400);
    let truth = exact_visibility(&scene, &points);
    assert!(truth.contains(&0.0) && truth.contains(&1.0));
    for preset in PRESETS {
        let found = drawn(&scene, &points, volumes(preset).as_ref());
        assert!(found.iter().zip(&truth).all(|(v, truth)| f64::from(*v) == *truth), "{preset}: {found:?}");
    }
}

#[test]
fn where_the_horizon_hides_the_centre_points_over_it_tell() {
    let caster = mesh(&quad([0.2, 0.8], 3.0, [-0.3, 0.9]));
    for shape in [Shape::Rect { size: DVec2::new(3.0, 2.0) }, Shape::Disk { size: DVec2::new(3.0, 2.0) }] {
        let light = || vec![light_down(shape, [0.0, 4.0, 0.0])];
        let scene = scene(vec![caster.clone()], light());
        let places = leaning(&scene, -2.0..-0.01);
        let truth = exact_at(&scene, &places);
        let bare = common::scene(vec![mesh(&quad([0.2, 0.8], -9.0, [-0.3, 0.9]))], light());
        let alone = exact_at(&bare, &leaning(&bare, -2.0..-0.01));
        let found = draw_receivers(&scene, places, volumes("points=256").as_ref()).swap_remove(0).visibility;
        let [mut whole, mut part] = [0; 2];
        for ((&v, &truth), &alone) in found.iter().zip(&truth).zip(&alone) {
            if (truth - alone).abs() < 1e-9 {
                whole += usize::from(truth > 0.0);
                assert!((f64::from(v) - truth).abs() < 1e-5, "{shape:?}: {v} for {truth}");
            } else {
                part += 1;
                assert!((f64::from(v) - truth).abs() < 0.02, "{shape:?}: {v} for {truth} of {alone}");
            }
        }
        assert!(whole > 20 && part > 50, "{whole} {part}");
    }
}

#[test]
fn a_horizon_across_the_light_cuts_it_and_what_is_hidden_of_it() {
    let caster = mesh(&quad([-0.5, 0.5], 2.0, [-0.3, 0.9]));
    for shape in [Shape::Rect { size: DVec2::new(3.0, 2.0) }, Shape::Disk { size: DVec2::new(3.0, 2.0) }] {
        let scene = scene(vec![caster.clone()], vec![light_down(shape, [0.0, 4.0, 0.0])]);
        let places = leaning(&scene, 0.1..9.0);
        let truth = exact_at(&scene, &places);
        let cut = truth.iter().filter(|v| (0.05..0.95).contains(*v)).count();
        assert!(cut > 500, "{cut}");
        for preset in PRESETS {
            let found = draw_receivers(&scene, places.clone(), volumes(preset).as_ref()).swap_remove(0);
            // Four edges, and the horizon behind each of them.
            assert_close(&format!("{shape:?} {preset}"), &found.visibility, &truth, rounding(8.0, 4.0, 2.0, 1.0));
        }
    }
}

// ----------------------------------------------------------------------------------------------------------- meshes as they come

#[test]
fn an_edge_of_three_faces_ends_each_of_them() {
    // A plate, and from the middle of it a fin up to the left and one down to the right: seen from above, three plates side by side
    // and over each other, of which two meet the third at one edge.
    let plate =
        [[[0.0, 2.0, -1.0], [0.6, 2.0, -1.0], [0.6, 2.0, 1.0]], [[0.0, 2.0, -1.0], [0.6, 2.0, 1.0], [0.0, 2.0, 1.0]]];
    let fin = |x: f32, y: f32| {
        [[[0.0, 2.0, -1.0], [x, y, -1.0], [x, y, 1.0]], [[0.0, 2.0, -1.0], [x, y, 1.0], [0.0, 2.0, 1.0]]]
    };
    // Two faces go on where the third ends.
    let of = |faces: &[[[f32; 3]; 3]]| scene(vec![mesh(faces), floor()], vec![square_light(0.3, 4.0)]);
    let all = of(&[plate, fin(-0.6, 2.2), fin(-0.5, 1.8)].concat());
    let points = line(-2.0, 2.0, 201);
    let truth = exact_visibility(&all, &points);
    // What two fins hide is hidden twice: on 256 points whose projections are a 256th apart, the ends of what they overlap on are as
    // far off at most.
    let found = drawn(&all, &points, volumes("points=256").as_ref());
    assert_close("three faces", &found, &truth, rounding(6.0, 4.0, 2.5, 0.3) + 2.0 / 256.0);
    // One of them turned around, and without the lower fin: nothing is hidden twice, and no edge is left over in the middle.
    let turned = |faces: [[[f32; 3]; 3]; 2]| faces.map(|[a, b, c]| [a, c, b]);
    let bent = of(&[turned(plate), fin(-0.6, 2.2)].concat());
    let truth = exact_visibility(&bent, &points);
    for preset in PRESETS {
        let found = drawn(&bent, &points, volumes(preset).as_ref());
        assert_near(&format!("bent {preset}"), &found, &truth, rounding(4.0, 4.0, 2.5, 0.3));
    }
}

#[test]
fn an_open_box_hides_what_a_closed_one_does_to_the_points_spacing() {
    // Without its bottom all of its faces are sheets: what passes a side and the top is hidden twice, which the paper's sum shows.
    let open: Vec<_> =
        solid([-0.6, 0.5], [1.0, 2.0], [-0.5, 0.7]).into_iter().filter(|t| t.iter().any(|p| p[1] > 1.0)).collect();
    assert_eq!(open.len(), 10);
    let light = light_down(Shape::Rect { size: DVec2::new(0.8, 0.6) }, [0.0, 4.0, 0.1]);
    let scene = scene(vec![mesh(&open), floor()], vec![light]);
    let points = line(-2.4, 2.4, 301);
    let truth = exact_visibility(&scene, &points);
    let errors = |settings: &str| {
        let found = drawn(&scene, &points, volumes(settings).as_ref());
        found.iter().zip(&truth).map(|(v, truth)| (f64::from(*v) - truth).abs()).fold(0.0, f64::max)
    };
    // At each receiver two upright edges bound what is hidden twice, each to a point's spacing.
    assert!(errors("points=256") <= 2.0 / 256.0 + rounding(8.0, 4.0, 2.0, 0.3), "{}", errors("points=256"));
    assert!(errors("points=64") <= 2.0 / 64.0 + rounding(8.0, 4.0, 2.0, 0.3), "{}", errors("points=64"));
    assert!(errors("points=0") > 0.2, "{}", errors("points=0"));
}

#[test]
fn triangles_share_edges_wherever_they_meet_and_not_where_they_do_not() {
    // A plate as two triangles, as loose ones, as many: no seam is seen.
    let whole = scene(vec![mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5])), floor()], lights_of_every_shape());
    let mut many = Vec::new();
    for i in 0..8 {
        for j in 0..8 {
            let at = |i: i32| (i - 4) as f32 / 8.0;
            many.extend(quad([at(i), at(i + 1)], 2.0, [at(j), at(j + 1)]));
        }
    }
    let fine = scene(vec![mesh(&many), floor()], lights_of_every_shape());
    let points = line(-2.0, 2.0, 200);
    for preset in PRESETS {
        let [whole, fine] = [&whole, &fine].map(|scene| draw(scene, &points, volumes(preset).as_ref()));
        for ((a, b), light) in whole.iter().zip(&fine).zip(lights_of_every_shape()) {
            // The outline is in 32 parts now, of which four to sixteen are before the light.
            let tolerance = rounding(20.0, 4.0, 2.0, 0.05);
            let b: Vec<f64> = b.visibility.iter().map(|&v| f64::from(v)).collect();
            assert_near(&format!("{:?} {preset}", light.shape), &a.visibility, &b, tolerance);
        }
    }
}

// ----------------------------------------------------------------------------------------------------------- faults

#[test]
fn what_two_casters_hide_counts_twice_in_the_paper_and_once_on_points() {
    // Below a light 2 m wide at 5 m: at 1 m what spans 0 to 0.1 m, at 3 m what spans 0.06 to 0.3 m. From the origin they hide 0 to 0.5
    // and 0.1 to 0.5 half sides of the light: a quarter of it together; areas that are added up make 9/20 of that.
    let lower = mesh(&quad([0.0, 0.1], 1.0, [-3.0, 3.0]));
    let upper = mesh(&quad([0.06, 0.3], 3.0, [-3.0, 3.0]));
    let scene = scene(vec![lower, upper], vec![square_light(1.0, 5.0)]);
    let points = [DVec3::new(0.0, 0.0, 0.0137)];
    assert!((exact_visibility(&scene, &points)[0] - 0.75).abs() < 1e-6);
    let tolerance = rounding(4.0, 4.0, 5.0, 1.0);
    assert_near("paper", &drawn(&scene, &points, volumes("points=0").as_ref()), &[0.55], tolerance);
    for count in [16, 64, 256] {
        let found = drawn(&scene, &points, volumes(&format!("points={count}")).as_ref());
        // What both hide ends at two edges along an axis, on which the points are one of `count` apart.
        assert_close(&format!("{count} points"), &found, &[0.75], tolerance + 2.0 / f64::from(count));
    }
    let overlapping = |settings: &str| drawn(&scene, &line(-2.0, 2.0, 200), volumes(settings).as_ref());
    assert!(overlapping("points=0").iter().zip(overlapping("")).all(|(paper, best)| *paper <= best + 1e-6));
}

#[test]
fn a_ball_hides_less_than_it_should_of_a_light_that_sees_more_of_it_than_its_centre() {
    // A known fault: from near a ball, the rim of a wide light sees past the outline that the centre sees.
    let scene = scene(vec![mesh(&sphere(16)), floor()], vec![square_light(2.0, 3.0)]);
    let points: Vec<DVec3> = line(1.2, 2.4, 50).into_iter().map(|p| p - DVec3::new(0.0, 1.0, 0.0)).collect();
    let truth = exact_visibility(&scene, &points);
    let found = drawn(&scene, &points, volumes("").as_ref());
    let worst = found.iter().zip(&truth).map(|(v, truth)| (f64::from(*v) - truth).abs()).fold(0.0, f64::max);
    assert!(worst > 0.05, "{worst}");
    // Before a small light it is right to what the outline moves by as the point that sees it moves across the light.
    let small = AreaLight { shape: Shape::Rect { size: DVec2::splat(0.02) }, ..square_light(0.01, 3.0) };
    let scene = common::scene(vec![mesh(&sphere(16)), floor()], vec![small]);
    let truth = exact_visibility(&scene, &points);
    let found = drawn(&scene, &points, volumes("").as_ref());
    let agree = found.iter().zip(&truth).filter(|(v, truth)| (f64::from(**v) - **truth).abs() < 0.05).count();
    assert!(agree >= 48, "{agree} of 50");
}

#[test]
fn cut_outs_are_refused_in_one_line_where_they_can_block() {
    let mut leaf = mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5]));
    leaf.material = Some(0);
    let cutout = Some(Cutout { cutoff: 0.5, factor: 1.0, texture: None });
    let mut scene = scene(vec![leaf, floor()], vec![square_light(0.5, 5.0)]);
    scene.materials.push(Material { name: "leaf".into(), cutout, ..Material::default() });
    let places = || receivers(&scene, &line(-1.0, 1.0, 9), DVec3::Y);
    let refused = render_receivers(&scene, places(), volumes("").as_ref(), false, &Progress::default());
    let message = refused.expect_err("it has no edges").to_string();
    assert_eq!(
        message,
        "shadow-volumes of light \"light\": \"node 0\" has cut-outs (alphaMode MASK), which have no edges"
    );
    // What does not block the light may have any.
    let mut linked = scene.clone();
    linked.lights[0].shadow_exclude = vec!["node 0".into()];
    assert!(drawn(&linked, &line(-1.0, 1.0, 9), volumes("").as_ref()).iter().all(|&v| v == 1.0));
}

// ----------------------------------------------------------------------------------------------------------- extremes

#[test]
fn a_lit_floor_is_lit_and_the_inside_of_a_closed_box_dark() {
    let sunlit = scene(vec![floor()], lights_of_every_shape());
    let boxed = scene(vec![mesh(&solid([-2.0, 2.0], [-0.5, 1.0], [-2.0, 2.0])), floor()], lights_of_every_shape());
    for preset in PRESETS {
        for (lit, dark) in draw(&sunlit, &line(-2.0, 2.0, 200), volumes(preset).as_ref()).iter().zip(draw(
            &boxed,
            &line(-1.5, 1.5, 100),
            volumes(preset).as_ref(),
        )) {
            assert!(lit.visibility.iter().all(|&v| v == 1.0), "{preset} {:?}", lit.visibility);
            assert!(dark.visibility.iter().all(|&v| v == 0.0), "{preset} {:?}", dark.visibility);
        }
    }
}

#[test]
fn a_light_of_no_size_casts_the_hard_shadow_and_a_huge_one_a_number() {
    let points = line(-2.0, 2.0, 200);
    let lights = [
        Shape::Rect { size: DVec2::splat(1e-30) },
        Shape::Disk { size: DVec2::splat(1e-300) },
        Shape::Rect { size: DVec2::new(0.0, 0.0) },
        Shape::Point,
    ];
    for shape in lights {
        let scene = square_under(light_down(shape, [0.0, 5.0, 0.0]));
        for (point, v) in points.iter().zip(drawn(&scene, &points, volumes("").as_ref())) {
            // C3: the step is at ½ · H/(H − h), which no receiver of f32 is on.
            assert_eq!(v, if point.x.abs() < 2.5 / 3.0 { 0.0 } else { 1.0 }, "{shape:?} at {}", point.x);
        }
    }
    // The square's image is 2.5 m of a light of 1e7 m, which is rounded away.
    let scene = square_under(square_light(5e6, 5.0));
    assert!(drawn(&scene, &points, volumes("").as_ref()).iter().all(|&v| (v - 1.0).abs() < 1e-5));
}

#[test]
fn scaling_by_powers_of_two_changes_no_bit() {
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 60);
    for preset in PRESETS {
        let one = draw(&scene, &points, volumes(preset).as_ref());
        for exponent in [-20, 20] {
            let factor = 2f64.powi(exponent);
            let moved: Vec<DVec3> = points.iter().map(|&point| point * factor).collect();
            let found = draw(&scaled(&scene, factor), &moved, volumes(preset).as_ref());
            same_bits(&format!("{preset} × 2^{exponent}"), &one, &found);
        }
    }
}

#[test]
fn a_shift_by_instances_changes_no_more_than_roundings() {
    let block = || mesh(&solid([-0.6, 0.5], [1.0, 2.0], [-0.5, 0.7]));
    let shift = DVec3::new(4096.0, -512.0, 1024.0);
    let at = |shift: DVec3| {
        let light = light_down(Shape::Rect { size: DVec2::new(0.8, 0.6) }, (DVec3::new(0.0, 4.0, 0.1) + shift).into());
        let scene = placed_scene(vec![block(), floor()], DAffine3::from_translation(shift), vec![light]);
        let points: Vec<DVec3> = line(-2.0, 2.0, 100).into_iter().map(|p| p + shift).collect();
        drawn(&scene, &points, volumes("").as_ref())
    };
    let moved: Vec<f64> = at(shift).into_iter().map(f64::from).collect();
    assert_near("shifted", &at(DVec3::ZERO), &moved, 2.0 * rounding(4.0, 4.0, 2.0, 0.3));
}

#[test]
fn two_runs_have_the_same_bits() {
    let run = || {
        let procedural = procedural::build("demo").expect("builds");
        let request = Request { size: [64, 48], irradiance: false, shaded: None, antialiasing: 1, verify: None };
        let camera = &procedural.scene.cameras[0];
        render(&procedural.scene, camera, volumes("").as_ref(), &request, &Progress::default()).expect("renders").lights
    };
    same_bits("demo", &run(), &run());
}

#[test]
fn lists_longer_than_a_loop_are_worked_off_in_steps() {
    // 1,600 small plates, 6,400 edges, all before the light of each receiver; with 256 points a step takes 923 of them.
    let plates: Vec<_> = (0..1600)
        .flat_map(|i| {
            let at = |i: i32| (i - 20) as f32 / 40.0;
            let (x, z) = (at(i % 40), at(i / 40));
            quad([x, x + 1.0 / 64.0], 2.0, [z, z + 1.0 / 64.0])
        })
        .collect();
    let scene = scene(vec![mesh(&plates), floor()], vec![square_light(1.0, 5.0)]);
    let points = line(-0.3, 0.3, 20);
    let truth = exact_visibility(&scene, &points);
    for settings in ["points=0", "points=256"] {
        let found = drawn(&scene, &points, volumes(settings).as_ref());
        // Each edge is so long that 80 of them make one across the light.
        assert_near(settings, &found, &truth, rounding(6400.0 / 80.0, 4.0, 2.5, 1.0) + 6400.0 * 2f64.powi(-24));
    }
}

#[test]
fn without_receivers_or_casters_nothing_is_hidden() {
    let scene = square_under(square_light(0.5, 5.0));
    let none = Receivers { size: [3, 1], pixels: vec![None; 3] };
    let found = draw_receivers(&scene, none, volumes("").as_ref());
    assert_eq!(found[0].visibility, [1.0; 3]);
    // Without casters, all is lit.
    let empty = common::scene(vec![floor()], vec![square_light(0.5, 5.0)]);
    assert!(drawn(&empty, &line(-2.0, 2.0, 40), volumes("").as_ref()).iter().all(|&v| v == 1.0));
}

#[test]
fn every_end_of_its_parameter_gives_an_answer_and_what_is_beyond_is_refused() {
    let scene = scene(vec![mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5])), floor()], lights_of_every_shape());
    let points = line(-2.0, 2.0, 40);
    for settings in ["points=0", "points=4", "points=64", "points=256"] {
        for image in draw(&scene, &points, volumes(settings).as_ref()) {
            assert_eq!(image.visibility.len(), points.len(), "{settings}");
        }
    }
    for (settings, expected) in [
        ("points=257", "0 to 256"),
        ("points=-4", "0 to 256"),
        ("points=6", "a multiple of 4, found 6"),
        ("map_size=1", "unknown"),
    ] {
        let parameters = parse_settings(settings).expect("settings");
        let error = (Entry::find(NAME).expect("registered").build)(&CONTEXT, &parameters).expect_err("refused");
        assert!(error.to_string().contains(expected), "{settings}: {error}");
    }
}

/// As [`volumes`], on a GPU that binds no more than 64 KiB at once.
fn on_a_small_gpu(settings: &str) -> Box<dyn Technique> {
    let lower = |limits: wgpu::Limits| wgpu::Limits { max_storage_buffer_binding_size: 1 << 16, ..limits };
    let context = Context::from(Gpu::open_limited(lower).expect("a GPU, or a software one"));
    let parameters = parse_settings(settings).expect("settings");
    (Entry::find(NAME).expect("registered").build)(&context, &parameters).expect("builds")
}

#[test]
fn receivers_in_many_buffers_have_the_same_bits() {
    // 240 receivers a buffer, with 16 bytes and 64 counts each.
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 1000);
    let [whole, parts] = [volumes(""), on_a_small_gpu("")].map(|technique| draw(&scene, &points, technique.as_ref()));
    same_bits("parts", &whole, &parts);
}

#[test]
fn casters_that_do_not_fit_are_refused_in_one_line() {
    let scene = scene(vec![mesh(&sphere(64)), floor()], vec![square_light(0.5, 5.0)]);
    let places = receivers(&scene, &line(-2.0, 2.0, 9), DVec3::Y);
    let refused = render_receivers(&scene, places, on_a_small_gpu("").as_ref(), false, &Progress::default());
    let message = refused.expect_err("does not fit").to_string();
    assert!(message.starts_with("GPU: ") && message.contains("the casters' vertices would take"), "{message}");
    assert_eq!(message.lines().count(), 1);
}

// ----------------------------------------------------------------------------------------------------------- error

/// V of the key light of a procedural scene.
fn view(scene: &str, technique: &dyn Technique) -> Vec<f32> {
    let procedural = procedural::build(scene).expect("builds");
    let mut scene: Scene = procedural.scene;
    scene.lights.truncate(1);
    let request = Request { size: [48; 2], irradiance: false, shaded: None, antialiasing: 1, verify: None };
    let camera = scene.cameras[0].clone();
    render(&scene, &camera, technique, &request, &Progress::default())
        .expect("renders")
        .lights
        .swap_remove(0)
        .visibility
}

#[test]
fn it_is_nearer_to_the_truth_than_patches_of_a_map() {
    for scene in ["demo", "contact", "two-edges", "tilt"] {
        let truth = view(scene, &Exact);
        let rmse = |technique: &dyn Technique| {
            let found = view(scene, technique);
            let errors: Vec<f64> = found
                .iter()
                .zip(&truth)
                .filter(|(_, t)| 0.0 < **t && **t < 1.0)
                .map(|(v, truth)| f64::from(v - truth))
                .collect();
            (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
        };
        let (best, paper) = (rmse(volumes("").as_ref()), rmse(volumes("points=0").as_ref()));
        let [patches, bits] = ["soft-shadow-map", "bitmask"].map(|name| rmse(technique(name, "").as_ref()));
        assert!(best < patches && best < bits && best <= paper, "{scene}: {best}, {paper}; {patches}, {bits}");
    }
}
