//! Triangles as a receiver sees them against a light, and the outline that is left of a mesh when the edges that its
//! triangles share have cancelled.

use std::collections::hash_map::Entry;
use std::hash::{Hash, Hasher};

use glam::{DMat3, DVec2, DVec3};
use robust::{Coord, orient2d};
use rustc_hash::FxHashMap;

use super::bvh::Plane;
use super::coverage::{Edge, SQUARE};
use crate::closed_forms::clip_polygon;
use crate::scene::light::Emitter;

/// Maps vectors from the receiver to homogeneous coordinates (X, Y, W): the vector's image on the light's plane is
/// (u, v) = (X/W, Y/W), the light itself |u|, |v| ≤ 1, and W the share of the way to the light's plane.
#[derive(Debug, Clone, Copy)]
pub struct Projection {
    /// Homogeneous coordinates from scene space.
    pub homogeneous_from_scene: DMat3,
    /// Half axes of the light, right-handed along the line of sight.
    pub half: [DVec3; 2],
    /// The light is at infinity: nothing lies behind it.
    pub distant: bool,
}

/// Homogeneous coordinates are divided by W only up to this |u|, |v|: what reaches farther is clipped to the light first.
const MAX_UV: f64 = 1024.0;

impl Projection {
    /// The projection of a receiver onto an emitter. Half axes are taken to be at least `resolution` long (m), so that no light
    /// is smaller than what its coordinates can tell.
    pub fn new(emitter: &Emitter, resolution: f64) -> Self {
        let away = -emitter.normal;
        let direction_u = emitter.half_u.try_normalize().unwrap_or_else(|| away.any_orthonormal_vector());
        let direction_v = away.cross(direction_u);
        let half = [emitter.half_u.length().max(resolution), emitter.half_v.length().max(resolution)];
        let row_w = away / away.dot(emitter.center);
        let row = |direction: DVec3, half: f64| (direction - direction.dot(emitter.center) * row_w) / half;
        let rows = DMat3::from_cols(row(direction_u, half[0]), row(direction_v, half[1]), row_w);
        Self {
            homogeneous_from_scene: rows.transpose(),
            half: [half[0] * direction_u, half[1] * direction_v],
            distant: emitter.distant,
        }
    }

    /// The half spaces around the receiver that hold all that can block the light.
    pub fn planes(&self) -> Vec<Plane> {
        let [x, y, w] = [0, 1, 2].map(|i| self.homogeneous_from_scene.row(i));
        let end = (!self.distant).then_some(Plane { normal: w, offset: 1.0 });
        let sides = [x - w, -x - w, y - w, -y - w].map(|normal| Plane { normal, offset: 0.0 });
        sides.into_iter().chain(end).collect()
    }
}

/// Tells the corners of an instance's triangles apart by where they are, for files repeat positions.
pub type CornerKey = [u32; 3];

/// A corner's key in two words.
type PackedKey = (u64, u32);

/// An edge of an instance: its ends' keys in order. Whole words from the start: numbers of 4 bytes that are stored and at once
/// loaded as words of 8 stall the processor, as profiles show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct EdgeKey([u64; 4]);

impl EdgeKey {
    fn new(instance: u32, a: PackedKey, b: PackedKey) -> Self {
        Self([a.0, b.0, u64::from(a.1) | u64::from(b.1) << 32, u64::from(instance)])
    }
}

impl Hash for EdgeKey {
    /// Without the length, which the derived one takes for a part of an array.
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.0.iter().for_each(|&word| state.write_u64(word));
    }
}

/// The edges of the triangles added, each with how often a polygon lies on one side of it more than on the other.
#[derive(Debug, Default)]
pub struct Outline {
    edges: Vec<(DVec2, DVec2, i32)>,
    /// Where in `edges` the shared ones are that have not cancelled. Those that have are taken out: what is left is the outline
    /// of the triangles so far, which stays in the cache.
    shared: FxHashMap<EdgeKey, u32>,
    /// Places in `edges` that are free, with a count of zero.
    free: Vec<u32>,
    /// Triangles that may cover some of the light.
    pub triangles: u32,
}

impl Outline {
    /// Takes all triangles out.
    pub fn clear(&mut self) {
        self.edges.clear();
        self.shared.clear();
        self.free.clear();
        self.triangles = 0;
    }

    /// The edges that are left, as [`super::coverage`] takes them.
    pub fn edges(&self) -> impl Iterator<Item = Edge> {
        self.edges.iter().filter(|(.., count)| *count != 0).filter_map(|&(a, b, count)| Edge::new(a, b, count))
    }

    /// Adds a triangle of homogeneous corners, with the sign of their determinant: that of the height of the triangle's plane
    /// over the receiver, which the corners' own rounding would blur where the two nearly touch.
    pub fn add(&mut self, distant: bool, instance: u32, keys: [CornerKey; 3], corners: [DVec3; 3], volume: f64) {
        let projects = |c: &DVec3| c.x.abs().max(c.y.abs()) <= MAX_UV * c.z && c.z > 0.0 && (distant || c.z <= 1.0);
        if corners.iter().all(projects) {
            let [a, b, c] = corners.map(project);
            let coord = |p: DVec2| Coord { x: p.x, y: p.y };
            let turn = orient2d(coord(a), coord(b), coord(c));
            if turn == 0.0 {
                return;
            }
            self.triangles += 1;
            let count = if turn > 0.0 { 1 } else { -1 };
            for (i, j) in [(0, 1), (1, 2), (2, 0)] {
                self.add_shared(instance, [keys[i], keys[j]], [corners[i], corners[j]].map(project), count);
            }
            return;
        }
        let polygon = clip(distant, keys, corners, volume);
        if polygon.len() >= 3 {
            self.triangles += 1;
            self.add_polygon(&polygon);
        }
    }

    /// Adds a convex polygon of the light's plane.
    pub fn add_polygon(&mut self, polygon: &[DVec2]) {
        let turn: f64 =
            (2..polygon.len()).map(|i| (polygon[i - 1] - polygon[0]).perp_dot(polygon[i] - polygon[0])).sum();
        let count = if turn > 0.0 { 1 } else { -1 };
        for (i, &point) in polygon.iter().enumerate() {
            self.edges.push((point, polygon[(i + 1) % polygon.len()], count));
        }
    }

    fn add_shared(&mut self, instance: u32, keys: [CornerKey; 2], points: [DVec2; 2], count: i32) {
        let [a, b] = keys.map(|[x, y, z]| (u64::from(x) | u64::from(y) << 32, z));
        let in_order = a <= b;
        let (key, count) =
            if in_order { (EdgeKey::new(instance, a, b), count) } else { (EdgeKey::new(instance, b, a), -count) };
        match self.shared.entry(key) {
            Entry::Occupied(shared) => {
                let index = *shared.get();
                let sum = &mut self.edges[index as usize].2;
                *sum += count;
                if *sum == 0 {
                    shared.remove();
                    self.free.push(index);
                }
            }
            Entry::Vacant(place) => {
                let [start, end] = if in_order { points } else { [points[1], points[0]] };
                let edge = (start, end, count);
                if let Some(index) = self.free.pop() {
                    self.edges[index as usize] = edge;
                    place.insert(index);
                } else {
                    place.insert(self.edges.len() as u32);
                    self.edges.push(edge);
                }
            }
        }
    }
}

fn project(c: DVec3) -> DVec2 {
    c.truncate() / c.z
}

/// The part of the light's square that a triangle covers: where all three edges' planes and, unless the light is at infinity,
/// the triangle's own have the square's point on the inner side (half spaces through the receiver). Nothing
/// is divided by W, so that it is as exact for a plane that all but touches the receiver as for any other.
fn clip(distant: bool, keys: [CornerKey; 3], corners: [DVec3; 3], volume: f64) -> Vec<DVec2> {
    // By key, whatever order they came in, so that the same bits come out and neighbours cut at the same line.
    let mut order = [0, 1, 2];
    order.sort_by_key(|&i| keys[i]);
    let is_even = (order[0] + 1) % 3 == order[1];
    let sign = if is_even { volume.signum() } else { -volume.signum() };
    let [a, b, c] = order.map(|i| corners[i]);
    let mut polygon = SQUARE.to_vec();
    for (from, to, sign) in [(a, b, sign), (b, c, sign), (a, c, -sign)] {
        let normal = sign * from.cross(to - from);
        polygon = clip_polygon(&polygon, |uv| normal.dot(uv.extend(1.0)));
    }
    if !distant {
        // The plane is met at the light's point or before.
        let normal = sign * (b - a).cross(c - a);
        polygon = clip_polygon(&polygon, |uv| normal.dot(uv.extend(1.0) - a));
    }
    polygon
}
