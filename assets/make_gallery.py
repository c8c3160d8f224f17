"""Draws the gallery's pictures: `python assets/make_gallery.py [DEMO ...]` (minutes) writes assets/gallery/*.png, one strip a
scene.

A strip shows a scene at a few moments, from the same place, side by side.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import load_module
from taisoft.files import write_bytes
from taisoft.output.frames import SMALLEST, png_bytes
from taisoft.output.viewpoint import Viewpoint
from taisoft.view.offscreen import Offscreen
from taisoft.view.scene_view import IN_PICTURES

ASSETS = Path(__file__).resolve().parent
GAP = 4  # white pixels between two moments
MAX_BYTES = 200_000  # of a picture; the repository keeps them

# demo: moments [s], size of each picture, camera (target [m], distance [m], azimuth, elevation [deg]), colouring if not by body,
# layers if not those of pictures
STRIPS = {
    "bunny_ears": ((0.0, 0.9, 1.1, 1.3, 2.0), (260, 360), ((0.1, 1.05, 0.0), 5.6, 32.0, 8.0)),
    "hanging_cloth": ((0.0, 0.2, 0.4, 0.7, 4.0), (260, 230), ((0.0, -0.45, -0.1), 3.2, 40.0, 16.0)),
    "sheet_on_box": ((0.0, 0.2, 0.5, 3.0), (330, 240), ((0.0, 0.55, 0.0), 4.9, 32.0, 22.0)),
    "sheet_and_cube": ((0.0, 0.3, 0.6, 4.0), (330, 260), ((0.0, -0.2, 0.0), 9.5, 32.0, 20.0)),
    "squeeze": ((0.0, 0.6, 1.2, 1.7, 3.0), (260, 220), ((0.0, 0.0, 0.0), 1.25, 32.0, 10.0)),
    "drop_everything": ((0.0, 0.3, 0.5, 0.8, 1.3), (260, 330), ((0.0, 0.95, 0.0), 5.6, 32.0, 12.0)),
    "cube_pile": ((0.0, 0.3, 0.6, 2.0), (330, 330), ((0.0, 0.25, 0.0), 1.9, 32.0, 26.0)),
    "cube_on_box": ((0.0, 0.3, 0.6, 3.0), (330, 230), ((0.0, 0.6, 0.0), 6.0, 32.0, 14.0)),
    "two_cubes_two_boxes": ((0.0, 0.3, 0.6, 3.0), (330, 230), ((0.0, 0.6, 0.0), 7.0, 32.0, 14.0)),
    "incline": ((0.0, 0.7, 1.4, 2.0), (330, 230), ((0.1, 0.0, 0.0), 1.7, 20.0, 16.0)),
    "hanging_beam": ((0.0, 0.5, 1.0, 1.5, 2.0), (260, 260), ((-0.2, -1.4, 0.0), 11.0, 28.0, 14.0)),
    "midpoint_traction": ((0.0, 0.5, 6.0), (440, 140), ((0.0, 0.05, 0.0), 3.2, 12.0, 8.0)),
    "bending_beam_orders": ((0.0, 0.7, 5.0), (440, 290), ((0.0, -1.15, 0.0), 9.0, 88.0, 3.0)),
    "gripper": ((0.0, 0.4, 1.6), (330, 260), ((0.0, 0.1, 0.0), 0.75, 15.0, 6.0)),
    "seesaw": ((0.0, 0.1, 0.2, 0.4, 0.6), (330, 260), ((0.05, 0.6, 0.0), 5.2, 12.0, 8.0)),
    "robot_gripper": ((0.0, 0.52, 1.0, 2.0, 3.0), (280, 260), ((0.1, 0.0, 0.12), 0.85, 20.0, 10.0)),
    "inflated_finger": ((0.0, 0.5, 1.0, 4.0), (330, 200), ((0.2, -0.02, 0.0), 0.75, 12.0, 8.0), "stress"),
    "muscle": ((0.0, 1.0, 1.5, 2.0, 4.0), (200, 330), ((0.0, -0.15, 0.0), 0.85, 32.0, 8.0)),
    "drop_test": ((0.0, 0.145, 0.16, 0.175, 0.24), (220, 300), ((0.0, 0.13, 0.0), 0.7, 28.0, 8.0), "stress"),
    "foot_on_ground": ((0.0, 0.2, 0.5, 0.8, 1.2), (300, 220), ((0.0, 0.06, 0.0), 0.55, 20.0, 8.0), "stress", ()),
    "thin_cloth": ((0.0, 0.1, 0.2, 0.3, 2.0), (280, 260), ((0.0, 0.22, 0.0), 0.75, 35.0, 8.0)),
    "two_jellies": ((0.0, 0.05, 0.0666667, 0.1, 0.15), (300, 200), ((0.03, 0.0, 0.0), 0.5, 15.0, 14.0)),
    "layered_beam": ((0.0, 0.5, 3.0), (440, 130), ((1.2, -0.05, 0.0), 2.0, 0.0, 4.0), "stress"),
    "twisting_bar": ((0.0, 0.75, 1.5, 4.0), (330, 200), ((0.0, 0.0, 0.0), 6.6, 32.0, 20.0)),
}


def film(
    sim: ts.Simulator,
    moments: tuple,
    size: tuple[int, int],
    view: tuple,
    seconds: float,
    fps: float,
    layers: tuple[str, ...] = IN_PICTURES,
    on_moment: Callable[[ts.Simulator], None] | None = None,
    on_step=None,
    colour: str = "body",
) -> tuple[np.ndarray, ts.RunReport]:
    """Run for some seconds; the pictures of the moments [s] side by side, uint8 (height, width, 3), and what the run did.

    on_moment: called with each picture; on_step: as `Simulator.run` has it; colour: as of `Offscreen`.
    """
    target, distance, azimuth, elevation = view
    camera = Viewpoint(np.array(target), distance, azimuth, elevation, up=sim.scene.up)
    drawing = Offscreen(sim.scene, size, camera, colour=colour, layers=layers)
    frames = [round(moment * fps) for moment in moments]
    pictures: list[np.ndarray] = []

    def on_frame(sim, index, _report) -> None:
        if index in frames:
            pictures.append(drawing.image(sim))
            if on_moment is not None:
                on_moment(sim)

    result = sim.run(seconds, on_frame, fps, on_step=on_step)
    drawing.close()
    gap = np.full((size[1], GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis=1), result


def strip(
    scene_file: Path, moments: tuple, size: tuple[int, int], view: tuple, colour: str = "body", layers=IN_PICTURES
) -> np.ndarray:
    """The pictures of a scene at some times, uint8 (height, width, 3); its run ends with the last."""
    module = load_module(scene_file)
    settings = {name: value for name, value in module.solver.items() if name != "seconds"}
    fps = settings.pop("fps")
    with ts.Simulator(module.build(), **settings) as sim:
        picture, result = film(sim, moments, size, view, moments[-1], fps, layers, colour=colour)
    if result.status != "ok":
        raise SystemExit(f"{scene_file}: the run is {result.status}: {'; '.join(result.problems)}")
    return picture


def main() -> None:
    """Writes gallery/<demo>.png for the demos named, or for all."""
    names = sys.argv[1:] or list(STRIPS)
    for name in names:
        data = png_bytes(strip(ASSETS.parent / "demos" / f"{name}.py", *STRIPS[name]), SMALLEST)
        path = ASSETS / "gallery" / f"{name}.png"
        if len(data) > MAX_BYTES:
            raise SystemExit(f"{path}: {len(data)} bytes, at most {MAX_BYTES} are meant to be kept")
        write_bytes(path, data)
        print(f"{path.relative_to(ASSETS.parent)}: {len(data) / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
