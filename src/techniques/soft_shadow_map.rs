//! Soft shadow maps: each texel of a map of occluders, seen from the light's centre, is a micro-patch parallel to the light; the
//! shares of the light that patches hide are added. Atty, Holzschuch, Lapierre, Hasenfratz, Hansen and Sillion 2006, "Soft Shadow
//! Maps: Efficient Sampling of Light Source Visibility".
//!
//! Patches side by side and equally far from the light hide what they cover, to a half texel of their outline; at different depths
//! they leave gaps or count twice (Eq. 3, with the sign of Eq. 1's bracket turned: it is x1 − x2), the more the wider the light and
//! the nearer they are to it. A map from the centre knows nothing of what other points of the light see, but for the farthest
//! surfaces, which a second map has (`sides`): the larger of both sums counts.
//!
//! # The paper's method: `self_shadowing=false`
//! Occluders and receivers are different instances. A patch's penumbra is a rectangle in the soft shadow map, drawn with additive
//! blending; each of its texels knows the nearest receiver. That is projected onto the receivers from the light's centre. What
//! the paper does on the processor is done on the GPU: a prefix sum lists the patches, and an indirect draw takes their number from
//! it. The maps of occluders and receivers are fitted to them, with the light's axes, but not with its aspect, which only the
//! paper's apex asks for; disks and ellipses are intersected with patches exactly.
//!
//! Its limits are its own: occluders are lit as if alone, and of receivers behind one another the nearest alone is right.
//!
//! # Its future work: `self_shadowing=true`
//! The same patches are summed at each receiver of the view instead of at texels: no layer of receivers, no projection, and no split,
//! for a receiver's own tangent plane tells the patches before it from those of its own surface. Not every patch is looked at. One
//! that lies a distance r from the receiver's own place in the map hides the light only where its penumbra there is wider than r. So
//! patches are as large as the penumbra allows that they can throw: windows of `patches` across, each twice as wide as the one
//! before, in which a patch is a square of texels with the depth of the middle one. The smallest are those that a quarter of a
//! pixel shows. An edge is off by at most half a patch, which is 1/(`patches` − 4) of the light's width, and half a texel.
//!
//! The map then holds all that can shade anything, a room and its hills included, and needs more texels than that of a few occluders.
//!
//! # What it refuses, and what is left
//! It looks from the light one way: receivers behind a sphere, tube or point are refused. What blocks from more than 76° off the
//! light's axis is not in the map and lost, as is what is nearer to the light's plane than 2⁻¹⁶ of the way to the farthest receiver.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3, Vec2, Vec4};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{
    Context, Entry, Frame, LightImage, Needs, Parameters, Pass, Technique, add_passes, parse_parameters, schema_of,
};
use crate::geometry::shaft::{Shaft, light_bounds};
use crate::gpu::center_map::emitter_of;
use crate::gpu::gbuffer::DEPTH;
use crate::gpu::light_view::{LightView, WORKGROUP, fraction_above};
use crate::gpu::pass::Frame as GpuFrame;
use crate::gpu::scene::{DrawList, Part};
use crate::gpu::screen::Screen;
use crate::gpu::shader::{Constants, Pipeline, Targets};
use crate::gpu::shadow_map::{self, BEYOND, Face, Kept, NEAREST, ROUNDING};
use crate::gpu::{self, Gpu};
use crate::gpu_struct;
use crate::scene::{AreaLight, Bounds, Scene};
use crate::{Error, Result};

/// Registered as `soft-shadow-map`.
pub const ENTRY: Entry = Entry {
    name: "soft-shadow-map",
    paper: "Atty, Holzschuch, Lapierre, Hasenfratz, Hansen, Sillion 2006, \"Soft Shadow Maps: Efficient Sampling of Light Source \
            Visibility\"",
    summary: "the texels of a map from the light's centre as patches, and what each of them hides of the light added up",
    needs: Needs::Gpu,
    schema: schema_of::<SoftShadowMap>,
    presets: &[
        ("paper", "self_shadowing=false sides=both blending=fp16 map_size=128"),
        ("one-pass", "self_shadowing=false sides=front blending=fp16 map_size=128"),
    ],
    demo: &["self_shadowing=false map_size=128", ""],
    build,
};

/// Parameters of `soft-shadow-map`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SoftShadowMap {
    /// Texels a side of the maps. With `self_shadowing` the time hardly depends on it; without, it grows with the fourth power where
    /// penumbrae are wide, and 64 to 256 will do.
    #[schemars(range(min = 1, max = 4096))]
    pub map_size: u32,
    /// Which surfaces of the occluders are made of patches.
    pub sides: Sides,
    /// Whether receivers shade themselves and each other: patches are summed at the view's receivers. False: they are summed in a soft
    /// shadow map, and instances either occlude or receive (the paper).
    pub self_shadowing: bool,
    /// How patches are summed in a soft shadow map, without `self_shadowing`.
    pub blending: Blending,
    /// Patches across the windows around a receiver, a multiple of 4, with `self_shadowing`. A software GPU ends loops after 65536
    /// rounds, which 64 stay below.
    #[schemars(range(min = 8, max = 64))]
    pub patches: u32,
    /// The nodes whose instances occlude, with commas between; nothing: all that are no receivers. Where neither are
    /// named, all that stand before others, by their bounds, and more than
    /// a thousandth of the way to the light; of two that stand before each other, the smaller.
    pub occluders: String,
    /// The nodes whose instances receive, with commas between; nothing: all that are no occluders.
    pub receivers: String,
}

/// Surfaces of occluders that are made of patches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Sides {
    /// Those nearest to the light.
    Front,
    /// Those farthest from it.
    Bottom,
    /// Both, of which the larger sum counts.
    Both,
}

/// Numbers in which a soft shadow map is summed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Blending {
    /// Halves (the paper): patches that hide less than 2^-11 or 2^-10 of what is hidden already are lost, as the driver rounds.
    Fp16,
    /// Single precision, where the adapter can blend it.
    Fp32,
    /// Whole numbers of 2^-27, on any adapter.
    Fixed,
}

impl Default for SoftShadowMap {
    fn default() -> Self {
        Self {
            map_size: 2048,
            sides: Sides::Both,
            self_shadowing: true,
            blending: Blending::Fp32,
            patches: 8,
            occluders: String::new(),
            receivers: String::new(),
        }
    }
}

gpu_struct! {
    /// Twin of `Splat` in `techniques/soft_shadow_map.wgsl`.
    struct Splat {
        pub ssm_from_map: Vec4,
        pub spread: Vec2,
        pub size: u32,
        pub first: u32,
    }
}

/// Texels of a workgroup that lists patches: those of `THREADS` times `TEXELS_A_THREAD` in the shader.
const BLOCK: u32 = 1024;

/// Widest view, as a tangent off the light's axis.
const MAX_TANGENT: f64 = 4.0;

/// Most texels that the patches of a map may touch, by their bounds: minutes on a software GPU.
const MOST_SPLATS: u64 = 1 << 37;

/// As many are drawn before the work may stop.
const SPLATS_A_SLICE: u64 = 1 << 31;

fn build(context: &Context, given: &Parameters) -> Result<Box<dyn Technique>> {
    let parameters = parse_parameters::<SoftShadowMap>(&ENTRY, given)?;
    if !parameters.patches.is_multiple_of(4) {
        let message = format!("expected a multiple of 4, found {}", parameters.patches);
        return Err(Error::usage("parameter patches of soft-shadow-map", message));
    }
    let gpu = context.gpu()?;
    let blends = gpu.device.features().contains(wgpu::Features::FLOAT32_BLENDABLE);
    if !parameters.self_shadowing && parameters.blending == Blending::Fp32 && !blends {
        let message = format!("{} can't blend FP32; blending=fixed is as exact", gpu.adapter.name);
        return Err(Error::usage("parameter blending of soft-shadow-map", message));
    }
    Ok(Box::new(Built { gpu, parameters }))
}

#[derive(Debug)]
struct Built {
    gpu: Arc<Gpu>,
    parameters: SoftShadowMap,
}

/// What has been drawn of an image.
struct Drawn {
    /// By chunk.
    visibility: Vec<wgpu::Buffer>,
    maps: u32,
    texels: wgpu::Buffer,
    passes: Vec<Pass>,
}

impl Technique for Built {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let gpu = &*self.gpu;
        let sets = self.parameters.named(frame.scene)?;
        let Some(view) = LightView::new(gpu, frame, light)? else {
            frame.progress.advance(u64::from(frame.receivers.size[1]))?;
            return Ok(LightView::image(None, frame, light, |_, _, _| (0.0, 0.0)));
        };
        let [occludes, receives] = self.parameters.sets(sets, frame, light)?;
        let occluders = view.casters.only(|i| occludes[i]);
        let drawn = match self.maps(frame, &view, &occluders, light)? {
            None => None,
            Some(maps) if self.parameters.self_shadowing => Some(self.gather(frame, &view, &occluders, &maps)?),
            Some(maps) => {
                Some(self.splat(frame, &view, [&occluders, &self.receivers(frame, &view, &receives)?], &maps)?)
            }
        };
        let visibility: Vec<Vec<f32>> = match &drawn {
            Some(drawn) => drawn.visibility.iter().map(|buffer| gpu.read_buffer(buffer)).collect::<Result<_>>()?,
            None => Vec::new(),
        };
        let image = LightView::image(Some(&view), frame, light, |chunk, i, receiver| {
            let is_receiver = receives.get(receiver.instance as usize) != Some(&false);
            let seen = visibility.get(chunk).filter(|_| is_receiver).map_or(1.0, |chunk| f64::from(chunk[i]));
            // The map knows nothing of the receiver's horizon.
            let seen = seen.min(fraction_above(light, receiver));
            (seen, seen)
        });
        frame.progress.advance(u64::from(frame.receivers.size[1]))?;
        let texels = drawn.as_ref().map_or(Ok(0), |drawn| gpu.count(&drawn.texels))?;
        let (shadow_maps, passes) = drawn.map_or((0, Vec::new()), |drawn| (drawn.maps, drawn.passes));
        Ok(LightImage { samples: 1, shadow_maps, texels, approximate: true, passes, ..image })
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(&self.parameters).expect("parameters are numbers and names")
    }

    fn gpu(&self) -> Option<&Gpu> {
        Some(&self.gpu)
    }
}

// ------------------------------------------------------------------------------------------------------------------ sets

/// Which instances are named as occluders and as receivers; none where nothing is named.
type Named = [Option<Vec<bool>>; 2];

impl SoftShadowMap {
    fn named(&self, scene: &Scene) -> Result<Named> {
        let of = |parameter: &str, list: &str| {
            let names: Vec<String> =
                list.split(',').map(|name| name.trim().to_owned()).filter(|n| !n.is_empty()).collect();
            if names.is_empty() {
                return Ok(None);
            }
            if let Some(name) = names.iter().find(|&name| scene.nodes.iter().all(|node| node.name != *name)) {
                let what = format!("parameter {parameter} of soft-shadow-map");
                return Err(Error::usage(what, format!("the scene has no node {name:?}")));
            }
            Ok(Some(scene.instances_under(&names)))
        };
        Ok([of("occluders", &self.occluders)?, of("receivers", &self.receivers)?])
    }

    /// Which instances occlude and which receive.
    fn sets(&self, named: Named, frame: &Frame, light: &AreaLight) -> Result<[Vec<bool>; 2]> {
        let all = || vec![true; frame.scene.instances.len()];
        let not = |set: &[bool]| set.iter().map(|is_in| !is_in).collect::<Vec<bool>>();
        let [occluders, receivers] = match named {
            [Some(occluders), Some(receivers)] => [occluders, receivers],
            [Some(occluders), None] if self.self_shadowing => [occluders, all()],
            [None, Some(receivers)] if self.self_shadowing => [all(), receivers],
            [Some(occluders), None] => [occluders.clone(), not(&occluders)],
            [None, Some(receivers)] => [not(&receivers), receivers],
            [None, None] if self.self_shadowing => [shading(frame, light), all()],
            [None, None] => {
                let occluders = standing_before(frame, light)?;
                [occluders.clone(), not(&occluders)]
            }
        };
        let is_both = |i: &usize| occluders[*i] && receivers[*i];
        if !self.self_shadowing
            && let Some(both) = (0..occluders.len()).find(is_both)
        {
            let name = &frame.scene.nodes[frame.scene.instances[both].node].name;
            let message = format!("{name:?} is an occluder too, which self_shadowing=true alone allows");
            return Err(Error::usage("parameter receivers of soft-shadow-map", message));
        }
        Ok([occluders, receivers])
    }
}

/// What an instance shows of itself.
struct Shown {
    /// Around its receivers.
    receivers: Bounds,
    /// The diagonal of its bounds; of receivers on nothing known, infinite.
    size: f64,
    /// None for receivers on nothing known.
    instance: Option<usize>,
}

/// What is seen of the instances, the largest first.
fn shown(frame: &Frame) -> Vec<Shown> {
    let instances = frame.scene.instances.len();
    let mut bounds = vec![Bounds::EMPTY; instances + 1];
    for receiver in frame.receivers.hits() {
        let around = &mut bounds[(receiver.instance as usize).min(instances)];
        *around = around.including(receiver.position);
    }
    let of = |(i, receivers): (usize, Bounds)| {
        let instance = (i < instances).then_some(i);
        let size = instance.map_or(f64::INFINITY, |i| frame.bvh.instance_bounds(i).size().length());
        Shown { receivers, size, instance }
    };
    let mut shown: Vec<Shown> =
        bounds.into_iter().enumerate().filter(|(_, bounds)| !bounds.is_empty()).map(of).collect();
    shown.sort_by(|a, b| b.size.total_cmp(&a.size));
    shown
}

/// Which instances may hide the light from a receiver of another instance; where `one_way`, not those that a smaller one stands
/// before as well, as a room around its furniture does.
fn before(frame: &Frame, light: &AreaLight, one_way: bool) -> Vec<bool> {
    let count = frame.scene.instances.len();
    let bounds: Vec<Bounds> = (0..count).map(|i| frame.bvh.instance_bounds(i)).collect();
    let scene_bounds = bounds.iter().copied().fold(Bounds::EMPTY, Bounds::union);
    let shaft = |shown: Shown| {
        let light = light_bounds(light, &shown.receivers, &scene_bounds);
        // A thousandth of the way to the light: what they lie or stand on is not before them.
        let toward = |from: DVec3, to: DVec3| from.lerp(to, 1e-3);
        let Bounds { min, max } = shown.receivers;
        let shaft = Shaft::between(&Bounds { min: toward(min, light.min), max: toward(max, light.max) }, &light);
        (shown, shaft)
    };
    let shown: Vec<(Shown, Shaft)> = shown(frame).into_iter().map(shaft).collect();
    let mut shafts: Vec<Option<&Shaft>> = vec![None; count];
    for (of, shaft) in &shown {
        if let Some(i) = of.instance {
            shafts[i] = Some(shaft);
        }
    }
    let meets = |shaft: &Shaft, i: usize| !shaft.excludes(&bounds[i]);
    let is_before = |i: usize| {
        let size = bounds[i].size().length();
        shown.iter().any(|(of, shaft)| {
            let is_around =
                || of.instance.is_some_and(|j| size > of.size && shafts[i].is_some_and(|own| meets(own, j)));
            of.instance != Some(i) && meets(shaft, i) && !(one_way && is_around())
        })
    };
    (0..count).into_par_iter().map(is_before).collect()
}

/// Whether a mesh is flat in its own space, so that it can't shade itself.
fn is_flat(scene: &Scene, instance: usize) -> bool {
    scene.meshes[scene.instances[instance].mesh].bounds().size().min_element() == 0.0
}

/// Which instances can shade anything: a floor below all that is seen would only take texels from the rest.
fn shading(frame: &Frame, light: &AreaLight) -> Vec<bool> {
    let mut shading = before(frame, light, false);
    for (i, shades) in shading.iter_mut().enumerate() {
        *shades |= !is_flat(frame.scene, i);
    }
    shading
}

/// Which instances are occluders where none are named: those that stand before others, by their bounds.
fn standing_before(frame: &Frame, light: &AreaLight) -> Result<Vec<bool>> {
    let occluders = before(frame, light, true);
    let shades_itself = |shown: &Shown| shown.instance.is_some_and(|i| !is_flat(frame.scene, i));
    if !occluders.contains(&true) && shown(frame).iter().any(shades_itself) {
        let message = "no instance stands before another; name them (occluders=NAME,NAME), or set self_shadowing=true";
        return Err(Error::usage("soft-shadow-map with self_shadowing=false", message));
    }
    Ok(occluders)
}

// ------------------------------------------------------------------------------------------------------------------ maps

/// What maps see of a light's surroundings, along its axes from its centre.
struct Frustum {
    /// Right, up and forward as columns: the light's u, v and normal.
    axes: DMat3,
    center: DVec3,
    distant: bool,
    /// Half the light along u and v.
    half: DVec2,
    /// Depths from the light, or of a distant one along its direction from the origin.
    depths: [f64; 2],
}

/// What maps hold, in slopes or lengths across.
struct Maps {
    frustum: Frustum,
    occluders: Face,
    /// Of the soft shadow map, and of the map of receivers.
    ssm: Face,
}

impl Frustum {
    /// How much wider than the light's half what lies at a depth is seen from another, in slopes or lengths.
    fn widening(&self, near: f64, far: f64) -> f64 {
        if self.distant { (far - near).max(0.0) } else { (1.0 / near - 1.0 / far).max(0.0) }
    }

    /// What is seen of a box: its slopes or lengths, and so much of what the light's width adds to them before the nearest occluder.
    fn window(&self, corners: &[DVec3; 8], width: f64) -> [DVec2; 2] {
        let [nearest, _] = self.depths;
        if !self.distant && corners.iter().any(|corner| corner.z < nearest) {
            return [DVec2::splat(-MAX_TANGENT), DVec2::splat(MAX_TANGENT)];
        }
        let ends = |corner: &DVec3| {
            let at = if self.distant { corner.truncate() } else { corner.truncate() / corner.z };
            let reach = width * self.half * self.widening(nearest, corner.z);
            [at - reach, at + reach]
        };
        let [low, high] = corners.iter().map(ends).fold(EMPTY, around);
        if self.distant {
            return [low, high];
        }
        [low, high].map(|end| end.clamp(DVec2::splat(-MAX_TANGENT), DVec2::splat(MAX_TANGENT)))
    }

    fn face(&self, window: [DVec2; 2], size: [u32; 2]) -> Face {
        Face::new(&self.axes, self.center, self.distant, window, self.depths, size)
    }

    /// Half the light's width in a map of occluders by difference of depth, texels.
    fn spread(&self, face: &Face, size: u32) -> Vec2 {
        let [near, far] = self.depths;
        // Depth 1 is `near`, depth 0 `far`.
        let texels = DVec2::new(face.window.x.into(), face.window.y.into()) * f64::from(size);
        (self.half * self.widening(near, far) * texels).as_vec2()
    }
}

/// A window that holds nothing.
const EMPTY: [DVec2; 2] = [DVec2::INFINITY, DVec2::NEG_INFINITY];

fn around([low, high]: [DVec2; 2], [low_2, high_2]: [DVec2; 2]) -> [DVec2; 2] {
    [low.min(low_2), high.max(high_2)]
}

fn common([low, high]: [DVec2; 2], [low_2, high_2]: [DVec2; 2]) -> [DVec2; 2] {
    [low.max(low_2), high.min(high_2)]
}

impl Built {
    /// Around all occluders and receivers that matter to each other; none where nothing is between the light and the receivers.
    fn maps(&self, frame: &Frame, view: &LightView, occluders: &DrawList, light: &AreaLight) -> Result<Option<Maps>> {
        let SoftShadowMap { map_size, self_shadowing, .. } = self.parameters;
        let emitter = &view.emitter;
        let forward = emitter.normal;
        let right = emitter.half_u.try_normalize().unwrap_or_else(|| match emitter.half_v.try_normalize() {
            Some(up) => up.cross(forward),
            None => forward.any_orthonormal_vector(),
        });
        let up = emitter.half_v.try_normalize().unwrap_or_else(|| forward.cross(right));
        let axes = DMat3::from_cols(right, up, forward);
        let half = DVec2::new(emitter.half_u.length(), emitter.half_v.length());
        let center = if emitter.distant { DVec3::ZERO } else { emitter.center };
        let seen = |corner: DVec3| axes.transpose() * (corner - center);
        let z_of = |from: &mut dyn Iterator<Item = DVec3>| {
            from.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], at| {
                let z = seen(at).z;
                [low.min(z), high.max(z)]
            })
        };
        let is_behind = |&number: &u32| {
            let receiver = frame.receivers.pixels[number as usize].as_ref().expect("only hits face the light");
            seen((receiver.position - view.space.origin) / view.space.unit).z <= 0.0
        };
        if !emitter.distant && view.chunks.iter().any(|chunk| chunk.pixels.iter().any(is_behind)) {
            let message =
                "receivers lie around it, and this technique looks one way; uniform, pcss and rays look all around";
            return Err(Error::usage(format!("soft-shadow-map of light {:?}", light.name), message));
        }
        let [nearest, _] = z_of(&mut occluders.parts().flat_map(|bounds| bounds.corners()));
        let [_, farthest] = z_of(&mut view.tiles.iter().flat_map(Bounds::corners));
        if nearest >= farthest {
            return Ok(None);
        }
        let coordinates =
            view.caster_bounds.min.abs().max(view.caster_bounds.max.abs()).max(center.abs()).max_element();
        let depths = if emitter.distant {
            let beyond = BEYOND * (farthest - nearest);
            [nearest - beyond, farthest + beyond]
        } else {
            let farthest = farthest * (1.0 + BEYOND);
            [(nearest * (1.0 - BEYOND)).max(ROUNDING * coordinates).max(NEAREST * farthest), farthest]
        };
        if depths[0] >= depths[1] {
            return Ok(None);
        }
        let frustum = Frustum { axes, center, distant: emitter.distant, half, depths };
        let occluders = occluders.parts().map(|bounds| bounds.corners().map(seen));
        let before = occluders.filter(|corners| {
            let is_seen = |corner: &DVec3| depths[0] <= corner.z && corner.z <= depths[1];
            corners.iter().any(is_seen)
                || corners.iter().any(|c| c.z < depths[0]) && corners.iter().any(|c| c.z > depths[1])
        });
        let blocking = before.map(|corners| frustum.window(&corners, 0.0)).fold(EMPTY, around);
        // A penumbra on the farthest receiver is as wide as any.
        let reach = half * frustum.widening(depths[0], depths[1]);
        let wider = |[low, high]: [DVec2; 2]| [low - reach, high + reach];
        let seen_by = |width| {
            let windows = view.tiles.iter().map(|tile| frustum.window(&tile.corners().map(seen), width));
            windows.fold(EMPTY, around)
        };
        let is_empty = |[low, high]: [DVec2; 2]| low.cmpgt(high).any();
        let penumbra = common(seen_by(0.0), wider(blocking));
        if is_empty(penumbra) {
            return Ok(None);
        }
        // Its outermost texels see beyond all penumbrae or receivers.
        let ssm = frustum.face(penumbra, [map_size, 1]);
        // What is farther from a receiver's place hides nothing from it; a texel for roundings.
        let [low, high] = if self_shadowing { seen_by(1.0) } else { wider(ssm.shown()) };
        let texel = (high - low) / f64::from(map_size);
        let occluders = common(blocking, [low - texel, high + texel]);
        Ok((!is_empty(occluders)).then(|| Maps { occluders: frustum.face(occluders, [map_size, 0]), ssm, frustum }))
    }

    /// What is drawn into the map of receivers.
    fn receivers(&self, frame: &Frame, view: &LightView, receives: &[bool]) -> Result<DrawList> {
        view.buffers.draw_list(&self.gpu, frame.scene, view.space, Part::Chunk, |i, _| receives[i])
    }

    /// The layers of the maps of occluders that are used, and which of them is the first.
    fn sides(&self) -> (u32, u32) {
        match self.parameters.sides {
            Sides::Front => (0, 1),
            Sides::Bottom => (1, 1),
            Sides::Both => (0, 2),
        }
    }

    /// Records the maps of occluders: nearest surfaces in layer 0, farthest ones in layer 1.
    fn draw_occluders(
        &self,
        passes: &mut GpuFrame,
        view: &LightView,
        occluders: &DrawList,
        face: &Face,
    ) -> Result<wgpu::TextureView> {
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING;
        let size = self.parameters.map_size;
        let maps = self.gpu.texture("maps of occluders", [size, size, 2], DEPTH, usage)?;
        let (first, count) = self.sides();
        for layer in first..first + count {
            let kept = [Kept::Nearest, Kept::Farthest][layer as usize];
            shadow_map::draw_face(passes, "maps of occluders", view, occluders, (face, kept), (&maps, layer))?;
        }
        Ok(maps.create_view(&wgpu::TextureViewDescriptor {
            dimension: Some(wgpu::TextureViewDimension::D2Array),
            ..wgpu::TextureViewDescriptor::default()
        }))
    }

    fn compute(&self, entry_point: &str, constants: Constants) -> Arc<Pipeline<wgpu::ComputePipeline>> {
        let constants = [shadow_map::CONSTANTS, constants].concat();
        self.gpu.compute_pipeline("techniques/soft_shadow_map.wgsl", entry_point, &constants)
    }

    /// A buffer of V for each chunk of receivers.
    fn answers(&self, view: &LightView) -> Result<Vec<wgpu::Buffer>> {
        let answer = |chunk: &gpu::light_view::Chunk| {
            self.gpu.empty_buffer("visibility", 4 * chunk.pixels.len() as u64, wgpu::BufferUsages::STORAGE)
        };
        view.chunks.iter().map(answer).collect()
    }

    /// Sums patches at the view's receivers.
    fn gather(&self, frame: &Frame, view: &LightView, occluders: &DrawList, fitted: &Maps) -> Result<Drawn> {
        let gpu = &*self.gpu;
        let size = self.parameters.map_size;
        let Maps { frustum, occluders: face, .. } = fitted;
        let (first, count) = self.sides();
        let pipeline = self.compute(
            "gather",
            &[
                ("across", self.parameters.patches.into()),
                ("sides", count.into()),
                ("first_side", first.into()),
                ("has_camera", f64::from(u8::from(frame.shot.is_some()))),
            ],
        );
        let screen = frame
            .shot
            .map_or_else(bytemuck::Zeroable::zeroed, |shot| Screen::new(shot, frame.receivers.size, view, 0.0));
        let splat = Splat { ssm_from_map: Vec4::ZERO, spread: frustum.spread(face, size), size, first: 0 };
        let uniform = wgpu::BufferUsages::UNIFORM;
        let (screen, splat) = (gpu.buffer("screen", &[screen], uniform)?, gpu.buffer("splat", &[splat], uniform)?);
        let emitter = gpu.buffer("emitter", &[emitter_of(view)], uniform)?;
        let faces = gpu.buffer("faces", &[*face], wgpu::BufferUsages::STORAGE)?;
        let visibility = self.answers(view)?;
        let counter = gpu.counter()?;
        let mut passes = GpuFrame::new(gpu);
        let maps = self.draw_occluders(&mut passes, view, occluders, face)?;
        for (chunk, answer) in view.chunks.iter().zip(&visibility) {
            passes
                .compute("visibility", &pipeline)
                .bind("faces", &faces)
                .bind("receivers", &chunk.buffer)
                .bind("shadow_depth", &maps)
                .bind("splat", &splat)
                .bind("emitter", &emitter)
                .bind("screen", &screen)
                .bind("visibility", answer)
                .bind("counted", &counter)
                .dispatch([(chunk.pixels.len() as u32).div_ceil(WORKGROUP), 1, 1]);
        }
        let passes = passes.finish()?;
        frame.progress.check()?;
        Ok(Drawn { visibility, maps: count, texels: counter, passes })
    }

    /// Sums patches in a soft shadow map, and projects it.
    fn splat(
        &self,
        frame: &Frame,
        view: &LightView,
        [occluders, receivers]: [&DrawList; 2],
        fitted: &Maps,
    ) -> Result<Drawn> {
        let gpu = &*self.gpu;
        let SoftShadowMap { map_size: size, blending, .. } = self.parameters;
        let texels = u64::from(size).pow(2);
        let Maps { frustum, occluders: face, ssm } = fitted;
        let scale = ssm.window.as_dvec4() / face.window.as_dvec4();
        let offset = [0, 1].map(|i| {
            let [map, ssm] = [face, ssm].map(|face| f64::from(face.window[i + 2]));
            f64::from(size) * (ssm - map * scale[i])
        });
        let spread = frustum.spread(face, size);
        let ssm_from_map = Vec4::new(scale.x as f32, scale.y as f32, offset[0] as f32, offset[1] as f32);
        let slices = self.slices([0, 1].map(|i| (f64::from(2.0 * spread[i]) + 1.0) * scale[i] + 3.0))?;
        let splat = |first| Splat { ssm_from_map, spread, size, first };
        let uniform = wgpu::BufferUsages::UNIFORM;
        let splats: Vec<wgpu::Buffer> = (0..slices.count)
            .map(|i| gpu.buffer("splat", &[splat(i * slices.patches)], uniform))
            .collect::<Result<_>>()?;
        let storage = wgpu::BufferUsages::STORAGE;
        let emitter = gpu.buffer("emitter", &[emitter_of(view)], uniform)?;
        let faces = gpu.buffer("faces", &[*ssm], storage)?;
        let blocks = texels.div_ceil(BLOCK.into()) as u32;
        let block_sums = gpu.empty_buffer("sums of blocks", 4 * u64::from(blocks), storage)?;
        let patches = gpu.empty_buffer("patches", 4 * texels, storage)?;
        let arguments = 16 * u64::from(slices.count);
        let arguments = gpu.empty_buffer("draws", arguments, storage | wgpu::BufferUsages::INDIRECT)?;
        let occlusion = gpu.empty_buffer("soft shadow map", 4 * texels, storage)?;
        let is_fixed = blending == Blending::Fixed;
        let fixed_sums = gpu.empty_buffer("sums", if is_fixed { 4 * texels } else { 4 }, storage)?;
        let format = match blending {
            Blending::Fp16 => wgpu::TextureFormat::R16Float,
            Blending::Fp32 => wgpu::TextureFormat::R32Float,
            Blending::Fixed => wgpu::TextureFormat::R8Unorm,
        };
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING;
        let sums = gpu.texture("soft shadow map", [size, size, 1], format, usage)?;
        let sums = sums.create_view(&wgpu::TextureViewDescriptor::default());
        let counter = gpu.counter()?;
        let (first, count) = self.sides();

        let mut passes = Vec::new();
        let mut recorded = GpuFrame::new(gpu);
        let maps = self.draw_occluders(&mut recorded, view, occluders, face)?;
        let usage = wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::TEXTURE_BINDING;
        let receiver_map = gpu.texture("map of receivers", [size, size, 1], DEPTH, usage)?;
        let nearest = (ssm, Kept::Nearest);
        shadow_map::draw_face(&mut recorded, "map of receivers", view, receivers, nearest, (&receiver_map, 0))?;
        let receiver_map = receiver_map.create_view(&wgpu::TextureViewDescriptor::default());
        for side in first..first + count {
            let constants = [("side", f64::from(side)), ("slice", f64::from(slices.patches))];
            for (entry_point, groups) in [("count_patches", blocks), ("scan_blocks", 1), ("place_patches", blocks)] {
                let pipeline = self.compute(entry_point, &constants);
                let mut pass = recorded.compute("patches", &pipeline).bind("block_sums", &block_sums);
                for (name, resource) in [("arguments", &arguments), ("counted", &counter)] {
                    if entry_point == "scan_blocks" {
                        pass = pass.bind(name, resource);
                    }
                }
                pass.bind("shadow_depth", &maps)
                    .bind("splat", &splats[0])
                    .bind("patches", &patches)
                    .dispatch([groups, 1, 1]);
            }
            let pipeline = self.splat_pipeline(format, side, is_fixed);
            if is_fixed {
                recorded.encoder().clear_buffer(&fixed_sums, 0, None);
            }
            for (slice, splat) in splats.iter().enumerate() {
                let group = pipeline.bind_group(
                    gpu,
                    &[
                        ("splat", splat.as_entire_binding()),
                        ("drawn_patches", patches.as_entire_binding()),
                        ("shadow_depth", wgpu::BindingResource::TextureView(&maps)),
                        ("receiver_depth", wgpu::BindingResource::TextureView(&receiver_map)),
                        ("emitter", emitter.as_entire_binding()),
                        ("fixed_sums", fixed_sums.as_entire_binding()),
                    ],
                );
                let load = if slice == 0 { wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT) } else { wgpu::LoadOp::Load };
                let color = wgpu::RenderPassColorAttachment {
                    view: &sums,
                    depth_slice: None,
                    resolve_target: None,
                    ops: wgpu::Operations { load, store: wgpu::StoreOp::Store },
                };
                recorded.render("soft shadow map", &[Some(color)], None, |pass| {
                    pass.set_pipeline(&pipeline.raw);
                    pass.set_bind_group(0, &group, &[]);
                    pass.draw_indirect(&arguments, 16 * slice as u64);
                });
                if slice + 1 < splats.len() {
                    add_passes(&mut passes, std::mem::replace(&mut recorded, GpuFrame::new(gpu)).finish()?);
                    frame.progress.check()?;
                }
            }
            let merge = if is_fixed { "merge_fixed" } else { "merge_blended" };
            let merge = self.compute(merge, &[]);
            let pass =
                recorded.compute("soft shadow map", &merge).bind("splat", &splats[0]).bind("occlusion", &occlusion);
            let pass = if is_fixed { pass.bind("fixed_sums", &fixed_sums) } else { pass.bind("blended_sums", &sums) };
            pass.dispatch([size.div_ceil(WORKGROUP), size, 1]);
        }
        let visibility = self.answers(view)?;
        let project = self.compute("project", &[]);
        for (chunk, answer) in view.chunks.iter().zip(&visibility) {
            recorded
                .compute("visibility", &project)
                .bind("faces", &faces)
                .bind("receivers", &chunk.buffer)
                .bind("splat", &splats[0])
                .bind("occlusion", &occlusion)
                .bind("visibility", answer)
                .dispatch([(chunk.pixels.len() as u32).div_ceil(WORKGROUP), 1, 1]);
        }
        add_passes(&mut passes, recorded.finish()?);
        frame.progress.check()?;
        Ok(Drawn { visibility, maps: count + 1, texels: counter, passes })
    }

    /// How patches are drawn that touch up to so many texels of the soft shadow map along each axis.
    fn slices(&self, touched: [f64; 2]) -> Result<Slices> {
        let size = u64::from(self.parameters.map_size);
        // Saturates.
        let [x, y] = touched.map(|texels| (texels.ceil() as u64).min(size));
        let most = size * size * x * y;
        if most > MOST_SPLATS {
            let message = format!(
                "patches of {size} x {size} texels would touch up to {most} texels, and {MOST_SPLATS} are allowed; a light \
                 so wide needs fewer"
            );
            return Err(Error::usage("parameter map_size of soft-shadow-map", message));
        }
        let patches = (SPLATS_A_SLICE / (x * y)).clamp(1, size * size);
        Ok(Slices { count: (size * size).div_ceil(patches) as u32, patches: patches as u32 })
    }

    fn splat_pipeline(
        &self,
        format: wgpu::TextureFormat,
        side: u32,
        is_fixed: bool,
    ) -> Arc<Pipeline<wgpu::RenderPipeline>> {
        let add = wgpu::BlendComponent {
            src_factor: wgpu::BlendFactor::One,
            dst_factor: wgpu::BlendFactor::One,
            operation: wgpu::BlendOperation::Add,
        };
        let color = wgpu::ColorTargetState {
            format,
            blend: (!is_fixed).then_some(wgpu::BlendState { color: add, alpha: add }),
            write_mask: if is_fixed { wgpu::ColorWrites::empty() } else { wgpu::ColorWrites::RED },
        };
        let targets = Targets { vertices: &[], fragment: true, colors: &[Some(color)], depth: None };
        let constants: &[(&str, f64)] = &[("side", side.into()), ("fixed_point", f64::from(u8::from(is_fixed)))];
        let constants = [shadow_map::CONSTANTS, constants].concat();
        self.gpu.render_pipeline("techniques/soft_shadow_map.wgsl", &targets, &constants)
    }
}

/// Parts in which patches are drawn, so that the work may stop between them.
struct Slices {
    count: u32,
    /// Of one.
    patches: u32,
}
