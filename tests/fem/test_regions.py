"""Bodies whose tets differ in law, Young's modulus, Poisson's ratio, density or volume floor: stresses and warnings are those of
the right tet; numbers change during a run, refused changes leave everything; refined scenes and files keep them; bad input is
refused with body, region or tet; `stable_dt` counts a volume floor (forces: `test_elasticity`, masses: `test_elements`).
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.refine import refined, with_order
from taisoft.stability import hooke_stiffness, stable_dt
from taisoft.view.window.controls import Controls
from tests.dynamics.scenes import SNH, SVK, cube, halved, rubber
from tests.fem.oracle_laws import pk1
from tests.scene.toml_scenes import there_and_back

MESH = halved(cube(cells=(3, 1, 1)))
LEFT = MESH.regions == 3


def beam(material, order: int = 1, mesh: ts.TetMesh = MESH, **numbers) -> ts.Scene:
    """A cantilever with a load."""
    scene = ts.Scene()
    scene.contact_forces = False
    body = scene.add_body(mesh, material, name="beam", order=order, **numbers)
    body.fix(lambda X: X[:, 0] < -0.49)
    body.add_force(lambda X: X[:, 0] > 0.49, (10.0, -20.0, 5.0))
    return scene


def two_laws() -> dict:
    return {"left": rubber(SVK), 7: rubber(SNH, young=3e5)}


def explicit(scene: ts.Scene, dt: float = 1e-4, **settings) -> ts.Simulator:
    return ts.Simulator(scene, dt=dt, integrator="symplectic_euler", precision="f64", **settings)


def named(names: dict) -> ts.TetMesh:
    return ts.TetMesh(MESH.vertices, MESH.tets, regions=MESH.regions, region_names=names)


def test_regions_of_one_material_change_nothing():
    one, results = rubber(SNH), []
    for scene in (beam(one), beam({"left": one, 7: one})):
        scene.add_body(cube((0, 5, 0)), rubber(SVK), name="other")  # as in the next test, whose kernels it shares
        with explicit(scene) as sim:
            sim.step()
            found = [sim.positions(), sim.stress(), sim.reactions(), sim.energies().elastic, sim.stable_dt]
        results.append([*found, ts.modes(scene, 3).frequencies, scene.bodies[0].mass])
    assert all(np.array_equal(a, b) for a, b in zip(*results))


def test_stresses_and_warnings_are_those_of_the_right_tets():
    """A uniform stretch along x without Poisson's effect; Cauchy's stress is then the first Piola-Kirchhoff stress."""
    E = np.linspace(1e5, 3e5, MESH.n_tets)
    scene = beam({"left": rubber(SNH, poisson=0.0), 7: rubber(SVK, poisson=0.0)}, young=E)
    other = scene.add_body(cube((0, 5, 0)), rubber(SVK, poisson=0.0), name="other")
    with explicit(scene, dt=1e-6) as sim:
        for body in (scene.bodies[0], other):
            sim.set_state(positions=body.rest_positions * (1.01, 1, 1), body=body.name)
        svk, snh = E * (1.01**2 - 1) / 2 * 1.01, E * pk1(SNH, np.diag([1.01, 1, 1])[None], 1.0, 0.0)[0, 0, 0]
        assert sim.stress("beam")[:, 0, 0] == pytest.approx(np.where(LEFT, snh, svk), rel=1e-9)
        assert sim.stress("other")[:, 0, 0] == pytest.approx(svk[0] * 1e5 / E[0], rel=1e-9)
        x, own = scene.body("beam").rest_positions.copy(), MESH.tets[~LEFT][-1]
        x[own] = 0.7 * x[own].mean(axis=0) + 0.3 * x[own]
        sim.set_state(positions=x, body="beam")
        with pytest.warns(UserWarning, match=rf"tet \d+ of body 'beam' .* where {SVK} softens") as caught:
            sim.step()
            sim.step()
    (only,) = (str(w.message) for w in caught if "softens" in str(w.message))
    assert MESH.regions[int(only.split("tet ")[1].split()[0])] == 7


def after_two_steps(scene: ts.Scene, **change) -> np.ndarray:
    with explicit(scene) as sim:
        if change:
            sim.set_material("beam", **change)
        sim.step()
        sim.step()
        return sim.positions()


def test_numbers_of_a_region_and_by_tet_change_during_a_run():
    start = after_two_steps(beam(two_laws()))
    changed = after_two_steps(beam(two_laws()), region="left", young=2e5, density=500.0)
    assert np.array_equal(changed, after_two_steps(beam(two_laws() | {"left": rubber(SVK, young=2e5, density=500.0)})))
    assert not np.array_equal(changed, start)
    E, rho = np.linspace(5e4, 3e5, MESH.n_tets), np.linspace(500, 1500, MESH.n_tets)
    wanted = after_two_steps(beam(two_laws(), young=E, density=rho))
    assert np.array_equal(wanted, after_two_steps(beam(two_laws(), young=E[::-1]), young=E, density=rho))


def test_refused_changes_leave_everything_and_the_slider_scales_all_tets():
    scene = beam(two_laws())
    scene.add_body(MESH, rubber(SVK), name="late", position=(0, 5, 0))
    with explicit(scene) as sim:
        before = sim.scene.bodies[0].composition
        for numbers, message in (
            ({"region": 4, "young": 1.0}, "body 'beam': no tet is in region 4; there are 'left', 7"),
            ({"region": 7, "mass_damping": 0.0}, "mass_damping is one number for the whole body"),
            ({"law": SVK}, "body 'beam': law cannot change while it runs"),
        ):
            with pytest.raises(SceneError, match=message):
                sim.set_material("beam", **numbers)
        with pytest.raises(ts.SimulationError, match="above the estimated stability limit"):
            sim.set_material("beam", region=7, young=1e12)
        assert sim.scene.bodies[0].composition is before
        sim.set_material("late", region=7, young=3e5)  # a body of one material gets regions, since others have them
        assert set(sim.scene.body("late").young) == {1e5, 3e5} and sim.step().converged
        controls = Controls(sim)
        controls.set_number("young", ["beam"], 6e5)
        assert sim.scene.bodies[0].young == pytest.approx(2.0 * np.where(LEFT, 1e5, 3e5))
    with explicit(beam(rubber())) as sim:
        with pytest.raises(SceneError, match="body 'beam': young and poisson cannot differ between tets, since those of no body"):
            sim.set_material("beam", region="left", young=2e5)
        sim.set_material("beam", region="left", density=2e3)  # masses can always differ
        assert sim.scene.bodies[0].mass == pytest.approx(0.99 * 1e3 + 1e3 * MESH.volumes[LEFT].sum())


def test_assignments_replace_the_material_or_its_numbers():
    body = beam(two_laws()).bodies[0]
    assert body.material == {3: rubber(SVK), 7: rubber(SNH, young=3e5)}
    with pytest.raises(TypeError):
        body.material[7] = rubber()
    body.density = 500.0
    assert body.mass == pytest.approx(500 * 0.99) and set(body.density) == {500.0}
    body.material = rubber()
    assert (body.young, body.poisson, body.density) == (1e5, 0.3, 1000.0)
    with pytest.raises(SceneError, match="mass cannot be set: set body.density"):
        body.mass = 3.0


def everything() -> ts.Scene:
    scene = beam(two_laws(), density=np.linspace(100 / 3, 200 / 3, MESH.n_tets))
    scene.add_body(cube((0, 5, 0)), rubber(SVK), name="by tet", young=np.linspace(1e5, 3e5, 5) / 3, poisson=0.2)
    both = named({3: "left", 7: "right"})
    scene.add_body(both, {7: rubber(SNH), "left": rubber(SVK)}, name="names", position=(0, 9, 0))
    return scene


def test_refined_scenes_keep_everything():
    """Every part of a tet is what the tet was: masses, laws, and the static energy of a linear displacement."""
    scene, F = everything(), np.array([[0.1, 0.2, 0], [0, -0.3, 0.1], [0, 0, 0.2]])
    for new in (refined(scene), with_order(scene, 2)):
        for old, body in zip(scene.bodies, new.bodies):
            assert body.mass == pytest.approx(old.mass) and body.composition.laws == old.composition.laws
            u, old_u = ((b.rest_positions @ F).reshape(-1) for b in (body, old))
            assert u @ hooke_stiffness(body) @ u == pytest.approx(old_u @ hooke_stiffness(old) @ old_u)
        assert new.bodies[0].mesh.region_names == {3: "left"} and np.ndim(new.bodies[1].poisson) == 0


def test_scene_files_and_digests_keep_everything(tmp_path):
    """All meshes are checked before the first is written."""
    one, scene = rubber(), everything()
    scenes = [beam(one), beam({"left": one, 7: one}), beam(one, young=np.full(15, 1e5)), beam(one, density=np.full(15, 1e3))]
    assert len({scene_digest(scene) for scene in scenes}) == 4
    numbers = beam({"3": rubber(), "08": rubber(young=3e5)}, mesh=named({3: "3", 7: "08"}))
    for made in (scene, numbers):
        there_and_back(tmp_path / "a.toml", made, {"dt": 0.01})
    zero = ts.TetMesh(MESH.vertices, MESH.tets, regions=0 * MESH.regions, region_names={0: "all"})
    scene.add_body(zero, {"all": rubber()}, name="split", position=(0, 19, 0))
    with pytest.raises(SceneError, match="body 'split': its mesh has no region but 0, .*: use another number"):
        ts.write_scene(tmp_path / "b.toml", scene)
    assert not list(tmp_path.glob("b*"))


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"material": {"left": rubber()}}, "region 7 has no material; every region needs one"),
        ({"material": {"lft": rubber(), 7: rubber()}}, r"material: no region is called 'lft'; did you mean 'left'\?"),
        ({"material": {3: rubber(), "left": rubber(), 7: rubber()}}, "region 'left' is given two materials, by its name and by"),
        ({"material": {"left": rubber(friction=0.1), 7: rubber()}}, "friction is 0.1 in region 'left' and 0.5 in region 7"),
        ({"material": [rubber()]}, "material must be a Material, or a dict that gives each region one, not list"),
        ({"young": np.ones(3)}, r"young must have shape \(15,\), not \(3,\)"),
        ({"young": np.append(np.ones(14), 0.0)}, "young of tet 14 must be greater than 0 Pa, not 0"),
        ({"poisson": np.append(np.zeros(14), 0.5)}, r"poisson of tet 14 must lie in the open interval \(-1, 0.5\), not 0.5"),
        ({"young": [1e5] * 14 + [float("nan")]}, r"young: entry \[14\] is nan, not finite"),
    ],
)
def test_bad_input_is_refused(arguments, message):
    scene = ts.Scene()
    with pytest.raises(SceneError, match=rf"^body 'beam': {message}"):
        scene.add_body(**({"mesh": MESH, "material": rubber(), "name": "beam"} | arguments))
    assert scene.bodies == ()


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"regions": [1, 2]}, r"regions must have shape \(15,\), one for each tet, not \(2,\)"),
        ({"regions": np.ones(15)}, "regions must be integers, not of type float64"),
        ({"regions": [2**31] * 15}, "tet 0: region 2147483648 does not fit into 32 bits"),
        ({"region_names": {1: "a"}}, "region_names are given without regions"),
        ({"regions": [1] * 15, "region_names": {2: "a"}}, "region_names: no tet is in region 2"),
        ({"regions": [1] * 15, "region_names": {1: " "}}, "region_names: the name of region 1 must be a line of text"),
        ({"regions": [1] * 14 + [2], "region_names": {1: "a", 2: "a"}}, "region_names: 'a' is the name of two regions"),
        ({"regions": [1] * 14 + [-2], "region_names": {1: "-2"}}, "'-2', the name of region 1, is the number of another"),
    ],
)
def test_bad_regions_are_refused(arguments, message):
    with pytest.raises(ts.MeshError, match=f"^part: .*{message}"):
        ts.TetMesh(MESH.vertices, MESH.tets, source="part", **arguments)


def test_regions_are_looked_up_by_name_or_number():
    assert MESH.region_ids == (3, 7) and [MESH.region_id(key) for key in ("left", 3, np.int64(7))] == [3, 3, 7]
    for key in (3.0, True, "7", None, [3]):
        with pytest.raises(ts.MeshError, match="no tet is in region|no region is called"):
            MESH.region_id(key)


def test_a_floor_follows_changed_numbers_but_cannot_change():
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.add_body(cube(), rubber(SNH, poisson=0.4, volume_floor=0.1), name="block")
    with explicit(scene) as sim:
        sim.set_state(positions=sim.positions() * [1.0, 0.05, 1.0])
        before = sim.energies().elastic
        sim.set_material("block", young=5e4)
        assert sim.energies().elastic == pytest.approx(0.5 * before, rel=1e-12)
        with pytest.raises(ts.SceneError, match="volume_floor cannot change while it runs"):
            sim.set_material("block", volume_floor=0.2)


def test_stable_dt_counts_the_floor_of_each_region():
    """A floor in a soft region of a stiff body shortens it less than in the stiff one."""

    def limit(soft: float, stiff: float, **more) -> float:
        scene = ts.Scene()
        materials = {"left": rubber(SNH, young=1e3, volume_floor=soft), 7: rubber(SNH, young=1e6, volume_floor=stiff)}
        scene.add_body(halved(cube(cells=(2, 1, 1))), materials, **more)
        return stable_dt(scene, verlet=False)

    assert limit(0.05, 0.0) == pytest.approx(limit(0.0, 0.0), rel=0.02)
    assert limit(0.0, 0.05) == pytest.approx(limit(0.0, 0.0) / np.sqrt(41.0), rel=0.02)
    assert limit(0.1, 0.1) == pytest.approx(limit(0.0, 0.0) / np.sqrt(21.0), rel=1e-3)
    for more in ({"order": 2}, {"dilatation": "mean"}):
        assert limit(0.1, 0.1, **more) < limit(0.0, 0.0, **more) / 3.0
