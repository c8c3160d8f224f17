"""Lagrange multipliers: pressures of cavities of given volume, tensions of inextensible tendons.

The pressure p of an incompressible fluid is the multiplier of c = V_0 - V(x) = 0. A tendon of given length L has V = -l and
V_0 = -L, and its tension p is the multiplier of c = l - L <= 0, p >= 0, p c = 0: it slackens, but does not push.
Without contacts, each Newton step solves for y and the change q of p together (a bordered system), with g = dV/dx:
    A y - beta q g = -r,   beta g.y = c, or for a tendon that slackens, beta g.y >= c and p + q = 0.
A may be indefinite where the pressure falls as a balloon grows; A + k beta^2 g g^T, which has the same solution, need not be:
    y = y_0 + s z,   y_0 = -(A + k beta^2 g g^T)^-1 r,   z = (A + k beta^2 g g^T)^-1 beta g,
by conjugate gradients with block-Jacobi preconditioning; the rank-one term costs about one iteration more. Several
multipliers are several columns, and `solve_active` finds s and which tendons slacken. r is evaluated with p + k c, at least 0 for
tendons: the gradient of the augmented Lagrangian in x, by whose slope the step length is searched; A is formed with p alone.
With contacts, and on CUDA, p is fixed while a stage is solved. Then p and v are corrected in the same way, with A^-1 for the
contacts' terms in A and A projected, k = 0 and y_0 = 0, and the stage is solved again from there, until c is small. Near the
largest pressure of a balloon that does not converge.
Source: Nocedal, Wright, Numerical Optimization, 2nd ed. 2006, sections 11.1, 16.1, 17.3 and 17.4.
"""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import download, upload
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.loads import number_at
from taisoft.fem.spring_table import LengthForm
from taisoft.linear import pcg
from taisoft.linear.bordered import products, solve_active
from taisoft.scene.connection_records import Tendon
from taisoft.scene.loads import Cavity

TOLERANCE = 1e-6  # of |c| over V_0
PENALTY = 10.0  # k V_0 over Young's modulus of a cavity's body
HELD = 1e-9  # of the largest component of g: if those on free axes are smaller, they are rounding


class Multipliers:
    """The multipliers of a simulation. values: (k,) [Pa] or [N]; targets: V_0 (k,) [m^3], or -L [m]."""

    def __init__(self, simulation: SimulationState):
        self._simulation, scene = simulation, simulation.scene
        self._at = simulation.loads.multipliers
        cavities = [one for body in scene.bodies for one in body.cavities if one.given == "volume"]
        self._owners: list[Cavity | Tendon] = [*cavities, *(one for one in scene.tendons if one.is_inextensible)]
        self._is_tendon = np.array([isinstance(one, Tendon) for one in self._owners])
        self._forms = [self._form(one) for one in self._owners]
        self._refuse_held()
        self._rest = np.array([form.value_and_gradient(simulation.layout.rest)[0] for form in self._forms])
        self._weight = float(np.linalg.norm(scene.gravity)) * sum(body.mass for body in scene.bodies)  # [N]
        self.penalised = False  # whether the stage's residual is that of p + k c
        self.slope_change = 0.0  # of the residual along y, by the last change of p
        self._stored: pcg.Border | None = None

    def _form(self, owner: Cavity | Tendon):
        simulation = self._simulation
        return LengthForm(simulation.springs, owner.name) if isinstance(owner, Tendon) else simulation.cavity_form(owner.name)

    def _refuse_held(self) -> None:
        """Raise SceneError for what cannot change. A dependent node moves if those it depends on can."""
        moves, dependents = ~self._simulation.dirichlet.constrained(), self._simulation.dependents
        if dependents is not None:
            moves[dependents.node] = False
            moves = abs(dependents.matrix) @ moves.astype(np.float64) > 0.0
        for owner, form in zip(self._owners, self._forms):
            if isinstance(owner, Tendon):
                if not moves[form.nodes].any():
                    raise SceneError(
                        f"tendon {owner.name!r}: its length cannot be given, because its points are fixed or prescribed"
                    )
                continue
            size = np.abs(form.value_and_gradient(self._simulation.layout.rest)[1])
            if (size * moves[form.nodes]).max() <= HELD * size.max():
                raise SceneError(f"cavity {owner.name!r}: its volume cannot be given, because its surface is fixed or prescribed")

    def static_start(self) -> np.ndarray:
        """Values (k,) from which statics starts: tendons carry the weight, and so hold bodies across from the first step."""
        return np.where(self._is_tendon, self._weight / max(1, int(self._is_tendon.sum())), 0.0)

    def begin(self, time: float, penalised: bool) -> None:
        """Set volumes and lengths of a time [s]. Raises SimulationError.

        penalised: whether the stage's residual is that of p + k c, and p changes while it is solved.
        """
        self.penalised = penalised
        scene = self._simulation.scene
        tendons = {one.name: one for one in scene.tendons}
        present = [tendons[one.name] if isinstance(one, Tendon) else scene.cavity(one.name)[1] for one in self._owners]
        at, fraction = self._simulation.at, self._simulation.fraction(time)
        wanted = np.array([self._wanted(one, time if at is None else at) for one in present])
        grows = np.array([at is not None or one.path is None for one in present])
        self.targets = self._rest + np.where(grows, fraction, 1.0) * (wanted - self._rest)
        self.values = self._simulation.now.multipliers.copy()
        young = [1.0 if isinstance(one, Tendon) else float(np.max(scene.cavity(one.name)[0].young)) for one in present]
        force = np.where(self._is_tendon, np.maximum(self.values, self._weight), PENALTY * np.array(young))
        self.penalty = force / np.abs(np.where(self._is_tendon, self.targets, self._rest))
        self.slope_change = 0.0

    def _wanted(self, owner: Cavity | Tendon, time: float) -> float:
        """The target of a volume or a length at a time [s]."""
        value = number_at(owner, time, f"{_kind(owner)} {owner.name!r}")
        if isinstance(owner, Tendon):
            return -value
        if value <= 0.0:
            raise SimulationError(f"cavity {owner.name!r}: its volume at t = {time:g} s must be above 0, not {value:g} m^3")
        return value

    def measure(self) -> None:
        """Compute V and gradients of the present state, and upload the multipliers of the residual there."""
        x, amplitudes = download([self._simulation.model.state.x, self._simulation.model.amplitudes])
        for form in self._forms:
            form.set_amplitudes(amplitudes)
        found = [form.value_and_gradient(x) for form in self._forms]
        self._present = np.array([value for value, _ in found])
        self._gradients = [gradient for _, gradient in found]
        self.upload(self.effective)

    @property
    def missing(self) -> np.ndarray:
        """c = V_0 - V (k,) [m^3], or the excess of length [m], at the last `measure`."""
        return self.targets - self._present

    @property
    def _wrong(self) -> np.ndarray:
        """Which volumes (k,) are not those given, which tendons are too long, or slack under tension."""
        accurate = np.abs(self.missing) <= TOLERANCE * np.abs(self.targets)
        slack = self._is_tendon & (self.missing < 0.0) & (self.effective == 0.0)
        return ~(accurate | slack)

    @property
    def hold(self) -> bool:
        """Whether all volumes and lengths are those given."""
        return not self._wrong.any()

    @property
    def effective(self) -> np.ndarray:
        """Multipliers (k,) of the residual."""
        if not self.penalised:
            return self.values
        shifted = self.values + self.penalty * self.missing
        return np.where(self._is_tendon, np.maximum(shifted, 0.0), shifted)

    def upload(self, values: np.ndarray) -> None:
        """Copy multipliers (k,) to the device."""
        field = self._simulation.model.amplitudes
        amplitudes = field.to_numpy()
        amplitudes[self._at] = values
        upload([(field, amplitudes)])

    def end(self) -> None:
        """Keep the multipliers found, from which the next stage starts."""
        self._simulation.set_multipliers(self.effective)

    def problems(self) -> list[str]:
        """Describe cavities whose volume is not the one given, and tendons that are too long."""
        found = []
        for k in np.flatnonzero(self._wrong):
            owner, is_now, wanted = self._owners[k], self._present[k], self.targets[k]
            if not self._is_tendon[k]:
                found.append(f"cavity {owner.name!r} has a volume of {is_now:.8g} m^3 instead of {wanted:.8g} m^3")
            elif self.missing[k] > 0.0:
                found.append(f"tendon {owner.name!r} is {-is_now:.8g} m long instead of {-wanted:.8g} m")
            else:
                found.append(f"tendon {owner.name!r} of {-wanted:.8g} m is slack, but has a tension of {self.effective[k]:.3g} N")
        return found

    @property
    def candidates(self) -> np.ndarray:
        """Multipliers that may change: not those of tendons that are slack now; of some that tighten, the next step decides."""
        return np.flatnonzero(~self._is_tendon | (self.values > 0.0) | (self.missing > 0.0))

    def rows(self, beta: float, chosen: np.ndarray) -> np.ndarray:
        """beta g of the chosen, (k, 3 n_nodes), 0 on constrained axes."""
        m = self._simulation.model
        rows = np.zeros((len(chosen), m.n_nodes, 3))
        for row, k in zip(rows, chosen):
            row[self._forms[k].nodes] = beta * self._gradients[k]
        if self._simulation.dependents is not None:
            rows = np.stack([self._simulation.dependents.matrix.T @ row for row in rows])
        return (rows * m.free.to_numpy()).reshape(len(rows), -1)

    def border(self, G: np.ndarray, factors: np.ndarray) -> pcg.Border:
        """The term G^T s G for rows (k, 3 n_nodes) and factors (k,)."""
        n_nodes, capacity = self._simulation.model.n_nodes, len(self._owners)
        if self._stored is None:
            arena = self._simulation.arena
            self._stored = pcg.Border(
                n=arena.field("border_rows", ti.i32, 1),
                row=arena.vectors("border_row", ti.f64, capacity * n_nodes),
                factor=arena.field("border_factor", ti.f64, capacity),
                product=arena.field("border_product", ti.f64, capacity),
            )
        k = len(G)
        self._stored.n.host[0] = k
        self._stored.row.host[: k * n_nodes] = G.reshape(-1, 3)
        self._stored.factor.host[:k] = factors
        return self._stored

    def change(
        self, G: np.ndarray, y: np.ndarray, z: np.ndarray, shift: np.ndarray, penalty: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Change the candidates to reach c = 0 to first order. None: singular, no change.

        Return the factors s of z, and the changes of the residual's multipliers.
        """
        chosen, before = self.candidates, self.effective
        solved = solve_active(
            products(G, z),
            products(G, y[None])[:, 0],
            self.missing[chosen],
            self.values[chosen],
            shift,
            penalty,
            self._is_tendon[chosen],
        )
        if solved is None:
            return None
        factors, values = solved
        self.values = self.values.copy()
        self.values[chosen] = values
        return factors, (self.effective - before)[chosen]


def _kind(owner: Cavity | Tendon) -> str:
    return type(owner).__name__.lower()
