"""Samples of a simulation: what `DrawnState` holds, read from a simulator."""

from collections.abc import Iterable
from functools import cached_property

import numpy as np

from taisoft.errors import OutputError, SceneError, SimulationError, reworded
from taisoft.fem.reference import inverse_rest_edges
from taisoft.output.connection_lines import ConnectionLines
from taisoft.output.nodal_fields import NodalMean, surface_values, von_mises
from taisoft.scene.loads import Cavity, value_at
from taisoft.scene.rigid import RigidBody
from taisoft.view.drawn import ENERGIES, DrawnScene, DrawnState, pressing

MAX_SEGMENTS = 400  # of springs and tendons, in all
MAX_CONTACTS = 1000  # that are drawn
OF_CONTACTS = {"pressure": "pressure", "slip": "accumulated_slip"}  # quantity -> field of `ContactPressure`


class Sampler:
    """Samples states of the simulations of a scene. drawn: what is drawn of it."""

    def __init__(self, scene):
        self.drawn, self._scene = DrawnScene.of(scene), scene
        self._values, self._lines = NodalValues(scene.bodies), None
        if scene.has_springs:
            exact = scene.exact_attachments
            self._lines = ConnectionLines(scene, [one for one in scene.connections if one not in exact])
            ends, line = self._lines.segments
            step = -(-len(ends) // MAX_SEGMENTS)
            self._ends, self._line = ends[::step], line[::step]

    def state(self, sim, layers: Iterable[str] = (), kinds: Iterable[str] = (), energies: bool = True) -> DrawnState:
        """Return sim's present state, with what visible layers and colours show; energies: for a caption, or the window.

        Raises OutputError if a path fails.
        """
        x, scene, time = sim.positions(), sim.scene, sim.time
        with np.errstate(over="ignore", invalid="ignore"):
            state = DrawnState(self.drawn, time, (x - self.drawn.start).astype(np.float32), sim.step_count)
        state.values = {kind: self._values(kind, sim).astype(np.float32) for kind in kinds if kind != "body"}
        if energies:
            found = sim.energies()
            state.energies = {name: float(getattr(found, name)) for name in ENERGIES}
        with reworded((SceneError, SimulationError), "the scene cannot be shown: ", raised=OutputError):
            state.poses = {one.name: one.pose(time) for one in scene.obstacles if one.path is not None}
            if "tractions" in layers:
                state.tractions = [value_at(t, time, body.name) for body in scene.bodies for t in body.tractions]
            if "connections" in layers and self._lines is not None:
                state.segments = self._lines.points(x, time)[self._ends], self._lines.tensions(sim)[self._line]
            if "pressures" in layers:
                state.pressures = [_pressure(sim, *one) for one in pressing(scene)]
        if "contacts" in layers:
            found, k = sim.contacts(), slice(0, MAX_CONTACTS)
            state.contacts = {name: getattr(found, name)[k] for name in ("point", "normal", "impulse")}
        return state


def _pressure(sim, body, load, key) -> float:
    """Return a present pressure [Pa]; that of a cavity may be found by the simulation."""
    if isinstance(load, Cavity):
        return float(sim.cavity_pressure(key))
    return float(value_at(load, sim.time, f"body {body.name!r}: pressure {key}"))


class NodalValues:
    """A quantity at the nodes of all bodies. bodies: of the scene, in the order added."""

    def __init__(self, bodies):
        self._bodies = bodies
        self._rigid = np.concatenate([np.full(body.n_nodes, isinstance(body, RigidBody)) for body in bodies])

    def __call__(self, kind: str, sim) -> np.ndarray:
        """Return the quantity, one of UNITS but "body", at all nodes (n_nodes,) in sim's present state."""
        if kind == "stress":
            return np.where(self._rigid, np.nan, von_mises(self._mean(sim.stress())))  # a rigid body's tet is not its material
        if kind == "error":
            return sim.nodal_errors()
        if kind in OF_CONTACTS:
            return surface_values(sim, OF_CONTACTS[kind])[0]
        return self._mean(self._stretches(sim)) if kind == "stretch" else np.linalg.norm(sim.velocities(), axis=1)

    @cached_property
    def _mean(self) -> NodalMean:
        return NodalMean(self._bodies)

    @cached_property
    def _Dm_inv(self) -> list[np.ndarray]:
        return [inverse_rest_edges(b.mesh.vertices, b.mesh.tets)[0] for b in self._bodies]

    def _stretches(self, sim) -> np.ndarray:
        """Return the largest principal stretch of every tet (m,); for quadratic tets that of the linear tet of the corners."""
        parts = []
        for body, Dm_inv in zip(self._bodies, self._Dm_inv):
            corner = sim.positions(body.name)[body.mesh.tets]
            F = (corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1) @ Dm_inv
            parts.append(np.sqrt(np.linalg.eigvalsh(F.transpose(0, 2, 1) @ F)[:, 2]))
        return np.concatenate(parts)
