//! The lake: its object store, its commit log and what a reader may see.
