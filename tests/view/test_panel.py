"""The window's panel, keys and mouse become commands, which change the simulation between two steps, or move the view."""

from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.output.viewpoint import FILL, Viewpoint, framed_points
from taisoft.view.window.controls import Controls, touching_pairs
from taisoft.view.window.panel import Panel, Requests, range_about
from taisoft.view.window.screen import MESSAGES, PANEL, SIZE, Screen, free_part
from taisoft.view.window.timing import Timing
from tests.output.png import decode
from tests.view.drawing import connected_scene, cubes_scene, sampled
from tests.view.fake_simulator import FakeSimulator


class Gui:
    """A panel in which sliders move to the values in `moves` and buttons in `presses` are pressed, by the part after ###.

    shown: by slider, its label and its number as GGUI prints it; ends: of the sliders.
    """

    def __init__(self, moves=None, presses=(), checks=()):
        self.moves, self.presses, self.checks, self.shown, self.ends = moves or {}, presses, checks, {}, {}

    def slider_float(self, label, value, low, high):
        text, _, name = label.partition("###")
        assert low <= value <= high, label
        self.shown[name], self.ends[name] = f"{text}: {value:.3f}", (low, high)
        return self.moves.get(name, value)

    def button(self, label):
        return label.split("###")[-1] in self.presses

    def checkbox(self, label, value):
        return not value if label in self.checks else value

    def text(self, line, **_):
        assert isinstance(line, str)


@pytest.fixture
def cubes():
    with ts.Simulator(cubes_scene(), dt=2e-3, integrator="symplectic_euler", draggable=True) as sim:
        yield sim


def state_of(controls, answered=0):
    return {"controls": controls.values(), "paused": False, "asked_speed": 1.0, "answered": answered}


@pytest.fixture
def draw(cubes):
    """A function that draws the panel with moves and presses, and returns what the sliders show and the commands."""
    colouring = SimpleNamespace(kind="body", legend=list, choose_next=lambda: None)
    requests = Requests()
    panel = Panel(["a", "b", "c"], touching_pairs(cubes), colouring, SimpleNamespace(shown={}), requests)
    controls = Controls(cubes)

    def draw(moves=None, state=None, held=False, **more):
        panel.draw(gui := Gui(moves, **more), state or state_of(controls), held)
        draw.ends = gui.ends
        return gui.shown, requests.take()

    draw.panel, draw.controls = panel, controls
    return draw


def test_sliders_become_commands_and_keep_their_values(draw, cubes):
    shown, commands = draw({"gravity": 3.0, "young of a": 150.0, "dt": 1.0, "friction": 0.9})
    expected = {
        "young of a": "E [kPa]: 100.000",
        "density of a": "rho [kg/m3]: 1000.000",
        "gravity": "g [m/s2]: 9.810",
        "dt": "dt [ms]: 2.000",
    }
    assert (expected | {"friction": "mu 0.2 to 0.5: 0.500", "pull": "drag [weights]: 10.000"}).items() <= shown.items()
    assert commands[:2] == [["set_dt", pytest.approx(1e-3)], ["set_gravity", 3.0]]
    assert commands[2:] == [["set_number", "young", ["a", "b", "c"], pytest.approx(1.5e5)], ["set_friction", None, 0.9]]
    shown, none = draw()
    assert shown["gravity"] == "g [m/s2]: 3.000" and none == [], "not yet answered"
    for name, *arguments in commands:
        getattr(draw.controls, name)(*arguments)
    draw.controls.set_gravity(2.0)
    shown, none = draw(state=state_of(draw.controls, answered=1))
    expected = {"gravity": "g [m/s2]: 2.000", "young of a": "E [kPa]: 150.000", "friction": "mu: 0.900", "dt": "dt [ms]: 1.000"}
    assert expected.items() <= shown.items() and none == []
    assert cubes.dt == pytest.approx(1e-3) and cubes.scene.gravity.tolist() == [0.0, -2.0, 0.0]
    assert all(np.allclose(body.young, 1.5e5) for body in cubes.scene.bodies)


def test_several_drags_of_a_slider_reach_values_that_are_decades_away(draw):
    """Its range moves between them, within the limits; a number that is typed is limited too."""
    for low, high, moved in ((2.0, 200.0, 200.0), (5.0, 500.0, 500.0), (10.0, 1000.0, 10.0), (1.0, 20.0, 1.0)):
        draw()
        for value in (0.5 * (low + high), moved):
            _, ((_, _, _, young),) = draw({"young of a": value}, held=True)
            assert draw.ends["young of a"] == pytest.approx((low, high)), "it stays while the mouse is down"
            assert young == pytest.approx(1e3 * value)
    shown, ((*_, young),) = draw({"young of a": -5.0})
    assert shown["young of a"] == "E [kPa]: 1.000" and young == pytest.approx(1e3)


@pytest.mark.parametrize(
    "value, limits, unit, expected",
    [
        (1 / 60, (1e-4, 0.1), "s", (5e-4, 0.05, "ms", 1e-3)),
        (1e-3, (1e-5, 1.5e-3), "s", (1.5e-5, 1.5e-3, "ms", 1e-3)),
        (2e-8, (1e-10, 0.1), "s", (5e-10, 5e-8, "us", 1e-6)),
        (2.1e11, (2e9, 2e13), "Pa", (5e9, 5e11, "GPa", 1e9)),
        (7800.0, (780.0, 78000.0), "kg/m3", (780.0, 2e4, "kg/m3", 1.0)),
        (9.81, (0.0, 29.43), "m/s2", (0.0, 29.43, "m/s2", 1.0)),
    ],
)
def test_a_slider_has_a_round_range_about_its_value_and_a_fitting_unit(value, limits, unit, expected):
    assert range_about(value, limits, unit) == pytest.approx(expected)


def test_rigid_bodies_have_no_sliders_of_material(draw):
    soft = pytest.approx((1e5, 1e5, 1e3, 1e7))
    assert Controls(FakeSimulator(connected_scene())).values()["young"] == [soft, soft, None]
    state = state_of(draw.controls)
    state["controls"] |= {what: [None, *state["controls"][what][1:]] for what in ("young", "density")}  # as if a were one
    assert draw({"young of b": 150.0}, state)[1] == [["set_number", "young", ["b", "c"], pytest.approx(1.5e5)]]
    shown, _ = draw(state=state, presses=("which",))  # from all bodies to the first one
    assert not any(name.startswith(("young", "density")) for name in shown)


def test_every_pair_shows_its_friction_and_buttons_choose_a_solver(draw, cubes):
    draw(checks=["friction of pairs"])
    shown, ((name, *arguments),) = draw({"friction 2": 0.8})
    pairs = zip(("a, b", "a, c", "a, ground", "b, c", "b, ground", "c, ground"), (0.5, 0.5, 0.2, 0.5, 0.5, 0.5))
    assert [shown[f"friction {k}"] for k in range(6)] == [f"{names}: {friction:.3f}" for names, friction in pairs]
    getattr(draw.controls, name)(*arguments)
    assert draw.controls.values()["friction"] == [0.5, 0.5, 0.8, 0.5, 0.5, 0.5]
    assert cubes.scene.contact_numbers("a", "ground")[0] == 0.8
    draw(presses=("pause", "step"), checks=["solver"])
    assert draw.panel.pressed == {"pause", "step"} and draw.panel.strength == 10.0
    state = state_of(draw.controls) | {"budget": True}
    for integrator, pressed in (("symplectic_euler", set()), ("implicit_euler", {"budget"}), ("static", set())):
        draw(presses=("budget",), state=state | {"controls": state["controls"] | {"integrator": integrator}})
        assert draw.panel.pressed == pressed, "budgets are of implicit steps in time"
    draw(presses=("integrator",))
    assert draw(presses=("use",))[1] == [["rebuild", "velocity_verlet", "auto"]] and draw.panel.pressed == set()


def test_an_explicit_dt_follows_density(cubes):
    controls, limit = Controls(cubes), cubes.stable_dt
    controls.set_dt(1.0)
    largest = cubes.dt
    assert 0.8 * limit < largest < limit
    controls.set_number("density", ["b"], 100.0)
    assert cubes.scene.body("b").mass == pytest.approx(100.0) and cubes.dt == pytest.approx(largest / np.sqrt(10), rel=1e-3)
    controls.set_number("density", ["b"], 1000.0)
    assert cubes.dt == pytest.approx(largest)
    with pytest.raises(ts.SimulationError):
        controls.set_dt(-1.0)


def test_gravity_acts_downwards_where_there_was_none():
    for up, direction in (("y", (0, -1, 0)), ("z", (0, 0, -1))):
        scene = ts.Scene(gravity=(0, 0, 0), up=up)
        scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material())
        with ts.Simulator(scene, dt=1e-3) as sim:
            Controls(sim).set_gravity(2.0)
            assert np.array_equal(sim.scene.gravity, 2.0 * np.array(direction)) and sim.scene.up == up


def test_a_drag_needs_its_beginning(cubes):
    controls = Controls(cubes)
    controls.drag([0.0, 5.0, 0.0], 10.0)
    assert cubes.dragged is None
    controls.begin_drag("b", np.array([0, 1]), np.array([0.5, 0.5]))
    controls.drag([0.0, 5.0, 0.0], 10.0)
    assert controls.values()["drag"] == (0.0, cubes.dragged.max_force) and cubes.dragged.max_force > 0.0
    assert cubes.dragged.stiffness == pytest.approx(10.0 * 1000.0 * 9.81 / np.sqrt(3.0))
    controls.release()
    assert cubes.dragged is None and controls.values()["drag"] is None


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
    assert timing.seconds_to_answer(8, 1.0) == pytest.approx(0.9), "the state has not come"
    timing.dragged(8)
    timing.dragged(9)
    timing.came({"drag_done": 7})
    assert timing.awaited(is_fast=False) == 8 and timing.seconds_to_answer(8, 1.0) == pytest.approx(1.0), "any that is new"
    assert timing.awaited(is_fast=True) == 9, "slow pictures show all"
    timing.came({"drag_done": 8})
    assert timing.seconds_to_answer(8, 1.0) == 0.0 < timing.seconds_to_answer(9, 1.0)
    measured = {"speed": 0.5, "asked_speed": 2.0, "steps_per_second": 30.0}
    speed, solver, pictures = timing.lines(measured | {"on_budget": "on budget: 3 of 9 steps, residual 0.02"})
    assert solver == "solver   on budget: 3 of 9 steps, residual 0.02"
    assert timing.lines(measured | {"on_budget": ""})[1] == "solver   within its time"
    assert speed.split() == "speed 0.50 x real time (asked: 2), 30 steps/s".split()
    assert pictures.split() == "view 50 pictures/s, drag after 80 ms".split() and timing.lines({}) == [pictures]


class FakeCanvas(Gui):
    """A canvas and its window, without a display. drawn: the camera of the last picture."""

    keys, buttons, cursor, running = (), (), (0.9, 0.1), True
    window = property(lambda self: self)
    get_gui = show = lambda self: self

    def get_window_shape(self):
        return SIZE

    def sub_window(self, *_):
        return nullcontext(self)

    def get_events(self, _):
        return [SimpleNamespace(key=key) for key in self.keys]

    def is_pressed(self, button):
        return button in self.buttons

    def get_cursor_pos(self):
        return self.cursor

    def draw(self, x, colours, camera, background, lines, shadows):
        self.drawn = camera

    def pixels(self, left, top, right, bottom):
        return np.full((bottom - top, right - left, 3), 90, np.uint8)


@pytest.fixture
def screen(cubes, monkeypatch, tmp_path):
    """The window of the cubes, its canvas, and a function that draws with keys and buttons pressed and returns the commands."""
    canvas, requests, drawn = FakeCanvas(), Requests(), sampled(cubes)
    monkeypatch.setattr("taisoft.view.window.screen.Canvas", lambda *_, **__: canvas)
    monkeypatch.chdir(tmp_path)
    shown = {"colour": "body", "layers": ("fixed_nodes",), "controls": True, "pairs": touching_pairs(cubes)}
    screen, state = Screen(drawn.scene, shown, requests), state_of(Controls(cubes)) | {"status": "", "messages": []}

    def act(keys=(), buttons=(), cursor=(0.9, 0.1)):
        canvas.keys, canvas.buttons, canvas.cursor = keys, buttons, cursor
        screen.draw(drawn, state, 0.0)
        return requests.take()

    return screen, canvas, act


def test_keys(screen, tmp_path, cubes):
    screen, canvas, act = screen
    for key, action in {ti.ui.SPACE: "pause", "s": "step", ti.ui.RIGHT: "step", "r": "reset", ti.ui.UP: "faster"}.items():
        assert act([key]) == [[action]]
    assert act([ti.ui.DOWN, "x", "?", "b"]) == [["budget"], ["slower"], ["unbound"]]
    before = dict(screen.layers.shown)
    act("wcfd")
    assert {k for k in before if screen.layers.shown[k] != before[k]} == {"contacts", "fixed_nodes", "shadows", "wires"}
    act("v")
    assert screen.colouring.kind == "stress"
    for keys in ("i", (), "i", ()):
        act(keys)
    assert decode((tmp_path / "out/window-1.png").read_bytes()).shape == (720, 1280, 3)
    assert [path.name for path in sorted((tmp_path / "out").iterdir())] == ["window-1.png", "window-2.png"]
    screen.camera = replace(screen.camera, target=np.ones(3), azimuth=70.0)
    act("h")
    expected = Viewpoint.framing(cubes.positions(), SIZE, free_part(PANEL, SIZE), azimuth=70.0, elevation=screen.camera.elevation)
    assert np.allclose(screen.camera.position, expected.position) and np.allclose(screen.camera.target, expected.target)
    assert not screen.closed
    act([ti.ui.ESCAPE])
    assert screen.closed


def test_the_panel_hides_nothing_that_is_framed(screen, cubes):
    """At the start, when the camera has moved back, and framed again in a window of another size."""
    screen, canvas, act = screen
    right_end, x, start = (PANEL[0] + PANEL[2]) * SIZE[0], cubes.positions(), screen.camera

    def across(points, size=SIZE):
        projected = screen.camera.project(points, size)
        assert projected[:, 0].min() > right_end and projected[:, 0].max() < size[0]
        assert projected[:, 1].min() > 0.0 and projected[:, 1].max() < size[1]
        return np.ptp(projected[:, :2], axis=0)

    assert across(framed_points(cubes.scene))[1] == pytest.approx(FILL * 0.96 * SIZE[1])
    assert start.project(x, SIZE)[:, 1].max() < MESSAGES[1] * SIZE[1]
    act()
    assert screen.camera == start, "the camera stays while all is in view"
    screen.camera = start.zoom(0.3)
    act()
    assert across(x)[1] > 0.85 * SIZE[1], "it has moved back"
    canvas.get_window_shape = lambda: (700, 600)
    act("h")
    assert across(x, (700, 600))[0] > 0.5 * (700 - right_end)


def test_the_mouse_moves_the_view(screen):
    screen, canvas, act = screen
    start = screen.camera

    def drag(button, begin=(0.9, 0.1), by=(0.05, 0.1)):
        """The camera after a drag from the place `begin`; it is put back."""
        screen.camera = start
        act(buttons=[button], cursor=begin)
        act(buttons=[button], cursor=(begin[0] + by[0], begin[1] + by[1]))
        assert screen.dragging
        act()
        assert not screen.dragging and canvas.drawn is screen.camera
        return screen.camera

    turned = drag(ti.ui.LMB)
    assert turned.azimuth < start.azimuth - 5 and turned.elevation < start.elevation - 5, "the near side follows the cursor"
    assert turned.distance == start.distance and np.array_equal(turned.target, start.target)
    near, far = drag(ti.ui.RMB), drag(ti.ui.RMB, by=(0.0, -0.1))
    assert near.distance < 0.9 * start.distance and near.distance * far.distance == pytest.approx(start.distance**2)
    moved = np.diff([camera.project(start.target[None], SIZE)[0, :2] for camera in (start, drag(ti.ui.MMB))], axis=0)[0]
    assert moved == pytest.approx((0.05 * SIZE[0], -0.1 * SIZE[1])), "what is under the cursor stays under it"
    assert drag(ti.ui.LMB, begin=(0.1, 0.5)) == start, "on the panel"


def test_the_mouse_drags_a_body(screen, cubes):
    screen, canvas, act = screen
    x, camera = cubes.positions("b"), screen.camera
    across, down, _ = camera.project(x.mean(axis=0)[None], SIZE)[0]
    at = (across / SIZE[0], 1 - down / SIZE[1])
    (name, body, nodes, weights), (second, target, strength) = act(buttons=[ti.ui.LMB], cursor=at)
    assert (name, body, second, strength) == ("begin_drag", "b", "drag", 10.0)
    assert np.allclose(weights @ x[nodes], target)
    ((name, moved, _),) = act(buttons=[ti.ui.LMB], cursor=(at[0], at[1] + 0.1))
    assert name == "drag" and (np.array(moved) - target) @ camera.axes[1] > 0.1 and screen.camera == camera
    assert act() == [["release"]]
    assert act(buttons=[ti.ui.LMB, ti.ui.CTRL], cursor=at) == [] and screen.dragging, "with Ctrl the view turns"
