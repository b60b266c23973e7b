//! Rows of a pair on a surface, read without a plan: a page of one response needs few rows of six tables, and planning a
//! query for each takes longer than reading them.

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, UInt32Array};
use arrow::compute::{cast, concat_batches, take_record_batch};
use arrow::datatypes::{DataType, Float32Type, Float64Type, Int32Type, Int64Type};
use arrow::record_batch::RecordBatch;
use echolake_dsp::mean::SignalMean;
use echolake_lake::LakeSnapshot;
use echolake_query::{RowReading, Session};
use echolake_schema::RunId;
use echolake_schema::tables::Table;
use echolake_service::RequestFault;
use serde::Deserialize;
use serde::de::DeserializeOwned;

use super::environment::AirReading;
use super::pair::PairMeasurement;
use super::request::CatalogueRequest;
use super::rows::decode_rows;
use super::runs::RunLogEntry;
use super::snapshot::summary::SurfaceEntry;
use crate::request_protocol::request_protocol;

/// How `system.queries` lists the reading of these rows.
const LISTED_AS: &str = "(rows of a pair)";
const MEASUREMENT: [&str; 18] = [
    "ir",
    "log_time_ns",
    "run_id",
    "log_time",
    "attempt",
    "verdict",
    "reasons",
    "temperature_c",
    "humidity_pct",
    "pressure_hpa",
    "outside_level_db",
    "snr_db",
    "clipped_samples",
    "arrival_error_us",
    "microphone_residual_mm",
    "speaker_residual_mm",
    "source",
    "chunk_offset",
];
const ATTEMPT: [&str; 5] = ["log_time", "level", "name", "message", TIME];
const AIR: [&str; 5] = [TIME, "temperature_c", "humidity_pct", "pressure_hpa", "outside_level_db"];
const TIME: &str = "log_time_ns";
/// Log messages about a pair that are answered, and readings of the air.
const MOST_ATTEMPTS: usize = 200;
const MOST_READINGS: usize = 2000;

/// The rows of a pair on a surface.
#[derive(Clone)]
pub(super) struct PairRows {
    session: Arc<Session>,
    snapshot: Arc<LakeSnapshot>,
    surface: String,
    flat: String,
    pair: i32,
}

/// Responses and curves of a pair on one surface after Foam's response was subtracted: means over the surface's runs.
pub(super) struct PairResponses {
    /// None if Foam is missing.
    pub reflected: Option<Vec<f32>>,
    /// Rows that the means are over.
    pub pairs: i64,
    /// In the order of the wanted columns.
    pub bands: Vec<Option<Vec<f32>>>,
}

#[derive(Deserialize)]
struct MeasuredSamples {
    ir: Vec<f32>,
}

/// Rows of `tnce` of one run.
pub(super) struct PairEnergies(RecordBatch);

impl CatalogueRequest {
    /// Reads rows of a pair as a query is run: within the catalogue's limits, on threads of queries.
    ///
    /// # Errors
    /// Those of `read`, and what ended it.
    pub(super) async fn read_pair<T, F>(
        &self,
        entry: &SurfaceEntry,
        pair: usize,
        read: impl FnOnce(PairRows) -> F + Send + 'static,
    ) -> Result<T, RequestFault>
    where
        T: Send + 'static,
        F: Future<Output = Result<T, RequestFault>> + Send + 'static,
    {
        let rows = PairRows {
            session: self.view.session.clone(),
            snapshot: self.view.snapshot.clone(),
            surface: entry.surface.surface_id.clone(),
            flat: entry.surface.flat_reference.clone(),
            pair: pair as i32,
        };
        let service = self.catalogue.service();
        service.run_request(request_protocol(), self.view.session.client(), LISTED_AS, |_| read(rows)).await
    }
}

impl PairRows {
    /// Reads the newest measurement; None if there is none.
    ///
    /// # Errors
    /// The table's fault, or that of a file.
    pub async fn read_measurement(&self) -> Result<Option<PairMeasurement>, RequestFault> {
        Ok(decode_batch(&self.read_newest(&MEASUREMENT).await?)?.pop())
    }

    /// Reads the samples of the newest measurement; None if there is none.
    ///
    /// # Errors
    /// As [`Self::read_measurement`].
    pub async fn read_measured(&self) -> Result<Option<Vec<f32>>, RequestFault> {
        let newest = decode_batch::<MeasuredSamples>(&self.read_newest(&["ir"]).await?)?.pop();
        Ok(newest.map(|measured| measured.ir))
    }

    /// Reads the surface's response after Foam's was subtracted, and None if Foam is missing; None if the pair was not
    /// measured.
    ///
    /// # Errors
    /// As [`Self::read_measurement`].
    pub async fn read_own_reflected(&self) -> Result<Option<Option<Vec<f32>>>, RequestFault> {
        if self.read_newest(&["pair_id"]).await?.num_rows() == 0 {
            return Ok(None);
        }
        Ok(Some(mean_samples(self.read_nce(&self.surface, &["reflected_ir"]).await?.column(0))?))
    }

    // The row of the newest measurement; none if there is none.
    async fn read_newest(&self, columns: &[&str]) -> Result<RecordBatch, RequestFault> {
        let runs = self.runs_of(&self.surface);
        for run in runs.iter().rev() {
            let rows = self.read_rows(Table::Measurements, std::slice::from_ref(run), &[self.pair], columns).await?;
            if rows.num_rows() > 0 {
                return Ok(rows.slice(0, 1));
            }
        }
        self.read_rows(Table::Measurements, &[], &[], columns).await
    }

    /// Reads responses of the surface and of its Flat with these curves; None of one without rows.
    ///
    /// # Errors
    /// As [`Self::read_measurement`].
    pub async fn read_responses(&self, curves: &[String]) -> Result<[Option<PairResponses>; 2], RequestFault> {
        let columns: Vec<_> = std::iter::once("reflected_ir").chain(curves.iter().map(String::as_str)).collect();
        let (own, flat) =
            tokio::try_join!(self.read_nce(&self.surface, &columns), self.read_nce(&self.flat, &columns))?;
        Ok([PairResponses::from_rows(&own)?, PairResponses::from_rows(&flat)?])
    }

    /// Reads the responses of the surface and of its Flat after Foam's were subtracted, if they are known.
    ///
    /// # Errors
    /// As [`Self::read_measurement`].
    pub async fn read_reflected(&self) -> Result<[Option<Vec<f32>>; 2], RequestFault> {
        Ok(self.read_responses(&[]).await?.map(|found| found?.reflected))
    }

    /// Reads columns of `tnce` of some pairs in a run.
    ///
    /// # Errors
    /// As [`Self::read_measurement`].
    pub async fn read_energies(
        &self,
        run: &RunId,
        pairs: &[i32],
        columns: [&[String]; 4],
    ) -> Result<PairEnergies, RequestFault> {
        let columns: BTreeSet<_> = columns.into_iter().flatten().map(String::as_str).chain(["pair_id"]).collect();
        let columns: Vec<_> = columns.into_iter().collect();
        self.read_rows(Table::Tnce, std::slice::from_ref(run), pairs, &columns).await.map(PairEnergies)
    }

    /// Reads the first of what the controller of a run logged about the pair.
    ///
    /// # Errors
    /// As [`Self::read_measurement`].
    pub async fn read_attempts(&self, run: &RunId) -> Result<Vec<RunLogEntry>, RequestFault> {
        // The controller's messages about a pair begin so.
        let beginning = format!("pair {},", self.pair);
        let is_wanted = |rows: &RecordBatch, row: usize| {
            let messages = rows.column(3).as_string::<i32>();
            messages.is_valid(row) && messages.value(row).starts_with(&beginning)
        };
        self.read_first(Table::Events, run, &ATTEMPT, is_wanted, MOST_ATTEMPTS).await
    }

    /// Reads the first readings of the air during a run between two times, ns.
    ///
    /// # Errors
    /// As [`Self::read_measurement`].
    pub async fn read_air(&self, run: &RunId, first: i64, last: i64) -> Result<Vec<AirReading>, RequestFault> {
        let is_wanted = |rows: &RecordBatch, row: usize| {
            let times = rows.column(0).as_primitive::<Int64Type>();
            times.is_valid(row) && (first..=last).contains(&times.value(row))
        };
        self.read_first(Table::Environment, run, &AIR, is_wanted, MOST_READINGS).await
    }

    // The first rows by time of those that are wanted.
    async fn read_first<T: DeserializeOwned>(
        &self,
        table: Table,
        run: &RunId,
        columns: &[&str],
        is_wanted: impl Fn(&RecordBatch, usize) -> bool + Send,
        most: usize,
    ) -> Result<Vec<T>, RequestFault> {
        let failed = RequestFault::defect("rows of a run cannot be chosen");
        let read = self.session.read_run_rows(&self.snapshot, table, run, columns).await?;
        let mut kept = Vec::with_capacity(read.len());
        for batch in &read {
            let rows = (0..batch.num_rows()).filter(|row| is_wanted(batch, *row)).map(|row| row as u32);
            kept.push(take_record_batch(batch, &UInt32Array::from_iter_values(rows)).map_err(failed)?);
        }
        let Some(schema) = kept.first().map(RecordBatch::schema) else { return Ok(Vec::new()) };
        let kept = concat_batches(&schema, &kept).map_err(failed)?;
        let times = kept.column_by_name(TIME).map(|times| times.as_primitive::<Int64Type>().clone());
        let mut rows: Vec<_> = (0..kept.num_rows() as u32).collect();
        rows.sort_by_key(|row| times.as_ref().map(|times| times.value(*row as usize)));
        rows.truncate(most);
        decode_batch(&take_record_batch(&kept, &UInt32Array::from(rows)).map_err(failed)?)
    }

    async fn read_nce(&self, surface: &str, columns: &[&str]) -> Result<RecordBatch, RequestFault> {
        // Pages of all surfaces show Flat's rows.
        let reading = if surface == self.flat { RowReading::Kept } else { RowReading::Places };
        let runs = self.runs_of(surface);
        Ok(self.session.read_pair_rows(&self.snapshot, Table::Nce, &runs, &[self.pair], columns, reading).await?)
    }

    async fn read_rows(
        &self,
        table: Table,
        runs: &[RunId],
        pairs: &[i32],
        columns: &[&str],
    ) -> Result<RecordBatch, RequestFault> {
        let reading = RowReading::Places;
        Ok(self.session.read_pair_rows(&self.snapshot, table, runs, pairs, columns, reading).await?)
    }

    // By name and so by time.
    fn runs_of(&self, surface: &str) -> Vec<RunId> {
        let of_surface = self.snapshot.runs().filter(|run| run.surface.as_str() == surface);
        of_surface.map(|run| run.run.clone()).collect()
    }
}

impl PairResponses {
    fn from_rows(rows: &RecordBatch) -> Result<Option<Self>, RequestFault> {
        let Some((reflected, bands)) = rows.columns().split_first().filter(|_| rows.num_rows() > 0) else {
            return Ok(None);
        };
        let bands = bands.iter().map(mean_samples).collect::<Result<_, _>>()?;
        Ok(Some(Self { reflected: mean_samples(reflected)?, pairs: rows.num_rows() as i64, bands }))
    }
}

impl PairEnergies {
    /// Returns whether the pair has a row.
    pub fn has_pair(&self, pair: i32) -> bool {
        self.row_of(pair).is_some()
    }

    /// Returns values of a pair; None of what is not known, and if the pair has no row.
    ///
    /// # Errors
    /// A column that was not read, or is no number.
    pub fn find_values(&self, pair: i32, columns: &[String]) -> Result<Vec<Option<f64>>, RequestFault> {
        let Some(row) = self.row_of(pair) else { return Ok(vec![None; columns.len()]) };
        let value = |name: &String| {
            let column = self.0.column_by_name(name).ok_or(RequestFault::Internal)?.slice(row, 1);
            let number = cast(&column, &DataType::Float64).map_err(RequestFault::defect("an energy is no number"))?;
            let number = number.as_primitive::<Float64Type>();
            Ok(number.iter().next().flatten().filter(|value| value.is_finite()))
        };
        columns.iter().map(value).collect()
    }

    fn row_of(&self, pair: i32) -> Option<usize> {
        let pairs = self.0.column_by_name("pair_id")?.as_primitive::<Int32Type>();
        pairs.values().iter().position(|known| *known == pair)
    }
}

// The mean of lists, as `avg_list` computes it.
fn mean_samples(column: &ArrayRef) -> Result<Option<Vec<f32>>, RequestFault> {
    let mut mean = SignalMean::default();
    for samples in column.as_list::<i32>().iter().flatten() {
        let added = mean.add_signal(samples.as_primitive::<Float32Type>().values());
        added.map_err(RequestFault::defect("responses of a pair differ in length"))?;
    }
    let samples: Vec<_> = mean.mean_values().map(|sample| sample as f32).collect();
    if samples.iter().any(|sample| !sample.is_finite()) {
        tracing::error!("a response of a pair has samples that are not finite");
        return Err(RequestFault::Internal);
    }
    Ok((mean.count() > 0).then_some(samples))
}

fn decode_batch<T: DeserializeOwned>(rows: &RecordBatch) -> Result<Vec<T>, RequestFault> {
    decode_rows(LISTED_AS, rows)
}

#[cfg(test)]
mod tests;
