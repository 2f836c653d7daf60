//! `penumbra demo`.

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use image::imageops::{FilterType, crop_imm, overlay, resize};
use image::{DynamicImage, RgbImage};
use serde_json::Value;

use super::report::{Aov, Origin, Quantity, image_of};
use super::{print, with_bar};
use crate::image::{Image, write_exr, write_png};
use crate::metrics::{self, Mask};
use crate::picture::Canvas;
use crate::progress::Progress;
use crate::reference::exact::Exact;
use crate::render::{Rendering, Request, render};
use crate::scene::{Camera, Scene, procedural};
use crate::shading::Shading;
use crate::techniques::{ALL, Context, Entry, Needs, Technique, parse_settings};
use crate::{Error, Result};

/// Options of `demo`.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Directory for the images, made if it is not there
    #[arg(short, long, value_name = "DIR", default_value = "demo")]
    output: PathBuf,
}

/// Size of a panel's picture, pixels.
const PANEL: [u32; 2] = [400, 300];
/// Height of a panel's caption, pixels.
const CAPTION: u32 = 65;
/// Space between panels, pixels.
const GAP: u32 = 12;
const COLUMNS: u32 = 4;
/// The part of a panel that is shown enlarged in its corner: left, top, width, height as fractions; chosen to hold a wide
/// penumbra of the default scene.
const DETAIL: [f64; 4] = [0.47, 0.60, 0.09, 0.09];
/// How much larger it is shown.
const ENLARGED: u32 = 3;

/// A picture of the sheet with its caption.
struct Panel {
    picture: RgbImage,
    /// What it shows, by which settings, how fast and how well.
    caption: [String; 3],
}

/// Runs the command.
pub fn run(arguments: &Arguments, progress: &Progress) -> anyhow::Result<()> {
    let directory = &arguments.output;
    std::fs::create_dir_all(directory).map_err(|source| Error::io(directory, source))?;
    let mut scene = procedural::load("procedural:demo")?;
    let camera = scene.cameras[0].clone();

    let start = Instant::now();
    let shaded = run_one("shaded", progress, &scene, &camera, &Exact, Quantity::Shaded, 2)?;
    let shaded_picture = shaded.rgb_png("shaded").expect("a shaded rendering has that layer");
    write_png(&directory.join("shaded.png"), shaded_picture.clone())?;
    let mut panels = vec![Panel {
        picture: shaded_picture,
        caption: ["all lights, Lambertian surfaces".into(), "exact, 4 receivers a pixel".into(), elapsed(start)],
    }];

    // Visibility is a light's own: the sheet shows the first one's.
    scene.lights.truncate(1);
    let light = scene.lights[0].name.clone();
    let picture_of = |image: &Image| {
        let grey = image.visibility_png(&light).expect("the light has visibility");
        with_detail(DynamicImage::from(grey).into_rgb8())
    };
    let start = Instant::now();
    let truth = run_one("reference", progress, &scene, &camera, &Exact, Quantity::Visibility, 1)?;
    write_exr(&directory.join("reference.exr"), &truth)?;
    panels.push(Panel {
        picture: picture_of(&truth),
        caption: [format!("reference: V of light {light:?}"), "exact".into(), elapsed(start)],
    });

    let mut text = format!("{:<50} {:>9} {:>9} {:>9}\n", "technique", "time", "RMSE", "largest");
    let context = Context::default();
    let (shown, left_out): (Vec<&Entry>, Vec<&Entry>) =
        ALL.iter().partition(|entry| entry.needs == Needs::Cpu || context.gpu().is_ok());
    for entry in shown {
        for settings in entry.demo {
            let technique = (entry.build)(&context, &parse_settings(settings)?)?;
            let label = format!("{} {settings}", entry.name).trim_end().to_owned();
            let start = Instant::now();
            let image = run_one(entry.name, progress, &scene, &camera, technique.as_ref(), Quantity::Visibility, 1)?;
            let time = elapsed(start);
            let file = format!("{}.exr", label.replace([' ', '=', '/'], "-"));
            write_exr(&directory.join(file), &image)?;
            let report = metrics::compare(&image, &truth, &[Mask::Penumbra])?;
            let errors = &report.lights[0].masks[&Mask::Penumbra];
            let number = |value: Option<f64>| value.map_or_else(|| "-".into(), |value| format!("{value:.4}"));
            let (rmse, largest) = (number(errors.rmse), number(errors.max));
            text += &format!("{label:<50} {time:>9} {rmse:>9} {largest:>9}\n");
            let caption = [entry.name.into(), (*settings).into(), format!("{time}, penumbra RMSE {rmse}")];
            panels.push(Panel { picture: picture_of(&image), caption });
        }
    }
    if !left_out.is_empty()
        && let Err(reason) = context.gpu()
    {
        let names: Vec<&str> = left_out.iter().map(|entry| entry.name).collect();
        text += &format!("left out: {}; {reason}\n", names.join(", "));
    }
    let sheet = directory.join("contact-sheet.png");
    write_png(&sheet, contact_sheet(&panels))?;
    text += &format!("errors over the penumbra, against the exact answer\nsee {}", sheet.display());
    print(&text)
}

fn run_one(
    label: &str,
    progress: &Progress,
    scene: &Scene,
    camera: &Camera,
    technique: &dyn Technique,
    quantity: Quantity,
    antialiasing: u32,
) -> Result<Image> {
    let request = Request {
        size: PANEL,
        irradiance: false,
        shaded: (quantity == Quantity::Shaded).then_some(Shading::Lambert),
        antialiasing,
        verify: None,
    };
    let mut rendering: Rendering = with_bar(label, progress, || render(scene, camera, technique, &request, progress))?;
    let origin = Origin { technique: label, parameters: Value::Null };
    Ok(image_of(scene, &mut rendering, &origin, quantity, &[Aov::Position]))
}

fn elapsed(start: Instant) -> String {
    format!("{:.2} s", start.elapsed().as_secs_f64())
}

/// The picture with its detail enlarged in the upper right corner.
fn with_detail(mut picture: RgbImage) -> RgbImage {
    let pixels = |fraction: f64, side: u32| (fraction * f64::from(side)).round() as u32;
    let [x, y, width, height] = [
        pixels(DETAIL[0], PANEL[0]),
        pixels(DETAIL[1], PANEL[1]),
        pixels(DETAIL[2], PANEL[0]),
        pixels(DETAIL[3], PANEL[1]),
    ];
    let detail = crop_imm(&picture, x, y, width, height).to_image();
    let detail = resize(&detail, ENLARGED * width, ENLARGED * height, FilterType::Nearest);
    let frame = image::Rgb([214, 120, 40]);
    let mut framed = RgbImage::from_pixel(detail.width() + 4, detail.height() + 4, frame);
    overlay(&mut framed, &detail, 2, 2);
    outline(&mut picture, [x, y, width, height], frame);
    let left = PANEL[0] - framed.width();
    overlay(&mut picture, &framed, left.into(), 0);
    picture
}

fn outline(picture: &mut RgbImage, [x, y, width, height]: [u32; 4], color: image::Rgb<u8>) {
    for i in 0..width {
        picture.put_pixel(x + i, y, color);
        picture.put_pixel(x + i, y + height - 1, color);
    }
    for i in 0..height {
        picture.put_pixel(x, y + i, color);
        picture.put_pixel(x + width - 1, y + i, color);
    }
}

fn contact_sheet(panels: &[Panel]) -> RgbImage {
    let rows = (panels.len() as u32).div_ceil(COLUMNS);
    let [cell_width, cell_height] = [PANEL[0] + GAP, PANEL[1] + CAPTION + GAP];
    let mut sheet = Canvas::new(GAP + COLUMNS * cell_width, GAP + rows * cell_height);
    for (i, panel) in (0..).zip(panels) {
        let (x, y) = (GAP + i % COLUMNS * cell_width, GAP + i / COLUMNS * cell_height);
        overlay(&mut sheet.0, &panel.picture, x.into(), y.into());
        for (line, text) in (0..).zip(&panel.caption) {
            sheet.text(text, x, y + PANEL[1] + 6 + 19 * line);
        }
    }
    sheet.0
}
