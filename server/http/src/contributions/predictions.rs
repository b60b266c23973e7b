//! `POST /api/v1/predictions`: TNCE that a model predicts.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use arrow::array::{Array as _, AsArray as _, Float64Array, Int32Array, StringArray, TimestampMicrosecondArray};
use arrow::compute::{SortColumn, lexsort_to_indices, take_record_batch};
use arrow::datatypes::{Float64Type, Int32Type};
use arrow::record_batch::RecordBatch;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::response::Response;
use bytes::Bytes;
use chrono::Utc;
use datafusion::scalar::ScalarValue;
use echolake_lake::{BatchBuilder, ContributedFile, Lake, LakeSnapshot};
use echolake_schema::tables::{Table, predicted_columns};
use echolake_schema::{ProjectName, RunId, SurfaceId};
use echolake_service::{ContributionDraft, RequestFault};
use serde::Deserialize;
use utoipa::IntoParams;

use super::super::catalogue::{CatalogueRequest, LakeCatalogue, SnapshotView, text_value};
use super::super::extract::QueryParams;
use super::super::problem::ProblemResponse;
use super::arrow_body::{ColumnContent, ExpectedColumn, decode_arrow_body};
use super::new_rows::select_new_rows;
use super::{ContributionBody, answer_draft, choose_author, newest_view, refuse_encoding};

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
    /// Project of the surfaces' runs, empty for runs without one: only if runs of two projects have a surface of the
    /// request.
    #[serde(default)]
    project: Option<String>,
    /// Only without tokens; the token's name otherwise.
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    author: Option<String>,
}

/// The newest run of a surface of the request, and its project.
struct MeantRun {
    run: RunId,
    project: Option<ProjectName>,
}

/// Checks the predictions of a request.
pub(super) async fn draft_predictions(
    State(catalogue): State<LakeCatalogue>,
    QueryParams(params): QueryParams<PredictionParams>,
    body: Result<Bytes, BytesRejection>,
) -> Result<Response, ProblemResponse> {
    let of = catalogue.clone();
    let draft = move |body: ContributionBody| async move {
        let author = choose_author(&of, params.author.as_deref())?;
        check_model(&params)?;
        let rows = PredictedRows::from_stream(&of, &body)?;
        draft_rows(&of, &params, author, rows).await
    };
    answer_draft(&catalogue, "(predictions that are sent)", body, draft).await
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
    let (view, seen) = newest_view(catalogue, Table::Predictions).await?;
    let surfaces: BTreeSet<&str> = rows.surface_ids.iter().flatten().collect();
    let mut meant = BTreeMap::new();
    for surface in surfaces {
        meant.insert(surface, find_meant_run(&view.snapshot, surface, params.project.as_deref())?);
    }
    let known = read_known_rows(catalogue, &view, params, &meant).await?;
    let rows = rows.to_batch(catalogue.lake(), &view.snapshot, params, &author, &meant)?;
    let rows = select_new_rows(&known, &rows)?;
    let files = ContributedFile::encode_rows(catalogue.lake(), Table::Predictions, &rows).map_err(refuse_encoding)?;
    Ok(ContributionDraft { table: Table::Predictions, seen, files, annotation_ids: Vec::new() })
}

// A prediction is of the project of the surface's runs that its author sees. Of two projects the request names one.
fn find_meant_run(snapshot: &LakeSnapshot, surface: &str, project: Option<&str>) -> Result<MeantRun, RequestFault> {
    let named = project.map(|name| name.trim()).map(|name| (!name.is_empty()).then_some(name));
    let of_surface = snapshot.runs().filter(|run| run.surface.as_str() == surface);
    let mut newest = BTreeMap::new();
    for run in of_surface {
        newest.insert(snapshot.project_of(&run.run).cloned(), run.run.clone());
    }
    let quoted = |project: &Option<ProjectName>| match project {
        Some(project) => format!("`{project}`"),
        None => "none (`project=`)".to_owned(),
    };
    let known = newest.keys().map(quoted).collect::<Vec<_>>().join(", ");
    let is_meant =
        |project: &Option<ProjectName>| named.is_none_or(|named| project.as_ref().map(ProjectName::as_str) == named);
    let mut meant: Vec<_> = newest.into_iter().filter(|(project, _)| is_meant(project)).collect();
    match (meant.len(), known.is_empty()) {
        (1, _) => {
            let (project, run) = meant.remove(0);
            Ok(MeantRun { run, project })
        }
        (0, true) => Err(RequestFault::bad_request(format!(
            "surface `{surface}` is not there; hint: GET /api/v1/surfaces lists what there is"
        ))),
        (0, false) => Err(RequestFault::bad_request(format!(
            "surface `{surface}` has no run of project `{:.64}`, expected one of {known}",
            project.unwrap_or_default()
        ))),
        _ => Err(RequestFault::bad_request(format!(
            "surface `{surface}` has runs of several projects, {known}; hint: `project` names the one that is meant"
        ))),
    }
}

// The stored rows of the same model and version on these surfaces and their projects.
async fn read_known_rows(
    catalogue: &LakeCatalogue,
    view: &Arc<SnapshotView>,
    params: &PredictionParams,
    meant: &BTreeMap<&str, MeantRun>,
) -> Result<Vec<RecordBatch>, RequestFault> {
    let mut values = vec![text_value(&params.model), text_value(&params.version)];
    let mut places = Vec::new();
    for (surface, MeantRun { project, .. }) in meant {
        values.push(text_value(surface));
        values.push(ScalarValue::Utf8(project.as_ref().map(ToString::to_string)));
        let last = values.len();
        places.push(format!("(surface_id = ${} and project is not distinct from ${last})", last - 1));
    }
    let names = predicted_columns(catalogue.lake().rig()).join(", ");
    let sql = format!(
        "select model, model_version, surface_id, pair_id, {names} from predictions \
         where model = $1 and model_version = $2 and ({})",
        places.join(" or ")
    );
    let mut running = CatalogueRequest::new(catalogue, view, true).stream_batches(&sql, values).await?;
    let mut batches = Vec::new();
    while let Some(batch) = running.next_part().await? {
        batches.push(batch);
    }
    Ok(batches)
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
        let (Some(surfaces), Some(pairs)) = (rows.column_by_name("surface_id"), rows.column_by_name("pair_id")) else {
            return Err(RequestFault::bad_request("the rows need the columns `surface_id` and `pair_id`"));
        };
        let keys = [surfaces, pairs].map(|values| SortColumn { values: values.clone(), options: None });
        let sorted = lexsort_to_indices(&keys, None).and_then(|order| take_record_batch(&rows, &order));
        let rows = sorted.map_err(RequestFault::defect("rows are not sorted"))?;
        let values = |name: &String| Some(rows.column_by_name(name)?.as_primitive::<Float64Type>().clone());
        let sorted = Self {
            surface_ids: rows["surface_id"].as_string().clone(),
            pair_ids: rows["pair_id"].as_primitive::<Int32Type>().clone(),
            values: names.iter().map(values).collect(),
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
                        "{}: `{name}` is {value}, expected a number that is not negative; hint: values are linear, as \
                         in tnce, not dB",
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
        lake: &Lake,
        snapshot: &LakeSnapshot,
        params: &PredictionParams,
        author: &str,
        meant: &BTreeMap<&str, MeantRun>,
    ) -> Result<RecordBatch, RequestFault> {
        let rows = self.pair_ids.len();
        let run = |surface: Option<&str>| meant.get(surface?);
        let meant: Vec<_> = self.surface_ids.iter().map(run).collect();
        let projects = meant.iter().map(|meant| Some(meant.as_ref()?.project.as_ref()?.as_str()));
        let versions = meant.iter().map(|meant| Some(snapshot.seen_version(&meant.as_ref()?.run)? as i64));
        let time = TimestampMicrosecondArray::from_value(Utc::now().timestamp_micros(), rows).with_timezone("UTC");
        let mut batch = BatchBuilder::new(Table::Predictions, lake.rig(), rows);
        batch
            .push_column("surface_id", Arc::new(self.surface_ids.clone()))
            .push_column(
                "run_id",
                Arc::new(meant.iter().map(|m| Some(m.as_ref()?.run.as_str())).collect::<StringArray>()),
            )
            .push_column("project", Arc::new(projects.collect::<StringArray>()))
            .fill_text("model", params.model.as_str())
            .fill_text("model_version", params.version.as_str())
            .push_column("pair_id", Arc::new(self.pair_ids.clone()))
            .fill_text("author", author)
            .push_column("predicted", Arc::new(time))
            .push_longs("lake_version", versions);
        for (name, values) in predicted_columns(lake.rig()).iter().zip(&self.values) {
            let values = values.clone().unwrap_or_else(|| Float64Array::new_null(rows));
            batch.push_column(name, Arc::new(values));
        }
        batch.finish().map_err(refuse_encoding)
    }
}
