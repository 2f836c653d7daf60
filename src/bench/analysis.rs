//! What follows from measured times and errors: medians, hulls, interpolation.

use serde::{Deserialize, Serialize};
use statrs::statistics::{Data, OrderStatistics};

/// The step of an image's 32-bit floats just below 1: what two images of the same answer may differ by. A smaller RMSE is
/// taken for it where logarithms are asked for.
pub const LEAST_ERROR: f64 = 1.0 / (1 << 24) as f64;

/// How far two times may be apart, as a fraction, to count as equal.
pub const EQUAL_TIME: f64 = 0.05;

/// A median with its quartiles. Quantiles are those of Hyndman and Fan 1996, definition 8: independent of the distribution,
/// median-unbiased.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Half of the values lie below.
    pub median: f64,
    /// A quarter of the values lies below.
    pub q1: f64,
    /// Three quarters of the values lie below.
    pub q3: f64,
}

impl Spread {
    /// Of some values; none of none.
    pub fn of(values: Vec<f64>) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        let mut data = Data::new(values);
        Some(Self { median: data.median(), q1: data.lower_quartile(), q3: data.upper_quartile() })
    }
}

/// A measured time with the error that it bought.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Point {
    /// Any unit, above 0.
    pub time: f64,
    /// Not negative.
    pub error: f64,
}

impl Point {
    fn log(self) -> [f64; 2] {
        [self.time.ln(), self.error.max(LEAST_ERROR).ln()]
    }
}

/// The lower-left convex hull over the logarithms of time and error, from the fastest point to the most accurate: times rise
/// and errors fall along it. What lies above it is beaten, or met by interpolation between settings. Indices into `points`.
pub fn hull(points: &[Point]) -> Vec<usize> {
    let logs: Vec<[f64; 2]> = points.iter().map(|point| point.log()).collect();
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|&a, &b| logs[a][0].total_cmp(&logs[b][0]).then(logs[a][1].total_cmp(&logs[b][1])));
    let mut chain: Vec<usize> = Vec::new();
    for i in order {
        // Only what is more accurate than all that is faster.
        if chain.last().is_some_and(|&last| logs[i][1] >= logs[last][1]) {
            continue;
        }
        // Andrew's monotone chain: a middle point on or above the line between its neighbours goes.
        while let [.., a, b] = chain[..] {
            let [ab, ai] = [b, i].map(|j| [logs[j][0] - logs[a][0], logs[j][1] - logs[a][1]]);
            if ab[0] * ai[1] - ab[1] * ai[0] > 0.0 {
                break;
            }
            chain.pop();
        }
        chain.push(i);
    }
    chain
}

/// The least time to an error of at most `error` along a hull, by interpolation of the logarithms; none where the hull does
/// not come down to it.
pub fn time_to(hull: &[Point], error: f64) -> Option<f64> {
    let wanted = error.max(LEAST_ERROR).ln();
    let first = hull.first()?;
    if first.log()[1] <= wanted {
        return Some(first.time);
    }
    segment(hull, |_, error| error <= wanted).map(|[[t0, e0], [t1, e1]]| {
        let share = (wanted - e0) / (e1 - e0);
        (t0 + share * (t1 - t0)).exp()
    })
}

/// The least error within a time along a hull, by interpolation of the logarithms; none where the hull begins later.
pub fn error_at(hull: &[Point], time: f64) -> Option<f64> {
    let wanted = time.ln();
    if hull.first()?.log()[0] > wanted {
        return None;
    }
    let along = segment(hull, |time, _| time >= wanted).map(|[[t0, e0], [t1, e1]]| {
        let share = (wanted - t0) / (t1 - t0);
        (e0 + share * (e1 - e0)).exp()
    });
    // Time that a technique has no use for changes nothing.
    along.or_else(|| hull.last().map(|last| last.log()[1].exp()))
}

/// The first segment of a hull, in logarithms, whose end reaches something.
fn segment(hull: &[Point], reaches: impl Fn(f64, f64) -> bool) -> Option<[[f64; 2]; 2]> {
    hull.windows(2).map(|pair| [pair[0].log(), pair[1].log()]).find(|[_, [time, error]]| reaches(*time, *error))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(time: f64, error: f64) -> Point {
        Point { time, error }
    }

    #[track_caller]
    fn assert_near(found: Option<f64>, expected: f64) {
        let found = found.expect("a value");
        // Some ten roundings of logarithms below 20 in magnitude.
        assert!((found / expected - 1.0).abs() < 1e-13, "{found} for {expected}");
    }

    #[test]
    fn quartiles_of_five_numbers() {
        // Definition 8: place (n + 1/3)·p + 1/3, counted from 1. At n = 5: 1/4 at 5/3, 3/4 at 13/3.
        let spread = Spread::of(vec![50.0, 10.0, 40.0, 20.0, 30.0]).expect("values");
        assert_eq!(spread.median, 30.0);
        assert_near(Some(spread.q1), 10.0 + 10.0 * 2.0 / 3.0);
        assert_near(Some(spread.q3), 40.0 + 10.0 / 3.0);
    }

    #[test]
    fn median_of_an_even_number_lies_between_the_middle_two() {
        assert_near(Spread::of(vec![4.0, 1.0, 3.0, 2.0]).map(|spread| spread.median), 2.5);
        assert_eq!(Spread::of(Vec::new()), None);
    }

    #[test]
    fn hull_leaves_out_what_is_beaten_and_what_interpolation_beats() {
        let points = [
            point(100.0, 0.001), // the most accurate
            point(1.0, 0.1),     // the fastest
            point(1.0, 0.2),     // as fast, less accurate
            point(10.0, 0.05),   // above the line from (1, 0.1) to (100, 0.001), which is at 0.01
            point(20.0, 0.002),  // below the line, which is at 0.005
            point(200.0, 0.001), // slower for the same
        ];
        assert_eq!(hull(&points), [1, 4, 0]);
        assert_eq!(hull(&[]), Vec::<usize>::new());
        assert_eq!(hull(&points[..1]), [0]);
    }

    #[test]
    fn three_points_on_a_line_need_no_middle_one() {
        // 2^k is exact in floats, its logarithm within an ulp: either answer is a hull of the same line.
        let line = hull(&[point(1.0, 0.25), point(2.0, 0.125), point(4.0, 0.0625)]);
        assert!(line == [0, 2] || line == [0, 1, 2], "{line:?}");
    }

    #[test]
    fn interpolation_is_along_powers() {
        // The error falls tenfold as the time rises a hundredfold: e = 0.1 · t^-½.
        let hull = [point(1.0, 0.1), point(100.0, 0.01), point(1000.0, 0.001)];
        assert_near(time_to(&hull, 0.1 / 10f64.sqrt()), 10.0);
        assert_near(error_at(&hull, 10.0), 0.1 / 10f64.sqrt());
        // e = 0.01 · (t/100)^-1 on the second segment.
        assert_near(time_to(&hull, 0.005), 200.0);
        assert_near(error_at(&hull, 500.0), 0.002);
        // Its ends.
        assert_near(time_to(&hull, 0.1), 1.0);
        assert_near(time_to(&hull, 0.001), 1000.0);
    }

    #[test]
    fn beyond_a_hull() {
        let hull = [point(1.0, 0.1), point(100.0, 0.01)];
        assert_near(time_to(&hull, 0.5), 1.0);
        assert_eq!(time_to(&hull, 0.009), None);
        assert_eq!(error_at(&hull, 0.9), None);
        assert_near(error_at(&hull, 1e6), 0.01);
        assert_eq!((time_to(&[], 0.1), error_at(&[], 1.0)), (None, None));
    }

    #[test]
    fn no_error_at_all_counts_as_the_step_of_a_float() {
        let hull = [point(1.0, LEAST_ERROR * 4.0), point(16.0, 0.0)];
        assert_near(error_at(&hull, 16.0), LEAST_ERROR);
        assert_near(time_to(&hull, 2.0 * LEAST_ERROR), 4.0);
        assert_near(time_to(&hull, 0.0), 16.0);
    }
}
