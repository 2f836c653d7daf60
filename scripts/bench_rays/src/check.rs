//! Which side is right where the two differ: every triangle of the scene, without a hierarchy, in `f64`.

use std::fmt;

use glam::{DVec3, Vec3};
use penumbra::geometry::triangle::{Segment, crossing};
use penumbra::scene::Scene;
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::cases::{Bundle, EMBREE_OFFSET, Rays};

/// Most rays that are checked: each meets all triangles.
const MOST: usize = 128;

/// What became of the checked rays.
#[derive(Default)]
pub struct Check {
    differing: usize,
    agreeing: usize,
    /// Rays on which the exhaustive answer to our question is not ours. Should be none.
    ours_wrong: usize,
    /// Differing rays on which the exhaustive answer for Embree's own start and end is not Embree's: its rounding.
    embree_rounding: usize,
    /// Differing rays on which both are right: the step off the surface changes the answer.
    embree_offset: usize,
}

/// Checks some of the differing rays and as many others.
pub fn check(scene: &Scene, rays: &Rays, ours: &[bool], theirs: &[bool], differing: &[usize]) -> Check {
    let spread = |count: usize| (0..count.min(MOST)).map(move |i| i * count / count.min(MOST));
    let chosen: Vec<usize> = spread(differing.len()).map(|i| differing[i]).chain(spread(ours.len())).collect();
    let corners = corners(scene);
    let mut check = Check::default();
    for index in chosen {
        let at = rays.bundles.partition_point(|bundle| bundle.end <= index);
        let bundle = &rays.bundles[at];
        let (our_question, their_question) = exhaustive(&corners, rays, bundle, index);
        check.ours_wrong += usize::from(our_question != ours[index]);
        if ours[index] == theirs[index] {
            check.agreeing += 1;
        } else {
            check.differing += 1;
            check.embree_rounding += usize::from(their_question != theirs[index]);
            check.embree_offset += usize::from(their_question == theirs[index] && our_question == ours[index]);
        }
    }
    check
}

/// All triangles in scene space, with instance and triangle.
fn corners(scene: &Scene) -> Vec<([DVec3; 3], (u32, u32))> {
    let mut all = Vec::with_capacity(scene.triangle_count() as usize);
    for (i, instance) in scene.instances.iter().enumerate() {
        let mesh = &scene.meshes[instance.mesh];
        for triangle in 0..mesh.triangles.len() {
            let placed = mesh.corners(triangle).map(|corner| instance.scene_from_mesh.transform_point3(corner));
            all.push((placed, (i as u32, triangle as u32)));
        }
    }
    all
}

/// The answers to the two sides' questions.
fn exhaustive(corners: &[([DVec3; 3], (u32, u32))], rays: &Rays, bundle: &Bundle, index: usize) -> (bool, bool) {
    let ray = rays.shadow_ray(bundle, index);
    let our_segment = Segment {
        origin: ray.origin,
        direction: ray.to_light,
        origin_error: DVec3::splat(ray.origin_error),
        end_error: Some(DVec3::splat(ray.light_error)),
    };
    let direction = Vec3::from(rays.to_light_f32[index]).as_dvec3();
    let their_segment = Segment {
        origin: Vec3::from(bundle.origin_f32).as_dvec3(),
        direction: direction * (1.0 - EMBREE_OFFSET),
        origin_error: DVec3::ZERO,
        end_error: Some(DVec3::ZERO),
    };
    let ours =
        corners.par_iter().any(|(corners, source)| *source != ray.source && crossing(&our_segment, *corners).is_some());
    let theirs = corners.par_iter().any(|(corners, _)| crossing(&their_segment, *corners).is_some());
    (ours, theirs)
}

impl Check {
    pub fn to_json(&self) -> Value {
        json!({
            "differing": self.differing, "agreeing": self.agreeing, "ours_wrong": self.ours_wrong,
            "embree_rounding": self.embree_rounding, "embree_offset": self.embree_offset,
        })
    }
}

impl fmt::Display for Check {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(
            f,
            "checked without hierarchy: {} differing and {} other rays; ours wrong {}, Embree's rounding {}, Embree's offset {}",
            self.differing, self.agreeing, self.ours_wrong, self.embree_rounding, self.embree_offset
        )
    }
}
