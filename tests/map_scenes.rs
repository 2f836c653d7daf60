//! Shadow maps on real scenes: the error of `uniform` is that of rays to as many samples, and what the maps' texels add.

mod common;
#[expect(dead_code, reason = "its camera alone is needed")]
#[path = "common/judged.rs"]
mod judged;

use common::*;
use judged::kitchen_camera;
use penumbra::progress::Progress;
use penumbra::reference::exact::Exact;
use penumbra::render::{Rendering, Request, render};
use penumbra::scene::additions::{LightSpec, add_floor, add_light};
use penumbra::scene::{Camera, LoadOptions, Scene, gltf};
use penumbra::techniques::{Context, Entry, Technique, parse_settings};

const SIZE: [u32; 2] = [120, 90];
const SAMPLES: u32 = 36;

// What texels add to the squared error of V in the penumbra is stated with each scene, times the texels a side of a map. Texels
// are wrong along contacts, horizons and folds, in a band as wide as they are, by as much as V can be: its area, and with it the
// squared error, falls as the side of a texel; how long such lines are beside the penumbra is the scene's.

fn technique(name: &str, settings: &str) -> Box<dyn Technique> {
    let entry = Entry::find(name).expect("registered");
    (entry.build)(&Context::default(), &parse_settings(settings).expect("settings")).expect("builds")
}

/// RMSE over the penumbra of the first light.
fn rmse(test: &Rendering, truth: &Rendering) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for (i, (a, b)) in test.receivers.pixels.iter().zip(&truth.receivers.pixels).enumerate() {
        let (Some(a), Some(b)) = (a, b) else { continue };
        let expected = f64::from(truth.lights[0].visibility[i]);
        // The same surface: pixels on silhouettes may see another.
        if a.position == b.position && 0.0 < expected && expected < 1.0 {
            sum += (f64::from(test.lights[0].visibility[i]) - expected).powi(2);
            count += 1;
        }
    }
    assert!(count > 200, "{count} receivers in penumbra");
    (sum / f64::from(count)).sqrt()
}

/// Holds `uniform` against rays at as many samples, on maps that grow.
fn maps_add_what_their_texels_are_worth(name: &str, scene: &Scene, camera: &Camera, texel_error: f64) {
    let request = Request { size: SIZE, irradiance: false, shaded: None, antialiasing: 1, verify: None };
    let image =
        |technique: &dyn Technique| render(scene, camera, technique, &request, &Progress::default()).expect("renders");
    let truth = image(&Exact);
    let rays = rmse(&image(&*technique("rays", &format!("pattern=grid samples={SAMPLES}"))), &truth);
    let mut last = f64::INFINITY;
    for map_size in [256, 1024, 4096] {
        let found = rmse(&image(&*technique("uniform", &format!("samples={SAMPLES} map_size={map_size}"))), &truth);
        let bound = (1.2 * rays).hypot((texel_error / f64::from(map_size)).sqrt());
        assert!(found <= bound, "{name} {map_size}: {found} above {bound}; rays {rays}");
        assert!(found <= 1.05 * last, "{name} {map_size}: {found} after {last} with smaller maps");
        last = found;
    }
}

/// A scene of the shared folder on a floor, below the automatic light.
fn on_a_floor(file: &str, texel_error: f64) {
    let Some(scenes) = shared_scenes() else { return };
    let mut scene = gltf::load(&scenes.join(file), LoadOptions::default()).expect("loads");
    let camera = Camera::framing(&scene.bounds(), f64::from(SIZE[0]) / f64::from(SIZE[1]));
    add_light(&mut scene, &LightSpec::Auto, Some(&camera)).expect("fits");
    add_floor(&mut scene, None).expect("fits");
    maps_add_what_their_texels_are_worth(file, &scene, &camera, texel_error);
}

#[test]
fn maps_add_to_the_jeep_what_their_texels_are_worth() {
    on_a_floor("jeep1/jeep1.glb", 0.25);
}

#[test]
fn maps_add_to_the_bunny_what_their_texels_are_worth() {
    on_a_floor("stanford-bunny/stanford-bunny.glb", 0.7);
}

#[test]
fn maps_add_to_the_buddha_what_their_texels_are_worth() {
    on_a_floor("happy-buddha/happy-buddha.glb", 0.7);
}

#[test]
#[ignore = "a million triangles in over a hundred maps: scripts/test --full"]
fn maps_add_to_the_kitchen_what_their_texels_are_worth() {
    let Some(scenes) = shared_scenes() else { return };
    let mut scene =
        gltf::load(&scenes.join("country-kitchen/country-kitchen.glb"), LoadOptions::default()).expect("loads");
    let camera = kitchen_camera(&scene, f64::from(SIZE[0]) / f64::from(SIZE[1]));
    add_light(&mut scene, &LightSpec::Auto, Some(&camera)).expect("fits");
    maps_add_what_their_texels_are_worth("kitchen", &scene, &camera, 4.6);
}
