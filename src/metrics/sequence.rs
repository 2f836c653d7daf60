//! Metrics of images that follow each other: what changes that should not, what is left of what has gone, and after how many
//! frames an error stays small.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{LightReport, Mask, MaskErrors, Outliers, Visibilities, align, light_pairs, measured_pixels};
use crate::image::Image;
use crate::{Error, Result};

/// Errors to which frames are counted: a step of an 8-bit picture, and 1e-2.
pub const SMALL_ERRORS: [f64; 2] = [1.0 / 255.0, 1e-2];

/// Smallest error that makes a residue a ghost: the standard error down to which Scherzer et al. 2009 still filter what they
/// show (§4), so that nothing below it is one by their own measure.
pub const GHOST_ERROR: f64 = 1.0 / 50.0;

/// How a frame follows on the one before.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Change {
    /// RMS of [(out_t − out_{t−1}) − (ref_t − ref_{t−1})] over the pixels that are measured in both frames and in the penumbra
    /// of either; none where there are none, as in the first frame.
    pub flicker: Option<f64>,
    /// Share of the measured pixels that are ghosts: the reference is 0 or 1, it was not the same in every earlier frame that
    /// saw this point of the surface since it came into view, and the error exceeds [`GHOST_ERROR`].
    pub ghost_area: Option<f64>,
}

/// Since when a point of a surface has been in view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Since {
    /// Since the first frame.
    Start,
    /// It came into view later.
    Disocclusion,
}

/// After how many frames in view the error of a point in the penumbra stays below a bound.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Settling {
    /// Of which points.
    pub since: Since,
    /// The bound on |Δ|.
    pub error: f64,
    /// How many points: each that comes into view in the penumbra is followed until it leaves the penumbra or the view. What
    /// is right because the shadow has gone has not converged.
    pub points: u64,
    /// The number of the frame, counted from 1 where the point came into view, from which on the error stays below: half of
    /// the points need no more. None where half of them never get there.
    pub median: Option<u32>,
    /// As `median`, for 95 % of the points.
    pub p95: Option<u32>,
    /// Share of the points that are not below in the last frame that sees them in the penumbra.
    pub never: f64,
}

/// What a whole sequence comes to.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Stability {
    /// As [`Change::flicker`], over all pixels of all frames.
    pub flicker: Option<f64>,
    /// As [`Change::ghost_area`], over all frames but the first.
    pub ghost_area: Option<f64>,
    /// For each kind of point that there is and each of [`SMALL_ERRORS`].
    pub settling: Vec<Settling>,
}

impl Stability {
    /// How soon points of a kind settle; none where there are none.
    pub fn settling(&self, since: Since, error: f64) -> Option<Settling> {
        self.settling.iter().copied().find(|settling| settling.since == since && settling.error == error)
    }
}

/// The errors of several images of one light as if they were one: what a mean is of is weighted by its pixels. Percentiles and
/// banding can't be had so, and are none.
///
/// # Panics
/// Without an image.
pub fn pool(reports: &[LightReport]) -> LightReport {
    let first = reports.first().expect("at least one image");
    let mean = |values: &mut dyn Iterator<Item = (u64, Option<f64>)>| {
        let mut sum = Sum::default();
        values.filter_map(|(count, value)| Some((count, value?))).for_each(|(count, value)| {
            sum.add(Sum { total: count as f64 * value, count });
        });
        sum.mean()
    };
    let square = |value: Option<f64>| value.map(|value| value * value);
    let of_mask = |mask: Mask| {
        let all = || reports.iter().filter_map(move |report| report.masks.get(&mask));
        let mean_of = |of: fn(&MaskErrors) -> Option<f64>| mean(&mut all().map(|errors| (errors.count, of(errors))));
        MaskErrors {
            count: all().map(|errors| errors.count).sum(),
            rmse: mean(&mut all().map(|errors| (errors.count, square(errors.rmse)))).map(f64::sqrt),
            mae: mean_of(|errors| errors.mae),
            p99: None,
            max: all().filter_map(|errors| errors.max).reduce(f64::max),
            bias: mean_of(|errors| errors.bias),
            ssim: mean_of(|errors| errors.ssim),
            flip: mean_of(|errors| errors.flip),
        }
    };
    let outliers = |of: fn(&LightReport) -> Option<Outliers>| {
        let all = || reports.iter().filter_map(of);
        let rmse = mean(&mut all().map(|outliers| (outliers.count, square(outliers.rmse)))).map(f64::sqrt);
        all().next().map(|_| Outliers { count: all().map(|outliers| outliers.count).sum(), rmse })
    };
    LightReport {
        name: first.name.clone(),
        reference_name: first.reference_name.clone(),
        masks: first.masks.keys().map(|&mask| (mask, of_mask(mask))).collect(),
        false_umbra: outliers(|report| report.false_umbra),
        false_light: outliers(|report| report.false_light),
        banding_rmse_per_px: None,
        irradiance: None,
    }
}

/// Takes in frame after frame.
#[derive(Debug, Default)]
pub struct SequenceMeter {
    previous: Option<Previous>,
    flicker: Sum,
    ghosts: Sum,
    /// Points by the frames that they took (none: never), for each kind and each small error.
    settled: BTreeMap<(Since, usize), BTreeMap<Option<u32>, u64>>,
}

#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    total: f64,
    count: u64,
}

impl Sum {
    fn add(&mut self, other: Self) {
        self.total += other.total;
        self.count += other.count;
    }

    fn mean(self) -> Option<f64> {
        (self.count > 0).then(|| self.total / self.count as f64)
    }
}

/// What the next frame needs of this one, by pixel.
#[derive(Debug)]
struct Previous {
    /// Test − reference; none where it is not measured.
    differences: Vec<Option<f64>>,
    in_penumbra: Vec<bool>,
    tracks: Vec<Option<Track>>,
}

/// A point of a surface while it is in view.
#[derive(Debug, Clone, Copy)]
struct Track {
    since: Since,
    /// Whether it has been in the penumbra since it came into view.
    settles: bool,
    /// Frames in view.
    frames: u32,
    /// The last of them in which it was measured; 0: none.
    measured: u32,
    /// The last of them in which the error was not below each of [`SMALL_ERRORS`]; 0: none.
    off: [u32; SMALL_ERRORS.len()],
    /// Whether the reference has been dark, in between, lit.
    was: [bool; 3],
}

impl Track {
    fn new(since: Since, reference: f32) -> Self {
        let settles = Mask::Penumbra.holds(reference);
        Self { since, settles, frames: 0, measured: 0, off: [0; SMALL_ERRORS.len()], was: [false; 3] }
    }

    /// Another frame sees it; whether it is a ghost in it.
    fn see(&mut self, reference: f32, difference: Option<f64>) -> bool {
        self.frames += 1;
        let state = if Mask::Penumbra.holds(reference) { 1 } else { 2 * usize::from(reference > 0.0) };
        self.was[state] = true;
        let Some(error) = difference.map(f64::abs) else { return false };
        self.measured = self.frames;
        for (off, small) in self.off.iter_mut().zip(SMALL_ERRORS) {
            if error >= small {
                *off = self.frames;
            }
        }
        let was_otherwise = self.was.iter().filter(|was| **was).count() > 1;
        state != 1 && was_otherwise && error > GHOST_ERROR
    }
}

impl SequenceMeter {
    /// Takes in the next frame: images of one light. `came_from` has for each pixel the one that showed the same point of the
    /// surface in the frame before, none where that did not see it.
    ///
    /// # Errors
    /// Images that can't be compared.
    pub fn add(&mut self, test: &Image, reference: &Image, came_from: &[Option<u32>]) -> Result<Change> {
        let pixels = align(test, reference)?;
        let (names, _) = light_pairs(test, reference)?;
        let (name, reference_name) = &names[0];
        let measured = measured_pixels(reference, reference_name, &pixels);
        let Some(light) = Visibilities::of(test, reference, name, reference_name, measured)? else {
            return Err(Error::Mismatch(format!("{name} has no visibility in one of the images")));
        };
        let coverage = reference.channel("coverage.A");
        let facing = reference.facing(reference_name);
        let is_on = |channel: Option<&[f32]>, i: usize| channel.is_none_or(|channel| channel[i] != 0.0);
        let count = test.pixel_count();
        let differences: Vec<Option<f64>> =
            (0..count).map(|i| light.measured[i].then(|| light.difference(i))).collect();
        let in_penumbra: Vec<bool> = light.reference.iter().map(|&value| Mask::Penumbra.holds(value)).collect();

        let mut flicker = Sum::default();
        if let Some(previous) = &self.previous {
            for i in (0..count).filter(|&i| in_penumbra[i] || previous.in_penumbra[i]) {
                if let Some((now, before)) = differences[i].zip(previous.differences[i]) {
                    flicker.add(Sum { total: (now - before).powi(2), count: 1 });
                }
            }
        }

        let before = self.previous.take().map(|previous| previous.tracks);
        let is_first = before.is_none();
        let mut goes_on = vec![false; before.as_ref().map_or(0, Vec::len)];
        let mut ghosts = Sum::default();
        let mut tracks = vec![None; count];
        for i in (0..count).filter(|&i| is_on(coverage, i) && is_on(facing, i)) {
            let known = before.as_ref().and_then(|before| {
                let j = came_from[i]? as usize;
                goes_on[j] = true;
                before[j]
            });
            let since = if is_first { Since::Start } else { Since::Disocclusion };
            let mut track = known.unwrap_or_else(|| Track::new(since, light.reference[i]));
            if track.settles && !in_penumbra[i] {
                self.end(track);
                track.settles = false;
            }
            let is_ghost = track.see(light.reference[i], differences[i]);
            if differences[i].is_some() {
                ghosts.add(Sum { total: f64::from(u8::from(is_ghost)), count: 1 });
            }
            tracks[i] = Some(track);
        }
        let left = before.into_iter().flatten().zip(goes_on).filter(|(_, goes_on)| !goes_on);
        let left: Vec<Track> = left.filter_map(|(track, _)| track).collect();
        left.into_iter().for_each(|track| self.end(track));
        if !is_first {
            self.ghosts.add(ghosts);
        }
        self.flicker.add(flicker);
        self.previous = Some(Previous { differences, in_penumbra, tracks });
        Ok(Change { flicker: flicker.mean().map(f64::sqrt), ghost_area: ghosts.mean() })
    }

    /// A point has left the penumbra or the view.
    fn end(&mut self, track: Track) {
        if !track.settles || track.measured == 0 {
            return;
        }
        for (i, off) in track.off.into_iter().enumerate() {
            let frames = (off < track.measured).then_some(off + 1);
            *self.settled.entry((track.since, i)).or_default().entry(frames).or_default() += 1;
        }
    }

    /// What the sequence comes to.
    pub fn finish(mut self) -> Stability {
        let last = self.previous.take().map_or_else(Vec::new, |previous| previous.tracks);
        last.into_iter().flatten().for_each(|track| self.end(track));
        let settling = self.settled.iter().map(|(&(since, i), frames)| {
            let points: u64 = frames.values().sum();
            let never = frames.get(&None).copied().unwrap_or_default();
            Settling {
                since,
                error: SMALL_ERRORS[i],
                points,
                median: rank(frames, points.div_ceil(2)),
                p95: rank(frames, (95 * points).div_ceil(100)),
                never: never as f64 / points as f64,
            }
        });
        Stability {
            flicker: self.flicker.mean().map(f64::sqrt),
            ghost_area: self.ghosts.mean(),
            settling: settling.collect(),
        }
    }
}

/// The least number of frames that so many points need no more than; never counts as more than any.
fn rank(frames: &BTreeMap<Option<u32>, u64>, wanted: u64) -> Option<u32> {
    let mut points = 0;
    let settled = frames.iter().filter_map(|(frames, count)| Some(((*frames)?, count)));
    for (frames, count) in settled {
        points += count;
        if points >= wanted {
            return Some(frames);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(visibility: &[f32]) -> Image {
        let mut image = Image::new([visibility.len() as u32, 1]);
        image.add("light.visibility", visibility.to_vec());
        image
    }

    /// Pixels that show the same points in both frames.
    fn still(count: usize) -> Vec<Option<u32>> {
        (0..count as u32).map(Some).collect()
    }

    #[test]
    fn an_error_that_stays_does_not_flicker_and_one_that_comes_does() {
        let mut meter = SequenceMeter::default();
        // Lit, penumbra, penumbra, dark; binary fractions, so that differences are exact.
        let reference = image(&[1.0, 0.5, 0.25, 0.0]);
        let first = meter.add(&image(&[1.0, 0.75, 0.25, 0.0]), &reference, &still(4)).expect("comparable");
        assert_eq!(first.flicker, None);
        let second = meter.add(&image(&[1.0, 0.75, 0.25, 0.0]), &reference, &still(4)).expect("comparable");
        assert_eq!(second.flicker, Some(0.0));
        // One of the two pixels of the penumbra by ¼; what happens outside is no flicker of the penumbra.
        let third = meter.add(&image(&[0.5, 0.75, 0.5, 0.0]), &reference, &still(4)).expect("comparable");
        assert_eq!(third.flicker, Some((0.0625f64 / 2.0).sqrt()));
        // Over both changes.
        assert_eq!(meter.finish().flicker, Some((0.0625f64 / 4.0).sqrt()));
    }

    #[test]
    fn a_shadow_that_moves_as_it_should_does_not_flicker() {
        let mut meter = SequenceMeter::default();
        for shadow in [[0.0, 0.5, 1.0], [0.5, 1.0, 1.0], [1.0, 1.0, 1.0]] {
            let change = meter.add(&image(&shadow), &image(&shadow), &still(3)).expect("comparable");
            assert!(change.flicker.is_none_or(|flicker| flicker == 0.0));
        }
        let stability = meter.finish();
        assert_eq!((stability.flicker, stability.ghost_area), (Some(0.0), Some(0.0)));
    }

    #[test]
    fn a_ghost_is_a_residue_of_what_was_there() {
        let mut meter = SequenceMeter::default();
        // A shadow goes from the first pixel to the second; the third was always lit, and is off from the start.
        meter.add(&image(&[0.0, 1.0, 0.5, 1.0]), &image(&[0.0, 1.0, 1.0, 1.0]), &still(4)).expect("comparable");
        let change = meter.add(&image(&[0.25, 0.5, 0.5, 1.0]), &image(&[1.0, 0.0, 1.0, 1.0]), &still(4));
        assert_eq!(change.expect("comparable").ghost_area, Some(0.5));
        // An error of 1/50 itself is none.
        let faint = 1.0 - 1.0 / 64.0;
        let change = meter.add(&image(&[faint, 0.0, 0.5, 1.0]), &image(&[1.0, 0.0, 1.0, 1.0]), &still(4));
        assert_eq!(change.expect("comparable").ghost_area, Some(0.0));
        // Two of eight pixels; the first frame has no earlier one, and is not counted.
        assert_eq!(meter.finish().ghost_area, Some(0.25));
    }

    #[test]
    fn what_comes_into_view_has_no_past() {
        let mut meter = SequenceMeter::default();
        meter.add(&image(&[0.0, 0.0]), &image(&[0.0, 0.0]), &still(2)).expect("comparable");
        // The second pixel shows a point that the first frame did not see: it is off, but not for what was there.
        let change = meter.add(&image(&[0.5, 0.5]), &image(&[1.0, 1.0]), &[Some(0), None]);
        assert_eq!(change.expect("comparable").ghost_area, Some(0.5));
    }

    #[test]
    fn frames_are_counted_until_the_error_stays_below() {
        let mut meter = SequenceMeter::default();
        let reference = image(&[0.5; 4]);
        // Off by 1/128 (over 1/255, under 1e-2) or by 1/4: at once below; below from the third frame on, after a relapse;
        // below 1e-2 alone; never.
        let [near, far] = [0.5 + 1.0 / 128.0, 0.75];
        for test in [[0.5, 0.5, near, far], [0.5, far, near, far], [0.5, 0.5, near, far]] {
            meter.add(&image(&test), &reference, &still(4)).expect("comparable");
        }
        let stability = meter.finish();
        let [strict, loose] = SMALL_ERRORS.map(|error| stability.settling(Since::Start, error).expect("points"));
        assert_eq!((strict.points, strict.never, strict.median, strict.p95), (4, 0.5, Some(3), None));
        // 1, 1, 3, never.
        assert_eq!((loose.points, loose.never, loose.median, loose.p95), (4, 0.25, Some(1), None));
        assert_eq!(stability.settling(Since::Disocclusion, 1e-2), None);
    }

    #[test]
    fn points_are_followed_as_they_move_and_counted_when_they_leave() {
        let mut meter = SequenceMeter::default();
        let reference = image(&[0.5; 3]);
        // The view moves by a pixel a frame: a new point comes in on the left, the last one leaves on the right. Each point is
        // off in its first frame alone.
        let moved = [None, Some(0), Some(1)];
        for test in [[1.0, 1.0, 1.0], [1.0, 0.5, 0.5], [1.0, 0.5, 0.5]] {
            meter.add(&image(&test), &reference, &moved).expect("comparable");
        }
        let stability = meter.finish();
        let start = stability.settling(Since::Start, 1e-2).expect("points");
        // One has left after its first frame, never below; the two others took two frames.
        assert_eq!((start.points, start.median, start.never), (3, Some(2), 1.0 / 3.0));
        let later = stability.settling(Since::Disocclusion, 1e-2).expect("points");
        // One came in the second frame and took two; the other in the last one, and had no time.
        assert_eq!((later.points, later.median, later.p95, later.never), (2, Some(2), None, 0.5));
    }

    #[test]
    fn pooled_errors_are_those_of_all_pixels() {
        let pairs =
            [(image(&[0.5, 1.0, 0.25]), image(&[0.75, 1.0, 0.25])), (image(&[1.0, 0.0, 0.5]), image(&[0.5, 0.0, 1.0]))];
        let report = |(test, reference): &(Image, Image)| {
            crate::metrics::compare(test, reference, &Mask::ALL).expect("comparable").lights.remove(0)
        };
        let pooled = pool(&pairs.iter().map(report).collect::<Vec<_>>());
        // ¼ and 0 in the first image's penumbra, ½ in the second's.
        let penumbra = pooled.masks[&Mask::Penumbra];
        assert_eq!((penumbra.count, penumbra.max, penumbra.p99), (3, Some(0.5), None));
        let rmse = ((0.0625 + 0.25) / 3.0f64).sqrt();
        // Two square roots and their squares.
        assert!((penumbra.rmse.expect("some") / rmse - 1.0).abs() < 4.0 * f64::EPSILON);
        assert!((penumbra.bias.expect("some") - (0.5 - 0.25) / 3.0).abs() < f64::EPSILON);
        assert_eq!(pooled.false_umbra.map(|outliers| (outliers.count, outliers.rmse)), Some((1, Some(0.5))));
        assert_eq!(pooled.false_light.map(|outliers| outliers.count), Some(0));
    }

    #[test]
    fn a_shadow_that_leaves_makes_nothing_converge() {
        let mut meter = SequenceMeter::default();
        // The first point is off for as long as it is in the penumbra, the second is so in its first frame alone.
        let frames = [([0.75, 0.75], [0.5, 0.5]), ([0.75, 0.5], [0.5, 0.5]), ([1.0, 1.0], [1.0, 1.0])];
        for (test, reference) in frames {
            meter.add(&image(&test), &image(&reference), &still(2)).expect("comparable");
        }
        let settling = meter.finish().settling(Since::Start, 1e-2).expect("points");
        assert_eq!((settling.points, settling.median, settling.p95, settling.never), (2, Some(2), None, 0.5));
    }

    #[test]
    fn pixels_without_surface_or_light_are_in_no_figure() {
        let with = |visibility: &[f32; 3]| {
            let mut image = image(visibility);
            image.add("light.facing", vec![1.0, 0.0, 1.0]);
            image.add("coverage.A", vec![0.0, 1.0, 1.0]);
            image
        };
        let mut meter = SequenceMeter::default();
        for test in [[0.0, 0.0, 0.5], [1.0, 1.0, 0.5]] {
            meter.add(&with(&test), &with(&[0.5; 3]), &still(3)).expect("comparable");
        }
        let stability = meter.finish();
        assert_eq!((stability.flicker, stability.ghost_area), (Some(0.0), Some(0.0)));
        assert!(stability.settling.iter().all(|settling| settling.points == 1 && settling.median == Some(1)));
    }
}
