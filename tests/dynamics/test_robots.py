"""Robots that run with a simulation.

* a robot that touches nothing moves bit by bit as in MuJoCo alone, and one clock, reset, checkpoint and rebuild serve both;
* its links feel the sums of their contacts, and of what is attached to them, about their centres of mass, whatever axis is up;
* the error of weak coupling is of first order in dt; iterations agree, also where weak coupling is unstable, and say if not;
* controls follow paths until they are set; a step that fails leaves bodies and robots as they were;
* what cannot work with robots is refused by name.
"""

import copy
import subprocess
import sys

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics.implicit import ImplicitStepper
from taisoft.dynamics.running_robot import RunningRobot

mujoco = pytest.importorskip("mujoco")

DT = 0.01
PLATE = """<mujoco>
  <option timestep="0.004"/>
  <worldbody>
    <body name="plate">
      <joint name="lift" type="slide" axis="0 0 1" stiffness="400"/>
      <geom type="box" size=".2 .2 .02" mass="{mass}"/>
      <site name="joint"/>
    </body>
    <body name="arm" pos="0 0 2">
      <joint name="swing" axis="0 1 0" damping=".1" frictionloss=".01"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/>
      <body name="hand" pos=".3 0 0">
        <joint name="turn" axis="0 1 0"/>
        <geom type="sphere" size=".05" mass=".5"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="swing" joint="swing"/><position name="turn" joint="turn" kp="5" kv=".2"/></actuator>
  <sensor><force name="joint" site="joint"/></sensor>
</mujoco>"""
CUBE = ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1))
STEEL = ts.Material(young=1e7, poisson=0.3, density=1000.0, friction=0.8)  # hard beside the plate's spring


@pytest.fixture(scope="module")
def load(tmp_path_factory):
    """Return a function that loads the robot with a plate of some mass [kg]."""

    def loaded(mass: float = 2.0, **arguments) -> ts.Robot:
        path = tmp_path_factory.mktemp("robot") / "plate.xml"
        path.write_text(PLATE.format(mass=mass))
        return ts.Robot.load(path, **arguments)

    return loaded


def resting(robot: ts.Robot, up: str = "z", **arguments) -> ts.Scene:
    """A cube of 1 kg just above the plate, far below the arm."""
    scene = ts.Scene(up=up)
    place = (0.03, 0.04, 0.0701) if up == "z" else (0.03, 0.0701, -0.04)
    scene.add_body(CUBE, STEEL, name="cube", position=place)
    scene.add_robot(robot, friction=0.8, **arguments)
    return scene


def swing(sim: ts.Simulator, steps: int) -> list[np.ndarray]:
    """Positions of MuJoCo after each step, with controls that change."""
    found = []
    for _ in range(steps):
        sim.robot.control["swing"] = np.sin(20.0 * sim.time)
        sim.step()
        found.append(np.array(sim.robot.joint))
    return found


def test_a_free_robot_moves_as_in_mujoco_alone(load):
    robot = load(joints={"turn": 0.3})
    model = copy.copy(robot.model)
    data, model.opt.timestep = robot.make_data(model), DT / 3  # the longest that divides dt
    scene = resting(robot, links=("arm", "hand"))
    scene.add_ground(height=-1.0)
    with ts.Simulator(scene, dt=DT) as sim:
        assert sim.robot is sim.robots["robot"] and sim.robot.control["turn"] == 0.3
        for found in swing(sim, 20):
            data.ctrl[0] = np.sin(20.0 * round(data.time / DT) * DT)
            mujoco.mj_step(model, data, 3)
            np.testing.assert_array_equal(found, data.qpos)
        assert sim.robot.data.time == pytest.approx(sim.time)
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(sim.pose("robot/hand").translation, data.geom_xpos[2], atol=1e-12)
        np.testing.assert_allclose(sim.robot.link_pose("hand").translation, data.body("hand").xpos, atol=1e-12)


def test_reset_checkpoint_and_rebuild_hold_robots_too(load, tmp_path):
    robot = load()

    def state(sim):
        robot = sim.robot
        return np.concatenate([robot.joint, robot.joint_velocity, robot.sensor, sim.positions().ravel()])

    with ts.Simulator(resting(robot), dt=DT) as sim:
        swing(sim, 4)
        sim.save_checkpoint(tmp_path / "c.npz")
        swing(sim, 4)
        end = state(sim)
        sim.reset()
        assert np.array_equal(sim.robot.joint, robot.make_data().qpos) and not sim.robot.wrenches.any()
        swing(sim, 8)
        np.testing.assert_array_equal(state(sim), end)
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", resting(robot)) as sim:
        swing(sim, 4)
        np.testing.assert_array_equal(state(sim), end)
        before = sim.robot
        sim.rebuild(integrator="bdf2")
        with pytest.raises(ts.SimulationError, match="its simulator was closed or rebuilt: take it from sim.robots again"):
            before.control["swing"] = 1.0
        np.testing.assert_array_equal(state(sim), end)
        sim.step()
        assert sim.robot.data.time == pytest.approx(9 * DT)
    other = load(1.9)
    with pytest.raises(ts.SceneError, match="differs in robot 'robot'"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", resting(other))


@pytest.mark.parametrize("up", ["y", "z"])
def test_a_link_feels_the_sum_of_its_contacts_about_its_centre(load, up):
    with ts.Simulator(resting(load(), up=up), dt=DT) as sim:
        for _ in range(15):
            sim.step()
        contacts, (force, torque) = sim.contacts(), sim.robot.link_wrench("plate")
        assert len(contacts.gap) and sim.robot.link_wrench("arm").force.tolist() == [0.0, 0.0, 0.0]
        forces, centre = -contacts.impulse / DT, sim.robot.link_pose("plate").translation
        size = np.abs(forces.sum(axis=0)).max()
        np.testing.assert_allclose(force, forces.sum(axis=0), atol=1e-6 * size)
        moments = np.cross(contacts.point - centre, forces).sum(axis=0)
        np.testing.assert_allclose(torque, moments, atol=1e-3 * size)  # [m]: points lie midway in the gap, and were at the start
        down = -np.array([0.0, 0.0, 1.0] if up == "z" else [0.0, 1.0, 0.0])
        assert force @ down > 0.5 * size and abs(torque).max() > 0.02 * size
        assert sim.robot.joint_load["lift"] == pytest.approx(-force @ down) and sim.robot.joint_load["swing"] == 0.0


def oscillation(t: np.ndarray, mass: float) -> np.ndarray:
    """Height (k,) [m] at times t of plate and cube together on the spring, from rest at 0."""
    total = mass + 1.0
    return 9.81 * total / 400.0 * (np.cos(np.sqrt(400.0 / total) * t) - 1.0)


def lift(scene: ts.Scene, dt: float, seconds: float = 0.1) -> tuple[np.ndarray, np.ndarray, list]:
    """Times, heights of the plate, and reports of its steps."""
    with ts.Simulator(scene, dt=dt) as sim:
        rows = [(sim.step(), sim.time, sim.robot.joint["lift"]) for _ in range(round(seconds / dt))]
    reports, times, heights = zip(*rows)
    return np.array(times), np.array(heights), reports


def test_the_error_of_weak_coupling_is_of_first_order(load):
    robot, errors = load(), []
    for dt in (0.004, 0.002):
        t, z, _ = lift(resting(robot), dt)
        errors.append(np.abs(z - oscillation(t, 2.0)).max())
    assert 1.6 < errors[0] / errors[1] < 2.5, errors


def test_iterations_agree_where_weak_coupling_is_unstable(load):
    robot = load(0.2)
    t, weak, _ = lift(resting(robot), 0.004)
    _, strong, reports = lift(resting(robot, iterations=30), 0.004)
    exact = oscillation(t, 0.2)
    assert all(report.converged for report in reports)
    assert np.abs(strong - exact).max() < 0.05 * np.abs(exact).max() < np.abs(weak - exact).max()
    *_, reports = lift(resting(robot, iterations=2), 0.004)
    unfinished = [report for report in reports if not report.converged]
    assert unfinished and "robot do not agree after 2 iterations" in unfinished[0].problems[-1]


def test_links_feel_what_is_attached_to_them(load):
    """A cube hangs on the plate exactly, one by a spring, one by an attachment with springs: 3 kg at rest on 400 N/m."""
    scene, robot = ts.Scene(up="z"), load(joints={"lift": -9.81 * 5.0 / 400.0})
    damped = ts.Material(young=1e6, poisson=0.3, density=1000.0, mass_damping=20.0)
    scene.add_robot(robot, name="r", links=("plate",), iterations=30)
    z = robot.make_data().qpos[0]
    for name, x in (("exact", -0.15), ("spring", 0.0), ("soft", 0.15)):
        scene.add_body(CUBE, damped, name=name, position=(x, 0.0, z - 0.0701))
    top = {name: scene.body(name).rest_positions[:, 2] > 0.049 for name in ("exact", "soft")}
    scene.attach("exact", np.flatnonzero(top["exact"]), "r/plate")
    scene.attach("soft", np.flatnonzero(top["soft"]), "r/plate", stiffness=5e4, damping=50.0)
    scene.add_spring(("spring", (0.0, 0.0, 0.05)), ("r/plate", (0.0, 0.0, 0.0)), 5e4, damping=100.0)
    scene.contact_forces = False
    with ts.Simulator(scene, dt=0.02, integrator="implicit_euler") as sim:
        sim.run(1.5)
        force, torque = sim.robot.link_wrench("plate")
        np.testing.assert_allclose(force, (0.0, 0.0, -3 * 9.81), atol=0.02 * 9.81)
        np.testing.assert_allclose(torque, 0.0, atol=0.02)
        assert sim.robot.joint["lift"] == pytest.approx(z, abs=2e-3)
        assert sim.robot.sensor["joint"][2] == pytest.approx(5 * 9.81, rel=0.01)  # of the plate, too


def test_controls_follow_their_paths_until_they_are_set(load):
    ramp = ts.KeyFrames((0.0, 0.1), values=(0.0, 1.0))
    scene = resting(load(), control={"swing": ramp, "turn": lambda t: 2.0 * t})
    with ts.Simulator(scene, dt=DT) as sim:
        sim.step()
        assert np.array(sim.robot.control) == pytest.approx([0.1, 0.02])
        sim.robot.control["swing"] = 5.0
        sim.step()
        assert np.array(sim.robot.control) == pytest.approx([5.0, 0.04])
        sim.reset()
        sim.step()
        assert np.array(sim.robot.control) == pytest.approx([0.1, 0.02])


@pytest.mark.parametrize("iterations", [1, 5])
def test_a_step_that_fails_leaves_both_as_they_were(load, iterations, monkeypatch):
    with ts.Simulator(resting(load(), iterations=iterations), dt=DT) as sim:
        swing(sim, 3)
        before = np.array(sim.robot.joint), sim.positions(), sim.time
        sim.robot.control["swing"] = 1e20
        for _ in range(2):  # MuJoCo itself speaks only of the first
            with pytest.raises(ts.SimulationError, match="step 4: robot 'robot': MuJoCo: Nan, Inf or huge value in CTRL"):
                sim.step()
        sim.robot.control["swing"] = 0.0
        monkeypatch.setattr(ImplicitStepper, "advance", lambda self, n, dt: 1 / 0)  # after MuJoCo has moved the robot
        with pytest.raises(ZeroDivisionError):
            sim.step()
        monkeypatch.undo()
        for found, kept in zip((np.array(sim.robot.joint), sim.positions(), sim.time), before):
            np.testing.assert_array_equal(found, kept)
        assert sim.step().converged


def test_an_interrupt_after_the_bodies_step_leaves_one_clock(load, monkeypatch):
    with ts.Simulator(resting(load()), dt=DT) as sim:
        swing(sim, 12)
        measure, calls = RunningRobot.measure_wrenches, []

        def interrupted(robot, bodies):
            calls.append(1)
            if len(calls) == 1:
                raise KeyboardInterrupt
            measure(robot, bodies)

        monkeypatch.setattr(RunningRobot, "measure_wrenches", interrupted)
        with pytest.raises(KeyboardInterrupt):
            sim.step()
        assert sim.robot.data.time == pytest.approx(sim.time) and sim.robot.wrenches.any()
        np.testing.assert_array_equal(sim.robot.applied, sim.robot.wrenches)


def test_wrenches_on_what_cannot_move_are_not_iterated(load, tmp_path):
    """A cube rests on the floor of the robot's file, which has no part in the agreement; nor has a heavy base."""
    path = tmp_path / "floor.xml"
    floor = '<geom type="plane" size="1 1 .1" pos="0 0 -.5"/><geom type="box" size=".1 .1 .1" pos="5 0 0" mass="1e6"/>'
    path.write_text(PLATE.format(mass=2.0).replace("<worldbody>", f"<worldbody>{floor}"))
    scene = ts.Scene(up="z")
    scene.add_body(CUBE, STEEL, position=(0.5, 0.0, -0.4499))
    scene.add_robot(ts.Robot.load(path), iterations=20)
    with ts.Simulator(scene, dt=DT) as sim:
        steps = [sim.step() for _ in range(8)]
        assert all(step.converged and step.newton_iterations <= 5 for step in steps)
        assert sim.contact_force("robot/world")[2] == pytest.approx(-9.81, rel=1e-2)


def test_an_oscillating_coupling_is_reported(load):
    """Of a cube that is attached to a link much lighter than it is."""
    scene = ts.Scene(up="z")
    scene.add_robot(load(0.2), links=("plate",))
    scene.add_body(CUBE, STEEL, name="cube", position=(0.0, 0.0, 0.0701))
    scene.attach("cube", lambda X: X[:, 2] < -0.049, "robot/plate")
    with ts.Simulator(scene, dt=DT) as sim:
        problems = [text for _ in range(12) for text in sim.step().problems]
        assert any("forces on robot oscillate from step to step: couple with iterations=20" in text for text in problems)


def test_mujoco_is_not_imported_without_robots():
    code = """import sys, taisoft as ts
scene = ts.Scene()
scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(young=1e5, poisson=0.3))
ts.Simulator(scene, dt=0.01).step()
sys.exit('mujoco' in sys.modules)"""
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


def test_explicit_steps_are_taken_one_by_one(load):
    with ts.Simulator(resting(load()), dt=1e-4, integrator="symplectic_euler") as sim:
        assert sim.advance(8).steps == 1
        assert sim.robot.data.time == pytest.approx(sim.time)


def test_what_cannot_work_with_robots_is_refused(load):
    scene = resting(load())
    with ts.Simulator(scene, dt=DT) as sim:
        for call, text in (
            (lambda: sim.set_pose("robot/plate", (0, 0, 1)), "'robot/plate' belongs to robot 'robot'"),
            (lambda: sim.run(0.1, error=True), "error=True: the motion of robot 'robot' depends on forces"),
            (lambda: sim.robot.control["swng"], r"robot 'robot': no actuator is called 'swng' \(did you mean swing\?\)"),
            (lambda: sim.robot.link_wrench("plat"), r"no link is called 'plat' \(did you mean plate\?\)"),
        ):
            with pytest.raises(ts.TaisoftError, match=text):
                call()
        with pytest.raises(ts.SimulationError, match="no joint can be set, nor 'lift': a robot moves by"):
            sim.robot.joint["lift"] = 1.0
        with pytest.raises(ts.SceneError, match="'swing' .* not finite"):
            sim.robot.control["swing"] = np.nan
    with pytest.raises(ts.SimulationError, match="tolerance: the motion of robot 'robot' depends on forces"):
        ts.Simulator(scene, tolerance=1e-2)
    alone = ts.Scene()
    alone.add_body(CUBE, STEEL)
    with ts.Simulator(alone) as sim, pytest.raises(ts.SimulationError, match="the scene has none: call scene.add_robot"):
        sim.robot.control[:] = 0.0
