"""A soft finger with a stiff layer below curls when the channel in it is inflated.

0.4 x 0.08 x 0.06 m with a closed channel of 0.36 x 0.02 x 0.02 m, 1,110 quadratic tets in two regions: 2 MPa in the lowest
quarter, 0.1 MPa above, nu = 0, stable neo-Hookean. The pressure in the channel follows key frames, from 100 Pa to 20 kPa within
1.5 s; mass damping brings the finger to rest.

`check` compares the curvature of statics at 100 Pa with beam theory: the pressure on the channel's end pulls beside the neutral
axis of both materials, M = p A (y - y_0). At 20 kPa the end must have turned as far as in statics, 4 % less than on the mesh
refined once.
"""

import numpy as np

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 20, "seconds": 4.0, "fps": 20.0, "precision": "f64"}

CELL, CELLS = 0.02, (20, 4, 3)  # [m] edge of a cell, and their numbers
YOUNG = {"stiff": 2e6, "soft": 1e5}  # [Pa], from below
LOW, HIGH, RISE = 100.0, 2e4, 1.5  # [Pa] at the start and at the end, [s]
TURN = 0.24733  # of the end at 20 kPa [rad]


def build() -> ts.Scene:
    """The finger, straight and at rest, with air of LOW pressure in its channel."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    length, height, width = (n * CELL for n in CELLS)
    box = ts.box_mesh(CELLS, (length, height, width), (length / 2, 0.0, 0.0))
    middle = np.abs(box.vertices[box.tets].mean(axis=1) - (length / 2, CELL / 2, 0.0))
    solid = (middle > (length / 2 - CELL, CELL / 2, CELL / 2)).any(axis=1)
    used, tets = np.unique(box.tets[solid], return_inverse=True)
    vertices, tets = box.vertices[used], tets.reshape(-1, 4)
    low = vertices[tets].mean(axis=1)[:, 1] < -CELL
    mesh = ts.TetMesh(vertices, tets, regions=low.astype(int), region_names={0: "soft", 1: "stiff"})
    materials = {name: ts.Material(young=young, poisson=0.0, mass_damping=10.0) for name, young in YOUNG.items()}
    finger = scene.add_body(mesh, materials, name="finger", order=2)
    finger.fix(lambda X: X[:, 0] < 1e-9)
    rising = ts.KeyFrames((0.0, RISE), values=(LOW, HIGH), smooth=True)
    finger.add_cavity(inner, pressure=rising, name="air")
    return scene


def inner(centroids: np.ndarray) -> np.ndarray:
    """The channel's triangles."""
    length = CELLS[0] * CELL
    return (np.abs(centroids - (length / 2, CELL / 2, 0.0)) < (length / 2 - CELL / 2, CELL, CELL)).all(axis=1)


def curvature(pressure: float) -> float:
    """Curvature [1/m] by beam theory; layers of one cell from below, the third of them with the channel."""
    E = np.array([YOUNG["stiff"], *[YOUNG["soft"]] * 3])
    y, area = CELL * np.array([-1.5, -0.5, 0.5, 1.5]), CELL**2 * np.array([3.0, 3.0, 2.0, 3.0])
    neutral = (E * area @ y) / (E @ area)
    bending = float(E @ (area * (CELL**2 / 12 + (y - neutral) ** 2)))
    return pressure * CELL**2 * (CELL / 2 - neutral) / bending


def turn(X: np.ndarray, x: np.ndarray, at: float) -> float:
    """Angle [rad] by which the section at rest position `at` [m] has turned down."""
    on = np.abs(X[:, 0] - at) < 1e-9
    up = ((X[on, 1] - X[on, 1].mean())[:, None] * x[on]).sum(axis=0)
    return float(np.arctan2(up[0], up[1]))


def check(sim: ts.Simulator, result) -> None:
    """The finger curls as theory says at a low pressure, and as far as it should at a high one."""
    X, length = sim.scene.body("finger").rest_positions, CELLS[0] * CELL
    slightly = ts.solve_static(sim.scene, time=0.0).positions("finger")
    found = (turn(X, slightly, 0.7 * length) - turn(X, slightly, 0.3 * length)) / (0.4 * length)
    ratio = found / curvature(LOW)
    assert abs(ratio - 1.0) < 4e-3, f"the curvature at {LOW:g} Pa is {found:.6f} / m, {ratio:.4f} times the theory's"
    turned = turn(X, sim.positions("finger"), length)
    assert abs(turned / TURN - 1.0) < 4e-3, f"the end has turned by {turned:.4f} rad, not {TURN:.4f}"
    speed = np.linalg.norm(sim.velocities("finger"), axis=1).max()
    assert speed < 1e-3, f"it still moves, at {speed:.2e} m/s"
