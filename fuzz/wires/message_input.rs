//! A message with its schema as one input: length of the type's name, name, length of the schema, schema, message.

use echolake_mcap_tables::EncodedMessage;

/// The parts of an input.
#[derive(Debug, Clone, Copy)]
pub struct MessageInput<'a> {
    /// The message type's name.
    pub type_name: &'a str,
    /// The schema.
    pub schema: &'a [u8],
    /// The message.
    pub data: &'a [u8],
}

impl<'a> MessageInput<'a> {
    /// Takes the parts; None if the input is too short, or the name no text.
    pub fn parse(bytes: &'a [u8]) -> Option<Self> {
        let ([name_bytes], bytes) = bytes.split_first_chunk()?;
        let (name, bytes) = bytes.split_at_checked(usize::from(*name_bytes))?;
        let (schema_bytes, bytes) = bytes.split_first_chunk()?;
        let (schema, data) = bytes.split_at_checked(usize::from(u16::from_le_bytes(*schema_bytes)))?;
        Some(Self { type_name: std::str::from_utf8(name).ok()?, schema, data })
    }

    /// The input of the parts.
    ///
    /// # Panics
    /// The name or the schema is too long.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = vec![u8::try_from(self.type_name.len()).expect("a short name")];
        bytes.extend(self.type_name.bytes());
        bytes.extend(u16::try_from(self.schema.len()).expect("a short schema").to_le_bytes());
        bytes.extend([self.schema, self.data].concat());
        bytes
    }

    /// Returns the message, with its encoding and that of its schema.
    pub fn with_encodings(&self, message_encoding: &'a str, schema_encoding: &'a str) -> EncodedMessage<'a> {
        let Self { type_name, schema, data } = *self;
        EncodedMessage { type_name, schema_encoding, message_encoding, schema, data }
    }
}
