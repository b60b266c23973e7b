//! Lines that an engine writes to standard output, for its door.

use std::io::Write as _;
use std::sync::{Mutex, PoisonError};

use echolake_lake::CacheCounts;
use echolake_query::{SpreadCounts, WorkerState};
use serde::{Deserialize, Serialize};

use crate::activity::{ActivityTable, LakeFigures, QueryEnd, QueryStart};
use crate::fault::{FaultCode, RequestFault};

/// A line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EngineReport {
    /// It has read the lake and can be asked.
    Ready,
    /// It ends itself.
    Ending(EngineEnd),
    /// A query begins.
    Started(QueryStart),
    /// A query has ended.
    Ended(QueryEnd),
    /// A request failed.
    Failure(FaultCode),
    /// State of the lake; None if it cannot be read.
    Lake(Option<LakeFigures>),
    /// Counts of its cache of an object store since the last such line.
    Cache(CacheCounts),
    /// Queries over workers since the last such line, and the workers as they were when it last asked them.
    Workers {
        /// The queries.
        counts: SpreadCounts,
        /// The workers.
        workers: Vec<WorkerState>,
    },
    /// It asks for rows of a table of the server's activity.
    Ask {
        /// Number of the answer.
        number: u64,
        /// The table.
        table: ActivityTable,
        /// Name of the client whose rows they are.
        client: String,
        /// Whether the client may see other clients' rows, without their texts.
        sees_all: bool,
    },
}

/// Why an engine ends itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EngineEnd {
    /// The reason, for people.
    pub reason: String,
    /// Whose statement it ends for.
    pub culprit: Option<EngineCulprit>,
}

/// Whose statement has ended an engine.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct EngineCulprit {
    /// Name of its client.
    pub client: String,
    /// The door's number of its request or connection.
    pub request: Option<u64>,
}

/// Lines that wait to be written.
static QUEUED: Mutex<Vec<u8>> = Mutex::new(Vec::new());

impl EngineReport {
    /// Writes the line, and those that wait before it.
    pub fn send_line(&self) {
        self.queue_line();
        Self::send_queued();
    }

    /// Lets the line wait for [`EngineReport::send_queued`]: a write for each of a thousand queries a second would slow
    /// them down.
    pub(crate) fn queue_line(&self) {
        let mut queued = QUEUED.lock().unwrap_or_else(PoisonError::into_inner);
        let whole = queued.len();
        match serde_json::to_writer(&mut *queued, self) {
            Ok(()) => queued.push(b'\n'),
            Err(_) => queued.truncate(whole),
        }
    }

    /// Reports a failed request, and writes it to the log.
    pub fn record_failure(fault: &RequestFault) {
        Self::Failure(fault.code()).queue_line();
        fault.log_failure();
    }

    /// Writes the lines that wait.
    pub fn send_queued() {
        // Held while it is written, so that lines stay in order.
        let mut queued = QUEUED.lock().unwrap_or_else(PoisonError::into_inner);
        if !queued.is_empty() {
            let mut stdout = std::io::stdout().lock();
            // If the door is gone, standard input ends too, and the engine with it.
            let _ = stdout.write_all(&queued).and_then(|()| stdout.flush());
            queued.clear();
        }
    }
}
