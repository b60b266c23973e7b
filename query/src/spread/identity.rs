//! Common ground of a worker and an engine, without which they do not work together: the build, the lake, and a secret.

use std::fmt;

/// The build of a program and the lake that it reads. Workers and engines with different ones refuse each other: plans
/// of another build may not mean the same, and files of another lake are others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorkerIdentity {
    /// The program's version and checksum, without spaces.
    pub build: String,
    /// The lake's id.
    pub lake: String,
}

impl WorkerIdentity {
    /// Returns it as one line, which [`WorkerIdentity::parse`] reads.
    pub(super) fn to_line(&self) -> String {
        format!("{} {}", self.build, self.lake)
    }

    /// Reads a line of [`WorkerIdentity::to_line`]; None if it is not one.
    pub(super) fn parse(line: &str) -> Option<Self> {
        let (build, lake) = line.split_once(' ')?;
        Some(Self { build: build.to_owned(), lake: lake.to_owned() })
    }

    /// Returns in words how another one differs; None if it does not.
    pub(super) fn difference(&self, other: &Self) -> Option<String> {
        let Self { build, lake } = self;
        if other.build != *build {
            return Some(format!(
                "it is of another build: {}, expected {build}; hint: the same program everywhere",
                other.build
            ));
        }
        (other.lake != *lake)
            .then(|| format!("it has another lake: {}, expected {lake}; hint: start it with this lake", other.lake))
    }
}

/// The secret that workers and engines share.
#[derive(Clone, PartialEq, Eq)]
pub struct WorkerToken(String);

impl WorkerToken {
    /// Least number of characters: as many as `openssl rand -hex 16` writes.
    pub const LEAST: usize = 32;

    /// Takes the text of a token's file or variable; None if it is too short or has other characters than letters,
    /// digits and `-_+/=`.
    pub fn parse(text: &str) -> Option<Self> {
        let text = text.trim();
        let is_plain = text.chars().all(|c| c.is_ascii_alphanumeric() || "-_+/=".contains(c));
        (is_plain && text.len() >= Self::LEAST).then(|| Self(text.to_owned()))
    }

    /// Returns the secret itself.
    pub fn secret(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for WorkerToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("WorkerToken(..)")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_are_said_in_words() {
        let identity = |build: &str, lake: &str| WorkerIdentity { build: build.to_owned(), lake: lake.to_owned() };
        let own = identity("0.1.0-1a", "lake-1");
        assert_eq!(WorkerIdentity::parse(&own.to_line()), Some(own.clone()));
        assert_eq!(WorkerIdentity::parse(""), None);
        assert_eq!(own.difference(&own), None);
        let build = own.difference(&identity("0.1.0-2b", "lake-1")).expect("another build");
        assert!(build.contains("0.1.0-2b, expected 0.1.0-1a"), "{build}");
        let lake = own.difference(&identity("0.1.0-1a", "lake-2")).expect("another lake");
        assert!(lake.contains("lake-2, expected lake-1"), "{lake}");
    }

    #[test]
    fn tokens_are_long_and_never_printed() {
        let text = "0123456789abcdef0123456789abcdef";
        let token = WorkerToken::parse(&format!("{text}\n")).expect("a token");
        assert_eq!(token.secret(), text);
        assert!(!format!("{token:?}").contains(text));
        assert_eq!(WorkerToken::parse("short"), None);
        assert_eq!(WorkerToken::parse(&format!("{text} {text}")), None);
    }
}
