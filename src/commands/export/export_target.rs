//! The place of an export: a disk of this machine, or an object store.

use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use echolake_lake::{ObjectFolder, file_sha256, remote_access};
use tempfile::TempDir;

/// File with the checksums of all others. In an object store it is the last one to come.
const CHECKSUMS: &str = "SHA256SUMS";

/// A file or folder that `--output` names.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum ExportTarget {
    /// On a disk of this machine.
    Local(PathBuf),
    /// In an object store, such as `s3://bucket/prefix/name`.
    Remote(String),
}

impl ExportTarget {
    /// Parses an argument.
    pub fn parse(text: &str) -> Result<Self, String> {
        match text.split_once("://") {
            None => Ok(Self::Local(text.into())),
            Some(("file", path)) if path.starts_with('/') => Ok(Self::Local(path.into())),
            Some(_) if remote_access(text).is_some() => Ok(Self::Remote(text.trim_end_matches('/').to_owned())),
            // Otherwise a URL would become folders of its name.
            Some(_) => {
                Err("exports are not written there; hint: name a path, or s3://bucket/prefix/name (gs://, az://)"
                    .into())
            }
        }
    }
}

impl fmt::Display for ExportTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Local(path) => path.display().fmt(f),
            Self::Remote(location) => f.write_str(location),
        }
    }
}

/// An export on its way to its target. To an object store it goes from a temporary folder.
#[derive(Debug)]
pub(super) struct PendingExport {
    path: PathBuf,
    remote: Option<RemoteExport>,
}

#[derive(Debug)]
struct RemoteExport {
    folder: ObjectFolder,
    /// Deleted when it is dropped.
    spool: TempDir,
    location: String,
}

impl PendingExport {
    /// Prepares a folder of files. In an object store nothing may be below its name.
    pub async fn prepare_folder(target: &ExportTarget) -> anyhow::Result<Self> {
        match target {
            ExportTarget::Local(path) => Ok(Self { path: path.clone(), remote: None }),
            ExportTarget::Remote(location) => {
                let folder = ObjectFolder::open(location)?;
                folder.ensure_empty().await?;
                Self::prepare_remote(folder, "export", location)
            }
        }
    }

    /// Prepares a single file.
    pub async fn prepare_file(target: &ExportTarget) -> anyhow::Result<Self> {
        match target {
            ExportTarget::Local(path) => Ok(Self { path: path.clone(), remote: None }),
            ExportTarget::Remote(location) => {
                let named = location.rsplit_once('/').filter(|(parent, _)| !parent.ends_with(":/"));
                let (parent, name) =
                    named.with_context(|| format!("`{location}` names no object; hint: s3://bucket/prefix/NAME"))?;
                let folder = ObjectFolder::open(parent)?;
                folder.ensure_absent(name).await?;
                Self::prepare_remote(folder, name, location)
            }
        }
    }

    fn prepare_remote(folder: ObjectFolder, name: &str, location: &str) -> anyhow::Result<Self> {
        let spool = tempfile::Builder::new().prefix("echolake-export-").tempdir();
        let spool = spool.context("cannot make a temporary folder; hint: $TMPDIR names another disk")?;
        let path = spool.path().join(name);
        let location = location.to_owned();
        Ok(Self { path, remote: Some(RemoteExport { folder, spool, location }) })
    }

    /// Returns the path on this machine to write to.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Sends what was written to its target: data first, checksums last.
    pub async fn publish(self) -> anyhow::Result<()> {
        let Some(RemoteExport { folder, spool, location }) = self.remote else { return Ok(()) };
        if self.path.is_file() {
            let name = self.path.file_name().unwrap_or_default().to_string_lossy();
            folder.send_file(&self.path, &name).await?;
            return Ok(());
        }
        let mut names = Vec::new();
        collect_names(&self.path, "", &mut names)?;
        names.sort();
        let checksums = self.path.join(CHECKSUMS);
        if !checksums.exists() {
            let line = |name: &String| -> anyhow::Result<String> {
                let (digest, _) =
                    file_sha256(&self.path.join(name), &mut |_| {}).with_context(|| format!("cannot read `{name}`"))?;
                Ok(format!("{digest}  {name}\n"))
            };
            let lines = names.iter().map(line).collect::<anyhow::Result<String>>()?;
            std::fs::write(&checksums, lines)
                .with_context(|| format!("cannot write in `{}`", spool.path().display()))?;
        }
        names.retain(|name| name != CHECKSUMS);
        for name in names.iter().map(String::as_str).chain([CHECKSUMS]) {
            folder.send_file(&self.path.join(name), name).await?;
        }
        eprintln!("{location}: {} files and {CHECKSUMS}", names.len());
        Ok(())
    }
}

// Paths below a folder, with `/` between their parts.
fn collect_names(folder: &Path, prefix: &str, names: &mut Vec<String>) -> anyhow::Result<()> {
    for entry in folder.read_dir().with_context(|| format!("cannot read `{}`", folder.display()))? {
        let entry = entry?;
        let name = format!("{prefix}{}", entry.file_name().to_string_lossy());
        match entry.file_type()?.is_dir() {
            true => collect_names(&entry.path(), &format!("{name}/"), names)?,
            false => names.push(name),
        }
    }
    Ok(())
}
