"""Quantities of a run and their errors: exact for power laws, within a factor of 3 of oscillations and of a bar's tip; what texts
mean, and what is refused; a quantity without a value, or with none in a companion, is unknown with a reason.
"""

import json
from dataclasses import replace

import numpy as np
import pytest

import taisoft as ts
from benchmarks.error_quantities import FORCES, estimated
from taisoft.errors import SceneError
from taisoft.estimation.quantities import error_of_levels
from taisoft.output.report import write_report
from taisoft.running import run
from tests.dynamics.scenes import rubber
from tests.estimation.stand_in import BDF2, EULER, StandIn, block, motion

WITHIN = 3.0
FREQUENCY = 5.0


def test_errors_of_power_laws_are_exact():
    """Of the run, be it the finest, the middle or the coarsest of the levels, with the order as given or as seen."""
    for order in (0.7, 1.6):
        for sizes in ((1.0, 0.5), (1.0, 3.0), (1.0, 2.0, 4.0), (1.0, 0.5, 1.5), (1.0, 0.25, 0.5)):
            values = [7.0 + 0.3 * size**order for size in sizes]
            error, seen, reason = error_of_levels(values, sizes, order)
            assert error == pytest.approx(0.3) and not reason
            assert seen == (pytest.approx(order) if len(sizes) == 3 else None)
    assert error_of_levels([1.0, 1.1, 1.9], (1, 2, 4), 1.0, most=1.0) == pytest.approx((0.1, 1.0, ""))  # not above the highest


def test_the_order_is_that_of_all_times():
    """The last value, whose differences chance makes zero or nearly so, shows none."""
    values = np.array([[0.0, 1.0, 5.0], [0.1, 1.1, 5.1], [0.3, 1.3, 5.1]])
    error, order, _ = error_of_levels(values, (1, 2, 4), 1.0)
    assert error == pytest.approx(0.1 / (2.0**order - 1.0)) and 0.5 < order < 1.0
    values[:, 0] = np.nan  # had no value at first
    assert error_of_levels(values, (1, 2, 4), 1.0).error is not None


def test_what_levels_cannot_tell_is_unknown_with_a_reason():
    for values, range_of in (((1.0, 1.2, 1.25), None), ((1.0, 1.2, 1.1), None), ((1.0, 1.2, 0.9), 0.3), ((1.0, 1.2, 1.41), 0.41)):
        error, order, reason = error_of_levels(values, (1, 2, 4), 1.0)  # apart, or ever nearer
        assert error == pytest.approx(range_of) and order is None and "1, 1.2, " in reason
    parted_first = [[1.0, 2.0], [5.0, 2.1], [2.0, 2.3]]
    assert error_of_levels(parted_first, (1, 2, 4), 1.0) == (pytest.approx(0.1), pytest.approx(1.0), "")
    assert error_of_levels((1.0, np.nan), (1, 2), 1.0) == (None, None, "it has no value on one of the levels")
    assert error_of_levels((1.0, 1.0 + 1e-12, 1.0), (1, 2, 4), 1.0, negligible=1e-9).error < 2e-12  # rounding needs no order


def exact_place(t: float) -> float:
    """Height [m] of a node of the stand-in above its place at rest: it begins there, under a weight of 10 m/s^2."""
    return -10.0 / FREQUENCY**2 * (1.0 - np.cos(FREQUENCY * t))


@pytest.mark.parametrize("integrator, dt, order", [(EULER, 1 / 256, 1.0), (BDF2, 1 / 128, 2.0), (EULER, 1 / 16, None)])
def test_an_oscillator(integrator, dt, order):
    """Its position and its energy at the end; few steps are compared with half of them, and show no order."""
    quantities = {
        "height": lambda sim: sim.positions()[0, 1] - sim.rest[0, 1],
        "energy": lambda sim: (
            (sim.velocities()[0] ** 2).sum() / 2 + FREQUENCY**2 * (sim.positions()[0] - sim.rest[0])[1] ** 2 / 2
        ),
    }
    seconds = 1.0 if order else 0.5
    report = run(StandIn(block(), dt=dt, integrator=integrator), seconds, fps=16, error=True, quantities=quantities)
    weight = -10.0 * exact_place(seconds)  # from which the energy comes
    for name, exact in (("height", exact_place(seconds)), ("energy", weight)):
        found = report.quantities[name]
        true = abs(found.value - exact)
        assert true / WITHIN < found.time < WITHIN * true and found.solver < 1e-9 and found.space is None
        assert found.total == found.time + found.solver and not found.notes
        assert found.orders == ({"time": pytest.approx(order, abs=0.25)} if order else {})


def test_errors_of_the_mesh_and_of_the_solvers():
    """Falls are wrong by h^2 and by the tolerance."""
    kind = motion(frequency=0.0, width_error=1.0, offset=lambda sim: 0.5 * sim.settings.newton_tolerance * sim.time)
    fall = {"fall": lambda sim: sim.rest[0, 1] - sim.positions()[0, 1]}
    for mesh, expected in (("refined", 1.0 / (1 - 2.0**-1.5)), ("order", 1.0)):
        sim = kind(block(), newton_tolerance=1e-3)
        found = run(sim, 1.0, fps=16, error=True, error_mesh=mesh, quantities=fall).quantities["fall"]
        difference = 5.0 * (1.0 + 1 / 64) * 5.0 ** (-2.0 / 3.0) * 0.75
        assert found.space == pytest.approx(expected * difference) and found.solver == pytest.approx(0.5e-3)


def bar(cells) -> ts.Scene:
    """A bar of 1 m, clamped at its left end, that bends under a force at its right end until damping stops it."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    body = scene.add_body(ts.box_mesh(cells, (1.0, 0.2, 0.2), (0.5, 0.0, 0.0)), rubber(mass_damping=4.0), name="a bar")
    body.fix(lambda X: X[:, 0] < 1e-6)
    body.add_force(lambda X: X[:, 0] > 1.0 - 1e-6, (0.0, -1.0, 0.0))
    return scene


TIP = "displacement.y 'a bar' 1 0 0"


def at_rest(cells, **arguments):
    with ts.Simulator(bar(cells), dt=1 / 4, precision="f64") as sim:
        return sim.run(10.0, fps=None, quantities={"tip": TIP, "hold": "reaction.y 'a bar'"}, **arguments)


@pytest.fixture(scope="module")
def bars():
    """The run on a mesh, with its companion on another one."""
    return at_rest((6, 2, 2), error=True, error_mesh=bar((12, 4, 4))), at_rest((12, 4, 4), error=True, error_mesh=bar((6, 2, 2)))


def test_the_tip_of_a_bar_on_two_meshes(bars):
    """Errors of the mesh are those to a mesh twice as fine as both, and a little; what the load is, is exact."""
    exact = at_rest((24, 8, 8)).quantities["tip"].value
    exact += (exact - bars[1].quantities["tip"].value) / 3.0
    for report in bars:
        tip, hold = (report.quantities[name] for name in ("tip", "hold"))
        true = abs(tip.value - exact)
        assert tip.value < 0.0 and true / WITHIN < tip.space < WITHIN * true and tip.unit == "m"
        assert hold.value == pytest.approx(1.0, rel=1e-3) and hold.space < 1e-3 and hold.unit == "N"


def test_the_report_shows_them(bars, tmp_path):
    report = bars[0]
    write_report(tmp_path, report)
    tip = json.loads((tmp_path / "report.json").read_text())["quantities"]["tip"]
    own = report.quantities["tip"]
    assert tip["value"] == own.value and tip["space"] == own.space and tip["unit"] == "m" and tip["notes"] == own.notes
    line = f"tip = {own.value:.6g} m, errors: time {own.time:.2g}, space {own.space:.2g}, solver {own.solver:.2g}"
    assert line in repr(report) and line in report._repr_html_() and repr(own) == f"Quantity({line.removeprefix('tip = ')})"


@pytest.mark.parametrize("n, cells", [(0, (4, 8)), (4, (8, 4)), (9, (10, 20)), (9, (20, 10)), (11, (6, 3))])
def test_contact_forces_against_independent_references(n, cells):
    """Of a ball on a plane, smooth and rough, of a pushed block and of a ball on a block, by a finer mesh or a coarser one."""
    found = estimated(replace(FORCES[n], cells=cells))
    true = abs(found.value - FORCES[n].truth)
    assert true / WITHIN < found.space < WITHIN * true and found.solver < 1e-3 * true and not found.notes


def raises_where(test):
    return lambda sim: sim.time if not test(sim) else 1 / 0


@pytest.mark.parametrize(
    "function, reason",
    [
        (lambda sim: np.nan, "its value must be finite, not nan"),
        (lambda sim: "much", "its value must be a number, not 'much'"),
        (lambda sim: sim.positions()[0], "its value must be a number"),
        (lambda sim: {}["lost"], "KeyError: 'lost'"),
    ],
)
def test_a_quantity_without_a_value_degrades_the_run(function, reason):
    """It keeps its other quantities and its own errors."""
    given = {"bad": function, "good": lambda sim: sim.time}
    report = run(StandIn(block()), 1.0, fps=16, error=True, quantities=given)
    bad, good = report.quantities["bad"], report.quantities["good"]
    assert bad.value is bad.time is bad.total is None and reason in bad.notes[0] and "'bad'" in bad.notes[0]
    assert report.status == "degraded" and bad.notes[0] in report.problems and report.error_estimate.time is not None
    assert good.value == 1.0 and good.time == 0.0 and not good.notes and "bad = unknown" in repr(report)


def test_a_quantity_without_a_value_in_a_companion():
    twice = raises_where(lambda sim: sim.dt > 1 / 50)
    report = run(StandIn(block()), 1.0, fps=16, error=True, quantities={"q": twice})
    q = report.quantities["q"]
    note = "the error of 'q' in time is unknown: in the companion with dt = 0.03125 s, ZeroDivisionError: division by zero"
    assert q.value == 1.0 and q.time is None and q.solver == 0.0 and q.notes == [note] and report.status == "ok"
    late = run(StandIn(block()), 66 / 64, fps=64 / 6, error=True, quantities={"q": lambda sim: sim.time}).quantities["q"]
    assert late.notes == ["the errors of 'q' are those at t = 1 s, where companions meet the run"]

    def change(sim, k, _report):
        sim.changes += k == 5

    changed = run(StandIn(block()), 1.0, change, 16, error=True, quantities={"q": lambda sim: sim.time}).quantities["q"]
    assert changed.value == 1.0 and changed.time is None and "changed meanwhile" in changed.notes[0]


@pytest.fixture(scope="module")
def pushing():
    """A block on the ground that is pushed to the right, and held above."""
    scene = ts.Scene(gravity=(0.0, -10.0, 0.0))
    made = {"friction": 0.5, "restitution": 0.0}
    body = scene.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1), (0, 0.5, 0)), rubber(young=1e5, **made), name="block")
    body.fix(lambda X: X[:, 1] > 0.99, axes="xz")
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.5)
    with ts.Simulator(scene, dt=1 / 50, precision="f64") as sim:
        yield sim


def test_texts_measure_what_they_say(pushing):
    given = {
        "force": ("contact_force.y block ground", lambda sim: sim.contact_force("block", "ground")[1], "N"),
        "all": ("contact_force block", lambda sim: np.linalg.norm(sim.contact_force("block")), "N"),
        "torque": ("contact_torque.z ground block", lambda sim: sim.contact_torque("ground", "block")[2], "N m"),
        "held": ("reaction.x block", lambda sim: sim.reactions("block")[:, 0].sum(), "N"),
        "sag": ("displacement.y block 0 1 0", lambda sim: sim.positions("block")[top, 1] - 1.0, "m"),
        "corner": ("displacement block 0.5 1 0.5", lambda sim: abs(sim.positions("block")[corner, 1] - 1.0), "m"),
    }
    X = pushing.scene.body("block").rest_positions
    top, corner = (int(np.abs(X - point).sum(axis=1).argmin()) for point in ((0, 1, 0), (0.5, 1, 0.5)))
    given |= {"stress": ("stress.yy block 0 0.5 0", lambda sim: sim.stress("block")[:, 1, 1].mean(), "Pa")}
    report = pushing.run(0.1, fps=None, details=("quantities",), quantities={name: text for name, (text, _, _) in given.items()})
    for name, (_, function, unit) in given.items():
        found, loose = report.quantities[name], 0.5 if name == "stress" else 1e-9
        assert found.unit == unit and found.value == pytest.approx(function(pushing), rel=loose, abs=1e-9)
        assert found.time is found.space is found.solver is None and not found.notes
        row = report.to_dicts()[-1]
        assert row[f"quantity {name} [{unit}]"] == found.value
    assert report.quantities["force"].value > 1e3 and report.quantities["stress"].value < -1e3


def test_the_stress_at_a_point_is_that_of_a_uniform_state():
    for order in (1, 2):
        scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
        scene.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), rubber(), name="a", order=order)
        with ts.Simulator(scene, dt=1e-6, precision="f64") as sim:
            sim.set_state(positions=sim.positions("a") * (1.01, 1.0, 1.0), velocities=np.zeros_like(sim.positions("a")), body="a")
            texts = {"mises": "stress a 0.1 0.2 0.3", "xx": "stress.xx a 0.5 0.5 0.5"}
            before = sim.stress("a")[0]
            found = sim.run(1e-6, fps=None, quantities=texts).quantities
        assert found["xx"].value == pytest.approx(before[0, 0], rel=1e-3)
        assert found["mises"].value == pytest.approx(before[0, 0] - before[1, 1], rel=1e-3)


def test_the_largest_pressure_of_a_body(pushing):
    report = pushing.run(0.1, fps=None, quantities={"p": "max_pressure block"})
    assert report.quantities["p"].value == pytest.approx(pushing.contact_pressure("block").pressure.max())
    assert report.quantities["p"].value > 1e3 and report.quantities["p"].unit == "Pa"


@pytest.mark.parametrize(
    "given, message",
    [
        ({"q": 3}, "quantities must be texts or functions by name, not 3"),
        (["reaction block"], "quantities must be texts or functions by name"),
        ({"q": ""}, "quantity 'q': '' must begin with its kind"),
        ({"q": "reaction 'block"}, "must begin with its kind, and quotation marks must be closed"),
        ({"q": "reactions block"}, "its kind must be one of .* did you mean 'reaction'"),
        ({"q": "reaction.w block"}, "the component of reaction must be one of x, y, z"),
        ({"q": "reaction blok"}, "quantity 'q': scene: no body is called 'blok' .did you mean block"),
        ({"q": "reaction block ground"}, "must name reaction of one body"),
        ({"q": "contact_force block block"}, "exerts no net force on itself"),
        ({"q": "displacement block 1 2"}, "a body and three coordinates of a point"),
        ({"q": "displacement blok 0 0 0"}, "quantity 'q': scene: no body is called 'blok'"),
        ({"q": "displacement block 0 0 up"}, "'0 0 up' must be three finite numbers"),
        ({"q": "displacement block 0 0 nan"}, "'0 0 nan' must be three finite numbers"),
        ({"q": "displacement block 0 2 0"}, "the point lies outside of body 'block', by "),
    ],
)
def test_bad_quantities_are_refused_before_the_run(pushing, given, message):
    steps = pushing.step_count
    with pytest.raises(SceneError, match=message):
        pushing.run(0.1, quantities=given)
    assert pushing.step_count == steps


def test_quantities_that_nothing_gives_are_refused(pushing):
    with pytest.raises(SceneError, match="details: the run has no quantities"):
        pushing.run(0.1, details="quantities")
    scene = bar((1, 1, 1))
    scene.contact_forces = False
    scene.add_rigid_body(ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1), (3, 0.5, 0)), name="tool")
    with ts.Simulator(scene, precision="f64") as sim:
        for text, message in (
            ("contact_force 'a bar'", "quantity 'q': contact forces are not simulated here"),
            ("stress tool 3 0.5 0", "quantity 'q': body 'tool' is rigid: its stress is not modelled"),
        ):
            with pytest.raises(SceneError, match=message):
                sim.run(0.1, quantities={"q": text})
