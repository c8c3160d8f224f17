"""Material, ground and cube of the scenes with contacts: those that have them share their kernels."""

import numpy as np

import taisoft as ts

SIDE = 0.1  # [m] of the cubes
FRICTION = 0.5


def material(**numbers) -> ts.Material:
    """A soft material with friction and mass damping, which is small by default."""
    return ts.Material(**{"young": 1e5, "poisson": 0.3, "density": 1000.0, "friction": FRICTION, "mass_damping": 0.01, **numbers})


def ground() -> ts.HalfSpace:
    """The half-space below y = 0."""
    return ts.HalfSpace((0, 0, 0), (0, 1, 0))


def cube(cells: int, seed: int | None = None) -> ts.TetMesh:
    """A cube of that many cells along each side, bottom at y = 0; seed: of the shifts of its vertices."""
    mesh = ts.box_mesh((cells,) * 3, (SIDE,) * 3, (0, 0.5 * SIDE, 0))
    if seed is None:
        return mesh
    return ts.TetMesh(mesh.vertices + np.random.default_rng(seed).uniform(-0.01, 0.01, mesh.vertices.shape), mesh.tets)
