//! The logical node of a join by order.

use std::cmp::Ordering;
use std::fmt;
use std::sync::Arc;

use datafusion::common::{DFSchemaRef, JoinType};
use datafusion::error::{DataFusionError, Result};
use datafusion::logical_expr::logical_plan::builder::build_join_schema;
use datafusion::logical_expr::{Expr, Extension, LogicalPlan, Operator, UserDefinedLogicalNodeCore};

/// The side that has positions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum WindowSide {
    Left,
    Right,
}

/// The order of positions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum JoinOrder {
    Ascending,
    Descending,
}

/// The rows within a range that are joined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum MatchedRows {
    All,
    /// The first one. Of several at the same position it is the one that comes first by its other columns.
    Nearest,
}

/// An end of a range.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct JoinBound<E> {
    pub expr: E,
    /// Whether the bound itself is outside.
    pub is_strict: bool,
}

/// A join of each row of one side with rows of the other, the window, whose positions are within a range.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct SortedJoin {
    pub left: Arc<LogicalPlan>,
    pub right: Arc<LogicalPlan>,
    /// Expressions of the left and of the right that must be equal.
    pub keys: Vec<(Expr, Expr)>,
    pub window: WindowSide,
    /// An expression of the window.
    pub position: Expr,
    pub order: JoinOrder,
    /// Where ranges begin in this order, an expression of the other side.
    pub first: JoinBound<Expr>,
    /// Where they end; None for the end of the key.
    pub last: Option<JoinBound<Expr>>,
    pub matched: MatchedRows,
    /// Inner or left.
    pub join_type: JoinType,
    /// What must be true of a pair of rows besides.
    pub filter: Option<Expr>,
    pub schema: DFSchemaRef,
}

impl SortedJoin {
    /// Creates the join of each row of the left with the nearest row of the right for which `left operator right`.
    ///
    /// # Errors
    /// If the sides have a column of the same name.
    pub fn new_as_of(
        [left, right]: [Arc<LogicalPlan>; 2],
        keys: Vec<(Expr, Expr)>,
        (bound, operator, position): (Expr, Operator, Expr),
        join_type: JoinType,
    ) -> Result<Self> {
        let schema = Arc::new(build_join_schema(left.schema(), right.schema(), &join_type)?);
        let is_strict = matches!(operator, Operator::Gt | Operator::Lt);
        let is_before = matches!(operator, Operator::Gt | Operator::GtEq);
        Ok(Self {
            left,
            right,
            keys,
            window: WindowSide::Right,
            position,
            order: if is_before { JoinOrder::Descending } else { JoinOrder::Ascending },
            first: JoinBound { expr: bound, is_strict },
            last: None,
            matched: MatchedRows::Nearest,
            join_type,
            filter: None,
            schema,
        })
    }

    /// Returns the join that a node is, if it is one.
    pub fn of_plan(plan: &LogicalPlan) -> Option<&Self> {
        match plan {
            LogicalPlan::Extension(extension) => extension.node.as_any().downcast_ref(),
            _ => None,
        }
    }

    /// Returns it as a node of a plan.
    pub fn into_plan(self) -> LogicalPlan {
        LogicalPlan::Extension(Extension { node: Arc::new(self) })
    }

    /// Returns the join with other inputs.
    ///
    /// # Errors
    /// If the sides have a column of the same name.
    pub fn with_inputs(&self, left: Arc<LogicalPlan>, right: Arc<LogicalPlan>) -> Result<Self> {
        let schema = Arc::new(build_join_schema(left.schema(), right.schema(), &self.join_type)?);
        Ok(Self { left, right, schema, ..self.clone() })
    }
}

// Equal or not comparable.
impl PartialOrd for SortedJoin {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        (self == other).then_some(Ordering::Equal)
    }
}

impl UserDefinedLogicalNodeCore for SortedJoin {
    fn name(&self) -> &str {
        "SortedJoin"
    }

    fn inputs(&self) -> Vec<&LogicalPlan> {
        vec![&self.left, &self.right]
    }

    fn schema(&self) -> &DFSchemaRef {
        &self.schema
    }

    fn expressions(&self) -> Vec<Expr> {
        let keys = self.keys.iter().flat_map(|(left, right)| [left, right]);
        let range = [&self.position, &self.first.expr].into_iter().chain(self.last.as_ref().map(|last| &last.expr));
        keys.chain(range).chain(&self.filter).cloned().collect()
    }

    fn fmt_for_explain(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let keys: Vec<_> = self.keys.iter().map(|(left, right)| format!("{left} = {right}")).collect();
        write!(f, "SortedJoin: {:?}, {}, keys=[{}], ", self.matched, self.join_type, keys.join(", "))?;
        write!(f, "range=[{}]", describe_range(&self.position, self.order, &self.first, self.last.as_ref()))?;
        self.filter.as_ref().map_or(Ok(()), |filter| write!(f, ", filter={filter}"))
    }

    fn with_exprs_and_inputs(&self, exprs: Vec<Expr>, inputs: Vec<LogicalPlan>) -> Result<Self> {
        let wrong = || DataFusionError::Internal("a SortedJoin has other parts".to_owned());
        let [left, right] = <[LogicalPlan; 2]>::try_from(inputs).map_err(|_| wrong())?;
        let mut join = self.with_inputs(Arc::new(left), Arc::new(right))?;
        let mut exprs = exprs.into_iter();
        let keys = join.keys.iter_mut().flat_map(|(left, right)| [left, right]);
        let range = [&mut join.position, &mut join.first.expr].into_iter();
        let range = range.chain(join.last.as_mut().map(|last| &mut last.expr));
        for part in keys.chain(range).chain(join.filter.as_mut()) {
            *part = exprs.next().ok_or_else(wrong)?;
        }
        Ok(join)
    }

    // The columns of its own expressions are added by the optimizer.
    fn necessary_children_exprs(&self, output_columns: &[usize]) -> Option<Vec<Vec<usize>>> {
        let width = self.left.schema().fields().len();
        let (left, right): (Vec<_>, Vec<_>) = output_columns.iter().copied().partition(|column| *column < width);
        Some(vec![left, right.into_iter().map(|column| column - width).collect()])
    }
}

/// Returns a range as comparisons of the position, for EXPLAIN.
pub(super) fn describe_range<E: fmt::Display>(
    position: &E,
    order: JoinOrder,
    first: &JoinBound<E>,
    last: Option<&JoinBound<E>>,
) -> String {
    let [after, before] = match order {
        JoinOrder::Ascending => [">", "<"],
        JoinOrder::Descending => ["<", ">"],
    };
    let compare = |operator: &str, bound: &JoinBound<E>| {
        let equal = if bound.is_strict { "" } else { "=" };
        format!("{position} {operator}{equal} {}", bound.expr)
    };
    let first = compare(after, first);
    last.map_or_else(|| first.clone(), |last| format!("{first}, {}", compare(before, last)))
}
