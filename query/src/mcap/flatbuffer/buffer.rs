//! The bytes of a FlatBuffer: tables, texts and vectors where offsets say they are. Nothing is believed: whatever leads out
//! of the bytes is malformed.

use super::super::error::Malformed;

/// Bytes of an offset, and of a vector's length.
pub(super) const OFFSET_BYTES: usize = 4;
/// Bytes before a table's slots: their own length and the table's.
const SLOTS_HEAD: usize = 4;

/// A FlatBuffer.
#[derive(Debug, Clone, Copy)]
pub(super) struct FlatbufferBytes<'a>(pub(super) &'a [u8]);

/// A table in a FlatBuffer.
#[derive(Debug, Clone, Copy)]
pub(super) struct FlatbufferTable<'a> {
    pub(super) buffer: FlatbufferBytes<'a>,
    at: usize,
    /// By slot, where a field stands behind `at`; 0 where it is not there.
    slots: &'a [u8],
}

impl<'a> FlatbufferBytes<'a> {
    /// The bytes of a number.
    pub(super) fn array<const N: usize>(self, at: usize) -> Result<[u8; N], Malformed> {
        self.0.get(at..).and_then(|rest| rest.first_chunk::<N>()).copied().ok_or(Malformed::Ends)
    }

    /// Follows the offset at a place.
    pub(super) fn follow(self, at: usize) -> Result<usize, Malformed> {
        at.checked_add(u32::from_le_bytes(self.array(at)?) as usize).ok_or(Malformed::Ends)
    }

    /// The table that a FlatBuffer begins with.
    pub(super) fn root(self) -> Result<FlatbufferTable<'a>, Malformed> {
        self.table(self.follow(0)?)
    }

    /// The table at a place.
    pub(super) fn table(self, at: usize) -> Result<FlatbufferTable<'a>, Malformed> {
        let back = i64::from(i32::from_le_bytes(self.array(at)?));
        let begin = i64::try_from(at).ok().and_then(|at| at.checked_sub(back)).ok_or(Malformed::Ends)?;
        let begin = usize::try_from(begin).map_err(|_| Malformed::Ends)?;
        let length = usize::from(u16::from_le_bytes(self.array(begin)?));
        let slots = begin.checked_add(length).and_then(|end| self.0.get(begin..end)).ok_or(Malformed::Ends)?;
        if slots.len() < SLOTS_HEAD {
            return Err(Malformed::Ends);
        }
        Ok(FlatbufferTable { buffer: self, at, slots })
    }

    /// Number of elements of `size` bytes in the vector at a place, and place of the first; all of them are there.
    pub(super) fn vector(self, at: usize, size: usize) -> Result<(usize, usize), Malformed> {
        let count = u32::from_le_bytes(self.array(at)?) as usize;
        let first = at + OFFSET_BYTES;
        self.elements(first, count, size)?;
        Ok((count, first))
    }

    /// The bytes of elements side by side.
    pub(super) fn elements(self, first: usize, count: usize, size: usize) -> Result<&'a [u8], Malformed> {
        let end = count.checked_mul(size).and_then(|bytes| bytes.checked_add(first));
        end.and_then(|end| self.0.get(first..end)).ok_or(Malformed::Ends)
    }

    /// The bytes of the text or of the vector of bytes at a place.
    pub(super) fn bytes(self, at: usize) -> Result<&'a [u8], Malformed> {
        let (count, first) = self.vector(at, 1)?;
        self.elements(first, count, 1)
    }
}

impl<'a> FlatbufferTable<'a> {
    /// Place of a field; None if it is not there.
    pub(super) fn place(&self, slot: u16) -> Option<usize> {
        let place = self.slots.get(usize::from(slot)..).and_then(|rest| rest.first_chunk::<2>())?;
        match u16::from_le_bytes(*place) {
            0 => None,
            place => self.at.checked_add(usize::from(place)),
        }
    }

    /// The bytes of a number that is there.
    pub(super) fn number<const N: usize>(&self, slot: u16) -> Result<Option<[u8; N]>, Malformed> {
        self.place(slot).map(|at| self.buffer.array(at)).transpose()
    }

    /// A text, empty if it is not there.
    pub(super) fn text(&self, slot: u16) -> Result<&'a [u8], Malformed> {
        let Some(at) = self.place(slot) else { return Ok(&[]) };
        self.buffer.bytes(self.buffer.follow(at)?)
    }

    /// A table that is there.
    pub(super) fn child(&self, slot: u16) -> Result<Option<Self>, Malformed> {
        self.place(slot).map(|at| self.buffer.table(self.buffer.follow(at)?)).transpose()
    }

    /// A vector of tables, empty if it is not there.
    pub(super) fn children(&self, slot: u16) -> Result<Vec<Self>, Malformed> {
        let Some(at) = self.place(slot) else { return Ok(Vec::new()) };
        let (count, first) = self.buffer.vector(self.buffer.follow(at)?, OFFSET_BYTES)?;
        (0..count).map(|i| self.buffer.table(self.buffer.follow(first + i * OFFSET_BYTES)?)).collect()
    }
}
