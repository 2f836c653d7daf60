//! An eight-wide bounding volume hierarchy of triangles or boxes: `obvhs` builds a binary tree, which is collapsed here.
//!
//! It holds `f32` approximations in *normalised* coordinates, of magnitude at most one, and only ever rules things out: boxes
//! are rounded outwards and the triangle test keeps whatever its error bound can't exclude. Who asks decides in `f64`. So
//! neither the shape of the tree nor the instruction set can change an answer.

use glam::DVec3;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::node::Bvh2Node;
use obvhs::bvh2::reinsertion::ReinsertionOptimizer;
use obvhs::ploc::{PlocBuilder, SortPrecision};
use rayon::prelude::*;

/// Children a node, and triangles a leaf.
pub const WIDTH: usize = 8;

/// Marks a child that is a leaf.
pub const LEAF: u32 = 1 << 31;

/// Eight child boxes: `bounds[axis][0]` the minima, `bounds[axis][1]` the maxima. An unused child is an empty box.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(32))]
pub struct Node {
    /// Child boxes by axis, minimum and maximum, child.
    pub bounds: [[[f32; WIDTH]; 2]; 3],
    /// Index of a node, or [`LEAF`] plus the index of a leaf.
    pub children: [u32; WIDTH],
}

/// Up to eight triangles.
#[derive(Debug, Clone, Copy)]
#[repr(C, align(32))]
pub struct Leaf {
    /// First corner by axis.
    pub corner: [[f32; WIDTH]; 3],
    /// Second corner minus first.
    pub edge1: [[f32; WIDTH]; 3],
    /// Third corner minus first.
    pub edge2: [[f32; WIDTH]; 3],
    /// Largest absolute component of both edges; negative for an unused slot.
    pub size: [f32; WIDTH],
    /// Index of the primitive given to [`Tree::build`].
    pub primitive: [u32; WIDTH],
}

/// A tree over primitives: `T` is [`Leaf`] for triangles, a primitive index for boxes.
#[derive(Debug, Clone, Default)]
pub struct Tree<T> {
    /// The root is node 0; empty when there is nothing.
    pub nodes: Vec<Node>,
    /// What the leaves hold.
    pub leaves: Vec<T>,
}

const EMPTY_NODE: Node =
    Node { bounds: [[[f32::INFINITY; WIDTH], [f32::NEG_INFINITY; WIDTH]]; 3], children: [LEAF; WIDTH] };

impl Leaf {
    /// No triangle.
    pub const EMPTY: Self = Self {
        corner: [[0.0; WIDTH]; 3],
        edge1: [[0.0; WIDTH]; 3],
        edge2: [[0.0; WIDTH]; 3],
        size: [-1.0; WIDTH],
        primitive: [u32::MAX; WIDTH],
    };

    /// Puts a triangle into a slot.
    pub fn set(&mut self, slot: usize, primitive: u32, [a, b, c]: [DVec3; 3]) {
        let (edge1, edge2) = (b - a, c - a);
        for axis in 0..3 {
            self.corner[axis][slot] = a[axis] as f32;
            self.edge1[axis][slot] = edge1[axis] as f32;
            self.edge2[axis][slot] = edge2[axis] as f32;
        }
        let size = edge1.abs().max_element().max(edge2.abs().max_element()) as f32;
        self.size[slot] = size.next_up();
        self.primitive[slot] = primitive;
    }
}

impl<T> Tree<T> {
    /// Builds over `count` primitives with the given boxes; `leaf` packs the primitives of one leaf, at most `leaf_size` of
    /// them.
    pub fn build(
        count: u32,
        box_of: impl Fn(u32) -> Aabb + Sync,
        leaf_size: u32,
        leaf: impl Fn(&[u32]) -> T + Sync,
    ) -> Self
    where
        T: Send,
    {
        if count == 0 {
            return Self { nodes: Vec::new(), leaves: Vec::new() };
        }
        let mut collapse = Collapse::new(build_binary(count, box_of), leaf_size);
        let nodes = collapse.run();
        let Collapse { leaf_primitives, leaf_starts, .. } = collapse;
        let range = |i: usize| leaf_starts[i] as usize..leaf_starts[i + 1] as usize;
        let leaves = (0..leaf_starts.len() - 1)
            .into_par_iter()
            .with_min_len(512)
            .map(|i| leaf(&leaf_primitives[range(i)]))
            .collect();
        Self { nodes, leaves }
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        self.nodes.capacity() * size_of::<Node>() + self.leaves.capacity() * size_of::<T>()
    }
}

/// Neighbours on the Morton curve that the builder looks at on each side, and the passes before it looks beyond the next
/// one: `obvhs`'s fast preset.
const PLOC_SEARCH_DISTANCE: usize = 6;
const PLOC_PASSES_OF_DISTANCE_1: usize = 2;

/// Share of the nodes that are tried in a better place: `obvhs`'s fast preset. Ten times as much spares rays 2 to 8 % of the
/// nodes and makes the build 2.4 times as long.
const REINSERTION_RATIO: f32 = 0.02;

/// A binary tree with one primitive a leaf, the primitive's number in its `first_index`.
fn build_binary(count: u32, box_of: impl Fn(u32) -> Aabb + Sync) -> Bvh2 {
    let mut builder = PlocBuilder::new();
    builder.current_nodes = (0..count)
        .into_par_iter()
        .with_min_len(4096)
        .map(|primitive| Bvh2Node::new(box_of(primitive), 1, primitive))
        .collect();
    let bounds = builder.current_nodes.par_iter().map(|node| *node.aabb()).reduce(Aabb::empty, |a, b| a.union(&b));
    let mut binary = Bvh2::default();
    builder.build_ploc_from_leaves::<PLOC_SEARCH_DISTANCE, false>(
        &mut binary,
        bounds,
        SortPrecision::U64,
        PLOC_PASSES_OF_DISTANCE_1,
    );
    drop(builder);
    ReinsertionOptimizer::default().run(&mut binary, REINSERTION_RATIO, None);
    binary
}

/// Cost of testing a wide node's boxes and a leaf's triangles, relative to each other, from a profile. Leaf costs from 1 to 2
/// change what rays visit by less than 1 %.
const NODE_COST: f32 = 1.0;
const LEAF_COST: f32 = 1.5;

/// Turns the binary tree into the wide tree of the lowest surface area cost that can be had by leaving out binary nodes
/// (Ylitie, Karras and Laine 2017, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", section 3.1).
struct Collapse {
    binary: Bvh2,
    /// Primitives below each binary node.
    counts: Vec<u32>,
    /// Lowest cost of a binary node's subtree as at most 1, 2, … 7 children of a wide node.
    costs: Vec<[f32; WIDTH - 1]>,
    leaf_size: u32,
    /// Primitives in the order of leaves, and where each leaf's start, with the end of the last.
    leaf_primitives: Vec<u32>,
    leaf_starts: Vec<u32>,
}

impl Collapse {
    fn new(binary: Bvh2, leaf_size: u32) -> Self {
        let mut collapse = Self {
            counts: vec![0; binary.nodes.len()],
            costs: vec![[0.0; WIDTH - 1]; binary.nodes.len()],
            leaf_size,
            leaf_primitives: Vec::new(),
            leaf_starts: vec![0],
            binary,
        };
        // Children after their parents.
        let mut order = Vec::with_capacity(collapse.binary.nodes.len());
        order.push(0);
        for at in 0.. {
            let Some(&index) = order.get(at) else { break };
            if let Some([left, right]) = collapse.halves(index as usize) {
                order.extend([left as u32, right as u32]);
            }
        }
        for &index in order.iter().rev() {
            collapse.weigh(index as usize);
        }
        collapse
    }

    /// The children of a binary node that is not a leaf.
    fn halves(&self, index: usize) -> Option<[usize; 2]> {
        let node = &self.binary.nodes[index];
        let first = node.first_index as usize;
        (!node.is_leaf()).then_some([first, first + 1])
    }

    fn leaf_cost(&self, index: usize) -> f32 {
        let fits = self.counts[index] <= self.leaf_size;
        if fits { LEAF_COST * self.binary.nodes[index].aabb().half_area() } else { f32::INFINITY }
    }

    /// Finds a node's count and costs from those of its children.
    fn weigh(&mut self, index: usize) {
        let Some([left, right]) = self.halves(index) else {
            self.counts[index] = 1;
            self.costs[index] = [self.leaf_cost(index); WIDTH - 1];
            return;
        };
        self.counts[index] = self.counts[left] + self.counts[right];
        let as_node = NODE_COST * self.binary.nodes[index].aabb().half_area() + self.best_split([left, right], WIDTH).1;
        let mut costs = [self.leaf_cost(index).min(as_node); WIDTH - 1];
        for children in 2..WIDTH {
            costs[children - 1] = costs[children - 2].min(self.best_split([left, right], children).1);
        }
        self.costs[index] = costs;
    }

    /// How many of so many children to spend on the left half, and the cost.
    fn best_split(&self, [left, right]: [usize; 2], children: usize) -> (usize, f32) {
        let (left, right) = (&self.costs[left], &self.costs[right]);
        let mut best = (1, f32::INFINITY);
        for on_left in 1..children {
            let cost = left[on_left - 1] + right[children - on_left - 1];
            if cost < best.1 {
                best = (on_left, cost);
            }
        }
        best
    }

    /// The wide nodes; leaves are listed.
    fn run(&mut self) -> Vec<Node> {
        let mut nodes = vec![EMPTY_NODE];
        let mut children = Vec::with_capacity(WIDTH);
        // A binary node still to be turned into the wide node reserved for it.
        let mut open = vec![(0usize, 0usize)];
        while let Some((binary_index, wide_index)) = open.pop() {
            children.clear();
            self.choose_children(binary_index, &mut children);
            let mut wide = EMPTY_NODE;
            for (slot, &child) in children.iter().enumerate() {
                let aabb = self.binary.nodes[child].aabb();
                for axis in 0..3 {
                    wide.bounds[axis][0][slot] = aabb.min[axis];
                    wide.bounds[axis][1][slot] = aabb.max[axis];
                }
                wide.children[slot] = if self.is_leaf(child) {
                    self.gather(child);
                    self.leaf_starts.push(self.leaf_primitives.len() as u32);
                    LEAF | (self.leaf_starts.len() - 2) as u32
                } else {
                    nodes.push(EMPTY_NODE);
                    open.push((child, nodes.len() - 1));
                    (nodes.len() - 1) as u32
                };
            }
            nodes[wide_index] = wide;
        }
        nodes.shrink_to_fit();
        nodes
    }

    fn is_leaf(&self, index: usize) -> bool {
        self.leaf_cost(index) <= self.costs[index][0]
    }

    /// The children of the wide node that stands for a binary one.
    fn choose_children(&self, root: usize, chosen: &mut Vec<usize>) {
        let Some(halves) = self.halves(root).filter(|_| !self.is_leaf(root)) else {
            chosen.push(root);
            return;
        };
        let on_left = self.best_split(halves, WIDTH).0;
        self.spend(halves[0], on_left, chosen);
        self.spend(halves[1], WIDTH - on_left, chosen);
    }

    /// Makes a subtree at most so many children.
    fn spend(&self, index: usize, children: usize, chosen: &mut Vec<usize>) {
        let costs = &self.costs[index];
        match self.halves(index) {
            Some(halves) if costs[children - 1] < costs[0] => {
                let on_left = self.best_split(halves, children).0;
                self.spend(halves[0], on_left, chosen);
                self.spend(halves[1], children - on_left, chosen);
            }
            _ => chosen.push(index),
        }
    }

    /// Lists the primitives of a leaf.
    fn gather(&mut self, index: usize) {
        match self.halves(index) {
            Some(halves) => halves.into_iter().for_each(|half| self.gather(half)),
            None => self.leaf_primitives.push(self.binary.nodes[index].first_index),
        }
    }
}
