//! What is known of one snapshot of the lake, and kept while it is the latest: its runs and files, its surfaces, their
//! positions, and answers.

pub(super) mod bands;
pub(super) mod positions;
pub(super) mod summary;
pub(super) mod view;
