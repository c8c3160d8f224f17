"""Bodies that fall and come to rest in implicit steps: a process of `taisoft bench contact --drops`.

python contact_drops.py SCENE [STEPS] runs a scene of DROPS and prints times and iterations as a line of JSON. It uses nothing
newer than version 0.1, so that both versions can be measured.
"""

import json
import sys
import warnings
from collections.abc import Callable

import taisoft as ts

if __package__:
    from .contact_states import DOWN, EULER, GROUND, IMPLICIT, MESHES, cloth, demo, figure, open_silently, rubber, take_steps
    from .programs.own import make_scene
    from .works.scenes import WORKS
else:  # as a program
    from contact_states import DOWN, EULER, GROUND, IMPLICIT, MESHES, cloth, demo, figure, open_silently, rubber, take_steps

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
    """W3 or W4 of `taisoft bench peers`."""
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
    """Whether the scene's mesh is available."""
    return name not in MESH or (MESHES / MESH[name]).is_file()


def drop(name: str, steps: int) -> dict:
    """Times without compilation, iterations and contacts of each step of a scene."""
    build, settings, _ = DROPS[name]
    with open_silently(build(), **settings, precision="f32") as sim:
        seconds, reports = take_steps(sim, steps)
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
