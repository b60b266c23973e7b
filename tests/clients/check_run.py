"""Checks a run file with Python's mcap: `check_run.py RUN.mcap`. Every topic, every message decoded, every attachment.

Needs the PyPI packages mcap, mcap-protobuf-support, trimesh and numpy. Exits with 1 and says what is missing.
"""
import io
import sys

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
ATTACHMENTS = {"rig.toml", "surface.json", "panel.glb", "heights.f32"}


def main(path):
    counts = dict.fromkeys(SCHEMAS, 0)
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            assert SCHEMAS.get(channel.topic) == schema.name, f"{channel.topic} has schema {schema.name}"
            assert decoded is not None
            counts[channel.topic] += 1
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        attachments = {a.name: a.data for a in reader.iter_attachments()}
    empty = [topic for topic, count in counts.items() if count == 0]
    assert not empty, f"no message of {', '.join(empty)}"
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
