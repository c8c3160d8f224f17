"""Functions that the tests of `run_many` run in other processes."""

import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.backend import runtime

calls: list = []  # of this process


def add(a: float, b: float = 1.0, how: str = "") -> dict:
    """The sum, an array, a text, None, random numbers; or what `how` says: "once" ends a process that was used."""
    if how == "raise":
        raise ValueError("no\nsuch thing")
    if how == "exit":
        sys.exit(3)
    if how == "warn":
        warnings.warn("thin", UserWarning, stacklevel=1)
    if how == "die" or (how == "once" and calls):
        os.kill(os.getpid(), signal.SIGKILL)
    calls.append(how)
    report = ts.RunReport(status="degraded", problems=["two steps did not converge"])
    values = {"sum": a + b, "is_big": a > 2, "name": f"<{a}>", "nothing": None, "path": np.arange(a), "noise": np.random.rand()}
    return values | ({"run": report} if how == "degraded" else {})


def leaves(a: float) -> dict:
    """What the process of a row is left with, and leaves behind."""
    before = [os.environ.get("LEFT_BEHIND", ""), np.geterr()["divide"], hash("abc")]
    os.environ["LEFT_BEHIND"] = "1"
    np.seterr(divide="raise")
    return {"before": str(before)}


def waits(path: str) -> dict:
    """Start a process of its own, write its number to a file, and wait for it."""
    child = subprocess.Popen(["sleep", "60"])
    Path(path).write_text(str(child.pid))
    child.wait()
    return {}


def returned(kind: str):
    """What `run_many` refuses, by name."""
    kinds = {
        "list": [1],
        "word": {"two words": 1},
        "parameter": {"kind": 1},
        "column": {"status": "ok"},
        "object": {"x": object()},
    }
    return kinds[kind]


def slow(a: float) -> dict:
    """Takes a moment."""
    time.sleep(0.15)
    return {"twice": 2 * a, "pid": os.getpid()}


def beam(young: float, precision: str = "f32", closes: bool = True) -> dict:
    """A beam in free fall with a spin, in a simulator that may be left open."""
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((3, 1, 1), (3.0, 1.0, 1.0)), ts.Material(young=young), name="beam", order=1)
    body.fix(lambda X: X[:, 0] < -1.49)
    sim = ts.Simulator(scene, dt=1 / 600, integrator="symplectic_euler", precision=precision)
    report = sim.run(0.05, fps=60)
    x = sim.positions("beam")
    if closes:
        sim.close()
    else:
        calls.append(sim)
    return {"low": x[:, 1].min(), "x": x, "run": report, "threads": runtime.threads()}


if __name__ == "__main__":  # runs `slow` until a signal comes
    ts.run_many(slow, [{"a": a} for a in range(12)], workers=2, out=Path(sys.argv[1]))
