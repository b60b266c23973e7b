//! Limits on rewriting: what a short statement may grow to.

use datafusion::sql::sqlparser::ast::Expr;

use crate::Error;

/// Maximum number of times that one statement's tables are planned for their columns.
const MOST_LOOKUPS: usize = 100;
/// Maximum growth of a statement, in bytes of its text.
const MOST_BYTES: usize = 1 << 20;

/// Room that a choice of columns takes, for the regular expression or lambda.
const CHOICE_BYTES: usize = 1 << 10;
/// Room that each of the columns takes.
const COLUMN_BYTES: usize = 16;

/// The rest of what one statement may cost.
pub(super) struct RewriteBudget {
    lookups: usize,
    bytes: usize,
}

impl RewriteBudget {
    pub(super) fn new() -> Self {
        Self { lookups: MOST_LOOKUPS, bytes: MOST_BYTES }
    }

    /// Takes one lookup of columns.
    ///
    /// # Errors
    /// [`Error::Query`] if none is left.
    pub(super) fn take_lookup(&mut self) -> Result<(), Error> {
        let what = "subqueries with COLUMNS, PIVOT, RENAME or aliases that are used again";
        self.lookups = self.lookups.checked_sub(1).ok_or_else(|| exceeded(MOST_LOOKUPS, what))?;
        Ok(())
    }

    /// Takes one choice among `columns` columns.
    ///
    /// # Errors
    /// [`Error::Query`] if there is no room for it.
    pub(super) fn take_choice(&mut self, columns: usize) -> Result<(), Error> {
        self.take_bytes(CHOICE_BYTES + columns * COLUMN_BYTES)
    }

    /// Takes the room of `copies` copies of an expression.
    ///
    /// # Errors
    /// [`Error::Query`] if there is not so much.
    pub(super) fn take_copies(&mut self, expr: &Expr, copies: usize) -> Result<(), Error> {
        self.take_bytes(expr.to_string().len().saturating_mul(copies))
    }

    fn take_bytes(&mut self, bytes: usize) -> Result<(), Error> {
        let what = "bytes once COLUMNS, PIVOT and aliases are written out";
        self.bytes = self.bytes.checked_sub(bytes).ok_or_else(|| exceeded(MOST_BYTES, what))?;
        Ok(())
    }
}

fn exceeded(most: usize, what: &str) -> Error {
    Error::Query {
        message: format!("the query has more than {most} {what}"),
        place: None,
        hint: Some("fewer columns at a time, or WITH for what is repeated".to_owned()),
    }
}
