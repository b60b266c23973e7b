//! Decodes Protobuf messages: one pass over a message's bytes finds its fields, and each field ends in its column.

use std::collections::HashMap;

use arrow::datatypes::{DataType, Fields};
use prost_reflect::{FieldDescriptor, Kind as ProtoKind, MessageDescriptor};

use super::wire::{FieldReader, WireKind, WireValue};
use crate::column::{Column, List, append_text, value_width};
use crate::encodings::{Malformed, MessageDecoder, RowTally};

const NANOS: i64 = 1_000_000_000;
/// Field numbers up to here are looked up in a table, others in a map.
const SMALL_NUMBERS: u32 = 1024;

/// Decodes messages of one type.
pub(super) struct ProtobufDecoder(Node);

impl ProtobufDecoder {
    /// Compiles a decoder of the columns at `wanted`, which are `fields`.
    pub fn new(message: &MessageDescriptor, wanted: &[usize], fields: &Fields) -> Self {
        let descriptors: Vec<_> = message.fields().collect();
        Self(Node::new(wanted.iter().map(|i| &descriptors[*i]), fields))
    }
}

impl MessageDecoder for ProtobufDecoder {
    fn decode_message(
        &mut self,
        message: &[u8],
        columns: &mut [Column],
        tally: &mut RowTally,
    ) -> Result<(), Malformed> {
        self.0.decode_message(message, columns, tally)
    }
}

/// A message type as the decoder sees it, and what it found of the message at hand.
struct Node {
    fields: Vec<FieldNode>,
    numbers: Numbers,
    /// Bytes that a row of it takes whatever the message holds.
    width: usize,
    /// Which member of each oneof was seen last.
    oneofs: Vec<Option<usize>>,
}

struct FieldNode {
    kind: Kind,
    label: Label,
    /// Whether a missing value is null rather than the type's default.
    presence: bool,
    oneof: Option<usize>,
    found: Found,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Label {
    Single,
    Repeated,
    Map,
}

/// What a field holds.
enum Kind {
    /// A number of a wire type; the flag says that it is in zigzag.
    Number(WireKind, Zigzag),
    Enum(HashMap<i32, String>),
    Text,
    Bytes,
    /// A message that is given as its bytes.
    Opaque,
    Time,
    Empty,
    Message(Box<Node>),
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Zigzag {
    Yes,
    No,
}

/// What came of a field so far.
enum Found {
    Nothing,
    Number(u64),
    /// From where to where it stands in the message; several are parts of one, or entries of a map.
    Bytes(Vec<(usize, usize)>),
}

enum Numbers {
    Table(Vec<Option<usize>>),
    Map(HashMap<u32, usize>),
}

impl Numbers {
    fn new(numbers: &[u32]) -> Self {
        let most = numbers.iter().copied().max().unwrap_or(0);
        if most > SMALL_NUMBERS {
            return Self::Map(numbers.iter().enumerate().map(|(i, n)| (*n, i)).collect());
        }
        let mut table = vec![None; most as usize + 1];
        numbers.iter().enumerate().for_each(|(i, n)| table[*n as usize] = Some(i));
        Self::Table(table)
    }

    fn field_index(&self, number: u32) -> Option<usize> {
        match self {
            Self::Table(table) => table.get(number as usize).copied().flatten(),
            Self::Map(map) => map.get(&number).copied(),
        }
    }
}

impl Node {
    fn new<'a>(descriptors: impl Iterator<Item = &'a FieldDescriptor>, types: &Fields) -> Self {
        let mut names: Vec<String> = Vec::new();
        let mut fields = Vec::new();
        let mut numbers = Vec::new();
        for (descriptor, field) in descriptors.zip(types) {
            let oneof = descriptor.containing_oneof().map(|oneof| {
                let name = oneof.name().to_owned();
                names.iter().position(|n| *n == name).unwrap_or_else(|| {
                    names.push(name);
                    names.len() - 1
                })
            });
            numbers.push(descriptor.number());
            fields.push(FieldNode::new(descriptor, field.data_type(), oneof));
        }
        let width = types.iter().map(|f| value_width(f.data_type())).sum::<usize>() + 1;
        Self { fields, numbers: Numbers::new(&numbers), width, oneofs: vec![None; names.len()] }
    }

    fn decode_message(&mut self, data: &[u8], columns: &mut [Column], tally: &mut RowTally) -> Result<(), Malformed> {
        self.fields.iter_mut().for_each(FieldNode::forget_value);
        self.oneofs.fill(None);
        let mut wire = FieldReader::new(data);
        while !wire.is_at_end() {
            let (number, value) = wire.read_field()?;
            if let Some(i) = self.numbers.field_index(number) {
                self.see_field(i, value, data, columns, tally)?;
            }
        }
        for (field, column) in self.fields.iter_mut().zip(columns) {
            field.end_message(data, column, tally)?;
        }
        Ok(())
    }

    fn see_field(
        &mut self,
        i: usize,
        value: WireValue,
        data: &[u8],
        columns: &mut [Column],
        tally: &mut RowTally,
    ) -> Result<(), Malformed> {
        let field = &mut self.fields[i];
        match field.label {
            Label::Repeated => match &mut columns[i] {
                Column::List(list) => field.kind.append_elements(value, data, list, tally),
                _ => Ok(()),
            },
            Label::Single | Label::Map => {
                if field.keep_value(value)
                    && let Some(oneof) = field.oneof
                    && let Some(before) = self.oneofs[oneof].replace(i).filter(|before| *before != i)
                {
                    self.fields[before].forget_value();
                }
                Ok(())
            }
        }
    }
}

impl FieldNode {
    fn new(descriptor: &FieldDescriptor, data_type: &DataType, oneof: Option<usize>) -> Self {
        let (label, data_type) = match data_type {
            DataType::List(child) => (Label::Repeated, child.data_type()),
            DataType::Map(entry, _) => (Label::Map, entry.data_type()),
            other => (Label::Single, other),
        };
        let mut kind = Kind::new(&descriptor.kind(), data_type);
        // What an entry of a map lacks is its type's default, also where messages know absence.
        if let (Label::Map, Kind::Message(entry)) = (label, &mut kind) {
            entry.fields.iter_mut().for_each(|field| field.presence = false);
        }
        Self { kind, label, presence: descriptor.supports_presence(), oneof, found: Found::Nothing }
    }

    // A list of places is kept for the next message, emptied.
    fn forget_value(&mut self) {
        match &mut self.found {
            Found::Bytes(places) if !places.is_empty() => places.clear(),
            Found::Number(_) => self.found = Found::Nothing,
            _ => {}
        }
    }

    // Keeps a value until the message ends, since a later one may take its place; what has another wire type is no
    // value of this field.
    fn keep_value(&mut self, value: WireValue) -> bool {
        match value {
            WireValue::Number(wire, number) if wire == self.kind.wire_kind() => self.found = Found::Number(number),
            WireValue::Bytes(from, to) if self.kind.wire_kind() == WireKind::Bytes => {
                let merges = self.label == Label::Map || self.kind.merges_parts();
                match &mut self.found {
                    Found::Bytes(places) => {
                        if !merges {
                            places.clear();
                        }
                        places.push((from, to));
                    }
                    found => *found = Found::Bytes(vec![(from, to)]),
                }
            }
            _ => return false,
        }
        true
    }

    fn end_message(&mut self, data: &[u8], column: &mut Column, tally: &mut RowTally) -> Result<(), Malformed> {
        match (self.label, column) {
            (Label::Repeated, Column::List(list)) => {
                list.end_row();
                Ok(())
            }
            (Label::Map, Column::Map(list)) => {
                if let (Kind::Message(entry), Found::Bytes(places)) = (&mut self.kind, &mut self.found) {
                    keep_last_of_each_key(data, places);
                    for (from, to) in places.iter() {
                        entry.append_message(&data[*from..*to], &mut list.values, tally)?;
                    }
                }
                list.end_row();
                Ok(())
            }
            (_, column) => self.end_single(data, column, tally),
        }
    }

    fn end_single(&mut self, data: &[u8], column: &mut Column, tally: &mut RowTally) -> Result<(), Malformed> {
        match &self.found {
            Found::Number(number) => self.kind.push_number(*number, column, tally),
            Found::Bytes(places) if places.len() == 1 => {
                let (from, to) = places[0];
                self.kind.push_bytes(&data[from..to], column, tally)
            }
            // Parts of one message are the message when they stand one behind the other.
            Found::Bytes(places) if !places.is_empty() => {
                let whole: Vec<u8> = places.iter().flat_map(|(from, to)| &data[*from..*to]).copied().collect();
                self.kind.push_bytes(&whole, column, tally)
            }
            _ if self.presence => {
                column.append_null();
                Ok(())
            }
            _ if self.kind.wire_kind() == WireKind::Bytes => self.kind.push_bytes(&[], column, tally),
            _ => self.kind.push_number(0, column, tally),
        }
    }
}

impl Node {
    // One more element of a list of messages.
    fn append_message(&mut self, data: &[u8], values: &mut Column, tally: &mut RowTally) -> Result<(), Malformed> {
        if let Column::Struct(record) = values {
            tally.add_bytes(self.width)?;
            self.decode_message(data, &mut record.columns, tally)?;
            record.end_row();
        }
        Ok(())
    }
}

impl Kind {
    fn new(kind: &ProtoKind, data_type: &DataType) -> Self {
        use Zigzag::{No, Yes};
        match kind {
            ProtoKind::Double | ProtoKind::Fixed64 | ProtoKind::Sfixed64 => Self::Number(WireKind::Eight, No),
            ProtoKind::Float | ProtoKind::Fixed32 | ProtoKind::Sfixed32 => Self::Number(WireKind::Four, No),
            ProtoKind::Sint32 | ProtoKind::Sint64 => Self::Number(WireKind::Varint, Yes),
            ProtoKind::Int32 | ProtoKind::Int64 | ProtoKind::Uint32 | ProtoKind::Uint64 | ProtoKind::Bool => {
                Self::Number(WireKind::Varint, No)
            }
            ProtoKind::Enum(names) => {
                let mut by_number = HashMap::new();
                // Of several names of one number the first in the file is the one to show.
                for value in &names.enum_descriptor_proto().value {
                    by_number.entry(value.number()).or_insert_with(|| value.name().to_owned());
                }
                Self::Enum(by_number)
            }
            ProtoKind::String => Self::Text,
            ProtoKind::Bytes => Self::Bytes,
            ProtoKind::Message(message) => match data_type {
                DataType::Struct(fields) => {
                    let descriptors: Vec<_> = message.fields().collect();
                    Self::Message(Box::new(Node::new(descriptors.iter(), fields)))
                }
                DataType::Timestamp(..) | DataType::Duration(_) => Self::Time,
                DataType::Boolean => Self::Empty,
                _ => Self::Opaque,
            },
        }
    }

    fn wire_kind(&self) -> WireKind {
        match self {
            Self::Number(wire, _) => *wire,
            Self::Enum(_) => WireKind::Varint,
            _ => WireKind::Bytes,
        }
    }

    fn merges_parts(&self) -> bool {
        matches!(self, Self::Message(_) | Self::Time | Self::Opaque)
    }

    // One more value of a repeated field, or a packed list of them.
    fn append_elements(
        &mut self,
        value: WireValue,
        data: &[u8],
        list: &mut List,
        tally: &mut RowTally,
    ) -> Result<(), Malformed> {
        match value {
            WireValue::Number(wire, number) if wire == self.wire_kind() => {
                tally.add_bytes(8)?;
                self.push_number(number, &mut list.values, tally)
            }
            WireValue::Bytes(from, to) if self.wire_kind() == WireKind::Bytes => {
                self.push_bytes(&data[from..to], &mut list.values, tally)
            }
            WireValue::Bytes(from, to) => self.append_packed(&data[from..to], &mut list.values, tally),
            WireValue::Number(..) => Ok(()),
        }
    }

    fn append_packed(&self, packed: &[u8], values: &mut Column, tally: &mut RowTally) -> Result<(), Malformed> {
        let four = packed.as_chunks::<4>();
        let eight = packed.as_chunks::<8>();
        match self.wire_kind() {
            WireKind::Four if four.1.is_empty() => {
                tally.add_bytes(packed.len())?;
                match values {
                    Column::F32(c) => c.append_values(four.0.iter().map(|b| f32::from_le_bytes(*b))),
                    Column::I32(c) => c.append_values(four.0.iter().map(|b| i32::from_le_bytes(*b))),
                    Column::U32(c) => c.append_values(four.0.iter().map(|b| u32::from_le_bytes(*b))),
                    _ => {}
                }
                Ok(())
            }
            WireKind::Eight if eight.1.is_empty() => {
                tally.add_bytes(packed.len())?;
                match values {
                    Column::F64(c) => c.append_values(eight.0.iter().map(|b| f64::from_le_bytes(*b))),
                    Column::I64(c) => c.append_values(eight.0.iter().map(|b| i64::from_le_bytes(*b))),
                    Column::U64(c) => c.append_values(eight.0.iter().map(|b| u64::from_le_bytes(*b))),
                    _ => {}
                }
                Ok(())
            }
            WireKind::Varint => {
                let mut wire = FieldReader::new(packed);
                while !wire.is_at_end() {
                    tally.add_bytes(8)?;
                    self.push_number(wire.read_varint()?, values, tally)?;
                }
                Ok(())
            }
            _ => Err(Malformed::Ends),
        }
    }

    fn push_number(&self, number: u64, column: &mut Column, tally: &mut RowTally) -> Result<(), Malformed> {
        let zigzag = matches!(self, Self::Number(_, Zigzag::Yes));
        let signed = if zigzag { (number >> 1) as i64 ^ -((number & 1) as i64) } else { number as i64 };
        match column {
            Column::F64(c) => c.append_value(f64::from_bits(number)),
            Column::F32(c) => c.append_value(f32::from_bits(number as u32)),
            // A 32-bit zigzag is that of its lower half.
            Column::I32(c) if zigzag => c.append_value((number as u32 >> 1) as i32 ^ -((number & 1) as i32)),
            Column::I32(c) => c.append_value(number as i32),
            Column::I64(c) => c.append_value(signed),
            Column::U32(c) => c.append_value(number as u32),
            Column::U64(c) => c.append_value(number),
            Column::Bool(c) => c.append_value(number != 0),
            Column::Text(c) => match self {
                Self::Enum(names) => match names.get(&(number as i32)) {
                    Some(name) => {
                        tally.add_bytes(name.len())?;
                        c.append_value(name.as_bytes());
                    }
                    None => c.append_value((number as i32).to_string().as_bytes()),
                },
                _ => c.append_value(b""),
            },
            other => other.append_null(),
        }
        Ok(())
    }

    fn push_bytes(&mut self, data: &[u8], column: &mut Column, tally: &mut RowTally) -> Result<(), Malformed> {
        match (self, column) {
            (Self::Message(node), column) => node.append_message(data, column, tally)?,
            (Self::Time, Column::Time(c)) => {
                tally.add_bytes(8)?;
                c.append_option(parse_nanos(data)?);
            }
            (Self::Time, Column::Duration(c)) => {
                tally.add_bytes(8)?;
                c.append_option(parse_nanos(data)?);
            }
            (Self::Empty, Column::Bool(c)) => {
                tally.add_bytes(1)?;
                c.append_value(true);
            }
            (Self::Text, Column::Text(c)) => {
                tally.add_bytes(data.len() + 4)?;
                append_text(c, data);
            }
            (_, Column::Binary(c)) => {
                tally.add_bytes(data.len() + 4)?;
                c.append_value(data);
            }
            (_, other) => other.append_null(),
        }
        Ok(())
    }
}

/// Nanoseconds of a Timestamp or Duration; None where 64 bits do not hold them (from the year 2262 on).
fn parse_nanos(data: &[u8]) -> Result<Option<i64>, Malformed> {
    let mut seconds = 0i64;
    let mut rest = 0i32;
    let mut wire = FieldReader::new(data);
    while !wire.is_at_end() {
        match wire.read_field()? {
            (1, WireValue::Number(WireKind::Varint, number)) => seconds = number as i64,
            (2, WireValue::Number(WireKind::Varint, number)) => rest = number as i32,
            _ => {}
        }
    }
    Ok(seconds.checked_mul(NANOS).and_then(|nanos| nanos.checked_add(i64::from(rest))))
}

// Where a key comes twice its last value counts. Keys are compared by their first field's bytes: a writer that encodes
// one key in two ways is not expected.
fn keep_last_of_each_key(data: &[u8], places: &mut Vec<(usize, usize)>) {
    if places.len() < 2 {
        return;
    }
    let mut last = HashMap::new();
    for (i, (from, to)) in places.iter().enumerate() {
        last.insert(key_of(&data[*from..*to]), i);
    }
    if last.len() < places.len() {
        let mut i = 0;
        places.retain(|(from, to)| {
            i += 1;
            last.get(&key_of(&data[*from..*to])) == Some(&(i - 1))
        });
    }
}

/// The key of a map's entry as it stands there: a number, or bytes; a missing one is the default of either.
fn key_of(entry: &[u8]) -> (u64, &[u8]) {
    let mut wire = FieldReader::new(entry);
    let mut key = (0, &entry[..0]);
    while !wire.is_at_end() {
        match wire.read_field() {
            Ok((1, WireValue::Number(_, number))) => key = (number, &entry[..0]),
            Ok((1, WireValue::Bytes(from, to))) => key = (0, &entry[from..to]),
            Ok(_) => {}
            Err(_) => break,
        }
    }
    key
}
