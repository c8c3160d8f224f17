"""All that taisoft uses of Taichi 1.7.4 beyond its public interface; a later version must be checked against this list."""

from taichi._lib import core
from taichi.lang import impl, kernel_impl
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
from taichi.lang.enums import AutodiffMode
from taichi.lang.expr import Expr
from taichi.lang.kernel_impl import Kernel, template
from taichi.types import ndarray_type, primitive_types
from taichi.ui.utils import get_field_info

__all__ = [
    "ASTTransformerContext",
    "AutodiffMode",
    "Expr",
    "Kernel",
    "core",
    "get_field_info",
    "impl",
    "kernel_impl",
    "ndarray_type",
    "primitive_types",
    "template",
]
