//! A frame: passes in a straight line, each bound by name and timed.

use std::time::Instant;

use super::Gpu;
use super::shader::Pipeline;
use crate::Result;
use crate::progress::ms_since;
use crate::techniques::{Pass, add_passes};

/// Timestamps that one query set holds; wgpu allows 8192 bytes of 8 each at most, but 4096 queries.
const MAX_QUERIES: u32 = 4096;

/// Work that is being recorded.
pub struct Frame<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    timer: Timer,
}

/// What passes are timed by.
enum Timer {
    /// Nothing.
    None,
    /// The adapter's timestamps: pass i, of this name, has the queries 2i and 2i + 1.
    Timestamps { queries: wgpu::QuerySet, period_ns: f64, timed: Vec<&'static str> },
    /// The processor's clock, where it is the processor that works: passes in a row of one name are run, and waited for, together.
    /// lavapipe takes a compute pass's timestamps before its work is done where no render pass follows.
    Clock { recorded: Option<&'static str>, passes: Vec<Pass> },
}

/// A compute pass that is being described.
#[must_use = "nothing is recorded before it is dispatched"]
pub struct Compute<'f, 'a, 'r> {
    frame: &'f mut Frame<'a>,
    name: &'static str,
    pipeline: &'r Pipeline<wgpu::ComputePipeline>,
    resources: Vec<(&'r str, wgpu::BindingResource<'r>)>,
}

impl<'a> Frame<'a> {
    /// Nothing yet.
    pub fn new(gpu: &'a Gpu) -> Self {
        let timer = match gpu.timestamp_period_ns {
            _ if gpu.adapter.software => Timer::Clock { recorded: None, passes: Vec::new() },
            None => Timer::None,
            Some(period_ns) => {
                let queries = gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                    label: Some("pass times"),
                    ty: wgpu::QueryType::Timestamp,
                    count: MAX_QUERIES,
                });
                Timer::Timestamps { queries, period_ns, timed: Vec::new() }
            }
        };
        Self { gpu, encoder: encoder(gpu), timer }
    }

    /// A compute pass; passes of one name are reported together.
    pub fn compute<'r>(
        &mut self,
        name: &'static str,
        pipeline: &'r Pipeline<wgpu::ComputePipeline>,
    ) -> Compute<'_, 'a, 'r> {
        Compute { frame: self, name, pipeline, resources: Vec::new() }
    }

    /// A render pass onto these attachments, recorded by `draw`; passes of one name are reported together.
    pub fn render(
        &mut self,
        name: &'static str,
        colors: &[Option<wgpu::RenderPassColorAttachment>],
        depth: Option<wgpu::RenderPassDepthStencilAttachment>,
        draw: impl FnOnce(&mut wgpu::RenderPass),
    ) {
        let (encoder, timestamps) = self.begin(name);
        let timestamp_writes = timestamps.map(|(query_set, first)| wgpu::RenderPassTimestampWrites {
            query_set,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        });
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            label: Some(name),
            color_attachments: colors,
            depth_stencil_attachment: depth,
            timestamp_writes,
            occlusion_query_set: None,
            multiview_mask: None,
        });
        draw(&mut pass);
    }

    /// The encoder, for copies.
    pub fn encoder(&mut self) -> &mut wgpu::CommandEncoder {
        &mut self.encoder
    }

    /// Before a pass is recorded: by what, and its timestamps.
    fn begin(&mut self, name: &'static str) -> (&mut wgpu::CommandEncoder, Option<(&wgpu::QuerySet, u32)>) {
        if matches!(self.timer, Timer::Clock { recorded: Some(recorded), .. } if recorded != name) {
            self.run();
        }
        let timestamps = match &mut self.timer {
            Timer::None => None,
            Timer::Clock { recorded, .. } => {
                *recorded = Some(name);
                None
            }
            Timer::Timestamps { queries, timed, .. } => {
                let first = 2 * timed.len() as u32;
                let is_timed = first + 2 <= MAX_QUERIES;
                if is_timed {
                    timed.push(name);
                }
                is_timed.then_some((&*queries, first))
            }
        };
        (&mut self.encoder, timestamps)
    }

    /// Runs what has been recorded since the last time, by the clock.
    fn run(&mut self) {
        let Timer::Clock { recorded, passes } = &mut self.timer else { return };
        let start = Instant::now();
        self.gpu.queue.submit([std::mem::replace(&mut self.encoder, encoder(self.gpu)).finish()]);
        // What fails stays known: the last wait tells.
        let _ = self.gpu.wait();
        add_passes(passes, recorded.take().map(|name| Pass { name, ms: ms_since(start) }).into_iter().collect());
    }

    /// Runs what was recorded, waits for it, and tells the time of each pass, in the order in which their names came up first;
    /// nothing where the adapter has no timestamps and is no processor.
    ///
    /// # Errors
    /// As [`Gpu::wait`].
    pub fn finish(mut self) -> Result<Vec<Pass>> {
        self.run();
        let mut resolved = None;
        if let Timer::Timestamps { queries, timed, .. } = &self.timer
            && !timed.is_empty()
        {
            let count = 2 * timed.len() as u32;
            let usage = wgpu::BufferUsages::QUERY_RESOLVE;
            let buffer = self.gpu.empty_buffer("pass times", 8 * u64::from(count), usage)?;
            self.encoder.resolve_query_set(queries, 0..count, &buffer, 0);
            resolved = Some(buffer);
        }
        self.gpu.queue.submit([self.encoder.finish()]);
        self.gpu.wait()?;
        self.gpu.note_memory();
        let mut passes = Vec::new();
        match self.timer {
            Timer::None => {}
            Timer::Clock { passes: clocked, .. } => passes = clocked,
            Timer::Timestamps { period_ns, timed, .. } => {
                let ticks: Vec<u64> = resolved.map_or(Ok(Vec::new()), |buffer| self.gpu.read_buffer(&buffer))?;
                let ms = |pair: &[u64]| pair[1].saturating_sub(pair[0]) as f64 * period_ns * 1e-6;
                let pass = |(&name, pair): (&&'static str, &[u64])| Pass { name, ms: ms(pair) };
                add_passes(&mut passes, timed.iter().zip(ticks.chunks_exact(2)).map(pass).collect());
            }
        }
        Ok(passes)
    }
}

/// Nothing recorded.
fn encoder(gpu: &Gpu) -> wgpu::CommandEncoder {
    gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("frame") })
}

impl<'r> Compute<'_, '_, 'r> {
    /// Binds a resource under its name in the shader.
    pub fn bind(mut self, name: &'r str, resource: impl Into<Resource<'r>>) -> Self {
        self.resources.push((name, resource.into().0));
        self
    }

    /// Records it, with so many workgroups.
    pub fn dispatch(self, [x, y, z]: [u32; 3]) {
        let Self { frame, name, pipeline, resources } = self;
        let group = pipeline.bind_group(frame.gpu, &resources);
        let (encoder, timestamps) = frame.begin(name);
        let timestamp_writes = timestamps.map(|(query_set, first)| wgpu::ComputePassTimestampWrites {
            query_set,
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        });
        let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(name), timestamp_writes });
        pass.set_pipeline(&pipeline.raw);
        if let Some(group) = &group {
            pass.set_bind_group(0, group, &[]);
        }
        pass.dispatch_workgroups(x, y, z);
    }
}

/// Anything that can be bound.
pub struct Resource<'r>(pub wgpu::BindingResource<'r>);

impl<'r> From<&'r wgpu::Buffer> for Resource<'r> {
    fn from(buffer: &'r wgpu::Buffer) -> Self {
        Self(buffer.as_entire_binding())
    }
}

impl<'r> From<&'r wgpu::TextureView> for Resource<'r> {
    fn from(view: &'r wgpu::TextureView) -> Self {
        Self(wgpu::BindingResource::TextureView(view))
    }
}

impl<'r> From<&'r wgpu::Sampler> for Resource<'r> {
    fn from(sampler: &'r wgpu::Sampler) -> Self {
        Self(wgpu::BindingResource::Sampler(sampler))
    }
}
