//! Answers kept between runs, by the content of what was asked.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::{fs, io};

use blake3::{Hash, Hasher};
use glam::DVec3;
use serde_json::Value;

use crate::image::{Image, read_exr, write_exr};
use crate::receivers::Receiver;
use crate::scene::{AreaLight, Scene};
use crate::techniques::{Frame, LightImage, Linking, Technique, timed};
use crate::{Error, Result};

/// Part of every key: raised whenever a technique's answers change.
const REVISION: u32 = 1;

/// The layer name that a cached light has in its file.
const LIGHT: &str = "light";

/// A technique whose answers are looked up in a directory first, and kept there. An answer is found again when nothing that it
/// depends on has changed: geometry, cut-outs, instances and linking, the light, every receiver, the technique and its
/// parameters. Each is an EXR file of its own, named by the hash of all that; any of them may be removed at any time.
#[derive(Debug)]
pub struct Cached<'a> {
    technique: &'a dyn Technique,
    name: &'a str,
    directory: PathBuf,
    warnings: Mutex<Vec<String>>,
}

impl<'a> Cached<'a> {
    /// Keeps what `technique`, known as `name`, answers in a directory, which is made if need be.
    ///
    /// # Errors
    /// A directory that can't be made or written to: better known before the work than after it.
    pub fn new(technique: &'a dyn Technique, name: &'a str, directory: &Path) -> Result<Self> {
        let failed = |cause| Error::io(directory, cause);
        if directory.exists() && !directory.is_dir() {
            let message = "is a file; expected a directory";
            return Err(failed(io::Error::new(io::ErrorKind::NotADirectory, message)));
        }
        fs::create_dir_all(directory).map_err(failed)?;
        tempfile::tempfile_in(directory).map_err(failed)?;
        Ok(Self { technique, name, directory: directory.to_path_buf(), warnings: Mutex::default() })
    }

    /// What could not be kept, in one line each: the answers themselves are none the worse for it.
    pub fn warnings(&self) -> Vec<String> {
        self.warnings.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn key(&self, frame: &Frame, light: &AreaLight) -> Hash {
        let mut hasher = Hasher::new();
        let header = format!(
            "{} {REVISION} {} {} {} {light:?} {:?} {:?}",
            env!("CARGO_PKG_VERSION"),
            self.name,
            self.technique.parameters(),
            frame.irradiance,
            Linking::of(frame.scene, light),
            frame.receivers.size,
        );
        hasher.update(header.as_bytes());
        hash_scene(&mut hasher, frame.scene);
        for pixel in &frame.receivers.pixels {
            match pixel {
                None => drop(hasher.update(&[0])),
                Some(receiver) => hash_receiver(&mut hasher, receiver),
            }
        }
        hasher.finalize()
    }
}

/// Adds all geometry that may block a light, cut-outs included.
pub fn hash_scene(hasher: &mut Hasher, scene: &Scene) {
    // Whatever varies in length goes with its length.
    let update = |hasher: &mut Hasher, bytes: &[u8]| {
        hasher.update(&bytes.len().to_le_bytes());
        hasher.update(bytes);
    };
    for mesh in &scene.meshes {
        update(hasher, bytemuck::must_cast_slice(&mesh.triangles));
        update(hasher, bytemuck::must_cast_slice(&mesh.positions));
        let cutout = mesh.material.and_then(|index| scene.materials[index].cutout.as_ref());
        let Some(cutout) = cutout else {
            update(hasher, b"opaque");
            continue;
        };
        let settings = cutout.texture.as_ref().map(|texture| {
            update(hasher, texture.texels.as_flattened());
            format!("{:?} {} {} {:?}", texture.size, texture.srgb, texture.nearest, texture.wrap)
        });
        update(hasher, format!("{} {} {settings:?}", cutout.cutoff, cutout.factor).as_bytes());
        update(hasher, mesh.uvs.as_ref().map_or(&[], |uvs| bytemuck::must_cast_slice(uvs)));
    }
    for instance in &scene.instances {
        hasher.update(&instance.mesh.to_le_bytes());
        hasher.update(bytemuck::must_cast_slice(&instance.scene_from_mesh.to_cols_array()));
    }
}

fn hash_receiver(hasher: &mut Hasher, receiver: &Receiver) {
    let Receiver { position, position_error, normal, shading_normal, instance, triangle, .. } = receiver;
    let vectors: [DVec3; 3] = [*position, *normal, *shading_normal];
    hasher.update(bytemuck::must_cast_slice(&vectors));
    hasher.update(&position_error.to_le_bytes());
    hasher.update(bytemuck::must_cast_slice(&[*instance, *triangle]));
}

impl Technique for Cached<'_> {
    fn render(&self, frame: &Frame, light: &AreaLight) -> Result<LightImage> {
        let key = self.key(frame, light);
        let path = self.directory.join(format!("{}.exr", key.to_hex()));
        let mut passes = Vec::new();
        let kept = timed(&mut passes, "cache", || read(&path, &key, frame));
        if let Some(kept) = kept {
            frame.progress.advance(u64::from(frame.receivers.size[1]))?;
            return Ok(LightImage { passes, ..kept });
        }
        let image = self.technique.render(frame, light)?;
        if let Err(error) = write(&path, &key, frame, &image) {
            let warning = format!("not kept for the next run: {error}");
            self.warnings.lock().unwrap_or_else(PoisonError::into_inner).push(warning);
        }
        Ok(image)
    }

    fn parameters(&self) -> Value {
        self.technique.parameters()
    }
}

/// The channels of a light's values: each is 1 where the value is true.
const FLAGS: [&str; 2] = ["facing", "sampled"];

/// A name for what a file holds: the question, and every value of the answer.
fn seal(key: &Hash, image: &Image) -> String {
    let mut hasher = Hasher::new();
    hasher.update(key.as_bytes());
    let mut channels: Vec<_> = image.channels.iter().collect();
    channels.sort_by(|a, b| a.name.cmp(&b.name));
    for channel in channels {
        hasher.update(channel.name.as_bytes());
        hasher.update(bytemuck::must_cast_slice(&channel.samples));
    }
    for name in ["samples", "rays"] {
        hasher.update(image.attributes.get(name).map_or(&[], |value| value.as_bytes()));
    }
    hasher.finalize().to_string()
}

/// What a file holds, unless it is not there, not whole, or not what was written: it is then written anew.
fn read(path: &Path, key: &Hash, frame: &Frame) -> Option<LightImage> {
    let image = read_exr(path).ok().filter(|image| image.size == frame.receivers.size)?;
    if image.attributes.get("seal") != Some(&seal(key, &image)) {
        return None;
    }
    let flags = |name: &str| Some(image.channel(&format!("{LIGHT}.{name}"))?.iter().map(|&x| x > 0.0).collect());
    let number = |name: &str| image.attributes.get(name)?.parse::<u64>().ok();
    let (mut irradiance, mut irradiance_ratio) = (Vec::new(), Vec::new());
    if frame.irradiance {
        let [red, green, blue] = image.irradiance(LIGHT)?;
        irradiance = (0..image.pixel_count()).map(|i| [red[i], green[i], blue[i]]).collect();
        irradiance_ratio = image.irradiance_ratio(LIGHT)?.to_vec();
    }
    Some(LightImage {
        visibility: image.visibility(LIGHT)?.to_vec(),
        irradiance,
        irradiance_ratio,
        facing: flags(FLAGS[0])?,
        sampled: flags(FLAGS[1]).unwrap_or_default(),
        samples: u32::try_from(number("samples")?).ok()?,
        rays: number("rays")?,
        ..LightImage::default()
    })
}

fn write(path: &Path, key: &Hash, frame: &Frame, light: &LightImage) -> Result<()> {
    let mut image = Image::new(frame.receivers.size);
    image.add(format!("{LIGHT}.visibility"), light.visibility.clone());
    for (channel, name) in ["R", "G", "B"].iter().enumerate().filter(|_| frame.irradiance) {
        let values = light.irradiance.iter().map(|rgb| rgb[channel]).collect();
        image.add(format!("{LIGHT}.irradiance.{name}"), values);
    }
    if frame.irradiance {
        image.add(format!("{LIGHT}.irradiance_ratio"), light.irradiance_ratio.clone());
    }
    for (name, flags) in FLAGS.iter().zip([&light.facing, &light.sampled]).filter(|(_, flags)| !flags.is_empty()) {
        image.add(format!("{LIGHT}.{name}"), flags.iter().map(|&flag| f32::from(u8::from(flag))).collect());
    }
    let numbers = [("samples", u64::from(light.samples)), ("rays", light.rays)];
    image.attributes.extend(numbers.map(|(name, value)| (name.to_owned(), value.to_string())));
    let seal = seal(key, &image);
    image.attributes.insert("seal".into(), seal);
    write_exr(path, &image)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use glam::{DVec2, Vec2, Vec3};

    use super::*;
    use crate::geometry::bvh::SceneBvh;
    use crate::progress::Progress;
    use crate::receivers::{Receivers, UNKNOWN};
    use crate::scene::procedural::build;
    use crate::scene::{Cutout, Material, Texture};
    use crate::techniques::rays::Rays;

    /// All that an answer depends on.
    #[derive(Clone)]
    struct Question {
        scene: Scene,
        receiver: Receiver,
        irradiance: bool,
        rays: Rays,
        name: &'static str,
    }

    impl Question {
        /// A square that is a cut-out, linked and seen from one receiver.
        fn new() -> Self {
            let mut scene = build("square").expect("builds").scene;
            let texture = Texture { size: [1, 1], texels: vec![[200]], ..Texture::default() };
            let cutout = Cutout { cutoff: 0.5, factor: 1.0, texture: Some(Arc::new(texture)) };
            scene.materials = vec![Material { cutout: Some(cutout), ..Material::default() }];
            for mesh in &mut scene.meshes {
                mesh.material = Some(0);
                mesh.uvs = Some(vec![Vec2::ZERO; mesh.positions.len()].into());
            }
            let receiver = Receiver {
                position: DVec3::ZERO,
                position_error: 0.0,
                normal: DVec3::Y,
                shading_normal: DVec3::Y,
                depth: 1.0,
                instance: UNKNOWN,
                triangle: UNKNOWN,
                barycentric: [0.0; 2],
            };
            Self { scene, receiver, irradiance: false, rays: Rays::default(), name: "rays" }
        }

        fn key(&self) -> Hash {
            let receivers = Receivers { size: [1, 1], pixels: vec![Some(self.receiver)] };
            let (bvh, progress) = (SceneBvh::new(&self.scene), Progress::default());
            let irradiance = self.irradiance;
            let frame = Frame {
                scene: &self.scene,
                bvh: &bvh,
                receivers: &receivers,
                irradiance,
                progress: &progress,
                buffers: None,
                shot: None,
            };
            let directory = std::env::temp_dir();
            let cached = Cached::new(&self.rays, self.name, &directory).expect("a directory for temporary files");
            cached.key(&frame, &self.scene.lights[0])
        }

        fn texture(&mut self) -> &mut Texture<1> {
            let cutout = self.scene.materials[0].cutout.as_mut().expect("a cut-out");
            Arc::make_mut(cutout.texture.as_mut().expect("a texture"))
        }
    }

    #[test]
    fn whatever_an_answer_depends_on_changes_the_key() {
        let original = Question::new();
        assert_eq!(original.key(), Question::new().key());
        type Change = fn(&mut Question);
        let changes: [(&str, Change); 21] = [
            ("positions", |q| {
                let mesh = &mut q.scene.meshes[0];
                mesh.positions = mesh.positions.iter().map(|&p| p + Vec3::X).collect();
            }),
            ("triangles", |q| q.scene.meshes[0].triangles.swap(0, 1)),
            ("uvs", |q| {
                let count = q.scene.meshes[0].positions.len();
                q.scene.meshes[0].uvs = Some(vec![Vec2::ONE; count].into());
            }),
            ("no cut-out", |q| q.scene.meshes[0].material = None),
            ("cut-off", |q| q.scene.materials[0].cutout.as_mut().expect("a cut-out").cutoff = 0.6),
            ("factor", |q| q.scene.materials[0].cutout.as_mut().expect("a cut-out").factor = 0.9),
            ("texels", |q| q.texture().texels[0] = [100]),
            ("filter", |q| q.texture().nearest = true),
            ("instance", |q| q.scene.instances[0].scene_from_mesh.translation.x += 1.0),
            ("light's place", |q| q.scene.lights[0].scene_from_light.translation.y += 1.0),
            ("light's shape", |q| q.scene.lights[0].shape = crate::scene::Shape::Rect { size: DVec2::ONE }),
            ("spread", |q| q.scene.lights[0].spread = 1.0),
            ("casts_shadow", |q| q.scene.lights[0].casts_shadow = false),
            ("shadow linking", |q| {
                q.scene.lights[0].shadow_exclude = vec![q.scene.nodes[q.scene.instances[0].node].name.clone()];
            }),
            ("own geometry", |q| q.scene.lights[0].own_instance = Some(0)),
            ("receiver", |q| q.receiver.position.x += 1.0),
            ("normal", |q| q.receiver.normal = DVec3::Z),
            ("shading normal", |q| q.receiver.shading_normal = DVec3::Z),
            ("quantity", |q| q.irradiance = true),
            ("parameters", |q| q.rays.samples += 1),
            ("technique", |q| q.name = "other"),
        ];
        let mut keys = vec![("nothing", original.key())];
        for (what, change) in changes {
            let mut changed = original.clone();
            change(&mut changed);
            let key = changed.key();
            for (other, other_key) in &keys {
                assert_ne!(key, *other_key, "{what} and {other}");
            }
            keys.push((what, key));
        }
    }
}
