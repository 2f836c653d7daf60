//! glTF 2.0 and GLB.
//!
//! Nothing in a file is believed: every index, range and size is checked before it is used, and a fault is one
//! [`Error::Scene`] that names the place. `gltf::json` gives the types; neither the crate's validation (it refuses
//! KHR_mesh_quantization) nor its readers (they panic on bad ranges) are used.
//!
//! Memory and time are bounded by the size of the file, JSON and buffers together: 2²⁰ vertices and triangles and 4 more for
//! each byte, 2²⁰ instances and 1 more for each byte, 2²⁶ texels and 256 more for each byte of image files, 2¹⁶ lights. Files
//! whose accessors don't share their bytes stay below by themselves.

mod accessor;
mod document;
mod geometry;
mod hierarchy;
mod lights;
mod materials;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use glam::{DAffine3, DVec3};
use gltf::json::accessor::{ComponentType, Type};
use gltf::json::camera;
use gltf::json::validation::Checked;
use serde::Deserialize;

use self::accessor::Accessor;
use self::document::{Document, Parsed, extension, fault, item, one_line, quoted};
use self::geometry::Geometry;
use self::hierarchy::{Hierarchy, check_transform, rotation_of};
use super::{Bounds, Camera, Instance, LoadOptions, MAX_COORDINATE, Mesh, Node, Projection, Scene, UniqueNames};
use crate::{Error, Result};

/// What a file of no size may have of anything that few bytes can multiply.
const FREE_ELEMENTS: u64 = 1 << 20;

/// Loads a .gltf or .glb file with all that it refers to.
pub fn load(path: &Path, options: LoadOptions) -> Result<Scene> {
    let name = path.display().to_string();
    let is_file = path.metadata().map_err(|error| Error::io(path, error))?.is_file();
    if !is_file {
        return Err(Error::io(path, std::io::Error::other("not a regular file")));
    }
    let bytes = std::fs::read(path).map_err(|error| Error::io(path, error))?;
    load_slice(&bytes, Some(path.parent().unwrap_or(Path::new(""))), &name, options)
}

/// Loads a .gltf or .glb from memory. Relative URIs are looked up in `base_dir`; without one they are an error. `name` stands
/// for the file in messages.
pub fn load_slice(bytes: &[u8], base_dir: Option<&Path>, name: &str, options: LoadOptions) -> Result<Scene> {
    let scene = Document::parse(bytes, base_dir).and_then(|document| build(&document, name, options));
    let mut scene = scene.map_err(|fault| Error::Scene {
        path: name.into(),
        place: one_line(&fault.place, 200),
        message: one_line(&fault.message, 400),
    })?;
    scene.rebase();
    Ok(scene)
}

/// Remarks about a file: one line for each kind, with the names of what it is about.
#[derive(Default)]
struct Warnings {
    remarks: Vec<Remark>,
}

/// A remark and what it is about.
struct Remark {
    what: &'static str,
    /// The first few names, each once.
    names: Vec<String>,
    /// How many came after them.
    more: usize,
}

impl Warnings {
    /// Adds `name` to the remark `what`.
    fn add(&mut self, what: &'static str, name: &str) {
        let known = self.remarks.iter().position(|remark| remark.what == what);
        let at = known.unwrap_or_else(|| {
            self.remarks.push(Remark { what, names: Vec::new(), more: 0 });
            self.remarks.len() - 1
        });
        let remark = &mut self.remarks[at];
        let name = quoted(name);
        if remark.names.contains(&name) {
            return;
        }
        if remark.names.len() < 4 {
            remark.names.push(name);
        } else {
            remark.more += 1;
        }
    }

    fn lines(self) -> Vec<String> {
        let line = |remark: Remark| match remark.more {
            0 => format!("{}: {}", remark.names.join(", "), remark.what),
            more => format!("{} and {more} more: {}", remark.names.join(", "), remark.what),
        };
        self.remarks.into_iter().map(line).collect()
    }
}

/// A name from a file, on one line of at most 200 characters (it may be repeated many times), or `kind index` where it has none.
fn name_or(name: Option<&str>, kind: &str, index: usize) -> String {
    match name {
        Some(name) if !name.is_empty() => one_line(name, 200),
        _ => format!("{kind} {index}"),
    }
}

/// The scene in world space.
fn build(document: &Document, name: &str, options: LoadOptions) -> Parsed<Scene> {
    let root = &document.root;
    let mut warnings = Warnings::default();
    let hierarchy = Hierarchy::new(root)?;
    let shown_meshes = geometry::shown_meshes(document, &hierarchy)?;
    let used_materials = geometry::used_materials(document, &shown_meshes)?;
    let materials = materials::load(document, options, &used_materials, &mut warnings)?;
    let geometry = geometry::load(document, &shown_meshes, &materials, &mut warnings)?;

    let nodes = root.nodes.iter().zip(&hierarchy.parents).enumerate();
    // In full, for exclusion lists refer to them.
    let nodes = nodes.map(|(i, (node, &parent))| {
        let name = node.name.clone().filter(|name| !name.is_empty());
        Node { name: name.unwrap_or_else(|| format!("node {i}")), parent }
    });
    let instances = instances(document, &hierarchy, &geometry)?;
    let mut scene = Scene {
        name: name.into(),
        nodes: nodes.collect(),
        meshes: geometry.meshes,
        instances,
        cameras: cameras(document, &hierarchy)?,
        ..Scene::default()
    };
    let lights = lights::load(document, &hierarchy, &materials, &scene, &mut warnings)?;
    scene.add_lights(lights);
    scene.materials = materials.into_iter().map(|source| source.material).collect();

    for &node in &hierarchy.shown {
        if root.nodes[node].skin.is_some() {
            warnings.add("skins are not applied (the bind pose is shown)", &scene.nodes[node].name);
        }
    }
    scene.warnings = warnings.lines();
    if document.animated {
        scene.warnings.push("animations are not played: nodes stay where the file puts them".into());
    }
    if scene.instances.is_empty() {
        scene.warnings.push("the scene has no triangles: nothing will be seen".into());
    }
    Ok(scene)
}

/// `EXT_mesh_gpu_instancing` at a node.
#[derive(Deserialize)]
struct GpuInstancing {
    attributes: BTreeMap<String, u32>,
}

/// The uses of meshes, in the order of their nodes.
fn instances(document: &Document, hierarchy: &Hierarchy, geometry: &Geometry) -> Parsed<Vec<Instance>> {
    let bounds: Vec<Bounds> = geometry.meshes.iter().map(Mesh::bounds).collect();
    let budget = FREE_ELEMENTS.saturating_add(document.size);
    let mut instances = Vec::new();
    for &node in &hierarchy.shown {
        let json = &document.root.nodes[node];
        let meshes = json.mesh.map_or(&[][..], |mesh| &geometry.meshes_of[mesh.value()]);
        if meshes.is_empty() {
            continue;
        }
        let copies = copies(document, node)?;
        let more = copies.as_ref().map_or(1, |copies| copies.count) as u64 * meshes.len() as u64;
        if instances.len() as u64 + more > budget {
            let message =
                format!("too many instances for its size: a file of {} bytes may have {budget}", document.size);
            return Err(fault(format!("nodes[{node}]"), message));
        }
        let world_from_node = hierarchy.world(node)?;
        let mut add = |world_from_mesh: DAffine3, place: &dyn Fn() -> String| {
            check_transform(&world_from_mesh, place)?;
            for &mesh in meshes {
                let corners = bounds[mesh].corners().map(|corner| world_from_mesh.transform_point3(corner));
                if corners.iter().any(|corner| corner.abs().max_element() > MAX_COORDINATE) {
                    let message = format!("its geometry goes beyond {MAX_COORDINATE:e} in world space");
                    return Err(fault(place(), message));
                }
                instances.push(Instance { mesh, node, scene_from_mesh: world_from_mesh });
            }
            Ok(())
        };
        match copies {
            None => add(world_from_node, &|| format!("nodes[{node}]"))?,
            Some(copies) => {
                for i in 0..copies.count {
                    let place = || format!("nodes[{node}].extensions.EXT_mesh_gpu_instancing, instance {i}");
                    add(world_from_node * copies.transform(i, place)?, &place)?;
                }
            }
        }
    }
    Ok(instances)
}

/// Decoded attributes of `EXT_mesh_gpu_instancing`.
struct Copies {
    count: usize,
    translations: Option<Arc<[DVec3]>>,
    rotations: Option<Arc<[[f32; 4]]>>,
    scales: Option<Arc<[DVec3]>>,
}

impl Copies {
    /// Node space from mesh space of one copy.
    fn transform(&self, i: usize, place: impl FnOnce() -> String) -> Parsed<DAffine3> {
        let translation = self.translations.as_ref().map_or(DVec3::ZERO, |all| all[i]);
        let scale = self.scales.as_ref().map_or(DVec3::ONE, |all| all[i]);
        let rotation = rotation_of(self.rotations.as_ref().map_or([0.0, 0.0, 0.0, 1.0], |all| all[i]));
        match rotation {
            Some(rotation) => Ok(DAffine3::from_scale_rotation_translation(scale, rotation, translation)),
            None => Err(fault(place(), "expected a unit quaternion for ROTATION")),
        }
    }
}

/// The copies of a node's mesh; none: the node is no `EXT_mesh_gpu_instancing`.
fn copies(document: &Document, node: usize) -> Parsed<Option<Copies>> {
    let extensions = document.root.nodes[node].extensions.as_ref();
    let Some(value) = extensions.and_then(|extensions| extensions.others.get("EXT_mesh_gpu_instancing")) else {
        return Ok(None);
    };
    let place = format!("nodes[{node}].extensions.EXT_mesh_gpu_instancing");
    let instancing: GpuInstancing = extension(value, &place)?;
    let mut count = None;
    let mut attribute = |name: &str, index: u32| {
        let at = || format!("{place}.attributes.{name}");
        let accessor = Accessor::new(document, index as usize, at)?;
        accessor.expect_count(*count.get_or_insert(accessor.count), at)?;
        Ok(accessor)
    };
    let mut accessors = BTreeMap::new();
    for (name, &index) in &instancing.attributes {
        accessors.insert(name.as_str(), attribute(name, index)?);
    }
    let Some(count) = count else {
        return Err(fault(format!("{place}.attributes"), "expected TRANSLATION, ROTATION or SCALE"));
    };
    // Without data in the file there is nothing that bounds the count.
    if count as u64 > FREE_ELEMENTS.saturating_add(document.size) {
        return Err(fault(place, format!("{count} instances are too many for a file of {} bytes", document.size)));
    }
    let vectors = |name: &str| match accessors.get(name) {
        Some(accessor) => {
            accessor.expect(Type::Vec3, &[ComponentType::F32], || format!("{place}.attributes.{name}"))?;
            accessor.floats(|v| DVec3::from(v.map(f64::from))).map(Some)
        }
        None => Ok(None),
    };
    let rotations = match accessors.get("ROTATION") {
        Some(accessor) => {
            let components = [ComponentType::F32, ComponentType::I8, ComponentType::I16];
            accessor.expect(Type::Vec4, &components, || format!("{place}.attributes.ROTATION"))?;
            Some(accessor.floats(|v| v)?)
        }
        None => None,
    };
    Ok(Some(Copies { count, translations: vectors("TRANSLATION")?, rotations, scales: vectors("SCALE")? }))
}

fn cameras(document: &Document, hierarchy: &Hierarchy) -> Parsed<Vec<Camera>> {
    let mut cameras = Vec::new();
    let mut names = UniqueNames::default();
    for &node in &hierarchy.shown {
        let json = &document.root.nodes[node];
        let Some(index) = json.camera.map(|camera| camera.value()) else { continue };
        let camera = item(&document.root.cameras, "cameras", index, || format!("nodes[{node}].camera"))?;
        let (projection, near, far) = projection(camera, index)?;
        let named = camera.name.as_deref().filter(|name| !name.is_empty());
        cameras.push(Camera {
            name: names.take(&name_or(named.or(json.name.as_deref()), "camera", index)),
            scene_from_camera: hierarchy.rigid(node)?,
            projection,
            near,
            far,
        });
    }
    Ok(cameras)
}

/// How a camera projects, and its near and far distances.
fn projection(camera: &camera::Camera, index: usize) -> Parsed<(Projection, f64, f64)> {
    let place = |member: &str| format!("cameras[{index}].{member}");
    let missing = |member: &str| fault(place(member), "missing");
    let (projection, near, far, member) = match camera.type_ {
        Checked::Valid(camera::Type::Perspective) => {
            let json = camera.perspective.as_ref().ok_or_else(|| missing("perspective"))?;
            let fov_y = f64::from(json.yfov);
            if !(fov_y > 0.0 && fov_y < std::f64::consts::PI) {
                let message = format!("expected more than 0 and less than π, found {fov_y}");
                return Err(fault(place("perspective.yfov"), message));
            }
            let far = json.zfar.map_or(f64::INFINITY, f64::from);
            (Projection::Perspective { fov_y }, json.znear, far, "perspective")
        }
        Checked::Valid(camera::Type::Orthographic) => {
            let json = camera.orthographic.as_ref().ok_or_else(|| missing("orthographic"))?;
            let half_height = f64::from(json.ymag);
            if !(half_height > 0.0 && half_height <= MAX_COORDINATE) {
                let message = format!("expected a positive number, found {half_height}");
                return Err(fault(place("orthographic.ymag"), message));
            }
            (Projection::Orthographic { half_height }, json.znear, f64::from(json.zfar), "orthographic")
        }
        Checked::Invalid => return Err(fault(place("type"), "expected perspective or orthographic")),
    };
    let near = f64::from(near);
    if !(near >= 0.0 && near < far) {
        let message = format!("expected 0 <= znear < zfar, found {near} and {far}");
        return Err(fault(place(member), message));
    }
    Ok((projection, near, far))
}
