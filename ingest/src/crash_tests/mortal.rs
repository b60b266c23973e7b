//! A store that dies at one of its writes, for crash tests.

use std::sync::atomic::{AtomicUsize, Ordering};

use echolake_testing::{RequestFate, RequestKind, StoreBehaviour};
use object_store::Error as StoreError;
use object_store::path::Path;

/// The moment of a store's death.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DeathMoment {
    /// The write is not made.
    Before,
    /// The write is made, and its author gets an error.
    After,
}

/// A store dies at its nth write; all later writes fail.
#[derive(Debug)]
pub(crate) struct MortalStore {
    writes: AtomicUsize,
    last: usize,
    death: DeathMoment,
}

impl MortalStore {
    pub fn new(last: usize, death: DeathMoment) -> Self {
        Self { writes: AtomicUsize::new(0), last, death }
    }

    /// Returns whether the store has died.
    pub fn has_died(&self) -> bool {
        self.writes.load(Ordering::SeqCst) > self.last
    }
}

impl StoreBehaviour for MortalStore {
    fn decide_fate(&self, kind: RequestKind, _: Option<&Path>) -> RequestFate {
        if !kind.is_write() {
            return RequestFate::Done;
        }
        let number = self.writes.fetch_add(1, Ordering::SeqCst);
        let dead = StoreError::Generic { store: "Mortal", source: "the power is gone".into() };
        match self.death {
            _ if number < self.last => RequestFate::Done,
            DeathMoment::After if number == self.last => RequestFate::AnswerLost(dead),
            _ => RequestFate::Refused(dead),
        }
    }
}
