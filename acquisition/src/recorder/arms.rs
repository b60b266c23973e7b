//! What a run's file holds of the arms, where their joints are known: their shape once, joints and frames at every
//! measurement.

use std::sync::Arc;

use echolake_schema::{Timestamp, topics};
use foxglove::messages as fg;

use super::channels::{foxglove_channel, foxglove_topic};
use super::{Error, Recorder, Tap, Topic, scene};
use crate::robots::{Cell, Joints, Tool};

/// The schema of `std_msgs/msg/String`, and how its messages are encoded: viewers look for URDF there.
const STRING_SCHEMA: (&str, &str, &[u8]) = ("std_msgs/msg/String", "ros2msg", b"string data\n");
const STRING_ENCODING: &str = "cdr";

/// The arms, and their channels.
pub(super) struct Arms {
    cell: Arc<Cell>,
    joints: [u16; 2],
    description: u16,
    /// The description's message.
    text: Vec<u8>,
}

impl Arms {
    /// Their topics, as readers need them.
    pub(super) fn topics(&self) -> Vec<Topic> {
        let (schema, schema_encoding, data) = STRING_SCHEMA;
        let description = Topic {
            channel: self.description,
            topic: topics::ROBOT_DESCRIPTION.to_owned(),
            encoding: STRING_ENCODING.to_owned(),
            schema: schema.to_owned(),
            schema_encoding: schema_encoding.to_owned(),
            schema_data: data.to_vec(),
        };
        let [microphone, speaker] = self.joints;
        vec![
            description,
            foxglove_topic::<fg::JointStates>(microphone, topics::MICROPHONE_JOINTS),
            foxglove_topic::<fg::JointStates>(speaker, topics::SPEAKER_JOINTS),
        ]
    }

    /// Shows their shape to who listens since.
    pub(super) fn show(&self, at: Timestamp, tap: &mut dyn Tap) {
        tap.message(self.description, u64::try_from(at.0).unwrap_or(0), &self.text);
    }
}

impl Recorder {
    /// Records the arms' shape, `/robot_description`; from now on [`Self::joints`] tells how they stand, and
    /// [`Self::poses`] leaves `/tf` to it. `name` says what the arms are, and whether they are simulated. A run that is
    /// gone on with has it once more.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn arms(&mut self, at: Timestamp, cell: Arc<Cell>, name: &str) -> Result<(), Error> {
        let (schema, encoding, text) = STRING_SCHEMA;
        let file = &mut self.writer.mcap;
        let channels = file.add_schema(schema, encoding, text).and_then(|schema| {
            let none = Default::default();
            let description = file.add_channel(schema, topics::ROBOT_DESCRIPTION, STRING_ENCODING, &none)?;
            let mut joints = |topic| foxglove_channel::<fg::JointStates>(file, topic);
            Ok((description, [joints(topics::MICROPHONE_JOINTS)?, joints(topics::SPEAKER_JOINTS)?]))
        });
        let (description, joints) = channels.map_err(|e| self.failed(e.to_string()))?;
        let text = cdr_string(&cell.urdf(name));
        self.write(description, at, &text)?;
        self.arms = Some(Arms { cell, joints, description, text });
        Ok(())
    }

    /// Records the joints of the microphone's and the speaker's arm, rad, and `/tf` of both arms' links. Without
    /// [`Self::arms`] it records nothing.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn joints(&mut self, at: Timestamp, joints: &[Joints; 2]) -> Result<(), Error> {
        let Some(Arms { cell, joints: channels, .. }) = &self.arms else { return Ok(()) };
        let (cell, channels) = (cell.clone(), *channels);
        self.foxglove(self.channels.tf, at, &scene::arm_frames(at, &cell, joints))?;
        for ((tool, joints), channel) in [Tool::Microphone, Tool::Speaker].into_iter().zip(joints).zip(channels) {
            self.foxglove(channel, at, &scene::joint_states(at, tool, joints))?;
        }
        Ok(())
    }
}

// CDR, little-endian: four bytes that say so, then the length with the closing zero, the text, the zero.
fn cdr_string(text: &str) -> Vec<u8> {
    let length = (text.len() as u32 + 1).to_le_bytes();
    [&[0, 1, 0, 0], &length[..], text.as_bytes(), &[0]].concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strings_are_as_ros_2_writes_them() {
        assert_eq!(cdr_string("ab"), [0, 1, 0, 0, 3, 0, 0, 0, b'a', b'b', 0]);
    }
}
