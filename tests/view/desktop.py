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

    def tool(self, *arguments):
        self.display.tool(*arguments)

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

    @staticmethod
    def pause(seconds):
        time.sleep(seconds)

    def printed(self):
        """Words of the child so far, of lines that are whole."""
        text = self.log.read_text()
        return text[: text.rfind("\n") + 1].split()

    def picture(self):
        """The whole screen, uint8 (height, width, 3)."""
        path = self.folder / "screen.ppm"
        self.tool("import", "-window", "root", "-depth", "8", str(path))
        data = path.read_bytes()
        size, at = [], 2  # "P6", width, height, 255, then the pixels
        while len(size) < 3:
            end = at + 1
            while not data[end : end + 1].isspace():
                end += 1
            size.append(int(data[at:end]))
            at = end
        return np.frombuffer(data, np.uint8, offset=at + 1).reshape(size[1], size[0], 3)

    def last(self, key):
        """The last whole line of the child that starts with key, as a list of words; empty without one."""
        text = self.log.read_text()
        found = [line.split() for line in text[: text.rfind("\n") + 1].splitlines() if line.startswith(key)]
        return found[-1] if found else []

    def drag(self, start, way, hold=0.0, button=1):
        """Press a button, by default the left one, at start, move it in parts, hold it [s]; it stays pressed."""
        self.tool("xdotool", "mousemove", *map(str, start), "mousedown", str(button))
        time.sleep(0.2)
        for _ in range(5):
            time.sleep(0.1)
            self.tool("xdotool", "mousemove_relative", "--", *(str(pixels // 5) for pixels in way))
        time.sleep(hold)

    def close(self):
        self.child.kill()
        self.child.wait()
        self.display.close()
