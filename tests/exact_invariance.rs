//! What must not change the exact reference's answers: how a scene is cut into triangles, meshes and instances, in which order
//! they come, its size, and the number of threads.

mod common;

use std::collections::HashMap;

use common::*;
use glam::{DMat3, DVec2, DVec3, Vec3};
use penumbra::progress::Progress;
use penumbra::receivers::{Receiver, Receivers};
use penumbra::reference::exact::{Answer, Exact};
use penumbra::render::render_receivers;
use penumbra::scene::light::{Domain, Emitter};
use penumbra::scene::{Instance, Mesh, Node, Scene};
use penumbra::techniques::LightImage;

/// V and E (as a share of E₀) of the same geometry told differently: the few roundings of a sum in another order.
const SAME: f64 = 1e-12;

/// Receivers on the floor with normals around +Y, shading normals around these.
fn on_floor(scene: &Scene, count: usize) -> Receivers {
    let mut random = Random(77);
    let at: Vec<DVec3> =
        (0..count).map(|_| DVec3::new(random.between(-2.0, 2.0), 0.0, random.between(-2.0, 2.0))).collect();
    let mut receivers = receivers(scene, &at, DVec3::Y);
    for (i, receiver) in receivers.pixels.iter_mut().flatten().enumerate() {
        // Every third receiver is as tilted as to lose some light below its horizon, every second is smoothed.
        if i % 3 == 0 {
            receiver.normal = (DVec3::Y + random.in_cube(2.0)).normalize();
            receiver.shading_normal = receiver.normal;
        }
        if i % 2 == 0 {
            let bent = (receiver.normal + random.in_cube(0.4)).normalize();
            receiver.shading_normal = penumbra::receivers::toward(bent, receiver.normal);
        }
    }
    receivers
}

/// Casters between the floor and the lights: patches of a bumpy surface that share edges, and loose triangles, some through
/// the floor and above the lights.
fn casters() -> Scene {
    let mut random = Random(5);
    let mut bumps = Vec::new();
    let height = |i: i32, j: i32| 1.0 + 0.25 * ((i * 7 + j * 13).rem_euclid(11)) as f32 / 11.0;
    for i in -5..5 {
        for j in -5..5 {
            if (i * i + j) % 3 == 0 {
                continue;
            }
            let at = |i: i32, j: i32| [i as f32 * 0.13, height(i, j), j as f32 * 0.13];
            bumps.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
            bumps.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
    }
    let mut loose = Vec::new();
    for case in 0..24 {
        let middle = DVec3::new(random.between(-1.5, 1.5), random.between(0.5, 3.0), random.between(-1.5, 1.5));
        let size = if case % 8 == 0 { 6.0 } else { 0.4 };
        loose.push([0; 3].map(|_| (middle + random.in_cube(size)).as_vec3().to_array()));
    }
    scene(vec![mesh(&bumps), mesh(&loose)], lights_of_every_shape())
}

fn same(a: &[Vec<Answer>], b: &[Vec<Answer>], unshadowed: &[Vec<Answer>], what: &str) {
    for (light, ((a, b), whole)) in a.iter().zip(b).zip(unshadowed).enumerate() {
        for (i, ((a, b), whole)) in a.iter().zip(b).zip(whole).enumerate() {
            let (a, b, whole) = (a, b, whole.irradiance.max_element());
            assert!((a.visibility - b.visibility).abs() <= SAME, "{what}, light {light}, receiver {i}: {a:?} {b:?}");
            let off = (a.irradiance - b.irradiance).abs().max_element();
            assert!(off <= SAME * whole, "{what}, light {light}, receiver {i}: {a:?} {b:?} of {whole}");
            assert_eq!((a.facing, a.sampled, b.sampled), (b.facing, false, false), "{what}, {light}, {i}");
        }
    }
}

/// What an empty scene of the same lights gives.
fn unshadowed(scene: &Scene, receivers: &Receivers) -> Vec<Vec<Answer>> {
    let mut open = scene.clone();
    open.instances.clear();
    exact(&open, receivers)
}

/// All meshes as one instance a triangle.
fn loosened(scene: &Scene) -> Scene {
    let mut split = scene.clone();
    (split.meshes, split.instances, split.nodes) = (Vec::new(), Vec::new(), Vec::new());
    for instance in &scene.instances {
        let whole = &scene.meshes[instance.mesh];
        for &triangle in &whole.triangles {
            let number = split.meshes.len();
            split.nodes.push(Node { name: format!("node {number}"), parent: None });
            split.instances.push(Instance { mesh: number, node: number, ..instance.clone() });
            split.meshes.push(Mesh { triangles: vec![triangle], ..whole.clone() });
        }
    }
    split
}

#[test]
fn the_same_triangles_told_differently_have_the_same_answers() {
    let scene = casters();
    let receivers = on_floor(&scene, 1500);
    let whole = unshadowed(&scene, &receivers);
    let found = exact(&scene, &receivers);
    let partial = found.iter().flatten().filter(|a| a.visibility > 0.0 && a.visibility < 1.0).count();
    assert!(partial > 500, "only {partial} in a penumbra");

    let mut permuted = scene.clone();
    for mesh in &mut permuted.meshes {
        mesh.triangles.reverse();
        for (i, [a, b, c]) in mesh.triangles.iter_mut().enumerate() {
            (*a, *b, *c) = if i % 2 == 0 { (*b, *c, *a) } else { (*c, *b, *a) };
        }
    }
    same(&found, &exact(&permuted, &receivers), &whole, "triangles and corners in another order");

    let mut reversed = scene.clone();
    reversed.instances.reverse();
    same(&found, &exact(&reversed, &receivers), &whole, "instances in another order");

    let mut twice = scene.clone();
    for mesh in &mut twice.meshes {
        let again = mesh.triangles.clone();
        mesh.triangles.extend(again.iter().map(|&[a, b, c]| [b, a, c]));
    }
    same(&found, &exact(&twice, &receivers), &whole, "every triangle and its back");

    let mut instanced = scene.clone();
    instanced.instances.extend(scene.instances.iter().cloned());
    instanced.instances.extend(scene.instances.iter().cloned());
    same(&found, &exact(&instanced, &receivers), &whole, "laid over itself twice");

    same(&found, &exact(&loosened(&scene), &receivers), &whole, "an instance a triangle");

    // Every corner its own position, and every position of a mesh in one buffer: indices are no identity.
    let mut unindexed = scene.clone();
    for mesh in &mut unindexed.meshes {
        let positions: Vec<Vec3> = mesh.triangles.iter().flatten().map(|&i| mesh.positions[i as usize]).collect();
        mesh.triangles = (0..mesh.triangles.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        mesh.positions = positions.into();
    }
    same(&found, &exact(&unindexed, &receivers), &whole, "no shared corners");
}

#[test]
fn the_same_triangles_told_differently_have_the_same_bits() {
    // Order alone is no reason for a bit to differ.
    let scene = casters();
    let receivers = on_floor(&scene, 500);
    let found = exact(&scene, &receivers);
    let mut permuted = scene.clone();
    permuted.instances.reverse();
    for mesh in &mut permuted.meshes {
        mesh.triangles.reverse();
        for triangle in &mut mesh.triangles {
            triangle.rotate_left(1);
        }
    }
    for (light, (a, b)) in found.iter().zip(exact(&permuted, &receivers)).enumerate() {
        for (i, (a, b)) in a.iter().zip(b).enumerate() {
            assert_eq!(a, &b, "light {light}, receiver {i}");
        }
    }
}

#[test]
fn a_mesh_turned_and_turned_back_is_the_same() {
    // A quarter turn changes no digit.
    let scene = casters();
    let receivers = on_floor(&scene, 500);
    let whole = unshadowed(&scene, &receivers);
    let turn = DMat3::from_cols(DVec3::NEG_Z, DVec3::Y, DVec3::X);
    let mut turned = scene.clone();
    for mesh in &mut turned.meshes {
        mesh.positions = mesh.positions.iter().map(|p| Vec3::new(-p.z, p.y, p.x)).collect();
    }
    for instance in &mut turned.instances {
        assert_eq!(turn * DVec3::new(-3.0, 2.0, 1.0), DVec3::new(1.0, 2.0, 3.0));
        instance.scene_from_mesh.matrix3 = turn;
    }
    same(&exact(&scene, &receivers), &exact(&turned, &receivers), &whole, "a quarter turn");
}

/// Where a point of the scene is on the light's plane, in its half axes, and whether it lies strictly before it.
fn image(emitter: &Emitter, to: DVec3) -> Option<DVec2> {
    let share = emitter.normal.dot(to) / emitter.normal.dot(emitter.center);
    let offset = to / share - emitter.center;
    let along = |half: DVec3| offset.dot(half) / half.length_squared();
    (share > 0.0 && (emitter.distant || share < 1.0)).then(|| DVec2::new(along(emitter.half_u), along(emitter.half_v)))
}

#[test]
fn subdivided_triangles_differ_by_the_rounding_of_their_new_corners() {
    // Triangles that lie before the lights alone, so that each has an image.
    let mut scene = casters();
    scene.instances.truncate(1);
    scene.lights.pop();
    let coarse = &scene.meshes[0];
    let mut fine = scene.clone();
    let mut positions = coarse.positions.to_vec();
    let mut middles: HashMap<[[u32; 3]; 2], u32> = HashMap::new();
    let mut middle = |a: u32, b: u32, positions: &mut Vec<Vec3>| {
        let key = |i: u32| positions[i as usize].to_array().map(f32::to_bits);
        let ends = if key(a) < key(b) { [key(a), key(b)] } else { [key(b), key(a)] };
        *middles.entry(ends).or_insert_with(|| {
            // A third along the edge, from the same end for both neighbours: as good as never a float.
            let [from, to] = ends.map(|end| Vec3::from(end.map(f32::from_bits)).as_dvec3());
            positions.push((from + (to - from) / 3.0).as_vec3());
            positions.len() as u32 - 1
        })
    };
    fine.meshes[0].triangles = coarse
        .triangles
        .iter()
        .flat_map(|&[a, b, c]| {
            let [ab, bc, ca] = [[a, b], [b, c], [c, a]].map(|[from, to]| middle(from, to, &mut positions));
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        })
        .collect();
    fine.meshes[0].positions = positions.clone().into();

    let receivers = on_floor(&scene, 600);
    let [found, finer] = [&scene, &fine].map(|scene| exact(scene, &receivers));
    let place = scene.instances[0].scene_from_mesh;
    let (mut differing, mut largest) = (0, 0.0f64);
    for (number, light) in scene.lights.iter().enumerate() {
        for (i, receiver) in receivers.hits().enumerate() {
            let Some(emitter) = light.emitter(receiver.position) else { continue };
            // Each edge's new corner bends it into two sides of a triangle: the image of these triangles is all in which the
            // two unions can differ.
            let at =
                |p: Vec3| image(&emitter, place.transform_point3(p.as_dvec3()) - receiver.position).expect("between");
            let slivers = middles.iter().map(|(ends, &new)| {
                let [from, to] = ends.map(|end| at(Vec3::from(end.map(f32::from_bits))));
                0.5 * (to - from).perp_dot(at(positions[new as usize]) - from).abs()
            });
            let area = if emitter.domain == Domain::Disk { std::f64::consts::PI } else { 4.0 };
            let bound = slivers.sum::<f64>() / area;
            let (a, b) = (found[number][i], finer[number][i]);
            let off = (a.visibility - b.visibility).abs();
            assert!(off <= bound + SAME, "light {number}, receiver {i}: {off:e} above {bound:e}");
            // 2⁻²⁵ of a metre on 0.13 m, a few hundred times: else the bound would bound nothing.
            assert!(bound < 1e-3, "{bound:e}");
            differing += u32::from(off > SAME);
            largest = largest.max(off);
            // cos · cos / r² is at most 1 / depth².
            let depth = -emitter.normal.dot(emitter.center);
            let dark = penumbra::geometry::irradiance::emission_factor(light).x * emitter.area() / (depth * depth);
            let off = (a.irradiance.x - b.irradiance.x).abs();
            assert!(off <= (bound + SAME) * dark, "light {number}, receiver {i}: E {off:e} above {:e}", bound * dark);
        }
    }
    assert!(differing > 100 && largest > 1e-9, "{differing} differ, by {largest:e}: the new corners were not rounded");
}

#[test]
fn answers_do_not_change_with_scale() {
    let scene = casters();
    let receivers = on_floor(&scene, 600);
    let found = exact(&scene, &receivers);
    for exponent in [-20, -3, 20] {
        let factor = 2f64.powi(exponent);
        let moved = |receiver: &Receiver| Receiver { position: receiver.position * factor, ..*receiver };
        let pixels = receivers.pixels.iter().map(|pixel| pixel.as_ref().map(moved)).collect();
        let rescaled = exact(&scaled(&scene, factor), &Receivers { pixels, ..receivers });
        for (light, (a, b)) in found.iter().zip(&rescaled).enumerate() {
            // A point's irradiance falls with the square of the scale, by a power of two.
            let unit = if light == found.len() - 1 { factor * factor } else { 1.0 };
            for (i, (a, b)) in a.iter().zip(b).enumerate() {
                let b = Answer { irradiance: b.irradiance * unit, ..*b };
                assert_eq!(a, &b, "light {light}, receiver {i}, 2^{exponent}");
            }
        }
    }
}

#[test]
fn the_number_of_threads_does_not_matter() {
    let scene = casters();
    let receivers = on_floor(&scene, 400);
    let on = |threads: usize| -> Vec<LightImage> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
        let render = || render_receivers(&scene, receivers.clone(), &Exact, true, &Progress::default());
        let lights = pool.install(render).expect("renders").lights;
        lights.into_iter().map(|image| LightImage { passes: Vec::new(), ..image }).collect()
    };
    let one = on(1);
    assert!(one.iter().any(|image| image.visibility.iter().any(|&v| v > 0.0 && v < 1.0)));
    assert_eq!(one, on(3));
    assert_eq!(one, on(8));
    // Nor what was answered before.
    let answers = exact(&scene, &receivers);
    for (image, answers) in one.iter().zip(answers) {
        let visibility: Vec<f32> = answers.iter().map(|answer| answer.visibility as f32).collect();
        assert_eq!(image.visibility, visibility);
    }
}
