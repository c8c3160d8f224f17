"""Nonlinear elimination: steps that are first solved on a few nodes:

* these nodes are the fewest that hold nearly all of the residual, plus two rings around them; none if they are many;
* the lists of a subset name its nodes, edges and blocks, in bodies of both orders; restricted kernels compute the same rows as
  on the whole mesh, in f64 and f32, on one thread and on many, and write nothing else;
* an elimination moves only its nodes, keeps the multipliers of contacts, and lowers the residual;
* steps with inverted tets, with and without contacts, find the same result in fewer iterations.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import contact_newton
from taisoft.dynamics.contact_terms import NO_CONTACTS
from taisoft.dynamics.elimination import FEW, choose_nodes, eliminate, solve_on
from taisoft.dynamics.no_contacts import NoContacts
from taisoft.dynamics.stage import ELASTIC_STAGE, STAY, SubsetLists, form_residual, move
from taisoft.dynamics.stage_system import Stage, StageSystem
from taisoft.fem.node_graph import BLOCKS, EDGES, NODES
from taisoft.linear import block_csr, pcg
from tests.dynamics.scenes import SNH, built, dynamics, mixed_scene, rubber, set_state

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
    n = 40
    residual = np.zeros((n, 3))
    residual[: int(FEW * n)] = 1.0
    assert choose_nodes(residual, *line(n)) is not None
    residual[: int(FEW * n) + 2] = 1.0
    assert choose_nodes(residual, *line(n)) is None
    for value in (0.0, np.nan, np.inf):
        residual[:] = value
        assert choose_nodes(residual, *line(n)) is None


# --- stages -----------------------------------------------------------------------------------------------------------------


def beam(ground: bool = False) -> ts.Scene:
    """A beam fixed at its left end, optionally with a ground just below it."""
    scene = ts.Scene()
    mesh = ts.box_mesh((10, 3, 3), (1.0, 0.3, 0.3))
    body = scene.add_body(mesh, rubber(friction=0.5), name="beam", position=(0.0, 0.1501, 0.0))
    body.fix(lambda X: X[:, 0] < -0.49)
    if ground:
        scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    return scene


SETTINGS = {"dt": 0.01, "precision": "f64", "newton_tolerance": 1e-9, "contact_tolerance": 1e-8}


def pinched(scene: ts.Scene) -> np.ndarray:
    """Positions with one node pushed through its tets, far from the fixed end."""
    x = scene.bodies[0].rest_positions + scene.bodies[0].position
    x[np.argmin(np.abs(x - [0.2, 0.25, 0.0]).sum(axis=1))] -= [0.0, 0.25, 0.0]
    return x


def test_an_elimination_moves_only_its_nodes():
    with dynamics(beam(), **SETTINGS) as made:
        set_state(made, pinched(made.scene))
        stepper = made.stepper
        system, stage = stepper.solver, Stage(1.0, 0.01, 0.01, 1e-9)
        stepper.contact.begin(0.0, 0.01)
        stepper._begin(stepper.scheme, 0.0)
        system.begin(stage)
        r, _ = system.evaluate()
        before = made.state.state()[0]
        lists, free = system.lists, system.model.free.to_numpy()
        nodes = choose_nodes(free * system.work.residual.to_numpy(), lists.start, lists.column)
        found = eliminate(system, stage, r)
        assert found.linear > 0.0 and found.newton > 0.0 and not system.work.pcg.subset.restricted
        moved = (made.state.state()[0] != before).any(axis=1)
        assert 0 < moved.sum() <= len(nodes) < len(before) and not moved[np.setdiff1d(np.arange(len(before)), nodes)].any()
        left, _ = system.evaluate(None)
        inside = (free * system.work.residual.to_numpy())[nodes]
        assert left < 0.9 * r and np.linalg.norm(inside) < 0.11 * r
        assert system.evaluate(STAY)[0] == pytest.approx(left, rel=1e-9)  # forces were up to date


def test_an_elimination_keeps_the_multipliers():
    with dynamics(beam(ground=True), **SETTINGS) as made:
        x = pinched(made.scene)
        set_state(made, x, np.where(made.state.dirichlet.constrained(), 0.0, np.tile([0.0, -0.5, 0.0], (len(x), 1))))
        stepper = made.stepper
        system, stage = stepper.solver, Stage(1.0, 0.01, 0.01, 1e-9, contact_tolerance=1e-8)
        stepper.contact.begin(0.0, 0.01)
        stepper._begin(stepper.scheme, 0.0)
        system.begin(stage)
        system.evaluate()
        r, _ = system.evaluate(None, new_multipliers=True)
        before = system._k.work.multiplier.to_numpy()
        nodes = np.flatnonzero(system.model.free.to_numpy().any(axis=1))[::2]
        assert (before != 0.0).any() and solve_on(system, replace(stage, tolerance=0.0), nodes, 1e-9 * r).newton > 1.0
        assert np.array_equal(system._k.work.multiplier.to_numpy(), before)


@pytest.mark.parametrize("ground", [False, True])
def test_steps_with_and_without_eliminations_agree(monkeypatch, ground):
    """With eliminations, they take fewer Newton and CG iterations; with contacts, less than half the CG iterations."""
    results, calls = {}, []

    def counted(system, stage, r):
        found = eliminate(system, stage, r)
        calls.append(found is not None)
        return found

    for name, function in (("with", counted), ("without", lambda system, stage, r: None)):
        monkeypatch.setattr(contact_newton, "eliminate", function)
        with ts.Simulator(beam(ground), **SETTINGS) as sim:
            sim.set_state(positions=pinched(sim.scene))
            report = sim.step()
            assert report.converged
            results[name] = sim.positions(), report
    assert any(calls)
    (x, report), (x_without, report_without) = results["with"], results["without"]
    assert (report.n_contacts > 0) == ground
    assert np.abs(x - x_without).max() < 1e-7
    assert report.linear_iterations < (0.5 if ground else 1.0) * report_without.linear_iterations
    assert report.newton_iterations < report_without.newton_iterations or ground


# --- lists of a subset, and restricted kernels ------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["f64", "f32"])
def rig(request):
    with built(mixed_scene((SNH,) * 4, order="both", degrees=(2, 2)), request.param) as made:
        m, rng = made.model, np.random.default_rng(4)
        made.system = StageSystem(m, made.arena, made.machine.eps, np.zeros(0, dtype=int), NoContacts())
        free = rng.random((m.n_nodes, 3)) < 0.9
        m.free.from_numpy(free.astype(made.machine.np_real))
        made.x = made.oracle.rest + 0.03 * rng.standard_normal(made.oracle.rest.shape)
        made.system.work.x_hat.from_numpy(made.oracle.rest)
        made.nodes = np.unique(rng.integers(0, m.n_nodes, m.n_nodes // 6))
        made.close = 1e-12 if request.param == "f64" else 2e-5
        yield made


def test_lists_of_a_subset(rig):
    m, A = rig.model, rig.system.matrix
    lists = SubsetLists(m, A)
    try:
        part = lists.subset(rig.nodes)
        count = part.count.to_numpy()
        assert part.node.to_numpy()[: count[NODES]].tolist() == rig.nodes.tolist()
        start, column = A.row_start.to_numpy(), A.column.to_numpy()
        row = np.repeat(np.arange(2 * m.n_nodes), np.diff(start)) % m.n_nodes
        ends = np.sort(np.stack([row[A.edge_upper.to_numpy()], column[A.edge_upper.to_numpy()]], axis=1), axis=1)
        touched = np.flatnonzero(np.isin(ends, rig.nodes).any(axis=1))
        assert 0 < len(touched) < A.n_edges and part.edge.to_numpy()[: count[EDGES]].tolist() == touched.tolist()
        nodes, volume, blocks = m.nodes.to_numpy(), m.volume.to_numpy(), part.block.to_numpy()
        assert len(m.groups) > 1
        for n, g in enumerate(m.groups):
            size = g.n_nodes * m.lanes
            own = nodes[g.nodes_at :][: (g.last - g.first) * size].reshape(-1, g.n_nodes, m.lanes)
            has = (np.isin(own, rig.nodes).any(axis=1) & (volume[g.first : g.last] > 0.0)).any(axis=1)
            listed = blocks[count[BLOCKS + n] : count[BLOCKS + n + 1]]
            assert listed.tolist() == (g.first + np.flatnonzero(has)).tolist()
        assert set(lists.field_bytes) == {"subset_count", "subset_node", "subset_edge", "subset_block"}
    finally:
        lists.release()


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
    answer = pcg.solve(model, A, w.pcg, rig.close, 2000)
    system.restrict(None)
    assert answer.converged
    return (*(field.to_numpy() for field in fields), norms)


@pytest.mark.parametrize("threads", ["one", "all"])
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
    assert np.abs(found - expected.reshape(n, 3)[some].ravel()).max() < 1e3 * rig.close * np.abs(expected).max()
    assert np.isnan(y[~some]).all()
