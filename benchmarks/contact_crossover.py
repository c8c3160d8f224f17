"""Where coloured Gauss-Seidel on all threads overtakes the serial one: two plates of n x n cells, one on the other.

The problems are made up: the vertices of each plate touch the triangles of the other, which is turned by ten degrees; the
upper plate falls, and all nodes move a little at random. So the number of contacts is free, about 2 n^2, and a contact has four
nodes.
"""

from dataclasses import asdict, dataclass

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import Runtime
from taisoft.contact.problem import NODES, ContactProblem, build_node_problem, find_factors, index_nodes
from taisoft.output.tables import markdown

from .collision_table import crossovers
from .contact_captured import COLOURED, SERIAL, THREADED, Outcome, Solvers

SIZES, QUICK_SIZES = (4, 8, 16, 32, 64, 128, 192), (8, 16)
TURN, FRICTION, SEED = np.radians(10.0), 0.5, 1
FALL, SHAKE = -0.04, 0.02  # [m/s]
ROUNDS = 3


@dataclass
class Point:
    """Both solvers on one problem, from no impulses to the tolerance."""

    contacts: int
    colours: int
    serial: Outcome
    coloured: Outcome

    def record(self) -> dict:
        """As plain data."""
        return asdict(self)


def grid(n: int) -> np.ndarray:
    """Vertices ((n + 1)^2, 2) of a square of n x n unit cells round the origin, row by row."""
    x = np.arange(n + 1) - 0.5 * n
    return np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)


def find_under(points: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which of points (k,2) lie on the square, and the vertices (m,3) and weights (m,3) of the triangles under those."""
    place = points + 0.5 * n
    on = np.flatnonzero(((place >= 0) & (place <= n)).all(axis=1))
    cell = np.minimum(place[on].astype(int), n - 1)
    u, v = (place[on] - cell).T
    low = cell[:, 0] * (n + 1) + cell[:, 1]
    below = u >= v  # of the diagonal
    corner = np.where(below, low + n + 1, low + 1)
    weights = np.stack([1 - np.maximum(u, v), np.abs(u - v), np.minimum(u, v)], axis=1)
    return on, np.stack([low, corner, low + n + 2], axis=1), weights


def build_plates(n: int, runtime: Runtime, arena: FieldArena) -> ContactProblem:
    """The problem of two plates, in fields of the arena, without impulses."""
    rng, flat = np.random.default_rng(SEED), grid(n)
    c, s = np.cos(TURN), np.sin(TURN)
    turn = np.array([[c, -s], [s, c]])
    first = len(flat)  # node of the upper plate
    up, under, under_weight = find_under(flat @ turn.T, n)
    down, over, over_weight = find_under(flat @ turn, n)
    k, one = len(up) + len(down), np.ones
    node, weight = np.zeros((k, NODES), np.int32), np.zeros((k, NODES))
    node[: len(up), :4] = np.column_stack([first + up, under])  # side a, the upper, comes first
    weight[: len(up), :4] = np.column_stack([one(len(up)), -under_weight])
    node[len(up) :, :4] = np.column_stack([first + over, down])
    weight[len(up) :, :4] = np.column_stack([over_weight, -one(len(down))])
    v = SHAKE * rng.standard_normal((2 * first, 3))
    v[first:, 1] += FALL
    u = np.einsum("cj,cja->ca", weight, v[node])
    p = build_node_problem(arena, k, 2 * first, runtime.arch == "cpu")
    p.count[0] = k
    normal, tangent = np.tile([0.0, 1.0, 0.0], (k, 1)), np.tile([1.0, 0.0, 0.0], (k, 1))
    across = -u[:, 2]  # along normal x tangent
    for held, values in (
        (p.node, node),
        (p.arity, np.full(k, 4, np.int32)),
        (p.weight, weight),
        (p.normal, normal),
        (p.tangent, tangent),
        (p.inverse_mass, one((2 * first, 3))),
        (p.b, np.column_stack([u[:, 1], u[:, 0], across])),
        (p.friction, np.full(k, FRICTION)),
        (p.order, np.arange(k, dtype=np.int32)),
    ):
        held.from_numpy(np.ascontiguousarray(values))
    index_nodes(p)
    find_factors(p)
    return p


def measure_crossover(sizes, runtime: Runtime) -> list[Point]:
    """Both solvers on plates of these numbers of cells."""
    points = []
    for n in sizes:
        arena = FieldArena()
        try:
            p = build_plates(n, runtime, arena)
            solvers, names = Solvers(threads=True), (SERIAL, COLOURED + (THREADED if p.serial else ""))
            start = np.zeros((p.capacity, 3))
            solvers.outcomes(p, start, 1, names)  # compiles
            found = solvers.outcomes(p, start, ROUNDS, names)
            points.append(Point(int(p.count[0]), int(p.count[1]), *(found[name] for name in names)))
        finally:
            ti.sync()
            arena.release()
    return points


def crossover_table(points: list[Point]) -> str:
    """A row a problem."""
    lines = []
    for at in points:
        a, b = at.serial, at.coloured
        cells = (f"{1e3 * x:.3g}" for x in (a.median, b.median, float(np.median(b.colouring)), a.per_sweep, b.per_sweep))
        residuals = (f"{o.residual:.1e}" for o in (a, b))
        lines.append((f"{at.contacts:,}", f"{at.colours}", f"{a.sweeps}", f"{b.sweeps}", *residuals, *cells))
    headings = (
        "contacts",
        "colours",
        "sweeps, serial",
        "coloured",
        "residual, serial",
        "coloured",
        "solve, serial [ms]",
        "coloured [ms]",
        "of it colouring [ms]",
        "sweep, serial [ms]",
        "coloured [ms]",
    )
    return markdown(headings, lines)


def crossover_text(points: list[Point], arch: str) -> str:
    """A sentence for whole solves and one for sweeps."""
    contacts, lines = [p.contacts for p in points], []
    for what, of in (("a whole solve, colouring included", lambda o: o.median), ("a sweep", lambda o: o.per_sweep)):
        serial, coloured = [of(p.serial) for p in points], [of(p.coloured) for p in points]
        places = crossovers(contacts, serial, coloured)
        if places:
            found = f"crossover at {', '.join(f'{x:,.0f}' for x in places)} contacts"
        else:
            faster = "serial" if serial[0] < coloured[0] else "coloured"
            found = f"no crossover up to {contacts[-1]:,} contacts, {faster} Gauss-Seidel is faster throughout"
        lines.append(f"* {arch}, {what}: {found}")
    return "\n".join(lines)
