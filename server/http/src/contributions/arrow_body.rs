//! Rows that clients send as an Arrow stream. Nothing in a stream is trusted: its messages are verified, every length
//! is checked against the bytes that came before anything is allocated, and a column has one of the plain types that
//! its table can store. The library's own reader panics, or allocates what a stream claims.

use std::sync::Arc;
use std::vec;

use arrow::array::{Array as _, ArrayData, ArrayRef, AsArray as _, make_array};
use arrow::buffer::Buffer;
use arrow::compute::{CastOptions, cast_with_options, concat_batches};
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use arrow::error::ArrowError;
use arrow::ipc;
use arrow::record_batch::{RecordBatch, RecordBatchOptions};
use bytes::Bytes;
use echolake_schema::escape_controls;
use echolake_service::RequestFault;

/// Most bytes of a message's description; that of a stream has a few per column, and what pandas writes about itself.
const MOST_METADATA: usize = 128 << 10;
/// Before the length of a message; streams of before 2019 have none.
const CONTINUATION: [u8; 4] = [0xff; 4];
/// The beginning of Arrow's file format.
const FILE_MAGIC: &[u8] = b"ARROW1";
/// Characters of a name that an error text quotes.
const QUOTED_CHARS: usize = 64;

/// A column that a table takes.
#[derive(Debug, Clone)]
pub(super) struct ExpectedColumn {
    pub name: String,
    pub content: ColumnContent,
}

/// The content of a column, and so the types in which it may come.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum ColumnContent {
    /// A name of so many bytes at most: `string`, `large_string` or `string_view`; [`DataType::Utf8`] when read.
    Name { longest: usize },
    /// Integers of any width that fit in 32 bits; [`DataType::Int32`] when read.
    Integers,
    /// Numbers, floating or whole; [`DataType::Float64`] when read.
    Numbers,
}

/// Decodes the rows of a stream: columns in its order, each in the type of its [`ColumnContent`].
///
/// # Errors
/// [`RequestFault::Request`] if the stream is broken or a column is not as expected, [`RequestFault::TooMuch`] if it
/// has more than `most_rows` rows.
pub(super) fn decode_arrow_body(
    body: &Bytes,
    expected: &[ExpectedColumn],
    most_rows: usize,
) -> Result<RecordBatch, RequestFault> {
    let mut messages = MessageReader { bytes: Buffer::from(body.clone()), at: 0 };
    let mut stream: Option<StreamSchema> = None;
    let mut batches = Vec::new();
    let mut rows = 0;
    while let Some(metadata) = messages.next_metadata()? {
        let message = ipc::root_as_message(&metadata).map_err(|e| {
            let cause = e.to_string();
            messages.broken(format!("its description is damaged: {}", cause.lines().next().unwrap_or_default()))
        })?;
        if !(ipc::MetadataVersion::V4..=ipc::MetadataVersion::V5).contains(&message.version()) {
            return Err(messages.broken("its version is not 4 or 5 of the format"));
        }
        let data = messages.take_bytes(message.bodyLength())?;
        match (&stream, message.header_as_schema(), message.header_as_record_batch()) {
            (None, Some(schema), _) => stream = Some(StreamSchema::from_message(schema, expected)?),
            (Some(stream), _, Some(batch)) => {
                let count = messages.checked_length(batch.length(), "rows")?;
                rows += count;
                if rows > most_rows {
                    return Err(RequestFault::TooMuch { what: "rows", limit: most_rows });
                }
                batches.push(stream.read_batch(&messages, batch, &data, count)?);
            }
            _ => {
                let wanted = if stream.is_none() { "the schema" } else { "rows" };
                let kind = message.header_type().variant_name().unwrap_or("unknown");
                return Err(messages.broken(format!("it is {kind}, expected {wanted}")));
            }
        }
    }
    let stream = stream.ok_or_else(|| messages.broken("the stream ends before its schema"))?;
    concat_batches(&stream.schema, &batches).map_err(|e| messages.broken(e.to_string()))
}

/// Takes messages from a stream, one after the other.
struct MessageReader {
    bytes: Buffer,
    at: usize,
}

impl MessageReader {
    /// The description of the next message, aligned; None at the end of the stream.
    fn next_metadata(&mut self) -> Result<Option<Buffer>, RequestFault> {
        if self.bytes.starts_with(FILE_MAGIC) {
            return Err(RequestFault::bad_request(
                "the body is an Arrow file, expected a stream; hint: pyarrow.ipc.new_stream writes one",
            ));
        }
        if self.at == self.bytes.len() && self.at > 0 {
            let message = "the Arrow stream has no end: rows may be missing; hint: close its writer before sending";
            return Err(RequestFault::bad_request(message));
        }
        let mut prefix = self.take_word()?;
        if prefix == CONTINUATION {
            prefix = self.take_word()?;
        }
        let length = i32::from_le_bytes(prefix);
        if length == 0 {
            return match self.bytes.len() - self.at {
                0 => Ok(None),
                more => Err(self.broken(format!("{more} bytes follow the end of the stream"))),
            };
        }
        if i64::from(length) > MOST_METADATA as i64 {
            return Err(self.broken(format!("its description has {length} bytes, expected {MOST_METADATA} at most")));
        }
        let metadata = self.take_bytes(length.into())?;
        Ok(Some(Buffer::from(metadata.as_slice())))
    }

    fn take_word(&mut self) -> Result<[u8; 4], RequestFault> {
        let word = self.take_bytes(4)?;
        word.as_slice().try_into().map_err(|_| RequestFault::Internal)
    }

    fn take_bytes(&mut self, length: i64) -> Result<Buffer, RequestFault> {
        let length = self.checked_length(length, "bytes")?;
        let left = self.bytes.len() - self.at;
        if length > left {
            return Err(self.broken(format!("the stream ends: {left} bytes are left, expected {length}")));
        }
        let taken = self.bytes.slice_with_length(self.at, length);
        self.at += length;
        Ok(taken)
    }

    fn checked_length(&self, length: i64, unit: &str) -> Result<usize, RequestFault> {
        usize::try_from(length).map_err(|_| self.broken(format!("it claims {length} {unit}")))
    }

    fn broken(&self, defect: impl AsRef<str>) -> RequestFault {
        RequestFault::bad_request(format!(
            "the body is no whole Arrow stream: message before byte {}: {}; hint: pyarrow.ipc.new_stream writes one",
            self.at,
            defect.as_ref()
        ))
    }
}

/// The columns of a stream.
struct StreamSchema {
    sent: Vec<(ExpectedColumn, DataType)>,
    schema: SchemaRef,
}

impl StreamSchema {
    fn from_message(schema: ipc::Schema<'_>, expected: &[ExpectedColumn]) -> Result<Self, RequestFault> {
        if schema.endianness() != ipc::Endianness::Little {
            return Err(RequestFault::bad_request("the Arrow stream is big-endian, expected little-endian"));
        }
        let mut sent: Vec<(ExpectedColumn, DataType)> = Vec::new();
        for field in schema.fields().into_iter().flatten() {
            let name = field.name().unwrap_or_default();
            let quoted = quote_name(name);
            let Some(column) = expected.iter().find(|column| column.name == name) else {
                let known: Vec<_> = expected.iter().map(|column| column.name.as_str()).collect();
                return Err(RequestFault::bad_request(format!(
                    "column {quoted} is not one of predictions; hint: they are {}",
                    known.join(", ")
                )));
            };
            if sent.iter().any(|(other, _)| other.name == name) {
                return Err(RequestFault::bad_request(format!("column {quoted} is there twice, expected once")));
            }
            sent.push((column.clone(), column.content.sent_type(field, &quoted)?));
        }
        let fields = sent.iter().map(|(column, _)| Field::new(&column.name, column.content.read_type(), true));
        let schema = Arc::new(Schema::new(fields.collect::<Vec<_>>()));
        Ok(Self { sent, schema })
    }

    fn read_batch(
        &self,
        messages: &MessageReader,
        batch: ipc::RecordBatch<'_>,
        data: &Buffer,
        rows: usize,
    ) -> Result<RecordBatch, RequestFault> {
        if batch.compression().is_some() {
            let message = "the Arrow stream is compressed, expected plain; hint: write it without `compression`";
            return Err(RequestFault::bad_request(message));
        }
        let mut parts = BatchParts {
            data,
            nodes: batch.nodes().into_iter().flatten().copied().collect::<Vec<_>>().into_iter(),
            buffers: batch.buffers().into_iter().flatten().copied().collect::<Vec<_>>().into_iter(),
            counts: batch.variadicBufferCounts().into_iter().flatten().collect::<Vec<_>>().into_iter(),
        };
        let mut columns = Vec::with_capacity(self.sent.len());
        for (column, kind) in &self.sent {
            let array = parts.next_array(kind, rows);
            let array = array.map_err(|defect| messages.broken(format!("column `{}`: {defect}", column.name)))?;
            columns.push(column.read_array(&array)?);
        }
        if parts.nodes.next().is_some() || parts.buffers.next().is_some() || parts.counts.next().is_some() {
            return Err(messages.broken("it has more columns than the schema"));
        }
        let options = RecordBatchOptions::new().with_row_count(Some(rows));
        RecordBatch::try_new_with_options(self.schema.clone(), columns, &options)
            .map_err(|e| messages.broken(e.to_string()))
    }
}

/// The parts of a batch that are not read yet.
struct BatchParts<'a> {
    data: &'a Buffer,
    nodes: vec::IntoIter<ipc::FieldNode>,
    buffers: vec::IntoIter<ipc::Buffer>,
    counts: vec::IntoIter<i64>,
}

impl BatchParts<'_> {
    fn next_array(&mut self, kind: &DataType, rows: usize) -> Result<ArrayRef, String> {
        let node = self.nodes.next().ok_or("it is missing")?;
        let [length, nulls] = [node.length(), node.null_count()];
        if usize::try_from(length) != Ok(rows) || !(0..=length).contains(&nulls) {
            return Err(format!("it has {length} rows, {nulls} of them null, expected {rows} rows"));
        }
        let bitmap = self.next_buffer(if nulls > 0 { rows.div_ceil(8) } else { 0 })?;
        let (width, more_buffers) = match kind {
            DataType::Utf8 => (size_of::<i32>(), 1),
            DataType::LargeUtf8 => (size_of::<i64>(), 1),
            DataType::Utf8View => (size_of::<u128>(), self.counts.next().ok_or("it names no buffers")?),
            numbers => (numbers.primitive_width().unwrap_or_default(), 0),
        };
        let numbers = match kind {
            // One more end than texts; none without texts.
            DataType::Utf8 | DataType::LargeUtf8 if rows > 0 => rows + 1,
            _ => rows,
        };
        // The library takes whole numbers only: what is behind them is cut off.
        let bytes = numbers.saturating_mul(width);
        let mut buffers = vec![self.next_buffer(bytes)?.slice_with_length(0, bytes)];
        for _ in 0..more_buffers {
            buffers.push(self.next_buffer(0)?);
        }
        // Validated by the library: lengths, offsets, texts and the number of nulls.
        let array = ArrayData::builder(kind.clone())
            .len(rows)
            .null_count(nulls as usize)
            .null_bit_buffer((nulls > 0).then_some(bitmap))
            .buffers(buffers)
            .align_buffers(true)
            .build();
        array.map(make_array).map_err(|e| e.to_string())
    }

    // The next buffer, which has so many bytes at least.
    fn next_buffer(&mut self, bytes: usize) -> Result<Buffer, String> {
        let place = self.buffers.next().ok_or("a buffer is missing")?;
        let (offset, length) = (place.offset(), place.length());
        let end = self.data.len();
        match (usize::try_from(offset), usize::try_from(length)) {
            (Ok(from), Ok(size)) if size >= bytes && from.checked_add(size).is_some_and(|to| to <= end) => {
                Ok(self.data.slice_with_length(from, size))
            }
            _ => Err(format!(
                "a buffer has {length} bytes from byte {offset} on, expected {bytes} at least, within {end}"
            )),
        }
    }
}

impl ExpectedColumn {
    // Turns what came into the type that is read.
    fn read_array(&self, array: &ArrayRef) -> Result<ArrayRef, RequestFault> {
        let name = &self.name;
        if let ColumnContent::Name { longest } = self.content {
            // Many views may share one text, which a cast would repeat.
            let found = longest_text(array);
            if found > longest {
                return Err(RequestFault::bad_request(format!(
                    "column `{name}` has a text of {found} bytes, expected {longest} at most"
                )));
            }
        }
        let options = CastOptions { safe: false, ..CastOptions::default() };
        cast_with_options(array, &self.content.read_type(), &options).map_err(|e: ArrowError| {
            let (expected, _) = self.content.expected_types();
            RequestFault::bad_request(format!(
                "column `{name}` has a value that does not fit, expected {expected}: {e}"
            ))
        })
    }
}

impl ColumnContent {
    fn read_type(self) -> DataType {
        match self {
            Self::Name { .. } => DataType::Utf8,
            Self::Integers => DataType::Int32,
            Self::Numbers => DataType::Float64,
        }
    }

    // The types that fit, and the one of them to which pyarrow casts.
    fn expected_types(self) -> (&'static str, &'static str) {
        match self {
            Self::Name { .. } => ("string", "string"),
            Self::Integers => ("an integer type of 32 bits", "int32"),
            Self::Numbers => ("double, or another type of numbers", "float64"),
        }
    }

    // The type of a field of the stream, if this content may come in it.
    fn sent_type(self, field: ipc::Field<'_>, quoted: &str) -> Result<DataType, RequestFault> {
        let is_fit = |kind: &DataType| match self {
            Self::Name { .. } => !kind.is_numeric(),
            Self::Integers => kind.is_integer(),
            Self::Numbers => kind.is_numeric(),
        };
        plain_type(field).filter(is_fit).ok_or_else(|| {
            let (expected, cast) = self.expected_types();
            RequestFault::bad_request(format!(
                "column {quoted} is {}, expected {expected}; hint: pyarrow's `column.cast(\"{cast}\")`",
                type_name(field)
            ))
        })
    }
}

// A text or a number: the only types that any column may have. The library panics at those that it does not know.
fn plain_type(field: ipc::Field<'_>) -> Option<DataType> {
    let is_plain = match field.type_type() {
        _ if field.dictionary().is_some() => false,
        ipc::Type::Utf8 | ipc::Type::LargeUtf8 | ipc::Type::Utf8View => true,
        ipc::Type::Int => [8, 16, 32, 64].contains(&field.type_as_int()?.bitWidth()),
        ipc::Type::FloatingPoint => field.type_as_floating_point()?.precision().variant_name().is_some(),
        _ => false,
    };
    is_plain.then(|| Field::from(field).data_type().clone())
}

fn type_name(field: ipc::Field<'_>) -> String {
    if field.dictionary().is_some() {
        return "dictionary-encoded (categorical)".to_owned();
    }
    match plain_type(field) {
        Some(kind) => kind.to_string(),
        None => field.type_type().variant_name().unwrap_or("of an unknown type").to_owned(),
    }
}

fn longest_text(array: &ArrayRef) -> usize {
    let longest = match array.data_type() {
        DataType::Utf8 => array.as_string::<i32>().iter().flatten().map(str::len).max(),
        DataType::LargeUtf8 => array.as_string::<i64>().iter().flatten().map(str::len).max(),
        _ => array.as_string_view().iter().flatten().map(str::len).max(),
    };
    longest.unwrap_or(0)
}

// A name that somebody chose, for an error text.
fn quote_name(name: &str) -> String {
    let start: String = name.chars().take(QUOTED_CHARS).collect();
    let rest = if start.len() < name.len() { "..." } else { "" };
    format!("`{}{rest}`", escape_controls(&start))
}

#[cfg(test)]
mod tests;
