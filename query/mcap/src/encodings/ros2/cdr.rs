//! CDR, in which ROS 2 writes messages: values in their order, with every length checked.

use crate::encodings::Malformed;

/// The order of a number's bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ByteOrder {
    Little,
    Big,
}

/// Reads one message's values; each is aligned to its size, counted from behind the header.
pub(super) struct CdrReader<'a> {
    data: &'a [u8],
    at: usize,
    order: ByteOrder,
    /// The largest alignment: 8 in the first version of CDR, 4 in the second.
    align: usize,
}

impl<'a> CdrReader<'a> {
    /// Reads the header of a message.
    pub fn new(data: &'a [u8]) -> Result<Self, Malformed> {
        let (header, data) = data.split_at_checked(4).ok_or(Malformed::Ends)?;
        let (order, align) = match (header[0], header[1]) {
            (0, 0) => (ByteOrder::Big, 8),
            (0, 1) => (ByteOrder::Little, 8),
            (0, 6) => (ByteOrder::Big, 4),
            (0, 7) => (ByteOrder::Little, 4),
            _ => return Err(Malformed::Invalid("its encapsulation is none of CDR's that are known here")),
        };
        Ok(Self { data, at: 0, order, align })
    }

    /// Returns the number of bytes that are left.
    pub fn bytes_left(&self) -> usize {
        self.data.len().saturating_sub(self.at)
    }

    /// Reads this many bytes.
    pub fn read_bytes(&mut self, count: usize) -> Result<&'a [u8], Malformed> {
        let end = self.at.checked_add(count).ok_or(Malformed::Ends)?;
        let bytes = self.data.get(self.at..end).ok_or(Malformed::Ends)?;
        self.at = end;
        Ok(bytes)
    }

    /// Reads a value of this many bytes.
    pub fn read_array<const N: usize>(&mut self) -> Result<[u8; N], Malformed> {
        self.at = self.at.next_multiple_of(N.min(self.align));
        let bytes = self.data.get(self.at..).and_then(|rest| rest.first_chunk::<N>()).ok_or(Malformed::Ends)?;
        self.at += N;
        Ok(*bytes)
    }

    /// Reads numbers that are as they are in memory, all at once; None if they are not.
    pub fn read_many<const N: usize>(&mut self, count: usize) -> Result<Option<&'a [[u8; N]]>, Malformed> {
        // An empty list has no bytes, and is not aligned.
        if self.order == ByteOrder::Big || count == 0 {
            return Ok(None);
        }
        self.at = self.at.next_multiple_of(N.min(self.align));
        let bytes = self.read_bytes(count.checked_mul(N).ok_or(Malformed::Ends)?)?;
        Ok(Some(bytes.as_chunks::<N>().0))
    }

    /// Reads an unsigned integer.
    pub fn read_u16(&mut self) -> Result<u16, Malformed> {
        let bytes = self.read_array()?;
        Ok(if self.order == ByteOrder::Little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) })
    }

    /// Reads an unsigned integer.
    pub fn read_u32(&mut self) -> Result<u32, Malformed> {
        let bytes = self.read_array()?;
        Ok(if self.order == ByteOrder::Little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    /// Reads an unsigned integer.
    pub fn read_u64(&mut self) -> Result<u64, Malformed> {
        let bytes = self.read_array()?;
        Ok(if self.order == ByteOrder::Little { u64::from_le_bytes(bytes) } else { u64::from_be_bytes(bytes) })
    }

    /// Reads a text, whose length counts a zero at its end, which an empty text may lack.
    pub fn read_text(&mut self) -> Result<&'a [u8], Malformed> {
        let length = self.read_u32()? as usize;
        let bytes = self.read_bytes(length)?;
        Ok(bytes.strip_suffix(&[0]).unwrap_or(bytes))
    }
}
