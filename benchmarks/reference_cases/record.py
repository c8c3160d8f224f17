"""What a case of a reference problem is, what it finds, and what all cases share: checks, scenes, choices of nodes.

A case gets the problem's file as a dict and the arch, computes in f64, and returns checks. Two kinds of error are kept
apart: on the same mesh with the same element the numbers must agree to solver tolerance, and the check has a limit;
against a value converged in space the error is the mesh's own, and the check has none: it is only shown.
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
SAME_MESH = 1e-6  # relative: what the values computed on the same mesh are good to


@dataclass(frozen=True)
class Check:
    """A measured number beside its reference. error: relative unless the quantity says else; limit None: only reported."""

    quantity: str
    measured: float
    reference: float
    error: float
    limit: float | None = None

    @property
    def passed(self) -> bool:
        """Whether the error is within the limit; one that is not a number never is."""
        return math.isfinite(self.error) if self.limit is None else bool(self.error <= self.limit)

    @property
    def verdict(self) -> str:
        """pass, FAIL, or - where there is no limit."""
        return "FAIL" if not self.passed else "-" if self.limit is None else "pass"


def computed(compute: Callable[[], Iterable[Check]]) -> list[Check]:
    """The checks of a computation; of one that fails, a check that says why and has not passed."""
    try:
        return list(compute())
    except TaisoftError as error:
        return [Check(f"failed: {error}", math.nan, math.nan, math.nan, 0.0)]


@dataclass(frozen=True)
class Case:
    """One computation of a problem. fine: too long for the tests, only the benchmark runs it."""

    problem: str  # the reference file's name
    law: str
    mesh: str
    compute: Callable[[dict, str], Iterable[Check]]  # (reference, arch) -> checks
    fine: bool = False

    @property
    def name(self) -> str:
        """problem-law-mesh, unique among the cases."""
        return "-".join(part.replace(" ", "_") for part in (self.problem, self.law, self.mesh) if part)


def near(quantity: str, measured: float, reference: float, limit: float | None = None, scale: float | None = None) -> Check:
    """A check of |measured - reference| over `scale`, by default |reference|."""
    scale = abs(reference) if scale is None else scale
    return Check(quantity, float(measured), float(reference), float(abs(measured - reference) / scale), limit)


def small(quantity: str, measured: float, limit: float) -> Check:
    """A check that a number which ought to be 0 stays below `limit`."""
    return Check(quantity, float(measured), 0.0, abs(float(measured)), limit)


def reported(quantity: str, error: float) -> Check:
    """An error without a limit."""
    return Check(quantity, float(error), 0.0, abs(float(error)))


def order(quantity: str, coarse: float, fine: float, expected: float, limit: float | None) -> Check:
    """A check of the observed order log2(coarse/fine) of two errors, the step or the mesh width being halved."""
    observed = math.log2(coarse / fine) if coarse > 0.0 and fine > 0.0 else math.nan
    return Check(quantity, observed, expected, abs(observed - expected), limit)


def material(reference: dict, law: str) -> ts.Material:
    """The problem's material with one of LAWS; where the problem has no mass, the density is 1 kg/m^3."""
    numbers = reference["material"]
    return ts.Material(law=LAWS[law], young=numbers["E"], poisson=numbers["nu"], density=numbers["rho"] or 1.0)


def scene(gravity: bool = False) -> ts.Scene:
    """An empty scene with the problems' gravity or with none, whose bodies pass through each other."""
    made = ts.Scene(gravity=(0.0, -GRAVITY if gravity else 0.0, 0.0))
    made.contact_forces = False
    return made


def label(cells) -> str:
    """11x2x2 for the cells (11, 2, 2)."""
    return "x".join(str(c) for c in cells)


def face(axis: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    """A choice of the points (n,3) whose coordinate `axis` is `value` [m], for fix, move and add_traction."""
    return lambda X: np.abs(X[:, axis] - value) < 1e-9 * max(1.0, np.abs(X).max())


def nearest(points: np.ndarray, point) -> np.ndarray:
    """Indices of the points (n,d) nearest to a point (d,) [m]; all of them where several are equally near."""
    distance = np.linalg.norm(points - np.asarray(point, float), axis=1)
    return np.flatnonzero(distance <= distance.min() + 1e-9 * np.ptp(points))


def submesh(mesh: ts.TetMesh, chosen: np.ndarray) -> ts.TetMesh:
    """The chosen tets of a mesh (m,) bool, with the vertices that they use."""
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
    """The check with the largest error of several alike, called `what`; one that is not a number counts as largest."""
    checks = list(checks)
    found = max(checks, key=lambda check: math.inf if math.isnan(check.error) else check.error)
    return replace(found, quantity=f"{what}, worst of {len(checks)}: {found.quantity}")
