//! Protobuf messages into columns: types by reflection, values by a decoder of its own that is compiled from them.
//!
//! A general message object in between would cost an allocation a value; here a packed list of floats is one copy.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields};
use echolake_schema::tables::LIST_CHILD;
use prost_reflect::prost::Message as _;
use prost_reflect::prost_types::{FileDescriptorProto, FileDescriptorSet};
use prost_reflect::{DescriptorPool, FieldDescriptor, Kind as ProtoKind, MessageDescriptor};

use super::column::{Column, DEEPEST, List, MOST_LEAVES, Record, duration_type, time_type, width};
use super::error::{Malformed, Spent};

mod edition;

const NANOS: i64 = 1_000_000_000;
/// Field numbers up to here are looked up in a table, others in a map.
const SMALL_NUMBERS: u32 = 1024;

/// The message type that a channel's schema describes: `data` is a FileDescriptorSet.
pub(super) fn message_type(name: &str, data: &[u8]) -> Result<MessageDescriptor, String> {
    let files =
        FileDescriptorSet::decode(data).map_err(|e| format!("its schema is no set of file descriptors: {e}"))?;
    let is_plain = |file: &FileDescriptorProto| matches!(file.syntax.as_deref(), None | Some("proto2" | "proto3"));
    let pool = match files.file.iter().all(is_plain) {
        true => DescriptorPool::decode(data),
        false => DescriptorPool::from_file_descriptor_set(edition::without_editions(files, data)?),
    };
    let pool = pool.map_err(|e| format!("its schema is no set of file descriptors: {e}"))?;
    pool.get_message_by_name(name).ok_or_else(|| format!("its schema does not describe `{name}`"))
}

/// The columns of a message type, nested ones within structs.
pub(super) fn fields(message: &MessageDescriptor) -> Result<Fields, String> {
    Types { within: Vec::new(), leaves: 0 }.fields(message)
}

/// Makes Arrow's types of Protobuf's.
struct Types {
    /// The messages that the one at hand stands in.
    within: Vec<String>,
    leaves: usize,
}

impl Types {
    fn fields(&mut self, message: &MessageDescriptor) -> Result<Fields, String> {
        self.within.push(message.full_name().to_owned());
        let fields = message.fields().map(|f| self.field(&f)).collect();
        self.within.pop();
        fields
    }

    fn field(&mut self, field: &FieldDescriptor) -> Result<Field, String> {
        let list = |child: DataType| {
            let nullable = may_overflow(&child);
            DataType::List(Arc::new(Field::new(LIST_CHILD, child, nullable)))
        };
        if field.is_map() {
            return Ok(Field::new(field.name(), self.map(field)?, false));
        }
        let kind = self.kind(&field.kind())?;
        Ok(match field.is_list() {
            true => Field::new(field.name(), list(kind), false),
            false => Field::new(field.name(), kind, field.supports_presence()),
        })
    }

    fn map(&mut self, field: &FieldDescriptor) -> Result<DataType, String> {
        let Some(entry) = field.kind().as_message().cloned() else {
            return Err(format!("`{}` is a map without entries", field.full_name()));
        };
        let key = Field::new("key", self.kind(&entry.map_entry_key_field().kind())?, false);
        let value = self.kind(&entry.map_entry_value_field().kind())?;
        let nullable = may_overflow(&value);
        let value = Field::new("value", value, nullable);
        let entries = Field::new("entries", DataType::Struct(Fields::from(vec![key, value])), false);
        Ok(DataType::Map(Arc::new(entries), false))
    }

    // A message within itself would never end, so it is given as its bytes; so is what stands too deep.
    fn kind(&mut self, kind: &ProtoKind) -> Result<DataType, String> {
        self.leaves += 1;
        if self.leaves > MOST_LEAVES {
            return Err(format!("its schema has more than {MOST_LEAVES} columns"));
        }
        Ok(match kind {
            ProtoKind::Double => DataType::Float64,
            ProtoKind::Float => DataType::Float32,
            ProtoKind::Int32 | ProtoKind::Sint32 | ProtoKind::Sfixed32 => DataType::Int32,
            ProtoKind::Int64 | ProtoKind::Sint64 | ProtoKind::Sfixed64 => DataType::Int64,
            ProtoKind::Uint32 | ProtoKind::Fixed32 => DataType::UInt32,
            ProtoKind::Uint64 | ProtoKind::Fixed64 => DataType::UInt64,
            ProtoKind::Bool => DataType::Boolean,
            ProtoKind::String | ProtoKind::Enum(_) => DataType::Utf8,
            ProtoKind::Bytes => DataType::Binary,
            ProtoKind::Message(message) => match message.full_name() {
                "google.protobuf.Timestamp" => time_type(),
                "google.protobuf.Duration" => duration_type(),
                name if self.within.iter().any(|w| w == name) || self.within.len() >= DEEPEST => DataType::Binary,
                _ if message.fields().len() == 0 => DataType::Boolean,
                _ => DataType::Struct(self.fields(message)?),
            },
        })
    }
}

// A time that 64 bits do not hold is null.
fn may_overflow(kind: &DataType) -> bool {
    matches!(kind, DataType::Timestamp(..) | DataType::Duration(_))
}

/// Decodes messages of one type.
pub(super) struct Decoder {
    node: Node,
    record: Record,
    pub(super) spent: Spent,
}

impl Decoder {
    /// A decoder of some of a message's columns, by their place in [`fields`].
    pub(super) fn new(message: &MessageDescriptor, all: &Fields, wanted: &[usize]) -> Self {
        let some: Fields = wanted.iter().map(|i| all[*i].clone()).collect();
        let descriptors: Vec<_> = message.fields().collect();
        let chosen = wanted.iter().map(|i| &descriptors[*i]);
        Self { node: Node::new(chosen, &some), record: Record::new(&some), spent: Spent::default() }
    }

    /// Adds a message as one row.
    pub(super) fn push(&mut self, data: &[u8]) -> Result<(), Malformed> {
        self.node.decode(data, &mut self.record.columns, &mut self.spent)
    }

    /// The columns, which are empty afterwards.
    pub(super) fn columns(&mut self) -> &mut [Column] {
        self.spent = Spent::default();
        &mut self.record.columns
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
    Number(Wire, Zigzag),
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

#[derive(Clone, Copy, PartialEq, Eq)]
enum Wire {
    Varint,
    Eight,
    Four,
    Bytes,
}

/// What came of a field so far.
enum Found {
    Nothing,
    Number(u64),
    /// From where to where it stands in the message; several are parts of one, or entries of a map.
    Bytes(Vec<(usize, usize)>),
}

/// One value on the wire.
enum Value {
    Number(Wire, u64),
    Bytes(usize, usize),
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

    fn find(&self, number: u32) -> Option<usize> {
        match self {
            Self::Table(table) => table.get(number as usize).copied().flatten(),
            Self::Map(map) => map.get(&number).copied(),
        }
    }
}

impl Node {
    fn new<'a>(descriptors: impl Iterator<Item = &'a FieldDescriptor>, types: &Fields) -> Self {
        let mut names: Vec<String> = Vec::new();
        let (mut fields, mut numbers) = (Vec::new(), Vec::new());
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
        let width = types.iter().map(|f| width(f.data_type())).sum::<usize>() + 1;
        Self { fields, numbers: Numbers::new(&numbers), width, oneofs: vec![None; names.len()] }
    }

    fn decode(&mut self, data: &[u8], columns: &mut [Column], spent: &mut Spent) -> Result<(), Malformed> {
        spent.add(self.width)?;
        self.fields.iter_mut().for_each(FieldNode::forget);
        self.oneofs.fill(None);
        let mut wire = Reader { data, at: 0 };
        while wire.at < data.len() {
            let (number, value) = wire.field()?;
            if let Some(i) = self.numbers.find(number) {
                self.see(i, value, data, columns, spent)?;
            }
        }
        for (field, column) in self.fields.iter_mut().zip(columns) {
            field.end(data, column, spent)?;
        }
        Ok(())
    }

    fn see(
        &mut self,
        i: usize,
        value: Value,
        data: &[u8],
        columns: &mut [Column],
        spent: &mut Spent,
    ) -> Result<(), Malformed> {
        let field = &mut self.fields[i];
        match field.label {
            Label::Repeated => match &mut columns[i] {
                Column::List(list) => field.kind.append(value, data, list, spent),
                _ => Ok(()),
            },
            Label::Single | Label::Map => {
                if field.keep(value)
                    && let Some(oneof) = field.oneof
                    && let Some(before) = self.oneofs[oneof].replace(i).filter(|before| *before != i)
                {
                    self.fields[before].forget();
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
    fn forget(&mut self) {
        match &mut self.found {
            Found::Bytes(places) if !places.is_empty() => places.clear(),
            Found::Number(_) => self.found = Found::Nothing,
            _ => {}
        }
    }

    // Keeps a value until the message ends, since a later one may take its place; what has another wire type is no
    // value of this field.
    fn keep(&mut self, value: Value) -> bool {
        match value {
            Value::Number(wire, number) if wire == self.kind.wire() => self.found = Found::Number(number),
            Value::Bytes(from, to) if self.kind.wire() == Wire::Bytes => {
                let merges = self.label == Label::Map || self.kind.merges();
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

    fn end(&mut self, data: &[u8], column: &mut Column, spent: &mut Spent) -> Result<(), Malformed> {
        match (self.label, column) {
            (Label::Repeated, Column::List(list)) => {
                list.end_row();
                Ok(())
            }
            (Label::Map, Column::Map(list)) => {
                if let (Kind::Message(entry), Found::Bytes(places)) = (&mut self.kind, &mut self.found) {
                    keep_last_of_each_key(data, places);
                    for (from, to) in places.iter() {
                        entry.append(&data[*from..*to], &mut list.values, spent)?;
                    }
                }
                list.end_row();
                Ok(())
            }
            (_, column) => self.end_single(data, column, spent),
        }
    }

    fn end_single(&mut self, data: &[u8], column: &mut Column, spent: &mut Spent) -> Result<(), Malformed> {
        match &self.found {
            Found::Number(number) => self.kind.push_number(*number, column, spent),
            Found::Bytes(places) if places.len() == 1 => {
                let (from, to) = places[0];
                self.kind.push_bytes(&data[from..to], column, spent)
            }
            // Parts of one message are the message when they stand one behind the other.
            Found::Bytes(places) if !places.is_empty() => {
                let whole: Vec<u8> = places.iter().flat_map(|(from, to)| &data[*from..*to]).copied().collect();
                self.kind.push_bytes(&whole, column, spent)
            }
            _ if self.presence => {
                column.push_null();
                Ok(())
            }
            _ if self.kind.wire() == Wire::Bytes => self.kind.push_bytes(&[], column, spent),
            _ => self.kind.push_number(0, column, spent),
        }
    }
}

impl Node {
    // One more element of a list of messages.
    fn append(&mut self, data: &[u8], values: &mut Column, spent: &mut Spent) -> Result<(), Malformed> {
        if let Column::Struct(record) = values {
            self.decode(data, &mut record.columns, spent)?;
            record.end_row();
        }
        Ok(())
    }
}

impl Kind {
    fn new(kind: &ProtoKind, data_type: &DataType) -> Self {
        use Zigzag::{No, Yes};
        match kind {
            ProtoKind::Double | ProtoKind::Fixed64 | ProtoKind::Sfixed64 => Self::Number(Wire::Eight, No),
            ProtoKind::Float | ProtoKind::Fixed32 | ProtoKind::Sfixed32 => Self::Number(Wire::Four, No),
            ProtoKind::Sint32 | ProtoKind::Sint64 => Self::Number(Wire::Varint, Yes),
            ProtoKind::Int32 | ProtoKind::Int64 | ProtoKind::Uint32 | ProtoKind::Uint64 | ProtoKind::Bool => {
                Self::Number(Wire::Varint, No)
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

    fn wire(&self) -> Wire {
        match self {
            Self::Number(wire, _) => *wire,
            Self::Enum(_) => Wire::Varint,
            _ => Wire::Bytes,
        }
    }

    fn merges(&self) -> bool {
        matches!(self, Self::Message(_) | Self::Time | Self::Opaque)
    }

    // One more value of a repeated field, or a packed list of them.
    fn append(&mut self, value: Value, data: &[u8], list: &mut List, spent: &mut Spent) -> Result<(), Malformed> {
        match value {
            Value::Number(wire, number) if wire == self.wire() => {
                spent.add(8)?;
                self.push_number(number, &mut list.values, spent)
            }
            Value::Bytes(from, to) if self.wire() == Wire::Bytes => {
                self.push_bytes(&data[from..to], &mut list.values, spent)
            }
            Value::Bytes(from, to) => self.append_packed(&data[from..to], &mut list.values, spent),
            Value::Number(..) => Ok(()),
        }
    }

    fn append_packed(&self, packed: &[u8], values: &mut Column, spent: &mut Spent) -> Result<(), Malformed> {
        let (four, eight) = (packed.as_chunks::<4>(), packed.as_chunks::<8>());
        match self.wire() {
            Wire::Four if four.1.is_empty() => {
                spent.add(packed.len())?;
                match values {
                    Column::F32(c) => c.extend(four.0.iter().map(|b| f32::from_le_bytes(*b))),
                    Column::I32(c) => c.extend(four.0.iter().map(|b| i32::from_le_bytes(*b))),
                    Column::U32(c) => c.extend(four.0.iter().map(|b| u32::from_le_bytes(*b))),
                    _ => {}
                }
                Ok(())
            }
            Wire::Eight if eight.1.is_empty() => {
                spent.add(packed.len())?;
                match values {
                    Column::F64(c) => c.extend(eight.0.iter().map(|b| f64::from_le_bytes(*b))),
                    Column::I64(c) => c.extend(eight.0.iter().map(|b| i64::from_le_bytes(*b))),
                    Column::U64(c) => c.extend(eight.0.iter().map(|b| u64::from_le_bytes(*b))),
                    _ => {}
                }
                Ok(())
            }
            Wire::Varint => {
                let mut wire = Reader { data: packed, at: 0 };
                while wire.at < packed.len() {
                    spent.add(8)?;
                    self.push_number(wire.varint()?, values, spent)?;
                }
                Ok(())
            }
            _ => Err(Malformed::Ends),
        }
    }

    fn push_number(&self, number: u64, column: &mut Column, spent: &mut Spent) -> Result<(), Malformed> {
        let zigzag = matches!(self, Self::Number(_, Zigzag::Yes));
        let signed = if zigzag { (number >> 1) as i64 ^ -((number & 1) as i64) } else { number as i64 };
        match column {
            Column::F64(c) => c.push(f64::from_bits(number)),
            Column::F32(c) => c.push(f32::from_bits(number as u32)),
            // A 32-bit zigzag is that of its lower half.
            Column::I32(c) if zigzag => c.push((number as u32 >> 1) as i32 ^ -((number & 1) as i32)),
            Column::I32(c) => c.push(number as i32),
            Column::I64(c) => c.push(signed),
            Column::U32(c) => c.push(number as u32),
            Column::U64(c) => c.push(number),
            Column::Bool(c) => c.push(number != 0),
            Column::Text(c) => match self {
                Self::Enum(names) => match names.get(&(number as i32)) {
                    Some(name) => {
                        spent.add(name.len())?;
                        c.push(name.as_bytes());
                    }
                    None => c.push((number as i32).to_string().as_bytes()),
                },
                _ => c.push(b""),
            },
            other => other.push_null(),
        }
        Ok(())
    }

    fn push_bytes(&mut self, data: &[u8], column: &mut Column, spent: &mut Spent) -> Result<(), Malformed> {
        match (self, column) {
            (Self::Message(node), column) => node.append(data, column, spent),
            (Self::Time, Column::Time(c)) => {
                spent.add(8)?;
                match nanos(data)? {
                    Some(nanos) => c.push(nanos),
                    None => c.push_null(),
                }
                Ok(())
            }
            (Self::Time, Column::Duration(c)) => {
                spent.add(8)?;
                match nanos(data)? {
                    Some(nanos) => c.push(nanos),
                    None => c.push_null(),
                }
                Ok(())
            }
            (Self::Empty, Column::Bool(c)) => {
                spent.add(1)?;
                c.push(true);
                Ok(())
            }
            (Self::Text, Column::Text(c)) => {
                spent.add(data.len() + 4)?;
                c.push_text(data);
                Ok(())
            }
            (_, Column::Binary(c)) => {
                spent.add(data.len() + 4)?;
                c.push(data);
                Ok(())
            }
            (_, other) => {
                other.push_null();
                Ok(())
            }
        }
    }
}

/// Nanoseconds of a Timestamp or Duration; None where 64 bits do not hold them (from the year 2262 on).
fn nanos(data: &[u8]) -> Result<Option<i64>, Malformed> {
    let (mut seconds, mut rest) = (0i64, 0i32);
    let mut wire = Reader { data, at: 0 };
    while wire.at < data.len() {
        match wire.field()? {
            (1, Value::Number(Wire::Varint, number)) => seconds = number as i64,
            (2, Value::Number(Wire::Varint, number)) => rest = number as i32,
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
    let mut wire = Reader { data: entry, at: 0 };
    let mut key = (0, &entry[..0]);
    while wire.at < entry.len() {
        match wire.field() {
            Ok((1, Value::Number(_, number))) => key = (number, &entry[..0]),
            Ok((1, Value::Bytes(from, to))) => key = (0, &entry[from..to]),
            Ok(_) => {}
            Err(_) => break,
        }
    }
    key
}

/// Walks the fields of one message.
struct Reader<'a> {
    data: &'a [u8],
    at: usize,
}

impl Reader<'_> {
    // A field's number and value.
    fn field(&mut self) -> Result<(u32, Value), Malformed> {
        let (number, kind) = self.tag()?;
        let value = match kind {
            0 => Value::Number(Wire::Varint, self.varint()?),
            1 => Value::Number(Wire::Eight, u64::from_le_bytes(self.array()?)),
            2 => {
                let (from, to) = self.bytes()?;
                Value::Bytes(from, to)
            }
            3 => {
                let from = self.at;
                Value::Bytes(from, self.group()?)
            }
            5 => Value::Number(Wire::Four, u64::from(u32::from_le_bytes(self.array()?))),
            4 => return Err(Malformed::Group),
            _ => return Err(Malformed::Tag),
        };
        Ok((number, value))
    }

    fn tag(&mut self) -> Result<(u32, u8), Malformed> {
        let tag = self.varint()?;
        match u32::try_from(tag >> 3) {
            Ok(number) if number > 0 => Ok((number, (tag & 7) as u8)),
            _ => Err(Malformed::Tag),
        }
    }

    #[inline]
    fn varint(&mut self) -> Result<u64, Malformed> {
        let mut value = 0;
        for (i, byte) in self.data[self.at..].iter().take(10).enumerate() {
            value |= u64::from(byte & 0x7F) << (7 * i);
            if byte & 0x80 == 0 {
                self.at += i + 1;
                return Ok(value);
            }
        }
        Err(if self.data.len() - self.at < 10 { Malformed::Ends } else { Malformed::Varint })
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Malformed> {
        let bytes = self.data[self.at..].first_chunk::<N>().ok_or(Malformed::Ends)?;
        self.at += N;
        Ok(*bytes)
    }

    fn bytes(&mut self) -> Result<(usize, usize), Malformed> {
        let length = usize::try_from(self.varint()?).map_err(|_| Malformed::Ends)?;
        let from = self.at;
        let to = from.checked_add(length).filter(|to| *to <= self.data.len()).ok_or(Malformed::Ends)?;
        self.at = to;
        Ok((from, to))
    }

    // Passes a group; where its content ends.
    fn group(&mut self) -> Result<usize, Malformed> {
        let mut depth = 1;
        loop {
            let end = self.at;
            let (_, kind) = self.tag()?;
            match kind {
                0 => drop(self.varint()?),
                1 => drop(self.array::<8>()?),
                2 => drop(self.bytes()?),
                3 => depth += 1,
                4 => depth -= 1,
                5 => drop(self.array::<4>()?),
                _ => return Err(Malformed::Tag),
            }
            if depth == 0 {
                return Ok(end);
            }
        }
    }
}

#[cfg(test)]
mod tests;
