"""One configuration of `collision.py`: its model and its search for contacts, whose parts can be run alone.

Phases are kinds of `kinds.py`. The quadratic reduction is the older code's, compiled.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import taichi as ti

from taisoft.backend import parallel
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import Runtime, kernel
from taisoft.collision import surface
from taisoft.collision.bvh import Bvh
from taisoft.collision.candidates import Buffer, Pairs, entries, fill, list_pairs, pair_entries
from taisoft.collision.detector import MERGED, Detection
from taisoft.collision.reduction import FOUND, KEPT, LEFT, UNKNOWN, is_same
from taisoft.collision.spatial_hash import SpatialHash
from taisoft.fem.build import build_model
from taisoft.scene.plan import make_plan

from .collision_cases import FPS, Setup, start
from .kinds import BOXES, CANDIDATES, POINTS, REDUCTION, Spent
from .runner import REST, patched

PHASES = (BOXES, CANDIDATES, POINTS, REDUCTION)
HASH, TREES = "spatial_hash", ("bvh 6", "bvh 14", "bvh 18")
DT = 1 / FPS
NEAR = Pairs()  # a visitor of all near pairs


def phases_of(spent: Spent) -> dict[str, float]:
    """Seconds of each phase of a search, and of the rest: launches, the host, and what else is measured of contacts."""
    found = {name: spent.seconds.get(name, 0.0) for name in PHASES}
    return found | {REST: sum(spent.seconds.values()) - sum(found.values())}


# --- the quadratic reduction ---------------------------------------------------------------------------------------------


@kernel
def reduce_by_pairs(
    r: ti.template(), out: ti.template(), order: ti.types.ndarray(), state: ti.template(), kept: ti.template(), tolerance: ti.f64
):
    """Two nested loops over the contacts of a search: a contact is kept unless an earlier kept one is the same."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        n = 0
        for i in range(r.count[FOUND]):
            at = order[i]
            state[i] = KEPT
            j = 0
            while j < n and state[i] == KEPT:
                if is_same(out, at, kept[j], tolerance):
                    state[i] = UNKNOWN
                j += 1
            if state[i] == KEPT:
                kept[n] = at
                n += 1
        state[r.count[FOUND]] = n


class Quadratic:
    """Reduction of a detection's last search by two nested loops; a context manager."""

    def __init__(self, detection: Detection):
        self._detection, self._arena = detection, FieldArena()
        work = detection._reduction.work
        place = work.place.to_numpy()[: work.count[FOUND]]
        feature = detection.buffer.data.feature.to_numpy()[place]
        # by kind and feature, then by index
        self._order = place[np.lexsort((place, feature[:, 2], feature[:, 1], feature[:, 0]))].astype(np.int32)
        self._state, self._kept = (self._arena.field(name, ti.i32, detection.buffer.capacity + 1) for name in ("state", "kept"))

    def __enter__(self) -> "Quadratic":
        return self

    def __exit__(self, *error) -> None:
        self._arena.release()

    def reduce(self) -> None:
        """Reduce the contacts."""
        d = self._detection
        reduce_by_pairs(d._reduction.work, d.buffer.data, self._order, self._state, self._kept, MERGED * d.edge)

    def same(self) -> bool:
        """Whether it keeps the same contacts as the detection's reduction."""
        self.reduce()
        r = self._detection._reduction.work
        found, left = r.count[FOUND], r.count[LEFT]
        if self._state.to_numpy()[found] != left:
            return False
        return np.array_equal(np.sort(self._kept.to_numpy()[:left]), np.sort(r.kept.to_numpy()[:left]))


# --- searches -----------------------------------------------------------------------------------------------------------


class Rig:
    """Model and detection of a configuration; a context manager."""

    def __init__(self, setup: Setup, geometry: str, runtime: Runtime):
        self.setup, self.runtime = setup, runtime
        self.scene = setup.build(geometry)
        self._arena, self._others = FieldArena(), []
        self.model, layout = build_model(
            self.scene, runtime, self._arena, make_plan(self.scene, explicit=True, multistep=False).on
        )
        self.detection = Detection(self.scene, self.model, layout, runtime)
        surface, makers = self.detection.surface, {"row": entries, "pairs": pair_entries}
        self._lists = [Buffer(name, make, 2**12, None, surface.chunks, self._arena) for name, make in makers.items()]
        self.tets = sum(body.mesh.n_tets for body in self.scene.bodies)

    def __enter__(self) -> "Rig":
        return self

    def __exit__(self, *error) -> None:
        for part in (*self._lists, *self._others):
            part.release()
        self.detection.release()
        self._arena.release()

    def place(self, fraction: float) -> None:
        """Move the nodes to their positions at a fraction of the film."""
        x = start(self.scene) if self.setup.motion is None else self.setup.motion(self.scene, fraction)
        self.model.state.x.from_numpy(x)

    def search(self) -> None:
        """Run a whole search."""
        self.detection.find(0.0, DT)

    def list_pairs(self, broad=None) -> None:
        """Run a broad phase, by default the detection's, and list the pairs of triangles that are near each other."""
        d = self.detection
        near, (row, out) = (broad or d.broad).near(), self._lists
        fill(lambda: list_pairs(d.surface, near, row.parts, NEAR, out.parts), row, out)

    def pairs(self, broad=None) -> np.ndarray:
        """These pairs (k,2)."""
        self.list_pairs(broad)
        out = self._lists[1]
        return out.data.to_numpy()[out.filled(out.used.to_numpy()), :2]

    def n_pairs(self, broad=None) -> int:
        """Number of these pairs."""
        return len(self.pairs(broad))

    def broad_phase(self, name: str, ratio: float | None = None) -> SpatialHash | Bvh:
        """A broad phase of this surface: HASH with a ratio of cell to mean edge, or one of TREES."""
        d, arena = self.detection, FieldArena()
        x = start(self.scene)[d.topology.node]
        if name == HASH:
            ratio = self.scene.collision.cell_ratio if ratio is None else ratio
            made = SpatialHash(d.surface, arena, ratio * d.edge, np.ptp(x, axis=0))
        else:
            made = Bvh(d.surface, d.topology, x, d.reach, self.runtime, arena, int(name.split()[1]))
        self._others += [made, arena]
        return made


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Context in which what is built runs on one thread, for any size."""
    with patched(parallel, "pays", lambda seconds: False), patched(surface, "SERIAL_BELOW", 2**31):
        yield
