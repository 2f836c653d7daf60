//! A decoded file, and the scenes that it makes: one for each pose of its nodes.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use glam::{DAffine3, DMat3};
use gltf::json::Root;
use rayon::prelude::*;

use super::deformers::{Skin, checked_weights};
use super::document::{Document, Parsed, fault};
use super::geometry::{ELEMENTS_PER_BYTE, Geometry, Part, in_order};
use super::hierarchy::{Hierarchy, check_transform};
use super::materials::Source;
use super::{
    Copies, FREE_ELEMENTS, Warnings, animation, cameras, copies, deformers, error, geometry, lights, materials,
};
use crate::Result;
use crate::scene::animation::{Clip, Pose, Vertices};
use crate::scene::{Bounds, Instance, LoadOptions, MAX_COORDINATE, Mesh, Node, Scene};

/// A decoded file without its buffers.
pub(in crate::scene) struct Model {
    name: String,
    root: Root,
    /// See [`Document::size`].
    size: u64,
    /// As the file poses its nodes.
    hierarchy: Hierarchy,
    nodes: Vec<Node>,
    geometry: Geometry,
    materials: Vec<Source>,
    /// Those that shown nodes have, by index.
    skins: HashMap<usize, Skin>,
    /// By node.
    copies: BTreeMap<usize, Copies>,
    sides: lights::Sides,
    /// What there is to say of every pose.
    warnings: Warnings,
}

impl std::fmt::Debug for Model {
    fn fmt(&self, formatter: &mut std::fmt::Formatter) -> std::fmt::Result {
        formatter.debug_struct("Model").field("name", &self.name).finish_non_exhaustive()
    }
}

/// Deforming may take this many steps for each byte of the file, beyond [`FREE_ELEMENTS`]: displacements and joints applied, for
/// each mesh that is deformed differently. A crowd of 60 morphing heads in one file, each in its own way, stays below.
const STEPS_PER_BYTE: u64 = 64;

/// What makes deformed vertices differ.
#[derive(PartialEq, Eq, Hash, Clone)]
struct Deformation {
    /// [`Part::vertices`].
    vertices: usize,
    deformer: usize,
    /// Bits of the morph targets' weights.
    weights: Arc<[u64]>,
    skin: Option<usize>,
}

/// A mesh as instances show it, and the deformation that made it.
type Variant = (usize, Option<usize>);

/// What nodes show in a pose.
#[derive(Default)]
struct Shown {
    /// Each with a mesh that it is for and a node that has it, for messages.
    deformations: Vec<(Deformation, Part, usize)>,
    known_deformations: HashMap<Deformation, usize>,
    /// By mesh of the file's [`Geometry`], in the order of first use.
    variants: Vec<Vec<Option<usize>>>,
    known_variants: HashMap<Variant, usize>,
    /// For each shown node with triangles, its meshes: of the geometry, and which of its variants.
    uses: Vec<(usize, Vec<(usize, usize)>)>,
}

impl Model {
    /// Decodes a document, with its animations if they are wanted; also the scene that the file's own pose makes.
    pub(super) fn new(
        mut document: Document,
        name: &str,
        options: LoadOptions,
        animated: bool,
    ) -> Parsed<(Self, Vec<Clip>, Scene)> {
        let root = &document.root;
        let mut warnings = Warnings::default();
        let hierarchy = Hierarchy::new(root)?;
        let shown_meshes = geometry::shown_meshes(&document, &hierarchy)?;
        let skinned = deformers::skinned_meshes(root, &hierarchy);
        let used_materials = geometry::used_materials(&document, &shown_meshes)?;
        let materials = materials::load(&document, options, &used_materials, &mut warnings)?;
        let geometry = geometry::load(&document, &shown_meshes, &skinned, &materials, &mut warnings)?;
        let skins = deformers::skins(&document, &hierarchy, &geometry)?;
        let copies = all_copies(&document, &hierarchy, &geometry)?;
        for &node in copies.keys().filter(|&&node| root.nodes[node].skin.is_some()) {
            let name = root.nodes[node].name.as_deref().unwrap_or_default();
            warnings.add("EXT_mesh_gpu_instancing of a skinned mesh is not defined (one is shown)", name);
        }
        let clips = if animated { animation::clips(&document, &mut warnings)? } else { Vec::new() };

        let nodes = root.nodes.iter().zip(&hierarchy.parents).enumerate();
        // In full, for exclusion lists refer to them.
        let nodes = nodes.map(|(i, (node, &parent))| {
            let name = node.name.clone().filter(|name| !name.is_empty());
            Node { name: name.unwrap_or_else(|| format!("node {i}")), parent }
        });
        let nodes = nodes.collect();
        let mut model = Self {
            name: name.into(),
            nodes,
            root: std::mem::take(&mut document.root),
            size: document.size,
            hierarchy,
            geometry,
            materials,
            skins,
            copies,
            sides: lights::Sides::new(),
            warnings,
        };
        // Nothing below needs the file's bytes.
        drop(document);
        let mut sides = lights::Sides::new();
        let scene = model.scene(&model.hierarchy, &Pose::default(), &mut sides)?;
        model.sides = sides;
        Ok((model, clips, scene))
    }

    /// The scene in the file's own pose.
    pub fn rest(&self) -> Result<Scene> {
        self.scene(&self.hierarchy, &Pose::default(), &mut self.sides.clone())
            .map_err(|fault| error(&self.name, &fault))
    }

    /// The scene at a time of a clip.
    pub fn pose(&self, clip: &Clip, seconds: f64) -> Result<Scene> {
        let scene = || {
            let pose = clip.pose(seconds).map_err(|channel| {
                let message = "its cubic spline passes through 0, 0, 0, 0, which is no rotation";
                fault(format!("nodes[{}].rotation", clip.channels[channel].node), message)
            })?;
            let hierarchy = self.hierarchy.posed(&self.root, &pose)?;
            self.scene(&hierarchy, &pose, &mut self.sides.clone())
        };
        scene().map_err(|mut fault| {
            fault.place = format!("{} at {seconds} s of animation {:?}", fault.place, clip.name);
            error(&self.name, &fault)
        })
    }

    fn scene(&self, hierarchy: &Hierarchy, pose: &Pose, sides: &mut lights::Sides) -> Parsed<Scene> {
        let mut warnings = self.warnings.clone();
        let shown = self.shown(hierarchy, pose, &mut warnings)?;
        let meshes = self.meshes(hierarchy, &shown)?;
        let instances = self.instances(hierarchy, &shown, &meshes)?;
        let mut scene = Scene {
            name: self.name.clone(),
            nodes: self.nodes.clone(),
            meshes,
            instances,
            cameras: cameras(&self.root, hierarchy)?,
            ..Scene::default()
        };
        let lights = lights::load(&self.root, hierarchy, &self.materials, &scene, sides, &mut warnings)?;
        scene.add_lights(lights);
        scene.materials = self.materials.iter().map(|source| source.material.clone()).collect();
        scene.warnings = warnings.lines();
        if scene.instances.is_empty() {
            scene.warnings.push("the scene has no triangles: nothing will be seen".into());
        }
        scene.rebase();
        Ok(scene)
    }

    /// Which meshes the nodes show, and how they are deformed. Nodes that are scaled to nothing in all directions, which is how
    /// animations hide things, show none.
    fn shown(&self, hierarchy: &Hierarchy, pose: &Pose, warnings: &mut Warnings) -> Parsed<Shown> {
        let mut shown = Shown { variants: vec![Vec::new(); self.geometry.meshes.len()], ..Shown::default() };
        let mut cost = Cost::new(self.size);
        for &node in &hierarchy.shown {
            let json = &self.root.nodes[node];
            let Some(mesh) = json.mesh.map(|mesh| mesh.value()) else { continue };
            let parts = &self.geometry.meshes_of[mesh];
            let place = || format!("nodes[{node}]");
            let skin = json.skin.map(|skin| skin.value());
            if skin.is_none() && hierarchy.world_from_node[node].matrix3 == DMat3::ZERO {
                warnings.add("scaled to nothing: not shown", &self.nodes[node].name);
                continue;
            }
            let defaults = &self.geometry.weights_of[mesh];
            cost.add_steps(defaults.len() as u64, place)?;
            let posed = pose.nodes.get(&node).and_then(|node| node.weights.as_ref());
            let of_node =
                json.weights.as_ref().map(|all| checked_weights(all, defaults.len(), &format!("{}.weights", place())));
            let of_node = of_node.transpose()?;
            let weights = posed.or(of_node.as_ref()).unwrap_or(defaults);
            let bits: Arc<[u64]> = weights.iter().map(|weight| weight.to_bits()).collect();
            let is_morphed = weights.iter().any(|&weight| weight != 0.0);
            let mut uses = Vec::with_capacity(parts.len());
            for part in parts {
                let deformer = part.deformer.filter(|_| skin.is_some() || is_morphed);
                let deformation = match deformer {
                    Some(deformer) => {
                        let weights = Arc::clone(&bits);
                        let deformation = Deformation { vertices: part.vertices, deformer, weights, skin };
                        let next = shown.deformations.len();
                        let at = *shown.known_deformations.entry(deformation.clone()).or_insert(next);
                        if at == next {
                            let vertices = self.vertices(part).count();
                            let deformer = &self.geometry.deformers[deformer];
                            let joints = if skin.is_some() { 4 * deformer.influences.len() as u64 } else { 0 };
                            cost.add_elements(vertices, place)?;
                            cost.add_steps(
                                deformer.steps(weights_of(&deformation).as_slice()) + joints * vertices,
                                place,
                            )?;
                            shown.deformations.push((deformation, *part, node));
                        }
                        Some(at)
                    }
                    None => None,
                };
                let variants = &mut shown.variants[part.mesh];
                let next = variants.len();
                let variant = *shown.known_variants.entry((part.mesh, deformation)).or_insert(next);
                if variant == next {
                    cost.add_elements(self.geometry.meshes[part.mesh].triangles.len() as u64, place)?;
                    variants.push(deformation);
                }
                uses.push((part.mesh, variant));
            }
            shown.uses.push((node, uses));
        }
        Ok(shown)
    }

    /// The undeformed vertices of a part.
    fn vertices(&self, part: &Part) -> Vertices {
        let mesh = &self.geometry.meshes[part.mesh];
        Vertices { positions: Arc::clone(&mesh.positions), normals: mesh.normals.clone() }
    }

    /// Each variant of each mesh.
    fn meshes(&self, hierarchy: &Hierarchy, shown: &Shown) -> Parsed<Vec<Mesh>> {
        let mut joints: HashMap<usize, Vec<DAffine3>> = HashMap::new();
        for skin in shown.deformations.iter().filter_map(|(deformation, ..)| deformation.skin) {
            joints.entry(skin).or_insert_with(|| self.skins[&skin].transforms(hierarchy));
        }
        let deformed: Vec<Vertices> = in_order(shown.deformations.par_iter().map(|(deformation, part, node)| {
            let deformer = &self.geometry.deformers[deformation.deformer];
            let joints = deformation.skin.map(|skin| joints[&skin].as_slice());
            deformer.deformed(&self.vertices(part), &weights_of(deformation), joints).map_err(|vertex| {
                let name = &self.geometry.meshes[part.mesh].name;
                let message = format!("vertex {vertex} of {name:?} is deformed beyond {MAX_COORDINATE:e}");
                fault(format!("nodes[{node}]"), message)
            })
        }))?;
        let mut meshes = Vec::with_capacity(shown.known_variants.len());
        for (base, variants) in self.geometry.meshes.iter().zip(&shown.variants) {
            for deformation in variants {
                let mut mesh = base.clone();
                if let Some(at) = *deformation {
                    let Vertices { positions, normals } = deformed[at].clone();
                    (mesh.positions, mesh.normals) = (positions, normals);
                }
                meshes.push(mesh);
            }
        }
        Ok(meshes)
    }

    /// The uses of meshes, in the order of their nodes, in world space.
    fn instances(&self, hierarchy: &Hierarchy, shown: &Shown, meshes: &[Mesh]) -> Parsed<Vec<Instance>> {
        let bounds: Vec<Bounds> = meshes.par_iter().map(Mesh::bounds).collect();
        let mut first_variant = Vec::with_capacity(shown.variants.len());
        let mut next = 0;
        for variants in &shown.variants {
            first_variant.push(next);
            next += variants.len();
        }
        let mut instances = Vec::new();
        for (node, uses) in &shown.uses {
            let node = *node;
            let mut add = |world_from_mesh: DAffine3, place: &dyn Fn() -> String| {
                check_transform(&world_from_mesh, place)?;
                for &(mesh, variant) in uses {
                    let mesh = first_variant[mesh] + variant;
                    let corners = bounds[mesh].corners().map(|corner| world_from_mesh.transform_point3(corner));
                    if corners.iter().any(|corner| corner.abs().max_element() > MAX_COORDINATE) {
                        let message = format!("its geometry goes beyond {MAX_COORDINATE:e} in world space");
                        return Err(fault(place(), message));
                    }
                    instances.push(Instance { mesh, node, scene_from_mesh: world_from_mesh });
                }
                Ok(())
            };
            let place = || format!("nodes[{node}]");
            if uses.is_empty() {
                continue;
            }
            // Where its node is does not matter to what is skinned (glTF 2.0, 3.7.3.3).
            if let Some(skin) = self.root.nodes[node].skin {
                let origin = self.skins[&skin.value()].origin_world(hierarchy);
                add(DAffine3::from_translation(origin), &place)?;
                continue;
            }
            match self.copies.get(&node) {
                None => add(hierarchy.world(node)?, &place)?,
                Some(copies) => {
                    let world_from_node = hierarchy.world(node)?;
                    for i in 0..copies.count {
                        let place = || format!("nodes[{node}].extensions.EXT_mesh_gpu_instancing, instance {i}");
                        add(world_from_node * copies.transform(i, place)?, &place)?;
                    }
                }
            }
        }
        Ok(instances)
    }
}

fn weights_of(deformation: &Deformation) -> Vec<f64> {
    deformation.weights.iter().map(|&bits| f64::from_bits(bits)).collect()
}

/// What a pose takes, held against the size of the file.
struct Cost {
    size: u64,
    /// Deformed vertices and copied triangles.
    elements: u64,
    steps: u64,
}

impl Cost {
    fn new(size: u64) -> Self {
        Self { size, elements: 0, steps: 0 }
    }

    fn add_elements(&mut self, more: u64, place: impl FnOnce() -> String) -> Parsed<()> {
        self.elements = self.elements.saturating_add(more);
        self.check(self.elements, ELEMENTS_PER_BYTE, "vertices and triangles", place)
    }

    fn add_steps(&mut self, more: u64, place: impl FnOnce() -> String) -> Parsed<()> {
        self.steps = self.steps.saturating_add(more);
        self.check(self.steps, STEPS_PER_BYTE, "displacements and joints", place)
    }

    fn check(&self, count: u64, per_byte: u64, what: &str, place: impl FnOnce() -> String) -> Parsed<()> {
        let budget = FREE_ELEMENTS.saturating_add(self.size.saturating_mul(per_byte));
        if count <= budget {
            return Ok(());
        }
        let message = format!(
            "too much that is deformed for its size: with this, {count} {what}, and a file of {} bytes may have {budget}",
            self.size
        );
        Err(fault(place(), message))
    }
}

/// The copies that nodes have of their meshes.
fn all_copies(document: &Document, hierarchy: &Hierarchy, geometry: &Geometry) -> Parsed<BTreeMap<usize, Copies>> {
    let budget = FREE_ELEMENTS.saturating_add(document.size);
    let mut all = BTreeMap::new();
    let mut instances = 0u64;
    for &node in &hierarchy.shown {
        let parts = document.root.nodes[node].mesh.map_or(0, |mesh| geometry.meshes_of[mesh.value()].len());
        if parts == 0 {
            continue;
        }
        let copies = copies(document, node)?;
        instances += copies.as_ref().map_or(1, |copies| copies.count) as u64 * parts as u64;
        if instances > budget {
            let message =
                format!("too many instances for its size: a file of {} bytes may have {budget}", document.size);
            return Err(fault(format!("nodes[{node}]"), message));
        }
        if let Some(copies) = copies {
            all.insert(node, copies);
        }
    }
    Ok(all)
}
