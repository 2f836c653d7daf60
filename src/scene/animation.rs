//! Scenes that move: what a clip makes of a file's nodes at a time, and the meshes that morph targets and skins deform.
//!
//! Everything is computed in `f64` from what the file holds; deformed vertices are rounded once, to the `f32` of a mesh.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DAffine3, DMat3, DQuat, DVec3, Vec3};
use rayon::prelude::*;

use super::{MAX_COORDINATE, Scene, gltf, procedural};
use crate::Result;

/// A scene that can be had at any time.
#[derive(Debug)]
pub struct Animated {
    /// The clips that it can play; none: it stands still.
    pub clips: Vec<Clip>,
    source: Source,
}

/// Where the scenes of an [`Animated`] come from.
#[derive(Debug)]
enum Source {
    Still(Box<Scene>),
    Gltf(Box<gltf::Model>),
    Procedural(Box<procedural::Moving>),
}

/// One animation of a file, or of a procedural scene.
#[derive(Debug, Clone)]
pub struct Clip {
    /// Its name, unique within the file.
    pub name: String,
    /// What moves.
    pub channels: Vec<Channel>,
}

/// A property of a node over time.
#[derive(Debug, Clone)]
pub struct Channel {
    /// Index into [`Scene::nodes`].
    pub node: usize,
    /// Which property.
    pub property: Property,
    /// Its values.
    pub curve: Curve,
}

/// What a channel animates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Property {
    /// Of a node, in its parent's space.
    Translation,
    /// Of a node, a quaternion.
    Rotation,
    /// Of a node.
    Scale,
    /// Of the morph targets of a node's mesh.
    Weights,
}

/// How values are found between keys (glTF 2.0, appendix C).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interpolation {
    /// On the straight line; rotations on the shorter great circle.
    Linear,
    /// The last key's value.
    Step,
    /// Cubic Hermite spline with tangents of its own.
    CubicSpline,
}

/// Keys and what lies between them. Before the first key and after the last one the value stays.
#[derive(Debug, Clone)]
pub struct Curve {
    /// When the keys are, s: at least one, ascending.
    pub times: Arc<[f32]>,
    /// The keys' values, a fixed number of components each; of a cubic spline: in-tangent, value and out-tangent.
    pub values: Arc<[f32]>,
    /// Between the keys.
    pub interpolation: Interpolation,
}

/// Where a time lies among the keys.
enum Place {
    /// At a key, or beyond the ends.
    Key(usize),
    /// Between this key and the next one: seconds between the two, and which fraction of them has passed.
    After(usize, f64, f64),
}

/// What a clip says of the nodes at one time.
#[derive(Debug, Clone, Default)]
pub(super) struct Pose {
    /// By node; what is not there is as in the file.
    pub nodes: BTreeMap<usize, NodePose>,
}

/// What a clip says of one node.
#[derive(Debug, Clone, Default)]
pub(super) struct NodePose {
    pub translation: Option<DVec3>,
    pub rotation: Option<DQuat>,
    pub scale: Option<DVec3>,
    pub weights: Option<Vec<f64>>,
}

impl Animated {
    /// A scene that stands still.
    pub fn still(scene: Scene) -> Self {
        Self { clips: Vec::new(), source: Source::Still(Box::new(scene)) }
    }

    /// A file that poses its scenes.
    pub(super) fn gltf(model: gltf::Model, clips: Vec<Clip>) -> Self {
        Self { clips, source: Source::Gltf(Box::new(model)) }
    }

    /// A scene made by code with parts that move.
    pub(super) fn procedural(moving: procedural::Moving, clip: Clip) -> Self {
        Self { clips: vec![clip], source: Source::Procedural(Box::new(moving)) }
    }

    /// The scene without any clip: as the file's nodes pose it, or as it is at the start of a procedural one's.
    ///
    /// # Errors
    /// None in practice: the same pose was made when the file was loaded.
    pub fn rest(&self) -> Result<Scene> {
        match &self.source {
            Source::Still(scene) => Ok(Scene::clone(scene)),
            Source::Gltf(model) => model.rest(),
            Source::Procedural(moving) => Ok(moving.rest()),
        }
    }

    /// The scene at a time of one of its clips. A file's has the origin of its own geometry, which may move from one time to
    /// another; a procedural one's stays. Meshes that nothing deforms share their vertices with every other time.
    ///
    /// # Errors
    /// A pose that can't be rendered: a node that is flattened, or geometry out of range.
    ///
    /// # Panics
    /// Without such a clip.
    pub fn pose(&self, clip: usize, seconds: f64) -> Result<Scene> {
        let clip = &self.clips[clip];
        match &self.source {
            Source::Still(scene) => Ok(Scene::clone(scene)),
            Source::Gltf(model) => model.pose(clip, seconds),
            Source::Procedural(moving) => Ok(moving.pose(clip, seconds)),
        }
    }
}

impl Clip {
    /// Time of the first key, s; 0 without any.
    pub fn start(&self) -> f64 {
        let first = self.channels.iter().filter_map(|channel| channel.curve.times.first());
        first.copied().reduce(f32::min).map_or(0.0, f64::from)
    }

    /// Time of the last key, s; 0 without any.
    pub fn end(&self) -> f64 {
        let last = self.channels.iter().filter_map(|channel| channel.curve.times.last());
        last.copied().fold(0.0, f32::max).into()
    }

    /// The pose at a time, or the channel whose rotation has no direction there.
    pub(super) fn pose(&self, seconds: f64) -> Result<Pose, usize> {
        let mut pose = Pose::default();
        for (index, channel) in self.channels.iter().enumerate() {
            let node = pose.nodes.entry(channel.node).or_default();
            let vector = || DVec3::from_slice(&channel.curve.value(seconds));
            match channel.property {
                Property::Translation => node.translation = Some(vector()),
                Property::Rotation => node.rotation = Some(channel.curve.rotation(seconds).ok_or(index)?),
                Property::Scale => node.scale = Some(vector()),
                Property::Weights => node.weights = Some(channel.curve.value(seconds)),
            }
        }
        Ok(pose)
    }
}

impl Curve {
    /// The value at a time, all of its components.
    pub fn value(&self, seconds: f64) -> Vec<f64> {
        match self.place(seconds) {
            Place::Key(key) => self.components(key, 0).collect(),
            Place::After(key, span, fraction) => self.between(key, span, fraction),
        }
    }

    /// The rotation at a time; none where a cubic spline passes through zero.
    pub fn rotation(&self, seconds: f64) -> Option<DQuat> {
        let quaternion = |mut values: Vec<f64>| {
            // Scaled first: the square of a tangent's overshoot need not be a number.
            let largest = values.iter().fold(0.0f64, |most, x| most.max(x.abs()));
            values.iter_mut().for_each(|x| *x /= largest);
            let quaternion = DQuat::from_slice(&values);
            (largest > 0.0 && quaternion.is_finite()).then(|| quaternion.normalize())
        };
        let at = |key| quaternion(self.components(key, 0).collect());
        match self.place(seconds) {
            Place::Key(key) => at(key),
            Place::After(key, _, fraction) if self.interpolation == Interpolation::Linear => {
                Some(at(key)?.slerp(at(key + 1)?, fraction))
            }
            Place::After(key, span, fraction) => quaternion(self.between(key, span, fraction)),
        }
    }

    fn place(&self, seconds: f64) -> Place {
        let time = |key: usize| f64::from(self.times[key]);
        // Keys that have passed, the one of this very moment included.
        let passed = self.times.partition_point(|&time| f64::from(time) <= seconds);
        let Some(key) = passed.checked_sub(1) else { return Place::Key(0) };
        if passed == self.times.len() || time(key) == seconds {
            return Place::Key(key);
        }
        let span = time(passed) - time(key);
        Place::After(key, span, (seconds - time(key)) / span)
    }

    /// The components of a key's value (`part` 0), in-tangent (−1) or out-tangent (1).
    fn components(&self, key: usize, part: isize) -> impl Iterator<Item = f64> {
        let parts = if self.interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        let width = self.values.len() / (self.times.len() * parts);
        let first = width * (key * parts + (parts / 2).wrapping_add_signed(part));
        self.values[first..first + width].iter().map(|&value| f64::from(value))
    }

    fn between(&self, key: usize, span: f64, t: f64) -> Vec<f64> {
        let (from, to) = (self.components(key, 0), self.components(key + 1, 0));
        match self.interpolation {
            Interpolation::Step => from.collect(),
            Interpolation::Linear => from.zip(to).map(|(a, b)| a + t * (b - a)).collect(),
            // glTF 2.0, appendix C.5: the tangents are per second.
            Interpolation::CubicSpline => {
                let (t2, t3) = (t * t, t * t * t);
                let tangents = self.components(key, 1).zip(self.components(key + 1, -1));
                from.zip(to)
                    .zip(tangents)
                    .map(|((a, b), (leaving, arriving))| {
                        (2.0 * t3 - 3.0 * t2 + 1.0) * a
                            + span * (t3 - 2.0 * t2 + t) * leaving
                            + (3.0 * t2 - 2.0 * t3) * b
                            + span * (t3 - t2) * arriving
                    })
                    .collect()
            }
        }
    }
}

/// What deforms a mesh: morph targets, then joints.
#[derive(Debug)]
pub(super) struct Deformer {
    pub targets: Vec<Target>,
    /// Four joints and their weights a vertex in each; empty: not skinned.
    pub influences: Vec<Influences>,
    /// The highest joint with a weight.
    pub highest_joint: usize,
}

/// A morph target: displacements at a weight of 1, with their vertices; zero elsewhere.
#[derive(Debug)]
pub(super) struct Target {
    pub positions: Arc<[(u32, Vec3)]>,
    pub normals: Arc<[(u32, Vec3)]>,
}

/// A set of joints. At each vertex, the weights of all sets have a positive sum.
#[derive(Debug)]
pub(super) struct Influences {
    pub joints: Arc<[[u16; 4]]>,
    pub weights: Arc<[[f32; 4]]>,
}

/// Positions and normals, which meshes share.
#[derive(Debug, Clone)]
pub(super) struct Vertices {
    pub positions: Arc<[Vec3]>,
    pub normals: Option<Arc<[Vec3]>>,
}

impl Vertices {
    /// Vectors in all.
    pub fn count(&self) -> u64 {
        (self.positions.len() + self.normals.as_ref().map_or(0, |normals| normals.len())) as u64
    }
}

impl Deformer {
    /// Steps that [`deformed`](Self::deformed) takes with these weights beyond its vertices.
    pub fn steps(&self, weights: &[f64]) -> u64 {
        let active = self.targets.iter().zip(weights).filter(|(_, weight)| **weight != 0.0);
        active.map(|(target, _)| (target.positions.len() + target.normals.len()) as u64).sum()
    }

    /// The vertices of a mesh with its targets at these weights, then moved by `joints` (mesh space to the space that the
    /// result is in) if there are any; or the first vertex that is out of range.
    ///
    /// The weights of a vertex are divided by their sum, which the specification wants to be about 1: quantised ones
    /// rarely are, and Blender and three.js do the same.
    pub fn deformed(&self, base: &Vertices, weights: &[f64], joints: Option<&[DAffine3]>) -> Result<Vertices, usize> {
        let mut positions = morphed(&base.positions, self.targets.iter().map(|target| &target.positions), weights);
        let normal_deltas = self.targets.iter().map(|target| &target.normals);
        let mut normals = base.normals.as_ref().map(|normals| morphed(normals, normal_deltas, weights));
        if let Some(joints) = joints {
            positions.par_iter_mut().enumerate().for_each(|(vertex, position)| {
                *position = self.blended(vertex, joints).transform_point3(*position);
            });
            if let Some(normals) = &mut normals {
                normals.par_iter_mut().enumerate().for_each(|(vertex, normal)| {
                    *normal = normal_matrix(self.blended(vertex, joints).matrix3) * *normal;
                });
            }
        }
        let in_range = |p: &DVec3| p.abs().max_element() <= MAX_COORDINATE && !p.is_nan();
        if let Some(bad) = positions.iter().position(|position| !in_range(position)) {
            return Err(bad);
        }
        let unit = |(normal, base): (DVec3, &Vec3)| {
            // What collapses to nothing keeps its normal: no triangle there has an area.
            (normal / normal.abs().max_element()).try_normalize().map_or(*base, |normal| normal.as_vec3())
        };
        let normals = normals.zip(base.normals.as_ref());
        Ok(Vertices {
            positions: positions.into_iter().map(|position| position.as_vec3()).collect(),
            normals: normals.map(|(normals, bases)| normals.into_iter().zip(bases.iter()).map(unit).collect()),
        })
    }

    /// The weighted mean of the joints' transforms at a vertex.
    fn blended(&self, vertex: usize, joints: &[DAffine3]) -> DAffine3 {
        let mut sum = DAffine3::ZERO;
        let mut weights = 0.0;
        for set in &self.influences {
            for (&joint, &weight) in set.joints[vertex].iter().zip(&set.weights[vertex]) {
                if weight > 0.0 {
                    let weight = f64::from(weight);
                    let out_from_mesh = &joints[usize::from(joint)];
                    sum.matrix3 += weight * out_from_mesh.matrix3;
                    sum.translation += weight * out_from_mesh.translation;
                    weights += weight;
                }
            }
        }
        DAffine3 { matrix3: sum.matrix3 * (1.0 / weights), translation: sum.translation / weights }
    }
}

/// Vectors with the targets' displacements at these weights.
fn morphed<'a>(base: &[Vec3], targets: impl Iterator<Item = &'a Arc<[(u32, Vec3)]>>, weights: &[f64]) -> Vec<DVec3> {
    let mut moved: Vec<DVec3> = base.iter().map(|vector| vector.as_dvec3()).collect();
    for (deltas, &weight) in targets.zip(weights).filter(|(_, weight)| **weight != 0.0) {
        for &(vertex, delta) in deltas.iter() {
            moved[vertex as usize] += weight * delta.as_dvec3();
        }
    }
    moved
}

/// What normals are multiplied by where points are by `linear`: a multiple of its inverse's transpose, even where it has none.
fn normal_matrix(linear: DMat3) -> DMat3 {
    let largest = [linear.x_axis, linear.y_axis, linear.z_axis].map(|axis| axis.abs().max_element());
    // Scaled, so that products neither vanish nor overflow.
    let [x, y, z] = [linear.x_axis, linear.y_axis, linear.z_axis]
        .map(|axis| axis / largest.into_iter().fold(f64::MIN_POSITIVE, f64::max));
    let cofactors = DMat3::from_cols(y.cross(z), z.cross(x), x.cross(y));
    // A mirror turns the winding, not the front (glTF 2.0, 3.7.4).
    if x.dot(y.cross(z)) < 0.0 { cofactors * -1.0 } else { cofactors }
}
