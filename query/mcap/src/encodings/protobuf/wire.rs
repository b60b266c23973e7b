//! Protobuf on the wire: the fields of a message, one behind the other.

use crate::encodings::Malformed;

const NO_TAG: Malformed = Malformed::Invalid("there is no field number 0 and no wire type above 5");

/// A kind of value on the wire.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum WireKind {
    Varint,
    Eight,
    Four,
    Bytes,
}

/// One value on the wire.
pub(super) enum WireValue {
    Number(WireKind, u64),
    Bytes(usize, usize),
}

/// Walks the fields of one message.
pub(super) struct FieldReader<'a> {
    data: &'a [u8],
    at: usize,
}

impl<'a> FieldReader<'a> {
    /// Reads the fields of a message.
    pub fn new(data: &'a [u8]) -> Self {
        Self { data, at: 0 }
    }

    /// Returns true if there is no field left.
    pub fn is_at_end(&self) -> bool {
        self.at >= self.data.len()
    }

    /// Reads a field's number and value.
    pub fn read_field(&mut self) -> Result<(u32, WireValue), Malformed> {
        let (number, kind) = self.read_tag()?;
        let value = match kind {
            0 => WireValue::Number(WireKind::Varint, self.read_varint()?),
            1 => WireValue::Number(WireKind::Eight, u64::from_le_bytes(self.read_array()?)),
            2 => {
                let (from, to) = self.read_byte_range()?;
                WireValue::Bytes(from, to)
            }
            3 => {
                let from = self.at;
                WireValue::Bytes(from, self.skip_group()?)
            }
            5 => WireValue::Number(WireKind::Four, u64::from(u32::from_le_bytes(self.read_array()?))),
            4 => return Err(Malformed::Invalid("a group ends that did not begin")),
            _ => return Err(NO_TAG),
        };
        Ok((number, value))
    }

    fn read_tag(&mut self) -> Result<(u32, u8), Malformed> {
        let tag = self.read_varint()?;
        match u32::try_from(tag >> 3) {
            Ok(number) if number > 0 => Ok((number, (tag & 7) as u8)),
            _ => Err(NO_TAG),
        }
    }

    /// Reads an integer of variable length.
    #[inline]
    pub fn read_varint(&mut self) -> Result<u64, Malformed> {
        let mut value = 0;
        for (i, byte) in self.data[self.at..].iter().take(10).enumerate() {
            value |= u64::from(byte & 0x7F) << (7 * i);
            if byte & 0x80 == 0 {
                self.at += i + 1;
                return Ok(value);
            }
        }
        Err(if self.data.len() - self.at < 10 {
            Malformed::Ends
        } else {
            Malformed::Invalid("a variable-length integer has more than ten bytes")
        })
    }

    fn read_array<const N: usize>(&mut self) -> Result<[u8; N], Malformed> {
        let bytes = self.data[self.at..].first_chunk::<N>().ok_or(Malformed::Ends)?;
        self.at += N;
        Ok(*bytes)
    }

    fn read_byte_range(&mut self) -> Result<(usize, usize), Malformed> {
        let length = usize::try_from(self.read_varint()?).map_err(|_| Malformed::Ends)?;
        let from = self.at;
        let to = from.checked_add(length).filter(|to| *to <= self.data.len()).ok_or(Malformed::Ends)?;
        self.at = to;
        Ok((from, to))
    }

    // Passes a group; where its content ends.
    fn skip_group(&mut self) -> Result<usize, Malformed> {
        let mut depth = 1;
        loop {
            let end = self.at;
            let (_, kind) = self.read_tag()?;
            match kind {
                0 => drop(self.read_varint()?),
                1 => drop(self.read_array::<8>()?),
                2 => drop(self.read_byte_range()?),
                3 => depth += 1,
                4 => depth -= 1,
                5 => drop(self.read_array::<4>()?),
                _ => return Err(NO_TAG),
            }
            if depth == 0 {
                return Ok(end);
            }
        }
    }
}
