"""Cavities of given volume: an incompressible fluid, whose pressure p is the Lagrange multiplier of c = V_0 - V(x) = 0.

Without contacts, each Newton step solves for y and the change q of p together (a bordered system), with g = dV/dx:
    A y - beta q g = -r,   beta g.y = c.
A may be indefinite where the pressure falls as a balloon grows; A + k beta^2 g g^T, which has the same solution, need not be:
    y = y_0 + q z,   y_0 = -(A + k beta^2 g g^T)^-1 r,   z = (A + k beta^2 g g^T)^-1 beta g,   q = (c - beta g.y_0) / (beta g.z),
by conjugate gradients on the host with block-Jacobi preconditioning; the rank-one term costs about one iteration more. Several
cavities are several columns. r is evaluated with p + k c, the gradient of the augmented Lagrangian in x, by whose slope the step
length is searched; A is formed with p alone.
With contacts, and on CUDA, p is fixed while a stage is solved. Then p and v are corrected by q = c / (beta g.z) and q z, with
z = A^-1 beta g, the contacts' terms in A and A projected, and the stage is solved again from there, until c is small. Near the
largest pressure of a balloon that does not converge.
Source: Nocedal, Wright, Numerical Optimization, 2nd ed. 2006, sections 11.1, 16.1 and 17.3.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from taisoft.backend.arrays import upload
from taisoft.dynamics.results import StageResult, count_all
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.pressure import pressures_of
from taisoft.linear import block_csr, host_pcg, pcg
from taisoft.scene.loads import value_at

if TYPE_CHECKING:
    from collections.abc import Callable

    from taisoft.dynamics.stage_system import Stage, StageSystem

TOLERANCE = 1e-6  # of |V - V_0| over V_0
PENALTY = 10.0  # k V_0 over Young's modulus of the body
MAX_CORRECTIONS = 20  # of p, with contacts
MAX_TOLERANCE = 3e-2  # of the linear solves for z without contacts, which the size of r says nothing about
SLOPE_TOLERANCE = 1e-3  # of those with contacts
HELD = 1e-9  # of the largest component of g: if those on free axes are smaller, they are rounding
SINGULAR = 1e-6  # of a diagonal block's largest eigenvalue: smaller ones are raised to it in the preconditioner


class Volumes:
    """The cavities of given volume of a simulation. pressures: (k,) [Pa]; targets: (k,) [m^3]."""

    def __init__(self, simulation: SimulationState):
        self._simulation, scene = simulation, simulation.scene
        self._at = simulation.loads.given_volumes
        found = [pressures_of(scene)[n] for n in self._at]
        self._places = [(k, scene.bodies[k].cavities.index(cavity)) for k, cavity in found]
        self._forms = [simulation.cavity_form(cavity.name) for _, cavity in found]
        self._refuse_held([cavity.name for _, cavity in found])
        self._rest = np.array([cavity.rest_volume for _, cavity in found])
        self.penalised = False  # whether the stage's residual is that of p + k c
        self.slope_change = 0.0  # of the residual along y, by the last change of p

    def _refuse_held(self, names: list[str]) -> None:
        """Raise SceneError for a cavity whose volume cannot change. A dependent node moves if those it depends on can."""
        moves, dependents = ~self._simulation.dirichlet.constrained(), self._simulation.dependents
        if dependents is not None:
            moves[dependents.node] = False
            moves = abs(dependents.matrix) @ moves.astype(np.float64) > 0.0
        for name, form in zip(names, self._forms):
            size = np.abs(form.volume_and_gradient(self._simulation.layout.rest)[1])
            if (size * moves[form.nodes]).max() <= HELD * size.max():
                raise SceneError(f"cavity {name!r}: its volume cannot be given, because its surface is fixed or prescribed")

    def begin(self, time: float, fraction: float = 1.0) -> None:
        """Set the volumes of a time [s], or a fraction of the way there from those at rest. Raises SimulationError."""
        bodies = self._simulation.scene.bodies
        self._cavities = [bodies[k].cavities[n] for k, n in self._places]
        wanted = np.array([float(value_at(one, time, f"cavity {one.name!r}")) for one in self._cavities])
        for cavity, volume in zip(self._cavities, wanted):
            if volume <= 0.0:
                name = cavity.name
                raise SimulationError(f"cavity {name!r}: its volume at t = {time:g} s must be above 0, not {volume:g} m^3")
        self.targets = self._rest + fraction * (wanted - self._rest)
        self.pressures = self._simulation.cavity_pressures.copy()
        young = np.array([float(np.max(bodies[k].young)) for k, _ in self._places])
        self._penalty = PENALTY * young / self._rest
        self.slope_change = 0.0

    def measure(self) -> None:
        """Compute volumes and gradients of the present state, and upload the pressures of the residual there."""
        x = self._simulation.model.state.x.to_numpy()
        found = [form.volume_and_gradient(x) for form in self._forms]
        self.volumes = np.array([volume for volume, _ in found])
        self._gradients = [gradient for _, gradient in found]
        self.upload(self.effective)

    @property
    def missing(self) -> np.ndarray:
        """c = V_0 - V of each cavity (k,) [m^3], at the last `measure`."""
        return self.targets - self.volumes

    @property
    def hold(self) -> bool:
        """Whether all volumes are those given."""
        return bool((np.abs(self.missing) <= TOLERANCE * self.targets).all())

    @property
    def effective(self) -> np.ndarray:
        """Pressures (k,) [Pa] of the residual."""
        return self.pressures + self._penalty * self.missing if self.penalised else self.pressures

    def upload(self, pressures: np.ndarray) -> None:
        """Copy pressures (k,) [Pa] to the device."""
        field = self._simulation.model.amplitudes
        amplitudes = field.to_numpy()
        amplitudes[self._at] = pressures
        upload([(field, amplitudes)])

    def end(self) -> None:
        """Keep the pressures found, from which the next stage starts."""
        self._simulation.set_cavity_pressures(self.effective)

    def problems(self) -> list[str]:
        """Describe cavities whose volume is not the one given."""
        wrong = np.flatnonzero(np.abs(self.missing) > TOLERANCE * self.targets)
        return [
            f"cavity {self._cavities[k].name!r} has a volume of {self.volumes[k]:.8g} m^3 instead of {self.targets[k]:.8g} m^3"
            for k in wrong
        ]

    def _rows(self, beta: float) -> np.ndarray:
        """beta g of each cavity, (k, 3 n_nodes), 0 on constrained axes."""
        m = self._simulation.model
        rows = np.zeros((len(self._forms), m.n_nodes, 3))
        for row, form, gradient in zip(rows, self._forms, self._gradients):
            row[form.nodes] = beta * gradient
        if self._simulation.dependents is not None:
            rows = np.stack([self._simulation.dependents.matrix.T @ row for row in rows])
        return (rows * m.free.to_numpy()).reshape(len(rows), -1)

    def direction(self, system: "StageSystem", tolerance: float) -> pcg.LinearResult:
        """Solve the bordered system for y of pcg, and change the pressures.

        Where it is singular, or A indefinite even when projected, y is y_0 and the pressures stay; where A is not finite, y is 0.
        """
        solution = self._solve_bordered(system, tolerance)
        if not solution.negative:
            return solution
        system.form_matrix(projected=True)
        again = self._solve_bordered(system, tolerance)
        return replace(again, iterations=solution.iterations + again.iterations, negative=False)

    def _solve_bordered(self, system: "StageSystem", tolerance: float) -> pcg.LinearResult:
        m, w, A = system.model, system.work.pcg, system.matrix
        G, right = self._rows(system.stage.beta), w.rhs.host.copy()
        self.slope_change = 0.0
        inverse = block_inverse(A.diagonal.to_numpy(), m.free.to_numpy())
        if inverse is None:
            w.y.host[...] = 0.0
            return pcg.LinearResult(0, False, False)

        def precondition(r: np.ndarray) -> np.ndarray:
            return np.einsum("nrc,nc->nr", inverse, r.reshape(-1, 3)).reshape(-1)

        found, solutions = [], []
        for k, rhs in enumerate((right, *G)):
            w.rhs.host[...] = rhs.reshape(-1, 3)
            accuracy = tolerance if k == 0 else min(tolerance, MAX_TOLERANCE)
            found.append(host_pcg.solve(m, A, w, accuracy, pcg.iteration_limit(m), precondition, (G, self._penalty)))
            solutions.append(w.y.host.astype(np.float64).reshape(-1))
        w.rhs.host[...] = right
        y, z = solutions[0], np.array(solutions[1:])
        negative = any(one.negative for one in found)
        change = None if negative else solve_small(products(G, z), self.missing - products(G, y[None])[:, 0])
        if change is not None:
            y = y + np.einsum("k,kn->n", change, z)
            self.pressures = self.pressures + change
            self.slope_change = -float(change @ products(G, y[None])[:, 0])
        w.y.host[...] = y.reshape(-1, 3)
        converged = change is not None and all(one.converged for one in found)
        return pcg.LinearResult(sum(one.iterations for one in found), converged, negative)

    def correct(self, system: "StageSystem") -> tuple[int, bool]:
        """Change the pressures, and v along with them, to reach the volumes to first order.

        Return the linear iterations, and whether it was possible; if not, nothing is changed.
        """
        m, w = system.model, system.work.pcg
        G, z, n = self._rows(system.stage.beta), [], 0
        system.form_matrix(projected=True)
        for row in G:
            upload([(w.rhs, row.reshape(-1, 3))])
            n += system.solve_linear(SLOPE_TOLERANCE).iterations
            z.append(w.y.to_numpy().astype(np.float64).reshape(-1))
        change = solve_small(products(G, np.array(z)), self.missing)
        if change is None:
            return n, False
        self.pressures = self.pressures + change
        upload([(m.state.v, m.state.v.to_numpy() + np.einsum("k,kn->n", change, np.array(z)).reshape(-1, 3))])
        self.upload(self.pressures)
        return n, True


def products(G: np.ndarray, z: np.ndarray) -> np.ndarray:
    """G z^T of rows (k, n) and (l, n), without BLAS, whose threads cost more and whose sums depend on their number."""
    return np.einsum("kn,ln->kl", G, z)


def solve_small(A: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """A^-1 b (k,); None if A is singular or the result not finite."""
    try:
        x = np.linalg.solve(A, b)
    except np.linalg.LinAlgError:
        return None
    return x if np.isfinite(x).all() else None


def block_inverse(diagonal: np.ndarray, free: np.ndarray) -> np.ndarray | None:
    """Positive definite inverses (n, 3, 3) of the diagonal blocks, 0 on constrained axes; None if a block is not finite.

    diagonal: (n, 12) as stored.
    """
    if not np.isfinite(diagonal).all():
        return None
    mask = free[:, :, None] * free[:, None, :]
    blocks = block_csr.unpacked(diagonal) * mask + np.eye(3) * (1.0 - free[:, :, None])
    values, vectors = np.linalg.eigh(blocks)
    values = np.abs(values)
    values = np.maximum(values, SINGULAR * values.max(axis=1, keepdims=True))
    return np.einsum("nrk,nk,nck->nrc", vectors, 1.0 / values, vectors) * mask


def solve_with_volumes(system: "StageSystem", stage: "Stage", solve_stage: "Callable[[], StageResult]") -> StageResult:
    """Solve a stage by a function, and again with other pressures until its cavities have the given volumes."""
    from taisoft.dynamics.contact_newton import solve

    volumes = system.volumes
    if volumes is None:
        return solve_stage()
    volumes.penalised = system.contact.n_contacts == 0 and system.model.free.host is not None
    result, discarded, linear = solve_stage(), [], 0
    while not volumes.penalised and result.converged and not volumes.hold and len(discarded) < MAX_CORRECTIONS:
        iterations, corrected = volumes.correct(system)
        linear += iterations
        if not corrected:
            break
        discarded.append(result)
        result = solve(system, stage)
    result = replace(count_all(result, discarded), converged=result.converged and volumes.hold)
    if result.converged:
        volumes.end()
    return replace(result, linear_iterations=result.linear_iterations + linear)
