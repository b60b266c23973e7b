//! Errors of a spread query that are about its workers, not about the query.

use std::error::Error as StdError;
use std::fmt;

use datafusion::error::DataFusionError;
use tonic::Status;

use super::tasks::OVER;

/// The text by which an error is known again after it has come over a worker's connection, which keeps texts alone.
const MARK: &str = "worker lost: ";
/// The beginning of a tonic status as text: one worker's error about another.
const STATUS: &str = "code: '";
/// Text of a worker whose plan never came, because its sender, or the way to it, is gone.
const NO_PLAN: &str = "timed-out while waiting for the plan";

/// A worker did not answer, or not to the end.
#[derive(Debug)]
pub(crate) struct WorkerLoss {
    message: String,
}

impl WorkerLoss {
    pub fn new(message: impl Into<String>) -> Self {
        Self { message: message.into() }
    }

    /// Returns what was lost.
    pub fn message(&self) -> &str {
        &self.message
    }

    /// Finds in the error of a spread query that a worker was lost; None if the query itself failed.
    pub fn find_in(error: &DataFusionError) -> Option<Self> {
        let root = error.find_root();
        if let DataFusionError::External(cause) = root {
            if let Some(status) = cause.downcast_ref::<Status>() {
                return Some(Self::new(status_text(status)));
            }
            let text = cause.to_string();
            if let Some((_, message)) = text.split_once(MARK) {
                return Some(Self::new(message));
            }
            if text.starts_with(STATUS) {
                return Some(Self::new(text));
            }
        }
        let text = root.to_string();
        if text.contains(NO_PLAN) {
            return Some(Self::new("a worker got no plan"));
        }
        text.contains(OVER).then(|| Self::new("the connection that holds a task open was lost"))
    }
}

// With its causes: the status alone says `transport error`.
fn status_text(status: &Status) -> String {
    let mut words = status.message().to_owned();
    let mut cause = status.source();
    while let Some(next) = cause {
        let text = next.to_string();
        if !words.contains(&text) {
            words = format!("{words}: {text}");
        }
        cause = next.source();
    }
    words
}

impl fmt::Display for WorkerLoss {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{MARK}{}", self.message)
    }
}

impl StdError for WorkerLoss {}

impl From<WorkerLoss> for DataFusionError {
    fn from(loss: WorkerLoss) -> Self {
        Self::External(Box::new(loss))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;

    #[test]
    fn losses_are_told_from_failures() {
        let status = |code| DataFusionError::External(Box::new(Status::new(code, "transport error")));
        let lost = [
            status(tonic::Code::Unavailable),
            status(tonic::Code::Unauthenticated),
            DataFusionError::Shared(Arc::new(status(tonic::Code::Unknown))),
            WorkerLoss::new("gone").into(),
            // As it reads after a worker's connection.
            DataFusionError::External(WorkerLoss::new("gone").to_string().into()),
            DataFusionError::External(Status::unavailable("tcp connect error").to_string().into()),
            DataFusionError::Execution(OVER.into()),
            DataFusionError::Execution("Worker::execute_task timed-out while waiting for the plan to be set".into()),
        ];
        for error in lost {
            assert!(WorkerLoss::find_in(&error).is_some(), "{error}");
        }
        for error in [
            DataFusionError::Execution("division by zero".into()),
            DataFusionError::ResourcesExhausted("no memory".into()),
            DataFusionError::External("a file is not there".into()),
        ] {
            assert!(WorkerLoss::find_in(&error).is_none(), "{error}");
        }
    }
}
