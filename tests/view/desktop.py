"""A virtual display for tests of windows."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.virtual_display import VirtualDisplay, missing_tools

ROOT = Path(__file__).resolve().parents[2]
TOOLS = missing_tools("import")


class Desktop:
    """A virtual display with one child process that opens a window."""

    def __init__(self, folder, code):
        self.folder = folder
        self.display = VirtualDisplay()
        self.log = folder / "log"
        with open(self.log, "w") as log:
            self.child = subprocess.Popen(
                [sys.executable, "-c", code], cwd=ROOT, env=self.display.environment, stdout=log, stderr=subprocess.STDOUT
            )

    def xdotool(self, *arguments):
        self.display.tool("xdotool", *arguments)

    def wait_for(self, condition, what, action=None):
        """Until the condition holds; act every 3 s: a window does not see of the mouse what is over before its next picture."""
        begin, n = time.monotonic(), 0
        while not condition():
            assert time.monotonic() < begin + 60, f"no {what}: {self.log.read_text()}"
            if action is not None and n % 60 == 0:
                action()
            time.sleep(0.05)
            n += 1

    def picture(self):
        """The whole screen, uint8 (height, width, 3)."""
        path = self.folder / "screen.ppm"
        self.display.tool("import", "-window", "root", "-depth", "8", path)
        _, size, _, pixels = path.read_bytes().split(b"\n", 3)
        width, height = map(int, size.split())
        return np.frombuffer(pixels, np.uint8).reshape(height, width, 3)

    def last(self, key):
        """Words of the last whole line of the child that starts with key."""
        whole = self.log.read_text().rpartition("\n")[0].splitlines()
        return next((line.split() for line in reversed(whole) if line.startswith(key)), [])

    def close(self):
        self.child.kill()
        self.child.wait()
        self.display.close()
