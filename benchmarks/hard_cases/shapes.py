"""Meshes and scenes of the hard cases, and the shape error."""

import numpy as np

import taisoft as ts
from taisoft.mesh.nodes import make_nodes

from ..reference_cases.record import deformation_gradients, submesh

SNH, COR, SVK = "stable_neo_hookean", "corotational", "st_venant_kirchhoff"
G = 9.81  # [m/s^2]
DOWN = (0.0, -G, 0.0)
WEIGHTLESS = (0.0, 0.0, 0.0)


def box(cells, size, center=(0.0, 0.0, 0.0)) -> ts.TetMesh:
    """A grid of cells, each cut into six tets."""
    return ts.box_mesh(cells, size, center, pattern="six")


def cube(cells: int, edge: float) -> ts.TetMesh:
    """A cube-shaped `box`."""
    return box((cells,) * 3, (edge,) * 3)


def turn_about(axis: int, angle: float) -> np.ndarray:
    """(3,3) rotation about a coordinate axis by an angle [rad]."""
    turn, (c, s) = np.eye(3), (np.cos(angle), np.sin(angle))
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turn[a, a], turn[a, b], turn[b, a], turn[b, b] = c, -s, s, c
    return turn


def turned(mesh: ts.TetMesh, angle: float, axis: int) -> ts.TetMesh:
    """The mesh turned about a coordinate axis by an angle [rad]."""
    return ts.TetMesh(mesh.vertices @ turn_about(axis, angle).T, mesh.tets)


def voxels(filled: np.ndarray, edge: float, center=(0.0, 0.0, 0.0)) -> ts.TetMesh:
    """The filled voxels (nx,ny,nz) bool of a grid about a center [m], each cut as a cell of `box`."""
    whole = box(filled.shape, edge * np.array(filled.shape), center)
    return submesh(whole, filled.reshape(-1).repeat(6))


def one_body(name: str, mesh: ts.TetMesh, gravity=WEIGHTLESS, position=(0, 0, 0), velocity=(0, 0, 0), **material):
    """A scene with one body, by default of 1000 kg/m^3. Returns both."""
    scene = ts.Scene(gravity=gravity)
    stuff = ts.Material(**{"density": 1000.0} | material)
    return scene, scene.add_body(mesh, stuff, name=name, position=position, velocity=velocity)


def not_finite(*states: np.ndarray) -> float:
    """1 if a number of the states is not finite, else 0."""
    return float(not all(np.isfinite(state).all() for state in states))


def split(mesh: ts.TetMesh, times: int = 1) -> ts.TetMesh:
    """Split every tet into eight, `times` times."""
    for _ in range(times):
        finer = make_nodes(mesh, 2)
        mesh = ts.TetMesh(finer.positions, finer.tets)
    return mesh


def shape_error(rest: np.ndarray, x: np.ndarray, length: float) -> float:
    """Largest distance of the points x to the rest shape, both (n,3) [m], after the best rigid fit, over a length [m]."""
    a, b = rest - rest.mean(axis=0), x - x.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return float(np.linalg.norm(a @ (u @ mirror @ vt) - b, axis=1).max() / length)


def volume_ratios(sim: ts.Simulator, body: int = 0) -> np.ndarray:
    """J = det F of every tet of a body."""
    chosen = sim.scene.bodies[body]
    return np.linalg.det(deformation_gradients(chosen, sim.positions(chosen.name)))


def rest_at_last(sim: ts.Simulator, length: float) -> dict[str, float]:
    """Shape error over a length [m], inverted tets and smallest volume ratio of the only body."""
    J, x = volume_ratios(sim), sim.positions()
    return {
        "shape error at the end, over L": shape_error(sim.scene.bodies[0].rest_positions, x, length),
        "inverted tets at the end": float((J <= 0.0).sum()),
        "smallest volume ratio at the end": float(J.min()),
    }
