"""Force balance of each body and connected piece, and the rounding floor of residuals.

Newton's method ends on the residual norm of the whole scene, relative to the forces of the whole scene. All forces on a body
that is much lighter or less strained than others can be smaller than that: it would neither fall nor rest. So each body, and
each connected piece of one, is checked separately:
    |r|_b <= LIMIT s_b,   s_b = |M (v - v_hat)|_b + beta (|f_el|_b + |M g + loads|_b), loads with pressures,
unless its residual is rounding. The mean of r over a piece without constraints moves the piece as a whole. Elastic forces and
their rounding cancel in it, so only the rounding of momenta counts there. This check applies to linearly implicit steps, too;
the rest of their residual is the linearisation error.

The rounding floor of a stage's residual ends its solves, whatever the tolerance. The rounding of F causes forces as large as
those of a strain of eps; the rounding of x causes momenta.
"""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.backend.arrays import download
from taisoft.fem.model import Model
from taisoft.fem.terms.elasticity import gather_forces
from taisoft.fem.terms.pressure import gather_pressures
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
        if m.has_pressure:
            gather_pressures(m, w.pcg.q)
            external += w.pcg.q.to_numpy()
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


class RoundingFloor:
    """Rounding floor of a model, at the state where it was last measured."""

    def __init__(self, model: Model, eps: float):
        self.model, self.eps = model, eps
        self.measure()

    def measure(self) -> None:
        """Compute the nodal forces of a strain as large as its rounding, and the momenta of the rounding of x."""
        m = self.model
        volume, Dm_inv, constants, body, mass = download([m.volume, m.Dm_inv, m.law_constants, m.block_body, m.mass])
        volume, Dm_inv, mass = (a.astype(np.float64) for a in (volume, Dm_inv, mass))
        stiffness = np.abs(constants[:, :2]).sum(axis=1)  # of each body, or of each lane
        stiffness = stiffness if m.elasticity_by_tet else stiffness[body][:, None]
        g = np.sqrt((Dm_inv**2).sum(axis=1))
        if m.points is not None:  # the gradients of quadratic shape functions are larger
            steepest = float(np.abs(m.points.to_numpy()[:, 1:]).max())
            for group in m.groups:
                g[group.first : group.last] *= steepest if group.order == 2 else 1.0
        largest = float(np.abs(download([m.state.x])[0]).max())
        eps = np.full((len(g), 1), self.eps)  # of stress
        for group in m.groups:
            if group.rigid:
                eps[group.first : group.last] = np.finfo(np.float64).eps
        strain = eps + np.finfo(np.float64).eps * largest * g  # rounding of F, and of the f64 positions it is computed from
        squares = (stiffness * volume * g * strain) ** 2
        self.force = float(np.sqrt(squares.sum()))
        self.force_by_body = np.sqrt(np.bincount(body, squares.sum(axis=1)))
        # rounding of v = (x - x_hat) / beta: |M| times the rounding of x, still to be divided by beta
        self.position = 4.0 * float(np.finfo(np.float64).eps) * largest
        self.mass = float(np.linalg.norm(mass) * self.position)

    def stage_floor(self, c: float, beta: float) -> float:
        """Return the rounding floor of |r| of a stage [N s]."""
        return beta * self.force + c * self.mass / beta

    def snapshot(self) -> dict:
        """Return the numbers, which depend on the state where they were measured."""
        return {"force": self.force, "force_by_body": self.force_by_body, "position": self.position, "mass": self.mass}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self.force, self.position, self.mass = (float(kept[name]) for name in ("force", "position", "mass"))
        self.force_by_body = np.array(kept["force_by_body"])
