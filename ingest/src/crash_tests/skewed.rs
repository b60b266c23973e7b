//! A store as a machine whose clock is wrong writes to it, and whose commits of `runs` are preceded by others' work.

use std::fmt;
use std::sync::Arc;

use async_trait::async_trait;
use chrono::TimeDelta;
use echolake_testing::StoreBehaviour;
use futures::future::BoxFuture;
use object_store::path::Path;
use object_store::{PutOptions, PutPayload};
use serde_json::Value;

/// Work of another machine, done before each commit of `runs`.
pub(crate) type Interlude = Arc<dyn Fn() -> BoxFuture<'static, ()> + Send + Sync>;

/// A store whose commits have the times of a skewed clock.
pub(crate) struct SkewedStore {
    pub skew: TimeDelta,
    pub interlude: Option<Interlude>,
}

impl SkewedStore {
    fn shift_times(&self, commit: &[u8]) -> Vec<u8> {
        let mut shifted = Vec::new();
        for line in commit.split(|b| *b == b'\n').filter(|line| !line.is_empty()) {
            let mut line: Value = serde_json::from_slice(line).expect("an action");
            for action in line.as_object_mut().expect("an object").values_mut() {
                for name in ["timestamp", "modificationTime", "deletionTimestamp", "createdTime"] {
                    if let Some(time) = action.get_mut(name) {
                        *time = (time.as_i64().expect("a time") + self.skew.num_milliseconds()).into();
                    }
                }
            }
            shifted.extend(serde_json::to_vec(&line).expect("JSON"));
            shifted.push(b'\n');
        }
        shifted
    }
}

impl fmt::Debug for SkewedStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SkewedStore").field("skew", &self.skew).finish_non_exhaustive()
    }
}

#[async_trait]
impl StoreBehaviour for SkewedStore {
    async fn change_put(&self, path: &Path, payload: PutPayload, _: &mut PutOptions) -> PutPayload {
        if !path.as_ref().contains("/_delta_log/") || path.extension() != Some("json") {
            return payload;
        }
        if let Some(interlude) = self.interlude.as_ref().filter(|_| path.as_ref().starts_with("tables/runs/")) {
            interlude().await;
        }
        let bytes: Vec<u8> = payload.iter().flatten().copied().collect();
        self.shift_times(&bytes).into()
    }
}
