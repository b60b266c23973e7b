//! Errors for values from outside: names, numbers, rig descriptions, points, pairs and samples.

use std::borrow::Cow;

/// The cause of another member's error: an error of a library or the system, or a text.
pub type ErrorCause = Box<dyn std::error::Error + Send + Sync>;

/// Returns a text without characters that control a terminal, but with its lines: names in files, and messages of
/// libraries about them, may hold any.
pub fn escape_controls(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '\n' | '\t' => safe.push(character),
            // Those that turn the direction of writing hide as much.
            '\u{200e}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' => {
                safe.extend(character.escape_unicode());
            }
            _ if character.is_control() => safe.extend(character.escape_default()),
            _ => safe.push(character),
        }
    }
    safe
}

/// Characters of a text that an error quotes: as long as the longest name that is right, and more.
const QUOTED_CHARS: usize = 80;

/// Returns a text that an error quotes, such as a name that a client sent: cut if it is long, because nobody reads it
/// and it may be as large as the request.
pub fn quoted_text(text: &str) -> Cow<'_, str> {
    match text.char_indices().nth(QUOTED_CHARS) {
        Some((end, _)) => format!("{}...", &text[..end]).into(),
        None => text.into(),
    }
}

/// A value that is not what its type promises.
#[derive(Debug, thiserror::Error, Clone, PartialEq)]
pub enum Error {
    /// Not a name that a surface, run or file can have.
    #[error("`{value}` is not a valid {kind}: {reason}")]
    Id {
        /// Kind of name that was expected.
        kind: &'static str,
        /// The given value.
        value: String,
        /// The rule that it breaks.
        reason: &'static str,
    },
    /// A number outside of what is physically sensible.
    #[error("{quantity} is {actual}, expected {expected}")]
    Quantity {
        /// The quantity, with its unit.
        quantity: &'static str,
        /// The given number.
        actual: String,
        /// The accepted range.
        expected: &'static str,
    },
    /// A rig description that contradicts itself.
    #[error("rig `{rig}`: `{field}` {reason}")]
    Rig {
        /// The rig's name.
        rig: String,
        /// The field, as in the TOML.
        field: &'static str,
        /// Description of the contradiction.
        reason: String,
    },
    /// Text that is no rig description.
    #[error("not a rig description: {message}")]
    RigSyntax {
        /// The parser's message, with line and column.
        message: String,
    },
    /// A point that the rig's grid does not have.
    #[error(
        "{given} is not a point of the rig's grid ({expected}){}",
        nearest.as_deref().map(|n| format!("; the nearest is {n}")).unwrap_or_default()
    )]
    Point {
        /// The given point.
        given: String,
        /// Number of points, and the forms in which one is given.
        expected: String,
        /// The nearest point, if the given one was a position.
        nearest: Option<String>,
    },
    /// Two points that the rig does not measure as a pair.
    #[error("microphone {microphone} with speaker {speaker} is none of the rig's {pairs} pairs{hint}")]
    Pair {
        /// Microphone point.
        microphone: String,
        /// Speaker point.
        speaker: String,
        /// Number of pairs that the rig measures.
        pairs: usize,
        /// A hint at the cause.
        hint: &'static str,
    },
    /// Samples in a format that this version does not know.
    #[error("its sample format is unknown; hint: a newer version may have written it")]
    SampleFormat,
    /// Bytes that are not the samples they should be.
    #[error("it has {actual} bytes for {samples} samples of {width}")]
    SampleBytes {
        /// Number of bytes found.
        actual: usize,
        /// Number of samples expected.
        samples: usize,
        /// Bytes of one sample.
        width: usize,
    },
    /// Not a role of a surface.
    #[error("`{actual}` is no role, expected `hard` or `sample`")]
    SurfaceRole {
        /// The given text.
        actual: String,
    },
    /// A sample that is no number.
    #[error("sample {index} is {value}")]
    Sample {
        /// Index of the sample, 0-based.
        index: usize,
        /// Its value.
        value: f32,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_for_a_terminal_control_none() {
        let text = "`/a\u{1b}]0;title\u{7}\r\u{9b}31m`\n\tgrün \u{202e}";
        assert_eq!(escape_controls(text), "`/a\\u{1b}]0;title\\u{7}\\r\\u{9b}31m`\n\tgrün \\u{202e}");
    }

    /// E12: an error does not grow with what it is about.
    #[test]
    fn quoted_texts_are_cut() {
        assert_eq!(quoted_text(&"ü".repeat(80)), "ü".repeat(80));
        assert_eq!(quoted_text(&"ü".repeat(81)), format!("{}...", "ü".repeat(80)));
        let error = "x ".repeat(10_000_000).parse::<crate::SurfaceId>().expect_err("no name");
        assert!(error.to_string().len() < 200, "{error}");
    }
}
