//! What a channel's schema says of its messages: their columns, and the decoder that fills them.

use std::borrow::Cow;

use arrow::array::ArrayRef;
use arrow::datatypes::Fields;
use arrow::error::ArrowError;
use prost_reflect::MessageDescriptor;

use super::error::Malformed;
use super::ros::RosVersion;
use super::{flatbuffer, json, protobuf, ros, ros_idl};

/// A channel's schema as it stands in the file.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub(super) struct RawSchema {
    /// The message type's name.
    pub(super) name: String,
    /// What `data` is: `protobuf`, `jsonschema`, `ros2msg`, ...
    pub(super) encoding: String,
    /// How the messages are encoded: `protobuf`, `json`, `cdr`, ...
    pub(super) messages: String,
    pub(super) data: Vec<u8>,
}

/// A schema, understood.
#[derive(Debug)]
pub(super) struct Layout {
    /// The columns of a message.
    pub(super) fields: Fields,
    kind: Kind,
}

#[derive(Debug)]
enum Kind {
    Protobuf(MessageDescriptor),
    /// By its properties, or one column with the text.
    Json(json::Shape),
    Ros(ros::Definition),
    Flatbuffer(flatbuffer::FlatbufferDefinition),
    /// Messages of an encoding that is not known, which have no columns.
    Unknown,
}

/// The start of some texts in UTF-8, which is no part of them.
pub(super) const BYTE_ORDER_MARK: &[u8] = b"\xef\xbb\xbf";

/// The encodings that have columns, in words.
const KNOWN: &str =
    "protobuf, flatbuffer, json with jsonschema or none, cdr with ros2msg or ros2idl, and ros1 with ros1msg";

impl Layout {
    /// Understands a schema; the text of an error says what is wrong with it.
    pub(super) fn new(schema: &RawSchema) -> Result<Self, String> {
        let text = schema.data.strip_prefix(BYTE_ORDER_MARK).unwrap_or(&schema.data);
        let (fields, kind) = match Encoding::of(schema) {
            Some(Encoding::Protobuf) => {
                let message = protobuf::message_type(&schema.name, &schema.data)?;
                (protobuf::fields(&message)?, Kind::Protobuf(message))
            }
            Some(Encoding::Json) => {
                let (fields, shape) = json::columns(text)?;
                (fields, Kind::Json(shape))
            }
            Some(Encoding::Ros(version, notation)) => {
                let text = std::str::from_utf8(text).map_err(|e| format!("its schema is no text: {e}"))?;
                let text = match notation {
                    RosNotation::Message => Cow::Borrowed(text),
                    RosNotation::Idl => Cow::Owned(ros_idl::message_definitions(&schema.name, text)?),
                };
                let definition = ros::Definition::parse(&schema.name, &text, version)?;
                (definition.fields()?, Kind::Ros(definition))
            }
            Some(Encoding::Flatbuffer) => {
                let definition = flatbuffer::FlatbufferDefinition::parse(&schema.name, &schema.data)?;
                (definition.fields(), Kind::Flatbuffer(definition))
            }
            None => {
                let (messages, encoding) = (&schema.messages, &schema.encoding);
                return Err(format!(
                    "messages in `{messages}` with a schema in `{encoding}` are not known, but {KNOWN}"
                ));
            }
        };
        // Whatever a schema promises, files of another one may lack a column.
        let fields = fields.iter().map(|f| f.as_ref().clone().with_nullable(true)).collect();
        Ok(Self { fields, kind })
    }

    /// The layout of messages that are not decoded: they have rows, and no columns of their own.
    pub(super) fn without_columns() -> Self {
        Self { fields: Fields::empty(), kind: Kind::Unknown }
    }

    /// Returns true if messages with such a schema can be decoded, unless it is damaged.
    pub(super) fn is_known(schema: &RawSchema) -> bool {
        Encoding::of(schema).is_some()
    }

    /// A decoder of some of the columns, by their place in `fields`.
    pub(super) fn decoder(&self, wanted: &[usize]) -> Decoder {
        match &self.kind {
            Kind::Protobuf(message) => Decoder::Protobuf(protobuf::Decoder::new(message, &self.fields, wanted)),
            Kind::Json(shape) => Decoder::Json(json::Decoder::new(*shape, &self.fields, wanted)),
            Kind::Ros(definition) => Decoder::Ros(ros::Decoder::new(definition, &self.fields, wanted)),
            Kind::Flatbuffer(definition) => {
                Decoder::Flatbuffer(flatbuffer::FlatbufferDecoder::new(definition, &self.fields, wanted))
            }
            Kind::Unknown => Decoder::None,
        }
    }
}

/// An encoding of messages, together with that of their schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Encoding {
    Protobuf,
    Json,
    Ros(RosVersion, RosNotation),
    Flatbuffer,
}

/// Notation of ROS' message definitions.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RosNotation {
    Message,
    Idl,
}

impl Encoding {
    fn of(schema: &RawSchema) -> Option<Self> {
        Some(match (schema.messages.as_str(), schema.encoding.as_str()) {
            ("protobuf", "protobuf") => Self::Protobuf,
            ("json", "jsonschema" | "") => Self::Json,
            ("flatbuffer", "flatbuffer") => Self::Flatbuffer,
            ("cdr", "ros2msg") => Self::Ros(RosVersion::Two, RosNotation::Message),
            ("cdr", "ros2idl") => Self::Ros(RosVersion::Two, RosNotation::Idl),
            ("ros1", "ros1msg") => Self::Ros(RosVersion::One, RosNotation::Message),
            _ => return None,
        })
    }
}

/// Fills columns with messages.
pub(super) enum Decoder {
    Protobuf(protobuf::Decoder),
    Json(json::Decoder),
    Ros(ros::Decoder),
    Flatbuffer(flatbuffer::FlatbufferDecoder),
    /// Passes messages over.
    None,
}

impl Decoder {
    /// Adds a message as one row. After an error it is of no more use.
    pub(super) fn push(&mut self, data: &[u8]) -> Result<(), Malformed> {
        match self {
            Self::Protobuf(decoder) => decoder.push(data),
            Self::Json(decoder) => decoder.push(data),
            Self::Ros(decoder) => decoder.push(data),
            Self::Flatbuffer(decoder) => decoder.push(data),
            Self::None => Ok(()),
        }
    }

    /// What the rows since the last [`Self::finish`] take, roughly.
    pub(super) fn bytes(&self) -> usize {
        match self {
            Self::Protobuf(decoder) => decoder.spent.bytes(),
            Self::Json(decoder) => decoder.spent.bytes(),
            Self::Ros(decoder) => decoder.spent.bytes(),
            Self::Flatbuffer(decoder) => decoder.spent.bytes(),
            Self::None => 0,
        }
    }

    /// Takes the number of values since the last call that are null because they are not of their column's type.
    pub(super) fn take_unfit(&mut self) -> usize {
        match self {
            Self::Json(decoder) => std::mem::take(&mut decoder.unfit),
            Self::Protobuf(_) | Self::Ros(_) | Self::Flatbuffer(_) | Self::None => 0,
        }
    }

    /// The rows so far, by column; it begins anew.
    pub(super) fn finish(&mut self) -> Result<Vec<ArrayRef>, ArrowError> {
        let columns = match self {
            Self::Protobuf(decoder) => decoder.columns(),
            Self::Json(decoder) => decoder.columns(),
            Self::Ros(decoder) => decoder.columns(),
            Self::Flatbuffer(decoder) => decoder.columns(),
            Self::None => &mut [],
        };
        columns.iter_mut().map(super::column::Column::finish).collect()
    }
}
