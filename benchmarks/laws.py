"""What a law from its energy density costs: explicit steps and assemblies, beside laws written by hand; its first compilation.

taisoft bench laws [--quick] [--out [FILE.json]]

The three laws written by hand again from psi alone, the shipped ones, one of principal stretches, one of fibres (I4, projected by
the eigenvalues of 9x9 matrices) and one of F. Steps are of symplectic Euler in f32 on a block of 104,000 tets, assemblies of the
stiffness matrix on one of 16,000, as Newton's method forms it, and of the projected one, which it needs where it is indefinite;
each in turn with those of the law beside. Ratios are medians over rounds.
"first step" is an implicit one with all that comes before it, in a process that has no stored kernels, beside the same of stable
neo-Hookean; "check" is `ts.check_law`. --quick: small blocks, two rounds, two laws, no limits.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.linear.block_csr import assemble, build_block_csr
from taisoft.machine import summarise
from taisoft.output.tables import percent, spread_of

from .children import in_child
from .document import Limit, begin, table
from .runner import progress, quick_options, timed, without_warnings

COR, SNH, SVK = "corotational", "stable_neo_hookean", "st_venant_kirchhoff"
STEPS, ROUNDS = 10, 7
QUICK = ("psi of SNH", "psi of F")
SIZES, QUICK_SIZES = {"step": (28, 28, 26), "assembly": (15, 15, 14)}, {"step": (4, 4, 4), "assembly": (3, 3, 3)}
MOST_TIMES, MOST_SECONDS = 1.5, 6.0


def neo_hookean(I1, J, mu, lam):
    """Stable neo-Hookean."""
    m, l = 4 / 3 * mu, lam + 5 / 6 * mu
    return m / 2 * (I1 - 3) + l / 2 * (J - 1 - m / l + m / (4 * l)) ** 2 - m / 2 * np.log(I1 + 1)


def svk(I1, I2, mu, lam):
    """St. Venant-Kirchhoff."""
    return mu / 4 * (I1**2 - 2 * I2 - 2 * I1 + 3) + lam / 8 * (I1 - 3) ** 2


def corotational(I1, trS, mu, lam):
    """Corotational."""
    return mu * (I1 - 2 * trS + 3) + lam / 2 * (trS - 3) ** 2


def fibred(I1, I4, J, c, k1, k2, bulk):
    """Neo-Hookean with Holzapfel's fibres."""
    return c * (I1 - 3 - 2 * (J - 1)) + k1 / (2 * k2) * (np.exp(k2 * np.maximum(I4 - 1, 0) ** 2) - 1) + bulk / 2 * (J - 1) ** 2


def of_F(F, mu, lam):
    """St. Venant-Kirchhoff, as a function of F."""
    strain = (F.T @ F - np.eye(3)) / 2
    return mu * np.trace(strain @ strain) + lam / 2 * np.trace(strain) ** 2


OWN = {"psi of SNH": neo_hookean, "psi of SVK": svk, "psi of COR": corotational, "psi of F": of_F}
HOOKE = {"young": 1e6, "poisson": 0.3}
CASES = {  # name -> law, numbers, the law beside, and whether the ratio has a limit
    "psi of SNH": ("psi_of_SNH", HOOKE, SNH, True),
    "psi of SVK": ("psi_of_SVK", HOOKE, SVK, True),
    "psi of COR": ("psi_of_COR", HOOKE, COR, True),
    "Mooney-Rivlin": ("mooney_rivlin", {"c1": 2e5, "c2": 1e5, "bulk": 1e6}, SNH, False),
    "Gent": ("gent", {"shear": 4e5, "bulk": 1e6}, SNH, False),
    "Fung": ("fung", {"shear": 4e5, "bulk": 1e6}, SNH, False),
    "Ogden": ("ogden", {"mu1": 4e5, "alpha1": 1.7, "bulk": 1e6}, SNH, False),
    "I1, I4, J": ("fibred", {"c": 2e5, "k1": 4e5, "k2": 1.0, "bulk": 1e6}, SNH, False),
    "psi of F": ("psi_of_F", HOOKE, SVK, False),
}


@dataclass
class Cost:
    """Ratios of a law's steps and assemblies to those of the law beside it, by round; seconds of its step, check, compilation."""

    name: str
    beside: str
    tets: int
    step: list[float]
    assembly: list[float]
    projected: list[float]
    seconds: float
    check: float
    compile: list[float]  # of the law, and of stable neo-Hookean


def register() -> None:
    """Register the laws that the package does not have."""
    for name, psi in OWN.items():
        ts.register_law(name.replace(" ", "_"), psi)
    ts.register_law("fibred", fibred, {"c": "Pa", "k1": "Pa", "k2": "", "bulk": "Pa"})


def simulator(law: str, numbers: dict, cells: tuple, integrator: str = "symplectic_euler") -> ts.Simulator:
    """A block that is held at one end."""
    scene = ts.Scene()
    fibres = {"fibres": (0.6, 0.8, 0.0)} if law == "fibred" else {}
    body = scene.add_body(ts.box_mesh(cells, (1, 1, 1)), ts.Material(law=law, **numbers), **fibres)
    body.fix(lambda X: X[:, 0] < -0.49)
    return ts.Simulator(scene, dt=1e-6, integrator=integrator, precision="f32")


def in_turn(case: tuple, cells: tuple, rounds: int, prepare: Callable) -> list[tuple[float, float]]:
    """Seconds of what `prepare` makes of a simulator, for a law and the one beside it, by round."""
    law, numbers, beside, _ = case
    with ExitStack() as stack:
        sims = [stack.enter_context(simulator(*one, cells)) for one in ((law, numbers), (beside, HOOKE))]
        calls = [prepare(sim) for sim in sims]
        for call in calls:
            call()
        return [tuple(timed(call)[1] / STEPS for call in calls) for _ in range(rounds)]


def steps(sim: ts.Simulator) -> Callable:
    """STEPS explicit steps."""
    return lambda: sim.advance(STEPS)


def assemblies(projected: bool, sim: ts.Simulator) -> Callable:
    """STEPS assemblies of the stiffness matrix."""
    state = sim._dynamics.state
    matrix = build_block_csr(state.model, state.arena, "measured")
    return lambda: [assemble(state.model, matrix, projected) for _ in range(STEPS)]


def first_step(name: str) -> float:
    """The seconds from a new simulator to the end of its first implicit step."""
    with without_warnings():
        register()
        law, numbers, *_ = CASES.get(name, (SNH, HOOKE))
        start = time.perf_counter()
        with simulator(law, numbers, (3, 2, 2), "implicit_euler") as sim:
            sim.step()
        return time.perf_counter() - start


def compile_seconds(name: str) -> float:
    """The same in a new process that has no stored kernels."""
    with tempfile.TemporaryDirectory() as folder:
        return in_child(f"the first step of {name}", first_step, name, cache=Path(folder))


def measure(name: str, sizes: dict, rounds: int) -> Cost:
    """All of a law."""
    case = CASES[name]
    progress(name)
    _, check = timed(partial(ts.check_law, case[0]))
    step = in_turn(case, sizes["step"], rounds, steps)
    others = [in_turn(case, sizes["assembly"], rounds, partial(assemblies, projected)) for projected in (False, True)]
    ratios = [[a / b for a, b in pairs] for pairs in (step, *others)]
    tets = 5 * int(np.prod(sizes["step"]))
    compiled = [compile_seconds(one) for one in (name, SNH)]
    return Cost(name, case[2], tets, *ratios, float(np.median([a for a, _ in step])), check, compiled)


def ratio(values: list[float]) -> str:
    """Median and spread of ratios."""
    found = summarise(values)
    return f"{found.median:.2f} ({percent(spread_of(found))})"


def main(argv=None) -> int:
    """Measure and print. Exit status: 0, or 1 if a limit is not met (not with --quick)."""
    options = quick_options("laws", __doc__, argv, "small blocks, two rounds, two laws, no limits")
    document, numbers = begin("Laws from their energy densities", "arch cpu")
    with without_warnings():
        register()
        names, sizes, rounds = (QUICK, QUICK_SIZES, 2) if options.quick else (tuple(CASES), SIZES, ROUNDS)
        costs = [measure(name, sizes, rounds) for name in names]
    columns = (
        ("<law", "{.name}"),
        ("<beside", "{.beside}"),
        ("ns/tet", lambda c: f"{1e9 * c.seconds / c.tets:.1f}"),
        ("step", lambda c: ratio(c.step)),
        ("assembly", lambda c: ratio(c.assembly)),
        ("projected", lambda c: ratio(c.projected)),
        ("check [s]", "{0.check:.2f}"),
        ("first step [s]", lambda c: f"{c.compile[0]:.1f}"),
        ("of SNH", lambda c: f"{c.compile[1]:.1f}"),
    )
    document.add(table(costs, columns))
    limits = [
        Limit(f"{c.name}: {what}", float(np.median(values)), MOST_TIMES, spread_of(summarise(values)))
        for c in costs
        if CASES[c.name][3]
        for what, values in (("step", c.step), ("assembly", c.assembly))
    ]
    limits += [Limit(f"{c.name}: first step less that of SNH [s]", c.compile[0] - c.compile[1], MOST_SECONDS) for c in costs]
    return document.finish(options, numbers | {"costs": costs}, () if options.quick else limits)


if __name__ == "__main__":
    sys.exit(main())
