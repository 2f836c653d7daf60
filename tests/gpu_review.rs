//! Shadow maps at the ends of their ranges: lights far away, more maps than one binding describes.

use penumbra::progress::Progress;
use penumbra::render::{Rendering, Request, render};
use penumbra::scene::procedural::{Procedural, build};
use penumbra::techniques::{Context, Entry, parse_settings};

fn render_with(procedural: &Procedural, technique: &str, settings: &str, size: u32) -> Rendering {
    let settings = parse_settings(settings).expect("settings");
    let technique =
        (Entry::find(technique).expect("registered").build)(&Context::default(), &settings).expect("builds");
    let request = Request { size: [size, size], irradiance: false, shaded: None, antialiasing: 1, verify: None };
    let scene = &procedural.scene;
    render(scene, &scene.cameras[0], technique.as_ref(), &request, &Progress::default()).expect("renders")
}

/// V − truth of every receiver.
fn errors(procedural: &Procedural, rendering: &Rendering) -> Vec<f64> {
    let truth = procedural.truth.as_ref().expect("has a truth");
    let pixels = rendering.receivers.pixels.iter().flatten().zip(&rendering.lights[0].visibility);
    let origin = procedural.scene.origin_world;
    pixels.map(|(receiver, &v)| f64::from(v) - truth.visibility(receiver.position + origin)).collect()
}

#[test]
fn a_light_may_be_any_distance_away() {
    let size = 48;
    // A light of 0.2 rad, 10 to 10^9 times as far as the occluder is from the receiver.
    for (height, unit) in [(2e1, 1.0), (2e3, 1.0), (1e6, 1.0), (1e6, 1e-3)] {
        let [light, lift, occluder, x, z, view] =
            [0.1 * height, 2.0 * unit, 0.5 * unit, 0.1 * unit, -0.2 * unit, 2.0 * unit];
        let spec =
            format!("square?height={height}&light={light}&lift={lift}&occluder={occluder}&x={x}&z={z}&view={view}");
        let procedural = build(&spec).expect("builds");
        // A texel across, on the receiver: the view with the margins of the tiles that bound it and of half a kernel, over the
        // texels, along the diagonal. It moves an edge by up to its size, of a penumbra of C3's width; a corner has two edges.
        let width = 2.0 * light * lift / (height - lift);
        let texel = 2f64.sqrt() * 2.0 * (view * (1.0 + 32.0 / f64::from(size)) + width) / 1024.0;
        let by_texels = 2.0 * texel / width;
        // A grid of 16 x 16 points moves an edge by up to half a row.
        for (technique, settings, bound) in [
            ("pcss", "dense=true map_size=1024", by_texels),
            ("uniform", "samples=256 map_size=1024", by_texels + 1.0 / 16.0),
        ] {
            let rendering = render_with(&procedural, technique, settings, size);
            let most = errors(&procedural, &rendering).into_iter().fold(0.0, |most: f64, error| most.max(error.abs()));
            assert!(most <= bound, "{technique} at {spec}: off by {most}, more than {bound}");
        }
    }
}

#[test]
fn maps_may_be_more_than_one_binding_describes() {
    // 2048 maps of 16 texels: a few megabytes, but more uniforms than the 64 KiB that most adapters bind.
    let procedural = build("square").expect("builds");
    let rendering = render_with(&procedural, "uniform", "samples=2048 map_size=16", 8);
    let light = &rendering.lights[0];
    assert_eq!([light.samples, light.shadow_maps], [2048, 2048]);
    // However many batches they take, each kind of pass is told once.
    let names: Vec<&str> = light.passes.iter().map(|pass| pass.name).collect();
    assert!(names.is_empty() || names == ["shadow maps", "visibility"], "{names:?}");
}
