//! Errors between a run's file and the tables.

use std::ops::Range;

use echolake_dsp::foam_reflection::LEAST_PAIRS;
use echolake_lake::StoreError;
use echolake_recording::{FILE_END_BYTES, ResyncError};
use echolake_schema::ErrorCause;
use echolake_schema::manifest::ManifestError;

/// An error of an ingest.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The file cannot be read.
    #[error("cannot read `{file}`: {source}{}", StoreError::cause_hint(source))]
    Read {
        /// The file.
        file: String,
        /// The cause.
        source: ErrorCause,
    },
    /// The file is no MCAP file at all.
    #[error(
        "`{file}` is not an MCAP file: it begins with {actual}, expected the magic bytes `89 MCAP 30 0D 0A`; hint: is \
            it the right file?"
    )]
    NotMcap {
        /// The file.
        file: String,
        /// Its first bytes.
        actual: String,
    },
    /// An MCAP file, but not one of our runs.
    #[error(
        "`{file}` is an MCAP file but no run of echolake: it has no metadata `echolake.run`; hint: only recordings of \
            `echolake acquire` and `echolake import` can be ingested"
    )]
    Foreign {
        /// The file.
        file: String,
    },
    /// Its metadata is damaged.
    #[error("`{file}` cannot be taken in: {cause}")]
    Manifest {
        /// The file.
        file: String,
        /// The cause.
        #[source]
        cause: ManifestError,
    },
    /// Its metadata may be damaged.
    #[error("`{file}` cannot be taken in: {reason}")]
    Doubtful {
        /// The file.
        file: String,
        /// The evidence against it.
        reason: String,
    },
    /// An attachment that must be there is missing or damaged.
    #[error("`{file}`: attachment `{attachment}` {source}")]
    Attachment {
        /// The file.
        file: String,
        /// The attachment.
        attachment: &'static str,
        /// The damage.
        source: ErrorCause,
    },
    /// Another run of this name is in the lake.
    #[error(
        "run `{run}` is already in the lake with other content: `{file}` has SHA-256 {given}, the lake's file \
         {there}; hint: a run file never changes once closed; if the given one is right, `echolake remove {run}` takes \
         the lake's out"
    )]
    OtherContent {
        /// The run.
        run: String,
        /// The given file.
        file: String,
        /// Its digest.
        given: String,
        /// The digest of the lake's file.
        there: String,
    },
    /// No such run.
    #[error("no run at `{given}`: it is neither a file nor the name of a run in the lake's inbox or runs")]
    NoRun {
        /// The given argument.
        given: String,
    },
    /// The file has disappeared since it was listed.
    #[error("`{file}` is gone: another ingest has taken it, or somebody deleted it")]
    Gone {
        /// The file.
        file: String,
    },
    /// The file does not end as a closed file does: it is still being copied, or its recording was cut off.
    #[error(
        "`{file}` is not whole: it has {bytes} bytes, and its last {} are not the footer and the magic bytes that a \
         closed file ends with; it stays where it is. hint: once its copy has ended, ingest it again; if its recording \
         was cut off, `echolake recover` makes a run of what it holds",
        FILE_END_BYTES
    )]
    Unfinished {
        /// The file.
        file: String,
        /// Its size.
        bytes: u64,
    },
    /// The file ends as a closed file does, and is not filled: it is still being copied.
    #[error(
        "`{file}` is not whole: the CRC of its data is not the one behind them, and its bytes {} to {} are zeros, as \
         in a copy that is not made in order; it stays where it is. hint: once its copy has ended, ingest it again; if \
         nothing copies it, `echolake recover` makes a run of what it holds",
        hole.start,
        hole.end
    )]
    Unfilled {
        /// The file.
        file: String,
        /// The first zeros that were found.
        hole: Range<u64>,
    },
    /// A recording whose recorder died, and which cannot be resumed.
    #[error(
        "`{file}` was cut off after {bytes} bytes: its recorder has ended; it stays where it is. hint: `echolake \
         recover` makes a run of what it holds"
    )]
    CutOff {
        /// The file.
        file: String,
        /// Its size.
        bytes: u64,
    },
    /// The file changed while it was read.
    #[error(
        "`{file}` changed while it was read: {before}, now {after}; it stays where it is. hint: ingest it again once \
         nothing writes it any more"
    )]
    Changed {
        /// The file.
        file: String,
        /// Its state before.
        before: String,
        /// Its state now.
        after: String,
    },
    /// An entry of a folder that is no plain file with a usable name.
    #[error("`{path}` is passed over: {reason}")]
    Unusable {
        /// Its path, escaped.
        path: String,
        /// The reason.
        reason: String,
    },
    /// A removed run is in the lake again.
    #[error("run `{run}` was ingested again while it was removed; hint: remove it again once no ingest is at work")]
    CameBack {
        /// The run.
        run: String,
    },
    /// Another ingest is at it.
    #[error("`{file}` is being taken in by another ingest")]
    Claimed {
        /// The file.
        file: String,
    },
    /// The file is not the one that was uploaded.
    #[error(
        "`{file}` is not what was uploaded: it has SHA-256 {actual}, and `{file}.sha256` says {recorded}; hint: upload \
            it again"
    )]
    OtherDigest {
        /// The file.
        file: String,
        /// The digest beside it.
        recorded: String,
        /// Its own.
        actual: String,
    },
    /// Processes end while they ingest it.
    #[error(
        "`{file}` is passed over: processes that took in this file alone ended on the way ({endings}); hint: to retry \
            it, move it back into `inbox/`, or delete `{mark}`"
    )]
    Deadly {
        /// The file.
        file: String,
        /// Their exit statuses or signals.
        endings: String,
        /// Path of the mark that records them.
        mark: String,
    },
    /// A kernel refused.
    #[error("`{file}`: {cause}")]
    Kernel {
        /// The file.
        file: String,
        /// The kernel's error.
        #[source]
        cause: echolake_dsp::Error,
    },
    /// The direct sound without Foam's reflection is wanted and cannot be estimated.
    #[error(
        "Foam's reflection cannot be estimated from `{foam}` and `{flat}`, which `direct_sound = \"estimated\"` of \
         lake.toml needs: expected {} pairs whose direct and reflected sound are well apart, and a Flat that reflects \
         more than Foam; hint: set it to \"foam\"",
        LEAST_PAIRS
    )]
    FoamReflection {
        /// The surface that is Foam.
        foam: String,
        /// The surface that is Flat.
        flat: String,
    },
    /// A data file of the lake cannot be read.
    #[error("`{file}` in the lake is damaged: {reason}; hint: `echolake rebuild` makes the tables again from the runs")]
    DataFile {
        /// The file.
        file: String,
        /// The cause.
        reason: String,
    },
    /// The machine gives no more threads.
    #[error("cannot start the threads that compute: {source}; hint: is a limit of processes reached?")]
    Threads {
        /// The cause.
        source: rayon::ThreadPoolBuildError,
    },
    /// The ingest was stopped.
    #[error("stopped; hint: run the same command again to resume")]
    Stopped,
    /// An error of the lake.
    #[error(transparent)]
    Lake(#[from] echolake_lake::Error),
}

impl From<ResyncError> for Error {
    fn from(error: ResyncError) -> Self {
        match error {
            ResyncError::Read { file, source } => Self::read_failure(file, source),
            ResyncError::Gone { file } => Self::Gone { file },
            ResyncError::NotMcap { file, actual } => Self::NotMcap { file, actual },
        }
    }
}

/// The result of a step of ingest.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// Returns whether the error concerns this one file alone, so that others can still be ingested.
    pub fn is_refusal(&self) -> bool {
        match self {
            Self::Read { .. } | Self::NotMcap { .. } | Self::Foreign { .. } | Self::Manifest { .. } => true,
            Self::Attachment { .. } | Self::OtherContent { .. } | Self::NoRun { .. } | Self::Gone { .. } => true,
            Self::Claimed { .. } | Self::OtherDigest { .. } => true,
            Self::Unfilled { .. } => true,
            Self::Unfinished { .. } | Self::CutOff { .. } | Self::Changed { .. } | Self::Unusable { .. } => true,
            Self::Deadly { .. }
            | Self::Doubtful { .. }
            | Self::Kernel { .. }
            | Self::Lake(echolake_lake::Error::OtherRig { .. }) => true,
            Self::FoamReflection { .. }
            | Self::DataFile { .. }
            | Self::Threads { .. }
            | Self::Stopped
            | Self::CameBack { .. }
            | Self::Lake(_) => false,
        }
    }

    /// Returns whether the file stays in the inbox: it may be readable or whole later.
    pub(crate) fn keeps_place(&self) -> bool {
        matches!(
            self,
            Self::Read { .. }
                | Self::Unfinished { .. }
                | Self::Unfilled { .. }
                | Self::CutOff { .. }
                | Self::Changed { .. }
                | Self::Gone { .. }
        )
    }

    pub(crate) fn read_failure(file: impl ToString, source: impl Into<ErrorCause>) -> Self {
        Self::Read { file: file.to_string(), source: StoreError::plain_cause(source.into()) }
    }
}

#[cfg(test)]
mod tests {
    use std::io;

    use super::*;

    #[test]
    fn a_file_that_its_store_does_not_give_is_refused_with_a_hint() {
        let denied = io::Error::from(io::ErrorKind::PermissionDenied);
        let source = object_store::Error::Generic { store: "S3", source: Box::new(denied) };
        for error in [
            Error::read_failure("inbox/a.mcap", object_store::Error::Generic { store: "S3", source: "odd".into() }),
            ResyncError::Read { file: "inbox/a.mcap".into(), source: Box::new(source) }.into(),
        ] {
            let text = error.to_string();
            assert!(text.starts_with("cannot read `inbox/a.mcap`: ") && !text.contains("Generic"), "{text}");
            assert_eq!(text.contains("; hint: "), text.contains("permission denied"), "{text}");
        }
    }
}
