//! `POST /api/v1/annotations`: labels, verdicts and notes.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};

use axum::extract::State;
use axum::extract::rejection::BytesRejection;
use axum::response::Response;
use bytes::Bytes;
use chrono::Utc;
use echolake_lake::{ContributedFile, LakeSnapshot, SurfaceReferences, VisibleRun, annotation_rows};
use echolake_query::RequestMemory;
use echolake_schema::annotations::{Annotation, AnnotationKind};
use echolake_schema::tables::{Source, Table};
use echolake_schema::{Grid, RunId};
use echolake_service::{ContributionDraft, RequestFault, TokenScope};
use serde::Deserialize;
use utoipa::ToSchema;
use uuid::Uuid;

use super::super::catalogue::LakeCatalogue;
use super::super::problem::ProblemResponse;
use super::{ContributionBody, answer_draft, choose_author, newest_view, refuse_encoding};

/// Most pairs of all annotations of a request, of which a region may have all of the grid's.
const MOST_PAIRS: usize = 500_000;
/// Bytes of a pair while it is expanded and encoded.
const BYTES_PER_PAIR: usize = 32;

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
) -> Result<Response, ProblemResponse> {
    let of = catalogue.clone();
    let draft = move |body: ContributionBody| async move {
        let request: AnnotationsRequest = serde_json::from_slice(&body.bytes).map_err(|e| {
            RequestFault::bad_request(format!(
                "the body is not as expected: {e}; hint: {{\"annotations\": [{{\"run_id\": \"...\", \"pair_ids\": [7], \
                 \"kind\": \"verdict\", \"value\": \"rejected\", \"comment\": \"...\"}}]}}"
            ))
        })?;
        if request.annotations.len() > body.most_rows {
            return Err(RequestFault::TooMuch { what: "annotations", limit: body.most_rows });
        }
        draft_request(&of, request, &body.memory).await
    };
    answer_draft(&catalogue, "(annotations that are sent)", body, draft).await
}

async fn draft_request(
    catalogue: &LakeCatalogue,
    request: AnnotationsRequest,
    memory: &RequestMemory,
) -> Result<ContributionDraft, RequestFault> {
    if request.annotations.is_empty() {
        return Err(RequestFault::bad_request("`annotations` is empty, expected one at least"));
    }
    let author = choose_author(catalogue, request.author.as_deref())?;
    let (view, seen) = newest_view(catalogue, Table::Annotations).await?;
    let time = Utc::now();
    let mut annotations = Vec::with_capacity(request.annotations.len());
    let meant = meant_pairs(catalogue.lake().grid(), &request.annotations).await?;
    memory.reserve(meant.iter().flatten().map(Vec::len).sum::<usize>() * BYTES_PER_PAIR)?;
    for (i, (new, pair_ids)) in request.annotations.into_iter().zip(meant).enumerate() {
        let failed = |defect: String| annotation_fault(i, &defect);
        let run_id = view.snapshot.run(&new.run_id.parse::<RunId>().map_err(|e| failed(e.to_string()))?);
        let run_id = run_id.map(|run| run.run.clone()).ok_or_else(|| {
            failed(format!("run `{}` is not there; hint: GET /api/v1/runs lists what there is", new.run_id))
        })?;
        let annotation = Annotation {
            pair_ids,
            lake_version: view.snapshot.seen_version(&run_id),
            annotation_id: new.annotation_id.unwrap_or_else(|| Uuid::new_v4().to_string()),
            run_id,
            kind: new.kind,
            value: new.value,
            comment: new.comment,
            author: author.clone(),
            time,
        };
        annotation.check_texts(catalogue.lake().grid().pairs().len()).map_err(failed)?;
        annotations.push(annotation);
    }
    let annotation_ids: Vec<_> = annotations.iter().map(|annotation| annotation.annotation_id.clone()).collect();
    if annotations.iter().map(annotation_key).collect::<BTreeSet<_>>().len() < annotations.len() {
        return Err(RequestFault::bad_request("two annotations on a run have the same `annotation_id`"));
    }
    // Names are those of a run, so that nobody learns of annotations on runs of other projects.
    let runs = annotations.iter().map(|annotation| annotation.run_id.clone()).collect();
    let known = view.session.annotations_on(&view.snapshot, &runs).await?;
    let by_name: HashMap<_, &Annotation> = known.iter().map(|known| (annotation_key(known), known)).collect();
    let known = |new: &Annotation| by_name.get(&annotation_key(new)).copied();
    if let Some(new) = annotations.iter().find(|new| known(new).is_some_and(|known| !new.is_same(known))) {
        return Err(RequestFault::Taken {
            what: format!("annotation `{}`", new.annotation_id),
            hint: "a stored annotation never changes; add another with a new `annotation_id`",
        });
    }
    let new: Vec<_> = annotations.iter().filter(|new| known(new).is_none()).cloned().collect();
    check_reference_verdicts(catalogue, &view.snapshot, &new, request.confirm_rederivation)?;
    let lake = catalogue.lake();
    let files = annotation_rows(lake, &view.snapshot, &new)
        .and_then(|rows| ContributedFile::encode_rows(lake, Table::Annotations, &rows));
    let files = files.map_err(refuse_encoding)?;
    Ok(ContributionDraft { table: Table::Annotations, seen, files, annotation_ids })
}

// A verdict on a run changes the levels of all surfaces that rest on it, of other projects, too: it needs a right of
// its own, and the client first receives what is derived again.
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
    let service = catalogue.service();
    let scope = TokenScope::AnnotateReferences;
    if !service.has_scope(scope) {
        // The request counts the failure when it ends.
        return Err(RequestFault::Forbidden { name: service.client_name().to_owned(), scope });
    }
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

fn annotation_fault(index: usize, defect: &str) -> RequestFault {
    RequestFault::bad_request(format!("annotation {}: {defect}", index + 1))
}

// The pairs of each annotation. A small request can mean all pairs of the grid hundreds of times.
async fn meant_pairs(grid: &Grid, annotations: &[NewAnnotation]) -> Result<Vec<Option<Vec<u32>>>, RequestFault> {
    let mut meant = Vec::with_capacity(annotations.len());
    let mut total = 0;
    for (i, new) in annotations.iter().enumerate() {
        let pairs = pairs_of_one(grid, new).map_err(|defect| annotation_fault(i, &defect))?;
        total += pairs.as_ref().map_or(0, Vec::len);
        if total > MOST_PAIRS {
            return Err(RequestFault::TooMuch {
                what: "pairs in its annotations and their regions",
                limit: MOST_PAIRS,
            });
        }
        meant.push(pairs);
        // The request's time may end here: each region is compared with all pairs of the grid.
        tokio::task::yield_now().await;
    }
    Ok(meant)
}

// The pairs of an annotation, or of its region, ascending; None for the whole run.
fn pairs_of_one(grid: &Grid, new: &NewAnnotation) -> Result<Option<Vec<u32>>, String> {
    if new.microphones.is_none() && new.speakers.is_none() {
        let ids = new.pair_ids.as_ref().map(|ids| ids.iter().copied().collect::<BTreeSet<_>>());
        return Ok(ids.map(|ids| ids.into_iter().collect()));
    }
    if new.pair_ids.is_some() {
        return Err("it has `pair_ids` and a region; hint: give one of them".to_owned());
    }
    for point in new.microphones.iter().chain(&new.speakers).flatten() {
        if *point as usize >= grid.points().len() {
            return Err(format!(
                "point {point} is not one of the rig's, 0 to {}",
                grid.points().len().saturating_sub(1)
            ));
        }
    }
    let region = |points: &Option<Vec<u32>>| points.as_ref().map(|points| points.iter().copied().collect());
    let [microphones, speakers]: [Option<HashSet<u32>>; 2] = [region(&new.microphones), region(&new.speakers)];
    let is_of =
        |points: &Option<HashSet<u32>>, point: u32| points.as_ref().is_none_or(|points| points.contains(&point));
    let pairs = grid.pairs().iter();
    let meant = pairs.filter(|pair| is_of(&microphones, pair.microphone.0) && is_of(&speakers, pair.speaker.0));
    // One more than may be stored says enough.
    Ok(Some(meant.map(|pair| pair.id.0).take(MOST_PAIRS + 1).collect()))
}

#[cfg(test)]
mod tests {
    use echolake_schema::Rig;
    use echolake_service::FaultCode;
    use serde_json::json;

    use super::*;

    async fn meant(region: &serde_json::Value, count: usize) -> Result<Vec<Option<Vec<u32>>>, RequestFault> {
        let annotations = vec![region; count];
        let request = json!({ "annotations": annotations }).to_string();
        assert!(request.len() < 1 << 20, "it comes to an engine");
        let request: AnnotationsRequest = serde_json::from_str(&request).expect("annotations");
        meant_pairs(&Rig::paper().build_grid().expect("a grid"), &request.annotations).await
    }

    /// E8: a small request with many regions is stored, or refused with the limit before all of them are expanded.
    #[tokio::test]
    async fn the_pairs_of_all_regions_are_limited() {
        let all = json!({ "run_id": "r", "kind": "note", "comment": "x", "microphones": (0..600).collect::<Vec<_>>() });
        let one = json!({ "run_id": "r", "kind": "note", "comment": "x", "speakers": [0] });
        let grid = Rig::paper().build_grid().expect("a grid");
        let pairs: Vec<u32> = (0..2951).filter(|pair| grid.pairs()[*pair as usize].speaker.0 == 0).collect();
        assert_eq!(meant(&one, 600).await.expect("stored"), vec![Some(pairs); 600]);
        let points = grid.points().len();
        let whole =
            json!({ "run_id": "r", "kind": "note", "comment": "x", "speakers": (0..points).collect::<Vec<_>>() });
        assert_eq!(meant(&whole, 1).await.expect("stored"), [Some((0..2951).collect())]);
        let fault = meant(&whole, 600).await.expect_err("1.8 million pairs");
        assert_eq!(fault.code(), FaultCode::TooLarge);
        assert!(fault.to_string().contains("more than 500000 pairs in its annotations"), "{fault}");
        let fault = meant(&all, 1).await.expect_err("no such points").to_string();
        assert!(fault.contains("annotation 1: point"), "{fault}");
    }
}
