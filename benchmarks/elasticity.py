"""Cost of an explicit step by law and integrator, and of steps in sim.run: a falling beam.

taisoft bench elasticity [--arch cpu|cuda] [--quick] [--out [FILE.json]]

A beam 4 x 1 x 1 m, E = 1 MPa, nu = 0.3, 1000 kg/m^3, clamped at one end, falls under 9.8 m/s^2 from rest, on three meshes of five
tets per cell. Spread is the interquartile range over the median. The exit status is 0 also if limits are not met. --out writes
the page, FILE.md, and all numbers, FILE.json. A full run takes about ten minutes on two cores; do not edit the package meanwhile,
since kernels are compiled from it. `taisoft bench peers` has whole runs of the beam, beside other programs and with their errors.
"""

import sys
from dataclasses import dataclass

from taisoft.cli.doctor import cuda
from taisoft.machine import load_average

from .document import Document, begin, limit_table, load_text
from .elasticity_steps import cost_limits, cost_table, frame_limits, frame_table, measure_costs, measure_frames
from .exact_path import MESHES
from .runner import add_arch, add_named_out, make_parser, named_out


@dataclass(frozen=True)
class Extent:
    """Extent of the measurement. repeats: samples of a step's cost."""

    meshes: tuple
    precisions: tuple[str, ...]
    repeats: int


FULL = Extent(MESHES, ("f32", "f64"), repeats=15)
QUICK = Extent(MESHES[:2], ("f32",), repeats=5)


def measure(extent: Extent, arch: str) -> tuple[Document, dict]:
    """Measure and print everything; returns the page and the numbers."""
    document, numbers = begin("Elasticity: the falling beam")
    device = cuda().removeprefix("yes: ") if arch == "cuda" else None
    document.add(f"taisoft on {device}" if device else "taisoft on one thread of the processor")
    costs, frames = [], []
    document.add("## Cost of an explicit step")
    for precision in extent.precisions:
        for cells in extent.meshes:
            found = measure_costs(cells, precision, arch, extent.repeats)
            document.add(cost_table(found))
            costs += found
    document.add("## Steps in a run at 60 frames per second and steps alone, stable neo-Hookean, f32")
    for found in measure_frames(extent.meshes, arch, extent.repeats):
        document.add(frame_table(found))
        frames += found
    limits = cost_limits(costs) + frame_limits(frames)
    document.add("## Limits\n\n" + limit_table(limits))
    load = load_average()
    document.add(f"Load at the end: {load_text(load)}")
    numbers |= {"device": device, "arch": arch, "load_at_the_end": load}
    return document, numbers | {"cost": costs, "frames": frames, "limits": limits}


def main(argv=None) -> int:
    """Measure and print. Raises OutputError, or SimulationError if the arch is not available."""
    parser = make_parser("elasticity", __doc__)
    add_arch(parser)
    parser.add_argument("--quick", action="store_true", help="two small meshes, f32")
    add_named_out(parser)
    options = parser.parse_args(argv)
    out = named_out(options, "elasticity")
    document, numbers = measure(QUICK if options.quick else FULL, options.arch)
    if out is not None:
        document.write(out, numbers | {"quick": options.quick})
    return 0


if __name__ == "__main__":
    sys.exit(main())
