"""Quicker tracing gives what Taichi's own gives, and quicker launching with it.

* runs of both orders, explicit and implicit, one with contacts, and statics end in the same state, bit by bit, with Taichi's
  public interface alone and with what is built on its inner parts;
* an arithmetic function with branches, in lists, of arguments used several times computes what NumPy does;
* what Python would decide in its place while tracing is refused.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import taichi as ti

from taisoft.backend import runtime, tracing
from taisoft.backend.runtime import kernel
from taisoft.backend.tracing import arithmetic

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = """
import sys
import numpy as np
import taisoft as ts
states = []
CASES = (("stable_neo_hookean", 1, "symplectic_euler", 1e-5), ("corotational", 2, "implicit_euler", 1e-3))
for law, order, integrator, dt in CASES:
    scene = ts.Scene()
    material = ts.Material(law=law, young=1e5, poisson=0.3, density=1000.0)
    scene.add_body(ts.box_mesh((2, 1, 1), (0.2, 0.1, 0.1)), material, order=order).fix(lambda X: X[:, 0] < -0.099)
    with ts.Simulator(scene, dt=dt, integrator=integrator) as sim:
        sim.advance(5)
        states.append(sim.positions())
scene = ts.Scene()
scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 0, 1)))
for z in (0.051, 0.152):
    scene.add_body(ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1)), material, position=(0.0, 0.0, z))
with ts.Simulator(scene, dt=5e-3, integrator="implicit_euler") as sim:
    sim.advance(12)
    assert len(sim.contacts().gap)
    states.append(sim.positions())
scene = ts.Scene()
scene.add_body(ts.box_mesh((2, 1, 1), (0.2, 0.1, 0.1)), material).fix(lambda X: X[:, 0] < -0.099)
states.append(ts.solve_static(scene).positions())
np.save(sys.argv[1], np.concatenate(states))
"""


def test_states_are_those_of_taichis_public_interface(tmp_path):
    for name, public in (("quick", ""), ("public", "1")):
        environment = os.environ | {"TAISOFT_PUBLIC_TAICHI": public, "PYTHONPATH": str(ROOT)}
        subprocess.run([sys.executable, "-W", "ignore", "-c", SCRIPT, tmp_path / f"{name}.npy"], env=environment, check=True)
    quick, public = np.load(tmp_path / "quick.npy"), np.load(tmp_path / "public.npy")
    assert np.ptp(quick) > 0.1 and np.array_equal(quick, public)


@arithmetic
def mixture(a, b, flag):
    """b, and sums of a and its square, in two lists."""
    square = a[0] * a[0]
    twice = [square + a[k] for k in ti.static(range(2))]
    if ti.static(flag):
        twice = [2.0 * t for t in ti.static(twice)]
    return twice, [b, square]


@arithmetic
def root(x):
    return ti.sqrt(x)


@arithmetic
def of_another(x):
    """Its argument is no variable, and is used twice."""
    return root(mixture([x + 1.0, x], x, True)[0][0] * 2.0)


@kernel
def evaluate(x: ti.types.ndarray(), out: ti.types.ndarray()):
    for i in range(x.shape[0]):
        twice, rest = mixture([x[i] + 1.0, x[i]], x[i], False)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = twice[0], twice[1], rest[0], rest[1]
        out[i, 4] = of_another(x[i])


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_arithmetic_is_numpys(precision):
    x = np.linspace(0.0, 3.0, 7).astype({"f32": np.float32, "f64": np.float64}[precision])
    out = np.zeros((7, 5), dtype=x.dtype)
    opened = runtime.open_runtime("cpu", precision)
    try:
        evaluate(x, out)
    finally:
        opened.close()
    square = (x + 1) ** 2
    expected = np.stack([square + x + 1, square + x, x, square, np.sqrt(4 * (square + x + 1))], axis=1)
    assert out == pytest.approx(expected, rel=4 * float(np.finfo(x.dtype).eps))


def branches(x):
    y = x
    if x > 0.0:
        y = 2.0 * x
    return y


def chooses(x):
    return 1.0 if x > 0.0 else x


def loops(x):
    y = [x * k for k in range(3)]
    return y


def adds(x):
    y = 2.0 * x
    y += x
    return y


def both(x):
    return x > 0.0 and x < 1.0


def between(x):
    return 0.0 < x < 1.0


def negates(x):
    return not (x > 0.0)


def larger(x):
    return max(x, 0.5)


def belongs(x):
    return x in (0.0, 1.0)


def rounds(x):
    return ti.sqrt(float(x))


@pytest.mark.parametrize("function", [branches, chooses, loops, adds, both, between, negates, larger, belongs, rounds])
def test_what_python_would_decide_is_refused(function):
    with pytest.raises(TypeError, match="^an arithmetic function cannot contain "):
        tracing._as_python(function)
