"""Scenes for tests of the elements, so that each kernel is compiled for one of them, and what the elements do in a state.

Compiling takes more than twice as long for two kinds of tets in a scene: hence one law of each order.
"""

import numpy as np

import taisoft as ts
from taisoft.fem.measure import measure
from taisoft.fem.state import ELASTIC
from taisoft.fem.terms import elasticity
from taisoft.linear import block_csr
from tests.dynamics.scenes import SNH, SVK, cube, halved, rubber


def composition(*orders: int) -> ts.Scene:
    """Of the orders given: 1: bodies of 6 and 5 tets with a volume floor, one with numbers by tet; 2: one of 10 with two regions.

    They do not touch, none fills its last lanes, and damping, loads and constraints differ.
    """
    scene, damping = ts.Scene(gravity=(0.3, -9.81, 0.7)), {"mass_damping": 0.4, "stiffness_damping": 3e-3}
    scene.contact_forces = False
    if 2 in orders:
        regions = {"left": rubber(SNH, **damping), 7: rubber(SNH, young=4e4, poisson=0.1, density=1700.0, **damping)}
        mesh = halved(cube(cells=(2, 1, 1)))
        beam = scene.add_body(mesh, regions, name="beam", position=(0.5, 0, 0), order=2, quadrature_degree=4)
        beam.fix(lambda X: X[:, 0] < -0.49)
        beam.add_traction(lambda X: X[:, 0] > 0.49, (300.0, 2000.0, -500.0))
    if 1 in orders:
        numbers = {"young": np.linspace(4e4, 1e5, 6), "poisson": np.linspace(0, 0.4, 6), "density": np.linspace(5e2, 1e3, 6)}
        material, six = rubber(SVK, volume_floor=0.5, **damping), cube((3, 0, 0), pattern="six")
        block = scene.add_body(six, material, name="block", velocity=(0.5, 0, -0.3), **numbers)
        block.fix([0, 1], axes="x")
        block.add_force([5, 6, 7], (30.0, -10.0, 20.0))
        softer = rubber(SVK, young=7e4, poisson=0.2, density=1500.0, volume_floor=0.3)
        scene.add_body(cube((6, 0, 0)), softer, name="flyer")
    return scene


def vectors(rig, name: str):
    """A field of 3-vectors at the nodes that is allocated once."""
    if not hasattr(rig, name):
        setattr(rig, name, rig.vectors(name))
    return getattr(rig, name)


def forces(rig, x: np.ndarray, model=None) -> np.ndarray:
    """Elastic forces (n,3) [N]."""
    model, out = model or rig.model, vectors(rig, "force")
    model.state.x.from_numpy(x)
    model.state.element_force.fill(np.nan)  # entries that are read but not written give nan
    elasticity.elastic_forces(model)
    elasticity.gather_forces(model, out)
    return out.to_numpy()


def differential(rig, x: np.ndarray, dx: np.ndarray) -> np.ndarray:
    """Change of the elastic forces along dx (n,3) [N]."""
    direction, out = vectors(rig, "dx"), vectors(rig, "product")
    rig.model.state.x.from_numpy(x)
    direction.from_numpy(dx)
    elasticity.force_differential(rig.model, direction, out)
    return out.to_numpy()


def energy(rig, x: np.ndarray, model=None) -> float:
    """Elastic energy [J]; measures the others, too."""
    model = model or rig.model
    model.state.x.from_numpy(x)
    measure(model)
    return model.state.scalars[ELASTIC]


def added(rig, x: np.ndarray, beta: float, projected: bool = False) -> np.ndarray:
    """What terms but elasticity add to `rig.matrix` in an implicit step, dense."""
    rig.model.state.x.from_numpy(x)
    rig.matrix.value.fill(0.0)
    rig.matrix.diagonal.fill(0.0)
    block_csr.to_system(rig.model, rig.matrix, rig.matrix, int(projected), 0.0, beta)
    return block_csr.to_bsr(rig.model, rig.matrix).toarray()
