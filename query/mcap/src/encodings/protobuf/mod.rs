//! Protobuf messages into columns: types by reflection, values by a decoder of its own that is compiled from them.
//!
//! A general message object in between would cost an allocation a value; here a packed list of floats is one copy.

mod decoder;
mod edition;
mod wire;

use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields};
use echolake_schema::tables::LIST_CHILD;
use prost_reflect::prost::Message as _;
use prost_reflect::prost_types::{FileDescriptorProto, FileDescriptorSet};
use prost_reflect::{DescriptorPool, FieldDescriptor, Kind as ProtoKind, MessageDescriptor};

use super::{MessageDecoder, MessageEncoding, MessageType, RawSchema};
use crate::column::{DEEPEST, MOST_LEAVES, duration_type, time_type};
use decoder::ProtobufDecoder;

/// Protobuf: proto2, proto3, and editions.
pub(super) struct ProtobufEncoding;

impl MessageEncoding for ProtobufEncoding {
    fn encoding_names(&self) -> &'static [(&'static str, &'static str)] {
        &[("protobuf", "protobuf")]
    }

    fn parse_schema(&self, channel: &RawSchema) -> Result<(Fields, Box<dyn MessageType>), String> {
        let message = message_type(&channel.name, &channel.data)?;
        Ok((message_columns(&message)?, Box::new(message)))
    }
}

impl MessageType for MessageDescriptor {
    fn create_decoder(&self, wanted: &[usize], fields: &Fields) -> Box<dyn MessageDecoder> {
        Box::new(ProtobufDecoder::new(self, wanted, fields))
    }
}

// The message type that a channel's schema describes: `data` is a FileDescriptorSet.
fn message_type(name: &str, data: &[u8]) -> Result<MessageDescriptor, String> {
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

// The columns of a message type, nested ones within structs.
fn message_columns(message: &MessageDescriptor) -> Result<Fields, String> {
    Types { within: Vec::new(), leaves: 0 }.message_fields(message)
}

/// Makes Arrow's types of Protobuf's.
struct Types {
    /// The messages that the one at hand stands in.
    within: Vec<String>,
    leaves: usize,
}

impl Types {
    fn message_fields(&mut self, message: &MessageDescriptor) -> Result<Fields, String> {
        self.within.push(message.full_name().to_owned());
        let fields = message.fields().map(|f| self.column_field(&f)).collect();
        self.within.pop();
        fields
    }

    fn column_field(&mut self, field: &FieldDescriptor) -> Result<Field, String> {
        let list = |child: DataType| {
            let nullable = may_overflow(&child);
            DataType::List(Arc::new(Field::new(LIST_CHILD, child, nullable)))
        };
        if field.is_map() {
            return Ok(Field::new(field.name(), self.map_type(field)?, false));
        }
        let kind = self.column_type(&field.kind())?;
        Ok(match field.is_list() {
            true => Field::new(field.name(), list(kind), false),
            false => Field::new(field.name(), kind, field.supports_presence()),
        })
    }

    fn map_type(&mut self, field: &FieldDescriptor) -> Result<DataType, String> {
        let Some(entry) = field.kind().as_message().cloned() else {
            return Err(format!("`{}` is a map without entries", field.full_name()));
        };
        let key = Field::new("key", self.column_type(&entry.map_entry_key_field().kind())?, false);
        let value = self.column_type(&entry.map_entry_value_field().kind())?;
        let nullable = may_overflow(&value);
        let value = Field::new("value", value, nullable);
        let entries = Field::new("entries", DataType::Struct(Fields::from(vec![key, value])), false);
        Ok(DataType::Map(Arc::new(entries), false))
    }

    // A message within itself would never end, so it is given as its bytes; so is what stands too deep.
    fn column_type(&mut self, kind: &ProtoKind) -> Result<DataType, String> {
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
                _ => DataType::Struct(self.message_fields(message)?),
            },
        })
    }
}

// A time that 64 bits do not hold is null.
fn may_overflow(kind: &DataType) -> bool {
    matches!(kind, DataType::Timestamp(..) | DataType::Duration(_))
}

#[cfg(test)]
mod tests;
