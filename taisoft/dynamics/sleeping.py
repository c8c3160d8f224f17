"""Sleeping bodies: what rests, with all that it touches, is left out of implicit steps in time.

Bodies belong to one *island* if they are connected, or if the last search found contacts between them. An island falls asleep
once all its bodies are at rest, after steps that have all converged. A body is at rest if for LOOKS looks, LOOK steps apart, no
node has been farther from where it was at first than STILL times the tolerance of Newton's method, in sizes of the body, since
iterations within that tolerance may move a body at rest as far; and if it is not farther at the last one than DRIFT times as far
as in the first half of them, as what drifts or gains speed would be. The island's nodes are then held, its contacts set aside
with their forces, and contacts are searched only between it and what does not rest. A step in which everything sleeps only counts
its time.

It wakes before a step whose search finds a contact with something awake or with an obstacle that moves; where only the iterations
of the step found one that presses, that step is taken again. It wakes, too, with a change of a load, a number, the state or dt,
and when it is dragged. Some bodies never sleep, see `never_resting`.

Weak: a creep that decays ends where the motion left is as small, in single precision some 1e-3 of a size.
"""

from collections.abc import Callable

import numpy as np

from taisoft.dynamics.contact import ContactStep
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.mesh.topology import linked_groups
from taisoft.scene.plan import never_resting


class Sleep:
    """asleep: (n_colliders,) bool, of bodies. tolerance: of Newton's method."""

    LOOK, LOOKS = 10, 20
    STILL, MOST = 50.0, 2e-3  # the latter: of a body's size, the largest motion whatever the tolerance
    DRIFT = 1.5

    def __init__(self, simulation: SimulationState, contact: ContactStep | NoContacts, tolerance: float):
        scene, layout = simulation.scene, simulation.layout
        self._simulation, self._contact, self._first = simulation, contact, layout.node_start[:-1]
        self._n, index = len(scene.bodies), {c.name: k for k, c in enumerate(scene.colliders)}
        self._body = np.repeat(np.arange(self._n), np.diff(layout.node_start))  # of each node
        sizes = np.maximum.reduceat(layout.rest, self._first) - np.minimum.reduceat(layout.rest, self._first)
        self._limit = min(self.STILL * tolerance, self.MOST) * sizes.max(axis=1)
        self._restless = np.isin([body.name for body in scene.bodies], never_resting(scene))
        self._links = [sorted(index[name] for name in one.owners) for one in scene.connections]
        self.asleep = np.zeros(len(scene.colliders), dtype=bool)
        self._island = np.zeros(self._n, dtype=np.int64)  # number of that in which a body fell asleep
        self._forces = np.zeros((len(self._body), 3))  # that constraints of sleeping bodies bear [N]
        self.forget()

    def forget(self) -> None:
        """Let all bodies be awake, and have just moved."""
        self._x: np.ndarray | None = None  # where bodies stay
        self._steps, self._n_islands = 0, 0
        self._looks, self._early = (
            np.zeros(self._n, dtype=np.int64),
            np.zeros(self._n),
        )  # the latter: motion in the first half [m]
        self._was_moving = np.zeros(len(self.asleep), dtype=bool)  # obstacles, at the last step
        self._hold(np.zeros_like(self.asleep))

    def snapshot(self) -> dict:
        """Return the state for a checkpoint."""
        x = np.zeros((0, 3)) if self._x is None else self._x
        own = {"steps": self._steps, "looks": self._looks, "early": self._early, "x": x, "forces": self._forces}
        return own | {"asleep": self.asleep, "island": self._island, "was_moving": self._was_moving}

    def restore(self, kept: dict) -> None:
        """Restore a `snapshot`, after the contacts."""
        self._steps, self._x = int(kept["steps"]), np.array(kept["x"]) if len(kept["x"]) else None
        self._looks, self._early, self._forces = (np.array(kept[name]) for name in ("looks", "early", "forces"))
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
            self._let_rest()
        while moving.any() or not self.asleep[: self._n].all():
            contact.search(time, dt)
            if not self.wake(contact.touching(self.asleep)):
                return False
        return True

    def is_pressed(self) -> bool:
        """Wake what has been pressed in the step that was taken; return whether anything has, so that it must be taken again."""
        return not self._contact.idle and self.asleep.any() and self.wake(self._contact.touching(self.asleep, pressing=True))

    def end_step(self, time: float, is_solved: bool, reactions: Callable[[], np.ndarray]) -> None:
        """End a step at a time [s]: let fall asleep what has rested. is_solved: whether it converged without problems.

        reactions: of `ImplicitStages`.
        """
        self._steps += 1
        if not is_solved:
            self._x = None
        if self._steps % self.LOOK:
            return
        x = self._simulation.model.state.x.to_numpy().astype(np.float64)
        if self._x is None:
            self._x, self._looks[:] = x.copy(), 0
            return
        moved = np.sqrt(np.maximum.reduceat(((x - self._x) ** 2).sum(axis=1), self._first))
        is_still = (moved <= self._limit) & ~self._restless
        self._stay_at(x, ~is_still)
        self._looks += is_still
        self._early = np.where(2 * self._looks <= self.LOOKS, np.maximum(self._early * (self._looks > 1), moved), self._early)
        ready = self._looks >= self.LOOKS
        self._stay_at(x, drifts := ready & (moved > self.DRIFT * self._early))
        ready &= ~drifts
        if (ready & ~self.asleep[: self._n]).any():
            self._fall_asleep(time, ready, reactions)

    def _stay_at(self, x: np.ndarray, bodies: np.ndarray) -> None:
        """Let bodies (n,) bool have moved to positions (n_nodes, 3) just now."""
        self._looks[bodies] = 0
        if self._x is not None:
            nodes = bodies[self._body]
            self._x[nodes] = x[nodes]

    def _moving(self, time: float) -> np.ndarray:
        """Which colliders (n,) bool are obstacles that do not rest from a time on [s]."""
        obstacles = self._simulation.scene.obstacles
        return np.array([False] * self._n + [not obstacle.rests(time) for obstacle in obstacles])

    def _let_rest(self) -> None:
        """Search contacts only with what does not rest."""
        rests = self.asleep.copy()
        rests[self._n :] = rests.any() & ~self._was_moving[self._n :]
        self._contact.let_rest(rests)

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
            self._let_rest()

    def reactions(self, found: np.ndarray) -> np.ndarray:
        """Return the forces (n_nodes, 3) [N] of constraints, from those of the last step, where sleeping bodies have none."""
        return np.where(self._simulation.asleep[:, None], self._forces, found)
