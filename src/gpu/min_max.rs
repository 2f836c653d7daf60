//! Min–max pyramids over shadow maps, built by compute: `lib/min_max.wgsl` reads them.

use std::sync::Arc;

use super::Gpu;
use super::pass::Frame;
use super::shader::Pipeline;
use super::shadow_map::CONSTANTS;
use crate::Result;

/// What a pyramid's nodes bound.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bounded {
    /// Whether a node may bound depths between two tilted planes, where they are closer than two depths.
    pub slopes: bool,
    /// Whether a node also bounds the texels next to its own, to the right and above.
    pub neighbours: bool,
}

/// Slope (2), low, high.
const NODE: wgpu::TextureFormat = wgpu::TextureFormat::Rgba32Float;

/// Nodes a side of a workgroup.
const WORKGROUP: u32 = 8;

/// A pyramid over an array of maps.
#[derive(Debug)]
pub struct MinMax {
    texture: wgpu::Texture,
    from_map: Arc<Pipeline<wgpu::ComputePipeline>>,
    /// By level, from the second on.
    from_nodes: Vec<Arc<Pipeline<wgpu::ComputePipeline>>>,
    /// `texture_2d_array<f32>`, all levels.
    pub nodes: wgpu::TextureView,
}

impl MinMax {
    /// Over so many maps of `size` texels a side.
    ///
    /// # Errors
    /// [`crate::Error::Gpu`] where it doesn't fit.
    pub fn new(gpu: &Gpu, size: u32, maps: u32, bounded: Bounded) -> Result<Self> {
        // Levels halve a power of two, whatever the map's size: nodes of no texels are never read.
        let side = (size.next_power_of_two() / 2).max(1);
        let levels = side.ilog2() + 1;
        let usage = wgpu::TextureUsages::STORAGE_BINDING | wgpu::TextureUsages::TEXTURE_BINDING;
        let texture = gpu.texture_of_levels("min-max pyramid", [side, side, maps], levels, NODE, usage)?;
        let (slopes, reach) = (f64::from(u8::from(bounded.slopes)), f64::from(u8::from(bounded.neighbours)));
        let pipeline = |entry_point, finer_side: u32| {
            let own = [("slopes", slopes), ("reach", reach), ("side", f64::from(finer_side))];
            let constants = [CONSTANTS, &own].concat();
            gpu.compute_pipeline("passes/min_max.wgsl", entry_point, &constants)
        };
        let nodes = texture.create_view(&view_of(0..levels));
        Ok(Self {
            texture,
            from_map: pipeline("from_map", 1),
            from_nodes: (1..levels).map(|level| pipeline("from_nodes", 1 << level)).collect(),
            nodes,
        })
    }

    /// Records its making from the maps.
    pub fn build(&self, frame: &mut Frame, maps: &wgpu::TextureView) {
        let level = |level: u32| self.texture.create_view(&view_of(level..level + 1));
        let (side, layers) = (self.texture.width(), self.texture.depth_or_array_layers());
        let groups = |level: u32| {
            let across = (side >> level).div_ceil(WORKGROUP);
            [across, across, layers]
        };
        frame
            .compute("min-max pyramid", &self.from_map)
            .bind("shadow_depth", maps)
            .bind("coarser", &level(0))
            .dispatch(groups(0));
        for (coarser, pipeline) in (1..).zip(&self.from_nodes) {
            frame
                .compute("min-max pyramid", pipeline)
                .bind("finer", &level(coarser - 1))
                .bind("coarser", &level(coarser))
                .dispatch(groups(coarser));
        }
    }
}

/// The view of some levels of all maps.
fn view_of(levels: std::ops::Range<u32>) -> wgpu::TextureViewDescriptor<'static> {
    wgpu::TextureViewDescriptor {
        dimension: Some(wgpu::TextureViewDimension::D2Array),
        base_mip_level: levels.start,
        mip_level_count: Some(levels.end - levels.start),
        ..wgpu::TextureViewDescriptor::default()
    }
}
