"""Scene files that several test files read, and scenes compared bit for bit."""

from pathlib import Path

import numpy as np
from hypothesis import strategies as st

import taisoft as ts
from tests.cli.command import write

TEXT = """
gravity = [0, -9.81, 0]
allow_initial_overlap = true

[collision]
margin = 0.01

[solver]
dt = 0.01
integrator = "implicit_euler"
fps = "none"
newton_tolerance = 1e-4

[materials.rubber]
young = 1e5
density = 500

[bodies.beam]
material = "rubber"
mesh = { shape = "box", cells = [2, 1, 1], size = [2, 1, 1] }
position = [0, 1, 0]

[[bodies.beam.fix]]
nodes = { box = { min = [-1, -1, -1], max = [-1, 1, 1] } }
axes = "xz"

[[bodies.beam.move]]
nodes = [8, 9]
axes = "y"
path = { times = [0, 1], translations = [[0, 0, 0], [0, 0.5, 0]], release = true }

[[bodies.beam.traction]]
triangles = { half_space = { point = [0, -0.49, 0], normal = [0, 1, 0] } }
traction = [0, 2000, 0]

[[bodies.beam.force]]
nodes = "all"
force = [0, 0, 1]

[bodies."the ball"]
mesh = { shape = "ball", radius = 0.4, cells = 2 }
material = { friction = 0.1 }
position = [0, 3, 0]
order = 2

[obstacles.ground]
shape = "half_space"
point = [0, -5, 0]
normal = [0, 2, 0]
friction = 0.9

[obstacles.pin]
shape = "capsule"
a = [5, 0, 0]
b = [6, 0, 0]
radius = 0.1
path = { times = [0, 2], rotations = [[0, 0, 0], [0, 0, 6.28]], pivot = [5, 0, 0] }

[[contacts]]
between = ["beam", "ground"]
friction = 0.3
"""

MESH = '[bodies.a]\nmaterial = {{}}\nmesh = {{ file = "{}" }}\n'


# of records, what a file does not hold: how a mesh was made, and selection functions
NOT_STORED = ("source", "recipe", "warnings", "flipped", "where", "_given_twist")


def data(value):
    """A scene, or a part of one, as bytes and plain values that compare bit for bit."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        pairs = ((sorted(key) if isinstance(key, frozenset) else key, own) for key, own in value.items())
        return {str(key): data(own) for key, own in pairs if key not in NOT_STORED}
    if isinstance(value, (list, tuple)):
        # a file holds what fixes nodes before what moves them
        return [data(own) for own in sorted(value, key=lambda own: getattr(own, "path", None) is not None)]
    return (type(value).__name__, data(vars(value))) if hasattr(value, "__dict__") else value


def read(tmp_path: Path, text: str, **options) -> tuple[ts.Scene, dict]:
    return ts.read_scene(write(tmp_path / "scene.toml", text), **options)


def there_and_back(path: Path, scene: ts.Scene, solver: dict) -> None:
    ts.write_scene(path, scene, solver, overwrite=True)
    scene_again, solver_again = ts.read_scene(path)
    assert data(scene_again) == data(scene)
    assert solver_again == solver


def turned_box() -> ts.TetMesh:
    """A mesh that no shape function makes, its coordinates full of digits."""
    box, (c, s) = ts.box_mesh((1, 2, 1), (1.0, 1.0, 1.0)), (np.cos(0.3), np.sin(0.3))
    return ts.TetMesh(box.vertices @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), box.tets)


TURNED = turned_box()


def floats(*limits, **rules):
    """Without the smallest numbers: compiled code may set the processor to drop them."""
    return st.floats(*limits, allow_subnormal=False, **rules)
