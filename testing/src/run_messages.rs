//! Messages and attachments of a run's file, as tests read them.

use std::collections::HashMap;
use std::path::Path;

use echolake_recording::{Record, RecordingItem, RecordingReader};
use echolake_schema::messages::Message as RunMessage;

/// Reads all messages of a topic, in the file's order.
///
/// # Panics
/// The file cannot be read, or has other messages in the topic.
pub fn read_messages<M: RunMessage>(run: &Path, topic: &str) -> Vec<M> {
    let mut topics = HashMap::new();
    let mut messages = Vec::new();
    for item in read_items(run) {
        let RecordingItem::Chunk(chunk) = item else { continue };
        for record in chunk.records {
            match record {
                Record::Channel(channel) => drop(topics.insert(channel.id, channel.topic)),
                Record::Message { header, data } if topics.get(&header.channel_id).is_some_and(|of| of == topic) => {
                    messages.push(M::decode(&data[..]).expect("a message of this topic"));
                }
                _ => {}
            }
        }
    }
    messages
}

/// Reads an attachment.
///
/// # Panics
/// The file cannot be read, or has no such attachment.
pub fn read_attachment(run: &Path, name: &str) -> Vec<u8> {
    let found = read_items(run).into_iter().find_map(|item| match item {
        RecordingItem::Attachment(attachment) if attachment.name == name => Some(attachment.data.to_vec()),
        _ => None,
    });
    found.expect("the attachment is there")
}

fn read_items(run: &Path) -> Vec<RecordingItem> {
    let mut reader = RecordingReader::open(run).expect("a run's file");
    std::iter::from_fn(|| reader.next_item().expect("readable")).collect()
}
