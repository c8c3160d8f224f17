"""What benchmarks make of their numbers, on made-up rows:

* ratios and limits of elasticity and error follow the rows;
* scaling: exponents are those of power laws, the least bytes agree with a count by hand.
"""

import math

import pytest

import taisoft as ts
from benchmarks import error, error_quantities, scaling
from benchmarks.document import Limit
from benchmarks.elasticity import Cost, cost_limits, cost_table
from benchmarks.error_cases import CONTACT, SMOOTH
from benchmarks.scaling_bytes import GROUPS, Copy, copy_rate, floor_bytes, group_bytes
from benchmarks.scaling_runs import Row as Work
from benchmarks.scaling_runs import beam


def met(limits: list[Limit]) -> list[bool]:
    return [limit.met for limit in limits]


def cells_of(table: str, line: int = 2) -> list[str]:
    """The cells of a line of a table."""
    return [cell.strip() for cell in table.splitlines()[line].split("|")[1:-1]]


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
    run = Cost(4320, "SNH", "velocity_verlet", "f32", 0.5, [10e-6, 20e-6, 5e-6], [11e-6, 22e-6, 5.5e-6])
    (limit,) = cost_limits([run, Cost(4320, "SNH", "implicit_euler", "f32", 0.5, [1e-3], [2e-3])])
    assert limit.value == pytest.approx(1.1) and limit.spread == pytest.approx(0) and not limit.met


def test_limits_of_forces():
    """What is settled does not count; what is unknown is not within any range."""

    def row(time: float | None, space: float, true=math.nan) -> error_quantities.ForceRow:
        estimated = {"time": time, "space": space, "solver": 0.0}
        return error_quantities.ForceRow("", (1, 2), "", 100.0, estimated, {"time": 1e-6, "space": 10.0, "solver": true}, [])

    rows = [row(0.0, 4.0), row(2e-6, 29.0)]
    assert rows[0].ratio("space") == 0.4 and all(math.isnan(rows[0].ratio(kind)) for kind in ("time", "solver"))
    assert met(error_quantities.force_limits(rows)) == [True]
    assert met(error_quantities.force_limits([*rows, row(None, 4.0)])) == [False]
    assert met(error_quantities.force_limits([*rows, row(0.0, 3.0)])) == [False]
    assert "unknown" in error_quantities.force_table([row(None, 4.0)])


def test_limits_of_error():
    def row(kind=SMOOTH, time: float | None = 1e-3, **more) -> error.Row:
        numbers = {
            "name": "made up",
            "integrator": "bdf2",
            "tets": 5,
            "steps": 9,
            "status": "ok",
            "order": 1.5,
            "companions": 2.0,
        }
        numbers |= {"kind": kind, "estimated": {"time": time, "space": 0.1, "solver": 0.0}}
        return error.Row(true={"time": 1e-3, "space": 0.1, "solver": 0.0}, **numbers | more)

    assert row(time=2e-3).ratio("time") == 2.0 and math.isnan(row().ratio("solver")) and math.isnan(row(time=None).ratio("time"))
    assert met(error.find_limits([row(), row(CONTACT)])) == [True] * 4
    assert met(error.find_limits([row(time=3e-3), row(CONTACT, time=3e-3)])) == [False, True, True, True]
    assert met(error.find_limits([row(time=1e-4), row(CONTACT)])) == [False, True, True, False]


def work(kind="implicit", tets=1000, seconds=1.0, **more) -> Work:
    found = {"samples": [seconds] * 3, "phases": {"a": 0.75 * seconds, "b": 0.25 * seconds}, "counts": {"newton": 2.5}}
    found |= {"moved": 8.0 * tets, "field_bytes": {"matrix": 100 * tets}, "setup_seconds": 1e-6 * tets, "base": 10, "peak": 50}
    return Work(kind, "cpu", tets, 300, **found | more)


def test_exponents_of_scaling():
    rows = [work(tets=n, seconds=1e-9 * n**1.25) for n in (1000, 4000, 64_000)]
    found = scaling.growths([*rows, work("search"), work("search", samples=[], failure="no")])
    assert [g["kind"] for g in found] == ["implicit", "search"] and found[0]["meshes"] == 3 and math.isnan(found[1]["step"])
    assert [found[0][name] for name in ("step", "setup", "memory")] == pytest.approx([1.25, 1, 1])
    made_up = [Copy("a", 1, 5.0), Copy("b", 1, 7.0), Copy("a", 4, 20.0)]
    assert copy_rate(made_up, 1) == 7.0 and copy_rate(made_up, 4) == 20.0 and copy_rate(made_up[:2], 4) == 7.0


def test_bytes_of_an_explicit_step_agree_with_a_count_by_hand():
    with ts.Simulator(beam(20), dt=1e-4, integrator="velocity_verlet") as sim:  # 4 x 1 x 1 cells
        n, t, sizes = sim.scene.bodies[0].n_nodes, 20, sim.field_bytes
        elements = 24 * n + t * (16 + 36 + 4 + 1) + 48 * t  # x; nodes, Dm_inv, volume, one body per four tets; element_force
        assert floor_bytes(["elements"], sizes) == elements
        drift, nodes = n * (24 + 24 + 12 + 24 + 24), 48 * t + 4 * (n + 1) + 16 * t + n * (4 + 24 + 12 + 12 + 24)
        assert floor_bytes(["drift", "elements", "nodes"], sizes) == drift + elements + nodes
        assert group_bytes(sim) == dict.fromkeys(GROUPS, 0) | {GROUPS[0]: sum(sizes.values())}
