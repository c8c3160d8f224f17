"""The comparison with other programs:

* laws in NumPy reduce to linear elasticity at small strains, are frame-indifferent, and agree with taisoft's stresses;
* references are stored and converged, their errors relative to the length that each work defines;
* verdicts detect bodies that fall, lean, invert or penetrate; limits compare the fastest accurate settings;
* where MuJoCo is installed, it solves the same equations: masses, elastic forces of both laws, the order of its integrators.
"""

from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from benchmarks.exact_path import FallingBeam
from benchmarks.programs import mujoco_flex, own
from benchmarks.programs.session import Setting
from benchmarks.works import evaluation, references, scenes
from benchmarks.works.references import MODELS, MUJOCO, TAISOFT
from benchmarks.works.runs import Row, fastest_standing, fastest_within
from benchmarks.works.semi_discrete import LAWS, SemiDiscrete
from benchmarks.works.table import compare_table, comparisons, limits_of, run_table
from taisoft.errors import SimulationError

MU, LAM = 3e4, 7e4  # [Pa]
CELLS = (12, 3, 3)
needs_mujoco = pytest.mark.skipif(bool(mujoco_flex.problem()), reason=mujoco_flex.problem() or "MuJoCo is there")


@pytest.mark.parametrize("law", LAWS)
def test_laws_are_linear_at_small_strain_and_frame_indifferent(law):
    grad = 1e-6 * np.random.default_rng(3).standard_normal((3, 3, 5))
    strain = 0.5 * (grad + grad.transpose(1, 0, 2))
    linear = 2 * MU * strain + LAM * np.trace(strain) * np.eye(3)[:, :, None]
    stress = LAWS[law](np.eye(3)[:, :, None] + grad, MU, LAM)
    assert np.abs(stress - linear).max() < 1e-5 * np.abs(linear).max()
    F = np.eye(3)[:, :, None] + 0.2 * np.random.default_rng(4).standard_normal((3, 3, 5))
    c, s = np.cos(0.8), np.sin(0.8)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    rotated = LAWS[law](np.einsum("ij,jkm->ikm", R, F), MU, LAM)
    assert np.allclose(rotated, np.einsum("ij,jkm->ikm", R, LAWS[law](F, MU, LAM)), rtol=0, atol=1e-9 * np.abs(rotated).max())
    if law in own.LAWS:
        young = MU * (3 * LAM + 2 * MU) / (LAM + MU)
        deformed = F.transpose(2, 0, 1)
        _, found = ts.evaluate_law(own.LAWS[law], deformed, young=young, poisson=LAM / (2 * (LAM + MU)))
        expected = LAWS[law](F, MU, LAM).transpose(2, 0, 1)
        assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


def test_references_are_stored_and_converged():
    for work in (work for work in scenes.WORKS if work.kind == "path"):
        for model in MODELS:
            reference = references.load(work, model)
            assert reference.path.shape[0] == 101 and np.isfinite(reference.path).all()
            assert reference.good_to < (1e-4 if work.cells is None else 1e-6)
            moved = reference.path.copy()
            moved[50, -1] += 0.01
            excursion = np.linalg.norm(reference.path - reference.path[0], axis=1).max()
            expected = np.sqrt(0.01**2 / 101) / 0.5 if work.cells is None else 0.01 / excursion
            assert reference.error(reference.path) == 0.0 and reference.error(moved) == pytest.approx(expected)
    with pytest.raises(ts.SimulationError, match="no reference is stored for W1 2x1x1 with SNH"):
        references.load(scenes.hanging_beam((2, 1, 1)), TAISOFT)


def at_rest(work: scenes.Work, samples: int = 3) -> np.ndarray:
    return np.repeat(work.start[None], samples, axis=0)


def small_drop() -> scenes.Work:
    mesh = ts.box_mesh((1, 1, 1), (1, 1, 1))
    cube = scenes.Body("cube", ts.TetMesh(mesh.vertices + [0, 0.51, 0], mesh.tets), 1e5, np.zeros(mesh.n_verts, bool))
    return replace(scenes.dropped_cube(), key="small", kind="stand", bodies=(cube,))


def test_verdicts_detect_failures_f64():
    work = scenes.stack()
    nodes = work.slices()
    assert evaluation.evaluate(work, TAISOFT, at_rest(work)).stands
    for change, is_detected in (
        ([0.2, 0, 0], lambda v: v.fell == 0.01),  # leans
        ([0, -0.9, 0], lambda v: v.fell == 0.01 and v.penetration > 0.01),  # falls through
        ([0, -0.05, 0], lambda v: v.fell is None and v.penetration == pytest.approx(0.049, abs=1e-3)),  # penetrates
    ):
        moved = at_rest(work)
        moved[1, nodes["cube 1"]] += change
        verdict = evaluation.evaluate(work, TAISOFT, moved)
        assert is_detected(verdict) and not verdict.stands
    mirrored = at_rest(work)
    mirrored[2, nodes["cube 2"], 0] *= -1
    verdict = evaluation.evaluate(work, TAISOFT, mirrored)
    assert verdict.inverted == work.bodies[2].mesh.n_tets and not verdict.stands


def made_row(work: scenes.Work, program: str, seconds: float, error: float | None = None, inverted: int = 0) -> Row:
    row = Row(work, Setting(program, TAISOFT, "explicit", 2), [[seconds], [1.1 * seconds]], [0.1])
    penetration, edge = (0.0, 0.1) if work.touches else (None, None)
    row.verdict = evaluation.Verdict(inverted, error, None if error is None else 1e-6, penetration, edge)
    return row


def test_the_fastest_accurate_rows_are_compared():
    work = scenes.hanging_beam(CELLS)
    own_rows = [made_row(work, "taisoft", 0.1, 5e-3), made_row(work, "taisoft", 0.5, 5e-5)]
    rows = [*own_rows, made_row(work, "MuJoCo", 1.0, 5e-5), made_row(work, "MuJoCo", 0.3, 0.5)]
    assert fastest_within(rows, 1e-2) is rows[0] and fastest_within(rows, 1e-4) is rows[1] and fastest_within(rows, 1e-5) is None
    limits = limits_of(rows)
    assert [round(limit.value, 6) for limit in limits] == [1.0, 10.0, 1.0, 2.0, 1.0, 2.0, 0.0]
    assert [limit.met for limit in limits] == [True, True, True, False, True, False, False]
    table = compare_table(comparisons([rows]))
    assert "| error <= 0.01 " in table and table.count("MuJoCo explicit") == 3 and "| explicit, SNH, 5 ms" in table
    rows[0].verdict.error = 1e-8  # below the uncertainty of the reference
    assert rows[0].claimed == 1e-6 and "0.005 %" in run_table(rows)
    work = scenes.stack()  # rows that do not stand are not compared
    rows = [
        made_row(work, "taisoft", 0.5),
        made_row(work, "taisoft", 0.1, inverted=3),
        made_row(work, "Newton", 0.01, inverted=1),
    ]
    assert fastest_standing(rows) is rows[0] and [(one.value, one.met) for one in limits_of(rows)] == [(1.0, True)]
    assert not limits_of(rows[1:])[0].met
    drops = ((0.2, 4e-3), (0.2, 6e-3), (0.5, 4e-3))
    assert [limits_of([made_row(scenes.dropped_cube(), "taisoft", *one)])[0].met for one in drops] == [True, False, False]


@needs_mujoco
@pytest.mark.parametrize("law", ["beam", "SVK", "SNH13"])
def test_mujoco_has_the_same_masses_and_forces(law):
    mujoco, rng = mujoco_flex.import_mujoco(), np.random.default_rng(2)
    if law == "beam":
        exact, work = FallingBeam(CELLS), scenes.hanging_beam(CELLS)
        session = mujoco_flex.Run(work, Setting("MuJoCo", MUJOCO, "euler", 10))
        u = 0.02 * rng.standard_normal(exact.vertices.shape) * exact.free[:, None]
    else:
        work, model = small_drop(), mujoco_flex.NEO_HOOKEAN if law == "SNH13" else MUJOCO
        session = mujoco_flex.Run(work, Setting("MuJoCo", model, "discrete", 4, {"passive": True, "radius": 1e-4}))
        body = work.bodies[0]
        exact = SemiDiscrete(body.mesh, law, body.young, 0.3, 1000.0, work.gravity, ~body.fixed)
        u = 0.1 * rng.standard_normal(work.start.shape) + [0.0, 1.0, 0.0]  # above the ground
    data = mujoco.MjData(session.model)
    data.qpos[:] = u[exact.free].ravel()
    mujoco.mj_forward(session.model, data)
    assert session.model.nv == 3 * exact.free.sum()
    assert np.allclose(session.model.body_mass[1:], exact.mass[exact.free], rtol=1e-14)
    expected = exact.elastic_force(u.T).T[exact.free].ravel()
    assert np.abs(expected).max() > 1e3  # [N]: the elements are deformed
    assert np.abs(data.qfrc_passive - expected).max() < 1e-10 * np.abs(expected).max()
    if law == "beam":
        acceleration = exact.acceleration(u.T).T[exact.free].ravel()
        assert np.abs(data.qacc - acceleration).max() < 1e-10 * np.abs(acceleration).max()


@needs_mujoco
@pytest.mark.parametrize(
    "integrator, dt, order, largest",
    [("euler", 2.5e-3, 1, 2e-3), ("euler_staggered", 2.5e-3, 2, 5e-5), ("discrete", 2.5e-3, 1, 5e-3), ("rk4", 5e-3, 4, 1e-5)],
)
def test_the_error_of_mujoco_converges_with_the_order_of_its_integrator(integrator, dt, order, largest, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    coarse, fine = (mujoco_flex.run_mujoco(CELLS, integrator, h, seconds=0.7) for h in (dt, dt / 2))
    assert coarse["error"] < largest and np.log2(coarse["error"] / fine["error"]) == pytest.approx(order, abs=0.25)
    assert coarse["path"].shape == (71, 3) and np.allclose(coarse["path"][0], [2, 0, 0])
    if integrator in ("euler", "rk4"):  # one step fewer than the stored stable ones diverges
        steps = mujoco_flex.STABLE_STEPS[CELLS][integrator == "rk4"]
        with pytest.raises(SimulationError, match=f"MuJoCo's {integrator} with dt = .* diverges on the mesh"):
            mujoco_flex.run_mujoco(CELLS, integrator, 0.01 / (steps - 1))
    assert list(tmp_path.iterdir()) == []  # MuJoCo writes no log of warnings
