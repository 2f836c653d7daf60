//! Materials and textures, as far as a Lambertian surface with cut-outs needs them.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::io::Cursor;
use std::path::PathBuf;
use std::sync::Arc;

use glam::{Affine2, Mat2, Vec2, Vec3};
use gltf::json::material::AlphaMode;
use gltf::json::texture::{Info, MagFilter, Sampler, WrappingMode};
use gltf::json::validation::Checked;
use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader, Limits};
use rayon::prelude::*;

use super::Warnings;
use super::document::{Document, Fault, Parsed, data_uri, fault, item, read};
use crate::scene::{Cutout, LoadOptions, Material, Texture, Wrap};

/// Texels that the textures of a file may have in all: these, and [`TEXELS_PER_BYTE`] more for each byte of their files.
/// Photographs have 1 to 20 texels a byte; a bomb of one colour has a thousand.
const FREE_TEXELS: u64 = 1 << 26;
/// See [`FREE_TEXELS`].
const TEXELS_PER_BYTE: u64 = 256;
/// The decoder may be fed the file's bytes this many times: textures that share an image may differ in their samplers.
const MAX_DECODES: u64 = 16;
/// An image file may have at most this many bytes.
const MAX_IMAGE_BYTES: u64 = 1 << 30;

/// How a mesh finds the texture coordinates of its material's textures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) struct TexCoords {
    /// TEXCOORD_n.
    pub set: u32,
    /// Bits of KHR_texture_transform's offset, rotation and scale.
    transform: [u32; 5],
}

impl TexCoords {
    /// The transform of texture coordinates. Positive angles turn counter-clockwise on the image, whose v axis points down: the
    /// extension's text and all known implementations, against the sample code of its README (KhronosGroup/glTF issue 1563).
    pub fn transform(&self) -> Affine2 {
        let [offset_u, offset_v, rotation, scale_u, scale_v] = self.transform.map(f32::from_bits);
        let (sin, cos) = rotation.sin_cos();
        Affine2 {
            matrix2: Mat2::from_cols(scale_u * Vec2::new(cos, -sin), scale_v * Vec2::new(sin, cos)),
            translation: Vec2::new(offset_u, offset_v),
        }
    }
}

/// A material of the file.
pub(super) struct Source {
    pub material: Material,
    /// None: it has no texture that is loaded.
    pub tex_coords: Option<TexCoords>,
    /// Radiance in nits, if it emits.
    pub emission: Option<Vec3>,
    /// It has KHR_materials_emissive_strength: its emission is photometric, not just a glow of at most one nit.
    pub emissive_strength: bool,
    /// It emits through a texture.
    pub emissive_texture: bool,
    pub double_sided: bool,
}

/// Loads all materials, and the textures of those that are used.
pub(super) fn load(
    document: &Document,
    options: LoadOptions,
    used: &[bool],
    warnings: &mut Warnings,
) -> Parsed<Vec<Source>> {
    let mut sources = Vec::with_capacity(used.len());
    let mut wanted: Vec<Wanted> = Vec::new();
    let mut known: HashMap<usize, usize> = HashMap::new();
    let mut uses = Vec::with_capacity(used.len());
    for (index, &used) in used.iter().enumerate() {
        let (source, texture) = describe(document, index, options, used, warnings)?;
        uses.push(texture);
        if let Some((texture, channels)) = texture {
            let at = *known.entry(texture).or_insert(wanted.len());
            if at == wanted.len() {
                wanted.push((texture, [false; 2]));
            }
            let all = &mut wanted[at].1;
            *all = [all[0] | channels[0], all[1] | channels[1]];
        }
        sources.push(source);
    }
    let textures = textures(document, &wanted)?;
    for (source, texture) in sources.iter_mut().zip(uses) {
        let Some((texture, channels)) = texture else { continue };
        let (base_color, alpha) = &textures[&texture];
        if channels[0] {
            source.material.base_color_texture.clone_from(base_color);
        }
        if let Some(cutout) = source.material.cutout.as_mut().filter(|_| channels[1]) {
            cutout.texture.clone_from(alpha);
        }
    }
    for source in &mut sources {
        // A cut-out that cuts nothing out costs rays for nothing.
        source.material.cutout = source.material.cutout.take().filter(|c| c.texture.is_some() || c.factor < c.cutoff);
        let cut_by_texture = source.material.cutout.as_ref().is_some_and(|cutout| cutout.texture.is_some());
        if !cut_by_texture && source.material.base_color_texture.is_none() {
            source.tex_coords = None;
        }
    }
    Ok(sources)
}

/// A material without its texture, and what it needs of which texture.
fn describe(
    document: &Document,
    index: usize,
    options: LoadOptions,
    used: bool,
    warnings: &mut Warnings,
) -> Parsed<(Source, Option<Wanted>)> {
    let json = &document.root.materials[index];
    let place = |member: &str| format!("materials[{index}].{member}");
    let name = super::name_or(json.name.as_deref(), "material", index);
    let pbr = &json.pbr_metallic_roughness;
    let factor = pbr.base_color_factor.0;
    if !factor.iter().all(|c| c.is_finite()) {
        return Err(fault(place("pbrMetallicRoughness.baseColorFactor"), "expected finite numbers"));
    }
    if ![pbr.metallic_factor, pbr.roughness_factor].iter().all(|factor| factor.0.is_finite()) {
        return Err(fault(place("pbrMetallicRoughness"), "expected a finite metallicFactor and roughnessFactor"));
    }
    if options.highlights && used && pbr.metallic_roughness_texture.is_some() {
        warnings.add("textures of metalness and roughness are left out", &name);
    }
    let Checked::Valid(alpha_mode) = json.alpha_mode else {
        return Err(fault(place("alphaMode"), "expected OPAQUE, MASK or BLEND"));
    };
    let cutout = (alpha_mode == AlphaMode::Mask).then(|| Cutout {
        cutoff: json.alpha_cutoff.map_or(0.5, |cutoff| cutoff.0),
        factor: factor[3],
        texture: None,
    });
    if cutout.as_ref().is_some_and(|cutout| !cutout.cutoff.is_finite()) {
        return Err(fault(place("alphaCutoff"), "expected a finite number"));
    }
    if alpha_mode == AlphaMode::Blend && used {
        warnings.add("alphaMode BLEND is taken as opaque", &name);
    }
    let channels = [options.base_color_textures && used, cutout.is_some() && used];
    let info = pbr.base_color_texture.as_ref().filter(|_| channels != [false; 2]);
    let tex_coords = match info {
        Some(info) => Some(tex_coords(info, &place("pbrMetallicRoughness.baseColorTexture"))?),
        None => None,
    };
    if let Some(info) = info {
        item(&document.root.textures, "textures", info.index.value(), || {
            place("pbrMetallicRoughness.baseColorTexture.index")
        })?;
    }
    let strength = json.extensions.as_ref().and_then(|extensions| extensions.emissive_strength.as_ref());
    let emission = Vec3::from(json.emissive_factor.0) * strength.map_or(1.0, |strength| strength.emissive_strength.0);
    if !(emission.is_finite() && emission.min_element() >= 0.0) {
        return Err(fault(place("emissiveFactor"), "expected finite numbers of at least 0"));
    }
    let source = Source {
        material: Material {
            name,
            base_color: Vec3::from_slice(&factor[..3]).clamp(Vec3::ZERO, Vec3::ONE),
            base_color_texture: None,
            metallic: pbr.metallic_factor.0.clamp(0.0, 1.0),
            roughness: pbr.roughness_factor.0.clamp(0.0, 1.0),
            cutout,
        },
        tex_coords,
        emission: (emission != Vec3::ZERO).then_some(emission),
        emissive_strength: strength.is_some(),
        emissive_texture: json.emissive_texture.is_some(),
        double_sided: json.double_sided,
    };
    Ok((source, info.map(|info| (info.index.value(), channels))))
}

fn tex_coords(info: &Info, place: &str) -> Parsed<TexCoords> {
    let (mut set, mut transform) = (info.tex_coord, [0.0, 0.0, 0.0, 1.0, 1.0]);
    if let Some(json) = info.extensions.as_ref().and_then(|extensions| extensions.texture_transform.as_ref()) {
        let ([offset_u, offset_v], [scale_u, scale_v]) = (json.offset.0, json.scale.0);
        transform = [offset_u, offset_v, json.rotation.0, scale_u, scale_v];
        set = json.tex_coord.unwrap_or(set);
    }
    if transform.iter().all(|value| value.is_finite()) {
        return Ok(TexCoords { set, transform: transform.map(f32::to_bits) });
    }
    Err(fault(format!("{place}.extensions.KHR_texture_transform"), "expected finite numbers"))
}

/// A texture, and whether its base colour and its alpha are needed.
type Wanted = (usize, [bool; 2]);

/// Base colour and alpha of a texture.
type Loaded = (Option<Arc<Texture<3>>>, Option<Arc<Texture<1>>>);

/// Decodes textures: base colour, alpha or both of each.
fn textures(document: &Document, wanted: &[Wanted]) -> Parsed<HashMap<usize, Loaded>> {
    let mut files: HashMap<PathBuf, Arc<[u8]>> = HashMap::new();
    let mut encoded: HashMap<usize, Encoded> = HashMap::new();
    for &(texture, _) in wanted {
        if let Entry::Vacant(entry) = encoded.entry(document.root.textures[texture].source.value()) {
            entry.insert(image_bytes(document, texture, &mut files)?);
        }
    }
    let size = document.size + files.values().map(|file| file.len() as u64).sum::<u64>();
    let budget = FREE_TEXELS.saturating_add(size.saturating_mul(TEXELS_PER_BYTE));
    let (mut texels, mut bytes) = (0u64, 0u64);
    for &(texture, _) in wanted {
        let image = document.root.textures[texture].source.value();
        let place = || format!("images[{image}]");
        bytes = bytes.saturating_add(encoded[&image].len() as u64);
        if bytes > size.saturating_mul(MAX_DECODES) {
            return Err(fault(place(), format!("textures use the file's {size} bytes more than {MAX_DECODES} times")));
        }
        let (width, height) = decoder(&encoded[&image], image)?.dimensions();
        texels = texels.saturating_add(u64::from(width) * u64::from(height));
        if texels > budget || width == 0 || height == 0 {
            let message = format!(
                "{width} x {height} texels: textures of {size} bytes may have {budget} texels in all, and this one goes \
                 beyond"
            );
            return Err(fault(place(), message));
        }
    }
    let decoded: Vec<Parsed<(usize, Loaded)>> = wanted
        .par_iter()
        .map(|&(texture, channels)| {
            let image = document.root.textures[texture].source.value();
            let decoder = decoder(&encoded[&image], image)?;
            let decoded = DynamicImage::from_decoder(decoder).map_err(|error| undecodable(image, &error))?;
            Ok((texture, convert(document, texture, decoded, channels)?))
        })
        .collect();
    decoded.into_iter().collect()
}

/// An image file.
enum Encoded<'a> {
    /// Part of a buffer.
    View(&'a [u8]),
    /// Contents of a data URI or of a file.
    Owned(Arc<[u8]>),
}

impl std::ops::Deref for Encoded<'_> {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        match self {
            Self::View(bytes) => bytes,
            Self::Owned(bytes) => bytes,
        }
    }
}

/// The image file of a texture. Files outside the document are read once.
fn image_bytes<'a>(
    document: &'a Document,
    texture: usize,
    files: &mut HashMap<PathBuf, Arc<[u8]>>,
) -> Parsed<Encoded<'a>> {
    let index = document.root.textures[texture].source.value();
    let image = item(&document.root.images, "images", index, || format!("textures[{texture}].source"))?;
    if let Some(uri) = &image.uri {
        let place = format!("images[{index}].uri");
        if let Some(data) = data_uri(uri, &place)? {
            return Ok(Encoded::Owned(data.into()));
        }
        let path = document.external(uri, &place)?;
        return Ok(Encoded::Owned(match files.entry(path) {
            Entry::Occupied(file) => file.get().clone(),
            Entry::Vacant(file) => {
                let bytes = read(file.key(), 0, MAX_IMAGE_BYTES, &place)?;
                file.insert(bytes.into()).clone()
            }
        }));
    }
    match image.buffer_view {
        Some(view) => Ok(Encoded::View(document.view(view.value(), || format!("images[{index}].bufferView"))?.0)),
        None => Err(fault(format!("images[{index}]"), "expected a uri or a bufferView")),
    }
}

/// A decoder whose header has been read and whose memory is limited.
fn decoder(bytes: &[u8], image: usize) -> Parsed<impl ImageDecoder + '_> {
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|error| fault(format!("images[{image}]"), error.to_string()))?;
    if !matches!(reader.format(), Some(ImageFormat::Png | ImageFormat::Jpeg)) {
        return Err(fault(format!("images[{image}]"), "expected PNG or JPEG"));
    }
    reader.limits(Limits::default());
    reader.into_decoder().map_err(|error| undecodable(image, &error))
}

fn undecodable(image: usize, error: &image::ImageError) -> Fault {
    fault(format!("images[{image}]"), format!("can't be decoded: {error}"))
}

fn convert(document: &Document, texture: usize, image: DynamicImage, channels: [bool; 2]) -> Parsed<Loaded> {
    let size = [image.width(), image.height()];
    let default = Sampler::default();
    let sampler = match document.root.textures[texture].sampler {
        Some(sampler) => {
            item(&document.root.samplers, "samplers", sampler.value(), || format!("textures[{texture}].sampler"))?
        }
        None => &default,
    };
    let wrap = [wrap(&sampler.wrap_s), wrap(&sampler.wrap_t)];
    let nearest = sampler.mag_filter == Some(Checked::Valid(MagFilter::Nearest));
    // An image without alpha cuts nothing out.
    let alpha = (channels[1] && image.color().has_alpha()).then(|| {
        let texels = image.to_rgba8().into_raw().as_chunks::<4>().0.iter().map(|rgba| [rgba[3]]).collect();
        Arc::new(Texture { size, texels, srgb: false, nearest, wrap })
    });
    let base_color = channels[0].then(|| {
        let texels = image.into_rgb8().into_raw().as_chunks::<3>().0.to_vec();
        Arc::new(Texture { size, texels, srgb: true, nearest, wrap })
    });
    Ok((base_color, alpha))
}

fn wrap(mode: &Checked<WrappingMode>) -> Wrap {
    match mode {
        Checked::Valid(WrappingMode::ClampToEdge) => Wrap::ClampToEdge,
        Checked::Valid(WrappingMode::MirroredRepeat) => Wrap::MirroredRepeat,
        Checked::Valid(WrappingMode::Repeat) | Checked::Invalid => Wrap::Repeat,
    }
}
