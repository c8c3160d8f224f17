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
def _driver() -> tuple[ctypes.CDLL, ctypes.c_void_p]:
    """The driver and the context that Taichi uses: the primary one of the first device."""
    driver = ctypes.CDLL("libcuda.so.1")
    device, context = ctypes.c_int(), ctypes.c_void_p()
    _check("cuDeviceGet", driver.cuDeviceGet(ctypes.byref(device), 0))
    _check("cuDevicePrimaryCtxRetain", driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), device))
    return driver, context


def _check(what: str, status: int) -> None:
    if status != 0:
        raise SimulationError(f"the NVIDIA driver failed: {what} returned {status}")


def _ready(array: ti.Ndarray) -> tuple[ctypes.CDLL, ctypes.c_uint64]:
    """The driver, after all launches have ended and with its context in use, and the address of an array of Taichi's."""
    ti.sync()
    driver, context = _driver()
    _check("cuCtxSetCurrent", driver.cuCtxSetCurrent(context))
    return driver, ctypes.c_uint64(impl.get_runtime().prog.get_ndarray_data_ptr_as_int(array.arr))


def read(array: ti.Ndarray, out: np.ndarray) -> None:
    """Copy the first numbers of an array of Taichi's to `out`, contiguous and of the same type. Raises SimulationError."""
    driver, address = _ready(array)
    size = ctypes.c_size_t(out.nbytes)
    _check("cuMemcpyDtoH", driver.cuMemcpyDtoH_v2(ctypes.c_void_p(out.ctypes.data), address, size))


def write(array: ti.Ndarray, data: np.ndarray) -> None:
    """Copy `data`, contiguous and of the same type, to the start of an array of Taichi's. Raises SimulationError."""
    driver, address = _ready(array)
    size = ctypes.c_size_t(data.nbytes)
    _check("cuMemcpyHtoD", driver.cuMemcpyHtoD_v2(address, ctypes.c_void_p(data.ctypes.data), size))
