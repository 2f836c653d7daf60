//! Containers: GLB chunks, JSON, buffers and URIs, each checked before it is used.

use std::borrow::Cow;
use std::collections::HashMap;
use std::path::{Path, PathBuf};

use base64::Engine;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use gltf::json::{Root, buffer};
use percent_encoding::percent_decode_str;
use serde::Deserialize;
use serde::de::value::{MapAccessDeserializer, StringDeserializer};
use serde::de::{DeserializeSeed, Deserializer, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_path_to_error::Track;

use super::animation::Animation;

/// What is wrong with a file, and where inside it.
#[derive(Debug)]
pub(super) struct Fault {
    pub place: String,
    pub message: String,
}

/// `Result` with a [`Fault`].
pub(super) type Parsed<T> = Result<T, Fault>;

/// A fault at `place`.
pub(super) fn fault(place: impl Into<String>, message: impl Into<String>) -> Fault {
    Fault { place: place.into(), message: message.into() }
}

/// Text from a file on one line of bounded length.
pub(super) fn one_line(text: &str, most: usize) -> String {
    let mut line: String = text.chars().take(most).map(|c| if c.is_control() { ' ' } else { c }).collect();
    if text.chars().nth(most).is_some() {
        line.push('…');
    }
    line
}

/// A name from a file as messages show it.
pub(super) fn quoted(name: &str) -> String {
    format!("`{}`", one_line(name, 60))
}

/// The item of a list of the document, or a fault at `place` that says how many there are.
pub(super) fn item<'a, T>(list: &'a [T], kind: &str, index: usize, place: impl FnOnce() -> String) -> Parsed<&'a T> {
    list.get(index)
        .ok_or_else(|| fault(place(), format!("{kind}[{index}] does not exist: the file has {}", list.len())))
}

/// A parsed file with its buffers.
pub(super) struct Document<'a> {
    /// Without its animations.
    pub root: Root,
    /// Its animations, in types of their own: extensions change what a channel has (KHR_animation_pointer: no node).
    pub animations: Vec<Animation>,
    /// Bytes of JSON and of distinct buffers: what the size of a loaded scene is held against.
    pub size: u64,
    buffers: Vec<Buffer>,
    /// The BIN chunk of a GLB.
    bin: &'a [u8],
    /// Contents of data URIs and external files, each once.
    contents: Vec<Vec<u8>>,
    base_dir: Option<&'a Path>,
}

/// Where a buffer's bytes are, and how many of them it has.
struct Buffer {
    /// Index into [`Document::contents`]; none: the BIN chunk.
    content: Option<usize>,
    length: usize,
}

impl<'a> Document<'a> {
    /// Parses a .gltf or .glb, told apart by their first bytes.
    pub fn parse(bytes: &'a [u8], base_dir: Option<&'a Path>) -> Parsed<Self> {
        let (json, bin) = if bytes.starts_with(b"glTF") { glb_chunks(bytes)? } else { (bytes, None) };
        let Parts { mut root, animations } = parse_json(json)?;
        let mut document = Self {
            size: json.len() as u64,
            buffers: Vec::new(),
            bin: bin.unwrap_or(&[]),
            contents: Vec::new(),
            base_dir,
            animations,
            root: Root::default(),
        };
        document.read_buffers(&mut root.buffers, bin.is_some())?;
        document.size +=
            bin.map_or(0, <[u8]>::len) as u64 + document.contents.iter().map(|c| c.len() as u64).sum::<u64>();
        document.root = root;
        Ok(document)
    }

    /// The bytes of a buffer view.
    pub fn view(&self, index: usize, place: impl Fn() -> String) -> Parsed<(&[u8], &buffer::View)> {
        let view = item(&self.root.buffer_views, "bufferViews", index, &place)?;
        let buffer_index = view.buffer.value();
        let buffer = item(&self.buffers, "buffers", buffer_index, || format!("bufferViews[{index}].buffer"))?;
        let bytes = match buffer.content {
            Some(content) => &self.contents[content][..buffer.length],
            None => &self.bin[..buffer.length],
        };
        let start = view.byte_offset.unwrap_or_default().0;
        let range = start
            .checked_add(view.byte_length.0)
            .filter(|&end| end <= bytes.len() as u64)
            .map(|end| start as usize..end as usize);
        match range {
            Some(range) => Ok((&bytes[range], view)),
            None => Err(fault(
                format!("bufferViews[{index}]"),
                format!(
                    "{} bytes from {start} do not fit buffers[{buffer_index}], which has {}",
                    view.byte_length.0,
                    bytes.len()
                ),
            )),
        }
    }

    /// Where a relative URI leads: one path for one file, however it is spelt.
    pub fn external(&self, uri: &str, place: &str) -> Parsed<PathBuf> {
        let shown = quoted(uri);
        let decoded = percent_decode_str(uri)
            .decode_utf8()
            .map_err(|_| fault(place, format!("{shown} is not UTF-8 once percent-decoded")))?;
        let scheme_ends = decoded.find(|c: char| !(c.is_ascii_alphanumeric() || "+-.".contains(c)));
        let has_scheme = scheme_ends.is_some_and(|at| at > 0 && decoded[at..].starts_with(':'));
        if has_scheme || decoded.starts_with(['/', '\\']) || Path::new(&*decoded).has_root() {
            return Err(fault(place, format!("{shown} is not a relative path or a data: URI")));
        }
        match self.base_dir {
            Some(directory) => directory.join(&*decoded).canonicalize().map_err(|error| unreadable(place, uri, &error)),
            None => Err(fault(place, format!("{shown} is a file outside this one, which has no directory"))),
        }
    }

    fn read_buffers(&mut self, buffers: &mut [gltf::json::Buffer], has_bin: bool) -> Parsed<()> {
        let mut files: HashMap<PathBuf, (usize, u64)> = HashMap::new();
        let mut paths = Vec::new();
        for (index, buffer) in buffers.iter_mut().enumerate() {
            let place = format!("buffers[{index}].uri");
            let needed = buffer.byte_length.0;
            // Taken, so that a large data URI is not held twice.
            let content = match buffer.uri.take() {
                None if index == 0 && has_bin => None,
                None => {
                    return Err(fault(place, "missing, and this is not the first buffer of a GLB with a BIN chunk"));
                }
                Some(uri) => match data_uri(&uri, &place)? {
                    Some(data) => {
                        self.contents.push(data);
                        Some(self.contents.len() - 1)
                    }
                    None => {
                        let path = self.external(&uri, &place)?;
                        let next = self.contents.len();
                        let (content, most) = files.entry(path.clone()).or_insert((next, 0));
                        *most = needed.max(*most);
                        if *content == next {
                            self.contents.push(Vec::new());
                            paths.push((path, place.clone()));
                        }
                        Some(*content)
                    }
                },
            };
            let length = usize::try_from(needed).map_err(|_| fault(&place, "byteLength exceeds the address space"))?;
            self.buffers.push(Buffer { content, length });
        }
        for (path, place) in paths {
            let (content, most) = files[&path];
            self.contents[content] = read(&path, most, most, &place)?;
        }
        for (index, buffer) in self.buffers.iter().enumerate() {
            let found = buffer.content.map_or(self.bin.len(), |content| self.contents[content].len());
            if found < buffer.length {
                let place = format!("buffers[{index}].byteLength");
                return Err(fault(place, format!("expected {} bytes, found {found}", buffer.length)));
            }
        }
        Ok(())
    }
}

/// Reads at most `most` bytes of a regular file that must have at least `least`: a size that the file only claims is never
/// allocated, and neither a device nor a pipe is opened.
pub(super) fn read(path: &Path, least: u64, most: u64, place: &str) -> Parsed<Vec<u8>> {
    use std::io::Read;
    let shown = path.display().to_string();
    let metadata = path.metadata().map_err(|error| unreadable(place, &shown, &error))?;
    if !metadata.is_file() {
        return Err(fault(place, format!("{} is not a regular file", quoted(&shown))));
    }
    if metadata.len() < least {
        return Err(fault(place, format!("expected {least} bytes in {}, found {}", quoted(&shown), metadata.len())));
    }
    let mut bytes = Vec::new();
    let read = std::fs::File::open(path).and_then(|file| {
        bytes.reserve_exact(metadata.len().min(most) as usize);
        file.take(most).read_to_end(&mut bytes)
    });
    read.map_err(|error| unreadable(place, &shown, &error))?;
    Ok(bytes)
}

fn unreadable(place: &str, uri: &str, error: &std::io::Error) -> Fault {
    fault(place, format!("{} can't be read: {error}", quoted(uri)))
}

/// The contents of a base64 data URI; none for any other URI.
pub(super) fn data_uri(uri: &str, place: &str) -> Parsed<Option<Vec<u8>>> {
    if !uri.get(..5).is_some_and(|scheme| scheme.eq_ignore_ascii_case("data:")) {
        return Ok(None);
    }
    let Some((header, data)) = uri.split_once(',') else {
        return Err(fault(place, "data: URI without a comma"));
    };
    if !header.ends_with(";base64") {
        return Err(fault(place, format!("expected a data: URI in base64, found {}", quoted(header))));
    }
    let config = GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent);
    let data = GeneralPurpose::new(&STANDARD, config).decode(data);
    data.map(Some).map_err(|error| fault(place, format!("base64: {error}")))
}

/// The JSON and BIN chunks of a GLB (glTF 2.0, 4. GLB File Format Specification). Chunks of other types are skipped, as the
/// specification demands.
fn glb_chunks(bytes: &[u8]) -> Parsed<(&[u8], Option<&[u8]>)> {
    let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let (Some(version), Some(length)) = (word(4), word(8)) else {
        return Err(fault("GLB header", format!("expected 12 bytes, found {}", bytes.len())));
    };
    if version != 2 {
        return Err(fault("GLB header", format!("expected version 2, found {version}")));
    }
    let length = length as usize;
    if length < 12 || length > bytes.len() {
        return Err(fault("GLB header", format!("its length is {length} bytes, the file has {}", bytes.len())));
    }
    let (mut json, mut bin) = (None, None);
    let mut at = 12;
    while at < length {
        let place = || format!("GLB chunk at byte {at}");
        let (Some(size), Some(kind)) = (word(at).filter(|_| at + 8 <= length), bytes.get(at + 4..at + 8)) else {
            return Err(fault(place(), "cut short"));
        };
        let start = at + 8;
        let size = size as usize;
        if size > length - start {
            return Err(fault(place(), format!("its length is {size} bytes, {} are left", length - start)));
        }
        let data = &bytes[start..start + size];
        match kind {
            b"JSON" if json.is_none() => json = Some(data),
            _ if json.is_none() => return Err(fault(place(), "expected the JSON chunk first")),
            b"BIN\0" if bin.is_none() => bin = Some(data),
            _ => {}
        }
        // Chunks start at multiples of four bytes; a writer that left the padding out of the length is understood too.
        at = (start + size).next_multiple_of(4);
    }
    match json {
        Some(json) => Ok((json, bin)),
        None => Err(fault("GLB", "no JSON chunk")),
    }
}

/// What decides whether the rest of a document can be read.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Head {
    asset: Asset,
    #[serde(default)]
    extensions_required: Vec<String>,
}

/// glTF's `asset`.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Asset {
    version: String,
    min_version: Option<String>,
}

fn parse_json(json: &[u8]) -> Parsed<Parts> {
    let json = json.strip_prefix(b"\xef\xbb\xbf").unwrap_or(json);
    // A file of another version, or one that needs what we lack, should say so before it fails on a detail.
    if let Ok(head) = serde_json::from_slice::<Head>(json) {
        let needed = head.asset.min_version.as_ref().unwrap_or(&head.asset.version);
        let too_new = head.asset.min_version.as_ref().is_some_and(|version| version != "2.0");
        if too_new || !head.asset.version.starts_with("2.") {
            return Err(fault("asset.version", format!("expected glTF 2.0, found {}", quoted(needed))));
        }
        for (index, name) in head.extensions_required.iter().enumerate() {
            if !supported(name) {
                let place = format!("extensionsRequired[{index}]");
                return Err(fault(place, format!("{} is not supported", quoted(name))));
            }
        }
    }
    let parts = deserialize_at(json, |deserializer| deserializer.deserialize_map(PartsVisitor))?;
    deserialize_at(json, |deserializer| NarrowIndices { here: false, below: false }.deserialize(deserializer))?;
    Ok(parts)
}

/// Extensions that a file may require.
fn supported(name: &str) -> bool {
    // Materials matter only as far as a Lambertian surface needs them.
    name.starts_with("KHR_materials_")
        || [
            "EXT_lights_area",
            "EXT_mesh_gpu_instancing",
            "KHR_lights_punctual",
            "KHR_mesh_quantization",
            "KHR_texture_transform",
            "PENUMBRA_lights",
        ]
        .contains(&name)
}

/// A document whose animations are read apart from the rest.
struct Parts {
    root: Root,
    animations: Vec<Animation>,
}

struct PartsVisitor;

impl<'de> Visitor<'de> for PartsVisitor {
    type Value = Parts;

    fn expecting(&self, formatter: &mut std::fmt::Formatter) -> std::fmt::Result {
        formatter.write_str("struct Root")
    }

    fn visit_map<A: MapAccess<'de>>(self, members: A) -> Result<Parts, A::Error> {
        let mut animations = Vec::new();
        let members = OtherMembers { members, animations: &mut animations };
        let root = Root::deserialize(MapAccessDeserializer::new(members))?;
        Ok(Parts { root, animations })
    }
}

/// The members of a document but `animations`.
struct OtherMembers<'a, A> {
    members: A,
    animations: &'a mut Vec<Animation>,
}

impl<'de, A: MapAccess<'de>> MapAccess<'de> for OtherMembers<'_, A> {
    type Error = A::Error;

    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, A::Error> {
        while let Some(key) = self.members.next_key::<String>()? {
            if key != "animations" {
                return seed.deserialize(StringDeserializer::new(key)).map(Some);
            }
            *self.animations = self.members.next_value()?;
        }
        Ok(None)
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, A::Error> {
        self.members.next_value_seed(seed)
    }
}

type Json<'a, 'b> = &'b mut serde_json::Deserializer<serde_json::de::SliceRead<'a>>;

fn deserialize_at<'a, T>(
    json: &'a [u8],
    read: impl for<'b, 'c> FnOnce(serde_path_to_error::Deserializer<'b, 'c, Json<'a, 'b>>) -> serde_json::Result<T>,
) -> Parsed<T> {
    let mut deserializer = serde_json::Deserializer::from_slice(json);
    let mut track = Track::new();
    let value = read(serde_path_to_error::Deserializer::new(&mut deserializer, &mut track))
        .map_err(|error| json_fault(&track.path().to_string(), &error))?;
    deserializer.end().map_err(|error| json_fault(".", &error))?;
    Ok(value)
}

fn json_fault(path: &str, error: &serde_json::Error) -> Fault {
    let at = format!("line {}, column {}", error.line(), error.column());
    let place = if path == "." || path == "?" { at } else { format!("{path} ({at})") };
    let text = error.to_string();
    let suffix = format!(" at line {} column {}", error.line(), error.column());
    fault(place, text.strip_suffix(&suffix).unwrap_or(&text))
}

/// Reads an extension's JSON; faults name the place inside it.
pub(super) fn extension<'a, T: Deserialize<'a>>(value: &'a serde_json::Value, place: &str) -> Parsed<T> {
    serde_path_to_error::deserialize(value).map_err(|error| {
        let path = error.path().to_string();
        let place = if path == "." { place.to_owned() } else { format!("{place}.{path}") };
        fault(place, error.inner().to_string())
    })
}

/// Refuses integers of more than 32 bits where glTF has an index or an enumeration: `gltf::json` keeps their low half.
#[derive(Clone, Copy)]
struct NarrowIndices {
    /// The value itself is one.
    here: bool,
    /// The members of the object are.
    below: bool,
}

/// Keys whose values are indices or enumerations, or arrays of them.
const INDEX_KEYS: [&str; 26] = [
    "buffer",
    "bufferView",
    "camera",
    "children",
    "componentType",
    "index",
    "indices",
    "input",
    "inverseBindMatrices",
    "joints",
    "light",
    "magFilter",
    "material",
    "mesh",
    "minFilter",
    "mode",
    "node",
    "nodes",
    "output",
    "sampler",
    "scene",
    "skeleton",
    "skin",
    "source",
    "wrapS",
    "wrapT",
];

impl<'de> DeserializeSeed<'de> for NarrowIndices {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for NarrowIndices {
    type Value = ();

    fn expecting(&self, formatter: &mut std::fmt::Formatter) -> std::fmt::Result {
        formatter.write_str("JSON")
    }

    fn visit_u64<E: serde::de::Error>(self, value: u64) -> Result<(), E> {
        if self.here && value > u64::from(u32::MAX) {
            return Err(E::custom(format!("{value} is out of range")));
        }
        Ok(())
    }

    fn visit_i64<E>(self, _: i64) -> Result<(), E> {
        Ok(())
    }

    fn visit_f64<E>(self, _: f64) -> Result<(), E> {
        Ok(())
    }

    fn visit_bool<E>(self, _: bool) -> Result<(), E> {
        Ok(())
    }

    fn visit_str<E>(self, _: &str) -> Result<(), E> {
        Ok(())
    }

    fn visit_unit<E>(self) -> Result<(), E> {
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        while items.next_element_seed(self)?.is_some() {}
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<(), A::Error> {
        while let Some(key) = members.next_key::<Cow<str>>()? {
            // Animations have types of their own.
            if key == "extras" || key == "animations" {
                members.next_value::<IgnoredAny>()?;
                continue;
            }
            let here = self.below || INDEX_KEYS.contains(&&*key);
            members.next_value_seed(Self { here, below: key == "attributes" || key == "targets" })?;
        }
        Ok(())
    }
}
