//! Rewrites syntax that DataFusion parses and does not plan into syntax that it plans.

use std::ops::ControlFlow;

use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::{
    Expr, Fetch, Function, FunctionArg, FunctionArgExpr, FunctionArgumentClause, FunctionArguments, Ident, LimitClause,
    ObjectName, OrderByExpr, OrderByOptions, Query, Select, SelectFlavor, SelectItem, Value, ValueWithSpan,
    VisitMut as _, VisitorMut, WildcardAdditionalOptions,
};

/// Aggregates that take the first argument at the greatest (true) or least value of the second.
const ARGUMENT_AT_EXTREME: [(&str, bool); 6] =
    [("arg_max", true), ("argmax", true), ("max_by", true), ("arg_min", false), ("argmin", false), ("min_by", false)];

/// Rewrites in place: `FROM t` alone, `FETCH FIRST n ROWS ONLY`, `10_000`, `arg_max` and its relatives.
pub(crate) fn rewrite(statement: &mut Statement) {
    match statement {
        Statement::Statement(sql) => {
            let ControlFlow::<()>::Continue(()) = sql.visit(&mut FriendlyVisitor) else { return };
        }
        Statement::Explain(explain) => rewrite(&mut explain.statement),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => {}
    }
}

struct FriendlyVisitor;

impl VisitorMut for FriendlyVisitor {
    type Break = ();

    fn pre_visit_query(&mut self, query: &mut Query) -> ControlFlow<()> {
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

    fn pre_visit_select(&mut self, select: &mut Select) -> ControlFlow<()> {
        if select.flavor == SelectFlavor::FromFirstNoSelect {
            select.flavor = SelectFlavor::Standard;
            select.projection = vec![SelectItem::Wildcard(WildcardAdditionalOptions::default())];
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_value(&mut self, value: &mut ValueWithSpan) -> ControlFlow<()> {
        if let Value::Number(digits, _) = &mut value.value {
            digits.retain(|c| c != '_');
        }
        ControlFlow::Continue(())
    }

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Expr::Function(function) = expr {
            rewrite_argument_at_extreme(function);
        }
        ControlFlow::Continue(())
    }
}

// `arg_max(x, y)` becomes `first_value(x ORDER BY y DESC) FILTER (WHERE y IS NOT NULL)`.
fn rewrite_argument_at_extreme(function: &mut Function) {
    let name = function.name.to_string().to_lowercase();
    let Some((_, is_greatest)) = ARGUMENT_AT_EXTREME.into_iter().find(|(known, _)| *known == name) else { return };
    let FunctionArguments::List(list) = &mut function.args else { return };
    let [FunctionArg::Unnamed(FunctionArgExpr::Expr(_)), FunctionArg::Unnamed(FunctionArgExpr::Expr(by))] =
        list.args.as_slice()
    else {
        return;
    };
    let by = by.clone();
    list.args.truncate(1);
    let options = OrderByOptions { asc: Some(!is_greatest), nulls_first: Some(false) };
    list.clauses.push(FunctionArgumentClause::OrderBy(vec![OrderByExpr {
        expr: by.clone(),
        options,
        with_fill: None,
    }]));
    let has_value = Expr::IsNotNull(Box::new(by));
    function.filter = Some(Box::new(match function.filter.take() {
        Some(filter) => Expr::BinaryOp {
            left: Box::new(Expr::Nested(filter)),
            op: datafusion::sql::sqlparser::ast::BinaryOperator::And,
            right: Box::new(has_value),
        },
        None => has_value,
    }));
    function.name = ObjectName::from(vec![Ident::new("first_value")]);
}
