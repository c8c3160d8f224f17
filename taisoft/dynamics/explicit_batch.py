"""Batches of explicit sub-steps with contacts, which the host only launches: it reads nothing before their end.

Eight launches are a sub-step: fill the contact problem from the last search, predict, solve, move (Verlet: and kick again), check
the paths, search at the end, and accept. Where triangles can touch each other, there is no search in a batch: it keeps the
contacts of the one before it, see `search_ahead`. What the host would have to decide is an event: it stops the batch, so that
later launches do nothing, and the host takes over there, by the code of single sub-steps. No sub-step is accepted without the
check of its paths. In scenes where obstacles rest, beside meshes only half-spaces, with bodies without rigid parts, dependent or
prescribed nodes and Maxwell branches, under loads that do not change. Others take single sub-steps.
"""

import numpy as np
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import kernel
from taisoft.collision.near_list import go_onward
from taisoft.collision.reduction import FOUND, LEFT
from taisoft.collision.surface import dvec
from taisoft.contact.build import NODES, carry_on, fill, finish_contacts
from taisoft.contact.problem import RESIDUAL, SWEEPS
from taisoft.contact.solve import MOST_OF_TEAM, sweeps_per_launch, team_of
from taisoft.dynamics.contact import ContactStep
from taisoft.dynamics.explicit import reset_counters
from taisoft.dynamics.explicit_contact import begin_solve, finish_verlet, move, predict
from taisoft.dynamics.explicit_stepper import SubstepWork
from taisoft.dynamics.search_ahead import SLACK
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.state import StepState
from taisoft.fem.state import EVENT, GO
from taisoft.scene.obstacles import HalfSpace

MOST = 32  # sub-steps of a batch
# events, in the order in which a sub-step may meet them; OUTDATED: it is accepted, but the next one needs another search
NOTHING, NOT_SOLVED, FAULT, NOT_FREE, NOT_FOUND, OUTDATED = range(6)
# Indices into the tally: sub-steps accepted, sweeps in them, largest residual, solves that did not converge, deepest penetration
# [m], and over the finer side's edge; contacts in the last one; found by the search before the last one and by the last one, and
# those kept
DONE, ALL_SWEEPS, WORST, UNSOLVED, DEEPEST, DEEPEST_RELATIVE, CONTACTS, FOUND_BEFORE, FOUND_LAST, KEPT_LAST, N_TALLY = range(11)


@kernel
def begin_tally(s: ti.template(), tally: ti.template(), found: ti.i32, kept: ti.i32):
    """Begin a batch, after a search that found and kept so many contacts."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        s.run[EVENT] = NOTHING
        for k in ti.static(range(FOUND_BEFORE)):
            tally[k] = 0.0
        tally[FOUND_BEFORE] = tally[FOUND_LAST] = found
        tally[KEPT_LAST] = kept


@kernel
def begin_advance(m: ti.template(), s: ti.template()):
    """Reset the counters, and let kernels work, also after a batch that has ended early."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        reset_counters(m)
        s.run[GO] = 1


@kernel
def run_on(s: ti.template()):
    """Let kernels work again after a batch that has ended early."""
    ti.loop_config(serialize=True)
    for _ in range(1):
        s.run[GO] = 1


@kernel
def accept(
    m: ti.template(),
    p: ti.template(),
    s: ti.template(),
    found: ti.template(),
    reduction: ti.template(),
    good_x: ti.template(),
    good_v: ti.template(),
    good_slip: ti.template(),
    slip: ti.template(),
    tally: ti.template(),
    dt: ti.f64,
    tolerance: ti.f64,
    keeps: ti.template(),
    searched_x: ti.template(),
    slack: ti.f64,
):
    """Accept a sub-step of dt [s]: end its contacts, copy the state to the good one, and add to the tally.

    keeps: whether contacts are kept, up to a slack [m] of motion from the positions searched_x (n_nodes) [m].
    """
    finish_contacts(p, m, good_x, slip, dt, s.run[GO])
    if ti.static(keeps):
        go_onward(s, m.state.x, s.run[GO])
    ti.loop_config(serialize=m.serial)
    for i in range(s.run[GO] * m.n_nodes):
        good_x[i], good_v[i], good_slip[i] = m.state.x[i], m.state.v[i], slip[i]
    ti.loop_config(serialize=p.team.alone, block_dim=p.team.threads)
    for t in range(p.team.threads):
        depth, relative, moved = ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64), ti.cast(0.0, ti.f64)
        if ti.static(keeps):
            lo, hi = dvec(ti.math.inf), dvec(-ti.math.inf)
            for j in range(p.team.share(t, p.count[0])):
                c = p.team.term(t, j)
                depth = ti.max(depth, -p.gap[c])
                relative = ti.max(relative, -p.gap[c] / ti.min(s.edge[p.body[c][0]], s.edge[p.body[c][1]]))
                for e in range(p.first[c], p.first[c] + p.arity[c]):
                    motion = m.state.x[p.node[e]] - searched_x[p.node[e]]
                    lo, hi = ti.min(lo, motion), ti.max(hi, motion)
            for k in ti.static(range(3)):
                moved = ti.max(moved, p.team.largest(t, hi[k]) + p.team.largest(t, -lo[k]))
        else:
            for j in range(p.team.share(t, reduction.count[LEFT])):
                at = reduction.kept[p.team.term(t, j)]
                depth = ti.max(depth, -found.gap[at])
                relative = ti.max(relative, -found.gap[at] / ti.min(s.edge[found.body[at][0]], s.edge[found.body[at][1]]))
        depth, relative = p.team.largest(t, depth), p.team.largest(t, relative)
        if t == 0 and s.run[GO] == 1:
            tally[DONE] += 1.0
            tally[CONTACTS] = p.count[0]
            if p.count[0] > 0:
                residual = p.sweep.state[RESIDUAL]
                tally[ALL_SWEEPS] += p.sweep.state[SWEEPS]
                tally[WORST] = ti.max(tally[WORST], residual)
                tally[UNSOLVED] += ti.cast(not residual <= tolerance, ti.f64)
            tally[DEEPEST], tally[DEEPEST_RELATIVE] = ti.max(tally[DEEPEST], depth), ti.max(tally[DEEPEST_RELATIVE], relative)
            tally[FOUND_BEFORE], tally[FOUND_LAST] = tally[FOUND_LAST], reduction.count[FOUND]
            tally[KEPT_LAST] = reduction.count[LEFT]
            if not moved <= slack:
                s.run[GO], s.run[EVENT] = 0, OUTDATED


class Batch:
    """Batches of sub-steps of one simulation. tally: of the last one; event: that has ended it early, or NOTHING."""

    def __init__(self, simulation: SimulationState, contact: ContactStep, work: SubstepWork, method: str, tolerance: float):
        self._simulation, self._contact, self._work = simulation, contact, work
        self._method, self._tolerance, self._arena = method, tolerance, FieldArena()
        self._tally = self._arena.field("batch_tally", ti.f64, N_TALLY)
        self.tally, self.event = np.zeros(N_TALLY), NOTHING
        m = simulation.model
        is_plain = not (m.viscous or m.has_rigid_tets or m.has_dependents or work.has_prescribed or simulation.ramp)
        # the normals of contacts with planes stay, whatever moves: the slack says nothing about bodies that pass round obstacles
        has_planes = all(isinstance(one.shape, HalfSpace) for one in simulation.scene.obstacles)
        self._keeps = contact.detection.has_pairs and has_planes
        self._suits = is_plain and (contact.detection.only_shapes or self._keeps)
        self._slack = SLACK * float(contact.detection.edges[: len(simulation.scene.bodies)].min())

    def suits(self) -> bool:
        """Return whether the next sub-steps may be a batch."""
        simulation, contact = self._simulation, self._contact
        is_free = simulation.now.none_cross and not len(simulation.now.held.pairs) and not simulation.has_paths
        return self._suits and is_free and not simulation.loads.vary and contact.n_contacts <= MOST_OF_TEAM

    def is_far(self, time: float, dt: float) -> bool:
        """Return whether nothing can touch in a sub-step of dt from a time, if that is to be asked: on the GPU path a batch with
        searches reads less."""
        asks = self._simulation.model.on_cpu or self._keeps or not self.suits()
        return asks and self._contact.search.is_far(time, dt, self._contact.n_contacts)

    def search(self, n: int, time: float, dt: float) -> int:
        """Search, unless it is known what is near, and return how many of n sub-steps of dt [s] from a time a batch can take."""
        if self._keeps:
            return self._contact.search.keep(time, dt, n)
        self._contact.search.find(time, dt)
        return n

    def run(self, n: int, time: float, dt: float, good: StepState, max_sweeps: int) -> None:
        """Take up to n sub-steps of dt [s], after `search`.

        good: the state at the start, which becomes that after the last sub-step accepted. The tally is right after Ctrl-C, too.
        """
        contact, search, detection = self._contact, self._contact.search, self._contact.detection
        self.tally, self.event = np.zeros(N_TALLY), NOTHING
        contact.make_room()
        begin_tally(detection.surface, self._tally, detection.counts.found, detection.counts.contacts)
        try:
            for k in range(n):
                self.launch(k, time + k * dt, dt, good, max_sweeps)
        finally:
            interrupt = self._read(n)
            done, n, before, found, kept = self.tally[[DONE, CONTACTS, FOUND_BEFORE, FOUND_LAST, KEPT_LAST]].astype(int).tolist()
            is_whole = self.event in (NOTHING, OUTDATED)  # the next sub-step has not begun
            search.far.skip(done - int(self.event == NOTHING and not self._keeps))
            if self._keeps:
                search.count_done(done, self.event == OUTDATED)
                contact.take_over(dt, n if is_whole else None, detection.counts.found, detection.counts.unmapped)
            else:
                search.adopt(time + done * dt, dt, found, kept)
                contact.take_over(dt, *((n, before) if is_whole else (kept, found)))
            contact.check.measure_crossings()
        if interrupt is not None:
            raise interrupt

    def _read(self, n: int) -> KeyboardInterrupt | None:
        """Read how a batch of n sub-steps has ended; again after Ctrl-C, which is returned: the good state is the tally's."""
        interrupt = None
        while True:
            try:
                tally = self._tally.to_numpy()
                event = NOTHING if tally[DONE] == n and not self._keeps else int(self._contact.detection.surface.run[EVENT])
                self.tally, self.event = tally, event
                return interrupt
            except KeyboardInterrupt as error:
                interrupt = error

    def launch(self, k: int, time: float, dt: float, good: StepState, max_sweeps: int) -> None:
        """Launch sub-step k of the batch."""
        model, contact, work, detection = self._simulation.model, self._contact, self._work, self._contact.detection
        p, s, search = contact.problem, detection.surface, (detection.surface, detection.shapes)
        warm, offset, n = contact.warm_factor(dt) if k == 0 else 1.0, contact.contact_offset, detection.counts.contacts
        if self._keeps and contact.search.done + k > 0:
            carry_on(p, model, s, dt, offset)
        else:
            fill(p, model, *search, contact.numbers, detection.buffer.data, detection.reduction, -1, dt, warm, offset, 1)
        predict(model, work, p, s, dt, *contact.gap_targets)
        solve = self._method, self._tolerance, min(max_sweeps, sweeps_per_launch(n)), max_sweeps
        begin_solve(p, team_of(p, self._method, n)[0], s, *solve, NOT_SOLVED)
        move(model, work, p, s, dt, FAULT)
        if work.verlet:
            finish_verlet(model, work, p, s, dt, FAULT)
        detection.paths.check_in_batch(model.state.x, NOT_FREE)
        if not self._keeps:
            room = min(p.capacity - 1, p.node.shape[0] // (NODES * model.most_masters))
            detection.search_shapes(detection.motion(time + dt, dt), True, room, NOT_FOUND)
        state, kept = (good.x, good.v, good.slip, self._simulation.now.slip), (self._keeps, contact.search.x, self._slack)
        accept(model, p, s, detection.buffer.data, detection.reduction, *state, self._tally, dt, self._tolerance, *kept)

    @property
    def field_bytes(self) -> dict[str, int]:
        """Bytes by name."""
        return self._arena.bytes

    def release(self) -> None:
        """Free the memory."""
        self._arena.release()
