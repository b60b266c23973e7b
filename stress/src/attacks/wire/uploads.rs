//! Attacks by what Flight SQL's DoPut carries: parameters whose messages lie about what is in them.

use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array, RecordBatch, StringArray};
use arrow::error::ArrowError;
use arrow::ipc::CompressionType;
use arrow::ipc::writer::IpcWriteOptions;
use arrow_flight::encode::FlightDataEncoderBuilder;
use arrow_flight::error::FlightError;
use arrow_flight::sql::{
    ActionCreatePreparedStatementRequest, ActionCreatePreparedStatementResult, Any, CommandPreparedStatementQuery,
    ProstMessageExt as _,
};
use arrow_flight::{Action, FlightData, FlightDescriptor};
use futures::{StreamExt as _, TryStreamExt as _, stream};
use prost::Message as _;

use super::super::super::observed_server::{FlightClient, QueryClient, failure_outcome, flight_client};

/// A length that nothing in memory has.
const LYING_LENGTH: i64 = 1 << 62;
/// Bytes of a text that packs well.
const LONG_TEXT_BYTES: usize = 1 << 29;
/// Numbers that replace fields of a header.
const EXTREMES: [u32; 4] = [0x7fff_ffff, 0xffff_fff0, 0x8000_0000, 0x00ff_ffff];

/// Parameters for a statement.
#[derive(Debug, Clone, Copy)]
pub(crate) struct UploadAttack {
    pub name: &'static str,
    /// Makes the uploads, each the messages of one DoPut.
    uploads: fn() -> Result<Vec<Vec<FlightData>>, ArrowError>,
    /// Number of times that the last message of an upload is sent.
    repeats: usize,
}

pub(super) const ATTACKS: &[UploadAttack] = &[
    UploadAttack {
        name: "lz4 body declared 2^62 bytes",
        uploads: || lying_body(CompressionType::LZ4_FRAME),
        repeats: 1,
    },
    UploadAttack { name: "zstd body declared 2^62 bytes", uploads: || lying_body(CompressionType::ZSTD), repeats: 1 },
    UploadAttack { name: "zstd body of 512 MiB", uploads: zstd_bomb, repeats: 8 },
    UploadAttack { name: "headers with lying numbers", uploads: lying_headers, repeats: 1 },
    UploadAttack { name: "short bodies", uploads: short_bodies, repeats: 1 },
    UploadAttack {
        name: "batches without an end",
        uploads: || Ok(vec![encode_column(&number_column(), None)?]),
        repeats: 10_000_000,
    },
];

impl UploadAttack {
    /// Runs it until it ends or the client's connections are closed; returns how each upload ended.
    pub fn run(&self, client: &QueryClient) -> Vec<String> {
        let uploads = match (self.uploads)() {
            Ok(uploads) => uploads,
            Err(error) => return vec![format!("not made: {error}")],
        };
        uploads.into_iter().map(|upload| self.put(client, upload)).collect()
    }

    fn put(&self, client: &QueryClient, upload: Vec<FlightData>) -> String {
        match client.connections.run(put_parameters(client, upload, self.repeats)) {
            Some(Ok(())) => "answer".to_owned(),
            failed => failure_outcome(failed.and_then(Result::err)).to_string(),
        }
    }
}

async fn put_parameters(client: &QueryClient, mut upload: Vec<FlightData>, repeats: usize) -> Result<(), FlightError> {
    let mut flight = flight_client(client).await?;
    let command =
        CommandPreparedStatementQuery { prepared_statement_handle: prepare_statement(&mut flight).await?.into() };
    if let Some(first) = upload.first_mut() {
        first.flight_descriptor = Some(FlightDescriptor::new_cmd(command.as_any().encode_to_vec()));
    }
    let last = upload.pop().unwrap_or_default();
    let messages = stream::iter(upload).chain(stream::iter(std::iter::repeat_n(last, repeats)));
    let mut answers = flight.do_put(messages).await?;
    while answers.try_next().await?.is_some() {}
    Ok(())
}

// Returns the handle of a statement with a placeholder; the crate's own keeps it to itself.
async fn prepare_statement(flight: &mut FlightClient) -> Result<Vec<u8>, FlightError> {
    let request =
        ActionCreatePreparedStatementRequest { query: "select $1::bigint as n".to_owned(), transaction_id: None };
    let action = Action::new("CreatePreparedStatement", request.as_any().encode_to_vec());
    let mut results = flight.do_action(action).await?;
    let result = results.try_next().await?.unwrap_or_default();
    let wrong = |error: &dyn std::fmt::Display| FlightError::DecodeError(error.to_string());
    let any = Any::decode(result.body).map_err(|error| wrong(&error))?;
    let created = any.unpack::<ActionCreatePreparedStatementResult>()?;
    Ok(created.map_or_else(Vec::new, |created| created.prepared_statement_handle.to_vec()))
}

fn number_column() -> ArrayRef {
    Arc::new(Int64Array::from(vec![7; 1000]))
}

fn encode_column(column: &ArrayRef, compression: Option<CompressionType>) -> Result<Vec<FlightData>, ArrowError> {
    let batch = RecordBatch::try_from_iter([("$1", column.clone())])?;
    let options = IpcWriteOptions::default().try_with_compression(compression)?;
    let encoder = FlightDataEncoderBuilder::new().with_options(options).with_max_flight_data_size(usize::MAX);
    let encoded = encoder.build(stream::iter([Ok(batch)])).try_collect::<Vec<_>>();
    futures::executor::block_on(encoded).map_err(|error| ArrowError::ExternalError(Box::new(error)))
}

// Each buffer of a compressed body begins with its length as it was.
fn lying_body(compression: CompressionType) -> Result<Vec<Vec<FlightData>>, ArrowError> {
    let mut upload = encode_column(&number_column(), Some(compression))?;
    let honest = (8 * number_column().len() as i64).to_le_bytes();
    for message in &mut upload {
        let mut body = message.data_body.to_vec();
        if let Some(place) = body.windows(8).position(|bytes| bytes == honest) {
            body[place..place + 8].copy_from_slice(&LYING_LENGTH.to_le_bytes());
        }
        message.data_body = body.into();
    }
    Ok(vec![upload])
}

fn zstd_bomb() -> Result<Vec<Vec<FlightData>>, ArrowError> {
    let text: ArrayRef = Arc::new(StringArray::from(vec![" ".repeat(LONG_TEXT_BYTES)]));
    Ok(vec![encode_column(&text, Some(CompressionType::ZSTD))?])
}

// One number of the last header is another each time.
fn lying_headers() -> Result<Vec<Vec<FlightData>>, ArrowError> {
    let upload = encode_column(&number_column(), None)?;
    let length = upload.last().map_or(0, |message| message.data_header.len());
    let places = (0..length.saturating_sub(4)).step_by(4);
    Ok(places.flat_map(|place| EXTREMES.map(|number| with_number(&upload, place, number))).collect())
}

fn with_number(upload: &[FlightData], place: usize, number: u32) -> Vec<FlightData> {
    let mut changed = upload.to_vec();
    if let Some(last) = changed.last_mut() {
        let mut header = last.data_header.to_vec();
        header[place..place + 4].copy_from_slice(&number.to_le_bytes());
        last.data_header = header.into();
    }
    changed
}

fn short_bodies() -> Result<Vec<Vec<FlightData>>, ArrowError> {
    let upload = encode_column(&number_column(), None)?;
    let shortened = |length: usize| {
        let mut short = upload.clone();
        if let Some(last) = short.last_mut() {
            last.data_body = last.data_body.slice(..length.min(last.data_body.len()));
        }
        short
    };
    Ok([0, 1, 8, 100, 4000].map(shortened).to_vec())
}
