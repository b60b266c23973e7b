//! A lake, opened.

#[cfg(feature = "tables")]
use std::collections::BTreeSet;
use std::path::Path as FsPath;
use std::sync::Arc;

use echolake_schema::{Grid, Rig, RunId, SurfaceId};
#[cfg(feature = "tables")]
use echolake_schema::{ProjectName, tables::Table};
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode};

use crate::location::LakeLocation;
use crate::location_text::object_text;
#[cfg(feature = "remote")]
use crate::remote::PartStore;
#[cfg(feature = "tables")]
use crate::remote::{BlockCache, BlockFolder, CacheCounters, CacheCounts, CacheFolder, CachedStore};
#[cfg(feature = "tables")]
use crate::tables::{DeltaLog, ProjectLog};
use crate::unused;
use crate::{Error, LAKE_FORMAT, LakeConfig, ReferenceSurfaces, Result, SamplePrecision};

/// A lake. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Lake(Arc<OpenLake>);

#[derive(Debug, Clone)]
struct OpenLake {
    location: LakeLocation,
    config: LakeConfig,
    grid: Grid,
    #[cfg(feature = "tables")]
    log: Arc<DeltaLog>,
    /// The part of the log that is seen, if not all.
    #[cfg(feature = "tables")]
    projects: Option<ProjectLog>,
}

const CONFIG: &str = "lake.toml";
/// Folders that a lake whose configuration is lost may have.
const OWN_FOLDERS: [&str; 7] = ["annotations", "inbox", "predictions", "quarantine", "runs", "tables", "tags"];

impl Lake {
    /// Opens an existing lake.
    ///
    /// ```
    /// use echolake_lake::{Error, Lake};
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// assert!(matches!(Lake::open("memory://").await, Err(Error::NoLake { .. })));
    /// # });
    /// # Ok::<(), std::io::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::NoLake`], [`Error::Newer`], [`Error::Config`], or what the store says.
    pub async fn open(url: &str) -> Result<Self> {
        let location = LakeLocation::parse(url)?;
        match read_config(&location).await? {
            Some(config) => Self::from_config(location, config),
            None => Err(Error::NoLake { location: location.text }),
        }
    }

    /// Checks that the lake is there and can be read, by one request to its store.
    ///
    /// # Errors
    /// As [`Lake::open`].
    pub async fn check_readable(&self) -> Result<()> {
        match read_config(&self.0.location).await? {
            Some(_) => Ok(()),
            None => Err(Error::NoLake { location: self.location().to_owned() }),
        }
    }

    /// Opens a lake, or makes one for this rig if the location is empty; then makes the tables that are missing, in a
    /// build that has tables.
    ///
    /// ```
    /// use echolake_lake::{Error, Lake, ReferenceSurfaces};
    /// use echolake_schema::Rig;
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
    /// assert_eq!((lake.rig().name.as_str(), lake.grid().pairs().len()), ("paper", 2951));
    /// let other = Rig::from_toml("[impulse_response]\nlength = 400")?;
    /// assert!(matches!(lake.check_rig(&other), Err(Error::OtherRig { .. })));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// As [`Lake::open`]; [`Error::OtherRig`] if the lake has runs and was made for another rig, and
    /// [`Error::Occupied`] if other files do.
    pub async fn open_or_create(url: &str, rig: &Rig, references: &ReferenceSurfaces) -> Result<Self> {
        Self::open_or_create_at(LakeLocation::parse(url)?, rig, references).await
    }

    /// The same in a store that holds nothing but the lake; `name` is what messages call it. If it is a URL of an
    /// object store, such as `s3://bucket/lake`, the store is taken for a remote one.
    ///
    /// # Errors
    /// As [`Lake::open_or_create`].
    pub async fn open_or_create_in(
        store: Arc<dyn ObjectStore>,
        name: &str,
        rig: &Rig,
        references: &ReferenceSurfaces,
    ) -> Result<Self> {
        Self::open_or_create_at(LakeLocation::named_store(name, store), rig, references).await
    }

    async fn open_or_create_at(location: LakeLocation, rig: &Rig, references: &ReferenceSurfaces) -> Result<Self> {
        rig.check_consistency()?;
        let config = match read_config(&location).await? {
            Some(config) => config,
            None => create_config(&location, rig, references).await?,
        };
        let mut lake = Self::from_config(location, config)?;
        if let Err(misfit) = lake.check_rig(rig) {
            if !unused::is_unused(&lake).await? {
                return Err(misfit);
            }
            lake = lake.change_rig(rig).await?;
        }
        // Without them an ingest elsewhere makes them.
        #[cfg(feature = "tables")]
        lake.ensure_tables().await?;
        Ok(lake)
    }

    // The tables of grid and pairs are made anew for the rig.
    async fn change_rig(&self, rig: &Rig) -> Result<Self> {
        unused::delete_tables(self).await?;
        let references = self.config().references.clone();
        let config =
            LakeConfig { format: LAKE_FORMAT, samples: SamplePrecision::default(), references, rig: rig.clone() };
        let failed = |e| Error::store_failure("write", object_text(self.location(), CONFIG), e);
        self.store().put(&Path::from(CONFIG), config.to_toml()?.into()).await.map_err(failed)?;
        Self::from_config(self.0.location.clone(), config)
    }

    /// Removes a lake that holds no runs and no recordings; its folder stays, and other files in it. Returns whether it
    /// did: any other lake is left as it is.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn remove_unused(self) -> Result<bool> {
        let Some(folder) = self.folder() else { return Ok(false) };
        if !unused::is_unused(&self).await? {
            return Ok(false);
        }
        unused::delete_tables(&self).await?;
        let failed = |e| Error::store_failure("delete", object_text(self.location(), CONFIG), e);
        self.store().delete(&Path::from(CONFIG)).await.map_err(failed)?;
        unused::remove_empty_folders(folder);
        Ok(true)
    }

    fn from_config(location: LakeLocation, config: LakeConfig) -> Result<Self> {
        let grid = config.rig.build_grid()?;
        #[cfg(feature = "tables")]
        let log = Arc::new(DeltaLog::new(&location, config.rig.clone()));
        Ok(Self(Arc::new(OpenLake {
            location,
            config,
            grid,
            #[cfg(feature = "tables")]
            log,
            #[cfg(feature = "tables")]
            projects: None,
        })))
    }

    /// Checks that runs of this rig fit the lake: that its tables' numbers would mean the same.
    ///
    /// # Errors
    /// [`Error::OtherRig`] if they do not, with the differences.
    pub fn check_rig(&self, rig: &Rig) -> Result<()> {
        let differences = self.rig().differences_from(rig);
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

    /// The lake's location as the user wrote it.
    pub fn location(&self) -> &str {
        &self.0.location.text
    }

    /// The lake's folder, if it is one.
    pub fn folder(&self) -> Option<&FsPath> {
        self.0.location.folder.as_deref()
    }

    /// The lake's store; paths are relative to the lake.
    pub fn store(&self) -> Arc<dyn ObjectStore> {
        self.0.location.store.clone()
    }

    /// Returns whether the lake is on an object store, where others may work on it from other machines.
    #[cfg(feature = "remote")]
    pub fn is_remote(&self) -> bool {
        self.0.location.remote.is_some()
    }

    /// Returns the tag of this version of the lake, that of its table `runs`, if it is the newest one. Tables that are made
    /// again have the same versions with other tags. A lake that is gone has no newest version.
    ///
    /// # Errors
    /// [`Error::Store`].
    #[cfg(feature = "tables")]
    pub async fn newest_tag(&self, version: u64) -> Result<Option<String>> {
        let log = self.commit_log();
        if log.has_after(Table::Runs, version).await? {
            return Ok(None);
        }
        log.commit_tag(Table::Runs, version).await
    }

    /// Returns the lake with a cache of what never changes in it, in memory, and in a folder if there is one. A lake in
    /// a folder needs none and is returned as it is.
    ///
    /// # Errors
    /// [`Error::CacheFolder`], or what the store says.
    #[cfg(feature = "tables")]
    pub async fn with_cache(&self, folder: Option<&CacheFolder>) -> Result<Self> {
        if !self.is_remote() {
            return Ok(self.clone());
        }
        let mut blocks = None;
        if let Some(folder) = folder {
            let failed = |source| Error::CacheFolder { folder: folder.path.clone(), source };
            folder.create().map_err(failed)?;
            // A lake without tables has nothing to cache yet.
            let id = self.0.log.table_id(Table::Runs).await?;
            blocks = id.map(|id| BlockFolder::open(folder, &id)).transpose().map_err(failed)?;
        }
        let cached = CachedStore::new(self.store(), Arc::new(BlockCache::new(blocks)));
        let store = Arc::new(cached.clone());
        let location = LakeLocation { store, cached: Some(cached), ..self.0.location.clone() };
        Ok(Self(Arc::new(OpenLake { location, ..self.0.as_ref().clone() })))
    }

    /// Returns the lake as a reader of these projects sees it: with their runs, and those of the surfaces that
    /// `lake.toml` names as references. All other runs do not exist in it, as of no version; it cannot be written.
    ///
    /// ```
    /// use echolake_lake::{Error, Lake, ReferenceSurfaces};
    /// use echolake_schema::Rig;
    ///
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// let lake = Lake::open_or_create("memory://", &Rig::paper(), &ReferenceSurfaces::default()).await?;
    /// let seen = lake.restricted_to(["brick".parse()?].into());
    /// assert!(seen.is_restricted() && !lake.is_restricted());
    /// assert!(matches!(seen.ensure_tables().await, Err(Error::Restricted { .. })));
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    #[cfg(feature = "tables")]
    #[must_use]
    pub fn restricted_to(&self, projects: BTreeSet<ProjectName>) -> Self {
        let references = &self.config().references;
        let common = [references.flat.clone(), references.foam.clone()];
        let projects = Some(ProjectLog::new(self.0.log.clone(), projects, common));
        Self(Arc::new(OpenLake { projects, ..self.0.as_ref().clone() }))
    }

    /// Returns whether this is the lake as a reader of some projects sees it.
    #[cfg(feature = "tables")]
    pub fn is_restricted(&self) -> bool {
        self.0.projects.is_some()
    }

    /// Returns the projects whose runs this reader sees; None if it sees all runs.
    #[cfg(feature = "tables")]
    pub fn visible_projects(&self) -> Option<&BTreeSet<ProjectName>> {
        self.0.projects.as_ref().map(ProjectLog::visible_projects)
    }

    /// Returns whether both are one open lake, as readers with the same or with other rights see it.
    #[cfg(feature = "tables")]
    pub fn is_same_lake(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0.log, &other.0.log)
    }

    /// Returns what the cache has counted since it was made; None if there is no cache.
    #[cfg(feature = "tables")]
    pub fn cache_counts(&self) -> Option<CacheCounts> {
        Some(self.0.location.cached.as_ref()?.block_cache().read_counts())
    }

    /// Returns the store for one scan, with counters of its own; None if there is no cache.
    #[cfg(feature = "tables")]
    pub fn store_for_scan(&self, counters: Arc<CacheCounters>) -> Option<Arc<dyn ObjectStore>> {
        let cached = self.0.location.cached.as_ref()?;
        Some(Arc::new(cached.for_scan(counters)))
    }

    /// Probes, once in a process, if an object store is fit to be written: if one alone can create an object. A folder
    /// is.
    ///
    /// # Errors
    /// [`Error::NotExclusive`], or what the store says.
    #[cfg(feature = "remote")]
    pub async fn ensure_exclusive(&self) -> Result<()> {
        self.0.location.ensure_exclusive().await
    }

    /// Uploads in parts, if the lake is on an object store.
    #[cfg(feature = "remote")]
    pub(crate) fn part_store(&self) -> Option<&PartStore> {
        self.0.location.remote.as_ref()?.parts.as_ref()
    }

    /// Contents of `lake.toml`.
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

    /// The commit log, as far as it may be seen.
    #[cfg(feature = "tables")]
    pub fn commit_log(&self) -> &dyn crate::CommitLog {
        match &self.0.projects {
            Some(projects) => projects,
            None => self.0.log.as_ref(),
        }
    }

    /// The commit log, without regard to what may be seen.
    #[cfg(feature = "tables")]
    pub(crate) fn delta_log(&self) -> &DeltaLog {
        &self.0.log
    }

    /// Path of a run's file.
    ///
    /// ```
    /// let path = echolake_lake::Lake::run_path(&"flat".parse()?, &"20260105T080000Z-flat-7c1e".parse()?);
    /// assert_eq!(path.as_ref(), "runs/flat/20260105T080000Z-flat-7c1e.mcap");
    /// # Ok::<(), echolake_schema::Error>(())
    /// ```
    pub fn run_path(surface: &SurfaceId, run: &RunId) -> Path {
        Path::from(format!("runs/{surface}/{run}.mcap"))
    }
}

async fn read_config(location: &LakeLocation) -> Result<Option<LakeConfig>> {
    let path = Path::from(CONFIG);
    let failed = |e| Error::store_failure("read", object_text(&location.text, CONFIG), e);
    let bytes = match location.store.get(&path).await {
        Ok(found) => found.bytes().await.map_err(failed)?,
        Err(object_store::Error::NotFound { .. }) => return Ok(None),
        Err(e) => return Err(failed(e)),
    };
    let text =
        std::str::from_utf8(&bytes).map_err(|e| Error::Config { location: location.text.clone(), source: e.into() })?;
    LakeConfig::from_toml(text, &location.text).map(Some)
}

async fn create_config(location: &LakeLocation, rig: &Rig, references: &ReferenceSurfaces) -> Result<LakeConfig> {
    let failed = |e| Error::store_failure("write", object_text(&location.text, CONFIG), e);
    let there = location.store.list_with_delimiter(None).await.map_err(failed)?;
    let ours = |p: &Path| p.filename().is_some_and(|n| OWN_FOLDERS.contains(&n));
    if !there.objects.is_empty() || !there.common_prefixes.iter().all(ours) {
        return Err(Error::Occupied { location: location.text.clone() });
    }
    #[cfg(feature = "remote")]
    location.ensure_exclusive().await?;
    let config = LakeConfig {
        format: LAKE_FORMAT,
        samples: SamplePrecision::default(),
        references: references.clone(),
        rig: rig.clone(),
    };
    let text = config.to_toml()?;
    match location.store.put_opts(&Path::from(CONFIG), text.into(), PutMode::Create.into()).await {
        Ok(_) => Ok(config),
        // Another process made the lake at the same moment; its configuration counts.
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
        Lake::open_or_create(url, &Rig::paper(), &ReferenceSurfaces::default()).await
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
        let lake = paper(&url(&folder)).await.expect("made");
        let mut other = Rig::paper();
        other.impulse_response.length = 400;
        for used in ["inbox/x.mcap.partial", "runs/flat/x.mcap", "tables/runs/x.parquet"] {
            lake.store().put(&Path::from(used), "x".into()).await.expect("written");
            let error =
                Lake::open_or_create(&url(&folder), &other, &ReferenceSurfaces::default()).await.expect_err("differs");
            assert!(error.to_string().contains("`impulse_response.length` is 400, the lake's is 384"), "{error}");
            assert!(!lake.clone().remove_unused().await.expect("looked at"), "{used}");
            lake.store().delete(&Path::from(used)).await.expect("deleted");
        }
    }

    #[tokio::test]
    async fn a_lake_without_runs_takes_another_rig_and_can_be_removed() {
        let folder = tempfile::tempdir().expect("a folder");
        let references = ReferenceSurfaces { direct_sound: crate::DirectSound::Estimated, ..Default::default() };
        Lake::open_or_create(&url(&folder), &Rig::paper(), &references).await.expect("made");
        let mut other = Rig::paper();
        other.grid.layers.truncate(1);
        paper(&url(&folder)).await.expect("the same rig");
        Lake::open_or_create(&url(&folder), &other, &ReferenceSurfaces::default()).await.expect("another rig");
        let lake = Lake::open(&url(&folder)).await.expect("opened");
        assert_eq!((lake.rig(), &lake.config().references), (&other, &references), "references stay");
        let pairs = lake.snapshot().await.expect("a view").files(Table::Pairs).iter().map(|f| f.rows).sum::<u64>();
        assert_eq!(pairs, lake.grid().pairs().len() as u64);
        assert!(lake.remove_unused().await.expect("removed"));
        assert_eq!(std::fs::read_dir(folder.path().join("lake")).expect("listed").count(), 0);
    }

    #[tokio::test]
    async fn other_peoples_folders_are_left_alone() {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("thesis.tex"), "x").expect("written");
        let error = paper(&folder.path().display().to_string()).await.expect_err("occupied");
        assert!(matches!(error, Error::Occupied { .. }), "{error}");
        assert_eq!(std::fs::read_dir(folder.path()).expect("listed").count(), 1);
    }
}
