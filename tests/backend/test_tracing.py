"""Fast tracing and launching give the same results as Taichi's own.

* an explicit and an implicit run, with --long also one with contacts, end in the same bits with Taichi's public interface only
  (TAISOFT_PUBLIC_TAICHI);
* arithmetic functions with static branches, lists and arguments used several times agree with NumPy;
* arithmetic functions whose run-time branches or loops Python would evaluate while tracing are rejected.
"""

import os
import subprocess
import sys

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.backend.tracing import arithmetic
from tests.backend.lanes import opened
from tests.cli.command import ROOT

SCRIPT = """
import sys
import numpy as np
import taisoft as ts
states, material, touches = [], ts.Material(young=1e5, poisson=0.3, density=1000.0), sys.argv[2] == "contact"
for integrator, dt in (("symplectic_euler", 1e-5), ("implicit_euler", 5e-3)):
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((2, 1, 1), (0.2, 0.1, 0.1)), material, position=(0.0, 0.051, 0.0)).add_force([0, 3], (1, 2, 0))
    if touches and integrator == "implicit_euler":
        scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)))
    with ts.Simulator(scene, dt=dt, integrator=integrator) as sim:
        sim.advance(8)
        assert len(sim.contacts().gap) or not scene.obstacles
        states.append(sim.positions())
np.save(sys.argv[1], np.concatenate(states))
"""


@pytest.mark.parametrize("kind", ["free", pytest.param("contact", marks=pytest.mark.long)])
def test_states_equal_those_of_taichis_public_interface(tmp_path, monkeypatch, kind):
    environment = os.environ | {"TAISOFT_PUBLIC_TAICHI": "1", "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-W", "ignore", "-c", SCRIPT, tmp_path / "public.npy", kind], env=environment, check=True)
    monkeypatch.setattr(sys, "argv", ["", tmp_path / "fast.npy", kind])
    exec(SCRIPT, {})
    fast, public = np.load(tmp_path / "fast.npy"), np.load(tmp_path / "public.npy")
    assert np.ptp(fast) > 0.1 and np.array_equal(fast, public)


@arithmetic
def mixture(a, b, flag):
    """Sums of a and a[0]^2, doubled if flag; b and a[0]^2."""
    square = a[0] * a[0]
    sums = [square + a[k] for k in ti.static(range(2))]
    if ti.static(flag):
        sums = [2.0 * t for t in ti.static(sums)]
    return sums, [b, square]


@arithmetic
def root(x):
    return ti.sqrt(x)


@arithmetic
def nested(x):
    """Its arguments are expressions, and are used twice."""
    return root(mixture([x + 1.0, x], x, True)[0][0] * 2.0)


@kernel
def evaluate(x: ti.types.ndarray(), out: ti.types.ndarray()):
    for i in range(x.shape[0]):
        sums, rest = mixture([x[i] + 1.0, x[i]], x[i], False)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = sums[0], sums[1], rest[0], rest[1]
        out[i, 4] = nested(x[i])


def test_arithmetic_functions_agree_with_numpy():
    x = np.linspace(0.0, 3.0, 7)
    out = np.zeros((7, 5))
    with opened("f64"):
        evaluate(x, out)
    square = (x + 1) ** 2
    expected = np.stack([square + x + 1, square + x, x, square, np.sqrt(4 * (square + x + 1))], axis=1)
    assert out == pytest.approx(expected, rel=1e-15)


def if_statement(x):
    y = x
    if x > 0.0:
        y = 2.0 * x
    return y


def conditional_expression(x):
    return 1.0 if x > 0.0 else x


def loop(x):
    y = [x * k for k in range(3)]
    return y


def augmented_assignment(x):
    y = 2.0 * x
    y += x
    return y


def boolean_and(x):
    return x > 0.0 and x < 1.0


def chained_comparison(x):
    return 0.0 < x < 1.0


def negation(x):
    return not (x > 0.0)


def builtin_max(x):
    return max(x, 0.5)


def membership(x):
    return x in (0.0, 1.0)


def float_conversion(x):
    return ti.sqrt(float(x))


REJECTED = [if_statement, conditional_expression, loop, augmented_assignment, boolean_and]
REJECTED += [chained_comparison, negation, builtin_max, membership, float_conversion]


@pytest.mark.parametrize("function", REJECTED)
def test_functions_that_need_values_while_tracing_are_rejected(function):
    with pytest.raises(TypeError, match="^an arithmetic function cannot contain "):
        arithmetic(function)(0.5)
