//! Meshes as their outlines need them: welded, with the triangles at each edge, and what of them is closed.

use std::collections::hash_map::Entry;

use glam::{DVec3, Vec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::scene::Mesh;

/// A mesh whose triangles share vertices wherever they have the same position.
#[derive(Debug, Default)]
pub struct Surface {
    /// Mesh space, each once.
    pub positions: Vec<Vec3>,
    /// Those of different corners. Closed ones turn their front outwards.
    pub triangles: Vec<Triangle>,
    /// Pairs of vertices that triangles run along.
    pub edges: Vec<Edge>,
    /// Triangles at edges, edge by edge.
    pub sides: Vec<Side>,
}

/// A triangle of a [`Surface`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Triangle {
    /// Its vertices, counter-clockwise seen from its front.
    pub corners: [u32; 3],
    /// Whether it and all that it hangs together with by edges has as many triangles along each edge one way as the other: then it
    /// has an inside, or sides that lie on each other.
    pub is_closed: bool,
}

/// An edge of a [`Surface`], or some of one that very many triangles share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Edge {
    /// Its vertices, the lesser first.
    pub ends: [u32; 2],
    /// The first of its sides.
    pub first: u32,
    /// How many it has.
    pub count: u32,
}

/// A triangle at an edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Side {
    /// Its number.
    pub triangle: u32,
    /// Whether it runs from the edge's second end to its first.
    pub is_reversed: bool,
}

/// Most sides of one [`Edge`]: no loop over them is long.
pub const MOST_SIDES: usize = 1024;

impl Surface {
    /// That of a mesh.
    pub fn of(mesh: &Mesh) -> Self {
        let mut positions = Vec::new();
        let mut known: FxHashMap<[u32; 3], u32> = FxHashMap::default();
        let mut vertex = |index: u32| {
            // 0 and −0 are the same place.
            let position = mesh.positions[index as usize] + 0.0;
            match known.entry(position.to_array().map(f32::to_bits)) {
                Entry::Occupied(entry) => *entry.get(),
                Entry::Vacant(entry) => {
                    positions.push(position);
                    *entry.insert(positions.len() as u32 - 1)
                }
            }
        };
        let corners = mesh.triangles.iter().map(|triangle| triangle.map(&mut vertex));
        let triangles = corners.filter(|[a, b, c]| a != b && b != c && c != a);
        let mut triangles: Vec<Triangle> = triangles.map(|corners| Triangle { corners, is_closed: false }).collect();

        let mut along: Vec<([u32; 2], Side)> = triangles
            .par_iter()
            .enumerate()
            .flat_map_iter(|(i, triangle)| {
                let [a, b, c] = triangle.corners;
                [[a, b], [b, c], [c, a]].map(|[from, to]| {
                    let side = Side { triangle: i as u32, is_reversed: from > to };
                    ([from.min(to), from.max(to)], side)
                })
            })
            .collect();
        along.par_sort_unstable();
        let edges: Vec<&[([u32; 2], Side)]> = along.chunk_by(|(a, _), (b, _)| a == b).collect();

        // What hangs together by edges: each triangle's part is named by one of it.
        let mut part: Vec<u32> = (0..triangles.len() as u32).collect();
        for sides in &edges {
            let first = root(&mut part, sides[0].1.triangle);
            for (_, side) in &sides[1..] {
                let other = root(&mut part, side.triangle);
                part[other as usize] = first;
            }
        }
        let part: Vec<u32> = (0..triangles.len() as u32).map(|i| root(&mut part, i)).collect();
        let mut is_open = vec![false; triangles.len()];
        for sides in &edges {
            let reversed = sides.iter().filter(|(_, side)| side.is_reversed).count();
            is_open[part[sides[0].1.triangle as usize] as usize] |= 2 * reversed != sides.len();
        }
        // Six times the volume inside: negative where the front is.
        let mut volume = vec![0.0; triangles.len()];
        let origin = positions.first().copied().unwrap_or_default().as_dvec3();
        for (triangle, &part) in triangles.iter().zip(&part) {
            let [a, b, c]: [DVec3; 3] = triangle.corners.map(|at| positions[at as usize].as_dvec3() - origin);
            volume[part as usize] += a.dot(b.cross(c));
        }
        let turns = |triangle: u32| {
            let part = part[triangle as usize] as usize;
            !is_open[part] && volume[part] < 0.0
        };
        for (i, triangle) in (0..).zip(&mut triangles) {
            triangle.is_closed = !is_open[part[i as usize] as usize];
            if turns(i) {
                triangle.corners.swap(1, 2);
            }
        }
        let mut surface = Self { positions, triangles, edges: Vec::new(), sides: Vec::with_capacity(along.len()) };
        for sides in edges.iter().flat_map(|sides| sides.chunks(MOST_SIDES)) {
            let first = surface.sides.len() as u32;
            surface.edges.push(Edge { ends: sides[0].0, first, count: sides.len() as u32 });
            let turned =
                |&(_, side): &([u32; 2], Side)| Side { is_reversed: side.is_reversed != turns(side.triangle), ..side };
            surface.sides.extend(sides.iter().map(turned));
        }
        surface
    }
}

/// Which triangle names a triangle's part; those passed on the way are told of it.
fn root(part: &mut [u32], mut triangle: u32) -> u32 {
    while part[triangle as usize] != triangle {
        part[triangle as usize] = part[part[triangle as usize] as usize];
        triangle = part[triangle as usize];
    }
    triangle
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A mesh whose triangles share no vertices, as files with hard edges have them.
    fn loose(triangles: &[[[f32; 3]; 3]]) -> Mesh {
        let positions: Vec<Vec3> = triangles.iter().flatten().map(|&p| Vec3::from(p)).collect();
        let triangles = (0..triangles.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        Mesh { positions: positions.into(), triangles, ..Mesh::default() }
    }

    const CORNERS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    /// Its front outwards.
    fn tetrahedron() -> Vec<[[f32; 3]; 3]> {
        [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(|triangle| triangle.map(|i: usize| CORNERS[i])).to_vec()
    }

    /// The sum of a surface's triangles along each edge.
    fn boundary(surface: &Surface) -> Vec<i32> {
        let of = |edge: &Edge| {
            let sides = &surface.sides[edge.first as usize..(edge.first + edge.count) as usize];
            sides.iter().map(|side| if side.is_reversed { -1 } else { 1 }).sum()
        };
        surface.edges.iter().map(of).collect()
    }

    #[test]
    fn loose_triangles_of_a_solid_are_one_closed_surface() {
        let surface = Surface::of(&loose(&tetrahedron()));
        assert_eq!((surface.positions.len(), surface.edges.len(), surface.sides.len()), (4, 6, 12));
        assert!(surface.triangles.iter().all(|triangle| triangle.is_closed));
        assert_eq!(boundary(&surface), [0; 6]);
    }

    #[test]
    fn a_surface_with_a_hole_is_open_and_what_touches_it_at_a_vertex_is_not() {
        let mut triangles = tetrahedron();
        let moved = |triangle: [[f32; 3]; 3]| triangle.map(|[x, y, z]| [x + 1.0, y, z]);
        triangles.extend(tetrahedron()[..3].iter().map(|&triangle| moved(triangle)));
        let surface = Surface::of(&loose(&triangles));
        let is_closed: Vec<bool> = surface.triangles.iter().map(|triangle| triangle.is_closed).collect();
        assert_eq!(is_closed, [[true; 4].as_slice(), &[false; 3]].concat());
    }

    #[test]
    fn an_inside_out_solid_is_turned_and_an_open_one_left_as_it_is() {
        let inside_out: Vec<_> = tetrahedron().into_iter().map(|[a, b, c]| [a, c, b]).collect();
        let [outward, turned] = [&tetrahedron(), &inside_out].map(|triangles| Surface::of(&loose(triangles)));
        let volume = |surface: &Surface| -> f32 {
            let corners = surface.triangles.iter().map(|t| t.corners.map(|at| surface.positions[at as usize]));
            corners.map(|[a, b, c]| a.dot(b.cross(c))).sum()
        };
        assert_eq!([volume(&outward), volume(&turned)], [1.0, 1.0]);
        assert_eq!(boundary(&turned), [0; 6]);
        let open = Surface::of(&loose(&inside_out[..3]));
        assert_eq!(open.triangles[0].corners.map(|at| open.positions[at as usize].to_array()), inside_out[0]);
    }

    #[test]
    fn an_edge_of_three_faces_is_open_and_one_of_four_that_cancel_is_closed() {
        let fin = [CORNERS[0], CORNERS[1], [0.5, -1.0, -1.0]];
        let surface = Surface::of(&loose(&[tetrahedron(), vec![fin]].concat()));
        assert!(surface.triangles.iter().all(|triangle| !triangle.is_closed));
        // Two solids that share an edge.
        let below = |triangle: [[f32; 3]; 3]| triangle.map(|[x, y, z]| [x, -y, -z]);
        let triangles = [tetrahedron(), tetrahedron().into_iter().map(below).collect()].concat();
        let surface = Surface::of(&loose(&triangles));
        assert_eq!(surface.edges.iter().filter(|edge| edge.count == 4).count(), 1);
        assert!(surface.triangles.iter().all(|triangle| triangle.is_closed));
    }

    #[test]
    fn triangles_that_are_lines_are_left_out() {
        let [a, b, ..] = CORNERS;
        let surface = Surface::of(&loose(&[[a, b, a], [a, a, a], [a, b, [-0.0, 0.0, -0.0]]]));
        assert!(surface.triangles.is_empty() && surface.edges.is_empty());
        assert!(Surface::of(&Mesh::default()).positions.is_empty());
    }

    #[test]
    fn an_edge_of_very_many_faces_comes_in_parts() {
        let fan: Vec<_> = (0..3 * MOST_SIDES).map(|i| [CORNERS[0], CORNERS[1], [0.0, 1.0, i as f32]]).collect();
        let surface = Surface::of(&loose(&fan));
        let shared = surface.edges.iter().filter(|edge| edge.count > 1);
        assert_eq!(shared.map(|edge| edge.count as usize).collect::<Vec<_>>(), [MOST_SIDES; 3]);
    }
}
