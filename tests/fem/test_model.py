"""The device arrays of a scene, with linear bodies alone and with linear and quadratic ones:

* nodes keep the order of the bodies, tets are grouped by kind, no block holds tets of two bodies, padding has no volume;
* every node of every tet is gathered once;
* loads are those of the oracle and add up to the given totals;
* one lane per block, as on CUDA, gives the same forces as four;
* material numbers that cannot change at run time are refused, and nothing changes.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.fem.loads import SceneLoads
from taisoft.fem.model import build_model
from taisoft.fem.reference import gravity_masses, lumped_masses, mass_matrix
from taisoft.fem.terms import elasticity
from taisoft.scene.plan import change_material, make_plan
from tests.dynamics.scenes import COR, SNH, SVK, built, driven_scene, mixed_scene
from tests.fem.oracle import Oracle


@pytest.fixture(scope="module", params=[1, "both"])
def rig(request):
    with built(mixed_scene(order=request.param), "f64") as rig:
        yield rig


def quadratic(rig) -> bool:
    return rig.scene.bodies[0].order == 2


def elements(rig, group) -> np.ndarray:
    """Nodes (blocks, lanes, nodes per element) of a group, from the model's flat array."""
    count = (group.last - group.first) * group.n_nodes * rig.model.lanes
    flat = rig.model.nodes.to_numpy()[group.nodes_at : group.nodes_at + count]
    return flat.reshape(-1, group.n_nodes, rig.model.lanes).transpose(0, 2, 1)


def test_nodes_and_masses(rig):
    counts = [43, 8, 27, 8] if quadratic(rig) else [12, 8, 8, 8]
    assert list(rig.layout.node_start) == list(np.cumsum([0, *counts])) and rig.model.n_nodes == sum(counts)
    assert [len(rig.layout.rest[rig.layout.nodes(k)]) for k in range(4)] == counts
    assert np.array_equal(rig.layout.rest, rig.oracle.rest) and rig.layout.rest[0, 0] == 0.0  # position of the body included
    lumped, M = rig.oracle.lumped[:, 0], rig.oracle.mass
    assert rig.model.mass.to_numpy() == pytest.approx(lumped) and lumped_masses(rig.scene) == pytest.approx(lumped)
    assert np.abs(mass_matrix(rig.scene).toarray() - M).max() < 1e-13 * M.max()
    assert gravity_masses(rig.scene) == pytest.approx(M.sum(axis=1))
    assert rig.model.gravity_mass.to_numpy() == pytest.approx(M.sum(axis=1))
    assert [lumped.sum(), M.sum()] == pytest.approx([0.99 * (1000 + 1000 + 800 + 1500)] * 2)
    assert (rig.model.mass_matrix is not None) == rig.model.consistent == quadratic(rig)


def test_the_device_mass_matrix_is_consistent(rig):
    if not quadratic(rig):
        assert rig.model.mass_matrix is None
        return
    mass, n = rig.model.mass_matrix, rig.model.n_nodes
    start, column = mass.row_start.to_numpy(), mass.column.to_numpy()
    M = np.diag(mass.diagonal.to_numpy())
    M[np.repeat(np.arange(2 * n), np.diff(start)) % n, column] = mass.value.to_numpy()
    assert np.abs(M - rig.oracle.mass).max() < 1e-13 * M.max()


def test_tets_are_grouped_in_blocks_by_kind_and_body(rig):
    """A body's last block is padded with tets of no volume."""
    lanes, volume = rig.model.lanes, rig.model.volume.to_numpy()
    body = rig.model.block_body.to_numpy()
    assert lanes == 4 and list(rig.layout.tet_start) == [0, 10, 15, 21, 26] and rig.model.n_blocks == 9
    groups = [(g.order, g.n_points, g.law.NAME, g.first, g.last) for g in rig.model.groups]
    if quadratic(rig):
        assert groups == [(1, 1, SVK, 0, 4), (2, 4, SNH, 4, 7), (2, 14, COR, 7, 9)]
        assert list(body) == [1, 1, 3, 3, 0, 0, 0, 2, 2]
    else:
        assert groups == [(1, 1, SVK, 0, 4), (1, 1, COR, 4, 6), (1, 1, SNH, 6, 9)]
        assert list(body) == [1, 1, 3, 3, 2, 2, 0, 0, 0]
    for g in rig.model.groups:
        for k in set(body[g.first : g.last]):
            nodes, mesh, own = rig.scene.bodies[k].nodes, rig.scene.bodies[k].mesh, body[g.first : g.last] == k
            tets = elements(rig, g)[own].reshape(-1, g.n_nodes) - rig.layout.node_start[k]
            assert {tuple(tet) for tet in np.sort(tets, axis=1)} == {tuple(tet) for tet in np.sort(nodes.elements, axis=1)}
            assert (volume[body == k] > 0).sum() == mesh.n_tets
            assert volume[body == k].sum() == pytest.approx(mesh.volumes.sum())


def test_every_node_of_a_tet_is_gathered_once(rig):
    start, entry = rig.model.gather_start.to_numpy(), rig.model.gather_entry.to_numpy()
    volume, lanes, expected = rig.model.volume.to_numpy(), rig.model.lanes, {}
    for g in rig.model.groups:
        for at in np.ndindex(elements(rig, g).shape):
            block, lane, node = at
            if volume[g.first + block, lane] > 0:
                place = g.force_at + ((block * g.n_nodes + node) * 3) * lanes + lane
                expected[place] = elements(rig, g)[at]
    gathered = {e: node for node in range(rig.model.n_nodes) for e in entry[start[node] : start[node + 1]]}
    assert gathered == expected and len(entry) == len(expected)


def test_loads_equal_the_oracle_and_add_up(rig):
    total, start = SceneLoads(rig.scene).at(0.0), rig.layout.node_start
    assert total == pytest.approx(rig.oracle.loads)
    assert total[: start[1]].sum(axis=0) == pytest.approx(0.9 * 1.1 * np.array([300, 2000, -500]))
    assert total[start[1] : start[2]].sum(axis=0) == pytest.approx([30, -10, 20])
    driven = driven_scene(order="both" if quadratic(rig) else 1)
    assert not total[start[2] :].any() and SceneLoads(driven).at(0.0) == pytest.approx(Oracle(driven).loads)


def test_a_force_may_have_one_value_per_node(rig):
    scene, forces = rig.scene.snapshot(), np.random.default_rng(0).standard_normal((3, 3))
    scene.body("tower").add_force([4, 2, 7], forces)
    added = SceneLoads(scene).at(0.0) - SceneLoads(rig.scene).at(0.0)
    nodes = rig.layout.node_start[2] + np.array([4, 2, 7])
    assert np.abs(added[nodes] - forces).max() < 1e-12 and np.count_nonzero(added) == 9


def test_one_lane_gives_the_same_forces(rig):
    rng = np.random.default_rng(3)
    x = rig.oracle.rest + 0.1 * rng.standard_normal(rig.oracle.rest.shape)
    rig.machine.lanes, arena = 1, FieldArena()
    try:
        model, _ = build_model(rig.scene, rig.machine, arena, make_plan(rig.scene, True, False).on)
        assert model.n_blocks == 26
        force = arena.vectors("force", model.real, model.n_nodes)
        model.state.x.from_numpy(x)
        elasticity.elastic_forces(model)
        elasticity.gather_forces(model, force)
        expected = rig.oracle.force(x)
        assert np.abs(force.to_numpy() - expected).max() < 1e-13 * np.abs(expected).max()
    finally:
        rig.machine.lanes = 4
        arena.release()


@pytest.mark.parametrize(
    "numbers, message",
    [
        ({"law": SVK}, "body 'beam': law cannot change while it runs"),
        ({"young": 1e4, "colour": 1}, "body 'beam': colour cannot change"),
        ({"mass_damping": 1.0}, "body 'beam': mass_damping was 0 everywhere at the start"),
        ({"young": -1.0}, "young must be greater than 0"),
    ],
)
def test_invalid_changes_of_a_material_are_refused(rig, numbers, message):
    body, before = rig.scene.body("beam"), rig.scene.body("beam").material
    with pytest.raises(ts.SceneError, match=message):
        change_material(body, numbers, make_plan(rig.scene, False, False).on)
    assert body.material is before
