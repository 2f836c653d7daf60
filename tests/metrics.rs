//! Error metrics: numbers that can be worked out by hand, and by other programs.

use std::collections::BTreeMap;

use penumbra::image::Image;
use penumbra::metrics::{Map, Mask, MaskErrors, Outliers, PixelCounts, Report, compare, heatmap, ssim_map, table};

fn visibility(name: &str, size: [u32; 2], samples: &[f32]) -> Image {
    let mut image = Image::new(size);
    image.add(format!("{name}.visibility"), samples.to_vec());
    image
}

fn measured(test: &Image, reference: &Image) -> Report {
    compare(test, reference, &Mask::ALL).unwrap()
}

fn error(test: &Image, reference: &Image) -> String {
    compare(test, reference, &Mask::ALL).unwrap_err().to_string()
}

#[test]
fn errors_are_those_worked_out_by_hand() {
    let reference = visibility("Key", [4, 2], &[1.0, 1.0, 0.5, 0.25, 0.0, 0.0, 0.75, 1.0]);
    let test = visibility("Key", [4, 2], &[1.0, 0.5, 0.75, 0.25, 0.25, 0.0, 0.5, 1.0]);
    let report = measured(&test, &reference);
    assert_eq!(report.pixels, PixelCounts { compared: 8, ..PixelCounts::default() });
    let light = &report.lights[0];

    // Differences: 0, −½, ¼, 0, ¼, 0, −¼, 0.
    let all = light.masks[&Mask::All];
    assert_eq!(
        (all.count, all.mae, all.max, all.bias, all.p99),
        (8, Some(1.25 / 8.0), Some(0.5), Some(-0.25 / 8.0), Some(0.5))
    );
    assert_eq!(all.rmse, Some((0.4375f64 / 8.0).sqrt()));
    // Reference below 1: ½, ¼, 0, 0, ¾.
    let shadow = light.masks[&Mask::Shadow];
    assert_eq!((shadow.count, shadow.mae, shadow.bias), (5, Some(0.75 / 5.0), Some(0.25 / 5.0)));
    // ½, ¼, ¾.
    let penumbra = light.masks[&Mask::Penumbra];
    assert_eq!(
        (penumbra.count, penumbra.mae, penumbra.max, penumbra.bias),
        (3, Some(0.5 / 3.0), Some(0.25), Some(0.0))
    );

    assert_eq!(light.false_umbra, Some(Outliers { count: 1, rmse: Some(0.5) }));
    assert_eq!(light.false_light, Some(Outliers { count: 1, rmse: Some(0.25) }));
    // Neighbours both in the penumbra: pixels 2 and 3 of the first row alone; the slope is −½ instead of −¼.
    assert_eq!(light.banding_rmse_per_px, Some(0.25));
}

#[test]
fn p99_is_the_nearest_rank() {
    let test: Vec<f32> = (1..=200).map(|i| i as f32 / 1024.0).collect();
    let report = measured(&visibility("a", [20, 10], &test), &visibility("a", [20, 10], &[0.0; 200]));
    assert_eq!(report.lights[0].masks[&Mask::All].p99, Some(198.0 / 1024.0));
    let report = measured(&visibility("a", [1, 1], &[0.25]), &visibility("a", [1, 1], &[0.5]));
    assert_eq!(report.lights[0].masks[&Mask::All].p99, Some(0.25));
}

#[test]
fn masks_do_not_depend_on_the_test() {
    let samples: Vec<f32> = (0..64).map(|i| (i % 9) as f32 / 8.0).collect();
    let reference = visibility("Key", [8, 8], &samples);
    let counts = |test: f32| -> BTreeMap<Mask, u64> {
        let report = measured(&visibility("Key", [8, 8], &[test; 64]), &reference);
        report.lights[0].masks.iter().map(|(&mask, errors)| (mask, errors.count)).collect()
    };
    for test in [0.0, 0.5, 1.0, 7.0] {
        assert_eq!(counts(test), counts(0.25));
    }
    assert_eq!(counts(0.0)[&Mask::Penumbra], samples.iter().filter(|&&v| v > 0.0 && v < 1.0).count() as u64);
}

#[test]
fn outliers_below_half_an_8_bit_step_are_none() {
    let reference = visibility("a", [4, 1], &[1.0, 1.0, 0.0, 0.0]);
    let test = visibility("a", [4, 1], &[1.0 - 1.0 / 512.0, 1.0 - 1.0 / 256.0, 1.0 / 512.0, 1.0 / 256.0]);
    let light = &measured(&test, &reference).lights[0];
    let one = Some(Outliers { count: 1, rmse: Some(1.0 / 256.0) });
    assert_eq!((light.false_umbra, light.false_light), (one, one));
}

#[test]
fn identical_images_have_no_error() {
    let samples: Vec<f32> = (0..40 * 30).map(|i| ((i * 37) % 101) as f32 / 100.0).collect();
    let image = visibility("Key", [40, 30], &samples);
    let report = measured(&image, &image);
    for errors in report.lights[0].masks.values() {
        let expected = MaskErrors {
            count: errors.count,
            rmse: Some(0.0),
            mae: Some(0.0),
            p99: Some(0.0),
            max: Some(0.0),
            bias: Some(0.0),
            ssim: Some(1.0),
            flip: Some(0.0),
        };
        assert_eq!(*errors, expected);
    }
    assert_eq!(report.lights[0].banding_rmse_per_px, Some(0.0));
}

#[test]
fn an_empty_mask_has_no_numbers() {
    let lit = visibility("Key", [3, 3], &[1.0; 9]);
    let report = measured(&lit, &lit);
    let light = &report.lights[0];
    assert_eq!(light.masks[&Mask::Penumbra], MaskErrors::default());
    assert_eq!(light.banding_rmse_per_px, None);
    assert_eq!(light.false_light, Some(Outliers { count: 0, rmse: None }));
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["lights"][0]["masks"]["penumbra"]["rmse"], serde_json::Value::Null);
    assert_eq!(json["lights"][0]["masks"]["all"]["rmse"], 0.0);
    assert_eq!(json["lights"][0]["masks"]["penumbra"]["count"], 0);
    assert!(!table(&report).contains("NaN"));
}

#[test]
fn only_the_masks_asked_for_are_reported() {
    let image = visibility("Key", [3, 3], &[0.5; 9]);
    let report = compare(&image, &image, &[Mask::Penumbra]).unwrap();
    assert_eq!(report.lights[0].masks.keys().collect::<Vec<_>>(), [&Mask::Penumbra]);
}

/// Two images of 24×20, exact in floats.
fn ssim_pair() -> [Vec<f32>; 2] {
    let value = |i: u32, j: u32, k: u32| ((i * 7 + j * 13 + k) % 32) as f32 / 32.0;
    let at = |n: u32| (n / 24, n % 24);
    [
        (0..480).map(|n| value(at(n).0, at(n).1, 0)).collect(),
        (0..480).map(|n| value(at(n).0, at(n).1, at(n).0 * at(n).1 % 5)).collect(),
    ]
}

#[test]
fn ssim_agrees_with_scikit_image() {
    let [a, b] = ssim_pair();
    let map = ssim_map(&a, &b, &[true; 480], [24, 20]);
    // scikit-image 0.26.0: structural_similarity(a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
    // data_range=1, full=True), whose mean leaves out the 5 pixels at each border, where its padding differs from ours.
    let inner: Vec<f64> = (5..15).flat_map(|y| (5..19).map(move |x| y * 24 + x)).map(|i| map[i]).collect();
    let mean = inner.iter().sum::<f64>() / inner.len() as f64;
    assert!((mean - 0.8111679146340804).abs() < 1e-12, "{mean}");
    assert!((map[9 * 24 + 11] - 0.9591487841817669).abs() < 1e-12, "{}", map[9 * 24 + 11]);
}

#[test]
fn ssim_agrees_with_the_definition_at_borders_and_holes() {
    let [a, b] = ssim_pair();
    let measured: Vec<bool> = (0..480).map(|i| i % 7 != 3 && !(100..112).contains(&i)).collect();
    let map = ssim_map(&a, &b, &measured, [24, 20]);
    for (i, ssim) in map.iter().enumerate() {
        if !measured[i] {
            assert_eq!(*ssim, 0.0);
            continue;
        }
        let (x, y) = ((i % 24) as i32, (i / 24) as i32);
        let window: Vec<(f64, f64, f64)> = (-5..=5)
            .flat_map(|dy| (-5..=5).map(move |dx| (dx, dy)))
            .filter(|(dx, dy)| (0..24).contains(&(x + dx)) && (0..20).contains(&(y + dy)))
            .map(|(dx, dy)| (((y + dy) * 24 + x + dx) as usize, f64::from(dx * dx + dy * dy)))
            .filter(|&(j, _)| measured[j])
            .map(|(j, squared)| ((-squared / (2.0 * 1.5 * 1.5)).exp(), f64::from(a[j]), f64::from(b[j])))
            .collect();
        let total: f64 = window.iter().map(|(w, ..)| w).sum();
        let mean =
            |value: &dyn Fn(f64, f64) -> f64| window.iter().map(|&(w, a, b)| w * value(a, b)).sum::<f64>() / total;
        let (ma, mb) = (mean(&|a, _| a), mean(&|_, b| b));
        let (va, vb) = (mean(&|a, _| (a - ma).powi(2)), mean(&|_, b| (b - mb).powi(2)));
        let covariance = mean(&|a, b| (a - ma) * (b - mb));
        let expected = (2.0 * ma * mb + 0.01f64.powi(2)) * (2.0 * covariance + 0.03f64.powi(2))
            / ((ma * ma + mb * mb + 0.01f64.powi(2)) * (va + vb + 0.03f64.powi(2)));
        assert!((ssim - expected).abs() < 1e-12, "{x}, {y}: {ssim} {expected}");
    }
}

#[test]
fn flip_grows_with_the_difference() {
    let flip = |value: f32| {
        let report = measured(&visibility("a", [16, 16], &[value; 256]), &visibility("a", [16, 16], &[1.0; 256]));
        report.lights[0].masks[&Mask::All].flip.unwrap()
    };
    let values = [1.0, 0.9, 0.5, 0.0].map(flip);
    assert!(values.is_sorted() && values[0] == 0.0 && values[3] > 0.5 && values[3] <= 1.0, "{values:?}");
}

#[test]
fn pixels_facing_away_are_in_no_mask() {
    let mut reference = visibility("Key", [4, 1], &[0.0, 0.5, 1.0, 0.0]);
    reference.add("Key.facing", vec![0.0, 1.0, 1.0, 1.0]);
    let test = visibility("Key", [4, 1], &[1.0, 0.5, 1.0, 0.0]);
    let light = &measured(&test, &reference).lights[0];
    assert_eq!(light.masks[&Mask::All].count, 3);
    assert_eq!(light.masks[&Mask::All].rmse, Some(0.0));
    assert_eq!(light.false_light.unwrap().count, 0);
}

/// A plane seen head on: one unit between pixels.
fn with_positions(mut image: Image, scale: f64, moved: impl Fn(usize) -> [f64; 3]) -> Image {
    let width = image.size[0] as usize;
    let at = |i: usize| {
        let [x, y, z] = moved(i);
        [(i % width) as f64 + x, (i / width) as f64 + y, z]
    };
    for (axis, name) in ["position.X", "position.Y", "position.Z"].into_iter().enumerate() {
        image.add(name, (0..image.pixel_count()).map(|i| (scale * at(i)[axis]) as f32).collect());
    }
    image
}

#[test]
fn pixels_that_show_different_surfaces_are_left_out_and_counted() {
    let flat = visibility("Key", [5, 4], &[0.5; 20]);
    let mut wrong = vec![0.5; 20];
    (wrong[3], wrong[7], wrong[11]) = (1.0, 1.0, 1.0);
    for scale in [1.0, 2f64.powi(-40), 2f64.powi(40)] {
        let reference = with_positions(flat.clone(), scale, |_| [0.0; 3]);
        // Pixel 7 lies just over a footprint away, pixel 8 just under it; pixels 3 and 11 are covered on one side alone.
        let moved = |i: usize| match i {
            7 => [0.0, 0.0, 1.01],
            8 => [0.0, 0.0, 0.99],
            _ => [0.25, 0.0, 0.0],
        };
        let mut test = with_positions(visibility("Key", [5, 4], &wrong), scale, moved);
        let mut reference = reference;
        test.add("coverage.A", (0..20).map(|i| f32::from(u8::from(i != 3 && i != 0))).collect());
        reference.add("coverage.A", (0..20).map(|i| f32::from(u8::from(i != 11 && i != 0))).collect());
        let report = measured(&test, &reference);
        let expected = PixelCounts { compared: 16, uncovered: 1, coverage_differs: 2, position_differs: 1 };
        assert_eq!(report.pixels, expected);
        let all = report.lights[0].masks[&Mask::All];
        assert_eq!((all.count, all.max, all.ssim, all.flip), (16, Some(0.0), Some(1.0), Some(0.0)));
        assert!(table(&report).contains("left out: 2 where coverage differs, 1 where positions differ"));
    }
}

#[test]
fn rounding_of_far_positions_is_no_difference() {
    // At 2²⁴ floats are 2 apart and a pixel's footprint is 1. Points 0.55·√3 apart are within it, but (1, 1, 0) and
    // (1.55, 1.55, 0.55) are stored as (0, 0, 0) and (2, 2, 0).
    let far = 2f64.powi(24);
    let flat = visibility("Key", [8, 8], &[0.5; 64]);
    let reference = with_positions(flat.clone(), 1.0, |_| [far; 3]);
    let test = with_positions(flat, 1.0, |_| [far + 0.55; 3]);
    assert_eq!(measured(&test, &reference).pixels.compared, 64);
}

#[test]
fn a_silhouette_does_not_widen_the_footprint() {
    // Columns 3 and up lie far behind.
    let behind = |i: usize| [0.0, 0.0, if i % 6 >= 3 { 100.0 } else { 0.0 }];
    let flat = visibility("Key", [6, 6], &[0.5; 36]);
    let reference = with_positions(flat.clone(), 1.0, behind);
    let test = with_positions(flat, 1.0, |i| if i == 8 { [0.0, 0.0, 1.5] } else { behind(i) });
    assert_eq!(measured(&test, &reference).pixels.position_differs, 1);
}

#[test]
fn lights_are_compared_by_name() {
    let named = |names: &[&str]| {
        let mut image = Image::new([2, 2]);
        names.iter().for_each(|name| image.add(format!("{name}.visibility"), vec![0.5; 4]));
        ["X", "Y", "Z"].iter().for_each(|axis| image.add(format!("position.{axis}"), vec![0.0; 4]));
        image
    };
    let report = measured(&named(&["Key", "Fill", "Rim.001"]), &named(&["Sun", "Rim.001", "Key"]));
    let names: Vec<_> = report.lights.iter().map(|light| light.name.as_str()).collect();
    assert_eq!(names, ["Key", "Rim.001"]);
    assert_eq!(report.notes, ["in the test alone: Fill", "in the reference alone: Sun"]);

    let report = measured(&named(&["Key"]), &named(&["Area.001"]));
    assert_eq!((report.lights[0].name.as_str(), report.lights[0].reference_name.as_str()), ("Key", "Area.001"));
    assert_eq!(report.notes.len(), 1);
    assert!(measured(&named(&["Key"]), &named(&["Key"])).notes.is_empty());
    // Without positions, a reader should know.
    let bare = visibility("Key", [2, 2], &[0.5; 4]);
    assert!(measured(&bare, &bare).notes[0].contains("positions are not compared"));

    let message = error(&named(&["Key", "Fill"]), &named(&["Sun"]));
    assert!(message.contains("the test has Key, Fill") && message.contains("the reference has Sun"), "{message}");
}

#[test]
fn images_that_cannot_be_compared_are_one_clear_line() {
    let image = visibility("Key", [2, 2], &[0.5; 4]);
    let message = error(&image, &visibility("Key", [3, 2], &[0.5; 6]));
    assert!(message.contains("2×2") && message.contains("3×2") && !message.contains('\n'), "{message}");
    let mut foreign = Image::new([2, 2]);
    foreign.add("Y", vec![0.5; 4]);
    let message = error(&image, &foreign);
    assert!(message.contains("the reference has no channel named <light>.visibility") && message.ends_with("it has Y"));
    let message = error(&visibility("Key", [2, 2], &[0.5, 0.5, f32::NAN, 0.5]), &image);
    assert!(message.contains("Key in the test is NaN at pixel 0, 1"), "{message}");
}

#[test]
fn irradiance_errors_are_relative_to_the_reference_too() {
    let image = |r: [f32; 2], g: [f32; 2], b: [f32; 2]| {
        let mut image = Image::new([2, 1]);
        for (name, samples) in [("R", r), ("G", g), ("B", b)] {
            image.add(format!("Key.irradiance.{name}"), samples.to_vec());
        }
        image
    };
    let reference = image([2.0, 4.0], [1.0, 3.0], [0.0, 2.0]);
    let test = image([2.5, 4.0], [1.0, 3.0], [0.0, 1.0]);
    let report = measured(&test, &reference);
    let light = &report.lights[0];
    assert!(light.masks.is_empty());
    let errors = light.irradiance.unwrap();
    assert_eq!(errors.mean_reference_w_per_m2, 2.0);
    assert_eq!((errors.mae_w_per_m2, errors.bias_w_per_m2), (1.5 / 6.0, -0.5 / 6.0));
    assert_eq!(errors.rmse_w_per_m2, (1.25f64 / 6.0).sqrt());
    assert_eq!((errors.relative_mae, errors.relative_bias), (Some(1.5 / 12.0), Some(-0.5 / 12.0)));
    let dark = image([0.0; 2], [0.0; 2], [0.0; 2]);
    assert_eq!(measured(&test, &dark).lights[0].irradiance.unwrap().relative_rmse, None);
    assert!(table(&report).contains("irradiance"));
}

/// A disc's soft shadow and a copy of it with banding, a false shadow and false light.
fn shadows(size: [u32; 2]) -> [Image; 2] {
    let [width, height] = size;
    let radius = |x: u32, y: u32| {
        let (dx, dy) = (f64::from(x) - 0.5 * f64::from(width), f64::from(y) - 0.5 * f64::from(height));
        dx.hypot(dy) / (0.5 * f64::from(height))
    };
    let exact = |x, y| ((radius(x, y) - 0.3) / 0.4).clamp(0.0, 1.0);
    let banded = |x: u32, y: u32| {
        let levels = (exact(x, y) * 16.0).round() / 16.0;
        let wrong = 0.2 * f64::from(u8::from(radius(x, y) < 0.1)) - 0.1 * f64::from(u8::from(x < width / 10));
        (levels + wrong).clamp(0.0, 1.0)
    };
    let render =
        |f: &dyn Fn(u32, u32) -> f64| (0..width * height).map(|i| f(i % width, i / width) as f32).collect::<Vec<_>>();
    let coverage: Vec<f32> = (0..width * height).map(|i| f32::from(u8::from(i / width > height / 8))).collect();
    let mut images = [visibility("Key light", size, &render(&banded)), visibility("Key light", size, &render(&exact))];
    images[0].add(
        "coverage.A",
        (0..coverage.len()).map(|i| if i as u32 % width > width - width / 16 { 0.0 } else { coverage[i] }).collect(),
    );
    images[1].add("coverage.A", coverage);
    images
}

#[test]
fn heatmap_is_blue_where_the_test_is_darker_and_red_where_it_is_brighter() {
    let [test, reference] = shadows([480, 360]);
    for map in [Map::Difference, Map::Ssim, Map::Flip] {
        let picture = heatmap(&test, &reference, "Key light", map).unwrap();
        assert!(picture.width() == 480 && picture.height() > 360 + 80);
        let at = |x, y| picture.get_pixel(x, y).0;
        if let Ok(directory) = std::env::var("PENUMBRA_TEST_PICTURES") {
            picture.save(format!("{directory}/{map:?}.png")).unwrap();
        }
        if map == Map::Difference {
            let [r, g, b] = at(240, 180);
            assert!(r > g + 50 && r > b + 50, "false light is red: {:?}", at(240, 180));
            let [r, g, b] = at(10, 200);
            assert!(b > r + 30 && b > g + 10, "false umbra is blue: {:?}", at(10, 200));
            let [r, g, b] = at(100, 60);
            assert!(r == g && g == b && r > 230, "no error is near white: {:?}", at(100, 60));
        }
        assert_eq!(at(100, 20), [150; 3], "no surface is grey");
    }
    assert!(heatmap(&test, &reference, "Fill", Map::Difference).unwrap_err().to_string().contains("Fill"));
}

#[test]
fn heatmap_does_not_blow_up_tiny_errors() {
    let [_, reference] = shadows([60, 60]);
    let mut test = reference.clone();
    test.channels[0].samples.iter_mut().for_each(|value| *value = (*value - 1e-4).max(0.0));
    let picture = heatmap(&test, &reference, "Key light", Map::Difference).unwrap();
    // Enlarged eight times; an error of 1e-4 on a scale of 0.005 is all but white.
    assert_eq!(picture.width(), 480);
    assert!(picture.get_pixel(240, 240).0.iter().all(|&value| value > 225));
    if let Ok(directory) = std::env::var("PENUMBRA_TEST_PICTURES") {
        picture.save(format!("{directory}/tiny.png")).unwrap();
    }
}

#[test]
fn every_size_of_image_has_metrics_and_pictures() {
    for size in [[1, 1], [1, 7], [600, 1], [3, 2]] {
        let samples: Vec<f32> = (0..size[0] * size[1]).map(|i| (i % 3) as f32 / 2.0).collect();
        let image =
            visibility("灯 with a rather long name that can't fit into the legend of a small picture", size, &samples);
        let report = measured(&image, &image);
        assert_eq!(report.lights[0].masks[&Mask::All].ssim, Some(1.0));
        for map in [Map::Difference, Map::Ssim, Map::Flip] {
            heatmap(&image, &image, &report.lights[0].name, map).unwrap();
        }
    }
}

#[test]
fn reports_are_the_same_for_any_number_of_threads() {
    let [test, reference] = shadows([200, 150]);
    let reports = [1, 3].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| measured(&test, &reference))
    });
    assert_eq!(reports[0], reports[1]);
}

#[test]
fn table_is_aligned() {
    let [test, reference] = shadows([200, 150]);
    let text = table(&measured(&test, &reference));
    let rows: Vec<&str> = text.lines().skip_while(|line| !line.starts_with("  mask")).take(4).collect();
    assert!(rows.len() == 4 && rows.iter().all(|row| row.len() == rows[0].len()), "{text}");
}
