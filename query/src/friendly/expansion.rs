//! The walk over a statement's queries, innermost first, that writes out what depends on the columns of their tables.

use std::collections::VecDeque;
use std::ops::ControlFlow;

use datafusion::common::DFSchema;
use datafusion::execution::session_state::SessionState;
use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::helpers::attached_token::AttachedToken;
use datafusion::sql::sqlparser::ast::{
    Cte, Expr, ExprWithAlias, OrderBy, OrderByExpr, OrderByKind, PivotValueSource, Query, Select, SelectItem, SetExpr,
    Statement as Sql, TableAlias, TableFactor, TableWithJoins, Values, VisitorMut, WildcardAdditionalOptions, With,
};
use futures::FutureExt as _;
use futures::future::BoxFuture;

use super::budget::RewriteBudget;
use super::columns::{self, ChosenColumn, SourceColumns, refused};
use super::select_items::{self, SelectExpansion};
use super::{aliases, pivot, tree};
use crate::Error;
use crate::syntax_walk::walk_mut;

/// Writes out `COLUMNS`, `RENAME`, `PIVOT`, `UNPIVOT`, fields of structs and aliases that are used again.
///
/// # Errors
/// [`Error::Query`] if they name what is not there, or would become too long.
pub(crate) async fn expand(statement: &mut Statement, state: &SessionState, sql: &str) -> Result<(), Error> {
    let Some(query) = query_of(statement) else { return Ok(()) };
    let mut expansion = Expansion { state, sql, budget: RewriteBudget::new(), ctes: Vec::new(), is_recursive: false };
    expansion.expand_query(query, QueryPosition::Table).await
}

fn query_of(statement: &mut Statement) -> Option<&mut Query> {
    match statement {
        Statement::Statement(sql) => query_of_sql(sql),
        Statement::Explain(explain) => query_of(&mut explain.statement),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => None,
    }
}

fn query_of_sql(sql: &mut Sql) -> Option<&mut Query> {
    match sql {
        Sql::Query(query) => Some(query),
        Sql::Explain { statement, .. } => query_of_sql(statement),
        _ => None,
    }
}

/// Place of a query: as a table its names are its own tables', in an expression those around as well.
#[derive(Clone, Copy, PartialEq, Eq)]
enum QueryPosition {
    Table,
    Expression,
}

struct Expansion<'a> {
    state: &'a SessionState,
    sql: &'a str,
    budget: RewriteBudget,
    /// WITH of the queries around.
    ctes: Vec<Cte>,
    is_recursive: bool,
}

impl Expansion<'_> {
    fn expand_query<'b>(
        &'b mut self,
        query: &'b mut Query,
        position: QueryPosition,
    ) -> BoxFuture<'b, Result<(), Error>> {
        async move {
            let outer = self.ctes.len();
            if let Some(with) = &mut query.with {
                self.is_recursive |= with.recursive;
                for cte in &mut with.cte_tables {
                    self.expand_query(&mut cte.query, position).await?;
                    self.ctes.push(cte.clone());
                }
            }
            let mut bodies = vec![&mut *query.body];
            while let Some(body) = bodies.pop() {
                match body {
                    SetExpr::Select(select) => self.expand_select(select, position).await?,
                    SetExpr::Query(query) => self.expand_query(query, position).await?,
                    SetExpr::SetOperation { left, right, .. } => bodies.extend([&mut **left, &mut **right]),
                    _ => {}
                }
            }
            self.ctes.truncate(outer);
            order_by_all(query);
            Ok(())
        }
        .boxed()
    }

    async fn expand_select(&mut self, select: &mut Select, position: QueryPosition) -> Result<(), Error> {
        for from in &mut select.from {
            self.expand_tables(from).await?;
        }
        let mut inner = SubqueryVisitor::detach(select);
        for query in &mut inner {
            self.expand_query(query, QueryPosition::Expression).await?;
        }
        SubqueryVisitor::attach(select, inner);
        if select_items::is_expandable(select) {
            let source = self.look_up(&select.from).await?;
            let (state, budget) = (self.state, &mut self.budget);
            SelectExpansion { source: &source, state, budget, sql: self.sql }.expand(select)?;
        }
        if position == QueryPosition::Table && aliases::are_reused(select) {
            // Tables that cannot be planned have an error of their own later.
            if let Ok(source) = self.look_up(&select.from).await {
                aliases::write_out(select, &source, self.state, &mut self.budget)?;
            }
        }
        Ok(())
    }

    fn expand_tables<'b>(&'b mut self, tables: &'b mut TableWithJoins) -> BoxFuture<'b, Result<(), Error>> {
        async move {
            self.expand_factor(&mut tables.relation).await?;
            for join in &mut tables.joins {
                self.expand_factor(&mut join.relation).await?;
            }
            Ok(())
        }
        .boxed()
    }

    fn expand_factor<'b>(&'b mut self, factor: &'b mut TableFactor) -> BoxFuture<'b, Result<(), Error>> {
        async move {
            match factor {
                TableFactor::Derived { lateral: true, subquery, .. } => {
                    self.expand_query(subquery, QueryPosition::Expression).await
                }
                TableFactor::Derived { subquery, .. } => self.expand_query(subquery, QueryPosition::Table).await,
                TableFactor::NestedJoin { table_with_joins, .. } => self.expand_tables(table_with_joins).await,
                TableFactor::Pivot { table, .. } | TableFactor::Unpivot { table, .. } => {
                    self.expand_factor(table).await?;
                    let from = tree::from(TableFactor::clone(table));
                    let source = self.look_up(&from).await?;
                    self.write_out_pivot(factor, &source, from)
                }
                _ => Ok(()),
            }
        }
        .boxed()
    }

    fn write_out_pivot(
        &mut self,
        factor: &mut TableFactor,
        source: &SourceColumns,
        from: Vec<TableWithJoins>,
    ) -> Result<(), Error> {
        let (select, alias) = match factor {
            TableFactor::Pivot { aggregate_functions, value_column, value_source, default_on_null, alias, .. } => {
                let ([column], PivotValueSource::List(values), None) =
                    (value_column.as_slice(), value_source, default_on_null)
                else {
                    let message = "PIVOT takes one column and its listed values".to_owned();
                    return Err(refused(message, "PIVOT (sum(x) FOR c IN ('a', 'b'))".to_owned()));
                };
                let groups = pivot::groups(source, aggregate_functions, column);
                let budget = &mut self.budget;
                (pivot::pivoted(groups, aggregate_functions, column, values, from, budget)?, alias.take())
            }
            TableFactor::Unpivot { value, name, columns, null_inclusion, alias, .. } => {
                let Expr::Identifier(value) = value else {
                    let message = format!("`{value}` of an UNPIVOT is no name");
                    return Err(refused(message, "UNPIVOT (value FOR name IN (a, b))".to_owned()));
                };
                let columns = self.unpivoted_columns(columns, source)?;
                (pivot::unpivoted(source, &columns, name, value, null_inclusion.as_ref(), from), alias.take())
            }
            _ => return Ok(()),
        };
        *factor = derived(tree::query(select), alias);
        Ok(())
    }

    fn unpivoted_columns(
        &mut self,
        columns: &[ExprWithAlias],
        source: &SourceColumns,
    ) -> Result<Vec<ChosenColumn>, Error> {
        let mut chosen = Vec::new();
        for ExprWithAlias { expr, alias } in columns {
            let name = match expr {
                Expr::Function(function) if columns::is_columns(function) => {
                    let columns = source.chosen(function, self.state, &mut self.budget);
                    chosen.extend(columns.map_err(|error| error.at(self.sql, columns::place(function)))?);
                    continue;
                }
                Expr::Identifier(name) => name,
                Expr::CompoundIdentifier(names) if !names.is_empty() => &names[names.len() - 1],
                other => {
                    let hint = "UNPIVOT t ON a, b or ON COLUMNS('x.*')".to_owned();
                    return Err(refused(format!("`{other}` of an UNPIVOT is no column"), hint));
                }
            };
            let name = tree::normalized(name);
            let label = alias.as_ref().map_or_else(|| name.clone(), tree::normalized);
            chosen.push(ChosenColumn { source: name, name: label, expr: expr.clone(), groups: Vec::new() });
        }
        Ok(chosen)
    }

    // The planner tells the columns of FROM.
    async fn look_up(&mut self, from: &[TableWithJoins]) -> Result<SourceColumns, Error> {
        if from.is_empty() {
            return Ok(SourceColumns::of(&DFSchema::empty()));
        }
        self.budget.take_lookup()?;
        let all = SelectItem::Wildcard(WildcardAdditionalOptions::default());
        let mut query = tree::query(tree::select(vec![all], from.to_vec()));
        if !self.ctes.is_empty() {
            let with_token = AttachedToken::empty();
            query.with = Some(With { with_token, recursive: self.is_recursive, cte_tables: self.last_ctes() });
        }
        let statement = Statement::Statement(Box::new(Sql::Query(Box::new(query))));
        let plan = self.state.statement_to_plan(statement).await.map_err(|e| Error::plan(self.sql, &e))?;
        Ok(SourceColumns::of(plan.schema()))
    }

    // Of several of one name the innermost is meant, and a WITH names each once.
    fn last_ctes(&self) -> Vec<Cte> {
        let name = |cte: &Cte| tree::normalized(&cte.alias.name);
        let is_last = |(at, cte): &(usize, &Cte)| self.ctes[at + 1..].iter().all(|later| name(later) != name(cte));
        self.ctes.iter().enumerate().filter(is_last).map(|(_, cte)| cte.clone()).collect()
    }
}

// `ORDER BY ALL` becomes `ORDER BY 1, 2, ...`; the planner takes it for columns only.
fn order_by_all(query: &mut Query) {
    let Some(OrderBy { kind, .. }) = &mut query.order_by else { return };
    let (OrderByKind::All(options), SetExpr::Select(select)) = (&*kind, &*query.body) else { return };
    let is_one = |item: &SelectItem| matches!(item, SelectItem::UnnamedExpr(_) | SelectItem::ExprWithAlias { .. });
    if !select.projection.iter().all(is_one) {
        return;
    }
    let by = |column| OrderByExpr { expr: tree::number(column), options: *options, with_fill: None };
    let columns = i64::try_from(select.projection.len()).unwrap_or(0);
    *kind = OrderByKind::Expressions((1..=columns).map(by).collect());
}

fn derived(query: Query, alias: Option<TableAlias>) -> TableFactor {
    TableFactor::Derived { lateral: false, subquery: Box::new(query), alias, sample: None }
}

/// Takes the subqueries out of a select's expressions, and puts them back.
enum SubqueryVisitor {
    Detach(Vec<Query>),
    Attach(VecDeque<Query>),
}

impl SubqueryVisitor {
    fn detach(select: &mut Select) -> Vec<Query> {
        let mut visitor = Self::Detach(Vec::new());
        visitor.walk(select);
        match visitor {
            Self::Detach(queries) => queries,
            Self::Attach(_) => Vec::new(),
        }
    }

    fn attach(select: &mut Select, queries: Vec<Query>) {
        Self::Attach(queries.into()).walk(select);
    }

    fn walk(&mut self, select: &mut Select) {
        for item in &mut select.projection {
            let ControlFlow::<()>::Continue(()) = walk_mut(item, self) else { return };
        }
        for condition in [&mut select.selection, &mut select.having, &mut select.qualify].into_iter().flatten() {
            let ControlFlow::<()>::Continue(()) = walk_mut(condition, self) else { return };
        }
    }
}

impl VisitorMut for SubqueryVisitor {
    type Break = ();

    fn pre_visit_query(&mut self, query: &mut Query) -> ControlFlow<()> {
        if let Self::Detach(queries) = self {
            queries.push(std::mem::replace(query, nothing()));
        }
        ControlFlow::Continue(())
    }

    // After its parts, so that what is put back is not visited.
    fn post_visit_query(&mut self, query: &mut Query) -> ControlFlow<()> {
        if let Self::Attach(queries) = self
            && let Some(expanded) = queries.pop_front()
        {
            *query = expanded;
        }
        ControlFlow::Continue(())
    }
}

fn nothing() -> Query {
    let mut query = tree::query(tree::select(Vec::new(), Vec::new()));
    query.body = Box::new(SetExpr::Values(Values { explicit_row: false, value_keyword: false, rows: Vec::new() }));
    query
}
