//! Closed forms: exact answers that techniques and references are tested against.
//!
//! The setting is the textbook one: a horizontal receiver plane, a light of half-size `l` at height `H` above it that faces
//! down, and an occluder parallel to both at height `h`, `0 < h < H`. A receiver at `x` sees an occluder's point `o` in front
//! of the light point `x + (o − x)·H/h`, its *image*. Fractions are of the light's area.
//!
//! Numbers C1 to C9 are this project's own. Sources: C2 to C5 are plane geometry; C6 follows from the image's scale and
//! Fubini's theorem; C8 and C9 are Lambert's form factor of a polygon (Lambert 1760, "Photometria"; Howell, "A catalog of
//! radiation heat transfer configuration factors", B-4). Every function is scale-invariant: lengths in any one unit.

use std::f64::consts::{FRAC_PI_2, PI};

use glam::{DVec2, DVec3};

/// The point of the light's plane that an occluder's point hides, along one axis: `x + (o − x)·H/h`.
pub fn occluder_image(receiver: f64, occluder: f64, occluder_height: f64, light_height: f64) -> f64 {
    receiver + (occluder - receiver) * (light_height / occluder_height)
}

/// C1. Visible fraction of a rectangular light, centred above the origin, behind an axis-aligned rectangle.
///
/// `V = 1 − ov_x·ov_y / (4 l_x l_y)` with the overlap of image and light along each axis. A light of no size
/// (`light_half` zero) has the hard shadow.
pub fn rect_occluder_visibility(
    receiver: DVec2,
    occluder_center: DVec2,
    occluder_half: DVec2,
    occluder_height: f64,
    light_half: DVec2,
    light_height: f64,
) -> f64 {
    let blocked = |axis: usize| {
        strip_blocked_fraction(
            receiver[axis],
            occluder_center[axis],
            2.0 * occluder_half[axis],
            occluder_height,
            light_half[axis],
            light_height,
        )
    };
    1.0 - blocked(0) * blocked(1)
}

/// C2. Fraction of a rectangle `{u·e_u + v·e_v : u, v ∈ [−1, 1]}` on the near side `n·x ≤ distance` of a line, where
/// `support` holds `|n·e_u|` and `|n·e_v|`: for a square of half-size `l` and an edge at the angle φ, `l·(|cos φ|, |sin φ|)`.
///
/// Sorted so that it is exact as the smaller support vanishes; the textbook sum of four squares keeps 7 digits at φ = 1e-9.
/// A rectangle of no size gives the step, and ½ on the line itself.
pub fn rect_edge_fraction(distance: f64, support: DVec2) -> f64 {
    let (a, b) = (support.max_element(), support.min_element());
    if distance > 0.0 {
        return 1.0 - rect_edge_fraction(-distance, support);
    }
    if distance == 0.0 {
        0.5
    } else if distance <= -(a + b) {
        0.0
    } else if distance <= -(a - b) {
        // A corner triangle; b > 0 here, for else the case above holds. Divided by turns, so that nothing overflows.
        let reach = distance + a + b;
        0.125 * (reach / a) * (reach / b)
    } else {
        (distance + a) / (2.0 * a)
    }
}

/// C3. Visible fraction of a light in `[−l, l]` behind a half-plane that occupies `x < edge`.
pub fn half_plane_visibility(
    receiver: f64,
    edge: f64,
    occluder_height: f64,
    light_half: f64,
    light_height: f64,
) -> f64 {
    let image = occluder_image(receiver, edge, occluder_height, light_height);
    rect_edge_fraction(-image, DVec2::new(light_half, 0.0))
}

/// C3. Width of the penumbra of an edge: `2l·h/(H − h)`, which is also PCSS's estimate `L·(d_r − d_b)/d_b`.
pub fn penumbra_width(light_half: f64, occluder_height: f64, light_height: f64) -> f64 {
    2.0 * light_half * (occluder_height / (light_height - occluder_height))
}

/// C4. Fraction of a disk on the near side of a line at the signed distance `t` from its centre, in radii:
/// `½ + (t·√(1 − t²) + asin t)/π`.
pub fn disk_edge_fraction(t: f64) -> f64 {
    if t <= -1.0 {
        0.0
    } else if t >= 1.0 {
        1.0
    } else {
        0.5 + (t * ((1.0 - t) * (1.0 + t)).sqrt() + t.asin()) / PI
    }
}

/// C5. Area common to two discs of radii `R` and `r` whose centres are `c` apart: a lens.
///
/// `R²·atan2(q, c² + R² − r²) + r²·atan2(q, c² + r² − R²) − q/2`, with `q` in factored form.
pub fn lens_area(radius: f64, other_radius: f64, distance: f64) -> f64 {
    let (big, small, c) = (radius.max(other_radius), radius.min(other_radius), distance.abs());
    if c >= big + small {
        return 0.0;
    }
    if c <= big - small {
        return PI * small * small;
    }
    let q = ((small - (c - big)) * (c + (small - big)) * ((c + big) - small) * (c + small + big)).max(0.0).sqrt();
    // R² − r² as a product: c² + (R − r)(R + r).
    let difference = (big - small) * (big + small);
    let alpha = q.atan2(c * c + difference);
    let beta = q.atan2(c * c - difference);
    big * big * alpha + small * small * beta - 0.5 * q
}

/// C6. Shadow mass: the integral of `1 − V` over the receiver plane, for an occluder of area `A` and a light of *any* shape
/// and size: `A·(H/(H − h))²`.
pub fn shadow_mass(occluder_area: f64, occluder_height: f64, light_height: f64) -> f64 {
    let scale = light_height / (light_height - occluder_height);
    occluder_area * scale * scale
}

/// C7. Fraction of a light in `[−l, l]` that a strip of `width` around `center` blocks: `w·(H/h)/(2l)` while its image lies
/// within the light, whatever the width's rounding against `center`. A light of no size is blocked or not.
pub fn strip_blocked_fraction(
    receiver: f64,
    center: f64,
    width: f64,
    occluder_height: f64,
    light_half: f64,
    light_height: f64,
) -> f64 {
    let image = occluder_image(receiver, center, occluder_height, light_height).abs();
    let half = 0.5 * width * (light_height / occluder_height);
    if light_half == 0.0 {
        return if image < half { 1.0 } else { 0.0 };
    }
    if image + half <= light_half {
        return half / light_half;
    }
    let (low, high) = ((image - half).max(-light_half), (image + half).min(light_half));
    ((high - low) / (2.0 * light_half)).max(0.0)
}

/// C7. Shadow mass of a strip per unit length: `w·H/(H − h)`.
pub fn strip_mass(width: f64, occluder_height: f64, light_height: f64) -> f64 {
    width * (light_height / (light_height - occluder_height))
}

/// C8. Form factor from a receiver to a parallel rectangle with one corner straight above it and the sides `x` and `y`, both
/// in units of its height. Odd in each: sums of four make any axis-aligned rectangle.
///
/// `(1/2π)·[X/√(1 + X²)·atan(Y/√(1 + X²)) + Y/√(1 + Y²)·atan(X/√(1 + Y²))]`
pub fn corner_form_factor(x: f64, y: f64) -> f64 {
    let term = |x: f64, y: f64| {
        let diagonal = x.hypot(1.0);
        x / diagonal * (y / diagonal).atan()
    };
    (term(x, y) + term(y, x)) / (2.0 * PI)
}

/// C8. Form factor to a parallel rectangle between `min` and `max`, relative to the point straight above the receiver and in
/// units of the height. Irradiance is π times radiance times this. Good to 1e-16 absolutely, not relatively.
pub fn rect_form_factor(min: DVec2, max: DVec2) -> f64 {
    corner_form_factor(max.x, max.y) - corner_form_factor(min.x, max.y) - corner_form_factor(max.x, min.y)
        + corner_form_factor(min.x, min.y)
}

/// C9. Form factor to the part of a rectangular light, centred above the origin, that an axis-aligned rectangle hides.
pub fn rect_occluder_form_factor(
    receiver: DVec2,
    occluder_center: DVec2,
    occluder_half: DVec2,
    occluder_height: f64,
    light_half: DVec2,
    light_height: f64,
) -> f64 {
    let image = receiver + (occluder_center - receiver) * (light_height / occluder_height);
    let half = occluder_half * (light_height / occluder_height);
    let (min, max) = ((image - half).max(-light_half), (image + half).min(light_half));
    if min.x >= max.x || min.y >= max.y {
        return 0.0;
    }
    rect_form_factor((min - receiver) / light_height, (max - receiver) / light_height)
}

/// Solid angle of a rectangle of half sides `a`, `b` seen from straight below its centre at `height`, steradians:
/// `4·asin(ab/√((a² + H²)(b² + H²)))`, as an arc tangent that keeps its digits when the rectangle fills the view.
pub fn centered_rect_solid_angle(half: DVec2, height: f64) -> f64 {
    // Per height, so that no square overflows; at height zero the rectangle is the hemisphere.
    let (a, b) = (half.x / height, half.y / height);
    if a.is_infinite() && b.is_infinite() {
        return 4.0 * FRAC_PI_2;
    }
    4.0 * (a * (b / a.hypot(b).hypot(1.0))).atan()
}

/// Form factor to a polygon from a receiver at the origin with a unit `normal`; all vertices above its horizon. Positive for
/// either orientation. Lambert: `(1/2π)·|Σ Θ_i·Γ_i·n|`, with the edge's angle Θ as `atan2(|a×b|, a·b)`.
pub fn lambert_form_factor(vertices: &[DVec3], normal: DVec3) -> f64 {
    let sum: f64 = edges(vertices)
        .map(|(a, b)| {
            let cross = a.cross(b);
            let length = cross.length();
            if length == 0.0 { 0.0 } else { length.atan2(a.dot(b)) * (cross.dot(normal) / length) }
        })
        .sum();
    sum.abs() / (2.0 * PI)
}

/// The part of a convex polygon where `inside`, an affine function, is not negative.
pub fn clip_polygon(polygon: &[DVec2], inside: impl Fn(DVec2) -> f64) -> Vec<DVec2> {
    let mut clipped = Vec::with_capacity(polygon.len() + 1);
    for (a, b) in edges(polygon) {
        let (value_a, value_b) = (inside(a), inside(b));
        if value_a >= 0.0 {
            clipped.push(a);
        }
        if (value_a > 0.0 && value_b < 0.0) || (value_a < 0.0 && value_b > 0.0) {
            clipped.push(a + (b - a) * (value_a / (value_a - value_b)));
        }
    }
    clipped
}

/// Area of a simple polygon, positive for either orientation.
pub fn polygon_area(polygon: &[DVec2]) -> f64 {
    let Some(&first) = polygon.first() else { return 0.0 };
    // Relative to a vertex: a sliver far from the origin keeps its area.
    0.5 * edges(polygon).map(|(a, b)| (a - first).perp_dot(b - first)).sum::<f64>().abs()
}

/// Area common to a simple polygon and the unit disc around the origin, positive for either orientation.
///
/// Green's theorem: each edge gives its triangle with the centre where it runs inside the disc, a sector where outside.
pub fn polygon_in_unit_disc_area(polygon: &[DVec2]) -> f64 {
    edges(polygon).map(|(a, b)| edge_in_unit_disc(a, b)).sum::<f64>().abs()
}

/// Signed area of the unit disc between the rays from the centre to `a` and `b`, cut off by the edge `a b`.
fn edge_in_unit_disc(a: DVec2, b: DVec2) -> f64 {
    let sector = |a: DVec2, b: DVec2| 0.5 * a.perp_dot(b).atan2(a.dot(b));
    let along = b - a;
    let squared = along.length_squared();
    // Where the edge's line meets the circle; the discriminant as |d|² − (a×d)², free of cancellation.
    let cross = a.perp_dot(along);
    let discriminant = squared - cross * cross;
    if discriminant <= 0.0 {
        return sector(a, b);
    }
    let root = discriminant.sqrt();
    let enter = ((-a.dot(along) - root) / squared).max(0.0);
    let leave = ((-a.dot(along) + root) / squared).min(1.0);
    if enter >= leave {
        return sector(a, b);
    }
    let at = |t: f64| if t == 1.0 { b } else { a + t * along };
    let (p, q) = (at(enter), at(leave));
    sector(a, p) + 0.5 * p.perp_dot(q) + sector(q, b)
}

/// Pairs of neighbouring vertices, the last with the first.
fn edges<T: Copy>(polygon: &[T]) -> impl Iterator<Item = (T, T)> + '_ {
    (0..polygon.len()).map(|i| (polygon[i], polygon[(i + 1) % polygon.len()]))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_4;

    use super::*;

    /// Composite three-point Gauss–Legendre rule over `pieces` equal pieces.
    fn integrate(from: f64, to: f64, pieces: u32, f: impl Fn(f64) -> f64) -> f64 {
        let step = (to - from) / f64::from(pieces);
        let node = 0.5 * 0.6f64.sqrt();
        (0..pieces)
            .map(|i| {
                let middle = from + (f64::from(i) + 0.5) * step;
                step * (8.0 * f(middle) + 5.0 * (f(middle - node * step) + f(middle + node * step))) / 18.0
            })
            .sum()
    }

    /// Fraction of the points of an n×n cell grid over [−1, 1]² that pass; a convex boundary crosses at most 4n cells, so it
    /// is within 4/n of the area fraction.
    fn count(n: u32, inside: impl Fn(DVec2) -> bool) -> f64 {
        let at = |i: u32| (2.0 * f64::from(i) + 1.0) / f64::from(n) - 1.0;
        let hits = (0..n * n).filter(|i| inside(DVec2::new(at(i % n), at(i / n)))).count();
        hits as f64 / f64::from(n * n)
    }

    #[track_caller]
    fn close(value: f64, expected: f64, tolerance: f64) {
        assert!((value - expected).abs() <= tolerance, "{value} is not {expected} ± {tolerance:e}");
    }

    #[test]
    fn rect_occluder_agrees_with_rays() {
        let (center, half, h, l, height) =
            (DVec2::new(0.1, -0.2), DVec2::new(0.5, 0.3), 2.0, DVec2::new(1.0, 0.7), 5.0);
        for receiver in [DVec2::ZERO, DVec2::new(0.7, 0.2), DVec2::new(1.3, -0.9), DVec2::new(3.0, 0.0)] {
            let n = 1000;
            let visible = count(n, |uv| {
                // Where the segment from the receiver to the light point passes the occluder's plane.
                let at = receiver + (uv * l - receiver) * (h / height);
                let off = (at - center).abs();
                off.x > half.x || off.y > half.y
            });
            let closed = rect_occluder_visibility(receiver, center, half, h, l, height);
            close(closed, visible, 4.0 / f64::from(n));
        }
    }

    #[test]
    fn rect_occluder_close_to_the_light_hides_its_own_area() {
        // h → H: the image is the occluder itself.
        for k in [10, 30, 52] {
            let h = 5.0 * (1.0 - 0.5f64.powi(k));
            let closed =
                rect_occluder_visibility(DVec2::new(0.3, 0.1), DVec2::ZERO, DVec2::splat(0.5), h, DVec2::ONE, 5.0);
            // H/h − 1 < 2^(1−k) moves each image edge by at most 0.8·2^(1−k), each in a product of halves.
            close(closed, 0.75, 4.0 * 0.5f64.powi(k));
        }
    }

    #[test]
    fn light_of_no_size_casts_the_hard_shadow() {
        let visibility = |x: f64, l: f64| {
            rect_occluder_visibility(DVec2::new(x, 0.0), DVec2::ZERO, DVec2::splat(0.5), 2.0, DVec2::splat(l), 5.0)
        };
        // The shadow's edge is at 0.5·H/(H − h).
        for l in [1e-3, 1e-30, 1e-300, 0.0] {
            assert_eq!(visibility(0.83, l), 0.0);
            assert_eq!(visibility(0.84, l), 1.0);
            assert_eq!(half_plane_visibility(-1e-3, 0.0, 2.0, l, 5.0), 0.0);
            assert_eq!(half_plane_visibility(1e-3, 0.0, 2.0, l, 5.0), 1.0);
        }
    }

    #[test]
    fn edge_at_any_angle_agrees_with_chord_integration() {
        for angle in [0.0, 1e-9, 0.3, FRAC_PI_4, 1.0, 2.2, FRAC_PI_2] {
            let normal = DVec2::from_angle(angle);
            for distance in [-1.3, -0.9, -0.2, 0.0, 0.5, 1.2] {
                let closed = rect_edge_fraction(distance, normal.abs());
                // Chords along the axis nearer to the normal: their length is a clamped linear function. One piece in 2000
                // holds each of its two kinks and errs by less than its own square.
                let (n, m) = if normal.x.abs() > normal.y.abs() { (normal.x, normal.y) } else { (normal.y, normal.x) };
                let pieces = 2000;
                let area = integrate(-1.0, 1.0, pieces, |v| (1.0 + (distance - m * v) / n.abs()).clamp(0.0, 2.0));
                close(closed, area / 4.0, 2.0 / f64::from(pieces).powi(2));
            }
        }
    }

    #[test]
    fn edge_fraction_is_exact_as_the_angle_vanishes() {
        for angle in [1e-9, 1e-16, 1e-300] {
            close(rect_edge_fraction(0.3, DVec2::from_angle(angle).abs()), 0.65, 1e-16);
        }
        for distance in [-0.7, -0.1, 0.2] {
            let support = DVec2::new(0.4, 0.9);
            close(rect_edge_fraction(distance, support) + rect_edge_fraction(-distance, support), 1.0, 1e-16);
        }
        assert_eq!(rect_edge_fraction(0.0, DVec2::ZERO), 0.5);
    }

    #[test]
    fn penumbra_of_an_edge_is_as_wide_as_it_says() {
        let width = penumbra_width(1.0, 2.0, 5.0);
        close(width, 4.0 / 3.0, 1e-15);
        close(half_plane_visibility(-0.5 * width, 0.0, 2.0, 1.0, 5.0), 0.0, 1e-15);
        close(half_plane_visibility(0.0, 0.0, 2.0, 1.0, 5.0), 0.5, 1e-15);
        close(half_plane_visibility(0.5 * width, 0.0, 2.0, 1.0, 5.0), 1.0, 1e-15);
        close(half_plane_visibility(0.31, 0.0, 2.0, 1.0, 5.0), 0.7325, 1e-15);
        // On contact it closes in proportion to the occluder's height.
        close(penumbra_width(1.0, 5e-6, 5.0) / 5e-6, 2.0 / (5.0 - 5e-6), 1e-15);
    }

    #[test]
    fn disk_behind_an_edge_agrees_with_chord_integration() {
        for t in [-1.0, -0.999, -0.5, 0.0, 0.37, 0.9, 1.0] {
            // x = sin θ: the chord 2√(1 − x²) becomes 2 cos²θ, which is smooth.
            let area = integrate(-FRAC_PI_2, f64::asin(t), 200, |theta| 2.0 * theta.cos().powi(2));
            close(disk_edge_fraction(t), area / PI, 1e-13);
        }
        assert_eq!(disk_edge_fraction(-1.5), 0.0);
        assert_eq!(disk_edge_fraction(f64::INFINITY), 1.0);
    }

    #[test]
    fn lens_agrees_with_chord_integration() {
        for (big, small, c) in [(1.0, 0.6, 0.8), (1.0, 1.0, 0.5), (0.3, 1.0, 0.9), (2.0, 1e-3, 2.0), (1.0, 0.5, 0.0)] {
            let chord = |radius: f64, x: f64| (radius * radius - x * x).max(0.0).sqrt();
            let pieces = 200_000;
            let (from, to) = (f64::max(-big, c - small), f64::min(big, c + small));
            let area = integrate(from, to, pieces, |x| 2.0 * chord(big, x).min(chord(small, x - c)));
            // The chords start as a square root: a piece of width s errs by less than √(2·radius)·s^1.5 at each end, and
            // the kink where they cross by less than s².
            let step = (to - from) / f64::from(pieces);
            close(lens_area(big, small, c), area, 4.0 * f64::max(big, small).sqrt() * step.powf(1.5));
        }
    }

    #[test]
    fn lens_of_tangent_discs_is_nothing_or_the_smaller_disc() {
        assert_eq!(lens_area(1.0, 0.5, 1.5), 0.0);
        assert_eq!(lens_area(1.0, 0.5, 2.0), 0.0);
        assert_eq!(lens_area(1.0, 0.5, 0.5), PI * 0.25);
        assert_eq!(lens_area(1.0, 1.0, 0.0), PI);
        assert_eq!(lens_area(1.0, 0.0, 0.3), 0.0);
        // Nearly tangent, the lens vanishes like the gap to the power 3/2, from either side.
        for gap in [1e-6, 1e-10] {
            let outside = lens_area(1.0, 0.5, 1.5 - gap);
            assert!((0.0..=4.0 * f64::powf(gap, 1.5) + 1e-16).contains(&outside), "{outside}");
            close(lens_area(1.0, 0.5, 0.5 + gap), PI * 0.25, 4.0 * f64::powf(gap, 1.5) + 1e-15);
        }
    }

    #[test]
    fn shadow_mass_does_not_depend_on_the_light() {
        let (center, half, h, height) = (DVec2::new(0.1, -0.2), DVec2::splat(0.5), 2.0, 5.0);
        for l in [0.01, 0.5, 3.0] {
            // ψ is a product: so is its integral. Each factor has four kinks; see above.
            let reach = (half.x * height + l * h) / (height - h) + 1.0;
            let pieces = 20_000;
            let mass: f64 = (0..2)
                .map(|axis| {
                    integrate(-reach, reach, pieces, |x| {
                        strip_blocked_fraction(x, center[axis], 2.0 * half[axis], h, l, height)
                    })
                })
                .product();
            // Slopes of at most (H/h − 1)/2l within the pieces of the kinks.
            let step = 2.0 * reach / f64::from(pieces);
            close(mass, shadow_mass(1.0, h, height), 4.0 * step * step * 0.75 / l * 2.0);
        }
    }

    #[test]
    fn strip_keeps_its_mass_however_thin() {
        for width in [0.5, 1e-2, 1e-6, 1e-12, 1e-300] {
            close(strip_blocked_fraction(0.1, 0.05, width, 2.0, 1.0, 5.0) / width, 1.25, 1e-15);
            let pieces = 100_000;
            let mass = integrate(-2.0, 2.0, pieces, |x| strip_blocked_fraction(x, 0.0, width, 2.0, 1.0, 5.0));
            // A thin strip's ψ is a box: either end errs by less than a piece.
            let step = 4.0 / f64::from(pieces);
            close(mass / width, strip_mass(1.0, 2.0, 5.0), 2.0 * 1.25 * step);
        }
    }

    #[test]
    fn corner_form_factor_agrees_with_quadrature() {
        for (x, y) in [(0.2, 0.4), (1.0, 1.0), (3.0, 0.5), (-1.0, 2.0)] {
            // Unit height: cos·cos/(π r²) = 1/(π r⁴).
            let flux =
                integrate(0.0, x, 100, |u| integrate(0.0, y, 100, |v| 1.0 / (PI * (1.0 + u * u + v * v).powi(2))));
            close(corner_form_factor(x, y), flux, 1e-10);
        }
        // A quarter of the hemisphere.
        close(corner_form_factor(1e200, 1e200), 0.25, 1e-16);
        assert_eq!(corner_form_factor(0.0, 7.0), 0.0);
    }

    #[test]
    fn corner_sum_is_lamberts_polygon() {
        let receiver = DVec2::new(0.55, -0.4);
        let (min, max) = ((DVec2::splat(-1.0) - receiver) / 5.0, (DVec2::splat(1.0) - receiver) / 5.0);
        let polygon =
            [(min.x, min.y), (max.x, min.y), (max.x, max.y), (min.x, max.y)].map(|(x, y)| DVec3::new(x, y, 1.0));
        close(rect_form_factor(min, max), lambert_form_factor(&polygon, DVec3::Z), 1e-16);
    }

    #[test]
    fn occluded_form_factor_agrees_with_quadrature() {
        let (receiver, center, half) = (DVec2::new(0.55, -0.4), DVec2::new(0.1, -0.2), DVec2::new(0.3, 0.4));
        let closed = rect_occluder_form_factor(receiver, center, half, 2.0, DVec2::ONE, 5.0);
        let seen = |u: f64, v: f64| {
            let at = receiver + (DVec2::new(u, v) - receiver) * 0.4;
            let off = (at - center).abs();
            if off.x < half.x && off.y < half.y { 1.0 } else { 0.0 }
        };
        let pieces = 1000;
        let flux = integrate(-1.0, 1.0, pieces, |u| {
            integrate(-1.0, 1.0, pieces, |v| {
                let squared = 25.0 + (u - receiver.x).powi(2) + (v - receiver.y).powi(2);
                seen(u, v) * 25.0 / (PI * squared * squared)
            })
        });
        // The integrand is at most 1/25π and jumps across the image's four sides, each within one row of pieces.
        close(closed, flux, 4.0 * 2.0 * (2.0 / f64::from(pieces)) / (25.0 * PI));
        assert_eq!(rect_occluder_form_factor(DVec2::new(9.0, 0.0), center, half, 2.0, DVec2::ONE, 5.0), 0.0);
    }

    #[test]
    fn visible_share_of_a_huge_light_depends_on_the_measure() {
        // Half of the light's area is covered, yet nearly all of the irradiance arrives (algorithms.md, 2.2).
        for (l, height, expected) in [(1.0, 5.0, 0.5), (5.0, 5.0, 0.72), (20.0, 5.0, 0.956), (100.0, 5.0, 0.998)] {
            let x = if l == 1.0 { 0.0 } else { 0.5 * l };
            let full = rect_form_factor(DVec2::new(-l - x, -l) / height, DVec2::new(l - x, l) / height);
            let visible = rect_form_factor(DVec2::new(-x, -l) / height, DVec2::new(l - x, l) / height);
            close(visible / full, expected, 5e-3);
        }
    }

    #[test]
    fn solid_angle_agrees_with_quadrature_and_fills_the_hemisphere() {
        for half in [DVec2::new(1.0, 0.5), DVec2::new(0.01, 3.0)] {
            let angle = 4.0
                * integrate(0.0, half.x, 200, |u| {
                    integrate(0.0, half.y, 200, |v| 2.0 * (4.0 + u * u + v * v).powf(-1.5))
                });
            close(centered_rect_solid_angle(half, 2.0), angle, 1e-10);
            let asin = (half.x * half.y / ((half.x.powi(2) + 4.0) * (half.y.powi(2) + 4.0)).sqrt()).asin();
            close(centered_rect_solid_angle(half, 2.0), 4.0 * asin, 1e-15);
        }
        close(centered_rect_solid_angle(DVec2::ONE, 1e-200), 2.0 * PI, 1e-15);
        assert_eq!(centered_rect_solid_angle(DVec2::ONE, 0.0), 2.0 * PI);
    }

    #[test]
    fn polygon_in_disc_tends_to_the_lens() {
        let polygon = |n: u32, radius: f64, center: DVec2| -> Vec<DVec2> {
            (0..n).map(|i| center + radius * DVec2::from_angle(2.0 * PI * f64::from(i) / f64::from(n))).collect()
        };
        for (radius, center) in [(0.6, DVec2::new(0.8, 0.0)), (0.6, DVec2::ZERO), (3.0, DVec2::new(0.0, 2.5))] {
            let n = 4096;
            let area = polygon_in_unit_disc_area(&polygon(n, radius, center));
            // An inscribed n-gon lacks the share 2π²/3n² of its disc.
            let lack = PI * radius * radius * 2.0 * PI * PI / (3.0 * f64::from(n).powi(2));
            close(area, lens_area(1.0, radius, center.length()), 1.01 * lack + 1e-13);
        }
        let square = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| DVec2::new(x, y));
        close(polygon_in_unit_disc_area(&square), PI, 1e-15);
        close(polygon_in_unit_disc_area(&square.map(|v| 0.5 * v)), 1.0, 1e-15);
        // A half-plane: C4.
        let half = clip_polygon(&square, |uv| 0.37 - uv.x);
        close(polygon_in_unit_disc_area(&half) / PI, disk_edge_fraction(0.37), 1e-15);
        close(polygon_area(&half) / 4.0, rect_edge_fraction(0.37, DVec2::X), 1e-15);
    }
}
