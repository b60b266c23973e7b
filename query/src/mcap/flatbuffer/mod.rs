//! FlatBuffers messages into columns. Scalars that a message leaves out have their default; texts, vectors and tables that it
//! leaves out are null.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields};
use echolake_schema::tables::LIST_CHILD;

use super::column::{Column, Record, duration_type, time_type, width};
use super::error::{Malformed, Spent};
use buffer::FlatbufferBytes;

mod buffer;
mod schema;
mod values;

/// A table or a struct: its members in the order of their places.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FlatbufferDefinition {
    name: String,
    members: Vec<Member>,
    is_struct: bool,
    /// Bytes of a struct.
    bytes: usize,
}

#[derive(Debug, Clone, PartialEq)]
struct Member {
    name: String,
    /// Slot of a table, or offset in a struct.
    slot: u16,
    kind: Kind,
    count: Count,
    /// The default of an integer.
    integer: i64,
    /// The default of a float.
    real: f64,
    /// A scalar without a default.
    is_optional: bool,
}

/// Number of values of a member.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Count {
    One,
    /// In a struct.
    Fixed(usize),
    Vector,
}

/// By their numbers.
type EnumNames = Arc<HashMap<i64, String>>;

#[derive(Debug, Clone, PartialEq)]
enum Kind {
    Number(DataType),
    /// An integer of this type, and the names of its values.
    Enum(DataType, EnumNames),
    Text,
    Time,
    Duration,
    Object(FlatbufferDefinition),
    /// By the number that the member before it has: what it may be.
    Union(Vec<(i64, Member)>),
}

impl FlatbufferDefinition {
    /// Reads the type of a message from a binary schema. The text of an error says what is wrong.
    pub(super) fn parse(name: &str, data: &[u8]) -> Result<Self, String> {
        schema::parse(name, data)
    }

    /// The columns.
    pub(super) fn fields(&self) -> Fields {
        self.members.iter().map(Member::field).collect()
    }
}

impl Member {
    fn alone(kind: Kind, name: String) -> Self {
        Self { name, slot: 0, kind, count: Count::One, integer: 0, real: 0.0, is_optional: false }
    }

    // Bytes are bytes: an image is no list of numbers.
    fn is_binary(&self) -> bool {
        self.count != Count::One && self.kind == Kind::Number(DataType::UInt8)
    }

    fn field(&self) -> Field {
        let one = self.kind.data_type();
        let all = match self.count {
            Count::One => one,
            _ if self.is_binary() => DataType::Binary,
            _ => DataType::List(Arc::new(Field::new(LIST_CHILD, one, false))),
        };
        Field::new(&self.name, all, true)
    }
}

impl Kind {
    fn data_type(&self) -> DataType {
        match self {
            Self::Number(number) => number.clone(),
            Self::Enum(..) | Self::Text => DataType::Utf8,
            Self::Time => time_type(),
            Self::Duration => duration_type(),
            Self::Object(definition) if definition.members.is_empty() => DataType::Boolean,
            Self::Object(definition) => DataType::Struct(definition.fields()),
            Self::Union(parts) if parts.is_empty() => DataType::Boolean,
            Self::Union(parts) => DataType::Struct(parts.iter().map(|(_, part)| part.field()).collect()),
        }
    }
}

/// Decodes messages.
pub(super) struct FlatbufferDecoder {
    definition: FlatbufferDefinition,
    record: Record,
    width: usize,
    pub(super) spent: Spent,
}

impl FlatbufferDecoder {
    /// A decoder of some of a message's columns, by their place in [`FlatbufferDefinition::fields`].
    pub(super) fn new(definition: &FlatbufferDefinition, all: &Fields, wanted: &[usize]) -> Self {
        let some: Fields = wanted.iter().map(|i| all[*i].clone()).collect();
        let members = wanted.iter().map(|i| definition.members[*i].clone()).collect();
        let width = some.iter().map(|f| width(f.data_type())).sum();
        let definition = FlatbufferDefinition { members, ..definition.clone() };
        Self { definition, record: Record::new(&some), width, spent: Spent::default() }
    }

    /// Adds a message as one row.
    pub(super) fn push(&mut self, data: &[u8]) -> Result<(), Malformed> {
        self.spent.add(self.width)?;
        let root = FlatbufferBytes(data).root()?;
        self.definition.read(&values::FlatbufferRow::Table(root), &mut self.record.columns, &mut self.spent)
    }

    /// The columns, which are empty afterwards.
    pub(super) fn columns(&mut self) -> &mut [Column] {
        self.spent = Spent::default();
        &mut self.record.columns
    }
}

#[cfg(test)]
mod tests;
