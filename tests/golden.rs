//! Every technique's image of the demo against a stored one: what no fact says is held too.
//!
//! `PENUMBRA_BLESS=1` writes the stored images anew, on the adapter that they are strict on.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use penumbra::image::{Image, grey_png, read_exr, write_exr, write_png};
use penumbra::progress::Progress;
use penumbra::render::{Request, render};
use penumbra::scene::Scene;
use penumbra::scene::procedural::build;
use penumbra::techniques::{ALL, Context, Entry, Needs, parse_settings};

const SIZE: [u32; 2] = [96, 72];

/// The driver whose every bit is stored.
const STRICT_DRIVER: &str = "Mesa 22.3.6";

static CONTEXT: LazyLock<Context> = LazyLock::new(Context::default);

/// The demo, lit by its key light alone.
static DEMO: LazyLock<Scene> = LazyLock::new(|| {
    let mut scene = build("demo").expect("builds").scene;
    scene.lights.retain(|light| light.name == "Key");
    assert_eq!(scene.lights.len(), 1);
    scene
});

/// Settings of a technique's image: those that its defaults might change, and few samples.
fn settings(entry: &Entry) -> String {
    match entry.name {
        "rays" => "samples=16 pattern=sobol".into(),
        "hard" => "map_size=512".into(),
        "pcf" => "map_size=512 kernel=9".into(),
        "pcss" => "map_size=512 search_taps=16 filter_taps=16 near=0.5 pattern=sobol".into(),
        "adaptive" => "map_size=512 points=centers min_depth=1 max_depth=2 max_maps=81 epsilon=0.05 filter=true".into(),
        "temporal" => "map_size=512 frames=8 start_taps=16 start_weight=32".into(),
        "uniform" => "map_size=512 samples=16 placement=grid".into(),
        // A technique that is new here has its own defaults, until it is given settings.
        _ => String::new(),
    }
}

/// How much an image may differ from the stored one: the share of pixels that may differ at all, and the mean difference of V.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Threshold {
    differing: f64,
    mean: f64,
}

/// The one place that says how strict a comparison is.
///
/// Where the stored images were made, and for what runs on the processor in `f64`: not a bit may differ. Elsewhere a rasteriser
/// may snap vertices to its own grid of 1/256 of a pixel or finer, on either side of where this one does, so that an edge lies up to
/// 1/128 of a texel elsewhere. An edge that crosses a texel flips it by that chance: a receiver has one texel a sample and, at
/// worst, an edge in each, so V is 1/128 off in the mean. How many pixels differ says nothing there.
fn threshold(is_strict: bool) -> Threshold {
    if is_strict { Threshold { differing: 0.0, mean: 0.0 } } else { Threshold { differing: 1.0, mean: 1.0 / 128.0 } }
}

/// Whether what a technique runs on is what the stored images were made on.
fn is_strict(entry: &Entry) -> bool {
    match entry.needs {
        Needs::Cpu => true,
        Needs::Gpu => {
            let gpu = CONTEXT.gpu().expect("a GPU, or a software one");
            let info = gpu.device.adapter_info();
            info.name.contains("llvmpipe") && info.driver_info.contains(STRICT_DRIVER)
        }
    }
}

/// V of the demo's light by a technique.
fn drawn(entry: &Entry) -> Vec<f32> {
    let settings = parse_settings(&settings(entry)).expect("settings");
    let technique = (entry.build)(&CONTEXT, &settings).expect("builds");
    let request = Request { size: SIZE, irradiance: false, shaded: None, antialiasing: 1, verify: None };
    let mut found =
        render(&DEMO, &DEMO.cameras[0], technique.as_ref(), &request, &Progress::default()).expect("renders");
    found.lights.swap_remove(0).visibility
}

fn image_of(visibility: Vec<f32>) -> Image {
    let mut image = Image::new(SIZE);
    image.add("Key.visibility", visibility);
    image
}

fn stored_path(entry: &Entry) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden").join(format!("{}.exr", entry.name))
}

/// What is wrong with V where `stored` is expected, if anything is: then what was drawn and how it differs is written, and named.
fn judge(name: &str, visibility: &[f32], stored: &[f32], allowed: Threshold) -> Option<String> {
    assert_eq!(visibility.len(), stored.len(), "{name}");
    let difference: Vec<f32> = visibility.iter().zip(stored).map(|(a, b)| (a - b).abs()).collect();
    let pixels = stored.len() as f64;
    let changed = visibility.iter().zip(stored).filter(|(a, b)| a.to_bits() != b.to_bits()).count();
    let (differing, mean) =
        (changed as f64 / pixels, difference.iter().map(|&difference| f64::from(difference)).sum::<f64>() / pixels);
    if differing <= allowed.differing && mean <= allowed.mean {
        return None;
    }
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().expect("the target folder").join("golden");
    std::fs::create_dir_all(&folder).expect("a folder");
    let (exr, png) = (folder.join(format!("{name}.exr")), folder.join(format!("{name}.difference.png")));
    write_exr(&exr, &image_of(visibility.to_vec())).expect("writes");
    write_png(&png, grey_png(SIZE, &difference)).expect("writes");
    let largest = difference.iter().copied().fold(0.0, f32::max);
    Some(format!(
        "{name}: {changed} pixels differ, V by {mean} in the mean and {largest} at most: see {} and {}",
        exr.display(),
        png.display()
    ))
}

#[test]
#[expect(clippy::print_stderr, reason = "who runs the tests is told what is not held strictly")]
fn every_technique_draws_the_demo_as_it_is_stored() {
    let is_blessing = std::env::var_os("PENUMBRA_BLESS").is_some_and(|value| value == "1");
    let folder = stored_path(&ALL[0]).parent().expect("a folder").to_path_buf();
    let mut failures = Vec::new();
    for entry in ALL {
        let (actual, path, is_strict) = (drawn(entry), stored_path(entry), is_strict(entry));
        if is_blessing {
            assert!(is_strict, "{}: stored images are made on llvmpipe of {STRICT_DRIVER} alone", entry.name);
            std::fs::create_dir_all(&folder).expect("a folder");
            write_exr(&path, &image_of(actual)).expect("writes");
            continue;
        }
        if !is_strict {
            eprintln!("{}: not on llvmpipe of {STRICT_DRIVER}: held loosely", entry.name);
        }
        let stored = read_exr(&path).expect("a stored image: PENUMBRA_BLESS=1 makes it");
        let stored = stored.visibility("Key").expect("it holds the light");
        failures.extend(judge(entry.name, &actual, stored, threshold(is_strict)));
    }
    assert!(failures.is_empty(), "{}\nPENUMBRA_BLESS=1 stores them as they are", failures.join("\n"));
    for file in std::fs::read_dir(folder).expect("a folder") {
        let path = file.expect("an entry").path();
        let stem = path.file_stem().and_then(|stem| stem.to_str()).expect("UTF-8");
        assert!(ALL.iter().any(|entry| entry.name == stem), "{} is of no technique", path.display());
    }
}

#[test]
fn a_single_bit_is_told_with_the_images_that_show_it() {
    let stored = vec![0.5f32; (SIZE[0] * SIZE[1]) as usize];
    let mut changed = stored.clone();
    changed[1234] = 0.5f32.next_up();
    assert_eq!(judge("one-bit", &stored, &stored, threshold(true)), None);
    assert_eq!(judge("one-bit", &changed, &stored, threshold(false)), None);
    let told = judge("one-bit", &changed, &stored, threshold(true)).expect("it differs");
    assert!(told.starts_with("one-bit: 1 pixels differ"), "{told}");
    for name in ["one-bit.exr", "one-bit.difference.png"] {
        let at = told.find(name).expect("it is named") + name.len();
        let from = told[..at].rfind(if name.ends_with("exr") { "see " } else { "and " }).expect("it is named") + 4;
        assert!(Path::new(&told[from..at]).is_file(), "{told}");
    }
}
