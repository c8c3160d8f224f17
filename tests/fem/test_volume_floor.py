"""Laws with a volume floor in scenes; `test_laws` has the formulas, `test_elasticity` forces and matrices:

* a squeezed block keeps its tets in explicit steps below `stable_dt`, which counts the floor, by region, and flat tets; above
  `stable_dt` it explodes;
* changed numbers scale it, the floor itself cannot change.
"""

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator, eigsh

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.fem.reference import lumped_mass
from taisoft.stability import stable_dt
from tests.dynamics.scenes import SNH, cube, halved, rubber


def squeezed_block(floor: float, squeeze: float = 0.95, **numbers) -> ts.Scene:
    """A block in a box of which the lid comes down within a second, to a fraction of its height."""
    scene = ts.Scene(gravity=(0, 0, 0))
    one = scene.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), rubber(SNH, poisson=0.4, volume_floor=floor, **numbers), name="block")
    one.fix(lambda X: X[:, 1] < -0.499)
    one.fix(lambda X: (np.abs(X[:, [0, 2]]) > 0.499).any(axis=1) & (np.abs(X[:, 1]) < 0.499), axes="xz")
    one.move(lambda X: X[:, 1] > 0.499, ts.KeyFrames([0, 1], [(0, 0, 0), (0, -squeeze, 0)]))
    return scene


def lowest(sim: ts.Simulator, seconds: float = 1.2) -> tuple[float, int]:
    """Smallest J and largest number of inverted tets of all steps."""
    reports = [sim.step() for _ in range(round(seconds / sim.dt))]
    assert all(report.converged for report in reports)
    return min(report.min_volume_ratio for report in reports), max(report.n_inverted for report in reports)


def test_explicit_steps_resolve_the_floor():
    """`stable_dt` is 1 / sqrt(1 + 2 / floor) of that of the law: below it a squeezed block keeps its tets, above it explodes.

    Flat tets of the block vibrate a little slower than it allows.
    """
    plain = stable_dt(squeezed_block(0.0), verlet=False)
    assert plain / stable_dt(squeezed_block(0.1), verlet=False) == pytest.approx(np.sqrt(21.0), rel=1e-6)
    scene = squeezed_block(0.1, squeeze=0.97, mass_damping=5.0)
    settings = {"integrator": "symplectic_euler", "precision": "f64", "allow_unstable": True}
    with pytest.warns(UserWarning, match="stab"), ts.Simulator(scene, dt=0.9 * plain, **settings) as sim:
        with pytest.raises(SimulationError):
            lowest(sim)
        sim.reset()
        sim.dt = 0.9 * sim.stable_dt
        J, inverted = lowest(sim)
        assert 0.0 < J < 0.1 and inverted == 0
        before = sim.energies().elastic
        sim.set_material("block", young=5e4)
        assert sim.energies().elastic == pytest.approx(0.5 * before, rel=1e-12)
        with pytest.raises(ts.SceneError, match="volume_floor cannot change while it runs"):
            sim.set_material("block", volume_floor=0.2)
        sim.set_material("block", young=1e5)
        rest, scale = scene.bodies[0].rest_positions, 1.0 / np.sqrt(lumped_mass(scene.bodies[0]))[:, None]
        skewed = rest + 0.05 * np.random.default_rng(0).standard_normal(rest.shape)

        def scaled(v: np.ndarray) -> np.ndarray:
            return -(scale * sim.force_differential(scale * v.reshape(-1, 3))).reshape(-1)

        squares = []
        for n in np.array([[1, 0, 0], [0, 1, 0], [1, 1, 0], [1, -1, 1]]):
            sim.set_state(positions=skewed - 0.995 * np.outer(skewed @ n, n) / (n @ n))
            operator = LinearOperator((rest.size, rest.size), matvec=scaled, dtype=np.float64)
            squares.append(eigsh(operator, k=1, which="LA", tol=1e-3, v0=np.ones(rest.size), return_eigenvectors=False)[0])
        assert 0.4 < sim.stable_dt / (2.0 / np.sqrt(max(squares))) < 1.0


def test_stable_dt_counts_the_floor_of_each_region():
    """A floor in a soft region of a stiff body shortens it less than in the stiff one."""

    def limit(soft: float, stiff: float, **more) -> float:
        scene = ts.Scene()
        materials = {"left": rubber(SNH, young=1e3, volume_floor=soft), 7: rubber(SNH, young=1e6, volume_floor=stiff)}
        scene.add_body(halved(cube(cells=(2, 1, 1))), materials, **more)
        return stable_dt(scene, verlet=False)

    assert limit(0.05, 0.0) == pytest.approx(limit(0.0, 0.0), rel=0.02)
    assert limit(0.0, 0.05) == pytest.approx(limit(0.0, 0.0) / np.sqrt(41.0), rel=0.02)
    assert limit(0.1, 0.1) == pytest.approx(limit(0.0, 0.0) / np.sqrt(21.0), rel=1e-3)
    for more in ({"order": 2}, {"dilatation": "mean"}):
        assert limit(0.1, 0.1, **more) < limit(0.0, 0.0, **more) / 3.0
