"""A muscle lifts a weight: its fibres are activated, and it shortens and bulges.

0.2 x 0.04 x 0.04 m, 400 quadratic tets of stable neo-Hookean, E = 30 kPa, nu = 0.45, hang from a fixed end. Fibres run from end
to end along a harmonic field: k1 = 10 kPa, k2 = 1, 30 kPa of active stress. A rigid weight of 3 kg is attached to the other
end. The activation follows key frames, from 0.1 to 1 between 1 and 2 s; stiffness damping brings the weight to rest.

`check` compares the stretch in the middle, far from both ends, with that of a bar in uniaxial stress whose section bears the
weight and the muscle's lower half, and the pull on the weight with its own weight.
"""

import numpy as np
from scipy.optimize import fsolve

import taisoft as ts

solver = {"integrator": "implicit_euler", "dt": 1 / 30, "seconds": 4.0, "fps": 30.0, "precision": "f64"}

LENGTH, WIDTH, EDGE, G = 0.2, 0.04, 0.08, 9.81  # [m] of the muscle, and of the weight
WEIGHT, LOW = 3.0, 0.1  # [kg], activation at the start
FLESH = ts.Material(
    young=3e4, poisson=0.45, stiffness_damping=0.05, fibre_stiffness=1e4, fibre_exponent=1.0, active_stress=3e4, density=1000.0
)


def build() -> ts.Scene:
    """The muscle at its length at rest, with the weight below it."""
    scene = ts.Scene()
    mesh = ts.box_mesh((2, 20, 2), (WIDTH, LENGTH, WIDTH), (0.0, -LENGTH / 2, 0.0))
    fibres = ts.harmonic_fibres(mesh, lambda X: X[:, 1] > -1e-9, lambda X: X[:, 1] < 1e-9 - LENGTH)
    muscle = scene.add_body(mesh, FLESH, name="muscle", order=2, fibres=fibres)
    muscle.fix(lambda X: X[:, 1] > -1e-9)
    muscle.activate(ts.KeyFrames((0.0, 1.0, 2.0), values=(LOW, LOW, 1.0), smooth=True))
    cube = ts.box_mesh((1, 1, 1), (EDGE, EDGE, EDGE))
    scene.add_rigid_body(cube, WEIGHT / EDGE**3, name="weight", position=(0.0, -LENGTH - EDGE / 2, 0.0))
    scene.attach("muscle", lambda X: X[:, 1] < 1e-9 - LENGTH, "weight", name="tendon")
    return scene


def stretch(tension: float) -> float:
    """Stretch of a fully activated bar under a nominal tension [Pa]: Smith et al. 2018, Holzapfel et al. 2000."""
    m, l = 4.0 / 3.0 * FLESH.mu, FLESH.lam + 5.0 / 6.0 * FLESH.mu
    alpha = 1.0 + 0.75 * m / l

    def residuals(stretches: np.ndarray) -> tuple[float, float]:
        along, across = stretches
        a, b = m - m / (along**2 + 2.0 * across**2 + 1.0), l * (along * across**2 - alpha)
        d = max(along**2 - 1.0, 0.0)
        fibres = FLESH.active_stress + 2.0 * FLESH.fibre_stiffness * d * np.exp(FLESH.fibre_exponent * d**2) * along
        return (a * along + b * across**2 + fibres - tension) / FLESH.young, (a * across + b * along * across) / FLESH.young

    return float(fsolve(residuals, (0.8, 1.1), xtol=1e-12)[0])


def check(sim: ts.Simulator, result) -> None:
    """The middle is as short as it should be; the weight hangs at rest, higher than it began."""
    muscle, weight = sim.scene.body("muscle"), sim.scene.body("weight")
    centroids = muscle.mesh.vertices[muscle.mesh.tets].mean(axis=1)
    middle = np.abs(centroids[:, 1] + LENGTH / 2) < LENGTH / 20
    found = float(np.average(np.linalg.norm(sim.fibres("muscle"), axis=1)[middle], weights=muscle.mesh.volumes[middle]))
    expected = stretch(G * (weight.mass + muscle.mass / 2) / WIDTH**2)
    # 5e-4 measured, the ends' effect
    assert abs(found / expected - 1.0) < 1e-3, f"the stretch in the middle is {found:.5f}, not {expected:.5f}"
    pull = -sim.joint_force("tendon").sum(axis=0)[1]
    assert abs(pull / (G * weight.mass) - 1.0) < 1e-4, f"the muscle pulls with {pull:.4f} N, not {G * weight.mass:.4f} N"
    lift = sim.pose("weight").translation[1]
    assert lift > 0.045, f"the weight was lifted by {lift:.4f} m"
