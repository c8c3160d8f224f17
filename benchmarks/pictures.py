"""Pictures: what one costs at 1280 x 720, and how much longer runs with pictures take.

taisoft bench pictures [--quick] [--out [FILE.json]]

A scene of about 20,000 triangles, a ball and a cube on the ground, is drawn, and its picture coded as PNG. Each is the median of
rounds, with the range. Then runs of demos without pictures, with 60 that are drawn in a process of their own, and with 60 drawn
between the steps, in turn: wall times until all pictures are written, the part in which the simulation is kept by pictures, and
ratios to the run without. CPU times are those of all threads of the simulating process; a busy machine changes them less. Kernels
are compiled, and the process of the pictures is started, before.
Exit status: 0, or 1 if a limit is not met.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from statistics import median

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.output.picture_files import png_bytes
from taisoft.view.offscreen import Offscreen
from taisoft.view.pictures import PictureOptions, PictureProcess, picture_writer
from taisoft.view.sampling import Sampler

from .document import Limit, begin, table
from .runner import progress, quick_options

ROUNDS, RUN_ROUNDS, QUICK_ROUNDS = 15, 5, 3
BALL, CUBE = 32, 24  # cells
PICTURES = 60
DEMOS = {"cube_on_box": 3.0, "cube_pile": 1.0, "incline": 2.0, "sheet_on_box": 1.0, "twisting_bar": 2.0}  # simulated [s]
PICTURE = 60.0  # largest time of a picture [ms]


def build(quick: bool) -> ts.Scene:
    """A ball and a cube on the ground."""
    scene, soft = ts.Scene(), ts.Material(young=1e5, poisson=0.3, density=1000.0)
    ball, cube = (BALL // 8, CUBE // 8) if quick else (BALL, CUBE)
    scene.add_body(ts.ball_mesh(1.0, ball), soft, name="ball", position=(0.0, 1.2, 0.0))
    scene.add_body(ts.box_mesh((cube, cube, cube), (1.0, 1.0, 1.0)), soft, name="cube", position=(2.0, 0.6, 0.0))
    scene.add_obstacle(ts.HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), name="ground")
    return scene


def measure_picture(quick: bool) -> dict:
    """Times of drawing and of coding, for each round, seconds of the first picture, and the number of triangles."""
    scene = build(quick)
    with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler") as sim:
        kernels, pictures = Offscreen(scene), []
        first = timed(lambda: pictures.append(kernels.image(sim)))["wall"]
        ways = {"kernels": lambda: kernels.image(sim), "PNG": lambda: png_bytes(pictures[0])}
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
    """Times of a demo's run for each round, after one that compiles, without pictures, and with them drawn in both places."""
    scene, settings = load_scene(name)
    settings = {key: value for key, value in settings.items() if key not in ("seconds", "fps")}
    rounds: dict[str, list[dict[str, float]]] = {"without": [], "with": [], "between": []}
    with ts.Simulator(scene, **settings) as sim:
        for turn in range(n_rounds + 1):
            for where, own in rounds.items():
                sim.reset()
                one = timed_run(sim, seconds, where)
                if turn:
                    own.append(one)
    return {where: by_clock(own) for where, own in rounds.items()}


def timed_run(sim: ts.Simulator, seconds: float, where: str) -> dict[str, float]:
    """Wall and CPU seconds of a run until all pictures are written, and wall seconds for which pictures keep the simulation."""
    if where == "without":
        return timed(lambda: sim.run(seconds, fps=PICTURES / seconds)) | {"drawing": 0.0}
    drawing: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        path, options = Path(folder), PictureOptions()
        sampler = Sampler(sim.scene)
        writer = (PictureProcess if where == "with" else picture_writer)(path, sampler.drawn, options)

        def frame(index: int) -> None:
            writer.frame(sampler.state(sim, options.layers, [options.colour]), index)

        def on_frame(_sim, index, _report) -> None:
            drawing.append(timed(lambda: frame(index))["wall"])

        def run() -> None:
            sim.run(seconds, on_frame, fps=PICTURES / seconds)
            drawing.append(timed(writer.flush)["wall"])

        with closing(writer):
            frame(0)
            writer.flush()
            one = timed(run)
    return one | {"drawing": sum(drawing)}


def picture_table(found: dict) -> str:
    """Times of a picture."""
    columns = (
        ("<one picture", "{}"),
        ("median [ms]", lambda what: f"{1e3 * median(found[what]['wall']):.1f}"),
        ("range [ms]", lambda what: "{:.1f} to {:.1f}".format(*(1e3 * of(found[what]["wall"]) for of in (min, max)))),
        ("CPU [ms]", lambda what: f"{1e3 * median(found[what]['cpu']):.1f}"),
    )
    return table(("kernels", "PNG"), columns)


def run_table(found: dict[str, dict]) -> str:
    """Times of runs, medians over rounds."""

    def seconds(where: str, clock: str) -> Callable[[str], str]:
        return lambda name: f"{median(found[name][where][clock]):.2f}"

    def ratios(name: str, where: str, clock: str) -> list[float]:
        return [a / b for a, b in zip(found[name][where][clock], found[name]["without"][clock])]

    def ratio(where: str) -> Callable[[str], str]:
        return lambda name: "{:.2f} ({:.2f} to {:.2f})".format(*(of(ratios(name, where, "wall")) for of in (median, min, max)))

    columns = (
        (f"<{PICTURES} pictures", "{}"),
        ("without [s]", seconds("without", "wall")),
        ("with [s]", seconds("with", "wall")),
        ("of it kept [s]", seconds("with", "drawing")),
        ("ratio", ratio("with")),
        ("drawn between steps", ratio("between")),
        ("CPU without [s]", seconds("without", "cpu")),
        ("CPU with [s]", seconds("with", "cpu")),
        ("CPU ratio", lambda name: f"{median(ratios(name, 'with', 'cpu')):.2f}"),
    )
    return table(found, columns)


def main(argv=None) -> int:
    """Measure and print. Raises OutputError if a file cannot be written."""
    options = quick_options("pictures", __doc__, argv, "a coarse scene, one demo, few rounds, no limit")
    document, numbers = begin("Pictures", "arch cpu")
    progress("pictures")
    one = measure_picture(options.quick)
    size = f"{one['triangles']:,} triangles, 1280 x 720 pixels, {one['bytes'] / 1e3:.0f} kB as PNG"
    document.add(f"## A picture\n\n{size}; the first one in {one['first']:.2f} s\n\n{picture_table(one)}")
    runs = {}
    for name, seconds in list(DEMOS.items())[: 1 if options.quick else None]:
        progress(name)
        runs[name] = measure_run(name, seconds / 10 if options.quick else seconds, 1 if options.quick else RUN_ROUNDS)
    document.add(f"## Runs\n\n{run_table(runs)}")
    limits = [] if options.quick else [Limit("a picture [ms]", 1e3 * median(one["kernels"]["wall"]), PICTURE)]
    return document.finish(options, numbers | {"picture": one, "runs": runs}, limits)


if __name__ == "__main__":
    sys.exit(main())
