"""Cases of reference problems, their checks, and shared helpers for scenes and nodes.

A case gets the problem's file as a dict and the arch, computes in f64, and returns checks. On the same mesh with the same
element, numbers must agree to solver tolerance: the check has a limit. Against a value converged in space, the check only shows
the discretisation error.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

import taisoft as ts
from taisoft.errors import TaisoftError
from taisoft.scene.scene import Body

LAWS = {"SNH": "stable_neo_hookean", "COR": "corotational", "SVK": "st_venant_kirchhoff"}
GRAVITY = 9.8  # m/s^2 along -y, in every problem that has any
SAME_MESH = 1e-6  # relative uncertainty of values computed on the same mesh


@dataclass(frozen=True)
class Check:
    """A measured number and its reference. error: relative unless the quantity states otherwise; limit None: only shown."""

    quantity: str
    measured: float
    reference: float
    error: float
    limit: float | None = None

    @property
    def passed(self) -> bool:
        """Whether the error is within the limit; nan never is."""
        return math.isfinite(self.error) if self.limit is None else bool(self.error <= self.limit)

    @property
    def verdict(self) -> str:
        """pass, FAIL, or - without a limit."""
        return "FAIL" if not self.passed else "-" if self.limit is None else "pass"


def computed(compute: Callable[[], Iterable[Check]]) -> list[Check]:
    """The checks of a computation; if it fails, one failed check with the reason."""
    try:
        return list(compute())
    except TaisoftError as error:
        return [Check(f"failed: {error}", math.nan, math.nan, math.nan, 0.0)]


@dataclass(frozen=True)
class Case:
    """One computation of a problem. fine: only run by the benchmark, since it is too long for the tests."""

    problem: str  # the reference file's name
    law: str
    mesh: str
    compute: Callable[[dict, str], Iterable[Check]]  # (reference, arch) -> checks
    fine: bool = False
    closed_form: bool = False  # the reference is a formula in the code, and there is no file
    precision: str = "f64"

    @property
    def name(self) -> str:
        """problem-law-mesh, unique among the cases."""
        return "-".join(part.replace(" ", "_") for part in (self.problem, self.law, self.mesh) if part)


def near(quantity: str, measured: float, reference: float, limit: float | None = None, scale: float | None = None) -> Check:
    """A check of |measured - reference| over `scale`, by default |reference|."""
    scale = abs(reference) if scale is None else scale
    return Check(quantity, float(measured), float(reference), float(abs(measured - reference) / scale), limit)


def small(quantity: str, measured: float, limit: float) -> Check:
    """A check that a number is 0 within `limit`."""
    return Check(quantity, float(measured), 0.0, abs(float(measured)), limit)


def reported(quantity: str, error: float) -> Check:
    """An error without a limit."""
    return Check(quantity, float(error), 0.0, abs(float(error)))


def order(quantity: str, coarse: float, fine: float, expected: float, limit: float | None) -> Check:
    """A check of the observed order log2(coarse/fine) of two errors, with step or mesh width halved."""
    observed = math.log2(coarse / fine) if coarse > 0.0 and fine > 0.0 else math.nan
    return Check(quantity, observed, expected, abs(observed - expected), limit)


def material(reference: dict, law: str) -> ts.Material:
    """The problem's material with one of LAWS; 1 kg/m^3 if the problem has no mass."""
    numbers = reference["material"]
    return ts.Material(law=LAWS[law], young=numbers["E"], poisson=numbers["nu"], density=numbers["rho"] or 1.0)


def scene(gravity: bool = False) -> ts.Scene:
    """An empty scene without contact forces, with the problems' gravity or none."""
    made = ts.Scene(gravity=(0.0, -GRAVITY if gravity else 0.0, 0.0))
    made.contact_forces = False
    return made


def label(cells) -> str:
    """11x2x2 for the cells (11, 2, 2)."""
    return "x".join(str(c) for c in cells)


def face(axis: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    """A selector of the points (n,3) with coordinate `axis` equal to `value` [m], for fix, move and add_traction."""
    return lambda X: np.abs(X[:, axis] - value) < 1e-9 * max(1.0, np.abs(X).max())


def nearest(points: np.ndarray, point) -> np.ndarray:
    """Indices of the points (n,d) nearest to a point (d,) [m]; several if equally near."""
    distance = np.linalg.norm(points - np.asarray(point, float), axis=1)
    return np.flatnonzero(distance <= distance.min() + 1e-9 * np.ptp(points))


def submesh(mesh: ts.TetMesh, chosen: np.ndarray) -> ts.TetMesh:
    """The chosen tets (m,) bool of a mesh, with their vertices."""
    used, tets = np.unique(mesh.tets[chosen], return_inverse=True)
    return ts.TetMesh(mesh.vertices[used], tets.reshape(-1, 4))


def rotation(axis, angle: float) -> np.ndarray:
    """Rodrigues' rotation matrix (3,3) about an axis by an angle [rad]."""
    K = np.cross(np.eye(3), np.asarray(axis, float) / np.linalg.norm(axis))
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def deformation_gradients(body: Body, x: np.ndarray) -> np.ndarray:
    """F of every tet (m,3,3) at the positions x (n,3), computed on the host from the definition."""
    X, tets = body.rest_positions, body.mesh.tets
    rest, now = X[tets[:, 1:]] - X[tets[:, :1]], x[tets[:, 1:]] - x[tets[:, :1]]
    return np.linalg.solve(rest, now).transpose(0, 2, 1)


def worst(checks: Iterable[Check], what: str) -> Check:
    """The check with the largest error of several, renamed `what`; nan counts as largest."""
    checks = list(checks)
    found = max(checks, key=lambda check: math.inf if math.isnan(check.error) else check.error)
    return replace(found, quantity=f"{what}, worst of {len(checks)}: {found.quantity}")
