//! `POST /api/v1/predictions`: TNCE that a model predicts.

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::array::{
    Array as _, ArrayRef, AsArray as _, Float64Array, Int32Array, Int64Array, StringArray, TimestampMicrosecondArray,
    UInt32Array,
};
use arrow::compute::{SortColumn, cast, concat_batches, lexsort_to_indices, take};
use arrow::datatypes::{DataType, Float64Type, Int32Type};
use arrow::ipc::reader::StreamReader;
use arrow::record_batch::RecordBatch;
use axum::Json;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use chrono::Utc;
use echolake_lake::ContributionLog;
use echolake_schema::tables::{predicted_columns, prediction_schema};
use echolake_schema::{SurfaceId, quoted_text};
use echolake_service::{ContributionDraft, RequestFault, TokenScope};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::basic::{Compression, ZstdLevel};
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use utoipa::IntoParams;

use super::super::catalogue::LakeCatalogue;
use super::super::extract::QueryParams;
use super::super::problem::ProblemResponse;
use super::super::sql::whole_body;
use super::choose_author;

/// Key of the file's metadata that holds its [`PredictionRecord`].
const RECORD: &str = "echolake.predictions";
/// Longest name of a model or a version, in characters.
const LONGEST: usize = 64;

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

/// Contents of a stored file: model, surfaces and a digest.
#[derive(Debug, PartialEq, Eq, Serialize, Deserialize)]
struct PredictionRecord {
    model: String,
    version: String,
    surfaces: BTreeSet<String>,
    /// SHA-256 of keys and values.
    digest: String,
}

/// Checks the predictions of a request.
pub(super) async fn draft_predictions(
    State(catalogue): State<LakeCatalogue>,
    QueryParams(params): QueryParams<PredictionParams>,
    body: Result<Bytes, BytesRejection>,
) -> Result<Json<ContributionDraft>, ProblemResponse> {
    catalogue.service().authorised_client(TokenScope::Annotate)?;
    let author = choose_author(&catalogue, params.author.as_deref())?;
    for (name, text) in [("model", &params.model), ("version", &params.version)] {
        let is_name = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
        if text.is_empty() || text.len() > LONGEST || !text.chars().all(is_name) {
            let message = format!("`{name}` is `{text}`, expected 1 to {LONGEST} of A-Z a-z 0-9 _ - .");
            return Err(RequestFault::bad_request(message).into());
        }
    }
    let rows = PredictedRows::from_stream(&catalogue, &whole_body(body)?)?;
    Ok(Json(draft_rows(&catalogue, &params, author, rows).await?))
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
                "surface `{}` is not there; hint: GET /api/v1/surfaces lists what there is",
                quoted_text(surface)
            )));
        }
    }
    let record = PredictionRecord {
        model: params.model.clone(),
        version: params.version.clone(),
        surfaces,
        digest: rows.digest(),
    };
    let lake = catalogue.lake();
    let log = ContributionLog::Predictions;
    let unreadable = |e: echolake_lake::Error| RequestFault::from(echolake_query::Error::from(e));
    let files = lake.list_contributions(log, u64::MAX).await.map_err(unreadable)?;
    for file in files.iter().filter(|file| file.bytes > 0) {
        let bytes = lake.read_contribution(log, file.number).await.map_err(unreadable)?;
        let Some(known) = read_record(bytes)? else { continue };
        if known == record {
            return Ok(ContributionDraft { number: file.number, object: None, annotation_ids: Vec::new() });
        }
        let is_same_model = known.model == record.model && known.version == record.version;
        if is_same_model && let Some(surface) = record.surfaces.iter().find(|id| known.surfaces.contains(*id)) {
            return Err(RequestFault::Taken {
                what: format!(
                    "a prediction of `{}`, version `{}`, for surface `{surface}`",
                    record.model, record.version
                ),
                hint: "stored predictions never change; send them with another version",
            });
        }
    }
    let number = files.last().map_or(0, |file| file.number) + 1;
    let version = view.snapshot.lake_version().unwrap_or(0);
    let object = rows.encode_parquet(catalogue, &record, &author, version)?;
    Ok(ContributionDraft { number, object: Some(STANDARD.encode(object)), annotation_ids: Vec::new() })
}

fn read_record(bytes: Bytes) -> Result<Option<PredictionRecord>, RequestFault> {
    let reader = ParquetRecordBatchReaderBuilder::try_new(bytes)
        .map_err(RequestFault::defect("a file of predictions cannot be read"))?;
    let metadata = reader.metadata().file_metadata().key_value_metadata();
    let text = metadata.and_then(|all| all.iter().find(|entry| entry.key == RECORD)?.value.as_ref());
    Ok(text.and_then(|text| serde_json::from_str(text).ok()))
}

/// The rows of a request, sorted by surface and pair.
struct PredictedRows {
    surface_ids: StringArray,
    pair_ids: Int32Array,
    /// Values by column of [`predicted_columns`]; None if it is not predicted.
    values: Vec<Option<Float64Array>>,
}

impl PredictedRows {
    fn from_stream(catalogue: &LakeCatalogue, body: &[u8]) -> Result<Self, RequestFault> {
        let unreadable = |e: arrow::error::ArrowError| {
            RequestFault::bad_request(format!(
                "the body is no Arrow stream: {e}; hint: pyarrow.ipc.new_stream writes one"
            ))
        };
        let reader = StreamReader::try_new(body, None).map_err(unreadable)?;
        let schema = reader.schema();
        let batches = reader.collect::<Result<Vec<_>, _>>().map_err(unreadable)?;
        let rows = concat_batches(&schema, &batches).map_err(unreadable)?;
        Self::from_batch(catalogue, &rows)
    }

    fn from_batch(catalogue: &LakeCatalogue, rows: &RecordBatch) -> Result<Self, RequestFault> {
        let names = predicted_columns(catalogue.lake().rig());
        for field in rows.schema().fields() {
            let name = field.name();
            if !names.contains(name) && name != "surface_id" && name != "pair_id" {
                let known = names.join(", ");
                return Err(RequestFault::bad_request(format!(
                    "column `{name}` is not one of predictions; hint: surface_id, pair_id, and some of {known}"
                )));
            }
        }
        let surfaces = read_column(rows, "surface_id", &DataType::Utf8)?;
        let pairs = read_column(rows, "pair_id", &DataType::Int32)?;
        let (Some(surfaces), Some(pairs)) = (surfaces, pairs) else {
            return Err(RequestFault::bad_request("the rows need the columns `surface_id` and `pair_id`"));
        };
        let keys = [&surfaces, &pairs].map(|values| SortColumn { values: values.clone(), options: None });
        let order = lexsort_to_indices(&keys, None).map_err(RequestFault::defect("rows are not sorted"))?;
        let surfaces = sort_column(&surfaces, &order)?;
        let pairs = sort_column(&pairs, &order)?;
        let mut values = Vec::with_capacity(names.len());
        for name in &names {
            let column = read_column(rows, name, &DataType::Float64)?;
            let column = column.map(|column| sort_column(&column, &order)).transpose()?;
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
            let place = || format!("surface `{}`, pair {pair}", quoted_text(surface.unwrap_or_default()));
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

    fn digest(&self) -> String {
        let mut digest = Sha256::new();
        for (surface, pair) in self.surface_ids.iter().zip(self.pair_ids.values()) {
            digest.update(surface.unwrap_or_default());
            digest.update([0]);
            digest.update(pair.to_le_bytes());
        }
        for (i, values) in self.values.iter().enumerate() {
            let Some(values) = values else { continue };
            digest.update((i as u64).to_le_bytes());
            for value in values {
                digest.update(value.unwrap_or(f64::NAN).to_bits().to_le_bytes());
            }
        }
        hex::encode(digest.finalize())
    }

    fn encode_parquet(
        &self,
        catalogue: &LakeCatalogue,
        record: &PredictionRecord,
        author: &str,
        lake_version: u64,
    ) -> Result<Vec<u8>, RequestFault> {
        let failed = RequestFault::defect("predictions are not written as Parquet");
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
        let batch =
            RecordBatch::try_new(schema.clone(), columns).map_err(RequestFault::defect("columns do not fit"))?;
        let entry = serde_json::to_string(record).map_err(RequestFault::defect("a record is not written as JSON"))?;
        let properties = WriterProperties::builder()
            .set_compression(Compression::ZSTD(ZstdLevel::default()))
            .set_key_value_metadata(Some(vec![KeyValue::new(RECORD.to_owned(), entry)]))
            .build();
        let mut bytes = Vec::new();
        let mut writer = ArrowWriter::try_new(&mut bytes, schema, Some(properties)).map_err(failed)?;
        writer.write(&batch).map_err(failed)?;
        writer.close().map_err(failed)?;
        Ok(bytes)
    }
}

fn read_column(rows: &RecordBatch, name: &str, kind: &DataType) -> Result<Option<ArrayRef>, RequestFault> {
    let Some(column) = rows.column_by_name(name) else { return Ok(None) };
    let failed =
        |e| RequestFault::bad_request(format!("column `{name}` is {}, expected {kind}: {e}", column.data_type()));
    let read = cast(column, kind).map_err(failed)?;
    // A cast makes null of what does not fit.
    match read.null_count() == column.null_count() {
        true => Ok(Some(read)),
        false => Err(RequestFault::bad_request(format!("column `{name}` has values that are no {kind}"))),
    }
}

fn sort_column(column: &ArrayRef, order: &UInt32Array) -> Result<ArrayRef, RequestFault> {
    take(column, order, None).map_err(RequestFault::defect("rows are not sorted"))
}
