"""Compares the tables of a lake with an independent chain: `independent_chain.py --program ECHOLAKE`.

The chain was written from the paper (Rust et al. 2021) and from the definitions in docs/decisions/division.md and
schema/src/rig.rs; it shares no code with the program. It reads the raw sweeps and loopbacks of run files with Python's
mcap, computes responses, curves and levels in double precision, and compares them with the tables as deltalake reads
them, in each variant of `impulse_response.division`. The program makes the lakes: the demo's six surfaces, simulated
with one seed, on a small grid and on the paper's.

    --folder FOLDER     keeps the lakes there, and uses those that are there already
    --limit DB          the greatest difference that passes, 0.001 by default
    --grids GRID...     compares only these: small, small-half-second, paper; `none` for no comparison
    --reference FOLDER  compares with the pipeline.py in FOLDER, too
    --variants          prints how far tapered and floored levels are from literal ones
    --lengths           compares tapered levels of three sweep lengths

Needs Python 3.11 and the PyPI packages deltalake, mcap, mcap-protobuf-support, numpy, pyarrow and scipy. Exits with 1
if a difference is over its limit.
"""

import argparse
import dataclasses
import fractions
import importlib.util
import itertools
import pathlib
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import deltalake
import numpy as np
import numpy.typing as npt
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.signal import resample_poly

Signal = npt.NDArray[np.float64]

VARIANTS = ("tapered", "floored", "literal")
SMALL_GRID = """
[[grid.layers]]
points_per_side = 3
pitch_mm = 120.0
height_mm = 124.0
[[grid.layers]]
points_per_side = 1
pitch_mm = 0.0
height_mm = 304.0
"""
# Name of the grid: its text in a rig file, and the sweep's duration in seconds.
GRIDS = {"small": (SMALL_GRID, 0.03), "small-half-second": (SMALL_GRID, 0.5), "paper": ("", 0.05)}
# Pairs of each surface that are compared.
PAIR_COUNT = 45
LENGTH_SECS = (0.05, 0.5, 2.0)
LENGTH_PANEL = "river_rock"
LENGTH_LIMIT_DB = 0.01
# Seeds of Flat, Foam and the panel; the first without noise, drift and chance of the arms' places.
LENGTH_SEEDS = ((0, 0, 0), (1, 2, 3), (4, 5, 6))
# Without chance, lakes differ in what is compared alone.
QUIET = "[simulation]\nrepeatability_mm = 0.0\nnoise_and_drift = false\n"
# The five bands and the total.
LEVEL_COLUMNS = 6
# Beginning of the columns: what they are over.
OVER = {"tnce": "over Flat's total", "tnce_band": "over Flat's same band"}
# SampleFormat of sweep_recording.proto: low bytes of all samples, then the upper two of each.
S24_SPLIT = 5
ACCEPTED = 1
KELVIN = 273.15
AIRS = ("complete", "paper")
# The reference air: relative humidity, and pressure.
REFERENCE_HUMIDITY_PCT, REFERENCE_HPA = 50.0, 1013.25
# Cramer 1993, table III, and his water vapour; 0.04 % of carbon dioxide.
CRAMER = (
    (331.5024, 0.603055, -0.000528),
    (51.471935, 0.1495874, -0.000782),
    (-1.82e-7, 3.73e-8, -2.93e-10),
    (-85.20931, -0.228525, 5.91e-5),
)
CRAMER_SQUARES = (-2.835149, -2.15e-13, 29.179762)
CRAMER_PRODUCT = 0.000486
VAPOUR = (1.2811805e-5, -1.9509874e-2, 34.04926034, -6.3536311e3)
ENHANCEMENT = (1.00062, 3.14e-8, 5.6e-7)
CARBON_DIOXIDE = 0.0004
SIXTH_OCTAVE = 2 ** (1 / 6)
# Slopes of speaker and microphone: distance of the bins that one is between, Hz; the part of the direct sound before
# the reflection, and where it takes over: a frequency, and periods in the time between both arrivals.
SLOPE_HZ = 250.0
LEAST_PAIRS = 24
LEAST_SEPARATION_SECS = 0.2e-3
GATE_SECS = (0.15e-3, 0.05e-3)
GATED_HZ, GATED_PERIODS = 12e3, 5.0
# Share of the sweep's limits by which a tapered response's range is narrower.
MARGIN = 0.015


@dataclasses.dataclass(frozen=True)
class RigSettings:
    """The settings of a lake's rig that decide its numbers."""

    rate_hz: float
    low_hz: float
    high_hz: float
    length: int
    reference_celsius: float
    division: str
    floor_db: float
    centres_hz: tuple[float, ...]
    air: str

    @classmethod
    def from_lake(cls, folder: pathlib.Path) -> "RigSettings":
        rig = tomllib.loads((folder / "lake.toml").read_text())["rig"]
        sweep, response = rig["sweep"], rig["impulse_response"]
        return cls(
            rate_hz=sweep["rate_hz"],
            low_hz=sweep["low_hz"],
            high_hz=sweep["high_hz"],
            length=response["length"],
            reference_celsius=response["reference_temperature_c"],
            division=response["division"],
            floor_db=response.get("floor_db", -60.0),
            centres_hz=tuple(rig["bands"]["centres_hz"]),
            air=response["air"],
        )

    def band_names(self) -> list[str]:
        return [f"{centre:.0f}" for centre in self.centres_hz]


@dataclasses.dataclass(frozen=True)
class Air:
    """The state of the air."""

    celsius: float
    humidity_pct: float = REFERENCE_HUMIDITY_PCT
    hpa: float = REFERENCE_HPA

    def speed_of_sound(self) -> float:
        """Cramer 1993, m/s."""
        pascal, kelvin = 100 * self.hpa, self.celsius + KELVIN
        a, b, c, d = VAPOUR
        vapour = np.exp(a * kelvin**2 + b * kelvin + c + d / kelvin)
        one, per_pascal, per_square = ENHANCEMENT
        factor = one + per_pascal * pascal + per_square * self.celsius**2
        water = self.humidity_pct / 100 * factor * vapour / pascal
        shares = np.array([water, pascal, CARBON_DIOXIDE])
        powers = self.celsius ** np.arange(3)
        linear = np.array(CRAMER) @ powers @ np.array([1, *shares])
        return float(linear + np.array(CRAMER_SQUARES) @ shares**2 + CRAMER_PRODUCT * shares.prod())

    def absorption(self, hz: Signal) -> Signal:
        """ISO 9613-1, dB/m."""
        kelvin = self.celsius + KELVIN
        warmth, pressure = kelvin / 293.15, self.hpa / 1013.25
        water = self.humidity_pct / pressure * 10 ** (4.6151 - 6.8346 * (273.16 / kelvin) ** 1.261)
        oxygen = pressure * (24 + 4.04e4 * water * (0.02 + water) / (0.391 + water))
        nitrogen = pressure / np.sqrt(warmth) * (9 + 280 * water * np.exp(-4.17 * (warmth ** (-1 / 3) - 1)))
        relaxed = 0.01275 * np.exp(-2239.1 / kelvin) / (oxygen + hz**2 / oxygen)
        relaxed += 0.1068 * np.exp(-3352 / kelvin) / (nitrogen + hz**2 / nitrogen)
        return np.array(8.686 * hz**2 * (1.84e-11 / pressure * np.sqrt(warmth) + warmth**-2.5 * relaxed))


@dataclasses.dataclass(frozen=True)
class Sweep:
    """One accepted recording, in fractions of full scale."""

    recording: Signal
    loopback: Signal
    air: Air


@dataclasses.dataclass(frozen=True)
class Measured:
    """A response at the reference temperature, the air that it was measured in, and the lengths of direct and reflected
    path, m."""

    response: Signal
    air: Air
    metres: tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Derived:
    """What a response becomes beside Foam's and Flat's of the same pair."""

    curves: Signal
    over_total: Signal
    over_band: Signal
    total: float


class IndependentChain:
    """The paper's chain: from a recording to its response, and from there to bands."""

    def __init__(self, settings: RigSettings):
        self.settings = settings
        self.hz = np.fft.rfftfreq(settings.length, 1 / settings.rate_hz).astype(np.float64)
        self.reference = Air(settings.reference_celsius)
        self.slopes = np.zeros((2, len(self.hz)), complex)
        self.gains = self.band_gains(self.hz)

    def ratio(self, air: Air) -> float:
        """The speed of sound over that in the reference air."""
        if self.settings.air == "complete":
            return air.speed_of_sound() / self.reference.speed_of_sound()
        return float(np.sqrt((KELVIN + air.celsius) / (KELVIN + self.settings.reference_celsius)))

    def divide(self, recording: Signal, loopback: Signal, air: Air) -> Signal:
        """The appendix's step 1: the recording's spectrum over the loopback's."""
        rig, count = self.settings, len(recording)
        numerator, divisor = np.fft.rfft(recording), np.fft.rfft(loopback)
        hz = np.fft.rfftfreq(count, 1 / rig.rate_hz)
        inside = (hz >= rig.low_hz) & (hz <= rig.high_hz)
        if rig.division == "literal":
            return np.fft.irfft(numerator / divisor, count)
        if rig.division == "floored":
            power = np.abs(divisor) ** 2
            least = power[inside].mean() * 10 ** (rig.floor_db / 10)
            power = np.where(inside, power, np.maximum(power, least))
            return np.fft.irfft(numerator * divisor.conj() / power, count)
        # A response of this many samples resolves this width.
        width_hz = rig.rate_hz / rig.length
        # The same limits at the reference temperature, whatever that of the air is.
        low_hz = max(rig.low_hz * (1 + MARGIN) * self.ratio(air), rig.low_hz)
        high_hz = min(rig.high_hz * (1 - MARGIN) * self.ratio(air), rig.high_hz)
        rise = np.clip(np.minimum(hz - low_hz, high_hz - hz) / width_hz, 0, 1)
        quotient = np.zeros_like(numerator)
        np.divide(numerator, divisor, out=quotient, where=inside)
        return np.fft.irfft(quotient * (1 - np.cos(np.pi * rise)) / 2, count)

    def correct(self, response: Signal, air: Air) -> Signal:
        """Step 2: the time axis of the reference temperature, by SciPy's polyphase filter; then 4 ms of it."""
        # So fine a fraction is off by a hundredth of a sample at sample 384 at most.
        step = fractions.Fraction(self.ratio(air)).limit_denominator(20_000)
        corrected: Signal = resample_poly(response, step.numerator, step.denominator)[: self.settings.length]
        return np.pad(corrected, (0, self.settings.length - len(corrected)))

    def response(self, sweep: Sweep) -> Signal:
        corrected = self.correct(self.divide(sweep.recording, sweep.loopback, sweep.air), sweep.air)
        # A tapered response's spectrum keeps its height.
        return corrected / self.ratio(sweep.air) if self.settings.division == "tapered" else corrected

    def band_gains(self, hz: Signal) -> Signal:
        """Itersine windows an octave wide at -3 dB, with the cosine squared, which the paper omits in print; lowest and
        highest band hold what remains."""
        octaves = np.log2(np.maximum(hz, 1e-3) / self.settings.centres_hz[0])
        gains = []
        for band in range(len(self.settings.centres_hz)):
            distance = octaves - band
            if band == 0:
                distance = np.maximum(distance, 0)
            if band == len(self.settings.centres_hz) - 1:
                distance = np.minimum(distance, 0)
            window = np.sin(np.pi / 2 * np.cos(np.pi / 2 * distance) ** 2)
            gains.append(np.where(np.abs(distance) < 1, window, 0))
        return np.array(gains)

    def bands(self, response: Signal) -> Signal:
        return np.fft.irfft(self.gains * np.fft.rfft(response), len(response))

    def learn_slopes(self, foam: dict[int, Measured], flat: dict[int, Measured]) -> None:
        """d ln(spectrum) / d ln(frequency) of speaker and microphone: from the direct sound and from what Flat
        reflects, each summed over the pairs as if it came at once, without absorption by the reference air. At high
        frequencies the direct slopes are those of its part before the reflection."""
        pairs = sorted(foam.keys() & flat.keys())
        if len(pairs) < LEAST_PAIRS:
            raise RuntimeError(f"{len(pairs)} pairs, expected {LEAST_PAIRS} or more")
        metres = np.array([flat[pair].metres for pair in pairs])
        direct = np.array([foam[pair].response for pair in pairs])
        reflected = np.array([flat[pair].response - foam[pair].response for pair in pairs])
        emitted = [self.emitted(of, metres[:, path]) for path, of in enumerate((direct, reflected))]
        self.slopes = np.array([self.exact_slopes(spectrum) for spectrum in emitted])
        separation = (metres[:, 1] - metres[:, 0]) / self.reference.speed_of_sound()
        apart = separation >= LEAST_SEPARATION_SECS
        if apart.sum() < LEAST_PAIRS:
            return
        before_secs = metres[apart, 1, None] / self.reference.speed_of_sound() - GATE_SECS[0]
        secs = np.arange(self.settings.length) / self.settings.rate_hz - before_secs
        gate = (1 + np.cos(np.pi * np.clip(secs / (GATE_SECS[0] - GATE_SECS[1]), 0, 1))) / 2
        gated = self.smooth_slopes(self.emitted(direct[apart] * gate, metres[apart, 0]))
        from_hz = max(GATED_HZ, GATED_PERIODS / separation[apart].mean())
        share = np.clip((self.hz / from_hz - 1) * 3, 0, 1)
        self.slopes[0] = (1 - share) * self.slopes[0] + share * gated

    def emitted(self, signals: Signal, metres: Signal) -> npt.NDArray[np.complex128]:
        """Spectra summed as if all sound came at once, without absorption by the reference air."""
        delays = metres[:, None] / self.reference.speed_of_sound()
        aligned = np.fft.rfft(signals, axis=1) * np.exp(2j * np.pi * self.hz * delays) * metres[:, None]
        absorbed = metres.mean() / 20 * self.reference.absorption(self.hz)
        spectrum: npt.NDArray[np.complex128] = aligned.sum(axis=0) * 10**absorbed
        return spectrum

    def slope_range(self) -> tuple[int, int]:
        """The first and the last bin with a slope of its own."""
        step_hz = self.settings.rate_hz / self.settings.length
        first = int(np.ceil(self.settings.low_hz * 1.02 / step_hz)) + 2
        return first, min(int(self.settings.high_hz * 0.98 / step_hz) - 2, len(self.hz) - 2)

    def exact_slopes(self, spectrum: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
        """Slopes between bins that are 250 Hz to either side."""
        first, last = self.slope_range()
        bins = np.clip(np.arange(len(self.hz)), first, last)
        distance = max(1, round(SLOPE_HZ * self.settings.length / self.settings.rate_hz))
        distance = np.minimum(distance, np.minimum(bins - first, last - bins) + 1)
        low, high = bins - distance, bins + distance
        slopes: npt.NDArray[np.complex128] = np.log(spectrum[high] / spectrum[low]) / np.log(high / low)
        return slopes

    def smooth_slopes(self, spectrum: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
        """Slopes over a third of an octave."""
        first, last = self.slope_range()
        bins = np.arange(first, last + 1)
        slopes = np.log(spectrum[bins + 1] / spectrum[bins - 1]) / np.log((bins + 1) / (bins - 1))
        weights = np.abs(spectrum[bins + 1] * spectrum[bins - 1])
        smooth = np.zeros(len(self.hz), complex)
        for index in range(len(self.hz)):
            middle = min(max(index, first), last)
            near = (bins >= round(middle / SIXTH_OCTAVE)) & (bins <= round(middle * SIXTH_OCTAVE))
            smooth[index] = np.average(slopes[near], weights=weights[near])
        return smooth

    def reflected(self, of: Measured, foam: Measured) -> Signal:
        """What a surface reflects in the reference air: Foam's direct sound is brought to the surface's air first."""
        if self.settings.air == "paper":
            return of.response - foam.response
        own, other = self.ratio(of.air), self.ratio(foam.air)
        absorbed = of.air.absorption(self.hz * own)
        direct_m, reflected_m = of.metres
        to_own = (own / other) ** self.slopes[0]
        to_own = to_own * 10 ** (direct_m / 20 * (foam.air.absorption(self.hz * other) - absorbed))
        to_reference = own ** -self.slopes[1]
        to_reference = to_reference * 10 ** (reflected_m / 20 * (absorbed - self.reference.absorption(self.hz)))
        spectrum = (np.fft.rfft(of.response) - to_own * np.fft.rfft(foam.response)) * to_reference
        return np.fft.irfft(spectrum, len(of.response))

    def derive(self, reflected: Signal, flat: Signal) -> Derived:
        """Energies over Flat's."""
        energies = np.cumsum(self.bands(reflected) ** 2, axis=1)
        flat_energies = np.sum(self.bands(flat) ** 2, axis=1)
        curves = energies / flat_energies.sum()
        last = energies[:, -1]
        return Derived(curves, curves[:, -1], last / flat_energies, float(curves[:, -1].sum()))


class ReferenceChain(IndependentChain):
    """The steps of a pipeline.py. It knows the floored division alone; the other two are the chain's."""

    def __init__(self, settings: RigSettings, pipeline: Any):
        super().__init__(settings)
        self.pipeline = pipeline

    def divide(self, recording: Signal, loopback: Signal, air: Air) -> Signal:
        if self.settings.division == "floored":
            quotient: Signal = self.pipeline.deconvolve(recording, loopback, floor_db=self.settings.floor_db)
            return quotient
        return super().divide(recording, loopback, air)

    def correct(self, response: Signal, air: Air) -> Signal:
        cropped: Signal = self.pipeline.crop(self.pipeline.temperature_correct(response, air.celsius))
        return cropped

    def bands(self, response: Signal) -> Signal:
        filtered: Signal = self.pipeline.band_filter(response)
        return filtered

    def reflected(self, of: Measured, foam: Measured) -> Signal:
        difference: Signal = self.pipeline.subtract_direct(of.response, foam.response)
        return difference

    def derive(self, reflected: Signal, flat: Signal) -> Derived:
        curves = self.pipeline.nce(self.bands(reflected), flat)
        over_total, total = self.pipeline.tnce(curves)
        energies = [np.sum(self.bands(signal) ** 2, axis=1) for signal in (reflected, flat)]
        return Derived(curves, over_total, energies[0] / energies[1], float(total))


class MeasuredLake:
    """A lake of simulated runs, one of each surface."""

    def __init__(self, folder: pathlib.Path):
        self.folder = folder
        self.settings = RigSettings.from_lake(folder)

    @classmethod
    def make(cls, program: str, folder: pathlib.Path, rig: str, commands: Sequence[Sequence[str]]) -> "MeasuredLake":
        """Runs the commands, which make the lake, unless it is there."""
        if not (folder / "lake.toml").exists():
            folder.parent.mkdir(parents=True, exist_ok=True)
            rig_file = folder.with_suffix(".toml")
            rig_file.write_text(rig)
            partial = folder.with_suffix(".partial")
            for command in commands:
                arguments = [str(rig_file) if argument == "RIG" else argument for argument in command]
                run = [program, "--lake", str(partial), *arguments]
                done = subprocess.run(run, capture_output=True, text=True, check=False)
                if done.returncode:
                    raise RuntimeError(f"{' '.join(run)}\n{done.stderr}")
            partial.rename(folder)
        return cls(folder)

    def surfaces(self) -> list[str]:
        return sorted(path.name for path in (self.folder / "runs").iterdir())

    def path_metres(self) -> dict[int, tuple[float, float]]:
        """Lengths of the direct path and of that by the panel's plane, by pair."""
        columns = [f"{of}_{axis}_mm" for of in ("microphone", "speaker") for axis in "xyz"]
        table = deltalake.DeltaTable(str(self.folder / "tables" / "pairs")).to_pyarrow_table()
        metres = {}
        for row in table.select(["pair_id", *columns]).to_pylist():
            microphone, speaker = np.array([row[column] for column in columns]).reshape(2, 3) / 1000
            image = speaker * (1, 1, -1)
            metres[row["pair_id"]] = (
                float(np.linalg.norm(microphone - speaker)),
                float(np.linalg.norm(microphone - image)),
            )
        return metres

    def pairs(self) -> list[int]:
        """Some pairs of all layers, the first and the last among them."""
        every = sorted(self.rows("tnce", self.surfaces()[0], ["pair_id"]))
        chosen = np.linspace(0, len(every) - 1, min(PAIR_COUNT, len(every))).round().astype(int)
        return [every[index] for index in chosen]

    def rows(self, table: str, surface: str, columns: Sequence[str]) -> dict[int, dict[str, Any]]:
        """The rows of a surface by their pairs."""
        read = deltalake.DeltaTable(str(self.folder / "tables" / table))
        filters = [("surface_id", "=", surface)]
        rows = read.to_pyarrow_table(filters=filters, columns=list({"pair_id", *columns})).to_pylist()
        return {row["pair_id"]: row for row in rows}

    def levels(self) -> dict[str, dict[str, float]]:
        """The paper's table: a level for each surface and band."""
        surfaces = {surface: self.surface_rows(surface, ["p90_mean_db"]) for surface in self.surfaces()}
        levels = {
            surface: {band: row["p90_mean_db"] for band, row in rows.items() if row["p90_mean_db"] is not None}
            for surface, rows in surfaces.items()
        }
        return {surface: bands for surface, bands in levels.items() if bands}

    def surface_rows(self, surface: str, columns: Sequence[str]) -> dict[str, dict[str, Any]]:
        """The rows of `surface_stats` of a surface, by band."""
        read = deltalake.DeltaTable(str(self.folder / "tables" / "surface_stats"))
        filters = [("surface_id", "=", surface)]
        rows = read.to_pyarrow_table(filters=filters, columns=["band", *columns]).to_pylist()
        return {row["band"]: row for row in rows}

    def sweeps(self, surface: str, pairs: Iterable[int]) -> dict[int, Sweep]:
        """The accepted recordings of some pairs."""
        files = list((self.folder / "runs" / surface).glob("*.mcap"))
        if len(files) != 1:
            raise RuntimeError(f"{self.folder}: {surface} has {len(files)} runs, expected one")
        wanted, accepted, sweeps = set(pairs), {}, {}
        with open(files[0], "rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            for _, channel, _, message in reader.iter_decoded_messages(topics=["/sweep", "/measurement"]):
                if message.pair_id not in wanted:
                    continue
                if channel.topic == "/measurement" and message.verdict == ACCEPTED:
                    accepted[message.pair_id] = message.attempt
                elif channel.topic == "/sweep":
                    recording, loopback = (
                        fractions_of(message, part) for part in (message.microphone, message.loopback)
                    )
                    air = Air(message.temperature_c, message.humidity_pct, message.pressure_hpa)
                    sweeps[message.pair_id, message.attempt] = Sweep(recording, loopback, air)
        return {pair: sweeps[pair, attempt] for pair, attempt in accepted.items()}


def fractions_of(message: Any, data: bytes) -> Signal:
    """Samples as fractions of full scale."""
    if message.format != S24_SPLIT or len(data) != 3 * message.sample_count:
        raise RuntimeError(f"format {message.format}, {len(data)} bytes of {message.sample_count} samples")
    low = np.frombuffer(data, np.uint8, message.sample_count)
    upper = np.frombuffer(data, "<i2", offset=message.sample_count)
    return (upper.astype(float) * 256 + low) / 2**23


@dataclasses.dataclass
class Differences:
    """The greatest differences of measurements, and how many are over a limit."""

    limit_db: float
    compared: int = 0
    over_limit: int = 0
    response: float = 0.0
    levels_db: Signal = dataclasses.field(default_factory=lambda: np.zeros(4))

    def add(self, here: Derived, there: Derived, responses: tuple[Signal, Signal]) -> None:
        off_db = np.array(
            [
                level_difference(here.over_total, there.over_total),
                level_difference(here.over_band, there.over_band),
                level_difference(here.total, there.total),
                curve_difference(here.curves, there.curves),
            ]
        )
        off = np.linalg.norm(responses[0] - responses[1]) / np.linalg.norm(responses[1])
        self.compared += 1
        self.over_limit += bool(off_db.max() > self.limit_db)
        self.response = max(self.response, float(off))
        self.levels_db = np.maximum(self.levels_db, off_db)

    def cells(self) -> list[str]:
        response_db = 20 * np.log10(max(self.response, 1e-17))
        levels = [f"{level:.6f}" if level < 0.1 else f"{level:.2f}" for level in self.levels_db]
        return [str(self.compared), str(self.over_limit), f"{response_db:.0f}", *levels]


DIFFERENCE_COLUMNS = [
    "responses",
    "bands over Flat's total",
    "bands over Flat's same band",
    "totals",
    "curves",
]


def curve_difference(here: Signal, there: Signal) -> float:
    """The greatest distance of two curves over the last value of theirs, as a level."""
    last = there[:, -1]
    return float(10 * np.log10(1 + (np.abs(here - there).max(axis=1) / last).max())) if last.all() else 0.0


def level_difference(here: npt.ArrayLike, there: npt.ArrayLike) -> float:
    """The greatest difference of energies, dB. Foam's are zero, and must be on both sides."""
    a, b = np.atleast_1d(here).astype(float), np.atleast_1d(there).astype(float)
    if ((a == 0) != (b == 0)).any():
        return float("inf")
    return max((abs(10 * np.log10(x / y)) for x, y in zip(a, b, strict=True) if y), default=0.0)


def print_table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    print(f"\n{title}\n")
    for line in (header, ["---"] * len(header), *rows):
        print(f"| {' | '.join(line)} |", flush=True)


def table_values(lake: MeasuredLake, surface: str) -> dict[int, tuple[Derived, Signal]]:
    """What the tables hold of a surface, by pair."""
    names = lake.settings.band_names()
    over_total, over_band = [f"tnce_{name}" for name in names], [f"tnce_band_{name}" for name in names]
    levels = lake.rows("tnce", surface, [*over_total, *over_band, "tnce_total"])
    curves = lake.rows("nce", surface, [f"nce_{name}" for name in names])
    responses = lake.rows("measurements", surface, ["ir"])
    values = {}
    for pair, row in levels.items():
        derived = Derived(
            curves=np.array([curves[pair][f"nce_{name}"] for name in names], float),
            over_total=np.array([row[name] for name in over_total]),
            over_band=np.array([row[name] for name in over_band]),
            total=row["tnce_total"],
        )
        values[pair] = (derived, np.array(responses[pair]["ir"], float))
    return values


# Levels and response of each surface and pair.
MeasuredValues = dict[tuple[str, int], tuple[Derived, Signal]]
Chains = dict[str, Callable[[RigSettings], IndependentChain]]


def compare_lake(lake: MeasuredLake, chains: Chains, limit_db: float) -> dict[str, Differences]:
    """The tables beside the chain, and beside the reference, and these two beside each other."""
    pairs = lake.pairs()
    metres = lake.path_metres()
    # The slopes are of all pairs.
    wanted = {surface: metres if surface in ("foam", "flat") else pairs for surface in lake.surfaces()}
    sweeps = {surface: lake.sweeps(surface, wanted[surface]) for surface in wanted}
    derived: dict[str, MeasuredValues] = {"tables": {}}
    for surface in sweeps:
        values = table_values(lake, surface)
        derived["tables"] |= {(surface, pair): values[pair] for pair in pairs if pair in values}
    for name, make in chains.items():
        chain = make(lake.settings)
        measured = {
            surface: {pair: Measured(chain.response(sweep), sweep.air, metres[pair]) for pair, sweep in taken.items()}
            for surface, taken in sweeps.items()
        }
        foam, flat = measured["foam"], measured["flat"]
        chain.learn_slopes(foam, flat)
        derived[name] = {
            (surface, pair): (
                chain.derive(chain.reflected(of, foam[pair]), chain.reflected(flat[pair], foam[pair])),
                of.response,
            )
            for surface, of_surface in measured.items()
            for pair, of in of_surface.items()
            if pair in pairs and pair in foam and pair in flat
        }
    names = list(derived)
    couples = [(a, b) for index, b in enumerate(names) for a in names[:index]]
    return {f"{a} beside {b}": differences(derived[a], derived[b], limit_db) for a, b in couples}


def differences(here: MeasuredValues, there: MeasuredValues, limit_db: float) -> Differences:
    if here.keys() != there.keys():
        raise RuntimeError(f"measurements of one side alone: {sorted(here.keys() ^ there.keys())}")
    found = Differences(limit_db)
    for key, (derived, response) in here.items():
        found.add(derived, there[key][0], (response, there[key][1]))
    return found


def demo_lake(program: str, folder: pathlib.Path, grid: str, division: str, air: str = "complete") -> MeasuredLake:
    text, secs = GRIDS[grid]
    demo = ["demo", "--no-serve", "--rig", "RIG"]
    return MeasuredLake.make(program, folder / f"{grid}-{division}-{air}", rig_text(text, secs, division, air), [demo])


def rig_text(grid: str, secs: float, division: str, air: str = "complete") -> str:
    response = f'[impulse_response]\ndivision = "{division}"\nair = "{air}"\n'
    return f'name = "numbers"\nscale = 10\n[sweep]\nduration_secs = {secs}\n{response}{grid}'


def panel_lake(program: str, folder: pathlib.Path, secs: float, seeds: Sequence[int]) -> MeasuredLake:
    """One panel and its references with sweeps of a length."""
    surfaces = ("flat", "foam", LENGTH_PANEL)
    acquire = [
        ["acquire", "--rig", "RIG", "--seed", str(seed), "--surface", surface]
        for seed, surface in zip(seeds, surfaces, strict=True)
    ]
    name = f"length-{secs}-seeds-{'-'.join(map(str, seeds))}"
    rig = rig_text(SMALL_GRID, secs, "tapered") + (QUIET if not any(seeds) else "")
    return MeasuredLake.make(program, folder / name, rig, [*acquire, ["ingest"]])


def check_agreement(program: str, folder: pathlib.Path, grids: Sequence[str], chains: Chains, limit_db: float) -> bool:
    rows, right = [], True
    for grid in grids:
        for variant, air in itertools.product(VARIANTS, AIRS):
            lake = demo_lake(program, folder, grid, variant, air)
            # The reference pipeline knows the paper's treatment alone.
            known = {name: make for name, make in chains.items() if air == "paper" or name != "reference"}
            for sides, found in compare_lake(lake, known, limit_db).items():
                rows.append([grid, variant, air, sides, *found.cells()])
                right &= found.over_limit == 0
                print(f"{grid}, {variant}, {air}, {sides}: {found.over_limit} over", file=sys.stderr, flush=True)
    header = ["grid", "division", "air", "compared", "measurements", f"over {limit_db} dB", *DIFFERENCE_COLUMNS]
    if rows:
        print_table("Greatest differences, dB", header, rows)
    return right


def band_levels(lake: MeasuredLake, surface: str, prefix: str) -> dict[int, Signal]:
    """Levels of a surface by pair, dB: the bands, and the total with the prefix `tnce`."""
    columns = [f"{prefix}_{name}" for name in lake.settings.band_names()]
    columns += ["tnce_total"] if prefix == "tnce" else []
    rows = lake.rows("tnce", surface, columns)
    with np.errstate(divide="ignore"):
        return {pair: 10 * np.log10([row[column] for column in columns]) for pair, row in rows.items()}


def print_variants(program: str, folder: pathlib.Path, grid: str) -> None:
    """Prints how far tapered and floored levels are from literal ones, from the tables alone."""
    lakes = {
        variant: demo_lake(program, folder, grid, variant, "paper" if variant == "literal" else "complete")
        for variant in VARIANTS
    }
    literal = lakes["literal"]
    rows = []
    for variant in ("tapered", "floored"):
        for prefix, over in OVER.items():
            off = surface_changes(lakes[variant], literal, prefix)
            figures = {
                "mean": off.mean(axis=0),
                "standard deviation": off.std(axis=0),
                "greatest": greatest(off),
            }
            rows += [[variant, over, of, *signed(values)] for of, values in figures.items()]
        changes = greatest(table_changes(lakes[variant], literal))
        rows.append([variant, "over Flat's total", "greatest, mean up to P90 of a surface", *signed(changes)])
    print_table(f"Levels less those of literal division, {grid} grid, dB", level_header(literal, "division"), rows)


def surface_changes(lake: MeasuredLake, other: MeasuredLake, prefix: str) -> Signal:
    """Changes of all measurements but those of the references that are constant."""
    constant = {"foam"} if prefix == "tnce" else {"foam", "flat"}
    surfaces = [surface for surface in lake.surfaces() if surface not in constant]
    return np.concatenate([level_changes(lake, other, surface, prefix) for surface in surfaces])


def level_changes(lake: MeasuredLake, other: MeasuredLake, surface: str, prefix: str) -> Signal:
    here, there = band_levels(lake, surface, prefix), band_levels(other, surface, prefix)
    return np.array([here[pair] - there[pair] for pair in sorted(here.keys() & there.keys())])


def table_changes(lake: MeasuredLake, other: MeasuredLake) -> Signal:
    """Changes of the paper's table, a row for each surface."""
    here, there = lake.levels(), other.levels()
    bands = [*lake.settings.band_names(), "total"]
    return np.array([[here[surface][band] - there[surface][band] for band in bands] for surface in sorted(here)])


def check_lengths(program: str, folder: pathlib.Path) -> bool:
    """Compares lakes of one panel that differ in the sweep's length, and those that differ in the seeds alone."""
    lakes = {(secs, seeds): panel_lake(program, folder, secs, seeds) for seeds in LENGTH_SEEDS for secs in LENGTH_SECS}
    first_secs, no_seeds, own_seeds, other_seeds = LENGTH_SECS[0], *LENGTH_SEEDS
    lengths = [((secs, seeds), (first_secs, seeds)) for seeds in LENGTH_SEEDS for secs in LENGTH_SECS[1:]]
    repeats = [((secs, other_seeds), (secs, own_seeds)) for secs in LENGTH_SECS]
    rows, right = [], True
    for kind, couples in (("length", lengths), ("seeds", repeats)):
        for here, there in couples:
            named = [f"{secs} s, {seeds}" for secs, seeds in (here, there)]
            changes = {
                "mean up to P90 of a surface": table_changes(lakes[here], lakes[there]),
                **{
                    over: level_changes(lakes[here], lakes[there], LENGTH_PANEL, prefix)
                    for prefix, over in OVER.items()
                },
            }
            # The tables must be equal; single measurements have noise.
            checked = list(changes.values())[: 3 if here[1] == no_seeds else 1]
            right &= kind == "seeds" or all(np.abs(off).max() <= LENGTH_LIMIT_DB for off in checked)
            rows += [[kind, *named, of, *signed(greatest(off), 4)] for of, off in changes.items()]
    header = level_header(lakes[first_secs, no_seeds], "what differs")
    print_table("Greatest changes of tapered levels, dB", [header[0], "here", "there", *header[2:]], rows)
    return right


def level_header(lake: MeasuredLake, first: str) -> list[str]:
    return [first, "levels", "of", *(f"{name} Hz" for name in lake.settings.band_names()), "total"]


def greatest(changes: Signal) -> Signal:
    """The change of each column that is farthest from zero."""
    return np.array(changes[np.abs(changes).argmax(axis=0), range(changes.shape[1])])


def signed(values: Iterable[float], digits: int = 2) -> list[str]:
    """Cells of a row; there is no total over Flat's same band."""
    cells = [f"{value:+.{digits}f}" for value in values]
    return cells + [""] * (LEVEL_COLUMNS - len(cells))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", required=True, type=lambda path: str(pathlib.Path(path).absolute()))
    parser.add_argument("--folder", type=pathlib.Path)
    parser.add_argument("--limit", type=float, default=0.001)
    parser.add_argument("--grids", nargs="+", choices=[*GRIDS, "none"], default=list(GRIDS))
    parser.add_argument("--reference", type=pathlib.Path)
    parser.add_argument("--variants", action="store_true")
    parser.add_argument("--lengths", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        return run_checks(options, options.folder or pathlib.Path(place))


def run_checks(options: argparse.Namespace, folder: pathlib.Path) -> int:
    chains: Chains = {"chain": IndependentChain}
    if options.reference:
        pipeline = load_pipeline(options.reference)
        chains["reference"] = lambda settings: ReferenceChain(settings, pipeline)
    grids = [grid for grid in options.grids if grid != "none"]
    right = check_agreement(options.program, folder, grids, chains, options.limit)
    if options.variants:
        for grid in ("paper", "small-half-second"):
            print_variants(options.program, folder, grid)
    if options.lengths:
        right &= check_lengths(options.program, folder)
    return 0 if right else 1


def load_pipeline(folder: pathlib.Path) -> Any:
    spec = importlib.util.spec_from_file_location("pipeline", folder / "pipeline.py")
    if spec is None or spec.loader is None:
        raise RuntimeError(f"{folder} has no pipeline.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    sys.exit(main())
