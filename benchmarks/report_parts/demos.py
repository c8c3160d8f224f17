"""Demonstrations 1 to 3 and figures 1 to 4 of the report: our demos of these scenes, each with its check of the physics.

A demo runs once with pictures at moments like those of the report's figures, and again without them for the time of its steps,
without compilation and drawing.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from types import ModuleType

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import load_module, shipped_files, shipped_folder
from taisoft.machine import Timing, summarise
from taisoft.output.tables import percent, spread_of
from taisoft.records import RunReport

from ..document import table
from .page import Claim, Extent, Part, small_png

ROUNDS = 3
REPORTS_HOURS, HOUR = 10.0, 3600.0  # of demonstration 3; [s]


@dataclass(frozen=True)
class Scene:
    """A demo. said: the report's description; moments [s]: of the pictures; number: read at each moment [m], named `what`; shows:
    whether these numbers agree with the report."""

    demo: str
    where: str
    said: str
    moments: tuple[float, ...]
    what: str
    number: Callable[[ts.Simulator], float]
    shows: Callable[[list[float]], bool]
    layers: tuple[str, ...] = ("fixed_nodes",)
    quick: bool = False


def _falls(x: list[float]) -> bool:
    return bool((np.diff(x) < 0).all())


SCENES = (
    Scene(
        "hanging_beam",
        "demonstration 1, figure 2",
        "a beam held at its left end falls under gravity, here from 0 to 1 s",
        (0.0, 1 / 3, 2 / 3, 1.0),
        "height of the free end",
        lambda sim: _at(sim, "beam", lambda X: X[:, 0] > 1.99),
        _falls,
        quick=True,
    ),
    Scene(
        "midpoint_traction",
        "demonstration 2, figure 4",
        "a beam held at both ends is bent up by a traction under its middle",
        (0.0, 0.5, 6.0),
        "height of the middle",
        lambda sim: _at(sim, "beam", lambda X: np.linalg.norm(X, axis=1) < 1e-9),
        lambda y: y[1] > 0 and y[2] > 0,
        ("fixed_nodes", "tractions"),
        quick=True,
    ),
    Scene(
        "sheet_and_cube",
        "demonstration 3, figure 3",
        "a sheet held at two ends sags under a cube that lies on it",
        (0.0, 0.3, 0.6, 4.0),
        "lowest node of the sheet",
        lambda sim: float(sim.positions("sheet")[:, 1].min()),
        lambda y: y[-1] < y[0] - 0.05,
        quick=True,
    ),
    Scene(
        "bunny_ears",
        "figure 1, left above",
        "the ears of a bunny are stretched long",
        (0.0, 0.9, 1.1, 1.3, 2.0),
        "tips of the ears",
        lambda sim: float(sim.positions("bunny")[:, 1].max()),
        lambda y: y[1] > y[0] + 0.5 > y[-1],
    ),
    Scene(
        "sheet_on_box",
        "figure 1, left below",
        "a sheet rests on top of a box",
        (0.0, 0.2, 0.5, 3.0),
        "lowest node of the sheet",
        lambda sim: float(sim.positions("sheet")[:, 1].min()),
        lambda y: 0.0 < y[-1] < 1.0,
    ),
    Scene(
        "hanging_cloth",
        "figure 1, right",
        "a cloth hangs from its upper corners",
        (0.0, 0.2, 0.4, 0.7, 4.0),
        "lowest node",
        lambda sim: float(sim.positions("cloth")[:, 1].min()),
        lambda y: y[-1] < -0.9,
    ),
)


def _at(sim: ts.Simulator, body: str, chosen: Callable[[np.ndarray], np.ndarray]) -> float:
    """Mean height [m] of nodes chosen by their rest positions."""
    return float(sim.positions(body)[chosen(sim.scene.body(body).rest_positions), 1].mean())


@dataclass
class DemoRun:
    """Run of a demo. numbers: at the moments [m]; problem: failure of its check, or empty; spent: wall seconds of the steps per
    round."""

    scene: Scene
    tets: int
    seconds: float
    settings: str
    result: RunReport
    problem: str
    numbers: list[float]
    picture: bytes
    spent: list[float] = field(default_factory=list)

    @property
    def timing(self) -> Timing:
        """Wall seconds per simulated second."""
        return summarise(s / self.seconds for s in self.spent)

    @property
    def good(self) -> bool:
        """Whether status and check are ok."""
        return self.result.status == "ok" and not self.problem


def _problem(module: ModuleType, sim: ts.Simulator, result: RunReport) -> str:
    """Failure of the demo's check, or empty."""
    try:
        module.check(sim, result)
    except AssertionError as error:
        return str(error)
    return ""


def show(scene: Scene, arch: str, rounds: int) -> DemoRun:
    """Run a demo with pictures, check it, and run it again to time it."""
    gallery = load_module(shipped_folder("assets") / "make_gallery.py")
    _, size, view = gallery.STRIPS[scene.demo]
    module = load_module(shipped_files("demos")[scene.demo])
    settings = dict(module.solver)
    seconds, fps = settings.pop("seconds"), settings.pop("fps")
    numbers: list[float] = []
    with ts.Simulator(module.build(), arch=arch, **settings) as sim:
        rounds_spent = []
        for k in range(rounds):
            steps: list[float] = []

            def on_step(_report, took, steps=steps) -> None:
                steps.append(took)

            sim.reset()
            if k == 0:
                shots = scene.moments, size, view, seconds, fps, scene.layers
                image, result = gallery.film(sim, *shots, lambda sim: numbers.append(scene.number(sim)), on_step)
                problem = _problem(module, sim, result)
            else:
                sim.run(seconds, fps=fps, on_step=on_step)
            rounds_spent.append(sum(steps))
        tets = sum(body.mesh.n_tets for body in sim.scene.bodies)
        settings_text = f"{sim.settings.integrator}, dt = {1e3 * sim.dt:.3g} ms"
    return DemoRun(scene, tets, seconds, settings_text, result, problem, numbers, small_png(image), rounds_spent)


def claim_of(shown: DemoRun) -> Claim:
    """Claim that the demo agrees with the report's."""
    s, r = shown.scene, shown.result
    heights = ", ".join(f"{y:.3f}" for y in shown.numbers)
    times = ", ".join(f"{t:.3g}" for t in s.moments)
    text = f"{s.what} {heights} m at {times} s; the run is {r.status}"
    text += "; its own check passed." if not shown.problem else f"; its check failed: {shown.problem}."
    return Claim(f"{s.where}: {s.said}.", shown.good and s.shows(shown.numbers), text)


def hours_claim(seconds: float, simulated: float) -> Claim:
    """Claim on the ten hours of demonstration 3."""
    slow = seconds > HOUR
    times = HOUR * REPORTS_HOURS / seconds
    found = f"{simulated:g} s of it take {seconds:.2g} s of computing, {times:,.0f} times less than {REPORTS_HOURS:g} hours."
    why = "The report gives neither its machine nor the simulated time; it ran interpreted Python with small explicit steps."
    return Claim(f"demonstration 3 takes hours, about {REPORTS_HOURS:g} (section 3.1).", slow, found, "" if slow else why)


def demo_table(shown: list[DemoRun]) -> str:
    """A row per demo."""
    columns = (
        ("<demo", "{.scene.demo}"),
        ("<in the report", "{.scene.where}"),
        ("tets", "{.tets:,}"),
        ("<steps", "{.settings}"),
        ("simulated [s]", "{.seconds:g}"),
        ("max. contacts", lambda s: str(max((r.n_contacts for r in s.result.step_reports), default=0))),
        ("wall s per simulated s", lambda s: f"{s.timing.median:.3g}"),
        ("spread", lambda s: percent(spread_of(s.timing))),
        ("compile [s]", "{.result.compile_seconds:.1f}"),
        ("<status", "{.result.status}"),
        ("<own check", lambda s: "failed" if s.problem else "passed"),
    )
    return table(shown, columns)


def measure(extent: Extent) -> Part:
    """Run all demos of the report's scenes; a quick run has demonstrations 1 to 3."""
    part = Part(
        "demos",
        "The demonstrations",
        "demonstrations 1 to 3, figures 1 to 4",
        "each demo as `taisoft run` runs it, with its own check; times are of the steps alone, medians over "
        f"{extent.of(ROUNDS, 1)} runs. Meshes and materials are ours, since the report does not give its own.",
    )
    shown = [show(s, extent.arch, extent.of(ROUNDS, 1)) for s in SCENES if s.quick or not extent.quick]
    part.claims = [claim_of(s) for s in shown]
    third = next(s for s in shown if s.scene.demo == "sheet_and_cube")
    part.claims.append(hours_claim(float(np.median(third.spent)), third.seconds))
    part.tables.append(demo_table(shown))
    for s in shown:
        part.pictures[f"{s.scene.demo}.png"] = s.picture
        part.times[f"{s.scene.demo}, a simulated second"] = s.timing
        part.short += [f"{s.scene.demo} ends {s.result.status}: {'; '.join(s.result.problems)}"] * (s.result.status != "ok")
    part.short.append("the report's pictures are not in its text, so ours are compared with its captions.")
    if extent.quick:
        part.short.append("a quick run leaves out figure 1.")
    return part
