"""Copies between host and GPU memory, with a driver that copies the host's memory in place of NVIDIA's:

* numbers written are read back, in part too, after all launches;
* a call of the driver that fails is named.
"""

import ctypes
from types import SimpleNamespace

import numpy as np
import pytest
import taichi as ti

from taisoft.backend import arrays, device_memory
from taisoft.errors import SimulationError
from tests.backend.lanes import opened


class Driver(SimpleNamespace):
    """A driver whose calls succeed, except `failing`."""

    def __init__(self, failing: str = ""):
        names = ("cuDeviceGet", "cuDevicePrimaryCtxRetain", "cuCtxSetCurrent")
        super().__init__(**{name: lambda *_, name=name: 100 * (name == failing) for name in names})
        self.failing, self.copied = failing, 0

    def _copy(self, to, source, size, name: str) -> int:
        ctypes.memmove(to.value, source.value, size.value)
        self.copied += size.value
        return 700 * (name == self.failing)

    def cuMemcpyDtoH_v2(self, to, source, size) -> int:
        return self._copy(to, source, size, "cuMemcpyDtoH")

    def cuMemcpyHtoD_v2(self, to, source, size) -> int:
        return self._copy(to, source, size, "cuMemcpyHtoD")


@pytest.fixture
def start(monkeypatch):
    """Make `Driver` the driver; arrays are Taichi's own ones, as on CUDA."""

    def replace(failing: str = "") -> Driver:
        driver = Driver(failing)
        monkeypatch.setattr(device_memory.ctypes, "CDLL", lambda name: driver)
        device_memory.driver.cache_clear()
        return driver

    with opened("f64"):
        yield replace
    device_memory.driver.cache_clear()


@pytest.mark.parametrize(("dtype", "shape", "n"), [(ti.f64, (5,), 3), (ti.i32, (4, 2), 0), (ti.f32, (0,), 3), (ti.u8, (1,), 0)])
def test_arrays_are_read_and_written(start, dtype, shape, n):
    driver, array = start(), arrays.Array(dtype, shape, n, on_host=False)
    data = np.random.default_rng(1).integers(0, 99, array.full_shape).astype(arrays.DTYPES[dtype])
    array.from_numpy(data)
    assert np.array_equal(array.to_numpy(), data) and array.to_numpy().dtype == data.dtype
    assert np.array_equal(array.to_numpy(2), data[:2])
    assert driver.copied == 3 * data.nbytes + data[:2].nbytes
    if data.size:
        array[0] = 7
        assert (array[0] == np.full_like(data[0], 7)).all() and np.array_equal(array.to_numpy()[1:], data[1:])
    array.release()
    assert array.to_numpy().size == 0


@pytest.mark.parametrize("failing", ["cuDeviceGet", "cuDevicePrimaryCtxRetain", "cuCtxSetCurrent", "cuMemcpyDtoH"])
def test_failures_are_named(start, failing):
    start(failing)
    array = arrays.Array(ti.f32, (3,), 0, on_host=False)
    with pytest.raises(SimulationError, match=f"^the NVIDIA driver failed: {failing} returned [17]00$"):
        array.to_numpy()
