//! Traversal of a [`Tree`], eight lanes at a time, compiled for AVX-512, for AVX2 with FMA and for any machine.

#![expect(
    unsafe_code,
    reason = "AVX code is entered only after the processor was asked for it; it traces 2.1 times the portable version's rays"
)]

use glam::{DVec3, Vec3A};

use super::wide::{LEAF, Leaf, Node, Tree, WIDTH};

/// A ray in a tree's normalised coordinates, in `f32` with bounds on what rounding did to it.
#[derive(Debug, Clone, Copy)]
pub struct Ray {
    /// Origin.
    origin: Vec3A,
    /// Direction; the largest component is in [2^-40, 2^40].
    direction: Vec3A,
    /// Reciprocal of the direction, finite.
    inverse: Vec3A,
    /// Minus the origin times `inverse`, moved by its error bound such that distances to near planes come out too small.
    offset_near: Vec3A,
    /// … and those to far planes too large.
    offset_far: Vec3A,
    /// Bit per axis: set where the direction is negative, so that the maximum is the near plane.
    negative: u32,
    /// Bound of the error of the triangle test's volumes that the direction spans, per unit of edge size.
    error: f32,
    /// … and of the volume that both edges span with the origin, per unit of edge size squared.
    error_t: f32,
    /// Length in units of `direction`; rounded up, possibly infinite.
    t_max: f32,
    /// `t` of this ray per `t` of the caller.
    t_scale: f64,
}

impl Ray {
    /// The ray `origin + t · direction` for `t` in `[0, t_max]`, possibly infinite. `origin_error` bounds the error of each
    /// coordinate of `origin` and of the tree's triangles, beyond 2^-48 of the largest coordinate of `origin`.
    #[inline]
    pub fn new(origin: DVec3, origin_error: f64, direction: DVec3, t_max: f64) -> Self {
        let (mut direction_f32, mut t_scale) = (direction.as_vec3a(), 1.0);
        let mut length = direction_f32.abs().max_element();
        if !(2f32.powi(-40)..=2f32.powi(40)).contains(&length) {
            // A power of two brings the largest component into [1, 2): exact, and f32 can't overflow.
            let exponent = exponent_of(direction.abs().max_element());
            direction_f32 = (direction * power_of_two(-exponent)).as_vec3a();
            t_scale = power_of_two(exponent);
            length = 2.0;
        }
        let origin = origin.as_vec3a();
        let reach = origin.abs().max_element();
        let origin_error = origin_error as f32 + reach * 2f32.powi(-48);
        // A component below 2^-60 of the largest moves the ray by less than the last two terms of the shift within the box
        // around the tree and the origin; with one of at least that size nothing below is infinite.
        let inverse = direction_f32.abs().max(Vec3A::splat(length * 2f32.powi(-60))).copysign(direction_f32).recip();
        // Half an ulp from the conversion, one for each of the sum and the product below, one for what the portable
        // version's product with the plane loses (planes are at most 1), doubled.
        let shift = (origin.abs() + 1.0) * 2f32.powi(-21) + origin_error;
        let shift = shift.copysign(direction_f32);
        // The sum of the components of a cross product is at most 5.2 times its factors' largest ones; each component
        // multiplies a coordinate's error.
        let error_t = VOLUME_ERROR * (reach + 1.0) + 8.0 * origin_error;
        let mut ray = Self {
            origin,
            direction: direction_f32,
            inverse,
            offset_near: (-origin - shift) * inverse,
            offset_far: (shift - origin) * inverse,
            negative: direction_f32.is_negative_bitmask(),
            error: length * error_t,
            error_t,
            t_max: 0.0,
            t_scale,
        };
        ray.shorten(t_max);
        ray
    }

    /// Ends the ray at `t_max` (the caller's parameter).
    #[inline]
    fn shorten(&mut self, t_max: f64) {
        self.t_max = (t_max * self.t_scale) as f32 * (1.0 + 2f32.powi(-20));
    }
}

/// The exponent `e` for which a positive finite `x` is in [2^e, 2^(e+1)); clamped to where 2^±e is finite.
pub fn exponent_of(x: f64) -> i32 {
    if x > 0.0 { (((x.to_bits() >> 52) as i32 & 0x7ff) - 1023).clamp(-1020, 1020) } else { 0 }
}

/// 2^exponent, exact, for exponents of magnitude up to 1021.
pub fn power_of_two(exponent: i32) -> f64 {
    f64::from_bits(((exponent + 1023) as u64) << 52)
}

/// Bounds the error of the triangle test's volumes relative to (largest coordinate of the ray's origin + 1) × the largest
/// components of the other two vectors, edges or direction: with every coordinate of the triangle at most 1 and
/// relative roundings of 2^-24, the terms sum to less than 101 · 2^-24; that is rounded up to 2^-17. Fused products round
/// less.
const VOLUME_ERROR: f32 = 1.0 / 131_072.0;

/// No primitive.
pub const NONE: u32 = u32::MAX;

/// Nodes still to be visited.
#[derive(Debug, Default)]
pub struct Stack {
    /// The first so many entries count that the traversal says.
    pub(super) any: Vec<u32>,
    /// With a lower bound of where.
    nearest: Vec<(u32, f32)>,
}

/// Runs the version of a traversal that is made for this processor.
macro_rules! dispatch {
    ($function:ident($($argument:expr),*)) => {{
        #[cfg(target_arch = "x86_64")]
        {
            use std::arch::is_x86_feature_detected as has;
            if has!("avx512f") && has!("avx512vl") && has!("fma") {
                // SAFETY: the processor has these features.
                return unsafe { avx512::$function($($argument),*) };
            }
            if has!("avx2") && has!("fma") {
                // SAFETY: as above.
                return unsafe { avx2::$function($($argument),*) };
            }
        }
        portable::$function($($argument),*)
    }};
}

/// Visits the leaves that the ray may touch until `visit` returns true; returns whether it did.
#[inline]
pub fn any<T>(tree: &Tree<T>, ray: &Ray, stack: &mut Stack, visit: impl FnMut(&T) -> bool) -> bool {
    dispatch!(any(tree, ray, stack, visit))
}

/// Visits the triangles other than `except` that the ray may cross until `visit` returns true; returns whether it did.
#[inline]
pub fn any_triangle(
    tree: &Tree<Leaf>,
    ray: &Ray,
    except: u32,
    stack: &mut Stack,
    visit: impl FnMut(u32) -> bool,
) -> bool {
    dispatch!(any_triangle(tree, ray, except, stack, visit))
}

/// Visits the triangles that the ray may cross, nearer boxes first; `visit` returns a new, nearer end if it has found one.
#[inline]
pub fn nearest_triangle(tree: &Tree<Leaf>, ray: &Ray, stack: &mut Stack, visit: impl FnMut(u32) -> Option<f64>) {
    dispatch!(nearest_triangle(tree, ray, stack, visit));
}

/// The traversal, in terms of the eight-lane functions in scope.
macro_rules! kernels {
    ($(#[$feature:meta])?) => {
        $(#[$feature])?
        #[inline]
        pub fn any<T>(tree: &Tree<T>, ray: &Ray, stack: &mut Stack, mut visit: impl FnMut(&T) -> bool) -> bool {
            if tree.nodes.is_empty() {
                return false;
            }
            let stack = &mut stack.any;
            let (mut at, mut waiting) = (0, 0);
            loop {
                if at & LEAF == 0 {
                    let node = &tree.nodes[at as usize];
                    let (mut hits, _) = boxes(node, ray);
                    if hits != 0 {
                        at = node.children[hits.trailing_zeros() as usize % WIDTH];
                        hits &= hits - 1;
                        if hits != 0 {
                            if stack.len() < waiting + WIDTH {
                                stack.resize(2 * waiting + 8 * WIDTH, 0);
                            }
                            while hits != 0 {
                                stack[waiting] = node.children[hits.trailing_zeros() as usize % WIDTH];
                                waiting += 1;
                                hits &= hits - 1;
                            }
                        }
                        continue;
                    }
                } else if visit(&tree.leaves[(at ^ LEAF) as usize]) {
                    return true;
                }
                if waiting == 0 {
                    return false;
                }
                waiting -= 1;
                at = stack[waiting];
            }
        }

        $(#[$feature])?
        pub fn any_triangle(
            tree: &Tree<Leaf>,
            ray: &Ray,
            except: u32,
            stack: &mut Stack,
            mut visit: impl FnMut(u32) -> bool,
        ) -> bool {
            any(tree, ray, stack, |leaf| {
                let mut triangles = triangles(leaf, ray);
                while triangles != 0 {
                    let primitive = leaf.primitive[triangles.trailing_zeros() as usize % WIDTH];
                    if primitive != except && visit(primitive) {
                        return true;
                    }
                    triangles &= triangles - 1;
                }
                false
            })
        }

        $(#[$feature])?
        pub fn nearest_triangle(
            tree: &Tree<Leaf>,
            ray: &Ray,
            stack: &mut Stack,
            mut visit: impl FnMut(u32) -> Option<f64>,
        ) {
            if tree.nodes.is_empty() {
                return;
            }
            let mut ray = *ray;
            let stack = &mut stack.nearest;
            stack.clear();
            stack.push((0, 0.0));
            while let Some((at, t_near)) = stack.pop() {
                if t_near > ray.t_max {
                    continue;
                }
                if at & LEAF != 0 {
                    let leaf = &tree.leaves[(at ^ LEAF) as usize];
                    let mut triangles = triangles(leaf, &ray);
                    while triangles != 0 {
                        if let Some(t_max) = visit(leaf.primitive[triangles.trailing_zeros() as usize % WIDTH]) {
                            ray.shorten(t_max);
                        }
                        triangles &= triangles - 1;
                    }
                    continue;
                }
                let node = &tree.nodes[at as usize];
                let (mut hits, distances) = boxes(node, &ray);
                let distances = store(mul(distances, splat(1.0 - 2f32.powi(-20))));
                let from = stack.len();
                while hits != 0 {
                    let slot = hits.trailing_zeros() as usize % WIDTH;
                    hits &= hits - 1;
                    stack.push((node.children[slot], distances[slot]));
                }
                // Nearest on top.
                stack[from..].sort_unstable_by(|a, b| b.1.total_cmp(&a.1));
            }
        }

        /// Which child boxes the ray may meet, and where, too far by at most four roundings of 2^-24.
        $(#[$feature])?
        #[inline]
        fn boxes(node: &Node, ray: &Ray) -> (u32, F8) {
            let planes = |axis: usize| {
                let inverse = splat(ray.inverse[axis]);
                let negative = (ray.negative >> axis & 1) as usize;
                [
                    mul_add(load(&node.bounds[axis][negative]), inverse, splat(ray.offset_near[axis])),
                    mul_add(load(&node.bounds[axis][1 - negative]), inverse, splat(ray.offset_far[axis])),
                ]
            };
            let [x, y, z] = [planes(0), planes(1), planes(2)];
            let near = max(max(x[0], y[0]), max(z[0], splat(0.0)));
            let far = min(min(x[1], y[1]), min(z[1], splat(ray.t_max)));
            // Relative roundings on each side: the direction, its reciprocal and the distance, 2^-24 each; rounded up.
            (not_above(near, mul(far, splat(1.0 + 2f32.powi(-19)))), near)
        }

        /// Which triangles of a leaf the ray may cross: Möller and Trumbore 1997, without division, every sign decided only
        /// beyond its error bound.
        $(#[$feature])?
        #[inline]
        fn triangles(leaf: &Leaf, ray: &Ray) -> u32 {
            let d = ray.direction.to_array().map(|x| splat(x));
            let o = ray.origin.to_array().map(|x| splat(x));
            let size = load(&leaf.size);
            let edge1 = [load(&leaf.edge1[0]), load(&leaf.edge1[1]), load(&leaf.edge1[2])];
            let edge2 = [load(&leaf.edge2[0]), load(&leaf.edge2[1]), load(&leaf.edge2[2])];
            let s = [
                sub(o[0], load(&leaf.corner[0])),
                sub(o[1], load(&leaf.corner[1])),
                sub(o[2], load(&leaf.corner[2])),
            ];
            let p = cross(d, edge2);
            let q = cross(s, edge1);
            let det = dot(edge1, p);
            let u = dot(s, p);
            let v = dot(d, q);
            let w = sub(sub(det, u), v);
            let error = mul(splat(ray.error), size);
            // Inside where no two of u, v, w surely differ in sign; w carries the errors of all three of its terms.
            let error_w = mul(error, splat(3.0));
            let surely_positive = or(or(above(u, error), above(v, error)), above(w, error_w));
            let surely_negative = or(or(above(negate(u), error), above(negate(v), error)), above(negate(w), error_w));
            // Beyond either end, where the determinant's sign is sure.
            let error_t = mul(mul(splat(ray.error_t), size), size);
            let error_det = mul(error, size);
            let sign = sign_of(det);
            let t = xor(dot(edge2, q), sign);
            let magnitude = xor(det, sign);
            let behind = above(negate(t), error_t);
            let beyond = above(t, add(mul(splat(ray.t_max), add(magnitude, error_det)), error_t));
            let ruled_out =
                or(and(surely_positive, surely_negative), and(above(magnitude, error_det), or(behind, beyond)));
            let unused = above(splat(0.0), size);
            !mask(or(ruled_out, unused)) & 0xff
        }

        $(#[$feature])?
        #[inline]
        fn cross(a: [F8; 3], b: [F8; 3]) -> [F8; 3] {
            [
                mul_sub(a[1], b[2], mul(a[2], b[1])),
                mul_sub(a[2], b[0], mul(a[0], b[2])),
                mul_sub(a[0], b[1], mul(a[1], b[0])),
            ]
        }

        $(#[$feature])?
        #[inline]
        fn dot(a: [F8; 3], b: [F8; 3]) -> F8 {
            mul_add(a[2], b[2], mul_add(a[1], b[1], mul(a[0], b[0])))
        }
    };
}

/// Eight lanes in one register.
#[cfg(target_arch = "x86_64")]
macro_rules! one_register {
    ($features:tt) => {
        use std::arch::x86_64::*;

        use super::{LEAF, Leaf, Node, Ray, Stack, Tree, WIDTH};

        type F8 = __m256;

        lanes! { target_feature(enable = $features);
            splat(x: f32) -> F8 { _mm256_set1_ps(x) }
            load(x: &[f32; WIDTH]) -> F8 { bytemuck::must_cast(*x) }
            store(x: F8) -> [f32; WIDTH] { bytemuck::must_cast(x) }
            add(a: F8, b: F8) -> F8 { _mm256_add_ps(a, b) }
            sub(a: F8, b: F8) -> F8 { _mm256_sub_ps(a, b) }
            mul(a: F8, b: F8) -> F8 { _mm256_mul_ps(a, b) }
            mul_add(a: F8, b: F8, c: F8) -> F8 { _mm256_fmadd_ps(a, b, c) }
            mul_sub(a: F8, b: F8, c: F8) -> F8 { _mm256_fmsub_ps(a, b, c) }
            min(a: F8, b: F8) -> F8 { _mm256_min_ps(a, b) }
            max(a: F8, b: F8) -> F8 { _mm256_max_ps(a, b) }
            or(a: F8, b: F8) -> F8 { _mm256_or_ps(a, b) }
            and(a: F8, b: F8) -> F8 { _mm256_and_ps(a, b) }
            xor(a: F8, b: F8) -> F8 { _mm256_xor_ps(a, b) }
            sign_of(a: F8) -> F8 { _mm256_and_ps(a, _mm256_set1_ps(-0.0)) }
            negate(a: F8) -> F8 { _mm256_xor_ps(a, _mm256_set1_ps(-0.0)) }
            above(a: F8, b: F8) -> F8 { _mm256_cmp_ps::<_CMP_GT_OQ>(a, b) }
            not_above(a: F8, b: F8) -> u32 { mask(_mm256_cmp_ps::<_CMP_LE_OQ>(a, b)) }
            mask(a: F8) -> u32 { _mm256_movemask_ps(a) as u32 }
        }

        kernels!(#[target_feature(enable = $features)]);
    };
}

#[cfg(target_arch = "x86_64")]
macro_rules! lanes {
    ($attribute:meta; $($name:ident($($arg:ident: $type:ty),*) -> $result:ty { $body:expr })*) => {
        $(#[$attribute]
        #[inline]
        fn $name($($arg: $type),*) -> $result { $body })*
    };
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    one_register!("avx2,fma");
}

/// The same instructions with twice the registers.
#[cfg(target_arch = "x86_64")]
mod avx512 {
    one_register!("avx512f,avx512vl,fma");
}

mod portable {
    //! Eight lanes in an array.

    use super::{LEAF, Leaf, Node, Ray, Stack, Tree, WIDTH};

    type F8 = [f32; WIDTH];

    const SET: f32 = f32::from_bits(u32::MAX);

    fn map2(a: F8, b: F8, f: impl Fn(f32, f32) -> f32) -> F8 {
        std::array::from_fn(|i| f(a[i], b[i]))
    }

    fn bits2(a: F8, b: F8, f: impl Fn(u32, u32) -> u32) -> F8 {
        map2(a, b, |a, b| f32::from_bits(f(a.to_bits(), b.to_bits())))
    }

    macro_rules! lanes {
        ($($name:ident($($arg:ident: $type:ty),*) -> $result:ty { $body:expr })*) => {
            $(#[inline(always)]
            fn $name($($arg: $type),*) -> $result { $body })*
        };
    }

    lanes! {
        splat(x: f32) -> F8 { [x; WIDTH] }
        load(x: &[f32; WIDTH]) -> F8 { *x }
        store(x: F8) -> F8 { x }
        add(a: F8, b: F8) -> F8 { map2(a, b, |a, b| a + b) }
        sub(a: F8, b: F8) -> F8 { map2(a, b, |a, b| a - b) }
        mul(a: F8, b: F8) -> F8 { map2(a, b, |a, b| a * b) }
        mul_add(a: F8, b: F8, c: F8) -> F8 { add(mul(a, b), c) }
        mul_sub(a: F8, b: F8, c: F8) -> F8 { sub(mul(a, b), c) }
        min(a: F8, b: F8) -> F8 { map2(a, b, |a, b| if a < b { a } else { b }) }
        max(a: F8, b: F8) -> F8 { map2(a, b, |a, b| if a > b { a } else { b }) }
        or(a: F8, b: F8) -> F8 { bits2(a, b, |a, b| a | b) }
        and(a: F8, b: F8) -> F8 { bits2(a, b, |a, b| a & b) }
        xor(a: F8, b: F8) -> F8 { bits2(a, b, |a, b| a ^ b) }
        sign_of(a: F8) -> F8 { and(a, splat(-0.0)) }
        negate(a: F8) -> F8 { xor(a, splat(-0.0)) }
        above(a: F8, b: F8) -> F8 { map2(a, b, |a, b| if a > b { SET } else { 0.0 }) }
        not_above(a: F8, b: F8) -> u32 { mask(map2(a, b, |a, b| if a <= b { SET } else { 0.0 })) }
        mask(a: F8) -> u32 { a.iter().enumerate().fold(0, |mask, (i, x)| mask | (x.to_bits() >> 31) << i) }
    }

    kernels!();
}

#[cfg(test)]
mod tests {
    use obvhs::aabb::Aabb;

    use super::*;
    use crate::geometry::triangle::{Segment, crossing};
    use crate::sampling::hash;

    /// Numbers in [0, 1) with 24 bits.
    struct Random(u32);

    impl Random {
        fn next(&mut self) -> f64 {
            self.0 += 1;
            f64::from(hash(self.0) >> 8) * 2f64.powi(-24)
        }

        fn point(&mut self) -> DVec3 {
            DVec3::new(self.next(), self.next(), self.next())
        }
    }

    /// Triangles of all sizes down to a thousandth, a third of them in planes of constant x, y or z.
    fn triangles(random: &mut Random, count: usize) -> Vec<[DVec3; 3]> {
        let near = |corner: DVec3| corner.clamp(DVec3::ZERO, DVec3::ONE).as_vec3().as_dvec3();
        (0..count)
            .map(|i| {
                let (center, size) = (random.point(), 0.5 * 2f64.powf(-10.0 * random.next()));
                let mut corners = [(); 3].map(|()| near(center + size * (2.0 * random.point() - 1.0)));
                if i % 3 == 0 {
                    let axis = i / 3 % 3;
                    corners.iter_mut().for_each(|corner| corner[axis] = near(center)[axis]);
                }
                corners
            })
            .collect()
    }

    fn tree_of(triangles: &[[DVec3; 3]]) -> Tree<Leaf> {
        let box_of = |i: u32| {
            let [a, b, c] = triangles[i as usize].map(|corner| corner.as_vec3a());
            Aabb::new(a.min(b).min(c), a.max(b).max(c))
        };
        Tree::build(triangles.len() as u32, box_of, WIDTH as u32, |primitives| {
            let mut leaf = Leaf::EMPTY;
            for (slot, &primitive) in primitives.iter().enumerate() {
                leaf.set(slot, primitive, triangles[primitive as usize]);
            }
            leaf
        })
    }

    /// The triangles that each version that this processor can run lets through.
    fn candidates(tree: &Tree<Leaf>, ray: &Ray) -> Vec<Vec<u32>> {
        let mut stack = Stack::default();
        let mut all = Vec::new();
        let mut run = |traverse: &dyn Fn(&mut Stack, &mut Vec<u32>)| {
            let mut found = Vec::new();
            traverse(&mut stack, &mut found);
            all.push(found);
        };
        fn keep(found: &mut Vec<u32>) -> impl FnMut(u32) -> bool {
            |primitive| {
                found.push(primitive);
                false
            }
        }
        run(&|stack, found| {
            portable::any_triangle(tree, ray, NONE, stack, keep(found));
        });
        run(&|stack, found| {
            portable::nearest_triangle(tree, ray, stack, |primitive| {
                found.push(primitive);
                None
            });
        });
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: the processor has these features.
                run(&|stack, found| unsafe {
                    avx2::any_triangle(tree, ray, NONE, stack, keep(found));
                });
            }
            if std::arch::is_x86_feature_detected!("avx512vl") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: as above.
                run(&|stack, found| unsafe {
                    avx512::any_triangle(tree, ray, NONE, stack, keep(found));
                });
            }
        }
        all
    }

    /// Every version lets through what the exact test finds, however long the ray's direction is in numbers.
    #[test]
    fn no_version_loses_a_crossing() {
        let mut random = Random(0);
        let triangles = triangles(&mut random, 3000);
        let tree = tree_of(&triangles);
        let mut crossings = 0;
        for i in 0..6000 {
            // Half of the rays end barely behind an edge of a triangle.
            let [a, b, _] = triangles[(7 * i) % triangles.len()];
            let target = if i % 2 == 0 { random.point() } else { a + (b - a) * random.next() };
            let mut origin = (random.point() - 0.25) * 1.5;
            match i % 5 {
                // Parallel to an axis, exactly or nearly.
                0 => {
                    let axis = i / 5 % 3;
                    origin = target;
                    origin[axis] = -0.5;
                    origin[(axis + 1) % 3] += [0.0, 1e-30, 1e-12][i / 15 % 3];
                }
                // From as far as the exact test can be trusted with the smallest triangles.
                // From as far as the exact test can be trusted with the smallest triangles.
                1 => origin = target + 1e3 * (origin - target),
                // From a corner.
                2 => origin = triangles[i % triangles.len()][0],
                _ => {}
            }
            let length = 2f64.powi([0, -38, -60, 45, -300, 200][i % 6]);
            let direction = (target - origin) * (1.0 + 2f64.powi(-40));
            let segment = Segment { origin, direction, origin_error: DVec3::ZERO, end_error: Some(DVec3::ZERO) };
            let ray = Ray::new(origin, 0.0, segment.direction * length, 1.0 / length);
            let exact: Vec<u32> =
                (0..triangles.len() as u32).filter(|&t| crossing(&segment, triangles[t as usize]).is_some()).collect();
            crossings += exact.len();
            for (version, found) in candidates(&tree, &ray).iter().enumerate() {
                let lost: Vec<_> = exact.iter().filter(|t| !found.contains(t)).collect();
                assert!(lost.is_empty(), "ray {i}, version {version}: {lost:?}");
            }
        }
        assert!(crossings > 12_000, "{crossings} crossings are too few to tell");
    }

    /// The error bounds leave the test sharp: hardly a triangle is let through that isn't crossed.
    #[test]
    fn few_triangles_are_let_through_in_vain() {
        let mut random = Random(77);
        let triangles = triangles(&mut random, 3000);
        let tree = tree_of(&triangles);
        let (mut let_through, mut crossed) = (0, 0);
        for _ in 0..500 {
            let (origin, target) = (random.point(), random.point());
            let segment =
                Segment { origin, direction: target - origin, origin_error: DVec3::ZERO, end_error: Some(DVec3::ZERO) };
            crossed += triangles.iter().filter(|&&corners| crossing(&segment, corners).is_some()).count();
            let_through += candidates(&tree, &Ray::new(origin, 0.0, segment.direction, 1.0))[0].len();
        }
        assert!(crossed > 1000 && let_through <= crossed + crossed / 100, "{let_through} for {crossed}");
    }
}
