"""Draws the README's pictures: `python assets/make_gallery.py` (under a minute) writes assets/gallery/*.png, one strip a
scene.

A strip shows a scene at a few moments, from the same place, side by side. The bunny needs its mesh; see
benchmarks/scenes/bunny_pull.py.
"""

from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import load_module
from taisoft.output.camera import Camera
from taisoft.output.files import write_bytes
from taisoft.output.frames import png_bytes
from taisoft.view.offscreen import Offscreen

ASSETS = Path(__file__).resolve().parent
GAP = 4  # white pixels between two moments
MAX_BYTES = 200_000  # of a picture; the repository keeps them

# file in the repository: moments [s], size of each picture, camera (target [m], distance [m], azimuth, elevation [deg])
STRIPS = {
    "demos/hanging_beam.py": ((0.0, 0.5, 1.0, 1.5, 2.0), (300, 300), ((-0.2, -1.4, 0.0), 11.0, 28.0, 14.0)),
    "demos/midpoint_traction.py": ((0.0, 0.5, 6.0), (504, 160), ((0.0, 0.05, 0.0), 3.2, 12.0, 8.0)),
    "demos/bending_beam_orders.py": ((0.0, 0.7, 5.0), (504, 330), ((0.0, -1.15, 0.0), 9.0, 88.0, 3.0)),
    "demos/twisting_bar.py": ((0.0, 0.75, 1.5, 4.0), (377, 220), ((0.0, 0.0, 0.0), 6.6, 32.0, 20.0)),
    "benchmarks/scenes/bunny_pull.py": ((0.0, 1.0, 1.1, 1.3, 1.7), (260, 330), ((-0.3, 1.85, 0.0), 9.6, 32.0, 8.0)),
}


def strip(scene_file: Path, moments: tuple, size: tuple[int, int], view: tuple) -> np.ndarray:
    """The pictures of a scene at some times, uint8 (height, width, 3); its run ends with the last."""
    target, distance, azimuth, elevation = view
    camera = Camera(np.array(target), distance, azimuth, elevation)
    module = load_module(scene_file)
    settings = {name: value for name, value in module.solver.items() if name != "seconds"}
    fps = settings.pop("fps")
    pictures: list[np.ndarray] = []
    with ts.Simulator(module.build(), **settings) as sim:
        drawing = Offscreen(sim.scene, size, camera)

        def on_frame(sim, index, _report) -> None:
            if index in [round(moment * fps) for moment in moments]:
                pictures.append(drawing.image(sim))

        result = sim.run(moments[-1], on_frame, fps)
        drawing.close()
    if result.status != "ok":
        raise SystemExit(f"{scene_file}: the run is {result.status}: {'; '.join(result.problems)}")
    gap = np.full((size[1], GAP, 3), 255, dtype=np.uint8)
    return np.concatenate([part for picture in pictures for part in (gap, picture)][1:], axis=1)


def main() -> None:
    """Writes gallery/<scene>.png for every strip."""
    for name, (moments, size, view) in STRIPS.items():
        data = png_bytes(strip(ASSETS.parent / name, moments, size, view))
        path = ASSETS / "gallery" / f"{Path(name).stem}.png"
        if len(data) > MAX_BYTES:
            raise SystemExit(f"{path}: {len(data)} bytes, at most {MAX_BYTES} are meant to be kept")
        write_bytes(path, data)
        print(f"{path.relative_to(ASSETS.parent)}: {len(data) / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
