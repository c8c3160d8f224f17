"""How stiff is a beam that sags so much: Young's modulus by SciPy, then the beam comes to rest.

4 x 1 x 1 m on 12 x 3 x 3 nodes (220 tets), stable neo-Hookean, nu = 0.3, 1000 kg/m^3, g = 9.8 m/s^2; its tip was seen to hang
SAG below the clamp. `identify` compares static equilibria, each in some hundredths of a second once their kernels are compiled: a
kernel serves every mesh and every material number.

The measured sag is that of E = 3 MPa on this mesh, so `check` knows what must come out; the run shows that the beam, released
from its straight shape, comes to rest there.
"""

import numpy as np
from scipy.optimize import brentq

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 60, "seconds": 8.0, "fps": 30.0}

SAG = 0.91920881  # [m]
YOUNG = 3e6  # [Pa] what must come out


def beam(young: float) -> ts.Scene:
    """The clamped beam, of that Young's modulus [Pa]."""
    scene = ts.Scene(gravity=(0.0, -9.8, 0.0))
    mesh = ts.box_mesh(cells=(11, 2, 2), size=(4.0, 1.0, 1.0))
    rubber = ts.Material(law="stable_neo_hookean", young=young, poisson=0.3, density=1000.0, mass_damping=2.0)
    scene.add_body(mesh, rubber, name="beam").fix(lambda X: X[:, 0] < -1.99)
    return scene


def sag(young: float) -> float:
    """How far the tip hangs below the clamp at rest [m]."""
    result = ts.solve_static(beam(young))
    assert result.converged, f"no equilibrium at E = {young:g} Pa"
    return -tip(result.positions("beam"))


def tip(x: np.ndarray) -> float:
    """Mean height of the free end [m], from positions (n_nodes, 3)."""
    return float(x[ts.box_mesh(cells=(11, 2, 2), size=(4.0, 1.0, 1.0)).vertices[:, 0] > 1.99, 1].mean())


def identify(wanted: float) -> float:
    """Young's modulus [Pa] at which the beam sags so far [m]; the sag falls as it rises."""
    return 10.0 ** brentq(lambda power: sag(10.0**power) - wanted, 6.0, 7.5, rtol=1e-6)


def build() -> ts.Scene:
    """The beam of the modulus that was found; it starts straight and at rest."""
    return beam(identify(SAG))


def check(sim: ts.Simulator, result) -> None:
    """The modulus, and where the beam comes to rest."""
    young = sim.scene.body("beam").material.young
    assert abs(young / YOUNG - 1.0) < 1e-4, f"E = {young:g} Pa was found, not {YOUNG:g} Pa"
    low = -tip(sim.positions("beam"))
    assert abs(low / SAG - 1.0) < 1e-3, f"the tip hangs {low:.4f} m low at {sim.time:g} s, not {SAG} m"
