//! Encodings of messages: each makes columns of a channel's schema, and rows of its messages. One more is a folder here
//! and a line in [`ENCODINGS`].

mod json;
mod protobuf;
mod ros2;

use std::fmt;

use arrow::array::ArrayRef;
use arrow::datatypes::Fields;
use arrow::error::ArrowError;

use super::column::{Column, Record, value_width};

/// The encodings whose messages have columns.
static ENCODINGS: [&dyn MessageEncoding; 3] = [&protobuf::ProtobufEncoding, &json::JsonEncoding, &ros2::Ros2Encoding];

/// A channel's schema as it is in the file.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub(super) struct RawSchema {
    /// The message type's name.
    pub name: String,
    /// The encoding of `data`, such as `protobuf`, `jsonschema` or `ros2msg`; empty if there is no schema.
    pub encoding: String,
    /// The encoding of the messages, such as `protobuf`, `json` or `cdr`.
    pub messages: String,
    pub data: Vec<u8>,
}

/// An encoding of messages.
trait MessageEncoding: Sync {
    /// Returns the encodings of messages that it reads, each with that of their schema.
    fn encoding_names(&self) -> &'static [(&'static str, &'static str)];

    /// Returns true if it reads messages with such a schema, unless the schema is damaged.
    fn supports_schema(&self, channel: &RawSchema) -> bool {
        self.encoding_names().contains(&(&channel.messages, &channel.encoding))
    }

    /// Parses a schema that it supports into the columns of a message, and what decodes them. The text of an error is
    /// the defect of the schema.
    fn parse_schema(&self, channel: &RawSchema) -> Result<(Fields, Box<dyn MessageType>), String>;
}

/// A parsed schema.
trait MessageType: fmt::Debug + Send + Sync {
    /// Returns a decoder of the columns at `wanted`, which are `fields`.
    fn create_decoder(&self, wanted: &[usize], fields: &Fields) -> Box<dyn MessageDecoder>;
}

/// Decodes messages of one type.
trait MessageDecoder: Send {
    /// Adds the values of a message to the columns, one to each.
    fn decode_message(&mut self, message: &[u8], columns: &mut [Column], tally: &mut RowTally)
    -> Result<(), Malformed>;
}

/// The reason why bytes are no message of their schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(super) enum Malformed {
    #[error("it ends within a value")]
    Ends,
    #[error("it expands to more than {} MiB", RowTally::MOST_BYTES >> 20)]
    Expands,
    #[error("{0}")]
    Invalid(&'static str),
}

/// Memory of the rows under construction, roughly, and their values that do not fit.
#[derive(Debug, Default)]
pub(super) struct RowTally {
    bytes: usize,
    /// Values that are null because they are not of their column's type.
    unfit: usize,
}

impl RowTally {
    /// No batch of rows may take more, so that offsets fit 32 bits and a hostile message does not fill the memory.
    const MOST_BYTES: usize = 512 << 20;

    fn add_bytes(&mut self, bytes: usize) -> Result<(), Malformed> {
        self.bytes = self.bytes.saturating_add(bytes);
        if self.bytes <= Self::MOST_BYTES { Ok(()) } else { Err(Malformed::Expands) }
    }
}

/// The columns of a schema's messages.
#[derive(Debug)]
pub(super) struct MessageLayout {
    pub fields: Fields,
    /// None if messages are not decoded.
    message_type: Option<Box<dyn MessageType>>,
}

impl MessageLayout {
    /// Parses a schema. The text of an error is its defect.
    pub fn from_schema(schema: &RawSchema) -> Result<Self, String> {
        let encoding = find_encoding(schema).ok_or_else(|| describe_unknown(schema))?;
        let (fields, message_type) = encoding.parse_schema(schema)?;
        // Whatever a schema promises, files of another one may lack a column.
        let fields = fields.iter().map(|f| f.as_ref().clone().with_nullable(true)).collect();
        Ok(Self { fields, message_type: Some(message_type) })
    }

    /// Returns the layout of messages that are not decoded: they have rows, and no columns of their own.
    pub fn without_columns() -> Self {
        Self { fields: Fields::empty(), message_type: None }
    }

    /// Returns a decoder of the columns at `wanted`.
    pub fn create_decoder(&self, wanted: &[usize]) -> RowDecoder {
        let fields: Fields = wanted.iter().map(|i| self.fields[*i].clone()).collect();
        let width = fields.iter().map(|f| value_width(f.data_type())).sum();
        let decoder = self.message_type.as_ref().map(|message_type| message_type.create_decoder(wanted, &fields));
        RowDecoder { decoder, columns: Record::new(&fields).columns, width, tally: RowTally::default() }
    }
}

/// Returns true if messages with such a schema can be decoded, unless the schema is damaged.
pub(super) fn is_supported(schema: &RawSchema) -> bool {
    find_encoding(schema).is_some()
}

fn find_encoding(schema: &RawSchema) -> Option<&'static dyn MessageEncoding> {
    ENCODINGS.into_iter().find(|encoding| encoding.supports_schema(schema))
}

fn describe_unknown(schema: &RawSchema) -> String {
    let names = ENCODINGS.iter().flat_map(|encoding| encoding.encoding_names());
    let known: Vec<_> = names.map(|(messages, schema)| describe_names(messages, schema)).collect();
    let actual = describe_names(&schema.messages, &schema.encoding);
    format!("its messages are {actual}, which is not decoded; decoded are {}", known.join(", "))
}

fn describe_names(messages: &str, schema: &str) -> String {
    match schema {
        "" => format!("`{messages}` without a schema"),
        _ => format!("`{messages}` with a schema in `{schema}`"),
    }
}

/// Fills columns with messages.
pub(super) struct RowDecoder {
    decoder: Option<Box<dyn MessageDecoder>>,
    columns: Vec<Column>,
    /// Bytes that a row takes whatever its message holds.
    width: usize,
    tally: RowTally,
}

impl RowDecoder {
    /// Adds a message as one row. After an error it is of no more use.
    pub fn push_message(&mut self, message: &[u8]) -> Result<(), Malformed> {
        self.tally.add_bytes(self.width)?;
        match &mut self.decoder {
            Some(decoder) => decoder.decode_message(message, &mut self.columns, &mut self.tally),
            None => Ok(()),
        }
    }

    /// Returns the bytes of the rows since the last [`Self::finish`], roughly.
    pub fn buffered_bytes(&self) -> usize {
        self.tally.bytes
    }

    /// Takes the number of values since the last call that are null because they are not of their column's type.
    pub fn take_unfit(&mut self) -> usize {
        std::mem::take(&mut self.tally.unfit)
    }

    /// Returns the rows so far, by column, and begins again without any.
    pub fn finish(&mut self) -> Result<Vec<ArrayRef>, ArrowError> {
        self.tally.bytes = 0;
        self.columns.iter_mut().map(Column::finish).collect()
    }
}

/// Removes the start of some texts in UTF-8, which is no part of them.
fn strip_byte_order_mark(text: &[u8]) -> &[u8] {
    text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text)
}
