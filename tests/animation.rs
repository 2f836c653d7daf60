//! Animations, skins and morph targets: what a file's scene is at a time, by formulas of its own.

#[expect(dead_code, clippy::needless_pass_by_value, reason = "each test binary uses some of it, with `json!` literals")]
mod gltf_files;

use std::sync::Arc;

use glam::{DQuat, DVec3};
use gltf_files::{File, le, load, push, shared_scenes};
use penumbra::scene::animation::Animated;
use penumbra::scene::{LoadOptions, Scene, gltf};
use serde_json::{Value, json};

fn animated(file: &File) -> Animated {
    gltf::load_animated_slice(&file.gltf(), None, "test", LoadOptions::default()).expect("a valid file")
}

/// Adds a channel to the first animation.
fn channel(file: &mut File, node: usize, path: &str, interpolation: &str, times: &[f32], output: usize) {
    let input = file.floats(&times.iter().map(|&time| [time]).collect::<Vec<_>>());
    if file.json.get("animations").is_none() {
        file.json["animations"] = json!([{"name": "clip"}]);
    }
    let animation = &mut file.json["animations"][0];
    let sampler = json!({"input": input, "output": output, "interpolation": interpolation});
    let sampler = push(&mut animation["samplers"], sampler);
    push(&mut animation["channels"], json!({"sampler": sampler, "target": {"node": node, "path": path}}));
}

/// World positions of an instance.
fn positions(scene: &Scene, instance: usize) -> Vec<DVec3> {
    let instance = &scene.instances[instance];
    let world = |p: &glam::Vec3| instance.scene_from_mesh.transform_point3(p.as_dvec3()) + scene.origin_world;
    scene.meshes[instance.mesh].positions.iter().map(world).collect()
}

/// Equal but for the roundings of a few operations on numbers of this size.
fn assert_close(found: DVec3, expected: DVec3, size: f64) {
    assert!((found - expected).abs().max_element() <= 16.0 * f64::EPSILON * size, "{found} is not {expected}");
}

const CORNERS: [DVec3; 4] =
    [DVec3::new(-1.0, -1.0, 0.0), DVec3::new(1.0, -1.0, 0.0), DVec3::new(1.0, 1.0, 0.0), DVec3::new(-1.0, 1.0, 0.0)];

#[test]
fn linear_values_lie_on_the_line_and_stay_beyond_the_ends() {
    let mut file = File::square();
    let output = file.floats(&[[1.0, 2.0, 3.0], [3.0, 2.0, -5.0], [3.0, 4.0, 0.0]]);
    channel(&mut file, 0, "translation", "LINEAR", &[0.5, 1.5, 2.0], output);
    let output = file.floats(&[[1.0; 3], [3.0, 2.0, 1.0]]);
    channel(&mut file, 0, "scale", "LINEAR", &[0.0, 2.0], output);
    let animated = animated(&file);
    assert_eq!((animated.clips[0].start(), animated.clips[0].end()), (0.0, 2.0));
    for (seconds, at, scale) in [
        (-1.0, [1.0, 2.0, 3.0], [1.0, 1.0]),
        (0.5, [1.0, 2.0, 3.0], [1.5, 1.25]),
        (0.75, [1.5, 2.0, 1.0], [1.75, 1.375]),
        (1.5, [3.0, 2.0, -5.0], [2.5, 1.75]),
        (1.75, [3.0, 3.0, -2.5], [2.75, 1.875]),
        (9.0, [3.0, 4.0, 0.0], [3.0, 2.0]),
    ] {
        let scene = animated.pose(0, seconds).unwrap();
        for (found, corner) in positions(&scene, 0).into_iter().zip(CORNERS) {
            // Every number has a few binary digits: the pose is exact.
            assert_eq!(found, DVec3::from(at) + corner * DVec3::new(scale[0], scale[1], 1.0), "{seconds} s");
        }
    }
}

#[test]
fn rotations_turn_at_constant_speed_the_shorter_way() {
    let half = |degrees: f64| (0.5 * degrees.to_radians()).sin_cos();
    // The second key is the negative of a turn by 100° about Z, the same rotation.
    let (sin, cos) = half(100.0);
    let mut file = File::square();
    let output = file.floats(&[[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -sin as f32, -cos as f32]]);
    channel(&mut file, 0, "rotation", "LINEAR", &[1.0, 3.0], output);
    let animated = animated(&file);
    for share in [0.0, 0.125, 0.5, 0.75, 1.0] {
        let scene = animated.pose(0, 1.0 + 2.0 * share).unwrap();
        let (sin, cos) = (share * 100f64.to_radians()).sin_cos();
        for (found, corner) in positions(&scene, 0).into_iter().zip(CORNERS) {
            let expected = DVec3::new(cos * corner.x - sin * corner.y, sin * corner.x + cos * corner.y, 0.0);
            // The key's own rounding to f32 turns it by 6e-8 at most.
            assert!((found - expected).length() < 2.0 * f64::from(f32::EPSILON), "{share}: {found} {expected}");
        }
    }
}

#[test]
fn steps_hold_the_last_key() {
    let mut file = File::square();
    let output = file.floats(&[[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]]);
    channel(&mut file, 0, "translation", "STEP", &[1.0, 2.0, 4.0], output);
    let turned = [0.0, 0.0, 0.5f32.sqrt(), 0.5f32.sqrt()];
    let output = file.floats(&[[0.0, 0.0, 0.0, 1.0], turned]);
    channel(&mut file, 0, "rotation", "STEP", &[0.0, 3.0], output);
    let animated = animated(&file);
    for (seconds, x, is_turned) in
        [(0.0, 1.0, 0.0), (1.999, 1.0, 0.0), (2.0, 2.0, 0.0), (3.9, 2.0, 1.0), (4.0, 3.0, 1.0)]
    {
        let found = positions(&animated.pose(0, seconds).unwrap(), 0)[1];
        let expected = if is_turned == 1.0 { DVec3::new(1.0, 1.0, 0.0) } else { CORNERS[1] };
        assert_close(found, expected + DVec3::X * x, 4.0);
    }
}

/// A cubic Bézier curve by repeated halving of its control polygon in the ratio t.
fn de_casteljau<const N: usize>(mut points: Vec<[f64; N]>, t: f64) -> [f64; N] {
    while points.len() > 1 {
        points = points.windows(2).map(|p| std::array::from_fn(|i| (1.0 - t) * p[0][i] + t * p[1][i])).collect();
    }
    points[0]
}

/// The control polygon of a Hermite segment: its tangents are three times the first and the last side.
fn bezier<const N: usize>(
    from: [f64; N],
    leaving: [f64; N],
    arriving: [f64; N],
    to: [f64; N],
    span: f64,
) -> Vec<[f64; N]> {
    let inner =
        |end: [f64; N], tangent: [f64; N], sign: f64| std::array::from_fn(|i| end[i] + sign * span * tangent[i] / 3.0);
    vec![from, inner(from, leaving, 1.0), inner(to, arriving, -1.0), to]
}

#[test]
fn cubic_splines_are_the_bezier_curves_of_their_tangents() {
    // In-tangent, value, out-tangent of each key; the outermost tangents are never used.
    let keys = [[9.0; 3], [0.0, 1.0, 2.0], [3.0, -1.0, 0.5], [2.0, 0.25, -1.0], [4.0, 0.0, 1.0], [9.0; 3]];
    let mut file = File::square();
    let output = file.floats(&keys.map(|key| key.map(|x| x as f32)));
    channel(&mut file, 0, "translation", "CUBICSPLINE", &[0.5, 2.0], output);
    let quaternions =
        [[9.0; 4], [0.0, 0.0, 0.0, 1.0], [0.5, 0.0, 1.0, 0.0], [0.0, 0.25, 0.5, 0.0], [0.0, 0.0, 1.0, 0.0], [9.0; 4]];
    let output = file.floats(&quaternions.map(|key| key.map(|x| x as f32)));
    channel(&mut file, 0, "rotation", "CUBICSPLINE", &[0.5, 2.0], output);
    let animated = animated(&file);
    for t in [0.0, 0.25, 0.375, 0.5, 0.875, 1.0] {
        let at = DVec3::from(de_casteljau(bezier(keys[1], keys[2], keys[3], keys[4], 1.5), t));
        let q = de_casteljau(bezier(quaternions[1], quaternions[2], quaternions[3], quaternions[4], 1.5), t);
        let rotation = DQuat::from_array(q).normalize();
        let scene = animated.pose(0, 0.5 + 1.5 * t).unwrap();
        for (found, corner) in positions(&scene, 0).into_iter().zip(CORNERS) {
            assert_close(found, at + rotation * corner, 16.0);
        }
    }
}

#[test]
fn quantised_values_are_what_normalised_integers_mean() {
    let mut file = File::square();
    let quaternions = le(&[0i16, 0, 0, 32767, 0, 0, 23170, 23170, 0, 0, -32768, 0], i16::to_le_bytes);
    let output = file.accessor(&quaternions, 5122, 3, "VEC4");
    file.json["accessors"][output]["normalized"] = json!(true);
    channel(&mut file, 0, "rotation", "LINEAR", &[0.0, 1.0, 2.0], output);
    let moved = file.floats(&[[0.0, 0.0, 8.0]; 4]);
    file.primitive()["targets"] = json!([{"POSITION": moved}]);
    let output = file.accessor(&[0, 51, 255], 5121, 3, "SCALAR");
    file.json["accessors"][output]["normalized"] = json!(true);
    channel(&mut file, 0, "weights", "STEP", &[0.0, 1.0, 2.0], output);
    let animated = animated(&file);
    for (seconds, corner, z) in [(0.0, CORNERS[1], 0.0), (1.0, CORNERS[2], 1.6), (2.0, CORNERS[3], 8.0)] {
        let found = positions(&animated.pose(0, seconds).unwrap(), 0)[1];
        // The weight is an f32 (51 / 255), the position rounded to one.
        assert!(
            (found - corner - DVec3::Z * z).abs().max_element() < 2.0 * f64::from(f32::EPSILON),
            "{seconds}: {found}"
        );
    }
}

#[test]
fn lights_and_cameras_move_with_their_nodes() {
    let mut file = File::with_light(json!({"version": 1, "shape": "disk", "width": 0.5, "radiance": [1, 1, 1]}));
    file.json["cameras"] = json!([{"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}]);
    let camera = push(&mut file.json["nodes"], json!({"camera": 0, "translation": [0, 0, 5]}));
    let arm = file.add_node(json!({"children": [camera]}));
    let output = file.floats(&[[0.0, 4.0, 0.0], [2.0, 4.0, 0.0]]);
    channel(&mut file, 1, "translation", "LINEAR", &[0.0, 1.0], output);
    let quarter = 0.5f32.sqrt();
    let output = file.floats(&[[0.0, 0.0, 0.0, 1.0], [0.0, quarter, 0.0, quarter]]);
    channel(&mut file, arm, "rotation", "LINEAR", &[0.0, 1.0], output.to_owned());
    let animated = animated(&file);
    for seconds in [0.0, 0.25, 1.0] {
        let scene = animated.pose(0, seconds).unwrap();
        let light = scene.lights[0].scene_from_light.translation + scene.origin_world;
        assert_eq!(light, DVec3::new(2.0 * seconds, 4.0, 0.0));
        let camera = &scene.cameras[0].scene_from_camera;
        let (sin, cos) = (seconds * 90f64.to_radians()).sin_cos();
        assert_close(camera.translation + scene.origin_world, DVec3::new(5.0 * sin, 0.0, 5.0 * cos), 8.0);
        assert_close(camera.matrix3.z_axis, DVec3::new(sin, 0.0, cos), 1.0);
    }
}

#[test]
fn a_two_sided_light_does_not_turn_over_on_its_way() {
    let mut file = File::square();
    file.json["materials"] = json!([{"emissiveFactor": [1, 1, 1], "doubleSided": true,
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 5}}}]);
    file.primitive()["material"] = json!(0);
    push(&mut file.json["meshes"], json!({"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}));
    file.add_node(json!({"mesh": 1, "scale": [9, 9, 1]}));
    file.json["nodes"][0]["translation"] = json!([0, 0, 3]);
    let output = file.floats(&[[0.0, 0.0, 3.0], [0.0, 0.0, -3.0]]);
    channel(&mut file, 0, "translation", "LINEAR", &[0.0, 1.0], output);
    let animated = animated(&file);
    for seconds in [0.0, 0.5, 1.0] {
        assert_eq!(animated.pose(0, seconds).unwrap().lights[0].axis(), DVec3::NEG_Z);
    }
}

/// The square moved by joints: `nodes[1]` and `nodes[2]`, the latter the former's child.
fn skinned(weights: [[f32; 4]; 4]) -> File {
    let mut file = File::square();
    let joints = file.accessor(&[0, 1, 0, 0].repeat(4), 5121, 4, "VEC4");
    let weights = file.floats(&weights);
    file.primitive()["attributes"]["JOINTS_0"] = json!(joints);
    file.primitive()["attributes"]["WEIGHTS_0"] = json!(weights);
    file.add_node(json!({"name": "hip", "children": [2]}));
    push(&mut file.json["nodes"], json!({"name": "knee"}));
    file.json["skins"] = json!([{"joints": [1, 2]}]);
    file.json["nodes"][0]["skin"] = json!(0);
    file
}

#[test]
fn joints_move_what_they_hold_by_their_weights() {
    let mut file = skinned([[1.0, 0.0, 0.0, 0.0], [0.75, 0.25, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.5, 0.5, 0.0, 0.0]]);
    file.json["nodes"][1]["translation"] = json!([10, 0, 0]);
    file.json["nodes"][2]["scale"] = json!([1, 3, 1]);
    // The place of a skinned mesh's node does not matter, nor whether it has one.
    file.json["nodes"][0]["translation"] = json!([7, 7, 7]);
    file.json["nodes"][0]["scale"] = json!([0, 1, 0]);
    let output = file.floats(&[[0.0, 0.0, 0.0], [0.0, 4.0, 0.0]]);
    channel(&mut file, 2, "translation", "LINEAR", &[0.0, 1.0], output);
    let animated = animated(&file);
    for (seconds, lift) in [(0.0, 0.0), (0.5, 2.0), (1.0, 4.0)] {
        let scene = animated.pose(0, seconds).unwrap();
        let y = |y: f64, weight: f64| (1.0 - weight) * y + weight * (3.0 * y + lift);
        let expected = [[9.0, y(-1.0, 0.0)], [11.0, y(-1.0, 0.25)], [11.0, y(1.0, 1.0)], [9.0, y(1.0, 0.5)]];
        let expected: Vec<_> = expected.iter().map(|&[x, y]| DVec3::new(x, y, 0.0)).collect();
        assert_eq!(positions(&scene, 0), expected);
        assert_eq!(scene.instances[0].node, 0);
    }
    // Without a clip, the file's own pose.
    assert_eq!(positions(&load(&file.gltf()).unwrap(), 0)[2], DVec3::new(11.0, 3.0, 0.0));
}

#[test]
fn inverse_bind_matrices_come_first() {
    let mut file = skinned([[0.5, 0.5, 0.0, 0.0]; 4]);
    file.json["nodes"][1]["scale"] = json!([2, 2, 2]);
    file.json["nodes"][2]["translation"] = json!([0, 0, 1]);
    let moved = |x: f32| [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, x, 0.0, 0.0, 1.0];
    let matrices: Vec<f32> = [moved(1.0), moved(5.0)].concat();
    let matrices = file.accessor(&le(&matrices, f32::to_le_bytes), 5126, 2, "MAT4");
    file.json["skins"][0]["inverseBindMatrices"] = json!(matrices);
    // (2 (p + 1) + 2 (p + 5 + z)) / 2
    let expected = CORNERS.map(|p| 2.0 * p + DVec3::new(6.0, 0.0, 1.0));
    assert_eq!(positions(&file.scene(), 0), expected);
}

#[test]
fn weights_are_shares_of_their_sum_over_all_sets() {
    // 0.5 and 0.25 in one set, 0.25 of joint 1 in another: halves.
    let mut file = skinned([[0.5, 0.0, 0.0, 0.0]; 4]);
    let more = file.accessor(&[1, 0, 0, 0].repeat(4), 5121, 4, "VEC4");
    let weights = file.accessor(&le(&[32768u16, 0, 0, 0].repeat(4), u16::to_le_bytes), 5123, 4, "VEC4");
    file.json["accessors"][weights]["normalized"] = json!(true);
    file.json["nodes"][2]["translation"] = json!([3, 0, 0]);
    let first = positions(&file.scene(), 0);
    assert_eq!(first, CORNERS);
    file.primitive()["attributes"]["JOINTS_1"] = json!(more);
    file.primitive()["attributes"]["WEIGHTS_1"] = json!(weights);
    let share = f64::from(32768f32 / 65535.0);
    let expected = 3.0 * share / (0.5 + share);
    let found = positions(&file.scene(), 0)[0] - CORNERS[0];
    // One rounding to f32 of a number below 2, and the joint's own frame.
    assert!((found.x - expected).abs() <= 0.5 * f64::from(f32::EPSILON), "{found} {expected}");
}

#[test]
fn normals_of_deformed_meshes_stay_across_their_surfaces() {
    // A plane through the Z axis at 45°, made twice as wide in X by the joint: its normal (1, −1) becomes (1, −2).
    let mut file = skinned([[1.0, 0.0, 0.0, 0.0]; 4]);
    let diagonal = 0.5f32.sqrt();
    let normals = file.floats(&[[diagonal, -diagonal, 0.0]; 4]);
    file.primitive()["attributes"]["NORMAL"] = json!(normals);
    for (scale, expected) in
        [([2, 1, 1], [1.0, -2.0, 0.0]), ([-2, 1, 1], [-1.0, -2.0, 0.0]), ([0, 1, 1], [1.0, 0.0, 0.0])]
    {
        file.json["nodes"][1]["scale"] = json!(scale);
        let scene = file.scene();
        let normal = scene.meshes[0].normals.as_ref().unwrap()[0].as_dvec3();
        let off = (normal - DVec3::from(expected).normalize()).length();
        assert!(off <= 2.0 * f64::from(f32::EPSILON), "{scale:?}: {normal}");
    }
    // What collapses to a point keeps its normal.
    file.json["nodes"][1]["scale"] = json!([0, 0, 0]);
    let scene = file.scene();
    assert_eq!(scene.meshes[0].normals.as_ref().unwrap()[0].to_array(), [diagonal, -diagonal, 0.0]);
}

#[test]
fn a_skinned_mesh_far_from_the_origin_loses_nothing() {
    let mut file = skinned([[0.5, 0.5, 0.0, 0.0]; 4]);
    let far = 2f64.powi(40);
    file.json["nodes"][1]["translation"] = json!([far, far, -far]);
    let found = positions(&file.scene(), 0);
    assert_eq!(found, CORNERS.map(|corner| corner + DVec3::new(far, far, -far)));
}

/// The square with two morph targets: up, and the first corner aside (sparse, without a base).
fn morphed() -> File {
    let mut file = File::square();
    let up = file.floats(&[[0.0, 0.0, 2.0]; 4]);
    let index = file.view(&[0]);
    let value = file.view(&le(&[-4.0f32, 0.0, 0.0], f32::to_le_bytes));
    let aside = json!({"componentType": 5126, "count": 4, "type": "VEC3", "sparse": {"count": 1,
        "indices": {"bufferView": index, "componentType": 5121}, "values": {"bufferView": value}}});
    let aside = push(&mut file.json["accessors"], aside);
    let normals = file.floats(&[[0.0, 0.0, 1.0]; 4]);
    let tilt = file.floats(&[[3.0, 0.0, 0.0]; 4]);
    file.primitive()["attributes"]["NORMAL"] = json!(normals);
    file.primitive()["targets"] = json!([{"POSITION": up, "NORMAL": tilt}, {"POSITION": aside}]);
    file
}

#[test]
fn morph_targets_add_up_by_weights_of_node_else_mesh_else_none() {
    let mut file = morphed();
    assert_eq!(positions(&file.scene(), 0), CORNERS);
    file.json["meshes"][0]["weights"] = json!([0.5, 0.25]);
    let found = positions(&file.scene(), 0);
    assert_eq!(found[0], DVec3::new(-2.0, -1.0, 1.0));
    assert_eq!(found[2], DVec3::new(1.0, 1.0, 1.0));
    file.json["nodes"][0]["weights"] = json!([1, 0]);
    let scene = file.scene();
    assert_eq!(positions(&scene, 0)[0], DVec3::new(-1.0, -1.0, 2.0));
    let normal = scene.meshes[0].normals.as_ref().unwrap()[0].as_dvec3();
    assert!((normal - DVec3::new(3.0, 0.0, 1.0).normalize()).length() <= f64::from(f32::EPSILON));
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
}

#[test]
fn meshes_are_kept_apart_only_where_they_are_deformed_differently() {
    let mut file = morphed();
    for x in [3, 6, 9] {
        file.add_node(json!({"mesh": 0, "translation": [x, 0, 0]}));
    }
    // Two keys of two weights each.
    let output = file.floats(&[[0.0], [0.0], [1.0], [0.5]]);
    channel(&mut file, 1, "weights", "LINEAR", &[0.0, 1.0], output);
    file.json["nodes"][2]["weights"] = json!([0.5, 0.25]);
    let animated = animated(&file);
    let meshes_at = |seconds| {
        let scene = animated.pose(0, seconds).unwrap();
        (scene.instances.iter().map(|instance| instance.mesh).collect::<Vec<_>>(), scene)
    };
    let (meshes, at_first) = meshes_at(0.0);
    assert_eq!(meshes, [0, 0, 1, 0]);
    let (meshes, half_way) = meshes_at(0.5);
    assert_eq!(meshes, [0, 1, 1, 0]);
    let (meshes, scene) = meshes_at(0.75);
    assert_eq!(meshes, [0, 1, 2, 0]);
    assert_eq!(positions(&scene, 1)[0], DVec3::new(3.0 - 1.0 - 1.5, -1.0, 1.5));
    // What stands still is stored once for all times.
    for other in [&half_way, &scene] {
        assert!(Arc::ptr_eq(&at_first.meshes[0].positions, &other.meshes[0].positions));
        assert!(!Arc::ptr_eq(&at_first.meshes[0].positions, &other.meshes[1].positions));
    }
}

#[test]
fn morph_targets_come_before_joints() {
    let mut file = skinned([[1.0, 0.0, 0.0, 0.0]; 4]);
    let up = file.floats(&[[0.0, 0.0, 1.0]; 4]);
    file.primitive()["targets"] = json!([{"POSITION": up}]);
    file.json["meshes"][0]["weights"] = json!([0.5]);
    file.json["nodes"][1]["scale"] = json!([1, 1, 4]);
    assert_eq!(positions(&file.scene(), 0)[0], DVec3::new(-1.0, -1.0, 2.0));
}

#[test]
fn what_is_scaled_to_nothing_is_hidden() {
    let mut file = File::square();
    file.add_node(json!({"mesh": 0, "translation": [0, 0, -1]}));
    let output = file.floats(&[[1.0; 3], [0.0; 3]]);
    channel(&mut file, 0, "scale", "STEP", &[0.0, 1.0], output);
    let animated = animated(&file);
    assert_eq!(animated.pose(0, 0.5).unwrap().instances.len(), 2);
    let hidden = animated.pose(0, 1.0).unwrap();
    assert_eq!((hidden.instances.len(), hidden.instances[0].node), (1, 1));
    assert_eq!(hidden.warnings, ["`square`: scaled to nothing: not shown"]);
}

#[test]
fn a_pose_that_cannot_be_rendered_names_its_time() {
    let mut file = File::square();
    let output = file.floats(&[[1.0; 3], [1.0, 0.0, 1.0]]);
    channel(&mut file, 0, "scale", "STEP", &[0.0, 1.0], output);
    let line = animated(&file).pose(0, 1.5).unwrap_err().to_string();
    assert_eq!(
        line,
        "test: nodes[0] at 1.5 s of animation \"clip\": singular transform: it (or a parent's) flattens space, for example by \
         a scale of 0"
    );
}

#[test]
fn clips_have_names_of_their_own_and_say_what_they_leave_out() {
    let mut file = File::square();
    let output = file.floats(&[[1.0, 0.0, 0.0]]);
    channel(&mut file, 0, "translation", "LINEAR", &[0.0], output);
    let pointer = json!({"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": "/nodes/0/scale"}}});
    push(&mut file.json["animations"][0]["channels"], json!({"sampler": 0, "target": pointer}));
    let twin = file.json["animations"][0].clone();
    push(&mut file.json["animations"], twin);
    push(&mut file.json["animations"], json!({"channels": [], "samplers": []}));
    let animated = animated(&file);
    let names: Vec<_> = animated.clips.iter().map(|clip| clip.name.as_str()).collect();
    assert_eq!(names, ["clip", "clip#2", "animation 2"]);
    assert_eq!(
        animated.rest().unwrap().warnings,
        [
            "`clip`, `clip#2`: played in part: a channel's target is not a node's (KHR_animation_pointer is not supported)"
        ]
    );
    // Whoever asks for no time is told, once.
    assert_eq!(
        load(&file.gltf()).unwrap().warnings,
        ["rendered at the pose of the file's nodes: --frames renders its animation"]
    );
    assert_eq!(positions(&animated.pose(2, 1.0).unwrap(), 0), CORNERS);
}

#[test]
fn the_same_time_gives_the_same_bits() {
    let mut file = skinned([[0.3, 0.7, 0.0, 0.0]; 4]);
    let output = file.floats(&[[0.1, 0.2, 0.3], [0.7, -0.4, 0.9]]);
    channel(&mut file, 2, "translation", "LINEAR", &[0.0, 1.0], output);
    let bits = |scene: &Scene| format!("{:?} {:?} {:?}", scene.meshes, scene.instances, scene.origin_world);
    let animated = animated(&file);
    let first = bits(&animated.pose(0, 0.3).unwrap());
    animated.pose(0, 0.9).unwrap();
    assert_eq!(bits(&animated.pose(0, 0.3).unwrap()), first);
    assert_eq!(bits(&self::animated(&file).pose(0, 0.3).unwrap()), first);
}

/// Loads a shared scene with its animations, where there is one.
fn shared(path: &str) -> Option<Animated> {
    Some(gltf::load_animated(&shared_scenes()?.join(path), LoadOptions::default()).expect("loads"))
}

/// Lowest and highest corner of all positions, world space.
fn extent(scene: &Scene) -> [DVec3; 2] {
    let all = positions(scene, 0);
    [all.iter().copied().reduce(DVec3::min).unwrap(), all.into_iter().reduce(DVec3::max).unwrap()]
}

#[test]
fn the_fox_moves_as_another_reader_says() {
    let Some(fox) = shared("fox/Fox.glb") else { return };
    let ends = fox.clips.iter().map(|clip| (clip.name.as_str(), clip.channels.len(), clip.end()));
    let expected = [("Survey", 21, 3.416_666_7), ("Walk", 21, 0.708_333_3), ("Run", 21, 1.158_333_3)];
    for ((name, channels, end), expected) in ends.zip(expected) {
        assert_eq!((name, channels), (expected.0, expected.1));
        assert!((end - expected.2).abs() < 1e-6, "{name}: {end}");
    }
    // Extent, and vertices 0 and 1000, by a script of its own: matrices in Python's doubles, slerp by atan2, no library.
    let expected = [
        (
            None,
            0.0,
            [
                [-12.5927, -0.1217, -88.0950],
                [12.5927, 78.9072, 66.6249],
                [2.05637, 35.21442, -23.04512],
                [7.01432, 29.85748, 24.08296],
            ],
        ),
        (
            Some(0),
            1.0,
            [
                [-11.5972, -0.1309, -83.3110],
                [22.2052, 76.6942, 63.7019],
                [2.05522, 33.01199, -20.41928],
                [7.03365, 27.77402, 23.51463],
            ],
        ),
        (
            Some(1),
            0.35,
            [
                [-12.7789, -0.0265, -91.3267],
                [12.4065, 74.4599, 70.0431],
                [1.56970, 34.79325, -18.97594],
                [6.97633, 26.73632, 17.30361],
            ],
        ),
        (
            Some(2),
            0.5,
            [
                [-13.1452, -1.2517, -95.9885],
                [14.0621, 73.8171, 68.2067],
                [3.01369, 32.50792, -28.35198],
                [7.96436, 30.37705, 34.60104],
            ],
        ),
    ];
    for (clip, seconds, values) in expected {
        let scene = clip.map_or_else(|| fox.rest(), |clip| fox.pose(clip, seconds)).expect("a pose");
        let all = positions(&scene, 0);
        let [low, high] = extent(&scene);
        for (found, expected) in [low, high, all[0], all[1000]].into_iter().zip(values) {
            // Four digits are given.
            assert!((found - DVec3::from(expected)).abs().max_element() < 1e-4, "{clip:?}: {found} {expected:?}");
        }
        assert_eq!(scene.triangle_count(), 576);
    }
}

#[test]
fn the_animated_cube_turns_once_in_two_seconds() {
    let Some(cube) = shared("animated-cube/03_animated_cube.gltf") else { return };
    for seconds in [0.0, 0.25, 0.5, 1.0, 1.75, 2.0, 5.0] {
        let scene = cube.pose(0, seconds).expect("a pose");
        // Its key at 1 s is a half turn whose scalar part is just below 0, so that the shorter way is clockwise.
        let (sin, cos) = (-seconds.min(2.0) * std::f64::consts::PI).sin_cos();
        let rest = &scene.meshes[0].positions;
        for (found, p) in positions(&scene, 0).into_iter().zip(rest.iter().map(|p| p.as_dvec3())) {
            let expected = DVec3::new(cos * p.x + sin * p.z, p.y, cos * p.z - sin * p.x);
            // The middle key's quaternion is 4e-8 off a half turn.
            assert!((found - expected).abs().max_element() < 1e-6, "{seconds}: {found} {expected}");
        }
    }
}

#[test]
fn the_morph_cube_grows_as_its_weights_say() {
    let Some(cube) = shared("animated-morph-cube/glTF/AnimatedMorphCube.gltf") else { return };
    // At 2 s the weights are 0.80556 and 0.19444: its lowest y, ×100 along world −Z by the node, is 0.52512 then (the
    // script's figure, times the node's scale).
    let scene = cube.pose(0, 2.0).expect("a pose");
    let mesh = &scene.meshes[0];
    let lowest = mesh.positions.iter().map(|p| p.y).fold(f32::INFINITY, f32::min);
    assert!((lowest - 0.005_251_207).abs() < 1e-8, "{lowest}");
    let rest = cube.rest().expect("a pose");
    let [low, high] = extent(&rest);
    assert!((low + 1.0).abs().max_element() < 1e-5 && (high - 1.0).abs().max_element() < 1e-5, "{low} {high}");
    // No node moves.
    assert_eq!(scene.nodes.len(), rest.nodes.len());
}

#[test]
fn a_list_of_channels_names_nodes_and_keys() {
    let Some(fox) = shared("fox/Fox.glb") else { return };
    let channel = &fox.clips[0].channels[0];
    let record: Value = json!(channel.property);
    assert_eq!((record, channel.node, channel.curve.times.len()), (json!("rotation"), 8, 83));
}
