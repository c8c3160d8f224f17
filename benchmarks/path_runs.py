"""Runs of `taisoft bench paths`: steps with and without the check of paths, and captured steps beside a bound per vertex."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field

import numpy as np

import taisoft as ts
from taisoft.backend.counters import counting
from taisoft.cli.scene_file import load_shipped
from taisoft.collision.candidates import TOTAL
from taisoft.collision.detector import Detection
from taisoft.dynamics.contact import ContactStep
from taisoft.dynamics.contact_paths import ContactPaths
from taisoft.scene.obstacles import Capsule, HalfSpace, Sphere

from .hard_cases.case import Session
from .hard_runs import find
from .programs import own
from .runner import patched, timed, without_warnings
from .timed_run import advance
from .works.scenes import WORKS

Made = tuple[ts.Scene, dict]  # a scene and settings of its simulator
KERNELS = CHECK, LIST = "check_paths", "list_pairs"
FIELDS = ("path_", "near_pairs", "passages")  # how the names of the check's fields start
WINDOWS = 20  # at most so many windows are tried until one has no passages
FRACTION = 0.45  # of the least distance: bound on the displacement of a vertex
BEAM = "hanging_beam"


def demo(name: str) -> Made:
    """A demo."""
    made = load_shipped("demos", name)
    return made.build(), {key: value for key, value in made.solver.items() if key not in ("seconds", "fps")}


def work(key: str, method: str, steps: int) -> Made:
    """A work of `taisoft bench peers`, with so many steps in 10 ms."""
    return own.make_scene(next(one for one in WORKS if one.key == key)), {"integrator": method, "dt": 0.01 / steps}


# name -> scene, time at which the first window may begin [s], steps of a window
COST: dict[str, tuple[Callable[[], Made], float, int]] = {
    "W3, velocity_verlet": (lambda: work("W3", "velocity_verlet", 2), 0.8, 40),
    "W3, implicit_euler": (lambda: work("W3", "implicit_euler", 1), 0.8, 20),
    "W4, velocity_verlet": (lambda: work("W4", "velocity_verlet", 19), 0.8, 100),
    "W4, implicit_euler": (lambda: work("W4", "implicit_euler", 1), 0.8, 20),
    "cube_pile": (lambda: demo("cube_pile"), 1.2, 20),
    "drop_everything": (lambda: demo("drop_everything"), 1.2, 20),
    BEAM: (lambda: demo(BEAM), 0.5, 10_000),
}
WAYS = {"cube_pile": 60, "two_cubes_two_boxes": 60, "drop_everything": 120, "S1 B, start 0": 60}  # name -> steps captured


@contextmanager
def observed(after: Callable[[ContactPaths, bool, int, float], None]) -> Iterator[None]:
    """Context that calls after(paths, whether any were found, new passages, seconds) after each check of a substep's paths."""
    plain = ContactPaths.find

    def watched(self, as_searched=False):
        before = len(self._held[0])
        found, seconds = timed(lambda: plain(self, as_searched))
        after(self, found, len(self._held[0]) - before, seconds)
        return found

    with patched(ContactPaths, "find", watched):
        yield


def unchecked():
    """Context without the check."""
    return patched(ContactPaths, "find", lambda *_, **__: False)


def pairs_checked(detection: Detection) -> int:
    """Pairs that a check looks at: near and adjacent triangles, and triangles beside spheres and capsules."""
    round_shapes = sum(isinstance(obstacle.shape, Sphere | Capsule) for obstacle in detection.scene.obstacles)
    near = detection.paths.near.count[TOTAL] if detection.has_pairs else 0
    return int(near) + len(detection.paths._rows) + round_shapes * detection.surface.n_triangles


# --- cost ---------------------------------------------------------------------------------------------------------------


@dataclass
class Cost:
    """Steps with and without the check. In the window, launches: by kernel; relisting: steps that made a new list; near: pairs
    listed, mean; passages: steps with any. same: whether all runs end in the same state; field_bytes: of the check's fields."""

    name: str
    dt: float
    steps: int
    start: float = 0.0
    contacts: int = 0
    launches: dict[str, int] = field(default_factory=dict)
    relisting: int = 0
    near: float = 0.0
    passages: int = 0
    same: bool = True
    field_bytes: int = 0
    compile_seconds: float = 0.0
    with_check: list[float] = field(default_factory=list)  # seconds a step, by round
    without: list[float] = field(default_factory=list)


def measure_cost(name: str, arch: str, rounds: int, steps: int | None = None, start: float | None = None) -> Cost:
    """Measure a scene of COST. steps: of the window; start [s]; None for the scene's own."""
    make, begins, window = COST[name]
    scene, settings = make()
    with without_warnings(), ts.Simulator(scene, arch=arch, **settings) as sim:
        cost = Cost(name, sim.dt, steps or window)
        advance(sim, max(1, round((begins if start is None else start) / sim.dt)))
        kept, ends = find_window(sim, cost), []
        for number in range(rounds + 1):  # the first one compiles
            turns = [(cost.with_check, nullcontext), (cost.without, unchecked)]
            for seconds, how in turns if number % 2 else turns[::-1]:
                with how():
                    sim._dynamics.restore(kept)
                    sim.step()  # lists anew after a restored state
                    spent = advance(sim, cost.steps).seconds / cost.steps
                ends.append(sim.positions())
                if number:
                    seconds.append(spent)
        cost.same = all(np.array_equal(one, ends[0]) for one in ends)
        cost.field_bytes = sum(size for key, size in sim.field_bytes.items() if key.startswith(FIELDS))
        cost.compile_seconds = sim.compile_seconds
    return cost


def find_window(sim: ts.Simulator, cost: Cost) -> dict:
    """Count in the first window where all steps have contacts and none passages, or the last; returns its start's snapshot."""
    contact, passing = sim._dynamics.contact, []
    for _ in range(WINDOWS):
        kept, near, contacts, cost.start, cost.relisting = sim._dynamics.snapshot(), [], [], sim.time, 0
        held = contact is not None and len(sim._dynamics.state.now.held.pairs)
        sim._dynamics.restore(kept)
        passing.clear()
        with observed(lambda paths, found, *_: passing.append(sim.step_count) if found else None):
            sim.step()
            with counting() as counts:
                for _ in range(cost.steps):
                    listed = counts.launches[LIST]
                    contacts.append(sim.step().n_contacts)
                    cost.relisting += counts.launches[LIST] > listed
                    near.append(contact.detection.paths.near.count[TOTAL] if contact and contact.detection.has_pairs else 0)
        cost.launches = {kernel: counts.launches[kernel] for kernel in KERNELS}
        cost.near, cost.contacts, cost.passages = float(np.mean(near)), contacts[-1], len(set(passing))
        if contact is None or not passing and not held and min(contacts) > 0:
            break
    return kept


# --- two ways -----------------------------------------------------------------------------------------------------------


@dataclass
class Ways:
    """Captured substeps of a scene. passing: without passages in any attempt; near: moving vertices within the margin, over all
    substeps; over: of these, beyond the bound; ratios: largest displacement over its bound, by substep; pairs, seconds: of all
    checks; bound_pairs, search_seconds, bound_seconds: of the bound, once a substep."""

    name: str
    steps: int
    dt: float = 0.0
    substeps: int = 0
    passing: int = 0
    held_back: int = 0
    passages: int = 0
    near: int = 0
    over: int = 0
    ratios: list[float] = field(default_factory=list)
    checks: int = 0
    pairs: int = 0
    seconds: float = 0.0
    bound_pairs: int = 0
    search_seconds: float = 0.0
    bound_seconds: float = 0.0


class Bounds:
    """Least distances of the surface vertices of a simulator with contacts, by ipctk."""

    def __init__(self, detection: Detection, self_collision: bool):
        import ipctk

        self._ipctk, self._shapes, t = ipctk, [o.shape for o in detection.scene.obstacles], detection.topology
        n_bodies, self.triangle = len(detection.scene.bodies), t.triangle
        self.n_soft = int(t.vertex_first[n_bodies])  #: vertices of bodies, which come first
        faces, x = np.asfortranarray(t.triangle.astype(np.int32)), np.asfortranarray(detection.surface.x.to_numpy())
        self._mesh = ipctk.CollisionMesh(x, ipctk.edges(faces), faces)
        owner = np.repeat(np.arange(len(t.vertex_first) - 1), np.diff(t.vertex_first)).clip(max=n_bodies).astype(np.int32)
        bodies_only = ipctk.make_static_obstacle_filter(self.n_soft)
        self._mesh.can_collide = bodies_only if self_collision else ipctk.make_vertex_patches_filter(owner)

    def search(self, x: np.ndarray, within: float):
        """Candidates at the positions x (v,3) within a distance [m]."""
        found = self._ipctk.Candidates()
        found.build(self._mesh, np.asfortranarray(x), within)
        return found

    def of(self, candidates, x: np.ndarray, within: float) -> np.ndarray:
        """Least distances (n_soft,) [m] of the bodies' vertices, at most `within`."""
        safe = candidates.compute_per_vertex_safe_distances(self._mesh, np.asfortranarray(x), within).reshape(-1)
        return np.minimum(safe, self._from_shapes(x, within))[: self.n_soft]

    def _from_shapes(self, x: np.ndarray, within: float) -> np.ndarray:
        """Distances (v,) from half-spaces, spheres and capsules."""
        from .judge import axis_distance  # needs ipctk

        safe = np.full(len(x), within)
        for shape in self._shapes:
            if isinstance(shape, HalfSpace):
                safe = np.minimum(safe, np.abs((x - shape.point) @ np.asarray(shape.normal)))
            elif isinstance(shape, Sphere | Capsule):
                a, b = (np.asarray(p) for p in ([shape.center] * 2 if isinstance(shape, Sphere) else (shape.a, shape.b)))
                corners, grown = x[self.triangle], shape.radius + within
                lo, hi = np.minimum(a, b) - grown, np.maximum(a, b) + grown
                near = (corners.min(axis=1) <= hi).all(axis=1) & (corners.max(axis=1) >= lo).all(axis=1)
                far = [axis_distance(a, b, one) - shape.radius for one in corners[near]]
                np.minimum.at(safe, self.triangle[near], np.array(far)[:, None])
        return safe


def capture(sim: ts.Simulator, row: Ways, steps: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Take steps; returns positions (v,3) at the start and displacements (v,3) of surface vertices for each accepted substep."""
    taken, last, passages, plain = [], [], [], ContactStep.end_substep
    detection = sim._dynamics.contact.detection

    def after(paths: ContactPaths, found: bool, new: int, seconds: float) -> None:
        row.checks, row.pairs, row.seconds = row.checks + 1, row.pairs + pairs_checked(detection), row.seconds + seconds
        row.passages += new
        passages.append(found and not paths.uncovered)
        last.append(None if found else (detection.surface.x.to_numpy(), detection.paths.fields.path.to_numpy()))

    def end_substep(self) -> None:
        plain(self)
        row.held_back += last[-1] is None
        row.passing += not any(passages)
        taken.extend(one for one in last[-1:] if one is not None)
        last.clear()
        passages.clear()

    row.dt = sim.dt
    with observed(after), patched(ContactStep, "end_substep", end_substep):
        while sim.step_count < steps:
            sim.step()
    return taken


class Captured(Exception):
    """Ends a hard case once its steps are captured."""


class CapturedSession(Session):
    """A variant of a hard case whose first steps are compared instead of watched."""

    row: Ways

    def watch(self, sim: ts.Simulator, steps: int, *read, **_) -> list[list]:
        """Compare; see Session."""
        compare(sim, self.row, min(steps, self.row.steps))
        raise Captured


def compare(sim: ts.Simulator, row: Ways, steps: int) -> None:
    """Capture steps of a simulator and compare them with the bound."""
    taken, detection = capture(sim, row, steps), sim._dynamics.contact.detection
    bounds = Bounds(detection, sim.settings.self_collision)
    row.substeps = len(taken) + row.held_back
    for x, path in taken:
        moved = np.linalg.norm(path[: bounds.n_soft], axis=1)
        within = max(detection.reach, 1.001 * moved.max() / FRACTION)  # so that nothing farther away bounds
        safe = bounds.of(bounds.search(x, within), x, within)
        near = (safe <= detection.margin) & (moved > detection.floor)
        row.near, row.over = row.near + int(near.sum()), row.over + int((moved > FRACTION * safe)[near].sum())
        row.ratios.append(float((moved / np.maximum(FRACTION * safe, np.finfo(float).tiny)).max()))
        candidates, seconds = timed(lambda x=x: bounds.search(x, 0.5 * detection.reach))
        row.search_seconds += seconds
        row.bound_seconds += timed(lambda x=x, c=candidates: bounds.of(c, x, detection.reach))[1]
        row.bound_pairs += len(candidates.fv_candidates) + len(candidates.ee_candidates)


def measure_ways(name: str, arch: str, steps: int) -> Ways:
    """Compare both ways in so many steps of a scene of WAYS."""
    row = Ways(name, steps)
    with without_warnings():
        if name.startswith("S1 "):
            session = CapturedSession(*find("S1", name.removeprefix("S1 ")), arch)
            session.row = row
            try:
                session.case.run(session, **session.variant.parameters)
            except Captured:
                return row
        scene, settings = demo(name)
        with ts.Simulator(scene, arch=arch, **settings) as sim:
            compare(sim, row, steps)
    return row
