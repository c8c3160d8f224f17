"""The collision benchmark:

* scenes have the tets of the report and the stated overlaps, and are reproducible;
* a detection is timed by phases, which give the same contacts as the whole;
* both reductions keep the same contacts, and all broad phases find the same pairs;
* crossovers, best cell sizes and limits are computed from made-up rows;
* the benchmark prints and writes its results; an unmet limit sets the exit status, and a failure is shown in its row.
"""

import json

import numpy as np
import pytest

import taisoft as ts
from benchmarks import collision, collision_runs
from benchmarks.collision import best_cell, cell_table, crossover_text, find_limits, row_table
from benchmarks.collision_cases import (
    CUBES,
    DEEP_PENETRATION,
    LARGE_PILE,
    OLDER,
    PILES,
    REPORT,
    SHEET,
    Setup,
    cubes_setup,
    pile,
    pile_setup,
    sagging,
    start,
    turning,
)
from benchmarks.collision_runs import (
    GEOMETRIES,
    HASH,
    PHASES,
    TREES,
    Film,
    Rig,
    Row,
    Sweep,
    measure_broad,
    measure_film,
    measure_row,
)
from benchmarks.document import crossovers
from taisoft.backend.runtime import open_runtime
from taisoft.errors import SimulationError


def count(scene) -> tuple[int, int]:
    """Return the numbers of tets and surface triangles."""
    return sum(b.mesh.n_tets for b in scene.bodies), sum(len(b.mesh.surface) for b in scene.bodies)


def test_scenes_have_the_sizes_of_the_report():
    assert [count(setup.build("auto"))[0] for setup in REPORT] == [990, 215, 240]
    assert [count(cubes_setup(n).build("auto"))[0] for n in (5, 11)] == [1250, 13310]
    assert {5, 11} < set(CUBES) and set(OLDER) == {setup.name for setup in REPORT}
    assert count(pile(2, "auto")) == (162 * 8, 27 * 12 * 4)
    assert 162 * PILES[0] ** 3 < 2000 and 162 * PILES[-1] ** 3 > 200_000
    assert 27 * 12 * 6**2 == 11_664 and abs(27 * 12 * LARGE_PILE**2 - 100_000) < 5000


def test_cubes_of_a_pile_touch_without_overlap():
    scene, again = pile(3, "proximity"), pile(3, "proximity")
    assert np.array_equal(start(scene), start(again))
    lo, hi = (np.array([f(b.rest_positions + b.position, axis=0) for b in scene.bodies]) for f in (np.min, np.max))
    overlap = np.minimum(hi[:, None], hi[None]) - np.maximum(lo[:, None], lo[None])
    depth = overlap.min(axis=2)[np.triu_indices(27, 1)]
    assert depth.max() < 1e-12 and (depth > -1e-12).sum() > 10 and (depth > -1e-3).sum() >= 54
    # no vertex of a face coincides with one of the opposite face
    x = scene.bodies[0].rest_positions
    top, bottom = (x[np.abs(x[:, 1] - y) < 1e-9][:, [0, 2]] for y in (0.5, -0.5))
    inner = top[(np.abs(top) < 0.4).all(axis=1)]
    assert np.linalg.norm(inner[:, None] - bottom[None], axis=2).min() > 1e-3


def test_motions_start_and_end_at_the_stated_depth():
    cubes, sheet = cubes_setup(3).build("auto"), SHEET.build("auto")
    height = [turning(cubes, t)[64:, 1].min() - 0.5 for t in (0.0, 1.0)]
    assert np.allclose(height, [0.005 - DEEP_PENETRATION / 3, -0.005 - DEEP_PENETRATION / 3])
    assert np.array_equal(sagging(sheet, 0.0), start(sheet))
    x, n = sagging(sheet, 1.0), sheet.bodies[0].n_nodes
    fixed = np.abs(start(sheet)[:n, 0]) > 1.999
    assert np.abs((x - start(sheet))[:n][fixed]).max() == 0 and (x - start(sheet))[:n, 1].min() < -0.24
    bottom = x[n:][x[n:, 1] < x[n:, 1].min() + 1e-9]
    edge = bottom[np.abs(bottom[:, 0]).argmax()]
    top = 0.025 - 0.25 * (1 - (edge[0] / 2) ** 2)
    assert edge[1] - top == pytest.approx(-2e-4, abs=1e-6)


@pytest.fixture(scope="module")
def runtime():
    made = open_runtime("cpu", "f32", "a test of the benchmark")
    yield made
    made.close()


def test_detection_is_timed_by_phases(runtime):
    row = measure_row(cubes_setup(2), "proximity", runtime, 3)
    assert row.failure == "" and (row.tets, row.triangles) == (80, 96)
    assert 0 < row.active <= 96 and row.pairs > 0 and row.found >= row.contacts > 0
    assert len(row.whole) == 3 and set(row.phases) == set(PHASES) and all(min(x) > 0 for x in row.phases.values())
    assert row.same and len(row.quadratic) == 3 and row.first > row.compile_seconds >= 0 and row.field_bytes > 0


def test_phases_give_the_contacts_of_the_whole(runtime):
    """In both a buffer that is too small grows, also after the bodies have moved."""
    setup = cubes_setup(7)

    def build(geometry):
        scene = setup.build(geometry)
        scene.collision = ts.CollisionSettings(initial_capacity=64)
        return scene

    with Rig(Setup("small", build, setup.motion), "proximity", runtime) as rig:
        rig.place(1.0)
        rig.phases()
        kept, found = rig.detection.contacts(), rig.detection.counts.found
        assert found > 64 and rig.detection.buffer.growths == 1
        rig.search()
        again = rig.detection.contacts()
        assert rig.detection.counts.found == found and np.array_equal(again.feature, kept.feature)
        assert np.array_equal(again.point, kept.point) and len(kept) == rig.detection.counts.contacts
        quadratic = rig.quadratic()
        for t in (1.0, 0.5):
            rig.place(t)
            rig.phases()
            quadratic.reduce()
            assert quadratic.same()


def test_films_and_broad_phases(runtime, monkeypatch):
    """With one or two kinds of BVH, since each compiles its own kernels."""
    monkeypatch.setattr(collision_runs, "TREES", ("bvh 6", "bvh 18"))
    (sweep,) = measure_broad(cubes_setup(2), runtime, 3)
    assert sweep.at == sweep.tets == 80 and set(sweep.rounds) == {HASH, "bvh 6", "bvh 18"}
    assert sweep.pairs[HASH] == sweep.pairs["bvh 6"] >= sweep.pairs["bvh 18"] > 0
    (cells,) = measure_broad(cubes_setup(2), runtime, 3, (1.0,))
    assert cells.at == 1.0 and cells.pairs == {HASH: sweep.pairs[HASH]} and len(cells.rounds[HASH]) == 3
    monkeypatch.setattr(collision_runs, "TREES", ("bvh 6",))
    film = measure_film(cubes_setup(2), "proximity", runtime, 2, broad=True)
    assert film.same and {*PHASES, "quadratic", "active", "found", "kept", HASH, "bvh 6"} == set(film.numbers)
    assert all(len(values) == 2 for values in film.numbers.values()) and film.numbers["kept"][1] > 0


def test_a_failure_is_shown_in_its_row(runtime, monkeypatch):
    def failing(*arguments):
        raise SimulationError("no such luck")

    monkeypatch.setattr(collision_runs, "Detection", failing)
    row = measure_row(cubes_setup(2), "proximity", runtime, 3)
    assert row.failure == "no such luck" and row.timing is None and "* cubes 2, proximity: no such luck" in row_table([row])


def made_row(setup: str, geometry: str, ms: float = 1.0, same: bool = True) -> Row:
    phases = {name: [ms / 4000] * 3 for name in PHASES}
    return Row(setup, geometry, 100, 50, 40, 30, 20, 10, phases, [ms / 1000] * 3, [ms / 500] * 3, same, 2.0, 1.0, 1000)


def made_sweep(tets: int, hashed: float, tree: float) -> Sweep:
    rounds = {HASH: [hashed]} | {name: [tree] for name in TREES}
    return Sweep("tets", f"cubes {tets}", tets, tets, 10, dict.fromkeys(rounds, 5), rounds)


def test_crossovers_lie_between_two_sizes():
    tets = [100, 1000, 10000]
    assert crossovers(tets, [2.0, 2.0, 2.0], [1.0, 1.0, 1.0]) == []
    assert crossovers(tets, [2.0, 1.0, 1.0], [1.0, 2.0, 4.0]) == [pytest.approx(10**2.5)]
    assert len(crossovers(tets, [2.0, 1.0, 2.0], [1.0, 2.0, 1.0])) == 2
    text = crossover_text([made_sweep(100, 2.0, 1.0), made_sweep(1000, 1.0, 2.0)])
    assert text.splitlines()[0] == "* spatial_hash against bvh 6: crossover at 316 tets, below the first bvh 6 is faster"
    text = crossover_text([made_sweep(100, 1.0, 2.0), made_sweep(1000, 1.0, 2.0)])
    assert text.splitlines()[2] == "* spatial_hash against bvh 18: no crossover, spatial_hash is faster throughout"


def test_the_best_cell_is_the_fastest():
    cells = [Sweep("ratio", "cubes 5", at, 1250, 10, {HASH: 5}, {HASH: [ms]}) for at, ms in ((1.0, 3.0), (2.0, 2.0), (3.0, 2.08))]
    assert best_cell(cells).at == 2.0
    assert "* cubes 5, 1,250 tets: best at 2, within 5 % of it from 2 to 3; the report: 2.2" in cell_table(cells)


def test_limits_are_met_or_not():
    rows = [made_row(pile_setup(n).name, geometry, ms) for n, ms in ((6, 7.9), (LARGE_PILE, 81.0)) for geometry in GEOMETRIES]
    rows += [made_row(SHEET.name, "proximity", 2.3), made_row(SHEET.name, "distance_field", 2.5)]
    film = Film("cubes 5", "proximity", 1250)
    assert [limit.met for limit in find_limits(rows, [film])] == [True, True, False, False, True, False, True]
    film.same = False
    assert not find_limits(rows, [film])[-1].met
    assert not any(limit.met for limit in find_limits([], [film]))


@pytest.fixture
def faked(monkeypatch):
    """Made-up measurements."""

    def film(setup, geometry, runtime, frames, broad=False):
        made = Film(setup.name, geometry, 10)
        for _ in range(frames):
            others = dict.fromkeys((HASH, *TREES), 0.001) if broad else {}
            made.add(active=1, found=2, kept=2, quadratic=0.002, **dict.fromkeys(PHASES, 0.001), **others)
        return made

    def sweeps(setup, runtime, rounds, ratios=None):
        if ratios is None:
            return [made_sweep(10 * int(setup.name.split()[1]) ** 3, 0.001, 0.002)]
        return [Sweep("ratio", setup.name, at, 1250, 10, {HASH: 5}, {HASH: [0.001 * at]}) for at in ratios]

    monkeypatch.setattr(collision, "measure_row", lambda setup, geometry, runtime, rounds: made_row(setup.name, geometry))
    monkeypatch.setattr(collision, "measure_film", film)
    monkeypatch.setattr(collision, "measure_broad", sweeps)


def test_command_writes_what_it_prints(faked, tmp_path, capsys):
    out = tmp_path / "new" / "a.json"
    assert collision.main(["--out", str(out)]) == 0
    printed, numbers = capsys.readouterr().out, json.loads(out.read_text())
    assert out.with_suffix(".md").read_text().strip() in printed
    assert len(numbers["piles"]) == 2 * (len(PILES) + 1) and len(numbers["films"]) == 3
    assert all(limit["met"] for limit in numbers["limits"])
    for heading in ("fig. 12", "figs. 11, 13, 17", "fig. 14", "fig. 17", "fig. 18", "## Limits"):
        assert heading in printed


def test_an_unmet_limit_sets_the_exit_status(faked, monkeypatch, capsys):
    monkeypatch.setattr(collision, "measure_row", lambda setup, geometry, runtime, rounds: made_row(setup.name, geometry, 90.0))
    assert collision.main([]) == 1
    assert "NOT met" in capsys.readouterr().out
    assert collision.main(["--quick"]) == 0
    assert "## Limits" not in capsys.readouterr().out
