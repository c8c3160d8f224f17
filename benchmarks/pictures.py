"""Pictures: what one costs at 1280 x 720, and how much longer runs with pictures take.

taisoft bench pictures [--quick] [--out FILE.json]

A scene of about 20,000 triangles, a ball and a cube on the ground, drawn by the kernels and by the rasteriser in NumPy of earlier
versions, in turn in one process, and the coding of its picture as PNG. Each is the median of rounds, with the range. Then runs of
demos without pictures and with 60, in turn: wall times, the part in which the simulation waits for a picture, and their ratio.
CPU times are those of all threads of the process; a busy machine changes them less. Kernels are compiled before.
Exit status: 0, or 1 if pictures are less than eight times as cheap as NumPy's.
"""

import sys
import tempfile
import time
from collections.abc import Callable
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
    """Times of drawing by both ways and of coding, for each round, seconds of the first picture, and the number of triangles."""
    scene = build(quick)
    with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler") as sim:
        kernels, numpy, pictures = Offscreen(scene), NumpyOffscreen(scene), []
        first = timed(lambda: pictures.append(kernels.image(sim)))["wall"]
        ways = {"NumPy": lambda: numpy.image(sim), "kernels": lambda: kernels.image(sim), "PNG": lambda: png_bytes(pictures[0])}
        rounds = [{what: timed(way) for what, way in ways.items()} for _ in range(QUICK_ROUNDS if quick else ROUNDS)]
    times = {what: by_clock([one[what] for one in rounds]) for what in ways}
    return {"triangles": len(kernels.surfaces.triangles), "first": first, "bytes": len(png_bytes(pictures[0]))} | times


def timed(what: Callable) -> dict[str, float]:
    """Wall and CPU seconds of a call."""
    wall, cpu = time.perf_counter(), time.process_time()
    what()
    return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu}


def by_clock(times: list[dict[str, float]]) -> dict[str, list[float]]:
    """Times as lists over rounds."""
    return {clock: [one[clock] for one in times] for clock in times[0]}


def measure_run(name: str, seconds: float, n_rounds: int) -> dict:
    """Times of a demo's run for each round, after one that compiles, without pictures and with them."""
    scene, settings = load_scene(name)
    settings = {key: value for key, value in settings.items() if key not in ("seconds", "fps")}
    rounds: dict[bool, list[dict[str, float]]] = {False: [], True: []}
    with ts.Simulator(scene, **settings) as sim:
        for turn in range(n_rounds + 1):
            for pictures, own in rounds.items():
                sim.reset()
                drawing: list[float] = []
                one = timed(lambda pictures=pictures, drawing=drawing: run(sim, seconds, drawing if pictures else None))
                if turn:
                    own.append(one | {"drawing": sum(drawing)})
    return {"without": by_clock(rounds[False]), "with": by_clock(rounds[True])}


def run(sim: ts.Simulator, seconds: float, drawing: list[float] | None) -> None:
    """Run until all pictures are written.

    drawing: gets the wall time of each call of `FrameWriter.frame` [s]; None: no pictures.
    """
    if drawing is None:
        sim.run(seconds, fps=PICTURES / seconds)
        return
    with tempfile.TemporaryDirectory() as folder, closing(FrameWriter(folder, Offscreen(sim.scene))) as writer:

        def on_frame(sim, index, _report) -> None:
            drawing.append(timed(lambda: writer.frame(sim, index))["wall"])

        sim.run(seconds, on_frame, fps=PICTURES / seconds)


def picture_table(found: dict) -> str:
    """Times of a picture."""
    rows = []
    for what in ("NumPy", "kernels", "PNG"):
        t, cpu = (1e3 * np.array(found[what][clock]) for clock in ("wall", "cpu"))
        times = f"{np.median(t):.1f}", f"{t.min():.1f} to {t.max():.1f}", f"{np.median(cpu):.1f}"
        rows.append((what, *times, f"{ratio(found['NumPy'], found[what]):.1f}"))
    return markdown(("one picture", "median [ms]", "range [ms]", "CPU [ms]", "times as cheap as NumPy"), rows, left=(0,))


def run_table(found: dict[str, dict]) -> str:
    """Times of runs."""
    rows = []
    for name, one in found.items():
        walls = [one["without"]["wall"], one["with"]["wall"], one["with"]["drawing"], one["without"]["cpu"], one["with"]["cpu"]]
        rows.append((name, *(f"{np.median(wall):.2f}" for wall in walls), f"{ratio(one['with'], one['without']):.2f}"))
    headings = "without [s]", "with [s]", "of it waiting [s]", "CPU without [s]", "CPU with [s]", "ratio"
    return markdown((f"{PICTURES} pictures", *headings), rows, left=(0,))


def ratio(a: dict, b: dict) -> float:
    """Median over rounds of the wall time of a over that of b."""
    return float(np.median(np.array(a["wall"]) / np.array(b["wall"])))


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
    limits = (
        [] if options.quick else [Limit("times as cheap as NumPy", ratio(one["NumPy"], one["kernels"]), CHEAPER, at_least=True)]
    )
    return document.finish(options, numbers | {"picture": one, "runs": runs}, limits)


if __name__ == "__main__":
    sys.exit(main())
