//! Walks over syntax trees by visitors behind pointers.
//!
//! sqlparser compiles its walk anew for each type of visitor, which is half a megabyte of code each time. Here all
//! visitors share one walk that reads and one that changes.

use std::ops::ControlFlow;

use datafusion::sql::sqlparser::ast::{
    Expr, ObjectName, Query, Select, Statement, TableFactor, ValueWithSpan, Visit, VisitMut, Visitor, VisitorMut,
};

/// Walks over a part of a syntax tree; returns what the visitor broke off with.
pub(crate) fn walk_syntax<B>(node: &impl Visit, visitor: &mut dyn Visitor<Break = B>) -> ControlFlow<B> {
    let mut kept = KeptBreak { visitor, broken: None };
    match node.visit(&mut SharedVisitor(&mut kept)) {
        ControlFlow::Break(()) => kept.broken.map_or(ControlFlow::Continue(()), ControlFlow::Break),
        ControlFlow::Continue(()) => ControlFlow::Continue(()),
    }
}

/// Walks over a part of a syntax tree that the visitor may change; returns what the visitor broke off with.
pub(super) fn walk_mut<B>(node: &mut impl VisitMut, visitor: &mut dyn VisitorMut<Break = B>) -> ControlFlow<B> {
    let mut kept = KeptBreakMut { visitor, broken: None };
    match node.visit(&mut SharedVisitorMut(&mut kept)) {
        ControlFlow::Break(()) => kept.broken.map_or(ControlFlow::Continue(()), ControlFlow::Break),
        ControlFlow::Continue(()) => ControlFlow::Continue(()),
    }
}

/// Walks over a statement that the visitor may change; the visitor may end the walk.
///
/// The walk is compiled in this crate, once for all visitors.
pub fn walk_statement(statement: &mut Statement, visitor: &mut dyn VisitorMut<Break = ()>) -> ControlFlow<()> {
    walk_mut(statement, visitor)
}

/// Walks over an expression as [`walk_statement`] does over a statement.
pub fn walk_expr(expr: &mut Expr, visitor: &mut dyn VisitorMut<Break = ()>) -> ControlFlow<()> {
    walk_mut(expr, visitor)
}

/// The one visitor of the walks that read.
struct SharedVisitor<'a>(&'a mut dyn Visitor<Break = ()>);

/// The one visitor of the walks that change.
struct SharedVisitorMut<'a>(&'a mut dyn VisitorMut<Break = ()>);

/// Keeps what its visitor breaks off with.
struct KeptBreak<'a, B> {
    visitor: &'a mut dyn Visitor<Break = B>,
    broken: Option<B>,
}

/// Keeps what its visitor breaks off with.
struct KeptBreakMut<'a, B> {
    visitor: &'a mut dyn VisitorMut<Break = B>,
    broken: Option<B>,
}

macro_rules! pass_on {
    ($visitor:ident, $shared:ident, $kept:ident, $($method:ident($node:ty)),*) => {
        impl $visitor for $shared<'_> {
            type Break = ();
            $(fn $method(&mut self, node: $node) -> ControlFlow<()> {
                self.0.$method(node)
            })*
        }

        impl<B> $visitor for $kept<'_, B> {
            type Break = ();
            $(fn $method(&mut self, node: $node) -> ControlFlow<()> {
                let ControlFlow::Break(broken) = self.visitor.$method(node) else { return ControlFlow::Continue(()) };
                self.broken = Some(broken);
                ControlFlow::Break(())
            })*
        }
    };
}

pass_on!(
    Visitor,
    SharedVisitor,
    KeptBreak,
    pre_visit_query(&Query),
    post_visit_query(&Query),
    pre_visit_select(&Select),
    post_visit_select(&Select),
    pre_visit_relation(&ObjectName),
    post_visit_relation(&ObjectName),
    pre_visit_table_factor(&TableFactor),
    post_visit_table_factor(&TableFactor),
    pre_visit_expr(&Expr),
    post_visit_expr(&Expr),
    pre_visit_statement(&Statement),
    post_visit_statement(&Statement),
    pre_visit_value(&ValueWithSpan),
    post_visit_value(&ValueWithSpan)
);
pass_on!(
    VisitorMut,
    SharedVisitorMut,
    KeptBreakMut,
    pre_visit_query(&mut Query),
    post_visit_query(&mut Query),
    pre_visit_select(&mut Select),
    post_visit_select(&mut Select),
    pre_visit_relation(&mut ObjectName),
    post_visit_relation(&mut ObjectName),
    pre_visit_table_factor(&mut TableFactor),
    post_visit_table_factor(&mut TableFactor),
    pre_visit_expr(&mut Expr),
    post_visit_expr(&mut Expr),
    pre_visit_statement(&mut Statement),
    post_visit_statement(&mut Statement),
    pre_visit_value(&mut ValueWithSpan),
    post_visit_value(&mut ValueWithSpan)
);
