//! `POST /api/v1/annotations`: labels, verdicts and notes.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use axum::Json;
use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use chrono::Utc;
use echolake_lake::{LakeSnapshot, SurfaceReferences, VisibleRun};
use echolake_schema::RunId;
use echolake_schema::annotations::{Annotation, AnnotationKind};
use echolake_schema::tables::{Source, Table};
use echolake_service::{ContributionDraft, RequestFault, TokenScope};
use serde::Deserialize;
use utoipa::ToSchema;
use uuid::Uuid;

use super::super::catalogue::LakeCatalogue;
use super::super::problem::ProblemResponse;
use super::super::sql::whole_body;
use super::choose_author;

/// Annotations of one request: all of them are stored, or none.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct AnnotationsRequest {
    annotations: Vec<NewAnnotation>,
    /// Only without tokens; the token's name otherwise.
    #[schema(required = false, nullable = false)]
    author: Option<String>,
    /// Needed for verdicts on runs that levels of other surfaces rest on, as those of Flat and Foam: without it the
    /// answer is 409, and tells how many surfaces and rows the next ingest derives again.
    #[serde(default)]
    #[schema(required = false)]
    confirm_rederivation: bool,
}

/// One annotation.
#[derive(Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct NewAnnotation {
    /// Name that the author chooses, 1 to 64 of `A-Z a-z 0-9 _ - .`: the same annotation sent again is stored once.
    /// The server makes one up if there is none, and a request that is sent again is stored again.
    #[schema(required = false, nullable = false)]
    annotation_id: Option<String>,
    run_id: String,
    /// Pairs whose measurements are meant. Without pairs and points the whole run is.
    #[schema(required = false, nullable = false)]
    pair_ids: Option<Vec<u32>>,
    /// A region of the grid: the pairs with one of these microphone points.
    #[schema(required = false, nullable = false)]
    microphones: Option<Vec<u32>>,
    /// A region of the grid: the pairs with one of these speaker points.
    #[schema(required = false, nullable = false)]
    speakers: Option<Vec<u32>>,
    #[schema(value_type = String, pattern = "label|verdict|note")]
    kind: AnnotationKind,
    /// The label; `accepted` or `rejected` for a verdict; nothing for a note.
    #[serde(default)]
    #[schema(required = false)]
    value: String,
    /// The reason, or the note.
    #[serde(default)]
    #[schema(required = false)]
    comment: String,
}

/// Checks the annotations of a request.
pub(super) async fn draft_annotations(
    State(catalogue): State<LakeCatalogue>,
    body: Result<Bytes, BytesRejection>,
) -> Result<Json<ContributionDraft>, ProblemResponse> {
    catalogue.service().authorised_client(TokenScope::Annotate)?;
    let request: AnnotationsRequest = serde_json::from_slice(&whole_body(body)?).map_err(|e| {
        RequestFault::bad_request(format!(
            "the body is not as expected: {e}; hint: {{\"annotations\": [{{\"run_id\": \"...\", \"pair_ids\": [7], \
             \"kind\": \"verdict\", \"value\": \"rejected\", \"comment\": \"...\"}}]}}"
        ))
    })?;
    Ok(Json(draft_request(&catalogue, request).await?))
}

async fn draft_request(
    catalogue: &LakeCatalogue,
    request: AnnotationsRequest,
) -> Result<ContributionDraft, RequestFault> {
    if request.annotations.is_empty() {
        return Err(RequestFault::bad_request("`annotations` is empty, expected one at least"));
    }
    let author = choose_author(catalogue, request.author.as_deref())?;
    let view = catalogue.current_view().await?;
    let (last, known) = view.session.all_annotations().await?;
    // Names are those of a run, so that nobody learns of annotations on runs of other projects.
    let by_name: HashMap<_, &Annotation> = known.iter().map(|known| (annotation_key(known), known.as_ref())).collect();
    let time = Utc::now();
    let lake_version = view.snapshot.lake_version().unwrap_or(0);
    let mut annotations = Vec::with_capacity(request.annotations.len());
    for (i, new) in request.annotations.into_iter().enumerate() {
        let failed = |defect: String| RequestFault::bad_request(format!("annotation {}: {defect}", i + 1));
        let run_id = view.snapshot.run(&new.run_id.parse::<RunId>().map_err(|e| failed(e.to_string()))?);
        let run_id = run_id.map(|run| run.run.clone()).ok_or_else(|| {
            failed(format!("run `{}` is not there; hint: GET /api/v1/runs lists what there is", new.run_id))
        })?;
        let annotation = Annotation {
            number: last + 1,
            pair_ids: meant_pairs(catalogue, &new).map_err(failed)?,
            annotation_id: new.annotation_id.unwrap_or_else(|| Uuid::new_v4().to_string()),
            run_id,
            kind: new.kind,
            value: new.value,
            comment: new.comment,
            author: author.clone(),
            time,
            lake_version,
        };
        annotation.check_texts(catalogue.lake().grid().pairs().len()).map_err(failed)?;
        annotations.push(annotation);
    }
    let annotation_ids: Vec<_> = annotations.iter().map(|annotation| annotation.annotation_id.clone()).collect();
    if annotations.iter().map(annotation_key).collect::<BTreeSet<_>>().len() < annotations.len() {
        return Err(RequestFault::bad_request("two annotations on a run have the same `annotation_id`"));
    }
    let there: Vec<_> = annotations.iter().filter_map(|new| Some((new, *by_name.get(&annotation_key(new))?))).collect();
    match there.first() {
        None => {
            check_reference_verdicts(catalogue, &view.snapshot, &annotations, request.confirm_rederivation)?;
            let mut object = Vec::new();
            for annotation in &annotations {
                serde_json::to_writer(&mut object, annotation)
                    .map_err(RequestFault::defect("an annotation is not written as JSON"))?;
                object.push(b'\n');
            }
            let object = Some(STANDARD.encode(object));
            Ok(ContributionDraft { number: last + 1, object, annotation_ids })
        }
        Some((_, known)) if there.len() == annotations.len() && there.iter().all(|(new, known)| new.is_same(known)) => {
            Ok(ContributionDraft { number: known.number, object: None, annotation_ids })
        }
        Some((new, _)) => Err(RequestFault::Taken {
            what: format!("annotation `{}`", new.annotation_id),
            hint: "a stored annotation never changes; add another with a new `annotation_id`",
        }),
    }
}

// A verdict on a run changes the levels of all surfaces that rest on it, of other projects, too: it needs a right of its
// own, and the client is told first what is derived again.
fn check_reference_verdicts(
    catalogue: &LakeCatalogue,
    snapshot: &LakeSnapshot,
    annotations: &[Annotation],
    is_confirmed: bool,
) -> Result<(), RequestFault> {
    let references = SurfaceReferences::from_snapshot(snapshot, &catalogue.lake().config().references);
    let mut resting = BTreeMap::new();
    let mut first = None;
    for annotation in annotations.iter().filter(|annotation| annotation.kind == AnnotationKind::Verdict) {
        let Some(run) = snapshot.run(&annotation.run_id) else { continue };
        let dependent: Vec<_> = references.dependent_runs(snapshot, &run.surface).collect();
        // Surfaces that this client does not see may rest on the lake's own references.
        if !dependent.is_empty() || references.is_default(&run.surface) {
            resting.extend(dependent.into_iter().chain([run]).map(|run| (&run.run, run)));
            first = first.or(Some(run));
        }
    }
    let Some(run) = first else { return Ok(()) };
    catalogue.service().authorised_client(TokenScope::AnnotateReferences)?;
    if is_confirmed {
        return Ok(());
    }
    let derived = || Table::ALL.into_iter().filter(|table| table.source() == Source::References);
    let rows = |run: &VisibleRun| {
        let counts = snapshot.row_counts(&run.run);
        derived().filter_map(|table| counts?.rows_of(table)).sum::<u64>()
    };
    Err(RequestFault::Unconfirmed {
        run: run.run.to_string(),
        surfaces: resting.values().map(|run| &run.surface).collect::<BTreeSet<_>>().len(),
        rows: resting.values().map(|run| rows(run)).sum(),
    })
}

fn annotation_key(annotation: &Annotation) -> (&str, &str) {
    (annotation.run_id.as_str(), &annotation.annotation_id)
}

// The pairs of the request, or of its region, ascending; None for the whole run.
fn meant_pairs(catalogue: &LakeCatalogue, new: &NewAnnotation) -> Result<Option<Vec<u32>>, String> {
    if new.microphones.is_none() && new.speakers.is_none() {
        let ids = new.pair_ids.as_ref().map(|ids| ids.iter().copied().collect::<BTreeSet<_>>());
        return Ok(ids.map(|ids| ids.into_iter().collect()));
    }
    if new.pair_ids.is_some() {
        return Err("it has `pair_ids` and a region; hint: give one of them".to_owned());
    }
    let grid = catalogue.lake().grid();
    for point in new.microphones.iter().chain(&new.speakers).flatten() {
        if *point as usize >= grid.points().len() {
            return Err(format!(
                "point {point} is not one of the rig's, 0 to {}",
                grid.points().len().saturating_sub(1)
            ));
        }
    }
    let is_of = |points: &Option<Vec<u32>>, point: u32| points.as_ref().is_none_or(|points| points.contains(&point));
    let pairs = grid.pairs().iter();
    let meant = pairs.filter(|pair| is_of(&new.microphones, pair.microphone.0) && is_of(&new.speakers, pair.speaker.0));
    Ok(Some(meant.map(|pair| pair.id.0).collect()))
}
