//! What can lie between receivers and a light.

use glam::DVec3;

use crate::scene::{AreaLight, Bounds, Shape};

/// The convex hull of two boxes: all segments between a receiver and a light lie inside it (Haines and Wallace 1991).
#[derive(Debug, Clone)]
pub struct Shaft {
    union: Bounds,
    /// Outward normal and largest offset along it of planes that touch both boxes.
    planes: Vec<(DVec3, f64)>,
}

impl Shaft {
    /// The hull of two boxes.
    pub fn between(a: &Bounds, b: &Bounds) -> Self {
        let mut planes = Vec::new();
        for axis in 0..3 {
            // The hull of both boxes' projections along this axis: edges from a corner of one to the same corner of the
            // other, wherever all else lies on one side.
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            for corner in 0..4 {
                let pick = |bounds: &Bounds| {
                    let x = if corner & 1 == 0 { bounds.min[u] } else { bounds.max[u] };
                    let y = if corner & 2 == 0 { bounds.min[v] } else { bounds.max[v] };
                    (x, y)
                };
                let ((ax, ay), (bx, by)) = (pick(a), pick(b));
                let mut normal = DVec3::ZERO;
                normal[u] = by - ay;
                normal[v] = ax - bx;
                if normal == DVec3::ZERO {
                    continue;
                }
                for outward in [normal, -normal] {
                    let offset = extent(a, outward).max(extent(b, outward));
                    let mut on_edge = DVec3::ZERO;
                    on_edge[u] = ax;
                    on_edge[v] = ay;
                    // Rounding of the products, far above it so that it is one-sided.
                    let slack = 1e-12 * (magnitude(a, outward) + magnitude(b, outward));
                    // Only a supporting plane tells anything that the boxes' union does not.
                    if offset <= outward.dot(on_edge) + slack {
                        planes.push((outward, offset + slack));
                    }
                }
            }
        }
        Self { union: a.union(*b), planes }
    }

    /// Planes around it: outward normals, and the largest offset along each.
    pub fn planes(&self) -> impl Iterator<Item = (DVec3, f64)> {
        let Bounds { min, max } = self.union;
        let of_union = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| [(axis, axis.dot(max)), (-axis, -axis.dot(min))]);
        of_union.into_iter().flatten().chain(self.planes.iter().copied())
    }

    /// Whether a box reaches nowhere inside: at most it touches the hull, as a floor does that all receivers lie on or above. It
    /// blocks nothing then but segments within its own face.
    pub fn holds_nothing_of(&self, bounds: &Bounds) -> bool {
        // Far above the rounding of what lies on the box, far below what a map tells apart.
        let slack = 1e-12 * bounds.min.abs().max(bounds.max.abs()).max_element();
        let (min, max) = (bounds.min + slack, bounds.max - slack);
        (min.cmpge(self.union.max) | max.cmple(self.union.min)).any() || self.excludes(bounds)
    }

    /// Whether a box lies wholly outside; touching is inside.
    pub fn excludes(&self, bounds: &Bounds) -> bool {
        bounds.is_empty()
            || (bounds.min.cmpgt(self.union.max) | bounds.max.cmplt(self.union.min)).any()
            || self
                .planes
                .iter()
                .any(|&(normal, offset)| -extent(bounds, -normal) > offset + 1e-12 * magnitude(bounds, normal))
    }
}

/// The largest value of `normal · x` over a box.
fn extent(bounds: &Bounds, normal: DVec3) -> f64 {
    (normal * bounds.min).max(normal * bounds.max).element_sum()
}

/// The largest magnitude of a product in [`extent`].
fn magnitude(bounds: &Bounds, normal: DVec3) -> f64 {
    (normal.abs() * bounds.min.abs().max(bounds.max.abs())).max_element()
}

/// A box around a light's surface, scene space; for a sun a box so far off, `receivers` and `scene` being where they are,
/// that the hull of it and the receivers holds all that can block it.
pub fn light_bounds(light: &AreaLight, receivers: &Bounds, scene: &Bounds) -> Bounds {
    let rotation = &light.scene_from_light.matrix3;
    let center = light.scene_from_light.translation;
    let half = match light.shape {
        Shape::Rect { size } | Shape::Disk { size } => {
            0.5 * (size.x * rotation.x_axis.abs() + size.y * rotation.y_axis.abs())
        }
        Shape::Sphere { radius, .. } => DVec3::splat(radius),
        Shape::Tube { length, radius } => 0.5 * length * rotation.x_axis.abs() + DVec3::splat(radius),
        Shape::Point => DVec3::ZERO,
        Shape::Sun { angle } => {
            let distance = 2.0 * receivers.union(*scene).size().length();
            let spread = DVec3::splat(distance * (0.5 * angle).tan());
            let offset = distance * rotation.z_axis;
            return Bounds { min: receivers.min + offset - spread, max: receivers.max + offset + spread };
        }
    };
    Bounds { min: center - half, max: center + half }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cube(center: [f64; 3], half: f64) -> Bounds {
        let center = DVec3::from(center);
        Bounds { min: center - half, max: center + half }
    }

    #[test]
    fn a_box_between_is_inside_and_one_beside_is_not() {
        let shaft = Shaft::between(&cube([0.0, 0.0, 0.0], 1.0), &cube([10.0, 10.0, 0.0], 0.5));
        assert!(!shaft.excludes(&cube([5.0, 5.0, 0.0], 0.1)));
        // In the boxes' union, but off the diagonal.
        assert!(shaft.excludes(&cube([8.0, 2.0, 0.0], 0.1)));
        assert!(shaft.excludes(&cube([2.0, 8.0, 0.0], 0.1)));
        assert!(shaft.excludes(&cube([5.0, 5.0, 3.0], 0.1)));
    }

    #[test]
    fn a_floor_that_all_lies_on_is_outside_unless_the_light_reaches_below_it() {
        let on_floor = Bounds { min: DVec3::new(-1.0, -1.0, 0.0), max: DVec3::new(1.0, 1.0, 0.5) };
        let shaft = Shaft::between(&on_floor, &cube([0.0, 0.0, 5.0], 0.5));
        let floor = |z: f64| Bounds { min: DVec3::new(-9.0, -9.0, z), max: DVec3::new(9.0, 9.0, z) };
        assert!(shaft.holds_nothing_of(&floor(0.0)) && !shaft.excludes(&floor(0.0)));
        assert!(shaft.holds_nothing_of(&floor(1e-12)));
        assert!(!shaft.holds_nothing_of(&floor(1e-9)));
        let shaft = Shaft::between(&on_floor, &cube([8.0, 0.0, 0.0], 0.5));
        assert!(!shaft.holds_nothing_of(&floor(0.0)));
    }

    #[test]
    fn no_box_that_a_segment_meets_is_excluded() {
        let (a, b) =
            (Bounds { min: DVec3::new(-1.0, 0.0, -3.0), max: DVec3::new(2.0, 0.5, -1.0) }, cube([4.0, 7.0, 2.0], 0.7));
        let shaft = Shaft::between(&a, &b);
        let mix = |bounds: &Bounds, f: [f64; 3]| bounds.min + DVec3::from(f) * bounds.size();
        let mut fraction = 0.1f64;
        let mut next = || {
            fraction = (fraction * 997.0 + 0.137).fract();
            fraction
        };
        for _ in 0..20_000 {
            let from = mix(&a, [next(), next(), next()]);
            let to = mix(&b, [next(), next(), next()]);
            let at = from + next() * (to - from);
            assert!(!shaft.excludes(&Bounds { min: at, max: at }), "{at}");
        }
    }
}
