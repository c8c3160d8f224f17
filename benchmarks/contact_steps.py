"""Measurements of `contact.py`: whole steps by kind, implicit runs of demos, and real meshes that fall to the ground."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import shipped_folder

from .contact_runs import n_tets, to_impulses
from .kinds import watching
from .runner import clock

MESHES = Path(__file__).resolve().parents[1].parent / "shared" / "meshes"  # beside the repository
DROPPED = {"bunny": "bunny.msh", "bar": "bar-2523.msh", "octocat": "octocat.msh", "Armadillo": "Armadillo13K.msh"}
HEIGHT, DT = 0.05, 0.01  # from which the meshes, 1 m large, fall [m]; their steps [s]


@dataclass
class Profile:
    """Steps from the first impulse on. whole: wall seconds of each `step` with its report; kinds: mean seconds by kind, see
    `kinds.py`, of the same steps when repeated."""

    scene: str
    integrator: str
    geometry: str
    dt: float
    whole: list[float] = field(default_factory=list)
    kinds: dict[str, float] = field(default_factory=dict)
    contacts: list[int] = field(default_factory=list)
    sweeps: list[int] = field(default_factory=list)
    residual: float = 0.0


@dataclass
class Run:
    """An implicit run: lists over its steps with contacts; wall: seconds of all steps without compilation."""

    scene: str
    tets: int
    settings: str
    status: str
    problems: list[str]
    simulated: float
    wall: float
    seconds: list[float] = field(default_factory=list)
    contacts: list[int] = field(default_factory=list)
    outer: list[int] = field(default_factory=list)
    newton: list[int] = field(default_factory=list)
    linear: list[int] = field(default_factory=list)


def measure_steps(name: str, sim: ts.Simulator, steps: int) -> Profile:
    """Steps from the first impulse on, then the same by kind."""
    found = Profile(name, sim.settings.integrator, sim.scene.bodies[0].collision, sim.dt)
    _to_contact(sim)  # compiles
    _to_contact(sim)
    for _ in range(steps):
        begin = clock()
        report = sim.step()
        found.whole.append(clock() - begin)
        found.contacts.append(report.n_contacts)
        found.sweeps.append(report.contact_iterations)
        found.residual = max(found.residual, report.contact_residual)
    _to_contact(sim)
    with watching() as spend:
        found.kinds = spend(lambda: [sim.step() for _ in range(steps)], steps).seconds
    return found


def _to_contact(sim: ts.Simulator) -> None:
    """Go from the start to the step after the first impulse."""
    sim.reset()
    to_impulses(sim)
    sim.step()


def measure_run(name: str, sim: ts.Simulator, seconds: float) -> Run:
    """Implicit steps for some seconds."""
    spent: list[float] = []
    done = sim.run(seconds, fps=None, on_step=lambda _report, took: spent.append(took))
    settings = f"{sim.settings.integrator}, dt = {1e3 * sim.dt:.3g} ms"
    run = Run(name, n_tets(sim), settings, done.status, done.problems, done.sim_seconds, done.wall_seconds)
    for report, took in zip(done.step_reports, spent):
        if report.n_contacts:
            run.seconds.append(took)
            run.contacts.append(report.n_contacts)
            run.outer.append(report.contact_iterations)
            run.newton.append(report.newton_iterations)
            run.linear.append(report.linear_iterations)
    return run


# --- real meshes --------------------------------------------------------------------------------------------------------


def real_meshes() -> dict[str, Path]:
    """Name and file of the meshes of DROPPED that are there: in assets, or in shared/meshes beside the repository."""
    folders = [folder for folder in (shipped_folder("assets"), MESHES) if folder]
    paths = {name: folder / file for folder in reversed(folders) for name, file in DROPPED.items() if (folder / file).is_file()}
    return {name: paths[name] for name in DROPPED if name in paths}


def open_drop(path: Path, arch: str) -> ts.Simulator:
    """A simulator of a real mesh, scaled to 1 m, that falls to the ground."""
    scene, mesh = ts.Scene(), ts.read_mesh(path)
    x = mesh.vertices / np.ptp(mesh.vertices, axis=0).max()
    rubber = ts.Material(young=2e5, poisson=0.4, density=1000.0, friction=0.5)
    scene.add_body(ts.TetMesh(x, mesh.tets), rubber, name="figure", position=(0.0, HEIGHT - x[:, 1].min(), 0.0))
    scene.add_ground(friction=0.5)
    return ts.Simulator(scene, dt=DT, integrator="implicit_euler", precision="f32", arch=arch)
