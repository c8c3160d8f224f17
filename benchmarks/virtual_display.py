"""A virtual display for windows, and the mouse and keyboard on it. Needs Xvfb and xdotool (Debian: xvfb, xdotool)."""

import os
import shutil
import subprocess

from taisoft.errors import OutputError

TOOLS = ("Xvfb", "xdotool")
SCREEN = "1280x760x24"


def missing_tools(*more: str) -> list[str]:
    """Names of those of TOOLS, and more, that are not installed."""
    return [tool for tool in (*TOOLS, *more) if shutil.which(tool) is None]


class VirtualDisplay:
    """An X server in memory. environment: variables of processes that use it. Raises OutputError if a tool is missing."""

    def __init__(self) -> None:
        missing = missing_tools()
        if missing:
            raise OutputError(f"a virtual display needs {' and '.join(missing)} (Debian: xvfb, xdotool)")
        read, write = os.pipe()
        command = ["Xvfb", "-displayfd", str(write), "-screen", "0", SCREEN]
        self._server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
        os.close(write)
        with os.fdopen(read) as pipe:
            self.environment = os.environ | {"DISPLAY": f":{pipe.readline().strip()}"}

    def tool(self, *arguments: str | int) -> None:
        """Run a command on the display and wait for its end."""
        subprocess.run(list(map(str, arguments)), env=self.environment, capture_output=True, timeout=30, check=True)

    def close(self) -> None:
        """End the server."""
        self._server.kill()
        self._server.wait()
