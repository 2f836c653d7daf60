//! Only what a scene requires is built and traced: told by counters, not by clocks.

mod common;

use common::*;
use glam::{DAffine3, DVec2, DVec3};
use penumbra::progress::Progress;
use penumbra::render::{Counters, Request, render};
use penumbra::sampling::Pattern;
use penumbra::scene::camera::look_at;
use penumbra::scene::{AreaLight, Camera, Projection, Scene, Shape};

/// Looks straight down at a floor of 2 × 2 around the origin.
fn looking_down() -> Camera {
    Camera {
        name: "down".into(),
        scene_from_camera: look_at(DVec3::new(0.0, 1.0, 0.0), DVec3::ZERO, DVec3::NEG_Z),
        projection: Projection::Orthographic { half_height: 1.0 },
        near: 0.0,
        far: 10.0,
    }
}

/// A floor, the light, and a square of the given place.
fn counters(square: ([f32; 2], f32, [f32; 2]), light: AreaLight) -> Counters {
    let meshes = vec![mesh(&quad([-1.0, 1.0], 0.0, [-1.0, 1.0])), mesh(&quad(square.0, square.1, square.2))];
    let mut scene = scene(meshes, vec![light]);
    scene.cameras.push(looking_down());
    counters_of(&scene)
}

fn counters_of(scene: &Scene) -> Counters {
    let camera = Camera {
        scene_from_camera: DAffine3::from_translation(-scene.origin_world) * scene.cameras[0].scene_from_camera,
        ..scene.cameras[0].clone()
    };
    let request = Request { size: [32, 32], irradiance: false, shaded: None, antialiasing: 1, verify: None };
    render(scene, &camera, &rays(Pattern::Grid, 16), &request, &Progress::default()).expect("renders").counters
}

#[test]
fn a_caster_between_the_view_and_the_light_is_in_the_hierarchy() {
    let found = counters(([-0.2, 0.2], 2.0, [-0.2, 0.2]), square_light(0.5, 5.0));
    assert_eq!(found.stored_triangles, 4);
    assert_eq!((found.lights_traced, found.lights_skipped), (1, 0));
    assert_eq!(found.rays, 32 * 32 * 16);
}

#[test]
fn a_caster_outside_the_hull_of_view_and_light_costs_nothing() {
    let aside = counters(([3.0, 4.0], 2.0, [-0.2, 0.2]), square_light(0.5, 5.0));
    assert_eq!(aside.stored_triangles, 2);
    let above = counters(([-0.2, 0.2], 6.0, [-0.2, 0.2]), square_light(0.5, 5.0));
    assert_eq!(above.stored_triangles, 2);
    // A sun sees it.
    let sun = counters(([-0.2, 0.2], 6.0, [-0.2, 0.2]), light_down(Shape::Sun { angle: 0.01 }, [0.0; 3]));
    assert_eq!(sun.stored_triangles, 4);
}

#[test]
fn a_light_that_reaches_no_receiver_takes_no_pass_and_no_caster() {
    // The square is beside the view, below the light.
    let below = counters(([3.0, 4.0], -2.0, [-0.2, 0.2]), square_light(0.5, -1.0));
    assert_eq!((below.lights_traced, below.lights_skipped, below.rays), (0, 1, 0));
    assert_eq!(below.stored_triangles, 2);
}

#[test]
fn a_light_without_shadow_traces_no_ray() {
    let light = AreaLight { casts_shadow: false, ..square_light(0.5, 5.0) };
    let found = counters(([-0.2, 0.2], 2.0, [-0.2, 0.2]), light);
    assert_eq!((found.rays, found.stored_triangles), (0, 2));
}

#[test]
fn a_point_takes_one_ray_however_many_samples_are_asked_for() {
    let found = counters(([-0.2, 0.2], 2.0, [-0.2, 0.2]), light_down(Shape::Point, [0.0, 5.0, 0.0]));
    assert_eq!(found.rays, 32 * 32);
}

#[test]
fn excluded_casters_do_not_block_and_excluded_receivers_are_not_lit() {
    let meshes = vec![mesh(&quad([-1.0, 1.0], 0.0, [-1.0, 1.0])), mesh(&quad([-90.0, 90.0], 2.0, [-90.0, 90.0]))];
    let see_through = AreaLight { shadow_exclude: vec!["node 1".into()], ..square_light(0.5, 5.0) };
    let turned_off = AreaLight { light_exclude: vec!["node 0".into()], ..square_light(0.5, 5.0) };
    let disk = light_down(Shape::Disk { size: DVec2::ONE }, [0.0, 5.0, 0.0]);
    let mut scene = scene(meshes, vec![see_through, turned_off, disk]);
    scene.cameras.push(looking_down());
    let camera = Camera {
        scene_from_camera: DAffine3::from_translation(-scene.origin_world) * scene.cameras[0].scene_from_camera,
        ..scene.cameras[0].clone()
    };
    let request = Request { size: [8, 8], irradiance: true, shaded: None, antialiasing: 1, verify: None };
    let found = render(&scene, &camera, &rays(Pattern::Grid, 16), &request, &Progress::default()).expect("renders");
    assert!(found.lights[0].visibility.iter().all(|&v| v == 1.0));
    assert!(found.lights[1].facing.iter().all(|&facing| !facing));
    assert!(found.lights[1].irradiance.iter().all(|&e| e == [0.0; 3]));
    assert!(found.lights[2].visibility.iter().all(|&v| v == 0.0));
}
