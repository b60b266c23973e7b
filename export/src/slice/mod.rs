//! Slices of run files: the messages of just some measurements, as an MCAP file of their own.

mod groups;
mod outline;
mod repeats;
mod source;
mod writer;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, VecDeque};

use arrow::array::AsArray as _;
use arrow::compute::cast;
use arrow::datatypes::{DataType, Int32Type, Int64Type};
use arrow::record_batch::RecordBatch;
use bytes::Bytes;
use echolake_lake::{Lake, LakeSnapshot};
use echolake_recording::Metadata;
use echolake_schema::{RunId, SurfaceId, topics};
use futures::stream::{self, BoxStream, StreamExt as _};

use crate::error::{Error, Result};
use crate::rows;
use groups::{Groups, is_once};
pub use outline::{Outline, OutlineSchema, OutlineTopic, outline_slice};
use repeats::WrittenContents;
use source::{Message, RunFile, Source};
use writer::SliceWriter;

/// Topics that stand in a run's file once, and in every slice of it. A run that shows what the one before it showed
/// adds nothing.
const ONCE: [&str; 3] = [topics::PANEL_SCENE, topics::PANEL_POINTS, topics::ROBOT_DESCRIPTION];
/// Metadata record of a slice: what it was cut from.
const SLICE_METADATA: &str = "echolake.slice";
/// Metadata record of each of its runs: the run's own manifest. Under another name than in a run's file, so that no
/// slice is ever taken for a run.
const SLICE_RUN_METADATA: &str = "echolake.slice.run";
/// Key in it, before an attachment's name in the run's file: the slice's attachment with these bytes, if that has
/// another run's name.
const SAME_ATTACHMENT: &str = "attachment.";

/// A measurement that a slice is to have, as table `measurements` has it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Taken {
    /// Its run.
    pub run: RunId,
    /// Its pair.
    pub pair: u32,
    /// Its attempt.
    pub attempt: u32,
    /// Its time, ns since 1970.
    pub log_time_ns: i64,
}

impl Taken {
    /// The columns of `measurements` that [`Taken::of_batch`] wants.
    pub const COLUMNS: [&str; 4] = ["run_id", "pair_id", "attempt", "log_time_ns"];

    /// The measurements of rows with [`Taken::COLUMNS`].
    ///
    /// # Errors
    /// [`Error::Damaged`] where a column is missing or another's, or a number is below 0.
    pub fn of_batch(batch: &RecordBatch) -> Result<Vec<Self>> {
        let [run, pair, attempt, time] = Self::COLUMNS;
        let damaged = |reason: String| Error::damaged("measurements", reason);
        let negative = |column: &str, value: i64| damaged(format!("{column} is {value}"));
        let runs = batch.column_by_name(run).and_then(|c| cast(c, &DataType::Utf8).ok());
        let runs = runs.ok_or_else(|| damaged(format!("no column {run}")))?;
        let pairs = rows::number_column::<Int32Type>(batch, pair)?;
        let attempts = rows::number_column::<Int32Type>(batch, attempt)?;
        let times = rows::number_column::<Int64Type>(batch, time)?;
        if let Some(early) = times.iter().find(|time| **time < 0) {
            return Err(negative(time, *early));
        }
        let number = |column: &str, value: i32| u32::try_from(value).map_err(|_| negative(column, value.into()));
        let row = |(row, run): (usize, Option<&str>)| {
            let pair = number(pair, pairs[row])?;
            let attempt = number(attempt, attempts[row])?;
            Ok(Self { run: run.unwrap_or_default().parse()?, pair, attempt, log_time_ns: times[row] })
        };
        runs.as_string::<i32>().iter().enumerate().map(row).collect()
    }

    // As messages have it.
    fn message_time(&self) -> u64 {
        u64::try_from(self.log_time_ns).unwrap_or(0)
    }
}

/// In which chunks messages stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Layout {
    /// Heavy topics in chunks of their own, so that who reads poses by ranges does not fetch sweeps. Each chunk is
    /// ascending in time, and the index tells which comes when.
    #[default]
    ByTopic,
    /// All messages of the file ascend in time, for those who read it as it comes.
    InTime,
}

/// How a run's file is compared with the one that was ingested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Check {
    /// Its size, its index and the run that it names; chunks that are read are checked by their CRCs.
    Ends,
    /// Its SHA-256 too: all of it is read.
    #[default]
    Whole,
}

/// What a slice is made of.
#[derive(Debug, Clone, Default)]
pub struct SliceParams {
    /// The measurements.
    pub taken: Vec<Taken>,
    /// The topics; all, and the attachments, where it is empty.
    pub topics: Vec<String>,
    /// The layout.
    pub layout: Layout,
    /// How run files are checked.
    pub check: Check,
}

/// The messages of one measurement.
pub(crate) struct Measured {
    /// Its run.
    pub run: RunId,
    /// The run's file.
    pub file: String,
    messages: Vec<Message>,
}

impl Measured {
    /// Time and content of the first message of a topic.
    pub fn first_message(&self, topic: &str) -> Option<(i64, Bytes)> {
        let found = self.messages.iter().find(|m| m.channel.topic == topic)?;
        Some((i64::try_from(found.log_time).unwrap_or(0), found.data.clone()))
    }
}

/// A run whose wanted measurements are read one after the other.
pub(crate) struct OpenedRun(Groups);

impl OpenedRun {
    pub async fn next(&mut self) -> Result<Option<Measured>> {
        let run = self.run().clone();
        let file = self.file().to_owned();
        Ok(self.0.next().await?.map(|messages| Measured { run, file, messages }))
    }

    pub fn run(&self) -> &RunId {
        &self.0.source.file.run
    }

    pub fn surface(&self) -> &SurfaceId {
        &self.0.source.file.surface
    }

    pub fn file(&self) -> &str {
        self.0.source.file.path.as_ref()
    }
}

/// Opens the runs of measurements, each checked.
pub(crate) async fn open_runs(lake: &Lake, taken: &[Taken], check: Check) -> Result<Vec<OpenedRun>> {
    let mut opened = Vec::new();
    for (file, taken) in run_files(lake, &lake.whole_snapshot().await?, taken.to_vec()).await? {
        let source = Source::open(lake.store(), file, check).await?;
        opened.push(OpenedRun(Groups::new(source, &taken, &[])));
    }
    Ok(opened)
}

// The runs of measurements with their files, by their start; at least one.
async fn run_files(lake: &Lake, snapshot: &LakeSnapshot, taken: Vec<Taken>) -> Result<Vec<(RunFile, Vec<Taken>)>> {
    if taken.is_empty() {
        return Err(Error::Nothing { reason: "no measurement is selected".into() });
    }
    let mut by_run: BTreeMap<RunId, Vec<Taken>> = BTreeMap::new();
    for one in taken {
        match by_run.get_mut(&one.run) {
            Some(of_run) => of_run.push(one),
            None => drop(by_run.insert(one.run.clone(), vec![one])),
        }
    }
    let mut runs = Vec::new();
    for (run, taken) in by_run {
        runs.push((RunFile::find_run(lake, snapshot, &run).await?, taken));
    }
    runs.sort_by_key(|(file, _)| file.started_ns);
    Ok(runs)
}

/// A slice that is being cut. Its memory is bounded by a chunk a heavy topic and a measurement a run that is open.
pub struct Slice {
    lake: Lake,
    /// All where none are named.
    topics: Vec<String>,
    /// Runs that are still to be opened, by their start.
    runs: VecDeque<(RunFile, Vec<Taken>)>,
    /// The first of them, which most slices have no others beside, is opened already.
    first: Option<Source>,
    /// Its name.
    lead: RunId,
    open: Vec<OpenRun>,
    several: bool,
    waiting: BinaryHeap<Reverse<Waiting>>,
    arrived: u64,
    last_time: u64,
    written: WrittenContents,
    writer: Option<SliceWriter>,
}

/// A run whose next measurement is read.
struct OpenRun {
    groups: Groups,
    next: Vec<Message>,
}

/// A message that goes out when nothing earlier can come.
struct Waiting {
    order: (u64, u64),
    message: Message,
}

impl PartialEq for Waiting {
    fn eq(&self, other: &Self) -> bool {
        self.order == other.order
    }
}

impl Eq for Waiting {}

impl PartialOrd for Waiting {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Waiting {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.order.cmp(&other.order)
    }
}

impl Slice {
    /// Checks everything that can be known to fail: the runs' files, and the topics. A server gives the snapshot that
    /// it has, because taking one costs more than the first bytes of a slice.
    ///
    /// # Errors
    /// [`Error::Nothing`] without measurements, [`Error::Unknown`] for a topic that none of the runs has,
    /// [`Error::Changed`] for a file that is not the ingested one.
    pub async fn open(lake: &Lake, snapshot: &LakeSnapshot, params: SliceParams) -> Result<Self> {
        let SliceParams { taken, topics, layout, check } = params;
        let runs = run_files(lake, snapshot, taken).await?;
        let mut known = BTreeSet::new();
        let mut first = None;
        let lead = runs[0].0.run.clone();
        for (file, _) in &runs {
            let source = Source::open(lake.store(), file.clone(), check).await?;
            known.extend(source.channels.values().map(|c| c.topic.clone()));
            first.get_or_insert(source);
        }
        check_topics(&topics, &known)?;
        let mut writer = SliceWriter::new(layout)?;
        writer.write_metadata(slice_metadata(&runs, &topics))?;
        Ok(Self {
            lake: lake.clone(),
            several: runs.len() > 1,
            runs: runs.into(),
            first,
            lead,
            topics,
            open: Vec::new(),
            waiting: BinaryHeap::new(),
            arrived: 0,
            last_time: 0,
            written: WrittenContents::default(),
            writer: Some(writer),
        })
    }

    /// The next bytes of the file; None after the last.
    ///
    /// # Errors
    /// [`Error`]; the file is not whole then.
    pub async fn next(&mut self) -> Result<Option<Bytes>> {
        loop {
            let Some(writer) = &mut self.writer else { return Ok(None) };
            if let Some(piece) = writer.take_written() {
                return Ok(Some(piece));
            }
            if !self.advance_one().await? {
                self.release_until(u64::MAX)?;
                return self.writer.take().map(SliceWriter::finish).transpose();
            }
        }
    }

    /// The file as a stream, for those who send it.
    pub fn into_stream(self) -> BoxStream<'static, Result<Bytes>> {
        stream::try_unfold(self, |mut slice| async move { Ok(slice.next().await?.map(|piece| (piece, slice))) }).boxed()
    }

    // Goes on by one measurement; false after the last.
    async fn advance_one(&mut self) -> Result<bool> {
        let head = |run: &OpenRun| run.next.first().map_or(0, |m| m.log_time);
        let earliest = (0..self.open.len()).min_by_key(|i| head(&self.open[*i]));
        let at = earliest.map(|i| head(&self.open[i]));
        let starts = self.runs.front().map(|(file, _)| file.started_ns);
        match (earliest, starts) {
            (None, None) => return Ok(false),
            (Some(i), starts) if starts.is_none_or(|s| at.is_some_and(|at| at < s)) => {
                self.release_until(at.unwrap_or(0))?;
                let run = &mut self.open[i];
                let group = std::mem::take(&mut run.next);
                match run.groups.next().await? {
                    Some(next) => run.next = next,
                    None => drop(self.open.remove(i)),
                }
                group.into_iter().for_each(|message| self.queue_message(message));
            }
            _ => self.open_next().await?,
        }
        Ok(true)
    }

    async fn open_next(&mut self) -> Result<()> {
        let Some((file, taken)) = self.runs.pop_front() else { return Ok(()) };
        self.release_until(file.started_ns)?;
        let source = match self.first.take() {
            Some(source) => source,
            None => Source::open(self.lake.store(), file, Check::Ends).await?,
        };
        let mut metadata = source.manifest.clone();
        // They are attached where nothing is left out.
        if self.topics.is_empty() {
            metadata.extend(self.attach_all(&source).await?);
        }
        if let Some(writer) = &mut self.writer {
            writer.write_metadata(Metadata { name: SLICE_RUN_METADATA.into(), metadata })?;
        }
        let mut groups = Groups::new(source, &taken, &self.topics);
        while let Some(messages) = groups.next_once().await? {
            messages.into_iter().for_each(|message| self.queue_message(message));
        }
        if let Some(next) = groups.next().await? {
            self.open.push(OpenRun { groups, next });
        }
        Ok(())
    }

    // Returns references to attachments that an earlier run has brought.
    async fn attach_all(&mut self, source: &Source) -> Result<BTreeMap<String, String>> {
        let mut references = BTreeMap::new();
        let mut number = 0;
        while let (Some(mut attachment), Some(writer)) = (source.read_attachment(number).await?, &mut self.writer) {
            number += 1;
            if self.several {
                let name = format!("{}/{}", source.file.run, attachment.name);
                if let Some(known) = self.written.attached_name(&name, &attachment.data) {
                    references.insert(format!("{SAME_ATTACHMENT}{}", attachment.name), known);
                    continue;
                }
                attachment.name = name;
            }
            writer.write_attachment(&attachment)?;
        }
        Ok(references)
    }

    fn queue_message(&mut self, message: Message) {
        if is_named(&self.topics, &message.channel.topic) {
            self.arrived += 1;
            self.waiting.push(Reverse(Waiting { order: (message.log_time, self.arrived), message }));
        }
    }

    // Writes what is earlier than anything that is still to come.
    fn release_until(&mut self, until: u64) -> Result<()> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        while self.waiting.peek().is_some_and(|Reverse(w)| w.order.0 < until || until == u64::MAX) {
            let Some(Reverse(Waiting { message, .. })) = self.waiting.pop() else { break };
            if message.log_time < self.last_time {
                let run = self.open.first().map_or(&self.lead, |open| &open.groups.source.file.run).clone();
                return Err(Error::Uncuttable { run, reason: "its measurements are not in the order of time".into() });
            }
            self.last_time = message.log_time;
            if !self.written.is_repeat(&message) {
                writer.write_message(message)?;
            }
        }
        Ok(())
    }
}

// Whether a topic is among those of a slice; where none are named, all are.
fn is_named(topics: &[String], topic: &str) -> bool {
    topics.is_empty() || topics.iter().any(|named| named == topic)
}

fn check_topics(topics: &[String], known: &BTreeSet<String>) -> Result<()> {
    let Some(missing) = topics.iter().find(|t| !known.contains(*t)) else { return Ok(()) };
    let known = known.iter().map(String::as_str).collect::<Vec<_>>().join(", ");
    Err(Error::Unknown { kind: "topic", name: missing.clone(), known })
}

fn slice_metadata(runs: &[(RunFile, Vec<Taken>)], topics: &[String]) -> Metadata {
    let measurements: usize = runs.iter().map(|(_, taken)| taken.len()).sum();
    let mut metadata = BTreeMap::from([
        ("format".to_owned(), "1".to_owned()),
        ("software".to_owned(), concat!("echolake ", env!("CARGO_PKG_VERSION")).to_owned()),
        ("measurements".to_owned(), measurements.to_string()),
        ("topics".to_owned(), topics.join(",")),
    ]);
    // What each run's file was, so that a slice can be checked against it.
    metadata.extend(
        runs.iter()
            .map(|(file, taken)| (format!("run.{}", file.run), format!("{} of sha256:{}", taken.len(), file.sha256))),
    );
    Metadata { name: SLICE_METADATA.into(), metadata }
}
