//! What the benchmarks share: scenes, rays, Embree, and what they tell of the machine.

pub mod cases;
pub mod check;
pub mod embree;
#[path = "../../../tests/common/judged.rs"]
pub mod judged;
pub mod machine;

/// What a benchmark's parts return.
pub type Outcome<T> = Result<T, Box<dyn std::error::Error>>;

/// Slope and height at zero of the line of least squares through points.
pub fn line_through(points: &[(f64, f64)]) -> (f64, f64) {
    let count = points.len() as f64;
    let mean_x = points.iter().map(|(x, _)| x).sum::<f64>() / count;
    let mean_y = points.iter().map(|(_, y)| y).sum::<f64>() / count;
    let covariance: f64 = points.iter().map(|(x, y)| (x - mean_x) * (y - mean_y)).sum();
    let variance: f64 = points.iter().map(|(x, _)| (x - mean_x).powi(2)).sum();
    let slope = covariance / variance;
    (slope, mean_y - slope * mean_x)
}
