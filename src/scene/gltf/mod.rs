//! glTF 2.0 and GLB.
//!
//! Nothing in a file is believed: every index, range and size is checked before it is used, and a fault is one
//! [`Error::Scene`] that names the place. `gltf::json` gives the types; neither the crate's validation (it refuses
//! KHR_mesh_quantization) nor its readers (they panic on bad ranges) are used.
//!
//! Memory and time are bounded by the size of the file, JSON and buffers together: 2²⁰ vertices and triangles and 4 more for
//! each byte, as many again of deformed meshes in a pose, 2²⁰ numbers of keys and 4 more for each byte, 2²⁰ instances and 1 more
//! for each byte, 2²⁶ texels and 256 more for each byte of image files, 2¹⁶ lights. Files whose accessors don't share their bytes
//! stay below by themselves.

mod accessor;
mod animation;
mod deformers;
mod document;
mod geometry;
mod hierarchy;
mod lights;
mod materials;
mod model;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use glam::{DAffine3, DVec3};
use gltf::json::accessor::{ComponentType, Type};
use gltf::json::validation::Checked;
use gltf::json::{Root, camera};
use serde::Deserialize;

use self::accessor::Accessor;
use self::document::{Document, Fault, Parsed, extension, fault, item, one_line, quoted};
use self::hierarchy::{Hierarchy, rotation_of};
pub(super) use self::model::Model;
use super::animation::Animated;
use super::{Camera, LoadOptions, MAX_COORDINATE, Projection, Scene, UniqueNames};
use crate::{Error, Result};

/// What a file of no size may have of anything that few bytes can multiply.
const FREE_ELEMENTS: u64 = 1 << 20;

/// Loads a .gltf or .glb file with all that it refers to, as its nodes pose it.
pub fn load(path: &Path, options: LoadOptions) -> Result<Scene> {
    let (bytes, name) = read(path)?;
    load_slice(&bytes, Some(directory_of(path)), &name, options)
}

/// Loads a .gltf or .glb from memory, as its nodes pose it. Relative URIs are looked up in `base_dir`; without one they are an
/// error. `name` stands for the file in messages.
pub fn load_slice(bytes: &[u8], base_dir: Option<&Path>, name: &str, options: LoadOptions) -> Result<Scene> {
    let load = || {
        let document = Document::parse(bytes, base_dir)?;
        let is_animated = !document.animations.is_empty();
        let (_, _, mut scene) = Model::new(document, name, options, false)?;
        if is_animated {
            scene.warnings.push(NOT_PLAYED.into());
        }
        Ok(scene)
    };
    load().map_err(|fault| error(name, &fault))
}

/// Loads a .gltf or .glb file with its animations.
pub fn load_animated(path: &Path, options: LoadOptions) -> Result<Animated> {
    let (bytes, name) = read(path)?;
    load_animated_slice(&bytes, Some(directory_of(path)), &name, options)
}

/// Loads a .gltf or .glb with its animations from memory; see [`load_slice`].
pub fn load_animated_slice(
    bytes: &[u8],
    base_dir: Option<&Path>,
    name: &str,
    options: LoadOptions,
) -> Result<Animated> {
    let load = || {
        let (model, clips, _) = Model::new(Document::parse(bytes, base_dir)?, name, options, true)?;
        Ok(Animated::gltf(model, clips))
    };
    load().map_err(|fault| error(name, &fault))
}

/// What a file's animations come to where none is asked for.
const NOT_PLAYED: &str = "rendered at the pose of the file's nodes: --frames renders its animation";

fn read(path: &Path) -> Result<(Vec<u8>, String)> {
    let is_file = path.metadata().map_err(|error| Error::io(path, error))?.is_file();
    if !is_file {
        return Err(Error::io(path, std::io::Error::other("not a regular file")));
    }
    let bytes = std::fs::read(path).map_err(|error| Error::io(path, error))?;
    Ok((bytes, path.display().to_string()))
}

fn directory_of(path: &Path) -> &Path {
    path.parent().unwrap_or(Path::new(""))
}

/// A fault as users see it.
fn error(name: &str, fault: &Fault) -> Error {
    Error::Scene { path: name.into(), place: one_line(&fault.place, 200), message: one_line(&fault.message, 400) }
}

/// Remarks about a file: one line for each kind, with the names of what it is about.
#[derive(Debug, Clone, Default)]
struct Warnings {
    remarks: Vec<Remark>,
}

/// A remark and what it is about.
#[derive(Debug, Clone)]
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

/// `EXT_mesh_gpu_instancing` at a node.
#[derive(Deserialize)]
struct GpuInstancing {
    attributes: BTreeMap<String, u32>,
}

/// Decoded attributes of `EXT_mesh_gpu_instancing`.
#[derive(Debug)]
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

fn cameras(root: &Root, hierarchy: &Hierarchy) -> Parsed<Vec<Camera>> {
    let mut cameras = Vec::new();
    let mut names = UniqueNames::default();
    for &node in &hierarchy.shown {
        let json = &root.nodes[node];
        let Some(index) = json.camera.map(|camera| camera.value()) else { continue };
        let camera = item(&root.cameras, "cameras", index, || format!("nodes[{node}].camera"))?;
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
