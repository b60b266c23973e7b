//! Aliases of a select list that later items and WHERE use again: `SELECT x / 2 AS y, y + 1 AS z WHERE y > 3`.
//!
//! A column of that name goes first, as elsewhere in SQL.

use std::collections::{HashMap, HashSet};
use std::ops::ControlFlow;

use datafusion::execution::session_state::SessionState;
use datafusion::logical_expr::Volatility;
use datafusion::sql::sqlparser::ast::{
    Expr, LambdaFunction, OneOrManyWithParens, Query, Select, SelectItem, Visitor, VisitorMut,
};

use super::budget::RewriteBudget;
use super::columns::{SourceColumns, refused};
use super::tree;
use crate::Error;
use crate::syntax_walk::{walk, walk_mut};

/// Maximum length of a chain of aliases of aliases.
const MOST_CHAINED: usize = 30;

/// Returns whether an alias of the select list is the name of something in a later item or in WHERE.
pub(super) fn are_reused(select: &Select) -> bool {
    let mut aliases = HashSet::new();
    for item in &select.projection {
        if let Some(expr) = expr_of(item)
            && !names(expr).is_disjoint(&aliases)
        {
            return true;
        }
        if let SelectItem::ExprWithAlias { alias, .. } = item {
            aliases.insert(tree::normalized(alias));
        }
    }
    select.selection.as_ref().is_some_and(|selection| !names(selection).is_disjoint(&aliases))
}

/// Writes out the aliases that are used again.
///
/// # Errors
/// [`Error::Query`] if an alias has another value each time, or the query would become too long.
pub(super) fn write_out(
    select: &mut Select,
    source: &SourceColumns,
    state: &SessionState,
    budget: &mut RewriteBudget,
) -> Result<(), Error> {
    let mut known: HashMap<String, KnownAlias> = HashMap::new();
    for item in &mut select.projection {
        let mut chained = 0;
        if let SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. } = item {
            chained = substitute(expr, &known, budget)?;
        }
        if let SelectItem::ExprWithAlias { expr, alias } = item {
            let name = tree::normalized(alias);
            if !source.has(&name) {
                let is_volatile = is_volatile(expr, state);
                known.insert(name, KnownAlias { expr: expr.clone(), chained: chained + 1, is_volatile });
            }
        }
    }
    if let Some(selection) = &mut select.selection {
        substitute(selection, &known, budget)?;
    }
    Ok(())
}

struct KnownAlias {
    expr: Expr,
    chained: usize,
    is_volatile: bool,
}

fn substitute(
    expr: &mut Expr,
    known: &HashMap<String, KnownAlias>,
    budget: &mut RewriteBudget,
) -> Result<usize, Error> {
    let mut visitor = AliasVisitor { known, budget, chained: 0, queries: 0, shadows: Vec::new() };
    match walk_mut(expr, &mut visitor) {
        ControlFlow::Continue(()) => Ok(visitor.chained),
        ControlFlow::Break(error) => Err(*error),
    }
}

fn expr_of(item: &SelectItem) -> Option<&Expr> {
    match item {
        SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. } => Some(expr),
        _ => None,
    }
}

fn names(expr: &Expr) -> HashSet<String> {
    let mut found = BareNameVisitor::default();
    let ControlFlow::<()>::Continue(()) = walk(expr, &mut found) else { return HashSet::new() };
    found.0
}

fn is_volatile(expr: &Expr, state: &SessionState) -> bool {
    walk(expr, &mut VolatileVisitor(state)).is_break()
}

#[derive(Default)]
struct BareNameVisitor(HashSet<String>);

impl Visitor for BareNameVisitor {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &Expr) -> ControlFlow<()> {
        if let Expr::Identifier(name) = expr {
            self.0.insert(tree::normalized(name));
        }
        ControlFlow::Continue(())
    }
}

struct VolatileVisitor<'a>(&'a SessionState);

impl Visitor for VolatileVisitor<'_> {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &Expr) -> ControlFlow<()> {
        let Expr::Function(function) = expr else { return ControlFlow::Continue(()) };
        let known = tree::plain_name(&function.name).and_then(|name| self.0.scalar_functions().get(&name));
        match known.map(|function| function.signature().volatility) {
            Some(Volatility::Volatile) => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        }
    }
}

struct AliasVisitor<'a> {
    known: &'a HashMap<String, KnownAlias>,
    budget: &'a mut RewriteBudget,
    chained: usize,
    /// Number of subqueries around; their names are their own.
    queries: usize,
    /// Parameters of the lambdas around.
    shadows: Vec<Vec<String>>,
}

impl VisitorMut for AliasVisitor<'_> {
    type Break = Box<Error>;

    fn pre_visit_query(&mut self, _: &mut Query) -> ControlFlow<Box<Error>> {
        self.queries += 1;
        ControlFlow::Continue(())
    }

    fn post_visit_query(&mut self, _: &mut Query) -> ControlFlow<Box<Error>> {
        self.queries -= 1;
        ControlFlow::Continue(())
    }

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<Box<Error>> {
        if let Expr::Lambda(lambda) = expr {
            self.shadows.push(parameters(lambda));
        }
        ControlFlow::Continue(())
    }

    // After its parts, so that what is written here is not visited again.
    fn post_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<Box<Error>> {
        if let Expr::Lambda(_) = expr {
            self.shadows.pop();
        }
        let Expr::Identifier(name) = expr else { return ControlFlow::Continue(()) };
        let name = tree::normalized(name);
        if self.queries > 0 || self.shadows.iter().flatten().any(|shadow| *shadow == name) {
            return ControlFlow::Continue(());
        }
        let Some(alias) = self.known.get(&name) else { return ControlFlow::Continue(()) };
        match self.take(&name, alias) {
            Ok(written) => *expr = written,
            Err(error) => return ControlFlow::Break(Box::new(error)),
        }
        ControlFlow::Continue(())
    }
}

impl AliasVisitor<'_> {
    fn take(&mut self, name: &str, alias: &KnownAlias) -> Result<Expr, Error> {
        if alias.is_volatile {
            let hint = format!("compute `{name}` in a subquery: FROM (SELECT ... AS {name})");
            return Err(refused(format!("`{name}` would have another value each time it is used"), hint));
        }
        if alias.chained > MOST_CHAINED {
            let hint = "WITH gives a name to what stands inside".to_owned();
            return Err(refused(format!("more than {MOST_CHAINED} aliases of aliases"), hint));
        }
        self.budget.take_copies(&alias.expr, 1)?;
        self.chained = self.chained.max(alias.chained);
        Ok(Expr::Nested(Box::new(alias.expr.clone())))
    }
}

fn parameters(lambda: &LambdaFunction) -> Vec<String> {
    match &lambda.params {
        OneOrManyWithParens::One(one) => vec![tree::normalized(&one.name)],
        OneOrManyWithParens::Many(many) => many.iter().map(|one| tree::normalized(&one.name)).collect(),
    }
}
