//! One run's file becomes the rows that come from the run alone.

use std::path::{Path as FsPath, PathBuf};
use std::sync::Arc;

use echolake_lake::{FileName, Lake, VisibleRun};
use echolake_schema::tables::Table;
use echolake_schema::{RunId, SurfaceId};
use futures::TryStreamExt as _;
use object_store::local::LocalFileSystem;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, WriteMultipart};

use crate::CODE_VERSION;
use crate::error::{Error, Result};
use crate::references::{Finder, digest};
use crate::rows::{self, Keys};
use crate::run_content::RunContent;

/// Where a run's file is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// In the lake: under `inbox/` or `runs/`.
    Lake(Path),
    /// Anywhere else on this machine.
    File(PathBuf),
}

/// What became of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Taken {
    /// The run.
    pub run: RunId,
    /// Its surface.
    pub surface: SurfaceId,
    /// Measurements in the table.
    pub measurements: usize,
    /// References that are missing, separated by commas; empty where none is.
    pub missing: String,
    /// Whether it is new.
    pub outcome: Outcome,
    /// What could not be read, in words.
    pub damaged: Vec<String>,
    /// The file was closed and says how the run ended.
    pub whole: bool,
}

/// Whether a run is new to the lake.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// It is in the lake now.
    Added,
    /// It was in the lake before; nothing was added.
    Known,
}

/// Takes runs into a lake.
#[derive(Debug, Clone)]
pub struct Ingest<'a> {
    lake: &'a Lake,
}

impl<'a> Ingest<'a> {
    /// Into this lake.
    pub fn new(lake: &'a Lake) -> Self {
        Self { lake }
    }

    /// Takes in one run. The same run again adds nothing.
    ///
    /// # Errors
    /// [`Error`], naming the file; then nothing of the run is seen by readers, and the same call may be made again.
    pub async fn take_in(&self, source: &Source) -> Result<Taken> {
        let (store, path, name) = self.resolve(source)?;
        let content = RunContent::read(self.lake, store, &path, &name).await?;
        let keys = Keys { surface: content.manifest.surface_id.clone(), run: content.manifest.run_id.clone() };
        let derivation = digest(&[content.integrity.sha256.as_str(), CODE_VERSION]);
        let snapshot = self.lake.snapshot().await?;
        let known = snapshot.run(&keys.run).cloned();
        if let Some(known) = &known {
            let there = self.recorded_sha256(&snapshot, known).await?;
            if there != content.integrity.sha256 {
                let given = content.integrity.sha256.clone();
                return Err(Error::OtherContent { run: keys.run.to_string(), file: name, given, there });
            }
        }
        self.keep_file(source, &keys, &content).await?;
        let outcome = match known {
            Some(known) if known.run_derivation == derivation => Outcome::Known,
            _ => {
                self.commit(&keys, &content, &derivation).await?;
                Outcome::Added
            }
        };
        let after = self.lake.snapshot().await?;
        Ok(Taken {
            measurements: content.accepted.len(),
            missing: Finder::new(self.lake, &after).wanted(&keys.surface).missing(),
            outcome,
            whole: content.is_whole(),
            damaged: content.damaged,
            surface: keys.surface,
            run: keys.run,
        })
    }

    async fn commit(&self, keys: &Keys, content: &RunContent, derivation: &str) -> Result<()> {
        let (lake, rig) = (self.lake, self.lake.rig());
        let grid = rig.grid().map_err(echolake_lake::Error::from)?;
        let origin = content.manifest.origin.label();
        let surface =
            rows::surfaces::row(rig, keys, &content.surface, &lake.config().references, origin, &content.heights_mm)?;
        let mut tables = vec![
            (Table::Surfaces, vec![surface]),
            (Table::Measurements, rows::measurements::rows(rig, &grid, keys, &content.accepted)?),
            (Table::Environment, vec![rows::logs::environment(rig, keys, &content.readings)?]),
            (Table::Events, vec![rows::logs::events(rig, keys, &content.events)?]),
        ];
        tables.extend(rows::heightmaps::rows(rig, keys, &content.heights_mm)?.map(|b| (Table::Heightmaps, vec![b])));
        for (table, batches) in tables {
            let name = FileName::Rows {
                surface: keys.surface.clone(),
                run: keys.run.clone(),
                derivation: derivation.to_owned(),
            };
            lake.append_rows(table, name, batches).await?;
        }
        let snapshot = lake.snapshot().await?;
        let old: Vec<_> = snapshot.files_of(Table::Runs, &keys.run).cloned().collect();
        let references = rows::runs::References {
            missing: Finder::new(lake, &snapshot).wanted(&keys.surface).missing(),
            ..rows::runs::References::default()
        };
        let row = rows::runs::row(lake, keys, content, derivation, &references)?;
        let pointer = FileName::Pointer(VisibleRun {
            surface: keys.surface.clone(),
            run: keys.run.clone(),
            run_derivation: derivation.to_owned(),
            reference_derivation: None,
        });
        lake.replace_rows(Table::Runs, pointer, vec![row], &old).await?;
        Ok(())
    }

    fn resolve(&self, source: &Source) -> Result<(Arc<dyn ObjectStore>, Path, String)> {
        match source {
            Source::Lake(path) => Ok((self.lake.store(), path.clone(), path.to_string())),
            Source::File(file) => {
                let name = file.display().to_string();
                if !file.is_file() {
                    return Err(Error::NoRun { given: name });
                }
                let path = Path::from_absolute_path(std::path::absolute(file).map_err(|e| Error::read(&name, e))?);
                Ok((Arc::new(LocalFileSystem::new()), path.map_err(|e| Error::read(&name, e))?, name))
            }
        }
    }

    async fn recorded_sha256(&self, snapshot: &echolake_lake::Snapshot, run: &VisibleRun) -> Result<String> {
        let Some(file) = snapshot.files_of(Table::Runs, &run.run).next() else { return Ok(String::new()) };
        let row = crate::read_back::run_row(self.lake, file).await?;
        Ok(rows::runs::text_of(&row, "file_sha256").unwrap_or_default())
    }

    // The lake's copy stands under runs/ before any row names it.
    async fn keep_file(&self, source: &Source, keys: &Keys, content: &RunContent) -> Result<()> {
        let to = Lake::run_path(&keys.surface, &keys.run);
        let store = self.lake.store();
        let failed = |e: object_store::Error| Error::read(&to, e);
        let there = match store.head(&to).await {
            Ok(meta) => meta.size == content.integrity.bytes,
            Err(object_store::Error::NotFound { .. }) => false,
            Err(e) => return Err(failed(e)),
        };
        match source {
            Source::Lake(from) if *from == to => {}
            Source::Lake(from) if there => store.delete(from).await.map_err(failed)?,
            Source::Lake(from) => store.rename(from, &to).await.map_err(failed)?,
            Source::File(_) if there => {}
            Source::File(from) => self.copy_in(from, &to).await?,
        }
        Ok(())
    }

    // Under another name first, so that a run is under its own name whole or not at all.
    async fn copy_in(&self, from: &FsPath, to: &Path) -> Result<()> {
        let store = self.lake.store();
        let failed = |e: object_store::Error| Error::read(to, e);
        let staged = Path::from(format!("inbox/{}.copying", to.filename().unwrap_or("run")));
        let upload = store.put_multipart(&staged).await.map_err(failed)?;
        let mut writer = WriteMultipart::new(upload);
        let source: Arc<dyn ObjectStore> = Arc::new(LocalFileSystem::new());
        let path = Path::from_absolute_path(std::path::absolute(from).map_err(|e| Error::read(from.display(), e))?)
            .map_err(|e| Error::read(from.display(), e))?;
        let size = source.head(&path).await.map_err(failed)?.size;
        let mut at = 0;
        while at < size {
            let end = (at + (8 << 20)).min(size);
            writer.put(source.get_range(&path, at..end).await.map_err(failed)?);
            writer.wait_for_capacity(2).await.map_err(failed)?;
            at = end;
        }
        writer.finish().await.map_err(failed)?;
        store.rename(&staged, to).await.map_err(failed)
    }
}

/// The run files of the lake that are in no table yet: all of `inbox/`, and those of `runs/` that `runs` does not name.
///
/// # Errors
/// [`Error::Lake`] where the lake cannot be listed.
pub async fn pending(lake: &Lake) -> Result<Vec<Source>> {
    let snapshot = lake.snapshot().await?;
    let mut found = Vec::new();
    for folder in ["inbox", "runs"] {
        let listed: Vec<_> =
            lake.store().list(Some(&Path::from(folder))).try_collect().await.map_err(|e| Error::read(folder, e))?;
        found.extend(listed.into_iter().map(|meta| meta.location));
    }
    found.sort();
    let known = |path: &Path| {
        let run = path.filename().and_then(|n| n.strip_suffix(".mcap")).and_then(|n| n.parse::<RunId>().ok());
        run.and_then(|r| snapshot.run(&r)).is_some_and(|r| Lake::run_path(&r.surface, &r.run) == *path)
    };
    found.retain(|p| p.extension() == Some("mcap") && !known(p));
    Ok(found.into_iter().map(Source::Lake).collect())
}
