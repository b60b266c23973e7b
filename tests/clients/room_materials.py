"""Reverberation of a room whose wall is of a measured surface: `room_materials.py MATERIALS.json [PLOT]`.

MATERIALS.json is written by `echolake export materials --format pyroomacoustics`. The room is 6 x 5 x 3 m; one wall of
6 x 3 m is of each surface in turn, the others are of plaster. Printed is T30 by band with the scattering of the file, and
with 0.05 for all bands; PLOT is a picture of both. Image sources and rays are pyroomacoustics'.

    pip install pyroomacoustics matplotlib
"""

import json
import pathlib
import sys

import matplotlib.pyplot as plt
import numpy as np
import pyroomacoustics as pra

RATE_HZ = 16000
BANDS = (250, 500, 1000, 2000, 4000)
PLASTER = 0.06
OTHER_SCATTERING = 0.1


def decay_secs(wall: pra.Material) -> list[float]:
    """T30 by band."""
    np.random.seed(1)
    plain = {name: pra.Material(PLASTER, OTHER_SCATTERING) for name in ("east", "west", "north", "floor", "ceiling")}
    room = pra.ShoeBox(
        [6, 5, 3], fs=RATE_HZ, materials={**plain, "south": wall}, max_order=3, ray_tracing=True, air_absorption=True
    )
    room.set_ray_tracing(n_rays=20000, receiver_radius=0.5)
    room.add_source([1.5, 3.5, 1.5])
    room.add_microphone([4.5, 2.0, 1.2])
    room.compute_rir()
    filters = pra.OctaveBandsFactory(base_frequency=250, fs=RATE_HZ)
    bands = filters.analysis(np.array(room.rir[0][0]))
    centres = [round(hz) for hz in filters.centers]
    of_band = (bands[:, centres.index(hz)] for hz in BANDS)
    return [float(pra.experimental.measure_rt60(band, fs=RATE_HZ, decay_db=30)) for band in of_band]


def main() -> None:
    materials = json.loads(pathlib.Path(sys.argv[1]).read_text())
    print("| surface | scattering | " + " | ".join(f"{hz} Hz" for hz in BANDS) + " |")
    print("| --- | --- |" + " ---: |" * len(BANDS))
    _, axes = plt.subplots()
    for name, values in materials.items():
        absorption = values["energy_absorption"]
        for label, wall, style in (
            ("of the file", pra.Material(**values), "-o"),
            ("0.05", pra.Material(absorption, 0.05), "--s"),
        ):
            secs = decay_secs(wall)
            print(f"| {name} | {label} | " + " | ".join(f"{t:.2f} s" for t in secs) + " |")
            axes.semilogx(BANDS, secs, style, label=f"{name}, scattering {label}")
    if len(sys.argv) > 2:
        origins = {values["scattering"]["description"] for values in materials.values()}
        axes.set(title="\n".join(sorted(origins)), xlabel="Hz", ylabel="T30, s, computed by pyroomacoustics")
        axes.set_xticks(BANDS, BANDS)
        axes.set_xticks([], minor=True)
        axes.legend()
        plt.savefig(sys.argv[2])


if __name__ == "__main__":
    main()
