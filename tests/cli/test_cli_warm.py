"""`taisoft warm` compiles the kernels of scenes of every kind, so that similar scenes of any size compile none:

* afterwards, demos of the compiled structures add no kernel to the cache on disk and print nothing about compiling;
* the table has the structure of every demo;
* each scene of the table has the features of its structure;
* simulations and statics use the requested precision, or else their own defaults.
"""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.runtime import n_compiled
from taisoft.cli import main, warm
from taisoft.cli.scene_file import load_scene, shipped_files
from taisoft.cli.warm import Structure, build, static_structures, structures
from taisoft.collision.surface import SERIAL_BELOW
from taisoft.dynamics.elimination import solve_on
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.fem.dependents import dependent_table
from taisoft.fem.model import ILL_CONDITIONED
from taisoft.fem.reference import inverse_rest_edges
from taisoft.scene.obstacles import MeshObstacle
from taisoft.settings import plan_of
from tests.cli.command import ROOT
from tests.dynamics.scenes import dynamics

DEMOS = {
    "hanging_beam": Structure("velocity_verlet", fixed=True),
    "twisting_bar": Structure("implicit_euler", fixed=True, prescribed=True, mass_damping=True),
}


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
        touches and sum(counts) >= SERIAL_BELOW,
        solver.get("contact_solver", "auto"),
        solver.get("precision", "f32"),
        0 if table is None else table.most_masters,
    )


def is_thin(body) -> bool:
    X, tets = body.mesh.vertices, body.mesh.tets
    edges = ((X[tets[:, 1:]] - X[tets[:, :1]]) ** 2).sum(axis=(1, 2))
    return bool((edges * (inverse_rest_edges(X, tets)[0] ** 2).sum(axis=(1, 2))).max() > ILL_CONDITIONED**2)


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


@pytest.mark.long
def test_demos_compile_nothing_after_warming(tmp_path):
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    code = (
        "import tests.cli.test_cli_warm as t\nfrom taisoft.cli import main, warm\n"
        "warm.structures, warm.static_structures = t.DEMOS.values, tuple\nmain(['warm'])"
    )
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert len(done.stdout.splitlines()) == len(DEMOS) + 2 and done.stderr == ""
    before = set(tmp_path.rglob("*.tic"))
    assert len(before) > 5
    for name in DEMOS:
        command = [sys.executable, "-m", "taisoft", "run", name, "--headless", "--seconds", "0.1"]
        command += ["--out", str(tmp_path / name)]  # with pictures and a scene.usdc
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert set(tmp_path.rglob("*.tic")) == before, name
        assert "compiling" not in done.stderr


@pytest.mark.long
@pytest.mark.parametrize("name", ["inflated_finger", "gripper"])
def test_f64_demos_compile_nothing_after_warming(name):
    scene, solver = load_scene(name)
    solver = {"integrator": "implicit_euler", "dt": solver["dt"], "precision": solver["precision"]}
    structure = next(one for one in structures() if one.double and one.attached == bool(scene.exact_attachments))
    warm.simulate(structure, "f64")
    before = n_compiled()
    with ts.Simulator(scene, **solver) as sim:
        for _ in range(10):  # `advance` may take fewer
            sim.step()
        assert np.isfinite(sim.stress()).all() and sim.energies().kinetic > 0.0 and n_compiled() == before


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


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_scenes_have_the_features_of_their_structure():
    features = {
        "fixed": "fixed_nodes",
        "prescribed": "moving_nodes",
        "loaded": "loads",
        "pressed": "pressure",
        "tied": "springs",
        "rigid": "rigid_bodies",
        "mean_dilatation": "mean_dilatation",
        "by_tet": "elasticity_by_tet",
        "mass_damping": "mass_damping",
        "stiffness_damping": "stiffness_damping",
    }
    for one in dict.fromkeys([*structures(), *static_structures()]):
        scene = build(one)
        on, first = plan_of(scene, one.integrator or "implicit_euler", False, False).on, scene.bodies[0]
        assert {name: on[feature] for name, feature in features.items()} == {name: getattr(one, name) for name in features}, one
        assert on["dependent_nodes"] == (one.attached or one.rigid or one.skinned) and on[f"law:{one.law}"], one
        assert (scene.bodies[-1].skin is not None) == one.skinned, one
        assert [b.order for b in scene.bodies] == list(one.orders), one
        assert [o.name for o in scene.obstacles] == list(one.obstacles), one
        assert (is_thin(first), len(first.nodes.surface) > SERIAL_BELOW) == (one.thin, one.fine), one


@pytest.mark.parametrize("requested, simulated, static", [(None, "f32", "f64"), ("f32", "f32", "f32"), ("f64", "f64", "f64")])
def test_precisions(requested, simulated, static, monkeypatch, capsys):
    structure, found = Structure("implicit_euler", fixed=True), []
    monkeypatch.setattr(warm, "structures", lambda: [structure])
    monkeypatch.setattr(warm, "static_structures", lambda: [structure])
    monkeypatch.setattr(warm, "simulate", lambda structure, precision: found.append(precision))
    monkeypatch.setattr(warm, "solve", lambda structure, precision: found.append(precision))
    monkeypatch.setattr(warm, "draw", lambda structure, precision: found.append(precision))
    assert main(["warm", *(["--precision", requested] if requested else [])]) == 0
    assert found == [simulated, static, simulated] and f"statics in {static}" in capsys.readouterr().out
