"""Runs and slices in rerun: the panel, where microphone and speaker stand, responses, sound, air and log.

Samples at 96 kHz never become scalars, which viewers cannot hold: a response is a bar chart, a recording is sound,
played ten times slower because the rig is at a scale of 1:10.
"""

from __future__ import annotations

import io
import os
import urllib.request
import wave
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
_ENVIRONMENT = ("temperature_c", "humidity_pct", "pressure_hpa", "outside_level_db")
_LEVELS = {1: "DEBUG", 2: "INFO", 3: "WARN", 4: "ERROR", 5: "CRITICAL"}
# GLB counts y upwards, the panel z.
_UPRIGHT = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]


def blueprint() -> Any:
    """The views: rig, response, sound, air, verdicts and log."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/", contents=["/panel/**", "/microphone", "/speaker"], name="Rig"),
            rrb.Vertical(
                rrb.BarChartView(origin="/ir", name="Impulse response"),
                rrb.TimeSeriesView(origin="/environment", name="Air"),
                rrb.TimeSeriesView(origin="/measurement", name="Signal-to-noise ratio"),
                rrb.TextLogView(origin="/log", name="Log"),
            ),
            column_shares=[3, 2],
        ),
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
        _panel(recording, reader)
        _messages(recording, reader, None if pairs is None else set(pairs), sounds)
    recording.flush()
    return recording


# A file in memory where it comes from elsewhere: the reader needs to seek.
def _opened(source: str | os.PathLike[str]) -> Any:
    if str(source).startswith(("http://", "https://")):
        with urllib.request.urlopen(str(source)) as answer:
            return io.BytesIO(answer.read())
    return Path(source).open("rb")


def _panel(recording: Any, reader: Any) -> None:
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log("/panel", rr.Transform3D(mat3x3=_UPRIGHT), static=True)
    for attachment in reader.iter_attachments():
        if attachment.name.split("/")[-1] == "panel.glb":
            recording.log("/panel", rr.Asset3D(contents=attachment.data, media_type="model/gltf-binary"), static=True)
            return


def _messages(recording: Any, reader: Any, pairs: set[int] | None, sounds: int) -> None:
    number = 0
    for attempt in _attempts(reader):
        verdict = attempt.get("/measurement")
        if verdict is not None and (pairs is None or verdict[1].pair_id in pairs):
            recording.set_time("measurement", sequence=number)
            _measurement(recording, attempt, number < sounds)
            number += 1
    if pairs is None:
        recording.reset_time()
        for _, _, message, line in reader.iter_decoded_messages(topics=["/log"]):
            recording.set_time("time", timestamp=np.datetime64(message.log_time, "ns"))
            recording.log("/log", rr.TextLog(line.message, level=_LEVELS.get(line.level, "TRACE")))


# What was recorded of each attempt, by topic: everything between two verdicts.
def _attempts(reader: Any) -> Iterator[dict[str, tuple[int, Any]]]:
    wanted = ["/microphone/pose", "/speaker/pose", "/environment", "/ir", "/sweep/audio", "/measurement"]
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


def _measurement(recording: Any, attempt: dict[str, tuple[int, Any]], with_sound: bool) -> None:
    time, verdict = attempt["/measurement"]
    recording.set_time("time", timestamp=np.datetime64(time, "ns"))
    for name, colour in (("microphone", (70, 120, 255)), ("speaker", (255, 120, 40))):
        if (found := attempt.get(f"/{name}/pose")) is not None:
            at = found[1].pose.position
            recording.log(f"/{name}", rr.Points3D([[at.x, at.y, at.z]], radii=0.012, colors=[colour], labels=[name]))
    if (found := attempt.get("/environment")) is not None:
        for name in _ENVIRONMENT:
            recording.log(f"/environment/{name}", rr.Scalars(getattr(found[1], name)))
    recording.log("/measurement/snr_db", rr.Scalars(verdict.snr_db))
    for reason in verdict.reasons:
        recording.log("/log", rr.TextLog(f"pair {verdict.pair_id}: {reason}", level="WARN"))
    if (found := attempt.get("/ir")) is not None:
        response = np.asarray(found[1].samples, dtype=np.float32)
        recording.log("/ir", rr.BarChart(response))
        if with_sound and "/sweep/audio" not in attempt:
            _sound(recording, "/sound/ir", _sixteen_bits(response), found[1].sample_rate_hz / SLOWER)
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
