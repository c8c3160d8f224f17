"""Loads of a scene at a time: dead loads as nodal forces f_a(t) = sum over loads of w_a F(t), and loads that are one number.

w_a is the reference area at node a for a traction; for a total force the fraction of the lumped mass, or on a rigid body an equal
part; and 1 for a force per node.
Numbers, such as pressures, which force terms turn into nodal forces at the present x, are the model's `amplitudes`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import taichi as ti

from taisoft.errors import SimulationError
from taisoft.fem import reference
from taisoft.fem.model import Setup
from taisoft.fem.pressure import pressures_of
from taisoft.fem.spring_table import SpringTable
from taisoft.scene.connection_records import Tendon
from taisoft.scene.loads import DEAD, FOLLOWER, Activation, BodyLoad, Cavity, Pressure, ScalarLoad, value_at
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Body, Scene

FOLLOWS = ScalarLoad(value=np.zeros(()))  # a pressure or a tension that is a Lagrange multiplier, which steppers find


class _Path(NamedTuple):
    """A load that varies: its name in messages, its nodes (k,) of the scene, and their weights (k,)."""

    name: str
    load: BodyLoad
    nodes: np.ndarray
    weights: np.ndarray

    def forces(self, times: list[float]) -> np.ndarray:
        """Forces (r,k,3) [N] on its nodes at the times (r,) [s]."""
        values = [value_at(self.load, t, self.name) for t in times]
        if all(value.ndim == 1 for value in values):
            return np.stack(values)[:, None] * self.weights[:, None]
        return np.stack([_spread(value, self.weights) for value in values])


class SceneLoads:
    """The loads of a scene with its present values.

    nodes: those whose loads follow a path, ascending. multipliers: amplitudes that are Lagrange multipliers, the pressures in
    cavities of given volume and the tensions of inextensible tendons; activations: those that activate fibres, whose energy is
    elastic. has_potential: whether energies count the work of all loads but those along a path: not that of a pressure on an
    open surface, which depends on the path of its border, of the fluid in a given volume, and of a tendon whose given length
    follows a path.
    """

    def __init__(self, scene: Scene, springs: SpringTable | None = None):
        """springs: the scene's table; only its ends on obstacles that move matter."""
        starts = np.cumsum([0, *(body.n_nodes for body in scene.bodies)])
        self._constant, self._paths = np.zeros((starts[-1], 3)), []
        for body, start in zip(scene.bodies, starts):
            for kind, k, load in body.numbered_loads:
                if load.feature != DEAD:
                    _check_follower(body, load)
                    continue
                nodes, weights = _weights(body, load)
                if load.path is None:
                    self._constant[start + nodes] += _spread(load.value, weights)
                else:
                    self._paths.append(_Path(f"body {body.name!r}: {kind} {k}", load, start + nodes, weights))
        self.nodes = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *(path.nodes for path in self._paths)]))
        self._scalars, self._moving = scalar_loads(scene), None if springs is None else springs.moving
        self.multipliers = np.array([n for n, (_, load) in enumerate(self._scalars) if load is FOLLOWS], dtype=np.int64)
        self.activations = np.array(
            [n for n, (_, load) in enumerate(self._scalars) if isinstance(load, Activation)], dtype=np.int64
        )
        others = [load for _, load in pressures_of(scene) if not load.has_potential]
        winches = [tendon for tendon in scene.tendons if tendon.is_inextensible and tendon.path is not None]
        self.has_potential = not (winches or any(load.path is not None or load.value.any() for load in others))

    @property
    def n_amplitudes(self) -> int:
        """Number of loads that are one number, and of numbers that place the ends of springs on obstacles that move."""
        return len(self._scalars) + (0 if self._moving is None else self._moving.n_amplitudes)

    @property
    def amplitudes_vary(self) -> bool:
        """Whether any of these follows a path."""
        return self._moving is not None or any(load.path is not None for _, load in self._scalars)

    @property
    def vary(self) -> bool:
        """Whether any load follows a path."""
        return bool(self._paths) or self.amplitudes_vary

    def amplitudes(self, times: np.ndarray | list[float]) -> np.ndarray:
        """Values (r, n_amplitudes) at the times (r,) [s]: of `scalar_loads`, then of `MovingEnds`. Raises SimulationError."""
        rows = [[number_at(load, float(t), name) for name, load in self._scalars] for t in times]
        if self._moving is not None:
            rows = [[*row, *self._moving.amplitudes(float(t))] for row, t in zip(rows, times)]
        return np.array(rows).reshape(len(times), self.n_amplitudes)

    @property
    def is_constant(self) -> np.ndarray:
        """Which amplitudes (n_amplitudes,) follow no path."""
        own = [load.path is None for _, load in self._scalars]
        return np.array(own + [False] * (self.n_amplitudes - len(own)), dtype=bool)

    def at(self, t: float, fraction: float = 1.0) -> np.ndarray:
        """Forces (n_nodes, 3) [N] on all nodes at t [s], a fraction of constant ones. Raises SimulationError if a path fails."""
        total = fraction * self._constant
        for path in self._paths:
            total[path.nodes] += path.forces([t])[0]
        return total

    def rows(self, times: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Forces (r, k, 3) [N] on some nodes (k,), ascending, which include `nodes`, at the times (r,) [s]."""
        rows = np.repeat(self._constant[nodes][None], len(times), axis=0)
        for path in self._paths:
            rows[:, np.searchsorted(nodes, path.nodes)] += path.forces(times.tolist())
        return rows


def model_fields(setup: Setup) -> dict[str, Any]:
    """Fields of Model: dead loads and amplitudes at the start, each if there are any."""
    arena, layout, on = setup.arena, setup.layout, setup.on["loads"]
    loads = SceneLoads(setup.scene, layout.springs)
    return {
        "loaded": on,
        "loads": arena.vectors("loads", setup.runtime.real, len(layout.rest), loads.at(0.0)) if on else None,
        "amplitudes": arena.filled("amplitudes", ti.f64, loads.amplitudes([0.0])[0]) if loads.n_amplitudes else None,
    }


def number_at(load: ScalarLoad | Tendon, t: float, what: str) -> float:
    """Value of a load at t [s]. what: start of messages. Raises SimulationError for one that is not allowed."""
    value = float(value_at(load, t, what))
    if isinstance(load, Tendon) and not load.allows(value):
        unit, rule = ("N", "a tendon cannot push") if load.given == "force" else ("m", "a length must be above 0")
        raise SimulationError(f"{what}: its path gave {value:g} {unit} at t = {t:g} s: {rule}")
    if isinstance(load, Activation) and not 0.0 <= value <= 1.0:
        raise SimulationError(f"{what}: its path gave {value:g} at t = {t:g} s: an activation must lie from 0 to 1")
    return value


def scalar_loads(scene: Scene) -> list[tuple[str, ScalarLoad | Tendon]]:
    """The loads of a scene that are one number, each with its name in messages, in the order of the model's `amplitudes`."""
    found: list[tuple[str, ScalarLoad | Tendon]] = []
    for body in scene.bodies:
        for kind, k, load in body.numbered_loads:
            if isinstance(load, Cavity):
                found.append((f"cavity {load.name!r}", FOLLOWS if load.given == "volume" else load))
            elif isinstance(load, Pressure):
                found.append((f"body {body.name!r}: {kind} {k}", load))
    for body in scene.bodies:
        found += [(f"body {body.name!r}: activation", load) for load in body.activations]
    return found + [(f"tendon {one.name!r}", FOLLOWS if one.is_inextensible else one) for one in scene.tendons]


def activation_slots(scene: Scene) -> dict[int, int]:
    """The place of the first activation of each body with fibres among the model's `amplitudes`, by the body's number."""
    first = np.cumsum([len(pressures_of(scene)), *(len(body.activations) for body in scene.bodies)])
    return {k: int(first[k]) for k, body in enumerate(scene.bodies) if body.activations}


def tendon_slots(scene: Scene) -> dict[str, int]:
    """The place of each tendon's tension, or length at rest if it is elastic, among the model's `amplitudes`, by name."""
    first = len(scalar_loads(scene)) - len(scene.tendons)
    return {tendon.name: first + k for k, tendon in enumerate(scene.tendons)}


def _areas(body: Body, load: BodyLoad) -> tuple[np.ndarray, np.ndarray]:
    areas = reference.triangle_areas(body, load.ids)
    nodes = np.flatnonzero(areas)
    return nodes, areas[nodes]


def _shares(body: Body, load: BodyLoad) -> tuple[np.ndarray, np.ndarray]:
    parts = np.ones(body.n_nodes) if isinstance(body, RigidBody) else reference.lumped_mass(body)
    return load.ids, parts[load.ids] / parts[load.ids].sum()


# by kind of dead load: (body, load) -> the nodes (k,) of the body on which it acts, and their weights (k,)
WEIGHTS: dict[str, Callable[[Body, BodyLoad], tuple[np.ndarray, np.ndarray]]] = {"traction": _areas, "force": _shares}


def _check_follower(body: Body, load: BodyLoad) -> None:
    """Raise SimulationError for a kind that says it is a pressure, and is not: one that follows otherwise has its own feature."""
    if load.feature == FOLLOWER and not isinstance(load, (Pressure, Cavity)):
        raise SimulationError(f"body {body.name!r}: no forces are known of a {load.kind}: give its class a feature of its own")


def _weights(body: Body, load: BodyLoad) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of a dead load. Raises SimulationError for a kind without a row."""
    if load.kind not in WEIGHTS:
        raise SimulationError(
            f"body {body.name!r}: no forces are known of a {load.kind}: add its row to taisoft.fem.loads.WEIGHTS"
        )
    return WEIGHTS[load.kind](body, load)


def _spread(value: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Forces (k,3) of a value: one per node (k,3), or (3,) times the weights (k,)."""
    return value if value.ndim == 2 else np.outer(weights, value)
