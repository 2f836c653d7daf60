//! A scene: meshes, their instances, area lights and cameras.
//!
//! # Spaces
//! - **world**: the file's own space, metres, right-handed, +Y up.
//! - **scene**: world space with its origin moved to [`Scene::origin_world`], the lowest corner of the geometry. All that
//!   [`Scene`] holds is in scene space and in `f64`, so a scene far from the world's origin loses nothing: subtracting the
//!   origin is exact wherever the moved coordinates are representable.
//! - **mesh**: the raw `f32` coordinates of a [`Mesh`].

pub mod additions;
pub mod animation;
pub mod camera;
pub mod gltf;
pub mod light;
pub mod procedural;

use std::collections::HashMap;
use std::sync::Arc;

use glam::{DAffine3, DVec2, DVec3, Vec2, Vec3};

pub use camera::{Camera, Projection};
pub use light::{AreaLight, Cone, Emission, Shape};

/// The largest coordinate (after transforms) that a scene may hold: beyond it a squared area overflows `f32`.
pub const MAX_COORDINATE: f64 = 1e9 * 1e9;

/// Geometry, lights and cameras, ready to be rendered. See the module for its spaces.
#[derive(Debug, Clone, Default)]
pub struct Scene {
    /// Path or `procedural:` name, as shown to the user and written to image headers.
    pub name: String,
    /// World position of the scene-space origin: the lowest corner of the geometry's bounds.
    pub origin_world: DVec3,
    /// The file's nodes: names and hierarchy, for light linking and messages.
    pub nodes: Vec<Node>,
    /// Geometry, each stored once however often it is used.
    pub meshes: Vec<Mesh>,
    /// Materials, referred to by [`Mesh::material`].
    pub materials: Vec<Material>,
    /// Uses of meshes.
    pub instances: Vec<Instance>,
    /// Lights, in file order; names are unique (`#2` is appended to a duplicate).
    pub lights: Vec<AreaLight>,
    /// Cameras, in file order.
    pub cameras: Vec<Camera>,
    /// What was skipped or taken differently, in one line each.
    pub warnings: Vec<String>,
}

/// A node of the source file.
#[derive(Debug, Clone)]
pub struct Node {
    /// Its name, or `node N` when it has none.
    pub name: String,
    /// Its parent, if it is not a root.
    pub parent: Option<usize>,
}

/// Triangles of one material (one glTF primitive).
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// Name for messages.
    pub name: String,
    /// Positions, mesh space. Shared between meshes that index the same vertices.
    pub positions: Arc<[Vec3]>,
    /// Unit shading normals, one a position; without them triangles are flat.
    pub normals: Option<Arc<[Vec3]>>,
    /// Texture coordinates of the material's textures, one a position (KHR_texture_transform applied).
    pub uvs: Option<Arc<[Vec2]>>,
    /// Three position indices a triangle, counter-clockwise seen from its front. In range, always.
    pub triangles: Vec<[u32; 3]>,
    /// Index into [`Scene::materials`]; none: white, opaque.
    pub material: Option<usize>,
}

/// What a surface looks like, as far as shading and cut-out shadows need it.
#[derive(Debug, Clone)]
pub struct Material {
    /// Name for messages.
    pub name: String,
    /// Linear base colour, alpha apart.
    pub base_color: Vec3,
    /// Multiplies `base_color`; loaded only when asked for ([`LoadOptions::base_color_textures`]).
    pub base_color_texture: Option<Arc<Texture<3>>>,
    /// 0 for plastic to 1 for metal; Phong's shading alone reads it.
    pub metallic: f32,
    /// 0 for a mirror to 1, as glTF has it; Phong's shading alone reads it.
    pub roughness: f32,
    /// `alphaMode: MASK`: where alpha is below the cut-off there is no surface.
    pub cutout: Option<Cutout>,
}

impl Default for Material {
    /// White and rough, without holes.
    fn default() -> Self {
        Self {
            name: String::new(),
            base_color: Vec3::ONE,
            base_color_texture: None,
            metallic: 0.0,
            roughness: 1.0,
            cutout: None,
        }
    }
}

/// A cut-out: `factor · texture.alpha < cutoff` is a hole.
#[derive(Debug, Clone)]
pub struct Cutout {
    /// Alpha below this is a hole.
    pub cutoff: f32,
    /// Alpha factor of the material.
    pub factor: f32,
    /// Alpha texture; without it the factor decides alone.
    pub texture: Option<Arc<Texture<1>>>,
}

/// How texture coordinates outside [0, 1] are taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Wrap {
    /// Repeats.
    #[default]
    Repeat,
    /// Repeats, every second one mirrored.
    MirroredRepeat,
    /// The border texel continues.
    ClampToEdge,
}

/// An image of `N` channels, linear values in [0, 1] stored in 8 bits (sRGB-decoded on sampling where `srgb` is set).
#[derive(Debug, Clone, Default)]
pub struct Texture<const N: usize> {
    /// Width and height, texels.
    pub size: [u32; 2],
    /// Row-major from the image's top-left corner, which is texture coordinate (0, 0).
    pub texels: Vec<[u8; N]>,
    /// Whether stored values go through the sRGB curve.
    pub srgb: bool,
    /// Nearest texel instead of bilinear.
    pub nearest: bool,
    /// Wrap modes along u and v.
    pub wrap: [Wrap; 2],
}

/// One use of a mesh.
#[derive(Debug, Clone)]
pub struct Instance {
    /// Index into [`Scene::meshes`].
    pub mesh: usize,
    /// Index into [`Scene::nodes`].
    pub node: usize,
    /// Mesh space to scene space; invertible, any sign of determinant.
    pub scene_from_mesh: DAffine3,
}

/// Names given so far.
#[derive(Debug, Default)]
pub struct UniqueNames {
    /// For each name, the last number that was tried behind it.
    numbers: HashMap<String, usize>,
}

/// An axis-aligned box; empty when `min > max`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Lowest corner.
    pub min: DVec3,
    /// Highest corner.
    pub max: DVec3,
}

/// What to load beyond geometry, lights and cameras.
#[derive(Debug, Clone, Copy, Default)]
pub struct LoadOptions {
    /// Decode base-colour textures (needed for shaded images alone; alpha of cut-outs is always decoded).
    pub base_color_textures: bool,
    /// Warn of textures of metalness and roughness, which are not read (Phong's shading alone needs them).
    pub highlights: bool,
}

impl Bounds {
    /// The box that holds nothing.
    pub const EMPTY: Self = Self { min: DVec3::INFINITY, max: DVec3::NEG_INFINITY };

    /// Whether it holds no point.
    pub fn is_empty(&self) -> bool {
        !(self.min.x <= self.max.x && self.min.y <= self.max.y && self.min.z <= self.max.z)
    }

    /// The smallest box around this one and a point.
    pub fn including(self, point: DVec3) -> Self {
        Self { min: self.min.min(point), max: self.max.max(point) }
    }

    /// The smallest box around both.
    pub fn union(self, other: Self) -> Self {
        Self { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// The middle.
    pub fn center(&self) -> DVec3 {
        0.5 * (self.min + self.max)
    }

    /// Edge lengths; zero when empty.
    pub fn size(&self) -> DVec3 {
        if self.is_empty() { DVec3::ZERO } else { self.max - self.min }
    }

    /// The box around this one's transformed corners.
    pub fn transformed(&self, transform: &DAffine3) -> Self {
        if self.is_empty() {
            return Self::EMPTY;
        }
        self.corners().into_iter().map(|corner| transform.transform_point3(corner)).collect()
    }

    /// The eight corners.
    pub fn corners(&self) -> [DVec3; 8] {
        std::array::from_fn(|i| {
            DVec3::new(
                if i & 1 == 0 { self.min.x } else { self.max.x },
                if i & 2 == 0 { self.min.y } else { self.max.y },
                if i & 4 == 0 { self.min.z } else { self.max.z },
            )
        })
    }
}

impl FromIterator<DVec3> for Bounds {
    fn from_iter<T: IntoIterator<Item = DVec3>>(points: T) -> Self {
        points.into_iter().fold(Self::EMPTY, Self::including)
    }
}

impl Mesh {
    /// Bounds in mesh space of the positions that triangles use.
    pub fn bounds(&self) -> Bounds {
        self.bounds_of(0, self.triangles.len())
    }

    /// Bounds in mesh space of `count` triangles, as far as there are so many, from the `first` on.
    pub fn bounds_of(&self, first: usize, count: usize) -> Bounds {
        let (mut min, mut max) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        let end = self.triangles.len().min(first + count);
        for &index in self.triangles[first..end].as_flattened() {
            let position = self.positions[index as usize];
            min = min.min(position);
            max = max.max(position);
        }
        Bounds { min: min.as_dvec3(), max: max.as_dvec3() }
    }

    /// The triangle's corners, mesh space.
    pub fn corners(&self, triangle: usize) -> [DVec3; 3] {
        self.triangles[triangle].map(|index| self.positions[index as usize].as_dvec3())
    }
}

impl Scene {
    /// Triangles, every instance counted.
    pub fn triangle_count(&self) -> u64 {
        self.instances.iter().map(|instance| self.meshes[instance.mesh].triangles.len() as u64).sum()
    }

    /// Bounds of the geometry in scene space: of the instances' boxes.
    pub fn bounds(&self) -> Bounds {
        use rayon::prelude::*;
        self.instance_bounds().into_par_iter().reduce(|| Bounds::EMPTY, Bounds::union)
    }

    /// Bounds of each instance in scene space. Exact for axis-aligned transforms, else the box around its mesh's box.
    pub fn instance_bounds(&self) -> Vec<Bounds> {
        use rayon::prelude::*;
        let mesh_bounds: Vec<Bounds> = self.meshes.par_iter().map(Mesh::bounds).collect();
        self.instances
            .par_iter()
            .map(|instance| mesh_bounds[instance.mesh].transformed(&instance.scene_from_mesh))
            .collect()
    }

    /// For each instance, whether its node or an ancestor of it is named in `names`.
    pub fn instances_under(&self, names: &[String]) -> Vec<bool> {
        // Each node is decided once, from the nearest ancestor that is decided already.
        let mut is_under: Vec<Option<bool>> =
            self.nodes.iter().map(|node| names.contains(&node.name).then_some(true)).collect();
        let mut path = Vec::new();
        self.instances
            .iter()
            .map(|instance| {
                let mut at = Some(instance.node);
                while let Some(node) = at.filter(|&node| is_under[node].is_none()) {
                    path.push(node);
                    at = self.nodes[node].parent;
                }
                let found = at.is_some_and(|node| is_under[node] == Some(true));
                path.drain(..).for_each(|node| is_under[node] = Some(found));
                found
            })
            .collect()
    }

    /// Moves the origin to the lowest corner of the geometry. Called once by whoever has built the scene in world space
    /// (`origin_world` still zero), before anything is rendered.
    pub fn rebase(&mut self) {
        let bounds = self.bounds();
        if bounds.is_empty() {
            return;
        }
        let origin = bounds.min;
        self.origin_world += origin;
        for instance in &mut self.instances {
            instance.scene_from_mesh.translation -= origin;
        }
        for light in &mut self.lights {
            light.scene_from_light.translation -= origin;
        }
        for camera in &mut self.cameras {
            camera.scene_from_camera.translation -= origin;
        }
    }

    /// Adds a light (in scene space) under a name that is not taken yet.
    pub fn add_light(&mut self, light: AreaLight) {
        self.add_lights([light]);
    }

    /// Adds lights (in scene space) under names that are not taken yet.
    pub fn add_lights(&mut self, lights: impl IntoIterator<Item = AreaLight>) {
        let mut names = UniqueNames::default();
        for light in &self.lights {
            names.take(&light.name);
        }
        for mut light in lights {
            light.name = names.take(&light.name);
            self.lights.push(light);
        }
    }
}

impl UniqueNames {
    /// A name that was not given before: `wanted`, else `wanted#2`, `wanted#3` and so on.
    pub fn take(&mut self, wanted: &str) -> String {
        let mut name = wanted.to_owned();
        while self.numbers.contains_key(&name) {
            let number = self.numbers.entry(wanted.to_owned()).or_insert(1);
            *number += 1;
            name = format!("{wanted}#{number}");
        }
        self.numbers.insert(name.clone(), 1);
        name
    }
}

impl Cutout {
    /// Whether the surface is there at a texture coordinate.
    pub fn is_solid(&self, uv: DVec2) -> bool {
        let alpha = match &self.texture {
            Some(texture) => self.factor * texture.sample(uv)[0],
            None => self.factor,
        };
        alpha >= self.cutoff
    }
}

impl<const N: usize> Texture<N> {
    /// The value at a texture coordinate, linear, filtered as the texture says.
    pub fn sample(&self, uv: DVec2) -> [f32; N] {
        let [width, height] = self.size.map(f64::from);
        let at = DVec2::new(uv.x * width, uv.y * height);
        if !at.is_finite() {
            return self.texel(0, 0);
        }
        if self.nearest {
            return self.texel(at.x.floor() as i64, at.y.floor() as i64);
        }
        let corner = (at - 0.5).floor();
        let fraction = (at - 0.5 - corner).as_vec2();
        let (x, y) = (corner.x as i64, corner.y as i64);
        // Coordinates beyond i64 are those of its ends.
        let (right, below) = (x.saturating_add(1), y.saturating_add(1));
        let [a, b, c, d] = [self.texel(x, y), self.texel(right, y), self.texel(x, below), self.texel(right, below)];
        std::array::from_fn(|i| {
            let top = a[i] + (b[i] - a[i]) * fraction.x;
            let bottom = c[i] + (d[i] - c[i]) * fraction.x;
            top + (bottom - top) * fraction.y
        })
    }

    fn texel(&self, x: i64, y: i64) -> [f32; N] {
        let x = self.wrap[0].apply(x, i64::from(self.size[0]));
        let y = self.wrap[1].apply(y, i64::from(self.size[1]));
        self.texels[(y * i64::from(self.size[0]) + x) as usize].map(|value| {
            let value = f32::from(value) / 255.0;
            if self.srgb { crate::image::linear_from_srgb(value) } else { value }
        })
    }
}

impl Wrap {
    /// Maps any texel coordinate into `0..size`.
    fn apply(self, at: i64, size: i64) -> i64 {
        match self {
            Self::Repeat => at.rem_euclid(size),
            Self::MirroredRepeat => {
                let at = at.rem_euclid(2 * size);
                if at < size { at } else { 2 * size - 1 - at }
            }
            Self::ClampToEdge => at.clamp(0, size - 1),
        }
    }
}
