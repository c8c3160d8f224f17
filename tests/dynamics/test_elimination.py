"""Nonlinear elimination: steps that are first solved on a few nodes:

* these nodes are the fewest that hold nearly all of the residual, plus two rings around them; none if they are many;
* kernels restricted to a subset compute the same rows as on the whole mesh, and write nothing else;
* an elimination moves only its nodes, keeps the multipliers of contacts, and lowers the residual;
* steps with inverted tets, with and without contacts, find the same result in fewer iterations.
"""

import math

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import contact_newton, stage_system
from taisoft.dynamics.contact_terms import NO_CONTACTS
from taisoft.dynamics.elimination import choose_nodes, eliminate
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.stage import ELASTIC_STAGE, STAY, form_residual, move
from taisoft.dynamics.stage_system import StageSystem
from taisoft.linear import block_csr, pcg
from tests.dynamics.contact_scenes import ground, material
from tests.dynamics.scenes import SNH, built, mixed_scene

BETA = 0.01  # [s]


# --- choice of nodes ------------------------------------------------------------------------------------------------------


def line(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a graph in which each node has the next one and the last one as neighbours."""
    rows = [[j for j in (i - 1, i + 1) if 0 <= j < n] for i in range(n)]
    return np.cumsum([0] + [len(row) for row in rows]), np.concatenate(rows)


def test_nodes_that_hold_the_residual_are_chosen():
    residual = np.full((40, 3), 1e-3)
    residual[[7, 30]] = [[5.0, 0.0, 0.0], [0.0, -4.0, 0.0]]
    assert choose_nodes(residual, *line(40)).tolist() == [5, 6, 7, 8, 9, 28, 29, 30, 31, 32]
    residual[30] = 0.1  # less than a hundredth of the whole
    assert choose_nodes(residual, *line(40)).tolist() == [5, 6, 7, 8, 9]
    assert choose_nodes(1e-30 * residual.astype(np.float32), *line(40)).tolist() == [5, 6, 7, 8, 9]


def test_no_nodes_are_chosen_where_many_hold_the_residual():
    residual = np.zeros((40, 3))
    residual[:4] = 1.0
    assert choose_nodes(residual, *line(40)) is not None
    residual[:20] = 1.0
    assert choose_nodes(residual, *line(40)) is None
    for value in (0.0, np.nan, np.inf):
        residual[:] = value
        assert choose_nodes(residual, *line(40)) is None


# --- steps ------------------------------------------------------------------------------------------------------------------


def beam(on_ground: bool) -> ts.Scene:
    """A beam fixed at its left end, optionally with a ground just below it."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((10, 3, 3), (1.0, 0.3, 0.3)), material(), name="beam", position=(0.0, 0.1501, 0.0))
    body.fix(lambda X: X[:, 0] < -0.49)
    if on_ground:
        scene.add_obstacle(ground(), name="ground", friction=0.5)
    return scene


def pinched(scene: ts.Scene) -> np.ndarray:
    """Positions with one node pushed through its tets, far from the fixed end."""
    x = scene.bodies[0].rest_positions + scene.bodies[0].position
    x[np.argmin(np.abs(x - [0.2, 0.25, 0.0]).sum(axis=1))] -= [0.0, 0.25, 0.0]
    return x


def check_elimination(system: StageSystem, stage, r: float, contacts: list):
    """Eliminate, and check what changes; contacts: those of the stage, last."""

    def now():
        return system.model.state.x.to_numpy(), [k.work.multiplier.to_numpy() for k in contacts[-1:]]

    lists, free = system.lists, system.model.free.to_numpy()
    nodes = choose_nodes(free * system.work.residual.to_numpy(), lists.start, lists.column)
    before, multipliers = now()
    found = eliminate(system, stage, r)
    assert (found is None) == (nodes is None) and not system.work.pcg.subset.restricted
    after, kept = now()
    assert all(np.array_equal(a, b) for a, b in zip(multipliers, kept))
    if found is not None:
        assert found.linear > 0.0 and found.newton > 0.0
        moved = (after != before).any(axis=1)
        assert 0 < moved.sum() <= len(nodes) < len(before) and not moved[np.setdiff1d(np.arange(len(before)), nodes)].any()
        left, _ = system.evaluate(None)
        inside = (free * system.work.residual.to_numpy())[nodes]
        assert left < 0.9 * r and np.linalg.norm(inside) < 0.11 * r
        assert system.evaluate(STAY)[0] == pytest.approx(left, rel=1e-9)  # forces were up to date
    return found


@pytest.mark.parametrize("on_ground", [False, True])
def test_steps_with_and_without_eliminations_agree(monkeypatch, on_ground):
    """With eliminations, they take fewer Newton and CG iterations; with contacts, about half the CG iterations."""
    results, found, contacts, build = {}, [], [], stage_system.build_stage_contacts
    monkeypatch.setattr(stage_system, "build_stage_contacts", lambda *args: contacts.append(build(*args)) or contacts[-1])

    def checked(system, stage, r):
        found.append(check_elimination(system, stage, r, contacts))
        return found[-1]

    for name, function in (("with", checked), ("without", lambda system, stage, r: None)):
        monkeypatch.setattr(contact_newton, "eliminate", function)
        with ts.Simulator(beam(on_ground), dt=0.01, precision="f64", newton_tolerance=1e-9, contact_tolerance=1e-8) as sim:
            sim.set_state(positions=pinched(sim.scene))
            report = sim.step()
            assert report.converged
            results[name] = sim.positions(), report
    assert any(one is not None for one in found) and bool(contacts) == on_ground
    (x, report), (x_without, report_without) = results["with"], results["without"]
    assert (report.n_contacts > 0) == on_ground
    assert np.abs(x - x_without).max() < 1e-7
    assert report.linear_iterations < (0.6 if on_ground else 1.0) * report_without.linear_iterations
    assert report.newton_iterations < report_without.newton_iterations or on_ground


# --- restricted kernels ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rig():
    with built(mixed_scene((SNH,) * 4), "f64") as made:
        m, rng = made.model, np.random.default_rng(4)
        made.system = StageSystem(m, made.arena, made.machine.eps, np.zeros(0, dtype=int), NoContacts())
        free = rng.random((m.n_nodes, 3)) < 0.9
        m.free.from_numpy(free.astype(np.float64))
        made.x = made.oracle.rest + 0.03 * rng.standard_normal(made.oracle.rest.shape)
        made.system.work.x_hat.from_numpy(made.oracle.rest)
        made.nodes = np.unique(rng.integers(0, m.n_nodes, m.n_nodes // 6))
        yield made


def evaluate(rig, model, nodes) -> tuple[np.ndarray, ...]:
    """Residual, matrix, solution and norms; rows that kernels do not write are nan. nodes: None for all."""
    system = rig.system
    for field in (system.work.pcg.r, system.work.pcg.p, system.work.pcg.q):
        field.fill(1e3)  # as left by earlier solves
    system.restrict(nodes)
    w, subset = system.work, system.work.pcg.subset
    A, norms = system.matrix, np.zeros(5)
    fields = (w.residual, A.value, A.diagonal, w.pcg.y)
    for field in fields:
        field.fill(np.nan)
    model.state.x.from_numpy(rig.x)
    move(model, w, NO_CONTACTS, ELASTIC_STAGE, STAY, 0.0, 1.0, BETA)
    form_residual(model, w, A, NO_CONTACTS, ELASTIC_STAGE, BETA, norms)
    block_csr.assemble(model, A, subset, True)
    block_csr.to_system(model, A, A, subset, 0, 1.0, BETA)
    answer = pcg.solve(model, A, w.pcg, 1e-12, 2000)
    system.restrict(None)
    assert answer.converged
    return (*(field.to_numpy() for field in fields), norms)


@pytest.mark.parametrize("threads", ["one", pytest.param("all", marks=pytest.mark.long)])
def test_restricted_kernels_compute_the_rows_of_the_whole_mesh(rig, threads):
    model = rig.model if threads == "one" else rig.parallel
    whole = evaluate(rig, model, None)
    A = block_csr.to_scipy(rig.model, rig.system.matrix).toarray()
    residual, value, diagonal, y, norms = evaluate(rig, model, rig.nodes)
    n, some = rig.model.n_nodes, np.isin(np.arange(rig.model.n_nodes), rig.nodes)
    start, column = rig.system.matrix.row_start.to_numpy(), rig.system.matrix.column.to_numpy()
    row = np.repeat(np.arange(2 * n), np.diff(start)) % n
    for restricted, full in ((residual, whole[0]), (diagonal, whole[2])):
        assert np.array_equal(restricted[some], full[some], equal_nan=True) and np.isnan(restricted[~some]).all()
    assert np.array_equal(value[some[row]], whole[1][some[row]], equal_nan=True)
    assert np.isnan(value[~(some[row] | some[column])]).all()
    free = rig.model.free.to_numpy().astype(bool)
    r = np.where(free & some[:, None], residual, 0.0).astype(float)
    assert math.sqrt(norms[0]) == pytest.approx(np.linalg.norm(r), rel=1e-6)
    assert norms[0] < 0.5 * whole[4][0]
    on = (free & some[:, None]).ravel()
    expected = np.zeros(3 * n)
    expected[on] = np.linalg.solve(A[np.ix_(on, on)], -r.ravel()[on])
    found = y[some].ravel()
    assert np.abs(found - expected.reshape(n, 3)[some].ravel()).max() < 1e-9 * np.abs(expected).max()
    assert np.isnan(y[~some]).all()
