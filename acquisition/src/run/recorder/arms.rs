//! What a run's file holds of the arms, where their joints are known: their shape once, joints and frames at every
//! measurement.

use std::sync::Arc;

use echolake_recording::system_cause;
use echolake_schema::{Timestamp, topics};
use foxglove::messages as fg;

use super::channels::{foxglove_channel, foxglove_topic};
use super::{Error, Recorder, Topic, scene};
use crate::rig::robots::{Cell, Joints, Tool};

/// The schema of `std_msgs/msg/String`, and how its messages are encoded: viewers look for URDF there.
const STRING_SCHEMA: (&str, &str, &[u8]) = ("std_msgs/msg/String", "ros2msg", b"string data\n");
const STRING_ENCODING: &str = "cdr";

/// The arms' channels.
pub(super) struct Arms {
    cell: Arc<Cell>,
    /// Channel of the description, and the message on it.
    description: (u16, Vec<u8>),
    joints: [u16; 2],
}

impl Arms {
    /// What live views subscribe to.
    pub fn topics(&self) -> Vec<Topic> {
        let (schema, encoding, text) = STRING_SCHEMA;
        let [microphone, speaker] = self.joints;
        vec![
            Topic {
                channel: self.description.0,
                topic: topics::ROBOT_DESCRIPTION.to_owned(),
                encoding: STRING_ENCODING.to_owned(),
                schema: schema.to_owned(),
                schema_encoding: encoding.to_owned(),
                schema_data: text.to_vec(),
            },
            foxglove_topic::<fg::JointStates>(microphone, topics::MICROPHONE_JOINTS),
            foxglove_topic::<fg::JointStates>(speaker, topics::SPEAKER_JOINTS),
        ]
    }

    /// The description's channel and message.
    pub fn description(&self) -> (u16, &[u8]) {
        (self.description.0, &self.description.1)
    }
}

impl Recorder {
    /// Records the arms' shape, `/robot_description`; from now on [`Self::record_joints`] tells how they stand, and
    /// [`Self::poses`] leaves `/tf` to it. `name` says what the arms are, and whether they are simulated.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn record_arms(&mut self, at: Timestamp, cell: Arc<Cell>, name: &str) -> Result<(), Error> {
        let (schema, encoding, text) = STRING_SCHEMA;
        let channels = self.writer.mcap.add_schema(schema, encoding, text).and_then(|schema| {
            let none = Default::default();
            let description =
                self.writer.mcap.add_channel(schema, topics::ROBOT_DESCRIPTION, STRING_ENCODING, &none)?;
            let mut joints = |topic| foxglove_channel::<fg::JointStates>(&mut self.writer.mcap, topic);
            Ok((description, [joints(topics::MICROPHONE_JOINTS)?, joints(topics::SPEAKER_JOINTS)?]))
        });
        let (description, joints) = channels.map_err(|e| self.failed(system_cause(e)))?;
        let message = cdr_string(&cell.to_urdf(name));
        // A resumed run has it already.
        if !self.is_resumed {
            self.write(description, at, &message)?;
        }
        self.arms = Some(Arms { cell, description: (description, message), joints });
        Ok(())
    }

    /// Records `/tf` of both arms' links alone, at the beginning of a run: without it viewers have no place for
    /// anything until the first pair is measured. A resumed run has it already.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn record_arm_frames(&mut self, at: Timestamp, joints: &[Joints; 2]) -> Result<(), Error> {
        let Some(cell) = self.arms.as_ref().filter(|_| !self.is_resumed).map(|arms| arms.cell.clone()) else {
            return Ok(());
        };
        self.foxglove(self.channels.tf, at, &scene::arm_frames(at, &cell, joints))
    }

    /// Records the joints of the microphone's and the speaker's arm, rad, and `/tf` of both arms' links. Without
    /// [`Self::record_arms`] it records nothing.
    ///
    /// # Errors
    /// [`Error::Write`].
    pub fn record_joints(&mut self, at: Timestamp, joints: &[Joints; 2]) -> Result<(), Error> {
        let Some(Arms { cell, joints: channels, .. }) = &self.arms else { return Ok(()) };
        let cell = cell.clone();
        let channels = *channels;
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
