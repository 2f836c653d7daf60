//! Numerical integration: Gauss–Legendre, and its adaptive use by bisection.

use std::num::NonZeroUsize;
use std::sync::LazyLock;

use gauss_quad::GaussLegendre;

/// Nodes of the rule: exact for polynomials of degree 15. On a quarter of a circle, the longest smooth piece that it is used
/// on without a check, its error for cosines is 4e-20.
const NODES: NonZeroUsize = NonZeroUsize::new(8).expect("not zero");

/// Intervals that one adaptive integral may look at. A jump in a derivative costs two a bisection, and 2⁻³⁰ of the interval
/// is below every tolerance asked for, so this is room for four of them.
const MAX_INTERVALS: usize = 256;

static RULE: LazyLock<GaussLegendre> = LazyLock::new(|| GaussLegendre::new(NODES));

/// ∫f from `from` to `to` by one rule, and the same integral of |f|.
pub fn gauss_with_magnitude(from: f64, to: f64, mut f: impl FnMut(f64) -> f64) -> (f64, f64) {
    let half = 0.5 * (to - from);
    let middle = from + half;
    let (mut sum, mut magnitude) = (0.0, 0.0);
    for &(node, weight) in RULE.as_node_weight_pairs() {
        let value = weight * f(middle + half * node);
        sum += value;
        magnitude += value.abs();
    }
    (half * sum, half.abs() * magnitude)
}

/// ∫f from `from` to `to` by one rule: for smooth functions.
pub fn gauss(from: f64, to: f64, f: impl FnMut(f64) -> f64) -> f64 {
    gauss_with_magnitude(from, to, f).0
}

/// ∫f from `from` to `to`, bisected wherever one rule and its two halves differ by more than `tolerance` times ∫|f| or `floor`,
/// whichever is larger. Work is bounded: an integrand that is all noise is taken as it is after [`MAX_INTERVALS`].
pub fn adaptive(from: f64, to: f64, tolerance: f64, floor: f64, mut f: impl FnMut(f64) -> f64) -> f64 {
    let (whole, magnitude) = gauss_with_magnitude(from, to, &mut f);
    let mut magnitude = magnitude.max(floor);
    let mut pending = vec![(from, to, whole)];
    let mut intervals = 0;
    let mut sum = 0.0;
    while let Some((from, to, whole)) = pending.pop() {
        let middle = from + 0.5 * (to - from);
        let (left, left_magnitude) = gauss_with_magnitude(from, middle, &mut f);
        let (right, right_magnitude) = gauss_with_magnitude(middle, to, &mut f);
        magnitude = magnitude.max(left_magnitude + right_magnitude);
        intervals += 1;
        let converged = (left + right - whole).abs() <= tolerance * magnitude;
        if converged || middle == from || middle == to || intervals + pending.len() + 2 > MAX_INTERVALS {
            sum += left + right;
        } else {
            pending.push((middle, to, right));
            pending.push((from, middle, left));
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smooth_integrals_are_exact_to_rounding() {
        assert!((gauss(0.0, 1.0, f64::exp) - 1f64.exp_m1()).abs() < 4.0 * f64::EPSILON);
        assert!((adaptive(0.0, 1.0, 1e-13, 0.0, |x| 1.0 / (1e-6 + x * x)) - 1e3 * 1e3f64.atan()).abs() < 1e-9);
    }

    #[test]
    fn kinks_are_found() {
        let got = adaptive(0.0, 1.0, 1e-11, 0.0, |x| (x - 0.3f64).abs());
        assert!((got - 0.29).abs() < 1e-11, "{got}");
        // A jump costs two intervals a bisection.
        let got = adaptive(0.0, 1.0, 1e-9, 0.0, |x| f64::from(u8::from(x < 1.0 / 3.0)));
        assert!((got - 1.0 / 3.0).abs() < 1e-8, "{got}");
    }

    #[test]
    fn noise_ends() {
        let mut evaluations = 0u64;
        let mut state = 1u64;
        adaptive(0.0, 1.0, 1e-13, 0.0, |_| {
            evaluations += 1;
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 40) as f64
        });
        assert!(evaluations <= 16 * MAX_INTERVALS as u64 + 16, "{evaluations}");
    }
}
