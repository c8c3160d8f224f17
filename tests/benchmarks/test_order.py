"""The benchmark of element orders, on tiny meshes and made-up numbers. No test here checks speed:

* the time to an error is exact for a power law, and a bound if all meshes lie on one side of it;
* ratios are per round, with the default quadrature, and errors below the uncertainty of the reference do not count;
* references agree with the reference problems, and every scene can be built with every element;
* an equilibrium agrees with the tabulated one of its mesh, and a failure is shown in its row;
* the benchmark prints, writes and plots its results, and an unmet limit sets the exit status.
"""

import json
import math
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest

from benchmarks import order, order_runs
from benchmarks.order import Reach, compare, find_limits, row_table, time_to
from benchmarks.order_cases import CASES, HANGING, HEAVY, LINEAR, QUADRATIC, QUADRATIC_14, STRIP, Reference
from benchmarks.order_runs import Row, measure_case, own_reference, set_error
from benchmarks.reference_cases.record import GRAVITY
from taisoft.backend.runtime import open_runtime
from taisoft.errors import OutputError, SimulationError

BEAM = CASES[0]
REFERENCE = Reference((-2.0,), 1e-3, "made up")
FILES = {  # case -> file of the reference problem, keys of the value, keys of its uncertainty
    "hanging_beam": ("hanging_beam_E1e6", ("SNH", "uy_tip"), ("SNH", "uy")),
    "hanging_beam_cor": ("hanging_beam_E1e6", ("COR", "uy_tip"), ("COR", "uy")),
    "hanging_beam_svk": ("hanging_beam_E2e6", ("SVK", "uy_tip"), ("SVK", "uy")),
    "cook": ("cook_membrane_3d", ("SNH", "uy_mid"), ("SNH", "uy_mid")),
    "twist": ("twist_bar_90deg", ("SNH", "torque"), ("SNH", "torque")),
    "cantilever": ("cantilever_small", ("fe3d",), ()),
    "soft_sheet": ("soft_sheet_self_weight", ("SNH", "uy_centre"), ("SNH",)),
    "beam_fall": ("beam_fall_converged", ("best_estimate", "SNH", "y_min"), ("y_min",)),
}


def row(element=LINEAR, cells=(2, 1, 1), error=0.1, rounds=(1.0,), **more) -> Row:
    """A row with a made-up error and times."""
    found = {"tets": 10, "nodes": 12, "measured": [-1.9], "error": error, "rounds": list(rounds)} | more
    return Row(HANGING, "SNH", element.order, element.degree, element.points, cells, **found)


# --- time to an error -------------------------------------------------------------------------------------------------


def test_time_to_an_error_is_exact_for_a_power_law():
    seconds = np.array([0.1, 0.7, 2.0, 30.0])
    errors = 0.02 * seconds**-0.75
    reach = time_to(errors, seconds, goal=0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(2.0 ** (4 / 3))
    assert str(Reach(0.1234, "=")) == "0.123 s" and str(Reach(2.0, ">")) == "> 2 s"


def test_times_are_not_extrapolated():
    assert time_to([0.5, 0.02], [1.0, 9.0], 0.01) == Reach(9.0, ">")
    assert time_to([0.01, 0.002], [1.0, 9.0], 0.01) == Reach(1.0, "<=")
    assert time_to([], [], 0.01) is None


def test_all_later_errors_must_be_below():
    """An error that changes sign may be small on one mesh and larger on a finer one."""
    reach = time_to([0.5, 0.001, 0.04, 0.0025], [1.0, 2.0, 3.0, 6.0], 0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(3.0 * 2 ** (math.log(4) / math.log(16)))


# --- ratios -----------------------------------------------------------------------------------------------------------


def test_ratios_are_per_round_with_the_default_quadrature():
    rows = [
        row(error=0.04, rounds=(4.0, 8.0, 4.0)),
        row(error=0.0025, rounds=(16.0, 32.0, 16.0)),
        row(QUADRATIC, error=0.04, rounds=(0.1, 0.2, 0.1)),
        row(QUADRATIC, error=0.0025, rounds=(0.4, 0.8, 0.4, 0.4)),
        row(QUADRATIC_14, error=0.0025, rounds=(0.001,)),
        row(error=None, rounds=(), failure="no luck"),
    ]
    found = compare(BEAM, rows, REFERENCE)
    assert found.bound == "=" and (found.ratio.median, found.ratio.spread) == pytest.approx((40, 0))
    assert found.ratio.repeats == 3
    assert [found.reach[order].seconds for order in (1, 2)] == pytest.approx([8.0, 0.2])


def test_errors_below_the_uncertainty_do_not_count():
    rows = [row(error=0.04), row(error=1e-6, rounds=(4.0,)), row(QUADRATIC, error=0.001)]
    exact = compare(BEAM, rows, replace(REFERENCE, uncertainty=0.0))
    known = compare(BEAM, rows, replace(REFERENCE, uncertainty=0.0025))
    assert exact.reach[1].seconds < known.reach[1].seconds == pytest.approx(2.0)
    assert known.bound == ">"  # order 2 takes at most the time of its only mesh
    unknown = compare(BEAM, rows, replace(REFERENCE, uncertainty=0.01))
    assert unknown.reach == {1: None, 2: None} and unknown.texts() == ("-", "-", "-", "")


@pytest.mark.parametrize(
    "slow, fast, bound",
    [
        ((0.04, 0.0025), (0.04, 0.0025), "="),
        ((0.04, 0.02), (0.04, 0.0025), ">"),
        ((0.04, 0.02), (0.001,), ">"),
        ((0.04, 0.0025), (0.04, 0.02), "<"),
        ((0.001,), (0.04, 0.02), "<"),
        ((0.04, 0.02), (0.04, 0.02), "?"),
        ((0.001,), (0.001,), "?"),
        ((0.04, 0.0025), (), "?"),
    ],
)
def test_bounds_of_a_ratio(slow, fast, bound):
    rows = [row(e, error=x, rounds=(k + 1.0,)) for e, errors in ((LINEAR, slow), (QUADRATIC, fast)) for k, x in enumerate(errors)]
    found = compare(BEAM, rows, REFERENCE)
    assert found.bound == bound and (found.ratio is None) == (bound == "?")


def test_limits_are_met_or_not():
    def limits(seconds, elastica):
        rows = [row(error=0.04, rounds=(seconds,)), row(error=0.0025, rounds=(4 * seconds,))]
        rows += [row(QUADRATIC, error=0.04), row(QUADRATIC, error=0.0025, rounds=(4.0,))]
        slender = replace(row(QUADRATIC, error=elastica), case="elastica_shear")
        return find_limits([compare(BEAM, rows, REFERENCE)], [*rows, replace(slender, error=0.1), slender])

    assert [(x.value, x.met) for x in limits(30.0, 0.004)] == [(pytest.approx(30), True), (pytest.approx(0.4), True)]
    assert [(x.value, x.met) for x in limits(10.0, 0.006)] == [(pytest.approx(10), False), (pytest.approx(0.6), False)]
    unknown, missing = find_limits(
        [compare(BEAM, [row()], REFERENCE)], [replace(row(QUADRATIC, error=None), case="elastica_shear")]
    )
    assert math.isnan(unknown.value) and math.isnan(missing.value) and not unknown.met and not missing.met
    only_a_bound = [row(error=0.001, rounds=(90.0,)), row(QUADRATIC, error=0.04), row(QUADRATIC, error=0.0025)]
    assert not find_limits([compare(BEAM, only_a_bound, REFERENCE)], only_a_bound)[0].met


def test_table_of_rows():
    failed = row(QUADRATIC, error=None, measured=[], rounds=(), failure="lost")
    table = row_table([row(error=5e-4, rounds=(1.0, 3.0, 2.0), linear=1234), failed], REFERENCE).splitlines()
    first, second = ([cell.strip() for cell in line.split("|")[1:-1]] for line in table[2:4])
    assert first[:5] == ["SNH", "1", "1", "2x1x1", "10"] and first[7:13] == ["< 0.1", "0", "1,234", "2", "50.0%", "3"]
    assert second[1:3] == ["2", "4"] and second[6:8] == ["-", "-"] and table[-1] == "* order 2, 2x1x1: lost"


# --- references -------------------------------------------------------------------------------------------------------


def test_own_reference_is_the_limit_of_a_geometric_sequence():
    values = [-2.0 + 0.3 * 0.25**k for k in range(4)]
    rows = [row(QUADRATIC, measured=[x]) for x in values] + [row(measured=[7.0]), row(QUADRATIC_14, measured=[8.0])]
    limit = own_reference(replace(BEAM, extrapolated=True), rows)
    assert limit.values == pytest.approx((-2.0,), rel=1e-12) and "extrapolated" in limit.source
    assert limit.uncertainty == pytest.approx(0.3 * 0.25**3 / 2)
    assert own_reference(replace(BEAM, extrapolated=False), rows).values == ()
    assert own_reference(replace(BEAM, extrapolated=True), rows[:2]).values == ()


def test_the_largest_error_counts():
    found = row(measured=[-1.9, 4.4, 99.0], error=None)
    set_error(found, Reference((-2.0, 4.0), 0.0, ""))
    assert found.error == pytest.approx(0.1)
    set_error(found, Reference((), 0.0, "none"))
    assert found.error == pytest.approx(0.1)


@pytest.mark.parametrize("name", FILES)
def test_references_agree_with_the_problems(name, shared):
    (case,) = (c for c in CASES if c.name == name)
    file, value_keys, uncertainty_keys = FILES[name]
    path = shared / "references" / f"{file}.json"
    if not path.is_file():
        pytest.skip(f"{path.name} is absent")
    problem = json.loads(path.read_text(encoding="utf-8"))
    value, uncertainty = problem["value"], problem["uncertainty"]
    for key in value_keys:
        value = value[key]
    for key in uncertainty_keys:
        uncertainty = uncertainty[key]
    assert case.reference.values == (value,)
    assert uncertainty / abs(value) == pytest.approx(case.reference.uncertainty, rel=0.05)
    numbers = problem["material"]
    assert (case.material["young"], case.material["poisson"]) == (numbers["E"], numbers["nu"])
    if case.gravity:
        assert case.material["density"] == numbers["rho"]


def test_references_agree_with_the_elastica(shared):
    cases = {c.name: c for c in CASES}
    shear = json.loads((shared / "references" / "elastica_end_shear.json").read_text(encoding="utf-8"))
    shortening, rise = shear["value"]["elastica"]
    assert cases["elastica_shear"].reference.values == (-shortening, rise)
    weight = json.loads((shared / "references" / "elastica_self_weight.json").read_text(encoding="utf-8"))
    drop, retraction = weight["value"]["8.0"]
    assert cases["elastica_weight"].reference.values == pytest.approx((-10 * retraction, -10 * drop), rel=1e-12)
    length, height, width = STRIP
    weight_per_length, stiffness = HEAVY * GRAVITY * height * width, 1.2e6 * width * height**3 / 12
    assert weight_per_length * length**3 / stiffness == pytest.approx(8.0)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_scene_can_be_built_with_every_element(case):
    assert [c.name for c in CASES].count(case.name) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # order 1 and nu = 0.499
        for element, chain in case.meshes.items():
            (body,) = case.build(chain[0], element).bodies
            assert (body.order, body.quadrature_degree) == (element.order, element.degree or 1)
            ends = body.rest_positions[body.constraints[0].nodes][:, 0]
            assert ends.min() == body.rest_positions[:, 0].min()
            if element.order == 2:  # edge nodes of the clamped face are fixed, too
                assert (body.constraints[0].nodes >= body.mesh.n_verts).any()
            assert sorted(chain, key=math.prod) == list(chain)
    assert set(case.meshes) >= {LINEAR, QUADRATIC}


# --- runs -------------------------------------------------------------------------------------------------------------


def test_an_equilibrium_agrees_with_the_reference_problem(capsys):
    """Order 1 on the coarsest mesh, for which another program gives -2.26757962869 m."""
    runtime = open_runtime("cpu", "f64", "a test")
    try:
        rows, reference = measure_case(BEAM, {LINEAR: ((11, 2, 2),)}, 2, runtime)
    finally:
        runtime.close()
    (found,) = rows
    assert reference is BEAM.reference and not found.failure and (found.tets, found.nodes) == (220, 108)
    assert found.measured == pytest.approx([-2.26757962869], rel=1e-6)
    assert found.error == pytest.approx(0.163094, rel=1e-4)
    assert len(found.rounds) == 2 and found.newton > 3 and found.linear > found.newton and found.field_bytes > 1e5
    assert "hanging_beam: order 1, 1 points, 11x2x2" in capsys.readouterr().err


class FakeRun:
    """Instead of a solver: errors that decrease with the square of the cells, or no equilibrium."""

    def __init__(self, case, scene, runtime):
        self.closed = False
        self.case, self.scene = case, scene
        made.append(self)

    def first(self, row):
        across, base = row.cells[1], {1: 0.32, 2: 0.02}[row.order]
        if across == 3:
            raise SimulationError("no equilibrium beyond 90% of the load")
        row.newton, row.linear, row.field_bytes = 5, 50, 10**6
        row.measured = [x * (1 - base / across**2) for x in (self.case.reference or REFERENCE).values]

    def again(self):
        pass

    def close(self):
        self.closed = True


made: list[FakeRun] = []


@pytest.fixture
def faked(monkeypatch):
    """The benchmark without a solver."""
    made.clear()
    monkeypatch.setattr(order_runs, "Statics", FakeRun)
    monkeypatch.setattr(order_runs, "Fall", FakeRun)
    monkeypatch.setattr(order, "open_runtime", lambda *a: FakeRuntime())
    return made


class FakeRuntime:
    arch = "cpu"

    def close(self):
        pass


def test_a_failure_is_shown_in_its_row(faked, capsys):
    rows, _ = measure_case(BEAM, {QUADRATIC: ((6, 1, 1), (16, 3, 3))}, 2, FakeRuntime())
    solved, failed = rows
    assert solved.error == pytest.approx(0.02) and len(solved.rounds) == 2 and not solved.failure
    assert failed.failure == "no equilibrium beyond 90% of the load" and failed.error is None
    assert not failed.rounds and failed.tets == 720
    assert all(run.closed for run in faked) and len(faked) == 2


def test_command_writes_and_plots_what_it_prints(faked, tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    fall = next(c for c in CASES if c.dt is not None)
    statics = replace(BEAM, meshes={LINEAR: ((2, 2, 2), (8, 8, 8)), QUADRATIC: ((1, 1, 1), (2, 2, 2), (3, 3, 3))})
    motion = replace(fall, meshes={LINEAR: ((2, 2, 2), (4, 4, 4)), QUADRATIC: ((1, 1, 1), (2, 2, 2))})
    monkeypatch.setattr(order, "CASES", [statics, motion])
    out, plot = tmp_path / "new" / "order.json", tmp_path / "order.png"
    status = order.main(["--out", str(out), "--plot", str(plot)])
    numbers, shown = json.loads(out.read_text()), capsys.readouterr().out
    assert status == (0 if numbers["limits"][0]["met"] else 1)
    assert [(r["case"], r["order"], r["cells"]) for r in numbers["rows"]][:3] == [
        ("hanging_beam", 1, [2, 2, 2]),
        ("hanging_beam", 1, [8, 8, 8]),
        ("hanging_beam", 2, [1, 1, 1]),
    ]
    assert [r["error"] for r in numbers["rows"][:4]] == pytest.approx([0.08, 0.005, 0.02, 0.005])
    compared = {(c["case"], c["goal"]): c for c in numbers["comparisons"]}
    assert len(compared) == 6 and [compared[name, 0.01]["bound"] for name in ("hanging_beam", "beam_fall")] == ["=", ">"]
    assert compared["hanging_beam", 0.1]["reach"]["1"]["bound"] == "<=" and compared["hanging_beam", 0.03]["bound"] == ">"
    assert numbers["rows"][0]["seconds"]["repeats"] == order.ROUNDS
    assert numbers["precision"] == "f64" and numbers["references"]["beam_fall"]["values"] == [-3.774]
    kept = (tmp_path / "new" / "order.md").read_text()
    assert kept.strip() in shown and "* order 2, 3x3x3: no equilibrium beyond 90% of the load" in kept
    for part in ("## hanging_beam: hanging beam, SNH", "## Time to 1% error", "## Limits", "uncertainty 0.04%"):
        assert part in kept
    assert plot.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and len(plot.read_bytes()) > 10_000


def test_an_unmet_limit_sets_the_exit_status(faked, monkeypatch, capsys):
    """With equal times, hence a ratio of 1."""
    monkeypatch.setattr(order_runs, "repeated", lambda *arguments, **named: [1.0])
    same = {LINEAR: ((2, 2, 2), (8, 8, 8)), QUADRATIC: ((1, 1, 1), (2, 2, 2))}
    monkeypatch.setattr(order, "CASES", [replace(BEAM, meshes=same)])
    assert order.main([]) == 1
    assert "NOT met" in capsys.readouterr().out
    assert order.main(["--quick"]) == 0  # without limits
    assert "## Limits" not in capsys.readouterr().out


def test_quick_runs_and_named_cases(faked, capsys):
    assert order.main(["--quick"]) == 0
    assert [(run.case.name, run.scene.bodies[0].order) for run in faked] == [(HANGING, k) for k in (1, 1, 2, 2)]
    faked.clear()
    assert order.main(["--quick", "--case", "cook"]) == 0
    assert {run.case.name for run in faked} == {"cook"} and "## cook: Cook's panel, SNH" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        order.main(["--case", "nothing"])


def test_missing_matplotlib_is_reported_before_measuring(monkeypatch, tmp_path):
    monkeypatch.setattr(order, "measure", lambda *a: pytest.fail("it measured"))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(OutputError, match=r"needs the package matplotlib, which is missing: pip install 'taisoft\[plot\]'"):
        order.main(["--plot", str(tmp_path / "a.png")])
