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
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from echolake.contributions import ContributionClient
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
WORKERS = 2
LEARNING_RATE = 3e-3
RIDGE_WEIGHT = 1e-4
CHECKPOINT_STEPS = 50
SIMULATED_BANDS = [2500, 5000, 10000, 20000, 40000]
SIMULATION_ERRORS_DB = {
    "simulation, rubble": [0.16, 0.40, 1.31, 1.38, 1.60],
    "simulation, wells": [2.43, 1.06, 1.17, 1.59, 2.14],
}
"""Of the simulated rig against boundary elements: docs/devices.md, rms of a pair, rows `rubble, joints 5-8 mm` and
`wells 45 mm`, `steep_facets = true`."""


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


def open_split(folder: str, split: Any, bands: list[int], **settings: Any) -> Measurements:
    """Batches of a split: pairs, positions and energies."""
    columns = ["pair_id", "microphone_mm", "speaker_mm", *(f"tnce_band_{band}" for band in bands)]
    return Measurements(folder, split, columns, rank=0, world_size=1, **settings)


def read_levels(batch: Batch, bands: list[int]) -> Tensor:
    """Measured levels ``[rows, bands]`` in dB."""
    energies = torch.stack([batch[f"tnce_band_{band}"] for band in bands], 1)
    return (10 * torch.log10(energies.clamp(min=1e-30))).clamp(min=FLOOR_DB)


class ReliefInputs:
    """Adds to a batch what is computed from height maps: the integral's level by band, and the network's inputs."""

    def __init__(self, folder: str, bands: list[int], means: PairMeans) -> None:
        first = next(iter(open_split(folder, "train", bands, heights=True, batch_size=1)))
        self.bands, self.size_mm = bands, float(first["size_mm"][0])
        # Each band by the beam that is nearest to it.
        self.beam = [min(range(len(BEAMS_HZ)), key=lambda beam: abs(BEAMS_HZ[beam] - band)) for band in bands]
        self.inputs = len(BEAMS_HZ) * len(bands) + 9
        flat = torch.zeros_like(first["heights"])
        of_row = torch.zeros(len(means.microphone), dtype=torch.long)
        self.flat = self.integrate_rows(flat, of_row, means.microphone, means.speaker)

    def __call__(self, batch: Batch) -> Batch:
        microphone, speaker = batch["microphone_mm"], batch["speaker_mm"]
        levels = self.integrate_rows(batch.pop("heights"), batch["surface"], microphone, speaker)
        levels = levels - self.flat[batch["pair_id"].long()]
        between = (microphone - speaker).norm(dim=1, keepdim=True)
        positions = torch.cat([microphone, speaker, find_mirror(microphone, speaker), between], 1)
        batch["integral"] = levels[:, self.beam, range(len(self.bands))]
        batch["inputs"] = torch.cat([levels.flatten(1) / 10, positions / 200], 1)
        return batch

    def integrate_rows(self, maps: Tensor, of_row: Tensor, microphone: Tensor, speaker: Tensor) -> Tensor:
        """Levels of rows ``[rows, beams, bands]``."""
        blocks = zip(of_row.split(BLOCK), microphone.split(BLOCK), speaker.split(BLOCK), strict=True)
        return torch.cat([integrate_relief(maps[of], self.size_mm, m, s, self.bands) for of, m, s in blocks])


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
    aim = nn.functional.normalize(torch.cat([find_mirror(microphone, speaker) - speaker[:, :2], -speaker[:, 2:]], 1))
    along = (aim[:, 0, None, None] * x + aim[:, 1, None, None] * y + aim[:, 2, None, None] * z) / from_speaker
    # Arrivals at a rate at which the highest band is smooth, and energies of octaves of their spectrum.
    rate_hz = 8.0 * max(bands)
    samples = 1 << int(4 * size_mm * rate_hz / SPEED_MM_S).bit_length()
    arrivals = ((from_microphone + from_speaker) * (rate_hz / SPEED_MM_S)).long().clamp_(max=samples - 1).flatten(1)
    frequencies = torch.arange(samples // 2 + 1) * (rate_hz / samples)
    octaves = torch.stack([((frequencies - band).abs() < 0.35 * band) * frequencies.square() for band in bands], 1)
    levels = []
    for beam_hz in BEAMS_HZ:
        # A piston's gain up to its first null is about a Gaussian.
        exponent = (2 * math.pi * beam_hz / SPEED_MM_S * TWEETER_RADIUS_MM) ** 2 / 8
        beam = weights * torch.exp(exponent * (along.square() - 1)) if beam_hz > 0 else weights
        pulse = torch.zeros(len(heights), samples).scatter_add_(1, arrivals, beam.flatten(1))
        energies = torch.view_as_real(torch.fft.rfft(pulse)).square().sum(2) @ octaves
        levels.append(10 * torch.log10(energies + 1e-30))
    return torch.stack(levels, 1)


def find_mirror(microphone: Tensor, speaker: Tensor) -> Tensor:
    """x and y of the point where a flat panel mirrors the speaker, which aims at it, to the microphone."""
    share = (microphone[:, 2] / (microphone[:, 2] + speaker[:, 2]))[:, None]
    return microphone[:, :2] + share * (speaker - microphone)[:, :2]


class RidgeRegression:
    """Levels as a linear function of inputs, from the rows that the network learns from."""

    def __init__(self, inputs: int, bands: int) -> None:
        self.sums = torch.zeros(inputs + 1, inputs + 1 + bands, dtype=torch.float64)

    def add_rows(self, inputs: Tensor, levels: Tensor) -> None:
        """Takes rows into account."""
        factors = self.add_constant(inputs)
        self.sums += factors.T @ torch.cat([factors, levels.double()], 1)

    def add_constant(self, inputs: Tensor) -> Tensor:
        """Inputs and a column of ones."""
        return torch.cat([inputs, torch.ones(len(inputs), 1)], 1).double()

    def solve_weights(self) -> Tensor:
        """The weights ``[inputs + 1, bands]``."""
        squares, products = self.sums[:, : len(self.sums)], self.sums[:, len(self.sums) :]
        return torch.linalg.solve(squares + RIDGE_WEIGHT * torch.diag(squares.diagonal() + 1e-9), products)


def make_network(inputs: int, bands: int) -> nn.Sequential:
    """The network that corrects the integral."""
    width = 96
    hidden = [nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width), nn.GELU()]
    # Normalises inputs by their mean and deviation over all batches of training.
    return nn.Sequential(nn.BatchNorm1d(inputs, momentum=None, affine=False), *hidden, nn.Linear(width, bands))


def train_network(
    network: nn.Module, ridge: RidgeRegression, describe: ReliefInputs, arguments: argparse.Namespace
) -> dict[str, Any]:
    """Trains from the start or from the checkpoint; returns what the checkpoint says of the training."""
    order = {"batch_size": arguments.batch_size, "clump": 16, "seed": arguments.seed}
    train = open_split(arguments.folder, "train", describe.bands, heights=True, **order)
    croissant = json.loads((Path(arguments.folder) / "croissant.json").read_text())
    trained_on = {"folder": arguments.folder, "set": train.source.digest, "bands_hz": describe.bands}
    # Its version is 1.N.0 for runs@N of the lake.
    trained_on |= {"lake_version": int(croissant["version"].split(".")[1]), "steps": arguments.steps}
    optimizer = torch.optim.AdamW(network.parameters())
    step = 0
    if arguments.checkpoint.exists():
        saved = torch.load(arguments.checkpoint, weights_only=True)
        if saved["trained_on"] != trained_on:
            sys.exit(f"error: `{arguments.checkpoint}` is of {saved['trained_on']}, expected {trained_on}")
        train.load_state_dict(saved["data"])
        network.load_state_dict(saved["network"])
        optimizer.load_state_dict(saved["optimizer"])
        ridge.sums, step = saved["ridge"], saved["step"]
        print(f"continues {arguments.checkpoint} at step {step}", file=sys.stderr)
    while step < arguments.steps:
        for batch in DataLoader(train, batch_size=None, num_workers=WORKERS, collate_fn=describe):
            levels = read_levels(batch, describe.bands)
            ridge.add_rows(batch["inputs"], levels)
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * (0.5 + 0.5 * math.cos(math.pi * step / arguments.steps))
            loss = nn.functional.mse_loss(batch["integral"] + network(batch["inputs"]), levels)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            step += 1
            if step % CHECKPOINT_STEPS == 0 or step == arguments.steps:
                state = {"network": network.state_dict(), "optimizer": optimizer.state_dict(), "ridge": ridge.sums}
                state |= {"data": train.state_dict(after=batch), "step": step, "trained_on": trained_on}
                save_checkpoint(arguments.checkpoint, state)
                print(f"step {step} of {arguments.steps}, error {loss.item() ** 0.5:.2f} dB", file=sys.stderr)
            if step == arguments.steps:
                break
        train.set_epoch(train.epoch + 1)
    return trained_on


# Renamed when it is whole: a run that is killed leaves the last checkpoint or this one.
def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    partial = path.with_name(path.name + ".partial")
    torch.save(state, partial)
    os.replace(partial, path)


Predictor = Callable[[Batch], Tensor]


def compare_predictors(
    predictors: dict[str, Predictor], splits: list[str], folder: str, describe: ReliefInputs
) -> tuple[dict[str, list[float]], pa.Table]:
    """Errors of each predictor by band, and what the last one predicts, in columns as those of table ``tnce``."""
    squares: dict[str, list[Tensor]] = {name: [] for name in predictors}
    names: list[str] = []
    rows = []
    for split in splits:
        data = open_split(folder, split, describe.bands, heights=True)
        for batch in DataLoader(data, batch_size=None, num_workers=WORKERS, collate_fn=describe):
            measured = read_levels(batch, describe.bands)
            for name, predict in predictors.items():
                predicted = predict(batch)
                squares[name].append((predicted - measured).square())
            names += [batch["surface_ids"][place] for place in batch["surface"]]
            rows.append((batch["pair_id"].clone(), 10 ** (predicted.double() / 10)))
    pairs, energies = (torch.cat(column).numpy() for column in zip(*rows, strict=True))
    columns = {f"tnce_band_{band}": energies[:, number] for number, band in enumerate(describe.bands)}
    errors = {name: torch.cat(of_rows).mean(0).sqrt().tolist() for name, of_rows in squares.items()}
    return errors, pa.table({"surface_id": names, "pair_id": pairs} | columns)


def digest_weights(network: nn.Module) -> str:
    """SHA-256 of the network's weights."""
    weights = [value.numpy().tobytes() for value in network.state_dict().values()]
    return hashlib.sha256(b"".join(weights)).hexdigest()


def format_report(report: dict[str, Any]) -> str:
    """The report as text."""
    errors = report["rms_error_db"] | report["simulation_rms_error_db"]
    lines = [
        f"Error, dB rms, of levels over Flat's same band (tnce_band_*) on {report['held_out_rows']} rows of "
        f"{report['held_out_panels']} held-out panels;",
        f"{report['train_panels']} panels trained on. Origin of the data: {', '.join(report['origins'])}.",
        "",
        f"{'Hz':20}" + "".join(f"{band:>8}" for band in report["bands_hz"]),
        *(f"{name:20}" + "".join(f"{error:8.2f}" for error in of_band) for name, of_band in errors.items()),
        "",
    ]
    if "simulated" in report["origins"]:
        lines.append("Simulated data come from a Kirchhoff integral, too: beside measurements errors would be larger.")
    if report["simulation_rms_error_db"]:
        lines.append("Rows `simulation` are its own errors beside boundary elements, rms of a pair: docs/devices.md.")
    return "\n".join([*lines, f"Weights: {report['weights_sha256']}"])


def main() -> None:
    """Trains, predicts and reports."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", help="a training set of `echolake export ml --columns tnce_band_2500,...`")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--batch-size", type=int, default=256)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--checkpoint", type=Path, default=Path("baseline.pt"), help="written often, and continued")
    parser.add_argument("--predict", type=Path, metavar="PARQUET", help="writes predictions for the held-out panels")
    parser.add_argument("--send", metavar="URL", help="stores these in the lake that is served there")
    parser.add_argument("--few", action="store_true", help=f"learns from fewer than {LEAST_RELIEFS} reliefs, too")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    with open(Path(arguments.folder) / "surfaces.csv", newline="") as file:
        surfaces = list(csv.DictReader(file))
    if any(row["typology"] == "reference" for row in surfaces):
        parser.error(f"`{arguments.folder}` has references; hint: export without --references")
    train = [row for row in surfaces if row["split"] == "train"]
    held_out = [row for row in surfaces if row["split"] != "train"]
    if len(train) < LEAST_RELIEFS and not arguments.few:
        parser.error(
            f"`{arguments.folder}`: split train has {len(train)} reliefs, expected at least {LEAST_RELIEFS}, because "
            "errors on other reliefs would mean nothing; hint: a lake of `echolake demo --surfaces 131`, or --few"
        )
    names = [name.removeprefix("tnce_band_") for name in MeasurementRows(arguments.folder).columns]
    bands = sorted(int(name) for name in names if name.isdigit())
    if not bands:
        parser.error(f"`{arguments.folder}` has no columns tnce_band_*; hint: export --columns tnce_band_2500,...")

    torch.use_deterministic_algorithms(True)
    # Sums over threads depend on their number; workers integrate side by side.
    torch.set_num_threads(1)
    torch.manual_seed(arguments.seed)
    means = PairMeans(arguments.folder, bands)
    describe = ReliefInputs(arguments.folder, bands, means)
    network, ridge = make_network(describe.inputs, len(bands)), RidgeRegression(describe.inputs, len(bands))
    trained_on = train_network(network, ridge, describe, arguments)
    network.eval()
    weights = ridge.solve_weights()
    predictors: dict[str, Predictor] = {
        "mean": lambda batch: means.mean.expand(len(batch["pair_id"]), -1),
        "pair mean": lambda batch: means.of_pair[batch["pair_id"].long()],
        "ridge": lambda batch: (ridge.add_constant(batch["inputs"]) @ weights).float(),
        "integral": lambda batch: batch["integral"],
        "network": lambda batch: batch["integral"] + network(batch["inputs"]),
    }
    with torch.no_grad():
        errors, predicted = compare_predictors(
            predictors, sorted({row["split"] for row in held_out}), arguments.folder, describe
        )
    origins = sorted({row["origin"] for row in surfaces})
    report: dict[str, Any] = {
        "origins": origins,
        "train_panels": len({row["group"] for row in train}),
        "held_out_panels": len({row["group"] for row in held_out}),
        "held_out_rows": predicted.num_rows,
        "bands_hz": bands,
        "rms_error_db": errors,
        "simulation_rms_error_db": SIMULATION_ERRORS_DB
        if origins == ["simulated"] and bands == SIMULATED_BANDS
        else {},
        "weights_sha256": digest_weights(network),
        "trained_on": trained_on,
    }
    version = report["weights_sha256"][:16]
    if arguments.predict:
        about = {"model": "baseline", "version": version, "trained_on": json.dumps(trained_on)}
        pq.write_table(predicted.replace_schema_metadata(about), arguments.predict)
    if arguments.send:
        client = ContributionClient(arguments.send, os.environ.get("ECHOLAKE_TOKEN"))
        client.predict("baseline", version, predicted)
    print(json.dumps(report, indent=2) if arguments.json else format_report(report))


if __name__ == "__main__":
    main()
