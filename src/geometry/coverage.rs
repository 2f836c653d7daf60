//! What polygons leave uncovered of a square or a disc: area and pieces, without sampling.
//!
//! Polygons are given by their edges alone, each with the change of the number of polygons over a point that crosses it
//! upwards. What neighbours share cancels beforehand, so that a mesh costs what its outline costs; and nothing needs
//! polygons to be simple, disjoint or distinct.
//!
//! The plane is cut into slabs at every u where something changes: an edge begins or ends, two edges cross, one crosses the
//! circle. Within a slab the uncovered length L(u) is linear but for arcs, whose area is elementary, so that
//! ∫L du = (u₁ − u₀)·L(middle). There is no topology to be corrupted: L is continuous, and an event that rounding moves by δ
//! moves the area by O(δ) at most.
//!
//! The cost of slabs grows with the square of the edges side by side, so the square is cut into cells first until each holds
//! few; a cell without an edge is covered or not, and one below enough polygons is left out.

use glam::DVec2;
use robust::{Coord, orient2d};

use crate::scene::light::Domain;

/// Edges that a cell is not divided for: in the flat part of the time of whole images (a bunny, the demo, a cloud of leaves),
/// measured once from 8 to 256.
const CELL_EDGES: usize = 48;

/// A cell is not divided below this side: all of its area, 2⁻⁴⁸ of the square, is below what rounding leaves of the sum.
const MIN_CELL: f64 = 1.0 / 16_777_216.0;

/// Visits of an edge that the irradiance of a piece takes the time of: four integrals along its sides.
const TRAPEZOID_VISITS: u64 = 64;

/// An edge of a polygon, `from.x < to.x`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// Left end.
    pub from: DVec2,
    /// Right end.
    pub to: DVec2,
    /// Polygons above minus polygons below.
    pub weight: i32,
}

/// A part of the uncovered region between `u[0]` and `u[1]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trapezoid {
    /// Left and right end.
    pub u: [f64; 2],
    /// Lower border.
    pub lower: Border,
    /// Upper border.
    pub upper: Border,
}

/// The lower or upper border of a trapezoid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Border {
    /// Straight, with v at the left and right end.
    Line([f64; 2]),
    /// On the unit circle: the lower half below, the upper half above.
    Arc,
}

/// Memory of [`Coverage::uncovered`], and what it works on.
#[derive(Debug, Default)]
pub struct Coverage {
    edges: Vec<Edge>,
    /// Work that is left.
    budget: u64,
    wants_trapezoids: bool,
    /// The pieces found, where asked for.
    pub trapezoids: Vec<Trapezoid>,
    /// Whether anything was covered: no sum tells, for it rounds.
    pub is_touched: bool,
    area: f64,
    events: Vec<f64>,
    crossings: Vec<f64>,
    active: Vec<Active>,
    runs: Vec<Run>,
    next_runs: Vec<Run>,
}

/// More work than was allowed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OverBudget;

/// The part of an edge between two u.
#[derive(Debug, Clone, Copy)]
struct Part {
    edge: u32,
    from: f64,
    to: f64,
}

/// A change of the number of polygons along the lower side of a cell.
#[derive(Debug, Clone, Copy)]
struct Step {
    u: f64,
    change: i32,
}

#[derive(Debug, Clone, Copy)]
struct Cell {
    min: DVec2,
    max: DVec2,
}

/// An edge in a strip: v at its left and right end and in the middle of a slab.
#[derive(Debug, Clone, Copy)]
struct Active {
    part: Part,
    left: f64,
    right: f64,
    middle: f64,
}

/// Bounds an uncovered interval of a slab.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Side {
    /// The cell's lower or upper side.
    Cell,
    Arc,
    Edge(u32),
}

/// An uncovered interval that goes on from slab to slab.
#[derive(Debug, Clone, Copy)]
struct Run {
    lower: Side,
    upper: Side,
    start: f64,
}

impl Edge {
    /// The edge between two points in the order of a polygon's boundary, `count` times, or none if it is upright.
    pub fn new(start: DVec2, end: DVec2, count: i32) -> Option<Self> {
        if start.x < end.x {
            Some(Self { from: start, to: end, weight: count })
        } else if end.x < start.x {
            Some(Self { from: end, to: start, weight: -count })
        } else {
            None
        }
    }

    /// v at u, from the nearer end.
    fn v(&self, u: f64) -> f64 {
        let slope = (self.to.y - self.from.y) / (self.to.x - self.from.x);
        if u - self.from.x <= self.to.x - u {
            self.from.y + (u - self.from.x) * slope
        } else {
            self.to.y - (self.to.x - u) * slope
        }
    }

    /// u at v, which both ends enclose.
    fn u(&self, v: f64) -> f64 {
        let slope = (self.to.x - self.from.x) / (self.to.y - self.from.y);
        if (v - self.from.y).abs() <= (self.to.y - v).abs() {
            self.from.x + (v - self.from.y) * slope
        } else {
            self.to.x - (self.to.y - v) * slope
        }
    }

    /// Whether two edges cross, ends included: exactly (Shewchuk 1997, "Adaptive Precision Floating-Point Arithmetic").
    fn crosses(&self, other: &Self) -> bool {
        let coord = |p: DVec2| Coord { x: p.x, y: p.y };
        let side = |edge: &Self, p: DVec2| orient2d(coord(edge.from), coord(edge.to), coord(p));
        let divides = |edge: &Self, of: &Self| {
            let (a, b) = (side(edge, of.from), side(edge, of.to));
            !(a > 0.0 && b > 0.0 || a < 0.0 && b < 0.0)
        };
        divides(self, other) && divides(other, self)
    }

    /// Where the line of the edge meets the unit circle.
    fn circle_crossings(&self) -> impl Iterator<Item = f64> {
        let along = self.to - self.from;
        // From the point of the line that is nearest to the centre.
        let squared = along.length_squared();
        let nearest = self.from - along * (self.from.dot(along) / squared);
        let distance_squared = along.perp_dot(self.from).powi(2) / squared;
        let reach = along.x * ((1.0 - distance_squared) / squared).sqrt();
        // NaN where they don't meet, which no range holds.
        [nearest.x - reach, nearest.x + reach].into_iter()
    }
}

impl Cell {
    fn is_divisible(&self) -> bool {
        (self.max - self.min).max_element() > MIN_CELL
    }

    /// Whether the unit circle's line goes through it.
    fn meets_circle(&self) -> bool {
        let far = self.min.abs().max(self.max.abs());
        let near = self.nearest_to_center();
        far.length_squared() > 1.0 && near.length_squared() < 1.0
    }

    fn is_outside_circle(&self) -> bool {
        self.nearest_to_center().length_squared() >= 1.0
    }

    fn nearest_to_center(&self) -> DVec2 {
        DVec2::ZERO.clamp(self.min, self.max)
    }
}

/// The corners of the square, counter-clockwise.
pub const SQUARE: [DVec2; 4] = [DVec2::NEG_ONE, DVec2::new(1.0, -1.0), DVec2::ONE, DVec2::new(-1.0, 1.0)];

/// Half the length of the unit disc's chord at u.
pub fn half_chord(u: f64) -> f64 {
    ((1.0 - u) * (1.0 + u)).max(0.0).sqrt()
}

/// ∫ of [`half_chord`] from 0 to u.
fn half_chord_integral(u: f64) -> f64 {
    let half = half_chord(u);
    0.5 * (u * half + u.atan2(half))
}

impl Coverage {
    /// The uncovered area of [−1, 1]² or of the unit disc, and its [`Coverage::trapezoids`] where these are asked for.
    /// Polygons may reach beyond; each must be closed but for what lies above or beside the square.
    ///
    /// # Errors
    /// [`OverBudget`] where it would take more than `budget` visits of an edge in a slab; exchanges of neighbours and pieces count
    /// too.
    pub fn uncovered(
        &mut self,
        edges: impl IntoIterator<Item = Edge>,
        domain: Domain,
        wants_trapezoids: bool,
        budget: u64,
    ) -> Result<f64, OverBudget> {
        self.edges.clear();
        self.edges.extend(edges);
        // One order, whatever the edges came in: the same bits from the same scene.
        self.edges.sort_unstable_by(|a, b| {
            let key = |e: &Edge| [e.from.x, e.from.y, e.to.x, e.to.y];
            let order = key(a).into_iter().zip(key(b)).map(|(a, b)| a.total_cmp(&b)).find(|order| order.is_ne());
            order.unwrap_or(std::cmp::Ordering::Equal).then(a.weight.cmp(&b.weight))
        });
        self.trapezoids.clear();
        // A run may be left open by a region that went over its budget.
        self.runs.clear();
        self.wants_trapezoids = wants_trapezoids;
        self.budget = budget;
        self.area = 0.0;
        self.is_touched = false;
        let root = Cell { min: DVec2::NEG_ONE, max: DVec2::ONE };
        let (mut parts, mut steps) = (Vec::new(), Vec::new());
        for (index, edge) in self.edges.iter().enumerate() {
            let (from, to) = (edge.from.x.max(-1.0), edge.to.x.min(1.0));
            if from < to {
                let part = Part { edge: index as u32, from, to };
                keep_between(edge, part, [-1.0, 1.0], &mut parts, &mut steps);
            }
        }
        merge(&mut steps, root.max.x);
        self.divide(root, parts, steps, domain == Domain::Disk)?;
        Ok(self.area)
    }

    /// Adds up a cell, its parts and the steps along its lower side given.
    fn divide(&mut self, cell: Cell, parts: Vec<Part>, steps: Vec<Step>, in_disc: bool) -> Result<(), OverBudget> {
        if in_disc && cell.is_outside_circle() {
            return Ok(());
        }
        let in_disc = in_disc && cell.meets_circle();
        if is_covered(&self.edges, &parts, &steps, cell.min.x) {
            self.is_touched = true;
            return Ok(());
        }
        let size = cell.max - cell.min;
        if parts.len() <= CELL_EDGES || !cell.is_divisible() {
            return self.sweep(cell, parts, &steps, in_disc);
        }
        self.spend(parts.len() as u64)?;
        let middle = 0.5 * (cell.min + cell.max);
        let (mut low, mut high) = (Vec::with_capacity(parts.len() / 2), Vec::with_capacity(parts.len() / 2));
        let (mut low_steps, mut high_steps) = (Vec::new(), Vec::new());
        let (mut low_cell, mut high_cell) = (cell, cell);
        if size.x >= size.y {
            (low_cell.max.x, high_cell.min.x) = (middle.x, middle.x);
            for part in parts {
                if part.from < middle.x {
                    low.push(Part { to: part.to.min(middle.x), ..part });
                }
                if part.to > middle.x {
                    high.push(Part { from: part.from.max(middle.x), ..part });
                }
            }
            // What changes left of the middle is there from the start on its right.
            for step in steps {
                if step.u < middle.x {
                    low_steps.push(step);
                }
                high_steps.push(Step { u: step.u.max(middle.x), ..step });
            }
        } else {
            (low_cell.max.y, high_cell.min.y) = (middle.y, middle.y);
            low_steps.extend_from_slice(&steps);
            high_steps.extend_from_slice(&steps);
            for part in parts {
                let edge = &self.edges[part.edge as usize];
                keep_between(edge, part, [cell.min.y, middle.y], &mut low, &mut low_steps);
                keep_between(edge, part, [middle.y, cell.max.y], &mut high, &mut high_steps);
            }
        }
        merge(&mut low_steps, low_cell.max.x);
        merge(&mut high_steps, high_cell.max.x);
        self.divide(low_cell, low, low_steps, in_disc)?;
        self.divide(high_cell, high, high_steps, in_disc)
    }

    fn spend(&mut self, work: u64) -> Result<(), OverBudget> {
        self.budget = self.budget.checked_sub(work).ok_or(OverBudget)?;
        Ok(())
    }

    /// Adds up a cell strip by strip: from each u where something begins or ends to the next.
    fn sweep(&mut self, cell: Cell, mut parts: Vec<Part>, steps: &[Step], in_disc: bool) -> Result<(), OverBudget> {
        let mut events = std::mem::take(&mut self.events);
        let mut active = std::mem::take(&mut self.active);
        events.clear();
        events.extend([cell.min.x, cell.max.x]);
        events.extend(steps.iter().map(|step| step.u));
        for part in &parts {
            events.extend([part.from, part.to]);
            if in_disc {
                let crossings = self.edges[part.edge as usize].circle_crossings();
                events.extend(crossings.filter(|&u| u > part.from && u < part.to));
            }
        }
        if in_disc {
            for v in [cell.min.y, cell.max.y] {
                events.extend([-half_chord(v), half_chord(v)]);
            }
        }
        events.retain(|&u| u >= cell.min.x && u <= cell.max.x);
        events.sort_unstable_by(f64::total_cmp);
        events.dedup();
        parts.sort_by(|a, b| a.from.total_cmp(&b.from));

        active.clear();
        let (mut next_part, mut next_step, mut below) = (0, 0, 0);
        for strip in events.windows(2) {
            let [start, end] = [strip[0], strip[1]];
            while let Some(step) = steps.get(next_step).filter(|step| step.u <= start) {
                below += step.change;
                next_step += 1;
            }
            active.retain(|a: &Active| a.part.to > start);
            while let Some(&part) = parts.get(next_part).filter(|part| part.from <= start) {
                if part.to > start {
                    active.push(Active { part, left: 0.0, right: 0.0, middle: 0.0 });
                }
                next_part += 1;
            }
            self.spend(1 + active.len() as u64)?;
            for a in &mut active {
                let edge = &self.edges[a.part.edge as usize];
                (a.left, a.right) = (edge.v(start), edge.v(end));
            }
            self.strip(cell, [start, end], &mut active, below, in_disc)?;
        }
        self.close_runs(cell, cell.max.x);
        self.events = events;
        self.active = active;
        Ok(())
    }

    /// Adds up a strip, cut into slabs where edges cross in it.
    fn strip(
        &mut self,
        cell: Cell,
        [start, end]: [f64; 2],
        active: &mut [Active],
        below: i32,
        in_disc: bool,
    ) -> Result<(), OverBudget> {
        let mut exchanges =
            insertion_sort(active, |a, b| (a.left, a.right, a.part.edge) > (b.left, b.right, b.part.edge), |_, _| {});
        let mut crossings = std::mem::take(&mut self.crossings);
        crossings.clear();
        let is_sorted = active.windows(2).all(|pair| pair[0].right <= pair[1].right);
        // In the smallest cells any number of edges may cross, and where they do makes no difference.
        if !is_sorted && cell.is_divisible() {
            let edges = &self.edges;
            exchanges += insertion_sort(
                active,
                |a, b| a.right > b.right,
                |a, b| {
                    // Rounding may exchange edges that only touch.
                    let crosses = edges[a.part.edge as usize].crosses(&edges[b.part.edge as usize]);
                    let (before, after) = (b.left - a.left, a.right - b.right);
                    let u = start + (end - start) * (before / (before + after));
                    if crosses && u > start && u < end {
                        crossings.push(u);
                    }
                },
            );
            crossings.sort_unstable_by(f64::total_cmp);
            crossings.dedup();
        }
        self.spend(exchanges + (crossings.len() * active.len()) as u64)?;
        let mut from = start;
        for index in 0..=crossings.len() {
            let to = crossings.get(index).copied().unwrap_or(end);
            if crossings.is_empty() {
                for a in active.iter_mut() {
                    a.middle = 0.5 * (a.left + a.right);
                }
            } else {
                let middle = from + 0.5 * (to - from);
                for a in active.iter_mut() {
                    a.middle = self.edges[a.part.edge as usize].v(middle);
                }
            }
            let exchanges = insertion_sort(active, |a, b| a.middle > b.middle, |_, _| {});
            self.spend(exchanges)?;
            self.slab(cell, [from, to], active, below, in_disc);
            from = to;
        }
        self.crossings = crossings;
        Ok(())
    }

    /// Adds up a slab: the intervals of its middle line without a polygon, times its width.
    fn slab(&mut self, cell: Cell, [from, to]: [f64; 2], active: &[Active], below: i32, in_disc: bool) {
        let width = to - from;
        let (mut bottom, mut top) = ((cell.min.y, Side::Cell), (cell.max.y, Side::Cell));
        let mut arc_area = 0.0;
        if in_disc {
            let half = half_chord(from + 0.5 * width);
            arc_area = half_chord_integral(to) - half_chord_integral(from);
            if -half > bottom.0 {
                bottom = (-half, Side::Arc);
            }
            if half < top.0 {
                top = (half, Side::Arc);
            }
        }
        let upper_integral = |(v, side): (f64, Side)| if side == Side::Arc { arc_area } else { width * v };
        let lower_integral = |(v, side): (f64, Side)| if side == Side::Arc { -arc_area } else { width * v };
        let mut count = below;
        let mut lower = (count <= 0).then_some(bottom);
        let mut next = std::mem::take(&mut self.next_runs);
        let mut close = |area: &mut f64, lower: (f64, Side), upper: (f64, Side)| {
            let lower = if lower.0 < bottom.0 { bottom } else { lower };
            let upper = if upper.0 > top.0 { top } else { upper };
            if upper.0 > lower.0 {
                *area += upper_integral(upper) - lower_integral(lower);
                next.push(Run { lower: lower.1, upper: upper.1, start: from });
            }
        };
        for a in active {
            let before = count;
            count += self.edges[a.part.edge as usize].weight;
            if before <= 0 && count > 0 {
                if let Some(lower) = lower.take() {
                    close(&mut self.area, lower, (a.middle, Side::Edge(a.part.edge)));
                }
            } else if before > 0 && count <= 0 {
                lower = Some((a.middle, Side::Edge(a.part.edge)));
            }
        }
        if let Some(lower) = lower {
            close(&mut self.area, lower, top);
        }
        let is_open = matches!(next.as_slice(), [run] if run.lower == bottom.1 && run.upper == top.1);
        self.is_touched |= top.0 > bottom.0 && !is_open;
        if self.wants_trapezoids {
            self.continue_runs(cell, from, &mut next);
        }
        next.clear();
        self.next_runs = next;
    }

    /// Ends the runs that are not among `next`, which are those of the slab from `u` on.
    fn continue_runs(&mut self, cell: Cell, u: f64, next: &mut Vec<Run>) {
        let runs = std::mem::take(&mut self.runs);
        for run in &runs {
            match next.iter_mut().find(|new| new.lower == run.lower && new.upper == run.upper) {
                Some(same) => same.start = run.start,
                None => self.emit(cell, *run, u),
            }
        }
        self.runs = runs;
        std::mem::swap(&mut self.runs, next);
    }

    fn close_runs(&mut self, cell: Cell, u: f64) {
        for run in std::mem::take(&mut self.runs) {
            self.emit(cell, run, u);
        }
    }

    fn emit(&mut self, cell: Cell, run: Run, end: f64) {
        let u = [run.start, end];
        let border = |side: Side, v: f64| match side {
            Side::Cell => Border::Line([v; 2]),
            Side::Arc => Border::Arc,
            Side::Edge(edge) => Border::Line(u.map(|u| self.edges[edge as usize].v(u))),
        };
        let (lower, upper) = (border(run.lower, cell.min.y), border(run.upper, cell.max.y));
        self.trapezoids.push(Trapezoid { u, lower, upper });
        // What follows from running out is seen by the next who spends.
        self.budget = self.budget.saturating_sub(TRAPEZOID_VISITS);
    }
}

/// Whether polygons cover a cell however its edges lie: the fewest below it, less what its edges can take away.
fn is_covered(edges: &[Edge], parts: &[Part], steps: &[Step], start: f64) -> bool {
    let (mut count, mut fewest) = (0, i32::MAX);
    for (index, step) in steps.iter().enumerate() {
        if index == 0 && step.u > start {
            return false;
        }
        count += step.change;
        fewest = fewest.min(count);
    }
    let taken: i32 = parts.iter().map(|part| edges[part.edge as usize].weight.min(0)).sum();
    !steps.is_empty() && fewest + taken > 0
}

/// Keeps what of a part lies between two v; what lies below becomes steps.
fn keep_between(edge: &Edge, part: Part, [low, high]: [f64; 2], parts: &mut Vec<Part>, steps: &mut Vec<Step>) {
    let (start, end) = (edge.v(part.from), edge.v(part.to));
    let mut below = |from: f64, to: f64| {
        if from < to {
            steps.push(Step { u: from, change: edge.weight });
            steps.push(Step { u: to, change: -edge.weight });
        }
    };
    if start <= low && end <= low {
        return below(part.from, part.to);
    }
    if start >= high && end >= high {
        return;
    }
    let Part { mut from, mut to, .. } = part;
    let crossing = |v: f64| edge.u(v).clamp(part.from, part.to);
    if start < low {
        from = crossing(low);
        below(part.from, from);
    } else if start > high {
        from = crossing(high);
    }
    if end < low {
        to = crossing(low);
        below(to, part.to);
    } else if end > high {
        to = crossing(high);
    }
    if from < to {
        parts.push(Part { from, to, ..part });
    }
}

/// Sorts steps and adds up those at the same u, of which a chain of edges leaves none between its ends; drops what changes
/// nothing before the cell's `end`.
fn merge(steps: &mut Vec<Step>, end: f64) {
    steps.sort_unstable_by(|a, b| a.u.total_cmp(&b.u));
    steps.dedup_by(|next, kept| {
        let same = next.u == kept.u;
        if same {
            kept.change += next.change;
        }
        same
    });
    steps.retain(|step| step.change != 0 && step.u < end);
}

/// Sorts what is nearly sorted; told of every exchange of neighbours (`a`, `b`) into (`b`, `a`), whose number is returned.
fn insertion_sort<T: Copy>(items: &mut [T], above: impl Fn(&T, &T) -> bool, mut exchanged: impl FnMut(&T, &T)) -> u64 {
    let mut exchanges = 0;
    for sorted in 1..items.len() {
        let item = items[sorted];
        let mut at = sorted;
        while at > 0 && above(&items[at - 1], &item) {
            exchanged(&items[at - 1], &item);
            items[at] = items[at - 1];
            at -= 1;
            exchanges += 1;
        }
        items[at] = item;
    }
    exchanges
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    /// The edges of a triangle.
    fn triangle(corners: [[f64; 2]; 3]) -> Vec<Edge> {
        let [a, b, c] = corners.map(DVec2::from);
        let count = if (b - a).perp_dot(c - a) > 0.0 { 1 } else { -1 };
        [(a, b), (b, c), (c, a)].into_iter().filter_map(|(from, to)| Edge::new(from, to, count)).collect()
    }

    /// A fan of needles that all cross near one point.
    fn star(needles: usize) -> Vec<Edge> {
        let needle = |i: usize| {
            let (sin, cos) = (PI * i as f64 / needles as f64).sin_cos();
            triangle([
                [-1.5 * cos, -1.5 * sin],
                [1.5 * cos, 1.5 * sin],
                [1.5 * cos - 1e-3 * sin, 1.5 * sin + 1e-3 * cos],
            ])
        };
        (0..needles).flat_map(needle).collect()
    }

    #[test]
    fn a_triangle_takes_its_area() {
        let mut coverage = Coverage::default();
        let edges = triangle([[-0.5, -0.25], [0.5, -0.5], [0.25, 0.75]]);
        for (domain, whole) in [(Domain::Rect, 4.0), (Domain::Disk, PI)] {
            let area = coverage.uncovered(edges.clone(), domain, false, u64::MAX).expect("no limit");
            assert!((whole - area - 0.59375).abs() < 1e-15 * 8.0, "{domain:?}: {area}");
        }
    }

    #[test]
    fn what_takes_too_long_is_given_up_and_leaves_nothing_behind() {
        let (simple, mut fresh, mut used) = (star(3), Coverage::default(), Coverage::default());
        let ask = |coverage: &mut Coverage| {
            let area = coverage.uncovered(simple.clone(), Domain::Rect, true, u64::MAX);
            (area, coverage.trapezoids.clone())
        };
        let expected = ask(&mut fresh);
        // At every stage of the work.
        for budget in [0, 1, 10, 100, 1000, 10_000, 100_000] {
            let given_up = used.uncovered(star(300), Domain::Rect, true, budget);
            assert_eq!(given_up, Err(OverBudget), "{budget}");
            assert_eq!(ask(&mut used), expected, "{budget}");
        }
    }

    #[test]
    fn thousands_of_crossings_at_a_point_take_no_memory() {
        let mut coverage = Coverage::default();
        // A needle's own area is 1.5e-3, the union's less; all that counts here is that the work is bounded.
        let _ = coverage.uncovered(star(4000), Domain::Rect, false, 1 << 22);
        let crossings = CELL_EDGES * CELL_EDGES;
        assert!(coverage.crossings.capacity() <= 2 * crossings, "{}", coverage.crossings.capacity());
    }
}
