"""Checks a run file with Python's mcap: `check_run.py RUN.mcap`. Every topic, every message decoded, every attachment.

Needs the PyPI packages mcap, mcap-protobuf-support, trimesh and numpy. Exits with 1 and says what is missing.
"""
import io
import sys
import xml.etree.ElementTree

import trimesh
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

SCHEMAS = {
    "/tf": "foxglove.FrameTransforms",
    "/panel/scene": "foxglove.SceneUpdate",
    "/panel/points": "foxglove.PointCloud",
    "/microphone/pose": "foxglove.PoseInFrame",
    "/speaker/pose": "foxglove.PoseInFrame",
    "/sweep": "echolake.v1.SweepRecording",
    "/sweep/audio": "foxglove.RawAudio",
    "/ir": "echolake.v1.ImpulseResponse",
    "/environment": "echolake.v1.AmbientSample",
    "/measurement": "echolake.v1.Measurement",
    "/log": "foxglove.Log",
}
# Where the arms' joints are known; in simulated runs of a grid within the arms' reach.
ARMS = {
    "/robot_description": "std_msgs/msg/String",
    "/robots/microphone/joint_states": "foxglove.JointStates",
    "/robots/speaker/joint_states": "foxglove.JointStates",
}
ATTACHMENTS = {"rig.toml", "surface.json", "panel.glb", "heights.f32"}


def main(path):
    schemas, urdf, moved = SCHEMAS | ARMS, None, {}
    counts = dict.fromkeys(SCHEMAS, 0)
    with open(path, "rb") as file:
        factory, decoders = DecoderFactory(), {}
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert schemas.get(channel.topic) == schema.name, f"{channel.topic} has schema {schema.name}"
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            if channel.topic == "/robot_description":
                urdf = xml.etree.ElementTree.fromstring(message.data[8:-1])
                continue
            decode = decoders.setdefault(channel.id, factory.decoder_for(channel.message_encoding, schema))
            decoded = decode(message.data)
            assert decoded is not None
            if channel.topic in ARMS:
                moved.setdefault(channel.topic, set()).add(tuple(j.position for j in decoded.joints))
            if channel.topic == "/tf":
                frames = {t.child_frame_id: t.parent_frame_id for t in decoded.transforms}
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {a.name: a.data for a in reader.iter_attachments()}
    empty = [topic for topic, count in counts.items() if count == 0]
    assert not empty, f"no message of {', '.join(empty)}"
    if urdf is not None:
        tree = {j.find("child").get("link"): j.find("parent").get("link") for j in urdf.iter("joint")}
        assert tree == frames, f"the URDF's links are {tree}, the frames of /tf {frames}"
        assert counts["/robots/microphone/joint_states"] == counts["/measurement"], f"{counts}"
        assert all(len(joints) > 1 for joints in moved.values()), "an arm does not move"
    missing = ATTACHMENTS - attachments.keys()
    assert not missing, f"no attachment {', '.join(sorted(missing))}"
    assert {"echolake.run", "echolake.run.end"} <= metadata.keys(), f"metadata is {sorted(metadata)}"
    panel = trimesh.load(io.BytesIO(attachments["panel.glb"]), file_type="glb", force="mesh")
    assert panel.is_watertight, "panel.glb is not watertight"
    size = panel.extents.round(3).tolist()
    assert abs(size[0] - 0.585) < 1e-3 and abs(size[2] - 0.585) < 1e-3, f"panel.glb measures {size} m"
    print(f"{path}: {sum(counts.values())} messages decoded, {counts}; panel {size} m, {len(panel.faces)} triangles")


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except AssertionError as error:
        sys.exit(f"{sys.argv[1]}: {error}")
