//! `penumbra bench`, end to end.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use assert_cmd::cargo::CommandCargoExt;
use penumbra::techniques::{ALL, Entry, Needs};
use serde_json::Value;

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
    assert_eq!((&results["version"], &results["suite"]), (&1.into(), &"suite".into()));
    let records = results["records"].as_array().expect("records");
    assert_eq!(records.len(), 4);
    let widths: Vec<&Value> = records.iter().map(|record| &record["size"][0]).collect();
    assert_eq!(widths, [16, 16, 24, 24]);
    for (record, samples) in records.iter().zip([4, 16, 4, 16]) {
        let expected = [
            "key",
            "scene",
            "source",
            "triangles",
            "light",
            "size",
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

fn check_outcome(outcome: &Value, size: &[Value], samples: u64) {
    let expected =
        ["status", "time", "memory_mb", "samples", "rays", "shadow_maps", "reference", "pixels", "errors", "notes"];
    assert_eq!(keys(outcome), expected);
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
    // Two pictures a configuration, one a group; two charts a group, with a marker for each configuration.
    assert_eq!(html.matches("src=\"data:image/png;base64,").count(), 2 * 4 + 2);
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
        ("sizes = [\"9x9\"]".into(), "line 1: missing field `scenes`"),
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
        ("{}", "expected results of version 1, found null"),
        ("{\"version\": 2}", "expected results of version 1, found 2"),
        ("{\"version\": 1, \"suite\": \"a\", \"records\": [{}]}", "missing field"),
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
        let plan = Plan::read(Path::new(name), &Machine::this(), &Progress::default()).expect(name);
        let sizes: BTreeSet<_> = plan.groups.iter().map(|group| group.size).collect();
        assert!(sizes.len() >= 2, "{name}: a time at one size says little");
        assert!(plan.configurations.len() >= plan.groups.len(), "{name}");
    }
}
