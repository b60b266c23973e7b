"""Runs and slices in rerun: panel, arms, microphone and speaker, responses, sound, air and log.

Samples at 96 kHz never become scalars, which viewers cannot hold: a response is a bar chart, a recording is sound,
played ten times slower because the rig is at a scale of 1:10.
"""

from __future__ import annotations

import argparse
import io
import os
import urllib.request
import wave
import xml.etree.ElementTree as ET
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray

__all__ = ["blueprint", "view"]

SLOWER = 10
"""How many times slower sound is played."""
_WORLD = "/world"
_ENVIRONMENT = {
    "temperature_c": "Temperature, °C",
    "humidity_pct": "Humidity, %",
    "pressure_hpa": "Pressure, hPa",
    "outside_level_db": "Level outside, dB",
}
_LEVELS = {1: "DEBUG", 2: "INFO", 3: "WARN", 4: "ERROR", 5: "CRITICAL"}
# GLB counts y upwards, the panel z.
_UPRIGHT = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]


def blueprint() -> Any:
    """The views: rig, response, one for each quantity of the air, signal-to-noise ratio, log. Time starts at the first
    measurement."""
    titles = {f"/environment/{name}": title for name, title in _ENVIRONMENT.items()}
    titles["/measurement/snr_db"] = "Signal-to-noise ratio, dB"
    legend = rrb.PlotLegend(visible=False)
    series = [rrb.TimeSeriesView(origin=entity, name=title, plot_legend=legend) for entity, title in titles.items()]
    eye = rrb.EyeControls3D(position=(1.4, -1.9, 2.0), look_target=(0.0, 0.0, 0.95), eye_up=(0.0, 0.0, 1.0))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin=_WORLD, name="Rig", eye_controls=eye),
            rrb.Vertical(
                rrb.BarChartView(origin="/ir", name="Impulse response over time, ms", plot_legend=legend),
                rrb.Grid(*series, rrb.TextLogView(origin="/log", name="Log"), grid_columns=2),
                row_shares=[1, 2],
            ),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline="measurement", play_state="paused", fps=5.0),
        collapse_panels=True,
    )


def view(
    source: str | os.PathLike[str],
    *,
    save: str | os.PathLike[str] | None = None,
    pairs: Sequence[int] | None = None,
    sounds: int = 100,
    spawn: bool | None = None,
) -> Any:
    """Shows a run or a slice; returns the recording.

    ``source`` is an MCAP file or its URL (``echolake export mcap`` makes small ones), ``pairs`` the pairs to show, all
    by default. The first ``sounds`` measurements can be listened to. ``save`` writes an ``.rrd`` file; without it a
    viewer is started, unless ``spawn`` is false.
    """
    recording = rr.RecordingStream("echolake")
    if save is not None:
        recording.save(str(save), default_blueprint=blueprint())
    elif spawn is not False:
        recording.spawn(default_blueprint=blueprint())
    with _opened(source) as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        parents = _parent_frames(reader)
        _panel(recording, reader, parents)
        _arms(recording, reader, parents)
        _messages(recording, reader, parents, None if pairs is None else set(pairs), sounds)
    recording.flush()
    return recording


# A file in memory where it comes from elsewhere: the reader needs to seek.
def _opened(source: str | os.PathLike[str]) -> Any:
    if str(source).startswith(("http://", "https://")):
        with urllib.request.urlopen(str(source)) as answer:
            return io.BytesIO(answer.read())
    return Path(source).open("rb")


# Each frame's parent; all messages of a run have the same frames.
def _parent_frames(reader: Any) -> dict[str, str]:
    for _, _, _, frames in reader.iter_decoded_messages(topics=["/tf"]):
        return {frame.child_frame_id: frame.parent_frame_id for frame in frames.transforms}
    return {}


# A frame's entity stands below its parent's, so that it moves with it.
def _entity(frame: str, parents: dict[str, str]) -> str:
    if frame == "world":
        return _WORLD
    return f"{_entity(parents.get(frame, 'world'), parents)}/{frame}"


def _panel(recording: Any, reader: Any, parents: dict[str, str]) -> None:
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    mesh = _entity("panel", parents) + "/mesh"
    recording.log(mesh, rr.Transform3D(mat3x3=_UPRIGHT), static=True)
    for attachment in reader.iter_attachments():
        if attachment.name.split("/")[-1] == "panel.glb":
            recording.log(mesh, rr.Asset3D(contents=attachment.data, media_type="model/gltf-binary"), static=True)
            return


# The arms' links as the run describes them, in URDF of boxes, cylinders and spheres.
def _arms(recording: Any, reader: Any, parents: dict[str, str]) -> None:
    for _, _, message in reader.iter_messages(topics=["/robot_description"]):
        # Behind the header of CDR and the text's length; the text ends with a zero.
        description = message.data[8:].rstrip(b"\0")
        for link in ET.fromstring(description).iter("link"):
            for number, visual in enumerate(link.iter("visual")):
                entity = f"{_entity(link.attrib['name'], parents)}/shape_{number}"
                recording.log(entity, _link_shape(visual), static=True)
        return


def _link_shape(visual: ET.Element) -> Any:
    shape = visual.find("geometry/*")
    if shape is None:
        return rr.Clear(recursive=False)
    style = {
        "centers": [_numbers(visual.find("origin"), "xyz", [0.0, 0.0, 0.0])],
        "colors": [_numbers(visual.find("material/color"), "rgba", [0.7, 0.7, 0.7, 1.0])],
        "fill_mode": "solid",
    }
    if shape.tag == "box":
        return rr.Boxes3D(sizes=[_numbers(shape, "size", [0.0, 0.0, 0.0])], **style)
    radius = float(shape.attrib["radius"])
    if shape.tag == "cylinder":
        return rr.Cylinders3D(lengths=[float(shape.attrib["length"])], radii=[radius], **style)
    return rr.Ellipsoids3D(radii=[radius], **style)


def _numbers(element: ET.Element | None, name: str, default: list[float]) -> list[float]:
    return default if element is None else [float(number) for number in element.attrib[name].split()]


def _messages(recording: Any, reader: Any, parents: dict[str, str], pairs: set[int] | None, sounds: int) -> None:
    times: list[int] = []
    # Numbers and transforms are sent as columns, which is many times faster than one by one.
    numbers: dict[str, list[tuple[int, float]]] = defaultdict(list)
    frames: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    for attempt in _attempts(reader):
        verdict = attempt.get("/measurement")
        if verdict is None or (pairs is not None and verdict[1].pair_id not in pairs):
            continue
        number = len(times)
        times.append(verdict[0])
        recording.set_time("measurement", sequence=number)
        recording.set_time("time", timestamp=np.datetime64(verdict[0], "ns"))
        _measurement(recording, attempt, parents, number < sounds)
        numbers["/measurement/snr_db"].append((number, verdict[1].snr_db))
        if (found := attempt.get("/environment")) is not None:
            for name in _ENVIRONMENT:
                numbers[f"/environment/{name}"].append((number, getattr(found[1], name)))
        if (found := attempt.get("/tf")) is not None:
            for frame in found[1].transforms:
                frames[_entity(frame.child_frame_id, parents)].append((number, frame))
    for entity, values in numbers.items():
        columns = rr.Scalars.columns(scalars=[value for _, value in values])
        recording.send_columns(entity, indexes=_time_columns(times, values), columns=columns)
    for entity, moves in frames.items():
        positions = [(f.translation.x, f.translation.y, f.translation.z) for _, f in moves]
        turns = [(f.rotation.x, f.rotation.y, f.rotation.z, f.rotation.w) for _, f in moves]
        columns = rr.Transform3D.columns(translation=positions, quaternion=turns)
        recording.send_columns(entity, indexes=_time_columns(times, moves), columns=columns)
    if pairs is None:
        for _, _, message, line in reader.iter_decoded_messages(topics=["/log"]):
            recording.set_time("measurement", sequence=max(bisect_right(times, message.log_time) - 1, 0))
            recording.set_time("time", timestamp=np.datetime64(message.log_time, "ns"))
            recording.log("/log", rr.TextLog(line.message, level=_LEVELS.get(line.level, "TRACE")))


def _time_columns(times: list[int], rows: Sequence[tuple[int, Any]]) -> list[Any]:
    numbers = [number for number, _ in rows]
    stamps = np.array([times[number] for number in numbers], dtype="datetime64[ns]")
    return [rr.TimeColumn("measurement", sequence=numbers), rr.TimeColumn("time", timestamp=stamps)]


# What was recorded of each attempt, by topic: everything between two verdicts.
def _attempts(reader: Any) -> Iterator[dict[str, tuple[int, Any]]]:
    wanted = ["/tf", "/microphone/pose", "/speaker/pose", "/environment", "/ir", "/sweep/audio", "/measurement"]
    open_attempts: dict[int, dict[str, tuple[int, Any]]] = {}
    last_air: tuple[int, Any] | None = None
    for _, channel, message, decoded in reader.iter_decoded_messages(topics=wanted):
        if channel.topic == "/environment":
            last_air = (message.log_time, decoded)
            continue
        # All that an attempt records bears its time; older ones are whole.
        for time in [t for t in open_attempts if t < message.log_time]:
            yield _with_air(open_attempts.pop(time), last_air)
        open_attempts.setdefault(message.log_time, {})[channel.topic] = (message.log_time, decoded)
    for attempt in open_attempts.values():
        yield _with_air(attempt, last_air)


def _with_air(attempt: dict[str, tuple[int, Any]], air: tuple[int, Any] | None) -> dict[str, tuple[int, Any]]:
    return attempt | ({"/environment": air} if air is not None else {})


def _measurement(
    recording: Any, attempt: dict[str, tuple[int, Any]], parents: dict[str, str], with_sound: bool
) -> None:
    verdict = attempt["/measurement"][1]
    panel = _entity("panel", parents)
    for name, colour in (("microphone", (70, 120, 255)), ("speaker", (255, 120, 40))):
        if (found := attempt.get(f"/{name}/pose")) is not None:
            at = found[1].pose.position
            points = rr.Points3D([[at.x, at.y, at.z]], radii=0.012, colors=[colour], labels=[name])
            recording.log(f"{panel}/{name}", points)
    for reason in verdict.reasons:
        recording.log("/log", rr.TextLog(f"pair {verdict.pair_id}: {reason}", level="WARN"))
    if (found := attempt.get("/ir")) is not None:
        rate_hz = found[1].sample_rate_hz
        response = np.asarray(found[1].samples, dtype=np.float32)
        times_ms = np.arange(len(response), dtype=np.float32) / rate_hz * 1e3
        recording.log("/ir", rr.BarChart(response, abscissa=times_ms, widths=np.full_like(times_ms, 1e3 / rate_hz)))
        if with_sound and "/sweep/audio" not in attempt:
            _sound(recording, "/sound/ir", _sixteen_bits(response), rate_hz / SLOWER)
    if with_sound and (found := attempt.get("/sweep/audio")) is not None:
        # It is slowed down in the file already.
        _sound(recording, "/sound/sweep", np.frombuffer(found[1].data, dtype="<i2"), found[1].sample_rate)


def _sixteen_bits(samples: NDArray[np.float32]) -> NDArray[np.int16]:
    peak = float(np.max(np.abs(samples), initial=0.0)) or 1.0
    return np.round(samples / peak * 32_000).astype(np.int16)


def _sound(recording: Any, path: str, samples: NDArray[np.int16], rate_hz: float) -> None:
    if not hasattr(rr, "AssetAudio"):
        return
    recording.log(path, rr.AssetAudio(contents=_wav(samples, round(rate_hz)), media_type="audio/wav"))


def _wav(samples: NDArray[np.int16], rate_hz: int) -> bytes:
    content = io.BytesIO()
    with wave.open(content, "wb") as to:
        to.setnchannels(1)
        to.setsampwidth(2)
        to.setframerate(rate_hz)
        to.writeframes(samples.astype("<i2").tobytes())
    return content.getvalue()


def main() -> None:
    """Shows a file or a URL: ``python -m echolake.rerun 'http://localhost:8080/api/v1/runs/RUN/file.mcap'``."""
    parser = argparse.ArgumentParser(prog="python -m echolake.rerun", description="Show a run or a slice in rerun.")
    parser.add_argument("source", help="MCAP file or its URL")
    parser.add_argument("--save", metavar="FILE", help="write an .rrd file instead of starting a viewer")
    arguments = parser.parse_args()
    view(arguments.source, save=arguments.save)


if __name__ == "__main__":
    main()
