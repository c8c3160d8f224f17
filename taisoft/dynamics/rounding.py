"""Rounding floor of the residual of a stage, which ends its solves, whatever the tolerance.

The rounding of F causes forces as large as those of a strain of eps; the rounding of x causes momenta.
"""

import numpy as np

from taisoft.backend.arrays import download
from taisoft.dynamics.pieces import Pieces
from taisoft.fem.model import Model


class RoundingFloor:
    """Rounding floor of a model, at the state where it was last measured."""

    def __init__(self, model: Model, eps: float, pieces: Pieces):
        self.model, self.eps, self.pieces = model, eps, pieces
        self.measure()

    def measure(self) -> None:
        """Compute the nodal forces of a strain as large as its rounding, and the momenta of the rounding of x."""
        m = self.model
        volume, Dm_inv, constants, body, mass = download([m.volume, m.Dm_inv, m.law_constants, m.block_body, m.mass])
        volume, Dm_inv, mass = (a.astype(np.float64) for a in (volume, Dm_inv, mass))
        stiffness = np.abs(constants[:, :2]).sum(axis=1)  # of each body, or of each lane
        stiffness = stiffness if m.elasticity_by_tet else stiffness[body][:, None]
        if m.fibres is not None:
            numbers = download([m.fibres.numbers])[0]
            stiffness = stiffness + 4.0 * numbers[:, 3] + numbers[:, 5]
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
        self.piece_force = np.sqrt(np.bincount(self.pieces.of_lane, squares.reshape(-1), len(self.pieces.body)))
        # rounding of v = (x - x_hat) / beta: |M| times the rounding of x, still to be divided by beta
        self.position = 4.0 * float(np.finfo(np.float64).eps) * largest
        self.mass = float(np.linalg.norm(mass) * self.position)
        self.piece_mass = np.sqrt(np.bincount(self.pieces.of_node, mass**2)) * self.position

    def of_stage(self, c: float, beta: float) -> float:
        """Return the rounding floor of |r| of a stage [N s]."""
        return beta * self.force + c * self.mass / beta

    def of_pieces(self, c: float, beta: float) -> np.ndarray:
        """Return that of each piece (n,) [N s]."""
        return beta * self.piece_force + c * self.piece_mass / beta

    def snapshot(self) -> dict:
        """Return the numbers, which depend on the state where they were measured."""
        by_part = {"piece_force": self.piece_force, "piece_mass": self.piece_mass}
        return {"force": self.force, "position": self.position, "mass": self.mass, **by_part}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self.force, self.position, self.mass = (float(kept[name]) for name in ("force", "position", "mass"))
        self.piece_force, self.piece_mass = np.array(kept["piece_force"]), np.array(kept["piece_mass"])
