//! What the exact reference costs: whole images by the command line, and receivers by the triangles that lie between them and
//! the light.
//!
//! `bench_exact PENUMBRA_BINARY SCENES_FOLDER OUT.json OUT.png` prints tables, writes both files, and fails where an image
//! takes longer than it may.

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::Instant;

use bench_rays::judged::{self, SCENES};
use bench_rays::machine::{children_user_seconds, cpu_name, load_average, thread_seconds};
use bench_rays::{Outcome, line_through};
use penumbra::progress::Progress;
use penumbra::reference::exact::{Exact, Memory};
use penumbra::scene::Projection;
use penumbra::techniques::{Frame, Linking};
use plotters::prelude::*;
use rayon::prelude::*;
use serde_json::{Value, json};

/// The images: scene, how it is completed, and the seconds that it may take on four threads.
const IMAGES: [(&str, &[&str], f64); 3] = [
    ("bunny", &["--add-light", "auto", "--add-floor"], 60.0),
    ("buddha", &["--add-light", "auto", "--add-floor"], 600.0),
    ("kitchen", &["--add-light", "rect:at=0.08/2.0/-3.3,to=0.08/2.0/0,size=1.3x2.2"], 600.0),
];

/// Receivers of a scene whose cost is measured.
const RECEIVERS: usize = 3000;

/// The exponent is that of receivers with at least so many triangles before the light: with fewer, what is the same for all
/// receivers counts for more.
const MANY: u32 = 64;

/// Width and height of the plot, pixels.
const PLOT: (u32, u32) = (1000, 640);

fn main() -> Outcome<ExitCode> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [penumbra, scenes, output, plot] = arguments.as_slice() else {
        return Err("usage: bench_exact PENUMBRA_BINARY SCENES_FOLDER OUT.json OUT.png".into());
    };
    let threads = rayon::current_num_threads();
    println!("{}, {threads} threads\n", cpu_name());
    println!("`penumbra reference` at 320x240, V of one rect light; `load before`: tasks running beside it\n");
    println!("| scene | wall s | may take s | user s | peak MB | load before |\n|---|---|---|---|---|---|");
    let mut images = Vec::new();
    let mut is_in_time = true;
    for (name, options, limit) in IMAGES {
        let image = image(name, Path::new(penumbra), Path::new(scenes), options)?;
        println!(
            "| {name} | {:.1} | {limit} | {:.1} | {:.0} | {:.1} |",
            image.wall_s, image.user_s, image.peak_mb, image.load_before
        );
        is_in_time &= image.wall_s <= limit;
        images.push(json!({
            "scene": name, "options": options, "wall_s": image.wall_s, "limit_s": limit, "user_s": image.user_s,
            "peak_mb": image.peak_mb, "load_before": image.load_before,
        }));
    }

    let mut costs = Vec::new();
    for (name, _) in SCENES {
        costs.push((name, costs_of(name, Path::new(scenes))?));
    }
    println!(
        "\nProcessor time of V at {RECEIVERS} receivers of each scene, rect light, by triangles before the light\n"
    );
    println!("| triangles | receivers | median µs | 95 % µs |\n|---|---|---|---|");
    let all: Vec<Cost> = costs.iter().flat_map(|(_, costs)| costs).copied().collect();
    let bins = bins(&all);
    for bin in &bins {
        println!("| {}-{} | {} | {:.1} | {:.1} |", bin.from, 2 * bin.from - 1, bin.count, bin.median_us, bin.p95_us);
    }
    let many: Vec<(f64, f64)> = all.iter().filter(|cost| cost.triangles >= MANY).map(Cost::logarithms).collect();
    let (exponent, at_one) = line_through(&many);
    println!("\nfrom {MANY} triangles on: {:.3} µs · triangles^{exponent:.2}", 10f64.powf(at_one));
    draw(Path::new(plot), &costs, &bins, (exponent, at_one))?;

    let record = json!({
        "cpu": cpu_name(), "threads": threads, "images": images, "exponent": exponent, "us_of_one": 10f64.powf(at_one),
        "bins": bins.iter().map(Bin::to_json).collect::<Vec<_>>(),
        "receivers": costs.iter().map(|(name, costs)| {
            json!({"scene": name, "triangles_and_us": costs.iter().map(|c| json!([c.triangles, c.us])).collect::<Vec<_>>()})
        }).collect::<Vec<_>>(),
    });
    std::fs::write(output, serde_json::to_string(&record)? + "\n")?;
    Ok(if is_in_time { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// What an image took.
struct Image {
    wall_s: f64,
    user_s: f64,
    peak_mb: f64,
    load_before: f64,
}

fn image(name: &str, penumbra: &Path, scenes: &Path, options: &[&str]) -> Outcome<Image> {
    let file = SCENES.iter().find(|(scene, _)| *scene == name).expect("one of the scenes").1;
    let temporary =
        |extension: &str| std::env::temp_dir().join(format!("bench_exact.{}.{extension}", std::process::id()));
    let (mut scene, output) = (scenes.join(file), temporary("exr"));
    if name == "kitchen" {
        scene = with_kitchen_camera(&scene, scenes, temporary("glb"))?;
    }
    let load_before = load_average();
    let (user, start) = (children_user_seconds(), Instant::now());
    let mut command = Command::new(penumbra);
    command.arg("reference").arg(&scene).args(options).args(["--method", "exact", "--size", "320x240", "--json", "-o"]);
    let run = command.arg(&output).output()?;
    let wall_s = start.elapsed().as_secs_f64();
    let user_s = children_user_seconds() - user;
    if !run.status.success() {
        return Err(String::from_utf8_lossy(&run.stderr).into_owned().into());
    }
    std::fs::remove_file(&output)?;
    if name == "kitchen" {
        std::fs::remove_file(&scene)?;
    }
    let record: Value = serde_json::from_slice(&run.stdout)?;
    let peak_mb = record.pointer("/memory_mb/peak_rss").and_then(Value::as_f64).unwrap_or(f64::NAN);
    Ok(Image { wall_s, user_s, peak_mb, load_before })
}

/// The kitchen with its author's camera, which its file does not hold.
fn with_kitchen_camera(scene: &Path, scenes: &Path, output: PathBuf) -> Outcome<PathBuf> {
    let judged = judged::load("kitchen", scenes)?;
    let camera = &judged.camera;
    let Projection::Perspective { fov_y } = camera.projection else { return Err("the kitchen has a pinhole".into()) };
    let mut world_from_camera = camera.scene_from_camera;
    world_from_camera.translation += judged.scene.origin_world;

    // A header of 12 bytes, then chunks: length, type, contents; the first is JSON.
    let glb = std::fs::read(scene)?;
    let word = |at: usize| u32::from_le_bytes([glb[at], glb[at + 1], glb[at + 2], glb[at + 3]]) as usize;
    let (json, rest) = glb[20..].split_at(word(12));
    let mut file: Value = serde_json::from_slice(json)?;
    let nodes = file["nodes"].as_array_mut().ok_or("no nodes")?;
    let node = nodes.len();
    nodes.push(json!({"camera": 0, "matrix": glam::DMat4::from(world_from_camera).to_cols_array()}));
    let roots = file["scenes"][0]["nodes"].as_array_mut().ok_or("no scene")?;
    roots.push(json!(node));
    file["cameras"] = json!([{"type": "perspective", "perspective": {"yfov": fov_y, "znear": 0.001}}]);
    let mut json = serde_json::to_vec(&file)?;
    json.resize(json.len().next_multiple_of(4), b' ');
    let mut copy = glb[..8].to_vec();
    copy.extend(u32::try_from(20 + json.len() + rest.len())?.to_le_bytes());
    copy.extend(u32::try_from(json.len())?.to_le_bytes());
    copy.extend(&glb[16..20]);
    copy.extend(json);
    copy.extend(rest);
    std::fs::write(&output, copy)?;
    Ok(output)
}

/// What a receiver cost.
#[derive(Clone, Copy)]
struct Cost {
    triangles: u32,
    us: f64,
}

impl Cost {
    fn logarithms(&self) -> (f64, f64) {
        (f64::from(self.triangles).log10(), self.us.log10())
    }
}

/// What receivers of a scene cost that have a triangle before the light.
fn costs_of(name: &str, scenes: &Path) -> Outcome<Vec<Cost>> {
    let judged = judged::load(name, scenes)?;
    let bvh = judged.bvh();
    let receivers = judged.receivers(&bvh)?;
    let progress = Progress::default();
    let scene = &judged.scene;
    let frame = Frame { scene, bvh: &bvh, receivers: &receivers, irradiance: false, progress: &progress, buffers: None };
    let light = &judged.lights[0];
    let linking = Linking::of(scene, light);
    let hits: Vec<_> = judged::scattered(&receivers).take(RECEIVERS).collect();
    let cost = |memory: &mut Memory, &(number, receiver): &_| {
        let start = thread_seconds();
        let answer = Exact::answer(&frame, light, receiver, number, &linking, memory);
        Cost { triangles: answer.triangles, us: 1e6 * (thread_seconds() - start) }
    };
    let costs: Vec<Cost> = hits.par_iter().map_init(Memory::default, cost).collect();
    Ok(costs.into_iter().filter(|cost| cost.triangles > 0).collect())
}

/// Receivers with `from` to `2·from − 1` triangles.
struct Bin {
    from: u32,
    count: usize,
    median_us: f64,
    p95_us: f64,
}

impl Bin {
    fn to_json(&self) -> Value {
        json!({"from": self.from, "count": self.count, "median_us": self.median_us, "p95_us": self.p95_us})
    }
}

fn bins(costs: &[Cost]) -> Vec<Bin> {
    let bin = |log: u32| {
        let mut us: Vec<f64> = costs.iter().filter(|c| c.triangles.ilog2() == log).map(|c| c.us).collect();
        us.sort_by(f64::total_cmp);
        let at = |fraction: f64| us[(fraction * (us.len() - 1) as f64).round() as usize];
        (!us.is_empty()).then(|| Bin { from: 1 << log, count: us.len(), median_us: at(0.5), p95_us: at(0.95) })
    };
    (0..u32::BITS).filter_map(bin).collect()
}

/// Time against triangles, both logarithmic: receivers as points, medians as a line, the fitted power as another.
fn draw(path: &Path, scenes: &[(&str, Vec<Cost>)], bins: &[Bin], (exponent, at_one): (f64, f64)) -> Outcome<()> {
    // The bitmap backend brings no font.
    let font = epaint_default_fonts::UBUNTU_LIGHT;
    plotters::style::register_font("sans-serif", FontStyle::Normal, font).map_err(|_| "the font can't be read")?;
    let all = || scenes.iter().flat_map(|(_, costs)| costs);
    let most = all().map(|cost| cost.triangles).max().unwrap_or(1);
    let (least_us, most_us) = all().fold((f64::INFINITY, 0f64), |(a, b), cost| (a.min(cost.us), b.max(cost.us)));
    let area = BitMapBackend::new(path, PLOT).into_drawing_area();
    area.fill(&WHITE)?;
    let mut chart = ChartBuilder::on(&area)
        .margin(16)
        .x_label_area_size(48)
        .y_label_area_size(72)
        .caption("Exact visibility of a receiver", ("sans-serif", 24))
        .build_cartesian_2d((1.0..f64::from(most)).log_scale(), (least_us..most_us).log_scale())?;
    let count = |x: &f64| format!("{x:.0}");
    chart
        .configure_mesh()
        .x_desc("triangles between receiver and light")
        .y_desc("processor time, µs")
        .label_style(("sans-serif", 16))
        .x_label_formatter(&count)
        .y_label_formatter(&count)
        .draw()?;
    for (index, (name, costs)) in scenes.iter().enumerate() {
        let color = Palette99::pick(index).to_rgba();
        let points = costs.iter().map(|c| Circle::new((f64::from(c.triangles), c.us), 1, color.mix(0.4).filled()));
        chart.draw_series(points)?.label(*name).legend(move |(x, y)| Circle::new((x + 10, y), 4, color.filled()));
    }
    // A bin's receivers lie around the middle of its logarithms.
    let medians = bins.iter().map(|bin| (f64::from(bin.from) * 2f64.sqrt(), bin.median_us));
    chart
        .draw_series(LineSeries::new(medians, BLACK.stroke_width(2)))?
        .label("median")
        .legend(|(x, y)| PathElement::new([(x, y), (x + 20, y)], BLACK.stroke_width(2)));
    let fit = [f64::from(MANY), f64::from(most)].map(|x| (x, 10f64.powf(at_one) * x.powf(exponent)));
    chart
        .draw_series(LineSeries::new(fit, RED.stroke_width(2)))?
        .label(format!("triangles^{exponent:.2}"))
        .legend(|(x, y)| PathElement::new([(x, y), (x + 20, y)], RED.stroke_width(2)));
    chart
        .configure_series_labels()
        .position(SeriesLabelPosition::UpperLeft)
        .label_font(("sans-serif", 16))
        .background_style(WHITE.mix(0.8))
        .border_style(BLACK)
        .draw()?;
    area.present()?;
    Ok(())
}
