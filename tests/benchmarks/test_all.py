"""Every benchmark runs at its smallest size: it prints its page, writes the same page and its numbers, and returns its status.

Where a benchmark has no small form, one is made here. Stand-ins take the place of what takes minutes or needs other programs:

* implicit steps with contacts, which take a minute to compile: contact and crossings take explicit ones, ipc shows made-up rows,
  and so do order and launches;
* child processes, whose work is done in this process: crossings, error, hard, many, pictures, scaling, tolerance;
* the simulators of error and tolerance, by one with known errors; the display of window.

The long runs do without them. The others run in test_document.py (figures, manual), test_peers.py and
tests/references.
"""

import importlib
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

import taisoft as ts
from benchmarks import (
    collision,
    contact,
    contact_runs,
    elasticity,
    error,
    gpu,
    gpu_parts,
    gym,
    hard_runs,
    launches,
    laws,
    many,
    order,
    pictures,
    scaling,
    tolerance,
    window,
)
from benchmarks.collision_cases import REPORT
from benchmarks.elasticity import Cost
from benchmarks.order import Row as OrderRow
from benchmarks.scaling_bytes import measure_copy
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.view.pictures import picture_writer
from tests.benchmarks import stand_ins
from tests.benchmarks.stand_ins import SOLVER, SPACE, TIME, ModelSimulator, answer_here, in_this_process
from tests.many import makes
from tests.many.stand_in import InProcess


def replace(patch: pytest.MonkeyPatch, module, **values) -> None:
    """Set attributes of a module."""
    for name, value in values.items():
        patch.setattr(module, name, value)


def collision_small(patch, folder):
    replace(patch, collision, PILES=(1,), REPORT=REPORT[1:2], SHEET=REPORT[1], GEOMETRIES=("proximity",), TREES=("bvh 6",))
    replace(patch, collision, CUBES=(2,), SWEPT=(2,), RATIOS=(1.0, 2.0), QUICK_FRAMES=2)


def collision_check(n):
    for row in n["piles"] + n["scenes"]:
        assert row["failure"] == "" and row["same"] and row["found"] >= row["contacts"] > 0 and min(row["whole"]) > 0
    assert n["piles"][0]["tets"] == 162 and all(film["same"] for film in n["films"])
    pairs = n["broad"][0]["pairs"]
    assert pairs["spatial_hash"] == pairs["bvh 6"] == n["cells"][0]["pairs"]["spatial_hash"] > 0


def contact_small(patch, folder):
    def explicit(name, arch, refine=None, geometry=None, **_):
        return contact_runs.open_demo(name, arch, refine, **contact_runs.EXPLICIT)

    replace(patch, contact, QUICK_FRAMES=2, QUICK_STEPS=3, QUICK_SIZES=(4,), QUICK_RUN_SECONDS=0.2)
    replace(patch, contact, open_demo=explicit, real_meshes=dict, SHEET="cube_on_box", SETTLE=3)
    replace(patch, contact_runs, SOLVERS=("gauss_seidel",))
    patch.setattr(contact.contact_problems, "missing", lambda names: "they are not asked for")


def contact_check(n):
    (film,), (run,), (step, _) = n["films"], n["runs"], n["steps"]
    (found,) = film["outcomes"].values()
    assert film["tets"] == 215 and len(found) == len(film["time"]) and all(one["residual"] <= 1e-4 for one in found)
    assert len(step["whole"]) == 3 and step["residual"] <= 1e-4 and step["kinds"]["friction"] > 0 < step["kinds"]["contacts"]
    assert len(n["touching"]["contacts"]) == len(n["touching"]["nodes"]) > 0
    assert run["status"] == "ok" and 10 < len(run["seconds"]) < 48 and run["wall"] > sum(run["seconds"])
    assert all(n["crossover"][0][how]["residual"] <= 1e-4 for how in ("serial", "coloured"))


def crossings_small(patch, folder):
    from benchmarks import crossing_runs, crossings  # need ipctk

    demo = crossing_runs.load_module(crossing_runs.shipped_files("demos")["cube_on_box"])
    settings = {"dt": 1 / 240, "integrator": "symplectic_euler", "seconds": 5 / 240, "fps": 240.0}
    replace(patch, crossing_runs, load_module=lambda _: SimpleNamespace(build=demo.build, solver=settings))
    answer_here(patch, crossing_runs.answer)
    replace(patch, crossings, QUICK={"demos": ("cube_on_box",)})


def elasticity_small(patch, folder):
    """The steps' numbers are made up."""
    made_up = Cost(540, "SNH", "velocity_verlet", "f32", 0.5, [6e-6, 6e-6], [6.6e-6, 6.6e-6])
    replace(patch, elasticity, MESHES=((12, 3, 3),), measure_costs=lambda *_: [made_up])


def error_small(patch, folder):
    patch.setattr(ts, "Simulator", ModelSimulator)
    answer_here(patch, error.answer)


def error_check(n):
    (beam,) = n["rows"]
    dt, n_tets = 1 / 60, beam["tets"]
    assert (
        beam["steps"] == round(2.0 / dt) and beam["companions"] == 3.0 and beam["estimated"]["time"] == pytest.approx(TIME * dt)
    )
    true = {"time": TIME * dt * 15 / 16 + SOLVER, "space": SPACE / n_tets * 63 / 64, "solver": SOLVER}
    for what, value in true.items():
        assert beam["true"][what] == pytest.approx(value / (1.0 + SPACE / n_tets + TIME * dt / 16), rel=1e-6)


def laws_small(patch, folder):
    replace(patch, laws, QUICK_SIZES={"step": (2, 1, 1), "assembly": (2, 1, 1)}, compile_seconds=lambda name: 1.0, STEPS=1)


def gpu_small(patch, folder):
    """Without results of a device."""
    replace(patch, gpu, RESULTS=folder)
    replace(patch, gpu_parts, PLATES=(2,), REPEATS=1)
    answer_here(patch, gpu_parts.answer)


def gpu_check(n):
    launches, counts, sweeps = (part["rows"] for part in n["parts"])
    assert min(row.get("launch [us]", 1.0) for row in launches) > 0 and launches[-1]["time [us]"] > 0
    step, batch, implicit = counts
    assert 0 < step["launches"] < batch["launches"] and implicit["N"] > 0 < implicit["contacts"] and implicit["E"] > 0
    assert sweeps[0]["residual"] < 1e-4 and sweeps[0]["colours"] > 1


def gym_small(patch, folder):
    """Environments in this process, all of one beam, without MuJoCo."""
    gymnasium = pytest.importorskip("gymnasium")
    (work,) = (work for work in gym.WORKS if work.key == "W1 12x3x3")
    replace(patch, gym, INTEGRATORS={"velocity_verlet": 3}, block=lambda: gym.own.make_scene(work, gym.MUJOCO))
    replace(patch, gym, vector=gymnasium.vector.SyncVectorEnv)
    patch.setattr(gym, "problem", lambda _: "it is not asked for")


def gym_check(n):
    cost, (row,) = n["costs"]["velocity_verlet"], n["works"]
    assert 0 < cost["reset"] < cost["make"] and min(cost.values()) > 0 and row["processes"] == 2 and row["error"] < 1e-4
    assert len(row["one"]) == len(row["several"]) == 1 and min(row["one"] + row["several"]) > 0


def hard_small(patch, folder):
    answer_here(patch, hard_runs.answer)


def ipc_small(patch, folder):
    answer_here(patch, stand_ins.ipc_answer)


def many_small(patch, folder):
    """No kill."""
    patch.setattr("taisoft.many.runs.LocalPlace", InProcess)
    replace(patch, many, PARTS={"sums": (makes.add, [{"a": float(k)} for k in range(9)])})
    replace(patch, many, killed=lambda name, n, workers, whole, folder: (many.run(name, n, 1, out=folder)[0].digest(), n // 2))


def many_check(n):
    digests = n["parts"]["sums"]["digests"]
    assert len(digests) >= 5 and len(set(digests.values())) == 1 and n["parts"]["sums"]["runs"] == many.QUICK_RUNS


def order_small(patch, folder):
    row = OrderRow("hanging_beam", "SNH", 1, None, (11, 2, 2), 220, 108, [-2.26758], 0.163, 5, 90, [0.5])
    replace(patch, order, measure_mesh=lambda *_: row)


def pictures_small(patch, folder):
    replace(patch, pictures, DEMOS={"hanging_beam": 0.5}, PICTURES=2, QUICK_ROUNDS=1)
    replace(patch, pictures, PictureProcess=picture_writer)


def pictures_check(n):
    run, one = n["runs"]["hanging_beam"], n["picture"]
    for where in ("with", "between"):
        assert 0 < run[where]["drawing"][0] < run[where]["wall"][0] and run["without"]["cpu"][0] > 0
    assert len(one["kernels"]["wall"]) == 1 and one["bytes"] > 1000


def scaling_small(patch, folder):
    replace(patch, scaling, in_child=in_this_process, measure_copy=lambda arch: measure_copy(arch, 2**20))


def scaling_check(n):
    (row,) = n["rows"]
    assert (row["tets"], row["nodes"], row["threads"]) == (20, 20, 1) and min(row["samples"]) > 0 and row["setup_seconds"] > 0
    assert row["phases"]["assembly and forces"] > 0 and set(row["phases"]) == {"assembly and forces", "launches", "host"}
    assert min(row["calls"].values()) >= 0 and sum(row["calls"].values()) > 0
    assert row["moved"] > 0 and row["peak"] >= row["base"] > 0 and all(copy["rate"] > 0 for copy in n["copies"])


def tolerance_small(patch, folder):
    """Without limits on times, which other processes on the machine may lengthen."""
    patch.setattr(ts, "Simulator", ModelSimulator)
    replace(patch, tolerance, MEDIAN=math.inf, SLOWEST=math.inf)
    replace(patch, tolerance, cache_folders=lambda: iter([folder]))
    answer_here(patch, tolerance.answer)


def tolerance_check(n):
    (row,), grid = n["rows"], n["grids"]["hanging beam"]
    dt, finest, whole = 1 / 480, 1 / 60 / 128, 1.0 + SPACE / 160
    assert row["true"] == pytest.approx((TIME * (dt - finest) + SOLVER) / (whole + TIME * finest), rel=1e-6)
    assert row["own"] == pytest.approx(TIME * finest / (whole + TIME * finest), rel=1e-6)
    enough = [one for one in grid if one["error"] <= 0.01]
    assert {one["integrator"] for one in grid} == {*EXPLICIT, *IMPLICIT} and 0 < len(enough) < len(grid)
    fastest = min(enough, key=lambda one: one["seconds"])
    assert (row["best"]["integrator"], row["best"]["steps"]) == (fastest["integrator"], fastest["steps"])


def window_small(patch, folder):
    replace(patch, window, VirtualDisplay=lambda: SimpleNamespace(close=lambda: None))
    replace(patch, window, measure=lambda name, display: stand_ins.WINDOW | {"demo": name})


@dataclass(frozen=True)
class Small:
    """A small run. shows: parts of its page, blanks squeezed; reduce: makes it small; check: of its numbers."""

    arguments: tuple[str, ...]
    shows: tuple[str, ...] = ()
    reduce: Callable[[pytest.MonkeyPatch, Path], None] = lambda patch, folder: None
    check: Callable[[dict], None] = lambda numbers: None


QUICK = ("--quick",)


def launches_small(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Made-up times."""
    rounds = iter([{"launches": {"200": us}, "steps": {"resting": 100.0 * us}} for us in (1.0, 3.0, 2.0)])
    replace(patch, launches, QUICK_ROUNDS=3, in_child=lambda *_: next(rounds))


BEAM = ("--only", "hanging beam")
RUNS = {
    "collision": Small(QUICK, ("| pile 1 | proximity | 162 |", "(fig. 18)", "| yes |"), collision_small, collision_check),
    "contact": Small(QUICK, ("| cube_on_box | 215 |", "| parallel |", "Left out: they are"), contact_small, contact_check),
    "crossings": Small(
        ("--what", "demos", "--quick"),
        ("| cube_on_box | symplectic_euler, 1/240 s, f32 |", "**In all: 5 states judged, 0 cross**, in 0 of 1 runs"),
        crossings_small,
    ),
    "elasticity": Small(QUICK, ("| SNH | 6.00 |", "| 1.00 | 1.10 | 0.50 |", "cores, load"), elasticity_small),
    "error": Small(BEAM, ("| hanging beam | bdf2 | 160 |", "a note"), error_small, error_check),
    "gpu": Small(
        ("--quick", "--arch", "cpu", "--only", "micro", "counts", "sweeps"),
        ("Not run on a device", "| a barrier of a block |", "| a sub-step |", "| an implicit step |"),
        gpu_small,
        gpu_check,
    ),
    "gym": Small(
        QUICK,
        ("| velocity_verlet |", "| W1 12x3x3 | taisoft |", "MuJoCo is left out: it is not asked for."),
        gym_small,
        gym_check,
    ),
    "hard": Small(("--only", "G1", "--quick"), ("# Hard cases", "**1 of 1 variants are solved.**"), hard_small),
    "ipc": Small(("--quick", "--only", "twisted_mat"), ("| twisted mat | 800 | 1,805 | 0.04 | 0.08 of 25 (2) |",), ipc_small),
    "launches": Small(QUICK, ("| 200 | 2.00 (1.00 to 3.00) |", "| resting | 200 (100 to 300) |"), launches_small),
    "laws": Small(QUICK, ("| psi of SNH | stable_neo_hookean |", "| psi of F | st_venant_kirchhoff |"), laws_small),
    "many": Small(QUICK, ("| sums | 6 |", "| killed and called again |", "| met |"), many_small, many_check),
    "order": Small(QUICK, ("| SNH | 1 | 1 | 11x2x2 | 220 | 108 | -2.26758 | 16.3 |",), order_small),
    "pictures": Small(QUICK, ("| kernels |", "| PNG |", "| hanging_beam |"), pictures_small, pictures_check),
    "regression": Small(("--only", "search, two"), ("| search, two cubes | f32 |", "nothing has changed")),
    "robots": Small(QUICK, ("| 2 | 8 |", "weak, amplitude 0.", "| of it MuJoCo and exchange |")),
    "scaling": Small(("--sizes", "20", "--kind", "explicit"), ("| explicit | 20 | 1 |",), scaling_small, scaling_check),
    "tolerance": Small((*BEAM, "--wish", "1"), ("| hanging beam | 1 | bdf2 | 8 |",), tolerance_small, tolerance_check),
    "window": Small(
        QUICK,
        (
            "| cube_on_box | 1,215 | 10 | 2 | 20 | 3.00 | 1.00 | 25 | 70 | 60 | 87 | 0.99 | 4.0 | 25 | 0.03 | 70 |",
            "| cube_on_box | 2.1 | 2 | 40 | 30 | 10 | 5 | 0 | 5 | 10 | 1,234 |",
        ),
        window_small,
    ),
}
WHOLE = {"startup": Small(QUICK)} | {name: Small(run.arguments) for name, run in RUNS.items() if name != "window"}  # a display


@pytest.mark.filterwarnings("ignore:body")  # few tets through the thickness
@pytest.mark.parametrize(
    "name, small", [*RUNS.items(), *(pytest.param(*one, marks=pytest.mark.long, id=f"{one[0]}-whole") for one in WHOLE.items())]
)
def test_a_benchmark_runs(name, small, monkeypatch, tmp_path, capsys):
    if name in ("crossings", "ipc"):
        pytest.importorskip("ipctk")
    small.reduce(monkeypatch, tmp_path)
    out = tmp_path / "new" / f"{name}.json"
    written = () if name == "regression" else ("--out", str(out))
    drawn = ("--plot", str(out.with_suffix(".png"))) if name in ("order", "scaling") else ()
    status = importlib.import_module(f"benchmarks.{name}").main([*small.arguments, *written, *drawn])
    page = printed = capsys.readouterr().out
    if written:
        page, numbers = out.with_suffix(".md").read_text(), json.loads(out.read_text())
        assert page.strip() in printed and page.startswith("# ") and numbers["processor"] and numbers["date"]
        small.check(numbers)
    assert not drawn or out.with_suffix(".png").read_bytes()[:4] == b"\x89PNG"
    squeezed = re.sub(" +", " ", page)
    assert status == 0 and [part for part in small.shows if part not in squeezed] == []
