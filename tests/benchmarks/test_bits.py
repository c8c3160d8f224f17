"""The benchmark of same bits:

* digests do not depend on the order of contacts, and any other bit changes them;
* a changed bit is found, with the step, the part and the difference, and a failed, missing or new case is no success;
* a file that is missing, damaged, foreign or of another kind of run is refused before anything runs;
* what makes small scenes run on several threads is where the benchmark expects it;
* a case ends after its steps, and is the same when it is run again;
* from `Simulator.step` to the launch of a linear solve there are at most 16 calls of the package, the backend left out.
"""

import gzip
import inspect
from importlib import import_module

import numpy as np
import pytest

from benchmarks import bits
from benchmarks.bits_cases import all_cases
from taisoft.errors import SceneError
from taisoft.linear import gauss_seidel, pcg
from taisoft.nested import to_json

SETTINGS = {"steps": bits.STEPS, "quick": True, "case": ""}


def record(error: str = "", last: float = 1.0, **changed) -> dict:
    """A record of two steps. changed: parts of the second one."""
    second = [changed.get(part, part) for part in bits.PARTS]
    positions = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, last]])
    return bits.NOTHING | {"digests": [["a", "b", "c"], second], "positions": positions, "error": error}


def test_what_makes_loops_parallel_exists():
    assert all(hasattr(import_module(f"taisoft.{module}"), name) for module, name, _ in bits.PARALLEL)


def test_digests_do_not_depend_on_the_order_of_contacts():
    rng = np.random.default_rng(0)
    x, v, points, impulses = rng.standard_normal((4, 9, 3))
    first, order = bits.digests_of(x, v, points, impulses), rng.permutation(9)
    assert bits.digests_of(x, v, points[order], impulses[order]) == first
    impulses[3, 1] = np.nextafter(impulses[3, 1], 9.0)
    x[8, 2] = np.nextafter(x[8, 2], 9.0)
    assert [a == b for a, b in zip(bits.digests_of(x, v, points, impulses), first)] == [False, True, False]


@pytest.mark.parametrize(
    "new, old, text, status",
    [
        (record(), record(), "| same", 0),
        (record(velocities="x", last=1.5), record(), "| differs from step 2 (velocities) |            0.5 |       0.5 |", 1),
        (bits.NOTHING, record(), "| differs from step 1 (positions, velocities, contacts) |            nan |", 1),
        (record("no"), record(), "| differs in its error", 1),
        (None, record(), "| only in FILE", 1),
        (record(), None, "| not in FILE", 1),
    ],
)
def test_what_differs_is_reported(capsys, new, old, text, status):
    new, old = ({"scene a, f32, 1": one} if one else {} for one in (new, old))
    assert bits.report(new, old) == status and text in capsys.readouterr().out


def test_files_that_cannot_be_compared_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(bits, "run_all", lambda cases: pytest.fail("a case ran"))
    path = tmp_path / "bits.gz"
    with pytest.raises(SceneError, match="cannot be read: No such file"):
        bits.main(["--against", str(path)])
    bits.write(path, SETTINGS, {"scene a, f32, 1": record()})
    (kept,) = bits.read(path, SETTINGS | {"case": "scene"})["records"].values()
    assert to_json(kept) == to_json(record())
    with pytest.raises(SceneError, match="holds another kind of run"):
        bits.main(["--against", str(path)])
    whole = path.read_bytes()
    for damaged in (whole[:-9], whole[:40] + b"x" + whole[41:], b"no file of this kind", gzip.compress(b"{}")):
        path.write_bytes(damaged)
        with pytest.raises(SceneError, match="is damaged or not of|cannot be read"):
            bits.main(["--quick", "--against", str(path)])


def test_a_case_repeats_itself():
    cases = all_cases()
    assert len({case.key for case in cases}) == len(cases) and sum(case.quick for case in cases) == 8
    case = next(case for case in cases if case.key == "scene resting cube, explicit, f32, 1")
    first, second = (bits.run(case, 2) for _ in range(2))
    assert first["error"] == "" and len(first["digests"]) == 2 and first["contacts"] > 0
    assert bits.verdict(first, second) == bits.SAME


def calls_above(frame) -> int:
    """Functions of the package on the stack, from `Simulator.step` on, without those of the backend."""
    names = []
    while frame is not None:
        names.append((frame.f_globals.get("__name__", ""), frame.f_code.co_name))
        frame = frame.f_back
    names = names[: 1 + max((k for k, (_, name) in enumerate(names) if name == "step"), default=len(names) - 1)]
    return sum(module.startswith("taisoft.") and not module.startswith("taisoft.backend") for module, _ in names)


def test_a_step_is_not_deep(monkeypatch):
    depths = []

    def watch(launch):
        def watched(*arguments):
            depths.append(calls_above(inspect.currentframe().f_back))
            return launch(*arguments)

        return watched

    for module, names in ((gauss_seidel, ("run_alone", "start_shared", "iterate_shared")), (pcg, ("start", "iterate"))):
        for name in names:
            monkeypatch.setattr(module, name, watch(getattr(module, name)))
    for key in ("scene squeeze, implicit, f32, 1", "demo cube_pile, f32, 1"):
        case, before = next(case for case in all_cases() if case.key == key), len(depths)
        assert not bits.run(case, steps=4)["error"] and len(depths) > before
    assert 10 < max(depths) <= 16
