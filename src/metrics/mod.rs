//! Error metrics of one image against another (`contract.md`, "Masks").
//!
//! SSIM: Wang et al. 2004, "Image Quality Assessment: From Error Visibility to Structural Similarity".
//! FLIP: Andersson et al. 2020, "FLIP: A Difference Evaluator for Alternating Images", through the `nv-flip` crate.

mod heatmap;
mod interval;
mod sequence;

use std::collections::BTreeMap;
use std::fmt::Write;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::image::{Image, grey_png};
use crate::{Error, Result};

pub use heatmap::{Map, heatmap};
pub use interval::{RmseEstimate, rmse_interval};
pub use sequence::{Change, GHOST_ERROR, SMALL_ERRORS, SequenceMeter, Settling, Since, Stability, pool};

/// Which pixels are measured. Made from the reference alone, so that every test is judged on the same pixels. Pixels that
/// face away from the light (the reference's `facing` is 0) are in none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Mask {
    /// A surface was hit.
    All,
    /// The reference is below 1.
    Shadow,
    /// The reference is between 0 and 1.
    Penumbra,
}

impl Mask {
    /// All masks, widest first.
    pub const ALL: [Self; 3] = [Self::All, Self::Shadow, Self::Penumbra];

    /// The name, as in options and reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::All => "all",
            Self::Shadow => "shadow",
            Self::Penumbra => "penumbra",
        }
    }

    fn holds(self, reference: f32) -> bool {
        match self {
            Self::All => true,
            Self::Shadow => reference < 1.0,
            Self::Penumbra => 0.0 < reference && reference < 1.0,
        }
    }
}

/// What `compare` found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// How many pixels could be compared.
    pub pixels: PixelCounts,
    /// The lights that both images have.
    pub lights: Vec<LightReport>,
    /// What a reader should know: lights in one image alone, names that differ, images that hardly overlap.
    pub notes: Vec<String>,
}

/// Every pixel is in one of these.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct PixelCounts {
    /// A surface in both images, at the same place.
    pub compared: u64,
    /// No surface in either image.
    pub uncovered: u64,
    /// Left out: a surface in one image alone.
    pub coverage_differs: u64,
    /// Left out: surfaces farther apart than a pixel's footprint.
    pub position_differs: u64,
}

impl std::ops::Add for PixelCounts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            compared: self.compared + other.compared,
            uncovered: self.uncovered + other.uncovered,
            coverage_differs: self.coverage_differs + other.coverage_differs,
            position_differs: self.position_differs + other.position_differs,
        }
    }
}

/// How the images differ in one light.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LightReport {
    /// The light's name in the test.
    pub name: String,
    /// The light's name in the reference.
    pub reference_name: String,
    /// Errors of visibility, by mask; empty when one of the images has irradiance alone.
    pub masks: BTreeMap<Mask, MaskErrors>,
    /// Where the reference is 1 and the test darker by more than 1/512.
    pub false_umbra: Option<Outliers>,
    /// Where the reference is 0 and the test brighter by more than 1/512.
    pub false_light: Option<Outliers>,
    /// RMSE of ∂V/∂x over the penumbra, by differences of horizontal neighbours that are both in it, 1/pixel.
    pub banding_rmse_per_px: Option<f64>,
    /// Where both images have it.
    pub irradiance: Option<IrradianceErrors>,
}

/// Errors of visibility over one mask; none where the mask is empty. Signed differences are test − reference.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct MaskErrors {
    /// Pixels in the mask.
    pub count: u64,
    /// Root of the mean squared difference.
    pub rmse: Option<f64>,
    /// Mean absolute difference.
    pub mae: Option<f64>,
    /// The least absolute difference that at least 99 % of the pixels don't exceed (nearest rank).
    pub p99: Option<f64>,
    /// Largest absolute difference.
    pub max: Option<f64>,
    /// Mean difference: above 0 the test is too bright.
    pub bias: Option<f64>,
    /// Mean structural similarity; 1 is identical.
    pub ssim: Option<f64>,
    /// Mean FLIP at 67 pixels per degree; 0 is identical.
    pub flip: Option<f64>,
}

/// Pixels that are wrong about whether there is a shadow at all.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Outliers {
    /// How many.
    pub count: u64,
    /// Their RMSE; none when there are none.
    pub rmse: Option<f64>,
}

/// Errors of irradiance over the mask `all`, each colour channel a sample of its own.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct IrradianceErrors {
    /// Root of the mean squared difference.
    pub rmse_w_per_m2: f64,
    /// Mean absolute difference.
    pub mae_w_per_m2: f64,
    /// Mean of test − reference.
    pub bias_w_per_m2: f64,
    /// Mean of the reference.
    pub mean_reference_w_per_m2: f64,
    /// RMSE over the mean of the reference; none when that is 0.
    pub relative_rmse: Option<f64>,
    /// MAE over the mean of the reference.
    pub relative_mae: Option<f64>,
    /// Bias over the mean of the reference.
    pub relative_bias: Option<f64>,
}

/// Smallest error that makes a lit or dark pixel a false one: half an 8-bit step, which no 8-bit picture shows.
const FALSE_THRESHOLD: f64 = 1.0 / 512.0;

/// Measures `test` against `reference`: each light that both have, over each of `masks`.
///
/// An image with one light on either side is compared even if the names differ, with a note.
pub fn compare(test: &Image, reference: &Image, masks: &[Mask]) -> Result<Report> {
    let pixels = align(test, reference)?;
    let (pairs, mut notes) = light_pairs(test, reference)?;
    let counts = count(&pixels);
    if test.xyz("position").is_none() || reference.xyz("position").is_none() {
        notes.push("positions are not compared: not both images have the layer (--aov position)".into());
    }
    if counts.compared < counts.coverage_differs + counts.position_differs {
        notes.push(
            "most pixels show different surfaces in the two images: are they of the same camera and scene?".into(),
        );
    }
    let lights: Vec<Result<LightReport>> = pairs
        .into_par_iter()
        .map(|(name, reference_name)| compare_light(test, reference, name, reference_name, &pixels, masks))
        .collect();
    let lights = lights.into_iter().collect::<Result<_>>()?;
    Ok(Report { size: test.size, pixels: counts, lights, notes })
}

fn compare_light(
    test: &Image,
    reference: &Image,
    name: String,
    reference_name: String,
    pixels: &[PixelKind],
    masks: &[Mask],
) -> Result<LightReport> {
    let mut report = LightReport {
        masks: BTreeMap::new(),
        false_umbra: None,
        false_light: None,
        banding_rmse_per_px: None,
        irradiance: None,
        name,
        reference_name,
    };
    let size = test.size;
    let measured = measured_pixels(reference, &report.reference_name, pixels);
    if let (Some(a), Some(b)) = (test.irradiance(&report.name), reference.irradiance(&report.reference_name)) {
        for (test, reference) in a.iter().zip(b) {
            check_finite(test, &format!("irradiance of {} in the test", report.name), &measured, size)?;
            check_finite(
                reference,
                &format!("irradiance of {} in the reference", report.reference_name),
                &measured,
                size,
            )?;
        }
        report.irradiance = irradiance_errors(a, b, &measured);
    }
    let Some(light) = Visibilities::of(test, reference, &report.name, &report.reference_name, measured)? else {
        return Ok(report);
    };
    let ssim = ssim_map(light.test, light.reference, &light.measured, light.size);
    let flip = flip_map(&light);
    for &mask in masks {
        let inside: Vec<usize> = light.within(mask).collect();
        let mean =
            |map: &[f64]| (!inside.is_empty()).then(|| sum(inside.iter().map(|&i| map[i])) / inside.len() as f64);
        let differences = inside.iter().map(|&i| light.difference(i)).collect();
        report.masks.insert(mask, MaskErrors { ssim: mean(&ssim), flip: mean(&flip), ..errors(differences) });
    }
    let outliers = |is: &dyn Fn(f32, f64) -> bool| {
        let differences: Vec<f64> = light
            .within(Mask::All)
            .map(|i| (light.reference[i], light.difference(i)))
            .filter(|&(reference, difference)| is(reference, difference))
            .map(|(_, difference)| difference)
            .collect();
        Some(Outliers { count: differences.len() as u64, rmse: rmse(&differences) })
    };
    report.false_umbra = outliers(&|reference, difference| reference == 1.0 && difference < -FALSE_THRESHOLD);
    report.false_light = outliers(&|reference, difference| reference == 0.0 && difference > FALSE_THRESHOLD);
    report.banding_rmse_per_px = banding(&light);
    Ok(report)
}

/// What a pixel of two images shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum PixelKind {
    Compared,
    Uncovered,
    CoverageDiffers,
    PositionDiffers,
}

fn count(pixels: &[PixelKind]) -> PixelCounts {
    let mut counts = PixelCounts::default();
    for pixel in pixels {
        *match pixel {
            PixelKind::Compared => &mut counts.compared,
            PixelKind::Uncovered => &mut counts.uncovered,
            PixelKind::CoverageDiffers => &mut counts.coverage_differs,
            PixelKind::PositionDiffers => &mut counts.position_differs,
        } += 1;
    }
    counts
}

/// Sorts the pixels; without a coverage layer all are covered, and without a position layer on either side all are in place.
fn align(test: &Image, reference: &Image) -> Result<Vec<PixelKind>> {
    if test.size != reference.size {
        let [[tw, th], [rw, rh]] = [test.size, reference.size];
        return Err(Error::Mismatch(format!(
            "the test has {tw}×{th} pixels, the reference {rw}×{rh}; expected the same size"
        )));
    }
    let covered = |image: &Image| match image.channel("coverage.A") {
        Some(coverage) => coverage.iter().map(|&value| value == 1.0).collect(),
        None => vec![true; image.pixel_count()],
    };
    let (test_covered, reference_covered): (Vec<bool>, Vec<bool>) = (covered(test), covered(reference));
    let positions = test.xyz("position").zip(reference.xyz("position"));
    let tolerances = positions.map(|(_, positions)| footprints(positions, &reference_covered, reference.size));
    Ok((0..test.pixel_count())
        .map(|i| match (test_covered[i], reference_covered[i], positions, &tolerances) {
            (false, false, ..) => PixelKind::Uncovered,
            (true, true, Some((a, b)), Some(tolerances)) => {
                // Both images round each coordinate to a float: by half a unit in the last place each.
                let largest = a.iter().chain(&b).map(|axis| f64::from(axis[i]).abs()).fold(0.0, f64::max);
                let rounding = 3f64.sqrt() * largest * f64::from(f32::EPSILON);
                let apart = distance(a, i, b, i);
                if apart.is_finite() && apart <= tolerances[i] + rounding {
                    PixelKind::Compared
                } else {
                    PixelKind::PositionDiffers
                }
            }
            (true, true, ..) => PixelKind::Compared,
            _ => PixelKind::CoverageDiffers,
        })
        .collect())
}

fn distance(a: [&[f32]; 3], i: usize, b: [&[f32]; 3], j: usize) -> f64 {
    (0..3).map(|axis| f64::from(a[axis][i]) - f64::from(b[axis][j])).map(|d| d * d).sum::<f64>().sqrt()
}

/// The world size of each covered pixel, m: the smallest distance, zero apart, from its position to those of its four
/// neighbours. At a silhouette the neighbours on the same surface decide, being nearer. Where no neighbour is covered, the
/// median of the other pixels; infinite where there are none.
fn footprints(positions: [&[f32]; 3], covered: &[bool], [width, height]: [u32; 2]) -> Vec<f64> {
    let (width, height) = (width as usize, height as usize);
    let mut footprints: Vec<f64> = (0..covered.len())
        .into_par_iter()
        .map(|i| {
            let (x, y) = (i % width, i / width);
            let neighbours = [(x > 0, 1, 0), (x + 1 < width, 0, 1), (y > 0, width, 0), (y + 1 < height, 0, width)];
            neighbours
                .into_iter()
                .filter(|&(inside, ..)| inside)
                .map(|(_, back, forward)| i - back + forward)
                .filter(|&j| covered[i] && covered[j])
                .map(|j| distance(positions, i, positions, j))
                .filter(|&distance| distance > 0.0)
                .fold(f64::INFINITY, f64::min)
        })
        .collect();
    let mut known: Vec<f64> = footprints.iter().copied().filter(|footprint| footprint.is_finite()).collect();
    if !known.is_empty() {
        let middle = known.len() / 2;
        let median = *known.select_nth_unstable_by(middle, f64::total_cmp).1;
        footprints.iter_mut().filter(|footprint| footprint.is_infinite()).for_each(|footprint| *footprint = median);
    }
    footprints
}

/// Names of the same light in the test and in the reference.
type LightPair = (String, String);

/// The lights that both images have, and notes about the others.
fn light_pairs(test: &Image, reference: &Image) -> Result<(Vec<LightPair>, Vec<String>)> {
    let (ours, theirs) = (test.light_names(), reference.light_names());
    for (side, image, names) in [("test", test, &ours), ("reference", reference, &theirs)] {
        if names.is_empty() {
            return Err(Error::Mismatch(format!(
                "the {side} has no channel named <light>.visibility or <light>.irradiance.R; it has {}",
                channels(image)
            )));
        }
    }
    if let ([name], [reference_name]) = (ours.as_slice(), theirs.as_slice()) {
        let note = format!("the light is named {name} in the test and {reference_name} in the reference");
        let notes = if name == reference_name { Vec::new() } else { vec![note] };
        return Ok((vec![(name.clone(), reference_name.clone())], notes));
    }
    let alone = |names: &[String], others: &[String]| {
        names.iter().filter(|name| !others.contains(name)).cloned().collect::<Vec<_>>()
    };
    let mut notes = Vec::new();
    for (side, names) in [("test", alone(&ours, &theirs)), ("reference", alone(&theirs, &ours))] {
        if !names.is_empty() {
            notes.push(format!("in the {side} alone: {}", names.join(", ")));
        }
    }
    let pairs: Vec<_> =
        ours.iter().filter(|name| theirs.contains(name)).map(|name| (name.clone(), name.clone())).collect();
    if pairs.is_empty() {
        let (ours, theirs) = (ours.join(", "), theirs.join(", "));
        let message = format!("no light in common: the test has {ours}; the reference has {theirs}");
        return Err(Error::Mismatch(message));
    }
    Ok((pairs, notes))
}

/// The first few channel names, for a message.
fn channels(image: &Image) -> String {
    const SHOWN: usize = 8;
    let names: Vec<_> = image.channels.iter().take(SHOWN).map(|channel| channel.name.as_str()).collect();
    let more = if image.channels.len() > SHOWN { ", …" } else { "" };
    format!("{}{more}", names.join(", "))
}

/// Whether each pixel is in any mask of the light.
fn measured_pixels(reference: &Image, light: &str, pixels: &[PixelKind]) -> Vec<bool> {
    let facing = reference.facing(light);
    let faces = |i: usize| facing.is_none_or(|facing| facing[i] != 0.0);
    pixels.iter().enumerate().map(|(i, &pixel)| pixel == PixelKind::Compared && faces(i)).collect()
}

fn check_finite(samples: &[f32], what: &str, measured: &[bool], [width, _]: [u32; 2]) -> Result<()> {
    match (0..samples.len()).find(|&i| measured[i] && !samples[i].is_finite()) {
        None => Ok(()),
        Some(i) => {
            let (x, y) = (i % width as usize, i / width as usize);
            Err(Error::Mismatch(format!("{what} is {} at pixel {x}, {y}", samples[i])))
        }
    }
}

/// The visibilities of one light in both images.
struct Visibilities<'a> {
    size: [u32; 2],
    test: &'a [f32],
    reference: &'a [f32],
    /// In the mask `all`.
    measured: Vec<bool>,
}

impl<'a> Visibilities<'a> {
    fn of(
        test: &'a Image,
        reference: &'a Image,
        name: &str,
        reference_name: &str,
        measured: Vec<bool>,
    ) -> Result<Option<Self>> {
        let (Some(a), Some(b)) = (test.visibility(name), reference.visibility(reference_name)) else {
            return Ok(None);
        };
        check_finite(a, &format!("visibility of {name} in the test"), &measured, test.size)?;
        check_finite(b, &format!("visibility of {reference_name} in the reference"), &measured, test.size)?;
        Ok(Some(Self { size: test.size, test: a, reference: b, measured }))
    }

    fn within(&self, mask: Mask) -> impl Iterator<Item = usize> {
        (0..self.measured.len()).filter(move |&i| self.measured[i] && mask.holds(self.reference[i]))
    }

    /// Test − reference.
    fn difference(&self, i: usize) -> f64 {
        f64::from(self.test[i]) - f64::from(self.reference[i])
    }
}

fn sum(values: impl Iterator<Item = f64>) -> f64 {
    values.fold(0.0, |sum, value| sum + value)
}

fn rmse(differences: &[f64]) -> Option<f64> {
    let squares = sum(differences.iter().map(|d| d * d));
    (!differences.is_empty()).then(|| (squares / differences.len() as f64).sqrt())
}

fn errors(mut differences: Vec<f64>) -> MaskErrors {
    let count = differences.len();
    if count == 0 {
        return MaskErrors::default();
    }
    let mean = |value: &dyn Fn(f64) -> f64| Some(sum(differences.iter().map(|&d| value(d))) / count as f64);
    let (rmse, mae, bias) = (rmse(&differences), mean(&f64::abs), mean(&|d| d));
    differences.iter_mut().for_each(|difference| *difference = difference.abs());
    differences.sort_unstable_by(f64::total_cmp);
    MaskErrors {
        count: count as u64,
        rmse,
        mae,
        p99: Some(differences[(99 * count).div_ceil(100) - 1]),
        max: differences.last().copied(),
        bias,
        ssim: None,
        flip: None,
    }
}

fn irradiance_errors(test: [&[f32]; 3], reference: [&[f32]; 3], measured: &[bool]) -> Option<IrradianceErrors> {
    let samples = || {
        (0..3).flat_map(|c| (0..measured.len()).filter(|&i| measured[i]).map(move |i| (test[c][i], reference[c][i])))
    };
    let differences: Vec<f64> = samples().map(|(test, reference)| f64::from(test) - f64::from(reference)).collect();
    let errors = errors(differences);
    let mean = sum(samples().map(|(_, reference)| f64::from(reference))) / errors.count as f64;
    let relative = |value: f64| (mean != 0.0).then(|| value / mean);
    let (rmse, mae, bias) = (errors.rmse?, errors.mae?, errors.bias?);
    Some(IrradianceErrors {
        rmse_w_per_m2: rmse,
        mae_w_per_m2: mae,
        bias_w_per_m2: bias,
        mean_reference_w_per_m2: mean,
        relative_rmse: relative(rmse),
        relative_mae: relative(mae),
        relative_bias: relative(bias),
    })
}

fn banding(light: &Visibilities) -> Option<f64> {
    let width = light.size[0] as usize;
    let inside = |i: usize| light.measured[i] && Mask::Penumbra.holds(light.reference[i]);
    let slopes: Vec<f64> = (0..light.measured.len())
        .filter(|i| (i + 1) % width != 0)
        .filter(|&i| inside(i) && inside(i + 1))
        .map(|i| light.difference(i + 1) - light.difference(i))
        .collect();
    rmse(&slopes)
}

/// Half the window of SSIM: 11×11 (Wang et al. 2004, section III.C).
const SSIM_RADIUS: usize = 5;
/// Of the window's Gaussian, pixels.
const SSIM_SIGMA: f64 = 1.5;

/// Structural similarity at each pixel with a weight, of values with range 1; 0 elsewhere.
///
/// Window 11×11, Gaussian of σ 1.5; K₁ 0.01, K₂ 0.03; population variances. At borders, and where pixels are not
/// measured, the window's remaining weights are scaled to sum 1.
pub fn ssim_map(test: &[f32], reference: &[f32], measured: &[bool], size: [u32; 2]) -> Vec<f64> {
    // Wang et al. 2004, Eq. 13: C₁ = (K₁L)², C₂ = (K₂L)², L = 1.
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let plane = |value: &(dyn Fn(f64, f64) -> f64 + Sync)| {
        let values = (0..measured.len()).map(|i| match measured[i] {
            true => value(f64::from(test[i]), f64::from(reference[i])),
            false => 0.0,
        });
        blurred(&values.collect::<Vec<_>>(), size)
    };
    let weight = plane(&|_, _| 1.0);
    let (x, y) = (plane(&|x, _| x), plane(&|_, y| y));
    let (xx, yy, xy) = (plane(&|x, _| x * x), plane(&|_, y| y * y), plane(&|x, y| x * y));
    (0..measured.len())
        .map(|i| {
            if !measured[i] {
                return 0.0;
            }
            let [x, y, xx, yy, xy] = [&x, &y, &xx, &yy, &xy].map(|plane| plane[i] / weight[i]);
            let (variance_x, variance_y, covariance) = (xx - x * x, yy - y * y, xy - x * y);
            // Eq. 13.
            ((2.0 * x * y + c1) * (2.0 * covariance + c2)) / ((x * x + y * y + c1) * (variance_x + variance_y + c2))
        })
        .collect()
}

/// The values under the window of SSIM, zero beyond the borders; rows first, then columns.
fn blurred(values: &[f64], [width, height]: [u32; 2]) -> Vec<f64> {
    let (width, height) = (width as usize, height as usize);
    let gaussian: [f64; 2 * SSIM_RADIUS + 1] = std::array::from_fn(|i| {
        let offset = i as f64 - SSIM_RADIUS as f64;
        (-0.5 * (offset / SSIM_SIGMA).powi(2)).exp()
    });
    // Taps of the window around `at` that lie inside `length`: (index, weight).
    let taps = |at: usize, length: usize| {
        let first = at.saturating_sub(SSIM_RADIUS);
        let last = (at + SSIM_RADIUS).min(length - 1);
        (first..=last).map(move |j| (j, gaussian[j + SSIM_RADIUS - at]))
    };
    let rows: Vec<f64> = (0..values.len())
        .into_par_iter()
        .map(|i| {
            let (x, row) = (i % width, i - i % width);
            sum(taps(x, width).map(|(j, weight)| weight * values[row + j]))
        })
        .collect();
    (0..values.len())
        .into_par_iter()
        .map(|i| {
            let (x, y) = (i % width, i / width);
            sum(taps(y, height).map(|(j, weight)| weight * rows[j * width + x]))
        })
        .collect()
}

/// FLIP at each pixel, of the images as a PNG shows them. Pixels that are not measured take the reference's value in both.
fn flip_map(light: &Visibilities) -> Vec<f64> {
    let masked: Vec<f32> =
        (0..light.measured.len()).map(|i| if light.measured[i] { light.test[i] } else { light.reference[i] }).collect();
    let [test, reference] = [masked.as_slice(), light.reference].map(|samples| {
        let rgb: Vec<u8> = grey_png(light.size, samples).into_raw().into_iter().flat_map(|grey| [grey; 3]).collect();
        nv_flip::FlipImageRgb8::with_data(light.size[0], light.size[1], &rgb)
    });
    let map = nv_flip::flip(reference, test, nv_flip::DEFAULT_PIXELS_PER_DEGREE);
    map.to_vec().into_iter().map(f64::from).collect()
}

/// The report as lines for people.
pub fn table(report: &Report) -> String {
    let mut text = String::new();
    let PixelCounts { compared, uncovered, coverage_differs, position_differs } = report.pixels;
    let [width, height] = report.size;
    line(&mut text, format_args!("{width}×{height}: {compared} pixels compared, {uncovered} without a surface"));
    if coverage_differs + position_differs > 0 {
        line(
            &mut text,
            format_args!(
                "left out: {coverage_differs} where coverage differs, {position_differs} where positions differ"
            ),
        );
    }
    for light in &report.lights {
        line(&mut text, format_args!("\nlight {}", light.name));
        if !light.masks.is_empty() {
            let titles = ["RMSE", "MAE", "p99", "max", "bias", "SSIM", "FLIP"];
            let titles: String = titles.iter().map(|title| format!(" {title:>9}")).collect();
            line(&mut text, format_args!("  {:<11} {:>10}{titles}", "mask", "pixels"));
        }
        for (mask, errors) in &light.masks {
            let MaskErrors { count, rmse, mae, p99, max, bias, ssim, flip } = *errors;
            let values: String =
                [rmse, mae, p99, max, bias, ssim, flip].map(|value| format!(" {}", cell(value))).concat();
            line(&mut text, format_args!("  {:<11} {count:>10}{values}", mask.name()));
        }
        for (name, outliers) in [("false umbra", light.false_umbra), ("false light", light.false_light)] {
            if let Some(Outliers { count, rmse }) = outliers {
                line(&mut text, format_args!("  {name:<11} {count:>10} {}", cell(rmse)));
            }
        }
        if let Some(banding) = light.banding_rmse_per_px {
            line(&mut text, format_args!("  {:<22} {} per pixel, RMSE of dV/dx", "banding", cell(Some(banding))));
        }
        if let Some(errors) = light.irradiance {
            let IrradianceErrors { rmse_w_per_m2, mae_w_per_m2, bias_w_per_m2, mean_reference_w_per_m2, .. } = errors;
            let values = [rmse_w_per_m2, mae_w_per_m2].map(|value| format!(" {}", cell(Some(value)))).concat();
            let bias = cell(Some(bias_w_per_m2));
            let mean = cell(Some(mean_reference_w_per_m2));
            line(
                &mut text,
                format_args!("  {:<22}{values} {:>9} {:>9} {bias} W/m²; mean {}", "irradiance", "", "", mean.trim()),
            );
        }
    }
    for note in &report.notes {
        line(&mut text, format_args!("\nnote: {note}"));
    }
    text
}

fn line(text: &mut String, arguments: std::fmt::Arguments) {
    writeln!(text, "{arguments}").expect("a string takes any text");
}

/// A number in nine columns, four digits of it significant.
fn cell(value: Option<f64>) -> String {
    match value {
        None => format!("{:>9}", "-"),
        Some(0.0) => format!("{:>9}", "0"),
        Some(value) if (1e-3..1e4).contains(&value.abs()) => format!("{value:>9.5}"),
        Some(value) => format!("{value:>9.2e}"),
    }
}
