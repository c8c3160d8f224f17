"""What benchmarks make of their numbers, on made-up rows:

* ratios and limits of collision, elasticity, error, tolerance, startup and window follow the rows;
* contact: verdicts on rigid scenes follow from residuals and costs; beside another version what converges in both counts;
* scaling: exponents are those of power laws, the least bytes agree with a count by hand.
"""

import math
from dataclasses import replace

import pytest

import taisoft as ts
from benchmarks import collision, contact_problems, contact_versions, error, scaling, startup, tolerance
from benchmarks import window as window_benchmark
from benchmarks.collision_cases import LARGE_PILE, SHEET, pile_setup
from benchmarks.collision_runs import GEOMETRIES, PHASES, Film
from benchmarks.collision_runs import Row as SearchRow
from benchmarks.contact_problems import PLAIN
from benchmarks.contact_problems import Row as ProblemRow
from benchmarks.document import Limit
from benchmarks.elasticity_steps import Cost, Frames, cost_limits, cost_table, frame_limits, frame_table
from benchmarks.error_cases import CONTACT, SMOOTH
from benchmarks.scaling_bytes import GROUPS, Copy, copy_rate, floor_bytes, group_bytes
from benchmarks.scaling_runs import Row as Work
from benchmarks.scaling_runs import beam
from tests.benchmarks import stand_ins


def met(limits: list[Limit]) -> list[bool]:
    return [limit.met for limit in limits]


def cells_of(table: str, line: int = 2) -> list[str]:
    """The cells of a line of a table."""
    return [cell.strip() for cell in table.splitlines()[line].split("|")[1:-1]]


def test_limits_of_collision():
    def made(setup: str, geometry: str, ms: float) -> SearchRow:
        phases = {name: [ms / 4000] * 3 for name in PHASES}
        return SearchRow(setup, geometry, 100, 50, 40, 30, 20, 10, phases, [ms / 1000] * 3, [ms / 500] * 3, True, 2.0, 1.0, 1000)

    rows = [made(pile_setup(n).name, geometry, ms) for n, ms in ((6, 7.9), (LARGE_PILE, 81.0)) for geometry in GEOMETRIES]
    rows += [made(SHEET.name, "proximity", 2.3), made(SHEET.name, "distance_field", 2.5)]
    film = Film("cubes 5", "proximity", 1250)
    assert met(collision.find_limits(rows, [film])) == [True, True, False, False, True, False, True]
    film.same = False
    assert not met(collision.find_limits(rows, [film]))[-1] and not any(met(collision.find_limits([], [film])))


def test_costs_are_compared_sample_by_sample():
    samples = {"SNH": [6e-6, 12e-6, 6e-6], "SVK": [5e-6, 10e-6, 5e-6], "COR": [24e-6, 48e-6, 24e-6]}
    found = [Cost(540, law, "velocity_verlet", "f32", 0.5, values) for law, values in samples.items()]
    limits = {limit.what: limit for limit in cost_limits(found)}
    assert limits["SNH step, velocity_verlet, 540 tets [us/step]"].value == pytest.approx(6)
    svk, cor = (limits[f"{law} / SNH, velocity_verlet, 540 tets"] for law in ("SVK", "COR"))
    assert (svk.value, cor.value) == pytest.approx((5 / 6, 4)) and svk.met and not cor.met
    assert cor.spread == pytest.approx(0)  # the slow sample is slow for all laws
    assert [cells_of(cost_table(found), -1)[k] for k in (3, 4, 8)] == ["COR", "24.00", "4.00"]
    large = [Cost(34_560, "SNH", "velocity_verlet", precision, 0.5, [345.6e-6]) for precision in ("f32", "f64")]
    (limit,) = cost_limits(large)  # in single precision only
    assert (limit.value, limit.limit) == pytest.approx((10, 11)) and "ns/tet" in limit.what
    rows = [Frames(540, "velocity_verlet", 84, [11e-6, 22e-6, 5.5e-6], [10e-6, 20e-6, 5e-6])]
    assert cells_of(frame_table(rows)) == ["540", "velocity_verlet", "84", "10.00", "11.00", "1.100", "0.0%", "84"]
    (limit,) = frame_limits([*rows, Frames(540, "implicit_euler", 1, [2e-3], [1e-3])])
    assert limit.value == pytest.approx(1.1) and limit.spread == pytest.approx(0) and not limit.met


def test_limits_of_error():
    def row(kind=SMOOTH, time: float | None = 1e-3, **more) -> error.Row:
        numbers = {"name": "made up", "integrator": "bdf2", "tets": 5, "steps": 9, "status": "ok", "order": 1.5, "twins": 2.0}
        numbers |= {"kind": kind, "estimated": {"time": time, "space": 0.1, "solver": 0.0}}
        return error.Row(true={"time": 1e-3, "space": 0.1, "solver": 0.0}, **numbers | more)

    assert row(time=2e-3).ratio("time") == 2.0 and math.isnan(row().ratio("solver")) and math.isnan(row(time=None).ratio("time"))
    assert met(error.find_limits([row(), row(CONTACT)])) == [True] * 4
    assert met(error.find_limits([row(time=3e-3), row(CONTACT, time=3e-3)])) == [False, True, True, True]
    assert met(error.find_limits([row(time=1e-4), row(CONTACT)])) == [False, True, True, False]
    assert met(error.find_limits([row(time=None), row(CONTACT)])) == [False, True, True, True]


def test_limits_of_tolerance():
    def row(tol=0.01, true=1e-3, best: float | None = 1.0, **more) -> tolerance.Row:
        fixed = None if best is None else tolerance.Fixed("bdf2", 4, true, best)
        numbers = {"name": "made up", "integrator": "bdf2", "steps": 4, "status": "ok", "estimated": 1e-3, "own": 1e-5}
        numbers |= {"seconds": 1.2, "pilots": 0.2, "observed": 1.5}
        return tolerance.Row(tolerance=tol, true=true, best=fixed, **numbers | more)

    assert row().met and row().ratio == 1.2 and math.isnan(row(best=None).ratio)
    assert met(tolerance.find_limits([row(), row(0.1)])) == [True] * 4
    assert met(tolerance.find_limits([row(), row(0.1, true=0.2)])) == [False, True, True, True]
    assert met(tolerance.find_limits([row(best=0.5), row(), row()])) == [True, True, False]
    assert met(tolerance.find_limits([row(seconds=1.4)])) == [True, False, True]


def test_limits_of_startup_and_windows():
    now, old = stand_ins.startup_numbers(0.5, 0), stand_ins.startup_numbers(10.0, 3)
    assert all(met(startup.find_limits(now, old))) and len(startup.find_limits(now, old)) == 25
    assert not all(met(startup.find_limits(stand_ins.startup_numbers(0.5, 1), None)))
    assert startup.ratio([1.0, 9.0, 4.0], [2.0, 3.0, 4.0]) == 1.0  # the median of the ratios of each round
    rows = ({"intervals": [0.06]}, {"latencies": [0.12]}, {"latencies": [0.12], "speed": 0.4}, {"latencies": []})
    assert met(window_benchmark.limits_of([stand_ins.WINDOW])) == [True, True]
    found = [met(window_benchmark.limits_of([stand_ins.WINDOW | row])) for row in rows]
    assert found == [[False, True], [True, False], [True], [True, False]]


def work(kind="implicit", tets=1000, seconds=1.0, **more) -> Work:
    found = {"samples": [seconds] * 3, "phases": {"a": 0.75 * seconds, "b": 0.25 * seconds}, "counts": {"newton": 2.5}}
    found |= {"moved": 8.0 * tets, "field_bytes": {"matrix": 100 * tets}, "setup_seconds": 1e-6 * tets, "base": 10, "peak": 50}
    return Work(kind, "cpu", tets, 300, **found | more)


def test_exponents_of_scaling():
    rows = [work(tets=n, seconds=1e-9 * n**1.25) for n in (1000, 4000, 64_000)]
    found = scaling.growths([*rows, work("search"), work("search", samples=[], failure="no")])
    assert [g.kind for g in found] == ["implicit", "search"] and found[0].meshes == 3 and math.isnan(found[1].step)
    assert (found[0].step, found[0].step_at_last, found[0].setup, found[0].memory) == pytest.approx((1.25, 1.25, 1, 1))
    (bent,) = scaling.growths([work(tets=n, seconds=s) for n, s in ((1000, 1.0), (2000, 2.0), (4000, 8.0))])
    assert bent.step_at_last == pytest.approx(2) and 1 < bent.step < 2
    table = scaling.time_table([work(), work("search", tets=5, samples=[], failure="no luck")])
    assert cells_of(table)[:7] == ["implicit", "1,000", "1", "1000", "0.0%", "1e+06", "2.5 newton"]
    assert table.splitlines()[-1] == "* search, 5 tets: no luck"
    made_up = [Copy("a", 1, 5.0), Copy("b", 1, 7.0), Copy("a", 4, 20.0)]
    assert copy_rate(made_up, 1) == 7.0 and copy_rate(made_up, 4) == 20.0 and copy_rate(made_up[:2], 4) == 7.0


def test_bytes_of_an_explicit_step_agree_with_a_count_by_hand():
    with ts.Simulator(beam(20), dt=1e-4, integrator="velocity_verlet") as sim:  # 4 x 1 x 1 cells
        n, t, sizes = sim.scene.bodies[0].n_nodes, 20, sim.field_bytes
        elements = 24 * n + t * (16 + 36 + 4 + 1) + 48 * t  # x; nodes, Dm_inv, volume, one body per four tets; element_force
        assert floor_bytes(["elements"], sizes) == elements
        drift, nodes = n * (24 + 12 + 12 + 24 + 12), 48 * t + 4 * (n + 1) + 16 * t + n * (4 + 12 + 12 + 12 + 12)
        assert floor_bytes(["drift", "elements", "nodes"], sizes) == drift + elements + nodes
        assert group_bytes(sim) == dict.fromkeys(GROUPS, 0) | {GROUPS[0]: sum(sizes.values())}


PLAIN_ROW = ProblemRow("Rover1039", 4, PLAIN, (2.8e-2, 5.9e-4, 1e-10), 430, 0.5, 0.4)
ROWS = [PLAIN_ROW, replace(PLAIN_ROW, solver="jacobi", iterations=None)]
ROWS.append(replace(PLAIN_ROW, solver="hybrid", time=0.3, operations=0.2))


def test_verdicts_follow_from_residuals_and_costs(monkeypatch, tmp_path):
    def verdicts(rows):
        return [row.verdict for row in contact_problems.with_verdicts(rows)]

    assert verdicts(ROWS) == ["yardstick: pass", "", "best: pass"]
    slow = [replace(row, residuals=(1.0, 1.0, 1.0), time=5.0 + row.time) for row in ROWS]
    assert verdicts(slow) == ["yardstick: FAIL", "", "best: FAIL"]
    unconverged = [replace(row, iterations=None) for row in ROWS]
    assert all("FAIL" in one for one in verdicts(unconverged)) and unconverged[0].cells[6] == "-"
    lines = contact_problems.summary(ROWS).splitlines()
    assert lines[1].startswith("* jacobi:") and "0 of 1" in lines[1]
    assert "1 of 1" in lines[2] and "operations 0.20, time 0.30" in lines[2]
    monkeypatch.setattr(contact_problems, "PROBLEMS", tmp_path)
    assert "contact problems are absent" in contact_problems.missing() and "Rover4396" in contact_problems.missing()


def test_limits_beside_another_version():
    """Only steps that converge in every version count."""
    one = {"newton": [3, 3], "unconverged": 0, "contacts": [0, 4]}
    this, older = ({name: one | {"seconds": [s] * 2} for name in ("bunny", "cloth")} for s in (1.0, 4.0))
    met = {limit.what: limit.met for limit in contact_versions.drop_limits({"this": this, "older": older})}
    assert met["bunny: time of the older version over this one's"] and not met["cloth: time of the older version over this one's"]
    assert len(met) == 6 and sum(met.values()) == 4
    runs = {"this": [{"converged": [True] * 3, "newton": [2, 3, 4], "seconds": [1.0] * 3}]}
    runs["older"] = [{"converged": [True, False, True], "newton": [1, 1, 1], "seconds": [1.0] * 3}]
    assert contact_versions.total(runs, "this", "newton") == [6]
    limits = {limit.what: limit for limit in contact_versions.free_limits({"static beams": runs})}
    ratio = limits["static beams: Newton iterations over the older version's"]
    assert ratio.value == 3.0 and not ratio.met and limits["static beams: time over the older version's"].value == 1.0
    (inverted,) = contact_versions.free_limits({"inverted beam, BDF2": {"this": runs["this"]}})
    assert inverted.value == 3.0
