"""The benchmark of orders, on tiny meshes and on numbers made up; no test here asks how fast anything is:

* the time to an error is exact for a power law, and a bound where all meshes lie on one side of it;
* ratios are taken round by round, from the default quadrature, and no error counts below what the reference is good to;
* the references are those of the reference problems, and every scene can be built with every element;
* a real equilibrium is the tabulated one of its mesh, and a mesh without one is a row that says so;
* the whole prints, writes and draws what it found, and its exit status tells a limit that is not met.
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
FILES = {  # case -> file of the reference problem, and where in it stand the value and its uncertainty
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
    """A row with an error and times."""
    found = {"tets": 10, "nodes": 12, "measured": [-1.9], "error": error, "rounds": list(rounds)} | more
    return Row(HANGING, "SNH", element.order, element.degree, element.points, cells, **found)


# --- time to an error -------------------------------------------------------------------------------------------------


def test_time_to_an_error_is_exact_for_a_power_law():
    seconds = np.array([0.1, 0.7, 2.0, 30.0])
    errors = 0.02 * seconds**-0.75
    reach = time_to(errors, seconds, goal=0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(2.0 ** (4 / 3))
    assert str(Reach(0.1234, "=")) == "0.123 s" and str(Reach(2.0, ">")) == "> 2 s"


def test_nothing_is_extrapolated():
    assert time_to([0.5, 0.02], [1.0, 9.0], 0.01) == Reach(9.0, ">")
    assert time_to([0.01, 0.002], [1.0, 9.0], 0.01) == Reach(1.0, "<=")
    assert time_to([], [], 0.01) is None


def test_an_error_must_stay_below():
    """One that changes its sign passes through 0 on its way to a worse mesh."""
    reach = time_to([0.5, 0.001, 0.04, 0.0025], [1.0, 2.0, 3.0, 6.0], 0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(3.0 * 2 ** (math.log(4) / math.log(16)))


# --- ratios -----------------------------------------------------------------------------------------------------------


def test_ratios_are_taken_round_by_round_from_the_default_quadrature():
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


def test_no_error_counts_below_what_the_reference_is_good_to():
    rows = [row(error=0.04), row(error=1e-6, rounds=(4.0,)), row(QUADRATIC, error=0.001)]
    exact = compare(BEAM, rows, replace(REFERENCE, uncertainty=0.0))
    good = compare(BEAM, rows, replace(REFERENCE, uncertainty=0.0025))
    assert exact.reach[1].seconds < good.reach[1].seconds == pytest.approx(2.0)
    assert good.bound == ">"  # order 2 takes at most the time of its only mesh
    blind = compare(BEAM, rows, replace(REFERENCE, uncertainty=0.01))
    assert blind.reach == {1: None, 2: None} and blind.texts() == ("-", "-", "-", "")


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
def test_what_is_known_of_a_ratio(slow, fast, bound):
    rows = [row(e, error=x, rounds=(k + 1.0,)) for e, errors in ((LINEAR, slow), (QUADRATIC, fast)) for k, x in enumerate(errors)]
    found = compare(BEAM, rows, REFERENCE)
    assert found.bound == bound and (found.ratio is None) == (bound == "?")


def test_limits():
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
    below_is_no_proof = [row(error=0.001, rounds=(90.0,)), row(QUADRATIC, error=0.04), row(QUADRATIC, error=0.0025)]
    assert not find_limits([compare(BEAM, below_is_no_proof, REFERENCE)], below_is_no_proof)[0].met


def test_rows_tell_what_they_hold():
    lost = row(QUADRATIC, error=None, measured=[], rounds=(), failure="lost")
    table = row_table([row(error=5e-4, rounds=(1.0, 3.0, 2.0), linear=1234), lost], REFERENCE).splitlines()
    first, second = ([cell.strip() for cell in line.split("|")[1:-1]] for line in table[2:4])
    assert first[:5] == ["SNH", "1", "1", "2x1x1", "10"] and first[7:13] == ["< 0.1", "0", "1,234", "2", "50.0%", "3"]
    assert second[1:3] == ["2", "4"] and second[6:8] == ["-", "-"] and table[-1] == "* order 2, 2x1x1: lost"


# --- references -------------------------------------------------------------------------------------------------------


def test_own_reference_is_the_limit_of_a_geometric_sequence_or_nothing():
    values = [-2.0 + 0.3 * 0.25**k for k in range(4)]
    rows = [row(QUADRATIC, measured=[x]) for x in values] + [row(measured=[7.0]), row(QUADRATIC_14, measured=[8.0])]
    limit = own_reference(replace(BEAM, extrapolated=True), rows)
    assert limit.values == pytest.approx((-2.0,), rel=1e-12) and "extrapolated" in limit.source
    assert limit.uncertainty == pytest.approx(0.3 * 0.25**3 / 2)
    assert own_reference(replace(BEAM, extrapolated=False), rows).values == ()
    assert own_reference(replace(BEAM, extrapolated=True), rows[:2]).values == ()


def test_errors_are_the_largest_of_the_numbers_that_have_a_reference():
    found = row(measured=[-1.9, 4.4, 99.0], error=None)
    set_error(found, Reference((-2.0, 4.0), 0.0, ""))
    assert found.error == pytest.approx(0.1)
    set_error(found, Reference((), 0.0, "none"))
    assert found.error == pytest.approx(0.1)


@pytest.mark.parametrize("name", FILES)
def test_references_are_those_of_the_problems(name, shared):
    (case,) = (c for c in CASES if c.name == name)
    file, where, uncertain = FILES[name]
    path = shared / "references" / f"{file}.json"
    if not path.is_file():
        pytest.skip(f"{path.name} is absent")
    problem = json.loads(path.read_text(encoding="utf-8"))
    value, uncertainty = problem["value"], problem["uncertainty"]
    for key in where:
        value = value[key]
    for key in uncertain:
        uncertainty = uncertainty[key]
    assert case.reference.values == (value,)
    assert uncertainty / abs(value) == pytest.approx(case.reference.uncertainty, rel=0.05)
    numbers = problem["material"]
    assert (case.material["young"], case.material["poisson"]) == (numbers["E"], numbers["nu"])
    if case.gravity:
        assert case.material["density"] == numbers["rho"]


def test_references_of_the_elastica(shared):
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
            if element.order == 2:  # the middles of the edges in the clamped face are held too
                assert (body.constraints[0].nodes >= body.mesh.n_verts).any()
            assert sorted(chain, key=math.prod) == list(chain)
    assert set(case.meshes) >= {LINEAR, QUADRATIC}


# --- runs -------------------------------------------------------------------------------------------------------------


def test_an_equilibrium_is_the_tabulated_one_of_its_mesh(capsys):
    """Order 1 on the coarsest mesh of the reference problem, where another program gives -2.26757962869 m."""
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


class Fake:
    """In place of a solve: errors that fall with the square of the cells across, or no equilibrium at all."""

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


made: list[Fake] = []


@pytest.fixture
def faked(monkeypatch):
    """The benchmark without a solver."""
    made.clear()
    monkeypatch.setattr(order_runs, "Statics", Fake)
    monkeypatch.setattr(order_runs, "Fall", Fake)
    monkeypatch.setattr(order, "open_runtime", lambda *a: Nothing())
    return made


class Nothing:
    """A runtime that starts nothing."""

    arch = "cpu"

    def close(self):
        pass


def test_a_mesh_without_an_equilibrium_is_a_row_that_says_so(faked, capsys):
    rows, _ = measure_case(BEAM, {QUADRATIC: ((6, 1, 1), (16, 3, 3))}, 2, Nothing())
    good, lost = rows
    assert good.error == pytest.approx(0.02) and len(good.rounds) == 2 and not good.failure
    assert lost.failure == "no equilibrium beyond 90% of the load" and lost.error is None and not lost.rounds and lost.tets == 720
    assert all(run.closed for run in faked) and len(faked) == 2


def test_the_whole_writes_and_draws_what_it_prints(faked, tmp_path, capsys, monkeypatch):
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
    told = {(c["case"], c["goal"]): c for c in numbers["comparisons"]}
    assert len(told) == 6 and [told[name, 0.01]["bound"] for name in ("hanging_beam", "beam_fall")] == ["=", ">"]
    assert told["hanging_beam", 0.1]["reach"]["1"]["bound"] == "<=" and told["hanging_beam", 0.03]["bound"] == ">"
    assert numbers["rows"][0]["seconds"]["repeats"] == order.ROUNDS
    assert numbers["precision"] == "f64" and numbers["references"]["beam_fall"]["values"] == [-3.774]
    kept = (tmp_path / "new" / "order.md").read_text()
    assert kept.strip() in shown and "* order 2, 3x3x3: no equilibrium beyond 90% of the load" in kept
    for part in ("## hanging_beam: hanging beam, SNH", "## Time to 1% error", "## Limits", "uncertainty 0.04%"):
        assert part in kept
    assert plot.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and len(plot.read_bytes()) > 10_000


def test_a_limit_that_is_not_met_is_the_exit_status(faked, monkeypatch, capsys):
    """Around times that give a ratio of 1, which is not the wanted one."""
    monkeypatch.setattr(order_runs, "repeated", lambda *arguments, **named: [1.0])
    same = {LINEAR: ((2, 2, 2), (8, 8, 8)), QUADRATIC: ((1, 1, 1), (2, 2, 2))}
    monkeypatch.setattr(order, "CASES", [replace(BEAM, meshes=same)])
    assert order.main([]) == 1
    assert "NOT met" in capsys.readouterr().out
    assert order.main(["--quick"]) == 0  # tells no limit
    assert "## Limits" not in capsys.readouterr().out


def test_a_quick_run_and_a_named_case(faked, capsys):
    assert order.main(["--quick"]) == 0
    assert [(run.case.name, run.scene.bodies[0].order) for run in faked] == [(HANGING, k) for k in (1, 1, 2, 2)]
    faked.clear()
    assert order.main(["--quick", "--case", "cook"]) == 0
    assert {run.case.name for run in faked} == {"cook"} and "## cook: Cook's panel, SNH" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        order.main(["--case", "nothing"])


def test_without_matplotlib_a_sentence_says_so_before_anything_is_measured(monkeypatch, tmp_path):
    monkeypatch.setattr(order, "measure", lambda *a: pytest.fail("it measured"))
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(OutputError, match=r"needs the package matplotlib, which is missing: pip install 'taisoft\[plot\]'"):
        order.main(["--plot", str(tmp_path / "a.png")])


@pytest.mark.parametrize("option, name, why", [("--out", "a.txt", "end in .json"), ("--plot", "a.svg", "end in .png")])
def test_files_that_cannot_be_written_are_refused_first(option, name, why, monkeypatch, tmp_path):
    monkeypatch.setattr(order, "measure", lambda *a: pytest.fail("it measured"))
    with pytest.raises(OutputError, match=why):
        order.main([option, str(tmp_path / name)])
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="a file has that name"):
        order.main([option, str(tmp_path / "file" / f"a{why[-5:].strip()}")])
