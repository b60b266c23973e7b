"""Solves reliefs by boundary elements in three dimensions: scattering and diffusion of plane waves in the far field.

A relief is the upper side of a rigid solid in free air. NumCalc, the solver of Mesh2scattering (Burton and Miller's
formulation, constant elements, multi-level fast multipole method), gives the pressure on it; the far field is the sum
over its elements. Scattering is Mommertz's correlation over the upper half space with a flat solid of the same outline;
diffusion is that of 37 receivers in the plane of incidence, 5 degrees apart, normalised by the flat solid's (ISO
17497-2). One line of JSON is printed for each case, and kept in FILE, so that a run that was stopped goes on.

    pip install mesh2scattering numpy scipy trimesh       # its solver is compiled by g++ and make
    python tests/simulation/solid_bem.py --reference FILE # a sine: 16 published values (93 minutes beside other work)
    python tests/simulation/solid_bem.py --reference FILE --write docs/materials.md
    python tests/simulation/solid_bem.py FILE             # five reliefs of 585 mm, three incidences

The reference is what the mesh in the public data of Mesh2scattering is (its example `sine`, at 1:2.5), at 1:10: a round
sample of 200 mm of a sine of 20 mm and 5.76 mm from crest to trough, on a plate of 2.5 mm, c = 346.18 m/s. Its
description calls it 17.7 mm and 5.1 mm. Five reliefs at 2.5, 5 and 10 kHz, one of them at 20 kHz.
"""

import argparse
import itertools
import json
import pathlib
import subprocess
import sys
import tempfile
import time

import mesh2scattering as m2s
import numpy as np
import pyfar as pf
import trimesh
from compare_bem import RECEIVER_ANGLES, write_table
from scipy.spatial import Delaunay

# Published scattering: zenith and azimuth of the source, deg; 4, 8, 12, 16 kHz at 1:10.
REFERENCE = {
    (0, 0): [0.005, 0.023, 0.021, 0.214],
    (30, 0): [0.007, 0.036, 0.951, 0.860],
    (60, 0): [0.015, 0.320, 0.883, 0.894],
    (60, 90): [0.005, 0.019, 0.023, 0.034],
}


def rubble(x, y):
    """Sum of 60 waves of chance directions and lengths of 30 to 120 mm, 2 mm root mean square."""
    chance = np.random.default_rng(7)
    length, turn = chance.uniform(0.03, 0.12, 60), chance.uniform(0, np.pi, 60)
    start = chance.uniform(0, 2 * np.pi, 60)
    waves = [
        np.cos(2 * np.pi / wide * (x * np.cos(a) + y * np.sin(a)) + p)
        for wide, a, p in zip(length, turn, start, strict=True)
    ]
    return 0.002 * np.sqrt(2 / 60) * np.sum(waves, 0)


def triangle(x, period):
    """Triangular wave between 0 and 1."""
    return np.abs(2 * ((x / period) % 1) - 1)


SINE = (lambda x, y: 0.00288125 * (1 + np.cos(2 * np.pi * x / 0.02)) + 0 * y, 0.0022)
# Heights in m over x and y, and the widest element, m, that shows them.
RELIEFS = {
    "sine 16 mm / 100 mm": (lambda x, y: 0.008 * np.cos(2 * np.pi * x / 0.1) + 0 * y, 0.008),
    "waves 12 mm / 250 mm": (lambda x, y: 0.006 * np.cos(2 * np.pi * x / 0.25 + 0.7) + 0 * y, 0.012),
    "egg crate 12 mm / 60 mm": (
        lambda x, y: 0.003 * (np.cos(2 * np.pi * x / 0.06) + np.cos(2 * np.pi * y / 0.06)),
        0.006,
    ),
    "rubble 2 mm": (rubble, 0.006),
    "pyramids 20 mm / 40 mm": (lambda x, y: 0.02 * np.minimum(triangle(x, 0.04), triangle(y, 0.04)), 0.005),
}


def solid(height, size, widest, is_round):
    """A closed mesh: the relief above, a flat side below, both triangulated from points about `widest` apart. A round
    one is 2.5 mm thick under its lowest place, others 10 mm."""
    count = int(np.ceil(size / widest))
    if is_round:
        rings = [
            size / 2 * ring / count * 2 * np.stack([np.cos(a), np.sin(a)], 1)
            for ring in range(1, count // 2 + 1)
            for a in [2 * np.pi * np.arange(6 * ring) / (6 * ring)]
        ]
        scale = size / 2 / np.hypot(*rings[-1].T).max()
        edge, inner = rings[-1] * scale, np.concatenate([[[0.0, 0.0]], *rings[:-1]]) * scale
    else:
        line = np.linspace(-size / 2, size / 2, count + 1)
        sides = [np.stack([line[:-1], np.full(count, -size / 2)], 1)]
        for _ in range(3):
            sides.append(np.stack([-sides[-1][:, 1], sides[-1][:, 0]], 1))
        edge = np.concatenate(sides)
        x, y = np.meshgrid(line[1:-1], line[1:-1])
        # Every second row is moved by half a step, so that triangles are nearly equilateral.
        x = x + np.where(np.arange(count - 1) % 2, 0.25, -0.25)[:, None] * (line[1] - line[0])
        inner = np.stack([x.ravel(), y.ravel()], 1)
    flat = np.concatenate([edge, inner])
    faces = Delaunay(flat).simplices
    a, b, c = (flat[faces[:, i]] for i in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    faces = faces[np.abs(area) > 1e-3 * widest * widest]
    area = area[np.abs(area) > 1e-3 * widest * widest]
    faces[area < 0] = faces[area < 0][:, ::-1]
    z = height(flat[:, 0], flat[:, 1])
    low = z.min() - (0.0025 if is_round else 0.010)
    top = np.column_stack([flat, z])
    bottom = np.column_stack([flat, np.full(len(flat), low)])
    levels = int(np.ceil((z.max() - low) / widest))
    between = [
        np.column_stack([edge, z[: len(edge)] + (low - z[: len(edge)]) * level / levels]) for level in range(1, levels)
    ]
    vertices = np.concatenate([top, bottom, *between])
    loops = [np.arange(len(edge))]
    loops += [len(top) + len(bottom) + len(edge) * level + np.arange(len(edge)) for level in range(levels - 1)]
    loops += [len(top) + np.arange(len(edge))]
    walls = []
    for upper, lower in itertools.pairwise(loops):
        upper_next, lower_next = np.roll(upper, -1), np.roll(lower, -1)
        walls += [np.stack([upper, lower, upper_next], 1), np.stack([upper_next, lower, lower_next], 1)]
    mesh = trimesh.Trimesh(vertices, np.concatenate([faces, faces[:, ::-1] + len(top), *walls]), process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0
    return mesh


def direction(zenith_deg, azimuth_deg):
    """Unit vector towards a source."""
    zenith, azimuth = np.radians([zenith_deg, azimuth_deg])
    return np.array([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])


def surface_pressures(mesh, hz, source, speed):
    """Pressure on each element, from a plane wave that comes from `source`."""
    with tempfile.TemporaryDirectory() as folder:
        project = pathlib.Path(folder) / "project"
        # The solver asks for receivers; the far field needs none.
        near = pf.Coordinates([1.0, 1.01, 1.0], [0, 0, 0.01], [1.0, 1.0, 1.0], weights=np.ones(3))
        grid = m2s.input.EvaluationGrid(near, np.array([[0, 1, 2]]), "near")
        towards = pf.Coordinates(*[[x] for x in -source], weights=[1.0])
        sample = m2s.input.SampleMesh(mesh, m2s.input.SurfaceDescription())
        m2s.input.write_scattering_project_numcalc(
            str(project),
            "case",
            np.array([hz]),
            m2s.input.SoundSource(towards, m2s.input.SoundSourceType.PLANE_WAVE),
            [grid],
            sample,
            speed_of_sound=speed,
        )
        where = project / "NumCalc" / "source_1"
        solver = m2s.numcalc.build_or_fetch_numcalc()
        subprocess.run([solver, "-istart", "1", "-iend", "1"], cwd=where, check=True, stdout=subprocess.DEVNULL)
        log = "".join(path.read_text() for path in where.glob("NC*.out"))
        if "Maximum number of iterations is reached" in log:
            sys.exit(f"the solver did not converge at {hz} Hz")
        rows = [line.split() for line in (where / "be.out" / "be.1" / "pBoundary").read_text().splitlines()]
        values = {int(row[0]): complex(float(row[1]), float(row[2])) for row in rows if len(row) == 3}
        return np.array([values[i] for i in range(len(mesh.faces))])


def far_field(mesh, pressures, k, directions):
    """Scattered pressure far away but for a common factor, `[directions]`."""
    weighted = mesh.face_normals * (mesh.area_faces * pressures)[:, None]
    out = np.empty(len(directions), complex)
    for start in range(0, len(directions), 128):
        d = directions[start : start + 128]
        turns = np.exp(-1j * k * d @ mesh.triangles_center.T)
        out[start : start + 128] = ((turns @ weighted) * d).sum(1)
    return out


def half_space(k, size):
    """Directions of the upper half space and their solid angles, as close as a field of this size needs."""
    count = max(int(np.ceil(k * size / 1.6 / 2)), 45)
    zenith = (np.arange(count) + 0.5) * np.pi / 2 / count
    azimuth = np.arange(4 * count) * 2 * np.pi / (4 * count)
    zenith, azimuth = (a.ravel() for a in np.meshgrid(zenith, azimuth, indexing="ij"))
    directions = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], 1)
    return directions, np.sin(zenith)


def half_circle(azimuth_deg):
    """Directions of the 37 receivers in the plane of incidence."""
    azimuth = np.radians(azimuth_deg)
    across = np.sin(RECEIVER_ANGLES)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(RECEIVER_ANGLES)], 1)


def diffusion(pressures):
    """Directional diffusion coefficient of equal weights."""
    energy = np.abs(pressures) ** 2
    return (energy.sum() ** 2 - (energy**2).sum()) / (len(energy) - 1) / (energy**2).sum()


def fields(height, size, widest, is_round, hz, incidence, speed):
    """Far fields over the half space and along the half circle, and what they cost."""
    began = time.monotonic()
    mesh = solid(height, size, min(widest, speed / hz / 7), is_round)
    source, k = direction(*incidence), 2 * np.pi * hz / speed
    pressures = surface_pressures(mesh, hz, source, speed)
    over, _ = half_space(k, size)
    around = far_field(mesh, pressures, k, over)
    along = far_field(mesh, pressures, k, half_circle(incidence[1]))
    return around, along, {"elements": len(mesh.faces), "secs": round(time.monotonic() - began, 1)}


def flat(x, _):
    """No relief."""
    return 0 * x


def solve(cases, size, is_round, speed, file):
    """Solves cases that the file does not have, and yields all: relief, frequency, incidence, coefficients."""
    known = {}
    if file.exists():
        for line in file.read_text().splitlines():
            row = json.loads(line)
            known[row["relief"], row["hz"], row["zenith_deg"], row["azimuth_deg"]] = row
    flats = {}
    for name, (height, widest), hz, incidence in cases:
        key = (name, hz, *incidence)
        if key not in known:
            if (hz, incidence) not in flats:
                flats[hz, incidence] = fields(flat, size, 1.0, is_round, hz, incidence, speed)
            flat_around, flat_along, _ = flats[hz, incidence]
            around, along, cost = fields(height, size, widest, is_round, hz, incidence, speed)
            _, angles = half_space(2 * np.pi * hz / speed, size)
            mutual = np.abs((angles * around * flat_around.conj()).sum()) ** 2
            own = (angles * np.abs(around) ** 2).sum() * (angles * np.abs(flat_around) ** 2).sum()
            flat_d = diffusion(flat_along)
            known[key] = {
                "relief": name,
                "hz": hz,
                "zenith_deg": incidence[0],
                "azimuth_deg": incidence[1],
                "scattering": round(1 - mutual / own, 4),
                "diffusion_normalised": round((diffusion(along) - flat_d) / (1 - flat_d), 4),
                **cost,
            }
            with file.open("a") as out:
                print(json.dumps(known[key]), file=out, flush=True)
        yield known[key]


def reference_table(rows):
    """Lines of the reference's table, in Markdown."""
    yield "| source, zenith and azimuth | | " + " | ".join(f"{khz} kHz" for khz in (4, 8, 12, 16)) + " |"
    yield "| --- | --- |" + " ---: |" * 4
    for (zenith, azimuth), published in REFERENCE.items():
        found = {
            row["hz"]: row["scattering"] for row in rows if (row["zenith_deg"], row["azimuth_deg"]) == (zenith, azimuth)
        }
        yield f"| {zenith}, {azimuth} | published | " + " | ".join(f"{x:.3f}" for x in published) + " |"
        yield "| | here | " + " | ".join(f"{found[khz * 1e3]:.3f}" for khz in (4, 8, 12, 16)) + " |"


def main():
    """Solves the reference, or five reliefs."""
    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=pathlib.Path, metavar="FILE")
    parser.add_argument("--reference", action="store_true")
    parser.add_argument("--write", type=pathlib.Path, metavar="PAGE")
    args = parser.parse_args()
    if args.reference:
        cases = [("sine", SINE, hz, incidence) for hz in (4e3, 8e3, 12e3, 16e3) for incidence in REFERENCE]
        worst, rows = 0.0, []
        for row in solve(cases, 0.2, True, 346.18, args.file):
            expected = REFERENCE[row["zenith_deg"], row["azimuth_deg"]][int(row["hz"] / 4e3) - 1]
            worst = max(worst, abs(row["scattering"] - expected))
            rows.append(row)
            print(json.dumps({**row, "published": expected}), flush=True)
        if args.write:
            write_table(args.write, "tests/simulation/solid_bem.py --reference", reference_table(rows))
        print(f"greatest difference: {worst:.3f}", file=sys.stderr)
        sys.exit(int(worst > 0.05))
    incidences = [(0, 0), (30, 0), (60, 0)]
    cases = [(name, relief, hz, i) for hz in (2.5e3, 5e3, 10e3) for name, relief in RELIEFS.items() for i in incidences]
    cases += [("waves 12 mm / 250 mm", RELIEFS["waves 12 mm / 250 mm"], 20e3, i) for i in incidences]
    for row in solve(cases, 0.585, False, 343.2, args.file):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
