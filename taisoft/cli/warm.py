"""`taisoft warm [SCENE ...]`: compiles the kernels of scenes in advance, so that later runs find them in the disk cache.

Kernels depend on what a scene holds, and little on its meshes and numbers, so that a scene serves all others of its kind. Without
names the demos are compiled, their pictures, and statics.
"""

import time
import warnings
from argparse import Namespace
from collections.abc import Callable

import taisoft as ts
from taisoft import compile_message
from taisoft.backend.runtime import n_compiled
from taisoft.cli.run import RUN_KEYS
from taisoft.cli.scene_file import load_scene, shipped_files
from taisoft.errors import MissingPackage
from taisoft.static import solve_static
from taisoft.view.offscreen import Offscreen

PICTURED, HELD = "drop_test", "hanging_beam"  # the demos whose pictures and statics are compiled


def warm(arguments: Namespace) -> int:
    """Compile, print one line per scene, and return 0. precision: of all, by default the scenes' own, and f64 of statics."""
    start, before, chosen = time.perf_counter(), n_compiled(), arguments.precision
    with compile_message.silenced():
        for name in arguments.scenes or shipped_files("demos"):
            try:
                scene, solver = load_scene(name)
            except MissingPackage as error:
                if arguments.scenes:
                    raise
                print(f"{name:<30} left out: {error}", flush=True)
                continue
            given = {key: value for key, value in solver.items() if key not in (*RUN_KEYS, "tolerance")}
            _report(name, simulate, scene, given | ({"precision": chosen} if chosen else {}))
        if not arguments.scenes:
            _report("pictures", draw, load_scene(PICTURED)[0], chosen or "f32")
            _report("statics", solve_static, load_scene(HELD)[0], precision=chosen or "f64")
    print(f"{n_compiled() - before} kernels in {time.perf_counter() - start:.0f} s")
    return 0


def _report(title: str, compile_for: Callable, *given, **named) -> None:
    start, before = time.perf_counter(), n_compiled()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        compile_for(*given, **named)
    print(f"{title:<30} {n_compiled() - before:3d} kernels {time.perf_counter() - start:6.1f} s", flush=True)


def simulate(scene: ts.Scene, settings: dict) -> None:
    """Warm up, and compute what a run with --out writes."""
    with ts.Simulator(scene, **settings) as sim:
        sim.warm_up()
        sim.energies()
        sim.stress()


def draw(scene: ts.Scene, precision: str) -> None:
    """Draw a picture with a shadow; its kernels depend on nothing but the precision."""
    with ts.Simulator(scene, precision=precision) as sim:
        Offscreen(scene, (64, 36)).image(sim)
