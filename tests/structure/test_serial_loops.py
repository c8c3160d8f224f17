"""No loop over n entries runs on one thread of a GPU, where an entry takes microseconds.

A loop under `ti.loop_config(serialize=True)` may repeat a constant number of operations. Entries belong into parallel loops, into
loops of teams (`serialize=team.alone`), or into loops that are serial on the CPU only (`serialize=model.on_cpu`, or behind a
`ti.static` of that). The functions of CPU_ONLY never run on the GPU path.
"""

import ast
from collections.abc import Iterator
from functools import cache

from tests.structure.test_source import FILES, PACKAGE, tree

SWEEPS = "sweeps of Gauss-Seidel, in the order of the nodes, are the CPU's preconditioner"
BANDED = "the preconditioner of nearly incompressible bodies is the CPU's: it solves with a banded matrix"
DIRECT = "direct solves are the CPU's"
CPU_ONLY = {  # (file, function): why it does not run on the GPU path, or why it may
    **{("linear/gauss_seidel.py", name): SWEEPS for name in ("iterate_shared", "run_alone", "start", "take_step")},
    ("linear/sweep_order.py", "find_last"): SWEEPS,
    **{("linear/volumes.py", name): BANDED for name in ("apply", "prepare_volumes", "correct_volumes", "step_with_volumes")},
    **{("linear/factor.py", name): DIRECT for name in ("apply", "substitute_once")},
    **{("dynamics/delassus.py", name): DIRECT for name in ("_list_contacts", "_fill_rows", "begin_direct", "end_direct")},
    ("dynamics/delassus.py", "move_directly"): DIRECT,
    ("dynamics/frame_factors.py", "_set_factors"): "the GPU path has the factors of the diagonal",
    ("linear/coarse_correction.py", "correct"): "multigrid is the CPU's, beside Gauss-Seidel",
    ("dynamics/explicit.py", "advance_alone"): "many sub-steps of small models on one CPU thread",
    ("contact/past.py", "enter_past"): "doubles a number until it is large enough",
    ("collision/reduction.py", "_fill_cells"): "doubles a number until it is large enough",
    **{("view/raster.py", name): "draws pictures, outside of steps" for name in ("set_up", "enlist")},
}
ON_CPU = ("on_cpu", "serial")  # attributes that are true on the CPU path only


def is_func(node: ast.AST) -> bool:
    """Whether a definition is code of kernels."""
    return isinstance(node, ast.FunctionDef) and any(
        "func" in (d := ast.unparse(x)) or "kernel" in d for x in node.decorator_list
    )


@cache
def functions() -> dict[str, list[tuple[str, ast.FunctionDef]]]:
    """Kernel code by name, with its file: functions of one name are not distinguished, nor are methods."""
    found = {}
    for path in FILES:
        if "import taichi as ti" in path.read_text(encoding="utf-8"):
            for node in tree(path).body:
                for inner in getattr(node, "body", []) if isinstance(node, ast.ClassDef) else [node]:
                    if is_func(inner):
                        found.setdefault(inner.name, []).append((str(path.relative_to(PACKAGE)), inner))
    return found


def is_constant(bound: ast.expr) -> bool:
    """Whether a bound of a range is a number or a constant of a module."""
    return isinstance(bound, ast.Constant) or (isinstance(bound, ast.Name) and bound.id.isupper())


def repeats(node: ast.AST) -> bool:
    """Whether a node is a loop that runs as often as data demand."""
    if isinstance(node, ast.While):
        return True
    if not isinstance(node, ast.For) or not isinstance(node.iter, ast.Call):
        return False
    return called(node.iter) == "range" and not all(map(is_constant, node.iter.args))


def is_on_cpu(test: ast.expr) -> bool:
    """Whether a condition holds on the CPU path only."""
    if isinstance(test, ast.BoolOp) and isinstance(test.op, ast.And):
        return any(map(is_on_cpu, test.values))
    return isinstance(test, ast.Attribute) and test.attr in ON_CPU


def branches(node: ast.If) -> list[ast.stmt]:
    """The statements of a condition that the GPU path may run."""
    if isinstance(node.test, ast.Call) and ast.unparse(node.test.func) == "ti.static":
        (test,) = node.test.args
        if is_on_cpu(test):
            return node.orelse
        if isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not) and is_on_cpu(test.operand):
            return node.body
    return node.body + node.orelse


def parts(node: ast.AST) -> Iterator[ast.AST]:
    """A node and those below it that the GPU path may run."""
    yield node
    children = [node.test, *branches(node)] if isinstance(node, ast.If) else ast.iter_child_nodes(node)
    for child in children:
        yield from parts(child)


def called(node: ast.AST) -> str:
    """The name of what a node calls, "" if it is no call, or one of Taichi."""
    function = node.func if isinstance(node, ast.Call) else None
    if isinstance(function, ast.Attribute):
        return "" if isinstance(function.value, ast.Name) and function.value.id == "ti" else function.attr
    return function.id if isinstance(function, ast.Name) else ""


@cache
def long_functions() -> set[str]:
    """Names of kernel code that contains a loop of run-time length, or calls what does."""
    nodes = {
        name: [part for _, node in defined if "func" in ast.unparse(node.decorator_list[0]) for part in parts(node)]
        for name, defined in functions().items()
    }
    found, before = {name for name, own in nodes.items() if any(map(repeats, own))}, set()
    while found != before:
        before = set(found)
        found |= {name for name, own in nodes.items() if not before.isdisjoint(map(called, own))}
    return found


def is_long(node: ast.AST) -> bool:
    """Whether a node is such a loop, or the call of a function that contains one."""
    return repeats(node) or called(node) in long_functions()


def blocks(node: ast.AST) -> Iterator[list[ast.stmt]]:
    """All lists of statements below a node that the GPU path may run."""
    for part in parts(node):
        if isinstance(part, ast.If):
            yield branches(part)
        elif isinstance(body := getattr(part, "body", None), list):
            yield body


def serial_loops(function: ast.AST) -> list[int]:
    """Lines of loops that one GPU thread runs over entries."""
    found = []
    for block in blocks(function):
        for config, loop in zip(block, block[1:]):
            is_config = isinstance(config, ast.Expr) and ast.unparse(config).startswith("ti.loop_config(serialize=True")
            if is_config and any(map(is_long, parts(loop))):
                found.append(loop.lineno)
    return found


def test_no_loop_over_entries_runs_on_one_gpu_thread():
    found = []
    for name, defined in functions().items():
        for file, node in defined:
            if (file, name) not in CPU_ONLY:
                found += [f"{file}:{line} {name}" for line in serial_loops(node)]
    assert not found, "\n".join(found)
    assert all(any(file == where for where, _ in functions().get(name, ())) for file, name in CPU_ONLY)


SNIPPETS = {  # one GPU thread runs a loop over entries
    "for c in range(n): f(c)": True,
    "for c in range(N): f(c)": False,
    "for _ in range(1):\n    for c in range(n): f(c)": True,
    "for _ in range(1):\n    for c in range(3): f(c)": False,
    "for _ in range(1):\n    for c in ti.static(range(n)): f(c)": False,
    "for _ in range(1):\n    while f(0): f(1)": True,
    "for _ in range(1): x[0] = sum_before(x, n)": True,
    "for _ in range(1): x[0] = contact_offset_of(x, 0, 1)": False,
    "for _ in range(1):\n    if ti.static(m.on_cpu):\n        for c in range(n): f(c)": False,
    "for _ in range(1):\n    if ti.static(not m.on_cpu):\n        for c in range(n): f(c)": True,
}


def test_what_is_found():
    for loop, is_found in SNIPPETS.items():
        assert bool(serial_loops(ast.parse(f"ti.loop_config(serialize=True)\n{loop}"))) == is_found, loop
    behind = "if ti.static(m.on_cpu):\n    ti.loop_config(serialize=True)\n    for c in range(n): f(c)"
    assert not serial_loops(ast.parse(behind)) and serial_loops(ast.parse(behind.replace("on_cpu", "damped")))
