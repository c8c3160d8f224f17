"""Steps without contacts, and statics: a process of `taisoft bench contact --free`.

python contact_free.py CASE [STEPS] runs a case of CASES, or solves the static beams, and prints times and iterations as a line of
JSON. It uses nothing newer than version 0.1, so that both versions can be measured.
"""

import itertools
import json
import sys
import warnings
from dataclasses import dataclass

import taisoft as ts

if __package__:
    from .contact_states import take_steps, timed
else:  # as a program
    from contact_states import take_steps, timed

STATICS = "static beams"
LAWS = ("stable_neo_hookean", "corotational", "st_venant_kirchhoff")


@dataclass(frozen=True)
class Case:
    """Steps of a beam of 4 x 1 x 1 m clamped at one end. first: the first step that counts."""

    cells: tuple[int, int, int]
    law: str
    integrator: str
    steps: int
    first: int = 0
    dt: float = 0.01  # [s]


BEAM, LARGE = (24, 6, 6), (48, 12, 12)
CASES = {
    "beam, midpoint": Case(BEAM, LAWS[0], "implicit_midpoint", 100),
    "beam, BDF2": Case(BEAM, LAWS[0], "bdf2", 100),
    "beam, Euler": Case(BEAM, LAWS[0], "implicit_euler", 100),
    "beam, explicit": Case(BEAM, LAWS[0], "symplectic_euler", 2000, dt=5e-4),
    "inverted beam, midpoint": Case(LARGE, LAWS[2], "implicit_midpoint", 100, 70),
    "inverted beam, BDF2": Case(LARGE, LAWS[2], "bdf2", 100, 70),
}
INVERTED = ("inverted beam, midpoint", "inverted beam, BDF2")  # about 2,000 inverted tets from `first` on


def beam_steps(case: Case, steps: int) -> dict:
    """Times without compilation and iterations of each step of a case."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    material = ts.Material(young=1e6, poisson=0.3, density=1000.0, law=case.law)
    beam = scene.add_body(ts.box_mesh(case.cells, (4.0, 1.0, 1.0)), material, name="beam")
    beam.fix(lambda x: x[:, 0] < -2.0 + 1e-9)
    with ts.Simulator(scene, dt=case.dt, integrator=case.integrator, precision="f32") as sim:
        seconds, reports = take_steps(sim, steps)
    first = min(case.first, steps - 1)
    return {
        "tets": beam.mesh.n_tets,
        "seconds": seconds[first:],
        "newton": [r.newton_iterations for r in reports[first:]],
        "linear": [r.linear_iterations for r in reports[first:]],
        "converged": [bool(r.converged) for r in reports[first:]],
        "inverted": max(int(r.n_inverted) for r in reports[first:]),
    }


def static_beams(number: int) -> dict:
    """Times and iterations of static slender beams under their weight: three laws, two element orders, two stiffnesses."""
    found: dict = {name: [] for name in ("seconds", "newton", "linear", "converged")}
    mesh = ts.box_mesh((12, 3, 3), (1.0, 0.25, 0.25))
    for law, order, young in itertools.islice(itertools.product(LAWS, (1, 2), (2e4, 2e5)), number):
        scene = ts.Scene(gravity=(0.0, -9.81, 0.0))
        material = ts.Material(young=young, poisson=0.4, density=1000.0, law=law)
        beam = scene.add_body(mesh, material, name="beam", **({"order": 2} if order == 2 else {}))
        beam.fix(lambda x: x[:, 0] < -0.499)
        result, seconds = timed(lambda scene=scene: ts.solve_static(scene))
        found["seconds"].append(seconds)
        found["newton"].append(result.iterations)
        found["linear"].append(result.linear_iterations)
        found["converged"].append(bool(result.converged))
    return found | {"tets": mesh.n_tets, "inverted": 0}


def take(name: str, count: int | None) -> dict:
    """Run a case, or `count` of its steps or solves."""
    found = static_beams(count or 12) if name == STATICS else beam_steps(CASES[name], count or CASES[name].steps)
    return {"scene": name} | found


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps(take(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else None)))
