//! Values of a message, from where they stand into columns.

use arrow::datatypes::DataType;

use super::super::column::{Column, width};
use super::super::error::{Malformed, Spent};
use super::buffer::{FlatbufferBytes, FlatbufferTable, OFFSET_BYTES};
use super::{Count, FlatbufferDefinition, Kind, Member};

const NANOS: i64 = 1_000_000_000;
/// Bytes by which the number of a union's type stands before the union in a table's slots.
const UNION_TYPE_SLOT: u16 = 2;

/// A table, or the place of a struct.
pub(super) enum FlatbufferRow<'a> {
    Table(FlatbufferTable<'a>),
    Struct(FlatbufferBytes<'a>, usize),
}

impl<'a> FlatbufferRow<'a> {
    fn buffer(&self) -> FlatbufferBytes<'a> {
        match self {
            Self::Table(table) => table.buffer,
            Self::Struct(buffer, _) => *buffer,
        }
    }

    fn place(&self, slot: u16) -> Option<usize> {
        match self {
            Self::Table(table) => table.place(slot),
            Self::Struct(_, at) => at.checked_add(usize::from(slot)),
        }
    }
}

impl FlatbufferDefinition {
    /// Adds a value to each member's column.
    pub(super) fn read(
        &self,
        row: &FlatbufferRow<'_>,
        columns: &mut [Column],
        spent: &mut Spent,
    ) -> Result<(), Malformed> {
        self.members.iter().zip(columns).try_for_each(|(member, column)| member.read(row, column, spent))
    }

    fn read_at(
        &self,
        buffer: FlatbufferBytes<'_>,
        at: usize,
        column: &mut Column,
        spent: &mut Spent,
    ) -> Result<(), Malformed> {
        let row = match self.is_struct {
            true => FlatbufferRow::Struct(buffer, at),
            false => FlatbufferRow::Table(buffer.table(buffer.follow(at)?)?),
        };
        match column {
            Column::Struct(record) => {
                self.read(&row, &mut record.columns, spent)?;
                record.end_row();
            }
            Column::Bool(c) => c.push(true),
            _ => {}
        }
        Ok(())
    }
}

impl Member {
    fn read(&self, row: &FlatbufferRow<'_>, column: &mut Column, spent: &mut Spent) -> Result<(), Malformed> {
        let buffer = row.buffer();
        let Some(at) = row.place(self.slot) else {
            self.push_default(column);
            return Ok(());
        };
        match (&self.kind, self.count) {
            (Kind::Union(parts), _) => {
                let number = self.slot.checked_sub(UNION_TYPE_SLOT).and_then(|slot| row.place(slot));
                let number = number.map_or(Ok([0]), |at| buffer.array(at))?;
                read_union(parts, i64::from(number[0]), buffer, at, column, spent)
            }
            (_, Count::One) => self.kind.read(buffer, at, column, spent),
            (_, Count::Fixed(count)) => self.read_list(buffer, at, count, column, spent),
            (_, Count::Vector) => {
                let (count, first) = buffer.vector(buffer.follow(at)?, self.kind.element_bytes())?;
                self.read_list(buffer, first, count, column, spent)
            }
        }
    }

    fn push_default(&self, column: &mut Column) {
        let integer = self.integer;
        match column {
            _ if self.is_optional => column.push_null(),
            Column::Bool(c) if matches!(self.kind, Kind::Number(_)) => c.push(integer != 0),
            Column::I8(c) => c.push(integer as i8),
            Column::I16(c) => c.push(integer as i16),
            Column::I32(c) => c.push(integer as i32),
            Column::I64(c) => c.push(integer),
            Column::U8(c) => c.push(integer as u8),
            Column::U16(c) => c.push(integer as u16),
            Column::U32(c) => c.push(integer as u32),
            Column::U64(c) => c.push(integer as u64),
            Column::F32(c) => c.push(self.real as f32),
            Column::F64(c) => c.push(self.real),
            Column::Text(c) => match &self.kind {
                Kind::Enum(_, names) => c.push(enum_name(names.get(&integer), integer).as_bytes()),
                _ => column.push_null(),
            },
            _ => column.push_null(),
        }
    }

    fn read_list(
        &self,
        buffer: FlatbufferBytes<'_>,
        first: usize,
        count: usize,
        column: &mut Column,
        spent: &mut Spent,
    ) -> Result<(), Malformed> {
        let size = self.kind.element_bytes();
        let bytes = buffer.elements(first, count, size)?;
        match column {
            Column::Binary(c) => {
                spent.add(count)?;
                c.push(bytes);
            }
            Column::List(list) => {
                spent.add(count.saturating_mul(width(&self.kind.data_type())))?;
                match &mut *list.values {
                    // Numbers that stand as they are in memory, all at once.
                    Column::F32(c) => c.extend(bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b))),
                    Column::F64(c) => c.extend(bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b))),
                    values => {
                        for i in 0..count {
                            self.kind.read(buffer, first + i * size, values, spent)?;
                        }
                    }
                }
                list.end_row();
            }
            _ => {}
        }
        Ok(())
    }
}

fn read_union(
    parts: &[(i64, Member)],
    number: i64,
    buffer: FlatbufferBytes<'_>,
    at: usize,
    column: &mut Column,
    spent: &mut Spent,
) -> Result<(), Malformed> {
    let Column::Struct(record) = column else {
        column.push_null();
        return Ok(());
    };
    for ((own, part), column) in parts.iter().zip(&mut record.columns) {
        match &part.kind {
            _ if *own != number => column.push_null(),
            // In a union a struct stands behind an offset, too.
            Kind::Object(definition) if definition.is_struct => {
                definition.read_at(buffer, buffer.follow(at)?, column, spent)?;
            }
            kind => kind.read(buffer, at, column, spent)?,
        }
    }
    record.end_row();
    Ok(())
}

impl Kind {
    /// Bytes of an element of a vector.
    fn element_bytes(&self) -> usize {
        match self {
            Self::Number(DataType::Boolean) => 1,
            Self::Number(number) | Self::Enum(number, _) => number.primitive_width().unwrap_or(1),
            Self::Time | Self::Duration => 8,
            Self::Object(definition) => definition.element_bytes(),
            Self::Text | Self::Union(_) => OFFSET_BYTES,
        }
    }

    fn read(
        &self,
        buffer: FlatbufferBytes<'_>,
        at: usize,
        column: &mut Column,
        spent: &mut Spent,
    ) -> Result<(), Malformed> {
        match (self, column) {
            (Self::Object(definition), column) => return definition.read_at(buffer, at, column, spent),
            (Self::Text, Column::Text(c)) => {
                let bytes = buffer.bytes(buffer.follow(at)?)?;
                spent.add(bytes.len())?;
                c.push_text(bytes);
            }
            (Self::Enum(kind, names), Column::Text(c)) => {
                let number = integer(kind, buffer, at)?;
                let name = enum_name(names.get(&number), number);
                spent.add(name.len())?;
                c.push(name.as_bytes());
            }
            (Self::Time, Column::Time(c)) => {
                c.push(i64::from(u32::from_le_bytes(buffer.array(at)?)) * NANOS + nanos(buffer, at)?);
            }
            (Self::Duration, Column::Duration(c)) => {
                c.push(i64::from(i32::from_le_bytes(buffer.array(at)?)) * NANOS + nanos(buffer, at)?);
            }
            (_, Column::Bool(c)) => c.push(buffer.array(at)? != [0]),
            (_, Column::I8(c)) => c.push(i8::from_le_bytes(buffer.array(at)?)),
            (_, Column::I16(c)) => c.push(i16::from_le_bytes(buffer.array(at)?)),
            (_, Column::I32(c)) => c.push(i32::from_le_bytes(buffer.array(at)?)),
            (_, Column::I64(c)) => c.push(i64::from_le_bytes(buffer.array(at)?)),
            (_, Column::U8(c)) => c.push(u8::from_le_bytes(buffer.array(at)?)),
            (_, Column::U16(c)) => c.push(u16::from_le_bytes(buffer.array(at)?)),
            (_, Column::U32(c)) => c.push(u32::from_le_bytes(buffer.array(at)?)),
            (_, Column::U64(c)) => c.push(u64::from_le_bytes(buffer.array(at)?)),
            (_, Column::F32(c)) => c.push(f32::from_le_bytes(buffer.array(at)?)),
            (_, Column::F64(c)) => c.push(f64::from_le_bytes(buffer.array(at)?)),
            (_, column) => column.push_null(),
        }
        Ok(())
    }
}

fn nanos(buffer: FlatbufferBytes<'_>, at: usize) -> Result<i64, Malformed> {
    Ok(i64::from(u32::from_le_bytes(buffer.array(at + 4)?)))
}

fn integer(kind: &DataType, buffer: FlatbufferBytes<'_>, at: usize) -> Result<i64, Malformed> {
    Ok(match kind {
        DataType::Boolean | DataType::UInt8 => u8::from_le_bytes(buffer.array(at)?).into(),
        DataType::Int8 => i8::from_le_bytes(buffer.array(at)?).into(),
        DataType::Int16 => i16::from_le_bytes(buffer.array(at)?).into(),
        DataType::UInt16 => u16::from_le_bytes(buffer.array(at)?).into(),
        DataType::Int32 => i32::from_le_bytes(buffer.array(at)?).into(),
        DataType::UInt32 => u32::from_le_bytes(buffer.array(at)?).into(),
        // Names of unsigned ones are kept by the same bits.
        _ => i64::from_le_bytes(buffer.array(at)?),
    })
}

fn enum_name(name: Option<&String>, number: i64) -> String {
    name.cloned().unwrap_or_else(|| number.to_string())
}
