"""Laws with a volume floor:

* psi, P, dP and the projected dP equal the oracle's for J from -0.2 to 0.2 and beyond, P and dP are derivatives by finite
  differences, dP is symmetric, psi and P rotate with F; all are finite for degenerate F;
* from J = floor on they are the law's own, bit for bit; the second derivative has no jump at J = floor and J = 0;
* with mean dilatation, in both orders, it adds the same energy, of which force and tangent are derivatives;
* a column under a load that turns the law inside out stands at the volume that the formula gives; a squeezed block keeps its
  tets, in implicit steps, and in explicit ones below `stable_dt`, which counts the floor, also with mean dilatation, by region;
* explicit and implicit steps, with damping, are the oracle's; changed numbers and resumed runs work; regions may differ in it;
* a scene without it has no number for it, and a body without it in a scene with one moves as alone, bit for bit.

Assembled matrices and forces of bodies with and without one are compared with the oracle in `test_elasticity`.
"""

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator, eigsh

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.errors import SimulationError
from taisoft.fem.laws import LAWS
from taisoft.fem.laws.evaluate import evaluate_differential
from taisoft.fem.reference import lumped_mass, shape_gradients
from taisoft.stability import stable_dt
from tests.dynamics.following import follow, simulator
from tests.dynamics.scenes import COR, SNH, SVK, cube, halved, mixed_scene, rubber
from tests.fem import oracle_laws as oracle
from tests.fem.matrices import MATRICES, rotations, stretched

YOUNG, POISSON, FLOOR = 3e5, 0.35, 0.08
each_law = pytest.mark.parametrize("law", LAWS)


def flat(n: int = 300) -> np.ndarray:
    """Matrices (n,3,3) with det F from -0.2 to 0.2 and moderate stretches; a seventh have one above the floor."""
    rng = np.random.default_rng(1)
    J, a, b = rng.uniform(-0.2, 0.2, n), *rng.uniform(0.7, 1.5, (2, n))
    return stretched(rng, np.stack([a, b, J / (a * b)], axis=1), n)


FLAT = flat()


def values(law: str, F, floor: float = FLOOR):
    return ts.evaluate_law(law, F, YOUNG, POISSON, volume_floor=floor)


def differential(law: str, F, D, projected: bool = False, floor: float = FLOOR):
    return evaluate_differential(law, F, D, YOUNG, POISSON, projected, floor)


def test_the_matrices_lie_on_both_sides():
    J = np.linalg.det(FLAT)
    assert J.min() < -0.19 and J.max() > 0.19 and 40 < (J > FLOOR).sum() < 150 < (J < 0).sum() + 50


@each_law
def test_values_equal_the_oracle(law):
    D = np.random.default_rng(2).standard_normal(FLAT.shape)
    psi, P = values(law, FLAT)
    assert np.abs(psi - oracle.psi(law, FLAT, YOUNG, POISSON, FLOOR)).max() < 1e-11 * YOUNG
    assert np.abs(P - oracle.pk1(law, FLAT, YOUNG, POISSON, FLOOR)).max() < 1e-11 * YOUNG
    expected = oracle.dpk1(law, FLAT, D, YOUNG, POISSON, FLOOR)
    assert np.abs(differential(law, FLAT, D) - expected).max() < 1e-11 * np.abs(expected).max()
    assert np.abs(psi - values(law, FLAT, 0.0)[0]).max() > 0.1 * YOUNG  # it matters


@each_law
def test_derivatives_by_finite_differences(law):
    rng, h = np.random.default_rng(4), 1e-6
    D, other = rng.standard_normal((2, *FLAT.shape))
    (up, P_up), (down, P_down) = (values(law, FLAT + s * D) for s in (h, -h))
    P, dP = values(law, FLAT)[1], differential(law, FLAT, D)
    size = np.abs(dP).max()
    assert np.abs(np.sum(P * D, axis=(1, 2)) - (up - down) / (2 * h)).max() < 1e-5 * YOUNG
    assert np.abs(dP - (P_up - P_down) / (2 * h)).max() < 1e-6 * size  # the third derivative jumps at J = floor and J = 0
    assert np.abs(np.sum(dP * other - differential(law, FLAT, other) * D, axis=(1, 2))).max() < 1e-13 * size


@each_law
@pytest.mark.parametrize("kind", ["flat", "all alike", "inverted", "rank 2", "nearly inverted"])
def test_the_projected_differential_is_the_clamped_hessian(law, kind):
    F = FLAT if kind == "flat" else MATRICES[kind]
    H = np.stack([differential(law, F, D, projected=True).reshape(-1, 9) for D in oracle.UNIT], axis=-1)
    largest = np.abs(H).max()
    assert np.abs(H - oracle.transposed(H)).max() <= 1e-12 * largest
    assert np.linalg.eigvalsh((H + oracle.transposed(H)) / 2).min() >= -1e-12 * largest
    s = oracle.signed_svd(F)[1]
    ok = (s[:, 1] + s[:, 2] > 0.02 * s[:, 0]) | (law != COR)  # where its rotation is unique
    expected = oracle.hessian(law, F[ok], YOUNG, POISSON, True, FLOOR)
    assert ok.any() and np.abs(H[ok] - expected).max() <= 1e-11 * largest


@each_law
def test_objectivity_and_isotropy(law):
    Q = rotations(np.random.default_rng(5), len(FLAT))
    (psi, P), (psi_left, P_left), (psi_right, P_right) = (values(law, F) for F in (FLAT, Q @ FLAT, FLAT @ Q))
    assert max(np.abs(psi_left - psi).max(), np.abs(psi_right - psi).max()) < 1e-11 * YOUNG
    assert max(np.abs(P_left - Q @ P).max(), np.abs(P_right - P @ Q).max()) < 1e-10 * YOUNG


@each_law
@pytest.mark.parametrize("kind", ["rank 2", "rank 1", "zero", "reflections", "needles", "tiny"])
def test_values_are_finite_for_degenerate_matrices(law, kind):
    F = MATRICES[kind]
    D = np.random.default_rng(2).standard_normal(F.shape)
    assert all(np.isfinite(part).all() for part in (*values(law, F), differential(law, F, D), differential(law, F, D, True)))


@each_law
def test_above_the_floor_it_is_the_law(law):
    F = np.concatenate(
        [FLAT[np.linalg.det(FLAT) > FLOOR], np.eye(3) + 0.1 * np.random.default_rng(0).standard_normal((50, 3, 3))]
    )
    D = np.random.default_rng(1).standard_normal(F.shape)
    assert all(np.array_equal(a, b) for a, b in zip(values(law, F), values(law, F, 0.0)))
    assert np.array_equal(differential(law, F, D), differential(law, F, D, floor=0.0))


@each_law
@pytest.mark.parametrize("J", [FLOOR, 0.0])
def test_the_second_derivative_has_no_jump(law, J):
    F = np.stack([np.diag([1.0, 1.1, (J + s) / 1.1]) for s in (-1e-9, 1e-9)])
    D = np.random.default_rng(3).standard_normal((3, 3))
    one, other = differential(law, F, D)
    assert np.abs(one - other).max() < 1e-5 * YOUNG


def test_stress_of_a_flat_tet():
    """At J = 0 the floor adds lambda + 2 mu, whatever it is."""
    mu, lam = oracle.lame(YOUNG, POISSON)
    for floor in (0.01, 0.05, 0.5):
        added = values(SNH, np.diag([1.0, 1.0, 0.0])[None], floor)[1] - values(SNH, np.diag([1.0, 1.0, 0.0])[None], 0.0)[1]
        assert np.allclose(added[0], np.diag([0.0, 0.0, -lam - 2 * mu]), rtol=1e-12)


# --- scenes -----------------------------------------------------------------------------------------------------------


def squeezed_block(floor: float, law: str = SVK, squeeze: float = 0.95, **body) -> ts.Scene:
    """A block in a box of which the lid comes down within a second, to a twentieth of its height."""
    scene = ts.Scene(gravity=(0, 0, 0))
    one = scene.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), rubber(law, poisson=0.4, volume_floor=floor), name="block", **body)
    one.fix(lambda X: X[:, 1] < -0.499)
    one.fix(lambda X: (np.abs(X[:, [0, 2]]) > 0.499).any(axis=1) & (np.abs(X[:, 1]) < 0.499), axes="xz")
    one.move(lambda X: X[:, 1] > 0.499, ts.KeyFrames([0, 1], [(0, 0, 0), (0, -squeeze, 0)]))
    return scene


def lowest(scene: ts.Scene, **settings) -> tuple[float, int]:
    """Smallest J and largest number of inverted tets of all steps of 1.2 s."""
    with ts.Simulator(scene, **settings) as sim:
        reports = [sim.step() for _ in range(round(1.2 / sim.dt))]
    assert all(report.converged for report in reports)
    return min(report.min_volume_ratio for report in reports), max(report.n_inverted for report in reports)


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_a_squeezed_block_keeps_its_tets(precision):
    with pytest.warns(UserWarning, match=f"{SVK} softens: tets may collapse or invert"):
        J, inverted = lowest(squeezed_block(0.0), dt=0.05, precision=precision)
    assert J < -0.5 and inverted > 10
    with pytest.warns(UserWarning, match=f"{SVK} softens: tets may collapse to below their volume_floor of 0.1"):
        J, inverted = lowest(squeezed_block(0.1), dt=0.05, precision=precision)
    assert 0.0 < J < 0.1 and inverted == 0


def column(load: float, floor: float, order: int) -> ts.Scene:
    """A column in a tube under a traction [Pa] on its top: F = diag(1, J, 1) everywhere."""
    scene = ts.Scene(gravity=(0, 0, 0))
    body = scene.add_body(cube(), rubber(SNH, poisson=0.3, volume_floor=floor), order=order)
    body.fix(lambda X: X[:, 1] < -0.449)
    body.fix(lambda X: X[:, 1] > -0.449, axes="xz")
    body.add_traction(lambda X: X[:, 1] > 0.449, (0.0, -load, 0.0))
    return scene


@pytest.mark.parametrize("order", [1, 2])
def test_a_loaded_column_stands_at_the_volume_of_the_formula(order):
    load, floor = 2.2e5, 0.1  # [Pa]: 1.7 times the law's stress at J = 0

    def pressure(J: float) -> float:
        return -oracle.pk1(SNH, np.diag([1.0, J, 1.0])[None], 1e5, 0.3, floor)[0, 1, 1]

    low, high = 0.0, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if pressure(middle) > load else (low, middle)
    assert not ts.solve_static(column(load, 0.0, order)).converged
    result = ts.solve_static(column(load, floor, order), tolerance=1e-10)
    assert result.converged and result.n_inverted == 0
    assert 0.0 < low < 0.05 and np.ptp(result.positions()[:, 1]) / 0.9 == pytest.approx(low, abs=1e-8)


def patched(order: int, floor: float) -> ts.Scene:
    """A body with mean dilatation; if it is linear, only one of its two regions has the floor."""
    scene, mesh = ts.Scene(gravity=(0, 0, 0)), cube(cells=(2, 1, 1))
    material = rubber(SVK, poisson=0.4, volume_floor=floor)
    mesh, material = (mesh, material) if order == 2 else (halved(mesh), {"left": material, 7: rubber(SVK, poisson=0.1)})
    scene.add_body(mesh, material, order=order, dilatation="mean")
    return scene


@pytest.mark.parametrize("order", [1, 2])
def test_mean_dilatation(order):
    """The patches carry lambda of the law; the floor acts on J of each point, with the whole lambda."""
    scene, floor, h = patched(order, 0.3), 0.3, 1e-7
    body = scene.bodies[0]
    rest, (gradients, volumes) = body.rest_positions, shape_gradients(body)
    x = rest * [1.0, 0.2, 1.0] + 0.04 * np.random.default_rng(1).standard_normal(rest.shape)
    F = np.einsum("eai,eqaj->eqij", x[body.nodes.elements], gradients)
    with ts.Simulator(patched(order, 0.0), dt=1e-3, precision="f64") as sim:
        sim.set_state(positions=x)
        without = sim.energies().elastic
    with ts.Simulator(scene, dt=1e-3, precision="f64") as sim:
        f = elastic_forces(sim, x)
        own = slice(None) if order == 2 else body.mesh.regions == 3
        added = np.sum(volumes[own] * oracle.floor_energy(F[own], 1e5, 0.4, floor))
        assert added > 100.0 and sim.energies().elastic - without == pytest.approx(added, rel=1e-9)
        for seed in range(3):
            d, energies, ends = np.random.default_rng(seed).standard_normal(x.shape), [], []
            df = sim.force_differential(d)
            for step in (h, -h):
                ends.append(elastic_forces(sim, x + step * d))
                energies.append(sim.energies().elastic)
            sim.set_state(positions=x)
            assert np.isclose((energies[1] - energies[0]) / (2 * h), np.sum(f * d), rtol=1e-5)
            assert np.abs((ends[0] - ends[1]) / (2 * h) - df).max() < 1e-5 * np.abs(df).max()


def elastic_forces(sim: ts.Simulator, x: np.ndarray) -> np.ndarray:
    sim.set_state(positions=x)
    return sim.elastic_forces()


def test_explicit_steps_resolve_the_floor():
    """`stable_dt` is 1 / sqrt(1 + 2 / floor) of that of the law: below it a squeezed block keeps its tets, above it explodes."""
    limits = {}
    for floor in (0.0, 0.1):
        with ts.Simulator(squeezed_block(floor, SNH), dt=1e-5, integrator="symplectic_euler") as sim:
            limits[floor] = sim.stable_dt
    assert limits[0.0] / limits[0.1] == pytest.approx(np.sqrt(21.0), rel=1e-6)
    scene = squeezed_block(0.1, SNH, squeeze=0.97)
    scene.bodies[0].material = rubber(SNH, poisson=0.4, volume_floor=0.1, mass_damping=5.0)
    settings = {"integrator": "symplectic_euler", "precision": "f64"}
    J, inverted = lowest(scene, dt=0.9 * limits[0.1], **settings)
    assert 0.0 < J < 0.1 and inverted == 0
    with pytest.raises(SimulationError), pytest.warns(UserWarning, match="stab"):
        lowest(scene, dt=0.9 * limits[0.0], allow_unstable=True, **settings)


@pytest.mark.parametrize("dilatation", ["local", "mean"])
@pytest.mark.parametrize("order", [1, 2])
def test_stable_dt_counts_flat_tets(order, dilatation):
    """Flat tets of a skewed mesh whose sides have their lengths at rest vibrate a little slower than `stable_dt` allows."""
    scene, mesh = ts.Scene(gravity=(0, 0, 0)), ts.box_mesh((2, 2, 2), (1, 1, 1))
    skewed = ts.TetMesh(mesh.vertices + 0.08 * np.random.default_rng(0).standard_normal(mesh.vertices.shape), mesh.tets)
    body = scene.add_body(skewed, rubber(SNH, poisson=0.49, volume_floor=0.05), order=order, dilatation=dilatation)
    rest, scale = body.rest_positions, 1.0 / np.sqrt(lumped_mass(body))[:, None]
    with ts.Simulator(scene, dt=1e-6, integrator="symplectic_euler", precision="f64") as sim:

        def scaled(v: np.ndarray) -> np.ndarray:
            return -(scale * sim.force_differential(scale * v.reshape(-1, 3))).reshape(-1)

        squares = []
        for n in np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1], [1, -1, 1]]):
            sim.set_state(positions=rest - 0.995 * np.outer(rest @ n, n) / (n @ n))
            operator = LinearOperator((rest.size, rest.size), matvec=scaled, dtype=np.float64)
            squares.append(eigsh(operator, k=1, which="LA", tol=1e-3, v0=np.ones(rest.size), return_eigenvectors=False)[0])
        assert 0.6 < sim.stable_dt / (2.0 / np.sqrt(max(squares))) < 1.0


def test_stable_dt_counts_the_floor_of_each_region():
    """A floor in a soft region of a stiff body shortens it less than in the stiff one."""

    def limit(soft: float, stiff: float) -> float:
        scene = ts.Scene()
        materials = {"left": rubber(SNH, young=1e3, volume_floor=soft), 7: rubber(SNH, young=1e6, volume_floor=stiff)}
        scene.add_body(halved(cube(cells=(2, 1, 1))), materials)
        return stable_dt(scene, verlet=False)

    assert limit(0.05, 0.0) == pytest.approx(limit(0.0, 0.0), rel=0.02)
    assert limit(0.0, 0.05) == pytest.approx(limit(0.0, 0.0) / np.sqrt(41.0), rel=0.02)
    assert limit(0.1, 0.1) == pytest.approx(limit(0.0, 0.0) / np.sqrt(21.0), rel=1e-3)


@pytest.mark.parametrize("integrator, damping, tolerance", [("velocity_verlet", 1e-4, 1e-10), ("implicit_euler", 4e-3, 1e-8)])
def test_steps_match_the_oracle(integrator, damping, tolerance):
    """A floor of 0.999 acts on all that is squeezed; two of the four bodies have it."""
    tight = {} if integrator in EXPLICIT else {"newton_tolerance": 1e-13, "linear_tolerance": 1e-13}
    scene = mixed_scene((SVK,) * 4, volume_floor=0.999, mass_damping=3.0, stiffness_damping=damping)
    with simulator(scene, integrator, allow_unstable=True, **tight) as sim:
        follow(sim, integrator, 5, tolerance)
        assert sim.step().min_volume_ratio < 0.99


def test_changed_numbers_and_resumed_runs(tmp_path):
    scene, settings = squeezed_block(0.1), {"dt": 0.05, "precision": "f64"}
    x = scene.bodies[0].rest_positions * [1.0, 0.02, 1.0]
    with ts.Simulator(scene, **settings) as sim:
        sim.set_state(positions=x)
        before = sim.energies().elastic
        sim.set_material("block", young=3e5)
        assert sim.energies().elastic == pytest.approx(3 * before, rel=1e-12)
        with pytest.raises(ts.SceneError, match="volume_floor cannot change while it runs"):
            sim.set_material("block", volume_floor=0.2)
    with ts.Simulator(scene, **settings) as sim:
        for _ in range(18):
            sim.step()
        sim.save_checkpoint(tmp_path / "state.npz")
        sim.step()
        expected = sim.positions()
    with ts.Simulator.load_checkpoint(tmp_path / "state.npz", scene) as sim:
        sim.step()
        assert np.array_equal(sim.positions(), expected)


def test_what_does_not_use_it_is_as_before():
    def bytes_and_positions(*floors: float) -> tuple[dict, np.ndarray]:
        scene = ts.Scene()
        scene.contact_forces = False
        for k, floor in enumerate(floors):
            scene.add_body(cube((3 * k, 0, 0)), rubber(SVK, volume_floor=floor), velocity=(0, 0, k)).fix([0, 1, 2])
        with ts.Simulator(scene, dt=0.02, precision="f64") as sim:
            for _ in range(5):
                sim.step()
            assert sim.plan.on["volume_floor"] is (max(floors) > 0.0)
            return sim.field_bytes, sim.positions()

    plain, x = bytes_and_positions(0.0, 0.0)
    both, y = bytes_and_positions(0.0, 0.2)
    assert plain["law_constants"] == 2 * 4 * 8 and both == plain | {"law_constants": 2 * 6 * 8}
    assert np.array_equal(x[:8], y[:8])
