"""The arrays of a scene:

* nodes keep the order of the bodies, tets are grouped by law, no block holds two bodies, padding has no volume;
* every corner of every tet is gathered once, at its node;
* loads are those of the oracle and add up to what was asked for;
* one lane, as on CUDA, gives the same forces as four;
* what cannot change while it runs is refused, and nothing is changed then.
"""

import numpy as np
import pytest
from oracle import Oracle
from scenes import COR, SNH, SVK, built, driven_scene, mixed_scene

import taisoft as ts
from taisoft import elasticity
from taisoft.materials import LAWS
from taisoft.model import body_loads, body_masses, build_model, changed_material
from taisoft.runtime import FieldArena
from taisoft.scene.plan import make_plan


@pytest.fixture(scope="module")
def rig():
    with built(mixed_scene(), "f64") as made:
        yield made


def test_nodes_and_masses(rig):
    assert list(rig.layout.node_start) == [0, 12, 20, 28, 36] and rig.model.n_nodes == 36
    assert [len(rig.layout.rest[rig.layout.nodes(k)]) for k in range(4)] == [12, 8, 8, 8]
    assert np.array_equal(rig.layout.rest, rig.oracle.rest) and rig.layout.rest[0, 0] == 0.0  # placed half a metre on
    assert rig.model.mass.to_numpy() == pytest.approx(rig.oracle.mass[:, 0])
    assert body_masses(rig.scene).sum() == pytest.approx(0.99 * (1000 + 1000 + 800 + 1500))


def test_blocks(rig):
    """Tets of one law are neighbours; a body's last lanes are copies of its last tet without volume."""
    lanes, volume = rig.model.lanes, rig.model.volume.to_numpy()
    body, verts = rig.model.block_body.to_numpy(), rig.model.verts.to_numpy()
    assert lanes == 4 and list(rig.layout.n_tets) == [10, 5, 6, 5] and rig.model.n_blocks == 9
    ranges = {law.NAME: (first, last) for law, first, last in rig.model.laws}
    assert ranges == {SVK: (0, 4), COR: (4, 6), SNH: (6, 9)} and list(ranges) == list(LAWS)
    assert list(body) == [1, 1, 3, 3, 2, 2, 0, 0, 0]
    for k, made in enumerate(rig.scene.bodies):
        blocks = body == k
        inside = verts[blocks].transpose(0, 2, 1).reshape(-1, 4) - rig.layout.node_start[k]
        here = {tuple(tet) for tet in np.sort(made.mesh.tets, axis=1)}
        assert {tuple(tet) for tet in np.sort(inside, axis=1)} == here
        assert (volume[blocks] > 0).sum() == made.mesh.n_tets
        assert volume[blocks].sum() == pytest.approx(made.mesh.volumes.sum())


def test_every_corner_is_gathered_once(rig):
    start, entry = rig.model.gather_start.to_numpy(), rig.model.gather_entry.to_numpy()
    verts, volume, lanes = rig.model.verts.to_numpy(), rig.model.volume.to_numpy(), rig.model.lanes
    assert len(entry) == 4 * rig.layout.n_tets.sum() == len(set(entry))
    for node in range(rig.model.n_nodes):
        for at in entry[start[node] : start[node + 1]]:
            block, rest = divmod(at, 12 * lanes)
            corner, lane = divmod(rest, 3 * lanes)
            assert lane < lanes and verts[block, corner, lane] == node and volume[block, lane] > 0


def test_loads(rig):
    total = body_loads(rig.scene)
    assert total == pytest.approx(rig.oracle.loads)
    assert total[:12].sum(axis=0) == pytest.approx(0.9 * 1.1 * np.array([300, 2000, -500]))
    assert total[12:20].sum(axis=0) == pytest.approx([30, -10, 20])
    assert not total[20:].any() and body_loads(driven_scene()) == pytest.approx(Oracle(driven_scene()).loads)


def test_one_lane_gives_the_same_forces(rig):
    rng = np.random.default_rng(3)
    x = rig.oracle.rest + 0.1 * rng.standard_normal(rig.oracle.rest.shape)
    rig.machine.lanes, arena = 1, FieldArena()
    try:
        model, _ = build_model(rig.scene, rig.machine, arena, make_plan(rig.scene, True, False).on)
        assert model.n_blocks == 26
        force = arena.vectors("force", model.real, model.n_nodes)
        model.x.from_numpy(x)
        elasticity.elastic_forces(model)
        elasticity.gather_forces(model, force)
        expected = rig.oracle.force(x)
        assert np.abs(force.to_numpy() - expected).max() < 1e-13 * np.abs(expected).max()
    finally:
        rig.machine.lanes = 4
        arena.release()


@pytest.mark.parametrize(
    "numbers, words",
    [
        ({"law": SVK}, "body 'beam': law cannot change while it runs"),
        ({"young": 1e4, "colour": 1}, "body 'beam': colour cannot change"),
        ({"mass_damping": 1.0}, "body 'beam': mass_damping was 0 everywhere at the start"),
        ({"young": -1.0}, "young must be greater than 0"),
    ],
)
def test_changes_that_are_refused(rig, numbers, words):
    body, before = rig.scene.body("beam"), rig.scene.body("beam").material
    with pytest.raises(ts.SceneError, match=words):
        changed_material(body, numbers, make_plan(rig.scene, False, False).on)
    assert body.material is before
