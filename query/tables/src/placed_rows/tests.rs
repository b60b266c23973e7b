//! Rows at places are those of the whole file, and no other pages are fetched.

use std::io::Cursor;
use std::sync::Mutex;

use arrow::array::{ArrayRef, Float32Builder, Int32Array, ListBuilder, StringArray, UInt32Array};
use arrow::compute::take_record_batch;
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use futures::FutureExt as _;
use futures::future::BoxFuture;
use parquet::arrow::ArrowWriter;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;

use super::*;

const ROWS: usize = 5000;

/// A file in memory that counts the bytes which are read of its pages.
struct CountedFile {
    file: Cursor<Vec<u8>>,
    read: Arc<Mutex<u64>>,
}

impl AsyncFileReader for CountedFile {
    fn get_bytes(&mut self, range: Range<u64>) -> BoxFuture<'_, ParquetResult<Bytes>> {
        *self.read.lock().expect("a count") += range.end - range.start;
        self.file.get_bytes(range)
    }

    fn get_metadata<'a>(
        &'a mut self,
        options: Option<&'a ArrowReaderOptions>,
    ) -> BoxFuture<'a, ParquetResult<Arc<ParquetMetaData>>> {
        self.file.get_metadata(options).boxed()
    }
}

fn table_schema() -> SchemaRef {
    let samples = DataType::List(Arc::new(Field::new("element", DataType::Float32, true)));
    Arc::new(Schema::new(vec![
        Field::new("run_id", DataType::Utf8, false),
        Field::new("pair_id", DataType::Int32, true),
        Field::new("samples", samples, true),
        Field::new("added", DataType::Utf8, true),
    ]))
}

// Rows whose texts have a dictionary and whose lists have several lengths, without the column that came later.
fn file_rows() -> RecordBatch {
    let child = Field::new("element", DataType::Float32, true);
    let mut samples = ListBuilder::new(Float32Builder::new()).with_field(child);
    for row in 0..ROWS {
        match row % 11 {
            0 => samples.append_null(),
            length => {
                let values = (0..length * 5).map(|i| (i != 3).then(|| (row * 64 + i) as f32 * 0.37));
                samples.append_value(values.collect::<Vec<_>>());
            }
        }
    }
    let columns: Vec<ArrayRef> = vec![
        Arc::new(StringArray::from_iter_values((0..ROWS).map(|row| format!("run {}", row / 700)))),
        Arc::new((0..ROWS as i32).map(|row| (row % 13 > 0).then_some(row)).collect::<Int32Array>()),
        Arc::new(samples.finish()),
    ];
    let schema = table_schema().project(&[0, 1, 2]).expect("three columns");
    RecordBatch::try_new(Arc::new(schema), columns).expect("rows")
}

fn encode(rows: &RecordBatch, has_index: bool) -> Vec<u8> {
    let statistics = if has_index { EnabledStatistics::Page } else { EnabledStatistics::None };
    let properties = WriterProperties::builder()
        .set_max_row_group_row_count(Some(2100))
        .set_data_page_row_count_limit(60)
        .set_write_batch_size(20)
        .set_statistics_enabled(statistics)
        .set_offset_index_disabled(!has_index)
        // As in the lake's files.
        .set_column_dictionary_enabled(ColumnPath::from(vec!["samples".into(), "list".into(), "element".into()]), false)
        .build();
    let mut writer = ArrowWriter::try_new(Vec::new(), rows.schema(), Some(properties)).expect("a writer");
    writer.write(rows).expect("written");
    writer.into_inner().expect("a file")
}

#[tokio::test]
async fn rows_are_those_at_their_places() {
    let rows = file_rows();
    let all: Vec<_> = (0..ROWS).collect();
    let scattered: Vec<_> = all.iter().copied().filter(|row| row * row % 97 < 3).collect();
    for has_index in [true, false] {
        let file = encode(&rows, has_index);
        for places in [
            &[0][..],
            &[ROWS - 1],
            &[59, 60],
            &[2099, 2100, 4199, 4200],
            &[5, 37, 38, 71, 300, 333, 366],
            &scattered,
            &all,
            &[],
        ] {
            for columns in [&[2][..], &[0, 1, 2, 3], &[3, 0], &[1], &[3]] {
                let wanted = WantedColumns::new(&table_schema(), columns).expect("columns");
                let reader = Box::new(Cursor::new(file.clone()));
                let found = read_placed_rows(reader, &wanted, places).await.expect("rows");
                let expected = UInt32Array::from_iter_values(places.iter().map(|place| *place as u32));
                let expected = take_record_batch(&rows, &expected).expect("rows");
                let expected = add_missing_columns(&expected, wanted.schema()).expect("all columns");
                assert_eq!(found, expected, "{has_index} {columns:?} {places:?}");
            }
        }
    }
}

#[tokio::test]
async fn other_pages_are_not_fetched_and_absent_rows_are_refused() {
    let file = encode(&file_rows(), true);
    let wanted = WantedColumns::new(&table_schema(), &[0, 2]).expect("columns");
    let open = || {
        let read = Arc::<Mutex<u64>>::default();
        (Box::new(CountedFile { file: Cursor::new(file.clone()), read: read.clone() }), read)
    };
    let (reader, read) = open();
    read_placed_rows(reader, &wanted, &[1000, 4000]).await.expect("rows");
    let bytes = *read.lock().expect("a count");
    assert!(bytes > 0 && bytes < file.len() as u64 / 20, "{bytes} of {}", file.len());
    let (reader, _) = open();
    let error = read_placed_rows(reader, &wanted, &[7, ROWS]).await.expect_err("no such row").to_string();
    assert!(error.contains("it has no row 5000"), "{error}");
}
