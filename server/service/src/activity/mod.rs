//! What a server does, as its engines and its door tell each other: queries, connections, and the state of the lake.

mod activity_rows;
mod lake_figures;
mod query_events;

pub use activity_rows::{ActivityRows, ActivityTable, LoggedQuery, OpenConnection};
pub use lake_figures::{FolderFigures, LakeFigures};
pub use query_events::{QueryEnd, QueryStart};
