"""The comparison with other programs:

* laws in NumPy reduce to linear elasticity at small strains, are frame-indifferent, and agree with taisoft's stresses;
* integration gives the independent reference path of a coarse beam; references are stored, converged and those of this code,
  their errors relative to the length that each work defines;
* verdicts detect bodies that fall, lean, invert or penetrate; limits compare the fastest accurate settings.
"""

import json

import numpy as np
import pytest

import taisoft as ts
from benchmarks.exact_path import integrate
from benchmarks.programs import own
from benchmarks.programs.session import Setting
from benchmarks.works import evaluation, references, scenes
from benchmarks.works.references import MODELS, MUJOCO, TAISOFT
from benchmarks.works.runs import Row, fastest_standing, fastest_within
from benchmarks.works.semi_discrete import LAWS
from benchmarks.works.table import limits_of

MU, LAM = 3e4, 7e4  # [Pa]
CELLS = (12, 3, 3)


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


def test_integration_gives_the_reference_path(shared):
    value = json.loads((shared / "references" / "beam_fall_semidiscrete.json").read_text())["value"]["SVK_lumped"]
    beam = references.semi_discrete(scenes.hanging_beam((11, 2, 2)), 0, MUJOCO)
    node = np.flatnonzero(np.all(np.isclose(beam.vertices, [2, 0, 0]), axis=1))
    t, path = integrate(beam, 1e-9, node)
    assert np.allclose(t[10::10], value["t"][:10])
    assert np.abs(path[10::10] - np.array(value["probe_x"])[:10]).max() < 1e-8  # m
    work = scenes.hanging_beam(CELLS)
    stored = references.load(work, MUJOCO).path
    _, path = integrate(references.semi_discrete(work, 0, MUJOCO), 1e-8, references.tip(work), seconds=0.1)
    assert np.linalg.norm(path - stored[: len(path)], axis=1).max() < 4e-7  # m, of an excursion of 4 m


def at_rest(work: scenes.Work, samples: int = 3) -> np.ndarray:
    return np.repeat(work.start[None], samples, axis=0)


@pytest.mark.long  # it compiles in f64
def test_verdicts_detect_failures():
    work = scenes.stack()
    nodes = work.slices()
    assert evaluation.evaluate(work, TAISOFT, at_rest(work)).stands
    for change, fell, penetration in (([0.2, 0, 0], 0.01, 0.0), ([0, -0.9, 0], 0.01, 0.1), ([0, -0.05, 0], None, 0.049)):
        moved = at_rest(work)
        moved[1, nodes["cube 1"]] += change
        verdict = evaluation.evaluate(work, TAISOFT, moved)
        assert verdict.fell == fell and verdict.penetration > penetration - 1e-3 and not verdict.stands
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
