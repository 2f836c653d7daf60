//! V and E of every shape against a brute force that shares nothing with the library but the scene.
//!
//! The surfaces are written from the definitions: rect, disk and ellipse as they are, a sphere as the disc of its visible cap's
//! silhouette (or, facing, the disc through its centre), a tube as the length × diameter rectangle through its axis, a sun as
//! the disc of radius tan(angle/2) at distance 1, a point. Every segment meets every triangle (Möller and Trumbore 1997).

mod common;

use std::collections::HashSet;
use std::f64::consts::PI;

use common::{Random, SHAPES, rays, receivers, trace_receivers};
use glam::{DVec2, DVec3};
use penumbra::receivers::Receivers;
use penumbra::sampling::Pattern;
use penumbra::scene::{AreaLight, Cone, Emission, Scene, Shape};
use rayon::prelude::*;

/// Points a side.
const SIDE: usize = 64;

/// What a light's surface looks like from one receiver.
struct Surface {
    outline: Outline,
    /// From the receiver.
    center: DVec3,
    u: DVec3,
    v: DVec3,
    /// At infinity: a segment towards it has no end.
    endless: bool,
}

#[derive(Clone, Copy, PartialEq)]
enum Outline {
    Rectangle,
    Ellipse,
    Point,
}

/// A unit vector across a unit vector.
fn across(axis: DVec3) -> DVec3 {
    let least = axis.abs().min_element();
    let other = if axis.x.abs() == least {
        DVec3::X
    } else if axis.y.abs() == least {
        DVec3::Y
    } else {
        DVec3::Z
    };
    axis.cross(other).normalize()
}

/// The surface of a light (world space) that a receiver sees; none where it sees the dark side or nothing.
fn surface(light: &AreaLight, position: DVec3) -> Option<Surface> {
    let pose = &light.scene_from_light;
    let (x, y, z) = (pose.matrix3.x_axis, pose.matrix3.y_axis, pose.matrix3.z_axis);
    let center = pose.translation - position;
    let round = |center: DVec3, radius: f64, endless: bool| {
        let u = across(center.normalize());
        let v = center.normalize().cross(u);
        Some(Surface { outline: Outline::Ellipse, center, u: radius * u, v: radius * v, endless })
    };
    match light.shape {
        Shape::Rect { size } | Shape::Disk { size } => {
            // It emits towards -Z: the receiver must be there.
            let outline = if matches!(light.shape, Shape::Rect { .. }) { Outline::Rectangle } else { Outline::Ellipse };
            (z.dot(center) > 0.0).then(|| Surface {
                outline,
                center,
                u: 0.5 * size.x * x,
                v: 0.5 * size.y * y,
                endless: false,
            })
        }
        Shape::Sphere { radius, facing: true } => round(center, radius, false),
        Shape::Sphere { radius, facing: false } => {
            // Tangents from p touch the circle at distance (d² − r²)/d along the axis, of radius r·sqrt(d² − r²)/d.
            let d = center.length();
            if d <= radius {
                return None;
            }
            let tangent = (d * d - radius * radius).sqrt();
            round(center / d * (tangent * tangent / d), radius * tangent / d, false)
        }
        Shape::Tube { length, radius } => {
            let to_axis = center - x * x.dot(center);
            Some(Surface {
                outline: Outline::Rectangle,
                center,
                u: 0.5 * length * x,
                v: radius * x.cross(to_axis).normalize(),
                endless: false,
            })
        }
        Shape::Sun { angle } => round(z, (0.5 * angle).tan(), true),
        Shape::Point => {
            Some(Surface { outline: Outline::Point, center, u: DVec3::ZERO, v: DVec3::ZERO, endless: false })
        }
    }
}

impl Surface {
    /// Centres of `side`² cells of equal area: a lattice of a rectangle, rings of 1, 3, 5, … sectors of an ellipse.
    fn points(&self, side: usize) -> Vec<DVec3> {
        if self.outline == Outline::Point {
            return vec![self.center];
        }
        let mut points = Vec::with_capacity(side * side);
        for row in 0..side {
            let columns = if self.outline == Outline::Rectangle { side } else { 2 * row + 1 };
            for column in 0..columns {
                let (a, b) = ((column as f64 + 0.5) / columns as f64, (row as f64 + 0.5) / side as f64);
                let (s, t) = if self.outline == Outline::Rectangle {
                    (2.0 * a - 1.0, 2.0 * b - 1.0)
                } else {
                    let (sin, cos) = (2.0 * PI * a).sin_cos();
                    let radius = if row == 0 { 0.0 } else { b };
                    (radius * cos, radius * sin)
                };
                points.push(self.center + s * self.u + t * self.v);
            }
        }
        points
    }

    /// The cell of an ellipse that a direction goes to.
    fn cell(&self, to: DVec3, side: usize) -> Option<usize> {
        let away = self.u.cross(self.v);
        let on_plane = to * (away.dot(self.center) / away.dot(to)) - self.center;
        let (s, t) = (on_plane.dot(self.u) / self.u.length_squared(), on_plane.dot(self.v) / self.v.length_squared());
        let row = (s.hypot(t) * side as f64) as usize;
        let turn = (t.atan2(s) / (2.0 * PI)).rem_euclid(1.0);
        (row < side).then(|| row * row + ((turn * (2 * row + 1) as f64) as usize).min(2 * row))
    }

    /// Cells of an ellipse that an edge crosses as seen from the receiver, as far as it lies before the surface.
    fn mark(&self, [a, b]: [DVec3; 2], side: usize, cells: &mut HashSet<usize>) {
        let away = self.u.cross(self.v);
        let away = if away.dot(self.center) < 0.0 { -away } else { away };
        let depth = |point: DVec3| away.dot(point) / away.dot(self.center);
        let [near, far] = [depth(a), depth(b)];
        // In front of the receiver alone.
        let clip = |from: DVec3, to: DVec3, d: f64, e: f64| {
            if d > 1e-3 { from } else { from + (to - from) * ((1e-3 - d) / (e - d)) }
        };
        if near.max(far) <= 1e-3 {
            return;
        }
        let (a, b) = (clip(a, b, near, far), clip(b, a, far, near));
        let [near, far] = [depth(a), depth(b)];
        let (from, to) = (a / near, b / far);
        // The stretch of the image within the ellipse.
        let flat = |point: DVec3| {
            let offset = point - self.center;
            DVec2::new(offset.dot(self.u) / self.u.length_squared(), offset.dot(self.v) / self.v.length_squared())
        };
        let (start, along) = (flat(from), flat(to) - flat(from));
        let (squared, half) = (along.length_squared(), start.dot(along));
        let root = half * half - squared * (start.length_squared() - 1.0);
        if root <= 0.0 {
            return;
        }
        let [first, last] = [-1.0, 1.0].map(|sign| ((-half + sign * root.sqrt()) / squared).clamp(0.0, 1.0));
        // A third of a cell a step.
        let steps = ((last - first) * along.length() * side as f64 * 3.0).ceil() as usize + 1;
        for i in 0..=steps {
            let x = first + (last - first) * (i as f64 / steps as f64);
            // 1/depth is linear on the image.
            let inverse = 1.0 / near + (1.0 / far - 1.0 / near) * x;
            if self.endless || inverse >= 1.0 {
                cells.extend(self.cell(from + x * (to - from), side));
            }
        }
    }

    /// Corners of the rectangle, or of the one around the ellipse.
    fn corners(&self) -> [DVec3; 4] {
        [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[s, t]| self.center + s * self.u + t * self.v)
    }

    fn area(&self) -> f64 {
        let parallelogram = self.u.cross(self.v).length();
        match self.outline {
            Outline::Rectangle => 4.0 * parallelogram,
            Outline::Ellipse => PI * parallelogram,
            Outline::Point => 1.0,
        }
    }

    /// A stretch of the line in which the receiver's tangent plane cuts the surface, if it does.
    fn horizon(&self, normal: DVec3) -> Option<[DVec3; 2]> {
        let (at, along_u, along_v) = (normal.dot(self.center), normal.dot(self.u), normal.dot(self.v));
        let squared = along_u * along_u + along_v * along_v;
        // In the parameter plane: the line's nearest point and direction.
        let foot = [-at * along_u / squared, -at * along_v / squared];
        let reach = if self.outline == Outline::Rectangle { 2f64.sqrt() } else { 1.0 };
        (foot[0].hypot(foot[1]) < reach).then(|| {
            let direction = [-along_v / squared.sqrt(), along_u / squared.sqrt()];
            [-2.0, 2.0]
                .map(|x| self.center + (foot[0] + x * direction[0]) * self.u + (foot[1] + x * direction[1]) * self.v)
        })
    }
}

/// What a segment from the origin does at a triangle.
#[derive(Clone, Copy, PartialEq)]
enum Meeting {
    Blocked,
    Free,
    /// Too near to an edge, an end or the plane for rounding to say.
    Unsure,
}

/// Möller and Trumbore 1997: `t · to` for `t` in (0, 1), or beyond where `endless`.
fn meeting(to: DVec3, endless: bool, [a, b, c]: [DVec3; 3]) -> Meeting {
    // Coordinates are of size 1 to 10: their roundings are four orders below this.
    const MARGIN: f64 = 1e-11;
    let (edge1, edge2) = (b - a, c - a);
    let p = to.cross(edge2);
    let determinant = edge1.dot(p);
    if determinant.abs() <= MARGIN {
        return Meeting::Unsure;
    }
    let u = (-a).dot(p) / determinant;
    let q = (-a).cross(edge1);
    let v = to.dot(q) / determinant;
    let t = edge2.dot(q) / determinant;
    let beyond = if endless { f64::NEG_INFINITY } else { t - 1.0 };
    let margin = MARGIN / determinant.abs().min(1.0);
    let outside = (-u).max(-v).max(u + v - 1.0).max(-t).max(beyond);
    if outside > margin {
        Meeting::Free
    } else if outside < -margin {
        Meeting::Blocked
    } else {
        Meeting::Unsure
    }
}

/// The scene's triangles in world space, before it is rebased.
fn triangles(scene: &Scene) -> Vec<[DVec3; 3]> {
    let of_instance = |instance: &penumbra::scene::Instance| {
        let mesh = &scene.meshes[instance.mesh];
        let place = instance.scene_from_mesh;
        let corners = |t: &[u32; 3]| t.map(|i| place.transform_point3(mesh.positions[i as usize].as_dvec3()));
        mesh.triangles.iter().map(corners).collect::<Vec<_>>()
    };
    scene.instances.iter().flat_map(of_instance).collect()
}

/// What arrives from a direction relative to full radiance or intensity: the spread of flat lights, the cone of spots.
fn modulation(light: &AreaLight, to: DVec3) -> f64 {
    let cos = light.scene_from_light.matrix3.z_axis.dot(to.normalize());
    let mut factor = 1.0;
    if light.spread < PI && matches!(light.shape, Shape::Rect { .. } | Shape::Disk { .. }) {
        let half = 0.5 * light.spread;
        factor *= (half.tan() - cos.acos().tan()).max(0.0) / (half.tan() - half);
    }
    if let Some(cone) = light.cone {
        let linear = (cos - cone.outer.cos()) / (cone.inner.cos() - cone.outer.cos());
        factor *= linear.clamp(0.0, 1.0).powi(2);
    }
    factor
}

/// Radiance of the surface, or the intensity of a point.
fn strength(light: &AreaLight) -> f64 {
    match (light.emission, light.shape) {
        (Emission::Irradiance(e), Shape::Sun { angle }) => e.x / (PI * (0.5 * angle).sin().powi(2)),
        (Emission::Radiance(x) | Emission::Intensity(x) | Emission::Irradiance(x), _) => x.x,
    }
}

/// cos·cos/r² (cos/r² of a point), horizon and modulation included.
fn weight(light: &AreaLight, surface: &Surface, normal: DVec3, shading_normal: DVec3, to: DVec3) -> f64 {
    let r = to.length();
    if normal.dot(to) <= 0.0 || shading_normal.dot(to) <= 0.0 {
        return 0.0;
    }
    let emitted = if surface.outline == Outline::Point {
        1.0
    } else {
        (surface.u.cross(surface.v).normalize().dot(to) / r).abs()
    };
    modulation(light, to) * (shading_normal.dot(to) / r) * emitted / (r * r)
}

/// What the brute force finds at one receiver.
struct Truth {
    surface: Surface,
    /// Share of the points seen, and of those that rounding can't decide.
    visibility: f64,
    unsure: f64,
    /// Cells of an ellipse that a triangle's edge or the horizon crosses, as a share of all.
    mixed: f64,
    /// Whether the horizon crosses the surface.
    is_cut: bool,
    /// E and E₀, and the largest that a point alone would make of either.
    irradiance: f64,
    unshadowed: f64,
    peak: f64,
    /// Bound on the error of `unshadowed` where nothing jumps.
    smooth_error: f64,
    any_above: bool,
    wholly_below: bool,
    wholly_hidden: bool,
    wholly_seen: bool,
}

fn truth(light: &AreaLight, triangles: &[[DVec3; 3]], position: DVec3, normals: [DVec3; 2]) -> Option<Truth> {
    let surface = surface(light, position)?;
    let [normal, shading_normal] = normals;
    let triangles: Vec<[DVec3; 3]> = triangles.iter().map(|t| t.map(|corner| corner - position)).collect();
    let points = surface.points(SIDE);
    let share = 1.0 / points.len() as f64;
    let factor = strength(light) * surface.area();
    let (mut seen, mut any_above) = (0, false);
    let (mut unsure, mut irradiance, mut unshadowed, mut peak) = (0.0, 0.0, 0.0, 0f64);
    for &to in &points {
        let is_above = normal.dot(to) > 0.0;
        let mut is_seen = is_above;
        for &triangle in &triangles {
            if !is_seen {
                break;
            }
            match meeting(to, surface.endless, triangle) {
                Meeting::Blocked => is_seen = false,
                Meeting::Unsure => unsure += share,
                Meeting::Free => {}
            }
        }
        let weight = factor * weight(light, &surface, normal, shading_normal, to);
        unshadowed += share * weight;
        irradiance += if is_seen { share * weight } else { 0.0 };
        peak = peak.max(weight);
        seen += usize::from(is_seen);
        any_above |= is_above;
    }
    let coarse = |side: usize| {
        let points = surface.points(side);
        let sum: f64 = points.iter().map(|&to| weight(light, &surface, normal, shading_normal, to)).sum();
        factor * sum / points.len() as f64
    };
    // Midpoint sums converge with the square of the cell: a quarter remains at each halving, a third of the last change.
    let (half, quarter) = (coarse(SIDE / 2), coarse(SIDE / 4));
    let mut smooth_error = (unshadowed - half).abs() + (half - quarter).abs() / 4.0;
    if unshadowed == 0.0 {
        // No point carries weight: what does is a sliver along the rim, less than two cells' rows wide, and its cosine at most
        // what a cell subtends.
        let cell = 2.0 * (surface.u.length() + surface.v.length()) / SIDE as f64;
        let nearest = points.iter().map(|to| to.length()).fold(f64::INFINITY, f64::min);
        smooth_error += factor / nearest.powi(2) * (2.0 / SIDE as f64) * (cell / nearest);
    }

    let horizon = if surface.outline == Outline::Point { None } else { surface.horizon(normal) };
    let mut crossed = HashSet::new();
    if surface.outline == Outline::Ellipse {
        for &[a, b, c] in &triangles {
            [[a, b], [b, c], [c, a]].into_iter().for_each(|edge| surface.mark(edge, SIDE, &mut crossed));
        }
        if let Some(line) = horizon {
            surface.mark(line.map(|point| 0.999 * point), SIDE, &mut crossed);
        }
    }

    let corners = surface.corners();
    let all_above = corners.iter().all(|&corner| normal.dot(corner) > 0.0);
    // What one triangle hides of a plane is convex: with the corners it hides all between them.
    let wholly_hidden = triangles
        .iter()
        .any(|&triangle| corners.iter().all(|&c| meeting(c, surface.endless, triangle) == Meeting::Blocked));
    let wholly_seen = all_above && triangles.iter().all(|triangle| is_clear_of(&corners, surface.endless, triangle));
    Some(Truth {
        visibility: seen as f64 * share,
        unsure,
        mixed: crossed.len() as f64 * share,
        is_cut: horizon.is_some(),
        wholly_below: corners.iter().all(|&corner| normal.dot(corner) < 0.0),
        irradiance,
        unshadowed,
        peak,
        smooth_error,
        any_above,
        wholly_hidden,
        wholly_seen,
        surface,
    })
}

/// Whether a plane keeps a triangle out of the pyramid from the origin to the corners (without a base where `endless`).
fn is_clear_of(corners: &[DVec3; 4], endless: bool, triangle: &[DVec3; 3]) -> bool {
    let middle = corners[0] + corners[1] + corners[2] + corners[3];
    let beside = (0..4).any(|i| {
        let side = corners[i].cross(corners[(i + 1) % 4]);
        let outward = if side.dot(middle) > 0.0 { -side } else { side };
        triangle.iter().all(|corner| outward.dot(*corner) > 0.0)
    });
    let base = (corners[1] - corners[0]).cross(corners[3] - corners[0]);
    let away = if base.dot(corners[0]) < 0.0 { -base } else { base };
    let behind = !endless && triangle.iter().all(|&corner| away.dot(corner - corners[0]) > 0.0);
    let plane = (triangle[1] - triangle[0]).cross(triangle[2] - triangle[0]);
    let offset = plane.dot(triangle[0]);
    let one_sided = corners.iter().all(|&corner| {
        let height = plane.dot(corner) - if endless { 0.0 } else { offset };
        if offset > 0.0 { height < 0.0 } else { height > 0.0 }
    });
    beside || behind || one_sided
}

/// A scene with one light of a shape; receivers around its middle, more or less turned towards the light.
fn lit_scene(random: &mut Random, shape: &str) -> (Scene, Vec<(DVec3, [DVec3; 2])>) {
    let mut scene = random.scene(12, 4.0, 2.5);
    let mut light = random.light(shape);
    if random.chance(0.3) {
        light.spread = random.between(0.8, 3.0);
    }
    if matches!(light.shape, Shape::Sphere { .. } | Shape::Point) && random.chance(0.5) {
        light.cone = Some(Cone { inner: random.between(0.05, 0.4), outer: random.between(0.6, 1.4) });
    }
    let center = light.scene_from_light.translation;
    let towards_sun = light.scene_from_light.matrix3.z_axis;
    let is_sun = matches!(light.shape, Shape::Sun { .. });
    let places = (0..24)
        .map(|_| {
            let position = random.in_cube(2.5);
            let towards = if is_sun { towards_sun } else { (center - position).normalize() };
            let normal = (towards + random.between(0.0, 2.0) * random.direction()).normalize();
            // Half of them smooth-shaded.
            let shading_normal =
                if random.chance(0.5) { normal } else { (normal + 0.4 * random.direction()).normalize() };
            (position, [normal, shading_normal])
        })
        .collect();
    scene.add_light(light);
    (scene, places)
}

/// Exact receivers at world positions with geometric and shading normals.
fn turned_receivers(scene: &Scene, places: &[(DVec3, [DVec3; 2])]) -> Receivers {
    let positions: Vec<DVec3> = places.iter().map(|place| place.0).collect();
    let mut receivers = receivers(scene, &positions, DVec3::Y);
    for (receiver, (_, [normal, shading_normal])) in receivers.pixels.iter_mut().flatten().zip(places) {
        (receiver.normal, receiver.shading_normal) = (*normal, *shading_normal);
    }
    receivers
}

/// What was met, so that an agreement about nothing is noticed.
#[derive(Debug, Default)]
struct Tally {
    dark: usize,
    hidden: usize,
    lit: usize,
    partial: usize,
    cut_by_horizon: usize,
    /// Sum of signed differences in V, and of their variances.
    difference: f64,
    variance: f64,
}

#[test]
fn rays_agrees_with_a_brute_force_of_every_shape() {
    SHAPES.into_par_iter().enumerate().for_each(|(number, shape)| {
        let mut random = Random(0xe317 + number as u64);
        let mut tally = Tally::default();
        for scene_number in 0..24 {
            let (mut scene, places) = lit_scene(&mut random, shape);
            let (light, triangles) = (scene.lights[0].clone(), triangles(&scene));
            scene.rebase();
            let receivers = turned_receivers(&scene, &places);
            let image = trace_receivers(&scene, receivers, &rays(Pattern::Grid, (SIDE * SIDE) as u32)).lights.remove(0);
            for (i, &(position, normals)) in places.iter().enumerate() {
                let got = [f64::from(image.visibility[i]), f64::from(image.irradiance[i][0])];
                let what = format!("{shape}, scene {scene_number}, receiver {i}: {light:?} at {position} {normals:?}");
                check(&light, truth(&light, &triangles, position, normals), got, image.facing[i], &what, &mut tally);
            }
        }
        // A point's only sample tells all.
        assert!(tally.dark >= 10 && (shape == "point" || tally.hidden.min(tally.lit) >= 5), "{shape}: {tally:?}");
        assert!(shape == "point" || (tally.partial > 100 && tally.cut_by_horizon > 20), "{shape}: {tally:?}");
        // Independent errors of either side cancel: six standard deviations of their sum.
        assert!(tally.difference.abs() <= 6.0 * tally.variance.sqrt(), "{shape}: {tally:?}");
    });
}

fn check(light: &AreaLight, truth: Option<Truth>, got: [f64; 2], facing: bool, what: &str, tally: &mut Tally) {
    let [visibility, irradiance] = got;
    if !facing {
        assert_eq!(got, [0.0, 0.0], "{what}");
    }
    let Some(truth) = truth else {
        assert!(!facing, "{what} sees the dark side");
        tally.dark += 1;
        return;
    };
    if truth.any_above {
        assert!(facing, "{what}");
    }
    if truth.wholly_below {
        assert!(!facing, "{what}");
    }
    if !truth.any_above {
        tally.dark += 1;
    }
    if truth.wholly_hidden {
        assert_eq!(got, [0.0, 0.0], "{what} is hidden");
        tally.hidden += 1;
    }
    if truth.wholly_seen {
        assert_eq!(visibility, 1.0, "{what} is lit");
        tally.lit += 1;
    }
    tally.partial += usize::from(truth.visibility > 0.0 && truth.visibility < 1.0);
    tally.cut_by_horizon += usize::from(truth.is_cut);

    // Two rectangles' lattices are the same points. On an ellipse ours are rings and theirs squares: a cell that a boundary
    // crosses is right or wrong by at most itself, on either side, at random: variance 1/4 a cell; no error exceeds them all.
    let count = (SIDE * SIDE) as f64;
    let (mut bound, mut variance) = (truth.unsure, 0.0);
    if truth.surface.outline == Outline::Ellipse {
        variance = 0.5 * truth.mixed / count;
        // And one more on either side for a boundary that a cell's corner hides from the walk along it.
        bound += 6.0 * variance.sqrt() + 2.0 / count;
    }
    tally.difference += visibility - truth.visibility;
    tally.variance += variance + truth.unsure.powi(2);
    assert!(
        (visibility - truth.visibility).abs() <= bound,
        "{what}: V {visibility}, expected {} ± {bound}",
        truth.visibility
    );
    // E: what the seen cells may be wrong by, at the largest weight; the closed form against our midpoint sum, which jumps
    // at the geometric horizon by at most half a cell in each row or ring crossed, twice in a ring; the f32 of the image.
    let jump = if truth.is_cut { 1.0 / SIDE as f64 } else { 0.0 };
    let unshadowed_error = truth.smooth_error + jump * truth.peak;
    let relative = 4.0 * f64::from(f32::EPSILON);
    let bound = 2.0 * bound * truth.peak + unshadowed_error + relative * truth.unshadowed;
    assert!(
        (irradiance - truth.irradiance).abs() <= bound,
        "{what}: E {irradiance}, expected {} ± {bound} of {}, strength {}",
        truth.irradiance,
        truth.unshadowed,
        strength(light)
    );
}
