//! The workers that an engine may use, and which of them answer now.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use datafusion_distributed::{ChannelResolver as _, GetWorkerInfoRequest};
use futures::future::join_all;
use serde::{Deserialize, Serialize};
use url::Url;

use super::channels::{CONNECT_LIMIT, WorkerChannels};
use super::links::parse_worker_url;
use super::loss::WorkerLoss;
use super::{WorkerFault, WorkerFigures, WorkerIdentity, WorkerLink, WorkerToken};

/// Time for which a worker's answer is good.
const CHECK_LASTS: Duration = Duration::from_secs(5);

/// The workers of a server, as it passes them to its engines.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct ClusterSettings {
    /// Addresses of the workers, as `https://10.0.0.7:7070`.
    pub workers: Vec<String>,
    /// The secret that they share with the server.
    pub token: Option<WorkerToken>,
    /// The certificates of the workers or their issuers, PEM.
    pub authorities: Option<String>,
    /// Bytes that a query has to read to be spread.
    pub least_bytes: u64,
    /// The build that workers must have.
    pub build: String,
}

impl ClusterSettings {
    /// Returns the addresses, and the link to them, if they may be used.
    ///
    /// # Errors
    /// [`WorkerFault`].
    pub fn check_workers(&self) -> Result<(Vec<Url>, WorkerLink), WorkerFault> {
        let link = WorkerLink::new(self.token.clone(), self.authorities.as_deref())?;
        let mut urls = self.workers.iter().map(|given| parse_worker_url(given)).collect::<Result<Vec<_>, _>>()?;
        for url in &urls {
            link.check_url(url)?;
        }
        // In one order everywhere, so that files stay with their workers.
        urls.sort();
        urls.dedup();
        Ok((urls, link))
    }

    /// Returns the ports of the workers.
    pub fn ports(&self) -> Vec<u16> {
        let urls = self.workers.iter().filter_map(|given| parse_worker_url(given).ok());
        urls.filter_map(|url| url.port_or_known_default()).collect()
    }
}

/// Workers that run parts of heavy queries.
///
/// ```
/// use echolake_query::{ClusterSettings, WorkerCluster};
///
/// let settings = ClusterSettings {
///     workers: vec!["http://127.0.0.1:7070".to_owned()],
///     token: None,
///     authorities: None,
///     least_bytes: 64 << 20,
///     build: "0.1.0-1a".to_owned(),
/// };
/// let cluster = WorkerCluster::new(&settings, "a lake's id")?;
/// assert!(!cluster.worker_states()[0].was_asked());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct WorkerCluster {
    urls: Vec<Url>,
    /// Identity that workers must have.
    identity: Mutex<WorkerIdentity>,
    least_bytes: u64,
    channels: WorkerChannels,
    checks: Mutex<HashMap<Url, (Instant, WorkerState)>>,
    counts: Mutex<SpreadCounts>,
}

/// Queries over workers since the start of an engine.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SpreadCounts {
    /// Queries that were begun on workers.
    pub spread: u64,
    /// Queries that were repeated on the remaining workers, because one was lost.
    pub repeated: u64,
    /// Queries that the engine ran itself after workers could not.
    pub returned: u64,
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

/// A worker as it was when it was last asked.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct WorkerState {
    /// Its address.
    pub url: String,
    /// Reason not to use it; None if there is none.
    pub problem: Option<String>,
    /// Its build; None if it has never answered.
    pub build: Option<String>,
    /// Time of its last answer, microseconds since 1970.
    pub last_seen_micros: Option<i64>,
    /// Its figures then.
    pub figures: Option<WorkerFigures>,
}

impl WorkerState {
    /// Returns whether it was asked, whatever it answered.
    pub fn was_asked(&self) -> bool {
        self.problem.is_some() || self.last_seen_micros.is_some()
    }
}

impl WorkerCluster {
    /// Makes the cluster of an engine of this lake, whose id may change with its tables; it asks no worker yet.
    ///
    /// # Errors
    /// [`WorkerFault`].
    pub fn new(settings: &ClusterSettings, lake_id: &str) -> Result<Self, WorkerFault> {
        let (urls, link) = settings.check_workers()?;
        Ok(Self {
            urls,
            identity: Mutex::new(WorkerIdentity { build: settings.build.clone(), lake: lake_id.to_owned() }),
            least_bytes: settings.least_bytes,
            channels: WorkerChannels::new(&link)?,
            checks: Mutex::default(),
            counts: Mutex::default(),
        })
    }

    /// Takes the id of the tables that a query reads. If they were made again since the last query, workers are asked
    /// whether they have them.
    pub(crate) fn follow_lake(&self, lake_id: &str) {
        let mut identity = self.lock_identity();
        if identity.lake != lake_id {
            lake_id.clone_into(&mut identity.lake);
            self.checks().clear();
        }
    }

    fn lock_identity(&self) -> MutexGuard<'_, WorkerIdentity> {
        self.identity.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns all workers as they were when they were last asked.
    pub fn worker_states(&self) -> Vec<WorkerState> {
        self.urls.iter().map(|url| self.known_state(url)).collect()
    }

    /// Returns all workers, after asking those that were not asked for a while.
    pub(crate) async fn fresh_states(&self) -> Vec<WorkerState> {
        self.check_workers(CHECK_LASTS).await;
        self.worker_states()
    }

    /// Asks all workers now, and returns how they are.
    pub async fn ask_workers(&self) -> Vec<WorkerState> {
        self.check_workers(Duration::ZERO).await;
        self.worker_states()
    }

    /// Returns what was counted since the start.
    pub fn spread_counts(&self) -> SpreadCounts {
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
        let old: Vec<_> = self.urls.iter().filter(is_old).collect();
        join_all(old.into_iter().map(|url| self.check_worker(url))).await;
        let checks = self.checks();
        let answers = |url: &&Url| checks.get(*url).is_some_and(|(_, state)| state.problem.is_none());
        self.urls.iter().filter(answers).cloned().collect()
    }

    async fn check_worker(&self, url: &Url) {
        let before = self.known_state(url);
        let answer = tokio::time::timeout(CONNECT_LIMIT, self.ask_worker(url)).await;
        let answer = answer.unwrap_or_else(|_| Err(format!("it did not answer within {} s", CONNECT_LIMIT.as_secs())));
        let state = answer.unwrap_or_else(|problem| WorkerState { problem: Some(problem), ..before.clone() });
        match &state.problem {
            Some(problem) if before.problem.as_ref() != Some(problem) => {
                tracing::warn!(worker = %url, problem, "a worker is not used");
            }
            None if before.problem.is_some() => tracing::info!(worker = %url, "a worker is used again"),
            _ => {}
        }
        self.checks().insert(url.clone(), (Instant::now(), state));
    }

    // The error is the reason for which it is not used.
    async fn ask_worker(&self, url: &Url) -> Result<WorkerState, String> {
        let answer = async {
            let mut client = self.channels.get_worker_client_for_url(url).await?;
            client.get_worker_info(GetWorkerInfoRequest {}).await
        };
        let info = answer.await.map_err(|e| {
            let problem = WorkerLoss::find_in(&e).map_or_else(|| e.to_string(), |loss| loss.message().to_owned());
            with_hint(problem)
        })?;
        let other = WorkerIdentity::parse_line(&info.version)
            .ok_or_else(|| format!("it is no worker of echolake: its version is `{}`", info.version))?;
        let problem = self.lock_identity().find_difference(&other);
        Ok(WorkerState {
            url: url.to_string(),
            problem,
            build: Some(other.build),
            last_seen_micros: SystemTime::now().duration_since(UNIX_EPOCH).ok().map(|time| time.as_micros() as i64),
            figures: self.channels.fetch_figures(url).await,
        })
    }

    fn known_state(&self, url: &Url) -> WorkerState {
        let unknown =
            || WorkerState { url: url.to_string(), problem: None, build: None, last_seen_micros: None, figures: None };
        self.checks().get(url).map_or_else(unknown, |(_, state)| state.clone())
    }

    pub(super) fn channels(&self) -> &WorkerChannels {
        &self.channels
    }

    pub(super) fn least_bytes(&self) -> u64 {
        self.least_bytes
    }

    pub(super) fn size(&self) -> usize {
        self.urls.len()
    }

    fn checks(&self) -> MutexGuard<'_, HashMap<Url, (Instant, WorkerState)>> {
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
