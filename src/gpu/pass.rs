//! A frame: passes in a straight line, each bound by name and timed.

use std::collections::BTreeMap;

use super::Gpu;
use super::shader::Pipeline;
use crate::Result;
use crate::techniques::Pass;

/// Timestamps that one query set holds; wgpu allows 8192 bytes of 8 each at most, but 4096 queries.
const MAX_QUERIES: u32 = 4096;

/// Work that is being recorded.
pub struct Frame<'a> {
    gpu: &'a Gpu,
    encoder: wgpu::CommandEncoder,
    queries: Option<wgpu::QuerySet>,
    /// The names of the passes timed so far: pass i has the queries 2i and 2i + 1.
    timed: Vec<&'static str>,
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
        let encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label: Some("frame") });
        let queries = gpu.timestamp_period_ns.map(|_| {
            gpu.device.create_query_set(&wgpu::QuerySetDescriptor {
                label: Some("pass times"),
                ty: wgpu::QueryType::Timestamp,
                count: MAX_QUERIES,
            })
        });
        Self { gpu, encoder, queries, timed: Vec::new() }
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
        let timestamps = self.next_timestamps(name);
        let timestamp_writes = timestamps.map(|first| wgpu::RenderPassTimestampWrites {
            query_set: self.queries.as_ref().expect("there are timestamps"),
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        });
        let mut pass = self.encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
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

    fn next_timestamps(&mut self, name: &'static str) -> Option<u32> {
        let first = 2 * self.timed.len() as u32;
        if self.queries.is_none() || first + 2 > MAX_QUERIES {
            return None;
        }
        self.timed.push(name);
        Some(first)
    }

    /// Runs what was recorded, waits for it, and tells the time of each pass, in the order in which their names came up first;
    /// nothing where the adapter has no timestamps.
    ///
    /// # Errors
    /// As [`Gpu::wait`].
    pub fn finish(mut self) -> Result<Vec<Pass>> {
        let mut resolved = None;
        if let Some(queries) = self.queries.as_ref().filter(|_| !self.timed.is_empty()) {
            let count = 2 * self.timed.len() as u32;
            let usage = wgpu::BufferUsages::QUERY_RESOLVE;
            let buffer = self.gpu.empty_buffer("pass times", 8 * u64::from(count), usage)?;
            self.encoder.resolve_query_set(queries, 0..count, &buffer, 0);
            resolved = Some(buffer);
        }
        self.gpu.queue.submit([self.encoder.finish()]);
        self.gpu.wait()?;
        self.gpu.note_memory();
        let Some(buffer) = resolved else { return Ok(Vec::new()) };
        let ticks: Vec<u64> = self.gpu.read_buffer(&buffer)?;
        let period_ns = self.gpu.timestamp_period_ns.expect("there are timestamps");
        let mut order: Vec<&'static str> = Vec::new();
        let mut sums: BTreeMap<&'static str, f64> = BTreeMap::new();
        for (&name, pair) in self.timed.iter().zip(ticks.chunks_exact(2)) {
            if !sums.contains_key(name) {
                order.push(name);
            }
            *sums.entry(name).or_default() += pair[1].saturating_sub(pair[0]) as f64 * period_ns * 1e-6;
        }
        Ok(order.into_iter().map(|name| Pass { name, ms: sums[name] }).collect())
    }
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
        let timestamps = frame.next_timestamps(name);
        let timestamp_writes = timestamps.map(|first| wgpu::ComputePassTimestampWrites {
            query_set: frame.queries.as_ref().expect("there are timestamps"),
            beginning_of_pass_write_index: Some(first),
            end_of_pass_write_index: Some(first + 1),
        });
        let mut pass =
            frame.encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label: Some(name), timestamp_writes });
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
