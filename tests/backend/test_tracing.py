"""Fast tracing and launching give the same results as Taichi's own.

* an explicit run, with --long also implicit ones with contacts, ends in the same bits with Taichi's public interface only
  (TAISOFT_PUBLIC_TAICHI), and optimised as users have it, which the tests are not;
* a function called several times in a kernel, within itself and with values of different types, is traced anew at each call;
* the text of a function is that which Python finds, whatever is in it;
* arithmetic functions with static branches, lists and arguments used several times agree with NumPy;
* arithmetic functions whose run-time branches or loops Python would evaluate while tracing are rejected.
"""

import ast
import inspect
import os
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti

from taisoft.backend.runtime import kernel
from taisoft.backend.tracing import arithmetic, source_of
from taisoft.collision import analytic
from tests.backend.lanes import opened
from tests.cli.command import ROOT

SCRIPT = """
import sys
import numpy as np
import taisoft as ts
integrator = sys.argv[2]
scene, material = ts.Scene(), ts.Material(young=1e5, poisson=0.3, density=1000.0)
scene.add_body(ts.box_mesh((2, 1, 1), (0.2, 0.1, 0.1)), material, position=(0.0, 0.051, 0.0)).add_force([0, 3], (1, 2, 0))
if integrator == "implicit_euler":
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)))
with ts.Simulator(scene, dt=5e-3 if scene.obstacles else 1e-5, integrator=integrator) as sim:
    sim.advance(8)
    assert len(sim.contacts().gap) or not scene.obstacles
    np.save(sys.argv[1], sim.positions())
"""


@pytest.mark.parametrize("integrator", ["symplectic_euler", pytest.param("implicit_euler", marks=pytest.mark.long)])
def test_states_equal_those_of_taichis_public_interface(tmp_path, monkeypatch, integrator):
    environment = os.environ | {"TAISOFT_PUBLIC_TAICHI": "1", "TI_ADVANCED_OPTIMIZATION": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "ignore", "-c", SCRIPT, tmp_path / "public.npy", integrator]
    subprocess.run(command, env=environment, check=True)
    monkeypatch.setattr(sys, "argv", ["", tmp_path / "fast.npy", integrator])
    exec(SCRIPT, {})
    fast, public = np.load(tmp_path / "fast.npy"), np.load(tmp_path / "public.npy")
    assert np.ptp(fast) > 0.1 and np.array_equal(fast, public)


@ti.func
def power(x, n: ti.template()):
    """x^n, by compile-time recursion."""
    result = x
    if ti.static(n > 1):
        result = x * power(x, n - 1)
    return result


class Constant:
    """Has a method that vectors have, too."""

    def sum(self):
        return 2.0


CONSTANT = Constant()


@ti.func
def total(x: ti.template()):
    return x.sum()


@kernel
def call_several_times(x: ti.types.ndarray(), out: ti.types.ndarray()):
    for i in range(x.shape[0]):
        vector = ti.Vector([x[i], 1.0])
        out[i, 0] = power(power(x[i], 3), 2)
        out[i, 1] = total(vector) + total(CONSTANT) + total(2.0 * vector)


@pytest.mark.filterwarnings("ignore:.*Calling non-taichi function")
def test_each_call_is_traced_anew():
    x = np.linspace(0.0, 2.0, 5)
    out = np.zeros((5, 2))
    with opened("f64"):
        call_several_times(x, out)
    assert out == pytest.approx(np.stack([x**6, 3 * (x + 1) + 2], axis=1), rel=1e-15)


ODD = '''
def outer():
    """A text
that begins in the first column."""
# and a comment there
    @ti.func
    def inner(
        x,  # a number
    ):

        return x
    return inner


@ti.func
def last(x): return (
    x
)
'''


def test_the_text_of_a_function_is_found(tmp_path):
    path, scope = tmp_path / "odd.py", {"ti": SimpleNamespace(func=lambda function: function)}
    path.write_text(ODD)
    exec(compile(ODD, path, "exec"), scope)
    found = [one for module in (analytic, sys.modules[__name__]) for one in vars(module).values() if inspect.isfunction(one)]
    for function in (scope["outer"], scope["outer"](), scope["last"], *map(inspect.unwrap, found)):
        lines, first = inspect.getsourcelines(function)
        file, ours, at, _ = source_of(function)
        assert (file, at) == (inspect.getsourcefile(function), first)
        assert ast.dump(ast.parse(textwrap.dedent("".join(lines)))) == ast.dump(ast.parse(source_of(function)[3]))
        assert "".join(ours).strip().startswith("".join(lines).strip())


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


@pytest.mark.parametrize(
    "line",
    [
        *("if x > 0.0: x = 2.0 * x", "y = 1.0 if x > 0.0 else x", "y = [x * k for k in range(3)]", "x += 1.0"),
        *("y = x > 0.0 and x < 1.0", "y = 0.0 < x < 1.0", "y = not (x > 0.0)", "y = max(x, 0.5)", "y = x in (0.0, 1.0)"),
        "y = ti.sqrt(float(x))",
    ],
)
def test_functions_that_need_values_while_tracing_are_rejected(line, tmp_path):
    path, scope = tmp_path / "bad.py", {"ti": ti}
    path.write_text(f"def bad(x):\n    {line}\n    return x\n")
    exec(compile(path.read_text(), path, "exec"), scope)
    with pytest.raises(TypeError, match="^an arithmetic function cannot contain "):
        arithmetic(scope["bad"])(0.5)
