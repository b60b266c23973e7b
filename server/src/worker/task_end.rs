//! Calls of a worker: computed on threads of their own, and each task ended with the call by which it was sent, however that
//! ends: an engine holds it open while its query runs.

use std::pin::Pin;
use std::task::{Context, Poll};

use axum::body::{Body, Bytes, HttpBody};
use axum::extract::{Request, State};
use axum::middleware::Next;
use axum::response::Response;
use echolake_query::{SpreadTasks, TASK_HEADER, TaskLease};
use hyper::body::{Frame, SizeHint};
use tokio::runtime::Handle;
use tonic::Status;

/// The end of the path of the call that sends a task.
const TASK_CALL: &str = "/CoordinatorChannel";

/// State of calls beside their request.
#[derive(Clone)]
pub(super) struct WorkerCalls {
    pub(super) tasks: SpreadTasks,
    /// The threads that compute. Those that serve connections never do, or they would not hear that a query is over.
    pub(super) threads: Handle,
}

/// Runs a call on the threads that compute. One that sends a task is numbered, and ends the task when its answer is over or
/// nobody listens to it any more.
pub(super) async fn run_call(State(calls): State<WorkerCalls>, mut request: Request, next: Next) -> Response {
    let lease = request.uri().path().ends_with(TASK_CALL).then(|| calls.tasks.begin());
    request.headers_mut().remove(TASK_HEADER);
    if let Some(lease) = &lease {
        request.headers_mut().insert(TASK_HEADER, lease.header());
    }
    match (calls.threads.spawn(next.run(request)).await, lease) {
        (Ok(answer), Some(lease)) => answer.map(|body| Body::new(TaskAnswer { body, _lease: lease })),
        (Ok(answer), None) => answer,
        // It panicked, which ends the process; or the worker is stopping.
        (Err(_), _) => Status::unavailable("the worker is stopping").into_http(),
    }
}

/// The answer of such a call.
struct TaskAnswer {
    body: Body,
    _lease: TaskLease,
}

impl HttpBody for TaskAnswer {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(context)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}
