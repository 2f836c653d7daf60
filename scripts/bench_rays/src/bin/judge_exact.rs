//! The exact reference judged by Embree 4: the same receivers, the same light samples, and a difference that has to fall as
//! the samples grow.
//!
//! `judge_exact EMBREE_LIBRARY SCENES_FOLDER OUT.json [SCENE…]` prints a table, writes the JSON file, and fails where the
//! difference does not fall or stays too large.
//!
//! Embree's rays start a small step off the surface and end just before the light (`cases::EMBREE_OFFSET`), all in `f32`,
//! with the scene flag ROBUST; the exact answer is for the receiver itself. The step is relative to the largest coordinate, so
//! Embree's coordinates are relative to the middle of the receivers: from the corner of the palm's sea, 196 m away, steps of
//! 0.2 mm leave an error of 2e-3 to 6e-3 that no number of samples takes away.

use std::path::Path;
use std::process::ExitCode;

use bench_rays::cases::{EMBREE_OFFSET, embree_origin, flatten};
use bench_rays::embree::{self, Embree};
use bench_rays::judged::{self, Chosen, SCENES, choose};
use bench_rays::machine::{cpu_name, timed};
use bench_rays::{Outcome, judged::Judged};
use glam::{DVec3, Vec3};
use penumbra::progress::Progress;
use penumbra::receivers::Receivers;
use penumbra::reference::exact::REFERENCE_SEED;
use penumbra::sampling::{Pattern, Sampler};
use penumbra::scene::AreaLight;
use penumbra::techniques::Frame;
use rayon::prelude::*;
use serde_json::{Value, json};

/// Receivers a light, in its penumbra and of each other kind.
const PENUMBRA: usize = 96;
const OTHERS: usize = 32;

/// Binary logarithms of the sample counts: each set is the beginning of the next.
const LOG_SAMPLES: [u32; 5] = [6, 8, 10, 12, 14];

/// Not the reference's.
const SEED: u32 = 2;
const _: () = assert!(SEED != REFERENCE_SEED);

/// The largest root mean square difference at the most samples.
const TOLERANCE: f64 = 5e-4;

/// The slowest fall: that of samples that know nothing of each other.
const SLOWEST: f64 = -0.5;

fn main() -> Outcome<ExitCode> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [library, scenes, output, wanted @ ..] = arguments.as_slice() else {
        return Err("usage: judge_exact EMBREE_LIBRARY SCENES_FOLDER OUT.json [SCENE...]".into());
    };
    let embree = Embree::load(Path::new(library))?;
    println!("{}, {} threads; Embree {}, ROBUST", cpu_name(), rayon::current_num_threads(), embree.version);
    println!("RMSE of Embree's V against exact at up to {PENUMBRA} receivers in the penumbra, by samples a receiver;");
    println!(
        "wrong: Embree's rays that are blocked from lit receivers or free from ones in the umbra, of all such rays\n"
    );
    println!(
        "{:10} {:14} {:>8} {:>8} {:>8} {:>8} {:>8}  exponent        wrong",
        "scene", "light", "2^6", "2^8", "2^10", "2^12", "2^14"
    );
    let mut records = Vec::new();
    let mut failures = Vec::new();
    for (name, _) in SCENES {
        if wanted.is_empty() || wanted.iter().any(|w| w == name) {
            let judged = judged::load(name, Path::new(scenes))?;
            let (record, ms) = timed(|| judge(name, &judged, &embree, &mut failures));
            let mut record = record?;
            record["seconds"] = json!(ms / 1e3);
            records.push(record);
        }
    }
    let record = json!({
        "embree": embree.version, "log_samples": LOG_SAMPLES, "tolerance": TOLERANCE, "scenes": records, "failures": failures,
    });
    std::fs::write(output, serde_json::to_string_pretty(&record)? + "\n")?;
    for failure in &failures {
        println!("FAILED: {failure}");
    }
    Ok(if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn judge(name: &str, judged: &Judged, embree: &Embree, failures: &mut Vec<String>) -> Outcome<Value> {
    let bvh = judged.bvh();
    let receivers = judged.receivers(&bvh)?;
    let progress = Progress::default();
    let frame =
        Frame { scene: &judged.scene, bvh: &bvh, receivers: &receivers, irradiance: false, progress: &progress, buffers: None };
    let middle = middle(&receivers);
    let embree_scene = embree.build(&flatten(&judged.scene, middle));
    let mut lights = Vec::new();
    for light in &judged.lights {
        let choice = choose(&frame, light, PENUMBRA, OTHERS);
        let counts = |kind: &[Chosen]| -> Vec<Vec<Count>> {
            kind.par_iter().map(|chosen| trace(&embree_scene, middle, light, chosen)).collect()
        };
        let (mut wrong, mut of) = (0, 0);
        for (kind, visibility) in [(&choice.lit, 1.0), (&choice.umbra, 0.0)] {
            for count in counts(kind).iter().filter_map(|counts| counts.last()) {
                wrong += (f64::from(count.seen) - visibility * f64::from(count.of)).abs() as u64;
                of += u64::from(count.of);
            }
        }
        let mut record = json!({"light": light.name, "wrong": wrong, "of": of, "receivers": choice.penumbra.len()});
        if light.shape.is_point() {
            println!("{name:10} {:14} {:>54}  {wrong} of {of}", light.name, "");
            lights.push(record);
            continue;
        }
        let counts = counts(&choice.penumbra);
        let errors: Vec<f64> = (0..LOG_SAMPLES.len())
            .map(|i| {
                let square = |(counts, chosen): (&Vec<Count>, &Chosen)| {
                    (f64::from(counts[i].seen) / f64::from(counts[i].of) - chosen.answer.visibility).powi(2)
                };
                let sum: f64 = counts.iter().zip(&choice.penumbra).map(square).sum();
                (sum / choice.penumbra.len() as f64).sqrt()
            })
            .collect();
        let exponent = slope(&errors);
        let columns: Vec<String> = errors.iter().map(|error| format!("{error:8.1e}")).collect();
        println!("{name:10} {:14} {}     {exponent:.2}  {wrong} of {of}", light.name, columns.join(" "));
        let last = errors[LOG_SAMPLES.len() - 1];
        let what = format!("{name}, {}", light.name);
        if choice.penumbra.len() < PENUMBRA {
            failures.push(format!("{what}: {} receivers in the penumbra", choice.penumbra.len()));
        }
        if !errors.is_sorted_by(|a, b| a > b) || exponent > SLOWEST {
            failures.push(format!("{what}: the error does not fall as it should, exponent {exponent:.2}"));
        }
        if last > TOLERANCE {
            failures.push(format!("{what}: {last:.1e} is above {TOLERANCE:.0e}"));
        }
        record["rmse"] = json!(errors);
        record["exponent"] = json!(exponent);
        lights.push(record);
    }
    Ok(json!({"scene": name, "lights": lights}))
}

/// The median of the receivers' coordinates along each axis.
fn middle(receivers: &Receivers) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|axis| {
        let mut coordinates: Vec<f64> = receivers.hits().map(|receiver| receiver.position[axis]).collect();
        coordinates.sort_by(f64::total_cmp);
        coordinates[coordinates.len() / 2]
    }))
}

/// Samples that were seen, of how many.
struct Count {
    seen: u32,
    of: u32,
}

/// What Embree sees from a receiver, at each of the sample counts.
fn trace(scene: &embree::Scene, middle: DVec3, light: &AreaLight, chosen: &Chosen) -> Vec<Count> {
    let receiver = &chosen.receiver;
    let emitter = light.emitter(receiver.position).expect("the light faces the receiver");
    let sampler = Sampler::new(Pattern::Sobol, 1 << LOG_SAMPLES[LOG_SAMPLES.len() - 1], chosen.number, SEED);
    let origin = embree_origin(receiver, middle);
    let origin_moved = middle + Vec3::from(origin).as_dvec3();
    let is_seen = |index: u32| {
        let to_light = emitter.at(sampler.on_emitter(index, &emitter));
        if receiver.normal.dot(to_light) <= 0.0 {
            return false;
        }
        let (direction, t_far) = if emitter.distant {
            (to_light, f32::INFINITY)
        } else {
            (receiver.position + to_light - origin_moved, 1.0 - EMBREE_OFFSET as f32)
        };
        !scene.is_occluded(origin, direction.as_vec3().to_array(), t_far)
    };
    let (mut seen, mut from) = (0, 0);
    let mut count = |of: u32| {
        seen += (from..of).filter(|&index| is_seen(index)).count() as u32;
        from = of;
        Count { seen, of }
    };
    LOG_SAMPLES.iter().map(|&log| count(1 << log)).collect()
}

/// The exponent of the fall: the slope of the line of least squares through the logarithms.
fn slope(errors: &[f64]) -> f64 {
    let points: Vec<(f64, f64)> = LOG_SAMPLES.iter().zip(errors).map(|(&x, y)| (f64::from(x), y.log2())).collect();
    bench_rays::line_through(&points).0
}
