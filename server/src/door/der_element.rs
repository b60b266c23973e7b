//! Elements of DER, in which certificates are written.

/// An element.
pub(super) struct DerElement<'a> {
    /// Its content.
    pub content: &'a [u8],
    /// The bytes that follow it.
    pub rest: &'a [u8],
}

impl<'a> DerElement<'a> {
    /// Reads the first element; None if there is no whole one.
    pub fn read_first(der: &'a [u8]) -> Option<Self> {
        let (&[_kind, length], rest) = der.split_first_chunk()?;
        let (bytes, rest) = match length {
            0..=0x7f => (usize::from(length), rest),
            0x81..=0x84 => {
                let (length, rest) = rest.split_at_checked(usize::from(length & 0x7f))?;
                (length.iter().fold(0, |bytes, byte| bytes << 8 | usize::from(*byte)), rest)
            }
            _ => return None,
        };
        let (content, rest) = rest.split_at_checked(bytes)?;
        Some(Self { content, rest })
    }
}
