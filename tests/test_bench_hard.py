"""The benchmark of hard cases: a case passes, and its table and exit status tell what did not."""

import pytest

from benchmarks import hard
from benchmarks.reference_cases.record import Check, small
from taisoft.errors import SimulationError


def test_a_stiff_cube_lands_and_rests():
    checks = hard.run("T4 stiff cube, corotational", "cpu")
    assert len(checks) == 3 and all(check.limit is not None and check.passed for check in checks)


def test_the_table_tells_what_failed(monkeypatch, capsys):
    def lost(arch) -> list[Check]:
        raise SimulationError("lost")

    monkeypatch.setattr(hard, "CASES", {"A good": lambda arch: [small("way [m]", 1.0, 2.0)], "A lost": lost,
                                        "B bad": lambda arch: [small("way [m]", 3.0, 2.0)]})  # fmt: skip
    assert hard.main(["--case", "A good"]) == 0 and "all passed" in capsys.readouterr().out
    assert hard.main([]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-2] for line in lines[1:4]] == ["pass", "FAIL", "FAIL"] and "failed: lost" in lines[2]
    assert lines[-1] == "2 failed"
    with pytest.raises(SystemExit):
        hard.main(["--case", "nothing"])
