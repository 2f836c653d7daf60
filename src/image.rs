//! Float images with named channels; OpenEXR and PNG files.
//!
//! Channel names are `layer.channel`; a light's layer is the light's name, which may hold dots itself, so names are split at
//! the known suffixes of [`LIGHT_SUFFIXES`].

use std::collections::{BTreeMap, HashSet};
use std::fs::File;
use std::io::{BufReader, Read, Seek, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use exr::block::chunk::{Chunk, CompressedBlock};
use exr::block::reader::ChunksReader;
use exr::block::{BlockIndex, UncompressedBlock};
use exr::compression::Compression;
use exr::math::Vec2;
use exr::meta::attribute::{AttributeValue, ChannelDescription, LineOrder, SampleType, Text};
use exr::meta::header::Header;
use exr::meta::{BlockDescription, Requirements};
use exr::prelude::{SmallVec, f16};
use image::{DynamicImage, GrayImage, Luma, Rgb, RgbImage};
use rayon::prelude::*;

use crate::output::{Prepared, prepare, write_atomically};
use crate::{Error, Result};

/// What a light's layer can hold: visibility; irradiance, W/m²; and `facing`, 1 where some of the light lies above the
/// receiver's tangent plane and on its emitting side, else 0 (absent: 1 everywhere).
pub const LIGHT_SUFFIXES: [&str; 7] =
    [".visibility", ".facing", ".sampled", ".irradiance.R", ".irradiance.G", ".irradiance.B", ".irradiance_ratio"];

/// Most samples (pixels × channels) that are read from a file: 1 GiB of floats.
pub const MAX_SAMPLES: u64 = 1 << 28;

/// A float image with named channels.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Image {
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// In any order; names are unique. A file holds (and a read image has) them sorted by name.
    pub channels: Vec<Channel>,
    /// Text attributes of the file's header, such as `penumbra:technique`.
    pub attributes: BTreeMap<String, String>,
}

/// One channel of an image.
#[derive(Debug, Clone, PartialEq)]
pub struct Channel {
    /// `layer.channel`, such as `Key.visibility` or `position.X`.
    pub name: String,
    /// Row-major from the top-left pixel.
    pub samples: Vec<f32>,
}

impl Image {
    /// An image without channels.
    pub fn new(size: [u32; 2]) -> Self {
        Self { size, ..Self::default() }
    }

    /// Width × height.
    pub fn pixel_count(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    /// Adds a channel.
    pub fn add(&mut self, name: impl Into<String>, samples: Vec<f32>) {
        let name = name.into();
        assert_eq!(samples.len(), self.pixel_count(), "samples of {name}");
        assert!(self.channel(&name).is_none(), "{name} is there already");
        self.channels.push(Channel { name, samples });
    }

    /// The samples of a channel, by its full name.
    pub fn channel(&self, name: &str) -> Option<&[f32]> {
        self.channels.iter().find(|channel| channel.name == name).map(|channel| channel.samples.as_slice())
    }

    /// The layer's R, G and B, where it has all three.
    pub fn rgb(&self, layer: &str) -> Option<[&[f32]; 3]> {
        self.three(layer, ["R", "G", "B"])
    }

    /// The layer's X, Y and Z, where it has all three.
    pub fn xyz(&self, layer: &str) -> Option<[&[f32]; 3]> {
        self.three(layer, ["X", "Y", "Z"])
    }

    fn three(&self, layer: &str, names: [&str; 3]) -> Option<[&[f32]; 3]> {
        let [a, b, c] = names.map(|name| self.channel(&format!("{layer}.{name}")));
        Some([a?, b?, c?])
    }

    /// Fraction of the light's area seen from each pixel.
    pub fn visibility(&self, light: &str) -> Option<&[f32]> {
        self.channel(&format!("{light}.visibility"))
    }

    /// 1 where some of the light lies above the receiver's tangent plane and on its emitting side, else 0.
    pub fn facing(&self, light: &str) -> Option<&[f32]> {
        self.channel(&format!("{light}.facing"))
    }

    /// 1 where the light's exact answer had to be sampled, else 0.
    pub fn sampled(&self, light: &str) -> Option<&[f32]> {
        self.channel(&format!("{light}.sampled"))
    }

    /// Share of the unshadowed irradiance that is left, E/E₀: what a renderer shows, where V is a share of area.
    pub fn irradiance_ratio(&self, light: &str) -> Option<&[f32]> {
        self.channel(&format!("{light}.irradiance_ratio"))
    }

    /// Irradiance from the light, W/m².
    pub fn irradiance(&self, light: &str) -> Option<[&[f32]; 3]> {
        self.rgb(&format!("{light}.irradiance"))
    }

    /// Names of the lights that the image has a layer of, in the order of the channels.
    pub fn light_names(&self) -> Vec<String> {
        let mut names: Vec<String> = Vec::new();
        for channel in &self.channels {
            let light = LIGHT_SUFFIXES.iter().find_map(|suffix| channel.name.strip_suffix(suffix));
            if let Some(light) = light
                && !names.iter().any(|name| name == light)
            {
                names.push(light.to_owned());
            }
        }
        names
    }

    /// Visibility of a light as a linear grey through the sRGB curve.
    pub fn visibility_png(&self, light: &str) -> Option<GrayImage> {
        Some(grey_png(self.size, self.visibility(light)?))
    }

    /// A layer of linear R, G and B through the sRGB curve.
    pub fn rgb_png(&self, layer: &str) -> Option<RgbImage> {
        let [r, g, b] = self.rgb(layer)?;
        let width = self.size[0] as usize;
        Some(RgbImage::from_fn(self.size[0], self.size[1], |x, y| {
            let at = y as usize * width + x as usize;
            Rgb([r[at], g[at], b[at]].map(srgb8_from_linear))
        }))
    }
}

/// sRGB to linear, both in [0, 1] (IEC 61966-2-1).
pub fn linear_from_srgb(value: f32) -> f32 {
    if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
}

/// Linear to sRGB, both in [0, 1] (IEC 61966-2-1).
pub fn srgb_from_linear(value: f32) -> f32 {
    if value <= 0.003_130_8 { value * 12.92 } else { 1.055 * value.powf(1.0 / 2.4) - 0.055 }
}

/// Linear to the nearest of 256 sRGB steps; clamped to [0, 1].
pub fn srgb8_from_linear(value: f32) -> u8 {
    // A float to integer cast saturates.
    (255.0 * srgb_from_linear(value.clamp(0.0, 1.0)) + 0.5) as u8
}

/// Linear greys through the sRGB curve: what a PNG of visibility holds.
pub fn grey_png(size: [u32; 2], samples: &[f32]) -> GrayImage {
    let width = size[0] as usize;
    GrayImage::from_fn(size[0], size[1], |x, y| Luma([srgb8_from_linear(samples[y as usize * width + x as usize])]))
}

/// Writes a PNG, whole or not at all.
pub fn write_png(path: &Path, picture: impl Into<DynamicImage>) -> Result<()> {
    write_pngs(std::iter::once((path, picture)))
}

/// Writes PNGs, all of them or none.
pub fn write_pngs(pictures: impl Iterator<Item = (impl AsRef<Path>, impl Into<DynamicImage>)>) -> Result<()> {
    let prepared: Vec<_> = pictures
        .map(|(path, picture)| {
            let (path, picture) = (path.as_ref(), picture.into());
            prepare(path, |file| {
                let encoder = image::codecs::png::PngEncoder::new(file);
                picture.write_with_encoder(encoder).map_err(|error| match error {
                    image::ImageError::IoError(cause) => Error::io(path, cause),
                    other => Error::Image { path: path.into(), message: other.to_string() },
                })
            })
        })
        .collect::<Result<_>>()?;
    prepared.into_iter().try_for_each(Prepared::commit)
}

/// Where the PNG of each light goes: `path` itself for one light, else `OUT.<light>.png`.
///
/// Characters that some file system can't hold (controls and `/ \ : * ? " < > |`) become `_`, a long name is cut to 100 bytes,
/// and a name that would be the same file as an earlier one (letter case apart) gets `#2`.
pub fn png_paths(path: &Path, lights: &[String]) -> Vec<PathBuf> {
    if lights.len() == 1 {
        return vec![path.to_path_buf()];
    }
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut taken = HashSet::new();
    lights
        .iter()
        .map(|light| {
            let mut safe: String =
                light.chars().map(|c| if c.is_control() || r#"/\:*?"<>|"#.contains(c) { '_' } else { c }).collect();
            safe.truncate(safe.floor_char_boundary(100));
            let name = numbered(&safe, |name| taken.insert(name.to_lowercase()));
            path.with_file_name(format!("{stem}.{name}.png"))
        })
        .collect()
}

/// `name`, or the first of `name#2`, `name#3`, … that `accept` takes.
fn numbered(name: &str, mut accept: impl FnMut(&str) -> bool) -> String {
    let mut candidate = name.to_owned();
    let mut number = 1;
    while !accept(&candidate) {
        number += 1;
        candidate = format!("{name}#{number}");
    }
    candidate
}

/// Writes an OpenEXR file, whole or not at all: scan lines, ZIP, 32-bit float, one part. The bytes depend on the image alone.
///
/// A value that is not finite, an empty image and a name that OpenEXR can't hold are errors.
pub fn write_exr(path: &Path, image: &Image) -> Result<()> {
    write_atomically(path, |file| {
        encode_exr(image, file).map_err(|error| match error {
            EncodeError::Io(source) => Error::io(path, source),
            EncodeError::Image(message) => Error::Image { path: path.into(), message },
        })
    })
}

enum EncodeError {
    Io(std::io::Error),
    Image(String),
}

impl From<std::io::Error> for EncodeError {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
    }
}

impl From<exr::error::Error> for EncodeError {
    fn from(error: exr::error::Error) -> Self {
        match error {
            exr::error::Error::Io(error) => Self::Io(error),
            other => Self::Image(other.to_string()),
        }
    }
}

/// Longest name that OpenEXR holds, bytes, with the long-names flag and without (OpenEXR file layout, "Version Field").
const NAME_LENGTHS: [usize; 2] = [255, 31];

fn encode_exr(image: &Image, mut file: impl Write) -> Result<(), EncodeError> {
    let [width, height] = image.size.map(|side| side as usize);
    let mut channels: Vec<&Channel> = image.channels.iter().collect();
    channels.sort_by(|a, b| a.name.cmp(&b.name));
    check_writable(image, &channels).map_err(EncodeError::Image)?;

    let descriptions = channels
        .iter()
        .map(|channel| ChannelDescription::new(text(&channel.name), SampleType::F32, true))
        .collect::<SmallVec<_>>();
    let mut header = Header::new(Text::from(""), Vec2(width, height), descriptions).with_encoding(
        Compression::ZIP16,
        BlockDescription::ScanLines,
        LineOrder::Increasing,
    );
    header.own_attributes.layer_name = None;
    for (name, value) in &image.attributes {
        header.own_attributes.other.insert(text(name), AttributeValue::Text(text(value)));
    }
    // With it the crate's checks run: sizes, reserved attribute names.
    header.validate(false, &mut false, true)?;

    let names = channels.iter().map(|channel| &channel.name).chain(image.attributes.keys());
    let mut head = Vec::new();
    exr::meta::magic_number::write(&mut head)?;
    Requirements {
        file_format_version: 2,
        is_single_layer_and_tiled: false,
        has_long_names: names.into_iter().any(|name| name.len() > NAME_LENGTHS[1]),
        has_deep_data: false,
        has_multiple_layers: false,
    }
    .write(&mut head)?;
    // The crate's own writer takes custom attributes in a hash map's order, which changes from run to run.
    let mut attributes: Vec<_> = header.all_named_attributes().collect();
    attributes.sort_by(|a, b| a.0.cmp(b.0));
    for (name, value) in &attributes {
        exr::meta::attribute::write(name, value, &mut head)?;
    }
    exr::meta::sequence_end::write(&mut head)?;

    let lines = Compression::ZIP16.scan_lines_per_block();
    let headers = [header];
    let chunks: Vec<Vec<u8>> = (0..height.div_ceil(lines))
        .into_par_iter()
        .map(|block| {
            let top = block * lines;
            let index = BlockIndex {
                layer: 0,
                pixel_position: Vec2(0, top),
                pixel_size: Vec2(width, lines.min(height - top)),
                level: Vec2(0, 0),
            };
            let block = UncompressedBlock::from_lines(&headers[0].channels, index, |line| {
                let start = line.location.position.y() * width;
                let samples = &channels[line.location.channel].samples[start..start + width];
                line.value.copy_from_slice(bytemuck::cast_slice(samples));
            });
            let mut bytes = Vec::new();
            block.compress_to_chunk(&headers)?.write(&mut bytes, headers.len())?;
            Ok(bytes)
        })
        .collect::<Result<_, EncodeError>>()?;

    let mut offset = (head.len() + chunks.len() * size_of::<u64>()) as u64;
    for chunk in &chunks {
        head.extend(offset.to_le_bytes());
        offset += chunk.len() as u64;
    }
    file.write_all(&head)?;
    for chunk in &chunks {
        file.write_all(chunk)?;
    }
    Ok(())
}

/// Names are UTF-8, as other programs write them; the crate's own conversion knows Latin-1 alone.
fn text(value: &str) -> Text {
    Text::from_slice_unchecked(value.as_bytes())
}

fn check_writable(image: &Image, sorted: &[&Channel]) -> Result<(), String> {
    let [width, height] = image.size;
    if sorted.is_empty() || width == 0 || height == 0 {
        return Err(format!("nothing to write: {width}×{height} pixels, {} channels", sorted.len()));
    }
    for name in sorted.iter().map(|channel| &channel.name).chain(image.attributes.keys()) {
        if name.is_empty() || name.len() > NAME_LENGTHS[0] || name.contains('\0') {
            return Err(format!("{name:?}: OpenEXR names have 1 to {} bytes, none of them zero", NAME_LENGTHS[0]));
        }
    }
    if let Some(pair) = sorted.windows(2).find(|pair| pair[0].name == pair[1].name) {
        return Err(format!("two channels are named {:?}", pair[0].name));
    }
    for channel in sorted {
        if channel.samples.len() != image.pixel_count() {
            return Err(format!("{}: {} samples for {width}×{height} pixels", channel.name, channel.samples.len()));
        }
    }
    let bad = sorted.par_iter().find_map_first(|channel| {
        let at = channel.samples.iter().position(|value| !value.is_finite())?;
        let (x, y) = (at % width as usize, at / width as usize);
        Some(format!("{} is {} at pixel {x}, {y}; only finite values are written", channel.name, channel.samples[at]))
    });
    bad.map_or(Ok(()), Err)
}

/// Reads an OpenEXR file: any flat image that the `exr` crate decodes; half and integer samples become floats.
///
/// In a file of several parts a channel is named `part.channel`, unless its name begins so already; a name that comes twice
/// gets `#2` on its layer. Where the data window is larger than the display window the image is cut to the latter; where it
/// leaves some of it open, or parts differ in size, the file is refused.
///
/// Claimed sizes are checked against the length of the file before anything of that size is allocated.
pub fn read_exr(path: &Path) -> Result<Image> {
    let file = File::open(path).map_err(|error| Error::io(path, error))?;
    let metadata = file.metadata().map_err(|error| Error::io(path, error))?;
    let wrong = |message| Error::Image { path: path.into(), message };
    if !metadata.is_file() {
        return Err(wrong("is not a regular file; expected an OpenEXR file".into()));
    }
    // Where overflow is checked (debug builds), exr 1.74's B44 decoder panics on damaged data; a bad file must be an error.
    let decoded = catch_unwind(AssertUnwindSafe(|| decode_exr(BufReader::new(file), metadata.len())));
    match decoded {
        Ok(Ok(image)) => Ok(image),
        Ok(Err(DecodeError::Exr(exr::error::Error::Io(error)))) => Err(Error::io(path, error)),
        Ok(Err(DecodeError::Exr(error))) => Err(wrong(format!("is not an OpenEXR file that can be read: {error}"))),
        Ok(Err(DecodeError::Image(message))) => Err(wrong(message)),
        Err(_) => Err(wrong("is not an OpenEXR file that can be read: damaged data".into())),
    }
}

enum DecodeError {
    Exr(exr::error::Error),
    Image(String),
}

impl From<exr::error::Error> for DecodeError {
    fn from(error: exr::error::Error) -> Self {
        Self::Exr(error)
    }
}

/// Most bytes that one byte of a chunk can decompress to.
///
/// Deflate codes 258 bytes in 2 bits (RFC 1951, 3.2.5): 1032. RLE writes 128 bytes from 2. PIZ writes a run of up to 255
/// 16-bit values from a code of at least 1 bit and a length of 8. B44A codes 16 half floats in 3 bytes. DWA stacks deflate on
/// runs.
fn max_expansion(compression: Compression) -> u64 {
    match compression {
        Compression::Uncompressed => 1,
        Compression::RLE => 64,
        Compression::ZIP1 | Compression::ZIP16 | Compression::PXR24 => 1032,
        Compression::PIZ => 454,
        Compression::B44 | Compression::B44A => 11,
        _ => 1032 * 64,
    }
}

fn decode_exr(file: impl Read + Seek, file_length: u64) -> Result<Image, DecodeError> {
    let reader = exr::block::read(file, false)?;
    let headers = reader.headers().to_vec();
    let window = headers[0].shared_attributes.display_window;
    check_readable(&headers, file_length).map_err(DecodeError::Image)?;

    let mut image = Image::new([window.size.width() as u32, window.size.height() as u32]);
    // Position in `image.channels` of every part's channels.
    let mut slots: Vec<Vec<usize>> = Vec::new();
    let mut taken: HashSet<String> = HashSet::new();
    for header in &headers {
        let part = header.own_attributes.layer_name.as_ref().map(decoded_text).unwrap_or_default();
        slots.push((image.channels.len()..image.channels.len() + header.channels.list.len()).collect());
        for channel in &header.channels.list {
            let mut name = decoded_text(&channel.name);
            let prefix = format!("{part}.");
            if headers.len() > 1 && !part.is_empty() && !name.starts_with(&prefix) {
                name.insert_str(0, &prefix);
            }
            let (layer, suffix) = split_layer(&name);
            let layer = numbered(layer, |layer| taken.insert(format!("{layer}{suffix}")));
            let name = format!("{layer}{suffix}");
            image.channels.push(Channel { name, samples: vec![0.0; image.pixel_count()] });
        }
        for (name, value) in &header.own_attributes.other {
            if let AttributeValue::Text(value) = value {
                image.attributes.entry(decoded_text(name)).or_insert_with(|| decoded_text(value));
            }
        }
    }

    let mut chunks = reader.filter_chunks(false, |_, tile, _| tile.is_largest_resolution_level())?;
    let meta_data = chunks.meta_data().clone();
    // As many chunks are read as there are blocks: none twice means that none is missing.
    let mut seen = HashSet::new();
    loop {
        // Decompress a few dozen chunks at a time: all cores at work, and never all of the file's blocks in memory.
        let batch = chunks.by_ref().take(64).collect::<Result<Vec<Chunk>, _>>()?;
        if batch.is_empty() {
            break;
        }
        for chunk in &batch {
            let block = headers[chunk.layer_index].get_block_data_indices(&chunk.compressed_block)?;
            if !block.is_largest_resolution_level() || !seen.insert((chunk.layer_index, block)) {
                let Vec2(x, y) = block.tile_index;
                return Err(DecodeError::Image(format!("is damaged: block {x}, {y} comes twice")));
            }
        }
        let blocks = batch
            .into_par_iter()
            .map(|chunk| {
                check_dwa_counters(&chunk, &headers)?;
                UncompressedBlock::decompress_chunk(chunk, &meta_data, false)
            })
            .collect::<Result<Vec<_>, _>>()?;
        for block in blocks {
            insert_block(&mut image, &headers, &slots, &block)?;
        }
    }
    image.channels.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(image)
}

/// Refuses a DWA chunk whose own counters claim more than a block can hold: the decoder allocates what they say.
fn check_dwa_counters(chunk: &Chunk, headers: &[Header]) -> Result<(), exr::error::Error> {
    let header = &headers[chunk.layer_index];
    let bytes = match &chunk.compressed_block {
        CompressedBlock::ScanLine(block) => &block.compressed_pixels_le,
        CompressedBlock::Tile(block) => &block.compressed_pixels_le,
        _ => return Ok(()),
    };
    if !matches!(header.compression, Compression::DWAA(_) | Compression::DWAB(_)) {
        return Ok(());
    }
    let tile = header.get_block_data_indices(&chunk.compressed_block)?;
    let Vec2(width, height) = header.get_absolute_block_pixel_coordinates(tile)?.size;
    let bytes_per_pixel = header.channels.bytes_per_pixel as u64;
    // A block that would not shrink is stored as it is.
    if bytes.len() as u64 == width as u64 * height as u64 * bytes_per_pixel {
        return Ok(());
    }
    // Blocks of 8×8 are padded; run lengths add less than as much again.
    let most = 2 * (width as u64 + 8) * (height as u64 + 8) * bytes_per_pixel;
    // Eleven 64-bit counters (OpenEXR, internal_dwa_compressor.h, DataSizesSingle). The five that size what is decoded:
    // unknown, RLE uncompressed, RLE raw, AC count and DC count; the decoder checks the others against the chunk.
    let counters = bytes.as_chunks::<8>().0.iter().take(11).map(|counter| u64::from_le_bytes(*counter));
    let too_large = counters.enumerate().any(|(i, counter)| matches!(i, 1 | 6 | 7 | 8 | 9) && counter > most);
    if too_large { Err(exr::error::Error::Invalid("DWA counters".into())) } else { Ok(()) }
}

/// UTF-8, else Latin-1.
fn decoded_text(text: &Text) -> String {
    String::from_utf8(text.as_slice().to_vec()).unwrap_or_else(|_| text.to_string())
}

/// `layer` and the rest, which begins with a dot; for a light's channel at the known suffix, else at the last dot.
fn split_layer(name: &str) -> (&str, &str) {
    let known = LIGHT_SUFFIXES.iter().find(|suffix| name.ends_with(*suffix)).map(|suffix| name.len() - suffix.len());
    name.split_at(known.or_else(|| name.rfind('.')).unwrap_or(name.len()))
}

/// Whether all parts cover the same display window, and their claims fit into the file and into memory.
fn check_readable(headers: &[Header], file_length: u64) -> Result<(), String> {
    let window = headers[0].shared_attributes.display_window;
    let mut samples = 0u64;
    let mut file_bytes = 0u64;
    for header in headers {
        let data = header.data_window();
        if header.shared_attributes.display_window != window {
            return Err("its parts have different display windows".into());
        }
        if !data.contains(window) || window.size.area() == 0 {
            return Err(format!(
                "its data window ({}) does not cover its display window ({}); expected an image without a crop region",
                described(data),
                described(window)
            ));
        }
        if header.deep {
            return Err("holds deep data; expected a flat image".into());
        }
        if let BlockDescription::Tiles(tiles) = header.blocks {
            // A tile is decoded as one block, however little of it lies in the image.
            let allowed = data.size.width().max(data.size.height()).max(4096);
            if tiles.tile_size.width() > allowed || tiles.tile_size.height() > allowed {
                let Vec2(width, height) = tiles.tile_size;
                return Err(format!("claims tiles of {width}×{height} pixels"));
            }
        }
        // The decoder allocates whole blocks, however few of their lines lie in the image.
        let block_bytes = header.max_block_byte_size() as u64;
        if block_bytes > MAX_SAMPLES * size_of::<f32>() as u64 {
            return Err(format!("claims blocks of {block_bytes} bytes"));
        }
        let pixels = data.size.width() as u64 * data.size.height() as u64;
        let channels = header.channels.list.len() as u64;
        samples = samples.saturating_add(pixels.saturating_mul(channels));
        let bytes = pixels.saturating_mul(header.channels.bytes_per_pixel as u64);
        // Each chunk has an offset, and at least a coordinate and a size.
        file_bytes = file_bytes
            .saturating_add(header.chunk_count as u64 * 16)
            .saturating_add(bytes / max_expansion(header.compression));
    }
    if samples > MAX_SAMPLES {
        return Err(format!("claims {samples} samples (pixels × channels); at most {MAX_SAMPLES} are read"));
    }
    if file_bytes > file_length {
        return Err(format!(
            "claims {} pixels in {} parts, which take at least {file_bytes} bytes; the file has {file_length}",
            described(window),
            headers.len()
        ));
    }
    Ok(())
}

fn described(window: exr::meta::attribute::IntegerBounds) -> String {
    let (Vec2(x, y), Vec2(width, height)) = (window.position, window.size);
    if x == 0 && y == 0 { format!("{width}×{height}") } else { format!("{width}×{height} at {x}, {y}") }
}

/// Copies the part of a decoded block that lies in the display window.
fn insert_block(
    image: &mut Image,
    headers: &[Header],
    slots: &[Vec<usize>],
    block: &UncompressedBlock,
) -> Result<(), exr::error::Error> {
    let header = &headers[block.index.layer];
    let origin = header.own_attributes.layer_position - header.shared_attributes.display_window.position;
    let [width, height] = image.size.map(i64::from);
    for line in block.lines(&header.channels) {
        let y = line.location.position.y() as i64 + i64::from(origin.y());
        if y < 0 || y >= height {
            continue;
        }
        let first = line.location.position.x() as i64 + i64::from(origin.x());
        let channel = line.location.channel;
        let row_start = (y * width) as usize;
        let row = &mut image.channels[slots[block.index.layer][channel]].samples[row_start..row_start + width as usize];
        let mut store = |i: usize, value: f32| {
            if let Ok(x) = usize::try_from(first + i as i64)
                && let Some(sample) = row.get_mut(x)
            {
                *sample = value;
            }
        };
        match header.channels.list[channel].sample_type {
            SampleType::F32 => line.read_samples::<f32>().enumerate().try_for_each(|(i, v)| v.map(|v| store(i, v)))?,
            SampleType::F16 => {
                line.read_samples::<f16>().enumerate().try_for_each(|(i, v)| v.map(|v| store(i, v.to_f32())))?;
            }
            SampleType::U32 => {
                line.read_samples::<u32>().enumerate().try_for_each(|(i, v)| v.map(|v| store(i, v as f32)))?;
            }
        }
    }
    Ok(())
}
