//! `GET /api/v1/surfaces/{surface_id}/pairs/{pair_id}`: everything about one impulse response.

use std::ops::RangeInclusive;
use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array};
use arrow::record_batch::RecordBatch;
use axum::Extension;
use echolake_dsp::room_parameters::is_long_enough;
use echolake_query::figure_rows::{CurveRow, TOTAL_BAND, band_keys, levels_db};
use echolake_schema::symmetry::MovedPair;
use echolake_schema::{Rig, RunId, Symmetry};
use echolake_service::RequestFault;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::super::extract::{BinaryContent, PathParams};
use super::content::{AnswerContent, EndpointAnswer};
use super::curves::CurveSet;
use super::environment::{AirReading, AirSeries};
use super::pair_rows::{PairEnergies, PairResponses, PairRows};
use super::request::{CatalogueRequest, missing_item, number_value, text_value};
use super::runs::RunLogEntry;
use super::snapshot::summary::SurfaceEntry;

/// Length of the air's history that is shown before and after a measurement.
const AROUND_NS: i64 = 900_000_000_000;

/// The path of a pair of a surface.
#[derive(Deserialize, IntoParams)]
#[into_params(parameter_in = Path)]
pub(super) struct PairPath {
    pub surface_id: String,
    #[param(value_type = usize)]
    pub pair_id: String,
}

/// Everything about one impulse response.
#[derive(Serialize, ToSchema)]
struct PairDetail<'a> {
    surface_id: &'a str,
    pair: &'a PairGeometry,
    measurement: &'a PairMeasurement,
    rate_hz: f64,
    /// Temperature-corrected, cropped, direct sound still in it; Pa per unit of the sweep's amplitude.
    measured: &'a [f32],
    /// After Foam's response was subtracted; null if Foam is missing.
    reflected: Option<&'a [f32]>,
    flat_reflected: Option<&'a [f32]>,
    /// Over Flat's total. One value per band in the order of `lake.bands`, the total last; null if there is no value.
    tnce_db: Vec<Option<f64>>,
    /// Over Flat's same band, by band as `tnce_db`.
    tnce_band_db: Vec<Option<f64>>,
    /// Standard uncertainties of `tnce_db`; null if they are not known.
    tnce_u_db: Vec<Option<f64>>,
    /// Standard uncertainties of `tnce_band_db`; null if they are not known.
    tnce_band_u_db: Vec<Option<f64>>,
    curves: Option<CurveSet>,
    symmetries: Vec<SymmetricPair>,
    /// All frequencies, then octaves; none if the response is too short to be a room's.
    room: Vec<RoomBand>,
    /// What the controller logged about this pair.
    attempts: Vec<RunLogEntry>,
    environment: AirSeries,
}

/// A first Fresnel zone, by its full diameters.
#[derive(Deserialize, Serialize, ToSchema)]
struct FresnelEllipse {
    frequency_hz: f64,
    major_mm: f64,
    minor_mm: f64,
}

/// The geometry of a pair.
#[derive(Deserialize, Serialize, ToSchema)]
#[schema(as = Pair)]
pub(crate) struct PairGeometry {
    pair_id: i32,
    microphone: i32,
    speaker: i32,
    microphone_mm: [f64; 3],
    speaker_mm: [f64; 3],
    pub direct_mm: f64,
    pub image_mm: f64,
    incidence_deg: f64,
    /// x, y in the panel's plane.
    specular_mm: [f64; 2],
    /// Those of 2 and 40 kHz that are within the range of the sweep. They are no column of the table.
    #[serde(default)]
    #[schema(required = true)]
    fresnel: Vec<FresnelEllipse>,
    #[serde(skip_serializing)]
    #[schema(ignore)]
    low_mm: [Option<f64>; 2],
    #[serde(skip_serializing)]
    #[schema(ignore)]
    high_mm: [Option<f64>; 2],
}

/// A measurement of a pair.
#[derive(Deserialize, Serialize, ToSchema)]
#[schema(as = Measurement)]
pub(super) struct PairMeasurement {
    #[serde(skip_serializing)]
    #[schema(ignore)]
    pub ir: Vec<f32>,
    #[serde(skip_serializing)]
    #[schema(ignore)]
    log_time_ns: i64,
    run_id: String,
    #[schema(format = DateTime)]
    log_time: String,
    attempt: i64,
    verdict: String,
    reasons: String,
    temperature_c: Option<f64>,
    humidity_pct: Option<f64>,
    pressure_hpa: Option<f64>,
    outside_level_db: Option<f32>,
    snr_db: Option<f32>,
    clipped_samples: Option<i64>,
    arrival_error_us: Option<f32>,
    microphone_residual_mm: Option<f32>,
    speaker_residual_mm: Option<f32>,
    source: String,
    chunk_offset: i64,
}

impl PairMeasurement {
    /// Returns whether the sound arrived so much earlier or later than geometry gives.
    pub fn is_off_by(&self, secs: f64) -> bool {
        self.arrival_error_us.is_some_and(|error_us| f64::from(error_us).abs() > secs * 1e6)
    }
}

/// A pair that a symmetry of the grid makes of another.
#[derive(Serialize, ToSchema)]
struct SymmetricPair {
    symmetry: &'static str,
    pair_id: i64,
    microphone: i64,
    speaker: i64,
    /// Relies on reciprocity.
    swapped: bool,
    /// Of that pair on the same surface, over Flat's total, by band as in `PairDetail`.
    tnce_db: Vec<Option<f64>>,
}

/// Parameters of ISO 3382-1 of a response in one band, as in view `room_parameters`; null if `reason` says why not.
#[derive(Deserialize, Serialize, ToSchema)]
struct RoomBand {
    /// Of the octave; null for all frequencies.
    midband_hz: Option<f64>,
    edt_s: Option<f64>,
    t20_s: Option<f64>,
    t30_s: Option<f64>,
    c50_db: Option<f64>,
    c80_db: Option<f64>,
    d50: Option<f64>,
    ts_ms: Option<f64>,
    range_db: Option<f64>,
    /// By how much T30 is longer than T20.
    curvature_percent: Option<f64>,
    reason: Option<String>,
    /// Reasons for which the values may not be what they are taken for, as of a decay with two slopes.
    doubt: Option<String>,
}

const GEOMETRY: &str = "select pair_id, microphone, speaker, \
    make_array(microphone_x_mm, microphone_y_mm, microphone_z_mm) as microphone_mm, \
    make_array(speaker_x_mm, speaker_y_mm, speaker_z_mm) as speaker_mm, direct_mm, image_mm, incidence_deg, \
    make_array(specular_x_mm, specular_y_mm) as specular_mm, \
    make_array(fresnel_major_2000_mm, fresnel_minor_2000_mm) as low_mm, \
    make_array(fresnel_major_40000_mm, fresnel_minor_40000_mm) as high_mm from pairs order by pair_id";
const ROOM: &str = "select midband_hz, edt_s, t20_s, t30_s, c50_db, c80_db, d50, ts_ms, range_db, \
    curvature_percent, reason, doubt \
    from room_parameters where surface_id = $1 and pair_id = $2 and run_id = $3 order by midband_hz nulls first";

impl CatalogueRequest {
    /// The pair of this number.
    pub fn parse_pair(&self, text: &str) -> Result<usize, RequestFault> {
        let pairs = self.catalogue.lake().grid().pairs().len();
        let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        match (digits, text.parse::<usize>()) {
            (true, Ok(pair)) if pair < pairs => Ok(pair),
            (true, _) => Err(missing_item(format!("pair `{text}`"), "table `pairs` lists what there is")),
            _ => Err(RequestFault::bad_request(format!("the pair is `{text}`; hint: a whole number below {pairs}"))),
        }
    }
}

/// Finds the geometry of a pair; that of all is read once per snapshot.
///
/// # Errors
/// Those of its query.
pub(super) async fn find_geometry(request: &CatalogueRequest, pair: usize) -> Result<&PairGeometry, RequestFault> {
    let sweep = &request.catalogue.lake().rig().sweep;
    let measured_hz = sweep.low_hz..=sweep.high_hz;
    let read = || async {
        let rows = request.read_rows::<PairGeometry>(GEOMETRY, Vec::new()).await?;
        Ok::<Vec<_>, RequestFault>(rows.into_iter().map(|pair| pair.with_fresnel(&measured_hz)).collect())
    };
    let all = request.view.results.pairs.get_or_try_init(read).await?;
    let found = all.iter().find(|row| usize::try_from(row.pair_id) == Ok(pair));
    found.ok_or_else(|| missing_item(format!("pair {pair}"), "ask for another one"))
}

// The fault for a pair that was not measured.
fn missing_measurement(entry: &SurfaceEntry, pair: usize) -> RequestFault {
    let what = format!("a measurement of pair {pair} on surface `{}`", entry.surface.surface_id);
    missing_item(what, "its run may be partial; another pair may be there")
}

/// The newest measurement of a pair, and the responses of its surface and of Flat after Foam's were subtracted, if they
/// are known.
///
/// # Errors
/// [`RequestFault::NotFound`] if there is no measurement.
pub(super) async fn read_samples(
    request: &CatalogueRequest,
    entry: &SurfaceEntry,
    pair: usize,
) -> Result<(PairMeasurement, [Option<Vec<f32>>; 2]), RequestFault> {
    let read = |rows: PairRows| async move {
        let (measurement, reflected) = tokio::join!(rows.read_measurement(), rows.read_reflected());
        // Of a pair that was not measured, nothing else counts.
        let Some(measurement) = measurement? else { return Ok(None) };
        Ok::<_, RequestFault>(Some((measurement, reflected?)))
    };
    let found = request.read_pair(entry, pair, read).await?;
    found.ok_or_else(|| missing_measurement(entry, pair))
}

/// A pair's response.
#[derive(Clone, Copy, Default, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
#[schema(default = "reflected")]
pub(super) enum ResponseSignal {
    /// After Foam's was subtracted.
    #[default]
    Reflected,
    Measured,
}

impl ResponseSignal {
    pub fn name(self) -> &'static str {
        match self {
            Self::Reflected => "reflected",
            Self::Measured => "measured",
        }
    }

    /// Reads the samples.
    ///
    /// # Errors
    /// [`RequestFault::NoData`] if Foam is missing, [`RequestFault::NotFound`] if the pair was not measured.
    pub async fn read_samples(
        self,
        request: &CatalogueRequest,
        entry: &SurfaceEntry,
        pair: usize,
    ) -> Result<Vec<f32>, RequestFault> {
        let read = move |rows: PairRows| async move {
            match self {
                Self::Measured => Ok::<_, RequestFault>(rows.read_measured().await?.map(Some)),
                Self::Reflected => rows.read_own_reflected().await,
            }
        };
        let found = request.read_pair(entry, pair, read).await?;
        let samples = found.ok_or_else(|| missing_measurement(entry, pair))?;
        samples.ok_or_else(|| RequestFault::NoData {
            what: format!("pair {pair} of surface `{}`", entry.surface.surface_id),
            data: "reflected response",
            hint: "its Foam is missing; ask for signal=measured",
        })
    }
}

/// Everything about one impulse response.
///
/// As an Arrow stream its samples: `time_ms`, `measured`, `reflected`, `flat_reflected`.
#[utoipa::path(
    get,
    path = "/api/v1/surfaces/{surface_id}/pairs/{pair_id}",
    tag = "catalogue",
    params(PairPath),
    responses((status = 200, description = "OK", content(
        (PairDetail = "application/json"),
        (inline(BinaryContent) = "application/vnd.apache.arrow.stream")
    ))),
    extensions(("x-sql" = json!([
        "select * from measurements where surface_id = $1 and pair_id = $2",
        "select reflected_ir, nce_* from nce where surface_id in ($1, $flat) and pair_id = $2",
        "select * from tnce where surface_id = $1 and pair_id = $2",
        "select * from pairs where pair_id = $2",
        "select d.symmetry, d.d4_pair_id, d.d4_microphone, d.d4_speaker, d.swapped, t.* from tnce_d4 d join tnce t \
         on t.surface_id = d.surface_id and t.pair_id = d.d4_pair_id where d.surface_id = $1 and d.pair_id = $2",
        "select * from room_parameters where surface_id = $1 and pair_id = $2",
        "select * from events where run_id = $run and message like 'pair ' || $2 || ',%'",
        "select * from environment where run_id = $run and log_time_ns between $t - 900e9 and $t + 900e9",
    ])))
)]
pub(super) async fn pair(
    Extension(request): Extension<CatalogueRequest>,
    PathParams(path): PathParams<PairPath>,
) -> EndpointAnswer {
    let entry = request.find_surface(&path.surface_id).await?;
    let pair = request.parse_pair(&path.pair_id)?;
    if request.as_arrow {
        let (measurement, [own, flat]) = read_samples(&request, entry, pair).await?;
        return Ok(encode_samples(&request, &measurement.ir, own.as_deref(), flat.as_deref())?);
    }
    let (found, geometry) = tokio::try_join!(read_findings(&request, entry, pair), find_geometry(&request, pair))?;
    let PairFindings { measurement, responses: [own, flat], energies, attempts, air } = found;
    let room = read_room(&request, entry, pair, &measurement).await?;
    let rig = request.catalogue.lake().rig();
    let number = geometry.pair_id;
    let bands = BandColumns::new(rig);
    let surface = &entry.surface;
    let mut curves = Vec::new();
    let [own, flat] = [(&surface.surface_id, own), (&surface.flat_reference, flat)].map(|(name, found)| {
        let PairResponses { reflected, pairs, bands } = found?;
        curves.push(CurveRow { surface_id: name.clone(), pairs, bands });
        reflected
    });
    let curves = CurveSet::from_rows(rig, entry, &curves, usize::MAX);
    Ok(AnswerContent::encode_json(&PairDetail {
        surface_id: &surface.surface_id,
        pair: geometry,
        environment: AirSeries::new(air, measurement.log_time_ns, &measurement.log_time),
        measured: &measurement.ir,
        measurement: &measurement,
        rate_hz: rig.sweep.rate_hz.get(),
        reflected: own.as_deref(),
        flat_reflected: flat.as_deref(),
        tnce_db: levels_db(&energies.find_values(number, &bands.total)?),
        tnce_band_db: levels_db(&energies.find_values(number, &bands.band)?),
        tnce_u_db: energies.find_values(number, &bands.total_u_db)?,
        tnce_band_u_db: energies.find_values(number, &bands.band_u_db)?,
        curves: Some(curves).filter(CurveSet::is_there),
        symmetries: find_symmetries(&request, pair, &energies, &bands)?,
        room,
        attempts,
    })?)
}

impl PairGeometry {
    fn with_fresnel(mut self, measured_hz: &RangeInclusive<f64>) -> Self {
        let zone = |frequency_hz: f64, [major, minor]: [Option<f64>; 2]| {
            Some(FresnelEllipse { frequency_hz, major_mm: major?, minor_mm: minor? })
        };
        let zones = [zone(2000.0, self.low_mm), zone(40_000.0, self.high_mm)].into_iter().flatten();
        self.fresnel = zones.filter(|zone| measured_hz.contains(&zone.frequency_hz)).collect();
        self
    }
}

/// What tables have of a pair on a surface.
struct PairFindings {
    measurement: PairMeasurement,
    /// Of the surface and of its Flat, with the curves by band.
    responses: [Option<PairResponses>; 2],
    /// Of the pair, and of those that symmetries make of it.
    energies: PairEnergies,
    attempts: Vec<RunLogEntry>,
    air: Vec<AirReading>,
}

async fn read_findings(
    request: &CatalogueRequest,
    entry: &SurfaceEntry,
    pair: usize,
) -> Result<PairFindings, RequestFault> {
    let rig = request.catalogue.lake().rig();
    let curves: Vec<_> = rig.band_names().iter().map(|band| format!("nce_{band}")).collect();
    let bands = BandColumns::new(rig);
    let moved = moved_pairs(request, pair).map(|(_, moved)| moved.pair.id.0 as i32);
    let pairs: Vec<_> = moved.chain([pair as i32]).collect();
    let read = |rows: PairRows| async move {
        let (measurement, responses) = tokio::join!(rows.read_measurement(), rows.read_responses(&curves));
        let Some(measurement) = measurement? else { return Ok(None) };
        let responses = responses?;
        let run: RunId = measurement.run_id.parse().map_err(RequestFault::defect("a row is of no run"))?;
        let ns = measurement.log_time_ns;
        let columns = [&bands.total, &bands.band, &bands.total_u_db, &bands.band_u_db].map(Vec::as_slice);
        let (energies, attempts, air) = tokio::try_join!(
            rows.read_energies(&run, &pairs, columns),
            rows.read_attempts(&run),
            rows.read_air(&run, ns.saturating_sub(AROUND_NS), ns.saturating_add(AROUND_NS)),
        )?;
        Ok::<_, RequestFault>(Some(PairFindings { measurement, responses, energies, attempts, air }))
    };
    let found = request.read_pair(entry, pair, read).await?;
    found.ok_or_else(|| missing_measurement(entry, pair))
}

/// Columns of `tnce` by band, the total last.
struct BandColumns {
    total: Vec<String>,
    band: Vec<String>,
    total_u_db: Vec<String>,
    band_u_db: Vec<String>,
}

impl BandColumns {
    fn new(rig: &Rig) -> Self {
        let over_total = |band: &String| format!("tnce_{band}");
        let over_band = |band: &String| if band == TOTAL_BAND { over_total(band) } else { format!("tnce_band_{band}") };
        let with_u = |columns: &[String]| columns.iter().map(|column| format!("{column}_u_db")).collect();
        let bands = band_keys(rig);
        let total: Vec<_> = bands.iter().map(over_total).collect();
        let band: Vec<_> = bands.iter().map(over_band).collect();
        Self { total_u_db: with_u(&total), band_u_db: with_u(&band), total, band }
    }
}

// The pairs that the symmetries of the grid make of a pair, by the symmetries' names.
fn moved_pairs(request: &CatalogueRequest, pair: usize) -> impl Iterator<Item = (&'static str, MovedPair)> {
    let moved = request.view.results.moved_pairs.get_or_init(|| {
        let images = |symmetry| Some((symmetry, request.catalogue.lake().grid().moved_pairs(symmetry)?));
        let mut all: Vec<_> = Symmetry::ALL.into_iter().filter_map(images).collect();
        all.sort_by_key(|(symmetry, _)| symmetry.name());
        all
    });
    moved.iter().map(move |(symmetry, pairs)| (symmetry.name(), pairs[pair]))
}

fn find_symmetries(
    request: &CatalogueRequest,
    pair: usize,
    energies: &PairEnergies,
    bands: &BandColumns,
) -> Result<Vec<SymmetricPair>, RequestFault> {
    // A pair without energies has no row in `tnce_d4` either.
    if !energies.has_pair(pair as i32) {
        return Ok(Vec::new());
    }
    let measured = moved_pairs(request, pair).filter(|(_, moved)| energies.has_pair(moved.pair.id.0 as i32));
    let symmetries = measured.map(|(symmetry, moved)| {
        let pair = moved.pair;
        Ok(SymmetricPair {
            symmetry,
            pair_id: pair.id.0.into(),
            microphone: pair.microphone.0.into(),
            speaker: pair.speaker.0.into(),
            swapped: moved.swapped,
            tnce_db: levels_db(&energies.find_values(pair.id.0 as i32, &bands.total)?),
        })
    });
    symmetries.collect()
}

async fn read_room(
    request: &CatalogueRequest,
    entry: &SurfaceEntry,
    pair: usize,
    measurement: &PairMeasurement,
) -> Result<Vec<RoomBand>, RequestFault> {
    // A rig's responses of some ms would make rows of nulls.
    if !is_long_enough(measurement.ir.len(), request.catalogue.lake().rig().sweep.rate_hz.get()) {
        return Ok(Vec::new());
    }
    let values = vec![text_value(&entry.surface.surface_id), number_value(pair), text_value(&measurement.run_id)];
    request.read_rows(ROOM, values).await
}

fn encode_samples(
    request: &CatalogueRequest,
    measured: &[f32],
    own: Option<&[f32]>,
    flat: Option<&[f32]>,
) -> Result<AnswerContent, RequestFault> {
    let rate_hz = request.catalogue.lake().rig().sweep.rate_hz.get();
    let times = (0..measured.len()).map(|i| Some(1000.0 * i as f64 / rate_hz));
    let column = |values: Option<&[f32]>| -> ArrayRef {
        let values = values.unwrap_or_default();
        Arc::new((0..measured.len()).map(|i| values.get(i).copied().map(f64::from)).collect::<Float64Array>())
    };
    let columns: [(&str, ArrayRef); 4] = [
        ("time_ms", Arc::new(times.collect::<Float64Array>())),
        ("measured", column(Some(measured))),
        ("reflected", column(own)),
        ("flat_reflected", column(flat)),
    ];
    let batch = RecordBatch::try_from_iter_with_nullable(columns.map(|(name, values)| (name, values, true)));
    AnswerContent::encode_arrow(&batch.map_err(RequestFault::defect("samples make no batch"))?)
}
