//! Parts of a procedural scene that move: loops as curves, and the scene at a time of them.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use glam::{DAffine3, DMat3, DQuat, DVec3};

use crate::scene::Scene;
use crate::scene::animation::{Channel, Clip, Curve, Interpolation, Pose, Property};

/// What moves.
#[derive(Debug, Clone, Copy)]
pub(super) enum Part {
    /// The one instance of an object of the draft; in a scene, an instance.
    Object(usize),
    /// A light.
    Light(usize),
    /// A camera.
    Camera(usize),
}

/// A part with its way, before `scale` and `shift`.
pub(super) struct Mover {
    pub part: Part,
    /// Otherwise it stands where its way begins.
    pub moves: bool,
    pub translation: Curve,
    /// None: it does not turn.
    pub rotation: Option<Curve>,
}

/// A scene with parts that move, and where the draft's space lies in it.
#[derive(Debug)]
pub(in crate::scene) struct Moving {
    /// At time 0, rebased. Its origin is that of all times.
    rest: Scene,
    /// By node.
    parts: BTreeMap<usize, Part>,
    placement: Placement,
}

/// Scale and shift of a draft.
#[derive(Debug, Clone, Copy)]
pub(super) struct Placement {
    pub scale: f64,
    pub shift: DVec3,
}

/// Keys of a loop beside the last one, which is the first again. The spline through as many samples of a sine is off by less
/// than 4·10⁻⁵ of its height.
const KEYS: u32 = 32;

/// A loop of this many seconds through `at`, which has the period 2π: a Catmull-Rom spline, smooth across its ends too.
pub(super) fn curve<const N: usize>(seconds: f64, at: impl Fn(f64) -> [f64; N]) -> Curve {
    let step = seconds / f64::from(KEYS);
    // The same angles in every round: the end is the start, bit for bit.
    let key = |i: u32| at(TAU * f64::from(i % KEYS) / f64::from(KEYS));
    let keys = (0..=KEYS).map(|i| {
        let (before, after) = (key(i + KEYS - 1), key(i + 1));
        let tangent: [f64; N] = std::array::from_fn(|c| (after[c] - before[c]) / (2.0 * step));
        [tangent, key(i), tangent]
    });
    Curve {
        times: (0..=KEYS).map(|i| (f64::from(i) * step) as f32).collect(),
        values: keys.flatten().flatten().map(|value| value as f32).collect(),
        interpolation: Interpolation::CubicSpline,
    }
}

/// [`curve`] of rotations that stay within half a turn of the first.
pub(super) fn rotation_curve(seconds: f64, at: impl Fn(f64) -> DMat3) -> Curve {
    let first = DQuat::from_mat3(&at(0.0));
    curve(seconds, |angle| {
        let quaternion = DQuat::from_mat3(&at(angle));
        // Of the two that are this rotation, the one whose neighbours are its neighbours.
        let nearer = if quaternion.dot(first) < 0.0 { -quaternion } else { quaternion };
        nearer.to_array()
    })
}

impl Placement {
    /// From a draft's space to a scene's, or to the world with an origin of zero.
    pub fn placed(self, transform: &DAffine3, origin_world: DVec3) -> DAffine3 {
        DAffine3 { matrix3: transform.matrix3, translation: self.point(transform.translation, origin_world) }
    }

    fn point(self, point: DVec3, origin_world: DVec3) -> DVec3 {
        point * self.scale + self.shift - origin_world
    }

    fn apply(self, scene: &mut Scene, parts: &BTreeMap<usize, Part>, pose: &Pose) {
        for (node, posed) in &pose.nodes {
            let transform = match parts[node] {
                Part::Object(instance) => &mut scene.instances[instance].scene_from_mesh,
                Part::Light(light) => &mut scene.lights[light].scene_from_light,
                Part::Camera(camera) => &mut scene.cameras[camera].scene_from_camera,
            };
            if let Some(translation) = posed.translation {
                transform.translation = self.point(translation, scene.origin_world);
            }
            if let Some(rotation) = posed.rotation {
                transform.matrix3 = DMat3::from_quat(rotation);
            }
        }
    }
}

/// The movers of a scene that is not rebased yet, by node: `nodes` holds a node for each. All are put where they begin.
pub(super) fn place(
    scene: &mut Scene,
    movers: Vec<(usize, Mover)>,
    placement: Placement,
) -> (BTreeMap<usize, Part>, Option<Clip>) {
    let parts = movers.iter().map(|(node, mover)| (*node, mover.part)).collect();
    let (mut moving, mut all) = (Vec::new(), Vec::new());
    for (node, mover) in movers {
        let translation = Channel { node, property: Property::Translation, curve: mover.translation };
        let rotation = mover.rotation.map(|curve| Channel { node, property: Property::Rotation, curve });
        let channels = [translation].into_iter().chain(rotation);
        if mover.moves {
            moving.extend(channels.clone());
        }
        all.extend(channels);
    }
    placement.apply(scene, &parts, &pose(&Clip { name: String::new(), channels: all }, 0.0));
    let clip = (!moving.is_empty()).then(|| Clip { name: "loop".into(), channels: moving });
    (parts, clip)
}

fn pose(clip: &Clip, seconds: f64) -> Pose {
    clip.pose(seconds).expect("between keys that are far less than half a turn apart there is a rotation")
}

impl Moving {
    pub(super) fn new(rest: Scene, parts: BTreeMap<usize, Part>, placement: Placement) -> Self {
        Self { rest, parts, placement }
    }

    /// The scene at time 0.
    pub fn rest(&self) -> Scene {
        self.rest.clone()
    }

    /// The scene at a time of its clip.
    pub fn pose(&self, clip: &Clip, seconds: f64) -> Scene {
        let mut scene = self.rest();
        self.placement.apply(&mut scene, &self.parts, &pose(clip, seconds));
        scene
    }
}
