//! Occlusion rays per second of Penumbra and of Embree 4: the same receivers, light samples, threads and minute.
//!
//! `bench_rays EMBREE_LIBRARY PENUMBRA_BINARY SCENES_FOLDER OUT.json [SCENE…]` prints a table and writes the JSON file.
//!
//! Both sides trace precomputed rays of one receiver after the other, rows of receivers spread over the same thread pool, in
//! rounds that alternate. Embree gets each mesh instance as one geometry in scene space (no instancing), the scene flag
//! ROBUST, medium quality and single rays (`rtcOccluded1`); its rays start a small step off the surface and end just before
//! the light (see `cases::EMBREE_OFFSET`), where ours start on it and leave out the receiver's triangle.

use std::path::{Path, PathBuf};
use std::process::Command;

use glam::DVec3;
use penumbra::geometry::bvh::{SceneBvh, Scratch};
use penumbra::progress::Progress;
use penumbra::techniques::rays::Rays as RaysTechnique;
use penumbra::techniques::{Frame, Technique};
use rayon::prelude::*;
use serde_json::{Value, json};

use bench_rays::cases::{self, Case, LIGHTS, Rays, SAMPLES, SCENES, SIZE};
use bench_rays::embree::Embree;
use bench_rays::machine::{cpu_name, process_seconds, timed};
use bench_rays::{Outcome, check};

/// Alternating rounds a light.
const ROUNDS: usize = 7;

/// Receivers that a thread takes at once.
const CHUNK: usize = 1024;

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [library, penumbra, scenes, output, wanted @ ..] = arguments.as_slice() else {
        return Err("usage: bench_rays EMBREE_LIBRARY PENUMBRA_BINARY SCENES_FOLDER OUT.json [SCENE...]".into());
    };
    let embree = Embree::load(Path::new(library))?;
    let threads = rayon::current_num_threads();
    let cpu = cpu_name();
    println!("{cpu}, {threads} threads; Embree {}, ROBUST, medium quality, single rays", embree.version);
    println!("{}x{} receivers, {SAMPLES} light samples, medians of {ROUNDS} alternating rounds\n", SIZE[0], SIZE[1]);

    let mut records = Vec::new();
    for (name, file) in SCENES {
        if !wanted.is_empty() && !wanted.iter().any(|w| w == name) {
            continue;
        }
        let path = Path::new(scenes).join(file);
        records.push(measure(name, &path, &embree, Path::new(penumbra))?);
    }
    let record = json!({
        "cpu": cpu, "threads": threads, "embree": embree.version, "rounds": ROUNDS, "size": SIZE, "samples": SAMPLES,
        "scenes": records,
    });
    std::fs::write(output, serde_json::to_string_pretty(&record)? + "\n")?;
    Ok(())
}

fn measure(name: &str, path: &Path, embree: &Embree, penumbra: &Path) -> Outcome<Value> {
    let process = render_process(penumbra, path)?;
    let case = cases::load(name, path)?;
    let triangles = case.scene.triangle_count();

    // Best of five: a build takes tens of milliseconds, in which a busy machine shows most.
    let mut build_ms = f64::INFINITY;
    let mut embree_build_ms = f64::INFINITY;
    let meshes = cases::flatten(&case.scene, DVec3::ZERO);
    for _ in 0..5 {
        build_ms = build_ms.min(timed(|| build(&case)).1);
        embree_build_ms = embree_build_ms.min(timed(|| embree.build(&meshes)).1);
    }
    let bvh = build(&case);
    let embree_scene = embree.build(&meshes);
    let receivers = cases::receivers(&case, &bvh)?;

    println!(
        "{name}: {triangles} triangles; load {:.0} ms, build {build_ms:.0} ms (Embree {embree_build_ms:.0} ms);",
        case.load_ms
    );
    println!(
        "  hierarchy {:.0} B/triangle; whole process {:.0} MB = {:.0} B/triangle, load {:.0} ms, build {:.0} ms",
        bvh.bytes() as f64 / triangles as f64,
        process.peak_mb,
        process.peak_mb * 1e6 / triangles as f64,
        process.load_ms,
        process.build_ms
    );
    println!(
        "  light     Mrays   blocked  differ   ours Mrays/s  Embree Mrays/s  ratio (IQR)       CPU ratio  technique Mrays/s"
    );
    let mut lights = Vec::new();
    for (light_name, factor) in LIGHTS {
        let light = cases::resized(&case.light, factor);
        let rays = Rays::new(&receivers, &light);
        let ours = |results: &mut [bool]| {
            trace(&rays, results, Scratch::default, |bundle, index, scratch| {
                bvh.is_blocked(&rays.shadow_ray(bundle, index), scratch, |_| true)
            })
        };
        let theirs = |results: &mut [bool]| {
            trace(
                &rays,
                results,
                || (),
                |bundle, index, ()| {
                    embree_scene.is_occluded(
                        bundle.origin_f32,
                        rays.to_light_f32[index],
                        1.0 - cases::EMBREE_OFFSET as f32,
                    )
                },
            )
        };
        let mut our_results = vec![false; rays.to_light.len()];
        let mut their_results = our_results.clone();
        ours(&mut our_results);
        theirs(&mut their_results);
        let (mut a, mut b, mut ratios, mut cpu_ratios) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let mut full = Vec::new();
        let count = rays.to_light.len() as f64;
        let technique = RaysTechnique { samples: SAMPLES, ..RaysTechnique::default() };
        for _ in 0..ROUNDS {
            let our_cpu = process_seconds();
            let ((), our_ms) = timed(|| ours(&mut our_results));
            let their_cpu = process_seconds();
            let ((), their_ms) = timed(|| theirs(&mut their_results));
            let end_cpu = process_seconds();
            a.push(count / our_ms / 1e3);
            b.push(count / their_ms / 1e3);
            ratios.push(their_ms / our_ms);
            cpu_ratios.push((end_cpu - their_cpu) / (their_cpu - our_cpu));
            let progress = Progress::default();
            let frame =
                Frame { scene: &case.scene, bvh: &bvh, receivers: &receivers, irradiance: false, progress: &progress, buffers: None };
            let (image, ms) = timed(|| technique.render(&frame, &light));
            full.push(image?.rays as f64 / ms / 1e3);
        }
        let [a, b, ratio, cpu_ratio, full] = [a, b, ratios, cpu_ratios, full].map(|values| Quartiles::of(&values));
        let blocked = |results: &[bool]| results.iter().filter(|&&blocked| blocked).count();
        let differing: Vec<usize> = (0..our_results.len()).filter(|&i| our_results[i] != their_results[i]).collect();
        let checked = check::check(&case.scene, &rays, &our_results, &their_results, &differing);
        println!(
            "  {light_name:8} {:6.2}  {:7.3} % {:6} {:10.1}     {:10.1}      {:.2} ({:.2}-{:.2})   {:.2}      {:10.1}",
            count / 1e6,
            1e2 * blocked(&our_results) as f64 / count,
            differing.len(),
            a.median,
            b.median,
            ratio.median,
            ratio.low,
            ratio.high,
            cpu_ratio.median,
            full.median,
        );
        println!("           {checked}");
        lights.push(json!({
            "light": light_name, "rays": our_results.len(), "blocked": blocked(&our_results),
            "embree_blocked": blocked(&their_results), "differing": differing.len(), "check": checked.to_json(),
            "mrays_per_s": a.to_json(), "embree_mrays_per_s": b.to_json(), "ratio": ratio.to_json(),
            "cpu_time_ratio": cpu_ratio.to_json(), "technique_mrays_per_s": full.to_json(),
        }));
    }
    println!();
    Ok(json!({
        "scene": name, "triangles": triangles, "load_ms": case.load_ms, "build_ms": build_ms,
        "embree_build_ms": embree_build_ms, "hierarchy_bytes": bvh.bytes(),
        "process": {"peak_mb": process.peak_mb, "load_ms": process.load_ms, "build_ms": process.build_ms},
        "lights": lights,
    }))
}

fn build(case: &Case) -> SceneBvh<'_> {
    let mut bvh = SceneBvh::new(&case.scene);
    bvh.add(|_| true);
    bvh
}

/// Traces all rays on the thread pool.
fn trace<S>(
    rays: &Rays,
    results: &mut [bool],
    init: impl Fn() -> S + Sync + Send,
    is_blocked: impl Fn(&cases::Bundle, usize, &mut S) -> bool + Sync,
) {
    // Each chunk's results are its own part of the slice.
    let mut rest = results;
    let mut parts = Vec::new();
    for bundles in rays.bundles.chunks(CHUNK) {
        let first = bundles[0].first;
        let (part, tail) = rest.split_at_mut(bundles[bundles.len() - 1].end - first);
        parts.push((bundles, first, part));
        rest = tail;
    }
    parts.into_par_iter().with_max_len(1).for_each_init(init, |scratch, (bundles, first, part)| {
        for bundle in bundles {
            for index in bundle.first..bundle.end {
                part[index - first] = is_blocked(bundle, index, scratch);
            }
        }
    });
}

/// What the command reports of itself.
struct RenderProcess {
    peak_mb: f64,
    load_ms: f64,
    build_ms: f64,
}

/// Renders the scene in a process of its own, all of it in view.
fn render_process(penumbra: &Path, scene: &Path) -> Outcome<RenderProcess> {
    let image: PathBuf = std::env::temp_dir().join(format!("bench_rays.{}.exr", std::process::id()));
    let size = format!("{}x{}", SIZE[0], SIZE[1]);
    let output = Command::new(penumbra)
        .arg("render")
        .arg(scene)
        .arg("-o")
        .arg(&image)
        .args(["--json", "--add-light", "auto", "--size", &size, "--set", "samples=1"])
        .output()?;
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).into_owned().into());
    }
    std::fs::remove_file(&image)?;
    let record: Value = serde_json::from_slice(&output.stdout)?;
    let number = |pointer: &str| record.pointer(pointer).and_then(Value::as_f64).unwrap_or(f64::NAN);
    Ok(RenderProcess {
        peak_mb: number("/memory_mb/peak_rss"),
        load_ms: number("/time_ms/load"),
        build_ms: number("/time_ms/build"),
    })
}

/// Median and quartiles.
struct Quartiles {
    low: f64,
    median: f64,
    high: f64,
}

impl Quartiles {
    fn of(values: &[f64]) -> Self {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let at = |fraction: f64| sorted[(fraction * (sorted.len() - 1) as f64).round() as usize];
        Self { low: at(0.25), median: at(0.5), high: at(0.75) }
    }

    fn to_json(&self) -> Value {
        json!({"median": self.median, "quartiles": [self.low, self.high]})
    }
}
