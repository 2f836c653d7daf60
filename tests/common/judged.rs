//! Where the exact reference is judged: real scenes, a light of every shape in each, and receivers of every kind. Tests judge
//! it by `rays`; `scripts/judge-exact` and `scripts/bench-exact` include this file too.

use std::path::Path;

use glam::{DAffine3, DMat3, DVec2, DVec3};
use penumbra::Result;
use penumbra::geometry::bvh::SceneBvh;
use penumbra::geometry::irradiance::unshadowed;
use penumbra::progress::Progress;
use penumbra::receivers::{Receiver, Receivers};
use penumbra::reference::exact::{Answer, Exact, Memory};
use penumbra::scene::additions::add_floor;
use penumbra::scene::camera::look_at;
use penumbra::scene::{AreaLight, Bounds, Camera, LoadOptions, Projection, Scene, Shape, gltf};
use penumbra::techniques::{Frame, Linking};
use rayon::prelude::*;

/// The scenes, by file below the folder of scenes.
pub const SCENES: [(&str, &str); 6] = [
    ("bunny", "stanford-bunny/stanford-bunny.glb"),
    ("buddha", "happy-buddha/happy-buddha.glb"),
    ("jeep1", "jeep1/jeep1.glb"),
    ("engine", "two-cylinder-engine/2CylinderEngine.glb"),
    ("palm-tree", "palm-tree/palm-tree.glb"),
    ("kitchen", "country-kitchen/country-kitchen.glb"),
];

/// Width and height of the image whose receivers are chosen from, pixels.
pub const SIZE: [u32; 2] = [160, 120];

/// Pixels are taken a prime apart, which scatters them and comes to each of them once.
const STRIDE: usize = 7919;

/// A scene, what looks at it, and a light of every shape.
pub struct Judged {
    pub scene: Scene,
    pub camera: Camera,
    pub lights: Vec<AreaLight>,
}

/// Loads one of [`SCENES`]: the kitchen as its author's camera sees it, with lights at its window and below its ceiling; the
/// palm from near by, on its own ground; the others on a floor.
pub fn load(name: &str, folder: &Path) -> Result<Judged> {
    let file = SCENES.iter().find(|(scene, _)| *scene == name).expect("one of the scenes").1;
    let mut scene = gltf::load(&folder.join(file), LoadOptions::default())?;
    let aspect = f64::from(SIZE[0]) / f64::from(SIZE[1]);
    if name == "kitchen" {
        let (camera, lights) = (kitchen_camera(&scene, aspect), kitchen_lights(&scene));
        return Ok(Judged { scene, camera, lights });
    }
    let bounds = if name == "palm-tree" { palm(&scene) } else { scene.bounds() };
    if name != "palm-tree" {
        add_floor(&mut scene, None)?;
    }
    Ok(Judged { scene, camera: Camera::framing(&bounds, aspect), lights: lights_above(&bounds) })
}

/// Bounds of the palm without its hilly ground and the sea around it, 69 m and 392 m wide.
fn palm(scene: &Scene) -> Bounds {
    let small = |bounds: &Bounds| bounds.size().max_element() < 10.0;
    scene.instance_bounds().into_iter().filter(small).fold(Bounds::EMPTY, Bounds::union)
}

/// The camera of `kitchen.mitsuba.xml`: full horizontal field of view 60°; Mitsuba looks along +Z with +X to the left.
pub fn kitchen_camera(scene: &Scene, aspect: f64) -> Camera {
    let x = DVec3::new(-0.89874, 0.0, 0.438481);
    let y = DVec3::new(-0.0182716, 0.999131, -0.0374507);
    let eye_world = DVec3::new(1.211, 1.80475, 3.85239);
    // The file's digits make the axes orthogonal to 1e-6 only.
    let x = -x.normalize();
    let y = (y - y.dot(x) * x).normalize();
    Camera {
        name: "kitchen".into(),
        scene_from_camera: DAffine3 {
            matrix3: DMat3::from_cols(x, y, x.cross(y)),
            translation: eye_world - scene.origin_world,
        },
        projection: Projection::Perspective { fov_y: 2.0 * (30f64.to_radians().tan() / aspect).atan() },
        near: 0.0,
        far: f64::INFINITY,
    }
}

/// The kitchen's window as a light of the daylight behind it.
pub fn kitchen_window(scene: &Scene) -> AreaLight {
    let size = DVec2::new(1.3, 2.2);
    light("rect", Shape::Rect { size }, [0.08, 2.0, -3.3], [0.08, 2.0, 0.0], scene.origin_world)
}

fn kitchen_lights(scene: &Scene) -> Vec<AreaLight> {
    let place = |name, shape, at, to| light(name, shape, at, to, scene.origin_world);
    let (window, inside) = ([0.08, 2.0, -3.3], [0.08, 2.0, 0.0]);
    let (lamp, below) = ([0.0, 2.6, 0.5], [0.0, 0.0, 0.5]);
    let (disk, ellipse) = (DVec2::splat(0.8), DVec2::new(1.0, 0.5));
    vec![
        kitchen_window(scene),
        place("disk", Shape::Disk { size: disk }, window, inside),
        place("ellipse", Shape::Disk { size: ellipse }, lamp, below),
        place("sphere", Shape::Sphere { radius: 0.2, facing: false }, lamp, below),
        place("facing sphere", Shape::Sphere { radius: 0.2, facing: true }, lamp, below),
        place("tube", Shape::Tube { length: 1.2, radius: 0.03 }, lamp, below),
        place("sun", Shape::Sun { angle: 0.1 }, window, [0.4, 0.8, -1.3]),
        place("point", Shape::Point, lamp, below),
    ]
}

/// A light of every shape, from the left, above and in front, outside the bounding sphere and aimed at its middle.
fn lights_above(bounds: &Bounds) -> Vec<AreaLight> {
    let to = bounds.center();
    let radius = 0.5 * bounds.size().length();
    let at = to + 2.0 * radius * DVec3::new(-0.6, 1.0, 0.45).normalize();
    let place = |name, shape| light(name, shape, at.into(), to.into(), DVec3::ZERO);
    let size = |x: f64, y: f64| radius * DVec2::new(x, y);
    vec![
        place("rect", Shape::Rect { size: size(0.8, 0.5) }),
        place("disk", Shape::Disk { size: size(0.6, 0.6) }),
        place("ellipse", Shape::Disk { size: size(0.9, 0.4) }),
        place("sphere", Shape::Sphere { radius: 0.3 * radius, facing: false }),
        place("facing sphere", Shape::Sphere { radius: 0.3 * radius, facing: true }),
        place("tube", Shape::Tube { length: radius, radius: 0.05 * radius }),
        place("sun", Shape::Sun { angle: 0.2 }),
        place("point", Shape::Point),
    ]
}

/// A light at a place that shines towards another; the origin is that of scene space.
fn light(name: &str, shape: Shape, at: [f64; 3], to: [f64; 3], origin: DVec3) -> AreaLight {
    let pose = look_at(DVec3::from(at) - origin, DVec3::from(to) - origin, DVec3::Y);
    let translation = if matches!(shape, Shape::Sun { .. }) { DVec3::ZERO } else { pose.translation };
    AreaLight::new(name, DAffine3 { translation, ..pose }, shape)
}

impl Judged {
    /// The hierarchy over all of the scene.
    pub fn bvh(&self) -> SceneBvh<'_> {
        let mut bvh = SceneBvh::new(&self.scene);
        bvh.add(|_| true);
        bvh
    }

    /// What the camera sees.
    pub fn receivers(&self, bvh: &SceneBvh) -> Result<Receivers> {
        Receivers::find(bvh, &self.camera, SIZE, DVec2::splat(0.5), &Progress::default())
    }
}

/// All receivers with their pixels' numbers, scattered over the image: the first few are as good as random ones.
pub fn scattered(receivers: &Receivers) -> impl Iterator<Item = (u32, &Receiver)> {
    let pixels = &receivers.pixels;
    let numbers = (0..pixels.len()).map(|i| i * STRIDE % pixels.len());
    numbers.filter_map(|number| pixels[number].as_ref().map(|receiver| (number as u32, receiver)))
}

/// A receiver with what it sees of a light, exactly.
#[derive(Debug, Clone, Copy)]
pub struct Chosen {
    pub receiver: Receiver,
    /// Its pixel, which picks its samples.
    pub number: u32,
    pub answer: Answer,
    /// E₀ of a white light.
    pub unshadowed: f64,
}

/// Receivers that a light faces, by what they see of it.
#[derive(Debug, Default)]
pub struct Choice {
    /// V strictly between 0 and 1.
    pub penumbra: Vec<Chosen>,
    pub lit: Vec<Chosen>,
    pub umbra: Vec<Chosen>,
}

/// Chooses up to `penumbra` receivers in the penumbra of a light, and up to `others` of the lit ones and of those in its umbra,
/// scattered over the image.
pub fn choose(frame: &Frame, light: &AreaLight, penumbra: usize, others: usize) -> Choice {
    let scattered: Vec<(u32, &Receiver)> = scattered(frame.receivers).collect();
    let linking = Linking::of(frame.scene, light);
    let answer = |memory: &mut Memory, &(number, &receiver): &(u32, &Receiver)| {
        let answer = Exact::answer(frame, light, &receiver, number, &linking, memory);
        answer.facing.then(|| Chosen { receiver, number, answer, unshadowed: unshadowed(light, &receiver).x })
    };
    let mut choice = Choice::default();
    for part in scattered.chunks(64) {
        let answers: Vec<Option<Chosen>> = part.par_iter().map_init(Memory::default, answer).collect();
        for chosen in answers.into_iter().flatten() {
            let (kind, most) = match chosen.answer.visibility {
                0.0 => (&mut choice.umbra, others),
                1.0 => (&mut choice.lit, others),
                _ => (&mut choice.penumbra, penumbra),
            };
            if kind.len() < most {
                kind.push(chosen);
            }
        }
        let has_penumbra = choice.penumbra.len() == penumbra || light.shape.is_point();
        if has_penumbra && choice.lit.len() + choice.umbra.len() >= others {
            break;
        }
    }
    choice
}
