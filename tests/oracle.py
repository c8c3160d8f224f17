"""What taisoft should compute, once more: dense NumPy written from the formulas, slow and independent of the package.

It reads a `Scene`'s plain records and shares no formula with the package: shape gradients come from inverting the
matrix (1, X), the corotational rotation from NumPy's SVD, derivatives of the other laws from complex steps, the
projection from the eigenvalues of the 9x9 second derivative, implicit steps from dense Newton.
"""

import numpy as np

LAW_NAMES = ("st_venant_kirchhoff", "corotational", "stable_neo_hookean")
UNIT = np.eye(9).reshape(9, 3, 3)  # the nine directions in which F can change


def lame(young: float, poisson: float) -> tuple[float, float]:
    """(mu, lambda) [Pa]."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def transposed(A):
    return np.swapaxes(A, -1, -2)


def trace(A):
    return np.trace(A, axis1=-2, axis2=-1)


def cofactor(F):
    """Columns f1 x f2, f2 x f0, f0 x f1."""
    f = [F[..., k] for k in range(3)]
    return np.stack([np.cross(f[1], f[2]), np.cross(f[2], f[0]), np.cross(f[0], f[1])], axis=-1)


def signed_svd(F):
    """F = U diag(s) V^T with rotations U and V; the smallest s is negative where F is inverted."""
    U, s, Vt = np.linalg.svd(F)
    s = s.copy()
    for A, part in ((U, np.s_[..., :, 2]), (Vt, np.s_[..., 2, :])):
        flip = np.linalg.det(A) < 0
        A[part] = np.where(flip[..., None], -A[part], A[part])
        s[..., 2] = np.where(flip, -s[..., 2], s[..., 2])
    return U, s, transposed(Vt)


def rotation(F):
    """The rotation of the polar decomposition, det +1."""
    U, _, V = signed_svd(F)
    return U @ transposed(V)


def psi(law: str, F, young: float, poisson: float):
    """Energy density (k,) [Pa], 0 at rest, of F (k,3,3)."""
    mu, lam = lame(young, poisson)
    if law == "st_venant_kirchhoff":
        E = (transposed(F) @ F - np.eye(3)) / 2
        return mu * np.sum(E * E, axis=(-2, -1)) + lam / 2 * trace(E) ** 2
    if law == "corotational":
        R = rotation(F)
        return mu * np.sum((F - R) ** 2, axis=(-2, -1)) + lam / 2 * (trace(transposed(R) @ F) - 3) ** 2
    m, l, alpha = _neo_hookean(mu, lam)

    def value(Ic, J):
        return m / 2 * (Ic - 3) + l / 2 * (J - alpha) ** 2 - m / 2 * np.log(Ic + 1)

    return value(np.sum(F * F, axis=(-2, -1)), np.linalg.det(F)) - value(3.0, 1.0)


def _neo_hookean(mu: float, lam: float) -> tuple[float, float, float]:
    m, l = 4 * mu / 3, lam + 5 * mu / 6
    return m, l, 1 + m / l - m / (4 * l)


def pk1(law: str, F, young: float, poisson: float):
    """First Piola-Kirchhoff stress (k,3,3) [Pa]; F may be complex but for the corotational law."""
    mu, lam = lame(young, poisson)
    if law == "st_venant_kirchhoff":
        E = (transposed(F) @ F - np.eye(3)) / 2
        return F @ (2 * mu * E + lam * trace(E)[..., None, None] * np.eye(3))
    if law == "corotational":
        R = rotation(F)
        return 2 * mu * (F - R) + lam * (trace(transposed(R) @ F) - 3)[..., None, None] * R
    m, l, alpha = _neo_hookean(mu, lam)
    G = cofactor(F)
    Ic = np.sum(F * F, axis=(-2, -1))[..., None, None]
    J = np.sum(F[..., 0] * G[..., 0], axis=-1)[..., None, None]
    return m * (1 - 1 / (Ic + 1)) * F + l * (J - alpha) * G


def dpk1(law: str, F, D, young: float, poisson: float):
    """Change of the stress along D (k,3,3) [Pa]."""
    if law != "corotational":
        h = 1e-30  # a complex step has no cancellation
        return pk1(law, F + 1j * h * D, young, poisson).imag / h
    mu, lam = lame(young, poisson)
    U, s, V = signed_svd(F)
    X = transposed(U) @ D @ V
    R = U @ transposed(V)
    # dR = U W V^T with the antisymmetric W_ij = (X_ij - X_ji) / (s_i + s_j), 0 on the diagonal
    W = (X - transposed(X)) / np.where(np.eye(3, dtype=bool), 1.0, s[..., :, None] + s[..., None, :])
    t = (trace(transposed(R) @ F) - 3)[..., None, None]
    return 2 * mu * D + (lam * t - 2 * mu) * (U @ W @ transposed(V)) + lam * trace(X)[..., None, None] * R


def hessian(law: str, F, young: float, poisson: float, projected: bool = False):
    """Second derivative (k,9,9) [Pa] of psi over F's entries row by row; projected: negative eigenvalues become 0."""
    columns = [dpk1(law, F, np.broadcast_to(D, F.shape), young, poisson).reshape(-1, 9) for D in UNIT]
    H = np.stack(columns, axis=-1)
    if not projected:
        return H
    w, Q = np.linalg.eigh((H + transposed(H)) / 2)
    return (Q * np.maximum(w, 0.0)[:, None, :]) @ transposed(Q)


class Oracle:
    """A scene's bodies as dense arrays, and every integrator as one short method."""

    def __init__(self, scene):
        self.gravity = scene.gravity
        self.parts, start, mass, loads = [], 0, [], []
        for body in scene.bodies:
            X, tets, material = body.mesh.vertices, body.mesh.tets, body.material
            corners = np.concatenate([np.ones((len(tets), 4, 1)), X[tets]], axis=2)
            gradients = transposed(np.linalg.inv(corners)[:, 1:, :])  # (m,4,3): N_a = c_a + gradient_a . X
            volumes = np.abs(np.linalg.det(corners)) / 6
            self.parts.append((tets + start, gradients, volumes, material))
            mass.append(np.zeros(len(X)))
            for tet, volume in zip(tets, volumes):
                mass[-1][tet] += material.density * volume / 4
            loads.append(_loads(body, mass[-1]))
            start += len(X)
        self.n = start
        self.mass, self.loads = np.concatenate(mass)[:, None], np.concatenate(loads)
        self.rest = np.concatenate([b.mesh.vertices + b.position for b in scene.bodies])
        self.x = self.rest.copy()
        self.v = np.concatenate([np.broadcast_to(b.velocity, b.mesh.vertices.shape) for b in scene.bodies])
        rates = [(b.material.mass_damping, b.material.stiffness_damping) for b in scene.bodies]
        counts = [len(b.mesh.vertices) for b in scene.bodies]
        self.mass_damping, self.stiffness_damping = (np.repeat([r[k] for r in rates], counts)[:, None] for k in (0, 1))
        self._hold(scene)
        self.time, self.past, self.acceleration = 0.0, [], None

    def _hold(self, scene) -> None:
        self.fixed, self.led, start = np.zeros((self.n, 3), dtype=bool), [], 0
        for body in scene.bodies:
            for c in body.constraints:
                mask = np.zeros((self.n, 3), dtype=bool)
                mask[np.ix_(c.nodes + start, np.flatnonzero(c.axes))] = True
                if c.path is None:
                    self.fixed |= mask
                else:
                    self.led.append((c.nodes + start, mask, c.path))
            start += len(body.mesh.vertices)
        self.v = np.where(~self._masks(), self.v, 0.0)

    def _masks(self):
        mask = self.fixed.copy()
        for _, led, _ in self.led:
            mask |= led
        return mask

    def targets(self, t: float):
        """(positions, mask) of the led axes at a time; groups that let go are dropped, and the past with them."""
        where, mask = self.rest.copy(), np.zeros((self.n, 3), dtype=bool)
        still = [group for group in self.led if group[2](t) is not None]
        if len(still) < len(self.led):
            self.led, self.past, self.acceleration = still, [], None
        for nodes, led, path in self.led:
            way = np.zeros((self.n, 3))
            way[nodes] = path(t)
            where = where + np.where(led, way, 0.0)
            mask |= led
        return where, mask

    # --- elasticity -------------------------------------------------------------------------------------------------

    def gradients(self, x, part):
        tets, g, _, _ = part
        return np.einsum("eai,eaj->eij", x[tets], g)

    def energy(self, x) -> float:
        """Elastic energy [J]."""
        total = 0.0
        for part in self.parts:
            _, _, V, m = part
            total += V @ psi(m.law, self.gradients(x, part), m.young, m.poisson)
        return total

    def force(self, x):
        """Elastic forces (n,3) [N]."""
        f = np.zeros((self.n, 3))
        for part in self.parts:
            tets, g, V, m = part
            P = pk1(m.law, self.gradients(x, part), m.young, m.poisson)
            np.subtract.at(f, tets, np.einsum("e,eij,eaj->eai", V, P, g))
        return f

    def stiffness(self, x, projected: bool = False):
        """-df/dx as a dense (3n,3n) matrix [N/m]."""
        K = np.zeros((self.n, 3, self.n, 3))
        for part in self.parts:
            tets, g, V, m = part
            H = hessian(m.law, self.gradients(x, part), m.young, m.poisson, projected).reshape(-1, 3, 3, 3, 3)
            blocks = np.einsum("e,eaj,eijkl,ebl->eaibk", V, g, H, g)
            for tet, block in zip(tets, blocks):
                for a in range(4):
                    for b in range(4):
                        K[tet[a], :, tet[b], :] += block[a, :, b, :]
        return K.reshape(3 * self.n, 3 * self.n)

    def total_force(self, x, v, damper=None):
        """All but the constraints' forces (n,3) [N]; damper: the projected stiffness, where it is not that of x."""
        f = self.force(x) + self.loads + self.mass * self.gravity - self.mass_damping * self.mass * v
        if self.stiffness_damping.any():
            damper = self.stiffness(x, projected=True) if damper is None else damper
            f = f - self.stiffness_damping * (damper @ v.reshape(-1)).reshape(-1, 3)
        return f

    # --- explicit steps ---------------------------------------------------------------------------------------------

    def symplectic_euler(self, dt: float) -> None:
        """v += dt a(x, v), x += dt v."""
        goal, led = self.targets(self.time + dt)
        x, v, f = self.x, self.v, self.total_force(self.x, self.v)
        self.v = np.where(self.fixed | led, 0.0, v + dt * f / self.mass)
        self.v = np.where(led, (goal - x) / dt, self.v)
        self.x = np.where(led, goal, x + dt * self.v)
        self._react(f, v, dt)

    def velocity_verlet(self, dt: float) -> None:
        """Decay, half a kick, drift, force at the extrapolated velocity, half a kick, decay."""
        goal, led = self.targets(self.time + dt)
        held, decay = self.fixed | led, np.exp(-0.5 * dt * self.mass_damping)
        before = self.v

        def accelerate(x, v):
            f = self.total_force(x, v) + self.mass_damping * self.mass * v  # the decay takes the place of that part
            return f, np.where(held, 0.0, f / self.mass)

        a = accelerate(self.x, self.v)[1] if self.acceleration is None else self.acceleration
        half = decay * self.v + 0.5 * dt * a
        way = (goal - self.x) / dt
        x = np.where(led, goal, self.x + dt * half)
        f, a = accelerate(x, np.where(led, way, half + 0.5 * dt * a))
        self.v = np.where(led, way, np.where(self.fixed, 0.0, decay * (half + 0.5 * dt * a)))
        self.x, self.acceleration = x, a
        self._react(f - self.mass_damping * self.mass * self.v, before, dt)

    def _react(self, f, v_before, dt: float) -> None:
        self.time += dt
        self.reactions = np.where(self._masks(), self.mass * (self.v - v_before) / dt - f, 0.0)

    # --- implicit steps ---------------------------------------------------------------------------------------------

    def implicit_euler(self, dt: float) -> None:
        """M (v1 - v0) = dt f(x0 + dt v1, v1)."""
        goal, led = self.targets(self.time + dt)
        x, v = self.x, self.v
        self.x, self.v = self._stage(x, v, dt, goal, led)
        self._end(x, v, dt)

    def implicit_midpoint(self, dt: float) -> None:
        """A stage of half the step, then as much again."""
        goal, led = self.targets(self.time + dt)
        x, v = self.x, self.v
        xm, vm = self._stage(x, v, dt / 2, (goal + x) / 2, led)
        self.x, self.v = 2 * xm - x, np.where(led, (goal - x) / dt, 2 * vm - v)
        self._end(x, v, dt)

    def bdf2(self, dt: float) -> None:
        """x1 = 4/3 x0 - 1/3 x_(-1) + 2/3 dt v1, v1 alike; the first step is implicit Euler's."""
        goal, led = self.targets(self.time + dt)
        if not self.past:
            return self.implicit_euler(dt)
        (older_x, older_v), x, v = self.past[-1], self.x, self.v
        self.x, self.v = self._stage((4 * x - older_x) / 3, (4 * v - older_v) / 3, 2 * dt / 3, goal, led)
        self._end(x, v, dt)

    def linearly_implicit_euler(self, dt: float) -> None:
        """(M + dt a M + dt^2 K + dt b K_d) v1 = M v0 + dt f(x), f linearised where led nodes have gone and others stay."""
        goal, led = self.targets(self.time + dt)
        free = ~(self.fixed | led).reshape(-1)
        x, v, damper = self.x, self.v, self.stiffness(self.x, projected=True)
        start, way = np.where(led, goal, x), np.where(led, (goal - x) / dt, 0.0)
        rhs = (self.mass * v + dt * self.total_force(start, way, damper)).reshape(-1)
        self.v = way.copy()
        self.v[free.reshape(-1, 3)] = np.linalg.solve(self._system(dt, start, damper)[np.ix_(free, free)], rhs[free])
        self.x = np.where(led, goal, x + dt * self.v)
        self._residual = self.mass * (self.v - v) / dt - self.total_force(self.x, self.v, damper)
        self._end(x, v, dt)

    def _system(self, beta: float, x, damper):
        """M + beta a M + beta^2 K(x) + beta b K_d."""
        inertia = np.repeat(self.mass * (1 + beta * self.mass_damping), 3, axis=1).reshape(-1)
        b = np.repeat(self.stiffness_damping, 3, axis=1).reshape(-1, 1)
        return np.diag(inertia) + beta**2 * self.stiffness(x) + beta * b * damper

    def _stage(self, x_hat, v_hat, beta: float, goal, led):
        """Solve M (v - v_hat) = beta f(x_hat + beta v, v) on the free axes by dense Newton."""
        held = self.fixed | led
        free = ~held.reshape(-1)
        damper = self.stiffness(self.x, projected=True)
        v = np.where(led, (goal - x_hat) / beta, np.where(held, 0.0, v_hat))
        for _ in range(50):
            x = x_hat + beta * v
            self._residual = self.mass * (v - v_hat) / beta - self.total_force(x, v, damper)
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


def _loads(body, mass):
    """Nodal forces (n,3) of the tractions (a third of a triangle's to each corner) and of the forces (by mass)."""
    f = np.zeros((len(mass), 3))
    for traction in body.tractions:
        for triangle in body.mesh.surface[traction.triangles]:
            a, b, c = body.mesh.vertices[triangle]
            f[triangle] += traction.value * np.linalg.norm(np.cross(b - a, c - a)) / 2 / 3
    for force in body.forces:
        for node in force.nodes:
            f[node] += force.value * mass[node] / mass[force.nodes].sum()
    return f
