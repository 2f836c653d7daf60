//! `--frames` through the binary: which files it writes, what moves in them and what does not.

#[expect(dead_code, clippy::needless_pass_by_value, reason = "each test binary uses some of it, with `json!` literals")]
mod gltf_files;

use std::path::Path;
use std::process::{Command, Output, Stdio};

use assert_cmd::cargo::CommandCargoExt;
use gltf_files::File;
use penumbra::image::read_exr;
use serde_json::{Value, json};

fn penumbra(arguments: &[&str], directory: &Path) -> Output {
    command(arguments, directory).output().expect("runs")
}

fn command(arguments: &[&str], directory: &Path) -> Command {
    let mut command = Command::cargo_bin("penumbra").expect("the binary");
    command.args(arguments).current_dir(directory);
    command
}

/// Runs `render` on what must succeed, small and quick; returns stdout.
fn render(scene: &str, output: &str, more: &[&str], directory: &Path) -> String {
    let common = ["render", scene, "--size", "40x30", "--set", "samples=4", "-o", output];
    let run = penumbra(&[common.as_slice(), more].concat(), directory);
    assert!(run.status.success(), "{more:?}: {}", String::from_utf8_lossy(&run.stderr));
    String::from_utf8(run.stdout).expect("UTF-8")
}

fn names_in(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).expect("a directory");
    let mut names: Vec<_> =
        entries.map(|entry| entry.expect("an entry").file_name().into_string().expect("UTF-8")).collect();
    names.sort();
    names
}

/// A square that rises from 0 to 4 in a second (`rise`) or goes to 4 in X (`slide`), lying flat.
fn rising() -> File {
    let mut file = File::square();
    file.json["nodes"][0]["rotation"] = json!([-0.5f32.sqrt(), 0.0, 0.0, 0.5f32.sqrt()]);
    let times = file.floats(&[[0.0], [1.0]]);
    let rise = file.floats(&[[0.0; 3], [0.0, 4.0, 0.0]]);
    let slide = file.floats(&[[0.0; 3], [4.0, 0.0, 0.0]]);
    let clip = |name: &str, output: usize| {
        json!({"name": name, "samplers": [{"input": times, "output": output}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]})
    };
    file.json["animations"] = json!([clip("rise", rise), clip("slide", slide)]);
    file
}

/// A directory with the rising square as `scene.glb`.
fn with_rising() -> tempfile::TempDir {
    let directory = tempfile::tempdir().expect("a directory");
    std::fs::write(directory.path().join("scene.glb"), rising().glb()).expect("writes");
    directory
}

#[test]
fn each_frame_is_a_file_and_a_record() {
    let directory = with_rising();
    let at = directory.path();
    let more = ["--frames", "0-24:12", "--add-light", "auto", "--add-floor", "--json", "--aov", "position"];
    let records = render("scene.glb", "out.##.exr", &more, at);
    assert_eq!(names_in(at), ["out.00.exr", "out.12.exr", "out.24.exr", "scene.glb"]);
    let records: Vec<Value> = records.lines().map(|line| serde_json::from_str(line).expect("JSON")).collect();
    let summary: Vec<_> = records.iter().map(|r| json!([r["frame"], r["seconds"], r["output"]])).collect();
    let expected = [json!([0, 0.0, "out.00.exr"]), json!([12, 0.5, "out.12.exr"]), json!([24, 1.0, "out.24.exr"])];
    assert_eq!(summary, expected);
    assert!(records.iter().all(|record| record["lights"][0]["name"] == "Key" && record["technique"] == "rays"));

    // The square rises; the floor under the lowest of it and the camera stay.
    let images = [0, 12, 24].map(|frame| read_exr(&at.join(format!("out.{frame:02}.exr"))).expect("an image"));
    let highest = images.each_ref().map(|image| {
        let [_, y, _] = image.xyz("position").expect("positions");
        y.iter().copied().fold(f32::NEG_INFINITY, f32::max)
    });
    // Frame 0 may see the floor through the square, at the same height. The node's rotation is off by a rounding.
    for (found, expected) in highest.iter().zip([0.0, 2.0, 4.0]) {
        assert!((found - expected).abs() < 1e-6, "{highest:?}");
    }
    let corner = images.each_ref().map(|image| {
        let last = image.pixel_count() - 1;
        image.xyz("position").expect("positions").map(|axis| axis[last])
    });
    // To a rounding of f32: the frames' scenes have origins of their own.
    for axis in 0..3 {
        let off = corner.iter().map(|p| (p[axis] - corner[0][axis]).abs()).fold(0.0, f32::max);
        assert!(off <= 4.0 * f32::EPSILON, "{corner:?}");
    }
    assert!(corner[0][1].abs() < 1e-6, "{corner:?}");
    assert!(images[0].visibility("Key") != images[2].visibility("Key"));
}

#[test]
fn a_frame_alone_is_the_frame_of_the_sequence() {
    let directory = with_rising();
    let at = directory.path();
    let added = ["--add-light", "auto", "--add-floor"];
    render("scene.glb", "all.#.exr", &[added.as_slice(), &["--frames", "3-9:3"]].concat(), at);
    render("scene.glb", "alone.exr", &[added.as_slice(), &["--frames", "6"]].concat(), at);
    let read = |name: &str| std::fs::read(at.join(name)).expect("a file");
    assert!(read("all.6.exr") == read("alone.exr"));
    assert!(read("all.6.exr") != read("all.9.exr"));
}

#[test]
fn a_reference_has_the_same_frames() {
    let directory = with_rising();
    let at = directory.path();
    let more = ["--frames", "6-12:6", "--add-light", "auto", "--add-floor", "--aov", "position"];
    render("scene.glb", "test.#.exr", &more, at);
    let common = ["reference", "scene.glb", "--size", "40x30", "-o", "truth.#.exr"];
    let run = penumbra(&[common.as_slice(), &more].concat(), at);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    for frame in [6, 12] {
        let [test, truth] =
            ["test", "truth"].map(|name| read_exr(&at.join(format!("{name}.{frame}.exr"))).expect("an image"));
        assert_eq!(test.xyz("position"), truth.xyz("position"));
        assert!(test.visibility("Key") != truth.visibility("Key"), "4 samples are not exact");
    }
}

#[test]
fn the_animation_and_its_speed_are_chosen() {
    let directory = with_rising();
    let at = directory.path();
    let more = ["--add-light", "point:at=0/9/0", "--aov", "position", "--frames", "30"];
    let highest = |name: &str, axis: usize, more: &[&str]| {
        render("scene.glb", name, more, at);
        let image = read_exr(&at.join(name)).expect("an image");
        let covered = image.channel("coverage.A").expect("coverage").to_vec();
        let values = image.xyz("position").expect("positions")[axis].iter().zip(covered);
        values.filter(|(_, covered)| *covered == 1.0).map(|(x, _)| *x).fold(f32::NEG_INFINITY, f32::max)
    };
    // Frame 30 at 60 a second: half-way.
    let rise = highest("rise.exr", 1, &[more.as_slice(), &["--fps", "60"]].concat());
    assert!((rise - 2.0).abs() < 1e-6, "{rise}");
    let slide = highest("slide.exr", 0, &[more.as_slice(), &["--animation", "slide"]].concat());
    // Beyond its end, it stays there: up to its own edge at 5, in which some pixel's centre is seen.
    assert!((4.5..=5.000_001).contains(&slide), "{slide}");
}

#[test]
fn what_stands_still_gives_the_same_bits_in_every_frame() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    render("procedural:square", "out.#.exr", &["--frames", "0-2"], at);
    let read = |name: &str| std::fs::read(at.join(name)).expect("a file");
    assert!(read("out.0.exr") == read("out.1.exr") && read("out.0.exr") == read("out.2.exr"));
    // And those that it gives without frames.
    render("procedural:square", "still.exr", &[], at);
    assert!(read("out.0.exr") == read("still.exr"));
}

#[test]
fn pictures_of_several_lights_have_number_and_name() {
    let directory = with_rising();
    let lights = ["--add-light", "point:at=0/9/0,name=A", "--add-light", "point:at=0/8/0,name=B"];
    render("scene.glb", "out.###.png", &[lights.as_slice(), &["--frames", "7-8"]].concat(), directory.path());
    assert_eq!(
        names_in(directory.path()),
        ["out.007.A.png", "out.007.B.png", "out.008.A.png", "out.008.B.png", "scene.glb"]
    );
}

#[test]
fn verification_is_told_for_each_frame() {
    let directory = with_rising();
    let more = ["--frames", "6-12:6", "--add-light", "auto", "--add-floor", "--verify", "16"];
    let text = render("scene.glb", "out.#.exr", &more, directory.path());
    let starts: Vec<_> = text.lines().map(|line| line.split(": ").next().unwrap_or_default()).collect();
    assert_eq!(starts, ["frame 6, Key", "frame 12, Key"]);
}

#[test]
fn what_cannot_be_rendered_is_refused_before_any_work() {
    let directory = with_rising();
    let fail = |output: &str, more: &[&str], status: i32, reason: &str| {
        let common = ["render", "scene.glb", "--add-light", "auto", "-o", output];
        let run = penumbra(&[common.as_slice(), more].concat(), directory.path());
        let errors = String::from_utf8_lossy(&run.stderr);
        assert_eq!(run.status.code(), Some(status), "{more:?}: {errors}");
        assert!(errors.contains(reason), "{more:?}: {errors}");
        assert_eq!(names_in(directory.path()), ["scene.glb"], "{more:?} left something");
    };
    fail("out.exr", &["--frames", "0-1"], 2, "expected a pattern such as out.####.exr");
    fail("#.#.exr", &["--frames", "0-1"], 2, "one run of #");
    fail("none/#.exr", &["--frames", "0-1"], 1, "does not exist");
    fail("#.exr", &["--frames", "2-1"], 2, "A <= B");
    fail("#.exr", &["--frames", "0-9:0"], 2, "STEP of at least 1");
    fail("#.exr", &["--frames", "0-100000"], 2, "at most 100000 frames");
    fail("#.exr", &["--frames", "now"], 2, "such as 1-24");
    fail("#.exr", &["--frames", "0-1", "--fps", "0"], 2, "0.001 to");
    fail("#.exr", &["--fps", "25"], 2, "--frames");
    fail("#.exr", &["--frames", "0-1", "--animation", "jump"], 2, "\"jump\" is not there; the scene has rise, slide");
}

#[test]
fn a_scene_says_what_it_plays() {
    let directory = with_rising();
    let at = directory.path();
    let info = penumbra(&["info", "scene.glb"], at);
    let text = String::from_utf8_lossy(&info.stdout).into_owned();
    assert!(text.contains("animation  rise: 0.0000 s to 1.0000 s, 1 channel\n"), "{text}");
    let info: Value = serde_json::from_slice(&penumbra(&["info", "scene.glb", "--json"], at).stdout).expect("JSON");
    assert_eq!(
        info["animations"][1],
        json!({"name": "slide", "start_seconds": 0.0, "end_seconds": 1.0,
            "channels": [{"node": "square", "property": "translation", "keys": 2}]})
    );
    // A still image of it says that it is one.
    let run = penumbra(&["render", "scene.glb", "-o", "out.exr", "--size", "8x6", "--add-light", "auto"], at);
    assert!(String::from_utf8_lossy(&run.stderr).contains("--frames renders its animation"));
}

#[cfg(unix)]
#[test]
fn ctrl_c_leaves_whole_frames_only() {
    let directory = with_rising();
    let at = directory.path();
    let arguments = [
        "render",
        "scene.glb",
        "--frames",
        "0-9999",
        "--add-light",
        "auto",
        "--add-floor",
        "--size",
        "200x150",
        "--set",
        "samples=64",
        "-o",
        "out.#.exr",
    ];
    let mut child = command(&arguments, at).stderr(Stdio::piped()).spawn().expect("runs");
    // Until some frames are there.
    for _ in 0..600 {
        if names_in(at).iter().filter(|name| name.ends_with(".exr")).count() >= 2 {
            break;
        }
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
    assert!(child.try_wait().expect("a status").is_none(), "it is still at work");
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill").success());
    let output = child.wait_with_output().expect("ends");
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("error: cancelled"));
    let names = names_in(at);
    assert!(names.len() >= 3, "{names:?}");
    for name in names.iter().filter(|name| *name != "scene.glb") {
        assert!(name.ends_with(".exr") && read_exr(&at.join(name)).is_ok(), "{name}");
    }
}
