//! Refuses clauses that the parser reads and the planner drops without a word, so that no answer is silently another
//! query's.

use std::ops::ControlFlow;

use datafusion::execution::session_state::SessionState;
use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::{
    BinaryOperator, Expr, Function, FunctionArgumentClause, FunctionArguments, Join, JoinConstraint, JoinOperator,
    ObjectName, ObjectNamePart, Query, Select, TableFactor, TableWithJoins, Visitor,
};

use super::syntax_walk::walk_syntax;
use super::{as_of_join, hints, tree};
use crate::Error;

/// Aliases that are the first word of a kind of join which the parser does not know.
const JOIN_WORDS: [&str; 1] = ["POSITIONAL"];

/// Accepts statements all of whose clauses are planned.
///
/// # Errors
/// [`Error::Query`] with the clause and what to write instead.
pub(super) fn check_clauses(statement: &Statement, sql: &str, state: &SessionState) -> Result<(), Error> {
    match statement {
        Statement::Statement(parsed) => match walk_syntax(parsed.as_ref(), &mut ClauseVisitor { state }) {
            ControlFlow::Break(ignored) => Err(Error::unsupported_clause(sql, &ignored.clause, ignored.hint)),
            ControlFlow::Continue(()) => Ok(()),
        },
        Statement::Explain(explain) => check_clauses(&explain.statement, sql, state),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => Ok(()),
    }
}

/// A clause that would be dropped; it begins with the word by which it is found in the query.
struct IgnoredClause {
    clause: String,
    hint: String,
}

struct ClauseVisitor<'a> {
    state: &'a SessionState,
}

type Outcome = ControlFlow<IgnoredClause>;

fn refuse_if(is_there: bool, clause: &str, hint: &str) -> Outcome {
    match is_there {
        true => ControlFlow::Break(IgnoredClause { clause: clause.to_owned(), hint: hint.to_owned() }),
        false => ControlFlow::Continue(()),
    }
}

impl Visitor for ClauseVisitor<'_> {
    type Break = IgnoredClause;

    fn pre_visit_query(&mut self, query: &Query) -> Outcome {
        refuse_if(query.for_clause.is_some(), "FOR XML, FOR JSON and FOR BROWSE", "--format json prints rows as JSON")?;
        refuse_if(query.settings.is_some(), "SETTINGS", "leave it out")?;
        refuse_if(query.format_clause.is_some(), "FORMAT", "leave it out; the format is an option of the client")
    }

    fn pre_visit_select(&mut self, select: &Select) -> Outcome {
        refuse_if(select.prewhere.is_some(), "PREWHERE", "WHERE")?;
        refuse_if(!select.connect_by.is_empty(), "CONNECT BY", "WITH RECURSIVE")?;
        refuse_if(select.exclude.is_some(), "EXCLUDE after the columns", "SELECT * EXCLUDE (column)")?;
        refuse_if(select.value_table_mode.is_some(), "AS STRUCT and AS VALUE", "SELECT struct(column, ...)")?;
        select.from.iter().try_for_each(check_joins)
    }

    fn pre_visit_table_factor(&mut self, factor: &TableFactor) -> Outcome {
        const SAMPLE: &str = "WHERE random() < 0.1 takes a tenth of the rows, ORDER BY random() LIMIT 10 takes ten";
        match factor {
            TableFactor::Table { sample, partitions, index_hints, with_ordinality, json_path, .. } => {
                refuse_if(sample.is_some(), "TABLESAMPLE", SAMPLE)?;
                refuse_if(!partitions.is_empty(), "PARTITION of a table", "WHERE surface_id = '...'")?;
                refuse_if(!index_hints.is_empty(), "INDEX hints", "leave them out")?;
                refuse_if(json_path.is_some(), "PartiQL paths of a table", "select the column")?;
                refuse_if(*with_ordinality, "ORDINALITY", "row_number() over ()")
            }
            TableFactor::Derived { sample, .. } => refuse_if(sample.is_some(), "TABLESAMPLE", SAMPLE),
            TableFactor::Function { with_ordinality, .. } => {
                refuse_if(*with_ordinality, "ORDINALITY", "row_number() over ()")
            }
            TableFactor::NestedJoin { table_with_joins, .. } => check_joins(table_with_joins),
            TableFactor::Pivot { .. } => refuse_if(true, "PIVOT", hints::PIVOT),
            TableFactor::Unpivot { .. } => refuse_if(true, "UNPIVOT", hints::UNPIVOT),
            _ => ControlFlow::Continue(()),
        }
    }

    fn pre_visit_expr(&mut self, expr: &Expr) -> Outcome {
        let is_caret = matches!(expr, Expr::BinaryOp { op: BinaryOperator::BitwiseXor, .. });
        refuse_if(is_caret, "`^`, which means power or XOR", "power(a, b) or bit_xor over rows")?;
        refuse_if(matches!(expr, Expr::JsonAccess { .. }), "a name before a colon", hints::NAMED)?;
        let Expr::Function(function) = expr else { return ControlFlow::Continue(()) };
        let name = function.name.to_string();
        let is_columns = name.eq_ignore_ascii_case("columns");
        refuse_if(is_columns, "COLUMNS here", "COLUMNS in a select list, in WHERE, HAVING or QUALIFY")?;
        let has_parameters = function.parameters != FunctionArguments::None;
        refuse_if(has_parameters, &format!("parameters of {name} before its arguments"), "write them as arguments")?;
        if !self.is_scalar(&function.name) {
            return ControlFlow::Continue(());
        }
        let refuse = |is_there, clause: &str| {
            refuse_if(is_there, &format!("{clause} in a call of {name}"), "only aggregate and window functions take it")
        };
        refuse(function.over.is_some(), "OVER")?;
        refuse(function.filter.is_some(), "FILTER")?;
        refuse(is_ordered(function), "ORDER BY")?;
        refuse(is_distinct(function), "DISTINCT")?;
        refuse(function.null_treatment.is_some(), "NULLS")
    }
}

// A join without a condition would be a cross join.
fn check_joins(tables: &TableWithJoins) -> Outcome {
    let mut left = &tables.relation;
    for Join { relation, join_operator, global } in &tables.joins {
        if let Some(word) = join_word(left) {
            refuse_if(true, &format!("{word} JOIN"), "JOIN ... ON row_number, or quote the alias")?;
        }
        let is_bare = matches!(
            join_operator,
            JoinOperator::Join(JoinConstraint::None)
                | JoinOperator::Inner(JoinConstraint::None)
                | JoinOperator::Left(JoinConstraint::None)
                | JoinOperator::LeftOuter(JoinConstraint::None)
                | JoinOperator::Right(JoinConstraint::None)
                | JoinOperator::RightOuter(JoinConstraint::None)
                | JoinOperator::FullOuter(JoinConstraint::None)
        );
        let is_as_of = matches!(join_operator, JoinOperator::AsOf { .. });
        refuse_if(is_as_of, "MATCH_CONDITION of a join", as_of_join::FORM)?;
        refuse_if(*global, "GLOBAL JOIN", "JOIN")?;
        refuse_if(is_bare, "JOIN without ON or USING", "CROSS JOIN if every pair of rows is meant")?;
        left = relation;
    }
    ControlFlow::Continue(())
}

// `a POSITIONAL JOIN b` is read as table `a` with an alias.
fn join_word(factor: &TableFactor) -> Option<&'static str> {
    let (TableFactor::Table { alias, .. } | TableFactor::Derived { alias, .. } | TableFactor::Function { alias, .. }) =
        factor
    else {
        return None;
    };
    let alias = alias.as_ref().filter(|a| !a.explicit && a.name.quote_style.is_none())?;
    JOIN_WORDS.into_iter().find(|word| alias.name.value.eq_ignore_ascii_case(word))
}

impl ClauseVisitor<'_> {
    // A scalar function and nothing else.
    fn is_scalar(&self, name: &ObjectName) -> bool {
        let [ObjectNamePart::Identifier(name)] = name.0.as_slice() else { return false };
        let name = tree::normalized_name(name);
        self.state.scalar_functions().contains_key(&name)
            && !self.state.aggregate_functions().contains_key(&name)
            && !self.state.window_functions().contains_key(&name)
    }
}

fn is_ordered(function: &Function) -> bool {
    let has_order = |clause: &FunctionArgumentClause| matches!(clause, FunctionArgumentClause::OrderBy(_));
    let in_arguments = match &function.args {
        FunctionArguments::List(list) => list.clauses.iter().any(has_order),
        _ => false,
    };
    in_arguments || !function.within_group.is_empty()
}

fn is_distinct(function: &Function) -> bool {
    matches!(&function.args, FunctionArguments::List(list) if list.duplicate_treatment.is_some())
}
