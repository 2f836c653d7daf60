//! Small glTF files made in memory.

use std::path::{Path, PathBuf};

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use penumbra::scene::{LoadOptions, Scene, gltf};
use serde_json::{Value, json};

/// A document and its one buffer.
#[derive(Clone)]
pub struct File {
    pub json: Value,
    pub bin: Vec<u8>,
}

impl File {
    /// A 2 × 2 square around the origin in the XY plane, facing +Z, in `nodes[0]`: `accessors[0]` holds its positions,
    /// `accessors[1]` its indices.
    pub fn square() -> Self {
        let json = json!({
            "asset": {"version": "2.0"},
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": "square", "mesh": 0}],
            "meshes": [{"name": "square", "primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
            "accessors": [], "bufferViews": [],
        });
        let mut file = Self { json, bin: Vec::new() };
        file.floats(&[[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]]);
        file.accessor(&le(&[0u16, 1, 2, 0, 2, 3], u16::to_le_bytes), 5123, 6, "SCALAR");
        file
    }

    /// The square with `PENUMBRA_lights` in `nodes[1]`.
    pub fn with_light(light: Value) -> Self {
        let mut file = Self::square();
        file.add_node(json!({"name": "light", "extensions": {"PENUMBRA_lights": light}}));
        file
    }

    /// Adds a root node to the scene.
    pub fn add_node(&mut self, node: Value) -> usize {
        let index = push(&mut self.json["nodes"], node);
        push(&mut self.json["scenes"][0]["nodes"], json!(index));
        index
    }

    /// Adds bytes to the buffer, as a view.
    pub fn view(&mut self, bytes: &[u8]) -> usize {
        let view = json!({"buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len()});
        self.bin.extend(bytes);
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        push(&mut self.json["bufferViews"], view)
    }

    /// Adds an accessor with a view of its own.
    pub fn accessor(&mut self, bytes: &[u8], component: u32, count: usize, kind: &str) -> usize {
        let view = self.view(bytes);
        let accessor = json!({"bufferView": view, "componentType": component, "count": count, "type": kind});
        push(&mut self.json["accessors"], accessor)
    }

    /// Adds an accessor of float vectors.
    pub fn floats<const N: usize>(&mut self, vectors: &[[f32; N]]) -> usize {
        let kind = ["", "SCALAR", "VEC2", "VEC3", "VEC4"][N];
        self.accessor(&le(vectors.as_flattened(), f32::to_le_bytes), 5126, vectors.len(), kind)
    }

    /// The first primitive of the first mesh.
    pub fn primitive(&mut self) -> &mut Value {
        &mut self.json["meshes"][0]["primitives"][0]
    }

    fn with_buffer(&self, uri: Option<&str>) -> Vec<u8> {
        let mut json = self.json.clone();
        if json.get("buffers").is_none() {
            json["buffers"] = json!([{"byteLength": self.bin.len()}]);
            if let Some(uri) = uri {
                json["buffers"][0]["uri"] = json!(uri);
            }
        }
        json.to_string().into_bytes()
    }

    /// As .gltf with its buffer inside.
    pub fn gltf(&self) -> Vec<u8> {
        self.with_buffer(Some(&format!("data:application/octet-stream;base64,{}", STANDARD.encode(&self.bin))))
    }

    /// As .gltf that refers to a file.
    pub fn gltf_beside(&self, uri: &str) -> Vec<u8> {
        self.with_buffer(Some(uri))
    }

    /// As .glb.
    pub fn glb(&self) -> Vec<u8> {
        let mut json = self.with_buffer(None);
        json.resize(json.len().next_multiple_of(4), b' ');
        let length = 12 + 8 + json.len() + 8 + self.bin.len();
        let word = |value: usize| (value as u32).to_le_bytes();
        let parts: [&[u8]; 9] = [
            b"glTF",
            &word(2),
            &word(length),
            &word(json.len()),
            b"JSON",
            &json,
            &word(self.bin.len()),
            b"BIN\0",
            &self.bin,
        ];
        parts.concat()
    }

    /// Loads it.
    pub fn scene(&self) -> Scene {
        load(&self.gltf()).expect("a valid file")
    }
}

/// Loads from memory, with base-colour textures.
pub fn load(bytes: &[u8]) -> Result<Scene, String> {
    gltf::load_slice(bytes, None, "test", LoadOptions { base_color_textures: true, highlights: true })
        .map_err(|error| error.to_string())
}

/// Numbers as little-endian bytes.
pub fn le<T: Copy, const N: usize>(values: &[T], to_bytes: impl Fn(T) -> [u8; N]) -> Vec<u8> {
    values.iter().flat_map(|&value| to_bytes(value)).collect()
}

/// Appends to an array, which is made where there is none.
pub fn push(array: &mut Value, item: Value) -> usize {
    if array.is_null() {
        *array = json!([]);
    }
    let items = array.as_array_mut().expect("an array");
    items.push(item);
    items.len() - 1
}

/// The folder of shared scenes, where this checkout has one. Under continuous integration it must be there.
pub fn shared_scenes() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/scenes");
    assert!(folder.is_dir() || std::env::var_os("CI").is_none(), "{} is missing", folder.display());
    folder.is_dir().then_some(folder)
}
