"""Long runs: a free spin of 1e5 steps, a minute at rest, a run that is stopped and goes on in another process."""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.fem.reference import lumped_mass
from taisoft.output.report import peak_memory

from .contact import on_slope, stack_scene
from .record import ANALYTIC, MEASURED, OK, PROPOSED, Case, Criterion, Must, Variant
from .session import Session
from .shapes import COR, SNH, WEIGHTLESS, cube

IMPLICIT, EXPLICIT = "implicit_euler", "symplectic_euler"


def spin(session: Session, law: str) -> dict[str, float]:
    """L1: a free cube flies and spins for 1e5 steps."""
    scene, mesh = ts.Scene(gravity=WEIGHTLESS), cube(4, 0.1)
    speed = np.cross([0.0, 0.0, 20.0], mesh.vertices) + [1.0, 0.5, 0.0]
    body = scene.add_body(mesh, ts.Material(law=law, young=1e5, poisson=0.4, density=1000.0), name="cube", velocity=speed)
    mass = lumped_mass(body)
    momenta, spins, energies = [], [], []

    def look(sim, k, report):
        x, v = sim.positions(), sim.velocities()
        arm, way = x - mass @ x / mass.sum(), v - mass @ v / mass.sum()
        momenta.append(mass @ v)
        spins.append(mass @ np.cross(arm, way))
        energies.append(sim.energies().total)

    with session.simulator(scene) as sim:
        session.go(sim, 100_000, look, every=100)

    def drift(values) -> float:
        values = np.array(values)
        return float(np.linalg.norm(values - values[0], axis=1).max() / np.linalg.norm(values[0]))

    energies = np.array(energies)
    return {
        "drift of the momentum": drift(momenta),
        "drift of the angular momentum": drift(spins),
        "drift of the energy": float(np.abs(energies / energies[0] - 1.0).max()),
    }


def rest(session: Session) -> dict[str, float]:
    """L2: a cube on a slope neither creeps nor shakes in 60 s, and costs the same all the time."""
    soft = ts.Material(law=COR, young=1e5, poisson=0.3, density=1000.0)
    with session.simulator(on_slope(cube(4, 0.1), soft, np.radians(10.0), 0.5)) as sim:
        session.go(sim, 100)
        start, fields, peak = sim.positions(), sum(sim.field_bytes.values()), peak_memory()
        ways = []
        session.go(sim, 5900, lambda sim, k, report: ways.append(np.abs(sim.positions() - start).max()))
        seconds = np.array(session.step_seconds)
        return {
            "creep after 1 s, most [m]": max(ways),
            "kinetic energy after 1 s, most [J]": max(report.kinetic for report in session.reports if report.time > 1.0),
            "growth of the fields after 1 s": sum(sim.field_bytes.values()) / fields - 1.0,
            "growth of the process's peak memory after 1 s": peak_memory() / peak - 1.0,
            "time of the last 1000 steps over that of the first": np.median(seconds[-1000:]) / np.median(seconds[:1000]),
        }


def go_on(session: Session) -> dict[str, float]:
    """L3: 200 steps of a stack at once, against 100, a checkpoint, and 100 more in another process."""
    frames = []
    with tempfile.TemporaryDirectory() as folder, session.simulator(stack_scene(None)) as sim:
        saved = Path(folder) / "checkpoint.npz"

        def look(sim, k, report):
            if k == 100:
                sim.save_checkpoint(saved)
            if k > 100:
                frames.append(np.stack([sim.positions(), sim.velocities()]))

        session.go(sim, 200, look)
        touching = session.reports[99].n_contacts
        others = frames_elsewhere(saved)
    different = [k for k, (a, b) in enumerate(zip(frames, others)) if not np.array_equal(a, b)]
    return {
        "contacts when it was stopped": float(touching),
        "frames": float(min(len(frames), len(others))),
        "frames that differ in a bit": float(len(different)),
        "largest difference [m]": np.abs(np.array(frames)[:, 0] - others[:, 0]).max() if len(frames) == len(others) else np.nan,
    }


ELSEWHERE = """
import sys
import numpy as np
from taisoft.cli.scene_file import load_shipped
np.save(sys.argv[2], load_shipped("benchmarks", "hard_cases.long_run").frames_from(sys.argv[1]))
"""


def frames_elsewhere(saved: Path) -> np.ndarray:
    """`frames_from` in a process of its own. Raises CalledProcessError where that fails."""
    frames = saved.with_name("frames.npy")
    subprocess.run([sys.executable, "-c", ELSEWHERE, saved, frames], check=True)
    return np.load(frames)


def frames_from(saved: str) -> np.ndarray:
    """(100,2,n,3) positions [m] and velocities [m/s] of the 100 steps after a checkpoint of L3."""
    with ts.Simulator.load_checkpoint(saved, stack_scene(None)) as sim:
        found = []
        for _ in range(100):
            sim.step()
            found.append(np.stack([sim.positions(), sim.velocities()]))
    return np.array(found)


SPINS = Must(OK, "a free body keeps its momenta, and symplectic steps below the limit keep its energy in bounds")
L1 = Case(
    "L1",
    "free spin, 1e5 steps",
    spin,
    tuple(
        Variant(f"{law}, {precision}", {"dt": 5.6e-4, "integrator": EXPLICIT, "precision": precision}, {"law": law}, SPINS)
        for law in (COR, SNH)
        for precision in ("f32", "f64")
    ),
    (
        Criterion("drift of the momentum", 1e-4, MEASURED, of={"precision": "f32"}),
        Criterion("drift of the angular momentum", 1e-4, MEASURED, of={"precision": "f32"}),
        Criterion("drift of the momentum", 1e-12, MEASURED, of={"precision": "f64"}),
        Criterion("drift of the angular momentum", 1e-10, MEASURED, of={"precision": "f64"}),
        Criterion("drift of the energy", 0.02, MEASURED),
    ),
    size=0.1,
)

RESTS = Must(OK, "the slope's tangent of 0.18 is below the friction of 0.5, so that the cube stays where it is")
L2 = Case(
    "L2",
    "sixty seconds at rest",
    rest,
    (Variant(COR, {"dt": 0.01, "integrator": IMPLICIT}, {}, RESTS),),
    (
        Criterion("creep after 1 s, most [m]", 1e-4, PROPOSED),
        Criterion("kinetic energy after 1 s, most [J]", 1e-8, PROPOSED),
        Criterion("growth of the fields after 1 s", 0.02, PROPOSED, cost=True),
        Criterion("growth of the process's peak memory after 1 s", 0.02, PROPOSED, cost=True),
        Criterion("time of the last 1000 steps over that of the first", 1.1, PROPOSED, cost=True),
    ),
    size=0.1,
)

GOES_ON = Must(OK, "a checkpoint holds all that the next step depends on")
L3 = Case(
    "L3",
    "stop and go on",
    go_on,
    (Variant(SNH, {"dt": 0.025, "integrator": IMPLICIT}, {}, GOES_ON, reference=False),),
    (
        Criterion("contacts when it was stopped", 1.0, ANALYTIC, at_least=True),
        Criterion("frames", 100.0, ANALYTIC, at_least=True),
        Criterion("frames that differ in a bit", 0.0, PROPOSED),
    ),
    size=5.0,
)

CASES = (L1, L2, L3)
