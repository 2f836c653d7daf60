//! What is left out of the hierarchy changes nothing: not one bit of an image rendered through a camera.

mod common;
#[expect(dead_code, reason = "it draws small scenes, and here its adapter alone is wanted")]
#[path = "common/drawn.rs"]
mod drawn;

use common::{Random, SHAPES, mesh, quad, rays};
use glam::{DAffine3, DVec2, DVec3};
use penumbra::geometry::bvh::{SceneBvh, is_out_of_view};
use penumbra::geometry::shaft::{Shaft, light_bounds};
use penumbra::gpu::light_view::{LightView, Work};
use penumbra::gpu::scene::SceneBuffers;
use penumbra::progress::Progress;
use penumbra::receivers::Receivers;
use penumbra::render::{Request, render};
use penumbra::sampling::{Pattern, Sampler};
use penumbra::scene::camera::look_at;
use penumbra::scene::{Bounds, Camera, Instance, Node, Projection, Scene};
use penumbra::techniques::{Frame, LightImage, Technique};

const SIZE: [u32; 2] = [24, 18];

/// A camera that looks roughly at the middle, from outside or from inside the scene, with every kind of near and far.
fn camera(random: &mut Random, half: f64) -> Camera {
    let eye = random.direction() * random.between(0.0, 2.5 * half);
    let projection = if random.chance(0.5) {
        Projection::Perspective { fov_y: random.between(0.1, 2.0) }
    } else {
        Projection::Orthographic { half_height: random.between(0.1, 1.2) * half }
    };
    let near = if random.chance(0.5) { 0.0 } else { random.between(0.0, 1.5) * half };
    let far = if random.chance(0.5) { f64::INFINITY } else { near + random.between(0.2, 3.0) * half };
    let scene_from_camera = look_at(eye, random.in_cube(0.7 * half), random.direction());
    Camera { name: "camera".into(), scene_from_camera, projection, near, far }
}

/// Many small instances around the origin over a floor, with lights of these shapes and a camera.
fn crowded_scene(random: &mut Random, shapes: &[&str]) -> Scene {
    let mut scene = random.scene(160, 1.4, 4.0);
    let floor = random.between(-4.0, 0.0) as f32;
    scene.nodes.push(Node { name: "floor".into(), parent: None });
    scene.instances.push(Instance { mesh: scene.meshes.len(), node: 160, scene_from_mesh: DAffine3::IDENTITY });
    scene.meshes.push(mesh(&quad([-4.0, 4.0], floor, [-4.0, 4.0])));
    for shape in shapes {
        scene.add_light(random.light(shape));
    }
    scene.cameras.push(camera(random, 4.0));
    scene.rebase();
    scene
}

/// The same image with everything in the hierarchy.
fn unculled(scene: &Scene, offset_px: DVec2, technique: &dyn Technique) -> (Receivers, Vec<LightImage>) {
    let progress = Progress::default();
    let mut bvh = SceneBvh::new(scene);
    bvh.add(|_| true);
    let receivers = Receivers::find(&bvh, &scene.cameras[0], SIZE, offset_px, &progress).expect("finds");
    let frame = Frame {
        scene,
        bvh: &bvh,
        receivers: &receivers,
        irradiance: true,
        progress: &progress,
        buffers: None,
        shot: None,
    };
    let images = scene.lights.iter().map(|light| technique.render(&frame, light).expect("renders")).collect();
    (receivers, images)
}

fn request(antialiasing: u32) -> Request {
    Request { size: SIZE, irradiance: true, shaded: None, antialiasing, verify: None }
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

/// Renders culled and unculled, and says what was found on the way.
fn compare(scene: &Scene, what: &str, tally: &mut Tally) {
    let technique = rays(Pattern::Sobol, 16);
    let camera = &scene.cameras[0];
    let culled = render(scene, camera, &technique, &request(1), &Progress::default()).expect("renders");
    let (receivers, images) = unculled(scene, DVec2::splat(0.5), &technique);
    assert_eq!(culled.receivers.pixels, receivers.pixels, "{what}: receivers of {camera:?}");
    for (light, (got, expected)) in scene.lights.iter().zip(culled.lights.iter().zip(&images)) {
        assert_eq!(bits(&got.visibility), bits(&expected.visibility), "{what}: V of {light:?} through {camera:?}");
        assert_eq!(
            bits(got.irradiance.as_flattened()),
            bits(expected.irradiance.as_flattened()),
            "{what}: E of {light:?} through {camera:?}"
        );
        assert_eq!(got.facing, expected.facing, "{what}: facing of {light:?} through {camera:?}");
        tally.partly_seen += expected.visibility.iter().filter(|&&v| v > 0.0 && v < 1.0).count();
        tally.hidden += expected.visibility.iter().filter(|&&v| v == 0.0).count();
    }
    tally.receivers += receivers.hits().count();
    tally.scenes += 1;
    tally.culled += usize::from(culled.counters.stored_triangles < scene.triangle_count() / 2);
}

/// What random scenes held, so that a comparison of nothing with nothing is noticed.
#[derive(Debug, Default)]
struct Tally {
    scenes: usize,
    culled: usize,
    receivers: usize,
    partly_seen: usize,
    hidden: usize,
}

#[test]
fn an_image_is_the_same_bits_with_and_without_what_was_left_out() {
    let mut random = Random(0x0c11);
    for shape in SHAPES {
        let mut tally = Tally::default();
        for i in 0..40 {
            let scene = crowded_scene(&mut random, &[shape]);
            compare(&scene, &format!("{shape} {i}"), &mut tally);
        }
        assert!(tally.receivers > 40 * 100 && tally.hidden > 500, "{shape}: {tally:?}");
        assert!(shape == "point" || tally.partly_seen > 300, "{shape}: {tally:?}");
        assert!(tally.culled > 0, "{shape}: {tally:?}");
    }
}

#[test]
fn several_lights_share_one_hierarchy() {
    let mut random = Random(0x0c12);
    let mut tally = Tally::default();
    for i in 0..40 {
        let first = random.below(SHAPES.len());
        let scene = crowded_scene(&mut random, &[SHAPES[first], SHAPES[(first + 3) % 8], SHAPES[(first + 5) % 8]]);
        compare(&scene, &format!("scene {i}"), &mut tally);
    }
    assert!(tally.partly_seen > 1000, "{tally:?}");
}

#[test]
fn antialiased_irradiance_is_the_mean_over_unculled_sub_pixels() {
    // Each sub-pixel pass finds receivers of its own in the hierarchy that the passes before have grown.
    let mut random = Random(0x0c13);
    let technique = rays(Pattern::Sobol, 4);
    for shape in SHAPES {
        for i in 0..6 {
            let scene = crowded_scene(&mut random, &[shape]);
            let camera = &scene.cameras[0];
            let culled = render(&scene, camera, &technique, &request(2), &Progress::default()).expect("renders");
            let mut sums = vec![[0f64; 3]; culled.receivers.pixels.len()];
            for offset in [[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]] {
                let (_, images) = unculled(&scene, DVec2::from(offset), &technique);
                for (sum, value) in sums.iter_mut().zip(&images[0].irradiance) {
                    for channel in 0..3 {
                        sum[channel] += 0.25 * f64::from(value[channel]);
                    }
                }
            }
            // A pixel whose centre has no surface has no irradiance, whatever its sub-pixels have.
            let covered = sums.into_iter().zip(&culled.receivers.pixels);
            let expected: Vec<[f32; 3]> =
                covered.map(|(sum, pixel)| if pixel.is_some() { sum.map(|x| x as f32) } else { [0.0; 3] }).collect();
            assert!(culled.lights[0].irradiance == expected, "{shape} {i}");
        }
    }
}

#[test]
fn no_shaft_excludes_a_box_that_a_shadow_ray_meets() {
    let mut random = Random(0x0c14);
    for shape in SHAPES {
        let mut kept = 0;
        for _ in 0..400 {
            let light = random.light(shape);
            let middle = random.in_cube(3.0);
            let points: Vec<DVec3> =
                (0..1 + random.below(4)).map(|_| middle + random.in_cube(random.0 as f64 * 2f64.powi(-64))).collect();
            let receivers: Bounds = points.iter().copied().collect();
            let blockers: Bounds = [random.in_cube(5.0), random.in_cube(5.0)].into_iter().collect();
            let bounds = light_bounds(&light, &receivers, &blockers);
            let shaft = Shaft::between(&receivers, &bounds);
            for _ in 0..100 {
                let origin = points[random.below(points.len())];
                let Some(emitter) = light.emitter(origin) else { continue };
                let sampler = Sampler::new(Pattern::Sobol, 16, random.bits() as u32, 0);
                let to_light = emitter.at(sampler.on_emitter(random.below(16) as u32, &emitter));
                // A sun's rays go on until they have left all that could block them.
                let reach = if emitter.distant { 2.0 * blockers.union(receivers).size().length() } else { 1.0 };
                let at = origin + reach * random.between(0.0, 1.0) * to_light;
                let size = random.between(0.0, 0.3);
                let inside = random.in_cube(1.0).abs() * size;
                let bounds = Bounds { min: at - inside, max: at - inside + size };
                let holds = |inner: DVec3| inner.cmpge(blockers.min).all() && inner.cmple(blockers.max).all();
                if emitter.distant && !holds(at) {
                    continue;
                }
                kept += 1;
                assert!(!shaft.excludes(&bounds), "{light:?}: {bounds:?} from {origin}");
                // The point alone is there but for the rounding of its own computation.
                let rounding = 16.0 * f64::EPSILON * (at.abs() + origin.abs() + to_light.abs() * reach).max_element();
                let point = Bounds { min: at - rounding, max: at + rounding };
                assert!(!shaft.excludes(&point), "{light:?}: {at} from {origin}");
            }
        }
        // Most of a sun's ray lies outside the blockers.
        assert!(kept > if shape == "sun" { 500 } else { 4000 }, "{shape}: {kept}");
    }
}

#[test]
fn what_loses_light_to_a_caster_is_in_a_shadowed_tile() {
    let mut random = Random(0x0c16);
    let gpu = drawn::CONTEXT.gpu().expect("opens");
    let technique = rays(Pattern::Sobol, 64);
    let size = [96, 72];
    for shape in SHAPES {
        let (mut lit, mut tiles, mut darker) = (0, 0, 0);
        for i in 0..24 {
            // A few objects, a floor below them all, and a light above.
            let mut scene = random.scene(4, 0.8, 1.5);
            scene.nodes.push(Node { name: "floor".into(), parent: None });
            scene.instances.push(Instance { mesh: scene.meshes.len(), node: 4, scene_from_mesh: DAffine3::IDENTITY });
            scene.meshes.push(mesh(&quad([-6.0, 6.0], -2.5, [-6.0, 6.0])));
            let mut light = random.light(shape);
            light.scene_from_light.translation = 4.0 * random.direction() + 6.0 * DVec3::Y;
            scene.add_light(light);
            let eye = DVec3::new(random.between(-4.0, 4.0), random.between(0.0, 9.0), 7.0);
            let scene_from_camera = look_at(eye, random.in_cube(1.0), DVec3::Y);
            let projection = Projection::Perspective { fov_y: 0.9 };
            let far = f64::INFINITY;
            scene.cameras.push(Camera { name: "camera".into(), scene_from_camera, projection, near: 0.0, far });
            scene.rebase();
            let progress = Progress::default();
            let mut bvh = SceneBvh::new(&scene);
            bvh.add(|_| true);
            let receivers =
                Receivers::find(&bvh, &scene.cameras[0], size, DVec2::splat(0.5), &progress).expect("finds");
            let buffers = SceneBuffers::new(&gpu, &scene).expect("fits");
            let frame = Frame {
                scene: &scene,
                bvh: &bvh,
                receivers: &receivers,
                irradiance: false,
                progress: &progress,
                buffers: Some(&buffers),
                shot: None,
            };
            let light = &scene.lights[0];
            let view = LightView::in_chunks(&gpu, &frame, light, 64, Work::Shadowed).expect("fits");
            let Some(view) = view else { continue };
            let with = technique.render(&frame, light).expect("renders");
            let unblocked = penumbra::scene::AreaLight { casts_shadow: false, ..light.clone() };
            let without = technique.render(&frame, &unblocked).expect("renders");
            darker += with.visibility.iter().zip(&without.visibility).filter(|(with, without)| with < without).count();
            for &pixel in &view.lit {
                let [with, without] = [&with, &without].map(|image| image.visibility[pixel as usize]);
                assert!(with == without, "{shape} {i}: V = {with} of {without} at {pixel}");
            }
            lit += view.lit_tiles().len();
            tiles += view.tiles.len();
        }
        assert!(darker > 300, "{shape}: {darker} receivers in shadow");
        assert!(10 * lit > tiles, "{shape}: {lit} of {tiles} tiles are lit");
    }
}

#[test]
fn no_box_that_a_pixel_may_see_is_out_of_view() {
    let mut random = Random(0x0c15);
    let mut out = 0;
    for _ in 0..2000 {
        let camera = camera(&mut random, 4.0);
        for _ in 0..50 {
            let at_px = DVec2::new(random.between(0.0, 24.0), random.between(0.0, 18.0));
            let ray = camera.ray(at_px, SIZE);
            let depth = random.between(camera.near, camera.far.min(camera.near + 10.0));
            let at = ray.origin + depth * ray.direction;
            let size = random.between(0.0, 1.0).powi(4) * DVec3::new(3.0, 1.0, 0.2);
            let before = random.in_cube(1.0).abs() * size;
            let rounding = 32.0 * f64::EPSILON * (ray.origin.abs() + depth * ray.direction.abs()).max_element();
            let bounds = Bounds { min: at - before - rounding, max: at - before + size + rounding };
            assert!(!is_out_of_view(&bounds, &camera, SIZE), "{bounds:?} through {at_px} of {camera:?}");
            let center = random.in_cube(8.0);
            out += usize::from(is_out_of_view(&Bounds { min: center - 0.1, max: center + 0.1 }, &camera, SIZE));
        }
    }
    assert!(out > 10_000, "{out} of 100,000 boxes are out of view");
}
