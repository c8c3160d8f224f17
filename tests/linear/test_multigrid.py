"""Multigrid, as a preconditioner and as the simulator chooses it:

* a V-cycle equals the dense reference; it is symmetric and positive definite, and 0 on constrained axes; rigid motions lie in the
  range of the prolongation, also of aggregates that are rigid about their centres;
* conjugate gradients with it give SciPy's solution, report negative curvature and stop where asked; the iterations hardly grow
  with the mesh;
* statics of a slender bar take at most 200 iterations a Newton step;
* implicit steps that use it give the positions of those that do not, also when nodes are released, and resume bitwise;
* a scene that needs few iterations does not use it: no memory, no kernel.
"""

import ast
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg as sl
import scipy.sparse as sp
import scipy.sparse.linalg as spl
import taichi as ti

import taisoft as ts
from taisoft.backend import runtime
from taisoft.dynamics import linear_solver
from taisoft.fem.node_graph import EVERYTHING
from taisoft.linear import block_csr, host_pcg, multigrid, pcg
from taisoft.linear.aggregation import MODES, prolongation, rigid_aggregates, rigid_modes
from taisoft.linear.multigrid import Multigrid
from taisoft.linear.pcg_work import build_pcg
from taisoft.mesh.aggregates import aggregate
from tests.backend.lanes import opened
from tests.dynamics.scenes import built, cube, rubber


def held_box(cells=(6, 3, 3), young: float = 1e5) -> ts.Scene:
    """A box clamped at its left end, some of whose other nodes are held along one axis."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh(cells, (2.0, 1.0, 1.0)), rubber(young=young), name="box")
    body.fix(lambda X: X[:, 0] < -0.99)
    body.fix([body.n_nodes - 1], axes="y")
    return scene


def strip(young: float = 1e9, cells=(100, 1, 10)) -> ts.Scene:
    """A strip 10 x 0.1 x 1 m, clamped at its left end."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh(cells, (10.0, 0.1, 1.0)), rubber(young=young), name="strip")
    body.fix(lambda X: X[:, 0] < -4.99)
    return scene


def random_matrix(seed: int = 3) -> tuple[sp.bsr_matrix, np.ndarray, np.ndarray]:
    """A positive definite matrix on a box's edges, the identity on some axes; its rigid modes and its free axes (n, 3)."""
    mesh, rng = cube(cells=(7, 5, 4)), np.random.default_rng(seed)
    n = len(mesh.vertices)
    A, free = np.zeros((3 * n, 3 * n)), rng.random((n, 3)) < 0.95
    free[:6] = False
    for tet in mesh.tets:
        rows = (3 * tet[:, None] + np.arange(3)).reshape(-1)
        B = rng.standard_normal((12, 12))
        A[np.ix_(rows, rows)] += B @ B.T
    f = free.reshape(-1)
    A = A * np.outer(f, f) + np.diag(~f)
    A = sp.csr_matrix(A).tobsr((3, 3))
    A.sort_indices()
    return A, rigid_modes(mesh.vertices, free), free


@pytest.fixture
def f64():
    """Taichi in that precision."""
    with opened("f64"):
        yield


@pytest.fixture
def several_levels(monkeypatch):
    """Coarsen small matrices too."""
    monkeypatch.setattr(multigrid, "SMALL", 40)
    monkeypatch.setattr(multigrid, "NARROW", 0)


def dense_cycle(cycle: Multigrid, k: int, A: np.ndarray, r: np.ndarray) -> np.ndarray:
    """The formula of `multigrid`, with the coarse matrices formed here."""
    if k == len(cycle.levels):
        return np.linalg.solve(A, r)
    level = cycle.levels[k]
    n, d, P = level.matrix.n_rows, level.matrix.rows, level.prolongation.to_scipy().toarray()
    S = sl.block_diag(*level.smoother.to_numpy().reshape(n, d, -1)[:, :, :d].swapaxes(1, 2))
    coarse = P.T @ A @ P
    coarse += np.diag(np.diag(coarse) == 0.0)  # unused unknowns
    x, (first, second) = np.zeros_like(r), multigrid.STEPS
    for step in (first, second):
        x = x + step * S @ (r - A @ x)
    x = x + P @ dense_cycle(cycle, k + 1, coarse, P.T @ (r - A @ x))
    for step in (second, first):
        x = x + step * S @ (r - A @ x)
    return x


def test_a_cycle_equals_the_dense_reference(several_levels, f64):
    A, modes, free = random_matrix()
    cycle, r = Multigrid(A, modes, ti.f64), np.random.default_rng(4).standard_normal(free.shape) * free
    expected = dense_cycle(cycle, 0, A.toarray(), r.reshape(-1))
    found = cycle.apply(r.reshape(-1))
    assert len(cycle.levels) >= 2 and cycle.n_bytes > A.data.nbytes
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()
    assert not found[~free.reshape(-1)].any() and np.abs(found[free.reshape(-1)]).min() > 0.0


def test_a_cycle_is_symmetric_and_positive_definite(several_levels, f64):
    A, modes, free = random_matrix()
    cycle, f = Multigrid(A, modes, ti.f64), free.reshape(-1)
    M = np.array([cycle.apply(e) for e in np.eye(len(f))[f]])[:, f]
    assert np.abs(M - M.T).max() < 1e-12 * np.abs(M).max()
    assert np.linalg.eigvalsh(0.5 * (M + M.T)).min() > 0.0
    convergence = np.linalg.eigvals(M @ A.toarray()[np.ix_(f, f)]).real
    assert 0.0 < convergence.min() and convergence.max() < 1.0 + 1e-9


def test_a_narrow_band_is_solved_exactly(f64):
    A, modes, free = random_matrix()
    cycle, b = Multigrid(A, modes, ti.f64), np.random.default_rng(5).standard_normal(free.size)
    assert not cycle.levels and np.abs(A @ cycle.apply(b) - b).max() < 1e-8


def test_an_indefinite_matrix_is_refused(f64):
    A, modes, _ = random_matrix()
    with pytest.raises(np.linalg.LinAlgError):
        Multigrid((A - 200.0 * sp.identity(A.shape[0])).tobsr((3, 3)), modes, ti.f64)


def test_aggregates_cover_the_included_nodes_and_are_connected():
    A, _, free = random_matrix()
    included = free.any(axis=1)
    found = aggregate(A.indptr, A.indices, included)
    assert np.array_equal(found >= 0, included) and np.array_equal(np.unique(found[included]), np.arange(found.max() + 1))
    assert 4 < included.sum() / (found.max() + 1) < 60
    graph = sp.csr_matrix((np.ones(len(A.indices)), A.indices, A.indptr))
    for k in range(found.max() + 1):
        own = np.flatnonzero(found == k)
        assert sp.csgraph.connected_components(graph[own][:, own])[0] == 1


def test_rigid_motions_are_prolonged_exactly():
    """Also in aggregates of one or two nodes, which have fewer than six motions."""
    rng = np.random.default_rng(6)
    x, free = rng.standard_normal((40, 3)), np.ones((40, 3), dtype=bool)
    free[3], free[7, 1] = False, False
    modes = rigid_modes(x, free)
    owner = np.array([-1 if k == 3 else 0 if k == 1 else 1 if k in (2, 9) else 2 + k % 3 for k in range(40)])
    P, coarse, unused = prolongation(modes, owner)
    assert np.abs(P @ coarse.reshape(-1, MODES) - modes.reshape(-1, MODES)).max() < 1e-12
    assert unused[0].sum() == 3 and unused[1].sum() == 1 and not unused[2:].any()
    used = P.toarray()[:, ~unused.reshape(-1)]
    assert np.abs(used.T @ used - np.eye(used.shape[1])).max() < 1e-12
    # e_z x r turns x to y
    turned = np.cross([0.0, 0.0, 1.0], x - x.mean(axis=0)) * free
    scale = turned[0, 0] / modes[0, 0, 5]
    assert np.allclose(turned, scale * modes[:, :, 5])


def test_pairs_along_an_axis_keep_the_rotations_that_move_them():
    """The one about the line of two nodes is a translation of both, whichever of the three it is."""
    rng = np.random.default_rng(6)
    x = rng.standard_normal((6, 3))
    for axis in range(3):
        x[2 * axis + 1] = x[2 * axis] + 0.3 * np.eye(3)[axis]
    modes, owner = rigid_modes(x, np.ones((6, 3), dtype=bool)), np.array([0, 0, 1, 1, 2, 2])
    P, coarse, unused = prolongation(modes, owner)
    assert np.abs(P @ coarse.reshape(-1, MODES) - modes.reshape(-1, MODES)).max() < 1e-12
    assert np.array_equal(unused, [np.arange(6) == 3 + axis for axis in range(3)])


def test_aggregates_that_are_rigid_about_their_centres_have_the_same_motions():
    """A single node and a line have no rotations, neither have rows of constrained axes."""
    rng = np.random.default_rng(6)
    x, free = rng.standard_normal((40, 3)), np.ones((40, 3), dtype=bool)
    free[3], free[7, 1], free[2, 2] = False, False, False
    x[11:14] = x[10] + np.outer([1.0, 2.0, 3.0], [0.3, -0.2, 0.1])
    modes = rigid_modes(x, free)
    owner = np.array([-1 if k == 3 else 0 if k == 1 else 1 if k == 2 else 2 if 10 <= k < 14 else 3 + k % 3 for k in range(40)])
    arms, T, coarse, unused = rigid_aggregates(x, free, owner)
    found = np.einsum("nij,njk->nik", T, coarse[owner])
    whole = owner >= 3
    assert np.abs(found - modes)[whole | (owner == 0) | (owner == 1)].max() < 1e-12
    centre = modes[10:14].mean(axis=0)
    assert np.abs(found[10:14] - centre).max() < 1e-12 and not arms[[1, 2, 3, *range(10, 14)]].any() and not T[3].any()
    assert np.array_equal(unused[0], np.arange(6) > 2) and np.array_equal(unused[1], np.arange(6) > 1)
    assert np.array_equal(unused[2], np.arange(6) > 2) and not unused[3:].any() and not coarse[unused].any()
    for c in range(3, 6):
        own = owner == c
        assert np.abs(arms[own].mean(axis=0)).max() < 1e-12 and abs((arms[own] ** 2).sum(axis=1).mean() - 1.0) < 1e-12


def test_the_smoothed_prolongation_keeps_the_motions_without_energy(several_levels, f64):
    with built(held_box(), "f64") as made:
        K = made.oracle.stiffness(made.oracle.rest, projected=True)
    n = len(made.oracle.rest)
    A = (sp.csr_matrix(K) + 1e-6 * sp.identity(3 * n)).tobsr((3, 3))
    A.sort_indices()
    modes = rigid_modes(made.oracle.rest, np.ones((n, 3), dtype=bool))
    P = Multigrid(A, modes, ti.f64).levels[0].prolongation.to_scipy().toarray()
    for mode in modes.reshape(-1, MODES).T:
        nearest = P @ np.linalg.lstsq(P, mode, rcond=None)[0]
        assert np.linalg.norm(nearest - mode) < 1e-8 * np.linalg.norm(mode)


# --- conjugate gradients ----------------------------------------------------------------------------------------------


def assembled(made, shift: float = 0.0) -> tuple:
    """Matrix and work of a scene at rest, and its matrix and hierarchy on the host; shift [N/m] is added to the matrix."""
    m, A = made.model, block_csr.build_block_csr(made.model, made.arena)
    w = build_pcg(m, made.arena)
    m.free.from_numpy(~made.oracle.fixed)
    block_csr.assemble(m, A, EVERYTHING, True)
    A.diagonal.host[:, [0, 5, 10]] += shift
    free = ~made.oracle.fixed
    f = free.reshape(-1)
    matrix = sp.diags(1.0 * f) @ block_csr.to_scipy(m, A) @ sp.diags(1.0 * f) + sp.diags(1.0 * ~f)
    matrix = matrix.tobsr((3, 3))
    matrix.sort_indices()
    w.rhs.from_numpy(np.random.default_rng(7).standard_normal(free.shape))
    return A, w, matrix, free


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_the_solution_is_scipys(several_levels, precision):
    with built(held_box(), precision) as made:
        A, w, matrix, free = assembled(made, shift=100.0)
        cycle = Multigrid(matrix, rigid_modes(made.oracle.rest, free), made.model.real)
        tolerance = {"f64": 1e-12, "f32": 1e-6}[precision]
        result = host_pcg.solve(made.model, A, w, tolerance, 200, cycle.apply)
        y = w.y.to_numpy().astype(np.float64).reshape(-1)
        exact = spl.spsolve(matrix.tocsc(), (free * w.rhs.to_numpy()).reshape(-1).astype(np.float64))
        assert result.converged and not result.negative and 4 < result.iterations < 60
        assert np.abs(y - exact).max() < 100 * tolerance * np.abs(exact).max()
        assert not y[~free.reshape(-1)].any()
        stopped = host_pcg.solve(made.model, A, w, tolerance, 3, cycle.apply)
        assert stopped.iterations == 3 and not stopped.converged and not stopped.negative


def test_negative_curvature_is_reported():
    with built(held_box(), "f64") as made:
        A, w, matrix, free = assembled(made)
        cycle = Multigrid(matrix, rigid_modes(made.oracle.rest, free), made.model.real)
        A.diagonal.host[:, [0, 5, 10]] -= 3e4
        result = host_pcg.solve(made.model, A, w, 1e-8, 200, cycle.apply)
        assert result.negative and not result.converged
        assert np.isfinite(w.y.to_numpy()).all() and np.sum(w.y.to_numpy() * w.rhs.to_numpy()) > 0.0


def test_iterations_hardly_grow_with_the_mesh(monkeypatch):
    monkeypatch.setattr(multigrid, "SMALL", 300)
    monkeypatch.setattr(multigrid, "NARROW", 0)
    counts, plain = [], []
    for cells in ((6, 3, 3), (12, 6, 6), (24, 12, 12)):
        with built(held_box(cells), "f64") as made:
            A, w, matrix, free = assembled(made)
            cycle = Multigrid(matrix, rigid_modes(made.oracle.rest, free), made.model.real)
            counts.append(host_pcg.solve(made.model, A, w, 1e-8, 200, cycle.apply).iterations)
            plain.append(pcg.solve(made.model, A, w, 1e-8, 2000).iterations)
    assert plain[-1] > 2.5 * plain[0] and counts[-1] < 35 and counts[-1] < 1.5 * counts[1]


# --- as it is chosen --------------------------------------------------------------------------------------------------


def test_statics_of_a_slender_bar():
    result = ts.solve_static(strip(young=1e8), tolerance=1e-6)
    assert result.converged and result.multigrid_solves > 3
    assert result.linear_iterations < 200 * result.iterations


def test_statics_with_an_exact_attachment(several_levels, monkeypatch):
    """The rows of attached nodes are empty: their diagonal blocks must be there all the same."""
    scene = held_box(cells=(10, 4, 4))
    scene.add_body(ts.box_mesh((2, 2, 2), (0.5, 0.5, 0.5)), rubber(), name="knob", position=(1.25, 0.0, 0.0))
    scene.attach("knob", lambda X: X[:, 0] < -0.249, "box")
    plain = ts.solve_static(scene, tolerance=1e-8)
    monkeypatch.setattr(linear_solver, "BUILD", dict.fromkeys(linear_solver.BUILD, -(10**9)))
    result = ts.solve_static(scene, tolerance=1e-8)
    assert result.converged and result.multigrid_solves > 0 and not plain.multigrid_solves
    x, expected = (np.concatenate([one.positions(name) for name in ("box", "knob")]) for one in (result, plain))
    assert np.abs(x - expected).max() < 1e-6


def without_multigrid(monkeypatch):
    monkeypatch.setattr(linear_solver, "BUILD", dict.fromkeys(linear_solver.BUILD, 10**9))


@pytest.mark.parametrize("precision", ["f64", "f32"])
def test_steps_are_those_without_multigrid_also_after_a_release(monkeypatch, precision):
    monkeypatch.setattr(linear_solver, "RATIO", dict.fromkeys(linear_solver.RATIO, 1.0))
    monkeypatch.setattr(linear_solver, "BUILD", dict.fromkeys(linear_solver.BUILD, 50))

    def run() -> tuple:
        scene = strip()
        scene.body("strip").move(lambda X: X[:, 0] > 4.99, lambda t: (0.0, 0.5 * t, 0.0) if t < 0.1 else None)
        with ts.Simulator(scene, dt=1 / 30, integrator="implicit_euler", precision=precision) as sim:
            reports = [sim.step() for _ in range(6)]
            return sim.positions(), reports, sim.field_bytes

    x, reports, sizes = run()
    without_multigrid(monkeypatch)
    other, plain, plain_sizes = run()
    rest = strip().body("strip").rest_positions
    assert np.abs(x - other).max() < {"f64": 1e-6, "f32": 1e-3}[precision] * np.abs(x - rest).max()
    assert all(r.converged for r in reports) and sum(r.multigrid_solves for r in reports[3:]) > 2
    assert sizes["multigrid"] > 10_000 and "multigrid" not in plain_sizes
    assert not any(r.multigrid_solves for r in plain)
    assert sum(r.linear_iterations for r in reports) < 0.5 * sum(r.linear_iterations for r in plain)


@pytest.mark.parametrize(("damping", "wide"), [(0.0, False), (1e-3, False), (0.0, True)])
def test_steps_resume_bitwise(tmp_path, monkeypatch, damping, wide):
    """With a factorisation, and with multigrid as if the band were wide."""
    if wide:
        monkeypatch.setattr(multigrid, "SMALL", 40)
        monkeypatch.setattr(multigrid, "NARROW", 0)
        monkeypatch.setitem(linear_solver.LOADING, False, 0)
    scene = strip()
    scene.body("strip").material = rubber(young=1e9, stiffness_damping=damping)
    path = tmp_path / "checkpoint.npz"
    with ts.Simulator(scene, dt=1 / 30, integrator="implicit_euler", precision="f64") as sim:
        first = [sim.step() for _ in range(4)]
        sim.save_checkpoint(path)
        reports, x = [sim.step() for _ in range(3)], sim.positions()
    assert first[-1].multigrid_solves and all(r.multigrid_solves for r in reports)
    with ts.Simulator.load_checkpoint(path, scene) as sim:
        again = [sim.step() for _ in range(3)]
        assert again == reports and np.array_equal(sim.positions(), x)


def test_where_it_does_not_pay_it_is_given_up(monkeypatch):
    """Multigrid that is said to be slow is tried, and then only after several times the savings."""
    monkeypatch.setattr(linear_solver, "RATIO", dict.fromkeys(linear_solver.RATIO, 400.0))
    monkeypatch.setattr(linear_solver, "ITERATIONS", 0)
    with ts.Simulator(strip(), dt=1 / 30, integrator="implicit_euler", precision="f64") as sim:
        used = [sim.step().multigrid_solves for _ in range(12)]
    assert 0 < sum(used) < 12 and used[-1] == 0


def test_a_soft_scene_does_not_use_it():
    before = runtime.launches["multiply"]
    with ts.Simulator(held_box(), dt=1 / 60, integrator="implicit_euler") as sim:
        reports = [sim.step() for _ in range(3)]
        assert "multigrid" not in sim.field_bytes
    assert not any(r.multigrid_solves for r in reports) and sum(r.linear_iterations for r in reports) > 5
    assert runtime.launches["multiply"] == before


def test_sums_do_not_depend_on_the_number_of_threads():
    """The operator @ on dense vectors calls BLAS, which splits sums among threads."""
    tree = ast.parse(Path(host_pcg.__file__).read_text())
    assert not [node.lineno for node in ast.walk(tree) if isinstance(node, ast.MatMult) or getattr(node, "attr", "") == "dot"]
    assert "np.linalg.norm" not in Path(multigrid.__file__).read_text()
    v = np.random.default_rng(7).standard_normal(20_000)
    assert host_pcg.norm(v) == pytest.approx(np.linalg.norm(v), rel=1e-14)
