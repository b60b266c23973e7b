//! `COPY (query) TO STDOUT`: rows as text, CSV or binary, the way drivers fetch much at once. To anywhere else, and
//! from anywhere, is refused.

use std::fmt::Debug;
use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use arrow_pg::encoder::encode_value;
use bytes::Bytes;
use datafusion::sql::sqlparser::ast::{
    CopyLegacyCsvOption, CopyLegacyOption, CopyOption, CopySource, CopyTarget, Ident, Statement as Sql,
};
use echolake_query::Error as QueryError;
use echolake_service::RequestFault;
use echolake_service::running::{AnswerEncoder, RunningQuery};
use futures::{Sink, SinkExt as _};
use pgwire::api::portal::Format;
use pgwire::api::results::{CopyCsvOptions, CopyEncoder, CopyTextOptions, FieldInfo, Tag};
use pgwire::error::{PgWireError, PgWireResult};
use pgwire::messages::PgWireBackendMessage;
use pgwire::messages::copy::{CopyData, CopyDone, CopyOutResponse};

use super::columns::parse_statement;
use super::rows::{column_fields, encoding_fault, sent_columns, text_fields};
use super::sqlstate::failure;

/// A binary copy without rows: signature, no flags, no extension, and the trailer.
const EMPTY_BINARY: &[u8] = b"PGCOPY\n\xff\r\n\0\0\0\0\0\0\0\0\0\xff\xff";

/// The format of a copy, and what the client asked for instead of the usual.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct CopyForm {
    format: CopyFormat,
    delimiter: Option<char>,
    null: Option<String>,
    quote: Option<char>,
    header: bool,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
enum CopyFormat {
    Binary,
    #[default]
    Text,
    Csv,
}

/// Reads the query that is copied, and how.
///
/// # Errors
/// It is copied to a file or a program, or in a way that is not known.
pub(super) fn read_copy(
    source: CopySource,
    target: &CopyTarget,
    options: Vec<CopyOption>,
    legacy: Vec<CopyLegacyOption>,
) -> Result<(Sql, CopyForm), RequestFault> {
    if *target != CopyTarget::Stdout {
        return Err(RequestFault::Query(QueryError::NotReading { statement: format!("COPY TO {target}") }));
    }
    let mut form = CopyForm::default();
    options.into_iter().try_for_each(|option| form.set_option(option))?;
    legacy.into_iter().try_for_each(|option| form.set_legacy(option))?;
    let query = match source {
        CopySource::Query(query) => Sql::Query(query),
        CopySource::Table { table_name, columns } => {
            let columns: Vec<_> = columns.iter().map(ToString::to_string).collect();
            let columns = if columns.is_empty() { "*".to_owned() } else { columns.join(", ") };
            // Both were parsed as names, and print as such.
            parse_statement(&format!("SELECT {columns} FROM {table_name}"))
                .ok_or_else(|| RequestFault::bad_request(format!("`{table_name}` cannot be copied")))?
        }
    };
    Ok((query, form))
}

impl CopyForm {
    fn set_option(&mut self, option: CopyOption) -> Result<(), RequestFault> {
        match option {
            CopyOption::Format(format) => {
                self.format = match format.value.to_ascii_lowercase().as_str() {
                    "binary" => CopyFormat::Binary,
                    "csv" => CopyFormat::Csv,
                    "text" => CopyFormat::Text,
                    other => return Err(RequestFault::unsupported(format!("COPY as {other}"))),
                }
            }
            CopyOption::Delimiter(mark) | CopyOption::Quote(mark)
                if !mark.is_ascii() || mark.is_ascii_alphanumeric() || ['\n', '\r', '\0', '\\'].contains(&mark) =>
            {
                return Err(RequestFault::bad_request(format!("{mark:?} cannot separate or quote")));
            }
            CopyOption::Delimiter(mark) => self.delimiter = Some(mark),
            CopyOption::Quote(mark) => self.quote = Some(mark),
            CopyOption::Null(text) => self.null = Some(text),
            CopyOption::Header(header) => self.header = header,
            CopyOption::Encoding(name) if ["utf8", "utf-8"].contains(&name.to_ascii_lowercase().as_str()) => {}
            other => return Err(RequestFault::unsupported(format!("COPY with {other}"))),
        }
        Ok(())
    }

    fn set_legacy(&mut self, option: CopyLegacyOption) -> Result<(), RequestFault> {
        let option = match option {
            CopyLegacyOption::Binary => CopyOption::Format(Ident::new("binary")),
            CopyLegacyOption::Delimiter(mark) => CopyOption::Delimiter(mark),
            CopyLegacyOption::Null(text) => CopyOption::Null(text),
            CopyLegacyOption::Header => CopyOption::Header(true),
            CopyLegacyOption::Csv(options) => {
                for option in options {
                    self.set_option(match option {
                        CopyLegacyCsvOption::Header => CopyOption::Header(true),
                        CopyLegacyCsvOption::Quote(mark) => CopyOption::Quote(mark),
                        other => return Err(RequestFault::unsupported(format!("COPY with {other}"))),
                    })?;
                }
                CopyOption::Format(Ident::new("csv"))
            }
            other => return Err(RequestFault::unsupported(format!("COPY with {other}"))),
        };
        self.set_option(option)
    }

    fn is_binary(&self) -> bool {
        self.format == CopyFormat::Binary
    }

    fn value_format(&self) -> Format {
        if self.is_binary() { Format::UnifiedBinary } else { Format::UnifiedText }
    }

    fn make_encoder(&self, fields: Arc<Vec<FieldInfo>>) -> CopyEncoder {
        let delimiter = |usual: char| self.delimiter.unwrap_or(usual).to_string();
        match self.format {
            CopyFormat::Binary => CopyEncoder::new_binary(fields),
            CopyFormat::Text => {
                let null_string = self.null.as_deref().unwrap_or("\\N").into();
                CopyEncoder::new_text(fields, CopyTextOptions { delimiter: delimiter('\t').into(), null_string })
            }
            CopyFormat::Csv => {
                let quote = self.quote.unwrap_or('"').to_string();
                let options = CopyCsvOptions {
                    delimiter: delimiter(',').into(),
                    quote: quote.as_str().into(),
                    escape: quote.into(),
                    null_string: self.null.as_deref().unwrap_or_default().into(),
                    force_quote: Vec::new(),
                };
                CopyEncoder::new_csv(fields, options)
            }
        }
    }

    // Names of columns, if they are wanted.
    fn header_line(&self, fields: &[FieldInfo]) -> PgWireResult<Option<CopyData>> {
        if !self.header || self.is_binary() {
            return Ok(None);
        }
        let names: Vec<_> = fields.iter().map(FieldInfo::name).collect();
        let mut encoder = self.make_encoder(text_fields(&names));
        names.iter().try_for_each(|name| encoder.encode_field(name))?;
        Ok(Some(encoder.take_copy()))
    }
}

/// Encodes rows to be copied, a message each, as Postgres sends them.
pub(super) struct CopyRowEncoder {
    encoder: CopyEncoder,
    fields: Arc<Vec<FieldInfo>>,
}

impl CopyRowEncoder {
    /// For an answer of these columns.
    pub fn new(schema: &SchemaRef, form: &CopyForm) -> Result<Self, RequestFault> {
        let fields = column_fields(schema, &form.value_format())?;
        Ok(Self { encoder: form.make_encoder(fields.clone()), fields })
    }
}

impl AnswerEncoder for CopyRowEncoder {
    type Item = Vec<CopyData>;

    fn encode_batch(&mut self, batch: RecordBatch) -> Result<Vec<Vec<CopyData>>, RequestFault> {
        let batch = sent_columns(&self.fields, batch)?;
        let schema = batch.schema();
        let mut rows = Vec::with_capacity(batch.num_rows());
        for row in 0..batch.num_rows() {
            for (i, column) in batch.columns().iter().enumerate() {
                encode_value(&mut self.encoder, column, row, schema.field(i), &self.fields[i])
                    .map_err(|e| encoding_fault(&e))?;
            }
            rows.push(self.encoder.take_copy());
        }
        Ok(vec![rows])
    }

    fn encode_end(self) -> Result<Vec<Vec<CopyData>>, RequestFault> {
        Ok(Vec::new())
    }
}

/// Sends a copy to its end.
pub(super) async fn send_copy<C>(
    client: &mut C,
    form: &CopyForm,
    mut running: RunningQuery<Vec<CopyData>>,
) -> PgWireResult<()>
where
    C: Sink<PgWireBackendMessage> + Unpin,
    C::Error: Debug,
    PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
{
    let fields = column_fields(&running.schema, &form.value_format()).map_err(failure)?;
    let code = i16::from(form.is_binary());
    let begin = CopyOutResponse::new(code as i8, fields.len() as i16, vec![code; fields.len()]);
    client.feed(PgWireBackendMessage::CopyOutResponse(begin)).await?;
    if let Some(line) = form.header_line(&fields)? {
        client.feed(PgWireBackendMessage::CopyData(line)).await?;
    }
    let mut count = 0;
    while let Some(rows) = running.next_part().await.map_err(failure)? {
        count += rows.len();
        for row in rows {
            client.feed(PgWireBackendMessage::CopyData(row)).await?;
        }
    }
    if form.is_binary() {
        // The encoder puts the header before its first row.
        let end = match count {
            0 => CopyData::new(Bytes::from_static(EMPTY_BINARY)),
            _ => CopyEncoder::finish_copy_binary(),
        };
        client.feed(PgWireBackendMessage::CopyData(end)).await?;
    }
    client.feed(PgWireBackendMessage::CopyDone(CopyDone::new())).await?;
    client.feed(PgWireBackendMessage::CommandComplete(Tag::new("COPY").with_rows(count).into())).await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(sql: &str) -> Result<(String, CopyForm), String> {
        let Some(Sql::Copy { source, target, options, legacy_options, .. }) = parse_statement(sql) else {
            panic!("{sql} is no COPY");
        };
        let read = read_copy(source, &target, options, legacy_options).map_err(|e| e.to_string())?;
        Ok((read.0.to_string(), read.1))
    }

    #[test]
    fn drivers_forms_are_read() {
        let binary = CopyForm { format: CopyFormat::Binary, ..CopyForm::default() };
        for sql in [
            "COPY (SELECT 1) TO STDOUT WITH BINARY",
            "COPY (SELECT 1) TO STDOUT (FORMAT binary)",
            "COPY (SELECT 1) TO STDOUT (FORMAT \"binary\")",
        ] {
            assert_eq!(check(sql).expect(sql), ("SELECT 1".to_owned(), binary.clone()));
        }
        let text = ("SELECT pair_id FROM pairs".to_owned(), CopyForm::default());
        assert_eq!(check("COPY pairs (pair_id) TO STDOUT").expect("read"), text);
        let csv = CopyForm { format: CopyFormat::Csv, delimiter: Some(';'), header: true, ..CopyForm::default() };
        for sql in [
            "COPY (SELECT 1) TO STDOUT WITH (FORMAT csv, HEADER, DELIMITER ';')",
            "COPY (SELECT 1) TO STDOUT DELIMITER ';' CSV HEADER",
        ] {
            assert_eq!(check(sql).expect(sql).1, csv);
        }
        let line = csv.header_line(&text_fields(&["a;b", "c"])).expect("encoded").expect("a header");
        assert_eq!(line.data.as_ref(), b"\"a;b\";c\n");
    }

    #[test]
    fn nothing_is_copied_elsewhere() {
        for (sql, expected) in [
            ("COPY (SELECT 1) TO '/tmp/x'", "only reading"),
            ("COPY (SELECT 1) TO PROGRAM 'sh'", "only reading"),
            ("COPY (SELECT 1) TO STDOUT (FORMAT parquet)", "COPY as parquet is not supported"),
            ("COPY (SELECT 1) TO STDOUT (FORMAT csv, DELIMITER 'a')", "cannot separate"),
        ] {
            let error = check(sql).expect_err(sql);
            assert!(error.contains(expected), "{sql}: {error}");
        }
    }
}
