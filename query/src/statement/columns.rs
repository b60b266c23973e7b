//! `COLUMNS(...)`: an expression for each of the columns of FROM that a regular expression or a wildcard chooses.

use std::ops::ControlFlow;

use datafusion::common::{DFSchema, TableReference};
use datafusion::sql::sqlparser::ast::{
    ExceptSelectItem, ExcludeSelectItem, Expr, Function, FunctionArg, FunctionArgExpr, FunctionArguments, Ident,
    ObjectName, Select, SelectItem, Value, ValueWithSpan, Visitor, VisitorMut, WildcardAdditionalOptions,
};
use datafusion::sql::sqlparser::tokenizer::Location;
use regex::RegexBuilder;

use super::syntax_walk::{walk_mut, walk_syntax};
use super::tree;
use crate::Error;

/// Maximum size of a compiled regular expression, bytes.
const REGEX_BYTES: usize = 1 << 16;
/// Maximum number of columns that an error lists.
const LISTED: usize = 12;
/// Maximum number of columns that a condition is repeated for: the repetitions are one chain of AND.
const MOST_CONDITIONS: usize = 300;
/// Bytes that a call takes of a statement's growth, for its regular expression.
const CHOICE_BYTES: usize = 1 << 10;
/// Bytes that each column takes of it.
const COLUMN_BYTES: usize = 16;
const FORMS: &str = "COLUMNS('regular expression'), COLUMNS(*), COLUMNS(t.*) or COLUMNS(* EXCLUDE (x))";

/// Writes out the calls of `COLUMNS` of one select.
pub(super) struct ColumnsExpansion<'a> {
    /// The columns of FROM.
    pub schema: &'a DFSchema,
    /// The statement's text, for places of errors.
    pub sql: &'a str,
    /// Bytes by which the statement may still grow.
    pub bytes_left: &'a mut usize,
}

/// A column that `COLUMNS` chose.
#[derive(Clone)]
struct ChosenColumn {
    name: String,
    expr: Expr,
    /// The whole match of a regular expression, and its groups.
    groups: Vec<String>,
}

/// Returns whether the select list or a condition has a call of `COLUMNS`.
pub(super) fn has_columns(select: &Select) -> bool {
    let items = select.projection.iter().filter_map(|item| match item {
        SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. } => Some(expr),
        _ => None,
    });
    let conditions = [&select.selection, &select.having, &select.qualify].into_iter().flatten();
    items.chain(conditions).any(|expr| !find_calls(expr).is_empty())
}

/// Returns an error with a hint and without a place.
pub(super) fn hinted_error(message: String, hint: impl Into<String>) -> Error {
    Error::Query { message, place: None, hint: Some(hint.into()) }
}

impl ColumnsExpansion<'_> {
    /// Writes out the select list and the conditions.
    ///
    /// # Errors
    /// [`Error::Query`] if a column is not there, or too many are.
    pub fn expand_select(&mut self, select: &mut Select) -> Result<(), Error> {
        let mut projection = Vec::with_capacity(select.projection.len());
        for item in std::mem::take(&mut select.projection) {
            self.expand_item(item, &mut projection)?;
        }
        select.projection = projection;
        for condition in [&mut select.selection, &mut select.having, &mut select.qualify].into_iter().flatten() {
            self.expand_condition(condition)?;
        }
        Ok(())
    }

    fn expand_item(&mut self, item: SelectItem, items: &mut Vec<SelectItem>) -> Result<(), Error> {
        match item {
            SelectItem::UnnamedExpr(expr) => {
                items.extend(self.column_copies(expr)?.into_iter().map(|(expr, _)| tree::select_item(expr, None)));
            }
            SelectItem::ExprWithAlias { expr, alias } => {
                let copies = self.column_copies(expr)?;
                if copies.len() > 1 && !alias.value.contains('\\') {
                    let hint = format!("AS \"{}_\\0\", where \\0 is a column's name", alias.value);
                    return Err(hinted_error(format!("`{alias}` would be the name of {} columns", copies.len()), hint));
                }
                let named = |(expr, column)| tree::select_item(expr, Some(alias_of(&alias, column)));
                items.extend(copies.into_iter().map(named));
            }
            other => items.push(other),
        }
        Ok(())
    }

    fn expand_condition(&mut self, condition: &mut Expr) -> Result<(), Error> {
        let copies = self.column_copies(condition.clone())?;
        if copies.len() > MOST_CONDITIONS {
            let hint = "a regular expression that fewer columns match".to_owned();
            return Err(hinted_error(format!("more than {MOST_CONDITIONS} columns in a condition"), hint));
        }
        if let Some(all) = copies.into_iter().map(|(expr, _)| expr).reduce(tree::and_conditions) {
            *condition = all;
        }
        Ok(())
    }

    // One copy of an expression for each column that its `COLUMNS` choose; all must choose the same.
    fn column_copies(&mut self, expr: Expr) -> Result<Vec<(Expr, Option<ChosenColumn>)>, Error> {
        let calls = find_calls(&expr);
        let mut first: Option<Vec<ChosenColumn>> = None;
        for call in &calls {
            let chosen = self.chosen_columns(call).map_err(|error| error.with_place(self.sql, call_location(call)))?;
            let is_same = |known: &Vec<ChosenColumn>| known.iter().map(|c| &c.name).eq(chosen.iter().map(|c| &c.name));
            if !first.as_ref().is_none_or(is_same) {
                let message = "COLUMNS of one expression choose different columns".to_owned();
                let hint = "the same COLUMNS(...) at each place, or write the columns out".to_owned();
                return Err(hinted_error(message, hint).with_place(self.sql, call_location(call)));
            }
            first.get_or_insert(chosen);
        }
        let Some(first) = first else { return Ok(vec![(expr, None)]) };
        self.take_bytes(expr.to_string().len().saturating_mul(first.len()))?;
        let copy = |column: ChosenColumn| {
            let mut copy = expr.clone();
            // The walk never breaks off.
            let _ = walk_mut(&mut copy, &mut ReplaceVisitor(&column.expr));
            (copy, Some(column))
        };
        Ok(first.into_iter().map(copy).collect())
    }

    fn chosen_columns(&mut self, call: &Function) -> Result<Vec<ChosenColumn>, Error> {
        self.take_bytes(CHOICE_BYTES + self.schema.fields().len() * COLUMN_BYTES)?;
        let chosen = match only_argument(call) {
            Some(FunctionArgExpr::Wildcard) => self.filter_columns(|_, _| true),
            Some(FunctionArgExpr::QualifiedWildcard(table)) => {
                let table = last_name(table);
                self.filter_columns(|qualifier, _| qualifier.map(TableReference::table) == table.as_deref())
            }
            Some(FunctionArgExpr::WildcardWithOptions(options)) if only_excludes(options) => {
                let excluded = excluded_names(options);
                if let Some(unknown) = excluded.iter().find(|name| !self.schema.has_column_with_unqualified_name(name))
                {
                    return Err(hinted_error(format!("no column `{unknown}`"), self.columns_hint()));
                }
                self.filter_columns(|_, name| !excluded.iter().any(|excluded| excluded == name))
            }
            Some(FunctionArgExpr::Expr(Expr::Value(ValueWithSpan {
                value: Value::SingleQuotedString(pattern),
                ..
            }))) => self.matching_columns(pattern)?,
            _ => return Err(hinted_error(format!("`{call}` does not say which columns"), FORMS.to_owned())),
        };
        if chosen.is_empty() {
            return Err(hinted_error(format!("`{call}` chooses no column"), self.columns_hint()));
        }
        Ok(chosen)
    }

    fn filter_columns(&self, is_chosen: impl Fn(Option<&TableReference>, &str) -> bool) -> Vec<ChosenColumn> {
        let chosen = self.schema.iter().filter(|(qualifier, field)| is_chosen(*qualifier, field.name()));
        chosen.map(|(qualifier, field)| chosen_column(qualifier, field.name(), Vec::new())).collect()
    }

    fn matching_columns(&self, pattern: &str) -> Result<Vec<ChosenColumn>, Error> {
        let regex = RegexBuilder::new(pattern).size_limit(REGEX_BYTES).build().map_err(|e| {
            hinted_error(format!("`{pattern}` is no regular expression: {e}"), "COLUMNS('tnce_band_.*')".to_owned())
        })?;
        let chosen = self.schema.iter().filter_map(|(qualifier, field)| {
            let captures = regex.captures(field.name())?;
            let group = |group: Option<regex::Match<'_>>| group.map_or_else(String::new, |m| m.as_str().to_owned());
            Some(chosen_column(qualifier, field.name(), captures.iter().map(group).collect()))
        });
        Ok(chosen.collect())
    }

    fn columns_hint(&self) -> String {
        let names: Vec<_> = self.schema.fields().iter().map(|field| field.name().as_str()).take(LISTED).collect();
        let more = if self.schema.fields().len() > LISTED { ", ..." } else { "" };
        format!("the columns are {}{more}", names.join(", "))
    }

    fn take_bytes(&mut self, bytes: usize) -> Result<(), Error> {
        *self.bytes_left = self.bytes_left.checked_sub(bytes).ok_or_else(|| {
            let message = "the query is too long once COLUMNS are written out".to_owned();
            hinted_error(message, "fewer columns at a time, or WITH for what is repeated".to_owned())
        })?;
        Ok(())
    }
}

fn chosen_column(qualifier: Option<&TableReference>, name: &str, groups: Vec<String>) -> ChosenColumn {
    let quoted = tree::quoted_ident(name);
    let expr = match qualifier {
        Some(qualifier) => {
            let parts = qualifier.to_vec();
            Expr::CompoundIdentifier(parts.iter().map(|part| tree::quoted_ident(part)).chain([quoted]).collect())
        }
        None => Expr::Identifier(quoted),
    };
    ChosenColumn { name: name.to_owned(), expr, groups }
}

// `\0` is the match, `\1` to `\9` are the groups of a regular expression; without one, `\0` is the column's name.
fn alias_of(alias: &Ident, column: Option<ChosenColumn>) -> Ident {
    let Some(column) = column.filter(|_| alias.value.contains('\\')) else { return alias.clone() };
    let mut name = tree::normalized_name(alias);
    for digit in 0..10 {
        let group = column.groups.get(digit).map_or("", String::as_str);
        let group = if digit == 0 && column.groups.is_empty() { &column.name } else { group };
        name = name.replace(&format!("\\{digit}"), group);
    }
    tree::quoted_ident(&name)
}

fn is_columns(function: &Function) -> bool {
    tree::plain_name(&function.name).is_some_and(|name| name == "columns")
}

fn call_location(function: &Function) -> Location {
    function.name.0.first().and_then(|part| part.as_ident()).map_or(Location::empty(), |name| name.span.start)
}

// The calls of `COLUMNS` in an expression, outermost first.
fn find_calls(expr: &Expr) -> Vec<Function> {
    let mut found = CallVisitor(Vec::new());
    // The walk never breaks off.
    let _ = walk_syntax(expr, &mut found);
    found.0
}

// The names that `* EXCLUDE (...)` or `* EXCEPT (...)` leaves out.
fn excluded_names(options: &WildcardAdditionalOptions) -> Vec<String> {
    let mut names: Vec<String> = match &options.opt_exclude {
        Some(ExcludeSelectItem::Single(name)) => last_name(name).into_iter().collect(),
        Some(ExcludeSelectItem::Multiple(names)) => names.iter().filter_map(last_name).collect(),
        None => Vec::new(),
    };
    if let Some(ExceptSelectItem { first_element, additional_elements }) = &options.opt_except {
        names.extend([first_element].into_iter().chain(additional_elements).map(tree::normalized_name));
    }
    names
}

fn last_name(name: &ObjectName) -> Option<String> {
    name.0.last().and_then(|part| part.as_ident()).map(tree::normalized_name)
}

fn only_excludes(options: &WildcardAdditionalOptions) -> bool {
    options.opt_replace.is_none()
        && options.opt_rename.is_none()
        && options.opt_ilike.is_none()
        && options.opt_alias.is_none()
}

fn only_argument(function: &Function) -> Option<&FunctionArgExpr> {
    let FunctionArguments::List(list) = &function.args else { return None };
    match list.args.as_slice() {
        [FunctionArg::Unnamed(argument)] if list.clauses.is_empty() => Some(argument),
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

struct ReplaceVisitor<'a>(&'a Expr);

impl VisitorMut for ReplaceVisitor<'_> {
    type Break = ();

    fn pre_visit_expr(&mut self, expr: &mut Expr) -> ControlFlow<()> {
        if let Expr::Function(function) = expr
            && is_columns(function)
        {
            *expr = self.0.clone();
        }
        ControlFlow::Continue(())
    }
}
