"""Samples of a simulation: what `DrawnState` holds, read from a simulator."""

from collections.abc import Iterable

import numpy as np

from taisoft.errors import OutputError, SceneError, SimulationError, reworded
from taisoft.output.connection_lines import ConnectionLines
from taisoft.output.nodal_fields import NodalValues
from taisoft.scene.loads import Cavity, value_at
from taisoft.view.choices import ENERGIES, nodal
from taisoft.view.drawn import DrawnScene, DrawnState, some, with_arrows

MAX_SEGMENTS = 400  # of springs and tendons, in all
MAX_CONTACTS = 1000  # that are drawn


class Sampler:
    """Samples states of the simulations of a scene. drawn: what is drawn of it; values: of its nodes, which writers may share."""

    def __init__(self, scene, values: NodalValues | None = None):
        self.drawn, self._lines = DrawnScene.of(scene), None
        self._values = values or NodalValues(scene.bodies)
        if scene.has_springs:
            exact = scene.exact_attachments
            self._lines = ConnectionLines(scene, [one for one in scene.connections if one not in exact])
            self._ends, self._line = (some(items, MAX_SEGMENTS) for items in self._lines.segments)

    def state(self, sim, layers: Iterable[str] = (), kinds: Iterable[str] = (), energies: bool = True) -> DrawnState:
        """Return sim's present state, with what visible layers and colours show; energies: for a caption, or the window.

        Raises OutputError if a path fails.
        """
        x, scene, time = sim.positions(), sim.scene, sim.time
        with np.errstate(over="ignore", invalid="ignore"):
            state = DrawnState(self.drawn, time, (x - self.drawn.start).astype(np.float32), sim.step_count)
        state.values = {kind: self._values(kind, sim).astype(np.float32) for kind in kinds if kind in nodal()}
        if energies:
            found = sim.energies()
            state.energies = {name: float(getattr(found, name)) for name in ENERGIES}
        with reworded((SceneError, SimulationError), "the scene cannot be shown: ", raised=OutputError):
            state.poses = {one.name: one.pose(time) for one in scene.obstacles if one.path is not None}
            if "tractions" in layers:
                found = with_arrows(scene, "tractions")
                state.tractions = [load.shown(value_at(load, time, body.name)) for body, _, load in found]
            if "connections" in layers and self._lines is not None:
                state.segments = self._lines.points(x, time)[self._ends], self._lines.tensions(sim)[self._line]
            if "pressures" in layers:
                state.pressures = [_pressure(sim, *one) for one in with_arrows(scene, "pressures")]
        if "contacts" in layers:
            found, k = sim.contacts(), slice(0, MAX_CONTACTS)
            state.contacts = {name: getattr(found, name)[k] for name in ("point", "normal", "impulse")}
        return state


def _pressure(sim, body, index, load) -> float:
    """Return a present pressure [Pa]; that of a cavity may be found by the simulation."""
    if isinstance(load, Cavity):
        return float(sim.cavity_pressure(load.name))
    return float(load.shown(value_at(load, sim.time, f"body {body.name!r}: {load.kind} {index}")))
