//! Rows of users that an engine has checked and encoded, for the door to store: engines have no right to write, and the
//! door decodes no rows. A draft is sent as a line of JSON, with the sizes of the files, and the files one behind the
//! other. The door checks that its numbers agree: an engine that a query has taken over must not break a table.

use bytes::Bytes;
use echolake_lake::ContributedFile;
use echolake_schema::tables::{Source, Table};
use serde::{Deserialize, Serialize};

/// Checked rows of a table of users.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
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
        let sizes: Vec<_> = self.files.iter().map(|file| file.bytes.len()).collect();
        // Numbers and texts have no reason to fail; without a header the draft is refused.
        let mut bytes = serde_json::to_vec(&(sizes, self)).unwrap_or_default();
        bytes.push(b'\n');
        self.files.iter().for_each(|file| bytes.extend_from_slice(&file.bytes));
        bytes.into()
    }

    /// Decodes a draft.
    ///
    /// # Errors
    /// What is not as expected.
    pub fn decode(mut bytes: Bytes) -> Result<Self, String> {
        let end = bytes.iter().position(|byte| *byte == b'\n').ok_or("its header has no end")?;
        let header = serde_json::from_slice(&bytes.split_to(end + 1));
        let (sizes, mut draft): (Vec<usize>, Self) = header.map_err(|e| e.to_string())?;
        if draft.table.source() != Source::Users || sizes.len() != draft.files.len() {
            return Err(format!(
                "it has {} files of table {}, {} sizes",
                draft.files.len(),
                draft.table.name(),
                sizes.len()
            ));
        }
        for (file, size) in draft.files.iter_mut().zip(sizes) {
            let rows = file.parts.iter().try_fold(0_u64, |rows, part| rows.checked_add(part.rows));
            let counted = serde_json::from_str::<FileRows>(&file.stats).map_err(|e| e.to_string())?.num_records;
            let is_without_rows = counted == 0 || file.parts.iter().any(|part| part.rows == 0);
            if size > bytes.len() || rows != Some(counted) || is_without_rows {
                let left = bytes.len();
                return Err(format!(
                    "a file has {size} of {left} bytes, {rows:?} of {counted} rows, or a part has none"
                ));
            }
            file.bytes = bytes.split_to(size);
        }
        if bytes.is_empty() { Ok(draft) } else { Err(format!("{} bytes are of no file", bytes.len())) }
    }
}

/// The rows of a file by its statistics, which table logs count.
#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct FileRows {
    num_records: u64,
}

#[cfg(test)]
mod tests {
    use echolake_lake::ContributedPart;

    use super::*;

    fn draft() -> ContributionDraft {
        let part = |surface: &str, rows| ContributedPart {
            surface: surface.parse().expect("an id"),
            run: format!("20260105T080000Z-{surface}-7c1e").parse().expect("an id"),
            rows,
        };
        let file = |parts: Vec<ContributedPart>, bytes: &'static str| ContributedFile {
            stats: format!(
                r#"{{"numRecords":{},"minValues":{{"value":"a\\nb"}}}}"#,
                parts.iter().map(|part| part.rows).sum::<u64>()
            ),
            parts,
            bytes: bytes.into(),
        };
        let files =
            vec![file(vec![part("flat", 1), part("wood", 2)], "PAR1\n\nPAR1"), file(vec![part("brick", 1)], "x")];
        ContributionDraft { table: Table::Annotations, seen: 7, files, annotation_ids: vec!["a-1".to_owned()] }
    }

    #[test]
    fn drafts_round_trip_and_what_is_none_is_refused() {
        let draft = draft();
        assert_eq!(ContributionDraft::decode(draft.encode()), Ok(draft.clone()));
        let empty = ContributionDraft { files: Vec::new(), ..draft.clone() };
        assert_eq!(ContributionDraft::decode(empty.encode()), Ok(empty));
        let encoded = draft.encode();
        for cut in 0..encoded.len() {
            assert!(ContributionDraft::decode(encoded.slice(..cut)).is_err(), "cut at {cut}");
        }
        assert!(ContributionDraft::decode([&encoded[..], b"x"].concat().into()).is_err(), "a byte of no file");
    }

    /// E11: what an engine names is checked before it is stored: one number that is wrong would make all later readers
    /// miss rows.
    #[test]
    fn a_header_with_absurd_numbers_is_refused() {
        let huge = (1_u64 << 63).to_string();
        let encoded = draft().encode();
        let end = encoded.iter().position(|byte| *byte == b'\n').expect("a header");
        let header = String::from_utf8(encoded[..end].to_vec()).expect("text");
        let seen_huge = header.replace(r#""seen":7"#, &format!(r#""seen":{huge}"#));
        for (before, after) in [
            (r#""table":"annotations""#, r#""table":"runs""#),
            (r#""table":"annotations""#, r#""table":"../annotations""#),
            (r#""seen":7"#, r#""seen":-1"#),
            (r#""seen":7"#, r#""seen":18446744073709551616"#),
            ("[10,1]", "[9,1]"),
            ("[10,1]", "[11,1]"),
            ("[10,1]", "[11]"),
            ("[10,1]", &format!("[10,{huge}]")),
            (r#""rows":2"#, r#""rows":0"#),
            (r#""rows":2"#, &format!(r#""rows":{huge}"#)),
            (r#""rows":2"#, &format!(r#""rows":{}"#, u64::MAX)),
            (r#"numRecords\":3"#, &format!(r#"numRecords\":{huge}"#)),
            (r#"numRecords"#, r#"numRows"#),
            (r#""surface":"wood""#, r#""surface":"../wood""#),
            (r#""run":"20260105T080000Z-wood-7c1e""#, r#""run":"""#),
        ] {
            assert!(header.contains(before), "{header} has no {before}");
            let changed = header.replacen(before, after, 1).into_bytes();
            let changed = [&changed, &encoded[end..]].concat();
            assert!(ContributionDraft::decode(changed.into()).is_err(), "{before} as {after}");
        }
        // The table is looked at before it is written: no version of it is that one.
        let changed = ContributionDraft::decode([seen_huge.as_bytes(), &encoded[end..]].concat().into());
        assert_eq!(changed.expect("a draft").seen, 1 << 63);
    }
}
