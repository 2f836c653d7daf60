//! `--frames`: an image for each frame of an animation.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

use clap::Args;

use super::render::ImageOptions;
use super::report::{Origin, finish_frame};
use super::scene_options::{LoadedScene, SceneOptions};
use super::{print_warnings, with_bar};
use crate::output;
use crate::progress::{Progress, ms_since};
use crate::render::{self, Request};
use crate::techniques::Technique;
use crate::{Error, Result};

/// Options of an animation.
#[derive(Debug, Args)]
pub struct FrameOptions {
    /// Renders frames A to B of the scene's animation, every STEP-th; frame F is at F / fps seconds.
    ///
    /// OUT is then a pattern: out.####.exr becomes out.0001.exr and so on; a single frame may go to a plain name. --json prints
    /// a record a line, with the frame's number and seconds. Cameras, lights and meshes move as the file says; before the first
    /// key and after the last one they stay. What --add-light and --add-floor add, and the camera that frames a scene without
    /// one, stay where they are: they are fitted to the whole animation, so that every frame of it gets the same.
    #[arg(long, value_name = "A-B[:STEP]", value_parser = parse_frames)]
    pub frames: Option<Frames>,
    /// Frames a second
    #[arg(long, value_name = "N", default_value_t = 24.0, value_parser = parse_fps, requires = "frames")]
    pub fps: f64,
    /// Animation to play, by name (see `penumbra info`) [default: the first]
    #[arg(long, value_name = "NAME", requires = "frames")]
    pub animation: Option<String>,
}

/// Which frames of an animation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frames {
    first: u32,
    last: u32,
    step: u32,
}

impl Frames {
    /// Their numbers, ascending.
    pub fn numbers(&self) -> std::iter::StepBy<std::ops::RangeInclusive<u32>> {
        (self.first..=self.last).step_by(self.step as usize)
    }
}

/// One of them.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Its number.
    pub number: u32,
    /// Its time, s.
    pub seconds: f64,
    /// Where its image goes.
    pub output: PathBuf,
}

/// Most frames of a run: more than an hour at 24 a second.
const MAX_FRAMES: u32 = 100_000;

/// The highest frame number: its digits fit any file name.
const MAX_FRAME: u32 = 999_999_999;

/// Reads the value of `--frames`.
pub fn parse_frames(text: &str) -> Result<Frames, String> {
    let number =
        |digits: &str| digits.bytes().all(|b| b.is_ascii_digit()).then(|| digits.parse::<u32>().ok()).flatten();
    let (range, step) = text.split_once(':').unwrap_or((text, "1"));
    let (first, last) = range.split_once('-').unwrap_or((range, range));
    let (Some(first), Some(last), Some(step)) = (number(first), number(last), number(step)) else {
        return Err("expected A, A-B or A-B:STEP, such as 1-24 or 0-100:10".into());
    };
    if last > MAX_FRAME {
        return Err(format!("expected frames up to {MAX_FRAME}"));
    }
    if first > last || step == 0 {
        return Err("expected A <= B and a STEP of at least 1".into());
    }
    if (last - first) / step >= MAX_FRAMES {
        return Err(format!("expected at most {MAX_FRAMES} frames; render them in several runs"));
    }
    Ok(Frames { first, last, step })
}

/// Reads the value of `--fps`.
pub fn parse_fps(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(fps) if (1e-3..=1e6).contains(&fps) => Ok(fps),
        _ => Err("expected a number from 0.001 to 1000000".into()),
    }
}

impl FrameOptions {
    /// The frames that are asked for, and where their images go; refuses what can't be written, before anything is computed.
    pub fn plan(&self, output: &Path) -> Result<Option<Vec<Frame>>> {
        let Some(frames) = self.frames else { return Ok(None) };
        let pattern = Pattern::of(output)?;
        let numbers = frames.numbers();
        if pattern.is_none() && numbers.clone().nth(1).is_some() {
            let message = "one file can't hold several frames; expected a pattern such as out.####.exr";
            return Err(Error::usage(format!("-o {}", output.display()), message));
        }
        let mut planned = Vec::new();
        for number in numbers {
            let output = pattern.as_ref().map_or_else(|| output.to_path_buf(), |pattern| pattern.path(number));
            output::check(&output)?;
            planned.push(Frame { number, seconds: f64::from(number) / self.fps, output });
        }
        Ok(Some(planned))
    }
}

/// What makes the images of frames.
pub struct Job<'a> {
    /// What is seen.
    pub scene: &'a SceneOptions,
    /// What the images show.
    pub image: &'a ImageOptions,
    /// What moves.
    pub options: &'a FrameOptions,
    /// Of the technique or reference method.
    pub name: &'a str,
    /// Built once for all frames.
    pub technique: &'a dyn Technique,
    /// See [`Request::verify`].
    pub verify: Option<u32>,
}

impl Job<'_> {
    /// Renders frame after frame; each image is in its place before the next one begins. `start` is when the run began.
    pub fn run(&self, frames: &[Frame], mut start: Instant, progress: &Progress) -> anyhow::Result<()> {
        let Self { scene: options, image, technique, verify, .. } = *self;
        let sequence = options.load_sequence(image.load_options(), self.options.animation.as_deref())?;
        let request = Request { verify, ..image.request(options.size) };
        let mut told: HashSet<String> = HashSet::new();
        let mut drawn = render::Sequence::new(technique);
        for (index, frame) in frames.iter().enumerate() {
            progress.check()?;
            let mut loaded = sequence.at(frame.seconds)?;
            let load_ms = ms_since(start);
            loaded.note_framing();
            let LoadedScene { scene, camera, .. } = &loaded;
            let is_new = |warning: &&String| told.insert((*warning).clone());
            let news: Vec<String> = scene.warnings.iter().filter(is_new).cloned().collect();
            print_warnings(&news);
            let label = format!("frame {}/{}", index + 1, frames.len());
            let rendering = with_bar(&label, progress, || drawn.frame(scene, camera, &request, progress))?;
            let origin = Origin { technique: self.name, parameters: technique.parameters() };
            finish_frame(image, scene, rendering, origin, Some(frame), start, load_ms)?;
            start = Instant::now();
        }
        Ok(())
    }
}

/// A path with a run of `#` in its file name.
struct Pattern<'a> {
    path: &'a Path,
    before: &'a str,
    digits: usize,
    after: &'a str,
}

impl<'a> Pattern<'a> {
    fn of(path: &'a Path) -> Result<Option<Self>> {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let Some(start) = name.find('#') else { return Ok(None) };
        let after = name[start..].trim_start_matches('#');
        if after.contains('#') {
            return Err(Error::usage(format!("-o {}", path.display()), "expected one run of # for the frame's number"));
        }
        Ok(Some(Self { path, before: &name[..start], digits: name.len() - start - after.len(), after }))
    }

    fn path(&self, number: u32) -> PathBuf {
        let Self { path, before, digits, after } = self;
        path.with_file_name(format!("{before}{number:0digits$}{after}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_one_a_range_or_a_range_with_a_step() {
        let frames = |first, last, step| Ok(Frames { first, last, step });
        assert_eq!(parse_frames("7"), frames(7, 7, 1));
        assert_eq!(parse_frames("0-24"), frames(0, 24, 1));
        assert_eq!(parse_frames("0-24:10"), frames(0, 24, 10));
        assert_eq!(parse_frames("0-99999"), frames(0, 99_999, 1));
        for bad in
            ["", "-", "-3", "3-", "1-2-3", "1-2:", "1-2:0", "2-1", "+1-2", "1.5", "0-100000", "0-1000000000", "a"]
        {
            assert!(parse_frames(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_run_of_hashes_becomes_the_number() {
        let path = |pattern: &str, number| {
            Pattern::of(Path::new(pattern)).expect("one run").expect("a run").path(number).display().to_string()
        };
        assert_eq!(path("out.####.exr", 7), "out.0007.exr");
        assert_eq!(path("a#b/#.png", 12), "a#b/12.png");
        assert_eq!(path("out.##.exr", 12_345), "out.12345.exr");
        assert!(Pattern::of(Path::new("out.exr")).expect("none").is_none());
        assert!(Pattern::of(Path::new("#.#.exr")).is_err());
    }
}
