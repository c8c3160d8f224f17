"""Quicker tracing: what Taichi finds out anew at each decoration and at each call of a function in a kernel, found once.

Taichi asks of every decorated function whether it stands in a class, through Python's source tools; it reads, wraps and splits a
function's source at each of its calls in a kernel; and for every syntax node it formats an excerpt of the source for messages
that are seldom needed. Together that takes longer than building the code. Without the excerpts messages still name file, line and
function. Functions of nothing but arithmetic need no tracing at all: see `arithmetic`. This rests on 1.7.4, the version that
taisoft asks for; with any other, or with TAISOFT_PUBLIC_TAICHI set, Taichi stays as it is, and results are the same.
"""

import ast
import functools
import linecache
import os
import sys
import textwrap
from collections.abc import Callable
from typing import Any

import taichi as ti
from taichi.lang import impl, kernel_impl
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
from taichi.lang.expr import Expr

QUICK = ti.__version__ == (1, 7, 4) and not os.environ.get("TAISOFT_PUBLIC_TAICHI")

ORDERS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE, ast.Eq, ast.NotEq)  # comparisons that Taichi's expressions know
DECIDING = ("max", "min", "bool", "int", "float", "round", "any", "all", "sorted")  # Python's own ask what a number is


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Whether the decorator that asks is used in the body of a class, which runs with a name of its own."""
    return "__qualname__" in sys._getframe(level_of_class_stackframe - 1).f_locals


@functools.cache
def _ends(file: str) -> dict[int, int]:
    """First line of each function in a file, decorators counted, to its last one."""
    found = {}
    for node in ast.walk(ast.parse("".join(linecache.getlines(file)))):
        if isinstance(node, ast.FunctionDef):
            found[min([node.lineno, *[one.lineno for one in node.decorator_list]])] = node.end_lineno
    return found


@functools.cache
def source_of(function: Callable) -> tuple[str, list[str], int, str]:
    """File, lines, number of the first, and their text without the indentation that all share."""
    file, first = function.__code__.co_filename, function.__code__.co_firstlineno
    lines = linecache.getlines(file)[first - 1 : _ends(file)[first]]
    return file, lines, first, textwrap.dedent("".join(lines))


def _tree_and_context(
    self, excluded_parameters=(), is_kernel=True, arg_features=None, args=None, ast_builder=None, is_real_function=False
):  # fmt: skip
    """The function's syntax, which tracing writes into, and what else it needs; as Taichi's own."""
    file, lines, first, text = source_of(self.func)
    tree = ast.parse(text)
    tree.body[0].decorator_list = []
    names = kernel_impl._get_global_vars(self.func)
    if is_kernel or is_real_function:
        for k in self.template_slot_locations:
            names[self.arguments[k].name] = args[k]
    return tree, ASTTransformerContext(
        excluded_parameters=excluded_parameters, is_kernel=is_kernel, func=self, arg_features=arg_features, global_vars=names,
        argument_data=args, src=lines, start_lineno=first, file=file, ast_builder=ast_builder, is_real_function=is_real_function,
    )  # fmt: skip


def _position(context: ASTTransformerContext, node) -> str:
    """File, line and function of a syntax node, for Taichi's messages. What `launching` generates lies where its source does."""
    file, line = context.file.partition("#")[0], node.lineno + context.lineno_offset
    return f'File "{file}", line {line}, in {context.func.func.__name__}:\n'


class _Keep(ast.NodeTransformer):
    """`x = f` becomes `x = _keep(f)`; what Python would decide while tracing, unless by `ti.static`, raises TypeError."""

    def visit_Assign(self, node: ast.Assign) -> ast.Assign:
        self.generic_visit(node)
        node.value = ast.Call(ast.Name("_keep", ast.Load()), [node.value], [])
        return node

    def visit_Call(self, node: ast.Call) -> ast.Call:
        if ast.unparse(node.func) == "ti.static":  # Python's own, as in any kernel
            return node
        if isinstance(node.func, ast.Name) and node.func.id in DECIDING:
            raise TypeError(f"an arithmetic function cannot hold '{ast.unparse(node)}'")
        return self.generic_visit(node)

    def generic_visit(self, node: ast.AST) -> ast.AST:
        decides = getattr(node, "test", None) or (node.iter if isinstance(node, (ast.For, ast.comprehension)) else None)
        is_static = isinstance(decides, ast.Call) and ast.unparse(decides.func) == "ti.static"
        is_chain = isinstance(node, ast.Compare) and (len(node.ops) > 1 or not isinstance(node.ops[0], ORDERS))
        is_not = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)
        if isinstance(node, (ast.BoolOp, ast.AugAssign)) or is_chain or is_not or (decides is not None and not is_static):
            raise TypeError(f"an arithmetic function cannot hold '{ast.unparse(node)}'")
        return super().generic_visit(node)


def _argument(value: Any) -> Any:
    """An argument as a function may use it several times: what is not a variable yet becomes one."""
    if isinstance(value, (list, tuple)):
        return [_argument(one) for one in value]
    return value if not isinstance(value, Expr) or value.ptr.is_lvalue() else impl.expr_init(value)


@functools.cache
def _as_python(function: Callable) -> Callable:
    """The function, which makes a variable of the kernel of each value that it gives a name."""
    _, _, first, text = source_of(function)
    tree = ast.parse("def _make(_keep):\n    pass")
    own = _Keep().visit(ast.increment_lineno(ast.parse(text), first - 1).body[0])
    own.decorator_list = []
    tree.body[0].body = [own, ast.Return(ast.Name(own.name, ast.Load()))]
    made: dict[str, Callable] = {}
    exec(compile(ast.fix_missing_locations(tree), function.__code__.co_filename, "exec"), function.__globals__, made)
    return made["_make"](impl.expr_init)


def arithmetic(function: Callable) -> Callable:
    """As `ti.func`, for functions of numbers, vectors and lists of them that only assign new names and return.

    Python runs such a function on the expressions that its arguments are, in a third of the time that tracing takes. It may hold
    calls, comprehensions, and loops and branches by `ti.static`; none at run time, and no ti.Vector.
    """
    if not QUICK:
        return ti.func(function)

    @functools.wraps(function)
    def build(*arguments):
        return _as_python(function)(*[_argument(one) for one in arguments])

    build._is_taichi_function = False  # that it is there says that Taichi need not warn, and False that it is not traced
    return build


if QUICK:
    kernel_impl._inside_class = _inside_class
    kernel_impl._get_tree_and_ctx = _tree_and_context
    ASTTransformerContext.get_pos_info = _position
