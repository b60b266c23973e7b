//! Rewrites by shape alone: syntax that DataFusion parses and does not plan, and functions under other names.

use std::ops::ControlFlow;

use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::helpers::attached_token::AttachedToken;
use datafusion::sql::sqlparser::ast::{
    AccessExpr, CaseWhen, Expr, Fetch, Function, FunctionArg, FunctionArgExpr, FunctionArgumentClause,
    FunctionArguments, Ident, JoinOperator, LimitClause, ObjectName, ObjectNamePart, OrderByExpr, OrderByOptions,
    Query, Select, SelectFlavor, SelectItem, Subscript, Value, ValueWithSpan, VisitorMut, WildcardAdditionalOptions,
};

use super::budget::RewriteBudget;
use super::columns::refused;
use super::tree;
use crate::Error;
use crate::syntax_walk::walk_mut;

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
/// Schemas, whose functions are no methods of a column.
const SCHEMAS: [&str; 4] = ["pg_catalog", "information_schema", "public", "datafusion"];

/// Rewrites in place: `FROM t` alone, `FETCH FIRST n ROWS ONLY`, `10_000`, `x: 42`, `x.f()`, `list[2:]`, `arg_max` and
/// its relatives.
///
/// # Errors
/// [`Error::Query`] if the statement would become too long.
pub(crate) fn rewrite(statement: &mut Statement) -> Result<(), Error> {
    match statement {
        Statement::Statement(sql) => match walk_mut(sql, &mut FriendlyVisitor { budget: RewriteBudget::new() }) {
            ControlFlow::Break(error) => Err(*error),
            ControlFlow::Continue(()) => Ok(()),
        },
        Statement::Explain(explain) => rewrite(&mut explain.statement),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => Ok(()),
    }
}

struct FriendlyVisitor {
    budget: RewriteBudget,
}

impl VisitorMut for FriendlyVisitor {
    type Break = Box<Error>;

    fn pre_visit_query(&mut self, query: &mut Query) -> ControlFlow<Box<Error>> {
        if let Some(Fetch { with_ties: false, percent: false, quantity }) = &query.fetch {
            let rows = quantity.clone().unwrap_or_else(|| Expr::value(Value::Number("1".into(), false)));
            match &mut query.limit_clause {
                None => {
                    let (limit, limit_by) = (Some(rows), Vec::new());
                    query.limit_clause = Some(LimitClause::LimitOffset { limit, offset: None, limit_by });
                    query.fetch = None;
                }
                Some(LimitClause::LimitOffset { limit: limit @ None, .. }) => {
                    *limit = Some(rows);
                    query.fetch = None;
                }
                Some(_) => {}
            }
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_select(&mut self, select: &mut Select) -> ControlFlow<Box<Error>> {
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
        for item in &mut select.projection {
            if let SelectItem::UnnamedExpr(Expr::Named { expr, name }) = item {
                *item = tree::item((**expr).clone(), Some(name.clone()));
            }
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_value(&mut self, value: &mut ValueWithSpan) -> ControlFlow<Box<Error>> {
        if let Value::Number(digits, _) = &mut value.value {
            digits.retain(|c| c != '_');
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<Box<Error>> {
        match expr {
            Expr::CompoundFieldAccess { root, access_chain } if access_chain.iter().any(is_call) => {
                *expr = chained_calls(std::mem::replace(&mut **root, tree::number(0)), std::mem::take(access_chain));
            }
            Expr::Function(function) => call_on_column(function),
            _ => {}
        }
        match expr {
            Expr::CompoundFieldAccess { access_chain, .. } => access_chain.iter_mut().for_each(close_slice),
            Expr::Function(function) => match rewrite_function(function, &mut self.budget) {
                Ok(Some(rewritten)) => *expr = rewritten,
                Ok(None) => {}
                Err(error) => return ControlFlow::Break(Box::new(error)),
            },
            _ => {}
        }
        ControlFlow::Continue(())
    }
}

fn is_call(access: &AccessExpr) -> bool {
    matches!(access, AccessExpr::Dot(Expr::Function(_)))
}

// `x.f().g(2)` becomes `g(f(x), 2)`.
fn chained_calls(root: Expr, chain: Vec<AccessExpr>) -> Expr {
    let (mut expr, mut accesses) = (root, Vec::new());
    let with_accesses = |expr: Expr, accesses: &mut Vec<AccessExpr>| match accesses.is_empty() {
        true => expr,
        false => with_fields(expr, std::mem::take(accesses)),
    };
    for access in chain {
        match access {
            AccessExpr::Dot(Expr::Function(mut function)) => {
                prepend(&mut function, with_accesses(expr, &mut accesses));
                expr = Expr::Function(function);
            }
            other => accesses.push(other),
        }
    }
    with_accesses(expr, &mut accesses)
}

// `a.b` of names is one compound name.
fn with_fields(root: Expr, accesses: Vec<AccessExpr>) -> Expr {
    let name = |access: &AccessExpr| match access {
        AccessExpr::Dot(Expr::Identifier(name)) => Some(name.clone()),
        _ => None,
    };
    match (&root, accesses.iter().map(name).collect::<Option<Vec<_>>>()) {
        (Expr::Identifier(first), Some(names)) => {
            Expr::CompoundIdentifier([first.clone()].into_iter().chain(names).collect())
        }
        _ => Expr::CompoundFieldAccess { root: Box::new(root), access_chain: accesses },
    }
}

// The parser takes `x.f(1)` for a function `f` of a schema `x`.
fn call_on_column(function: &mut Function) {
    let names: Option<Vec<Ident>> = function.name.0.iter().map(|part| part.as_ident().cloned()).collect();
    let Some(names) = names else { return };
    let [column @ .., name] = names.as_slice() else { return };
    let expr = match column {
        [] => return,
        [first, ..] if SCHEMAS.contains(&tree::normalized(first).as_str()) => return,
        [one] => Expr::Identifier(one.clone()),
        more => Expr::CompoundIdentifier(more.to_vec()),
    };
    function.name = ObjectName(vec![ObjectNamePart::Identifier(name.clone())]);
    prepend(function, expr);
}

fn prepend(function: &mut Function, expr: Expr) {
    if let FunctionArguments::List(list) = &mut function.args {
        list.args.insert(0, FunctionArg::Unnamed(FunctionArgExpr::Expr(expr)));
    }
}

// `list[2:]` and `list[:2]` have both ends; which ones those of a stride are depends on its sign.
fn close_slice(access: &mut AccessExpr) {
    if let AccessExpr::Subscript(Subscript::Slice { lower_bound, upper_bound, stride: None }) = access {
        lower_bound.get_or_insert_with(|| tree::number(1));
        upper_bound.get_or_insert_with(|| tree::number(-1));
    }
}

// Returns what replaces a call as a whole; None if it stays a call.
fn rewrite_function(function: &mut Function, budget: &mut RewriteBudget) -> Result<Option<Expr>, Error> {
    let Some(name) = tree::plain_name(&function.name) else { return Ok(None) };
    if let Some((_, known)) = OTHER_NAMES.into_iter().find(|(other, _)| *other == name) {
        function.name = ObjectName::from(vec![Ident::new(known)]);
        return Ok(None);
    }
    let extreme = ARGUMENT_AT_EXTREME.into_iter().find(|(known, _)| *known == name);
    if extreme.is_none() && !["max", "min", "if", "count_if", "struct_pack"].contains(&name.as_str()) {
        return Ok(None);
    }
    if name == "struct_pack" {
        name_fields(function);
        return Ok(None);
    }
    let Some(arguments) = arguments(function) else { return Ok(None) };
    let is_ordered = extreme.is_some() || (["max", "min"].contains(&name.as_str()) && arguments.len() == 2);
    if is_ordered && function.over.is_some() {
        let hint =
            "first_value(x) OVER (PARTITION BY p ORDER BY y DESC), or QUALIFY row_number() OVER (...) <= n".into();
        return Err(refused(format!("`{name}` of two values has no OVER"), hint));
    }
    if is_ordered {
        budget.take_copies(&Expr::Function(function.clone()), 2)?;
    }
    Ok(match (name.as_str(), extreme, arguments.as_slice()) {
        (_, Some((_, is_greatest)), [of, by]) => {
            order(function, "first_value", of, by, is_greatest);
            None
        }
        (_, Some((_, is_greatest)), [of, by, most]) => Some(first_of(function, of, by, is_greatest, most)),
        ("max", _, [of, most]) => Some(first_of(function, of, of, true, most)),
        ("min", _, [of, most]) => Some(first_of(function, of, of, false, most)),
        ("if", _, [condition, then, otherwise]) => Some(case(condition, then, Some(otherwise))),
        ("count_if", _, [condition]) => {
            let counted = case(condition, &tree::number(1), None);
            set_arguments(function, "count", counted);
            None
        }
        _ => None,
    })
}

// `struct_pack(x := 1)` becomes `named_struct('x', 1)`.
fn name_fields(function: &mut Function) {
    let FunctionArguments::List(list) = &mut function.args else { return };
    let is_named = |argument: &FunctionArg| matches!(argument, FunctionArg::Named { .. });
    if !list.args.iter().all(is_named) {
        return;
    }
    let mut args = Vec::with_capacity(2 * list.args.len());
    for argument in list.args.drain(..) {
        if let FunctionArg::Named { name, arg, .. } = argument {
            args.push(FunctionArg::Unnamed(FunctionArgExpr::Expr(tree::text(&tree::normalized(&name)))));
            args.push(FunctionArg::Unnamed(arg));
        }
    }
    list.args = args;
    function.name = ObjectName::from(vec![Ident::new("named_struct")]);
}

fn case(condition: &Expr, then: &Expr, otherwise: Option<&Expr>) -> Expr {
    Expr::Case {
        case_token: AttachedToken::empty(),
        end_token: AttachedToken::empty(),
        operand: None,
        conditions: vec![CaseWhen { condition: condition.clone(), result: then.clone() }],
        else_result: otherwise.cloned().map(Box::new),
    }
}

fn arguments(function: &Function) -> Option<Vec<Expr>> {
    let FunctionArguments::List(list) = &function.args else { return None };
    let expr = |argument: &FunctionArg| match argument {
        FunctionArg::Unnamed(FunctionArgExpr::Expr(expr)) => Some(expr.clone()),
        _ => None,
    };
    list.args.iter().map(expr).collect()
}

fn set_arguments(function: &mut Function, name: &str, argument: Expr) {
    function.name = ObjectName::from(vec![Ident::new(name)]);
    if let FunctionArguments::List(list) = &mut function.args {
        list.args = vec![FunctionArg::Unnamed(FunctionArgExpr::Expr(argument))];
    }
}

// `max(x, 3)` becomes a slice of `array_agg(x ORDER BY x DESC)`.
fn first_of(function: &mut Function, of: &Expr, by: &Expr, is_greatest: bool, most: &Expr) -> Expr {
    order(function, "array_agg", of, by, is_greatest);
    tree::call("array_slice", [Expr::Function(function.clone()), tree::number(1), most.clone()])
}

// `arg_max(x, y)` becomes `first_value(x ORDER BY y DESC) FILTER (WHERE x IS NOT NULL AND y IS NOT NULL)`.
fn order(function: &mut Function, name: &str, of: &Expr, by: &Expr, is_greatest: bool) {
    set_arguments(function, name, of.clone());
    let options = OrderByOptions { asc: Some(!is_greatest), nulls_first: Some(false) };
    if let FunctionArguments::List(list) = &mut function.args {
        let order = vec![OrderByExpr { expr: by.clone(), options, with_fill: None }];
        list.clauses.push(FunctionArgumentClause::OrderBy(order));
    }
    let is_there = |expr: &Expr| Expr::IsNotNull(Box::new(Expr::Nested(Box::new(expr.clone()))));
    let are_there = if of == by { is_there(by) } else { tree::and(is_there(of), is_there(by)) };
    function.filter = Some(Box::new(match function.filter.take() {
        Some(filter) => tree::and(*filter, are_there),
        None => are_there,
    }));
}
