//! Calls of a worker: let in by the token, computed on threads of their own, and each task ended with the call by which
//! it was sent, however that ends: an engine holds it open while its query runs.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::header::AUTHORIZATION;
use axum::middleware::Next;
use axum::response::Response;
use axum::routing::get;
use axum::{Json, Router};
use http_body_util::BodyExt as _;
use subtle::ConstantTimeEq as _;
use tonic::Status;

use super::tasks::{SpreadTasks, TASK_HEADER};
use super::{WorkerFigures, WorkerToken};
use crate::control::threads::QueryThreads;

/// The path at which a worker returns its figures as JSON.
pub(super) const FIGURES_PATH: &str = "/figures";
/// The end of the path of the call that sends a task.
const TASK_CALL: &str = "/CoordinatorChannel";

/// State of calls beside their request.
pub(super) struct WorkerCalls {
    /// The header that is expected; None if all of this machine may call.
    authorization: Option<String>,
    tasks: SpreadTasks,
    /// The threads that compute. Those that serve connections never do, or they would not hear that a query is over.
    /// Plans are decoded by recursion, for which these threads have the stack.
    threads: QueryThreads,
}

impl WorkerCalls {
    pub fn new(token: Option<&WorkerToken>, tasks: SpreadTasks, threads: QueryThreads) -> Self {
        Self { authorization: token.map(WorkerToken::authorization), tasks, threads }
    }

    /// Adds the figures to a worker's routes, and all that calls need.
    pub fn complete_routes(
        self,
        routes: Router,
        figures: impl Fn() -> WorkerFigures + Clone + Send + Sync + 'static,
    ) -> Router {
        // Figures are answered while all threads compute.
        let figures = get(move || std::future::ready(Json(figures())));
        let calls = Arc::new(self);
        routes
            .layer(axum::middleware::from_fn_with_state(calls.clone(), run_call))
            .route(FIGURES_PATH, figures)
            .layer(axum::middleware::from_fn_with_state(calls, check_token))
    }
}

async fn check_token(State(calls): State<Arc<WorkerCalls>>, request: Request, next: Next) -> Response {
    let given = request.headers().get(AUTHORIZATION).map(|value| value.as_bytes());
    match (&calls.authorization, given) {
        (Some(_), None) => Status::unauthenticated("this worker needs a token; hint: --worker-token FILE").into_http(),
        (Some(expected), Some(given)) if !bool::from(given.ct_eq(expected.as_bytes())) => {
            let hint = "the token is not this worker's; hint: the same --worker-token everywhere";
            Status::unauthenticated(hint).into_http()
        }
        _ => next.run(request).await,
    }
}

// One that sends a task is numbered, and ends the task when its answer is over or nobody listens to it any more.
async fn run_call(State(calls): State<Arc<WorkerCalls>>, mut request: Request, next: Next) -> Response {
    let stopping = || Status::unavailable("the worker is stopping").into_http();
    let lease = request.uri().path().ends_with(TASK_CALL).then(|| calls.tasks.begin_task());
    request.headers_mut().remove(TASK_HEADER);
    if let Some(lease) = &lease {
        request.headers_mut().insert(TASK_HEADER, lease.header_value());
    }
    let Some(threads) = calls.threads.handle() else { return stopping() };
    match (threads.spawn(next.run(request)).await, lease) {
        (Ok(answer), Some(lease)) => answer.map(|body| {
            let held = move |frame| {
                let _ = &lease;
                frame
            };
            Body::new(body.map_frame(held))
        }),
        (Ok(answer), None) => answer,
        // It panicked, which ends the process.
        (Err(_), _) => stopping(),
    }
}
