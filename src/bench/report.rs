//! `report.html`: one file, pictures included, that needs no network.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use minijinja::value::Serde;
use minijinja::{Environment, context};
use serde::Serialize;

use super::analysis::{EQUAL_TIME, LEAST_ERROR, Point, Spread, error_at, hull, time_to};
use super::chart::{COLORS, Chart, Labels, Mark, Series, short};
use super::results::{Measured, Outcome, Record, Results, Times};
use super::suite::{Group, Plan, label};
use super::{difference_path, picture_path};
use crate::metrics;
use crate::output::write_atomically;
use crate::techniques::BEST;
use crate::{Error, Result};

/// Errors to which times are told (`docs/bench.md`).
const TARGETS: [f64; 3] = [1e-2, 3e-3, 1e-3];

/// Lines of one chart of what something grows with, at most: more can't be told apart.
const MOST_LINES: usize = COLORS.len();

/// Which time is meant.
#[derive(Debug, Clone, Copy)]
struct Clock {
    /// In the page's script.
    name: &'static str,
    axis: &'static str,
    time: fn(&Times) -> Spread,
    ratio: fn(&Times) -> Spread,
    baseline: fn(&Times) -> Spread,
}

const CLOCKS: [Clock; 2] = [
    Clock {
        name: "wall",
        axis: "time of a whole frame, ms",
        time: |time| time.wall_ms,
        ratio: |time| time.baseline.wall_ratio,
        baseline: |time| time.baseline.wall_ms,
    },
    Clock {
        name: "render",
        axis: "time of the technique alone, ms",
        time: |time| time.render_ms,
        ratio: |time| time.baseline.render_ratio,
        baseline: |time| time.baseline.render_ms,
    },
];

/// Everything that the template shows.
#[derive(Debug, Serialize)]
struct Page<'a> {
    name: &'a str,
    about: &'a str,
    version: &'static str,
    date: String,
    machines: Vec<String>,
    adapters: Vec<String>,
    /// Whether any time is one of a processor.
    software: bool,
    runs: u32,
    seconds: f64,
    targets: Vec<String>,
    overview: Vec<Overview>,
    refused: Vec<Refused>,
    groups: Vec<GroupView>,
    scaling: Vec<ScalingView>,
    /// Records of earlier suites, which are not shown.
    others: usize,
}

/// Times to the targets, of one clock.
#[derive(Debug, Serialize)]
struct Overview {
    clock: &'static str,
    techniques: Vec<String>,
    rows: Vec<OverviewRow>,
}

#[derive(Debug, Serialize)]
struct OverviewRow {
    id: usize,
    name: String,
    /// By technique, then by target.
    cells: Vec<Vec<String>>,
}

#[derive(Debug, Serialize)]
struct Refused {
    what: String,
    status: &'static str,
    message: String,
}

#[derive(Debug, Serialize)]
struct GroupView {
    id: usize,
    name: String,
    source: String,
    triangles: u64,
    penumbra: u64,
    sampled: u64,
    reference: Option<String>,
    views: Vec<ClockView>,
    rows: Vec<Row>,
    passes: Vec<PassColor>,
}

#[derive(Debug, Serialize)]
struct ClockView {
    clock: &'static str,
    chart: Option<Chart>,
    techniques: Vec<String>,
    comparisons: Vec<Comparison>,
}

/// A point of a hull with what every technique has for its time and for its error.
#[derive(Debug, Serialize)]
struct Comparison {
    name: String,
    time: String,
    error: String,
    at_equal_time: Vec<Cell>,
    at_equal_error: Vec<Cell>,
}

#[derive(Debug, Default, Serialize)]
struct Cell {
    text: String,
    /// Over that of the row's own.
    ratio: Option<String>,
    better: bool,
}

#[derive(Debug, Serialize)]
struct Row {
    number: usize,
    technique: String,
    color: &'static str,
    label: String,
    parameters: String,
    wall: String,
    wall_quartiles: String,
    render: String,
    ratio: String,
    runs: u32,
    rmse: String,
    mae: String,
    p99: String,
    max: String,
    bias: String,
    ssim: String,
    flip: String,
    rmse_shadow: String,
    rmse_all: String,
    false_umbra: String,
    false_light: String,
    banding: String,
    rss: String,
    gpu: String,
    samples: u32,
    rays: u64,
    shadow_maps: u32,
    adapter: String,
    notes: Vec<String>,
    picture: Option<String>,
    difference: Option<String>,
    parts: Vec<Part>,
}

/// A part of a frame's time.
#[derive(Debug, Clone, Serialize)]
struct Part {
    name: String,
    ms: String,
    percent: f64,
    color: &'static str,
}

#[derive(Debug, Serialize)]
struct PassColor {
    name: String,
    color: &'static str,
}

/// How times and errors change with one thing, the rest being equal.
#[derive(Debug, Serialize)]
struct ScalingView {
    title: String,
    time: Option<Chart>,
    error: Option<Chart>,
    left_out: usize,
}

/// A technique with its points, each with the index of its record in the group.
type Technique = (String, Vec<(usize, Point)>);

/// A group with its records that were measured.
struct Found<'a> {
    group: &'a Group,
    records: Vec<(&'a Record, &'a Measured)>,
}

impl Found<'_> {
    /// Median of the baseline's times, ms: all of the group's ratios are to it.
    fn baseline(&self, clock: Clock) -> f64 {
        let medians = self.records.iter().map(|(_, measured)| (clock.baseline)(&measured.time).median).collect();
        Spread::of(medians).map_or(f64::NAN, |spread| spread.median)
    }

    /// Time and penumbra error by technique, with the index of the record. The time is the ratio to the baseline in ms of the
    /// baseline's median, so that a load that came and went favours nobody.
    fn points(&self, clock: Clock) -> Vec<Technique> {
        let baseline = self.baseline(clock);
        let mut techniques: Vec<Technique> = Vec::new();
        for (i, (record, measured)) in self.records.iter().enumerate() {
            let Some(error) = penumbra_rmse(measured) else { continue };
            let point = Point { time: (clock.ratio)(&measured.time).median * baseline, error };
            match techniques.iter_mut().find(|(name, _)| *name == record.technique) {
                Some((_, points)) => points.push((i, point)),
                None => techniques.push((record.technique.clone(), vec![(i, point)])),
            }
        }
        techniques
    }
}

fn penumbra_rmse(measured: &Measured) -> Option<f64> {
    measured.errors.masks.get(&metrics::Mask::Penumbra)?.rmse
}

/// The points of a hull, in its order.
fn hull_of(points: &[(usize, Point)]) -> Vec<(usize, Point)> {
    let only: Vec<Point> = points.iter().map(|(_, point)| *point).collect();
    hull(&only).into_iter().map(|i| points[i]).collect()
}

/// Writes the report of what the plan asks for.
pub fn write(path: &Path, plan: &Plan, results: &Results, directory: &Path) -> Result<()> {
    let page = page(plan, results, directory);
    let mut environment = Environment::new();
    environment.add_template("report.html", include_str!("report.html")).expect("the template is valid");
    let template = environment.get_template("report.html").expect("it was added");
    let html = template.render(context! { page => Serde(&page) }).expect("the template fits its data");
    write_atomically(path, |file| file.write_all(html.as_bytes()).map_err(|cause| Error::io(path, cause)))
}

fn page<'a>(plan: &'a Plan, results: &Results, directory: &Path) -> Page<'a> {
    let records: BTreeMap<&str, &Record> = results.records.iter().map(|record| (record.key.as_str(), record)).collect();
    let mut found: Vec<Found> = plan.groups.iter().map(|group| Found { group, records: Vec::new() }).collect();
    let mut refused = Vec::new();
    let mut shown: Vec<&Record> = Vec::new();
    for configuration in &plan.configurations {
        let Some(&record) = records.get(configuration.key.as_str()) else { continue };
        shown.push(record);
        let group = &mut found[configuration.group];
        let (status, message) = match &record.outcome {
            Outcome::Done(measured) => {
                group.records.push((record, measured));
                continue;
            }
            Outcome::Failed { message } => ("failed", message),
            Outcome::Skipped { message } => ("skipped", message),
        };
        let what = format!("{} {} on {}", record.technique, configuration.label(), group.group.label());
        refused.push(Refused { what, status, message: message.clone() });
    }
    let unique = |mut texts: Vec<String>| {
        texts.sort();
        texts.dedup();
        texts
    };
    let machine = |record: &&Record| {
        let machine = &record.machine;
        format!("{}, {}, {} threads", machine.processor, machine.system, machine.threads)
    };
    let adapters = shown.iter().filter_map(|record| record.adapter.as_ref());
    let adapter = |adapter: &super::results::AdapterRecord| {
        let kind = if adapter.backend != "cpu" && adapter.software { ", software" } else { "" };
        format!("{} ({}{kind})", adapter.name, adapter.backend)
    };
    Page {
        name: &plan.name,
        about: plan.about.trim(),
        version: env!("CARGO_PKG_VERSION"),
        date: humantime::format_rfc3339_seconds(std::time::SystemTime::now()).to_string(),
        machines: unique(shown.iter().map(machine).collect()),
        adapters: unique(adapters.clone().map(adapter).collect()),
        software: adapters.clone().any(|adapter| adapter.software),
        runs: plan.timing.runs,
        seconds: plan.timing.seconds,
        targets: TARGETS.iter().map(ToString::to_string).collect(),
        overview: CLOCKS.iter().map(|clock| overview(&found, *clock)).collect(),
        refused,
        groups: found.iter().enumerate().map(|(id, found)| group_view(id, found, directory)).collect(),
        scaling: scaling(&found),
        others: results.records.len() - shown.len(),
    }
}

fn overview(found: &[Found], clock: Clock) -> Overview {
    let points: Vec<_> = found.iter().map(|found| found.points(clock)).collect();
    let mut techniques: Vec<String> = Vec::new();
    for (name, _) in points.iter().flatten() {
        if !techniques.contains(name) {
            techniques.push(name.clone());
        }
    }
    let row = |(id, points): (usize, &Vec<Technique>)| {
        let cells = |technique: &String| {
            let points = points.iter().find(|(name, _)| name == technique);
            let hull: Vec<Point> =
                points.map_or_else(Vec::new, |(_, points)| hull_of(points).iter().map(|(_, point)| *point).collect());
            let cell = |target: &f64| match time_to(&hull, *target) {
                Some(time) => short(time),
                None => hull.last().map_or_else(|| "–".into(), |best| format!("best {}", short(best.error))),
            };
            TARGETS.iter().map(cell).collect()
        };
        OverviewRow { id, name: found[id].group.label(), cells: techniques.iter().map(cells).collect() }
    };
    Overview { clock: clock.name, rows: points.iter().enumerate().map(row).collect(), techniques }
}

fn group_view(id: usize, found: &Found, directory: &Path) -> GroupView {
    let first = found.records.first().map(|(_, measured)| *measured);
    let mut names: Vec<String> = Vec::new();
    for (record, _) in &found.records {
        if !names.contains(&record.technique) {
            names.push(record.technique.clone());
        }
    }
    let mut colors = PassColors::default();
    let rows = found
        .records
        .iter()
        .enumerate()
        .map(|(i, (record, measured))| row(i + 1, record, measured, &names, &mut colors, directory))
        .collect();
    GroupView {
        id,
        name: found.group.label(),
        source: found.group.source.clone(),
        triangles: found.group.triangles,
        penumbra: first.and_then(|m| m.errors.masks.get(&metrics::Mask::Penumbra)).map_or(0, |errors| errors.count),
        sampled: first.map_or(0, |measured| measured.reference.sampled_receivers),
        reference: data_uri(&picture_path(directory, &found.group.key)),
        views: CLOCKS.iter().map(|clock| clock_view(found, *clock)).collect(),
        rows,
        passes: colors.0.into_iter().map(|(name, color)| PassColor { name, color }).collect(),
    }
}

fn describe(record: &Record) -> String {
    format!("{} {}", record.technique, label(&record.preset, &record.settings))
}

fn clock_view(found: &Found, clock: Clock) -> ClockView {
    let points = found.points(clock);
    let hulls: Vec<Vec<(usize, Point)>> = points.iter().map(|(_, points)| hull_of(points)).collect();
    let at = |point: Point| [point.time, point.error.max(LEAST_ERROR)];
    let series: Vec<Series> = points
        .iter()
        .zip(&hulls)
        .map(|((name, points), hull)| {
            let mark = |&(i, point): &(usize, Point)| {
                let (record, measured) = found.records[i];
                Mark {
                    at: at(point),
                    title: format!(
                        "{}: {}\n{} ms, {} × rays samples=64\nRMSE {}",
                        i + 1,
                        describe(record),
                        short(point.time),
                        short((clock.ratio)(&measured.time).median),
                        short(point.error)
                    ),
                    number: (i + 1).to_string(),
                    hollow: record.preset != BEST && record.preset != "demo",
                }
            };
            Series {
                name: name.clone(),
                marks: points.iter().map(mark).collect(),
                line: hull.iter().map(|(_, point)| at(*point)).collect(),
            }
        })
        .collect();
    let top = Some(("times that of rays with 64 samples", found.baseline(clock)));
    let labels = Labels { x: clock.axis, y: "RMSE of visibility, penumbra", top };
    ClockView {
        clock: clock.name,
        chart: Chart::new(&series, labels),
        techniques: points.iter().map(|(name, _)| name.clone()).collect(),
        comparisons: comparisons(found, &points, &hulls),
    }
}

/// What every technique has for the time and for the error of each point of a hull.
fn comparisons(found: &Found, points: &[Technique], hulls: &[Vec<(usize, Point)>]) -> Vec<Comparison> {
    if hulls.len() < 2 {
        return Vec::new();
    }
    let mut anchors: Vec<(usize, usize, Point)> =
        hulls.iter().enumerate().flat_map(|(t, hull)| hull.iter().map(move |&(i, point)| (t, i, point))).collect();
    anchors.sort_by(|a, b| a.2.time.total_cmp(&b.2.time));
    let hulls: Vec<Vec<Point>> = hulls.iter().map(|hull| hull.iter().map(|(_, point)| *point).collect()).collect();
    anchors
        .into_iter()
        .map(|(own, index, anchor)| {
            let cell = |value: Option<(f64, bool)>, of: f64| match value {
                None => Cell { text: "–".into(), ..Cell::default() },
                Some((value, measured)) => Cell {
                    text: format!("{}{}", if measured { "" } else { "~" }, short(value)),
                    ratio: (of > 0.0).then(|| short(value / of)),
                    better: value < of,
                },
            };
            let of_technique = |t: usize| {
                if t == own {
                    return [Cell::default(), Cell::default()];
                }
                let same_time = points[t].1.iter().map(|(_, point)| *point);
                let same_time = same_time.filter(|point| (point.time / anchor.time - 1.0).abs() <= EQUAL_TIME);
                let measured = same_time.map(|point| point.error).min_by(f64::total_cmp).map(|error| (error, true));
                let error = measured.or_else(|| Some((error_at(&hulls[t], anchor.time)?, false)));
                let time = time_to(&hulls[t], anchor.error).map(|time| (time, false));
                [cell(error, anchor.error), cell(time, anchor.time)]
            };
            let (at_equal_time, at_equal_error) =
                (0..hulls.len()).map(of_technique).map(|[time, error]| (time, error)).unzip();
            Comparison {
                name: format!("{} {}", index + 1, describe(found.records[index].0)),
                time: short(anchor.time),
                error: short(anchor.error),
                at_equal_time,
                at_equal_error,
            }
        })
        .collect()
}

/// The colours of passes, in the order in which they turn up.
#[derive(Debug, Default)]
struct PassColors(Vec<(String, &'static str)>);

impl PassColors {
    fn of(&mut self, name: &str) -> &'static str {
        if let Some((_, color)) = self.0.iter().find(|(known, _)| known == name) {
            return color;
        }
        let color = COLORS[self.0.len() % COLORS.len()];
        self.0.push((name.to_owned(), color));
        color
    }
}

/// Parts of a frame below this share of it are not drawn.
const LEAST_SHARE: f64 = 0.005;

/// A whole frame's time by pass: what the passes leave of building, of the technique, and of the frame has its own part.
fn parts(time: &Times, colors: &mut PassColors) -> Vec<Part> {
    let sum = |passes: &[super::results::PassTime]| passes.iter().map(|pass| pass.ms).sum::<f64>();
    let (build, render, wall) = (time.build_ms.median, time.render_ms.median, time.wall_ms.median);
    let mut parts: Vec<(&str, f64)> = vec![("building", build - sum(&time.build_passes))];
    parts.extend(time.build_passes.iter().map(|pass| (pass.name.as_str(), pass.ms)));
    parts.extend(time.passes.iter().map(|pass| (pass.name.as_str(), pass.ms)));
    parts.push(("rest of the technique", render - sum(&time.passes)));
    parts.push(("rest of the frame", wall - build - render));
    let whole: f64 = parts.iter().map(|(_, ms)| ms.max(0.0)).sum();
    parts
        .into_iter()
        .filter(|(_, ms)| *ms > LEAST_SHARE * whole)
        .map(|(name, ms)| Part {
            name: name.to_owned(),
            ms: short(ms),
            percent: (1e4 * ms / whole).round() / 100.0,
            color: colors.of(name),
        })
        .collect()
}

fn row(
    number: usize,
    record: &Record,
    measured: &Measured,
    techniques: &[String],
    colors: &mut PassColors,
    directory: &Path,
) -> Row {
    let time = &measured.time;
    let errors = |mask| measured.errors.masks.get(&mask).copied().unwrap_or_default();
    let penumbra = errors(metrics::Mask::Penumbra);
    let number_or_none = |value: Option<f64>| value.map_or_else(|| "–".into(), short);
    let outliers = |outliers: Option<metrics::Outliers>| outliers.map_or_else(|| "–".into(), |o| o.count.to_string());
    let series = techniques.iter().position(|name| *name == record.technique).unwrap_or_default();
    Row {
        number,
        technique: record.technique.clone(),
        color: COLORS[series % COLORS.len()],
        label: label(&record.preset, &record.settings),
        parameters: record.parameters.to_string(),
        wall: short(time.wall_ms.median),
        wall_quartiles: format!("{} to {}", short(time.wall_ms.q1), short(time.wall_ms.q3)),
        render: short(time.render_ms.median),
        ratio: short(time.baseline.wall_ratio.median),
        runs: time.runs,
        rmse: number_or_none(penumbra.rmse),
        mae: number_or_none(penumbra.mae),
        p99: number_or_none(penumbra.p99),
        max: number_or_none(penumbra.max),
        bias: number_or_none(penumbra.bias),
        ssim: number_or_none(penumbra.ssim),
        flip: number_or_none(penumbra.flip),
        rmse_shadow: number_or_none(errors(metrics::Mask::Shadow).rmse),
        rmse_all: number_or_none(errors(metrics::Mask::All).rmse),
        false_umbra: outliers(measured.errors.false_umbra),
        false_light: outliers(measured.errors.false_light),
        banding: number_or_none(measured.errors.banding_rmse_per_px),
        rss: number_or_none(measured.memory_mb.peak_rss),
        gpu: short(measured.memory_mb.gpu),
        samples: measured.samples,
        rays: measured.rays,
        shadow_maps: measured.shadow_maps,
        adapter: record.adapter.as_ref().map_or_else(|| "–".into(), |adapter| adapter.name.clone()),
        notes: measured.notes.clone(),
        picture: data_uri(&picture_path(directory, &record.key)),
        difference: data_uri(&difference_path(directory, &record.key)),
        parts: parts(time, colors),
    }
}

/// A picture's file as text that a page can hold; none where somebody has removed it.
fn data_uri(path: &Path) -> Option<String> {
    let bytes = fs::read(path).ok()?;
    Some(format!("data:image/png;base64,{}", BASE64_STANDARD.encode(bytes)))
}

/// What groups may differ in, one at a time.
struct Variable {
    name: &'static str,
    value: fn(&Group) -> Option<f64>,
    /// What has to be equal; none where the group is not to be drawn.
    rest: fn(&Group) -> Option<String>,
}

const VARIABLES: [Variable; 3] = [
    Variable {
        name: "triangles",
        value: |group| Some(group.triangles as f64),
        rest: |group| {
            Some(format!("{}, {}, {}x{}", group.family.as_ref()?, group.light.name, group.size[0], group.size[1]))
        },
    },
    Variable {
        name: "pixels",
        value: |group| Some(f64::from(group.size[0]) * f64::from(group.size[1])),
        rest: |group| Some(format!("{}, {}", group.scene, group.light.name)),
    },
    Variable {
        name: "size of the light over its distance",
        value: |group| group.light.extent.filter(|extent| *extent > 0.0),
        rest: |group| Some(format!("{}, {}x{}", group.scene, group.size[0], group.size[1])),
    },
];

/// Charts of what groups differ in, where at least three of them do in nothing else.
fn scaling(found: &[Found]) -> Vec<ScalingView> {
    let mut views = Vec::new();
    for variable in VARIABLES {
        let mut families: Vec<(String, Vec<(f64, &Found)>)> = Vec::new();
        for found in found {
            let (value, rest) = ((variable.value)(found.group), (variable.rest)(found.group));
            let Some((value, rest)) = value.zip(rest) else { continue };
            match families.iter_mut().find(|(name, _)| *name == rest) {
                Some((_, family)) => family.push((value, found)),
                None => families.push((rest, vec![(value, found)])),
            }
        }
        for (name, mut family) in families {
            family.sort_by(|a, b| a.0.total_cmp(&b.0));
            let mut values: Vec<f64> = family.iter().map(|(value, _)| *value).collect();
            values.dedup();
            if values.len() >= 3 {
                views.push(scaling_view(format!("{name}: by {}", variable.name), variable.name, &family));
            }
        }
    }
    views
}

fn scaling_view(title: String, variable: &str, family: &[(f64, &Found)]) -> ScalingView {
    let mut names: Vec<String> = Vec::new();
    for (record, _) in family.iter().flat_map(|(_, found)| &found.records) {
        let name = describe(record);
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let left_out = names.len().saturating_sub(MOST_LINES);
    names.truncate(MOST_LINES);
    let series = |value: &dyn Fn(&Measured) -> Option<f64>| -> Vec<Series> {
        names
            .iter()
            .map(|name| {
                let points: Vec<[f64; 2]> = family
                    .iter()
                    .filter_map(|(x, found)| {
                        let (_, measured) = found.records.iter().find(|(record, _)| describe(record) == *name)?;
                        Some([*x, value(measured)?])
                    })
                    .collect();
                let mark = |&at: &[f64; 2]| Mark {
                    at,
                    title: format!("{name}\n{} {variable}: {}", short(at[0]), short(at[1])),
                    number: String::new(),
                    hollow: false,
                };
                Series { name: name.clone(), marks: points.iter().map(mark).collect(), line: points }
            })
            .collect()
    };
    let labels = |y| Labels { x: variable, y, top: None };
    let wall = CLOCKS[0];
    ScalingView {
        title,
        time: Chart::new(&series(&|measured| Some((wall.time)(&measured.time).median)), labels(wall.axis)),
        error: Chart::new(
            &series(&|measured| penumbra_rmse(measured).map(|error| error.max(LEAST_ERROR))),
            labels("RMSE of visibility, penumbra"),
        ),
        left_out,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bench::results::Machine;
    use crate::progress::Progress;

    const SUITE: &str = r#"
        sizes = ["8x6"]
        [[scenes]]
        scene = "procedural:square"
        [[techniques]]
        technique = "rays"
        set = { samples = [1, 2, 3, 4, 5] }
    "#;

    /// What a run leaves, with times (as ratios to a baseline of 10 ms) and errors of our choice.
    fn record(plan: &Plan, index: usize, technique: &str, ratio: f64, rmse: f64) -> Record {
        let spread = |x: f64| serde_json::json!({"median": x, "q1": x, "q3": x});
        let outcome = serde_json::json!({
            "status": "done",
            "time": {
                "runs": 5, "wall_ms": spread(99.0), "build_ms": spread(9.0), "render_ms": spread(80.0),
                "build_passes": [], "passes": [{"name": "rays", "ms": 60.0}],
                "baseline": {
                    "runs": 5, "wall_ms": spread(10.0), "render_ms": spread(10.0),
                    "wall_ratio": spread(ratio), "render_ratio": spread(ratio),
                },
            },
            "memory_mb": {"peak_rss": null, "gpu": 0.0},
            "samples": 1, "rays": 1, "shadow_maps": 0,
            "reference": {"method": "exact", "sampled_receivers": 0},
            "pixels": {"compared": 48, "uncovered": 0, "coverage_differs": 0, "position_differs": 0},
            "errors": {
                "name": "light", "reference_name": "light",
                "masks": {"penumbra": {"count": 9, "rmse": rmse}},
            },
            "notes": [],
        });
        let configuration = &plan.configurations[index];
        let outcome = serde_json::from_value(outcome).expect("an outcome");
        let record = Record::new(configuration, &plan.groups[0], &Machine::this(), outcome);
        Record { technique: technique.into(), ..record }
    }

    #[test]
    fn equal_time_is_measured_within_five_percent_and_equal_error_interpolated() {
        let directory = tempfile::tempdir().expect("a directory");
        let path = directory.path().join("suite.toml");
        fs::write(&path, SUITE).expect("writes");
        let plan = Plan::read(&path, &Machine::this(), &Progress::default()).expect("a suite");
        let records = [
            record(&plan, 0, "rays", 1.0, 0.1),
            record(&plan, 1, "rays", 100.0, 0.001),
            record(&plan, 2, "other", 1.04, 0.05),
            record(&plan, 3, "other", 10.0, 0.02),
        ];
        let records: Vec<&Record> = records.iter().collect();
        let measured = |record: &&'_ Record| record.measured().expect("measured").clone();
        let measured: Vec<Measured> = records.iter().map(measured).collect();
        let found = Found { group: &plan.groups[0], records: records.into_iter().zip(&measured).collect() };
        let view = clock_view(&found, CLOCKS[0]);
        assert_eq!(view.techniques, ["rays", "other"]);
        let rows: Vec<[&str; 3]> =
            view.comparisons.iter().map(|row| [row.name.as_str(), &row.time, &row.error]).collect();
        let expected = [
            ["1 rays samples=1", "10.0", "0.100"],
            ["3 other samples=3", "10.4", "0.0500"],
            ["4 other samples=4", "100", "0.0200"],
            ["2 rays samples=2", "1000", "0.00100"],
        ];
        assert_eq!(rows, expected);
        let cells = |row: usize, technique: usize| {
            let row = &view.comparisons[row];
            [&row.at_equal_time, &row.at_equal_error].map(|cells| cells[technique].text.as_str())
        };
        // Row 1: `other` has a setting 4 % slower, and reaches 0.1 with its fastest.
        assert_eq!(cells(0, 1), ["0.0500", "~10.4"]);
        assert_eq!(cells(0, 0), ["", ""]);
        // Row 2: 10 ms is 3.8 % less than 10.4. Along the hull e = 0.1/(t/10): 0.05 takes 20 ms.
        assert_eq!(cells(1, 0), ["0.100", "~20.0"]);
        // Row 3: nothing of `rays` near 100 ms; the hull has 0.01 there, and 0.02 at 50.
        assert_eq!(cells(2, 0), ["~0.0100", "~50.0"]);
        // Row 4: `other` has no use for more time, and never gets to 0.001.
        assert_eq!(cells(3, 1), ["~0.0200", "–"]);
        assert!(view.comparisons[2].at_equal_error[0].better && !view.comparisons[1].at_equal_error[0].better);
        assert_eq!(view.comparisons[2].at_equal_error[0].ratio.as_deref(), Some("0.500"));

        let overview = overview(std::slice::from_ref(&found), CLOCKS[0]);
        // `rays`: e = 1/t. `other`: its best is 0.02.
        assert_eq!(overview.rows[0].cells, [["100", "333", "1000"], ["best 0.0200"; 3]]);
    }

    #[test]
    fn parts_of_a_frame_add_up() {
        let spread = |x: f64| Spread { median: x, q1: x, q3: x };
        let pass = |name: &str, ms: f64| super::super::results::PassTime { name: name.into(), ms };
        let one = spread(1.0);
        let baseline = super::super::results::Baseline {
            runs: 5,
            wall_ms: one,
            render_ms: one,
            wall_ratio: one,
            render_ratio: one,
        };
        let time = Times {
            runs: 5,
            wall_ms: spread(100.0),
            build_ms: spread(30.0),
            render_ms: spread(69.9),
            build_passes: vec![pass("G-buffer", 10.0)],
            passes: vec![pass("maps", 40.0), pass("filter", 20.0)],
            baseline,
        };
        let parts = parts(&time, &mut PassColors::default());
        let shown: Vec<(&str, &str)> = parts.iter().map(|part| (part.name.as_str(), part.ms.as_str())).collect();
        // The 0.1 ms outside of both is less than can be seen.
        let expected = [
            ("building", "20.0"),
            ("G-buffer", "10.0"),
            ("maps", "40.0"),
            ("filter", "20.0"),
            ("rest of the technique", "9.90"),
        ];
        assert_eq!(shown, expected);
        assert_eq!(parts[2].percent, 40.0);
    }
}
