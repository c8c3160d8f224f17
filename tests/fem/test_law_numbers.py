"""Numbers of laws from an energy density reach materials, scenes, files, checkpoints and running simulations; ranges hold."""

import dataclasses
import warnings

import numpy as np
import pytest

import taisoft as ts
from taisoft.backend.counters import counting
from taisoft.scene.laws import LAWS
from tests.dynamics.scenes import COR, SNH, SVK
from tests.fem.energies import OLD, POLYNOMIAL, block, neo_hookean, polynomial

pytestmark = pytest.mark.usefixtures("known_laws")


def test_names_of_the_package_and_values_out_of_range_are_refused():
    with pytest.raises(ts.SceneError, match="is that of a law of the package"):
        ts.register_law("gent", OLD[SVK])
    with pytest.warns(UserWarning, match="'own' is not finite where det F < 0"):
        found = ts.register_law("own", polynomial, POLYNOMIAL)
    assert found.is_isotropic and not found.is_finite_inverted
    numbers = {"c1": 2e4, "c2": 1e3, "bulk": 1e5}
    for change, message in (
        ({"c1": -1.0}, "material: c1 must be greater than 0 Pa, not -1"),
        ({"c1": None}, "material: law own needs c1"),
        ({"c4": 1.0}, "law own: no parameter is called 'c4'"),
        ({"young": 1e5}, "young follows from the numbers of law own: c1, c2, bulk"),
        ({"bulk": -1e5}, "law 'own' is unstable at rest with c1 = 20000, c2 = 1000, bulk = -100000"),
    ):
        given = {name: value for name, value in {**numbers, **change}.items() if value is not None}
        with pytest.raises(ts.SceneError, match=message):
            ts.Material(law="own", **given)
    with pytest.raises(ts.SceneError, match="law corotational has no parameters"):
        ts.Material(law=COR, parameters={"c1": 1.0})


def test_moduli_at_rest_follow_from_the_parameters():
    material = ts.Material(law="mooney_rivlin", c1=2e4, c2=5e3, bulk=1e6, friction=0.1)
    assert material.mu == pytest.approx(5e4) and material.lam == pytest.approx(1e6 - 2 / 3 * 5e4)
    assert (material.c1, material.parameters["bulk"], material.friction) == (2e4, 1e6, 0.1)
    changed = dataclasses.replace(material, c1=4e4)
    assert changed.mu == pytest.approx(9e4) and changed.friction == 0.1
    assert dataclasses.replace(material, friction=0.3).c1 == 2e4
    assert ts.Material(law="ogden", mu1=3e4, alpha1=4.0, bulk=1e6).mu == pytest.approx(6e4)


def test_statics_of_a_law_from_its_energy_equal_those_of_the_one_written_by_hand():
    ts.register_law("again", neo_hookean)
    for order in (1, 2):
        found, expected = (
            ts.solve_static(block(ts.Material(law=law, young=1e5, poisson=0.4), order=order)).positions("block")
            for law in ("again", SNH)
        )
        assert np.abs(found - expected).max() < 1e-9
        assert np.abs(expected[:, 0].max() - 1.0) > 0.2


def test_mean_dilatation_takes_the_volumetric_part():
    """Of neo-Hookean as psi + lam/2 (J - 1)^2, on patches as the law written by hand."""

    def without_volume(I1, J, mu):
        return 2 / 3 * mu * (I1 - 3 - np.log((I1 + 1) / 4)) + 5 / 12 * mu * (J - 1) ** 2 - mu * (J - 1)

    ts.register_law("mean", lambda I1, J, mu, lam: without_volume(I1, J, mu), dilatation=lambda J: J - 1, modulus="lam")
    made = {law: block(ts.Material(law=law, young=1e5, poisson=0.48)) for law in ("mean", SNH)}
    assert made["mean"].bodies[0].dilatation == "mean"
    found, expected = (ts.solve_static(scene).positions("block") for scene in made.values())
    assert np.abs(found - expected).max() < 1e-9
    rubber = ts.Material(law="mooney_rivlin", c1=2e4, bulk=2e6)
    local, mean = (ts.solve_static(block(rubber, dilatation=one)).positions("block")[:, 0].max() for one in ("local", "mean"))
    assert mean > 1.02 * local  # linear tets lock


def test_parameters_by_region_and_by_tet_in_files_runs_and_checkpoints(tmp_path):
    mesh = ts.box_mesh((2, 1, 1), (2, 1, 1))
    left = mesh.vertices[mesh.tets].mean(axis=1)[:, 0] < 0
    mesh = ts.TetMesh(mesh.vertices, mesh.tets, regions=np.where(left, 1, 2), region_names={1: "soft", 2: "hard"})
    materials = {"soft": ts.Material(law="mooney_rivlin", c1=2e4, bulk=1e5), "hard": ts.Material(law=SNH, young=4e5)}
    c1 = np.where(left, 2e4, np.nan)
    scene = block(materials[("soft")], parameters={"c1": np.linspace(2e4, 4e4, mesh.n_tets)})
    scene.add_body(mesh, materials, name="two", position=(0, 5, 0))
    assert np.array_equal(scene.body("two").young < 2e5, left)
    ts.write_scene(tmp_path / "scene.toml", scene)
    again, _ = ts.read_scene(tmp_path / "scene.toml")
    for name in ("block", "two"):
        assert np.array_equal(
            again.body(name).composition.number("c1"), scene.body(name).composition.number("c1"), equal_nan=True
        )
        assert again.body(name).composition.materials == scene.body(name).composition.materials
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
            sim.step()
            sim.set_material("two", region="soft", c1=3e4)
            sim.set_material("two", c1=1.5 * c1, young=5e5)
            with counting() as counts:
                sim.set_material("block", c1=5e4)
            assert not counts.compiled
            with pytest.raises(ts.SceneError, match="c3 cannot change while it runs .did you mean c2"):
                sim.set_material("block", c3=1.0)
            with pytest.raises(ts.SceneError, match="c1 of tet 3 .*must|shear modulus"):
                sim.set_material("block", c1=np.where(np.arange(mesh.n_tets) == 3, -1e5, 1e4))
            sim.step()
            sim.save_checkpoint(tmp_path / "saved.npz")
            sim.step()
            expected = sim.positions()
        with ts.Simulator.load_checkpoint(tmp_path / "saved.npz", scene) as sim:
            assert sim.scene.body("block").composition.number("c1") == 5e4
            assert np.nanmax(sim.scene.body("two").composition.number("c1")) == 3e4
            sim.step()
            assert np.array_equal(sim.positions(), expected)


def test_numbers_by_tet_of_mixed_bodies_reach_checkpoints(tmp_path):
    mesh = ts.box_mesh((2, 1, 1), (2, 1, 1))
    left = mesh.vertices[mesh.tets].mean(axis=1)[:, 0] < 0
    mesh = ts.TetMesh(mesh.vertices, mesh.tets, regions=np.where(left, 1, 2))
    scene = ts.Scene()
    materials = {1: ts.Material(law="gent", shear=2e4, bulk=1e5), 2: ts.Material(law=SNH, young=4e5)}
    scene.add_body(mesh, materials, name="two").fix(lambda X: X[:, 0] < -0.9)
    with ts.Simulator(scene, dt=0.01, precision="f64") as sim:
        sim.set_material("two", young=np.linspace(1e5, 9e5, mesh.n_tets))
        sim.step()
        sim.save_checkpoint(tmp_path / "saved.npz")
        sim.step()
        expected = sim.positions()
    with ts.Simulator.load_checkpoint(tmp_path / "saved.npz", scene) as sim:
        sim.step()
        assert np.array_equal(sim.positions(), expected)


def test_materials_of_a_law_that_was_registered_anew_are_refused():
    ts.register_law("own", lambda I1, J, k: k * (I1 - 3 - 2 * (J - 1) + 2 * (J - 1) ** 2), {"k": "Pa"})
    old = ts.Material(law="own", k=1e5)
    with pytest.raises(ts.SceneError, match="parameters cannot change"):
        old.parameters["k"] = 1.0
    stale = block(old)
    with ts.Simulator(stale, dt=0.01), pytest.raises(ts.SceneError, match="registered already, and a simulator"):
        ts.register_law("own", polynomial, POLYNOMIAL)
    ts.register_law("own", lambda I1, J, k: 9 * k * (I1 - 3 - 2 * (J - 1) + 2 * (J - 1) ** 2), {"k": "Pa"})
    with pytest.raises(ts.SceneError, match="law 'own' has been registered anew since its material was made"):
        block(old)
    for use in (ts.Simulator, ts.solve_static, lambda scene: ts.modes(scene, 1)):
        with pytest.raises(ts.SceneError, match="body 'block': law 'own' has been registered anew"):
            use(stale)
    with pytest.raises(ts.SceneError, match="no parameter of its laws is called 'friction'; there are k"):
        block(ts.Material(law="own", k=1e5), parameters={"friction": 0.1})
    del LAWS["own"]
    with pytest.raises(ts.SceneError, match="law 'own' is not registered in this process"):
        block(old)


def test_a_law_that_has_changed_does_not_continue_a_checkpoint(tmp_path):
    ts.register_law("own", neo_hookean)
    scene = block(ts.Material(law="own", young=1e5))
    with ts.Simulator(scene, dt=0.01) as sim:
        sim.step()
        sim.save_checkpoint(tmp_path / "saved.npz")
    ts.register_law("own", OLD[SVK])
    with pytest.raises(ts.SceneError, match="body 'block': order, quadrature, dilatation, law, branches or collision"):
        ts.Simulator.load_checkpoint(tmp_path / "saved.npz", scene)
