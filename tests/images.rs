//! Float images: what is written is read again, and no file does harm.

use std::fs;
use std::panic::catch_unwind;
use std::path::{Path, PathBuf};

use exr::prelude::*;
use penumbra::image::{self, Image, read_exr, write_exr};

/// SplitMix64 (Steele et al. 2014, "Fast Splittable Pseudorandom Number Generators").
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn unit(&mut self) -> f32 {
        (self.next() >> 40) as f32 / (1u64 << 24) as f32
    }
}

fn place() -> tempfile::TempDir {
    tempfile::tempdir().unwrap()
}

/// Every finite kind of float: zeros of both signs, subnormals, extremes, and noise that doesn't compress.
fn sample_image(names: &[&str], size: [u32; 2]) -> Image {
    let mut random = Random(1);
    let mut image = Image::new(size);
    for name in names {
        let special = [0.0, -0.0, f32::MIN_POSITIVE / 8.0, f32::MAX, f32::MIN, 1.0, 0.1];
        let samples = (0..image.pixel_count())
            .map(|i| if i % 3 == 0 { special[i / 3 % special.len()] } else { random.unit() })
            .collect();
        image.add(*name, samples);
    }
    image
}

fn bits(image: &Image) -> Vec<(String, Vec<u32>)> {
    let mut channels: Vec<_> =
        image.channels.iter().map(|c| (c.name.clone(), c.samples.iter().map(|v| v.to_bits()).collect())).collect();
    channels.sort();
    channels
}

#[test]
fn exr_keeps_every_bit_every_name_and_every_attribute() {
    let directory = place();
    let long = "a light with a name of more than thirty-one bytes.visibility";
    let names =
        ["Key.visibility", "Key#2.visibility", "Sun.001.irradiance.R", "Licht über dem Tor.visibility", "灯.facing"];
    for size in [[1, 1], [7, 5], [33, 49]] {
        for names in [names.to_vec(), [&names[..], &[long]].concat()] {
            let mut image = sample_image(&names, size);
            image.attributes.insert("penumbra:technique".into(), "rays".into());
            image.attributes.insert("penumbra:scene".into(), "Küche.glb".into());
            image.attributes.insert("penumbra:parameters".into(), format!("{{\"x\":\"{}\"}}", "y".repeat(500)));
            let path = directory.path().join("ü image.exr");
            write_exr(&path, &image).unwrap();
            let read = read_exr(&path).unwrap();
            assert_eq!(read.size, size);
            assert_eq!(bits(&read), bits(&image));
            assert_eq!(read.attributes, image.attributes);
            assert_eq!(fs::read_dir(directory.path()).unwrap().count(), 1);
        }
    }
}

#[test]
fn lights_are_found_by_known_suffixes() {
    let names = [
        "Sun.001.visibility",
        "Sun.001.irradiance.R",
        "a.irradiance.visibility",
        "dim.irradiance.G",
        "position.X",
        "shaded.R",
        "coverage.A",
    ];
    let image = sample_image(&names, [2, 2]);
    assert_eq!(image.light_names(), ["Sun.001", "a.irradiance", "dim"]);
    assert_eq!(image.visibility("Sun.001"), image.channel("Sun.001.visibility"));
    assert!(image.irradiance("dim").is_none(), "only one of three channels is there");
}

#[test]
fn exr_bytes_do_not_depend_on_channel_order_or_threads() {
    let directory = place();
    let names = ["Key.visibility", "position.X", "position.Y", "position.Z", "coverage.A"];
    let mut image = sample_image(&names, [200, 150]);
    for i in 0..20 {
        image.attributes.insert(format!("penumbra:{i}"), i.to_string());
    }
    let mut written = Vec::new();
    for threads in [1, 2, 5] {
        let path = directory.path().join("out.exr");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| write_exr(&path, &image)).unwrap();
        written.push(fs::read(&path).unwrap());
        image.channels.reverse();
    }
    assert!(written.iter().all(|bytes| *bytes == written[0]));
}

#[test]
fn written_file_is_what_the_contract_says() {
    let directory = place();
    let path = directory.path().join("out.exr");
    write_exr(&path, &sample_image(&["b.visibility", "a.visibility"], [20, 40])).unwrap();
    let meta = MetaData::read_from_file(&path, true).unwrap();
    MetaData::validate(&meta.headers, true).unwrap();
    let [header] = meta.headers.as_slice() else { panic!("one part") };
    assert_eq!(header.compression, Compression::ZIP16);
    assert_eq!(header.blocks, exr::meta::BlockDescription::ScanLines);
    assert_eq!(header.line_order, LineOrder::Increasing);
    let names: Vec<_> = header.channels.list.iter().map(|channel| channel.name.to_string()).collect();
    assert_eq!(names, ["a.visibility", "b.visibility"]);
    assert!(header.channels.list.iter().all(|channel| channel.sample_type == SampleType::F32));
    // Another reader, offset tables and all.
    let other = read_all_flat_layers_from_file(&path).unwrap();
    assert_eq!(other.layer_data[0].size, Vec2(20, 40));
}

#[test]
fn what_an_exr_cannot_hold_is_named() {
    let directory = place();
    let path = directory.path().join("out.exr");
    let message = |image: &Image| {
        let message = write_exr(&path, image).unwrap_err().to_string();
        assert!(!path.exists() && fs::read_dir(directory.path()).unwrap().count() == 0);
        message
    };
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut image = sample_image(&["Key.visibility"], [4, 3]);
        image.channels[0].samples[6] = bad;
        let message = message(&image);
        assert!(message.contains("Key.visibility") && message.contains("pixel 2, 1"), "{message}");
    }
    let mut image = sample_image(&["Key.visibility"], [4, 3]);
    image.channels.push(image.channels[0].clone());
    assert!(message(&image).contains("two channels are named \"Key.visibility\""));
    assert!(message(&sample_image(&["a\0b.visibility"], [4, 3])).contains("bytes"));
    assert!(message(&sample_image(&["x".repeat(256).as_str()], [4, 3])).contains("255"));
    assert!(message(&Image::new([4, 3])).contains("nothing to write"));
    assert!(message(&sample_image(&["a"], [0, 3])).contains("nothing to write"));
}

fn layer(name: &str, size: (usize, usize), channels: &[(&str, FlatSamples)]) -> Layer<AnyChannels<FlatSamples>> {
    let channels = channels.iter().map(|(name, samples)| AnyChannel::new(*name, samples.clone())).collect();
    Layer::new(size, LayerAttributes::named(name), Encoding::FAST_LOSSLESS, AnyChannels::sort(channels))
}

fn write_layers(path: &Path, layers: Vec<Layer<AnyChannels<FlatSamples>>>, window: IntegerBounds) {
    let layers: Layers<_> = layers.into();
    exr::image::Image::from_layers(ImageAttributes::new(window), layers).write().to_file(path).unwrap();
}

#[test]
fn parts_and_sample_types_become_float_channels() {
    let directory = place();
    let path = directory.path().join("parts.exr");
    let floats = |start: u32| FlatSamples::F32((0..6).map(|i| (start + i) as f32).collect());
    let halves = FlatSamples::F16((0..6).map(|i| f16::from_f32(0.5 * i as f32)).collect());
    let integers = FlatSamples::U32((0..6).map(|i| 1000 * i).collect());
    write_layers(
        &path,
        vec![
            layer("ViewLayer.Diffuse Direct", (3, 2), &[("R", floats(0)), ("G", floats(10)), ("B", halves)]),
            layer("ViewLayer.Depth", (3, 2), &[("ViewLayer.Depth.Z", integers)]),
            layer("Key", (3, 2), &[("visibility", floats(20))]),
        ],
        IntegerBounds::from_dimensions((3, 2)),
    );
    let image = read_exr(&path).unwrap();
    assert_eq!(image.size, [3, 2]);
    let [r, g, b] = image.rgb("ViewLayer.Diffuse Direct").unwrap();
    assert_eq!(r, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
    assert_eq!(g[5], 15.0);
    assert_eq!(b, [0.0, 0.5, 1.0, 1.5, 2.0, 2.5]);
    assert_eq!(image.channel("ViewLayer.Depth.Z").unwrap()[5], 5000.0);
    assert_eq!(image.visibility("Key").unwrap()[0], 20.0);
    assert_eq!(image.channels.len(), 5);
}

#[test]
fn names_that_come_twice_are_numbered_on_their_layer() {
    let directory = place();
    let path = directory.path().join("twice.exr");
    let flat = |value: f32| FlatSamples::F32(vec![value; 4]);
    write_layers(
        &path,
        vec![
            layer("left", (2, 2), &[("left.Sun.visibility", flat(1.0))]),
            layer("left.Sun", (2, 2), &[("visibility", flat(2.0))]),
        ],
        IntegerBounds::from_dimensions((2, 2)),
    );
    let image = read_exr(&path).unwrap();
    assert_eq!(image.visibility("left.Sun").unwrap()[0], 1.0);
    assert_eq!(image.visibility("left.Sun#2").unwrap()[0], 2.0);
}

#[test]
fn overscan_is_cut_and_a_crop_region_refused() {
    let directory = place();
    let path = directory.path().join("window.exr");
    // Sample value = 10 · y + x in file coordinates.
    let at = |position: (i32, i32), size: (usize, usize)| {
        let samples = (0..size.1 as i32)
            .flat_map(|y| (0..size.0 as i32).map(move |x| (10 * (position.1 + y) + position.0 + x) as f32))
            .collect();
        let mut layer = layer("", size, &[("Key.visibility", FlatSamples::F32(samples))]);
        layer.attributes = LayerAttributes::default().with_position(Vec2(position.0, position.1));
        layer
    };
    write_layers(&path, vec![at((-2, -1), (8, 6))], IntegerBounds::from_dimensions((3, 2)));
    let image = read_exr(&path).unwrap();
    assert_eq!(image.size, [3, 2]);
    assert_eq!(image.visibility("Key").unwrap(), [0.0, 1.0, 2.0, 10.0, 11.0, 12.0]);

    write_layers(&path, vec![at((4, 5), (3, 2))], IntegerBounds::new((4, 5), (3, 2)));
    let image = read_exr(&path).unwrap();
    assert_eq!(image.visibility("Key").unwrap(), [54.0, 55.0, 56.0, 64.0, 65.0, 66.0]);

    write_layers(&path, vec![at((1, 0), (2, 2))], IntegerBounds::from_dimensions((3, 2)));
    let message = read_exr(&path).unwrap_err().to_string();
    assert!(message.contains("2×2 at 1, 0") && message.contains("3×2") && !message.contains('\n'), "{message}");
}

/// One file of each way to store pixels.
fn stored_in_every_way(directory: &Path) -> Vec<PathBuf> {
    let mut random = Random(3);
    let size = (70, 50);
    let channels: Vec<_> = ["Key.visibility", "half.R", "int.R"]
        .iter()
        .map(|name| {
            let values: Vec<f32> =
                (0..size.0 * size.1).map(|i| (i / 70) as f32 / 50.0 + 0.01 * random.unit()).collect();
            let samples = match *name {
                "half.R" => FlatSamples::F16(values.iter().map(|&v| f16::from_f32(v)).collect()),
                "int.R" => FlatSamples::U32(values.iter().map(|&v| (1e6 * v) as u32).collect()),
                _ => FlatSamples::F32(values),
            };
            AnyChannel::new(*name, samples)
        })
        .collect();
    let methods = [
        Compression::Uncompressed,
        Compression::RLE,
        Compression::ZIP1,
        Compression::ZIP16,
        Compression::PIZ,
        Compression::PXR24,
        Compression::B44,
        Compression::B44A,
        Compression::DWAA(None),
        Compression::DWAB(None),
    ];
    let mut paths = Vec::new();
    for blocks in [Blocks::ScanLines, Blocks::Tiles(Vec2(32, 16))] {
        for compression in methods {
            let encoding = Encoding { compression, blocks, line_order: LineOrder::Increasing };
            let attributes =
                LayerAttributes { comments: Some(Text::from("a comment")), ..LayerAttributes::named("part") };
            let layer = Layer::new(size, attributes, encoding, AnyChannels::sort(channels.iter().cloned().collect()));
            let path = directory.join(format!("{}.exr", paths.len()));
            exr::image::Image::from_layer(layer).write().to_file(&path).unwrap();
            paths.push(path);
        }
    }
    let path = directory.join("ours.exr");
    write_exr(&path, &sample_image(&["Key.visibility", "position.X"], [40, 30])).unwrap();
    paths.push(path);
    paths
}

#[test]
fn every_compression_is_read() {
    let directory = place();
    for path in stored_in_every_way(directory.path()) {
        let image = read_exr(&path).unwrap();
        if image.size == [70, 50] {
            let samples = image.visibility("Key").unwrap();
            // Written as y/50 plus noise of at most 0.01; the lossy methods keep 12 bits.
            for (i, value) in samples.iter().enumerate() {
                let y = (i / 70) as f32 / 50.0;
                assert!((-0.001..0.011).contains(&(value - y)), "{path:?}: {value} at {i}");
            }
        }
    }
}

#[test]
fn damaged_files_are_errors() {
    let directory = place();
    let mut random = Random(7);
    let damaged = directory.path().join("damaged.exr");
    for path in stored_in_every_way(directory.path()) {
        let whole = fs::read(&path).unwrap();
        for round in 0..200 {
            let mut bytes = whole.clone();
            if round % 4 == 0 {
                bytes.truncate(random.next() as usize % whole.len());
            } else {
                // The header is where a byte matters most.
                let reach = if round % 4 == 1 { bytes.len() } else { bytes.len().min(700) };
                for _ in 0..1 + random.next() % 4 {
                    let at = random.next() as usize % reach;
                    bytes[at] = random.next() as u8;
                }
            }
            fs::write(&damaged, &bytes).unwrap();
            let result = catch_unwind(|| read_exr(&damaged)).expect("read_exr never panics");
            if let Ok(image) = result {
                assert!(image.channels.iter().all(|channel| channel.samples.len() == image.pixel_count()));
            }
            if round % 4 == 0 {
                assert!(read_exr(&damaged).is_err());
            }
        }
    }
}

#[test]
fn claimed_sizes_are_checked_against_the_file() {
    let directory = place();
    let path = directory.path().join("out.exr");
    write_exr(&path, &sample_image(&["Key.visibility"], [16, 16])).unwrap();
    let whole = fs::read(&path).unwrap();
    // After the name come the type, box2i, and the size of the value.
    let window = |name: &[u8]| whole.windows(name.len()).position(|at| at == name).unwrap() + name.len() + 1 + 6 + 4;
    for (side, expected) in [(5_000, "the file has"), (30_000, "at most 268435456"), (1 << 29, "claims blocks of")] {
        let mut bytes = whole.clone();
        for start in [window(b"dataWindow"), window(b"displayWindow")] {
            bytes[start + 8..start + 12].copy_from_slice(&(side - 1_i32).to_le_bytes());
            bytes[start + 12..start + 16].copy_from_slice(&(side - 1_i32).to_le_bytes());
        }
        let count = whole.windows(10).position(|at| at == b"chunkCount").unwrap() + 11 + 4 + 4;
        bytes[count..count + 4].copy_from_slice(&((side as u32).div_ceil(16)).to_le_bytes());
        fs::write(&path, &bytes).unwrap();
        let message = read_exr(&path).unwrap_err().to_string();
        assert!(message.contains(expected), "{side}: {message}");
    }
    fs::write(&path, b"").unwrap();
    assert!(read_exr(&path).is_err());
    fs::write(&path, b"PNG or something").unwrap();
    assert!(read_exr(&path).unwrap_err().to_string().contains("not an OpenEXR file"));
    assert!(read_exr(directory.path()).unwrap_err().to_string().contains("not a regular file"));
    assert!(read_exr(&directory.path().join("none.exr")).unwrap_err().to_string().contains("No such file"));
}

#[test]
fn srgb_curve_and_its_inverse_agree() {
    for i in 0..=255 {
        let value = i as f32 / 255.0;
        assert_eq!(image::srgb8_from_linear(image::linear_from_srgb(value)), i as u8);
    }
    // IEC 61966-2-1: 18 % grey is 118 of 255; out of range is clamped.
    assert_eq!([0.18, -1.0, 2.0, f32::NAN].map(image::srgb8_from_linear), [118, 0, 255, 0]);
}

#[test]
fn png_holds_visibility_through_the_srgb_curve() {
    let directory = place();
    let path = directory.path().join("out.png");
    let mut float = Image::new([2, 2]);
    float.add("Key.visibility", vec![0.0, 0.18, 0.5, 1.0]);
    image::write_png(&path, float.visibility_png("Key").unwrap()).unwrap();
    let read = ::image::open(&path).unwrap().into_luma8();
    assert_eq!(read.into_raw(), [0, 118, 188, 255]);
}

#[test]
fn png_of_each_light_has_a_name_of_its_own() {
    let names = |lights: &[&str]| {
        let lights: Vec<_> = lights.iter().map(|name| (*name).to_owned()).collect();
        image::png_paths(Path::new("dir/out.png"), &lights)
    };
    assert_eq!(names(&["Key"]), [Path::new("dir/out.png")]);
    let expected =
        ["dir/out.Key.png", "dir/out.key#2.png", "dir/out.a_b_c.png", "dir/out.Sun.001.png"].map(PathBuf::from);
    assert_eq!(names(&["Key", "key", "a/b:c", "Sun.001"]), expected);
    let long = "ü".repeat(200);
    assert!(names(&["Key", &long])[1].file_name().unwrap().len() < 120);
}

#[test]
fn a_block_that_comes_twice_is_damage() {
    let directory = place();
    let path = directory.path().join("out.exr");
    write_exr(&path, &sample_image(&["Key.visibility"], [16, 32])).unwrap();
    let mut bytes = fs::read(&path).unwrap();
    // The first of two offsets is where the table of 16 bytes ends.
    let offset = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
    let table = (0..bytes.len() - 8).find(|&at| offset(at) == at as u64 + 16).unwrap();
    bytes.copy_within(table..table + 8, table + 8);
    fs::write(&path, &bytes).unwrap();
    let message = read_exr(&path).unwrap_err().to_string();
    assert!(message.contains("comes twice"), "{message}");
}
