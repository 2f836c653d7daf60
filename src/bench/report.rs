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
use super::chart::{COLORS, Chart, Labels, Mark, Scale, Series, short};
use super::results::{FrameRecord, Measured, Outcome, Record, Results, SequenceRecord, Times};
use super::suite::{Experiment, Group, Plan, Sweep, label};
use super::{difference_path, frame_key, picture_path, ssim_path};
use crate::metrics::{self, SMALL_ERRORS, Since};
use crate::output::write_atomically;
use crate::techniques::BEST;
use crate::{Error, Result};

/// Errors to which times are told (`docs/bench.md`).
const TARGETS: [f64; 3] = [1e-2, 3e-3, 1e-3];

/// What an error is in charts.
const RMSE: &str = "RMSE of visibility, penumbra";

/// What a technique takes of the light, in charts: its maps may be several a point.
const POINTS: &str = "points of the light";

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
    frame_ratio: fn(&FrameRecord) -> f64,
}

const CLOCKS: [Clock; 2] = [
    Clock {
        name: "wall",
        axis: "time of a whole frame, ms",
        time: |time| time.wall_ms,
        ratio: |time| time.baseline.wall_ratio,
        baseline: |time| time.baseline.wall_ms,
        frame_ratio: |frame| frame.wall_ratio,
    },
    Clock {
        name: "render",
        axis: "time of the technique alone, ms",
        time: |time| time.render_ms,
        ratio: |time| time.baseline.render_ratio,
        baseline: |time| time.baseline.render_ms,
        frame_ratio: |frame| frame.render_ratio,
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
    refused: Vec<Refused>,
    sections: Vec<Section<'a>>,
    /// Records of earlier suites, which are not shown.
    others: usize,
}

/// An experiment.
#[derive(Debug, Serialize)]
struct Section<'a> {
    id: usize,
    /// Empty where the suite has no experiments.
    title: &'a str,
    paper: &'a str,
    summary: Option<Summary>,
    charts: Vec<ScalingView>,
    overview: Vec<Overview>,
    scaling: Vec<ScalingView>,
    groups: Vec<GroupView>,
}

/// An experiment's figures in one table.
#[derive(Debug, Serialize)]
struct Summary {
    baseline: Option<String>,
    /// Whether some group is a sequence.
    moving: bool,
    /// Frames whose errors are told apart.
    shown: Vec<u32>,
    settling: Vec<SettlingHeading>,
    groups: Vec<SummaryGroup>,
}

/// Which frames to which error a column has.
#[derive(Debug, Serialize)]
struct SettlingHeading {
    since: &'static str,
    error: String,
}

#[derive(Debug, Serialize)]
struct SummaryGroup {
    id: usize,
    name: String,
    /// Whether it is a sequence.
    moving: bool,
    rows: Vec<SummaryRow>,
}

#[derive(Debug, Serialize)]
struct SummaryRow {
    number: usize,
    technique: String,
    label: String,
    shadow_maps: u32,
    samples: u32,
    /// Read, millions.
    texels: String,
    rmse: String,
    ssim: String,
    flip: String,
    ratio: String,
    /// Frame rates over the baseline's: of the whole frame, of the technique alone.
    rates: Vec<String>,
    memory: String,
    frame: String,
    slowest: String,
    flicker: String,
    ghost_area: String,
    settling: Vec<String>,
    shown: Vec<String>,
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
    /// Of a sequence.
    frames: Option<usize>,
    sampled: u64,
    references: Vec<Picture>,
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
    pictures: Vec<Picture>,
    parts: Vec<Part>,
}

/// A picture of visibility, and of how far off and how unlike it is.
#[derive(Debug, Serialize)]
struct Picture {
    caption: String,
    visibility: Option<String>,
    difference: Option<String>,
    ssim: Option<String>,
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

/// How times, errors and other figures change with one thing, the rest being equal.
#[derive(Debug, Serialize)]
struct ScalingView {
    title: String,
    charts: Vec<Chart>,
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
    /// The sequences that were measured.
    fn sequences(&self) -> impl Iterator<Item = &SequenceRecord> {
        self.records.iter().filter_map(|(_, measured)| measured.sequence.as_ref())
    }

    /// The techniques' names, in the order in which they turn up.
    fn techniques(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for (record, _) in &self.records {
            if !names.contains(&record.technique.as_str()) {
                names.push(&record.technique);
            }
        }
        names
    }

    /// The numbers of the frames that the report shows.
    fn shown(&self) -> &[u32] {
        self.group.frames.as_ref().map_or(&[], |frames| &frames.shown)
    }

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
        refused,
        sections: plan.experiments.iter().enumerate().map(|(id, of)| section(id, of, &found, directory)).collect(),
        // Experiments may share a record.
        others: results.records.len() - unique(shown.iter().map(|record| record.key.clone()).collect()).len(),
    }
}

fn section<'a>(id: usize, experiment: &'a Experiment, found: &[Found], directory: &Path) -> Section<'a> {
    let first = experiment.groups.start;
    let found = &found[experiment.groups.clone()];
    let mut charts: Vec<ScalingView> = experiment.x.iter().flat_map(|x| sweep_views(x, found)).collect();
    charts.extend(found.iter().filter_map(frame_view));
    let views = found.iter().enumerate().map(|(i, found)| group_view(first + i, found, directory));
    Section {
        id,
        title: &experiment.title,
        paper: &experiment.paper,
        summary: summary(experiment, found),
        charts,
        overview: CLOCKS.iter().map(|clock| overview(found, first, *clock)).collect(),
        scaling: scaling(found),
        groups: views.collect(),
    }
}

/// The figures of an experiment or of sequences; none of a plain suite of single images, whose groups have it all.
fn summary(experiment: &Experiment, found: &[Found]) -> Option<Summary> {
    let sequences = || found.iter().flat_map(Found::sequences);
    let moving = sequences().next().is_some();
    if experiment.title.is_empty() && !moving {
        return None;
    }
    let mut shown: Vec<u32> =
        found.iter().filter_map(|found| found.group.frames.as_ref()).flat_map(|frames| frames.shown.clone()).collect();
    shown.sort_unstable();
    shown.dedup();
    let kinds: Vec<(Since, f64)> = [Since::Start, Since::Disocclusion]
        .into_iter()
        .flat_map(|since| SMALL_ERRORS.map(|error| (since, error)))
        .filter(|&(since, error)| sequences().any(|sequence| sequence.stability.settling(since, error).is_some()))
        .collect();
    let heading = |&(since, error): &(Since, f64)| {
        let since = match since {
            Since::Start => "from the start",
            Since::Disocclusion => "disoccluded",
        };
        let error = if error == SMALL_ERRORS[0] { "1/255".to_owned() } else { error.to_string() };
        SettlingHeading { since, error }
    };
    let group = |(i, found): (usize, &Found)| {
        let baseline = experiment.baseline.as_ref().and_then(|baseline| {
            let is_it =
                |record: &Record| record.technique == baseline.technique && record.parameters == baseline.parameters;
            found.records.iter().find(|(record, _)| is_it(record)).map(|(_, measured)| *measured)
        });
        let row = |(number, (record, measured)): (usize, &(&Record, &Measured))| {
            let penumbra = measured.errors.masks.get(&metrics::Mask::Penumbra).copied().unwrap_or_default();
            let time = &measured.time;
            let sequence = measured.sequence.as_ref();
            let stability = sequence.map(|sequence| &sequence.stability);
            let settling = |&(since, error): &(Since, f64)| {
                let frames = |frames: Option<u32>| frames.map_or_else(|| "∞".into(), |frames| frames.to_string());
                stability.and_then(|stability| stability.settling(since, error)).map_or_else(
                    || "–".into(),
                    |found| {
                        format!("{} / {} / {} %", frames(found.median), frames(found.p95), short(100.0 * found.never))
                    },
                )
            };
            let at = |number: &u32| {
                let frame = sequence.and_then(|sequence| sequence.frames.iter().find(|frame| frame.frame == *number));
                number_or_none(frame.and_then(|frame| frame.rmse))
            };
            let rate = |clock: &Clock| baseline.map_or_else(|| "–".into(), |base| short(rate(measured, base, *clock)));
            SummaryRow {
                number: number + 1,
                technique: record.technique.clone(),
                label: label(&record.technique, &record.preset, &record.settings),
                shadow_maps: measured.shadow_maps,
                samples: measured.samples,
                texels: short(measured.texels as f64 / 1e6),
                rmse: number_or_none(penumbra.rmse),
                ssim: number_or_none(penumbra.ssim),
                flip: number_or_none(penumbra.flip),
                ratio: short(time.baseline.wall_ratio.median),
                rates: CLOCKS.iter().map(rate).collect(),
                memory: memory(measured),
                frame: format!(
                    "{} ({} to {})",
                    short(time.wall_ms.median),
                    short(time.wall_ms.q1),
                    short(time.wall_ms.q3)
                ),
                slowest: sequence.map_or_else(
                    || "–".into(),
                    |of| format!("{} / {}", short(of.wall_max_over_median), short(of.render_max_over_median)),
                ),
                flicker: number_or_none(stability.and_then(|stability| stability.flicker)),
                ghost_area: stability
                    .and_then(|stability| stability.ghost_area)
                    .map_or_else(|| "–".into(), |share| format!("{} %", short(100.0 * share))),
                settling: kinds.iter().map(settling).collect(),
                shown: shown.iter().map(at).collect(),
            }
        };
        SummaryGroup {
            id: experiment.groups.start + i,
            name: found.group.label(),
            moving: found.group.frames.is_some(),
            rows: found.records.iter().enumerate().map(row).collect(),
        }
    };
    Some(Summary {
        baseline: experiment.baseline.as_ref().map(|baseline| baseline.name.clone()),
        moving,
        settling: kinds.iter().map(heading).collect(),
        groups: found.iter().enumerate().map(group).collect(),
        shown,
    })
}

/// Frames a second over another's: by the ratios to `rays` that each was run in turn with; of sequences the median over their
/// frames.
fn rate(of: &Measured, over: &Measured, clock: Clock) -> f64 {
    let single = (clock.ratio)(&over.time).median / (clock.ratio)(&of.time).median;
    let frames = of.sequence.as_ref().zip(over.sequence.as_ref()).and_then(|(of, over)| {
        let rates = of.frames.iter().zip(&over.frames);
        Spread::of(rates.map(|(of, over)| (clock.frame_ratio)(over) / (clock.frame_ratio)(of)).collect())
    });
    frames.map_or(single, |rates| rates.median)
}

/// On a GPU that of its allocator, else the process's, MB.
fn memory(measured: &Measured) -> String {
    let memory = &measured.memory_mb;
    if memory.gpu > 0.0 { short(memory.gpu) } else { number_or_none(memory.peak_rss) }
}

fn number_or_none(value: Option<f64>) -> String {
    value.map_or_else(|| "–".into(), short)
}

fn overview(found: &[Found], first: usize, clock: Clock) -> Overview {
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
        OverviewRow { id: first + id, name: found[id].group.label(), cells: techniques.iter().map(cells).collect() }
    };
    Overview { clock: clock.name, rows: points.iter().enumerate().map(row).collect(), techniques }
}

fn group_view(id: usize, found: &Found, directory: &Path) -> GroupView {
    let first = found.records.first().map(|(_, measured)| *measured);
    let names = found.techniques();
    let mut colors = PassColors::default();
    let rows = found
        .records
        .iter()
        .enumerate()
        .map(|(i, (record, measured))| row(i + 1, record, measured, (&names, found.shown()), &mut colors, directory))
        .collect();
    GroupView {
        id,
        name: found.group.label(),
        source: found.group.source.clone(),
        triangles: found.group.triangles,
        penumbra: first.and_then(|m| m.errors.masks.get(&metrics::Mask::Penumbra)).map_or(0, |errors| errors.count),
        frames: found.group.frames.as_ref().map(|frames| frames.numbers.len()),
        sampled: first.map_or(0, |measured| measured.reference.sampled_receivers),
        references: references(found, directory),
        views: CLOCKS.iter().map(|clock| clock_view(found, *clock)).collect(),
        rows,
        passes: colors.0.into_iter().map(|(name, color)| PassColor { name, color }).collect(),
    }
}

/// The pictures of a group's exact answers.
fn references(found: &Found, directory: &Path) -> Vec<Picture> {
    let picture = |key: &str, caption: String| Picture {
        caption,
        visibility: data_uri(&picture_path(directory, key)),
        difference: None,
        ssim: None,
    };
    let key = &found.group.key;
    match found.group.frames {
        None => vec![picture(key, "exact V".into())],
        Some(_) => {
            let frame = |&frame: &u32| picture(&frame_key(key, frame), format!("exact V, frame {frame}"));
            found.shown().iter().map(frame).collect()
        }
    }
}

/// The pictures of a record: one of a single image, else those of the frames that are shown.
fn pictures(record: &Record, measured: &Measured, number: usize, shown: &[u32], directory: &Path) -> Vec<Picture> {
    let picture = |key: &str, caption: String| Picture {
        caption,
        visibility: data_uri(&picture_path(directory, key)),
        difference: data_uri(&difference_path(directory, key)),
        ssim: data_uri(&ssim_path(directory, key)),
    };
    let name = format!("{number}: {}", describe(record));
    let Some(sequence) = &measured.sequence else {
        let rmse = number_or_none(penumbra_rmse(measured));
        let ratio = short(measured.time.baseline.wall_ratio.median);
        return vec![picture(&record.key, format!("{name}; RMSE {rmse}, {ratio} × rays 64"))];
    };
    let frames = sequence.frames.iter().filter(|frame| shown.contains(&frame.frame));
    frames
        .map(|frame| {
            let caption = format!("{name}; frame {}, RMSE {}", frame.frame, number_or_none(frame.rmse));
            picture(&frame_key(&record.key, frame.frame), caption)
        })
        .collect()
}

fn color_of(techniques: &[&str], record: &Record) -> &'static str {
    let series = techniques.iter().position(|name| *name == record.technique).unwrap_or_default();
    COLORS[series % COLORS.len()]
}

fn describe(record: &Record) -> String {
    format!("{} {}", record.technique, label(&record.technique, &record.preset, &record.settings))
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
    let labels = Labels { x: clock.axis, x_scale: Scale::Log, y: RMSE, top };
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
    (techniques, shown): (&[&str], &[u32]),
    colors: &mut PassColors,
    directory: &Path,
) -> Row {
    let time = &measured.time;
    let errors = |mask| measured.errors.masks.get(&mask).copied().unwrap_or_default();
    let penumbra = errors(metrics::Mask::Penumbra);
    let outliers = |outliers: Option<metrics::Outliers>| outliers.map_or_else(|| "–".into(), |o| o.count.to_string());
    Row {
        number,
        technique: record.technique.clone(),
        color: color_of(techniques, record),
        label: label(&record.technique, &record.preset, &record.settings),
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
        pictures: pictures(record, measured, number, shown, directory),
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
    let mut lines = Lines::default();
    for (x, found) in family {
        for (record, measured) in &found.records {
            let line = lines.line(describe(record));
            line.push((*x, [Some((CLOCKS[0].time)(&measured.time).median), drawn_rmse(penumbra_rmse(measured)), None]));
        }
    }
    lines.view(title, (variable, Scale::Log), [CLOCKS[0].axis, RMSE, ""])
}

/// What a chart can show of an error.
fn drawn_rmse(rmse: Option<f64>) -> Option<f64> {
    rmse.map(|error| error.max(LEAST_ERROR))
}

/// A place along a chart's lower axis with the heights of as many charts as there are.
type Place = (f64, [Option<f64>; 3]);

/// Lines by name, for three charts over the same lower axis.
#[derive(Debug, Default)]
struct Lines(Vec<(String, Vec<Place>)>);

impl Lines {
    fn line(&mut self, name: String) -> &mut Vec<Place> {
        let index = self.0.iter().position(|(known, _)| *known == name).unwrap_or_else(|| {
            self.0.push((name, Vec::new()));
            self.0.len() - 1
        });
        &mut self.0[index].1
    }

    /// Their charts; those without a point are left out.
    fn view(mut self, title: String, (x, x_scale): (&str, Scale), y: [&str; 3]) -> ScalingView {
        let left_out = self.0.len().saturating_sub(MOST_LINES);
        self.0.truncate(MOST_LINES);
        for (_, places) in &mut self.0 {
            places.sort_by(|a, b| a.0.total_cmp(&b.0));
        }
        let chart = |(i, y): (usize, &str)| {
            let series = |(name, places): &(String, Vec<Place>)| {
                // Nothing has no place on a logarithmic axis.
                let points: Vec<[f64; 2]> = places
                    .iter()
                    .filter_map(|(x, values)| Some([*x, values[i].filter(|value| *value > 0.0)?]))
                    .collect();
                let mark = |&at: &[f64; 2]| Mark {
                    at,
                    title: format!("{name}\n{} {x}: {}", short(at[0]), short(at[1])),
                    number: String::new(),
                    hollow: false,
                };
                Series { name: name.clone(), marks: points.iter().map(mark).collect(), line: points }
            };
            let series: Vec<Series> = self.0.iter().map(series).collect();
            Chart::new(&series, Labels { x, x_scale, y, top: None })
        };
        ScalingView { title, charts: y.into_iter().enumerate().filter_map(chart).collect(), left_out }
    }
}

/// A record's name among others: without the settings that all of its technique have.
fn name_among(record: &Record, others: &[&Record], without: Option<&str>) -> String {
    let same = || others.iter().filter(|other| other.technique == record.technique);
    let told_apart = |key: &str, value: &serde_json::Value| {
        Some(key) != without && same().any(|other| other.settings.get(key) != Some(value))
    };
    let mut settings = record.settings.clone();
    settings.retain(|key, value| told_apart(key, value));
    let is_alone = settings.is_empty() && same().all(|other| other.preset == record.preset);
    if is_alone {
        record.technique.clone()
    } else {
        format!("{} {}", record.technique, label(&record.technique, &record.preset, &settings))
    }
}

/// Charts of a sequence's frames.
fn frame_view(found: &Found) -> Option<ScalingView> {
    found.sequences().next()?;
    let records: Vec<&Record> = found.records.iter().map(|(record, _)| *record).collect();
    let mut lines = Lines::default();
    for (record, measured) in &found.records {
        let Some(sequence) = &measured.sequence else { continue };
        let line = lines.line(name_among(record, &records, None));
        for (i, frame) in sequence.frames.iter().enumerate() {
            // As in the other charts, what the machine did otherwise at the time is taken out by the baseline.
            let baselines = found.sequences().filter_map(|sequence| Some(sequence.frames.get(i)?.baseline_render_ms));
            let baseline = Spread::of(baselines.collect()).map_or(f64::NAN, |spread| spread.median);
            let points = Some(f64::from(frame.samples));
            line.push((f64::from(frame.frame), [Some(frame.render_ratio * baseline), drawn_rmse(frame.rmse), points]));
        }
    }
    let title = format!("{}: frame by frame", found.group.label());
    Some(lines.view(title, ("frame", Scale::Linear), [CLOCKS[1].axis, RMSE, POINTS]))
}

/// Charts of what an experiment varies.
fn sweep_views(x: &Sweep, found: &[Found]) -> Vec<ScalingView> {
    let records: Vec<&Record> = found.iter().flat_map(|found| &found.records).map(|(record, _)| *record).collect();
    let (name, parameter) = match x {
        Sweep::Parameter(name) => (name.as_str(), Some(name.as_str())),
        Sweep::Scene(name) => (name.as_str(), None),
    };
    // What a scene's name varies makes one chart of all scenes; a parameter makes one of each group.
    let mut views: Vec<(String, Lines)> = Vec::new();
    for found in found {
        let title = match x {
            Sweep::Parameter(_) => found.group.label(),
            Sweep::Scene(_) => format!("{}, {}x{}", found.group.light.name, found.group.size[0], found.group.size[1]),
        };
        if views.iter().all(|(known, _)| *known != title) {
            views.push((title.clone(), Lines::default()));
        }
        let (_, lines) = views.iter_mut().find(|(known, _)| *known == title).expect("just added");
        for (record, measured) in &found.records {
            let value = match x {
                Sweep::Parameter(name) => record.parameters[name.as_str()].as_f64(),
                Sweep::Scene(name) => found.group.scene_value(name),
            };
            let Some(value) = value else { continue };
            let ratio = measured.time.baseline.wall_ratio.median;
            let points = Some(f64::from(measured.samples));
            let figures = [points, drawn_rmse(penumbra_rmse(measured)), Some(ratio)];
            lines.line(name_among(record, &records, parameter)).push((value, figures));
        }
    }
    let labels = [POINTS, RMSE, "whole frame, times rays 64"];
    let view = |(title, lines): (String, Lines)| {
        let values = lines.0.iter().flat_map(|(_, places)| places).map(|(x, _)| *x);
        let [low, high] = values.fold([f64::INFINITY, 0.0], |[low, high], x| [f64::min(low, x), f64::max(high, x)]);
        let scale = if low > 0.0 && high >= WIDE * low { Scale::Log } else { Scale::Linear };
        lines.view(format!("{title}: by {name}"), (name, scale), labels)
    };
    views.into_iter().map(view).collect()
}

/// From this ratio of the largest to the smallest on, values are laid out by their logarithms.
const WIDE: f64 = 8.0;

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
            "samples": 1, "rays": 1, "shadow_maps": 0, "texels": 0,
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
        let plan = Plan::read(&path, &[], &Machine::this(), &Progress::default()).expect("a suite");
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

        let overview = overview(std::slice::from_ref(&found), 0, CLOCKS[0]);
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
