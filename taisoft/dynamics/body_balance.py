"""Whether the forces on every body balance, not only those on the heaviest.

Newton's method ends on the norm of the residual over the whole scene, relative to the forces of the whole scene. All forces on a
body that is much lighter than others, or much less strained, can hide below that: it would neither fall nor rest. So each body,
and each piece of one that is not connected, is looked at on its own, as
    |r|_b <= LIMIT s_b,   s_b = |M (v - v_hat)|_b + beta (|f_el|_b + |M g + loads|_b),
unless its residual is rounding. What remains of r when it is averaged over a piece that nothing holds moves the piece as a whole;
elastic forces cancel in it, and their rounding with them, so there only the rounding of momenta counts. It holds of linearly
implicit steps, too, whose other residual is that of what they do not linearise.
"""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.elasticity import gather_forces
from taisoft.mesh.topology import connected_pieces
from taisoft.scene.scene import Scene
from taisoft.transfer import download

if TYPE_CHECKING:
    from taisoft.dynamics.stage_system import StageSystem

LIMIT = 0.01  # of the forces on a body: a residual beyond is a wrong motion
UNFELT = 1e-9  # of a piece's momentum and forces: what a step may lose of its momentum, whatever changed that
ROUNDING = 4.0  # times the floor of a body, as of the whole scene in `newton`


class BodyBalance:
    """Residuals of a scene's pieces, one by one."""

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
        """How many there are."""
        return len(self._names)

    def worst(self, solver: "StageSystem", beta: float, linear: bool) -> tuple[float, str]:
        """The largest relative residual of a piece in the stage just solved, and which it is; 0 where all are rounding.

        linear: only of what moves pieces as a whole.
        """
        m, w = solver.model, solver.work
        gather_forces(m, w.pcg.q)
        fields = [w.residual, m.state.v, w.v_hat, w.pcg.q, m.free, m.mass, m.gravity_mass, *([m.loads] if m.loaded else [])]
        residual, v, v_hat, elastic, free, mass, gravity_mass, *loads = (a.astype(np.float64) for a in download(fields))
        external = gravity_mass[:, None] * m.gravity.to_numpy()[0] + (loads[0] if loads else 0.0)
        r, inertia, momentum, elastic, external, masses = (
            self._norm(free * a)
            for a in (
                residual, mass[:, None] * (v - v_hat), mass[:, None] * v, elastic, external, mass[:, None] * np.ones(3),
            )
        )  # fmt: skip
        scale = inertia + beta * (elastic + external)
        floor = beta * solver.rounding.force_by_body[self._body] + masses * solver.rounding.position / beta
        mean_floor = max(solver.rounding.eps, UNFELT) * (momentum + beta * elastic) + masses * solver.rounding.position / beta
        mean = self._mean(residual, free)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(mean > ROUNDING * mean_floor, mean / scale, 0.0)
            if not linear:
                ratio = np.maximum(ratio, np.where(r > ROUNDING * floor, r / scale, 0.0))
        k = int(np.argmax(ratio))
        return float(ratio[k]), self._names[k]

    def _norm(self, a: np.ndarray) -> np.ndarray:
        """(n_pieces,) of (n_nodes, 3)."""
        return np.sqrt(np.bincount(self._piece, (a**2).sum(axis=1)))

    def _mean(self, residual: np.ndarray, free: np.ndarray) -> np.ndarray:
        """(n_pieces,) norms of the residual averaged over each piece, along the axes on which nothing holds it."""
        means = np.zeros((3, self.n_pieces))
        for axis in range(3):
            held = np.bincount(self._piece, 1.0 - free[:, axis]) > 0.0
            means[axis] = np.where(held, 0.0, np.bincount(self._piece, residual[:, axis]))
        return np.linalg.norm(means, axis=0) / np.sqrt(self._n_nodes)
