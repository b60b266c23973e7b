//! Errors of a lake.

use std::path::PathBuf;

use echolake_schema::ErrorCause;

use crate::location_text::object_text;

/// The commands of this build that make a missing lake, as words of a hint.
#[cfg(feature = "tables")]
const LAKE_MAKERS: &str = "`echolake demo`, `echolake acquire` and `echolake import` make one";
#[cfg(not(feature = "tables"))]
const LAKE_MAKERS: &str = "`echolake acquire` makes one";

/// The locations on object stores that this build reaches, as words of a hint.
#[cfg(feature = "remote")]
const REMOTE_LOCATIONS: &str = "s3://bucket/prefix (gs://, az://)";
#[cfg(not(feature = "remote"))]
const REMOTE_LOCATIONS: &str = "use a program with the feature `upload` for object stores";

/// An operation that a lake could not do, by what the caller can do about it.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The location is no path and no URL that this build reaches.
    #[error("`{location}` is not a lake's location: {source}; hint: give a folder, file:///..., or {REMOTE_LOCATIONS}")]
    Location {
        /// The given location.
        location: String,
        /// The fault.
        source: ErrorCause,
    },
    /// There is no lake there.
    #[error("no lake at `{location}`: it has no lake.toml; hint: {LAKE_MAKERS}")]
    NoLake {
        /// The location.
        location: String,
    },
    /// Another program's files are there.
    #[error("`{location}` holds other files and no lake.toml, so no lake is made there; hint: name an empty folder")]
    Occupied {
        /// The location.
        location: String,
    },
    /// The object store lets several create the same object, so that writers would overwrite each other's commits.
    #[error(
        "the object store of `{location}` cannot hold a lake: {observed}; hint: commits need a store that refuses to \
            create an object that exists (`If-None-Match: *`), and a bucket without versions"
    )]
    NotExclusive {
        /// The lake's location.
        location: String,
        /// Observation of the probe.
        observed: String,
    },
    /// `lake.toml` cannot be read.
    #[error("`{}` is damaged: {source}", object_text(location, "lake.toml"))]
    Config {
        /// The lake's location.
        location: String,
        /// The damage.
        source: ErrorCause,
    },
    /// A later version wrote the lake.
    #[error(
        "the lake at `{location}` has format {actual}, the newest that this version reads is {newest}; hint: update \
            echolake"
    )]
    Newer {
        /// The lake's location.
        location: String,
        /// Its format.
        actual: u32,
        /// Ours.
        newest: u32,
    },
    /// The lake was made for another rig.
    #[error(
        "rig `{given}` does not fit the lake at `{location}`, made for rig `{lake}`: {differences}; hint: use the \
            lake's rig, or another lake"
    )]
    OtherRig {
        /// The lake's location.
        location: String,
        /// Name of the given rig.
        given: String,
        /// Name of the lake's rig.
        lake: String,
        /// Field by field, what differs.
        differences: String,
    },
    /// Something is there already, and nothing is overwritten.
    #[error("`{path}` is there already; hint: name a new place")]
    ObjectExists {
        /// The object or folder.
        path: String,
    },
    /// The store refused.
    #[error("cannot {action} `{path}`: {source}{}", source.hint_text())]
    Store {
        /// The attempted operation.
        action: &'static str,
        /// Path of the object.
        path: String,
        /// The store's error.
        source: StoreError,
    },
    /// The commit log of a table is damaged or unreadable.
    #[error("the log of table `{table}` cannot be {action}: {source}")]
    Log {
        /// The table.
        table: &'static str,
        /// The attempted operation.
        action: &'static str,
        /// The fault.
        source: ErrorCause,
    },
    /// A table does not have the rows that `runs` names, or has others besides.
    #[error("table `{table}` is not whole: {found}; hint: {}", rows_hint(table))]
    Incomplete {
        /// The table.
        table: &'static str,
        /// The run with its expected and actual rows, or what else is wrong.
        found: String,
    },
    /// The lake is as a reader of some projects sees it.
    #[error("table `{table}` cannot be {action} by a reader of some projects; hint: open the lake without projects")]
    Restricted {
        /// The table.
        table: &'static str,
        /// The attempted operation.
        action: &'static str,
    },
    /// Rows could not be encoded.
    #[error("rows of table `{table}` cannot be encoded: {reason}")]
    Encode {
        /// The table.
        table: &'static str,
        /// Description of the fault.
        reason: String,
    },
    /// A file of a table cannot be read.
    #[error("`{file}` is damaged: {source}; {}", file_hint(file))]
    DataFile {
        /// The file.
        file: String,
        /// The damage.
        source: ErrorCause,
    },
    /// The folder for a cache is not fit for it.
    #[error("`{}` cannot hold a cache: {source}; hint: --cache names a folder that can be written", folder.display())]
    CacheFolder {
        /// The folder.
        folder: std::path::PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// Another process holds the maintenance lease.
    #[error(
        "`{location}` is being maintained by process {pid} on {host} (lease until {until}); hint: wait for it; where \
            it has died, its lease ends by itself"
    )]
    Maintained {
        /// The lake's location.
        location: String,
        /// The machine.
        host: String,
        /// The process there.
        pid: u32,
        /// End of the lease if it is not renewed.
        until: String,
    },
    /// Another process has taken the lease, because it was not renewed in time.
    #[error("the maintenance lease of `{location}` was lost; hint: nothing is half-done, run the command again")]
    LeaseLost {
        /// The lake's location.
        location: String,
    },
    /// The log does not hold the lake at that moment.
    #[error(
        "the lake has no {moment}: {held}; hint: the log's own clean-up forgets old versions, and tables that are made \
         again count from 0 again"
    )]
    NoMoment {
        /// The moment.
        moment: String,
        /// The versions that the log holds.
        held: String,
    },
    /// Files of that moment are deleted.
    #[error(
        "table `{table}` cannot be seen at {moment}: {missing} of its {files} files then are deleted; hint: `echolake \
            vacuum --keep-hours` keeps files longer"
    )]
    Vacuumed {
        /// The moment.
        moment: String,
        /// The table.
        table: &'static str,
        /// Files that are gone.
        missing: usize,
        /// Files that it had.
        files: usize,
    },
    /// A text that is no name of a tag.
    #[error("`{text}` is no name of a tag: up to 63 of A-Z a-z 0-9 . _ -, beginning with a letter")]
    TagName {
        /// The text.
        text: String,
    },
    /// A tag of that name is there.
    #[error("the lake has a tag `{name}`; hint: `echolake tag --delete {name}` deletes it")]
    TagTaken {
        /// The name.
        name: String,
    },
    /// There is no tag of that name.
    #[error("the lake has no tag `{name}`: {known}; hint: `echolake tag` lists them")]
    NoTag {
        /// The name.
        name: String,
        /// The names of those that are there.
        known: String,
    },
    /// A tag's file cannot be read.
    #[error("tag `{path}` cannot be read: {reason}; hint: restore it from a backup, or delete the file")]
    DamagedTag {
        /// Path in the lake.
        path: String,
        /// The cause.
        reason: String,
    },
    /// The log has forgotten rows of that moment.
    #[error(
        "table `{table}` cannot be seen at {moment}: of the rows of then, its log does not have all: {lacking}; hint: \
         ask for a newer version, `system.versions` lists them"
    )]
    Forgotten {
        /// The moment.
        moment: String,
        /// The table.
        table: &'static str,
        /// The run with its expected and actual rows.
        lacking: String,
    },
    /// The run file that is uploaded, or the journal of its upload beside it, cannot be used.
    #[error("cannot {action} `{}`: {source}{hint}", file.display())]
    UploadFile {
        /// The attempted operation.
        action: &'static str,
        /// The file.
        file: PathBuf,
        /// The cause.
        source: std::io::Error,
        /// What to do about it, with `; hint: ` before it; may be empty.
        hint: &'static str,
    },
    /// Another process uploads the same file.
    #[error("`{}` is being uploaded by another process; hint: wait for its end", file.display())]
    UploadBusy {
        /// The run file.
        file: PathBuf,
    },
    /// A run of this name is in the lake, or on its way there, with other content.
    #[error(
        "`{path}` of `{location}` is another file than the given one: it has {there}, the given file {given}; hint: a \
            run file never changes once closed, so record it under another name; if an upload was given up, delete \
            `{path}.sha256`"
    )]
    OtherUpload {
        /// The lake's location.
        location: String,
        /// Path of the run in the lake.
        path: String,
        /// SHA-256 or size of the lake's.
        there: String,
        /// SHA-256 or size of the given file.
        given: String,
    },
    /// The uploaded object is not what was sent. It is deleted.
    #[error(
        "`{path}` of `{location}` does not hold what was uploaded: it has SHA-256 {actual}, expected {expected}; hint: \
            it is deleted, run the command again"
    )]
    UploadDamaged {
        /// The lake's location.
        location: String,
        /// Path of the object.
        path: String,
        /// Digest of the run file.
        expected: String,
        /// Digest of the object.
        actual: String,
    },
    /// The uploaded object disappeared before it was compared.
    #[error(
        "`{path}` of `{location}` disappeared before its SHA-256 was compared; hint: look into `quarantine/`, then run \
            the command again"
    )]
    UploadGone {
        /// The lake's location.
        location: String,
        /// Path of the object.
        path: String,
    },
    /// A rig or id that is not valid.
    #[error(transparent)]
    Schema(#[from] echolake_schema::Error),
}

/// An object store's error. Its text is that of the innermost cause, which is what a user can act on: object_store
/// wraps the system's error several times. Of a request that was repeated it says how often it was tried.
#[derive(Debug)]
pub struct StoreError(pub object_store::Error);

impl std::fmt::Display for StoreError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let answer = answer_text(&root_cause(&self.0).to_string());
        let cause = answer.unwrap_or_else(|| root_cause(&self.0).to_string());
        write!(f, "{cause}{}", tries_text(&self.0))
    }
}

impl std::error::Error for StoreError {
    // A store's answer is said in full; behind it is only its XML.
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        answer_text(&root_cause(&self.0).to_string()).is_none().then_some(&self.0)
    }
}

impl Error {
    /// Returns whether a table is at fault, which stops no reader of the others.
    pub fn is_table_fault(&self) -> bool {
        matches!(self, Self::Incomplete { .. } | Self::Log { .. } | Self::DataFile { .. })
    }

    pub(crate) fn store_failure(action: &'static str, path: impl ToString, source: object_store::Error) -> Self {
        Self::Store { action, path: path.to_string(), source: StoreError(source) }
    }

    #[cfg(feature = "tables")]
    pub(crate) fn damaged_tag(path: &object_store::path::Path, cause: &serde_json::Error) -> Self {
        Self::DamagedTag { path: path.to_string(), reason: cause.to_string() }
    }

    /// Returns the error of a store that was asked for an object again and again in vain; any other fault is given
    /// back.
    ///
    /// # Errors
    /// The given fault.
    #[cfg(feature = "tables")]
    pub fn from_unanswered(
        path: &object_store::path::Path,
        source: object_store::Error,
    ) -> std::result::Result<Self, object_store::Error> {
        if is_unanswered(&source) { Ok(Self::store_failure("read", path, source)) } else { Err(source) }
    }

    /// Returns the error for a table's file that a store did not give: an absent one is damage to the lake, any other
    /// fault is the store's.
    #[cfg(feature = "tables")]
    pub fn unread_file(file: &object_store::path::Path, source: object_store::Error) -> Self {
        match source {
            // The store's text names the place on the server's disk.
            object_store::Error::NotFound { .. } => {
                Self::DataFile { file: file.to_string(), source: "it is not there".into() }
            }
            source => Self::store_failure("read", file, source),
        }
    }
}

// The table of a file in `tables/`.
/// Tables whose rows users added, so that no run has them.
const OF_USERS: [&str; 2] = ["annotations", "predictions"];

fn rows_hint(table: &str) -> String {
    match OF_USERS.contains(&table) {
        true => lost_rows_hint(table),
        false => "`echolake ingest` derives it again from the runs".to_owned(),
    }
}

/// Returns the ways out for rows of users, which nothing makes again.
fn lost_rows_hint(table: &str) -> String {
    format!("bring `tables/{table}` back from a backup; `echolake rebuild {table}` gives up what is lost of it")
}

/// Returns the way out of a table whose log or files cannot be read.
pub(crate) fn rebuild_hint(table: &str) -> String {
    match OF_USERS.contains(&table) {
        true => format!("hint: {}", lost_rows_hint(table)),
        false => format!("hint: `echolake rebuild {table}` makes it again from the runs"),
    }
}

fn file_hint(file: &str) -> String {
    match file.strip_prefix("tables/").and_then(|within| within.split('/').next()) {
        Some(table) => rebuild_hint(table),
        None => "hint: bring it back from a backup, or put an empty file in its place to give it up".to_owned(),
    }
}

impl StoreError {
    /// The same cause, with a store's error as one that says what a user can act on.
    pub fn plain_cause(cause: ErrorCause) -> ErrorCause {
        match cause.downcast::<object_store::Error>() {
            Ok(error) => Box::new(Self(*error)),
            Err(other) => other,
        }
    }

    /// The advice about a cause that is a store's error, with `; hint: ` before it; empty if nothing is known.
    pub fn cause_hint(cause: &ErrorCause) -> &'static str {
        cause.downcast_ref::<Self>().map_or("", Self::hint_text)
    }

    fn hint_text(&self) -> &'static str {
        let mut source: Option<&dyn std::error::Error> = Some(&self.0);
        while let Some(error) = source {
            if let Some(io) = error.downcast_ref::<std::io::Error>() {
                return match io.kind() {
                    std::io::ErrorKind::StorageFull | std::io::ErrorKind::QuotaExceeded => {
                        "; hint: the disk is full; make space and run the command again, nothing is half-written"
                    }
                    std::io::ErrorKind::PermissionDenied | std::io::ErrorKind::ReadOnlyFilesystem => {
                        "; hint: the lake must be writable for this command"
                    }
                    _ => "",
                };
            }
            source = error.source();
        }
        let answer = answer_text(&root_cause(&self.0).to_string()).unwrap_or_default();
        if answer.contains("NoSuchBucket") {
            return "; hint: is the bucket's name right, and AWS_ENDPOINT_URL that of its store?";
        }
        #[cfg(feature = "remote")]
        if is_unanswered(&self.0) {
            return "; hint: run the same command again when the store answers; what was done stays";
        }
        #[cfg(feature = "remote")]
        if crate::remote::is_forbidden(&self.0) {
            return "; hint: look at the store's credentials in the environment, and at what they allow";
        }
        ""
    }
}

// Stores answer errors as XML: status, code and message of such an answer.
fn answer_text(text: &str) -> Option<String> {
    let element = |name: &str| {
        let (_, from) = text.split_once(&format!("<{name}>"))?;
        Some(from.split_once(&format!("</{name}>"))?.0.trim())
    };
    let (status, _) = text.split_once(": <?xml")?;
    let status = status.rsplit(": ").next().unwrap_or(status);
    let message = element("Message").filter(|message| !message.is_empty());
    let message = message.map(|message| format!(" ({message})")).unwrap_or_default();
    Some(format!("{status}, {}{message}", element("Code")?))
}

fn tries_text(error: &object_store::Error) -> String {
    let tries = count_tries(error);
    if tries > 1 { format!(" (tried {tries} times)") } else { String::new() }
}

#[cfg(feature = "remote")]
fn count_tries(error: &object_store::Error) -> u32 {
    let causes = crate::remote::list_causes(error);
    let retried = causes.filter_map(|cause| cause.downcast_ref::<crate::remote::RetriedError>());
    retried.map(|retried| retried.tries).max().unwrap_or(0).max(crate::remote::count_requests(error))
}

// A disk is asked once.
#[cfg(not(feature = "remote"))]
fn count_tries(_: &object_store::Error) -> u32 {
    1
}

// Returns whether the request was repeated in vain, and not because it is wrong.
#[cfg(feature = "remote")]
fn is_unanswered(error: &object_store::Error) -> bool {
    if answer_text(&root_cause(error).to_string()).is_some_and(|answer| answer.starts_with('4')) {
        return false;
    }
    let mut source = Some(error as &dyn std::error::Error);
    while let Some(cause) = source {
        if cause.is::<crate::remote::RetriedError>() {
            return true;
        }
        source = cause.source();
    }
    false
}

fn root_cause(error: &object_store::Error) -> &dyn std::error::Error {
    let mut cause: &dyn std::error::Error = error;
    while let Some(inner) = cause.source() {
        cause = inner;
    }
    cause
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn answers_of_stores_are_said_in_words_with_the_number_of_tries() {
        let check = |text: &str, expected: &str| {
            let source = object_store::Error::Generic { store: "S3", source: text.to_owned().into() };
            let error = StoreError(source);
            assert_eq!(error.to_string(), expected);
            assert_eq!(std::error::Error::source(&error).is_none(), text.contains("<?xml"), "said in full");
        };
        check("the power is gone", "the power is gone");
        check(
            "Error performing PUT http://host/x in 1.2s, after 3 retries, max_retries: 3, retry_timeout: 180s  - \
             Server returned non-2xx status code: 503 Service Unavailable: <?xml \
             version=\"1.0\"?><Error><Code>SlowDown</Code><Message>Reduce your request rate.</Message></Error>",
            "503 Service Unavailable, SlowDown (Reduce your request rate.) (tried 4 times)",
        );
        check(
            "GET http://host/x: 404 Not Found: <?xml?><Error><Code>NoSuchBucket</Code></Error>",
            "404 Not Found, NoSuchBucket",
        );
        let absent = "404 Not Found: <?xml?><Error><Code>NoSuchBucket</Code></Error>".to_owned();
        let error =
            Error::store_failure("list", "s3://x", object_store::Error::Generic { store: "S3", source: absent.into() });
        assert!(error.to_string().contains("NoSuchBucket; hint: is the bucket's name right"), "{error}");
    }
}
