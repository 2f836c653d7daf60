//! Which triangles may lie in a convex region with few planes, such as the pyramid of a receiver and a light.

use glam::DVec3;

use super::wide::{LEAF, Node, Tree, WIDTH};
use super::{Entry, Normalized, SceneBvh, Scratch};

/// A half space: points x with `normal·(x − apex) ≤ offset`.
#[derive(Debug, Clone, Copy)]
pub struct Plane {
    /// Outward, of any length.
    pub normal: DVec3,
    /// Along it.
    pub offset: f64,
}

/// A bound on the roundings of a transformed plane's terms, relative to their magnitudes: a dozen of 2⁻⁵³.
const ROUNDING: f64 = 32.0 * f64::EPSILON;

/// A plane in a tree's coordinates, which lie in [0, 1]: a box is outside where its nearest corner is beyond the offset.
#[derive(Debug, Clone, Copy)]
struct TreePlane {
    normal: [f64; 3],
    /// For each axis, whether the box's maximum is its nearest side.
    nearest: [usize; 3],
    offset: f64,
}

impl TreePlane {
    fn new(normal: DVec3, offset: f64, error: f64) -> Self {
        Self {
            normal: normal.to_array(),
            nearest: normal.to_array().map(|n| usize::from(n < 0.0)),
            offset: offset + error + ROUNDING * (normal.abs().element_sum() + offset.abs()),
        }
    }
}

impl SceneBvh<'_> {
    /// Visits every triangle (instance and number) that may have a point in all of the half spaces.
    pub fn in_pyramid(&self, apex: DVec3, planes: &[Plane], scratch: &mut Scratch, mut visit: impl FnMut(u32, u32)) {
        let Scratch { top, group: stack } = scratch;
        let (top, stack) = (&mut top.any, &mut stack.any);
        let mut tree_planes = Vec::with_capacity(planes.len());
        if let [entry] = self.entries.as_slice() {
            return self.group_in_pyramid(entry, apex, planes, &mut tree_planes, stack, &mut visit);
        }
        place(planes, apex, &self.top_space, &mut tree_planes);
        let mut found = Vec::new();
        traverse(&self.top, &tree_planes, top, |&entry| found.push(entry));
        for entry in found {
            self.group_in_pyramid(&self.entries[entry as usize], apex, planes, &mut tree_planes, stack, &mut visit);
        }
    }

    fn group_in_pyramid(
        &self,
        entry: &Entry,
        apex: DVec3,
        planes: &[Plane],
        tree_planes: &mut Vec<TreePlane>,
        stack: &mut Vec<u32>,
        visit: &mut impl FnMut(u32, u32),
    ) {
        let group = &self.groups[entry.group as usize];
        match entry.instance {
            None => place(planes, apex, &group.space, tree_planes),
            Some(instance) => {
                let frame = &self.frames[instance as usize];
                let linear = self.scene.instances[instance as usize].scene_from_mesh.matrix3;
                tree_planes.clear();
                tree_planes.extend(planes.iter().map(|plane| {
                    // normal·(linear·m + anchor − apex) ≤ offset, m relative to the mesh's lowest corner.
                    let normal = linear.transpose() * plane.normal;
                    let offset = plane.offset + plane.normal.dot(apex - frame.anchor_scene);
                    let magnitude = plane.normal.abs().dot(apex.abs() + frame.anchor_scene.abs());
                    let growth = super::absolute(&linear).transpose() * plane.normal.abs();
                    let error = ROUNDING * magnitude
                        + plane.normal.abs().dot(frame.anchor_error)
                        + ROUNDING * growth.element_sum() / group.space.scale;
                    TreePlane::new(normal, offset * group.space.scale, error * group.space.scale)
                }));
            }
        }
        traverse(&group.tree, tree_planes, stack, |leaf| {
            for (slot, &primitive) in leaf.primitive.iter().enumerate() {
                if leaf.size[slot] >= 0.0 {
                    let (instance, triangle) = group.locate(entry, primitive);
                    visit(instance, triangle);
                }
            }
        });
    }
}

/// The planes in the coordinates of a tree over scene space.
fn place(planes: &[Plane], apex: DVec3, space: &Normalized, placed: &mut Vec<TreePlane>) {
    placed.clear();
    placed.extend(planes.iter().map(|plane| {
        let offset = plane.offset + plane.normal.dot(apex - space.origin);
        let magnitude = plane.normal.abs().dot(apex.abs() + space.origin.abs());
        let error = ROUNDING * magnitude * space.scale + plane.normal.abs().element_sum() * space.origin_error;
        TreePlane::new(plane.normal, offset * space.scale, error)
    }));
}

fn traverse<T>(tree: &Tree<T>, planes: &[TreePlane], stack: &mut Vec<u32>, mut visit: impl FnMut(&T)) {
    if tree.nodes.is_empty() {
        return;
    }
    stack.clear();
    stack.push(0);
    while let Some(at) = stack.pop() {
        if at & LEAF != 0 {
            visit(&tree.leaves[(at ^ LEAF) as usize]);
            continue;
        }
        let node = &tree.nodes[at as usize];
        let outside = outside(node, planes);
        for (slot, &child) in node.children.iter().enumerate() {
            if !outside[slot] {
                stack.push(child);
            }
        }
    }
}

/// Which child boxes, the empty ones included, lie beyond one of the planes.
fn outside(node: &Node, planes: &[TreePlane]) -> [bool; WIDTH] {
    let mut outside: [bool; WIDTH] = std::array::from_fn(|slot| node.bounds[0][0][slot] > node.bounds[0][1][slot]);
    for plane in planes {
        let sides: [&[f32; WIDTH]; 3] = std::array::from_fn(|axis| &node.bounds[axis][plane.nearest[axis]]);
        for slot in 0..WIDTH {
            let at = |axis: usize| plane.normal[axis] * f64::from(sides[axis][slot]);
            outside[slot] |= at(0) + at(1) + at(2) > plane.offset;
        }
    }
    outside
}
