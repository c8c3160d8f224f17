"""Sleeping bodies: what rests, with all that it touches, is left out of implicit steps in time.

Bodies belong to one *island* if they are connected, or if the last search found contacts between them. An island falls asleep
once all its bodies have been at rest for SPANS spans of SPAN looks, LOOK steps apart, all of which converged:
* no node has been farther from where it was at first than STILL times the tolerance of Newton's method, in sizes of the body;
* momenta have changed from look to look by less than BALANCED times that tolerance of what gravity and loads give: else forces
  are not in balance, as at the top of a flight or of a vibration;
* no span has moved it on as the one before did: else it drifts or gains speed. What iterations within their tolerance do to a
  body at rest has no direction for long.
The island's nodes are then held, its contacts set aside with their forces, and contacts are searched only between it and what
does not rest. A step in which everything sleeps only counts its time.

It wakes before a step whose search finds a contact with something awake or with an obstacle that moves; where only the iterations
of a part of the step found one that presses, or where that part was held back, the step is taken again. It wakes, too, with a
change of a load, a number, the state or dt, and when it is dragged. Some bodies never sleep, see `never_resting`.

Weak: the rest of a creep that decays fast is lost, in single precision some 1e-3 of a size. Steps take elements and nodes that
sleep along, unless everything does.
"""

from collections.abc import Callable

import numpy as np

from taisoft.backend.arrays import download
from taisoft.dynamics.contact import ContactStep
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.mesh.topology import linked_groups
from taisoft.scene.plan import never_resting


class Sleep:
    """asleep: (n_colliders,) bool, of bodies. tolerance: of Newton's method."""

    LOOK, SPAN, SPANS = 10, 10, 3
    STILL, MOST = 50.0, 2e-3  # the latter: of a body's size, the largest motion whatever the tolerance
    BALANCED, MOST_UNBALANCED = 20.0, 2e-3  # likewise
    ROUNDING = 1e-12  # of a size: changes of a velocity by less in the time between two looks are none
    ALIGNED, LASTING = 0.5, 0.5  # cosine between motions of two spans, and ratio of their lengths, from which a body drifts

    def __init__(self, simulation: SimulationState, contact: ContactStep | NoContacts, tolerance: float):
        scene, layout = simulation.scene, simulation.layout
        self._simulation, self._contact, self._first, self._n = simulation, contact, layout.node_start[:-1], len(scene.bodies)
        index = {c.name: k for k, c in enumerate(scene.colliders)}
        self._body = np.repeat(np.arange(self._n), np.diff(layout.node_start))  # of each node
        sizes = np.maximum.reduceat(layout.rest, self._first) - np.minimum.reduceat(layout.rest, self._first)
        self._size = sizes.max(axis=1)
        self._limit = min(self.STILL * tolerance, self.MOST) * self._size
        self._unbalanced = min(self.BALANCED * tolerance, self.MOST_UNBALANCED)
        self._restless = np.isin([body.name for body in scene.bodies], never_resting(scene))
        self._links = [sorted(index[name] for name in one.owners) for one in scene.connections]
        self.asleep = np.zeros(len(scene.colliders), dtype=bool)
        self._island = np.zeros(self._n, dtype=np.int64)  # number of that in which a body fell asleep
        self._forces = np.zeros((len(self._body), 3))  # that constraints of sleeping bodies bear [N]
        self.forget()

    def forget(self) -> None:
        """Let all bodies be awake, and have just moved."""
        # (n_nodes, 3): x, where bodies stay; v at the last look; span_x, where the span began; motion in the one before
        self._seen: dict[str, np.ndarray] | None = None
        self._steps, self._n_islands = 0, 0
        self._looks = np.zeros(self._n, dtype=np.int64)
        self._was_moving, self._pressed = np.zeros_like(self.asleep), np.zeros_like(self.asleep)  # the former: obstacles
        self._hold(np.zeros_like(self.asleep))

    def snapshot(self) -> dict:
        """Return the state for a checkpoint."""
        own = {"steps": self._steps, "looks": self._looks, "forces": self._forces, "seen": self._seen or {}}
        return own | {"asleep": self.asleep, "island": self._island, "was_moving": self._was_moving}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`, after the contacts."""
        self._steps = int(kept["steps"])
        self._seen = {name: np.array(values) for name, values in kept["seen"].items()} or None
        self._looks, self._forces = np.array(kept["looks"]), np.array(kept["forces"])
        self._island, self._was_moving = np.array(kept["island"]), np.array(kept["was_moving"])
        self._n_islands = int(self._island.max()) + 1
        self._hold(np.array(kept["asleep"]))

    # --- a step -------------------------------------------------------------------------------------------------------

    def begin_step(self, time: float, dt: float) -> bool:
        """Wake what a step of dt from a time [s] moves; return whether everything sleeps, so that nothing is left of the step."""
        if not self.asleep.any():
            return False
        moving, contact = self._moving(time), self._contact
        if contact.idle:
            return bool(self.asleep[: self._n].all())
        if (moving != self._was_moving).any():
            self._was_moving = moving
            self._tell_contacts()
        while moving.any() or not self.asleep[: self._n].all():
            contact.search.find(time, dt)
            if not self.wake(contact.search.touching(self.asleep)):
                break
        return bool(self.asleep[: self._n].all())

    def see_part(self) -> None:
        """See what presses on sleeping bodies at the end of a part of a step, before the next one."""
        if not self._contact.idle and self.asleep.any():
            self._pressed |= self.asleep if self._contact.paths.held_back else self._contact.pressing(self.asleep)

    def is_pressed(self) -> bool:
        """Wake what has been pressed in the step that was taken; return whether anything has, so that it must be taken again."""
        pressed, self._pressed = self._pressed, np.zeros_like(self.asleep)
        return self.wake(pressed)

    def end_step(self, time: float, dt: float, is_solved: bool, reactions: Callable[[], np.ndarray]) -> None:
        """End a step of dt at a time [s]: let fall asleep what has rested. is_solved: whether it converged without problems.

        reactions: of `ImplicitStages`.
        """
        self._steps += 1
        if not is_solved:
            self._seen = None
        if self._steps % self.LOOK:
            return
        x, v = (values.astype(np.float64) for values in self._simulation.state())
        if self._seen is None:
            self._seen = {"x": x, "v": v, "span_x": x.copy(), "motion": np.zeros_like(x)}
            self._looks[:] = 0
            return
        moves = np.sqrt(self._sums((x - self._seen["x"]) ** 2, np.maximum)) > self._limit
        moves |= self._restless | self._is_unbalanced(v - self._seen["v"], self.LOOK * dt) | self._drifts(x)
        self._seen["v"] = v
        self._looks += 1
        self._stay_at(x, moves)
        ready = self._looks >= self.SPANS * self.SPAN
        if (ready & ~self.asleep[: self._n]).any():
            self._fall_asleep(time, ready, reactions)

    def _sums(self, values: np.ndarray, add: np.ufunc = np.add) -> np.ndarray:
        """Sums (n,) over the nodes of each body of the sums of rows (n_nodes, 3), or their maxima."""
        return add.reduceat(values.sum(axis=1), self._first)

    def _drifts(self, x: np.ndarray) -> np.ndarray:
        """Which bodies (n,) bool have moved on, in a span that ends at x (n_nodes, 3), as in the one before."""
        ends = (self._looks + 1) % self.SPAN == 0
        if not ends.any():
            return ends
        nodes, motion, before = ends[self._body], x - self._seen["span_x"], self._seen["motion"].copy()
        self._seen["motion"][nodes], self._seen["span_x"][nodes] = motion[nodes], x[nodes]
        last, first, both = self._sums(motion**2), self._sums(before**2), self._sums(motion * before)
        lasts = (both > self.ALIGNED * np.sqrt(last * first)) & (last > self.LASTING**2 * first)
        return ends & (self._looks >= self.SPAN) & lasts

    def _is_unbalanced(self, change: np.ndarray, time: float) -> np.ndarray:
        """Which bodies (n,) bool are not in balance, by changes of velocities (n_nodes, 3) in a time [s]."""
        m, gravity = self._simulation.model, np.array(self._simulation.scene.gravity)
        mass, weight = (values.astype(np.float64)[:, None] for values in download([m.mass, m.gravity_mass]))
        forces = weight * gravity + (m.loads.to_numpy() if m.loaded else 0.0)
        inertia = self._sums((mass * change / time) ** 2)
        is_rounding = self._sums(change**2, np.maximum) <= (self.ROUNDING * self._size / time) ** 2
        return ~is_rounding & (inertia > self._unbalanced**2 * self._sums(forces**2))

    def _stay_at(self, x: np.ndarray, bodies: np.ndarray) -> None:
        """Let bodies (n,) bool have moved to positions (n_nodes, 3) just now."""
        self._looks[bodies] = 0
        if self._seen is not None:
            nodes = bodies[self._body]
            self._seen["x"][nodes] = self._seen["span_x"][nodes] = x[nodes]

    def _moving(self, time: float) -> np.ndarray:
        """Which colliders (n,) bool are obstacles that do not rest from a time on [s]."""
        obstacles = self._simulation.scene.obstacles
        return np.array([False] * self._n + [not obstacle.rests(time) for obstacle in obstacles])

    def _tell_contacts(self) -> None:
        """Search contacts only with what does not rest."""
        rests = self.asleep.copy()
        rests[self._n :] = rests.any() & ~self._was_moving[self._n :]
        self._contact.search.let_rest(rests)

    # --- falling asleep and waking ------------------------------------------------------------------------------------

    def _fall_asleep(self, time: float, ready: np.ndarray, reactions: Callable[[], np.ndarray]) -> None:
        """Let the islands fall asleep all of whose bodies are ready (n,) bool, that touch nothing that moves, and that nothing is
        inside."""
        n, contact, moving = self._n, self._contact, self._moving(time)
        if not contact.paths.none_cross:
            return
        pairs = np.zeros((0, 2), dtype=np.int64)
        if not contact.idle:
            rows = contact.awake()
            pairs = rows.collider.astype(np.int64)
            ready &= ~np.isin(np.arange(n), pairs[(rows.gap < 0.0) | moving[pairs].any(axis=1)])
        links = [(one[0], other) for one in self._links for other in one[1:]]
        a, b = np.concatenate([pairs, np.array(links, dtype=np.int64).reshape(-1, 2)]).T
        among = (a < n) & (b < n)
        n_islands, island = linked_groups(a[among], b[among], n)
        falls = (np.bincount(island, ~ready, n_islands) == 0)[island] & ~self.asleep[:n]
        if not falls.any():
            return
        self._island[falls] = self._n_islands + island[falls]
        self._n_islands += n_islands
        nodes = falls[self._body]
        self._forces[nodes] = reactions()[nodes]
        asleep = self.asleep.copy()
        asleep[:n] |= falls
        if not contact.idle:
            contact.set_aside(np.concatenate([falls, self.asleep[n:]]))
        self._hold(asleep)
        x, v = self._simulation.state()
        v[nodes] = 0.0
        self._simulation.set_state(x, v)

    def wake(self, bodies: np.ndarray) -> bool:
        """Wake bodies, of colliders (n,) bool, and their islands, and let them be awake a while; return whether any slept."""
        n, woken = self._n, np.zeros_like(self.asleep)
        self._looks[bodies[:n]] = 0
        woken[:n] = self.asleep[:n] & np.isin(self._island, self._island[bodies[:n] & self.asleep[:n]])
        if not woken.any():
            return False
        if not self._contact.idle:
            self._contact.take_back(woken)
        self._stay_at(self._simulation.model.state.x.to_numpy(), woken[:n])
        self._hold(self.asleep & ~woken)
        return True

    def bodies_of(self, nodes: np.ndarray) -> np.ndarray:
        """Return the bodies of nodes (k,), of colliders (n,) bool."""
        return np.isin(np.arange(len(self.asleep)), self._body[nodes])

    def _hold(self, asleep: np.ndarray) -> None:
        """Hold the nodes of bodies, of colliders (n,) bool, and no others."""
        are_new = (self.asleep & ~asleep).any()
        self.asleep = asleep
        self._simulation.asleep = asleep[: self._n][self._body]
        self._simulation.upload_constraints()
        if not self._contact.idle and (asleep.any() or are_new):
            self._tell_contacts()

    def reactions(self, found: np.ndarray) -> np.ndarray:
        """Return the forces (n_nodes, 3) [N] of constraints, from those of the last step, where sleeping bodies have none."""
        return np.where(self._simulation.asleep[:, None], self._forces, found)
