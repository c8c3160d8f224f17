"""Taichi's runtime, its arrays and how kernels are launched: what touches Taichi's own state or private parts."""

import inspect

# While Taichi is imported, it asks for the source of every function that it decorates, and Python then for the function's module,
# among all that are loaded: a third of a second. The source is found without.
_getmodule, inspect.getmodule = inspect.getmodule, lambda *_: None
try:
    import taichi  # noqa: F401
finally:
    inspect.getmodule = _getmodule
