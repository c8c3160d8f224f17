"""The reference problems of `benchmarks/references.py` on coarse meshes:

* every case has checks with a limit, and all pass;
* a wrong number or NaN fails its check;
* the benchmark's table, file and exit status show what failed, what could not be computed and what is missing.
"""

import json
import math
from dataclasses import replace

import pytest

from benchmarks import references
from benchmarks.reference_cases import CASES, PROBLEMS
from benchmarks.reference_cases.record import Check, near, order, small, worst
from taisoft.errors import SimulationError

OWN_KERNELS = (  # beginnings of the names of cases that take most of their time to compile, or a minute to run
    *("attached_parts-", "bar_impact-", "column_self_weight-", "cook_membrane_3d-", "hanging_beam_E1e6-", "incline_stick_slip-"),
    *("layered_beam-", "rigid_motion-", "contact_patch-"),  # of which `test_pressures` runs the last
    *("locking-", "mid_traction_beam-", "newton_impact-", "patch_test-", "rigid_mat", "rigid_stack", "rigid_top-"),
    *("stack_rest-", "hertz_ball-", "slide_to_stop-"),
    *("soft_sheet_self_weight-", "soft_soft_momentum-", "spin_block-SNH-4x3x2_implicit_midpoint", "tendon-", "thick_sphere-"),
    *("spring_mass-SNH-implicit_midpoint", "twist_bar_90deg-", "two_material_bar-", "oscillator_amplification-SVK-one_tet_bdf2"),
    *("beam_fall_semidiscrete-COR", "beam_fall_semidiscrete-SNH-11x2x2_bdf2", "beam_fall_semidiscrete-SNH-11x2x2_exact"),
)
COARSE = [
    pytest.param(case, id=case.name, marks=[pytest.mark.long] if case.name.startswith(OWN_KERNELS) else [])
    for case in CASES
    if not case.fine
]


@pytest.mark.gpu_path("rigid_slope-slides")
@pytest.mark.parametrize("case", COARSE)
def test_reference(case, shared):
    path = shared / "references" / f"{case.problem}.json"
    if not case.closed_form and not path.is_file():
        pytest.skip(f"{path.name} is absent")
    checks = list(case.compute({} if case.closed_form else json.loads(path.read_text(encoding="utf-8")), "cpu"))
    assert any(check.limit is not None for check in checks)
    assert not [check for check in checks if not check.passed]


def test_problems_have_coarse_cases_but_long_ones():
    coarse = {case.problem for case in CASES if not case.fine}
    assert set(PROBLEMS) - coarse == {"beam_fall_converged", "pressure_varies", "ironing", "cattaneo_mindlin"}
    assert len({case.name for case in CASES}) == len(CASES)


def test_checks_fail_for_wrong_values_and_nan():
    assert near("a", 1.001, 1.0, 0.01).passed and not near("a", 1.02, 1.0, 0.01).passed
    assert near("a", 5.0, 0.0, 0.1, scale=100.0).passed
    assert not small("a", -2.0, 1.0).passed and not small("a", math.nan, 1.0).passed
    assert not near("a", math.nan, 1.0).passed and near("a", 3.0, 1.0).passed
    assert order("a", 4.1, 1.0, 2, 0.1).passed and not order("a", 2.0, 1.0, 2, 0.1).passed
    assert not order("a", 0.0, 0.0, 2, 0.1).passed


def test_worst_finds_the_largest_error_and_nan():
    checks = [Check("a", 1, 1, 0.1, 1.0), Check("b", 2, 1, 0.7, 1.0)]
    assert worst(checks, "what").error == 0.7 and "b" in worst(checks, "what").quantity
    assert not worst([*checks, Check("c", 0, 1, math.nan, 1.0)], "what").passed


@pytest.fixture
def tables(shared, tmp_path, monkeypatch):
    """A folder with a copy of the law table, used by the benchmark as its references."""
    text = (shared / "references" / "stress_table.json").read_text(encoding="utf-8")
    monkeypatch.setattr(references, "REFERENCES", tmp_path)
    (tmp_path / "stress_table.json").write_text(text, encoding="utf-8")
    return tmp_path


def test_the_benchmark_writes_its_results_and_fails_for_a_wrong_value(tables, capsys):
    out = tables / "rows.json"
    assert references.main(["--only", "stress_table", "--out", str(out)]) == 0
    rows = json.loads(out.read_text(encoding="utf-8"))["rows"]
    assert len(rows) == 6 and {row["law"] for row in rows} == {"SNH", "COR", "SVK"}
    assert all(row["verdict"] == "pass" and row["error"] <= row["limit"] for row in rows)
    page = out.with_suffix(".md").read_text(encoding="utf-8")
    assert page in capsys.readouterr().out and page.count("| stress_table |") == 6 and "6 checks passed, 0 failed" in page
    path = tables / "stress_table.json"
    table = json.loads(path.read_text(encoding="utf-8"))
    table["value"][2]["SVK"]["P"][0][0] *= 1 + 1e-8
    path.write_text(json.dumps(table), encoding="utf-8")
    assert references.main(["--only", "stress_table"]) == 1
    failed = [line for line in capsys.readouterr().out.splitlines() if " FAIL " in line]
    assert len(failed) == 1 and "SVK" in failed[0] and "P11" in failed[0]


def test_the_benchmark_names_missing_references(tmp_path, capsys, monkeypatch):
    (tmp_path / "stress_table.json").write_text("{}", encoding="utf-8")
    for folder, name in ((tmp_path, "uniaxial_stress"), (tmp_path / "nowhere", "nowhere")):
        monkeypatch.setattr(references, "REFERENCES", folder)
        assert references.main([]) == 2
        printed = capsys.readouterr()
        assert printed.out == "" and printed.err.count("\n") == 1 and "absent" in printed.err
        assert name in printed.err and "stress_table" not in printed.err


def test_a_case_that_cannot_be_computed_is_a_failed_row():
    def broken(reference, arch):
        raise SimulationError("no solution")
        yield

    rows = references.run(replace(CASES[0], compute=broken), {}, "cpu")
    assert [row["verdict"] for row in rows] == ["FAIL"] and "no solution" in rows[0]["quantity"]
