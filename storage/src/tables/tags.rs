//! Tags: names for versions of the lake. While there is one, the tables' logs are kept as a whole, and `vacuum` keeps
//! the files of its version.

use std::collections::HashSet;
use std::fmt;
use std::str::FromStr;

use chrono::{DateTime, Utc};
use echolake_schema::tables::Table;
use futures::TryStreamExt as _;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt as _, PutMode};
use serde::{Deserialize, Serialize};

use crate::locks::MaintenanceLease;
use crate::{Error, Lake, LakeMoment, Result, TableVersion};

/// Folder of the tags: a JSON file each.
const FOLDER: &str = "tags";
/// Longest name.
const LONGEST: usize = 63;

/// Name of a tag: up to 63 of `A-Z a-z 0-9 . _ -`, beginning with a letter.
///
/// ```
/// use echolake_lake::TagName;
///
/// assert_eq!("baseline-2026-11".parse::<TagName>()?.as_str(), "baseline-2026-11");
/// assert!("2026-11".parse::<TagName>().is_err());
/// # Ok::<(), echolake_lake::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct TagName(String);

/// A version of the lake with its name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct LakeTag {
    /// The name.
    pub name: TagName,
    /// The version.
    pub version: u64,
    /// Time at which the version was committed.
    pub committed: DateTime<Utc>,
    /// Time at which the version was tagged.
    pub tagged: DateTime<Utc>,
}

impl LakeTag {
    /// Returns whether it names a version of the log as it is now.
    pub fn is_of(&self, version: &TableVersion) -> bool {
        (self.version, self.committed) == (version.version, version.committed)
    }
}

impl TagName {
    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }

    fn path(&self) -> Path {
        Path::from(FOLDER).join(format!("{}.json", self.0))
    }
}

impl fmt::Display for TagName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for TagName {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let is_name = text.len() <= LONGEST
            && text.starts_with(|c: char| c.is_ascii_alphabetic())
            && text.bytes().all(|b| b.is_ascii_alphanumeric() || b"._-".contains(&b));
        if is_name { Ok(Self(text.to_owned())) } else { Err(Error::TagName { text: text.to_owned() }) }
    }
}

impl TryFrom<String> for TagName {
    type Error = Error;

    fn try_from(text: String) -> Result<Self> {
        text.parse()
    }
}

impl Lake {
    /// Names a version, under the maintenance lease, so that no `vacuum` deletes its files meanwhile.
    ///
    /// # Errors
    /// [`Error::TagTaken`]; [`Error::NoMoment`], [`Error::Vacuumed`] or [`Error::Forgotten`] if the version cannot be
    /// seen as a whole; [`Error::Maintained`]; or what the store says.
    pub async fn create_tag(&self, name: &TagName, moment: &LakeMoment) -> Result<LakeTag> {
        let lease = MaintenanceLease::acquire(self).await?;
        let made = self.write_tag(name, moment).await;
        let released = lease.release().await;
        made.and_then(|tag| released.map(|()| tag))
    }

    async fn write_tag(&self, name: &TagName, moment: &LakeMoment) -> Result<LakeTag> {
        let TableVersion { version, committed, .. } = self.find_version(moment).await?;
        for table in Table::ALL {
            self.snapshot_at(version, table).await?;
        }
        let tag = LakeTag { name: name.clone(), version, committed, tagged: Utc::now() };
        let text = serde_json::to_vec_pretty(&tag).map_err(|e| Error::damaged_tag(&name.path(), &e))?;
        match self.store().put_opts(&name.path(), text.into(), PutMode::Create.into()).await {
            Ok(_) => Ok(tag),
            Err(object_store::Error::AlreadyExists { .. }) => Err(Error::TagTaken { name: name.to_string() }),
            Err(e) => Err(Error::store_failure("write", name.path(), e)),
        }
    }

    /// The tags by name.
    ///
    /// # Errors
    /// [`Error::DamagedTag`], or what the store says.
    pub async fn list_tags(&self) -> Result<Vec<LakeTag>> {
        let files = tag_files(self.store().as_ref()).await?;
        let mut tags = Vec::with_capacity(files.len());
        for path in files {
            tags.extend(self.read_tag(&path).await?);
        }
        tags.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(tags)
    }

    /// The tag of a name.
    ///
    /// # Errors
    /// [`Error::NoTag`], [`Error::DamagedTag`], or what the store says.
    pub async fn find_tag(&self, name: &TagName) -> Result<LakeTag> {
        if let Some(tag) = self.read_tag(&name.path()).await? {
            return Ok(tag);
        }
        let known: Vec<_> = self.list_tags().await?.into_iter().map(|tag| format!("`{}`", tag.name)).collect();
        let known = if known.is_empty() { "it has none".to_owned() } else { format!("there are {}", known.join(", ")) };
        Err(Error::NoTag { name: name.to_string(), known })
    }

    /// Deletes a tag; its version stays until the logs' retention and `vacuum` end it.
    ///
    /// # Errors
    /// [`Error::NoTag`], or what the store says.
    pub async fn delete_tag(&self, name: &TagName) -> Result<()> {
        self.find_tag(name).await?;
        self.store().delete(&name.path()).await.map_err(|e| Error::store_failure("delete", name.path(), e))
    }

    /// The tagged versions that the log has; a tag of tables that are gone keeps nothing.
    pub(crate) async fn tagged_versions(&self) -> Result<Vec<u64>> {
        let tags = self.list_tags().await?;
        let versions = if tags.is_empty() { Vec::new() } else { self.list_versions().await? };
        let tagged = versions.iter().filter(|version| tags.iter().any(|tag| tag.is_of(version)));
        Ok(tagged.map(|version| version.version).collect())
    }

    /// The files of a table at some versions.
    pub(crate) async fn files_at_versions(&self, table: Table, versions: &[u64]) -> Result<HashSet<Path>> {
        let mut files = HashSet::new();
        for version in versions {
            let snapshot = self.snapshot_at(*version, table).await?;
            files.extend(snapshot.files(table).iter().map(|file| file.path.clone()));
        }
        Ok(files)
    }

    async fn read_tag(&self, path: &Path) -> Result<Option<LakeTag>> {
        let bytes = match self.store().get(path).await {
            Ok(found) => found.bytes().await.map_err(|e| Error::store_failure("read", path, e))?,
            Err(object_store::Error::NotFound { .. }) => return Ok(None),
            Err(e) => return Err(Error::store_failure("read", path, e)),
        };
        serde_json::from_slice(&bytes).map(Some).map_err(|e| Error::damaged_tag(path, &e))
    }
}

/// Returns whether the lake of a store has tags.
pub(super) async fn has_tags(store: &dyn ObjectStore) -> Result<bool> {
    tag_files(store).await.map(|files| !files.is_empty())
}

async fn tag_files(store: &dyn ObjectStore) -> Result<Vec<Path>> {
    let folder = Path::from(FOLDER);
    let files: Vec<_> =
        store.list(Some(&folder)).try_collect().await.map_err(|e| Error::store_failure("list", &folder, e))?;
    Ok(files.into_iter().map(|meta| meta.location).filter(|path| path.extension() == Some("json")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_none_of_versions_or_times() {
        for text in ["12", "2026-11-21", "", "a b", "a/b", "-a", "\u{e4}", &"a".repeat(64)] {
            assert!(text.parse::<TagName>().is_err(), "{text}");
        }
        for text in ["a", "baseline-2026-11", "v1.2_final", &"a".repeat(63)] {
            assert_eq!(text.parse::<TagName>().expect("a name").as_str(), text);
        }
    }
}
