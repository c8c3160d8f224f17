"""Demonstrations 1 to 3 and figures 1 to 4 of the report: our demos of these scenes, each with its check of the physics.

A demo runs once with pictures at moments like those of the report's figures; its time is that of its steps, without compilation
and drawing.
"""

from dataclasses import dataclass

import taisoft as ts
from taisoft.cli.scene_file import load_module, shipped_files, shipped_folder
from taisoft.records import RunReport

from ..document import table
from .page import Claim, Extent, Part, small_png

REPORTS_HOURS, HOUR = 10.0, 3600.0  # of demonstration 3; [s]
THIRD = "sheet_and_cube"  # demonstration 3


@dataclass(frozen=True)
class Scene:
    """A demo. said: the report's description; moments [s]: of the pictures."""

    demo: str
    where: str
    said: str
    moments: tuple[float, ...]
    layers: tuple[str, ...] = ("fixed_nodes",)


SCENES = (
    Scene(
        "hanging_beam",
        "demonstration 1, figure 2",
        "a beam held at its left end falls under gravity, here from 0 to 1 s",
        (0.0, 1 / 3, 2 / 3, 1.0),
    ),
    Scene(
        "midpoint_traction",
        "demonstration 2, figure 4",
        "a beam held at both ends is bent up by a traction under its middle",
        (0.0, 0.5, 6.0),
        ("fixed_nodes", "tractions"),
    ),
    Scene(THIRD, "demonstration 3, figure 3", "a sheet held at two ends sags under a cube that lies on it", (0.0, 0.3, 0.6, 4.0)),
    Scene("bunny_ears", "figure 1, left above", "the ears of a bunny are stretched long", (0.0, 0.9, 1.1, 1.3, 2.0)),
    Scene("sheet_on_box", "figure 1, left below", "a sheet rests on top of a box", (0.0, 0.2, 0.5, 3.0)),
    Scene("hanging_cloth", "figure 1, right", "a cloth hangs from its upper corners", (0.0, 0.2, 0.4, 0.7, 4.0)),
)
QUICK = 3  # scenes of a quick run


@dataclass
class DemoRun:
    """Run of a demo. problem: failure of its check, or empty; spent: wall seconds of its steps."""

    scene: Scene
    tets: int
    settings: str
    result: RunReport
    problem: str
    picture: bytes
    spent: float


def show(scene: Scene, arch: str) -> DemoRun:
    """Run a demo with pictures and check it."""
    gallery = load_module(shipped_folder("assets") / "make_gallery.py")
    _, size, view = gallery.STRIPS[scene.demo]
    module = load_module(shipped_files("demos")[scene.demo])
    settings = dict(module.solver)
    shots = scene.moments, size, view, settings.pop("seconds"), settings.pop("fps"), scene.layers
    spent, problem = [], ""
    with ts.Simulator(module.build(), arch=arch, **settings) as sim:
        image, result = gallery.film(sim, *shots, on_step=lambda _report, took: spent.append(took))
        try:
            module.check(sim, result)
        except AssertionError as error:
            problem = str(error)
        tets = sum(body.mesh.n_tets for body in sim.scene.bodies)
        text = f"{sim.settings.integrator}, dt = {1e3 * sim.dt:.3g} ms"
    return DemoRun(scene, tets, text, result, problem, small_png(image), sum(spent))


def claim_of(shown: DemoRun) -> Claim:
    """Claim that the demo agrees with the report's."""
    check = f"its check of the physics failed: {shown.problem}" if shown.problem else "its own check of the physics passed"
    holds = shown.result.status == "ok" and not shown.problem
    return Claim(f"{shown.scene.where}: {shown.scene.said}.", holds, f"the run is {shown.result.status}; {check}.")


def hours_claim(third: DemoRun) -> Claim:
    """Claim on the ten hours of demonstration 3."""
    return Claim(
        f"demonstration 3 takes hours, about {REPORTS_HOURS:g} (section 3.1).",
        third.spent > HOUR,
        f"{third.result.sim_seconds:g} s of it take {third.spent:.2g} s of computing, {HOUR * REPORTS_HOURS / third.spent:,.0f} "
        f"times less than {REPORTS_HOURS:g} hours.",
        "The report gives neither its machine nor the simulated time; it ran interpreted Python with small explicit steps.",
    )


def demo_table(shown: list[DemoRun]) -> str:
    """A row per demo."""
    columns = (
        ("<demo", "{.scene.demo}"),
        ("<in the report", "{.scene.where}"),
        ("tets", "{.tets:,}"),
        ("<steps", "{.settings}"),
        ("simulated [s]", "{.result.sim_seconds:g}"),
        ("max. contacts", lambda s: str(max((r.n_contacts for r in s.result.step_reports), default=0))),
        ("wall s per simulated s", lambda s: f"{s.spent / s.result.sim_seconds:.3g}"),
        ("compile [s]", "{.result.compile_seconds:.1f}"),
        ("<status", "{.result.status}"),
        ("<own check", lambda s: "failed" if s.problem else "passed"),
    )
    return table(shown, columns)


def measure(extent: Extent) -> Part:
    """Run all demos of the report's scenes; a quick run has demonstrations 1 to 3."""
    shown = [show(scene, extent.arch) for scene in (SCENES[:QUICK] if extent.quick else SCENES)]
    part = Part(
        "demos",
        "The demonstrations",
        "demonstrations 1 to 3, figures 1 to 4",
        "each demo as `taisoft run` runs it, with its own check; times are of the steps alone. Meshes and materials are ours, "
        "since the report does not give its own.",
        [*map(claim_of, shown), hours_claim(next(s for s in shown if s.scene.demo == THIRD))],
        [demo_table(shown)],
        {f"{s.scene.demo}.png": s.picture for s in shown},
        short=["the report's pictures are not in its text, so ours are compared with its captions."],
    )
    part.short += [
        f"{s.scene.demo} ends {s.result.status}: {'; '.join(s.result.problems)}" for s in shown if s.result.status != "ok"
    ]
    part.short += ["a quick run leaves out figure 1."] * extent.quick
    return part
