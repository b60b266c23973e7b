//! `AS OF`: past versions of tables. `nce VERSION AS OF 12` becomes `"nce@12"`, a name that every parser reads and the
//! catalogue resolves.

use std::collections::BTreeSet;
use std::ops::ControlFlow;

use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::{
    Expr, Ident, ObjectName, ObjectNamePart, TableAlias, TableFactor, TableVersion, Value, ValueWithSpan, Visitor,
};
use echolake_lake::LakeMoment;

use super::syntax_walk::walk_syntax;
use super::tree;
use crate::Error;

/// Separator between a table's name and the moment.
const MARK: char = '@';
/// The forms of `AS OF`.
const FORMS: &str = "VERSION AS OF 12, or TIMESTAMP AS OF '2026-11-21T10:00:00Z' (without a zone it is UTC) or 'tag'";

/// A table or view at a moment.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct PastTableName {
    /// Its name as the query has it, `nce@12`.
    pub name: String,
    /// The name of the table.
    pub table: String,
    /// The moment, as text.
    pub at: String,
}

impl PastTableName {
    /// Reads the name and version of a table in FROM; None if it is the table as it is now.
    fn from_table(name: &ObjectName, version: Option<&TableVersion>) -> Result<Option<Self>, Error> {
        let Some(ObjectNamePart::Identifier(ident)) = name.0.last() else { return Ok(None) };
        let Some(version) = version else {
            let parts = ident.value.split_once(MARK);
            return Ok(parts.map(|(table, at)| Self {
                name: ident.value.clone(),
                table: table.to_owned(),
                at: at.to_owned(),
            }));
        };
        let table = tree::normalized_name(ident);
        let at = version_text(version).ok_or_else(|| not_a_moment(&version.to_string()))?.to_owned();
        Ok(Some(Self { name: format!("{table}{MARK}{at}"), table, at }))
    }

    /// Parses the moment.
    ///
    /// # Errors
    /// [`Error::Query`] if it is neither a version, a time, nor the name of a tag.
    pub fn parse_moment(&self) -> Result<LakeMoment, Error> {
        self.at.parse().map_err(|_| not_a_moment(&self.at))
    }
}

/// Returns the past tables that a statement names.
///
/// # Errors
/// [`Error::Query`] if an `AS OF` has no literal.
pub(crate) fn find_past_tables(statement: &Statement) -> Result<BTreeSet<PastTableName>, Error> {
    match statement {
        Statement::Statement(sql) => {
            let mut found = PastTableVisitor(BTreeSet::new());
            match walk_syntax(sql.as_ref(), &mut found) {
                ControlFlow::Break(error) => Err(*error),
                ControlFlow::Continue(()) => Ok(found.0),
            }
        }
        Statement::Explain(explain) => find_past_tables(&explain.statement),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => Ok(BTreeSet::new()),
    }
}

/// Replaces the `AS OF` of a table in FROM by the name of the past table. Without an alias it gets its plain name as
/// alias, so that `nce.pair_id` refers to it.
///
/// # Errors
/// [`Error::Query`] if the `AS OF` has no literal.
pub(super) fn rewrite_as_of(factor: &mut TableFactor) -> Result<(), Error> {
    let TableFactor::Table { name, version, alias, .. } = factor else { return Ok(()) };
    let Some(past) = PastTableName::from_table(name, version.take().as_ref())? else { return Ok(()) };
    if let Some(ObjectNamePart::Identifier(ident)) = name.0.last_mut() {
        ident.value = past.name;
        ident.quote_style = Some('"');
    }
    let table = Ident::with_quote('"', past.table);
    alias.get_or_insert_with(|| TableAlias { explicit: true, name: table, columns: Vec::new(), at: None });
    Ok(())
}

struct PastTableVisitor(BTreeSet<PastTableName>);

impl Visitor for PastTableVisitor {
    type Break = Box<Error>;

    // `DESCRIBE "nce@12"` has no table factor.
    fn pre_visit_relation(&mut self, relation: &ObjectName) -> ControlFlow<Box<Error>> {
        self.add_table(relation, None)
    }

    fn pre_visit_table_factor(&mut self, factor: &TableFactor) -> ControlFlow<Box<Error>> {
        match factor {
            TableFactor::Table { name, version: Some(version), .. } => self.add_table(name, Some(version)),
            _ => ControlFlow::Continue(()),
        }
    }
}

impl PastTableVisitor {
    fn add_table(&mut self, name: &ObjectName, version: Option<&TableVersion>) -> ControlFlow<Box<Error>> {
        match PastTableName::from_table(name, version) {
            Ok(past) => self.0.extend(past),
            Err(error) => return ControlFlow::Break(Box::new(error)),
        }
        ControlFlow::Continue(())
    }
}

fn version_text(version: &TableVersion) -> Option<&str> {
    match version {
        TableVersion::VersionAsOf(Expr::Value(ValueWithSpan { value: Value::Number(text, _), .. }))
        | TableVersion::TimestampAsOf(Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. }))
        | TableVersion::ForSystemTimeAsOf(Expr::Value(ValueWithSpan {
            value: Value::SingleQuotedString(text), ..
        })) => Some(text),
        _ => None,
    }
}

fn not_a_moment(text: &str) -> Error {
    let message = format!("`{text}` is neither a version, a time, nor the name of a tag");
    Error::Query { message, place: None, hint: Some(FORMS.to_owned()) }
}
