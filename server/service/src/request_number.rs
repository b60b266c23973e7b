//! The door's number of the request or connection that a task answers. Statements carry it, so that an engine that ends
//! names the request that it ended for.

tokio::task_local! {
    static REQUEST: Option<u64>;
}

/// Answers a request with this number.
pub async fn answer_numbered<T>(number: Option<u64>, work: impl Future<Output = T>) -> T {
    REQUEST.scope(number, work).await
}

/// Returns the number of the request that this task answers, if the door gave one.
pub(crate) fn current_request() -> Option<u64> {
    REQUEST.try_with(|number| *number).ok().flatten()
}
