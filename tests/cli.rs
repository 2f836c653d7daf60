//! The binary, end to end.

mod common;

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use assert_cmd::cargo::CommandCargoExt;
use penumbra::image::{read_exr, write_exr};
use penumbra::techniques::{ALL, Needs};
use serde_json::Value;

fn penumbra(arguments: &[&str], directory: &Path) -> Output {
    command(arguments, directory).output().expect("runs")
}

fn command(arguments: &[&str], directory: &Path) -> Command {
    let mut command = Command::cargo_bin("penumbra").expect("the binary");
    command.args(arguments).current_dir(directory);
    command
}

/// Runs what must succeed; returns stdout.
fn succeed(arguments: &[&str], directory: &Path) -> String {
    let run = penumbra(arguments, directory);
    assert!(run.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&run.stderr));
    String::from_utf8(run.stdout).expect("UTF-8")
}

/// Runs what must fail with this status and one line that holds `reason`, and leave nothing behind.
fn fail(arguments: &[&str], status: i32, reason: &str) {
    let directory = tempfile::tempdir().expect("a directory");
    let run = penumbra(arguments, directory.path());
    let errors = String::from_utf8_lossy(&run.stderr);
    assert_eq!(run.status.code(), Some(status), "{arguments:?}: {errors}");
    assert_eq!(errors.lines().filter(|line| line.starts_with("error: ")).count(), 1, "{arguments:?}: {errors}");
    assert!(errors.contains(reason), "{arguments:?}: {errors}");
    // No cause is told twice.
    let line = errors.lines().find(|line| line.starts_with("error: ")).expect("found above");
    let parts: Vec<_> = line.split(": ").collect();
    assert!(parts.windows(2).all(|pair| pair[0] != pair[1]), "{line}");
    assert_eq!(std::fs::read_dir(directory.path()).expect("a directory").count(), 0, "{arguments:?} left something");
}

const SQUARE: [&str; 4] = ["procedural:square", "--size", "40x30", "--set"];

fn render_square(directory: &Path, output: &str, more: &[&str]) -> String {
    let arguments = [&["render"], SQUARE.as_slice(), &["samples=16", "-o", output], more].concat();
    succeed(&arguments, directory)
}

#[test]
fn progress_is_told_as_lines_where_they_are_asked_for() {
    let directory = tempfile::tempdir().expect("a directory");
    let arguments =
        ["render", "procedural:square", "--size", "200x150", "--set", "samples=1024", "-o", "out.exr", "--json"];
    let run = penumbra(&[arguments.as_slice(), &["--progress"]].concat(), directory.path());
    assert!(run.status.success());
    serde_json::from_slice::<Value>(&run.stdout).expect("stdout holds the record alone");
    let errors = String::from_utf8(run.stderr).expect("UTF-8");
    let percents: Vec<u32> = errors
        .lines()
        .map(|line| match line.split(' ').collect::<Vec<_>>()[..] {
            ["progress:", percent, "rays"] => percent.parse().expect("a number"),
            _ => panic!("{line}"),
        })
        .collect();
    assert!(
        percents.len() > 2 && percents.is_sorted() && percents.iter().all(|&percent| percent <= 100),
        "{percents:?}"
    );

    let run = penumbra(&arguments, directory.path());
    assert!(run.status.success() && run.stderr.is_empty());
}

#[test]
fn a_rendering_is_compared_with_its_reference() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    render_square(at, "out.exr", &["--aov", "position,normal"]);
    succeed(&["reference", "procedural:square", "--size", "40x30", "-o", "truth.exr"], at);
    let text = succeed(&["compare", "out.exr", "truth.exr", "--heatmap", "error.png", "--ssim-map", "ssim.png"], at);
    assert!(text.contains("penumbra"), "{text}");
    assert!(image::open(at.join("error.png")).is_ok() && image::open(at.join("ssim.png")).is_ok());
    let report: Value =
        serde_json::from_str(&succeed(&["compare", "out.exr", "truth.exr", "--json"], at)).expect("JSON");
    let rmse = report["lights"][0]["masks"]["penumbra"]["rmse"].as_f64().expect("a number");
    assert!((1e-4..0.1).contains(&rmse), "{rmse}");
    assert_eq!(report["pixels"]["compared"], 40 * 30);
    // One mask alone on request.
    let report: Value =
        serde_json::from_str(&succeed(&["compare", "out.exr", "truth.exr", "--mask", "shadow", "--json"], at))
            .expect("JSON");
    assert_eq!(report["lights"][0]["masks"].as_object().map(|masks| masks.len()), Some(1));
}

#[test]
fn a_floor_takes_a_height_but_not_the_argument_after_it() {
    let directory = tempfile::tempdir().expect("a directory");
    let common = ["--size", "8x6", "--set", "samples=1", "-o", "out.exr"];
    for floor in [["--add-floor", "procedural:square"].as_slice(), &["procedural:square", "--add-floor", "-0.5"]] {
        succeed(&[&["render"], floor, common.as_slice()].concat(), directory.path());
    }
    fail(&["render", "procedural:square", "-o", "out.exr", "--add-floor=high"], 2, "expected a height");
}

#[test]
fn the_image_holds_the_layers_of_the_contract() {
    let directory = tempfile::tempdir().expect("a directory");
    render_square(
        directory.path(),
        "out.exr",
        &["--quantity", "irradiance", "--aov", "position,normal,shading_normal,depth,coverage"],
    );
    let image = read_exr(&directory.path().join("out.exr")).expect("an image");
    let names: Vec<_> = image.channels.iter().map(|channel| channel.name.as_str()).collect();
    let light = &image.light_names()[0];
    for layer in ["visibility", "facing", "irradiance.R", "irradiance.G", "irradiance.B"] {
        assert!(names.contains(&format!("{light}.{layer}").as_str()), "{names:?}");
    }
    for name in ["position.X", "normal.Y", "shading_normal.Z", "depth.Z", "coverage.A"] {
        assert!(names.contains(&name), "{names:?}");
    }
    for attribute in ["version", "technique", "parameters", "adapter", "scene"] {
        assert!(image.attributes.contains_key(&format!("penumbra:{attribute}")), "{:?}", image.attributes);
    }
    assert!(image.channels.iter().flat_map(|channel| &channel.samples).all(|sample| sample.is_finite()));
}

#[test]
fn the_same_input_gives_the_same_bytes_on_any_number_of_threads() {
    let directory = tempfile::tempdir().expect("a directory");
    for (threads, output) in [("1", "a.exr"), ("3", "b.exr")] {
        let arguments =
            [&["render"], SQUARE.as_slice(), &["samples=16", "-o", output, "--quantity", "irradiance"]].concat();
        let run = command(&arguments, directory.path()).env("RAYON_NUM_THREADS", threads).output().expect("runs");
        assert!(run.status.success());
    }
    let read = |name: &str| std::fs::read(directory.path().join(name)).expect("a file");
    assert!(read("a.exr") == read("b.exr"));
}

#[test]
fn the_json_record_has_what_the_contract_says() {
    let directory = tempfile::tempdir().expect("a directory");
    let record: Value = serde_json::from_str(&render_square(directory.path(), "out.exr", &["--json"])).expect("JSON");
    assert_eq!(record["output"], "out.exr");
    assert_eq!(record["size"], serde_json::json!([40, 30]));
    assert_eq!(record["technique"], "rays");
    assert_eq!(record["parameters"]["samples"], 16);
    assert_eq!(record["adapter"]["software"], true);
    assert_eq!(record["lights"][0]["samples"], 16);
    assert!(record["lights"][0]["time_ms"]["passes"][0]["ms"].is_number());
    for time in ["load", "build", "render", "write", "total"] {
        assert!(record["time_ms"][time].is_number(), "{time}");
    }
    assert!(record["warnings"].is_array() && record["memory_mb"].is_object());
}

#[test]
fn receivers_of_an_image_give_its_visibility_back() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    let common = ["reference", "procedural:disks?x=0.013", "--size", "40x30", "--method", "rays", "--samples", "256"];
    succeed(&[common.as_slice(), &["-o", "camera.exr", "--aov", "position,normal"]].concat(), at);
    succeed(&[common.as_slice(), &["-o", "points.exr", "--receivers", "camera.exr"]].concat(), at);
    let (a, b) = (read_exr(&at.join("camera.exr")).expect("reads"), read_exr(&at.join("points.exr")).expect("reads"));
    let light = &a.light_names()[0];
    let pairs = a.visibility(light).expect("a light").iter().zip(b.visibility(light).expect("a light"));
    // Positions are rounded to floats, which moves a receiver by 1e-7: a sample of 256 here and there.
    assert!(pairs.clone().all(|(a, b)| (a - b).abs() <= 1.0 / 256.0));
    assert!(pairs.filter(|(a, b)| a != b).count() <= 2);
    // An image without positions says what to do.
    render_square(at, "bare.exr", &[]);
    let run = penumbra(&[common.as_slice(), &["-o", "c.exr", "--receivers", "bare.exr"]].concat(), at);
    assert!(String::from_utf8_lossy(&run.stderr).contains("--aov position,normal"));
}

#[test]
fn several_lights_become_several_pictures() {
    let directory = tempfile::tempdir().expect("a directory");
    render_square(directory.path(), "out.png", &["--add-light", "point:at=1/4/0,name=Lamp"]);
    let mut names: Vec<_> = std::fs::read_dir(directory.path())
        .expect("a directory")
        .map(|entry| entry.expect("an entry").file_name().into_string().expect("UTF-8"))
        .collect();
    names.sort();
    assert!(names.len() == 2 && names.contains(&"out.Lamp.png".to_owned()), "{names:?}");
    // Picked by name, it is alone.
    let directory = tempfile::tempdir().expect("a directory");
    render_square(directory.path(), "out.png", &["--add-light", "point:at=1/4/0,name=Lamp", "--light", "Lamp"]);
    assert!(directory.path().join("out.png").is_file());
}

#[test]
fn shaded_pictures_are_smoothed_and_colourful() {
    let directory = tempfile::tempdir().expect("a directory");
    succeed(
        &[
            "render",
            "procedural:demo",
            "-o",
            "out.png",
            "--quantity",
            "shaded",
            "--aa",
            "2",
            "--size",
            "64x48",
            "--set",
            "samples=4",
        ],
        directory.path(),
    );
    let picture = image::open(directory.path().join("out.png")).expect("a picture").into_rgb8();
    assert!(picture.pixels().any(|pixel| pixel[0] > pixel[2].saturating_add(20)), "something is warm");
}

#[test]
fn antialiased_irradiance_is_the_mean_of_its_sub_pixels() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    let common =
        ["render", "procedural:square", "--set", "pattern=grid", "--set", "samples=16", "--quantity", "irradiance"];
    succeed(&[common.as_slice(), &["--size", "10x8", "--aa", "2", "-o", "smooth.exr"]].concat(), at);
    succeed(&[common.as_slice(), &["--size", "20x16", "-o", "fine.exr"]].concat(), at);
    let (smooth, fine) =
        (read_exr(&at.join("smooth.exr")).expect("reads"), read_exr(&at.join("fine.exr")).expect("reads"));
    let light = &smooth.light_names()[0];
    let (smooth, fine) = (smooth.irradiance(light).expect("a light")[1], fine.irradiance(light).expect("a light")[1]);
    for y in 0..8 {
        for x in 0..10 {
            let fine_at = |dx: usize, dy: usize| fine[(2 * y + dy) * 20 + 2 * x + dx];
            let mean = (fine_at(0, 0) + fine_at(1, 0) + fine_at(0, 1) + fine_at(1, 1)) / 4.0;
            assert!((smooth[y * 10 + x] - mean).abs() <= 1e-6 * mean.max(1e-3), "{x} {y}");
        }
    }
}

#[test]
fn lists_and_descriptions_are_there_for_people_and_programs() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    assert!(succeed(&["list"], at).contains("--set samples=64"));
    let list: Value = serde_json::from_str(&succeed(&["list", "--json"], at)).expect("JSON");
    let parameter = &list["techniques"][0]["parameters"][0];
    assert_eq!((parameter["name"].as_str(), parameter["default"].as_u64()), (Some("samples"), Some(64)));
    assert!(parameter["minimum"].is_number() && parameter["maximum"].is_number() && parameter["meaning"].is_string());
    assert!(succeed(&["info", "procedural:demo"], at).contains("light      Key: rect"));
    let info: Value = serde_json::from_str(&succeed(&["info", "procedural:demo", "--json"], at)).expect("JSON");
    assert!(info["triangles"].as_u64() > Some(1000) && info["bounds_world"].is_array());
    for subcommand in ["render", "reference", "compare", "list", "info", "demo"] {
        assert!(succeed(&[subcommand, "--help"], at).contains("Usage:"), "{subcommand}");
    }
}

#[test]
fn wrong_usage_is_told_in_one_line() {
    let render = |more: &[&'static str]| [&["render", "procedural:square", "-o", "out.exr"], more].concat();
    fail(&render(&["--technique", "magic"]), 2, "there is rays");
    fail(&render(&["--set", "smaples=3"]), 2, "there is samples, pattern, seed");
    fail(&render(&["--set", "samples=0"]), 2, "expected 1 to");
    fail(&render(&["--set", "samples=many"]), 2, "samples");
    fail(&render(&["--set", "pattern=1"]), 2, "expected one of grid, jittered, halton, sobol");
    fail(&["reference", "procedural:square", "-o", "out.exr", "--samples", "64"], 2, "add --method rays");
    fail(&["reference", "procedural:square", "-o", "out.exr", "--cache", "/dev/null/cache"], 1, "/dev/null/cache");
    fail(&render(&["--set", "pattern=spiral"]), 2, "expected one of grid, jittered, halton, sobol");
    fail(&render(&["--light", "Lamp"]), 2, "the scene has");
    fail(&render(&["--camera", "Side"]), 2, "the scene has");
    fail(&render(&["--add-light", "cube:at=0/1/0"]), 2, "shapes");
    fail(&render(&["--add-light", "rect:at=0/1/0,size=0"]), 2, "size");
    fail(&render(&["--size", "0x5"]), 2, "expected");
    fail(&render(&["--device", "gpu"]), 2, "processor");
    fail(&render(&["--aa", "2"]), 2, "pixel centres");
    fail(&render(&["--verify", "0"]), 2, "--verify");
    fail(&render(&["--max-error", "0.01"]), 2, "no technique `auto` yet");
    fail(&["render", "procedural:square", "-o", "out.jpg"], 2, ".exr or .png");
    fail(&["render", "procedural:square", "-o", "out.png", "--quantity", "irradiance"], 2, ".exr");
    fail(&["render", "procedural:square", "-o", "out.png", "--shading", "phong"], 2, "--quantity shaded");
    fail(&["render", "procedural:sqare", "-o", "out.exr"], 2, "square");
    fail(&["render", "scene.usd", "-o", "out.exr"], 2, "USD");
    fail(&["render"], 2, "required");
}

#[test]
fn a_reference_shares_no_samples_with_what_it_judges() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    render_square(at, "out.exr", &[]);
    succeed(
        &[
            "reference",
            "procedural:square",
            "--size",
            "40x30",
            "--method",
            "rays",
            "--samples",
            "16",
            "-o",
            "truth.exr",
        ],
        at,
    );
    let report: Value =
        serde_json::from_str(&succeed(&["compare", "out.exr", "truth.exr", "--json"], at)).expect("JSON");
    // Two independent estimates at the sampling floor of 16 samples (0.044) differ by √2 times that.
    let rmse = report["lights"][0]["masks"]["penumbra"]["rmse"].as_f64().expect("a number");
    assert!(rmse > 0.02, "{rmse}");
}

#[test]
fn a_reference_is_exact_unless_told_otherwise() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    succeed(&["reference", "procedural:square", "--size", "40x30", "-o", "truth.exr"], at);
    let image = read_exr(&at.join("truth.exr")).expect("reads");
    assert_eq!(image.attributes["penumbra:technique"], "reference-exact");
    assert!(image.sampled("Key").expect("a layer").iter().all(|&sampled| sampled == 0.0));
    // The errors of samples fall towards it.
    let errors = ["64", "256", "1024"].map(|samples| {
        let arguments = ["render", "procedural:square", "--size", "40x30", "-o", "out.exr", "--set"];
        succeed(&[arguments.as_slice(), &[&format!("samples={samples}")]].concat(), at);
        penumbra_rmse(at, "out.exr", "truth.exr")
    });
    assert!(errors[1] < 0.5 * errors[0] && errors[2] < 0.5 * errors[1], "{errors:?}");
}

/// RMSE over the penumbra of the first light.
fn penumbra_rmse(at: &Path, test: &str, reference: &str) -> f64 {
    let report: Value = serde_json::from_str(&succeed(&["compare", test, reference, "--json"], at)).expect("JSON");
    report["lights"][0]["masks"]["penumbra"]["rmse"].as_f64().expect("a number")
}

#[test]
fn irradiance_comes_with_its_share_of_the_unshadowed() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    let scene = "procedural:corner?height=1&lift=0.4&light=2&occluder=0.3";
    let arguments = [scene, "--size", "40x30", "--quantity", "irradiance", "-o"];
    succeed(&[&["reference"], arguments.as_slice(), &["truth.exr"]].concat(), at);
    succeed(&[&["render"], arguments.as_slice(), &["out.exr", "--set", "samples=1024"]].concat(), at);
    let [truth, image] = ["truth.exr", "out.exr"].map(|name| read_exr(&at.join(name)).expect("reads"));
    let light = &truth.light_names()[0];
    let ratio = truth.irradiance_ratio(light).expect("a layer");
    let visibility = truth.visibility(light).expect("a layer");
    let sampled = image.irradiance_ratio(light).expect("a layer");
    let mut differing = 0;
    for i in 0..ratio.len() {
        assert!((0.0..=1.0).contains(&ratio[i]) && (ratio[i] > 0.0) == (visibility[i] > 0.0));
        // 1024 samples leave some 0.002 of an edge; the weights of so near a light are up to ten times their mean.
        assert!((ratio[i] - sampled[i]).abs() < 0.02, "{} {}", ratio[i], sampled[i]);
        differing += usize::from((ratio[i] - visibility[i]).abs() > 0.02);
    }
    assert!(differing > 20, "the share of E is that of the area at all but {differing} pixels");
    // It belongs to pixel centres.
    succeed(&[&["reference"], arguments.as_slice(), &["aa.exr", "--aa", "2"]].concat(), at);
    assert!(read_exr(&at.join("aa.exr")).expect("reads").irradiance_ratio(light).is_none());
}

#[test]
fn a_reference_answers_at_the_receivers_of_an_image() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    let camera = ["reference", "procedural:sphere", "--size", "40x30", "-o", "truth.exr", "--aov", "position,normal"];
    succeed(&camera, at);
    succeed(&["reference", "procedural:sphere", "--receivers", "truth.exr", "-o", "again.exr"], at);
    // Positions in the file are rounded to floats, by at most 2e-6 here, of penumbrae that are wider than 2 % of that scene.
    let rmse = penumbra_rmse(at, "again.exr", "truth.exr");
    assert!(rmse < 1e-4, "{rmse}");
}

#[test]
fn a_cache_answers_again_and_only_what_was_asked() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    let reference = |output: &'static str, more: &[&'static str]| {
        let common =
            ["reference", "--size", "40x30", "--quantity", "irradiance", "--json", "--cache", "kept", "-o", output];
        let record: Value = serde_json::from_str(&succeed(&[common.as_slice(), more].concat(), at)).expect("JSON");
        let pass = record["lights"][0]["time_ms"]["passes"][0]["name"].as_str().expect("a pass").to_owned();
        (pass, std::fs::read(at.join(output)).expect("written"))
    };
    let (pass, bytes) = reference("a.exr", &["procedural:square"]);
    assert_eq!(pass, "exact");
    assert_eq!(reference("a.exr", &["procedural:square"]), ("cache".into(), bytes.clone()));
    // Another scene, another quantity, another method: not the same question.
    for other in [&["procedural:square?occluder=0.4"][..], &["procedural:square", "--method", "rays", "--samples", "4"]]
    {
        let (pass, other_bytes) = reference("b.exr", other);
        assert!(pass != "cache" && other_bytes != bytes, "{other:?}");
    }
    // What is damaged is answered anew, and replaced.
    for entry in std::fs::read_dir(at.join("kept")).expect("a directory") {
        let path = entry.expect("an entry").path();
        let whole = std::fs::read(&path).expect("reads");
        std::fs::write(&path, &whole[..whole.len() / 2]).expect("writes");
    }
    assert_eq!(reference("a.exr", &["procedural:square"]), ("exact".into(), bytes.clone()));
    assert_eq!(reference("a.exr", &["procedural:square"]), ("cache".into(), bytes));
}

#[test]
fn verifying_every_receiver_finds_the_error_itself() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    let common = ["render", "procedural:demo", "--size", "40x30", "--set", "samples=16", "-o", "out.exr"];
    let record = succeed(&[common.as_slice(), &["--verify", "1000000", "--json"]].concat(), at);
    let record: Value = serde_json::from_str(&record).expect("JSON");
    succeed(&["reference", "procedural:demo", "--size", "40x30", "-o", "truth.exr"], at);
    let report: Value =
        serde_json::from_str(&succeed(&["compare", "out.exr", "truth.exr", "--json"], at)).expect("JSON");
    for light in record["lights"].as_array().expect("lights") {
        let lights = report["lights"].as_array().expect("lights");
        let compared = lights.iter().find(|other| other["name"] == light["name"]).expect("the same light");
        let all = &compared["masks"]["all"];
        let verified = &light["verified"];
        assert_eq!(verified["receivers"], all["count"]);
        let number = |value: &Value| value.as_f64().expect("a number");
        assert!((number(&verified["rmse"]) - number(&all["rmse"])).abs() < 1e-9, "{verified} {all}");
        assert!((number(&verified["max"]) - number(&all["max"])).abs() < 1e-6, "{verified} {all}");
        assert_eq!(verified["rmse_ci95"], serde_json::json!([verified["rmse"], verified["rmse"]]));
    }
    let header = read_exr(&at.join("out.exr")).expect("reads").attributes["penumbra:verified"].clone();
    let header: Value = serde_json::from_str(&header).expect("JSON");
    assert_eq!(header["Key"]["rmse"], record["lights"][0]["verified"]["rmse"]);
    // For people, a line a light.
    let text = succeed(&[common.as_slice(), &["--verify", "64"]].concat(), at);
    assert!(text.lines().count() == 2 && text.contains("Key: RMSE of visibility"), "{text}");
}

#[test]
fn several_pictures_are_written_together_or_not_at_all() {
    let directory = tempfile::tempdir().expect("a directory");
    std::fs::create_dir(directory.path().join("out.Lamp.png")).expect("a directory in the way");
    let arguments =
        [&["render"], SQUARE.as_slice(), &["samples=1", "-o", "out.png", "--add-light", "point:at=1/4/0,name=Lamp"]];
    let run = penumbra(&arguments.concat(), directory.path());
    assert_eq!(run.status.code(), Some(1));
    assert_eq!(std::fs::read_dir(directory.path()).expect("a directory").count(), 1);
}

#[test]
fn more_lights_than_fit_are_refused_before_any_work() {
    let directory = tempfile::tempdir().expect("a directory");
    let mut arguments = vec!["render", "procedural:square", "-o", "out.exr", "--size", "8000x8000"];
    arguments.extend(["--add-light", "point:at=1/4/0"].repeat(3));
    let run = penumbra(&arguments, directory.path());
    assert_eq!(run.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&run.stderr).contains("fewer lights"));
}

#[test]
fn what_goes_wrong_outside_is_told_in_one_line() {
    fail(&["render", "missing.glb", "-o", "out.exr"], 1, "missing.glb");
    fail(&["render", "procedural:square", "-o", "no/where/out.exr"], 1, "no/where");
    fail(&["compare", "a.exr", "b.exr"], 1, "a.exr");
}

#[test]
fn images_that_do_not_fit_are_refused() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    render_square(at, "a.exr", &[]);
    succeed(&["render", "procedural:square", "--size", "20x30", "-o", "b.exr"], at);
    let run = penumbra(&["compare", "a.exr", "b.exr"], at);
    assert_eq!(run.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&run.stderr).contains("20"), "{}", String::from_utf8_lossy(&run.stderr));
    std::fs::write(at.join("broken.exr"), b"v/1\x01 not really").expect("writes");
    let run = penumbra(&["compare", "a.exr", "broken.exr"], at);
    assert_eq!(run.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&run.stderr).starts_with("error: "));
}

#[test]
fn a_pixel_that_faces_away_from_the_light_is_in_no_mask() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    render_square(at, "a.exr", &[]);
    let mut image = read_exr(&at.join("a.exr")).expect("reads");
    let light = image.light_names()[0].clone();
    for channel in &mut image.channels {
        if channel.name == format!("{light}.facing") {
            channel.samples.fill(0.0);
        }
    }
    write_exr(&at.join("away.exr"), &image).expect("writes");
    let report: Value = serde_json::from_str(&succeed(&["compare", "a.exr", "away.exr", "--json"], at)).expect("JSON");
    assert_eq!(report["lights"][0]["masks"]["all"]["count"], 0);
}

#[cfg(unix)]
#[test]
fn ctrl_c_stops_within_a_second_and_leaves_nothing() {
    let directory = tempfile::tempdir().expect("a directory");
    let arguments = [
        "reference",
        "procedural:demo",
        "--method",
        "rays",
        "--samples",
        "1000000",
        "--size",
        "800x600",
        "-o",
        "out.exr",
    ];
    let mut child = command(&arguments, directory.path()).stderr(Stdio::piped()).spawn().expect("runs");
    std::thread::sleep(Duration::from_millis(1500));
    assert!(child.try_wait().expect("a status").is_none(), "it is still at work");
    let start = Instant::now();
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill").success());
    let output = child.wait_with_output().expect("ends");
    // A second, and what a machine with more to do than cores may add.
    assert!(start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
    assert_eq!(output.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&output.stderr).contains("error: cancelled"));
    assert_eq!(std::fs::read_dir(directory.path()).expect("a directory").count(), 0);
}

#[test]
fn what_needs_no_gpu_works_without_a_driver() {
    let directory = tempfile::tempdir().expect("a directory");
    let run = |arguments: &[&str]| {
        let nothing = "/nonexistent/driver.json";
        let mut command = command(arguments, directory.path());
        command.envs([("VK_ICD_FILENAMES", nothing), ("VK_DRIVER_FILES", nothing)]).output().expect("runs")
    };
    let listed = run(&["list"]);
    assert!(listed.status.success());
    let render = ["render", "procedural:square", "--size", "8x6", "-o", "out.exr", "--technique"];
    for entry in ALL {
        assert!(String::from_utf8_lossy(&listed.stdout).contains(&format!("\n{} - ", entry.name)), "{}", entry.name);
        let rendered = run(&[render.as_slice(), &[entry.name]].concat());
        let errors = String::from_utf8_lossy(&rendered.stderr);
        match entry.needs {
            Needs::Cpu => assert!(rendered.status.success(), "{}: {errors}", entry.name),
            Needs::Gpu => {
                assert_eq!(rendered.status.code(), Some(1), "{}: {errors}", entry.name);
                assert!(errors.contains("error: GPU: "), "{}: {errors}", entry.name);
            }
        }
    }
}
