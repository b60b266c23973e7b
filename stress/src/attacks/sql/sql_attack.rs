//! A hostile statement, and how long ones are made.

/// A hostile statement.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SqlAttack {
    pub name: &'static str,
    /// Makes the statement.
    pub text: fn() -> String,
}

pub(super) const fn define_attack(name: &'static str, text: fn() -> String) -> SqlAttack {
    SqlAttack { name, text }
}

/// Repeats a text that may contain its number as `{}`.
pub(super) fn repeat_numbered(text: &str, between: &str, count: usize) -> String {
    (0..count).map(|number| text.replace("{}", &number.to_string())).collect::<Vec<_>>().join(between)
}

/// Puts an expression into so many brackets: `open`, the expression, `close`.
pub(super) fn nest_expression(open: &str, inner: &str, close: &str, depth: usize) -> String {
    [&open.repeat(depth), inner, &close.repeat(depth)].concat()
}

/// A chain of queries, each of which selects from the one before: `first`, and so many times `columns`.
pub(super) fn query_chain(first: &str, columns: &str, count: usize) -> String {
    let mut steps = vec![format!("t0 as ({first})")];
    steps.extend((0..count).map(|step| format!("t{} as (select {columns} from t{step})", step + 1)));
    format!("with {} select * from t{count}", steps.join(", "))
}
