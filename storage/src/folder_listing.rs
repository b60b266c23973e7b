//! Lists a folder of a lake entry by entry, for folders that anybody may put things into.
//!
//! `object_store`'s own listing follows symbolic links, and fails as a whole at a name that is not UTF-8, at a control
//! character and at a link that leads back. Here each entry is judged alone: plain files with usable names are listed,
//! and anything else is named with the reason why nothing opens it.

use std::ffi::OsStr;
use std::fmt::Write as _;
use std::fs::{self, DirEntry};
use std::io::{self, ErrorKind};
use std::os::unix::fs::FileTypeExt as _;
use std::path::{Path as FsPath, PathBuf};

use chrono::{DateTime, Utc};
use futures::TryStreamExt as _;
use object_store::path::Path;
use object_store::{ObjectMeta, ObjectStore as _};

use crate::{Error, Lake, Result};

/// Contents of a folder of a lake, and of the folders in it.
#[derive(Debug, Clone, Default)]
pub struct FolderListing {
    /// Plain files with usable names, by path.
    pub files: Vec<ObjectMeta>,
    /// What else there is.
    pub unusable: Vec<UnusableEntry>,
}

/// An entry of a folder that nothing opens.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct UnusableEntry {
    /// Its path in the lake; control characters and bytes that are no UTF-8 are escaped.
    pub path: String,
    /// The reason.
    pub reason: String,
    /// Size.
    pub bytes: u64,
    /// Time of its last change.
    pub changed: DateTime<Utc>,
}

impl Lake {
    /// Lists a folder of the lake. A folder that is absent is empty.
    ///
    /// ```
    /// # tokio::runtime::Runtime::new()?.block_on(async {
    /// # let place = tempfile::tempdir()?;
    /// use echolake_lake::{Lake, ReferenceSurfaces};
    ///
    /// let folder = place.path().join("lake");
    /// let url = folder.to_string_lossy();
    /// let lake = Lake::open_or_create(&url, &Default::default(), &ReferenceSurfaces::default()).await?;
    /// std::fs::create_dir(folder.join("inbox"))?;
    /// std::fs::write(folder.join("inbox/a.mcap"), "a run")?;
    /// std::os::unix::fs::symlink("..", folder.join("inbox/up"))?;
    /// let listing = lake.list_folder("inbox").await?;
    /// assert_eq!((listing.files.len(), listing.files[0].size), (1, 5));
    /// assert_eq!(listing.unusable[0].path, "inbox/up");
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// # })?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Store`] if the folder itself cannot be listed.
    pub async fn list_folder(&self, folder: &str) -> Result<FolderListing> {
        let failed = |e| Error::store_failure("list", folder, e);
        let mut listing = match self.folder() {
            Some(lake) => {
                let lake = lake.to_owned();
                let folder = folder.to_owned();
                let walk = move || list_local_folder(&lake, &folder);
                let join_failed = |source| failed(object_store::Error::JoinError { source });
                let read_failed = |e: io::Error| {
                    failed(object_store::Error::Generic { store: "LocalFileSystem", source: Box::new(e) })
                };
                tokio::task::spawn_blocking(walk).await.map_err(join_failed)?.map_err(read_failed)?
            }
            None => {
                let listed = self.store().list(Some(&Path::from(folder))).try_collect().await;
                FolderListing { files: listed.map_err(failed)?, unusable: Vec::new() }
            }
        };
        listing.files.sort_by(|a, b| a.location.cmp(&b.location));
        listing.unusable.sort();
        Ok(listing)
    }
}

/// A folder that is still to be read.
struct OpenFolder {
    path: PathBuf,
    /// Its path in the lake.
    location: String,
}

fn list_local_folder(lake: &FsPath, folder: &str) -> io::Result<FolderListing> {
    let mut listing = FolderListing::default();
    // The folder itself may be a link: whoever moved it to another disk owns the lake.
    let entries = match fs::read_dir(lake.join(folder)) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(listing),
        entries => entries?,
    };
    let mut folders = Vec::new();
    for entry in entries {
        judge_entry(&entry?, folder, &mut listing, &mut folders);
    }
    while let Some(OpenFolder { path, location }) = folders.pop() {
        let read = fs::read_dir(&path).and_then(|entries| entries.collect::<io::Result<Vec<_>>>());
        match read {
            Ok(entries) => {
                entries.iter().for_each(|entry| judge_entry(entry, &location, &mut listing, &mut folders));
            }
            Err(e) if e.kind() == ErrorKind::NotFound => {}
            Err(e) => listing.unusable.push(UnusableEntry {
                reason: format!("a folder that cannot be read: {e}"),
                ..UnusableEntry::new(location, &path)
            }),
        }
    }
    Ok(listing)
}

fn judge_entry(entry: &DirEntry, folder: &str, listing: &mut FolderListing, folders: &mut Vec<OpenFolder>) {
    let path = entry.path();
    let name = entry.file_name();
    let location = format!("{folder}/{}", escape_name(&name));
    let unusable =
        |reason: &str| UnusableEntry { reason: reason.to_owned(), ..UnusableEntry::new(location.clone(), &path) };
    // Neither of the two follows a link.
    let (kind, meta) = match (entry.file_type(), entry.metadata()) {
        (Ok(kind), Ok(meta)) => (kind, meta),
        // It is gone again.
        (Err(e), _) | (_, Err(e)) if e.kind() == ErrorKind::NotFound => return,
        (Err(e), _) | (_, Err(e)) => {
            listing.unusable.push(unusable(&format!("nothing is known of it: {e}")));
            return;
        }
    };
    let usable = name.to_str().filter(|name| !name.chars().any(char::is_control));
    let reason = match usable {
        _ if kind.is_symlink() => "a symbolic link, which is not followed; hint: put the file itself there",
        _ if kind.is_fifo() => "a named pipe, expected a file",
        _ if kind.is_socket() => "a socket, expected a file",
        _ if kind.is_block_device() || kind.is_char_device() => "a device, expected a file",
        None if name.to_str().is_none() => "its name is not UTF-8; hint: rename it",
        None => "its name has a control character; hint: rename it",
        Some(name) if kind.is_dir() => {
            if FsPath::new(name).extension().is_some_and(|e| e == "mcap") {
                listing.unusable.push(unusable("a folder, expected a file"));
            }
            folders.push(OpenFolder { path, location });
            return;
        }
        // What a write of this program has not brought to its end.
        Some(name) if is_temporary(name) => return,
        Some(_) => match Path::parse(&location) {
            Ok(location) => {
                let last_modified = meta.modified().map(DateTime::<Utc>::from).unwrap_or_default();
                let meta = ObjectMeta { location, last_modified, size: meta.len(), e_tag: None, version: None };
                listing.files.push(meta);
                return;
            }
            Err(_) => "its name is none that a lake can hold; hint: rename it",
        },
    };
    listing.unusable.push(unusable(reason));
}

impl UnusableEntry {
    fn new(path: String, file: &FsPath) -> Self {
        let meta = fs::symlink_metadata(file).ok();
        let changed = meta.as_ref().and_then(|meta| meta.modified().ok()).map(DateTime::<Utc>::from);
        Self { path, reason: String::new(), bytes: meta.map_or(0, |m| m.len()), changed: changed.unwrap_or_default() }
    }
}

// The store hides such names, too: a `#`, and digits to the end.
fn is_temporary(name: &str) -> bool {
    let number = name.split_once('#').map(|(_, number)| number);
    number.is_some_and(|number| !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit()))
}

fn escape_name(name: &OsStr) -> String {
    let mut text = String::new();
    for part in name.as_encoded_bytes().utf8_chunks() {
        for c in part.valid().chars() {
            match c.is_control() {
                true => text.extend(c.escape_default()),
                false => text.push(c),
            }
        }
        for byte in part.invalid() {
            // Writing to a string does not fail.
            let _ = write!(text, "\\x{byte:02x}");
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use std::os::unix::ffi::OsStrExt as _;
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use super::*;

    #[test]
    fn each_entry_is_judged_alone_and_no_link_is_followed() {
        let place = tempfile::tempdir().expect("a folder");
        let inbox = place.path().join("inbox");
        let elsewhere = place.path().join("elsewhere");
        for folder in ["inbox/sub", "inbox/folder.mcap", "elsewhere"] {
            fs::create_dir_all(place.path().join(folder)).expect("made");
        }
        fs::write(elsewhere.join("theirs.mcap"), "theirs").expect("written");
        let long = format!("{}.mcap", "n".repeat(250));
        let good =
            ["a.mcap", "b c%20~#x.mcap", "über.mcap", &long, "sub/deep.mcap", "folder.mcap/in.mcap", "notes.txt"];
        for name in good {
            fs::write(inbox.join(name), "1234").expect("written");
        }
        fs::write(inbox.join("being written.mcap#12"), "").expect("written");
        symlink("..", inbox.join("up")).expect("linked");
        symlink(&elsewhere, inbox.join("other")).expect("linked");
        symlink(elsewhere.join("theirs.mcap"), inbox.join("link.mcap")).expect("linked");
        symlink("nowhere", inbox.join("broken.mcap")).expect("linked");
        fs::write(inbox.join(OsStr::from_bytes(b"\xff\x1b.mcap")), "1").expect("written");
        fs::write(inbox.join("line\nbreak.mcap"), "12").expect("written");
        fs::write(inbox.join("c1\u{9b}.mcap"), "1").expect("written");
        let _socket = UnixListener::bind(inbox.join("s.mcap")).expect("bound");

        let listing = list_local_folder(place.path(), "inbox").expect("listed");
        let mut files: Vec<_> = listing.files.iter().map(|f| f.location.as_ref().to_owned()).collect();
        files.sort();
        let mut expected: Vec<_> = good.iter().map(|name| format!("inbox/{name}")).collect();
        expected.sort();
        assert_eq!(files, expected);
        assert!(listing.files.iter().all(|file| file.size == 4));
        let mut others: Vec<_> = listing.unusable.iter().map(|e| (e.path.as_str(), e.reason.as_str())).collect();
        others.sort_unstable();
        let link = "a symbolic link, which is not followed; hint: put the file itself there";
        let control = "its name has a control character; hint: rename it";
        assert_eq!(
            others,
            [
                ("inbox/\\xff\\u{1b}.mcap", "its name is not UTF-8; hint: rename it"),
                ("inbox/broken.mcap", link),
                ("inbox/c1\\u{9b}.mcap", control),
                ("inbox/folder.mcap", "a folder, expected a file"),
                ("inbox/line\\nbreak.mcap", control),
                ("inbox/link.mcap", link),
                ("inbox/other", link),
                ("inbox/s.mcap", "a socket, expected a file"),
                ("inbox/up", link),
            ]
        );
        assert!(list_local_folder(place.path(), "absent").expect("listed").files.is_empty());
    }
}
