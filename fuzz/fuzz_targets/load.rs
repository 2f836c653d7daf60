//! The glTF loader on any bytes: it never panics, hangs or takes memory beyond its bounds, and what it returns is sound; so are
//! the poses of its animations.
//!
//! Half of the mutations are of bytes, half of the JSON's values, so that most inputs get past the JSON parser.

#![no_main]

use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};
use penumbra::scene::{LoadOptions, Scene, gltf};
use serde_json::{Value, json};

fuzz_target!(|data: &[u8]| {
    if let Ok(scene) = gltf::load_slice(data, None, "fuzz", LoadOptions { base_color_textures: true }) {
        assert_sound(&scene);
    }
    if let Ok(animated) = gltf::load_animated_slice(data, None, "fuzz", LoadOptions::default()) {
        // Each clip before its start, within it, and beyond its end.
        for (index, clip) in animated.clips.iter().enumerate().take(4) {
            for seconds in [-1.0, 0.6 * clip.start() + 0.4 * clip.end(), 2.0 * clip.end()] {
                if let Ok(scene) = animated.pose(index, seconds) {
                    assert_sound(&scene);
                }
            }
        }
    }
});

fuzz_mutator!(|data: &mut [u8], size: usize, max_size: usize, seed: u32| {
    let mut random = Random(u64::from(seed) << 1 | 1);
    if random.below(2) == 0 {
        return fuzzer_mutate(data, size, max_size);
    }
    let Some((mut value, bin)) = split(&data[..size]) else {
        return fuzzer_mutate(data, size, max_size);
    };
    for _ in 0..1 + random.below(3) {
        mutate(&mut value, &mut random);
    }
    let bytes = join(&value, bin.as_deref());
    if bytes.len() > max_size {
        return fuzzer_mutate(data, size, max_size);
    }
    data[..bytes.len()].copy_from_slice(&bytes);
    bytes.len()
});

/// What every technique takes for granted.
fn assert_sound(scene: &Scene) {
    for mesh in &scene.meshes {
        let vertices = mesh.positions.len();
        assert!(mesh.triangles.as_flattened().iter().all(|&index| (index as usize) < vertices));
        assert!(mesh.positions.iter().all(|p| p.is_finite()));
        assert!(mesh.normals.as_ref().is_none_or(|n| n.len() == vertices && n.iter().all(|n| n.is_normalized())));
        assert!(mesh.uvs.as_ref().is_none_or(|uvs| uvs.len() == vertices));
        assert!(mesh.material.is_none_or(|material| material < scene.materials.len()));
    }
    for material in &scene.materials {
        let texture = material.base_color_texture.as_ref();
        assert!(texture.is_none_or(|t| t.texels.len() as u64 == u64::from(t.size[0]) * u64::from(t.size[1])));
    }
    for instance in &scene.instances {
        assert!(!scene.meshes[instance.mesh].triangles.is_empty());
        assert!(instance.node < scene.nodes.len());
        assert!(instance.scene_from_mesh.is_finite() && instance.scene_from_mesh.inverse().is_finite());
    }
    for light in &scene.lights {
        let [x, y, z] = [0, 1, 2].map(|axis| light.scene_from_light.matrix3.col(axis));
        assert!(x.is_normalized() && y.is_normalized() && z.is_normalized() && light.scene_from_light.is_finite());
        assert!(x.cross(y).dot(z) > 0.999 && x.dot(y).abs() < 1e-9);
        assert!(light.own_instance.is_none_or(|instance| instance < scene.instances.len()));
    }
    for node in &scene.nodes {
        assert!(node.parent.is_none_or(|parent| parent < scene.nodes.len()));
    }
    assert!(scene.warnings.iter().all(|line| !line.contains('\n')));
}

/// xorshift64*.
struct Random(u64);

impl Random {
    fn below(&mut self, end: usize) -> usize {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        (self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 33) as usize % end.max(1)
    }
}

/// The JSON and the BIN chunk, if the input is sane enough.
fn split(data: &[u8]) -> Option<(Value, Option<Vec<u8>>)> {
    if !data.starts_with(b"glTF") {
        return Some((serde_json::from_slice(data).ok()?, None));
    }
    let length = u32::from_le_bytes(data.get(12..16)?.try_into().ok()?) as usize;
    let json = data.get(20..20usize.checked_add(length)?)?;
    let bin = data.get(28 + length..).map(<[u8]>::to_vec);
    Some((serde_json::from_slice(json).ok()?, Some(bin.unwrap_or_default())))
}

fn join(value: &Value, bin: Option<&[u8]>) -> Vec<u8> {
    let mut json = value.to_string().into_bytes();
    let Some(bin) = bin else { return json };
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut bytes = b"glTF".to_vec();
    bytes.extend(2u32.to_le_bytes());
    bytes.extend((12 + 8 + json.len() as u32 + 8 + bin.len() as u32).to_le_bytes());
    bytes.extend((json.len() as u32).to_le_bytes());
    bytes.extend(b"JSON");
    bytes.extend(&json);
    bytes.extend((bin.len() as u32).to_le_bytes());
    bytes.extend(b"BIN\0");
    bytes.extend(bin);
    bytes
}

/// Changes one value somewhere in the tree.
fn mutate(root: &mut Value, random: &mut Random) {
    let donor = pick(root, random).clone();
    let target = pick(root, random);
    *target = match random.below(10) {
        0 => donor,
        1 => NUMBERS[random.below(NUMBERS.len())].parse().expect("JSON"),
        2 => json!(random.below(300)),
        3 => json!([5120, 5121, 5122, 5123, 5125, 5126, 9728, 33071, 33648, 10497][random.below(10)]),
        4 => json!(
            ["SCALAR", "VEC2", "VEC3", "VEC4", "MASK", "BLEND", "rect", "disk", "sphere", "tube"][random.below(10)]
        ),
        5 => json!(
            [
                "sun",
                "point",
                "spot",
                "directional",
                "orthographic",
                "perspective",
                "a.bin",
                "data:;base64,AAAA",
                "",
                "\n",
                "CUBICSPLINE",
                "STEP",
                "rotation",
                "weights"
            ][random.below(14)]
        ),
        6 => match target.take() {
            Value::Array(mut items) => {
                if let Some(item) = items.get(random.below(items.len())).cloned() {
                    items.push(item);
                }
                Value::Array(items)
            }
            Value::Number(number) => {
                let value = number.as_f64().unwrap_or(0.0) + [1.0, -1.0, 0.25, 1e6][random.below(4)];
                if value.fract() == 0.0 && (0.0..1e15).contains(&value) { json!(value as u64) } else { json!(value) }
            }
            other => other,
        },
        7 => match target.take() {
            Value::Array(mut items) => {
                if !items.is_empty() {
                    items.remove(random.below(items.len()));
                }
                Value::Array(items)
            }
            Value::Object(mut members) => {
                if let Some(key) = members.keys().nth(random.below(members.len())).cloned() {
                    members.remove(&key);
                }
                Value::Object(members)
            }
            other => other,
        },
        8 => match target.take() {
            Value::Object(mut members) => {
                let key = KEYS[random.below(KEYS.len())];
                members.insert(key.into(), donor);
                Value::Object(members)
            }
            other => other,
        },
        _ => json!(-(random.below(100) as f64) / 7.0),
    };
}

/// Numbers at the edges of types.
const NUMBERS: [&str; 10] =
    ["0", "1", "-1", "4294967295", "4294967296", "18446744073709551615", "1e39", "-1e300", "1e-45", "0.5"];

/// Members that inputs may lack.
const KEYS: [&str; 33] = [
    "sparse",
    "byteStride",
    "byteOffset",
    "normalized",
    "indices",
    "mode",
    "matrix",
    "scale",
    "rotation",
    "children",
    "mesh",
    "camera",
    "skin",
    "extensions",
    "KHR_lights_punctual",
    "EXT_lights_area",
    "PENUMBRA_lights",
    "EXT_mesh_gpu_instancing",
    "KHR_texture_transform",
    "KHR_materials_emissive_strength",
    "bufferView",
    "uri",
    "NORMAL",
    "TEXCOORD_0",
    "targets",
    "weights",
    "JOINTS_0",
    "WEIGHTS_0",
    "joints",
    "inverseBindMatrices",
    "animations",
    "interpolation",
    "node",
];

/// A random value of the tree.
fn pick<'a>(root: &'a mut Value, random: &mut Random) -> &'a mut Value {
    let mut at = root;
    loop {
        let size = match at {
            Value::Array(items) => items.len(),
            Value::Object(members) => members.len(),
            _ => 0,
        };
        if size == 0 || random.below(8) == 0 {
            return at;
        }
        let which = random.below(size);
        at = match at {
            Value::Array(items) => &mut items[which],
            Value::Object(members) => members.values_mut().nth(which).expect("within its size"),
            _ => unreachable!("has no members"),
        };
    }
}
