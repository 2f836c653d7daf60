//! The GPU, headless: adapter and device, buffers and textures, reading back.
//!
//! Software adapters (lavapipe) count as GPUs and are named as what they are. Mistakes in the use of wgpu are ours: they panic
//! with what to report. What a machine lacks is the user's to know: an [`Error::Gpu`] of one line.

pub mod center_map;
pub mod emission;
pub mod gbuffer;
pub mod layout;
pub mod light_view;
pub mod min_max;
pub mod pass;
pub mod scene;
pub mod screen;
pub mod shader;
pub mod shadow_map;

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError, mpsc};

use serde::Serialize;

use self::shader::{Constants, Pipeline, Source, Targets};
use crate::{Error, Result};

/// A device, ready for work.
#[derive(Debug)]
pub struct Gpu {
    /// Makes resources.
    pub device: wgpu::Device,
    /// Takes work.
    pub queue: wgpu::Queue,
    /// What the work runs on.
    pub adapter: Adapter,
    /// Nanoseconds a tick of a timestamp, where the adapter has timestamps.
    pub timestamp_period_ns: Option<f64>,
    /// What the driver has given up for, if it has: all work after that is void.
    failure: Arc<OnceLock<String>>,
    /// Most memory seen held, bytes.
    peak_bytes: AtomicU64,
    /// By shader, entry point and constants: each is built once.
    compute_pipelines: Pipelines<wgpu::ComputePipeline>,
    render_pipelines: Pipelines<wgpu::RenderPipeline>,
}

type Pipelines<T> = Mutex<HashMap<String, Arc<Pipeline<T>>>>;

/// What work runs on, for records and headers.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Adapter {
    /// As the driver says.
    pub name: String,
    /// `vulkan`, `metal`, `dx12`, or `cpu` for what needs no GPU.
    pub backend: String,
    /// Whether a processor does the work.
    pub software: bool,
}

impl std::fmt::Display for Adapter {
    /// Its name; what a processor plays says so.
    fn fmt(&self, formatter: &mut std::fmt::Formatter) -> std::fmt::Result {
        let played = self.software && self.backend != "cpu";
        write!(formatter, "{}{}", self.name, if played { ", a software GPU" } else { "" })
    }
}

impl Adapter {
    /// What techniques without a GPU run on.
    pub fn cpu() -> Self {
        Self { name: "CPU".into(), backend: "cpu".into(), software: true }
    }
}

/// Features that no technique can do without: the G-buffer's triangle numbers.
const FEATURES: wgpu::Features = wgpu::Features::PRIMITIVE_INDEX;

/// Features that are used where they are there: times of passes, sums of FP32 by blending.
const OPTIONAL_FEATURES: wgpu::Features = wgpu::Features::TIMESTAMP_QUERY.union(wgpu::Features::FLOAT32_BLENDABLE);

/// Chooses the adapter whose name contains it, in any case of letters: wgpu's own convention.
const ADAPTER_VARIABLE: &str = "WGPU_ADAPTER_NAME";

impl Gpu {
    /// The best adapter there is, which may be a software one, or the one that `WGPU_ADAPTER_NAME` names.
    ///
    /// # Errors
    /// [`Error::Gpu`]: no Vulkan loader, a loader without a driver, no adapter of that name, an adapter without a feature that is
    /// needed.
    pub fn open() -> Result<Self> {
        Self::open_limited(|limits| limits)
    }

    /// [`Gpu::open`], as if the adapter had the lower limits that `lower` makes of its own.
    ///
    /// # Errors
    /// As [`Gpu::open`].
    pub fn open_limited(lower: impl FnOnce(wgpu::Limits) -> wgpu::Limits) -> Result<Self> {
        let backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
        let descriptor =
            wgpu::InstanceDescriptor { backends, ..wgpu::InstanceDescriptor::new_without_display_handle() };
        let instance = wgpu::Instance::new(descriptor);
        let wanted = std::env::var_os(ADAPTER_VARIABLE).filter(|name| !name.is_empty());
        let adapter = match wanted {
            Some(wanted) => {
                let mut adapters = pollster::block_on(instance.enumerate_adapters(backends));
                let names: Vec<String> = adapters.iter().map(|adapter| adapter.get_info().name).collect();
                adapters.swap_remove(named(&names, &wanted.to_string_lossy())?)
            }
            None => {
                let options = wgpu::RequestAdapterOptions {
                    power_preference: wgpu::PowerPreference::HighPerformance,
                    ..wgpu::RequestAdapterOptions::default()
                };
                pollster::block_on(instance.request_adapter(&options)).map_err(|_| no_adapter(has_loader()))?
            }
        };
        let info = adapter.get_info();
        check_features(&info.name, adapter.features())?;
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("penumbra"),
            required_features: FEATURES | (OPTIONAL_FEATURES & adapter.features()),
            // All that there is: each use checks what it needs.
            required_limits: lower(adapter.limits()),
            ..wgpu::DeviceDescriptor::default()
        };
        let (device, queue) = pollster::block_on(adapter.request_device(&descriptor))
            .map_err(|error| Error::Gpu(one_line(&format!("{}: {error}", info.name))))?;
        let failure = Arc::new(OnceLock::new());
        let lost = Arc::clone(&failure);
        device.set_device_lost_callback(move |_, reason| {
            // The first failure is the one to tell.
            let _ = lost.set(format!("the device was lost ({reason})"));
        });
        let failed = Arc::clone(&failure);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| match error {
            wgpu::Error::OutOfMemory { .. } => {
                let _ = failed.set("out of memory".into());
            }
            wgpu::Error::Internal { description, .. } => {
                let _ = failed.set(format!("the driver failed ({description})"));
            }
            // What was made after a failure is not valid, which is no mistake of ours.
            wgpu::Error::Validation { .. } if failed.get().is_some() => {}
            error @ wgpu::Error::Validation { .. } => {
                panic!("this is a bug in Penumbra, please report it with the command line and the scene: {error}")
            }
        }));
        let timestamp_period_ns = device
            .features()
            .contains(wgpu::Features::TIMESTAMP_QUERY)
            .then(|| f64::from(queue.get_timestamp_period()));
        let adapter = Adapter {
            name: info.name,
            backend: info.backend.to_str().to_owned(),
            software: info.device_type == wgpu::DeviceType::Cpu,
        };
        Ok(Self {
            device,
            queue,
            adapter,
            timestamp_period_ns,
            failure,
            peak_bytes: AtomicU64::new(0),
            compute_pipelines: Mutex::default(),
            render_pipelines: Mutex::default(),
        })
    }

    /// The most memory that was held when a frame was finished, bytes; 0 where the driver's allocator does not tell.
    pub fn peak_bytes(&self) -> u64 {
        self.peak_bytes.load(Ordering::Relaxed)
    }

    /// Looks how much memory is held.
    pub(super) fn note_memory(&self) {
        if let Some(report) = self.device.generate_allocator_report() {
            self.peak_bytes.fetch_max(report.total_allocated_bytes, Ordering::Relaxed);
        }
    }

    /// A compute pipeline, built when it is first asked for.
    pub fn compute_pipeline(
        &self,
        path: &str,
        entry_point: &str,
        constants: Constants,
    ) -> Arc<Pipeline<wgpu::ComputePipeline>> {
        let mut built = self.compute_pipelines.lock().unwrap_or_else(PoisonError::into_inner);
        let key = format!("{path} {entry_point} {constants:?}");
        let build = || Arc::new(Pipeline::compute(self, &Source::load(path), entry_point, constants));
        Arc::clone(built.entry(key).or_insert_with(build))
    }

    /// A render pipeline, built when it is first asked for.
    pub fn render_pipeline(
        &self,
        path: &str,
        targets: &Targets,
        constants: Constants,
    ) -> Arc<Pipeline<wgpu::RenderPipeline>> {
        let mut built = self.render_pipelines.lock().unwrap_or_else(PoisonError::into_inner);
        let key = format!("{path} {targets:?} {constants:?}");
        Arc::clone(built.entry(key).or_insert_with(|| Arc::new(Pipeline::render(self, path, targets, constants))))
    }

    /// A buffer with these contents; at least one element long, for bindings can't be empty.
    ///
    /// # Errors
    /// As [`Gpu::empty_buffer`].
    pub fn buffer<T: bytemuck::Pod>(
        &self,
        label: &str,
        contents: &[T],
        usage: wgpu::BufferUsages,
    ) -> Result<wgpu::Buffer> {
        let bytes: &[u8] = bytemuck::cast_slice(contents);
        let buffer = self.empty_buffer(label, bytes.len().max(size_of::<T>()) as u64, usage)?;
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        // Copies are of whole words.
        let (words, rest) = bytes.split_at(bytes.len() / 4 * 4);
        self.queue.write_buffer(&buffer, 0, words);
        if !rest.is_empty() {
            let mut last = [0; 4];
            last[..rest.len()].copy_from_slice(rest);
            self.queue.write_buffer(&buffer, words.len() as u64, &last);
        }
        self.check_memory(scope, label, buffer.size())?;
        Ok(buffer)
    }

    /// A buffer of zeros.
    ///
    /// # Errors
    /// [`Error::Gpu`] where the adapter's limits or memory don't allow it.
    pub fn empty_buffer(&self, label: &str, bytes: u64, usage: wgpu::BufferUsages) -> Result<wgpu::Buffer> {
        let size = bytes.max(4).next_multiple_of(4);
        let limits = self.device.limits();
        for (what, applies, limit) in [
            ("a buffer (max_buffer_size)", true, limits.max_buffer_size),
            (
                "what a shader reads (max_storage_buffer_binding_size)",
                usage.contains(wgpu::BufferUsages::STORAGE),
                limits.max_storage_buffer_binding_size,
            ),
            (
                "a shader's constants (max_uniform_buffer_binding_size)",
                usage.contains(wgpu::BufferUsages::UNIFORM),
                limits.max_uniform_buffer_binding_size,
            ),
        ] {
            if applies && size > limit {
                let name = &self.adapter.name;
                let message = format!("{name}: {label} would take {size} bytes; this adapter allows {what} {limit}");
                return Err(Error::Gpu(message));
            }
        }
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let buffer = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some(label),
            size,
            usage: usage | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC,
            mapped_at_creation: false,
        });
        self.check_memory(scope, label, size)?;
        Ok(buffer)
    }

    /// What came of an allocation.
    fn check_memory(&self, scope: wgpu::ErrorScopeGuard, label: &str, bytes: u64) -> Result<()> {
        match pollster::block_on(scope.pop()) {
            None => Ok(()),
            Some(_) => {
                let (name, megabytes) = (&self.adapter.name, bytes / 1_000_000);
                Err(Error::Gpu(format!("{name}: no memory for {label} of {megabytes} MB")))
            }
        }
    }

    /// A 2D texture or array of `size` (width, height, layers).
    ///
    /// # Errors
    /// [`Error::Gpu`] where the adapter's limits or memory don't allow it.
    pub fn texture(
        &self,
        label: &str,
        size: [u32; 3],
        format: wgpu::TextureFormat,
        usage: wgpu::TextureUsages,
    ) -> Result<wgpu::Texture> {
        self.texture_of_levels(label, size, 1, format, usage)
    }

    /// [`Gpu::texture`] with so many levels, each half as large as the one before.
    ///
    /// # Errors
    /// As [`Gpu::texture`].
    pub fn texture_of_levels(
        &self,
        label: &str,
        [width, height, layers]: [u32; 3],
        levels: u32,
        format: wgpu::TextureFormat,
        usage: wgpu::TextureUsages,
    ) -> Result<wgpu::Texture> {
        let limits = self.device.limits();
        for (what, asked, limit, limit_name) in [
            ("pixels wide", width, limits.max_texture_dimension_2d, "max_texture_dimension_2d"),
            ("pixels high", height, limits.max_texture_dimension_2d, "max_texture_dimension_2d"),
            ("layers deep", layers, limits.max_texture_array_layers, "max_texture_array_layers"),
        ] {
            if asked > limit {
                let name = &self.adapter.name;
                let message = format!("{name}: {label} is {asked} {what}; this adapter allows {limit} ({limit_name})");
                return Err(Error::Gpu(message));
            }
        }
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let texture = self.device.create_texture(&wgpu::TextureDescriptor {
            label: Some(label),
            size: wgpu::Extent3d { width, height, depth_or_array_layers: layers },
            mip_level_count: levels,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format,
            usage,
            view_formats: &[],
        });
        let bytes = u64::from(width)
            * u64::from(height)
            * u64::from(layers)
            * u64::from(format.block_copy_size(None).unwrap_or(4));
        self.check_memory(scope, label, bytes)?;
        Ok(texture)
    }

    /// The contents of a buffer, once all work submitted before is done.
    ///
    /// # Errors
    /// [`Error::Gpu`] where there is no memory for a copy, or where the driver has failed.
    pub fn read_buffer<T: bytemuck::Pod>(&self, buffer: &wgpu::Buffer) -> Result<Vec<T>> {
        let scope = self.device.push_error_scope(wgpu::ErrorFilter::OutOfMemory);
        let staging = self.device.create_buffer(&wgpu::BufferDescriptor {
            label: Some("read back"),
            size: buffer.size(),
            usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
            mapped_at_creation: false,
        });
        self.check_memory(scope, "reading back", buffer.size())?;
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.copy_buffer_to_buffer(buffer, 0, &staging, 0, buffer.size());
        self.queue.submit([encoder.finish()]);
        let (sender, mapped) = mpsc::channel();
        staging.slice(..).map_async(wgpu::MapMode::Read, move |result| {
            // Nobody listens where waiting has failed.
            let _ = sender.send(result);
        });
        self.wait()?;
        let failed = |error: &dyn std::fmt::Display| Error::Gpu(format!("{}: {error}", self.adapter.name));
        mapped.recv().map_err(|error| failed(&error))?.map_err(|error| failed(&error))?;
        let view = staging.slice(..).get_mapped_range().map_err(|error| failed(&error))?;
        // Copied to where T's alignment holds.
        Ok(bytemuck::pod_collect_to_vec(&view[..view.len() / size_of::<T>() * size_of::<T>()]))
    }

    /// A counter of `lib/counter.wgsl`, at zero.
    ///
    /// # Errors
    /// As [`Gpu::empty_buffer`].
    pub fn counter(&self) -> Result<wgpu::Buffer> {
        self.empty_buffer("counter", 8, wgpu::BufferUsages::STORAGE)
    }

    /// What a counter has come to.
    ///
    /// # Errors
    /// As [`Gpu::read_buffer`].
    pub fn count(&self, counter: &wgpu::Buffer) -> Result<u64> {
        let words: Vec<u32> = self.read_buffer(counter)?;
        Ok(u64::from(words[0]) | u64::from(words[1]) << 32)
    }

    /// Records the copy of a texture's first layer into a buffer; bytes a row, padded as copies need it.
    ///
    /// # Errors
    /// As [`Gpu::empty_buffer`].
    pub fn copy_of(&self, texture: &wgpu::Texture, encoder: &mut wgpu::CommandEncoder) -> Result<(u32, wgpu::Buffer)> {
        let texel_bytes = texture.format().block_copy_size(None).expect("a format of one aspect");
        let row = (texture.width() * texel_bytes).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
        let bytes = u64::from(row) * u64::from(texture.height());
        let buffer = self.empty_buffer("a copy of an image", bytes, wgpu::BufferUsages::empty())?;
        let layout = wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row), rows_per_image: None };
        let size = wgpu::Extent3d { depth_or_array_layers: 1, ..texture.size() };
        encoder.copy_texture_to_buffer(
            texture.as_image_copy(),
            wgpu::TexelCopyBufferInfo { buffer: &buffer, layout },
            size,
        );
        Ok((row, buffer))
    }

    /// Waits for all work submitted.
    ///
    /// # Errors
    /// [`Error::Gpu`] where the driver has failed: a lost device, no memory.
    pub fn wait(&self) -> Result<()> {
        let waited = self.device.poll(wgpu::PollType::wait_indefinitely());
        let name = &self.adapter.name;
        match (self.failure.get(), waited) {
            (Some(failure), _) => Err(Error::Gpu(one_line(&format!("{name}: {failure}")))),
            (None, Err(error)) => Err(Error::Gpu(one_line(&format!("{name}: {error}")))),
            (None, Ok(_)) => Ok(()),
        }
    }
}

fn one_line(text: &str) -> String {
    text.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// The index of the adapter whose name contains `wanted`.
fn named(names: &[String], wanted: &str) -> Result<usize> {
    let wanted_lower = wanted.to_lowercase();
    names.iter().position(|name| name.to_lowercase().contains(&wanted_lower)).ok_or_else(|| {
        if names.is_empty() {
            return no_adapter(has_loader());
        }
        Error::Gpu(format!("no adapter is named {ADAPTER_VARIABLE}={wanted}; there is {}", names.join(", ")))
    })
}

fn check_features(adapter: &str, features: wgpu::Features) -> Result<()> {
    let lacking: Vec<&str> = (FEATURES - features).iter_names().map(|(name, _)| name).collect();
    if lacking.is_empty() {
        return Ok(());
    }
    let lacking = lacking.join(", ");
    Err(Error::Gpu(format!("{adapter} lacks {lacking}; {ADAPTER_VARIABLE} chooses another adapter, if there is one")))
}

/// Why there is no adapter: whether the Vulkan loader itself is missing, which the driver's own message does not tell.
fn no_adapter(has_loader: Option<bool>) -> Error {
    let both = "libvulkan1 and mesa-vulkan-drivers (Debian, Ubuntu) or vulkan-icd-loader and vulkan-swrast (Arch)";
    Error::Gpu(match has_loader {
        Some(false) => format!("no Vulkan loader; for a software GPU install {both}"),
        Some(true) => {
            "a Vulkan loader but no driver; for a software GPU install mesa-vulkan-drivers (Debian, Ubuntu) or \
                       vulkan-swrast (Arch)"
                .into()
        }
        None => format!("no Vulkan driver; for a software GPU install {both}"),
    })
}

/// Whether a Vulkan loader lies where the dynamic linker looks; none where that can't be told.
#[cfg(target_os = "linux")]
fn has_loader() -> Option<bool> {
    // Its folder is not on the path of everybody.
    let listing = ["ldconfig", "/sbin/ldconfig", "/usr/sbin/ldconfig"].iter().find_map(|program| {
        let output = std::process::Command::new(program).arg("-p").output().ok()?;
        output.status.success().then_some(output.stdout)
    })?;
    Some(String::from_utf8_lossy(&listing).contains("libvulkan.so.1"))
}

/// Whether a Vulkan loader is there; elsewhere drivers come with the system.
#[cfg(not(target_os = "linux"))]
fn has_loader() -> Option<bool> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_adapter_is_named_by_a_part_of_its_name() {
        let names = ["NVIDIA H100".to_owned(), "llvmpipe (LLVM 15)".to_owned()];
        assert_eq!(named(&names, "LLVMpipe").expect("it is there"), 1);
        assert_eq!(named(&names, "v").expect("it is there"), 0);
        let message = named(&names, "Radeon").expect_err("there is none").to_string();
        assert_eq!(
            message,
            "GPU: no adapter is named WGPU_ADAPTER_NAME=Radeon; there is NVIDIA H100, llvmpipe (LLVM 15)"
        );
    }

    #[test]
    fn a_lacking_feature_is_named() {
        check_features("it", FEATURES | OPTIONAL_FEATURES).expect("all is there");
        check_features("it", FEATURES).expect("the others are optional");
        let message = check_features("Old GPU", OPTIONAL_FEATURES).expect_err("lacks one").to_string();
        assert!(message.starts_with("GPU: Old GPU lacks PRIMITIVE_INDEX; WGPU_ADAPTER_NAME chooses"), "{message}");
    }

    #[test]
    fn a_missing_loader_and_a_missing_driver_are_told_apart() {
        let message = |has_loader| no_adapter(has_loader).to_string();
        assert!(message(Some(false)).starts_with("GPU: no Vulkan loader; for a software GPU install libvulkan1 and"));
        assert!(message(Some(true)).starts_with("GPU: a Vulkan loader but no driver; "));
        assert!(message(None).starts_with("GPU: no Vulkan driver; "));
        for has_loader in [Some(false), Some(true), None] {
            assert!(message(has_loader).contains("mesa-vulkan-drivers (Debian, Ubuntu)"));
            assert!(!message(has_loader).contains('\n'));
        }
    }
}
