"""`taisoft warm` compiles the kernels of scenes of every kind, so that similar scenes of any size compile none:

* the table has the structure of every demo;
* scenes of the compiled structures add no kernel;
* simulations and statics use the requested precision, or else their own defaults.
"""

from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.runtime import n_compiled
from taisoft.cli import main, warm
from taisoft.cli.scene_file import load_scene, shipped_files
from taisoft.cli.warm import Structure, build, structures
from taisoft.dynamics.elimination import solve_on
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.fem.dependents import dependent_table
from taisoft.fem.reference import inverse_rest_edges
from taisoft.scene.obstacles import MeshObstacle
from taisoft.settings import plan_of
from tests.dynamics.scenes import dynamics

MANY_TRIANGLES = 1500  # `fine` in the docstring of Structure


def key(scene: ts.Scene, integrator: str, **solver) -> tuple:
    """The properties of a scene that kernels are compiled for."""
    scene = scene.snapshot()  # in which the laws of rigid bodies are chosen
    on = {name for name, is_on in plan_of(scene, integrator, solver.get("self_collision", False), False).on.items() if is_on}
    if integrator not in EXPLICIT:
        on -= {"fixed_nodes", "load_paths"}  # a mask, and forces that the host sets
    rigid = {body.name for body in scene.rigid_bodies}
    groups = sorted({(b.order, b.quadrature_degree, law, b.name in rigid) for b in scene.bodies for law in b.composition.laws})
    analytic = any(not isinstance(o.shape, MeshObstacle) for o in scene.obstacles)
    surfaces = [o.shape.surface() for o in scene.obstacles]
    counts = [len(b.nodes.surface) for b in scene.bodies] + [len(s[1]) for s in surfaces if s is not None]
    touches, table = "contact_forces" in on, dependent_table(scene)
    return (
        integrator,
        tuple(sorted(on)),
        tuple(groups),
        any(is_thin(b) for b in scene.bodies if b.name not in rigid),
        touches and analytic,
        touches and len(counts) > 1,
        touches and sum(counts) >= MANY_TRIANGLES,
        solver.get("contact_solver", "auto"),
        solver.get("precision", "f32"),
        0 if table is None else table.most_masters,
    )


def is_thin(body) -> bool:
    X, tets = body.mesh.vertices, body.mesh.tets
    edges = ((X[tets[:, 1:]] - X[tets[:, :1]]) ** 2).sum(axis=(1, 2))
    return bool((edges * (inverse_rest_edges(X, tets)[0] ** 2).sum(axis=(1, 2))).max() > 100.0**2)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_every_demo_is_in_the_table():
    covered = {
        key(build(one), one.integrator, precision="f64" if one.double else "f32", self_collision=one.self_collision)
        for one in structures()
    }
    missing = []
    for name in shipped_files("demos"):
        scene, solver = load_scene(name)
        if key(scene, **{"integrator": "implicit_euler"} | solver) not in covered:
            missing.append(name)
    assert missing == [], "add its Structure to warm.structures"


def test_scenes_of_other_sizes_compile_nothing():
    warm.simulate(Structure("implicit_euler", obstacles=("half-space",)), "f32")
    before = n_compiled()
    scene = ts.Scene()
    rubber = ts.Material(law="stable_neo_hookean", young=2e5, poisson=0.2, density=900.0)
    scene.add_body(ts.box_mesh((4, 3, 2), (0.3, 0.2, 0.1)), rubber, position=(0, 0.0501, 0))
    scene.add_obstacle(ts.HalfSpace((0, -0.05, 0), (0, 1, 0)))
    with ts.Simulator(scene, dt=2e-3, integrator="implicit_euler") as sim:
        sim.advance(2)
        assert np.isfinite(sim.positions()).all() and n_compiled() == before
    with dynamics(scene, dt=2e-3, integrator="implicit_euler") as made:
        made.advance(1)
        solver, x = made.stepper.solver, made.state.state()[0]
        solved = solve_on(solver, replace(solver.stage, tolerance=0.0), np.arange(20, 40), 0.0)  # as hard steps do
        assert solved.linear > 0.0 and not np.array_equal(made.state.state()[0], x) and n_compiled() == before


def test_precisions(monkeypatch, capsys):
    structure, found = Structure("implicit_euler", fixed=True), []
    for name in ("structures", "static_structures"):
        monkeypatch.setattr(warm, name, lambda: [structure])
    for name in ("simulate", "solve", "draw"):
        monkeypatch.setattr(warm, name, lambda structure, precision: found.append(precision))
    for requested, simulated, static in ((None, "f32", "f64"), ("f32", "f32", "f32"), ("f64", "f64", "f64")):
        found.clear()
        assert main(["warm", *(["--precision", requested] if requested else [])]) == 0
        assert found == [simulated, static, simulated] and f"statics in {static}" in capsys.readouterr().out
