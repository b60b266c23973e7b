//! Decoders of messages for fuzz targets, which give them schemas and messages without a file around them.

use super::encodings::{MessageLayout, RawSchema};

/// A message with its channel's schema.
#[derive(Debug, Clone, Copy)]
pub struct EncodedMessage<'a> {
    /// The message type's name.
    pub type_name: &'a str,
    /// The encoding of the schema, such as `ros2msg`.
    pub schema_encoding: &'a str,
    /// The encoding of the message, such as `cdr`.
    pub message_encoding: &'a str,
    /// The schema.
    pub schema: &'a [u8],
    /// The message.
    pub data: &'a [u8],
}

impl EncodedMessage<'_> {
    /// Decodes the message twice, once with all columns and once with every other one, and returns the number of
    /// columns; None if the schema or the message is refused.
    ///
    /// # Panics
    /// A column has not one row per message.
    pub fn decode(&self) -> Option<usize> {
        let schema = RawSchema {
            name: self.type_name.to_owned(),
            encoding: self.schema_encoding.to_owned(),
            messages: self.message_encoding.to_owned(),
            data: self.schema.to_vec(),
        };
        let layout = MessageLayout::from_schema(&schema).ok()?;
        for step in [1, 2] {
            let wanted: Vec<usize> = (0..layout.fields.len()).step_by(step).collect();
            let mut decoder = layout.decoder(&wanted);
            decoder.push(self.data).ok()?;
            decoder.push(self.data).ok()?;
            let columns = decoder.finish().ok()?;
            assert_eq!(columns.len(), wanted.len());
            assert!(columns.iter().all(|column| column.len() == 2), "{:?}", layout.fields);
        }
        Some(layout.fields.len())
    }
}
