//! Notes inside a file: title, command, query, version of the lake, program.

use serde::Serialize;

/// Notes inside a file. They have no time and no path of a machine, so that the same lake gives the same bytes.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct FigureNotes {
    /// The title.
    pub title: String,
    /// The command that makes it, or the request.
    pub command: String,
    /// The queries that give its numbers.
    pub query: String,
    /// Version of the lake.
    pub lake: String,
    /// Name and version of the program.
    pub program: String,
    /// Origins of the data: `simulated`, `computed`, `measured`, `imported`; none if it is calculated from the rig
    /// alone.
    pub origins: Vec<String>,
}

impl FigureNotes {
    /// Returns the notes of a figure of this version of a lake, whose data have these origins, each named once.
    pub fn of_lake(lake: String, origins: impl Iterator<Item = String>) -> Self {
        let mut origins: Vec<_> = origins.collect();
        origins.sort();
        origins.dedup();
        Self { lake, program: concat!("echolake ", env!("CARGO_PKG_VERSION")).into(), origins, ..Self::default() }
    }

    /// Name and text of each note that is not empty.
    pub(crate) fn named_notes(&self) -> Vec<(&'static str, String)> {
        let all = [
            ("Title", self.title.clone()),
            ("Command", self.command.clone()),
            ("Query", self.query.clone()),
            ("Lake", self.lake.clone()),
            ("Origin", self.origins.join(", ")),
            ("Software", self.program.clone()),
        ];
        all.into_iter().filter(|(_, text)| !text.is_empty()).collect()
    }

    /// The notes as JSON.
    pub(crate) fn to_json(&self) -> String {
        // Texts alone: nothing in them fails.
        serde_json::to_string(self).unwrap_or_default()
    }

    /// The origin of the data in a word or two.
    pub(crate) fn origin_word(&self) -> &'static str {
        match (self.origins.is_empty(), self.origins.iter().filter(|o| *o == "simulated" || *o == "computed").count()) {
            (true, _) => "calculated",
            (false, 0) => "",
            (false, n) if n == self.origins.len() => "simulated",
            (false, _) => "partly simulated",
        }
    }

    /// Origin, lake and program in a line.
    pub(crate) fn origin_line(&self) -> String {
        let lake = if self.lake.is_empty() { String::new() } else { format!("lake {}", self.lake) };
        let parts = [self.origin_word(), &lake, &self.program];
        parts.into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join(" · ")
    }
}
