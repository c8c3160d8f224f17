"""Coloured Gauss-Seidel: colourings of contact graphs, and the crossover with serial Gauss-Seidel on all threads.

The crossover uses artificial problems: two plates of n x n cells on each other, one turned by ten degrees. The vertices of each
touch triangles of the other; the upper plate falls, and all nodes have small random velocities. This gives about 2 n^2 contacts
of four nodes each.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import Runtime
from taisoft.contact.colouring import UNCOLOURED, colour_contacts, colour_greedy
from taisoft.contact.problem import ContactProblem, build_node_problem, fill_rows, find_factors, index_nodes, read_entries

from .contact_runs import COLOURED, SERIAL, Outcome, outcomes
from .document import crossovers, ms, ranged, table
from .runner import clock

SEEDS, QUICK_SEEDS = 15, 3  # of random colourings
ROUNDS = 3  # of deterministic colourings
SCENE = "two_cubes_two_boxes"  # that of the report
REPORT = {SCENE: (286, {"greedy": 95, "random": 125})}  # contacts, colours
SIZES, QUICK_SIZES = (4, 8, 16, 32, 64, 128, 192), (8, 16)  # cells along a plate
TURN, FRICTION, SEED = np.radians(10.0), 0.5, 1
FALL, SHAKE = -0.04, 0.02  # [m/s]


@dataclass(frozen=True)
class Colouring:
    """A method of colouring (`way`) on one scene's contacts, per seed or round.

    least: lower bound of the colours, the contacts that meet at one node. numbers: colours. largest: contacts of the largest
    colour. seconds: time, including the graph.
    """

    scene: str
    way: str
    contacts: int
    least: int
    numbers: list[int]
    largest: list[int]
    seconds: list[float]


@dataclass(frozen=True)
class Touching:
    """Which contacts touch which nodes, a pair each, the nodes numbered without gaps; colours of the contacts by method."""

    contacts: list[int]
    nodes: list[int]
    colours: dict[str, list[int]]


def node_graph(contact: np.ndarray, node: np.ndarray, k: int, inverse_mass: np.ndarray) -> sp.csr_matrix:
    """Adjacency (k,k), bool, of contacts over nodes.

    contact, node: of each entry; k: number of contacts; inverse_mass: (n_nodes, 3) [1/kg].
    """
    free = np.any(inverse_mass[node] != 0.0, axis=1)
    touches = sp.csr_matrix((np.ones(free.sum(), dtype=np.int32), (contact[free], node[free])), shape=(k, len(inverse_mass)))
    joined = (touches @ touches.T).tocoo()
    off = joined.row != joined.col
    return sp.csr_matrix((np.ones(off.sum(), dtype=bool), (joined.row[off], joined.col[off])), shape=(k, k))


def graph_of(problem: ContactProblem) -> sp.csr_matrix:
    """Adjacency matrix of the contacts of a problem over nodes."""
    contact, node, _ = read_entries(problem)
    return node_graph(contact, node, int(problem.count[0]), problem.inverse_mass.to_numpy())


def colour_random(graph: sp.csr_matrix, seed: int = 0, shrink: float = 3.0) -> np.ndarray:
    """Colours (k,) from 0 by Vivace, Fratarcangeli, Tibaldo and Pellacini 2016; palettes start with degree / shrink colours.

    Tentative colours are random, and kept if no neighbour of lower index has the same; an exhausted palette grows by one colour.
    """
    k = graph.shape[0]
    generator = np.random.default_rng(seed)
    edges = sp.triu(graph).tocoo()
    a, b = edges.row, edges.col
    degree = np.diff(graph.indptr)
    size = np.maximum(1, np.ceil(degree / shrink)).astype(int)  # of the palettes; degree + 1 suffices
    number = np.arange(int(degree.max(initial=0)) + 2)
    taken = np.zeros((k, len(number)), dtype=bool)
    colour = np.full(k, UNCOLOURED, dtype=np.int32)
    while True:
        uncoloured = np.flatnonzero(colour == UNCOLOURED)
        if not len(uncoloured):
            return np.unique(colour, return_inverse=True)[1].astype(np.int32)  # numbers the colours without gaps
        free = (number < size[uncoloured, None]) & ~taken[uncoloured]
        exhausted = ~free.any(axis=1)
        size[uncoloured[exhausted]] += 1
        uncoloured, free = uncoloured[~exhausted], free[~exhausted]
        tentative = np.full(k, UNCOLOURED)
        tentative[uncoloured] = np.argmax(np.where(free, generator.random(free.shape), -1.0), axis=1)
        keep = tentative != UNCOLOURED
        # of two equal colours the lower index keeps its own: if neither did, two equal palettes of one colour would loop forever
        keep[b[keep[a] & (tentative[a] == tentative[b])]] = False
        colour[keep] = tentative[keep]
        for one, other in ((a, b), (b, a)):
            kept = keep[one]
            taken[other[kept], colour[one[kept]]] = True


def proper(graph: sp.csr_matrix, colour: np.ndarray) -> bool:
    """Whether neighbours have different colours."""
    joined = graph.tocoo()
    return bool((colour >= 0).all() and (colour[joined.row] != colour[joined.col]).all())


def _parallel(p: ContactProblem) -> np.ndarray:
    index_nodes(p)
    colour_contacts(p)
    return p.sweep.colour.to_numpy()[: int(p.count[0])]


def colour_all(scene: str, p: ContactProblem, seeds: int) -> tuple[list[Colouring], Touching]:
    """Colourings of the contacts of `p`, and an example of each method."""
    graph, k, colourings, colours = graph_of(p), int(p.count[0]), [], {}
    start, movable = p.by_node.start.to_numpy(p.n_nodes + 1), (p.inverse_mass.to_numpy() != 0.0).any(axis=1)
    least = int(np.diff(start)[movable].max())
    _parallel(p)  # compiles
    methods = {
        "greedy": lambda _: colour_greedy(graph_of(p)),
        "random": lambda seed: colour_random(graph_of(p), seed),
        "parallel": lambda _: _parallel(p),
    }
    for name, method in methods.items():
        numbers, largest, seconds = [], [], []
        for seed in range(seeds if name == "random" else ROUNDS):
            begin = clock()
            colour = method(seed)
            seconds.append(clock() - begin)
            if not proper(graph, colour):
                raise ArithmeticError(f"{scene}: the {name} colouring gives neighbours one colour")
            sizes = np.bincount(colour)
            numbers.append(len(sizes))
            largest.append(int(sizes.max()))
            colours.setdefault(name, colour.tolist())
        colourings.append(Colouring(scene, name, k, least, numbers, largest, seconds))
    contact, node, _ = read_entries(p)
    pairs = np.unique(np.column_stack([contact, np.unique(node, return_inverse=True)[1]]), axis=0)
    return colourings, Touching(*pairs.T.tolist(), colours)


def colour_table(colourings: list[Colouring]) -> str:
    """A row per scene and method, then those of the report."""
    rows = [(c.scene, c.way, c.contacts, c.least, c.numbers, c.largest, ms(np.median(c.seconds))) for c in colourings]
    for scene in dict.fromkeys(c.scene for c in colourings):
        contacts, found = REPORT.get(scene, (0, {}))
        rows += [(f"{scene}, the report", name, contacts, "-", [n], [], "-") for name, n in found.items()]
    columns = (
        ("<scene", "{[0]}"),
        ("<colouring", "{[1]}"),
        ("contacts", "{[2]}"),
        ("at one node", "{[3]}"),
        ("colours", lambda row: ranged(row[4])),
        ("contacts per colour", lambda row: f"{row[2] / np.median(row[4]):.1f}"),
        ("largest", lambda row: ranged(row[5])),
        ("ms", "{[6]}"),
    )
    return table(rows, columns)


# --- serial and coloured ------------------------------------------------------------------------------------------------


@dataclass
class Point:
    """Both solvers on one problem, from zero impulses to the tolerance."""

    contacts: int
    colours: int
    serial: Outcome
    coloured: Outcome


def grid(n: int) -> np.ndarray:
    """Vertices ((n + 1)^2, 2) of a square of n x n unit cells about the origin, row by row."""
    x = np.arange(n + 1) - 0.5 * n
    return np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)


def find_under(points: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices of the points (k,2) on the square, and vertices (m,3) and weights (m,3) of the triangles below them."""
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
    """The contact problem of two plates, with zero impulses."""
    rng, flat = np.random.default_rng(SEED), grid(n)
    c, s = np.cos(TURN), np.sin(TURN)
    turn = np.array([[c, -s], [s, c]])
    first = len(flat)  # node of the upper plate
    up, under, under_weight = find_under(flat @ turn.T, n)
    down, over, over_weight = find_under(flat @ turn, n)
    k, one = len(up) + len(down), np.ones
    # side a, the upper plate, comes first
    node = np.vstack([np.column_stack([first + up, under]), np.column_stack([first + over, down])])
    weight = np.vstack([np.column_stack([one(len(up)), -under_weight]), np.column_stack([over_weight, -one(len(down))])])
    v = SHAKE * rng.standard_normal((2 * first, 3))
    v[first:, 1] += FALL
    u = np.einsum("cj,cja->ca", weight, v[node])
    p = build_node_problem(arena, k, 2 * first, runtime.arch == "cpu", node.size)
    fill_rows(p, np.full(k, 4), node.reshape(-1), weight.reshape(-1))
    normal, tangent = np.tile([0.0, 1.0, 0.0], (k, 1)), np.tile([1.0, 0.0, 0.0], (k, 1))
    across = -u[:, 2]  # along normal x tangent
    for held, values in (
        (p.normal, normal),
        (p.tangent, tangent),
        (p.inverse_mass, one((2 * first, 3))),
        (p.b, np.column_stack([u[:, 1], u[:, 0], across])),
        (p.friction, np.full(k, FRICTION)),
        (p.sweep.order, np.arange(k, dtype=np.int32)),
    ):
        held.from_numpy(np.ascontiguousarray(values))
    index_nodes(p)
    find_factors(p)
    return p


def measure_crossover(sizes, runtime: Runtime) -> list[Point]:
    """Both solvers on plates with these numbers of cells."""
    points = []
    for n in sizes:
        arena = FieldArena()
        try:
            p = build_plates(n, runtime, arena)
            forms = {SERIAL: p, COLOURED: replace(p, serial=False)}
            start = np.zeros((p.capacity, 3))
            outcomes(p, forms, start, 1)  # compiles
            found = outcomes(p, forms, start)
            points.append(Point(int(p.count[0]), int(p.count[1]), found[SERIAL], found[COLOURED]))
        finally:
            ti.sync()
            arena.release()
    return points


def crossover_table(points: list[Point]) -> str:
    """A row per problem."""
    columns = (
        ("contacts", "{.contacts:,}"),
        ("colours", "{.colours}"),
        ("sweeps, serial", "{.serial.sweeps}"),
        ("coloured", "{.coloured.sweeps}"),
        ("residual, serial", "{.serial.residual:.1e}"),
        ("coloured", "{.coloured.residual:.1e}"),
        ("solve, serial [ms]", lambda p: ms(p.serial.median)),
        ("coloured [ms]", lambda p: ms(p.coloured.median)),
        ("of which colouring [ms]", lambda p: ms(np.median(p.coloured.colouring))),
        ("sweep, serial [ms]", lambda p: ms(p.serial.per_sweep)),
        ("coloured [ms]", lambda p: ms(p.coloured.per_sweep)),
    )
    return table(points, columns)


def crossover_text(points: list[Point], arch: str) -> str:
    """A line for whole solves and one for sweeps."""
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
