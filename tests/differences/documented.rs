//! What echolake answers otherwise than DuckDB by design, each with the reason. `docs/duckdb.md` is written from this.

use super::ComparisonOutcome;

/// Settings with which DuckDB means the same by `/` and by `ORDER BY` without NULLS.
pub(crate) const PEER_SETTINGS: [(&str, &str); 3] =
    [("integer_division", "true"), ("default_null_order", "nulls_last_on_asc_first_on_desc"), ("TimeZone", "UTC")];

/// Recognises a difference by its statement and by the answers.
type DifferenceTest = fn(&str, &ComparisonOutcome) -> bool;

/// A difference by design.
pub(crate) struct DocumentedDifference {
    /// What it is about.
    pub name: &'static str,
    /// A statement that shows it.
    pub sql: &'static str,
    /// Why echolake answers so.
    pub reason: &'static str,
    /// Recognises it; not needed for one that a setting of DuckDB removes.
    pub applies: Option<DifferenceTest>,
}

/// All of them.
pub(crate) const DOCUMENTED: [DocumentedDifference; 3] = [
    DocumentedDifference {
        name: "division of whole numbers",
        sql: "select 7 / 2 as x",
        reason: "`/` of whole numbers is a whole number, as in PostgreSQL; DuckDB has `//` for it",
        applies: None,
    },
    DocumentedDifference {
        name: "place of NULL",
        sql: "select x from (values (1), (null)) t(x) order by x desc limit 1",
        reason: "NULL is greater than all values without `NULLS FIRST` or `NULLS LAST`, as in PostgreSQL",
        applies: None,
    },
    DocumentedDifference {
        name: "division by zero",
        sql: "select 1 % 0 as x",
        reason: "an error, as in PostgreSQL, and not NULL",
        applies: Some(
            |_, outcome| matches!(outcome, ComparisonOutcome::RefusedHere(message) if message.contains("division by zero")),
        ),
    },
];

/// Returns the name of the documented difference that this one is.
pub(crate) fn find_documented(sql: &str, outcome: &ComparisonOutcome) -> Option<&'static str> {
    let applies = |known: &&DocumentedDifference| known.applies.is_some_and(|applies| applies(sql, outcome));
    DOCUMENTED.iter().find(applies).map(|known| known.name)
}
