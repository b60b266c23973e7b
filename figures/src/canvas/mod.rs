//! Drawing and writing of figures: shapes, colours and texts, plots around them, and the files they become.

pub(crate) mod colours;
pub(crate) mod drawing;
pub(crate) mod font;
pub(crate) mod frame;
pub(crate) mod notes;
mod output;
pub(crate) mod picture;
