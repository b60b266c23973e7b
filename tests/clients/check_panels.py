"""Checks the panels of every typology with trimesh: `check_panels.py ECHOLAKE [FOLDER]`.

ECHOLAKE is the command. Makes panels with two sides in all four formats, and says of each whether it is watertight,
wound outwards, of some volume, and within 585 x 585 x 100 mm; that its height fields are those of its sides; and that
the pictures are there. Needs the PyPI packages trimesh and numpy. Exits with 1 and says what is wrong.
"""
import json
import pathlib
import subprocess
import sys
import tempfile

import numpy as np
import trimesh

SIZE_MM = 585.0
THICKEST_MM = 100.0
THINNEST_MM = 20.0


def panel(command, *arguments):
    return subprocess.run([command, "panel", *arguments], check=True, capture_output=True, text=True).stdout


def check_mesh(path):
    mesh = trimesh.load(path, force="mesh")
    mesh.merge_vertices()
    if path.suffix == ".glb":  # glTF is in metres, its y axis up.
        mesh.apply_scale(1000)
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    size = mesh.extents
    assert mesh.is_watertight, f"{path}: not watertight"
    assert mesh.is_winding_consistent, f"{path}: winding is not consistent"
    assert mesh.volume > SIZE_MM**2 * THINNEST_MM * 0.9, f"{path}: volume {mesh.volume}"
    assert mesh.body_count == 1, f"{path}: {mesh.body_count} bodies"
    assert np.allclose(size[:2], SIZE_MM, atol=0.01), f"{path}: {size}"
    assert size[2] <= THICKEST_MM + 0.01, f"{path}: {size[2]} mm thick"
    return mesh, f"{len(mesh.faces)} triangles, {size[2]:.1f} mm, {mesh.volume / 1e6:.2f} l"


def check_sides(mesh, folder, name):
    """The mesh's upper and lower surfaces against the height fields, at their middles' neighbourhood."""
    front, back = (np.load(folder / f"{name}_{side}.npy") for side in (0, 1))
    assert front.shape == back.shape == (512, 512) and front.dtype == np.float32
    for heights in (front, back):
        assert heights.min() >= -11.001 and heights.max() <= 29.001, f"{name}: {heights.min()} to {heights.max()}"
    z = mesh.vertices[:, 2]
    assert abs(z.max() - front.max()) < 1.0, f"{name}: front {z.max()} {front.max()}"
    assert abs(-42 - z.min() - back.max()) < 1.0, f"{name}: back {z.min()} {back.max()}"


def main(command, folder):
    reliefs = json.loads(panel(command, "--list", "--json"))
    # Panels of the paper have their parameters' values, and are of these reliefs.
    names = [r["relief"] for r in reliefs if "panel" not in r]
    for name, other in zip(names, names[1:] + names[:1]):
        files = [folder / f"{name}{extension}" for extension in (".stl", ".npy", ".json")]
        panel(command, name, "--back", other, *(x for file in files for x in ("-o", str(file))))
        mesh, facts = check_mesh(files[0])
        check_sides(mesh, folder, name)
        assert json.loads((folder / f"{name}_1.json").read_text())["relief"] == other
        print(f"{name} / {other}: {facts}")
        if name in ("stretcher_bond", "river_rock"):
            path = folder / f"{name}.glb"
            panel(command, name, "--back", other, "-o", str(path))
            again, _ = check_mesh(path)
            assert abs(again.volume / mesh.volume - 1) < 1e-4, f"{path}: another volume"
            panel(command, name, "--cells", "200", "-o", str(folder / f"{name}_single.stl"))
            check_mesh(folder / f"{name}_single.stl")
    print(f"{len(names)} typologies")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        main(sys.argv[1], pathlib.Path(sys.argv[2]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(sys.argv[1], pathlib.Path(temporary))
