//! What becomes of a machine that lacks something: errors of one line, no panic.

use std::process::Command;

use glam::DVec2;
use penumbra::geometry::bvh::SceneBvh;
use penumbra::gpu::pass::Frame;
use penumbra::gpu::scene::SceneBuffers;
use penumbra::gpu::{Gpu, gbuffer};
use penumbra::progress::Progress;
use penumbra::render::{Request, render};
use penumbra::scene::procedural::build;
use penumbra::techniques::{Context, Entry, parse_settings};
use wgpu::{BufferUsages, Limits};

const OPENED: &str = "opened: ";

#[test]
#[expect(clippy::print_stdout, reason = "read by the other tests, and by who runs the tests")]
fn the_gpu_opens_or_tells_why() {
    let told = Gpu::open().map_or_else(|error| error.to_string(), |gpu| gpu.adapter.to_string());
    assert_eq!(told.lines().count(), 1, "{told}");
    println!("\n{OPENED}{told}");
}

/// What [`the_gpu_opens_or_tells_why`] tells in a process with these variables.
fn opened_with(variables: &[(&str, &str)]) -> String {
    let own = std::env::current_exe().expect("a path");
    let run = Command::new(own)
        .args(["--exact", "the_gpu_opens_or_tells_why", "--nocapture"])
        .envs(variables.iter().copied())
        .output()
        .expect("runs");
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let output = String::from_utf8_lossy(&run.stdout).into_owned();
    output.lines().find_map(|line| line.strip_prefix(OPENED)).expect("it tells").to_owned()
}

#[test]
fn an_adapter_is_chosen_by_name() {
    let gpu = Gpu::open().expect("a GPU, or a software one");
    let part: String = gpu.adapter.name.to_uppercase().chars().take(4).collect();
    assert!(opened_with(&[("WGPU_ADAPTER_NAME", &part)]).to_uppercase().contains(&part));
    assert_eq!(opened_with(&[("WGPU_ADAPTER_NAME", "")]), gpu.adapter.to_string(), "empty is not set");
    let none = opened_with(&[("WGPU_ADAPTER_NAME", "Voodoo")]);
    assert!(none.starts_with("GPU: no adapter is named WGPU_ADAPTER_NAME=Voodoo; there is "), "{none}");
    assert!(none.contains(&gpu.adapter.name), "{none}");
}

#[test]
#[cfg(target_os = "linux")]
fn a_loader_without_driver_is_told() {
    let nothing = "/nonexistent/driver.json";
    let variables = [("VK_ICD_FILENAMES", nothing), ("VK_DRIVER_FILES", nothing)];
    let expected = "GPU: a Vulkan loader but no driver; for a software GPU install mesa-vulkan-drivers (Debian, Ubuntu) or \
                    vulkan-swrast (Arch)";
    assert_eq!(opened_with(&variables), expected);
    // Asking for an adapter by name changes nothing.
    assert_eq!(opened_with(&[variables[0], variables[1], ("WGPU_ADAPTER_NAME", "Voodoo")]), expected);
}

#[test]
fn software_adapters_are_named_as_such() {
    let gpu = Gpu::open().expect("a GPU, or a software one");
    assert_eq!(gpu.adapter.to_string().ends_with(", a software GPU"), gpu.adapter.software);
    assert_eq!(penumbra::gpu::Adapter::cpu().to_string(), "CPU");
}

/// A GPU with little of everything.
fn small() -> Gpu {
    let lower = |limits: Limits| Limits {
        max_texture_dimension_2d: 256,
        max_texture_array_layers: 4,
        max_buffer_size: 1 << 20,
        max_storage_buffer_binding_size: 1 << 16,
        max_uniform_buffer_binding_size: 1 << 14,
        ..limits
    };
    Gpu::open_limited(lower).expect("a GPU, or a software one")
}

#[test]
fn what_exceeds_a_limit_is_told_with_the_limit() {
    let gpu = small();
    let told = |message: String, parts: &[&str]| {
        for part in [&["GPU: ", &gpu.adapter.name], parts].concat() {
            assert!(message.contains(part), "{message}: {part}");
        }
        assert_eq!(message.lines().count(), 1, "{message}");
    };
    for (usage, limit, allowed) in [
        (BufferUsages::VERTEX, "max_buffer_size", 1 << 20),
        (BufferUsages::STORAGE, "max_storage_buffer_binding_size", 1 << 16),
        (BufferUsages::UNIFORM, "max_uniform_buffer_binding_size", 1 << 14),
    ] {
        gpu.empty_buffer("it", allowed, usage).expect("fits");
        let asked = allowed + 4;
        let parts = [limit, &asked.to_string(), &allowed.to_string()];
        told(gpu.empty_buffer("it", asked, usage).expect_err("is too large").to_string(), &parts);
        let contents = vec![0u8; asked as usize];
        told(gpu.buffer("it", &contents, usage).expect_err("is too large").to_string(), &parts);
    }
    for (size, parts) in [
        ([257, 1, 1], ["257 pixels wide", "allows 256 (max_texture_dimension_2d)"]),
        ([1, 300, 1], ["300 pixels high", "allows 256 (max_texture_dimension_2d)"]),
        ([1, 1, 5], ["5 layers deep", "allows 4 (max_texture_array_layers)"]),
    ] {
        let usage = wgpu::TextureUsages::TEXTURE_BINDING;
        let texture = gpu.texture("it", size, wgpu::TextureFormat::R8Unorm, usage);
        told(texture.expect_err("is too large").to_string(), &parts);
    }
}

#[test]
fn scenes_and_images_that_exceed_a_limit_are_refused() {
    let gpu = small();
    let large = build("sphere?subdivisions=8").expect("builds").scene;
    let message = SceneBuffers::new(&gpu, &large).expect_err("is too large").to_string();
    assert!(message.contains("the scene's vertices would take"), "{message}");
    let scene = build("square").expect("builds").scene;
    let (buffers, bvh) = (SceneBuffers::new(&gpu, &scene).expect("fits"), SceneBvh::new(&scene));
    let draw =
        |size| gbuffer::receivers(&gpu, (&scene, &buffers, &bvh), &scene.cameras[0], (size, [0; 2]), DVec2::splat(0.5));
    draw([256, 200]).expect("fits");
    let message = draw([300, 200]).expect_err("is too large").to_string();
    assert!(message.contains("G-buffer is 300 pixels wide; this adapter allows 256"), "{message}");
}

#[test]
fn limits_beyond_the_adapter_are_told() {
    let greedy = |limits: Limits| Limits { max_bind_groups: 1000, ..limits };
    let message = Gpu::open_limited(greedy).expect_err("no adapter has so many").to_string();
    assert!(
        message.starts_with("GPU: ") && message.contains("max_bind_groups") && message.contains("1000"),
        "{message}"
    );
    assert_eq!(message.lines().count(), 1, "{message}");
}

#[test]
fn a_lost_device_is_told_once_work_is_waited_for() {
    let scene = build("square").expect("builds").scene;
    let gpu = Gpu::open().expect("a GPU, or a software one");
    let (buffers, bvh) = (SceneBuffers::new(&gpu, &scene).expect("fits"), SceneBvh::new(&scene));
    gpu.device.destroy();
    let message = Frame::new(&gpu).finish().expect_err("the device is gone").to_string();
    assert!(message.starts_with(&format!("GPU: {}: the device was lost", gpu.adapter.name)), "{message}");
    assert_eq!(message.lines().count(), 1, "{message}");
    let drawn =
        gbuffer::receivers(&gpu, (&scene, &buffers, &bvh), &scene.cameras[0], ([20, 10], [0; 2]), DVec2::splat(0.5));
    assert_eq!(drawn.expect_err("the device is gone").to_string(), message);
}

#[test]
fn receivers_are_split_where_a_binding_cannot_hold_them() {
    // A third of the receivers' 48 bytes each: three buffers and a rest.
    let procedural = build("demo").expect("builds");
    let (scene, size) = (&procedural.scene, [64, 48]);
    let limit = 48 * 64 * 48 / 3;
    let image = |context: &Context| {
        let entry = Entry::find("uniform").expect("registered");
        let settings = parse_settings("samples=4 map_size=64").expect("settings");
        let technique = (entry.build)(context, &settings).expect("builds");
        let request = Request { size, irradiance: true, shaded: None, antialiasing: 1, verify: None };
        let progress = Progress::default();
        let rendering = render(scene, &scene.cameras[0], technique.as_ref(), &request, &progress).expect("renders");
        rendering.lights.into_iter().map(|light| (light.visibility, light.irradiance, light.texels)).collect::<Vec<_>>()
    };
    let whole = image(&Context::default());
    let lower = |limits| Limits { max_storage_buffer_binding_size: limit, ..limits };
    let split = image(&Context::from(Gpu::open_limited(lower).expect("opens")));
    assert!(whole == split);
    assert!(whole.iter().all(|(_, _, texels)| *texels > 3000));
}
