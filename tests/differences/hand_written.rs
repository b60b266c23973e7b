//! Statements whose right answer is written down beside them, in `statements.txt`.

use anyhow::{Context as _, Result};

use super::answer_rows::RowOrder;

/// A statement and its right answer.
#[derive(Debug)]
pub(crate) struct HandWrittenStatement {
    /// What it is about, with the name of the defect that it came from, if it did.
    pub title: &'static str,
    /// The text.
    pub sql: &'static str,
    /// The right answer.
    pub expected: ExpectedAnswer,
    /// Whether the order of the rows counts.
    pub order: RowOrder,
}

/// A right answer.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum ExpectedAnswer {
    /// These rows, a line each.
    Rows(Vec<&'static str>),
    /// A refusal that has this in it.
    Refusal(&'static str),
}

/// Returns all of them.
///
/// # Errors
/// The file is not as it should be.
pub(crate) fn hand_written_statements() -> Result<Vec<HandWrittenStatement>> {
    let parts = include_str!("statements.txt").split("\n\n-- ").skip(1);
    parts.map(|part| read_statement(part).with_context(|| part.to_owned())).collect()
}

fn read_statement(part: &'static str) -> Result<HandWrittenStatement> {
    let (title, rest) = part.split_once('\n').context("no statement")?;
    let (sql, answer) = rest.split_once("\n----").context("no answer")?;
    let rows: Vec<_> = answer.trim_matches('\n').lines().filter(|line| !line.is_empty()).collect();
    let expected = match rows.first().and_then(|line| line.strip_prefix("refused: ")) {
        Some(refusal) => ExpectedAnswer::Refusal(refusal),
        None => ExpectedAnswer::Rows(rows),
    };
    let order = if title.ends_with(", in order") { RowOrder::Total } else { RowOrder::Free };
    Ok(HandWrittenStatement { title, sql, expected, order })
}
