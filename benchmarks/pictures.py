"""Pictures: what one costs at 1280 x 720, and how much longer runs with pictures take.

taisoft bench pictures [--quick] [--out FILE.json]

A scene of about 20,000 triangles, a ball and a cube on the ground, drawn by the kernels and by the rasteriser in NumPy of earlier
versions, in turn in one process, and the coding of its picture as PNG. Each is the median of rounds, with the range. Then runs of
demos without pictures and with 60, in turn: wall times, the part in which the simulation waits for a picture, and their ratio.
Kernels are compiled before. Exit status: 0, or 1 if pictures are less than eight times as cheap as NumPy's.
"""

import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.output.frames import FrameWriter, png_bytes
from taisoft.output.tables import markdown
from taisoft.view.colouring import background
from taisoft.view.offscreen import Offscreen
from taisoft.view.shading import N_ATTRIBUTES, SAMPLES

from .document import Limit, begin, check_out
from .numpy_raster import averaged, rasterise
from .runner import make_parser, progress

ROUNDS, QUICK_ROUNDS = 15, 3
BALL, CUBE = 32, 24  # cells
PICTURES = 60
DEMOS = {"cube_on_box": 3.0, "cube_pile": 1.0, "incline": 2.0, "sheet_on_box": 1.0, "twisting_bar": 2.0}  # simulated [s]
CHEAPER = 8.0


class NumpyOffscreen(Offscreen):
    """Pictures by the rasteriser in NumPy, without shadows."""

    def image(self, sim) -> np.ndarray:
        """Return a picture of sim's present state, as `Offscreen.image` does."""
        x, colours, lines = self._drawn(sim, self.size)
        attributes = np.column_stack([colours, np.zeros((len(x), N_ATTRIBUTES - 3))])
        points, triangles, attributes = self._triangles(x, attributes, lines)
        large = background((SAMPLES * self.size[0], SAMPLES * self.size[1]))
        rasterise(points, triangles, attributes[:, :3], self.camera.clipping[0], large)
        return averaged(large)


def build(quick: bool) -> ts.Scene:
    """A ball and a cube on the ground."""
    scene, soft = ts.Scene(), ts.Material(young=1e5, poisson=0.3, density=1000.0)
    ball, cube = (BALL // 8, CUBE // 8) if quick else (BALL, CUBE)
    scene.add_body(ts.ball_mesh(1.0, ball), soft, name="ball", position=(0.0, 1.2, 0.0))
    scene.add_body(ts.box_mesh((cube, cube, cube), (1.0, 1.0, 1.0)), soft, name="cube", position=(2.0, 0.6, 0.0))
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground")
    return scene


def measure_picture(quick: bool) -> dict:
    """Seconds of each round of drawing by both ways and of coding, of the first picture, and the number of triangles."""
    scene = build(quick)
    with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler") as sim:
        kernels, numpy, first = Offscreen(scene), NumpyOffscreen(scene), time.perf_counter()
        picture = kernels.image(sim)
        first = time.perf_counter() - first
        ways = {"NumPy": lambda: numpy.image(sim), "kernels": lambda: kernels.image(sim), "PNG": lambda: png_bytes(picture)}
        seconds: dict[str, list[float]] = {what: [] for what in ways}
        for _ in range(QUICK_ROUNDS if quick else ROUNDS):
            for what, way in ways.items():
                start = time.perf_counter()
                way()
                seconds[what].append(time.perf_counter() - start)
    return {"triangles": len(kernels.surfaces.triangles), "first": first, "bytes": len(png_bytes(picture))} | seconds


def measure_run(name: str, seconds: float, rounds: int) -> dict:
    """Wall times of a demo's run for each round, after one that compiles, without pictures and with them."""
    scene, settings = load_scene(name)
    settings = {key: value for key, value in settings.items() if key not in ("seconds", "fps")}
    found: dict = {"without": [], "with": [], "drawing": []}
    with ts.Simulator(scene, **settings) as sim:
        for turn in range(rounds + 1):
            for pictures in (False, True):
                sim.reset()
                wall, drawing = timed_run(sim, seconds, pictures)
                if turn:
                    found["with" if pictures else "without"].append(wall)
                    found["drawing"] += [drawing] * pictures
    return found


def timed_run(sim: ts.Simulator, seconds: float, pictures: bool) -> tuple[float, float]:
    """Wall time of a run, until all its pictures are written, and the part of it that was spent in `FrameWriter.frame` [s]."""
    drawing = [0.0]
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        if not pictures:
            sim.run(seconds, fps=PICTURES / seconds)
            return time.perf_counter() - start, 0.0
        with closing(FrameWriter(folder, Offscreen(sim.scene))) as writer:

            def on_frame(sim, index, _report) -> None:
                begun = time.perf_counter()
                writer.frame(sim, index)
                drawing[0] += time.perf_counter() - begun

            sim.run(seconds, on_frame, fps=PICTURES / seconds)
        return time.perf_counter() - start, drawing[0]


def picture_table(found: dict) -> str:
    """Times of a picture."""
    rows = []
    for what in ("NumPy", "kernels", "PNG"):
        t = 1e3 * np.array(found[what])
        rows.append((what, f"{np.median(t):.1f}", f"{t.min():.1f} to {t.max():.1f}", f"{cheaper(found, what):.1f}"))
    return markdown(("one picture", "median [ms]", "range [ms]", "times as cheap as NumPy"), rows, left=(0,))


def cheaper(found: dict, what: str) -> float:
    """Median over rounds of NumPy's time over another one."""
    return float(np.median(np.array(found["NumPy"]) / np.array(found[what])))


def run_table(found: dict[str, dict]) -> str:
    """Times of runs."""
    rows = []
    for name, one in found.items():
        cells = [f"{np.median(one[what]):.2f}" for what in ("without", "with", "drawing")]
        rows.append((name, *cells, f"{ratio(one):.2f}"))
    return markdown((f"{PICTURES} pictures", "without [s]", "with [s]", "of it in the observer [s]", "ratio"), rows, left=(0,))


def ratio(one: dict) -> float:
    """Median over rounds of the time with pictures over that without."""
    return float(np.median(np.array(one["with"]) / np.array(one["without"])))


def main(argv=None) -> int:
    """Measure and print. Raises OutputError if a file cannot be written."""
    parser = make_parser("pictures", __doc__)
    parser.add_argument("--quick", action="store_true", help="a coarse scene, one demo, few rounds, no limit")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="write FILE.json and FILE.md too")
    options = parser.parse_args(argv)
    check_out(options.out, ".json")
    document, numbers = begin("Pictures", "arch cpu")
    progress("pictures")
    one = measure_picture(options.quick)
    size = f"{one['triangles']:,} triangles, 1280 x 720 pixels, {one['bytes'] / 1e3:.0f} kB as PNG"
    document.add(f"## A picture\n\n{size}; the first one in {one['first']:.2f} s\n\n{picture_table(one)}")
    runs = {}
    for name, seconds in list(DEMOS.items())[: 1 if options.quick else None]:
        progress(name)
        runs[name] = measure_run(name, seconds / 10 if options.quick else seconds, 1 if options.quick else QUICK_ROUNDS)
    document.add(f"## Runs\n\n{run_table(runs)}")
    limits = [] if options.quick else [Limit("times as cheap as NumPy", cheaper(one, "kernels"), CHEAPER, at_least=True)]
    return document.finish(options, numbers | {"picture": one, "runs": runs}, limits)


if __name__ == "__main__":
    sys.exit(main())
