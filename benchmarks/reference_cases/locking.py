"""Volumetric locking: the hanging beam at Poisson's ratios of up to 0.499 with mean dilatation, and what it costs.

The reference at 0.3 is that of 27-node bricks (`order_cases.BRICKS`). From 0.45 on it is extrapolated from order 2 with mean
dilatation on 11x2x2, 16x3x3 and 22x4x4 cells; at 0.499 order 2 with local dilatation approaches it from the other side, with
-2.672 m on 24x8x8 cells. The rows of times compare steps of implicit Euler in f64, over one second of each beam's fall.
"""

import statistics
import time
import warnings
from functools import partial

import taisoft as ts

from .record import Case, Check, face, label, near, nearest, scene

SAG = {0.3: -2.70947892267, 0.45: -2.691, 0.47: -2.688, 0.49: -2.683, 0.499: -2.680}  # [m] of the tip's middle; good to 0.002
RATIO_LIMIT, ERROR_LIMIT = 1.3, 5e-3
DT, SECONDS = 1 / 60, 1.0
SIZE = (4.0, 1.0, 1.0)


def _beam(cells: tuple[int, int, int], poisson: float, order: int, dilatation: str) -> tuple[ts.Scene, object]:
    made = scene(gravity=True)
    material = ts.Material(young=1e6, poisson=poisson, density=1000.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # linear tets lock
        body = made.add_body(ts.box_mesh(cells, SIZE), material, name="beam", order=order, dilatation=dilatation)
    body.fix(face(0, -2.0))
    return made, body


def _error(cells: tuple[int, int, int], poisson: float, order: int, dilatation: str, arch: str) -> float:
    """Relative error of the tip's sag at equilibrium."""
    made, body = _beam(cells, poisson, order, dilatation)
    result = ts.solve_static(made, tolerance=1e-8, arch=arch)
    tip = nearest(body.rest_positions, (2.0, 0.0, 0.0))
    sag = float((result.positions() - body.rest_positions)[tip, 1].mean())
    return abs(sag / SAG[poisson] - 1.0)


def _step(cells: tuple[int, int, int], poisson: float, order: int, dilatation: str, arch: str) -> float:
    """Processor time of a step [s], the median over a fall from rest, since some steps compile."""
    made, _ = _beam(cells, poisson, order, dilatation)
    seconds = []
    with ts.Simulator(made, dt=DT, precision="f64", arch=arch) as sim:
        for _ in range(round(SECONDS / DT)):
            start = time.thread_time()
            sim.step()
            seconds.append(time.thread_time() - start)
    return statistics.median(seconds)


def compute(cells: tuple[int, int, int], fine: bool, _reference: dict, arch: str):
    """Errors of both orders, and with `fine` their steps' times."""
    for order in (1, 2):
        local, errors = ({nu: _error(cells, nu, order, kind, arch) for nu in SAG} for kind in ("local", "mean"))
        usual = local[0.3]
        for nu, error in local.items():
            yield Check(f"order {order}: error of the sag, nu = {nu}, local dilatation", error, 0.0, error)
        for nu, error in errors.items():
            limit = ERROR_LIMIT if order == 2 and fine else None
            yield Check(f"order {order}: error of the sag, nu = {nu}, mean dilatation", error, 0.0, error, limit)
        if order == 1:
            ratio = errors[0.499] / usual
            yield Check("order 1: error at 0.499, mean, over that at 0.3, local", ratio, 1.0, ratio, RATIO_LIMIT)
            ratio = errors[0.499] / errors[0.3]
            yield Check("order 1: error at 0.499 over that at 0.3, both mean", ratio, 1.0, ratio)
    if fine:
        for order in (1, 2):
            kinds = (0.3, "local"), (0.3, "mean"), (0.499, "mean")
            usual, own, nearly = (_step(cells, nu, order, kind, arch) for nu, kind in kinds)
            yield near(f"order {order}: step at 0.499, mean, over 0.3, local", nearly / usual, 1.0)
            yield near(f"order {order}: step at 0.499 over 0.3, both mean", nearly / own, 1.0)
        for nu in SAG:
            local, mean = (_step(cells, nu, 1, kind, arch) for kind in ("local", "mean"))
            yield near(f"order 1: step at {nu}, mean over local", mean / local, 1.0)


CASES = tuple(
    Case("locking", "SNH", label(cells), partial(compute, cells, fine), fine, closed_form=True)
    for cells, fine in (((11, 2, 2), False), ((22, 4, 4), True))
)
