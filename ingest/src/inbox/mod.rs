//! Places of run files: new ones in `inbox/`, ingested ones under `runs/`, refused ones under `quarantine/`.

mod file_state;
mod pending_files;
mod quarantine;
mod reading_mark;
mod run_place;
mod run_source;

pub(crate) use file_state::{FileVersion, ReadFile, check_unchanged};
pub use pending_files::{
    PendingFiles, RecordingState, UnfinishedRecording, find_runs, list_arrivals, list_pending, pending_runs, rig_of_run,
};
pub(crate) use quarantine::{quarantine_file, set_file_aside};
pub(crate) use reading_mark::ReadingMark;
pub use reading_mark::SuspectFile;
pub(crate) use run_place::{delete_run, move_to_place, replace_partial};
pub(crate) use run_source::{OpenedRun, check_end, has_end_at};
pub use run_source::{RunSource, has_end};
