"""The live window, partly on a virtual display:

* the cursor picks the nearest surface that is drawn, skins too; the drag patch around it has weights of sum 1;
* wires, contacts and arrows have the right places;
* keys pause, step, restart, colour, frame and quit; dragging beside bodies turns the view, dragging a body moves it;
* choosing another integrator continues the run with it; plots can be shown, and a drag over them turns the view;
* sliders change the run at once without compiling; a stiffer body lowers dt of explicit steps;
* pictures are written and recorded; the window can be resized, made tiny, and closed in the middle of a drag;
* while a step takes long, the view turns.
"""

import struct

import numpy as np
import pytest

import taisoft as ts
from taisoft.output.camera import Camera
from taisoft.view.connection_layer import ConnectionMarks
from taisoft.view.mirror import MirrorSimulation, describe_scene, describe_state
from taisoft.view.picking import MouseDrag, nearest_hit, pick
from taisoft.view.scene_view import Layers, scene_size
from tests.view.desktop import ROOT, TOOLS, Desktop
from tests.view.fake_simulator import RUBBER, FakeSimulator, beam_scene
from tests.view.test_view import body_mask, needs_vulkan

WATCH = """
import os, sys, time
sys.path[:0] = [{root!r} + "/tests", {root!r}]
os.chdir({folder!r})
from tests.view.fake_simulator import beam_scene
import numpy as np
import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.view.window import show


class PrintingSimulator(ts.Simulator):
    def advance(self, n):
        begin = time.perf_counter()
        report = super().advance(n)
        time.sleep(max(0.0, begin + {step} - time.perf_counter()))
        x, body = self.positions()[-14], self.scene.bodies[0]
        numbers = self.dt, body.material.young, -self.scene.gravity[1], compile_clock()
        print("step", self.step_count, *x.round(4), *numbers, flush=True)
        return report

    def rebuild(self, **changes):
        before = self.positions(), self.velocities(), self.time
        super().rebuild(**changes)
        same = all(np.array_equal(a, b) for a, b in zip(before, (self.positions(), self.velocities(), self.time)))
        print("rebuilt", self.settings.integrator, self.step_count, "same" if same else "other", flush=True)

    def reset(self):
        super().reset()
        print("reset", flush=True)


with PrintingSimulator(beam_scene(), dt={dt}, integrator={integrator!r}, draggable=True) as sim:
    show(sim, fps=None)
    print("ended", sim.settings.integrator, sim.step_count, np.isfinite(sim.energies().total))
print("closed")
"""
SLIDERS = {"dt": 285, "gravity": 308, "young": 331}  # pixels from the top, with one body
SOLVER, INTEGRATOR, USE = 491, 514, 537  # with a legend: the solver section, its integrator button, and its apply button
RIGHT = 430  # of the panel
TIP = (965, 350)  # initial pixel of the beam's end


# --- picking ---


def test_ray_hits_the_nearest_triangle():
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2], [1, 0, 2], [0, 1, 2]])
    triangles = np.array([[3, 4, 5], [0, 2, 1]])
    ray = np.array([0.0, 0, 1])
    t, weights = nearest_hit(np.array([0.2, 0.3, -1]), ray, x, triangles)
    assert t == 1 and np.allclose(weights @ x[triangles[t]], (0.2, 0.3, 0))
    t, weights = nearest_hit(np.array([0.2, 0.3, 1]), ray, x, triangles)
    assert t == 0 and np.allclose(weights, (0.5, 0.2, 0.3))
    assert nearest_hit(np.array([0.2, 0.3, 3]), ray, x, triangles) is None
    assert nearest_hit(np.array([0.9, 0.3, -1]), ray, x, triangles) is None


@pytest.mark.parametrize("order", [1, 2])
def test_cursor_picks_and_drags_a_body(order):
    scene = beam_scene(("one", "two"), order=order)
    sim, camera, size = FakeSimulator(scene), Camera.framing(np.array([[-2.0, -1, -1], [2, 2, 1]])), (1600, 900)
    sim.time = 1.0
    centres = sim.positions("two")[scene.bodies[1].nodes.surface].mean(axis=1)
    point = centres[np.argmin(np.linalg.norm(centres - camera.position, axis=1))]  # of a visible triangle
    across, down, _ = camera.project(point[None], size)[0]
    cursor = (across / size[0], 1 - down / size[1])
    hit = pick(sim, camera, cursor, size)
    assert scene.bodies[hit.body].name == "two" and np.allclose(hit.point, point) and np.allclose(hit.weights, 1 / 3)
    drag = MouseDrag(sim, hit)
    assert drag.body == "two" and drag.weights.sum() == pytest.approx(1.0) and len(drag.nodes) >= 3
    target = drag.target
    assert np.allclose(target, drag.weights @ sim.positions("two")[drag.nodes]), "without motion there is no force"
    drag.move(camera, cursor, size)
    assert np.allclose(drag.target, target)
    assert drag.move(camera, (cursor[0], cursor[1] + 0.1), size)
    assert not drag.move(camera, (cursor[0], cursor[1] + 0.1), size)
    moved = drag.target - target
    assert moved @ camera.axes[0] == pytest.approx(0, abs=1e-9) and moved @ camera.forward == pytest.approx(0, abs=1e-9)
    assert moved @ camera.axes[1] > 0
    assert np.allclose(drag.line(sim), [point, point + moved])
    assert pick(sim, camera, (0.01, 0.99), size) is None


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("cells, size", [(2, 1.0), (12, 1.0), (1, 0.8)])  # the tets of the last one do not hold all of the skin
def test_cursor_picks_and_drags_a_skin(order, cells, size):
    """Of a ball in a cube of tets, deformed, as the mirror in the window's process sees it."""
    scene, ball = ts.Scene(), ts.ball_mesh(0.45, 4)
    body = scene.add_body(ts.box_mesh((cells,) * 3, (size,) * 3), RUBBER, name="cube", position=(3, 0, 0), order=order)
    used, triangles = np.unique(ball.surface, return_inverse=True)
    skin = body.embed(ts.SurfaceMesh(ball.vertices[used], triangles.reshape(-1, 3)))
    real, marks, window = FakeSimulator(scene), ConnectionMarks(scene, scene_size(scene)), (900, 900)
    real.time = 1.0
    sim, camera = MirrorSimulation(describe_scene(scene, marks), body.n_nodes), Camera.framing(real.positions())
    sim.take(describe_state(real, marks, set(), None) | {"colour": "body"}, real.positions(), np.zeros(body.n_nodes))
    x = real.positions()
    centres = (skin.weights @ x)[skin.surface.triangles].mean(axis=1)
    point = centres[np.argmin(np.linalg.norm(centres - camera.position, axis=1))]
    across, down, _ = camera.project(point[None], window)[0]
    hit = pick(sim, camera, (across / window[0], 1 - down / window[1]), window)
    assert np.allclose(hit.point, point) and np.allclose(hit.weights @ x[hit.nodes], point) and len(hit.nodes) > 3
    drag = MouseDrag(sim, hit)
    assert drag.weights.sum() == pytest.approx(1.0) and (drag.weights > 0.0).all()
    assert np.linalg.norm(drag.weights @ body.rest_positions[drag.nodes] - hit.weights @ body.rest_positions[hit.nodes]) < 0.2
    assert np.allclose(drag.line(sim)[0], point), "the line begins at the point under the cursor"
    inside = 0.98 * x + 0.02 * x.mean(axis=0)
    across, down, _ = camera.project(inside[[np.argmax(inside @ camera.axes[0])]], window)[0]
    assert pick(sim, camera, (across / window[0], 1 - down / window[1]), window) is None, "only a corner of the tets is there"


# --- layers ---


def test_lines_of_layers():
    scene = beam_scene()
    scene.bodies[0].add_traction(lambda c: c[:, 0] > 1.99, (0, 0, 50.0))
    sim, layers, camera = FakeSimulator(scene), Layers(scene), Camera.framing(scene.bodies[0].rest_positions)
    contacts = sim.contacts()
    contacts.point, contacts.normal = np.array([[0.0, 1, 0]]), np.array([[0.0, 1, 0]])
    sim.contacts = lambda: contacts
    faces = len(scene.bodies[0].mesh.surface)
    loaded = 2 * 2 * 2  # triangles of the end
    counts = {"wires": 3 * faces // 2, "contacts": 2, "tractions": 3 * loaded, "fixed_nodes": 0}
    for name, count in counts.items():
        layers.shown = {other: other == name for other in layers.shown}
        ends, colours = layers.lines(sim, camera)
        assert len(ends) == len(colours) == 2 * count <= 2 * layers.n_segments
        if name == "wires":
            x, size = sim.positions(), (200, 100)
            nodes, drawn = camera.project(x, size), camera.project(ends, size)
            gaps = np.linalg.norm(drawn[:, None, :2] - nodes[None, :, :2], axis=2).min(axis=1)
            assert gaps.max() < 1e-9, "wires end at nodes"
        if name == "contacts":
            a, b, _, c = (ends - camera.position) / 0.1 + camera.position
            assert np.allclose(a, contacts.point) and np.allclose((b - a) / np.linalg.norm(b - a), contacts.normal)
            assert np.allclose(np.cross(c - a, contacts.impulse[0]), 0, atol=1e-12)


# --- the window ---


@pytest.fixture
def opened(tmp_path):
    if TOOLS:
        pytest.skip(f"a virtual display needs {', '.join(TOOLS)} (Debian: xvfb, xdotool, imagemagick)")
    made = []

    def start(dt=1 / 60, integrator="implicit_euler", step=0.0):
        code = WATCH.format(root=str(ROOT), folder=str(tmp_path), dt=dt, integrator=integrator, step=step)
        desktop = Desktop(tmp_path, code)
        made.append(desktop)
        desktop.wait_for(lambda: steps(desktop) >= 2, "running simulation")
        desktop.tool("xdotool", "search", "--sync", "--name", "taisoft", "windowmove", "0", "0", "windowfocus")
        return desktop

    yield start
    for desktop in made:
        desktop.close()


def steps(desktop):
    return int((desktop.last("step") or [0, 0])[1])


def press(desktop, key, condition, what):
    desktop.tool("xdotool", "key", key)
    desktop.wait_for(condition, what)


def is_paused(desktop):
    before = steps(desktop)
    desktop.pause(0.4)
    return steps(desktop) == before


def quit_window(desktop):
    desktop.tool("xdotool", "key", "Escape")
    assert desktop.child.wait(timeout=30) == 0
    assert desktop.printed()[-1] == "closed"


@needs_vulkan
def test_keys_and_mouse(opened, tmp_path):
    desktop = opened()
    press(desktop, "space", lambda: is_paused(desktop), "pause")
    for k, key in enumerate(("s", "Right")):
        before = steps(desktop)
        press(desktop, key, lambda at=before: steps(desktop) == at + 1, f"single step {k}")
    screen = desktop.picture()
    mask = body_mask(screen[:, RIGHT:])  # right of the panel
    assert mask.mean() > 0.05, "the beam is visible"
    assert (screen[60:160, 30:300] > 200).any(), "the panel's text is visible"
    desktop.tool("xdotool", "key", "v")
    desktop.wait_for(lambda: np.abs(desktop.picture()[:, RIGHT:].astype(int) - screen[:, RIGHT:]).max() > 60, "change of colours")

    def turn():
        desktop.drag((1000, 650), (-150, 50), 0.3)
        desktop.tool("xdotool", "mouseup", "1")

    desktop.repeat(turn, lambda: np.mean(body_mask(desktop.picture()[:, RIGHT:]) != mask) > 0.02, "turned view")
    assert is_paused(desktop)
    plain = desktop.picture()
    desktop.tool("xdotool", "key", "w")
    desktop.wait_for(
        lambda: np.mean((plain[:, RIGHT:] > desktop.picture()[:, RIGHT:].astype(int) + 40).any(axis=2)) > 0.003, "wires"
    )
    press(desktop, "i", lambda: (tmp_path / "out/window-1.png").is_file(), "picture")
    press(desktop, "p", lambda: len(list(tmp_path.glob("out/window-2/*.png"))) > 1, "recorded pictures")
    desktop.tool("xdotool", "key", "p")
    assert struct.unpack(">II", (tmp_path / "out/window-2/00000.png").read_bytes()[16:24]) == (1280, 720)
    press(desktop, "g", lambda: n_plots(desktop) == 4, "plots")
    view = desktop.picture()[400:, RIGHT:1000]
    desktop.drag((1150, 100), (-100, 50), 0.3)
    desktop.wait_for(lambda: n_plots(desktop) == 0, "view without plots while it is turned over them")
    assert np.mean(body_mask(desktop.picture()[400:, RIGHT:1000]) != body_mask(view)) > 0.01, "the view turned"
    desktop.tool("xdotool", "mouseup", "1")
    desktop.wait_for(lambda: n_plots(desktop) == 4, "plots again")
    press(desktop, "g", lambda: n_plots(desktop) == 0, "no plots")
    near = body_mask(desktop.picture()[:, RIGHT:]).mean()

    def zoom_out():
        desktop.drag((1000, 400), (0, 200), 0.3, button=3)
        desktop.tool("xdotool", "mouseup", "3")

    desktop.repeat(zoom_out, lambda: body_mask(desktop.picture()[:, RIGHT:]).mean() < 0.1 * near, "distant beam")
    press(desktop, "h", lambda: body_mask(desktop.picture()[:, RIGHT:]).mean() > 0.25 * near, "framed beam")
    press(desktop, "r", lambda: desktop.printed().count("reset") == 1, "restart")
    press(desktop, "space", lambda: not is_paused(desktop), "resumed run")
    choose_the_next_integrator(desktop)
    for width, height in ((800, 600), (1, 1), (1000, 700)):
        desktop.tool("xdotool", "search", "--name", "taisoft", "windowsize", str(width), str(height))
        before = steps(desktop)
        desktop.wait_for(lambda at=before: steps(desktop) > at + 2, f"steps in a window of {width} x {height}")
    desktop.wait_for(lambda: body_mask(desktop.picture()[:, RIGHT:]).mean() > 0.03, "beam in a resized window")
    quit_window(desktop)
    assert desktop.last("ended")[1] == "bdf2" and desktop.last("ended")[3] == "True"


def n_plots(desktop):
    """Number of plots at the right: dark text windows at least three lines high, beside light boxes."""
    screen = desktop.picture()[:720]
    dark = np.flatnonzero((screen[:, 1030:1038] < 60).all(axis=(1, 2)))
    tall = [run for run in np.split(dark, np.flatnonzero(np.diff(dark) > 1) + 1) if len(run) > 40]
    return sum((screen[run, 1046:1260] > 225).all(axis=2).mean() > 0.5 for run in tall)


def choose_the_next_integrator(desktop):
    """Open the solver section of the panel and choose bdf2, which follows implicit_euler; the run continues."""
    desktop.repeat(lambda: hold(desktop, 32, SOLVER), lambda: bright(desktop, INTEGRATOR), "section of the solver")
    desktop.repeat(lambda: hold(desktop, 60, INTEGRATOR), lambda: bright(desktop, USE), "button that applies the choice")
    desktop.repeat(lambda: hold(desktop, 60, USE), lambda: desktop.last("rebuilt"), "other integrator")
    _, name, count, same = desktop.last("rebuilt")
    assert name == "bdf2" and same == "same"
    desktop.wait_for(lambda: steps(desktop) > int(count) + 2, "steps after the rebuild")


def bright(desktop, height):
    """Whether the panel has a button at that height."""
    return (desktop.picture()[height - 8 : height + 8, 24:140, 2] > 90).mean() > 0.5


def hold(desktop, across, down):
    """Click for long enough to be noticed between slow pictures."""
    desktop.tool("xdotool", "mousemove", str(across), str(down), "mousedown", "1")
    desktop.pause(0.4)
    desktop.tool("xdotool", "mouseup", "1")
    desktop.pause(0.4)


def numbers(desktop):
    """x, y, z of the beam's end, dt, Young's modulus, gravity, seconds of compiling."""
    return [float(word) for word in desktop.last("step")[2:]]


def click(desktop, across, down):
    desktop.tool("xdotool", "mousemove", str(across), str(down), "click", "1")


@needs_vulkan
def test_dragging_and_sliders(opened):
    desktop = opened(dt=8e-3, integrator="symplectic_euler")
    compiled = numbers(desktop)[-1]
    press(desktop, "r", lambda: desktop.printed().count("reset") == 1, "restart")
    before = numbers(desktop)
    desktop.repeat(lambda: click(desktop, 30, SLIDERS["gravity"]), lambda: numbers(desktop)[5] < 5.0, "less gravity")

    def drag():
        desktop.tool("xdotool", "mouseup", "1")
        desktop.drag(TIP, (0, -250), 0.5)

    desktop.repeat(drag, lambda: numbers(desktop)[1] > before[1] + 0.3, "dragged beam")
    desktop.tool("xdotool", "mouseup", "1")
    desktop.wait_for(lambda: numbers(desktop)[1] < before[1] + 0.2, "beam that springs back")
    desktop.repeat(lambda: click(desktop, 262, SLIDERS["young"]), lambda: numbers(desktop)[4] > 2e6, "stiffer beam")
    stiff = numbers(desktop)
    assert stiff[3] < 4e-3, "below the explicit limit"
    desktop.repeat(lambda: click(desktop, 60, SLIDERS["dt"]), lambda: numbers(desktop)[3] < 0.5 * stiff[3], "shorter steps")
    assert numbers(desktop)[-1] == compiled, "nothing is compiled"
    desktop.drag((640, 650), (0, -20))  # closed while a button is pressed
    quit_window(desktop)


@needs_vulkan
def test_the_view_turns_during_a_step(opened):
    desktop = opened(step=4.0)
    before = steps(desktop)
    desktop.wait_for(lambda: steps(desktop) > before, "beginning of a step")
    begun, mask = steps(desktop), body_mask(desktop.picture()[:, RIGHT:])
    desktop.drag((1000, 650), (-150, 50), 0.2)
    assert np.mean(body_mask(desktop.picture()[:, RIGHT:]) != mask) > 0.02, "turned view"
    assert steps(desktop) == begun, "during the same step"
    quit_window(desktop)
