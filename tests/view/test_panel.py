"""The window's panel and what it changes:

* sliders and buttons become commands, of which the last counts; a slider keeps its value until the simulation has answered;
* labels show values in SI units, and the friction in use of every pair;
* the commands change the simulation between two steps: a lighter body lowers an explicit dt, which returns with its weight.
"""

from types import SimpleNamespace

import numpy as np
import pytest

import taisoft as ts
from taisoft.view.controls import Controls, touching_pairs
from taisoft.view.panel import Panel, Requests
from taisoft.view.plots import PlotChoice
from taisoft.view.timing import Timing
from tests.dynamics.scenes import rubber


class Gui:
    """A panel in which sliders move to the values in `moves` and buttons in `presses` are pressed, by the part after ###."""

    def __init__(self, moves=None, presses=(), checks=()):
        self.moves, self.presses, self.checks, self.labels, self.texts = moves or {}, presses, checks, {}, []

    def slider_float(self, label, value, low, high):
        shown, _, name = label.partition("###")
        assert low <= value <= high, label
        self.labels[name] = shown
        return self.moves.get(name, value)

    def button(self, label):
        return label.split("###")[-1] in self.presses

    def checkbox(self, label, value):
        return not value if label in self.checks else value

    def text(self, line, **_):
        self.texts.append(line)


def three_cubes(**settings):
    scene = ts.Scene()
    for k, name in enumerate("abc"):
        scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), rubber(friction=0.5), name=name, position=(0, 2.0 * k, 0))
    scene.add_obstacle(ts.HalfSpace((0, -1, 0), (0, 1, 0)), name="ground", friction=0.5)
    scene.set_contact("a", "ground", friction=0.2)
    return ts.Simulator(scene, draggable=True, **settings)


@pytest.fixture
def cubes():
    with three_cubes(dt=0.01) as sim:
        yield sim


def panel_of(sim):
    colouring = SimpleNamespace(kind="body", legend=list, choose_next=lambda: None)
    layers = SimpleNamespace(shown={"wires": False})
    plots = PlotChoice(None, {"implicit": True, "contact": True, "error": False})
    requests = Requests()
    return Panel(["a", "b", "c"], touching_pairs(sim), colouring, layers, plots, requests), requests


def state_of(controls, answered=0):
    return {"controls": controls.values(), "paused": False, "asked_speed": 1.0, "answered": answered}


def test_later_commands_replace_earlier_ones_with_the_same_key():
    requests = Requests()
    assert requests.take() == [] and requests.number == 0
    for command in (("pause",), ("drag", 1), ("pause",), ("drag", 2)):
        requests.add(*command, key=command[0] if command[0] == "drag" else None)
    assert requests.next_number == 1
    assert requests.take() == [["pause"], ["pause"], ["drag", 2]] and requests.number == 1 and requests.take() == []


def test_sliders_become_commands_and_keep_their_values(cubes):
    sim = cubes
    controls = Controls(sim)
    panel, requests = panel_of(sim)
    gui = Gui({"gravity": 3.0, "young": 6.0, "dt": -3.0, "friction": 0.9})
    panel.draw(gui, state_of(controls), False)
    assert gui.labels["young"] == "E 1e+05 Pa" and gui.labels["density"] == "rho 1000 kg/m3"
    assert gui.labels["gravity"] == "g 9.81 m/s2" and gui.labels["friction"] == "mu 0.20-0.50"
    commands = {command[0]: command[1:] for command in requests.take()}
    assert commands["set_gravity"] == [3.0] and commands["set_dt"] == [pytest.approx(1e-3)]
    assert commands["set_number"] == ["young", ["a", "b", "c"], pytest.approx(1.0)]
    assert commands["set_friction"] == [None, 0.9]
    gui = Gui()
    panel.draw(gui, state_of(controls), False)
    assert gui.labels["gravity"] == "g 3 m/s2" and requests.take() == [], "not yet answered"
    for name, arguments in commands.items():
        getattr(controls, name)(*arguments)
    gui = Gui()
    panel.draw(gui, state_of(controls, answered=1), False)
    assert gui.labels["gravity"] == "g 3 m/s2" and gui.labels["young"] == "E 1e+06 Pa" and requests.take() == []
    assert gui.labels["friction"] == "mu 0.90" and gui.labels["dt"] == "dt 0.001 s"
    assert sim.dt == pytest.approx(1e-3) and sim.scene.gravity.tolist() == [0.0, -3.0, 0.0]
    assert all(np.allclose(body.young, 1e6) for body in sim.scene.bodies)


def test_rigid_bodies_have_no_sliders_of_material():
    scene = ts.Scene()
    scene.contact_forces = False
    for k, name in enumerate("ab"):
        scene.add_rigid_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), name=name, position=(2 * k, 0, 0))
    scene.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), ts.Material(young=1e5), name="c", position=(4, 0, 0))
    with ts.Simulator(scene, dt=0.01) as sim:
        controls, (panel, requests) = Controls(sim), panel_of(sim)
        gui = Gui({"young": 6.0})
        panel.draw(gui, state_of(controls), False)
        assert gui.labels["young"] == "E 1e+05 Pa"
        ((name, *arguments),) = requests.take()
        assert (name, arguments) == ("set_number", ["young", ["c"], pytest.approx(1.0)])
        getattr(controls, name)(*arguments)
        assert sim.scene.body("c").young == pytest.approx(1e6)
        gui = Gui(presses=("which",))  # from all bodies to the first one
        panel.draw(gui, state_of(controls), False)
        assert "young" not in gui.labels and "density" not in gui.labels


def test_every_pair_shows_its_friction(cubes):
    sim = cubes
    controls, (panel, requests) = Controls(sim), panel_of(sim)
    panel.draw(Gui(checks=["friction of pairs"]), state_of(controls), False)
    gui = Gui({"friction 2": 0.8})
    panel.draw(gui, state_of(controls), False)
    shown = [gui.labels[f"friction {k}"] for k in range(6)]
    assert shown == ["0.50 a, b", "0.50 a, c", "0.20 a, ground", "0.50 b, c", "0.50 b, ground", "0.50 c, ground"]
    ((name, *arguments),) = requests.take()
    getattr(controls, name)(*arguments)
    assert sim.scene.contact_numbers("a", "ground")[0] == 0.8 and sim.scene.contact_numbers("b", "ground")[0] == 0.5
    assert controls.values()["friction"] == [0.5, 0.5, 0.8, 0.5, 0.5, 0.5]


def test_buttons_and_the_choice_of_a_solver(cubes):
    sim = cubes
    controls, (panel, requests) = Controls(sim), panel_of(sim)
    panel.draw(Gui(presses=("pause", "record"), checks=["solver"]), state_of(controls), False)
    assert panel.pressed == {"pause", "record"} and panel.strength == 10.0
    panel.draw(Gui(presses=("integrator",)), state_of(controls), False)
    panel.draw(Gui(presses=("use",)), state_of(controls), False)
    assert requests.take() == [["rebuild", "bdf2", "auto"]] and panel.pressed == set()


def test_an_explicit_dt_follows_density():
    with three_cubes(integrator="symplectic_euler", dt=2e-3) as sim:
        controls, limit = Controls(sim), sim.stable_dt
        assert limit > 2e-3
        controls.set_dt(1.0)
        largest = sim.dt
        assert 0.8 * limit < largest < limit
        controls.set_number("density", ["b"], -1.0)
        assert sim.scene.body("b").mass == pytest.approx(100.0) and sim.dt == pytest.approx(largest / np.sqrt(10), rel=1e-3)
        controls.set_number("density", ["b"], 0.0)
        assert sim.dt == pytest.approx(largest)
        with pytest.raises(ts.SimulationError):
            controls.set_dt(-1.0)


def test_a_drag_needs_its_beginning(cubes):
    sim = cubes
    controls = Controls(sim)
    controls.drag([0.0, 5.0, 0.0], 10.0)
    assert sim.dragged is None
    controls.begin_drag("b", np.array([0, 1]), np.array([0.5, 0.5]))
    controls.drag([0.0, 5.0, 0.0], 10.0)
    sim.step()
    force, highest = controls.values()["drag"]
    assert 0.0 < force <= 1.000001 * highest and sim.dragged.stiffness == pytest.approx(10.0 * 1000.0 * 9.81 / np.sqrt(3.0))
    controls.release()
    assert sim.dragged is None and controls.values()["drag"] is None


def test_latency_counts_from_the_last_look_that_saw_nothing(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    timing = Timing()
    for k in range(1, 11):  # pictures every 20 ms; the mouse moves before the fifth, a state with its effect comes for the eighth
        now[0] = 0.02 * k
        timing.shown({"drag_done": 7 if k >= 8 else 6})
        if k == 5:
            timing.dragged(7)
            timing.dragged(7)
        timing.polled()
    assert list(timing.latencies) == [pytest.approx(0.02 * (8 - 4))]
    assert timing.pictures_per_second() == pytest.approx(50.0)
    assert timing.seconds_to_answer(1.0) == pytest.approx(0.9), "the state has not come"
    state = {"speed": 0.5, "asked_speed": 2.0, "steps_per_second": 30.0}
    assert timing.lines(state)[0].split() == "speed 0.50 x real time (asked: 2), 30 steps/s".split()
    assert "drag after 80 ms" in timing.lines({})[0] and len(timing.lines({})) == 1
