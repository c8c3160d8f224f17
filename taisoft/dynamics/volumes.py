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
from taisoft.errors import SimulationError
from taisoft.fem.pressure import CavityForm, pressures_of
from taisoft.linear import block_csr, host_pcg, pcg
from taisoft.scene.loads import value_at

if TYPE_CHECKING:
    from collections.abc import Callable

    from taisoft.dynamics.stage_system import Stage, StageSystem

TOLERANCE = 1e-6  # of |V - V_0| over V_0
PENALTY = 10.0  # k V_0 over Young's modulus of the body
MAX_CORRECTIONS = 20  # of p, with contacts
SLOPE_TOLERANCE = 1e-3  # of the linear solves for z, with contacts
SINGULAR = 1e-6  # of a diagonal block's largest eigenvalue: smaller ones are raised to it in the preconditioner


class Volumes:
    """The cavities of given volume of a simulation. pressures: (k,) [Pa]; targets: (k,) [m^3]."""

    def __init__(self, simulation: SimulationState):
        self._simulation, scene = simulation, simulation.scene
        self._at = simulation.loads.given_volumes
        found = [pressures_of(scene)[n] for n in self._at]
        self._places = [(k, scene.bodies[k].cavities.index(cavity)) for k, cavity in found]
        self._forms = [CavityForm(scene.bodies[k], cavity, simulation.layout.node_start[k]) for k, cavity in found]
        self._rest = np.array([cavity.rest_volume for _, cavity in found])
        self.penalised = False  # whether the stage's residual is that of p + k c
        self.slope_change = 0.0  # of the residual along y, by the last change of p

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
        """Solve the bordered system for y of pcg, and change the pressures."""
        solution = self._solve_bordered(system, tolerance)
        if not solution.negative:
            return solution
        system.form_matrix(projected=True)
        again = self._solve_bordered(system, tolerance)
        return replace(again, iterations=solution.iterations + again.iterations, negative=False)

    def _solve_bordered(self, system: "StageSystem", tolerance: float) -> pcg.LinearResult:
        m, w, A = system.model, system.work.pcg, system.matrix
        G, right = self._rows(system.stage.beta), w.rhs.host.copy()
        inverse = block_inverse(A.diagonal.to_numpy(), m.free.to_numpy())

        def precondition(r: np.ndarray) -> np.ndarray:
            return np.einsum("nrc,nc->nr", inverse, r.reshape(-1, 3)).reshape(-1)

        found, solutions = [], []
        for rhs in (right, *G):
            w.rhs.host[...] = rhs.reshape(-1, 3)
            limit = pcg.iteration_limit(m)
            found.append(host_pcg.solve(m, A, w, tolerance, limit, precondition, (G, self._penalty)))
            solutions.append(w.y.host.astype(np.float64).reshape(-1))
        w.rhs.host[...] = right
        y, z = solutions[0], np.array(solutions[1:])
        change = np.linalg.solve(G @ z.T, self.missing - G @ y)
        negative = any(one.negative for one in found)
        if not negative:
            y = y + change @ z
            w.y.host[...] = y.reshape(-1, 3)
            self.pressures = self.pressures + change
            self.slope_change = -float(change @ (G @ y))
        return pcg.LinearResult(sum(one.iterations for one in found), all(one.converged for one in found), negative)

    def correct(self, system: "StageSystem") -> int:
        """Change the pressures, and v along with them, to reach the volumes to first order; return the linear iterations."""
        m, w = system.model, system.work.pcg
        G, z, n = self._rows(system.stage.beta), [], 0
        system.form_matrix(projected=True)
        for row in G:
            upload([(w.rhs, row.reshape(-1, 3))])
            n += system.solve_linear(SLOPE_TOLERANCE).iterations
            z.append(w.y.to_numpy().astype(np.float64).reshape(-1))
        change = np.linalg.solve(G @ np.array(z).T, self.missing)
        self.pressures = self.pressures + change
        upload([(m.state.v, m.state.v.to_numpy() + (change @ np.array(z)).reshape(-1, 3))])
        self.upload(self.pressures)
        return n


def block_inverse(diagonal: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Positive definite inverses (n, 3, 3) of the diagonal blocks, 0 on constrained axes. diagonal: (n, 12) as stored."""
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
        discarded.append(result)
        linear += volumes.correct(system)
        result = solve(system, stage)
    result = replace(count_all(result, discarded), converged=result.converged and volumes.hold)
    if result.converged:
        volumes.end()
    return replace(result, linear_iterations=result.linear_iterations + linear)
