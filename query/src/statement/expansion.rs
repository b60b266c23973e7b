//! Refuses a statement of few words whose plan is huge: names of a WITH that stand for each other are planned again
//! wherever they stand, and CUBE makes each subset of its columns a grouping set.

use std::collections::HashMap;
use std::ops::ControlFlow;

use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::{
    Expr, GroupByExpr, GroupByWithModifier, ObjectNamePart, Query, Select, TableFactor, Visitor,
};

use super::columns::hinted_error;
use super::syntax_walk::walk_syntax;
use super::tree::normalized_name;
use crate::Error;

/// Maximum number of tables of a query, with those behind the names of its WITH.
const MOST_TABLES: u64 = 2_000;
/// Maximum number of grouping sets of one SELECT.
const MOST_GROUPINGS: u64 = 4_096;

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
        match count_groupings(&select.group_by) <= MOST_GROUPINGS {
            true => ControlFlow::Continue(()),
            false => ControlFlow::Break(hinted_error(
                format!("GROUP BY has more than {MOST_GROUPINGS} grouping sets"),
                "GROUPING SETS names those that are needed",
            )),
        }
    }
}

fn count_groupings(group_by: &GroupByExpr) -> u64 {
    let (keys, modifiers) = match group_by {
        GroupByExpr::Expressions(keys, modifiers) => (keys.as_slice(), modifiers),
        GroupByExpr::All(modifiers) => (&[][..], modifiers),
    };
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
            (format!("rollup({})", columns(3_000)), true),
            (format!("rollup({0}), rollup({0})", columns(100)), false),
            ("grouping sets ((c0), (c1), ())".to_owned(), true),
            (columns(3_000), true),
        ] {
            let sql = format!("select count(*) from t group by {group}");
            assert_eq!(refusal(&sql).is_none(), passes, "{sql}");
        }
    }
}
