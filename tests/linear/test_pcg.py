"""Conjugate gradients in f64, with block-Jacobi by loops and by teams, and Gauss-Seidel over the whole system and over chunks, on
one thread and on several: the solution is exact on the free axes and 0 on the others, limits hold, and negative curvature is
reported.
"""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.backend.counters import counting
from taisoft.backend.paths import Order, gpu_path
from taisoft.linear import block_csr, gauss_seidel, pcg
from taisoft.linear.coupling import NO_COUPLING, Coupling, build_coupling
from taisoft.linear.jacobi import JACOBI
from taisoft.linear.pcg_work import RUNNING, LinearResult, build_pcg
from tests.dynamics.scenes import built, mixed_scene
from tests.linear.boxes import divided, fill

TEAMS = {"team": Order(), "team of 7": Order(7), "team of 64, backwards": Order(64, True)}
PRECONDITIONERS = dict.fromkeys(("jacobi", *TEAMS), JACOBI)  # of `pcg`
METHODS = ("whole", "chunks", "threads", *PRECONDITIONERS)


@pytest.fixture(scope="module")
def rig():
    with built(mixed_scene(order="both"), "f64") as made:
        arenas, made.ways = [FieldArena() for _ in METHODS], {}
        models = {"whole": made.model} | dict.fromkeys(PRECONDITIONERS, replace(made.parallel, on_cpu=False))
        models |= {name: divided(made.model, arenas[0], 4, serial=name == "chunks") for name in ("chunks", "threads")}
        for arena, (name, m) in zip(arenas, models.items()):
            of_cpu = models["whole"] if name in PRECONDITIONERS else m
            matrix = block_csr.build_block_csr(of_cpu, arena)
            with gpu_path(TEAMS.get(name, Order())):
                made.ways[name] = m, matrix, build_pcg(m if name in TEAMS else of_cpu, arena)
        assert made.ways["chunks"][2].n_chunks == 6 and made.ways["chunks"][1].crossed
        rng = np.random.default_rng(1)
        x = made.oracle.rest * [0.8, 1.1, 0.9] + 0.05 * rng.standard_normal(made.oracle.rest.shape)
        made.stiffness, made.free = made.oracle.stiffness(x, projected=True), rng.random(x.shape) < 0.8
        made.free[3] = False
        made.model.free.from_numpy(made.free.astype(np.float64))
        made.rhs = rng.standard_normal(x.shape)
        yield made
        for arena in arenas:
            arena.release()


def upload(rig, dense: np.ndarray) -> np.ndarray:
    """Upload a matrix with the node graph's pattern to all ways; returns the exact solution (n,3)."""
    for m, matrix, _ in rig.ways.values():
        fill(m, matrix, sp.bsr_matrix(dense, blocksize=(3, 3)))
        assert abs(block_csr.to_bsr(m, matrix) - dense).max() == 0.0
    f, y = rig.free.reshape(-1), np.zeros(len(dense))
    y[f] = np.linalg.solve(dense[f][:, f], rig.rhs.reshape(-1)[f])
    return y.reshape(-1, 3)


def solve(rig, method: str, tolerance: float, limit: int = 1000, rhs: np.ndarray | None = None):
    model, matrix, work = rig.ways[method]
    work.rhs.from_numpy(rig.rhs if rhs is None else rhs)
    work.y.fill(np.nan)
    if method in PRECONDITIONERS:
        return pcg.solve(model, matrix, PRECONDITIONERS[method], work, tolerance, limit), work.y.to_numpy()
    return gauss_seidel.solve(model, matrix, work, tolerance, limit), work.y.to_numpy()


@pytest.fixture
def exact(rig):
    """Solution of a system of K plus an inertia of about a hundredth of it."""
    shift = np.repeat(np.random.default_rng(2).uniform(200.0, 2000.0, rig.model.n_nodes), 3)  # [N/m], one per node
    return upload(rig, rig.stiffness + np.diag(shift))


@pytest.mark.parametrize("method", METHODS)
def test_the_solution_the_tolerance_and_the_limits(rig, exact, method):
    result, y = solve(rig, method, 1e-12)
    assert result.converged and not result.negative and 5 < result.iterations < rig.free.sum()
    # the error is at most the tolerance times the root of the condition of the preconditioned matrix, about 30
    assert np.abs(y - exact).max() < 1e-10 * np.abs(exact).max()
    assert np.all(y[~rig.free] == 0.0) and np.abs(rig.rhs[~rig.free]).max() > 1.0
    counts = [solve(rig, method, tolerance)[0].iterations for tolerance in (0.3, 1e-2, 1e-5)]
    assert counts == sorted(set(counts))
    assert 1e-3 < np.abs(solve(rig, method, 0.3)[1] - exact).max() / np.abs(exact).max() < 1.0
    result, y = solve(rig, method, 1e-5, limit=3)
    assert result.iterations == 3 and not result.converged and not result.negative and np.isfinite(y).all()
    result, y = solve(rig, method, 1e-6, rhs=np.where(rig.free, 0.0, 1.0))
    assert result.converged and result.iterations == 0 and not y.any()


def test_threads_give_the_same_bits_and_gauss_seidel_takes_fewer_iterations(rig, exact):
    found = {method: solve(rig, method, 1e-5) for method in METHODS}
    for again in (found["threads"], *(solve(rig, "threads", 1e-5) for _ in range(5))):
        assert again[0] == found["chunks"][0] and np.array_equal(again[1], found["chunks"][1])
    whole, chunks, jacobi = (found[method][0].iterations for method in ("whole", "chunks", "jacobi"))
    assert whole < 0.8 * jacobi and chunks < 0.9 * jacobi


def with_terms(rig, arena: FieldArena, n: int = 40) -> tuple[Coupling, np.ndarray]:
    """Random terms of up to six nodes, most of them active, and the matrix that they add."""
    rng, n_nodes, size = np.random.default_rng(5), rig.model.n_nodes, 3 * rig.model.n_nodes
    arity, active = rng.integers(1, 7, n).astype(np.int32), (rng.random(n) < 0.8).astype(np.int32)
    contact, node = np.repeat(np.arange(n), arity), rng.integers(0, n_nodes, arity.sum())
    weight, roots = rng.standard_normal(len(node)), 30.0 * rng.standard_normal((n, 3, 3))
    blocks = roots @ roots.swapaxes(1, 2)
    J = np.zeros((n, 3, size))
    for c, i, w in zip(contact, node, weight):
        J[c, :, 3 * i : 3 * i + 3] += w * np.eye(3)
    base = [block_csr.to_bsr(*rig.ways["jacobi"][:2]).toarray()[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(n_nodes)]
    integers = {"count": [n], "first": np.cumsum(arity) - arity, "arity": arity, "node": node, "contact": contact}
    integers |= {"entry_start": np.append(0, np.cumsum(np.bincount(node, minlength=n_nodes))), "active": active}
    integers["entry"] = np.argsort(node, kind="stable")
    fields = {k: arena.field(k, ti.i32, len(v), np.asarray(v, dtype=np.int32)) for k, v in integers.items()}
    fields["weight"] = arena.field("weight", ti.f64, len(weight), weight)
    fields["block"] = arena.vectors("block", ti.f64, n, block_csr.packed(blocks), n=12)
    fields["base"] = arena.vectors("base", ti.f64, n_nodes, block_csr.packed(np.array(base)), n=12)
    return build_coupling(arena, ti.f64, n_nodes, **fields), np.einsum("c,cai,cab,cbj->ij", active, J, blocks, J)


def test_teams_solve_as_loops_do_with_terms_in_any_order(rig, exact):
    """Up to rounding of the sums, whose order is that of the entries, and whatever the number of iterations in a launch."""
    arena, f = FieldArena(), rig.free.reshape(-1)
    terms, added = with_terms(rig, arena)
    A = (block_csr.to_bsr(*rig.ways["jacobi"][:2]).toarray() + added)[f][:, f]
    expected, found = np.zeros(len(f)), {}
    expected[f] = np.linalg.solve(A, rig.rhs.reshape(-1)[f])
    for method in ("jacobi", *TEAMS):
        model, matrix, work = rig.ways[method]
        for again in (False, True):  # with the diagonal of the last solve
            work.rhs.from_numpy(rig.rhs)
            result = pcg.solve(model, matrix, JACOBI, work, 1e-11, 1000, terms, again)
            assert result.converged
            assert np.abs(work.y.to_numpy().reshape(-1) - expected).max() < 1e-9 * np.abs(expected).max()
        short = pcg.solve(model, matrix, JACOBI, work, 1e-3, 1000, terms, True), work.y.to_numpy()
        found[method] = result.iterations, short
    n, (loops, y) = found["jacobi"]
    for n_team, (short, y_team) in found.values():
        assert abs(n_team - n) <= 2 and short == loops  # rounding adds up over the first ones
        assert np.abs(y_team - y).max() < 1e-10 * np.abs(y).max()
    arena.release()


def test_a_solve_by_a_team_goes_on_after_a_launch(rig, exact):
    model, matrix, work = rig.ways["team"]
    work.rhs.from_numpy(rig.rhs)
    with counting() as counts:
        whole = pcg.solve(model, matrix, JACOBI, work, 1e-12, 1000)
    assert whole.converged and counts.launches.total() == 1 and sum(counts.accesses.values()) == 1
    y = work.y.to_numpy()
    pcg.run_team(model, matrix, JACOBI, NO_COUPLING, work, 1e-12, 0, 1, 5)
    assert work.result(1000) == LinearResult(5, False, False)
    work.state.from_numpy(np.array([*work.state.to_numpy()[:4], RUNNING]))
    pcg.run_team(model, matrix, JACOBI, NO_COUPLING, work, 1e-12, 0, 0, 1000)
    assert work.result(1000) == whole and np.array_equal(work.y.to_numpy(), y)


def test_a_border_is_part_of_the_matrix(rig, exact):
    """G^T s G of two rows, of which storage has three."""
    model, matrix, work = rig.ways["jacobi"]
    arena, rng, n, f = FieldArena(), np.random.default_rng(3), model.n_nodes, rig.free.reshape(-1)
    G, scale = rng.standard_normal((2, 3 * n)) * f, np.array([3e3, 2e2])
    rows = np.concatenate([G.reshape(-1, 3), np.full((n, 3), np.nan)])
    border = pcg.Border(
        n=arena.field("n", ti.i32, 1, np.array([2], dtype=np.int32)),
        row=arena.vectors("row", ti.f64, 3 * n, rows),
        factor=arena.field("factor", ti.f64, 3, np.array([*scale, np.nan])),
        product=arena.field("product", ti.f64, 3),
    )
    work.rhs.from_numpy(rig.rhs)
    assert pcg.solve(model, matrix, JACOBI, work, 1e-12, 1000, border=border).converged
    y, A = work.y.to_numpy().reshape(-1), block_csr.to_bsr(model, matrix).toarray() + G.T @ (scale[:, None] * G)
    assert np.abs((A @ y - rig.rhs.reshape(-1))[f]).max() < 1e-8 * np.abs(rig.rhs).max()
    arena.release()


@pytest.mark.parametrize("method", METHODS)
def test_negative_curvature_is_reported(rig, method):
    """Slightly indefinite, and negative definite, which already shows in the diagonal blocks."""
    for shift in (-1e3, -1e5):
        A, f = rig.stiffness + shift * np.eye(len(rig.stiffness)), rig.free.reshape(-1)
        upload(rig, A)
        assert np.linalg.eigvalsh(A[f][:, f]).min() < -500
        result, y = solve(rig, method, 1e-6)
        assert result.negative and not result.converged
        assert np.isfinite(y).all() and np.sum(y * rig.rhs) >= 0.0
        for after in (1, 2, 8):  # the limit falls into the iteration that finds it, or a later one of its batch
            again, same = solve(rig, method, 1e-6, limit=result.iterations + after)
            assert again == result and np.array_equal(same, y)
