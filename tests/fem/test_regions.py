"""Bodies whose tets differ in law, Young's modulus, Poisson's ratio or density.

test_elasticity.py has forces, blocks and energies by finite differences and by the oracle, test_references.py bars and beams of
two materials against closed forms, test_region_files.py the readers. Here:

* regions of one material change nothing: positions, stresses, masses, statics, modes and the stable dt are the same bits;
* a scene without them has the arrays and the kernels that it had: law constants of four numbers a body;
* steps, masses, statics and modes equal the oracle's;
* stresses and warnings are those of the right tet; numbers of a region, and by tet, can change during a run;
* refined scenes, other orders, scene files and checkpoints keep everything;
* bad input is refused in one sentence that names the body, the region or tet, and the rule.
"""

import pickle
import warnings

import numpy as np
import pytest
import scipy.linalg as la

import taisoft as ts
from taisoft.backend.runtime import compile_clock
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.errors import SceneError
from taisoft.fem.reference import gravity_masses, lumped_masses, mass_matrix
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.refine import refined, with_order
from taisoft.stability import hooke_differential, hooke_stiffness, stable_dt
from taisoft.view.controls import Controls
from tests.dynamics.following import DT, follow, simulator
from tests.dynamics.scenes import COR, SNH, SVK, cube, halved, mixed_scene, rubber
from tests.fem.oracle import Oracle
from tests.scene.toml_scenes import there_and_back

MESH = halved(cube(cells=(3, 1, 1)))
GRID = ts.box_mesh((20, 5, 2), (4, 1, 1))
MANY = ts.TetMesh(GRID.vertices, GRID.tets, regions=range(1, 1001))
TIGHT = {"newton_tolerance": 1e-13, "linear_tolerance": 1e-13}


def beam(material, order: int = 1, mesh: ts.TetMesh = MESH, **numbers) -> ts.Scene:
    """A cantilever over a ground far below."""
    scene = ts.Scene()
    body = scene.add_body(mesh, material, name="beam", order=order, **numbers)
    body.fix(lambda X: X[:, 0] < -0.49)
    body.add_force(lambda X: X[:, 0] > 0.49, (10.0, -20.0, 5.0))
    return scene


def plain_and_split(order: int = 1, **numbers) -> tuple[ts.Scene, ts.Scene]:
    """A beam of one material, and the same one given by region."""
    one = rubber(SNH, **numbers)
    return beam(one, order), beam({"left": one, 7: one}, order)


def by_tet_scene(order="both", **damping) -> ts.Scene:
    return mixed_scene((SNH, SVK, COR, SVK), order=order, by_tet=True, **damping)


# --- regions of one material ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("integrator", ["velocity_verlet", "implicit_euler"])
def test_regions_of_one_material_change_nothing(integrator, precision):
    results = []
    for scene in plain_and_split(mass_damping=0.5, stiffness_damping=1e-3):
        with ts.Simulator(scene, dt=1e-3, integrator=integrator, precision=precision) as sim:
            for _ in range(5):
                sim.step()
            now = sim.energies()
            results.append(
                [sim.positions(), sim.velocities(), sim.stress(), sim.reactions(), now.elastic, now.kinetic, sim.stable_dt]
            )
    assert all(np.array_equal(a, b) for a, b in zip(*results))


@pytest.mark.parametrize("order", [1, 2])
def test_neither_in_statics_modes_and_masses(order):
    plain, split = plain_and_split(order)
    assert np.array_equal(ts.solve_static(plain).positions(), ts.solve_static(split).positions())
    assert np.array_equal(ts.modes(plain, 3).frequencies, ts.modes(split, 3).frequencies)
    assert np.array_equal(lumped_masses(plain), lumped_masses(split)) and plain.bodies[0].mass == split.bodies[0].mass
    assert stable_dt(plain, False) == stable_dt(split, False)


def test_contacts_of_regions_of_one_material():
    results = []
    for material in (rubber(), {"left": rubber(), 7: rubber()}):
        scene = ts.Scene()
        for k in range(2):
            scene.add_body(MESH, material, name=f"body{k}", position=(0.1 * k, 0.451 + 0.902 * k, 0))
        scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)))
        with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
            for _ in range(3):
                report = sim.step()
            results.append(sim.positions())
    assert report.n_contacts > 0 and report.converged and np.array_equal(*results)


def test_a_scene_without_them_is_as_before():
    """Four constants a body, and none for its tets; a mesh with regions but one material compiles nothing new."""
    with ts.Simulator(beam(rubber(), mesh=cube(cells=(3, 1, 1))), dt=1e-3) as sim:
        sim.step()
        plain, compiled = sim.field_bytes, compile_clock()
    assert plain["law_constants"] == 4 * 8 and not sim.plan.on["elasticity_by_tet"]
    with ts.Simulator(beam(rubber()), dt=1e-3) as sim:
        sim.step()
        assert sim.field_bytes == plain and compile_clock() == compiled
    with ts.Simulator(beam({3: rubber(), 7: rubber()}), dt=1e-3) as sim:
        blocks = -(-MESH.n_tets // 4)
        assert sim.field_bytes == plain | {"law_constants": blocks * 4 * 4 * 8} and sim.plan.on["elasticity_by_tet"]


# --- the oracle -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet"])
def test_explicit_steps_match_the_oracle(integrator):
    with simulator(by_tet_scene(mass_damping=3.0, stiffness_damping=1e-3, order=1), integrator, allow_unstable=True) as sim:
        follow(sim, integrator, 6, 1e-10)
    assert integrator in EXPLICIT


@pytest.mark.parametrize("integrator", ["implicit_euler", "bdf2"])
def test_implicit_steps_match_the_oracle(integrator):
    with simulator(by_tet_scene(mass_damping=3.0, stiffness_damping=0.004, order=1), integrator, **TIGHT) as sim:
        follow(sim, integrator, 4, 1e-8)
    assert integrator in IMPLICIT


@pytest.mark.parametrize("order", [1, 2])
def test_masses_match_the_oracle(order):
    scene = by_tet_scene(order)
    oracle = Oracle(scene)
    assert lumped_masses(scene) == pytest.approx(oracle.lumped[:, 0])
    assert np.abs(mass_matrix(scene).toarray() - oracle.mass).max() < 1e-13 * oracle.mass.max()
    assert gravity_masses(scene) == pytest.approx(oracle.consistent.sum(axis=1))
    assert [body.mass for body in scene.bodies] == pytest.approx(
        [oracle.lumped[slice(a, b)].sum() for a, b in zip(oracle.starts, oracle.starts[1:])]
    )


@pytest.mark.parametrize("order", [1, 2])
def test_stiffness_frequencies_and_modes_match_the_oracle(order):
    scene = beam({"left": rubber(COR), 7: rubber(SVK, young=3e5, poisson=0.1, density=400.0)}, order)
    scene.bodies[0].poisson = np.linspace(0.0, 0.45, MESH.n_tets)
    oracle, body = Oracle(scene), scene.bodies[0]
    K, free = oracle.stiffness(oracle.rest), ~oracle.fixed.reshape(-1)
    assert np.abs(hooke_stiffness(body).toarray() - K).max() < 1e-12 * np.abs(K).max()
    v = np.random.default_rng(0).standard_normal((body.n_nodes, 3))
    assert np.abs(hooke_differential(body)(v) - (K @ v.reshape(-1)).reshape(-1, 3)).max() < 1e-11 * np.abs(K).max()
    for mass, M in (("lumped", oracle.inertia(explicit=True)), ("consistent", oracle.consistent)):
        M = np.kron(M, np.eye(3))
        squares = la.eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], eigvals_only=True)
        assert ts.modes(scene, 4, mass=mass).frequencies == pytest.approx(np.sqrt(squares[:4]) / (2 * np.pi), rel=1e-6)
        if mass == "lumped":
            assert stable_dt(scene, False) == pytest.approx(2 / np.sqrt(squares[-1]), rel=0.01)


def test_statics_match_the_oracle():
    scene = beam({"left": rubber(SNH), "right": rubber(COR, young=4e4, poisson=0.1)}, mesh=named(MESH), order=2)
    expected = Oracle(scene).static()
    assert np.abs(ts.solve_static(scene, tolerance=1e-12).positions() - expected).max() < 1e-9


def named(mesh: ts.TetMesh) -> ts.TetMesh:
    """The halves of a mesh, both with names."""
    return ts.TetMesh(mesh.vertices, mesh.tets, regions=mesh.regions, region_names={3: "left", 7: "right"})


# --- results by tet ---------------------------------------------------------------------------------------------------


def test_stresses_are_those_of_the_right_tets():
    """A uniform stretch along x without Poisson's effect; Cauchy's stress is then the first Piola-Kirchhoff stress."""
    E = np.linspace(1e5, 3e5, MESH.n_tets)
    scene = beam({"left": rubber(SVK, poisson=0.0), 7: rubber(COR, poisson=0.0)}, young=E)
    other = scene.add_body(cube((0, 5, 0)), rubber(SVK, poisson=0.0), name="other")
    with ts.Simulator(scene, dt=1e-3, precision="f64") as sim:
        for body in (scene.bodies[0], other):
            sim.set_state(positions=(body.rest_positions + body.position) * (1.01, 1, 1), body=body.name)
        left = MESH.regions == 3
        svk = E * (1.01**2 - 1) / 2 * 1.01
        assert sim.stress("beam")[:, 0, 0] == pytest.approx(np.where(left, svk, E * 0.01), rel=1e-9)
        assert sim.stress("other")[:, 0, 0] == pytest.approx(svk[0] * 1e5 / E[0], rel=1e-9)
        assert np.array_equal(sim.stress(), np.concatenate([sim.stress("beam"), sim.stress("other")]))


def test_softening_names_the_tet_and_its_law():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(cube((0, 5, 0)), rubber(), name="other")
    scene.add_body(MESH, {"left": rubber(COR), 7: rubber(SVK)}, name="beam")
    with ts.Simulator(scene, dt=1e-6, precision="f64") as sim:
        x = scene.body("beam").rest_positions.copy()
        tet = int(np.flatnonzero(MESH.regions == 7)[-1])
        corners = MESH.tets[tet]
        x[corners] = x[corners].mean(axis=0) + 0.3 * (x[corners] - x[corners].mean(axis=0))
        sim.set_state(positions=x, body="beam")
        with pytest.warns(UserWarning, match=rf"tet \d+ of body 'beam' .* where {SVK} softens") as caught:
            sim.step()
    first = next(str(w.message) for w in caught if "softens" in str(w.message))
    assert MESH.regions[int(first.split("tet ")[1].split()[0])] == 7


# --- changes ----------------------------------------------------------------------------------------------------------


def run(scene: ts.Scene, change=None, steps: int = 4) -> np.ndarray:
    with ts.Simulator(scene, dt=DT, precision="f64", integrator="implicit_euler", **TIGHT) as sim:
        if change is not None:
            change(sim)
        for _ in range(steps):
            sim.step()
        return sim.positions()


def test_numbers_of_a_region_change_during_a_run():
    left, right = rubber(SVK), rubber(COR, young=3e5)
    changed = run(beam({"left": left, 7: right}), lambda sim: sim.set_material("beam", region="left", young=2e5, density=500.0))
    assert np.array_equal(changed, run(beam({"left": rubber(SVK, young=2e5, density=500.0), 7: right})))
    assert np.abs(changed - run(beam({"left": left, 7: right}))).max() > 1e-5


def test_numbers_by_tet_change_during_a_run():
    E, rho = np.linspace(5e4, 3e5, MESH.n_tets), np.linspace(500, 1500, MESH.n_tets)
    wanted = run(beam(rubber(), young=E, density=rho))
    start = beam(rubber(), young=E[::-1])
    assert np.array_equal(wanted, run(start, lambda sim: sim.set_material("beam", young=E, density=rho)))
    back = beam(rubber(), young=E)
    assert np.array_equal(run(beam(rubber())), run(back, lambda sim: sim.set_material("beam", young=1e5)))


def test_a_body_of_one_material_can_get_regions_where_others_have_them():
    scene = by_tet_scene(order=1)
    scene.add_body(MESH, rubber(), name="late", position=(0, 5, 0))
    with ts.Simulator(scene, dt=1e-4, precision="f64") as sim:
        sim.set_material("late", region=7, young=3e5)
        assert set(sim.scene.body("late").young) == {1e5, 3e5} and sim.step().converged


def test_the_windows_slider_scales_the_numbers_of_all_tets():
    with ts.Simulator(beam({"left": rubber(), 7: rubber(young=3e5)}), dt=1e-3) as sim:
        controls = Controls(sim)
        assert controls.values()["young"] == [(1e5, 3e5, 0.0)]
        controls.set_number("young", ["beam"], 1.0)  # a decade
        assert controls.values()["young"] == [(pytest.approx(1e6), pytest.approx(3e6), 1.0)]
        assert sim.scene.bodies[0].young == pytest.approx(np.where(MESH.regions == 3, 1e6, 3e6))


def test_refused_changes_leave_everything():
    with ts.Simulator(beam({"left": rubber(), 7: rubber()}), dt=1e-3, integrator="symplectic_euler") as sim:
        before = sim.scene.bodies[0].composition
        for numbers, message in (
            ({"region": "lefty", "young": 1.0}, r"body 'beam': no region is called 'lefty'; did you mean 'left'\?"),
            ({"region": 4, "young": 1.0}, "body 'beam': no tet is in region 4; there are 'left', 7"),
            ({"region": 7, "young": -1.0}, "body 'beam': region 7: young must be greater than 0 Pa, not -1.0$"),
            ({"region": 7, "mass_damping": 0.0}, "mass_damping is one number for the whole body"),
            ({"young": [1e5, 2e5]}, r"body 'beam': young must have shape \(15,\), not \(2,\)"),
            ({"mass_damping": np.zeros(15)}, "mass_damping must be a number"),
        ):
            with pytest.raises(SceneError, match=message):
                sim.set_material("beam", **numbers)
        with pytest.raises(ts.SimulationError, match="above the estimated stability limit"):
            sim.set_material("beam", region=7, young=1e12)
        assert sim.scene.bodies[0].composition is before
    with ts.Simulator(beam(rubber()), dt=1e-3) as sim:
        with pytest.raises(SceneError, match="body 'beam': young and poisson cannot differ between tets, since those of no body"):
            sim.set_material("beam", region="left", young=2e5)
        sim.set_material("beam", region="left", density=2e3)  # masses can always differ
        assert sim.scene.bodies[0].mass == pytest.approx(0.99 * 1e3 + 1e3 * MESH.volumes[MESH.regions == 3].sum())


def test_assignments_replace_the_material_or_its_numbers():
    body = beam({"left": rubber(SVK), 7: rubber(COR, young=3e5)}).bodies[0]
    assert body.material == {3: rubber(SVK), 7: rubber(COR, young=3e5)} and repr(body).endswith(f"{SVK} and {COR})")
    assert body.young.tolist() == np.where(MESH.regions == 3, 1e5, 3e5).tolist()
    body.young = np.full(MESH.n_tets, 2e5)
    body.density = 500.0
    assert set(body.young) == {2e5} and body.mass == pytest.approx(500 * 0.99) and set(body.density) == {500.0}
    body.material = rubber()
    assert (body.young, body.poisson, body.density) == (1e5, 0.3, 1000.0)
    with pytest.warns(UserWarning, match="poisson = 0.495 is above 0.49"):
        body.poisson = np.linspace(0.1, 0.495, MESH.n_tets)
    with pytest.raises(SceneError, match="mass cannot be set: set body.density"):
        body.mass = 3.0


def test_the_materials_of_regions_are_read_only_and_can_be_passed_on():
    body, other = (beam({"left": rubber(SVK), 7: rubber(COR)}).bodies[0] for _ in range(2))
    with pytest.raises(TypeError):
        body.material[7] = rubber()
    body.material = {3: rubber(), 7: rubber(young=3e5)}
    other.material = body.material
    assert other.material == body.material and set(other.young) == {1e5, 3e5}


def test_an_array_of_one_number_is_a_number():
    body = beam(rubber(), young=np.array(2e5)).bodies[0]
    assert body.young == 2e5 and isinstance(body.young, float) and not body.composition.elastic_by_tet
    body.density = np.array(500)
    assert body.density == 500.0 and rubber(young=np.array(3e5)) == rubber(young=3e5)


# --- copies -----------------------------------------------------------------------------------------------------------


def everything() -> ts.Scene:
    scene = beam({"left": rubber(SVK), 7: rubber(COR, young=3e5)}, density=np.linspace(1 / 3, 2 / 3, MESH.n_tets))
    scene.add_body(cube((0, 5, 0)), rubber(), name="by tet", young=np.linspace(1e5, 3e5, 5) / 3, poisson=0.2)
    scene.add_body(named(MESH), {7: rubber(SNH), "left": rubber(SVK)}, name="names", position=(0, 9, 0))
    return scene


@pytest.mark.parametrize("change", [refined, lambda scene: with_order(scene, 2)], ids=["refined", "order"])
def test_refined_scenes_keep_everything(change):
    """Every part of a tet is what the tet was: masses, laws, and the static energy of a linear displacement."""
    scene = everything()
    new = change(scene)
    for old, body in zip(scene.bodies, new.bodies):
        assert body.mass == pytest.approx(old.mass) and body.composition.laws == old.composition.laws
        K, old_K = hooke_stiffness(body), hooke_stiffness(old)
        u, old_u = (b.rest_positions @ np.array([[0.1, 0.2, 0], [0, -0.3, 0.1], [0, 0, 0.2]]) for b in (body, old))
        assert u.reshape(-1) @ K @ u.reshape(-1) == pytest.approx(old_u.reshape(-1) @ old_K @ old_u.reshape(-1))
    assert new.bodies[0].mesh.region_names == {3: "left"} and np.ndim(new.bodies[1].poisson) == 0


def test_scene_files_keep_everything(tmp_path):
    there_and_back(tmp_path / "a.toml", everything(), {"dt": 0.01})
    again = ts.read_scene(tmp_path / "a.toml")[0]
    assert scene_digest(again) == scene_digest(everything()) and again.bodies[2].mesh.region_names == {3: "left", 7: "right"}
    text = (tmp_path / "a.toml").read_text()
    assert '[bodies.beam.materials]\nleft = "material0"\n7 = "material1"\n' in text


def test_scene_files_need_a_region_that_their_meshes_can_hold(tmp_path):
    """All meshes are checked before the first is written; a body that does not use its only region does without it."""
    zero = ts.TetMesh(MESH.vertices, MESH.tets, regions=0 * MESH.regions, region_names={0: "all"})
    scene = ts.Scene()
    scene.add_body(named(MESH), rubber(), name="names")
    scene.add_body(zero, rubber(), name="plain", position=(0, 5, 0))
    with pytest.warns(
        UserWarning, match="body 'plain': its mesh has no region but 0, which its file cannot tell from none"
    ) as caught:
        ts.write_scene(tmp_path / "a.toml", scene)
    assert caught[0].filename == __file__
    again = ts.read_scene(tmp_path / "a.toml")[0]
    assert scene_digest(again) == scene_digest(scene) and again.bodies[1].mesh.regions is None
    assert again.bodies[0].mesh.region_names == {3: "left", 7: "right"}
    scene.add_body(zero, {"all": rubber()}, name="split", position=(0, 9, 0))
    with pytest.raises(SceneError, match="body 'split': its mesh has no region but 0, .*: use another number"):
        ts.write_scene(tmp_path / "b.toml", scene)
    assert not list(tmp_path.glob("b*"))


def test_a_name_may_be_its_regions_own_number(tmp_path):
    mesh = ts.TetMesh(MESH.vertices, MESH.tets, regions=MESH.regions, region_names={3: "3", 7: "08"})
    scene = ts.Scene()
    scene.add_body(mesh, {"3": rubber(), "08": rubber(young=3e5)}, name="body")
    there_and_back(tmp_path / "a.toml", scene, {"dt": 0.01})


def test_checkpoints_keep_everything(tmp_path):
    path, E = tmp_path / "checkpoint.npz", np.linspace(1e5, 2e5, 5)

    def change(sim):
        sim.set_material("beam", region=7, young=2e5)
        sim.set_material("by tet", young=E)

    with ts.Simulator(everything(), dt=DT, precision="f64") as sim:
        sim.step()
        change(sim)
        sim.step()
        sim.save_checkpoint(path)
        sim.step()
        wanted = sim.positions()
    with ts.Simulator.load_checkpoint(path, everything()) as sim:
        assert np.array_equal(sim.scene.body("by tet").young, E) and sim.scene.body("beam").material[7].young == 2e5
        sim.step()
        assert np.array_equal(sim.positions(), wanted)
    for other, message in (
        (lambda s: setattr(s.bodies[1], "young", np.linspace(1e5, 3e5, 5)), r"body 'by tet': young by tet, tet 0 is 100000.0"),
        (
            lambda s: setattr(s.bodies[0], "material", {3: rubber(SVK), 7: rubber(COR)}),
            "body 'beam': region 7: young is 100000.0",
        ),
        (lambda s: setattr(s.bodies[0], "material", rubber(SVK)), "differs in body 'beam': regions"),
    ):
        scene = everything()
        other(scene)
        with pytest.raises(SceneError, match=message):
            ts.Simulator.load_checkpoint(path, scene)


def test_checkpoints_hold_numbers_by_tet_as_arrays(tmp_path):
    """Once, if they did not change: 8 bytes a number, and no text."""
    path, E = tmp_path / "c.npz", np.linspace(1e5, 2e5, GRID.n_tets) / 3
    sizes = []
    for arguments in ({}, {"young": E}, {"density": E}):
        with ts.Simulator(beam(rubber(), mesh=GRID, **arguments), dt=1e-3) as sim:
            for young in (None, E[::-1].copy()):
                if young is not None and arguments.keys() == {"young"}:
                    sim.set_material("beam", young=young)
                sim.save_checkpoint(path)
                sizes.append(path.stat().st_size)
                with np.load(path) as file:
                    assert len(file["header"]) < 5000
    extra = (np.array(sizes) - sizes[0]) / (8 * GRID.n_tets)
    assert extra.round().tolist() == [0.0, 0.0, 1.0, 2.0, 1.0, 1.0]


def test_the_digest_tells_compositions_apart():
    one = rubber()
    scenes = [beam(one), beam({"left": one, 7: one}), beam(one, young=np.full(15, 1e5)), beam(one, density=np.full(15, 1e3))]
    assert len({scene_digest(scene) for scene in scenes}) == 4


# --- bad input --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"material": {"left": rubber()}}, "region 7 has no material; every region needs one"),
        ({"material": {7: rubber()}}, "region 'left' has no material"),
        ({"material": {}}, "region 'left' has no material"),
        ({"material": {"lft": rubber(), 7: rubber()}}, r"material: no region is called 'lft'; did you mean 'left'\?"),
        ({"material": {True: rubber(), 7: rubber()}}, "material: no tet is in region True; there are 'left', 7"),
        ({"material": {3: rubber(), "left": rubber(), 7: rubber()}}, "region 'left' is given two materials, by its name and by"),
        ({"material": {"left": rubber(), 7: 1e5}}, "the material of region 7 must be a Material, not float"),
        (
            {"material": {"left": rubber(friction=0.1), 7: rubber()}},
            "friction is 0.1 in region 'left' and 0.5 in region 7, but it is",
        ),
        ({"material": {"left": rubber(), 7: rubber(mass_damping=1.0)}}, "mass_damping is 0 in region 'left' and 1 in region 7"),
        ({"material": [rubber()]}, "material must be a Material, or a dict that gives each region one, not list"),
        ({"material": {"left": rubber()}, "mesh": cube()}, "materials are given by region, but its mesh has no regions"),
        ({"young": np.ones(3)}, r"young must have shape \(15,\), not \(3,\)"),
        ({"young": np.append(np.ones(14), 0.0)}, "young of tet 14 must be greater than 0 Pa, not 0"),
        ({"density": np.append(-1.0, np.ones(14))}, "density of tet 0 must be greater than 0 kg/m.3, not -1"),
        ({"poisson": np.append(np.zeros(14), 0.5)}, r"poisson of tet 14 must lie in the open interval \(-1, 0.5\), not 0.5"),
        ({"young": [1e5] * 14 + [float("nan")]}, r"young: entry \[14\] is nan, not finite"),
        ({"young": -1.0}, "young must be greater than 0 Pa, not -1.0$"),
        ({"young": "1e5"}, "young must be a number, not '1e5'$"),
        ({"young": np.array(-1.0)}, "young must be greater than 0 Pa, not "),
        ({"young": np.array(["a"] * 1000)}, r"young must be numbers of shape \(15,\), not .{1,120}$"),
        ({"young": "a\n" * 1000}, "young must be a number, not .{1,120}$"),
        (
            {"material": dict.fromkeys(range(1000), rubber()), "mesh": MANY},
            r"material: no tet is in region 0; there are .{1,180}\(1000 in all\)$",
        ),
    ],
)
def test_bad_input_is_refused(arguments, message):
    scene = ts.Scene()
    with pytest.raises(SceneError, match=rf"^body 'beam': {message}"), warnings.catch_warnings():
        scene.add_body(**({"mesh": MESH, "material": rubber(), "name": "beam"} | arguments))
    assert scene.bodies == []


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"regions": [1, 2]}, r"regions must have shape \(15,\), one for each tet, not \(2,\)"),
        ({"regions": np.ones(15)}, "regions must be integers, not of type float64"),
        ({"regions": [2**31] * 15}, "tet 0: region 2147483648 does not fit into 32 bits"),
        ({"regions": [[1], [2, 3]]}, "regions must be an array of integers"),
        ({"region_names": {1: "a"}}, "region_names are given without regions"),
        ({"regions": [1] * 15, "region_names": {2: "a"}}, "region_names: no tet is in region 2"),
        ({"regions": [1] * 15, "region_names": {1: " "}}, "region_names: the name of region 1 must be a line of text"),
        ({"regions": [1] * 14 + [2], "region_names": {1: "a", 2: "a"}}, "region_names: 'a' is the name of two regions"),
        ({"regions": [1] * 15, "region_names": []}, r"region_names must be a dict of names by region, not \[\]"),
        (
            {"regions": [1] * 14 + [-2], "region_names": {1: "-2"}},
            "region_names: '-2', the name of region 1, is the number of another",
        ),
        ({"regions": [1] * 15, "region_names": ["a"]}, r"region_names must be a dict of names by region, not \['a'\]"),
    ],
)
def test_bad_regions_are_refused(arguments, message):
    with pytest.raises(ts.MeshError, match=f"^part: {message}"):
        ts.TetMesh(MESH.vertices, MESH.tets, source="part", **arguments)


# --- look-ups ---------------------------------------------------------------------------------------------------------


def test_regions_are_sorted_once(monkeypatch):
    mesh = ts.TetMesh(MESH.vertices, MESH.tets, regions=MESH.regions, region_names={3: "left"})
    copies = pickle.loads(pickle.dumps(mesh)), mesh
    monkeypatch.setattr(np, "unique", None)
    for one in copies:
        assert one.region_ids == (3, 7) and one.region_ids is one.region_ids
        assert [one.region_id(key) for key in ("left", 3, np.int64(7))] == [3, 3, 7]
        for key in (3.0, True, "7", None, [3]):
            with pytest.raises(ts.MeshError, match="no tet is in region|no region is called"):
                one.region_id(key)
    with pytest.raises(ts.MeshError, match="region_ids"):
        mesh.region_ids = ()
