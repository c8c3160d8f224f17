"""The benchmark of element orders, on made-up numbers:

* the time to an error is exact for a power law, and a bound if all meshes lie on one side of it;
* ratios are per round, with the default quadrature; errors below the uncertainty of the reference do not count;
* references agree with the reference problems.
"""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.order import Reach, compare, find_limits, time_to
from benchmarks.order_cases import CASES, HANGING, HEAVY, LINEAR, QUADRATIC, QUADRATIC_14, STRIP, Reference
from benchmarks.order_runs import Row, own_reference, set_error
from benchmarks.reference_cases.record import GRAVITY

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


def test_times_to_an_error():
    """Exact for a power law, never extrapolated; all later errors must be below, too: an error may change its sign."""
    seconds = np.array([0.1, 0.7, 2.0, 30.0])
    reach = time_to(0.02 * seconds**-0.75, seconds, goal=0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(2.0 ** (4 / 3))
    assert time_to([0.5, 0.02], [1.0, 9.0], 0.01) == Reach(9.0, ">") and time_to([], [], 0.01) is None
    assert time_to([0.01, 0.002], [1.0, 9.0], 0.01) == Reach(1.0, "<=")
    reach = time_to([0.5, 0.001, 0.04, 0.0025], [1.0, 2.0, 3.0, 6.0], 0.01)
    assert reach.bound == "=" and reach.seconds == pytest.approx(3.0 * 2 ** (math.log(4) / math.log(16)))


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
    assert found.bound == "=" and found.ratio.repeats == 3
    assert (found.ratio.median, found.ratio.spread) == (pytest.approx(40), pytest.approx(0))
    assert [found.reach[order].seconds for order in (1, 2)] == pytest.approx([8.0, 0.2])


def test_errors_below_the_uncertainty_do_not_count():
    rows = [row(error=0.04), row(error=1e-6, rounds=(4.0,)), row(QUADRATIC, error=0.001)]
    exact, known, unknown = (compare(BEAM, rows, replace(REFERENCE, uncertainty=u)) for u in (0.0, 0.0025, 0.01))
    assert exact.reach[1].seconds < known.reach[1].seconds == pytest.approx(2.0)
    assert known.bound == ">"  # order 2 takes at most the time of its only mesh
    assert unknown.reach == {1: None, 2: None} and unknown.texts() == ("-", "-", "-", "")


def test_limits_are_met_or_not():
    def limits(seconds, elastica):
        rows = [row(error=0.04, rounds=(seconds,)), row(error=0.0025, rounds=(4 * seconds,))]
        rows += [row(QUADRATIC, error=0.04), row(QUADRATIC, error=0.0025, rounds=(4.0,))]
        slender = replace(row(QUADRATIC, error=elastica), case="elastica_shear")
        return find_limits([compare(BEAM, rows, REFERENCE)], [*rows, replace(slender, error=0.1), slender])

    assert [(x.value, x.met) for x in limits(30.0, 0.004)] == [(pytest.approx(30), True), (pytest.approx(0.4), True)]
    assert [(x.value, x.met) for x in limits(10.0, 0.006)] == [(pytest.approx(10), False), (pytest.approx(0.6), False)]
    missing = [replace(row(QUADRATIC, error=None), case="elastica_shear")]
    assert all(math.isnan(x.value) and not x.met for x in find_limits([compare(BEAM, [row()], REFERENCE)], missing))


def test_own_references_and_errors():
    """The limit of a geometric sequence; the largest error counts."""
    values = [-2.0 + 0.3 * 0.25**k for k in range(4)]
    rows = [row(QUADRATIC, measured=[x]) for x in values] + [row(measured=[7.0]), row(QUADRATIC_14, measured=[8.0])]
    limit = own_reference(replace(BEAM, extrapolated=True), rows)
    assert limit.values == pytest.approx((-2.0,), rel=1e-12) and limit.uncertainty == pytest.approx(0.3 * 0.25**3 / 2)
    assert own_reference(replace(BEAM, extrapolated=False), rows).values == ()
    assert own_reference(replace(BEAM, extrapolated=True), rows[:2]).values == ()
    found = row(measured=[-1.9, 4.4, 99.0], error=None)
    set_error(found, Reference((-2.0, 4.0), 0.0, ""))
    assert found.error == pytest.approx(0.1)


def test_references_agree_with_the_problems(shared):
    cases, folder = {c.name: c for c in CASES}, shared / "references"
    for name, (file, value_keys, uncertainty_keys) in FILES.items():
        problem, reference = json.loads((folder / f"{file}.json").read_text(encoding="utf-8")), cases[name].reference
        value, uncertainty, numbers = problem["value"], problem["uncertainty"], problem["material"]
        for key in value_keys:
            value = value[key]
        for key in uncertainty_keys:
            uncertainty = uncertainty[key]
        assert reference.values == (value,) and uncertainty / abs(value) == pytest.approx(reference.uncertainty, rel=0.05)
        material = cases[name].material
        assert (material["young"], material["poisson"]) == (numbers["E"], numbers["nu"])
        assert not cases[name].gravity or material["density"] == numbers["rho"]
    shear, weight = (json.loads((folder / f"elastica_{kind}.json").read_text())["value"] for kind in ("end_shear", "self_weight"))
    shortening, rise = shear["elastica"]
    assert cases["elastica_shear"].reference.values == (-shortening, rise)
    drop, retraction = weight["8.0"]
    assert cases["elastica_weight"].reference.values == pytest.approx((-10 * retraction, -10 * drop), rel=1e-12)
    length, height, width = STRIP
    weight_per_length, stiffness = HEAVY * GRAVITY * height * width, 1.2e6 * width * height**3 / 12
    assert weight_per_length * length**3 / stiffness == pytest.approx(8.0)
