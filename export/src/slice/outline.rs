//! What a slice will hold, for readers who want to know before they read.

use std::collections::BTreeSet;

use echolake_lake::{Lake, LakeSnapshot};
use echolake_recording::ChunkIndex;

use super::groups::is_once;
use super::source::Source;
use super::{SliceParams, Taken, check_topics, is_named, run_files};
use crate::error::Result;

/// What a slice will hold.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Outline {
    /// Its topics, by name; one with several schemas is there several times.
    pub topics: Vec<OutlineTopic>,
    /// Their schemas.
    pub schemas: Vec<OutlineSchema>,
    /// No message is earlier, ns since 1970.
    pub start_ns: i64,
    /// No message is later.
    pub end_ns: i64,
}

/// A topic of a slice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutlineTopic {
    /// Its name.
    pub name: String,
    /// How its messages are encoded, as MCAP calls it.
    pub message_encoding: String,
    /// Which of [`Outline::schemas`] they have.
    pub schema: Option<usize>,
}

/// A schema of a slice.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OutlineSchema {
    /// Its name.
    pub name: String,
    /// What it is written in, as MCAP calls it.
    pub encoding: String,
    /// It.
    pub data: Vec<u8>,
}

/// Looks a slice over without cutting it. Its runs are checked as [`super::Slice::open`] checks them.
///
/// # Errors
/// As [`super::Slice::open`].
pub async fn outline_slice(lake: &Lake, snapshot: &LakeSnapshot, params: SliceParams) -> Result<Outline> {
    let SliceParams { taken, topics, check, .. } = params;
    let (mut outline, mut known) =
        (Outline { start_ns: i64::MAX, end_ns: i64::MIN, ..Outline::default() }, BTreeSet::new());
    for (file, taken) in run_files(lake, snapshot, taken).await? {
        let source = Source::open(lake.store(), file, check).await?;
        known.extend(source.channels.values().map(|c| c.topic.clone()));
        outline.add_source(&source, &taken, &topics);
    }
    check_topics(&topics, &known)?;
    outline.topics.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(outline)
}

impl Outline {
    fn add_source(&mut self, source: &Source, taken: &[Taken], topics: &[String]) {
        for channel in source.channels.values().filter(|c| is_named(topics, &c.topic)) {
            let schema = channel.schema.as_ref().map(|s| {
                self.schema_index(OutlineSchema {
                    name: s.name.clone(),
                    encoding: s.encoding.clone(),
                    data: s.data.to_vec(),
                })
            });
            let name = channel.topic.clone();
            let message_encoding = channel.message_encoding.clone();
            let topic = OutlineTopic { name, message_encoding, schema };
            if !self.topics.contains(&topic) {
                self.topics.push(topic);
            }
        }
        let times: BTreeSet<_> = taken.iter().map(Taken::message_time).collect();
        // Chunks that are read; a measurement's messages are not all of its very time.
        let is_read = |chunk: &&ChunkIndex| {
            let once =
                |id: &u16| source.channels.get(id).is_some_and(|c| is_once(&c.topic) && is_named(topics, &c.topic));
            times.range(chunk.message_start_time..=chunk.message_end_time).next().is_some()
                || chunk.message_index_offsets.keys().any(once)
        };
        let read = || source.chunks.iter().filter(is_read);
        let signed = |time: Option<u64>| time.and_then(|t| i64::try_from(t).ok()).unwrap_or(0);
        self.start_ns = self.start_ns.min(signed(read().map(|c| c.message_start_time).min()));
        self.end_ns = self.end_ns.max(signed(read().map(|c| c.message_end_time).max()));
    }

    fn schema_index(&mut self, schema: OutlineSchema) -> usize {
        self.schemas.iter().position(|known| *known == schema).unwrap_or_else(|| {
            self.schemas.push(schema);
            self.schemas.len() - 1
        })
    }
}
