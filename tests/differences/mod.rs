//! SQL beside DuckDB: statements whose right answer is written down, and generated ones, whose answers are compared
//! value by value.
//!
//! The short form is among the tests; the long one is `stress sql-differences`, which shrinks the statement of each
//! difference. What differs by design is in [`DOCUMENTED`], and from there in `docs/duckdb.md`.

mod answer_rows;
mod documented;
#[cfg(all(test, feature = "lake"))]
mod hand_written;
mod peer;
mod query_generator;
mod shrinker;
mod statement_generator;
#[cfg(all(test, feature = "lake"))]
mod tests;

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use arrow::array::RecordBatch;
use echolake_acquisition::run::controller::RecordingMode;
use echolake_ingest::{LakeIngest, pending_runs};
use echolake_lake::{Lake, ReferenceSurfaces};
use echolake_query::{EngineClient, Error, QueryEngine, QueryQuota, Session};
use echolake_schema::Rig;
use echolake_schema::tables::Table;
use echolake_testing::{SMALL_RIG, simulate_run};
use parquet::arrow::ArrowWriter;
use tokio::runtime::Runtime;

pub(crate) use answer_rows::{AnswerRows, RowOrder, find_difference};
pub(crate) use documented::{DOCUMENTED, DocumentedDifference, find_documented};
use documented::{PEER_SETTINGS, peer_text};
#[cfg(all(test, feature = "lake"))]
use hand_written::{ExpectedAnswer, hand_written_statements};
pub(crate) use peer::{DuckdbPeer, PeerTables, install_duckdb};
pub(crate) use query_generator::QueryGenerator;
use shrinker::shrink_statement;
use statement_generator::VIEWS;
pub(crate) use statement_generator::{DifferenceStatement, StatementGenerator};

/// Most rows of an answer that is compared.
const MOST_ROWS: u64 = 30_000;
/// Most time of a statement.
const TIME_LIMIT: Duration = Duration::from_secs(20);
/// Most time of the search for a smaller statement.
const SHRINK_LIMIT: Duration = Duration::from_secs(60);
/// Memory of all statements at a time, bytes.
const MEMORY: usize = 1 << 30;
/// Surfaces of the lake and their reliefs.
const SURFACES: [(&str, &str); 3] = [("flat", "flat"), ("foam", "foam"), ("0001_0", "macrostructure")];
/// What is Rust's or DataFusion's, and no word of SQL.
const DEBUG_TEXTS: [&str; 18] = [
    "Field {",
    "<subquery>",
    "Exists(",
    "Exists {",
    "Subquery(",
    "Int64(",
    "Int32(",
    "Utf8(",
    "Float64(",
    "Boolean(",
    "metadata:",
    "LogicalPlan",
    "Internal error",
    "not implemented",
    "panicked",
    "Physical input schema",
    "__common_expr",
    "__correlated",
];

/// How two engines answered a statement.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ComparisonOutcome {
    /// By the same values; if types differ, as a whole number and a float do, they are named.
    Same(Option<String>),
    /// By other values.
    Different(String),
    /// echolake refuses what DuckDB answers.
    RefusedHere(String),
    /// DuckDB refuses what echolake answers.
    RefusedThere(String),
    /// Both refuse it: the message of echolake.
    RefusedByBoth(String),
    /// The answer has too many rows, or takes too long.
    Skipped,
}

impl ComparisonOutcome {
    /// Returns a name for outcomes of its sort.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Same(None) => "same",
            Self::Same(Some(_)) => "same values, other type",
            Self::Different(_) => "different",
            Self::RefusedHere(message) if find_debug_text(message).is_some() => "refused here in Rust's words",
            Self::RefusedHere(_) => "refused here",
            Self::RefusedThere(message) if is_value_error(message) => "answered where DuckDB refuses the values",
            Self::RefusedThere(_) => "refused by DuckDB",
            Self::RefusedByBoth(message) if find_debug_text(message).is_some() => {
                "refused by both, here in Rust's words"
            }
            Self::RefusedByBoth(_) => "refused by both",
            Self::Skipped => "skipped",
        }
    }

    /// Returns whether it is a defect, unless it is documented.
    pub fn is_wrong(&self) -> bool {
        match self {
            Self::Different(_) => true,
            Self::RefusedHere(message) | Self::RefusedByBoth(message) => find_debug_text(message).is_some(),
            Self::RefusedThere(message) => is_value_error(message),
            Self::Same(_) | Self::Skipped => false,
        }
    }

    /// Returns what was found.
    pub fn detail(&self) -> &str {
        match self {
            Self::Different(text)
            | Self::RefusedHere(text)
            | Self::RefusedThere(text)
            | Self::RefusedByBoth(text)
            | Self::Same(Some(text)) => text,
            Self::Same(None) | Self::Skipped => "",
        }
    }

    // What statements with the same cause share: the outcome's name and, of a refusal, the message without what is the
    // statement's own.
    fn shape(&self) -> String {
        match self {
            Self::Different(_) => self.name().to_owned(),
            _ => format!("{}: {}", self.name(), message_shape(self.detail())),
        }
    }
}

/// A sort of difference: the smallest statement that shows it, and how many had it.
#[derive(Debug, Clone)]
pub(crate) struct DifferenceFinding {
    /// Kind of the statement that it was found by.
    pub kind: &'static str,
    /// Its number.
    pub number: u64,
    /// The smallest statement.
    pub sql: String,
    /// How the engines answered that.
    pub outcome: ComparisonOutcome,
    /// Statements with the same shape.
    pub count: usize,
}

/// What a campaign found.
#[derive(Debug, Default)]
pub(crate) struct DifferenceCounts {
    /// Statements by their kind and the outcome's name.
    pub outcomes: BTreeMap<(&'static str, &'static str), usize>,
    /// Statements by documented difference.
    pub documented: BTreeMap<&'static str, usize>,
    /// By the shape of the smallest statement.
    pub findings: BTreeMap<String, DifferenceFinding>,
    /// Findings that were shrunk, by the shape before.
    shrunk: BTreeMap<String, usize>,
}

impl DifferenceCounts {
    /// Returns the findings that are defects.
    pub fn wrong(&self) -> impl Iterator<Item = &DifferenceFinding> {
        self.findings.values().filter(|finding| finding.outcome.is_wrong())
    }
}

/// A lake and both engines.
pub(crate) struct DifferenceCampaign {
    runtime: Runtime,
    session: Session,
    peer: Option<DuckdbPeer>,
    python: Option<PathBuf>,
    tables: PeerTables,
    _folder: tempfile::TempDir,
}

impl DifferenceCampaign {
    /// Measures three surfaces of the small rig and ingests them. Without a Python there is no peer.
    ///
    /// # Errors
    /// The lake cannot be made, or the peer does not start.
    pub fn new(python: Option<PathBuf>) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        let runtime = Runtime::new()?;
        let lake = runtime.block_on(make_lake(&folder.path().join("lake")))?;
        let quota = QueryQuota { time: Some(TIME_LIMIT), rows: Some(MOST_ROWS), ..QueryQuota::default() };
        let engine = QueryEngine::new(&lake, Some(MEMORY))?;
        let session = engine.open_session(&Arc::new(EngineClient::new("differences", quota)));
        let mut files = runtime.block_on(visible_files(&lake))?;
        if python.is_some() {
            for (view, _) in VIEWS {
                let path = folder.path().join(format!("{view}.parquet"));
                runtime.block_on(export_view(&session, view, &path))?;
                files.push((view.to_owned(), vec![path.display().to_string()]));
            }
        }
        let tables = PeerTables { files, threads: 1, is_copied: true, settings: PEER_SETTINGS.to_vec() };
        let peer = python.as_ref().map(|python| DuckdbPeer::start(python, &tables)).transpose()?;
        Ok(Self { runtime, session, peer, python, tables, _folder: folder })
    }

    /// Starts a DuckDB as it is by default.
    ///
    /// # Errors
    /// It does not start.
    #[cfg(all(test, feature = "lake"))]
    pub fn start_plain_peer(&self) -> Result<Option<DuckdbPeer>> {
        let tables = PeerTables { settings: vec![("TimeZone", "UTC")], ..self.tables.clone() };
        self.python.as_ref().map(|python| DuckdbPeer::start(python, &tables)).transpose()
    }

    /// Returns the answer of echolake, or its message.
    ///
    /// # Errors
    /// Values cannot be read.
    #[cfg(all(test, feature = "lake"))]
    pub fn own_answer(&self, sql: &str) -> Result<Result<AnswerRows, String>> {
        match self.collect_rows(sql) {
            Ok(batches) => Ok(Ok(AnswerRows::read(&batches)?)),
            Err(error) => Ok(Err(error.to_string())),
        }
    }

    /// Returns the answer of DuckDB, or its message; None without a peer.
    ///
    /// # Errors
    /// The peer has ended, or values cannot be read.
    pub fn peer_answer(&mut self, sql: &str) -> Result<Option<Result<AnswerRows, String>>> {
        let Some(peer) = &mut self.peer else { return Ok(None) };
        Ok(Some(match peer.ask_rows(&peer_text(sql))? {
            Ok(batches) => Ok(AnswerRows::read(&batches)?),
            Err(message) => Err(message),
        }))
    }

    /// Answers a statement by both engines.
    ///
    /// # Errors
    /// There is no peer, or it has ended, or values cannot be read.
    pub fn compare_answers(&mut self, sql: &str, order: RowOrder) -> Result<ComparisonOutcome> {
        let own = match self.collect_rows(sql) {
            Err(Error::RowLimit { .. } | Error::TimeLimit { .. } | Error::MemoryLimit { .. }) => {
                return Ok(ComparisonOutcome::Skipped);
            }
            answer => answer.map_err(|error| error.to_string()),
        };
        let own = match own {
            Ok(batches) => Ok(AnswerRows::read(&batches).with_context(|| sql.to_owned())?),
            Err(message) => Err(message),
        };
        let peer = self.peer_answer(sql).with_context(|| sql.to_owned())?.context("there is no DuckDB")?;
        Ok(match (own, peer) {
            (Ok(own), Ok(peer)) => {
                let types = own.find_type_difference(&peer);
                own.find_difference(peer, order).map_or(ComparisonOutcome::Same(types), ComparisonOutcome::Different)
            }
            (Err(message), Ok(_)) => ComparisonOutcome::RefusedHere(message),
            (Ok(_), Err(message)) => ComparisonOutcome::RefusedThere(message),
            (Err(message), Err(_)) => ComparisonOutcome::RefusedByBoth(message),
        })
    }

    /// Creates the generator of statements about the lake.
    ///
    /// # Errors
    /// A query fails.
    pub fn create_generator(&self, seed: u64) -> Result<StatementGenerator> {
        self.runtime.block_on(StatementGenerator::new(&self.session, seed))
    }

    /// Compares the answers to a statement, and counts the outcome; what is wrong is shrunk, if less than `shrunk`
    /// statements like it were.
    ///
    /// # Errors
    /// As [`Self::compare_answers`].
    pub fn count_statement(
        &mut self,
        number: u64,
        statement: &DifferenceStatement,
        shrunk: usize,
        counts: &mut DifferenceCounts,
    ) -> Result<ComparisonOutcome> {
        let DifferenceStatement { kind, sql, order } = statement;
        let kind = *kind;
        let outcome = match self.compare_answers(sql, *order) {
            Ok(outcome) => outcome,
            // A DuckDB that ended by a statement is started again; that is its defect.
            Err(_) if self.restart_peer()? => ComparisonOutcome::Skipped,
            Err(error) => return Err(error),
        };
        if let Some(documented) = find_documented(sql, &outcome) {
            *counts.documented.entry(documented).or_default() += 1;
            *counts.outcomes.entry((kind, "documented")).or_default() += 1;
            return Ok(ComparisonOutcome::Same(None));
        }
        *counts.outcomes.entry((kind, outcome.name())).or_default() += 1;
        let is_reported = outcome.is_wrong()
            || matches!(outcome, ComparisonOutcome::RefusedHere(_) | ComparisonOutcome::Same(Some(_)));
        if !is_reported {
            return Ok(outcome);
        }
        let before = format!("{kind}: {}", outcome.shape());
        let tried = counts.shrunk.entry(before.clone()).or_default();
        *tried += 1;
        let is_counted_only = shrunk > 0 && *tried > shrunk;
        let (sql, outcome) = match shrunk > 0 && !is_counted_only {
            true => self.shrink_difference(statement, &outcome)?,
            false => (sql.clone(), outcome),
        };
        let shape = match outcome.is_wrong() && !is_counted_only {
            true => format!("{}: {}", outcome.name(), statement_shape(&sql)),
            false => before,
        };
        let finding = DifferenceFinding { kind, number, sql, outcome: outcome.clone(), count: 0 };
        let known = counts.findings.entry(shape).or_insert_with(|| finding.clone());
        known.count += 1;
        if !is_counted_only && finding.sql.len() < known.sql.len() {
            *known = DifferenceFinding { count: known.count, ..finding };
        }
        Ok(outcome)
    }

    fn restart_peer(&mut self) -> Result<bool> {
        let Some(python) = self.python.clone() else { return Ok(false) };
        self.peer = Some(DuckdbPeer::start(&python, &self.tables)?);
        Ok(true)
    }

    fn shrink_difference(
        &mut self,
        statement: &DifferenceStatement,
        outcome: &ComparisonOutcome,
    ) -> Result<(String, ComparisonOutcome)> {
        let shape = outcome.shape();
        let has = |sql: &str, words: &str| sql.to_lowercase().contains(words);
        let whole = &statement.sql;
        let begun = Instant::now();
        let is_wrong = &mut |sql: &str| {
            // Without its order it answers by chance, or in another order.
            let needs_order = statement.order == RowOrder::Total || has(sql, "distinct on") || has(sql, "limit");
            let is_loose = needs_order && has(whole, "order by") && !has(sql, "order by");
            if is_loose || begun.elapsed() > SHRINK_LIMIT || self.session.parse_sql(sql).is_err() {
                return false;
            }
            match self.compare_answers(sql, statement.order) {
                Ok(smaller) => smaller.shape() == shape && find_documented(sql, &smaller).is_none(),
                Err(_) => self.restart_peer().is_err(),
            }
        };
        let sql = shrink_statement(whole, is_wrong);
        let outcome = self.compare_answers(&sql, statement.order)?;
        Ok((sql, outcome))
    }

    fn collect_rows(&self, sql: &str) -> Result<Vec<RecordBatch>, Error> {
        self.runtime.block_on(collect_answer(&self.session, sql))
    }
}

/// Returns all batches of an answer.
///
/// # Errors
/// The query fails.
pub(crate) async fn collect_batches(session: &Session, sql: &str) -> Result<Vec<RecordBatch>> {
    Ok(collect_answer(session, sql).await?)
}

async fn collect_answer(session: &Session, sql: &str) -> Result<Vec<RecordBatch>, Error> {
    let mut answer = session.query(sql).await?;
    let mut batches = Vec::new();
    while let Some(batch) = answer.next().await? {
        batches.push(batch);
    }
    Ok(batches)
}

/// Returns the files of each table that readers see, so that both engines read the same rows.
///
/// # Errors
/// The lake is in no folder, or is being cleaned up.
pub(crate) async fn visible_files(lake: &Lake) -> Result<Vec<(String, Vec<String>)>> {
    let folder = lake.folder().context("the peer reads lakes in folders")?;
    let snapshot = lake.snapshot().await?;
    let mut tables = Vec::new();
    for table in Table::ALL {
        let files = snapshot.files(table).iter();
        ensure!(files.clone().all(|f| f.hidden.is_empty()), "the lake is being cleaned up; run this again");
        let paths: Vec<_> = files.map(|f| folder.join(f.path.as_ref()).display().to_string()).collect();
        if !paths.is_empty() {
            tables.push((table.name().to_owned(), paths));
        }
    }
    Ok(tables)
}

async fn make_lake(folder: &Path) -> Result<Lake> {
    let references = ReferenceSurfaces::default();
    let lake = Lake::open_or_create(&folder.display().to_string(), &Rig::from_toml(SMALL_RIG)?, &references).await?;
    let inbox = folder.join("inbox");
    std::fs::create_dir_all(&inbox)?;
    for (number, (surface, relief)) in SURFACES.into_iter().enumerate() {
        simulate_run(&inbox, number, surface, relief, RecordingMode::ResponsesOnly);
    }
    let ingest = LakeIngest::new(&lake, Arc::default());
    ingest.ingest_runs(pending_runs(&lake).await?, &mut |_| {}).await?;
    ingest.complete_runs(&mut |_, _| {}).await?;
    Ok(lake)
}

// A copy of a view, which DuckDB does not have.
async fn export_view(session: &Session, view: &str, path: &Path) -> Result<()> {
    let batches = collect_batches(session, &format!("select * from {view}")).await?;
    let first = batches.first().with_context(|| format!("view `{view}` has no rows"))?;
    let mut writer = ArrowWriter::try_new(File::create(path)?, first.schema(), None)?;
    for batch in &batches {
        writer.write(batch)?;
    }
    writer.close()?;
    Ok(())
}

/// Returns what of a message is Rust's and no word of SQL.
pub(crate) fn find_debug_text(message: &str) -> Option<&'static str> {
    DEBUG_TEXTS.into_iter().find(|text| message.contains(text))
}

// DuckDB refuses values, not the statement.
fn is_value_error(message: &str) -> bool {
    ["Conversion Error", "Out of Range Error", "Invalid Input Error"].iter().any(|kind| message.starts_with(kind))
}

// The first line, without what is quoted, and without numbers.
fn message_shape(message: &str) -> String {
    let line = message.lines().next().unwrap_or_default();
    let mut shape = String::new();
    let mut quote = None;
    for c in line.chars() {
        match quote {
            Some(open) if c == open => quote = None,
            Some(_) => {}
            None if matches!(c, '`' | '"' | '\'') => {
                quote = Some(c);
                shape.push('x');
            }
            None if c.is_ascii_digit() => {
                if !shape.ends_with('0') {
                    shape.push('0');
                }
            }
            None => shape.push(c),
        }
    }
    shape
}

// A statement without its names of columns and sources, and without its values.
fn statement_shape(sql: &str) -> String {
    let mut shape = String::new();
    let mut rest = sql;
    while let Some(first) = rest.chars().next() {
        let is_word = |c: char| c.is_alphanumeric() || c == '_' || c == '.';
        let end = match first {
            '\'' => rest[1..].find('\'').map_or(rest.len(), |end| end + 2),
            c if is_word(c) => rest.find(|c| !is_word(c)).unwrap_or(rest.len()),
            c => c.len_utf8(),
        };
        let word = &rest[..end];
        let is_name = word.contains('.') || word.len() <= 2 && !matches!(word, "in" | "is" | "on" | "or" | "by" | "as");
        let is_value = first == '\'' || first.is_ascii_digit();
        let is_column = word.contains('_') && !rest[end..].starts_with('(');
        shape.push_str(if is_value || (is_word(first) && (is_name || is_column)) { "x" } else { word });
        rest = &rest[end..];
    }
    shape
}
