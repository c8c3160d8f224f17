"""Runs explicit sub-steps in batches, checks them, and puts the last good state back when one fails."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.arrays import Count
from taisoft.dynamics import explicit
from taisoft.dynamics.world import World
from taisoft.errors import SimulationError
from taisoft.model import Model
from taisoft.scalars import LOWEST_J, MOST_INVERTED, STEPS_DONE
from taisoft.transfer import upload

LAUNCH_SECONDS = 0.1  # of one launch at most, roughly, so that Ctrl-C is heard
DAMPING_POINT_SECONDS = 800e-9  # that stiffness damping adds to a law's POINT_SECONDS: it projects the stiffness of each point
MAX_BATCH = 4096
TARGET_BYTES_PER_TET = 200  # memory that the targets of a batch may take


@dataclass(frozen=True, eq=False)
class SubstepWork:
    """Fields of the explicit steps; what a scene does not need is None."""

    verlet: bool
    n_moved: Count
    n_held: Count
    acceleration: Any  # (n_nodes) 3-vectors, Verlet
    half_velocity: Any  # (n_nodes) 3-vectors, Verlet with stiffness damping
    moved: Any  # (n_moved) i32
    moved_axes: Any  # (n_moved) 3-vectors i32
    targets: Any  # (rows * n_moved) 3-vectors f64
    before: Any  # (n_moved) 3-vectors f64: position before the sub-step
    held: Any  # (n_held) i32
    held_velocity: Any  # (n_held) 3-vectors
    reaction: Any  # (n_held) 3-vectors [N]

    @property
    def leads(self) -> bool:
        """Whether nodes are moved."""
        return self.moved is not None

    @property
    def holds(self) -> bool:
        """Whether nodes are held."""
        return self.held is not None


@dataclass(frozen=True)
class SubstepResult:
    """Extremes over a batch."""

    done: int
    min_volume_ratio: float
    n_inverted: int


def largest_batch(m: Model) -> int:
    """Sub-steps that one launch may take. It rests on the scene alone, not on the clock: where a batch ends shows in the last
    digit of the report's extremes."""
    damping = DAMPING_POINT_SECONDS if m.stiffness_damping else 0.0
    seconds = sum((g.last - g.first) * m.lanes * g.n_points * (g.law.POINT_SECONDS + damping) for g in m.groups)
    return max(1, min(MAX_BATCH, int(LAUNCH_SECONDS / seconds)))


class ExplicitStepper:
    """Takes sub-steps of symplectic Euler or velocity Verlet over a world."""

    def __init__(self, world: World, verlet: bool):
        self.world = world
        m, arena, motion = world.model, world.arena, world.motion
        n_tets = int(world.layout.n_tets.sum())
        self.max_batch = largest_batch(m)
        n_moved, n_held = motion.n_moved, len(motion.held)
        self.rows = max(1, min(self.max_batch, TARGET_BYTES_PER_TET * n_tets // (24 * max(1, n_moved))))

        def vectors(name: str, count: int, dtype=m.real, wanted: bool = True, data=None):
            return arena.vectors(name, dtype, count, data) if wanted and count > 0 else None

        self.work = SubstepWork(
            verlet=verlet, n_moved=n_moved, n_held=n_held,
            acceleration=vectors("acceleration", m.n_nodes, wanted=verlet),
            half_velocity=vectors("half_velocity", m.n_nodes, wanted=verlet and m.stiffness_damping),
            moved=arena.field("moved", ti.i32, n_moved, motion.moved.astype(np.int32)) if n_moved else None,
            moved_axes=vectors("moved_axes", n_moved, ti.i32, data=motion.moved_axes()),
            targets=vectors("targets", self.rows * n_moved, ti.f64),
            before=vectors("moved_before", n_moved, ti.f64),
            held=arena.field("held", ti.i32, n_held, motion.held.astype(np.int32)) if n_held else None,
            held_velocity=vectors("held_velocity", n_held), reaction=vectors("reaction", n_held),
        )  # fmt: skip
        self.stale = True  # Verlet's acceleration does not belong to the present state

    def forget(self) -> None:
        """The state was set."""
        self.stale = True
        if self.work.n_held:
            self.work.reaction.fill(0.0)

    def numbers_changed(self) -> None:
        """Gravity or material numbers changed."""
        self.stale = True

    def _kept_fields(self) -> dict[str, Any]:
        """Fields that live from one sub-step to the next, by name, where the scene has them."""
        both = {"acceleration": self.work.acceleration, "reaction": self.work.reaction}
        return {name: field for name, field in both.items() if field is not None}

    def snapshot(self) -> dict:
        """What the next sub-step rests on beside the world, and what `reactions` tells.

        Verlet's acceleration was found with a velocity of the middle, so it is kept, not found again.
        """
        return {"stale": self.stale} | {name: field.to_numpy() for name, field in self._kept_fields().items()}

    def restore(self, kept: dict) -> None:
        """Back to what `snapshot` told."""
        upload([(field, kept[name]) for name, field in self._kept_fields().items()])
        self.stale = bool(kept["stale"])

    def advance(self, n: int, dt: float) -> SubstepResult:
        """Take n sub-steps of dt, or fewer where led nodes let go or the launch would last too long; at least one.

        A sub-step with a non-finite result raises SimulationError, and the state is the one before it; any other
        exception leaves the state as it was.
        """
        n = min(n, self.max_batch)
        world = self.world
        if self.work.n_moved:
            n = min(n, self.rows)
            releases = world.releases
            targets = world.next_targets(world.time + dt * np.arange(1, n + 1))
            self.stale = self.stale or world.releases != releases
            n = len(targets)
            self._upload_targets(targets)
        kept = world.state()
        try:
            result = self._launch(n, dt)
        except BaseException:  # Ctrl-C, heard when the launch has ended: the batch is abandoned
            self._put_back(*kept)
            raise
        if result.done < n:
            self._put_back(*kept)
            if result.done > 0:  # deterministic on the CPU: the same sub-steps again, up to the last good one
                self._launch(result.done, dt)
            good = world.state()
            self._put_back(*good)
            self._launch(1, dt)
            where = self._fault()
            self._put_back(*good)
            world.step_count += result.done
            world.time += result.done * dt
            raise SimulationError(f"step {world.step_count + 1}: {where}")
        return result

    def _fault(self) -> str:
        """What ended the last sub-step, whose state is at hand."""
        lowest = self.world.model.state.scalars[LOWEST_J]
        exploded = f"a tet is inside out by {-lowest:.1e} times its volume: the motion has diverged, and a smaller dt is needed"
        return self.world.find_unfinite() or (exploded if lowest <= -explicit.EXPLODED else "a velocity is no longer finite")

    def _upload_targets(self, targets: np.ndarray) -> None:
        explicit.set_targets(self.work, targets.reshape(-1, 3))
        upload([(self.work.moved_axes, self.world.motion.moved_axes())])

    def _put_back(self, x: np.ndarray, v: np.ndarray) -> None:
        self.world.set_state(x, v)
        self.stale = True

    def _launch(self, n: int, dt: float) -> SubstepResult:
        m, s = self.world.model, self.work
        if m.serial:
            explicit.advance_serial(m, s, n, dt, int(self.stale))
        else:
            self._launch_parallel(n, dt)
        self.stale = False
        done, lowest, inverted = m.state.scalars.to_numpy()[STEPS_DONE : MOST_INVERTED + 1].tolist()
        return SubstepResult(int(done), lowest, int(inverted))

    def _launch_parallel(self, n: int, dt: float) -> None:
        m, s = self.world.model, self.work
        if s.verlet and self.stale:
            explicit.elements_parallel(m)
            explicit.restart_parallel(m, s)
        explicit.begin_parallel(m)
        for row in range(n):
            if s.verlet or s.n_moved or s.n_held:
                explicit.drift_parallel(m, s, row, dt)
            explicit.elements_parallel(m)
            explicit.nodes_parallel(m, s, row, dt)

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name of fields outside of the simulator's own memory: none."""
        return {}

    def release(self) -> None:
        """Nothing to give back."""

    def reactions(self) -> np.ndarray:
        """(n_nodes, 3) force of the constraints in the last sub-step [N]."""
        out = np.zeros((self.world.model.n_nodes, 3))
        if self.work.n_held:
            out[self.world.motion.held] = self.work.reaction.to_numpy()
        return out
