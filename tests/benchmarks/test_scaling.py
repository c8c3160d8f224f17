"""The scaling benchmark, on tiny meshes and made-up numbers. No test here checks speed:

* exponents are those of power laws, and NaN from one mesh;
* the least bytes moved by a step agree with a count by hand, and every kind of step has the fields counted;
* groups of fields add up to all fields, and a copy is compared only with work on as many threads;
* a row of each kind has times, phases that add up to a step, counts and memory;
* child processes return numbers or an error; the benchmark prints, writes and plots, and a failure sets the exit status.
"""

import json
import math

import numpy as np
import pytest

import taisoft as ts
from benchmarks import scaling
from benchmarks.collision_cases import Setup, pile, pile_setup
from benchmarks.collision_runs import Rig
from benchmarks.document import exponent
from benchmarks.scaling import gain_table, growths, time_table
from benchmarks.scaling_bytes import GROUPS, LOOPS, Copy, copy_rate, floor_bytes, group_bytes, measure_copy
from benchmarks.scaling_runs import KINDS, ON_ONE, Row, beam, cubes_on_ground, measure
from taisoft.backend.runtime import open_runtime
from taisoft.errors import OutputError

EXPLICIT = "explicit"


def row(kind="implicit", tets=1000, seconds=1.0, **more) -> Row:
    """A row with made-up times."""
    found = {"samples": [seconds] * 3, "phases": {"a": 0.75 * seconds, "b": 0.25 * seconds}, "counts": {"newton": 2.5}}
    found |= {"moved": 8.0 * tets, "field_bytes": {"matrix": 100 * tets}, "setup_seconds": 1e-6 * tets, "base": 10, "peak": 50}
    return Row(kind, "cpu", tets, 300, **found | more)


def hashed(collision: str) -> ts.Scene:
    """The smallest pile, with a spatial hash, as on CUDA."""
    scene = pile(1, collision)
    scene.collision = ts.CollisionSettings(broad_phase="spatial_hash")
    return scene


# --- numbers ----------------------------------------------------------------------------------------------------------


def test_exponents_are_those_of_power_laws():
    tets = [1000, 4000, 64_000]
    rows = [row(tets=n, seconds=1e-9 * n**1.25) for n in tets]
    found = growths([*rows, row("search"), row("search", samples=[], failure="no")])
    assert [g.kind for g in found] == ["implicit", "search"] and found[0].meshes == 3
    assert (found[0].step, found[0].step_at_last, found[0].setup, found[0].memory) == pytest.approx((1.25, 1.25, 1, 1))
    assert math.isnan(found[1].step) and math.isnan(exponent([1, 2], [0.0, 1.0])[0])
    bent = growths([row(tets=n, seconds=s) for n, s in ((1000, 1.0), (2000, 2.0), (4000, 8.0))])[0]
    assert bent.step_at_last == pytest.approx(2) and 1 < bent.step < 2


def test_bytes_of_an_explicit_step_agree_with_a_count_by_hand():
    with ts.Simulator(beam(20), dt=1e-4, integrator="velocity_verlet") as sim:  # 4 x 1 x 1 cells
        n, t, sizes = sim.scene.bodies[0].n_nodes, 20, sim.field_bytes
        elements = 24 * n + t * (16 + 36 + 4 + 1) + 48 * t  # x; nodes, Dm_inv, volume, one body per four tets; element_force
        assert floor_bytes(["elements"], sizes) == elements
        drift, nodes = n * (24 + 12 + 12 + 24 + 12), 48 * t + 4 * (n + 1) + 16 * t + n * (4 + 12 + 12 + 12 + 12)
        assert floor_bytes(["drift", "elements", "nodes"], sizes) == drift + elements + nodes
        assert group_bytes(sim) == dict.fromkeys(GROUPS, 0) | {GROUPS[0]: sum(sizes.values())}


def test_every_counted_field_exists():
    known: set[str] = set()
    for scene, integrator in ((beam(20), "bdf2"), (cubes_on_ground(10), "symplectic_euler"), (beam(20), "velocity_verlet")):
        with ts.Simulator(scene, dt=1e-5, integrator=integrator) as sim:
            known |= set(sim.field_bytes)
            groups = group_bytes(sim)
            assert sum(groups.values()) == sum(sim.field_bytes.values())
            assert (groups["matrix"] > 0) == (integrator == "bdf2") and (groups["contacts"] > 0) == (len(scene.bodies) == 2)
    runtime = open_runtime("cpu", "f32")
    try:
        for build in (pile_setup(1).build, hashed):
            with Rig(Setup("pile", build), "proximity", runtime) as rig:
                known |= set(rig.detection.field_bytes)
    finally:
        runtime.close()
    assert {name for loop in LOOPS.values() for names in loop for name in names} <= known


def test_copy_rate_is_the_best_on_at_most_as_many_threads():
    copies = measure_copy("cpu", 2**20)
    assert {copy.by for copy in copies} == {"NumPy", "Taichi"} and all(copy.rate > 0 for copy in copies)
    made_up = [Copy("a", 1, 5.0), Copy("b", 1, 7.0), Copy("a", 4, 20.0)]
    assert copy_rate(made_up, 1) == 7.0 and copy_rate(made_up, 4) == 20.0 and copy_rate(made_up[:2], 4) == 7.0


# --- rows -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_row_of_each_kind(kind):
    found = measure(kind, 60, "cpu")
    assert found.failure == "" and found.tets > 0 and found.nodes > 0 and found.moved > 0
    assert min(found.samples) > 0 and min(found.phases.values()) >= 0 and found.peak >= found.base
    assert sum(found.field_bytes.values()) > 0 and found.setup_seconds > 0
    if kind.removesuffix(ON_ONE) == EXPLICIT:
        assert sum(found.phases.values()) == pytest.approx(found.timing.median) and found.threads == 1
    elif kind.removesuffix(ON_ONE) == "search":
        assert found.counts["contacts"] > 0
    elif "contact" in kind:
        assert found.counts["contacts"] > 0 and found.counts["sweeps"] > 0 and {"search", "problem"} <= set(found.phases)
    else:
        assert found.counts["linear"] >= found.counts["newton"] >= 1 and {"residual", "matrix"} <= set(found.phases)
    assert Row(**json.loads(json.dumps(found.record()))) == found


def test_table_shows_failures():
    table = time_table([row(), row("search", tets=5, samples=[], failure="no luck")]).splitlines()
    cells = [cell.strip() for cell in table[2].split("|")[1:-1]]
    assert cells[:7] == ["implicit", "1,000", "1", "1000", "0.0%", "1e+06", "2.5 newton"]
    assert table[-1] == "* search, 5 tets: no luck"


# --- command --------------------------------------------------------------------------------------------------------


def test_a_child_answers_with_a_row_or_an_error():
    found = scaling.run_child(f"{EXPLICIT}:20", "cpu")
    assert Row(**found).tets == 20 and found["samples"]
    assert "nonsense" in scaling.run_child("nonsense:20", "cpu")


def test_one_thread_is_measured_where_several_were_used(monkeypatch):
    jobs = []

    def run_child(job, arch):
        jobs.append(job)
        kind, _, size = job.rpartition(":")
        return row(kind, int(size), threads=2 if int(size) > 50 and not kind.endswith(ON_ONE) else 1).record()

    monkeypatch.setattr(scaling, "run_child", run_child)
    rows = list(scaling.measure_all(list(KINDS), [10, 100], "cpu"))
    on_one = [kind for kind in KINDS if kind.endswith(ON_ONE)]
    assert [job for job in jobs if ON_ONE in job] == [f"{kind}:100" for kind in on_one]
    assert len(rows) == len(jobs) == 2 * len(KINDS) - len(on_one)
    assert gain_table(rows).count("| 2 |") == 0 and gain_table(rows).count("1.00") == len(on_one)
    jobs.clear()
    list(scaling.measure_all(list(KINDS), [10, 100], "cuda"))
    assert not [job for job in jobs if ON_ONE in job]


def test_command_prints_writes_and_plots(monkeypatch, tmp_path, capsys):
    copies = [{"by": "NumPy", "threads": 1, "rate": 2e10}]

    def run_child(job, arch):
        if job == scaling.COPY:
            return copies
        kind, _, size = job.rpartition(":")
        return "it broke" if job == "search:9" else row(kind, int(size)).record()

    monkeypatch.setattr(scaling, "run_child", run_child)
    out, plot = tmp_path / "s.json", tmp_path / "s.png"
    assert scaling.main(["--sizes", "900,300", "--out", str(out), "--plot", str(plot)]) == 0
    numbers = json.loads(out.read_text())
    assert {r["tets"] for r in numbers["rows"]} == {300, 900} and numbers["copies"] == copies
    assert [g["kind"] for g in numbers["exponents"]] == [kind for kind in KINDS if not kind.endswith(ON_ONE)]
    printed = capsys.readouterr().out
    assert out.with_suffix(".md").read_text().strip() in printed and "a 75%, b 25%" in printed and plot.stat().st_size > 10_000
    assert scaling.main(["--sizes", "9", "--kind", "search"]) == 1
    assert "it broke" in capsys.readouterr().out
    for wrong in ("none", "0", ""):
        with pytest.raises(SystemExit):
            scaling.main(["--sizes", wrong])
    with pytest.raises(OutputError):
        scaling.main(["--out", str(tmp_path / "s.txt")])
    monkeypatch.setattr(scaling, "run_child", lambda job, arch: "no CUDA here")
    with pytest.raises(ts.SimulationError, match="no CUDA here"):
        scaling.main(["--arch", "cuda"])


def test_meshes_have_about_the_requested_size():
    sizes = np.array([1000, 16_000, 64_000])
    beams = np.array([beam(n).bodies[0].mesh.n_tets for n in sizes])
    cubes = np.array([sum(b.mesh.n_tets for b in cubes_on_ground(n).bodies) for n in sizes])
    assert (np.abs(np.log(beams / sizes)) < 0.3).all() and (np.abs(np.log(cubes / sizes)) < 0.3).all()
