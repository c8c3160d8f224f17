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

try:
    from taisoft.backend.runtime import compile_clock
except ImportError:  # version 0.1
    from taisoft.runtime import compile_clock

if __package__:
    from .contact_states import DOWN, EULER, GROUND, IMPLICIT, MESHES, cloth, demo, figure, rubber
    from .programs.own import make_scene
    from .works.scenes import WORKS
else:  # as a program
    from contact_states import DOWN, EULER, GROUND, IMPLICIT, MESHES, cloth, demo, figure, rubber

    from benchmarks.programs.own import make_scene
    from benchmarks.works.scenes import WORKS

MESH = {"bar": "bar-2523.msh", "bunny": "bunny.msh", "octocat": "octocat.msh", "Armadillo": "Armadillo13K.msh"}
BDF2 = {"integrator": "bdf2", "dt": 0.01}


def on_plane(name: str) -> ts.Scene:
    """A mesh of shared/meshes falls 5 cm."""
    scene = ts.Scene(gravity=DOWN)
    scene.add_body(figure(MESH[name], 0.05), rubber(), name=name)
    scene.add_obstacle(GROUND, name="ground", friction=0.5)
    return scene


def ledge() -> ts.Scene:
    """A cube of 384 tets rests on a box."""
    scene = ts.Scene(gravity=DOWN)
    scene.add_body(ts.box_mesh((4, 4, 4), (0.2, 0.2, 0.2), pattern="six"), rubber(), name="cube", position=(0, 0.1005, 0))
    scene.add_obstacle(ts.Box((0, -0.05, 0), (0.2, 0.05, 0.2)), name="ledge", friction=0.5)
    return scene


def work(key: str) -> ts.Scene:
    """W3 or W4, as `taisoft bench peers` has them."""
    return make_scene(next(one for one in WORKS if one.key == key))


# name: (scene, settings, steps)
DROPS: dict[str, tuple[Callable[[], ts.Scene], dict, int]] = {
    **{name: (lambda name=name: on_plane(name), EULER, 100) for name in MESH},
    "cloth": (lambda: cloth(0.11, 0.5), IMPLICIT | {"dt": 1 / 120}, 120),
    "cube pile": (lambda: demo("cube_pile"), EULER | {"contact_tolerance": 1e-3}, 200),
    "stack, Euler": (lambda: work("W3"), EULER, 100),
    "stack, BDF2": (lambda: work("W3"), BDF2, 100),
    "cube on sheet, Euler": (lambda: work("W4"), EULER, 100),
    "cube on sheet, BDF2": (lambda: work("W4"), BDF2, 100),
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
        "scene": name,
        "tets": tets,
        "seconds": seconds,
        "contacts": [int(r.n_contacts) for r in reports],
        "newton": [r.newton_iterations for r in reports],
        "linear": [r.linear_iterations for r in reports],
        "unconverged": sum(not r.converged for r in reports),
        "penetration": float(reports[-1].max_penetration),
    }


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    print(json.dumps(drop(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else DROPS[sys.argv[1]][2])))
