"""Companions: simulators that accompany a run with other settings, or on another mesh, from the same state.

All of them take whole steps, and meet the run at the times of the comparisons.
"""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from taisoft.dynamics.contact import TOLERANCE as CONTACT_TOLERANCE
from taisoft.dynamics.implicit_stages import DEFAULT_TOLERANCE
from taisoft.errors import SimulationError, no_memory
from taisoft.estimation.comparison import shared_nodes
from taisoft.estimation.first_choice import STABLE_FRACTION
from taisoft.scene.refine import refined, with_order
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Body, Scene
from taisoft.stability import constrained_axes, stable_dt

if TYPE_CHECKING:
    from taisoft.simulator import Simulator

MIN_STEPS = 32  # of a run whose error is estimated by larger steps
TIGHTER = 0.1  # a companion's tolerances over those of the run; much less takes many iterations, and in f32 meets rounding
REFINED, ORDER = "refined", "order"  # meshes of a companion, besides a scene
MESHES = (REFINED, ORDER)
MIN_WIDTH_RATIO = 1.2  # of two meshes: below it chance rules their difference
PLACED = 1e-2  # largest distance of bodies in two scenes, over the size of the first
SAME_STATE = 1e-6  # largest distance of shared nodes at the start, over the size of the scene


class Companion:
    """One companion. Nodes `own` of the run are compared with nodes `theirs` of the companion.

    failed: the reason, if it did, else ""; what: in words; ratio: of its step, or mesh width, over the run's; steps: taken while
    the run takes `per` steps. nodes: those of both, and the vector [m] from where the former start to the latter.
    """

    def __init__(self, what: str, sim: "Simulator", ratio: float, steps=1, per=1, nodes=(slice(None), slice(None), 0.0)):
        self.what, self.sim, self.ratio, self.steps, self.per = what, sim, ratio, steps, per
        self.own, self.theirs, self._shift = nodes
        self.failed = ""
        self.reports = self.unconverged = 0
        self._start = sim.step_count

    def follow(self, run_steps: int) -> None:
        """Take the steps that belong to `run_steps` steps of the run."""
        end = self._start + run_steps * self.steps // self.per
        try:
            while self.sim.step_count < end and not self.failed:
                report = self.sim.advance(end - self.sim.step_count)
                self.reports += 1
                self.unconverged += not report.converged
        except (SimulationError, MemoryError) as error:
            self.failed = str(no_memory("its next step", error) if isinstance(error, MemoryError) else error)

    def positions(self) -> np.ndarray:
        """Positions of the compared nodes (k,3) [m], had they started where the run's did."""
        return self.sim.positions()[self.theirs] - self._shift


def other_steps(sim: "Simulator", steps: int) -> Iterator[Companion]:
    """Companions of a run of `steps` steps: with twice and four times the step, but half of it for few steps, or where explicit
    ones would be unstable."""
    if steps >= MIN_STEPS and not (sim.settings.explicit and 4.0 * sim.dt > STABLE_FRACTION * sim.stable_dt):
        for ratio in (2, 4):
            yield Companion(f"dt = {ratio * sim.dt:.4g} s", sim._copy(dt=ratio * sim.dt, budget=None), ratio, per=ratio)
    else:
        yield Companion(f"dt = {0.5 * sim.dt:.4g} s", sim._copy(dt=0.5 * sim.dt, budget=None), 0.5, steps=2)


def tighter(sim: "Simulator") -> Companion | None:
    """A companion with tighter tolerances of all solvers; None if nothing is solved."""
    given, precision = sim.settings, sim.settings.precision
    used = {"linear_tolerance": given.linear_tolerance} if given.linear_tolerance else {}
    if not given.explicit:
        used["newton_tolerance"] = given.newton_tolerance or DEFAULT_TOLERANCE[precision]
    if sim.touches:
        used["contact_tolerance"] = given.contact_tolerance or CONTACT_TOLERANCE[precision]
    tight = {name: TIGHTER * value for name, value in used.items()}
    return Companion(f"tolerances x {TIGHTER:g}", sim._copy(**tight, budget=None), TIGHTER) if tight else None


def on_mesh(sim: "Simulator", mesh: str | Scene) -> tuple[Companion, list[float | None]]:
    """A companion on another mesh: "refined", "order" (the other order of elements) or the scene itself on another mesh.

    Also return its mesh widths over those of the run, one a body, None where the order differs and of rigid bodies. Raises
    SceneError or SimulationError if the companion cannot be made, does not start as the run does, or cannot show a body's error.
    """
    scene = other_mesh(sim, mesh)
    ratios = [_width_ratio(*bodies) for bodies in zip(sim.scene.bodies, scene.bodies)]
    dt, steps = sim.dt, 1
    settings = sim._arguments()
    if sim.settings.explicit:
        limit = STABLE_FRACTION * stable_dt(scene, sim.settings.integrator == "velocity_verlet")
        steps = max(1, math.ceil(dt / limit))
    other = type(sim)(scene, **settings | {"dt": dt / steps, "budget": None})
    try:
        nodes = shared_nodes(*_nodes(sim), *_nodes(other))
        shift = _placement(other)[nodes[1]] - _placement(sim)[nodes[0]]
        _check_start(sim, other, nodes, shift)
        _check_free(sim.scene, nodes[0])
    except BaseException:
        other.close()
        raise
    what = mesh if isinstance(mesh, str) else f"{sum(b.mesh.n_tets for b in scene.bodies):,} tets"
    return Companion(f"mesh: {what}", other, 1.0, steps, nodes=(*nodes, shift)), ratios


def _width_ratio(own: Body, other: Body) -> float | None:
    """Mesh width of a body of a companion over that of the run; None if the orders differ, or the body is rigid. SimulationError
    if
    it is near 1."""
    if own.order != other.order or isinstance(own, RigidBody):
        return None
    ratio = (own.mesh.n_tets / other.mesh.n_tets) ** (1.0 / 3.0)
    if max(ratio, 1.0 / ratio) < MIN_WIDTH_RATIO:
        raise SimulationError(
            f"error_mesh: body {own.name!r} has {other.mesh.n_tets:,} tets there and {own.mesh.n_tets:,} in the run: the mesh "
            f"widths must differ by a factor of at least {MIN_WIDTH_RATIO:g}, or the orders, to show an error"
        )
    return ratio


def _check_free(scene: Scene, shared: np.ndarray) -> None:
    """Raise SimulationError if all nodes of a body that two meshes share are fixed or follow paths. shared: (k,) ids."""
    first = 0
    for body in scene.bodies:
        own = shared[(shared >= first) & (shared < first + body.n_nodes)] - first
        if constrained_axes(body, prescribed=True, scene=scene)[own].all():
            raise SimulationError(f"error_mesh: body {body.name!r}: all nodes of both meshes that coincide are constrained")
        first += body.n_nodes


def other_mesh(sim: "Simulator", mesh: str | Scene) -> Scene:
    """The scene of a companion on another mesh. Raises SceneError or SimulationError if there is none."""
    if isinstance(mesh, Scene):
        names = [[b.name for b in scene.bodies] for scene in (sim.scene, mesh)]
        if names[0] != names[1]:
            raise SimulationError(f"error_mesh: its bodies are {', '.join(names[1])}, and those of the run {', '.join(names[0])}")
        return mesh
    if mesh not in MESHES:
        raise SimulationError(f"error_mesh {mesh!r} is unknown: it must be {' or '.join(map(repr, MESHES))}, or a scene")
    if mesh == REFINED:
        return refined(sim.scene)
    orders = {b.order for b in sim.scene.bodies}
    if len(orders) > 1:
        raise SimulationError("error_mesh 'order': the bodies have both orders, so there is no other one: use 'refined'")
    return with_order(sim.scene, 3 - orders.pop())


def _nodes(sim: "Simulator") -> tuple[np.ndarray, list]:
    """Rest positions (n,3) [m] of all nodes, and the number of nodes of each body by name."""
    bodies = sim.scene.bodies
    return np.concatenate([b.rest_positions for b in bodies]), [[b.name, b.n_nodes] for b in bodies]


def _placement(sim: "Simulator") -> np.ndarray:
    """Where the scene puts the body of each node (n,3) [m]."""
    return np.concatenate([np.broadcast_to(body.position, (body.n_nodes, 3)) for body in sim.scene.bodies])


def _check_start(sim: "Simulator", other: "Simulator", nodes: tuple[np.ndarray, np.ndarray], shift: np.ndarray) -> None:
    """Raise SimulationError unless a companion on another mesh, which starts as its scene does, has the run's state, but for a
    shift (k,3) [m] of at most PLACED, as of bodies that start at the contact offset."""
    own, theirs = nodes
    x, v, dt = sim.positions(), sim.velocities(), max(sim.dt, 1.0 / 60.0)
    size = np.ptp(x, axis=0).max()
    if np.abs(shift).max() > PLACED * size:
        raise SimulationError(f"error_mesh: the scene's bodies are {np.abs(shift).max():.2g} m from their places in the run")
    apart = np.abs(x[own] - other.positions()[theirs] + shift).max()
    faster = np.abs(v[own] - other.velocities()[theirs]).max() * dt
    if sim.time != other.time or max(apart, faster) > SAME_STATE * size:
        raise SimulationError(
            "error_mesh: a companion on another mesh starts with the scene, so the run must start there too: reset()"
        )
