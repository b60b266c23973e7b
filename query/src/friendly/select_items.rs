//! Select lists with `COLUMNS(...)`, `* RENAME (...)` and the fields of structs, written out.

use arrow::datatypes::DataType;
use datafusion::execution::session_state::SessionState;
use datafusion::sql::sqlparser::ast::{
    Expr, Ident, ObjectName, RenameSelectItem, Select, SelectItem, SelectItemQualifiedWildcardKind, TableFactor,
    WildcardAdditionalOptions,
};

use super::budget::RewriteBudget;
use super::columns::{self, ChosenColumn, SourceColumn, SourceColumns, refused};
use super::tree;
use crate::Error;

/// Maximum number of columns that a condition is repeated for: the repetitions are one chain of AND.
const MOST_CONDITIONS: usize = 300;

/// Writes out the select lists and conditions of a query whose tables have these columns.
pub(super) struct SelectExpansion<'a> {
    pub(super) source: &'a SourceColumns,
    pub(super) state: &'a SessionState,
    pub(super) budget: &'a mut RewriteBudget,
    /// The statement's text, for places of errors.
    pub(super) sql: &'a str,
}

/// Returns whether a select has something to write out.
pub(super) fn is_expandable(select: &Select) -> bool {
    let has_columns = |expr: &Expr| !columns::calls(expr).is_empty();
    let is_expandable = |item: &SelectItem| match item {
        SelectItem::UnnamedExpr(expr) | SelectItem::ExprWithAlias { expr, .. } => has_columns(expr),
        SelectItem::Wildcard(options) => options.opt_rename.is_some(),
        SelectItem::QualifiedWildcard(kind, options) => options.opt_rename.is_some() || is_struct(select, kind),
        SelectItem::ExprWithAliases { .. } => false,
    };
    let conditions = [&select.selection, &select.having, &select.qualify];
    select.projection.iter().any(is_expandable) || conditions.into_iter().flatten().any(has_columns)
}

// `s.*` of something that is no table.
fn is_struct(select: &Select, kind: &SelectItemQualifiedWildcardKind) -> bool {
    let SelectItemQualifiedWildcardKind::ObjectName(name) = kind else { return false };
    let [part] = name.0.as_slice() else { return false };
    let Some(name) = part.as_ident().map(tree::normalized) else { return false };
    let tables = select
        .from
        .iter()
        .flat_map(|from| [&from.relation].into_iter().chain(from.joins.iter().map(|join| &join.relation)));
    let mut known = tables.map(table_name);
    known.all(|table| table.is_some_and(|table| table != name))
}

// None for what has tables inside.
fn table_name(factor: &TableFactor) -> Option<String> {
    match factor {
        TableFactor::Table { alias: Some(alias), .. }
        | TableFactor::Derived { alias: Some(alias), .. }
        | TableFactor::Function { alias: Some(alias), .. }
        | TableFactor::UNNEST { alias: Some(alias), .. } => Some(tree::normalized(&alias.name)),
        TableFactor::Table { name, .. } => name.0.last().and_then(|part| part.as_ident()).map(tree::normalized),
        TableFactor::Derived { .. } => Some(String::new()),
        _ => None,
    }
}

impl SelectExpansion<'_> {
    /// Writes out the select list and the conditions.
    ///
    /// # Errors
    /// [`Error::Query`] if a column is not there, or too many are.
    pub(super) fn expand(&mut self, select: &mut Select) -> Result<(), Error> {
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
            SelectItem::Wildcard(options) if options.opt_rename.is_some() => self.rename(&options, |_| true, items),
            SelectItem::QualifiedWildcard(SelectItemQualifiedWildcardKind::ObjectName(table), options)
                if options.opt_rename.is_some() =>
            {
                self.rename(&options, |column| column.is_of(&table), items)
            }
            SelectItem::QualifiedWildcard(SelectItemQualifiedWildcardKind::ObjectName(name), options)
                if !self.source.iter().any(|column| column.is_of(&name)) =>
            {
                self.budget.take_choice(self.source.len())?;
                match self.fields(&name, &options) {
                    Some(fields) => items.extend(fields),
                    None => items.push(SelectItem::QualifiedWildcard(
                        SelectItemQualifiedWildcardKind::ObjectName(name),
                        options,
                    )),
                }
                Ok(())
            }
            SelectItem::UnnamedExpr(expr) => {
                items.extend(self.copies(expr)?.into_iter().map(|(expr, _)| tree::item(expr, None)));
                Ok(())
            }
            SelectItem::ExprWithAlias { expr, alias } => {
                let copies = self.copies(expr)?;
                if copies.len() > 1 && !alias.value.contains('\\') {
                    let hint = format!("AS \"{}_\\0\", where \\0 is a column's name", alias.value);
                    return Err(refused(format!("`{alias}` would be the name of {} columns", copies.len()), hint));
                }
                let named = |(expr, column)| tree::item(expr, Some(alias_of(&alias, column)));
                items.extend(copies.into_iter().map(named));
                Ok(())
            }
            other => {
                items.push(other);
                Ok(())
            }
        }
    }

    fn expand_condition(&mut self, condition: &mut Expr) -> Result<(), Error> {
        let copies = self.copies(condition.clone())?;
        if copies.len() > MOST_CONDITIONS {
            let hint = "a regular expression that fewer columns match".to_owned();
            return Err(refused(format!("more than {MOST_CONDITIONS} columns in a condition"), hint));
        }
        if let Some(all) = copies.into_iter().map(|(expr, _)| expr).reduce(tree::and) {
            *condition = all;
        }
        Ok(())
    }

    // One copy of an expression for each column that its `COLUMNS` choose; all must choose the same.
    fn copies(&mut self, expr: Expr) -> Result<Vec<(Expr, Option<ChosenColumn>)>, Error> {
        let calls = columns::calls(&expr);
        let mut first: Option<Vec<ChosenColumn>> = None;
        for call in &calls {
            let chosen = self.source.chosen(call, self.state, self.budget);
            let chosen = chosen.map_err(|error| error.at(self.sql, columns::place(call)))?;
            let is_same = |known: &Vec<ChosenColumn>| known.iter().map(|c| &c.name).eq(chosen.iter().map(|c| &c.name));
            if !first.as_ref().is_none_or(is_same) {
                let message = "COLUMNS of one expression choose different columns".to_owned();
                let hint = "the same COLUMNS(...) at each place, or write the columns out".to_owned();
                return Err(refused(message, hint).at(self.sql, columns::place(call)));
            }
            first.get_or_insert(chosen);
        }
        let Some(first) = first else { return Ok(vec![(expr, None)]) };
        self.budget.take_copies(&expr, first.len())?;
        let copy = |column: &ChosenColumn| {
            let mut copy = expr.clone();
            columns::replace(&mut copy, vec![column.expr.clone(); calls.len()]);
            (copy, Some(column.clone()))
        };
        Ok(first.iter().map(copy).collect())
    }

    fn rename(
        &mut self,
        options: &WildcardAdditionalOptions,
        is_wanted: impl Fn(&SourceColumn) -> bool,
        items: &mut Vec<SelectItem>,
    ) -> Result<(), Error> {
        self.budget.take_choice(self.source.len())?;
        let renamed: Vec<_> = match &options.opt_rename {
            Some(RenameSelectItem::Single(one)) => vec![one],
            Some(RenameSelectItem::Multiple(many)) => many.iter().collect(),
            None => Vec::new(),
        };
        let excluded = columns::excluded(options);
        let replaced = options.opt_replace.iter().flat_map(|replace| &replace.items);
        let replaced: Vec<_> =
            replaced.map(|element| (tree::normalized(&element.column_name), &element.expr)).collect();
        let names = renamed.iter().map(|one| tree::normalized(&one.ident));
        let left: Vec<_> = names.chain(replaced.iter().map(|(name, _)| name.clone())).collect();
        self.source.check_names(excluded.iter().chain(&left))?;
        if let Some(name) = left.iter().find(|name| excluded.contains(name)) {
            let hint = format!("EXCLUDE without `{name}`, or only EXCLUDE");
            return Err(refused(format!("`{name}` is left out and has a new name or value"), hint));
        }
        for column in self.source.iter().filter(|c| is_wanted(c) && !excluded.contains(&c.name)) {
            let alias = renamed.iter().find(|one| tree::normalized(&one.ident) == column.name);
            let alias = alias.map(|one| tree::quoted(&tree::normalized(&one.alias)));
            let replacement = replaced.iter().find(|(name, _)| *name == column.name);
            items.push(match replacement {
                Some((name, expr)) => tree::item((*expr).clone(), Some(alias.unwrap_or_else(|| tree::quoted(name)))),
                None => tree::item(column.expr(), alias),
            });
        }
        Ok(())
    }

    // None if it is no struct, or has options that the planner refuses.
    fn fields(&self, name: &ObjectName, options: &WildcardAdditionalOptions) -> Option<Vec<SelectItem>> {
        if !columns::is_plain(options) {
            return None;
        }
        let name = name.0.last().and_then(|part| part.as_ident()).map(tree::normalized)?;
        let column = self.source.iter().find(|column| column.name == name)?;
        let DataType::Struct(fields) = &column.data_type else { return None };
        let field = |field: &str| tree::item(tree::field(column.expr(), field), Some(tree::quoted(field)));
        Some(fields.iter().map(|f| field(f.name())).collect())
    }
}

// `\0` is the match, `\1` to `\9` are the groups of a regular expression; without one, `\0` is the column's name.
fn alias_of(alias: &Ident, column: Option<ChosenColumn>) -> Ident {
    let Some(column) = column.filter(|_| alias.value.contains('\\')) else { return alias.clone() };
    let mut name = tree::normalized(alias);
    for digit in 0..10 {
        let group = column.groups.get(digit).map_or("", String::as_str);
        let group = if digit == 0 && column.groups.is_empty() { &column.name } else { group };
        name = name.replace(&format!("\\{digit}"), group);
    }
    tree::quoted(&name)
}
