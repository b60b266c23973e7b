//! `GET /api/v1/surfaces/{surface_id}/pairs/{pair_id}`: everything about one impulse response.

use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array};
use arrow::record_batch::RecordBatch;
use serde::{Deserialize, Serialize};

use super::asked::{CatalogueRequest, long, missing, number, text};
use super::content::AnswerContent;
use super::curves::{CurveSet, PairSelection};
use super::environment::{AirReading, AirSeries};
use super::lake::{TOTAL, band_list, levels_db};
use super::runs::RunLogEntry;
use super::summary::SurfaceEntry;
use crate::fault::RequestFault;

/// Length of the air's history that is shown before and after a measurement.
const AROUND_NS: i64 = 900_000_000_000;

#[derive(Serialize)]
struct PairDetail<'a> {
    surface_id: &'a str,
    pair: PairDescription,
    measurement: &'a PairMeasurement,
    rate_hz: f64,
    measured: &'a [f64],
    reflected: Option<&'a [f64]>,
    flat_reflected: Option<&'a [f64]>,
    tnce_db: Vec<Option<f64>>,
    tnce_band_db: Vec<Option<f64>>,
    curves: Option<CurveSet>,
    symmetries: Vec<SymmetricPair>,
    attempts: Vec<RunLogEntry>,
    environment: AirSeries,
}

#[derive(Serialize)]
struct PairDescription {
    pair_id: usize,
    #[serde(flatten)]
    geometry: PairGeometry,
    fresnel: Vec<FresnelEllipse>,
}

#[derive(Serialize)]
struct FresnelEllipse {
    frequency_hz: f64,
    major_mm: f64,
    minor_mm: f64,
}

#[derive(Deserialize, Serialize)]
struct PairGeometry {
    microphone: i32,
    speaker: i32,
    microphone_mm: [f64; 3],
    speaker_mm: [f64; 3],
    direct_mm: f64,
    image_mm: f64,
    incidence_deg: f64,
    specular_mm: [f64; 2],
    #[serde(skip_serializing)]
    low_mm: [Option<f64>; 2],
    #[serde(skip_serializing)]
    high_mm: [Option<f64>; 2],
}

#[derive(Deserialize, Serialize)]
pub(super) struct PairMeasurement {
    #[serde(skip_serializing)]
    pub(super) ir: Vec<f64>,
    #[serde(skip_serializing)]
    log_time_ns: i64,
    run_id: String,
    log_time: String,
    attempt: i64,
    verdict: String,
    reasons: String,
    temperature_c: Option<f64>,
    humidity_pct: Option<f64>,
    pressure_hpa: Option<f64>,
    outside_level_db: Option<f64>,
    snr_db: Option<f64>,
    clipped_samples: Option<i64>,
    arrival_error_us: Option<f64>,
    microphone_residual_mm: Option<f64>,
    speaker_residual_mm: Option<f64>,
    source: String,
    chunk_offset: i64,
}

#[derive(Deserialize)]
pub(super) struct ReflectedResponse {
    surface_id: String,
    pub(super) reflected: Option<Vec<f64>>,
}

#[derive(Deserialize)]
struct PairEnergies {
    total: Vec<Option<f64>>,
    band: Vec<Option<f64>>,
}

#[derive(Serialize)]
struct SymmetricPair {
    symmetry: String,
    pair_id: i64,
    microphone: i64,
    speaker: i64,
    swapped: bool,
    tnce_db: Vec<Option<f64>>,
}

#[derive(Deserialize)]
struct SymmetryRow {
    symmetry: String,
    pair_id: i64,
    microphone: i64,
    speaker: i64,
    swapped: bool,
    energies: Vec<Option<f64>>,
}

const MEASUREMENT: &str = "select ir, log_time_ns, run_id, log_time, attempt, verdict, reasons, temperature_c, \
    humidity_pct, pressure_hpa, outside_level_db, snr_db, clipped_samples, arrival_error_us, microphone_residual_mm, \
    speaker_residual_mm, source, chunk_offset from measurements \
    where surface_id = $1 and pair_id = $2 order by run_id desc limit 1";
const GEOMETRY: &str = "select microphone, speaker, \
    make_array(microphone_x_mm, microphone_y_mm, microphone_z_mm) as microphone_mm, \
    make_array(speaker_x_mm, speaker_y_mm, speaker_z_mm) as speaker_mm, direct_mm, image_mm, incidence_deg, \
    make_array(specular_x_mm, specular_y_mm) as specular_mm, \
    make_array(fresnel_major_2000_mm, fresnel_minor_2000_mm) as low_mm, \
    make_array(fresnel_major_40000_mm, fresnel_minor_40000_mm) as high_mm from pairs where pair_id = $1";
const REFLECTED: &str = "select surface_id, avg_list(reflected_ir) as reflected from nce \
    where surface_id in ($1, $2) and pair_id = $3 group by surface_id";
const ATTEMPTS: &str = "select log_time, level, name, message from events \
    where run_id = $1 and message like $2 order by log_time_ns limit 200";
const AIR: &str = "select log_time_ns as ns, temperature_c, humidity_pct, pressure_hpa, outside_level_db \
    from environment where run_id = $1 and log_time_ns between $2 and $3 order by log_time_ns limit 2000";

impl CatalogueRequest {
    /// The pair that the path names.
    fn pair(&self) -> Result<usize, RequestFault> {
        let (text, pairs) = (self.part("pair_id"), self.catalogue.lake().grid().pairs().len());
        let digits = !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        match (digits, text.parse::<usize>()) {
            (true, Ok(pair)) if pair < pairs => Ok(pair),
            (true, _) => Err(missing(format!("pair `{text}`"), "table `pairs` lists what there is")),
            _ => Err(RequestFault::request(format!("the pair is `{text}`; hint: a whole number below {pairs}"))),
        }
    }
}

/// The newest measurement of the pair that the path names.
///
/// # Errors
/// [`RequestFault::NotFound`] if there is none.
pub(super) async fn measurement(
    asked: &CatalogueRequest,
    entry: &SurfaceEntry,
) -> Result<(usize, PairMeasurement), RequestFault> {
    let pair = asked.pair()?;
    let id = &entry.surface.surface_id;
    let found = asked.rows(MEASUREMENT, vec![text(id), number(pair)]).await?.into_iter().next();
    let what = || format!("a measurement of pair {pair} on surface `{id}`");
    Ok((pair, found.ok_or_else(|| missing(what(), "its run may be partial; another pair may be there"))?))
}

/// The responses of a surface and of its Flat after Foam's were subtracted, if they are known.
pub(super) async fn reflected(
    asked: &CatalogueRequest,
    entry: &SurfaceEntry,
    pair: usize,
) -> Result<[Option<Vec<f64>>; 2], RequestFault> {
    let (id, flat) = (&entry.surface.surface_id, &entry.surface.flat_reference);
    let rows: Vec<ReflectedResponse> = asked.rows(REFLECTED, vec![text(id), text(flat), number(pair)]).await?;
    let of = |surface: &str| rows.iter().find(|row| row.surface_id == surface).and_then(|row| row.reflected.clone());
    Ok([of(id), of(flat)])
}

/// Everything about one impulse response; as an Arrow stream its samples.
pub(super) async fn pair(asked: CatalogueRequest) -> Result<AnswerContent, RequestFault> {
    let entry = asked.surface().await?;
    let pair = asked.pair()?;
    let responses = tokio::try_join!(measurement(&asked, entry), reflected(&asked, entry, pair));
    let ((_, measurement), [own, flat]) = responses?;
    if asked.as_arrow {
        return samples(&asked, &measurement.ir, own.as_deref(), flat.as_deref());
    }
    let (geometry, energies, moved, curves, attempts, air) = tokio::try_join!(
        asked.rows::<PairGeometry>(GEOMETRY, vec![number(pair)]),
        energies(&asked, entry, pair, &measurement.run_id),
        symmetries(&asked, entry, pair, &measurement.run_id),
        CurveSet::read(&asked, entry, PairSelection::Pair(pair), usize::MAX),
        // The controller's messages about a pair begin so.
        asked.rows::<RunLogEntry>(ATTEMPTS, vec![text(&measurement.run_id), text(&format!("pair {pair},%"))]),
        asked.rows::<AirReading>(
            AIR,
            vec![
                text(&measurement.run_id),
                long(measurement.log_time_ns.saturating_sub(AROUND_NS)),
                long(measurement.log_time_ns.saturating_add(AROUND_NS)),
            ],
        ),
    )?;
    let geometry = geometry.into_iter().next().ok_or_else(|| missing(format!("pair {pair}"), "ask for another one"))?;
    AnswerContent::json(&PairDetail {
        surface_id: &entry.surface.surface_id,
        pair: geometry.pair(pair),
        environment: AirSeries::new(air, measurement.log_time_ns, &measurement.log_time),
        measured: &measurement.ir,
        measurement: &measurement,
        rate_hz: asked.catalogue.lake().rig().sweep.rate_hz.get(),
        reflected: own.as_deref(),
        flat_reflected: flat.as_deref(),
        tnce_db: levels_db(&energies.total),
        tnce_band_db: levels_db(&energies.band),
        curves: Some(curves).filter(CurveSet::is_there),
        symmetries: moved,
        attempts,
    })
}

impl PairGeometry {
    fn pair(self, pair_id: usize) -> PairDescription {
        let zone = |frequency_hz: f64, [major, minor]: [Option<f64>; 2]| {
            Some(FresnelEllipse { frequency_hz, major_mm: major?, minor_mm: minor? })
        };
        let fresnel = [zone(2000.0, self.low_mm), zone(40_000.0, self.high_mm)].into_iter().flatten().collect();
        PairDescription { pair_id, geometry: self, fresnel }
    }
}

async fn energies(
    asked: &CatalogueRequest,
    entry: &SurfaceEntry,
    pair: usize,
    run: &str,
) -> Result<PairEnergies, RequestFault> {
    let rig = asked.catalogue.lake().rig();
    let total = band_list(rig, |band| format!("tnce_{band}"));
    let band = band_list(rig, |band| if band == TOTAL { "tnce_total".into() } else { format!("tnce_band_{band}") });
    let sql = format!(
        "select {total} as total, {band} as band from tnce where surface_id = $1 and pair_id = $2 and run_id = $3"
    );
    let values = vec![text(&entry.surface.surface_id), number(pair), text(run)];
    let nothing = vec![None; rig.band_names().len() + 1];
    let found = asked.rows(&sql, values).await?.into_iter().next();
    Ok(found.unwrap_or_else(|| PairEnergies { total: nothing.clone(), band: nothing }))
}

async fn symmetries(
    asked: &CatalogueRequest,
    entry: &SurfaceEntry,
    pair: usize,
    run: &str,
) -> Result<Vec<SymmetricPair>, RequestFault> {
    let energies = band_list(asked.catalogue.lake().rig(), |band| format!("t.tnce_{band}"));
    let sql = format!(
        "select d.symmetry, d.d4_pair_id as pair_id, d.d4_microphone as microphone, d.d4_speaker as speaker, d.swapped, \
         {energies} as energies from tnce_d4 d join tnce t on t.surface_id = d.surface_id and t.run_id = d.run_id \
         and t.pair_id = d.d4_pair_id where d.surface_id = $1 and d.pair_id = $2 and d.run_id = $3 \
         and t.surface_id = $1 and t.run_id = $3 order by d.symmetry"
    );
    let rows = asked.rows(&sql, vec![text(&entry.surface.surface_id), number(pair), text(run)]).await?;
    let levels = |row: SymmetryRow| SymmetricPair {
        symmetry: row.symmetry,
        pair_id: row.pair_id,
        microphone: row.microphone,
        speaker: row.speaker,
        swapped: row.swapped,
        tnce_db: levels_db(&row.energies),
    };
    Ok(rows.into_iter().map(levels).collect())
}

fn samples(
    asked: &CatalogueRequest,
    measured: &[f64],
    own: Option<&[f64]>,
    flat: Option<&[f64]>,
) -> Result<AnswerContent, RequestFault> {
    let rate_hz = asked.catalogue.lake().rig().sweep.rate_hz.get();
    let times = (0..measured.len()).map(|i| Some(1000.0 * i as f64 / rate_hz));
    let column = |values: Option<&[f64]>| -> ArrayRef {
        let values = values.unwrap_or_default();
        Arc::new((0..measured.len()).map(|i| values.get(i).copied()).collect::<Float64Array>())
    };
    let columns: [(&str, ArrayRef); 4] = [
        ("time_ms", Arc::new(times.collect::<Float64Array>())),
        ("measured", column(Some(measured))),
        ("reflected", column(own)),
        ("flat_reflected", column(flat)),
    ];
    let batch = RecordBatch::try_from_iter_with_nullable(columns.map(|(name, values)| (name, values, true)));
    AnswerContent::arrow(&batch.map_err(|e| {
        eprintln!("samples make no batch: {e}");
        RequestFault::Internal
    })?)
}
