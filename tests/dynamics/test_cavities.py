"""Cavities of given pressure and of given volume:

* a given pressure acts as `add_pressure` does; volumes and pressures can be asked for;
* a given volume is kept to 1e-6 in statics, also where the pressure falls as the volume grows, and in steps with and without
  contacts; a given pressure of the size found gives back the volume;
* paths, changes while it runs, checkpoints, scene files, refinement, and what is refused.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError, SimulationError
from taisoft.fem.pressure import cavity_form
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.plan import make_plan
from taisoft.scene.refine import refined, with_order
from tests.dynamics.companion import LOOSE, add_companion, simulator
from tests.dynamics.scenes import rubber
from tests.fem.shells import hold_planes, inside, thick_sphere
from tests.scene.toml_scenes import there_and_back

MESH = thick_sphere(1.0, 2.0, 2, 1, whole=True)
BALL = 4.0 / 3.0 * np.pi  # [m^3] of the cavity at rest
KEPT = 1e-6  # of the volume


def bare(order: int = 1, held: bool = True, mesh: ts.TetMesh = MESH, **cavity) -> ts.Scene:
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.contact_forces = False
    body = scene.add_body(mesh, rubber(), name="ball", order=order)
    if held:
        hold_planes(body)
    if cavity:
        body.add_cavity(inside(mesh, 1.0), **cavity)
    return scene


def balloon(**arguments) -> ts.Scene:
    return add_companion(bare(**arguments))


def test_a_given_pressure_is_add_pressure():
    scene, other = balloon(pressure=8e3, name="air"), balloon()
    other.body("ball").add_pressure(inside(MESH, 1.0), 8e3)
    found, wanted = ts.solve_static(scene), ts.solve_static(other)
    assert found.converged and np.array_equal(found.positions(), wanted.positions())
    assert found.cavity_pressure("air") == 8e3 and found.cavity_volume("air") > 1.1 * BALL
    with simulator(scene, "velocity_verlet", 1e-3) as sim:
        assert sim.cavity_volume("air") == pytest.approx(BALL, rel=1e-12) and sim.cavity_pressure("air") == 8e3
        for _ in range(5):
            sim.step()
        assert sim.energies().loads == pytest.approx(-8e3 * sim.cavity_volume("air")) and sim.cavity_volume("air") > 1.0002 * BALL
        sim.set_cavity("air", 2e3)
        assert sim.cavity_pressure("air") == 2e3


def test_static_volumes():
    """The pressure rises, and falls beyond its largest value; given as such, it leads to the same volume."""
    pressures = []
    for ratio in (1.0, 1.5, 8.0, 40.0):
        found = ts.solve_static(balloon(volume=ratio * BALL, name="water"))
        assert found.converged and found.load_steps == 1 and found.iterations <= 20
        assert found.cavity_volume("water") == pytest.approx(ratio * BALL, rel=KEPT)
        pressures.append(found.cavity_pressure("water"))
    assert abs(pressures[0]) < 1.0 and 5e3 < pressures[1] < pressures[2] and pressures[3] < pressures[2]
    again = ts.solve_static(balloon(pressure=pressures[1], name="air"), tolerance=1e-8)
    assert again.cavity_volume("air") == pytest.approx(1.5 * BALL, rel=1e-5)


@pytest.mark.parametrize("order", [1, 2])
def test_the_gradient_of_a_volume(order):
    scene = bare(order=order, volume=BALL, name="water")
    body, form, rng = scene.body("ball"), cavity_form(scene, "water"), np.random.default_rng(3)
    assert form.value_and_gradient(body.rest_positions)[0] == pytest.approx(BALL, rel=1e-12)
    x, way = body.rest_positions + 0.05 * rng.standard_normal((body.n_nodes, 3)), rng.standard_normal((body.n_nodes, 3))
    slope = (form.value_and_gradient(x + 1e-4 * way)[0] - form.value_and_gradient(x - 1e-4 * way)[0]) / 2e-4
    assert (form.value_and_gradient(x)[1] * way[form.nodes]).sum() == pytest.approx(slope, rel=1e-6)
    assert np.abs(form.value_and_gradient(x)[1].sum(axis=0)).max() < 1e-10  # a translation changes no volume


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_steps_keep_volumes(integrator):
    scene = balloon(held=False, volume=lambda t: BALL * (1.0 + 3.0 * t), name="water")
    scene.gravity = (0.0, -9.81, 0.0)
    with simulator(scene, integrator, 0.01, **LOOSE) as sim:
        for _ in range(6):
            report = sim.step()
            assert report.converged and sim.cavity_volume("water") == pytest.approx(BALL * (1 + 3 * sim.time), rel=KEPT)
        assert sim.cavity_pressure("water") > 1e3
        fall = sim.velocities("ball")[:, 1].mean()
        assert sim.energies().loads == 0.0 and fall == pytest.approx(-9.81 * sim.time, rel=0.05)


@pytest.mark.long  # an inextensible tendon with contacts takes the same way: test_tendons
def test_contacts_keep_volumes():
    mesh = thick_sphere(1.0, 1.5, 1, 1, whole=True)
    scene = ts.Scene()
    body = scene.add_body(mesh, rubber(), name="ball", position=(0, 0.02 - mesh.vertices[:, 1].min(), 0), velocity=(0, -2, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    body.add_cavity(inside(mesh, 1.0), volume=BALL, name="water")
    with simulator(add_companion(scene, attached=True), "implicit_euler", 1 / 60, **LOOSE) as sim:
        for _ in range(8):
            report = sim.step()
            assert report.converged and sim.cavity_volume("water") == pytest.approx(BALL, rel=KEPT)
        assert report.n_contacts > 0 and sim.cavity_pressure("water") > 100.0
        assert sim.contact_force("ground")[1] < -1e4


def test_changes_and_checkpoints(tmp_path):
    def make() -> ts.Scene:
        return balloon(volume=1.2 * BALL, name="water")

    def steps(sim, n: int) -> None:
        for _ in range(n):
            assert sim.step().converged

    with simulator(make(), "implicit_euler", 0.01, **LOOSE) as sim:
        steps(sim, 2)
        sim.set_cavity("water", 1.3 * BALL)
        steps(sim, 1)
        assert sim.cavity_volume("water") == pytest.approx(1.3 * BALL, rel=KEPT)
        sim.save_checkpoint(tmp_path / "c.npz")
        steps(sim, 2)
        wanted = sim.positions(), sim.cavity_pressure("water")
        with pytest.raises(SceneError, match="volume must be above 0, not -1"):
            sim.set_cavity("water", -1.0)
        with pytest.raises(SceneError, match="no cavity is called 'watr'; did you mean 'water'"):
            sim.set_cavity("watr", 1.0)
        with pytest.raises(SimulationError, match="needs integrator implicit_euler or bdf2"):
            sim.rebuild(integrator="velocity_verlet")
        sim.reset()
        assert sim.cavity_pressure("water") == 0.0
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", make()) as sim:
        steps(sim, 2)
        assert np.array_equal(sim.positions(), wanted[0]) and sim.cavity_pressure("water") == wanted[1]
    with pytest.raises(SceneError, match="differs in body 'ball': loads"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", balloon(pressure=1.2 * BALL, name="water"))


def test_scene_files_and_refinement(tmp_path):
    scene = bare(volume=ts.KeyFrames((0.0, 1.0), values=(BALL, 2 * BALL)), name="water")
    there_and_back(tmp_path / "a.toml", scene, {"dt": 0.01})
    again = ts.read_scene(tmp_path / "a.toml")[0]
    assert scene_digest(again) == scene_digest(scene)
    cavity = again.cavity("water")[1]
    assert cavity.given == "volume" and cavity.path(0.5) == 1.5 * BALL and cavity.rest_volume == pytest.approx(BALL)
    for change in (refined, lambda one: with_order(one, 2)):
        new = change(scene).cavity("water")[1]
        assert new.rest_volume == pytest.approx(BALL) and new.path.frames is scene.cavity("water")[1].path.frames
    assert scene_digest(bare(pressure=1.0)) != scene_digest(bare(volume=1.0))
    plan = make_plan(scene, False, False)
    assert plan.on["pressure"] and plan.why("pressure") == "on ball"


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({}, "give either a pressure or a volume"),
        ({"pressure": 1.0, "volume": 1.0}, "give either a pressure or a volume"),
        ({"volume": 0.0}, "volume must be above 0, not 0"),
        ({"volume": lambda t: t - 1.0}, "volume must be above 0, not -1"),
        ({"volume": (1.0, 2.0)}, "volume must be a number, not of shape .2,."),
        ({"volume": 1.0, "name": " "}, "name must be a text that is not empty"),
        ({"volume": 1.0, "where": [0, 1]}, "the chosen triangles have a border"),
        ({"volume": 1.0, "where": "outside"}, "the normals of the chosen triangles point outward"),
    ],
)
def test_bad_cavities_are_refused(arguments, message):
    body = bare().bodies[0]
    outside = np.setdiff1d(np.arange(len(MESH.surface)), inside(MESH, 1.0))
    where = arguments.get("where", inside(MESH, 1.0))
    arguments = {key: value for key, value in arguments.items() if key != "where"}
    with pytest.raises(SceneError, match=f"^body 'ball': add_cavity: {message}"):
        body.add_cavity(outside if isinstance(where, str) else where, **arguments)
    assert body.cavities == []


def test_cavities_must_not_overlap_and_have_names_of_their_own():
    scene = bare(volume=BALL, name="water")
    body, triangle = scene.bodies[0], inside(MESH, 1.0).min()
    rule = f"body 'ball': add_cavity: surface triangle {triangle} of cavity 'air' belongs to cavity 'water'"
    with pytest.raises(SceneError, match=rule):
        body.add_cavity(inside(MESH, 1.0), pressure=1.0, name="air")
    assert [cavity.name for cavity in body.cavities] == ["water"]
    other = scene.add_body(MESH, rubber(), name="other", position=(5, 0, 0))
    other.add_cavity(inside(MESH, 1.0), pressure=1.0, name="water")
    with pytest.raises(SceneError, match="body 'other': cavity name 'water' is taken"):
        scene.check()


@pytest.mark.parametrize("integrator", ["velocity_verlet", "linearly_implicit_euler", "implicit_midpoint"])
def test_integrators_that_cannot_keep_a_volume_are_refused(integrator):
    with pytest.raises(SimulationError, match="cavity 'ball cavity 0' of given volume needs integrator implicit_euler or bdf2"):
        ts.Simulator(bare(volume=BALL), integrator=integrator)
    with pytest.raises(SimulationError, match="without a tolerance"):
        ts.Simulator(bare(volume=BALL), tolerance=1e-2)


@pytest.mark.parametrize("prescribed", [False, True])
def test_a_volume_whose_surface_cannot_move_is_refused(prescribed):
    scene = bare(held=False, volume=BALL, name="water")
    near = np.linalg.norm(scene.bodies[0].rest_positions, axis=1) < 1.1
    if prescribed:
        scene.bodies[0].move(near, lambda t: (t, 0.0, 0.0))
    else:
        scene.bodies[0].fix(near)
    for build in (ts.solve_static, lambda one: simulator(one, "implicit_euler", 0.01)):
        with pytest.raises(SceneError, match="cavity 'water': its volume cannot be given, because its surface is fixed"):
            build(scene)
