//! Statements as Postgres' clients write them: queries are planned, what changes nothing is known, all else is refused.

use std::sync::Arc;

use datafusion::sql::parser::Statement as Parsed;
use datafusion::sql::sqlparser::ast::{
    CloseCursor, Declare, DeclareType, DiscardObject, Expr, FetchDirection, Ident, ObjectName, Reset, Set,
    Statement as Sql, Value, ValueWithSpan,
};
use datafusion::sql::sqlparser::dialect::PostgreSqlDialect;
use datafusion::sql::sqlparser::parser::Parser;
use datafusion_pg_catalog::sql::PostgresCompatibilityParser;
use echolake_query::{Error as QueryError, OpaqueValue, PreparedQuery, Session, check_statement_bounds};
use echolake_service::RequestFault;

use super::catalog_statement::{EmptyRelations, adapt_catalog_statement, find_catalog_names};
use super::columns::adapt_columns;
use super::copy::{CopyForm, read_copy};

/// Statements of one text at most.
const TOGETHER: usize = 100;
/// A statement that the parser does not know, and the same in other words.
const ABORT: &str = "abort";
const ROLLBACK: &str = "rollback";

/// A planned query.
pub(super) struct PlannedQuery {
    pub prepared: Arc<PreparedQuery>,
    statement: OpaqueValue<Parsed>,
    sql: Arc<str>,
}

impl PlannedQuery {
    async fn new(session: &Session, sql: &Arc<str>, statement: Parsed) -> Result<Arc<Self>, RequestFault> {
        let prepared = Arc::new(session.prepare_statement(sql, statement.clone()).await?);
        Ok(Arc::new(Self { prepared, statement: OpaqueValue::new(statement), sql: sql.clone() }))
    }

    /// Its plan on the present lake: the first one, or another if the lake has changed since.
    pub async fn current_plan(&self, session: &Session) -> Result<Arc<PreparedQuery>, QueryError> {
        if session.is_current(&self.prepared).await? {
            return Ok(self.prepared.clone());
        }
        Ok(Arc::new(session.prepare_statement(&self.sql, Parsed::clone(&self.statement)).await?))
    }
}

/// A statement that a client may run.
#[derive(Clone)]
pub(super) enum ClientStatement {
    Query(Arc<PlannedQuery>),
    Copy(Arc<PlannedQuery>, CopyForm),
    Declare {
        name: String,
        planned: Arc<PlannedQuery>,
        held: bool,
    },
    /// None for all rows that are left.
    Fetch {
        name: String,
        rows: Option<u64>,
    },
    /// None for all cursors, and so below for settings and prepared statements.
    Close(Option<String>),
    Begin,
    Commit,
    Rollback,
    /// Savepoints: there is nothing to go back from.
    Savepoint(&'static str),
    Set(Vec<(String, String)>),
    Reset(Option<String>),
    Show(Option<String>),
    Discard(DiscardObject),
    Deallocate(Option<String>),
    /// Nobody can LISTEN.
    Unlisten,
}

/// Parses the statements of a text. Those about the server alone are adapted, all others stay as they are written, but
/// for what [`adapt_columns`] adds.
pub(super) fn parse_statements(
    parser: &PostgresCompatibilityParser,
    empty: &EmptyRelations,
    session: &Session,
    sql: &str,
) -> Result<Vec<Parsed>, RequestFault> {
    check_statement_bounds(sql, &PostgreSqlDialect {})?;
    let sql = if sql.trim_end_matches([' ', ';']).eq_ignore_ascii_case(ABORT) { ROLLBACK } else { sql };
    // DataFusion's own parser knows more, such as DESCRIBE, and gives the position of an error.
    let Ok(mut statements) = Parser::parse_sql(&PostgreSqlDialect {}, sql) else {
        return Ok(vec![session.parse_sql(sql)?]);
    };
    if statements.len() > TOGETHER {
        return Err(RequestFault::TooMany { what: "statements in one text", limit: TOGETHER });
    }
    if let Some(replaced) = replace_queries(parser, sql, &mut statements) {
        statements = replaced;
    }
    Ok(statements.into_iter().map(|statement| adapt_statement(statement, empty)).collect())
}

fn adapt_statement(mut statement: Sql, empty: &EmptyRelations) -> Parsed {
    adapt_columns(&mut statement);
    if let Some(names) = find_catalog_names(&mut statement) {
        statement = adapt_catalog_statement(statement, names, empty);
    }
    Parsed::Statement(Box::new(statement))
}

// The statements of a text about the server, if it is one of the queries that the library replaces as a whole: what
// comes of its text is something else than what its rules make of its statements.
fn replace_queries(parser: &PostgresCompatibilityParser, sql: &str, written: &mut [Sql]) -> Option<Vec<Sql>> {
    if !written.iter_mut().all(|statement| find_catalog_names(statement).is_some()) {
        return None;
    }
    let by_rules: Vec<_> = written.iter().cloned().map(|statement| parser.rewrite(statement)).collect();
    parser.parse(sql).ok().filter(|replaced| *replaced != by_rules)
}

/// Makes of a statement what can be done.
pub(super) async fn plan_statement(
    session: &Session,
    sql: &Arc<str>,
    parsed: Parsed,
) -> Result<ClientStatement, RequestFault> {
    let query = async |statement: Parsed| PlannedQuery::new(session, sql, statement).await;
    let statement = match parsed {
        Parsed::Statement(statement) => *statement,
        other => return Ok(ClientStatement::Query(query(other).await?)),
    };
    Ok(match statement {
        Sql::StartTransaction { statements, .. } if statements.is_empty() => ClientStatement::Begin,
        Sql::Commit { .. } => ClientStatement::Commit,
        Sql::Rollback { savepoint: None, .. } => ClientStatement::Rollback,
        Sql::Rollback { .. } => ClientStatement::Savepoint("ROLLBACK"),
        Sql::Savepoint { .. } => ClientStatement::Savepoint("SAVEPOINT"),
        Sql::ReleaseSavepoint { .. } => ClientStatement::Savepoint("RELEASE"),
        Sql::Set(set) => ClientStatement::Set(assigned_settings(set)?),
        Sql::Reset(reset) => ClientStatement::Reset(match reset.reset {
            Reset::ALL => None,
            Reset::ConfigurationParameter(name) => Some(name.to_string()),
        }),
        Sql::ShowVariable { variable } => ClientStatement::Show(shown_setting(&variable)),
        Sql::Discard { object_type } => ClientStatement::Discard(object_type),
        Sql::UNLISTEN { .. } => ClientStatement::Unlisten,
        Sql::Deallocate { name, .. } => ClientStatement::Deallocate(unless_all(&name)),
        Sql::Declare { stmts } => {
            let (name, held, asked) = declared_cursor(stmts)?;
            ClientStatement::Declare { name, held, planned: query(asked).await? }
        }
        Sql::Fetch { name, direction, .. } => {
            ClientStatement::Fetch { name: name.value, rows: fetch_count(&direction)? }
        }
        Sql::Close { cursor: CloseCursor::All } => ClientStatement::Close(None),
        Sql::Close { cursor: CloseCursor::Specific { name } } => ClientStatement::Close(Some(name.value)),
        Sql::Copy { source, to: true, target, options, legacy_options, .. } => {
            let (asked, form) = read_copy(source, &target, options, legacy_options)?;
            ClientStatement::Copy(query(Parsed::Statement(Box::new(asked))).await?, form)
        }
        other => ClientStatement::Query(query(Parsed::Statement(Box::new(other))).await?),
    })
}

fn unless_all(name: &Ident) -> Option<String> {
    let all = name.quote_style.is_none() && name.value.eq_ignore_ascii_case("all");
    (!all).then(|| name.value.clone())
}

// SHOW TRANSACTION ISOLATION LEVEL and SHOW TIME ZONE have names of their own.
fn shown_setting(variable: &[Ident]) -> Option<String> {
    let words: Vec<_> = variable.iter().map(|i| i.value.to_ascii_lowercase()).collect();
    match words.join(" ").as_str() {
        "all" => None,
        "transaction isolation level" => Some("transaction_isolation".to_owned()),
        "time zone" => Some("timezone".to_owned()),
        "session authorization" => Some("session_authorization".to_owned()),
        _ => Some(words.join(".")),
    }
}

fn assigned_settings(set: Set) -> Result<Vec<(String, String)>, RequestFault> {
    match set {
        Set::SingleAssignment { variable, values, .. } => Ok(vec![(join_name(&variable), setting_value(&values)?)]),
        Set::SetTimeZone { value, .. } => Ok(vec![("timezone".to_owned(), setting_value(&[value])?)]),
        Set::SetNames { charset_name, .. } => Ok(vec![("client_encoding".to_owned(), charset_name.value)]),
        // All transactions read, and see what is there when each of their queries begins.
        Set::SetTransaction { .. } => Ok(Vec::new()),
        other => Err(RequestFault::unsupported(format!("`{other}`"))),
    }
}

fn join_name(name: &ObjectName) -> String {
    let parts = name.0.iter().map(|p| p.as_ident().map_or_else(|| p.to_string(), |i| i.value.clone()));
    parts.collect::<Vec<_>>().join(".")
}

fn setting_value(values: &[Expr]) -> Result<String, RequestFault> {
    let one = |value: &Expr| match value {
        Expr::Value(ValueWithSpan { value: Value::SingleQuotedString(text), .. }) => Ok(text.clone()),
        Expr::Value(value) => Ok(value.to_string()),
        Expr::Identifier(word) => Ok(word.value.clone()),
        Expr::UnaryOp { .. } | Expr::Interval(_) => Ok(value.to_string()),
        other => Err(RequestFault::bad_request(format!("`{other}` is no value of a setting"))),
    };
    Ok(values.iter().map(one).collect::<Result<Vec<_>, _>>()?.join(", "))
}

fn declared_cursor(mut statements: Vec<Declare>) -> Result<(String, bool, Parsed), RequestFault> {
    let refused = || RequestFault::unsupported("DECLARE of anything but one cursor");
    let (Some(declare), true) = (statements.pop(), statements.is_empty()) else { return Err(refused()) };
    let (Some(name), Some(query), Some(DeclareType::Cursor)) =
        (declare.names.first(), declare.for_query, declare.declare_type)
    else {
        return Err(refused());
    };
    if declare.scroll == Some(true) {
        return Err(RequestFault::unsupported("a cursor that goes back (SCROLL)"));
    }
    let statement = Parsed::Statement(Box::new(Sql::Query(query)));
    Ok((name.value.clone(), declare.hold == Some(true), statement))
}

fn fetch_count(direction: &FetchDirection) -> Result<Option<u64>, RequestFault> {
    let count = |limit: &ValueWithSpan| {
        limit
            .to_string()
            .parse()
            .map_err(|_| RequestFault::bad_request(format!("`{limit}` is no number of rows to go forward")))
    };
    match direction {
        FetchDirection::Next | FetchDirection::Forward { limit: None } => Ok(Some(1)),
        FetchDirection::Count { limit } | FetchDirection::Forward { limit: Some(limit) } => count(limit).map(Some),
        FetchDirection::All | FetchDirection::ForwardAll => Ok(None),
        other => Err(RequestFault::unsupported(format!("FETCH {other}"))),
    }
}
