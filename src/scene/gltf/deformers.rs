//! Morph targets and skins: which accessors make them up, and what they hold.

use std::collections::hash_map::Entry;
use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use glam::{DAffine3, Vec3};
use gltf::json::accessor::{ComponentType, Type};
use gltf::json::mesh::{Primitive, Semantic};
use gltf::json::validation::Checked;
use gltf::json::{Root, mesh};
use rayon::prelude::*;

use super::accessor::Accessor;
use super::document::{Document, Parsed, fault, item};
use super::geometry::{Distinct, Geometry, in_order};
use super::hierarchy::{Hierarchy, NO_AFFINE, affine};
use crate::scene::animation::{Deformer, Influences, Target};

/// The accessors of a primitive's deformer.
#[derive(Clone, PartialEq, Eq, Hash)]
pub(super) struct Key {
    /// Displacements of positions and normals of each target.
    targets: Vec<[Option<usize>; 2]>,
    /// Joints and weights of each set.
    influences: Vec<[usize; 2]>,
}

/// Deformers to be decoded.
#[derive(Default)]
pub(super) struct Planned {
    known: HashMap<Key, usize>,
    /// Each with its first primitive's place, such as `meshes[0].primitives[1]`.
    deformers: Vec<(Key, String)>,
}

/// What has been counted of deformers so far.
#[derive(Default)]
pub(super) struct Counted<'a> {
    deformers: HashSet<&'a Key>,
    displacements: HashSet<usize>,
    influences: HashSet<usize>,
}

impl<'a> Counted<'a> {
    /// Elements to be decoded for a deformer of so many vertices that haven't been counted yet.
    pub fn add(&mut self, document: &Document, key: &'a Key, vertices: usize) -> Parsed<u64> {
        let mut elements = 0u64;
        for &index in key.targets.iter().flatten().flatten() {
            if self.displacements.insert(index) {
                elements = elements.saturating_add(Accessor::new(document, index, String::new)?.stored() as u64);
            }
        }
        let mut passes = key.influences.iter().flatten().filter(|&&index| self.influences.insert(index)).count();
        if self.deformers.insert(key) {
            // Its weights are summed.
            passes += key.influences.len();
        }
        Ok(elements.saturating_add((passes as u64).saturating_mul(vertices as u64)))
    }
}

impl Planned {
    /// The index of a deformer, which is new or known.
    pub fn add(&mut self, key: &Key, place: &str) -> usize {
        let next = self.deformers.len();
        let at = *self.known.entry(key.clone()).or_insert(next);
        if at == next {
            self.deformers.push((key.clone(), place.to_owned()));
        }
        at
    }
}

/// Displacements, as core glTF and KHR_mesh_quantization allow them.
const DISPLACEMENTS: [ComponentType; 3] = [ComponentType::F32, ComponentType::I8, ComponentType::I16];

/// Finds and checks the accessors that deform a primitive; none for one that nothing deforms.
pub(super) fn plan(
    document: &Document,
    primitive: &Primitive,
    vertices: usize,
    skinned: bool,
    place: &str,
) -> Parsed<Option<Key>> {
    let check = |index: usize, dimensions, components: &[ComponentType], member: &str| {
        let at = || format!("{place}.{member}");
        let accessor = Accessor::new(document, index, at)?;
        accessor.expect(dimensions, components, at)?;
        accessor.expect_count(vertices, at)?;
        Ok(accessor)
    };
    let mut key = Key { targets: Vec::new(), influences: Vec::new() };
    for (t, target) in primitive.targets.iter().flatten().enumerate() {
        let displacement = |index: &Option<gltf::json::Index<_>>, name: &str| {
            let index = index.map(|index: gltf::json::Index<gltf::json::Accessor>| index.value());
            if let Some(index) = index {
                check(index, Type::Vec3, &DISPLACEMENTS, &format!("targets[{t}].{name}"))?;
            }
            Ok(index)
        };
        key.targets.push([displacement(&target.positions, "POSITION")?, displacement(&target.normals, "NORMAL")?]);
    }
    if skinned {
        let index = |semantic| primitive.attributes.get(&Checked::Valid(semantic)).map(|index| index.value());
        // The semantics of all sets that have joints or weights, in order.
        let mut sets: Vec<u32> = Vec::new();
        for semantic in primitive.attributes.keys() {
            if let Checked::Valid(Semantic::Joints(set) | Semantic::Weights(set)) = semantic {
                sets.push(*set);
            }
        }
        sets.push(0);
        sets.sort_unstable();
        sets.dedup();
        for set in sets {
            let missing = |name: &str| {
                let message = "missing, and a node with a skin shows it";
                fault(format!("{place}.attributes.{name}_{set}"), message)
            };
            let joints = index(Semantic::Joints(set)).ok_or_else(|| missing("JOINTS"))?;
            let weights = index(Semantic::Weights(set)).ok_or_else(|| missing("WEIGHTS"))?;
            let components = [ComponentType::U8, ComponentType::U16];
            check(joints, Type::Vec4, &components, &format!("attributes.JOINTS_{set}"))?;
            let components = [ComponentType::F32, ComponentType::U8, ComponentType::U16];
            let member = format!("attributes.WEIGHTS_{set}");
            let accessor = check(weights, Type::Vec4, &components, &member)?;
            if accessor.component != ComponentType::F32 && !accessor.normalized {
                let message = format!("accessors[{weights}]: expected normalized integers");
                return Err(fault(format!("{place}.{member}"), message));
            }
            key.influences.push([joints, weights]);
        }
    }
    Ok((!key.targets.is_empty() || !key.influences.is_empty()).then_some(key))
}

/// Decodes each distinct accessor in parallel, then checks what the deformers hold.
pub(super) fn decode(document: &Document, planned: Planned) -> Parsed<Vec<Deformer>> {
    let (mut displacements, mut joints, mut weights) =
        (Distinct::default(), Distinct::default(), Distinct::<usize>::default());
    for (key, _) in &planned.deformers {
        key.targets.iter().flatten().flatten().for_each(|&index| _ = displacements.add(index));
        for &[of_joints, of_weights] in &key.influences {
            joints.add(of_joints);
            weights.add(of_weights);
        }
    }
    // Found and checked before: the place can't be needed.
    let accessor = |index| Accessor::new(document, index, String::new);
    let all_displacements = in_order(displacements.items.par_iter().map(|&index| {
        let displacements = accessor(index)?.displacements()?;
        match displacements.iter().find(|(_, vector)| !vector.is_finite()) {
            Some((vertex, _)) => {
                let message = format!("element {vertex} is a displacement of a morph target: expected finite numbers");
                Err(fault(format!("accessors[{index}]"), message))
            }
            None => Ok(displacements),
        }
    }))?;
    let all_joints = in_order(joints.items.par_iter().map(|&index| accessor(index)?.quadruples()))?;
    let all_weights = in_order(weights.items.par_iter().map(|&index| {
        let weights = accessor(index)?.floats::<4, _>(|weights| weights)?;
        let bad = weights.iter().position(|all| !all.iter().all(|weight| weight.is_finite() && *weight >= 0.0));
        match bad {
            Some(vertex) => {
                let message = format!("vertex {vertex} has a weight below 0 or not finite");
                Err(fault(format!("accessors[{index}]"), message))
            }
            None => Ok(weights),
        }
    }))?;

    let none: Arc<[(u32, Vec3)]> = Arc::new([]);
    in_order(planned.deformers.into_par_iter().map(|(key, place)| {
        let deltas = |index: Option<usize>| match index {
            Some(index) => Arc::clone(&all_displacements[displacements.places[&index]]),
            None => Arc::clone(&none),
        };
        let targets = key
            .targets
            .iter()
            .map(|&[positions, normals]| Target { positions: deltas(positions), normals: deltas(normals) });
        let influences: Vec<Influences> = key
            .influences
            .iter()
            .map(|[of_joints, of_weights]| Influences {
                joints: Arc::clone(&all_joints[joints.places[of_joints]]),
                weights: Arc::clone(&all_weights[weights.places[of_weights]]),
            })
            .collect();
        let mut highest_joint = 0;
        for vertex in 0..influences.first().map_or(0, |set| set.weights.len()) {
            let mut is_held = false;
            for set in &influences {
                for (&joint, &weight) in set.joints[vertex].iter().zip(&set.weights[vertex]) {
                    if weight > 0.0 {
                        is_held = true;
                        highest_joint = highest_joint.max(usize::from(joint));
                    }
                }
            }
            if !is_held {
                let message = format!("all weights of vertex {vertex} are 0: no joint moves it");
                return Err(fault(format!("{place}.attributes.WEIGHTS_0"), message));
            }
        }
        Ok(Deformer { targets: targets.collect(), influences, highest_joint })
    }))
}

/// Which meshes of the file a node with a skin shows.
pub(super) fn skinned_meshes(root: &Root, hierarchy: &Hierarchy) -> Vec<bool> {
    let mut skinned = vec![false; root.meshes.len()];
    for &node in &hierarchy.shown {
        if let (Some(mesh), Some(_)) = (root.nodes[node].mesh, root.nodes[node].skin) {
            skinned[mesh.value()] = true;
        }
    }
    skinned
}

/// The weights of a mesh's morph targets where nothing else is said.
pub(super) fn default_weights(mesh: &mesh::Mesh, targets: usize, place: &str) -> Parsed<Vec<f64>> {
    match &mesh.weights {
        Some(weights) => checked_weights(weights, targets, &format!("{place}.weights")),
        None => Ok(vec![0.0; targets]),
    }
}

/// Weights of a mesh or node, as many as there are targets.
pub(super) fn checked_weights(weights: &[f32], targets: usize, place: &str) -> Parsed<Vec<f64>> {
    if weights.len() != targets {
        return Err(fault(place, format!("expected one for each of {targets} morph targets, found {}", weights.len())));
    }
    if weights.iter().any(|weight| !weight.is_finite()) {
        return Err(fault(place, "expected finite numbers"));
    }
    Ok(weights.iter().map(|&weight| f64::from(weight)).collect())
}

/// A skin: nodes, and where they are in the mesh.
pub(super) struct Skin {
    /// The nodes, at least one.
    joints: Vec<usize>,
    /// Joint space from mesh space; none: the same space.
    joint_from_mesh: Option<Vec<DAffine3>>,
}

impl Skin {
    /// Where a deformed mesh has its origin, world space: at the first joint, so that nothing is lost far from the world's.
    pub fn origin_world(&self, hierarchy: &Hierarchy) -> glam::DVec3 {
        hierarchy.world_from_node[self.joints[0]].translation
    }

    /// For each joint, the deformed mesh's space (world axes, [`origin_world`](Self::origin_world)) from mesh space.
    pub fn transforms(&self, hierarchy: &Hierarchy) -> Vec<DAffine3> {
        let origin = self.origin_world(hierarchy);
        let transform = |(at, &joint): (usize, &usize)| {
            let mut deformed_from_joint = hierarchy.world_from_node[joint];
            deformed_from_joint.translation -= origin;
            match &self.joint_from_mesh {
                Some(all) => deformed_from_joint * all[at],
                None => deformed_from_joint,
            }
        };
        self.joints.iter().enumerate().map(transform).collect()
    }
}

/// The skins that nodes with triangles have, by their index.
pub(super) fn skins(document: &Document, hierarchy: &Hierarchy, geometry: &Geometry) -> Parsed<HashMap<usize, Skin>> {
    let root = &document.root;
    let mut skins = HashMap::new();
    for &node in &hierarchy.shown {
        let (Some(mesh), Some(index)) = (root.nodes[node].mesh, root.nodes[node].skin) else { continue };
        let (mesh, index) = (mesh.value(), index.value());
        let place = || format!("nodes[{node}].skin");
        item(&root.skins, "skins", index, place)?;
        let parts = &geometry.meshes_of[mesh];
        if parts.is_empty() {
            continue;
        }
        let skin = match skins.entry(index) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(new) => new.insert(skin(document, index)?),
        };
        let joints = skin.joints.len();
        let highest =
            parts.iter().filter_map(|part| part.deformer).map(|at| geometry.deformers[at].highest_joint).max();
        if let Some(highest) = highest.filter(|&highest| highest >= joints) {
            let message = format!("skins[{index}] has {joints} joints, and meshes[{mesh}] is moved by joint {highest}");
            return Err(fault(place(), message));
        }
    }
    Ok(skins)
}

fn skin(document: &Document, index: usize) -> Parsed<Skin> {
    let json = &document.root.skins[index];
    let mut joints = Vec::with_capacity(json.joints.len());
    for (which, joint) in json.joints.iter().enumerate() {
        item(&document.root.nodes, "nodes", joint.value(), || format!("skins[{index}].joints[{which}]"))?;
        joints.push(joint.value());
    }
    if joints.is_empty() {
        return Err(fault(format!("skins[{index}].joints"), "expected at least one"));
    }
    let joint_from_mesh = match json.inverse_bind_matrices {
        Some(accessor) => {
            let at = || format!("skins[{index}].inverseBindMatrices");
            let accessor = Accessor::new(document, accessor.value(), at)?;
            accessor.expect(Type::Mat4, &[ComponentType::F32], at)?;
            // More are allowed; they are of no joint, and may be a claim without data.
            if accessor.count < joints.len() {
                let message = format!(
                    "accessors[{}]: {} are too few for {} joints",
                    accessor.index,
                    accessor.count,
                    joints.len()
                );
                return Err(fault(at(), message));
            }
            let mut transforms = Vec::with_capacity(joints.len());
            for (which, matrix) in accessor.first::<16>(joints.len())?.into_iter().enumerate() {
                let transform = affine(matrix).ok_or_else(|| fault(at(), format!("matrix {which}: {NO_AFFINE}")))?;
                transforms.push(transform);
            }
            Some(transforms)
        }
        None => None,
    };
    Ok(Skin { joints, joint_from_mesh })
}
