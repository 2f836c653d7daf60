//! What the GPU finds beside what the processor finds.
//!
//! Where both see the same triangle the receivers are equal, bit for bit: both come from the same formula in `f64`. Where they
//! see different ones, each pixel must be one that a rasteriser may take either way (see [`Judge`]).

mod common;

use std::sync::{Arc, LazyLock};

use common::*;
use glam::{DAffine3, DMat3, DVec2, DVec3, Vec2};
use penumbra::geometry::bvh::SceneBvh;
use penumbra::gpu::Gpu;
use penumbra::gpu::gbuffer;
use penumbra::gpu::scene::SceneBuffers;
use penumbra::progress::Progress;
use penumbra::receivers::{Receiver, Receivers};
use penumbra::scene::camera::look_at;
use penumbra::scene::procedural::build;
use penumbra::scene::{Camera, Cutout, LoadOptions, Material, Projection, Scene, Texture, Wrap, gltf};

/// One adapter for all tests.
static GPU: LazyLock<Gpu> = LazyLock::new(|| Gpu::open().expect("a GPU, or a software one"));

const CENTER: DVec2 = DVec2::splat(0.5);

/// How far an edge may lie from its place, pixels. Vertices snap to a grid of 1/256 of a pixel, by at most half a step along
/// each axis: 0.0028. Coordinates reach 2^14 pixels (the guard band), where half an ulp of an f32 is 0.0005: two for the
/// roundings of the transform.
const SNAP_PX: f64 = 1.0 / 256.0;

/// Relative rounding of a depth between those of a triangle's corners, in f32: products and sums of three terms.
const DEPTH_ROUNDING: f64 = 8.0 / 16_777_216.0;

/// Corners of a square around a point.
const AROUND: [DVec2; 4] = [DVec2::ONE, DVec2::new(-1.0, 1.0), DVec2::new(1.0, -1.0), DVec2::NEG_ONE];

/// Judges pixels where a ray and the rasteriser see different triangles. There are three good reasons:
/// - the pixel's centre lies within [`SNAP_PX`] of an edge of one of the two,
/// - both are equally far away, to within the depth buffer's rounding and what the snapping moves their planes; or one alone is
///   seen, and is as far away as the camera's range begins,
/// - one is a cut-out whose alpha crosses its cut-off within the same distance.
struct Judge<'a> {
    bvh: &'a SceneBvh<'a>,
    camera: &'a Camera,
    size: [u32; 2],
}

impl Judge<'_> {
    /// Homogeneous pixel coordinates of a place, scene space.
    fn projected(&self, place: DVec3) -> DVec3 {
        let [width, height] = self.size.map(f64::from);
        let at = self.camera.scene_from_camera.inverse().transform_point3(place);
        let (scale, w) = match self.camera.projection {
            Projection::Perspective { fov_y } => ((0.5 * fov_y).tan(), -at.z),
            Projection::Orthographic { half_height } => (half_height, 1.0),
        };
        let half = 0.5 * height / scale;
        DVec3::new(at.x * half + 0.5 * width * w, 0.5 * height * w - at.y * half, w)
    }

    fn corners(&self, (instance, triangle): (u32, u32)) -> [DVec3; 3] {
        let scene = self.bvh.scene();
        let instance = &scene.instances[instance as usize];
        let corners = scene.meshes[instance.mesh].corners(triangle as usize);
        corners.map(|corner| instance.scene_from_mesh.transform_point3(corner))
    }

    fn is_on_an_edge(&self, at_px: DVec2, of: (u32, u32)) -> bool {
        let corners = self.corners(of).map(|corner| self.projected(corner));
        (0..3).any(|i| {
            let (a, b) = (corners[i], corners[(i + 1) % 3]);
            if a.z > 0.0 && b.z > 0.0 {
                let (a, b) = (a.truncate() / a.z, b.truncate() / b.z);
                let along = ((at_px - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
                return at_px.distance(if along.is_finite() { a.lerp(b, along) } else { a }) <= SNAP_PX;
            }
            // Partly behind the camera: what is seen of it is on the line.
            let line = a.cross(b);
            line.dot(at_px.extend(1.0)).abs() <= SNAP_PX * line.truncate().length()
        })
    }

    /// Depth of a triangle's plane at a pixel, and how far it may be off there.
    fn depth(&self, at_px: DVec2, (instance, triangle): (u32, u32)) -> Option<(f64, f64)> {
        let depth = |offset: DVec2| {
            let ray = self.camera.ray(at_px + offset, self.size);
            self.bvh.plane_crossing(instance, triangle, ray.origin, ray.direction).map(|crossing| crossing.t)
        };
        let here = depth(DVec2::ZERO)?;
        let mut error = 0.0f64;
        for corner in AROUND {
            error = error.max((depth(SNAP_PX * corner)? - here).abs());
        }
        let axis = -self.camera.scene_from_camera.matrix3.z_axis;
        let depths =
            self.corners((instance, triangle)).map(|c| axis.dot(c - self.camera.scene_from_camera.translation));
        let rounding = match self.camera.projection {
            // The buffer holds near/depth, rounded relative to its largest value on the triangle.
            Projection::Perspective { .. } => {
                here * here / depths.into_iter().fold(f64::INFINITY, f64::min).max(self.camera.near).max(1e-6 * here)
            }
            // It holds depth relative to that of the scene.
            Projection::Orthographic { .. } => self.bvh.scene().bounds().size().length(),
        };
        Some((here, error + DEPTH_ROUNDING * rounding))
    }

    /// Whether the surface there is a hole or not by less than the snapping may move it.
    fn is_at_the_rim_of_a_hole(&self, at_px: DVec2, (instance, triangle): (u32, u32)) -> bool {
        let scene = self.bvh.scene();
        let mesh = &scene.meshes[scene.instances[instance as usize].mesh];
        let Some(cutout) = mesh.material.and_then(|material| scene.materials[material].cutout.as_ref()) else {
            return false;
        };
        let is_solid = |offset: DVec2| {
            let ray = self.camera.ray(at_px + offset, self.size);
            let crossing = self.bvh.plane_crossing(instance, triangle, ray.origin, ray.direction)?;
            Some(cutout.is_solid(mesh.uv_at(triangle as usize, crossing.barycentric)))
        };
        let here = is_solid(DVec2::ZERO);
        AROUND.into_iter().any(|corner| is_solid(SNAP_PX * corner) != here)
    }

    fn may_differ(&self, at_px: DVec2, seen: &[(u32, u32)]) -> bool {
        if seen.iter().any(|&of| self.is_on_an_edge(at_px, of) || self.is_at_the_rim_of_a_hole(at_px, of)) {
            return true;
        }
        let depths: Option<Vec<(f64, f64)>> = seen.iter().map(|&of| self.depth(at_px, of)).collect();
        match depths.as_deref() {
            Some([(depth, error)]) => (depth - self.camera.near).abs() <= *error,
            Some([(a, a_error), (b, b_error)]) => (a - b).abs() <= a_error + b_error,
            _ => false,
        }
    }
}

fn key(receiver: &Option<Receiver>) -> Option<(u32, u32)> {
    receiver.map(|receiver| (receiver.instance, receiver.triangle))
}

fn drawn(bvh: &SceneBvh, scene: &Scene, camera: &Camera, size: [u32; 2]) -> Receivers {
    let buffers = SceneBuffers::new(&GPU, scene).expect("fits");
    gbuffer::receivers(&GPU, (scene, &buffers, bvh), camera, (size, [0; 2]), CENTER).expect("draws").0
}

/// Holds the G-buffer against rays: how many pixels see a surface, and how many see another triangle.
fn compare(what: &str, scene: &Scene, camera: &Camera, size: [u32; 2]) -> (usize, usize) {
    let mut bvh = SceneBvh::new(scene);
    bvh.add(|_| true);
    let traced = Receivers::find(&bvh, camera, size, CENTER, &Progress::default()).expect("traces");
    let drawn = drawn(&bvh, scene, camera, size);
    let judge = Judge { bvh: &bvh, camera, size };
    let mut differing = 0;
    for (i, (traced, drawn)) in traced.pixels.iter().zip(&drawn.pixels).enumerate() {
        if key(traced) == key(drawn) {
            assert_eq!(traced, drawn, "{what}");
            continue;
        }
        differing += 1;
        let at_px = DVec2::new((i % size[0] as usize) as f64, (i / size[0] as usize) as f64) + CENTER;
        let seen: Vec<(u32, u32)> = [key(traced), key(drawn)].into_iter().flatten().collect();
        assert!(judge.may_differ(at_px, &seen), "{what}: at {at_px} a ray sees {traced:?}, the rasteriser {drawn:?}");
    }
    (traced.hits().count(), differing)
}

/// [`compare`] where something must be seen.
fn agree(what: &str, scene: &Scene, camera: &Camera, size: [u32; 2]) {
    let (seen, _) = compare(what, scene, camera, size);
    assert!(seen > 0, "{what}: nothing is seen");
}

#[test]
fn the_g_buffer_sees_what_rays_see() {
    for spec in ["demo", "square", "sphere", "instances", "square?shift=1000000/0/-1000000"] {
        let scene = build(spec).expect("builds").scene;
        agree(spec, &scene, &scene.cameras[0], [200, 150]);
    }
}

#[test]
fn the_g_buffer_sees_what_rays_see_in_real_scenes() {
    for file in ["stanford-bunny/stanford-bunny.glb", "alpha-mask/01_alpha_mask.gltf"] {
        agree_on(file);
    }
}

#[test]
#[ignore = "7.7 million triangles: scripts/test --full"]
fn the_g_buffer_sees_what_rays_see_among_thousands_of_instances() {
    agree_on("gpu-instancing/24_gpu_instancing.gltf");
}

/// Compares on a file of the shared folder.
fn agree_on(file: &str) {
    let Some(scenes) = shared_scenes() else { return };
    let scene = gltf::load(&scenes.join(file), LoadOptions::default()).expect("loads");
    agree(file, &scene, &Camera::framing(&scene.bounds(), 4.0 / 3.0), [400, 300]);
}

#[test]
fn the_g_buffer_sees_what_rays_see_among_mirrored_and_uneven_instances() {
    let mut random = Random(31);
    for _ in 0..10 {
        let scene = random.scene(40, 1.0, 2.0);
        let camera = Camera::framing(&scene.bounds(), 1.0);
        agree("instances", &scene, &camera, [120, 120]);
        // From within, where triangles pass behind the camera.
        let pose = look_at(random.in_cube(1.0), random.in_cube(2.0), DVec3::Y);
        compare("within", &scene, &Camera { scene_from_camera: pose, ..camera }, [120, 120]);
    }
}

#[test]
fn near_and_far_and_parallel_rays_cut_the_g_buffer_as_they_cut_rays() {
    let mut random = Random(32);
    for _ in 0..5 {
        let scene = random.scene(60, 1.0, 2.0);
        let framing = Camera::framing(&scene.bounds(), 1.5);
        let distance = (framing.scene_from_camera.translation - scene.bounds().center()).length();
        for projection in [framing.projection, Projection::Orthographic { half_height: 1.5 }] {
            let whole = Camera { projection, ..framing.clone() };
            let cut = Camera { near: distance - 0.5, far: distance + 0.5, ..whole.clone() };
            let size = [90, 60];
            let (all, _) = compare("whole", &scene, &whole, size);
            let (between, _) = compare("cut", &scene, &cut, size);
            assert!(0 < between && between < all, "{between} of {all}");
        }
    }
}

#[test]
fn images_of_one_pixel_and_views_of_nothing_are_drawn() {
    let scene = build("demo").expect("builds").scene;
    let camera = &scene.cameras[0];
    agree("one pixel", &scene, camera, [1, 1]);
    agree("one row", &scene, camera, [37, 1]);
    agree("one column", &scene, camera, [1, 37]);
    let away = look_at(DVec3::splat(1e3), DVec3::splat(2e3), DVec3::Y);
    let away = Camera { scene_from_camera: away, ..camera.clone() };
    assert_eq!(compare("away", &scene, &away, [20, 10]), (0, 0));
    let empty = Scene { name: "empty".into(), ..Scene::default() };
    assert_eq!(compare("empty", &empty, camera, [20, 10]), (0, 0));
}

#[test]
fn a_mesh_far_from_its_own_origin_keeps_its_edges() {
    // Even numbers up to 1600 around 2^24 are exact in f32, but what a turned instance makes of them is not, unless the mesh's
    // place is taken off first: an ulp there is 2, a quarter of a pixel.
    let place = DVec3::new(2f64.powi(24), -2f64.powi(24), 2f64.powi(24));
    let mut scene = build("sphere").expect("builds").scene;
    let whole = scene.bounds().size().max_element();
    for mesh in &mut scene.meshes {
        mesh.positions =
            mesh.positions.iter().map(|&p| ((800.0 / whole * p.as_dvec3()).round() * 2.0 + place).as_vec3()).collect();
    }
    for instance in &mut scene.instances {
        let matrix3 = Random(33).rotation() * DMat3::from_diagonal(DVec3::splat(1.0 / 800.0));
        instance.scene_from_mesh = DAffine3 { matrix3, translation: -(matrix3 * place) };
    }
    scene.rebase();
    agree("far mesh", &scene, &Camera::framing(&scene.bounds(), 1.0), [200, 200]);
}

#[test]
fn scenes_of_any_size_look_the_same() {
    for spec in ["demo", "instances"] {
        let scene = build(spec).expect("builds").scene;
        let ids = |scene: &Scene, camera: &Camera| {
            let mut bvh = SceneBvh::new(scene);
            bvh.add(|_| true);
            drawn(&bvh, scene, camera, [100, 75]).pixels.iter().map(key).collect::<Vec<_>>()
        };
        let parallel = |scene: &Scene, half_height: f64| Camera {
            projection: Projection::Orthographic { half_height },
            ..scene.cameras[0].clone()
        };
        let expected = [ids(&scene, &scene.cameras[0]), ids(&scene, &parallel(&scene, 1.0))];
        assert!(expected.iter().flatten().any(Option::is_some));
        // Up to 1e18 and down to 1e-18; powers of two, for which all that depends on the size scales exactly.
        for exponent in [56, 20, -20, -60] {
            let factor = 2f64.powi(exponent);
            let scaled = scaled(&scene, factor);
            assert_eq!(ids(&scaled, &scaled.cameras[0]), expected[0], "{spec} × 2^{exponent}");
            assert_eq!(ids(&scaled, &parallel(&scaled, factor)), expected[1], "{spec} × 2^{exponent}, parallel");
        }
        // Units of mesh space that f32 holds in no transform.
        let mut odd = scene.clone();
        for mesh in &mut odd.meshes {
            mesh.positions = mesh.positions.iter().map(|&p| p * 2f32.powi(-100)).collect();
        }
        for instance in &mut odd.instances {
            instance.scene_from_mesh.matrix3 *= 2f64.powi(100);
        }
        assert_eq!(ids(&odd, &odd.cameras[0]), expected[0], "{spec} in small units");
    }
}

/// A square of 2 × 2 before the camera, with a cut-out.
fn masked(texture: Texture<1>, factor: f32, cutoff: f32) -> Scene {
    let mut square = mesh(&quad([-1.0, 1.0], 0.0, [-1.0, 1.0]));
    // One and a half of the texture's periods each way, not aligned with its texels.
    square.uvs = Some(square.positions.iter().map(|p| 0.75 * Vec2::new(p.x, p.z) + 0.111).collect());
    square.material = Some(0);
    let mut scene = scene(vec![square], Vec::new());
    scene.materials.push(Material {
        name: "holes".into(),
        cutout: Some(Cutout { cutoff, factor, texture: Some(Arc::new(texture)) }),
        ..Material::default()
    });
    scene
}

#[test]
fn cut_outs_have_the_holes_that_rays_find() {
    let mut random = Random(34);
    for nearest in [false, true] {
        for wrap in [Wrap::Repeat, Wrap::MirroredRepeat, Wrap::ClampToEdge] {
            let texels = (0..8 * 5).map(|_| [random.bits() as u8]).collect();
            let texture = Texture { size: [8, 5], texels, srgb: false, nearest, wrap: [wrap; 2] };
            let scene = masked(texture, 0.9, 0.5);
            let bounds = scene.bounds();
            let from = DVec3::new(0.4, 3.0, 0.7);
            let camera = Camera {
                scene_from_camera: look_at(bounds.center() + from, bounds.center(), DVec3::Y),
                ..Camera::framing(&bounds, 1.0)
            };
            let size = [150, 150];
            let (seen, _) = compare("cut-out", &scene, &camera, size);
            let mut whole = scene.clone();
            whole.materials[0].cutout = None;
            let (in_all, _) = compare("whole", &whole, &camera, size);
            // Of texels that are any number, 44 % pass, give or take what forty of them leave to chance.
            let share = seen as f64 / in_all as f64;
            assert!((0.15..0.85).contains(&share), "{share}");
        }
    }
}

#[test]
fn a_cut_out_without_texture_is_solid_or_not_as_a_whole() {
    let mut scene = masked(Texture { size: [1, 1], texels: vec![[255]], ..Texture::default() }, 1.0, 0.5);
    let camera = Camera::framing(&scene.bounds(), 1.0);
    for (factor, is_solid) in [(0.5, true), (0.499, false)] {
        scene.materials[0].cutout = Some(Cutout { cutoff: 0.5, factor, texture: None });
        let (seen, _) = compare("factor", &scene, &camera, [30, 30]);
        assert_eq!(seen > 0, is_solid, "factor {factor}");
    }
}
