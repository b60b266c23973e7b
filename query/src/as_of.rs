//! `AS OF`: past versions of tables. `nce VERSION AS OF 12` is rewritten to `"nce@12"`, which every parser accepts, and
//! the catalogue resolves such names.
//!
//! The parser supports `AS OF` in some dialects only, and the planner in none, so the text is rewritten before it is
//! parsed; the rest keeps its line and column, so that errors still point at the place.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::iter::Peekable;
use std::ops::ControlFlow;
use std::str::CharIndices;

use datafusion::sql::parser::Statement;
use datafusion::sql::sqlparser::ast::{
    Ident, ObjectName, ObjectNamePart, Statement as Sql, TableAlias, TableFactor, VisitorMut,
};
use datafusion::sql::sqlparser::dialect::GenericDialect;
use datafusion::sql::sqlparser::tokenizer::{Location, Token, TokenWithSpan, Tokenizer};
use echolake_lake::LakeMoment;

use crate::Error;
use crate::syntax_walk::walk_mut;

/// Separator between a table's name and the moment.
const MARK: char = '@';
/// A table or view at a moment.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct PastTableName {
    /// Its name as the query has it, `nce@12`.
    pub(crate) name: String,
    /// The name of the table.
    pub(crate) table: String,
    /// The moment, as text.
    pub(crate) at: String,
}

impl PastTableName {
    fn of(name: &str) -> Option<Self> {
        let (table, at) = name.split_once(MARK)?;
        Some(Self { name: name.to_owned(), table: table.to_owned(), at: at.to_owned() })
    }

    /// Parses the moment.
    ///
    /// # Errors
    /// [`Error::Query`] if it is neither a version nor a time.
    pub(crate) fn moment(&self) -> Result<LakeMoment, Error> {
        self.at.parse().map_err(|_| Error::Query {
            message: format!("`{}` is neither a version nor a time", self.at),
            place: None,
            hint: Some("VERSION AS OF 12, or TIMESTAMP AS OF '2026-11-21T10:00:00Z'; without a zone it is UTC".into()),
        })
    }
}

/// Returns the query with its `AS OF` clauses rewritten: after a table's name `[FOR] VERSION AS OF n`,
/// `[FOR] TIMESTAMP AS OF 't'` or `FOR SYSTEM_TIME AS OF 't'`.
pub(crate) fn respelled(sql: &str) -> Cow<'_, str> {
    let unchanged = Cow::Borrowed(sql);
    if !sql.as_bytes().windows(2).any(|two| two.eq_ignore_ascii_case(b"of")) {
        return unchanged;
    }
    // Invalid SQL is left to the parser's message.
    let Ok(tokens) = Tokenizer::new(&GenericDialect {}, sql).tokenize_with_location() else { return unchanged };
    let tokens: Vec<_> = tokens.into_iter().filter(|t| !matches!(t.token, Token::Whitespace(_))).collect();
    let found: Vec<_> = (0..tokens.len()).filter_map(|i| clause(&tokens, i)).collect();
    if found.is_empty() {
        return unchanged;
    }
    let mut out = String::with_capacity(sql.len() + 2);
    let (mut offsets, mut done) = (ByteOffsets::of(sql), 0);
    for AsOfClause { start, end, name } in found {
        let (from, to) = (offsets.advance(start), offsets.advance(end));
        let Some(between) = sql.get(done..from) else { continue };
        let Some(replaced) = sql.get(from..to) else { continue };
        out.push_str(between);
        fill(&mut out, &name, replaced);
        done = to;
    }
    out.push_str(&sql[done..]);
    Cow::Owned(out)
}

/// A clause `nce VERSION AS OF 12` and its replacement.
struct AsOfClause {
    start: Location,
    end: Location,
    name: String,
}

fn clause(tokens: &[TokenWithSpan], at: usize) -> Option<AsOfClause> {
    let Token::Word(table) = &tokens[at].token else { return None };
    // `FOR VERSION AS OF 3` belongs to the name before it.
    if is_word(&tokens[at], "for") {
        return None;
    }
    let mut next = at + 1;
    if is_word(tokens.get(next)?, "for") {
        next += 1;
    }
    let of_version = is_word(tokens.get(next)?, "version") || is_word(tokens.get(next)?, "system_version");
    let of_time = is_word(tokens.get(next)?, "timestamp") || is_word(tokens.get(next)?, "system_time");
    let as_of = is_word(tokens.get(next + 1)?, "as") && is_word(tokens.get(next + 2)?, "of");
    let last = tokens.get(next + 3)?;
    let moment = match &last.token {
        Token::Number(digits, _) if of_version => digits,
        Token::SingleQuotedString(text) if of_time || of_version => text,
        _ => return None,
    };
    let written = if table.quote_style.is_some() { table.value.clone() } else { table.value.to_lowercase() };
    let name = format!("\"{}{MARK}{}\"", written.replace('"', "\"\""), moment.replace('"', "\"\""));
    as_of.then(|| AsOfClause { start: tokens[at].span.start, end: last.span.end, name })
}

fn is_word(token: &TokenWithSpan, word: &str) -> bool {
    matches!(&token.token, Token::Word(w) if w.quote_style.is_none() && w.value.eq_ignore_ascii_case(word))
}

// The name is shorter than the clause; blanks fill the rest, so that the following text keeps its place.
fn fill(out: &mut String, name: &str, replaced: &str) {
    out.push_str(name);
    let blank = |c: char| if c == '\n' { '\n' } else { ' ' };
    match replaced.find('\n') {
        Some(line) => out.extend(replaced[line..].chars().map(blank)),
        None => out.extend(std::iter::repeat_n(' ', replaced.chars().count().saturating_sub(name.chars().count()))),
    }
}

/// Byte offsets of places in a text, in one pass from its start to its end.
struct ByteOffsets<'a> {
    rest: Peekable<CharIndices<'a>>,
    len: usize,
    at: Location,
}

impl<'a> ByteOffsets<'a> {
    fn of(text: &'a str) -> Self {
        Self { rest: text.char_indices().peekable(), len: text.len(), at: Location { line: 1, column: 1 } }
    }

    /// Returns the offset of a place, which must not be before the previous one.
    fn advance(&mut self, place: Location) -> usize {
        while self.at < place
            && let Some((_, c)) = self.rest.next()
        {
            match c {
                '\n' => self.at = Location { line: self.at.line + 1, column: 1 },
                _ => self.at.column += 1,
            }
        }
        self.rest.peek().map_or(self.len, |(at, _)| *at)
    }
}

/// Returns the past tables that a statement names. Each one without an alias gets its plain name as alias, so that
/// `nce.pair_id` refers to it.
pub(crate) fn named(statement: &mut Statement) -> BTreeSet<PastTableName> {
    match statement {
        Statement::Statement(sql) => named_in(sql),
        Statement::Explain(explain) => named(&mut explain.statement),
        Statement::CreateExternalTable(_) | Statement::CopyTo(_) | Statement::Reset(_) => BTreeSet::new(),
    }
}

fn named_in(sql: &mut Sql) -> BTreeSet<PastTableName> {
    let mut found = PastTableVisitor::default();
    let ControlFlow::<()>::Continue(()) = walk_mut(sql, &mut found) else { return BTreeSet::new() };
    found.0
}

#[derive(Default)]
struct PastTableVisitor(BTreeSet<PastTableName>);

impl VisitorMut for PastTableVisitor {
    type Break = ();

    fn pre_visit_relation(&mut self, relation: &mut ObjectName) -> ControlFlow<()> {
        self.0.extend(past(relation));
        ControlFlow::Continue(())
    }

    fn pre_visit_table_factor(&mut self, factor: &mut TableFactor) -> ControlFlow<()> {
        if let TableFactor::Table { name, alias: alias @ None, .. } = factor
            && let Some(past) = past(name)
        {
            let name = Ident::with_quote('"', past.table);
            *alias = Some(TableAlias { explicit: true, name, columns: Vec::new(), at: None });
        }
        ControlFlow::Continue(())
    }
}

fn past(name: &ObjectName) -> Option<PastTableName> {
    match name.0.last()? {
        ObjectNamePart::Identifier(ident) => PastTableName::of(&ident.value),
        ObjectNamePart::Function(_) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_of_is_respelled_in_place() {
        let check = |sql: &str, expected: &str| {
            let out = respelled(sql);
            let squeezed: Vec<_> = out.split_whitespace().collect();
            assert_eq!(squeezed.join(" "), expected, "{sql}");
            if !sql.contains('\n') {
                assert_eq!(out.chars().count(), sql.chars().count(), "{sql}");
            }
            assert_eq!(out.matches('\n').count(), sql.matches('\n').count(), "{sql}");
        };
        check("select * from nce version as of 12", "select * from \"nce@12\"");
        check("select é, x from NCE VERSION AS OF 12 n where 1=1", "select é, x from \"nce@12\" n where 1=1");
        check(
            "select * from runs timestamp as of '2026-11-21T10:00:00Z', tnce",
            "select * from \"runs@2026-11-21T10:00:00Z\" , tnce",
        );
        check("select * from runs for system_time as of '2026-11-21'", "select * from \"runs@2026-11-21\"");
        check("select * from public.nce\n  version as of 3\nwhere x", "select * from public.\"nce@3\" where x");
        check("select 'runs version as of 3' as of_course", "select 'runs version as of 3' as of_course");
        check("select * from a version as of version as of 3", "select * from a version as \"of@3\"");
        check("select * from a for version as of 3, b for version as of 4", "select * from \"a@3\" , \"b@4\"");
        check("select version as of from runs", "select version as of from runs");
        check("select 'broken of", "select 'broken of");
    }
}
