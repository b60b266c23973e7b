//! The one rewrite of a parsed statement: what the parser reads and DataFusion does not plan.
//!
//! | statement | what DataFusion plans |
//! | --- | --- |
//! | `FROM t` | `SELECT * FROM t` |
//! | `t VERSION AS OF 12` | `"t@12" AS t` |
//! | `SELECT c FROM t LEFT JOIN u USING (c) WHERE c = 1` | `SELECT t.c AS c ... WHERE t.c = 1` |
//! | `t SEMI JOIN u` | `t LEFT SEMI JOIN u` |
//! | `FETCH FIRST 3 ROWS ONLY` | `LIMIT 3` |
//! | `ORDER BY ALL` | `ORDER BY 1, 2, ...` |
//! | `10_000`, `list[2:]` | `10000`, `list[2:-1]` |
//! | `list(x)`, `if(c, x, y)`, `arg_max(x, y)` | `array_agg(x)`, `CASE ...`, `first_value(x ORDER BY y DESC) ...` |
//! | `COLUMNS('x.*')` | the columns of FROM, see [`columns`](super::columns) |
//! | `SUMMARIZE t` | a row per column, see [`summarize`](super::summarize) |
//! | `q EXCEPT ALL r` | rows with numbers, see [`set_operations`](super::set_operations) |
//! | `a IS DISTINCT FROM b AND c` | `(a IS DISTINCT FROM b) AND c`, see [`distinct_operands`](super::distinct_operands) |
//! | `(a, b) IN (q)` | `EXISTS`, see [`row_values`](super::row_values) |
//! | `NULL & NULL`, `sum(NULL)` | `NULL`, `sum(NULL::bigint)` |
//! | `x > ANY (list)` | `NOT (x <= ALL (list))`, see [`list_comparisons`](super::list_comparisons) |
//! | `t AT TIME ZONE 'zone'` | a call of a function |
//! | `t(a, b) AS (SELECT 1, 1)`, `ROLLUP(1, 2)` | names and positions, see [`result_names`](super::result_names) |
//!
//! Some depend on the columns of FROM, which the planner tells. So queries are rewritten from the inside out.

use std::ops::ControlFlow;

use datafusion::common::DFSchema;
use datafusion::execution::session_state::SessionState;
use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::helpers::attached_token::AttachedToken;
use datafusion::sql::sqlparser::ast::{
    AccessExpr, CaseWhen, Cte, Expr, Fetch, Function, FunctionArg, FunctionArgExpr, FunctionArgumentClause,
    FunctionArguments, Ident, JoinOperator, LimitClause, ObjectName, OrderBy, OrderByExpr, OrderByKind, OrderByOptions,
    Query, Select, SelectFlavor, SelectItem, SetExpr, Statement as Sql, Subscript, TableFactor, TableWithJoins, Value,
    ValueWithSpan, Visitor, VisitorMut, WildcardAdditionalOptions, With,
};
use echolake_functions::AT_TIME_ZONE;
use futures::FutureExt as _;

use super::as_of::rewrite_as_of;
use super::columns::{ColumnsExpansion, has_columns, hinted_error};
use super::distinct_operands::order_distinct_operands;
use super::list_comparisons::rewrite_list_comparison;
use super::null_operands::settle_null;
use super::result_names::{expand_grouping_positions, name_listed_columns};
use super::row_values::{rewrite_row_conditions, rewrite_row_value};
use super::set_operations::count_set_rows;
use super::summarize::{summarized_query, write_summary};
use super::syntax_walk::{walk_mut, walk_syntax};
use super::tree;
use super::using_columns::{name_ordering_columns, name_using_columns};
use crate::Error;

/// Aggregates that take the first argument at the greatest (true) or least value of the second.
const ARGUMENT_AT_EXTREME: [(&str, bool); 6] =
    [("arg_max", true), ("argmax", true), ("max_by", true), ("arg_min", false), ("argmin", false), ("min_by", false)];
/// Functions that DataFusion knows under another name.
const OTHER_NAMES: [(&str, &str); 4] = [
    ("list", "array_agg"),
    ("first", "first_value"),
    ("last", "last_value"),
    ("approx_quantile", "approx_percentile_cont"),
];
/// Maximum number of times that one statement's tables are planned for their columns.
const MOST_LOOKUPS: usize = 100;
/// Maximum growth of a statement, in bytes of its text.
const MOST_BYTES: usize = 1 << 20;

type Visit = ControlFlow<Box<Error>>;

/// Rewrites a statement, whose tables `state` knows. `sql` is its text, for places of errors.
///
/// # Errors
/// [`Error::Query`] if it names what is not there, or would become too long.
pub(super) fn rewrite_statement(statement: &mut Statement, state: &SessionState, sql: &str) -> Result<(), Error> {
    match statement {
        Statement::Statement(parsed) => {
            order_distinct_operands(parsed);
            let mut visitor = RewriteVisitor {
                state,
                sql,
                ctes: Vec::new(),
                withs: Vec::new(),
                bytes_left: MOST_BYTES,
                lookups_left: MOST_LOOKUPS,
            };
            match walk_mut(parsed.as_mut(), &mut visitor) {
                ControlFlow::Break(error) => Err(*error),
                ControlFlow::Continue(()) => Ok(()),
            }
        }
        Statement::Explain(explain) => rewrite_statement(&mut explain.statement, state, sql),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => Ok(()),
    }
}

struct RewriteVisitor<'a> {
    state: &'a SessionState,
    sql: &'a str,
    /// Common tables that the query names: those of the queries around, and the ones before.
    ctes: Vec<Cte>,
    /// WITH of each query around: rewritten before its query, so that the walk does not meet it.
    withs: Vec<Option<With>>,
    bytes_left: usize,
    lookups_left: usize,
}

impl VisitorMut for RewriteVisitor<'_> {
    type Break = Box<Error>;

    fn pre_visit_query(&mut self, query: &mut Query) -> Visit {
        limit_fetched_rows(query);
        let mut with = query.with.take();
        for cte in with.iter_mut().flat_map(|with| &mut with.cte_tables) {
            name_listed_columns(&mut cte.query.body, &cte.alias);
            walk_mut(&mut *cte.query, self)?;
            self.ctes.push(cte.clone());
        }
        self.withs.push(with);
        ControlFlow::Continue(())
    }

    fn post_visit_query(&mut self, query: &mut Query) -> Visit {
        visit_outcome(name_ordering_columns(query, &mut |from| self.look_up(from)))?;
        visit_outcome(count_set_rows(&mut query.body, &mut |from| self.look_up(from)))?;
        query.with = self.withs.pop().flatten();
        let own = query.with.as_ref().map_or(0, |with| with.cte_tables.len());
        self.ctes.truncate(self.ctes.len() - own);
        order_by_all(query);
        ControlFlow::Continue(())
    }

    fn pre_visit_select(&mut self, select: &mut Select) -> Visit {
        if select.flavor == SelectFlavor::FromFirstNoSelect {
            select.flavor = SelectFlavor::Standard;
            select.projection = vec![SelectItem::Wildcard(WildcardAdditionalOptions::default())];
        }
        for join in select.from.iter_mut().flat_map(|from| &mut from.joins) {
            join.join_operator = match std::mem::replace(&mut join.join_operator, JoinOperator::CrossApply) {
                JoinOperator::Semi(constraint) => JoinOperator::LeftSemi(constraint),
                JoinOperator::Anti(constraint) => JoinOperator::LeftAnti(constraint),
                other => other,
            };
        }
        visit_outcome(expand_grouping_positions(select))?;
        visit_outcome(select.selection.as_mut().map_or(Ok(()), rewrite_row_conditions))
    }

    fn post_visit_select(&mut self, select: &mut Select) -> Visit {
        visit_outcome(name_using_columns(select, &mut |from| self.look_up(from)))?;
        if has_columns(select) { visit_outcome(self.expand_columns(select)) } else { ControlFlow::Continue(()) }
    }

    fn pre_visit_table_factor(&mut self, factor: &mut TableFactor) -> Visit {
        if let TableFactor::Derived { subquery, alias: Some(alias), .. } = factor {
            name_listed_columns(&mut subquery.body, alias);
        }
        visit_outcome(rewrite_as_of(factor))
    }

    fn post_visit_table_factor(&mut self, factor: &mut TableFactor) -> Visit {
        visit_outcome(self.expand_summary(factor))
    }

    fn pre_visit_value(&mut self, value: &mut ValueWithSpan) -> Visit {
        if let Value::Number(digits, _) = &mut value.value {
            digits.retain(|c| c != '_');
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> Visit {
        match expr {
            Expr::CompoundFieldAccess { access_chain, .. } => access_chain.iter_mut().for_each(close_slice),
            Expr::Function(function) => match rewrite_function(function) {
                Ok(Some(rewritten)) => *expr = rewritten,
                Ok(None) => {}
                Err(error) => return ControlFlow::Break(Box::new(error)),
            },
            Expr::AtTimeZone { timestamp, time_zone } => {
                *expr = tree::function_call(AT_TIME_ZONE, [timestamp, time_zone])
            }
            _ => rewrite_list_comparison(expr),
        }
        let is_aggregate = |name: &str| self.state.aggregate_functions().contains_key(name);
        visit_outcome(rewrite_row_value(expr, &is_aggregate))
    }

    fn post_visit_expr(&mut self, expr: &mut Expr) -> Visit {
        settle_null(expr);
        ControlFlow::Continue(())
    }
}

impl RewriteVisitor<'_> {
    fn expand_columns(&mut self, select: &mut Select) -> Result<(), Error> {
        let schema = self.look_up(select.from.clone())?;
        ColumnsExpansion { schema: &schema, sql: self.sql, bytes_left: &mut self.bytes_left }.expand_select(select)
    }

    fn expand_summary(&mut self, factor: &mut TableFactor) -> Result<(), Error> {
        let Some((query, alias)) = summarized_query(factor) else { return Ok(()) };
        let source = TableFactor::Derived { lateral: false, subquery: query.clone(), alias: None, sample: None };
        let schema = self.look_up(vec![TableWithJoins { relation: source, joins: Vec::new() }])?;
        let subquery = write_summary(query, schema.as_arrow())?;
        *factor = TableFactor::Derived { lateral: false, subquery, alias, sample: None };
        Ok(())
    }

    // The planner tells the columns of FROM.
    fn look_up(&mut self, from: Vec<TableWithJoins>) -> Result<DFSchema, Error> {
        if from.is_empty() {
            return Ok(DFSchema::empty());
        }
        self.lookups_left = self.lookups_left.checked_sub(1).ok_or_else(|| {
            let message = format!("the query has more than {MOST_LOOKUPS} subqueries with COLUMNS");
            hinted_error(message, "WITH for what is repeated".to_owned())
        })?;
        let mut query = tree::parse_query("SELECT *")?;
        if let SetExpr::Select(select) = &mut *query.body {
            select.from = from;
        }
        if !self.ctes.is_empty() {
            let recursive = self.withs.iter().flatten().any(|with| with.recursive);
            query.with = Some(With { with_token: AttachedToken::empty(), recursive, cte_tables: self.last_ctes() });
        }
        let planned = self.state.statement_to_plan(Statement::Statement(Box::new(Sql::Query(query)))).now_or_never();
        // The tables of a query's context are in memory, so that planning never waits.
        let waits = || Error::failed_query("the columns of a table are not known at once");
        let plan = planned.ok_or_else(waits)?.map_err(|e| Error::from_planning(self.sql, &e))?;
        Ok(DFSchema::clone(plan.schema()))
    }

    // Of several of one name the innermost is meant, and a WITH names each once.
    fn last_ctes(&self) -> Vec<Cte> {
        let name = |cte: &Cte| tree::normalized_name(&cte.alias.name);
        let is_last = |(at, cte): &(usize, &Cte)| self.ctes[at + 1..].iter().all(|later| name(later) != name(cte));
        self.ctes.iter().enumerate().filter(is_last).map(|(_, cte)| cte.clone()).collect()
    }
}

fn visit_outcome(result: Result<(), Error>) -> Visit {
    match result {
        Ok(()) => ControlFlow::Continue(()),
        Err(error) => ControlFlow::Break(Box::new(error)),
    }
}

// `FETCH FIRST n ROWS ONLY` becomes `LIMIT n`.
fn limit_fetched_rows(query: &mut Query) {
    let Some(Fetch { with_ties: false, percent: false, quantity }) = &query.fetch else { return };
    let rows = Some(quantity.clone().unwrap_or_else(|| tree::number_literal(1)));
    match &mut query.limit_clause {
        limit @ None => *limit = Some(LimitClause::LimitOffset { limit: rows, offset: None, limit_by: Vec::new() }),
        Some(LimitClause::LimitOffset { limit: limit @ None, .. }) => *limit = rows,
        Some(_) => return,
    }
    query.fetch = None;
}

// `ORDER BY ALL` becomes `ORDER BY 1, 2, ...`; the planner takes it for columns only.
fn order_by_all(query: &mut Query) {
    let Some(OrderBy { kind, .. }) = &mut query.order_by else { return };
    let (OrderByKind::All(options), SetExpr::Select(select)) = (&*kind, &*query.body) else { return };
    let is_one = |item: &SelectItem| matches!(item, SelectItem::UnnamedExpr(_) | SelectItem::ExprWithAlias { .. });
    if !select.projection.iter().all(is_one) {
        return;
    }
    let by = |column| OrderByExpr { expr: tree::number_literal(column), options: *options, with_fill: None };
    let columns = i64::try_from(select.projection.len()).unwrap_or(0);
    *kind = OrderByKind::Expressions((1..=columns).map(by).collect());
}

// `list[2:]` and `list[:2]` have both ends; which ones those of a stride are depends on its sign.
fn close_slice(access: &mut AccessExpr) {
    if let AccessExpr::Subscript(Subscript::Slice { lower_bound, upper_bound, stride: None }) = access {
        lower_bound.get_or_insert_with(|| tree::number_literal(1));
        upper_bound.get_or_insert_with(|| tree::number_literal(-1));
    }
}

// Returns what replaces a call as a whole; None if it stays a call.
fn rewrite_function(function: &mut Function) -> Result<Option<Expr>, Error> {
    let Some(name) = tree::plain_name(&function.name) else { return Ok(None) };
    if let Some((_, known)) = OTHER_NAMES.into_iter().find(|(other, _)| *other == name) {
        function.name = ObjectName::from(vec![Ident::new(known)]);
        return Ok(None);
    }
    let extreme = extreme_of(&name);
    if extreme.is_none() && name != "if" && name != "count_if" {
        return Ok(None);
    }
    match (name.as_str(), extreme, plain_arguments(function).as_deref()) {
        (_, Some(is_greatest), Some([of, by])) => {
            check_extreme(&name, function)?;
            take_at_extreme(function, of, by, is_greatest);
        }
        (_, Some(_), _) => {
            let hint = "arg_max(x, y) of one row, array_agg(x ORDER BY y DESC)[1:3] of several".to_owned();
            return Err(hinted_error(format!("`{name}` takes two values"), hint));
        }
        ("if", _, Some([condition, then, otherwise])) => {
            return Ok(Some(case_expression(condition, then, Some(otherwise))));
        }
        ("count_if", _, Some([condition])) => {
            set_argument(function, "count", case_expression(condition, &tree::number_literal(1), None));
        }
        _ => {}
    }
    Ok(None)
}

fn extreme_of(name: &str) -> Option<bool> {
    ARGUMENT_AT_EXTREME.into_iter().find(|(known, _)| *known == name).map(|(_, is_greatest)| is_greatest)
}

// Its arguments are written twice, so that one in another one in another one would double each time.
fn check_extreme(name: &str, function: &Function) -> Result<(), Error> {
    if function.over.is_some() {
        let hint = "first_value(x) OVER (PARTITION BY p ORDER BY y DESC), or QUALIFY row_number() OVER (...) = 1";
        return Err(hinted_error(format!("`{name}` of two values has no OVER"), hint.to_owned()));
    }
    if walk_syntax(&function.args, &mut ExtremeVisitor).is_break() {
        let hint = "the inner one in a subquery of FROM, or in WITH".to_owned();
        return Err(hinted_error(format!("`{name}` has another such aggregate in it"), hint));
    }
    Ok(())
}

struct ExtremeVisitor;

impl Visitor for ExtremeVisitor {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &Expr) -> ControlFlow<()> {
        let Expr::Function(function) = expr else { return ControlFlow::Continue(()) };
        match tree::plain_name(&function.name).and_then(|name| extreme_of(&name)) {
            Some(_) => ControlFlow::Break(()),
            None => ControlFlow::Continue(()),
        }
    }
}

fn case_expression(condition: &Expr, then: &Expr, otherwise: Option<&Expr>) -> Expr {
    Expr::Case {
        case_token: AttachedToken::empty(),
        end_token: AttachedToken::empty(),
        operand: None,
        conditions: vec![CaseWhen { condition: condition.clone(), result: then.clone() }],
        else_result: otherwise.cloned().map(Box::new),
    }
}

fn plain_arguments(function: &Function) -> Option<Vec<Expr>> {
    let FunctionArguments::List(list) = &function.args else { return None };
    let expr = |argument: &FunctionArg| match argument {
        FunctionArg::Unnamed(FunctionArgExpr::Expr(expr)) => Some(expr.clone()),
        _ => None,
    };
    list.args.iter().map(expr).collect()
}

fn set_argument(function: &mut Function, name: &str, argument: Expr) {
    function.name = ObjectName::from(vec![Ident::new(name)]);
    if let FunctionArguments::List(list) = &mut function.args {
        list.args = vec![FunctionArg::Unnamed(FunctionArgExpr::Expr(argument))];
    }
}

// `arg_max(x, y)` becomes `first_value(x ORDER BY y DESC) FILTER (WHERE x IS NOT NULL AND y IS NOT NULL)`.
fn take_at_extreme(function: &mut Function, of: &Expr, by: &Expr, is_greatest: bool) {
    set_argument(function, "first_value", of.clone());
    let options = OrderByOptions { asc: Some(!is_greatest), nulls_first: Some(false) };
    if let FunctionArguments::List(list) = &mut function.args {
        let order = vec![OrderByExpr { expr: by.clone(), options, with_fill: None }];
        list.clauses.push(FunctionArgumentClause::OrderBy(order));
    }
    let is_there = |expr: &Expr| Expr::IsNotNull(Box::new(Expr::Nested(Box::new(expr.clone()))));
    let are_there = tree::and_conditions(is_there(of), is_there(by));
    function.filter = Some(Box::new(match function.filter.take() {
        Some(filter) => tree::and_conditions(*filter, are_there),
        None => are_there,
    }));
}
