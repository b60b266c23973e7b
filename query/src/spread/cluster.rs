//! The workers that an engine may ask, and which of them answer now.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use datafusion_distributed::{ChannelResolver as _, GetWorkerInfoRequest};
use futures::future::join_all;
use serde::{Deserialize, Serialize};
use url::Url;

use super::channels::{CONNECT_LIMIT, WorkerChannels};
use super::loss::WorkerLoss;
use super::{WorkerFigures, WorkerIdentity, WorkerLink};
use crate::Error;

/// Time for which a worker's answer is good.
const CHECK_LASTS: Duration = Duration::from_secs(5);

/// The workers of an engine, and when they are asked.
#[derive(Debug, Clone)]
pub struct ClusterSettings {
    /// Addresses of the workers, as `https://10.0.0.7:7070`.
    pub workers: Vec<Url>,
    /// Connection to them.
    pub link: WorkerLink,
    /// The engine's build and lake.
    pub identity: WorkerIdentity,
    /// Bytes from which a query is spread.
    pub least_bytes: u64,
}

/// Workers that run parts of heavy queries.
///
/// ```
/// use echolake_query::{ClusterSettings, WorkerCluster, WorkerIdentity, WorkerLink};
///
/// let identity = WorkerIdentity { build: "0.1.0-1a".to_owned(), lake: "lake".to_owned() };
/// let workers = vec!["http://127.0.0.1:7070".parse()?];
/// let link = WorkerLink::default();
/// let cluster = WorkerCluster::new(ClusterSettings { workers, link, identity, least_bytes: 64 << 20 })?;
/// // Nobody was asked yet.
/// assert!(cluster.workers()[0].problem.is_none());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct WorkerCluster {
    settings: ClusterSettings,
    channels: WorkerChannels,
    checks: Mutex<HashMap<Url, (Instant, WorkerStatus)>>,
    counts: Mutex<SpreadCounts>,
}

/// Queries over workers since the start of an engine.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SpreadCounts {
    /// Queries that were begun on workers.
    pub spread: u64,
    /// Queries that were begun again, on the workers that were left, because one was lost.
    pub repeated: u64,
    /// Queries that the engine ran itself after workers could not.
    pub returned: u64,
}

/// A worker as it was when it was asked last.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerStatus {
    /// Its address.
    pub url: String,
    /// Reason not to use it; None if there is none.
    pub problem: Option<String>,
    /// Its build; None if it has never answered.
    pub build: Option<String>,
    /// Time of its last answer, microseconds since 1970.
    pub last_seen: Option<i64>,
    /// Its figures then.
    pub figures: Option<WorkerFigures>,
}

impl WorkerStatus {
    fn unknown(url: &Url) -> Self {
        Self { url: url.to_string(), problem: None, build: None, last_seen: None, figures: None }
    }
}

impl WorkerCluster {
    /// Takes workers to use; it asks none of them yet.
    ///
    /// # Errors
    /// [`Error::Execution`] if the token cannot be sent.
    pub fn new(mut settings: ClusterSettings) -> Result<Self, Error> {
        // In one order everywhere, so that files stay with their workers.
        settings.workers.sort();
        settings.workers.dedup();
        let channels = WorkerChannels::new(&settings.link).map_err(|e| Error::execution(&e))?;
        Ok(Self { settings, channels, checks: Mutex::default(), counts: Mutex::default() })
    }

    /// Returns all workers as they were when they were asked last.
    pub fn workers(&self) -> Vec<WorkerStatus> {
        self.settings.workers.iter().map(|url| self.status(url)).collect()
    }

    /// Returns all workers, after asking those that were not asked for a while.
    pub(crate) async fn checked_workers(&self) -> Vec<WorkerStatus> {
        self.check_workers(CHECK_LASTS).await;
        self.workers()
    }

    /// Returns what was counted since the start.
    pub fn counts(&self) -> SpreadCounts {
        *self.counts.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn count(&self, add: impl FnOnce(&mut SpreadCounts)) {
        add(&mut self.counts.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// Returns the workers that answer, in order, after asking those that were not asked for a while.
    pub(super) async fn usable_workers(&self) -> Vec<Url> {
        self.check_workers(CHECK_LASTS).await
    }

    /// Returns the workers that answer now.
    pub(super) async fn remaining_workers(&self) -> Vec<Url> {
        self.check_workers(Duration::ZERO).await
    }

    async fn check_workers(&self, lasts: Duration) -> Vec<Url> {
        let is_old = |url: &&Url| self.checks().get(*url).is_none_or(|(at, _)| at.elapsed() >= lasts);
        let old: Vec<_> = self.settings.workers.iter().filter(is_old).collect();
        join_all(old.into_iter().map(|url| self.check_worker(url))).await;
        let checks = self.checks();
        let answers = |url: &&Url| checks.get(*url).is_some_and(|(_, status)| status.problem.is_none());
        self.settings.workers.iter().filter(answers).cloned().collect()
    }

    async fn check_worker(&self, url: &Url) {
        let before = self.status(url);
        let answer = tokio::time::timeout(CONNECT_LIMIT, self.ask_worker(url)).await;
        let status = match answer {
            Ok(Ok(status)) => status,
            Ok(Err(problem)) => WorkerStatus { problem: Some(problem), ..before.clone() },
            Err(_) => {
                let problem = format!("it did not answer within {} s", CONNECT_LIMIT.as_secs());
                WorkerStatus { problem: Some(problem), ..before.clone() }
            }
        };
        match &status.problem {
            Some(problem) if before.problem.as_ref() != Some(problem) => {
                tracing::warn!(worker = %url, problem, "a worker is not used");
            }
            None if before.problem.is_some() => tracing::info!(worker = %url, "a worker is used again"),
            _ => {}
        }
        self.checks().insert(url.clone(), (Instant::now(), status));
    }

    // The error is the reason why it does not answer.
    async fn ask_worker(&self, url: &Url) -> Result<WorkerStatus, String> {
        let answer = async {
            let mut client = self.channels.get_worker_client_for_url(url).await?;
            client.get_worker_info(GetWorkerInfoRequest {}).await
        };
        let info = answer
            .await
            .map_err(|e| WorkerLoss::find(&e).map_or_else(|| e.to_string(), |loss| loss.message().to_owned()))
            .map_err(with_hint)?;
        let other = WorkerIdentity::parse(&info.version)
            .ok_or_else(|| format!("it is no worker of echolake: it says `{}`", info.version))?;
        Ok(WorkerStatus {
            url: url.to_string(),
            problem: self.settings.identity.difference(&other),
            build: Some(other.build),
            last_seen: SystemTime::now().duration_since(UNIX_EPOCH).ok().map(|time| time.as_micros() as i64),
            figures: self.channels.figures(url).await,
        })
    }

    fn status(&self, url: &Url) -> WorkerStatus {
        self.checks().get(url).map_or_else(|| WorkerStatus::unknown(url), |(_, status)| status.clone())
    }

    pub(super) fn channels(&self) -> &WorkerChannels {
        &self.channels
    }

    pub(crate) fn least_bytes(&self) -> u64 {
        self.settings.least_bytes
    }

    pub(super) fn size(&self) -> usize {
        self.settings.workers.len()
    }

    fn checks(&self) -> MutexGuard<'_, HashMap<Url, (Instant, WorkerStatus)>> {
        self.checks.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

// Errors of encryption have one of their own.
fn with_hint(problem: String) -> String {
    match problem.contains("hint: ") {
        true => problem,
        false => {
            format!("{problem}; hint: `serve --worker` there, and https:// if it has a certificate, http:// if not")
        }
    }
}

impl SpreadCounts {
    /// Returns what was counted since `before`.
    #[must_use]
    pub fn since(&self, before: &Self) -> Self {
        Self {
            spread: self.spread.saturating_sub(before.spread),
            repeated: self.repeated.saturating_sub(before.repeated),
            returned: self.returned.saturating_sub(before.returned),
        }
    }
}

/// A cluster is shared by all sessions of an engine.
pub(crate) type SharedCluster = Arc<WorkerCluster>;
