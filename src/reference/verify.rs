//! An image's error, measured against exact answers at some of its receivers.

use serde::Serialize;

use super::exact::Exact;
use crate::Result;
use crate::geometry::bvh::SceneBvh;
use crate::metrics::rmse_interval;
use crate::progress::Progress;
use crate::receivers::Receivers;
use crate::scene::{AreaLight, Scene};
use crate::techniques::{Frame, LightImage, Technique};

/// Picks the receivers: the same ones for the same image, so that nothing changes from run to run.
const SEED: u64 = 0x5eed_0f07_2ec3_1ae5;

/// Receivers a row of the image of them that is evaluated: one step of progress.
const ROW: u32 = 8;

/// The error of a light's visibility over all receivers that some of it faces, estimated from some of them.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Verified {
    /// Receivers that were evaluated.
    pub receivers: u32,
    /// Root of the mean square error of V; the estimate.
    pub rmse: f64,
    /// Where it lies in 95 of 100 images.
    pub rmse_ci95: [f64; 2],
    /// The largest error that was seen.
    pub max: f64,
    /// Receivers among them whose exact answer had to be sampled.
    pub sampled: u32,
}

/// Steps of progress that verifying one light takes at most.
pub fn steps(count: u32) -> u64 {
    u64::from(count.div_ceil(ROW))
}

/// Measures a light's image at `count` receivers, drawn uniformly from those that the light faces; at all of them where there
/// are no more.
///
/// # Errors
/// [`crate::Error::Cancelled`].
pub fn verify(
    scene: &Scene,
    bvh: &SceneBvh,
    receivers: &Receivers,
    (light, image): (&AreaLight, &LightImage),
    count: u32,
    progress: &Progress,
) -> Result<Verified> {
    let facing: Vec<usize> = (0..receivers.pixels.len()).filter(|&i| image.facing[i]).collect();
    let mut chosen = fastrand::Rng::with_seed(SEED).choose_multiple(facing.iter().copied(), count as usize);
    chosen.sort_unstable();
    let rows = (chosen.len() as u32).div_ceil(ROW);
    let mut pixels: Vec<_> = chosen.iter().map(|&index| receivers.pixels[index]).collect();
    pixels.resize((rows * ROW) as usize, None);
    let subset = Receivers { size: [ROW, rows], pixels };
    let exact = Exact.render(
        &Frame { scene, bvh, receivers: &subset, irradiance: false, progress, buffers: None, shot: None },
        light,
    )?;
    progress.advance(steps(count) - u64::from(rows))?;
    let difference = |(&index, &truth): (&usize, &f32)| f64::from(image.visibility[index]) - f64::from(truth);
    let errors: Vec<f64> = chosen.iter().zip(&exact.visibility).map(difference).collect();
    let estimate = rmse_interval(&errors, facing.len() as u64);
    Ok(Verified {
        receivers: errors.len() as u32,
        rmse: estimate.rmse,
        rmse_ci95: estimate.ci95,
        max: estimate.max,
        sampled: exact.sampled.iter().filter(|&&sampled| sampled).count() as u32,
    })
}
