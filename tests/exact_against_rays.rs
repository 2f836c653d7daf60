//! The exact reference judged by `rays`, which shares with it the hierarchy, the lights and E₀ alone: on real scenes the
//! difference falls as rays' samples grow, for every shape of light, and there is none where a light is seen whole or not at
//! all. Where a cut-out decides, both sample, and the image says so.

mod common;
#[path = "common/judged.rs"]
mod judged;

use glam::{DVec2, DVec3};
use judged::{Chosen, choose};
use penumbra::geometry::irradiance::unshadowed;
use penumbra::progress::Progress;
use penumbra::receivers::Receiver;
use penumbra::reference::exact::{Answer, REFERENCE_SEED};
use penumbra::sampling::Pattern;
use penumbra::scene::additions::add_floor;
use penumbra::scene::{AreaLight, LoadOptions, Scene, Shape, gltf};
use penumbra::techniques::rays::{Rays, Seen};
use penumbra::techniques::{Frame, Linking};
use rayon::prelude::*;

/// Not the reference's.
const SEED: u32 = 1;
const _: () = assert!(SEED != REFERENCE_SEED);

/// Receivers a light, in its penumbra and of each other kind.
const PENUMBRA: usize = 64;
const OTHERS: usize = 12;

/// Samples by which the reference is judged.
const SAMPLES: [u32; 4] = [1 << 6, 1 << 8, 1 << 11, 1 << 14];

/// The largest root mean square difference at the most samples.
const TOLERANCE: f64 = 5e-4;

/// What `rays` sees from receivers.
fn trace(frame: &Frame, light: &AreaLight, receivers: &[Chosen], samples: u32) -> Vec<Seen> {
    let rays = Rays { samples, pattern: Pattern::Sobol, seed: SEED };
    let linking = Linking::of(frame.scene, light);
    let seen = receivers.par_iter().map_init(Default::default, |scratch, chosen| {
        rays.trace(frame, light, &chosen.receiver, chosen.number, &linking, scratch)
    });
    seen.collect()
}

fn visibility(seen: &Seen) -> f64 {
    f64::from(seen.count) / f64::from(seen.samples)
}

/// What differences of E are measured in: E₀; where the shading plane cuts the light, and a share of the samples alone counts
/// for it, the E₀ of a receiver that is turned to the light.
fn unit_of_irradiance(light: &AreaLight, chosen: &Chosen) -> f64 {
    let Receiver { position, shading_normal, .. } = chosen.receiver;
    let emitter = light.emitter(position).expect("the light faces the receiver");
    let is_above = |u: f64, v: f64| shading_normal.dot(emitter.at(DVec2::new(u, v))) > 0.0;
    if is_above(-1.0, -1.0) && is_above(1.0, -1.0) && is_above(1.0, 1.0) && is_above(-1.0, 1.0) {
        return chosen.unshadowed;
    }
    let normal = emitter.center.normalize();
    unshadowed(light, &Receiver { normal, shading_normal: normal, ..chosen.receiver }).x
}

fn root_mean_square(differences: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = differences.len() as f64;
    (differences.map(|x| x * x).sum::<f64>() / count).sqrt()
}

fn check_fall(what: &str, errors: &[f64]) {
    let listed = || errors.iter().map(|error| format!("{error:.1e}")).collect::<Vec<_>>().join(", ");
    assert!(errors.is_sorted_by(|a, b| a > b), "{what} does not fall: {}", listed());
    // No slower than that of samples that know nothing of each other.
    let slowest = (f64::from(SAMPLES[0]) / f64::from(SAMPLES[3])).sqrt();
    assert!(errors[3] < slowest * errors[0], "{what} falls too slowly: {}", listed());
    assert!(errors[3] < TOLERANCE, "{what} is too large: {}", listed());
}

fn judge(name: &str) {
    let Some(folder) = common::shared_scenes() else { return };
    let judged = judged::load(name, &folder).expect("loads");
    let bvh = judged.bvh();
    let receivers = judged.receivers(&bvh).expect("finds");
    let progress = Progress::default();
    let frame = Frame {
        scene: &judged.scene,
        bvh: &bvh,
        receivers: &receivers,
        irradiance: true,
        progress: &progress,
        buffers: None,
        shot: None,
    };
    let (mut lit, mut umbra) = (0, 0);
    for light in &judged.lights {
        let what = format!("{name}, {}", light.name);
        let choice = choose(&frame, light, PENUMBRA, OTHERS);
        let all = [&choice.penumbra, &choice.lit, &choice.umbra].into_iter().flatten();
        assert!(all.into_iter().all(|chosen| !chosen.answer.sampled), "{what}: sampled");

        for (receivers, expected) in [(&choice.lit, 1.0), (&choice.umbra, 0.0)] {
            let seen = trace(&frame, light, receivers, SAMPLES[2]);
            for (seen, chosen) in seen.iter().zip(receivers) {
                assert_eq!(visibility(seen), expected, "{what}: V at pixel {}", chosen.number);
                assert_eq!(seen.irradiance_ratio, expected, "{what}: E at pixel {}", chosen.number);
                let difference = chosen.answer.irradiance.x - expected * chosen.unshadowed;
                // The contour's quadrature is good to 1e-9.
                let tolerance = 1e-9 * unit_of_irradiance(light, chosen);
                assert!(difference.abs() <= tolerance, "{what}: exact E at pixel {}", chosen.number);
            }
        }
        lit += choice.lit.len();
        umbra += choice.umbra.len();
        if light.shape.is_point() {
            assert!(choice.penumbra.is_empty(), "{what} has a penumbra");
            continue;
        }
        assert_eq!(choice.penumbra.len(), PENUMBRA, "{what}: receivers in the penumbra");

        let (mut of_visibility, mut of_irradiance) = (Vec::new(), Vec::new());
        for samples in SAMPLES {
            let seen = trace(&frame, light, &choice.penumbra, samples);
            let pairs = || seen.iter().zip(&choice.penumbra);
            of_visibility
                .push(root_mean_square(pairs().map(|(seen, chosen)| visibility(seen) - chosen.answer.visibility)));
            of_irradiance.push(root_mean_square(pairs().map(|(seen, chosen)| {
                let difference = seen.irradiance_ratio * chosen.unshadowed - chosen.answer.irradiance.x;
                difference / unit_of_irradiance(light, chosen)
            })));
        }
        check_fall(&format!("{what}: V"), &of_visibility);
        check_fall(&format!("{what}: E"), &of_irradiance);
    }
    assert!(lit >= 2 * OTHERS && umbra >= 2 * OTHERS, "{name}: {lit} lit receivers, {umbra} in the umbra");
}

#[test]
fn rays_converge_to_exact_on_the_bunny() {
    judge("bunny");
}

#[test]
fn rays_converge_to_exact_on_the_buddha() {
    judge("buddha");
}

#[test]
fn rays_converge_to_exact_on_the_jeep() {
    judge("jeep1");
}

#[test]
fn rays_converge_to_exact_on_the_engine() {
    judge("engine");
}

#[test]
fn rays_converge_to_exact_on_the_palm() {
    judge("palm-tree");
}

#[test]
#[ignore = "a million triangles: scripts/test --full"]
fn rays_converge_to_exact_in_the_kitchen() {
    judge("kitchen");
}

/// A leaf cut out by its texture over a floor, half of it with something solid below it.
struct Leaf {
    scene: Scene,
    /// Its instance.
    leaf: usize,
}

fn leaf() -> Option<Leaf> {
    let path = common::shared_scenes()?.join("alpha-mask/01_alpha_mask.gltf");
    let mut scene = gltf::load(&path, LoadOptions::default()).expect("loads");
    assert_eq!(scene.instances.len(), 1, "the leaf alone");
    let board = common::scene(vec![common::mesh(&common::quad([0.1, 1.6], -0.1, [-0.9, 0.9]))], Vec::new());
    let at_world = board.instances[0].scene_from_mesh.translation + board.origin_world;
    let mut instance = board.instances[0].clone();
    (instance.mesh, instance.node) = (scene.meshes.len(), scene.nodes.len());
    instance.scene_from_mesh.translation = at_world - scene.origin_world;
    scene.meshes.extend(board.meshes);
    scene.nodes.extend(board.nodes);
    scene.instances.push(instance);
    add_floor(&mut scene, Some(-0.5)).expect("a floor");
    let mut light = common::light_down(Shape::Rect { size: DVec2::new(1.2, 0.8) }, [0.3, 2.0, 0.2]);
    light.scene_from_light.translation -= scene.origin_world;
    scene.add_light(light);
    Some(Leaf { scene, leaf: 0 })
}

/// The exact answers on a grid of points of the floor.
fn answers_below(scene: &Scene) -> Vec<Answer> {
    let coordinate = |i: usize| -2.3 + 4.6 * i as f64 / 23.0;
    let positions: Vec<DVec3> = (0..576).map(|i| DVec3::new(coordinate(i % 24), -0.5, coordinate(i / 24))).collect();
    common::exact(scene, &common::receivers(scene, &positions, DVec3::Y)).swap_remove(0)
}

#[test]
fn a_receiver_is_sampled_only_where_a_cutout_decides() {
    let Some(Leaf { scene, leaf }) = leaf() else { return };
    let mut solid = scene.clone();
    solid.materials.iter_mut().for_each(|material| material.cutout = None);
    let mut absent = scene.clone();
    absent.lights[0].shadow_exclude = vec![scene.nodes[scene.instances[leaf].node].name.clone()];
    let (answers, least, most) = (answers_below(&scene), answers_below(&solid), answers_below(&absent));

    let (mut exact, mut sampled) = ([0; 3], 0);
    for ((answer, least), most) in answers.iter().zip(&least).zip(&most) {
        assert!(!least.sampled && !most.sampled, "no cut-out, no sample");
        if answer.sampled {
            sampled += 1;
            assert!(least.visibility < most.visibility, "sampled, though a leaf or none is all the same: {answer:?}");
            let range = least.visibility..=most.visibility;
            assert!(range.contains(&answer.visibility), "{answer:?} is not within {range:?}");
        } else {
            assert_eq!(answer.visibility, least.visibility, "not sampled, though a solid leaf is another matter");
            assert_eq!(answer.visibility, most.visibility, "not sampled, though no leaf is another matter");
            let difference = (answer.irradiance - most.irradiance).abs().max_element();
            assert!(difference <= 1e-12 * most.irradiance.max_element(), "{answer:?}, {most:?}");
            exact[if answer.visibility == 1.0 { 2 } else { usize::from(answer.visibility > 0.0) }] += 1;
        }
    }
    // Umbra and penumbra of what is solid, lit floor, and what the leaf decides.
    assert!(exact.iter().all(|&count| count >= 8) && sampled >= 8, "{exact:?} exact, {sampled} sampled");
}
