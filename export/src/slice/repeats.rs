//! Meshes, points and files that runs of a slice have in common: they are written once.

use std::collections::HashMap;

use bytes::Bytes;
use echolake_schema::topics;
use prost::Message as _;
use sha2::{Digest as _, Sha256};

use super::is_once;
use super::source::Message;

type ContentDigest = [u8; 32];

/// Contents that a slice has already.
#[derive(Default)]
pub(super) struct WrittenContents {
    /// The last content of each topic that stands in a run's file once.
    topics: HashMap<String, ContentDigest>,
    /// Names of attachments.
    attachments: HashMap<ContentDigest, String>,
}

/// The panel in `foxglove.SceneUpdate`, without times.
#[derive(Clone, PartialEq, prost::Message)]
struct SceneContent {
    #[prost(message, repeated, tag = "2")]
    entities: Vec<EntityContent>,
}

#[derive(Clone, PartialEq, prost::Message)]
struct EntityContent {
    #[prost(bytes = "bytes", repeated, tag = "14")]
    models: Vec<Bytes>,
}

/// The points in `foxglove.PointCloud`, without their time.
#[derive(Clone, PartialEq, prost::Message)]
struct PointContent {
    #[prost(bytes = "bytes", tag = "6")]
    data: Bytes,
}

impl WrittenContents {
    /// Returns whether a message shows again what its topic has shown last; messages come by time.
    pub fn is_repeat(&mut self, message: &Message) -> bool {
        let topic = &message.channel.topic;
        if !is_once(topic) {
            return false;
        }
        let digest = content_digest(topic, &message.data);
        self.topics.insert(topic.clone(), digest) == Some(digest)
    }

    /// Returns the name of an attachment with the same bytes; without one, these bytes have `name` from now on.
    pub fn attached_name(&mut self, name: &str, data: &[u8]) -> Option<String> {
        let digest = Sha256::digest(data).into();
        let known = self.attachments.get(&digest).cloned();
        if known.is_none() {
            self.attachments.insert(digest, name.to_owned());
        }
        known
    }
}

// A message that has none of the fields is compared as a whole.
fn content_digest(topic: &str, data: &Bytes) -> ContentDigest {
    let parts = match topic {
        topics::PANEL_SCENE => SceneContent::decode(data.clone())
            .map(|scene| scene.entities.into_iter().flat_map(|entity| entity.models).collect()),
        topics::PANEL_POINTS => PointContent::decode(data.clone()).map(|points| vec![points.data]),
        _ => Ok(Vec::new()),
    };
    let parts: Vec<Bytes> = parts.unwrap_or_default();
    let is_empty = parts.iter().all(Bytes::is_empty);
    let parts = if is_empty { vec![data.clone()] } else { parts };
    let digest = parts.iter().fold(Sha256::new(), |digest, part| digest.chain_update(part));
    digest.finalize().into()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::sync::Arc;

    use echolake_recording::Channel;

    use super::*;

    fn message(topic: &str, data: Vec<u8>) -> Message {
        let channel = Channel {
            id: 1,
            topic: topic.to_owned(),
            schema: None,
            message_encoding: "protobuf".to_owned(),
            metadata: BTreeMap::new(),
        };
        Message { channel: Arc::new(channel), log_time: 0, publish_time: 0, data: data.into() }
    }

    // The time is field 1 of an entity, the mesh field 14.
    fn scene(time: u8, mesh: &[u8]) -> Vec<u8> {
        let models = [&[14 << 3 | 2, mesh.len() as u8][..], mesh].concat();
        let entity = [&[1 << 3 | 2, 2, 1 << 3, time][..], &models].concat();
        [&[2 << 3 | 2, entity.len() as u8][..], &entity].concat()
    }

    #[test]
    fn a_mesh_is_a_repeat_until_another_was_shown() {
        let mut written = WrittenContents::default();
        let runs = [(1, b"brick"), (2, b"brick"), (3, b"stone"), (4, b"brick"), (5, b"brick")];
        let repeats = runs.map(|(time, mesh)| written.is_repeat(&message(topics::PANEL_SCENE, scene(time, mesh))));
        assert_eq!(repeats, [false, true, false, false, true]);
        let described = [b"arms", b"arms", b"none"].map(|text| message(topics::ROBOT_DESCRIPTION, text.to_vec()));
        assert_eq!(described.each_ref().map(|m| written.is_repeat(m)), [false, true, false]);
        let responses = [(); 2].map(|()| written.is_repeat(&message(topics::IR, scene(1, b"brick"))));
        assert_eq!(responses, [false; 2], "measurements that are alike are two");
    }

    #[test]
    fn scenes_without_a_mesh_are_compared_whole() {
        let mut written = WrittenContents::default();
        let scenes = [scene(1, b""), scene(2, b""), scene(2, b""), b"no protobuf".to_vec()];
        let repeats = scenes.map(|data| written.is_repeat(&message(topics::PANEL_SCENE, data)));
        assert_eq!(repeats, [false, false, true, false]);
    }
}
