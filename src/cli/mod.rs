//! The command line: one file a subcommand.

mod bench;
mod compare;
mod demo;
pub(crate) mod frames;
mod info;
mod list;
mod reference;
mod render;
pub(crate) mod report;
pub(crate) mod scene_options;

use std::io::Write;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::Context;
use clap::{Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use crate::progress::Progress;
use crate::{Error, output};

/// Soft shadows whose accuracy is a number.
///
/// Renders how much of each area light every point of a scene sees, and measures one such image against another.
#[derive(Debug, Parser)]
#[command(name = "penumbra", version, max_term_width = 110, after_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    /// Writes progress to stderr as lines `progress: PERCENT LABEL`, for programs that run this one
    #[arg(long, global = true, hide_short_help = true)]
    progress: bool,
}

const EXAMPLES: &str = "\
Examples:
  penumbra demo                                             see what this machine can do
  penumbra render scene.glb -o out.png                      the lights of a glTF scene, as visibility
  penumbra render model.glb -o out.exr --add-light auto --add-floor
  penumbra reference model.glb -o truth.exr --add-light auto --add-floor
  penumbra compare out.exr truth.exr --heatmap error.png    how far off, in numbers and as a picture
  penumbra bench quick -o bench                             what each technique gives for its time";

#[derive(Debug, Subcommand)]
enum Command {
    /// Renders a scene's soft shadows.
    Render(render::Arguments),
    /// Renders the reference that others are judged by.
    Reference(reference::Arguments),
    /// Measures an image against a reference.
    Compare(compare::Arguments),
    /// Measures what techniques give for the time they take, and writes a report.
    Bench(bench::Arguments),
    /// Lists techniques with their parameters, and procedural scenes with theirs.
    List(list::Arguments),
    /// Shows what a scene holds.
    Info(info::Arguments),
    /// Renders a built-in scene in every way this machine can, on one contact sheet.
    Demo(demo::Arguments),
}

/// Runs the command line. Errors become one line on stderr.
pub fn main() -> ExitCode {
    let cli = Cli::parse_from(scene_options::with_floor_spelled_out(std::env::args_os()));
    let progress = Arc::new(Progress::new(cli.progress));
    stop_on_ctrl_c(Arc::clone(&progress));
    let result = match &cli.command {
        Command::Render(arguments) => render::run(arguments, &progress),
        Command::Reference(arguments) => reference::run(arguments, &progress),
        Command::Compare(arguments) => compare::run(arguments),
        Command::Bench(arguments) => bench::run(arguments, &progress),
        Command::List(arguments) => list::run(arguments),
        Command::Info(arguments) => info::run(arguments),
        Command::Demo(arguments) => demo::run(arguments, &progress),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            print_error(&error);
            let usage = matches!(error.downcast_ref::<Error>(), Some(Error::Usage { .. }));
            ExitCode::from(if usage { 2 } else { 1 })
        }
    }
}

fn print_error(error: &anyhow::Error) {
    // A chain's causes may span lines; the user gets one.
    let line = format!("{error:#}").replace('\n', " ");
    // Nobody left to tell if stderr is closed.
    let _ = writeln!(std::io::stderr(), "error: {line}");
}

/// Asks the work to stop, and ends the process for it when it has not within a second (while a file is being parsed, say).
fn stop_on_ctrl_c(progress: Arc<Progress>) {
    let handler = move || {
        progress.cancel();
        std::thread::sleep(Duration::from_millis(800));
        output::remove_unfinished();
        print_error(&Error::Cancelled.into());
        std::process::exit(1);
    };
    if let Err(error) = ctrlc::set_handler(handler) {
        log::warn!("Ctrl-C will not clean up: {error}");
    }
}

/// Runs `work` while a bar on stderr (if that is a terminal), or lines if they are asked for, show how far it is.
fn with_bar<T: Send>(label: &str, progress: &Progress, work: impl FnOnce() -> T + Send) -> T {
    let style = ProgressStyle::with_template("{msg:>12} [{bar:40}] {percent:>3} % {elapsed} (left: {eta})");
    let bar = ProgressBar::new(0).with_style(style.expect("the template is valid").progress_chars("=> "));
    bar.set_message(label.to_owned());
    let mut last_line = String::new();
    std::thread::scope(|scope| {
        let worker = scope.spawn(work);
        while !worker.is_finished() {
            let (done, total) = progress.state();
            if progress.as_lines {
                let line = format!("progress: {} {label}", 100 * done.min(total) / total.max(1));
                if line != last_line {
                    // Nobody left to tell if stderr is closed.
                    let _ = writeln!(std::io::stderr(), "{line}");
                    last_line = line;
                }
            } else {
                bar.set_length(total);
                bar.set_position(done);
            }
            std::thread::park_timeout(Duration::from_millis(20));
        }
        bar.finish_and_clear();
        worker.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// Prints a result to stdout.
fn print(text: &str) -> anyhow::Result<()> {
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{}", text.trim_end()).and_then(|()| stdout.flush()).context("stdout")
}

/// Prints a result to stdout as JSON.
fn print_json(value: &impl Serialize) -> anyhow::Result<()> {
    print(&serde_json::to_string_pretty(value)?)
}

/// Prints warnings to stderr, one a line.
fn print_warnings(warnings: &[String]) {
    for warning in warnings {
        // Nobody left to tell if stderr is closed.
        let _ = writeln!(std::io::stderr(), "warning: {warning}");
    }
}
