"""Gauss-Seidel over chunks with coupling terms: iterations are NumPy's with the triangle of the stated order, in which the nodes
of a term outside the first chunk of each parity are last, and the solution is exact and the same on any number of threads.
"""

import numpy as np
import pytest
import scipy.sparse as sp
import taichi as ti

from taisoft.backend.arrays import FieldArena
from taisoft.linear import block_csr, gauss_seidel
from taisoft.linear.coupling import build_coupling
from taisoft.linear.pcg_work import RZ, build_pcg
from taisoft.linear.sweep_order import find_last
from tests.dynamics.scenes import built, mixed_scene
from tests.linear.boxes import divided, fill

N_TERMS, WIDTH, FIXED = 30, 6, [2, 9]
SHIFTS = {"layered": 5, "crossed": 4}  # three chunks of 32 nodes, of which blocks couple neighbours alone, and six of 16


@pytest.fixture(scope="module", params=[("layered", False), ("crossed", True)], ids=str)
def rig(request):
    name, shared = request.param
    with built(mixed_scene(order="both"), "f64") as made:
        arena, rng = FieldArena(), np.random.default_rng(4)
        made.models = {serial: divided(made.model, arena, SHIFTS[name], serial) for serial in (True, False)}
        m = made.models[False]
        made.order, made.shared, n = m.sweep, shared, m.n_nodes
        made.matrix, made.work = block_csr.build_block_csr(m, arena), build_pcg(m, arena)
        assert made.work.n_chunks == (3 if name == "layered" else 6) and made.matrix.crossed == (name == "crossed")
        free = np.ones((n, 3))
        free[FIXED] = 0.0
        m.free.from_numpy(free)
        K = made.oracle.stiffness(made.oracle.rest, projected=True) + 1e3 * np.eye(3 * n)
        fill(m, made.matrix, sp.bsr_matrix(K, blocksize=(3, 3)))
        made.nodes = [np.sort(rng.choice(n // 2, k, replace=False)) * 2 for k in rng.integers(1, WIDTH + 1, N_TERMS)]  # even
        weights, half = rng.uniform(-1, 1, (N_TERMS, WIDTH)), rng.standard_normal((N_TERMS, 3, 3))
        D, active = 1e4 * half @ half.transpose(0, 2, 1), np.arange(N_TERMS) % 7 != 0
        made.A = K.reshape(n, 3, n, 3).transpose(0, 2, 1, 3).copy()
        base = block_csr.packed(made.A[np.arange(n), np.arange(n)])
        made.coupling = upload_terms(made, arena, weights, D, active, base)
        for own, w, block in zip(*([part[k] for k in np.flatnonzero(active)] for part in (made.nodes, weights, D))):
            w = w[: len(own)]
            made.A[np.ix_(own, own)] += (w[:, None] * w)[:, :, None, None] * block
        made.free, made.rhs = free.reshape(-1) > 0.0, np.where(free > 0.0, rng.standard_normal((n, 3)), 0.0)
        yield made


def upload_terms(made, arena, weights, D, active, base):
    m, arity, node = made.model, [len(own) for own in made.nodes], np.concatenate(made.nodes)
    start, entry = np.searchsorted(np.sort(node), np.arange(m.n_nodes + 1)), np.argsort(node, kind="stable")
    integers = {"count": [N_TERMS], "first": np.cumsum(arity) - arity, "arity": arity, "node": node}
    integers |= {"contact": np.repeat(np.arange(N_TERMS), arity), "entry_start": start, "entry": entry, "active": active}
    fields = {name: arena.field(name, ti.i32, np.shape(v), np.array(v, dtype=np.int32)) for name, v in integers.items()}
    for name, v in (("block", block_csr.packed(D)), ("base", base)):
        fields[name] = arena.vectors(name, m.real, len(v), v, n=block_csr.BLOCK)
    weights = np.concatenate([w[:n] for w, n in zip(weights, arity)])
    fields["weight"] = arena.field("weight", ti.f64, weights.shape, weights)
    return build_coupling(arena, m.real, m.n_nodes, made.shared, **fields)


def last_nodes(made) -> np.ndarray:
    """Which nodes (n,) are last, by definition."""
    last, shift = np.zeros(made.model.n_nodes, dtype=bool), made.order.shift
    for own in made.nodes if made.shared else []:
        for parity in (0, 1):
            chunk = own >> shift
            of_parity = own[chunk % 2 == parity]
            if len(of_parity):
                last[of_parity[(of_parity >> shift) > (of_parity >> shift).min()]] = True
    return last


def dense(blocks: np.ndarray) -> np.ndarray:
    """Matrix of blocks (n, n, 3, 3)."""
    return blocks.transpose(0, 2, 1, 3).reshape(3 * len(blocks), -1)


def solve(made, serial: bool, tolerance: float, limit: int):
    m, w = made.models[serial], made.work
    if made.shared:
        find_last(m, made.matrix, made.coupling, w)
    w.rhs.from_numpy(made.rhs)
    result = gauss_seidel.solve(m, made.matrix, w, tolerance, limit, made.coupling)
    return result, w.y.to_numpy(), float(w.state.to_numpy()[RZ])


def numpy_rz(made, n: int) -> list[float]:
    """r.z at the start and after each of n iterations of NumPy's conjugate gradients."""
    number, last = np.arange(made.model.n_nodes), last_nodes(made)
    rank = np.where(last, number + (1 << 40), made.order.rank(number))
    L = rank[:, None] > rank[None]
    if made.shared:
        L &= ~made.order.apart(number[:, None], number[None]) | last[:, None] | last[None]
    masks = np.ones_like(L), L, np.eye(len(number))
    full, lower, D = (dense(made.A * mask[:, :, None, None])[made.free][:, made.free] for mask in masks)
    M = (D + lower) @ np.linalg.solve(D, (D + lower).T)
    r, p, found = made.rhs.reshape(-1)[made.free], 0.0, []
    for k in range(n + 1):
        z = np.linalg.solve(M, r)
        found.append(float(r @ z))
        p = z + (found[k] / found[k - 1] if k else 0.0) * p
        r = r - found[k] / (p @ full @ p) * (full @ p)
    return found


@pytest.mark.parametrize("serial", [True, False])
def test_iterations_are_numpys(rig, serial):
    expected = numpy_rz(rig, 6)
    found = [solve(rig, serial, 0.0, n)[2] for n in range(1, 7)]
    assert np.allclose(found, expected[1:], rtol=1e-8) and expected[6] < 0.1 * expected[0]


def test_the_solution_is_exact_and_the_same_on_any_number_of_threads(rig):
    full, exact = dense(rig.A), np.zeros(rig.free.size)
    exact[rig.free] = np.linalg.solve(full[rig.free][:, rig.free], rig.rhs.reshape(-1)[rig.free])
    one, several = (solve(rig, serial, 1e-10, 1000) for serial in (True, False))
    assert one[0] == several[0] and np.array_equal(one[1], several[1]) and one[0].converged
    assert np.abs(one[1].reshape(-1) - exact).max() < 1e-7 * np.abs(exact).max()
