"""Connected pieces of a scene: each counts by itself, and the rigid motion of free ones is known in closed form.

Newton's method and CG end on norms over the whole scene, in which the forces on a light or little strained piece vanish beside
those of a heavy one. So norms are sums of |r|_p^2 / s_p^2 over the pieces p, with
    s_p = |M (v - v_hat)|_p + beta (|f_internal|_p + |loads|_p),
but at least so large that rounding is below the tolerance; and the right side of a linear solve is scaled so that all components,
pieces joined by connections, have the same energy norm.

Internal forces have no resultant and no moment. A free component therefore obeys, with arms from its centre,
    sum_i [M (v - v_hat)]_i - beta loads_i = 0,   sum_i arm_i x ([M (v - v_hat)]_i - beta loads_i) = 0,
mass damping in M (v - v_hat). However loosely a stage is solved, its v is corrected by the rigid motion that restores both sums.
In a linearly implicit step the arms are those of its start, and the forces f - beta K v, whose moment is beta sum_i f_i x v_i.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, FieldArena, download
from taisoft.dynamics.rigid_balance import N_MOMENTS, N_SUMS, N_TERMS, measure_pieces
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.stage import StageWork
from taisoft.mesh.topology import connected_pieces, linked_groups

RIGID = 1e-10  # least over largest eigenvalue of what holds a component: below it some rigid motion is left
ROUNDED = 1e-12  # sum of the weights of an element of springs, between points of bodies: 0 but for rounding


@dataclass(frozen=True, eq=False)
class PieceWork:
    """Pieces in the order of their components, for kernels."""

    several: bool  # whether norms have weights
    n: Count
    n_components: Count
    n_rows: Count
    row_start: Any  # (n_rows + 1) i32: first place of each row in `node`
    piece_row: Any  # (n + 1) i32: first row of each piece
    component_row: Any  # (n_components + 1) i32: first row of each component
    node: Any  # (n_nodes) i32: nodes by piece
    piece: Any  # (n_nodes) i32 of each node
    component: Any  # (n_nodes) i32 of each node
    weight: Any  # (n) f64: 1 / s_p^2
    factor: Any  # (n_components) f64: of right sides and solutions of linear solves
    norms: Any  # (n, N_SUMS) f64
    sums: Any  # (n_rows, N_TERMS) f64: scratch
    anchored: Any  # (n_components) i32: 1 if forces from outside other than loads act on it
    pressed: Any  # (n_components) i32: 1 if pressures act on it, which change in a linearised step
    held: Any  # (n_components) i32: scratch, state of `correct_rigid_motion`
    moments: Any  # (n_components, N_MOMENTS) f64: scratch: mass, centre, resultant, constraints by axis
    motion: Any  # (n_components, 6) f64: correction, velocity of the centre and angular velocity


class Pieces:
    """The pieces of a simulation, their names, and the kernels' record of them."""

    LIMIT = 0.01  # of the forces on a piece: a larger mean residual of a linearised step means wrong motion
    NEGLIGIBLE_MOMENTUM = 1e-9  # of a piece's momentum and forces: momentum error that a step may always make
    MEAN_ROUNDING = 4.0  # times the rounding of a mean residual
    REACH = 0.25  # of the size of a piece: the most that it moves in a static iteration where nothing resists
    ROW = 256  # least nodes of a partial sum: of larger scenes, the root of all nodes

    def __init__(self, simulation: SimulationState, arena: FieldArena):
        self.model = simulation.model
        piece, names, self.body = _pieces(simulation)
        n_nodes, n = len(piece), len(names)
        anchored, component = _components(simulation, piece, n)
        pressed = np.zeros(len(anchored), dtype=np.int32)
        pressed[component[[bool(simulation.scene.bodies[k].pressures) for k in self.body]]] = 1
        self.anchored = anchored > 0
        order = np.argsort(component[piece] * n + piece, kind="stable")
        number = np.unique(component * n + np.arange(n), return_inverse=True)[1]  # of each piece, by component
        self._names, self.body = [names[k] for k in np.argsort(number)], self.body[np.argsort(number)]
        component, piece = component[np.argsort(number)], number[piece]
        self.of_node, self._component = piece, component[piece]
        self._simulation = simulation
        self.weights, self._is_uploaded = np.ones(n), True  # those of `work`, which lag behind until they are needed
        self._loose_free, self._loose = np.zeros(0), True  # of the last call of `any_loose`
        self._free, self._any_free = np.zeros(0), False  # of the last call of `any_free`
        self._independent = np.ones(n_nodes, dtype=bool)
        if simulation.dependents is not None:
            self._independent[simulation.dependents.node] = False
        layout = simulation.layout
        first_node = np.concatenate([b.nodes.elements[:, 0] + s for b, s in zip(simulation.scene.bodies, layout.node_start)])
        self.of_lane = piece[first_node[layout.tet_of_lane]]
        length = max(self.ROW, math.isqrt(n_nodes))
        rows = [-(-count // length) for count in np.bincount(piece, minlength=n)]
        first = np.concatenate([[0], np.cumsum(np.bincount(piece, minlength=n))])
        starts = np.concatenate([first[k] + length * np.arange(rows[k]) for k in range(n)] + [[n_nodes]])
        piece_row = np.concatenate([[0], np.cumsum(rows)])
        n_components, n_rows = int(component.max()) + 1, int(piece_row[-1])

        def ids(name: str, data):
            return arena.field(f"piece_{name}", ti.i32, len(data), np.asarray(data, dtype=np.int32))

        def numbers(name: str, shape, data=None):
            return arena.field(f"piece_{name}", ti.f64, shape, data)

        self.work = PieceWork(
            several=n > 1,
            n=n,
            n_components=n_components,
            n_rows=n_rows,
            row_start=ids("row_start", starts),
            piece_row=ids("row", piece_row),
            component_row=ids("component_row", piece_row[np.searchsorted(component, np.arange(n_components + 1))]),
            node=ids("node", order),
            piece=ids("number", piece),
            component=ids("component", component[piece]),
            weight=numbers("weight", n, np.ones(n)),
            factor=numbers("factor", n_components, np.ones(n_components)),
            norms=numbers("norms", (n, N_SUMS)),
            sums=numbers("sums", (n_rows, N_TERMS)),
            anchored=ids("anchored", anchored),
            pressed=ids("pressed", pressed),
            held=ids("held", anchored),
            moments=numbers("moments", (n_components, N_MOMENTS)),
            motion=numbers("motion", (n_components, 6)),
        )

    @property
    def several(self) -> bool:
        """Whether there are several pieces."""
        return self.work.several

    def node_weights(self) -> np.ndarray:
        """Return 1 / s_p of each node's piece (n_nodes,)."""
        return np.sqrt(self.weights)[self.of_node]

    def any_free(self) -> bool:
        """Return whether some component is free along some axis, but for contacts."""
        if (free := self._simulation.free) is not self._free:
            held = (free == 0.0) & self._independent[:, None]
            fixed = [np.bincount(self._component, held[:, axis], len(self.anchored)) for axis in range(3)]
            self._free, self._any_free = free, bool(((np.array(fixed) == 0.0) & ~self.anchored).any())
        return self._any_free

    def any_loose(self) -> bool:
        """Return whether constraints leave some component a rigid motion, as of a hinge."""
        if (free := self._simulation.free) is not self._loose_free:
            rest = self._simulation.layout.rest
            node, axis = np.nonzero((free == 0.0) & self._independent[:, None])
            along, n = np.eye(3)[axis], len(self.anchored)
            arm = (rest[node] - rest.mean(axis=0)) / np.ptp(rest, axis=0).max()
            held = np.hstack([along, np.cross(arm, along)])  # its work is zero in the motions that are left
            number = 36 * self._component[node][:, None] + np.arange(36)
            grams = np.bincount(number.ravel(), (held[:, :, None] * held[:, None]).ravel(), 36 * n).reshape(n, 6, 6)
            least, *_, largest = np.linalg.eigvalsh(grams).T
            self._loose_free, self._loose = free, bool((least <= RIGID * largest).any())
        return self._loose

    def _sums(self, values: np.ndarray) -> np.ndarray:
        """Return the sums (3, n) over each piece of values (n_nodes, 3)."""
        return np.array([np.bincount(self.of_node, values[:, axis], self.work.n) for axis in range(3)])

    @cached_property
    def _size(self) -> np.ndarray:
        """Sizes (n,) of the pieces at rest [m]."""
        rest, ends = self._simulation.layout.rest, np.full((2, self.work.n, 3), -np.inf)
        for end, sign in zip(ends, (1.0, -1.0)):
            np.maximum.at(end, self.of_node, sign * rest)
        return ends.sum(axis=0).max(axis=1)

    def farthest(self, way: np.ndarray) -> tuple[float, str]:
        """Return the largest mean displacement of a piece over its size, and its name. way: (n_nodes, 3) [m]."""
        mean = self._sums(way) / np.bincount(self.of_node, minlength=self.work.n)
        far = np.linalg.norm(mean, axis=0) / self._size
        k = int(np.argmax(far))
        return float(far[k]), self._names[k]

    def proximal(self, residual: np.ndarray, beta: float, eps: float) -> float:
        """Return c, as in c M + beta^2 K: small beside beta^2 K, but so large that no piece moves farther than REACH of its size.

        residual (n_nodes, 3): [N s], on the free axes.
        """
        net = np.linalg.norm(self._sums(residual), axis=0)
        mass = np.bincount(self.of_node, self.model.mass.to_numpy(), self.work.n)
        bodies = self._simulation.scene.bodies
        slowest = min(bodies[k].composition.lowest_wave_speed / size for k, size in zip(self.body, self._size))
        return max(float((beta * net / (self.REACH * self._size * mass)).max()), math.sqrt(eps) * (beta * slowest) ** 2)

    def forget_weights(self) -> None:
        """Let all pieces count alike, and linear solves without factors."""
        self.weights, self._is_uploaded = np.ones(self.work.n), True
        self.work.weight.fill(1.0)
        self.forget_factors()

    def upload_weights(self) -> None:
        """Upload the weights if they have changed."""
        if not self._is_uploaded:
            self.work.weight.from_numpy(self.weights)
            self._is_uploaded = True

    def forget_factors(self) -> None:
        """Let all components count alike in slopes."""
        self.work.factor.fill(1.0)

    def momenta(self, mass: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the norm (n,) of the momenta of each piece's nodes [N s]. mass: (n_nodes,), v: (n_nodes, 3)."""
        return np.sqrt(np.bincount(self.of_node, ((mass[:, None] * v) ** 2).sum(axis=1), self.work.n))

    def unbalanced_mean(self, stage_work: StageWork, beta: float, eps: float, least: np.ndarray) -> tuple[float, str]:
        """Return the largest relative mean residual of a piece after a linearised step, and its name; 0 if all are rounding.

        It moves a piece as a whole, along the axes on which it has no constraint; elastic forces and their rounding cancel in it.
        The rest of the residual is the linearisation error. eps: rounding of the model's precision; least (n,): that of
        momenta, times beta [kg m].
        """
        m, n = self.model, self.work.n
        measure_pieces(m, stage_work, self.work, beta)
        _r, inertia, internal, loads, _held = np.sqrt(self.work.norms.to_numpy()).T
        residual, v, free, mass = (a.astype(np.float64) for a in download([stage_work.residual, m.state.v, m.free, m.mass]))
        means = np.where(self._sums(1.0 - free) > 0.0, 0.0, self._sums(residual))
        mean = np.linalg.norm(means, axis=0) / np.sqrt(np.bincount(self.of_node, minlength=n))
        floor = max(eps, self.NEGLIGIBLE_MOMENTUM) * (self.momenta(mass, v) + beta * internal) + least / beta
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.where(mean > self.MEAN_ROUNDING * floor, mean / (inertia + beta * (internal + loads)), 0.0)
        k = int(np.argmax(ratio))
        return float(ratio[k]), self._names[k]

    def weigh(self, norms: np.ndarray, floor: np.ndarray, beta: float, tolerance: float, static: bool) -> tuple[float, str]:
        """Set the weights from norms (N_SUMS, n); return the largest |r|_p over s_p, and the name of that piece.

        floor (n,): |r|_p that is rounding [N s].
        """
        r, inertia, internal, loads, held = norms
        scale = inertia + beta * (internal + loads)
        if static:
            scale = np.where(loads > 0.0, beta * loads, np.where(held > 0.0, held, beta * internal))
        least = np.maximum(scale, floor / tolerance)
        least = np.where(least > 0.0, least, max(float(least.max()), np.finfo(np.float64).tiny))
        self.weights, self._is_uploaded = 1.0 / least**2, False
        ratio = r / least
        worst = int(np.argmax(ratio))
        return float(ratio[worst]), self._names[worst]


def _pieces(simulation: SimulationState) -> tuple[np.ndarray, list[str], np.ndarray]:
    """Return the piece of each node (n_nodes,), the names of the pieces and their bodies (n,)."""
    pieces, names, bodies = [], [], []
    for k, body in enumerate(simulation.scene.bodies):
        n, piece = 1, np.zeros(body.n_nodes, dtype=np.int64)
        if body.mesh.n_components > 1:
            n, piece = connected_pieces(body.nodes.elements, body.n_nodes)
        pieces.append(piece + len(names))
        names += [f"body '{body.name}'" if n == 1 else f"a piece of body '{body.name}'"] * n
        bodies += [k] * n
    return np.concatenate(pieces), names, np.array(bodies)


def _components(simulation: SimulationState, piece: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each component is anchored, and the component of each piece (n,), by connections between pieces."""
    table, dependents = simulation.springs, simulation.dependents
    links, outside = [], np.zeros(0, dtype=np.int64)
    if dependents is not None:
        links.append((np.repeat(dependents.node, np.diff(dependents.start)), dependents.master))
    if table is not None:
        line = table.line[table.element]  # one tension couples all elements of a line
        links.append((table.node[np.searchsorted(line, line)], table.node))
        fixed = np.abs(np.bincount(table.element, table.weight, len(table.kind))) > ROUNDED
        # the damping of a spring without length need not act along it, and then has a moment
        fixed |= table.is_isotropic & (table.damping > 0.0)
        outside = table.node[fixed[table.element]]
    a, b = (np.concatenate([link[side] for link in links] or [outside[:0]]) for side in (0, 1))
    n_components, component = linked_groups(piece[a], piece[b], n)
    anchored = np.zeros(n_components, dtype=np.int32)
    anchored[component[piece[outside]]] = 1
    return anchored, component
