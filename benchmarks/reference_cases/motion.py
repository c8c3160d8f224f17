"""Motion on a fixed mesh, against exactly integrated paths: order of accuracy, energies, momenta.

Orders come from the largest error over the whole path at two steps, the second half the first. The last problem refines the mesh
and shows the discretisation error in space.
"""

from collections import namedtuple
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, INTEGRATORS, SECOND_ORDER
from taisoft.errors import SimulationError
from taisoft.fem.reference import lumped_masses

from .record import LAWS, Case, Check, face, label, material, near, nearest, order, reported, scene, small

ORDER = {name: 2 if name in SECOND_ORDER else 1 for name in INTEGRATORS}


@dataclass
class Path:
    """A body at the frames of a run, the start left out: x, v (k,n,3) [m, m/s]; kinetic, elastic, gravity (k,) [J]."""

    x: np.ndarray
    v: np.ndarray
    kinetic: np.ndarray
    elastic: np.ndarray
    gravity: np.ndarray


def simulator(s: ts.Scene, integrator: str, arch: str, linear_tolerance: float | None = None) -> ts.Simulator:
    """A simulator in f64; implicit steps are solved to 1e-10."""
    tight = {} if integrator in EXPLICIT else {"newton_tolerance": 1e-10, "linear_tolerance": linear_tolerance}
    return ts.Simulator(s, dt=1e-4, integrator=integrator, precision="f64", arch=arch, **tight)


def follow(sim: ts.Simulator, steps: int, seconds: float, fps: int) -> Path:
    """Run from the start with `steps` steps a second. Raises SimulationError unless every step converged."""
    sim.reset()
    sim.dt = 1.0 / steps
    frames = []

    def keep(s: ts.Simulator, index: int, report) -> None:
        energies = s.energies()
        frames.append((s.positions(), s.velocities(), energies.kinetic, energies.elastic, energies.gravity))

    report = sim.run(seconds, keep, fps)
    if report.status == "failed" or not all(step.converged for step in report.step_reports):
        raise SimulationError("; ".join(report.problems))
    return Path(*(np.array(column) for column in zip(*frames[1:])))


def _distance(path: np.ndarray, exact) -> float:
    """Largest distance of a path (k,3) to an exact one, which may go on."""
    return float(np.linalg.norm(path - np.array(exact)[: len(path)], axis=1).max())


def _path_order(integrator: str, starts_free: bool) -> int:
    """Order of the positions. Without a force at the start, symplectic Euler's are those of Verlet."""
    return 2 if starts_free and integrator == "symplectic_euler" else ORDER[integrator]


@dataclass(frozen=True)
class Exact:
    """A problem whose exact path on its own mesh is tabulated; the probe is the node nearest to a point."""

    name: str
    build: Callable[[dict, str], ts.Scene]  # (reference, law) -> scene of one body
    probe: tuple[float, float, float]
    fps: int
    steps: dict[bool, int]  # steps a second of the coarser run for the order, by whether the integrator is explicit
    starts_free: bool  # no force acts at the start

    def start(self, reference: dict, law: str) -> tuple[dict, ts.Scene, int]:
        """The tabulated path (t, probe_x, probe_v, kinetic, elastic, perhaps gravity), the scene, and the probe's node."""
        s = self.build(reference, law)
        return reference["value"].get(f"{law}_lumped", reference["value"]), s, nearest(s.bodies[0].rest_positions, self.probe)[0]

    def orders(self, law: str, integrator: str, seconds: float, reference: dict, arch: str) -> Iterable[Check]:
        """Observed orders of an integrator's positions and velocities over the first `seconds`."""
        (table, s, node), steps, errors = self.start(reference, law), self.steps[integrator in EXPLICIT], []
        with simulator(s, integrator, arch) as sim:
            for n in (steps, 2 * steps):
                path = follow(sim, n, seconds, self.fps)
                x, v = path.x[:, node], path.v[:, node]
                errors.append((_distance(x, table["probe_x"]), _distance(v, table["probe_v"])))
        (coarse_x, coarse_v), (fine_x, fine_v) = errors
        expected = _path_order(integrator, self.starts_free)
        yield reported(f"largest error of the probe, dt = 1/{2 * steps} s [m]", fine_x)
        yield order("order in dt of the position", coarse_x, fine_x, expected, 0.12)
        if expected != ORDER[integrator]:
            yield order("order in dt of the velocity", coarse_v, fine_v, ORDER[integrator], 0.12)

    def exact_path(self, law: str, seconds: float, limit: float, reference: dict, arch: str) -> Iterable[Check]:
        """Verlet with steps of 10 us, whose error is below the table's: probe, velocity, energies at all times."""
        table, s, node = self.start(reference, law)
        with simulator(s, "velocity_verlet", arch) as sim:
            path = follow(sim, 100_000, seconds, self.fps)
        k = len(path.x)
        for name, measured in (("probe_x", path.x[:, node]), ("probe_v", path.v[:, node])):
            exact = np.array(table[name])[:k]
            size = np.linalg.norm(exact - exact[0], axis=1).max()
            yield small(f"{name}: largest error / excursion", _distance(measured, exact) / size, limit)
        for name in ("kinetic", "elastic", "gravity"):
            if name in table:
                exact = np.array(table[name])[:k]
                error = np.abs(getattr(path, name) - exact).max()
                yield small(f"{name} energy: largest error / largest value", error / np.abs(exact).max(), limit)


def _falling_beam(reference: dict, law: str, cells=None) -> ts.Scene:
    s, geometry = scene(gravity=True), reference["geometry"]
    s.add_body(ts.box_mesh(cells or geometry["cells"], geometry["box"]), material(reference, law)).fix(face(0, -2.0))
    return s


def _breathing_bar(reference: dict, law: str) -> ts.Scene:
    s, size = scene(), reference["geometry"]["box"]
    mesh = ts.box_mesh(reference["geometry"]["cells"], size, (size[0] / 2, 0.0, 0.0))
    s.add_body(mesh, material(reference, law), velocity=mesh.vertices * (2.0, 0.0, 0.0)).fix(face(0, 0.0))
    return s


BEAM = Exact("beam_fall_semidiscrete", _falling_beam, (2, 0, 0), 10, {True: 3200, False: 400}, starts_free=False)
BAR = Exact("breathing_bar", _breathing_bar, (1, 0.25, 0.25), 20, {True: 3200, False: 800}, starts_free=True)


# --- spinning block -------------------------------------------------------------------------------------------------


def _spinning_block(reference: dict, law: str) -> ts.Scene:
    mesh = ts.box_mesh(reference["geometry"]["cells"], reference["geometry"]["box"])
    s = scene()
    s.add_body(mesh, material(reference, law), velocity=np.cross((1.0, 2.0, 6.0), mesh.vertices) + (0.5, 1.0, 0.0))
    return s


Drift = namedtuple("Drift", "P L energy probe")  # largest relative changes of momenta and energy, largest error of the probe [m]


def _drift(path: Path, s: ts.Scene, law: str, reference: dict) -> Drift:
    value, mass = reference["value"], lumped_masses(s)[None, :, None]
    node = nearest(s.bodies[0].rest_positions, (0.5, 0.375, 0.25))[0]
    P, L = (mass * path.v).sum(axis=1), (mass * np.cross(path.x, path.v)).sum(axis=1)
    return Drift(
        float(np.linalg.norm(P - value["P"], axis=1).max() / np.linalg.norm(value["P"])),
        float(np.linalg.norm(L - value["L"], axis=1).max() / np.linalg.norm(value["L"])),
        float(np.abs(path.kinetic + path.elastic - value["energy"]).max() / value["energy"]),
        _distance(path.x[:, node], value["probe_x"][f"{law}_lumped"]),
    )


def spin_block_exact(law: str, reference: dict, arch: str):
    """Fine Verlet steps: constants and path."""
    s = _spinning_block(reference, law)
    with simulator(s, "velocity_verlet", arch) as sim:
        path = follow(sim, 100_000, 1.0, 10)
    drift, elastic = _drift(path, s, law, reference), np.array(reference["value"]["elastic"][f"{law}_lumped"])
    yield small("momentum P, relative drift", drift.P, 1e-10)
    yield small("angular momentum L, relative drift", drift.L, 1e-10)
    yield small("energy, relative drift", drift.energy, 1e-7)
    yield small("largest error of the probe [m]", drift.probe, 1e-7)
    error = np.abs(path.elastic - elastic).max() / elastic.max()
    yield small("elastic energy: largest error / largest value", error, 1e-6)


CONSERVES = {"symplectic_euler", "velocity_verlet", "implicit_midpoint"}  # L, and the energy but for a wobble


def spin_block(integrator: str, reference: dict, arch: str):
    """Order of an integrator's path, and which constants it keeps; what drifts, drifts with the integrator's order."""
    s, expected = _spinning_block(reference, "SNH"), ORDER[integrator]
    steps = 3200 if integrator in EXPLICIT else 800
    # what a linear solve leaves over would change P and L
    with simulator(s, integrator, arch, linear_tolerance=1e-12) as sim:
        coarse, fine = (_drift(follow(sim, n, 1.0, 10), s, "SNH", reference) for n in (steps, 2 * steps))
    yield small("momentum P, relative drift", fine.P, 1e-9)
    if integrator in CONSERVES:
        yield small("angular momentum L, relative drift", fine.L, 1e-9)
    else:
        yield reported(f"L, relative drift, dt = 1/{2 * steps} s", fine.L)
        yield order("order in dt of the drift of L", coarse.L, fine.L, expected, 0.12)
    yield reported(f"energy, relative drift, dt = 1/{2 * steps} s", fine.energy)
    # BDF2's dissipation is of third order and mixes with the second-order wobble
    limit = None if integrator == "bdf2" else 0.2
    yield order("order in dt of the energy's drift", coarse.energy, fine.energy, expected, limit)
    yield order("order in dt of the position", coarse.probe, fine.probe, _path_order(integrator, True), 0.12)


# --- the beam itself, converged in space ----------------------------------------------------------------------------


NESTED = ((11, 2, 2), (22, 4, 4), (44, 8, 8))


def beam_fall_converged(law: str, reference: dict, arch: str):
    """Lowest point of the first swing on three meshes: how far each is from the converged one, and where they lead."""
    best, lowest = reference["value"]["best_estimate"][law], []
    for cells in NESTED:
        s = _falling_beam(reference, law, cells)
        node = nearest(s.bodies[0].rest_positions, (2, 0, 0))[0]
        with simulator(s, "velocity_verlet", arch) as sim:
            y = follow(sim, 1200, 1.2, 200).x[:, node, 1]
        t, low = parabola_vertex(y, 1 / 200)
        lowest.append(low)
        yield near(f"lowest uy of the tip, {label(cells)} [m]", low, best["y_min"])
        yield near(f"time of the lowest point, {label(cells)} [s]", t, best["t_min"])
    first, last = lowest[1] - lowest[0], lowest[2] - lowest[1]
    limit = lowest[2] + last * last / (first - last)  # of a geometric sequence
    uncertainty = reference["uncertainty"]["y_min"] / abs(best["y_min"])
    yield near("lowest uy of the tip, extrapolated [m]", limit, best["y_min"], uncertainty)


def parabola_vertex(y: np.ndarray, spacing: float) -> tuple[float, float]:
    """Time and value of the lowest point of y, sampled at spacing, 2 spacing, ...: a parabola through three samples."""
    k = int(np.argmin(y[:-1]))
    a, b, c = y[k - 1 : k + 2]
    shift = 0.5 * (a - c) / (a - 2 * b + c)
    return (k + 1 + shift) * spacing, b - 0.25 * (a - c) * shift


# the tests measure the midpoint rule in the spinning block
QUICK_ORDERS = ("symplectic_euler", "velocity_verlet", "implicit_euler", "bdf2")


def _beam_cases():
    for law, seconds, limit in (("SNH", 2.0, 1e-7), ("COR", 2.0, 1e-7), ("SVK", 0.8, 1e-5)):
        yield Case(BEAM.name, law, "11x2x2 exact path", partial(BEAM.exact_path, law, seconds, limit))
        for name in INTEGRATORS:
            if law != "SNH" and name == "linearly_implicit_euler":
                continue  # its one Newton step is implicit Euler's first
            run = partial(BEAM.orders, law, name, min(seconds, 1.0))
            yield Case(BEAM.name, law, f"11x2x2 {name}", run, law != "SNH" or name not in QUICK_ORDERS)


def _bar_cases():
    yield Case(BAR.name, "SNH", "4x2x2 exact path", partial(BAR.exact_path, "SNH", 0.5, 1e-6), fine=True)
    for name in INTEGRATORS:
        yield Case(BAR.name, "SNH", f"4x2x2 {name}", partial(BAR.orders, "SNH", name, 0.5), name != "velocity_verlet")


def _spin_cases():
    for law in LAWS:
        yield Case("spin_block", law, "4x3x2 exact path", partial(spin_block_exact, law), law != "SNH")
    for name in INTEGRATORS:
        yield Case("spin_block", "SNH", f"4x3x2 {name}", partial(spin_block, name), name != "implicit_midpoint")


CASES = (
    *_beam_cases(),
    *_bar_cases(),
    *_spin_cases(),
    *(Case("beam_fall_converged", law, "11x2x2 to 44x8x8", partial(beam_fall_converged, law), True) for law in ("SNH", "COR")),
)
