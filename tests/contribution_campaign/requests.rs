//! What the clients of a campaign send: annotations and predictions by a seeded generator, each with the rows that it
//! becomes.

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, Int32Array, RecordBatch, StringArray};
use arrow::ipc::writer::StreamWriter;
use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};

use super::super::serve::http::{HttpRequest, HttpResponse};
use super::super::serve::server::ANSWER_LIMIT;

/// The runs of the lake: surface and project of each.
pub(super) const RUNS: [(&str, Option<&str>); 4] =
    [("flat", None), ("foam", None), ("brick_wall", Some("alpha")), ("brick_wall", Some("beta"))];
/// The clients: name and project. The last one sees both projects, and may judge references.
pub(super) const CLIENTS: [(&str, Option<&str>); 3] = [("ann", Some("alpha")), ("bob", Some("beta")), ("eve", None)];
/// The number of the last one.
pub(super) const EVE: usize = 2;
/// Pairs of the rig.
const PAIRS: i32 = 45;

/// The tables, with the columns that tell one row from another.
pub(super) const TABLES: [(&str, &[&str]); 2] = [
    (
        "annotations",
        &["surface_id", "run_id", "project", "pair_ids", "kind", "value", "comment", "author", "annotation_id"],
    ),
    ("predictions", &["surface_id", "run_id", "project", "model", "model_version", "pair_id", "author", "tnce_10000"]),
];
/// The numbers of the tables.
pub(super) const ANNOTATIONS: usize = 0;
pub(super) const PREDICTIONS: usize = 1;

/// A row that is to be stored: the project of its run, and its text.
type NewRow = (Option<&'static str>, String);
/// An annotation as it is sent, and the row that it becomes.
type DrawnAnnotation = (Value, NewRow);

/// A request, and the rows that are stored once it is acknowledged.
pub(super) struct SentRows {
    pub client: usize,
    pub table: usize,
    pub path: String,
    body: Vec<u8>,
    pub rows: Vec<NewRow>,
}

/// Predictions of one version of a model, by run and pair.
#[derive(Clone)]
pub(super) struct PredictedValues {
    pub client: usize,
    version: usize,
    /// The project that the request names.
    project: Option<&'static str>,
    /// Runs that it may have values of.
    runs: Vec<usize>,
    pub values: BTreeMap<(usize, i32), f64>,
}

/// The generator, and what it needs of the lake.
pub(super) struct RequestSource {
    pub random: ChaCha8Rng,
    /// By number of [`RUNS`].
    run_ids: Vec<String>,
    /// The last number that each client used in a name.
    numbers: [usize; CLIENTS.len()],
}

impl RequestSource {
    pub fn new(seed: u64, run_ids: Vec<String>) -> Self {
        Self { random: ChaCha8Rng::seed_from_u64(seed), run_ids, numbers: [0; CLIENTS.len()] }
    }

    pub fn draw_annotations(&mut self, client: usize) -> SentRows {
        let runs = visible_runs(client);
        let count = self.random.random_range(1..=3);
        let mut drawn = Vec::new();
        for _ in 0..count {
            let run = runs[self.random.random_range(0..runs.len())];
            let kind = match (self.random.random_range(0..3), RUNS[run].1) {
                (0, Some(_)) => "verdict",
                (1, _) => "label",
                _ => "note",
            };
            drawn.push(self.draw_annotation(client, run, kind));
        }
        self.annotation_request(client, drawn, false)
    }

    pub fn draw_annotation(&mut self, client: usize, run: usize, kind: &str) -> DrawnAnnotation {
        let number = self.next_number(client);
        let (name, project) = CLIENTS[client];
        let (surface, owner) = RUNS[run];
        // Both projects use the same names on their own runs.
        let prefix = if project.is_some() && owner.is_some() { "note" } else { name };
        let verdict = if self.random.random() { "rejected" } else { "accepted" };
        let value = match kind {
            "verdict" => verdict,
            "label" => "odd",
            _ => "",
        };
        let mut annotation = json!({
            "annotation_id": format!("{prefix}-{number}"), "run_id": self.run_ids[run], "kind": kind, "value": value,
            "comment": format!("seen by {name}"),
        });
        if kind == "verdict" || self.random.random() {
            let first = self.random.random_range(0..PAIRS - 1);
            annotation["pair_ids"] = json!([first, first + 1]);
        }
        let mut row = annotation.clone();
        row["surface_id"] = json!(surface);
        row["project"] = json!(owner);
        row["author"] = json!(name);
        (annotation, (owner, row_text(ANNOTATIONS, &row)))
    }

    pub fn annotation_request(&self, client: usize, drawn: Vec<DrawnAnnotation>, is_confirmed: bool) -> SentRows {
        let (annotations, rows): (Vec<_>, Vec<_>) = drawn.into_iter().unzip();
        let body = json!({ "annotations": annotations, "confirm_rederivation": is_confirmed }).to_string();
        SentRows { client, table: ANNOTATIONS, path: "/api/v1/annotations".to_owned(), body: body.into(), rows }
    }

    pub fn draw_predictions(&mut self, client: usize) -> PredictedValues {
        let version = self.next_number(client);
        let mut runs = visible_runs(client);
        // A client who sees both projects names one, and then sends no rows of the references.
        if client == EVE {
            let of_one = vec![self.random.random_range(2..RUNS.len())];
            runs = if self.random.random() { of_one } else { vec![0, 1] };
        }
        let project = RUNS[runs[0]].1;
        let mut predicted = PredictedValues { client, version, project, runs, values: BTreeMap::new() };
        for _ in 0..self.random.random_range(1..=4) {
            self.draw_value(&mut predicted);
        }
        predicted
    }

    /// Adds a value, unless there is one of its run and pair.
    pub fn draw_value(&mut self, predicted: &mut PredictedValues) {
        let run = predicted.runs[self.random.random_range(0..predicted.runs.len())];
        // Both projects predict the same pairs of their surface by a model of the same name, and others of references.
        let pair = match RUNS[run].1 {
            Some(_) => self.random.random_range(0..PAIRS),
            None => 3 * self.random.random_range(0..PAIRS / 3) + predicted.client as i32,
        };
        let value = f64::from(self.random.random_range(1..64)) / 64.0;
        predicted.values.entry((run, pair)).or_insert(value);
    }

    /// A request with the values of these runs and pairs, in this order.
    pub fn prediction_request(&self, predicted: &PredictedValues, keys: &[(usize, i32)]) -> SentRows {
        let PredictedValues { client, version, project, values, .. } = predicted;
        let surfaces: ArrayRef = Arc::new(StringArray::from_iter_values(keys.iter().map(|(run, _)| RUNS[*run].0)));
        let pairs: ArrayRef = Arc::new(Int32Array::from_iter_values(keys.iter().map(|(_, pair)| *pair)));
        let sent: ArrayRef = Arc::new(Float64Array::from_iter_values(keys.iter().map(|key| values[key])));
        let columns = [("surface_id", surfaces), ("pair_id", pairs), ("tnce_10000", sent)];
        let batch = RecordBatch::try_from_iter(columns).expect("rows");
        let mut writer = StreamWriter::try_new(Vec::new(), &batch.schema()).expect("a stream");
        writer.write(&batch).and_then(|()| writer.finish()).expect("written");
        let body = writer.into_inner().expect("bytes");
        let model = if *client == EVE { "rnn" } else { "cnn" };
        let named = project.map(|project| format!("&project={project}")).unwrap_or_default();
        let path = format!("/api/v1/predictions?model={model}&version={version}{named}");
        let row = |key: &(usize, i32)| {
            let (surface, owner) = RUNS[key.0];
            let row = json!({
                "surface_id": surface, "run_id": self.run_ids[key.0], "project": owner, "model": model,
                "model_version": version.to_string(), "pair_id": key.1, "author": CLIENTS[*client].0,
                "tnce_10000": values[key],
            });
            (owner, row_text(PREDICTIONS, &row))
        };
        SentRows { client: *client, table: PREDICTIONS, path, body, rows: keys.iter().map(row).collect() }
    }

    fn next_number(&mut self, client: usize) -> usize {
        self.numbers[client] += 1;
        self.numbers[client]
    }
}

impl PredictedValues {
    /// A value for the surface of a run, of whose project it is.
    pub fn of_run(client: usize, run: usize) -> Self {
        let values = BTreeMap::from([((run, 0), 0.5)]);
        Self { client, version: 0, project: RUNS[run].1, runs: vec![run], values }
    }

    /// The runs and pairs that it has values of.
    pub fn keys(&self) -> Vec<(usize, i32)> {
        self.values.keys().copied().collect()
    }
}

impl SentRows {
    /// The request, which may be sent again.
    pub fn http_request(&self) -> HttpRequest {
        let media = if self.table == ANNOTATIONS { "application/json" } else { "application/vnd.apache.arrow.stream" };
        HttpRequest::post_bytes(&self.path, self.body.clone()).with("content-type", media)
    }
}

/// The status and JSON of an answer; None if no whole one came.
pub(super) fn send_request(address: &str, token: &str, request: HttpRequest) -> Option<(u16, Value)> {
    let request = request.with("authorization", &format!("Bearer {token}"));
    let mut stream = TcpStream::connect(address).ok()?;
    stream.set_read_timeout(Some(ANSWER_LIMIT)).expect("a limit");
    stream.write_all(&request.bytes(address)).ok()?;
    let mut bytes = Vec::new();
    // A server that was killed leaves what it had sent.
    let _ = stream.read_to_end(&mut bytes);
    let answer = HttpResponse::read(&bytes).filter(|answer| answer.is_whole)?;
    Some((answer.status, serde_json::from_slice(&answer.body).ok()?))
}

/// Returns whether a client may see rows of a project.
pub(super) fn is_visible(client: usize, project: Option<&str>) -> bool {
    CLIENTS[client].1.is_none() || project.is_none() || project == CLIENTS[client].1
}

fn visible_runs(client: usize) -> Vec<usize> {
    (0..RUNS.len()).filter(|run| is_visible(client, RUNS[*run].1)).collect()
}

/// The text of a row, the same of an answer, of an independent reader, and as it is expected.
pub(super) fn row_text(table: usize, row: &Value) -> String {
    TABLES[table].1.iter().map(|column| row[*column].to_string()).collect::<Vec<_>>().join(" ")
}
