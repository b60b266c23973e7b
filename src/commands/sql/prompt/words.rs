//! Completion: tables after FROM, columns of the query's own tables first, functions with their bracket.

use std::collections::BTreeMap;

use echolake_query::Session;
use rustyline::completion::{Completer, Pair};
use rustyline::{Context, Helper, Highlighter, Hinter, Validator};

/// Words that are completed besides names.
const KEYWORDS: [&str; 39] = [
    "and",
    "as",
    "asc",
    "asof join",
    "between",
    "by",
    "case",
    "cast",
    "desc",
    "describe",
    "distinct",
    "else",
    "end",
    "except",
    "explain",
    "explain analyze",
    "from",
    "full join",
    "group by",
    "having",
    "in",
    "is not null",
    "is null",
    "join",
    "left join",
    "like",
    "limit",
    "not",
    "offset",
    "on",
    "or",
    "order by",
    "over",
    "select",
    "show tables",
    "then",
    "union all",
    "when",
    "where",
];
/// The prompt's own commands.
const COMMANDS: [&str; 9] = ["\\?", "\\d", "\\df", "\\f", "\\o", "\\pager", "\\q", "\\timing", "\\d+"];
/// Words after which a table is named.
const BEFORE_TABLE: [&str; 5] = ["from", "join", "describe", "\\d", "\\d+"];

/// Completions of a word.
#[derive(Helper, Highlighter, Hinter, Validator)]
pub(super) struct WordCompleter {
    tables: BTreeMap<String, Vec<String>>,
    functions: Vec<String>,
}

impl WordCompleter {
    /// The names that a session knows.
    pub fn from_session(session: &Session) -> Self {
        let columns = |schema: &arrow::datatypes::Schema| schema.fields().iter().map(|f| f.name().clone()).collect();
        Self {
            tables: session.all_tables().into_iter().map(|(name, schema)| (name, columns(&schema))).collect(),
            functions: session.sql_functions().into_iter().map(|f| f.name).collect(),
        }
    }

    fn find_candidates(&self, line: &str, start: usize, begun: &str) -> Vec<String> {
        let fits = |word: &&String| word.starts_with(&begun.to_lowercase());
        let before = line[..start].split_whitespace().next_back().map(str::to_lowercase);
        if before.as_deref().is_some_and(|word| BEFORE_TABLE.contains(&word)) {
            return self.tables.keys().filter(fits).cloned().collect();
        }
        if before.as_deref() == Some("\\df") {
            return self.functions.iter().filter(fits).cloned().collect();
        }
        if begun.is_empty() {
            return Vec::new();
        }
        if begun.starts_with('\\') {
            return COMMANDS.iter().filter(|c| c.starts_with(begun)).map(|c| (*c).to_owned()).collect();
        }
        let mut found: Vec<String> = self.named_columns(line).filter(fits).cloned().collect();
        found.sort();
        found.dedup();
        found.extend(self.tables.keys().filter(fits).cloned());
        found.extend(self.functions.iter().filter(fits).map(|f| format!("{f}(")));
        found.extend(KEYWORDS.iter().filter(|k| k.starts_with(&begun.to_lowercase())).map(|k| (*k).to_owned()));
        found
    }

    // Columns of the tables that the line names; of all, if it names none yet.
    fn named_columns<'a>(&'a self, line: &'a str) -> impl Iterator<Item = &'a String> {
        let words: Vec<_> = line.split(|c: char| !is_part(c)).collect();
        let any = self.tables.keys().any(|table: &String| words.iter().any(|w| w.eq_ignore_ascii_case(table)));
        let named = move |table: &String| !any || words.iter().any(|w| w.eq_ignore_ascii_case(table));
        self.tables.iter().filter(move |(table, _)| named(table)).flat_map(|(_, columns)| columns)
    }
}

fn is_part(c: char) -> bool {
    c.is_alphanumeric() || c == '_' || c == '\\' || c == '+' || c == '?'
}

impl Completer for WordCompleter {
    type Candidate = Pair;

    fn complete(&self, line: &str, pos: usize, _: &Context<'_>) -> rustyline::Result<(usize, Vec<Pair>)> {
        let start =
            line[..pos].rfind(|c| !is_part(c)).map_or(0, |i| i + line[i..].chars().next().map_or(1, char::len_utf8));
        let pair = |word: String| Pair { display: word.clone(), replacement: word };
        Ok((start, self.find_candidates(line, start, &line[start..pos]).into_iter().map(pair).collect()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words() -> WordCompleter {
        let table = |name: &str, columns: &[&str]| (name.to_owned(), columns.iter().map(|c| (*c).to_owned()).collect());
        WordCompleter {
            tables: [table("runs", &["run_id", "started"]), table("pairs", &["pair_id", "path_mm"])].into(),
            functions: vec!["round".to_owned(), "p90_mean".to_owned()],
        }
    }

    fn completed(line: &str) -> Vec<String> {
        let start = line.rfind(|c| !is_part(c)).map_or(0, |i| i + 1);
        words().find_candidates(line, start, &line[start..])
    }

    #[test]
    fn places_decide_what_is_meant() {
        assert_eq!(completed("select * from "), ["pairs", "runs"]);
        assert_eq!(completed("\\d p"), ["pairs"]);
        assert_eq!(completed("select * from runs where r"), ["run_id", "runs", "round("]);
        assert_eq!(completed("select p"), ["pair_id", "path_mm", "pairs", "p90_mean("]);
        assert_eq!(completed("select RUN"), ["run_id", "runs"]);
        assert_eq!(completed("\\df p"), ["p90_mean"]);
        assert_eq!(completed("\\ti"), ["\\timing"]);
        assert!(completed("select ").is_empty());
    }
}
