//! Facts about unshadowed irradiance: closed forms, independent sums, limits and extremes.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use glam::{DAffine3, DMat3, DQuat, DVec2, DVec3};
use penumbra::geometry::contour::{Region, polygon_projected_solid_angle};
use penumbra::geometry::irradiance::{emission_factor, reaches, sample_weight, unshadowed};
use penumbra::receivers::{Receiver, UNKNOWN};
use penumbra::scene::light::{AreaLight, Cone, Domain, Emission, Emitter, Shape};

fn receiver(position: DVec3, normal: DVec3) -> Receiver {
    Receiver {
        position,
        position_error: 0.0,
        normal,
        shading_normal: normal,
        depth: 1.0,
        instance: UNKNOWN,
        triangle: UNKNOWN,
        barycentric: [0.0; 2],
    }
}

/// A light at `position` whose −Z points along `axis`.
fn light(shape: Shape, position: DVec3, axis: DVec3) -> AreaLight {
    let z = -axis.normalize();
    let x = z.any_orthonormal_vector();
    let rotation = DMat3::from_cols(x, z.cross(x), z);
    AreaLight::new("light", DAffine3::from_mat3_translation(rotation, position), shape)
}

/// A light at height `h` over the floor z = 0 that shines straight down; local X is world X.
fn ceiling(shape: Shape, h: f64) -> AreaLight {
    let rotation = DMat3::from_cols(DVec3::X, DVec3::Y, DVec3::Z);
    AreaLight::new("light", DAffine3::from_mat3_translation(rotation, DVec3::Z * h), shape)
}

fn e0(light: &AreaLight, receiver: &Receiver) -> f64 {
    unshadowed(light, receiver).x
}

fn square(size: f64) -> Shape {
    Shape::Rect { size: DVec2::splat(size) }
}

fn disk(size: f64) -> Shape {
    Shape::Disk { size: DVec2::splat(size) }
}

fn sphere(radius: f64) -> Shape {
    Shape::Sphere { radius, facing: false }
}

#[track_caller]
fn assert_relative(got: f64, expected: f64, tolerance: f64) {
    let error = (got - expected).abs();
    assert!(error <= tolerance * expected.abs(), "got {got:e}, expected {expected:e}, relative {:e}", error / expected);
}

/// Deterministic numbers in [0, 1).
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next()
    }

    fn direction(&mut self) -> DVec3 {
        loop {
            let v = DVec3::new(self.between(-1.0, 1.0), self.between(-1.0, 1.0), self.between(-1.0, 1.0));
            if v.length_squared() <= 1.0 && v.length_squared() > 1e-4 {
                return v.normalize();
            }
        }
    }
}

/// Mean of `f` over `n`² points uniform on the domain.
fn mean(domain: Domain, n: usize, f: impl Fn(DVec2) -> f64) -> f64 {
    let mut sum = 0.0;
    for i in 0..n {
        let mut row = 0.0;
        for j in 0..n {
            let (a, b) = ((i as f64 + 0.5) / n as f64, (j as f64 + 0.5) / n as f64);
            row += f(match domain {
                Domain::Rect => DVec2::new(2.0 * a - 1.0, 2.0 * b - 1.0),
                Domain::Disk => DVec2::from_angle(TAU * b) * a.sqrt(),
                Domain::Point => DVec2::ZERO,
            });
        }
        sum += row;
    }
    sum / (n * n) as f64
}

/// What `sample_weight` says that E₀ is, from n² samples.
fn sampled(light: &AreaLight, receiver: &Receiver, n: usize) -> f64 {
    let Some(emitter) = light.emitter(receiver.position) else { return 0.0 };
    let area = if emitter.domain == Domain::Point { 1.0 } else { emitter.area() };
    let mean = mean(emitter.domain, n, |uv| sample_weight(light, &emitter, receiver, emitter.at(uv)));
    emission_factor(light).x * area * mean
}

/// The definition, summed over the surface of a flat light: nothing shared with the library but the light's transform.
fn summed(light: &AreaLight, receiver: &Receiver, n: usize) -> f64 {
    let (domain, size, area) = match light.shape {
        Shape::Rect { size } => (Domain::Rect, size, size.x * size.y),
        Shape::Disk { size } => (Domain::Disk, size, PI / 4.0 * size.x * size.y),
        _ => unreachable!("flat lights alone"),
    };
    let Emission::Radiance(radiance) = light.emission else { unreachable!("flat lights have a radiance") };
    let half = 0.5 * light.spread;
    let axis = light.scene_from_light.transform_vector3(DVec3::NEG_Z);
    area * radiance.x
        * mean(domain, n, |uv| {
            let local = (0.5 * size * uv).extend(0.0);
            let to_light = light.scene_from_light.transform_point3(local) - receiver.position;
            let direction = to_light.normalize();
            if receiver.normal.dot(direction) <= 0.0 || axis.dot(direction) >= 0.0 {
                return 0.0;
            }
            let cos_light = -axis.dot(direction);
            let spread = if light.spread < PI {
                (half.tan() - cos_light.acos().tan()).max(0.0) / (half.tan() - half)
            } else {
                1.0
            };
            let cone = light.cone.map_or(1.0, |cone| cone.attenuation(-light.axis().dot(direction)));
            spread * cone * receiver.shading_normal.dot(direction).max(0.0) * cos_light / to_light.length_squared()
        })
}

/// C8: form factor from a corner, sides in heights.
fn corner_form_factor(x: f64, y: f64) -> f64 {
    let (p, q) = ((1.0 + x * x).sqrt(), (1.0 + y * y).sqrt());
    (x / p * (y / p).atan() + y / q * (x / q).atan()) / TAU
}

/// C9: a rectangle [x0, x1] × [y0, y1] at height 1 by signed corners.
fn rectangle_form_factor([x0, x1]: [f64; 2], [y0, y1]: [f64; 2]) -> f64 {
    let f = |x: f64, y: f64| corner_form_factor(x, y);
    f(x1, y1) - f(x0, y1) - f(x1, y0) + f(x0, y0)
}

#[test]
fn parallel_rectangles_have_their_closed_form() {
    for (width, height, h) in [(2.0, 2.0, 5.0), (2.0, 1.0, 1.0), (8.0, 0.5, 2.0), (30.0, 20.0, 1.0), (0.7, 0.3, 1.0)] {
        // The receiver under a corner, where C8 is a single term, and under the middle.
        let light = ceiling(Shape::Rect { size: DVec2::new(width, height) }, h);
        let expected = PI * corner_form_factor(width / h, height / h);
        let corner = receiver(DVec3::new(0.5 * width, -0.5 * height, 0.0), DVec3::Z);
        assert_relative(e0(&light, &corner), expected, 1e-13);
        let expected = 4.0 * PI * corner_form_factor(0.5 * width / h, 0.5 * height / h);
        assert_relative(e0(&light, &receiver(DVec3::ZERO, DVec3::Z)), expected, 1e-13);
    }
}

#[test]
fn parts_of_a_rectangle_add_up() {
    let light = ceiling(square(2.0), 5.0);
    let position = DVec3::new(0.55, -0.4, 0.0);
    let sides = |offset: f64| [(-1.0 - offset) / 5.0, (1.0 - offset) / 5.0];
    let expected = PI * rectangle_form_factor(sides(position.x), sides(position.y));
    assert_relative(e0(&light, &receiver(position, DVec3::Z)), expected, 1e-13);

    // A part of it as a polygon: the signed corners again, and the rest by difference.
    let part = |x: [f64; 2], y: [f64; 2]| {
        let corners = [[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]];
        polygon_projected_solid_angle(&corners.map(|[x, y]| DVec3::new(x, y, 1.0)), DVec3::Z)
    };
    let (x, y) = ([-0.11, 0.05], [0.08, 0.28]);
    assert!((part(x, y) - PI * rectangle_form_factor(x, y)).abs() < 1e-14);
    let rest = part([0.05, 0.09], y) + part([-0.31, -0.11], y) + part([-0.31, 0.09], [-0.12, 0.08]);
    assert!((rest + part(x, y) - expected).abs() < 1e-14);
}

#[test]
fn discs_have_their_closed_forms() {
    for (r, h) in [(1.0, 1.0), (0.25, 7.0), (40.0, 0.5), (1e-3, 1.0)] {
        let on_axis = receiver(DVec3::ZERO, DVec3::Z);
        assert_relative(e0(&ceiling(disk(2.0 * r), h), &on_axis), PI * r * r / (r * r + h * h), 1e-14);
    }
    // Parallel, off the axis (Howell's configuration factor B-11): ½(1 − (x² + h² − r²)/√((x² + h² + r²)² − 4r²x²)).
    for (r, h, x) in [(1.0f64, 1.0f64, 0.5f64), (1.0, 0.5, 1.0), (2.0, 1.0, 7.0)] {
        let z = x * x + h * h;
        let expected = FRAC_PI_2 * (1.0 - (z - r * r) / ((z + r * r).powi(2) - 4.0 * r * r * x * x).sqrt());
        assert_relative(e0(&ceiling(disk(2.0 * r), h), &receiver(DVec3::X * x, DVec3::Z)), expected, 1e-13);
    }
}

#[test]
fn spheres_above_the_horizon_have_their_closed_form() {
    let mut random = Random(1);
    for _ in 0..1000 {
        let (normal, direction) = (random.direction(), random.direction());
        let distance = random.between(0.1, 10.0);
        let radius = distance * random.between(1e-6, 1.0);
        let cos = normal.dot(direction);
        if cos * distance < radius * 1.0001 {
            continue;
        }
        let light = light(sphere(radius), direction * distance, DVec3::X);
        assert_relative(e0(&light, &receiver(DVec3::ZERO, normal)), PI * (radius / distance).powi(2) * cos, 1e-12);
    }
}

/// ∫max(cos θ, 0) dω over a sphere of angular radius `alpha` whose centre is at angle `theta` from the normal: rings about the
/// normal, each with the angle that the sphere covers of it. Independent of contours and discs.
fn sphere_by_rings(theta: f64, alpha: f64, n: usize) -> f64 {
    let (low, high) = ((theta - alpha).abs(), (theta + alpha).min(FRAC_PI_2));
    let ring = |t: f64| {
        let cos = ((alpha.cos() - theta.cos() * t.cos()) / (theta.sin() * t.sin())).clamp(-1.0, 1.0);
        2.0 * cos.acos() * t.cos() * t.sin()
    };
    // Square roots at the ends: t = low + (high − low)·(3s² − 2s³) smooths both.
    let sum: f64 = (0..n)
        .map(|i| {
            let s = (i as f64 + 0.5) / n as f64;
            ring(low + (high - low) * s * s * (3.0 - 2.0 * s)) * 6.0 * s * (1.0 - s)
        })
        .sum();
    let cap = if theta < alpha { PI * (alpha - theta).sin().powi(2) } else { 0.0 };
    (high - low) * sum / n as f64 + cap
}

#[test]
fn spheres_partly_below_the_horizon_match_rings() {
    for alpha in [0.01f64, 0.3, 0.9, 1.4] {
        for share in [-0.95, -0.5, 0.0, 0.4, 0.99] {
            let theta = FRAC_PI_2 + share * alpha;
            let light = light(sphere(2.0 * alpha.sin()), 2.0 * DVec3::new(theta.sin(), 0.0, theta.cos()), DVec3::X);
            let (coarse, fine) = (sphere_by_rings(theta, alpha, 20_000), sphere_by_rings(theta, alpha, 40_000));
            let full = PI * alpha.sin().powi(2);
            let got = e0(&light, &receiver(DVec3::ZERO, DVec3::Z));
            let error = 4.0 * (fine - coarse).abs() + 1e-12 * full;
            assert!((got - fine).abs() <= error, "alpha {alpha}, theta {theta}: {got} and {fine}, {:e}", got - fine);
            assert!(error < 1e-7 * full);
        }
    }
}

#[test]
fn tilted_flat_lights_match_sums() {
    let mut random = Random(2);
    for index in 0..60 {
        let size = DVec2::new(random.between(0.1, 4.0), random.between(0.1, 4.0));
        let shape = match index % 3 {
            0 => Shape::Rect { size },
            1 => disk(size.x),
            _ => Shape::Disk { size },
        };
        let position = 2.0 * random.direction();
        let axis = (-position + 1.2 * random.direction()).normalize();
        let light = light(shape, position, axis);
        let normal = (position.normalize() + 1.4 * random.direction()).normalize();
        let mut receiver = receiver(DVec3::ZERO, normal);
        if index % 2 == 0 {
            receiver.shading_normal = (normal + 0.5 * random.direction()).normalize();
        }
        // The clipped edge falls between samples: an error of one row at most, of the size that halving shows.
        let (coarse, fine) = (summed(&light, &receiver, 500), summed(&light, &receiver, 1000));
        let got = e0(&light, &receiver);
        let full = PI.min(PI * size.x * size.y / 4.0);
        assert!((got - fine).abs() <= 3.0 * (fine - coarse).abs() + 3e-6 * full, "{index}: {got}, {fine}, {coarse}");
    }
}

#[test]
fn whole_ellipses_match_sums_to_many_digits() {
    // Midpoints on a circle of the domain converge geometrically; Gauss–Legendre would on its radius, midpoints do as 1/n².
    for (size, position, normal) in [
        (DVec2::new(2.0, 1.0), DVec3::ZERO, DVec3::Z),
        (DVec2::new(0.6, 3.0), DVec3::new(0.3, 0.2, 0.0), DVec3::new(0.1, 0.2, 1.0).normalize()),
        (DVec2::new(0.1, 0.03), DVec3::new(0.3, 0.2, 0.0), DVec3::Z),
        (DVec2::new(0.02, 0.01), DVec3::new(-0.3, 0.9, 0.0), DVec3::Z),
    ] {
        let light = ceiling(Shape::Disk { size }, 3.0);
        let receiver = receiver(position, normal);
        let sums = [500, 1000].map(|n| summed(&light, &receiver, n));
        let extrapolated = sums[1] + (sums[1] - sums[0]) / 3.0;
        assert_relative(e0(&light, &receiver), extrapolated, 1e-11);
    }
}

#[test]
fn an_ellipse_of_equal_axes_is_a_circle() {
    // A relative difference of 1e-14 in the axes takes the quadrature instead of the closed form.
    let mut random = Random(3);
    for _ in 0..500 {
        let size = 10f64.powf(random.between(-3.0, 3.0));
        let circle = light(disk(size), random.direction(), random.direction());
        let mut ellipse = circle.clone();
        ellipse.shape = Shape::Disk { size: size * DVec2::new(1.0, 1.0 + 1e-14) };
        let mut receiver = receiver(DVec3::ZERO, random.direction());
        receiver.shading_normal = (receiver.normal + 0.3 * random.direction()).normalize();
        let (circle, ellipse) = (e0(&circle, &receiver), e0(&ellipse, &receiver));
        assert!((circle - ellipse).abs() <= 1e-10 * circle + 1e-14, "{size}: {circle:e} {ellipse:e}");
    }
}

#[test]
fn rims_of_huge_ellipses_are_not_missed() {
    // The receiver is a height from the rim of a light of 10³ to 10¹² heights: an arc's nearest point is all that matters.
    let mut random = Random(10);
    for index in 0..600 {
        let half = 10f64.powf(random.between(3.0, if index % 2 == 0 { 6.0 } else { 12.0 }));
        let rim = random.between(0.0, TAU);
        let position = DVec3::new(rim.cos(), rim.sin(), 0.0) * (half + random.between(-5.0, 5.0));
        let spread = if index % 3 == 0 { 2.0 } else { PI };
        let mut receiver = receiver(position, DVec3::Z);
        receiver.shading_normal = (DVec3::Z + 0.5 * random.direction()).normalize();
        let values = [disk(2.0 * half), Shape::Disk { size: 2.0 * half * DVec2::new(1.0, 1.0 + 1e-14) }]
            .map(|shape| e0(&AreaLight { spread, ..ceiling(shape, 1.0) }, &receiver));
        // Coordinates of the rim are rounded to ε·half, and the axes differ by 45 of those; the spread's radiance is up to 2.8.
        let tolerance = 1e-10 + 3.0 * 64.0 * f64::EPSILON * half;
        assert!((values[0] - values[1]).abs() <= tolerance, "{index}: half {half:e}: {values:?}");
    }
}

#[test]
fn cones_that_cut_nothing_change_nothing() {
    let mut random = Random(11);
    for index in 0..60 {
        let size = DVec2::new(random.between(2.0, 6.0), random.between(2.0, 6.0));
        let shape = if index % 2 == 0 { Shape::Rect { size } } else { Shape::Disk { size } };
        let mut light = ceiling(shape, 1.0);
        light.spread = if index % 3 == 0 { 1.7 } else { PI };
        let mut receiver = receiver(DVec3::new(random.between(-2.0, 2.0), random.between(-2.0, 2.0), 0.0), DVec3::Z);
        receiver.normal = (DVec3::Z + 0.9 * random.direction()).normalize();
        receiver.shading_normal = (receiver.normal + 0.3 * random.direction()).normalize();
        let expected = e0(&light, &receiver);
        // No point of the light is beyond 2 + 3√2 heights across: 81°.
        light.cone = Some(Cone { inner: 82f64.to_radians(), outer: 84f64.to_radians() });
        let got = e0(&light, &receiver);
        assert!((got - expected).abs() <= 1e-8 * expected.max(0.1), "{index}: {got} {expected} {:e}", got - expected);
    }
}

#[test]
fn tiny_lights_are_points() {
    let (position, axis) = (DVec3::new(1.0, 2.0, 3.0), DVec3::new(-0.2, -0.5, -1.0).normalize());
    let mut receiver = receiver(DVec3::new(0.1, 0.0, 0.2), DVec3::new(0.3, -0.1, 1.0).normalize());
    receiver.shading_normal = DVec3::new(0.2, 0.1, 1.0).normalize();
    let to_light = position - receiver.position;
    let direction = to_light.normalize();
    let cosines = receiver.shading_normal.dot(direction) / to_light.length_squared();
    let cos_light = -axis.dot(direction);
    for half in [1e-6, 1e-10, 1e-20, 1e-30] {
        let size = 2.0 * half * DVec2::new(1.0, 0.5);
        for (shape, area) in [
            (Shape::Rect { size }, size.x * size.y * cos_light),
            (Shape::Disk { size }, PI / 4.0 * size.x * size.y * cos_light),
            (disk(2.0 * half), PI * half * half * cos_light),
            (sphere(half), PI * half * half),
            (Shape::Sphere { radius: half, facing: true }, PI * half * half),
        ] {
            assert_relative(e0(&light(shape, position, axis), &receiver), area * cosines, 1e-9);
        }
        let mut tube = light(Shape::Tube { length: 4.0 * half, radius: half }, position, axis);
        let along = tube.scene_from_light.matrix3.x_axis;
        let sin = (1.0 - along.dot(direction).powi(2)).sqrt();
        assert_relative(e0(&tube, &receiver), 8.0 * half * half * sin * cosines, 1e-9);
        tube.emission = Emission::Radiance(DVec3::ZERO);
        assert_eq!(e0(&tube, &receiver), 0.0);
    }
    let mut sun = light(Shape::Sun { angle: 1e-30 }, position, axis);
    assert_relative(e0(&sun, &receiver), -receiver.shading_normal.dot(axis), 1e-12);
    sun.shape = Shape::Sun { angle: 0.0 };
    assert_relative(e0(&sun, &receiver), -receiver.shading_normal.dot(axis), 1e-15);
}

#[test]
fn tiny_lights_with_spread_or_cone_are_points() {
    for half in [1e-4, 1e-8, 1e-16, 1e-30] {
        for shape in [square(2.0 * half), disk(2.0 * half), Shape::Disk { size: half * DVec2::new(2.0, 1.0) }] {
            let mut light = light(shape, DVec3::new(0.3, 0.2, 1.0), DVec3::NEG_Z);
            let receiver = receiver(DVec3::ZERO, DVec3::Z);
            for (spread, cone) in [
                (FRAC_PI_2, None),
                (PI, Some(Cone { inner: 0.1, outer: 0.6 })),
                (2.0, Some(Cone { inner: 0.1, outer: 0.6 })),
            ] {
                (light.spread, light.cone) = (spread, cone);
                let emitter = light.emitter(receiver.position).unwrap();
                let expected = emitter.area() * sample_weight(&light, &emitter, &receiver, emitter.center);
                assert!(expected > 0.0);
                assert_relative(e0(&light, &receiver), expected, 3.0 * half + 1e-11);
            }
        }
    }
}

#[test]
fn huge_lights_fill_the_hemisphere() {
    for shape in [square(2e6), disk(2e6), Shape::Disk { size: DVec2::new(2e6, 4e6) }] {
        for position in [DVec3::ZERO, DVec3::new(3e4, -2e4, 0.0)] {
            let below = receiver(position, DVec3::Z);
            // What is missing is beyond 0.9e6 heights: π/(1 + 0.9e6²).
            assert_relative(e0(&ceiling(shape, 1.0), &below), PI, 1.3e-12);
            // Tilted by 60°, the horizon cuts away (1 − cos 60°)/2.
            let tilted = receiver(position, DVec3::new(0.75f64.sqrt(), 0.0, 0.5));
            assert_relative(e0(&ceiling(shape, 1.0), &tilted), 0.75 * PI, 3e-6);
        }
    }
    let near = light(sphere(1e6), DVec3::Z * (1e6 + 1.0), DVec3::X);
    assert_relative(e0(&near, &receiver(DVec3::ZERO, DVec3::Z)), PI, 2.1e-6);
    let tube = light(Shape::Tube { length: 1e6, radius: 1e6 }, DVec3::Z, DVec3::NEG_Z);
    assert_relative(e0(&tube, &receiver(DVec3::ZERO, DVec3::Z)), PI, 1e-11);
}

#[test]
fn coplanar_lights_give_exactly_nothing() {
    let mut random = Random(4);
    for _ in 0..2000 {
        let rotation = DQuat::from_axis_angle(random.direction(), random.between(0.0, TAU));
        let normal = rotation * DVec3::Z;
        let scale = 10f64.powf(random.between(-6.0, 6.0));
        let corner = scale * random.direction();
        let at = |x: f64, y: f64| corner + scale * (rotation * DVec3::new(x, y, 0.0));
        let rest = receiver(at(random.between(-3.0, 3.0), random.between(-3.0, 3.0)), normal);
        let position = at(random.between(-3.0, 3.0), random.between(-3.0, 3.0));
        // The light in the receiver's plane, facing along it or against it; and points in that plane.
        for shape in [square(scale), disk(scale)] {
            for axis in [normal, -normal] {
                assert_eq!(unshadowed(&light(shape, position, axis), &rest), DVec3::ZERO);
            }
        }
        assert_eq!(unshadowed(&light(Shape::Point, position, normal), &rest), DVec3::ZERO);
        // A light whose upper edge lies in the plane.
        let standing = DAffine3::from_mat3_translation(
            DMat3::from_quat(rotation * DQuat::from_rotation_x(FRAC_PI_2)),
            position - 0.5 * scale * normal,
        );
        let standing = AreaLight::new("light", standing, square(scale));
        assert_eq!(unshadowed(&standing, &rest), DVec3::ZERO);
    }
}

#[test]
fn lights_reach_only_what_they_rise_above() {
    let floor = receiver(DVec3::ZERO, DVec3::Z);
    let reached = |light: &AreaLight, receiver: &Receiver| {
        light.emitter(receiver.position).is_some_and(|emitter| reaches(&emitter, receiver))
    };
    let standing = |bottom: f64| light(square(1.0), DVec3::new(3.0, 0.0, bottom + 0.5), DVec3::NEG_X);
    assert!(reached(&standing(0.0), &floor) && reached(&standing(-0.999), &floor));
    assert!(!reached(&standing(-1.0), &floor) && !reached(&standing(-2.0), &floor));
    assert!(reached(&light(sphere(1.0), DVec3::new(3.0, 0.0, -0.99), DVec3::X), &floor));
    assert!(!reached(&light(sphere(1.0), DVec3::new(3.0, 0.0, -1.0), DVec3::X), &floor));
    let mut uncertain = floor;
    uncertain.position_error = 1e-3;
    assert!(!reached(&standing(-0.9995), &uncertain) && reached(&standing(-0.9985), &uncertain));
    let sun = |z: f64| light(Shape::Sun { angle: 0.01 }, DVec3::ZERO, DVec3::new(1.0, 0.0, -z));
    assert!(reached(&sun(-0.004), &floor) && !reached(&sun(-0.006), &floor));
    // The sun is at infinity wherever the receiver is.
    assert!(reached(&sun(-0.004), &receiver(DVec3::splat(1e15), DVec3::Z)));
}

#[test]
fn turning_a_receiver_away_dims_it_continuously() {
    let lights = [
        light(square(1.0), DVec3::Z * 2.0, DVec3::new(0.3, 0.1, -1.0)),
        light(disk(1.0), DVec3::Z * 2.0, DVec3::new(0.3, 0.1, -1.0)),
        light(Shape::Disk { size: DVec2::new(1.0, 0.4) }, DVec3::Z * 2.0, DVec3::new(0.3, 0.1, -1.0)),
        light(sphere(0.5), DVec3::Z * 2.0, DVec3::X),
        light(Shape::Tube { length: 1.0, radius: 0.3 }, DVec3::Z * 2.0, DVec3::Z),
        light(Shape::Sun { angle: 0.4 }, DVec3::ZERO, DVec3::NEG_Z),
        light(disk(0.01), DVec3::Z * 2.0, DVec3::new(0.3, 0.1, -1.0)),
    ];
    const STEPS: usize = 20_000;
    for light in &lights {
        let values: Vec<f64> = (0..=STEPS)
            .map(|i| {
                // From facing the light to past 90°, until all of it has set.
                let angle = (FRAC_PI_2 + 0.35) * i as f64 / STEPS as f64;
                e0(light, &receiver(DVec3::ZERO, DVec3::new(angle.sin(), 0.0, angle.cos())))
            })
            .collect();
        assert!(values[0] > 0.0);
        assert_eq!(values[STEPS], 0.0);
        for (i, pair) in values.windows(2).enumerate() {
            // dE/dangle is at most E facing the light; the first steps may rise towards an oblique light's own best angle.
            assert!((pair[0] - pair[1]).abs() <= 1.05 * 1.93 * values[0] / STEPS as f64 + 1e-14);
            assert!(i < STEPS / 4 || pair[1] <= pair[0] + 1e-15, "{:?} step {i}: {} {}", light.shape, pair[0], pair[1]);
        }
    }
}

#[test]
fn a_spread_of_a_half_turn_is_lambertian() {
    let mut random = Random(5);
    for _ in 0..200 {
        let shape = if random.next() < 0.5 { square(random.between(0.1, 3.0)) } else { disk(random.between(0.1, 3.0)) };
        let mut light = light(shape, 2.0 * random.direction(), random.direction());
        let receiver = receiver(DVec3::ZERO, random.direction());
        let lambertian = e0(&light, &receiver);
        // As it nears a half turn: (tan h − tan θ)/(tan h − h) differs by (tan θ + h)/tan h.
        light.spread = PI * (1.0 - 1e-9);
        assert!((e0(&light, &receiver) - lambertian).abs() <= 1e-7 * PI);
        light.spread = PI;
        assert_eq!(e0(&light, &receiver), lambertian);
    }
}

#[test]
fn spreads_match_sums() {
    let mut random = Random(6);
    for index in 0..60 {
        let size = DVec2::new(random.between(0.05, 4.0), random.between(0.05, 4.0));
        let shape = match index % 3 {
            0 => Shape::Rect { size },
            1 => disk(size.x),
            _ => Shape::Disk { size },
        };
        let position = 2.0 * random.direction();
        let mut light = light(shape, position, (-position + 0.9 * random.direction()).normalize());
        light.spread = [90f64, 45.0, 150.0, 20.0][index % 4].to_radians();
        let normal = (position.normalize() + 1.2 * random.direction()).normalize();
        let mut receiver = receiver(DVec3::ZERO, normal);
        receiver.shading_normal = (normal + 0.3 * random.direction()).normalize();
        let (coarse, fine) = (summed(&light, &receiver, 500), summed(&light, &receiver, 1000));
        let got = e0(&light, &receiver);
        let full = sampled(&light, &receiver, 30).max(1e-3);
        assert!((got - fine).abs() <= 3.0 * (fine - coarse).abs() + 3e-6 * full, "{index}: {got} {fine} {coarse}");
    }
}

#[test]
fn spread_on_the_axis_of_a_disc_has_its_closed_form() {
    // E = 2π/(tan h − h) ∫₀^m (tan h − tan θ) cos θ sin θ dθ with tan m = min(r/d, tan h).
    for spread in [1e-3f64, 0.1, 1.0, 2.0, 3.0] {
        for ratio in [1e-4f64, 0.01, 0.3, 1.0, 50.0, 1e6] {
            let half = 0.5 * spread;
            let mut light = ceiling(disk(2.0 * ratio), 1.0);
            light.spread = spread;
            let limit = ratio.atan().min(half);
            let norm =
                if half < 0.1 { half.powi(3) * (1.0 / 3.0 + half * half * 2.0 / 15.0) } else { half.tan() - half };
            // sin² m tan h − (m − sin m cos m), both by their series where they are small.
            let second = if limit < 0.1 {
                limit.powi(3) * (2.0 / 3.0 - limit * limit * 2.0 / 15.0)
            } else {
                limit - limit.sin() * limit.cos()
            };
            let expected = PI * (half.tan() * limit.sin().powi(2) - second) / norm;
            // Two terms of the series leave 1e-6·m⁴ at 0.05.
            assert_relative(e0(&light, &receiver(DVec3::ZERO, DVec3::Z)), expected, 2e-6);
            if half > 0.1 && limit > 0.1 {
                assert_relative(e0(&light, &receiver(DVec3::ZERO, DVec3::Z)), expected, 1e-11);
            }
        }
    }
}

#[test]
fn spread_keeps_the_power() {
    // All light passes a sphere around it: ∫E dA = πLA, receivers facing the light's centre, which is small beside the sphere
    // so that the cosines agree to 1e-6.
    let size = 1e-3;
    for spread in [PI, 150f64.to_radians(), FRAC_PI_2, 45f64.to_radians(), 0.1] {
        let mut light = ceiling(square(size), 0.0);
        light.spread = spread;
        let n = 4000;
        let limit = (0.5 * spread + 2.0 * size).min(FRAC_PI_2);
        let sum: f64 = (0..n)
            .map(|i| {
                let theta = limit * (i as f64 + 0.5) / f64::from(n);
                let below = -DVec3::new(theta.sin(), 0.0, theta.cos());
                e0(&light, &receiver(below, -below)) * TAU * theta.sin() * limit / f64::from(n)
            })
            .sum();
        assert_relative(sum, PI * size * size, 5e-6);
    }
}

#[test]
fn sample_weights_add_up_to_the_irradiance() {
    let mut random = Random(7);
    let cone = Cone { inner: 0.35, outer: 0.6 };
    let sharp = Cone { inner: 0.5, outer: 0.5 };
    for index in 0..120 {
        let (a, b) = (random.between(0.05, 2.0), random.between(0.05, 2.0));
        let size = DVec2::new(a, b);
        let shape = match index % 8 {
            0 => Shape::Rect { size },
            1 => disk(a),
            2 => Shape::Disk { size },
            3 => sphere(0.5 * a),
            4 => Shape::Sphere { radius: a, facing: true },
            5 => Shape::Tube { length: a, radius: 0.5 * b },
            6 => Shape::Sun { angle: 0.5 * a },
            _ => Shape::Point,
        };
        let position = 2.0 * random.direction();
        let mut light = light(shape, position, (-position + 0.7 * random.direction()).normalize());
        if index % 5 == 0 {
            light.spread = 1.3;
        }
        if !matches!(shape, Shape::Sun { .. }) {
            light.cone = [None, Some(cone), Some(sharp)][index % 3];
        }
        let direction = if index % 8 == 6 { -light.axis() } else { position.normalize() };
        let normal = (direction + 1.1 * random.direction()).normalize();
        let mut receiver = receiver(DVec3::ZERO, normal);
        receiver.shading_normal = (normal + 0.3 * random.direction()).normalize();
        let got = e0(&light, &receiver);
        let (coarse, fine) = (sampled(&light, &receiver, 501), sampled(&light, &receiver, 1000));
        let mut plain = light.clone();
        (plain.cone, plain.spread) = (None, PI);
        let full = e0(&plain, &receiver);
        // A jump (of the sharp cone) between two grids: a boundary of length ~n cells, each cell's error random.
        let jump = if light.cone == Some(sharp) { 3e-5 } else { 3e-6 };
        assert!(
            (got - fine).abs() <= 3.0 * (fine - coarse).abs() + jump * full.max(1e-3),
            "{index} {shape:?}: {got} {fine} {coarse}"
        );
    }
}

#[test]
fn cones_that_hold_or_miss_the_whole_light_need_no_quadrature() {
    let mut light = light(sphere(0.1), DVec3::Z * 2.0, DVec3::NEG_Z);
    let receiver = receiver(DVec3::new(0.2, 0.0, 0.0), DVec3::Z);
    let plain = e0(&light, &receiver);
    light.cone = Some(Cone { inner: 0.4, outer: 0.5 });
    assert_eq!(e0(&light, &receiver), plain);
    light.cone = Some(Cone { inner: 0.0, outer: 0.03 });
    assert_eq!(e0(&light, &receiver), 0.0);
}

#[test]
fn cones_on_the_axis_have_their_closed_form() {
    // A large facing disc seen along the axis: E = 2π∫ attenuation(cos θ) cos θ sin θ dθ up to atan(r/d), with c = cos θ.
    let cone = Cone { inner: 0.3, outer: 0.7 };
    let (ci, co) = (cone.inner.cos(), cone.outer.cos());
    for ratio in [0.5f64, 1.0, 30.0] {
        let mut light = ceiling(Shape::Sphere { radius: ratio, facing: true }, 1.0);
        light.cone = Some(cone);
        let low = (1.0 / ratio.hypot(1.0)).max(co);
        // ∫(c − co)²·c dc from low to ci.
        let antiderivative = |c: f64| c.powi(4) / 4.0 - 2.0 * co * c.powi(3) / 3.0 + co * co * c * c / 2.0;
        let falloff = (antiderivative(ci) - antiderivative(low)) / (ci - co).powi(2);
        let expected = TAU * (0.5 * (1.0 - ci * ci) + falloff);
        assert_relative(e0(&light, &receiver(DVec3::ZERO, DVec3::Z)), expected, 1e-10);
    }
}

/// A configuration over many orders of magnitude.
fn wild(random: &mut Random, decades: f64) -> (AreaLight, Receiver) {
    let mut length = || 10f64.powf(random.between(-decades, decades));
    let (a, b, distance, shift) = (length(), length(), length(), length());
    let shape = match (random.next() * 9.0) as usize {
        0 | 1 => Shape::Rect { size: DVec2::new(a, b) },
        2 => disk(a),
        3 => Shape::Disk { size: DVec2::new(a, b) },
        4 => sphere(a),
        5 => Shape::Sphere { radius: a, facing: true },
        6 => Shape::Tube { length: a, radius: b },
        7 => Shape::Sun { angle: (a / b).atan() },
        _ => Shape::Point,
    };
    let normal = if random.next() < 0.3 { DVec3::Z } else { random.direction() };
    let mut axis = random.direction();
    if random.next() < 0.3 {
        axis =
            *[normal, -normal, DVec3::X, normal.any_orthonormal_vector()].get((random.next() * 4.0) as usize).unwrap();
    }
    let position = if random.next() < 0.5 { DVec3::ZERO } else { shift * random.direction() };
    let mut offset = distance * random.direction();
    if random.next() < 0.2 {
        // Touching the receiver's plane, or the light's own.
        offset -= offset.dot(normal) * normal;
    } else if random.next() < 0.2 {
        offset -= offset.dot(axis) * axis * (1.0 - 1e-12);
    }
    let mut light = light(shape, position + offset, axis);
    if random.next() < 0.2 {
        light.spread = *[1e-9, 0.01, 1.0, 3.0, PI * (1.0 - 1e-15)].get((random.next() * 5.0) as usize).unwrap();
    }
    if random.next() < 0.03 && !matches!(shape, Shape::Sun { .. }) {
        let outer = random.between(0.0, FRAC_PI_2);
        light.cone = Some(Cone { inner: outer * random.between(0.0, 1.0), outer });
    }
    let mut receiver = receiver(position, normal);
    if random.next() < 0.5 {
        receiver.shading_normal = (normal + 0.5 * random.direction()).normalize();
    }
    (light, receiver)
}

#[test]
fn extremes_are_finite_and_bounded() {
    use rayon::prelude::*;
    (0..100_000u64).into_par_iter().for_each(|seed| {
        let (light, receiver) = wild(&mut Random(seed), 30.0);
        let got = e0(&light, &receiver);
        assert!(got.is_finite() && got >= 0.0, "seed {seed}: {got}, {light:?} {receiver:?}");
        if light.spread >= PI && matches!(light.emission, Emission::Radiance(_)) {
            assert!(got <= PI * (1.0 + 1e-12), "seed {seed}: {got}, {light:?} {receiver:?}");
        }
        if let Some(emitter) = light.emitter(receiver.position) {
            let weight = sample_weight(&light, &emitter, &receiver, emitter.center);
            assert!(weight.is_finite() && weight >= 0.0, "seed {seed}: weight {weight}, {light:?} {receiver:?}");
        }
    });
}

#[test]
fn scaling_by_powers_of_two_changes_no_bit() {
    let scaled = |shape: Shape, k: f64| match shape {
        Shape::Rect { size } => Shape::Rect { size: k * size },
        Shape::Disk { size } => Shape::Disk { size: k * size },
        Shape::Sphere { radius, facing } => Shape::Sphere { radius: k * radius, facing },
        Shape::Tube { length, radius } => Shape::Tube { length: k * length, radius: k * radius },
        Shape::Sun { .. } | Shape::Point => shape,
    };
    for seed in 0..5000 {
        let (light, receiver) = wild(&mut Random(seed), 2.0);
        let expected = e0(&light, &receiver);
        for k in [2f64.powi(-20), 2f64.powi(20)] {
            let mut far = light.clone();
            far.shape = scaled(light.shape, k);
            far.scene_from_light.translation *= k;
            let moved = Receiver { position: k * receiver.position, ..receiver };
            let falloff = if light.shape == Shape::Point { k * k } else { 1.0 };
            assert_eq!((e0(&far, &moved) * falloff).to_bits(), expected.to_bits(), "seed {seed}: {light:?}");
        }
    }
}

#[test]
fn clipped_regions_add_up_to_the_whole() {
    let mut random = Random(8);
    for index in 0..2000 {
        let (half_u, half_v) = (random.direction(), random.direction());
        let half_v = half_v.cross(half_u).normalize() * random.between(0.2, 1.0);
        let normal = half_u.cross(half_v).normalize();
        // Far enough for all of it to lie before the plane that `facing` is normal to.
        let center = 10f64.powf(random.between(0.2, 3.0)) * random.direction();
        let normal = if normal.dot(center) < 0.0 { normal } else { -normal };
        let domain = if index % 2 == 0 { Domain::Rect } else { Domain::Disk };
        let half_v = if index % 4 == 1 { half_v.normalize() } else { half_v };
        let emitter = Emitter { domain, center, half_u, half_v, normal, distant: false };
        let region = Region::of(&emitter);
        // A plane through the receiver and a point of the emitter.
        let through = emitter.at(0.6 * DVec2::new(random.between(-1.0, 1.0), random.between(-1.0, 1.0)));
        let plane = through.cross(random.direction()).normalize();
        let facing = center.normalize();
        let [a, b] = [plane, -plane].map(|n| region.clone().clipped(n).projected_solid_angle(facing));
        let whole = region.projected_solid_angle(facing);
        assert!(a >= 0.0 && b >= 0.0, "{index}: {a} {b}");
        // The cut itself is rounded: by ε·|c| of a length of about 1.
        let tolerance = (1e-11 + 1e-15 * center.length()) * whole;
        assert!((a + b - whole).abs() <= tolerance, "{index}: {a} + {b} = {whole}, off {:e}", (a + b - whole) / whole);
    }
}
