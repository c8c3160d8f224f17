"""Whether the forces on every body balance, not only those on the heaviest.

Newton's method ends on the norm of the residual over the whole scene, relative to the forces of the whole scene. All forces on a
body that is much lighter than others, or much less strained, can hide below that: it would neither fall nor rest. So each body is
looked at on its own, as
    |r|_b <= LIMIT s_b,   s_b = |M (v - v_hat)|_b + beta (|f_el|_b + |M g + loads|_b),
unless its residual is rounding.
"""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.elasticity import gather_forces
from taisoft.model import Layout
from taisoft.scene.scene import Scene
from taisoft.transfer import download

if TYPE_CHECKING:
    from taisoft.stepping.newton import StageSolver

LIMIT = 0.01  # of the forces on a body: a residual beyond is a wrong motion
ROUNDING = 4.0  # times the floor of a body, as of the whole scene in `newton`


class BodyBalance:
    """Residuals of a scene's bodies, one by one; of several bodies only."""

    def __init__(self, scene: Scene, layout: Layout):
        self._names = [body.name for body in scene.bodies]
        self._start = layout.node_start[:-1]

    def worst(self, solver: "StageSolver", beta: float) -> tuple[float, str]:
        """The largest relative residual of a body in the stage just solved, and the body's name; 0 where all are rounding."""
        m, w = solver.model, solver.work
        gather_forces(m, solver.pcg.q)
        fields = [w.residual, m.v, w.v_hat, solver.pcg.q, m.free, m.mass, m.weight, *([m.loads] if m.loaded else [])]
        residual, v, v_hat, elastic, free, mass, weight, *loads = (a.astype(np.float64) for a in download(fields))
        external = weight[:, None] * m.gravity.to_numpy()[0] + (loads[0] if loads else 0.0)
        r, inertia, elastic, external, masses = (
            np.sqrt(np.add.reduceat(((free * a) ** 2).sum(axis=1), self._start))
            for a in (residual, mass[:, None] * (v - v_hat), elastic, external, mass[:, None] * np.ones(3))
        )
        floor = beta * solver.rounding_by_body + masses * solver.rounding_of_x / beta
        scale = inertia + beta * (elastic + external)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(r > ROUNDING * floor, r / scale, 0.0)
        k = int(np.argmax(ratio))
        return float(ratio[k]), self._names[k]
