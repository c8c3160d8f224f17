"""The process that draws a run's pictures: `python -m taisoft.view.picture_process MEMORY`, see `taisoft.view.pictures`.

It gets a description of the scene, then states, which it draws, codes and writes in their order. It says when a state is drawn,
and on request when all pictures are written. When its caller ends without a request, the pictures that wait are dropped.
"""

import os
from pathlib import Path
from types import SimpleNamespace

from taisoft.compile_message import silenced
from taisoft.errors import TaisoftError, no_memory, reason
from taisoft.processes import Link, LinkClosed
from taisoft.view.drawn import DrawnScene
from taisoft.view.link import SharedNodes, serve
from taisoft.view.pictures import FAILURE, PictureOptions, picture_writer
from taisoft.view.plots import PlotChoice


class Drawing:
    """Draws the states that come over a link. description: of the scene and the pictures. Raises OutputError."""

    def __init__(self, link: Link, nodes: SharedNodes, scene: DrawnScene, description: dict):
        self._link, self._nodes, self._scene, self._caller = link, nodes, scene, description["caller"]
        options = PictureOptions(**description["options"])
        self._plots = PlotChoice(None, description["enabled"], tuple(options.plots)) if options.plots else None
        self._writer = picture_writer(Path(description["folder"]), scene, options, self._plots)

    def run(self) -> None:
        """Draw until the link is closed, which raises LinkClosed. The error that ends it before is sent."""
        try:
            with silenced():
                while True:
                    message = self._link.receive(None)
                    if os.getppid() != self._caller:  # its pictures in the folder may be another run's by now
                        return
                    self._take(message)
        except LinkClosed:
            raise
        except TaisoftError as error:
            self._link.send({"error": str(error)})
        except MemoryError as error:
            self._link.send({"error": f"{FAILURE}: {no_memory('a picture', error)}"})
        except Exception as error:
            self._link.send({"error": f"{FAILURE}: {reason(error)}"})
            raise

    def _take(self, message: dict) -> None:
        """Draw a state, or wait until all pictures are written."""
        if "flush" in message:
            self._writer.flush()
            self._link.send({"flushed": True})
            return
        state = self._nodes.take(self._scene, message["state"], message["slot"])
        if self._plots is not None:
            self._plots.history, self._plots.enabled = SimpleNamespace(**message["history"]), message["enabled"]
        self._writer.frame(state, message["index"])
        drawing = self._writer.renderer
        self._link.send({"drawn": state.time, "kept": [drawing.kept(state.time), drawing.kept()]})


if __name__ == "__main__":
    serve(Drawing)
