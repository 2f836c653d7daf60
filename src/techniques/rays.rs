//! Ray-traced visibility: one any-hit ray from the receiver to each of N points of the light.
//!
//! Distribution ray tracing: Cook, Porter and Carpenter 1984; sample patterns in [`crate::sampling`]. Every shape, cut-outs
//! and instances included; the only error is that of the light's sampling.

use glam::DVec3;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{Entry, Frame, LightImage, Linking, Needs, Technique, parse_parameters, schema_of, timed};
use crate::Result;
use crate::geometry::bvh::{Scratch, ShadowRay};
use crate::geometry::irradiance;
use crate::receivers::Receiver;
use crate::sampling::{Pattern, Sampler};
use crate::scene::AreaLight;
use crate::scene::light::Domain;

/// Registered as `rays`.
pub const ENTRY: Entry = Entry {
    name: "rays",
    paper: "Cook, Porter, Carpenter 1984, \"Distributed Ray Tracing\"",
    summary: "traces a shadow ray to each sample of the light; every shape, exact but for the sampling",
    needs: Needs::Cpu,
    schema: schema_of::<Rays>,
    presets: &[],
    demo: &[
        "pattern=grid samples=16",
        "pattern=jittered samples=16",
        "pattern=halton samples=16",
        "pattern=sobol samples=16",
        "pattern=sobol samples=64",
        "pattern=sobol samples=256",
    ],
    build: |_, given| Ok(Box::new(parse_parameters::<Rays>(&ENTRY, given)?)),
};

/// Parameters of `rays`.
#[derive(Debug, Clone, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Rays {
    /// Light samples a receiver. The error falls as 1/N at best and 1/sqrt(N) at worst.
    #[schemars(range(min = 1, max = 16_777_216))]
    pub samples: u32,
    /// How the samples are spread over the light.
    pub pattern: Pattern,
    /// Chooses another set of samples.
    pub seed: u32,
}

impl Default for Rays {
    fn default() -> Self {
        Self { samples: 64, pattern: Pattern::Sobol, seed: 0 }
    }
}

/// What one receiver sees of one light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Seen {
    /// Samples seen.
    pub count: u32,
    /// Samples in all.
    pub samples: u32,
    /// E/E₀: the seen share of the samples' weights.
    pub irradiance_ratio: f64,
    /// Whether some of the light faces the receiver.
    pub facing: bool,
    /// Rays traced.
    pub rays: u32,
}

/// What a receiver sees of a light that does not face it.
const UNSEEN: Seen = Seen { count: 0, samples: 1, irradiance_ratio: 0.0, facing: false, rays: 0 };

impl Rays {
    /// What the receiver sees of the light; `number` picks its samples.
    pub fn trace(
        &self,
        frame: &Frame,
        light: &AreaLight,
        receiver: &Receiver,
        number: u32,
        linking: &Linking,
        scratch: &mut Scratch,
    ) -> Seen {
        let Some(emitter) = light.emitter(receiver.position) else { return UNSEEN };
        if !irradiance::reaches(&emitter, receiver) {
            return UNSEEN;
        }
        let samples = if emitter.domain == Domain::Point { 1 } else { self.samples };
        let sampler = Sampler::new(self.pattern, samples, number, self.seed);
        let mut seen = Seen { count: 0, samples, irradiance_ratio: 0.0, facing: true, rays: 0 };
        let (mut above, mut seen_weight, mut weight) = (0, 0.0, 0.0);
        let light_error = emitter.position_error(receiver.position);
        for index in 0..samples {
            let to_light = emitter.at(sampler.on_emitter(index, &emitter));
            let sample_weight =
                if frame.irradiance { irradiance::sample_weight(light, &emitter, receiver, to_light) } else { 0.0 };
            weight += sample_weight;
            if receiver.normal.dot(to_light) <= 0.0 {
                continue;
            }
            above += 1;
            if light.casts_shadow {
                seen.rays += 1;
                let ray = ShadowRay {
                    origin: receiver.position,
                    origin_error: receiver.position_error,
                    to_light,
                    light_error,
                    distant: emitter.distant,
                    source: (receiver.instance, receiver.triangle),
                };
                if frame.bvh.is_blocked(&ray, scratch, |instance| linking.blocks(instance)) {
                    continue;
                }
            }
            seen.count += 1;
            seen_weight += sample_weight;
        }
        // E = E₀ where nothing is hidden, however the weights lie; where all samples have missed what little of the light emits
        // this way (a narrow spread), the seen share of the area stands for that of the weights.
        seen.irradiance_ratio = if seen.count == above {
            1.0
        } else if weight > 0.0 {
            seen_weight / weight
        } else {
            f64::from(seen.count) / f64::from(above)
        };
        seen
    }
}

impl Technique for Rays {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let samples = if light.shape.is_point() { 1 } else { self.samples };
        let mut image = LightImage { samples, ..LightImage::default() };
        let linking = Linking::of(frame.scene, light);

        let [width, height] = frame.receivers.size;
        let mut passes = Vec::new();
        let rows: Vec<LightImage> = timed(&mut passes, "rays", || {
            (0..height)
                .into_par_iter()
                .map_init(Scratch::default, |scratch, y| {
                    let mut row = LightImage::default();
                    for x in 0..width {
                        let number = y * width + x;
                        frame.progress.check()?;
                        let Some(receiver) = &frame.receivers.pixels[number as usize] else {
                            row.push(1.0, frame.irradiance.then_some((DVec3::ZERO, 1.0)), false);
                            continue;
                        };
                        let seen = if linking.lights(receiver) {
                            self.trace(frame, light, receiver, number, &linking, scratch)
                        } else {
                            UNSEEN
                        };
                        row.rays += u64::from(seen.rays);
                        let irradiance = frame.irradiance.then(|| {
                            // Most pixels of most images are lit or dark: only what is seen costs a closed form.
                            let rgb = if seen.irradiance_ratio == 0.0 {
                                DVec3::ZERO
                            } else {
                                seen.irradiance_ratio * irradiance::unshadowed(light, receiver)
                            };
                            (rgb, if rgb == DVec3::ZERO { 0.0 } else { seen.irradiance_ratio })
                        });
                        row.push(f64::from(seen.count) / f64::from(seen.samples), irradiance, seen.facing);
                    }
                    frame.progress.advance(1)?;
                    Ok(row)
                })
                .collect::<Result<_>>()
        })?;
        for row in rows {
            image.visibility.extend(row.visibility);
            image.irradiance.extend(row.irradiance);
            image.irradiance_ratio.extend(row.irradiance_ratio);
            image.facing.extend(row.facing);
            image.rays += row.rays;
        }
        image.passes = passes;
        Ok(image)
    }

    fn parameters(&self) -> Value {
        serde_json::to_value(self).expect("parameters are numbers and names")
    }
}
