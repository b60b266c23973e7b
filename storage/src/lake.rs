//! A lake, opened.

use std::path::Path as FsPath;
use std::sync::Arc;

use arrow::record_batch::RecordBatch;
use echolake_schema::tables::{Source, Table};
use echolake_schema::{Grid, Rig, RunId, SurfaceId};
use futures::future::join_all;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode};

use crate::delta::{DeltaLog, folder};
use crate::location::Location;
use crate::{
    Commit, CommitLog, Committed, DataFile, EncodedFile, Error, FileName, LAKE_FORMAT, LakeConfig, NewFile, References,
    Replaces, Result, Snapshot, VisibleRun, encode, rig_tables,
};

/// A lake. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Lake(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    location: Location,
    config: LakeConfig,
    grid: Grid,
    log: DeltaLog,
}

/// A file in the store that no commit names yet.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Staged {
    pub(crate) table: Table,
    pub(crate) file: NewFile,
}

impl Staged {
    /// Makes a run's row take the place of the rows that are there, which are these files or none. Where others stand
    /// there by the time of the commit, it is [`Committed::Outdated`].
    #[must_use]
    pub fn replacing<'a>(mut self, run: &VisibleRun, old: impl IntoIterator<Item = &'a DataFile>) -> Self {
        let names = old.into_iter().filter_map(|f| f.path.filename()).map(str::to_owned).collect();
        self.file.replaces = Some(Replaces { prefix: Some(run.prefix()), names });
        self
    }
}

const CONFIG: &str = "lake.toml";

impl Lake {
    /// Opens a lake that is there.
    ///
    /// # Errors
    /// [`Error::NoLake`], [`Error::Newer`], [`Error::Config`], or what the store says.
    pub async fn open(url: &str) -> Result<Self> {
        let location = Location::parse(url)?;
        match read_config(&location).await? {
            Some(config) => Self::assemble(location, config),
            None => Err(Error::NoLake { location: location.text }),
        }
    }

    /// Opens a lake, or makes one for this rig where the place is empty; then makes the tables that are missing.
    ///
    /// # Errors
    /// As [`Lake::open`]; [`Error::OtherRig`] where the lake is there and was made for another rig, and
    /// [`Error::Occupied`] where other files are.
    pub async fn open_or_create(url: &str, rig: &Rig, references: &References) -> Result<Self> {
        Self::open_or_create_at(Location::parse(url)?, rig, references).await
    }

    /// The same in a store that holds nothing but the lake; `name` is what messages call it.
    ///
    /// # Errors
    /// As [`Lake::open_or_create`].
    pub async fn open_or_create_in(
        store: Arc<dyn ObjectStore>,
        name: &str,
        rig: &Rig,
        references: &References,
    ) -> Result<Self> {
        Self::open_or_create_at(Location::store(name, store), rig, references).await
    }

    async fn open_or_create_at(location: Location, rig: &Rig, references: &References) -> Result<Self> {
        rig.check()?;
        let config = match read_config(&location).await? {
            Some(config) => config,
            None => create_config(&location, rig, references).await?,
        };
        let lake = Self::assemble(location, config)?;
        lake.fits(rig)?;
        lake.ensure_tables().await?;
        Ok(lake)
    }

    fn assemble(location: Location, config: LakeConfig) -> Result<Self> {
        let grid = config.rig.grid()?;
        let log = DeltaLog::new(location.store.clone(), config.rig.clone());
        Ok(Self(Arc::new(Inner { location, config, grid, log })))
    }

    /// Whether runs of this rig may stand beside those that are here.
    ///
    /// # Errors
    /// [`Error::OtherRig`] where they may not, with what differs.
    pub fn fits(&self, rig: &Rig) -> Result<()> {
        let differences = self.rig().differences(rig);
        if differences.is_empty() {
            return Ok(());
        }
        let text = |(field, lake, given): (_, String, String)| format!("`{field}` is {given}, the lake's is {lake}");
        Err(Error::OtherRig {
            location: self.location().to_owned(),
            given: rig.name.clone(),
            lake: self.rig().name.clone(),
            differences: differences.into_iter().map(text).collect::<Vec<_>>().join("; "),
        })
    }

    /// Makes the tables that are missing, and the rows that come from the rig alone.
    ///
    /// # Errors
    /// What the store says.
    pub async fn ensure_tables(&self) -> Result<()> {
        for table in Table::ALL {
            self.log().ensure(table).await?;
        }
        let grid = self.grid();
        let derivation = || FileName::Rig { derivation: format!("v{LAKE_FORMAT}") };
        for table in Table::ALL.into_iter().filter(|t| t.source() == Source::Rig) {
            let rows = match table {
                Table::Points => rig_tables::points(self.rig(), grid)?,
                _ => self.pairs()?,
            };
            self.append_rows(table, &derivation(), &[rows]).await?;
        }
        Ok(())
    }

    /// The rows of table `pairs`, which follow from the rig: row i is pair i.
    ///
    /// # Errors
    /// [`Error::Encode`] where the rig has no such columns, which is a mistake in this crate.
    pub fn pairs(&self) -> Result<RecordBatch> {
        rig_tables::pairs(self.rig(), self.grid())
    }

    /// The lake's location as the user wrote it.
    pub fn location(&self) -> &str {
        &self.0.location.text
    }

    /// The lake's folder, where it is one.
    pub fn folder(&self) -> Option<&FsPath> {
        self.0.location.folder.as_deref()
    }

    /// The lake's store; paths are relative to the lake.
    pub fn store(&self) -> Arc<dyn ObjectStore> {
        self.0.location.store.clone()
    }

    /// What `lake.toml` says.
    pub fn config(&self) -> &LakeConfig {
        &self.0.config
    }

    /// The rig that all runs share.
    pub fn rig(&self) -> &Rig {
        &self.0.config.rig
    }

    /// The rig's points and pairs.
    pub fn grid(&self) -> &Grid {
        &self.0.grid
    }

    /// The commit log.
    pub fn log(&self) -> &dyn CommitLog {
        &self.0.log
    }

    /// A frozen view of what readers may see.
    ///
    /// # Errors
    /// [`Error::Log`] where a table's log is damaged.
    pub async fn snapshot(&self) -> Result<Snapshot> {
        Snapshot::take(self.log()).await
    }

    /// Where a run's file stands.
    pub fn run_path(surface: &SurfaceId, run: &RunId) -> Path {
        Path::from(format!("runs/{surface}/{run}.mcap"))
    }

    /// Puts a file's bytes into the store, for a commit to name. Nobody sees them before that.
    ///
    /// # Errors
    /// What the store says.
    pub async fn stage(&self, table: Table, name: &FileName, file: EncodedFile) -> Result<Staged> {
        let name = name.compose();
        let path = folder(table).join(name.as_str());
        let (bytes, stats) = (file.bytes.len() as u64, file.stats);
        self.store().put(&path, file.bytes.into()).await.map_err(|e| Error::store("write", &path, e))?;
        Ok(Staged { table, file: NewFile { name, bytes, stats, replaces: None, parts: Vec::new() } })
    }

    /// Whether a file of this name is in the table.
    ///
    /// # Errors
    /// [`Error::Log`] where the table's log is damaged.
    pub async fn has(&self, table: Table, name: &FileName) -> Result<bool> {
        self.log().has(table, &name.compose()).await
    }

    /// Commits staged files, each of their tables once, all of them side by side but `runs`, which is last: from that commit on readers see them.
    /// Returns what became of each file, in the given order. The same files again add nothing.
    ///
    /// # Errors
    /// What the store says. Tables that were committed before stay so, seen by nobody; the same call goes on.
    pub async fn commit(&self, staged: &[Staged]) -> Result<Vec<Committed>> {
        let mut outcomes = vec![Committed::Before; staged.len()];
        let (pointers, others): (Vec<_>, Vec<_>) = Table::ALL.into_iter().partition(|table| *table == Table::Runs);
        for tables in [others, pointers] {
            // Each is brought to its end, whatever becomes of the others.
            for done in join_all(tables.into_iter().map(|table| self.commit_table(table, staged))).await {
                done?.into_iter().for_each(|(i, outcome)| outcomes[i] = outcome);
            }
        }
        Ok(outcomes)
    }

    // What became of the files of one table, each with its place among all.
    async fn commit_table(&self, table: Table, staged: &[Staged]) -> Result<Vec<(usize, Committed)>> {
        let of: Vec<_> = (0..staged.len()).filter(|i| staged[*i].table == table).collect();
        if of.is_empty() {
            return Ok(Vec::new());
        }
        let add = of.iter().map(|i| staged[*i].file.clone()).collect();
        let done = self.log().commit(table, &Commit { add, ..Commit::default() }).await?;
        Ok(of.into_iter().zip(done).collect())
    }

    /// Puts rows into a table, once: the same name again adds nothing.
    ///
    /// # Errors
    /// [`Error::Encode`] where the rows do not fit the table, or what the store says.
    pub async fn append_rows(&self, table: Table, name: &FileName, batches: &[RecordBatch]) -> Result<Committed> {
        if self.has(table, name).await? {
            return Ok(Committed::Before);
        }
        let staged = self.stage(table, name, encode(table, &table.schema(self.rig()), batches)?).await?;
        Ok(self.commit(&[staged]).await?[0])
    }

    /// Takes out of the logs what no run's row names any more; merged files are written anew without it. The files
    /// stay for readers that hold older views.
    ///
    /// # Errors
    /// What the store says.
    pub async fn remove_superseded(&self) -> Result<usize> {
        let snapshot = self.snapshot().await?;
        let mut count = 0;
        for table in Table::ALL {
            let remove: Vec<_> = snapshot.superseded(table).iter().map(|f| f.path.clone()).collect();
            if !remove.is_empty() {
                count += remove.len();
                self.log().commit(table, &Commit { remove, ..Commit::default() }).await?;
            }
            for file in snapshot.outgrown(table) {
                self.rewrite(table, file).await?;
                count += 1;
            }
        }
        Ok(count)
    }
}

async fn read_config(location: &Location) -> Result<Option<LakeConfig>> {
    let path = Path::from(CONFIG);
    let failed = |e| Error::store("read", format!("{}/{CONFIG}", location.text), e);
    let bytes = match location.store.get(&path).await {
        Ok(found) => found.bytes().await.map_err(failed)?,
        Err(object_store::Error::NotFound { .. }) => return Ok(None),
        Err(e) => return Err(failed(e)),
    };
    let text = std::str::from_utf8(&bytes)
        .map_err(|e| Error::Config { location: location.text.clone(), reason: e.to_string() })?;
    LakeConfig::from_toml(text, &location.text).map(Some)
}

async fn create_config(location: &Location, rig: &Rig, references: &References) -> Result<LakeConfig> {
    let failed = |e| Error::store("write", format!("{}/{CONFIG}", location.text), e);
    let there = location.store.list_with_delimiter(None).await.map_err(failed)?;
    let ours = |p: &Path| p.filename().is_some_and(|n| matches!(n, "runs" | "inbox" | "quarantine" | "tables"));
    if !there.objects.is_empty() || !there.common_prefixes.iter().all(ours) {
        return Err(Error::Occupied { location: location.text.clone() });
    }
    let config = LakeConfig { format: LAKE_FORMAT, references: references.clone(), rig: rig.clone() };
    let text = config.to_toml()?;
    match location.store.put_opts(&Path::from(CONFIG), text.into(), PutMode::Create.into()).await {
        Ok(_) => Ok(config),
        // Somebody else made the lake at the same moment; theirs counts.
        Err(object_store::Error::AlreadyExists { .. }) => {
            read_config(location).await?.ok_or_else(|| Error::NoLake { location: location.text.clone() })
        }
        Err(e) => Err(failed(e)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn paper(url: &str) -> Result<Lake> {
        Lake::open_or_create(url, &Rig::paper(), &References::default()).await
    }

    fn url(folder: &tempfile::TempDir) -> String {
        folder.path().join("lake").display().to_string()
    }

    #[tokio::test]
    async fn a_lake_is_made_once_and_opened_again() {
        let folder = tempfile::tempdir().expect("a folder");
        let missing = Lake::open(&url(&folder)).await.expect_err("not yet").to_string();
        assert!(missing.contains("no lake at"), "{missing}");
        let first = paper(&url(&folder)).await.expect("made");
        let again = paper(&url(&folder)).await.expect("opened");
        assert_eq!(first.config(), again.config());
        for table in [Table::Points, Table::Pairs] {
            let files = again.snapshot().await.expect("a view").files(table).to_vec();
            assert_eq!(files.len(), 1, "{table:?} {files:?}");
        }
    }

    #[tokio::test]
    async fn another_rig_is_refused_with_what_differs() {
        let folder = tempfile::tempdir().expect("a folder");
        paper(&url(&folder)).await.expect("made");
        let mut other = Rig::paper();
        other.impulse_response.length = 400;
        let error = Lake::open_or_create(&url(&folder), &other, &References::default()).await.expect_err("differs");
        assert!(error.to_string().contains("`impulse_response.length` is 400, the lake's is 384"), "{error}");
    }

    #[tokio::test]
    async fn other_peoples_folders_are_left_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("thesis.tex"), "x").expect("written");
        let error = paper(&folder.path().display().to_string()).await.expect_err("occupied");
        assert!(matches!(error, Error::Occupied { .. }), "{error}");
        assert_eq!(std::fs::read_dir(folder.path()).expect("listed").count(), 1);
    }

    #[tokio::test]
    async fn the_same_rows_twice_are_added_once() {
        let lake = paper("memory://").await.expect("made");
        let grid = lake.rig().grid().expect("a grid");
        let rows = || vec![rig_tables::points(lake.rig(), &grid).expect("rows")];
        let name = || FileName::Rig { derivation: "test".into() };
        assert_eq!(lake.append_rows(Table::Points, &name(), &rows()).await.expect("added"), Committed::Now);
        assert_eq!(lake.append_rows(Table::Points, &name(), &rows()).await.expect("known"), Committed::Before);
        assert_eq!(lake.log().files(Table::Points).await.expect("files").len(), 2);
    }

    #[tokio::test]
    async fn two_writers_lose_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let lakes = [paper(&url(&folder)).await.expect("made"), paper(&url(&folder)).await.expect("opened")];
        let grid = lakes[0].rig().grid().expect("a grid");
        let write = |lake: Lake, writer: usize| {
            let rows = rig_tables::points(lake.rig(), &grid).expect("rows");
            tokio::spawn(async move {
                for i in 0..10 {
                    let name = FileName::Rig { derivation: format!("{writer}x{i}") };
                    lake.append_rows(Table::Points, &name, std::slice::from_ref(&rows)).await.expect("committed");
                }
            })
        };
        let [a, b] = lakes.clone();
        let (a, b) = tokio::join!(write(a, 0), write(b, 1));
        a.and(b).expect("both done");
        assert_eq!(lakes[0].log().files(Table::Points).await.expect("files").len(), 21);
    }
}
