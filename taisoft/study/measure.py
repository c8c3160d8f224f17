"""One run of a study, in its own process: recorded once at the frames, then timed from the start without recording."""

import time

import numpy as np

from taisoft.backend import runtime
from taisoft.errors import SimulationError, TaisoftError, collected_warnings
from taisoft.fem.loads import SceneLoads
from taisoft.fem.reference import gravity_mass, lumped_mass
from taisoft.machine import PACKAGES, load_average, machine, peak_memory, usable_cores, versions
from taisoft.mesh.quality import edge_lengths
from taisoft.output.report import extremes
from taisoft.scene.scene import Scene
from taisoft.simulator import Simulator
from taisoft.study import simulator_arguments

MAX_REPEATED_SECONDS = 20.0  # a run with a longer wall time is not repeated: the recorded run gives its time
ITERATIONS = ("newton_iterations", "linear_iterations", "contact_iterations")
SHORT_SECONDS, MAX_RUNS = 0.5, 25  # short runs are repeated until their total time [s] or their number reaches these


def measure(scene: Scene, task: dict) -> dict:
    """Return the record of one run of a scene that is already refined, as plain data; a failed run's record says why.

    task: `setting`, `fixed` (further arguments of Simulator), `frame` [s], `frames`, `steps` (per frame), `repeats` (minimum
    number of timed runs, 0 for none).
    """
    setting = simulator_arguments(task["setting"])
    record = {"task": task, "machine": machine(named=True), "versions": versions(*PACKAGES)}
    record |= {"cores": usable_cores(), "load": load_average()}
    record |= _scene_facts(scene, task)
    with collected_warnings() as record["warnings"]:
        record |= _run(scene, setting | task["fixed"], task)
    return record | {"load_at_the_end": load_average(), "peak_memory_bytes": peak_memory(), "threads": runtime.threads()}


def _scene_facts(scene: Scene, task: dict) -> dict:
    """Return what is known before the run: sizes, and which conservation laws hold."""
    bodies = scene.bodies
    mass_damped = any(b.composition.first.mass_damping for b in bodies)
    damped = mass_damped or any(b.composition.first.stiffness_damping or b.composition.branches.size for b in bodies)
    damped = damped or any(one.damping for one in scene.connections)
    prescribed = any(c.path is not None for b in bodies for c in b.constraints) or any(
        o.path is not None for o in scene.obstacles
    )
    touches = scene.pushes(task["fixed"].get("self_collision", False))
    varied = any(load.path is not None for load in scene.loads) or any(not p.closed for b in bodies for p in b.pressures)
    anchored = {name for one in scene.connections for name in one.owners} - {b.name for b in bodies}
    free = not (varied or anchored or any(b.constraints for b in bodies) or mass_damped or (touches and scene.obstacles))
    return {
        "bodies": [[b.name, b.n_nodes] for b in bodies],
        "nodes": sum(b.n_nodes for b in bodies),
        "tets": sum(b.mesh.n_tets for b in bodies),
        "orders": sorted({b.order for b in bodies}),
        "smallest_edge": min(float(edge_lengths(b.mesh.vertices, b.mesh.tets).min()) for b in bodies),  # [m]
        "keeps_energy": not (damped or prescribed or scene.loads or touches),
        "momentum_rate": _total_load(scene).tolist() if free else None,  # [N]
    }


def _total_load(scene: Scene) -> np.ndarray:
    """Return the sum of weights, tractions and forces (3,) [N]."""
    return sum(gravity_mass(b).sum() for b in scene.bodies) * scene.gravity + SceneLoads(scene).at(0.0).sum(axis=0)


def _run(scene: Scene, simulator: dict, task: dict) -> dict:
    start = time.perf_counter()
    try:
        with Simulator(scene, **simulator) as sim:
            built = time.perf_counter() - start
            return {"build_seconds": built} | _record_and_time(sim, task)
    except TaisoftError as error:
        return {"status": "failed", "problems": [str(error)], "seconds": [], "path": None}


def _record_and_time(sim: Simulator, task: dict) -> dict:
    observer, length = Observer(sim), task["frame"] * task["frames"]
    result = sim.run(length, on_frame=observer.frame, fps=1.0 / task["frame"])
    reports = result.step_reports
    numbers = {
        "status": result.status,
        "problems": result.problems,
        "steps": result.steps,
        "reports": len(reports),
        "extremes": extremes(reports),
        "explicit": sim.settings.explicit,
        "dt": sim.dt,
        "unconverged": sum(not r.converged for r in reports),
        **{key: sum(getattr(r, key) for r in reports) for key in ITERATIONS},
        "seconds": [],
        "path": None,
    }
    if result.status != "failed":
        try:
            if task["repeats"]:
                numbers["seconds"] = list(_timed(sim, task, (result.wall_seconds - observer.seconds) / length))
            numbers |= observer.numbers()
        except SimulationError as error:  # a repeat may still fail, because threads change the order of sums
            return numbers | {"status": "failed", "problems": [*result.problems, f"in a repeated run: {error}"]}
    return numbers | {"compile_seconds": sim.compile_seconds}


def _timed(sim: Simulator, task: dict, recorded: float):
    """Yield wall seconds per simulated second of each timed run. recorded: those of the recorded run."""
    length = task["frame"] * task["frames"]
    if recorded * length > MAX_REPEATED_SECONDS:  # without the first launch of each kernel
        yield recorded
        return
    total, count, steps = 0.0, 0, task["steps"] * task["frames"]
    while count < task["repeats"] or (total < SHORT_SECONDS and count < MAX_RUNS):
        sim.reset()
        done, compiled, start = 0, sim.compile_seconds, time.perf_counter()
        while done < steps:  # in the largest batches, as sim.run does between two frames
            done += sim.advance(steps - done).steps
        seconds = time.perf_counter() - start - (sim.compile_seconds - compiled)
        total, count = total + seconds, count + 1
        yield seconds / length


class Observer:
    """Records positions, energies and momentum at the frames. seconds: its own wall time, without compiling."""

    def __init__(self, sim: Simulator):
        self.seconds = 0.0
        mass = lumped_mass if sim.settings.explicit else gravity_mass
        self._mass = np.concatenate([mass(body) for body in sim.scene.bodies])
        self._path, self._energies, self._momentum = [], [], []

    def frame(self, sim: Simulator, _index: int, _report) -> None:
        """Record a frame; pass to Simulator.run as on_frame."""
        compiled, start = sim.compile_seconds, time.perf_counter()
        self._path.append(sim.positions())
        e = sim.energies()
        self._energies.append((e.kinetic, e.elastic, e.gravity))
        self._momentum.append((self._mass @ sim.velocities()).tolist())
        self.seconds += time.perf_counter() - start - (sim.compile_seconds - compiled)

    def numbers(self) -> dict:
        """Return energies (k,3) [J], momentum (k,3) [kg m/s], path (k,n,3) [m]."""
        return {"energies": self._energies, "momentum": self._momentum, "path": np.array(self._path)}
