//! How a light is divided: points on a grid that is refined where it matters, and what each of them counts.

use std::collections::HashMap;

use glam::DVec2;

/// A light's points and its cells.
#[derive(Debug, Clone)]
pub struct Tree {
    nodes: Nodes,
    is_line: bool,
    max_depth: u32,
    /// On the grid of the smallest cells there may be; of a line, y is 0.
    points: Vec<[u32; 2]>,
    number_of: HashMap<[u32; 2], usize>,
    /// Cells that are not divided.
    leaves: Vec<Cell>,
}

/// A part of the light: a square, or a segment of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cell {
    /// Its lowest corner, on the tree's grid.
    low: [u32; 2],
    /// How often the light was divided to get it.
    pub depth: u32,
    /// Numbers of the points at its corners: low, right, upper, far; of a segment start and end, each twice. Or its only point.
    pub points: [usize; 4],
}

/// Where the points of cells are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Nodes {
    /// One in the middle of each cell, which is divided in three along each side: its point is its middle part's.
    Centers,
    /// At the corners of cells, shared between them, which are divided in two (the paper).
    Corners,
}

/// A point that a division has added.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Added {
    /// Its number.
    pub point: usize,
    /// Which of the divided cells touch it.
    pub cells: Vec<usize>,
}

/// What the points of a tree count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Weights {
    /// Each cell's area, a quarter to each of its corners (of a segment, half of its length to either end; or all to its middle):
    /// right however unevenly the light is divided.
    Trapezoid,
    /// The paper's Eq. 5 and 6, normalised: 1/(2^d + 1) for each dimension, d being the depth of the smallest cell at the point.
    Paper,
    /// All the same: what is left where maps are added up before the tree is known.
    Equal,
}

impl Tree {
    /// A line or a square, divided evenly `min_depth` times.
    pub fn new(nodes: Nodes, is_line: bool, min_depth: u32, max_depth: u32) -> Self {
        let (points, number_of, leaves) = (Vec::new(), HashMap::new(), Vec::new());
        let mut tree = Self { nodes, is_line, max_depth, points, number_of, leaves };
        let whole = tree.cell([0, 0], 0, &mut |_| {});
        tree.leaves.push(whole);
        for _ in 0..min_depth.min(max_depth) {
            let leaves = tree.leaves.clone();
            tree.divide(&leaves);
        }
        tree
    }

    /// How many points there are.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether it divides a line.
    pub fn is_line(&self) -> bool {
        self.is_line
    }

    /// Cells that are not divided.
    pub fn leaves(&self) -> &[Cell] {
        &self.leaves
    }

    /// Whether a cell may be divided.
    pub fn is_divisible(&self, cell: &Cell) -> bool {
        cell.depth < self.max_depth
    }

    /// In how many parts each side of a cell is divided.
    fn parts(&self) -> u32 {
        match self.nodes {
            Nodes::Centers => 3,
            Nodes::Corners => 2,
        }
    }

    /// The side of cells of a depth, in the smallest ones.
    fn side(&self, depth: u32) -> u32 {
        self.parts().pow(self.max_depth - depth)
    }

    /// How often it is divided at most.
    pub fn depth(&self) -> u32 {
        self.leaves.iter().map(|leaf| leaf.depth).max().unwrap_or(0)
    }

    /// The side of cells of a depth, as a fraction of the light's.
    pub fn side_at(&self, depth: u32) -> f64 {
        f64::from(self.parts()).powi(-(depth as i32))
    }

    /// A point's place on the unit square; of a line, in the middle of y.
    pub fn place(&self, point: usize) -> DVec2 {
        let whole = f64::from(self.side(0));
        let offset = if self.nodes == Nodes::Centers { 0.5 } else { 0.0 };
        let [x, y] = self.points[point].map(|at| (f64::from(at) + offset) / whole);
        DVec2::new(x, if self.is_line { 0.5 } else { y })
    }

    /// The points that tell whether a cell must be divided: its own, or, if it has but one, those of the cells beside it. The first
    /// and the last are opposed, and so are the others.
    pub fn around(&self, cell: &Cell) -> [usize; 4] {
        if self.nodes == Nodes::Corners {
            return cell.points;
        }
        let (whole, side) = (self.side(0), self.side(cell.depth));
        let [x, y] = self.points[cell.points[0]];
        let beside = |x: Option<u32>, y: Option<u32>| {
            let inside = |at: Option<u32>| at.filter(|&at| at < whole);
            let (Some(x), Some(y)) = (inside(x), inside(y)) else { return cell.points[0] };
            // As large, or the larger one that is not divided: the middle of what has been divided is still a point.
            let middle = |depth: u32, at: u32| at / self.side(depth) * self.side(depth) + self.side(depth) / 2;
            let at = |depth: u32| [middle(depth, x), if self.is_line { 0 } else { middle(depth, y) }];
            let found = (0..=cell.depth).rev().find_map(|depth| self.number_of.get(&at(depth)));
            *found.expect("the whole light has a middle")
        };
        let across = |up: Option<u32>| if self.is_line { None } else { up };
        [
            beside(x.checked_sub(side), Some(y)),
            beside(Some(x), across(y.checked_sub(side))),
            beside(Some(x), across(y.checked_add(side))),
            beside(x.checked_add(side), Some(y)),
        ]
    }

    /// How many points dividing a cell would add.
    pub fn cost(&self, cell: &Cell) -> usize {
        let side = self.side(cell.depth + 1);
        let mut added = Vec::new();
        for low in self.lows(cell) {
            let corners = self.corners(low, side);
            added.extend(corners.into_iter().filter(|at| !self.number_of.contains_key(at)));
        }
        added.sort_unstable();
        added.dedup();
        added.len()
    }

    /// The lowest corners of a cell's parts.
    fn lows(&self, cell: &Cell) -> Vec<[u32; 2]> {
        let (parts, side) = (self.parts(), self.side(cell.depth + 1));
        let [x, y] = cell.low;
        let rows = if self.is_line { 1 } else { parts };
        (0..rows * parts).map(|i| [x + i % parts * side, y + i / parts * side]).collect()
    }

    /// Where the points of a cell are.
    fn corners(&self, [x, y]: [u32; 2], side: u32) -> [[u32; 2]; 4] {
        let across = |y: u32| if self.is_line { 0 } else { y };
        match self.nodes {
            Nodes::Centers => [[x + side / 2, across(y + side / 2)]; 4],
            Nodes::Corners => [[x, y], [x + side, y], [x, across(y + side)], [x + side, across(y + side)]],
        }
    }

    /// Divides leaves, which must be divisible: their parts, and the points that this adds.
    pub fn divide(&mut self, cells: &[Cell]) -> (Vec<Cell>, Vec<Added>) {
        let (mut parts, mut added): (Vec<Cell>, Vec<Added>) = (Vec::new(), Vec::new());
        self.leaves.retain(|leaf| !cells.contains(leaf));
        let first = self.points.len();
        for (index, cell) in cells.iter().enumerate() {
            for low in self.lows(cell) {
                let part = self.cell(low, cell.depth + 1, &mut |point| {
                    if point < first {
                        return;
                    }
                    if point - first == added.len() {
                        added.push(Added { point, cells: Vec::new() });
                    }
                    let touching = &mut added[point - first].cells;
                    if touching.last() != Some(&index) {
                        touching.push(index);
                    }
                });
                parts.push(part);
            }
        }
        self.leaves.extend(&parts);
        (parts, added)
    }

    /// A cell with its points, added where they are new; `touched` is told each of them.
    fn cell(&mut self, low: [u32; 2], depth: u32, touched: &mut dyn FnMut(usize)) -> Cell {
        let points = self.corners(low, self.side(depth)).map(|at| {
            let next = self.points.len();
            let number = *self.number_of.entry(at).or_insert(next);
            if number == next {
                self.points.push(at);
            }
            touched(number);
            number
        });
        Cell { low, depth, points }
    }

    /// What each point counts. Those of [`Weights::Trapezoid`] and [`Weights::Equal`] are whole numbers, which sum without
    /// rounding: four times the square of the smallest cells along a side is less than 2^24 up to 7 divisions in two, or 6 in three.
    pub fn weights(&self, weights: Weights) -> Vec<f64> {
        let mut all = vec![0.0; self.points.len()];
        let dimensions = if self.is_line { 1 } else { 2 };
        match weights {
            Weights::Equal => all.fill(1.0),
            Weights::Trapezoid => {
                for leaf in &self.leaves {
                    let area = f64::from(self.side(leaf.depth)).powi(dimensions);
                    for point in leaf.points {
                        all[point] += area;
                    }
                }
            }
            Weights::Paper => {
                let mut depths = vec![0; self.points.len()];
                for leaf in &self.leaves {
                    for point in leaf.points {
                        depths[point] = leaf.depth.max(depths[point]);
                    }
                }
                let weight = |depth: u32| (f64::from(1u32 << depth) + 1.0).powi(-dimensions);
                all = depths.into_iter().map(weight).collect();
            }
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The light's square divided `depth` times in its lowest corner, and once elsewhere.
    fn uneven(nodes: Nodes, is_line: bool, depth: u32) -> Tree {
        let mut tree = Tree::new(nodes, is_line, 0, depth);
        for _ in 0..depth {
            let deepest = tree.leaves.iter().map(|leaf| leaf.depth).max().expect("leaves");
            let corner = |leaf: &&Cell| leaf.low == [0, 0] && leaf.depth == deepest;
            let chosen = *tree.leaves.iter().find(corner).expect("the lowest corner has a leaf");
            tree.divide(&[chosen]);
        }
        tree
    }

    /// The estimate of the light's share where `function` of the place is 1, by weights.
    fn estimate(tree: &Tree, weights: Weights, function: impl Fn(DVec2) -> f64) -> f64 {
        let weights = tree.weights(weights);
        let sum: f64 = weights.iter().enumerate().map(|(point, weight)| weight * function(tree.place(point))).sum();
        sum / weights.iter().sum::<f64>()
    }

    #[test]
    fn an_even_tree_is_the_papers_grid() {
        for (depth, line, square) in [(0, 2, 4), (1, 3, 9), (2, 5, 25), (3, 9, 81), (7, 129, 16_641)] {
            assert_eq!(Tree::new(Nodes::Corners, true, depth, depth).len(), line);
            assert_eq!(Tree::new(Nodes::Corners, false, depth, depth).len(), square);
        }
        let tree = Tree::new(Nodes::Corners, false, 2, 4);
        // Eq. 6: 1/(2^d + 1)^2 each, which sums to 1 without normalising.
        assert!(tree.weights(Weights::Paper).iter().all(|&weight| weight == 1.0 / 25.0));
        // A quarter of a cell at the light's corners, half of one on its edges.
        let weights = tree.weights(Weights::Trapezoid);
        let weight = |x: f64, y: f64| {
            let point = (0..tree.len()).find(|&point| tree.place(point) == DVec2::new(x, y));
            weights[point.expect("a point of the grid")] / weights.iter().sum::<f64>()
        };
        assert_eq!([weight(0.0, 0.0), weight(0.25, 0.0), weight(0.5, 0.75)], [1.0 / 64.0, 1.0 / 32.0, 1.0 / 16.0]);
    }

    #[test]
    fn the_cost_of_a_division_is_what_it_adds() {
        for is_line in [true, false] {
            let mut tree = Tree::new(Nodes::Corners, is_line, 1, 4);
            let leaves = tree.leaves().to_vec();
            for leaf in &leaves[..leaves.len().min(3)] {
                let before = tree.len();
                let cost = tree.cost(leaf);
                let (parts, added) = tree.divide(&[*leaf]);
                assert_eq!(tree.len() - before, cost);
                assert_eq!(added.len(), cost);
                assert_eq!(parts.len(), if is_line { 2 } else { 4 });
                assert!(added.iter().all(|added| added.cells == [0]));
            }
        }
        // The middle of the side that two cells share is added once, for both.
        let mut tree = Tree::new(Nodes::Corners, false, 1, 2);
        let leaves = tree.leaves().to_vec();
        let (_, added) = tree.divide(&leaves[..2]);
        assert_eq!(added.len(), 9);
        assert_eq!(added.iter().filter(|added| added.cells == [0, 1]).count(), 1);
    }

    #[test]
    fn trapezoid_weights_are_exact_for_what_is_linear_however_uneven_the_tree() {
        for (nodes, is_line) in
            [Nodes::Corners, Nodes::Centers].into_iter().flat_map(|nodes| [(nodes, true), (nodes, false)])
        {
            for depth in 0..=5 {
                let tree = uneven(nodes, is_line, depth);
                // The mean over the light of a linear function is its value in the middle.
                for (a, b) in [(1.0, 0.0), (0.25, 0.5), (-1.0, 1.0)] {
                    let found = estimate(&tree, Weights::Trapezoid, |at| a * at.x + b * at.y);
                    assert!((found - 0.5 * (a + b)).abs() < 1e-15, "{nodes:?} {is_line} {depth}: {found}");
                }
            }
        }
    }

    #[test]
    fn the_papers_weights_are_biased_on_an_uneven_tree() {
        // Mean over 1000 edges across the light, each with its mirror image: a fair estimate is off by nothing on average only if
        // it does not favour where the tree is dense. The light's lowest corner is divided five times, the rest once.
        let tree = uneven(Nodes::Corners, false, 5);
        let bias = |weights: Weights| {
            let error = |i: u32| {
                let at = (f64::from(i) + 0.5) / 1000.0;
                estimate(&tree, weights, |place| f64::from(u8::from(place.x < at))) - at
            };
            (0..1000).map(error).sum::<f64>() / 1000.0
        };
        let [trapezoid, paper, equal] = [Weights::Trapezoid, Weights::Paper, Weights::Equal].map(bias);
        assert!(trapezoid.abs() < 1e-3, "{trapezoid}");
        // Each of the few points in the dense corner counts a quarter as much as those around it, which is too little; all alike is
        // too much.
        assert!(paper < -0.05, "{paper}");
        assert!(equal > 0.05, "{equal}");
    }

    #[test]
    fn centers_are_the_middles_of_cells_and_stay() {
        for (depth, line, square) in [(0, 1, 1), (1, 3, 9), (2, 9, 81), (3, 27, 729)] {
            assert_eq!(Tree::new(Nodes::Centers, true, depth, depth).len(), line);
            assert_eq!(Tree::new(Nodes::Centers, false, depth, depth).len(), square);
        }
        let mut tree = Tree::new(Nodes::Centers, false, 1, 2);
        let before: Vec<DVec2> = (0..tree.len()).map(|point| tree.place(point)).collect();
        let middle =
            *tree.leaves().iter().find(|leaf| tree.place(leaf.points[0]) == DVec2::splat(0.5)).expect("a middle");
        // Left of it, below, above, and right of it.
        let beside = tree.around(&middle).map(|point| tree.place(point));
        assert_eq!(
            beside.map(|at| (6.0 * at).round()),
            [[1.0, 3.0], [3.0, 1.0], [3.0, 5.0], [5.0, 3.0]].map(DVec2::from)
        );
        assert_eq!(tree.cost(&middle), 8);
        let (parts, added) = tree.divide(&[middle]);
        assert_eq!((parts.len(), added.len()), (9, 8));
        assert!(added.iter().all(|added| added.cells == [0]));
        assert!(before.iter().enumerate().all(|(point, &at)| tree.place(point) == at));
        // Beside a part at the edge of the middle lies an undivided cell, beyond the light nothing.
        let part = parts.iter().find(|part| (18.0 * tree.place(part.points[0])).round() == DVec2::new(7.0, 9.0));
        let part = part.expect("the part left of the middle");
        let beside = tree.around(part).map(|point| (18.0 * tree.place(point)).round());
        assert_eq!(beside, [[3.0, 9.0], [7.0, 7.0], [7.0, 11.0], [9.0, 9.0]].map(DVec2::from));
        let corner = *tree.leaves().iter().find(|leaf| leaf.low == [0, 0]).expect("a corner");
        let own = corner.points[0];
        let beside = tree.around(&corner);
        assert_eq!([beside[0], beside[1]], [own, own]);
    }

    #[test]
    fn whole_weights_sum_without_rounding() {
        for (nodes, depth) in [(Nodes::Corners, 7), (Nodes::Centers, 6)] {
            let sum: f64 = Tree::new(nodes, false, 0, depth).weights(Weights::Trapezoid).iter().sum();
            assert!(sum <= f64::from(1 << 24), "{nodes:?}");
        }
    }
}
