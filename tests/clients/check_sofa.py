"""Checks `import sofa` and `import hdf5` against files of other programs: `check_sofa.py ECHOLAKE`.

ECHOLAKE is the command. Writes a file of each convention with sofar (those packed by netCDF, too), and a set of responses
with h5py, imports them into a lake of its own, and compares what SQL says with what sofar reads: responses, positions in
millimetres, and which response belongs to which two of them. Needs the PyPI packages sofar, h5py and numpy. Exits with 1
and says what differs.
"""
import json
import pathlib
import subprocess
import sys
import tempfile

import h5py
import numpy as np
import sofar

from checks import Checks

RATE_HZ = 48000
LENGTH = 512
CELSIUS = 20.0
RANDOM = np.random.default_rng(7)
ROWS = """select m.surface_id, m.ir, a.x_mm mx, a.y_mm my, a.z_mm mz, b.x_mm sx, b.y_mm sy, b.z_mm sz
    from measurements m join pairs p on m.pair_id = p.pair_id
    join points a on p.microphone = a.point_id join points b on p.speaker = b.point_id"""


def cartesian_mm(position, kind, units):
    """Positions of a file, mm."""
    position = np.atleast_2d(np.asarray(position, float))
    scale = {"metre": 1e3, "millimetre": 1.0, "centimetre": 10.0}[units.split(", ")[-1]]
    if kind == "cartesian":
        return position * scale
    azimuth, elevation, distance = np.radians(position[:, 0]), np.radians(position[:, 1]), position[:, 2] * scale
    flat = distance * np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)], axis=1)


def elements_mm(sofa, element, count):
    """Positions of receivers or emitters relative to their listener or source, mm."""
    position = np.asarray(getattr(sofa, f"{element}Position"), float)
    position = position[..., 0] if position.ndim == 3 else np.atleast_2d(position)
    kind, units = (getattr(sofa, f"{element}Position_{what}") for what in ("Type", "Units"))
    return np.broadcast_to(cartesian_mm(position, kind, units), (count, 3))


def objects_mm(sofa, name, count):
    kind, units = (getattr(sofa, f"{name}Position_{what}") for what in ("Type", "Units"))
    return np.broadcast_to(cartesian_mm(getattr(sofa, f"{name}Position"), kind, units), (count, 3))


def responses_of(sofa):
    """All responses of a file with their microphone's and speaker's position, mm."""
    if sofa.GLOBAL_DataType == "TF":
        irs = np.fft.irfft(sofa.Data_Real + 1j * sofa.Data_Imag, axis=-1)[..., None]
    else:
        irs = np.asarray(sofa.Data_IR)
        irs = irs[..., None] if irs.ndim == 3 else irs
    measurements, receivers, _, emitters = irs.shape
    listeners, sources = (objects_mm(sofa, name, measurements) for name in ("Listener", "Source"))
    microphones, speakers = elements_mm(sofa, "Receiver", receivers), elements_mm(sofa, "Emitter", emitters)
    return [
        (listeners[m] + microphones[r], sources[m] + speakers[e], irs[m, r, :, e].astype(np.float32))
        for m in range(measurements)
        for r in range(receivers)
        for e in range(emitters)
    ]


def noise(*shape):
    return RANDOM.standard_normal(shape).astype(np.float32).astype(float)


def new(convention, irs=None):
    sofa = sofar.Sofa(convention)
    if irs is not None:
        sofa.Data_IR = irs
        sofa.Data_SamplingRate = RATE_HZ
    if convention.startswith("SingleRoom"):
        sofa.MeasurementDate = np.zeros(len(irs))
        for element in ("Receiver", "Emitter"):
            for name in ("Descriptions", "View", "View_Type", "View_Units", "Up"):
                sofa.delete(f"{element}{name}")
    return sofa


def files():
    """A file of each convention."""
    srir = new("SingleRoomSRIR", noise(6, 1, LENGTH))
    srir.ListenerPosition = np.tile([0, 0, 0.124], (6, 1))
    srir.SourcePosition = [[0.1 + 0.05 * i, 0.3, 1.0] for i in range(6)]
    yield "srir", srir
    mimo = new("SingleRoomMIMOSRIR", noise(2, 3, LENGTH, 2))
    mimo.Data_Delay = np.zeros((1, 3, 1))
    mimo.ListenerPosition = [[0, 0, 0], [0, 1, 0]]
    mimo.ReceiverPosition = np.array([[0, 0, 0.1], [90, 0, 0.1], [0, 90, 0.1]])[..., None]
    mimo.SourcePosition = [[2, 0, 1], [2, 0, 1]]
    mimo.EmitterPosition = np.array([[0, 0.2, 0], [0.1, -0.2, 0]])[..., None]
    mimo.EmitterPosition_Type, mimo.EmitterPosition_Units = "cartesian", "metre"
    yield "mimo", mimo
    fir = new("GeneralFIR", noise(2, 4, LENGTH))
    fir.Data_Delay = np.zeros((1, 4))
    # sofar writes no other units than metre; see check_file.
    fir.ListenerPosition = [[0, 0, 500]]
    fir.ReceiverPosition = [[10 * i, 5, 0] for i in range(4)]
    fir.SourcePosition = [[30, 10, 1.2], [-60, 0, 2]]
    yield "fir", fir
    hrir = new("SimpleFreeFieldHRIR", noise(5, 2, LENGTH))
    hrir.SourcePosition = [[40 * i, 15 * i - 30, 1.5] for i in range(5)]
    yield "hrir", hrir
    directivity = new("FreeFieldDirectivityTF")
    # What sofar has as defaults, but cannot write.
    for name in ("EmitterDescriptions", "Description"):
        directivity.delete(name)
    spectra = np.fft.rfft(noise(1, 8, LENGTH))
    directivity.Data_Real, directivity.Data_Imag = spectra.real, spectra.imag
    directivity.N = np.fft.rfftfreq(LENGTH, 1 / RATE_HZ)
    directivity.SourcePosition = [[0.3, 0.3, 0.3]]
    directivity.ReceiverPosition = [[45 * i, 10, 1] for i in range(8)]
    yield "directivity", directivity


def write_set(path, microphones, speakers, irs):
    """A set of responses as other programs write it: packed, samples in the middle."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        chunks = (1, 64, 3)
        data.create_dataset("ir", data=irs, dtype="f4", chunks=chunks, compression="gzip", shuffle=True)
        data.create_dataset("microphones", data=microphones)
        data.create_dataset("speakers", data=speakers.T / 1e3).attrs["Units"] = "metre"
        data["ir"].attrs["fs"] = np.int64(RATE_HZ)


MAPPING = f"""file = "set.h5"
surfaces = ["set"]
sampling_rate = {{ dataset = "data/ir", attribute = "fs" }}
temperature = {CELSIUS}
[responses]
dataset = "data/ir"
dimensions = ["speaker", "sample", "microphone"]
[microphones]
dataset = "data/microphones"
units = "mm"
[speakers]
dataset = "data/speakers"
"""


class CheckedLake:
    """A lake of one rig, whose points are those of a file."""

    def __init__(self, command, folder, positions):
        self.command, self.folder = command, folder
        points = np.unique(np.round(np.concatenate(positions), 6), axis=0)
        text = "".join(f"    {point.tolist()},\n" for point in points)
        rig = f"impulse_response = {{ length = 384, reference_temperature_c = {CELSIUS} }}\nsweep.rate_hz = {RATE_HZ}.0\n"
        rig += "sweep.low_hz = 100.0\nsweep.high_hz = 20000.0\nbands.centres_hz = [1000.0, 2000.0, 4000.0]\n"
        grid = f'[grid]\npairs = "ordered"\nclearance_mm = 0.0\npoints_mm = [\n{text}]\n'
        (folder / "rig.toml").write_text(rig + grid)

    def run(self, *arguments):
        done = subprocess.run([self.command, "--lake", "lake", *arguments], cwd=self.folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def rows(self):
        self.run("ingest")
        return json.loads(self.run("sql", "--json", ROWS))


def compare(rows, expected, tolerance):
    """None, or what differs."""
    if len(rows) != len(expected):
        return f"{len(rows)} responses, expected {len(expected)}"
    for microphone, speaker, ir in expected:
        position = np.concatenate([microphone, speaker])
        found = [r for r in rows if np.allclose([r[k] for k in ("mx", "my", "mz", "sx", "sy", "sz")], position, atol=1e-5)]
        if len(found) != 1:
            return f"{len(found)} responses at {position.round(3).tolist()}"
        actual = np.asarray(found[0]["ir"], np.float32)
        worst = np.abs(actual - ir[: len(actual)]).max()
        if worst > tolerance:
            return f"a response at {position.round(3).tolist()} is {worst} off"
    return None


def check_file(command, name, sofa, packed):
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        sofar.write_sofa(str(folder / f"{name}.sofa"), sofa, compression=4 if packed else 0)
        if sofa.GLOBAL_SOFAConventions == "GeneralFIR":
            with h5py.File(folder / f"{name}.sofa", "a") as file:
                for variable in ("ListenerPosition", "ReceiverPosition"):
                    file[variable].attrs["Units"] = "millimetre"
        expected = responses_of(sofar.read_sofa(str(folder / f"{name}.sofa"), verify=False, verbose=False))
        lake = CheckedLake(command, folder, [[m for m, _, _ in expected], [s for _, s, _ in expected]])
        lake.run("import", "sofa", f"{name}.sofa", "--rig", "rig.toml", "--temperature-c", str(CELSIUS))
        return compare(lake.rows(), expected, 1e-6 if sofa.GLOBAL_DataType == "TF" else 0)


def check_set(command):
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        microphones = np.array([[20.0 * i, 0, 100] for i in range(7)])
        speakers = np.array([[30.0 * i, 500, 200] for i in range(5)])
        irs = noise(5, LENGTH, 7)
        write_set(folder / "set.h5", microphones, speakers, irs)
        (folder / "set.toml").write_text(MAPPING)
        lake = CheckedLake(command, folder, [microphones, speakers])
        lake.run("import", "hdf5", "set.toml", "--rig", "rig.toml")
        expected = [(microphones[m], speakers[s], irs[s, :, m].astype(np.float32)) for m in range(7) for s in range(5)]
        return compare(lake.rows(), expected, 0)


def main(command):
    checks = Checks()
    for packed in (False, True):
        for name, sofa in files():
            label = f"{sofa.GLOBAL_SOFAConventions}{', packed' if packed else ''}"
            checks.same(label, None, lambda: check_file(command, name, sofa, packed))
    checks.same("a set in HDF5", None, lambda: check_set(command))
    return checks.done()


if __name__ == "__main__":
    sys.exit(main(str(pathlib.Path(sys.argv[1]).absolute())))
