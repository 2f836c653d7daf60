//! Small scenes built by hand, and what `rays` sees in them.

#![expect(dead_code, reason = "each test binary uses some of it")]

use std::f64::consts::PI;
use std::path::{Path, PathBuf};

use glam::{DAffine3, DMat3, DVec2, DVec3, Vec3};
use penumbra::geometry::bvh::SceneBvh;
use penumbra::progress::Progress;
use penumbra::receivers::{Receiver, Receivers, UNKNOWN};
use penumbra::reference::exact::{Answer, Exact, Memory};
use penumbra::render::{Rendering, render_receivers};
use penumbra::sampling::Pattern;
use penumbra::scene::camera::aimed;
use penumbra::scene::{AreaLight, Instance, Mesh, Node, Scene, Shape};
use penumbra::techniques::rays::Rays;
use penumbra::techniques::{Frame, LightImage, Linking};

/// A mesh of the given corners, three a triangle.
pub fn mesh(triangles: &[[[f32; 3]; 3]]) -> Mesh {
    let positions: Vec<Vec3> = triangles.iter().flatten().map(|&p| Vec3::from(p)).collect();
    let indices = (0..triangles.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
    Mesh { positions: positions.into(), triangles: indices, ..Mesh::default() }
}

/// A horizontal rectangle at height `y`.
pub fn quad(x: [f32; 2], y: f32, z: [f32; 2]) -> Vec<[[f32; 3]; 3]> {
    let [a, b, c, d] = [[x[0], y, z[0]], [x[1], y, z[0]], [x[1], y, z[1]], [x[0], y, z[1]]];
    vec![[a, c, b], [a, d, c]]
}

/// A scene of one instance a mesh, all at the world's origin.
pub fn scene(meshes: Vec<Mesh>, lights: Vec<AreaLight>) -> Scene {
    placed_scene(meshes, DAffine3::IDENTITY, lights)
}

/// A scene whose instances all have the same transform.
pub fn placed_scene(meshes: Vec<Mesh>, world_from_mesh: DAffine3, lights: Vec<AreaLight>) -> Scene {
    let mut scene = Scene { name: "test".into(), ..Scene::default() };
    for (i, mesh) in meshes.into_iter().enumerate() {
        scene.nodes.push(Node { name: format!("node {i}"), parent: None });
        scene.instances.push(Instance { mesh: i, node: i, scene_from_mesh: world_from_mesh });
        scene.meshes.push(mesh);
    }
    for light in lights {
        scene.add_light(light);
    }
    scene.rebase();
    scene
}

/// A light at a place that shines straight down (−Y).
pub fn light_down(shape: Shape, at: [f64; 3]) -> AreaLight {
    let rotation = aimed(DVec3::NEG_Y, DVec3::Y);
    AreaLight::new("light", DAffine3 { matrix3: rotation, translation: at.into() }, shape)
}

/// A square light of half side `half` at height `height` over the origin, facing down.
pub fn square_light(half: f64, height: f64) -> AreaLight {
    light_down(Shape::Rect { size: DVec2::splat(2.0 * half) }, [0.0, height, 0.0])
}

/// Exact receivers at world positions, all with one normal.
pub fn receivers(scene: &Scene, positions_world: &[DVec3], normal: DVec3) -> Receivers {
    let receiver = |&position_world: &DVec3| {
        Some(Receiver {
            position: position_world - scene.origin_world,
            position_error: 0.0,
            normal,
            shading_normal: normal,
            depth: 0.0,
            instance: UNKNOWN,
            triangle: UNKNOWN,
            barycentric: [0.0; 2],
        })
    };
    Receivers { size: [positions_world.len() as u32, 1], pixels: positions_world.iter().map(receiver).collect() }
}

/// Points along x on the floor, off any symmetry of the scenes.
pub fn line(from: f64, to: f64, count: usize) -> Vec<DVec3> {
    let x = |i: usize| from + (to - from) * (i as f64 + 0.5) / count as f64;
    (0..count).map(|i| DVec3::new(x(i), 0.0, 0.0137)).collect()
}

/// A square of half side ½ at height 2, and a light.
pub fn square_under(light: AreaLight) -> Scene {
    scene(vec![mesh(&quad([-0.5, 0.5], 2.0, [-0.5, 0.5]))], vec![light])
}

/// An uneven surface of many small triangles over a floor, with everything that lights it.
pub fn bumpy(lights: Vec<AreaLight>) -> Scene {
    let mut triangles = Vec::new();
    let height = |i: i32, j: i32| 1.0 + 0.25 * ((i * 7 + j * 13) % 11) as f32 / 11.0;
    for i in -6..6 {
        for j in -6..6 {
            if (i + j) % 3 == 0 {
                continue;
            }
            let at = |i: i32, j: i32| [i as f32 * 0.125, height(i, j), j as f32 * 0.125];
            triangles.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
            triangles.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
        }
    }
    scene(vec![mesh(&triangles), mesh(&quad([-4.0, 4.0], 0.0, [-4.0, 4.0]))], lights)
}

/// Whether two sets of images are equal bit for bit, irradiance and times apart.
pub fn same_bits(what: &str, a: &[LightImage], b: &[LightImage]) {
    assert_eq!(a.len(), b.len());
    for (i, (a, b)) in a.iter().zip(b).enumerate() {
        let bits = |image: &LightImage| image.visibility.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(a), bits(b), "{what}: visibility of light {i}");
        assert_eq!(a.facing, b.facing, "{what}: facing of light {i}");
    }
}

/// A sphere of radius 1 around the origin: as many rows of facets as subdivisions, twice as many columns.
pub fn sphere(subdivisions: u32) -> Vec<[[f32; 3]; 3]> {
    let (n, m) = (2 * subdivisions, subdivisions);
    let vertex = |i: u32, j: u32| {
        let (phi, theta) = (2.0 * PI * f64::from(i % n) / f64::from(n), PI * f64::from(j) / f64::from(m));
        DVec3::new(theta.sin() * phi.cos(), theta.cos(), theta.sin() * phi.sin()).as_vec3().to_array()
    };
    let mut triangles = Vec::new();
    for i in 0..n {
        for j in 0..m {
            triangles.push([vertex(i, j), vertex(i + 1, j), vertex(i + 1, j + 1)]);
            triangles.push([vertex(i, j), vertex(i + 1, j + 1), vertex(i, j + 1)]);
        }
    }
    triangles
}

/// `rays` with a pattern and a count.
pub fn rays(pattern: Pattern, samples: u32) -> Rays {
    Rays { samples, pattern, seed: 0 }
}

/// What `rays` finds at world positions with normal +Y.
pub fn trace(scene: &Scene, positions_world: &[DVec3], rays: &Rays) -> Rendering {
    trace_receivers(scene, receivers(scene, positions_world, DVec3::Y), rays)
}

/// What `rays` finds at receivers.
pub fn trace_receivers(scene: &Scene, receivers: Receivers, rays: &Rays) -> Rendering {
    render_receivers(scene, receivers, rays, true, &Progress::default()).expect("renders")
}

/// V of the first light at world positions with normal +Y, by a cell grid.
pub fn visibility(scene: &Scene, positions_world: &[DVec3], samples: u32) -> Vec<f32> {
    trace(scene, positions_world, &rays(Pattern::Grid, samples)).lights.swap_remove(0).visibility
}

/// The exact answers of every light at receivers, in `f64`.
pub fn exact(scene: &Scene, receivers: &Receivers) -> Vec<Vec<Answer>> {
    let mut bvh = SceneBvh::new(scene);
    bvh.add(|_| true);
    let progress = Progress::default();
    let frame = Frame { scene, bvh: &bvh, receivers, irradiance: true, progress: &progress, buffers: None, shot: None };
    let of_light = |light: &AreaLight| {
        let linking = Linking::of(scene, light);
        let receivers = receivers.hits().enumerate();
        let mut memory = Memory::default();
        receivers.map(|(i, r)| Exact::answer(&frame, light, r, i as u32, &linking, &mut memory)).collect()
    };
    scene.lights.iter().map(of_light).collect()
}

/// The exact V of the first light at world positions with normal +Y.
pub fn exact_visibility(scene: &Scene, positions_world: &[DVec3]) -> Vec<f64> {
    let answers = exact(scene, &receivers(scene, positions_world, DVec3::Y)).swap_remove(0);
    answers.into_iter().map(|answer| answer.visibility).collect()
}

/// The same scene with every position multiplied by `factor`.
pub fn scaled(scene: &Scene, factor: f64) -> Scene {
    let mut scaled = scene.clone();
    scaled.origin_world *= factor;
    for mesh in &mut scaled.meshes {
        mesh.positions = mesh.positions.iter().map(|&p| p * factor as f32).collect();
    }
    for instance in &mut scaled.instances {
        instance.scene_from_mesh.translation *= factor;
    }
    for light in &mut scaled.lights {
        light.scene_from_light.translation *= factor;
        light.shape = match light.shape {
            Shape::Rect { size } => Shape::Rect { size: size * factor },
            Shape::Disk { size } => Shape::Disk { size: size * factor },
            Shape::Sphere { radius, facing } => Shape::Sphere { radius: radius * factor, facing },
            Shape::Tube { length, radius } => Shape::Tube { length: length * factor, radius: radius * factor },
            shape @ (Shape::Sun { .. } | Shape::Point) => shape,
        };
    }
    for camera in &mut scaled.cameras {
        camera.scene_from_camera.translation *= factor;
        camera.near *= factor;
        camera.far *= factor;
    }
    scaled
}

/// One light of every shape, each big enough for a penumbra, over the origin.
pub fn lights_of_every_shape() -> Vec<AreaLight> {
    let mut lights = vec![
        light_down(Shape::Rect { size: DVec2::new(1.0, 0.5) }, [0.2, 4.0, 0.1]),
        light_down(Shape::Disk { size: DVec2::new(1.0, 1.0) }, [0.2, 4.0, 0.1]),
        light_down(Shape::Disk { size: DVec2::new(1.5, 0.4) }, [0.2, 4.0, 0.1]),
        light_down(Shape::Sphere { radius: 0.5, facing: false }, [0.2, 4.0, 0.1]),
        light_down(Shape::Sphere { radius: 0.5, facing: true }, [0.2, 4.0, 0.1]),
        light_down(Shape::Tube { length: 1.5, radius: 0.1 }, [0.2, 4.0, 0.1]),
        light_down(Shape::Sun { angle: 0.1 }, [0.0; 3]),
        light_down(Shape::Point, [0.2, 4.0, 0.1]),
    ];
    // The sun shines a little aslant.
    lights[6].scene_from_light.matrix3 = DMat3::from_rotation_z(0.2) * lights[6].scene_from_light.matrix3;
    lights
}

/// [`lights_of_every_shape`] at places that are multiples of a sixty-fourth, moved by a shift that is one too.
pub fn lights_in_sixty_fourths(shift: DVec3) -> Vec<AreaLight> {
    let mut lights = lights_of_every_shape();
    for light in &mut lights {
        light.scene_from_light.translation = (light.scene_from_light.translation * 64.0).round() / 64.0 + shift;
    }
    lights
}

/// The folder of scenes that nobody here made; none where it is absent, which CI does not accept.
#[expect(clippy::print_stderr, reason = "who runs the tests is told what was skipped")]
pub fn shared_scenes() -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    if path.is_dir() {
        return Some(path);
    }
    assert!(std::env::var_os("CI").is_none(), "{} is missing, which CI must have", path.display());
    eprintln!("skipped: {} is not there", path.display());
    None
}

/// A repeatable sequence of numbers (SplitMix64: Steele, Lea and Flood 2014).
#[derive(Debug)]
pub struct Random(pub u64);

impl Random {
    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^ (x >> 31)
    }

    /// A number in [`low`, `high`).
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * ((self.bits() >> 11) as f64 * 2f64.powi(-53))
    }

    /// An index below `count`.
    pub fn below(&mut self, count: usize) -> usize {
        (self.bits() % count as u64) as usize
    }

    /// True with this probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.between(0.0, 1.0) < probability
    }

    /// A point of the cube of this half side around the origin.
    pub fn in_cube(&mut self, half: f64) -> DVec3 {
        DVec3::new(self.between(-half, half), self.between(-half, half), self.between(-half, half))
    }

    /// A direction, uniform on the sphere.
    pub fn direction(&mut self) -> DVec3 {
        loop {
            let point = self.in_cube(1.0);
            if (0.01..=1.0).contains(&point.length_squared()) {
                return point.normalize();
            }
        }
    }

    /// A rotation about any axis by any angle.
    pub fn rotation(&mut self) -> DMat3 {
        DMat3::from_axis_angle(self.direction(), self.between(0.0, std::f64::consts::TAU))
    }

    /// Rotated, unevenly scaled (by at most `size` along an axis) and as often mirrored as not.
    pub fn placement(&mut self, size: f64, half: f64) -> DAffine3 {
        let scale = DVec3::from_array(std::array::from_fn(|_| {
            let length = self.between(0.2 * size, size);
            if self.chance(0.5) { -length } else { length }
        }));
        let matrix3 = self.rotation() * DMat3::from_diagonal(scale) * self.rotation();
        DAffine3 { matrix3, translation: self.in_cube(half) }
    }

    /// A mesh of triangles within the unit cube around the origin.
    pub fn mesh(&mut self, triangles: usize) -> Mesh {
        let corner = |random: &mut Self| random.in_cube(0.5).as_vec3().to_array();
        let corners: Vec<_> = (0..triangles).map(|_| [corner(self), corner(self), corner(self)]).collect();
        mesh(&corners)
    }

    /// A scene of instances of few meshes, some meshes used once and others often, around the origin.
    pub fn scene(&mut self, instances: usize, size: f64, half: f64) -> Scene {
        let mut scene = Scene { name: "test".into(), ..Scene::default() };
        scene.meshes = (0..instances.div_ceil(2)).map(|_| self.mesh(2)).collect();
        let shared = scene.meshes.len().div_ceil(8);
        for i in 0..instances {
            // Every second instance is of one of the few shared meshes.
            let mesh = if i % 2 == 0 { i / 2 } else { self.below(shared) };
            scene.nodes.push(Node { name: format!("node {i}"), parent: None });
            scene.instances.push(Instance { mesh, node: i, scene_from_mesh: self.placement(size, half) });
        }
        scene
    }

    /// A light of one of [`SHAPES`]' shapes, with any pose around the origin.
    pub fn light(&mut self, shape: &str) -> AreaLight {
        let shape = match shape {
            "rect" => Shape::Rect { size: DVec2::new(self.between(0.2, 3.0), self.between(0.2, 3.0)) },
            "disk" => Shape::Disk { size: DVec2::splat(self.between(0.2, 3.0)) },
            "ellipse" => Shape::Disk { size: DVec2::new(self.between(0.2, 3.0), self.between(0.2, 3.0)) },
            "sphere" => Shape::Sphere { radius: self.between(0.1, 1.5), facing: false },
            "facing sphere" => Shape::Sphere { radius: self.between(0.1, 1.5), facing: true },
            "tube" => Shape::Tube { length: self.between(0.3, 4.0), radius: self.between(0.05, 0.5) },
            "sun" => Shape::Sun { angle: self.between(0.02, 1.2) },
            "point" => Shape::Point,
            _ => unreachable!("no such shape"),
        };
        let at = self.direction() * self.between(2.5, 5.0);
        // Towards the middle, more or less; one in four anywhere.
        let axis = if self.chance(0.25) { self.direction() } else { self.in_cube(1.5) - at };
        let matrix3 = aimed(axis, self.direction());
        AreaLight::new("light", DAffine3 { matrix3, translation: at }, shape)
    }
}

/// What [`Random::light`] knows.
pub const SHAPES: [&str; 8] = ["rect", "disk", "ellipse", "sphere", "facing sphere", "tube", "sun", "point"];
