//! Primitives: which accessors make them up, and their triangles. What several primitives share is decoded once.

use std::collections::HashMap;
use std::hash::Hash;
use std::sync::Arc;

use glam::{Vec2, Vec3};
use gltf::json::accessor::{ComponentType, Type};
use gltf::json::mesh::{Mode, Primitive, Semantic, TRIANGLE_FAN, TRIANGLE_STRIP};
use gltf::json::validation::Checked;
use rayon::prelude::*;

use super::accessor::Accessor;
use super::animation::target_count;
use super::deformers;
use super::document::{Document, Parsed, fault, item};
use super::hierarchy::Hierarchy;
use super::materials::{Source, TexCoords};
use super::{FREE_ELEMENTS, Warnings, name_or};
use crate::scene::animation::Deformer;
use crate::scene::{MAX_COORDINATE, Mesh};

/// Vertices, normals, texture coordinates and triangles may number [`FREE_ELEMENTS`] in all and this many for each byte of the
/// file. Data that isn't shared never has more than one for a byte.
pub(super) const ELEMENTS_PER_BYTE: u64 = 4;

/// The meshes of a file, none of them deformed.
pub(super) struct Geometry {
    pub meshes: Vec<Mesh>,
    /// For each mesh of the file, the meshes (one a primitive) that it stands for.
    pub meshes_of: Vec<Vec<Part>>,
    /// What deforms them.
    pub deformers: Vec<Deformer>,
    /// For each mesh of the file, the weights of its morph targets where nothing else is said.
    pub weights_of: Vec<Vec<f64>>,
}

/// A primitive.
#[derive(Clone, Copy)]
pub(super) struct Part {
    /// Index into [`Geometry::meshes`].
    pub mesh: usize,
    /// Index into [`Geometry::deformers`].
    pub deformer: Option<usize>,
    /// Which vertices it indexes: the same number, the same positions and normals.
    pub vertices: usize,
}

/// What makes two primitives the same mesh.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
struct Key {
    positions: usize,
    normals: Option<usize>,
    uvs: Option<Uvs>,
    indices: Option<usize>,
    /// glTF's number of the primitive mode.
    mode: u32,
    material: Option<usize>,
}

/// Where texture coordinates come from.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
enum Uvs {
    Accessor(usize, TexCoords),
    /// All zero, this many.
    Missing(usize),
}

/// A primitive whose accessors have been found and checked.
struct Planned {
    key: Key,
    /// Such as `meshes[0].primitives[1]`.
    place: String,
    name: String,
    vertices: usize,
    triangles: u64,
    deformer: Option<deformers::Key>,
}

/// Which meshes of the file the scene's nodes use.
pub(super) fn shown_meshes(document: &Document, hierarchy: &Hierarchy) -> Parsed<Vec<bool>> {
    let mut shown = vec![false; document.root.meshes.len()];
    for &node in &hierarchy.shown {
        if let Some(mesh) = document.root.nodes[node].mesh {
            item(&document.root.meshes, "meshes", mesh.value(), || format!("nodes[{node}].mesh"))?;
            shown[mesh.value()] = true;
        }
    }
    Ok(shown)
}

/// Which materials the triangles of these meshes use.
pub(super) fn used_materials(document: &Document, shown_meshes: &[bool]) -> Parsed<Vec<bool>> {
    let mut used = vec![false; document.root.materials.len()];
    for (m, mesh) in document.root.meshes.iter().enumerate().filter(|&(m, _)| shown_meshes[m]) {
        for (p, primitive) in mesh.primitives.iter().enumerate() {
            if let Some(material) = primitive.material.filter(|_| is_triangles(primitive)) {
                let place = || format!("meshes[{m}].primitives[{p}].material");
                item(&document.root.materials, "materials", material.value(), place)?;
                used[material.value()] = true;
            }
        }
    }
    Ok(used)
}

pub(super) fn is_triangles(primitive: &Primitive) -> bool {
    matches!(primitive.mode, Checked::Valid(Mode::Triangles | Mode::TriangleStrip | Mode::TriangleFan))
}

/// Loads the meshes that the scene's nodes use; those in `skinned` with their joints.
pub(super) fn load(
    document: &Document,
    shown_meshes: &[bool],
    skinned: &[bool],
    materials: &[Source],
    warnings: &mut Warnings,
) -> Parsed<Geometry> {
    let mut planned = Vec::new();
    let mut planned_deformers = deformers::Planned::default();
    let mut known = HashMap::new();
    let mut vertices = Distinct::default();
    let mut meshes_of = vec![Vec::new(); document.root.meshes.len()];
    let mut weights_of = vec![Vec::new(); document.root.meshes.len()];
    for (m, mesh) in document.root.meshes.iter().enumerate().filter(|&(m, _)| shown_meshes[m]) {
        let mesh_name = name_or(mesh.name.as_deref(), "mesh", m);
        let targets = target_count(mesh);
        weights_of[m] = deformers::default_weights(mesh, targets, &format!("meshes[{m}]"))?;
        for (p, primitive) in mesh.primitives.iter().enumerate() {
            let name = if mesh.primitives.len() == 1 { mesh_name.clone() } else { format!("{mesh_name} [{p}]") };
            let place = format!("meshes[{m}].primitives[{p}]");
            let found = primitive.targets.as_ref().map_or(0, Vec::len);
            if is_triangles(primitive) && found != targets {
                let message = format!("expected {targets}, as many as the mesh's other primitives have, found {found}");
                return Err(fault(format!("{place}.targets"), message));
            }
            let Some(plan) = plan(document, primitive, place, name, skinned[m], materials, warnings)? else { continue };
            let deformer = plan.deformer.as_ref().map(|key| planned_deformers.add(key, &plan.place));
            vertices.add((plan.key.positions, plan.key.normals));
            let vertices = vertices.places[&(plan.key.positions, plan.key.normals)];
            let next = planned.len();
            let mesh = *known.entry((plan.key, deformer)).or_insert(next);
            if mesh == next {
                planned.push(plan);
            }
            meshes_of[m].push(Part { mesh, deformer, vertices });
        }
    }
    check_budget(document, &planned)?;
    let mut meshes = decode(document, planned, warnings)?;
    let deformers = deformers::decode(document, planned_deformers)?;

    // A mesh without triangles is no mesh.
    let mut kept = Vec::with_capacity(meshes.len());
    let mut next = 0;
    for mesh in &meshes {
        let empty = mesh.triangles.is_empty();
        kept.push((!empty).then_some(next));
        next += usize::from(!empty);
    }
    meshes.retain(|mesh| !mesh.triangles.is_empty());
    for parts in &mut meshes_of {
        *parts = parts.iter().filter_map(|&part| Some(Part { mesh: kept[part.mesh]?, ..part })).collect();
    }
    Ok(Geometry { meshes, meshes_of, deformers, weights_of })
}

/// Finds and checks a primitive's accessors; none for what has no triangles.
fn plan(
    document: &Document,
    primitive: &Primitive,
    place: String,
    name: String,
    skinned: bool,
    materials: &[Source],
    warnings: &mut Warnings,
) -> Parsed<Option<Planned>> {
    let Checked::Valid(mode) = primitive.mode else {
        return Err(fault(format!("{place}.mode"), "expected 0 to 6"));
    };
    if !is_triangles(primitive) {
        warnings.add("points and lines are skipped", &name);
        return Ok(None);
    }
    let attribute = |semantic| primitive.attributes.get(&Checked::Valid(semantic)).map(|index| index.value());
    let Some(positions) = attribute(Semantic::Positions) else {
        warnings.add("skipped, for it has no POSITION", &name);
        return Ok(None);
    };
    let at = |member: &str| format!("{place}.{member}");
    let accessor = |index, member: &str| Accessor::new(document, index, || at(member));

    let member = "attributes.POSITION";
    let compressed = primitive.extensions.as_ref().is_some_and(|e| e.others.contains_key("KHR_draco_mesh_compression"));
    let accessors = &document.root.accessors;
    if compressed && accessors.get(positions).is_some_and(|positions| positions.buffer_view.is_none()) {
        return Err(fault(
            at("extensions.KHR_draco_mesh_compression"),
            "not supported, and there is no uncompressed copy",
        ));
    }
    let position_accessor = accessor(positions, member)?;
    position_accessor.expect(Type::Vec3, &QUANTIZED_OR_FLOAT, || at(member))?;
    let vertices = position_accessor.count;

    let normals = attribute(Semantic::Normals);
    if let Some(normals) = normals {
        let member = "attributes.NORMAL";
        let normals = accessor(normals, member)?;
        normals.expect(Type::Vec3, &[ComponentType::F32, ComponentType::I8, ComponentType::I16], || at(member))?;
        normals.expect_count(vertices, || at(member))?;
    }

    let material = primitive.material.map(|material| material.value());
    let tex_coords = material.and_then(|material| materials[material].tex_coords);
    let uvs = match tex_coords.map(|tex_coords| (tex_coords, attribute(Semantic::TexCoords(tex_coords.set)))) {
        Some((tex_coords, Some(index))) => {
            let member = format!("attributes.TEXCOORD_{}", tex_coords.set);
            let uvs = accessor(index, &member)?;
            uvs.expect(Type::Vec2, &QUANTIZED_OR_FLOAT, || at(&member))?;
            uvs.expect_count(vertices, || at(&member))?;
            Some(Uvs::Accessor(index, tex_coords))
        }
        Some((_, None)) => {
            warnings.add("textured without texture coordinates (0, 0 is taken)", &name);
            Some(Uvs::Missing(vertices))
        }
        None => None,
    };

    let indices = primitive.indices.map(|index| index.value());
    let corners = match indices {
        Some(index) => {
            let accessor = accessor(index, "indices")?;
            let components = [ComponentType::U8, ComponentType::U16, ComponentType::U32];
            accessor.expect(Type::Scalar, &components, || at("indices"))?;
            accessor.count
        }
        None => vertices,
    };
    if u32::try_from(vertices).is_err() {
        return Err(fault(at(member), format!("{vertices} vertices are more than an index can tell apart")));
    }
    if mode == Mode::Triangles && !corners.is_multiple_of(3) {
        warnings.add("corners beyond the last whole triangle are ignored", &name);
    }
    let triangles = if mode == Mode::Triangles { corners / 3 } else { corners.saturating_sub(2) };
    let key = Key { positions, normals, uvs, indices, mode: mode.as_gl_enum(), material };
    let deformer = deformers::plan(document, primitive, vertices, skinned, &place)?;
    Ok(Some(Planned { key, place, name, vertices, triangles: triangles as u64, deformer }))
}

/// What core glTF and KHR_mesh_quantization allow for positions and texture coordinates.
const QUANTIZED_OR_FLOAT: [ComponentType; 5] =
    [ComponentType::F32, ComponentType::I8, ComponentType::U8, ComponentType::I16, ComponentType::U16];

/// Faults where few bytes claim to be many triangles: by accessors without data, or by many uses of the same data.
fn check_budget(document: &Document, planned: &[Planned]) -> Parsed<()> {
    let budget = FREE_ELEMENTS.saturating_add(document.size.saturating_mul(ELEMENTS_PER_BYTE));
    let (mut positions, mut normals, mut uvs) = (Distinct::default(), Distinct::default(), Distinct::default());
    let mut deformers = deformers::Counted::default();
    let mut elements = 0u64;
    for plan in planned {
        let decoded = [
            positions.add(plan.key.positions),
            plan.key.normals.is_some_and(|index| normals.add(index)),
            plan.key.uvs.is_some_and(|source| uvs.add(source)),
        ];
        let vertices = decoded.iter().filter(|&&new| new).count() as u64 * plan.vertices as u64;
        elements = elements.saturating_add(plan.triangles).saturating_add(vertices);
        if let Some(key) = &plan.deformer {
            elements = elements.saturating_add(deformers.add(document, key, plan.vertices)?);
        }
        if elements > budget {
            let message = format!(
                "too much geometry for its size: with this, {elements} vertices and triangles, and a file of {} bytes may \
                 have {budget}",
                document.size
            );
            return Err(fault(&plan.place, message));
        }
    }
    Ok(())
}

/// Items in the order in which they were first added.
pub(super) struct Distinct<T> {
    pub places: HashMap<T, usize>,
    pub items: Vec<T>,
}

impl<T> Default for Distinct<T> {
    fn default() -> Self {
        Self { places: HashMap::new(), items: Vec::new() }
    }
}

impl<T: Hash + Eq + Copy> Distinct<T> {
    /// Whether it is new.
    pub fn add(&mut self, item: T) -> bool {
        let next = self.items.len();
        let new = *self.places.entry(item).or_insert(next) == next;
        if new {
            self.items.push(item);
        }
        new
    }
}

/// Decodes in parallel each distinct accessor, then each mesh's triangles. Faults come in file order whatever the threads do.
fn decode(document: &Document, planned: Vec<Planned>, warnings: &mut Warnings) -> Parsed<Vec<Mesh>> {
    let mut positions = Distinct::default();
    let mut normals = Distinct::default();
    let mut uvs = Distinct::default();
    let mut first_use = Vec::new();
    for plan in &planned {
        if positions.add(plan.key.positions) {
            first_use.push(&plan.place);
        }
        if let Some(index) = plan.key.normals {
            normals.add(index);
        }
        if let Some(source) = plan.key.uvs {
            uvs.add(source);
        }
    }
    // Found and checked before: the place can't be needed.
    let accessor = |index| Accessor::new(document, index, String::new);
    let decoded_positions = in_order(positions.items.par_iter().zip(&first_use).map(|(&index, place)| {
        let positions = accessor(index)?.floats(Vec3::from_array)?;
        let good = |p: &Vec3| p.abs().max_element() <= MAX_COORDINATE as f32 && !p.is_nan();
        match positions.iter().position(|p| !good(p)) {
            Some(bad) => {
                let [x, y, z] = positions[bad].to_array();
                let message = format!("position {bad} is ({x}, {y}, {z}): expected at most {MAX_COORDINATE:e}");
                Err(fault(format!("{place}.attributes.POSITION"), message))
            }
            None => Ok(positions),
        }
    }))?;
    let decoded_normals =
        in_order(normals.items.par_iter().map(|&index| Ok(unit(accessor(index)?.floats(Vec3::from_array)?))))?;
    let decoded_uvs = in_order(uvs.items.par_iter().map(|&source| match source {
        Uvs::Accessor(index, tex_coords) => {
            let transform = tex_coords.transform();
            accessor(index)?.floats(|uv| transform.transform_point2(Vec2::from_array(uv)))
        }
        Uvs::Missing(count) => Ok(std::iter::repeat_n(Vec2::ZERO, count).collect()),
    }))?;

    for plan in &planned {
        if plan.key.normals.is_some_and(|index| decoded_normals[normals.places[&index]].is_none()) {
            warnings.add("shaded flat, for it has normals of no direction", &plan.name);
        }
    }
    in_order(planned.into_par_iter().map(|plan| {
        let triangles = match plan.key.indices {
            Some(index) => {
                let indices = accessor(index)?.indices()?;
                if let Some(bad) = indices.iter().position(|&index| index as usize >= plan.vertices) {
                    let message = format!("index {bad} is {}: expected below {}", indices[bad], plan.vertices);
                    return Err(fault(format!("{}.indices", plan.place), message));
                }
                triangles(plan.key.mode, indices.len(), |corner| indices[corner])
            }
            None => triangles(plan.key.mode, plan.vertices, |corner| corner as u32),
        };
        Ok(Mesh {
            name: plan.name,
            positions: decoded_positions[positions.places[&plan.key.positions]].clone(),
            normals: plan.key.normals.and_then(|index| decoded_normals[normals.places[&index]].clone()),
            uvs: plan.key.uvs.map(|source| decoded_uvs[uvs.places[&source]].clone()),
            triangles,
            material: plan.key.material,
        })
    }))
}

/// All results, or the first fault.
pub(super) fn in_order<T: Send>(results: impl IndexedParallelIterator<Item = Parsed<T>>) -> Parsed<Vec<T>> {
    let results: Vec<Parsed<T>> = results.collect();
    results.into_iter().collect()
}

/// Normals of unit length; none when one of them has no direction.
fn unit(mut normals: Arc<[Vec3]>) -> Option<Arc<[Vec3]>> {
    for normal in Arc::get_mut(&mut normals).into_iter().flatten() {
        *normal = normal.as_dvec3().try_normalize()?.as_vec3();
    }
    Some(normals)
}

/// The triangles of a list, strip or fan (glTF 2.0, 3.7.2.1). Those that join the parts of a strip are left out.
fn triangles(mode: u32, corners: usize, index: impl Fn(usize) -> u32) -> Vec<[u32; 3]> {
    match mode {
        TRIANGLE_STRIP => (2..corners)
            .map(|i| [index(i - 2), index(i - 1 + i % 2), index(i - i % 2)])
            .filter(|[a, b, c]| a != b && b != c && c != a)
            .collect(),
        TRIANGLE_FAN => (2..corners).map(|i| [index(i - 1), index(i), index(0)]).collect(),
        _ => (0..corners / 3).map(|i| [index(3 * i), index(3 * i + 1), index(3 * i + 2)]).collect(),
    }
}
