//! Sample patterns on a light: points of the unit square, mapped by area onto a rectangle or a disk.
//!
//! All arithmetic that picks a sample is on `u32`, so that a shader can repeat it bit for bit.

use std::f64::consts::PI;

use glam::DVec2;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::scene::light::{Domain, Emitter};

/// How samples are spread over a light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Pattern {
    /// Centres of a grid of cells, the same at every receiver: lowest error, errors show as bands.
    Grid,
    /// One random point in each cell of the grid: errors show as noise.
    Jittered,
    /// Halton (2, 3), shifted anew at every receiver (Cranley and Patterson 1976).
    Halton,
    /// Sobol' (0, 2)-sequence with hash-based Owen scrambling, scrambled anew at every receiver (Burley 2020).
    Sobol,
}

impl Pattern {
    /// Its number in `lib/sampling.wgsl`.
    pub fn on_gpu(self) -> u32 {
        match self {
            Self::Grid => 0,
            Self::Jittered => 1,
            Self::Halton => 2,
            Self::Sobol => 3,
        }
    }
}

/// The samples of one receiver.
#[derive(Debug, Clone, Copy)]
pub struct Sampler {
    pattern: Pattern,
    count: u32,
    columns: u32,
    rows: u32,
    seed: u32,
}

impl Sampler {
    /// `count` samples for the receiver numbered `receiver`; `seed` chooses another set altogether.
    ///
    /// # Panics
    /// If `count` is zero.
    pub fn new(pattern: Pattern, count: u32, receiver: u32, seed: u32) -> Self {
        assert!(count > 0, "a sampler needs a sample");
        let (columns, rows) = grid_of(count);
        Self { pattern, count, columns, rows, seed: hash(receiver ^ hash(seed)) }
    }

    /// Sample `index` in [0, 1)².
    pub fn unit_square(&self, index: u32) -> DVec2 {
        debug_assert!(index < self.count);
        match self.pattern {
            Pattern::Grid => self.in_cell(index, DVec2::splat(0.5)),
            Pattern::Jittered => self.in_cell(index, independent(self.seed, index)),
            Pattern::Halton => {
                let shift = DVec2::new(unit(hash(self.seed)), unit(hash(self.seed ^ 0x9e37_79b9)));
                let point = DVec2::new(unit((index + 1).reverse_bits()), radical_inverse_3(index + 1)) + shift;
                point - point.floor()
            }
            Pattern::Sobol => {
                // Owen scrambling works on reversed bits, in which the sequence is generated.
                let x = laine_karras(index, hash(self.seed ^ 0x68bc_21eb));
                let y = laine_karras(sobol_second_reversed(index), hash(self.seed ^ 0x02e5_be93));
                DVec2::new(unit(x.reverse_bits()), unit(y.reverse_bits()))
            }
        }
    }

    /// Parameters of sample `index` on an emitter's domain, uniform over its area.
    pub fn on_emitter(&self, index: u32, emitter: &Emitter) -> DVec2 {
        on_domain(emitter.domain, self.unit_square(index))
    }

    fn in_cell(&self, index: u32, offset: DVec2) -> DVec2 {
        let cell = DVec2::new(f64::from(index % self.columns), f64::from(index / self.columns));
        (cell + offset) / DVec2::new(f64::from(self.columns), f64::from(self.rows))
    }
}

/// Parameters of an emitter's domain for a point of the unit square, uniform over its area.
pub fn on_domain(domain: Domain, square: DVec2) -> DVec2 {
    match domain {
        Domain::Rect => 2.0 * square - 1.0,
        Domain::Disk => disk_from_square(square),
        Domain::Point => DVec2::ZERO,
    }
}

/// Point `index` in [0, 1)² of the sequence R2, multiples of the inverse of the plastic number and of its square (Roberts 2018, "The
/// Unreasonable Effectiveness of Quasirandom Sequences"); `seed` shifts it.
pub fn r2(index: u32, seed: u32) -> DVec2 {
    let first = hash(seed);
    let x = first.wrapping_add(index.wrapping_mul(3_242_174_889));
    let y = hash(first).wrapping_add(index.wrapping_mul(2_447_445_413));
    DVec2::new(unit(x), unit(y))
}

/// Point `index` in [0, 1)² of a sequence of independent ones; `seed` chooses another sequence.
pub fn random(index: u32, seed: u32) -> DVec2 {
    independent(hash(seed), index)
}

fn independent(hashed_seed: u32, index: u32) -> DVec2 {
    let first = hash(hashed_seed ^ hash(index));
    DVec2::new(unit(first), unit(hash(first)))
}

/// Columns and rows whose product is `count`, as near to square as its factors allow, columns first (128 = 16 × 8).
pub fn grid_of(count: u32) -> (u32, u32) {
    let mut rows = count.isqrt().max(1);
    while !count.is_multiple_of(rows) {
        rows -= 1;
    }
    (count / rows, rows)
}

/// The concentric map of the unit square onto the unit disk, area-preserving (Shirley and Chiu 1997).
pub fn disk_from_square(square: DVec2) -> DVec2 {
    let at = 2.0 * square - 1.0;
    if at == DVec2::ZERO {
        return DVec2::ZERO;
    }
    let (radius, angle) = if at.x.abs() > at.y.abs() {
        (at.x, 0.25 * PI * (at.y / at.x))
    } else {
        (at.y, 0.5 * PI - 0.25 * PI * (at.x / at.y))
    };
    radius * DVec2::new(angle.cos(), angle.sin())
}

/// A well-mixed 32-bit hash (Wellons 2018, "lowbias32").
pub fn hash(mut x: u32) -> u32 {
    x ^= x >> 16;
    x = x.wrapping_mul(0x7feb_352d);
    x ^= x >> 15;
    x = x.wrapping_mul(0x846c_a68b);
    x ^ (x >> 16)
}

/// A 32-bit fraction as a number in [0, 1).
fn unit(x: u32) -> f64 {
    f64::from(x) * 2f64.powi(-32)
}

/// Owen scrambling of a 32-bit fraction in reversed bits, by Laine and Karras' hash with the constants of Vegdahl 2021.
fn laine_karras(mut x: u32, seed: u32) -> u32 {
    x ^= x.wrapping_mul(0x3d20_adea);
    x = x.wrapping_add(seed);
    x = x.wrapping_mul((seed >> 16) | 1);
    x ^= x.wrapping_mul(0x0552_6c56);
    x ^ x.wrapping_mul(0x53a2_2864)
}

/// Second coordinate of the Sobol' sequence (primitive polynomial x + 1), as a 32-bit fraction in reversed bits; the first one's
/// reversed bits are the index itself.
fn sobol_second_reversed(mut index: u32) -> u32 {
    let mut direction = 1u32;
    let mut result = 0;
    while index != 0 {
        if index & 1 != 0 {
            result ^= direction;
        }
        index >>= 1;
        direction ^= direction << 1;
    }
    result
}

fn radical_inverse_3(mut index: u32) -> f64 {
    let (mut digits, mut power) = (0u64, 1u64);
    while index > 0 {
        digits = digits * 3 + u64::from(index % 3);
        power *= 3;
        index /= 3;
    }
    digits as f64 / power as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    const PATTERNS: [Pattern; 4] = [Pattern::Grid, Pattern::Jittered, Pattern::Halton, Pattern::Sobol];

    #[test]
    fn every_pattern_stays_in_the_unit_square() {
        for pattern in PATTERNS {
            for count in [1, 2, 7, 16, 128, 1000] {
                let sampler = Sampler::new(pattern, count, 12, 3);
                for i in 0..count {
                    let at = sampler.unit_square(i);
                    assert!(at.min_element() >= 0.0 && at.max_element() < 1.0, "{pattern:?} {count} {at}");
                }
            }
        }
    }

    #[test]
    fn sobol_points_are_a_0_2_net() {
        // Every elementary interval of area 1/64 holds exactly one of 64 points.
        for receiver in 0..20 {
            let sampler = Sampler::new(Pattern::Sobol, 64, receiver, 0);
            for log_columns in 0..=6 {
                let (columns, rows) = (1u32 << log_columns, 64u32 >> log_columns);
                let mut seen = [false; 64];
                for i in 0..64 {
                    let at = sampler.unit_square(i) * DVec2::new(f64::from(columns), f64::from(rows));
                    let cell = at.y as usize * columns as usize + at.x as usize;
                    assert!(!std::mem::replace(&mut seen[cell], true), "cell {cell} of {columns}x{rows} twice");
                }
            }
        }
    }

    #[test]
    fn sequences_fill_the_square_as_evenly_as_they_should() {
        // The star discrepancy of a thousand points, on a grid of corners: some 1/n for R2, 1/√n for independent points.
        let discrepancy = |point: &dyn Fn(u32) -> DVec2| {
            let points: Vec<DVec2> = (0..1000).map(point).collect();
            assert!(points.iter().all(|at| at.min_element() >= 0.0 && at.max_element() < 1.0));
            let corners = (1..=40).flat_map(|x| (1..=40).map(move |y| DVec2::new(f64::from(x), f64::from(y)) / 40.0));
            let off = |corner: DVec2| {
                let inside = points.iter().filter(|at| at.x < corner.x && at.y < corner.y).count();
                (inside as f64 / 1000.0 - corner.x * corner.y).abs()
            };
            corners.map(off).fold(0.0, f64::max)
        };
        for seed in 0..8 {
            let even = discrepancy(&|index| r2(index, seed));
            let independent = discrepancy(&|index| random(index, seed));
            assert!(even < 0.008, "{seed}: {even}");
            assert!(independent > 0.012 && independent < 0.08, "{seed}: {independent}");
        }
    }

    #[test]
    fn grids_are_as_square_as_factors_allow() {
        assert_eq!(grid_of(128), (16, 8));
        assert_eq!(grid_of(81), (9, 9));
        assert_eq!(grid_of(7), (7, 1));
        assert_eq!(grid_of(1), (1, 1));
    }

    #[test]
    fn the_disk_map_keeps_area() {
        // A fifth of the square's radius holds a twenty-fifth of the points.
        let sampler = Sampler::new(Pattern::Grid, 250_000, 0, 0);
        let inside = (0..250_000).filter(|&i| disk_from_square(sampler.unit_square(i)).length() < 0.2).count();
        assert!((inside as f64 / 250_000.0 - 0.04).abs() < 1e-3, "{inside}");
    }
}
