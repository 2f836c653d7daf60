//! Animations: clips with their samplers' keys.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use gltf::json::accessor::{ComponentType, Type};
use gltf::json::mesh::Mesh;
use serde::Deserialize;

use super::accessor::Accessor;
use super::document::{Document, Parsed, fault, item, quoted};
use super::geometry::is_triangles;
use super::{FREE_ELEMENTS, Warnings, name_or};
use crate::scene::UniqueNames;
use crate::scene::animation::{Channel, Clip, Curve, Interpolation, Property};

/// An animation of the file.
#[derive(Deserialize)]
pub(super) struct Animation {
    name: Option<String>,
    channels: Vec<JsonChannel>,
    samplers: Vec<JsonSampler>,
}

/// What a sampler's values are for.
#[derive(Deserialize)]
struct JsonChannel {
    sampler: u32,
    target: JsonTarget,
}

/// A property of a node, or of what an extension says.
#[derive(Deserialize)]
struct JsonTarget {
    node: Option<u32>,
    path: String,
}

/// Accessors of times and values.
#[derive(Deserialize)]
struct JsonSampler {
    input: u32,
    output: u32,
    #[serde(default = "linear")]
    interpolation: String,
}

fn linear() -> String {
    "LINEAR".into()
}

/// Keys may have this many numbers for each byte of the file, beyond [`FREE_ELEMENTS`]. Data that isn't shared never has more
/// than one.
const NUMBERS_PER_BYTE: u64 = 4;

/// Morph targets of a mesh of the file: those of its first primitive with triangles. That the others have as many is checked
/// where they are loaded.
pub(super) fn target_count(mesh: &Mesh) -> usize {
    let first = mesh.primitives.iter().find(|primitive| is_triangles(primitive));
    first.and_then(|primitive| primitive.targets.as_ref()).map_or(0, Vec::len)
}

/// All animations of a document.
pub(super) fn clips(document: &Document, warnings: &mut Warnings) -> Parsed<Vec<Clip>> {
    let mut keys =
        Keys { document, times: HashMap::new(), values: HashMap::new(), quaternions: HashSet::new(), total: 0 };
    let mut names = UniqueNames::default();
    let mut clips = Vec::with_capacity(document.animations.len());
    for (index, animation) in document.animations.iter().enumerate() {
        let place = format!("animations[{index}]");
        let name = names.take(&name_or(animation.name.as_deref(), "animation", index));
        let mut targets = HashSet::new();
        let mut channels = Vec::with_capacity(animation.channels.len());
        for (c, json) in animation.channels.iter().enumerate() {
            let at = |member: &str| format!("{place}.channels[{c}].{member}");
            let property = match json.target.path.as_str() {
                "translation" => Some(Property::Translation),
                "rotation" => Some(Property::Rotation),
                "scale" => Some(Property::Scale),
                "weights" => Some(Property::Weights),
                "pointer" => None,
                other => {
                    let expected = "expected translation, rotation, scale or weights";
                    return Err(fault(at("target.path"), format!("{expected}, found {}", quoted(other))));
                }
            };
            let sampler = json.sampler as usize;
            let samplers = &animation.samplers;
            let json_sampler = item(samplers, &format!("{place}.samplers"), sampler, || at("sampler"))?;
            let (Some(property), Some(node)) = (property, json.target.node) else {
                let what =
                    "played in part: a channel's target is not a node's (KHR_animation_pointer is not supported)";
                warnings.add(what, &name);
                continue;
            };
            let node = node as usize;
            let json_node = item(&document.root.nodes, "nodes", node, || at("target.node"))?;
            if !targets.insert((node, json.target.path.as_str())) {
                let message = format!("another channel has the {} of nodes[{node}] already", json.target.path);
                return Err(fault(at("target"), message));
            }
            let width = match property {
                Property::Translation | Property::Rotation | Property::Scale if json_node.matrix.is_some() => {
                    let message =
                        format!("nodes[{node}] has a matrix: what is animated has translation, rotation and scale");
                    return Err(fault(at("target.node"), message));
                }
                Property::Translation | Property::Scale => Width::Vector,
                Property::Rotation => Width::Quaternion,
                Property::Weights => {
                    let mesh = json_node.mesh.map(|mesh| {
                        item(&document.root.meshes, "meshes", mesh.value(), || format!("nodes[{node}].mesh"))
                    });
                    match mesh.transpose()?.map_or(0, target_count) {
                        0 => return Err(fault(at("target.node"), format!("nodes[{node}] has no morph targets"))),
                        count => Width::Scalars(count),
                    }
                }
            };
            let curve = keys.curve(json_sampler, width, &format!("{place}.samplers[{sampler}]"))?;
            channels.push(Channel { node, property, curve });
        }
        clips.push(Clip { name, channels });
    }
    Ok(clips)
}

/// What a sampler's output holds for each value.
#[derive(Clone, Copy)]
enum Width {
    Vector,
    Quaternion,
    /// This many elements of one number.
    Scalars(usize),
}

/// Decoded accessors of samplers, each once.
struct Keys<'a> {
    document: &'a Document<'a>,
    times: HashMap<usize, Arc<[f32]>>,
    values: HashMap<usize, Arc<[f32]>>,
    /// Which of the values have been found to be quaternions, by the parts of a key.
    quaternions: HashSet<(usize, usize)>,
    /// Numbers so far.
    total: u64,
}

impl Keys<'_> {
    fn curve(&mut self, json: &JsonSampler, width: Width, place: &str) -> Parsed<Curve> {
        let at = |member: &str| format!("{place}.{member}");
        let interpolation = match json.interpolation.as_str() {
            "LINEAR" => Interpolation::Linear,
            "STEP" => Interpolation::Step,
            "CUBICSPLINE" => Interpolation::CubicSpline,
            other => {
                let message = format!("expected LINEAR, STEP or CUBICSPLINE, found {}", quoted(other));
                return Err(fault(at("interpolation"), message));
            }
        };
        let document = self.document;
        let input = Accessor::new(document, json.input as usize, || at("input"))?;
        input.expect(Type::Scalar, &[ComponentType::F32], || at("input"))?;
        if input.count == 0 {
            return Err(fault(at("input"), format!("accessors[{}]: expected at least 1 element", input.index)));
        }
        let output = Accessor::new(document, json.output as usize, || at("output"))?;
        let numbers =
            [ComponentType::F32, ComponentType::I8, ComponentType::U8, ComponentType::I16, ComponentType::U16];
        let (dimensions, components, elements) = match width {
            Width::Vector => (Type::Vec3, &numbers[..1], 1),
            Width::Quaternion => (Type::Vec4, &numbers[..], 1),
            Width::Scalars(count) => (Type::Scalar, &numbers[..], count),
        };
        output.expect(dimensions, components, || at("output"))?;
        if output.component != ComponentType::F32 && !output.normalized {
            return Err(fault(at("output"), format!("accessors[{}]: expected normalized integers", output.index)));
        }
        let parts = if interpolation == Interpolation::CubicSpline { 3 } else { 1 };
        // Both are at most what JSON and buffers hold, or the product is beyond any accessor.
        output.expect_count(input.count.saturating_mul(parts).saturating_mul(elements), || at("output"))?;

        let times = match self.times.get(&input.index) {
            Some(known) => Arc::clone(known),
            None => {
                let times = self.numbers(&input, &at("input"))?;
                check_times(&times, &at("input"))?;
                self.times.insert(input.index, Arc::clone(&times));
                times
            }
        };
        let values = match self.values.get(&output.index) {
            Some(known) => Arc::clone(known),
            None => {
                let values = self.numbers(&output, &at("output"))?;
                if let Some(bad) = values.iter().find(|value| !value.is_finite()) {
                    return Err(fault(at("output"), format!("expected finite numbers, found {bad}")));
                }
                self.values.insert(output.index, Arc::clone(&values));
                values
            }
        };
        if matches!(width, Width::Quaternion) && self.quaternions.insert((output.index, parts)) {
            let mut quaternions = values.chunks_exact(4).skip(parts / 2).step_by(parts);
            if let Some(bad) = quaternions.position(|quaternion| quaternion.iter().all(|&x| x == 0.0)) {
                return Err(fault(at("output"), format!("expected unit quaternions, found 0, 0, 0, 0 at key {bad}")));
            }
        }
        if let Width::Scalars(count) = width {
            // Each pose has a list of them.
            self.take(count as u64, place)?;
        }
        Ok(Curve { times, values, interpolation })
    }

    /// All numbers of an accessor, whose shape has been checked.
    fn numbers(&mut self, accessor: &Accessor, place: &str) -> Parsed<Arc<[f32]>> {
        // Before anything is allocated: a count without data is only a claim.
        self.take((accessor.count as u64).saturating_mul(accessor.dimensions.multiplicity() as u64), place)?;
        Ok(match accessor.dimensions {
            Type::Vec3 => accessor.floats::<3, _>(|v| v)?.as_flattened().into(),
            Type::Vec4 => accessor.floats::<4, _>(|v| v)?.as_flattened().into(),
            _ => accessor.floats::<1, _>(|v| v)?.as_flattened().into(),
        })
    }

    /// Counts numbers; faults when there are too many.
    fn take(&mut self, numbers: u64, place: &str) -> Parsed<()> {
        self.total = self.total.saturating_add(numbers);
        let size = self.document.size;
        let budget = FREE_ELEMENTS.saturating_add(size.saturating_mul(NUMBERS_PER_BYTE));
        if self.total <= budget {
            return Ok(());
        }
        let message = format!("too many keys for its size: a file of {size} bytes may have {budget} numbers in them");
        Err(fault(place, message))
    }
}

fn check_times(times: &[f32], place: &str) -> Parsed<()> {
    let is_good = |i: usize| times[i].is_finite() && times[i] >= 0.0 && (i == 0 || times[i] > times[i - 1]);
    match (0..times.len()).find(|&i| !is_good(i)) {
        Some(bad) => {
            let expected = "expected finite times of at least 0 that ascend";
            Err(fault(place, format!("{expected}, found {} as number {bad}", times[bad])))
        }
        None => Ok(()),
    }
}
