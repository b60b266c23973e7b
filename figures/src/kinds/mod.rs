//! The kinds of figures, each laid out as a drawing of plain data, and the table.

pub(crate) mod coverage;
pub(crate) mod filters;
pub(crate) mod grid;
pub(crate) mod growth;
pub(crate) mod levels;
pub(crate) mod map;
pub(crate) mod nce;
pub(crate) mod relief;
pub(crate) mod setup;
pub(crate) mod steps;
pub(crate) mod table;
