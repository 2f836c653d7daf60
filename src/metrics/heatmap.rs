//! Pictures of how two images differ.

use embedded_graphics::text::Alignment;
use image::{Rgb, RgbImage};

use super::{Mask, PixelKind, Visibilities, align, cell, count, flip_map, light_pairs, measured_pixels, ssim_map};
use crate::image::{Image, srgb8_from_linear};
use crate::picture::Canvas;
use crate::{Error, Result};

/// What a heatmap shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Map {
    /// Test − reference: blue where the test is darker, red where it is brighter. The legend states the scale, which fits
    /// 99.9 % of the pixels and is at least ±0.005.
    Difference,
    /// Structural similarity, light at 1 and dark at 0 (and below).
    Ssim,
    /// FLIP, light at 0 and dark at 1.
    Flip,
}

/// A false-colour picture of how `test` differs from `reference` in the light of that name in the test, with a legend.
/// Pixels that are left out are hatched; those without a surface or facing away are grey. Small images are enlarged.
pub fn heatmap(test: &Image, reference: &Image, light: &str, map: Map) -> Result<RgbImage> {
    let pixels = align(test, reference)?;
    let (pairs, _) = light_pairs(test, reference)?;
    let unknown = || Error::Mismatch(format!("both images must have {light}.visibility"));
    let (name, reference_name) = pairs.iter().find(|(name, _)| name == light).ok_or_else(unknown)?;
    let measured = measured_pixels(reference, reference_name, &pixels);
    let light = Visibilities::of(test, reference, name, reference_name, measured)?.ok_or_else(unknown)?;

    let differences: Vec<f64> = (0..light.measured.len()).map(|i| light.difference(i)).collect();
    let scale = difference_scale(light.within(Mask::All).map(|i| differences[i].abs()).collect());
    let largest = light.within(Mask::All).map(|i| differences[i].abs()).fold(0.0, f64::max);
    let (values, legend) = match map {
        Map::Difference => (
            differences.iter().map(|difference| difference / scale).collect(),
            Legend {
                title: format!("test - reference, largest {}", cell(Some(largest)).trim()),
                ends: [-1.0, 1.0],
                labels: [format!("-{scale}"), "0".into(), format!("+{scale}")],
                meaning: ["test darker", "equal", "test brighter"],
            },
        ),
        Map::Ssim => (
            ssim_map(light.test, light.reference, &light.measured, light.size).iter().map(|ssim| 1.0 - ssim).collect(),
            Legend {
                title: "SSIM 11x11".into(),
                ends: [0.0, 1.0],
                labels: ["1", "0.5", "0"].map(Into::into),
                meaning: ["same structure", "", "none"],
            },
        ),
        Map::Flip => (
            flip_map(&light),
            Legend {
                title: "FLIP, 67 pixels/degree".into(),
                ends: [0.0, 1.0],
                labels: ["0", "0.5", "1"].map(Into::into),
                meaning: ["looks the same", "", "looks different"],
            },
        ),
    };
    Ok(drawn(name, &values, &legend, &pixels, &light))
}

/// The scale of a picture of differences: 99.9 % of them fit; rounded up to 1, 2 or 5 times a power of ten. Never below
/// 0.005, the first such number above an 8-bit step, so that what no picture could show isn't painted as an error.
fn difference_scale(mut absolute: Vec<f64>) -> f64 {
    let mut scale = 0.005;
    if absolute.is_empty() {
        return scale;
    }
    let rank = (999 * absolute.len()).div_ceil(1000) - 1;
    let wanted = *absolute.select_nth_unstable_by(rank, f64::total_cmp).1;
    for step in [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0] {
        // Differences of floats: 0.2 as a float is above 0.2.
        if scale as f32 >= wanted as f32 {
            break;
        }
        scale = step;
    }
    scale
}

struct Legend {
    title: String,
    /// Values at the ends of the bar, in [-1, 1].
    ends: [f64; 2],
    /// Numbers at the bar's start, middle and end.
    labels: [String; 3],
    /// What they mean.
    meaning: [&'static str; 3],
}

/// Oklab (Ottosson 2020, "A perceptual color space for image processing"): equal steps look equal.
type Oklab = [f64; 3];
const NEUTRAL: Oklab = [0.96, 0.0, 0.0];
/// Of one lightness, so that errors of either sign weigh the same; inside the sRGB gamut.
const DARKER: Oklab = [0.45, -0.02, -0.19];
const BRIGHTER: Oklab = [0.45, 0.165, 0.08];
const UNSURE: Oklab = [0.30, 0.08, -0.12];

/// The colour of a value in [-1, 1] of a signed map (`ends` from −1) or in [0, 1] of an unsigned one.
fn color(value: f64, ends: [f64; 2]) -> Rgb<u8> {
    let end = if ends[0] == 0.0 {
        UNSURE
    } else if value < 0.0 {
        DARKER
    } else {
        BRIGHTER
    };
    let amount = value.clamp(ends[0], ends[1]).abs();
    rgb_from_oklab(std::array::from_fn(|i| NEUTRAL[i] + amount * (end[i] - NEUTRAL[i])))
}

fn rgb_from_oklab([lightness, a, b]: Oklab) -> Rgb<u8> {
    let l = (lightness + 0.396_337_777_4 * a + 0.215_803_757_3 * b).powi(3);
    let m = (lightness - 0.105_561_345_8 * a - 0.063_854_172_8 * b).powi(3);
    let s = (lightness - 0.089_484_177_5 * a - 1.291_485_548_0 * b).powi(3);
    let linear = [
        4.076_741_662_1 * l - 3.307_711_591_3 * m + 0.230_969_929_2 * s,
        -1.268_438_004_6 * l + 2.609_757_401_1 * m - 0.341_319_396_5 * s,
        -0.004_196_086_3 * l - 0.703_418_614_7 * m + 1.707_614_701_0 * s,
    ];
    Rgb(linear.map(|value| srgb8_from_linear(value as f32)))
}

/// Smallest width of a picture, which its legend needs.
const PICTURE_WIDTH: u32 = 480;
/// Largest width of the legend's bar.
const BAR_WIDTH: u32 = 960;
const BAR_HEIGHT: u32 = 16;
/// Of [`FONT_9X15`].
const LETTER_WIDTH: u32 = 9;
const LINE_HEIGHT: u32 = 18;
const MARGIN: u32 = 12;
const GREY: Rgb<u8> = Rgb([150; 3]);
const HATCHES: [Rgb<u8>; 2] = [Rgb([110; 3]), Rgb([190; 3])];

fn drawn(name: &str, values: &[f64], legend: &Legend, pixels: &[PixelKind], light: &Visibilities) -> RgbImage {
    let [width, height] = light.size;
    let enlarged = (PICTURE_WIDTH / width.max(height)).max(1);
    let picture_width = (width * enlarged).max(PICTURE_WIDTH);
    let picture_height = height * enlarged;
    let lines = 5;
    let legend_height = lines * LINE_HEIGHT + BAR_HEIGHT + 2 * MARGIN;
    let mut canvas = Canvas::new(picture_width, picture_height + legend_height);
    let hatch = |x: u32, y: u32| HATCHES[((x + y) / 4 % 2) as usize];
    for y in 0..picture_height {
        for x in 0..width * enlarged {
            let i = (y / enlarged) as usize * width as usize + (x / enlarged) as usize;
            let pixel = match pixels[i] {
                PixelKind::CoverageDiffers | PixelKind::PositionDiffers => hatch(x, y),
                _ if light.measured[i] => color(values[i], legend.ends),
                _ => GREY,
            };
            canvas.0.put_pixel(x, y, pixel);
        }
    }

    let mut top = picture_height + MARGIN;
    let letters = ((picture_width - 2 * MARGIN) / LETTER_WIDTH) as usize;
    canvas.aligned_text(&shortened(&format!("{name}: {}", legend.title), letters), MARGIN, top, Alignment::Left);
    top += LINE_HEIGHT + 2;
    let bar = (picture_width - 2 * MARGIN).min(BAR_WIDTH);
    for x in 0..bar {
        let value = legend.ends[0] + (legend.ends[1] - legend.ends[0]) * f64::from(x) / f64::from(bar - 1);
        for y in 0..BAR_HEIGHT {
            let edge = x == 0 || x + 1 == bar || y == 0 || y + 1 == BAR_HEIGHT;
            canvas.0.put_pixel(MARGIN + x, top + y, if edge { Rgb([0; 3]) } else { color(value, legend.ends) });
        }
    }
    top += BAR_HEIGHT + 2;
    let places = [(MARGIN, Alignment::Left), (MARGIN + bar / 2, Alignment::Center), (MARGIN + bar, Alignment::Right)];
    for texts in [legend.labels.each_ref().map(String::as_str), legend.meaning] {
        for (text, (x, alignment)) in texts.into_iter().zip(places) {
            canvas.aligned_text(text, x, top, alignment);
        }
        top += LINE_HEIGHT;
    }
    let counts = count(pixels);
    let left_out = counts.coverage_differs + counts.position_differs;
    let measured = light.measured.iter().filter(|&&measured| measured).count() as u64;
    let rest = pixels.len() as u64 - left_out - measured;
    let swatch = 14;
    for (text, is_hatch) in [
        (format!("left out, other surface: {left_out} pixels"), true),
        (format!("no surface, or faces away: {rest} pixels"), false),
    ] {
        for (x, y) in (0..swatch).flat_map(|y| (0..swatch).map(move |x| (x, y))) {
            canvas.0.put_pixel(MARGIN + x, top + y, if is_hatch { hatch(x, y) } else { GREY });
        }
        canvas.aligned_text(&text, MARGIN + swatch + 6, top, Alignment::Left);
        top += LINE_HEIGHT;
    }
    canvas.0
}

fn shortened(text: &str, letters: usize) -> String {
    if text.chars().count() <= letters {
        text.to_owned()
    } else {
        text.chars().take(letters - 3).chain("...".chars()).collect()
    }
}
