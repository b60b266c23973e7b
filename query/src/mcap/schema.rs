//! What a channel's schema says of its messages: their columns, and the decoder that fills them.

use arrow::array::ArrayRef;
use arrow::datatypes::Fields;
use arrow::error::ArrowError;
use prost_reflect::MessageDescriptor;

use super::error::Malformed;
use super::{json, protobuf, ros2};

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
    Ros2(ros2::Definition),
}

impl Layout {
    /// Understands a schema; the text of an error says what is wrong with it.
    pub(super) fn new(schema: &RawSchema) -> Result<Self, String> {
        let (fields, kind) = match (schema.messages.as_str(), schema.encoding.as_str()) {
            ("protobuf", "protobuf") => {
                let message = protobuf::message_type(&schema.name, &schema.data)?;
                (protobuf::fields(&message)?, Kind::Protobuf(message))
            }
            ("json", "jsonschema" | "") => {
                let (fields, shape) = json::columns(&schema.data)?;
                (fields, Kind::Json(shape))
            }
            ("cdr", "ros2msg") => {
                let text = std::str::from_utf8(&schema.data).map_err(|e| format!("its schema is no text: {e}"))?;
                let definition = ros2::Definition::parse(&schema.name, text)?;
                (definition.fields()?, Kind::Ros2(definition))
            }
            (messages, encoding) => {
                let known = "protobuf, json with jsonschema, and cdr with ros2msg";
                return Err(format!(
                    "messages in `{messages}` with a schema in `{encoding}` are not known, but {known}"
                ));
            }
        };
        // Whatever a schema promises, files of another one may lack a column.
        let fields = fields.iter().map(|f| f.as_ref().clone().with_nullable(true)).collect();
        Ok(Self { fields, kind })
    }

    /// A decoder of some of the columns, by their place in `fields`.
    pub(super) fn decoder(&self, wanted: &[usize]) -> Decoder {
        match &self.kind {
            Kind::Protobuf(message) => Decoder::Protobuf(protobuf::Decoder::new(message, &self.fields, wanted)),
            Kind::Json(shape) => Decoder::Json(json::Decoder::new(*shape, &self.fields, wanted)),
            Kind::Ros2(definition) => Decoder::Ros2(ros2::Decoder::new(definition, &self.fields, wanted)),
        }
    }
}

/// Fills columns with messages.
pub(super) enum Decoder {
    Protobuf(protobuf::Decoder),
    Json(json::Decoder),
    Ros2(ros2::Decoder),
}

impl Decoder {
    /// Adds a message as one row. After an error it is of no more use.
    pub(super) fn push(&mut self, data: &[u8]) -> Result<(), Malformed> {
        match self {
            Self::Protobuf(decoder) => decoder.push(data),
            Self::Json(decoder) => decoder.push(data),
            Self::Ros2(decoder) => decoder.push(data),
        }
    }

    /// What the rows since the last [`Self::finish`] take, roughly.
    pub(super) fn bytes(&self) -> usize {
        match self {
            Self::Protobuf(decoder) => decoder.spent.bytes(),
            Self::Json(decoder) => decoder.spent.bytes(),
            Self::Ros2(decoder) => decoder.spent.bytes(),
        }
    }

    /// The rows so far, by column; it begins anew.
    pub(super) fn finish(&mut self) -> Result<Vec<ArrayRef>, ArrowError> {
        let columns = match self {
            Self::Protobuf(decoder) => decoder.columns(),
            Self::Json(decoder) => decoder.columns(),
            Self::Ros2(decoder) => decoder.columns(),
        };
        columns.iter_mut().map(super::column::Column::finish).collect()
    }
}
