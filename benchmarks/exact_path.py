"""The falling beam integrated exactly in time, the reference for solvers on the same mesh.

A beam 4 x 1 x 1 m of St. Venant-Kirchhoff material, psi = mu E:E + lam/2 tr(E)^2 with E = (F^T F - I)/2, is clamped at
x = -2 and falls under gravity from rest, undamped. The mesh (five tets per cell) and the lumped mass (a quarter of each tet's
mass per node) are fixed, so that a solver's difference to this path is its time integration error. SciPy's DOP853 (Runge-Kutta
of order 8) integrates the ordinary differential equations; `works.references` stores paths, and their distance to those of a
looser tolerance as their uncertainty.

The law has no barrier against inversion: from about t = 0.8 s the beam folds at the clamp and tets invert. The path remains well
defined but unphysical.
"""

import numpy as np
from scipy.integrate import DOP853

from taisoft.errors import SimulationError

from .works.semi_discrete import SemiDiscrete

SIZE = (4.0, 1.0, 1.0)  # m, centred at the origin
YOUNG, POISSON, DENSITY = 1e6, 0.3, 1000.0  # Pa, 1, kg/m^3
GRAVITY = 9.8  # m/s^2, along -y
MESHES = ((12, 3, 3), (24, 6, 6), (48, 12, 12))  # 540, 4,320, 34,560 tets
SAMPLE = 0.01  # s between stored points of the path
SECONDS = 1.0


def integrate(beam: SemiDiscrete, tolerance: float, points: np.ndarray, seconds: float = SECONDS):
    """Times (k,) [s], every SAMPLE, and the positions (k,3) [m] of the mean of some vertices, (p,) indices.

    tolerance: relative, and absolute in m and m/s, of the error of one step. Raises SimulationError if it fails.
    """
    n = len(beam.vertices)

    def rate(_, y):
        u, v = y.reshape(2, 3, n)
        return np.concatenate([v.ravel(), beam.acceleration(u).ravel()])

    times = np.arange(round(seconds / SAMPLE) + 1) * SAMPLE
    start = beam.vertices[points].mean(axis=0)
    path = np.tile(start, (len(times), 1))
    solver = DOP853(rate, 0.0, np.zeros(6 * n), times[-1], rtol=tolerance, atol=tolerance)
    done = 1
    while solver.status == "running":
        solver.step()
        reached = np.searchsorted(times, solver.t + 1e-12, side="right")
        if reached > done:
            between = solver.dense_output()
            for k in range(done, reached):
                path[k] += between(min(times[k], solver.t)).reshape(2, 3, n)[0][:, points].mean(axis=1)
            done = reached
    if solver.status == "failed":
        raise SimulationError(f"the exact path of {len(beam.tets)} tets ends at t = {solver.t:.4f} s: too small a step")
    return times, path
