"""Dense algebra on one thread: the matrices are small, threads that wait for work take it from the kernels', and sums must not
depend on their number."""

import functools
from contextlib import AbstractContextManager

from threadpoolctl import ThreadpoolController

_controller = functools.cache(ThreadpoolController)  # looks for loaded libraries, once


def one_thread() -> AbstractContextManager:
    """Context in which BLAS and LAPACK use one thread."""
    return _controller().limit(limits=1, user_api="blas")
