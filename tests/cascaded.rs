//! Cascaded soft shadow maps, and the bilateral filter that they are held against: splits, seams, look-ups left out, filters.

mod common;
#[expect(dead_code, reason = "its small scenes are for tests of every technique")]
#[path = "common/drawn.rs"]
mod drawn;

use common::*;
use drawn::*;
use glam::DVec3;
use penumbra::Error;
use penumbra::progress::Progress;
use penumbra::receivers::Receivers;
use penumbra::render::{Rendering, Request, render};
use penumbra::scene::camera::look_at;
use penumbra::scene::procedural::build;
use penumbra::scene::{Camera, Projection, Scene};
use penumbra::shading::Shading;
use penumbra::techniques::cascaded::{Planes, planes, shares};
use penumbra::techniques::{Entry, Technique, parse_settings};

/// A scene's first camera's view.
fn view(scene: &Scene, technique: &dyn Technique, size: [u32; 2]) -> Rendering {
    let request = Request { size, irradiance: true, shaded: None, antialiasing: 1, verify: None };
    render(scene, &scene.cameras[0], technique, &request, &Progress::default()).expect("renders")
}

fn cascaded(settings: &str) -> Box<dyn Technique> {
    technique("cascaded", settings)
}

/// Receivers at the same place across a shadow, and farther and farther from a camera that looks along its edge.
fn along(scene: &Scene, x: f64, depths: &[f64]) -> Receivers {
    let points: Vec<DVec3> = depths.iter().map(|&depth| DVec3::new(x, 0.0, depth)).collect();
    let mut along = receivers(scene, &points, DVec3::Y);
    for (receiver, &depth) in along.pixels.iter_mut().flatten().zip(depths) {
        receiver.depth = depth;
    }
    along
}

/// A square light of half side 1 at height 5 over a half-plane at x < 0 and height 2 that goes on in depth: V depends on x alone.
fn long_edge() -> Scene {
    scene(vec![mesh(&quad([-1000.0, 0.0], 2.0, [-1000.0, 1000.0]))], vec![square_light(1.0, 5.0)])
}

#[test]
fn phongs_highlights_are_dimmed_as_irradiance_is() {
    let mut scene = build("demo").expect("builds").scene;
    scene.lights.truncate(1);
    let mut unshadowed = scene.clone();
    unshadowed.lights[0].casts_shadow = false;
    let shaded = |scene: &Scene, shading| {
        let request =
            Request { size: [64, 48], irradiance: true, shaded: Some(shading), antialiasing: 1, verify: None };
        render(scene, &scene.cameras[0], cascaded("").as_ref(), &request, &Progress::default()).expect("renders")
    };
    let (phong, lambert) = (shaded(&scene, Shading::Phong), shaded(&scene, Shading::Lambert));
    let lit = shaded(&unshadowed, Shading::Phong);
    let ratio = &phong.lights[0].irradiance_ratio;
    let (mut highlights, mut shadows) = (0, 0);
    let pixels = phong.shaded.iter().zip(&lambert.shaded).zip(lit.shaded.iter().zip(ratio));
    for (i, ((phong, lambert), (lit, &ratio))) in pixels.enumerate() {
        for (found, whole) in phong.iter().zip(lit) {
            assert!((found - whole * ratio).abs() <= 1e-6 * whole, "pixel {i}: {found}, {whole} times {ratio}");
        }
        highlights += u32::from(phong[1] > 1.05 * lambert[1]);
        shadows += u32::from(lit[1] > 0.0 && ratio < 1.0);
    }
    assert!(highlights > 10 && shadows > 300, "{highlights} pixels of highlights, {shadows} of shadows");
}

// --------------------------------------------------------------------------------------------------------------- splits

#[test]
fn planes_of_splits_are_the_papers_and_zhangs() {
    // n = 1, f = 100, m = 3: (1 + 100^(i/3)) terms by hand.
    for (form, expected) in [(Planes::Printed, [1.5, 5.1, 22.0, 100.0]), (Planes::Practical, [1.0, 19.3, 44.3, 100.0])]
    {
        for (found, expected) in planes(form, 1.0, 100.0, 3).into_iter().zip(expected) {
            assert!((found - expected).abs() <= 0.05, "{form:?}: {found}, expected {expected}");
        }
    }
    // Zhang's scale with what is seen; at no near plane it has no ratio.
    let scaled = |factor: f64| planes(Planes::Practical, 0.3 * factor, 17.0 * factor, 4);
    for power in [-20, 20] {
        let factor = 2f64.powi(power);
        assert_eq!(scaled(factor), scaled(1.0).into_iter().map(|plane| plane * factor).collect::<Vec<_>>());
    }
    assert_eq!(planes(Planes::Practical, 0.0, 9.0, 3), [0.0, 1.5, 3.0, 9.0]);
}

#[test]
fn every_depth_is_in_one_split_or_fades_between_two() {
    for form in [Planes::Printed, Planes::Practical] {
        for (near, far, count) in [(1.0, 100.0, 3), (0.0, 2.0, 8), (1.0, 1.3, 4), (5.0, 6.0, 1), (1e-9, 1e9, 2)] {
            let planes = planes(form, near, far, count);
            assert!(planes.is_sorted() && planes.len() == count + 1, "{planes:?}");
            for blend in [0.0, 0.25, 1.0] {
                let mut before: Option<[(usize, f32); 2]> = None;
                for i in 0..=1000 {
                    // Some beyond the planes on either side.
                    let depth = near - 0.1 + (far - near + 0.2) * f64::from(i) / 1000.0;
                    let [(one, a), (other, b)] = shares(&planes, blend, depth);
                    assert!(a >= 0.0 && b >= 0.0 && a + b == 1.0, "{a} + {b}");
                    assert!(one.max(other) < count && other - one <= 1, "{one} and {other} of {count}");
                    if blend == 0.0 {
                        assert_eq!((b, one), (0.0, planes[1..count].iter().filter(|&&plane| depth > plane).count()));
                    }
                    // Splits only ever grow.
                    let place = f64::from(one as u32) + f64::from(b);
                    let last = before.map_or(0.0, |[(one, _), (_, b)]| f64::from(one as u32) + f64::from(b));
                    assert!(place >= last - 1e-6, "{place} after {last}");
                    before = Some([(one, a), (other, b)]);
                }
            }
        }
    }
}

#[test]
fn seams_fade_with_blending_and_are_there_without() {
    let scene = long_edge();
    // A metre to the right of where the light's middle lies behind the edge V is near ½ + x k/(2 l); a grid of a row of k points has it
    // to ½k, and no two of 4, 3 and 2 have the same steps.
    let depths: Vec<f64> = (0..400).map(|i| 1.0 + 0.05 * f64::from(i)).collect();
    let planes = planes(Planes::Practical, depths[0], depths[399], 3);
    let largest = |blend: f64, x: f64| {
        let technique = cascaded(&format!("blend={blend} map_size=256"));
        let found = draw_receivers(&scene, along(&scene, x, &depths), technique.as_ref()).swap_remove(0).visibility;
        found.windows(2).map(|pair| f64::from((pair[0] - pair[1]).abs())).fold(0.0, f64::max)
    };
    for x in [-0.31, -0.1, 0.13, 0.29] {
        // Bands are `blend` times the narrower split wide; within one V goes from what k points see to what k − 1 do, each within half
        // a row of the truth, and a texel's column (1/256 of the light's view of the line, far below a row) beside.
        let narrowest = planes.windows(2).map(|pair| pair[1] - pair[0]).fold(f64::INFINITY, f64::min);
        let apart = 0.5 * (1.0 / 3.0 + 1.0 / 2.0);
        let bound = |blend: f64| 0.05 / (blend * narrowest) * apart + 1e-6;
        assert!(largest(0.5, x) <= bound(0.5), "{x}: {} above {}", largest(0.5, x), bound(0.5));
        assert!(largest(1.0, x) <= bound(1.0), "{x}: {} above {}", largest(1.0, x), bound(1.0));
    }
    // At −0.1: 4, 3 and 2 rows see it as ½ ∓ something: somewhere a whole step of a twelfth at least (½ − ⅓, ½ − ¼, ⅓ − ¼).
    let steps: Vec<f64> = [-0.31, -0.1, 0.13, 0.29].map(|x| largest(0.0, x)).into();
    assert!(steps.iter().any(|&step| step >= 1.0 / 12.0 - 1e-6), "{steps:?}");
}

#[test]
fn a_split_without_receivers_has_no_maps() {
    let scene = long_edge();
    let found = |depths: &[f64]| draw_receivers(&scene, along(&scene, 0.0, depths), cascaded("map_size=64").as_ref());
    // Near, middle and far; near and far; and one without depths, which is in the first.
    assert_eq!(found(&[1.0, 30.0, 100.0])[0].shadow_maps, 16 + 9 + 4);
    assert_eq!(found(&[1.0, 1.5, 99.0, 100.0])[0].shadow_maps, 16 + 4);
    assert_eq!(found(&[0.0; 3])[0].shadow_maps, 16);
    assert_eq!(found(&[7.0; 3])[0].shadow_maps, 16);
}

#[test]
fn each_split_holds_its_own_receivers_alone() {
    // Two groups far apart: each one's maps have as fine texels as if it were all there is.
    let scene = long_edge();
    let near: Vec<f64> = (0..64).map(|i| 1.0 + 0.01 * f64::from(i)).collect();
    let far: Vec<f64> = near.iter().map(|depth| depth + 80.0).collect();
    let technique = cascaded("points=16/16 map_size=32 blend=0");
    let visibility = |depths: &[f64]| {
        draw_receivers(&scene, along(&scene, 0.2, depths), technique.as_ref()).swap_remove(0).visibility
    };
    let both = visibility(&[near.clone(), far].concat());
    assert_eq!(both[..64], visibility(&near)[..]);
}

// -------------------------------------------------------------------------------------------------------------- samples

#[test]
fn one_split_without_filter_is_uniform_sampling() {
    for (spec, shape) in
        [("square", "rect"), ("contact", "disk"), ("edge", "sphere"), ("square", "sun"), ("strip", "tube")]
    {
        let scene = build(&format!("{spec}?shape={shape}")).expect("builds").scene;
        for (placement, uniform) in [("grid", "grid"), ("corners", "corners weights=equal")] {
            for points in [1, 4, 16, 25] {
                let settings = format!("points={points} placement={placement} refine=all filter=false map_size=128");
                let found = view(&scene, cascaded(&settings).as_ref(), [40, 30]).lights.swap_remove(0);
                let uniform = format!("samples={points} placement={uniform} map_size=128");
                let expected = view(&scene, technique("uniform", &uniform).as_ref(), [40, 30]).lights.swap_remove(0);
                assert_eq!(found.visibility, expected.visibility, "{spec} {shape} {settings}");
                assert_eq!(found.shadow_maps, expected.shadow_maps, "{spec} {shape} {settings}");
                let unfiltered = format!("points={points} placement={placement} taps=1 map_size=128");
                let bilateral =
                    view(&scene, technique("bilateral", &unfiltered).as_ref(), [40, 30]).lights.swap_remove(0);
                assert_eq!(bilateral.visibility, expected.visibility, "{spec} {shape} {unfiltered}");
            }
        }
    }
}

#[test]
fn look_ups_in_the_penumbra_alone_leave_the_rest_as_it_is() {
    let size = [160, 120];
    let mut saved = 0;
    for spec in ["square", "edge?angle=30", "contact", "tilt", "two-edges", "demo"] {
        let scene = build(spec).expect("builds").scene;
        let of = |settings: &str| {
            let technique = cascaded(&format!("filter=false map_size=256 {settings}"));
            view(&scene, technique.as_ref(), size).lights.swap_remove(0)
        };
        let [all, split, tile] = ["all", "split", "tile"].map(|refine| of(&format!("refine={refine}")));
        // The paper's rule looks all points up in a split where something is in penumbra, and has nothing to find in others.
        assert_eq!(all.visibility, split.visibility, "{spec}");
        assert!(tile.texels <= all.texels && split.texels <= all.texels, "{spec}");
        saved += all.texels - tile.texels;
        let mut off = 0;
        for (&found, &expected) in tile.visibility.iter().zip(&all.visibility) {
            if found != expected {
                // What was not looked up is what the four points near the corners agree about.
                assert!(found == 0.0 || found == 1.0, "{spec}: {found} for {expected}");
                off += 1;
            }
        }
        // Of one edge or one convex caster, four points near the corners of a light miss nothing.
        let allowed = if spec == "demo" { size[0] * size[1] / 50 } else { 0 };
        assert!(off <= allowed, "{spec}: {off} differ");
    }
    assert!(saved > 0);
}

// --------------------------------------------------------------------------------------------------------------- filter

/// RMS of the errors of V in penumbra, by a closed form.
fn closed_form_rmse(spec: &str, technique: &dyn Technique, size: u32) -> f64 {
    let procedural = build(spec).expect("builds");
    let rendering = view(&procedural.scene, technique, [size; 2]);
    let truth = procedural.truth.as_ref().expect("has a truth");
    let (mut sum, mut count) = (0.0, 0u32);
    for (receiver, &v) in rendering.receivers.pixels.iter().flatten().zip(&rendering.lights[0].visibility) {
        let expected = truth.visibility(receiver.position + procedural.scene.origin_world);
        if 0.0 < expected && expected < 1.0 {
            sum += (f64::from(v) - expected).powi(2);
            count += 1;
        }
    }
    assert!(count > 100, "only {count} receivers in penumbra");
    (sum / f64::from(count)).sqrt()
}

#[test]
fn the_filter_makes_ramps_of_the_steps_between_points() {
    // A parallel edge: k points a row and four taps in each cell are 4k steps, off by an evenly spread half of one; the edge is where
    // a texel and the tap's pixel say, each evenly spread over its own width in a penumbra of 2 l h/(H − h) = 4/3 m. The view is
    // 4 m wide, and its tiles reach 32 px beyond.
    for points in [4u32, 9, 16, 25] {
        let (pixels, texels) = (200.0, 512.0);
        let step = 1.0 / (4.0 * f64::from(points).sqrt());
        let texel = 4.0 * (1.0 + 32.0 / pixels) / texels / (4.0 / 3.0);
        let pixel = 4.0 / pixels / (4.0 / 3.0);
        let bound = (step + texel + pixel) / 12f64.sqrt();
        let settings = format!("points={points} map_size=512");
        let found = closed_form_rmse("edge", cascaded(&settings).as_ref(), 200);
        assert!(found <= bound, "{points}: {found} above {bound}");
        // Without it the steps are whole.
        let plain = closed_form_rmse("edge", cascaded(&format!("{settings} filter=false")).as_ref(), 200);
        assert!(found < 0.5 * plain, "{points}: {found}, without {plain}");
    }
}

#[test]
fn filters_cross_no_edge_of_a_surface() {
    // From above: a lit square over its own shadow, which surrounds it on the screen; in one mesh with the floor, or apart from it.
    let (square, floor) = (quad([-0.5, 0.5], 0.5, [-0.5, 0.5]), quad([-2.0, 2.0], 0.0, [-2.0, 2.0]));
    let meshes = [vec![mesh(&square), mesh(&floor)], vec![mesh(&[square.clone(), floor.clone()].concat())]];
    for meshes in meshes {
        let mut scene = scene(meshes, vec![square_light(0.5, 3.0)]);
        scene.cameras.push(Camera {
            name: "down".into(),
            scene_from_camera: look_at(
                DVec3::new(0.0, 4.0, 0.0) - scene.origin_world,
                -scene.origin_world,
                DVec3::NEG_Z,
            ),
            projection: Projection::Perspective { fov_y: 0.6 },
            near: 0.1,
            far: 100.0,
        });
        for technique in
            [cascaded("refine=all map_size=256"), technique("bilateral", "map_size=256 sigma_visibility=1000")]
        {
            let rendering = view(&scene, technique.as_ref(), [96, 96]);
            let (mut on_top, mut in_penumbra) = (0, 0);
            for (receiver, &v) in rendering.receivers.pixels.iter().flatten().zip(&rendering.lights[0].visibility) {
                if receiver.position.y + scene.origin_world.y > 0.25 {
                    assert_eq!(v, 1.0, "{:?}", receiver.position);
                    on_top += 1;
                }
                in_penumbra += u32::from(v > 0.0 && v < 1.0);
            }
            assert!(on_top > 500 && in_penumbra > 100, "{on_top}, {in_penumbra}");
        }
    }
}

#[test]
fn the_bilateral_filter_keeps_what_its_sigmas_keep() {
    let scene = build("square").expect("builds").scene;
    let of = |settings: &str| {
        view(&scene, technique("bilateral", &format!("map_size=128 {settings}")).as_ref(), [64, 48])
            .lights
            .swap_remove(0)
    };
    // Neighbours of other V, or farther than none, count nothing: e^−½(1/625/0.001)² is below 2^-24 of the pixel's own.
    let plain = of("taps=1");
    let close = of("sigma_visibility=0.001");
    let changed = |found: &[f32]| plain.visibility.iter().zip(found).filter(|(a, b)| (*a - *b).abs() > 1e-6).count();
    assert_eq!(changed(&close.visibility), 0);
    assert!(changed(&of("sigma_visibility=1000").visibility) > 100);
}

// ------------------------------------------------------------------------------------------------------------- extremes

#[test]
fn a_light_without_extent_casts_hard_shadows_and_a_huge_one_none_that_are_not_numbers() {
    for name in ["cascaded", "bilateral"] {
        let of = |light: &str| {
            let scene = build(&format!("square?light={light}")).expect("builds").scene;
            view(&scene, technique(name, "map_size=256").as_ref(), [64, 48]).lights.swap_remove(0).visibility
        };
        // All points are one, and all taps the receiver's own pixel.
        let tiny = of("1e-30");
        assert!(tiny.iter().all(|&v| v == 0.0 || v == 1.0) && tiny.contains(&0.0) && tiny.contains(&1.0), "{name}");
        // Of a light of 2e6 m at 5 m the square hides nothing that 25 points could tell, were one not above it.
        let huge = of("1e6");
        assert!(huge.iter().all(|v| (0.0..=1.0).contains(v)), "{name}");
    }
}

#[test]
fn lengths_in_other_units_change_no_bit() {
    for name in ["cascaded", "bilateral"] {
        for spec in ["contact", "tilt"] {
            let of = |scale: &str| {
                let scene = build(&format!("{spec}?scale={scale}")).expect("builds").scene;
                view(&scene, technique(name, "map_size=128").as_ref(), [64, 48]).lights.swap_remove(0).visibility
            };
            for scale in ["2^-20", "2^20"] {
                assert_eq!(of(scale), of("1"), "{name} {spec} {scale}");
            }
        }
    }
}

#[test]
fn casters_at_two_depths_are_off_by_what_the_grid_is_for_each() {
    // Each edge is off by half a row at most, evenly spread; the filter, as wide as the mean of both blockers moves the shadow, averages
    // over less than a row: by so much again. Two of them are off by the sum at most (Minkowski). A texel and a pixel, of 4 m in 512 and
    // 160, move an edge by so much of the narrower penumbra, 2 l h/(H - h) = ½ m (h = 1, H = 5).
    for (name, rows) in [("cascaded", 4.0), ("bilateral", 5.0)] {
        let moved = 4.0 / 512.0 + 4.0 / 160.0;
        let bound = 2.0 * (2.0 / rows + moved / 0.5) / 12f64.sqrt();
        let found = closed_form_rmse("two-edges", technique(name, "map_size=512").as_ref(), 160);
        assert!(found <= bound, "{name}: {found} above {bound}");
    }
}

// ----------------------------------------------------------------------------------------------------------- parameters

#[test]
fn both_ends_of_every_parameter_render() {
    let scene = build("square").expect("builds").scene;
    for settings in [
        "points=1",
        "points=1024 map_size=16",
        "points=1/1/1/1/1/1/1/1",
        "points=4/9/16/25/16/9/4/1",
        "placement=corners",
        "planes=printed",
        "range=camera",
        "planes=printed range=camera",
        "refine=all",
        "refine=split",
        "blend=0",
        "blend=1",
        "filter=false",
        "kernels=1",
        "kernels=15",
        "kernels=15/1/15",
        "map_size=1",
        "map_size=1/2/3",
        "points=1 map_size=16384",
    ] {
        let found = view(&scene, cascaded(settings).as_ref(), [32, 24]).lights.swap_remove(0);
        assert!(found.visibility.iter().all(|v| (0.0..=1.0).contains(v)), "{settings}");
    }
    for settings in [
        "points=1",
        "points=1024 map_size=16",
        "placement=corners",
        "taps=1",
        "taps=31",
        "sigma_distance=0.01 sigma_normal=0.001 sigma_visibility=0.001",
        "sigma_distance=1000 sigma_normal=1000 sigma_visibility=1000",
        "map_size=1",
        "points=1 map_size=16384",
    ] {
        let found = view(&scene, technique("bilateral", settings).as_ref(), [32, 24]).lights.swap_remove(0);
        assert!(found.visibility.iter().all(|v| (0.0..=1.0).contains(v)), "{settings}");
    }
}

#[test]
fn what_is_out_of_range_is_refused_in_one_line() {
    for (name, settings, expected) in [
        ("cascaded", "points=15", "parameter points of cascaded: expected up to 8 squares of 1 to 32, found 15"),
        ("cascaded", "points=16/9/4/4/4/4/4/4/4", "expected up to 8 squares"),
        ("cascaded", "points=0", "expected up to 8 squares"),
        ("cascaded", "points=1089", "expected up to 8 squares"),
        ("cascaded", "points=16/a", "parameter points of cascaded: expected whole numbers as 16/9/4, found \"16/a\""),
        ("cascaded", "kernels=0", "parameter kernels of cascaded: expected 1 to 15, found 0"),
        ("cascaded", "map_size=0/1/1", "parameter map_size of cascaded: expected 1 to 16384, found 0/1/1"),
        ("cascaded", "blend=1.1", "expected 0 to 1"),
        ("bilateral", "taps=4", "expected an odd number, found 4"),
        ("bilateral", "sigma_normal=0", "expected 0.001 to 1000"),
    ] {
        let parameters = parse_settings(settings).expect("settings");
        let error: Error = (Entry::find(name).expect("there is").build)(&CONTEXT, &parameters).expect_err("refused");
        let told = error.to_string();
        assert!(told.contains(expected) && !told.contains('\n'), "{settings}: {told}");
    }
}

#[test]
fn presets_render_every_scene() {
    for name in ["cascaded", "bilateral"] {
        let entry = Entry::find(name).expect("there is");
        for (preset, settings) in entry.presets {
            for spec in ["contact", "tilt", "demo"] {
                let scene = build(spec).expect("builds").scene;
                let found = view(&scene, technique(name, settings).as_ref(), [48, 36]);
                assert!(found.lights.iter().all(|light| light.shadow_maps > 0), "{name} {preset} {spec}");
            }
        }
    }
}
