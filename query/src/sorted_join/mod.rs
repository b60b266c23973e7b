//! Joins by order: range joins, and as-of joins, by a merge of both sides in the order of their keys and times.
//!
//! ```sql
//! select * from measurements m join environment e
//!     on e.run_id = m.run_id and e.log_time between m.log_time - interval '5 seconds' and m.log_time
//! select * from measurements m asof join environment e on m.run_id = e.run_id and m.log_time >= e.log_time
//! ```
//!
//! One side has one value per row, its *position* (`e.log_time`). It is the *window*. Each row of the other side, the
//! *probe*, has a range of positions: one bound or two. Both sides are sorted by the keys (`run_id`), then by the
//! position and by the bound at which the range begins, so that the ranges of later rows of the probe begin no earlier.
//! Then one pass suffices:
//!
//! ```text
//! probe, by the beginning of its ranges    [--]
//!                                             [----]
//!                                               [--]
//! window, by position                  . .  .  . . .  .  . .
//!                                      dropped ^head       not read yet
//! ```
//!
//! An as-of join is a range with one bound of which the first row of the window is taken, the nearest one; for
//! `m.log_time >= e.log_time` both sides are sorted in descending order. [`SortedJoin`] is the logical node. The syntax
//! of as-of joins makes one ([`as_of_join`](crate::statement)); of the optimizer's joins [`SortedJoinPlanner`] makes
//! those by order that [`recognition`] finds. DataFusion sorts, partitions by the keys and spills what it sorts;
//! `SortedJoinExec` ([`exec`]) merges, and reserves memory for the part of the window that it holds.

mod exec;
mod filter_rule;
mod merge;
mod node;
mod planner;
mod recognition;
mod reduction;
#[cfg(test)]
mod tests;
mod window;

pub(crate) use filter_rule::AsOfFilter;
pub(crate) use node::{JoinBound, JoinOrder, MatchedRows, SortedJoin, WindowSide};
pub(crate) use planner::SortedJoinPlanner;
pub(crate) use recognition::is_ordered_type;
