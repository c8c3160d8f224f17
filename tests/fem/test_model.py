"""The device arrays of a scene with bodies of both orders, several laws in a body and numbers by tet:

* nodes keep the order of the bodies, every tet has a lane in a block of its kind and body, padding has no volume;
* every node of every tet is gathered once;
* masses, also the consistent ones, and loads are those of the oracle and add up to the given totals; linear bodies alone have
  lumped masses.
"""

import numpy as np
import pytest

from taisoft.fem.loads import SceneLoads
from taisoft.fem.reference import gravity_masses, lumped_masses, mass_matrix, quadrature, shape_derivatives
from tests.dynamics.scenes import SNH, SVK, built, driven_scene, mixed_scene
from tests.fem.composition import composition
from tests.fem.oracle import Oracle, tet_materials


@pytest.fixture(scope="module")
def rig():
    with built(composition(1, 2), "f64") as rig:
        yield rig


def elements(rig, group) -> np.ndarray:
    """Nodes (blocks, lanes, nodes per element) of a group, from the model's flat array."""
    count = (group.last - group.first) * group.n_nodes * rig.model.lanes
    flat = rig.model.nodes.to_numpy()[group.nodes_at : group.nodes_at + count]
    return flat.reshape(-1, group.n_nodes, rig.model.lanes).transpose(0, 2, 1)


def test_nodes_and_masses(rig):
    counts, m = [43, 8, 8], rig.model
    assert list(rig.layout.node_start) == list(np.cumsum([0, *counts])) and m.n_nodes == sum(counts)
    assert np.array_equal(rig.layout.rest, rig.oracle.rest) and rig.layout.rest[0, 0] == 0.0  # position of the body included
    lumped, M = rig.oracle.lumped[:, 0], rig.oracle.mass
    assert m.mass.to_numpy() == pytest.approx(lumped) and lumped_masses(rig.scene) == pytest.approx(lumped)
    assert np.abs(mass_matrix(rig.scene).toarray() - M).max() < 1e-13 * M.max()
    weight = rig.oracle.consistent.sum(axis=1)
    assert gravity_masses(rig.scene) == pytest.approx(weight) and m.gravity_mass.to_numpy() == pytest.approx(weight)
    assert [body.mass for body in rig.scene.bodies] == pytest.approx([part.sum() for part in np.split(lumped, [43, 51])])
    start, column, stored = (getattr(m.mass_matrix, name).to_numpy() for name in ("row_start", "column", "value"))
    on_device = np.diag(m.mass_matrix.diagonal.to_numpy())
    on_device[np.repeat(np.arange(2 * m.n_nodes), np.diff(start)) % m.n_nodes, column] = stored
    assert m.consistent and np.abs(on_device - M).max() < 1e-13 * M.max()


def test_linear_bodies_have_lumped_masses():
    with built(mixed_scene(), "f64") as rig:
        assert rig.model.mass_matrix is None and not rig.model.consistent
        assert rig.model.gravity_mass.to_numpy() == pytest.approx(rig.oracle.lumped[:, 0])


def test_groups_find_the_points_of_their_quadrature():
    with built(mixed_scene(order=2), "f64") as rig:
        table = rig.model.points.to_numpy()
        for g, degree in zip(rig.model.groups, (2, 2, 4)):
            own, rule = table[g.points_at : g.points_at + g.n_points], quadrature(degree)
            assert np.allclose(own[:, 0], rule.weights) and g.n_points == len(rule.weights)
            s = shape_derivatives(2, rule.points)[:, 1:]
            assert np.allclose(own[:, 1:], (s[:, :, 1:] - s[:, :, :1]).reshape(len(own), 27))


def test_every_tet_has_a_lane_of_its_kind(rig):
    """A body's last block is padded with tets of no volume."""
    m, layout = rig.model, rig.layout
    lanes, volume, body, found = m.lanes, m.volume.to_numpy(), m.block_body.to_numpy(), {}
    groups = [(g.order, g.n_points, getattr(g.law, "law", g.law).NAME, g.first, g.last) for g in m.groups]
    assert groups == [(1, 1, SVK, 0, 4), (2, 4, SNH, 4, 7)] and m.n_blocks == 7
    assert lanes == 4 and list(layout.tet_start) == [0, 10, 16, 21] and list(body) == [1, 1, 2, 2, 0, 0, 0]
    assert (volume > 0).sum() == 21 == len(set(layout.lane_of_tet))
    for g in m.groups:
        for (block, lane), nodes in zip(np.ndindex(g.last - g.first, lanes), elements(rig, g).reshape(-1, g.n_nodes)):
            found[(g.first + block) * lanes + lane] = g, nodes
    for k, made in enumerate(rig.scene.bodies):
        for tet, material in enumerate(tet_materials(made)):
            lane = layout.lane_of_tet[layout.tet_start[k] + tet]
            g, nodes = found[lane]
            assert body[lane // lanes] == k and getattr(g.law, "law", g.law).NAME == material.law
            assert np.array_equal(np.sort(nodes), np.sort(made.nodes.elements[tet]) + layout.node_start[k])
            assert volume.reshape(-1)[lane] == pytest.approx(made.mesh.volumes[tet])


def test_every_node_of_a_tet_is_gathered_once(rig):
    start, entry = rig.model.gather_start.to_numpy(), rig.model.gather_entry.to_numpy()
    volume, lanes, expected = rig.model.volume.to_numpy(), rig.model.lanes, {}
    for g in rig.model.groups:
        own = elements(rig, g)
        for block, lane, node in np.ndindex(own.shape):
            if volume[g.first + block, lane] > 0:
                expected[g.force_at + ((block * g.n_nodes + node) * 3) * lanes + lane] = own[block, lane, node]
    gathered = {e: node for node in range(rig.model.n_nodes) for e in entry[start[node] : start[node + 1]]}
    assert gathered == expected and len(entry) == len(expected)


@pytest.mark.parametrize("order", [1, 2])
def test_loads_equal_the_oracle_and_add_up(order):
    scene = mixed_scene(order=order)
    oracle, total = Oracle(scene), SceneLoads(scene).at(0.0)
    first, second, third, _ = oracle.starts[1:]
    assert total == pytest.approx(oracle.loads) and not total[second:].any()
    assert total[:first].sum(axis=0) == pytest.approx(0.9 * 1.1 * np.array([300, 2000, -500]))
    assert total[first:second].sum(axis=0) == pytest.approx([30, -10, 20])
    driven = driven_scene(order=order)
    assert SceneLoads(driven).at(0.0) == pytest.approx(Oracle(driven).loads)
    forces = np.random.default_rng(0).standard_normal((3, 3))  # one for each node
    scene.body("tower").add_force([4, 2, 7], forces)
    added = SceneLoads(scene).at(0.0) - total
    assert np.abs(added[second + np.array([4, 2, 7])] - forces).max() < 1e-12 and np.count_nonzero(added) == 9
