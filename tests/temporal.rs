//! Facts about `temporal`: what its samples are, how its error falls, and what becomes of it when something moves.

mod common;
#[expect(dead_code, reason = "its receivers and settings by name alone are needed")]
#[path = "common/drawn.rs"]
mod drawn;

use std::path::Path;

use common::*;
use drawn::*;
use glam::DVec3;
use penumbra::gpu::Gpu;
use penumbra::gpu::pass::Frame;
use penumbra::gpu::shader::{Pipeline, Source};
use penumbra::progress::Progress;
use penumbra::reference::exact::Exact;
use penumbra::render::{Rendering, Request, Sequence, render, render_receivers};
use penumbra::scene::camera::look_at;
use penumbra::scene::procedural::{build, load_animated};
use penumbra::scene::{AreaLight, Camera, LoadOptions, Projection, Scene, Shape};
use penumbra::techniques::{Context, Entry, LightImage, Technique, parse_settings};

const SIZE: [u32; 2] = [48, 36];

fn request(size: [u32; 2]) -> Request {
    Request { size, irradiance: false, shaded: None, antialiasing: 1, verify: None }
}

fn temporal(settings: &str) -> Box<dyn Technique> {
    technique("temporal", settings)
}

/// A preset of `temporal`, with settings of a test.
fn preset(name: &str, settings: &str) -> Box<dyn Technique> {
    let entry = Entry::find("temporal").expect("registered");
    let mut parameters = entry.preset(name).expect("there is");
    parameters.extend(parse_settings(settings).expect("settings"));
    (entry.build)(&CONTEXT, &parameters).expect("builds")
}

fn still(scene: &Scene, camera: &Camera, technique: &dyn Technique) -> Rendering {
    render(scene, camera, technique, &request(SIZE), &Progress::default()).expect("renders")
}

fn visibility_of(rendering: Rendering) -> Vec<f32> {
    rendering.lights.into_iter().next().expect("a light").visibility
}

fn truth(scene: &Scene, camera: &Camera) -> Vec<f32> {
    visibility_of(still(scene, camera, &Exact))
}

/// RMS of V − truth where a mask holds.
fn rms_where(found: &[f32], truth: &[f32], mask: impl Fn(usize) -> bool) -> f64 {
    let squares: Vec<f64> =
        (0..truth.len()).filter(|&i| mask(i)).map(|i| (f64::from(found[i]) - f64::from(truth[i])).powi(2)).collect();
    assert!(squares.len() > 15, "{} pixels", squares.len());
    (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
}

/// RMS of V − truth in the penumbra.
fn rmse(found: &[f32], truth: &[f32]) -> f64 {
    rms_where(found, truth, |i| 0.0 < truth[i] && truth[i] < 1.0)
}

/// The next frame of a sequence.
fn next(sequence: &mut Sequence, scene: &Scene, camera: &Camera) -> Vec<LightImage> {
    sequence.frame(scene, camera, &request(SIZE), &Progress::default()).expect("renders").lights
}

fn next_visibility(sequence: &mut Sequence, scene: &Scene, camera: &Camera) -> Vec<f32> {
    next(sequence, scene, camera).swap_remove(0).visibility
}

/// A camera that turns where it is, so that nothing comes into view from behind something.
fn turned(scene: &Scene, by: f64) -> Camera {
    let camera = camera_at(scene, [0.0; 3]);
    let eye = camera.scene_from_camera.translation;
    let target = DVec3::ZERO - scene.origin_world + DVec3::new(by, 0.0, 0.0);
    Camera { scene_from_camera: look_at(eye, target, DVec3::Y), ..camera }
}

/// A camera above the floor and before it that looks at a place, which lies in world space.
fn camera_at(scene: &Scene, target_world: [f64; 3]) -> Camera {
    let target = DVec3::from(target_world) - scene.origin_world;
    Camera {
        name: "test".into(),
        scene_from_camera: look_at(target + DVec3::new(0.0, 5.0, 3.5), target, DVec3::Y),
        projection: Projection::Perspective { fov_y: 0.7 },
        near: 0.0,
        far: f64::INFINITY,
    }
}

/// A floor (instance 0) with squares of half side ½ over it at x, height and z, below a square light of half side ½ at height 5.
fn squares(places: &[[f64; 3]]) -> Scene {
    let mut meshes = vec![mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]))];
    meshes.extend(places.iter().map(|_| mesh(&quad([-0.5, 0.5], 0.0, [-0.5, 0.5]))));
    let mut scene = scene(meshes, vec![square_light(0.5, 5.0)]);
    for (instance, &place) in scene.instances[1..].iter_mut().zip(places) {
        instance.scene_from_mesh.translation += DVec3::from(place);
    }
    scene
}

/// Squares whose penumbrae, 1.5 m and 1 m wide, are a dozen pixels: what is fetched from between pixels keeps those, and blurs edges of
/// one or two.
fn wide() -> Scene {
    squares(&[[0.0, 3.0, 0.0], [1.3, 2.5, 0.5]])
}

fn moved(scene: &Scene, instance: usize, by: [f64; 3]) -> Scene {
    let mut moved = scene.clone();
    moved.instances[instance].scene_from_mesh.translation += DVec3::from(by);
    moved
}

// ------------------------------------------------------------------------------------------------------------------- samples

#[test]
fn without_start_and_filter_frames_are_the_points_of_uniform_sampling() {
    // Eq. 5 from the first frame on: sums of the same tests, divided once.
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 100);
    for frames in [1, 2, 7, 64] {
        let found = draw(&scene, &points, temporal(&format!("frames={frames} start_weight=0 threshold=1")).as_ref());
        let expected =
            draw(&scene, &points, technique("uniform", &format!("samples={frames} placement=sobol")).as_ref());
        for (light, (found, expected)) in scene.lights.iter().zip(found.iter().zip(expected)) {
            for (a, b) in found.visibility.iter().zip(expected.visibility) {
                assert!((a - b).abs() <= 1e-6, "{frames} {:?}: {a} for {b}", light.shape);
            }
            assert_eq!((found.samples, found.shadow_maps), (expected.samples, expected.shadow_maps));
        }
    }
}

#[test]
fn frames_that_follow_each_other_are_a_still_of_as_many() {
    let scene = squares(&[[0.0, 1.5, 0.0]]);
    let camera = camera_at(&scene, [0.0; 3]);
    for settings in
        ["", "start_weight=0 threshold=1", "points=halton kernel=disk error=binomial blockers=all history=fp16"]
    {
        let technique = temporal(settings);
        let mut sequence = Sequence::new(technique.as_ref());
        for frames in 1..=9 {
            let found = next_visibility(&mut sequence, &scene, &camera);
            let expected =
                visibility_of(still(&scene, &camera, temporal(&format!("frames={frames} {settings}")).as_ref()));
            assert_eq!(found, expected, "{settings} {frames}");
        }
    }
}

/// Runs statements of the technique's shader once for each of the inputs.
fn run_shader(body: &str, inputs: &[[f32; 2]], settings: &[(&str, f64)]) -> Vec<[f32; 4]> {
    let gpu = Gpu::open().expect("a GPU, or a software one");
    let text = format!(
        "#import \"techniques/temporal.wgsl\"
        @group(0) @binding(100) var<storage, read> inputs: array<vec2<f32>>;
        @group(0) @binding(101) var<storage, read_write> results: array<vec4<f32>>;
        @compute @workgroup_size(64)
        fn main(@builtin(global_invocation_id) id: vec3<u32>) {{
            if (id.x >= arrayLength(&inputs)) {{ return; }}
            {body}
        }}"
    );
    let names = [
        "dense",
        "near",
        "search_taps",
        "filter_taps",
        "pattern",
        "search_columns",
        "filter_columns",
        "bias_texels",
        "start_weight",
        "starts",
        "threshold",
        "screen_disk",
        "all_depths",
        "printed",
        "half_floats",
        "resets",
        "aging",
        "binomial",
    ];
    let unset = names.iter().filter(|name| settings.iter().all(|(set, _)| set != *name));
    let constants: Vec<(&str, f64)> = settings.iter().copied().chain(unset.map(|&name| (name, 0.0))).collect();
    let pipeline = Pipeline::compute(&gpu, &Source::new("test", &text), "main", &constants);
    let given = gpu.buffer("inputs", inputs, wgpu::BufferUsages::STORAGE).expect("fits");
    let results = gpu.empty_buffer("results", 16 * inputs.len() as u64, wgpu::BufferUsages::STORAGE).expect("fits");
    let mut frame = Frame::new(&gpu);
    frame.compute("test", &pipeline).bind("inputs", &given).bind("results", &results).dispatch([1, 1, 1]);
    frame.finish().expect("runs");
    gpu.read_buffer(&results).expect("reads")
}

/// What the shader's `standard_error` makes of tests: those in shadow and all.
fn standard_errors(binomial: bool, tests: &[[f32; 2]]) -> Vec<f32> {
    let body = "var past = NO_PAST;
        past.shadowed = inputs[id.x].x;
        past.count = inputs[id.x].y;
        results[id.x].x = standard_error(past);";
    let rows = run_shader(body, tests, &[("binomial", f64::from(u8::from(binomial)))]);
    rows.into_iter().map(|[found, ..]| found).collect()
}

#[test]
fn standard_errors_are_those_of_table_1_and_of_jeffreys() {
    // τ = 1, 0, 1, 1, 1, 0, 1: sums as they grow, and the table's last row, to its two digits.
    let table = [([1.0, 1.0], 0.0), ([1.0, 2.0], 0.5), ([2.0, 3.0], 0.33), ([3.0, 4.0], 0.25), ([4.0, 5.0], 0.2)];
    let table = [&table[..], &[([4.0, 6.0], 0.21), ([5.0, 7.0], 0.18)]].concat();
    let tests: Vec<[f32; 2]> = table.iter().map(|row| row.0).collect();
    for (found, (tests, expected)) in standard_errors(true, &tests).iter().zip(&table) {
        assert!((found - expected).abs() <= 0.0051, "{found} for {expected} of {tests:?}");
    }
    // Of one sample, and of two equal ones, the paper is certain. Jeffreys' posterior is not: √(1.5·0.5/3)/2 = ¼ and √(2.5·0.5/4)/3 =
    // 0.19.
    let certain = [[1.0, 1.0], [2.0, 2.0], [0.0, 2.0]];
    assert_eq!(standard_errors(true, &certain), [0.0; 3]);
    for (found, expected) in standard_errors(false, &certain).iter().zip([0.25, 0.186_339, 0.186_339]) {
        assert!((found - expected).abs() < 1e-5, "{found} for {expected}");
    }
}

// ------------------------------------------------------------------------------------------------------------------- counters

/// V in the middle of a half-plane's penumbra, in its umbra and in the light.
fn half_dark_lit(settings: &str) -> [f32; 3] {
    let scene = scene(vec![mesh(&quad([-90.0, 0.0], 2.0, [-90.0, 90.0]))], vec![square_light(0.5, 5.0)]);
    let points = [DVec3::ZERO, DVec3::new(-1.0, 0.0, 0.0), DVec3::new(1.0, 0.0, 0.0)];
    drawn(&scene, &points, temporal(settings).as_ref()).try_into().expect("three")
}

#[test]
fn halves_fail_after_2048_frames_as_predicted() {
    // In FP16 2048 + 1 is 2048, whichever way it is rounded: n sticks there; what is in shadow is counted on, up to 2048. With every
    // second test in shadow, ρ after f frames is f/2, to within a few tests of the sequence: V = 1 − f/2/2048.
    for (frames, expected) in [(1000, 0.5), (2048, 0.5), (3000, 1.0 - 1500.0 / 2048.0), (4096, 0.0)] {
        let common = format!("frames={frames} start_weight=0 threshold=1 map_size=16");
        let [half, dark, lit] = half_dark_lit(&format!("{common} history=fp16"));
        assert!((f64::from(half) - expected).abs() <= 0.01, "{frames}: {half} for {expected}");
        assert_eq!((dark, lit), (0.0, 1.0), "{frames}");
        let [half, dark, lit] = half_dark_lit(&common);
        assert!((f64::from(half) - 0.5).abs() <= 0.01, "{frames}: {half} in FP32");
        assert_eq!((dark, lit), (0.0, 1.0), "{frames}");
    }
}

#[test]
fn a_hundred_thousand_frames_do_not_drift() {
    // Every k-th test in shadow; none, all. Counts are halved at 65,536, exactly: those of whole numbers are halves.
    let periods = [0u32, 1, 2, 4];
    let mut state = [[0.0f32; 2]; 4];
    let mut counted = 0;
    // Software drivers end a loop after 65,535 rounds.
    for _ in 0..5 {
        let rows = run_shader(
            "var periods = array<u32, 4>(0u, 1u, 2u, 4u);
            let period = periods[id.x];
            var past = Past(inputs[id.x].x, inputs[id.x].y, 2.0, 1.0, 0.0, 0.0, 0.0, 0u);
            var is_sound = 1.0;
            for (var i = 0u; i < 20000u; i++) {
                let before = past.count;
                past = with_test(past, Test(true, period != 0u && i % max(period, 1u) == 0u, false, 2.0));
                let is_next = past.count == before + 1.0 || (before == MOST_SAMPLES && past.count == 0.5 * MOST_SAMPLES + 1.0);
                is_sound = select(0.0, is_sound, is_next && past.gap == 2.0);
            }
            results[id.x] = vec4(past.shadowed, past.count, is_sound, 0.0);",
            &state,
            &[],
        );
        counted += 20_000;
        for (i, &[shadowed, count, is_sound, _]) in rows.iter().enumerate() {
            state[i] = [shadowed, count];
            assert_eq!(is_sound, 1.0, "{counted}");
            let expected = if periods[i] == 0 { 0.0 } else { 1.0 / periods[i] as f32 };
            // Where a halving splits a period the count is a share of one test off.
            assert!(
                (shadowed - expected * count).abs() <= 1.0,
                "{counted}: {shadowed} of {count}, every {}",
                periods[i]
            );
            assert!(periods[i] > 1 || shadowed == expected * count, "{counted}: {shadowed} of {count}");
        }
    }
    // 65,536 tests bring the count to 65,536, from 32,768 on 98,304 do again, and the last 1,696 are counted.
    assert_eq!(state[0][1], 32_768.0 + 1_696.0);
}

// ---------------------------------------------------------------------------------------------------------------- convergence

const CLOSED: [&str; 2] = ["square?x=0.1", "square?shape=disk"];

#[test]
fn the_error_after_n_frames_is_that_of_as_many_rays_and_the_filter_lowers_it() {
    for spec in CLOSED {
        let scene = build(spec).expect("builds").scene;
        let camera = &scene.cameras[0];
        let truth = truth(&scene, camera);
        let of = |technique: &dyn Technique| rmse(&visibility_of(still(&scene, camera, technique)), &truth);
        for frames in [1, 2, 4, 8, 16, 32, 64] {
            // One set of points, the same at all receivers, is good or bad luck: the mean over twelve.
            let mean = |settings: &str| {
                let errors = (0..12)
                    .map(|seed| of(temporal(&format!("frames={frames} seed={seed} {settings}")).as_ref()).powi(2));
                (errors.sum::<f64>() / 12.0).sqrt()
            };
            let filtered = mean("");
            let unfiltered = mean("threshold=1 start_weight=0");
            let rays = of(&rays(penumbra::sampling::Pattern::Sobol, frames));
            assert!(unfiltered <= 1.2 * rays, "{spec} {frames}: {unfiltered}, of rays {rays}");
            assert!(filtered <= 1.2 * rays, "{spec} {frames}: filtered {filtered}, of rays {rays}");
            if frames <= 32 {
                assert!(filtered < unfiltered, "{spec} {frames}: {filtered} filtered, {unfiltered} not");
            }
        }
    }
}

#[test]
fn the_error_on_a_real_scene_is_that_of_as_many_rays() {
    let Some(scenes) = shared_scenes() else { return };
    let mut scene = penumbra::scene::gltf::load(
        &scenes.join(Path::new("stanford-bunny/stanford-bunny.glb")),
        LoadOptions::default(),
    )
    .expect("loads");
    let camera = Camera::framing(&scene.bounds(), 4.0 / 3.0);
    let light = penumbra::scene::additions::LightSpec::Auto;
    penumbra::scene::additions::add_light(&mut scene, &light, Some(&camera)).expect("fits");
    penumbra::scene::additions::add_floor(&mut scene, None).expect("fits");
    let truth = truth(&scene, &camera);
    let of = |technique: &dyn Technique| rmse(&visibility_of(still(&scene, &camera, technique)), &truth);
    for frames in [1, 4, 16, 64] {
        let found = of(temporal(&format!("frames={frames}")).as_ref());
        let rays = of(&rays(penumbra::sampling::Pattern::Sobol, frames));
        // What texels add to the squared error is that of `tests/map_scenes.rs` for this scene: 0.7 over the texels a side.
        let bound = (1.2 * rays).hypot((0.7f64 / 1024.0).sqrt());
        assert!(found <= bound, "{frames}: {found} above {bound}, rays {rays}");
    }
}

// --------------------------------------------------------------------------------------------------------------- moving camera

/// Frames of a view that moves over a still scene, in which shadows of two depths overlap: V of each frame, and the truth.
fn walk(technique: &dyn Technique, frames: usize, step: f64) -> Vec<(Vec<f32>, Vec<f32>)> {
    let scene = squares(&[[0.0, 2.4, 0.0], [0.4, 1.0, 0.3]]);
    let mut sequence = Sequence::new(technique);
    (0..frames)
        .map(|i| {
            let camera = camera_at(&scene, [step * (i as f64 - 0.5 * frames as f64), 0.0, 0.3 * step * i as f64]);
            (next_visibility(&mut sequence, &scene, &camera), truth(&scene, &camera))
        })
        .collect()
}

#[test]
fn a_walk_costs_no_more_than_what_comes_into_view() {
    // A pixel is 0.12 m; two thirds of one a frame. Where receivers have a past, the error after 32 frames is at most 1.2 times that of a
    // still of as many.
    let settings = "threshold=1 start_weight=0";
    let scene = wide();
    let technique = temporal(settings);
    let mut sequence = Sequence::new(technique.as_ref());
    let mut found = Vec::new();
    for i in 0..32 {
        found = next_visibility(&mut sequence, &scene, &turned(&scene, 0.08 * f64::from(i - 31)));
    }
    let camera = turned(&scene, 0.0);
    let truth = truth(&scene, &camera);
    let standing = visibility_of(still(&scene, &camera, temporal(&format!("frames=32 {settings}")).as_ref()));
    // What has been in view for all frames: the left of the image, and not what its upper and lower corners have hidden.
    let has_past = |i: usize| i % 48 < 24 && (6..30).contains(&(i / 48));
    let in_penumbra = |i: usize| 0.0 < truth[i] && truth[i] < 1.0 && has_past(i);
    let (walked, stood) = (rms_where(&found, &truth, in_penumbra), rms_where(&standing, &truth, in_penumbra));
    assert!(walked <= 1.2 * stood, "{walked} after a walk, {stood} of a still");
}

#[test]
fn a_walkthrough_is_nearer_the_truth_than_pcss_and_flickers_half_as_much_as_without_filter() {
    let frames = 12;
    let pcss = technique("pcss", "search_taps=16 filter_taps=16");
    let [found, unfiltered, pcss] =
        [temporal(""), temporal("threshold=1 start_weight=0"), pcss].map(|t| walk(t.as_ref(), frames, 0.08));
    for (i, ((found, truth), (pcss, _))) in found.iter().zip(&pcss).enumerate() {
        let (error, bound) = (rmse(found, truth), rmse(pcss, truth));
        assert!(error <= bound, "frame {i}: {error} above {bound} of PCSS");
    }
    let flicker = |walked: &[(Vec<f32>, Vec<f32>)]| {
        let squares: Vec<f64> = walked
            .windows(2)
            .flat_map(|pair| {
                let ((a, ta), (b, tb)) = (&pair[0], &pair[1]);
                (0..a.len())
                    .filter(|&i| 0.0 < tb[i] && tb[i] < 1.0)
                    .map(move |i| f64::from((b[i] - a[i]) - (tb[i] - ta[i])).powi(2))
            })
            .collect();
        (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
    };
    let (filtered, unfiltered) = (flicker(&found), flicker(&unfiltered));
    assert!(filtered <= 0.5 * unfiltered, "{filtered} with filter, {unfiltered} without");
}

#[test]
fn a_penumbra_a_few_pixels_wide_is_not_blurred_frame_by_frame() {
    // A light of 0.2 m: penumbrae of one to three pixels, fetched from between pixels in every frame.
    let animated = load_animated("procedural:moving?camera=1&light_size=0.2").expect("loads");
    let [found, as_old, pcss] =
        ["temporal", "temporal aging=false", "pcss search_taps=16 filter_taps=16"].map(|settings| {
            let (name, settings) = settings.split_once(' ').unwrap_or((settings, ""));
            let technique = technique(name, settings);
            let mut sequence = Sequence::new(technique.as_ref());
            let mut errors = Vec::new();
            for frame in 0..12 {
                let scene = animated.pose(0, f64::from(frame) / 24.0).expect("poses");
                let request = request([160, 120]);
                let lights =
                    sequence.frame(&scene, &scene.cameras[0], &request, &Progress::default()).expect("renders").lights;
                let truth = render(&scene, &scene.cameras[0], &Exact, &request, &Progress::default()).expect("renders");
                errors.push(rmse(&lights[0].visibility, &visibility_of(truth)));
            }
            (errors[6..].iter().map(|error| error * error).sum::<f64>() / 6.0).sqrt()
        });
    assert!(found <= 0.75 * as_old, "{found}, {as_old} without ages");
    // Some tests are kept beside PCSS.
    assert!(found <= 1.5 * pcss, "{found}, {pcss} of PCSS");
}

#[test]
fn what_comes_into_view_is_begun_by_pcss() {
    // As the paper has it a new pixel is the share of PCSS, of 16 taps; after k more frames a multiple of 1/(16 (k + 1)).
    let scene = squares(&[[0.0, 1.5, 0.0]]);
    let technique = preset("paper-unfiltered", "history=fp32 reprojection=exact overscan=0");
    let mut sequence = Sequence::new(technique.as_ref());
    let is_share = |v: f32, parts: f32| (v * parts - (v * parts).round()).abs() < 1e-3;
    for _ in 0..6 {
        next_visibility(&mut sequence, &scene, &camera_at(&scene, [-3.0, 0.0, 0.0]));
    }
    // Nothing of the left half is in the right one.
    let found = next_visibility(&mut sequence, &scene, &camera_at(&scene, [0.0, 0.0, 0.0]));
    let right = (0..found.len()).filter(|i| i % 48 > 40).collect::<Vec<_>>();
    assert!(right.iter().all(|&i| is_share(found[i], 16.0)), "{found:?}");
    let again = next_visibility(&mut sequence, &scene, &camera_at(&scene, [0.0, 0.0, 0.0]));
    assert!(again.iter().any(|&v| !is_share(v, 16.0)) && right.iter().all(|&i| is_share(again[i], 32.0)), "{again:?}");
}

#[test]
fn what_the_border_has_seen_has_a_past() {
    // After 16 frames the view moves by four pixels or so: its last three columns are new without a border, and of 17 samples with one.
    let scene = squares(&[[2.4, 2.5, 0.0], [2.6, 2.0, 1.3], [2.4, 2.5, -1.3]]);
    let after = |overscan: f64| {
        let technique = temporal(&format!("overscan={overscan} threshold=1 start_weight=0"));
        let mut sequence = Sequence::new(technique.as_ref());
        for _ in 0..32 {
            next_visibility(&mut sequence, &scene, &camera_at(&scene, [0.0; 3]));
        }
        let camera = camera_at(&scene, [0.4, 0.0, 0.0]);
        let (found, truth) = (next_visibility(&mut sequence, &scene, &camera), truth(&scene, &camera));
        rms_where(&found, &truth, |i| i % 48 >= 45 && 0.0 < truth[i] && truth[i] < 1.0)
    };
    let (without, with) = (after(0.0), after(0.5));
    // One sample's error is √(ψ(1 − ψ)), 0.41 on a ramp; that of 33 a tenth of it at most.
    assert!(without > 0.25 && with < 0.08, "{without} without, {with} with a border");
}

#[test]
fn a_border_leaves_the_receivers_as_they_are() {
    let scene = squares(&[[0.0, 1.5, 0.0]]);
    let camera = camera_at(&scene, [0.0; 3]);
    let of =
        |overscan: f64| still(&scene, &camera, temporal(&format!("frames=1 overscan={overscan}")).as_ref()).receivers;
    let (plain, within) = (of(0.0), of(0.3));
    assert_eq!((plain.size, &plain.pixels), (within.size, &within.pixels));
}

// ------------------------------------------------------------------------------------------------------------- moving casters

/// Where V is 1 by the truth and by that of the frames before it was not: what a technique leaves there of 1 − V, at most.
fn ghost(technique: &dyn Technique) -> f64 {
    let mut scene = squares(&[[-1.5, 1.0, 0.0], [1.2, 1.0, 1.0]]);
    let camera = camera_at(&scene, [0.0; 3]);
    let mut sequence = Sequence::new(technique);
    let mut was_dark = vec![false; (SIZE[0] * SIZE[1]) as usize];
    let mut worst = 0.0f64;
    for i in 0..14 {
        if i >= 8 {
            scene = moved(&scene, 1, [0.4, 0.0, 0.0]);
        }
        let (found, truth) = (next_visibility(&mut sequence, &scene, &camera), truth(&scene, &camera));
        for pixel in 0..truth.len() {
            // Away from the penumbra as it is now, by what texels and kernels of few taps may reach.
            let x = pixel % 48;
            let is_lit = (x > 0 && x < 47) && [pixel - 1, pixel, pixel + 1].iter().all(|&i| truth[i] == 1.0);
            if was_dark[pixel] && is_lit {
                worst = worst.max(1.0 - f64::from(found[pixel]));
            }
            was_dark[pixel] |= truth[pixel] < 0.5;
        }
    }
    worst
}

#[test]
fn a_moving_caster_leaves_no_ghost() {
    assert_eq!(ghost(temporal("").as_ref()), 0.0);
    assert_eq!(ghost(temporal("threshold=1 start_weight=0").as_ref()), 0.0);
}

#[test]
fn a_moving_caster_leaves_a_ghost_where_nothing_is_done_about_it() {
    // Eight frames in shadow and up to six in the light.
    let ignored = ghost(preset("paper", "moving=ignore").as_ref());
    assert!(ignored > 0.5, "{ignored}");
    // The paper's detection leaves what the last frames in the moving shadow have found: less, not nothing.
    let detected = ghost(preset("paper", "").as_ref());
    assert!(detected < ignored, "{detected} with detection, {ignored} without");
}

#[test]
fn what_stops_or_starts_is_begun_anew_where_its_shadow_falls() {
    let before = squares(&[[-1.0, 1.0, 0.0], [1.2, 1.0, 0.4]]);
    let camera = camera_at(&before, [0.0; 3]);
    let technique = temporal("threshold=1 start_weight=0");
    let mut sequence = Sequence::new(technique.as_ref());
    for _ in 0..16 {
        next_visibility(&mut sequence, &before, &camera);
    }
    let mut scene = before.clone();
    for _ in 0..4 {
        scene = moved(&scene, 1, [0.1, 0.0, 0.0]);
        next_visibility(&mut sequence, &scene, &camera);
    }
    let mut found = Vec::new();
    for _ in 0..16 {
        found = next_visibility(&mut sequence, &scene, &camera);
    }
    let truth = truth(&scene, &camera);
    // Samples 20 to 35 of the sequence on the left, the first 36 on the right, of which the first frames' are those of the start.
    let is_left = |i: usize| i % 48 < 24;
    let in_penumbra = |i: usize| 0.0 < truth[i] && truth[i] < 1.0;
    let left = rms_where(&found, &truth, |i| in_penumbra(i) && is_left(i));
    let anew = visibility_of(still(&scene, &camera, temporal("frames=16 threshold=1 start_weight=0").as_ref()));
    let expected = rms_where(&anew, &truth, |i| in_penumbra(i) && is_left(i));
    // Any 16 of a (0, 2)-sequence in a row are two nets of 8 or better: an error of at most 2^¾ that of a net of 16.
    assert!(left <= 2f64.powf(0.75) * 1.2 * expected, "{left} after the stop, {expected} anew");
    let right = rms_where(&found, &truth, |i| in_penumbra(i) && !is_left(i));
    assert!(right < left, "{right} where nothing moved, {left} where something did");
    // Lit is lit, dark is dark.
    let is_within =
        |i: usize, v: f32| truth[i] == v && (1..47).contains(&(i % 48)) && truth[i - 1] == v && truth[i + 1] == v;
    for v in [0.0, 1.0] {
        assert!((0..truth.len()).filter(|&i| is_within(i, v)).all(|i| found[i] == v), "{v}");
    }
}

#[test]
fn shadows_of_what_moves_and_of_what_stands_are_one() {
    // A moving square over a still floor beside a still square: the moving one by PCSS from the light's centre, as good as PCSS is.
    let mut scene = squares(&[[-1.5, 1.0, 0.0], [1.4, 1.5, 0.0]]);
    let camera = camera_at(&scene, [0.0; 3]);
    let technique = temporal("");
    let mut sequence = Sequence::new(technique.as_ref());
    let pcss = |scene: &Scene| {
        visibility_of(still(scene, &camera, drawn::technique("pcss", "search_taps=16 filter_taps=16").as_ref()))
    };
    for i in 0..24 {
        if i > 12 {
            scene = moved(&scene, 1, [0.04, 0.0, 0.0]);
        }
        let found = next_visibility(&mut sequence, &scene, &camera);
        if i > 16 {
            let truth = truth(&scene, &camera);
            let (error, bound) = (rmse(&found, &truth), rmse(&pcss(&scene), &truth));
            assert!(error <= bound, "frame {i}: {error} above {bound} of PCSS");
        }
    }
}

// ------------------------------------------------------------------------------------- moving receivers, moving lights, others

#[test]
fn a_moving_receiver_takes_its_shadow_along_no_further_than_its_past_allows() {
    // A platform slides under a still square. Aged, its error stays that of a few samples; if every sample counted alike the shadow
    // would lag behind.
    let error = |settings: &str| {
        let mut scene = squares(&[[0.0, 1.5, 0.0]]);
        let camera = camera_at(&scene, [0.0, 0.0, 0.0]);
        let technique = temporal(&format!("threshold=1 {settings}"));
        let mut sequence = Sequence::new(technique.as_ref());
        let mut last = (Vec::new(), Vec::new());
        for i in 0..24 {
            if i > 0 {
                scene = moved(&scene, 0, [0.05, 0.0, 0.0]);
            }
            last = (next_visibility(&mut sequence, &scene, &camera), truth(&scene, &camera));
        }
        rmse(&last.0, &last.1)
    };
    let (aged, not) = (error(""), error("aging=false"));
    // The penumbra is 3/7 m wide: δ = 0.117, of which n = (0.75/δ²)^(2/7) = 3.1: ½ n^-¾ = 0.21 and n δ/2 = 0.18, together 0.28.
    assert!(aged < 0.28, "{aged}");
    // 24 frames of 0.05 m: up to 1.2 m behind.
    assert!(not > 1.3 * aged, "{not} without ages, {aged} with them");
}

#[test]
fn a_moving_light_leaves_a_bounded_error_that_goes_when_it_stops() {
    let still_scene = squares(&[[0.0, 1.5, 0.0]]);
    let camera = camera_at(&still_scene, [0.0; 3]);
    let run = |settings: &str| {
        let mut scene = still_scene.clone();
        let technique = temporal(&format!("threshold=1 {settings}"));
        let mut sequence = Sequence::new(technique.as_ref());
        let mut errors = Vec::new();
        for i in 0..64 {
            if (8..24).contains(&i) {
                scene.lights[0].scene_from_light.translation.x += 0.05;
            }
            let found = next_visibility(&mut sequence, &scene, &camera);
            errors.push(rmse(&found, &truth(&scene, &camera)));
        }
        errors
    };
    let aged = run("");
    // δ = 0.05 of a light 1 m wide: n = (0.75/δ²)^(2/7) = 5.1: ½ n^-¾ = 0.15 and n δ/2 = 0.13, together 0.19.
    let worst = aged[8..24].iter().copied().fold(0.0, f64::max);
    assert!(worst < 0.19, "{worst} while it moves: {aged:?}");
    // 40 frames later the five old samples, off by at most a few steps, weigh an eighth.
    let settled = rmse(
        &visibility_of(still(&still_scene, &camera, temporal("frames=40 threshold=1").as_ref())),
        &truth(&still_scene, &camera),
    );
    let last = aged.last().expect("frames");
    assert!(*last < settled + 0.19 * 5.1 / 45.0, "{last} at rest, {settled} of a still");
    let not = run("aging=false");
    assert!(not[23] > 1.5 * aged[23], "{} without ages, {} with them", not[23], aged[23]);
}

#[test]
fn each_of_several_lights_has_its_own_history() {
    let mut lights = lights_of_every_shape();
    for (i, light) in lights.iter_mut().enumerate() {
        light.name = format!("light {i}");
    }
    let with = |lights: Vec<AreaLight>| {
        let mut scene = squares(&[[0.0, 1.5, 0.0]]);
        scene.lights.clear();
        scene.add_lights(
            lights
                .into_iter()
                .map(|mut light| {
                    light.scene_from_light.translation -= scene.origin_world;
                    light
                })
                .collect::<Vec<_>>(),
        );
        scene
    };
    let technique = temporal("map_size=128");
    let run = |lights: &[AreaLight]| {
        let scene = with(lights.to_vec());
        let mut sequence = Sequence::new(technique.as_ref());
        let mut last = Vec::new();
        for i in 0..4 {
            last = next(&mut sequence, &scene, &camera_at(&scene, [0.05 * f64::from(i), 0.0, 0.0]));
        }
        last
    };
    let together = run(&lights);
    for (i, light) in lights.iter().enumerate() {
        let alone = run(std::slice::from_ref(light));
        assert_eq!(alone[0].visibility, together[i].visibility, "{:?}", light.shape);
        assert!(
            alone[0].visibility.contains(&1.0) && alone[0].visibility.iter().any(|&v| v < 0.5),
            "{:?}",
            light.shape
        );
    }
    // One that comes, goes and comes back begins anew; the other goes on as if nothing were.
    let (both, one) = (with(lights[..2].to_vec()), with(lights[..1].to_vec()));
    let camera = camera_at(&both, [0.0; 3]);
    let mut sequence = Sequence::new(technique.as_ref());
    let mut alone = Sequence::new(technique.as_ref());
    for (i, scene) in [&both, &one, &both, &both].into_iter().enumerate() {
        let found = next(&mut sequence, scene, &camera);
        assert_eq!(found[0].visibility, next(&mut alone, &one, &camera)[0].visibility, "frame {i}");
    }
}

#[test]
fn another_scene_or_size_begins_anew() {
    let (one, two) = (squares(&[[0.0, 1.5, 0.0]]), squares(&[[0.0, 1.5, 0.0], [1.0, 1.0, 0.0]]));
    let camera = camera_at(&one, [0.0; 3]);
    let technique = temporal("");
    let mut sequence = Sequence::new(technique.as_ref());
    for _ in 0..4 {
        next(&mut sequence, &one, &camera);
    }
    let first = |scene: &Scene| visibility_of(still(scene, &camera, temporal("frames=1").as_ref()));
    assert_eq!(next_visibility(&mut sequence, &two, &camera), first(&two));
    let small = request([24, 18]);
    let found = sequence.frame(&two, &camera, &small, &Progress::default()).expect("renders");
    let fresh = render(&two, &camera, temporal("frames=1").as_ref(), &small, &Progress::default()).expect("renders");
    assert_eq!(visibility_of(found), visibility_of(fresh));
}

#[test]
fn the_same_frames_are_drawn_twice_and_on_any_number_of_threads() {
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        pool.install(|| {
            let mut scene = squares(&[[0.0, 1.5, 0.0], [1.0, 1.0, 0.0]]);
            let technique = temporal("");
            let mut sequence = Sequence::new(technique.as_ref());
            (0..5)
                .map(|i| {
                    scene = moved(&scene, 1, [if i > 2 { 0.1 } else { 0.0 }, 0.0, 0.0]);
                    next_visibility(&mut sequence, &scene, &camera_at(&scene, [0.07 * f64::from(i), 0.0, 0.0]))
                })
                .collect::<Vec<_>>()
        })
    };
    let one = run(1);
    assert_eq!(one, run(1));
    assert_eq!(one, run(3));
}

#[test]
fn an_orthographic_camera_is_fetched_from_as_well() {
    let scene = wide();
    let at = |x: f64| Camera {
        projection: Projection::Orthographic { half_height: 2.0 },
        ..camera_at(&scene, [x, 0.0, 0.0])
    };
    let technique = temporal("threshold=1 start_weight=0");
    let mut sequence = Sequence::new(technique.as_ref());
    let mut found = Vec::new();
    for i in 0..32 {
        found = next_visibility(&mut sequence, &scene, &at(0.01 * f64::from(i)));
    }
    let truth = truth(&scene, &at(0.31));
    let standing = still(&scene, &at(0.31), temporal("frames=32 threshold=1 start_weight=0").as_ref());
    // What has come into view is at the right; beside the outline of another instance all is new as long as the view moves.
    let instance = |x: usize, y: usize| standing.receivers.pixels[48 * y + x].map(|receiver| receiver.instance);
    let is_inside = |x: usize, y: usize| {
        (1..43).contains(&x)
            && (1..35).contains(&y)
            && (0..9).all(|i| instance(x + i % 3 - 1, y + i / 3 - 1) == instance(x, y))
    };
    let has_past = |i: usize| 0.0 < truth[i] && truth[i] < 1.0 && is_inside(i % 48, i / 48);
    let standing = &standing.lights[0].visibility;
    let (walked, stood) = (rms_where(&found, &truth, has_past), rms_where(standing, &truth, has_past));
    assert!(walked <= 1.2 * stood, "{walked} after a walk, {stood} of a still");
}

// ----------------------------------------------------------------------------------------------------------------- parameters

#[test]
fn every_parameter_works_at_both_ends() {
    let scene = squares(&[[0.0, 1.5, 0.0], [0.8, 0.8, 0.0]]);
    let entry = Entry::find("temporal").expect("registered");
    let small = "frames=2 map_size=32 start_taps=4";
    let with = |key: &str, value: &str| {
        let mut parameters = parse_settings(small).expect("settings");
        parameters.extend(parse_settings(&format!("{key}={value}")).expect("settings"));
        let technique = (entry.build)(&CONTEXT, &parameters).expect("builds");
        let mut sequence = Sequence::new(technique.as_ref());
        for i in 0..3 {
            let scene = moved(&scene, 1, [0.1 * f64::from(i), 0.0, 0.0]);
            let images = next(&mut sequence, &scene, &camera_at(&scene, [0.03 * f64::from(i), 0.0, 0.0]));
            let v = &images[0].visibility;
            assert!(v.iter().all(|v| (0.0..=1.0).contains(v)), "{key}={value}");
            assert!(v.contains(&1.0) && v.iter().any(|&v| v < 0.5), "{key}={value}: {v:?}");
        }
        render_receivers(
            &scene,
            receivers(&scene, &line(-1.0, 1.0, 20), DVec3::Y),
            technique.as_ref(),
            true,
            &Progress::default(),
        )
        .expect("renders");
    };
    for parameter in entry.parameters() {
        for (choice, _) in &parameter.choices {
            with(&parameter.name, choice);
        }
        if parameter.default.is_boolean() {
            with(&parameter.name, "true");
            with(&parameter.name, "false");
        }
        for end in [parameter.minimum, parameter.maximum].into_iter().flatten() {
            // Ends that are costs, not cases: a million maps; maps of a gigabyte; 4096 taps at each receiver.
            let end = match parameter.name.as_str() {
                "frames" if end > 1.0 => 300.0,
                "map_size" if end > 1.0 => 4096.0,
                _ => end,
            };
            if parameter.name == "map_size" && end == 1.0 {
                // One texel shows nothing: what it answers is checked in `extremes_maps.rs`.
                continue;
            }
            with(&parameter.name, &end.to_string());
            let beyond = if end <= parameter.minimum.expect("both") {
                end - 1.0
            } else {
                parameter.maximum.expect("both") * 2.0
            };
            let refused = (entry.build)(
                &Context::default(),
                &parse_settings(&format!("{}={beyond}", parameter.name)).expect("settings"),
            );
            assert!(refused.is_err(), "{}={beyond}", parameter.name);
        }
    }
    for (name, settings) in entry.presets {
        assert!(parse_settings(settings).is_ok(), "{name}");
        preset(name, small);
    }
}

#[test]
fn a_point_light_takes_one_sample_a_frame_and_is_hard() {
    let mut scene = squares(&[[0.0, 1.5, 0.0]]);
    let at = scene.lights[0].scene_from_light;
    scene.lights[0] = AreaLight::new("light", at, Shape::Point);
    let camera = camera_at(&scene, [0.0; 3]);
    let technique = temporal("");
    let mut sequence = Sequence::new(technique.as_ref());
    for i in 0..4 {
        let scene = moved(&scene, 1, [if i > 1 { 0.2 } else { 0.0 }, 0.0, 0.0]);
        let found = next_visibility(&mut sequence, &scene, &camera);
        assert!(found.iter().all(|&v| v == 0.0 || v == 1.0), "{found:?}");
        assert!(found.contains(&0.0) && found.contains(&1.0));
    }
}

#[test]
fn pixels_with_several_receivers_are_fetched_from_where_these_lie() {
    // What moves has every receiver look for its past; the camera stands still, so each finds it at its own place. Half a pixel off,
    // the passes of an antialiased image would walk a quarter of a pixel a frame: five pixels in twenty frames.
    let animated = load_animated("procedural:moving?camera=0&caster=1").expect("loads");
    let last = |antialiasing: u32| {
        let technique = temporal("map_size=512");
        let mut sequence = Sequence::new(technique.as_ref());
        let request = Request { irradiance: true, antialiasing, ..request([96, 72]) };
        let frame = |frame: u32| {
            let scene = animated.pose(0, f64::from(frame) / 24.0).expect("poses");
            sequence.frame(&scene, &scene.cameras[0], &request, &Progress::default()).expect("renders")
        };
        (0..20).map(frame).last().expect("frames").lights.swap_remove(0).irradiance
    };
    let scene = animated.pose(0, 19.0 / 24.0).expect("poses");
    let request = Request { irradiance: true, antialiasing: 2, ..request([96, 72]) };
    let exact = render(&scene, &scene.cameras[0], &Exact, &request, &Progress::default()).expect("renders");
    let exact = &exact.lights[0].irradiance;
    let error = |found: &[[f32; 3]]| {
        let squares = found.iter().zip(exact).map(|(a, b)| f64::from(a[0] - b[0]).powi(2));
        (squares.sum::<f64>() / exact.len() as f64).sqrt()
    };
    // One receiver a pixel is off by what the others see at edges; four by less.
    let [one, four] = [last(1), last(2)].map(|found| error(&found));
    assert!(four < one, "{four} with four receivers a pixel, {one} with one");
}

#[test]
fn a_start_that_halves_round_to_nothing_is_none() {
    let scene = build("square").expect("builds").scene;
    let shown = |weight: &str| {
        // No error is above the threshold, but PCSS is asked for, and both have the same map.
        let settings = format!("frames=1 threshold=0.99 map_size=256 start_weight={weight}");
        let technique = preset("paper", &settings);
        visibility_of(still(&scene, &scene.cameras[0], technique.as_ref()))
    };
    assert_eq!(shown("1e-8"), shown("0"));
    assert!(shown("0").contains(&1.0));
}
