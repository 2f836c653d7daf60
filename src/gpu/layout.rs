//! Structs shared with shaders, written once in Rust and held against WGSL's own layout by a test of each.

#[cfg(test)]
use wgpu::naga;

#[cfg(test)]
use super::shader::{SOURCES, Source};

/// A field of a GPU struct: name, offset in bytes, WGSL type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Field {
    /// The same on both sides.
    pub name: &'static str,
    /// Bytes from the struct's start.
    pub offset: usize,
    /// As WGSL spells it.
    pub wgsl: &'static str,
}

/// A struct of which shaders have a twin.
pub trait GpuStruct: bytemuck::Pod {
    /// The twin's name.
    const NAME: &'static str;
    /// Its fields, in order.
    const FIELDS: &'static [Field];
}

/// How a Rust type is spelt in WGSL.
pub trait Wgsl {
    /// The spelling.
    const NAME: &'static str;
}

macro_rules! wgsl_names {
    ($($type:ty => $name:literal),* $(,)?) => {
        $(impl Wgsl for $type { const NAME: &'static str = $name; })*
    };
}

wgsl_names! {
    f32 => "f32",
    u32 => "u32",
    i32 => "i32",
    [u32; 2] => "vec2<u32>",
    [u32; 4] => "vec4<u32>",
    glam::Vec2 => "vec2<f32>",
    glam::Vec3 => "vec3<f32>",
    glam::Vec4 => "vec4<f32>",
    glam::Mat4 => "mat4x4<f32>",
}

/// Declares a `repr(C)` struct that shaders share, and the test that its layout is that of its twin in WGSL, padding included:
/// the struct of the same name, or of the name after `as`.
#[macro_export]
macro_rules! gpu_struct {
    (
        $(#[$meta:meta])*
        $visibility:vis struct $name:ident { $($fields:tt)* }
    ) => {
        $crate::gpu_struct! { $(#[$meta])* $visibility struct $name as $name { $($fields)* } }
    };
    (
        $(#[$meta:meta])*
        $visibility:vis struct $name:ident as $wgsl:ident {
            $($(#[$field_meta:meta])* pub $field:ident: $type:ty,)*
        }
    ) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
        #[repr(C)]
        $visibility struct $name { $($(#[$field_meta])* pub $field: $type,)* }

        impl $crate::gpu::layout::GpuStruct for $name {
            const NAME: &'static str = stringify!($wgsl);
            const FIELDS: &'static [$crate::gpu::layout::Field] = &[$($crate::gpu::layout::Field {
                name: stringify!($field),
                offset: std::mem::offset_of!($name, $field),
                wgsl: <$type as $crate::gpu::layout::Wgsl>::NAME,
            },)*];
        }

        #[cfg(test)]
        #[test]
        #[expect(non_snake_case, reason = "the test of a struct's layout has the struct's name")]
        fn $name() {
            $crate::gpu::layout::assert_twin::<$name>();
        }
    };
}

/// Holds a struct against its twin in every shader that has one: names, order, offsets, types, size, and the stride of arrays.
///
/// # Panics
/// Where they differ, and where no shader has a twin.
#[cfg(test)]
pub(crate) fn assert_twin<T: GpuStruct>() {
    let sources: Vec<Source> = SOURCES.iter().map(|(path, _)| Source::load(path)).collect();
    let mut found = 0;
    for source in &sources {
        let types = &source.module.types;
        let is_twin = |kind: &naga::Type| kind.name.as_deref() == Some(T::NAME);
        let Some((twin, kind)) = types.iter().find(|(_, kind)| is_twin(kind)) else { continue };
        let naga::TypeInner::Struct { members, span } = &kind.inner else {
            panic!("{}: {} is no struct", source.path, T::NAME)
        };
        found += 1;
        let place = format!("{} in {}", T::NAME, source.path);
        let fields: Vec<(&str, usize, String)> = members
            .iter()
            .map(|member| {
                let name = member.name.as_deref().expect("members have names");
                (name, member.offset as usize, spelling(&types[member.ty].inner))
            })
            .collect();
        let own: Vec<_> = T::FIELDS.iter().map(|field| (field.name, field.offset, field.wgsl.to_owned())).collect();
        assert_eq!(own, fields, "{place}: name, offset and type of fields, in Rust and in WGSL");
        assert_eq!(size_of::<T>(), *span as usize, "{place}: bytes, in Rust and in WGSL");
        for (_, kind) in types.iter() {
            if let naga::TypeInner::Array { base, stride, .. } = kind.inner
                && base == twin
            {
                assert_eq!(size_of::<T>(), stride as usize, "{place}: bytes from one of an array to the next");
            }
        }
    }
    assert!(found > 0, "no shader has a struct {}", T::NAME);
}

/// How WGSL spells a type that a field may have.
#[cfg(test)]
fn spelling(kind: &naga::TypeInner) -> String {
    let scalar = |scalar: &naga::Scalar| match (scalar.kind, scalar.width) {
        (naga::ScalarKind::Float, 4) => "f32",
        (naga::ScalarKind::Uint, 4) => "u32",
        (naga::ScalarKind::Sint, 4) => "i32",
        other => panic!("no twin of a field is {other:?}"),
    };
    match kind {
        naga::TypeInner::Scalar(of) => scalar(of).to_owned(),
        naga::TypeInner::Vector { size, scalar: of } => format!("vec{}<{}>", *size as u32, scalar(of)),
        naga::TypeInner::Matrix { columns, rows, scalar: of } => {
            format!("mat{}x{}<{}>", *columns as u32, *rows as u32, scalar(of))
        }
        other => panic!("no twin of a field is {other:?}"),
    }
}
