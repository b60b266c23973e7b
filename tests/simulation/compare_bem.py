"""Compares the simulated rig's scattering with a boundary-element method, in two dimensions.

A relief is the upper side of a rigid bar as long as the panel is wide, 75 mm thick, in free air. The boundary-element
method solves for the pressure on it (Burton and Miller 1971, collocation, constant elements of an eighth of the
wavelength, 0.35 mm in joints); `--cylinder` compares it with the series of a rigid cylinder. The two forms of
`echolake_dsp::kirchhoff::FacetScattering` are computed beside it on cells of the panel's facets (2.135 mm), with
heights that are means over the cells, as the program has them. Microphones and speakers are at the 16 places of the
paper's grid over the middle of the panel, all pairs of them. Energies are summed over 36 frequencies from 2 to 40 kHz
with weights of the bands an octave apart, and are over those of a flat bar by the same method. The last row of a relief
is columns `detail_phase_*` of table `surfaces`: the phase of its details that are narrower than a wavelength. A test in
`schema/src/simulation/` compares the table with the constants that say how far the simulation is trusted.

    pip install numpy scipy
    python tests/simulation/compare_bem.py                 # half an hour on one core
    python tests/simulation/compare_bem.py waves joint1.2  # these reliefs
    python tests/simulation/compare_bem.py --write FILE    # and puts the table between the markers in FILE
    python tests/simulation/compare_bem.py --cylinder
    python tests/simulation/compare_bem.py --far-field --write docs/materials.md  # ten minutes

With `--far-field` the table has coefficients by band, of 3 frequencies each: diffusion by ISO 17497-2, normalised by
the flat bar, and scattering by Mommertz's correlation with the flat bar; the program's is 1 less the share that is
mirrored. The far field has plane waves from 0, 30 and 60 degrees to both sides, with weights for random incidence, by
the boundary-element method and as `echolake_dsp::far_field` has it. Diffusion has 37 receivers. Scattering has 721: 37
stand in the middle of the mirror's narrow beam, and count it for more than it is. Beside each stands the standard
uncertainty that `echolake_dsp::relief_coefficients` gives to Kirchhoff's approximation, from the phase of the details
that are narrower than a wavelength; a test in that module compares the table with its constants. The last row is what
the lake's function `scattering` makes of the boundary elements' pressures at the 120 pairs of the grid.
"""

import argparse
import pathlib
import sys

import numpy as np
from scipy.linalg import solve
from scipy.special import h1vp, hankel1, j0, j1, jvp, y0, y1

SPEED = 343.0
WIDTH = 0.585
FACETS = 274
CENTRES = 2500.0 * 2.0 ** np.arange(5)
FREQUENCIES = 2000.0 * 20.0 ** (np.arange(36) / 35)
LAYERS = [(6, 75.0, 124.0), (5, 93.75, 214.0), (4, 125.0, 304.0), (1, 0.0, 474.0)]
PLACES = np.array([((i - (n - 1) / 2) * pitch, z) for n, pitch, z in LAYERS for i in range(n)]) / 1e3
PAIRS = [(i, j) for i in range(16) for j in range(i)]
FEW = np.polynomial.legendre.leggauss(2)
MANY = np.polynomial.legendre.leggauss(8)
# Receivers and sources of ISO 17497-2, and the sources' weights for random incidence.
RECEIVER_ANGLES = np.radians(np.arange(-90, 91, 5))
FINE_ANGLES = np.radians(np.arange(-360, 361) / 4)
SOURCE_ANGLES = np.radians([0, -30, 30, -60, 60])
SOURCE_WEIGHTS = np.array([1, 3, 3, 3, 3]) / 13
# Rows of the table: energies over Flat, and root mean square differences of the pairs from the boundary-element method.
LEVELS = ("boundary elements, mean, dB", "`steep_facets = false`, mean, dB", "`steep_facets = true`, mean, dB")
DIFFERENCES = ("`steep_facets = false`, rms a pair, dB", "`steep_facets = true`, rms a pair, dB")
MARKER = "tests/simulation/compare_bem.py"


def hankel(z):
    """Hankel functions of orders 0 and 1: time goes as e^(-i omega t)."""
    return j0(z) + 1j * y0(z), j1(z) + 1j * y1(z)


class BoundaryMesh:
    """Straight elements along a closed polygon, their normals to the left of travel."""

    def __init__(self, corners, sizes):
        starts, ends = [], []
        for a, b, size in zip(corners, np.roll(corners, -1, axis=0), sizes, strict=True):
            length = np.hypot(*(b - a))
            if length < 1e-9:
                continue
            points = a + (b - a) * np.linspace(0, 1, int(np.ceil(length / size)) + 1)[:, None]
            starts.append(points[:-1])
            ends.append(points[1:])
        a, b = np.concatenate(starts), np.concatenate(ends)
        self.middle, self.half = (a + b) / 2, (b - a) / 2
        self.length = 2 * np.hypot(*self.half.T)
        self.normal = np.stack([-self.half[:, 1], self.half[:, 0]], 1) * (2 / self.length[:, None])

    def kernel(self, k, x, nx, y, ny):
        """Double layer, plus i/k times its normal derivative."""
        d = x - y
        r = np.hypot(d[..., 0], d[..., 1])
        h0, h1 = hankel(k * r)
        rx, ry = (d * nx).sum(-1) / r, -(d * ny).sum(-1) / r
        double = -0.25j * k * h1 * ry
        mixed = -0.25j * k * k * (h0 - h1 / (k * r)) * rx * ry + 0.25j * k * h1 * ((nx * ny).sum(-1) + rx * ry) / r
        return double + 1j / k * mixed

    def matrix(self, k):
        n = len(self.middle)
        a = np.zeros((n, n), complex)
        for t, w in zip(*FEW, strict=True):
            y = self.middle + self.half * t
            with np.errstate(all="ignore"):
                a -= self.kernel(k, self.middle[:, None], self.normal[:, None], y[None], self.normal[None]) * (
                    w * self.length / 2
                )
        gap = self.middle[:, None] - self.middle[None]
        i, j = np.nonzero(np.hypot(gap[..., 0], gap[..., 1]) < 3 * self.length[None])
        i, j = i[i != j], j[i != j]
        a[i, j] = 0
        for t, w in zip(*MANY, strict=True):
            y = self.middle[j] + self.half[j] * t
            a[i, j] -= self.kernel(k, self.middle[i], self.normal[i], y, self.normal[j]) * (w * self.length[j] / 2)
        # An element upon itself: the finite part of 1/(2 pi r^2), and the kernel's next terms.
        h = self.length / 2
        log = h * (np.log(k * h / 2) - 1) + (np.euler_gamma - 0.5) * h
        own = -1 / (np.pi * h) + 0.5j * k * k * (h / 2 + 1j / np.pi * log)
        a[np.arange(n), np.arange(n)] = 0.5 - 1j / k * own
        return a

    def scattered(self, k, sources, receivers):
        """Scattered pressure `[receivers, sources]` of line sources i/4 H0(k r)."""
        near, _ = self.all_scattered(k, sources, receivers)
        return near

    def all_scattered(self, k, sources, receivers):
        """The same, and that of plane waves far away, `[721, 5]`, but for a common factor."""
        d = self.middle[:, None] - sources[None]
        r = np.hypot(d[..., 0], d[..., 1])
        h0, h1 = hankel(k * r)
        incident = 0.25j * h0 + 0.25 * h1 * (d * self.normal[:, None]).sum(-1) / r
        to_source = np.stack([np.sin(SOURCE_ANGLES), np.cos(SOURCE_ANGLES)])
        waves = np.exp(-1j * k * self.middle @ to_source) * (1 + self.normal @ to_source)
        both = np.hstack([incident, waves])
        both = solve(self.matrix(k), both, overwrite_a=True, overwrite_b=True, check_finite=False)
        pressure, of_waves = both[:, : len(sources)], both[:, len(sources) :]
        to_receiver = np.stack([np.sin(FINE_ANGLES), np.cos(FINE_ANGLES)])
        out, far = 0, 0
        for t, w in zip(*FEW, strict=True):
            d = receivers[:, None] - (self.middle + self.half * t)[None]
            r = np.hypot(d[..., 0], d[..., 1])
            double = 0.25j * k * hankel(k * r)[1] * (d * self.normal[None]).sum(-1) / r
            out = out + (double * (w * self.length / 2)) @ pressure
            turns = np.exp(-1j * k * (self.middle + self.half * t) @ to_receiver)
            far = far + (self.normal @ to_receiver * turns).T * (w * self.length / 2) @ of_waves
        return out, far


def stairs(edges, heights):
    """Level pieces between edges, with upright walls."""
    return [(x, z) for left, right, z in zip(edges, edges[1:], heights, strict=False) for x in (left, right)]


def joints(width):
    """Grooves 1 mm deep, 7.5 mm apart: the bed joints of bricks."""
    count = int(WIDTH / 0.0075)
    centres = (np.arange(count) - (count - 1) / 2) * 0.0075
    edges = np.concatenate([[-WIDTH / 2], np.stack([centres - width / 2, centres + width / 2], 1).ravel(), [WIDTH / 2]])
    return stairs(edges, [0.0, -0.001] * count + [0.0])


def rubble():
    """Stones 30 to 60 mm wide and rough by up to 3 mm; joints 5 to 8 mm wide and 4 to 7 mm deep."""
    chance = np.random.default_rng(5)
    top, x = [(-WIDTH / 2, 0.0)], -WIDTH / 2
    while True:
        width, joint = chance.uniform(0.03, 0.06), chance.uniform(0.005, 0.008)
        if x + width + joint > WIDTH / 2 - 0.02:
            return [*top, (x, 0.0), (WIDTH / 2, 0.0)]
        count = int(width / 0.002)
        window = np.hanning(9) / np.sqrt((np.hanning(9) ** 2).sum())
        rough = np.convolve(chance.normal(size=count + 16), window, "same")[8 : 8 + count] * 0.0013
        rough = np.clip(rough + chance.uniform(-0.0008, 0.0008), -0.003, 0.003)
        top += list(zip(np.linspace(x, x + width, count), rough, strict=True))
        x += width
        depth = -chance.uniform(0.004, 0.007)
        top += [(x, depth), (x + joint, depth)]
        x += joint


def wells(width, depth, seed):
    """Wells side by side, of eight depths."""
    count = int(WIDTH / width)
    inner = (np.arange(count - 1) - (count - 2) / 2) * width
    edges = np.concatenate([[-WIDTH / 2], inner, [WIDTH / 2]])
    return stairs(edges, -depth * np.random.default_rng(seed).integers(0, 8, count) / 7.0)


def relief(name):
    """Upper outline of a relief, from left to right, m."""
    along = np.linspace(-WIDTH / 2, WIDTH / 2, 1201)
    return {
        "flat": lambda: [(-WIDTH / 2, 0.0), (WIDTH / 2, 0.0)],
        "waves": lambda: [(x, 0.006 * np.cos(2 * np.pi * x / 0.25 + 0.7)) for x in along],
        "joint0.6": lambda: joints(0.0006),
        "joint1.2": lambda: joints(0.0012),
        "joint1.5": lambda: joints(0.0015),
        "rubble": rubble,
        "wells45": lambda: wells(0.045, 0.038, 1),
        "wells15": lambda: wells(0.015, 0.020, 2),
        "sine": lambda: [(x, 0.008 * np.cos(2 * np.pi * x / 0.1)) for x in along],
        "prd": lambda: stairs(np.linspace(-WIDTH / 2, WIDTH / 2, 13), [-0.038 * pow(2, k, 13) / 13 for k in range(12)]),
    }[name]()


RELIEFS = {
    "waves": "waves 12 mm / 250 mm",
    "joint0.6": "joints 0.6 x 1 mm",
    "joint1.2": "joints 1.2 x 1 mm",
    "joint1.5": "joints 1.5 x 1 mm",
    "rubble": "rubble, joints 5-8 mm",
    "wells45": "wells 45 mm, <= 38 deep",
    "wells15": "wells 15 mm, <= 20 deep",
}
FAR_RELIEFS = {
    "sine": "sine 16 mm / 100 mm",
    "prd": "primitive root diffuser, 12 wells, 38 mm",
    **RELIEFS,
}


def boundary_meshes(name, frequencies):
    """A mesh of the bar for each frequency."""
    top = relief(name)
    corners = np.array([(-WIDTH / 2, -0.075), *top, (WIDTH / 2, -0.075)])
    lengths = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    is_detail = (lengths < 0.003) & (name not in ("waves", "sine"))
    for hz in frequencies:
        sizes = np.full(len(corners), min(SPEED / hz / 8, 0.003))
        sizes[is_detail] = np.minimum(sizes[is_detail], np.maximum(lengths[is_detail] / 3, 0.00035))
        yield hz, BoundaryMesh(corners, sizes)
        print(f"\r{name} {hz:6.0f} Hz", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)


def exact(name):
    """Scattered pressure by the boundary-element method, `[frequencies, receivers, sources]`."""
    meshes = boundary_meshes(name, FREQUENCIES)
    return np.array([mesh.scattered(2 * np.pi * hz / SPEED, PLACES, PLACES) for hz, mesh in meshes])


def cell_heights(name):
    """Means of a relief's height over the program's cells, and their middles, m."""
    top = np.array(relief(name))
    fine = (np.arange(FACETS * 64) + 0.5) / (FACETS * 64) * WIDTH - WIDTH / 2
    height = np.interp(fine, top[:, 0] + np.arange(len(top)) * 1e-12, top[:, 1]).reshape(FACETS, 64).mean(1)
    return height, (np.arange(FACETS) + 0.5) * WIDTH / FACETS - WIDTH / 2


def detail_phases(name, frequencies=CENTRES):
    """Phase by frequency of what is left of a relief beside its mean over a wavelength, root mean square."""
    height, _ = cell_heights(name)
    sums = np.concatenate([[0.0], np.cumsum(height)])
    place, phases = np.arange(FACETS), []
    for hz in frequencies:
        half = round((SPEED / hz / (WIDTH / FACETS) - 1) / 2)
        low, high = np.maximum(place - half, 0), np.minimum(place + half + 1, FACETS)
        detail = height - (sums[high] - sums[low]) / (high - low)
        phases.append(2 * np.pi * hz / SPEED * np.sqrt((detail**2).mean()))
    return phases


def kirchhoff(name):
    """Scattered pressure by both forms of the program: facing tangent planes alone, and blended."""
    height, x = cell_heights(name)
    step = WIDTH / FACETS
    d = PLACES[:, None] - np.stack([x, height], 1)[None]
    r = np.hypot(d[..., 0], d[..., 1])
    along, up = d[..., 0] / r, d[..., 1] / r
    cosine = up - np.gradient(height, step) * along
    faces = cosine > 0
    slant = 4 * (1 + along[:, None] * along[None]) / (up[:, None] + up[None])
    facing, blended = [], []
    for hz in FREQUENCIES:
        k = 2 * np.pi * hz / SPEED
        pulse, slope = 0.25j * hankel1(0, k * r), 0.25j * k * hankel1(1, k * r)
        near, turned = pulse * faces, slope * cosine * faces
        facing.append((turned @ near.T + near @ turned.T) * step)
        tangent = ((slope * cosine) @ pulse.T + pulse @ (slope * cosine).T) * step
        small_slope = np.einsum("in,jn,ijn->ij", pulse, pulse, slant) * (-1j * k * step)
        blended.append((tangent + small_slope) / 2)
    return np.array(facing), np.array(blended)


def band_energies(fields):
    """Energies `[bands, pairs]`: windows an octave wide to each side, the lowest open below."""
    octaves = np.log2(FREQUENCIES / CENTRES[0])[None] - np.arange(5)[:, None]
    window = np.where(np.abs(octaves) < 1, np.sin(np.pi / 2 * np.cos(np.pi / 2 * octaves) ** 2) ** 2, 0.0)
    window[0] = np.where(octaves[0] < 0, 1.0, window[0])
    weights = window / window.sum(0) * np.gradient(FREQUENCIES)
    energies = np.abs(fields) ** 2
    return np.array([[(w * energies[:, i, j]).sum() for i, j in PAIRS] for w in weights])


def check_cylinder():
    """Prints the largest error on a rigid cylinder, also at frequencies at which its inside resonates."""
    radius, angle = 0.05, np.linspace(0, np.pi, 7)
    turns = -np.arange(300) * 2 * np.pi / 300
    mesh = BoundaryMesh(radius * np.stack([np.cos(turns), np.sin(turns)], 1), [1.0] * 300)
    receivers = 0.15 * np.stack([np.cos(angle), np.sin(angle)], 1)
    for hz in (2000.0, 5000.0, 10000.0, *(SPEED * root / (2 * np.pi * radius) for root in (2.404826, 3.831706))):
        k = 2 * np.pi * hz / SPEED
        series = sum(
            -(0.25j if n == 0 else 0.5j)
            * jvp(n, k * radius) / h1vp(n, k * radius)
            * hankel1(n, 0.2 * k) * hankel1(n, 0.15 * k) * np.cos(n * angle)
            for n in range(int(k * radius) + 25)
        )  # fmt: skip
        error = np.abs(mesh.scattered(k, np.array([[0.2, 0.0]]), receivers)[:, 0] - series).max()
        print(f"{hz:8.0f} Hz  {100 * error / np.abs(series).max():.3f} %")
        assert error < 1e-3 * np.abs(series).max()


def table(names):
    """Lines of the table, in Markdown."""
    flat_exact, flats = band_energies(exact("flat")), [band_energies(f) for f in kirchhoff("flat")]
    yield "| relief | | " + " | ".join(f"{hz:.0f} Hz" for hz in CENTRES) + " |"
    yield "| --- | --- |" + " ---: |" * len(CENTRES)
    for name in names:
        truth = band_energies(exact(name)) / flat_exact
        forms = [band_energies(f) / flat for f, flat in zip(kirchhoff(name), flats, strict=True)]
        off = [np.sqrt(((10 * np.log10(ratios / truth)) ** 2).mean(1)) for ratios in forms]
        rows = [(label, 10 * np.log10(x.mean(1))) for label, x in zip(LEVELS, [truth, *forms], strict=True)]
        rows += [(label, x) for label, x in zip(DIFFERENCES, off, strict=True)]
        rows.append(("phase of details, rad", detail_phases(name)))
        for n, (label, values) in enumerate(rows):
            cells = " | ".join(f"{x:.2f}".replace("-0.00", "0.00") for x in values)
            yield f"| {RELIEFS[name] if n == 0 else ''} | {label} | {cells} |"


def far_frequencies():
    """Frequencies of the bands, 3 each: thirds of an octave, as far as the sweep has them."""
    low = np.maximum(CENTRES / np.sqrt(2), 2000)[:, None]
    high = np.minimum(CENTRES * np.sqrt(2), 40000)[:, None]
    return (low * (high / low) ** ((np.arange(3) + 0.5) / 3)).ravel()


def far_kirchhoff(name, hz):
    """Pressures far away, `[37, 5]`, as the program has them."""
    height, x = cell_heights(name)
    height, step, k = height - height.mean(), WIDTH / FACETS, 2 * np.pi * hz / SPEED
    out = np.empty((len(RECEIVER_ANGLES), len(SOURCE_ANGLES)), complex)
    for j, source in enumerate(SOURCE_ANGLES):
        for i, receiver in enumerate(RECEIVER_ANGLES):
            along, up = np.sin(source) + np.sin(receiver), np.cos(source) + np.cos(receiver)
            phase = np.exp(1j * k * up * height)
            level = (up + 4 * (1 + np.sin(source) * np.sin(receiver)) / up) / 2
            sloped = along / 2 * np.gradient(phase, step) / (1j * k * up)
            out[i, j] = ((level * phase - sloped) * np.exp(1j * k * along * x)).sum()
    return out


def far_diffusion(fields, flat):
    """Normalised diffusion of a band, from pressures `[frequencies, 37, 5]`."""

    def diffusion(pressures):
        energy = (np.abs(pressures) ** 2).sum(0)
        square = (energy**2).sum(0)
        return (energy.sum(0) ** 2 - square) / (len(energy) - 1) / square

    d, flat_d = diffusion(fields), diffusion(flat)
    return ((d - flat_d) / (1 - flat_d)) @ SOURCE_WEIGHTS


def far_scattering(fields, flat):
    """Scattering of a band, from pressures `[frequencies, 721, 5]`."""
    coherent = (np.abs((fields * flat.conj()).sum(1)) ** 2 / (np.abs(flat) ** 2).sum(1)).sum(0)
    return (1 - coherent / (np.abs(fields) ** 2).sum((0, 1))) @ SOURCE_WEIGHTS


def mirrored_share(name, hz):
    """Share of the energy that is mirrored, as the program has it, for random incidence."""
    height, _ = cell_heights(name)
    turns = 4j * np.pi * hz / SPEED * np.cos(SOURCE_ANGLES)[:, None] * (height - height.mean())
    return (np.abs(np.exp(turns).mean(1)) ** 2) @ SOURCE_WEIGHTS


def grid_scattering(fields, flat):
    """Scattering of a band by correlation over the pairs of the grid, from pressures `[frequencies, 16, 16]`."""
    pairs = np.array(PAIRS)
    fields, flat = (f[:, pairs[:, 0], pairs[:, 1]] for f in (fields, flat))
    d = PLACES[pairs[:, 0]] - PLACES[pairs[:, 1]] * [1, -1]
    classes = np.minimum(np.floor(10 * d[:, 1] / np.hypot(*d.T)), 9)
    coherent = 0
    for c in np.unique(classes):
        x, x0 = fields[:, classes == c], flat[:, classes == c]
        coherent += (np.abs((x * x0.conj()).sum(1)) ** 2 / (np.abs(x0) ** 2).sum(1)).sum()
    return 1 - coherent / (np.abs(fields) ** 2).sum()


def far_table(names):
    """Lines of the table of the far field, in Markdown."""
    frequencies = far_frequencies()

    def fields(name):
        meshes = boundary_meshes(name, frequencies)
        both = [mesh.all_scattered(2 * np.pi * hz / SPEED, PLACES, PLACES) for hz, mesh in meshes]
        near, far = (np.array(part) for part in zip(*both, strict=True))
        return near, far, np.array([far_kirchhoff(name, hz) for hz in frequencies])

    near_flat, far_flat, kirchhoff_flat = fields("flat")
    bands = [slice(3 * b, 3 * b + 3) for b in range(len(CENTRES))]
    yield "| relief | | " + " | ".join(f"{hz:.0f} Hz" for hz in CENTRES) + " |"
    yield "| --- | --- |" + " ---: |" * len(CENTRES)
    for name in names:
        near, far, by_kirchhoff = fields(name)
        to_37 = slice(None, None, 20)
        phase = np.array([np.mean(detail_phases(name, frequencies[b])) for b in bands])
        scattering = np.array([np.mean([1 - mirrored_share(name, hz) for hz in frequencies[b]]) for b in bands])
        rows = [
            ("diffusion, boundary elements", [far_diffusion(far[b][:, to_37], far_flat[b][:, to_37]) for b in bands]),
            ("diffusion, Kirchhoff", [far_diffusion(by_kirchhoff[b], kirchhoff_flat[b]) for b in bands]),
            ("its standard uncertainty", np.hypot(0.01, 0.45 * phase)),
            ("scattering, boundary elements", [far_scattering(far[b], far_flat[b]) for b in bands]),
            ("scattering, Kirchhoff", scattering),
            ("its standard uncertainty", np.hypot(0.02, 0.8 * phase * (1 - scattering))),
            ("phase of details, rad", phase),
            ("`scattering` of the grid's pairs", [grid_scattering(near[b], near_flat[b]) for b in bands]),
        ]
        for n, (label, values) in enumerate(rows):
            cells = " | ".join(f"{x:.2f}".replace("-0.00", "0.00") for x in values)
            yield f"| {FAR_RELIEFS[name] if n == 0 else ''} | {label} | {cells} |"


def write_table(page, marker, lines):
    """Puts lines between the markers in a page."""
    before, rest = page.read_text().split(f"<!-- {marker} -->\n")
    after = rest.split(f"<!-- end of {marker} -->\n")[1]
    body = "\n".join(lines)
    page.write_text(f"{before}<!-- {marker} -->\n\n{body}\n\n<!-- end of {marker} -->\n{after}")


def main():
    """Prints the table, or checks the method."""
    parser = argparse.ArgumentParser()
    parser.add_argument("reliefs", nargs="*", metavar="RELIEF", help=" ".join(FAR_RELIEFS))
    parser.add_argument("--cylinder", action="store_true")
    parser.add_argument("--far-field", action="store_true")
    parser.add_argument("--write", type=pathlib.Path, metavar="FILE")
    args = parser.parse_args()
    if args.cylinder:
        check_cylinder()
        return
    marker = f"{MARKER} --far-field" if args.far_field else MARKER
    lines = []
    for line in far_table(args.reliefs or FAR_RELIEFS) if args.far_field else table(args.reliefs or RELIEFS):
        print(line, flush=True)
        lines.append(line)
    if args.write:
        write_table(args.write, marker, lines)


if __name__ == "__main__":
    main()
