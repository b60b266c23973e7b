//! Hostile SQL, a family in each file. Statements are texts; those that are long are made when they are needed.

mod allocations;
mod expressions;
mod functions;
mod joins;
mod planning;
mod tables;
mod windows;

/// A hostile statement.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SqlAttack {
    pub(crate) name: &'static str,
    /// Makes the statement.
    pub(crate) text: fn() -> String,
}

/// The statements, by family.
pub(crate) const SQL_FAMILIES: [(&str, &[SqlAttack]); 7] = [
    ("expressions", expressions::ATTACKS),
    ("planning", planning::ATTACKS),
    ("allocations", allocations::ATTACKS),
    ("windows", windows::ATTACKS),
    ("functions", functions::ATTACKS),
    ("joins", joins::ATTACKS),
    ("tables", tables::ATTACKS),
];

const fn attack(name: &'static str, text: fn() -> String) -> SqlAttack {
    SqlAttack { name, text }
}

/// Repeats a text that may contain its number as `{}`.
fn numbered(text: &str, between: &str, count: usize) -> String {
    (0..count).map(|number| text.replace("{}", &number.to_string())).collect::<Vec<_>>().join(between)
}

/// Puts an expression into so many brackets: `open`, the expression, `close`.
fn nested(open: &str, inner: &str, close: &str, depth: usize) -> String {
    [&open.repeat(depth), inner, &close.repeat(depth)].concat()
}

/// A chain of queries, each of which selects from the one before: `first`, and so many times `columns`.
fn steps(first: &str, columns: &str, count: usize) -> String {
    let mut steps = vec![format!("t0 as ({first})")];
    steps.extend((0..count).map(|step| format!("t{} as (select {columns} from t{step})", step + 1)));
    format!("with {} select * from t{count}", steps.join(", "))
}
