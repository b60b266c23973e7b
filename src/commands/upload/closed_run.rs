//! A run file that is closed: what an upload needs to know of it, read from the file itself.

use std::fs::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::Path;

use anyhow::{Context as _, bail, ensure};
use echolake_acquisition::recovery::is_partial;
use echolake_recording::{RecordingItem, RecordingReader, summary_range, tail_range};
use echolake_schema::manifest::RunManifest;
use echolake_schema::{Rig, topics};

/// The beginning of a closed run file.
pub(super) struct ClosedRun {
    pub manifest: RunManifest,
    pub rig: Rig,
}

impl ClosedRun {
    /// Reads manifest and rig of a run file.
    pub fn from_file(path: &Path) -> anyhow::Result<Self> {
        let name = path.display();
        ensure!(
            !is_partial(path),
            "`{name}` is an unfinished recording, expected a closed run (.mcap); hint: `echolake acquire --resume \
             {name}` resumes it, `echolake recover {name}` makes a run of what it holds"
        );
        let mut reader = RecordingReader::open(path)?;
        ensure!(
            has_end(path)?,
            "`{name}` was not closed: it has no summary at its end; hint: `echolake recover {name}` makes a run of \
             what it holds"
        );
        let mut manifest = None;
        let mut rig = None;
        while manifest.is_none() || rig.is_none() {
            match reader.next_item()? {
                Some(RecordingItem::Metadata(record)) if record.name == topics::RUN_METADATA => {
                    let found = RunManifest::from_metadata(&record.metadata);
                    manifest = Some(found.with_context(|| format!("`{name}` is no run that this version knows"))?);
                }
                Some(RecordingItem::Attachment(attachment)) if attachment.name == topics::RIG_ATTACHMENT => {
                    let text = String::from_utf8(attachment.data.to_vec());
                    let found = text.map_err(anyhow::Error::from).and_then(|text| Ok(Rig::from_toml(&text)?));
                    rig = Some(found.with_context(|| format!("the rig in `{name}`"))?);
                }
                Some(_) => {}
                None => break,
            }
        }
        if let (Some(manifest), Some(rig)) = (manifest, rig) {
            return Ok(Self { manifest, rig });
        }
        match reader.finish()?.damage.first() {
            Some(damage) => {
                bail!("`{name}` is damaged: {damage}; hint: `echolake recover {name}` makes a run of what it holds")
            }
            _ => bail!(
                "`{name}` is an MCAP file but no run of echolake: it has no metadata `{}` or no attachment `{}`; hint: \
                 only recordings of `echolake acquire` and `echolake import` are uploaded",
                topics::RUN_METADATA,
                topics::RIG_ATTACHMENT
            ),
        }
    }
}

fn has_end(path: &Path) -> anyhow::Result<bool> {
    let read = || {
        let mut file = File::open(path)?;
        let mut tail = Vec::new();
        let bytes = file.metadata()?.len();
        file.seek(SeekFrom::Start(tail_range(bytes).start))?;
        file.take(bytes).read_to_end(&mut tail)?;
        Ok::<_, std::io::Error>((tail, bytes))
    };
    let (tail, bytes) = read().with_context(|| format!("cannot read `{}`", path.display()))?;
    Ok(summary_range(&tail, bytes).is_some())
}
