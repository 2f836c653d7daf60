//! Nodes: who is whose parent, where they are in the world, and which of them the scene shows.

use glam::{DAffine3, DMat3, DMat4, DQuat, DVec3};
use gltf::json::{Root, scene};

use super::document::{Parsed, fault, item};
use crate::scene::MAX_COORDINATE;
use crate::scene::animation::{NodePose, Pose};

/// The nodes of a file, by their index in it.
pub(super) struct Hierarchy {
    /// Each node's parent.
    pub parents: Vec<Option<usize>>,
    /// The nodes of the chosen scene, in file order.
    pub shown: Vec<usize>,
    /// Each node's transform into the world; may be singular.
    pub world_from_node: Vec<DAffine3>,
    /// All nodes, parents first.
    order: Vec<usize>,
}

impl Hierarchy {
    /// Checks that the nodes form trees, multiplies the matrices that the file gives them and chooses the scene: the default
    /// one, else the first, else all nodes.
    pub fn new(root: &Root) -> Parsed<Self> {
        let parents = parents(root)?;
        let order = order(root, &parents)?;
        let world_from_node = world_from_node(root, &parents, &order, &Pose::default())?;
        Ok(Self { shown: shown(root, &parents, &order)?, parents, world_from_node, order })
    }

    /// The same nodes in another pose.
    pub fn posed(&self, root: &Root, pose: &Pose) -> Parsed<Self> {
        let world_from_node = world_from_node(root, &self.parents, &self.order, pose)?;
        let Self { parents, shown, order, .. } = self;
        Ok(Self { parents: parents.clone(), shown: shown.clone(), world_from_node, order: order.clone() })
    }

    /// A node's transform into the world, which must be invertible and within range.
    pub fn world(&self, node: usize) -> Parsed<DAffine3> {
        let world_from_node = self.world_from_node[node];
        check_transform(&world_from_node, || format!("nodes[{node}]"))?;
        Ok(world_from_node)
    }

    /// A node's rotation and translation into the world; scale and shear are left out. Local −Z keeps its direction, +Y is
    /// made perpendicular to it, and +X follows, whatever the handedness.
    pub fn rigid(&self, node: usize) -> Parsed<DAffine3> {
        let world_from_node = self.world(node)?;
        let z = direction(world_from_node.matrix3.z_axis);
        let y = direction(world_from_node.matrix3.y_axis);
        let y = direction(y - y.dot(z) * z);
        Ok(DAffine3 { matrix3: DMat3::from_cols(y.cross(z), y, z), translation: world_from_node.translation })
    }
}

fn world_from_node(root: &Root, parents: &[Option<usize>], order: &[usize], pose: &Pose) -> Parsed<Vec<DAffine3>> {
    let mut world_from_node = vec![DAffine3::IDENTITY; root.nodes.len()];
    for &node in order {
        let parent_from_node = local_transform(&root.nodes[node], node, pose.nodes.get(&node))?;
        world_from_node[node] = match parents[node] {
            Some(parent) => world_from_node[parent] * parent_from_node,
            None => parent_from_node,
        };
    }
    Ok(world_from_node)
}

/// Faults unless a transform into the world is finite, within range and invertible.
pub(super) fn check_transform(world_from_local: &DAffine3, place: impl FnOnce() -> String) -> Parsed<()> {
    let linear = world_from_local.matrix3;
    let largest = [linear.x_axis, linear.y_axis, linear.z_axis, world_from_local.translation]
        .iter()
        .fold(0.0, |most, column| column.abs().max_element().max(most));
    if !world_from_local.is_finite() || largest > MAX_COORDINATE {
        return Err(fault(place(), format!("transform out of range: its entries may be at most {MAX_COORDINATE:e}")));
    }
    // Of columns of unit length, so that no scale counts as singular. A product of a few hundred matrices, one of them
    // singular, leaves a determinant of that many times 2⁻⁵³.
    let determinant =
        DMat3::from_cols(direction(linear.x_axis), direction(linear.y_axis), direction(linear.z_axis)).determinant();
    if determinant.abs() > 2f64.powi(-44) && world_from_local.inverse().is_finite() {
        return Ok(());
    }
    Err(fault(place(), "singular transform: it (or a parent's) flattens space, for example by a scale of 0"))
}

/// A vector's unit direction, without overflow or underflow; zero for a zero vector.
pub(super) fn direction(vector: DVec3) -> DVec3 {
    (vector / vector.abs().max_element()).normalize_or_zero()
}

fn parents(root: &Root) -> Parsed<Vec<Option<usize>>> {
    let mut parents = vec![None; root.nodes.len()];
    for (index, node) in root.nodes.iter().enumerate() {
        for (which, child) in node.children.iter().flatten().enumerate() {
            let place = || format!("nodes[{index}].children[{which}]");
            item(&root.nodes, "nodes", child.value(), place)?;
            if let Some(other) = parents[child.value()].replace(index) {
                let message = format!("nodes[{}] is a child of nodes[{other}] already", child.value());
                return Err(fault(place(), message));
            }
        }
    }
    Ok(parents)
}

/// All nodes, parents first.
fn order(root: &Root, parents: &[Option<usize>]) -> Parsed<Vec<usize>> {
    let mut order: Vec<usize> = (0..parents.len()).filter(|&node| parents[node].is_none()).collect();
    let mut next = 0;
    while let Some(&node) = order.get(next) {
        order.extend(root.nodes[node].children.iter().flatten().map(|child| child.value()));
        next += 1;
    }
    if order.len() == parents.len() {
        return Ok(order);
    }
    // What no root reaches hangs on a cycle: walk up until a node comes again.
    let mut seen = vec![false; parents.len()];
    for &node in &order {
        seen[node] = true;
    }
    let mut node = seen.iter().position(|seen| !seen).unwrap_or_default();
    while !std::mem::replace(&mut seen[node], true) {
        node = parents[node].unwrap_or(node);
    }
    Err(fault(format!("nodes[{node}]"), "is its own ancestor"))
}

fn shown(root: &Root, parents: &[Option<usize>], order: &[usize]) -> Parsed<Vec<usize>> {
    let scene = match root.scene {
        Some(index) => Some((index.value(), item(&root.scenes, "scenes", index.value(), || "scene".into())?)),
        None => root.scenes.first().map(|scene| (0, scene)),
    };
    let Some((index, scene)) = scene else {
        return Ok((0..parents.len()).collect());
    };
    let mut in_scene = vec![false; parents.len()];
    for (which, node) in scene.nodes.iter().enumerate() {
        item(&root.nodes, "nodes", node.value(), || format!("scenes[{index}].nodes[{which}]"))?;
        in_scene[node.value()] = true;
    }
    for &node in order {
        in_scene[node] |= parents[node].is_some_and(|parent| in_scene[parent]);
    }
    Ok((0..parents.len()).filter(|&node| in_scene[node]).collect())
}

/// A node's transform into its parent's space: the file's, but for what a pose says.
fn local_transform(node: &scene::Node, index: usize, pose: Option<&NodePose>) -> Parsed<DAffine3> {
    let place = |member: &str| format!("nodes[{index}].{member}");
    if let Some(matrix) = node.matrix {
        return affine(matrix).ok_or_else(|| fault(place("matrix"), NO_AFFINE));
    }
    let vector =
        |value: Option<[f32; 3]>, default: f64, member: &str| match value.map(|v| DVec3::from(v.map(f64::from))) {
            Some(vector) if !vector.is_finite() => Err(fault(place(member), "expected finite numbers")),
            Some(vector) => Ok(vector),
            None => Ok(DVec3::splat(default)),
        };
    let mut translation = vector(node.translation, 0.0, "translation")?;
    let mut scale = vector(node.scale, 1.0, "scale")?;
    let mut rotation = match &node.rotation {
        Some(rotation) => {
            rotation_of(rotation.0).ok_or_else(|| fault(place("rotation"), "expected a unit quaternion"))?
        }
        None => DQuat::IDENTITY,
    };
    if let Some(pose) = pose {
        translation = pose.translation.unwrap_or(translation);
        rotation = pose.rotation.unwrap_or(rotation);
        scale = pose.scale.unwrap_or(scale);
    }
    Ok(DAffine3::from_scale_rotation_translation(scale, rotation, translation))
}

/// What is wrong with a matrix that is not [`affine`].
pub(super) const NO_AFFINE: &str = "expected finite numbers with a last row of 0, 0, 0, 1";

/// A matrix of a file, columns first; none when it is no affine transform.
pub(super) fn affine(matrix: [f32; 16]) -> Option<DAffine3> {
    let matrix = DMat4::from_cols_array(&matrix.map(f64::from));
    // A few roundings of f32 are let pass, a projection isn't.
    let off = (matrix.row(3) - glam::DVec4::W).abs().max_element();
    (matrix.is_finite() && off <= 8.0 * f64::from(f32::EPSILON)).then(|| DAffine3::from_mat4(matrix))
}

/// The rotation of a quaternion of `f32` of about unit length; none when it has no direction.
pub(super) fn rotation_of(quaternion: [f32; 4]) -> Option<DQuat> {
    let quaternion = DQuat::from_array(quaternion.map(f64::from));
    let length = quaternion.length();
    (length.is_finite() && length > 0.0).then(|| quaternion / length)
}
