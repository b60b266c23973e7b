//! `COLUMNS(...)`: the columns of a query's tables that a regular expression, a lambda or a list of names chooses.

use std::ops::ControlFlow;
use std::sync::Arc;

use arrow::array::{Array as _, ArrayRef, AsArray as _, StringArray};
use arrow::datatypes::{DataType, Field, Schema};
use arrow::record_batch::RecordBatch;
use datafusion::common::{DFSchema, TableReference};
use datafusion::error::{DataFusionError, Result as PlanResult};
use datafusion::execution::session_state::SessionState;
use datafusion::sql::sqlparser::ast::{
    Array, ExceptSelectItem, ExcludeSelectItem, Expr, ExprWithAlias, Function, FunctionArg, FunctionArgExpr,
    FunctionArguments, Ident, LambdaFunction, ObjectName, OneOrManyWithParens, Value, ValueWithSpan, Visitor,
    VisitorMut, WildcardAdditionalOptions,
};
use datafusion::sql::sqlparser::tokenizer::Location;
use regex::RegexBuilder;

use super::budget::RewriteBudget;
use super::tree;
use crate::Error;
use crate::syntax_walk::{walk, walk_mut};

/// Maximum size of a compiled regular expression, bytes.
const REGEX_BYTES: usize = 1 << 16;
/// Maximum number of columns that an error lists.
const LISTED: usize = 12;

/// A column of a query's tables.
pub(super) struct SourceColumn {
    qualifier: Option<TableReference>,
    pub(super) name: String,
    pub(super) data_type: DataType,
}

/// The columns of a query's tables, in the order of `*`.
pub(super) struct SourceColumns(Vec<SourceColumn>);

/// A column that `COLUMNS` chose.
#[derive(Clone)]
pub(super) struct ChosenColumn {
    /// Its name in its table.
    pub(super) source: String,
    /// Its name in the answer.
    pub(super) name: String,
    pub(super) expr: Expr,
    /// The whole match of a regular expression, and its groups.
    pub(super) groups: Vec<String>,
}

impl SourceColumn {
    /// Returns the expression of the column.
    pub(super) fn expr(&self) -> Expr {
        let name = tree::quoted(&self.name);
        let Some(qualifier) = &self.qualifier else { return Expr::Identifier(name) };
        let mut parts: Vec<_> = qualifier.to_vec().iter().map(|part| tree::quoted(part)).collect();
        parts.push(name);
        Expr::CompoundIdentifier(parts)
    }

    /// Returns whether the column is of a table.
    pub(super) fn is_of(&self, table: &ObjectName) -> bool {
        let last = table.0.last().and_then(|part| part.as_ident()).map(tree::normalized);
        self.qualifier.as_ref().is_some_and(|qualifier| Some(qualifier.table()) == last.as_deref())
    }

    fn chosen(&self, groups: Vec<String>) -> ChosenColumn {
        ChosenColumn { source: self.name.clone(), name: self.name.clone(), expr: self.expr(), groups }
    }
}

impl SourceColumns {
    pub(super) fn of(schema: &DFSchema) -> Self {
        let column = |(qualifier, field): (Option<&TableReference>, &Arc<Field>)| SourceColumn {
            qualifier: qualifier.cloned(),
            name: field.name().clone(),
            data_type: field.data_type().clone(),
        };
        Self(schema.iter().map(column).collect())
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &SourceColumn> {
        self.0.iter()
    }

    /// Returns the number of columns.
    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    /// Returns whether there is a column of this name.
    pub(super) fn has(&self, name: &str) -> bool {
        self.0.iter().any(|column| column.name == name)
    }

    /// Returns the columns that a call of `COLUMNS` chooses.
    ///
    /// # Errors
    /// [`Error::Query`] if it chooses none, does not say which, or the budget is spent.
    pub(super) fn chosen(
        &self,
        function: &Function,
        state: &SessionState,
        budget: &mut RewriteBudget,
    ) -> Result<Vec<ChosenColumn>, Error> {
        budget.take_choice(self.len())?;
        let chosen = match argument(function) {
            Some(FunctionArgExpr::Wildcard) => self.all(|_| true),
            Some(FunctionArgExpr::QualifiedWildcard(table)) => self.all(|column| column.is_of(table)),
            Some(FunctionArgExpr::WildcardWithOptions(options)) if only_excludes(options) => {
                let excluded = excluded(options);
                self.check_names(&excluded)?;
                self.all(|column| !excluded.contains(&column.name))
            }
            Some(FunctionArgExpr::Expr(Expr::Value(ValueWithSpan {
                value: Value::SingleQuotedString(pattern),
                ..
            }))) => self.matching(pattern)?,
            Some(FunctionArgExpr::Expr(Expr::Lambda(lambda))) => self.satisfying(lambda, state)?,
            Some(FunctionArgExpr::Expr(Expr::Array(list))) => self.named(list)?,
            _ => return Err(refused(format!("`{function}` does not say which columns"), FORMS.to_owned())),
        };
        if chosen.is_empty() {
            return Err(refused(format!("`{function}` chooses no column"), self.listed()));
        }
        Ok(chosen)
    }

    /// Accepts names of columns.
    ///
    /// # Errors
    /// [`Error::Query`] if one is not there.
    pub(super) fn check_names<'a>(&self, names: impl IntoIterator<Item = &'a String>) -> Result<(), Error> {
        match names.into_iter().find(|name| !self.has(name)) {
            Some(unknown) => Err(refused(format!("no column `{unknown}`"), self.listed())),
            None => Ok(()),
        }
    }

    fn all(&self, is_chosen: impl Fn(&SourceColumn) -> bool) -> Vec<ChosenColumn> {
        self.iter().filter(|column| is_chosen(column)).map(|column| column.chosen(Vec::new())).collect()
    }

    fn matching(&self, pattern: &str) -> Result<Vec<ChosenColumn>, Error> {
        let regex = RegexBuilder::new(pattern).size_limit(REGEX_BYTES).build().map_err(|e| {
            refused(format!("`{pattern}` is no regular expression: {e}"), "COLUMNS('tnce_band_.*')".to_owned())
        })?;
        let chosen = self.iter().filter_map(|column| {
            let captures = regex.captures(&column.name)?;
            let group = |group: Option<regex::Match<'_>>| group.map_or_else(String::new, |m| m.as_str().to_owned());
            Some(column.chosen(captures.iter().map(group).collect()))
        });
        Ok(chosen.collect())
    }

    fn named(&self, list: &Array) -> Result<Vec<ChosenColumn>, Error> {
        let column = |expr: &Expr| match expr {
            Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(name), .. }) => {
                let known = self.iter().find(|column| column.name.eq_ignore_ascii_case(name));
                let column = known.ok_or_else(|| refused(format!("no column `{name}`"), self.listed()))?;
                Ok(column.chosen(Vec::new()))
            }
            other => Err(refused(format!("`{other}` is no name in quotes"), FORMS.to_owned())),
        };
        list.elem.iter().map(column).collect()
    }

    // The lambda's body is an expression like any other, so the planner evaluates it, over the names.
    fn satisfying(&self, lambda: &LambdaFunction, state: &SessionState) -> Result<Vec<ChosenColumn>, Error> {
        let OneOrManyWithParens::One(parameter) = &lambda.params else {
            return Err(refused("the lambda of COLUMNS has one parameter".to_owned(), FORMS.to_owned()));
        };
        let is_chosen = self.evaluated(&tree::normalized(&parameter.name), &lambda.body, state).map_err(|e| {
            refused(format!("the lambda of COLUMNS is no condition of a name: {}", e.strip_backtrace()), FORMS.into())
        })?;
        let is_chosen = is_chosen.as_boolean();
        let rows = (0..self.0.len()).filter(|row| is_chosen.is_valid(*row) && is_chosen.value(*row));
        Ok(rows.map(|row| self.0[row].chosen(Vec::new())).collect())
    }

    fn evaluated(&self, parameter: &str, body: &Expr, state: &SessionState) -> PlanResult<ArrayRef> {
        let schema = Arc::new(Schema::new(vec![Field::new(parameter, DataType::Utf8, false)]));
        let names = StringArray::from_iter_values(self.0.iter().map(|column| &column.name));
        let batch = RecordBatch::try_new(schema.clone(), vec![Arc::new(names)])?;
        let schema = DFSchema::try_from(schema)?;
        let body = ExprWithAlias { expr: body.clone(), alias: None };
        let expr = state.create_logical_expr_from_sql_expr(body, &schema)?;
        let value = state.create_physical_expr(expr, &schema)?.evaluate(&batch)?.into_array(batch.num_rows())?;
        match value.data_type() {
            DataType::Boolean => Ok(value),
            other => Err(DataFusionError::Plan(format!("it is of type {other}"))),
        }
    }

    fn listed(&self) -> String {
        let names: Vec<_> = self.0.iter().map(|column| column.name.as_str()).take(LISTED).collect();
        let more = if self.0.len() > LISTED { ", ..." } else { "" };
        format!("the columns are {}{more}", names.join(", "))
    }
}

const FORMS: &str =
    "COLUMNS('regular expression'), COLUMNS(* EXCLUDE (x)), COLUMNS(['x', 'y']) or COLUMNS(c -> c LIKE 'x%')";

/// Returns whether a function is `COLUMNS`.
pub(super) fn is_columns(function: &Function) -> bool {
    tree::plain_name(&function.name).is_some_and(|name| name == "columns")
}

/// Returns the place of a call.
pub(super) fn place(function: &Function) -> Location {
    function.name.0.first().and_then(|part| part.as_ident()).map_or(Location::empty(), |name| name.span.start)
}

/// Returns the calls of `COLUMNS` in an expression, outermost first.
pub(super) fn calls(expr: &Expr) -> Vec<Function> {
    let mut found = CallVisitor(Vec::new());
    let ControlFlow::<()>::Continue(()) = walk(expr, &mut found) else { return Vec::new() };
    found.0
}

/// Replaces the calls of `COLUMNS` in an expression by columns, in the order of [`calls`].
pub(super) fn replace(expr: &mut Expr, columns: Vec<Expr>) {
    let ControlFlow::<()>::Continue(()) = walk_mut(expr, &mut ReplaceVisitor(columns.into_iter())) else { return };
}

/// Returns an error with a hint and without a place.
pub(super) fn refused(message: String, hint: String) -> Error {
    Error::Query { message, place: None, hint: Some(hint) }
}

/// Returns the names that `* EXCLUDE (...)` or `* EXCEPT (...)` leaves out.
pub(super) fn excluded(options: &WildcardAdditionalOptions) -> Vec<String> {
    let last = |name: &ObjectName| name.0.last().and_then(|part| part.as_ident()).map(tree::normalized);
    let mut names: Vec<String> = match &options.opt_exclude {
        Some(ExcludeSelectItem::Single(name)) => last(name).into_iter().collect(),
        Some(ExcludeSelectItem::Multiple(names)) => names.iter().filter_map(last).collect(),
        None => Vec::new(),
    };
    if let Some(ExceptSelectItem { first_element, additional_elements }) = &options.opt_except {
        let all: Vec<&Ident> = [first_element].into_iter().chain(additional_elements).collect();
        names.extend(all.into_iter().map(tree::normalized));
    }
    names
}

/// Returns whether a wildcard has no options.
pub(super) fn is_plain(options: &WildcardAdditionalOptions) -> bool {
    options.opt_exclude.is_none() && options.opt_except.is_none() && only_excludes(options)
}

fn only_excludes(options: &WildcardAdditionalOptions) -> bool {
    options.opt_replace.is_none()
        && options.opt_rename.is_none()
        && options.opt_ilike.is_none()
        && options.opt_alias.is_none()
}

fn argument(function: &Function) -> Option<&FunctionArgExpr> {
    match &function.args {
        FunctionArguments::List(list) => match list.args.as_slice() {
            [FunctionArg::Unnamed(argument)] if list.clauses.is_empty() => Some(argument),
            _ => None,
        },
        _ => None,
    }
}

struct CallVisitor(Vec<Function>);

impl Visitor for CallVisitor {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &Expr) -> ControlFlow<()> {
        if let Expr::Function(function) = expr
            && is_columns(function)
        {
            self.0.push(function.clone());
        }
        ControlFlow::Continue(())
    }
}

struct ReplaceVisitor(std::vec::IntoIter<Expr>);

impl VisitorMut for ReplaceVisitor {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Expr::Function(function) = expr
            && is_columns(function)
            && let Some(column) = self.0.next()
        {
            *expr = column;
        }
        ControlFlow::Continue(())
    }
}
