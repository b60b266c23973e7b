//! Commands of the prompt: lines that are not SQL.

use std::path::PathBuf;

use echolake_query::output::AnswerFormat;

/// The text that `\?` prints.
pub(super) const HELP: &str = "\
a query ends with ;
\\d          the tables               \\d TABLE      its columns, with units
\\df         the functions            \\df PART      those with PART in their name; of one, what it does
\\f FORMAT   table, csv, json; parquet and arrow into a file
\\o FILE     the next answer goes into a file
\\timing     how long it took         \\pager        long answers page by page, or all at once
\\q          leave
Tab completes; Ctrl-R searches the history; Ctrl-C stops a query or clears the line; Ctrl-D leaves";

/// An order to the prompt.
#[derive(Debug, PartialEq, Eq)]
pub(in super::super) enum PromptCommand {
    /// Leave.
    Quit,
    /// Print the help.
    Help,
    /// Print times, or do not.
    Timing,
    /// Page, or do not.
    Pager,
    /// The format of answers.
    Format(AnswerFormat),
    /// The file for the next answer.
    Output(Option<PathBuf>),
    /// List the tables.
    Tables,
    /// Describe a table.
    Columns(String),
    /// List functions.
    Functions(Option<String>),
}

impl PromptCommand {
    /// Returns whether it prints a text to standard output.
    pub fn prints_text(&self) -> bool {
        matches!(self, Self::Tables | Self::Columns(_) | Self::Functions(_))
    }
}

/// Parses the command of a line; None if it is SQL.
pub(in super::super) fn parse_command(line: &str) -> Option<Result<PromptCommand, String>> {
    let line = line.trim();
    let (word, rest) = line.split_once(char::is_whitespace).unwrap_or((line, ""));
    let rest = rest.trim().trim_end_matches(';').trim_end();
    let name = (!rest.is_empty()).then(|| rest.to_owned());
    Some(Ok(match word.trim_end_matches(';') {
        "\\q" | "exit" | "quit" if name.is_none() => PromptCommand::Quit,
        "\\?" | "\\h" | "help" if name.is_none() => PromptCommand::Help,
        "\\timing" => PromptCommand::Timing,
        "\\pager" | "\\pset" => PromptCommand::Pager,
        "\\f" | "\\format" => match AnswerFormat::ALL.into_iter().find(|f| f.name().eq_ignore_ascii_case(rest)) {
            Some(format) => PromptCommand::Format(format),
            None => return Some(Err(format!("no format `{rest}`; hint: table, csv, json, parquet or arrow"))),
        },
        "\\o" => PromptCommand::Output(name.map(PathBuf::from)),
        "\\d" | "\\dt" | "\\d+" => name.map_or(PromptCommand::Tables, PromptCommand::Columns),
        "\\df" => PromptCommand::Functions(name),
        other if other.starts_with('\\') => return Some(Err(format!("no command `{other}`; hint: \\? lists them"))),
        _ => return None,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_orders_or_sql() {
        assert_eq!(parse_command("\\d  runs;"), Some(Ok(PromptCommand::Columns("runs".to_owned()))));
        assert_eq!(parse_command("\\d"), Some(Ok(PromptCommand::Tables)));
        assert_eq!(parse_command("  quit "), Some(Ok(PromptCommand::Quit)));
        assert_eq!(parse_command("\\f CSV"), Some(Ok(PromptCommand::Format(AnswerFormat::Csv))));
        assert_eq!(parse_command("\\o a b.csv"), Some(Ok(PromptCommand::Output(Some("a b.csv".into())))));
        assert_eq!(parse_command("select 1;"), None);
        assert_eq!(parse_command(""), None);
        assert!(matches!(parse_command("\\f xls"), Some(Err(m)) if m.contains("xls")));
        assert!(matches!(parse_command("\\z"), Some(Err(m)) if m.contains("\\z")));
    }
}
