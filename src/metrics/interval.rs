//! The RMSE of a whole image, estimated from its errors at a few random receivers.
//!
//! Student's t interval for the logarithm of the mean square (delta method), with the finite-population correction of
//! Cochran 1977, "Sampling Techniques", section 2.6. Its degrees of freedom are Kish's effective number of squared
//! errors (Kish 1965, "Survey Sampling", section 11.7) instead of the N − 1 of a plain mean: where few receivers lie in
//! a penumbra, and few of these hold most of the error, it is from those few that the variance is known, whatever N is.
//! That choice is ours, by what it covers: `tests/verify_interval.rs` measures it for 40 pairs of a scene and a setting of `rays`.
//! N − 1 degrees, percentile and BCa bootstraps and empirical likelihood all fell short where few receivers err.
//!
//! Where t knows nothing (all errors alike) or too little (one that is not 0), the bound of Hoeffding 1963,
//! "Probability Inequalities for Sums of Bounded Random Variables", Eq. 2.1, limits the interval: it needs no more than
//! |error| ≤ 1, and holds for draws without replacement (his section 6).

use serde::Serialize;
use statrs::distribution::{ContinuousCDF, StudentsT};

/// The RMSE of a population of which a part was seen.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RmseEstimate {
    /// Root of the mean squared error of the members seen; NaN (`null` in JSON) where none of any was seen.
    pub rmse: f64,
    /// Holds the RMSE of all members for 95 % of samples; within [0, 1].
    pub ci95: [f64; 2],
    /// Largest absolute error seen; that of all members may be larger.
    pub max: f64,
}

/// What a 95 % interval misses on either side.
const TAIL: f64 = 0.025;

/// Estimates the RMSE of a population.
///
/// `errors`: signed, each in [-1, 1], at distinct uniformly random members of a population of `population` members.
/// What is no error must be 0 exactly: rounding tells as little as zeros do about the members unseen, yet is taken at
/// its word.
///
/// - All members seen: the interval is the point. No members at all: 0.
/// - None seen of some: nothing is known. The RMSE is NaN, which is below no limit, and the interval [0, 1].
/// - Zeros alone: errors may be elsewhere, of at most 1. A share p of them is missed with a chance of (1 − p)^N, so
///   that the mean square may be 1 − 0.025^(1/N), about 3.7/N: an RMSE of 0.085 for 512. (The rule of three, 3/N, puts
///   all of the 5 % on this side; with what an interval misses where errors are seen, that would be more than 5 %.)
/// - Few that are not 0: wide, as it must be, but never above what Hoeffding's bound leaves.
///
/// No sample tells of what it is too small to hold: errors far above `max` at one in N of the members are missed by one
/// sample in e, and then the interval is that of the other members.
///
/// # Panics
/// If there are more errors than members, or one is not in [-1, 1].
pub fn rmse_interval(errors: &[f64], population: u64) -> RmseEstimate {
    let seen = errors.len() as u64;
    assert!(seen <= population, "{seen} errors of {population} members");
    assert!(errors.iter().all(|error| error.abs() <= 1.0), "an error is not in [-1, 1]");
    if seen == 0 {
        let [rmse, high] = if population == 0 { [0.0, 0.0] } else { [f64::NAN, 1.0] };
        return RmseEstimate { rmse, ci95: [0.0, high], max: 0.0 };
    }
    let max = errors.iter().fold(0f64, |max, error| max.max(error.abs()));
    // Squared in units of the largest, so that none is too small for it.
    let unit = if max > 0.0 { max } else { 1.0 };
    let squares: Vec<f64> = errors.iter().map(|error| (error / unit).powi(2)).collect();
    let count = seen as f64;
    let mean = squares.iter().sum::<f64>() / count;
    let rmse = unit * mean.sqrt();
    if seen == population {
        return RmseEstimate { rmse, ci95: [rmse; 2], max };
    }

    let mean_square = rmse * rmse;
    let seen_share = count / population as f64;
    // What was seen is part of the population; the rest errs by 0 at least and 1 at most.
    let seen_square = seen_share * mean_square;
    let [mut low, mut high] = hoeffding_bounds(mean_square, count);
    [low, high] = [low.max(seen_square), high.min(seen_square + 1.0 - seen_share)];
    if squares.iter().any(|&square| square != squares[0]) {
        let variance = squares.iter().map(|square| (square - mean).powi(2)).sum::<f64>() / (count - 1.0);
        let relative_error = (variance / count * (1.0 - seen_share)).sqrt() / mean;
        let effective = (count * mean).powi(2) / squares.iter().map(|square| square.powi(2)).sum::<f64>();
        let factor = (t_quantile(effective.min(count - 1.0)) * relative_error).exp();
        [low, high] = [low.max(mean_square / factor), high.min(mean_square * factor)];
    }
    // Rounding must not put the estimate outside.
    RmseEstimate { rmse, ci95: [low.sqrt().min(rmse), high.sqrt().max(rmse)], max }
}

/// What Student's t exceeds in 2.5 % of cases.
fn t_quantile(degrees_of_freedom: f64) -> f64 {
    // At least 1: a single error is the effective number 1, to rounding. At most 10⁴, where t is within 1.2e-4 of the
    // normal quantile z (Abramowitz and Stegun 1964, Eq. 26.7.5: z + (z³ + z)/4ν): statrs 0.19 does not return at 10⁸.
    let degrees_of_freedom = degrees_of_freedom.clamp(1.0, 1e4);
    StudentsT::new(0.0, 1.0, degrees_of_freedom).expect("at least one degree").inverse_cdf(1.0 - TAIL)
}

/// Between which means of numbers in [0, 1] the chance to find `mean` or worse in `count` of them may be above 2.5 %.
fn hoeffding_bounds(mean: f64, count: f64) -> [f64; 2] {
    // Eq. 2.1 with the divergence D of two Bernoulli distributions: the chance is at most exp(−N D(mean ‖ μ)).
    let term = |p: f64, q: f64| if p > 0.0 { p * (p / q).ln() } else { 0.0 };
    let allows = |mu: f64| term(mean, mu) + term(1.0 - mean, 1.0 - mu) <= -TAIL.ln() / count;
    // D grows away from the mean on either side; halve the way to 0 and to 1 as often as f64 has digits.
    [0.0, 1.0].map(|end| {
        let (mut inside, mut outside) = (mean, end);
        for _ in 0..f64::MANTISSA_DIGITS {
            let middle = 0.5 * (inside + outside);
            *(if allows(middle) { &mut inside } else { &mut outside }) = middle;
        }
        outside
    })
}
