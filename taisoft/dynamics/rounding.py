"""What rounding leaves of the residual of a stage: below it nothing is solved for, whatever tolerance is asked for.

The rounding of F makes forces of its own, as large as those of a strain of eps; the rounding of x makes momenta.
"""

import numpy as np

from taisoft.model import Model
from taisoft.transfer import download


class RoundingFloor:
    """The floor of a model, at the state where it was last measured."""

    def __init__(self, model: Model, eps: float):
        self.model, self.eps = model, eps
        self.measure()

    def measure(self) -> None:
        """Recompute it: the nodal forces of a strain as large as its rounding, the momenta of that of x."""
        m = self.model
        volume, Dm_inv, constants, body, mass = download([m.volume, m.Dm_inv, m.law_constants, m.block_body, m.mass])
        volume, Dm_inv, mass = (a.astype(np.float64) for a in (volume, Dm_inv, mass))
        stiff = np.abs(constants[:, :2]).sum(axis=1)[body]
        g = np.sqrt((Dm_inv**2).sum(axis=1))
        if m.points is not None:  # the gradients of quadratic shape functions are larger
            steepest = float(np.abs(m.points.to_numpy()[:, 1:]).max())
            for group in m.groups:
                g[group.first : group.last] *= steepest if group.order == 2 else 1.0
        largest = float(np.abs(download([m.state.x])[0]).max())
        strain = self.eps + np.finfo(np.float64).eps * largest * g  # of F, and of the f64 positions it is formed from
        squares = (stiff[:, None] * volume * g * strain) ** 2
        self.force = float(np.sqrt(squares.sum()))
        self.force_by_body = np.sqrt(np.bincount(body, squares.sum(axis=1)))
        # and of v = (x - x_hat) / beta: |M| times the rounding of x, to be divided by beta
        self.position = 4.0 * float(np.finfo(np.float64).eps) * largest
        self.mass = float(np.linalg.norm(mass) * self.position)

    def of_stage(self, c: float, beta: float) -> float:
        """|r| [N s] that rounding may leave of a stage."""
        return beta * self.force + c * self.mass / beta

    def snapshot(self) -> dict:
        """The numbers, which tell of the state where they were measured."""
        return {"force": self.force, "force_by_body": self.force_by_body, "position": self.position, "mass": self.mass}

    def restore(self, kept: dict) -> None:
        """Back to what `snapshot` told."""
        self.force, self.position, self.mass = (float(kept[name]) for name in ("force", "position", "mass"))
        self.force_by_body = np.array(kept["force_by_body"])
