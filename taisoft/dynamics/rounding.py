"""Rounding floor of a stage's residual: solves end there, whatever the tolerance.

The rounding of F causes forces as large as those of a strain of eps; the rounding of x causes momenta.
"""

import numpy as np

from taisoft.backend.arrays import download
from taisoft.fem.model import Model


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
        stiffness = np.abs(constants[:, :2]).sum(axis=1)[body]
        g = np.sqrt((Dm_inv**2).sum(axis=1))
        if m.points is not None:  # the gradients of quadratic shape functions are larger
            steepest = float(np.abs(m.points.to_numpy()[:, 1:]).max())
            for group in m.groups:
                g[group.first : group.last] *= steepest if group.order == 2 else 1.0
        largest = float(np.abs(download([m.state.x])[0]).max())
        strain = self.eps + np.finfo(np.float64).eps * largest * g  # rounding of F, and of the f64 positions it is computed from
        squares = (stiffness[:, None] * volume * g * strain) ** 2
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
