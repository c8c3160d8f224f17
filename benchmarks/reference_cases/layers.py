"""Bodies of two materials against beam theory in closed form: a bar in tension, and the bending and vibration of a layered beam.

Poisson's ratio is 0, so that layers do not squeeze each other. With layers i of height h_i, widths b, and y_i their middles,
    tension:    F = k u,   1/k = sum_i L_i / (E_i A),
    bending:    w = F L^3 / (3 B) + F L / S,   B = sum_i E_i b h_i (h_i^2/12 + (y_i - y_0)^2),   S: Timoshenko's shear stiffness,
    vibration:  f = 1.8751^2 / (2 pi L^2) sqrt(B / (sum_i rho_i b h_i)),
with the neutral axis at y_0 = sum E_i h_i y_i / sum E_i h_i. Of w the part of shear is below 0.1 % here, so S may be that of a
homogeneous beam of the mean modulus. Lengths are at least 24 heights.
"""

from functools import partial

import numpy as np

import taisoft as ts

from .record import LAWS, Case, face, label, near, scene

LIMIT = 5e-3  # relative
FORCE = 1e-4  # [N]: strains stay below 1e-4, where all laws are Hooke's
STIFF, SOFT = {"young": 4e6, "density": 2500.0}, {"young": 1e6, "density": 1000.0}
LENGTH, HEIGHT, WIDTH = 2.4, 0.1, 0.1  # [m]


def layered(cells: tuple[int, int, int], axis: int, laws: tuple[str, str]) -> tuple[ts.Scene, object]:
    """A scene with a quadratic beam, fixed at x = 0, whose halves below and above its middle along an axis are stiff and soft."""
    box = ts.box_mesh(cells, (LENGTH, HEIGHT, WIDTH), (LENGTH / 2, 0.0, 0.0))
    middle = (LENGTH / 2, 0.0, 0.0)[axis]
    regions = np.where(box.vertices[box.tets].mean(axis=1)[:, axis] < middle, 1, 2)
    mesh = ts.TetMesh(box.vertices, box.tets, regions=regions, region_names={1: "stiff", 2: "soft"})
    numbers = {"stiff": STIFF, "soft": SOFT}
    materials = {name: ts.Material(law=LAWS[law], poisson=0.0, **numbers[name]) for name, law in zip(numbers, laws)}
    made = scene()
    beam = made.add_body(mesh, materials, name="beam", order=2)
    beam.fix(face(0, 0.0))
    return made, beam


def _end_displacement(made: ts.Scene, beam, direction: int, arch: str) -> float:
    """Mean displacement of the loaded end along a direction [m]."""
    beam.add_traction(face(0, LENGTH), FORCE / (HEIGHT * WIDTH) * np.eye(3)[direction])
    result = ts.solve_static(made, tolerance=1e-7, arch=arch)
    end = face(0, LENGTH)(beam.rest_positions)
    return float((result.positions("beam") - beam.rest_positions)[end, direction].mean())


def _bending_stiffness() -> float:
    E, y, h = np.array([STIFF["young"], SOFT["young"]]), np.array([-HEIGHT / 4, HEIGHT / 4]), HEIGHT / 2
    return float((E * WIDTH * h * (h**2 / 12 + (y - (E @ y) / E.sum()) ** 2)).sum())


def tension(laws: tuple[str, str], cells: tuple[int, int, int], _reference: dict, arch: str):
    """Two halves in series."""
    made, beam = layered(cells, 0, laws)
    compliance = sum(LENGTH / 2 / (numbers["young"] * HEIGHT * WIDTH) for numbers in (STIFF, SOFT))
    stiffness = FORCE / _end_displacement(made, beam, 0, arch)
    yield near("stiffness of the halves in series [N/m]", stiffness, 1.0 / compliance, LIMIT)


def bending(laws: tuple[str, str], cells: tuple[int, int, int], _reference: dict, arch: str):
    """A cantilever with a load at its end."""
    made, beam = layered(cells, 1, laws)
    shear = 5 / 6 * (STIFF["young"] + SOFT["young"]) / 2 / 2 * HEIGHT * WIDTH
    expected = FORCE * LENGTH**3 / (3 * _bending_stiffness()) + FORCE * LENGTH / shear
    yield near("deflection of the end [m]", _end_displacement(made, beam, 1, arch), expected, LIMIT)


def vibration(laws: tuple[str, str], cells: tuple[int, int, int], _reference: dict, arch: str):
    """The lowest frequency of a cantilever, in the plane of the layers' normal."""
    made, beam = layered(cells, 1, laws)
    beam.fix(lambda X: np.ones(len(X), dtype=bool), axes="z")
    per_length = (STIFF["density"] + SOFT["density"]) * HEIGHT / 2 * WIDTH
    expected = 1.875104**2 / (2 * np.pi * LENGTH**2) * np.sqrt(_bending_stiffness() / per_length)
    for mass in ("lumped", "consistent"):
        yield near(f"lowest frequency, {mass} mass [Hz]", ts.modes(made, 1, mass=mass).frequencies[0], expected, LIMIT)


def _case(problem: str, compute, laws: tuple[str, str], cells: tuple[int, int, int], fine: bool) -> Case:
    return Case(problem, "-".join(laws), label(cells), partial(compute, laws, cells), fine, closed_form=True)


CASES = tuple(
    _case(problem, compute, laws, cells, fine)
    for laws, cells, fine in ((("SVK", "COR"), (24, 2, 1), False), (("SNH", "SNH"), (48, 4, 2), True))
    for problem, compute in (("two_material_bar", tension), ("layered_beam", bending), ("layered_beam_vibration", vibration))
)
