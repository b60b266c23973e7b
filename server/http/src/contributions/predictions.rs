//! `POST /api/v1/predictions`: TNCE that a model predicts.

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::array::{
    Array as _, ArrayRef, AsArray as _, Float64Array, Int32Array, Int64Array, StringArray, TimestampMicrosecondArray,
    UInt32Array,
};
use arrow::compute::{SortColumn, lexsort_to_indices, take};
use arrow::datatypes::{Float64Type, Int32Type};
use arrow::record_batch::RecordBatch;
use axum::Json;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use chrono::Utc;
use echolake_lake::ContributionLog;
use echolake_schema::SurfaceId;
use echolake_schema::tables::{predicted_columns, prediction_schema};
use echolake_service::{ContributionDraft, RequestFault};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::basic::{Compression, ZstdLevel};
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use serde::{Deserialize, Serialize};
use utoipa::IntoParams;

use super::super::catalogue::LakeCatalogue;
use super::super::extract::QueryParams;
use super::super::problem::ProblemResponse;
use super::arrow_body::{ColumnContent, ExpectedColumn, decode_arrow_body};
use super::new_rows::select_new_rows;
use super::{ContributionBody, choose_author, with_request_ticket};

/// Key of the file's metadata that holds its [`PredictionRecord`].
const RECORD: &str = "echolake.predictions";
/// Longest name of a model or a version, in characters.
const LONGEST: usize = 64;
/// Most rows of a request: more than 1 MiB holds with values in double precision.
const MOST_ROWS: usize = 100_000;

/// The parameters after the path's `?`.
#[derive(Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PredictionParams {
    /// Name of the model, 1 to 64 of `A-Z a-z 0-9 _ - .`.
    model: String,
    /// Version of the model, as its name.
    version: String,
    /// Only without tokens; the token's name otherwise.
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    author: Option<String>,
}

/// What a stored file has: model, version and surfaces.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
struct PredictionRecord {
    model: String,
    version: String,
    surfaces: BTreeSet<String>,
}

/// Checks the predictions of a request.
pub(super) async fn draft_predictions(
    State(catalogue): State<LakeCatalogue>,
    QueryParams(params): QueryParams<PredictionParams>,
    body: Result<Bytes, BytesRejection>,
) -> Result<Json<ContributionDraft>, ProblemResponse> {
    let of = catalogue.clone();
    let drafted = with_request_ticket(&catalogue, "(predictions that are sent)", body, move |body| async move {
        let author = choose_author(&of, params.author.as_deref())?;
        check_model(&params)?;
        let rows = PredictedRows::from_stream(&of, &body)?;
        draft_rows(&of, &params, author, rows).await
    });
    Ok(Json(drafted.await?))
}

fn check_model(params: &PredictionParams) -> Result<(), RequestFault> {
    for (name, text) in [("model", &params.model), ("version", &params.version)] {
        let is_name = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
        if text.is_empty() || text.len() > LONGEST || !text.chars().all(is_name) {
            let message = format!("`{name}` is `{text}`, expected 1 to {LONGEST} of A-Z a-z 0-9 _ - .");
            return Err(RequestFault::bad_request(message));
        }
    }
    Ok(())
}

async fn draft_rows(
    catalogue: &LakeCatalogue,
    params: &PredictionParams,
    author: String,
    rows: PredictedRows,
) -> Result<ContributionDraft, RequestFault> {
    let view = catalogue.current_view().await?;
    let surfaces: BTreeSet<String> = rows.surface_ids.iter().flatten().map(str::to_owned).collect();
    for surface in &surfaces {
        let is_there = surface.parse::<SurfaceId>().is_ok_and(|id| view.snapshot.runs().any(|run| run.surface == id));
        if !is_there {
            return Err(RequestFault::bad_request(format!(
                "surface `{surface}` is not there; hint: GET /api/v1/surfaces lists what there is"
            )));
        }
    }
    let record = PredictionRecord { model: params.model.clone(), version: params.version.clone(), surfaces };
    let lake = catalogue.lake();
    let log = ContributionLog::Predictions;
    let unreadable = |e: echolake_lake::Error| RequestFault::from(echolake_query::Error::from(e));
    let files = lake.list_contributions(log, u64::MAX).await.map_err(unreadable)?;
    let mut known = Vec::new();
    let mut last_known = 0;
    for file in files.iter().filter(|file| file.bytes > 0) {
        let bytes = lake.read_contribution(log, file.number).await.map_err(unreadable)?;
        if let Some(batches) = read_known_rows(bytes, &record)? {
            known.extend(batches);
            last_known = file.number;
        }
    }
    let version = view.snapshot.lake_version().unwrap_or(0);
    let rows = select_new_rows(&known, &rows.to_batch(catalogue, &record, &author, version)?)?;
    if rows.num_rows() == 0 {
        return Ok(ContributionDraft { number: last_known, object: None, annotation_ids: Vec::new() });
    }
    let number = files.last().map_or(0, |file| file.number) + 1;
    let object = encode_parquet(&rows, &record)?;
    Ok(ContributionDraft { number, object: Some(STANDARD.encode(object)), annotation_ids: Vec::new() })
}

// The rows of a file of the same model, version and a surface; None if it is another's.
fn read_known_rows(bytes: Bytes, record: &PredictionRecord) -> Result<Option<Vec<RecordBatch>>, RequestFault> {
    let failed = RequestFault::defect("a file of predictions cannot be read");
    let reader = ParquetRecordBatchReaderBuilder::try_new(bytes).map_err(failed)?;
    let metadata = reader.metadata().file_metadata().key_value_metadata();
    let text = metadata.and_then(|all| all.iter().find(|entry| entry.key == RECORD)?.value.as_ref());
    let known: Option<PredictionRecord> = text.and_then(|text| serde_json::from_str(text).ok());
    let is_same = |known: &PredictionRecord| {
        known.model == record.model && known.version == record.version && !known.surfaces.is_disjoint(&record.surfaces)
    };
    if !known.as_ref().is_some_and(is_same) {
        return Ok(None);
    }
    let rows = reader.build().map_err(failed)?.collect::<Result<_, _>>();
    rows.map(Some).map_err(RequestFault::defect("rows of predictions cannot be read"))
}

/// The rows of a request, sorted by surface and pair.
struct PredictedRows {
    surface_ids: StringArray,
    pair_ids: Int32Array,
    /// Values by column of [`predicted_columns`]; None if it is not predicted.
    values: Vec<Option<Float64Array>>,
}

impl PredictedRows {
    fn from_stream(catalogue: &LakeCatalogue, body: &ContributionBody) -> Result<Self, RequestFault> {
        let rig = catalogue.lake().rig();
        let names = predicted_columns(rig);
        let values = names.iter().map(|name| ExpectedColumn { name: name.clone(), content: ColumnContent::Numbers });
        let keys =
            [("surface_id", ColumnContent::Name { longest: SurfaceId::LONGEST }), ("pair_id", ColumnContent::Integers)];
        let keys = keys.map(|(name, content)| ExpectedColumn { name: name.to_owned(), content });
        let expected: Vec<_> = keys.into_iter().chain(values).collect();
        let rows = decode_arrow_body(&body.bytes, &expected, body.most_rows.min(MOST_ROWS))?;
        let column = |name: &str| rows.column_by_name(name).cloned();
        let (Some(surfaces), Some(pairs)) = (column("surface_id"), column("pair_id")) else {
            return Err(RequestFault::bad_request("the rows need the columns `surface_id` and `pair_id`"));
        };
        let keys = [&surfaces, &pairs].map(|values| SortColumn { values: values.clone(), options: None });
        let order = lexsort_to_indices(&keys, None).map_err(RequestFault::defect("rows are not sorted"))?;
        let surfaces = sort_column(&surfaces, &order)?;
        let pairs = sort_column(&pairs, &order)?;
        let mut values = Vec::with_capacity(names.len());
        for name in &names {
            let column = column(name).map(|column| sort_column(&column, &order)).transpose()?;
            values.push(column.map(|column| column.as_primitive::<Float64Type>().clone()));
        }
        let sorted = Self {
            surface_ids: surfaces.as_string().clone(),
            pair_ids: pairs.as_primitive::<Int32Type>().clone(),
            values,
        };
        sorted.check_rows(catalogue, &names)?;
        Ok(sorted)
    }

    fn check_rows(&self, catalogue: &LakeCatalogue, names: &[String]) -> Result<(), RequestFault> {
        if self.pair_ids.is_empty() || self.values.iter().all(Option::is_none) {
            let known = names.join(", ");
            return Err(RequestFault::bad_request(format!("there is no prediction; hint: one of {known} at least")));
        }
        if self.surface_ids.null_count() + self.pair_ids.null_count() > 0 {
            return Err(RequestFault::bad_request("a row has no `surface_id` or no `pair_id`"));
        }
        let pairs = catalogue.lake().grid().pairs().len();
        let keys: Vec<_> = self.surface_ids.iter().zip(self.pair_ids.values().iter().copied()).collect();
        for (i, (surface, pair)) in keys.iter().enumerate() {
            let place = || format!("surface `{}`, pair {pair}", surface.unwrap_or_default());
            if usize::try_from(*pair).ok().is_none_or(|pair| pair >= pairs) {
                let last = pairs.saturating_sub(1);
                return Err(RequestFault::bad_request(format!("{}: the pair is not one of 0 to {last}", place())));
            }
            if i > 0 && keys[i - 1] == keys[i] {
                return Err(RequestFault::bad_request(format!("{} is there twice", place())));
            }
            for (name, values) in names.iter().zip(&self.values) {
                let Some(values) = values.as_ref().filter(|values| values.is_valid(i)) else { continue };
                let value = values.value(i);
                if !value.is_finite() || value < 0.0 {
                    return Err(RequestFault::bad_request(format!(
                        "{}: `{name}` is {value}, expected a number that is not negative; hint: values are linear, as in \
                         tnce, not dB",
                        place()
                    )));
                }
            }
        }
        Ok(())
    }

    // The rows of table `predictions`.
    fn to_batch(
        &self,
        catalogue: &LakeCatalogue,
        record: &PredictionRecord,
        author: &str,
        lake_version: u64,
    ) -> Result<RecordBatch, RequestFault> {
        let schema = prediction_schema(catalogue.lake().rig());
        let rows = self.pair_ids.len();
        let text =
            |text: &str| -> ArrayRef { Arc::new(StringArray::from_iter_values(std::iter::repeat_n(text, rows))) };
        let mut columns = vec![
            text(&record.model),
            text(&record.version),
            Arc::new(self.surface_ids.clone()) as ArrayRef,
            Arc::new(self.pair_ids.clone()),
        ];
        for values in &self.values {
            columns.push(match values {
                Some(values) => Arc::new(values.clone()),
                None => Arc::new(Float64Array::new_null(rows)),
            });
        }
        let time = TimestampMicrosecondArray::from_value(Utc::now().timestamp_micros(), rows).with_timezone("UTC");
        columns.push(text(author));
        columns.push(Arc::new(time));
        columns.push(Arc::new(Int64Array::from_value(lake_version as i64, rows)));
        RecordBatch::try_new(schema, columns).map_err(RequestFault::defect("columns do not fit"))
    }
}

fn encode_parquet(rows: &RecordBatch, record: &PredictionRecord) -> Result<Vec<u8>, RequestFault> {
    let failed = RequestFault::defect("predictions are not written as Parquet");
    let entry = serde_json::to_string(record).map_err(RequestFault::defect("a record is not written as JSON"))?;
    let properties = WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::default()))
        .set_key_value_metadata(Some(vec![KeyValue::new(RECORD.to_owned(), entry)]))
        .build();
    let mut bytes = Vec::new();
    let mut writer = ArrowWriter::try_new(&mut bytes, rows.schema(), Some(properties)).map_err(failed)?;
    writer.write(rows).map_err(failed)?;
    writer.close().map_err(failed)?;
    Ok(bytes)
}

fn sort_column(column: &ArrayRef, order: &UInt32Array) -> Result<ArrayRef, RequestFault> {
    take(column, order, None).map_err(RequestFault::defect("rows are not sorted"))
}
