//! The permissions of tokens.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// A permission of a token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TokenScope {
    /// Queries, and what the tables are.
    Sql,
    /// The runs' and tables' files.
    Files,
    /// The server's own figures.
    Metrics,
    /// Adding annotations and predictions.
    Annotate,
    /// Verdicts on runs that levels of other surfaces rest on, beside [`Self::Annotate`].
    #[serde(rename = "annotate-references")]
    AnnotateReferences,
}

impl TokenScope {
    /// The scopes, by their names in the file of tokens.
    pub const NAMED: [(&'static str, Self); 5] = [
        ("sql", Self::Sql),
        ("files", Self::Files),
        ("metrics", Self::Metrics),
        ("annotate", Self::Annotate),
        ("annotate-references", Self::AnnotateReferences),
    ];
}

impl FromStr for TokenScope {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        let found = Self::NAMED.into_iter().find(|(known, _)| *known == name);
        found
            .map(|(_, scope)| scope)
            .ok_or_else(|| format!("no scope `{name}`; hint: sql, files, metrics, annotate or annotate-references"))
    }
}

impl fmt::Display for TokenScope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Sql => "SQL",
            Self::Files => "files",
            Self::Metrics => "metrics",
            Self::Annotate => "annotations",
            Self::AnnotateReferences => "verdicts on references, which need the scope `annotate-references`",
        })
    }
}
