//! The list of acknowledged attempts, for other programs: one line per attempt, written once it is synced to disk.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::Path;

use anyhow::Context as _;
use echolake_acquisition::run::controller::RunEvent;
use echolake_schema::messages::Verdict;

/// An open list.
pub(super) struct AcknowledgementWriter {
    out: AcknowledgementTarget,
}

enum AcknowledgementTarget {
    Stdout,
    File(File),
}

impl AcknowledgementWriter {
    /// Opens the list for more lines; `-` is stdout.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        if path == Path::new("-") {
            return Ok(Self { out: AcknowledgementTarget::Stdout });
        }
        let file = OpenOptions::new().create(true).append(true).open(path);
        Ok(Self {
            out: AcknowledgementTarget::File(file.with_context(|| format!("cannot write `{}`", path.display()))?),
        })
    }

    /// Writes the attempts that are safe on the disk.
    pub fn observe_event(&mut self, event: &RunEvent<'_>) {
        let RunEvent::Safe { verdicts, .. } = event else { return };
        let mut lines = String::new();
        for m in *verdicts {
            let verdict = match m.verdict() {
                Verdict::Accepted => "accepted",
                Verdict::Repeated => "repeated",
                Verdict::Rejected => "rejected",
                Verdict::Unspecified => "unknown",
            };
            lines.push_str(&format!("{} {} {verdict} {:.1}\n", m.pair_id, m.attempt, m.snr_db));
        }
        let written = match &mut self.out {
            AcknowledgementTarget::Stdout => io::stdout().lock().write_all(lines.as_bytes()),
            AcknowledgementTarget::File(file) => file.write_all(lines.as_bytes()),
        };
        // The run is worth more than the list; its readers take a missing attempt for one that was not measured.
        if let Err(error) = written {
            eprintln!("warning: cannot write the list of acknowledged attempts: {error}");
        }
    }
}
