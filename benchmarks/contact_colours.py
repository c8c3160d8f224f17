"""Colourings of contact graphs beside each other: number of colours, largest colour, time; what the report found."""

import time
from dataclasses import asdict, dataclass

import numpy as np
import scipy.sparse as sp

from taisoft.contact.colouring import colour_contacts, colour_greedy, colour_random, graph_of
from taisoft.contact.problem import ContactProblem
from taisoft.output.tables import markdown

from .contact_captured import clock

SEEDS, QUICK_SEEDS = 15, 3  # of random colourings
ROUNDS = 3  # of the colourings that give one result
REPORT = {"two_cubes_two_boxes": (286, {"greedy": 95, "random": 125})}  # contacts, colours


@dataclass(frozen=True)
class Colouring:
    """A way to colour one scene's contacts, the same as often as there are seeds or rounds.

    least: colours that any colouring needs, as many contacts share one node. numbers: colours; largest: contacts of the
    largest colour; seconds: the graph included.
    """

    scene: str
    way: str
    contacts: int
    least: int
    numbers: list[int]
    largest: list[int]
    seconds: list[float]

    def record(self) -> dict:
        """As plain data."""
        return asdict(self)


def proper(graph: sp.csr_matrix, colour: np.ndarray) -> bool:
    """Whether no two neighbours have one colour."""
    joined = graph.tocoo()
    return bool((colour >= 0).all() and (colour[joined.row] != colour[joined.col]).all())


def _parallel(p: ContactProblem) -> np.ndarray:
    colour_contacts(p)
    return p.colour.to_numpy()[: int(p.count[0])]


def colour_all(scene: str, p: ContactProblem, seeds: int) -> tuple[list[Colouring], dict[str, np.ndarray]]:
    """Colourings of the contacts that `p` holds, and a colour (k,) of each way."""
    graph, k, made, colours = graph_of(p), int(p.count[0]), [], {}
    start, movable = p.entry_start.to_numpy(), (p.inverse_mass.to_numpy() != 0.0).any(axis=1)
    least = int(np.diff(start)[movable].max())
    _parallel(p)  # compiles
    ways = {
        "greedy": lambda _: colour_greedy(graph_of(p)),
        "random": lambda seed: colour_random(graph_of(p), seed),
        "parallel": lambda _: _parallel(p),
    }
    for name, way in ways.items():
        numbers, largest, seconds = [], [], []
        for seed in range(seeds if name == "random" else ROUNDS):
            begin = clock()
            colour = way(seed)
            seconds.append(time.perf_counter() - begin)
            if not proper(graph, colour):
                raise ArithmeticError(f"{scene}: the {name} colouring gives neighbours one colour")
            sizes = np.bincount(colour)
            numbers.append(len(sizes))
            largest.append(int(sizes.max()))
            colours.setdefault(name, colour)
        made.append(Colouring(scene, name, k, least, numbers, largest, seconds))
    return made, colours


def _ranged(values: list[int]) -> str:
    low, high = min(values), max(values)
    return f"{np.median(values):g}" + ("" if low == high else f" ({low} to {high})")


def colour_table(colourings: list[Colouring]) -> str:
    """A row a scene and way, those of the report below."""
    lines = [
        (
            c.scene,
            c.way,
            f"{c.contacts}",
            f"{c.least}",
            _ranged(c.numbers),
            f"{c.contacts / np.median(c.numbers):.1f}",
            _ranged(c.largest),
            f"{1e3 * float(np.median(c.seconds)):.3g}",
        )
        for c in colourings
    ]
    for scene in dict.fromkeys(c.scene for c in colourings):
        contacts, found = REPORT.get(scene, (0, {}))
        for way, n in found.items():
            lines.append((f"{scene}, the report", way, f"{contacts}", "-", f"{n}", f"{contacts / n:.1f}", "-", "-"))
    headings = ("scene", "colouring", "contacts", "at one node", "colours", "contacts a colour", "largest", "ms")
    return markdown(headings, lines, left=(0, 1))
