//! `bench`: techniques measured against each other and against the exact answer, over a suite of scenes.
//!
//! A suite ([`suite`]) is read and checked as a whole, then measured configuration by configuration ([`measure`], and [`sequence`]
//! where the scene moves); after each, [`results`] are on disk, and a later run goes on from there. [`report`] draws what [`analysis`] makes of them.

pub mod analysis;
pub mod chart;
pub mod measure;
pub mod motion;
pub mod report;
pub mod results;
pub mod sequence;
pub mod suite;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use image::DynamicImage;
use image::imageops::FilterType;

use self::measure::Subject;
use self::results::{Machine, Outcome, Record, Results};
use self::sequence::MovingSubject;
use self::suite::{Configuration, Group, Plan};
use crate::image::{Image, write_png};
use crate::metrics::{self, Map};
use crate::progress::Progress;
use crate::techniques::Context;
use crate::{Error, Result};

/// What happens, for who waits.
#[derive(Debug, Clone)]
pub enum Event {
    /// So many configurations will be measured.
    Planned(usize),
    /// Something has begun.
    Started(String),
    /// A configuration is through.
    Finished,
    /// What a reader should know.
    Warning(String),
}

/// How it went.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Summary {
    /// Configurations measured now.
    pub measured: usize,
    /// Configurations that had been measured before.
    pub kept: usize,
    /// Configurations that can't be done.
    pub failed: usize,
    /// Configurations that this machine can't run.
    pub skipped: usize,
    /// What to look at.
    pub report: PathBuf,
}

/// Where everything goes.
struct Places<'a> {
    directory: &'a Path,
    cache: PathBuf,
}

/// Width of the report's pictures, pixels, at most.
const PICTURE_WIDTH: u32 = 480;

impl Places<'_> {
    fn results(&self) -> PathBuf {
        self.directory.join("results.json")
    }

    fn write_results(&self, results: &Results) -> Result<()> {
        results.write(&self.results())
    }

    fn write_visibility(&self, key: &str, image: &Image) -> Result<()> {
        let picture = image.visibility_png(&image.light_names()[0]).expect("every light has visibility");
        write_png(&picture_path(self.directory, key), at_most(picture.into()))
    }

    fn write_errors(&self, key: &str, image: &Image, reference: &Image) -> Result<()> {
        let light = &image.light_names()[0];
        for (path, map) in
            [(difference_path(self.directory, key), Map::Difference), (ssim_path(self.directory, key), Map::Ssim)]
        {
            write_png(&path, at_most(metrics::heatmap(image, reference, light, map)?.into()))?;
        }
        Ok(())
    }
}

/// The picture of a configuration's visibility, or of a group's reference.
fn picture_path(directory: &Path, key: &str) -> PathBuf {
    directory.join("pictures").join(format!("{key}.png"))
}

/// The picture of how a configuration differs from its reference.
fn difference_path(directory: &Path, key: &str) -> PathBuf {
    directory.join("pictures").join(format!("{key}.difference.png"))
}

/// The picture of a configuration's structural similarity to its reference.
fn ssim_path(directory: &Path, key: &str) -> PathBuf {
    directory.join("pictures").join(format!("{key}.ssim.png"))
}

/// What a frame's pictures are found by.
fn frame_key(key: &str, frame: u32) -> String {
    format!("{key}.{frame}")
}

fn at_most(picture: DynamicImage) -> DynamicImage {
    if picture.width() <= PICTURE_WIDTH {
        return picture;
    }
    picture.resize(PICTURE_WIDTH, u32::MAX, FilterType::Triangle)
}

/// Runs a suite, or `only` those of its experiments whose titles hold one of these texts: what `directory` holds already is
/// kept, the rest is measured.
///
/// # Errors
/// A suite or results that can't be read, in one line; [`Error::Cancelled`], with everything that is done on disk. What a
/// single configuration can't do is a record.
pub fn run(
    suite: &Path,
    only: &[String],
    directory: &Path,
    cache: Option<&Path>,
    progress: &Progress,
    watch: &mut dyn FnMut(Event),
) -> Result<Summary> {
    let machine = Machine::this();
    watch(Event::Started("checking the suite".into()));
    let plan = Plan::read(suite, only, &machine, progress)?;
    let places = Places { directory, cache: cache.map_or_else(|| directory.join("cache"), Path::to_path_buf) };
    let mut results = Results::read(&places.results())?;
    fs::create_dir_all(directory.join("pictures")).map_err(|cause| Error::io(directory, cause))?;

    results.suite.clone_from(&plan.name);
    let mut summary = Summary { report: directory.join("report.html"), ..Summary::default() };
    let mut to_do: Vec<&Configuration> = Vec::new();
    // Experiments may ask for the same.
    let mut keys = BTreeSet::new();
    for configuration in plan.configurations.iter().filter(|configuration| keys.insert(&configuration.key)) {
        let group = &plan.groups[configuration.group];
        let record = |outcome| Record::new(configuration, group, &machine, outcome);
        if let Some(message) = &configuration.skipped {
            results.put(record(Outcome::Skipped { message: message.clone() }));
            summary.skipped += 1;
            continue;
        }
        match results.find(&configuration.key).filter(|found| found.measured().is_some()).cloned() {
            // Names may have changed; of experiments that are left out this time nothing is known.
            Some(Record { outcome, date, experiments, .. }) => {
                let mut kept = Record { date, ..record(outcome) };
                kept.experiments.extend(experiments.into_iter().filter(|title| !only.is_empty() && !plan.holds(title)));
                results.put(kept);
                summary.kept += 1;
            }
            None => to_do.push(configuration),
        }
    }
    results.sort(&plan.configurations);
    places.write_results(&results)?;

    watch(Event::Planned(to_do.len()));
    let measured = measure_all(&plan, &to_do, &machine, &places, &mut results, &mut summary, progress, watch);
    // What is done is reported even where the rest was cancelled.
    results.sort(&plan.configurations);
    places.write_results(&results)?;
    results.write_csv(&directory.join("results.csv"))?;
    report::write(&summary.report, &plan, &results, directory)?;
    measured.map(|()| summary)
}

#[expect(clippy::too_many_arguments, reason = "all of a run's state, used once")]
fn measure_all(
    plan: &Plan,
    to_do: &[&Configuration],
    machine: &Machine,
    places: &Places,
    results: &mut Results,
    summary: &mut Summary,
    progress: &Progress,
    watch: &mut dyn FnMut(Event),
) -> Result<()> {
    for (index, group) in plan.groups.iter().enumerate() {
        let configurations: Vec<&&Configuration> = to_do.iter().filter(|c| c.group == index).collect();
        if configurations.is_empty() {
            continue;
        }
        watch(Event::Started(format!("{}: reference", group.label())));
        let subject = match subject(group, places, progress) {
            Err(Error::Cancelled) => return Err(Error::Cancelled),
            Ok((subject, warnings)) => {
                warnings.into_iter().for_each(|warning| watch(Event::Warning(warning)));
                Ok(subject)
            }
            Err(error) => Err(error.to_string()),
        };
        for configuration in configurations {
            watch(Event::Started(format!("{}: {} {}", group.label(), configuration.entry.name, configuration.label())));
            let outcome = match &subject {
                Err(message) => Err(message.clone()),
                Ok(subject) => match measure(configuration, subject, plan, places, progress) {
                    Err(Error::Cancelled) => return Err(Error::Cancelled),
                    outcome => outcome.map_err(|error| error.to_string()),
                },
            };
            let outcome = outcome.unwrap_or_else(|message| Outcome::Failed { message });
            match &outcome {
                Outcome::Done(_) => summary.measured += 1,
                Outcome::Failed { .. } | Outcome::Skipped { .. } => summary.failed += 1,
            }
            results.put(Record::new(configuration, group, machine, outcome));
            places.write_results(results)?;
            watch(Event::Finished);
        }
    }
    Ok(())
}

/// What a group's techniques are held against.
enum Truth<'a> {
    Still(Box<Subject>),
    Moving(Box<MovingSubject<'a>>),
}

fn subject<'a>(group: &'a Group, places: &Places, progress: &Progress) -> Result<(Truth<'a>, Vec<String>)> {
    match &group.frames {
        None => {
            let (subject, warnings) = Subject::new(group.load()?, group.size, &places.cache, progress)?;
            places.write_visibility(&group.key, &subject.reference)?;
            Ok((Truth::Still(Box::new(subject)), warnings))
        }
        Some(frames) => {
            let show = |frame, image: &Image| places.write_visibility(&frame_key(&group.key, frame), image);
            let (subject, warnings) = MovingSubject::new(group, frames, &places.cache, progress, show)?;
            Ok((Truth::Moving(Box::new(subject)), warnings))
        }
    }
}

fn measure(
    configuration: &Configuration,
    subject: &Truth,
    plan: &Plan,
    places: &Places,
    progress: &Progress,
) -> Result<Outcome> {
    // A context of its own: what a GPU held at most is then this configuration's.
    let context = Context::default();
    let technique = (configuration.entry.build)(&context, &configuration.settings)?;
    let key = &configuration.key;
    let measured = match subject {
        Truth::Still(subject) => {
            let (measured, image) = subject.measure(technique.as_ref(), plan.timing, progress)?;
            places.write_visibility(key, &image)?;
            places.write_errors(key, &image, &subject.reference)?;
            measured
        }
        Truth::Moving(subject) => {
            let (measured, shown) = subject.measure(technique.as_ref(), plan.timing, progress)?;
            for shown in shown {
                let key = frame_key(key, shown.frame);
                places.write_visibility(&key, &shown.image)?;
                places.write_errors(&key, &shown.image, &shown.reference)?;
            }
            measured
        }
    };
    Ok(Outcome::Done(Box::new(measured)))
}
