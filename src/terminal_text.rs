//! Texts of users on their way to a terminal, which control characters in them would otherwise drive.

use std::io::{self, IsTerminal as _, Write};
use std::str::from_utf8;

use echolake_schema::escape_controls;

/// Standard output; a terminal gets control characters in escaped form, a file or a pipe every byte as it is.
pub(crate) fn text_output() -> TextOutput<io::Stdout> {
    let stdout = io::stdout();
    if stdout.is_terminal() { TextOutput::Escaped { to: stdout, begun: Vec::new() } } else { TextOutput::Plain(stdout) }
}

/// An output for texts of users.
pub(crate) enum TextOutput<W: Write> {
    /// Every byte as it is.
    Plain(W),
    /// Without control characters.
    Escaped {
        /// The terminal.
        to: W,
        /// The beginning of a character whose other bytes are still to come.
        begun: Vec<u8>,
    },
}

impl<W: Write> Write for TextOutput<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let (to, begun) = match self {
            Self::Plain(to) => return to.write(bytes),
            Self::Escaped { to, begun } => (to, begun),
        };
        begun.extend_from_slice(bytes);
        let text_end = match from_utf8(begun) {
            Err(error) if error.error_len().is_none() => error.valid_up_to(),
            _ => begun.len(),
        };
        let rest = begun.split_off(text_end);
        to.write_all(escape_controls(&String::from_utf8_lossy(begun)).as_bytes())?;
        *begun = rest;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        match self {
            Self::Plain(to) | Self::Escaped { to, .. } => to.flush(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// E12: however the bytes are cut, a terminal gets no control character.
    #[test]
    fn a_terminal_gets_no_control_characters() {
        let text = "a\u{1b}]0;title\u{7}\u{9b}31m grün\n";
        for size in 1..=text.len() {
            let mut output = TextOutput::Escaped { to: Vec::new(), begun: Vec::new() };
            for part in text.as_bytes().chunks(size) {
                output.write_all(part).expect("written");
            }
            let TextOutput::Escaped { to, .. } = output else { panic!("it is a terminal") };
            assert_eq!(String::from_utf8(to).expect("text"), "a\\u{1b}]0;title\\u{7}\\u{9b}31m grün\n", "{size}");
        }
    }

    #[test]
    fn a_file_gets_every_byte() {
        let mut output = TextOutput::Plain(Vec::new());
        output.write_all(b"\x1b[31m\xff").expect("written");
        let TextOutput::Plain(to) = output else { panic!("it is a file") };
        assert_eq!(to, b"\x1b[31m\xff");
    }
}
