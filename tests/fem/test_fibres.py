"""Fibres: the addition's energy, stress and differentials against NumPy and finite differences, for any F; stresses of a block
with fibres at an angle and an activated bar against closed forms; energy under the midpoint rule; activation by region, path and
call; harmonic directions; what scene files and refinement keep, and what is refused.
"""

from dataclasses import replace

import numpy as np
import pytest
import taichi as ti

import taisoft as ts
from taisoft.backend.runtime import kernel
from taisoft.errors import MeshError, SceneError, SimulationError
from taisoft.fem.fibres import fibre_tangent
from taisoft.fem.laws import fibres, stable_neo_hookean
from taisoft.fem.laws.additions import WithAdditions
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.numbers import scene_numbers, set_numbers
from taisoft.scene.refine import refined, with_order
from taisoft.stability import highest_frequency, hooke_stiffness
from tests.backend.lanes import load, opened, packed, store, unpacked
from tests.dynamics.scenes import SNH, cube, halved, rubber
from tests.fem import oracle_laws as oracle
from tests.fem.matrices import MATRICES
from tests.scene.toml_scenes import there_and_back

ARRAY = ti.types.ndarray()
MESH = halved(cube(cells=(2, 1, 1)))
MUSCLE = rubber(fibre_stiffness=3e4, fibre_exponent=2.0, active_stress=4e4, active_strain=0.2)
TILTED = np.array([np.cos(0.4), np.sin(0.4), 0.0])


def fibre_energy(F, a, k1, k2, T, s):
    """The energy density (k,) [Pa] of the fibres; F may be complex."""
    I4 = np.einsum("kij,j,kil,l->k", F, a, F, a)
    d = np.where((s * I4).real > 1.0, s * I4 - 1.0, 0.0)
    return (k1 / (2 * k2) * (np.exp(k2 * d**2) - 1.0) if k2 else k1 / 2 * d**2) + T * (np.sqrt(I4) - 1.0)


def fibre_stress(F, a, k1, k2, T, s):
    """Its derivative (k,3,3) by complex steps."""
    energy = [fibre_energy(F + 1e-30j * D, a, k1, k2, T, s).imag / 1e-30 for D in oracle.UNIT]
    return np.stack(energy, axis=-1).reshape(-1, 3, 3)


def numbers(material: ts.Material, activation: float) -> tuple:
    """(k1, k2, T, s) of a material at an activation."""
    s = (1.0 - activation * material.active_strain) ** -2
    return material.fibre_stiffness, material.fibre_exponent, activation * material.active_stress, s


LAW = WithAdditions(stable_neo_hookean, (fibres,))
CASES = [(TILTED, 3e4, 2.0, 4e4, 1.3), (TILTED, 5e4, 0.0, 0.0, 1.0), (np.eye(3)[2], 0.0, 1.0, 3e4, 1.0)]
each_case = pytest.mark.parametrize("a, k1, k2, T, s", CASES)


@kernel
def evaluate(law: ti.template(), lanes: ti.template(), F: ARRAY, D: ARRAY, p: ARRAY, out: ARRAY):
    """psi, then the stress, its differential along D and the projected one, of blocks of lanes."""
    for b in range(F.shape[0]):
        G, H = load(F, b, lanes, 9), load(D, b, lanes, 9)
        c = [ti.Vector([p[k] for q in ti.static(range(lanes))]) for k in ti.static(range(11))]
        energy = [law.psi(G, c)]
        store(out, b, 0, energy, lanes)
        store(out, b, 1, law.pk1(G, c), lanes)
        store(out, b, 10, law.dpk1(G, law.prepare(G, c), H), lanes)
        store(out, b, 19, law.dpk1_projected(law.prepare_projected(G, c), H), lanes)


def everything(F, D, *case) -> tuple:
    """psi (k,), P, dP and the projected dP (k,3,3) of the law with fibres."""
    p = np.concatenate([stable_neo_hookean.constants(1e4, 2e4), case[0], case[1:]])
    with opened("f64") as runtime:
        blocks, along = (packed(values, runtime.lanes, np.float64) for values in (F, np.broadcast_to(D, F.shape)))
        out = np.zeros((len(blocks), 28, runtime.lanes))
        evaluate(LAW, runtime.lanes, blocks, along, p, out)
    found = unpacked(out, len(F))
    return found[:, 0], *(found[:, k : k + 9].reshape(-1, 3, 3) for k in (1, 10, 19))


def values(F, *case) -> tuple:
    return everything(F, np.zeros((3, 3)), *case)[:2]


def differential(F, D, projected, *case) -> np.ndarray:
    return everything(F, D, *case)[3 if projected else 2]


NEAR = np.eye(3) + 0.25 * np.random.default_rng(1).standard_normal((60, 3, 3))
PLAIN = (TILTED, 0.0, 0.0, 0.0, 1.0)  # the law without fibres


@each_case
def test_energy_and_stress_follow_the_formula_and_differentials_the_stress(a, k1, k2, T, s):
    case, I4 = (a, k1, k2, T, s), s * (np.einsum("kij,j->ki", NEAR, a) ** 2).sum(axis=1)
    F = NEAR[(np.abs(I4 - 1.0) > 1e-3) & (I4 < 4.0)]  # away from the jump of the stiffness
    assert len(F) > 40 and (I4 > 1.0).any() and (I4 < 1.0).any()
    psi, P = (one - other for one, other in zip(values(F, *case), values(F, *PLAIN)))
    size = 1.0 + np.abs(fibre_energy(F, *case))
    assert np.abs(psi - fibre_energy(F, *case)).max() < 1e-12 * size.max()
    assert np.abs(P - fibre_stress(F, *case)).max() < 1e-12 * np.abs(P).max() > 0.0
    D, h = np.random.default_rng(2).standard_normal(F.shape), 1e-6
    dP = differential(F, D, False, *case)
    moved = (values(F + h * D, *case)[1] - values(F - h * D, *case)[1]) / (2 * h)
    assert np.abs(dP - moved).max() < 1e-6 * np.abs(dP).max()
    assert np.abs(unprojected(F, *case)).max() < 1e-12 * np.abs(dP).max()


def unprojected(F, *case) -> np.ndarray:
    """Fibres' part of the differential minus its projection, which is the same: no eigenvalue is negative."""
    apart = [differential(F, D, False, *case) - differential(F, D, False, *PLAIN) for D in oracle.UNIT]
    projected = [differential(F, D, True, *case) - differential(F, D, True, *PLAIN) for D in oracle.UNIT]
    H = np.stack(apart, axis=1).reshape(len(F), 9, 9)
    assert np.linalg.eigvalsh((H + oracle.transposed(H)) / 2).min() > -1e-10 * np.abs(H).max()
    return H - np.stack(projected, axis=1).reshape(len(F), 9, 9)


@each_case
def test_any_deformation_gradient_is_valid(a, k1, k2, T, s):
    case = (a, k1, k2, T, s)
    for kind in ("zero", "rank 2", "inverted", "huge"):
        F = MATRICES[kind] * (1e-12 if kind == "huge" else 1.0)
        psi, P = values(F, *case)
        D = np.random.default_rng(2).standard_normal(F.shape)
        assert all(np.isfinite(x).all() for x in (psi, P, differential(F, D, False, *case), differential(F, D, True, *case))), (
            kind
        )
    # beyond the bounds of the exponential, and where |F a| is tiny, the stress is still the derivative of the energy
    for F in (np.diag([3.0, 2.0, 9.0])[None], 5e-4 * np.eye(3)[None]):
        D, h = np.ones((1, 3, 3)), 1e-7
        slope = (values(F + h * D, *case)[0] - values(F - h * D, *case)[0]) / (2 * h)
        assert (values(F, *case)[1] * D).sum() == pytest.approx(slope[0], rel=1e-5, abs=0.1)


def block(material=MUSCLE, order: int = 1, mesh=MESH, **directions) -> ts.Scene:
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(mesh, material, name="muscle", order=order, **({"fibres": TILTED} | directions))
    return scene


@pytest.mark.parametrize("order, change", [(1, {}), (2, {}), (1, {"poisson": 0.47, "volume_floor": 0.05})])
def test_stress_of_a_block_with_fibres_at_an_angle_has_its_closed_form(order, change, tmp_path):
    """The last one has mean dilatation and a volume floor that does not act."""
    material = replace(MUSCLE, **change)
    scene, F = block(material, order), np.array([[1.2, 0.1, 0.0], [0.05, 0.95, 0.1], [0.0, 0.0, 1.05]])
    with ts.Simulator(scene, precision="f64") as sim:
        for activation in (0.0, 0.75):
            sim.set_activation("muscle", activation)
            sim.set_state(positions=scene.bodies[0].rest_positions @ F.T)
            case = (TILTED, *numbers(material, activation))
            P = oracle.pk1(SNH, F[None], material.young, material.poisson) + fibre_stress(F[None], *case)
            sigma = P[0] @ F.T / np.linalg.det(F)
            assert np.abs(sim.stress() - sigma).max() < 1e-8 * np.abs(sigma).max()
            psi = oracle.psi(SNH, F[None], material.young, material.poisson) + fibre_energy(F[None], *case)
            assert sim.energies().elastic == pytest.approx(psi[0] * MESH.volumes.sum(), rel=1e-10)
            assert np.allclose(sim.fibres(), F @ TILTED, atol=1e-14)
        sim.write_vtu(tmp_path / "a.vtu")
        assert np.allclose(ts.read_mesh(tmp_path / "a.vtu").fibres, F @ TILTED, atol=1e-6)
        softer = replace(material, fibre_stiffness=1e4)
        sim.set_material("muscle", fibre_stiffness=1e4)
        P = oracle.pk1(SNH, F[None], softer.young, softer.poisson) + fibre_stress(F[None], TILTED, *numbers(softer, 0.75))
        assert np.abs(sim.stress() - P[0] @ F.T / np.linalg.det(F)).max() < 1e-8 * np.abs(P).max()


def bar(material: ts.Material, activation) -> ts.Scene:
    """A bar along its fibres that contracts freely."""
    scene = block(material, fibres=(2.0, 0.0, 0.0))
    body = scene.bodies[0]
    for k, axis in enumerate("xyz"):
        body.fix(lambda X, k=k: X[:, k] < X[:, k].min() + 1e-9, axis)
    body.activate(activation)
    return scene


@pytest.mark.parametrize("change", [{}, {"active_strain": 0.0}, {"active_stress": 0.0, "fibre_exponent": 0.0}])
def test_an_activated_bar_contracts_as_in_uniaxial_stress(change):
    from scipy.optimize import fsolve

    material, A = replace(MUSCLE, **change), 0.6

    def stresses(stretches):
        F = np.diag([stretches[0], stretches[1], stretches[1]])[None]
        P = oracle.pk1(SNH, F, material.young, material.poisson)
        P = P + fibre_stress(F, np.eye(3)[0], *numbers(material, A))
        return P[0, 0, 0] / 1e5, P[0, 1, 1] / 1e5

    along, across = fsolve(stresses, (0.9, 1.0), xtol=1e-13)
    result = ts.solve_static(bar(material, A), precision="f64")
    assert result.converged and result.residual < 1e-6 and along < 0.98
    extent = np.ptp(result.positions(), axis=0) / np.ptp(MESH.vertices, axis=0)
    assert np.abs(extent - (along, across, across)).max() < 1e-6


def test_midpoint_steps_conserve_the_energy_of_fibres():
    changes = []
    for dt in (2e-3, 5e-4):
        scene = block()
        body = scene.bodies[0]
        body.activate(0.5)
        body.velocity = body.rest_positions * (1.5, -1.0, 0.5)
        with ts.Simulator(scene, dt=dt, integrator="implicit_midpoint", precision="f64") as sim:
            total, kinetic = [], []
            for _ in range(round(0.1 / dt)):
                report = sim.step()
                total.append(report.kinetic + report.elastic)
                kinetic.append(report.kinetic)
            changes.append(np.ptp(total) / np.ptp(kinetic))
    assert changes[0] < 1e-3 and changes[1] < 0.2 * changes[0]  # the rule is of second order


def test_activation_follows_paths_regions_and_calls_and_creates_no_energy_error(tmp_path):
    scene = block()
    body = scene.bodies[0]
    body.fix(lambda X: X[:, 0] < -0.49)
    body.activate(ts.KeyFrames(times=[0.0, 0.02], values=[0.0, 0.8]), region="left")
    body.activate(lambda t: 0.1, region=7)
    assert [one.region for one in body.activations] == [3, 7]
    found = scene_numbers(scene)
    assert found["muscle.left.activation"] is None and found["muscle.activation"] is None
    with ts.Simulator(scene, dt=2e-3, precision="f64") as sim:
        assert sim.plan.on["fibres"] and sim.run(0.02).status == "ok"
        assert sim.fibres()[MESH.regions == 3].mean() < sim.fibres()[MESH.regions == 7].mean()
        sim.set_activation("muscle", 0.5, region="left")
        sim.set_activation("muscle", 0.5, region=7)
        assert scene_numbers(sim.scene)["muscle.activation"] == 0.5 and sim.run(0.02).status == "ok"
        sim.save_checkpoint(tmp_path / "a.npz")
        sim.step()
        x = sim.positions()
        for change, message in (
            ((1.5,), "must lie from 0 to 1, not 1.5"),
            ((0.5, "right"), "right"),
            ((abs,), "must be a number"),
        ):
            with pytest.raises(SceneError, match=message):
                sim.set_activation("muscle", *change)
    with ts.Simulator.load_checkpoint(tmp_path / "a.npz", scene) as sim:
        sim.step()
        assert np.array_equal(sim.positions(), x)
    scene = block()
    scene.bodies[0].activate(lambda t: 0.0 if t == 0.0 else 2.0)
    with (
        ts.Simulator(scene, dt=2e-3, precision="f64") as sim,
        pytest.raises(SimulationError, match="gave 2 at t = .*from 0 to 1"),
    ):
        sim.step()
    changed = block({"left": MUSCLE, 7: MUSCLE})
    set_numbers(changed, {"muscle.activation": 0.25, "muscle.left.active_stress": 1e3})
    assert [float(one.value) for one in changed.bodies[0].activations] == [0.25, 0.25]
    assert changed.bodies[0].composition.number("active_stress").tolist() == np.where(MESH.regions == 3, 1e3, 4e4).tolist()


def test_explicit_steps_follow_a_path_and_stable_dt_bounds_fibres():
    scene = block(mesh=cube(cells=(2, 1, 1)), fibres=(1.0, 0.0, 0.0))
    body = scene.bodies[0]
    body.activate(0.3)
    K = hooke_stiffness(body).toarray()
    with ts.Simulator(scene, dt=1e-4, integrator="symplectic_euler", precision="f64") as sim:
        u = np.random.default_rng(4).standard_normal((body.n_nodes, 3))
        expected = -(K @ u.reshape(-1)).reshape(-1, 3)
        assert np.abs(sim.force_differential(u) - expected).max() < 1e-10 * np.abs(expected).max()
    plain = ts.Scene().add_body(body.mesh, rubber(), name="plain")
    assert highest_frequency(body) > 1.2 * highest_frequency(plain)
    eigenvalues = [np.linalg.eigvalsh(fibre_tangent(body, A)[0]) for A in (0.0, 0.3, 1.0)]
    assert all((one <= other).all() for one, other in zip(eigenvalues, eigenvalues[1:]))  # so that full activation is a bound
    scene = block(mesh=body.mesh, fibres=(1.0, 0.0, 0.0))
    scene.bodies[0].activate(lambda t: min(1.0, 200.0 * t))
    with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler", precision="f64") as sim:
        sim.dt = 0.5 * sim.stable_dt
        assert sim.run(0.02).status == "ok" and np.ptp(sim.positions()[:, 0]) < 0.97


def test_harmonic_fibres_run_from_one_end_to_the_other():
    ring = ts.box_mesh((24, 3, 3), (1.0, 0.2, 0.2), (0.5, 0.0, 0.0), "six")
    angle, radius = 0.5 * np.pi * ring.vertices[:, 0], 1.0 + ring.vertices[:, 1]
    ring = ts.TetMesh(np.stack([radius * np.sin(angle), radius * np.cos(angle), ring.vertices[:, 2]], axis=1), ring.tets)
    found = ts.harmonic_fibres(ring, lambda X: X[:, 0] < 1e-9, np.flatnonzero(ring.vertices[:, 1] < 1e-9))
    x = ring.vertices[ring.tets].mean(axis=1)
    around = np.stack([x[:, 1], -x[:, 0], 0.0 * x[:, 0]], axis=1) / np.linalg.norm(x[:, :2], axis=1, keepdims=True)
    assert np.allclose(np.linalg.norm(found, axis=1), 1.0) and (found * around).sum(axis=1).min() > 0.99
    with pytest.raises(SceneError, match="harmonic_fibres: end: no vertex is chosen"):
        ts.harmonic_fibres(ring, [0], [])
    with pytest.raises(MeshError, match="vertex 1 is chosen by start and by end"):
        ts.harmonic_fibres(ring, [0, 1], [1, 2])
    with pytest.raises(MeshError, match="no gradient in tet 0"):
        ts.harmonic_fibres(cube(), [0, 1, 2, 3, 4, 5, 6], [7])


def test_scene_files_refinement_and_other_orders_keep_fibres(tmp_path):
    rng = np.random.default_rng(0)
    by_tet = rng.standard_normal((MESH.n_tets, 3))
    with_data = ts.TetMesh(MESH.vertices, MESH.tets, regions=MESH.regions, region_names=dict(MESH.region_names), fibres=by_tet)
    for mesh, directions in ((MESH, {}), (MESH, {"fibres": by_tet}), (with_data, {"fibres": None})):
        scene = block(mesh=mesh, **directions)
        scene.bodies[0].activate(0.3, region="left")
        scene.bodies[0].activate(ts.KeyFrames(times=[0.0, 1.0], values=[0.0, 1.0]), region=7)
        there_and_back(tmp_path / "scene.toml", scene, {})
        assert scene_digest(ts.read_scene(tmp_path / "scene.toml")[0]) == scene_digest(scene)
        fine, quadratic = refined(scene).bodies[0], with_order(scene, 2).bodies[0]
        assert np.array_equal(fine.fibres, np.repeat(scene.bodies[0].fibres, 8, axis=0))
        assert fine.activations == quadratic.activations == scene.bodies[0].activations
    assert np.allclose(ts.place(with_data, up="z", scale=2.0).fibres, 2.0 * by_tet[:, [0, 2, 1]] * (1.0, 1.0, -1.0))


WITHOUT = np.where(np.arange(MESH.n_tets)[:, None] == 2, 0.0, TILTED)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"fibres": None}, "body 'muscle': its material has fibres, so it needs their directions"),
        ({"material": rubber()}, "body 'muscle': it has fibres, but fibre_stiffness, .* of its material are 0"),
        ({"fibres": WITHOUT}, "body 'muscle': fibres: the direction of tet 2 is zero"),
        ({"fibres": np.where(WITHOUT == 0.0, np.nan, 1.0)}, "fibres: entry .0, 2. is nan, not finite"),
        ({"fibres": np.ones((4, 3))}, r"fibres must have shape \(3,\) or \(10, 3\), not \(4, 3\)"),
        ({"fibres": lambda x: x / 0}, None),
        ({"fibres": lambda x: y}, "the function of fibres failed"),  # noqa: F821
    ],
)
def test_refused_directions(change, message):
    if message is None:
        with pytest.raises(SceneError, match="not finite"), np.errstate(all="ignore"):
            block(**change)
        return
    with pytest.raises(SceneError, match=message):
        block(**change)


def test_refused_numbers_and_activations():
    for change in ({"fibre_stiffness": -1.0}, {"fibre_exponent": -1.0}, {"active_stress": -1.0}, {"active_strain": 1.0}):
        with pytest.raises(SceneError, match=f"material: {next(iter(change))} must be"):
            rubber(**change)
    plain = ts.Scene().add_body(MESH, rubber(), name="plain")
    with pytest.raises(SceneError, match="body 'plain': activate: it has no fibres"):
        plain.activate(0.5)
    with pytest.raises(SceneError, match="its material has fibres, so it needs their directions"):
        plain.material = MUSCLE
    with pytest.raises(SceneError, match=r"body 'muscle': activate: the path must give|must be a number"):
        block().bodies[0].activate(lambda t: None)
    with pytest.raises(MeshError, match=r"fibres must have shape \(10, 3\)"):
        ts.TetMesh(MESH.vertices, MESH.tets, fibres=np.ones(3))


def test_regions_without_fibres_need_no_directions_and_numbers_differ_by_region():
    directions = np.where((MESH.regions == 3)[:, None], TILTED, 0.0)
    scene = block({"left": MUSCLE, 7: rubber()}, fibres=directions)
    with ts.Simulator(scene, precision="f64") as sim:
        sim.set_state(positions=1.1 * MESH.vertices)
        plain = oracle.pk1(SNH, 1.1 * np.eye(3)[None], MUSCLE.young, MUSCLE.poisson)[0] / 1.1**2
        assert np.abs(sim.stress()[MESH.regions == 7] - plain).max() < 1e-8 * np.abs(plain).max()
        assert np.abs(sim.stress()[MESH.regions == 3] - plain).max() > 0.1 * np.abs(plain).max()
        sim.set_material("muscle", region="left", fibre_stiffness=0.0)
        assert np.abs(sim.stress() - plain).max() < 1e-8 * np.abs(plain).max()
        with pytest.raises(SceneError, match="the direction of tet . is zero, but its material has fibres"):
            sim.set_material("muscle", region=7, fibre_stiffness=1.0)


def test_scenes_without_fibres_have_none_of_their_data():
    scene = ts.Scene()
    scene.add_body(MESH, rubber(), name="plain")
    with ts.Simulator(scene, precision="f64") as sim:
        assert not sim.plan.on["fibres"] and not {"fibres", "fibre_slot", "amplitudes"} & set(sim.field_bytes)
