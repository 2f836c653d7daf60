//! WGSL sources: `#import`, reflection, pipelines whose resources are bound by name.

use std::collections::BTreeMap;

use wgpu::naga;

use super::Gpu;

/// Every file of `shaders/`, by its path there. A test holds the list against the folder.
pub const SOURCES: &[(&str, &str)] = &[
    ("lib/arctangent.wgsl", include_str!("../../shaders/lib/arctangent.wgsl")),
    ("lib/back_projection.wgsl", include_str!("../../shaders/lib/back_projection.wgsl")),
    ("lib/counter.wgsl", include_str!("../../shaders/lib/counter.wgsl")),
    ("lib/cutout.wgsl", include_str!("../../shaders/lib/cutout.wgsl")),
    ("lib/emission.wgsl", include_str!("../../shaders/lib/emission.wgsl")),
    ("lib/emitter.wgsl", include_str!("../../shaders/lib/emitter.wgsl")),
    ("lib/face.wgsl", include_str!("../../shaders/lib/face.wgsl")),
    ("lib/instance.wgsl", include_str!("../../shaders/lib/instance.wgsl")),
    ("lib/kernel.wgsl", include_str!("../../shaders/lib/kernel.wgsl")),
    ("lib/look_up.wgsl", include_str!("../../shaders/lib/look_up.wgsl")),
    ("lib/min_max.wgsl", include_str!("../../shaders/lib/min_max.wgsl")),
    ("lib/pcss.wgsl", include_str!("../../shaders/lib/pcss.wgsl")),
    ("lib/receiver.wgsl", include_str!("../../shaders/lib/receiver.wgsl")),
    ("lib/sampling.wgsl", include_str!("../../shaders/lib/sampling.wgsl")),
    ("lib/screen.wgsl", include_str!("../../shaders/lib/screen.wgsl")),
    ("lib/shadow_map.wgsl", include_str!("../../shaders/lib/shadow_map.wgsl")),
    ("lib/smooth.wgsl", include_str!("../../shaders/lib/smooth.wgsl")),
    ("passes/gbuffer.wgsl", include_str!("../../shaders/passes/gbuffer.wgsl")),
    ("passes/min_max.wgsl", include_str!("../../shaders/passes/min_max.wgsl")),
    ("passes/shadow_map.wgsl", include_str!("../../shaders/passes/shadow_map.wgsl")),
    ("techniques/adaptive.wgsl", include_str!("../../shaders/techniques/adaptive.wgsl")),
    ("techniques/bilateral.wgsl", include_str!("../../shaders/techniques/bilateral.wgsl")),
    ("techniques/bitmask.wgsl", include_str!("../../shaders/techniques/bitmask.wgsl")),
    ("techniques/cascaded.wgsl", include_str!("../../shaders/techniques/cascaded.wgsl")),
    ("techniques/hard.wgsl", include_str!("../../shaders/techniques/hard.wgsl")),
    ("techniques/min_max_backprojection.wgsl", include_str!("../../shaders/techniques/min_max_backprojection.wgsl")),
    ("techniques/min_max_pcf.wgsl", include_str!("../../shaders/techniques/min_max_pcf.wgsl")),
    ("techniques/pcf.wgsl", include_str!("../../shaders/techniques/pcf.wgsl")),
    ("techniques/pcss.wgsl", include_str!("../../shaders/techniques/pcss.wgsl")),
    ("techniques/shadow_volumes.wgsl", include_str!("../../shaders/techniques/shadow_volumes.wgsl")),
    ("techniques/soft_shadow_map.wgsl", include_str!("../../shaders/techniques/soft_shadow_map.wgsl")),
    ("techniques/temporal.wgsl", include_str!("../../shaders/techniques/temporal.wgsl")),
    ("techniques/uniform.wgsl", include_str!("../../shaders/techniques/uniform.wgsl")),
];

/// A WGSL file with all that it imports, checked.
#[derive(Debug)]
pub struct Source {
    /// Its path below `shaders/`.
    pub path: &'static str,
    /// Imports replaced by what they import, each file once.
    pub text: String,
    /// As naga reads it.
    pub module: naga::Module,
    info: naga::valid::ModuleInfo,
}

/// Where a resource is bound.
type Bindings = BTreeMap<String, u32>;

impl Source {
    /// The source at a path.
    ///
    /// # Panics
    /// On an unknown path or import, and on WGSL that is not valid: our bugs, which tests find without an adapter.
    pub fn load(path: &str) -> Self {
        let (path, text) = find(path);
        Self::new(path, text)
    }

    /// A source of its own text, which may import what is below `shaders/`; `path` is its name in messages.
    ///
    /// # Panics
    /// As [`Source::load`].
    pub fn new(path: &'static str, own_text: &str) -> Self {
        let mut text = String::new();
        expand(own_text, &mut vec![path], &mut text);
        let module = naga::front::wgsl::parse_str(&text)
            .unwrap_or_else(|error| panic!("{}", error.emit_to_string_with_path(&text, path)));
        let capabilities = naga::valid::Capabilities::all();
        let info = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), capabilities)
            .validate(&module)
            .unwrap_or_else(|error| panic!("{}", error.emit_to_string_with_path(&text, path)));
        Self { path, text, module, info }
    }

    /// The resources that one of the entry points uses, by name: all in group 0.
    pub fn bindings(&self, entry_points: &[&str]) -> Bindings {
        let mut bindings = Bindings::new();
        for (index, entry) in self.module.entry_points.iter().enumerate() {
            if !entry_points.contains(&entry.name.as_str()) {
                continue;
            }
            let used = self.info.get_entry_point(index);
            for (handle, variable) in self.module.global_variables.iter() {
                if let (Some(binding), false) = (&variable.binding, used[handle].is_empty()) {
                    assert!(binding.group == 0, "{}: bindings belong to group 0", self.path);
                    bindings.insert(variable.name.clone().expect("globals have names"), binding.binding);
                }
            }
        }
        bindings
    }

    fn compile(&self, gpu: &Gpu) -> wgpu::ShaderModule {
        gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
            label: Some(self.path),
            source: wgpu::ShaderSource::Wgsl(self.text.as_str().into()),
        })
    }
}

fn find(path: &str) -> (&'static str, &'static str) {
    let found = SOURCES.iter().find(|(name, _)| *name == path);
    *found.unwrap_or_else(|| panic!("no shader {path:?}"))
}

/// Appends a file's text, and its imports (`#import "path"`, below `shaders/`) where they stand, each once.
fn expand(own_text: &str, seen: &mut Vec<&'static str>, text: &mut String) {
    for line in own_text.lines() {
        match line.strip_prefix("#import ") {
            Some(import) => {
                let (path, imported) = find(import.trim().trim_matches('"'));
                if !seen.contains(&path) {
                    seen.push(path);
                    expand(imported, seen, text);
                }
            }
            None => {
                text.push_str(line);
                text.push('\n');
            }
        }
    }
}

/// A pipeline and where its resources go.
#[derive(Debug)]
pub struct Pipeline<T> {
    /// For messages.
    pub path: &'static str,
    /// wgpu's.
    pub raw: T,
    /// By name.
    pub bindings: Bindings,
    declared: Vec<String>,
    /// Of group 0.
    pub layout: Option<wgpu::BindGroupLayout>,
}

/// Counts and switches of a shader: the values of its `override` constants.
pub type Constants<'a> = &'a [(&'a str, f64)];

impl Pipeline<wgpu::ComputePipeline> {
    /// The compute pipeline of an entry point.
    pub fn compute(gpu: &Gpu, source: &Source, entry_point: &str, constants: Constants) -> Self {
        let raw = gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(source.path),
            layout: None,
            module: &source.compile(gpu),
            entry_point: Some(entry_point),
            compilation_options: options(constants),
            cache: None,
        });
        Self::of(
            source,
            &[entry_point],
            |bindings| (!bindings.is_empty()).then(|| raw.get_bind_group_layout(0)),
            raw.clone(),
        )
    }
}

/// What a render pipeline draws to and how.
#[derive(Debug, Clone)]
pub struct Targets<'a> {
    /// Vertex buffers.
    pub vertices: &'a [Option<wgpu::VertexBufferLayout<'a>>],
    /// Whether fragments are shaded, or only their depth is kept.
    pub fragment: bool,
    /// Colour formats, with blending.
    pub colors: &'a [Option<wgpu::ColorTargetState>],
    /// Depth.
    pub depth: Option<wgpu::DepthStencilState>,
}

impl Pipeline<wgpu::RenderPipeline> {
    /// The render pipeline of a file's `vertex` and `fragment` entry points; faces are drawn from both sides.
    pub fn render(gpu: &Gpu, path: &str, targets: &Targets, constants: Constants) -> Self {
        let source = Source::load(path);
        let module = source.compile(gpu);
        let raw = gpu.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some(source.path),
            layout: None,
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("vertex"),
                compilation_options: options(constants),
                buffers: targets.vertices,
            },
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: targets.depth.clone(),
            multisample: wgpu::MultisampleState::default(),
            fragment: targets.fragment.then(|| wgpu::FragmentState {
                module: &module,
                entry_point: Some("fragment"),
                compilation_options: options(constants),
                targets: targets.colors,
            }),
            multiview_mask: None,
            cache: None,
        });
        let entry_points: &[&str] = if targets.fragment { &["vertex", "fragment"] } else { &["vertex"] };
        Self::of(
            &source,
            entry_points,
            |bindings| (!bindings.is_empty()).then(|| raw.get_bind_group_layout(0)),
            raw.clone(),
        )
    }
}

fn options(constants: Constants<'_>) -> wgpu::PipelineCompilationOptions<'_> {
    wgpu::PipelineCompilationOptions { constants, ..wgpu::PipelineCompilationOptions::default() }
}

impl<T> Pipeline<T> {
    fn of(
        source: &Source,
        entry_points: &[&str],
        layout: impl FnOnce(&Bindings) -> Option<wgpu::BindGroupLayout>,
        raw: T,
    ) -> Self {
        let bindings = source.bindings(entry_points);
        let declared = source.module.global_variables.iter().filter_map(|(_, v)| v.name.clone()).collect();
        Self { path: source.path, layout: layout(&bindings), raw, bindings, declared }
    }

    /// The bind group of named resources. What the shader declares but doesn't use is left out.
    ///
    /// # Panics
    /// On a name that the shader does not declare, and on a resource that it uses and that is not given: our bugs.
    pub fn bind_group(&self, gpu: &Gpu, resources: &[(&str, wgpu::BindingResource)]) -> Option<wgpu::BindGroup> {
        for (name, _) in resources {
            assert!(self.declared.iter().any(|declared| declared == name), "{} has no resource {name:?}", self.path);
        }
        let entries: Vec<wgpu::BindGroupEntry> = self
            .bindings
            .iter()
            .map(|(name, &binding)| {
                let resource = resources.iter().find(|(given, _)| given == name);
                let resource = resource.unwrap_or_else(|| panic!("{}: {name:?} is not bound", self.path)).1.clone();
                wgpu::BindGroupEntry { binding, resource }
            })
            .collect();
        let layout = self.layout.as_ref()?;
        Some(gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(self.path),
            layout,
            entries: &entries,
        }))
    }
}
