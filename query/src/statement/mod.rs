//! From the text of a statement to the plan that DataFusion runs.
//!
//! [`parse_statement`] checks the bounds of a text ([`bounds`]) and parses it in the [`dialect`] of HTTP, Flight SQL
//! and the prompt; Postgres' protocol checks the same bounds and has a parser of its own. [`prepare_statement`] then
//! takes the steps that are the same for all protocols, in this order: the one [`rewrite`] of the tree, the [`gate`]
//! and the check of [`clauses`], the planner, and four passes over its plan. The text itself is never rewritten.

mod as_of;
mod as_of_join;
mod bounds;
mod cast_place;
mod clauses;
mod columns;
mod declared_types;
mod dialect;
mod distinct_operands;
mod ending_rules;
mod expansion;
mod float_forms;
mod gate;
pub(crate) mod hints;
mod integer_arithmetic;
mod integer_casts;
mod limited_operators;
mod list_comparisons;
mod literals;
mod null_operands;
mod placeholders;
mod predicate;
mod result_names;
mod rewrite;
mod row_values;
mod script;
mod set_operations;
mod subquery_conditions;
mod summarize;
mod syntax_walk;
#[cfg(test)]
mod tests;
mod tree;
mod using_columns;

use std::sync::Arc;

use datafusion::execution::context::SQLOptions;
use datafusion::execution::session_state::SessionState;
use datafusion::logical_expr::{DescribeTable, LogicalPlan};
use datafusion::sql::parser::{DFParserBuilder, Statement};
use datafusion::sql::sqlparser::ast::{DescribeAlias, Statement as Sql};
use datafusion::sql::sqlparser::tokenizer::Tokenizer;

pub(crate) use as_of::{PastTableName, find_past_tables};
pub(crate) use as_of_join::AsOfSidePlanner;
pub use bounds::check_statement_bounds;
pub(crate) use cast_place::find_cast;
pub(crate) use ending_rules::{EndingPhysicalRule, EndingRule, end_joins};
pub(crate) use float_forms::FloatForms;
pub(crate) use integer_arithmetic::{IntegerArithmetic, checked_operators};
pub(crate) use limited_operators::LimitedOperators;
pub use predicate::PredicateForm;
pub(crate) use predicate::append_predicate;
pub use script::{is_blank_statement, split_statement};
pub(crate) use subquery_conditions::{SubqueryConditions, UNPLANNED};
pub use syntax_walk::{walk_expr, walk_statement};

use crate::Error;
use dialect::LakeDialect;

/// Parses a text that is one statement.
///
/// # Errors
/// [`Error::Query`] if it is none, or exceeds a bound.
pub(crate) fn parse_statement(sql: &str, recursion_limit: usize) -> Result<Statement, Error> {
    check_statement_bounds(sql, &LakeDialect)?;
    let tokens = Tokenizer::new(&LakeDialect, sql).tokenize_with_location();
    let tokens = summarize::read_summarize(tokens.map_err(|e| Error::from_tokenizer(sql, e.into()))?);
    let (tokens, as_of_joins) = as_of_join::read_as_of_joins(tokens);
    let builder = DFParserBuilder::new(tokens).with_dialect(&LakeDialect).with_recursion_limit(recursion_limit);
    let statements = builder.build().and_then(|mut parser| parser.parse_statements());
    match <[Statement; 1]>::try_from(Vec::from(statements.map_err(|e| Error::from_planning(sql, &e))?)) {
        Ok([mut statement]) => {
            as_of_join::mark_as_of_joins(&mut statement, as_of_joins, sql)?;
            Ok(statement)
        }
        Err(none) if none.is_empty() => Err(columns::hinted_error("no statement".into(), "select * from surfaces")),
        Err(_) => {
            let hint = "`echolake sql` takes several, each ended by ;";
            Err(columns::hinted_error("one statement at a time".into(), hint))
        }
    }
}

/// Plans a parsed statement, whose tables `state` knows. `sql` is its text, for places of errors.
///
/// # Errors
/// [`Error::Query`] if it cannot be planned as a whole, [`Error::NotReading`] if it would change something.
pub(crate) async fn prepare_statement(
    sql: &str,
    mut statement: Statement,
    state: &SessionState,
) -> Result<LogicalPlan, Error> {
    rewrite::rewrite_statement(&mut statement, state, sql)?;
    gate::check_reading(&statement)?;
    expansion::check_expansion(&statement)?;
    clauses::check_clauses(&statement, sql, state)?;
    let described = match described_query(&statement) {
        Some(query) => Some(Arc::new(plan_statement(sql, query, state).await?.schema().as_arrow().clone())),
        None => None,
    };
    let plan = match (plan_statement(sql, statement, state).await?, described) {
        (LogicalPlan::DescribeTable(table), Some(schema)) => {
            LogicalPlan::DescribeTable(DescribeTable { schema, ..table })
        }
        (plan, _) => plan,
    };
    // `SELECT INTO` reads by its first word and makes a table by its plan.
    let reading = SQLOptions::new().with_allow_ddl(false).with_allow_dml(false).with_allow_statements(false);
    reading.verify_plan(&plan).map_err(|_| Error::NotReading { statement: plan.display().to_string() })?;
    Ok(plan)
}

async fn plan_statement(sql: &str, statement: Statement, state: &SessionState) -> Result<LogicalPlan, Error> {
    let plan = state.statement_to_plan(statement).await;
    let plan = plan.and_then(placeholders::infer_types).and_then(integer_casts::round_casts);
    let plan = plan.and_then(|plan| declared_types::settle_types(plan, state.config_options()));
    let plan = plan.and_then(as_of_join::plan_as_of_joins);
    plan.map_err(|e| Error::from_planning(sql, &e))
}

// Returns the query of DESCRIBE, whose types the planner takes before they are settled.
fn described_query(statement: &Statement) -> Option<Statement> {
    let Statement::Statement(parsed) = statement else { return None };
    match parsed.as_ref() {
        Sql::Explain { describe_alias: DescribeAlias::Describe | DescribeAlias::Desc, statement, .. }
            if matches!(**statement, Sql::Query(_)) =>
        {
            Some(Statement::Statement(statement.clone()))
        }
        _ => None,
    }
}
