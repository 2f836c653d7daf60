//! WGSL without an adapter: every file is registered, imports resolve, layouts match Rust's.

use std::collections::BTreeSet;
use std::path::Path;

use penumbra::gpu::shader::{SOURCES, Source};
use penumbra::techniques::{ALL, Needs};
use wgpu::naga::{AddressSpace, TypeInner};

/// Every file of a folder and those in it, relative to it, in order.
fn files_below(folder: &str) -> Vec<String> {
    fn add(root: &Path, under: &Path, found: &mut Vec<String>) {
        for entry in std::fs::read_dir(under).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                add(root, &path, found);
            } else {
                let relative = path.strip_prefix(root).expect("below the root");
                found.push(relative.to_str().expect("UTF-8").replace('\\', "/"));
            }
        }
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let mut found = Vec::new();
    add(&root, &root, &mut found);
    found.sort();
    found
}

fn source_of(file: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("src").join(file)).expect("a file")
}

#[test]
fn every_shader_is_registered_and_valid() {
    let files = files_below("shaders");
    let mut registered: Vec<&str> = SOURCES.iter().map(|(path, _)| *path).collect();
    registered.sort_unstable();
    assert_eq!(files, registered);
    for path in registered {
        let source = Source::load(path);
        let is_library = path.starts_with("lib/");
        assert_eq!(source.module.entry_points.is_empty(), is_library, "{path}: libraries alone have no entry point");
    }
}

/// The WGSL names of the structs that the library declares with `gpu_struct!`, each of which has a test of its layout.
fn gpu_structs() -> BTreeSet<String> {
    let mut names = BTreeSet::new();
    for file in files_below("src").iter().filter(|file| *file != "gpu/layout.rs") {
        for declared in source_of(file).split("gpu_struct! {").skip(1) {
            let words: Vec<&str> = declared.split_whitespace().collect();
            let at = words.iter().position(|&word| word == "struct").expect("gpu_struct! holds a struct");
            let name = if words[at + 2] == "as" { words[at + 3] } else { words[at + 1] };
            assert!(names.insert(name.to_owned()), "{file}: another {name}");
        }
    }
    names
}

#[test]
fn every_struct_in_a_buffer_has_a_twin_in_rust() {
    let twins = gpu_structs();
    assert!(twins.contains("View") && twins.contains("Cutout"), "{twins:?}");
    for (path, _) in SOURCES {
        let module = Source::load(path).module;
        for (_, variable) in module.global_variables.iter() {
            if !matches!(variable.space, AddressSpace::Uniform | AddressSpace::Storage { .. }) {
                continue;
            }
            let mut kind = &module.types[variable.ty];
            while let TypeInner::Array { base, .. } = kind.inner {
                kind = &module.types[base];
            }
            if let (TypeInner::Struct { .. }, Some(name)) = (&kind.inner, &kind.name) {
                assert!(twins.contains(name), "{path}: {name} is not declared with gpu_struct!");
            }
        }
    }
}

#[test]
fn every_technique_is_registered_and_has_its_shader() {
    let techniques = files_below("src/techniques");
    let shaders: Vec<&str> = SOURCES.iter().filter_map(|(path, _)| path.strip_prefix("techniques/")).collect();
    for file in techniques.iter().filter(|file| source_of(&format!("techniques/{file}")).contains("pub const ENTRY:")) {
        let stem = file.trim_end_matches(".rs").replace('_', "-");
        assert!(ALL.iter().any(|entry| entry.name == stem), "{file} is not in ALL");
    }
    for entry in ALL {
        let stem = entry.name.replace('-', "_");
        assert!(techniques.contains(&format!("{stem}.rs")), "{} is not in a file of its name", entry.name);
        let has_shader = shaders.contains(&format!("{stem}.wgsl").as_str());
        assert_eq!(has_shader, entry.needs == Needs::Gpu, "{}: a shader of its name, for a GPU alone", entry.name);
    }
    for shader in shaders {
        let stem = shader.trim_end_matches(".wgsl").replace('_', "-");
        assert!(ALL.iter().any(|entry| entry.name == stem), "techniques/{shader} is of no technique");
    }
}
