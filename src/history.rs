//! What frames that follow each other know of one another: how the scene was posed, and what a technique has kept.

use std::any::Any;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use glam::{DAffine3, DVec2, DVec3, Vec3};

use crate::receivers::{Receiver, UNKNOWN};
use crate::scene::{AreaLight, Bounds, Camera, Scene};

/// The image that receivers are the pixels of.
#[derive(Debug, Clone, Copy)]
pub struct Shot<'a> {
    /// What sees them.
    pub camera: &'a Camera,
    /// Width and height of the image, pixels.
    pub size: [u32; 2],
    /// Pixels that the receivers go beyond the image, left and right, above and below.
    pub border: [u32; 2],
    /// Which of a pixel's receivers they are, where it has several.
    pub pass: u32,
    /// Where in each pixel they lie; (½, ½) is the middle.
    pub offset_px: DVec2,
    /// The frames before, if this is one of several.
    pub history: Option<&'a History>,
}

/// What is known of the frames before.
#[derive(Debug, Default)]
pub struct History {
    /// How all stood in the frame before; none in the first.
    pub previous: Option<Pose>,
    /// What was kept in the frame before, and what is kept for the next one.
    kept: Mutex<Memories>,
    keeping: Mutex<Memories>,
}

/// By pass and light.
type Memories = HashMap<(u32, String), Memory>;

type Memory = Box<dyn Any + Send>;

/// How a scene and its camera stood in a frame.
#[derive(Debug)]
pub struct Pose {
    /// The camera, in its scene's space.
    pub camera: Camera,
    /// See [`Shot::size`].
    pub size: [u32; 2],
    origin_world: DVec3,
    meshes: Vec<PosedMesh>,
    instances: Vec<(usize, DAffine3)>,
    lights: Vec<AreaLight>,
}

#[derive(Debug)]
struct PosedMesh {
    positions: Arc<[Vec3]>,
    bounds: Bounds,
    triangles: usize,
}

/// How far roundings of a pose that stands still may go, relative to what is added: files are read anew for each frame, and their
/// origins may move.
const ROUNDING: f64 = 1e-12;

impl History {
    /// What was kept in the frame before under a light's name.
    pub fn take<T: 'static>(&self, pass: u32, light: &str) -> Option<T> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.remove(&(pass, light.to_owned()))?.downcast().ok().map(|memory| *memory)
    }

    /// Keeps something for the next frame.
    pub fn keep<T: Any + Send>(&self, pass: u32, light: &str, memory: T) {
        let mut keeping = self.keeping.lock().unwrap_or_else(PoisonError::into_inner);
        keeping.insert((pass, light.to_owned()), Box::new(memory));
    }

    /// Ends a frame. What was kept before and not again is forgotten.
    pub fn advance(&mut self, scene: &Scene, camera: &Camera, size: [u32; 2]) {
        let keeping = self.keeping.get_mut().unwrap_or_else(PoisonError::into_inner);
        *self.kept.get_mut().unwrap_or_else(PoisonError::into_inner) = std::mem::take(keeping);
        self.previous = Some(Pose::of(scene, camera, size, self.previous.as_ref()));
    }
}

impl Pose {
    /// `before` spares looking at meshes again that stay.
    fn of(scene: &Scene, camera: &Camera, size: [u32; 2], before: Option<&Self>) -> Self {
        let posed = |(i, mesh): (usize, &crate::scene::Mesh)| {
            let known = before.and_then(|pose| pose.meshes.get(i));
            let same = known.filter(|known| {
                Arc::ptr_eq(&known.positions, &mesh.positions) && known.triangles == mesh.triangles.len()
            });
            PosedMesh {
                positions: Arc::clone(&mesh.positions),
                bounds: same.map_or_else(|| mesh.bounds(), |known| known.bounds),
                triangles: mesh.triangles.len(),
            }
        };
        Self {
            camera: camera.clone(),
            size,
            origin_world: scene.origin_world,
            meshes: scene.meshes.iter().enumerate().map(posed).collect(),
            instances: scene.instances.iter().map(|i| (i.mesh, i.scene_from_mesh)).collect(),
            lights: scene.lights.clone(),
        }
    }

    /// Whether a scene is this one, moved at most: the same instances of the same triangles.
    pub fn is_of(&self, scene: &Scene) -> bool {
        let same_mesh = |(posed, mesh): (&PosedMesh, &crate::scene::Mesh)| {
            posed.triangles == mesh.triangles.len() && posed.positions.len() == mesh.positions.len()
        };
        self.meshes.len() == scene.meshes.len()
            && self.instances.len() == scene.instances.len()
            && self.meshes.iter().zip(&scene.meshes).all(same_mesh)
            && self.instances.iter().zip(&scene.instances).all(|(posed, instance)| posed.0 == instance.mesh)
    }

    /// What takes positions of this pose's scene space to those of a scene's.
    fn shift_to(&self, scene: &Scene) -> DVec3 {
        self.origin_world - scene.origin_world
    }

    /// By instance of a scene of which this is an earlier pose, whether it has moved or changed its form since.
    pub fn moved(&self, scene: &Scene) -> Vec<bool> {
        let deformed: Vec<bool> = self
            .meshes
            .iter()
            .zip(&scene.meshes)
            .map(|(posed, mesh)| !Arc::ptr_eq(&posed.positions, &mesh.positions) && posed.positions != mesh.positions)
            .collect();
        let moved = |((mesh, posed), instance): (&(usize, DAffine3), &crate::scene::Instance)| {
            deformed[*mesh] || !self.is_placed_alike(posed, &instance.scene_from_mesh, scene)
        };
        self.instances.iter().zip(&scene.instances).map(moved).collect()
    }

    /// Whether a transform of this pose is one of a later scene but for roundings.
    fn is_placed_alike(&self, posed: &DAffine3, now: &DAffine3, scene: &Scene) -> bool {
        let shifted = posed.translation + self.shift_to(scene);
        let magnitude = now.translation.abs() + self.origin_world.abs() + scene.origin_world.abs();
        let is_near = |a: DVec3, b: DVec3, magnitude: DVec3| (a - b).abs().cmple(ROUNDING * magnitude).all();
        let axes = [0, 1, 2].map(|i| (posed.matrix3.col(i), now.matrix3.col(i)));
        is_near(shifted, now.translation, magnitude)
            && axes.iter().all(|&(a, b)| is_near(a, b, DVec3::splat(b.abs().max_element())))
    }

    /// Whether the camera and the image are as they were.
    pub fn has_camera(&self, scene: &Scene, camera: &Camera, size: [u32; 2]) -> bool {
        self.size == size
            && self.camera.projection == camera.projection
            && self.is_placed_alike(&self.camera.scene_from_camera, &camera.scene_from_camera, scene)
    }

    /// Where a receiver was, in the scene space of its scene now, and its normal there.
    pub fn receiver(&self, scene: &Scene, receiver: &Receiver) -> (DVec3, DVec3) {
        let unmoved = (receiver.position, receiver.normal);
        if receiver.instance == UNKNOWN {
            return unmoved;
        }
        let (mesh, posed) = &self.instances[receiver.instance as usize];
        let corners_now = scene.meshes[*mesh].corners(receiver.triangle as usize);
        let indices = scene.meshes[*mesh].triangles[receiver.triangle as usize];
        let corners = indices.map(|index| self.meshes[*mesh].positions[index as usize].as_dvec3());
        let now = &scene.instances[receiver.instance as usize].scene_from_mesh;
        if corners == corners_now && self.is_placed_alike(posed, now, scene) {
            return unmoved;
        }
        let placed = |scene_from_mesh: &DAffine3, [a, b, c]: [DVec3; 3]| {
            let [u, v] = receiver.barycentric.map(f64::from);
            let (ab, ac) = (b - a, c - a);
            let normal = (scene_from_mesh.matrix3 * ab).cross(scene_from_mesh.matrix3 * ac);
            (scene_from_mesh.transform_point3(a + u * ab + v * ac), normal)
        };
        let ((before, normal), (after, normal_now)) = (placed(posed, corners), placed(now, corners_now));
        // The same side of the triangle; what its weights round is in both places.
        let side = if normal_now.dot(receiver.normal) < 0.0 { -1.0 } else { 1.0 };
        let normal = (side * normal).try_normalize().unwrap_or(receiver.normal);
        (receiver.position + (before + self.shift_to(scene) - after), normal)
    }

    /// The camera of this pose, in the space of a later scene.
    pub fn camera_in(&self, scene: &Scene) -> Camera {
        let mut camera = self.camera.clone();
        camera.scene_from_camera.translation += self.shift_to(scene);
        camera
    }

    /// A light of this pose, in the space of a later scene.
    pub fn light_in(&self, scene: &Scene, name: &str) -> Option<AreaLight> {
        let mut light = self.lights.iter().find(|light| light.name == name)?.clone();
        light.scene_from_light.translation += self.shift_to(scene);
        Some(light)
    }

    /// Bounds of an instance of this pose, in the space of a later scene.
    pub fn bounds_in(&self, scene: &Scene, instance: usize) -> Bounds {
        let (mesh, posed) = &self.instances[instance];
        let shifted = DAffine3 { translation: posed.translation + self.shift_to(scene), ..*posed };
        self.meshes[*mesh].bounds.transformed(&shifted)
    }
}
