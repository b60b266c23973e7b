//! Rewrites friendly SQL, mostly DuckDB's, into SQL that DataFusion plans.
//!
//! Some syntax is read by hooks of the dialect ([`parse`]), some is rewritten in the tokens ([`tokens`]), some by its
//! shape alone ([`syntax`]), and some needs the columns of a query's tables ([`expansion`]). What remains is refused with
//! a hint.

mod aliases;
mod budget;
mod columns;
mod expansion;
pub(crate) mod hints;
pub(crate) mod parse;
mod pivot;
mod select_items;
mod syntax;
#[cfg(test)]
mod tests;
pub(crate) mod tokens;
mod tree;

pub(crate) use expansion::expand;
pub(crate) use syntax::rewrite;
