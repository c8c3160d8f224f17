"""Copies between the host and a GPU's memory by NVIDIA's driver.

Taichi's own copies launch kernels, and take ten times as long for the few numbers that a step reads.
"""

import ctypes
import functools

import numpy as np
import taichi as ti

from taisoft.backend.private import impl
from taisoft.errors import SimulationError


@functools.cache
def driver() -> tuple[ctypes.CDLL, ctypes.c_void_p]:
    """The driver and the context that Taichi uses: the primary one of the first device."""
    library = ctypes.CDLL("libcuda.so.1")
    device, context = ctypes.c_int(), ctypes.c_void_p()
    _check("cuDeviceGet", library.cuDeviceGet(ctypes.byref(device), 0))
    _check("cuDevicePrimaryCtxRetain", library.cuDevicePrimaryCtxRetain(ctypes.byref(context), device))
    return library, context


def _check(what: str, status: int) -> None:
    if status != 0:
        raise SimulationError(f"the NVIDIA driver failed: {what} returned {status}")


def _ready(array: ti.Ndarray) -> tuple[ctypes.CDLL, ctypes.c_uint64]:
    """The driver, after all launches have ended and with its context in use, and the address of an array of Taichi's."""
    ti.sync()
    library, context = driver()
    _check("cuCtxSetCurrent", library.cuCtxSetCurrent(context))
    return library, ctypes.c_uint64(impl.get_runtime().prog.get_ndarray_data_ptr_as_int(array.arr))


def read(array: ti.Ndarray, out: np.ndarray) -> None:
    """Copy the first numbers of an array of Taichi's to `out`, contiguous and of the same type. Raises SimulationError."""
    library, address = _ready(array)
    size = ctypes.c_size_t(out.nbytes)
    _check("cuMemcpyDtoH", library.cuMemcpyDtoH_v2(ctypes.c_void_p(out.ctypes.data), address, size))


def write(array: ti.Ndarray, data: np.ndarray, offset: int = 0) -> None:
    """Copy `data`, contiguous and of the same type, into an array of Taichi's from a byte on. Raises SimulationError."""
    library, address = _ready(array)
    size = ctypes.c_size_t(data.nbytes)
    _check(
        "cuMemcpyHtoD", library.cuMemcpyHtoD_v2(ctypes.c_uint64(address.value + offset), ctypes.c_void_p(data.ctypes.data), size)
    )
