//! Accessors: typed, strided, sparse views of buffers, with every range checked here.

use std::sync::Arc;

use glam::Vec3;
use gltf::json::accessor::{ComponentType, Type};
use gltf::json::validation::Checked;

use super::document::{Document, Fault, Parsed, fault, item};

/// A checked accessor: all its bytes are there. Sparse indices are checked when it is read.
pub(super) struct Accessor<'a> {
    pub index: usize,
    pub count: usize,
    pub component: ComponentType,
    pub dimensions: Type,
    pub normalized: bool,
    /// None: all zero.
    base: Option<Strided<'a>>,
    sparse: Option<Sparse<'a>>,
}

/// Elements at equal distances.
struct Strided<'a> {
    /// From the first element to the end of the last.
    bytes: &'a [u8],
    stride: usize,
}

/// Elements that replace others.
struct Sparse<'a> {
    count: usize,
    component: ComponentType,
    indices: Strided<'a>,
    values: Strided<'a>,
}

impl<'a> Accessor<'a> {
    /// Finds the accessor that `place` refers to, and checks its ranges.
    pub fn new(document: &'a Document, index: usize, place: impl FnOnce() -> String) -> Parsed<Self> {
        let accessor = item(&document.root.accessors, "accessors", index, place)?;
        let here = |member: &str| format!("accessors[{index}]{member}");
        let Checked::Valid(component) = accessor.component_type else {
            return Err(fault(here(".componentType"), "expected 5120, 5121, 5122, 5123, 5125 or 5126"));
        };
        let Checked::Valid(dimensions) = accessor.type_ else {
            return Err(fault(here(".type"), "expected SCALAR, VEC2, VEC3, VEC4, MAT2, MAT3 or MAT4"));
        };
        let component = component.0;
        let element_bytes = component.size() * dimensions.multiplicity();
        let count = usize::try_from(accessor.count.0)
            .map_err(|_| fault(here(".count"), format!("{} is out of range", accessor.count.0)))?;
        let base = match accessor.buffer_view {
            Some(view) => {
                let offset = accessor.byte_offset.unwrap_or_default().0;
                let element = Element { bytes: element_bytes, count };
                Some(strided(document, view.value(), offset, element, &here(""))?)
            }
            None => None,
        };
        let sparse = match &accessor.sparse {
            Some(sparse) => {
                let Checked::Valid(index_component) = sparse.indices.component_type else {
                    return Err(fault(here(".sparse.indices.componentType"), "expected 5121, 5123 or 5125"));
                };
                if sparse.count.0 > accessor.count.0 {
                    let message = format!("{} is more than the accessor's {count}", sparse.count.0);
                    return Err(fault(here(".sparse.count"), message));
                }
                let count = sparse.count.0 as usize;
                let indices = Element { bytes: index_component.0.size(), count };
                let values = Element { bytes: element_bytes, count };
                let (at, offset) = (sparse.indices.buffer_view.value(), sparse.indices.byte_offset.0);
                let indices = strided(document, at, offset, indices, &here(".sparse.indices"))?;
                let (at, offset) = (sparse.values.buffer_view.value(), sparse.values.byte_offset.0);
                let values = strided(document, at, offset, values, &here(".sparse.values"))?;
                Some(Sparse { count, component: index_component.0, indices, values })
            }
            None => None,
        };
        Ok(Self { index, count, component, dimensions, normalized: accessor.normalized, base, sparse })
    }

    /// Faults unless the accessor has this shape and one of these component types.
    pub fn expect(&self, dimensions: Type, components: &[ComponentType], place: impl FnOnce() -> String) -> Parsed<()> {
        if self.dimensions == dimensions && components.contains(&self.component) {
            return Ok(());
        }
        let names: Vec<_> = components.iter().map(|&component| name(component)).collect();
        Err(fault(
            place(),
            format!(
                "accessors[{}]: expected {} of {}, found {} of {}",
                self.index,
                type_name(dimensions),
                names.join(" or "),
                type_name(self.dimensions),
                name(self.component)
            ),
        ))
    }

    /// Faults unless the accessor has `expected` elements.
    pub fn expect_count(&self, expected: usize, place: impl FnOnce() -> String) -> Parsed<()> {
        if self.count == expected {
            return Ok(());
        }
        let message = format!("accessors[{}]: expected {expected} elements, found {}", self.index, self.count);
        Err(fault(place(), message))
    }

    /// Its elements of `N` components as floats; integers as they are, or in [−1, 1] when normalised. The shape must have
    /// been [expected](Self::expect).
    pub fn floats<const N: usize, T: Copy>(&self, make: impl Fn([f32; N]) -> T + Copy) -> Parsed<Arc<[T]>> {
        match (self.component, self.normalized) {
            (ComponentType::F32, _) => self.collect(|b| make(array(b, f32::from_le_bytes))),
            (ComponentType::I8, false) => self.collect(|b| make(array(b, |v| f32::from(i8::from_le_bytes(v))))),
            (ComponentType::U8, false) => self.collect(|b| make(array(b, |v| f32::from(u8::from_le_bytes(v))))),
            (ComponentType::I16, false) => self.collect(|b| make(array(b, |v| f32::from(i16::from_le_bytes(v))))),
            (ComponentType::U16, false) => self.collect(|b| make(array(b, |v| f32::from(u16::from_le_bytes(v))))),
            // glTF 2.0, 3.11: how normalised integers map to floats.
            (ComponentType::I8, true) => {
                self.collect(|b| make(array(b, |v| (f32::from(i8::from_le_bytes(v)) / 127.0).max(-1.0))))
            }
            (ComponentType::U8, true) => self.collect(|b| make(array(b, |v| f32::from(u8::from_le_bytes(v)) / 255.0))),
            (ComponentType::I16, true) => {
                self.collect(|b| make(array(b, |v| (f32::from(i16::from_le_bytes(v)) / 32767.0).max(-1.0))))
            }
            (ComponentType::U16, true) => {
                self.collect(|b| make(array(b, |v| f32::from(u16::from_le_bytes(v)) / 65535.0)))
            }
            (ComponentType::U32, _) => self.collect(|b| make(array(b, |v| u32::from_le_bytes(v) as f32))),
        }
    }

    /// Its elements as indices. The shape must have been [expected](Self::expect).
    pub fn indices(&self) -> Parsed<Arc<[u32]>> {
        match self.component {
            ComponentType::U8 => self.collect(|b| u32::from(b[0])),
            ComponentType::U16 => self.collect(|b| u32::from(u16::from_le_bytes([b[0], b[1]]))),
            _ => self.collect(|b| array::<1, 4, u32>(b, u32::from_le_bytes)[0]),
        }
    }

    /// Its elements of four unsigned components of one or two bytes. The shape must have been [expected](Self::expect).
    pub fn quadruples(&self) -> Parsed<Arc<[[u16; 4]]>> {
        match self.component {
            ComponentType::U8 => self.collect(|b| array(b, |[v]: [u8; 1]| u16::from(v))),
            _ => self.collect(|b| array(b, u16::from_le_bytes)),
        }
    }

    /// Elements that have bytes of their own in the file: where none has but the sparse ones, these.
    pub fn stored(&self) -> usize {
        match (&self.base, &self.sparse) {
            (Some(_), _) => self.count,
            (None, Some(sparse)) => sparse.count,
            (None, None) => 0,
        }
    }

    /// Its vectors that are not zero, with their indices; no more than are [stored](Self::stored) take memory. The shape must
    /// have been [expected](Self::expect).
    pub fn displacements(&self) -> Parsed<Arc<[(u32, Vec3)]>> {
        let nonzero = |(index, vector): (u32, Vec3)| (vector != Vec3::ZERO).then_some((index, vector));
        match (&self.base, &self.sparse) {
            (Some(_), _) => {
                let all = self.floats(Vec3::from_array)?;
                Ok((0..).zip(all.iter().copied()).filter_map(nonzero).collect())
            }
            (None, Some(sparse)) => {
                let mut indices = Vec::with_capacity(sparse.count);
                self.visit_sparse(sparse, |_, at| indices.push(at as u32))?;
                let values = Strided { bytes: sparse.values.bytes, stride: sparse.values.stride };
                let values = Accessor { count: sparse.count, base: Some(values), sparse: None, ..*self };
                let values = values.floats(Vec3::from_array)?;
                Ok(indices.into_iter().zip(values.iter().copied()).filter_map(nonzero).collect())
            }
            (None, None) => Ok(Arc::new([])),
        }
    }

    /// Its first `most` elements of `N` floats. It must have as many, and their shape must have been [expected](Self::expect).
    pub fn first<const N: usize>(&self, most: usize) -> Parsed<Vec<[f32; N]>> {
        let read = |bytes: &[u8]| array(bytes, f32::from_le_bytes);
        let element_bytes = 4 * N;
        let mut elements: Vec<[f32; N]> = match &self.base {
            Some(base) => (0..most).map(|i| read(base.element(i, element_bytes))).collect(),
            None => vec![[0.0; N]; most],
        };
        if let Some(sparse) = &self.sparse {
            self.visit_sparse(sparse, |i, at| {
                if let Some(element) = elements.get_mut(at) {
                    *element = read(sparse.values.element(i, element_bytes));
                }
            })?;
        }
        Ok(elements)
    }

    fn collect<T: Copy>(&self, read: impl Fn(&[u8]) -> T) -> Parsed<Arc<[T]>> {
        let element_bytes = self.component.size() * self.dimensions.multiplicity();
        let mut elements: Arc<[T]> = match &self.base {
            Some(base) => (0..self.count).map(|i| read(base.element(i, element_bytes))).collect(),
            // The largest element is a MAT4 of four-byte components.
            None => std::iter::repeat_n(read(&[0; 64][..element_bytes]), self.count).collect(),
        };
        if let Some(sparse) = &self.sparse {
            let elements = Arc::get_mut(&mut elements).expect("made above");
            self.visit_sparse(sparse, |i, at| elements[at] = read(sparse.values.element(i, element_bytes)))?;
        }
        Ok(elements)
    }

    /// Calls `visit` with each sparse element's number and the index of the element that it replaces.
    fn visit_sparse(&self, sparse: &Sparse, mut visit: impl FnMut(usize, usize)) -> Parsed<()> {
        let mut lowest = 0;
        for i in 0..sparse.count {
            let mut word = [0; 4];
            word[..sparse.component.size()].copy_from_slice(sparse.indices.element(i, sparse.component.size()));
            let at = u32::from_le_bytes(word) as usize;
            if at < lowest || at >= self.count {
                return Err(self.sparse_fault(i, at, lowest));
            }
            visit(i, at);
            lowest = at + 1;
        }
        Ok(())
    }

    fn sparse_fault(&self, i: usize, found: usize, lowest: usize) -> Fault {
        let place = format!("accessors[{}].sparse.indices", self.index);
        let message = format!("index {i} is {found}: expected at least {lowest} (ascending) and below {}", self.count);
        fault(place, message)
    }
}

impl Strided<'_> {
    fn element(&self, i: usize, bytes: usize) -> &[u8] {
        &self.bytes[i * self.stride..i * self.stride + bytes]
    }
}

/// `N` components of `B` bytes each.
fn array<const N: usize, const B: usize, T>(bytes: &[u8], read: impl Fn([u8; B]) -> T) -> [T; N] {
    let components = bytes.as_chunks::<B>().0;
    std::array::from_fn(|i| read(components[i]))
}

/// Size of an element and how many there are.
#[derive(Clone, Copy)]
struct Element {
    bytes: usize,
    count: usize,
}

fn strided<'a>(
    document: &'a Document,
    view_index: usize,
    offset: u64,
    element: Element,
    place: &str,
) -> Parsed<Strided<'a>> {
    let (bytes, view) = document.view(view_index, || format!("{place}.bufferView"))?;
    let stride = view.byte_stride.map_or(element.bytes, |stride| stride.0);
    // glTF 2.0, 5.11.4: at most 252. Less than an element would make them overlap.
    if stride < element.bytes || (view.byte_stride.is_some() && stride > 252) {
        return Err(fault(
            format!("bufferViews[{view_index}].byteStride"),
            format!("expected {} to 252 for {place}, found {stride}", element.bytes),
        ));
    }
    if element.count == 0 {
        return Ok(Strided { bytes: &[], stride });
    }
    let end = (element.count as u64 - 1)
        .checked_mul(stride as u64)
        .and_then(|last| last.checked_add(element.bytes as u64))
        .and_then(|length| length.checked_add(offset))
        .filter(|&end| end <= bytes.len() as u64);
    match end {
        Some(end) => Ok(Strided { bytes: &bytes[offset as usize..end as usize], stride }),
        None => Err(fault(
            place,
            format!(
                "{} elements of {} bytes, {stride} apart, from byte {offset} do not fit bufferViews[{view_index}], \
                 which has {}",
                element.count,
                element.bytes,
                bytes.len()
            ),
        )),
    }
}

fn name(component: ComponentType) -> &'static str {
    match component {
        ComponentType::I8 => "BYTE",
        ComponentType::U8 => "UNSIGNED_BYTE",
        ComponentType::I16 => "SHORT",
        ComponentType::U16 => "UNSIGNED_SHORT",
        ComponentType::U32 => "UNSIGNED_INT",
        ComponentType::F32 => "FLOAT",
    }
}

fn type_name(dimensions: Type) -> &'static str {
    match dimensions {
        Type::Scalar => "SCALAR",
        Type::Vec2 => "VEC2",
        Type::Vec3 => "VEC3",
        Type::Vec4 => "VEC4",
        Type::Mat2 => "MAT2",
        Type::Mat3 => "MAT3",
        Type::Mat4 => "MAT4",
    }
}
