//! `penumbra bench`.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::{print, print_warnings};
use crate::bench::{self, Event, Summary};
use crate::progress::Progress;

/// Options of `bench`.
#[derive(Debug, Args)]
#[command(after_help = HELP)]
pub struct Arguments {
    /// Suite: a TOML file, or the name of one that is built in: quick, scaling, papers
    #[arg(value_name = "SUITE.toml")]
    suite: PathBuf,
    /// Directory for results.json, results.csv and report.html, made if it is not there. What it holds already is not measured
    /// again
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Runs only the experiments with TEXT in their titles, in any case; repeatable
    #[arg(long, value_name = "TEXT")]
    only: Vec<String>,
    /// Keeps exact references in this directory rather than in DIR/cache
    #[arg(long, value_name = "DIR")]
    cache: Option<PathBuf>,
}

const HELP: &str = "\
Built-in suites:
  quick      every technique on small scenes, at two sizes: less than two minutes on two cores
  scaling    time and error against triangles, samples, image size and size of the light
  papers     what the papers report, measured anew beside their own words (hours on a software GPU; see --only)

A suite multiplies out scenes, lights, image sizes, techniques and their settings:
  sizes = [\"320x240\", \"640x480\"]

  [[scenes]]
  scene = \"model.glb\"                 # or procedural:NAME?key=value
  add_floor = true                    # as on the command line; so are camera, light, add_light
  lights = [                          # a sweep over lights
      { name = \"small\", add_light = [\"rect:at=1/3/1,to=0/0/0,size=0.2\"] },
      { name = \"large\", add_light = [\"rect:at=1/3/1,to=0/0/0,size=1\"] },
  ]

  [[techniques]]
  technique = \"rays\"                  # or \"all\"
  preset = \"best\"                     # or a paper's, a list of them, \"all\"
  set = { samples = [4, 16, 64], pattern = [\"sobol\", \"grid\"] }

A scene with frames = \"0-47\" is a sequence. [[experiments]] have scenes and techniques of their own,
what a paper says about them, and a section of the report each; --only runs some of them.

Each configuration is judged against the exact reference, and timed in turn with `rays` at 64
samples: on a machine that does other work too, read the ratios. Ctrl-C keeps what is done; the
same command goes on from there.";

/// Runs the command.
pub fn run(arguments: &Arguments, progress: &Progress) -> anyhow::Result<()> {
    let style = ProgressStyle::with_template("[{bar:30}] {pos}/{len} {elapsed} (left: {eta}) {wide_msg}");
    let bar = ProgressBar::new(0).with_style(style.expect("the template is valid").progress_chars("=> "));
    bar.enable_steady_tick(Duration::from_millis(100));
    let mut watch = |event: Event| match event {
        Event::Planned(count) => {
            bar.set_length(count as u64);
            bar.reset();
        }
        Event::Started(what) => bar.set_message(what),
        Event::Finished => bar.inc(1),
        Event::Warning(warning) => bar.suspend(|| print_warnings(&[warning])),
    };
    let Arguments { suite, output, only, cache } = arguments;
    let result = bench::run(suite, only, output, cache.as_deref(), progress, &mut watch);
    bar.finish_and_clear();
    let summary = result?;
    print_warnings(&refusals(&summary));
    let Summary { measured, kept, report, .. } = &summary;
    print(&format!("{measured} configurations measured, {kept} kept from before; see {}", report.display()))
}

fn refusals(summary: &Summary) -> Vec<String> {
    let Summary { measured, kept, failed, skipped, .. } = summary;
    if failed + skipped == 0 {
        return Vec::new();
    }
    let total = measured + kept + failed + skipped;
    vec![format!("of {total} configurations {failed} failed and {skipped} were skipped: the report says why")]
}
