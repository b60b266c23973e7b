//! Refuses a statement whose plan is huge, or is made in a time that grows with the square of its lists: names of a WITH
//! that stand for each other are planned again wherever they stand, CUBE makes each subset of its columns a grouping set,
//! and each column, window and key of an order is compared with all others.

use std::collections::{HashMap, HashSet};
use std::ops::ControlFlow;

use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::{
    Expr, GroupByExpr, GroupByWithModifier, ObjectNamePart, OrderByKind, Query, Select, TableFactor, Visitor,
    WindowType,
};

use super::columns::hinted_error;
use super::syntax_walk::walk_syntax;
use super::tree::normalized_name;
use crate::Error;

/// Maximum number of tables of a query, with those behind the names of its WITH.
const MOST_TABLES: u64 = 2_000;
/// Maximum number of grouping sets of one SELECT.
const MOST_GROUPINGS: u64 = 4_096;
/// Maximum number of columns in grouping sets: DataFusion has no more, and finds that out after it has planned them.
const MOST_GROUPED: usize = 64;
/// Maximum number of expressions of one SELECT; four thousand take a second.
const MOST_COLUMNS: usize = 4_096;
/// Maximum number of keys of one ORDER BY.
const MOST_KEYS: usize = 1_000;
/// Maximum number of windows of one statement that are written in different ways.
const MOST_WINDOWS: usize = 200;

/// Accepts statements whose plans are not much larger than they are.
///
/// # Errors
/// [`Error::Query`] with the exceeded limit for all others.
pub(super) fn check_expansion(statement: &Statement) -> Result<(), Error> {
    match statement {
        Statement::Statement(parsed) => match walk_syntax(parsed.as_ref(), &mut ExpansionVisitor::default()) {
            ControlFlow::Break(error) => Err(error),
            ControlFlow::Continue(()) => Ok(()),
        },
        Statement::Explain(explain) => check_expansion(&explain.statement),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => Ok(()),
    }
}

/// Counts the tables of queries, from the inner ones to the outer ones.
#[derive(Default)]
struct ExpansionVisitor {
    /// The queries that are open.
    open: Vec<OpenQuery>,
    /// Names of WITHs that are known here, the newest last, and how many tables each stands for.
    known: Vec<(String, u64)>,
    /// Names of queries of a WITH, by the addresses of the queries.
    named: HashMap<*const Query, String>,
    /// Windows as they are written.
    windows: HashSet<String>,
}

struct OpenQuery {
    tables: u64,
    /// Names that were known before it.
    known: usize,
}

impl ExpansionVisitor {
    fn add_tables(&mut self, tables: u64) -> ControlFlow<Error> {
        let Some(query) = self.open.last_mut() else { return ControlFlow::Continue(()) };
        query.tables = query.tables.saturating_add(tables);
        if query.tables <= MOST_TABLES {
            return ControlFlow::Continue(());
        }
        let message =
            format!("the query has more than {MOST_TABLES} tables, once each name of a WITH is what it stands for");
        ControlFlow::Break(hinted_error(message, "name it once, and join fewer of them"))
    }
}

impl Visitor for ExpansionVisitor {
    type Break = Error;

    fn pre_visit_query(&mut self, query: &Query) -> ControlFlow<Error> {
        self.open.push(OpenQuery { tables: 0, known: self.known.len() });
        if let Some(OrderByKind::Expressions(keys)) = query.order_by.as_ref().map(|order| &order.kind)
            && keys.len() > MOST_KEYS
        {
            return refuse_keys();
        }
        for part in query.with.iter().flat_map(|with| &with.cte_tables) {
            self.named.insert(&raw const *part.query, normalized_name(&part.alias.name));
        }
        ControlFlow::Continue(())
    }

    fn post_visit_query(&mut self, query: &Query) -> ControlFlow<Error> {
        let Some(closed) = self.open.pop() else { return ControlFlow::Continue(()) };
        self.known.truncate(closed.known);
        match self.named.remove(&(&raw const *query)) {
            Some(name) => {
                self.known.push((name, closed.tables));
                ControlFlow::Continue(())
            }
            None => self.add_tables(closed.tables),
        }
    }

    fn pre_visit_table_factor(&mut self, factor: &TableFactor) -> ControlFlow<Error> {
        let TableFactor::Table { name, .. } = factor else { return ControlFlow::Continue(()) };
        let known = match name.0.as_slice() {
            [ObjectNamePart::Identifier(name)] => {
                let name = normalized_name(name);
                self.known.iter().rev().find(|known| known.0 == name).map(|known| known.1)
            }
            _ => None,
        };
        self.add_tables(known.unwrap_or(1).max(1))
    }

    fn pre_visit_select(&mut self, select: &Select) -> ControlFlow<Error> {
        if select.projection.len() > MOST_COLUMNS {
            return ControlFlow::Break(hinted_error(
                format!("SELECT has more than {MOST_COLUMNS} columns"),
                "a row for each of them, by a join with VALUES, or several queries",
            ));
        }
        if count_grouped(&select.group_by) > MOST_GROUPED {
            return ControlFlow::Break(hinted_error(
                format!("grouping sets have more than {MOST_GROUPED} columns"),
                "a GROUP BY for each set, and UNION ALL",
            ));
        }
        match count_groupings(&select.group_by) <= MOST_GROUPINGS {
            true => ControlFlow::Continue(()),
            false => ControlFlow::Break(hinted_error(
                format!("GROUP BY has more than {MOST_GROUPINGS} grouping sets"),
                "GROUPING SETS names those that are needed",
            )),
        }
    }

    fn pre_visit_expr(&mut self, expr: &Expr) -> ControlFlow<Error> {
        let Expr::Function(call) = expr else { return ControlFlow::Continue(()) };
        let Some(window) = &call.over else { return ControlFlow::Continue(()) };
        if let WindowType::WindowSpec(window) = window
            && window.order_by.len() > MOST_KEYS
        {
            return refuse_keys();
        }
        self.windows.insert(window.to_string());
        match self.windows.len() <= MOST_WINDOWS {
            true => ControlFlow::Continue(()),
            false => ControlFlow::Break(hinted_error(
                format!("the query has more than {MOST_WINDOWS} different windows"),
                "several queries with fewer of them",
            )),
        }
    }
}

fn refuse_keys() -> ControlFlow<Error> {
    let message = format!("ORDER BY has more than {MOST_KEYS} keys");
    ControlFlow::Break(hinted_error(message, "an order by one expression of them"))
}

// Counts the expressions in grouping sets, each once; 0 without such sets.
fn count_grouped(group_by: &GroupByExpr) -> usize {
    let (keys, modifiers) = grouping_parts(group_by);
    let mut grouped = HashSet::new();
    let mut has_sets = !modifiers.is_empty();
    for key in keys {
        match key {
            Expr::Cube(sets) | Expr::Rollup(sets) | Expr::GroupingSets(sets) => {
                has_sets = true;
                grouped.extend(sets.iter().flatten().map(ToString::to_string));
            }
            key => {
                grouped.insert(key.to_string());
            }
        }
    }
    if has_sets { grouped.len() } else { 0 }
}

fn grouping_parts(group_by: &GroupByExpr) -> (&[Expr], &[GroupByWithModifier]) {
    match group_by {
        GroupByExpr::Expressions(keys, modifiers) => (keys, modifiers),
        GroupByExpr::All(modifiers) => (&[], modifiers),
    }
}

fn count_groupings(group_by: &GroupByExpr) -> u64 {
    let (keys, modifiers) = grouping_parts(group_by);
    let of_key = |key: &Expr| match key {
        Expr::Cube(columns) => count_subsets(columns.len()),
        Expr::Rollup(columns) => columns.len() as u64 + 1,
        Expr::GroupingSets(sets) => sets.len() as u64,
        _ => 1,
    };
    let of_modifier = |modifier: &GroupByWithModifier| match modifier {
        GroupByWithModifier::Cube => count_subsets(keys.len()),
        GroupByWithModifier::Rollup => keys.len() as u64 + 1,
        _ => 1,
    };
    let counts = keys.iter().map(of_key).chain(modifiers.iter().map(of_modifier));
    counts.fold(1, u64::saturating_mul)
}

fn count_subsets(columns: usize) -> u64 {
    u32::try_from(columns).ok().and_then(|columns| 1u64.checked_shl(columns)).unwrap_or(u64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::statement::parse_statement;

    fn refusal(sql: &str) -> Option<String> {
        let statement = parse_statement(sql, 128).unwrap_or_else(|e| panic!("{sql}: {e}"));
        check_expansion(&statement).err().map(|e| e.to_string())
    }

    // Each step joins the one before with itself.
    fn double(levels: usize) -> String {
        let mut steps = vec!["t0 as (select 1 a)".to_owned()];
        steps.extend((1..=levels).map(|n| format!("T{n} as (select x.a from t{0} x, (select * from t{0}) y)", n - 1)));
        format!("with {} select count(*) from t{levels}", steps.join(", "))
    }

    #[test]
    fn names_that_stand_for_each_other_are_counted() {
        assert_eq!(refusal(&double(10)), None);
        for levels in [11, 22, 80] {
            assert!(refusal(&double(levels)).is_some_and(|text| text.contains("more than 2000 tables")), "{levels}");
        }
        assert!(refusal(&format!("explain {}", double(22))).is_some());
        // One after the other they are few, and a name of an inner WITH ends with it.
        let steps: Vec<_> = (1..=300).map(|n| format!("t{n} as (select a from t{})", n - 1)).collect();
        assert_eq!(refusal(&format!("with t0 as (select 1 a), {} select a from t300", steps.join(", "))), None);
        assert_eq!(refusal(&format!("select * from ({}) x, t10", double(10))), None);
    }

    #[test]
    fn grouping_sets_are_counted() {
        let columns = |count| (0..count).map(|n| format!("c{n}")).collect::<Vec<_>>().join(", ");
        for (group, passes) in [
            (format!("cube({})", columns(12)), true),
            (format!("cube({})", columns(13)), false),
            (format!("cube({})", columns(200)), false),
            (format!("cube({0}), cube({0})", columns(7)), false),
            (format!("rollup({})", columns(64)), true),
            (format!("rollup({})", columns(65)), false),
            (format!("rollup({0}), rollup({0}), rollup({0})", columns(16)), false),
            (format!("grouping sets (({}), (c70))", columns(64)), false),
            ("grouping sets ((c0), (c1), ())".to_owned(), true),
            (columns(3_000), true),
        ] {
            let sql = format!("select count(*) from t group by {group}");
            assert_eq!(refusal(&sql).is_none(), passes, "{sql}");
        }
    }

    #[test]
    fn long_lists_are_counted_where_their_square_costs() {
        let list = |count: usize, part: &str| {
            (0..count).map(|n| part.replace('#', &n.to_string())).collect::<Vec<_>>().join(", ")
        };
        for (sql, limit) in [
            (format!("select {} from t", list(4_096, "a + # as c#")), None),
            (format!("select {} from t", list(4_097, "a + # as c#")), Some("4096 columns")),
            (format!("select * from (select {} from t)", list(4_097, "a")), Some("4096 columns")),
            (format!("select a from t order by {}", list(1_000, "a + #")), None),
            (format!("select a from t order by {}", list(1_001, "a + #")), Some("1000 keys")),
            (format!("select sum(a) over (order by {}) from t", list(1_001, "a + #")), Some("1000 keys")),
            (format!("select {} from t", list(200, "sum(a) over (order by b + #)")), None),
            (format!("select {} from t", list(201, "sum(a) over (order by b + #)")), Some("200 different windows")),
            (format!("select {} from t", list(4_000, "sum(a + #) over (order by b)")), None),
            (format!("select a from t where a in ({})", list(100_000, "#")), None),
        ] {
            let refused = refusal(&sql);
            let is_expected = match limit {
                Some(limit) => refused.as_ref().is_some_and(|text| text.contains(limit)),
                None => refused.is_none(),
            };
            assert!(is_expected, "{}: {refused:?}", &sql[..60]);
        }
    }
}
