//! What the techniques with shadow maps see of small scenes, all on one adapter.

use std::sync::LazyLock;

use glam::DVec3;
use penumbra::Result;
use penumbra::progress::Progress;
use penumbra::receivers::Receivers;
use penumbra::render::render_receivers;
use penumbra::scene::Scene;
use penumbra::techniques::{Context, Entry, LightImage, Technique, parse_settings};

use crate::common::receivers;

/// One adapter for all tests.
pub static CONTEXT: LazyLock<Context> = LazyLock::new(Context::default);

/// The techniques that hold texels of shadow maps against receivers, each blocked or not; `min_max.rs` has what adds up areas.
pub const MAPPED: [&str; 9] =
    ["hard", "pcf", "min-max-pcf", "pcss", "uniform", "adaptive", "temporal", "cascaded", "bilateral"];

/// All that draw what may block.
pub const DRAWN: [&str; 13] = [
    "hard",
    "pcf",
    "min-max-pcf",
    "pcss",
    "uniform",
    "adaptive",
    "temporal",
    "cascaded",
    "bilateral",
    "min-max-backprojection",
    "bitmask",
    "soft-shadow-map",
    "shadow-volumes",
];

/// Texels on either side of its own that `pcf` and `min-max-pcf` read as [`mapped`] makes it.
pub const PCF_RADIUS: u32 = 1;

/// A technique with settings.
pub fn technique(name: &str, settings: &str) -> Box<dyn Technique> {
    let parameters = parse_settings(settings).expect("settings");
    (Entry::find(name).expect("there is").build)(&CONTEXT, &parameters).expect("builds")
}

/// One of [`DRAWN`] with small kernels and few samples.
pub fn mapped(name: &str, map_size: u32) -> Box<dyn Technique> {
    let own = match name {
        "pcf" | "min-max-pcf" => "kernel=3",
        "pcss" => "dense=true",
        "uniform" => "samples=16",
        "adaptive" => "max_depth=2",
        "temporal" => "frames=16 start_weight=0 threshold=1",
        "shadow-volumes" => return technique(name, ""),
        _ => "",
    };
    technique(name, &format!("{own} map_size={map_size}"))
}

/// What a technique finds at receivers, a light each; every value is one that may be written.
pub fn draw_receivers(scene: &Scene, receivers: Receivers, technique: &dyn Technique) -> Vec<LightImage> {
    try_draw_receivers(scene, receivers, technique).expect("renders")
}

fn try_draw_receivers(scene: &Scene, receivers: Receivers, technique: &dyn Technique) -> Result<Vec<LightImage>> {
    let lights = render_receivers(scene, receivers, technique, true, &Progress::default())?.lights;
    for image in &lights {
        assert!(image.visibility.iter().all(|v| (0.0..=1.0).contains(v)), "{:?}", image.visibility);
        assert!(image.irradiance_ratio.iter().all(|v| (0.0..=1.0).contains(v)), "{:?}", image.irradiance_ratio);
        assert!(image.irradiance.iter().flatten().all(|e| e.is_finite() && *e >= 0.0), "{:?}", image.irradiance);
    }
    Ok(lights)
}

/// [`draw`], of what may be refused.
pub fn try_draw(scene: &Scene, positions_world: &[DVec3], technique: &dyn Technique) -> Result<Vec<LightImage>> {
    try_draw_receivers(scene, receivers(scene, positions_world, DVec3::Y), technique)
}

/// What a technique finds at world positions with normal +Y, a light each.
pub fn draw(scene: &Scene, positions_world: &[DVec3], technique: &dyn Technique) -> Vec<LightImage> {
    draw_receivers(scene, receivers(scene, positions_world, DVec3::Y), technique)
}

/// V of the first light at world positions with normal +Y.
pub fn drawn(scene: &Scene, positions_world: &[DVec3], technique: &dyn Technique) -> Vec<f32> {
    draw(scene, positions_world, technique).swap_remove(0).visibility
}
