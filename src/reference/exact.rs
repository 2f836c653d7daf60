//! The exact reference: what of a light a receiver sees, without sampling.
//!
//! All triangles between the receiver and the light are projected onto the light's plane, in `f64` and relative to the
//! receiver; edges that neighbours share cancel; what the rest leaves of the light is found by slabs
//! ([`crate::geometry::coverage`]). V is the area that is left; E the irradiance of it, as a contour integral around its
//! pieces: Lambert's polygon formula, closed forms for circles' arcs, quadrature for ellipses', spreads and cones
//! ([`crate::geometry::irradiance`]). The horizon and the shading plane count as polygons that cover what lies below them.
//!
//! Nothing is pruned by which way a triangle faces: shared edges cancel for open meshes and for closed ones, so there is
//! nothing left to win, and nothing to prove.
//!
//! A cut-out has no outline. Where one decides, the answer is sampled, within the bounds that it would have if cut-outs were
//! solid or weren't there; likewise where a light is hidden by more edges than can be afforded. The image says where.

use std::f64::consts::PI;

use glam::{DMat3, DVec2, DVec3};
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::Result;
use crate::closed_forms::clip_polygon;
use crate::geometry::bvh::{Scratch, ShadowRay};
use crate::geometry::contour::{Arc, Piece};
use crate::geometry::coverage::{Border, Coverage, OverBudget, SQUARE, Trapezoid, half_chord};
use crate::geometry::irradiance;
use crate::geometry::outline::{Outline, Projection};
use crate::geometry::triangle::{Segment, normal_of};
use crate::receivers::Receiver;
use crate::sampling::Pattern;
use crate::scene::AreaLight;
use crate::scene::light::{Domain, Emitter};
use crate::techniques::rays::Rays;
use crate::techniques::{Frame, LightImage, Linking, Technique, timed};

/// Seed of a reference's samples: with those of the image it judges in common, it would find the image better than it is.
pub const REFERENCE_SEED: u32 = 0x9e37_79b9;

/// Samples where the exact answer can't be had: their error is ten times below the smallest that is judged by it.
const SAMPLES: u32 = 1 << 16;

/// Visits of an edge in a slab that a receiver may cost, each some tens of nanoseconds: a second or so. Real scenes take a
/// hundredth of it. Beyond it a receiver is sampled, which takes what [`SAMPLES`] rays take.
const BUDGET: u64 = 1 << 25;

/// Triangles before the light that a receiver may see: they take some 200 bytes each, on every thread.
const MAX_TRIANGLES: u32 = 1 << 21;

/// Visibility below this is nothing: the gaps that rounding leaves between casters that touch. Coordinates are good to 1e-16
/// of the scene, and so to 1e-12 of a light of a ten-thousandth of it.
const NOTHING: f64 = 1e-11;

/// Triangles all of whose corners are this near to the light's plane, in units of the distance, are tested for lying in it.
const NEAR_LIGHT_PLANE: f64 = 1e-6;

/// The exact reference as a technique.
#[derive(Debug, Clone, Copy)]
pub struct Exact;

/// What a receiver sees of a light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Answer {
    /// V, in [0, 1].
    pub visibility: f64,
    /// E, W/m², linear RGB; zero unless asked for.
    pub irradiance: DVec3,
    /// E/E₀, in [0, 1]; zero where E₀ is, and unless asked for.
    pub irradiance_ratio: f64,
    /// Whether some of the light faces the receiver.
    pub facing: bool,
    /// Whether it was sampled after all.
    pub sampled: bool,
    /// Triangles between the receiver and the light.
    pub triangles: u32,
    /// Rays traced.
    pub rays: u32,
}

/// Reusable memory, one a thread.
#[derive(Debug, Default)]
pub struct Memory {
    scratch: Scratch,
    opaque: Outline,
    cutouts: Outline,
    coverage: Coverage,
}

const UNSEEN: Answer = Answer {
    visibility: 0.0,
    irradiance: DVec3::ZERO,
    irradiance_ratio: 0.0,
    facing: false,
    sampled: false,
    triangles: 0,
    rays: 0,
};

/// An instance as a receiver sees it.
struct View {
    instance: u32,
    segment: Segment,
    homogeneous_from_mesh: DMat3,
    /// Its determinant.
    determinant: f64,
    blocks: bool,
    /// Whether its material is a cut-out that depends on the place.
    is_cutout: bool,
}

impl Exact {
    /// What the receiver, the image's `number`th, sees of the light.
    pub fn answer(
        frame: &Frame,
        light: &AreaLight,
        receiver: &Receiver,
        number: u32,
        linking: &Linking,
        memory: &mut Memory,
    ) -> Answer {
        let Some(emitter) = light.emitter(receiver.position) else { return UNSEEN };
        if !linking.lights(receiver) || !irradiance::reaches(&emitter, receiver) {
            return UNSEEN;
        }
        let unshadowed = || if frame.irradiance { irradiance::unshadowed(light, receiver) } else { DVec3::ZERO };
        let light_error = emitter.position_error(receiver.position);
        let ray = ShadowRay {
            origin: receiver.position,
            origin_error: receiver.position_error,
            to_light: emitter.center,
            light_error,
            distant: emitter.distant,
            source: (receiver.instance, receiver.triangle),
        };
        let size = emitter.half_u.length().max(emitter.half_v.length());
        if emitter.domain == Domain::Point || size <= light_error {
            let is_above = receiver.normal.dot(emitter.center) > 0.0;
            let mut is_blocked = || frame.bvh.is_blocked(&ray, &mut memory.scratch, |i| linking.blocks(i));
            let is_seen = is_above && !(light.casts_shadow && is_blocked());
            let answer = Answer { facing: true, rays: u32::from(is_above && light.casts_shadow), ..UNSEEN };
            return if is_seen { Answer { visibility: 1.0, ..answer }.lit_by(unshadowed()) } else { answer };
        }

        let projection = Projection::new(&emitter, light_error);
        memory.opaque.clear();
        memory.cutouts.clear();
        if light.casts_shadow {
            gather(frame, &emitter, &projection, &ray, linking, memory);
        }
        let triangles = memory.opaque.triangles + memory.cutouts.triangles;
        let mut answer = Answer { facing: true, triangles, ..UNSEEN };
        let horizon = below(&emitter, &projection, receiver.normal);
        let shading_horizon = below(&emitter, &projection, receiver.shading_normal);
        if horizon.is_empty() && triangles == 0 {
            return Answer { visibility: 1.0, ..answer }.lit_by(unshadowed());
        }
        // One pass serves both quantities unless the shading plane takes part of the light from E alone.
        let same_region = shading_horizon.is_empty() || receiver.shading_normal == receiver.normal;
        let wants_pieces = frame.irradiance && same_region;
        memory.opaque.add_polygon(&horizon);
        let Ok(visibility) = memory.visibility(emitter.domain, false, wants_pieces) else {
            return sample(frame, light, receiver, number, linking, [0.0, 1.0], answer, memory);
        };
        if visibility > 0.0 && memory.cutouts.triangles > 0 {
            let with_cutouts = memory.visibility(emitter.domain, true, wants_pieces).unwrap_or(0.0);
            if visibility - with_cutouts > NOTHING {
                let bounds = [with_cutouts, visibility];
                return sample(frame, light, receiver, number, linking, bounds, answer, memory);
            }
        }
        answer.visibility = visibility;
        if !frame.irradiance || visibility == 0.0 {
            return answer;
        }
        let most = unshadowed();
        if triangles == 0 || !memory.coverage.is_touched {
            return answer.lit_by(most);
        }
        if !same_region {
            memory.opaque.add_polygon(&shading_horizon);
            if memory.visibility(emitter.domain, false, true).is_err() {
                return sample(frame, light, receiver, number, linking, [0.0, 1.0], answer, memory);
            }
        }
        let boundary = memory.coverage.trapezoids.iter().flat_map(|t| pieces(t, &projection)).collect();
        // Two sums of the same whole differ by rounding.
        answer.with(irradiance::from_part(light, &emitter, receiver, boundary).min(most), most)
    }
}

impl Answer {
    /// With all of the irradiance that there is without shadow.
    fn lit_by(self, unshadowed: DVec3) -> Self {
        self.with(unshadowed, unshadowed)
    }

    /// With this irradiance, of that without shadow.
    fn with(self, irradiance: DVec3, unshadowed: DVec3) -> Self {
        let whole = unshadowed.element_sum();
        let irradiance_ratio = if whole > 0.0 { irradiance.element_sum() / whole } else { 0.0 };
        Self { irradiance, irradiance_ratio, ..self }
    }
}

impl Memory {
    /// V of what the outlines leave of a light, with or without cut-outs as if they were solid.
    fn visibility(&mut self, domain: Domain, cutouts: bool, wants_pieces: bool) -> Result<f64, OverBudget> {
        if self.opaque.triangles + self.cutouts.triangles > MAX_TRIANGLES {
            return Err(OverBudget);
        }
        let cutouts = cutouts.then(|| self.cutouts.edges()).into_iter().flatten();
        let area = self.coverage.uncovered(self.opaque.edges().chain(cutouts), domain, wants_pieces, BUDGET)?;
        if !self.coverage.is_touched {
            return Ok(1.0);
        }
        let whole = if domain == Domain::Disk { PI } else { 4.0 };
        let visibility = (area / whole).clamp(0.0, 1.0);
        Ok(if visibility > NOTHING { visibility } else { 0.0 })
    }
}

/// Projects what lies between the receiver and the light.
fn gather(
    frame: &Frame,
    emitter: &Emitter,
    projection: &Projection,
    ray: &ShadowRay,
    linking: &Linking,
    memory: &mut Memory,
) {
    let Memory { scratch, opaque, cutouts, .. } = memory;
    let mut view: Option<View> = None;
    let scene = frame.scene;
    frame.bvh.in_pyramid(ray.origin, &projection.planes(), scratch, |instance, triangle| {
        if (instance, triangle) == ray.source || opaque.triangles + cutouts.triangles > MAX_TRIANGLES {
            return;
        }
        if view.as_ref().is_none_or(|view| view.instance != instance) {
            let placed = &scene.instances[instance as usize];
            let cutout = scene.meshes[placed.mesh].material.and_then(|m| scene.materials[m].cutout.as_ref());
            let is_hole = cutout.is_some_and(|cutout| cutout.texture.is_none() && !cutout.is_solid(DVec2::ZERO));
            let homogeneous_from_mesh = projection.homogeneous_from_scene * placed.scene_from_mesh.matrix3;
            view = Some(View {
                instance,
                segment: frame.bvh.segment(instance, ray),
                homogeneous_from_mesh,
                determinant: homogeneous_from_mesh.determinant(),
                blocks: linking.blocks(instance) && !is_hole,
                is_cutout: cutout.is_some_and(|cutout| cutout.texture.is_some()),
            });
        }
        let Some(view) = view.as_ref().filter(|view| view.blocks) else { return };
        let corners = frame.bvh.corners(instance, triangle);
        let relative = corners.map(|corner| corner - view.segment.origin);
        let homogeneous = relative.map(|corner| view.homogeneous_from_mesh * corner);
        if is_outside(&homogeneous, emitter.distant) {
            return;
        }
        let normal = normal_of(corners);
        let height = view.segment.origin_height(normal, relative[0]);
        if height == 0.0 {
            return;
        }
        let is_near = !emitter.distant && homogeneous.iter().all(|c| (c.z - 1.0).abs() <= NEAR_LIGHT_PLANE);
        if is_near && is_in_light_plane(frame, emitter, ray, instance, normal, relative[0]) {
            return;
        }
        let mesh = &scene.meshes[scene.instances[instance as usize].mesh];
        let keys = mesh.triangles[triangle as usize].map(|index| {
            // The two zeros are one place.
            mesh.positions[index as usize].to_array().map(|x| (x + 0.0).to_bits())
        });
        let outline = if view.is_cutout { &mut *cutouts } else { &mut *opaque };
        outline.add(emitter.distant, instance, keys, homogeneous, height * view.determinant.signum());
    });
}

/// Whether a triangle of homogeneous corners lies beyond one side of the light's pyramid.
fn is_outside(corners: &[DVec3; 3], distant: bool) -> bool {
    let [a, b, c] = corners;
    let all = |outside: fn(&DVec3) -> bool| outside(a) && outside(b) && outside(c);
    all(|p| p.x >= p.z)
        || all(|p| -p.x >= p.z)
        || all(|p| p.y >= p.z)
        || all(|p| -p.y >= p.z)
        || (!distant && all(|p| p.z >= 1.0))
}

/// Whether a triangle lies in the plane of the light, as far as rounding can tell: it blocks nothing, for an occluder lies
/// strictly between.
fn is_in_light_plane(
    frame: &Frame,
    emitter: &Emitter,
    ray: &ShadowRay,
    instance: u32,
    normal: DVec3,
    corner: DVec3,
) -> bool {
    SQUARE.into_iter().all(|uv| {
        let to_light = emitter.at(uv);
        frame.bvh.segment(instance, &ShadowRay { to_light, ..*ray }).end_height(normal, corner) == 0.0
    })
}

/// The part of the light's square below the plane through the receiver with this normal; empty where there is none.
fn below(emitter: &Emitter, projection: &Projection, normal: DVec3) -> Vec<DVec2> {
    let [along_u, along_v] = projection.half.map(|half| normal.dot(half));
    let depth = |uv: DVec2| -(normal.dot(emitter.center) + uv.x * along_u + uv.y * along_v);
    if SQUARE.iter().all(|&uv| depth(uv) <= 0.0) {
        return Vec::new();
    }
    clip_polygon(&SQUARE, depth)
}

/// The boundary of a trapezoid of the light's plane, counter-clockwise.
fn pieces(trapezoid: &Trapezoid, projection: &Projection) -> impl Iterator<Item = Piece> {
    let [half_u, half_v] = projection.half;
    let [from, to] = trapezoid.u;
    let at = |u: f64, v: f64| u * half_u + v * half_v;
    let arc = |from: f64, to: f64| Piece::Arc(Arc { u: half_u, v: half_v, from, to });
    // The angle of a point of the upper half of the circle.
    let angle = |u: f64| half_chord(u).atan2(u);
    let ends = |border: Border, sign: f64| match border {
        Border::Line(v) => v,
        Border::Arc => [sign * half_chord(from), sign * half_chord(to)],
    };
    let (low, high) = (ends(trapezoid.lower, -1.0), ends(trapezoid.upper, 1.0));
    let lower = match trapezoid.lower {
        Border::Line(_) => Piece::Segment { from: at(from, low[0]), to: at(to, low[1]) },
        Border::Arc => arc(-angle(from), -angle(to)),
    };
    let upper = match trapezoid.upper {
        Border::Line(_) => Piece::Segment { from: at(to, high[1]), to: at(from, high[0]) },
        Border::Arc => arc(angle(to), angle(from)),
    };
    let right = Piece::Segment { from: at(to, low[1]), to: at(to, high[1]) };
    let left = Piece::Segment { from: at(from, high[0]), to: at(from, low[0]) };
    [lower, right, upper, left].into_iter()
}

/// The sampled answer, within bounds on V.
#[expect(clippy::too_many_arguments, reason = "it is the tail of `answer`")]
fn sample(
    frame: &Frame,
    light: &AreaLight,
    receiver: &Receiver,
    number: u32,
    linking: &Linking,
    [least, most]: [f64; 2],
    answer: Answer,
    memory: &mut Memory,
) -> Answer {
    let rays = Rays { samples: SAMPLES, pattern: Pattern::Sobol, seed: REFERENCE_SEED };
    let seen = rays.trace(frame, light, receiver, number, linking, &mut memory.scratch);
    let visibility = (f64::from(seen.count) / f64::from(seen.samples)).clamp(least, most);
    let answer = Answer { visibility, sampled: true, rays: seen.rays, ..answer };
    if !frame.irradiance {
        return answer;
    }
    let unshadowed = irradiance::unshadowed(light, receiver);
    answer.with(seen.irradiance_ratio * unshadowed, unshadowed)
}

impl Technique for Exact {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let linking = Linking::of(frame.scene, light);
        let width = frame.receivers.size[0] as usize;
        let mut passes = Vec::new();
        let answers: Vec<Option<Answer>> = timed(&mut passes, "exact", || {
            // By pixel, not by row: a row of umbra may take as long as all others.
            let pixels = frame.receivers.pixels.par_iter().enumerate();
            pixels
                .with_max_len(16)
                .map_init(Memory::default, |memory, (index, pixel)| {
                    frame.progress.check()?;
                    let receiver = pixel.as_ref();
                    let answer = receiver.map(|r| Self::answer(frame, light, r, index as u32, &linking, memory));
                    if index % width == width - 1 {
                        frame.progress.advance(1)?;
                    }
                    Ok(answer)
                })
                .collect::<Result<_>>()
        })?;
        let mut image = LightImage { passes, ..LightImage::default() };
        for answer in answers {
            let missed = Answer { visibility: 1.0, irradiance_ratio: 1.0, ..UNSEEN };
            let Answer { visibility, irradiance, irradiance_ratio, facing, sampled, rays, .. } =
                answer.unwrap_or(missed);
            image.push(visibility, frame.irradiance.then_some((irradiance, irradiance_ratio)), facing);
            image.sampled.push(sampled);
            image.rays += u64::from(rays);
        }
        Ok(image)
    }

    fn parameters(&self) -> Value {
        json!({ "samples_where_not_exact": SAMPLES })
    }
}
