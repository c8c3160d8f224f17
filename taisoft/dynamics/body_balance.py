"""Force balance of each body and connected piece.

Newton's method ends on the residual norm of the whole scene, relative to the forces of the whole scene. All forces on a body
that is much lighter or less strained than others can be smaller than that: it would neither fall nor rest. So each body, and
each connected piece of one, is checked separately:
    |r|_b <= LIMIT s_b,   s_b = |M (v - v_hat)|_b + beta (|f_el|_b + |M g + loads|_b),
unless its residual is rounding. The mean of r over a piece without constraints moves the piece as a whole. Elastic forces and
their rounding cancel in it, so only the rounding of momenta counts there. This check applies to linearly implicit steps, too;
the rest of their residual is the linearisation error.
"""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.backend.arrays import download
from taisoft.fem.terms.elasticity import gather_forces
from taisoft.mesh.topology import connected_pieces
from taisoft.scene.scene import Scene

if TYPE_CHECKING:
    from taisoft.dynamics.stage_system import StageSystem

LIMIT = 0.01  # of the forces on a body: a larger residual means wrong motion
NEGLIGIBLE_MOMENTUM = 1e-9  # of a piece's momentum and forces: momentum error that a step may always make
ROUNDING = 4.0  # times the rounding floor of a body, as for the whole scene in `newton`


class BodyBalance:
    """Residuals of the connected pieces of a scene."""

    def __init__(self, scene: Scene):
        pieces, names, bodies = [], [], []
        for k, body in enumerate(scene.bodies):
            n, piece = 1, np.zeros(body.n_nodes, dtype=np.int64)
            if body.mesh.n_components > 1:
                n, piece = connected_pieces(body.nodes.elements, body.n_nodes)
            pieces.append(piece + len(names))
            names += [f"body '{body.name}'" if n == 1 else f"a piece of body '{body.name}'"] * n
            bodies += [k] * n
        self._piece, self._names, self._body = np.concatenate(pieces), names, np.array(bodies)
        self._n_nodes = np.bincount(self._piece)

    @property
    def n_pieces(self) -> int:
        """Number of pieces."""
        return len(self._names)

    def worst(self, solver: "StageSystem", beta: float, linear: bool) -> tuple[float, str]:
        """Return the largest relative residual of a piece in the stage just solved, and its name; 0 if all are rounding.

        linear: consider only the mean residuals, which move pieces as a whole.
        """
        m, w = solver.model, solver.work
        gather_forces(m, w.pcg.q)
        fields = [w.residual, m.state.v, w.v_hat, w.pcg.q, m.free, m.mass, m.gravity_mass, *([m.loads] if m.loaded else [])]
        residual, v, v_hat, elastic, free, mass, gravity_mass, *loads = (a.astype(np.float64) for a in download(fields))
        external = gravity_mass[:, None] * m.gravity.to_numpy()[0] + (loads[0] if loads else 0.0)
        r, inertia, momentum, elastic, external, masses = (
            self._norm(free * a)
            for a in (residual, mass[:, None] * (v - v_hat), mass[:, None] * v, elastic, external, mass[:, None] * np.ones(3))
        )
        scale = inertia + beta * (elastic + external)
        floor = beta * solver.rounding.force_by_body[self._body] + masses * solver.rounding.position / beta
        mean_floor = (
            max(solver.rounding.eps, NEGLIGIBLE_MOMENTUM) * (momentum + beta * elastic) + masses * solver.rounding.position / beta
        )
        mean = self._mean(residual, free)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(mean > ROUNDING * mean_floor, mean / scale, 0.0)
            if not linear:
                ratio = np.maximum(ratio, np.where(r > ROUNDING * floor, r / scale, 0.0))
        k = int(np.argmax(ratio))
        return float(ratio[k]), self._names[k]

    def _norm(self, a: np.ndarray) -> np.ndarray:
        """Return the norms (n_pieces,) of (n_nodes, 3)."""
        return np.sqrt(np.bincount(self._piece, (a**2).sum(axis=1)))

    def _mean(self, residual: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Return the norms (n_pieces,) of each piece's mean residual, along the axes on which it has no constraint."""
        means = np.zeros((3, self.n_pieces))
        for axis in range(3):
            constrained = np.bincount(self._piece, 1.0 - free[:, axis]) > 0.0
            means[axis] = np.where(constrained, 0.0, np.bincount(self._piece, residual[:, axis]))
        return np.linalg.norm(means, axis=0) / np.sqrt(self._n_nodes)
