//! Monitoring of a whole run, as opposed to one take: lasting faults, a clock that goes back, a disk that fills up.

use std::path::{Path, PathBuf};

use echolake_schema::Timestamp;

use super::Error;
use crate::disk::{folder_of, free_bytes};
use crate::run::objection::TakeObjection;

/// Pairs given up in a row before the run is: one may be bad luck, three with all their attempts are not.
const LASTING: usize = 3;

/// Monitoring state of a run.
pub(super) struct RunMonitor {
    folder: PathBuf,
    given_up: usize,
    last: Timestamp,
    free: fn(&Path) -> std::io::Result<u64>,
}

impl RunMonitor {
    /// Starts at a time, for a recording at `path`.
    pub fn new(path: &Path, last: Timestamp) -> Self {
        Self { folder: folder_of(path).to_owned(), given_up: 0, last, free: free_bytes }
    }

    /// Records that a pair was accepted.
    pub fn note_accepted(&mut self) {
        self.given_up = 0;
    }

    /// Records that a pair was given up.
    ///
    /// # Errors
    /// [`Error::Lasting`] if too many were in a row.
    pub fn given_up(&mut self, reasons: &[TakeObjection]) -> Result<(), Error> {
        self.given_up += 1;
        if self.given_up < LASTING {
            return Ok(());
        }
        let text: Vec<_> = reasons.iter().map(ToString::to_string).collect();
        let hint = reasons.first().map_or("look at the log", TakeObjection::hint);
        Err(Error::Lasting { pairs: self.given_up, reasons: text.join("; "), hint })
    }

    /// Records the time of an event.
    ///
    /// # Errors
    /// [`Error::Clock`] if it is before that of the last event.
    pub fn note_time(&mut self, now: Timestamp) -> Result<(), Error> {
        if now < self.last {
            let back_secs = (self.last.0 - now.0) as f64 / 1e9;
            return Err(Error::Clock { before: self.last, now, back_secs });
        }
        self.last = now;
        Ok(())
    }

    /// Checks that the disk has room for these bytes.
    ///
    /// # Errors
    /// [`Error::DiskNearlyFull`].
    pub fn check_disk(&self, needed: u64) -> Result<(), Error> {
        // A file system that does not report it will refuse to write in the end.
        let Ok(free) = (self.free)(&self.folder) else { return Ok(()) };
        if free >= needed {
            return Ok(());
        }
        let megabytes = |bytes: u64| bytes as f64 / 1e6;
        let free_mb = megabytes(free);
        let needed_mb = megabytes(needed);
        Err(Error::DiskNearlyFull { folder: self.folder.clone(), free_mb, needed_mb })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_bad_pair_is_luck_and_three_are_a_fault() {
        let mut watch = RunMonitor::new(Path::new("run.mcap"), Timestamp(0));
        let loud = [TakeObjection::Outside { level_db: 80.0, most_db: 65.0 }];
        assert!(watch.given_up(&loud).is_ok() && watch.given_up(&loud).is_ok());
        watch.note_accepted();
        assert!(watch.given_up(&loud).is_ok() && watch.given_up(&loud).is_ok());
        let error = watch.given_up(&loud).expect_err("the third in a row").to_string();
        assert!(
            error.contains("3 pairs") && error.contains("outside noise 80.0 dB") && error.contains("quiet"),
            "{error}"
        );
    }

    #[test]
    fn a_disk_that_fills_up_is_noticed_before_it_is_full() {
        let mut watch = RunMonitor::new(Path::new("run.mcap"), Timestamp(0));
        watch.free = |_| Ok(5_000_000);
        assert!(watch.check_disk(5_000_000).is_ok());
        let error = watch.check_disk(5_100_000).expect_err("too little").to_string();
        assert!(error.contains("5.0 MB are left, 5.1 are kept free to end the run"), "{error}");
        watch.free = |_| Err(std::io::ErrorKind::Unsupported.into());
        assert!(watch.check_disk(u64::MAX).is_ok(), "what cannot be told is no reason to stop");
    }
}
