//! The opcode and the length in front of each record.

/// Bytes of the opcode and the length in front of each record.
pub const FRAME_BYTES: usize = 9;

/// The first bytes of a record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordFrame {
    /// The opcode.
    pub code: u8,
    /// Bytes behind the frame.
    pub length: u64,
}

impl RecordFrame {
    /// Returns the frame at the start of `bytes`, which are at least [`FRAME_BYTES`].
    pub fn read(bytes: &[u8]) -> Self {
        let mut length = [0; 8];
        length.copy_from_slice(&bytes[1..FRAME_BYTES]);
        Self { code: bytes[0], length: u64::from_le_bytes(length) }
    }
}
