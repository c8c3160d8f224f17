"""Draws the pictures of the tutorials: `python docs/make_pictures.py [NAME ...]` writes docs/pictures/NAME.png."""

import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "assets")]

from make_gallery import film  # noqa: E402

import taisoft as ts  # noqa: E402
from taisoft.files import write_bytes  # noqa: E402
from taisoft.output.frames import SMALLEST, png_bytes  # noqa: E402

GROUND = ts.HalfSpace((0, 0, 0), (0, 1, 0))


def drop() -> np.ndarray:
    scene = ts.Scene()
    rubber = ts.Material(young=1e5, poisson=0.4, density=1000.0)
    scene.add_body(ts.ball_mesh(radius=0.1, cells=6), rubber, name="ball", position=(0, 0.5, 0))
    scene.add_obstacle(GROUND, name="ground", friction=0.5)
    return strip(scene, 1 / 200, (0.0, 0.2, 0.3, 1.0), 50, (210, 300), ((0, 0.29, 0), 1.75, 32.0, 10.0))


def ring() -> np.ndarray:
    n, m, big, small = 48, 20, 0.12, 0.045
    u, v = np.meshgrid(2 * np.pi * np.arange(n) / n, 2 * np.pi * np.arange(m) / m, indexing="ij")
    x = [(big + small * np.cos(v)) * np.cos(u), small * np.sin(v), -(big + small * np.cos(v)) * np.sin(u)]
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    q = np.stack([(a % n) * m + b % m for a, b in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))], -1).reshape(-1, 4)
    surface = ts.SurfaceMesh(np.stack(x, -1).reshape(-1, 3), np.concatenate([q[:, [0, 1, 2]], q[:, [0, 2, 3]]]))
    scene = ts.Scene()
    soft = ts.Material(young=5e4, poisson=0.4)
    mesh = ts.tetrahedralize(surface, edge_length=0.03)
    turned = mesh.vertices @ np.array([[1, 0, 0], [0, 0.6, -0.8], [0, 0.8, 0.6]]).T
    scene.add_body(ts.TetMesh(turned, mesh.tets), soft, name="ring", position=(0, 0.3, 0))
    scene.add_obstacle(GROUND, name="ground", friction=0.5)
    return strip(scene, 1 / 200, (0.0, 0.16, 0.3, 0.8), 50, (230, 230), ((0, 0.19, 0), 1.45, 32.0, 14.0), "body")


def identify() -> np.ndarray:
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    mesh = ts.box_mesh(cells=(11, 2, 2), size=(4.0, 1.0, 1.0))
    scene.add_body(mesh, ts.Material(young=3e6, mass_damping=2.0), name="beam").fix(lambda X: X[:, 0] < -1.99)
    return strip(scene, 1 / 60, (0.0, 8.0), 30, (420, 260), ((0, -0.35, 0), 9.5, 28.0, 14.0))


def strip(scene, dt, moments, fps, size, view, colour="stress") -> np.ndarray:
    with ts.Simulator(scene, dt=dt) as sim:
        picture, result = film(sim, moments, size, view, moments[-1], fps, colour=colour)
    if result.status != "ok":
        raise SystemExit(f"the run is {result.status}: {'; '.join(result.problems)}")
    return picture


PICTURES = {"drop": drop, "ring": ring, "identify": identify}


def main(names: list[str]) -> None:
    for name in names or PICTURES:
        data = png_bytes(PICTURES[name](), SMALLEST)
        write_bytes(Path(__file__).parent / "pictures" / f"{name}.png", data)
        print(f"{name}: {len(data):,} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
