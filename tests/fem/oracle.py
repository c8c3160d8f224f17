"""What taisoft should compute, once more: dense NumPy written from the formulas, slow and independent of the package.

It reads a `Scene`'s plain records and shares no formula with the package: the laws are those of `oracle_laws`, the finite
elements those of `oracle_elements`, and implicit steps and statics are dense Newton.
"""

from dataclasses import replace

import numpy as np

from tests.fem.oracle_elements import Elements, Part, body_loads
from tests.fem.oracle_laws import hessian, pk1, psi


def tet_materials(body) -> list:
    """The material (m,) of each tet of a body, with its own numbers."""
    of_regions = body.material if body.composition.has_regions else None
    found = [of_regions[int(r)] for r in body.mesh.regions] if of_regions else [body.material] * body.mesh.n_tets
    for name, values in body.composition.by_tet.items():
        found = [replace(material, **{name: float(value)}) for material, value in zip(found, values)]
    return found


def parts_of(body, whole: Part) -> list[Part]:
    """A part for each material of a body; whole: the part of all its tets."""
    materials, parts = tet_materials(body), []
    for material in dict.fromkeys(materials):
        rows = np.repeat([one == material for one in materials], whole.points)
        parts.append(Part(whole.nodes[rows], whole.gradients[rows], whole.weights[rows], material, whole.points))
    return parts


class Oracle:
    """A scene's bodies as dense arrays, and every integrator as one short method.

    n nodes. lumped: (n,1) masses of explicit steps. mass: (n,n) of implicit ones, consistent for second-order bodies and
    lumped for first-order ones. consistent: (n,n), for bodies of either order [kg]. loads: (n,3) [N], without weight.
    """

    def __init__(self, scene):
        self.gravity = scene.gravity
        self.parts: list[Part] = []
        elements, self.starts = [], [0]
        for body in scene.bodies:
            elements.append(Elements(body.mesh, body.order))
            self.parts += parts_of(body, elements[-1].part(body.quadrature_degree, None, self.starts[-1]))
            self.starts.append(self.starts[-1] + len(elements[-1].X))
        self.n = self.starts[-1]
        self.lumped, self.loads, self.rest, self.v = np.zeros((self.n, 1)), *(np.zeros((self.n, 3)) for _ in range(3))
        self.mass_damping, self.stiffness_damping = np.zeros((self.n, 1)), np.zeros((self.n, 1))
        self.mass, self.consistent = np.zeros((self.n, self.n)), np.zeros((self.n, self.n))
        for body, made, start, end in zip(scene.bodies, elements, self.starts, self.starts[1:]):
            own, (m, *_) = slice(start, end), (materials := tet_materials(body))
            density = np.array([material.density for material in materials])
            lumped = made.lumped_mass(density)
            self.consistent[own, own] = made.consistent_mass(density)
            self.mass[own, own] = self.consistent[own, own] if body.order == 2 else np.diag(lumped)
            self.lumped[own, 0], self.loads[own] = lumped, body_loads(body, made.X, lumped)
            self.rest[own], self.v[own] = made.X + body.position, body.velocity
            self.mass_damping[own], self.stiffness_damping[own] = m.mass_damping, m.stiffness_damping
        self.x = self.rest.copy()
        self._hold(scene)
        self.time, self.past, self.acceleration = 0.0, [], None

    def _hold(self, scene) -> None:
        self.fixed, self.prescribed = np.zeros((self.n, 3), dtype=bool), []
        for body, start in zip(scene.bodies, self.starts):
            for c in body.constraints:
                mask = np.zeros((self.n, 3), dtype=bool)
                mask[np.ix_(c.nodes + start, np.flatnonzero(c.axes))] = True
                if c.path is None:
                    self.fixed |= mask
                else:
                    self.prescribed.append((c.nodes + start, mask, c.path))
        self.v = np.where(~self._masks(), self.v, 0.0)

    def _masks(self):
        return np.any([self.fixed, *(prescribed for _, prescribed, _ in self.prescribed)], axis=0)

    def targets(self, t: float):
        """(positions, mask) of the led axes at a time; groups that let go are dropped, and the past with them."""
        where, mask = self.rest.copy(), np.zeros((self.n, 3), dtype=bool)
        still = [group for group in self.prescribed if group[2](t) is not None]
        if len(still) < len(self.prescribed):
            self.prescribed, self.past, self.acceleration = still, [], None
        for nodes, prescribed, path in self.prescribed:
            where[nodes] += np.where(prescribed[nodes], path(t), 0.0)
            mask |= prescribed
        return where, mask

    # --- elasticity -------------------------------------------------------------------------------------------------

    def gradients(self, x, part):
        """F (k,3,3) at the quadrature points."""
        return np.einsum("eai,eaj->eij", x[part.nodes], part.gradients)

    def volume_ratios(self, x):
        """(smallest det F of all quadrature points, number of tets that have one without positive det F)."""
        J = [np.linalg.det(self.gradients(x, part)).reshape(-1, part.points).min(axis=1) for part in self.parts]
        return min(worst.min() for worst in J), sum((worst <= 0).sum() for worst in J)

    def energy(self, x) -> float:
        """Elastic energy [J]."""
        total = 0.0
        for part in self.parts:
            m = part.material
            total += part.weights @ psi(m.law, self.gradients(x, part), m.young, m.poisson, m.volume_floor)
        return total

    def force(self, x):
        """Elastic forces (n,3) [N]."""
        f = np.zeros((self.n, 3))
        for part in self.parts:
            m = part.material
            P = pk1(m.law, self.gradients(x, part), m.young, m.poisson, m.volume_floor)
            np.subtract.at(f, part.nodes, np.einsum("e,eij,eaj->eai", part.weights, P, part.gradients))
        return f

    def stiffness(self, x, projected: bool = False):
        """-df/dx as a dense (3n,3n) matrix [N/m]; projected: with the laws' second derivatives made positive."""
        K = np.zeros((3 * self.n, 3 * self.n))
        for part in self.parts:
            m, g = part.material, part.gradients
            H = hessian(m.law, self.gradients(x, part), m.young, m.poisson, projected, m.volume_floor).reshape(-1, 3, 3, 3, 3)
            Hg = np.einsum("e,eijkl,ebl->eijbk", part.weights, H, g)
            blocks = np.einsum("eaj,eijbk->eaibk", g, Hg).reshape(len(g), 3 * g.shape[1], -1)
            blocks = blocks.reshape(-1, part.points, *blocks.shape[1:]).sum(axis=1)
            axes = (3 * part.nodes[:: part.points, :, None] + np.arange(3)).reshape(len(blocks), -1)
            np.add.at(K, (axes[:, :, None], axes[:, None, :]), blocks)
        return K

    def inertia(self, explicit: bool):
        """The mass matrix (n,n) of explicit or implicit steps [kg]."""
        return np.diag(self.lumped[:, 0]) if explicit else self.mass

    def kinetic(self, v, explicit: bool) -> float:
        """Kinetic energy [J]."""
        return np.sum(v * (self.inertia(explicit) @ v)) / 2

    def weight(self, x, explicit: bool) -> float:
        """Energy of gravity [J], 0 at the origin."""
        return -np.sum(self.inertia(explicit) @ x @ self.gravity)

    def applied(self, explicit: bool = False):
        """Loads and weight (n,3) [N]."""
        return self.loads + self.inertia(explicit) @ np.broadcast_to(self.gravity, (self.n, 3))

    def total_force(self, x, v, damper=None, explicit: bool = False):
        """All but the constraints' forces (n,3) [N]; damper: the projected stiffness, where it is not that of x."""
        f = self.force(x) + self.applied(explicit) - self.mass_damping * (self.inertia(explicit) @ v)
        if self.stiffness_damping.any():
            damper = self.stiffness(x, projected=True) if damper is None else damper
            f = f - self.stiffness_damping * (damper @ v.reshape(-1)).reshape(-1, 3)
        return f

    # --- explicit steps ---------------------------------------------------------------------------------------------

    def symplectic_euler(self, dt: float) -> None:
        """v += dt a(x, v), x += dt v."""
        goal, prescribed = self.targets(self.time + dt)
        x, v, f = self.x, self.v, self.total_force(self.x, self.v, explicit=True)
        self.v = np.where(self.fixed | prescribed, 0.0, v + dt * f / self.lumped)
        self.v = np.where(prescribed, (goal - x) / dt, self.v)
        self.x = np.where(prescribed, goal, x + dt * self.v)
        self._react(f, v, dt)

    def velocity_verlet(self, dt: float) -> None:
        """Decay, half a kick, drift, force at the extrapolated velocity, half a kick, decay."""
        goal, prescribed = self.targets(self.time + dt)
        held, decay = self.fixed | prescribed, np.exp(-0.5 * dt * self.mass_damping)
        before, drag = self.v, self.mass_damping * self.lumped

        def accelerate(x, v):
            f = self.total_force(x, v, explicit=True) + drag * v  # the decay takes the place of that part
            return f, np.where(held, 0.0, f / self.lumped)

        a = accelerate(self.x, self.v)[1] if self.acceleration is None else self.acceleration
        half = decay * self.v + 0.5 * dt * a
        way = (goal - self.x) / dt
        x = np.where(prescribed, goal, self.x + dt * half)
        f, a = accelerate(x, np.where(prescribed, way, half + 0.5 * dt * a))
        self.v = np.where(prescribed, way, np.where(self.fixed, 0.0, decay * (half + 0.5 * dt * a)))
        self.x, self.acceleration = x, a
        self._react(f - drag * self.v, before, dt)

    def _react(self, f, v_before, dt: float) -> None:
        self.time += dt
        self.reactions = np.where(self._masks(), self.lumped * (self.v - v_before) / dt - f, 0.0)

    # --- implicit steps ---------------------------------------------------------------------------------------------

    def prescribed_v_hat(self, v_hat, way, prescribed, beta: float, dt: float, at_end: bool = False):
        """v_hat with that of led axes such that (way - v_hat) / beta is their acceleration, where the mass couples nodes.

        The acceleration is a second difference of the ways at shares of the step.
        """
        if np.count_nonzero(self.mass - np.diag(np.diag(self.mass))) == 0:
            return v_hat
        shares, weights = ((0, 1 / 3, 2 / 3, 1), (-9, 36, -45, 18)) if at_end else ((0, 0.5, 1), (4, -8, 4))
        acceleration = np.zeros((self.n, 3))
        for nodes, mask, path in self.prescribed:
            second = sum(w * np.asarray(path(self.time + share * dt)) for share, w in zip(shares, weights)) / dt**2
            acceleration[nodes] += np.where(mask[nodes], second, 0.0)
        return np.where(prescribed, way - beta * acceleration, v_hat)

    def implicit_euler(self, dt: float, at_end: bool = False) -> None:
        """M (v1 - v0) = dt f(x0 + dt v1, v1)."""
        goal, prescribed = self.targets(self.time + dt)
        x, v = self.x, self.v
        v_hat = self.prescribed_v_hat(v, (goal - x) / dt, prescribed, dt, dt, at_end)
        self.x, self.v = self._stage(x, v_hat, dt, goal, prescribed)
        self._end(x, v, dt)

    def implicit_midpoint(self, dt: float) -> None:
        """A stage of half the step, then as much again; led nodes change their velocity once a step, by half in the stage."""
        goal, prescribed = self.targets(self.time + dt)
        x, v, way = self.x, self.v, (goal - self.x) / dt
        v_hat = self.prescribed_v_hat(np.where(prescribed, (way + v) / 2, v), way, prescribed, dt / 2, dt)
        xm, vm = self._stage(x, v_hat, dt / 2, (goal + x) / 2, prescribed)
        self.x, self.v = 2 * xm - x, np.where(prescribed, way, 2 * vm - v)
        self._end(x, v, dt)

    def bdf2(self, dt: float) -> None:
        """x1 = 4/3 x0 - 1/3 x_(-1) + 2/3 dt v1, v1 alike; the first step is implicit Euler's."""
        goal, prescribed = self.targets(self.time + dt)
        if not self.past:
            return self.implicit_euler(dt, at_end=True)
        (older_x, older_v), x, v, beta = self.past[-1], self.x, self.v, 2 * dt / 3
        x_hat = (4 * x - older_x) / 3
        v_hat = self.prescribed_v_hat((4 * v - older_v) / 3, (goal - x_hat) / beta, prescribed, beta, dt, at_end=True)
        self.x, self.v = self._stage(x_hat, v_hat, beta, goal, prescribed)
        self._end(x, v, dt)

    def linearly_implicit_euler(self, dt: float) -> None:
        """(M + dt a M + dt^2 K + dt b K_d) w = M (v0 - u) + dt f(x, u), v1 = u + w; u and x: led nodes have gone, others stay."""
        goal, prescribed = self.targets(self.time + dt)
        free = ~(self.fixed | prescribed).reshape(-1)
        x, v, damper = self.x, self.v, self.stiffness(self.x, projected=True)
        start, way = np.where(prescribed, goal, x), np.where(prescribed, (goal - x) / dt, 0.0)
        old, v = v, self.prescribed_v_hat(v, way, prescribed, dt, dt)
        rhs = (self.mass @ (v - way) + dt * self.total_force(start, way, damper)).reshape(-1)
        self.v = way.copy()
        self.v[free.reshape(-1, 3)] = np.linalg.solve(self._system(dt, start, damper)[np.ix_(free, free)], rhs[free])
        self.x = np.where(prescribed, goal, x + dt * self.v)
        self._residual = self.mass @ (self.v - v) / dt - self.total_force(self.x, self.v, damper)
        self._end(x, old, dt)

    def _system(self, beta: float, x, damper):
        """M + beta a M + beta^2 K(x) + beta b K_d."""
        inertia = np.kron((1 + beta * self.mass_damping) * self.mass, np.eye(3))
        return inertia + beta**2 * self.stiffness(x) + beta * np.repeat(self.stiffness_damping, 3, axis=0) * damper

    def _stage(self, x_hat, v_hat, beta: float, goal, prescribed):
        """Solve M (v - v_hat) = beta f(x_hat + beta v, v) on the free axes by dense Newton."""
        held = self.fixed | prescribed
        free = ~held.reshape(-1)
        damper = self.stiffness(self.x, projected=True)
        v = np.where(prescribed, (goal - x_hat) / beta, np.where(held, 0.0, v_hat))
        for _ in range(50):
            x = x_hat + beta * v
            self._residual = self.mass @ (v - v_hat) / beta - self.total_force(x, v, damper)
            A = self._system(beta, x, damper)
            step = np.linalg.solve(A[np.ix_(free, free)], -beta * self._residual.reshape(-1)[free])
            v = v.reshape(-1).copy()
            v[free] += step
            v = v.reshape(-1, 3)
            if np.abs(step).max() <= 1e-13 * (np.abs(v).max() + 1e-300):
                return x_hat + beta * v, v
        raise AssertionError("the oracle's Newton did not converge: take a smaller step")

    def _end(self, x, v, dt: float) -> None:
        self.past.append((x, v))
        self.time += dt
        self.reactions = np.where(self._masks(), self._residual, 0.0)

    def equilibrium(self, x, load, free):
        """Positions (n,3) where dense Newton steps lead from x under a load (n,3) [N]; free: (3n,) bool."""
        for _ in range(50):
            K, f = self.stiffness(x)[np.ix_(free, free)], (self.force(x) + load).reshape(-1)[free]
            step = np.zeros(3 * self.n)
            step[free] = np.linalg.solve(K, f)
            x = x + step.reshape(-1, 3)
            if np.abs(step).max() <= 1e-12 * np.abs(x).max():
                return x
        raise AssertionError("the oracle's Newton did not converge: take smaller load steps")
