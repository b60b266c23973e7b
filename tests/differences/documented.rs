//! What echolake answers otherwise than DuckDB by design, each with the reason. `docs/duckdb.md` is written from this.

use super::ComparisonOutcome;

/// Settings with which DuckDB means the same by `ORDER BY` without NULLS, and by times.
pub(crate) const PEER_SETTINGS: [(&str, &str); 2] =
    [("default_null_order", "nulls_last_on_asc_first_on_desc"), ("TimeZone", "UTC")];

/// Recognises a difference by its statement and by what was found.
type DifferenceTest = fn(&str, &ComparisonOutcome) -> bool;

/// A difference by design.
pub(crate) struct DocumentedDifference {
    /// What it is about.
    pub name: &'static str,
    /// A statement that shows it.
    pub sql: &'static str,
    /// Why echolake answers so.
    pub reason: &'static str,
    /// Recognises it; not needed for one that a setting of DuckDB, or [`peer_text`], removes.
    pub applies: Option<DifferenceTest>,
}

/// All of them.
pub(crate) const DOCUMENTED: [DocumentedDifference; 20] = [
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
        name: "number with a point",
        sql: "select 0.1 + 0.2 = 0.3 as x",
        reason: "it is a double; `'0.1'::decimal(10, 2)` is a decimal",
        applies: None,
    },
    DocumentedDifference {
        name: "division by zero",
        sql: "select 1 % 0 as x",
        reason: "an error, as in PostgreSQL, and not NULL",
        applies: Some(
            |_, outcome| matches!(outcome, ComparisonOutcome::RefusedHere(text) if text.contains("division by zero")),
        ),
    },
    DocumentedDifference {
        name: "statistic of values without bounds",
        sql: "select var_samp(x) as x from (values ('inf'::double), (1.0::double)) t(x)",
        reason: "NaN, as arithmetic has it, and no error",
        applies: Some(|sql, outcome| match outcome {
            ComparisonOutcome::RefusedThere(text) => text.contains("is out of range!"),
            _ => (sql.contains("stddev") || sql.contains("var_")) && has_words(outcome, &["NaN"]),
        }),
    },
    DocumentedDifference {
        name: "correlation of one row",
        sql: "select corr(x, x) as x from (values (1.0::double)) t(x)",
        reason: "NULL, as in PostgreSQL: it is not defined",
        applies: Some(|sql, outcome| (sql.contains("corr(") || sql.contains("regr_")) && has_words(outcome, &["NaN"])),
    },
    DocumentedDifference {
        name: "sign of zero in a list",
        sql: "select array_has([x], 0.0) as x from (values ((-0.0)::double)) t(x)",
        reason: "values in lists are compared by their bits; `x + 0.0` has no sign",
        applies: Some(|sql, outcome| {
            sql.contains("-0.0") && sql.contains("array_") && has_words(outcome, &["-0", "false"])
        }),
    },
    DocumentedDifference {
        name: "NULL in array_sort",
        sql: "select array_sort([2, null, 1]) as x",
        reason: "it comes first",
        applies: Some(|sql, outcome| sql.contains("array_sort(") && has_words(outcome, &["[null"])),
    },
    DocumentedDifference {
        name: "NULL in array_distinct",
        sql: "select array_distinct([1, null]) as x",
        reason: "it is a value, which is there once",
        applies: Some(|sql, outcome| {
            sql.contains("array_distinct(")
                && sql.contains("null")
                && matches!(outcome, ComparisonOutcome::Different(_))
        }),
    },
    DocumentedDifference {
        name: "NULL in a row beside a subquery",
        sql: "select (1, 1) in (select null::int, 10) as x",
        reason: "a row with an unequal value is another one, whatever is NULL in it, as in PostgreSQL",
        applies: Some(|sql, outcome| match outcome {
            ComparisonOutcome::Different(text) => {
                sql.contains(") in (select ") && text.contains("false and ") && text.ends_with("null")
            }
            _ => false,
        }),
    },
    DocumentedDifference {
        name: "count_if of NULL alone",
        sql: "select count_if(x) as x from (values (null::boolean)) t(x)",
        reason: "a count is never NULL",
        applies: Some(|sql, outcome| sql.contains("count_if(") && has_words(outcome, &["null"])),
    },
    DocumentedDifference {
        name: "halves as whole numbers",
        sql: "select cast((-2.5)::double as int) as x",
        reason: "casts round ties away from zero, of doubles, too",
        applies: Some(|sql, outcome| sql.contains("cast(") && sql.contains("-2.5") && has_words(outcome, &["-3"])),
    },
    DocumentedDifference {
        name: "number beyond REAL",
        sql: "select try_cast(1e300::double as real) as x",
        reason: "its cast is infinite, and no error",
        applies: Some(|sql, outcome| sql.contains("as real)") && has_words(outcome, &["inf"])),
    },
    DocumentedDifference {
        name: "text of a time",
        sql: "select cast(timestamp '2026-01-05 12:00:00' as varchar) as x",
        reason: "ISO 8601, with `T`, as in CSV and JSON",
        applies: Some(|sql, outcome| sql.contains("varchar") && has_iso_time(outcome)),
    },
    DocumentedDifference {
        name: "text of an interval",
        sql: "select cast(interval '90 minutes' as varchar) as x",
        reason: "Arrow's",
        applies: Some(|sql, outcome| sql.contains("varchar") && has_words(outcome, &[" mins", " hours", " days"])),
    },
    DocumentedDifference {
        name: "NULL in a list as text",
        sql: "select array_to_string([null::text], '-') as x",
        reason: "it is left out, as in PostgreSQL",
        applies: Some(|sql, outcome| sql.contains("array_to_string(") && has_words(outcome, &[""])),
    },
    DocumentedDifference {
        name: "start of substr",
        sql: "select substr('abc', -1, 3) as x",
        reason: "it counts from the first character, as in PostgreSQL: here two places lie before it",
        applies: Some(|sql, outcome| sql.contains("substr(") && sql.contains(", -1, ") && has_words(outcome, &[""])),
    },
    DocumentedDifference {
        name: "escape of LIKE",
        sql: "select 'a%b' like '%\\%%' as x",
        reason: "a backslash escapes `%` and `_`, as in PostgreSQL",
        applies: Some(|sql, outcome| sql.contains("like '%\\%'") && has_words(outcome, &[""])),
    },
    DocumentedDifference {
        name: "capital of ß",
        sql: "select upper('ß') as x",
        reason: "`SS`, as Unicode has it",
        applies: Some(|sql, outcome| sql.contains("upper(") && has_words(outcome, &["ẞ"])),
    },
    DocumentedDifference {
        name: "accents in reverse",
        sql: "select reverse('e' || chr(769) || 'x') = 'x' || chr(769) || 'e' as x",
        reason: "it turns the code points round, as in PostgreSQL",
        applies: Some(|sql, outcome| sql.contains("reverse(") && has_words(outcome, &["\u{301}"])),
    },
];

/// Returns the name of the documented difference that this one is.
pub(crate) fn find_documented(sql: &str, outcome: &ComparisonOutcome) -> Option<&'static str> {
    let applies = |known: &&DocumentedDifference| known.applies.is_some_and(|applies| applies(sql, outcome));
    DOCUMENTED.iter().find(applies).map(|known| known.name)
}

/// Returns a statement with DuckDB's operator for the division by a whole number that is written out.
pub(crate) fn peer_text(sql: &str) -> String {
    let mut text = String::new();
    for (number, part) in sql.split(" / ").enumerate() {
        let digits = part.trim_start_matches('-').trim_start_matches(|c: char| c.is_ascii_digit());
        let has_digits = part.starts_with(|c: char| c == '-' || c.is_ascii_digit());
        let is_whole = has_digits && !digits.starts_with(|c: char| c == '.' || c == ':' || c.is_ascii_alphanumeric());
        text.push_str(if number == 0 {
            ""
        } else if is_whole {
            " // "
        } else {
            " / "
        });
        text.push_str(part);
    }
    text
}

fn has_words(outcome: &ComparisonOutcome, words: &[&str]) -> bool {
    matches!(outcome, ComparisonOutcome::Different(text) if words.iter().any(|word| text.contains(word)))
}

fn has_iso_time(outcome: &ComparisonOutcome) -> bool {
    let is_time = |part: &[u8]| part[0].is_ascii_digit() && part[1] == b'T' && part[2].is_ascii_digit();
    matches!(outcome, ComparisonOutcome::Different(text) if text.as_bytes().windows(3).any(is_time))
}
