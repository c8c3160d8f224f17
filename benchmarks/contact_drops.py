"""Bodies that fall and come to rest in implicit steps: what a process of `taisoft bench contact --drops` does.

python contact_drops.py SCENE [STEPS]: takes the steps of a scene of DROPS and prints, as a line of JSON, what they took.
Nothing here is newer than version 0.1, so that both can be measured.
"""

import json
import sys
import time
import warnings
from collections.abc import Callable

import taisoft as ts
from taisoft.runtime import compile_clock

if __package__:
    from .contact_states import DOWN, GROUND, IMPLICIT, MESHES, demo, figure, rubber
else:  # as a program
    from contact_states import DOWN, GROUND, IMPLICIT, MESHES, demo, figure, rubber

MESH = {"bar": "bar-2523.msh", "bunny": "bunny.msh", "octocat": "octocat.msh", "Armadillo": "Armadillo13K.msh"}


def on_plane(name: str) -> ts.Scene:
    """A mesh of shared/meshes falls 5 cm."""
    scene = ts.Scene(gravity=DOWN)
    scene.add_body(figure(MESH[name], 0.05), rubber(), name=name)
    scene.add_obstacle(GROUND, name="ground", friction=0.5)
    return scene


def cloth() -> ts.Scene:
    """A cloth of 2 mm falls on a sphere."""
    scene = ts.Scene(gravity=DOWN)
    material = ts.Material(young=1e5, poisson=0.3, density=500.0, friction=0.5)
    scene.add_body(ts.sheet_mesh((20, 20), (0.5, 0.002, 0.5)), material, name="cloth", position=(0, 0.11, 0))
    scene.add_obstacle(ts.Sphere((0, 0, 0), 0.1), name="sphere", friction=0.5)
    return scene


def ledge() -> ts.Scene:
    """A cube of 384 tets rests on a box."""
    scene = ts.Scene(gravity=DOWN)
    scene.add_body(ts.box_mesh((4, 4, 4), (0.2, 0.2, 0.2), pattern="six"), rubber(), name="cube", position=(0, 0.1005, 0))
    scene.add_obstacle(ts.Box((0, -0.05, 0), (0.2, 0.05, 0.2)), name="ledge", friction=0.5)
    return scene


def stack() -> ts.Scene:
    """W3 of the works: three cubes of 1 m fall on each other."""
    scene, mesh = ts.Scene(gravity=DOWN), ts.box_mesh((6, 6, 6), (1.0, 1.0, 1.0))
    for k in range(3):
        scene.add_body(mesh, rubber(young=1e5, poisson=0.3), name=f"cube {k}", position=(0, 0.501 + 1.001 * k, 0))
    scene.add_obstacle(GROUND, name="ground", friction=0.5)
    return scene


def cube_on_sheet() -> ts.Scene:
    """W4: a cube of 0.5 m falls on a clamped sheet."""
    scene = ts.Scene(gravity=DOWN)
    sheet = ts.box_mesh((20, 2, 10), (4.0, 0.05, 4.0))
    made = scene.add_body(sheet, rubber(young=1e6, poisson=0.3), name="sheet")
    made.fix(lambda X: abs(X[:, 0]) > 1.9)
    cube = ts.box_mesh((4, 4, 4), (0.5, 0.5, 0.5))
    scene.add_body(cube, rubber(young=1e5, poisson=0.3), name="cube", position=(0, 0.525, 0))
    return scene


# name: (scene, settings, steps)
DROPS: dict[str, tuple[Callable[[], ts.Scene], dict, int]] = {
    **{name: (lambda name=name: on_plane(name), IMPLICIT | {"dt": 0.01}, 100) for name in MESH},
    "cloth": (cloth, IMPLICIT | {"dt": 1 / 120}, 120),
    "cube pile": (lambda: demo("cube_pile"), IMPLICIT | {"dt": 0.01, "contact_tolerance": 1e-3}, 200),
    "stack, Euler": (stack, IMPLICIT | {"dt": 0.01}, 100),
    "stack, BDF2": (stack, {"integrator": "bdf2", "dt": 0.01}, 100),
    "cube on sheet, Euler": (cube_on_sheet, IMPLICIT | {"dt": 0.01}, 100),
    "cube on sheet, BDF2": (cube_on_sheet, {"integrator": "bdf2", "dt": 0.01}, 100),
    "cube at rest": (ledge, IMPLICIT | {"dt": 0.005}, 400),
}


def can_build(name: str) -> bool:
    """Whether the mesh that a scene needs is here."""
    return name not in MESH or (MESHES / MESH[name]).is_file()


def drop(name: str, steps: int) -> dict:
    """What the steps of a scene took, one by one, without compiling."""
    build, settings, _ = DROPS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sim = ts.Simulator(build(), **settings, precision="f32")
    seconds, reports = [], []
    with sim:
        for _ in range(steps):
            begin, compiled = time.perf_counter(), compile_clock()
            reports.append(sim.advance(1))
            seconds.append(time.perf_counter() - begin - (compile_clock() - compiled))
        tets = sum(body.mesh.n_tets for body in sim.scene.bodies)
    return {
        "scene": name, "tets": tets, "seconds": seconds, "contacts": [int(r.n_contacts) for r in reports],
        "newton": [r.newton_iterations for r in reports], "linear": [r.linear_iterations for r in reports],
        "unconverged": sum(not r.converged for r in reports), "penetration": float(reports[-1].max_penetration),
    }  # fmt: skip


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps(drop(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else DROPS[sys.argv[1]][2])))
