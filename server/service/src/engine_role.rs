//! The two engines of a server, by what they are asked.

use std::fmt;
use std::str::FromStr;

/// What an engine answers. Both read the same lake, each in a process of its own that all clients share.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum EngineRole {
    /// Pages: the program's own statements with bound values, and files of tables. Nothing from outside can end it.
    Pages,
    /// Statements and predicates from outside, bodies of requests, and whatever decodes run files or uploads.
    Statements,
}

impl EngineRole {
    /// Both roles.
    pub const ALL: [Self; 2] = [Self::Pages, Self::Statements];

    /// The name, for arguments and figures.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pages => "pages",
            Self::Statements => "statements",
        }
    }
}

impl fmt::Display for EngineRole {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for EngineRole {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|role| role.name() == name);
        found.ok_or_else(|| format!("no engine is of `{name}`; expected pages or statements"))
    }
}
