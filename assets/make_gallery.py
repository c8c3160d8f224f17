"""Draws the gallery's pictures: `python assets/make_gallery.py [NAME ...]` (minutes) writes assets/gallery/*.png, one strip a
scene.

A strip shows a scene at a few moments, from the same place, side by side. `film` and `film_again` are one run, drawn twice by the
command line.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

import taisoft as ts
from taisoft.cli import main as taisoft
from taisoft.cli.scene_file import load_module
from taisoft.files import write_bytes
from taisoft.output.picture_files import SMALLEST, png_bytes
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
FILM = "drop_everything"  # which gallery/film.png and film_again.png show
FILM_FRAMES, FILM_SIZE, FILM_FPS = (0, 15, 25, 40, 65), (260, 330), 50
COLOURS = {"bunny": "#f2ede4", "plank": "#c98b4e", "ring": "#3d7a78", "ball": "#d9583b", "box": "#2f4b6e"}
AROUND = (
    "position = [[4.0, 1.7, 4.0], [1.5, 2.2, 5.8], [-4.2, 1.8, 4.0]], target = [[0, 1.25, 0], [0, 1.0, 0], [-0.15, 0.5, 0]], "
    "fov = 32, times = [0, 0.6, 1.3]"
)
ABOVE = "position = [[5, 2.6, 1.5], [1.0, 4.8, 2.6]], target = [[0, 1.15, 0], [0, 0.4, 0]], fov = 34, times = [0, 1.3]"
GREY = "#8d8378"
LOOKS = {
    "film": {"scene.background": '["#fbf4e9", "#dfc9ae"]', "ground.colour": "#efe0ca", "stone.colour": GREY, "step.colour": GREY}
    | {f"{name}.colour": colour for name, colour in COLOURS.items()},
    "film_again": {"scene.background": '["#11151c", "#2b3442"]', "ground.colour": "#39424f", "stone.opacity": "0.4"},
}


def films() -> dict[str, np.ndarray]:
    """The strips of FILM in own colours with a moving camera, and of the same run, drawn again by stress from above."""
    pictures = {}
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "film"
        size = "x".join(map(str, FILM_SIZE))
        command = ["run", FILM, "--headless", "--no-usd", "--seconds", "1.3", "--fps", str(FILM_FPS), "--out", str(run)]
        again = ["draw", str(run), "--colour", "stress", "--camera", ABOVE]
        for name, words, out in (("film", [*command, "--camera", AROUND], run), ("film_again", again, run / "drawn")):
            looks = [f"--set={key}={value}" for key, value in LOOKS[name].items()]
            if taisoft([*words, "--size", size, *looks]):
                raise SystemExit(f"{name} failed")
            pictures[name] = side_by_side([np.asarray(Image.open(out / f"frames/{frame:05d}.png")) for frame in FILM_FRAMES])
    return pictures


def side_by_side(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures of one size in a row, with a gap between them."""
    gap = np.full((len(pictures[0]), GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis=1)


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
    return side_by_side(pictures), result


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
    """Writes gallery/<name>.png for the demos and films named, or for all."""
    names = sys.argv[1:] or [*STRIPS, *LOOKS]
    drawn = films() if set(names) & set(LOOKS) else {}
    for name in names:
        picture = drawn[name] if name in drawn else strip(ASSETS.parent / "demos" / f"{name}.py", *STRIPS[name])
        data = png_bytes(picture, SMALLEST)
        path = ASSETS / "gallery" / f"{name}.png"
        if len(data) > MAX_BYTES:
            raise SystemExit(f"{path}: {len(data)} bytes, at most {MAX_BYTES} are meant to be kept")
        write_bytes(path, data)
        print(f"{path.relative_to(ASSETS.parent)}: {len(data) / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
