//! What is measured: scenes, cameras, lights, and the rays between receivers and light samples.

use std::path::Path;
use std::time::Instant;

use glam::{DVec2, DVec3};
use penumbra::geometry::bvh::{SceneBvh, ShadowRay};
use penumbra::progress::Progress;
use penumbra::receivers::{Receiver, Receivers};
use penumbra::sampling::{Pattern, Sampler};
use penumbra::scene::additions::{LightSpec, add_floor, add_light};
use penumbra::scene::{AreaLight, Camera, LoadOptions, Scene, Shape, gltf};
use rayon::prelude::*;

use crate::embree;
use crate::judged::kitchen_camera;

/// Image size, pixels.
pub const SIZE: [u32; 2] = [640, 480];

/// Light samples a receiver.
pub const SAMPLES: u32 = 16;

/// The scenes, by file below the folder of scenes.
pub const SCENES: [(&str, &str); 3] = [
    ("bunny", "stanford-bunny/stanford-bunny.glb"),
    ("buddha", "happy-buddha/happy-buddha.glb"),
    ("kitchen", "country-kitchen/country-kitchen.glb"),
];

/// Side of a light relative to the automatic one's.
pub const LIGHTS: [(&str, f64); 3] = [("small", 0.1), ("medium", 1.0), ("huge", 4.0)];

/// A loaded scene with what looks at it and what lights it.
pub struct Case {
    pub scene: Scene,
    pub camera: Camera,
    /// The medium light; lights of other sizes are scaled from it.
    pub light: AreaLight,
    pub load_ms: f64,
}

/// Loads a scene: the kitchen as its author's camera sees it with a rect light below the ceiling; others on a floor, framed
/// from the front, with a rect light from above.
pub fn load(name: &str, path: &Path) -> penumbra::Result<Case> {
    let start = Instant::now();
    let mut scene = gltf::load(path, LoadOptions::default())?;
    let load_ms = 1e3 * start.elapsed().as_secs_f64();
    let is_room = name == "kitchen";
    let aspect = f64::from(SIZE[0]) / f64::from(SIZE[1]);
    let camera = if is_room { kitchen_camera(&scene, aspect) } else { Camera::framing(&scene.bounds(), aspect) };
    add_light(&mut scene, &LightSpec::Auto, Some(&camera))?;
    if !is_room {
        add_floor(&mut scene, None)?;
    }
    let light = scene.lights[0].clone();
    Ok(Case { scene, camera, light, load_ms })
}

/// A light of another size.
pub fn resized(light: &AreaLight, factor: f64) -> AreaLight {
    let Shape::Rect { size } = light.shape else { panic!("the automatic light is a rectangle") };
    AreaLight { shape: Shape::Rect { size: factor * size }, ..light.clone() }
}

/// Embree's scene: each instance relative to a place in scene space, rounded to `f32`.
pub fn flatten(scene: &Scene, from: DVec3) -> Vec<embree::Mesh> {
    scene
        .instances
        .par_iter()
        .map(|instance| {
            let mesh = &scene.meshes[instance.mesh];
            let place =
                |p: &glam::Vec3| (instance.scene_from_mesh.transform_point3(p.as_dvec3()) - from).as_vec3().to_array();
            embree::Mesh { positions: mesh.positions.iter().map(place).collect(), triangles: mesh.triangles.clone() }
        })
        .collect()
}

/// A receiver with the light samples above its horizon.
pub struct Bundle {
    pub receiver: Receiver,
    pub light_error: f64,
    /// Origin of Embree's rays, relative to the scene's origin.
    pub origin_f32: [f32; 3],
    /// The range of its rays.
    pub first: usize,
    pub end: usize,
}

/// All rays of a case, with what each side needs precomputed.
#[derive(Default)]
pub struct Rays {
    pub bundles: Vec<Bundle>,
    /// From the receiver to the light sample.
    pub to_light: Vec<DVec3>,
    /// From the moved receiver to the light sample.
    pub to_light_f32: Vec<[f32; 3]>,
}

impl Rays {
    /// The rays that the technique `rays` traces with Sobol' samples.
    pub fn new(receivers: &Receivers, light: &AreaLight) -> Self {
        let mut rays = Self::default();
        for (number, receiver) in receivers.pixels.iter().enumerate() {
            let Some(receiver) = receiver else { continue };
            let Some(emitter) = light.emitter(receiver.position) else { continue };
            let sampler = Sampler::new(Pattern::Sobol, SAMPLES, number as u32, 0);
            let magnitude =
                emitter.center.abs() + emitter.half_u.abs() + emitter.half_v.abs() + receiver.position.abs();
            let origin_f32 = embree_origin(receiver, DVec3::ZERO);
            let origin_moved = glam::Vec3::from(origin_f32).as_dvec3();
            let first = rays.to_light.len();
            for index in 0..SAMPLES {
                let to_light = emitter.at(sampler.on_emitter(index, &emitter));
                if receiver.normal.dot(to_light) <= 0.0 {
                    continue;
                }
                let light_point = receiver.position + to_light;
                rays.to_light.push(to_light);
                rays.to_light_f32.push((light_point - origin_moved).as_vec3().to_array());
            }
            rays.bundles.push(Bundle {
                receiver: *receiver,
                light_error: 8.0 * f64::EPSILON * magnitude.max_element(),
                origin_f32,
                first,
                end: rays.to_light.len(),
            });
        }
        rays
    }

    /// A ray of ours.
    #[inline]
    pub fn shadow_ray(&self, bundle: &Bundle, index: usize) -> ShadowRay {
        ShadowRay {
            origin: bundle.receiver.position,
            origin_error: bundle.receiver.position_error,
            to_light: self.to_light[index],
            light_error: bundle.light_error,
            distant: false,
            source: (bundle.receiver.instance, bundle.receiver.triangle),
        }
    }
}

/// Embree's rays start this far off the surface, relative to the largest coordinate, and end this far before the light,
/// relative to their length: eight units in the last place of `f32`.
pub const EMBREE_OFFSET: f64 = 1.0 / 1_048_576.0;

/// Where Embree's rays start, relative to the place that its scene is relative to.
pub fn embree_origin(receiver: &Receiver, from: DVec3) -> [f32; 3] {
    let position = receiver.position - from;
    let offset = EMBREE_OFFSET * position.abs().max_element();
    (position + offset * receiver.normal).as_vec3().to_array()
}

/// What the camera sees.
pub fn receivers(case: &Case, bvh: &SceneBvh) -> penumbra::Result<Receivers> {
    Receivers::find(bvh, &case.camera, SIZE, DVec2::splat(0.5), &Progress::default())
}
