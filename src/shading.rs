//! What surfaces look like: radiance towards the camera, from the irradiance of each light.
//!
//! Irradiance E holds the shadow; a surface multiplies it by what share of it goes where. A Lambertian one sends E·ρ/π everywhere.
//! Phong's lobe around the mirrored direction (Phong 1975, "Illumination for Computer Generated Pictures", normalised as Lafortune
//! and Willems 1994, "Using the Modified Phong Reflectance Model for Physically Based Rendering") sends
//! E·k_s/π · (n + 2)/2 · cosⁿα more, its cosine averaged over the light by what each part of the light adds to E₀. So shadows dim a
//! highlight as they dim E, as if they hid no part of the light rather than another.

use std::f64::consts::FRAC_1_PI;

use clap::ValueEnum;
use glam::{DVec2, DVec3, Vec3};
use rayon::prelude::*;

use crate::geometry::irradiance::sample_weight;
use crate::history::Shot;
use crate::receivers::{Receiver, Receivers};
use crate::sampling::on_domain;
use crate::scene::light::Domain;
use crate::scene::{AreaLight, Material, Scene};
use crate::techniques::LightImage;

/// How surfaces reflect.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Shading {
    /// Base colour over π, whatever the material
    Lambert,
    /// A highlight as well, by the material's metalness and roughness
    Phong,
}

/// Reflectance along the normal of what is not metal (glTF 2.0, Appendix B).
const DIELECTRIC: f64 = 0.04;

/// Roughness below this is taken as this: a lobe of a million.
const LEAST_ROUGHNESS: f64 = 0.03;

/// Points of a light at which lobes are averaged, along each side of a square one.
const POINTS_A_SIDE: f64 = 16.0;

/// Standard deviation of the narrowest lobe that is averaged, in angles between neighbouring points: sums of such Gaussians ripple
/// by 2·exp(−2π²σ²) = .002. A narrower one would show the points.
const LEAST_DEVIATION: f64 = 0.6;

/// Adds the radiance of each pixel's receiver towards the camera, W/(m²·sr), of all lights.
pub fn add_radiance(
    shaded: &mut [[f32; 3]],
    shading: Shading,
    (scene, receivers): (&Scene, &Receivers),
    lights: &[LightImage],
    shot: &Shot,
) {
    let width = receivers.size[0] as usize;
    shaded.par_iter_mut().enumerate().for_each(|(i, shaded)| {
        let Some(receiver) = &receivers.pixels[i] else { return };
        let look = Look::of(scene, receiver);
        let irradiance = || lights.iter().map(|light| Vec3::from(light.irradiance[i]).as_dvec3());
        let radiance = match shading {
            Shading::Lambert => look.base_color * irradiance().sum::<DVec3>() * FRAC_1_PI,
            Shading::Phong => {
                let at_px = DVec2::new((i % width) as f64, (i / width) as f64) + shot.offset_px;
                let mirrored = reflected(shot.camera.ray(at_px, shot.size).direction, receiver.shading_normal);
                let of_light = |(light, irradiance): (&AreaLight, DVec3)| {
                    if irradiance == DVec3::ZERO {
                        irradiance
                    } else {
                        irradiance * look.phong(light, receiver, mirrored)
                    }
                };
                scene.lights.iter().zip(irradiance()).map(of_light).sum::<DVec3>() * FRAC_1_PI
            }
        };
        *shaded = (Vec3::from(*shaded) + radiance.as_vec3()).to_array();
    });
}

/// A direction mirrored at a plane, unit.
fn reflected(direction: DVec3, normal: DVec3) -> DVec3 {
    (direction - 2.0 * normal.dot(direction) * normal).normalize()
}

/// A material at one place.
#[derive(Debug, Clone, Copy)]
struct Look {
    /// Linear.
    base_color: DVec3,
    metallic: f64,
    roughness: f64,
}

impl Look {
    fn of(scene: &Scene, receiver: &Receiver) -> Self {
        let mesh = &scene.meshes[scene.instances[receiver.instance as usize].mesh];
        let Some(Material { base_color, base_color_texture, metallic, roughness, .. }) =
            mesh.material.map(|index| &scene.materials[index])
        else {
            return Self { base_color: DVec3::ONE, metallic: 0.0, roughness: 1.0 };
        };
        let texel = base_color_texture.as_ref().map_or(Vec3::ONE, |texture| {
            Vec3::from(texture.sample(mesh.uv_at(receiver.triangle as usize, receiver.barycentric.map(f64::from))))
        });
        Self {
            base_color: (*base_color * texel).as_dvec3(),
            metallic: f64::from(*metallic),
            roughness: f64::from(*roughness),
        }
    }

    /// π times the radiance along the ray that `mirrored` is the mirror of, per irradiance of a light. Both parts together never send
    /// out more than comes in.
    fn phong(&self, light: &AreaLight, receiver: &Receiver, mirrored: DVec3) -> DVec3 {
        let specular = DVec3::splat(DIELECTRIC).lerp(self.base_color, self.metallic);
        let diffuse = self.base_color * (1.0 - self.metallic) * (DVec3::ONE - specular);
        diffuse + specular * mean_lobe(light, receiver, mirrored, exponent(self.roughness))
    }
}

/// Phong's exponent for a roughness of glTF's: that of the lobe around the mirrored direction which is as wide as the microfacets'
/// around the half vector, 2/α² − 2 with α = r² (Walter 2007, "Microfacet Models for Refraction"), seen at twice the angle. 0 where
/// r is 1: Lambertian.
fn exponent(roughness: f64) -> f64 {
    let alpha = roughness.max(LEAST_ROUGHNESS).powi(2);
    0.5 / (alpha * alpha) - 0.5
}

/// The mean of (n + 2)/2 · cosⁿα over a light, by what each part of it adds to E₀.
fn mean_lobe(light: &AreaLight, receiver: &Receiver, mirrored: DVec3, exponent: f64) -> f64 {
    let Some(emitter) = light.emitter(receiver.position) else { return 0.0 };
    let lobe = |to_light: DVec3, n: f64| 0.5 * (n + 2.0) * mirrored.dot(to_light.normalize()).max(0.0).powf(n);
    if emitter.domain == Domain::Point {
        return lobe(emitter.center, exponent);
    }
    // Cells about as long as wide, as many as those of a square.
    let [u, v] = [emitter.half_u.length(), emitter.half_v.length()];
    let columns = (POINTS_A_SIDE * (u / v).sqrt()).round().clamp(1.0, POINTS_A_SIDE * POINTS_A_SIDE);
    let rows = (POINTS_A_SIDE * POINTS_A_SIDE / columns).round();
    let step = (2.0 * u / columns).max(2.0 * v / rows);
    // cosⁿα is a Gaussian of deviation 1/√n, and points are a step apart from where the mirrored direction meets the light's plane.
    let (near, far) = (emitter.center.dot(emitter.normal), mirrored.dot(emitter.normal));
    let farthest = emitter.center.length() + u + v;
    let distance = if far < 0.0 { (near / far).min(farthest) } else { farthest };
    let n = exponent.min((distance / (LEAST_DEVIATION * step)).powi(2));
    let (mut sum, mut weights) = (0.0, 0.0);
    for row in 0..rows as u32 {
        for column in 0..columns as u32 {
            let square = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5) / DVec2::new(columns, rows);
            let to_light = emitter.at(on_domain(emitter.domain, square));
            let weight = sample_weight(light, &emitter, receiver, to_light);
            if weight > 0.0 {
                sum += weight * lobe(to_light, n);
                weights += weight;
            }
        }
    }
    // What little of the light sheds anything may lie between the points.
    if weights > 0.0 { sum / weights } else { lobe(emitter.center, n) }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use glam::{DAffine3, DMat3};

    use super::*;
    use crate::geometry::irradiance::unshadowed;
    use crate::receivers::UNKNOWN;
    use crate::scene::light::Shape;

    /// On the floor y = 0.
    fn receiver(x: f64, z: f64) -> Receiver {
        Receiver {
            position: DVec3::new(x, 0.0, z),
            position_error: 0.0,
            normal: DVec3::Y,
            shading_normal: DVec3::Y,
            depth: 1.0,
            instance: UNKNOWN,
            triangle: UNKNOWN,
            barycentric: [0.0; 2],
        }
    }

    /// A light whose local +Z is given.
    fn light(shape: Shape, at: DVec3, z: DVec3) -> AreaLight {
        let x = z.any_orthonormal_vector();
        AreaLight::new("light", DAffine3::from_mat3_translation(DMat3::from_cols(x, z.cross(x), z), at), shape)
    }

    fn at_angle(angle: f64) -> DVec3 {
        DVec3::new(angle.sin(), angle.cos(), 0.0)
    }

    #[test]
    fn a_lobe_sends_out_what_comes_in() {
        for roughness in [1.0, 0.7, 0.4, 0.2, 0.1] {
            let n = exponent(roughness);
            // Towards the normal; by the midpoint rule over suns all around it.
            let steps = 20_000;
            let ring = |step: u32| {
                let angle = (f64::from(step) + 0.5) * FRAC_PI_2 / f64::from(steps);
                let sun = light(Shape::Sun { angle: 0.0 }, DVec3::ZERO, at_angle(angle));
                mean_lobe(&sun, &receiver(0.0, 0.0), DVec3::Y, n) * angle.cos() * angle.sin()
            };
            let sum = 2.0 * FRAC_PI_2 / f64::from(steps) * (0..steps).map(ring).sum::<f64>();
            assert!((sum - 1.0).abs() < 1e-4, "roughness {roughness}: {sum}");
        }
        assert_eq!(exponent(1.0), 0.0);
        assert!(exponent(0.0) > 1e5 && exponent(0.0).is_finite());
    }

    #[test]
    fn a_wide_lobe_is_the_integral_over_the_light() {
        let mirrored = DVec3::new(0.3, 0.8, -0.4).normalize();
        for (x, z) in [(0.0, 0.0), (0.7, -0.4), (2.0, 1.0)] {
            let place = receiver(x, z);
            let size = DVec2::new(1.2, 0.8);
            let lamp = light(Shape::Rect { size }, DVec3::new(0.2, 1.5, 0.1), DVec3::Y);
            let emitter = lamp.emitter(place.position).expect("it faces the floor");
            let (mut sum, mut whole, n) = (0.0, 0.0, exponent(0.5));
            for i in 0..400 {
                for j in 0..400 {
                    let uv = DVec2::new(f64::from(2 * i - 399), f64::from(2 * j - 399)) / 400.0;
                    let to = emitter.center + uv.x * emitter.half_u + uv.y * emitter.half_v;
                    // cos cos / r², both cosines y/r.
                    let weight = to.y * to.y / to.length_squared().powi(2);
                    sum += weight * 0.5 * (n + 2.0) * (mirrored.dot(to) / to.length()).max(0.0).powf(n);
                    whole += weight;
                }
            }
            let got = mean_lobe(&lamp, &place, mirrored, n);
            // The midpoint rule's error along both sides: cells of 1.2/20 m from 1.4 m at least, and a lobe that bends by n of its peak.
            let error = 2.0 / 24.0 * (1.2 / 20.0 / 1.4f64).powi(2) * n * 0.5 * (n + 2.0);
            assert!((got - sum / whole).abs() < error, "{got} for {}, which may be off by {error}", sum / whole);
        }
    }

    #[test]
    fn a_mirror_shows_the_light_without_its_points() {
        // E/π times the mean lobe is the light's radiance, cos θ of the mirrored direction apart.
        for shape in [Shape::Rect { size: DVec2::splat(2.0) }, Shape::Rect { size: DVec2::new(16.0, 1.0) }] {
            let lamp = light(shape, DVec3::Y, DVec3::Y);
            for i in 0..60 {
                let place = receiver(0.002 * f64::from(i), 0.001 * f64::from(i));
                let seen = unshadowed(&lamp, &place).x / PI * mean_lobe(&lamp, &place, DVec3::Y, exponent(0.0));
                assert!((seen - 1.0).abs() < 0.02, "{shape:?} {i}: {seen}");
            }
            // What looks past it sees nothing of it.
            let beside = mean_lobe(&lamp, &receiver(0.0, 0.0), at_angle(-1.4).with_z(0.8).normalize(), exponent(0.0));
            assert!(beside < 1e-6, "{beside}");
        }
    }

    #[test]
    fn a_rough_surface_is_lambertian_and_none_shines_by_itself() {
        let lamp = light(Shape::Rect { size: DVec2::ONE }, DVec3::Y, DVec3::Y);
        for metallic in [0.0, 0.3, 1.0] {
            for color in [DVec3::ZERO, DVec3::new(0.2, 0.5, 0.9), DVec3::ONE] {
                let look = Look { base_color: color, metallic, roughness: 1.0 };
                let [one, other] =
                    [at_angle(0.0), at_angle(1.2)].map(|mirrored| look.phong(&lamp, &receiver(0.0, 0.0), mirrored));
                assert!(
                    (one - other).abs().max_element() < 1e-12 && one.max_element() <= 1.0,
                    "{look:?}: {one} {other}"
                );
            }
        }
    }
}
