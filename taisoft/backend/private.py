"""All that taisoft uses of Taichi 1.7.4 beyond its public interface; a later version must be checked against this list.

Also `func_id`, `compiled` and `taichi_functions` of `Func` (`runtime`, `tracing`), and the memory of contexts (`pack`).
"""

from taichi._lib import core as core
from taichi.lang import expr as expr
from taichi.lang import impl as impl
from taichi.lang import kernel_impl as kernel_impl
from taichi.lang.any_array import AnyArray as AnyArray
from taichi.lang.ast.ast_transformer import ASTTransformer as ASTTransformer
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext as ASTTransformerContext
from taichi.lang.ast.transform import transform_tree as transform_tree
from taichi.lang.enums import AutodiffMode as AutodiffMode
from taichi.lang.expr import Expr as Expr
from taichi.lang.kernel_impl import Kernel as Kernel
from taichi.lang.kernel_impl import template as template
from taichi.lang.matrix import make_matrix as make_matrix
from taichi.types import ndarray_type as ndarray_type
from taichi.types import primitive_types as primitive_types
from taichi.ui.utils import get_field_info as get_field_info
