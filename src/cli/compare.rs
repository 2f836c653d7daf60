//! `penumbra compare`.

use std::path::{Path, PathBuf};

use clap::Args;

use super::report::is_png;
use super::{print, print_json};
use crate::image::{Image, png_paths, read_exr, write_pngs};
use crate::metrics::{self, Map, Mask};
use crate::{Error, Result, output};

/// Options of `compare`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Image to judge
    #[arg(value_name = "TEST.exr")]
    test: PathBuf,
    /// What it should be
    #[arg(value_name = "REFERENCE.exr")]
    reference: PathBuf,
    /// Pixels to measure, by the reference: all receivers, those not fully lit, those partly lit [default: each of them]
    #[arg(long, value_enum)]
    mask: Option<Mask>,
    /// Writes a picture of where the test is darker and brighter (several lights: OUT.<light>.png)
    #[arg(long, value_name = "OUT.png")]
    heatmap: Option<PathBuf>,
    /// Writes a picture of the structural similarity (SSIM)
    #[arg(long, value_name = "OUT.png")]
    ssim_map: Option<PathBuf>,
    /// Writes a picture of the perceived difference (FLIP)
    #[arg(long, value_name = "OUT.png")]
    flip_map: Option<PathBuf>,
    /// Prints JSON
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    for path in [&arguments.heatmap, &arguments.ssim_map, &arguments.flip_map].into_iter().flatten() {
        if !is_png(path)? {
            return Err(Error::usage(path.display().to_string(), "pictures are written as .png").into());
        }
        output::check(path)?;
    }
    let (test, reference) = (read_exr(&arguments.test)?, read_exr(&arguments.reference)?);
    let masks = arguments.mask.map_or(Mask::ALL.to_vec(), |mask| vec![mask]);
    let report = metrics::compare(&test, &reference, &masks)?;
    let lights: Vec<String> = report.lights.iter().map(|light| light.name.clone()).collect();
    let maps =
        [(&arguments.heatmap, Map::Difference), (&arguments.ssim_map, Map::Ssim), (&arguments.flip_map, Map::Flip)];
    for (path, map) in maps {
        if let Some(path) = path {
            write_maps(path, &test, &reference, &lights, map)?;
        }
    }
    if arguments.json { print_json(&report) } else { print(&metrics::table(&report)) }
}

fn write_maps(path: &Path, test: &Image, reference: &Image, lights: &[String], map: Map) -> anyhow::Result<()> {
    let pictures: Vec<_> =
        lights.iter().map(|light| metrics::heatmap(test, reference, light, map)).collect::<Result<_>>()?;
    Ok(write_pngs(png_paths(path, lights).iter().zip(pictures))?)
}
