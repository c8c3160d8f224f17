"""Drag spring: a damped spring pulls a point of a body towards a target, as mouse dragging does.

The point is x_p = sum_i w_i x_i over some nodes, and node i gets w_i F of
    F = k (target - x_p) - c v_p,
computed at the start of every step, or of every batch of explicit sub-steps, and held constant over that time T.
This is stable if k T^2 and c T are small compared with the effective mass m_p = 1 / sum_i (w_i^2 / m_i). So k is limited to
SOFT m_p / T^2, and c, half of the critical 2 sqrt(k m_p), to SOFT m_p / T. With SOFT = 0.5 a mass on such a spring comes to
rest under every integrator here, including BDF2. Weakness: finer meshes and longer steps allow only weaker springs.
|F| is limited, too, so that dragging inverts no tets: to STRAIN young A, where A = (m_p / density)^(2/3) is the dragged area,
and to HEAVY times the body's weight. young is that of the body's softest tet, and density its mean.
"""

from dataclasses import dataclass

import numpy as np

from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SceneError
from taisoft.scene import checks

SOFT = 0.5
EARTH = 9.81  # [m/s^2], for a body's weight, also in scenes without gravity


@dataclass
class Drag:
    """Dragged point and spring: nodes (k,) of all bodies, weights (k,) of sum 1, target (3,) [m], requested stiffness [N/m]."""

    body: str
    nodes: np.ndarray
    weights: np.ndarray
    target: np.ndarray
    stiffness: float
    mass: float  # effective mass m_p [kg]
    max_force: float  # maximum |F| [N]
    point: np.ndarray  # (3,) dragged point when the force was computed [m]
    force: np.ndarray  # (3,) [N]


class DragSpring:
    """Drag spring of a simulation whose model has loads."""

    STRAIN = 0.25
    HEAVY = 20.0

    def __init__(self, simulation: SimulationState):
        self._simulation = simulation
        self.drag: Drag | None = None

    def take(self, body: int, nodes, weights, target, stiffness) -> None:
        """Drag that point of a body from the next step on, instead of any previous one. Raise SceneError."""
        own, layout = self._simulation.scene.bodies[body], self._simulation.layout
        nodes = checks.item_ids(nodes, own.n_nodes, f"body '{own.name}': the nodes to pull at", "node")
        weights = np.atleast_1d(np.asarray(weights, dtype=np.float64))
        if weights.shape != nodes.shape or not (np.isfinite(weights).all() and (weights >= 0).all() and weights.sum() > 0):
            raise SceneError(f"body '{own.name}': the weights of a pull must be {len(nodes)} numbers, none below 0, not all 0")
        target = checks.array(target, f"body '{own.name}': the target of a pull", ((3,),))
        stiffness = checks.number(stiffness, "the stiffness of a pull", above=0.0, unit="N/m")
        nodes, weights = nodes + layout.node_start[body], weights / weights.sum()
        masses, dependents = self._simulation.model.mass.to_numpy().astype(np.float64), self._simulation.dependents
        if dependents is not None:
            every = np.bincount(nodes, weights, dependents.n_nodes) @ dependents.matrix
            nodes, weights = np.flatnonzero(every), every[every != 0.0]
        mass = 1.0 / float((weights**2 / masses[nodes]).sum())
        area = (mass * float(own.volumes.sum()) / own.mass) ** (2 / 3)
        max_force = min(self.STRAIN * float(np.min(own.young)) * area, self.HEAVY * EARTH * own.mass)
        self.release()  # removes the force from the previous nodes
        self.drag = Drag(own.name, nodes, weights, target, stiffness, mass, max_force, target, np.zeros(3))
        self.drag.point = weights @ self._simulation.state()[0][nodes]

    def apply(self, hold_time: float) -> None:
        """Compute the force, to be held over a time [s]."""
        drag = self.drag
        x, v = self._simulation.state()
        k = min(drag.stiffness, SOFT * drag.mass / hold_time**2)
        c = min(np.sqrt(k * drag.mass), SOFT * drag.mass / hold_time)
        drag.point = drag.weights @ x[drag.nodes]
        force = k * (drag.target - drag.point) - c * (drag.weights @ v[drag.nodes].astype(np.float64))
        size = float(np.linalg.norm(force))
        drag.force = force * min(1.0, drag.max_force / size) if size > 0.0 else force
        self.upload()

    def release(self) -> bool:
        """End the drag, leaving the scene's own loads; return False if nothing was dragged."""
        if self.drag is None:
            return False
        self.drag = None
        self.upload()
        return True

    def upload(self) -> None:
        """Upload the scene's loads, plus the drag force if something is dragged."""
        drag = self.drag
        self._simulation.set_drag(None if drag is None else (drag.nodes, np.outer(drag.weights, drag.force)))
