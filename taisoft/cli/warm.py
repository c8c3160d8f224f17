"""`taisoft warm`: compiles the kernels of common scenes ahead, so that later runs find them in the cache on disk.

A kernel depends on laws, orders, integrators, contacts and precision, on neither meshes nor numbers: tiny scenes do.
"""

import itertools
import time
import warnings
from argparse import Namespace
from collections.abc import Callable
from typing import Any

import taisoft as ts
from taisoft.runtime import n_compiled

EXPLICIT, IMPLICIT = "symplectic_euler", "implicit_euler"
INTEGRATORS = {EXPLICIT: 1e-5, IMPLICIT: 1e-3}  # name -> dt [s]
LAWS = ("stable_neo_hookean", "corotational", "st_venant_kirchhoff")
CONTACTS = ("no contacts", "a half-space", "two bodies")


def command(arguments: Namespace) -> int:
    """Compiles, one line for each kind of scene, and returns 0."""
    start, before = time.perf_counter(), n_compiled()
    for law, (integrator, dt), contacts in itertools.product(LAWS, INTEGRATORS.items(), CONTACTS):
        what = f"{law}, {integrator}, {contacts}"
        _report(what, _simulate, scene(law, contacts), integrator, dt, arguments.precision)
    _report("statics", ts.solve_static, scene(LAWS[0], CONTACTS[0]))
    print(f"{n_compiled() - before} kernels in {time.perf_counter() - start:.0f} s")
    return 0


def scene(law: str, contacts: str) -> ts.Scene:
    """A cube that is held or touches something."""
    made, cube = ts.Scene(), ts.box_mesh((2, 2, 2), (0.1, 0.1, 0.1))
    material = ts.Material(law=law, young=1e5, poisson=0.3, density=1000.0)
    body = made.add_body(cube, material, name="cube", position=(0.0, 0.0501, 0.0))
    if contacts == "no contacts":
        body.fix(lambda X: X[:, 1] < -0.049)
    elif contacts == "a half-space":
        made.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground")
    else:
        made.add_body(cube, material, name="other", position=(0.0, -0.0501, 0.0)).fix(lambda X: X[:, 1] < -0.049)
    return made


def _simulate(made: ts.Scene, integrator: str, dt: float, precision: str) -> None:
    with ts.Simulator(made, dt=dt, integrator=integrator, precision=precision) as sim:
        sim.advance(3)
        sim.energies()


def _report(what: str, do: Callable, *arguments: Any) -> None:
    start, before = time.perf_counter(), n_compiled()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of scenes that nobody looks at
        do(*arguments)
    print(f"{what:<60} {n_compiled() - before:3d} kernels {time.perf_counter() - start:6.1f} s", flush=True)
