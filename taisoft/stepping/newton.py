"""Newton's method for one implicit stage, shared by every implicit integrator and the static solve.

Unknown v (with x = x_hat + beta v), residual on the free axes
    r(v) = c M (v - v_hat) - beta (f_el(x) + f_loads + M g - a M v - b K_d v),
system (c + beta a) M + beta^2 K(x) + beta b K_d, the gradient and second derivative of
    Phi(v) = c/2 |v - v_hat|^2_M + psi(x) - loads.x - M g.x + beta/2 v.(a M + b K_d) v.
c = 1 for a time step, 0 for statics (v is then a displacement). A full step that lowers |r| is taken; otherwise Phi
decides by backtracking. K is unprojected; negative curvature in CG asks for the projected one. CG's tolerance follows
Newton's progress (Eisenstat and Walker 1996, choice 2).
Convergence: |r| <= tolerance * scale + floor, scale = |c M (v - v_hat)| + beta (|f_el| + |f_ext|) on the free axes; floor is
the rounding of the stress, eps * the force that a strain of 1 would make: below it lies only noise. In statics the scale is
the applied load (without any: the constraint forces) and there is no floor.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.elasticity import elastic_forces, measure
from taisoft.elements import gather
from taisoft.linear import block_csr, pcg
from taisoft.linear.block_csr import BlockCsr, row_times
from taisoft.model import Model
from taisoft.runtime import FieldArena, kernel

MAX_BACKTRACKS = 30  # halvings: below 1e-9 of a step nothing but rounding is left
MAX_FORCING = 0.1  # CG's loosest tolerance
SUFFICIENT = 1e-4  # Armijo's share of the predicted decrease


@dataclass(frozen=True, eq=False)
class StageWork:
    """Fields of a stage; (n_nodes) 3-vectors."""

    x_hat: Any  # f64
    v_hat: Any
    base: Any  # v before the step that is being tried
    residual: Any  # on all axes: constraint impulses where not free
    moved: Any  # (n_moved) i32
    moved_axes: Any  # (n_moved, 3) i32
    targets: Any  # (n_moved) f64 3-vectors
    n_moved: int
    damper: Any  # BlockCsr or None


@dataclass(frozen=True)
class StageResult:
    """What a solve did."""

    newton_iterations: int
    linear_iterations: int
    residual: float  # relative
    converged: bool
    projected: bool  # a projected matrix was needed


@ti.func
def lead_rows(m: ti.template(), w: ti.template()):
    for k in range(w.n_moved):
        for a in ti.static(range(3)):
            if w.moved_axes[k][a] != 0:
                m.x[w.moved[k]][a] = w.targets[k][a]


@kernel
def begin_stage(m: ti.template(), w: ti.template(), beta: ti.f64):
    """Constrained velocities from the targets (0 on fixed axes is v's own state), then x from v."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        m.x[i] = w.x_hat[i] + beta * ti.cast(m.v[i], ti.f64)
    ti.loop_config(serialize=True)
    for k in range(w.n_moved):
        i = w.moved[k]
        for a in ti.static(range(3)):
            if w.moved_axes[k][a] != 0:
                m.v[i][a] = ti.cast((w.targets[k][a] - w.x_hat[i][a]) / beta, m.real)
                m.x[i][a] = w.targets[k][a]


@kernel
def form_residual(m: ti.template(), w: ti.template(), p: ti.template(), c: ti.f64, beta: ti.f64):
    """Residual from the corner buffer, -r as CG's right side, inertia of the system.

    partial 0..4: |r|^2, |c M dv|^2, |f_el|^2, |f_ext|^2 on the free axes, |r|^2 on the others; scalars 8..12 their sums.
    """
    ti.loop_config(serialize=m.serial)
    for k in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        s = ti.Vector([0.0, 0.0, 0.0, 0.0, 0.0], ti.f64)
        for i in range(k * size, ti.min(m.n_nodes, (k + 1) * size)):
            b, mass, free = ti.cast(beta, m.real), m.mass[i], m.free[i]
            inertia = ti.cast(c, m.real) * mass
            f = gather(m, i)
            external = mass * m.gravity[0]
            if ti.static(m.loaded):
                external += m.loads[i]
            drag = ti.Vector([0.0, 0.0, 0.0], m.real)
            if ti.static(m.damped):
                a = m.damping[m.node_body[i], 0]
                drag += a * mass * m.v[i]
                inertia += b * a * mass
            if ti.static(m.stiffness_damping):
                drag += m.damping[m.node_body[i], 1] * row_times(m, w.damper, i, m.v)
            change = ti.cast(c, m.real) * mass * (m.v[i] - w.v_hat[i])
            r = change - b * (f + external - drag)
            w.residual[i] = r
            p.rhs[i] = -free * r
            p.shift[i] = inertia
            s += ti.Vector(
                [norm2(free * r), norm2(free * change), norm2(free * f), norm2(free * external), norm2((1.0 - free) * r)]
            )
        for j in ti.static(range(5)):
            m.partial[k, j] = s[j]
    ti.loop_config(serialize=True)
    for _ in range(1):
        for j in ti.static(range(5)):
            m.scalars[8 + j] = pcg.total(m, j)


@ti.func
def norm2(a):
    b = ti.cast(a, ti.f64)
    return b.dot(b)


@kernel
def try_step(m: ti.template(), w: ti.template(), y: ti.template(), share: ti.f64, beta: ti.f64):
    """v = base + share y, x accordingly."""
    ti.loop_config(serialize=m.serial)
    for i in range(m.n_nodes):
        v = w.base[i] + ti.cast(share, m.real) * y[i]
        m.v[i] = v
        m.x[i] = w.x_hat[i] + beta * ti.cast(v, ti.f64)
    ti.loop_config(serialize=True)
    for _ in range(1):
        lead_rows(m, w)


@kernel
def keep_base(m: ti.template(), w: ti.template(), y: ti.template()):
    """base = v; scalars 13: slope r.y of the step y (its sign: negative is downhill)."""
    ti.loop_config(serialize=m.serial)
    for k in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        for i in range(k * size, ti.min(m.n_nodes, (k + 1) * size)):
            w.base[i] = m.v[i]
            s += pcg.dot64(m.free[i] * w.residual[i], y[i])
        m.partial[k, 5] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.scalars[13] = pcg.total(m, 5)


@kernel
def stage_terms(m: ti.template(), w: ti.template(), c: ti.f64, beta: ti.f64):
    """Inertia, loads and damping terms of Phi, in f64: scalars 14."""
    ti.loop_config(serialize=m.serial)
    for k in range(m.chunks):
        size = (m.n_nodes + m.chunks - 1) // m.chunks
        s = ti.cast(0.0, ti.f64)
        for i in range(k * size, ti.min(m.n_nodes, (k + 1) * size)):
            mass, v = ti.cast(m.mass[i], ti.f64), ti.cast(m.v[i], ti.f64)
            d = v - ti.cast(w.v_hat[i], ti.f64)
            s += 0.5 * c * mass * d.dot(d)
            if ti.static(m.loaded):
                s -= ti.cast(m.loads[i], ti.f64).dot(m.x[i])
            if ti.static(m.damped):
                s += 0.5 * beta * m.damping[m.node_body[i], 0] * mass * v.dot(v)
            if ti.static(m.stiffness_damping):
                s += 0.5 * beta * m.damping[m.node_body[i], 1] * pcg.dot64(m.v[i], row_times(m, w.damper, i, m.v))
        m.partial[k, 5] = s
    ti.loop_config(serialize=True)
    for _ in range(1):
        m.scalars[14] = pcg.total(m, 5)


def _forcing(last: float, r: float, previous: float) -> float:
    """CG's tolerance from Newton's progress: Eisenstat and Walker's choice 2, with their safeguard."""
    if previous == 0.0:
        return MAX_FORCING
    wanted, guard = 0.9 * (r / previous) ** 2, 0.9 * last**2
    return min(MAX_FORCING, max(wanted, guard if guard > 0.1 else 0.0))


class StageSolver:
    """Owns the matrix and the vectors of implicit stages over one model."""

    def __init__(self, model: Model, arena: FieldArena, eps: float, moved: np.ndarray):
        self.model, self.eps = model, eps
        self.matrix: BlockCsr = block_csr.build_block_csr(model, arena, model.real)
        self.damper = block_csr.sibling(self.matrix, model, arena, model.real, "damping") if model.stiffness_damping else None
        self.pcg = pcg.build_pcg(model, arena, self.damper)
        n, k = model.n_nodes, max(1, len(moved))
        self.work = StageWork(
            x_hat=arena.vectors("x_hat", ti.f64, n), v_hat=arena.vectors("v_hat", model.real, n),
            base=arena.vectors("v_base", model.real, n), residual=arena.vectors("residual", model.real, n),
            moved=arena.field("stage_moved", ti.i32, k, moved.astype(np.int32) if len(moved) else None),
            moved_axes=arena.vectors("stage_moved_axes", ti.i32, k), targets=arena.vectors("stage_targets", ti.f64, k),
            n_moved=len(moved), damper=self.damper,
        )  # fmt: skip
        self.rounding_force = 0.0

    def update_material(self) -> None:
        """Recompute the rounding floor: eps times the nodal forces of a strain of 1."""
        m = self.model
        volume, Dm_inv = m.volume.to_numpy().astype(np.float64), m.Dm_inv.to_numpy().astype(np.float64)
        stiff = np.abs(m.law_constants.to_numpy()[:, :2]).sum(axis=1)[m.block_body.to_numpy()]
        g = np.sqrt((Dm_inv**2).sum(axis=1))
        self.rounding_force = self.eps * float(np.sqrt(((stiff[:, None] * volume * g) ** 2).sum()))

    def assemble_damper(self) -> None:
        """K_d = projected K at the present x, for the step that begins."""
        if self.damper is not None:
            block_csr.assemble(self.model, self.damper, True)

    def _evaluate(self, c: float, beta: float) -> tuple[float, float]:
        """(|r|, scale) at the present v and x."""
        elastic_forces(self.model)
        form_residual(self.model, self.work, self.pcg, c, beta)
        r, inertia, elastic, external, held = (float(s) for s in np.sqrt(self.model.scalars.to_numpy()[8:13]))
        if c == 0.0:
            return r, beta * external if external > 0.0 else held
        return r, inertia + beta * (elastic + external)

    def _objective(self, c: float, beta: float) -> float:
        measure(self.model)
        stage_terms(self.model, self.work, c, beta)
        s = self.model.scalars.to_numpy()
        return float(s[0] + s[4] + s[14])

    def _direction(self, beta: float, tolerance: float, max_iterations: int, projected: bool) -> pcg.LinearResult:
        block_csr.assemble(self.model, self.matrix, projected)
        self.pcg.factor[0], self.pcg.factor[1] = beta * beta, beta
        return pcg.solve(self.model, self.matrix, self.pcg, tolerance, max_iterations)

    def solve(
        self, c: float, beta: float, tolerance: float, max_newton: int, linear_tolerance: float | None = None,
        by_energy: bool = False,
    ) -> StageResult:  # fmt: skip
        """Solve the stage from the present v. x_hat, v_hat and the targets are set by the caller.

        by_energy: every step must lower Phi (statics); otherwise a lower |r| is enough. max_newton = 1 takes one full
        step without looking back (linearly implicit).
        """
        begin_stage(self.model, self.work, beta)
        r, scale = self._evaluate(c, beta)
        limit = beta * self.rounding_force if c > 0.0 else 0.0
        newton = linear = 0
        needs_projection, forcing, previous = False, MAX_FORCING, 0.0
        max_linear = max(200, 3 * self.model.n_nodes)
        while not r <= tolerance * scale + limit and newton < max_newton:
            wanted = linear_tolerance
            if wanted is None:
                forcing = _forcing(forcing, r, previous)
                # the last solve need not go far below what Newton asks for; a single one has nobody to correct it
                wanted = tolerance if max_newton == 1 else max(forcing, 0.1 * (tolerance * scale + limit) / r, 1e-12)
            answer = self._direction(beta, wanted, max_linear, needs_projection)
            linear += answer.iterations
            if answer.negative:
                needs_projection = True
                answer = self._direction(beta, wanted, max_linear, True)
                linear += answer.iterations
            previous = r
            r, scale, moved = self._advance(c, beta, r, scale, max_newton == 1, by_energy)
            newton += 1
            if not moved:
                if needs_projection:
                    break
                needs_projection = True  # the unprojected direction did not go downhill
        converged = bool(r <= tolerance * scale + limit) or max_newton == 1
        relative = r / scale if scale > 0.0 else 0.0
        return StageResult(newton, linear, relative, converged and np.isfinite(r), needs_projection)

    def _advance(self, c: float, beta: float, r: float, scale: float, blind: bool, by_energy: bool):
        """Take the step in pcg.y as far as it helps; returns (|r|, scale, moved)."""
        m, w, y = self.model, self.work, self.pcg.y
        keep_base(m, w, y)
        slope = float(m.scalars[13])
        start = self._objective(c, beta) if by_energy else None
        try_step(m, w, y, 1.0, beta)
        if not by_energy:
            new_r, new_scale = self._evaluate(c, beta)
            if blind or new_r < r:
                return new_r, new_scale, True
            try_step(m, w, y, 0.0, beta)
            start = self._objective(c, beta)
            try_step(m, w, y, 1.0, beta)
        share = 1.0
        # Phi's own rounding: the elastic terms of f32 forces are only good to eps, so tiny rises are not rises
        slack = 10.0 * np.finfo(np.float64).eps * abs(start)
        for _ in range(MAX_BACKTRACKS):
            value = self._objective(c, beta)
            if np.isfinite(value) and value <= start + SUFFICIENT * share * slope + slack and slope < 0.0:
                new_r, new_scale = self._evaluate(c, beta)
                return new_r, new_scale, True
            share *= 0.5
            try_step(m, w, y, share, beta)
        try_step(m, w, y, 0.0, beta)
        r, scale = self._evaluate(c, beta)
        return r, scale, False
