//! `COPY (query) TO STDOUT`: rows as text, CSV or binary, the way drivers fetch much at once. To anywhere else, and from
//! anywhere, is refused.

use std::fmt::Debug;
use std::sync::Arc;

use arrow::datatypes::SchemaRef;
use arrow::record_batch::RecordBatch;
use arrow_pg::encoder::encode_value;
use bytes::Bytes;
use datafusion::sql::sqlparser::ast::{
    CopyLegacyCsvOption, CopyLegacyOption, CopyOption, CopySource, CopyTarget, Statement as Sql,
};
use datafusion::sql::sqlparser::dialect::PostgreSqlDialect;
use datafusion::sql::sqlparser::parser::Parser;
use echolake_query::Error as QueryError;
use futures::{Sink, SinkExt as _};
use pgwire::api::portal::Format;
use pgwire::api::results::{CopyCsvOptions, CopyEncoder, CopyTextOptions, FieldInfo, Tag};
use pgwire::error::{PgWireError, PgWireResult};
use pgwire::messages::PgWireBackendMessage;
use pgwire::messages::copy::{CopyData, CopyDone, CopyOutResponse};

use super::rows::{encoding, fields, sent_columns};
use super::sqlstate::error;
use crate::fault::RequestFault;
use crate::running::{AnswerEncoder, RunningQuery};

/// Header of a binary copy: signature, no flags, no extension.
const BINARY_HEADER: &[u8] = b"PGCOPY\n\xff\r\n\0\0\0\0\0\0\0\0\0";
/// Trailer of a binary copy.
const BINARY_END: &[u8] = &[0xff, 0xff];

/// The format of a copy.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum CopyAs {
    Binary,
    Text { delimiter: String, null: String, header: bool },
    Csv { delimiter: String, null: String, quote: String, header: bool },
}

#[derive(Default)]
struct CopyOptions {
    format: Option<String>,
    delimiter: Option<char>,
    null: Option<String>,
    quote: Option<char>,
    header: bool,
}

/// The query that is copied, and how.
///
/// # Errors
/// It is copied to a file or a program, or in a way that is not known.
pub(super) fn read(
    source: CopySource,
    target: &CopyTarget,
    options: Vec<CopyOption>,
    legacy: Vec<CopyLegacyOption>,
) -> Result<(Sql, CopyAs), RequestFault> {
    if *target != CopyTarget::Stdout {
        return Err(RequestFault::Query(QueryError::NotReading { statement: format!("COPY TO {target}") }));
    }
    let mut read = CopyOptions::default();
    options.into_iter().try_for_each(|option| read.take(option))?;
    legacy.into_iter().try_for_each(|option| read.take_legacy(option))?;
    let query = match source {
        CopySource::Query(query) => Sql::Query(query),
        CopySource::Table { table_name, columns } => {
            let columns: Vec<_> = columns.iter().map(ToString::to_string).collect();
            let columns = if columns.is_empty() { "*".to_owned() } else { columns.join(", ") };
            // Both were parsed as names, and print as such.
            let sql = format!("SELECT {columns} FROM {table_name}");
            let parsed = Parser::parse_sql(&PostgreSqlDialect {}, &sql).ok().and_then(|mut all| all.pop());
            parsed.ok_or_else(|| RequestFault::request(format!("`{table_name}` cannot be copied")))?
        }
    };
    Ok((query, read.form()?))
}

impl CopyOptions {
    fn take(&mut self, option: CopyOption) -> Result<(), RequestFault> {
        match option {
            CopyOption::Format(format) => self.format = Some(format.value.to_ascii_lowercase()),
            CopyOption::Delimiter(c) => self.delimiter = Some(c),
            CopyOption::Null(text) => self.null = Some(text),
            CopyOption::Quote(c) => self.quote = Some(c),
            CopyOption::Header(header) => self.header = header,
            CopyOption::Encoding(name) if ["utf8", "utf-8"].contains(&name.to_ascii_lowercase().as_str()) => {}
            other => return Err(RequestFault::unsupported(format!("COPY with {other}"))),
        }
        Ok(())
    }

    fn take_legacy(&mut self, option: CopyLegacyOption) -> Result<(), RequestFault> {
        match option {
            CopyLegacyOption::Binary => self.format = Some("binary".to_owned()),
            CopyLegacyOption::Delimiter(c) => self.delimiter = Some(c),
            CopyLegacyOption::Null(text) => self.null = Some(text),
            CopyLegacyOption::Header => self.header = true,
            CopyLegacyOption::Csv(options) => {
                self.format = Some("csv".to_owned());
                for option in options {
                    match option {
                        CopyLegacyCsvOption::Header => self.header = true,
                        CopyLegacyCsvOption::Quote(c) => self.quote = Some(c),
                        other => return Err(RequestFault::unsupported(format!("COPY with {other}"))),
                    }
                }
            }
            other => return Err(RequestFault::unsupported(format!("COPY with {other}"))),
        }
        Ok(())
    }

    fn form(self) -> Result<CopyAs, RequestFault> {
        let is_mark = |c: &char| c.is_ascii() && !c.is_ascii_alphanumeric() && !['\n', '\r', '\0', '\\'].contains(c);
        if let Some(wrong) = [self.delimiter, self.quote].iter().flatten().find(|c| !is_mark(c)) {
            return Err(RequestFault::request(format!("{wrong:?} cannot separate or quote")));
        }
        let mark = |given: Option<char>, usual: char| given.unwrap_or(usual).to_string();
        match self.format.as_deref() {
            Some("binary") => Ok(CopyAs::Binary),
            Some("csv") => Ok(CopyAs::Csv {
                delimiter: mark(self.delimiter, ','),
                null: self.null.unwrap_or_default(),
                quote: mark(self.quote, '"'),
                header: self.header,
            }),
            None | Some("text") => Ok(CopyAs::Text {
                delimiter: mark(self.delimiter, '\t'),
                null: self.null.unwrap_or_else(|| "\\N".to_owned()),
                header: self.header,
            }),
            Some(other) => Err(RequestFault::unsupported(format!("COPY as {other}"))),
        }
    }
}

impl CopyAs {
    fn format(&self) -> Format {
        if *self == Self::Binary { Format::UnifiedBinary } else { Format::UnifiedText }
    }

    // Names of columns, if they are wanted.
    fn first_line(&self, fields: &[FieldInfo]) -> Option<Bytes> {
        let names = |delimiter: &str, quoted: &dyn Fn(&str) -> String| {
            let names: Vec<_> = fields.iter().map(|f| quoted(f.name())).collect();
            Some(Bytes::from(names.join(delimiter) + "\n"))
        };
        match self {
            Self::Text { delimiter, header: true, .. } => {
                names(delimiter, &|name| name.replace('\\', "\\\\").replace('\t', "\\t").replace('\n', "\\n"))
            }
            Self::Csv { delimiter, quote, header: true, .. } => names(delimiter, &|name| match name
                .contains([',', '"', '\n', '\r'])
                || name.contains(&**delimiter)
                || name.contains(&**quote)
            {
                true => format!("{quote}{}{quote}", name.replace(&**quote, &quote.repeat(2))),
                false => name.to_owned(),
            }),
            _ => None,
        }
    }
}

/// Encodes rows to be copied, a message each, as Postgres sends them.
pub(super) struct CopyRowEncoder {
    encoder: CopyEncoder,
    fields: Arc<Vec<FieldInfo>>,
}

impl CopyRowEncoder {
    /// For an answer of these columns.
    pub(super) fn new(schema: &SchemaRef, form: &CopyAs) -> Result<Self, RequestFault> {
        let fields = fields(schema, &form.format())?;
        let encoder = match form {
            CopyAs::Binary => CopyEncoder::new_binary(fields.clone()),
            CopyAs::Text { delimiter, null, .. } => {
                let options = CopyTextOptions { delimiter: delimiter.into(), null_string: null.into() };
                CopyEncoder::new_text(fields.clone(), options)
            }
            CopyAs::Csv { delimiter, null, quote, .. } => {
                let options = CopyCsvOptions {
                    delimiter: delimiter.into(),
                    quote: quote.into(),
                    escape: quote.into(),
                    null_string: null.into(),
                    force_quote: Vec::new(),
                };
                CopyEncoder::new_csv(fields.clone(), options)
            }
        };
        Ok(Self { encoder, fields })
    }
}

impl AnswerEncoder for CopyRowEncoder {
    type Item = Vec<CopyData>;

    fn batch(&mut self, batch: RecordBatch) -> Result<Vec<Vec<CopyData>>, RequestFault> {
        let batch = sent_columns(&self.fields, batch)?;
        let schema = batch.schema();
        let mut rows = Vec::with_capacity(batch.num_rows());
        for row in 0..batch.num_rows() {
            for (i, column) in batch.columns().iter().enumerate() {
                encode_value(&mut self.encoder, column, row, schema.field(i), &self.fields[i])
                    .map_err(|e| encoding(&e))?;
            }
            rows.push(self.encoder.take_copy());
        }
        Ok(vec![rows])
    }

    fn end(self) -> Result<Vec<Vec<CopyData>>, RequestFault> {
        Ok(Vec::new())
    }
}

/// Sends a copy to its end.
pub(super) async fn send<C>(client: &mut C, form: &CopyAs, mut running: RunningQuery<Vec<CopyData>>) -> PgWireResult<()>
where
    C: Sink<PgWireBackendMessage> + Unpin,
    C::Error: Debug,
    PgWireError: From<<C as Sink<PgWireBackendMessage>>::Error>,
{
    let fields = fields(&running.schema, &form.format()).map_err(|fault| error(&fault))?;
    let code = i16::from(*form == CopyAs::Binary);
    let begin = CopyOutResponse::new(code as i8, fields.len() as i16, vec![code; fields.len()]);
    client.feed(PgWireBackendMessage::CopyOutResponse(begin)).await?;
    let mut data = async |bytes: Bytes| client.feed(PgWireBackendMessage::CopyData(CopyData::new(bytes))).await;
    if let Some(line) = form.first_line(&fields) {
        data(line).await?;
    }
    let mut count = 0;
    while let Some(rows) = running.next().await.map_err(|fault| error(&fault))? {
        count += rows.len();
        for row in rows {
            data(row.data).await?;
        }
    }
    if *form == CopyAs::Binary {
        // The encoder puts the header before its first row.
        data(if count == 0 { [BINARY_HEADER, BINARY_END].concat().into() } else { Bytes::from_static(BINARY_END) })
            .await?;
    }
    client.feed(PgWireBackendMessage::CopyDone(CopyDone::new())).await?;
    client.feed(PgWireBackendMessage::CommandComplete(Tag::new("COPY").with_rows(count).into())).await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(sql: &str) -> Result<(String, CopyAs), String> {
        let mut statements = Parser::parse_sql(&PostgreSqlDialect {}, sql).expect(sql);
        let Some(Sql::Copy { source, target, options, legacy_options, .. }) = statements.pop() else {
            panic!("{sql} is no COPY");
        };
        let read = read(source, &target, options, legacy_options).map_err(|e| e.to_string())?;
        Ok((read.0.to_string(), read.1))
    }

    #[test]
    fn drivers_forms_are_read() {
        let binary = ("SELECT 1".to_owned(), CopyAs::Binary);
        for sql in [
            "COPY (SELECT 1) TO STDOUT WITH BINARY",
            "COPY (SELECT 1) TO STDOUT (FORMAT binary)",
            "COPY (SELECT 1) TO STDOUT (FORMAT \"binary\")",
        ] {
            assert_eq!(check(sql).expect(sql), binary);
        }
        let text = CopyAs::Text { delimiter: "\t".to_owned(), null: "\\N".to_owned(), header: false };
        assert_eq!(
            check("COPY pairs (pair_id) TO STDOUT").expect("read"),
            ("SELECT pair_id FROM pairs".to_owned(), text)
        );
        let csv = check("COPY (SELECT 1) TO STDOUT WITH (FORMAT csv, HEADER, DELIMITER ';')").expect("read").1;
        assert!(matches!(csv, CopyAs::Csv { delimiter, header: true, .. } if delimiter == ";"));
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
