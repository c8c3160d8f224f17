"""PyBullet's deformable bodies on the works: stable neo-Hookean, explicit elasticity, equal nodal masses.

Meshes are loaded from files; anchors fix nodes. Mass springs (loadSoftBody's useMassSpring) are off, damping is zero. Contact
between soft bodies is a spring of `repulsion` [N/m] and a velocity solve, contact with the ground a velocity solve with a margin.
"""

import contextlib
import ctypes
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

import taisoft as ts
from taisoft.errors import SimulationError
from taisoft.machine import require

from ..exact_path import DENSITY, POISSON
from ..works.references import PYBULLET
from ..works.scenes import Body, Work
from .session import Session, Setting

NAME, MODEL = "PyBullet", PYBULLET
MARGIN = 1e-3  # m


def load():
    """The package. Raises SimulationError where it is absent."""
    with _silent():
        return require("pybullet", "the comparison with PyBullet", "peers", SimulationError)


def settings(work: Work, arch: str = "cpu") -> list[Setting]:
    """Steps from about the largest stable one on; with several bodies two repulsion stiffnesses."""
    steps = {"W2": (3, 4, 8, 16), "W3": (6, 8), "W4": (20,)}.get(work.key, (4, 8))
    if work.cells is not None:
        tets, young = work.tets, work.bodies[0].young
        steps = {540: (2, 4, 8), 4320: (5, 10), 34560: (11,)}[tets] if young == 1e6 else {1e8: (20,), 1e9: (62,)}[young]
    repulsions = ({"repulsion": 1e3}, {"repulsion": 1e5}) if len(work.bodies) > 1 else ({},)
    return [Setting(NAME, MODEL, "explicit", n, options) for n in steps for options in repulsions]


class Run(Session):
    """Each reset rebuilds the world."""

    def build(self) -> None:
        self.bullet = load()
        with _silent():
            self.here = {"physicsClientId": self.bullet.connect(self.bullet.DIRECT)}
            self.reset()

    def reset(self) -> None:
        bullet, here = self.bullet, self.here
        bullet.resetSimulation(bullet.RESET_USE_DEFORMABLE_WORLD, **here)
        bullet.setGravity(0, -self.work.gravity, 0, **here)
        bullet.setPhysicsEngineParameter(numSubSteps=0, **here)
        bullet.setTimeStep(self.setting.dt, **here)
        if self.work.ground:
            # soft bodies come to rest 0.1 m above its own planes, whatever the margins
            box = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[5, 1, 5], **here)
            ground = bullet.createMultiBody(0, box, basePosition=[0, -1, 0], **here)
            bullet.changeDynamics(ground, -1, lateralFriction=self.work.friction, **here)
        self.bodies = [self._load(body) for body in self.work.bodies]

    def _load(self, body: Body) -> int:
        several = len(self.work.bodies) > 1
        material = ts.Material(young=body.young, poisson=POISSON)
        numbers = {
            "mass": DENSITY * float(body.mesh.volumes.sum()),
            "useNeoHookean": 1,
            "NeoHookeanMu": 4 / 3 * material.mu,
            "NeoHookeanLambda": material.lam + 5 / 6 * material.mu,
            "NeoHookeanDamping": 0.0,
            "collisionMargin": MARGIN,
            "frictionCoeff": self.work.friction,
            "useFaceContact": int(several),
            "useSelfCollision": 0,
        }
        if several:
            numbers["repulsionStiffness"] = self.setting.options["repulsion"]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "body.vtk"
            path.write_text(_vtk(body))
            made = self.bullet.loadSoftBody(str(path), **numbers, **self.here)
        if np.abs(self._positions_of(made) - body.mesh.vertices).max() > 1e-9:
            raise SimulationError(f"{NAME} has reordered the nodes of {body.name!r}")
        for node in np.flatnonzero(body.fixed):
            self.bullet.createSoftBodyAnchor(made, int(node), -1, -1, **self.here)
        return made

    def run(self, follow: bool) -> tuple[np.ndarray | None, float]:
        with _silent():
            return super().run(follow)

    def step(self) -> None:
        for _ in range(self.setting.steps):
            self.bullet.stepSimulation(**self.here)

    def positions(self) -> np.ndarray:
        return np.concatenate([self._positions_of(body) for body in self.bodies])

    def _positions_of(self, body: int) -> np.ndarray:
        return np.array(self.bullet.getMeshData(body, -1, flags=self.bullet.MESH_DATA_SIMULATION_MESH, **self.here)[1])

    def close(self) -> None:
        self.bullet.disconnect(**self.here)


def _vtk(body: Body) -> str:
    """The mesh as a legacy VTK file in the layout that PyBullet reads."""
    points = "\n".join("{:.17g} {:.17g} {:.17g}".format(*x) for x in body.mesh.vertices)
    cells = "\n".join("4 {} {} {} {}".format(*tet) for tet in body.mesh.tets)
    n, m = body.mesh.n_verts, body.mesh.n_tets
    head = f"# vtk DataFile Version 2.0\nbody\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {n} double"
    return f"{head}\n{points}\nCELLS {m} {5 * m}\n{cells}\nCELL_TYPES {m}\n" + "10\n" * m


@contextlib.contextmanager
def _silent():
    """Context that discards the output of PyBullet's library, which C buffers until it is flushed."""
    library = ctypes.CDLL(None)
    sys.stdout.flush()
    kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        library.fflush(None)
        os.dup2(kept, 1)
        os.close(kept)
        os.close(nowhere)
