"""Collision detection: time of a search, of its phases, of its broad phases and reductions, against size and over frames.

taisoft bench collision [--quick] [--arch cpu|cuda] [--precision f32|f64] [--out FILE.json] [--plot FILE.png]

Configurations: piles of 27 touching cubes, two cubes, and the report's scenes; bodies are hit by the proximity of their
surfaces or through distance fields. A time is the median over rounds of one phase, or of a whole search (boxes, candidates,
contacts, reduction), with nothing copied to the host; spread is the distance between the quartiles over the median. The first
search, which compiles the kernels and lets the buffers grow, is told apart. Figures named are those of the report. The older
code's times are quoted: of a whole step, contacts and solver, on this class of machine. Exit status: 0, or 1 where a limit
is not met. --quick has small meshes, few rounds and frames, and no limit. The whole takes about fifteen minutes on two cores.
"""

import argparse
import sys

from taisoft.backend.runtime import Runtime, open_runtime
from taisoft.timing import load_average

from .collision_cases import CUBES, FRAMES, LARGE_PILE, PILES, RATIOS, REPORT, SHEET, SWEPT, cubes_setup, pile_setup
from .collision_plot import draw
from .collision_runs import GEOMETRIES, QUICK_ROUNDS, ROUNDS, measure_broad, measure_film, measure_row
from .collision_table import (
    broad_table,
    cell_table,
    crossover_text,
    film_table,
    find_limits,
    older_table,
    reduction_table,
    row_table,
)
from .document import Document, header
from .elasticity_table import limit_table
from .order import parse_options

QUICK_FRAMES = 3


def measure(quick: bool, runtime: Runtime, document: Document) -> dict:
    """Everything, printed as it comes: rows, films and sweeps by name."""
    rounds = QUICK_ROUNDS if quick else ROUNDS
    frames = QUICK_FRAMES if quick else FRAMES
    few = slice(2 if quick else None)

    def rows(setups) -> list:
        return [measure_row(setup, geometry, runtime, rounds) for setup in setups for geometry in GEOMETRIES]

    document.add("## Piles of 27 cubes at rest, touching (fig. 12)")
    piles = rows([pile_setup(n) for n in (*PILES[few], *(() if quick else (LARGE_PILE,)))])
    document.add(row_table(piles))
    document.add("## The report's scenes")
    scenes = rows(REPORT[few])
    document.add(row_table(scenes) + "\n\n" + older_table(scenes))
    document.add(f"## Over {frames} frames (figs. 11, 13, 17)")
    turned = cubes_setup(SWEPT[0])
    films = [measure_film(SHEET, geometry, runtime, frames) for geometry in GEOMETRIES]
    films.append(measure_film(turned, GEOMETRIES[0], runtime, frames, broad=True))
    document.add(film_table(films))
    document.add("## Reduction (fig. 14)\n\n" + reduction_table(piles))
    document.add("## Broad phases, two cubes (fig. 17)")
    broad = [sweep for n in CUBES[few] for sweep in measure_broad(cubes_setup(n), runtime, rounds)]
    document.add(broad_table(broad) + "\n\n" + crossover_text(broad))
    document.add("## Cells of the spatial hash (fig. 18)")
    cells = [s for n in SWEPT[: 1 if quick else None] for s in measure_broad(cubes_setup(n), runtime, rounds, RATIOS[few])]
    document.add(cell_table(cells))
    return {"piles": piles, "scenes": scenes, "films": films, "broad": broad, "cells": cells}


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError where the arch cannot be had."""
    first, _, rest = __doc__.partition("\n")
    parser = argparse.ArgumentParser(prog="taisoft bench collision", description=first, epilog=rest.partition("\n\n")[2])
    parser.add_argument("--quick", action="store_true", help="small meshes, few rounds and frames, no limit")
    parser.add_argument("--precision", choices=("f32", "f64"), default="f32", help="of all but positions (default f32)")
    options = parse_options(parser, argv, "the report's figures")
    document, (text, numbers) = Document(), header("Collision detection", options.arch, options.precision)
    document.add(text)
    runtime = open_runtime(options.arch, options.precision, "the benchmark of collision detection")
    try:
        found = measure(options.quick, runtime, document)
    finally:
        runtime.close()
    limits = [] if options.quick else find_limits(found["piles"] + found["scenes"], found["films"])
    if limits:
        document.add("## Limits\n\n" + limit_table(limits))
    if options.out:
        records = {name: [x.record() for x in some] for name, some in found.items()}
        numbers |= {"arch": options.arch, "precision": options.precision, "quick": options.quick}
        numbers |= {"load_at_the_end": load_average()} | records
        numbers["limits"] = [limit.record() for limit in limits]
        document.write(options.out, numbers)
    if options.plot:
        draw(found, options.plot)
        print(f"written: {options.plot}")
    return 0 if all(limit.met for limit in limits) else 1


if __name__ == "__main__":
    sys.exit(main())
