//! Errors of queries, with the place in the text and hints.

use std::cmp::Reverse;
use std::collections::BTreeSet;
use std::fmt::{self, Display, Formatter};
use std::time::Duration;

use arrow::error::ArrowError;
use datafusion::common::utils::datafusion_strsim::normalized_levenshtein;
use datafusion::common::{Column, SchemaError};
use datafusion::error::DataFusionError;
use datafusion::sql::sqlparser::parser::ParserError;
use datafusion::sql::sqlparser::tokenizer::Location;
use echolake_lake::Error as LakeError;
use echolake_schema::tables::Table;
use echolake_schema::{ErrorCause, escape_controls};

use crate::control::StopReason;
use crate::spread::WorkerLoss;
use crate::statement::{UNPLANNED, find_cast, hints};

/// Minimum similarity of a suggested name: half of the letters, as in DataFusion's own suggestions.
const ALIKE: f64 = 0.5;
/// Maximum number of names in a suggestion.
const SUGGESTED: usize = 3;
/// Maximum number of columns in a hint if no name is similar.
const LISTED: usize = 12;

/// The message for the query that is ended to get memory back.
const EXHAUSTED: &str = "the server's memory is exhausted, and this query holds the most of it";

/// Begins the message of a calculation whose result its type cannot hold.
pub const OUT_OF_RANGE: &str = "overflow, out of range: ";
/// Table functions of other databases that read files.
const FILE_FUNCTIONS: [&str; 9] = [
    "read_csv",
    "read_csv_auto",
    "read_json",
    "read_json_auto",
    "read_parquet",
    "parquet_scan",
    "read_text",
    "read_blob",
    "glob",
];
/// Endings of names that are no tables but files.
const FILE_ENDINGS: [&str; 8] = [".csv", ".tsv", ".txt", ".json", ".parquet", ".arrow", ".feather", ".xlsx"];
/// Parts of messages that name what DataFusion makes of a subquery.
const SUBQUERY_STATE: [&str; 5] =
    ["__common_expr", "__correlated", "__scalar_sq", "outer_ref(", "Correlated scalar subquery can only"];
/// Parts of messages about other state of DataFusion.
const ENGINE_STATE: [&str; 6] = [
    "Internal error",
    "panicked",
    "Physical input schema",
    "Optimizer rule",
    "likely caused by a bug",
    "GroupsAccumulator",
];
/// Begins what DataFusion prints of a call that it has no function for, behind an error of its own.
const NO_MATCH: &str = "No function matches";
/// The message for a statement that makes DataFusion fail.
const UNSUPPORTED: &str = "this statement is not supported in this form; hint: take it apart, with WITH or subqueries in \
    FROM; EXPLAIN of each part shows which one is not supported";
const NO_FILES: &str = ": a query reads the lake and no other files";
const OWN_ROWS: &str = "WITH mine(a, b) AS (VALUES (1, 2), (3, 4)) for a few rows; for a file, DuckDB or polars, which \
    read the lake's tables, too";

/// A place in a query's text. Lines, columns and positions count from 1.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct QueryPlace {
    /// Line.
    pub line: u64,
    /// Column, in characters.
    pub column: u64,
    /// Position in the whole text, in characters.
    pub position: u64,
    /// The line, and below it a mark under the place.
    pub mark: String,
}

impl Display for QueryPlace {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, " (line {}, column {})\n{}", self.line, self.column, self.mark)
    }
}

/// An error of a query.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The query is invalid.
    #[error("{message}{}{}", place.as_ref().map_or_else(String::new, ToString::to_string), hint_line(hint.as_deref()))]
    Query {
        /// Description of the error.
        message: String,
        /// The place in the query.
        place: Option<QueryPlace>,
        /// A suggestion.
        hint: Option<String>,
    },
    /// The query would change something.
    #[error("only reading is allowed here, not {statement}; hint: SELECT, EXPLAIN, DESCRIBE and SHOW are")]
    NotReading {
        /// The refused statement's name.
        statement: String,
    },
    /// The query is valid, and failed while it ran.
    #[error("the query failed: {message}{}", place_and_hint(place.as_ref(), hint.as_deref()))]
    Execution {
        /// The cause.
        message: String,
        /// The place in the query, if it is known.
        place: Option<QueryPlace>,
        /// A suggestion.
        hint: Option<String>,
    },
    /// The client cancelled it.
    #[error("the query was cancelled")]
    Cancelled,
    /// It took longer than its client may.
    #[error("the query took longer than {} s; hint: ask for less, or for fewer surfaces at a \
        time", limit.as_secs_f64())]
    TimeLimit {
        /// The client's time for a query.
        limit: Duration,
    },
    /// A worker that ran a part of it was lost after rows had been sent.
    #[error("a worker was lost while the query ran: {message}; hint: ask again, the others go on")]
    WorkerLost {
        /// The cause.
        message: String,
    },
    /// It needed more memory than there is for it.
    #[error("the query needs more memory than it may have: {message}; hint: ask for less, or for fewer columns")]
    MemoryLimit {
        /// The exhausted limit.
        message: String,
    },
    /// Its answer has more rows than its client's limit.
    #[error("the answer has more than {limit} rows; hint: LIMIT, or a WHERE that asks for less")]
    RowLimit {
        /// Rows that the client may have.
        limit: u64,
    },
    /// The client runs as many queries as it may.
    #[error("`{client}` already runs {limit} queries, as many as it may; hint: wait for one, or cancel it")]
    Busy {
        /// The client's name.
        client: String,
        /// The client's limit.
        limit: usize,
    },
    /// The answer cannot be written.
    #[error("the answer cannot be written as {format}: {source}")]
    Format {
        /// The format.
        format: &'static str,
        /// The encoder's error.
        source: ErrorCause,
    },
    /// The answer's destination refused.
    #[error("cannot write the answer")]
    Write(#[from] std::io::Error),
    /// The lake cannot be read.
    #[error(transparent)]
    Lake(#[from] echolake_lake::Error),
}

impl Error {
    /// Converts an error of parsing or planning `sql`.
    pub(crate) fn from_planning(sql: &str, error: &DataFusionError) -> Self {
        if let Some(limit) = Self::from_root_cause(error) {
            return limit;
        }
        let (message, mut hint) = explain_error(error);
        if let DataFusionError::SchemaError(schema, _) = error.find_root()
            && let SchemaError::FieldNotFound { field, .. } = schema.as_ref()
        {
            let similar = hint.take_if(|hint| hint.starts_with("did you mean"));
            let own = hints::of_alias(sql, &field.name).or(similar).or_else(|| hints::of_quoted_name(sql, &field.name));
            hint = own.or(hint);
        }
        let span = error.diagnostic().and_then(|d| d.span).map(|s| (s.start.line, s.start.column));
        let (message, parsed) = without_place(sql, &message);
        let place = span.or(parsed).and_then(|(line, column)| query_place(sql, line, column));
        let place = place.or_else(|| cast_place(sql, &message));
        let (message, hint) = match message.split_once("; hint: ") {
            Some((message, own)) => (message.to_owned(), own.to_owned()),
            None => {
                let is_syntax = matches!(error.find_root(), DataFusionError::SQL(..));
                let hint =
                    hint.unwrap_or_else(|| if is_syntax { hints::of_syntax(sql) } else { hints::of_plan(&message) });
                (hints::shorten_message(&message), hint)
            }
        };
        Self::Query { message: escape_controls(&message), place, hint: Some(escape_controls(&hint)) }
    }

    /// Converts an error of optimizing the plan of `sql`, whose names are resolved: a missing column is DataFusion's own.
    pub(crate) fn from_optimizing(sql: &str, error: &DataFusionError) -> Self {
        match error.find_root() {
            DataFusionError::SchemaError(..) => {
                Self::from_planning(sql, &DataFusionError::NotImplemented(UNPLANNED.to_owned()))
            }
            _ => Self::from_planning(sql, error),
        }
    }

    /// Converts an error of the tokenizer.
    pub(crate) fn from_tokenizer(sql: &str, error: ParserError) -> Self {
        Self::from_planning(sql, &DataFusionError::from(error))
    }

    /// Sets the place of an error that has none, if the query has one.
    pub(crate) fn with_place(mut self, sql: &str, start: Location) -> Self {
        if let Self::Query { place: place @ None, .. } = &mut self {
            *place = query_place(sql, start.line, start.column);
        }
        self
    }

    /// Returns the error for a clause that is not planned; the query is marked at the clause's first word in capitals.
    pub(crate) fn unsupported_clause(sql: &str, clause: &str, hint: String) -> Self {
        let word = clause.split(' ').find(|word| !word.is_empty() && word.chars().all(|c| c.is_ascii_uppercase()));
        let place = word.and_then(|word| {
            let at = sql.to_ascii_uppercase().find(word)?;
            let line_start = sql[..at].rfind('\n').map_or(0, |newline| newline + 1);
            let line = sql[..at].matches('\n').count() + 1;
            query_place(sql, line as u64, sql[line_start..at].chars().count() as u64 + 1)
        });
        Self::Query { message: format!("not supported: {clause}"), place, hint: Some(hint) }
    }

    /// Converts an error of running `sql`, which is empty if the error is not of a statement.
    pub(crate) fn from_execution(sql: &str, error: &DataFusionError) -> Self {
        Self::from_root_cause(error).unwrap_or_else(|| {
            let message = explain_error(error).0;
            if let Some(damaged) = damaged_file(&message) {
                return damaged.into();
            }
            let place = cast_place(sql, &message);
            Self::failed_at(&store_fault(&message).unwrap_or(message), place)
        })
    }

    /// Returns the error of a query that failed while it ran, with the hint of the message, or one that is known.
    pub(crate) fn failed_query(message: &str) -> Self {
        Self::failed_at(message, None)
    }

    fn failed_at(message: &str, place: Option<QueryPlace>) -> Self {
        let (cause, hint) = match message.split_once("; hint: ") {
            Some((cause, hint)) => (cause, Some(hint)),
            None => (message, hints::of_run(message)),
        };
        Self::Execution { message: escape_controls(cause), place, hint: hint.map(escape_controls) }
    }

    // An error about a limit, a worker or the lake, not about the query.
    fn from_root_cause(error: &DataFusionError) -> Option<Self> {
        match error.find_root() {
            DataFusionError::ResourcesExhausted(text) => Some(Self::MemoryLimit { message: text.clone() }),
            DataFusionError::External(cause) => match cause.downcast_ref::<WorkerLoss>() {
                Some(loss) => Some(Self::WorkerLost { message: loss.message().to_owned() }),
                None => cause.downcast_ref::<LakeError>().and_then(repeat_table_fault).map(Self::from),
            },
            _ => None,
        }
    }

    /// Returns the error for a query that was stopped.
    pub(crate) fn from_stop(why: &StopReason) -> Self {
        match why {
            StopReason::Cancelled => Self::Cancelled,
            StopReason::Time(limit) => Self::TimeLimit { limit: *limit },
            StopReason::Memory => Self::MemoryLimit { message: EXHAUSTED.to_owned() },
        }
    }
}

/// Repeats a table's fault; None if the error is another one.
pub(crate) fn repeat_table_fault(error: &LakeError) -> Option<LakeError> {
    Some(match error {
        LakeError::Incomplete { table, found } => LakeError::Incomplete { table, found: found.clone() },
        LakeError::Log { table, action, source } => LakeError::Log { table, action, source: source.to_string().into() },
        LakeError::DataFile { file, source } => {
            LakeError::DataFile { file: file.clone(), source: source.to_string().into() }
        }
        _ => return None,
    })
}

// Without a place the error is one line.
fn place_and_hint(place: Option<&QueryPlace>, hint: Option<&str>) -> String {
    match place {
        Some(place) => format!("{place}{}", hint_line(hint)),
        None => hint.map_or_else(String::new, |hint| format!("; hint: {hint}")),
    }
}

fn hint_line(hint: Option<&str>) -> String {
    hint.map_or_else(String::new, |hint| format!("\nhint: {hint}"))
}

// Returns the message without the name of the layer that raised it, and a hint. What names DataFusion's own state is
// no help to a client, and a defect of it or of this crate.
fn explain_error(error: &DataFusionError) -> (String, Option<String>) {
    let (message, hint) = describe_error(error);
    let message = message.replace("[return_type] ", "");
    if SUBQUERY_STATE.iter().any(|part| message.contains(part)) {
        return (UNPLANNED.to_owned(), None);
    }
    match (ENGINE_STATE.iter().any(|part| message.contains(part)), message.find(NO_MATCH)) {
        (false, _) => (message, hint),
        (true, Some(at)) => (message[at..].to_owned(), hint),
        (true, None) => (UNSUPPORTED.to_owned(), None),
    }
}

fn describe_error(error: &DataFusionError) -> (String, Option<String>) {
    match error.find_root() {
        DataFusionError::SchemaError(schema, _) => match schema.as_ref() {
            SchemaError::FieldNotFound { field, valid_fields } => {
                (format!("no column `{}`", field.flat_name()), column_hint(field, valid_fields))
            }
            other => (other.to_string(), None),
        },
        DataFusionError::SQL(parser, _) => match parser.as_ref() {
            ParserError::TokenizerError(text) | ParserError::ParserError(text) => (text.clone(), None),
            ParserError::RecursionLimitExceeded => ("the query is nested too deeply".to_owned(), None),
        },
        DataFusionError::ArrowError(arrow, _) => (arrow_message(arrow), None),
        DataFusionError::Plan(text) => match text.strip_suffix("' not found").and_then(|text| text.split_once(" '")) {
            Some(("table", name)) => missing_table(name),
            Some(("table function", name)) if FILE_FUNCTIONS.contains(&name) => {
                (format!("no table function `{name}`{NO_FILES}"), Some(OWN_ROWS.to_owned()))
            }
            _ if text.starts_with("Too many columns!") => (
                "a subquery has several columns, expected one for a single value".to_owned(),
                Some("(a, b) IN (SELECT ...) compares several values".to_owned()),
            ),
            _ => (text.clone(), None),
        },
        // The message prints the expression as the library's own structure.
        DataFusionError::NotImplemented(text) if text == UNPLANNED || is_unplanned_subquery(text) => {
            (UNPLANNED.to_owned(), None)
        }
        DataFusionError::Execution(text) => (text.clone(), None),
        other => (other.strip_backtrace(), None),
    }
}

fn is_unplanned_subquery(message: &str) -> bool {
    message.starts_with("Physical plan does not support")
        && ["ubquery", "Exists", "OuterReference"].iter().any(|kind| message.contains(kind))
}

// Returns the error of a table's file that is gone or damaged. The readers of files keep such faults as texts alone.
fn damaged_file(message: &str) -> Option<LakeError> {
    let (_, after) = message.split_once("Failed to fetch metadata for file ")?;
    let (file, cause) = after.split_once(": ").filter(|(file, _)| file.starts_with("tables/"))?;
    if store_fault(message).is_some() {
        return None;
    }
    // The store's text names the place on the server's disk.
    let cause = if cause.contains(" not found") { "it is not there" } else { cause };
    Some(LakeError::DataFile { file: file.to_owned(), source: cause.to_owned().into() })
}

// Returns what is to be said of a store that did not answer. The readers of files keep such faults as texts alone.
fn store_fault(message: &str) -> Option<String> {
    let (_, request) = message.split_once("Error performing ")?;
    let (request, outcome) = request.split_once(" in ")?;
    let (_, url) = request.split_once("://")?;
    let path = url.split_once('/').map_or(url, |(_, path)| path);
    let (_, cause) = outcome.split_once(" - ")?;
    let cause = cause.split(": <?xml").next().unwrap_or(cause).trim();
    let hint = match ["status code: 401", "status code: 403"].iter().any(|status| cause.contains(status)) {
        true => "look at the credentials of the store in the environment, and at what they allow",
        false => "run the query again when the store answers",
    };
    Some(format!("cannot read `{path}` of the lake's store: {cause}; hint: {hint}"))
}

fn arrow_message(error: &ArrowError) -> String {
    match error {
        ArrowError::DivideByZero => "division by zero".to_owned(),
        ArrowError::ArithmeticOverflow(text) => match text.strip_prefix("Overflow happened on: ") {
            Some(calculation) => format!("{OUT_OF_RANGE}{calculation}"),
            None => text.clone(),
        },
        ArrowError::CastError(text) | ArrowError::ComputeError(text) => text.clone(),
        ArrowError::ExternalError(source) => match source.downcast_ref::<DataFusionError>() {
            Some(inner) => explain_error(inner).0,
            None => source.to_string(),
        },
        other => other.to_string(),
    }
}

/// Returns the error of a query that names an unknown table.
pub(crate) fn unknown_table(name: &str) -> Error {
    let (message, hint) = missing_table(name);
    Error::Query { message, place: None, hint }
}

// DataFusion adds the catalogue and schema, which the query does not contain.
fn missing_table(qualified: &str) -> (String, Option<String>) {
    let name = qualified.strip_prefix("datafusion.public.").unwrap_or(qualified);
    if FILE_ENDINGS.iter().any(|ending| name.to_ascii_lowercase().ends_with(ending)) || name.contains('/') {
        return (format!("no table `{name}`{NO_FILES}"), Some(OWN_ROWS.to_owned()));
    }
    let tables = Table::ALL.map(Table::name);
    let hint = did_you_mean(name, &tables).unwrap_or_else(|| format!("the tables are {}", tables.join(", ")));
    (format!("no table `{name}`"), Some(hint))
}

fn column_hint(field: &Column, valid: &[Column]) -> Option<String> {
    let mut seen = BTreeSet::new();
    let names: Vec<_> = valid.iter().map(|c| c.name.as_str()).filter(|name| seen.insert(*name)).collect();
    if names.is_empty() {
        return Some("FROM names the tables; without it there are no columns".to_owned());
    }
    Some(did_you_mean(&field.name, &names).unwrap_or_else(|| {
        let more = if names.len() > LISTED { ", ...; DESCRIBE lists all of a table" } else { "" };
        format!("the columns are {}{more}", names[..names.len().min(LISTED)].join(", "))
    }))
}

fn did_you_mean(name: &str, names: &[&str]) -> Option<String> {
    let wanted = name.to_lowercase();
    let score = |known: &str| normalized_levenshtein(&wanted, &known.to_lowercase());
    let mut near: Vec<_> = names.iter().map(|known| (score(known), *known)).filter(|n| n.0 >= ALIKE).collect();
    near.sort_by_key(|(score, _)| Reverse((score * 1e6) as u64));
    let near: Vec<_> = near.into_iter().take(SUGGESTED).map(|(_, known)| format!("`{known}`")).collect();
    let (last, before) = near.split_last()?;
    Some(match before {
        [] => format!("did you mean {last}?"),
        _ => format!("did you mean {} or {last}?", before.join(", ")),
    })
}

// The parser appends the place to its message, `... at Line: 1, Column: 8`, except at the end of the query.
fn without_place(sql: &str, message: &str) -> (String, Option<(u64, u64)>) {
    if let Some(expected) = message.strip_suffix(", found: EOF") {
        return (format!("{expected}, found the end of the query"), end_of(sql));
    }
    let Some((text, place)) = message.rsplit_once(" at Line: ") else { return (message.to_owned(), None) };
    let digits = |text: &str| text.chars().take_while(char::is_ascii_digit).collect::<String>().parse().ok();
    let found = place.split_once(", Column: ").and_then(|(line, column)| Some((digits(line)?, digits(column)?)));
    match found {
        Some(place) => (text.to_owned(), Some(place)),
        None => (message.to_owned(), None),
    }
}

fn end_of(sql: &str) -> Option<(u64, u64)> {
    let text = sql.trim_end();
    let last = text.lines().last()?;
    Some((text.lines().count() as u64, last.chars().count() as u64 + 1))
}

fn cast_place(sql: &str, message: &str) -> Option<QueryPlace> {
    let cast = find_cast(sql, message)?;
    query_place(sql, cast.line, cast.column)
}

/// Characters of a line shown before and after a marked place.
const MARKED_CHARS: usize = 60;

fn query_place(sql: &str, line: u64, column: u64) -> Option<QueryPlace> {
    let before = usize::try_from(line.checked_sub(1)?).ok()?;
    let text = sql.lines().nth(before)?;
    let length = text.chars().count();
    let column = usize::try_from(column.checked_sub(1)?).ok()?.min(length);
    let above: usize = sql.split_inclusive('\n').take(before).map(|line| line.chars().count()).sum();
    Some(QueryPlace {
        line,
        column: column as u64 + 1,
        position: (above + column) as u64 + 1,
        mark: marked_line(text, length, column),
    })
}

// Shows only the surroundings of the place in a long line, such as programs generate.
fn marked_line(text: &str, length: usize, column: usize) -> String {
    let begin = column.saturating_sub(MARKED_CHARS);
    let around: String = text.chars().skip(begin).take(2 * MARKED_CHARS).collect();
    let (cut, column) = if begin > 0 { ("...", column - begin + 3) } else { ("", column) };
    let end = if length > begin + 2 * MARKED_CHARS { "..." } else { "" };
    let text = format!("{cut}{around}{end}");
    // Tabs stay tabs, so that the mark is under its place at any tab width.
    let blank: String = text.chars().take(column).map(|c| if c == '\t' { '\t' } else { ' ' }).collect();
    format!("  {text}\n  {blank}^")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_found_and_marked() {
        assert_eq!(without_place("", "Expected: x at Line: 2, Column: 5"), ("Expected: x".to_owned(), Some((2, 5))));
        assert_eq!(without_place("", "meet me at Line: nowhere"), ("meet me at Line: nowhere".to_owned(), None));
        let (message, place) = without_place("select\n  1 +\n", "Expected: an expression, found: EOF");
        assert_eq!((message.as_str(), place), ("Expected: an expression, found the end of the query", Some((2, 6))));
        let place = query_place("sélect\nfrom x", 2, 6).expect("a place");
        assert_eq!((place.line, place.column, place.position), (2, 6, 13));
        assert_eq!(place.to_string(), " (line 2, column 6)\n  from x\n       ^");
        assert_eq!(query_place("\tx", 1, 2).expect("a place").mark, "  \tx\n  \t^");
        assert_eq!(query_place("select", 9, 1), None);
        let long = format!("{}x{}", "a".repeat(100), "b".repeat(100));
        let around = format!("  ...{}x{}...\n  {}^", "a".repeat(60), "b".repeat(59), " ".repeat(63));
        assert_eq!(query_place(&long, 1, 101).expect("a place").mark, around);
    }

    #[test]
    fn a_store_that_does_not_answer_is_named_without_the_layers_above_it() {
        let fault = "Parquet error: Failed to fetch metadata for file x.parquet: Object Store error: Generic remote \
                     error: Generic S3 error: Error performing GET http://host:7480/lake/tables/x.parquet in 250.4ms, \
                     after 1 retries, max_retries: 1, retry_timeout: 180s  - HTTP error: error sending request";
        let expected = "cannot read `lake/tables/x.parquet` of the lake's store: HTTP error: error sending request; \
                        hint: run the query again when the store answers";
        assert_eq!(store_fault(fault).as_deref(), Some(expected));
        assert_eq!(store_fault("division by zero"), None);
        // B3: credentials that a store refuses do not become right when it answers.
        let (request, _) = fault.split_once(", after").expect("tries");
        let refused = format!("{request} - Server returned non-2xx status code: 403 Forbidden: <?xml?><Error/>");
        let refused = store_fault(&refused).expect("a fault of the store");
        assert!(refused.contains("403 Forbidden; hint: look at the credentials of the store"), "{refused}");
        assert!(damaged_file(&fault.replace(" x.parquet", " tables/nce/x.parquet")).is_none());
    }

    #[test]
    fn a_file_that_is_gone_is_damage_with_a_way_out_and_without_the_servers_paths() {
        let fault = "Parquet error: Failed to fetch metadata for file tables/nce/x.parquet: Object Store error: Object \
                     at location /srv/lake/tables/nce/x.parquet not found: No such file or directory (os error 2)";
        let expected = "`tables/nce/x.parquet` is damaged: it is not there; hint: `echolake rebuild nce` makes it \
                        again from the runs";
        assert_eq!(damaged_file(fault).map(|error| error.to_string()).as_deref(), Some(expected));
        assert!(damaged_file("division by zero").is_none());
    }

    #[test]
    fn near_names_are_suggested_nearest_first() {
        let names = ["ended", "ended_ns", "started", "pair_id"];
        assert_eq!(did_you_mean("endd", &names).as_deref(), Some("did you mean `ended` or `ended_ns`?"));
        assert_eq!(did_you_mean("Pair_Id", &names).as_deref(), Some("did you mean `pair_id`?"));
        assert_eq!(did_you_mean("qqq", &names), None);
    }
}
