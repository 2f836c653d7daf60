//! Every glTF file that nobody here made: it renders, or it fails with one right line.

mod common;

use std::path::Path;
use std::process::{Command, Output};

use assert_cmd::cargo::CommandCargoExt;
use common::shared_scenes;
use serde_json::Value;

/// What a file must do.
enum Expected {
    /// Renders with this many triangles, instances counted.
    Renders(u64),
    /// Fails, its one line holding this.
    Fails(&'static str),
}
use Expected::{Fails, Renders};

/// Every .gltf and .glb of the shared scenes; triangles as its manifest gives them, counted by other readers.
const TABLE: &[(&str, Expected)] = &[
    ("airplane/airplane.glb", Renders(17_456)),
    ("alien-cake/alien.glb", Renders(292)),
    ("alien-cake/cakeBirthday.glb", Renders(1_332)),
    ("alien-cake/tile.glb", Renders(20)),
    ("alpha-mask/01_alpha_mask.gltf", Renders(2)),
    ("animated-cube/03_animated_cube.gltf", Renders(12)),
    ("animated-morph-cube/glTF/AnimatedMorphCube.gltf", Renders(12)),
    (
        "bad-gltf-a/IndexOutOfRange/AllIndicesOutOfRange.gltf",
        Fails("meshes[0].primitives[0].indices: index 0 is 65535: expected below 24"),
    ),
    (
        "bad-gltf-a/IndexOutOfRange/IndexOutOfRange.gltf",
        Fails("meshes[0].primitives[0].indices: index 0 is 255: expected below 24"),
    ),
    ("bad-gltf-a/MissingBin/BoxTextured.gltf", Fails("buffers[0].uri: `BoxTextured0.bin` can't be read")),
    (
        "bad-gltf-a/wrongTypes/badArray.gltf",
        Fails("meshes[0].primitives (line 44, column 26): invalid type: map, expected a sequence"),
    ),
    (
        "bad-gltf-a/wrongTypes/badExtension.gltf",
        Fails("materials[0].pbrMetallicRoughness.baseColorTexture.extensions.KHR_texture_transform"),
    ),
    ("bad-gltf-a/wrongTypes/badNumber.gltf", Fails("materials[0].normalTexture.scale")),
    ("bad-gltf-a/wrongTypes/badObject.gltf", Fails("materials[0].pbrMetallicRoughness")),
    ("bad-gltf-a/wrongTypes/badString.gltf", Fails("scenes[0].name")),
    ("bad-gltf-a/wrongTypes/badUint.gltf", Fails("materials[0].pbrMetallicRoughness.baseColorTexture.index")),
    ("cornell-box/CornellBox.glb", Renders(36)),
    ("country-kitchen/country-kitchen.glb", Renders(1_021_815)),
    ("cubes-point-light/Cubes.glb", Renders(36)),
    ("flight-helmet/flight-helmet.glb", Renders(94_722)),
    ("fox/Fox.glb", Renders(576)),
    ("gpu-instancing/24_gpu_instancing.gltf", Renders(7_656_770)),
    ("happy-buddha/happy-buddha.glb", Renders(100_000)),
    ("jeep1/jeep1.glb", Renders(2_032)),
    ("mixed-lighting-chair/mixed-lighting-chair.glb", Renders(40_898)),
    ("palm-tree/palm-tree.glb", Renders(10_124)),
    ("plane/01_plane.gltf", Renders(2)),
    ("primitive-modes/Mesh_PrimitiveMode_00.gltf", Fails("no triangles")),
    ("primitive-modes/Mesh_PrimitiveMode_01.gltf", Fails("no triangles")),
    ("primitive-modes/Mesh_PrimitiveMode_02.gltf", Fails("no triangles")),
    ("primitive-modes/Mesh_PrimitiveMode_03.gltf", Fails("no triangles")),
    ("primitive-modes/Mesh_PrimitiveMode_04.gltf", Renders(2)),
    ("primitive-modes/Mesh_PrimitiveMode_05.gltf", Renders(2)),
    ("primitive-modes/Mesh_PrimitiveMode_06.gltf", Renders(2)),
    ("primitive-modes/Mesh_PrimitiveMode_07.gltf", Fails("no triangles")),
    ("primitive-modes/Mesh_PrimitiveMode_08.gltf", Fails("no triangles")),
    ("primitive-modes/Mesh_PrimitiveMode_09.gltf", Fails("no triangles")),
    ("primitive-modes/Mesh_PrimitiveMode_10.gltf", Fails("no triangles")),
    ("primitive-modes/Mesh_PrimitiveMode_11.gltf", Renders(2)),
    ("primitive-modes/Mesh_PrimitiveMode_12.gltf", Renders(2)),
    ("primitive-modes/Mesh_PrimitiveMode_13.gltf", Renders(2)),
    ("primitive-modes/Mesh_PrimitiveMode_14.gltf", Renders(2)),
    ("primitive-modes/Mesh_PrimitiveMode_15.gltf", Renders(2)),
    ("spot/spot.glb", Renders(23_062)),
    ("stanford-bunny/stanford-bunny.glb", Renders(69_451)),
    ("suzanne/02_suzanne.gltf", Renders(3_936)),
    ("two-cylinder-engine-draco/2CylinderEngine.gltf", Fails("`KHR_draco_mesh_compression` is not supported")),
    ("two-cylinder-engine/2CylinderEngine.glb", Renders(121_496)),
];

/// Folders of files with two coplanar triangles, whose shadow need not be seen.
const FLAT: &[&str] = &["alpha-mask/", "plane/", "primitive-modes/"];

fn is_gltf(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "gltf" || extension == "glb")
}

fn files_below(directory: &Path, found: &mut Vec<std::path::PathBuf>) {
    for entry in directory.read_dir().expect("a readable directory") {
        let path = entry.expect("a readable entry").path();
        if path.is_dir() {
            files_below(&path, found);
        } else if is_gltf(&path) {
            found.push(path);
        }
    }
}

#[test]
fn the_table_names_every_file() {
    let Some(scenes) = shared_scenes() else { return };
    let mut found = Vec::new();
    files_below(&scenes, &mut found);
    let mut found: Vec<_> =
        found.iter().map(|path| path.strip_prefix(&scenes).expect("below").display().to_string()).collect();
    found.sort();
    let mut listed: Vec<_> = TABLE.iter().map(|(name, _)| (*name).to_owned()).collect();
    listed.sort();
    assert_eq!(found, listed);
}

fn render(scene: &Path, output: &Path, more: &[&str]) -> Output {
    let mut command = Command::cargo_bin("penumbra").expect("the binary");
    command.arg("render").arg(scene).args(["--json", "--size", "64x48", "--set", "samples=4"]).args(more);
    command.arg("-o").arg(output).output().expect("runs")
}

#[test]
fn every_file_renders_or_fails_with_one_right_line() {
    let Some(scenes) = shared_scenes() else { return };
    let directory = tempfile::tempdir().expect("a directory");
    for (name, expected) in TABLE {
        let output = directory.path().join("out.exr");
        let mut run = render(&scenes.join(name), &output, &[]);
        let mut floor = 0;
        if String::from_utf8_lossy(&run.stderr).contains("has no light") {
            run = render(&scenes.join(name), &output, &["--add-light", "auto", "--add-floor"]);
            floor = 2;
        }
        let errors = String::from_utf8_lossy(&run.stderr);
        match expected {
            Renders(triangles) => {
                assert!(run.status.success(), "{name}: {errors}");
                let record: Value = serde_json::from_slice(&run.stdout).expect("a JSON record");
                assert_eq!(record["scene"]["triangles"].as_u64(), Some(triangles + floor), "{name}");
                let image = penumbra::image::read_exr(&output).expect("an image");
                let lights = image.light_names();
                assert!(!lights.is_empty(), "{name}");
                let coverage = image.channel("coverage.A").expect("coverage");
                assert!(coverage.contains(&1.0), "{name}: no pixel sees a surface");
                for light in lights {
                    let visibility = image.visibility(&light).expect("visibility");
                    assert!(visibility.iter().all(|v| (0.0..=1.0).contains(v)), "{name} {light}");
                    if floor > 0 {
                        let covered = || visibility.iter().zip(coverage).filter(|(_, a)| **a == 1.0).map(|(v, _)| *v);
                        assert!(covered().any(|v| v == 1.0), "{name} {light}: nothing is lit");
                        let is_flat = FLAT.iter().any(|folder| name.starts_with(folder));
                        assert!(is_flat || covered().any(|v| v < 1.0), "{name} {light}: nothing is in shadow");
                    }
                }
                std::fs::remove_file(&output).expect("removes");
            }
            Fails(reason) => {
                assert_eq!(run.status.code(), Some(1), "{name}: {errors}");
                let lines: Vec<_> = errors.lines().filter(|line| line.starts_with("error: ")).collect();
                assert!(matches!(lines.as_slice(), [line] if line.contains(reason)), "{name}: {errors}");
                assert!(run.stdout.is_empty() && !output.exists(), "{name} left something behind");
            }
        }
    }
    assert_eq!(std::fs::read_dir(directory.path()).expect("a directory").count(), 0, "nothing is left behind");
}

#[test]
fn a_field_of_instances_is_never_flattened() {
    let Some(scenes) = shared_scenes() else { return };
    let directory = tempfile::tempdir().expect("a directory");
    let scene = scenes.join("gpu-instancing/24_gpu_instancing.gltf");
    let run = render(&scene, &directory.path().join("out.exr"), &["--add-light", "auto"]);
    let record: Value = serde_json::from_slice(&run.stdout).expect("a JSON record");
    assert_eq!(record["scene"]["triangles"], 7_656_770);
    assert!(record["counters"]["stored_triangles"].as_u64().expect("a number") < 10_000);
    // 1 GiB for all of the process.
    if let Some(peak_mb) = record["memory_mb"]["peak_rss"].as_f64() {
        assert!(peak_mb < 1073.0, "{peak_mb} MB");
    }
}
