"""Linear vibration about the rest shape: Hooke stiffness, highest frequency, stable steps, eigenmodes. NumPy and SciPy.

Isotropic laws linearise to Hooke's law at F = I, so they share one stiffness: sigma = 2 mu eps + lambda tr(eps) I. With mean
dilatation tr(eps) is averaged over patches. Fibres add their own, as if they were taut. Explicit steps also resolve what a
volume floor adds to flat tets, and Maxwell branches, which are relaxed in modes.
"""

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from taisoft.display import short_repr
from taisoft.errors import SceneError
from taisoft.fem import reference
from taisoft.fem.dependent_table import DependentTable, dependent_table
from taisoft.fem.fibres import fibre_tangent, start_activation
from taisoft.fem.loads import SceneLoads
from taisoft.fem.spring_table import SpringTable, length_and_gradient
from taisoft.fem.springs import spring_table
from taisoft.scene import checks
from taisoft.scene.composition import Composition
from taisoft.scene.rigid import RigidBody
from taisoft.scene.scene import Body, Scene

MAX_WEIGHT_STRAIN = 0.5  # strain of a body under its own weight above which its scale is questioned
SMALL = 1e-3  # of the frequency and damping rate of connections: a frequency that does not change the limit these set
LANCZOS_MARGIN = 1.005  # Lanczos approaches the highest frequency from below; its tolerance is half this margin


def hooke_differential(body: Body, stiffest: bool = False):
    """Return v -> K v of one body at rest, matrix-free: a function (n,3) -> (n,3) [N per unit of v]. Fibres are fully active.

    stiffest: add what a volume floor delta adds to flat tets whose sides have their lengths at rest: at most 2/delta times the
    stiffness of each, with its own dilatation, see `laws.volume_floor`; and Maxwell branches that have not relaxed.
    """
    nodes, (mu, lam) = body.nodes.elements, body.composition.lame
    gradients, volumes = reference.shape_gradients(body)
    added, is_mean = _floor_stiffness(body) if stiffest else 0.0, body.dilatation == "mean"
    fractions = body.composition.branches[..., 1].sum(axis=1)
    branches = mu * (fractions if body.composition.elastic_by_tet else fractions[0]) if stiffest else 0.0
    local = lam - body.composition.dilatation_modulus if is_mean else 0.0
    mu, lam = mu * (1.0 + added) + branches, lam * (added if is_mean else 1.0 + added) + local - 2.0 / 3.0 * branches
    if body.composition.elastic_by_tet:  # one row for each quadrature point
        mu, lam = (np.repeat(np.broadcast_to(x, len(nodes)), volumes.shape[1])[:, None] for x in (mu, lam))
        mu = mu[:, :, None]
    patch_lam, average = _patch_average(body, volumes) if is_mean else (None, None)
    rows = gradients.swapaxes(2, 3)  # (m, p, 3, nodes of a tet): d/dX_j of v at each point; SciPy sums this layout fastest
    columns = np.broadcast_to(nodes[:, None, None, :], rows.shape)
    starts = np.arange(0, rows.size + 1, nodes.shape[1])
    gradient = sp.csr_matrix((rows.reshape(-1), columns.reshape(-1), starts), shape=(len(starts) - 1, body.n_nodes))
    divergence, weight = gradient.T.tocsr(), volumes.reshape(-1, 1, 1)
    if body.fibres is not None:
        a, B = (np.repeat(x, volumes.shape[1], axis=0) for x in (body.fibres, fibre_tangent(body, 1.0)))

    extra = body.composition.anisotropy
    extra = None if extra is None else np.repeat(extra, volumes.shape[1], axis=0)

    def apply(v: np.ndarray) -> np.ndarray:
        H = (gradient @ v).reshape(-1, 3, 3)
        P = mu * (H + H.transpose(0, 2, 1))
        theta = H[:, 0, 0] + H[:, 1, 1] + H[:, 2, 2]
        P[:, (0, 1, 2), (0, 1, 2)] += lam * theta[:, None]
        if is_mean:
            P[:, (0, 1, 2), (0, 1, 2)] += patch_lam * average(theta)[:, None]
        if extra is not None:
            P += (extra @ H.reshape(-1, 9, 1)).reshape(-1, 3, 3)
        if body.fibres is not None:
            P += (B @ H @ a[:, :, None]) * a[:, None]
        return divergence @ (weight * P).reshape(-1, 3)

    return apply


def _floor_stiffness(body: Body) -> np.ndarray:
    """2/delta of a body's tets with a volume floor delta, 0 of those without one: one number, or (m,)."""
    floor = np.asarray(body.composition.number("volume_floor"))
    return np.where(floor > 0.0, 2.0 / np.where(floor > 0.0, floor, 1.0), 0.0)


def _patch_average(body: Body, volumes: np.ndarray):
    """Return lambda (m p, 1) at all quadrature points and the function that averages values (m p,) over patches.

    volumes: (m, p) of the points.
    """
    patch = reference.tet_patches(body)
    of_point, weights = np.repeat(patch, volumes.shape[1]), volumes.reshape(-1)
    total = np.bincount(of_point, weights)
    lam = reference.patch_moduli(body, patch)[of_point][:, None]
    return lam, lambda theta: (np.bincount(of_point, weights * theta) / total)[of_point]


def hooke_stiffness(body: Body) -> sp.csr_matrix:
    """Stiffness matrix (3n, 3n) of one body at rest [N/m]. Fibres are as active as at the start."""
    nodes, (mu, lam) = body.nodes.elements, body.composition.lame
    mu, lam = (np.reshape(x, (-1, 1, 1, 1, 1)) for x in (mu, lam))
    gradients, volumes = reference.shape_gradients(body)
    # G_ab = sum_q V_q ga gb^T, and K_ab = mu (tr(G_ab) I + G_ab^T) + lambda G_ab
    G = np.einsum("eq,eqai,eqbj->eabij", volumes, gradients, gradients, optimize=True)
    is_mean = body.dilatation == "mean"
    lam = lam - np.reshape(body.composition.dilatation_modulus, (-1, 1, 1, 1, 1)) if is_mean else lam
    K = mu * (np.einsum("eabii->eab", G)[..., None, None] * np.eye(3) + G.swapaxes(3, 4)) + lam * G
    if (extra := body.composition.anisotropy) is not None:
        extra = extra.reshape(-1, 3, 3, 3, 3)
        K = K + np.einsum("eq,eqaj,eqbl,eijkl->eabik", volumes, gradients, gradients, extra, optimize=True)
    if body.fibres is not None:
        along = np.einsum("eqai,ei->eqa", gradients, body.fibres)
        B = fibre_tangent(body, start_activation(body))
        K = K + np.einsum("eq,eqa,eqb,eij->eabij", volumes, along, along, B, optimize=True)
    dof = 3 * nodes[:, :, None] + np.arange(3)
    rows = np.broadcast_to(dof[:, :, None, :, None], K.shape)
    columns = np.broadcast_to(dof[:, None, :, None, :], K.shape)
    size = 3 * body.n_nodes
    local = sp.csr_matrix((K.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape=(size, size))
    return local + _patch_stiffness(body, np.einsum("eq,eqai->eai", volumes, gradients), dof) if is_mean else local


def _patch_stiffness(body: Body, divergence: np.ndarray, dof: np.ndarray) -> sp.csr_matrix:
    """Stiffness matrix of the patches' mean dilatations. divergence: (m, a, 3) of each tet by its nodes, dof: (m, a, 3)."""
    patch = reference.tet_patches(body)
    rows = np.broadcast_to(patch[:, None, None], dof.shape).reshape(-1)
    D = sp.csr_matrix((divergence.reshape(-1), (rows, dof.reshape(-1))), shape=(int(patch.max()) + 1, 3 * body.n_nodes))
    return D.T @ sp.diags(reference.patch_moduli(body, patch) / np.bincount(patch, reference.rest_volumes(body))) @ D


def constrained_axes(body: Body, prescribed: bool, scene: Scene | None = None) -> np.ndarray:
    """Constrained axes (n, 3), bool: the fixed ones, and if `prescribed` those that follow a path too.

    scene: of which exact attachments to obstacles count as well.
    """
    constrained = np.zeros((body.n_nodes, 3), dtype=bool)
    for c in body.constraints if scene is None else scene.constraints(body):
        if prescribed or c.path is None:
            constrained[np.ix_(c.nodes, np.flatnonzero(c.axes))] = True
    return constrained


_frequencies: "WeakKeyDictionary[Composition, dict[tuple, float]]" = WeakKeyDictionary()  # compositions are immutable


def highest_frequency(body: Body) -> float:
    """omega_max [rad/s] that explicit steps of a body must resolve, by Lanczos; overestimated by a fraction of a percent.

    It is that at rest with lumped mass, of bodies that are as stiff as they may be, see `hooke_differential`.
    Fibres count as fully active; what their exponential adds under strain is left out.
    """
    free = ~constrained_axes(body, prescribed=False)  # a path may release its nodes
    free[body.nodes.n_elastic :] = False
    known = _frequencies.setdefault(body.composition, {})  # also asked for when a simulator's settings change
    key = body.order, body.quadrature_degree, body.dilatation, free.tobytes()
    if key not in known:
        known[key] = _highest_frequency(body, free)
    return known[key]


def _highest_frequency(body: Body, free: np.ndarray) -> float:
    """`highest_frequency` [rad/s], computed. free: (n,3) axes."""
    mass = reference.lumped_mass(body)
    scale = np.where(free, 1.0 / np.sqrt(np.where(free, mass[:, None], 1.0)), 0.0)
    if not free.any():
        return 0.0
    apply = hooke_differential(body, stiffest=True)
    size = scale.size
    operator = spl.LinearOperator(
        (size, size), matvec=lambda y: (scale * apply(scale * y.reshape(-1, 3))).reshape(-1), dtype=np.float64
    )
    start = np.random.default_rng(0).normal(size=size) * free.reshape(-1)
    if size <= 60:
        dense = np.stack([operator.matvec(e) for e in np.eye(size)])
        return LANCZOS_MARGIN * float(np.sqrt(np.linalg.eigvalsh(0.5 * (dense + dense.T))[-1]))
    top = spl.eigsh(operator, k=1, which="LA", tol=0.5 * (LANCZOS_MARGIN - 1.0), v0=start, return_eigenvectors=False)
    return LANCZOS_MARGIN * float(np.sqrt(top[0]))


def scale_warnings(scene: Scene) -> list[str]:
    """One warning for each body whose own weight would crush it, such as a mesh in millimetres read as metres."""
    warnings = []
    for body in scene.bodies:
        size = float(np.ptp(body.rest_positions, axis=0).max())
        mass, volume, gravity = body.mass, float(body.volumes.sum()), float(np.linalg.norm(scene.gravity))
        young = volume / float(np.sum(body.volumes / body.composition.number("young")))  # of layers in series
        strain = mass / volume * gravity * size / young
        if strain > MAX_WEIGHT_STRAIN:
            crossing = size / np.sqrt(young * volume / mass)
            warnings.append(
                f"body '{body.name}': {size:.4g} m long and {mass:.3g} kg, its own weight strains it by about {strain:.2g}; "
                f"a wave crosses it in {crossing:.2g} s, explicit steps must stay below "
                f"{2.0 / highest_frequency(body):.2g} s: is the mesh in metres and young in pascals?"
            )
    return warnings


def _euler_matrix(z: float, alpha: float, beta: float) -> np.ndarray:
    """Matrix of a symplectic Euler step of (x, dt v). z: omega dt; alpha, beta: dt times the mass and stiffness damping rate."""
    v = np.array([-z * z, 1.0 - alpha - beta])
    return np.array([[1.0, 0.0], [0.0, 0.0]]) + np.array([v, v])


def _verlet_matrix(z: float, alpha: float, beta: float) -> np.ndarray:
    """Matrix of a velocity Verlet step of (x, dt v, dt^2 a), as in dynamics/explicit.py."""
    decay = np.exp(-0.5 * alpha)
    half = np.array([0.0, decay, 0.5])
    x = np.array([1.0, 0.0, 0.0]) + half
    a = -z * z * x - beta * (half + np.array([0.0, 0.0, 0.5]))
    v = decay * (half + 0.5 * a)
    return np.stack([x, v, a])


def stable_dt(scene: Scene, verlet: bool) -> float:
    """Largest stable step [s] of an explicit integrator about the rest shape; infinite if nothing can vibrate.

    It is 2/omega_max without damping, else the dt at which an eigenvalue of the step matrix leaves the unit disk; omega_max from
    `highest_frequency`. Rigid bodies have none of their own. Springs add their own largest omega^2 and damping rate to those of
    the bodies that they connect, and nodes attached exactly multiply omega by `DependentTable.growth`, which are upper bounds.
    """
    limit = np.inf
    connected = {owner for one in scene.connections for owner in one.owners}
    dependents = dependent_table(scene)
    square, rate = spring_rates(scene, dependents) if connected else (0.0, 0.0)
    elastic = np.concatenate([np.arange(body.n_nodes) < body.nodes.n_elastic for body in scene.bodies])
    growth = 1.0 if dependents is None else dependents.growth(elastic)
    for body in scene.bodies:
        material, own_square, own_rate = body.composition.first, 0.0, 0.0
        if isinstance(body, RigidBody):  # explicit steps move it as one
            omega = SMALL * (np.sqrt(square) + rate) if body.name in connected else 0.0
        else:
            omega = highest_frequency(body)
        if omega > 0.0:
            if body.name in connected:
                omega, own_square, own_rate = growth * omega, square, rate
            own_rate += material.stiffness_damping * omega**2
            limit = min(limit, _stable_dt_of(np.sqrt(omega**2 + own_square), material.mass_damping, own_rate, verlet))
    return float(limit)


def spring_rates(scene: Scene, dependents: DependentTable | None) -> tuple[float, float]:
    """Upper bounds of the largest omega^2 [1/s^2] and damping rate [1/s] that springs alone give the nodes at the start.

    Each acts as if it had its stiffness, or its tension over its length if that is larger, in all directions. Each segment of
    an elastic tendon has its stiffness times the number of segments, a bound wherever the points are.
    """
    table = spring_table(scene, dependents)
    if table is None:
        return 0.0, 0.0
    amplitudes = SceneLoads(scene, table).amplitudes([0.0])[0]
    length, _ = length_and_gradient(table.vectors(_start_positions(scene), amplitudes), table.smoothing)
    tension = table.stretching(length, amplitudes) + table.given(amplitudes)
    stiffness = table.stiffness * np.diff(table.line_start)[table.line]
    largest = np.maximum(stiffness, tension / np.where(tension > 0.0, length, 1.0))
    masses = reference.lumped_masses(scene, dependents)
    scaled = sp.csr_matrix((table.weight / np.sqrt(masses[table.node]), table.node, table.start))
    return tuple(_largest_eigenvalue(scaled, weights) for weights in (largest, table.damping))


def _start_positions(scene: Scene) -> np.ndarray:
    return np.concatenate([body.rest_positions + body.position for body in scene.bodies])


def _largest_eigenvalue(rows: sp.csr_matrix, weights: np.ndarray) -> float:
    """Upper bound of the largest eigenvalue of sum_e w_e r_e^T r_e, within a percent."""
    if not weights.any():
        return 0.0
    rows = sp.diags(np.sqrt(weights)) @ rows
    gram = (rows @ rows.T).tocsr()  # has the same one
    if gram.shape[0] <= 100:
        return float(np.linalg.eigvalsh(gram.toarray())[-1])
    start = np.random.default_rng(0).normal(size=gram.shape[0])
    top = spl.eigsh(gram, k=1, which="LA", tol=LANCZOS_MARGIN - 1.0, v0=start, return_eigenvectors=False)
    return LANCZOS_MARGIN**2 * float(top[0])


def spring_stiffness(scene: Scene, table: SpringTable) -> sp.csr_matrix:
    """Stiffness matrix (3n, 3n) of a scene's springs, tendons and attachments at the start [N/m]."""
    amplitudes = SceneLoads(scene, table).amplitudes([0.0])[0]
    e = table.vectors(_start_positions(scene), amplitudes)
    C = sp.kron(table.rows, sp.identity(3), format="csr")
    return (C.T @ table.stiffness_matrix(e, amplitudes) @ C).tocsr()


def _stable_dt_of(omega: float, mass_damping: float, damping_rate: float, verlet: bool) -> float:
    if mass_damping == 0.0 and damping_rate == 0.0:
        return 2.0 / omega
    step = _verlet_matrix if verlet else _euler_matrix

    def stable(dt: float) -> bool:
        matrix = step(omega * dt, mass_damping * dt, damping_rate * dt)
        return np.abs(np.linalg.eigvals(matrix)).max() <= 1.0 + 1e-9

    low, high = 0.0, 2.0 / omega
    while stable(high):  # mass damping can raise the limit
        low, high = high, 2.0 * high
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


class Modes(NamedTuple):
    """frequencies (k,) [Hz], ascending; shapes (k, n_nodes, 3), each with unit modal mass, bodies in the order added."""

    frequencies: np.ndarray
    shapes: np.ndarray

    __repr__ = short_repr


def modes(scene: Scene, k: int, mass: str = "lumped") -> Modes:
    """The lowest k eigenfrequencies [Hz] and shapes of a scene at rest, with its constraints; rigid motions count as 0 Hz.

    mass: "lumped" or "consistent". Maxwell branches are relaxed. Springs and tendons act as they do at the start: an elastic
    tendon that is slack there does not. Raises SceneError for an invalid k or mass, and for an inextensible tendon, whose tension
    there is unknown.
    """
    checks.choice(mass, "modes: mass", ("lumped", "consistent"))
    if not scene.bodies:
        raise SceneError("the scene holds no body")
    scene.check()
    for tendon in [one for one in scene.tendons if one.is_inextensible]:
        raise SceneError(f"modes: tendon {tendon.name!r} has a given length, but no stiffness: give it one")
    scene = scene.snapshot()  # in which rigid bodies are as stiff as the others ask for
    free = np.concatenate([~constrained_axes(b, prescribed=True, scene=scene) for b in scene.bodies]).reshape(-1)
    dependents = dependent_table(scene)
    T = sp.identity(len(free), format="csr") if dependents is None else sp.kron(dependents.matrix, sp.identity(3), format="csr")
    if dependents is not None:
        free.reshape(-1, 3)[dependents.node] = False
    n_free = int(free.sum())
    checks.whole(k, f"modes: k ({n_free} axes are free)", range(1, n_free + 1))
    K = sp.block_diag([hooke_stiffness(b) for b in scene.bodies], format="csr")
    table = spring_table(scene, dependents)
    K = K if table is None else K + spring_stiffness(scene, table)
    K = (T.T @ K @ T)[free][:, free]
    if mass == "lumped":
        M = sp.diags(np.repeat(reference.lumped_masses(scene, dependents), 3)[free], format="csc")
    else:
        scalar = sp.block_diag([reference.consistent_mass(b) for b in scene.bodies])
        M = (T.T @ sp.kron(scalar, sp.identity(3), format="csr") @ T)[free][:, free]
    noise = _eigenvalue_noise(
        K, M, np.concatenate([np.full(3 * b.n_nodes, isinstance(b, RigidBody)) for b in scene.bodies])[free]
    )
    if n_free <= max(200, 2 * k):
        values, vectors = _dense_modes(K, M, k)
    else:
        # shift slightly below 0, so that the matrix of free bodies (K singular) can be factorised too
        shift = -1e3 * noise
        start = np.random.default_rng(0).normal(size=n_free)
        values, vectors = spl.eigsh(K.tocsc(), k=int(k), M=M.tocsc(), sigma=shift, which="LM", v0=start)
    order = np.argsort(values)
    shapes = np.zeros((int(k), free.size))
    shapes[:, free] = vectors[:, order].T
    shapes = shapes @ T.T
    eigenvalues = np.where(np.abs(values[order]) < noise, 0.0, values[order])
    return Modes(np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi), shapes.reshape(int(k), -1, 3))


def _eigenvalue_noise(K, M, rigid: np.ndarray) -> float:
    """Eigenvalue [1/s^2] up to which one counts as rounding error of a rigid motion. rigid: (n,) axes of rigid bodies, which are
    so stiff that a bound for them like that of the others would hide slow modes."""
    stiffness, mass = K.diagonal(), M.diagonal()
    soft = 1e-9 * stiffness[~rigid].max(initial=0.0) / mass.max()
    return max(soft, 1e-13 * (stiffness[rigid] / mass[rigid]).max(initial=0.0))


def _dense_modes(K, M, k: int) -> tuple[np.ndarray, np.ndarray]:
    from scipy.linalg import eigh

    return eigh(K.toarray(), M.toarray(), subset_by_index=[0, int(k) - 1])
