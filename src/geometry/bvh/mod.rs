//! The scene's two-level hierarchy and the questions asked of it: is a segment blocked, what does a camera ray see.
//!
//! Meshes used once are built into one tree in scene space; a mesh used several times has one tree in its own space, entered
//! once an instance. Trees rule out in `f32` (see [`wide`]); every crossing is decided in `f64` in the mesh's own space,
//! relative to its lowest corner, by [`crate::geometry::triangle`].

mod kernel;
mod pyramid;
pub mod wide;

use glam::{DAffine3, DMat3, DVec2, DVec3};
use obvhs::aabb::Aabb;
use rayon::prelude::*;

use super::triangle::{Crossing, Segment, crossing, plane_crossing};
use crate::scene::camera::CameraRay;
use crate::scene::{Bounds, Camera, Instance, Mesh, Projection, Scene};
use kernel::{NONE, Ray, Stack};
pub use kernel::{exponent_of, power_of_two};
pub use pyramid::Plane;
use wide::{Leaf, Tree, WIDTH};

/// Reusable memory of queries, one a thread.
#[derive(Debug, Default)]
pub struct Scratch {
    top: Stack,
    group: Stack,
}

/// A hierarchy over some of a scene's instances.
#[derive(Debug)]
pub struct SceneBvh<'a> {
    scene: &'a Scene,
    mesh_bounds: Vec<Bounds>,
    /// One for each of the scene's instances.
    frames: Vec<Frame>,
    groups: Vec<Group>,
    entries: Vec<Entry>,
    /// For each instance held in a group in scene space: that group and the number of its first triangle there.
    placed: Vec<Option<(u32, u32)>>,
    top: Tree<u32>,
    top_space: Normalized,
    /// Which instances are in it.
    held: Vec<bool>,
    /// Triangles in trees, each counted as often as it is stored.
    pub stored_triangles: u64,
}

/// Scene space as an instance's mesh sees it: relative to the mesh's lowest corner.
#[derive(Debug, Clone, Copy)]
struct Frame {
    mesh_from_scene: DMat3,
    /// Absolute values of `mesh_from_scene`: how errors grow.
    growth: DMat3,
    /// Bounds how far going to the scene and back is from staying, per coordinate in the mesh.
    inverse_error: DMat3,
    /// The mesh's lowest corner, scene space and mesh space.
    anchor_scene: DVec3,
    anchor_mesh: DVec3,
    /// Bounds on the errors of `anchor_scene`'s coordinates.
    anchor_error: DVec3,
}

/// Coordinates scaled by a power of two into [0, 1], relative to an origin.
#[derive(Debug, Clone, Copy)]
struct Normalized {
    origin: DVec3,
    scale: f64,
    /// Bound on the rounding of coordinates in this space that is due to the magnitude of `origin`.
    origin_error: f64,
}

/// One tree of triangles.
#[derive(Debug)]
struct Group {
    tree: Tree<Leaf>,
    space: Normalized,
    /// In scene space, or in mesh space relative to the mesh's lowest corner.
    bounds: Bounds,
    /// The instances it holds (any one of them for a shared mesh) and the number of each one's first triangle.
    parts: Vec<(u32, u32)>,
}

/// A group as placed in the scene.
#[derive(Debug, Clone, Copy)]
struct Entry {
    group: u32,
    /// The instance for a shared mesh; none for the group in scene space.
    instance: Option<u32>,
}

/// A shadow ray in scene space.
#[derive(Debug, Clone, Copy)]
pub struct ShadowRay {
    /// The receiver.
    pub origin: DVec3,
    /// Bound on the distance of `origin` from its surface.
    pub origin_error: f64,
    /// To the light point; a direction of any length when `distant`.
    pub to_light: DVec3,
    /// Bound on the error of each coordinate of the light point.
    pub light_error: f64,
    /// The light is at infinity.
    pub distant: bool,
    /// The receiver's own instance and triangle, which can't block it.
    pub source: (u32, u32),
}

/// What a camera ray sees first.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Instance and triangle.
    pub instance: u32,
    /// Index into its mesh's triangles.
    pub triangle: u32,
    /// Where.
    pub crossing: Crossing,
}

/// A surface point from its triangle.
#[derive(Debug, Clone, Copy)]
pub struct SurfacePoint {
    /// Scene space.
    pub position: DVec3,
    /// Bound on the distance of `position` from the triangle.
    pub error: f64,
    /// Unit geometric normal, scene space, on the triangle's front (counter-clockwise in its file).
    pub normal: DVec3,
}

impl<'a> SceneBvh<'a> {
    /// A hierarchy that holds nothing yet.
    pub fn new(scene: &'a Scene) -> Self {
        let mesh_bounds: Vec<Bounds> = scene.meshes.par_iter().map(Mesh::bounds).collect();
        let frames = scene.instances.iter().map(|instance| Frame::new(instance, &mesh_bounds[instance.mesh])).collect();
        Self {
            scene,
            mesh_bounds,
            frames,
            groups: Vec::new(),
            entries: Vec::new(),
            placed: vec![None; scene.instances.len()],
            top: Tree::default(),
            top_space: Normalized::around(Bounds::EMPTY),
            held: vec![false; scene.instances.len()],
            stored_triangles: 0,
        }
    }

    /// Adds the instances that `wanted` selects and that it does not hold yet; trees are built in parallel.
    pub fn add(&mut self, wanted: impl Fn(usize) -> bool) {
        let scene = self.scene;
        let chosen: Vec<u32> = (0..scene.instances.len())
            .filter(|&i| !self.held[i] && !scene.meshes[scene.instances[i].mesh].triangles.is_empty() && wanted(i))
            .map(|i| i as u32)
            .collect();
        if chosen.is_empty() {
            return;
        }
        let mesh_of = |instance: u32| scene.instances[instance as usize].mesh;
        let mut uses = vec![0u32; scene.meshes.len()];
        for &i in &chosen {
            self.held[i as usize] = true;
            uses[mesh_of(i)] += 1;
        }
        // A mesh used once is part of one group in scene space, others have a group each.
        let (single, shared): (Vec<u32>, Vec<u32>) = chosen.iter().partition(|&&i| uses[mesh_of(i)] == 1);
        let first_group = self.groups.len() as u32;
        let mut groups_parts = Vec::new();
        if !single.is_empty() {
            self.entries.push(Entry { group: first_group, instance: None });
            groups_parts.push((single, true));
        }
        let mut group_of_mesh = vec![None; scene.meshes.len()];
        for &i in &shared {
            let group = *group_of_mesh[mesh_of(i)].get_or_insert_with(|| {
                groups_parts.push((vec![i], false));
                first_group + groups_parts.len() as u32 - 1
            });
            self.entries.push(Entry { group, instance: Some(i) });
        }
        for (group, (parts, _)) in groups_parts.iter().enumerate().filter(|(_, (_, in_scene_space))| *in_scene_space) {
            let mut first = 0u32;
            for &i in parts {
                self.placed[i as usize] = Some((first_group + group as u32, first));
                first += scene.meshes[mesh_of(i)].triangles.len() as u32;
            }
        }
        let groups: Vec<Group> = groups_parts
            .into_par_iter()
            .map(|(parts, in_scene_space)| Group::build(self, &parts, in_scene_space))
            .collect();
        self.stored_triangles += groups.iter().map(|group| group.triangle_count(scene)).sum::<u64>();
        self.groups.extend(groups);

        let boxes: Vec<Bounds> = self
            .entries
            .iter()
            .map(|entry| match entry.instance {
                None => self.groups[entry.group as usize].bounds,
                Some(i) => self.instance_bounds(i as usize),
            })
            .collect();
        self.top_space = Normalized::around(boxes.iter().copied().fold(Bounds::EMPTY, Bounds::union));
        let box_of = |entry: u32| self.top_space.aabb(&boxes[entry as usize]);
        self.top = Tree::build(boxes.len() as u32, box_of, 1, |entries| entries[0]);
    }

    /// The box of an instance, scene space.
    pub fn instance_bounds(&self, instance: usize) -> Bounds {
        let Instance { mesh, scene_from_mesh, .. } = &self.scene.instances[instance];
        self.mesh_bounds[*mesh].transformed(scene_from_mesh)
    }

    /// The scene it is over.
    pub fn scene(&self) -> &'a Scene {
        self.scene
    }

    /// Bytes held by the trees.
    pub fn bytes(&self) -> usize {
        self.top.bytes() + self.groups.iter().map(|group| group.tree.bytes()).sum::<usize>()
    }

    /// Whether an instance that `blocks` admits blocks the open segment from the receiver to the light point.
    pub fn is_blocked(&self, ray: &ShadowRay, scratch: &mut Scratch, blocks: impl Fn(u32) -> bool) -> bool {
        let t_max = if ray.distant { f64::INFINITY } else { 1.0 };
        let Scratch { top, group: group_stack } = scratch;
        self.any_entry(ray.origin, ray.to_light, t_max, top, |entry| {
            let group = &self.groups[entry.group as usize];
            let group_ray = self.group_ray(entry, ray.origin, ray.to_light, t_max);
            let source = self.primitive_of(entry, ray.source);
            kernel::any_triangle(&group.tree, &group_ray, source, group_stack, |primitive| {
                let (instance, triangle) = group.locate(entry, primitive);
                if !blocks(instance) {
                    return false;
                }
                let segment = self.segment(instance, ray);
                self.solid_crossing(instance, triangle, &segment).is_some()
            })
        })
    }

    /// A shadow ray in the space of an instance's mesh, relative to the mesh's lowest corner.
    #[inline]
    pub fn segment(&self, instance: u32, ray: &ShadowRay) -> Segment {
        let end_error = (!ray.distant).then_some(ray.light_error);
        self.frames[instance as usize].segment(ray.origin, ray.origin_error, ray.to_light, end_error)
    }

    /// The corners of an instance's triangle in its mesh's space, relative to the mesh's lowest corner.
    #[inline]
    pub fn corners(&self, instance: u32, triangle: u32) -> [DVec3; 3] {
        let mesh = &self.scene.meshes[self.scene.instances[instance as usize].mesh];
        let anchor = self.frames[instance as usize].anchor_mesh;
        mesh.corners(triangle as usize).map(|corner| corner - anchor)
    }

    /// The first surface along `origin + t · direction` for `t` in `[t_min, t_max]`; equal distances go to the lowest
    /// instance, then triangle.
    pub fn first_hit(
        &self,
        origin: DVec3,
        direction: DVec3,
        t_min: f64,
        t_max: f64,
        scratch: &mut Scratch,
    ) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        let Scratch { top, group: group_stack } = scratch;
        self.any_entry(origin, direction, t_max, top, |entry| {
            let group = &self.groups[entry.group as usize];
            let reach = best.map_or(t_max, |hit| hit.crossing.t);
            let group_ray = self.group_ray(entry, origin, direction, reach);
            kernel::nearest_triangle(&group.tree, &group_ray, group_stack, |primitive| {
                let (instance, triangle) = group.locate(entry, primitive);
                let frame = &self.frames[instance as usize];
                let segment = frame.segment(origin, 0.0, direction, None);
                let crossing = self.solid_crossing(instance, triangle, &segment)?;
                let key = (crossing.t, instance, triangle);
                let nearer = best.is_none_or(|hit| key < (hit.crossing.t, hit.instance, hit.triangle));
                (nearer && crossing.t >= t_min && crossing.t <= t_max).then(|| {
                    best = Some(Hit { instance, triangle, crossing });
                    crossing.t
                })
            });
            false
        });
        best
    }

    /// Where a line meets the plane of a triangle; none where it runs along it.
    pub fn plane_crossing(&self, instance: u32, triangle: u32, origin: DVec3, direction: DVec3) -> Option<Crossing> {
        let segment = self.frames[instance as usize].segment(origin, 0.0, direction, None);
        plane_crossing(&segment, self.corners(instance, triangle))
    }

    /// The point of a triangle with the given weights of its second and third corner.
    pub fn surface_point(&self, instance: u32, triangle: u32, barycentric: [f64; 2]) -> SurfacePoint {
        let frame = &self.frames[instance as usize];
        let linear = self.scene.instances[instance as usize].scene_from_mesh.matrix3;
        let mesh = &self.scene.meshes[self.scene.instances[instance as usize].mesh];
        let [a, b, c] = mesh.corners(triangle as usize).map(|corner| corner - frame.anchor_mesh);
        let (ab, ac) = (b - a, c - a);
        let local = a + barycentric[0] * ab + barycentric[1] * ac;
        let offset = linear * local;
        // Roundings of the interpolation and of the transform, each relative to the magnitudes added.
        let magnitude = absolute(&linear) * a.abs().max(b.abs()).max(c.abs());
        let error = 16.0 * f64::EPSILON * (magnitude + frame.anchor_scene.abs()).element_sum()
            + frame.anchor_error.max_element();
        // The cofactor matrix maps normals, mirrored transforms included.
        let front = (linear * ab).cross(linear * ac);
        // Scaled first, for a tiny triangle's squared length is no normal number.
        let front = front / front.abs().max_element();
        SurfacePoint { position: frame.anchor_scene + offset, error, normal: front.normalize() }
    }

    /// Unit interpolated normal, scene space, on the side that the file gives it; none for a flat mesh.
    pub fn shading_normal(&self, instance: u32, triangle: u32, barycentric: [f64; 2]) -> Option<DVec3> {
        let mesh = &self.scene.meshes[self.scene.instances[instance as usize].mesh];
        let normals = mesh.normals.as_ref()?;
        let [a, b, c] = mesh.triangles[triangle as usize].map(|index| normals[index as usize].as_dvec3());
        let local = a + barycentric[0] * (b - a) + barycentric[1] * (c - a);
        (self.frames[instance as usize].mesh_from_scene.transpose() * local).try_normalize()
    }

    fn any_entry(
        &self,
        origin: DVec3,
        direction: DVec3,
        t_max: f64,
        stack: &mut Stack,
        mut visit: impl FnMut(&Entry) -> bool,
    ) -> bool {
        // A lone group's root node tells as much as its box.
        if let [entry] = self.entries.as_slice() {
            return visit(entry);
        }
        let ray = self.top_space.ray(origin, direction, t_max);
        kernel::any(&self.top, &ray, stack, |&entry| visit(&self.entries[entry as usize]))
    }

    #[inline]
    fn group_ray(&self, entry: &Entry, origin: DVec3, direction: DVec3, t_max: f64) -> Ray {
        let space = &self.groups[entry.group as usize].space;
        match entry.instance {
            None => space.ray(origin, direction, t_max),
            Some(instance) => {
                let segment = self.frames[instance as usize].segment(origin, 0.0, direction, None);
                Ray::new(
                    segment.origin * space.scale,
                    segment.origin_error.max_element() * space.scale,
                    segment.direction * space.scale,
                    t_max,
                )
            }
        }
    }

    /// The number in a group of a triangle of an instance, or [`NONE`] where it is not in it.
    #[inline]
    fn primitive_of(&self, entry: &Entry, (instance, triangle): (u32, u32)) -> u32 {
        match entry.instance {
            Some(own) if own == instance => triangle,
            Some(_) => NONE,
            None => match self.placed.get(instance as usize) {
                Some(&Some((group, first))) if group == entry.group => first.checked_add(triangle).unwrap_or(NONE),
                _ => NONE,
            },
        }
    }

    fn solid_crossing(&self, instance: u32, triangle: u32, segment: &Segment) -> Option<Crossing> {
        let crossing = crossing(segment, self.corners(instance, triangle))?;
        let mesh = &self.scene.meshes[self.scene.instances[instance as usize].mesh];
        let cutout = mesh.material.and_then(|material| self.scene.materials[material].cutout.as_ref());
        match cutout {
            Some(cutout) if !cutout.is_solid(mesh.uv_at(triangle as usize, crossing.barycentric)) => None,
            _ => Some(crossing),
        }
    }
}

impl Frame {
    fn new(instance: &Instance, mesh_bounds: &Bounds) -> Self {
        let DAffine3 { matrix3, translation } = instance.scene_from_mesh;
        let anchor_mesh = if mesh_bounds.is_empty() { DVec3::ZERO } else { mesh_bounds.min };
        let mesh_from_scene = matrix3.inverse();
        let anchor_magnitude = absolute(&matrix3) * anchor_mesh.abs() + translation.abs();
        let residual = absolute(&(DMat3::IDENTITY - mesh_from_scene * matrix3));
        Self {
            mesh_from_scene,
            growth: absolute(&mesh_from_scene),
            inverse_error: residual + absolute(&mesh_from_scene) * absolute(&matrix3) * (8.0 * f64::EPSILON),
            anchor_scene: instance.scene_from_mesh.transform_point3(anchor_mesh),
            anchor_mesh,
            anchor_error: 4.0 * f64::EPSILON * anchor_magnitude,
        }
    }

    /// A segment in the mesh's space, relative to the mesh's lowest corner, with its errors, axis by axis: what lies along an
    /// axis keeps the precision that it has.
    #[inline]
    fn segment(&self, origin: DVec3, origin_error: f64, direction: DVec3, end_error: Option<f64>) -> Segment {
        const ROUNDING: f64 = 4.0 * f64::EPSILON;
        let relative = origin - self.anchor_scene;
        let origin_mesh = self.mesh_from_scene * relative;
        let direction_mesh = self.mesh_from_scene * direction;
        let scene_error = self.anchor_error + ROUNDING * relative.abs();
        Segment {
            origin: origin_mesh,
            direction: direction_mesh,
            origin_error: self.growth * (scene_error + origin_error) + self.inverse_error * origin_mesh.abs(),
            end_error: end_error.map(|end_error| {
                self.growth * (scene_error + ROUNDING * direction.abs() + end_error)
                    + self.inverse_error * (origin_mesh.abs() + direction_mesh.abs())
            }),
        }
    }
}

impl Normalized {
    /// The space of a box. Its largest coordinate becomes a number in [1/2, 1).
    fn around(bounds: Bounds) -> Self {
        if bounds.is_empty() {
            return Self { origin: DVec3::ZERO, scale: 1.0, origin_error: 0.0 };
        }
        let scale = power_of_two(-exponent_of(bounds.size().max_element()) - 1);
        // Eight roundings of a point's coordinate and of the origin's; the former is at most a relative one plus the latter.
        let origin_error = 16.0 * f64::EPSILON * bounds.min.abs().max_element() * scale;
        Self { origin: bounds.min, scale, origin_error }
    }

    /// A ray of the space that this is relative to.
    #[inline]
    fn ray(&self, origin: DVec3, direction: DVec3, t_max: f64) -> Ray {
        Ray::new((origin - self.origin) * self.scale, self.origin_error, direction * self.scale, t_max)
    }

    /// A box in these coordinates, rounded outwards.
    fn aabb(&self, bounds: &Bounds) -> Aabb {
        let min = ((bounds.min - self.origin) * self.scale).to_array().map(round_down);
        let max = ((bounds.max - self.origin) * self.scale).to_array().map(|x| -round_down(-x));
        Aabb::new(min.into(), max.into())
    }
}

impl Group {
    fn build(bvh: &SceneBvh, instances: &[u32], in_scene_space: bool) -> Self {
        let scene = bvh.scene;
        let mut parts = Vec::with_capacity(instances.len());
        let mut count = 0u32;
        let mut bounds = Bounds::EMPTY;
        for &i in instances {
            let instance = &scene.instances[i as usize];
            parts.push((i, count));
            count += scene.meshes[instance.mesh].triangles.len() as u32;
            let mesh = bvh.mesh_bounds[instance.mesh];
            bounds = bounds.union(if in_scene_space {
                bvh.instance_bounds(i as usize)
            } else {
                Bounds { min: DVec3::ZERO, max: mesh.max - mesh.min }
            });
        }
        let space = Normalized::around(bounds);
        let corners = |primitive: u32| {
            let (i, first) = part_of(&parts, primitive);
            let instance = &scene.instances[i as usize];
            let frame = &bvh.frames[i as usize];
            scene.meshes[instance.mesh].corners((primitive - first) as usize).map(|corner| {
                let local = corner - frame.anchor_mesh;
                let placed = if in_scene_space {
                    instance.scene_from_mesh.matrix3 * local + (frame.anchor_scene - space.origin)
                } else {
                    local
                };
                placed * space.scale
            })
        };
        let unit = Normalized { origin: DVec3::ZERO, scale: 1.0, origin_error: 0.0 };
        let box_of = |primitive| unit.aabb(&corners(primitive).into_iter().collect());
        let tree = Tree::build(count, box_of, WIDTH as u32, |primitives| {
            let mut leaf = Leaf::EMPTY;
            for (slot, &primitive) in primitives.iter().enumerate() {
                leaf.set(slot, primitive, corners(primitive));
            }
            leaf
        });
        Self { tree, space, bounds, parts }
    }

    /// The instance and triangle of a primitive.
    #[inline]
    fn locate(&self, entry: &Entry, primitive: u32) -> (u32, u32) {
        match entry.instance {
            Some(instance) => (instance, primitive),
            None => {
                let (instance, first) = part_of(&self.parts, primitive);
                (instance, primitive - first)
            }
        }
    }

    fn triangle_count(&self, scene: &Scene) -> u64 {
        self.parts.iter().map(|&(i, _)| scene.meshes[scene.instances[i as usize].mesh].triangles.len() as u64).sum()
    }
}

#[inline]
fn part_of(parts: &[(u32, u32)], primitive: u32) -> (u32, u32) {
    parts[parts.partition_point(|&(_, first)| first <= primitive) - 1]
}

fn absolute(matrix: &DMat3) -> DMat3 {
    DMat3::from_cols(matrix.x_axis.abs(), matrix.y_axis.abs(), matrix.z_axis.abs())
}

/// The largest `f32` not above `x`.
fn round_down(x: f64) -> f32 {
    let rounded = x as f32;
    if f64::from(rounded) > x { rounded.next_down() } else { rounded }
}

impl Mesh {
    /// Texture coordinate at weights of a triangle's second and third corner; zero without coordinates.
    pub fn uv_at(&self, triangle: usize, barycentric: [f64; 2]) -> DVec2 {
        let Some(uvs) = &self.uvs else { return DVec2::ZERO };
        let [a, b, c] = self.triangles[triangle].map(|index| uvs[index as usize].as_dvec2());
        a + barycentric[0] * (b - a) + barycentric[1] * (c - a)
    }
}

/// Whether a box lies wholly outside a camera's view.
pub fn is_out_of_view(bounds: &Bounds, camera: &Camera, size: [u32; 2]) -> bool {
    let [width, height] = size.map(f64::from);
    let corners_px = [(0.0, 0.0), (width, 0.0), (width, height), (0.0, height)];
    let rays = corners_px.map(|(x, y)| camera.ray(DVec2::new(x, y), size));
    let corners = bounds.corners();
    // Outside one of the four side planes, each through two neighbouring corner rays.
    let beyond_side = (0..4).any(|i| {
        let (a, b) = (rays[i], rays[(i + 1) % 4]);
        // From one ray to another, at any scale: a direction is no length.
        let to = |other: CameraRay| match camera.projection {
            Projection::Perspective { .. } => other.direction,
            Projection::Orthographic { .. } => other.origin - a.origin,
        };
        let mut outward = a.direction.cross(to(b));
        if outward.dot(to(rays[(i + 2) % 4])) > 0.0 {
            outward = -outward;
        }
        corners.iter().all(|&corner| outward.dot(corner - a.origin) > 0.0)
    });
    let forward = -camera.scene_from_camera.matrix3.z_axis;
    let depth = |corner: &DVec3| forward.dot(*corner - camera.scene_from_camera.translation);
    beyond_side || corners.iter().all(|c| depth(c) < camera.near) || corners.iter().all(|c| depth(c) > camera.far)
}
