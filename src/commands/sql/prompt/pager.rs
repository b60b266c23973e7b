//! Long answers go through the reader's pager, as in psql.

use std::io::{IsTerminal as _, Write};
use std::process::{Child, Command, Stdio};

use crate::terminal_text::{TextOutput, text_output};

/// Exits at once if all fits on the screen, and leaves the text there; long lines are not folded.
const PAGER: &str = "less -FRSX";

/// The output for a formatted answer.
pub(super) enum PageOutput {
    /// The pager.
    Pager(Child),
    /// The terminal itself.
    Terminal(TextOutput<std::io::Stdout>),
}

impl PageOutput {
    /// The pager if one is wanted and available, else the terminal.
    pub fn open(is_wanted: bool) -> Self {
        let terminal = text_output();
        if !is_wanted || !std::io::stdout().is_terminal() {
            return Self::Terminal(terminal);
        }
        let command = std::env::var("PAGER").unwrap_or_else(|_| PAGER.to_owned());
        let mut words = command.split_whitespace();
        let child =
            words.next().and_then(|program| Command::new(program).args(words).stdin(Stdio::piped()).spawn().ok());
        child.map_or(Self::Terminal(terminal), Self::Pager)
    }
}

impl Write for PageOutput {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        match self {
            Self::Terminal(terminal) => terminal.write(bytes),
            Self::Pager(child) => match child.stdin.as_mut().map(|pipe| pipe.write(bytes)) {
                // A user who leaves the pager early wants no more.
                Some(Err(e)) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(bytes.len()),
                Some(written) => written,
                None => Ok(bytes.len()),
            },
        }
    }

    fn flush(&mut self) -> std::io::Result<()> {
        match self {
            Self::Terminal(terminal) => terminal.flush(),
            Self::Pager(_) => Ok(()),
        }
    }
}

impl Drop for PageOutput {
    // The prompt comes back when the pager has gone.
    fn drop(&mut self) {
        if let Self::Pager(child) = self {
            drop(child.stdin.take());
            // It has been shown; how the pager ended changes nothing.
            let _ = child.wait();
        }
    }
}

/// Shows a text.
pub(super) fn show_text(is_paged: bool, text: &str) -> std::io::Result<()> {
    writeln!(PageOutput::open(is_paged), "{text}")
}
