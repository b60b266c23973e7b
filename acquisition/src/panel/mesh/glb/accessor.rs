//! Numbers of a GLB file: accessors over views of its one buffer.

use serde_json::Value;

use super::{FLOAT, UNSIGNED_BYTE, UNSIGNED_INT, UNSIGNED_SHORT};

/// A file's JSON and its binary chunk.
pub(super) struct GlbFile<'a> {
    pub(super) document: Value,
    pub(super) bin: &'a [u8],
}

/// Bytes of an accessor's elements.
struct Elements<'a> {
    kind: u64,
    bytes: &'a [u8],
    count: usize,
    size: usize,
    stride: usize,
}

impl<'a> Elements<'a> {
    fn iter(&self) -> impl Iterator<Item = &'a [u8]> {
        let (bytes, size, stride) = (self.bytes, self.size, self.stride);
        (0..self.count).map(move |i| &bytes[i * stride..i * stride + size])
    }
}

/// The items of a JSON array; of anything else, none.
pub(super) fn list(value: &Value) -> &[Value] {
    value.as_array().map_or(&[], Vec::as_slice)
}

/// A whole number from 0.
pub(super) fn number(value: &Value) -> Option<usize> {
    value.as_u64().and_then(|n| usize::try_from(n).ok())
}

// One that may be left out, but not be something else.
fn number_or(value: &Value, default: usize) -> Option<usize> {
    if value.is_null() { Some(default) } else { number(value) }
}

impl<'a> GlbFile<'a> {
    /// Returns the number of elements that an accessor declares.
    pub(super) fn count(&self, accessor: &Value) -> Option<usize> {
        number(&self.accessor(accessor)?["count"])
    }

    /// Positions, as the file has them.
    pub(super) fn positions(&self, accessor: &Value) -> Option<Vec<[f32; 3]>> {
        let elements = self.elements(accessor, "VEC3", 3)?;
        let float = |b: &[u8]| Some(f32::from_le_bytes(b.try_into().ok()?));
        (elements.kind == FLOAT).then_some(())?;
        elements.iter().map(|e| Some([float(&e[..4])?, float(&e[4..8])?, float(&e[8..12])?])).collect()
    }

    /// Indices: whole numbers, as glTF has them.
    pub(super) fn indices(&self, accessor: &Value) -> Option<Vec<u32>> {
        let elements = self.elements(accessor, "SCALAR", 1)?;
        let int = |e: &[u8]| e.iter().rev().fold(0, |n, b| n << 8 | u32::from(*b));
        (elements.kind != FLOAT).then(|| elements.iter().map(int).collect())
    }

    fn accessor(&self, index: &Value) -> Option<&Value> {
        list(&self.document["accessors"]).get(number(index)?)
    }

    // None if the accessor leads out of the file, or is sparse: that kind is not read.
    fn elements(&self, accessor: &Value, shape: &str, width: usize) -> Option<Elements<'a>> {
        let accessor = self.accessor(accessor)?;
        let view = list(&self.document["bufferViews"]).get(number(&accessor["bufferView"])?)?;
        let kind = accessor["componentType"].as_u64()?;
        let size = match kind {
            FLOAT | UNSIGNED_INT => 4,
            UNSIGNED_SHORT => 2,
            UNSIGNED_BYTE => 1,
            _ => return None,
        } * width;
        if accessor["type"] != shape || number(&view["buffer"])? != 0 || !accessor["sparse"].is_null() {
            return None;
        }
        let start = number_or(&view["byteOffset"], 0)?;
        let view_bytes = self.bin.get(start..start.checked_add(number(&view["byteLength"])?)?)?;
        let stride = number_or(&view["byteStride"], size)?.max(size);
        let bytes = view_bytes.get(number_or(&accessor["byteOffset"], 0)?..)?;
        let count = number(&accessor["count"])?;
        let needed = count.checked_sub(1).map_or(Some(0), |n| n.checked_mul(stride)?.checked_add(size))?;
        (needed <= bytes.len()).then_some(Elements { kind, bytes, count, size, stride })
    }
}
