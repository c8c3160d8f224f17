"""Choose the preconditioner of a linear solve without contacts: that of `pcg`, or multigrid where its iterations save time.

A solve starts with `pcg`. Its iterations beyond those that would pay for a multigrid solve are added up over the solves; when
they would also have paid for building the hierarchy, it is built, and the solve starts again with it. From then on all solves
use it. It is built from the projected matrix, which is positive definite, at the present positions, and kept over Newton
iterations and steps, until a solve takes GROWTH times as many iterations as the first one did for the same accuracy. After
PERIOD solves `pcg` is tried again. All decisions count iterations and nodes, so they are the same in every run. A checkpoint
holds the positions of the last build, from which the hierarchy is built again.

Solves with contacts, those of elimination and those on CUDA use `pcg`.
"""

import math
from typing import TYPE_CHECKING

import numpy as np

from taisoft.backend.arrays import upload
from taisoft.fem.model import Model
from taisoft.fem.node_graph import EVERYTHING
from taisoft.linear import block_csr, host_pcg, pcg
from taisoft.linear.aggregation import rigid_modes
from taisoft.linear.multigrid import Multigrid

if TYPE_CHECKING:
    from taisoft.dynamics.stage_system import StageSystem

# In iterations of `pcg`. Measured on one core: a multigrid iteration takes 3 times as long as one of pcg on meshes of 20,000 nodes
# and more, and 7 times on 2,500 nodes; building takes 150 to 350 times as long.
BUILD, ITERATIONS, RATIO, OVERHEAD = 300, 10, 3.0, 10_000  # OVERHEAD: nodes that add 1 to the ratio, divided by their number
GROWTH, SLACK = 2.0, 10  # a solve that takes more than GROWTH times the first iterations + SLACK requires a new hierarchy
LONGEST = 300  # iterations of a solve with a new hierarchy
PERIOD = 128  # solves by multigrid between trials of pcg
SPENT = -1000  # savings after multigrid has failed


class LinearSolver:
    """Linear solver of one model's stages."""

    def __init__(self, model: Model):
        self.model = model
        self.savings = 0.0  # iterations of pcg that multigrid would have saved
        self.uses = 0  # solves by multigrid since the last trial of pcg
        self.active = False  # multigrid is in use
        self.rate = 0.0  # iterations per decimal digit of the first solve with the hierarchy; 0: none yet
        self._built: tuple | None = None  # (c, beta, x, free) of the last build
        self._hierarchy: Multigrid | None = None

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes of the hierarchy, if there is one."""
        return {"multigrid": self._hierarchy.n_bytes} if self._hierarchy else {}

    def release(self) -> None:
        """Discard the hierarchy; the next solve by multigrid builds a new one."""
        self._hierarchy = self._built = None

    def snapshot(self) -> dict:
        """Return what later solves depend on."""
        c, beta, x, free = self._built or (0.0, 0.0, np.zeros((0, 3)), np.zeros((0, 3), dtype=bool))
        own = {"savings": self.savings, "uses": self.uses, "active": self.active, "rate": self.rate}
        return own | {"c": c, "beta": beta, "x": x, "free": free}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        self.savings, self.uses, self.active = float(kept["savings"]), int(kept["uses"]), bool(kept["active"])
        self.rate, x = float(kept["rate"]), np.array(kept["x"])
        self.release()
        if len(x):
            self._built = float(kept["c"]), float(kept["beta"]), x, np.array(kept["free"], dtype=bool)

    def solve(self, system: "StageSystem", tolerance: float) -> pcg.LinearResult:
        """Solve for y of pcg from its rhs. system: of a stage without contacts, on all nodes, whose matrix is formed."""
        m, w, done = self.model, system.work.pcg, 0
        if m.free.host is None:  # CUDA
            return pcg.solve(m, system.matrix, w, tolerance, pcg.iteration_limit(m))
        if not self.active:
            allowed = ITERATIONS * (RATIO + OVERHEAD / m.n_nodes)
            most = min(pcg.iteration_limit(m), math.ceil(allowed + BUILD - self.savings))
            found = pcg.solve(m, system.matrix, w, tolerance, most)
            self.savings = max(self.savings + found.iterations - allowed, min(self.savings, 0.0))
            if found.converged or found.negative or found.iterations < most:
                return found
            self.active, done = True, found.iterations
        found = self._solve_multigrid(system, tolerance)
        self.uses += 1
        if self.uses >= PERIOD:
            self.active, self.uses, self.savings = False, 0, 0.8 * BUILD
        if found is None:
            self.active, self.savings = False, SPENT
            found = pcg.solve(m, system.matrix, w, tolerance, pcg.iteration_limit(m))
        return pcg.LinearResult(done + found.iterations, found.converged, found.negative, found.multigrid)

    def _solve_multigrid(self, system: "StageSystem", tolerance: float) -> pcg.LinearResult | None:
        """Solve with the hierarchy, or with a new one if it has none or is out of date; None if that fails too."""
        m, w = self.model, system.work.pcg
        digits, wasted, free = max(-math.log10(tolerance), 1.0), 0, m.free.host > 0.0
        if self._built is not None and np.array_equal(self._built[3], free):
            if self._hierarchy is None:
                self._build(system, *self._built)
            most = math.ceil(GROWTH * self.rate * digits) + SLACK if self.rate > 0.0 else LONGEST
            found = host_pcg.solve(m, system.matrix, w, tolerance, most, self._hierarchy.apply)
            wasted = found.iterations
            if found.converged or found.negative:
                return pcg.LinearResult(wasted, found.converged, found.negative, True)
        self.release()
        try:
            self._build(system, system.stage.c, system.stage.beta, m.state.x.to_numpy(), free)
        except np.linalg.LinAlgError:
            return None
        found = host_pcg.solve(m, system.matrix, w, tolerance, LONGEST, self._hierarchy.apply)
        if not (found.converged or found.negative):
            return None
        self.rate = found.iterations / digits
        return pcg.LinearResult(wasted + found.iterations, found.converged, found.negative, True)

    def _build(self, system: "StageSystem", c: float, beta: float, x: np.ndarray, free: np.ndarray) -> None:
        """Build the hierarchy from the projected matrix at positions x."""
        m, A = self.model, system.matrix
        present = [(array, array.to_numpy()) for array in (m.state.x, A.value, A.diagonal)]
        m.state.x.from_numpy(x)
        system.form(EVERYTHING, True, c, beta)
        matrix = block_csr.to_bsr(m, A)
        upload(present)
        row = np.repeat(np.arange(m.n_nodes), np.diff(matrix.indptr))
        matrix.data *= free[row][:, :, None] & free[matrix.indices][:, None, :]
        matrix.data[matrix.indices == row] += np.eye(3) * ~free[:, :, None]
        self._hierarchy, self._built = Multigrid(matrix, rigid_modes(x, free)), (c, beta, x, free)
