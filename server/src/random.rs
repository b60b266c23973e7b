//! Bytes that nobody can guess, for tokens and for handles of statements.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, Read as _};

/// The system's generator.
const DEVICE: &str = "/dev/urandom";

/// Random bytes.
///
/// # Errors
/// Where the system has none.
pub(crate) fn bytes<const N: usize>() -> io::Result<[u8; N]> {
    let mut bytes = [0; N];
    File::open(DEVICE)?.read_exact(&mut bytes)?;
    Ok(bytes)
}

/// Bytes as hexadecimal digits.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// The bytes that hexadecimal digits stand for; None where they do not make N bytes.
pub(crate) fn unhex<const N: usize>(text: &str) -> Option<[u8; N]> {
    let mut bytes = [0; N];
    if text.len() != 2 * N || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
        return None;
    }
    for (i, byte) in bytes.iter_mut().enumerate() {
        *byte = u8::from_str_radix(&text[2 * i..2 * i + 2], 16).ok()?;
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hexadecimal_there_and_back() {
        let random: [u8; 16] = bytes().expect("random bytes");
        assert_eq!(unhex(&hex(&random)), Some(random));
        assert_ne!(bytes::<16>().expect("random bytes"), random);
        for wrong in ["", "0", "zz", "+1", "0001", "é"] {
            assert_eq!(unhex::<1>(wrong), None, "{wrong}");
        }
    }
}
