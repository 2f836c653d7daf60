//! Facts about soft shadow maps: closed forms within derived bounds, what the paper says of its errors, and the numbers in which
//! patches are added.

mod common;
#[expect(dead_code, reason = "its small scenes are for tests of every technique")]
#[path = "common/drawn.rs"]
mod drawn;

use common::*;
use drawn::*;
use glam::{DVec2, DVec3};
use penumbra::Error;
use penumbra::gpu::Gpu;
use penumbra::progress::Progress;
use penumbra::receivers::Receivers;
use penumbra::render::{Request, render, render_receivers};
use penumbra::scene::procedural::build;
use penumbra::scene::{AreaLight, Scene, Shape};
use penumbra::techniques::{Entry, Parameters, Technique, parse_settings};

const NAME: &str = "soft-shadow-map";

fn made(settings: &str) -> Box<dyn Technique> {
    technique(NAME, settings)
}

/// The paper's method with maps of a size.
fn split(map_size: u32, more: &str) -> Box<dyn Technique> {
    made(&format!("self_shadowing=false map_size={map_size} {more}"))
}

/// A square of half side `half` at height `lift` over a floor, below a square light of half side 1 at height 5.
fn square_over_floor(half: f32, lift: f32) -> Scene {
    let square = mesh(&quad([-half, half], lift, [-half, half]));
    scene(vec![square, mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]))], vec![square_light(1.0, 5.0)])
}

/// A closed box around a point, over a floor.
fn box_over_floor(center: [f32; 3], half: f32, light: AreaLight) -> Scene {
    let corner = |i: usize| {
        let side = |bit: usize| if i & bit == 0 { -half } else { half };
        [center[0] + side(1), center[1] + side(2), center[2] + side(4)]
    };
    let faces = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];
    let triangles: Vec<_> =
        faces.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]].map(|t| t.map(corner))).collect();
    scene(vec![mesh(&triangles), mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]))], vec![light])
}

/// A grid of points of the floor, `count` a side within ±`half`, row by row.
fn grid(half: f64, count: usize) -> Vec<DVec3> {
    let place = |i: usize| half * (2.0 * (i as f64 + 0.5) / count as f64 - 1.0);
    (0..count * count).map(|i| DVec3::new(place(i % count), 0.0, place(i / count))).collect()
}

/// The paper's error: the mean of |ΔV| over what is in shadow.
fn mean_error(scene: &Scene, points: &[DVec3], technique: &dyn Technique) -> f64 {
    let truth = exact_visibility(scene, points);
    let pairs = drawn(scene, points, technique).into_iter().zip(truth);
    let errors: Vec<f64> =
        pairs.filter(|&(_, truth)| truth < 1.0).map(|(v, truth)| (f64::from(v) - truth).abs()).collect();
    assert!(errors.len() > 50, "{} receivers in shadow", errors.len());
    errors.iter().sum::<f64>() / errors.len() as f64
}

// ---------------------------------------------------------------------------------------------------------- closed forms

#[test]
fn a_planar_occluder_is_off_by_its_patches_alone() {
    // From the light's centre, receivers of ±2 m at 5 m with the light's half metre-wide image around them, at 3 m: slopes up to
    // 0.4 + (1/3 − 1/5) in the map of occluders, up to 0.4 in the soft shadow map, and a light 2 · (1/3 − 1/5) wide there, but for
    // the thousandth by which depths go beyond.
    let light = 2.0 * (1.0 / 3.0 - 1.0 / 5.0);
    let (map, ssm) = (2.0 * 1.01 * (0.4 + 0.5 * light), 2.0 * 0.4);
    // An edge at 20° crosses texels askew, which puts it off by (cos + sin)/cos as far.
    let askew = 1.0 + 20f64.to_radians().tan();
    for (spec, edges) in [("square", 4.0), ("edge", 1.0), ("edge?angle=20", askew)] {
        let procedural = build(spec).expect("builds");
        let truth = procedural.truth.as_ref().expect("has a truth");
        // The paper's: half a texel of the occluder, half a texel of the soft shadow map, and 64² roundings of 2^-24.
        let paper = |n: f64| edges * 0.5 * (map + ssm) / n / light + n * n * 2f64.powi(-24);
        // At the receivers: half a patch, which is at most the light's half width by a quarter of `patches` less one, and half a
        // texel by which its depth is taken off its middle.
        let view = |n: f64, patches: f64| edges * (1.0 / (patches - 4.0) + map / n / light) + 1e-4;
        for (settings, bound) in [
            ("self_shadowing=false map_size=64 blending=fp32", paper(64.0)),
            ("self_shadowing=false map_size=64 blending=fixed sides=front", paper(64.0)),
            ("self_shadowing=false map_size=37 blending=fp32 sides=bottom", paper(37.0)),
            ("map_size=256 patches=32", view(256.0, 32.0)),
            ("map_size=64 patches=16 sides=front", view(64.0, 16.0)),
        ] {
            let request = Request { size: [40, 40], irradiance: false, shaded: None, antialiasing: 1, verify: None };
            let scene = &procedural.scene;
            let technique = made(settings);
            let rendering =
                render(scene, &scene.cameras[0], technique.as_ref(), &request, &Progress::default()).expect("renders");
            let pixels = rendering.receivers.pixels.iter().flatten().zip(&rendering.lights[0].visibility);
            let mut penumbra = 0;
            for (receiver, &v) in pixels {
                let expected = truth.visibility(receiver.position + scene.origin_world);
                penumbra += usize::from(0.0 < expected && expected < 1.0);
                assert!((f64::from(v) - expected).abs() <= bound, "{spec} {settings}: {v} for {expected} ± {bound}");
            }
            assert!(penumbra > 50, "{spec}: {penumbra} in penumbra");
        }
    }
}

#[test]
fn the_mass_of_a_shadow_is_that_of_its_occluder() {
    // C6: ∬ψ = A (H/(H − h))², whatever the light. The map of occluders ends where the square does, so that its area is exact; 96²
    // midpoints over a continuous function with kinks a penumbra apart err by less than (step/penumbra)² of it, and the soft shadow
    // map's texels once more.
    for (half, shape) in [(0.5, "rect"), (1.0, "rect"), (1.0, "disk")] {
        let size = DVec2::splat(2.0 * half);
        let shape = if shape == "rect" { Shape::Rect { size } } else { Shape::Disk { size } };
        let mut scene = square_over_floor(0.5, 2.0);
        scene.lights[0] = AreaLight { shape, ..scene.lights[0].clone() };
        let step = 4.0 / 96.0;
        let tolerance = 2.0 * (step / (2.0 * half * 2.0 / 3.0)).powi(2);
        for settings in ["self_shadowing=false map_size=64", "map_size=256 patches=64"] {
            let found = drawn(&scene, &grid(2.0, 96), made(settings).as_ref());
            let mass = found.iter().map(|&v| 1.0 - f64::from(v)).sum::<f64>() * step * step;
            let expected = (5.0f64 / 3.0).powi(2);
            assert!((mass - expected).abs() <= tolerance * expected, "{shape:?} {settings}: {mass} for {expected}");
        }
    }
}

#[test]
fn every_shape_of_light_is_hidden_by_a_square() {
    // Bounds as above, for the light of every shape 4 m up, at slopes up to (2 + 0.2)/4 and a square 2 m below: its width there is
    // a quarter of its own. The chord of a disk is up to 4/π of a square's share. What faces the middle of the receivers is seen
    // askew by up to 30° elsewhere: a share of up to 1 − cos 30° of its width, half of it on each side, is off for spheres and tubes.
    let points = line(-2.0, 2.0, 200);
    for light in lights_of_every_shape() {
        let shape = light.shape;
        let scene = square_under(light);
        let truth = exact_visibility(&scene, &points);
        let askew =
            if matches!(shape, Shape::Sphere { .. } | Shape::Tube { .. }) { 0.5 * (1.0 - 0.75f64.sqrt()) } else { 0.0 };
        let narrowest = if matches!(shape, Shape::Tube { .. }) { 0.2 / 4.0 } else { 0.4 / 4.0 };
        let texel = 2.0 * ((2.0 + 0.2) / 4.0 + 1.5 / 8.0) / 1024.0;
        let bound = 4.0 * (4.0 / std::f64::consts::PI) * (1.0 / 60.0 + texel / narrowest) + askew;
        let found = drawn(&scene, &points, made("map_size=1024 patches=64").as_ref());
        let mut shadowed = 0;
        for (&v, truth) in found.iter().zip(truth) {
            shadowed += usize::from(truth < 0.5);
            let is_edge = shape.is_point();
            assert!(is_edge || (f64::from(v) - truth).abs() <= bound, "{shape:?}: {v} for {truth} ± {bound}");
        }
        assert!(shadowed > 10, "{shape:?}");
        // A point: no more than the two texels at the edges differ.
        if shape.is_point() {
            let truth = exact_visibility(&scene, &points);
            let differing = found.iter().zip(truth).filter(|&(&v, truth)| f64::from(v) != truth).count();
            assert!(differing <= 2, "{differing}");
        }
    }
}

#[test]
fn what_nothing_hides_is_lit_exactly() {
    let scene = square_over_floor(0.25, 2.0);
    // The penumbra ends at (0.25 + 1 · 2/5) · 5/3 = 1.083 m.
    let points: Vec<DVec3> = line(-4.0, 4.0, 300).into_iter().filter(|point| point.x.abs() > 1.2).collect();
    for settings in ["self_shadowing=false map_size=32", "self_shadowing=false map_size=32 blending=fp16", ""] {
        assert!(drawn(&scene, &points, made(settings).as_ref()).iter().all(|&v| v == 1.0), "{settings}");
    }
}

// ------------------------------------------------------------------------------------------------------- the paper's errors

#[test]
fn both_sides_of_a_flat_square_are_one() {
    let scene = square_over_floor(0.5, 2.0);
    let points = grid(2.0, 24);
    for mode in ["self_shadowing=false map_size=48", "map_size=128"] {
        let [front, both] =
            ["front", "both"].map(|sides| drawn(&scene, &points, made(&format!("{mode} sides={sides}")).as_ref()));
        assert!(front.iter().any(|&v| v < 0.5));
        assert_eq!(front, both, "{mode}");
    }
}

#[test]
fn a_box_is_nearer_the_truth_with_both_its_sides() {
    let contact = build("contact").expect("builds").scene;
    let request = Request { size: [48, 36], irradiance: false, shaded: None, antialiasing: 1, verify: None };
    for mode in ["self_shadowing=false map_size=64", "map_size=256"] {
        let [front, both] = ["front", "both"].map(|sides| {
            let technique = made(&format!("{mode} sides={sides}"));
            let found = render(&contact, &contact.cameras[0], technique.as_ref(), &request, &Progress::default())
                .expect("renders");
            let truth = exact(&contact, &found.receivers).swap_remove(0);
            let seen =
                found.receivers.pixels.iter().zip(&found.lights[0].visibility).filter(|(pixel, _)| pixel.is_some());
            let shadow = seen.zip(truth).filter(|(_, truth)| truth.facing && truth.visibility < 1.0);
            let errors: Vec<f64> = shadow.map(|((_, &v), truth)| (f64::from(v) - truth.visibility).abs()).collect();
            assert!(errors.len() > 50, "{} receivers in shadow", errors.len());
            errors.iter().sum::<f64>() / errors.len() as f64
        });
        assert!(both <= front, "{mode}: {both} with both, {front} with one");
        // What one side leaves out is there.
        assert!(front > 0.002, "{mode}: {front}");
    }
}

#[test]
fn walls_of_a_box_count_twice_below_a_wide_light() {
    // The farthest surfaces of a box in the air are its bottom and its walls: patches behind one another that overlap as seen from
    // below (Eq. 3), by more than the bottom adds. A known limit of sums.
    let scene = box_over_floor([0.3, 1.5, 0.1], 0.5, square_light(1.0, 5.0));
    let [front, both] = ["front", "both"]
        .map(|sides| mean_error(&scene, &grid(2.5, 40), split(48, &format!("sides={sides}")).as_ref()));
    assert!(front < both && both < 0.05, "{front} with one side, {both} with both");
}

#[test]
fn the_error_is_flat_in_texels_and_grows_towards_the_light_and_aside() {
    let points = grid(3.0, 72);
    let error = |[x, y, z]: [f32; 3], size: u32| {
        let ball =
            sphere(12).into_iter().map(|triangle| triangle.map(|p| [0.4 * p[0] + x, 0.4 * p[1] + y, 0.4 * p[2] + z]));
        let ball = mesh(&ball.collect::<Vec<_>>());
        let scene = scene(vec![ball, mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]))], vec![square_light(0.3, 5.0)]);
        mean_error(&scene, &points, made(&format!("map_size={size} patches=64")).as_ref())
    };
    // Fig. 17: beyond some 200² texels silhouettes are what is left.
    let [few, enough, many] = [4, 256, 1024].map(|size| error([0.0, 1.5, 0.0], size));
    // Fig. 20 and Fig. 19.
    let [low, high, aside] = [[0.0, 0.8, 0.0], [0.0, 3.5, 0.0], [1.5, 1.5, 0.0]].map(|center| error(center, 256));
    let all = format!("{few}, {enough}, {many} by texels; {low} low, {high} high, {aside} aside");
    assert!((enough - many).abs() < 0.1 * enough && few > 1.2 * enough, "{all}");
    assert!(low < enough && enough < high && enough < aside, "{all}");
}

#[test]
fn casters_one_above_the_other_are_at_least_what_the_nearer_one_hides() {
    // The lower square lies in the shadow of the upper one as the centre sees it, and reaches beyond it from elsewhere. The split
    // knows the nearest and the farthest surface, each alone: V is at most that of either, and at least 1 − the sum of both.
    let floor = || mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]));
    let upper = || mesh(&quad([-0.5, 0.5], 3.0, [-0.5, 0.5]));
    let lower = || mesh(&quad([-0.5, 0.5], 1.5, [-0.5, 0.5]));
    let light = || vec![square_light(1.0, 5.0)];
    let points = line(-2.5, 2.5, 60);
    let of = |meshes| drawn(&scene(meshes, light()), &points, made("map_size=512 patches=64").as_ref());
    let (both, upper, lower) =
        (of(vec![upper(), lower(), floor()]), of(vec![upper(), floor()]), of(vec![lower(), floor()]));
    // Half a patch of 1/60 on either side of either.
    let tolerance = 4.0 / 60.0;
    for i in 0..points.len() {
        let least = (upper[i] + lower[i] - 1.0).max(0.0);
        assert!(both[i] <= upper[i].min(lower[i]) + tolerance && both[i] >= least - tolerance, "{i}: {}", both[i]);
    }
}

// ---------------------------------------------------------------------------------------------------------------- numbers

/// A half, as the bits say.
fn half(bits: u16) -> f64 {
    let (exponent, fraction) = (i32::from(bits >> 10 & 31), f64::from(bits & 1023));
    if exponent == 0 { fraction * 2f64.powi(-24) } else { (1.0 + fraction / 1024.0) * 2f64.powi(exponent - 15) }
}

/// A positive number as a half: the nearest one, ties to even, or the one below.
fn to_half(x: f64, truncates: bool) -> f64 {
    let spacing = 2f64.powi((x.log2().floor() as i32).max(-14) - 10);
    let steps = x / spacing;
    spacing * if truncates { steps.floor() } else { steps.round_ties_even() }
}

/// What blending adds up to in halves, from 0: `share` so many times.
fn blended(gpu: &Gpu, share: f32, count: u32) -> f64 {
    let source = format!(
        "@vertex fn vertex(@builtin(vertex_index) i: u32) -> @builtin(position) vec4<f32> {{
             return vec4(f32(i % 3u & 1u) * 4.0 - 1.0, f32(i % 3u >> 1u) * 4.0 - 1.0, 0.0, 1.0);
         }}
         @fragment fn fragment() -> @location(0) f32 {{ return {share:?}; }}"
    );
    let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: None,
        source: wgpu::ShaderSource::Wgsl(source.into()),
    });
    let add = wgpu::BlendComponent {
        src_factor: wgpu::BlendFactor::One,
        dst_factor: wgpu::BlendFactor::One,
        operation: wgpu::BlendOperation::Add,
    };
    let target = wgpu::ColorTargetState {
        format: wgpu::TextureFormat::R16Float,
        blend: Some(wgpu::BlendState { color: add, alpha: add }),
        write_mask: wgpu::ColorWrites::ALL,
    };
    let pipeline = gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: None,
        layout: None,
        vertex: wgpu::VertexState {
            module: &module,
            entry_point: None,
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers: &[],
        },
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: None,
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: &module,
            entry_point: None,
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            targets: &[Some(target)],
        }),
        multiview_mask: None,
        cache: None,
    });
    let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC;
    let sums = gpu.texture("sums", [1, 1, 1], wgpu::TextureFormat::R16Float, usage).expect("fits");
    let view = sums.create_view(&wgpu::TextureViewDescriptor::default());
    let mut frame = penumbra::gpu::pass::Frame::new(gpu);
    let color = wgpu::RenderPassColorAttachment {
        view: &view,
        depth_slice: None,
        resolve_target: None,
        ops: wgpu::Operations { load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT), store: wgpu::StoreOp::Store },
    };
    frame.render("sums", &[Some(color)], None, |pass| {
        pass.set_pipeline(&pipeline);
        pass.draw(0..3 * count, 0..1);
    });
    let (_, buffer) = gpu.copy_of(&sums, frame.encoder()).expect("fits");
    frame.finish().expect("runs");
    half(gpu.read_buffer::<u16>(&buffer).expect("reads")[0])
}

/// Whether the driver truncates what it blends in halves.
fn truncates() -> bool {
    let gpu = CONTEXT.gpu().expect("there is one");
    let found = blended(&gpu, 0.001, 5000);
    let of = |truncates| (0..5000).fold(0.0, |sum, _| to_half(sum + f64::from(0.001f32), truncates));
    // Near 2 where the driver truncates, near 4 where it takes the nearest.
    let truncates = (found - of(true)).abs() < (found - of(false)).abs();
    assert!((found - of(truncates)).abs() < 0.02 * found, "{found} is neither {} nor {}", of(true), of(false));
    truncates
}

#[test]
fn equal_patches_of_a_power_of_two_stop_in_halves_after_2048() {
    let gpu = CONTEXT.gpu().expect("there is one");
    // However the driver rounds: up to 2048 e all is exact, and there half a spacing is e.
    for exponent in [-11, -13] {
        let share = 2f32.powi(exponent);
        for (count, expected) in [(1000, 1000.0), (2048, 2048.0), (3000, 2048.0)] {
            assert_eq!(blended(&gpu, share, count), expected * f64::from(share), "2^{exponent}, {count} times");
        }
    }
}

/// What the patches of a square hide of the light in the middle of its umbra, summed as halves are. The light is 0.8 of the square
/// wide there: (1/3 − 1/5)/(0.5/3).
fn predicted(map_size: u32, truncates: bool) -> f64 {
    let width = 0.8 * f64::from(map_size);
    let share = |i: u32| {
        let low = f64::from(i) - 0.5 * f64::from(map_size);
        let [a, b] = [low, low + 1.0].map(|at| at.clamp(-0.5 * width, 0.5 * width));
        (b - a) / width
    };
    let mut sum = 0.0;
    for y in 0..map_size {
        for x in 0..map_size {
            let more = share(x) * share(y);
            if more > 0.0 {
                sum = to_half(sum + more, truncates);
            }
        }
    }
    sum
}

#[test]
fn halves_stop_where_the_drivers_rounding_says_and_nothing_else_does() {
    let truncates = truncates();
    let scene = square_over_floor(0.5, 2.0);
    // The others give the maps their width.
    let points: Vec<DVec3> = grid(2.0, 8).into_iter().chain([DVec3::new(0.013, 0.0, -0.017)]).collect();
    for map_size in [39, 64, 96, 128] {
        let [fp16, fp32, fixed] = ["fp16", "fp32", "fixed"].map(|blending| {
            f64::from(drawn(&scene, &points, split(map_size, &format!("sides=front blending={blending}")).as_ref())[64])
        });
        let expected = 1.0 - predicted(map_size, truncates).min(1.0);
        // Where the texel's middle lies among the patches moves the order of unequal ones, of which each is at most two of the
        // last spacing, 2^-11, in each of two columns and rows.
        let tolerance = 4.0 * f64::from(map_size) * 2f64.powi(-11) * predicted(map_size, truncates).min(0.25);
        assert!((fp16 - expected).abs() <= tolerance, "{map_size}: {fp16} for {expected} ± {tolerance}");
        // N² roundings of 2^-25 of at most 1.
        let rounding = f64::from(map_size).powi(2) * 2f64.powi(-24);
        assert!(fp32 <= rounding && fixed <= rounding, "{map_size}: {fp32}, {fixed}");
        // Eq. 4, the safe side: the light is less than 32 patches wide, and each of them counts.
        if 0.8 * f64::from(map_size) < 32.0 {
            assert!(fp16 < 0.1, "{map_size}: {fp16}");
        } else if truncates && map_size >= 64 {
            assert!(fp16 > 0.4, "{map_size}: {fp16}");
        }
    }
    // All over the penumbra: the paper's case, and the fallback that is as exact.
    let points = line(-2.0, 2.0, 200);
    let [fp32, fixed] =
        ["fp32", "fixed"].map(|blending| drawn(&scene, &points, split(96, &format!("blending={blending}")).as_ref()));
    for (a, b) in fp32.iter().zip(&fixed) {
        assert!((a - b).abs() <= 96f32.powi(2) * 2f32.powi(-24), "{a} and {b}");
    }
}

#[test]
fn patches_are_the_occupied_texels() {
    // From −0.5 to −0.1 and from 0.2 to 0.5 of a window from −0.5 to 0.5: texels whose middles are there, in all rows.
    let squares = [[-0.5, -0.1], [0.2, 0.5]].map(|x| mesh(&quad(x, 2.0, [-0.5, 0.5])));
    let mut meshes = squares.to_vec();
    meshes.push(mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0])));
    let scene = scene(meshes, vec![square_light(1.0, 5.0)]);
    for size in [1u32, 2, 33, 50, 101] {
        let middle = |i: u32| (f64::from(i) + 0.5) / f64::from(size) - 0.5;
        let columns = (0..size).map(middle).filter(|x| !(-0.1..=0.2).contains(x)).count() as u64;
        for (sides, maps) in [("front", 1), ("both", 2)] {
            let image = draw(&scene, &grid(2.0, 8), split(size, &format!("sides={sides}")).as_ref()).swap_remove(0);
            assert_eq!(image.texels, maps * columns * u64::from(size), "{size} {sides}");
        }
    }
}

// ---------------------------------------------------------------------------------------------------------------- extremes

#[test]
fn the_same_bits_in_every_run_and_at_every_scale() {
    let scene = box_over_floor([0.3, 1.5, 0.1], 0.5, square_light(1.0, 5.0));
    let points = line(-2.0, 2.0, 100);
    for settings in [
        "self_shadowing=false map_size=32 blending=fp16",
        "self_shadowing=false map_size=32 blending=fp32",
        "self_shadowing=false map_size=32 blending=fixed",
        "map_size=128",
    ] {
        let technique = made(settings);
        let first = draw(&scene, &points, technique.as_ref());
        same_bits(settings, &first, &draw(&scene, &points, technique.as_ref()));
        for exponent in [-20, 20] {
            let factor = 2f64.powi(exponent);
            let points: Vec<DVec3> = points.iter().map(|point| factor * point).collect();
            same_bits(settings, &first, &draw(&scaled(&scene, factor), &points, technique.as_ref()));
        }
    }
}

#[test]
fn lights_without_size_and_of_any_size_answer() {
    let points = line(-2.0, 2.0, 200);
    for half in [0.0, 1e-30, 1e-6] {
        let scene = square_under(square_light(half, 5.0));
        for settings in ["self_shadowing=false map_size=64", "map_size=64"] {
            let found = drawn(&scene, &points, made(settings).as_ref());
            // C3: the step is at ½ · 5/3; the soft shadow map blurs it over a texel to either side.
            for (point, v) in points.iter().zip(found) {
                if (point.x.abs() - 0.5 * 5.0 / 3.0).abs() > 0.15 {
                    assert_eq!(v, if point.x.abs() < 0.8 { 0.0 } else { 1.0 }, "{half} {settings} at {}", point.x);
                }
            }
        }
    }
    // 10⁶ heights wide: what a metre hides of it is nothing.
    let found = drawn(&square_under(square_light(5e6, 5.0)), &points, made("map_size=64").as_ref());
    assert!(found.iter().all(|&v| v > 0.9999), "{found:?}");
}

#[test]
fn receivers_on_the_edges_of_texels_are_as_dark_as_others() {
    // A single row of receivers makes a map that is centred on it: all lie where two rows of texels meet.
    for half in [1e-12, 1e-3, 0.5] {
        let points: Vec<DVec3> = line(-0.4, 0.4, 20).into_iter().map(|point| DVec3 { z: 0.0, ..point }).collect();
        for shape in [Shape::Rect { size: DVec2::splat(2.0 * half) }, Shape::Sphere { radius: half, facing: false }] {
            let scene = square_under(light_down(shape, [0.0, 5.0, 0.0]));
            for settings in ["map_size=64", "map_size=63"] {
                let found = drawn(&scene, &points, made(settings).as_ref());
                assert!(found.iter().all(|&v| v == 0.0), "{shape:?} {settings}: {found:?}");
            }
        }
    }
}

#[test]
fn a_caster_at_the_receiver_hides_all_and_one_beyond_the_light_nothing() {
    let points = grid(0.4, 6);
    for lift in [0.01, 0.1] {
        // A light 2 · lift/5 wide there: far within the square, which is above the bias of a quarter texel of 2 · 0.5/1024.
        let found = drawn(&square_over_floor(0.5, lift), &points, made("").as_ref());
        assert!(found.iter().all(|&v| v <= 1e-3), "{lift}: {found:?}");
        let found = drawn(&square_over_floor(0.5, lift), &points, split(32, "").as_ref());
        assert!(found.iter().all(|&v| v <= 1e-3), "{lift}: {found:?}");
    }
    for lift in [5.0, 5.5] {
        for settings in ["self_shadowing=false map_size=32", ""] {
            let found = drawn(&square_over_floor(0.5, lift), &points, made(settings).as_ref());
            assert!(found.iter().all(|&v| v == 1.0), "{lift} {settings}: {found:?}");
        }
    }
}

#[test]
fn a_wall_through_the_lights_plane_loses_what_is_far_off_its_axis() {
    // A light 4 m wide, 1 m above the floor, and a wall 10 cm beside it: dark behind the wall. The map sees it up to 76° off the
    // axis, to 2.1/4 of a metre below the light; from 3 m the light to the left of 3 − 0.9/0.475 = 1.1 m is hidden by that, from
    // 4 m that left of 4 − 1.9/0.475 = 0. What is lost is up to 0.9/4 and 2/4 of the light: a known limit.
    let wall = vec![
        [[2.1, 0.0, -50.0], [2.1, 3.0, -50.0], [2.1, 3.0, 50.0]],
        [[2.1, 0.0, -50.0], [2.1, 3.0, 50.0], [2.1, 0.0, 50.0]],
    ];
    let scene = scene(vec![mesh(&wall), mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]))], vec![square_light(2.0, 1.0)]);
    let found = drawn(&scene, &line(2.3, 4.0, 40), made("").as_ref());
    assert!(found.iter().all(|&v| v < 1.0), "{found:?}");
    let found = drawn(&scene, &line(-2.0, 2.0, 40), made("").as_ref());
    assert!(found.iter().all(|&v| v == 1.0), "{found:?}");
}

#[test]
fn both_ends_of_every_parameter_answer_or_refuse_in_one_line() {
    let scene = bumpy(lights_of_every_shape());
    let points = line(-1.5, 1.5, 40);
    for settings in [
        "map_size=1",
        "map_size=4096",
        "patches=8",
        "patches=64 map_size=1024",
        "map_size=1 self_shadowing=false",
        "map_size=16 self_shadowing=false sides=bottom blending=fixed",
    ] {
        assert_eq!(draw(&scene, &points, made(settings).as_ref()).len(), scene.lights.len(), "{settings}");
    }
    let refused = |settings: &str| match (Entry::find(NAME).expect("there is").build)(
        &CONTEXT,
        &parse_settings(settings).expect("settings"),
    ) {
        Err(error) => error.to_string(),
        Ok(_) => panic!("{settings} builds"),
    };
    for settings in
        ["map_size=0", "map_size=4097", "patches=4", "patches=10", "patches=68", "sides=top", "blending=fp8"]
    {
        let message = refused(settings);
        assert!(message.starts_with("parameter ") && !message.contains('\n'), "{settings}: {message}");
    }
    // Work that would never end.
    let scene = square_over_floor(0.5, 2.0);
    let message = failure(&scene, receivers(&scene, &grid(2.0, 8), DVec3::Y), split(4096, "").as_ref());
    assert!(message.starts_with("parameter map_size of soft-shadow-map: patches of 4096 x 4096 texels"), "{message}");
}

/// What a technique says of a scene that it refuses.
fn failure(scene: &Scene, receivers: Receivers, technique: &dyn Technique) -> String {
    match render_receivers(scene, receivers, technique, false, &Progress::default()) {
        Err(error @ Error::Usage { .. }) => error.to_string(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn receivers_all_around_a_light_are_refused() {
    let scene =
        box_over_floor([0.0, 1.5, 0.0], 0.5, light_down(Shape::Sphere { radius: 0.1, facing: false }, [0.0, 3.0, 0.0]));
    let mut around = receivers(&scene, &[DVec3::new(0.0, 0.0, 0.0), DVec3::new(0.0, 10.0, 0.0)], DVec3::Y);
    around.pixels[1].as_mut().expect("is there").normal = DVec3::NEG_Y;
    let message = failure(&scene, around, made("").as_ref());
    assert!(message.starts_with("soft-shadow-map of light \"light\": receivers lie around it"), "{message}");
}

#[test]
fn sets_are_named_by_node_or_found() {
    // Node 0 is the square, node 1 the floor.
    let scene = square_over_floor(0.5, 2.0);
    let points = line(-2.0, 2.0, 60);
    let named = |settings: &[(&str, &str)]| {
        let mut parameters: Parameters = parse_settings("self_shadowing=false map_size=32").expect("settings");
        parameters.extend(settings.iter().map(|&(key, name)| (key.to_owned(), name.into())));
        (Entry::find(NAME).expect("there is").build)(&CONTEXT, &parameters).expect("builds")
    };
    let found = drawn(&scene, &points, named(&[]).as_ref());
    assert!(found.iter().any(|&v| v < 0.01));
    for settings in [
        &[("occluders", "node 0")][..],
        &[("receivers", "node 1")],
        &[("occluders", "node 0"), ("receivers", "node 1")],
    ] {
        assert_eq!(drawn(&scene, &points, named(settings).as_ref()), found, "{settings:?}");
    }
    let at = || receivers(&scene, &points, DVec3::Y);
    let message = failure(&scene, at(), named(&[("occluders", "sqare")]).as_ref());
    assert_eq!(message, "parameter occluders of soft-shadow-map: the scene has no node \"sqare\"");
    let message = failure(&scene, at(), named(&[("occluders", "node 0,node 1"), ("receivers", "node 1")]).as_ref());
    assert!(message.starts_with("parameter receivers of soft-shadow-map: \"node 1\" is an occluder too"), "{message}");
}

#[test]
fn instances_shade_themselves_without_the_split_alone() {
    // Receivers in the middle of the lower face of a box's top, seen from within: dark without the split. With it the box is an
    // occluder, and its own receivers are lit as if alone.
    let scene = box_over_floor([0.0, 1.5, 0.0], 0.5, square_light(0.5, 5.0));
    let mut inside = receivers(&scene, &[DVec3::new(0.05, 1.0, 0.03), DVec3::new(-0.1, 1.0, 0.1)], DVec3::Y);
    for receiver in inside.pixels.iter_mut().flatten() {
        receiver.instance = 0;
    }
    let found = draw_receivers(&scene, inside.clone(), made("").as_ref()).swap_remove(0).visibility;
    assert!(found.iter().all(|&v| v < 1e-3), "{found:?}");
    let mut named: Parameters = parse_settings("self_shadowing=false map_size=32").expect("settings");
    named.insert("occluders".into(), "node 0".into());
    let technique = (Entry::find(NAME).expect("there is").build)(&CONTEXT, &named).expect("builds");
    let found = draw_receivers(&scene, inside, technique.as_ref()).swap_remove(0).visibility;
    assert_eq!(found, [1.0, 1.0]);
}
