//! `query`: as many rows as an agent can read.

use std::sync::Arc;

use arrow::datatypes::{FieldRef, SchemaRef};
use arrow::record_batch::RecordBatch;
use echolake_query::EngineClient;
use echolake_query::output::{AnswerFormat, AnswerWriter};
use echolake_schema::tables::UNIT;
use echolake_service::running::AnswerEncoder;
use echolake_service::{QueryWork, RequestFault};
use serde_json::{Map, Value, json};

use super::tools::{MOST_BYTES, MOST_ROWS, ToolCall, USUAL_ROWS};
use crate::request_protocol::http_job;

/// Rows that are encoded at once, because one may be long.
const PART_ROWS: usize = 16;

impl ToolCall<'_> {
    /// Runs a query.
    ///
    /// # Errors
    /// A defect of the statement, or the cause of its end.
    pub async fn run_query(
        &self,
        client: &Arc<EngineClient>,
        sql: String,
        max_rows: Option<u64>,
    ) -> Result<Value, RequestFault> {
        let most = max_rows.unwrap_or(USUAL_ROWS);
        if !(1..=MOST_ROWS).contains(&most) {
            let message = format!("`max_rows` is {most}; hint: 1 to {MOST_ROWS}, or sums and means in SQL");
            return Err(RequestFault::bad_request(message));
        }
        let service = self.agents.catalogue.service();
        let job = http_job(Arc::new(service.begin_session(client)), QueryWork::Sql(sql));
        let most = usize::try_from(most).unwrap_or(usize::MAX);
        let mut running = service.begin_query(job, move |schema| Ok(CappedRows::new(schema, most))).await?;
        let mut rows = Vec::new();
        let mut end = AnswerEnd::Whole;
        let schema = running.schema.clone();
        while end == AnswerEnd::Whole
            && let Some(page) = running.next_part().await?
        {
            rows.extend(page.rows);
            end = page.end;
        }
        running.finish_early();
        let column = |field: &FieldRef| {
            let mut column = json!({ "name": field.name(), "type": field.data_type().to_string() });
            if let Some(unit) = field.metadata().get(UNIT).filter(|unit| !unit.is_empty()) {
                column["unit"] = unit.as_str().into();
            }
            column
        };
        let columns: Vec<_> = schema.fields().iter().map(column).collect();
        let mut answer = json!({ "columns": columns, "row_count": rows.len(), "truncated": end != AnswerEnd::Whole });
        if let Some(note) = end.truncation_note(most) {
            answer["note"] = note.into();
        }
        answer["rows"] = rows.into();
        Ok(answer)
    }
}

/// Reason that an answer ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AnswerEnd {
    Whole,
    Rows,
    Bytes,
}

impl AnswerEnd {
    fn truncation_note(self, most_rows: usize) -> Option<String> {
        let instead = "hint: aggregate or filter in SQL, or POST /api/v1/sql for all rows";
        match self {
            Self::Whole => None,
            Self::Rows => Some(format!("there are more rows than max_rows = {most_rows}; {instead}")),
            Self::Bytes => Some(format!("the rows that follow pass {MOST_BYTES} bytes; {instead}")),
        }
    }
}

/// Encodes rows up to a number and a size.
struct CappedRows {
    schema: SchemaRef,
    rows_left: usize,
    bytes_left: usize,
}

/// Some rows of an answer.
struct RowPage {
    rows: Vec<Value>,
    end: AnswerEnd,
}

impl CappedRows {
    fn new(schema: &SchemaRef, most_rows: usize) -> Self {
        Self { schema: schema.clone(), rows_left: most_rows, bytes_left: MOST_BYTES }
    }

    fn row_lists(&self, part: &RecordBatch) -> Result<Vec<Value>, RequestFault> {
        let mut text = Vec::new();
        let mut writer = AnswerWriter::new(AnswerFormat::Json, &self.schema, &mut text)?;
        writer.write(part)?;
        writer.finish()?;
        let objects: Vec<Map<String, Value>> =
            serde_json::from_slice(&text).map_err(RequestFault::defect("an answer is no JSON"))?;
        let list = |mut object: Map<String, Value>| -> Value {
            let fields = self.schema.fields().iter();
            fields.map(|field| object.remove(field.name()).unwrap_or(Value::Null)).collect()
        };
        Ok(objects.into_iter().map(list).collect())
    }
}

impl AnswerEncoder for CappedRows {
    type Item = RowPage;

    fn encode_batch(&mut self, batch: RecordBatch) -> Result<Vec<RowPage>, RequestFault> {
        let mut rows = Vec::new();
        let mut end = AnswerEnd::Whole;
        let wanted = batch.num_rows().min(self.rows_left);
        'parts: for at in (0..wanted).step_by(PART_ROWS) {
            for row in self.row_lists(&batch.slice(at, PART_ROWS.min(wanted - at)))? {
                let bytes = row.to_string().len();
                if bytes > self.bytes_left {
                    end = AnswerEnd::Bytes;
                    break 'parts;
                }
                self.bytes_left -= bytes;
                rows.push(row);
            }
        }
        self.rows_left -= wanted;
        if end == AnswerEnd::Whole && wanted < batch.num_rows() {
            end = AnswerEnd::Rows;
        }
        Ok(vec![RowPage { rows, end }])
    }

    fn encode_end(self) -> Result<Vec<RowPage>, RequestFault> {
        Ok(Vec::new())
    }
}

#[cfg(test)]
mod tests {
    use arrow::array::{ArrayRef, Int64Array, StringArray};

    use super::*;

    fn batch(texts: &[&str]) -> RecordBatch {
        let texts: ArrayRef = Arc::new(StringArray::from(texts.to_vec()));
        let numbers: ArrayRef = Arc::new(Int64Array::from_iter_values(0..texts.len() as i64));
        RecordBatch::try_from_iter([("text", texts), ("number", numbers)]).expect("a batch")
    }

    fn page(rows: &mut CappedRows, batch: RecordBatch) -> (Vec<Value>, AnswerEnd) {
        let page = rows.encode_batch(batch).expect("rows").remove(0);
        (page.rows, page.end)
    }

    #[test]
    fn rows_end_at_their_number() {
        let batch = batch(&["a", "b", "c"]);
        let mut capped = CappedRows::new(&batch.schema(), 5);
        assert_eq!(
            page(&mut capped, batch.clone()),
            (vec![json!(["a", 0]), json!(["b", 1]), json!(["c", 2])], AnswerEnd::Whole)
        );
        assert_eq!(page(&mut capped, batch.clone()), (vec![json!(["a", 0]), json!(["b", 1])], AnswerEnd::Rows));
        let mut capped = CappedRows::new(&batch.schema(), 3);
        assert_eq!(page(&mut capped, batch).1, AnswerEnd::Whole, "none is left out");
    }

    #[test]
    fn rows_end_at_their_size() {
        let long = "x".repeat(MOST_BYTES / 3);
        let batch = batch(&[&long, &long, &long, "y"]);
        let (rows, end) = page(&mut CappedRows::new(&batch.schema(), 100), batch);
        assert_eq!((rows.len(), end), (2, AnswerEnd::Bytes));
    }
}
