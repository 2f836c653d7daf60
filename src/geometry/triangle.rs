//! Segment against triangle, decided in `f64`.
//!
//! The test answers: does the open segment cross the closed triangle? It is watertight: two triangles that share an edge
//! evaluate that edge to exactly opposite values, so no segment slips between them. Nothing absolute enters: coordinates
//! scaled by a power of two give the same answer.
//!
//! An end of the segment that lies in the triangle's plane to within the rounding of its own coordinates does not count as
//! crossing. This is what keeps a receiver from shadowing itself, coplanar neighbours and exact duplicates included, and a
//! caster in the plane of the light from blocking it (`0 < t < 1` is strict).

use glam::DVec3;

/// A segment or ray, relative to the same origin as the triangles it is tested against.
#[derive(Debug, Clone, Copy)]
pub struct Segment {
    /// Start.
    pub origin: DVec3,
    /// End minus start; a direction of any length for a ray.
    pub direction: DVec3,
    /// Bounds on the errors of `origin`'s coordinates.
    pub origin_error: DVec3,
    /// Bounds on the errors of the end's coordinates; none for a ray, which has no end.
    pub end_error: Option<DVec3>,
}

impl Segment {
    /// Height of a plane over the origin, along the plane's `normal` (in units of its length), the plane's point `a` given
    /// relative to the origin; exactly 0 where rounding could account for it.
    #[inline]
    pub fn origin_height(&self, normal: DVec3, a: DVec3) -> f64 {
        beyond(normal.dot(a), normal.abs().dot(self.origin_error + ROUNDING * a.abs()))
    }

    /// The same over the end of a segment that has one.
    #[inline]
    pub fn end_height(&self, normal: DVec3, a: DVec3) -> f64 {
        let d = self.direction;
        let end_error = self.end_error.unwrap_or(DVec3::ZERO);
        beyond(normal.dot(a - d), normal.abs().dot(end_error + ROUNDING * (a.abs() + d.abs())))
    }
}

/// A value, or 0 where it is within its error bound.
#[inline]
fn beyond(value: f64, bound: f64) -> f64 {
    if value.abs() <= bound { 0.0 } else { value }
}

/// A triangle's normal, as long as twice its area. Differences of f32 corners are exact or nearly so.
#[inline]
pub fn normal_of([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a)
}

/// Where a segment crosses a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crossing {
    /// Along the segment: 0 at its origin, 1 at its end.
    pub t: f64,
    /// Weights of the triangle's second and third corner.
    pub barycentric: [f64; 2],
}

/// The crossing of the open segment with the closed triangle, if there is one. Degenerate triangles are never crossed.
#[inline]
pub fn crossing(segment: &Segment, corners: [DVec3; 3]) -> Option<Crossing> {
    let d = segment.direction;
    let [a, b, c] = corners.map(|corner| corner - segment.origin);
    // Signed volumes of the segment with each edge; swapping an edge's ends negates its value exactly.
    let weight_a = b.cross(c).dot(d);
    let weight_b = c.cross(a).dot(d);
    let weight_c = a.cross(b).dot(d);
    let any_negative = weight_a < 0.0 || weight_b < 0.0 || weight_c < 0.0;
    let any_positive = weight_a > 0.0 || weight_b > 0.0 || weight_c > 0.0;
    if any_negative == any_positive {
        return None;
    }
    let normal = normal_of(corners);
    let origin_height = segment.origin_height(normal, a);
    if origin_height == 0.0 {
        return None;
    }
    let slope = normal.dot(d);
    if segment.end_error.is_some() {
        let end_height = segment.end_height(normal, a);
        if end_height == 0.0 || (end_height > 0.0) == (origin_height > 0.0) {
            return None;
        }
    } else if slope == 0.0 || (slope > 0.0) != (origin_height > 0.0) {
        return None;
    }
    let sum = weight_a + weight_b + weight_c;
    Some(Crossing { t: origin_height / slope, barycentric: [weight_b / sum, weight_c / sum] })
}

/// Where the line of a segment meets a triangle's plane, inside the triangle or not, by the same formulas; none where it runs
/// along it.
pub fn plane_crossing(segment: &Segment, corners: [DVec3; 3]) -> Option<Crossing> {
    let d = segment.direction;
    let [a, b, c] = corners.map(|corner| corner - segment.origin);
    let [weight_a, weight_b, weight_c] = [b.cross(c).dot(d), c.cross(a).dot(d), a.cross(b).dot(d)];
    let normal = normal_of(corners);
    let crossing = Crossing {
        t: normal.dot(a) / normal.dot(d),
        barycentric: [weight_b, weight_c].map(|weight| weight / (weight_a + weight_b + weight_c)),
    };
    (crossing.t.is_finite() && crossing.barycentric.iter().all(|weight| weight.is_finite())).then_some(crossing)
}

/// Relative rounding of a dot product of three terms, each a product of rounded differences.
const ROUNDING: f64 = 8.0 * f64::EPSILON;

#[cfg(test)]
mod tests {
    use super::*;

    const TRIANGLE: [DVec3; 3] = [DVec3::ZERO, DVec3::X, DVec3::Y];

    fn segment(from: [f64; 3], to: [f64; 3]) -> Segment {
        let (origin, end) = (DVec3::from(from), DVec3::from(to));
        Segment { origin, direction: end - origin, origin_error: DVec3::ZERO, end_error: Some(DVec3::ZERO) }
    }

    #[test]
    fn a_crossing_has_its_parameter_and_weights() {
        let found = crossing(&segment([0.25, 0.5, -1.0], [0.25, 0.5, 3.0]), TRIANGLE).unwrap();
        assert_eq!(found, Crossing { t: 0.25, barycentric: [0.25, 0.5] });
    }

    #[test]
    fn ends_in_the_plane_do_not_cross() {
        assert_eq!(crossing(&segment([0.2, 0.2, 0.0], [0.2, 0.3, 1.0]), TRIANGLE), None);
        assert_eq!(crossing(&segment([0.2, 0.2, 1.0], [0.2, 0.2, 0.0]), TRIANGLE), None);
        assert_eq!(crossing(&segment([0.2, 0.2, 0.0], [0.3, 0.3, 0.0]), TRIANGLE), None);
    }

    #[test]
    fn edges_and_corners_belong_to_the_triangle() {
        for at in [[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.0, 1.0]] {
            assert!(crossing(&segment([at[0], at[1], -1.0], [at[0], at[1], 1.0]), TRIANGLE).is_some(), "{at:?}");
        }
    }

    #[test]
    fn a_degenerate_triangle_is_never_crossed() {
        let line = [DVec3::ZERO, DVec3::X, 2.0 * DVec3::X];
        assert_eq!(crossing(&segment([0.5, 0.0, -1.0], [0.5, 0.0, 1.0]), line), None);
        let point = [DVec3::ONE; 3];
        assert_eq!(crossing(&segment([1.0, 1.0, 0.0], [1.0, 1.0, 2.0]), point), None);
    }

    #[test]
    fn no_segment_slips_between_neighbours() {
        // Segments aimed at points of a shared, skew edge: each must hit at least one of the two triangles.
        let p = [[0.1f32, 0.3, 0.2], [0.9, 0.7, -0.3], [0.2, 0.9, 0.1], [0.8, 0.05, 0.4]]
            .map(|p| glam::Vec3::from(p).as_dvec3());
        for i in 0..10_000 {
            let target = p[0] + (p[1] - p[0]) * (f64::from(i) + 0.5) / 10_000.0;
            let origin = DVec3::new(0.3 + 1e-5 * f64::from(i), 0.2, -2.0);
            let segment = Segment {
                origin,
                direction: 2.0 * (target - origin),
                origin_error: DVec3::ZERO,
                end_error: Some(DVec3::ZERO),
            };
            let hit =
                crossing(&segment, [p[0], p[1], p[2]]).is_some() || crossing(&segment, [p[1], p[0], p[3]]).is_some();
            assert!(hit, "slipped through at {i}");
        }
    }
}
