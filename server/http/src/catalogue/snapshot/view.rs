//! The lake as one snapshot shows it, with cached results: a snapshot with other runs, or with other verdicts, begins
//! with an empty cache. What else users add changes only the answers that read it.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use arrow::datatypes::DataType;
use echolake_lake::{DataFile, LakeSnapshot, VisibleRun};
use echolake_query::figure_rows::CurveRow;
use echolake_query::{EngineClient, PreparedQuery, QueryQuota, Session};
use echolake_schema::Symmetry;
use echolake_schema::annotations::RejectedMeasurements;
use echolake_schema::symmetry::MovedPair;
use echolake_schema::tables::{Source, Table};
use echolake_service::{QueryService, RequestFault};
use object_store::path::Path as StorePath;
use sha2::{Digest as _, Sha256};
use tokio::sync::OnceCell;

use super::positions::SurfacePositions;
use super::summary::CatalogueSummary;
use crate::catalogue::diffusion::DiffusionCoefficients;
use crate::catalogue::pair::PairGeometry;

/// Time limit of the catalogue's own queries: they read a surface at most, and all surfaces once per snapshot.
const LONGEST: Duration = Duration::from_secs(60);
/// Files of earlier snapshots that are remembered.
const EARLIER: usize = 20_000;
/// Bytes of a version that tell it from all others.
const VERSION_BYTES: usize = 8;

/// A prepared query, and the types of its placeholders as far as they are known.
pub(crate) type TypedQuery = (Arc<PreparedQuery>, Arc<[Option<DataType>]>);

/// One snapshot.
pub(crate) struct SnapshotView {
    /// Changes with all but the contributions that no other table's answer rests on, and with the program.
    version: String,
    /// Changes with what users add.
    users_version: String,
    pub snapshot: Arc<LakeSnapshot>,
    pub session: Arc<Session>,
    pub results: Arc<SharedResults>,
    /// Prepared queries by their text; there are few texts, because values are bound.
    prepared: Mutex<HashMap<String, TypedQuery>>,
}

/// Results of all snapshots of one version.
#[derive(Default)]
pub(crate) struct SharedResults {
    pub summary: OnceCell<CatalogueSummary>,
    pub rejected: OnceCell<RejectedMeasurements>,
    pub places: OnceCell<SurfacePositions>,
    pub diffusion: OnceCell<DiffusionCoefficients>,
    /// The geometry of all pairs, by their numbers.
    pub pairs: OnceCell<Vec<PairGeometry>>,
    /// The pairs that the symmetries of the grid make of each pair, by the symmetries' names.
    pub moved_pairs: OnceLock<Vec<(Symmetry, Vec<MovedPair>)>>,
    /// Mean curves over all pairs of the references that surfaces are beside, by name; there are few.
    flat_curves: Mutex<HashMap<String, Arc<OnceCell<Option<CurveRow>>>>>,
}

impl SnapshotView {
    fn new(snapshot: Arc<LakeSnapshot>, session: Arc<Session>, before: Option<&Self>) -> Self {
        let version = snapshot_version(&snapshot);
        let same = before.filter(|before| before.version == version && snapshot.is_whole());
        let results = same.map(|before| before.results.clone()).unwrap_or_default();
        let users_version = users_version(&snapshot);
        Self { version, users_version, snapshot, session, results, prepared: Mutex::default() }
    }

    /// Returns the version of what an answer rests on.
    pub fn content_version(&self, content: AnswerContents) -> String {
        match content {
            AnswerContents::Runs => self.version.clone(),
            AnswerContents::Contributions => format!("{} {}", self.version, self.users_version),
        }
    }

    /// Returns the version of a run's description, which rests on the run's own rows; None if readers see no such run.
    pub fn run_version(&self, run: &str) -> Option<String> {
        let VisibleRun { surface, run, run_derivation, reference_derivation, verdicts } =
            self.snapshot.run(&run.parse().ok()?)?;
        let optional = [reference_derivation, verdicts].map(|mark| mark.as_deref().unwrap_or_default());
        let program = env!("CARGO_PKG_VERSION");
        Some(format!("{program} {surface} {run} {run_derivation} {}", optional.join(" ")))
    }

    /// Returns the tag of an answer: a digest of the version of what it rests on, and of its `name`, which no other
    /// answer has.
    pub fn answer_etag(&self, version: &str, name: &str) -> String {
        let digest = Sha256::new().chain_update(version).chain_update(name).finalize();
        format!("\"{}\"", hex::encode(&digest[..VERSION_BYTES]))
    }

    /// The lake's version for as long as which an answer of this snapshot is right; None if a mended table, which has
    /// no new version, may change it.
    pub fn lasting_version(&self) -> Option<u64> {
        self.snapshot.log_version(Table::Runs).filter(|_| self.snapshot.is_whole())
    }

    /// The place of a reference's mean curves over all pairs.
    pub fn flat_curves(&self, flat: &str) -> Arc<OnceCell<Option<CurveRow>>> {
        let mut known = self.results.flat_curves.lock().unwrap_or_else(PoisonError::into_inner);
        known.entry(flat.to_owned()).or_default().clone()
    }

    pub fn find_prepared(&self, sql: &str) -> Option<TypedQuery> {
        self.prepared.lock().unwrap_or_else(PoisonError::into_inner).get(sql).cloned()
    }

    pub fn keep_prepared(&self, sql: &str, prepared: TypedQuery) {
        self.prepared.lock().unwrap_or_else(PoisonError::into_inner).insert(sql.to_owned(), prepared);
    }
}

/// What an answer rests on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum AnswerContents {
    /// Runs, and the verdicts on them.
    Runs,
    /// All that users add, too.
    Contributions,
}

/// The greatest kind of annotation, in the order of texts: a file whose greatest it is holds one.
const VERDICT: &str = "verdict";

// The version of a snapshot: a digest of its files' names and visible rows. Of files of users it has those with
// verdicts.
fn snapshot_version(snapshot: &LakeSnapshot) -> String {
    let of_runs = Table::ALL.into_iter().filter(|table| table.source() != Source::Users);
    let files = of_runs.flat_map(|table| snapshot.files(table));
    let has_verdicts = |file: &&Arc<DataFile>| {
        let greatest = file.stats.as_ref().and_then(|stats| stats.max.get("kind")?.as_str());
        greatest.is_none_or(|kind| kind == VERDICT)
    };
    files_version(files.chain(snapshot.files(Table::Annotations).iter().filter(has_verdicts)), snapshot)
}

fn users_version(snapshot: &LakeSnapshot) -> String {
    files_version(Table::OF_USERS.into_iter().flat_map(|table| snapshot.files(table)), snapshot)
}

fn files_version<'a>(files: impl Iterator<Item = &'a Arc<DataFile>>, snapshot: &LakeSnapshot) -> String {
    let mut digest = Sha256::new();
    digest.update(env!("CARGO_PKG_VERSION"));
    for file in files {
        digest.update(file.path.as_ref());
        digest.update(file.visible_rows().to_le_bytes());
    }
    for table in Table::OF_USERS {
        digest.update(snapshot.pending_objects(table).end.to_le_bytes());
    }
    hex::encode(&digest.finalize()[..VERSION_BYTES])
}

/// A file of a table.
#[derive(Debug, Clone)]
pub(crate) struct VisibleFile {
    table: Table,
    pub path: StorePath,
    pub bytes: u64,
}

impl VisibleFile {
    fn from_data_file(table: Table, file: &DataFile) -> Self {
        Self { table, path: file.path.clone(), bytes: file.bytes }
    }

    fn is_named(&self, table: Table, name: &str) -> bool {
        self.table == table && self.path.filename() == Some(name)
    }
}

/// The newest snapshot that was seen.
#[derive(Default)]
pub(crate) struct SnapshotViews(Mutex<ViewHistory>);

#[derive(Default)]
struct ViewHistory {
    view: Option<Arc<SnapshotView>>,
    /// Files that earlier snapshots showed: they stay until `vacuum` removes them, and clients that read by a manifest
    /// of that time can continue.
    earlier: VecDeque<VisibleFile>,
}

impl SnapshotViews {
    /// The lake as it is now.
    ///
    /// # Errors
    /// The snapshot cannot be read.
    pub async fn current_view(&self, service: &QueryService) -> Result<Arc<SnapshotView>, RequestFault> {
        let known = self.lock_history().view.clone();
        let session = match &known {
            Some(view) => view.session.clone(),
            None => catalogue_session(service),
        };
        let snapshot = match session.known_snapshot().await {
            Ok(Some(snapshot)) => snapshot,
            _ => {
                let asking = session.clone();
                service.plan_query(session.client(), async move { Ok(asking.current_snapshot().await?) }).await?
            }
        };
        let mut seen = self.lock_history();
        match seen.view.as_ref().filter(|view| Arc::ptr_eq(&view.snapshot, &snapshot)) {
            Some(view) => Ok(view.clone()),
            None => {
                let view = Arc::new(SnapshotView::new(snapshot, session, seen.view.as_deref()));
                let before = seen.view.replace(view.clone());
                let gone = before.map(|before| removed_files(&before.snapshot, &view.snapshot)).unwrap_or_default();
                seen.earlier.extend(gone);
                let too_many = seen.earlier.len().saturating_sub(EARLIER);
                seen.earlier.drain(..too_many);
                Ok(view)
            }
        }
    }

    /// A file that a view shows, or that an earlier one did. A file with rows of other projects is none for a client of
    /// some.
    pub fn find_file(&self, view: &SnapshotView, table: Table, name: &str) -> Option<VisibleFile> {
        let now = view.snapshot.readable_files(table).find(|file| file.path.filename() == Some(name));
        let earlier = || self.lock_history().earlier.iter().find(|file| file.is_named(table, name)).cloned();
        now.map(|file| VisibleFile::from_data_file(table, file)).or_else(earlier)
    }

    fn lock_history(&self) -> std::sync::MutexGuard<'_, ViewHistory> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

// The files that a snapshot shows and the next does not.
fn removed_files(before: &LakeSnapshot, after: &LakeSnapshot) -> Vec<VisibleFile> {
    let mut gone = Vec::new();
    for table in Table::ALL {
        let stay: HashSet<_> = after.files(table).iter().map(|file| &file.path).collect();
        let left = before.readable_files(table).filter(|file| !stay.contains(&file.path));
        gone.extend(left.map(|file| VisibleFile::from_data_file(table, file)));
    }
    gone
}

// A session of all clients with the same rights. Each was authorised before; the quota of its own queries does not apply
// to these.
fn catalogue_session(service: &QueryService) -> Arc<Session> {
    let quota = QueryQuota { time: Some(LONGEST), ..QueryQuota::default() };
    let session = service.engine().open_session(&Arc::new(EngineClient::new_program("catalogue", quota)));
    // Most of its queries read a few rows: parts that wait for each other cost more than they save.
    Arc::new(session.with_extension(Arc::new(|context| {
        context.state_ref().write().config_mut().options_mut().execution.target_partitions = 1;
        Ok(())
    })))
}
