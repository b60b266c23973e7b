//! NCE curves by band: means over pairs, of a surface and of its Flat, decimated for plots.

use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array};
use arrow::record_batch::RecordBatch;
use axum::Extension;
use echolake_query::figure_rows::{CurveRow, curves_query, kept_curves_query, point_filter, thinned_samples, times_ms};
use echolake_schema::Rig;
use echolake_service::RequestFault;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{BinaryContent, PathParams, QueryParams, WholeNumber};
use super::content::{AnswerContent, EndpointAnswer};
use super::request::{CatalogueRequest, SurfacePath, number_value, text_value};
use super::snapshot::summary::SurfaceEntry;

/// Curves of a surface beside those of its Flat.
#[derive(Serialize, ToSchema)]
pub(super) struct CurveSet {
    pub time_ms: Vec<f64>,
    pub surface: SurfaceCurves,
    pub flat: SurfaceCurves,
}

/// Curves of a surface.
#[derive(Clone, Serialize, ToSchema)]
#[schema(as = Curves)]
pub(super) struct SurfaceCurves {
    surface_id: String,
    /// Measurements that the mean is over.
    pairs: i64,
    /// By band (no total), then by time: NCE over Flat's total, linear.
    pub bands: Vec<Vec<f32>>,
}

/// The pairs of which a mean is taken.
pub(super) enum PairSelection {
    All,
    Point(usize),
}

impl CurveSet {
    /// # Errors
    /// Those of its query.
    pub async fn read_curves(
        request: &CatalogueRequest,
        entry: &SurfaceEntry,
        over: PairSelection,
        points: usize,
    ) -> Result<Self, RequestFault> {
        let rig = request.catalogue.lake().rig();
        let id = &entry.surface.surface_id;
        let flat = &entry.surface.flat_reference;
        let rows = match over {
            PairSelection::Point(point) => {
                let values = vec![text_value(id), text_value(flat), number_value(point)];
                request.read_rows(&curves_query(rig, "$1, $2", &point_filter("$3")), values).await?
            }
            PairSelection::All => {
                let known = request.view.flat_curves(flat);
                let of_flat = known.get_or_try_init(|| read_mean_curves(request, flat));
                let (own, flat) = tokio::try_join!(read_mean_curves(request, id), of_flat)?;
                own.into_iter().chain(flat.clone()).collect()
            }
        };
        Ok(Self::from_rows(rig, entry, &rows, points))
    }

    /// The curves among these rows, decimated to `points`.
    pub fn from_rows(rig: &Rig, entry: &SurfaceEntry, rows: &[CurveRow], points: usize) -> Self {
        let surface = &entry.surface;
        let kept = thinned_samples(rig.impulse_response.length, points);
        let find = |name: &str| rows.iter().find(|row| row.surface_id == name);
        // What is left of Foam without Foam is no energy of a surface.
        let own = find(&surface.surface_id).filter(|_| !surface.is_foam());
        Self {
            time_ms: times_ms(rig, &kept),
            surface: thinned_curves(&surface.surface_id, own, rig, &kept),
            flat: thinned_curves(&surface.flat_reference, find(&surface.flat_reference), rig, &kept),
        }
    }

    /// Returns whether the surface itself has curves.
    pub fn is_there(&self) -> bool {
        self.surface.pairs > 0
    }

    // A column of times and one a band of either surface.
    fn to_batch(&self, rig: &Rig) -> Result<RecordBatch, RequestFault> {
        let column = |values: &[f32]| -> ArrayRef {
            let padded = (0..self.time_ms.len()).map(|i| values.get(i).copied().map(f64::from));
            Arc::new(padded.collect::<Float64Array>())
        };
        let times: ArrayRef = Arc::new(Float64Array::from(self.time_ms.clone()));
        let mut columns = vec![("time_ms".to_owned(), times)];
        for (name, curves) in [("nce", &self.surface), ("flat_nce", &self.flat)] {
            for (band, values) in rig.band_names().iter().zip(&curves.bands) {
                columns.push((format!("{name}_{band}"), column(values)));
            }
        }
        RecordBatch::try_from_iter_with_nullable(columns.into_iter().map(|(name, values)| (name, values, true)))
            .map_err(RequestFault::defect("curves make no batch"))
    }
}

// Means over all pairs, as ingest keeps them if it does.
async fn read_mean_curves(request: &CatalogueRequest, surface: &str) -> Result<Option<CurveRow>, RequestFault> {
    let rig = request.catalogue.lake().rig();
    for sql in [kept_curves_query(rig, "$1"), curves_query(rig, "$1", "")] {
        if let Some(row) = request.read_rows(&sql, vec![text_value(surface)]).await?.into_iter().next() {
            return Ok(Some(row));
        }
    }
    Ok(None)
}

fn thinned_curves(surface: &str, row: Option<&CurveRow>, rig: &Rig, kept: &[usize]) -> SurfaceCurves {
    let bands = row.map_or_else(|| vec![Vec::new(); rig.band_names().len()], |row| row.curves_at(kept));
    SurfaceCurves { surface_id: surface.to_owned(), pairs: row.map_or(0, |row| row.pairs), bands }
}

/// The pairs and the points of curves.
#[derive(Default, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub(super) struct CurvesQuery {
    /// A grid point.
    #[param(value_type = usize, required = false)]
    #[serde(default, deserialize_with = "crate::extract::read_present")]
    microphone: Option<String>,
    #[param(inline)]
    points: WholeNumber<16, 4096, 192>,
}

/// NCE by band, a mean over pairs, of a surface and of its Flat, decimated to `points`.
///
/// The pairs are all, or those of one microphone point. As an Arrow stream: `time_ms`, `nce_2500`, ...,
/// `flat_nce_2500`, ...
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/curves",
    tag = "catalogue",
    params(SurfacePath, CurvesQuery),
    responses((status = 200, description = "OK", content(
        (CurveSet = "application/json"),
        (inline(BinaryContent) = "application/vnd.apache.arrow.stream")
    ))),
    extensions(("x-sql" = json!([
        "select band_hz, mean_nce from surface_stats where surface_id in ($1, $flat); of a microphone, and of surfaces \
         of several runs: select nce_2500, ..., nce_40000 from nce where surface_id in ($1, $flat) [and (microphone = \
         $2 or speaker = $2)]; averaged sample by sample",
    ])))
)]
pub(super) async fn curves(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<SurfacePath>,
    QueryParams(query): QueryParams<CurvesQuery>,
) -> EndpointAnswer {
    let entry = request.find_surface(&path.surface_id).await?;
    let over = match &query.microphone {
        Some(point) => PairSelection::Point(request.parse_microphone(point)?),
        None => PairSelection::All,
    };
    let set = CurveSet::read_curves(&request, entry, over, query.points.get()).await?;
    Ok(match request.as_arrow {
        true => AnswerContent::encode_arrow(&set.to_batch(request.catalogue.lake().rig())?)?,
        false => AnswerContent::encode_json(&set)?,
    })
}
