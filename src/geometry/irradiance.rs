//! Unshadowed irradiance E₀.
//!
//! E₀ = ∫ L·cos θ_p·cos θ_l/r² dA over the part of the light above the receiver's horizon (its geometric normal) and above
//! its shading plane (where cos θ_p, of the shading normal, is positive). With constant L it is a closed form for polygons and
//! circles and a contour integral for ellipses ([`super::contour`]); where L varies (a spread below π, a spot's cone) it is
//! quadrature along the contour of radial integrals around a point of the light's plane.

use std::f64::consts::PI;

use glam::DVec3;

use super::contour::{Arc, Piece, Region};
use super::quadrature::{adaptive, gauss, gauss_with_magnitude};
use crate::receivers::Receiver;
use crate::scene::light::{AreaLight, Cone, Domain, Emission, Emitter, Shape};

/// Relative tolerance where emission varies and the radial integral is in closed form.
const SPREAD_TOLERANCE: f64 = 1e-12;

/// The same along the contour and along a radius where both are quadrature, of the unattenuated value; E is asked for to 1e-7.
const CONE_TOLERANCES: [f64; 2] = [1e-9, 1e-11];

/// Regions of at most this radius per distance are small enough for one rule a radius: 8e-12 measured for constant radiance.
const SMOOTH: f64 = 0.25;

/// Fans start at the receiver's foot on the light's plane up to this many radii from the region's centre (their parts
/// outside the region cancel, to its square), and inside the region beyond, where the region is small as seen from both.
const FOOT_RADII: f64 = 16.0;

/// Irradiance of an unoccluded receiver, W/m², linear RGB. Exactly zero where the light is edge-on, behind or wholly below
/// the horizon.
pub fn unshadowed(light: &AreaLight, receiver: &Receiver) -> DVec3 {
    let Some(emitter) = light.emitter(receiver.position) else {
        return DVec3::ZERO;
    };
    if !reaches(&emitter, receiver) {
        return DVec3::ZERO;
    }
    let weight = match emitter.domain {
        Domain::Point => sample_weight(light, &emitter, receiver, emitter.center),
        Domain::Rect | Domain::Disk => weight_integral(light, &emitter, receiver),
    };
    if weight > 0.0 { weight * emission_factor(light) } else { DVec3::ZERO }
}

/// Irradiance from the part of an area emitter that `boundary` encloses, W/m², linear RGB: closed loops relative to the
/// emitter's centre, counter-clockwise along the line of sight (holes clockwise), above the receiver's horizon and its shading
/// plane. The whole emitter gives what [`unshadowed`] gives.
pub fn from_part(light: &AreaLight, emitter: &Emitter, receiver: &Receiver, boundary: Vec<Piece>) -> DVec3 {
    let region = Region { center: emitter.center, away: -emitter.normal, pieces: boundary };
    let weight = region_weight(light, emitter, receiver, &near_unit(&region));
    if weight > 0.0 { weight * emission_factor(light) } else { DVec3::ZERO }
}

/// What [`sample_weight`]'s mean is multiplied by, besides the emitter's area: radiance (of a sun, the constant radiance of
/// its disc, E/(π sin²(angle/2))), or, for a light that is a point, its intensity or irradiance at normal incidence.
pub fn emission_factor(light: &AreaLight) -> DVec3 {
    match (light.emission, light.shape) {
        // A sphere of no size acts as a point, and a finite radiance then emits nothing.
        (Emission::Radiance(_), Shape::Sphere { radius: 0.0, .. }) => DVec3::ZERO,
        (Emission::Irradiance(irradiance), Shape::Sun { angle }) if angle != 0.0 => {
            irradiance / (PI * (0.5 * angle).sin().powi(2))
        }
        (Emission::Radiance(value) | Emission::Intensity(value) | Emission::Irradiance(value), _) => value,
    }
}

/// The weight w ≥ 0 of the light point at `to_light` (from the receiver, scene space; [`Emitter::at`]): per radiance and area,
/// such that E₀ = [`emission_factor`] · mean(w) · area, the mean over points uniform on the emitter and the area
/// [`Emitter::area`], or 1 for a point.
///
/// - Area emitters, the sun's disc at distance 1 included: spread · cone · cos θ_p · cos θ_l/r², 1/m².
/// - Points: cone · cos θ_p/r², 1/m²; at infinity cos θ_p.
///
/// cos θ_p is the shading normal's. Zero on and below the geometric horizon and behind the emitter.
pub fn sample_weight(light: &AreaLight, emitter: &Emitter, receiver: &Receiver, to_light: DVec3) -> f64 {
    let height = receiver.shading_normal.dot(to_light);
    if receiver.normal.dot(to_light) <= 0.0 || height <= 0.0 {
        return 0.0;
    }
    let squared = to_light.length_squared();
    let distance = squared.sqrt();
    let modulation = Modulation::of(light, emitter);
    if emitter.domain == Domain::Point {
        let falloff = if emitter.distant { 1.0 } else { squared };
        return modulation.factor(to_light) * (height / distance) / falloff;
    }
    let depth = -emitter.normal.dot(to_light);
    if depth <= 0.0 {
        return 0.0;
    }
    modulation.factor(to_light) * (height / distance) * (depth / distance) / squared
}

/// Whether some part of the emitter lies strictly above the receiver's geometric tangent plane, by more than the rounding of
/// its coordinates and the receiver's.
pub fn reaches(emitter: &Emitter, receiver: &Receiver) -> bool {
    let normal = receiver.normal;
    let (along_u, along_v) = (normal.dot(emitter.half_u), normal.dot(emitter.half_v));
    let extent = match emitter.domain {
        Domain::Rect => along_u.abs() + along_v.abs(),
        Domain::Disk => along_u.hypot(along_v),
        Domain::Point => 0.0,
    };
    let mut magnitudes = emitter.center.abs() + emitter.half_u.abs() + emitter.half_v.abs();
    let mut error = 0.0;
    if !emitter.distant {
        // The centre is the difference of the light's position and the receiver's.
        magnitudes += 2.0 * receiver.position.abs();
        error = receiver.position_error;
    }
    // A unit normal's dot product with n terms of magnitude m each within ½ε rounds by less than 8ε·Σm.
    error += 8.0 * f64::EPSILON * magnitudes.element_sum();
    normal.dot(emitter.center) + extent > error
}

/// What a light's radiance is multiplied by in one direction: it depends on nothing else.
#[derive(Debug, Clone, Copy)]
struct Modulation {
    /// tan h and tan h − h for h = spread/2, and the direction away from the receiver normal to the light.
    spread: Option<(f64, f64, DVec3)>,
    /// The cone and its axis turned around: the direction from which the receiver sees the spot's middle.
    cone: Option<(Cone, DVec3)>,
}

impl Modulation {
    fn of(light: &AreaLight, emitter: &Emitter) -> Self {
        let spread = spread_slopes(light).map(|(tan, norm)| (tan, norm, -emitter.normal));
        Self { spread, cone: light.cone.map(|cone| (cone, -light.axis())) }
    }

    /// The factor for light that arrives from `to_light`.
    fn factor(&self, to_light: DVec3) -> f64 {
        let mut factor = 1.0;
        if let Some((tan, norm, away)) = self.spread {
            let depth = away.dot(to_light);
            let tan_theta = (to_light - depth * away).length() / depth;
            // No light within a spread of nothing.
            factor *= if norm > 0.0 { (tan - tan_theta).max(0.0) / norm } else { 0.0 };
        }
        if let Some((cone, axis)) = self.cone {
            factor *= cone.attenuation(axis.dot(to_light) / to_light.length());
        }
        factor
    }

    /// A bound on the factor.
    fn peak(&self) -> f64 {
        match self.spread {
            Some((tan, norm, _)) if norm > 0.0 => tan / norm,
            _ => 1.0,
        }
    }

    /// The circular cones, apex at the receiver, across which the factor is not smooth: unit axis and cosine.
    fn creases(&self) -> Vec<(DVec3, f64)> {
        let mut creases = Vec::new();
        if let Some((tan, _, away)) = self.spread {
            creases.push((away, (1.0 / tan.hypot(1.0)).min(1.0)));
        }
        if let Some((cone, axis)) = self.cone {
            creases.extend([(axis, cone.inner.cos()), (axis, cone.outer.cos())]);
        }
        creases
    }
}

/// tan h and tan h − h for h = spread/2; none for a light that has no spread.
pub fn spread_slopes(light: &AreaLight) -> Option<(f64, f64)> {
    let flat = matches!(light.shape, Shape::Rect { .. } | Shape::Disk { .. });
    let half = 0.5 * light.spread;
    (flat && light.spread < PI).then(|| (half.tan(), tan_minus_angle(half)))
}

/// tan x − x for x in [0, π/2).
fn tan_minus_angle(x: f64) -> f64 {
    if x < 0.5 { gauss(0.0, x, |y| y.tan().powi(2)) } else { x.tan() - x }
}

/// ∫w dA over an area emitter.
fn weight_integral(light: &AreaLight, emitter: &Emitter, receiver: &Receiver) -> f64 {
    let mut region = near_unit(&Region::of(emitter)).clipped(receiver.normal);
    if receiver.shading_normal != receiver.normal {
        region = region.clipped(receiver.shading_normal);
    }
    region_weight(light, emitter, receiver, &region)
}

/// The region scaled by a power of two to a size near 1.
fn near_unit(region: &Region) -> Region {
    region.scaled(power_of_two_near_inverse(region.center.length().max(region.radius())))
}

/// ∫w dA over a region of the emitter, at any scale.
fn region_weight(light: &AreaLight, emitter: &Emitter, receiver: &Receiver, region: &Region) -> f64 {
    if region.pieces.is_empty() {
        return 0.0;
    }
    let normal = receiver.shading_normal;
    let mut modulation = Modulation::of(light, emitter);
    if let Some((cone, axis)) = modulation.cone {
        // The region's angular distances from the axis.
        let half = (region.radius() / region.center.length()).min(1.0).asin();
        let angle = axis.dot(region.center.normalize()).clamp(-1.0, 1.0).acos();
        if angle - half >= cone.outer {
            return 0.0;
        }
        if angle + half <= cone.inner {
            modulation.cone = None;
        }
    }
    match modulation {
        Modulation { spread: None, cone: None } => region.projected_solid_angle(normal),
        Modulation { spread: Some((tan, norm, _)), cone: None } => {
            spread_integral(region, &modulation, tan, norm, normal)
        }
        _ => modulated_integral(region, &modulation, normal),
    }
}

/// 2^−k with 2^k ≤ `length` < 2^(k+1): scaling by it is exact, and leaves nothing to overflow.
fn power_of_two_near_inverse(length: f64) -> f64 {
    const MANTISSA_BITS: u32 = f64::MANTISSA_DIGITS - 1;
    const BIAS: u64 = f64::MAX_EXP as u64 - 1;
    let exponent = length.to_bits() >> MANTISSA_BITS;
    if (1..2 * BIAS).contains(&exponent) { f64::from_bits((2 * BIAS - exponent) << MANTISSA_BITS) } else { 1.0 }
}

/// ∫w dA under a spread alone.
fn spread_integral(region: &Region, modulation: &Modulation, tan: f64, norm: f64, normal: DVec3) -> f64 {
    let Some(foot) = near_foot(region) else {
        return modulated_integral(region, modulation, normal);
    };
    if norm <= 0.0 {
        return 0.0;
    }
    let depth = region.away.dot(region.center);
    let along_away = normal.dot(region.away);
    // In units of the depth: n·s = x·n·e + n_z, r² = 1 + x².
    let radial = |edge: DVec3| {
        let x = edge.length() / depth;
        let (constant, linear) = spread_moments(x, tan);
        (normal.dot(edge) / depth * linear + along_away * constant) / (norm * depth * depth)
    };
    foot_fan(region, foot, (depth, Some(tan)), &[], (SPREAD_TOLERANCE, 0.0), radial)
}

/// ∫₀¹ τ·f(xτ) dτ and ∫₀¹ τ²·f(xτ) dτ for f(y) = max(tan h − y, 0)/(1 + y²)².
fn spread_moments(x: f64, tan: f64) -> (f64, f64) {
    if x <= 0.25 && x <= tan {
        let f = |tau: f64| tau * (tan - x * tau) / (1.0 + (x * tau).powi(2)).powi(2);
        return (gauss(0.0, 1.0, f), gauss(0.0, 1.0, |tau| tau * f(tau)));
    }
    if tan <= 0.25 {
        // All of it lies below tan: the same integrals over [0, tan].
        let (constant, linear) = spread_moments(tan, tan);
        let ratio = tan / x;
        return (ratio * ratio * constant, ratio * ratio * ratio * linear);
    }
    let y = x.min(tan);
    // ∫y/(1+y²)², ∫y²/(1+y²)², ∫y³/(1+y²)² from 0.
    let share = y * y / (1.0 + y * y);
    let first = 0.5 * share;
    let second = 0.5 * (y.atan() - y / (1.0 + y * y));
    let third = 0.5 * ((y * y).ln_1p() - share);
    ((tan * first - second) / (x * x), (tan * second - third) / (x * x * x))
}

/// ∫w dA under any modulation, by quadrature both ways.
fn modulated_integral(region: &Region, modulation: &Modulation, normal: DVec3) -> f64 {
    let [outer, inner] = CONE_TOLERANCES;
    let depth = region.away.dot(region.center);
    let creases = modulation.creases();
    let foot = near_foot(region);
    let plain = |point: DVec3| {
        let squared = point.length_squared();
        normal.dot(point) * depth / (squared * squared)
    };

    // No crease within the angular radius, nor the spread's apex: smooth.
    let share = region.radius() / region.center.length();
    let direction = region.center.normalize();
    let crosses = |&(axis, cos): &(DVec3, f64)| {
        (axis.dot(direction).clamp(-1.0, 1.0).acos() - cos.acos()).abs() <= share.min(1.0).asin()
    };
    if share <= SMOOTH && !creases.iter().any(crosses) && (modulation.spread.is_none() || foot.is_none()) {
        return region.integrate_smooth(|point| modulation.factor(point) * plain(point));
    }

    let peak = modulation.peak();
    let floor = peak * region.projected_solid_angle(normal);
    let radial = |start: DVec3, edge: DVec3| {
        let mut breaks = vec![0.0, 1.0];
        for &(axis, cos) in &creases {
            breaks.extend(cone_crossings(axis, cos, start, edge));
        }
        breaks.sort_by(f64::total_cmp);
        let (_, unattenuated) = gauss_with_magnitude(0.0, 1.0, |tau| tau * plain(start + tau * edge));
        let f = |tau: f64| {
            let point = start + tau * edge;
            tau * modulation.factor(point) * plain(point)
        };
        let parts = breaks.windows(2).filter(|w| w[0] < w[1]);
        parts.map(|w| adaptive(w[0], w[1], inner, peak * unattenuated, f)).sum::<f64>()
    };
    if let Some(foot) = foot {
        let start = depth * region.away;
        return foot_fan(region, foot, (depth, None), &creases, (outer, floor), |edge| radial(start, edge));
    }
    let inside = region.inside();
    let start = region.center + inside;
    let term = |point: DVec3, derivative: DVec3| {
        let edge = point - inside;
        region.away.dot(edge.cross(derivative)) * radial(start, edge)
    };
    let piece_integral = |piece: &Piece| match piece {
        Piece::Segment { from, to } => {
            let along = *to - *from;
            let mut breaks = vec![0.0, 1.0];
            for &(axis, cos) in &creases {
                breaks.extend(cone_crossings(axis, cos, region.center + *from, along));
            }
            breaks.sort_by(f64::total_cmp);
            let parts = breaks.windows(2).filter(|w| w[0] < w[1]);
            parts.map(|w| adaptive(w[0], w[1], outer, floor, |t| term(*from + t * along, along))).sum::<f64>()
        }
        Piece::Arc(arc) => {
            let parts = cut_at_creases(region, arc, &creases);
            parts.iter().map(|q| adaptive(q.from, q.to, outer, floor, |phi| term(q.at(phi), q.derivative(phi)))).sum()
        }
    };
    region.pieces.iter().map(piece_integral).sum()
}

/// Where `start + τ·edge`, 0 < τ < 1, crosses a cone about `axis` with its apex at the receiver (or the cone's mirror image).
fn cone_crossings(axis: DVec3, cos: f64, start: DVec3, edge: DVec3) -> impl Iterator<Item = f64> {
    let form = |a: DVec3, b: DVec3| axis.dot(a) * axis.dot(b) - cos * cos * a.dot(b);
    let (a, b, c) = (form(edge, edge), form(start, edge), form(start, start));
    let root = (b * b - a * c).sqrt();
    // The root with the larger sum first; NaN where there is none fails the filter.
    let sum = -(b + root.copysign(b));
    [sum / a, c / sum].into_iter().filter(|tau| *tau > 0.0 && *tau < 1.0)
}

/// Pieces of an arc of a region's boundary, at most a quarter turn each, cut where a crease crosses it: found by a change of
/// side from one eighth of a quarter to the next.
fn cut_at_creases(region: &Region, arc: &Arc, creases: &[(DVec3, f64)]) -> Vec<Arc> {
    const STEPS: usize = 8;
    let mut parts = Vec::new();
    for quarter in arc.quarters() {
        let mut breaks = vec![quarter.from, quarter.to];
        for &(axis, cos) in creases {
            let side = |phi: f64| {
                let point = region.center + quarter.at(phi);
                axis.dot(point) > cos * point.length()
            };
            let at = |step: usize| quarter.from + (quarter.to - quarter.from) * (step as f64 / STEPS as f64);
            for step in 0..STEPS {
                let (mut low, mut high) = (at(step), at(step + 1));
                let start = side(low);
                if side(high) == start {
                    continue;
                }
                loop {
                    let middle = 0.5 * (low + high);
                    if middle <= low || middle >= high {
                        break;
                    }
                    if side(middle) == start { low = middle } else { high = middle }
                }
                breaks.push(low);
            }
        }
        breaks.sort_by(f64::total_cmp);
        let pairs = breaks.windows(2).filter(|w| w[0] < w[1]);
        parts.extend(pairs.map(|w| Arc { from: w[0], to: w[1], ..quarter }));
    }
    parts
}

/// The foot of the perpendicular from the receiver onto the region's plane, relative to the region's centre, unless it is too
/// far from the region to start a fan at.
fn near_foot(region: &Region) -> Option<DVec3> {
    let foot = region.away.dot(region.center) * region.away - region.center;
    (foot.length() <= FOOT_RADII * region.radius()).then_some(foot)
}

/// ∫∫f dA over the region as a signed fan around the foot: `radial(edge)` is ∫₀¹ τ·f(foot + τ·edge) dτ. f changes on the scale
/// of `depth`, is not smooth across the creases, which edges are cut at (a corner beyond one may be too small for any rule to
/// see), and is zero beyond a distance of `tan_limit` depths from the foot; tolerance and floor as of `adaptive`.
fn foot_fan(
    region: &Region,
    foot: DVec3,
    (depth, tan_limit): (f64, Option<f64>),
    creases: &[(DVec3, f64)],
    (tolerance, floor): (f64, f64),
    radial: impl Fn(DVec3) -> f64,
) -> f64 {
    let scale = depth * tan_limit.unwrap_or(1.0).min(1.0);
    let segment = |from: DVec3, to: DVec3| {
        // In polar coordinates about the foot, where a near edge is as smooth as a far one.
        let along = (to - from).normalize_or_zero();
        let (start, end) = ((from - foot).dot(along), (to - foot).dot(along));
        let nearest = from - foot - start * along;
        let signed = region.away.dot(nearest.cross(along));
        let height = signed.abs();
        // Rounding may turn around an edge as short as itself.
        if height == 0.0 || start >= end {
            return 0.0;
        }
        let (first, last) = (start.atan2(height), end.atan2(height));
        let limit = tan_limit.map_or(0.0, |tan| (height / (tan * depth)).min(1.0).acos());
        let mut breaks = vec![first, (-limit).clamp(first, last), limit.clamp(first, last), last];
        for &(axis, cos) in creases {
            let crossings = cone_crossings(axis, cos, region.center + from, to - from);
            breaks.extend(crossings.map(|t| (start + t * (end - start)).atan2(height).clamp(first, last)));
        }
        breaks.sort_by(f64::total_cmp);
        let polar = |phi: f64| {
            let edge = nearest + height * phi.tan() * along;
            edge.length_squared() * radial(edge)
        };
        let parts = breaks.windows(2).filter(|w| w[0] < w[1]);
        signed.signum() * parts.map(|w| adaptive(w[0], w[1], tolerance, floor, polar)).sum::<f64>()
    };
    let arc = |arc: &Arc| -> f64 {
        let edge = |phi: f64| arc.at(phi) - foot;
        let squared = |phi: f64| edge(phi).length_squared() + scale * scale;
        let slope = |phi: f64| edge(phi).dot(arc.derivative(phi));
        let term = |phi: f64| {
            let edge = edge(phi);
            region.away.dot(edge.cross(arc.derivative(phi))) * radial(edge)
        };
        let parts = cut_at_creases(region, arc, creases);
        parts.iter().map(|part| part.integrate((tolerance, floor), squared, slope, term)).sum()
    };
    let piece_integral = |piece: &Piece| match piece {
        Piece::Segment { from, to } => segment(*from, *to),
        Piece::Arc(piece) => arc(piece),
    };
    region.pieces.iter().map(piece_integral).sum()
}
