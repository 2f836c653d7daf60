//! Small generators of surfaces.

use std::collections::HashMap;
use std::f64::consts::TAU;

use glam::{DAffine3, DVec2, DVec3};

/// Triangles in double precision, counter-clockwise seen from their front.
#[derive(Debug, Clone, Default)]
pub(super) struct Surface {
    pub positions: Vec<DVec3>,
    /// Unit normals, one a position; none: flat triangles.
    pub normals: Option<Vec<DVec3>>,
    pub triangles: Vec<[u32; 3]>,
}

impl Surface {
    /// Moved; a rotation, a translation and a uniform scale at most.
    pub fn moved(mut self, by: &DAffine3) -> Self {
        self.positions.iter_mut().for_each(|position| *position = by.transform_point3(*position));
        self.normals.iter_mut().flatten().for_each(|normal| *normal = (by.matrix3 * *normal).normalize());
        self
    }

    /// All in one; either all have normals or none.
    pub fn joined(surfaces: impl IntoIterator<Item = Self>) -> Self {
        surfaces.into_iter().reduce(Self::with).unwrap_or_default()
    }

    fn with(mut self, other: Self) -> Self {
        assert_eq!(self.normals.is_some(), other.normals.is_some(), "smooth and flat surfaces don't join");
        let first = self.positions.len() as u32;
        self.positions.extend(other.positions);
        if let (Some(normals), Some(more)) = (&mut self.normals, other.normals) {
            normals.extend(more);
        }
        self.triangles.extend(other.triangles.iter().map(|triangle| triangle.map(|index| first + index)));
        self
    }

    /// Smooth normals: the mean of the triangles' around each position, weighted by area.
    fn smooth(mut self) -> Self {
        let mut normals = vec![DVec3::ZERO; self.positions.len()];
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(|index| self.positions[index as usize]);
            for &index in triangle {
                normals[index as usize] += (b - a).cross(c - a);
            }
        }
        self.normals = Some(normals.into_iter().map(|normal| normal.normalize_or(DVec3::Y)).collect());
        self
    }
}

/// A convex polygon as a fan of triangles.
pub(super) fn polygon(corners: &[DVec3]) -> Surface {
    let triangles = (2..corners.len() as u32).map(|i| [0, i - 1, i]).collect();
    Surface { positions: corners.to_vec(), normals: None, triangles }
}

/// A horizontal rectangle that faces up.
pub(super) fn horizontal_rect(center: DVec2, half: DVec2, height: f64) -> Surface {
    let corner = |x: f64, z: f64| DVec3::new(center.x + x * half.x, height, center.y + z * half.y);
    polygon(&[corner(-1.0, 1.0), corner(1.0, 1.0), corner(1.0, -1.0), corner(-1.0, -1.0)])
}

/// A box between two corners.
pub(super) fn cuboid(min: DVec3, max: DVec3) -> Surface {
    let corner = |i: u32| {
        let pick = |bit: u32, low: f64, high: f64| if i & bit == 0 { low } else { high };
        DVec3::new(pick(1, min.x, max.x), pick(2, min.y, max.y), pick(4, min.z, max.z))
    };
    let sides = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    Surface {
        positions: (0..8).map(corner).collect(),
        normals: None,
        triangles: sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect(),
    }
}

/// A sphere around the origin: an icosahedron of 20·4ⁿ triangles after n subdivisions.
pub(super) fn icosphere(radius: f64, subdivisions: u32) -> Surface {
    let golden = 0.5 * (1.0 + 5f64.sqrt());
    let mut normals: Vec<DVec3> = [(0, 1), (1, 2), (2, 0)]
        .iter()
        .flat_map(|&(one, other)| {
            [(1.0, golden), (-1.0, golden), (1.0, -golden), (-1.0, -golden)].map(|(a, b)| {
                let mut vertex = DVec3::ZERO;
                vertex[one] = a;
                vertex[other] = b;
                vertex.normalize()
            })
        })
        .collect();
    // The faces are the triples of mutual neighbours, counter-clockwise from outside.
    let edge = normals[0].distance(normals[1]) * 1.1;
    let near = |a: usize, b: usize| normals[a].distance(normals[b]) < edge;
    let mut triangles = Vec::with_capacity(20);
    for a in 0..12 {
        for b in a + 1..12 {
            for c in b + 1..12 {
                if near(a, b) && near(b, c) && near(c, a) {
                    let outward = normals[a].dot(normals[b].cross(normals[c])) > 0.0;
                    let (b, c) = if outward { (b, c) } else { (c, b) };
                    triangles.push([a as u32, b as u32, c as u32]);
                }
            }
        }
    }
    for _ in 0..subdivisions {
        let mut middles: HashMap<[u32; 2], u32> = HashMap::new();
        let mut middle = |a: u32, b: u32| {
            *middles.entry([a.min(b), a.max(b)]).or_insert_with(|| {
                normals.push((normals[a as usize] + normals[b as usize]).normalize());
                normals.len() as u32 - 1
            })
        };
        triangles = triangles
            .iter()
            .flat_map(|&[a, b, c]| {
                let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
                [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            })
            .collect();
    }
    Surface { positions: normals.iter().map(|normal| radius * normal).collect(), normals: Some(normals), triangles }
}

/// A round tube along a polyline; a closed one joins its ends, an open one is capped.
pub(super) fn tube(path: &[DVec3], radius: f64, sides: u32, closed: bool) -> Surface {
    let count = path.len();
    let tangent = |i: usize| {
        let (before, after) = if closed {
            ((i + count - 1) % count, (i + 1) % count)
        } else {
            (i.saturating_sub(1), (i + 1).min(count - 1))
        };
        (path[after] - path[before]).normalize()
    };
    let mut surface = Surface { normals: Some(Vec::new()), ..Surface::default() };
    let mut across = tangent(0).any_orthonormal_vector();
    for (i, &center) in path.iter().enumerate() {
        // Parallel transport: the frame turns no more than the path does.
        let along = tangent(i);
        across = (across - across.dot(along) * along).normalize();
        let other = along.cross(across);
        let ring = (0..sides).map(|side| {
            let (sin, cos) = (TAU * f64::from(side) / f64::from(sides)).sin_cos();
            cos * across + sin * other
        });
        for normal in ring {
            surface.positions.push(center + radius * normal);
            surface.normals.get_or_insert_default().push(normal);
        }
    }
    let rings = if closed { count } else { count - 1 };
    for ring in 0..rings {
        let (here, there) = ((ring as u32) * sides, ((ring + 1) % count) as u32 * sides);
        for side in 0..sides {
            let next = (side + 1) % sides;
            surface.triangles.push([here + side, here + next, there + next]);
            surface.triangles.push([here + side, there + next, there + side]);
        }
    }
    if closed {
        return surface;
    }
    let cap = |ring: usize, normal: DVec3, flip: bool| {
        let first = ring * sides as usize;
        let positions = surface.positions[first..first + sides as usize].to_vec();
        let fan = (2..sides).map(|i| if flip { [0, i, i - 1] } else { [0, i - 1, i] });
        Surface { normals: Some(vec![normal; positions.len()]), triangles: fan.collect(), positions }
    };
    let (start, end) = (cap(0, -tangent(0), true), cap(count - 1, tangent(count - 1), false));
    surface.with(start).with(end)
}

/// A ring around local Y.
pub(super) fn torus(radius: f64, thickness: f64, segments: u32, sides: u32) -> Surface {
    tube(&circle(radius, segments), thickness, sides, true)
}

/// Points on a circle around local Y.
pub(super) fn circle(radius: f64, segments: u32) -> Vec<DVec3> {
    (0..segments)
        .map(|i| {
            let (sin, cos) = (TAU * f64::from(i) / f64::from(segments)).sin_cos();
            radius * DVec3::new(cos, 0.0, -sin)
        })
        .collect()
}

/// A solid of revolution around local Y: `profile` holds radius and height from the bottom up, with a crease at every point.
pub(super) fn lathe(profile: &[DVec2], sides: u32) -> Surface {
    let band = |low: DVec2, high: DVec2| {
        let slope = high - low;
        let mut surface = Surface { normals: Some(Vec::new()), ..Surface::default() };
        for side in 0..sides {
            let (sin, cos) = (TAU * f64::from(side) / f64::from(sides)).sin_cos();
            let outward = DVec3::new(cos, 0.0, -sin);
            let normal = (slope.y * outward - slope.x * DVec3::Y).normalize();
            for point in [low, high] {
                surface.positions.push(point.x * outward + point.y * DVec3::Y);
                surface.normals.get_or_insert_default().push(normal);
            }
            let (here, next) = (2 * side, 2 * ((side + 1) % sides));
            // A point on the axis closes the band by itself.
            if low.x > 0.0 {
                surface.triangles.push([here, next, next + 1]);
            }
            if high.x > 0.0 {
                surface.triangles.push([here, next + 1, here + 1]);
            }
        }
        surface
    };
    Surface::joined(profile.windows(2).map(|pair| band(pair[0], pair[1])))
}

/// A leaf that starts at the origin along local +Z and bends down by `bend` radians on its way to the tip, folded along its
/// midrib; it faces up.
pub(super) fn leaf(length: f64, width: f64, bend: f64, segments: u32) -> Surface {
    const ACROSS: [f64; 5] = [-1.0, -0.5, 0.0, 0.5, 1.0];
    let mut surface = Surface::default();
    let mut spine = DVec3::ZERO;
    for i in 0..=segments {
        let t = f64::from(i) / f64::from(segments);
        // Widest at two fifths of its length, pointed at both ends but never of no width.
        let half = 0.5 * width * (0.02 + 2.05 * t.powf(0.7) * (1.0 - t).powf(0.9)).min(1.0);
        for side in ACROSS {
            surface.positions.push(spine + DVec3::new(side * half, 0.25 * side.abs() * half, 0.0));
        }
        let angle = bend * t;
        spine += length / f64::from(segments) * DVec3::new(0.0, -angle.sin(), angle.cos());
    }
    let columns = ACROSS.len() as u32;
    for row in 0..segments {
        for column in 0..columns - 1 {
            let here = row * columns + column;
            let there = here + columns;
            surface.triangles.push([here, there, there + 1]);
            surface.triangles.push([here, there + 1, here + 1]);
        }
    }
    surface.smooth()
}

/// A profile in the local YZ plane, drawn out along X; it faces the side to the left of the profile's course seen from +X.
pub(super) fn extruded(profile: &[DVec2], half_width: f64) -> Surface {
    let mut surface = Surface::default();
    for point in profile {
        surface.positions.push(DVec3::new(half_width, point.y, point.x));
        surface.positions.push(DVec3::new(-half_width, point.y, point.x));
    }
    for i in 0..profile.len() as u32 - 1 {
        let [a, b, c, d] = [2 * i, 2 * i + 1, 2 * i + 3, 2 * i + 2];
        surface.triangles.push([a, d, c]);
        surface.triangles.push([a, c, b]);
    }
    surface.smooth()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Volume by the divergence theorem; positive where triangles face outwards, and right only where it is closed.
    fn volume(surface: &Surface) -> f64 {
        let corners = |triangle: &[u32; 3]| triangle.map(|index| surface.positions[index as usize]);
        surface.triangles.iter().map(corners).map(|[a, b, c]| a.dot(b.cross(c)) / 6.0).sum()
    }

    #[test]
    fn solids_face_outwards_and_hold_their_volume() {
        use std::f64::consts::PI;
        let unit_box = cuboid(DVec3::ZERO, DVec3::new(1.0, 2.0, 3.0));
        assert!((volume(&unit_box) - 6.0).abs() < 1e-14);
        let sphere = icosphere(2.0, 5);
        assert_eq!(sphere.triangles.len(), 20 * 4usize.pow(5));
        assert!((volume(&sphere) / (PI * 32.0 / 3.0) - 1.0).abs() < 2e-3);
        let ring = torus(1.0, 0.1, 256, 64);
        assert!((volume(&ring) / (2.0 * PI * PI * 0.01) - 1.0).abs() < 2e-3);
        let rod = tube(&[DVec3::ZERO, DVec3::Y, 3.0 * DVec3::Y], 0.5, 256, false);
        assert!((volume(&rod) / (PI * 0.75) - 1.0).abs() < 2e-3);
        let cone = lathe(&[DVec2::ZERO, DVec2::new(1.0, 0.0), DVec2::new(0.0, 3.0)], 256);
        assert!((volume(&cone) / PI - 1.0).abs() < 2e-3);
    }

    #[test]
    fn normals_are_unit_and_on_the_front() {
        let profile: Vec<DVec2> = (0..9).map(|i| DVec2::from_angle(0.2 * f64::from(i))).collect();
        for surface in [
            icosphere(2.0, 2),
            torus(1.0, 0.1, 32, 8),
            tube(&[DVec3::ZERO, DVec3::Y, DVec3::new(1.0, 3.0, 0.0)], 0.1, 8, false),
            lathe(&[DVec2::new(0.5, 0.0), DVec2::new(1.0, 0.5), DVec2::new(0.2, 3.0)], 16),
            leaf(1.0, 0.3, 1.0, 8),
            extruded(&profile, 2.0),
        ] {
            let normals = surface.normals.as_ref().unwrap();
            assert_eq!(normals.len(), surface.positions.len());
            for triangle in &surface.triangles {
                let [a, b, c] = triangle.map(|index| surface.positions[index as usize]);
                for &index in triangle {
                    let normal = normals[index as usize];
                    assert!((normal.length() - 1.0).abs() < 1e-12);
                    assert!(normal.dot((b - a).cross(c - a)) > 0.0, "{triangle:?}");
                }
            }
        }
    }
}
