//! Rows of users that an engine has checked and encoded, for the door to store: engines have no right to write, and the
//! door decodes nothing. They are sent as lines of text, an empty line, and the files one behind the other:
//!
//! ```text
//! annotations 12                    table, and its version that the engine looked at
//! named bad-1                       names of the annotations, in the order of the request
//! file 2345 {"numRecords":3,...}    a file's bytes and statistics
//! rows brick 20260105T080000Z-brick-7c1e 3      its parts: surface, run, rows
//! ```

use bytes::Bytes;
use echolake_lake::{ContributedFile, ContributedPart};
use echolake_schema::tables::Table;

/// Checked rows of a table of users.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ContributionDraft {
    /// The table.
    pub table: Table,
    /// The version of the table that was looked at.
    pub seen: u64,
    /// The files to add; none if all rows are there already.
    pub files: Vec<ContributedFile>,
    /// Names of the annotations; none for predictions.
    pub annotation_ids: Vec<String>,
}

impl ContributionDraft {
    /// Media type of an encoded draft.
    pub const MEDIA_TYPE: &'static str = "application/vnd.echolake.draft";

    /// Encodes the draft.
    pub fn encode(&self) -> Bytes {
        let mut text = format!("{} {}\n", self.table.name(), self.seen);
        self.annotation_ids.iter().for_each(|id| text += &format!("named {id}\n"));
        for file in &self.files {
            text += &format!("file {} {}\n", file.bytes.len(), file.stats);
            for part in &file.parts {
                text += &format!("rows {} {} {}\n", part.surface, part.run, part.rows);
            }
        }
        text.push('\n');
        let mut bytes = text.into_bytes();
        self.files.iter().for_each(|file| bytes.extend_from_slice(&file.bytes));
        bytes.into()
    }

    /// Decodes a draft.
    ///
    /// # Errors
    /// The line that is not as expected.
    pub fn decode(mut bytes: Bytes) -> Result<Self, String> {
        let end = bytes.windows(2).position(|two| two == b"\n\n").ok_or("it has no empty line")?;
        let head = bytes.split_to(end + 2);
        let head = std::str::from_utf8(&head[..end]).map_err(|e| e.to_string())?;
        let mut lines = head.split('\n');
        let first = lines.next().unwrap_or_default();
        let unexpected = |line: &str| format!("its line `{line:.100}` is not as expected");
        let (table, seen) = first.split_once(' ').ok_or_else(|| unexpected(first))?;
        let table = Table::OF_USERS.into_iter().find(|known| known.name() == table).ok_or_else(|| unexpected(first))?;
        let seen = seen.parse().map_err(|_| unexpected(first))?;
        let mut draft = Self { table, seen, files: Vec::new(), annotation_ids: Vec::new() };
        for line in lines {
            match line.split_once(' ').ok_or_else(|| unexpected(line))? {
                ("named", id) => draft.annotation_ids.push(id.to_owned()),
                ("file", file) => {
                    let (size, stats) = file.split_once(' ').ok_or_else(|| unexpected(line))?;
                    let size = size.parse().ok().filter(|size| *size <= bytes.len()).ok_or_else(|| unexpected(line))?;
                    let bytes = bytes.split_to(size);
                    draft.files.push(ContributedFile { parts: Vec::new(), stats: stats.to_owned(), bytes });
                }
                ("rows", part) => {
                    let part = parse_part(part).ok_or_else(|| unexpected(line))?;
                    draft.files.last_mut().ok_or_else(|| unexpected(line))?.parts.push(part);
                }
                _ => return Err(unexpected(line)),
            }
        }
        match bytes.is_empty() && draft.files.iter().all(|file| !file.parts.is_empty()) {
            true => Ok(draft),
            false => Err(format!("{} bytes are of no file, or a file has no part", bytes.len())),
        }
    }
}

fn parse_part(text: &str) -> Option<ContributedPart> {
    let mut words = text.split(' ');
    let surface = words.next()?.parse().ok()?;
    let run = words.next()?.parse().ok()?;
    let rows = words.next()?.parse().ok()?;
    Some(ContributedPart { surface, run, rows }).filter(|_| words.next().is_none())
}

/// The path of a table's requests.
pub fn contribution_path(table: Table) -> &'static str {
    match table {
        Table::Predictions => "/api/v1/predictions",
        _ => "/api/v1/annotations",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn drafts_round_trip_and_what_is_none_is_refused() {
        let part = |surface: &str, rows| ContributedPart {
            surface: surface.parse().expect("an id"),
            run: format!("20260105T080000Z-{surface}-7c1e").parse().expect("an id"),
            rows,
        };
        let file = |parts, bytes: &'static str| ContributedFile {
            parts,
            stats: r#"{"numRecords":1,"minValues":{"value":"a b"}}"#.to_owned(),
            bytes: bytes.into(),
        };
        let files =
            vec![file(vec![part("flat", 1), part("wood", 2)], "PAR1\n\nPAR1"), file(vec![part("brick", 1)], "x")];
        let draft =
            ContributionDraft { table: Table::Annotations, seen: 7, files, annotation_ids: vec!["a-1".to_owned()] };
        assert_eq!(ContributionDraft::decode(draft.encode()), Ok(draft.clone()));
        let empty = ContributionDraft { files: Vec::new(), ..draft.clone() };
        assert_eq!(ContributionDraft::decode(empty.encode()), Ok(empty));
        let encoded = draft.encode();
        for cut in 0..encoded.len() {
            assert!(ContributionDraft::decode(encoded.slice(..cut)).is_err(), "cut at {cut}");
        }
        for bad in
            ["runs 1\n\n", "annotations x\n\n", "annotations 1\nrows flat r 1\n\n", "annotations 1\nfile 9 {}\n\nx"]
        {
            assert!(ContributionDraft::decode(bad.into()).is_err(), "{bad}");
        }
    }
}
