//! `bitmask`: the bits that one occluder hides are those that lie behind it, whatever hides them and however often.

mod common;
#[expect(dead_code, reason = "its settings for tests are not needed")]
#[path = "common/drawn.rs"]
mod drawn;

use common::*;
use drawn::{CONTEXT, draw, drawn, technique};
use glam::DVec2;
use penumbra::closed_forms::occluder_image;
use penumbra::progress::Progress;
use penumbra::reference::exact::Exact;
use penumbra::render::{Request, render};
use penumbra::scene::{Scene, Shape, procedural};
use penumbra::techniques::{Entry, LightImage, Technique, parse_settings};

fn bitmask(settings: &str) -> Box<dyn Technique> {
    technique("bitmask", settings)
}

fn floor() -> Vec<[[f32; 3]; 3]> {
    quad([-9.0, 9.0], 0.0, [-9.0, 9.0])
}

/// An upright rectangle at `x`.
fn wall(x: f32, [low, high]: [f32; 2], z: [f32; 2]) -> Vec<[[f32; 3]; 3]> {
    let [a, b, c, d] = [[x, low, z[0]], [x, high, z[0]], [x, high, z[1]], [x, low, z[1]]];
    vec![[a, b, c], [a, c, d]]
}

/// A half-plane at height 2 that covers x < 0, below a light at 5 m.
fn half_plane(shape: Shape) -> Scene {
    let caster = mesh(&quad([-90.0, 0.0], 2.0, [-90.0, 90.0]));
    scene(vec![caster, mesh(&floor())], vec![light_down(shape, [0.0, 5.0, 0.0])])
}

/// The share of a light's bits that lie beyond an edge at `t`, in half sides of the light.
fn bits_beyond(t: f64, side: u32, is_disk: bool) -> f64 {
    let at = |i: u32| (2.0 * f64::from(i) + 1.0) / f64::from(side) - 1.0;
    let bits: Vec<[f64; 2]> = (0..side * side).map(|i| [at(i % side), at(i / side)]).collect();
    let lit = bits.iter().filter(|[u, v]| !is_disk || u * u + v * v <= 1.0);
    let (beyond, all) = lit.fold((0, 0), |(beyond, all), [u, _]| (beyond + u32::from(*u >= t), all + 1));
    f64::from(beyond) / f64::from(all)
}

#[test]
fn one_edge_hides_the_bits_behind_it() {
    let (half, points) = (0.5, line(-2.0, 2.0, 301));
    for (shape, is_disk) in [
        (Shape::Rect { size: DVec2::splat(2.0 * half) }, false),
        (Shape::Rect { size: DVec2::new(2.0 * half, 6.0) }, false),
        (Shape::Disk { size: DVec2::splat(2.0 * half) }, true),
    ] {
        let scene = half_plane(shape);
        for (own, texels_off) in [("", 0.5), ("patches=texels", 0.5), ("patches=quads", 1.0), ("shrink=0", 0.5)] {
            for (side, size) in [(16, 513), (8, 128), (5, 128), (1, 513)] {
                let found = drawn(&scene, &points, bitmask(&format!("side={side} map_size={size} {own}")).as_ref());
                // The map holds a box around the 4 m of receivers up to the occluder, 3 of 5 m from the light: a texel is so wide on
                // the floor. Half of one is half of 3/5 of it at the occluder, and 5/2 of that on the light. Roundings are far below.
                let texel = 4.0 * 5.0 / 3.0 / f64::from(size - 2);
                let off = texels_off * 1.5 * texel / half + 1e-4;
                for (point, &v) in points.iter().zip(&found) {
                    let edge = occluder_image(point.x, 0.0, 2.0, 5.0) / half;
                    let [least, most] = [off, -off].map(|off| bits_beyond(edge + off, side, is_disk) as f32);
                    assert!(
                        (least - 1e-6..=most + 1e-6).contains(&v),
                        "{shape:?} {side} {size} {own}: {v} outside of {least} to {most} at {}",
                        point.x
                    );
                }
            }
        }
    }
}

#[test]
fn a_bit_is_a_sixty_fourth_or_a_two_hundred_and_fifty_sixth() {
    let scene = square_under(square_light(0.5, 5.0));
    for (preset, bits) in [("paper", 64.0), ("12x12", 256.0), ("best", 256.0)] {
        let parameters = Entry::find("bitmask").expect("registered").preset(preset).expect("a preset");
        let built = (Entry::find("bitmask").expect("registered").build)(&CONTEXT, &parameters).expect("builds");
        let found = drawn(&scene, &line(-2.0, 2.0, 100), built.as_ref());
        assert!(found.iter().all(|v| (v * bits).fract() == 0.0), "{preset}: {found:?}");
        assert!(found.iter().any(|v| 0.0 < *v && *v < 1.0), "{preset}");
    }
}

#[test]
fn what_is_hidden_twice_counts_once() {
    // A plate drawn once, twice, in two abutting and in two overlapping pieces is the same in the map, and so on the light.
    let piece = |x: [f32; 2]| mesh(&quad(x, 2.0, [-0.5, 0.5]));
    let whole = [-0.5, 0.5];
    let points = line(-2.0, 2.0, 200);
    let of = |pieces: Vec<_>, settings: &str| {
        draw(&scene(pieces, lights_of_every_shape()), &points, bitmask(&format!("map_size=256 {settings}")).as_ref())
    };
    for settings in ["", "search=8 side=8 patches=texels", "search=12 patches=texels"] {
        let alone = of(vec![piece(whole)], settings);
        for pieces in [
            vec![piece(whole), piece(whole)],
            vec![piece([-0.5, 0.0]), piece([0.0, 0.5])],
            vec![piece([-0.5, 0.25]), piece([-0.25, 0.5])],
        ] {
            same_bits(settings, &of(pieces, settings), &alone);
        }
    }
}

#[test]
fn casters_at_two_depths_overlap_on_the_light_and_count_once() {
    // Below a light 2 m wide at 5 m: at 1 m what spans 0 to 0.1 m, at 3 m what spans 0.06 to 0.3 m. Seen from the light's centre,
    // at tangents of 0 to 1/40 and 3/100 to 3/20, neither covers the other. From the origin they hide 0 to 0.5 m and 0.1 to 0.5 m of
    // the light: a quarter of it together; areas that are added up make 9/20 of that.
    let lower = mesh(&quad([0.0, 0.1], 1.0, [-9.0, 9.0]));
    let upper = mesh(&quad([0.06, 0.3], 3.0, [-9.0, 9.0]));
    let scene = scene(vec![lower, upper, mesh(&floor())], vec![square_light(1.0, 5.0)]);
    let points = line(-0.002, 0.002, 5);
    let truth = exact_visibility(&scene, &points);
    let added = drawn(&scene, &points, technique("min-max-backprojection", "tolerance=0").as_ref());
    for settings in ["", "patches=texels", "side=8"] {
        let side = if settings == "side=8" { 8.0 } else { 16.0 };
        let found = drawn(&scene, &points, bitmask(settings).as_ref());
        for ((v, truth), added) in found.iter().zip(&truth).zip(&added) {
            // Two edges, half a column of bits each; a texel less than another half, for both.
            assert!((f64::from(*v) - truth).abs() <= 1.5 / side, "{settings}: {v} for {truth}");
            assert!(f64::from(*added) < truth - 0.15, "areas no longer add up: {added} for {truth}");
        }
    }
}

#[test]
fn a_disk_has_no_bits_in_its_corners() {
    // From the origin it hides what is beyond 0.75 half sides on both axes: outside of the disk.
    let caster = mesh(&quad([0.15, 1.0], 2.0, [0.15, 1.0]));
    let of = |shape| scene(vec![caster.clone()], vec![light_down(shape, [0.0, 5.0, 0.0])]);
    let points = line(-0.001, 0.001, 3);
    let round = drawn(&of(Shape::Disk { size: DVec2::ONE }), &points, bitmask("").as_ref());
    assert!(round.iter().all(|&v| v == 1.0), "{round:?}");
    let square = drawn(&of(Shape::Rect { size: DVec2::ONE }), &points, bitmask("").as_ref());
    assert!(square.iter().all(|&v| v < 1.0), "{square:?}");
}

#[test]
fn every_shape_meets_the_truth_to_half_a_row_an_edge() {
    let points = line(-2.0, 2.0, 200);
    let caster = mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5]));
    let scene = scene(vec![caster, mesh(&floor())], lights_of_every_shape());
    let truth = exact(&scene, &receivers(&scene, &points, glam::DVec3::Y));
    let found = draw(&scene, &points, bitmask("").as_ref());
    for ((light, truth), found) in scene.lights.iter().zip(&truth).zip(&found) {
        let errors: Vec<f64> =
            truth.iter().zip(&found.visibility).map(|(truth, &v)| f64::from(v) - truth.visibility).collect();
        let rmse = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        // Four edges; of each the error is uniform within half a row of 16, on a disk 4/π of that at most.
        let bound = 4.0 * 4.0 / std::f64::consts::PI / (16.0 * 12f64.sqrt());
        assert!(light.shape == Shape::Point || rmse <= bound, "{:?}: {rmse} above {bound}", light.shape);
    }
}

#[test]
fn a_light_of_no_size_casts_the_hard_shadow_and_a_huge_one_a_number() {
    let points = line(-2.0, 2.0, 200);
    let caster = mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5]));
    let of = |half: f64| {
        let scene = scene(vec![caster.clone()], vec![square_light(half, 5.0)]);
        drawn(&scene, &points, bitmask("map_size=128").as_ref())
    };
    for (point, v) in points.iter().zip(of(1e-30)) {
        // Within a texel of the step either may be.
        if (point.x.abs() - 5.0 / 6.0).abs() > 4.0 / 126.0 {
            assert_eq!(v == 0.0, point.x.abs() < 5.0 / 6.0, "{v} at {}", point.x);
        }
    }
    // The square's image is 2.5 m of a light of 1e7 m: nothing is hidden but what a texel is worth.
    assert!(of(5e6).iter().all(|v| (0.0..=1.0).contains(v)));
}

#[test]
fn a_lit_plane_has_no_acne_and_a_plate_close_above_it_no_light_below() {
    let sunlit = scene(vec![mesh(&floor())], lights_of_every_shape());
    // As far above the receivers as four texels of the coarsest map are wide, 64 on at most 3 m: what is nearer than two, the bias, is
    // taken for the floor. From 0.9 m the light's image ends 0.05 m short of the plate's edge at least.
    let pressed = scene(vec![mesh(&quad([-1.0, 1.0], 0.2, [-1.0, 1.0]))], lights_of_every_shape());
    for settings in ["map_size=64", "map_size=256 shrink=0 patches=texels", "map_size=256"] {
        let technique = bitmask(settings);
        for (light, image) in sunlit.lights.iter().zip(draw(&sunlit, &line(-2.0, 2.0, 200), technique.as_ref())) {
            assert!(image.visibility.iter().all(|&v| v == 1.0), "{settings} {:?}", light.shape);
        }
        for (light, image) in pressed.lights.iter().zip(draw(&pressed, &line(-0.9, 0.9, 60), technique.as_ref())) {
            assert!(image.visibility.iter().all(|&v| v == 0.0), "{settings} {:?}", light.shape);
        }
    }
}

#[test]
fn scaling_by_powers_of_two_changes_no_bit() {
    let points = line(-2.0, 2.0, 100);
    let at = |scale: f64| {
        let s = scale as f32;
        let caster = quad([-0.5 * s, 0.5 * s], 2.0 * s, [-0.5 * s, 0.5 * s]);
        let scene = scene(vec![mesh(&caster)], vec![square_light(0.5 * scale, 5.0 * scale)]);
        let scaled: Vec<_> = points.iter().map(|&p| p * scale).collect();
        drawn(&scene, &scaled, bitmask("map_size=128").as_ref())
    };
    let one = at(1.0);
    for exponent in [-20, 20] {
        assert_eq!(at(2f64.powi(exponent)), one, "2^{exponent}");
    }
}

#[test]
fn a_wall_through_the_lights_plane_hides_what_is_beyond_it_once() {
    let wall = wall(0.3, [1.0, 9.0], [-1.0, 1.0]);
    let points = line(-2.0, 2.0, 100);
    let all = scene(vec![mesh(&wall), mesh(&floor())], lights_of_every_shape());
    for image in draw(&all, &points, bitmask("map_size=128").as_ref()) {
        assert!(image.visibility.iter().all(|v| (0.0..=1.0).contains(v)));
    }
    // Beside a light 3 m wide it hides what is beyond 0.3 m, two fifths. Seen edge on, its texels lie at many depths and overlap in the
    // light's plane, where bits count once: half a column, and one for the last texel of the map, which stands for all beyond.
    let wide = scene(
        vec![mesh(&wall), mesh(&floor())],
        vec![light_down(Shape::Rect { size: DVec2::new(3.0, 0.5) }, [0.0, 4.0, 0.0])],
    );
    let found = drawn(&wide, &points, bitmask("map_size=512").as_ref());
    for (point, v) in points.iter().zip(&found).filter(|(point, _)| point.x < -1.9) {
        assert!((v - 0.6).abs() <= 1.5 / 16.0, "{v} at {}", point.x);
    }
}

#[test]
fn every_end_of_every_parameter_gives_an_answer() {
    let scene = scene(vec![mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5]))], lights_of_every_shape());
    let points = line(-2.0, 2.0, 40);
    for settings in [
        "map_size=1",
        "map_size=2",
        "map_size=3 patches=texels",
        "near=0.001",
        "near=1",
        "side=1",
        "side=16",
        "search=1",
        "search=96",
        "shrink=0",
        "shrink=8",
        "patches=texels",
        "patches=quads",
    ] {
        let map = if settings.contains("map_size") { "" } else { "map_size=64" };
        for image in draw(&scene, &points, bitmask(&format!("{map} {settings}")).as_ref()) {
            assert_eq!(image.visibility.len(), points.len(), "{settings}");
        }
    }
    let refusal = |settings: &str| {
        let parameters = parse_settings(settings).expect("settings");
        let built = (Entry::find("bitmask").expect("registered").build)(&CONTEXT, &parameters);
        built.err().map_or_else(|| "none".to_owned(), |error| error.to_string())
    };
    for (settings, expected) in [
        ("map_size=0", "1 to 16384"),
        ("near=0", "0.001 to 1"),
        ("side=17", "1 to 16"),
        ("search=97", "1 to 96"),
        ("shrink=9", "0 to 8"),
        ("patches=gaps", "texels, quads, joined"),
    ] {
        assert!(refusal(settings).contains(expected), "{settings}: {}", refusal(settings));
    }
}

/// The key light of a procedural scene's view.
fn view(scene: &str, technique: &dyn Technique) -> LightImage {
    let procedural = procedural::build(scene).expect("builds");
    let request = Request { size: [48; 2], irradiance: false, shaded: None, antialiasing: 1, verify: None };
    let camera = &procedural.scene.cameras[0];
    render(&procedural.scene, camera, technique, &request, &Progress::default()).expect("renders").lights.swap_remove(0)
}

#[test]
fn it_is_nearer_to_the_truth_than_dense_pcss_and_with_more_texels_the_more_so() {
    for scene in ["demo", "contact", "two-edges"] {
        let truth = view(scene, &Exact);
        let rmse = |technique: &dyn Technique| {
            let found = view(scene, technique);
            let pairs = found.visibility.iter().zip(&truth.visibility);
            let errors: Vec<f64> =
                pairs.filter(|(_, t)| 0.0 < **t && **t < 1.0).map(|(v, truth)| f64::from(v - truth)).collect();
            (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
        };
        let best = rmse(bitmask("").as_ref());
        let paper = rmse(bitmask("search=8 side=8 patches=texels").as_ref());
        let pcss = rmse(technique("pcss", "dense=true").as_ref());
        assert!(best < pcss && best < paper, "{scene}: {best} against {pcss} and {paper}");
    }
}
