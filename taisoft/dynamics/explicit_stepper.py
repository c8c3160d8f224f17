"""Explicit sub-steps in batches, with checks; a failure restores the last good state."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.arrays import Count, upload
from taisoft.dynamics import explicit
from taisoft.dynamics.results import StepResult
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.errors import SimulationError
from taisoft.fem.model import Model
from taisoft.fem.state import LOWEST_J, MOST_INVERTED, STEPS_DONE
from taisoft.fem.terms.elasticity import EXPLODED
from taisoft.settings import Settings


@dataclass(frozen=True, eq=False)
class SubstepWork:
    """Fields of the explicit steps; None if a scene does not need them."""

    verlet: bool
    n_prescribed: Count
    n_held: Count
    acceleration: Any  # (n_nodes) 3-vectors, Verlet
    half_velocity: Any  # (n_nodes) 3-vectors f64, Verlet with forces that depend on v
    decay: Any  # (n_nodes) factors of mass damping in half a sub-step: Verlet, on one thread
    prescribed_nodes: Any  # (n_prescribed) i32
    prescribed_axes: Any  # (n_prescribed) 3-vectors i32
    targets: Any  # (rows * n_prescribed) 3-vectors f64
    n_varied: Count
    varied_nodes: Any  # (n_varied) i32: those whose loads follow a path
    load_rows: Any  # (rows * n_varied) 3-vectors f64 [N]: their loads in each sub-step
    n_amplitudes: Count  # loads that are one number, if any follows a path; else 0
    amplitude_rows: Any  # (rows * n_amplitudes) f64: their values in each sub-step
    before: Any  # (n_prescribed) 3-vectors f64: position before the sub-step
    held: Any  # (n_held) i32
    held_velocity: Any  # (n_held) 3-vectors f64
    reaction: Any  # (n_held) 3-vectors [N]

    @property
    def keeps_decays(self) -> bool:
        """Whether the factors of mass damping are computed once in a launch."""
        return self.decay is not None

    @property
    def has_prescribed(self) -> bool:
        """Whether nodes have prescribed motion."""
        return self.prescribed_nodes is not None

    @property
    def has_varied_loads(self) -> bool:
        """Whether loads follow paths."""
        return self.has_varied_nodes or self.has_varied_amplitudes

    @property
    def has_varied_nodes(self) -> bool:
        """Whether dead loads follow paths."""
        return self.varied_nodes is not None

    @property
    def has_varied_amplitudes(self) -> bool:
        """Whether loads that are one number follow paths."""
        return self.amplitude_rows is not None

    @property
    def has_held(self) -> bool:
        """Whether nodes are constrained."""
        return self.held is not None


def largest_batch(m: Model) -> int:
    """Return the maximum number of sub-steps per launch.

    It depends on the scene alone, not on measured time, since the ends of batches affect the last digit of the report's extremes.
    A launch takes about 0.1 s at most, so that Ctrl-C takes effect; a GPU does about 30 times as much in that time. Where loops
    are divided, each sub-step has launches of its own, and the measurement that ends a batch takes almost as long as a sub-step.
    """
    more = (800e-9 if m.stiffness_damping else 0.0) + (40e-9 if m.viscous else 0.0)  # [s] a point: projection, branches
    seconds = sum((g.last - g.first) * m.lanes * g.n_points * (g.law.POINT_SECONDS + more) for g in m.groups)
    longest = 0.1 * 30 if not m.on_cpu else 0.4 if m.chunks > 1 else 0.1
    return max(1, min(4096, int(longest / seconds)))


class ExplicitStepper:
    """Take sub-steps of symplectic Euler or velocity Verlet."""

    _in_batches = True  # whether a launch takes many sub-steps, on one thread

    def __init__(self, simulation: SimulationState, settings: Settings):
        self.simulation, verlet = simulation, settings.integrator == "velocity_verlet"
        m, arena, dirichlet = simulation.model, simulation.arena, simulation.dirichlet
        n_tets = len(simulation.layout.lane_of_tet)
        self.max_batch = largest_batch(m)
        n_prescribed, n_held = dirichlet.n_prescribed, len(dirichlet.held)
        self._varied = simulation.loads.nodes if m.loaded else np.zeros(0, dtype=np.int64)
        n_varied = len(self._varied)
        n_amplitudes = simulation.loads.n_amplitudes if simulation.loads.amplitudes_vary else 0
        row_bytes = 24 * (n_prescribed + n_varied) + 8 * n_amplitudes
        self.rows = max(1, min(self.max_batch, 200 * n_tets // max(24, row_bytes)))  # of targets: at most 200 bytes a tet

        def ids(name: str, nodes: np.ndarray):
            return arena.field(name, ti.i32, len(nodes), nodes.astype(np.int32)) if len(nodes) else None

        def vectors(name: str, count: int, dtype=m.real, needed: bool = True, data=None):
            return arena.vectors(name, dtype, count, data) if needed and count > 0 else None

        self.work = SubstepWork(
            verlet=verlet,
            n_prescribed=n_prescribed,
            n_held=n_held,
            acceleration=vectors("acceleration", m.n_nodes, needed=verlet),
            half_velocity=vectors("half_velocity", m.n_nodes, ti.f64, needed=verlet and m.depends_on_velocity),
            decay=arena.field("mass_decay", m.real, m.n_nodes) if verlet and m.damped and m.serial and self._in_batches else None,
            prescribed_nodes=ids("prescribed_nodes", dirichlet.prescribed_nodes),
            prescribed_axes=vectors("prescribed_axes", n_prescribed, ti.i32, data=dirichlet.prescribed_axes()),
            targets=vectors("targets", self.rows * n_prescribed, ti.f64),
            n_varied=n_varied,
            varied_nodes=ids("varied_nodes", self._varied),
            load_rows=vectors("load_rows", self.rows * n_varied, ti.f64),
            n_amplitudes=n_amplitudes,
            amplitude_rows=arena.field("amplitude_rows", ti.f64, self.rows * n_amplitudes) if n_amplitudes else None,
            before=vectors("position_before", n_prescribed, ti.f64),
            held=ids("held", dirichlet.held),
            held_velocity=vectors("held_velocity", n_held, ti.f64),
            reaction=vectors("reaction", n_held),
        )
        self.good = simulation.now.another(arena, "good")  # the last good state
        self.acceleration_stale = True  # Verlet's acceleration does not match the present state

    def forget(self) -> None:
        """Invalidate the acceleration and clear the reactions, after the state was set."""
        self.acceleration_stale = True
        if self.work.n_held:
            self.work.reaction.fill(0.0)

    def numbers_changed(self) -> None:
        """Invalidate the acceleration, after gravity, materials or loads changed."""
        self.acceleration_stale = True

    loads_changed = numbers_changed

    def held_steps(self, dt: float) -> int:
        """Return the number of sub-steps of dt [s] over which a drag force is held."""
        return max(1, min(16, int(0.002 / dt)))  # at most 2 ms

    def _kept_fields(self) -> dict[str, Any]:
        """Fields kept from one sub-step to the next, by name, if the scene has them."""
        both = {"acceleration": self.work.acceleration, "reaction": self.work.reaction}
        return {name: field for name, field in both.items() if field is not None}

    def wake(self, *names: str) -> None:
        """Do nothing: nothing sleeps in explicit steps."""

    def warm_up(self, time: float, dt: float) -> None:
        """Do nothing: a step has launched all kernels."""

    def settle(self, dt: float, is_solved: bool) -> None:
        """Do nothing either."""

    def snapshot(self) -> dict:
        """Return the state of the stepper, including the reactions.

        Verlet's acceleration was computed with a mid-step velocity, so it is saved, not recomputed.
        """
        return {"stale": self.acceleration_stale} | {name: field.to_numpy() for name, field in self._kept_fields().items()}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`."""
        upload([(field, kept[name]) for name, field in self._kept_fields().items()])
        self.acceleration_stale = bool(kept["stale"])

    def advance(self, n: int, dt: float) -> StepResult:
        """Take n sub-steps of dt, or fewer if prescribed nodes are released or the launch would last too long; at least one.

        A sub-step with a non-finite result raises SimulationError, and the state is the one before it; any other
        exception leaves the state unchanged.
        """
        n = min(n, self.max_batch)
        simulation = self.simulation
        simulation.set_load_time(simulation.time)
        targets = loads = None
        if self.work.n_prescribed or self.work.has_varied_loads:
            n = min(n, self.rows)
        if self.work.n_prescribed:
            releases = simulation.releases
            targets = simulation.next_targets(simulation.time + dt * np.arange(1, n + 1))
            self.acceleration_stale = self.acceleration_stale or simulation.releases != releases
            n = len(targets)
        if self.work.has_varied_loads:
            times = simulation.time + dt * (np.arange(n) + int(self.work.verlet))  # Euler's forces are those at the start
            loads = self._load_rows(times)
        self._upload_rows(targets, loads)
        self.good.copy_from(simulation.now)
        try:
            result = self._launch(n, dt)
        except BaseException:  # Ctrl-C, raised when the launch has ended: the batch is abandoned
            self._return_to_good()
            raise
        if result.steps < n:
            self._return_to_good()
            if result.steps > 0:  # deterministic on the CPU: repeat up to the last good sub-step
                self._launch(result.steps, dt)
            self.good.copy_from(simulation.now)
            simulation.step_count += result.steps
            simulation.time += result.steps * dt
            self._return_to_good()
            rest = slice(result.steps, None)
            self._upload_rows(
                None if targets is None else targets[rest], None if loads is None else tuple(rows[rest] for rows in loads)
            )
            self._launch(1, dt)
            fault = self._describe_fault()
            self._return_to_good()
            raise SimulationError(f"step {simulation.step_count + 1}: {fault}")
        return result

    def _describe_fault(self) -> str:
        """Describe the failure of the last sub-step, from its state."""
        lowest = self.simulation.model.state.scalars[LOWEST_J]
        exploded = f"a tet is inverted by {-lowest:.1e} times its volume: the motion has diverged, and a smaller dt is needed"
        other = exploded if lowest <= -EXPLODED else "a velocity is no longer finite"
        return self.simulation.find_nonfinite() or other

    def _upload_rows(self, targets: np.ndarray | None, loads: tuple[np.ndarray, np.ndarray] | None) -> None:
        """Upload targets (r,k,3) and loads, as `_load_rows` returns them, of the next sub-steps; None without any."""
        if targets is not None:
            self._upload_targets(targets)
        if loads is not None and self.work.has_varied_nodes:
            self.work.load_rows.from_numpy(loads[0].reshape(-1, 3), 0)
        if loads is not None and self.work.has_varied_amplitudes:
            self.work.amplitude_rows.from_numpy(loads[1].reshape(-1), 0)

    def _upload_targets(self, targets: np.ndarray) -> None:
        self.work.targets.from_numpy(targets.reshape(-1, 3), 0)
        upload([(self.work.prescribed_axes, self.simulation.dirichlet.prescribed_axes())])

    def _load_rows(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the loads (r,k,3) [N] that follow paths at the times (r,) [s], and the amplitudes (r,n) if any does."""
        simulation = self.simulation
        return simulation.load_rows(times, self._varied), simulation.loads.amplitudes(times)

    def _return_to_good(self) -> None:
        """Return to the last good state."""
        self.simulation.return_to(self.good)
        self.simulation.set_load_time(self.simulation.time)
        self.acceleration_stale = True

    def _launch(self, n: int, dt: float) -> StepResult:
        m, s = self.simulation.model, self.work
        if s.has_varied_loads:
            self.simulation.load_time = None  # sub-steps set them
        if m.serial:
            explicit.advance_alone(m, s, n, dt, int(self.acceleration_stale))
        else:
            self._launch_shared(n, dt)
        self.acceleration_stale = False
        done, lowest, inverted = m.state.scalars.to_numpy()[STEPS_DONE : MOST_INVERTED + 1].tolist()
        return StepResult(int(done), min_volume_ratio=lowest, n_inverted=int(inverted))

    def _launch_shared(self, n: int, dt: float) -> None:
        m, s = self.simulation.model, self.work
        if s.verlet and self.acceleration_stale:
            explicit.run_elements(m)
            explicit.find_acceleration(m, s)
        explicit.begin_batch(m)
        special = explicit.begins_alone(m, s)

        def needs_drift(row: int) -> bool:  # not in the loop over nodes that ends the last sub-step
            last_held = s.n_held > 0 and row == n - 1  # the velocities before it are needed for the reactions
            return special or last_held or (s.verlet and row == 0)

        for row in range(n):
            if needs_drift(row):
                explicit.begin_shared(m, s, row, dt)
            if s.verlet:
                self.simulation.move_branches(dt)
            explicit.run_elements(m)
            explicit.end_shared(m, s, row, dt, int(s.verlet and row < n - 1 and not needs_drift(row + 1)))
            if not s.verlet:
                self.simulation.move_branches(dt)
        if s.n_held:
            explicit.find_reactions(m, s, dt)

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name of fields outside the simulator's arena: none."""
        return {}

    def release(self) -> None:
        """Free nothing."""

    def reactions(self) -> np.ndarray:
        """Return the constraint forces of the last sub-step, (n_nodes, 3) [N]."""
        out = np.zeros((self.simulation.model.n_nodes, 3))
        if self.work.n_held:
            out[self.simulation.dirichlet.held] = self.work.reaction.to_numpy()
        return out
