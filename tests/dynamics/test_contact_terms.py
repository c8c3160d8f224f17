"""Contact terms of an implicit stage, compared with NumPy, for contacts of all states between two bodies and with obstacles:

* impulses, velocities and the residual of the contact laws follow their formulas; those whose sides turn open at once;
* the derivative of the impulses is minus the blocks of the matrix;
* conjugate gradients with the factored J^T D J, serial and parallel, find the solution of a dense solver;
* the r-factors follow from the matrix's diagonal; the residual contains -J^T p; a linearised stage is linear;
* Anderson extrapolation of multipliers is that of least squares, also beside contacts that cannot move.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.contact.problem import build_node_problem, fill_field, fill_rows, find_factors, index_nodes
from taisoft.contact.targets import set_targets
from taisoft.dynamics import contact_terms, linearised
from taisoft.dynamics.contact_terms import NO_CONTACTS
from taisoft.dynamics.dirichlet import DirichletConditions
from taisoft.dynamics.friction import extrapolate_multipliers
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.simulation_state import SimulationState
from taisoft.dynamics.stage import AGAIN, ELASTIC_STAGE, STAY, STEP, form_residual, move
from taisoft.dynamics.stage_system import StageSystem
from taisoft.fem.state import END_SLOPE, LAW, N_NORMS, NORMS, START_SLOPE, STEP_LENGTH
from taisoft.linear import block_csr, gauss_seidel
from taisoft.linear.block_csr import to_bsr, unpacked
from tests.contact import contact_oracle as oracle
from tests.dynamics.scenes import built, cube, rubber

K, BETA, DT = 24, 0.002, 0.003  # contacts; [s]
TOLERANCE = 1e-12  # of the contact laws: so small that missed gaps do not count
GAP_TARGETS = 1e-3, 0.2, 0.02, 0.05  # contact offset [m], fractions corrected in a step, maximum speed of that [m/s]
STIFFNESS = 5.0
CLOSE = 1e-12  # relative rounding
FIXED = [0, 7]  # nodes


@pytest.fixture(scope="module")
def rig():
    scene = ts.Scene()
    for k in range(2):
        scene.add_body(cube(cells=(2, 1, 1)), rubber(), position=(0, 3.0 * k, 0))
    with built(scene, "f64") as made:
        m, arena, rng = made.model, made.arena, np.random.default_rng(3)
        free = np.ones((m.n_nodes, 3))
        free[FIXED] = 0.0
        m.free.from_numpy(free)
        contacts = oracle.random_contacts(5, K, m.n_nodes - 4)  # none at the last nodes
        contacts.arity[::5] = (contacts.weight[::5] > 0).sum(axis=1)  # against an obstacle
        p = build_node_problem(arena, K + 3, m.n_nodes, True, oracle.NODES * K)
        simulation = SimulationState(scene, made.machine, arena, m, made.layout, DirichletConditions(scene, made.layout))
        solver = StageSystem(simulation, NoContacts())
        k = contact_terms.build_stage_contacts(arena, m, p, arena.vectors("x_start", ti.f64, m.n_nodes))
        fill_rows(p, contacts.arity, *contacts.entries[1:])
        for name in ("normal", "tangent"):
            fill_field(getattr(p, name), getattr(contacts, name))
        obstacle_displacement = np.where((np.arange(K) % 5 == 0)[:, None], 1e-3 * rng.standard_normal((K, 3)), 0.0)
        friction, gap = np.where(np.arange(K) % 7 == 0, 0.0, 0.5), rng.uniform(-2, 3, K) * GAP_TARGETS[0]
        apart = np.tile([0, 1], (K, 1))  # self-contacts have other targets
        fields = (p.friction, p.gap, p.obstacle_displacement, p.body, p.load)
        loaded = np.ones(K)  # so that gaps open
        for field, values in zip(fields, (friction, gap, obstacle_displacement, apart, loaded)):
            fill_field(field, values)
        index_nodes(p)
        block_csr.assemble(m, solver.matrix, False)
        block_csr.to_system(m, solver.matrix, solver.matrix, 0, 1.0, BETA)
        contact_terms.save_diagonal(m, solver.matrix, k)
        find_factors(p)
        A = to_bsr(m, solver.matrix).toarray()
        found = replace(contacts, inverse_mass=np.zeros((m.n_nodes, 3)), friction=friction)
        start = made.oracle.rest
        x_hat, x = (start + size * rng.standard_normal(start.shape) for size in (1e-4, 1e-3))
        k.x_start.from_numpy(start)
        solver.work.x_hat.from_numpy(x_hat)
        set_targets(p, DT, *GAP_TARGETS)
        contact_terms.begin_contacts(solver.model, solver.work, k, False, BETA, DT, GAP_TARGETS[0], TOLERANCE)
        J = found.jacobian
        W = J @ np.diag(free.ravel() / np.diag(A)) @ J.T
        rig = SimpleNamespace(m=m, p=p, k=k, solver=solver, work=solver.work, A=A, J=J, W=W, free=free)
        rig.start, rig.x_hat, rig.x, rig.gap, rig.friction = start, x_hat, x, gap, friction
        rig.obstacle_displacement, rig.model = obstacle_displacement, {"one": m, "all": made.parallel}.get
        rig.frame = np.stack([found.normal, found.tangent, np.cross(found.normal, found.tangent)], axis=1)
        yield rig


def impulses_at(rig, x: np.ndarray) -> np.ndarray:
    """The impulses (K,3) at x (n,3), independent of earlier ones."""
    rig.m.state.x.from_numpy(x)
    rig.p.r.fill(np.nan)
    evaluate(rig)
    return rig.p.r.to_numpy()[:K]


def evaluate(rig, mode: int | None = STAY, term_weight: float = 1.0, multiply: bool = False, m=None) -> np.ndarray:
    """The norms of the residual. mode: None keeps the state and the forces. m: the model, by default the one on one thread."""
    s, m = rig.solver, m or rig.m
    if mode is not None:
        move(m, rig.work, rig.k, ELASTIC_STAGE, mode, term_weight, 1.0, BETA)
    contact_terms.update_impulses(m, rig.k, int(multiply), BETA, STIFFNESS)
    form_residual(m, rig.work, s.matrix, rig.k, ELASTIC_STAGE, BETA)
    return norms_of(m)


def norms_of(m) -> np.ndarray:
    """The norms (5,) that the last kernel stored."""
    return m.state.scalars.to_numpy()[NORMS : NORMS + N_NORMS]


def targets(rig) -> np.ndarray:
    """The gaps (K,) that contacts must have at the end [m]."""
    contact_offset, fast, slow, fastest = GAP_TARGETS
    above = np.maximum(rig.gap, 0)
    opening = np.minimum(slow * (contact_offset - above) + fast * (above - rig.gap), fastest * DT)
    assert 0 < (opening == fastest * DT).sum() < (rig.gap < contact_offset).sum()
    target = np.where(rig.gap >= contact_offset, contact_offset, rig.gap + opening)
    assert (target < 0.0).sum() > 1
    return target


@pytest.fixture
def pressed(rig):
    """Set multipliers with open, sticking and slipping contacts at rig.x. Returns z (K,3), radii (K,), u (K,3)."""
    rng = np.random.default_rng(11)
    factor = oracle.factors(rig.W)
    displacement, target_gap = (rig.x - rig.start).ravel(), targets(rig)
    obstacle_displacement_at = np.einsum("kij,kj->ki", rig.frame, rig.obstacle_displacement)
    u = (rig.J @ (rig.x - rig.x_hat).ravel() / BETA).reshape(K, 3) - obstacle_displacement_at / DT
    u[:, 0] = (rig.gap - target_gap + (rig.J @ displacement).reshape(K, 3)[:, 0] - obstacle_displacement_at[:, 0]) / BETA
    size = STIFFNESS * factor[:, 0] * np.abs(u).max()
    multiplier = size[:, None] * rng.uniform([-1, -1, -1], [3, 1, 1], (K, 3))
    multiplier[:, 0] = np.maximum(multiplier[:, 0], 0.0)
    fill_field(rig.p.r, multiplier)
    evaluate(rig, multiply=True)
    radius = rig.k.work.radius.to_numpy()[:K]
    assert np.array_equal(rig.k.work.multiplier.to_numpy()[:K], multiplier)
    assert np.allclose(radius, rig.friction * multiplier[:, 0], rtol=1e-15)
    z = multiplier - STIFFNESS * factor * u
    tangential = np.linalg.norm(z[:, 1:], axis=1)
    states = [(z[:, 0] < 0).sum(), (tangential < radius).sum(), ((tangential > radius) & (radius > 0)).sum(), (radius == 0).sum()]
    assert min(states) >= 3 and np.abs(tangential / np.maximum(radius, 1e-300) - 1).min() > 1e-3
    assert np.abs(z[:, 0]).min() > 1e-3 * size.min()
    return z, radius, u


def test_impulses_and_residual_of_the_contact_laws(rig, pressed):
    z, radius, u = pressed
    assert np.abs(rig.p.factor.to_numpy()[:K] / oracle.factors(rig.W)[:, :2] - 1).max() < 1e-11  # from the matrix's diagonal
    r = impulses_at(rig, rig.x)
    tangential = np.linalg.norm(z[:, 1:], axis=1)
    expected = np.where(np.arange(3) == 0, np.maximum(z, 0), z * np.minimum(1, radius / tangential)[:, None])
    assert np.abs(r - expected).max() < 1e-11 * np.abs(expected).max()
    fixed_point = np.array([oracle.project(row, mu) for row, mu in zip(r - oracle.factors(rig.W) * u, rig.friction)])
    residual = np.linalg.norm(r - fixed_point) / np.linalg.norm(r)
    assert rig.m.state.scalars[LAW] == pytest.approx(residual, rel=1e-11) and residual > 0.01


def test_a_gap_that_misses_its_target_is_a_residual(rig, pressed):
    """With a tolerance so large that it exceeds that of the impulses: half of the gap, or of the offset, corresponds to it."""
    _, _, u = pressed
    weights, target = rig.k.work.gap_weight.to_numpy(), targets(rig)
    kept = np.clip(target, 1e-3 * GAP_TARGETS[0], GAP_TARGETS[0])
    assert np.allclose(weights[:K], np.where(target > 0, TOLERANCE / (0.5 * kept), 0), rtol=1e-12) and (target <= 0).any()
    rig.k.work.gap_weight.from_numpy(weights * (1e3 / TOLERANCE))
    impulses_at(rig, rig.x)
    rig.k.work.gap_weight.from_numpy(weights)
    assert rig.m.state.scalars[LAW] == pytest.approx(1e3 * (-BETA * u[:, 0] / (0.5 * kept))[target > 0].max(), rel=1e-6)


def test_blocks_are_minus_the_derivative_of_the_impulses(rig, pressed):
    impulses_at(rig, rig.x)
    blocks, active = unpacked(rig.k.work.block.to_numpy()[:K]), rig.k.work.active.to_numpy()[:K]
    assert np.abs(blocks - blocks.swapaxes(1, 2)).max() <= CLOSE * np.abs(blocks).max()
    assert np.array_equal(active == 1, np.abs(blocks).max(axis=(1, 2)) > 0) and 0 < active.sum() < K
    dv, h = np.random.default_rng(1).standard_normal(rig.x.shape), 1e-7
    dr = (impulses_at(rig, rig.x + h * BETA * dv) - impulses_at(rig, rig.x - h * BETA * dv)) / (2 * h)
    du = np.einsum("kij,ki->kj", rig.frame, (rig.J @ dv.ravel()).reshape(K, 3))
    dp = np.einsum("kij,ki->kj", rig.frame, dr)
    assert np.abs(np.einsum("kij,kj->ki", blocks, du) + dp).max() < 1e-6 * np.abs(dp).max()


@pytest.mark.parametrize("threads", ["one", "all"])
def test_conjugate_gradients(rig, pressed, threads):
    """They solve with J^T D J of the present blocks, which matters."""
    m, work, J = rig.model(threads), rig.work.pcg, rig.J.reshape(K, 3, -1)
    impulses_at(rig, rig.x)
    J = np.einsum("kij,kim->kjm", rig.frame, J)  # in world axes
    dense = np.einsum("kim,kij,kjn->mn", J, unpacked(rig.k.work.block.to_numpy()[:K]), J, optimize=True)
    rhs, on = np.random.default_rng(4).standard_normal(rig.x.shape), rig.free.ravel() > 0
    work.rhs.from_numpy(rig.free * rhs)
    expected, without = (np.linalg.solve(A[np.ix_(on, on)], rhs.ravel()[on]) for A in (rig.A + dense, rig.A))
    result = gauss_seidel.solve(m, rig.solver.matrix, work, 1e-12, 2000, rig.k.coupling)
    y = work.y.to_numpy().ravel()
    assert result.converged and np.abs(y[on] - expected).max() < 1e-9 * np.abs(expected).max() and not y[~on].any()
    assert np.abs(without - expected).max() > 0.1 * np.abs(expected).max()


@pytest.mark.parametrize("threads", ["one", "all"])
def test_residual_of_a_stage(rig, pressed, threads):
    """The residual without contacts minus J^T p, after a full step, part of one, and a change of the multipliers only."""
    m = rig.model(threads)
    work, cg = rig.work, rig.solver.work.pcg
    rng = np.random.default_rng(6)
    y = 1e-2 * rng.standard_normal(rig.x.shape)
    before = rng.standard_normal(rig.x.shape)
    cg.y.from_numpy(y)
    work.residual.from_numpy(before)
    m.state.x.from_numpy(rig.x)
    for mode, term_weight in ((STEP, 1.0), (AGAIN, 0.4), (None, 0.4)):
        norms = evaluate(rig, mode, term_weight, multiply=mode is None, m=m)
        got, rhs, r = work.residual.to_numpy(), cg.rhs.to_numpy(), rig.p.r.to_numpy()[:K]
        assert np.abs(m.state.x.to_numpy() - rig.x - term_weight * BETA * y).max() < 1e-15
        v = m.state.v.to_numpy()
        assert np.abs(v - (m.state.x.to_numpy() - rig.x_hat) / BETA).max() < 1e-11 * np.abs(v).max()
        if mode == STEP:
            slope = (rig.free * before * y).sum()
            size = np.linalg.norm(before) * np.linalg.norm(y)
            assert m.state.scalars[START_SLOPE] == pytest.approx(slope, abs=1e-11 * size)
        end = m.state.scalars[END_SLOPE]
        move(m, work, NO_CONTACTS, ELASTIC_STAGE, STAY, 0.0, 1.0, BETA)
        form_residual(m, work, rig.solver.matrix, NO_CONTACTS, ELASTIC_STAGE, BETA)
        without = norms_of(m)
        expected = work.residual.to_numpy() - (rig.J.T @ r.ravel()).reshape(-1, 3)
        assert np.abs(expected - work.residual.to_numpy()).max() > 0.1 * np.abs(expected).max()  # impulses matter
        close = 1e-11 * np.abs(expected).max()
        assert np.abs(got - expected).max() < close and np.abs(rhs + rig.free * expected).max() < close
        squares = [((rig.free * expected) ** 2).sum(), *without[1:4], (((1 - rig.free) * expected) ** 2).sum()]
        assert norms == pytest.approx(squares, rel=1e-10) and norms[4] > 0
        slope, size = (rig.free * expected * y).sum(), np.linalg.norm(expected) * np.linalg.norm(y)
        assert end == pytest.approx(slope, abs=1e-10 * size)


@pytest.mark.parametrize("threads", ["one", "all"])
def test_a_linearised_stage_is_linear(rig, threads):
    """It moves along y to where the slope vanishes; its impulses replace those of the linearisation point."""
    m = rig.model(threads)
    rng, work, cg = np.random.default_rng(7), rig.work, rig.solver.work.pcg
    m.state.x.from_numpy(rig.start)
    evaluate(rig, m=m)
    there, at_start = rig.p.r.to_numpy()[:K], work.residual.to_numpy()
    before = at_start + (rig.J.T @ there.ravel()).reshape(-1, 3)
    linearised.begin_linearised(m, work, rig.k)
    y = np.linalg.solve(rig.A + 1e6 * np.diag(1 - rig.free.ravel()), -(rig.free * at_start).ravel()).reshape(-1, 3) * rig.free
    y += 0.1 * np.abs(y).max() * rig.free * rng.standard_normal(y.shape)
    cg.y.from_numpy(y)
    linearised.find_step_length(m, work, rig.solver.matrix, rig.k, BETA, STIFFNESS)
    linearised.advance(m, work, rig.k, BETA, STIFFNESS)
    r, length = rig.p.r.to_numpy()[:K], m.state.scalars[STEP_LENGTH]
    assert length > 0.0 and np.abs(r - there).max() > 0.01 * np.abs(r).max()
    displacement = length * BETA * y
    error = np.abs(m.state.x.to_numpy() - rig.start - displacement).max()
    assert error < CLOSE * np.abs(displacement).max() + 1e-15  # rounding of x
    expected = before + (length * rig.A @ y.ravel() - rig.J.T @ r.ravel()).reshape(-1, 3)
    size = np.abs(rig.A @ y.ravel()).max() * length + np.abs(expected).max()
    assert np.abs(work.residual.to_numpy() - expected).max() < 1e-10 * size
    assert norms_of(m)[0] == pytest.approx(((rig.free * expected) ** 2).sum(), rel=1e-9)
    start, end = (rig.free * at_start * y).sum(), (rig.free * expected * y).sum()
    assert abs(end) <= 0.05 * abs(start) + 1e-10 * size * np.abs(y).sum()
    for to_impulses in (0, 1):
        linearised.update_multipliers(m, work, rig.k, to_impulses, BETA, STIFFNESS)
        assert to_impulses or np.array_equal(rig.p.r.to_numpy()[:K], r), "the impulses of the same multipliers"
        found = before + (length * rig.A @ y.ravel() - rig.J.T @ rig.p.r.to_numpy()[:K].ravel()).reshape(-1, 3)
        assert np.abs(work.residual.to_numpy() - found).max() < 1e-10 * size
    assert np.array_equal(rig.k.work.multiplier.to_numpy()[:K], r) and not np.array_equal(rig.p.r.to_numpy()[:K], r)
    fill_field(rig.p.r, r)
    linearised.end_linearised(m, work, rig.k, 1, BETA)
    assert np.array_equal(rig.p.r.to_numpy()[:K], r) and np.array_equal(work.base.to_numpy(), rig.start)
    assert np.abs(cg.y.to_numpy() - length * y).max() < 1e-11 * np.abs(length * y).max()
    linearised.end_linearised(m, work, rig.k, 0, BETA)
    assert np.array_equal(rig.p.r.to_numpy()[:K], there)


def test_frictionless_blocks_act_only_along_the_normal(rig):
    """Also at the kink of the friction energy, without tangential motion."""
    rig.work.x_hat.from_numpy(rig.x)
    multiplier = np.zeros((K, 3))
    multiplier[:, 0] = 1e3
    fill_field(rig.p.r, multiplier)
    rig.m.state.x.from_numpy(rig.x)
    evaluate(rig, multiply=True)
    smooth = np.flatnonzero((rig.friction == 0) & ~rig.obstacle_displacement.any(axis=1))
    blocks, n = unpacked(rig.k.work.block.to_numpy()[:K]), rig.frame[:, 0]
    normal = STIFFNESS * oracle.factors(rig.W)[:, :1, None] * n[:, :, None] * n[:, None, :]
    assert len(smooth) >= 2 and np.abs(blocks - normal)[smooth].max() < 1e-11 * np.abs(normal).max()
    rig.work.x_hat.from_numpy(rig.x_hat)


def least_squares(factor: np.ndarray, multipliers: list[np.ndarray], impulses: list[np.ndarray]) -> np.ndarray:
    """The next multipliers (K,3) from all previous ones and the impulses that they gave, by NumPy."""
    weight = np.where(factor > 0.0, 1.0 / np.sqrt(np.where(factor > 0.0, factor, 1.0)), 0.0)
    change = [p - x for x, p in zip(multipliers, impulses)]
    steps = np.stack([(weight * (b - a)).ravel() for a, b in zip(change, change[1:])], axis=1)
    t = np.linalg.lstsq(steps, (weight * change[-1]).ravel(), rcond=None)[0]
    new = impulses[-1] - sum(s * (b - a) for s, a, b in zip(t, impulses, impulses[1:]))
    new[:, 0] = np.maximum(new[:, 0], 0.0)
    return new


@pytest.mark.parametrize("max_history", [1, 2])
def test_updates_of_multipliers_are_those_of_least_squares(rig, max_history):
    rng, before, work = np.random.default_rng(max_history), rig.p.factor.to_numpy(), rig.k.work
    factor = before.copy()
    factor[:K:9] = 0.0  # contacts that cannot move
    rig.p.factor.from_numpy(factor)
    multipliers, impulses = [rng.standard_normal((K, 3))], []
    fill_field(work.multiplier, multipliers[0])
    for n in range(5):
        impulses.append(rng.standard_normal((K, 3)))
        fill_field(rig.p.r, impulses[-1])
        history = min(n, max_history)
        extrapolate_multipliers(rig.k, history)
        multipliers.append(work.multiplier.to_numpy()[:K])
        expected = impulses[-1] * (impulses[-1] > (0.0, -np.inf, -np.inf))
        if history:
            expected = least_squares(factor[:K, [0, 1, 1]], multipliers[-2 - history : -1], impulses[-1 - history :])
        assert np.allclose(multipliers[-1], expected, rtol=1e-10, atol=1e-10)
        assert (multipliers[-1][:, 0] == 0.0).any()  # some were clipped
        assert np.allclose(work.radius.to_numpy()[:K], rig.friction * multipliers[-1][:, 0], rtol=1e-14)
    rig.p.factor.from_numpy(before)
