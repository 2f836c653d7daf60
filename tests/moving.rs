//! `procedural:moving`: each part moves alone, on a smooth loop, around an origin that stays.

use std::path::Path;
use std::process::{Command, Output};
use std::sync::Arc;

use assert_cmd::cargo::CommandCargoExt;
use glam::{DAffine3, DMat3, DVec2, DVec3};
use penumbra::image::read_exr;
use penumbra::scene::animation::Animated;
use penumbra::scene::procedural::{COMMON_PARAMETERS, ENTRIES, Kind, LEAST, MOST, load, load_animated};
use penumbra::scene::{Scene, Shape};
use serde_json::Value;

const PARTS: [&str; 4] = ["camera", "light", "caster", "receiver"];
/// All parts that can move, in the order of [`PARTS`].
const ALL: [bool; 4] = [true; 4];

fn moving(parts: [bool; 4], more: &str) -> Animated {
    let switches = PARTS.iter().zip(parts).map(|(part, moves)| format!("{part}={}&", u8::from(moves)));
    load_animated(&format!("procedural:moving?{}{more}", switches.collect::<String>())).expect("loads")
}

fn instance(scene: &Scene, name: &str) -> usize {
    let found = scene.instances.iter().position(|instance| scene.nodes[instance.node].name == name);
    found.expect("an instance")
}

/// Transforms of camera, light, hoop and board.
fn transforms(scene: &Scene) -> [DAffine3; 4] {
    let object = |name| scene.instances[instance(scene, name)].scene_from_mesh;
    [scene.cameras[0].scene_from_camera, scene.lights[0].scene_from_light, object("hoop"), object("board")]
}

fn bits(transform: &DAffine3) -> [u64; 12] {
    transform.to_cols_array().map(f64::to_bits)
}

/// Bits of all that a scene says of places: of the parts, then of everything else.
fn places(scene: &Scene) -> ([[u64; 12]; 4], Vec<[u64; 12]>, [u64; 3]) {
    let [hoop, board] = ["hoop", "board"].map(|name| instance(scene, name));
    let still = scene.instances.iter().enumerate().filter(|(i, _)| *i != hoop && *i != board);
    let still = still.map(|(_, instance)| bits(&instance.scene_from_mesh)).collect();
    (transforms(scene).each_ref().map(bits), still, scene.origin_world.to_array().map(f64::to_bits))
}

/// The angle between two rotations, radians.
fn turn(from: &DMat3, to: &DMat3) -> f64 {
    // By the chord of each axis: an angle's cosine would lose what is below 1e-8.
    let chord = (0..3).map(|axis| from.col(axis).distance_squared(to.col(axis))).sum::<f64>().sqrt();
    2.0 * (chord / 8f64.sqrt()).min(1.0).asin()
}

#[test]
fn each_switch_moves_its_part_and_no_other() {
    let still = load("procedural:moving?camera=0").expect("loads");
    for combination in 0..16u32 {
        let parts: [bool; 4] = std::array::from_fn(|i| combination >> i & 1 == 1);
        let animated = moving(parts, "");
        let names: Vec<_> = animated.clips.iter().map(|clip| clip.name.as_str()).collect();
        assert_eq!(names, if combination == 0 { vec![] } else { vec!["loop"] });
        assert_eq!(places(&animated.rest().expect("rests")), places(&still));
        if combination == 0 {
            continue;
        }
        assert_eq!(places(&animated.pose(0, 0.0).expect("poses")), places(&still));
        // Half-way, the light passes where it began.
        for frame in (1..48).filter(|&frame| frame != 24) {
            let scene = animated.pose(0, f64::from(frame) / 24.0).expect("poses");
            let ((found, others, origin), (at_start, others_at_start, origin_at_start)) =
                (places(&scene), places(&still));
            assert_eq!((others, origin), (others_at_start, origin_at_start));
            for (part, moves) in parts.into_iter().enumerate() {
                assert_eq!(found[part] != at_start[part], moves, "{} in {parts:?} at {frame}", PARTS[part]);
            }
            // And it is where it is when all move.
            let all = transforms(&moving(ALL, "").pose(0, f64::from(frame) / 24.0).expect("poses"));
            for part in (0..4).filter(|&part| parts[part]) {
                assert_eq!(found[part], bits(&all[part]), "{} in {parts:?} at {frame}", PARTS[part]);
            }
        }
    }
}

#[test]
fn the_camera_alone_walks_by_default() {
    let default = load_animated("procedural:moving").expect("loads");
    let camera = moving([true, false, false, false], "");
    assert_eq!(places(&default.pose(0, 0.7).expect("poses")), places(&camera.pose(0, 0.7).expect("poses")));
}

#[test]
fn moves_are_rigid_and_stay_in_the_room() {
    let animated = moving(ALL, "");
    for step in 0..480 {
        let scene = animated.pose(0, f64::from(step) / 240.0).expect("poses");
        for transform in transforms(&scene) {
            // A unit quaternion's matrix is orthonormal to a few roundings.
            let product = transform.matrix3.transpose() * transform.matrix3;
            assert!((product - DMat3::IDENTITY).abs_diff_eq(DMat3::ZERO, 1e-14), "{transform}");
            assert!(transform.matrix3.determinant() > 0.0);
        }
        // The room, which does not move, holds all the rest: rebased again, no scene would move.
        let bounds = scene.instance_bounds();
        let room = bounds[instance(&scene, "room")];
        assert_eq!(scene.bounds(), room);
        for name in ["hoop", "board"] {
            let part = bounds[instance(&scene, name)];
            assert!(part.min.y + scene.origin_world.y > 0.02, "{name} touches the floor");
        }
        for at in [scene.cameras[0].scene_from_camera, scene.lights[0].scene_from_light].map(|t| t.translation) {
            assert!((at - room.min).min_element() > 1.0 && (room.max - at).min_element() > 1.0, "{at} in {room:?}");
        }
    }
}

#[test]
fn the_loop_is_closed_and_smooth() {
    let animated = moving(ALL, "");
    let clip = &animated.clips[0];
    assert_eq!((clip.start(), clip.end()), (0.0, 2.0));
    let at = |seconds: f64| transforms(&animated.pose(0, seconds).expect("poses"));
    assert_eq!(at(0.0).each_ref().map(bits), at(2.0).each_ref().map(bits));
    // The loop's frequency is π a second. The fastest part is the hoop, with 0.9, 0.2 (at twice the frequency) and 0.6 m along
    // X, Y and Z: at most π·|(0.9, 0.4, 0.6)| = 3.6 m/s and π²·|(0.9, 0.8, 0.6)| = 13.3 m/s². Turns are of 0.9 and 0.5 rad at
    // once: 3.2 rad/s. The spline's own are within a tenth of these.
    let (most_speed, most_acceleration) = (4.0, 16.0);
    for step in [1.0 / 24.0, 1e-3, 1e-5] {
        // In equal steps that straddle keys, frames and the middle between them.
        for i in 0..240 {
            let seconds = (2.0 - 2.0 * step) * f64::from(i) / 239.0;
            let [before, here, after] = [0.0, 1.0, 2.0].map(|n| at(seconds + n * step));
            for part in 0..4 {
                let what = format!("{} at {seconds} by {step}", PARTS[part]);
                let way = here[part].translation - before[part].translation;
                let next_way = after[part].translation - here[part].translation;
                // What is left by rounding to f64 of coordinates of up to 16 m.
                let rounding = 16.0 * f64::EPSILON;
                assert!(way.length() <= most_speed * step, "{what}: {way}");
                let change = (next_way - way).length();
                assert!(change <= most_acceleration * step * step + 8.0 * rounding, "{what}: {change}");
                let angle = turn(&before[part].matrix3, &here[part].matrix3);
                assert!(angle <= most_speed * step + 8.0 * f64::EPSILON, "{what}: {angle}");
            }
        }
    }
    // Velocities agree across the seam as they do elsewhere: by the acceleration over the two steps.
    let step = 1e-4;
    let [last, end, first] = [at(2.0 - step), at(0.0), at(step)];
    for part in 0..4 {
        let (before, after) =
            (end[part].translation - last[part].translation, first[part].translation - end[part].translation);
        assert!((after - before).length() <= most_acceleration * step * step + 1e-14, "{}", PARTS[part]);
        let (before, after) = (
            end[part].matrix3.x_axis - last[part].matrix3.x_axis,
            first[part].matrix3.x_axis - end[part].matrix3.x_axis,
        );
        assert!((after - before).length() <= most_acceleration * step * step + 1e-14, "{}", PARTS[part]);
    }
}

#[test]
fn beyond_the_loop_all_stays_as_at_its_ends() {
    let animated = moving(ALL, "");
    let at = |seconds: f64| places(&animated.pose(0, seconds).expect("poses"));
    for seconds in [-1e300, -1.0, 2.0, 2.5, 1e5, 1e300] {
        assert_eq!(at(seconds), at(0.0), "{seconds}");
    }
    assert!(at(1.0) != at(0.0));
}

#[test]
fn speed_is_a_change_of_time_alone() {
    let slow = moving(ALL, "");
    for speed in [2f64.powi(-40), 0.5, 4.0] {
        let animated = moving(ALL, &format!("speed={speed}"));
        assert_eq!(animated.clips[0].end(), 2.0 / speed);
        for frame in [0.0, 5.0, 11.5, 40.0, 48.0] {
            // A power of two changes no digit of times and tangents.
            let [fast, slow] = [animated.pose(0, frame / 24.0 / speed), slow.pose(0, frame / 24.0)];
            assert_eq!(places(&fast.expect("poses")), places(&slow.expect("poses")), "{speed} {frame}");
        }
    }
}

#[test]
fn frames_share_their_vertices_and_their_order() {
    let animated = moving(ALL, "");
    let [first, other] = [0.0, 1.3].map(|seconds| animated.pose(0, seconds).expect("poses"));
    assert_eq!((first.meshes.len(), first.instances.len()), (other.meshes.len(), other.instances.len()));
    for (a, b) in first.meshes.iter().zip(&other.meshes) {
        assert!(a.name == b.name && Arc::ptr_eq(&a.positions, &b.positions) && a.triangles == b.triangles);
        assert!(a.normals.as_ref().zip(b.normals.as_ref()).is_none_or(|(a, b)| Arc::ptr_eq(a, b)));
    }
    for (a, b) in first.instances.iter().zip(&other.instances) {
        assert_eq!((a.mesh, a.node), (b.mesh, b.node));
    }
    let names = |scene: &Scene| scene.nodes.iter().map(|node| node.name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&first), names(&other));
    assert_eq!((first.lights[0].name.as_str(), first.lights.len(), first.cameras.len()), ("Key", 1, 1));
}

#[test]
fn every_load_gives_the_same_bits() {
    for seconds in [0.0, 0.3, 1.9] {
        let [a, b] = [0, 1].map(|_| moving(ALL, "").pose(0, seconds).expect("poses"));
        assert_eq!(places(&a), places(&b));
        for (a, b) in a.meshes.iter().zip(&b.meshes) {
            assert_eq!(a.positions, b.positions);
        }
    }
}

#[test]
fn scale_and_shift_go_with_the_way() {
    let base = moving(ALL, "");
    // Powers of two, and a shift that all coordinates bear to 2^-20: its rounding is that of f32 vertices, and of f64 here.
    let (scale, shift) = (1024.0, DVec3::new(3.0, -2.0, 10.0));
    let moved = moving(ALL, "scale=2^10&shift=3/-2/10");
    for seconds in [0.0, 0.4, 1.7] {
        let [base, moved] = [&base, &moved].map(|animated| animated.pose(0, seconds).expect("poses"));
        for (a, b) in transforms(&base).iter().zip(transforms(&moved)) {
            let world = (a.translation + base.origin_world) * scale + shift;
            let off = (world - b.translation - moved.origin_world).length();
            // Coordinates of up to 16 km, a few roundings.
            assert!(off <= 8.0 * 16384.0 * f64::EPSILON && a.matrix3 == b.matrix3, "{off}");
        }
    }
}

#[test]
fn the_light_is_as_large_as_asked() {
    for (query, size) in [
        ("", DVec2::new(0.8, 0.8)),
        ("light_size=0.1&", DVec2::new(0.1, 0.1)),
        ("light_size=2&aspect=128", DVec2::new(2.0, 0.015_625)),
        ("light_size=0.25&aspect=0.125", DVec2::new(0.25, 2.0)),
    ] {
        let scene = load(&format!("procedural:moving?{query}")).expect("loads");
        assert_eq!(scene.lights[0].shape, Shape::Rect { size });
    }
}

/// Values at the ends of a parameter's range.
fn ends(kind: &Kind) -> Vec<String> {
    match kind {
        Kind::Positive(_) => vec![LEAST.to_string(), MOST.to_string()],
        Kind::Number(_) => vec![(-MOST).to_string(), MOST.to_string()],
        Kind::Count { min, max, .. } => vec![min.to_string(), max.to_string()],
        Kind::Vector => vec!["-16777216/-16777216/-16777216".into(), "16777216/0/0".into()],
        Kind::Scale => vec!["2^-30".into(), "2^30".into()],
        Kind::Choice(words) => words.iter().map(|&word| word.to_owned()).collect(),
    }
}

#[test]
fn every_parameter_works_at_both_ends_or_says_what_it_expects() {
    let mut refused = Vec::new();
    for name in ["tilt", "moving"] {
        let entry = ENTRIES.iter().find(|entry| entry.name == name).expect("listed");
        for parameter in entry.parameters.iter().chain(&COMMON_PARAMETERS) {
            for end in ends(&parameter.kind) {
                let animated = match load_animated(&format!("{name}?{}={end}", parameter.name)) {
                    Ok(animated) => animated,
                    Err(error) => {
                        let message = error.to_string();
                        assert!(message.contains(&format!("procedural:{name}: ")) && !message.contains('\n'));
                        refused.push(format!("{name} {}={end}", parameter.name));
                        continue;
                    }
                };
                let last = animated.clips.first().map_or(0.0, |clip| clip.end());
                for share in [0.0, 0.3, 1.0, 2.0] {
                    let scene = if animated.clips.is_empty() {
                        animated.rest().expect("rests")
                    } else {
                        animated.pose(0, share * last).expect("poses")
                    };
                    let placed = scene.instances.iter().map(|instance| instance.scene_from_mesh);
                    let seen = [scene.cameras[0].scene_from_camera, scene.lights[0].scene_from_light];
                    for transform in placed.chain(seen) {
                        assert!(transform.is_finite() && transform.matrix3.determinant() > 0.0, "{}", scene.name);
                    }
                }
            }
        }
    }
    let end = |number: f64| number.to_string();
    let (least, most) = (end(LEAST), end(MOST));
    let mut expected = vec![
        // Lights that reach the receiver or hang below the occluder; slats that are thinner than the step of f32 so far out.
        format!("tilt light={most}"),
        format!("tilt height={least}"),
        format!("tilt lift={most}"),
        format!("tilt angle=-{most}"),
        format!("tilt angle={most}"),
        format!("tilt distance={least}"),
        format!("tilt distance={most}"),
        "moving shift=-16777216/-16777216/-16777216".into(),
        "moving shift=16777216/0/0".into(),
        format!("moving light_size={most}"),
        format!("moving aspect={least}"),
    ];
    expected.sort();
    refused.sort();
    assert_eq!(refused, expected);
}

fn penumbra(arguments: &[&str], directory: &Path) -> Output {
    let output = Command::cargo_bin("penumbra")
        .expect("the binary")
        .args(arguments)
        .current_dir(directory)
        .output()
        .expect("runs");
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

#[test]
fn list_and_info_show_it() {
    let directory = tempfile::tempdir().expect("a directory");
    let list = String::from_utf8(penumbra(&["list"], directory.path()).stdout).expect("UTF-8");
    for line in ["\nmoving - ", "\ntilt - ", "    caster=0: ", "    speed=1: ", "    distance=1: "] {
        assert!(list.contains(line), "{line:?}");
    }
    let info = penumbra(&["info", "procedural:moving?receiver=1&speed=0.5"], directory.path());
    let text = String::from_utf8(info.stdout).expect("UTF-8");
    assert!(text.contains("animation  loop: 0.0000 s to 4.0000 s, 4 channels\n"), "{text}");
    let info = penumbra(&["info", "procedural:moving?light=1", "--json"], directory.path());
    let info: Value = serde_json::from_slice(&info.stdout).expect("JSON");
    let channels = info["animations"][0]["channels"].as_array().expect("channels");
    let nodes: Vec<_> = channels.iter().map(|channel| (&channel["node"], &channel["property"])).collect();
    let [translation, rotation] = [Value::from("translation"), Value::from("rotation")];
    let [view, key] = [Value::from("view"), Value::from("Key")];
    assert_eq!(nodes, [(&view, &translation), (&view, &rotation), (&key, &translation)]);
    let still = penumbra(&["info", "procedural:moving?camera=0", "--json"], directory.path());
    let still: Value = serde_json::from_slice(&still.stdout).expect("JSON");
    assert_eq!(still["animations"], Value::Array(Vec::new()));
}

#[test]
fn frames_differ_in_what_moves() {
    let directory = tempfile::tempdir().expect("a directory");
    let at = directory.path();
    let render = |scene: &str, output: &str, frames: &[&str]| {
        let common = ["render", scene, "--size", "64x48", "--set", "samples=16", "--aov", "position", "-o", output];
        penumbra(&[common.as_slice(), frames].concat(), at);
    };
    let frames = ["--frames", "0-48:12"];
    let image = |name: &str| read_exr(&at.join(name)).expect("an image");
    for part in PARTS {
        let scene =
            if part == "camera" { "procedural:moving".into() } else { format!("procedural:moving?camera=0&{part}=1") };
        render(&scene, &format!("{part}.##.exr"), &frames);
        let [first, later, last] = ["00", "12", "48"].map(|frame| image(&format!("{part}.{frame}.exr")));
        let visibility = |of: &penumbra::image::Image| of.visibility("Key").map(<[f32]>::to_vec);
        assert!(visibility(&first).is_some() && visibility(&first) != visibility(&later), "{part}");
        assert!(visibility(&first) == visibility(&last) && first.xyz("position") == last.xyz("position"), "{part}");
        // The light is not seen: what it moves is V alone.
        assert_eq!(first.xyz("position") == later.xyz("position"), part == "light", "{part}");
    }
    // Without frames, the start.
    render("procedural:moving", "still.exr", &[]);
    assert_eq!(image("still.exr").visibility("Key"), image("camera.00.exr").visibility("Key"));
}
