"""Faster tracing: cache what Taichi recomputes at each decoration and at each call of a function in a kernel.

For every decorated function Taichi uses Python's source tools to find out whether it is defined in a class. It reads, wraps,
splits and parses a function's source at each of its calls in a kernel, and for every syntax node it formats a source excerpt for
messages that are seldom needed. Together this takes longer than building the code. Without the excerpts, messages still name the
file, the function and the line of the statement. Purely arithmetic functions need no tracing at all: see `arithmetic`. This
relies on Taichi 1.7.4, the version that taisoft requires; with any other, or with TAISOFT_PUBLIC_TAICHI set, Taichi is left
unpatched, and results are the same.
"""

import ast
import functools
import linecache
import os
import sys
import textwrap
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
import taichi as ti

from taisoft.backend.private import ASTTransformer, ASTTransformerContext, Expr, expr, impl, kernel_impl, transform_tree

FAST_TRACING = ti.__version__ == (1, 7, 4) and not os.environ.get("TAISOFT_PUBLIC_TAICHI")

COMPARISONS = (ast.Lt, ast.LtE, ast.Gt, ast.GtE, ast.Eq, ast.NotEq)  # comparisons that Taichi's expressions support
# Python's builtins that need the value of a number
VALUE_BUILTINS = ("max", "min", "bool", "int", "float", "round", "any", "all", "sorted")

_spare: dict[Callable, list[ast.Module]] = defaultdict(list)  # syntax trees of a function, apart from those that tracing is using


def _inside_class(level_of_class_stackframe: int) -> bool:
    """Whether the calling decorator is used in a class body, whose frame defines __qualname__."""
    return "__qualname__" in sys._getframe(level_of_class_stackframe - 1).f_locals


@functools.cache
def source_of(function: Callable) -> tuple[str, list[str], int, str]:
    """File, lines, number of the first line, and the dedented text of a function."""
    file, first = function.__code__.co_filename, function.__code__.co_firstlineno
    lines = linecache.getlines(file)[first - 1 :]
    lines = lines[: _end(lines)]
    return file, lines, first, textwrap.dedent("".join(lines))


def _end(lines: list[str]) -> int:
    """Number of the lines of a function with which these begin, decorators included, by their indentation.

    Comments do not end a function, nor do the brackets that close its signature, nor lines of a text in three quotes.
    """
    indent, is_inside, quotes = len(lines[0]) - len(lines[0].lstrip()), False, 0
    for k, line in enumerate(lines):
        text = line.lstrip()
        if is_inside and text and text[0] not in "#)]}" and len(line) - len(text) <= indent and quotes % 2 == 0:
            return k
        quotes += line.count('"""') + line.count("'''")
        is_inside |= text.startswith("def ")
    return len(lines)


def _tree_and_context(
    self, excluded_parameters=(), is_kernel=True, arg_features=None, args=None, ast_builder=None, is_real_function=False
):
    """Replacement of Taichi's function of this name: a syntax tree, which tracing modifies, and its context."""
    file, lines, first, text = source_of(self.func)
    spare = [] if is_kernel or is_real_function else _spare[self.func]  # those are traced once, which removes their arguments
    tree = spare.pop() if spare else ast.parse(text)
    tree.body[0].decorator_list = []
    names = kernel_impl._get_global_vars(self.func)
    if is_kernel or is_real_function:
        for k in self.template_slot_locations:
            names[self.arguments[k].name] = args[k]
    context = ASTTransformerContext(
        excluded_parameters=excluded_parameters,
        is_kernel=is_kernel,
        func=self,
        arg_features=arg_features,
        global_vars=names,
        argument_data=args,
        src=lines,
        start_lineno=first,
        file=file,
        ast_builder=ast_builder,
        is_real_function=is_real_function,
    )
    context.built = []  # syntax nodes
    return tree, context


def _traced(tree: ast.Module, context: ASTTransformerContext) -> Any:
    """Trace a tree, then free it of what Taichi has put there, so that the next call of its function can have it."""
    try:
        return transform_tree(tree, context)
    except BaseException:
        if context.is_real_function:  # which Taichi has listed as compiled: the next launch compiles it, under another number
            context.func.compiled, context.func.taichi_functions = None, {}
            context.func.func_id += 1_000_000
        raise
    finally:
        if not (context.is_kernel or context.is_real_function):
            for node in context.built:
                node.__dict__.pop("ptr", None)
                node.__dict__.pop("caller", None)
            _spare[context.func.func].append(tree)


_build_any = ASTTransformer.__call__


def _build(self, context: ASTTransformerContext, node: ast.AST) -> Any:
    """Build a syntax node. What is part of a statement gets the statement's position, not one of its own."""
    context.built.append(node)
    build = _BUILDERS.get(type(node))
    return _build_any(self, context, node) if build is None else build(context, node)


_BUILDERS = {
    kind: build
    for name in dir(ast)
    if isinstance(kind := getattr(ast, name), type)
    and not issubclass(kind, (ast.mod, ast.stmt))
    and (build := getattr(ASTTransformer, f"build_{name}", None)) is not None
}


@functools.cache
def _integer_range(dtype: type) -> tuple[int, int]:
    return np.iinfo(dtype).min, np.iinfo(dtype).max


def _check_in_range(dtype: type, value: int) -> bool:
    low, high = _integer_range(dtype)
    return low <= value <= high


def _position(context: ASTTransformerContext, node) -> str:
    """File, line and function of a syntax node, for Taichi's messages. Code generated by `launching` keeps its source's lines."""
    file, line = context.file.partition("#")[0], node.lineno + context.lineno_offset
    return f'File "{file}", line {line}, in {context.func.func.__name__}:\n'


class _BindAssignments(ast.NodeTransformer):
    """Turn `x = f` into `x = _bind(f)`. Raises TypeError for what Python would evaluate while tracing, unless in `ti.static`."""

    def visit_Assign(self, node: ast.Assign) -> ast.Assign:
        self.generic_visit(node)
        node.value = ast.Call(ast.Name("_bind", ast.Load()), [node.value], [])
        return node

    def visit_Call(self, node: ast.Call) -> ast.Call:
        if ast.unparse(node.func) == "ti.static":  # evaluated by Python, as in any kernel
            return node
        if isinstance(node.func, ast.Name) and node.func.id in VALUE_BUILTINS:
            raise TypeError(f"an arithmetic function cannot contain '{ast.unparse(node)}'")
        return self.generic_visit(node)

    def generic_visit(self, node: ast.AST) -> ast.AST:
        decides = getattr(node, "test", None) or (node.iter if isinstance(node, (ast.For, ast.comprehension)) else None)
        is_static = isinstance(decides, ast.Call) and ast.unparse(decides.func) == "ti.static"
        is_chain = isinstance(node, ast.Compare) and (len(node.ops) > 1 or not isinstance(node.ops[0], COMPARISONS))
        is_not = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not)
        if isinstance(node, (ast.BoolOp, ast.AugAssign)) or is_chain or is_not or (decides is not None and not is_static):
            raise TypeError(f"an arithmetic function cannot contain '{ast.unparse(node)}'")
        return super().generic_visit(node)


def _argument(value: Any) -> Any:
    """Bind an argument to variables of the kernel, unless it is one already, because a function may use it several times."""
    if isinstance(value, (list, tuple)):
        return [_argument(item) for item in value]
    return value if not isinstance(value, Expr) or value.ptr.is_lvalue() else impl.expr_init(value)


@functools.cache
def _as_python(function: Callable) -> Callable:
    """The function as plain Python that binds each value it assigns to a variable of the kernel."""
    _, _, first, text = source_of(function)
    tree = ast.parse("def _make(_bind):\n    pass")
    definition = _BindAssignments().visit(ast.increment_lineno(ast.parse(text), first - 1).body[0])
    definition.decorator_list = []
    tree.body[0].body = [definition, ast.Return(ast.Name(definition.name, ast.Load()))]
    defined: dict[str, Callable] = {}
    exec(compile(ast.fix_missing_locations(tree), function.__code__.co_filename, "exec"), function.__globals__, defined)
    return defined["_make"](impl.expr_init)


def arithmetic(function: Callable) -> Callable:
    """As `ti.func`, for functions of numbers, vectors and lists of them that only assign new names and return.

    Python runs such a function directly on Taichi expressions, in a third of the time of tracing. It may contain calls,
    comprehensions, and `ti.static` loops and branches, but no run-time loops or branches and no ti.Vector.
    """
    if not FAST_TRACING:
        return ti.func(function)

    @functools.wraps(function)
    def build(*arguments):
        return _as_python(function)(*[_argument(argument) for argument in arguments])

    build._is_taichi_function = False  # present: no warning from Taichi; False: not traced
    return build


def untraced(function: Callable) -> Callable:
    """Mark a function, or a method, that Python runs while a kernel is traced; it may call `ti.func` and `arithmetic` functions.

    Values that it uses several times it should get from these or as arguments: an expression is not bound to a variable here.
    """
    function._is_taichi_function = False  # present: no warning from Taichi; False: not traced
    return function


if FAST_TRACING:
    kernel_impl._inside_class = _inside_class
    kernel_impl._get_tree_and_ctx = _tree_and_context
    kernel_impl.transform_tree = _traced
    ASTTransformer.__call__ = _build
    expr._check_in_range = _check_in_range
    ASTTransformerContext.get_pos_info = _position
