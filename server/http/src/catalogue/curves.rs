//! NCE curves by band: means over pairs, of a surface and of its Flat, decimated for plots.

use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array};
use arrow::record_batch::RecordBatch;
use axum::Extension;
use datafusion::common::ScalarValue;
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
    Pair(usize),
}

impl PairSelection {
    fn sql_filter(&self) -> (String, Option<ScalarValue>) {
        match self {
            Self::All => (String::new(), None),
            Self::Point(point) => (point_filter("$2"), Some(number_value(*point))),
            Self::Pair(pair) => (" and pair_id = $2".to_owned(), Some(number_value(*pair))),
        }
    }
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
        let (filter, value) = over.sql_filter();
        let sql = curves_query(rig, "$1", &filter);
        let kept_sql = matches!(over, PairSelection::All).then(|| kept_curves_query(rig, "$1"));
        let first = async |sql: &str, values| -> Result<Option<CurveRow>, RequestFault> {
            Ok(request.read_rows(sql, values).await?.into_iter().next())
        };
        let read = async |surface: &str| -> Result<Option<CurveRow>, RequestFault> {
            if let Some(sql) = &kept_sql
                && let Some(row) = first(sql, vec![text_value(surface)]).await?
            {
                return Ok(Some(row));
            }
            first(&sql, [text_value(surface)].into_iter().chain(value.clone()).collect()).await
        };
        let id = &entry.surface.surface_id;
        let flat = &entry.surface.flat_reference;
        // What is left of Foam without Foam is no energy of a surface.
        let read_own = async || if entry.surface.is_foam() { Ok(None) } else { read(id).await };
        let known = request.view.flat_curves(flat);
        let read_flat = async || match over {
            PairSelection::All => Ok(known.get_or_try_init(|| read(flat)).await?.clone()),
            PairSelection::Point(_) | PairSelection::Pair(_) => read(flat).await,
        };
        let (own_row, flat_row) = tokio::try_join!(read_own(), read_flat())?;
        let kept = thinned_samples(rig.impulse_response.length, points);
        let thin = |surface: &str, row: Option<CurveRow>| thinned_curves(surface, row.as_ref(), rig, &kept);
        Ok(Self { time_ms: times_ms(rig, &kept), surface: thin(id, own_row), flat: thin(flat, flat_row) })
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
