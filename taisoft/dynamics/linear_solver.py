"""Choose the preconditioner of a linear solve without contacts: Gauss-Seidel, or multigrid where that is faster.

A solve starts with `gauss_seidel`. What its iterations take beyond an expected solve by multigrid is added up over the solves;
when that is worth building the hierarchy, it is built, and the solve starts again with it. From then on all solves use it, until
they have lost the same amount against the last solve without it, which then needs a multiple of the saving before multigrid is
tried again. After PERIOD solves Gauss-Seidel is tried again anyway.

The hierarchy is built from the projected matrix, which is positive definite, at the present positions. It is kept over Newton
iterations and steps, until a solve takes GROWTH times as many iterations as the first one did for the same accuracy. All
decisions count iterations and nodes, so they are the same in every run. A checkpoint holds the positions of the last build, from
which the hierarchy is built again.

Nearly incompressible bodies with mean dilatation have the preconditioner of `volumes` instead of Gauss-Seidel, if its band is
narrow enough. Solves with contacts use Gauss-Seidel, on CUDA all use block Jacobi.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena, upload
from taisoft.dynamics.stage import Stage
from taisoft.fem.model import Model
from taisoft.linear import gauss_seidel, pcg, volumes
from taisoft.linear.block_csr import BlockCsr
from taisoft.linear.coarse_correction import CoarseCorrection
from taisoft.linear.factor import Factor
from taisoft.linear.hierarchy import build_hierarchy, has_narrow_band
from taisoft.linear.jacobi import JACOBI
from taisoft.linear.pcg_work import LinearResult, PcgWork


class LinearSolver:
    """Linear solver of one model's stages."""

    # Durations in iterations of `gauss_seidel`, measured on one core and two: an iteration with the hierarchy takes RATIO plus
    # OVERHEAD over the number of nodes, by (whether it is a factorisation, precision). It is built once it would save BUILD:
    # what a factorisation takes, but half of what multigrid takes, since most simulations that need it go on. A solve is expected
    # to take ITERATIONS, before the first one. LOADING over the number of nodes is what multigrid's kernels take to load, 0.2 s.
    RATIO = {(False, ti.f32): 2.6, (False, ti.f64): 2.6, (True, ti.f32): 3.5, (True, ti.f64): 3.2}
    OVERHEAD = {(False, ti.f32): 5_000, (False, ti.f64): 10_000, (True, ti.f32): 25_000, (True, ti.f64): 20_000}
    BUILD, LOADING, ITERATIONS = {False: 90, True: 450}, {False: 5_000_000, True: 0}, 8
    GROWTH, SLACK = 2.0, 10  # a solve that takes more than GROWTH times the first iterations + SLACK requires a new hierarchy
    LONGEST = 300  # iterations of a solve with a new hierarchy
    PERIOD = 128  # solves by multigrid between trials without it
    UNFINISHED = 2.0  # of the iterations of a solve that multigrid interrupted: how many it is expected to have needed
    RETRY = 4  # a failure of multigrid multiplies the savings needed for a next trial by this
    STATE = {"active": bool, "savings": float, "uses": int, "failures": int, "rate": float, "pcg_rate": float}  # in a checkpoint

    def __init__(self, model: Model, matrix: BlockCsr, work: PcgWork, form: Callable[[bool, float, float], None]):
        """form: as `StageSystem.form`."""
        self.model, self._matrix, self._work, self._form = model, matrix, work, form
        self._arena, self._volumes = FieldArena(), None  # of `volumes`, built on first use
        self._use_volumes: bool | None = None  # None: to be decided
        self._is_prepared = False  # for the present matrix
        self._exact: bool | None = None  # whether the hierarchy is a factorisation; None: not known yet
        self.forget()

    def forget(self) -> None:
        """Discard everything learned so far, after the state was set."""
        self.active = False  # multigrid is in use
        self.savings = 0.0  # iterations that multigrid would have saved since it was last in use, or has saved since
        self.uses = self.failures = 0  # solves by multigrid since the last trial without it; times that it did not pay
        self.rate = self.pcg_rate = 0.0  # iterations per decimal digit: first solve with the hierarchy, last one without
        self.release()

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes of the hierarchy, if there is one."""
        return self._arena.bytes | ({"multigrid": self._hierarchy.n_bytes} if self._hierarchy else {})

    def numbers_changed(self) -> None:
        """Update for changed material numbers."""
        self._use_volumes = None
        self.release()

    def free(self) -> None:
        """Free all memory."""
        self.release()
        self._arena.release()

    @property
    def _ratio(self) -> float:
        """Duration of an iteration with the hierarchy over one without."""
        kind = self._exact, self.model.real
        return self.RATIO[kind] + self.OVERHEAD[kind] / self.model.n_nodes

    @property
    def _build_cost(self) -> float:
        """Iterations that the hierarchy must save, its kernels included."""
        return self.BUILD[self._exact] + self.LOADING[self._exact] / self.model.n_nodes

    def release(self) -> None:
        """Discard the hierarchy; the next solve by multigrid builds a new one."""
        self._hierarchy: Factor | CoarseCorrection | None = None
        self._factor: Factor | None = None  # the last one
        self._built: tuple | None = None  # (c, beta, x, free) of the last build

    def snapshot(self) -> dict:
        """Return what later solves depend on."""
        c, beta, x, free = self._built or (0.0, 0.0, np.zeros((0, 3)), np.zeros((0, 3), dtype=bool))
        return {name: getattr(self, name) for name in self.STATE} | {"c": c, "beta": beta, "x": x, "free": free}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        for name, kind in self.STATE.items():
            setattr(self, name, kind(kept[name]))
        self.release()
        if len(kept["x"]):
            self._built = float(kept["c"]), float(kept["beta"]), np.array(kept["x"]), np.array(kept["free"], dtype=bool)

    def matrix_changed(self) -> None:
        """Update for a matrix that was formed."""
        self._is_prepared = False

    def solve(self, stage: Stage, tolerance: float) -> LinearResult:
        """Solve for y of pcg from its rhs, in a stage without contacts, on all nodes, whose matrix is formed."""
        m, done = self.model, 0
        if not m.on_cpu:
            return pcg.solve(m, self._matrix, JACOBI, self._work, tolerance, pcg.iteration_limit(m))
        if self._exact is None:
            self._exact = has_narrow_band(m, self._matrix)
        digits = max(-math.log10(tolerance), 1.0)
        if not self.active:
            worth = self.ITERATIONS * self._ratio
            most = math.ceil(worth + self._build_cost - self.savings)
            found = self._solve_plain(stage.beta, tolerance, min(most, pcg.iteration_limit(m)))
            self._consider_multigrid(found, worth, most, digits)
            if not self.active:
                return found
            done = found.iterations
        found = self._solve_multigrid(stage, tolerance, digits)
        self.uses += 1
        if found is None or self.savings < -self._build_cost:
            self.failures += 1
            self.release()
            self.active, self.uses, self.savings = False, 0, -self._build_cost * float(self.RETRY**self.failures)
        elif self.uses >= self.PERIOD:
            self.active, self.uses, self.savings = False, 0, 0.8 * self._build_cost
        if found is None:
            found = self._solve_plain(stage.beta, tolerance, pcg.iteration_limit(m))
        return replace(found, iterations=done + found.iterations)

    def _consider_multigrid(self, found: LinearResult, worth: float, most: int, digits: float) -> None:
        """Activate multigrid after a solve without it that had to stop at `most` iterations; with it, it is worth `worth`."""
        self.savings = max(self.savings + found.iterations - worth, min(self.savings, 0.0))
        self.pcg_rate = found.iterations / digits
        if most <= found.iterations < pcg.iteration_limit(self.model) and not (found.converged or found.negative):
            self.active, self.savings = True, 0.0
            self.pcg_rate *= self.UNFINISHED

    def _solve_plain(self, beta: float, tolerance: float, most: int) -> LinearResult:
        """Solve with `volumes` or `gauss_seidel`."""
        if self.volumes() is None:
            return gauss_seidel.solve(self.model, self._matrix, self._work, tolerance, most)
        self.prepare(beta)
        return pcg.solve(self.model, self._matrix, self._volumes, self._work, tolerance, most)

    def volumes(self) -> volumes.VolumeSystem | None:
        """Return the system of `volumes` if it is to be used."""
        m = self.model
        if self._use_volumes is None:
            self._use_volumes = m.mean_dilatation and m.on_cpu and volumes.is_nearly_incompressible(m)
            if self._use_volumes and self._volumes is None:
                self._volumes = volumes.build_volume_system(m, self._matrix, self._arena)
                self._use_volumes = self._volumes is not None
        return self._volumes if self._use_volumes else None

    def prepare(self, beta: float) -> None:
        """Prepare `volumes` for the present matrix, unless it is."""
        if not self._is_prepared:
            volumes.prepare_volumes(self.model, self._matrix, self._work, self._volumes, beta**2)
            self._is_prepared = True

    def _solve_multigrid(self, stage: Stage, tolerance: float, digits: float) -> LinearResult | None:
        """Solve with the hierarchy, or with a new one if there is none or it is out of date; None if that fails too."""
        m, A, w, free, wasted = self.model, self._matrix, self._work, self.model.free.host > 0.0, 0
        if self._built is not None and np.array_equal(self._built[3], free):
            if self._hierarchy is None and not self._could_build(*self._built):
                return None
            most = math.ceil(self.GROWTH * self.rate * digits) + self.SLACK
            stiffness = (stage.beta / self._built[1]) ** 2
            found = self._hierarchy.solve(m, A, w, tolerance, most, stiffness)
            if found.converged or found.negative:
                return self._account(found, digits)
            wasted = found.iterations
            self.savings -= self._build_cost
        self.release()
        if not self._could_build(stage.c, stage.beta, m.state.x.to_numpy(), free):
            return None
        found = self._hierarchy.solve(m, A, w, tolerance, self.LONGEST)
        if not (found.converged or found.negative):
            return None
        self.rate = found.iterations / digits
        return self._account(replace(found, iterations=wasted + found.iterations), digits)

    def _account(self, found: LinearResult, digits: float) -> LinearResult:
        """Add what a solve by multigrid saved, as far as it went on."""
        if found.converged:
            self.savings = min(self.savings + self.pcg_rate * digits - self._ratio * found.iterations, self._build_cost)
        return replace(found, multigrid=True)

    def _could_build(self, c: float, beta: float, x: np.ndarray, free: np.ndarray) -> bool:
        """`_build`; False if the matrix is not positive definite."""
        try:
            self._build(c, beta, x, free)
        except np.linalg.LinAlgError:
            return False
        return True

    def _build(self, c: float, beta: float, x: np.ndarray, free: np.ndarray) -> None:
        """Build the hierarchy from the projected matrix at positions x."""
        m, A = self.model, self._matrix
        changed = [m.state.x, A.value, A.diagonal] + ([m.mean.dilatation, A.patches.gradient] if m.mean_dilatation else [])
        present = [(array, array.to_numpy()) for array in changed]
        m.state.x.from_numpy(x)
        self._form(True, c, beta)
        try:
            self._hierarchy, self._built = build_hierarchy(m, A, x, free, self._factor), (c, beta, x, free)
            self._factor = self._hierarchy if isinstance(self._hierarchy, Factor) else None  # whose pattern stays
        finally:
            upload(present)
