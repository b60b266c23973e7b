//! Why a query has no answer, said so that its author finds the place.

use datafusion::error::DataFusionError;

/// What went wrong with a query.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The query is not right.
    #[error("{message}{}", place.as_deref().unwrap_or_default())]
    Query {
        /// What is wrong.
        message: String,
        /// The line, with a mark under the place.
        place: Option<String>,
    },
    /// The query would change something.
    #[error("only reading is allowed here: {message}; hint: select, explain, describe and show tables are")]
    NotReading {
        /// What it would do.
        message: String,
    },
    /// The query was right, and failed on its way.
    #[error("the query failed: {message}")]
    Execution {
        /// Why.
        message: String,
    },
    /// The answer cannot be written.
    #[error("the answer cannot be written as {format}: {message}")]
    Format {
        /// The format.
        format: &'static str,
        /// Why not.
        message: String,
    },
    /// The answer's destination refused.
    #[error("cannot write the answer")]
    Write(#[from] std::io::Error),
    /// The lake cannot be read.
    #[error(transparent)]
    Lake(#[from] echolake_lake::Error),
}

impl Error {
    /// An error of planning `sql`.
    pub(crate) fn plan(sql: &str, error: &DataFusionError) -> Self {
        let message = message(error);
        let span = error.diagnostic().and_then(|d| d.span).map(|s| (s.start.line, s.start.column));
        let place = span.or_else(|| line_and_column(&message)).and_then(|(line, column)| mark(sql, line, column));
        Self::Query { message, place }
    }

    /// An error of running a query.
    pub(crate) fn execution(error: &DataFusionError) -> Self {
        Self::Execution { message: message(error) }
    }
}

// DataFusion's own words without the name of the layer that said them.
pub(crate) fn message(error: &DataFusionError) -> String {
    let text = error.find_root().strip_backtrace();
    let text = ["SQL error: ", "Error during planning: ", "Schema error: ", "External error: "]
        .into_iter()
        .fold(text.as_str(), |text, prefix| text.strip_prefix(prefix).unwrap_or(text))
        .to_owned();
    match text.strip_prefix("ParserError(\"").and_then(|t| t.strip_suffix("\")")) {
        Some(inner) => inner.replace("\\\"", "\""),
        None => text,
    }
}

// The parser puts the place into its text: `... at Line: 1, Column: 8`.
fn line_and_column(message: &str) -> Option<(u64, u64)> {
    let (_, place) = message.rsplit_once("Line: ")?;
    let (line, column) = place.split_once(", Column: ")?;
    let digits = |text: &str| text.chars().take_while(char::is_ascii_digit).collect::<String>().parse().ok();
    Some((digits(line)?, digits(column)?))
}

fn mark(sql: &str, line: u64, column: u64) -> Option<String> {
    let text = sql.lines().nth(usize::try_from(line.checked_sub(1)?).ok()?)?;
    let column = usize::try_from(column.checked_sub(1)?).ok()?.min(text.chars().count());
    Some(format!("\n  {text}\n  {}^", " ".repeat(column)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_marked() {
        assert_eq!(line_and_column("Expected: x at Line: 2, Column: 5"), Some((2, 5)));
        assert_eq!(mark("select\nfrom x", 2, 6).as_deref(), Some("\n  from x\n       ^"));
        assert_eq!(mark("select", 9, 1), None);
    }
}
