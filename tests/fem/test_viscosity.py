"""Maxwell branches: the addition to a law is consistent, objective and projected for every F; branches relax and dissipate
exactly between given strains, in every kind of element, and volumes stay elastic; bad branches are refused; files, plan,
`stable_dt`, modes and statics know them.
"""

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.fem.laws import viscosity as addition
from taisoft.fem.terms.elasticity import cauchy_stress, force_differential
from taisoft.fem.viscosity import begin_interval
from taisoft.linear.block_csr import assemble, build_block_csr, to_bsr
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.material import lame_parameters
from taisoft.scene.plan import make_plan
from taisoft.stability import stable_dt
from tests.backend.lanes import load, opened, packed, store, unpacked
from tests.collision.rotations import rotation
from tests.dynamics.scenes import SNH, SVK, built, cube, dynamics, halved, rubber, set_state
from tests.fem.test_laws import MODERATE
from tests.scene.toml_scenes import there_and_back

BRANCHES = ((0.1, 0.5), (0.02, 0.3))
MU, LAM = lame_parameters(1e5, 0.3)
SHEAR = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


@kernel
def evaluate(lanes: ti.template(), A: ti.types.ndarray(), out: ti.types.ndarray()):
    """psi, P, and the exact and the projected differential of the addition. A: F, D and the constants."""
    for b in range(A.shape[0]):
        Z = load(A, b, lanes, 26)
        F, D, p, zero = Z[:9], Z[9:18], Z[18:], [0.0 * Z[k] for k in ti.static(range(9))]
        S, T = addition.prepared(F, p), addition.prepared_projected(F, p)
        store(out, b, 0, [addition.psi(F, p)], lanes)
        store(out, b, 1, addition.add_stress(zero, F, p), lanes)
        store(out, b, 10, addition.add_differential(zero, F, S, D), lanes)
        store(out, b, 19, addition.add_projected(zero, T, D), lanes)


def at_points(F, D, p) -> tuple:
    """psi (k,), P (k,3,3) and the differentials (k,3,3) along D, exact and projected."""
    with opened("f64") as machine:
        rows = np.concatenate([F.reshape(-1, 9), D.reshape(-1, 9), np.tile(p, (len(F), 1))], axis=1)
        blocks = packed(rows, machine.lanes, np.float64)
        out = np.empty((len(blocks), 28, machine.lanes))
        evaluate(machine.lanes, blocks, out)
    found = unpacked(out, len(F))
    return found[:, 0], *(found[:, k : k + 9].reshape(-1, 3, 3) for k in (1, 10, 19))


def test_the_addition_is_consistent_objective_and_projected():
    rng = np.random.default_rng(1)
    p, F, D, h = [3e4, 7.0, 0.3, -0.2, -0.1, 0.15, -0.3, 0.2], MODERATE, rng.standard_normal(MODERATE.shape), 1e-6
    psi, P, exact, projected = at_points(F, D, p)
    (above, P_above, *_), (below, P_below, *_) = (at_points(F + s * h * D, D, p) for s in (1, -1))
    scale = p[0] * (1.0 + np.abs(F).max(axis=(1, 2))) ** 4
    assert (np.abs((above - below) / (2 * h) - np.einsum("kij,kij->k", P, D)) < 1e-7 * scale).all()
    assert (np.abs((P_above - P_below) / (2 * h) - exact) < 1e-7 * scale[:, None, None]).all()
    assert (psi >= p[1]).all() and np.allclose(at_points(rotation((1, 2, 3), 2.0) @ F, D, p)[0], psi, rtol=1e-9)
    assert (np.einsum("kij,kij->k", projected, D) >= -1e-12 * scale).all()
    E = 0.5 * (F[0].T @ F[0] - np.eye(3))
    Z = E - np.trace(E) / 3.0 * np.eye(3)
    _, P, exact, projected = at_points(F[:1], D[:1], [p[0], 0.0, *Z[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]])
    assert np.abs(P).max() < 1e-9 * np.abs(exact).max() and np.allclose(exact, projected, rtol=1e-9, atol=1e-6)


def test_the_assembled_stiffness_is_the_differential_of_the_forces():
    rng = np.random.default_rng(4)
    with built(block(rubber(SVK, branches=BRANCHES)), "f64") as rig:
        m, A = rig.model, build_block_csr(rig.model, rig.arena)
        dx, df = rig.vectors("dx", rng.standard_normal(rig.oracle.rest.shape)), rig.vectors("df")
        m.state.x.from_numpy(rig.oracle.rest + 0.1 * rng.standard_normal(rig.oracle.rest.shape))
        m.viscosity.history.from_numpy(0.1 * rng.standard_normal(m.viscosity.history.shape))
        begin_interval(m, 0.05)
        force_differential(m, dx, df)
        assemble(m, A, False)
        found, expected = to_bsr(m, A) @ dx.to_numpy().reshape(-1), -df.to_numpy().reshape(-1)
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()


def test_branches_are_checked():
    assert rubber(branches=[[0.1, 1], (2, 0.5)]).branches == ((0.1, 1.0), (2.0, 0.5)) and hash(rubber(branches=BRANCHES))
    for bad, words in (
        ([(0.0, 0.5)], "material: relaxation time of branch 0 must be greater than 0 s, not 0"),
        ([(0.1, 0.5), (0.1, -1.0)], "material: fraction of branch 1 must be greater than 0, not -1"),
        ([(0.1,)], "material: branches must be at most 8 pairs (relaxation time, fraction), not "),
        (0.1, "material: branches must be at most 8 pairs"),
        ([(0.1, 0.1)] * 9, "material: branches must be at most 8 pairs"),
    ):
        with pytest.raises(ts.SceneError) as refused:
            rubber(branches=bad)
        assert words in str(refused.value)


def block(material, **arguments) -> ts.Scene:
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(halved(cube(cells=(2, 1, 1))), material, name="block", **arguments)
    return scene


def test_files_plan_and_digests_know_branches(tmp_path):
    given = block({"left": rubber(branches=BRANCHES), 7: rubber()})
    there_and_back(tmp_path / "scene.toml", given, {})
    read, _ = ts.read_scene(tmp_path / "scene.toml")
    assert read.bodies[0].composition.materials[3].branches == BRANCHES and scene_digest(read) == scene_digest(given)
    other = block({"left": rubber(), 7: rubber(branches=BRANCHES)})
    assert scene_digest(other) != scene_digest(given)
    for scene, expected in ((given, "Maxwell branches of block"), (block(rubber()), "no material has branches")):
        assert make_plan(scene, explicit=False, multistep=False).why("viscosity") == expected


KINDS = {
    "quadratic": {"material": rubber(SVK, branches=BRANCHES), "order": 2},
    "mean dilatation": {"material": rubber(SVK, poisson=0.48, branches=BRANCHES), "dilatation": "mean"},
    "regions": {"material": {"left": rubber(SVK, branches=BRANCHES[:1]), 7: rubber(SNH, young=3e5)}},
}


def with_elastic(kind: str) -> ts.Scene:
    """A block of that kind, and one without branches."""
    scene = block(**KINDS[kind])
    scene.add_body(cube((0, 3, 0)), rubber(SVK), name="elastic")
    return scene


@pytest.mark.parametrize("kind", KINDS)
def test_held_strains_relax_and_dissipate_exactly(kind):
    """A sudden shear and compression; the law's own stress stays, that of each branch and its energy decay."""
    scene = with_elastic(kind)
    body = scene.bodies[0]
    small, t = 1e-5, 0.07
    strain = small * (SHEAR + 0.5 * np.diag([-1.0, 1.0, -1.0]))
    mu = np.broadcast_to(body.composition.lame[0], body.mesh.n_tets)
    tau, g = np.moveaxis(body.composition.branches, 2, 0)
    with dynamics(scene, dt=1e-3, integrator="symplectic_euler", precision="f64") as d:
        x = d.state.state()[0]
        set_state(d, x=x + x @ strain.T)
        d.state.move_branches(0.0)
        start, sudden = d.energies(), stresses(d)
        for part in (0.2, 0.5, 0.3):
            d.state.move_branches(part * t)
        end, later, parts = d.energies(), stresses(d), [one.dissipated for one in d.body_energies()]
        history = d.model.viscosity.history.to_numpy()
        kept = d.snapshot()
        d.reset()
        d.restore(kept)
        assert np.array_equal(d.model.viscosity.history.to_numpy(), history)
        d.state.begin_branches(1e9)  # at the end of which the law is left
        relaxed = stresses(d)
    E = 0.5 * (strain + strain.T)
    E = E - np.trace(E) / 3.0 * np.eye(3)
    for found, decay in ((sudden, np.ones_like(tau)), (later, np.exp(-t / tau))):
        modulus = 2.0 * mu * (g * decay).sum(axis=1)
        assert np.allclose(found - relaxed, modulus[:, None, None] * E, atol=1e-4 * 2 * mu.max() * small)
    stored = (mu * body.mesh.volumes)[:, None] * g * (E * E).sum() * (1.0 - np.exp(-2.0 * t / tau))
    assert end.dissipated == pytest.approx(stored.sum(), rel=1e-4) and start.dissipated == 0.0
    assert parts == pytest.approx([end.dissipated, 0.0], rel=1e-12)
    assert end.elastic + end.dissipated == pytest.approx(start.elastic, rel=1e-12)


def stresses(d) -> np.ndarray:
    """Cauchy stresses (n_tets,3,3) [Pa] of the first body."""
    out = np.empty((d.model.n_blocks * d.model.lanes, 9))
    cauchy_stress(d.model, out)
    return out[d.state.layout.lane_of_tet[d.state.layout.tets(0)]].reshape(-1, 3, 3)


def test_a_ramp_is_followed_exactly():
    """One interval in which strains grow linearly equals a hundred parts of it, with what they dissipate."""
    scene, rate = with_elastic("regions"), 1e-4 * SHEAR
    ends = []
    with dynamics(scene, dt=1e-3, integrator="symplectic_euler", precision="f64") as d:
        x = d.state.state()[0]
        for parts in (1, 100):
            d.reset()
            assert d.energies().dissipated == 0.0 and np.abs(stresses(d)).max() < 1e-9
            for k in range(parts):
                set_state(d, x=x + (k + 1) / parts * x @ rate.T)
                d.state.move_branches(0.08 / parts)
            ends.append((stresses(d)[:, 0, 1], d.energies().dissipated))
    assert np.allclose(ends[0][0], ends[1][0], rtol=1e-4, atol=1e-9) and ends[0][1] == pytest.approx(ends[1][1], rel=1e-3)
    assert ends[0][1] > 0.0


def test_modes_and_statics_are_relaxed_and_stable_dt_instantaneous():
    def scene(**numbers) -> ts.Scene:
        made = block(rubber(SVK, **numbers))
        made.bodies[0].fix(lambda X: X[:, 0] < -0.49)
        made.bodies[0].add_force(lambda X: X[:, 0] > 0.49, (0.0, -20.0, 5.0))
        return made

    branched, relaxed = scene(branches=BRANCHES), scene()
    assert np.array_equal(ts.modes(branched, 3).frequencies, ts.modes(relaxed, 3).frequencies)
    assert np.array_equal(ts.solve_static(branched).positions(), ts.solve_static(relaxed).positions())
    bulk, shear = LAM + 2.0 / 3.0 * MU, 1.8 * MU  # at once
    stiff = {"young": 9 * bulk * shear / (3 * bulk + shear), "poisson": (3 * bulk - 2 * shear) / (2 * (3 * bulk + shear))}
    for verlet in (False, True):
        found, expected = (stable_dt(s, verlet) for s in (branched, scene(**stiff)))
        assert found == pytest.approx(expected, rel=1e-6)
