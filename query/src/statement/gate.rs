//! The gate for statements: only those that read may pass. All others are refused by name before planning.

use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::Statement as Sql;

use crate::Error;

/// Accepts statements that only read.
///
/// # Errors
/// [`Error::NotReading`] for all others.
pub(super) fn check_reading(statement: &Statement) -> Result<(), Error> {
    let reads = match statement {
        Statement::Statement(sql) => is_reading(sql),
        Statement::Explain(explain) => return check_reading(&explain.statement),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => false,
    };
    if reads { Ok(()) } else { Err(Error::NotReading { statement: leading_keywords(&statement.to_string()) }) }
}

// An allow list, so that new statements of a newer parser are refused until they have been reviewed.
fn is_reading(statement: &Sql) -> bool {
    match statement {
        Sql::Explain { statement, .. } => is_reading(statement),
        Sql::Query(_)
        | Sql::ExplainTable { .. }
        | Sql::ShowTables { .. }
        | Sql::ShowColumns { .. }
        | Sql::ShowFunctions { .. }
        | Sql::ShowVariable { .. } => true,
        _ => false,
    }
}

// The name of `CREATE EXTERNAL TABLE x ...`: up to three words before the first that is not in capitals.
fn leading_keywords(statement: &str) -> String {
    let is_keyword = |word: &&str| !word.is_empty() && word.chars().all(|c| c.is_ascii_uppercase());
    statement.split_whitespace().take_while(is_keyword).take(3).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_statement_is_called_by_its_keywords() {
        assert_eq!(leading_keywords("CREATE EXTERNAL TABLE x STORED AS PARQUET"), "CREATE EXTERNAL TABLE");
        assert_eq!(leading_keywords("DROP TABLE runs"), "DROP TABLE");
        assert_eq!(leading_keywords("INSERT INTO points VALUES (1)"), "INSERT INTO");
    }
}
