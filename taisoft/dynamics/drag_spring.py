"""A point of a body pulled towards a target by a damped spring, as a mouse does.

The point is x_p = sum_i w_i x_i over some nodes, and node i bears w_i F of
    F = k (target - x_p) - c v_p,
taken anew at the start of every step, or of every batch of explicit sub-steps, and held over that time T.
A force held over T is stable where k T^2 and c T are small against the mass that it meets, m_p = 1 / sum_i (w_i^2 / m_i), so
k is limited to SOFT m_p / T^2 and c, half of the critical 2 sqrt(k m_p), to SOFT m_p / T: with SOFT = 0.5 a mass on such a
spring comes to rest under every integrator here, BDF2 included. Finer meshes and longer steps thus allow weaker springs.
|F| is limited, too, so that no pull turns tets inside out: to STRAIN young A, A = (m_p / density)^(2/3) the
area that is gripped, and to HEAVY times the body's weight.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SceneError
from taisoft.scene import checks

SOFT = 0.5
STRAIN = 0.25
HEAVY = 20.0
EARTH = 9.81  # [m/s^2], for the weight of a body in a scene without gravity, too
HELD = 0.002  # [s] that explicit sub-steps may hold the force, if it is more than one of them
BATCH = 16  # and as many of them at most


@dataclass
class Drag:
    """What is pulled, and how: nodes (k,) of all bodies, weights (k,) of sum 1, target (3,) [m], stiffness [N/m] asked for."""

    body: str
    nodes: np.ndarray
    weights: np.ndarray
    target: np.ndarray
    stiffness: float
    mass: float  # that the force meets [kg]
    max_force: float  # |F| is at most this [N]
    point: np.ndarray  # (3,) where it was when the force was taken [m]
    force: np.ndarray  # (3,) [N]


def batch(dt: float) -> int:
    """Explicit sub-steps of dt [s] over which the force is held."""
    return max(1, min(BATCH, int(HELD / dt)))


class DragSpring:
    """The pull on a world whose model has loads."""

    def __init__(self, simulation: SimulationState):
        self._simulation = simulation
        self.drag: Drag | None = None

    def take(self, body: int, nodes, weights, target, stiffness) -> None:
        """Pull that point of a body from the next step on, in place of what was pulled before. Raises SceneError."""
        own, layout = self._simulation.scene.bodies[body], self._simulation.layout
        nodes, weights = np.atleast_1d(nodes), np.atleast_1d(np.asarray(weights, dtype=np.float64))
        good = nodes.ndim == 1 and nodes.dtype.kind in "iu" and len(nodes) > 0
        if not good or nodes.min() < 0 or nodes.max() >= own.n_nodes:
            raise SceneError(f"body '{own.name}': the nodes to pull at must be whole numbers from 0 to {own.n_nodes - 1}")
        if weights.shape != nodes.shape or not (np.isfinite(weights).all() and (weights >= 0).all() and weights.sum() > 0):
            raise SceneError(f"body '{own.name}': the weights of a pull must be {len(nodes)} numbers, none below 0, not all 0")
        target = checks.array(target, f"body '{own.name}': the target of a pull", ((3,),))
        stiffness = checks.number(stiffness, "the stiffness of a pull", above=0.0, unit="N/m")
        nodes, weights = nodes + layout.node_start[body], weights / weights.sum()
        masses = self._simulation.model.mass.to_numpy().astype(np.float64)
        mass = 1.0 / float((weights**2 / masses[nodes]).sum())
        area = (mass / own.material.density) ** (2 / 3)
        max_force = min(STRAIN * own.material.young * area, HEAVY * EARTH * float(masses[layout.nodes(body)].sum()))
        self._simulation.upload_loads()  # the nodes may be others
        self.drag = Drag(own.name, nodes, weights, target, stiffness, mass, max_force, target, np.zeros(3))
        self.drag.point = weights @ self._simulation.state()[0][nodes]

    def apply(self, held: float) -> None:
        """Take the force anew, to be held over a time [s]."""
        drag = self.drag
        x, v = self._simulation.state()
        k = min(drag.stiffness, SOFT * drag.mass / held**2)
        c = min(np.sqrt(k * drag.mass), SOFT * drag.mass / held)
        drag.point = drag.weights @ x[drag.nodes]
        force = k * (drag.target - drag.point) - c * (drag.weights @ v[drag.nodes].astype(np.float64))
        size = float(np.linalg.norm(force))
        drag.force = force * min(1.0, drag.max_force / size) if size > 0.0 else force
        self.upload()

    def release(self) -> bool:
        """The scene's own loads alone; False where nothing was pulled."""
        if self.drag is None:
            return False
        self.drag = None
        self.upload()
        return True

    def upload(self) -> None:
        """The scene's loads to the device, and the pull's force where something is pulled."""
        if self.drag is None:
            self._simulation.upload_loads()
        else:
            self._simulation.upload_loads(self.drag.nodes, np.outer(self.drag.weights, self.drag.force))
