//! Every technique against every closed form it can meet (C1-C9), with tolerances that follow from its number of samples.

mod common;

use std::f64::consts::PI;

use common::*;
use glam::DVec3;
use penumbra::closed_forms::shadow_mass;
use penumbra::progress::Progress;
use penumbra::render::{Rendering, Request, render};
use penumbra::sampling::{Pattern, Sampler};
use penumbra::scene::procedural::{Procedural, Truth, build};
use penumbra::techniques::{ALL, Context, Entry, Technique, parse_settings};

/// RMSE of V over random half-plane edges for 16, 81, 256 and 1024 samples of a square: what a pattern can do at best,
/// measured apart from any renderer (Sobol': not worse than jittered).
const SAMPLING_FLOOR: [(Pattern, [f64; 4]); 4] = [
    (Pattern::Grid, [0.030, 0.0095, 0.0036, 0.0014]),
    (Pattern::Jittered, [0.044, 0.013, 0.0056, 0.0019]),
    (Pattern::Halton, [0.049, 0.0135, 0.0060, 0.0021]),
    (Pattern::Sobol, [0.044, 0.013, 0.0056, 0.0019]),
];
const COUNTS: [u32; 4] = [16, 81, 256, 1024];

/// V − truth wherever the truth is a penumbra.
fn penumbra_errors(rendering: &Rendering, origin_world: DVec3, truth: &Truth) -> Vec<f64> {
    let pixels = rendering.receivers.pixels.iter().flatten().zip(&rendering.lights[0].visibility);
    pixels
        .filter_map(|(receiver, &v)| {
            let expected = truth.visibility(receiver.position + origin_world);
            (0.0 < expected && expected < 1.0).then(|| f64::from(v) - expected)
        })
        .collect()
}

fn rmse(errors: &[f64]) -> f64 {
    (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
}

fn render_view(procedural: &Procedural, technique: &dyn Technique, size: u32) -> Rendering {
    let request = Request { size: [size, size], irradiance: true, shaded: None, antialiasing: 1, verify: None };
    let scene = &procedural.scene;
    render(scene, &scene.cameras[0], technique, &request, &Progress::default()).expect("renders")
}

#[test]
fn half_planes_meet_the_sampling_floor() {
    // Random edges: angles by the golden ratio, offsets by the receivers of a view.
    for (pattern, floors) in SAMPLING_FLOOR {
        for (samples, floor) in COUNTS.into_iter().zip(floors) {
            let mut errors = Vec::new();
            for i in 0..48 {
                let angle = 360.0 * (f64::from(i) * 0.618_033_988_749_895).fract();
                let spec = format!("edge?angle={angle}&x={}&view=1.2", 0.3 * (f64::from(i) * 0.381_966).fract());
                let procedural = build(&spec).expect("builds");
                let rendering = render_view(&procedural, &rays(pattern, samples), 12);
                let truth = procedural.truth.as_ref().expect("an edge has a truth");
                errors.extend(penumbra_errors(&rendering, procedural.scene.origin_world, truth));
            }
            let found = rmse(&errors);
            // 1.2: what measuring an implementation against the floor allows; the sample of edges is another one.
            assert!(found <= 1.2 * floor, "{pattern:?} {samples}: {found} above the floor {floor}");
        }
    }
}

/// Settings of 256 samples for every technique that has samples: kernels have no closed form of their own but on parallel
/// occluders (`maps.rs`).
fn sampling_techniques() -> Vec<(&'static str, String, Box<dyn Technique>)> {
    let context = Context::default();
    let mut all = Vec::new();
    for entry in ALL.iter().filter(|entry| entry.parameters().iter().any(|parameter| parameter.name == "samples")) {
        let settings: &[&str] = match entry.name {
            "rays" => &["pattern=grid", "pattern=jittered", "pattern=halton", "pattern=sobol"],
            "uniform" => &["map_size=256 placement=grid", "map_size=256 placement=sobol"],
            other => panic!("{other} has samples: say here how they are spread"),
        };
        for setting in settings {
            let setting = format!("{setting} samples=256");
            let technique = (entry.build)(&context, &parse_settings(&setting).expect("settings")).expect("builds");
            all.push((entry.name, setting, technique));
        }
    }
    all
}

/// How far apart on the receiver two places may be that one texel of a map stands for, m: the view with the margin of the tiles
/// that bound its receivers, over the map's texels, along the diagonal; nothing for what has no map.
fn texel(technique: &dyn Technique, view: f64, pixels: u32) -> f64 {
    let Some(size) = technique.parameters()["map_size"].as_f64() else { return 0.0 };
    2f64.sqrt() * 2.0 * view * (1.0 + 32.0 / f64::from(pixels)) / size
}

#[test]
fn every_technique_meets_every_closed_form_with_every_shape() {
    for (name, setting, technique) in sampling_techniques() {
        for (scene, edges) in SCENES {
            for shape in SHAPES {
                let procedural = build_with(scene, shape);
                let truth = procedural.truth.as_ref().expect("has a truth");
                let rendering = render_view(&procedural, technique.as_ref(), 40);
                let what = format!("{name} {setting} {scene} {shape}");
                let texel = texel(technique.as_ref(), 2.0, 40);
                for (receiver, &v) in rendering.receivers.pixels.iter().flatten().zip(&rendering.lights[0].visibility) {
                    // Lit or dark, and so is all that its texels may stand for.
                    let around = [[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]];
                    let position_world = receiver.position + procedural.scene.origin_world;
                    let seen = around.map(|[x, z]| truth.visibility(position_world + texel * DVec3::new(x, 0.0, z)));
                    let [expected, ..] = seen;
                    if (expected == 0.0 || expected == 1.0) && seen.iter().all(|&seen| seen == expected) {
                        assert_eq!(f64::from(v), expected, "{what} at {position_world}");
                    }
                }
                if shape == "point" {
                    continue;
                }
                let errors = penumbra_errors(&rendering, procedural.scene.origin_world, truth);
                assert!(errors.len() > 50, "{what}: only {} receivers in penumbra", errors.len());
                // The worst edge is parallel to the cells: then the error is uniform within half a row of 16, whose RMS
                // is 1/(16 √12). k edges at once: at most k times that (Minkowski). The map of the square onto the disk
                // bends an edge, which crosses up to π/2 as many cells. A texel moves an edge by up to its size: by so much of the
                // narrowest penumbra, that of a tube (1/8 of 2·2/3 m).
                let curved = if ["disk", "sphere", "sun"].contains(&shape) { PI / 2.0 } else { 1.0 };
                let narrowest = if shape == "tube" { 1.0 / 8.0 } else { 1.0 } * 2.0 * 2.0 / 3.0;
                let bound = edges * (curved / (16.0 * 12f64.sqrt()) + texel / narrowest / 12f64.sqrt());
                let found = rmse(&errors);
                assert!(found <= bound, "{what}: {found} above {bound}");
            }
        }
    }
}

/// What `uniform` can do at best with N = 16, 81, 256 points, measured apart from any renderer; corners with equal weights are
/// the papers' grid.
const MAP_FLOOR: [(&str, [f64; 3]); 6] = [
    ("placement=grid", [0.030, 0.0095, 0.0036]),
    ("placement=jittered", [0.044, 0.013, 0.0056]),
    ("placement=halton", [0.049, 0.0135, 0.0060]),
    ("placement=sobol", [0.044, 0.013, 0.0056]),
    ("placement=corners weights=equal", [0.074, 0.027, 0.014]),
    // Schwärzler 2009's grid with the area that belongs to each corner: .0115 at 81, .0044 at 256; at 16, of 9 cells, what a
    // grid of 9 cells does (.055).
    ("placement=corners weights=trapezoid", [0.055, 0.0115, 0.0044]),
];

#[test]
fn uniform_sampling_of_half_planes_meets_the_sampling_floor() {
    let context = Context::default();
    let entry = Entry::find("uniform").expect("registered");
    for (placement, floors) in MAP_FLOOR {
        for (samples, floor) in COUNTS.into_iter().zip(floors) {
            let mut errors = Vec::new();
            let mut texels = 0.0f64;
            for i in 0..12 {
                // The points are the same at every receiver: random ones are taken anew for every edge.
                let setting = format!("{placement} samples={samples} seed={i} map_size=512");
                let technique = (entry.build)(&context, &parse_settings(&setting).expect("settings")).expect("builds");
                let angle = 360.0 * (f64::from(i) * 0.618_033_988_749_895).fract();
                let spec = format!("edge?angle={angle}&x={}&view=1.2", 0.3 * (f64::from(i) * 0.381_966).fract());
                let procedural = build(&spec).expect("builds");
                let rendering = render_view(&procedural, technique.as_ref(), 16);
                let truth = procedural.truth.as_ref().expect("an edge has a truth");
                errors.extend(penumbra_errors(&rendering, procedural.scene.origin_world, truth));
                texels = texel(technique.as_ref(), 1.2, 16);
            }
            let found = rmse(&errors);
            // 1.2: what measuring an implementation against the floor allows. A texel moves an edge by an error uniform within its
            // size, of a penumbra 4/3 m wide.
            let bound = 1.2 * floor + texels / (4.0 / 3.0) / 12f64.sqrt();
            assert!(found <= bound, "{placement} {samples}: {found} above {bound}");
        }
    }
}

#[test]
fn rays_count_exactly_the_samples_that_the_closed_form_leaves() {
    for (pattern, _) in SAMPLING_FLOOR {
        let rays = rays(pattern, 64);
        for (scene, _) in SCENES {
            for shape in SHAPES {
                let procedural = build_with(scene, shape);
                let truth = procedural.truth.as_ref().expect("has a truth");
                let rendering = render_view(&procedural, &rays, 24);
                for (i, receiver) in rendering.receivers.pixels.iter().enumerate() {
                    let receiver = receiver.as_ref().expect("the receiver fills the view");
                    let emitter = procedural.scene.lights[0].emitter(receiver.position).expect("the light faces down");
                    let samples = if shape == "point" { 1 } else { rays.samples };
                    let sampler = Sampler::new(pattern, samples, i as u32, rays.seed);
                    let is_seen = |index: &u32| {
                        let direction = emitter.at(sampler.on_emitter(*index, &emitter));
                        !truth.blocks(direction, receiver.position + procedural.scene.origin_world)
                    };
                    let expected = (0..samples).filter(is_seen).count();
                    let found = f64::from(rendering.lights[0].visibility[i]) * f64::from(samples);
                    assert_eq!(found, expected as f64, "{scene} {shape} {pattern:?}, receiver {i}");
                }
            }
        }
    }
}

/// Scenes with a truth, and how many of their edges can cross the light at once. No edge passes exactly through a sample, where
/// a closed triangle and an open half-plane differ.
const SCENES: [(&str, f64); 5] = [
    ("square", 4.0),
    ("edge?angle=20&x=0.013", 1.0),
    ("disks?x=0.013&z=0.007", 1.0),
    ("strip?width=0.2&angle=30", 2.0),
    ("two-edges?x=0.013", 2.0),
];
const SHAPES: [&str; 6] = ["rect", "disk", "sphere", "tube", "sun", "point"];

fn build_with(scene: &str, shape: &str) -> Procedural {
    let separator = if scene.contains('?') { '&' } else { '?' };
    build(&format!("{scene}{separator}shape={shape}")).expect("builds")
}

#[test]
fn irradiance_meets_the_form_factors() {
    // C8 without an occluder is exact: every sample is seen, and E₀ is a closed form.
    let open = build("corner").expect("builds");
    let rendering = render_view(&open, &rays(Pattern::Sobol, 16), 24);
    each_form_factor(&open, &rendering, |expected, _, found| {
        assert!((found - expected).abs() <= 1e-6 * expected, "{found} for {expected}");
    });
    // C9 with one: the seen share of the weights, at most four edges' worth of the floor; the weights vary by less than
    // (1 + (2.5/5)²)² = 1.6 over the light.
    let occluded = build("corner?occluder=0.2").expect("builds");
    let rendering = render_view(&occluded, &rays(Pattern::Grid, 1024), 24);
    let mut errors = Vec::new();
    each_form_factor(&occluded, &rendering, |expected, whole, found| errors.push((found - expected) / whole));
    let found = rmse(&errors);
    assert!(found <= 1.2 * 1.6 * 4.0 * 0.0014, "{found}");
}

fn each_form_factor(procedural: &Procedural, rendering: &Rendering, mut check: impl FnMut(f64, f64, f64)) {
    let truth = procedural.truth.as_ref().expect("has a truth");
    let radiance = match procedural.scene.lights[0].emission {
        penumbra::scene::Emission::Radiance(radiance) => radiance.x,
        other => panic!("a rect has radiance, found {other:?}"),
    };
    for (receiver, irradiance) in rendering.receivers.pixels.iter().flatten().zip(&rendering.lights[0].irradiance) {
        let position_world = receiver.position + procedural.scene.origin_world;
        let [whole, visible] = truth.form_factors(position_world).expect("a rect light has them");
        check(PI * radiance * visible, PI * radiance * whole, f64::from(irradiance[0]));
    }
}

#[test]
fn the_mass_of_a_shadow_does_not_depend_on_the_light() {
    // C6: the integral of 1 − V over the receiver, for any size and shape of light parallel to the occluder.
    for shape in ["rect", "disk"] {
        for light in [0.01, 0.5, 1.5] {
            let view = 4.0;
            let procedural = build(&format!("square?light={light}&shape={shape}&view={view}")).expect("builds");
            let size = 320;
            let rendering = render_view(&procedural, &rays(Pattern::Sobol, 64), size);
            let pixel = 2.0 * view / f64::from(size);
            let shadows = rendering.lights[0].visibility.iter().map(|&v| 1.0 - f64::from(v));
            let mass = shadows.sum::<f64>() * pixel.powi(2);
            let expected = shadow_mass(1.0, 2.0, 5.0);
            // Sides of 5/3 m along the rows of pixels: a hard edge is placed to half a pixel, a penumbra of C3's width to
            // half a pixel times what one pixel is of it.
            let width = 2.0 * light * 2.0 / 3.0;
            let bound = 4.0 * (5.0 / 3.0) * 0.5 * pixel * (pixel / width).min(1.0) + 1e-3;
            assert!((mass - expected).abs() < bound, "{shape} of {light}: {mass} for {expected} ± {bound}");
        }
    }
}
