//! ROS 2 messages into columns: definitions as text, values in CDR.

mod cdr;
mod definition;

use arrow::datatypes::Fields;

use super::{Malformed, MessageDecoder, MessageEncoding, MessageType, RawSchema, RowTally, strip_byte_order_mark};
use crate::column::{Column, append_text, value_width};
use cdr::CdrReader;
use definition::{MemberCount, MemberKind, MessageDefinition, MessageMember};

const NANOS: i64 = 1_000_000_000;

/// ROS 2, whose definitions are `ros2msg`, those of services among them.
pub(super) struct Ros2Encoding;

impl MessageEncoding for Ros2Encoding {
    fn encoding_names(&self) -> &'static [(&'static str, &'static str)] {
        &[("cdr", "ros2msg")]
    }

    fn parse_schema(&self, channel: &RawSchema) -> Result<(Fields, Box<dyn MessageType>), String> {
        let text = std::str::from_utf8(strip_byte_order_mark(&channel.data));
        let text = text.map_err(|e| format!("its schema is no text: {e}"))?;
        let definition = MessageDefinition::parse(&channel.name, text)?;
        Ok((definition.column_fields(), Box::new(definition)))
    }
}

impl MessageType for MessageDefinition {
    fn create_decoder(&self, wanted: &[usize], _: &Fields) -> Box<dyn MessageDecoder> {
        // What stands behind the last wanted member need not be read.
        let last = wanted.iter().copied().max().map_or(0, |last| last + 1);
        let members = self.members.iter().take(last).cloned().enumerate();
        let with_column = |(i, member)| (member, wanted.iter().position(|place| *place == i));
        Box::new(Ros2Decoder { members: members.map(with_column).collect() })
    }
}

/// Decodes messages of one type.
struct Ros2Decoder {
    /// Members, each with its column if it has one.
    members: Vec<(MessageMember, Option<usize>)>,
}

impl MessageDecoder for Ros2Decoder {
    fn decode_message(
        &mut self,
        message: &[u8],
        columns: &mut [Column],
        tally: &mut RowTally,
    ) -> Result<(), Malformed> {
        let mut cdr = CdrReader::new(message)?;
        for (member, column) in &self.members {
            member.read_member(&mut cdr, column.map(|i| &mut columns[i]), tally)?;
        }
        Ok(())
    }
}

impl MessageMember {
    // Reads the member, into a column or past it: CDR has no lengths to jump by.
    fn read_member(
        &self,
        cdr: &mut CdrReader<'_>,
        column: Option<&mut Column>,
        tally: &mut RowTally,
    ) -> Result<(), Malformed> {
        let count = match self.count {
            MemberCount::One => return self.kind.read_value(cdr, column, tally),
            MemberCount::Fixed(count) => count,
            MemberCount::Sequence => cdr.read_u32()? as usize,
        };
        if self.is_binary() {
            let bytes = cdr.read_bytes(count)?;
            if let Some(Column::Binary(c)) = column {
                tally.add_bytes(count)?;
                c.append_value(bytes);
            }
            return Ok(());
        }
        // Every value takes a byte at least, so a count beyond the rest is a lie.
        if count > cdr.bytes_left() {
            return Err(Malformed::Ends);
        }
        match column {
            Some(Column::List(list)) => {
                tally.add_bytes(count.saturating_mul(value_width(&self.kind.data_type())))?;
                if !self.kind.read_many(cdr, count, &mut list.values)? {
                    for _ in 0..count {
                        self.kind.read_value(cdr, Some(&mut *list.values), tally)?;
                    }
                }
                list.end_row();
            }
            _ => {
                for _ in 0..count {
                    self.kind.read_value(cdr, None, tally)?;
                }
            }
        }
        Ok(())
    }
}

/// Adds a value, which is read in any case, to a column of this type, if it is wanted.
macro_rules! add_value {
    ($column:ident, $type:ident, $value:expr) => {{
        let value = $value;
        if let Some(Column::$type(c)) = $column {
            c.append_value(value);
        }
    }};
}

impl MemberKind {
    fn read_value(
        &self,
        cdr: &mut CdrReader<'_>,
        column: Option<&mut Column>,
        tally: &mut RowTally,
    ) -> Result<(), Malformed> {
        match self {
            Self::Bool => add_value!(column, Bool, cdr.read_array::<1>()?[0] != 0),
            Self::I8 => add_value!(column, I8, i8::from_ne_bytes(cdr.read_array()?)),
            Self::U8 => add_value!(column, U8, u8::from_ne_bytes(cdr.read_array()?)),
            Self::I16 => add_value!(column, I16, cdr.read_u16()? as i16),
            Self::U16 => add_value!(column, U16, cdr.read_u16()?),
            Self::I32 => add_value!(column, I32, cdr.read_u32()? as i32),
            Self::U32 => add_value!(column, U32, cdr.read_u32()?),
            Self::I64 => add_value!(column, I64, cdr.read_u64()? as i64),
            Self::U64 => add_value!(column, U64, cdr.read_u64()?),
            Self::F32 => add_value!(column, F32, f32::from_bits(cdr.read_u32()?)),
            Self::F64 => add_value!(column, F64, f64::from_bits(cdr.read_u64()?)),
            Self::Time => add_value!(column, Time, read_nanos(cdr)?),
            Self::Duration => add_value!(column, Duration, read_nanos(cdr)?),
            Self::Text => {
                let bytes = cdr.read_text()?;
                if let Some(Column::Text(c)) = column {
                    tally.add_bytes(bytes.len())?;
                    append_text(c, bytes);
                }
            }
            Self::Message(definition) => return definition.read_message(cdr, column, tally),
        }
        Ok(())
    }

    // Floats that are as they are in memory, all at once; false if they are not.
    fn read_many(&self, cdr: &mut CdrReader<'_>, count: usize, column: &mut Column) -> Result<bool, Malformed> {
        match (self, column) {
            (Self::F32, Column::F32(c)) => {
                let Some(values) = cdr.read_many::<4>(count)? else { return Ok(false) };
                c.append_values(values.iter().map(|b| f32::from_le_bytes(*b)));
            }
            (Self::F64, Column::F64(c)) => {
                let Some(values) = cdr.read_many::<8>(count)? else { return Ok(false) };
                c.append_values(values.iter().map(|b| f64::from_le_bytes(*b)));
            }
            _ => return Ok(false),
        }
        Ok(true)
    }
}

// Seconds have a sign, nanoseconds have none.
fn read_nanos(cdr: &mut CdrReader<'_>) -> Result<i64, Malformed> {
    let seconds = cdr.read_u32()? as i32;
    Ok(i64::from(seconds) * NANOS + i64::from(cdr.read_u32()?))
}

impl MessageDefinition {
    fn read_message(
        &self,
        cdr: &mut CdrReader<'_>,
        column: Option<&mut Column>,
        tally: &mut RowTally,
    ) -> Result<(), Malformed> {
        match column {
            // A message without members has a byte all the same.
            _ if self.members.is_empty() => add_value!(column, Bool, cdr.read_array::<1>().map(|_| true)?),
            Some(Column::Struct(record)) => {
                for (member, column) in self.members.iter().zip(&mut record.columns) {
                    member.read_member(cdr, Some(column), tally)?;
                }
                record.end_row();
            }
            _ => {
                for member in &self.members {
                    member.read_member(cdr, None, tally)?;
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
