//! The messages of `proto/echolake/v1`, as `schema/generate` compiles them, and their descriptors for MCAP schemas.

#![allow(missing_docs, reason = "generated; the meaning of every field stands in proto/")]

include!("messages/echolake.v1.rs");

/// The `FileDescriptorSet` of all messages, as the data of an MCAP schema with encoding `protobuf`.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!("messages/echolake.v1.fds");

/// A message that a run's file can hold.
///
/// ```
/// use echolake_schema::messages::{Measurement, Message, Verdict};
/// use prost::Message as _;
///
/// assert_eq!(Measurement::FULL_NAME, "echolake.v1.Measurement");
/// let message = Measurement { pair_id: 7, verdict: Verdict::Accepted.into(), ..Measurement::default() };
/// assert_eq!(Measurement::decode(&*message.encode_to_vec()), Ok(message));
/// ```
pub trait Message: prost::Message + Default {
    /// Its full name, the name of its MCAP schema.
    const FULL_NAME: &'static str;
}

impl Message for SweepRecording {
    const FULL_NAME: &'static str = "echolake.v1.SweepRecording";
}

impl Message for ImpulseResponse {
    const FULL_NAME: &'static str = "echolake.v1.ImpulseResponse";
}

impl Message for AmbientSample {
    const FULL_NAME: &'static str = "echolake.v1.AmbientSample";
}

impl Message for Measurement {
    const FULL_NAME: &'static str = "echolake.v1.Measurement";
}

impl Verdict {
    /// Its name in the tables.
    pub fn label(self) -> &'static str {
        match self {
            Self::Unspecified => "unspecified",
            Self::Accepted => "accepted",
            Self::Repeated => "repeated",
            Self::Rejected => "rejected",
        }
    }
}

impl SampleFormat {
    /// Bytes of one sample; None if the format is unknown.
    pub fn sample_bytes(self) -> Option<usize> {
        match self {
            Self::Unspecified => None,
            Self::S16le => Some(2),
            Self::S24le | Self::S24Split => Some(3),
            Self::S32le | Self::F32le => Some(4),
        }
    }
}
