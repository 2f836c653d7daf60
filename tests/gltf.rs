//! What valid glTF files become.

#![expect(clippy::needless_pass_by_value, reason = "`json!` literals are handed over as they are")]

mod gltf_files;

use std::collections::BTreeMap;
use std::f64::consts::PI;
use std::sync::Arc;

use glam::{DAffine3, DMat3, DVec2, DVec3, Vec2, Vec3};
use gltf_files::{File, le, load, push, shared_scenes};
use penumbra::scene::{AreaLight, Cone, Emission, LoadOptions, Projection, Scene, Shape, Texture, Wrap, gltf};
use serde_json::{Value, json};

/// World positions of an instance's vertices.
fn world_positions(scene: &Scene, instance: usize) -> Vec<DVec3> {
    let instance = &scene.instances[instance];
    let positions = scene.meshes[instance.mesh].positions.iter();
    positions.map(|p| scene.origin_world + instance.scene_from_mesh.transform_point3(p.as_dvec3())).collect()
}

/// Sum of the area vectors of a mesh's triangles.
fn area(scene: &Scene, mesh: usize) -> DVec3 {
    let mesh = &scene.meshes[mesh];
    (0..mesh.triangles.len()).map(|t| mesh.corners(t)).map(|[a, b, c]| 0.5 * (b - a).cross(c - a)).sum()
}

fn light(file: &File) -> AreaLight {
    let scene = file.scene();
    assert_eq!(scene.lights.len(), 1, "{:?}", scene.lights);
    scene.lights[0].clone()
}

fn radiance(light: &AreaLight) -> DVec3 {
    match light.emission {
        Emission::Radiance(radiance) => radiance,
        other => panic!("expected a radiance, found {other:?}"),
    }
}

/// Equal but for rounding in f64 of values around 1 to 10.
fn close(a: DVec3, b: DVec3) -> bool {
    (a - b).abs().max_element() < 1e-14
}

#[test]
fn scene_space_starts_at_the_lowest_corner() {
    let mut file = File::square();
    file.json["nodes"][0]["translation"] = json!([10, 20, 30]);
    let scene = file.scene();
    assert_eq!(scene.origin_world, DVec3::new(9.0, 19.0, 30.0));
    assert_eq!(scene.bounds().min, DVec3::ZERO);
    assert_eq!(world_positions(&scene, 0)[2], DVec3::new(11.0, 21.0, 30.0));
}

#[test]
fn nodes_inherit_their_parents_transforms() {
    let mut file = File::square();
    file.json["nodes"] = json!([
        {"mesh": 0, "translation": [1, 0, 0]},
        {"children": [0], "rotation": [0, 0, 0.5f64.sqrt() as f32, 0.5f64.sqrt() as f32], "scale": [2, 3, 4]},
        {"children": [1], "translation": [0, 0, 5]},
    ]);
    file.json["scenes"][0]["nodes"] = json!([2]);
    let scene = file.scene();
    // (1 + 1, 1) scaled by (2, 3), turned by 90° about Z, lifted by 5.
    assert!(close(world_positions(&scene, 0)[2], DVec3::new(-3.0, 4.0, 5.0)));
    assert_eq!(scene.nodes[0].parent, Some(1));
    assert_eq!(scene.nodes[0].name, "node 0");
}

#[test]
fn a_matrix_means_the_same_as_its_parts() {
    let mut parts = File::square();
    parts.json["nodes"][0] =
        json!({"mesh": 0, "translation": [1, 2, 3], "rotation": [0, 1, 0, 0], "scale": [2, -1, 0.5]});
    let mut matrix = File::square();
    matrix.json["nodes"][0] = json!({"mesh": 0, "matrix": [-2, 0, 0, 0, 0, -1, 0, 0, 0, 0, -0.5, 0, 1, 2, 3, 1]});
    let (parts, matrix) = (parts.scene(), matrix.scene());
    assert_eq!(world_positions(&parts, 0), world_positions(&matrix, 0));
    assert!(parts.instances[0].scene_from_mesh.matrix3.determinant() < 0.0);
}

#[test]
fn all_triangle_modes_and_index_types_make_the_same_square() {
    let list = [0u8, 1, 2, 0, 2, 3];
    let expected = DVec3::new(0.0, 0.0, 4.0);
    for (mode, corners) in [(4, &list[..]), (5, &[0, 1, 3, 2]), (6, &[0, 1, 2, 3])] {
        for component in [5121, 5123, 5125] {
            let mut file = File::square();
            let bytes = match component {
                5121 => corners.to_vec(),
                5123 => le(corners, |corner| u16::from(corner).to_le_bytes()),
                _ => le(corners, |corner| u32::from(corner).to_le_bytes()),
            };
            let indices = file.accessor(&bytes, component, corners.len(), "SCALAR");
            file.primitive()["indices"] = json!(indices);
            file.primitive()["mode"] = json!(mode);
            let scene = file.scene();
            assert_eq!(area(&scene, 0), expected, "mode {mode}, component type {component}");
        }
        let positions = [[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]];
        let mut file = File::square();
        let unrolled: Vec<[f32; 3]> = corners.iter().map(|&corner| positions[usize::from(corner)]).collect();
        let positions = file.floats(&unrolled);
        *file.primitive() = json!({"attributes": {"POSITION": positions}, "mode": mode});
        assert_eq!(area(&file.scene(), 0), expected, "mode {mode} without indices");
    }
}

#[test]
fn triangles_that_join_the_parts_of_a_strip_are_left_out() {
    let mut file = File::square();
    let indices = file.accessor(&[0, 1, 3, 2, 2, 0, 0, 1, 3, 2], 5121, 10, "SCALAR");
    file.primitive()["indices"] = json!(indices);
    file.primitive()["mode"] = json!(5);
    assert_eq!(file.scene().meshes[0].triangles, [[0, 1, 3], [1, 2, 3], [0, 1, 3], [1, 2, 3]]);
}

#[test]
fn degenerate_triangles_of_a_list_are_kept() {
    let mut file = File::square();
    let indices = file.accessor(&[0, 0, 0, 1, 2, 2], 5121, 6, "SCALAR");
    file.primitive()["indices"] = json!(indices);
    assert_eq!(file.scene().meshes[0].triangles, [[0, 0, 0], [1, 2, 2]]);
}

#[test]
fn points_and_lines_are_skipped_with_a_warning() {
    for mode in 0..4 {
        let mut file = File::square();
        file.primitive()["mode"] = json!(mode);
        let scene = file.scene();
        assert_eq!(scene.triangle_count(), 0);
        assert_eq!(
            scene.warnings,
            ["`square`: points and lines are skipped", "the scene has no triangles: nothing will be seen"]
        );
    }
}

#[test]
fn corners_beyond_the_last_whole_triangle_are_ignored_with_a_warning() {
    let mut file = File::square();
    let indices = file.accessor(&[0, 1, 2, 3, 0], 5121, 5, "SCALAR");
    file.primitive()["indices"] = json!(indices);
    let scene = file.scene();
    assert_eq!(scene.meshes[0].triangles, [[0, 1, 2]]);
    assert_eq!(scene.warnings, ["`square`: corners beyond the last whole triangle are ignored"]);
}

#[test]
fn sparse_accessors_replace_elements() {
    let mut file = File::square();
    let indices = file.view(&le(&[1u16, 3], u16::to_le_bytes));
    let values = file.view(&le(&[5.0f32, 6.0, 7.0, 8.0, 9.0, 10.0], f32::to_le_bytes));
    file.json["accessors"][0]["sparse"] = json!({
        "count": 2, "indices": {"bufferView": indices, "componentType": 5123}, "values": {"bufferView": values},
    });
    let scene = file.scene();
    let expected = [[-1.0, -1.0, 0.0], [5.0, 6.0, 7.0], [1.0, 1.0, 0.0], [8.0, 9.0, 10.0]];
    assert_eq!(scene.meshes[0].positions.as_ref(), expected.map(Vec3::from_array));
}

#[test]
fn sparse_accessors_without_a_view_start_from_zero() {
    let mut file = File::square();
    let indices = file.view(&[2]);
    let values = file.view(&le(&[5.0f32, 6.0, 7.0], f32::to_le_bytes));
    file.json["accessors"][0] = json!({"componentType": 5126, "count": 4, "type": "VEC3", "sparse": {
        "count": 1, "indices": {"bufferView": indices, "componentType": 5121}, "values": {"bufferView": values},
    }});
    assert_eq!(file.scene().meshes[0].positions[2], Vec3::new(5.0, 6.0, 7.0));
    assert_eq!(file.scene().meshes[0].positions[3], Vec3::ZERO);
}

#[test]
fn interleaved_attributes_are_told_apart() {
    let mut file = File::square();
    let square = [[-1.0f32, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]];
    let interleaved: Vec<f32> = square.iter().flat_map(|p| [p[0], p[1], p[2], 0.0, 0.0, 2.0]).collect();
    let view = file.view(&le(&interleaved, f32::to_le_bytes));
    file.json["bufferViews"][view]["byteStride"] = json!(24);
    file.json["accessors"][0]["bufferView"] = json!(view);
    let normals = json!({"bufferView": view, "byteOffset": 12, "componentType": 5126, "count": 4, "type": "VEC3"});
    let normals = push(&mut file.json["accessors"], normals);
    file.primitive()["attributes"]["NORMAL"] = json!(normals);
    let scene = file.scene();
    assert_eq!(scene.meshes[0].positions.as_ref(), square.map(Vec3::from_array));
    // Normals come out with unit length.
    assert_eq!(scene.meshes[0].normals.as_deref(), Some(&[Vec3::Z; 4][..]));
}

#[test]
fn quantized_positions_are_read_even_when_required() {
    // Component type, whether normalised, bytes of one vector (with padding), and what it means.
    let shorts = |values: [i16; 4]| le(&values, i16::to_le_bytes);
    let cases: [(u32, bool, Vec<u8>, [f32; 3]); 6] = [
        (5120, false, vec![127, 0x80, 3, 0], [127.0, -128.0, 3.0]),
        (5120, true, vec![127, 0x80, 0, 0], [1.0, -1.0, 0.0]),
        (5121, true, vec![255, 0, 51, 0], [1.0, 0.0, 0.2]),
        (5122, false, shorts([300, -300, 1, 0]), [300.0, -300.0, 1.0]),
        (5122, true, shorts([32767, -32768, 0, 0]), [1.0, -1.0, 0.0]),
        (5123, true, shorts([-1, 0, 13107, 0]), [1.0, 0.0, 0.2]),
    ];
    for (component, normalized, bytes, expected) in cases {
        let mut file = File::square();
        file.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
        let positions = file.accessor(&bytes.repeat(4), component, 4, "VEC3");
        file.json["accessors"][positions]["normalized"] = json!(normalized);
        let view = file.json["accessors"][positions]["bufferView"].as_u64().unwrap() as usize;
        file.json["bufferViews"][view]["byteStride"] = json!(bytes.len());
        file.primitive()["attributes"]["POSITION"] = json!(positions);
        assert_eq!(file.scene().meshes[0].positions[0], Vec3::from_array(expected), "{component} {normalized}");
    }
}

#[test]
fn gpu_instances_are_placed_without_copying_the_mesh() {
    let mut file = File::square();
    let translations = file.floats(&[[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 0.0, 3.0]]);
    // No turn, half a turn about Z, and the same in bytes that are not quite of unit length.
    let rotations = file.accessor(&[0, 0, 0, 127, 0, 0, 127, 0, 0, 0, 100, 0], 5120, 3, "VEC4");
    file.json["accessors"][rotations]["normalized"] = json!(true);
    let scales = file.floats(&[[1.0, 1.0, 1.0], [2.0, 3.0, 4.0], [1.0, -1.0, 1.0]]);
    file.json["extensionsUsed"] = json!(["EXT_mesh_gpu_instancing"]);
    file.json["nodes"][0]["translation"] = json!([10, 0, 0]);
    file.json["nodes"][0]["extensions"] = json!({"EXT_mesh_gpu_instancing": {
        "attributes": {"TRANSLATION": translations, "ROTATION": rotations, "SCALE": scales}
    }});
    let scene = file.scene();
    assert_eq!((scene.meshes.len(), scene.instances.len(), scene.triangle_count()), (1, 3, 6));
    let corners: Vec<DVec3> = (0..3).map(|instance| world_positions(&scene, instance)[2]).collect();
    let expected = [[11.0, 1.0, 1.0], [8.0, -3.0, 2.0], [9.0, 1.0, 3.0]].map(DVec3::from);
    assert!(corners.iter().zip(expected).all(|(&found, expected)| close(found, expected)), "{corners:?}");
}

#[test]
fn buffers_in_the_glb_in_the_uri_and_in_files_make_the_same_scene() {
    let folder = tempfile::tempdir().unwrap();
    let nested = folder.path().join("scenes");
    std::fs::create_dir(&nested).unwrap();
    let file = File::square();
    let expected = world_positions(&file.scene(), 0);
    assert_eq!(world_positions(&load(&file.glb()).unwrap(), 0), expected);
    std::fs::write(nested.join("a b ü.bin"), &file.bin).unwrap();
    std::fs::write(folder.path().join("above.bin"), &file.bin).unwrap();
    for uri in ["a%20b%20%C3%BC.bin", "a b ü.bin", "./a%20b%20%c3%bc.bin", "../above.bin"] {
        let path = nested.join("file.gltf");
        std::fs::write(&path, file.gltf_beside(uri)).unwrap();
        let scene = gltf::load(&path, LoadOptions::default()).unwrap();
        assert_eq!(world_positions(&scene, 0), expected, "{uri}");
    }
}

#[test]
fn a_primitive_used_twice_is_stored_once() {
    let mut file = File::square();
    file.add_node(json!({"mesh": 0, "translation": [0, 0, 1]}));
    push(&mut file.json["meshes"], json!({"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}));
    file.add_node(json!({"mesh": 1, "translation": [0, 0, 2]}));
    let scene = file.scene();
    assert_eq!((scene.meshes.len(), scene.instances.len()), (1, 3));
}

#[test]
fn primitives_of_the_same_vertices_share_them() {
    let mut file = File::square();
    let second = file.accessor(&[0, 1, 3], 5121, 3, "SCALAR");
    push(&mut file.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}, "indices": second}));
    let scene = file.scene();
    assert_eq!(scene.meshes.len(), 2);
    assert!(Arc::ptr_eq(&scene.meshes[0].positions, &scene.meshes[1].positions));
}

#[test]
fn the_chosen_scene_decides_what_is_loaded() {
    let mut file = File::square();
    push(&mut file.json["nodes"], json!({"name": "other", "mesh": 0, "translation": [5, 0, 0]}));
    file.json["scenes"] = json!([{"nodes": [0]}, {"nodes": [1]}]);
    assert_eq!(file.scene().instances[0].node, 0);
    file.json["scene"] = json!(1);
    let scene = file.scene();
    assert_eq!((scene.instances.len(), scene.instances[0].node), (1, 1));
    file.json.as_object_mut().unwrap().retain(|key, _| !key.starts_with("scene"));
    assert_eq!(file.scene().instances.len(), 2);
}

#[test]
fn missing_normals_are_flat_and_normals_of_no_direction_make_the_mesh_flat() {
    assert!(File::square().scene().meshes[0].normals.is_none());
    for bad in [[0.0; 3], [f32::INFINITY, 0.0, 0.0], [f32::NAN; 3]] {
        let mut file = File::square();
        let normals = file.floats(&[[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], bad, [0.0, 0.0, 1.0]]);
        file.primitive()["attributes"]["NORMAL"] = json!(normals);
        let scene = file.scene();
        assert!(scene.meshes[0].normals.is_none());
        assert_eq!(scene.warnings, ["`square`: shaded flat, for it has normals of no direction"]);
    }
}

#[test]
fn an_animation_that_is_not_asked_for_is_named_once() {
    let mut file = File::square();
    file.json["animations"] = json!([{"channels": [], "samplers": []}, {"channels": [], "samplers": []}]);
    assert_eq!(file.scene().warnings, ["rendered at the pose of the file's nodes: --frames renders its animation"]);
    file.json["animations"] = json!([]);
    assert!(file.scene().warnings.is_empty());
}

#[test]
fn animations_that_are_not_asked_for_are_not_read() {
    let mut file = File::square();
    let pointer = json!({"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": "/nodes/0/scale"}}});
    file.json["extensionsUsed"] = json!(["KHR_animation_pointer"]);
    file.json["animations"] =
        json!([{"channels": [{"sampler": 0, "target": pointer}], "samplers": [{"input": 9, "output": 9}]}]);
    assert_eq!(file.scene().warnings.len(), 1);
}

#[test]
fn blended_materials_are_opaque_with_one_warning() {
    let mut file = File::square();
    file.json["materials"] =
        json!([{"name": "glass", "alphaMode": "BLEND"}, {"alphaMode": "BLEND"}, {"alphaMode": "BLEND"}]);
    file.primitive()["material"] = json!(0);
    push(
        &mut file.json["meshes"][0]["primitives"],
        json!({"attributes": {"POSITION": 0}, "indices": 1, "material": 1}),
    );
    let scene = file.scene();
    assert!(scene.materials.iter().all(|material| material.cutout.is_none()));
    assert_eq!(scene.warnings, ["`glass`, `material 1`: alphaMode BLEND is taken as opaque"]);
}

#[test]
fn base_colors_come_with_their_meshes() {
    let mut file = File::square();
    file.json["materials"] = json!([{"pbrMetallicRoughness": {"baseColorFactor": [0.25, 0.5, 1, 0.5]}}]);
    file.primitive()["material"] = json!(0);
    let scene = file.scene();
    assert_eq!(scene.materials[scene.meshes[0].material.unwrap()].base_color, Vec3::new(0.25, 0.5, 1.0));
}

#[test]
fn metalness_and_roughness_are_factors_alone() {
    let mut file = File::square();
    let texture = json!({"index": 0});
    let shiny = json!({"metallicFactor": 0.25, "roughnessFactor": 0.5, "metallicRoughnessTexture": texture});
    file.json["materials"] = json!([{"name": "shiny", "pbrMetallicRoughness": shiny}, {}]);
    file.primitive()["material"] = json!(0);
    push(
        &mut file.json["meshes"][0]["primitives"],
        json!({"attributes": {"POSITION": 0}, "indices": 1, "material": 1}),
    );
    let load = |highlights| {
        let options = LoadOptions { highlights, ..LoadOptions::default() };
        gltf::load_slice(&file.gltf(), None, "test", options).unwrap()
    };
    let scene = load(true);
    let factors: Vec<_> = scene.materials.iter().map(|material| (material.metallic, material.roughness)).collect();
    // Without factors: glTF's own.
    assert_eq!(factors, [(0.25, 0.5), (1.0, 1.0)]);
    assert_eq!(scene.warnings, ["`shiny`: textures of metalness and roughness are left out"]);
    assert!(load(false).warnings.is_empty());
}

/// The square with a 2 × 1 texture: red and opaque, then green and transparent.
fn textured(material: Value) -> File {
    let mut png = std::io::Cursor::new(Vec::new());
    let image = image::RgbaImage::from_raw(2, 1, vec![255, 0, 0, 255, 0, 255, 0, 0]).unwrap();
    image.write_to(&mut png, image::ImageFormat::Png).unwrap();
    let mut file = File::square();
    let view = file.view(png.get_ref());
    let uvs = file.floats(&[[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]);
    file.json["images"] = json!([{"bufferView": view, "mimeType": "image/png"}]);
    file.json["samplers"] = json!([{"magFilter": 9728, "wrapS": 33071, "wrapT": 33648}]);
    file.json["textures"] = json!([{"source": 0, "sampler": 0}]);
    file.json["materials"] = json!([material]);
    file.primitive()["material"] = json!(0);
    file.primitive()["attributes"]["TEXCOORD_0"] = json!(uvs);
    file
}

#[test]
fn base_color_textures_are_loaded_when_asked_for() {
    let file = textured(json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}));
    let scene = file.scene();
    let texture = scene.materials[0].base_color_texture.as_ref().unwrap();
    assert_eq!((texture.size, &texture.texels[..]), ([2, 1], &[[255, 0, 0], [0, 255, 0]][..]));
    assert_eq!((texture.srgb, texture.nearest), (true, true));
    assert_eq!(texture.wrap, [Wrap::ClampToEdge, Wrap::MirroredRepeat]);
    assert_eq!(scene.meshes[0].uvs.as_ref().unwrap()[2], Vec2::new(1.0, 0.0));

    let without = gltf::load_slice(&file.gltf(), None, "test", LoadOptions::default()).unwrap();
    assert!(without.materials[0].base_color_texture.is_none());
    assert!(without.meshes[0].uvs.is_none());
}

#[test]
fn cut_outs_are_loaded_always() {
    let file = textured(json!({
        "alphaMode": "MASK", "alphaCutoff": 0.25,
        "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5], "baseColorTexture": {"index": 0}},
    }));
    let scene = gltf::load_slice(&file.gltf(), None, "test", LoadOptions::default()).unwrap();
    let cutout = scene.materials[0].cutout.as_ref().unwrap();
    assert_eq!((cutout.cutoff, cutout.factor), (0.25, 0.5));
    assert!(cutout.is_solid(DVec2::new(0.1, 0.5)) && !cutout.is_solid(DVec2::new(0.9, 0.5)));
    assert!(scene.meshes[0].uvs.is_some());
}

#[test]
fn a_cut_out_without_a_texture_is_all_or_nothing() {
    let mut file = File::square();
    file.json["materials"] = json!([{"alphaMode": "MASK"}, {"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.4]}}]);
    file.primitive()["material"] = json!(1);
    let scene = file.scene();
    assert!(scene.materials[0].cutout.is_none());
    assert!(!scene.materials[1].cutout.as_ref().unwrap().is_solid(DVec2::ZERO));
}

#[test]
fn texture_transforms_are_applied_to_the_coordinates_they_choose() {
    let mut file = textured(json!({"pbrMetallicRoughness": {"baseColorTexture": {
        "index": 0, "texCoord": 1,
        "extensions": {"KHR_texture_transform": {"offset": [0.5, 0.25], "rotation": PI / 2.0, "scale": [2, 4], "texCoord": 2}},
    }}}));
    let uvs = file.floats(&[[1.0, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]]);
    file.primitive()["attributes"]["TEXCOORD_2"] = json!(uvs);
    let scene = file.scene();
    let uvs = scene.meshes[0].uvs.as_ref().unwrap();
    // A quarter turn counter-clockwise on an image whose v points down takes +u to −v and +v to +u.
    for (found, expected) in uvs.iter().zip([[0.5, -1.75], [4.5, 0.25], [0.5, 0.25]].map(Vec2::from_array)) {
        // The sine and cosine are off by an f32 rounding of π/2.
        assert!((found - expected).abs().max_element() < 1e-6, "{found} {expected}");
    }
}

#[test]
fn a_texture_without_coordinates_takes_its_corner_with_a_warning() {
    let mut file = textured(json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 3}}}));
    file.json["samplers"] = json!([{}]);
    let scene = file.scene();
    assert_eq!(scene.meshes[0].uvs.as_deref(), Some(&[Vec2::ZERO; 4][..]));
    assert_eq!(scene.warnings, ["`square`: textured without texture coordinates (0, 0 is taken)"]);
}

#[test]
fn cameras_are_rigid_and_keep_their_distances() {
    let mut file = File::square();
    file.json["cameras"] = json!([
        {"name": "main", "type": "perspective", "perspective": {"yfov": 0.5, "znear": 0.25}},
        {"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 3, "znear": 0, "zfar": 8}},
    ]);
    file.add_node(json!({"camera": 0, "translation": [1, 1, 5], "scale": [-2, 3, 4]}));
    file.add_node(json!({"camera": 0}));
    file.add_node(json!({"name": "top", "camera": 1}));
    let scene = file.scene();
    let names: Vec<&str> = scene.cameras.iter().map(|camera| camera.name.as_str()).collect();
    assert_eq!(names, ["main", "main#2", "top"]);
    let main = &scene.cameras[0];
    assert_eq!(main.scene_from_camera, DAffine3::from_translation(DVec3::new(2.0, 2.0, 5.0)));
    assert_eq!((main.projection, main.near, main.far), (Projection::Perspective { fov_y: 0.5 }, 0.25, f64::INFINITY));
    let top = &scene.cameras[2];
    assert_eq!((top.projection, top.near, top.far), (Projection::Orthographic { half_height: 3.0 }, 0.0, 8.0));
}

/// A file with one `EXT_lights_area` light in `nodes[1]`.
fn with_area_light(light: Value) -> File {
    let mut file = File::square();
    file.json["extensions"] = json!({"EXT_lights_area": {"lights": [light]}});
    file.add_node(json!({"name": "lamp", "extensions": {"EXT_lights_area": {"light": 0}}}));
    file
}

#[test]
fn area_lights_have_the_size_of_their_node_and_radiance_in_watts() {
    let mut file = with_area_light(json!({
        "type": "rect", "color": [1, 0.5, 0], "intensity": 1366, "size": 2, "rect": {"aspect": 3}
    }));
    file.json["nodes"][1]["scale"] = json!([1, -5, 2]);
    let light = light(&file);
    assert_eq!(light.name, "lamp");
    assert_eq!(light.shape, Shape::Rect { size: DVec2::new(30.0, 10.0) });
    assert_eq!(radiance(&light), DVec3::new(2.0, 1.0, 0.0));
    // −Z stays, and the mirroring goes into X.
    assert_eq!(light.axis(), DVec3::NEG_Z);
    assert!((light.scene_from_light.matrix3.determinant() - 1.0).abs() < 1e-15);
}

#[test]
fn area_light_defaults_are_the_drafts() {
    let light = light(&with_area_light(json!({"name": "Key", "type": "disk"})));
    assert_eq!((light.name.as_str(), light.shape), ("Key", Shape::Disk { size: DVec2::ONE }));
    assert_eq!(radiance(&light), DVec3::splat(1000.0 / 683.0));
}

#[test]
fn our_block_wins_over_the_lights_beside_it() {
    let mut file = with_area_light(json!({"name": "Key", "type": "rect"}));
    file.json["extensions"]["KHR_lights_punctual"] = json!({"lights": [{"type": "point"}]});
    file.json["nodes"][1]["extensions"]["KHR_lights_punctual"] = json!({"light": 0});
    file.json["nodes"][1]["extensions"]["PENUMBRA_lights"] =
        json!({"version": 1, "shape": "disk", "width": 3, "height": 1, "radiance": [1, 2, 3]});
    let light = light(&file);
    assert_eq!((light.name.as_str(), light.shape), ("Key", Shape::Disk { size: DVec2::new(3.0, 1.0) }));
    assert_eq!(light.emission, Emission::Radiance(DVec3::new(1.0, 2.0, 3.0)));
}

#[test]
fn our_block_describes_every_shape() {
    let radiance = Emission::Radiance(DVec3::ONE);
    let cases = [
        (
            json!({"shape": "rect", "width": 2, "height": 3, "radiance": [1, 1, 1]}),
            Shape::Rect { size: DVec2::new(2.0, 3.0) },
            radiance,
        ),
        (
            json!({"shape": "disk", "width": 2, "radiance": [1, 1, 1]}),
            Shape::Disk { size: DVec2::splat(2.0) },
            radiance,
        ),
        (
            json!({"shape": "sphere", "radius": 2, "radiance": [1, 1, 1], "facing": true}),
            Shape::Sphere { radius: 2.0, facing: true },
            radiance,
        ),
        (
            json!({"shape": "tube", "length": 4, "radius": 0.5, "radiance": [1, 1, 1]}),
            Shape::Tube { length: 4.0, radius: 0.5 },
            radiance,
        ),
        (
            json!({"shape": "sun", "angle": 0.01, "irradiance": [1, 1, 1]}),
            Shape::Sun { angle: 0.01 },
            Emission::Irradiance(DVec3::ONE),
        ),
        (json!({"shape": "point", "intensity": [1, 1, 1]}), Shape::Point, Emission::Intensity(DVec3::ONE)),
        (
            json!({"shape": "spot", "intensity": [1, 1, 1], "outer_cone": 0.5}),
            Shape::Point,
            Emission::Intensity(DVec3::ONE),
        ),
        (
            json!({"shape": "spot", "radius": 2, "intensity": [1, 1, 1], "outer_cone": 0.5, "inner_cone": 0.25}),
            Shape::Sphere { radius: 2.0, facing: false },
            Emission::Radiance(DVec3::splat(1.0 / (4.0 * PI))),
        ),
    ];
    for (mut block, shape, emission) in cases {
        block["version"] = json!(1);
        let mut file = File::with_light(block.clone());
        // Only rotation and translation of the node count.
        file.json["nodes"][1]["scale"] = json!([7, 7, 7]);
        let light = light(&file);
        assert_eq!((light.shape, light.emission), (shape, emission), "{block}");
        assert_eq!(light.scene_from_light.matrix3, DMat3::IDENTITY);
        assert_eq!(light.cone.is_some(), block["shape"] == "spot");
        assert_eq!((light.spread, light.casts_shadow, light.own_instance), (PI, true, None));
    }
}

#[test]
fn our_block_says_what_a_light_leaves_out() {
    let mut file = File::with_light(json!({
        "version": 1, "shape": "rect", "width": 1, "height": 1, "radiance": [1, 1, 1], "spread": 1,
        "casts_shadow": false, "light_exclude": ["square"], "shadow_exclude": ["square", "gone"]
    }));
    file.json["nodes"][0]["name"] = json!("square");
    let scene = file.scene();
    let light = &scene.lights[0];
    assert_eq!((light.spread, light.casts_shadow), (1.0, false));
    assert_eq!(
        (&light.light_exclude[..], &light.shadow_exclude[..]),
        (&["square".into()][..], &["square".into(), "gone".into()][..])
    );
    assert_eq!(scene.warnings, ["`gone`: a light's exclusion list names what no node is called"]);
}

/// A file with one `KHR_lights_punctual` light in `nodes[1]`.
fn with_punctual(light: Value) -> File {
    let mut file = File::square();
    file.json["extensionsRequired"] = json!(["KHR_lights_punctual"]);
    file.json["extensions"] = json!({"KHR_lights_punctual": {"lights": [light]}});
    file.add_node(json!({"extensions": {"KHR_lights_punctual": {"light": 0}}, "scale": [3, 3, 3]}));
    file
}

#[test]
fn punctual_lights_are_points_spots_and_suns() {
    let point = light(&with_punctual(json!({"type": "point", "intensity": 683, "color": [1, 0.5, 0.25]})));
    assert_eq!((point.shape, point.emission), (Shape::Point, Emission::Intensity(DVec3::new(1.0, 0.5, 0.25))));
    assert_eq!(point.name, "node 1");
    let spot = light(&with_punctual(json!({"type": "spot", "intensity": 683, "spot": {"innerConeAngle": 0.25}})));
    let outer = f64::from(std::f32::consts::FRAC_PI_4);
    assert_eq!((spot.shape, spot.cone), (Shape::Point, Some(Cone { inner: 0.25, outer })));
    let sun = light(&with_punctual(json!({"type": "directional", "intensity": 1366})));
    assert_eq!((sun.shape, sun.emission), (Shape::Sun { angle: 0.0 }, Emission::Irradiance(DVec3::splat(2.0))));
    assert_eq!(sun.axis(), DVec3::NEG_Z);
}

#[test]
fn extras_of_the_light_or_of_its_node_give_punctual_lights_a_size() {
    let on_light = with_punctual(json!({"type": "point", "intensity": 683, "extras": {"radius": 0.5}}));
    let mut on_node = with_punctual(json!({"type": "point", "intensity": 683, "extras": "anything"}));
    on_node.json["nodes"][1]["extras"] = json!({"radius": 0.5, "more": [1]});
    for file in [on_light, on_node] {
        let light = light(&file);
        assert_eq!(light.shape, Shape::Sphere { radius: 0.5, facing: false });
        assert_eq!(radiance(&light), DVec3::splat(1.0 / (PI * 0.25)));
    }
    let sun = light(&with_punctual(json!({"type": "directional", "extras": {"angle": 0.25}})));
    assert_eq!(sun.shape, Shape::Sun { angle: 0.25 });
}

/// The square, made to emit.
fn emissive() -> File {
    let mut file = File::square();
    file.json["materials"] = json!([{
        "emissiveFactor": [1, 0.5, 0],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 1366}},
    }]);
    file.primitive()["material"] = json!(0);
    file
}

#[test]
fn an_emissive_rectangle_is_a_light_that_its_own_surface_does_not_block() {
    let mut file = emissive();
    file.json["nodes"][0]["scale"] = json!([1, 3, 1]);
    file.json["nodes"][0]["translation"] = json!([5, 5, 5]);
    let scene = file.scene();
    let light = &scene.lights[0];
    assert_eq!((light.name.as_str(), light.own_instance), ("square", Some(0)));
    let Shape::Rect { size } = light.shape else { panic!("{:?}", light.shape) };
    let linear = light.scene_from_light.matrix3;
    assert_eq!((size.x * linear.x_axis).abs() + (size.y * linear.y_axis).abs(), DVec3::new(2.0, 6.0, 0.0));
    assert_eq!(radiance(light), DVec3::new(2.0, 1.0, 0.0));
    // The square faces +Z, and so does its light.
    assert_eq!(light.axis(), DVec3::Z);
    assert_eq!(scene.origin_world + light.scene_from_light.translation, DVec3::splat(5.0));
    assert!(scene.warnings.is_empty());
}

#[test]
fn mirroring_an_emissive_rectangle_keeps_its_front() {
    let mut file = emissive();
    file.json["nodes"][0]["scale"] = json!([-1, 1, 1]);
    assert_eq!(light(&file).axis(), DVec3::Z);
    file.json["nodes"][0]["scale"] = json!([1, 1, -1]);
    assert_eq!(light(&file).axis(), DVec3::NEG_Z);
}

#[test]
fn an_emissive_rectangle_is_found_however_its_triangles_are_cut() {
    for triangles in [[0u8, 1, 2, 0, 2, 3], [2, 0, 1, 3, 0, 2], [1, 2, 3, 3, 0, 1], [3, 1, 2, 0, 1, 3]] {
        let mut file = emissive();
        let indices = file.accessor(&triangles, 5121, 6, "SCALAR");
        file.primitive()["indices"] = json!(indices);
        file.json["nodes"][0]["rotation"] = json!([0.1, 0.7, 0.5, 0.5]);
        let light = light(&file);
        let Shape::Rect { size } = light.shape else { panic!("{:?}", light.shape) };
        assert!((size - 2.0).abs().max_element() < 1e-14, "{size}");
        let linear = light.scene_from_light.matrix3;
        assert!(
            (linear.determinant() - 1.0).abs() < 1e-14 && (linear.transpose() * linear - DMat3::IDENTITY).is_finite()
        );
    }
}

#[test]
fn a_two_sided_emissive_rectangle_lights_the_scenes_centre() {
    for side in [-3i32, 3] {
        let mut file = emissive();
        file.json["materials"][0]["doubleSided"] = json!(true);
        push(&mut file.json["meshes"], json!({"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}));
        file.add_node(json!({"mesh": 1, "translation": [0, 0, side]}));
        let scene = file.scene();
        assert_eq!(scene.lights[0].axis(), DVec3::Z * f64::from(side.signum()));
        assert_eq!(
            scene.warnings,
            ["`square`: emits from both sides, of which only the one towards the scene's centre is taken"]
        );
    }
}

#[test]
fn emissive_surfaces_that_are_no_lights_say_why() {
    let reason = |edit: &dyn Fn(&mut File)| {
        let mut file = emissive();
        edit(&mut file);
        let scene = file.scene();
        assert!(scene.lights.is_empty());
        scene.warnings.join("\n")
    };
    let not_flat = "`square`: emissive but no light, for it isn't a flat rectangle of two triangles";
    let positions = |corner: [f32; 3]| {
        move |file: &mut File| {
            let positions = file.floats(&[[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], corner, [-1.0, 1.0, 0.0]]);
            file.primitive()["attributes"]["POSITION"] = json!(positions);
        }
    };
    assert_eq!(reason(&positions([1.0, 1.0, 0.5])), not_flat);
    assert_eq!(reason(&positions([2.0, 1.0, 0.0])), not_flat);
    assert_eq!(reason(&positions([-1.0, -1.0, 0.0])), not_flat);
    assert_eq!(
        reason(&|file| file.json["nodes"][0]["matrix"] = json!([1, 0, 0, 0, 1, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1])),
        not_flat
    );
    let textured = reason(&|file| {
        file.json["textures"] = json!([{"source": 0}]);
        file.json["materials"][0]["emissiveTexture"] = json!({"index": 0});
    });
    assert_eq!(textured, "`square`: emissive but no light, for it has an emissive texture");
    let glowing = reason(&|file| {
        file.json["materials"][0].as_object_mut().unwrap().remove("extensions");
    });
    assert_eq!(glowing, "`square`: emissive but no light, for it has no KHR_materials_emissive_strength");
}

#[test]
fn an_emissive_mesh_at_a_lights_node_is_that_light() {
    let mut file = emissive();
    file.json["nodes"][0]["extensions"] =
        json!({"PENUMBRA_lights": {"version": 1, "shape": "disk", "width": 1, "radiance": [1, 1, 1]}});
    let light = light(&file);
    assert_eq!((light.own_instance, light.shape), (Some(0), Shape::Disk { size: DVec2::ONE }));
}

#[test]
fn lights_of_one_name_are_numbered() {
    let mut file = with_area_light(json!({"name": "Key", "type": "disk"}));
    for _ in 0..2 {
        file.add_node(json!({"extensions": {"EXT_lights_area": {"light": 0}}}));
    }
    let names: Vec<String> = file.scene().lights.into_iter().map(|light| light.name).collect();
    assert_eq!(names, ["Key", "Key#2", "Key#3"]);
}

#[test]
fn light_names_are_cut_to_what_an_image_can_hold() {
    let mut file = with_area_light(json!({"name": "日".repeat(150), "type": "disk"}));
    file.add_node(json!({"extensions": {"EXT_lights_area": {"light": 0}}}));
    let lights = file.scene().lights;
    // 77 · 3 = 231 of the 232 bytes that are left beside `#65536.irradiance_ratio`.
    assert_eq!(lights[0].name, "日".repeat(77));
    assert_eq!(lights[1].name, format!("{}#2", "日".repeat(77)));

    let mut file = emissive();
    file.json["nodes"][0]["name"] = json!("é".repeat(190));
    assert_eq!(light(&file).name, "é".repeat(116));
}

#[test]
fn version_one_may_be_written_as_a_float() {
    let block = json!({"version": 1.0, "shape": "disk", "width": 1, "radiance": [1, 1, 1]});
    assert_eq!(light(&File::with_light(block)).shape, Shape::Disk { size: DVec2::ONE });
}

#[test]
fn a_sun_whose_solid_angle_vanishes_is_directional() {
    // Half of 2⁻⁵¹⁰ squared is 2⁻¹⁰²², the lowest normal number; JSON's digits may be read a unit in the last place off.
    let lowest = 2f64.powi(-510);
    for (angle, directional) in [(1e-160, true), (0.999 * lowest, true), (1.001 * lowest, false), (0.01, false)] {
        let block = json!({"version": 1, "shape": "sun", "angle": angle, "irradiance": [1, 1, 1]});
        let ours = File::with_light(block);
        let file = with_punctual(json!({"type": "directional", "extras": {"angle": angle}}));
        for file in [ours, file] {
            let Shape::Sun { angle: found } = light(&file).shape else { panic!("not a sun") };
            assert_eq!(found == 0.0, directional, "{angle:e}: {found:e}");
        }
    }
}

#[test]
fn small_scales_that_multiply_are_no_singular_transform() {
    let mut file = emissive();
    let small = json!([1e-27, 1e-27, 1e-27]);
    file.json["nodes"][0]["scale"] = small.clone();
    push(&mut file.json["nodes"], json!({"children": [0], "scale": small}));
    push(&mut file.json["nodes"], json!({"children": [1], "scale": small}));
    file.json["scenes"][0]["nodes"] = json!([2]);
    let scene = file.scene();
    let side = 2.0 * f64::from(1e-27f32).powi(3);
    assert!((scene.bounds().size().x / side - 1.0).abs() < 1e-14);
    assert_eq!(scene.lights.len(), 1);
}

#[test]
fn a_texture_has_a_value_at_every_coordinate() {
    for wrap in [Wrap::Repeat, Wrap::MirroredRepeat, Wrap::ClampToEdge] {
        for nearest in [false, true] {
            let texels = vec![[0], [255], [255], [0], [0], [255]];
            let texture = Texture { size: [3, 2], texels, srgb: false, nearest, wrap: [wrap; 2] };
            let large = [1e9, 1e18, 3.0743e18, 4.62e18, 1e30, f64::MAX, f64::INFINITY, f64::NAN];
            for (u, v) in large.iter().flat_map(|&at| [(at, 0.3), (0.3, at), (-at, at), (at, -at)]) {
                let [value] = texture.sample(DVec2::new(u, v));
                assert!((0.0..=1.0).contains(&value), "{wrap:?} at {u}, {v}: {value}");
            }
        }
    }
    let texture =
        Texture { size: [4, 1], texels: vec![[0], [51], [102], [255]], wrap: [Wrap::Repeat; 2], ..Texture::default() };
    for period in [0.0, -1.0, 7.0, 1e6, -1e6] {
        for (u, expected) in [(0.125, 0.0), (0.375, 0.2), (0.625, 0.4), (0.875, 1.0), (0.0, 0.5), (0.5, 0.3)] {
            let [value] = texture.sample(DVec2::new(u + period, 0.5));
            assert!((value - expected).abs() <= f32::EPSILON, "{u} + {period}: {value}");
        }
    }
}

#[test]
fn a_chain_of_many_nodes_is_followed_without_recursion() {
    let mut file = File::square();
    let depth = 50_000;
    let mut nodes: Vec<Value> = (0..depth).map(|i| json!({"children": [i + 1], "translation": [1, 0, 0]})).collect();
    nodes.push(json!({"mesh": 0}));
    file.json["nodes"] = json!(nodes);
    assert_eq!(world_positions(&file.scene(), 0)[2].x, f64::from(depth) + 1.0);
}

#[test]
fn scaling_by_a_power_of_two_scales_every_bit() {
    let at = |exponent: i32| {
        let scale = 2f64.powi(exponent);
        let mut file = emissive();
        file.json["nodes"][0]["rotation"] = json!([0.1, 0.7, 0.5, 0.5]);
        file.json["nodes"][0]["translation"] = json!([0.3, 0.7, 0.1]);
        push(&mut file.json["nodes"], json!({"children": [0], "scale": [scale, scale, scale]}));
        file.json["scenes"][0]["nodes"] = json!([1]);
        let scene = file.scene();
        let Shape::Rect { size } = scene.lights[0].shape else { panic!("not a rect") };
        (
            scene.origin_world / scale,
            size / scale,
            scene.lights[0].scene_from_light.matrix3,
            world_positions(&scene, 0)[1] / scale,
        )
    };
    assert_eq!(at(-20), at(0));
    assert_eq!(at(20), at(0));
}

/// What every glTF file of the shared scenes must become: triangles, instances, lights and warnings, or what an error says.
type Expected = Result<(u64, usize, &'static [&'static str], usize), &'static str>;

fn expected() -> BTreeMap<String, Expected> {
    let mut table: BTreeMap<String, Expected> = BTreeMap::new();
    let mut ok = |path: &str, triangles, instances, lights: &'static [&'static str], warnings| {
        table.insert(path.into(), Ok((triangles, instances, lights, warnings)));
    };
    ok("airplane/airplane.glb", 17_456, 1, &[], 0);
    ok("alien-cake/alien.glb", 292, 18, &[], 0);
    ok("alien-cake/cakeBirthday.glb", 1_332, 42, &[], 0);
    ok("alien-cake/tile.glb", 20, 2, &[], 0);
    ok("alpha-mask/01_alpha_mask.gltf", 2, 1, &[], 0);
    ok("animated-cube/03_animated_cube.gltf", 12, 1, &[], 1);
    ok("animated-morph-cube/glTF/AnimatedMorphCube.gltf", 12, 1, &[], 1);
    ok("cornell-box/CornellBox.glb", 36, 6, &["Light: rect"], 1);
    ok("country-kitchen/country-kitchen.glb", 1_021_815, 286, &[], 0);
    ok("cubes-point-light/Cubes.glb", 36, 3, &["Point: point"], 0);
    ok("flight-helmet/flight-helmet.glb", 94_722, 6, &[], 1);
    ok("fox/Fox.glb", 576, 1, &[], 1);
    ok("gpu-instancing/24_gpu_instancing.gltf", 7_656_770, 1_900, &[], 0);
    ok("happy-buddha/happy-buddha.glb", 100_000, 1, &[], 0);
    ok("jeep1/jeep1.glb", 2_032, 7, &[], 0);
    ok("mixed-lighting-chair/mixed-lighting-chair.glb", 40_898, 6, &["Sun: sun"], 0);
    ok("palm-tree/palm-tree.glb", 10_124, 10, &[], 1);
    ok("plane/01_plane.gltf", 2, 1, &[], 0);
    ok("spot/spot.glb", 23_062, 1, &[], 0);
    ok("stanford-bunny/stanford-bunny.glb", 69_451, 1, &[], 0);
    ok("suzanne/02_suzanne.gltf", 3_936, 1, &[], 0);
    ok("two-cylinder-engine/2CylinderEngine.glb", 121_496, 115, &[], 0);
    for mode in 0..16 {
        let path = format!("primitive-modes/Mesh_PrimitiveMode_{mode:02}.gltf");
        // Points and three kinds of lines, with and without indices.
        let (triangles, warnings) = if matches!(mode, 0..=3 | 7..=10) { (0, 2) } else { (2, 0) };
        ok(&path, triangles, usize::from(triangles > 0), &[], warnings);
    }
    let mut fails = |path: &str, end| table.insert(path.into(), Err(end));
    fails(
        "bad-gltf-a/IndexOutOfRange/AllIndicesOutOfRange.gltf",
        "meshes[0].primitives[0].indices: index 0 is 65535: expected below 24",
    );
    fails(
        "bad-gltf-a/IndexOutOfRange/IndexOutOfRange.gltf",
        "meshes[0].primitives[0].indices: index 0 is 255: expected below 24",
    );
    fails("bad-gltf-a/MissingBin/BoxTextured.gltf", "buffers[0].uri: `BoxTextured0.bin` can't be read");
    fails(
        "bad-gltf-a/wrongTypes/badArray.gltf",
        "meshes[0].primitives (line 44, column 26): invalid type: map, expected a sequence",
    );
    fails(
        "bad-gltf-a/wrongTypes/badExtension.gltf",
        "materials[0].pbrMetallicRoughness.baseColorTexture.extensions.KHR_texture_transform (line 130, column 46): \
         invalid type: string \"Not an object\", expected struct TextureTransform",
    );
    fails(
        "bad-gltf-a/wrongTypes/badNumber.gltf",
        "materials[0].normalTexture.scale (line 132, column 27): invalid type: string \"not a number\", expected f32",
    );
    fails(
        "bad-gltf-a/wrongTypes/badObject.gltf",
        "materials[0].pbrMetallicRoughness[0] (line 125, column 52): invalid type: string \"not an object\", expected an \
         array of length 4",
    );
    fails(
        "bad-gltf-a/wrongTypes/badString.gltf",
        "scenes[0].name (line 12, column 14): invalid type: integer `42`, expected a string",
    );
    fails(
        "bad-gltf-a/wrongTypes/badUint.gltf",
        "materials[0].pbrMetallicRoughness.baseColorTexture.index (line 128, column 31): invalid type: integer `-1`, \
         expected index into child of root",
    );
    fails(
        "two-cylinder-engine-draco/2CylinderEngine.gltf",
        "extensionsRequired[0]: `KHR_draco_mesh_compression` is not supported",
    );
    table
}

#[test]
fn every_shared_scene_loads_or_fails_with_its_one_line() {
    let Some(folder) = shared_scenes() else {
        return;
    };
    let table = expected();
    let mut found = Vec::new();
    let mut folders = vec![folder.clone()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "gltf" || extension == "glb") {
                found.push(path.strip_prefix(&folder).unwrap().to_str().unwrap().replace('\\', "/"));
            }
        }
    }
    found.sort();
    assert_eq!(found, table.keys().cloned().collect::<Vec<_>>(), "every file is in the table");
    for (path, expected) in table {
        let result =
            gltf::load(&folder.join(&path), LoadOptions { base_color_textures: true, ..LoadOptions::default() });
        match (result, expected) {
            (Ok(scene), Ok((triangles, instances, lights, warnings))) => {
                assert_eq!((scene.triangle_count(), scene.instances.len()), (triangles, instances), "{path}");
                let shapes = scene.lights.iter().map(|light| format!("{}: {}", light.name, light.shape.name()));
                assert_eq!(shapes.collect::<Vec<_>>(), lights, "{path}");
                assert_eq!(scene.warnings.len(), warnings, "{path}: {:?}", scene.warnings);
            }
            (Err(error), Err(end)) => {
                let line = error.to_string();
                assert!(line.contains(end) && !line.contains('\n'), "{path}: {line}");
            }
            (result, _) => panic!("{path}: {:?}", result.map(|scene| scene.warnings)),
        }
    }
}

#[test]
fn known_scenes_are_where_their_manifest_says() {
    let Some(folder) = shared_scenes() else {
        return;
    };
    let cases = [
        ("stanford-bunny/stanford-bunny.glb", [-0.0947, 0.033, -0.0619]),
        ("cornell-box/CornellBox.glb", [-556.0, 0.0, -559.2]),
        ("two-cylinder-engine/2CylinderEngine.glb", [-373.3, -188.3, -140.0]),
        ("gpu-instancing/24_gpu_instancing.gltf", [-339.4, 0.0, -339.4]),
        ("fox/Fox.glb", [-12.59, -0.1217, -88.09]),
    ];
    for (path, lowest) in cases {
        let scene = gltf::load(&folder.join(path), LoadOptions::default()).unwrap();
        let off = scene.origin_world - DVec3::from(lowest);
        // Four digits are given.
        assert!((off / scene.bounds().size()).abs().max_element() < 1e-3, "{path}: {}", scene.origin_world);
    }
}

#[test]
fn the_cornell_box_light_is_its_ceiling_quad() {
    let Some(folder) = shared_scenes() else {
        return;
    };
    let scene = gltf::load(&folder.join("cornell-box/CornellBox.glb"), LoadOptions::default()).unwrap();
    let light = &scene.lights[0];
    let Shape::Rect { size } = light.shape else { panic!("{:?}", light.shape) };
    // Corners are f32 numbers of up to 65.
    assert!((size - DVec2::new(105.0, 130.0)).abs().max_element() < 1e-5, "{size}");
    assert!(light.axis().dot(DVec3::NEG_Y) > 1.0 - 1e-12);
    assert!((radiance(light) - 100.0 / 683.0).abs().max_element() < 1e-9);
    assert_eq!(scene.instances[light.own_instance.unwrap()].node, 0);
}
