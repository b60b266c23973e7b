//! `a ASOF JOIN b`: each row of `a` with the one row of `b` that is nearest, as DuckDB writes it.
//!
//! | statement | what the parser reads | what is planned |
//! | --- | --- | --- |
//! | `a ASOF JOIN b ON c` | `a GLOBAL JOIN b ON c` | `a JOIN (b) AS "asof join" ON c` |
//! | `a ASOF LEFT JOIN b USING (t)` | `a GLOBAL LEFT JOIN b USING (t)` | `a LEFT JOIN (b) AS "asof join" USING (t)` |
//!
//! The parser knows `ASOF JOIN` with Snowflake's MATCH_CONDITION alone; GLOBAL, a word of ClickHouse, may stand before
//! every join. The planner makes a node of its own, [`AsOfSide`], of what has the mark, so that names are resolved as
//! in any join. Then [`plan_as_of_joins`] makes a [`SortedJoin`] of the join and its mark. It is no condition of a
//! join, because the optimizer may move conditions: one on the right would choose other rows.

use std::cmp::Ordering;
use std::fmt;
use std::ops::ControlFlow;
use std::sync::Arc;

use datafusion::common::tree_node::{Transformed, TreeNodeRecursion};
use datafusion::common::{DFSchemaRef, JoinConstraint as PlannedConstraint, JoinType};
use datafusion::error::{DataFusionError, Result as PlanResult};
use datafusion::logical_expr::binary::BinaryTypeCoercer;
use datafusion::logical_expr::logical_plan::Join as PlannedJoin;
use datafusion::logical_expr::planner::{PlannedRelation, RelationPlanner, RelationPlannerContext, RelationPlanning};
use datafusion::logical_expr::utils::{conjunction, split_conjunction_owned};
use datafusion::logical_expr::{
    BinaryExpr, Expr, ExprSchemable as _, Extension, Filter, LogicalPlan, Operator, UserDefinedLogicalNodeCore,
};
use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::{
    Join, JoinOperator, Select, TableAlias, TableFactor, TableWithJoins, VisitorMut,
};
use datafusion::sql::sqlparser::keywords::Keyword;
use datafusion::sql::sqlparser::tokenizer::{Token, TokenWithSpan};

use super::syntax_walk::walk_mut;
use super::tree::quoted_ident;
use crate::Error;
use crate::sorted_join::{SortedJoin, is_ordered_type};

/// The alias of a marked side.
const MARK: &str = "asof join";
/// The form of the join, which is the hint of errors.
pub(super) const FORM: &str = "a ASOF JOIN b ON a.k = b.k AND a.t >= b.t, with one of >=, >, <= and <; \
    a ASOF LEFT JOIN b USING (k, t) for a.t >= b.t";

/// Words before a name, so that what follows is no join of it.
const BEFORE_NAME: [Keyword; 6] =
    [Keyword::AS, Keyword::FROM, Keyword::JOIN, Keyword::LATERAL, Keyword::SELECT, Keyword::BY];
/// Words at the beginning of a join.
const JOIN_WORDS: [Keyword; 9] = [
    Keyword::JOIN,
    Keyword::INNER,
    Keyword::LEFT,
    Keyword::RIGHT,
    Keyword::FULL,
    Keyword::SEMI,
    Keyword::ANTI,
    Keyword::CROSS,
    Keyword::NATURAL,
];

/// Replaces the word `ASOF` before joins, and returns how often.
pub(super) fn read_as_of_joins(mut tokens: Vec<TokenWithSpan>) -> (Vec<TokenWithSpan>, usize) {
    let is_blank = |token: &TokenWithSpan| matches!(token.token, Token::Whitespace(_));
    let places: Vec<_> = (0..tokens.len()).filter(|place| !is_blank(&tokens[*place])).collect();
    let is_as_of = |&[before, word, after]: &[usize; 3]| {
        let is_name = match &tokens[before].token {
            Token::Comma | Token::LParen | Token::Period => true,
            Token::Word(word) => BEFORE_NAME.contains(&word.keyword),
            _ => false,
        };
        !is_name
            && keyword(&tokens[word]) == Some(Keyword::ASOF)
            && keyword(&tokens[after]).is_some_and(|word| JOIN_WORDS.contains(&word))
            && !has_match_condition(&tokens[after..])
    };
    let found: Vec<_> = places.array_windows().filter(|three| is_as_of(three)).map(|three| three[1]).collect();
    for place in &found {
        tokens[*place].token = Token::make_keyword("GLOBAL");
    }
    (tokens, found.len())
}

fn keyword(token: &TokenWithSpan) -> Option<Keyword> {
    match &token.token {
        Token::Word(word) if word.quote_style.is_none() => Some(word.keyword),
        _ => None,
    }
}

// Snowflake's form, in which rows without a match are kept.
fn has_match_condition(tokens: &[TokenWithSpan]) -> bool {
    let mut depth = 0_usize;
    for token in tokens {
        match (&token.token, keyword(token)) {
            (Token::LParen, _) => depth += 1,
            (Token::RParen, _) if depth == 0 => return false,
            (Token::RParen, _) => depth -= 1,
            (_, Some(Keyword::MATCH_CONDITION)) if depth == 0 => return true,
            (_, Some(Keyword::ON | Keyword::USING)) if depth == 0 => return false,
            _ => {}
        }
    }
    false
}

/// Marks the right sides of joins whose word [`read_as_of_joins`] has replaced `count` times.
///
/// # Errors
/// [`Error::Query`] if a join is of a kind that has no nearest row, or has the word GLOBAL itself.
pub(super) fn mark_as_of_joins(statement: &mut Statement, count: usize, sql: &str) -> Result<(), Error> {
    match statement {
        _ if count == 0 => Ok(()),
        Statement::Statement(parsed) => {
            let mut marker = AsOfMarker { count: 0, refused: None };
            let _ = walk_mut(parsed.as_mut(), &mut marker);
            match marker.refused {
                _ if marker.count != count => Err(global_join(sql)),
                Some(kind) => Err(Error::unsupported_clause(sql, &format!("ASOF {kind}"), FORM.to_owned())),
                None => Ok(()),
            }
        }
        Statement::Explain(explain) => mark_as_of_joins(&mut explain.statement, count, sql),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => Ok(()),
    }
}

fn global_join(sql: &str) -> Error {
    Error::unsupported_clause(sql, "GLOBAL JOIN", "JOIN".to_owned())
}

/// Returns whether a join is an as-of join.
pub(super) fn is_as_of_join(join: &Join) -> bool {
    as_of_alias(&join.relation).is_some()
}

// The marked side.
fn as_of_alias(factor: &TableFactor) -> Option<&TableFactor> {
    match factor {
        TableFactor::NestedJoin { table_with_joins, alias: Some(alias) }
            if alias.name.value == MARK && table_with_joins.joins.is_empty() =>
        {
            Some(&table_with_joins.relation)
        }
        _ => None,
    }
}

struct AsOfMarker {
    count: usize,
    refused: Option<&'static str>,
}

impl VisitorMut for AsOfMarker {
    type Break = ();

    fn pre_visit_select(&mut self, select: &mut Select) -> ControlFlow<()> {
        select.from.iter_mut().for_each(|tables| self.mark_joins(tables));
        ControlFlow::Continue(())
    }

    fn pre_visit_table_factor(&mut self, factor: &mut TableFactor) -> ControlFlow<()> {
        if let TableFactor::NestedJoin { table_with_joins, .. } = factor {
            self.mark_joins(table_with_joins);
        }
        ControlFlow::Continue(())
    }
}

impl AsOfMarker {
    fn mark_joins(&mut self, tables: &mut TableWithJoins) {
        for join in tables.joins.iter_mut().filter(|join| join.global) {
            join.global = false;
            self.count += 1;
            match join.join_operator {
                JoinOperator::Join(_) | JoinOperator::Inner(_) | JoinOperator::Left(_) | JoinOperator::LeftOuter(_) => {
                    mark_side(&mut join.relation)
                }
                JoinOperator::Right(_) | JoinOperator::RightOuter(_) => self.refused = Some("RIGHT JOIN"),
                JoinOperator::FullOuter(_) => self.refused = Some("FULL JOIN"),
                _ => self.refused = Some("JOIN of this kind"),
            }
        }
    }
}

fn mark_side(factor: &mut TableFactor) {
    let alias = TableAlias { explicit: true, name: quoted_ident(MARK), columns: Vec::new(), at: None };
    let side = TableWithJoins { relation: factor.clone(), joins: Vec::new() };
    *factor = TableFactor::NestedJoin { table_with_joins: Box::new(side), alias: Some(alias) };
}

/// Plans marked sides.
#[derive(Debug)]
pub(crate) struct AsOfSidePlanner;

impl RelationPlanner for AsOfSidePlanner {
    fn plan_relation(
        &self,
        relation: TableFactor,
        context: &mut dyn RelationPlannerContext,
    ) -> PlanResult<RelationPlanning> {
        let Some(side) = as_of_alias(&relation) else { return Ok(RelationPlanning::Original(Box::new(relation))) };
        let side = AsOfSide(Arc::new(context.plan(side.clone())?));
        let plan = LogicalPlan::Extension(Extension { node: Arc::new(side) });
        Ok(RelationPlanning::Planned(Box::new(PlannedRelation::new(plan, None))))
    }
}

/// The right side of an as-of join, until that is planned.
#[derive(Debug, PartialEq, Eq, Hash)]
struct AsOfSide(Arc<LogicalPlan>);

// Equal or not comparable.
impl PartialOrd for AsOfSide {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        (self == other).then_some(Ordering::Equal)
    }
}

impl UserDefinedLogicalNodeCore for AsOfSide {
    fn name(&self) -> &str {
        "AsOfSide"
    }

    fn inputs(&self) -> Vec<&LogicalPlan> {
        vec![&self.0]
    }

    fn schema(&self) -> &DFSchemaRef {
        self.0.schema()
    }

    fn expressions(&self) -> Vec<Expr> {
        Vec::new()
    }

    fn fmt_for_explain(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("AsOfSide")
    }

    fn with_exprs_and_inputs(&self, _: Vec<Expr>, mut inputs: Vec<LogicalPlan>) -> PlanResult<Self> {
        let input = inputs.pop().ok_or_else(|| DataFusionError::Internal("an as-of join of nothing".to_owned()))?;
        Ok(Self(Arc::new(input)))
    }
}

fn side_of_plan(plan: &LogicalPlan) -> Option<&AsOfSide> {
    match plan {
        LogicalPlan::Extension(extension) => extension.node.as_any().downcast_ref(),
        _ => None,
    }
}

/// Makes as-of joins of joins with a marked side.
///
/// # Errors
/// If a condition is none of an as-of join.
pub(super) fn plan_as_of_joins(plan: LogicalPlan) -> PlanResult<LogicalPlan> {
    let is_there = |plan: &LogicalPlan| {
        let mut is_there = false;
        plan.apply_with_subqueries(|node| {
            is_there = is_there || side_of_plan(node).is_some();
            Ok(if is_there { TreeNodeRecursion::Stop } else { TreeNodeRecursion::Continue })
        })?;
        Ok::<_, DataFusionError>(is_there)
    };
    if !is_there(&plan)? {
        return Ok(plan);
    }
    let planned = plan.transform_up_with_subqueries(|node| match &node {
        LogicalPlan::Join(join) => match side_of_plan(&join.right) {
            Some(side) => Ok(Transformed::yes(plan_join(join, side)?)),
            None => Ok(Transformed::no(node)),
        },
        _ => Ok(Transformed::no(node)),
    });
    let planned = planned?.data;
    if is_there(&planned)? { Err(refuse_condition("these columns")) } else { Ok(planned) }
}

fn refuse_condition(what: &str) -> DataFusionError {
    let takes = "ASOF JOIN takes equalities and one inequality, each between columns of both tables";
    DataFusionError::Plan(format!("{takes}, not {what}; hint: {FORM}"))
}

/// The conditions of an as-of join.
#[derive(Default)]
struct AsOfConditions {
    keys: Vec<(Expr, Expr)>,
    nearest: Option<(Expr, Operator, Expr)>,
    /// Those on rows of one side.
    on_left: Vec<Expr>,
    on_right: Vec<Expr>,
}

fn plan_join(join: &PlannedJoin, side: &AsOfSide) -> PlanResult<LogicalPlan> {
    let mut conditions = AsOfConditions::default();
    let mut pairs: Vec<_> = join.on.clone();
    if join.join_constraint == PlannedConstraint::Using {
        // As in DuckDB, the last column is the time.
        let (left, right) = pairs.pop().ok_or_else(|| refuse_condition("none"))?;
        conditions.nearest = Some(coerce_sides(join, left, Operator::GtEq, right)?);
    }
    for (left, right) in pairs {
        let (left, _, right) = coerce_sides(join, left, Operator::Eq, right)?;
        conditions.keys.push((left, right));
    }
    for part in join.filter.iter().cloned().flat_map(split_conjunction_owned) {
        conditions.add_condition(join, part)?;
    }
    let AsOfConditions { keys, nearest, on_left, on_right } = conditions;
    let nearest = nearest.ok_or_else(|| refuse_condition("equalities alone"))?;
    let inputs = [filter_side(&join.left, on_left)?, filter_side(&side.0, on_right)?];
    Ok(SortedJoin::new_as_of(inputs, keys, nearest, join.join_type)?.into_plan())
}

fn filter_side(side: &Arc<LogicalPlan>, conditions: Vec<Expr>) -> PlanResult<Arc<LogicalPlan>> {
    match conjunction(conditions) {
        Some(predicate) => Ok(Arc::new(LogicalPlan::Filter(Filter::try_new(predicate, side.clone())?))),
        None => Ok(side.clone()),
    }
}

impl AsOfConditions {
    fn add_condition(&mut self, join: &PlannedJoin, part: Expr) -> PlanResult<()> {
        let refuse = |part: &Expr| Err(refuse_condition(&format!("`{}`", part.human_display())));
        if let Expr::BinaryExpr(BinaryExpr { left, op, right }) = &part {
            let sides = match (is_of(left, &join.left), is_of(right, &join.right)) {
                (true, true) => Some((left, *op, right)),
                _ if is_of(left, &join.right) && is_of(right, &join.left) => op.swap().map(|op| (right, op, left)),
                _ => None,
            };
            match sides {
                Some((left, Operator::Eq, right)) => {
                    let (left, _, right) = coerce_sides(join, *left.clone(), Operator::Eq, *right.clone())?;
                    self.keys.push((left, right));
                    return Ok(());
                }
                Some((left, op @ (Operator::Gt | Operator::GtEq | Operator::Lt | Operator::LtEq), right))
                    if self.nearest.is_none() =>
                {
                    self.nearest = Some(coerce_sides(join, *left.clone(), op, *right.clone())?);
                    return Ok(());
                }
                Some(_) => return refuse(&part),
                None => {}
            }
        }
        match (is_of(&part, &join.left), is_of(&part, &join.right)) {
            // Rows of the left that do not fulfil it would be kept by a left join.
            (true, _) if join.join_type == JoinType::Inner => self.on_left.push(part),
            (_, true) => self.on_right.push(part),
            _ => return refuse(&part),
        }
        Ok(())
    }
}

fn is_of(expr: &Expr, plan: &LogicalPlan) -> bool {
    let columns = expr.column_refs();
    !columns.is_empty() && columns.iter().all(|column| plan.schema().has_column(column))
}

// Casts both sides of a comparison to the type in which they are compared.
fn coerce_sides(join: &PlannedJoin, left: Expr, op: Operator, right: Expr) -> PlanResult<(Expr, Operator, Expr)> {
    let [left_schema, right_schema] = [join.left.schema(), join.right.schema()];
    let (left_kind, right_kind) = (left.get_type(left_schema)?, right.get_type(right_schema)?);
    let (left_kind, right_kind) = BinaryTypeCoercer::new(&left_kind, &op, &right_kind).get_input_types()?;
    if left_kind != right_kind || !is_ordered_type(&left_kind) {
        let message = format!("ASOF JOIN cannot compare {left_kind} and {right_kind}");
        return Err(DataFusionError::Plan(format!("{message}; hint: CAST(x AS type) makes the types equal")));
    }
    Ok((left.cast_to(&left_kind, left_schema)?, op, right.cast_to(&right_kind, right_schema)?))
}
