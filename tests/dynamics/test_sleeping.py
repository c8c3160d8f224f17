"""Bodies at rest sleep: what wakes them, that nothing is lost meanwhile, and that they then move as if they had never slept."""

import numpy as np
import pytest

import taisoft as ts

from .contact_scenes import SIDE, cube, ground, material

DT, REST = 1 / 100, 8.5  # [s]; the latter: time in which the scenes come to rest and fall asleep
WEIGHT = 1000.0 * SIDE**3 * 9.81  # of a cube [N]


def pile(high: int = 2, others: int = 0, **numbers) -> ts.Scene:
    """A pile of cubes on the ground, and others alone beside it, all just above what they come to rest on."""
    scene = ts.Scene()
    foam = material(**{"mass_damping": 20.0, **numbers})
    for k in range(high):
        scene.add_body(cube(1), foam, name=f"cube {k}", position=(0.003 * k, 1.002 * SIDE * k + 1e-4, 0.0))
    for k in range(others):
        scene.add_body(cube(1), foam, name=f"other {k}", position=(5 * SIDE * (k + 1), 1e-4, 0.0))
    scene.add_obstacle(ground(), name="ground", friction=0.5)
    return scene


def simulator(scene: ts.Scene, **settings) -> ts.Simulator:
    return ts.Simulator(scene, **{"dt": DT, "precision": "f64", **settings})


def steps(sim: ts.Simulator, seconds: float) -> list[ts.StepReport]:
    return [sim.step() for _ in range(round(seconds / DT))]


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2", "linearly_implicit_euler"])
def test_a_pile_that_is_pushed_moves_as_one_that_never_slept(integrator):
    scene = pile(others=1)
    scene.body("cube 0").add_force(lambda X: X[:, 0] > 0.49 * SIDE, (0.0, 0.0, 0.0))
    ways, forces = [], []
    for sleep in (True, False):
        with simulator(scene, integrator=integrator, sleep=sleep) as sim:
            steps(sim, REST)
            assert sim.asleep == ["cube 0", "cube 1", "other 0"] * sleep
            sim.set_force("cube 0", 0, (6.0, 0.0, 0.0))
            assert sim.asleep == ["other 0"] * sleep
            way = []
            for _ in range(30):
                sim.step()
                way.append(sim.positions())
            ways.append(np.array(way))
            forces.append(sim.contact_force("ground"))
    assert np.abs(ways[1][-1] - ways[1][0]).max() > 0.01 * SIDE
    assert np.abs(ways[0] - ways[1]).max() < 1e-6 * SIDE
    np.testing.assert_allclose(*forces, rtol=1e-5)


def test_nothing_is_lost_of_what_sleeps():
    with simulator(pile()) as sim:
        last = steps(sim, REST)[-1]
        x, contacts = sim.positions(), sim.contacts()
        report = sim.step()
        assert sim.asleep and report.time == pytest.approx(REST + DT) and report.newton_iterations == 0 and report.converged
        assert (sim.positions() == x).all() and not sim.velocities().any()
        assert report.elastic == last.elastic and report.n_contacts == last.n_contacts == len(contacts.gap) > 0
        assert sim.contact_force("ground")[1] == pytest.approx(-2 * WEIGHT, rel=1e-6)
        assert sim.contact_force("cube 0", "cube 1")[1] == pytest.approx(-WEIGHT, rel=1e-6)
        assert {frozenset(pair) for pair in sim.pairs_in_contact()} == {
            frozenset(("cube 0", "cube 1")),
            frozenset(("cube 0", "ground")),
        }
        assert len(sim.detect_contacts().gap) >= len(contacts.gap)  # a query looks among sleeping bodies, too
        pressures = sim.contact_pressure("cube 0")
        assert sim.asleep and (sim.positions() == x).all()
        sim.step()
        np.testing.assert_array_equal(sim.contact_pressure("cube 0").pressure, pressures.pressure)


def test_only_what_is_met_wakes_and_at_once():
    scene = pile(others=1)
    scene.add_body(cube(1), material(mass_damping=20.0), name="ball", position=(0.02, 4.7, 0.01))  # falls at 0.49 m/s
    ways = []
    for sleep in (True, False):
        with simulator(scene, sleep=sleep) as sim:
            steps(sim, REST)
            assert set(sim.asleep) == ({"cube 0", "cube 1", "other 0"} if sleep else set())
            way, touched = [], False
            for _ in range(200):
                sim.step()
                touched |= bool(np.linalg.norm(sim.contact_force("ball")) > 0.0)
                assert not sleep or not touched or sim.asleep == ["other 0"]
                way.append(sim.positions())
            assert touched
            ways.append(np.array(way))
    assert np.ptp(ways[1][:, :8], axis=0).max() > 1e-3 * SIDE  # the blow moves the lowest cube
    assert np.abs(ways[0] - ways[1]).max() < 1e-5 * SIDE


@pytest.mark.parametrize("asleep", [False, True])
def test_a_contact_that_only_the_step_finds_wakes(asleep):
    """The search looks along the velocities at the step's start: a shot by a force lasts one step, and hits within it."""
    scene = pile(high=1)
    scene.add_body(cube(1), material(), name="shot", position=(-2 * SIDE, 1e-4, 0.0)).add_force(
        lambda X: X[:, 0] > -1.0, lambda t: (3e4 if abs(t - REST - DT) < 0.5 * DT else 0.0, 0.0, 0.0)
    )
    with simulator(scene, sleep=asleep, integrator="implicit_euler") as sim:
        steps(sim, REST)
        assert sim.asleep == ["cube 0"] * asleep
        report = sim.step()
        assert sim.asleep == [] and report.time == pytest.approx(REST + DT)
        assert sim.contact_force("cube 0", "shot")[0] > 1e3 and sim.velocities("cube 0")[:, 0].mean() > 1.0


def test_an_obstacle_that_begins_to_move_wakes_what_lies_on_it():
    scene = pile(high=1, others=1)
    scene.add_obstacle(ts.Box((-0.5, 0.2, 0.0), (0.05, 0.05, 0.2)), name="door")
    with simulator(scene) as sim:
        steps(sim, REST)
        assert set(sim.asleep) == {"cube 0", "other 0"}
        sim.set_pose("door", (0.3, 0.0, 0.0), seconds=0.1)
        steps(sim, 0.1)
        assert set(sim.asleep) == {"cube 0", "other 0"}
        sim.set_pose("door", (0.5, -0.1, 0.0), seconds=0.2)
        steps(sim, 0.3)
        assert sim.asleep == ["other 0"] and sim.positions("cube 0")[:, 0].mean() > 0.02
        sim.set_pose("ground", (0.0, 0.01, 0.0), seconds=0.1)
        steps(sim, 0.1)
        assert sim.asleep == []
        assert sim.positions("other 0")[:, 1].min() > 0.0095


def test_what_drifts_does_not_sleep_however_slowly():
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    for k, speed in enumerate((0.0, 2e-9)):  # 4e-8 of the size in 200 steps, which would be little enough
        scene.add_body(
            cube(1), material(mass_damping=0.0), name=f"cube {k}", position=(3 * SIDE * k, 0.0, 0.0), velocity=(0, speed, 0)
        )
    with simulator(scene) as sim:
        steps(sim, 8.0)
        assert sim.asleep == ["cube 0"]
        assert sim.momentum()[1] == pytest.approx(2e-9 * 1000.0 * SIDE**3)


def test_what_turns_back_or_slides_slowly_does_not_sleep():
    thrown, slope = ts.Scene(), ts.Scene(gravity=(9.81 * np.sin(angle := np.arctan(0.50005)), -9.81 * np.cos(angle), 0.0))
    thrown.add_body(cube(1), material(mass_damping=0.0), name="cube", position=(0.0, 1.0, 0.0), velocity=(0.0, 0.2, 0.0))
    plate = ts.box_mesh((2, 1, 2), (SIDE, 0.3 * SIDE, SIDE), (0.0, 0.15 * SIDE, 0.0))
    slope.add_body(plate, material(mass_damping=20.0), name="plate", position=(0.0, 1e-5, 0.0))
    for scene in (thrown, slope):
        scene.add_obstacle(ground(), name="ground", friction=0.5)
    with simulator(thrown, dt=5e-5, precision="f32") as sim:
        for _ in range(700):  # at the top after 400, and always within 2e-3 of the size from there within 600
            sim.step()
            assert not sim.asleep
    with simulator(slope, precision="f32") as sim:
        steps(sim, 7.0)
        assert not sim.asleep and sim.velocities()[:, 0].mean() > 1e-5


def test_a_blow_in_an_early_part_of_a_step_wakes():
    ways = []
    for sleep in (True, False):
        scene = pile(high=1)
        shot = scene.add_body(cube(1), material(restitution=0.9), name="shot", position=(-2 * SIDE, 1e-4, 0.0))
        shot.add_force(lambda X: X[:, 0] > -1.0, lambda t: (2000.0 if abs(t - REST - DT) < 0.5 * DT else 0.0, 0.0, 0.0))
        with simulator(scene, sleep=sleep) as sim:
            steps(sim, REST)
            assert sim.asleep == ["cube 0"] * sleep
            reports = steps(sim, 2 * DT)
            assert max(report.substeps for report in reports) > 1 and not sim.asleep
            ways.append(sim.positions())
    assert np.abs(ways[0] - ways[1]).max() < 1e-5 * SIDE


def test_connected_bodies_sleep_and_wake_together_and_constraints_bear_as_before():
    scene = ts.Scene()
    for name, y in (("hung", SIDE), ("low", -3 * SIDE)):
        scene.add_body(cube(1), material(mass_damping=40.0), name=name, position=(0.0, y, 0.0))
    scene.body("hung").fix(lambda X: X[:, 1] > 0.99 * SIDE)
    scene.body("hung").add_force(lambda X: X[:, 1] < 0.01, (0.0, 0.0, 0.0))
    scene.add_spring(("hung", (0.0, 0.0, 0.0)), ("low", (0.0, SIDE, 0.0)), stiffness=500.0, damping=30.0)
    with simulator(scene) as sim:
        steps(sim, REST)
        assert sim.asleep == ["hung", "low"]
        assert sim.reactions()[:8, 1].sum() == pytest.approx(2 * WEIGHT, rel=1e-6)
        sim.set_force("hung", 0, (0.0, -0.1, 0.0))
        steps(sim, 0.1)
        assert sim.asleep == [] and np.abs(sim.velocities("low")).max() > 0.0


def test_a_checkpoint_of_sleeping_bodies_continues_bitwise(tmp_path):
    scene = pile(others=1)
    scene.add_body(cube(1), material(mass_damping=20.0), name="ball", position=(0.02, 4.7, 0.01))
    with simulator(scene) as sim:
        steps(sim, REST)
        sim.save_checkpoint(tmp_path / "asleep.npz")
        with ts.Simulator.load_checkpoint(tmp_path / "asleep.npz", scene) as other:
            other.warm_up()  # wakes nothing
            assert other.asleep == sim.asleep and len(sim.asleep) == 3
            assert (other.contact_force("ground") == sim.contact_force("ground")).all()
            for _ in range(130):  # the ball comes and wakes the pile
                sim.step(), other.step()
            assert other.asleep == sim.asleep == ["other 0"]
            assert (sim.positions() == other.positions()).all() and (sim.velocities() == other.velocities()).all()


def test_changes_wake_and_a_drag_wakes_its_body_alone():
    scene = pile(high=1, others=1)
    with simulator(scene, draggable=True) as sim:
        steps(sim, REST)
        assert len(sim.asleep) == 2
        sim.drag("cube 0", [6, 7], [0.5, 0.5], (0.2, 0.3, 0.0), 50.0)
        steps(sim, 2.5)
        assert sim.asleep == ["other 0"]
        sim.release()
        for change in (
            lambda: sim.set_gravity((0.0, -9.0, 0.0)),
            lambda: sim.set_contact("cube 0", "ground", friction=0.1),
            lambda: sim.set_material("cube 0", young=2e5),
            lambda: sim.set_state(sim.positions()),
            sim.reset,
        ):
            sim.rebuild()
            steps(sim, REST)
            assert len(sim.asleep) == 2
            change()
            assert sim.asleep == [] and sim.step().converged
        dt = sim.dt
        sim.dt = 0.5 * dt
        assert sim.asleep == []


def test_the_plan_says_what_may_sleep():
    scene = pile(others=1)
    scene.body("other 0").move(lambda X: X[:, 1] < 0.01, lambda t: (0.0, 0.0, 0.0))
    with simulator(scene) as sim:
        assert sim.plan.why("sleeping") == "implicit steps leave out bodies at rest, but for other 0"
        steps(sim, REST)
        assert sim.asleep == ["cube 0", "cube 1"]
    for settings, why in (
        ({"sleep": False}, "switched off, or steps follow a tolerance"),
        ({"integrator": "velocity_verlet", "dt": 1e-4}, "explicit steps move everything"),
        ({"integrator": "static"}, "statics has no velocities"),
        ({"tolerance": 1e-2}, "switched off, or steps follow a tolerance"),
    ):
        with simulator(pile(high=1), **settings) as sim:
            assert not sim.plan.on["sleeping"] and sim.plan.why("sleeping") == why and sim.asleep == []
            assert sim.step().converged
    with pytest.raises(ts.SimulationError, match="^sleep must be True or False, not 1$"):
        simulator(pile(), sleep=1)
