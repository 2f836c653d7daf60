//! The interval of an RMSE from errors at random receivers: what it covers, how wide it is, and what it says where it
//! knows little.

mod common;

use std::sync::LazyLock;

use common::*;
use penumbra::metrics::{RmseEstimate, rmse_interval};
use penumbra::progress::Progress;
use penumbra::receivers::Receivers;
use penumbra::reference::exact::Exact;
use penumbra::render::{Rendering, Request, render, render_receivers};
use penumbra::sampling::Pattern;
use penumbra::scene::Scene;
use penumbra::scene::procedural::build;
use penumbra::techniques::rays::Rays;

/// Receivers asked for, as `--verify 512` does.
const ASKED: usize = 512;

/// Procedural scenes; the share of receivers in a penumbra goes from 1.3 % (`contact`) and 2 % (`square`) to 42 %.
const SCENES: [&str; 8] = [
    "edge?angle=20&x=0.013",
    "disks?light=0.4",
    "square?light=0.03",
    "wire",
    "sphere",
    "demo",
    "two-edges?x=0.013",
    "contact?light=0.1",
];

/// Settings of `rays`.
const SETTINGS: [(Pattern, u32); 5] =
    [(Pattern::Grid, 16), (Pattern::Grid, 64), (Pattern::Jittered, 16), (Pattern::Halton, 64), (Pattern::Sobol, 64)];

/// The exact V of the scene's light at each receiver.
fn truth(scene: &Scene, receivers: &Receivers) -> Vec<f32> {
    let rendering = render_receivers(scene, receivers.clone(), &Exact, false, &Progress::default()).expect("renders");
    rendering.lights.into_iter().next().expect("a light").visibility
}

/// The errors of one setting at all receivers of an image.
struct Population {
    name: String,
    errors: Vec<f64>,
    rmse: f64,
}

/// Every setting in every scene.
static POPULATIONS: LazyLock<Vec<Population>> = LazyLock::new(|| {
    let mut populations = Vec::new();
    for spec in SCENES {
        let scene = build(spec).expect("builds").scene;
        let view = |rays: &Rays| -> Rendering {
            let request = Request { size: [160, 120], irradiance: false, shaded: None, antialiasing: 1, verify: None };
            render(&scene, &scene.cameras[0], rays, &request, &Progress::default()).expect("renders")
        };
        let renderings = SETTINGS.map(|(pattern, samples)| view(&rays(pattern, samples)));
        let expected = truth(&scene, &renderings[0].receivers);
        for ((pattern, samples), rendering) in SETTINGS.into_iter().zip(renderings) {
            let light = &rendering.lights[0];
            // Where the light faces away, and where no surface is, there is nothing to be wrong about.
            let errors: Vec<f64> = (0..expected.len())
                .filter(|&i| light.facing[i])
                .map(|i| f64::from(light.visibility[i]) - f64::from(expected[i]))
                .collect();
            let rmse = rmse(&errors);
            populations.push(Population { name: format!("{spec} {pattern:?} {samples}"), errors, rmse });
        }
    }
    populations
});

fn rmse(errors: &[f64]) -> f64 {
    (errors.iter().map(|error| error * error).sum::<f64>() / errors.len() as f64).sqrt()
}

/// What samples of a population say of it.
struct Trials {
    covered: usize,
    /// Half of each interval over the true RMSE.
    half_widths: Vec<f64>,
}

fn trials(population: &Population, count: usize, seed: u64) -> Trials {
    let mut random = Random(seed);
    let mut shuffled = population.errors.clone();
    let mut trials = Trials { covered: 0, half_widths: Vec::new() };
    for _ in 0..count {
        // The first steps of a shuffle draw without replacement (Fisher and Yates; Knuth's algorithm P).
        for i in 0..ASKED {
            let other = i + random.below(shuffled.len() - i);
            shuffled.swap(i, other);
        }
        let RmseEstimate { ci95: [low, high], .. } = rmse_interval(&shuffled[..ASKED], shuffled.len() as u64);
        trials.covered += usize::from(low <= population.rmse && population.rmse <= high);
        trials.half_widths.push(0.5 * (high - low) / population.rmse);
    }
    trials
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn interval_covers_the_rmse_in_93_to_99_of_100_trials_and_is_narrow() {
    let all: Vec<Trials> = (0..).zip(POPULATIONS.iter()).map(|(seed, p)| trials(p, 25, seed)).collect();
    let half_widths: Vec<f64> = all.iter().flat_map(|trials| trials.half_widths.iter().copied()).collect();
    assert_eq!(half_widths.len(), 1000);
    let covered = all.iter().map(|trials| trials.covered).sum::<usize>();
    assert!((930..=990).contains(&covered), "{covered} of 1000");
    let half_width = median(half_widths);
    assert!(half_width <= 0.25, "{half_width} of the RMSE");
}

#[test]
fn interval_holds_in_every_scene_with_every_setting() {
    for (seed, population) in (100..).zip(POPULATIONS.iter()) {
        let trials = trials(population, 1000, seed);
        assert!(trials.covered >= 900, "{}: {} of 1000", population.name, trials.covered);
    }
}

/// `hits` errors of `size`, and zeros to make `count`.
fn with_hits(count: usize, hits: usize, size: f64) -> Vec<f64> {
    let mut errors = vec![0.0; count];
    errors[..hits].fill(size);
    errors
}

/// The chances of 0, 1, … hits among `count` of `population` members, `marked` of which are hits.
fn chances_of_hits(count: usize, population: usize, marked: usize) -> Vec<f64> {
    // Of none: each draw goes past all that are marked. Then the ratio of two hypergeometric chances.
    let mut chance: f64 =
        (0..count).map(|i| (population - i).saturating_sub(marked) as f64 / (population - i) as f64).product();
    let mut chances = Vec::new();
    for hits in 0..=count.min(marked) {
        chances.push(chance);
        let more = (marked - hits) as f64 * (count - hits) as f64;
        chance *= more / ((hits + 1) as f64 * (population + hits + 1 - marked - count) as f64);
    }
    chances
}

#[test]
fn errors_of_one_size_are_covered_at_every_share() {
    // No trials: the chance of each number of hits is known, and with it that of an interval that holds the truth.
    let population = 20_000;
    for size in [1.0, 0.01] {
        let intervals: Vec<[f64; 2]> =
            (0..=ASKED).map(|hits| rmse_interval(&with_hits(ASKED, hits, size), population as u64).ci95).collect();
        for marked in (1..population / 2).step_by(7) {
            let rmse = size * (marked as f64 / population as f64).sqrt();
            let chances = chances_of_hits(ASKED, population, marked);
            let covered: f64 = chances
                .iter()
                .zip(&intervals)
                .filter(|(_, [low, high])| (*low..=*high).contains(&rmse))
                .map(|(chance, _)| chance)
                .sum();
            // A count moves in steps, so that no interval that follows it keeps 95 % everywhere (Brown, Cai and
            // DasGupta 2001, "Interval Estimation for a Binomial Proportion"); the worst found is 94.6 %.
            assert!(covered > 0.94, "{marked} of {size}: {covered}");
        }
    }
}

#[test]
fn zeros_leave_the_error_that_they_miss_with_a_chance_of_a_fortieth() {
    for count in [1, 10, 512] {
        let estimate = rmse_interval(&vec![0.0; count], 1_000_000);
        assert_eq!((estimate.rmse, estimate.ci95[0], estimate.max), (0.0, 0.0, 0.0));
        // All of the mean square is a share of errors of 1.
        let missed = (1.0 - estimate.ci95[1].powi(2)).powi(count as i32);
        assert!((missed - 0.025).abs() < 1e-9, "{count}: {missed}");
    }
}

#[test]
fn a_census_is_the_point() {
    for errors in [vec![0.0; 3], vec![0.1, -0.3, 0.0, 0.0], vec![1.0], vec![-1.0; 5], vec![1e-200, 0.0]] {
        let estimate = rmse_interval(&errors, errors.len() as u64);
        assert_eq!(estimate.ci95, [estimate.rmse; 2]);
        let scale = estimate.max.max(f64::MIN_POSITIVE);
        let expected = scale * rmse(&errors.iter().map(|error| error / scale).collect::<Vec<_>>());
        assert!((estimate.rmse - expected).abs() <= 4.0 * f64::EPSILON * expected, "{errors:?}");
    }
}

#[test]
fn interval_only_shrinks_on_the_way_to_a_census() {
    for hits in [0, 1, 3, 100] {
        let errors = with_hits(ASKED, hits, 0.05);
        let mut last = 1.0;
        for unseen in [1_000_000, 512, 100, 10, 1] {
            let RmseEstimate { rmse, ci95: [low, high], .. } = rmse_interval(&errors, (ASKED + unseen) as u64);
            assert!(high - low <= last, "{hits} hits, {unseen} unseen");
            // Of the unseen each errs by at most 1.
            let population = (ASKED + unseen) as f64;
            let seen_square = rmse.powi(2) * ASKED as f64;
            // A share is rounded by half of ε, and so is what it leaves of 1.
            assert!(low.powi(2) >= seen_square / population - 2.0 * f64::EPSILON);
            assert!(high.powi(2) <= (seen_square + unseen as f64) / population + 2.0 * f64::EPSILON);
            last = high - low;
        }
    }
}

#[test]
fn nothing_seen_is_nothing_known() {
    let estimate = rmse_interval(&[], 100);
    assert!(estimate.rmse.is_nan());
    assert_eq!((estimate.ci95, estimate.max), ([0.0, 1.0], 0.0));
    let json = serde_json::to_value(estimate).expect("serialises");
    assert_eq!(json, serde_json::json!({ "rmse": null, "ci95": [0.0, 1.0], "max": 0.0 }));
    assert_eq!(rmse_interval(&[], 0), RmseEstimate { rmse: 0.0, ci95: [0.0; 2], max: 0.0 });
}

#[test]
fn one_error_says_little_of_the_others() {
    for size in [1.0, 0.1, 1e-3, 1e-9] {
        let RmseEstimate { rmse, ci95: [low, high], max } = rmse_interval(&with_hits(ASKED, 1, size), 1_000_000);
        assert_eq!(max, size);
        assert!((rmse - size / (ASKED as f64).sqrt()).abs() <= 1e-15 * size);
        // Garwood 1936: of a count of 1, the mean is in [0.0253, 5.572] at 95 %.
        assert!(low < 0.0253f64.sqrt() * rmse && 5.572f64.sqrt() * rmse < high, "{size}: {low} {high}");
    }
    // A leak: no share above what gives one hit or none with a chance of a fortieth is left by a bound that is exact,
    // and Hoeffding's is at most a sixth above it.
    let high = rmse_interval(&with_hits(ASKED, 1, 1.0), 1_000_000).ci95[1];
    let at_most_one = |share: f64| {
        let missed = 1.0 - share;
        missed.powi(512) + 512.0 * share * missed.powi(511)
    };
    assert!(at_most_one(high.powi(2)) < 0.025 && at_most_one(high.powi(2) / 1.2) > 0.025, "{high}");
}

#[test]
fn leaks_alone_bound_the_share_of_others() {
    let estimate = rmse_interval(&[1.0; ASKED], 1_000_000);
    assert_eq!((estimate.rmse, estimate.ci95[1]), (1.0, 1.0));
    let missed = estimate.ci95[0].powi(2).powi(512);
    assert!((missed - 0.025).abs() < 1e-9, "{missed}");
}

#[test]
fn errors_all_alike_say_no_more_than_their_number() {
    let mut last = [0.0, 1.0];
    for count in [1, 2, 16, 512, 100_000] {
        let RmseEstimate { rmse, ci95: [low, high], .. } = rmse_interval(&vec![-0.1; count], 1_000_000);
        assert!((rmse - 0.1).abs() < 1e-15);
        assert!(last[0] < low && low < 0.1 && 0.1 < high && high < last[1], "{count}: {low} {high}");
        // A share of 1 − 0.025^(1/N) is missed with a chance of a fortieth, and may err by 1.
        let missed = 1.0 - 0.025f64.powf(1.0 / count as f64);
        assert!(high.powi(2) > 0.01 + 0.99 * missed - 1e-12, "{count}: {high}");
        last = [low, high];
    }
}

#[test]
fn interval_scales_with_the_errors_and_ignores_their_signs() {
    let mut random = Random(1);
    let errors: Vec<f64> =
        (0..ASKED).map(|_| if random.chance(0.2) { random.between(-1.0, 1.0) } else { 0.0 }).collect();
    let whole = rmse_interval(&errors, 10_000);
    let flipped: Vec<f64> = errors.iter().map(|error| error.abs()).collect();
    assert_eq!(rmse_interval(&flipped, 10_000), whole);
    // A power of two changes no digit.
    for exponent in [1, 10, 300] {
        let scale = 2f64.powi(-exponent);
        let scaled: Vec<f64> = errors.iter().map(|error| scale * error).collect();
        let expected =
            RmseEstimate { rmse: scale * whole.rmse, ci95: whole.ci95.map(|end| scale * end), max: scale * whole.max };
        assert_eq!(rmse_interval(&scaled, 10_000), expected, "{exponent}");
    }
}

#[test]
fn interval_holds_the_estimate_whatever_the_errors() {
    let mut random = Random(2);
    for _ in 0..20_000 {
        let (count, share, power) = (1 + random.below(40), random.between(0.0, 1.2), random.between(0.0, 60.0));
        let errors: Vec<f64> =
            (0..count).map(|_| if random.chance(share) { random.between(0.0, 1.0).powf(power) } else { 0.0 }).collect();
        let population = count + random.below(100);
        let RmseEstimate { rmse, ci95: [low, high], max } = rmse_interval(&errors, population as u64);
        assert!(0.0 <= low && low <= rmse && rmse <= high && high <= 1.0 + f64::EPSILON, "{errors:?}");
        assert!(rmse <= max && max <= 1.0, "{errors:?}");
    }
    // Millions of degrees of freedom.
    let many: Vec<f64> = (0..3_000_000).map(|_| random.between(-0.1, 0.1)).collect();
    let RmseEstimate { rmse, ci95: [low, high], .. } = rmse_interval(&many, u64::MAX);
    // Squares of a uniform variable have the relative deviation 2/√5; half of it for the root, 1.96 of these on either
    // side.
    let expected = 1.96 * (0.8f64 / 3e6).sqrt();
    assert!(((high - low) / rmse - expected).abs() < 0.01 * expected);
}

#[test]
#[should_panic(expected = "3 errors of 2 members")]
fn more_errors_than_members_are_a_bug() {
    rmse_interval(&[0.0; 3], 2);
}

#[test]
fn errors_that_are_none_are_a_bug() {
    for error in [f64::NAN, 1.5, f64::NEG_INFINITY] {
        assert!(std::panic::catch_unwind(|| rmse_interval(&[0.0, error], 9)).is_err(), "{error}");
    }
}
