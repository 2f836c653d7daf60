//! Min–max pyramids: `min-max-pcf` is `pcf` bit for bit and reads far less of the map; `min-max-backprojection` is the truth where
//! occluders lie at one depth, and off by what is stated where not.

mod common;
#[expect(dead_code, reason = "its settings for tests are not needed")]
#[path = "common/drawn.rs"]
mod drawn;

use common::*;
use drawn::{CONTEXT, draw, draw_receivers, drawn, technique};
use glam::{DVec2, DVec3};
use penumbra::closed_forms::{disk_edge_fraction, occluder_image, rect_edge_fraction};
use penumbra::gpu::Gpu;
use penumbra::gpu::min_max::{Bounded, MinMax};
use penumbra::gpu::pass::Frame;
use penumbra::gpu::shader::{Pipeline, Source};
use penumbra::gpu::shadow_map::CONSTANTS;
use penumbra::progress::Progress;
use penumbra::receivers::Receivers;
use penumbra::reference::exact::Exact;
use penumbra::render::{Request, render};
use penumbra::scene::{Scene, Shape, procedural};
use penumbra::techniques::{Entry, LightImage, Technique, parse_settings};

/// An upright rectangle at `x`.
fn wall(x: f32, [low, high]: [f32; 2], z: [f32; 2]) -> Vec<[[f32; 3]; 3]> {
    let [a, b, c, d] = [[x, low, z[0]], [x, high, z[0]], [x, high, z[1]], [x, low, z[1]]];
    vec![[a, b, c], [a, c, d]]
}

/// The six sides of a cube.
fn cube(center: [f32; 3], half: f32) -> Vec<[[f32; 3]; 3]> {
    let ends = |axis: usize| [center[axis] - half, center[axis] + half];
    let mut sides = [quad(ends(0), ends(1)[0], ends(2)), quad(ends(0), ends(1)[1], ends(2))].concat();
    for x in ends(0) {
        sides.extend(wall(x, ends(1), ends(2)));
    }
    for z in ends(2) {
        // Turned about the vertical through the centre.
        let turned = |[x, y, _]: [f32; 3], across: f32| [center[0] + across - center[2], y, x];
        sides.extend(wall(z, ends(1), ends(2)).into_iter().map(|t| t.map(|p| turned(p, p[2]))));
    }
    sides
}

/// The key light of a procedural scene's view.
fn view(scene: &str, technique: &dyn Technique, size: u32) -> LightImage {
    let procedural = procedural::build(scene).expect("builds");
    let request = Request { size: [size; 2], irradiance: false, shaded: None, antialiasing: 1, verify: None };
    let camera = &procedural.scene.cameras[0];
    render(&procedural.scene, camera, technique, &request, &Progress::default()).expect("renders").lights.swap_remove(0)
}

fn assert_same_bits(what: &str, a: &LightImage, b: &LightImage) {
    let differing = a.visibility.iter().zip(&b.visibility).filter(|(a, b)| a.to_bits() != b.to_bits()).count();
    assert_eq!((differing, a.visibility.len()), (0, b.visibility.len()), "{what}");
}

// ------------------------------------------------------------------------------------------------------------------- the pyramid

/// Depths of a map and its pyramid: of each level all nodes, slope, low and high, row by row.
fn pyramid_over(gpu: &Gpu, depths: &[f32], size: u32, bounded: Bounded) -> Vec<Vec<[f32; 4]>> {
    let given = gpu.buffer("depths", depths, wgpu::BufferUsages::STORAGE).expect("fits");
    let usage = wgpu::TextureUsages::COPY_DST | wgpu::TextureUsages::TEXTURE_BINDING;
    let map = gpu.texture(
        "map",
        [size, size, 1],
        wgpu::TextureFormat::Depth32Float,
        usage | wgpu::TextureUsages::RENDER_ATTACHMENT,
    );
    let map = map.expect("fits");
    // Depth can't be copied to: a triangle over all of the map writes it.
    let text = format!(
        "@group(0) @binding(0) var<storage, read> given: array<f32>;
        struct Out {{ @builtin(frag_depth) depth: f32 }}
        @vertex fn vertex(@builtin(vertex_index) i: u32) -> @builtin(position) vec4<f32> {{
            return vec4(f32(i32(i & 1u) * 4 - 1), f32(i32(i >> 1u) * 4 - 1), 0.5, 1.0);
        }}
        @fragment fn fragment(@builtin(position) at: vec4<f32>) -> Out {{
            return Out(given[u32(at.y) * {size}u + u32(at.x)]);
        }}"
    );
    let module = gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: None,
        source: wgpu::ShaderSource::Wgsl(text.into()),
    });
    let writer = gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
        label: None,
        layout: None,
        vertex: wgpu::VertexState {
            module: &module,
            entry_point: Some("vertex"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            buffers: &[],
        },
        primitive: wgpu::PrimitiveState::default(),
        depth_stencil: Some(wgpu::DepthStencilState {
            format: wgpu::TextureFormat::Depth32Float,
            depth_write_enabled: Some(true),
            depth_compare: Some(wgpu::CompareFunction::Always),
            stencil: wgpu::StencilState::default(),
            bias: wgpu::DepthBiasState::default(),
        }),
        multisample: wgpu::MultisampleState::default(),
        fragment: Some(wgpu::FragmentState {
            module: &module,
            entry_point: Some("fragment"),
            compilation_options: wgpu::PipelineCompilationOptions::default(),
            targets: &[],
        }),
        multiview_mask: None,
        cache: None,
    });
    let group = gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: None,
        layout: &writer.get_bind_group_layout(0),
        entries: &[wgpu::BindGroupEntry { binding: 0, resource: given.as_entire_binding() }],
    });
    let target = map.create_view(&wgpu::TextureViewDescriptor::default());
    let maps = map.create_view(&wgpu::TextureViewDescriptor {
        dimension: Some(wgpu::TextureViewDimension::D2Array),
        ..wgpu::TextureViewDescriptor::default()
    });
    let attachment = wgpu::RenderPassDepthStencilAttachment {
        view: &target,
        depth_ops: Some(wgpu::Operations { load: wgpu::LoadOp::Clear(0.0), store: wgpu::StoreOp::Store }),
        stencil_ops: None,
    };
    let mut frame = Frame::new(gpu);
    frame.render("map", &[], Some(attachment), |pass| {
        pass.set_pipeline(&writer);
        pass.set_bind_group(0, &group, &[]);
        pass.draw(0..3, 0..1);
    });
    let pyramid = MinMax::new(gpu, size, 1, bounded).expect("fits");
    pyramid.build(&mut frame, &maps);
    let side = (size.next_power_of_two() / 2).max(1);
    let text = "#import \"lib/min_max.wgsl\"
        @group(0) @binding(100) var<storage, read_write> results: array<vec4<f32>>;
        override level: i32;
        override across: u32;
        @compute @workgroup_size(64)
        fn main(@builtin(global_invocation_id) id: vec3<u32>) {
            if (id.x < arrayLength(&results)) {
                let node = node_at(0u, Cursor(u32(level), vec2<i32>(vec2(id.x % across, id.x / across))));
                results[id.x] = vec4(node.slope, node.low, node.high);
            }
        }";
    let mut levels = Vec::new();
    for level in 0..=side.ilog2() {
        let across = side >> level;
        let constants = [("level", f64::from(level + 1)), ("across", f64::from(across))];
        let pipeline = Pipeline::compute(gpu, &Source::new("test", text), "main", &[CONSTANTS, &constants].concat());
        let count = across * across;
        let results = gpu.empty_buffer("results", 16 * u64::from(count), wgpu::BufferUsages::STORAGE).expect("fits");
        frame.compute("read", &pipeline).bind("pyramid", &pyramid.nodes).bind("results", &results).dispatch([
            count.div_ceil(64),
            1,
            1,
        ]);
        levels.push(results);
    }
    frame.finish().expect("runs");
    levels.iter().map(|results| gpu.read_buffer(results).expect("reads")).collect()
}

/// Maps of planes, steps, noise and nothing.
fn depths(size: u32, kind: usize, random: &mut Random) -> Vec<f32> {
    let texel = |i: u32| {
        let (x, y) = (f64::from(i % size), f64::from(i / size));
        let plane = 0.3 + (0.2 * x - 0.1 * y) / f64::from(size);
        let value = match kind {
            0 => plane,
            1 if x + 2.0 * y > f64::from(size) => 0.9,
            1 => plane,
            2 => random.between(0.0, 1.0),
            3 if x > 3.0 => 0.0,
            3 => 0.5,
            _ => 0.0,
        };
        value as f32
    };
    (0..size * size).map(texel).collect()
}

#[test]
fn nodes_bound_their_texels_on_maps_of_any_size() {
    let gpu = CONTEXT.gpu().expect("a GPU");
    let mut random = Random(31);
    for size in [1, 2, 3, 5, 16, 33, 100] {
        for kind in 0..5 {
            let depths = depths(size, kind, &mut random);
            for (slopes, neighbours) in [(false, false), (true, false), (false, true), (true, true)] {
                let levels = pyramid_over(&gpu, &depths, size, Bounded { slopes, neighbours });
                for (level, nodes) in (1..).zip(&levels) {
                    let across = (size.next_power_of_two() >> level).max(1);
                    assert_eq!(nodes.len() as u32, across * across);
                    for (i, [slope_x, slope_y, low, high]) in (0u32..).zip(nodes) {
                        let first = [(i % across) << level, (i / across) << level];
                        let reach = (1u32 << level) + u32::from(neighbours);
                        let (mut least, mut most) = (f32::INFINITY, f32::NEG_INFINITY);
                        for y in first[1]..(first[1] + reach).min(size) {
                            for x in first[0]..(first[0] + reach).min(size) {
                                let depth = depths[(y * size + x) as usize];
                                (least, most) = (least.min(depth), most.max(depth));
                                // In f64, which rounds these by far less than what the node leaves for roundings.
                                let tilt = f64::from(*slope_x) * f64::from(x - first[0])
                                    + f64::from(*slope_y) * f64::from(y - first[1]);
                                let level = f64::from(depth) - tilt;
                                let what = format!("{size} {kind} {slopes} {neighbours} {first:?}");
                                assert!((f64::from(*low)..=f64::from(*high)).contains(&level), "{what}: {level}");
                            }
                        }
                        if first[0] >= size || first[1] >= size {
                            // Of no texels of its own.
                            assert!(low > high || neighbours, "{size} {first:?}");
                        } else if !slopes {
                            // The twin: least and greatest depth, no more and no less.
                            assert_eq!(
                                [*slope_x, *slope_y, *low, *high],
                                [0.0, 0.0, least, most],
                                "{size} {kind} {first:?}"
                            );
                        } else if kind == 0 && first.iter().all(|first| first + (1 << level) <= size) {
                            // A plane is as thin as its roundings: 2^-19 a level of at most twice the depths' size, and their own.
                            assert!(
                                f64::from(high - low) <= 2.0 * f64::from(level) * 2f64.powi(-17),
                                "{size} {low} {high}"
                            );
                        }
                    }
                }
            }
        }
    }
}

// ------------------------------------------------------------------------------------------------------------------------- PCF

/// Ways through the pyramid: all must give the same answer.
const WAYS: [&str; 4] = ["slopes=false from_top=true", "slopes=false", "from_top=true", ""];

#[test]
fn every_kernel_answers_as_brute_force_does_bit_for_bit() {
    for kernel in 1..=63 {
        // Scenes and ways in turn; maps of odd and even sizes, smaller than the kernel too.
        let scene = ["demo", "contact", "tilt"][kernel % 3];
        let settings = format!("kernel={kernel} map_size={}", [512, 77, 33][kernel / 3 % 3]);
        let brute = view(scene, technique("pcf", &settings).as_ref(), 24);
        let way = WAYS[kernel % 4];
        let mine = view(scene, technique("min-max-pcf", &format!("{settings} {way}")).as_ref(), 24);
        assert_same_bits(&format!("{scene} {settings} {way}"), &mine, &brute);
    }
}

#[test]
fn every_light_and_every_face_of_a_cube_answers_as_brute_force_does() {
    // Receivers all around the lights: cubes, whose kernels run over the edges of faces.
    let room = cube([0.0; 3], 4.0);
    let cell = cube([2.0, -1.5, 1.0], 0.5);
    let lights: Vec<_> = lights_of_every_shape()
        .into_iter()
        .map(|mut light| {
            light.scene_from_light.translation = DVec3::new(0.1, 0.2, 0.3);
            light
        })
        .collect();
    let scene = scene(vec![mesh(&room), mesh(&cell)], lights);
    let mut random = Random(32);
    let points: Vec<DVec3> = (0..300).map(|_| random.in_cube(3.9)).collect();
    for settings in ["kernel=9 map_size=64", "kernel=30 map_size=65", "kernel=255 map_size=33", "kernel=64 map_size=1"]
    {
        let brute = draw(&scene, &points, technique("pcf", settings).as_ref());
        assert!(brute.iter().any(|image| image.shadow_maps > 1), "no cube");
        for way in WAYS {
            let mine = draw(&scene, &points, technique("min-max-pcf", &format!("{settings} {way}")).as_ref());
            for ((mine, brute), light) in mine.iter().zip(&brute).zip(&scene.lights) {
                assert_same_bits(&format!("{settings} {way} {:?}", light.shape), mine, brute);
            }
        }
    }
}

#[test]
fn grazing_planes_answer_as_brute_force_does() {
    // Normals from face on to edge on and past it, where the plane leaves the map or passes the light.
    let scene = scene(
        vec![mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5])), mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]))],
        lights_of_every_shape(),
    );
    for degrees in [0.0f64, 30.0, 60.0, 80.0, 89.0, 89.9, 89.999, 90.0, 91.0] {
        let normal = DVec3::new(degrees.to_radians().sin(), degrees.to_radians().cos(), 0.1).normalize();
        let at = |name: &str| {
            let receivers = receivers(&scene, &line(-2.0, 2.0, 100), normal);
            draw_receivers(&scene, receivers, technique(name, "kernel=31 map_size=128").as_ref())
        };
        for (mine, brute) in at("min-max-pcf").iter().zip(&at("pcf")) {
            assert_same_bits(&format!("{degrees}°"), mine, brute);
        }
    }
}

#[test]
fn a_fifth_of_the_fetches_suffices_at_31_texels() {
    for scene in ["demo", "contact", "edge", "two-edges", "tilt"] {
        let texels =
            |name: &str, own: &str| view(scene, technique(name, &format!("kernel=31 {own}")).as_ref(), 48).texels;
        let (brute, mine) = (texels("pcf", ""), texels("min-max-pcf", ""));
        assert!(5 * mine <= brute, "{scene}: {mine} of {brute}");
        // What the planes are worth: two depths never take less.
        let paper = texels("min-max-pcf", "slopes=false");
        assert!(mine <= paper, "{scene}: {mine} with slopes, {paper} without");
    }
}

#[test]
fn a_kernel_beyond_its_range_is_refused() {
    let refusal = |name: &str, settings: &str| {
        let parameters = parse_settings(settings).expect("settings");
        let built = (Entry::find(name).expect("there is").build)(&CONTEXT, &parameters);
        built.err().map_or_else(|| "none".to_owned(), |error| error.to_string())
    };
    for (name, settings, range) in [
        ("min-max-pcf", "kernel=0", "1 to 255"),
        ("min-max-pcf", "kernel=256", "1 to 255"),
        ("min-max-pcf", "map_size=0", "1 to 16384"),
        ("min-max-backprojection", "near=0", "0.001 to 1"),
        ("min-max-backprojection", "shrink=9", "0 to 8"),
        ("min-max-backprojection", "window=257", "1 to 256"),
        ("min-max-backprojection", "tolerance=1.5", "0 to 1"),
    ] {
        assert!(refusal(name, settings).contains(range), "{name} {settings}: {}", refusal(name, settings));
    }
}

// -------------------------------------------------------------------------------------------------------------- back-projection

fn backprojection(settings: &str) -> Box<dyn Technique> {
    technique("min-max-backprojection", settings)
}

/// A half-plane at height 2 that covers x < 0, below a light at 5 m.
fn half_plane(shape: Shape) -> Scene {
    let floor = mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]));
    scene(vec![mesh(&quad([-90.0, 0.0], 2.0, [-90.0, 90.0])), floor], vec![light_down(shape, [0.0, 5.0, 0.0])])
}

#[test]
fn one_occluder_hides_what_the_closed_form_says() {
    // C3, C4: the edge's image at x + (0 − x) · 5/2. The map's texels put the edge half a texel off at most: of one of w on the floor,
    // at the occluder's height 3/10 w, on the light 5/2 of that: 3/4 w of its width, for a disk 4/π of that at its middle. Areas are
    // rounded far below.
    let half = 0.5;
    let points = line(-2.0, 2.0, 301);
    let at = |x: f64| occluder_image(x, 0.0, 2.0, 5.0);
    for (shape, slope, truth) in [
        (
            Shape::Rect { size: DVec2::splat(2.0 * half) },
            1.0,
            (|t: f64| rect_edge_fraction(t, DVec2::new(1.0, 0.0))) as fn(f64) -> f64,
        ),
        // Any aspect.
        (Shape::Rect { size: DVec2::new(2.0 * half, 6.0) }, 1.0, |t: f64| rect_edge_fraction(t, DVec2::new(1.0, 0.0))),
        (Shape::Disk { size: DVec2::splat(2.0 * half) }, 4.0 / std::f64::consts::PI, disk_edge_fraction),
    ] {
        let scene = half_plane(shape);
        for size in [128, 513] {
            for own in ["", "tolerance=0", "fill_gaps=true", "shrink=0", "slopes=false"] {
                let settings = format!("map_size={size} {own}");
                let found = drawn(&scene, &points, backprojection(&settings).as_ref());
                // The map holds a box around the 4 m of receivers up to the occluder, 3 of 5 m from the light.
                let texel = 4.0 * 5.0 / 3.0 / f64::from(size - 2);
                let bound = slope * 0.75 * texel / (2.0 * half) + 1e-4;
                for (point, v) in points.iter().zip(&found) {
                    let expected = truth(-at(point.x) / half);
                    assert!(
                        (f64::from(*v) - expected).abs() <= bound,
                        "{shape:?} {settings}: {v} for {expected} ± {bound} at {}",
                        point.x
                    );
                }
            }
        }
    }
}

#[test]
fn a_light_of_no_size_casts_the_hard_shadow_and_a_huge_one_a_number() {
    let points = line(-2.0, 2.0, 200);
    let caster = mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5]));
    let of = |half: f64| {
        let scene = scene(vec![caster.clone()], vec![square_light(half, 5.0)]);
        drawn(&scene, &points, backprojection("map_size=128").as_ref())
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
fn a_lit_plane_has_no_acne_and_a_closed_box_no_light() {
    let floor = quad([-4.0, 4.0], 0.0, [-4.0, 4.0]);
    let sunlit = scene(vec![mesh(&floor)], lights_of_every_shape());
    let closed = scene(vec![mesh(&cube([0.0; 3], 1.0))], lights_of_every_shape());
    let points = line(-0.5, 0.5, 60);
    for settings in ["map_size=64", "map_size=256 slopes=false shrink=0 tolerance=0", "map_size=256"] {
        let technique = backprojection(settings);
        for (light, image) in sunlit.lights.iter().zip(draw(&sunlit, &line(-2.0, 2.0, 200), technique.as_ref())) {
            assert!(image.visibility.iter().all(|&v| v == 1.0), "{settings} {:?}", light.shape);
        }
        for (light, image) in closed.lights.iter().zip(draw(&closed, &points, technique.as_ref())) {
            let worst = image.visibility.iter().copied().fold(0.0, f32::max);
            assert!(worst == 0.0, "{settings} {:?}: {worst}", light.shape);
        }
    }
}

#[test]
fn what_is_above_a_lamp_in_a_room_is_not_searched() {
    // A lamp below the ceiling that lights walls has maps that look to all sides: half of each holds what is behind the light's plane,
    // which is nearer than the receivers and hides nothing.
    let room = mesh(&cube([0.0, 2.0, 0.0], 2.0));
    let board = mesh(&wall(-1.2, [2.2, 3.0], [-0.5, 0.4]));
    let light = light_down(Shape::Rect { size: DVec2::new(0.8, 0.6) }, [0.0, 3.9, 0.0]);
    let scene = scene(vec![room, board], vec![light]);
    let on_walls = || {
        let on = |x: f64| (0..120).map(move |i| DVec3::new(x, 0.2 + 0.03 * f64::from(i), 0.1)).collect::<Vec<_>>();
        let [mut left, right] =
            [(-2.0, DVec3::X), (2.0, -DVec3::X)].map(|(x, normal)| receivers(&scene, &on(x), normal));
        left.pixels.extend(right.pixels);
        Receivers { size: [240, 1], pixels: left.pixels }
    };
    let truth = &exact(&scene, &on_walls())[0];
    for map_size in [256, 512] {
        let technique = backprojection(&format!("map_size={map_size}"));
        let image = draw_receivers(&scene, on_walls(), technique.as_ref()).swap_remove(0);
        assert!(image.shadow_maps > 1, "one map");
        // The board's outline and the horizon of the lamp: some texels a side, not the square of that.
        let texels_each = image.texels / 240;
        assert!(texels_each < 8 * map_size, "{map_size}: {texels_each} texels a receiver");
        // What looks down has stairs of patches for the board, which overlap as the wall sees them: 0.022 and 0.027.
        let squares = image.visibility.iter().zip(truth).map(|(v, truth)| (f64::from(*v) - truth.visibility).powi(2));
        let rmse = (squares.sum::<f64>() / 240.0).sqrt();
        assert!(rmse < 0.03, "{map_size}: {rmse}");
    }
}

#[test]
fn scaling_by_powers_of_two_changes_no_bit() {
    let points = line(-2.0, 2.0, 100);
    let at = |scale: f64| {
        let s = scale as f32;
        let caster = quad([-0.5 * s, 0.5 * s], 2.0 * s, [-0.5 * s, 0.5 * s]);
        let scene = scene(vec![mesh(&caster)], vec![square_light(0.5 * scale, 5.0 * scale)]);
        let scaled: Vec<DVec3> = points.iter().map(|&p| p * scale).collect();
        ["min-max-pcf", "min-max-backprojection"]
            .map(|name| drawn(&scene, &scaled, technique(name, "map_size=128").as_ref()))
    };
    let one = at(1.0);
    for exponent in [-20, 20] {
        assert_eq!(at(2f64.powi(exponent)), one, "2^{exponent}");
    }
}

#[test]
fn what_an_upper_occluder_covers_of_a_lower_is_lost() {
    // Edges at 0 (1 m up) and at 0.2 m (3 m up) below a light 2 m wide at 5 m. From the light's centre they show at the tangents 0/4
    // and 0.2/2: the upper covers the lower, whose share of what is hidden is lost. So the answer is that of the upper alone, and the
    // error is what the lower hides beyond it, known in closed form.
    let scene = scene(
        vec![mesh(&quad([-90.0, 0.0], 1.0, [-90.0, 90.0])), mesh(&quad([-90.0, 0.2], 3.0, [-90.0, 90.0]))],
        vec![square_light(1.0, 5.0)],
    );
    let points = line(-2.0, 2.0, 201);
    let found = drawn(&scene, &points, backprojection("map_size=512").as_ref());
    let union = |x: f64| {
        let edge = occluder_image(x, 0.0, 1.0, 5.0).max(occluder_image(x, 0.2, 3.0, 5.0));
        rect_edge_fraction(-edge, DVec2::new(1.0, 0.0))
    };
    let errors: Vec<f64> = points.iter().zip(&found).map(|(p, v)| f64::from(*v) - union(p.x)).collect();
    let worst = errors.iter().fold(0.0, |worst: f64, e| worst.max(e.abs()));
    assert!(worst > 0.01, "the stated error is gone: {worst}");
    for ((point, v), error) in points.iter().zip(&found).zip(&errors) {
        // The map shows the upper alone.
        let upper = rect_edge_fraction(-occluder_image(point.x, 0.2, 3.0, 5.0), DVec2::new(1.0, 0.0));
        // A texel of (4 + 2)/510 m on the floor is 2/5 of that at the upper edge and 5/3 of this on the light: 2/3 of it, of a light
        // 2 m wide a third.
        assert!(
            (f64::from(*v) - upper).abs() <= 6.0 / 510.0 / 3.0,
            "{v} for {upper} at {}, off the truth by {error}",
            point.x
        );
    }
}

#[test]
fn a_caster_across_the_light_hides_what_is_before_it() {
    // A wall through the light's plane: what is behind hides nothing, and nothing is not a number.
    let wall = wall(0.3, [1.0, 9.0], [-1.0, 1.0]);
    let scene = scene(vec![mesh(&wall), mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]))], lights_of_every_shape());
    let points = line(-2.0, 2.0, 100);
    for image in draw(&scene, &points, backprojection("map_size=128").as_ref()) {
        assert!(image.visibility.iter().all(|v| (0.0..=1.0).contains(v)));
    }
    // Beside a light 3 m wide it hides what is beyond 0.3 m, two fifths. Seen edge on, its texels lie at many depths and overlap in the
    // light's plane: up to another fifth of the light is counted twice, the paper's fault.
    let wide = common::scene(
        vec![mesh(&wall), mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0]))],
        vec![light_down(Shape::Rect { size: DVec2::new(3.0, 0.5) }, [0.0, 4.0, 0.0])],
    );
    let found = drawn(&wide, &points, backprojection("map_size=512").as_ref());
    let away: Vec<f32> = points.iter().zip(&found).filter(|(p, _)| p.x < -1.9).map(|(_, v)| *v).collect();
    assert!(away.iter().all(|v| (0.4..=0.6).contains(v)), "{away:?}");
}

#[test]
fn every_end_of_every_parameter_gives_an_answer() {
    let scene = scene(vec![mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5]))], lights_of_every_shape());
    let points = line(-2.0, 2.0, 40);
    for settings in [
        "map_size=1",
        "map_size=2",
        "map_size=3",
        "near=0.001",
        "near=1",
        "shrink=0",
        "shrink=8",
        "window=1",
        "window=256",
        "tolerance=0",
        "tolerance=1",
        "fill_gaps=true slopes=false",
    ] {
        let map = if settings.contains("map_size") { "" } else { "map_size=64" };
        for image in draw(&scene, &points, backprojection(&format!("{map} {settings}")).as_ref()) {
            assert_eq!(image.visibility.len(), points.len(), "{settings}");
        }
    }
}

/// RMSE of V over the penumbra.
fn penumbra_rmse(scene: &str, technique: &dyn Technique) -> f64 {
    let (found, truth) = (view(scene, technique, 48), view(scene, &Exact, 48));
    let errors: Vec<f64> = found
        .visibility
        .iter()
        .zip(&truth.visibility)
        .filter(|(_, truth)| (0.0..1.0).contains(*truth) && **truth > 0.0)
        .map(|(v, truth)| f64::from(v - truth))
        .collect();
    (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
}

#[test]
fn it_is_nearer_to_the_truth_than_dense_pcss_where_depths_differ() {
    for scene in ["two-edges", "demo"] {
        let (mine, pcss) = (
            penumbra_rmse(scene, backprojection("").as_ref()),
            penumbra_rmse(scene, technique("pcss", "dense=true").as_ref()),
        );
        assert!(mine < pcss, "{scene}: {mine} against {pcss}");
    }
}
