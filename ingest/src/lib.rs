//! From a run's MCAP file to rows.
