"""The comparison with other programs:

* laws in NumPy reduce to linear elasticity at small strains, are frame-indifferent, and agree with taisoft's stresses;
* verdicts detect bodies that fall, lean, float, invert or penetrate;
* errors are relative to the length that each work defines;
* limits compare the fastest accurate settings of each program, and show where there are none;
* adapters give the positions of taisoft and of the installed programs, starting from those of the work;
* every program runs with implicit and explicit methods and its own laws; the page lists further settings that were tried.
"""

import importlib
import json
from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from benchmarks import peers
from benchmarks.programs import own
from benchmarks.programs.session import Setting
from benchmarks.works import evaluation, references, runs, scenes
from benchmarks.works.references import MODELS, NEWTON, PYBULLET, TAISOFT
from benchmarks.works.runs import Row, fastest_standing, fastest_within, measure
from benchmarks.works.semi_discrete import LAWS, SemiDiscrete
from benchmarks.works.table import compare_table, comparisons, limits_of, run_table

MU, LAM = 3e4, 7e4  # [Pa]


def rotation(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


@pytest.mark.parametrize("law", LAWS)
def test_laws_are_linear_at_small_strain_and_frame_indifferent(law):
    grad = 1e-6 * np.random.default_rng(3).standard_normal((3, 3, 5))
    strain = 0.5 * (grad + grad.transpose(1, 0, 2))
    linear = 2 * MU * strain + LAM * np.trace(strain) * np.eye(3)[:, :, None]
    stress = LAWS[law](np.eye(3)[:, :, None] + grad, MU, LAM)
    assert np.abs(stress - linear).max() < 1e-5 * np.abs(linear).max()
    F = np.eye(3)[:, :, None] + 0.2 * np.random.default_rng(4).standard_normal((3, 3, 5))
    R = rotation(0.8)
    rotated = LAWS[law](np.einsum("ij,jkm->ikm", R, F), MU, LAM)
    assert np.allclose(rotated, np.einsum("ij,jkm->ikm", R, LAWS[law](F, MU, LAM)), rtol=0, atol=1e-9 * np.abs(rotated).max())


@pytest.mark.parametrize("law", own.LAWS)
def test_stresses_agree_with_taisoft(law):
    F = np.eye(3) + 0.3 * np.random.default_rng(5).standard_normal((6, 3, 3))
    young = MU * (3 * LAM + 2 * MU) / (LAM + MU)
    _, found = ts.evaluate_law(own.LAWS[law], F, young=young, poisson=LAM / (2 * (LAM + MU)))
    expected = LAWS[law](F.transpose(1, 2, 0), MU, LAM).transpose(2, 0, 1)
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


def test_equal_masses_have_the_same_total():
    work = scenes.dropped_cube()
    lumped, equal = references.masses(work, TAISOFT), references.masses(work, PYBULLET)
    assert lumped.sum() == pytest.approx(1000.0) and equal.sum() == pytest.approx(1000.0)
    assert np.ptp(equal) == 0.0 and np.ptp(lumped) > 0.0


@pytest.mark.parametrize("work", [work for work in scenes.WORKS if work.kind == "path"], ids=lambda work: work.key)
@pytest.mark.parametrize("model", MODELS, ids=str)
def test_every_reference_is_stored_and_converged(work, model):
    reference = references.load(work, model)
    assert reference.path.shape[0] == 101 and np.isfinite(reference.path).all()
    assert reference.good_to < (1e-4 if work.cells is None else 1e-6)
    assert reference.error(reference.path) == 0.0
    moved = reference.path.copy()
    moved[50, -1] += 0.01
    excursion = np.linalg.norm(reference.path - reference.path[0], axis=1).max()
    expected = np.sqrt(0.01**2 / 101) / 0.5 if work.cells is None else 0.01 / excursion
    assert reference.error(moved) == pytest.approx(expected)


def test_a_missing_reference_is_refused():
    with pytest.raises(ts.SimulationError, match="no reference is stored for W1 2x1x1 with SNH"):
        references.load(scenes.hanging_beam((2, 1, 1)), TAISOFT)


def test_a_fall_is_parabolic_until_the_ground():
    mesh = ts.box_mesh((2, 2, 2), (1, 1, 1))
    mesh = ts.TetMesh(mesh.vertices + [0, 0.6, 0], mesh.tets)
    free = np.ones(mesh.n_verts, bool)
    body = SemiDiscrete(mesh, "SNH", 1e5, 0.3, 1000.0, 9.81, free)
    heights = references.fall_on_ground(body, 0.5, 1e-3, 0.4)[:, 0]
    t = np.arange(len(heights)) * 0.01
    falling = 0.5 * 9.81 * t**2 < 0.1
    assert np.allclose(heights[falling], 0.6 - 0.5 * 9.81 * t[falling] ** 2, atol=1e-9)
    assert 0.3 < heights.min() < 0.499


def at_rest(work: scenes.Work, samples: int = 3) -> np.ndarray:
    return np.repeat(work.start[None], samples, axis=0)


def test_verdicts_detect_failures():
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


@pytest.mark.parametrize("work", [work for work in scenes.WORKS if work.kind == "stand"], ids=lambda work: work.key)
def test_floating_bodies_do_not_stand(work):
    last = list(work.slices().values())[-1]
    falling = at_rest(work, 21)
    t = np.arange(21) * 0.01
    falling[:, last, 1] -= 0.5 * work.gravity * t[:, None] ** 2
    assert evaluation.free_fall(work, falling) == pytest.approx(1.0)
    assert evaluation.free_fall(work, at_rest(work, 21)) == 0.0 and evaluation.free_fall(work, at_rest(work)) is None
    verdict = evaluation.Verdict(0, free_fall=1.1)
    assert verdict.stands and not replace(verdict, free_fall=0.7).stands and not replace(verdict, free_fall=1.3).stands


def made_row(work: scenes.Work, program: str, seconds: float, error: float | None = None, inverted: int = 0) -> Row:
    row = Row(work, Setting(program, TAISOFT, "explicit", 2), [[seconds], [1.1 * seconds]], [0.1])
    penetration, edge = (0.0, 0.1) if work.touches else (None, None)
    good_to = None if error is None else 1e-6
    row.verdict = evaluation.Verdict(inverted, error, good_to, penetration, edge)
    return row


def test_the_fastest_accurate_rows_are_compared():
    work = scenes.hanging_beam((12, 3, 3))
    rows = [
        made_row(work, "taisoft", 0.1, 5e-3),
        made_row(work, "taisoft", 0.5, 5e-5),
        made_row(work, "MuJoCo", 1.0, 5e-5),
        made_row(work, "MuJoCo", 0.3, 0.5),
    ]
    assert fastest_within(rows, 1e-2) is rows[0] and fastest_within(rows, 1e-4) is rows[1] and fastest_within(rows, 1e-5) is None
    limits = limits_of(rows)
    assert [round(limit.value, 6) for limit in limits] == [1.0, 10.0, 1.0, 2.0, 1.0, 2.0, 0.0]
    assert [limit.met for limit in limits] == [True, True, True, False, True, False, False]
    table = compare_table(comparisons([rows]))
    assert "| error <= 0.01 " in table and table.count("MuJoCo explicit") == 3 and "| explicit, SNH, 5 ms" in table
    rows[0].verdict.error = 1e-8  # below the uncertainty of the reference
    assert rows[0].claimed == 1e-6
    assert "5e-05" not in run_table(rows) and "0.005 %" in run_table(rows)


def test_rows_that_do_not_stand_are_not_compared():
    work = scenes.stack()
    rows = [made_row(work, "taisoft", 0.5), made_row(work, "taisoft", 0.1, inverted=3)]
    rows.append(made_row(work, "Newton", 0.01, inverted=1))
    assert fastest_standing(rows) is rows[0]
    assert [(limit.value, limit.met) for limit in limits_of(rows)] == [(1.0, True)]
    assert not limits_of(rows[1:])[0].met
    rows[0].unconverged = 1
    assert not rows[0].stood


def test_limits_of_a_drop():
    work = scenes.dropped_cube()
    met = [made_row(work, "taisoft", 0.2, 4e-3)]
    assert limits_of(met)[0].met and not limits_of([made_row(work, "taisoft", 0.2, 6e-3)])[0].met
    assert not limits_of([made_row(work, "taisoft", 0.5, 4e-3)])[0].met


def small_drop() -> scenes.Work:
    mesh = ts.box_mesh((1, 1, 1), (1, 1, 1))
    cube = scenes.Body("cube", ts.TetMesh(mesh.vertices + [0, 0.51, 0], mesh.tets), 1e5, np.zeros(mesh.n_verts, bool))
    return replace(scenes.dropped_cube(), key="small", kind="stand", bodies=(cube,), seconds=0.1)


def test_rows_are_measured_with_verdicts(capsys):
    work = small_drop()

    class Broken:
        NAME = "broken"

        @staticmethod
        def settings(work, arch):
            return [Setting("broken", TAISOFT, "none", 1)]

        @staticmethod
        def Run(work, setting):
            raise ValueError("it is broken")

    rows = measure(work, [own, Broken], 1)
    assert "small, round 1 of 1: taisoft velocity_verlet" in capsys.readouterr().err
    assert all(row.verdict is not None and row.verdict.stands and row.timing for row in rows[:-1]) and len(rows) == 5
    assert rows[-1].failure == "it is broken" and rows[-1].timing is None and "it is broken" in run_table(rows)


@pytest.mark.parametrize("seconds, build_seconds, rounds", [(9.0, 19.0, 3), (11.0, 1.0, 1), (1.0, 21.0, 1)])
def test_slow_runs_are_measured_once(seconds, build_seconds, rounds, monkeypatch):
    monkeypatch.setattr(runs, "evaluate", lambda work, model, positions: evaluation.Verdict(0))

    class Slow:
        NAME, build_time = "slow", build_seconds
        settings = staticmethod(lambda work, arch: [Setting("slow", TAISOFT, "none", 1)])
        Run = classmethod(lambda cls, work, setting: cls())

        def __init__(self):
            self.build_seconds, self.unconverged = self.build_time, 0

        def run(self, follow):
            return (at_rest(small_drop()) if follow else None), seconds

        def close(self):
            pass

    work = replace(small_drop(), seconds=1.0)
    (row,) = measure(work, [Slow], 3)
    assert len(row.rounds) == rounds and all(one[0] == seconds for one in row.rounds)


def test_stored_rows_of_other_works_are_kept(tmp_path, monkeypatch, capsys):
    first, second = small_drop(), replace(small_drop(), key="second")
    seconds = {"small": 1.0, "second": 1.0}

    class AtRest:
        NAME = "taisoft"
        problem = staticmethod(lambda: "")
        settings = staticmethod(lambda work, arch: [Setting("taisoft", TAISOFT, "still", 1, {"precision": "f64"})])

        def __init__(self, work):
            self.work, self.build_seconds, self.unconverged = work, 0.1, 0

        Run = classmethod(lambda cls, work, setting: cls(work))

        def run(self, follow):
            return (at_rest(self.work) if follow else None), seconds[self.work.key] * self.work.seconds

        def close(self):
            pass

    monkeypatch.setattr(peers, "WORKS", (first, second))
    monkeypatch.setattr(peers, "PROGRAMS", (AtRest,))
    monkeypatch.setattr(peers, "own", AtRest)
    out = tmp_path / "peers.json"
    assert peers.main(["--out", str(out)]) == 0
    seconds.update(small=3.0, second=3.0)
    assert peers.main(["--work", "second", "--out", str(out)]) == 0
    numbers = json.loads(out.read_text())
    assert [row["rounds"][0][0] for row in numbers["runs"]] == pytest.approx([1.0, 3.0]) and not numbers["quick"]
    text = out.with_suffix(".md").read_text()
    assert "| ppf-contact-solver | all " in text and "## What else was tried" in text
    assert {one["program"] for one in numbers["tried"]["settings"]} >= {"MuJoCo", "PyBullet", "Newton", "ppf-contact-solver"}
    assert "0 of 1 times agree" in text and "## small" in text and "| second: taisoft, SNH, still" in text
    assert peers.main(["--work", "small", "--rounds", "1", "--out", str(tmp_path / "new.json")]) == 0
    assert json.loads((tmp_path / "new.json").read_text())["quick"] and not (tmp_path / "new.png").exists()


def test_explicit_steps_converge_to_the_exact_path():
    work = scenes.dropped_cube()
    setting = Setting("taisoft", TAISOFT, "velocity_verlet", 16, {"precision": "f64"})
    session = own.Run(work, setting)
    positions, _ = session.run(follow=True)
    session.close()
    path = references.observed(work, positions, references.masses(work, TAISOFT))
    assert references.load(work, TAISOFT).error(path) < 5e-4


def test_adapter_of_taisoft():
    work = small_drop()
    session = own.Run(work, Setting("taisoft", TAISOFT, "velocity_verlet", 4, {"precision": "f64"}))
    positions, seconds = session.run(follow=True)
    again, _ = session.run(follow=False)
    session.close()
    assert positions.shape == (11, work.bodies[0].mesh.n_verts, 3) and again is None and seconds > 0.0
    assert np.array_equal(positions[0], work.start) and session.unconverged == 0
    assert positions[3, :, 1].mean() == pytest.approx(0.51 - 0.5 * 9.81 * 0.03**2, abs=1e-9)
    assert evaluation.evaluate(work, TAISOFT, positions).stands


def adapter(name: str):
    program = importlib.import_module(f"benchmarks.programs.{name}")
    if program.problem():
        pytest.skip(program.problem())
    return program


def test_mujoco_runs_with_both_contact_models_and_laws():
    from benchmarks.programs import mujoco_flex

    for work in scenes.WORKS:
        found = mujoco_flex.settings(work)
        implicit = [one for one in found if one.method == "discrete"]
        assert {one.model for one in implicit} == {mujoco_flex.MODEL, mujoco_flex.NEO_HOOKEAN}
        assert any(one.method == "euler_staggered" for one in found)
        for contact in ("passive", "solref") if work.touches else ():
            similar = [one for one in implicit if one.model == mujoco_flex.NEO_HOOKEAN and contact in one.options]
            assert len({one.dt for one in similar}) >= 2
        assert len({str(one) + str(one.model) + str(one.dt) for one in found}) == len(found)


@pytest.mark.parametrize("neo_hookean", [False, True])
def test_forces_of_mujoco_agree_with_its_law(neo_hookean):
    program = adapter("mujoco_flex")
    mujoco = program.import_mujoco()
    work, model = small_drop(), program.NEO_HOOKEAN if neo_hookean else program.MODEL
    session = program.Run(work, Setting("MuJoCo", model, "discrete", 4, {"passive": True, "radius": 1e-4}))
    data, body = mujoco.MjData(session.model), work.bodies[0]
    u = 0.1 * np.random.default_rng(6).standard_normal(work.start.shape)
    u[:, 1] += 1.0  # above the ground
    data.qpos[:] = u.ravel()
    mujoco.mj_forward(session.model, data)
    exact = SemiDiscrete(body.mesh, model.law, body.young, 0.3, 1000.0, work.gravity, ~body.fixed)
    expected = exact.elastic_force(u.T).T.ravel()
    assert np.abs(expected).max() > 1e3  # N: something is active
    assert np.abs(data.qfrc_passive - expected).max() < 1e-10 * np.abs(expected).max()
    assert session.model.flex_passive[0] == 1 and session.model.opt.solver == mujoco.mjtSolver.mjSOL_CG


def test_mujoco_refuses_implicit_elasticity_except_in_discrete_steps():
    program = adapter("mujoco_flex")
    work = scenes.hanging_beam((12, 3, 3))
    (setting,) = (one for one in program.settings(work) if one.method == "implicitfast")
    with pytest.raises(Exception, match="flex elasticity is no longer integrated implicitly"):
        program.Run(work, setting).run(follow=False)


@pytest.mark.parametrize(
    "name, model", [("pybullet_soft", PYBULLET), ("newton_works", NEWTON), ("mujoco_flex", references.MUJOCO)]
)
def test_peers_start_and_fall_as_taisoft(name, model):
    program, work = adapter(name), small_drop()
    kinds = {(one.method, one.model, "passive" in one.options): one for one in program.settings(work) if "ipc" not in one.options}
    assert program.MODEL == model and model in {one.model for one in kinds.values()}
    for setting in kinds.values():
        session = program.Run(work, setting)
        positions, _ = session.run(follow=True)
        again, _ = session.run(follow=True)
        session.close()
        assert np.array_equal(positions[0], work.start) and np.array_equal(positions, again)
        fallen = 0.51 - 0.5 * 9.81 * 0.03**2
        assert positions[3, :, 1].mean() == pytest.approx(fallen, abs=1.6e-3)  # half a step of 10 ms of the fall


def test_explicit_steps_of_newton_are_second_order():
    program = adapter("newton_works")
    work = replace(scenes.hanging_beam((12, 3, 3)), seconds=0.3)
    reference, mass = references.load(work, program.EXPLICIT_MODEL), references.masses(work, program.EXPLICIT_MODEL)
    errors = []
    for steps in (3, 6):
        session = program.Run(work, Setting("Newton", program.EXPLICIT_MODEL, "semi_implicit", steps))
        path = references.observed(work, session.run(follow=True)[0], mass)
        errors.append(np.linalg.norm(path - reference.path[: len(path)], axis=1).max())
    assert errors[0] < 1e-4 and np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.3)
