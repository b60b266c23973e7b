//! `system.files`: the data files of the snapshot.

use std::sync::Arc;

use arrow::array::{Int64Array, StringArray};
use arrow::datatypes::{DataType, SchemaRef};
use arrow::record_batch::RecordBatch;
use async_trait::async_trait;
use datafusion::catalog::Session;
use datafusion::error::Result;
use echolake_lake::{DataFile, FileName, LakeSnapshot, VisibleRun};
use echolake_schema::tables::Table;

use super::{SystemRows, build_batch, build_schema, column_field};

#[derive(Debug)]
pub(super) struct LakeFiles {
    pub snapshot: Arc<LakeSnapshot>,
}

/// The columns of the table.
pub(super) fn table_schema() -> SchemaRef {
    build_schema([
        column_field("table", DataType::Utf8, false, "", "Table that the file is of"),
        column_field("path", DataType::Utf8, false, "", "Path of the file in the lake"),
        column_field(
            "bytes",
            DataType::Int64,
            false,
            "B",
            "Size; if it has rows of other projects, the share of those seen",
        ),
        column_field("rows", DataType::Int64, false, "1", "Rows that readers see"),
        column_field("runs", DataType::Int64, false, "1", "Runs whose rows readers see in it; 0 for tables of the rig"),
        column_field("surface_id", DataType::Utf8, true, "", "Surface of its run; null unless it has one run"),
        column_field("run_id", DataType::Utf8, true, "", "Its run; null unless it has one"),
        column_field("version", DataType::Int64, false, "1", "Version of the table that added it"),
    ])
}

#[async_trait]
impl SystemRows for LakeFiles {
    fn schema(&self) -> SchemaRef {
        table_schema()
    }

    async fn read_rows(&self, _: &dyn Session) -> Result<RecordBatch> {
        let all = Table::ALL.into_iter().flat_map(|table| self.snapshot.files(table).iter().map(move |f| (table, f)));
        let files: Vec<_> = all.map(|(table, file)| (table, file, runs_of(file))).collect();
        let long = |value: &dyn Fn(&DataFile) -> u64| {
            Arc::new(Int64Array::from_iter_values(files.iter().map(|(_, file, _)| value(file) as i64)))
        };
        let only = |part: fn(&(String, String)) -> &String| {
            let single = files.iter().map(|(_, _, runs)| match &runs[..] {
                [run] => Some(part(run).clone()),
                _ => None,
            });
            Arc::new(single.collect::<StringArray>())
        };
        let table = StringArray::from_iter_values(files.iter().map(|(table, _, _)| table.name()));
        let path = StringArray::from_iter_values(files.iter().map(|(_, file, _)| file.path.as_ref()));
        let runs = Int64Array::from_iter_values(files.iter().map(|(_, _, runs)| runs.len() as i64));
        build_batch(
            self.schema(),
            vec![
                Arc::new(table),
                Arc::new(path),
                long(&|file| seen_bytes(&self.snapshot, file)),
                long(&DataFile::visible_rows),
                Arc::new(runs),
                only(|(surface, _)| surface),
                only(|(_, run)| run),
                long(&|file| file.log_version),
            ],
        )
    }
}

fn seen_bytes(snapshot: &LakeSnapshot, file: &DataFile) -> u64 {
    match snapshot.is_restricted() {
        true => (u128::from(file.bytes) * u128::from(file.visible_rows()) / u128::from(file.rows.max(1))) as u64,
        false => file.bytes,
    }
}

// Surface and run of each run that readers see in a file.
fn runs_of(file: &DataFile) -> Vec<(String, String)> {
    match &file.name {
        Some(FileName::Rows { surface, run, .. } | FileName::Pointer(VisibleRun { surface, run, .. })) => {
            vec![(surface.to_string(), run.to_string())]
        }
        _ => file.visible_parts().map(|(part, _)| (part.surface.to_string(), part.run.to_string())).collect(),
    }
}
