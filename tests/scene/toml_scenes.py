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

BEAM_TOML = f"""
[solver]
dt = {1 / 240!r}
integrator = "symplectic_euler"
seconds = 0.1
fps = 30

[bodies.beam]
material = {{ young = 1e5 }}
mesh = {{ shape = "box", cells = [4, 1, 1], size = [4, 2, 2] }}

[[bodies.beam.fix]]
nodes = {{ half_space = {{ point = [-1.99, 0, 0], normal = [1, 0, 0] }} }}
"""

MESH = '[bodies.a]\nmaterial = {{}}\nmesh = {{ file = "{}" }}\n'


def path_data(path):
    """Of a path, its frames and where what it leads starts."""
    frames = getattr(path, "frames", path)
    names = ("times", "translations", "rotations", "pivot", "smooth", "release", "values")
    said = {name: np.asarray(getattr(frames, name)).tobytes() for name in names} if path else None
    return said and said | {name: getattr(path, name).tobytes() for name in ("starts", "center") if hasattr(path, name)}


def points_data(connection) -> list:
    """Names and positions of the points of a spring or tendon."""
    return [(point.owner, point.position.tobytes()) for point in connection.points]


def data(scene: ts.Scene) -> dict:
    """What a scene says, as bytes and plain values that compare bit for bit."""
    bodies = []
    for b in scene.bodies:
        arrays = (b.rest_positions, b.nodes.elements, b.mesh.tets, b.mesh.surface, b.position, b.velocity)
        fixed = [(c.nodes.tolist(), c.axes.tolist()) for c in b.constraints if c.path is None]
        moved = [(c.nodes.tolist(), c.axes.tolist(), path_data(c.path)) for c in b.constraints if c.path is not None]
        chosen = [t.triangles.tolist() for t in (*b.tractions, *b.pressures)] + [f.nodes.tolist() for f in b.forces]
        chosen += [(c.name, c.given, c.triangles.tolist()) for c in b.cavities]
        values = [path_data(load.path) or (load.value.shape, load.value.tobytes()) for load in b.loads]
        numbers = (b.name, b.order, b.quadrature_degree, b.dilatation, b.collision, b.material)
        by_tet = {name: own.tobytes() for name, own in b.composition.by_tet.items()}
        regions = b.mesh.regions if b.mesh.regions is None else (b.mesh.regions.tolist(), b.mesh.region_names)
        bodies.append((numbers, [a.tobytes() for a in arrays], fixed, moved, chosen, values, by_tet, regions))
    obstacles = []
    for o in scene.obstacles:
        fields = {name: np.asarray(value).tobytes() for name, value in vars(o.shape).items()}
        obstacles.append((o.name, type(o.shape), fields, o.friction, o.restitution, path_data(o.path)))
    connections = [
        *((s.name, points_data(s), s.stiffness, s.rest_length, s.damping) for s in scene.springs),
        *((t.name, points_data(t), path_data(t.path) or float(t.value)) for t in scene.tendons),
        *((a.name, a.a, a.nodes.tolist(), a.b, a.stiffness, a.damping) for a in scene.attachments),
    ]
    own = (scene.gravity.tobytes(), scene.collision, scene.allow_initial_overlap, scene.contact_forces)
    pairs = scene.contact_pairs
    return {"bodies": bodies, "obstacles": obstacles, "own": own, "pairs": pairs, "connections": connections}


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
