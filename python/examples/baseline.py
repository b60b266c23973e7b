"""A baseline: the level of every measured pair over a new relief, from the relief's height map and both positions.

    bands=tnce_band_2500,tnce_band_5000,tnce_band_10000,tnce_band_20000,tnce_band_40000
    echolake export ml -o reliefs --columns $bands
    python examples/baseline.py reliefs --predict predictions.parquet

A level is the reflected energy over Flat's energy of the same band (column ``tnce_band_*``) in dB. A Kirchhoff integral
over the height map, with a wide and two narrower beams of the speaker, gives a first guess; a small network corrects it
by all three and the positions. Rows of the table are root mean square errors on held-out panels, which are those of
splits validation and test: of the mean over split train, of the mean of each pair, of ridge regression on the network's
inputs, of the integral alone, and of the network.

Training is deterministic: a run that was killed continues from its checkpoint and ends with the same weights.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor, nn

from echolake.torch import Batch, MeasurementRows, Measurements

FLOOR_DB = -40.0
"""Levels below count as this: that of nothing is minus infinity."""
LEAST_RELIEFS = 20
"""From fewer nothing can be learned that holds for another relief."""
SPEED_MM_S = 343e3
BEAMS_HZ = (0.0, 20e3, 40e3)
"""Frequencies of the speaker's beams: at 0 Hz it radiates evenly."""
TWEETER_RADIUS_MM = 10.0
BLOCK = 8
"""Rows to integrate at once, few enough for the processor's cache."""
RIDGE_WEIGHT = 1e-4
SIMULATION_ERRORS_DB = {
    "simulation, rubble": [0.16, 0.40, 1.31, 1.38, 1.60],
    "simulation, wells": [2.43, 1.06, 1.17, 1.59, 2.14],
}
"""At 2.5, 5, 10, 20 and 40 kHz, of the simulated rig against boundary elements: docs/devices.md, rms of a pair, rows
`rubble, joints 5-8 mm` and `wells 45 mm`, `steep_facets = true`."""
SIMULATED_BANDS = [2500, 5000, 10000, 20000, 40000]
LEARNING_RATE = 3e-3
CHECKPOINT_STEPS = 50


def integrate_relief(heights: Tensor, size_mm: float, microphone: Tensor, speaker: Tensor, bands: list[int]) -> Tensor:
    """Levels ``[rows, beams, bands]`` in dB, but for a constant, of reflections at maps ``[rows, cells, cells]``."""
    cells = heights.shape[-1]
    axis = (torch.arange(cells) + 0.5) * (size_mm / cells) - size_mm / 2
    slope_y, slope_x = torch.gradient(heights, spacing=size_mm / cells, dim=(1, 2))

    def view_facets(place: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        x = (place[:, 0, None] - axis)[:, None, :]
        y = (place[:, 1, None] - axis)[:, :, None]
        z = place[:, 2, None, None] - heights
        distance = (x.square() + y.square() + z.square()).sqrt()
        return distance, (z - slope_x * x - slope_y * y) / distance, x, y, z

    from_microphone, microphone_cosine, *_ = view_facets(microphone)
    from_speaker, speaker_cosine, x, y, z = view_facets(speaker)
    weights = (microphone_cosine + speaker_cosine) / (from_microphone * from_speaker)
    # The speaker aims at the point where a flat panel mirrors it to the microphone.
    aim = nn.functional.normalize(torch.cat([find_mirror(microphone, speaker) - speaker[:, :2], -speaker[:, 2:]], 1))
    along = (aim[:, 0, None, None] * x + aim[:, 1, None, None] * y + aim[:, 2, None, None] * z) / from_speaker
    # Arrivals at a rate at which the highest band is smooth, and the energies of octaves of their spectrum.
    rate_hz = 8.0 * max(bands)
    samples = 1 << int(4 * size_mm * rate_hz / SPEED_MM_S).bit_length()
    arrivals = ((from_microphone + from_speaker) * (rate_hz / SPEED_MM_S)).long().clamp_(max=samples - 1).flatten(1)
    frequencies = torch.arange(samples // 2 + 1) * (rate_hz / samples)
    octaves = torch.stack([((frequencies - band).abs() < 0.35 * band) * frequencies.square() for band in bands], 1)
    levels = []
    for beam_hz in BEAMS_HZ:
        # A piston's gain up to its first null is about a Gaussian.
        exponent = (2 * math.pi * beam_hz / SPEED_MM_S * TWEETER_RADIUS_MM) ** 2 / 8
        beam = (weights * torch.exp(exponent * (along.square() - 1))).flatten(1)
        pulse = torch.zeros(len(heights), samples).scatter_add_(1, arrivals, beam)
        energies = torch.view_as_real(torch.fft.rfft(pulse)).square().sum(2) @ octaves
        levels.append(10 * torch.log10(energies + 1e-30))
    return torch.stack(levels, 1)


def find_mirror(microphone: Tensor, speaker: Tensor) -> Tensor:
    """x and y of the point where a flat panel mirrors the speaker to the microphone."""
    share = (microphone[:, 2] / (microphone[:, 2] + speaker[:, 2]))[:, None]
    return microphone[:, :2] + share * (speaker - microphone)[:, :2]


class LevelModel(nn.Module):
    """Levels of pairs over a relief, in dB against those of the pairs over Flat."""

    flat: Tensor

    def __init__(self, bands: list[int], cells: int, size_mm: float, microphone: Tensor, speaker: Tensor) -> None:
        """For maps of ``cells`` by ``cells``; the positions of all pairs are ``[pairs, 3]``."""
        super().__init__()
        self.bands, self.size_mm = bands, size_mm
        # Each band by the beam that is nearest to it.
        self.beam = [min(range(len(BEAMS_HZ)), key=lambda beam: abs(BEAMS_HZ[beam] - band)) for band in bands]
        self.inputs, width = len(BEAMS_HZ) * len(bands) + 9, 96
        layers = [nn.Linear(self.inputs, width), nn.GELU(), nn.Linear(width, width), nn.GELU()]
        self.network = nn.Sequential(*layers, nn.Linear(width, len(bands)))
        first = torch.zeros(len(microphone), dtype=torch.long)
        self.flat = self.integrate_pairs(torch.zeros(1, cells, cells), first, microphone, speaker)

    def integrate_pairs(self, maps: Tensor, of_row: Tensor, microphone: Tensor, speaker: Tensor) -> Tensor:
        blocks = zip(of_row.split(BLOCK), microphone.split(BLOCK), speaker.split(BLOCK), strict=True)
        return torch.cat([integrate_relief(maps[m], self.size_mm, a, b, self.bands) for m, a, b in blocks])

    def describe_rows(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """The integral's levels by band, and the network's inputs."""
        microphone, speaker = batch["microphone_mm"], batch["speaker_mm"]
        integral = self.integrate_pairs(batch["heights"], batch["surface"], microphone, speaker)
        integral = integral - self.flat[batch["pair_id"].long()]
        between = (microphone - speaker).norm(dim=1, keepdim=True)
        geometry = torch.cat([microphone, speaker, find_mirror(microphone, speaker), between], 1)
        return integral[:, self.beam, range(len(self.bands))], torch.cat([integral.flatten(1) / 10, geometry / 200], 1)

    def forward(self, batch: Batch) -> Tensor:
        integral, inputs = self.describe_rows(batch)
        corrected: Tensor = integral + self.network(inputs)
        return corrected


def read_levels(batch: Batch, bands: list[int]) -> Tensor:
    """Measured levels ``[rows, bands]`` in dB."""
    energies = torch.stack([batch[f"tnce_band_{band}"] for band in bands], 1)
    return (10 * torch.log10(energies.clamp(min=1e-30))).clamp(min=FLOOR_DB)


def open_split(folder: str, split: Any, bands: list[int], **settings: Any) -> Measurements:
    """Batches of a split: pairs, positions and energies."""
    columns = ["pair_id", "microphone_mm", "speaker_mm", *(f"tnce_band_{band}" for band in bands)]
    return Measurements(folder, split, columns, rank=0, world_size=1, **settings)


class PairMeans:
    """Mean levels over split train, of all rows and of each pair, and the positions of the pairs."""

    def __init__(self, folder: str, bands: list[int]) -> None:
        train = open_split(folder, "train", bands, shuffle=False)
        rows = [(b["pair_id"].long(), b["microphone_mm"], b["speaker_mm"], read_levels(b, bands)) for b in train]
        pair, microphone, speaker, levels = (torch.cat(column) for column in zip(*rows, strict=True))
        self.mean = levels.mean(0)
        counts = torch.bincount(pair)[:, None]
        sums = torch.zeros(len(counts), len(bands)).index_add_(0, pair, levels)
        self.of_pair = torch.where(counts > 0, sums / counts, self.mean)
        self.microphone, self.speaker = torch.ones(2, len(counts), 3)
        self.microphone[pair], self.speaker[pair] = microphone, speaker


class RidgeRegression:
    """Levels as a linear function of inputs and their products, from the rows that the network learns from."""

    def __init__(self, inputs: int, bands: int) -> None:
        self.upper = torch.triu_indices(inputs + 1, inputs + 1)
        self.sums = torch.zeros(self.upper.shape[1], self.upper.shape[1] + bands, dtype=torch.float64)

    def expand_inputs(self, inputs: Tensor) -> Tensor:
        """Constant, inputs and products."""
        factors = torch.cat([torch.ones(len(inputs), 1), inputs], 1).double()
        return factors[:, self.upper[0]] * factors[:, self.upper[1]]

    def add_rows(self, inputs: Tensor, levels: Tensor) -> None:
        """Takes rows into account."""
        expanded = self.expand_inputs(inputs)
        self.sums += expanded.T @ torch.cat([expanded, levels.double()], 1)

    def solve_weights(self) -> Tensor:
        """The weights of the expanded inputs."""
        squares, products = self.sums[:, : len(self.sums)], self.sums[:, len(self.sums) :]
        return torch.linalg.solve(squares + RIDGE_WEIGHT * torch.diag(squares.diagonal() + 1e-9), products)


def train_model(model: LevelModel, ridge: RidgeRegression, arguments: argparse.Namespace) -> dict[str, Any]:
    """Trains from the start or from the checkpoint; returns what the checkpoint says of the training set."""
    order = {"batch_size": arguments.batch_size, "clump": 16, "seed": arguments.seed}
    train = open_split(arguments.folder, "train", model.bands, heights=True, **order)
    trained_on = {"folder": arguments.folder, "digest": train.source.digest, "bands": model.bands}
    trained_on |= {"lake_version": read_version(arguments.folder), "steps": arguments.steps}
    optimizer = torch.optim.AdamW(model.parameters())
    step = 0
    if arguments.checkpoint.exists():
        saved = torch.load(arguments.checkpoint, weights_only=True)
        if saved["trained_on"] != trained_on:
            raise ValueError(f"`{arguments.checkpoint}` is of {saved['trained_on']}, expected {trained_on}")
        train.load_state_dict(saved["data"])
        model.load_state_dict(saved["model"])
        optimizer.load_state_dict(saved["optimizer"])
        ridge.sums, step = saved["ridge"], saved["step"]
        print(f"continues {arguments.checkpoint} at step {step}", file=sys.stderr)
    while step < arguments.steps:
        for batch in train:
            integral, inputs = model.describe_rows(batch)
            levels = read_levels(batch, model.bands)
            ridge.add_rows(inputs, levels)
            loss = nn.functional.mse_loss(integral + model.network(inputs), levels)
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * (0.5 + 0.5 * math.cos(math.pi * step / arguments.steps))
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            step += 1
            show_progress(f"step {step} of {arguments.steps}, error {loss.item() ** 0.5:.2f} dB")
            if step % CHECKPOINT_STEPS == 0 or step == arguments.steps:
                state = {"model": model.state_dict(), "optimizer": optimizer.state_dict(), "ridge": ridge.sums}
                state |= {"data": train.state_dict(after=batch), "step": step, "trained_on": trained_on}
                save_checkpoint(arguments.checkpoint, state)
            if step == arguments.steps:
                break
        train.set_epoch(train.epoch + 1)
    return trained_on


# Renamed when it is whole: a run that is killed leaves the last checkpoint or this one.
def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    partial = path.with_name(path.name + ".partial")
    torch.save(state, partial)
    os.replace(partial, path)


def read_version(folder: str) -> int:
    """The version of the lake that the set was made from."""
    croissant = json.loads((Path(folder) / "croissant.json").read_text())
    return int(croissant["version"].split(".")[1])


class HeldOutRows:
    """Errors and predictions on splits validation and test."""

    def __init__(
        self, model: LevelModel, means: PairMeans, ridge: RidgeRegression, folder: str, splits: list[str]
    ) -> None:
        weights = ridge.solve_weights()
        squares: dict[str, list[Tensor]] = {}
        self.surface_ids: list[str] = []
        pairs, levels = [], []
        with torch.no_grad():
            for split in splits:
                batches = open_split(folder, split, model.bands, heights=True)
                for batch in batches:
                    measured, pair = read_levels(batch, model.bands), batch["pair_id"].long()
                    integral, inputs = model.describe_rows(batch)
                    predicted = {
                        "mean": means.mean.expand_as(measured),
                        "pair mean": means.of_pair[pair],
                        "ridge": (ridge.expand_inputs(inputs) @ weights).float(),
                        "integral": integral,
                        "network": integral + model.network(inputs),
                    }
                    for name, level in predicted.items():
                        squares.setdefault(name, []).append((level - measured).square())
                    self.surface_ids += [batch["surface_ids"][place] for place in batch["surface"]]
                    pairs.append(pair)
                    levels.append(predicted["network"])
                    show_progress(f"{split}: batch {batch['batch'] + 1} of {len(batches)}")
        self.errors_db = {name: torch.cat(of).mean(0).sqrt().tolist() for name, of in squares.items()}
        self.pairs, self.levels = torch.cat(pairs), torch.cat(levels)


def write_predictions(path: Path, rows: HeldOutRows, bands: list[int], trained_on: dict[str, Any], digest: str) -> None:
    """Writes predicted energies over Flat's of the same band, in columns as those of table `tnce`."""
    columns: dict[str, Any] = {"surface_id": rows.surface_ids, "pair_id": pa.array(rows.pairs.numpy(), pa.int32())}
    for number, band in enumerate(bands):
        columns[f"tnce_band_{band}"] = (10 ** (rows.levels[:, number].double() / 10)).numpy()
    about = {"model": "baseline", "weights_sha256": digest, "trained_on": json.dumps(trained_on)}
    pq.write_table(pa.table(columns).replace_schema_metadata(about), path)
    # A served lake takes this file as predictions of a model.


def format_report(report: dict[str, Any]) -> str:
    """The report as text."""
    lines = [
        f"Error, dB rms, of levels over Flat's same band (tnce_band_*): {report['held_out_rows']} rows of "
        f"{report['held_out_panels']} held-out panels, {report['train_panels']} panels trained on",
        "",
        f"{'':22}" + "".join(f"{band:>8}" for band in report["bands_hz"]),
    ]
    errors = report["rms_error_db"] | report.get("simulation_rms_error_db", {})
    lines += [f"{name:22}" + "".join(f"{error:8.2f}" for error in of_band) for name, of_band in errors.items()]
    lines += ["", f"Origin of the data: {', '.join(report['origins'])}."]
    if "simulated" in report["origins"]:
        lines += [
            "They are simulated, by a Kirchhoff integral, too. Errors against measurements would be larger: the",
            "simulation itself is off by its rows above, rms of a pair, from boundary elements (docs/devices.md).",
        ]
    return "\n".join([*lines, f"Weights: {report['weights_sha256']}"])


def digest_weights(model: LevelModel) -> str:
    """SHA-256 of the network's weights."""
    weights = [value.numpy().tobytes() for value in model.state_dict().values()]
    return hashlib.sha256(b"".join(weights)).hexdigest()


def show_progress(text: str) -> None:
    """Overwrites a line of a terminal."""
    if sys.stderr.isatty():
        print(f"\r{text}\033[K", end="", file=sys.stderr, flush=True)


def main() -> None:
    """Trains, predicts and reports."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", help="a training set of `echolake export ml`")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--checkpoint", type=Path, default=Path("baseline.pt"), help="written often, and continued")
    parser.add_argument("--predict", type=Path, metavar="PARQUET", help="writes predictions for the held-out panels")
    parser.add_argument("--few", action="store_true", help=f"learns from fewer than {LEAST_RELIEFS} reliefs, too")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    torch.use_deterministic_algorithms(True)
    # Sums over threads depend on their number.
    torch.set_num_threads(2)
    torch.manual_seed(arguments.seed)
    with open(Path(arguments.folder) / "surfaces.csv", newline="") as file:
        surfaces = list(csv.DictReader(file))
    reliefs = {row["surface_id"] for row in surfaces if row["split"] == "train" and row["typology"] != "reference"}
    if any(row["typology"] == "reference" for row in surfaces):
        parser.error(f"`{arguments.folder}` has references; hint: export without --references")
    if len(reliefs) < LEAST_RELIEFS and not arguments.few:
        parser.error(
            f"`{arguments.folder}`: split train has {len(reliefs)} reliefs, expected at least {LEAST_RELIEFS}, because "
            "errors on other reliefs would mean nothing; hint: a lake of `echolake demo --surfaces 131`, or --few"
        )
    names = MeasurementRows(arguments.folder).columns
    bands = sorted(int(name.removeprefix("tnce_band_")) for name in names if name.removeprefix("tnce_band_").isdigit())
    if not bands:
        parser.error(f"`{arguments.folder}` has no columns tnce_band_*; hint: export --columns tnce_band_2500,...")
    means = PairMeans(arguments.folder, bands)
    first = next(iter(open_split(arguments.folder, "train", bands, heights=True, batch_size=1)))
    model = LevelModel(bands, first["heights"].shape[-1], float(first["size_mm"][0]), means.microphone, means.speaker)
    ridge = RidgeRegression(model.inputs, len(bands))
    trained_on = train_model(model, ridge, arguments)
    held_out = [row for row in surfaces if row["split"] != "train"]
    rows = HeldOutRows(model, means, ridge, arguments.folder, sorted({row["split"] for row in held_out}))
    show_progress("")
    digest = digest_weights(model)
    if arguments.predict:
        write_predictions(arguments.predict, rows, bands, trained_on, digest)
    report: dict[str, Any] = {
        "target": "tnce_band_*, energy over Flat's energy of the same band, dB",
        "origins": sorted({row["origin"] for row in surfaces}),
        "train_panels": len({row["group"] for row in surfaces if row["split"] == "train"}),
        "held_out_panels": len({row["group"] for row in held_out}),
        "held_out_rows": len(rows.pairs),
        "bands_hz": bands,
        "rms_error_db": rows.errors_db,
        "weights_sha256": digest,
        "trained_on": trained_on,
    }
    if "simulated" in report["origins"] and bands == SIMULATED_BANDS:
        report["simulation_rms_error_db"] = SIMULATION_ERRORS_DB
    print(json.dumps(report, indent=2) if arguments.json else format_report(report))


if __name__ == "__main__":
    main()
