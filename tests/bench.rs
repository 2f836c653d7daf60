//! `penumbra bench`, end to end.

#[expect(dead_code, clippy::needless_pass_by_value, reason = "each test binary uses some of it, with `json!` literals")]
mod gltf_files;

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use assert_cmd::cargo::CommandCargoExt;
use gltf_files::{File, push};
use penumbra::techniques::{ALL, Entry, Needs};
use serde_json::{Value, json};

/// Two sizes of one scene, two settings: the fewest runs that count.
const TINY: &str = r#"
about = "A <tiny> suite."
sizes = ["16x12", "24x18"]
timing = { runs = 5, seconds = 0 }

[[scenes]]
scene = "procedural:square"

[[techniques]]
technique = "rays"
set = { samples = [4, 16], pattern = "grid" }
"#;

fn bench(directory: &Path, suite: &str) -> Output {
    fs::write(directory.join("suite.toml"), suite).expect("writes");
    bench_file(directory, "suite.toml")
}

fn bench_file(directory: &Path, suite: &str) -> Output {
    command(directory, suite).output().expect("runs")
}

fn command(directory: &Path, suite: &str) -> Command {
    let mut command = Command::cargo_bin("penumbra").expect("the binary");
    // Without it, Vulkan loaders say so on stderr.
    command.env("XDG_RUNTIME_DIR", directory);
    command.args(["bench", suite, "-o", "out"]).current_dir(directory);
    command
}

/// Runs what must succeed; returns stdout and stderr.
fn succeed(directory: &Path, suite: &str) -> [String; 2] {
    let run = bench(directory, suite);
    let texts = [run.stdout, run.stderr].map(|bytes| String::from_utf8(bytes).expect("UTF-8"));
    assert!(run.status.success(), "{texts:?}");
    texts
}

fn results(directory: &Path) -> Value {
    let text = fs::read_to_string(directory.join("out/results.json")).expect("results");
    serde_json::from_str(&text).expect("JSON")
}

fn keys(value: &Value) -> Vec<&str> {
    value.as_object().expect("an object").keys().map(String::as_str).collect()
}

#[track_caller]
fn assert_spread(value: &Value) {
    assert_eq!(keys(value), ["median", "q1", "q3"]);
    let [median, q1, q3] = ["median", "q1", "q3"].map(|name| value[name].as_f64().expect("a number"));
    assert!(0.0 < q1 && q1 <= median && median <= q3, "{value}");
}

#[test]
fn results_have_every_field_of_the_schema() {
    let directory = tempfile::tempdir().expect("a directory");
    let [stdout, stderr] = succeed(directory.path(), TINY);
    assert!(stdout.starts_with("4 configurations measured, 0 kept"), "{stdout}");
    assert!(stderr.is_empty(), "{stderr}");
    let results = results(directory.path());
    assert_eq!(keys(&results), ["version", "suite", "records"]);
    assert_eq!((&results["version"], &results["suite"]), (&3.into(), &"suite".into()));
    let records = results["records"].as_array().expect("records");
    assert_eq!(records.len(), 4);
    let widths: Vec<&Value> = records.iter().map(|record| &record["size"][0]).collect();
    assert_eq!(widths, [16, 16, 24, 24]);
    for (record, samples) in records.iter().zip([4, 16, 4, 16]) {
        let expected = [
            "key",
            "experiments",
            "scene",
            "source",
            "triangles",
            "light",
            "size",
            "frames",
            "technique",
            "preset",
            "settings",
            "parameters",
            "penumbra",
            "machine",
            "adapter",
            "date",
            "outcome",
        ];
        assert_eq!(keys(record), expected);
        assert_eq!(record["key"].as_str().map(str::len), Some(32));
        assert_eq!((&record["scene"], &record["source"]), (&"square".into(), &"procedural:square".into()));
        assert_eq!((&record["experiments"], &record["frames"]), (&json!([]), &Value::Null));
        assert_eq!(record["triangles"], 4);
        assert_eq!(keys(&record["light"]), ["name", "shape", "extent"]);
        assert_eq!(record["light"]["shape"], "rect");
        assert_eq!((&record["technique"], &record["preset"]), (&"rays".into(), &"best".into()));
        assert_eq!(record["settings"], serde_json::json!({"pattern": "grid", "samples": samples}));
        assert_eq!(record["parameters"], serde_json::json!({"samples": samples, "pattern": "grid", "seed": 0}));
        assert_eq!(record["penumbra"], env!("CARGO_PKG_VERSION"));
        assert_eq!(keys(&record["machine"]), ["processor", "system", "threads"]);
        assert!(record["machine"]["threads"].as_u64().expect("threads") >= 1);
        assert_eq!(record["adapter"], serde_json::json!({"name": "CPU", "backend": "cpu", "software": true}));
        assert!(record["date"].as_str().expect("a date").ends_with('Z'));
        check_outcome(&record["outcome"], record["size"].as_array().expect("a size"), samples);
    }
}

/// What an outcome that was measured has.
const MEASURED: [&str; 12] = [
    "status",
    "time",
    "memory_mb",
    "samples",
    "rays",
    "shadow_maps",
    "texels",
    "reference",
    "pixels",
    "errors",
    "notes",
    "sequence",
];

fn check_outcome(outcome: &Value, size: &[Value], samples: u64) {
    assert_eq!(keys(outcome), MEASURED);
    assert_eq!(outcome["sequence"], Value::Null);
    assert_eq!(outcome["status"], "done");
    let time = &outcome["time"];
    let expected = ["runs", "wall_ms", "build_ms", "render_ms", "build_passes", "passes", "baseline"];
    assert_eq!(keys(time), expected);
    assert_eq!(time["runs"], 5);
    for name in ["wall_ms", "build_ms", "render_ms"] {
        assert_spread(&time[name]);
    }
    assert_eq!(time["build_passes"], serde_json::json!([]));
    assert_eq!(keys(&time["passes"][0]), ["name", "ms"]);
    assert_eq!(time["passes"][0]["name"], "rays");
    let baseline = &time["baseline"];
    assert_eq!(keys(baseline), ["runs", "wall_ms", "render_ms", "wall_ratio", "render_ratio"]);
    assert_eq!(baseline["runs"], 5);
    for name in ["wall_ms", "render_ms", "wall_ratio", "render_ratio"] {
        assert_spread(&baseline[name]);
    }
    assert_eq!(keys(&outcome["memory_mb"]), ["peak_rss", "gpu"]);
    assert_eq!(outcome["memory_mb"]["gpu"], 0.0);
    assert_eq!(outcome["samples"], samples);
    assert!(outcome["rays"].as_u64().expect("rays") > 0);
    assert_eq!(outcome["shadow_maps"], 0);
    assert_eq!(outcome["reference"], serde_json::json!({"method": "exact", "sampled_receivers": 0}));
    let pixels = size[0].as_u64().expect("width") * size[1].as_u64().expect("height");
    let counted = serde_json::json!({"compared": pixels, "uncovered": 0, "coverage_differs": 0, "position_differs": 0});
    assert_eq!(outcome["pixels"], counted);
    let errors = &outcome["errors"];
    let expected =
        ["name", "reference_name", "masks", "false_umbra", "false_light", "banding_rmse_per_px", "irradiance"];
    assert_eq!(keys(errors), expected);
    assert_eq!(keys(&errors["masks"]), ["all", "shadow", "penumbra"]);
    for (_, mask) in errors["masks"].as_object().expect("masks") {
        assert_eq!(keys(mask), ["count", "rmse", "mae", "p99", "max", "bias", "ssim", "flip"]);
    }
    // A cell-centred grid of n × n is off by at most some 1/n where one straight edge crosses the light, and by twice that at
    // a corner's two; its RMSE is below, and is not nothing.
    let rmse = errors["masks"]["penumbra"]["rmse"].as_f64().expect("an RMSE");
    assert!(1e-4 < rmse && rmse < 2.0 / (samples as f64).sqrt(), "{rmse}");
    assert_eq!(keys(&errors["false_umbra"]), ["count", "rmse"]);
}

#[test]
fn the_table_has_a_line_a_configuration() {
    let directory = tempfile::tempdir().expect("a directory");
    succeed(directory.path(), TINY);
    let mut reader = csv::Reader::from_path(directory.path().join("out/results.csv")).expect("a table");
    let header: Vec<String> = reader.headers().expect("a header").iter().map(str::to_owned).collect();
    assert_eq!(header.len(), header.iter().collect::<BTreeSet<_>>().len(), "{header:?}");
    let rows: Vec<csv::StringRecord> = reader.records().map(|row| row.expect("as long as the header")).collect();
    let records = results(directory.path());
    let records = records["records"].as_array().expect("records");
    assert_eq!(rows.len(), records.len());
    for (row, record) in rows.iter().zip(records) {
        let cell = |name: &str| &row[header.iter().position(|column| column == name).expect(name)];
        let number = |name: &str| cell(name).parse::<f64>().expect(name);
        assert_eq!(cell("technique"), "rays");
        assert_eq!(cell("status"), "done");
        assert_eq!(cell("key"), record["key"]);
        assert_eq!(number("width"), record["size"][0].as_f64().expect("a width"));
        let outcome = &record["outcome"];
        for (column, value) in [
            ("wall_ms", &outcome["time"]["wall_ms"]["median"]),
            ("render_ratio_q3", &outcome["time"]["baseline"]["render_ratio"]["q3"]),
            ("penumbra_rmse", &outcome["errors"]["masks"]["penumbra"]["rmse"]),
            ("all_flip", &outcome["errors"]["masks"]["all"]["flip"]),
            ("false_light_count", &outcome["errors"]["false_light"]["count"]),
        ] {
            assert_eq!(Some(number(column)), value.as_f64(), "{column}");
        }
    }
}

#[test]
fn the_report_holds_all_of_it_and_needs_nothing_else() {
    let directory = tempfile::tempdir().expect("a directory");
    succeed(directory.path(), TINY);
    let html = fs::read_to_string(directory.path().join("out/report.html")).expect("a report");
    for outside in ["http://", "https://", "src=\"//", "@import", "<link"] {
        assert!(!html.contains(outside), "{outside}");
    }
    assert!(html.contains("A &lt;tiny&gt; suite."), "text is escaped");
    for group in ["16x12", "24x18"] {
        assert!(html.contains(&format!("square, Key, {group}</h2>")), "{group}");
    }
    for settings in ["pattern=grid samples=4", "pattern=grid samples=16"] {
        assert!(html.matches(settings).count() >= 2, "{settings}");
    }
    // Three pictures a configuration, one a group; two charts a group, with a marker for each configuration.
    assert_eq!(html.matches("src=\"data:image/png;base64,").count(), 3 * 4 + 2);
    assert_eq!(html.matches("<svg ").count(), 2 * 2);
    assert_eq!(html.matches("<title>").count(), 1 + 2 * 4);
    for text in ["RMSE of visibility, penumbra", "time of a whole frame, ms", env!("CARGO_PKG_VERSION")] {
        assert!(html.contains(text), "{text}");
    }
    assert!(!html.contains("NaN") && !html.contains("undefined"));
}

#[test]
fn what_is_done_is_not_done_again() {
    let directory = tempfile::tempdir().expect("a directory");
    succeed(directory.path(), TINY);
    let before = results(directory.path());
    let [stdout, _] = succeed(directory.path(), TINY);
    assert!(stdout.starts_with("0 configurations measured, 4 kept"), "{stdout}");
    assert_eq!(results(directory.path()), before);

    // A changed suite keeps what it still asks for, and what it no longer does.
    let changed = TINY.replace("[4, 16]", "[16, 64]").replace("\"16x12\", ", "");
    let [stdout, _] = succeed(directory.path(), &changed);
    assert!(stdout.starts_with("1 configurations measured, 1 kept"), "{stdout}");
    let after = results(directory.path());
    let after = after["records"].as_array().expect("records");
    let before = before["records"].as_array().expect("records");
    assert_eq!(after.len(), 5);
    assert!(before.iter().all(|record| after.contains(record)));
    // Its own come first.
    assert_eq!((&after[0], &after[1]["settings"]["samples"]), (&before[3], &64.into()));
    let html = fs::read_to_string(directory.path().join("out/report.html")).expect("a report");
    assert!(html.contains("3 more records"), "what is not shown is said");
}

#[test]
fn a_name_may_change_without_a_new_measurement() {
    let directory = tempfile::tempdir().expect("a directory");
    succeed(directory.path(), TINY);
    let renamed = TINY.replace("scene =", "name = \"another\"\nscene =");
    let [stdout, _] = succeed(directory.path(), &renamed);
    assert!(stdout.starts_with("0 configurations measured, 4 kept"), "{stdout}");
    let results = results(directory.path());
    assert!(results["records"].as_array().expect("records").iter().all(|record| record["scene"] == "another"));
}

#[test]
fn lights_are_swept_and_measured_one_by_one() {
    let directory = tempfile::tempdir().expect("a directory");
    let suite = r#"
        sizes = ["12x9"]
        timing = { runs = 5, seconds = 0 }
        [[scenes]]
        scene = "procedural:demo"
        add_floor = -1
        lights = [
            { name = "added", add_light = ["rect:at=0/4/1,to=0/0/0,size=1"] },
            { name = "own" },
            { name = "rim", light = ["Rim"] }, # once more, and so not measured again
            { name = "sun", add_light = ["sun:to=-1/-2/0"] },
        ]
        [[techniques]]
        technique = "rays"
        set = { samples = 4 }
    "#;
    succeed(directory.path(), suite);
    let results = results(directory.path());
    let records = results["records"].as_array().expect("records");
    let lights: Vec<(&str, &str)> = records
        .iter()
        .map(|record| ["name", "shape"].map(|key| record["light"][key].as_str().expect("a name")))
        .map(|[name, shape]| (name, shape))
        .collect();
    assert_eq!(lights, [("added", "rect"), ("own/Key", "rect"), ("own/Rim", "disk"), ("sun", "sun")]);
}

#[test]
fn all_techniques_are_those_of_the_registry() {
    let directory = tempfile::tempdir().expect("a directory");
    let suite = TINY.replace("\"rays\"", "\"all\"").replace("set =", "preset = \"all\" #").replace("\"16x12\", ", "");
    let [_, stderr] = succeed(directory.path(), &suite);
    let results = results(directory.path());
    let records = results["records"].as_array().expect("records");
    let found: BTreeSet<&str> = records.iter().map(|record| record["technique"].as_str().expect("a name")).collect();
    assert_eq!(found, ALL.iter().map(|entry| entry.name).collect());
    // Whatever this machine can't run has a record that says why, and a line counts them.
    let refused: Vec<&Value> =
        records.iter().map(|record| &record["outcome"]).filter(|outcome| outcome["status"] != "done").collect();
    assert!(refused.iter().all(|outcome| outcome["message"].as_str().is_some_and(|text| !text.is_empty())));
    assert_eq!(stderr.lines().count(), usize::from(!refused.is_empty()), "{stderr}");
}

#[cfg(target_os = "linux")]
#[test]
fn without_a_gpu_its_techniques_are_skipped_with_the_reason() {
    let directory = tempfile::tempdir().expect("a directory");
    let suite = TINY.replace("\"rays\"", "\"all\"").replace("set =", "#").replace("\"16x12\", ", "");
    fs::write(directory.path().join("suite.toml"), suite).expect("writes");
    let run = |drivers: &[&str]| {
        let mut command = command(directory.path(), "suite.toml");
        command.envs(drivers.iter().map(|variable| (variable, "/nowhere.json")));
        let run = command.output().expect("runs");
        assert_eq!(run.status.code(), Some(0));
        [run.stdout, run.stderr].map(|bytes| String::from_utf8(bytes).expect("UTF-8"))
    };
    // A loader that finds no driver is a machine without a GPU.
    let [stdout, stderr] = run(&["VK_DRIVER_FILES", "VK_ICD_FILENAMES"]);
    let on_gpu = ALL.iter().filter(|entry| entry.needs == Needs::Gpu).count();
    let on_processor = ALL.len() - on_gpu;
    assert!(stdout.starts_with(&format!("{on_processor} configurations measured")), "{stdout}");
    let line = format!("warning: of {} configurations 0 failed and {on_gpu} were skipped", on_gpu + on_processor);
    assert!(stderr.starts_with(&line) && stderr.lines().count() == 1, "{stderr}");
    let results = results(directory.path());
    for record in results["records"].as_array().expect("records") {
        let name = record["technique"].as_str().expect("a name");
        let on_gpu = Entry::find(name).expect("registered").needs == Needs::Gpu;
        assert_eq!(record["outcome"]["status"], if on_gpu { "skipped" } else { "done" });
        assert_eq!(record["adapter"].is_null(), on_gpu);
        assert!(!on_gpu || record["outcome"]["message"].as_str().is_some_and(|message| message.starts_with("GPU: ")));
    }
    let html = fs::read_to_string(directory.path().join("out/report.html")).expect("a report");
    assert_eq!(html.matches("<td class=\"text\">skipped</td>").count(), on_gpu);
    // With one, if there is one, they are tried again, and what was done is kept.
    let [stdout, _] = run(&[]);
    assert!(stdout.contains(&format!(", {on_processor} kept from before")), "{stdout}");
}

#[test]
fn a_cancelled_run_keeps_what_is_done() {
    // Of many configurations, those that were done when the process was told to stop.
    let directory = tempfile::tempdir().expect("a directory");
    let samples: Vec<String> = (1..2000).map(|i| i.to_string()).collect();
    let suite = TINY.replace("[4, 16]", &format!("[{}]", samples.join(", ")));
    fs::write(directory.path().join("suite.toml"), suite).expect("writes");
    let mut child = command(directory.path(), "suite.toml").spawn().expect("runs");
    let done = || {
        let text = fs::read_to_string(directory.path().join("out/results.json")).ok()?;
        serde_json::from_str::<Value>(&text).expect("whole at any time")["records"].as_array().map(Vec::len)
    };
    while done().unwrap_or_default() < 2 {
        assert!(child.try_wait().expect("a child").is_none(), "it ended too early");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill");
    assert!(killed.success());
    assert_eq!(child.wait().expect("a status").code(), Some(1));
    let records = done().expect("results");
    assert!((2..1999).contains(&records), "{records}");
    for entry in fs::read_dir(directory.path().join("out")).expect("a directory") {
        let name = entry.expect("an entry").file_name().into_string().expect("UTF-8");
        assert!(!name.ends_with(".part"), "{name}");
    }
}

/// Runs a suite that must fail with one line that holds `reason`, before anything is made.
#[track_caller]
fn refuse(suite: &str, reason: &str) {
    let directory = tempfile::tempdir().expect("a directory");
    let run = bench(directory.path(), suite);
    let errors = String::from_utf8(run.stderr).expect("UTF-8");
    assert_eq!(run.status.code(), Some(2), "{errors}");
    assert_eq!(errors.lines().count(), 1, "{errors}");
    assert!(errors.starts_with("error: suite.toml, line ") && errors.contains(reason), "{errors}");
    assert!(!directory.path().join("out").exists(), "{errors}");
}

#[test]
fn mistakes_in_a_suite_are_told_with_their_line() {
    let with = |from: &str, to: &str| {
        assert!(TINY.contains(from), "{from}");
        TINY.replace(from, to)
    };
    let cases = [
        (with("\"24x18\"", "\"24\""), "line 3: expected WxH"),
        (with("about", "abuot"), "line 2: unknown field `abuot`"),
        (with("runs = 5", "runs = 4"), "line 4: timing: expected runs of at least 5"),
        (with("seconds = 0", "seconds = nan"), "line 4: timing: "),
        (with("\"rays\"", "\"raze\""), "line 10: technique \"raze\": unknown; there is "),
        (with("[4, 16]", "[4, 0]"), "line 11: parameter samples of rays: expected 1 to"),
        (with("[4, 16]", "[]"), "line 11: samples: expected a value or a list of values"),
        (with("pattern", "petrn"), "line 11: parameter petrn of rays: unknown; there is samples"),
        (with("\"grid\"", "\"grit\""), "line 11: parameter pattern of rays: expected one of"),
        (with("\"grid\"", "2021-01-01"), "line 11: parameter pattern of rays"),
        (with("set =", "preset = \"worst\"\nset ="), "line 11: --preset worst: rays has no such settings"),
        (with("set =", "preset = 5\nset ="), "line 11: expected the name of a preset"),
        (with("\"rays\"", "\"all\""), "line 10: `set` is for one technique"),
        (with("procedural:square", "procedural:squire"), "line 7: procedural: expected one of"),
        (with("procedural:square", "procedural:square?light=x"), "line 7: "),
        (with("procedural:square", "missing.glb"), "line 7: missing.glb: "),
        (with("procedural:square", "suite.toml"), "line 7: suite.toml: expected a .gltf or .glb file"),
        (with("[[techniques]]", "camera = \"none\"\n[[techniques]]"), "line 7: --camera: \"none\" is not there"),
        (with("[[techniques]]", "light = [\"none\"]\n[[techniques]]"), "line 7: --light: \"none\" is not there"),
        (with("[[techniques]]", "add_light = [\"cube\"]\n[[techniques]]"), "line 9: --add-light: expected auto"),
        (with("[[techniques]]", "add_floor = \"low\"\n[[techniques]]"), "line 9: expected true or a height"),
        (with("[[techniques]]", "sizes = []\n[[techniques]]"), "line 7: sizes is empty"),
        (with("[[techniques]]", "lights = [{ name = \"a\" }, { name = \"a\" }]\n[[techniques]]"), "called \"a\""),
        (
            with("[[techniques]]", "light = [\"a\"]\nlights = [{ name = \"a\" }]\n[[techniques]]"),
            "line 7: `lights` takes the place",
        ),
        (with("[[techniques]]", "[[scenes]]\nscene = \"procedural:square\"\n[[techniques]]"), "line 10: two scenes"),
        (with("[\"16x12\", \"24x18\"]", "[]"), "line 1: sizes is empty"),
        ("sizes = [\"9x9\"]".into(), "line 1: scenes is empty"),
        ("\u{0}".into(), "line 1: "),
    ];
    for (suite, reason) in cases {
        refuse(&suite, reason);
    }
    let many = (1..=101).map(|i| i.to_string()).collect::<Vec<_>>().join(", ");
    let product = format!("set = {{ samples = [{many}], seed = [{many}] }} #");
    refuse(&with("set =", &product), "more than 10000 combinations");
}

#[test]
fn a_missing_suite_names_those_that_are_built_in() {
    let directory = tempfile::tempdir().expect("a directory");
    let run = bench_file(directory.path(), "none.toml");
    let errors = String::from_utf8(run.stderr).expect("UTF-8");
    assert_eq!(run.status.code(), Some(1));
    assert!(errors.starts_with("error: none.toml: ") && errors.contains("quick, scaling"), "{errors}");
}

#[test]
fn results_of_another_kind_are_not_overwritten() {
    let directory = tempfile::tempdir().expect("a directory");
    fs::create_dir(directory.path().join("out")).expect("makes");
    let path = directory.path().join("out/results.json");
    for (text, reason) in [
        ("{", "EOF"),
        ("{}", "expected results of version 3, found null"),
        ("{\"version\": 2}", "expected results of version 3, found 2"),
        ("{\"version\": 3, \"suite\": \"a\", \"records\": [{}]}", "missing field"),
    ] {
        fs::write(&path, text).expect("writes");
        let run = bench(directory.path(), TINY);
        let errors = String::from_utf8(run.stderr).expect("UTF-8");
        assert_eq!(run.status.code(), Some(2), "{errors}");
        assert!(errors.lines().count() == 1 && errors.contains(reason), "{errors}");
        assert_eq!(fs::read_to_string(&path).expect("still there"), text);
    }
}

#[test]
fn built_in_suites_are_sound() {
    use penumbra::bench::results::Machine;
    use penumbra::bench::suite::{BUILT_IN, Plan};
    use penumbra::progress::Progress;
    for (name, _) in BUILT_IN {
        let plan = Plan::read(Path::new(name), &[], &Machine::this(), &Progress::default()).expect(name);
        let sizes: BTreeSet<_> = plan.groups.iter().map(|group| group.size).collect();
        assert!(sizes.len() >= 2, "{name}: a time at one size says little");
        assert!(plan.configurations.len() >= plan.groups.len(), "{name}");
    }
}

/// A small occluder that crosses a large square within a second, lit and seen from above: 2 triangles each.
fn moving_scene(directory: &Path) {
    let light = json!({"version": 1, "shape": "rect", "width": 0.8, "height": 0.8, "radiance": [1, 1, 1]});
    let mut file = File::with_light(light);
    file.json["nodes"][0]["scale"] = json!([3, 3, 1]);
    file.json["nodes"][1]["translation"] = json!([0, 0, 3]);
    let occluder = file.add_node(json!({"mesh": 0, "translation": [-1, 0, 1], "scale": [0.4, 0.4, 1]}));
    file.json["cameras"] = json!([{"type": "perspective", "perspective": {"yfov": 0.6, "znear": 0.1}}]);
    file.add_node(json!({"camera": 0, "translation": [0, 0, 6]}));
    let input = file.floats(&[[0.0], [1.0]]);
    let output = file.floats(&[[-1.0, 0.0, 1.0], [1.0, 0.0, 1.0]]);
    file.json["animations"] = json!([{"name": "cross"}]);
    let animation = &mut file.json["animations"][0];
    let sampler = push(&mut animation["samplers"], json!({"input": input, "output": output}));
    let target = json!({"node": occluder, "path": "translation"});
    push(&mut animation["channels"], json!({"sampler": sampler, "target": target}));
    fs::write(directory.join("moving.glb"), file.glb()).expect("writes");
}

/// An experiment on what moves, and one on what does not.
const EXPERIMENTS: &str = r#"
timing = { runs = 5, seconds = 0 }
sizes = ["32x24"]

[[experiments]]
title = "A shadow that moves"
paper = "It should be <smooth>."
baseline = { technique = "rays", set = { samples = 4, pattern = "grid" } }

[[experiments.scenes]]
scene = "moving.glb"
frames = "0-8:2"
fps = 8
animation = "cross"
show = [0, 4]

[[experiments.techniques]]
technique = "rays"
set = { samples = [4, 16], pattern = "grid" }

[[experiments]]
title = "Samples"
x = "samples"

[[experiments.scenes]]
scene = "moving.glb"

[[experiments.techniques]]
technique = "rays"
set = { samples = [4, 16, 64], pattern = "grid" }
"#;

#[test]
fn frames_of_a_sequence_are_measured_as_single_images_are() {
    let directory = tempfile::tempdir().expect("a directory");
    moving_scene(directory.path());
    let [stdout, stderr] = succeed(directory.path(), EXPERIMENTS);
    assert!(stdout.starts_with("5 configurations measured, 0 kept") && stderr.is_empty(), "{stdout}{stderr}");
    let results = results(directory.path());
    let records = results["records"].as_array().expect("records");
    let experiments: Vec<&Value> = records.iter().map(|record| &record["experiments"][0]).collect();
    assert_eq!(experiments[..2], ["A shadow that moves"; 2]);
    assert_eq!(experiments[2..], ["Samples"; 3]);
    for (moving, still) in records.iter().zip(&records[2..]) {
        let [outcome, still] = [&moving["outcome"], &still["outcome"]];
        if moving["frames"].is_null() {
            assert_eq!(outcome["sequence"], Value::Null);
            continue;
        }
        assert_eq!(moving["frames"], 5);
        assert_eq!(keys(outcome), MEASURED);
        assert_eq!(outcome["time"]["runs"], 3);
        for name in ["wall_ms", "build_ms", "render_ms"] {
            assert_spread(&outcome["time"][name]);
        }
        let sequence = &outcome["sequence"];
        let expected = ["fps", "wall_max_over_median", "render_max_over_median", "stability", "frames"];
        assert_eq!(keys(sequence), expected);
        assert!(sequence["wall_max_over_median"].as_f64().expect("a ratio") >= 1.0);
        let frames = sequence["frames"].as_array().expect("frames");
        let places: Vec<(u64, f64)> = frames
            .iter()
            .map(|frame| (frame["frame"].as_u64().expect("a number"), frame["seconds"].as_f64().expect("a time")))
            .collect();
        assert_eq!(places, [(0, 0.0), (2, 0.25), (4, 0.5), (6, 0.75), (8, 1.0)]);
        for frame in frames {
            assert!(frame["wall_ratio"].as_f64().expect("a ratio") > 0.0);
            assert!(frame["penumbra"].as_u64().expect("a count") > 0);
            assert!(frame["rmse_all"].as_f64() <= frame["rmse"].as_f64());
        }
        // The file's pose is that of the first frame, and `rays` knows no past.
        assert_eq!(frames[0]["rmse"], still["errors"]["masks"]["penumbra"]["rmse"]);
        assert_eq!(frames[0]["rays"], still["rays"]);
        assert_eq!((&frames[0]["flicker"], &frames[0]["ghost_area"]), (&Value::Null, &json!(0.0)));
        // All pixels of all frames together: the weighted mean of the squares, to rounding.
        let numbers = |frame: &Value| ["penumbra", "rmse"].map(|name| frame[name].as_f64().expect("a number"));
        let [count, squares] = frames
            .iter()
            .map(numbers)
            .fold([0.0; 2], |[count, squares], [pixels, rmse]| [count + pixels, squares + pixels * rmse * rmse]);
        let pooled = outcome["errors"]["masks"]["penumbra"]["rmse"].as_f64().expect("an RMSE");
        assert!((pooled / f64::sqrt(squares / count) - 1.0).abs() < 1e-12, "{pooled}");
    }
}

#[test]
fn what_stands_still_does_not_flicker_and_sampling_never_settles() {
    let directory = tempfile::tempdir().expect("a directory");
    let suite = TINY.replace("\"16x12\", ", "").replace("[[techniques]]", "frames = \"1-3\"\n[[techniques]]");
    succeed(directory.path(), &suite);
    let results = results(directory.path());
    for record in results["records"].as_array().expect("records") {
        let stability = &record["outcome"]["sequence"]["stability"];
        assert_eq!(keys(stability), ["flicker", "ghost_area", "settling"]);
        // The same image each time.
        assert_eq!((&stability["flicker"], &stability["ghost_area"]), (&json!(0.0), &json!(0.0)));
        let settling = stability["settling"].as_array().expect("an array");
        let kinds: Vec<(&Value, &Value)> = settling.iter().map(|found| (&found["since"], &found["error"])).collect();
        // All that is seen has been so from the start.
        assert_eq!(kinds, [(&json!("start"), &json!(1.0 / 255.0)), (&json!("start"), &json!(0.01))]);
        let penumbra = record["outcome"]["errors"]["masks"]["penumbra"]["count"].as_u64().expect("a count");
        for found in settling {
            assert_eq!(found["points"].as_u64().expect("a count") * 3, penumbra);
            // At once or never.
            assert!(found["median"].is_null() || found["median"] == 1, "{found}");
        }
        // Of 4 or 16 samples at least one of the many pixels is off by more than 1e-2.
        assert!(settling[1]["never"].as_f64().expect("a share") > 0.0);
    }
    let mut reader = csv::Reader::from_path(directory.path().join("out/results.csv")).expect("a table");
    let header: Vec<String> = reader.headers().expect("a header").iter().map(str::to_owned).collect();
    let row = reader.records().next().expect("a row").expect("as long as the header");
    let cell = |name: &str| &row[header.iter().position(|column| column == name).expect(name)];
    assert_eq!(["frames", "flicker", "ghost_area"].map(cell), ["3", "0", "0"]);
    assert!(!cell("start_frames_to_0.01_never").is_empty() && cell("disocclusion_frames_to_8bit_median").is_empty());
}

#[test]
fn a_sequence_that_is_done_is_not_done_again() {
    let directory = tempfile::tempdir().expect("a directory");
    moving_scene(directory.path());
    succeed(directory.path(), EXPERIMENTS);
    let before = results(directory.path());
    let [stdout, _] = succeed(directory.path(), EXPERIMENTS);
    assert!(stdout.starts_with("0 configurations measured, 5 kept"), "{stdout}");
    assert_eq!(results(directory.path()), before);
    // Another speed is another sequence; what stands still stays.
    let [stdout, _] = succeed(directory.path(), &EXPERIMENTS.replace("fps = 8", "fps = 9"));
    assert!(stdout.starts_with("2 configurations measured, 3 kept"), "{stdout}");
}

#[test]
fn an_experiment_is_a_section_with_what_the_paper_says() {
    let directory = tempfile::tempdir().expect("a directory");
    moving_scene(directory.path());
    succeed(directory.path(), EXPERIMENTS);
    let html = fs::read_to_string(directory.path().join("out/report.html")).expect("a report");
    for text in [
        "A shadow that moves</h2>",
        "It should be &lt;smooth&gt;.",
        "Samples</h2>",
        "× rays pattern=grid samples=4",
        "moving, light, 32x24, frames 0 to 8: frame by frame</h3>",
        "moving, light, 32x24: by samples</h3>",
        "frames to an error",
    ] {
        assert!(html.contains(text), "{text}");
    }
    // Frame by frame and by samples: time, error and points of the light. Two a group: its hulls.
    assert_eq!(html.matches("<svg ").count(), 3 + 3 + 2 * 2);
    // Of the sequence two frames each of two settings, with differences and SSIM, and of the reference; of the image three and one.
    assert_eq!(html.matches("src=\"data:image/png;base64,").count(), (2 * 2 * 3 + 2) + (3 * 3 + 1));
    assert!(!html.contains("NaN") && !html.contains("undefined"));
}

#[test]
fn only_some_experiments_can_be_run() {
    let directory = tempfile::tempdir().expect("a directory");
    moving_scene(directory.path());
    fs::write(directory.path().join("suite.toml"), EXPERIMENTS).expect("writes");
    let run = |only: &[&str]| {
        let mut command = command(directory.path(), "suite.toml");
        command.args(only.iter().flat_map(|only| ["--only", only]));
        let run = command.output().expect("runs");
        let texts = [run.stdout, run.stderr].map(|bytes| String::from_utf8(bytes).expect("UTF-8"));
        (run.status.code(), texts)
    };
    let (code, [_, errors]) = run(&["flicker"]);
    assert_eq!(code, Some(2));
    assert!(
        errors.starts_with("error: --only flicker: ") && errors.contains("A shadow that moves; Samples"),
        "{errors}"
    );
    let (_, [stdout, _]) = run(&["SAMPLES"]);
    assert!(stdout.starts_with("3 configurations measured, 0 kept"), "{stdout}");
    let html = fs::read_to_string(directory.path().join("out/report.html")).expect("a report");
    assert!(html.contains("Samples</h2>") && !html.contains("A shadow that moves"));
    let (_, [stdout, _]) = run(&["moves", "samples"]);
    assert!(stdout.starts_with("2 configurations measured, 3 kept"), "{stdout}");
}

#[test]
fn experiments_that_ask_for_the_same_share_it() {
    let directory = tempfile::tempdir().expect("a directory");
    moving_scene(directory.path());
    let start = EXPERIMENTS.find("[[experiments]]\ntitle = \"Samples\"").expect("there");
    let again = EXPERIMENTS[start..].replace("Samples", "Again").replace("[4, 16, 64]", "64");
    let suite = format!("{}{again}", EXPERIMENTS.replace("fps", "name = \"crossing\"\nfps"));
    let [stdout, _] = succeed(directory.path(), &suite);
    assert!(stdout.starts_with("5 configurations measured, 0 kept"), "{stdout}");
    let results = results(directory.path());
    let records = results["records"].as_array().expect("records");
    assert_eq!((records.len(), &records[4]["experiments"]), (5, &json!(["Samples", "Again"])));
    let html = fs::read_to_string(directory.path().join("out/report.html")).expect("a report");
    assert!(html.contains("Again</h2>") && html.matches("pattern=grid samples=64</td>").count() >= 2);

    // One of them alone leaves it to the other too.
    let mut command = command(directory.path(), "suite.toml");
    assert!(command.args(["--only", "Again"]).status().expect("runs").success());
    let records = &self::results(directory.path())["records"];
    let shared = records
        .as_array()
        .expect("records")
        .iter()
        .filter(|record| record["experiments"].as_array().is_some_and(|e| e.len() == 2));
    assert_eq!(shared.count(), 1);
}

#[test]
fn mistakes_in_experiments_are_told_with_their_line() {
    let base = EXPERIMENTS.replace("moving.glb", "procedural:square").replace("animation = \"cross\"\n", "");
    let with = |from: &str, to: &str| {
        assert!(base.contains(from), "{from}");
        base.replacen(from, to, 1)
    };
    let cases = [
        (with("title = \"Samples\"", "title = \"A shadow that moves\""), "a title that no other experiment has"),
        (with("title = \"Samples\"", "title = \" \""), "line 21: expected a title"),
        (with("title = \"Samples\"", ""), "missing field `title`"),
        (with("samples = 4,", "samples = [4, 5],"), "line 8: baseline: expected one setting, found 2"),
        (with("x = \"samples\"", "x = \"pattern\""), "line 22: x: expected a parameter"),
        (with("0-8:2", "8-0"), "line 12: frames: expected A <= B"),
        (with("fps = 8", "fps = -1"), "line 12: fps: expected a number"),
        (with("fps = 8", "animation = \"none\""), "line 11: --animation: \"none\" is not there"),
        (with("[0, 4]", "[0, 5]"), "line 12: show: 5 is not one of the frames"),
        (with("frames = \"0-8:2\"", ""), "line 11: `fps`, `animation` and `show` are for a scene with `frames`"),
        (with("0-8:2", "0-99999").replace("[4, 16]", "[4, 5, 6]"), "more than 250000 frames"),
        (with("sizes = [\"32x24\"]", ""), "sizes is empty"),
        (base.clone() + "[[scenes]]\nscene = \"procedural:square\"", "in them; expected none beside them"),
    ];
    for (suite, reason) in cases {
        refuse(&suite, reason);
    }
}
