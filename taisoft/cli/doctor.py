"""`taisoft doctor`: what this machine offers and how to get what is missing.

Nothing here can crash the process: Taichi's Vulkan probe, which loads drivers, runs in its own process; CUDA is queried
through its driver library.
"""

import ctypes
import os
import platform
import shutil
import subprocess
import sys
from argparse import Namespace
from importlib import metadata

from taisoft import __version__

REQUIRED = ("taichi", "numpy", "scipy", "meshio", "usd-core", "networkx", "rich")
# package -> the extra that installs it; only benchmarks use other programs, only studies and run_many use a cluster
OPTIONAL = {"wildmeshing": "mesh", "imageio-ffmpeg": "video", "matplotlib": "plot", "viser": "notebook"}
OPTIONAL |= {"pyvista": "pyvista", "distributed": "cluster", "mujoco-core": "robot", "pybullet": "peers", "newton": "peers"}
OPTIONAL |= {"argcomplete": "completion", "gymnasium": "gym"}
KERNEL = "ipykernel"  # of Jupyter, which no extra installs
VULKAN_PROBE = "from taichi._lib import core; print('vulkan', core.with_vulkan())"
PROBE_SECONDS = 60.0  # loading Taichi from a cold disk takes several seconds


def doctor(_: Namespace) -> int:
    """Print one line per finding; always return 0, because a missing part is not an error."""
    lines = [
        ("taisoft", f"{__version__}, Python {platform.python_version()}"),
        ("machine", f"{platform.platform()}, {os.cpu_count()} cores"),
        ("packages", ", ".join(f"{name} {_version(name)}" for name in REQUIRED)),
        *(("optional", f"{name} {_version(name, extra)}") for name, extra in OPTIONAL.items()),
        ("optional", f"{KERNEL} {_version(KERNEL, others='jupyterlab nbconvert')}"),
        ("arch cpu", "yes"),
        ("arch cuda", cuda()),
        ("vulkan", vulkan()),
        ("display", display()),
    ]
    for name, text in lines:
        print(f"{name:<10} {text}")
    return 0


def _version(package: str, extra: str = "", others: str = "") -> str:
    """Return a package's version, or how to install it: by an extra, by other packages, or by itself."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "missing: pip install " + (f"'taisoft[{extra}]'" if extra else others or package)


def cuda() -> str:
    """Return whether the NVIDIA driver offers a device, with its name and the driver's CUDA version."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "no: there is no NVIDIA driver (libcuda.so.1); install it, or use --arch cpu"
    status = driver.cuInit(0)
    if status != 0:
        return f"no: the NVIDIA driver does not start (cuInit returned {status}); see nvidia-smi, or use --arch cpu"
    count, version, name = ctypes.c_int(), ctypes.c_int(), ctypes.create_string_buffer(100)
    driver.cuDeviceGetCount(ctypes.byref(count))
    if count.value == 0:
        return "no: the NVIDIA driver finds no device; use --arch cpu"
    driver.cuDriverGetVersion(ctypes.byref(version))
    driver.cuDeviceGetName(name, len(name), 0)
    return f"yes: {name.value.decode()}, CUDA {version.value // 1000}.{version.value % 1000 // 10}"


def vulkan() -> str:
    """Return whether Taichi finds a Vulkan driver, which windows need."""
    hint = "no window; install a driver (Debian: apt install mesa-vulkan-drivers)"
    try:
        probe = subprocess.run(
            [sys.executable, "-c", VULKAN_PROBE], capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return f"no: the driver did not answer within {PROBE_SECONDS:.0f} s; {hint}"
    if "vulkan True" in probe.stdout:
        return "yes"
    return f"no: {hint}" if "vulkan False" in probe.stdout else f"no: the probe ended with {probe.returncode}; {hint}"


def display() -> str:
    """Return whether there is a display for the live window, or how to get a virtual one."""
    for variable in ("DISPLAY", "WAYLAND_DISPLAY"):
        if os.environ.get(variable):
            return f"yes: {variable}={os.environ[variable]}"
    if shutil.which("xvfb-run"):
        return "no, but a virtual one is available: xvfb-run -a taisoft run SCENE; or use --headless"
    return "no: use --headless, or a virtual one (Debian: apt install xvfb)"
