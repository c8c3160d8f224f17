"""Springs and tendons against closed forms, and a bar of attached parts against the whole.

period:     T = 2 pi sqrt(m / k), of a cube each of whose nodes hangs on a spring in proportion to its mass, so that it moves as
            a point mass; steps of omega dt change it by about (omega dt)^2 / 24 in Verlet,
extension:  u = m g / k of the same cube,
tendon:     a load W slides along a tendon of tension T to where both segments lie at the angle a with the vertical,
            cos a = W / (2 T), whatever the heights of the two supports,
parts:      a clamped bar cut in three and attached exactly at matching nodes sags as the whole does.
"""

from functools import partial

import numpy as np

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.fem.reference import lumped_masses
from taisoft.scene.locate import locate

from .record import GRAVITY, LAWS, Case, near, scene

OMEGA, START = 20.0, 0.05  # [rad/s], [m]
STEP = 1e-3  # [s]
PERIODS = {"velocity_verlet": 1.0 - (OMEGA * STEP) ** 2 / 24.0, "implicit_midpoint": 1.0 + (OMEGA * STEP) ** 2 / 12.0}
TENSION, TOP = 0.9, 0.25  # of the weight; height of the point of the load above its middle [m]


def _load(gravity: bool, law: str) -> ts.Scene:
    made = scene(gravity)
    mesh = ts.box_mesh((1, 1, 1), (0.5, 0.5, 0.5))
    made.add_body(mesh, ts.Material(law=LAWS[law], young=1e6), name="load")
    made.add_obstacle(ts.HalfSpace((0.0, 9.0, 0.0), (0.0, -1.0, 0.0)), name="ceiling")
    return made


def _hang_on_springs(made: ts.Scene) -> None:
    for node, (x, mass) in enumerate(zip(made.body("load").rest_positions, lumped_masses(made))):
        made.add_spring(("load", node), ("ceiling", x + (0.0, 2.0, 0.0)), mass * OMEGA**2)


def period(law: str, integrator: str, _reference: dict, arch: str):
    """Time between the first two downward crossings of the rest height, interpolated, over that of the exact motion."""
    made = _load(False, law)
    _hang_on_springs(made)
    tight = {} if integrator in EXPLICIT else {"newton_tolerance": 1e-10}
    with ts.Simulator(made, dt=STEP, integrator=integrator, precision="f64", arch=arch, **tight) as sim:
        rest, heights = sim.positions(), [START]
        sim.set_state(positions=rest + (0.0, START, 0.0))
        for _ in range(round(3.0 * np.pi / OMEGA / STEP)):
            sim.step()
            heights.append(float((sim.positions() - rest)[0, 1]))
    y = np.array(heights)
    k = np.flatnonzero((y[:-1] > 0.0) & (y[1:] <= 0.0))
    crossings = STEP * (k + y[k] / (y[k] - y[k + 1]))
    exact = 2.0 * np.pi / OMEGA
    yield near("period, with the integrator's own error [s]", crossings[1] - crossings[0], exact * PERIODS[integrator], 1e-6)
    yield near("period [s]", crossings[1] - crossings[0], exact)


def extension(law: str, _reference: dict, arch: str):
    """How far the cube hangs below its start."""
    made = _load(True, law)
    _hang_on_springs(made)
    drop = made.body("load").rest_positions - ts.solve_static(made, tolerance=1e-9, arch=arch).positions("load")
    yield near("extension [m]", drop[:, 1].mean(), GRAVITY / OMEGA**2, 1e-6)


def tendon(law: str, heights: tuple[float, float], _reference: dict, arch: str):
    """Place of the point where a tendon carries a load between two supports."""
    made, left, right = _load(True, law), np.array([-1.0, heights[0]]), np.array([1.3, heights[1]])
    weight = made.body("load").mass * GRAVITY
    nodes, weights, _ = locate(made.body("load"), np.array([(0.0, TOP, 0.0)]))
    ends = [("ceiling", (*end, 0.0)) for end in (left, right)]
    made.add_tendon([ends[0], ("load", (0.0, TOP, 0.0)), ends[1]], TENSION * weight)
    x = ts.solve_static(made, tolerance=1e-10, arch=arch).positions("load")
    cosine = 1.0 / (2.0 * TENSION)
    sine = np.sqrt(1.0 - cosine**2)
    length = 0.5 * ((right - left)[0] / sine + (left - right)[1] / cosine)  # of the left segment
    expected = left + length * np.array([sine, -cosine])
    found = weights[0] @ x[nodes[0]]
    for axis, name in enumerate("xy"):
        yield near(f"{name} of the load's point [m]", found[axis], expected[axis], 1e-6)


def _bar(parts: int, law: str) -> ts.Scene:
    made, size = scene(True), (0.9 / parts, 0.1, 0.1)
    material = ts.Material(law=LAWS[law], young=1e6)
    for k in range(parts):
        mesh = ts.box_mesh((9 // parts, 1, 1), size, ((k + 0.5) * size[0], 0.0, 0.0), pattern="six")
        body = made.add_body(mesh, material, name=f"part{k}", order=2)
        if k == 0:
            body.fix(lambda X: X[:, 0] < 1e-9)
        else:
            made.attach(body.name, lambda X, x=k * size[0]: X[:, 0] < x + 1e-9, f"part{k - 1}")
    return made


def attached_parts(law: str, _reference: dict, arch: str):
    """Lowest point of the bar in parts, against that of the whole."""
    lowest = []
    for parts in (1, 3):
        made = _bar(parts, law)
        x = ts.solve_static(made, tolerance=1e-9, arch=arch).positions(f"part{parts - 1}")
        lowest.append(-float(x[:, 1].min()))
    yield near("deflection [m]", lowest[1], lowest[0], 1e-6)


CASES = (
    Case("attached_parts", "SNH", "order 2", partial(attached_parts, "SNH"), closed_form=True),
    *(Case("spring_mass", "SNH", name, partial(period, "SNH", name), closed_form=True) for name in PERIODS),
    Case("spring_mass", "SNH", "at rest", partial(extension, "SNH"), closed_form=True),
    Case("tendon", "SNH", "level supports", partial(tendon, "SNH", (1.5, 1.5)), closed_form=True),
    Case("tendon", "SNH", "supports 0.4 m apart", partial(tendon, "SNH", (1.5, 1.9)), closed_form=True),
)
