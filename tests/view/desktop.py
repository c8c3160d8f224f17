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
    """A virtual display with one child process that opens a window; `say` waits for what the child prints."""

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

    def wait_for(self, condition, what):
        end = time.monotonic() + 60
        while not condition():
            assert time.monotonic() < end, f"no {what}: {self.log.read_text()}"
            time.sleep(0.05)

    def repeat(self, action, condition, what):
        """Act until the condition holds: a window does not see of the mouse what is over before its next picture."""
        end = time.monotonic() + 60
        while time.monotonic() < end:
            action()
            for _ in range(60):
                if condition():
                    return
                time.sleep(0.05)
        raise AssertionError(f"no {what}: {self.log.read_text()}")

    def printed(self):
        """Words of the child so far, of lines that are whole."""
        text = self.log.read_text()
        return text[: text.rfind("\n") + 1].split()

    def picture(self):
        """The whole screen, uint8 (height, width, 3)."""
        path = self.folder / "screen.ppm"
        self.display.tool("import", "-window", "root", "-depth", "8", path)
        _, size, _, pixels = path.read_bytes().split(b"\n", 3)
        width, height = map(int, size.split())
        return np.frombuffer(pixels, np.uint8).reshape(height, width, 3)

    def last(self, key):
        """The last whole line of the child that starts with key, as a list of words; empty without one."""
        text = self.log.read_text()
        found = [line.split() for line in text[: text.rfind("\n") + 1].splitlines() if line.startswith(key)]
        return found[-1] if found else []

    def close(self):
        self.child.kill()
        self.child.wait()
        self.display.close()
