//! What faulty glTF files say: one line, with the place inside the file. Never a panic.

#![expect(clippy::needless_pass_by_value, reason = "`json!` literals are handed over as they are")]

mod gltf_files;

use gltf_files::{File, le, load, push, shared_scenes};
use penumbra::scene::{LoadOptions, gltf};
use serde_json::{Value, json};

/// A test that a square, once edited, is refused with exactly this line.
macro_rules! refused {
    ($($name:ident: $edit:expr => $line:expr;)*) => {
        $(#[test]
        fn $name() {
            let mut file = File::square();
            let edit: fn(&mut File) = $edit;
            edit(&mut file);
            assert_eq!(error(&file), format!("test: {}", $line));
        })*
    };
}

/// The same for a square with a `PENUMBRA_lights` block, made of a rect light that is edited.
macro_rules! light_refused {
    ($($name:ident: $edit:tt => $line:expr;)*) => {
        $(#[test]
        fn $name() {
            let mut light = json!({"version": 1, "shape": "rect", "width": 1, "height": 1, "radiance": [1, 1, 1]});
            for (key, value) in json!($edit).as_object().unwrap() {
                light[key] = value.clone();
            }
            let line = error(&File::with_light(light));
            assert_eq!(line, format!("test: nodes[1].extensions.PENUMBRA_lights{}", $line));
        })*
    };
}

/// What a file says whose animations are asked for.
fn animation_error(file: &File) -> String {
    let result = gltf::load_animated_slice(&file.gltf(), None, "test", LoadOptions::default());
    result.expect_err("a faulty file").to_string()
}

/// A square with an animation of two keys, which move it: `accessors[2]` holds times, `accessors[3]` translations.
fn moving() -> File {
    let mut file = File::square();
    let times = file.floats(&[[0.0], [1.0]]);
    let values = file.floats(&[[0.0; 3], [1.0; 3]]);
    file.json["animations"] = json!([{
        "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}],
        "samplers": [{"input": times, "output": values}],
    }]);
    file
}

/// A test that a moving square, once edited, is refused with exactly this line.
macro_rules! animation_refused {
    ($($name:ident: $edit:expr => $line:expr;)*) => {
        $(#[test]
        fn $name() {
            let mut file = moving();
            let edit: fn(&mut File) = $edit;
            edit(&mut file);
            assert_eq!(animation_error(&file), format!("test: {}", $line));
        })*
    };
}

fn sampler(file: &mut File) -> &mut Value {
    &mut file.json["animations"][0]["samplers"][0]
}

fn target(file: &mut File) -> &mut Value {
    &mut file.json["animations"][0]["channels"][0]["target"]
}

animation_refused! {
    a_channel_without_a_sampler_is_refused: |f| f.json["animations"][0]["channels"][0]["sampler"] = json!(1) =>
        "animations[0].channels[0].sampler: animations[0].samplers[1] does not exist: the file has 1";
    an_animated_node_that_does_not_exist_is_refused: |f| target(f)["node"] = json!(7) =>
        "animations[0].channels[0].target.node: nodes[7] does not exist: the file has 1";
    an_unknown_path_is_refused: |f| target(f)["path"] = json!("colour") =>
        "animations[0].channels[0].target.path: expected translation, rotation, scale or weights, found `colour`";
    two_channels_of_one_target_are_refused: |f| {
        let twin = f.json["animations"][0]["channels"][0].clone();
        push(&mut f.json["animations"][0]["channels"], twin);
    } => "animations[0].channels[1].target: another channel has the translation of nodes[0] already";
    an_animated_matrix_is_refused: |f| f.json["nodes"][0]["matrix"] = json!([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]) =>
        "animations[0].channels[0].target.node: nodes[0] has a matrix: what is animated has translation, rotation and scale";
    weights_of_no_targets_are_refused: |f| target(f)["path"] = json!("weights") =>
        "animations[0].channels[0].target.node: nodes[0] has no morph targets";
    an_unknown_interpolation_is_refused: |f| sampler(f)["interpolation"] = json!("CUBIC") =>
        "animations[0].samplers[0].interpolation: expected LINEAR, STEP or CUBICSPLINE, found `CUBIC`";
    times_that_do_not_exist_are_refused: |f| sampler(f)["input"] = json!(9) =>
        "animations[0].samplers[0].input: accessors[9] does not exist: the file has 4";
    times_of_vectors_are_refused: |f| sampler(f)["input"] = json!(3) =>
        "animations[0].samplers[0].input: accessors[3]: expected SCALAR of FLOAT, found VEC3 of FLOAT";
    no_times_are_refused: |f| f.json["accessors"][2]["count"] = json!(0) =>
        "animations[0].samplers[0].input: accessors[2]: expected at least 1 element";
    times_that_do_not_ascend_are_refused: |f| {
        let times = f.floats(&[[1.0], [1.0]]);
        sampler(f)["input"] = json!(times);
    } => "animations[0].samplers[0].input: expected finite times of at least 0 that ascend, found 1 as number 1";
    negative_times_are_refused: |f| {
        let times = f.floats(&[[-0.5], [1.0]]);
        sampler(f)["input"] = json!(times);
    } => "animations[0].samplers[0].input: expected finite times of at least 0 that ascend, found -0.5 as number 0";
    times_that_are_no_numbers_are_refused: |f| {
        let times = f.floats(&[[0.0], [f32::NAN]]);
        sampler(f)["input"] = json!(times);
    } => "animations[0].samplers[0].input: expected finite times of at least 0 that ascend, found NaN as number 1";
    fewer_values_than_times_are_refused: |f| f.json["accessors"][3]["count"] = json!(1) =>
        "animations[0].samplers[0].output: accessors[3]: expected 2 elements, found 1";
    a_spline_without_tangents_is_refused: |f| sampler(f)["interpolation"] = json!("CUBICSPLINE") =>
        "animations[0].samplers[0].output: accessors[3]: expected 6 elements, found 2";
    values_of_a_wrong_type_are_refused: |f| target(f)["path"] = json!("rotation") =>
        "animations[0].samplers[0].output: accessors[3]: expected VEC4 of FLOAT or BYTE or UNSIGNED_BYTE or SHORT or UNSIGNED_SHORT, found VEC3 of FLOAT";
    values_that_are_no_numbers_are_refused: |f| {
        let values = f.floats(&[[0.0; 3], [f32::INFINITY; 3]]);
        sampler(f)["output"] = json!(values);
    } => "animations[0].samplers[0].output: expected finite numbers, found inf";
    rotations_of_no_direction_are_refused: |f| {
        let values = f.floats(&[[0.0, 0.0, 0.0, 1.0], [0.0; 4]]);
        sampler(f)["output"] = json!(values);
        target(f)["path"] = json!("rotation");
    } => "animations[0].samplers[0].output: expected unit quaternions, found 0, 0, 0, 0 at key 1";
    integers_that_are_not_normalized_are_refused: |f| {
        let values = f.accessor(&[0, 0, 0, 127, 0, 127, 0, 0], 5120, 2, "VEC4");
        sampler(f)["output"] = json!(values);
        target(f)["path"] = json!("rotation");
    } => "animations[0].samplers[0].output: accessors[4]: expected normalized integers";
    an_animated_index_beyond_32_bits_is_refused: |f| target(f)["node"] = json!(1u64 << 32) =>
        "animations[0].channels[0].target.node (line 1, column 702): invalid value: integer `4294967296`, expected u32";
}

#[test]
fn claimed_keys_without_data_are_refused_before_they_are_allocated() {
    let mut file = moving();
    file.json["accessors"][2] = json!({"componentType": 5126, "count": 4_000_000_000u64, "type": "SCALAR"});
    file.json["accessors"][3] = json!({"componentType": 5126, "count": 4_000_000_000u64, "type": "VEC3"});
    let line = animation_error(&file);
    assert!(line.starts_with("test: animations[0].samplers[0].input: too many keys for its size: a file of"), "{line}");
}

#[test]
fn a_spline_through_no_rotation_is_refused_at_its_time() {
    let mut file = moving();
    let zero = [0.0; 4];
    let values = file.floats(&[zero, [0.0, 0.0, 0.0, 1.0], zero, zero, [0.0, 0.0, 0.0, -1.0], zero]);
    *sampler(&mut file) = json!({"input": 2, "output": values, "interpolation": "CUBICSPLINE"});
    target(&mut file)["path"] = json!("rotation");
    let animated = gltf::load_animated_slice(&file.gltf(), None, "test", LoadOptions::default()).unwrap();
    assert_eq!(
        animated.pose(0, 0.5).unwrap_err().to_string(),
        "test: nodes[0].rotation at 0.5 s of animation \"animation 0\": its cubic spline passes through 0, 0, 0, 0, which is no \
         rotation"
    );
}

/// Gives the square a skin of two joints, which are nodes 1 and 2: accessors 2 and 3 hold joints and weights.
fn skin(file: &mut File) {
    let joints = file.accessor(&[0, 1, 0, 0].repeat(4), 5121, 4, "VEC4");
    let weights = file.floats(&[[0.5, 0.5, 0.0, 0.0]; 4]);
    file.primitive()["attributes"]["JOINTS_0"] = json!(joints);
    file.primitive()["attributes"]["WEIGHTS_0"] = json!(weights);
    file.add_node(json!({}));
    file.add_node(json!({}));
    file.json["skins"] = json!([{"joints": [1, 2]}]);
    file.json["nodes"][0]["skin"] = json!(0);
}

/// Gives the square other weights for its skin.
fn weigh(file: &mut File, weights: [f32; 4]) {
    skin(file);
    let weights = file.floats(&[[1.0, 0.0, 0.0, 0.0], weights, [1.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]]);
    file.primitive()["attributes"]["WEIGHTS_0"] = json!(weights);
}

/// Gives the square a morph target of these displacements.
fn morph(file: &mut File, displacements: &[[f32; 3]]) {
    let displacements = file.floats(displacements);
    file.primitive()["targets"] = json!([{"POSITION": displacements}]);
}

refused! {
    a_skin_that_does_not_exist_is_refused: |f| { skin(f); f.json["nodes"][0]["skin"] = json!(1); } =>
        "nodes[0].skin: skins[1] does not exist: the file has 1";
    a_joint_that_does_not_exist_is_refused: |f| { skin(f); f.json["skins"][0]["joints"] = json!([1, 8]); } =>
        "skins[0].joints[1]: nodes[8] does not exist: the file has 3";
    a_skin_without_joints_is_refused: |f| { skin(f); f.json["skins"][0]["joints"] = json!([]); } =>
        "skins[0].joints: expected at least one";
    a_joint_that_the_skin_lacks_is_refused: |f| { skin(f); f.json["skins"][0]["joints"] = json!([1]); } =>
        "nodes[0].skin: skins[0] has 1 joints, and meshes[0] is moved by joint 1";
    too_few_matrices_are_refused: |f| {
        skin(f);
        let matrices = f.accessor(&[0; 64], 5126, 1, "MAT4");
        f.json["skins"][0]["inverseBindMatrices"] = json!(matrices);
    } => "skins[0].inverseBindMatrices: accessors[4]: 1 are too few for 2 joints";
    matrices_that_are_no_transforms_are_refused: |f| {
        skin(f);
        let none = json!({"componentType": 5126, "count": 4_000_000_000u64, "type": "MAT4"});
        let matrices = push(&mut f.json["accessors"], none);
        f.json["skins"][0]["inverseBindMatrices"] = json!(matrices);
    } => "skins[0].inverseBindMatrices: matrix 0: expected finite numbers with a last row of 0, 0, 0, 1";
    a_skinned_mesh_without_joints_is_refused: |f| { skin(f); f.primitive()["attributes"].as_object_mut().unwrap().remove("JOINTS_0"); } =>
        "meshes[0].primitives[0].attributes.JOINTS_0: missing, and a node with a skin shows it";
    joints_without_weights_are_refused: |f| { skin(f); f.primitive()["attributes"]["JOINTS_1"] = json!(2); } =>
        "meshes[0].primitives[0].attributes.WEIGHTS_1: missing, and a node with a skin shows it";
    joints_of_floats_are_refused: |f| { skin(f); f.primitive()["attributes"]["JOINTS_0"] = json!(3); } =>
        "meshes[0].primitives[0].attributes.JOINTS_0: accessors[3]: expected VEC4 of UNSIGNED_BYTE or UNSIGNED_SHORT, found VEC4 of FLOAT";
    weights_of_plain_integers_are_refused: |f| { skin(f); f.primitive()["attributes"]["WEIGHTS_0"] = json!(2); } =>
        "meshes[0].primitives[0].attributes.WEIGHTS_0: accessors[2]: expected normalized integers";
    a_vertex_without_weight_is_refused: |f| weigh(f, [0.0; 4]) =>
        "meshes[0].primitives[0].attributes.WEIGHTS_0: all weights of vertex 1 are 0: no joint moves it";
    a_negative_weight_is_refused: |f| weigh(f, [1.0, -0.5, 0.0, 0.0]) =>
        "accessors[4]: vertex 1 has a weight below 0 or not finite";
    a_weight_that_is_no_number_is_refused: |f| weigh(f, [f32::NAN, 0.0, 0.0, 0.0]) =>
        "accessors[4]: vertex 1 has a weight below 0 or not finite";
    a_skinned_vertex_out_of_range_is_refused: |f| {
        weigh(f, [1.0, 0.0, 0.0, 0.0]);
        f.json["nodes"][1]["scale"] = json!([1e30, 1, 1]);
    } => "nodes[0]: vertex 0 of \"square\" is deformed beyond 1e18";
    fewer_displacements_than_vertices_are_refused: |f| morph(f, &[[0.0; 3]; 3]) =>
        "meshes[0].primitives[0].targets[0].POSITION: accessors[2]: expected 4 elements, found 3";
    displacements_that_do_not_exist_are_refused: |f| f.primitive()["targets"] = json!([{}, {"NORMAL": 9}]) =>
        "meshes[0].primitives[0].targets[1].NORMAL: accessors[9] does not exist: the file has 2";
    displacements_of_scalars_are_refused: |f| f.primitive()["targets"] = json!([{"POSITION": 1}]) =>
        "meshes[0].primitives[0].targets[0].POSITION: accessors[1]: expected VEC3 of FLOAT or BYTE or SHORT, found SCALAR of UNSIGNED_SHORT";
    displacements_that_are_no_numbers_are_refused: |f| morph(f, &[[0.0; 3], [f32::NAN; 3], [0.0; 3], [0.0; 3]]) =>
        "accessors[2]: element 1 is a displacement of a morph target: expected finite numbers";
    unequal_numbers_of_targets_are_refused: |f| {
        morph(f, &[[0.0; 3]; 4]);
        push(&mut f.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}}));
    } => "meshes[0].primitives[1].targets: expected 1, as many as the mesh's other primitives have, found 0";
    weights_of_a_mesh_without_targets_are_refused: |f| f.json["meshes"][0]["weights"] = json!([1]) =>
        "meshes[0].weights: expected one for each of 0 morph targets, found 1";
    too_many_weights_of_a_node_are_refused: |f| { morph(f, &[[0.0; 3]; 4]); f.json["nodes"][0]["weights"] = json!([1, 2]); } =>
        "nodes[0].weights: expected one for each of 1 morph targets, found 2";
    an_infinite_weight_is_refused: |f| { morph(f, &[[0.0; 3]; 4]); f.json["nodes"][0]["weights"] = json!([1e39]); } =>
        "nodes[0].weights[0] (line 1, column 103): number out of range";
    a_morphed_vertex_out_of_range_is_refused: |f| { morph(f, &[[1e30; 3]; 4]); f.json["nodes"][0]["weights"] = json!([1]); } =>
        "nodes[0]: vertex 0 of \"square\" is deformed beyond 1e18";
}

#[test]
fn indices_of_skins_and_targets_beyond_32_bits_are_refused() {
    let beyond = |edit: fn(&mut File)| {
        let mut file = File::square();
        skin(&mut file);
        edit(&mut file);
        let line = error(&file);
        assert!(line.ends_with(": 4294967296 is out of range"), "{line}");
        line.split(" (").next().unwrap().to_owned()
    };
    fn index() -> Value {
        json!(1u64 << 32)
    }
    assert_eq!(beyond(|f| f.json["nodes"][0]["skin"] = index()), "test: nodes[0].skin");
    assert_eq!(beyond(|f| f.json["skins"][0]["skeleton"] = index()), "test: skins[0].skeleton");
    assert_eq!(beyond(|f| f.json["skins"][0]["inverseBindMatrices"] = index()), "test: skins[0].inverseBindMatrices");
    assert_eq!(
        beyond(|f| f.primitive()["targets"] = json!([{"NORMAL": index()}])),
        "test: meshes[0].primitives[0].targets[0].NORMAL"
    );
}

#[test]
fn one_displacement_many_times_over_is_refused() {
    let mut file = File::square();
    // 2¹⁶ vertices with as many displacements, which 3000 targets share.
    let many = file.floats(&vec![[1.0, 2.0, 3.0]; 1 << 16]);
    file.primitive()["attributes"]["POSITION"] = json!(many);
    let count = 3000;
    file.primitive()["targets"] = json!(vec![json!({"POSITION": many}); count]);
    file.json["meshes"][0]["weights"] = json!(vec![1; count]);
    let line = error(&file);
    assert!(
        line.starts_with("test: nodes[0]: too much that is deformed for its size: with this, 196611000 displac"),
        "{line}"
    );
}

refused! {
    a_missing_asset_is_refused: |f| { f.json.as_object_mut().unwrap().remove("asset"); } =>
        format!("line 1, column {}: missing field `asset`", gltf_length("asset"));
    another_version_is_refused: |f| f.json["asset"]["version"] = json!("1.0") =>
        "asset.version: expected glTF 2.0, found `1.0`";
    a_later_minimum_version_is_refused: |f| f.json["asset"]["minVersion"] = json!("2.1") =>
        "asset.version: expected glTF 2.0, found `2.1`";
    a_required_extension_that_is_missing_here_is_named: |f| f.json["extensionsRequired"] = json!(["KHR_materials_unlit", "EXT_meshopt_compression"]) =>
        "extensionsRequired[1]: `EXT_meshopt_compression` is not supported";
    a_scene_that_does_not_exist_is_refused: |f| f.json["scene"] = json!(1) =>
        "scene: scenes[1] does not exist: the file has 1";
    a_scene_node_that_does_not_exist_is_refused: |f| f.json["scenes"][0]["nodes"] = json!([0, 4]) =>
        "scenes[0].nodes[1]: nodes[4] does not exist: the file has 1";
    a_child_that_does_not_exist_is_refused: |f| f.json["nodes"][0]["children"] = json!([7]) =>
        "nodes[0].children[0]: nodes[7] does not exist: the file has 1";
    a_mesh_that_does_not_exist_is_refused: |f| f.json["nodes"][0]["mesh"] = json!(3) =>
        "nodes[0].mesh: meshes[3] does not exist: the file has 1";
    a_camera_that_does_not_exist_is_refused: |f| f.json["nodes"][0]["camera"] = json!(0) =>
        "nodes[0].camera: cameras[0] does not exist: the file has 0";
    a_material_that_does_not_exist_is_refused: |f| f.primitive()["material"] = json!(0) =>
        "meshes[0].primitives[0].material: materials[0] does not exist: the file has 0";
    an_accessor_that_does_not_exist_is_refused: |f| f.primitive()["attributes"]["POSITION"] = json!(9) =>
        "meshes[0].primitives[0].attributes.POSITION: accessors[9] does not exist: the file has 2";
    a_view_that_does_not_exist_is_refused: |f| f.json["accessors"][0]["bufferView"] = json!(5) =>
        "accessors[0].bufferView: bufferViews[5] does not exist: the file has 2";
    a_buffer_that_does_not_exist_is_refused: |f| f.json["bufferViews"][0]["buffer"] = json!(1) =>
        "bufferViews[0].buffer: buffers[1] does not exist: the file has 1";
    a_node_that_is_its_own_child_is_refused: |f| f.json["nodes"][0]["children"] = json!([0]) =>
        "nodes[0]: is its own ancestor";
    a_node_of_two_parents_is_refused: |f| f.json["nodes"] = json!([{"children": [2]}, {"children": [2]}, {}]) =>
        "nodes[1].children[0]: nodes[2] is a child of nodes[0] already";
    a_cycle_of_nodes_is_refused: |f| f.json["nodes"] = json!([{"mesh": 0}, {"children": [2]}, {"children": [3]}, {"children": [1]}]) =>
        "nodes[1]: is its own ancestor";
    a_flattening_scale_is_refused: |f| f.json["nodes"][0]["scale"] = json!([1, 0, 1]) =>
        "nodes[0]: singular transform: it (or a parent's) flattens space, for example by a scale of 0";
    a_flattening_parent_is_refused_however_it_is_turned: |f| {
        f.json["nodes"] = json!([
            {"mesh": 0, "rotation": [0.1, 0.2, 0.3, 0.9]},
            {"children": [0], "rotation": [0.5, 0.1, 0.7, 0.2], "scale": [1, 0, 1]},
            {"children": [1], "rotation": [0.3, 0.3, 0.1, 0.8]},
        ]);
        f.json["scenes"][0]["nodes"] = json!([2]);
    } => "nodes[0]: singular transform: it (or a parent's) flattens space, for example by a scale of 0";
    a_rotation_of_no_direction_is_refused: |f| f.json["nodes"][0]["rotation"] = json!([0, 0, 0, 0]) =>
        "nodes[0].rotation: expected a unit quaternion";
    an_infinite_translation_is_refused: |f| f.json["nodes"][0]["translation"] = json!([0, 1e39, 0]) =>
        "nodes[0].translation[1] (line 1, column 109): number out of range";
    a_projecting_matrix_is_refused: |f| f.json["nodes"][0]["matrix"] = json!([1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]) =>
        "nodes[0].matrix: expected finite numbers with a last row of 0, 0, 0, 1";
    an_absurd_place_in_the_world_is_refused: |f| f.json["nodes"][0]["translation"] = json!([0, 2e18, 0]) =>
        "nodes[0]: transform out of range: its entries may be at most 1e18";
    geometry_that_a_scale_makes_absurd_is_refused: |f| {
        let far = f.floats(&[[0.0, 0.0, 0.0], [1e10, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        f.primitive()["attributes"]["POSITION"] = json!(far);
        f.json["nodes"][0]["scale"] = json!([1e10, 1, 1]);
    } => "nodes[0]: its geometry goes beyond 1e18 in world space";
    an_infinite_position_is_refused: |f| {
        let bad = f.floats(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, f32::INFINITY, 0.0], [0.0, 0.0, 1.0]]);
        f.primitive()["attributes"]["POSITION"] = json!(bad);
    } => "meshes[0].primitives[0].attributes.POSITION: position 2 is (0, inf, 0): expected at most 1e18";
    a_position_that_is_no_number_is_refused: |f| {
        let bad = f.floats(&[[0.0, 0.0, f32::NAN]; 4]);
        f.primitive()["attributes"]["POSITION"] = json!(bad);
    } => "meshes[0].primitives[0].attributes.POSITION: position 0 is (0, 0, NaN): expected at most 1e18";
    an_absurd_position_is_refused: |f| {
        let bad = f.floats(&[[0.0, 0.0, 0.0], [1e30, 0.0, 0.0], [0.0; 3], [0.0; 3]]);
        f.primitive()["attributes"]["POSITION"] = json!(bad);
    } => "meshes[0].primitives[0].attributes.POSITION: position 1 is (1000000000000000000000000000000, 0, 0): expected at most 1e18";
    an_index_out_of_range_is_refused: |f| {
        let indices = f.accessor(&[0, 1, 2, 0, 2, 4], 5121, 6, "SCALAR");
        f.primitive()["indices"] = json!(indices);
    } => "meshes[0].primitives[0].indices: index 5 is 4: expected below 4";
    indices_of_floats_are_refused: |f| f.json["accessors"][1]["componentType"] = json!(5126) =>
        "accessors[1]: 6 elements of 4 bytes, 4 apart, from byte 0 do not fit bufferViews[1], which has 12";
    indices_of_vectors_are_refused: |f| f.primitive()["indices"] = json!(0) =>
        "meshes[0].primitives[0].indices: accessors[0]: expected SCALAR of UNSIGNED_BYTE or UNSIGNED_SHORT or UNSIGNED_INT, found VEC3 of FLOAT";
    positions_of_scalars_are_refused: |f| f.primitive()["attributes"]["POSITION"] = json!(1) =>
        "meshes[0].primitives[0].attributes.POSITION: accessors[1]: expected VEC3 of FLOAT or BYTE or UNSIGNED_BYTE or SHORT or UNSIGNED_SHORT, found SCALAR of UNSIGNED_SHORT";
    fewer_normals_than_positions_are_refused: |f| {
        let normals = f.floats(&[[0.0, 0.0, 1.0]; 3]);
        f.primitive()["attributes"]["NORMAL"] = json!(normals);
    } => "meshes[0].primitives[0].attributes.NORMAL: accessors[2]: expected 4 elements, found 3";
    an_unknown_component_type_is_refused: |f| f.json["accessors"][0]["componentType"] = json!(5124) =>
        "accessors[0].componentType: expected 5120, 5121, 5122, 5123, 5125 or 5126";
    an_unknown_type_is_refused: |f| f.json["accessors"][0]["type"] = json!("VEC5") =>
        "accessors[0].type: expected SCALAR, VEC2, VEC3, VEC4, MAT2, MAT3 or MAT4";
    an_unknown_mode_is_refused: |f| f.primitive()["mode"] = json!(7) =>
        "meshes[0].primitives[0].mode: expected 0 to 6";
    an_accessor_beyond_its_view_is_refused: |f| f.json["accessors"][0]["count"] = json!(5) =>
        "accessors[0]: 5 elements of 12 bytes, 12 apart, from byte 0 do not fit bufferViews[0], which has 48";
    an_accessor_offset_beyond_its_view_is_refused: |f| f.json["accessors"][0]["byteOffset"] = json!(u64::MAX) =>
        "accessors[0]: 4 elements of 12 bytes, 12 apart, from byte 18446744073709551615 do not fit bufferViews[0], which has 48";
    a_view_beyond_its_buffer_is_refused: |f| f.json["bufferViews"][1]["byteLength"] = json!(13) =>
        "bufferViews[1]: 13 bytes from 48 do not fit buffers[0], which has 60";
    a_view_whose_end_overflows_is_refused: |f| f.json["bufferViews"][1]["byteLength"] = json!(u64::MAX) =>
        "bufferViews[1]: 18446744073709551615 bytes from 48 do not fit buffers[0], which has 60";
    a_stride_below_the_element_is_refused: |f| f.json["bufferViews"][0]["byteStride"] = json!(8) =>
        "bufferViews[0].byteStride: expected 12 to 252 for accessors[0], found 8";
    a_stride_of_zero_is_refused: |f| f.json["bufferViews"][0]["byteStride"] = json!(0) =>
        "bufferViews[0].byteStride: expected 12 to 252 for accessors[0], found 0";
    a_stride_beyond_the_limit_is_refused: |f| f.json["bufferViews"][0]["byteStride"] = json!(256) =>
        "bufferViews[0].byteStride: expected 12 to 252 for accessors[0], found 256";
    a_sparse_index_out_of_range_is_refused: |f| {
        f.view(&[1, 9]);
        f.view(&[0; 24]);
        f.json["accessors"][0]["sparse"] = sparse(2);
    } => "accessors[0].sparse.indices: index 1 is 9: expected at least 2 (ascending) and below 4";
    sparse_indices_that_do_not_ascend_are_refused: |f| {
        f.view(&[1, 1]);
        f.view(&[0; 24]);
        f.json["accessors"][0]["sparse"] = sparse(2);
    } => "accessors[0].sparse.indices: index 1 is 1: expected at least 2 (ascending) and below 4";
    sparse_values_beyond_their_view_are_refused: |f| {
        f.view(&[1, 2]);
        f.view(&[0; 20]);
        f.json["accessors"][0]["sparse"] = sparse(2);
    } => "accessors[0].sparse.values: 2 elements of 12 bytes, 12 apart, from byte 0 do not fit bufferViews[3], which has 20";
    more_sparse_elements_than_elements_are_refused: |f| {
        f.view(&[0; 8]);
        f.view(&[0; 96]);
        f.json["accessors"][0]["sparse"] = sparse(5);
    } => "accessors[0].sparse.count: 5 is more than the accessor's 4";
    a_claimed_count_without_data_is_refused_before_it_is_allocated: |f| {
        f.json["accessors"][0] = json!({"componentType": 5126, "count": 4_000_000_000u64, "type": "VEC3"});
    } => format!(
        "meshes[0].primitives[0]: too much geometry for its size: with this, 4000000002 vertices and triangles, and a file of {0} bytes may have {1}",
        size_with(&json!({"componentType": 5126, "count": 4_000_000_000u64, "type": "VEC3"})),
        (1 << 20) + 4 * size_with(&json!({"componentType": 5126, "count": 4_000_000_000u64, "type": "VEC3"})),
    );
    an_index_beyond_32_bits_is_refused: |f| f.json["nodes"][0]["mesh"] = json!(1u64 << 32) =>
        "nodes[0].mesh (line 1, column 95): 4294967296 is out of range";
    an_attribute_beyond_32_bits_is_refused: |f| f.primitive()["attributes"]["POSITION"] = json!(1u64 << 32) =>
        "meshes[0].primitives[0].attributes.POSITION (line 1, column 166): 4294967296 is out of range";
    a_buffer_longer_than_its_data_is_refused: |f| f.json["buffers"] = json!([{"byteLength": 4, "uri": "data:;base64,AAAA"}]) =>
        "buffers[0].byteLength: expected 4 bytes, found 3";
    a_buffer_without_data_is_refused: |f| f.json["buffers"] = json!([{"byteLength": 4}]) =>
        "buffers[0].uri: missing, and this is not the first buffer of a GLB with a BIN chunk";
    bad_base64_is_refused: |f| f.json["buffers"] = json!([{"byteLength": 3, "uri": "data:;base64,A*AA"}]) =>
        "buffers[0].uri: base64: Invalid symbol 42, offset 1.";
    a_data_uri_of_another_encoding_is_refused: |f| f.json["buffers"] = json!([{"byteLength": 3, "uri": "data:text/plain,abc"}]) =>
        "buffers[0].uri: expected a data: URI in base64, found `data:text/plain`";
    a_web_address_is_refused: |f| f.json["buffers"] = json!([{"byteLength": 3, "uri": "http://example.com/a.bin"}]) =>
        "buffers[0].uri: `http://example.com/a.bin` is not a relative path or a data: URI";
    an_absolute_path_is_refused: |f| f.json["buffers"] = json!([{"byteLength": 3, "uri": "/etc/hostname"}]) =>
        "buffers[0].uri: `/etc/hostname` is not a relative path or a data: URI";
    a_hidden_absolute_path_is_refused: |f| f.json["buffers"] = json!([{"byteLength": 3, "uri": "%2Fetc%2Fhostname"}]) =>
        "buffers[0].uri: `%2Fetc%2Fhostname` is not a relative path or a data: URI";
    a_drive_is_refused: |f| f.json["buffers"] = json!([{"byteLength": 3, "uri": "C:\\a.bin"}]) =>
        "buffers[0].uri: `C:\\a.bin` is not a relative path or a data: URI";
    a_file_outside_memory_is_refused: |f| f.json["buffers"] = json!([{"byteLength": 3, "uri": "a.bin"}]) =>
        "buffers[0].uri: `a.bin` is a file outside this one, which has no directory";
    draco_without_a_copy_is_refused: |f| {
        f.json["accessors"][0] = json!({"componentType": 5126, "count": 4, "type": "VEC3"});
        f.primitive()["extensions"] = json!({"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {}}});
    } => "meshes[0].primitives[0].extensions.KHR_draco_mesh_compression: not supported, and there is no uncompressed copy";
    a_camera_without_a_field_of_view_is_refused: |f| {
        f.json["cameras"] = json!([{"type": "perspective", "perspective": {"yfov": 0, "znear": 1}}]);
        f.add_node(json!({"camera": 0}));
    } => "cameras[0].perspective.yfov: expected more than 0 and less than π, found 0";
    a_camera_of_no_height_is_refused: |f| {
        f.json["cameras"] = json!([{"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 0, "znear": 0, "zfar": 1}}]);
        f.add_node(json!({"camera": 0}));
    } => "cameras[0].orthographic.ymag: expected a positive number, found 0";
    a_camera_whose_far_is_near_is_refused: |f| {
        f.json["cameras"] = json!([{"type": "perspective", "perspective": {"yfov": 1, "znear": 2, "zfar": 1}}]);
        f.add_node(json!({"camera": 0}));
    } => "cameras[0].perspective: expected 0 <= znear < zfar, found 2 and 1";
    a_camera_without_its_projection_is_refused: |f| {
        f.json["cameras"] = json!([{"type": "perspective"}]);
        f.add_node(json!({"camera": 0}));
    } => "cameras[0].perspective: missing";
    an_unknown_camera_is_refused: |f| {
        f.json["cameras"] = json!([{"type": "fisheye"}]);
        f.add_node(json!({"camera": 0}));
    } => "cameras[0].type: expected perspective or orthographic";
    an_unknown_alpha_mode_is_refused: |f| f.json["materials"] = json!([{"alphaMode": "HALF"}]) =>
        "materials[0].alphaMode: expected OPAQUE, MASK or BLEND";
    a_negative_emission_is_refused: |f| f.json["materials"] = json!([{"emissiveFactor": [0, -1, 0]}]) =>
        "materials[0].emissiveFactor: expected finite numbers of at least 0";
    a_texture_that_does_not_exist_is_refused: |f| {
        f.json["materials"] = json!([{"pbrMetallicRoughness": {"baseColorTexture": {"index": 2}}}]);
        f.primitive()["material"] = json!(0);
    } => "materials[0].pbrMetallicRoughness.baseColorTexture.index: textures[2] does not exist: the file has 0";
    a_texture_without_a_source_is_refused: |f| texture(f, json!([{"source": 4}]), json!([])) =>
        "textures[0].source: images[4] does not exist: the file has 0";
    an_image_without_data_is_refused: |f| texture(f, json!([{"source": 0}]), json!([{}])) =>
        "images[0]: expected a uri or a bufferView";
    an_image_of_another_format_is_refused: |f| texture(f, json!([{"source": 0}]), json!([{"uri": "data:image/webp;base64,UklGRgAAAABXRUJQ"}])) =>
        "images[0]: expected PNG or JPEG";
    a_sampler_that_does_not_exist_is_refused: |f| {
        let view = f.view(&png(1, 1));
        texture(f, json!([{"source": 0, "sampler": 3}]), json!([{"bufferView": view}]));
    } => "textures[0].sampler: samplers[3] does not exist: the file has 0";
    instances_of_unequal_counts_are_refused: |f| {
        let (one, two) = (f.floats(&[[0.0; 3]]), f.floats(&[[1.0; 3]; 2]));
        instancing(f, json!({"SCALE": two, "TRANSLATION": one}));
    } => "nodes[0].extensions.EXT_mesh_gpu_instancing.attributes.TRANSLATION: accessors[2]: expected 2 elements, found 1";
    instances_without_attributes_are_refused: |f| instancing(f, json!({})) =>
        "nodes[0].extensions.EXT_mesh_gpu_instancing.attributes: expected TRANSLATION, ROTATION or SCALE";
    instances_that_are_flat_are_refused: |f| {
        let scales = f.floats(&[[1.0; 3], [1.0, 0.0, 1.0]]);
        instancing(f, json!({"SCALE": scales}));
    } => "nodes[0].extensions.EXT_mesh_gpu_instancing, instance 1: singular transform: it (or a parent's) flattens space, for example by a scale of 0";
    instances_turned_by_nothing_are_refused: |f| {
        let rotations = f.floats(&[[0.0; 4]]);
        instancing(f, json!({"ROTATION": rotations}));
    } => "nodes[0].extensions.EXT_mesh_gpu_instancing, instance 0: expected a unit quaternion for ROTATION";
    instances_of_a_wrong_type_are_refused: |f| instancing(f, json!({"TRANSLATION": 1})) =>
        "nodes[0].extensions.EXT_mesh_gpu_instancing.attributes.TRANSLATION: accessors[1]: expected VEC3 of FLOAT, found SCALAR of UNSIGNED_SHORT";
    an_extension_of_a_wrong_shape_is_refused: |f| instancing(f, json!([1])) =>
        "nodes[0].extensions.EXT_mesh_gpu_instancing.attributes: invalid type: sequence, expected a map";
    an_area_light_that_does_not_exist_is_refused: |f| {
        f.add_node(json!({"extensions": {"EXT_lights_area": {"light": 0}}}));
    } => "nodes[1].extensions.EXT_lights_area.light: extensions.EXT_lights_area.lights[0] does not exist: the file has 0";
    an_area_light_of_unknown_type_is_refused: |f| area_light(f, json!({"type": "blob"})) =>
        "extensions.EXT_lights_area.lights[0].type: expected rect or disk, found `blob`";
    an_area_light_of_no_size_is_refused: |f| area_light(f, json!({"type": "disk", "size": 0})) =>
        "extensions.EXT_lights_area.lights[0].size: the light has no area: expected a positive length up to 1e18, found 0";
    an_area_light_of_negative_aspect_is_refused: |f| area_light(f, json!({"type": "rect", "rect": {"aspect": -1}})) =>
        "extensions.EXT_lights_area.lights[0].rect.aspect: the light has no area: expected a positive length up to 1e18, found -1";
    an_area_light_at_a_flattened_node_is_refused: |f| {
        area_light(f, json!({"type": "disk"}));
        f.json["nodes"][1]["scale"] = json!([0, 0, 0]);
    } => "nodes[1]: singular transform: it (or a parent's) flattens space, for example by a scale of 0";
    a_punctual_light_that_does_not_exist_is_refused: |f| {
        punctual(f, json!({"type": "point"}));
        f.json["nodes"][1]["extensions"]["KHR_lights_punctual"]["light"] = json!(1);
    } => "nodes[1].extensions.KHR_lights_punctual.light: extensions.KHR_lights_punctual.lights[1] does not exist: the file has 1";
    a_punctual_light_of_unknown_type_is_refused: |f| punctual(f, json!({"type": "tube"})) =>
        "extensions.KHR_lights_punctual.lights[0].type: expected point, spot or directional";
    a_spot_without_its_cone_is_refused: |f| punctual(f, json!({"type": "spot"})) =>
        "extensions.KHR_lights_punctual.lights[0].spot: missing";
    a_spot_wider_than_a_half_space_is_refused: |f| punctual(f, json!({"type": "spot", "spot": {"outerConeAngle": 2}})) =>
        "extensions.KHR_lights_punctual.lights[0].spot: expected cone angles with 0 <= inner <= outer <= π/2 and outer > 0, found 0 and 2";
    a_negative_radius_is_refused: |f| punctual(f, json!({"type": "point", "extras": {"radius": -1}})) =>
        "extensions.KHR_lights_punctual.lights[0].extras.radius: the light has no area: expected a positive length up to 1e18, found -1";
    a_sun_of_half_the_sky_is_refused: |f| punctual(f, json!({"type": "directional", "extras": {"angle": 3.5}})) =>
        "extensions.KHR_lights_punctual.lights[0].extras.angle: expected at least 0 and less than π, found 3.5";
    a_punctual_light_too_small_for_its_intensity_is_refused: |f| punctual(f, json!({"type": "point", "intensity": 1e30, "extras": {"radius": 1e-9}})) =>
        "extensions.KHR_lights_punctual.lights[0]: a radius of 0.000000001 is too small for its intensity";
    an_area_light_that_no_image_holds_is_refused: |f| area_light(f, json!({"type": "disk", "color": [0, 1, 0], "intensity": 1e300})) =>
        "extensions.EXT_lights_area.lights[0].color, intensity: expected at most 1e37, found 1e300";
    a_dark_light_of_negative_intensity_is_refused: |f| punctual(f, json!({"type": "point", "intensity": -683})) =>
        "extensions.KHR_lights_punctual.lights[0].color, intensity: expected finite numbers of at least 0, found -1, -1, -1";
}

light_refused! {
    a_later_version_of_our_block_is_refused: {"version": 2, "glow": true} => ".version: expected 1, found 2";
    a_radiance_that_no_image_holds_is_refused: {"radiance": [0, 2e38, 0]} => ".radiance: expected at most 1e37, found 2e38";
    an_irradiance_that_no_image_holds_is_refused: {"shape": "sun", "irradiance": [1e300, 0, 0]} =>
        ".irradiance: expected at most 1e37, found 1e300";
    an_intensity_that_no_image_holds_is_refused: {"shape": "point", "intensity": [1e300, 0, 0]} =>
        ".intensity: expected at most 1e37, found 1e300";
    an_unknown_shape_is_refused: {"shape": "ring\nline"} =>
        ".shape: expected rect, disk, sphere, tube, sun, point or spot, found `ring line`";
    an_unknown_member_is_refused: {"cast_shadows": false} =>
        ".cast_shadows: unknown field `cast_shadows`, expected one of `version`, `shape`, `width`, `height`, `radius`, `length`, \
         `angle`, `radiance`, `intensity`, `irradiance`, `facing`, `spread`, `inner_cone`, `outer_cone`, `casts_shadow`, \
         `light_exclude`, `shadow_exclude`, `extras`, `extensions`";
    a_member_of_a_wrong_type_is_refused: {"width": "wide"} => ".width: invalid type: string \"wide\", expected f64";
    a_rect_of_no_width_is_refused: {"width": 0} =>
        ".width: the light has no area: expected a positive length up to 1e18, found 0";
    a_rect_without_a_height_is_refused: {"height": null} => ".height: missing";
    a_rect_of_negative_height_is_refused: {"height": -2} =>
        ".height: the light has no area: expected a positive length up to 1e18, found -2";
    a_rect_whose_area_vanishes_is_refused: {"height": 1e-200} =>
        format!(".height: the light has no area: expected a positive length up to 1e18, found {}", 1e-200);
    a_rect_beyond_all_bounds_is_refused: {"height": 1e19} =>
        ".height: the light has no area: expected a positive length up to 1e18, found 10000000000000000000";
    a_tube_without_a_radius_is_refused: {"shape": "tube", "length": 1} => ".radius: missing";
    a_sphere_of_radiance_and_no_radius_is_refused: {"shape": "sphere", "radius": 0} =>
        ".radius: the light has no area: expected a positive length up to 1e18, found 0";
    a_light_without_emission_is_refused: {"radiance": null} => ".radiance: missing";
    a_sun_without_irradiance_is_refused: {"shape": "sun"} => ".irradiance: missing";
    a_point_without_intensity_is_refused: {"shape": "point"} => ".intensity: missing";
    a_spot_without_an_outer_cone_is_refused: {"shape": "spot", "intensity": [1, 1, 1], "radiance": null} => ".outer_cone: missing";
    a_negative_radiance_is_refused: {"radiance": [0, -1, 0]} =>
        ".radiance: expected finite numbers of at least 0, found 0, -1, 0";
    no_spread_at_all_is_refused: {"spread": 0} => ".spread: expected more than 0 and at most π, found 0";
    a_spread_of_more_than_a_half_space_is_refused: {"spread": 4} => ".spread: expected more than 0 and at most π, found 4";
}

/// What loading a file says.
fn error(file: &File) -> String {
    load(&file.gltf()).map(|scene| scene.warnings).expect_err("a faulty file")
}

/// Length of the square's JSON without one of its members.
fn gltf_length(without: &str) -> usize {
    let mut file = File::square();
    file.json.as_object_mut().unwrap().remove(without);
    file.gltf().len()
}

/// What counts as the size of a square whose first accessor is another one: its JSON and its buffer.
fn size_with(accessor: &Value) -> u64 {
    let mut file = File::square();
    file.json["accessors"][0] = accessor.clone();
    (file.gltf().len() + file.bin.len()) as u64
}

fn sparse(count: u32) -> Value {
    json!({"count": count, "indices": {"bufferView": 2, "componentType": 5121}, "values": {"bufferView": 3}})
}

fn texture(file: &mut File, textures: Value, images: Value) {
    file.json["materials"] = json!([{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]);
    file.primitive()["material"] = json!(0);
    file.json["textures"] = textures;
    file.json["images"] = images;
}

fn png(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::GrayImage::new(width, height).write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

fn instancing(file: &mut File, attributes: Value) {
    file.json["nodes"][0]["extensions"] = json!({"EXT_mesh_gpu_instancing": {"attributes": attributes}});
}

fn area_light(file: &mut File, light: Value) {
    file.json["extensions"] = json!({"EXT_lights_area": {"lights": [light]}});
    file.add_node(json!({"extensions": {"EXT_lights_area": {"light": 0}}}));
}

fn punctual(file: &mut File, light: Value) {
    file.json["extensions"] = json!({"KHR_lights_punctual": {"lights": [light]}});
    file.add_node(json!({"extensions": {"KHR_lights_punctual": {"light": 0}}}));
}

#[test]
fn a_glb_that_lies_about_its_length_is_refused() {
    let glb = File::square().glb();
    let with = |at: usize, value: u32| {
        let mut bytes = glb.clone();
        bytes[at..at + 4].copy_from_slice(&value.to_le_bytes());
        load(&bytes).unwrap_err()
    };
    let size = glb.len() as u32;
    let json_size = u32::from_le_bytes(glb[12..16].try_into().unwrap());
    assert_eq!(with(4, 1), "test: GLB header: expected version 2, found 1");
    assert_eq!(with(8, size + 1), format!("test: GLB header: its length is {} bytes, the file has {size}", size + 1));
    assert_eq!(with(8, 3), format!("test: GLB header: its length is 3 bytes, the file has {size}"));
    assert_eq!(
        with(12, u32::MAX),
        format!("test: GLB chunk at byte 12: its length is 4294967295 bytes, {} are left", size - 20)
    );
    assert_eq!(with(16, 0), "test: GLB chunk at byte 12: expected the JSON chunk first");
    let bin = 20 + json_size as usize;
    assert_eq!(with(bin, 61), format!("test: GLB chunk at byte {bin}: its length is 61 bytes, 60 are left"));
    assert_eq!(with(bin, 59), "test: buffers[0].byteLength: expected 60 bytes, found 59");
    assert_eq!(
        with(bin + 4, 0x1234),
        "test: buffers[0].uri: missing, and this is not the first buffer of a GLB with a BIN chunk"
    );
}

#[test]
fn every_truncation_is_refused_with_one_line() {
    let file = File::square();
    for bytes in [file.glb(), file.gltf()] {
        for length in 0..bytes.len() {
            let line = load(&bytes[..length]).unwrap_err();
            assert!(line.starts_with("test: ") && !line.contains('\n'), "{length}: {line}");
        }
    }
}

#[test]
fn deeply_nested_json_is_refused() {
    for (open, close) in [("[", "]"), ("{\"a\":", "}")] {
        for prefix in [
            "",
            "{\"asset\": {\"version\": \"2.0\"}, \"extras\": ",
            "{\"asset\": {\"version\": \"2.0\"}, \"extensions\": {\"a\": ",
        ] {
            let bytes = format!("{prefix}{}{}", open.repeat(100_000), close.repeat(100_000));
            assert!(!load(bytes.as_bytes()).unwrap_err().contains('\n'));
        }
    }
}

#[test]
fn a_long_message_stays_one_short_line() {
    let mut file = File::square();
    file.json["extensionsRequired"] = json!(["line\nbreak".repeat(1000)]);
    let line = error(&file);
    assert!(line.len() < 300 && !line.contains('\n'), "{line}");
}

#[test]
fn few_bytes_can_not_become_many_triangles() {
    // The same 300,000 corners under a thousand materials.
    let mut file = File::square();
    let indices = file.accessor(&[0, 1, 2].repeat(100_000), 5121, 300_000, "SCALAR");
    file.json["materials"] = json!(vec![json!({}); 1000]);
    let primitive = |material| json!({"attributes": {"POSITION": 0}, "indices": indices, "material": material});
    file.json["meshes"][0]["primitives"] = (0..1000).map(primitive).collect();
    let line = error(&file);
    assert!(line.contains("too much geometry for its size"), "{line}");
}

#[test]
fn few_bytes_can_not_become_many_instances() {
    // A thousand nodes with the same thousand copies of two primitives.
    let mut file = File::square();
    let translations = file.floats(&[[0.0; 3]; 1000]);
    push(&mut file.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}}));
    for _ in 0..1000 {
        file.add_node(json!({"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": translations}}}}));
    }
    let line = error(&file);
    assert!(line.contains("too many instances for its size"), "{line}");
}

#[test]
fn few_bytes_can_not_become_a_large_picture() {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image::GrayImage::new(1, 1).write_to(&mut bytes, image::ImageFormat::Jpeg).unwrap();
    let mut jpeg = bytes.into_inner();
    // Height and width follow the marker, the length and the precision of the frame header.
    let frame = jpeg.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
    jpeg[frame + 5..frame + 9].copy_from_slice(&[0xff, 0x00, 0xff, 0x00]);
    let mut file = File::square();
    let view = file.view(&jpeg);
    texture(&mut file, json!([{"source": 0}]), json!([{"bufferView": view}]));
    let line = error(&file);
    assert!(line.contains("images[0]: 65280 x 65280 texels: textures of"), "{line}");
}

#[test]
fn long_names_are_not_multiplied_by_their_uses() {
    let mut file = File::square();
    let name = "long ".repeat(200_000);
    file.json["meshes"][0]["name"] = json!(name);
    let primitive = |material| json!({"attributes": {"POSITION": 0}, "indices": 1, "material": material});
    file.json["materials"] = json!(vec![json!({}); 5000]);
    file.json["meshes"][0]["primitives"] = (0..5000).map(primitive).collect();
    let scene = file.scene();
    assert!(scene.meshes.len() == 5000 && scene.meshes.iter().all(|mesh| mesh.name.len() < 250));
}

#[test]
fn a_rectangle_among_many_vertices_is_found_without_looking_at_them() {
    // A hundred thousand copies of two triangles out of a million vertices.
    let mut file = File::square();
    let mut corners = vec![[0.0; 3]; 1_000_000];
    corners[..4].copy_from_slice(&[[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]);
    let positions = file.floats(&corners);
    file.json["materials"] =
        json!([{"emissiveFactor": [1, 1, 1], "extensions": {"KHR_materials_emissive_strength": {}}}]);
    *file.primitive() = json!({"attributes": {"POSITION": positions}, "indices": 1, "material": 0});
    let translations = file.floats(&[[0.0; 3]; 100_000]);
    instancing(&mut file, json!({"TRANSLATION": translations}));
    assert_eq!(error(&file), "test: nodes[0]: 65536 lights come before it, which is the most");
}

#[test]
fn an_image_is_not_decoded_for_ever() {
    let mut file = File::square();
    // Noise doesn't compress: the image is most of the file.
    let mut random = Random(1);
    let noise = image::GrayImage::from_fn(512, 512, |_, _| image::Luma([random.below(256) as u8]));
    let mut bytes = std::io::Cursor::new(Vec::new());
    noise.write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    let view = file.view(bytes.get_ref());
    file.json["images"] = json!([{"bufferView": view}]);
    file.json["textures"] = json!(vec![json!({"source": 0}); 100]);
    let material = |index| json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": index}}});
    file.json["materials"] = (0..100).map(material).collect();
    let primitive = |material| json!({"attributes": {"POSITION": 0}, "indices": 1, "material": material});
    file.json["meshes"][0]["primitives"] = (0..100).map(primitive).collect();
    let line = error(&file);
    assert!(
        line.contains("images[0]: textures use the file's") && line.ends_with("bytes more than 16 times"),
        "{line}"
    );
}

#[test]
fn many_lights_of_one_name_load_in_no_time() {
    let mut file = File::square();
    file.json["extensions"] = json!({"EXT_lights_area": {"lights": [{"name": "a", "type": "disk"}]}});
    for _ in 0..20_000 {
        push(&mut file.json["nodes"], json!({"extensions": {"EXT_lights_area": {"light": 0}}}));
    }
    file.json.as_object_mut().unwrap().remove("scenes");
    assert_eq!(file.scene().lights.last().unwrap().name, "a#20000");
}

#[test]
fn a_buffer_that_is_no_file_is_not_opened() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file.gltf");
    std::fs::create_dir(folder.path().join("a.bin")).unwrap();
    std::fs::write(&path, File::square().gltf_beside("a.bin")).unwrap();
    let line = gltf::load(&path, LoadOptions::default()).unwrap_err().to_string();
    assert!(line.contains("buffers[0].uri: `") && line.ends_with("a.bin` is not a regular file"), "{line}");
}

#[test]
fn a_buffer_file_that_is_too_short_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file.gltf");
    std::fs::write(folder.path().join("a.bin"), [0; 59]).unwrap();
    std::fs::write(&path, File::square().gltf_beside("a.bin")).unwrap();
    let line = gltf::load(&path, LoadOptions::default()).unwrap_err().to_string();
    assert!(line.contains("buffers[0].uri: expected 60 bytes in `") && line.ends_with("a.bin`, found 59"), "{line}");
}

#[test]
fn a_scene_that_is_no_file_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let line = gltf::load(folder.path(), LoadOptions::default()).unwrap_err().to_string();
    assert!(line.ends_with(": not a regular file"), "{line}");
    assert!(gltf::load(&folder.path().join("none.gltf"), LoadOptions::default()).is_err());
}

/// xorshift64*, so that the same files are made on every machine.
struct Random(u64);

impl Random {
    fn below(&mut self, end: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize % end
    }
}

#[test]
fn no_mutation_of_a_file_makes_the_loader_panic() {
    let mut seeds = vec![File::square().glb(), File::square().gltf(), everything().glb(), everything().gltf()];
    if let Some(folder) = shared_scenes() {
        for path in ["cubes-point-light/Cubes.glb", "cornell-box/CornellBox.glb", "alien-cake/tile.glb", "fox/Fox.glb"]
        {
            seeds.push(std::fs::read(folder.join(path)).unwrap());
        }
    }
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    let numbers = [
        "0",
        "1",
        "-1",
        "255",
        "65536",
        "4294967295",
        "4294967296",
        "1e39",
        "-1e300",
        "0.5",
        "null",
        "[]",
        "{}",
        "\"\"",
    ];
    for case in 0..2000 {
        let mut bytes = seeds[case % seeds.len()].clone();
        match random.below(4) {
            0 => bytes.truncate(random.below(bytes.len())),
            // Replace one run of digits.
            1 | 2 => {
                let start = random.below(bytes.len());
                if let Some(at) = bytes[start..].iter().position(u8::is_ascii_digit).map(|at| start + at) {
                    let digits = bytes[at..].iter().take_while(|byte| byte.is_ascii_digit()).count();
                    let number = numbers[random.below(numbers.len())];
                    bytes.splice(at..at + digits, number.bytes());
                    fix_lengths(&mut bytes);
                }
            }
            _ => {
                for _ in 0..1 + random.below(8) {
                    let at = random.below(bytes.len());
                    bytes[at] ^= 1 << random.below(8);
                }
            }
        }
        if let Err(line) = load(&bytes) {
            assert!(!line.contains('\n'), "case {case}: {line}");
        }
        let animated = gltf::load_animated_slice(&bytes, None, "test", LoadOptions::default());
        let posed = animated
            .and_then(|animated| (0..animated.clips.len()).try_for_each(|clip| animated.pose(clip, 0.3).map(drop)));
        if let Err(error) = posed {
            assert!(!error.to_string().contains('\n'), "case {case}: {error}");
        }
    }
}

/// Makes a GLB's lengths right again after its JSON has changed.
fn fix_lengths(bytes: &mut [u8]) {
    if !bytes.starts_with(b"glTF") {
        return;
    }
    let length = bytes.len() as u32;
    bytes[8..12].copy_from_slice(&length.to_le_bytes());
    if let Some(bin) = bytes.windows(4).position(|window| window == b"BIN\0") {
        let json = (bin as u32).wrapping_sub(24);
        bytes[12..16].copy_from_slice(&json.to_le_bytes());
    }
}

/// A file with most features.
fn everything() -> File {
    let mut file = File::square();
    let indices = file.view(&le(&[1u16], u16::to_le_bytes));
    let values = file.view(&le(&[5.0f32, 6.0, 7.0], f32::to_le_bytes));
    file.json["accessors"][0]["sparse"] = json!({"count": 1, "indices": {"bufferView": indices, "componentType": 5123}, "values": {"bufferView": values}});
    let normals = file.floats(&[[0.0, 0.0, 1.0]; 4]);
    let uvs = file.accessor(&[0, 0, 255, 0, 255, 255, 0, 255], 5121, 4, "VEC2");
    file.json["accessors"][uvs]["normalized"] = json!(true);
    let image = file.view(&png(2, 2));
    file.json["images"] = json!([{"bufferView": image}]);
    file.json["textures"] = json!([{"source": 0}]);
    file.json["materials"] = json!([
        {"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": {"KHR_texture_transform": {"rotation": 1}}}}},
        {"emissiveFactor": [1, 1, 1], "doubleSided": true, "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 5}}},
    ]);
    *file.primitive() = json!({"attributes": {"POSITION": 0, "NORMAL": normals, "TEXCOORD_0": uvs}, "indices": 1, "material": 0, "mode": 4});
    let flat = file.floats(&[[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]);
    push(
        &mut file.json["meshes"],
        json!({"primitives": [{"attributes": {"POSITION": flat}, "indices": 1, "material": 1}]}),
    );
    let translations = file.floats(&[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]);
    let rotations = file.accessor(&[0, 0, 0, 127, 0, 127, 0, 0], 5120, 2, "VEC4");
    let instancing =
        json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": translations, "ROTATION": rotations}}});
    file.add_node(json!({"mesh": 1, "extensions": instancing}));
    area_light(&mut file, json!({"type": "rect", "rect": {"aspect": 2}}));
    file.json["extensions"]["KHR_lights_punctual"] =
        json!({"lights": [{"type": "spot", "spot": {"outerConeAngle": 0.5}}]});
    file.add_node(json!({"extensions": {"KHR_lights_punctual": {"light": 0}}, "extras": {"radius": 0.5}}));
    file.add_node(json!({"extensions": {"PENUMBRA_lights": {"version": 1, "shape": "sun", "irradiance": [1, 1, 1]}}}));
    file.json["cameras"] = json!([{"type": "perspective", "perspective": {"yfov": 1, "znear": 1, "zfar": 9}}]);
    let camera = file.add_node(json!({"camera": 0, "rotation": [0.5, 0.5, 0.5, 0.5]}));
    let joints = file.accessor(&[0, 1, 0, 0].repeat(4), 5121, 4, "VEC4");
    let weights = file.floats(&[[0.5, 0.25, 0.0, 0.0]; 4]);
    let displacements = file.floats(&[[0.5, 0.0, 0.25]; 4]);
    push(
        &mut file.json["meshes"],
        json!({"weights": [0.5], "primitives": [{"attributes": {"POSITION": flat, "NORMAL": normals, "JOINTS_0": joints, "WEIGHTS_0": weights},
            "indices": 1, "targets": [{"POSITION": displacements, "NORMAL": displacements}]}]}),
    );
    let matrix = |x: f32| [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, x, 0.0, 0.0, 1.0];
    let matrices = file.accessor(&le(&[matrix(1.0), matrix(2.0)].concat(), f32::to_le_bytes), 5126, 2, "MAT4");
    file.json["skins"] = json!([{"joints": [0, camera], "inverseBindMatrices": matrices}]);
    let skinned = file.add_node(json!({"mesh": 2, "skin": 0}));
    let times = file.floats(&[[0.0], [0.5]]);
    let turns = file.floats(&[[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]]);
    let moves = file.floats(&[[0.0; 3], [0.0; 3], [1.0; 3], [1.0; 3], [0.5; 3], [0.0; 3]]);
    let shapes = file.accessor(&[0, 255], 5121, 2, "SCALAR");
    file.json["accessors"][shapes]["normalized"] = json!(true);
    file.json["animations"] = json!([{
        "channels": [
            {"sampler": 0, "target": {"node": camera, "path": "rotation"}},
            {"sampler": 1, "target": {"node": 0, "path": "translation"}},
            {"sampler": 2, "target": {"node": skinned, "path": "weights"}},
        ],
        "samplers": [
            {"input": times, "output": turns},
            {"input": times, "output": moves, "interpolation": "CUBICSPLINE"},
            {"input": times, "output": shapes, "interpolation": "STEP"},
        ],
    }]);
    file
}

#[test]
fn the_mutated_file_itself_is_sound() {
    let scene = everything().scene();
    assert_eq!((scene.instances.len(), scene.lights.len(), scene.cameras.len()), (4, 5, 1), "{:?}", scene.warnings);
    let animated = gltf::load_animated_slice(&everything().glb(), None, "test", LoadOptions::default()).unwrap();
    assert_eq!(animated.pose(0, 0.3).unwrap().instances.len(), 4);
}
