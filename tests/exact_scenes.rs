//! The exact reference in scenes with links, cut-outs and instances, and how the command holds images against it.

mod common;

use common::*;
use glam::{DAffine3, DMat3, DVec3, Vec3};
use penumbra::geometry::bvh::{Plane, SceneBvh, Scratch};
use penumbra::progress::Progress;
use penumbra::receivers::Receiver;
use penumbra::reference::exact::Exact;
use penumbra::render::{Request, render, render_receivers};
use penumbra::sampling::Pattern;
use penumbra::scene::procedural::build;
use penumbra::scene::{AreaLight, Cutout, Instance, Material, Node, Scene};

/// Receivers on the floor, off any symmetry.
fn line() -> Vec<DVec3> {
    (0..60).map(|i| DVec3::new(-2.0 + 4.0 * (f64::from(i) + 0.5) / 60.0, 0.0, 0.0137)).collect()
}

#[test]
fn excluded_casters_do_not_block_and_excluded_receivers_are_not_lit() {
    let meshes = vec![mesh(&quad([-9.0, 9.0], 0.0, [-9.0, 9.0])), mesh(&quad([-9.0, 9.0], 2.0, [-9.0, 9.0]))];
    let see_through = AreaLight { shadow_exclude: vec!["node 1".into()], ..square_light(0.5, 5.0) };
    let own = AreaLight { own_instance: Some(1), ..square_light(0.5, 5.0) };
    let turned_off = AreaLight {
        light_exclude: vec!["node 0".into()],
        shadow_exclude: vec!["node 1".into()],
        ..square_light(0.5, 5.0)
    };
    let scene = scene(meshes, vec![square_light(0.5, 5.0), see_through, own, turned_off]);
    let mut on_floor = receivers(&scene, &[DVec3::ZERO], DVec3::Y);
    let floor: &mut Receiver = on_floor.pixels[0].as_mut().expect("one receiver");
    (floor.instance, floor.triangle) = (0, 0);
    let rendering = render_receivers(&scene, on_floor, &Exact, true, &Progress::default()).expect("renders");
    let seen: Vec<(f32, bool)> = rendering.lights.iter().map(|light| (light.visibility[0], light.facing[0])).collect();
    assert_eq!(seen, [(0.0, true), (1.0, true), (1.0, true), (0.0, false)]);
    assert_eq!(rendering.lights[3].irradiance[0], [0.0; 3]);
}

#[test]
fn a_cut_out_without_a_texture_is_a_hole_or_solid_and_never_sampled() {
    for (factor, hidden) in [(0.4, 0.0), (0.6, 1.0)] {
        let mut scene = scene(vec![mesh(&quad([-9.0, 9.0], 2.0, [-9.0, 0.0]))], vec![square_light(0.5, 5.0)]);
        let cutout = Some(Cutout { cutoff: 0.5, factor, texture: None });
        scene.materials.push(Material { name: "leaf".into(), cutout, ..Material::default() });
        scene.meshes[0].material = Some(0);
        let answers = exact(&scene, &receivers(&scene, &[DVec3::new(0.0, 0.0, -1.0)], DVec3::Y)).swap_remove(0);
        assert_eq!((answers[0].visibility, answers[0].sampled), (1.0 - hidden, false), "factor {factor}");
    }
}

/// The scene with each instance's transform applied to a mesh of its own.
fn baked(scene: &Scene) -> Scene {
    let mut baked = scene.clone();
    baked.meshes = Vec::new();
    for (i, instance) in baked.instances.iter_mut().enumerate() {
        let mut mesh = scene.meshes[instance.mesh].clone();
        let place = |p: &Vec3| instance.scene_from_mesh.transform_point3(p.as_dvec3()).as_vec3();
        mesh.positions = mesh.positions.iter().map(place).collect();
        *instance = Instance { mesh: i, node: instance.node, scene_from_mesh: DAffine3::IDENTITY };
        baked.meshes.push(mesh);
    }
    baked
}

/// Instances of one mesh with these transforms, whose entries are powers of two, so that baking them rounds nothing.
fn instances(triangles: &[[[f32; 3]; 3]], transforms: &[DAffine3]) -> Scene {
    let mut scene = Scene { name: "test".into(), meshes: vec![mesh(triangles)], ..Scene::default() };
    for (i, &scene_from_mesh) in transforms.iter().enumerate() {
        scene.nodes.push(Node { name: format!("node {i}"), parent: None });
        scene.instances.push(Instance { mesh: 0, node: i, scene_from_mesh });
    }
    scene.lights = lights_of_every_shape();
    scene
}

#[test]
fn instances_answer_as_the_same_triangles_in_place() {
    let patch = [
        [[-0.5, 0.0, -0.5], [0.5, 0.0, -0.5], [0.0, 0.25, 0.5]],
        [[0.5, 0.0, -0.5], [1.0, 0.5, 0.5], [0.0, 0.25, 0.5]],
    ];
    // So large that it is clipped to the light rather than projected.
    let plane = [[[-8192.0, 0.0, -8192.0], [8192.0, 0.0, -8192.0], [0.125, 0.0, 0.25]]];
    let at = |scale: [f64; 3], translation: [f64; 3]| DAffine3 {
        matrix3: DMat3::from_diagonal(scale.into()),
        translation: translation.into(),
    };
    let placed = [
        at([1.0, 1.0, 1.0], [0.0, 2.0, 0.0]),
        // Where edges of two instances have the same corners in their mesh.
        at([1.0, 1.0, 1.0], [0.5, 2.5, 0.25]),
        at([-1.0, 1.0, 1.0], [-0.5, 1.5, 0.0]),
        at([0.5, -2.0, 0.5], [0.25, 3.0, -0.5]),
    ];
    let mut seen_in_part = 0;
    // Doubles are good to 1e-16 of the largest coordinate that an edge is evaluated from.
    for (triangles, tolerance) in [(patch.as_slice(), 1e-13), (&plane, 8192.0 * 1e-15)] {
        for transforms in [&placed[..], &placed[..1], &placed[1..2], &placed[2..3], &placed[3..]] {
            let scene = instances(triangles, transforms);
            let flat = baked(&scene);
            let answers = [&scene, &flat].map(|scene| exact(scene, &receivers(scene, &line(), DVec3::Y)));
            for (light, (a, b)) in answers[0].iter().zip(&answers[1]).enumerate() {
                for (a, b) in a.iter().zip(b) {
                    assert!((a.visibility - b.visibility).abs() < tolerance, "light {light}: {a:?} {b:?}");
                    seen_in_part += u32::from(a.visibility > 0.0 && a.visibility < 1.0);
                }
            }
        }
    }
    assert!(seen_in_part > 500, "{seen_in_part}");
}

#[test]
fn no_triangle_in_a_pyramid_is_passed_over() {
    let mut random = Random(7);
    let mut found_all = 0;
    for case in 0..40 {
        // Far from the origin by more than its size, on a grid that f32 holds; half of the triangles touch a side of the pyramid.
        let shift = if case % 2 == 0 { DVec3::ZERO } else { DVec3::new(4096.0, -2048.0, 1024.0) };
        let light = random.light("rect");
        let apex = random.in_cube(1.0) + shift;
        let emitter = AreaLight {
            scene_from_light: DAffine3 {
                translation: light.scene_from_light.translation + shift,
                ..light.scene_from_light
            },
            ..light
        };
        let Some(emitter) = emitter.emitter(apex) else { continue };
        let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|uv| emitter.at(uv.into()));
        let triangles: Vec<[[f32; 3]; 3]> = (0..500)
            .map(|i| {
                let (a, b) = (corners[i % 4], corners[(i + 1) % 4]);
                let on_side = apex + (a + (b - a) * random.between(0.0, 1.0)) * random.between(0.1, 0.9);
                let size = 10f64.powf(random.between(-7.0, 0.0));
                let near = if i % 2 == 0 { on_side } else { apex + random.in_cube(3.0) };
                [(); 3].map(|()| (near + random.in_cube(size)).as_vec3().to_array())
            })
            .collect();
        let scene = scene(vec![mesh(&triangles)], Vec::new());
        let apex = apex - scene.origin_world;
        // Inside the four sides through the apex, which turn like the corners.
        let middle: DVec3 = corners.iter().sum();
        let planes: Vec<Plane> = (0..4)
            .map(|i| {
                let normal = corners[i].cross(corners[(i + 1) % 4]);
                Plane { normal: if normal.dot(middle) > 0.0 { -normal } else { normal }, offset: 0.0 }
            })
            .collect();
        let mut bvh = SceneBvh::new(&scene);
        bvh.add(|_| true);
        let mut visited = vec![false; triangles.len()];
        bvh.in_pyramid(apex, &planes, &mut Scratch::default(), |_, triangle| visited[triangle as usize] = true);
        for (i, triangle) in triangles.iter().enumerate() {
            let relative = triangle.map(|p| Vec3::from(p).as_dvec3() - scene.origin_world - apex);
            let is_beyond = |plane: &Plane| relative.iter().all(|corner| plane.normal.dot(*corner) > 0.0);
            if !planes.iter().any(is_beyond) {
                assert!(visited[i], "case {case}, triangle {i}");
                found_all += 1;
            }
        }
    }
    assert!(found_all > 3000, "{found_all}");
}

#[test]
fn verification_finds_the_error_of_the_whole_image() {
    let scene = build("demo").expect("builds").scene;
    let camera = &scene.cameras[0];
    let request = Request { size: [160, 120], irradiance: false, shaded: None, antialiasing: 1, verify: Some(512) };
    let progress = Progress::default();
    let truth =
        render(&scene, camera, &Exact, &Request { verify: None, ..request.clone() }, &progress).expect("renders");
    for (pattern, samples) in
        [(Pattern::Grid, 16), (Pattern::Jittered, 16), (Pattern::Halton, 64), (Pattern::Sobol, 64)]
    {
        let rendering = render(&scene, camera, &rays(pattern, samples), &request, &progress).expect("renders");
        for ((image, truth), verified) in rendering.lights.iter().zip(&truth.lights).zip(&rendering.verified) {
            let errors: Vec<f64> = (0..image.visibility.len())
                .filter(|&i| image.facing[i])
                .map(|i| f64::from(image.visibility[i]) - f64::from(truth.visibility[i]))
                .collect();
            let rmse = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
            let [low, high] = verified.rmse_ci95;
            // Eight intervals of 95 %, of seeds that are fixed.
            assert!(low <= rmse && rmse <= high, "{pattern:?} {samples}: {rmse} is not in {low} to {high}");
            assert!(high < 3.0 * low, "{pattern:?} {samples}: {low} to {high} tells nothing");
            assert_eq!((verified.receivers, verified.sampled), (512, 0));
        }
    }
}
