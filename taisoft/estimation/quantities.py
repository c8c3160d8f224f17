"""Quantities of a run, such as a contact force, with errors from their values in runs of other steps, tolerances and meshes.

A quantity is a function of the simulator, or a text: a kind, a dot and a component unless it is the default, and what it is of,
    contact_force.x finger fruit        [N]    on the first by the second, or by all others; contact_torque likewise [N m]
    reaction.y beam                     [N]    sum of the constraint forces on a body
    displacement.y beam 4 0.5 0.5       [m]    since the start, of the point that is there at rest
    stress.xx beam 0 0.5 0.5            [Pa]   Cauchy stress, by default von Mises, as means over the tets at each vertex
    max_pressure ball                   [Pa]   of the contacts of a body
Components of vectors are x, y and z, by default the length. Points are found anew in the mesh of each run.

The error follows from the observed order (`order`) where there are three levels, else from a nominal one. In time that is the
integrator's. In the mesh width, forces fall with order 1 where slip or corners rule and with 2 in smooth contact: MESH_ORDER lies
between, and is wrong by at most a factor of 1.9 either way. Weak: two levels may agree by chance, as where a quantity is not
monotone in the width; three show that.
"""

import shlex
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from taisoft.errors import SceneError, TaisoftError
from taisoft.estimation.order import MIN_ORDER, error_over_difference, observed_order
from taisoft.output.nodal_fields import von_mises
from taisoft.records import Quantity, RunReport
from taisoft.scene import checks
from taisoft.scene.connection_records import MAX_OUTSIDE
from taisoft.scene.locate import locate
from taisoft.scene.rigid import RigidBody

if TYPE_CHECKING:
    from taisoft.estimation.twins import Twin
    from taisoft.simulator import Simulator

MESH_ORDER = 1.5  # of quantities in the mesh width: see above
SOLVER_ORDER = 1  # errors are about proportional to the tolerances


# --- definitions ------------------------------------------------------------------------------------------------------


class Definition(NamedTuple):
    """What is measured, and its unit, "" if unknown."""

    function: Callable[["Simulator"], float]
    unit: str = ""

    def measure(self, sim: "Simulator") -> tuple[float | None, str]:
        """Return the value in the present state of a simulator; or None, and why there is none."""
        try:
            return checks.number(self.function(sim), "its value"), ""
        except Exception as error:  # a function of the user may raise anything
            kind = "" if isinstance(error, TaisoftError) else f"{type(error).__name__}: "
            return None, kind + " ".join(str(error).split())


def definitions(sim: "Simulator", given: dict | None) -> dict[str, Definition]:
    """Return the quantities given to a run, by name. Raises SceneError for what is neither a function nor a valid text."""
    given = checks.check_solver(quantities=given or {})["quantities"]
    return {name: Definition(one) if callable(one) else _parsed(sim, f"quantity {name!r}", one) for name, one in given.items()}


def _parsed(sim: "Simulator", what: str, text: str) -> Definition:
    try:
        kind, *words = shlex.split(text)
    except ValueError:  # an open quotation mark, or no word
        raise SceneError(f"{what}: {text!r} must begin with its kind, and quotation marks must be closed") from None
    kind, _, component = kind.partition(".")
    function, unit, names, components = KINDS[checks.choice(kind, f"{what}: its kind", tuple(KINDS))]
    if component:
        checks.choice(component, f"{what}: the component of {kind}", components or ("none",))
    if not names[0] <= len(words) <= names[1]:
        raise SceneError(f"{what}: {text!r} must name {kind}{names[2]}")
    if names is OF_POINT:
        words = [words[0], _point(sim, what, *words)]

    def value(sim: "Simulator") -> float:
        found = function(sim, *words)
        if not components:
            return found
        if len(component) == found.ndim:
            return found[tuple("xyz".index(axis) for axis in component)]
        return von_mises(found) if found.ndim == 2 else np.linalg.norm(found)

    if names is OF_PAIR and not sim.touches:
        raise SceneError(f"{what}: contact forces are not simulated here")
    try:
        value(sim)
    except SceneError as error:
        raise SceneError(f"{what}: {error}") from None
    return Definition(value, unit)


def measure_at_end(sim: "Simulator", measured: dict[str, Definition], report: RunReport) -> None:
    """Add quantities of the present state to the report of a run, which one without a value degrades."""
    for name, definition in measured.items():
        value, reason = definition.measure(sim)
        report.quantities[name] = made = Quantity(value=value, unit=definition.unit)
        if reason:
            made.notes.append(f"the value of {name!r} is unknown: {reason}")
            report.problems += made.notes
            report.status = "degraded" if report.status == "ok" else report.status


def _point(sim: "Simulator", what: str, name: str, *words: str) -> np.ndarray:
    """Return a point (3,) [m] of a body at rest."""
    try:
        point = np.array([checks.number(float(word), f"{what}: a coordinate") for word in words])
    except ValueError:
        raise SceneError(f"{what}: {' '.join(words)!r} must be three numbers, a point of the body at rest [m]") from None
    try:
        body = sim.scene.body(name)
    except SceneError as error:
        raise SceneError(f"{what}: {error}") from None
    outside = float(locate(body, point[None])[2][0])
    if outside > MAX_OUTSIDE:
        raise SceneError(f"{what}: the point lies outside of body {name!r}, by {outside:.2g} times {body.extent}")
    return point


def _displacement(sim: "Simulator", name: str, point: np.ndarray) -> np.ndarray:
    body = sim.scene.body(name)
    nodes, weights, _ = locate(body, point[None])
    return weights[0] @ sim.positions(name)[nodes[0]] - point - body.position


def _stress(sim: "Simulator", name: str, point: np.ndarray) -> np.ndarray:
    body = sim.scene.body(name)
    if isinstance(body, RigidBody):
        raise SceneError(f"body {name!r} is rigid: its stress is not modelled")
    corners = locate(body, point[None])[0][0, :4]
    x = body.mesh.vertices[corners]
    upper = np.linalg.solve((x[1:] - x[0]).T, point - x[0])  # barycentric coordinates but the first
    volumes = (body.mesh.tets[:, :, None] == corners).any(axis=1).T * body.mesh.volumes  # (4, n_tets), 0 away from the corner
    means = np.tensordot(volumes, sim.stress(name), 1) / volumes.sum(axis=1)[:, None, None]
    return means[0] + np.tensordot(upper, means[1:] - means[0], 1)


OF_PAIR = (1, 2, " of one thing that touches, or on one by another")
OF_BODY = (1, 1, " of one body")
OF_POINT = (4, 4, " of a body and three coordinates of a point")
TENSOR = ("xx", "yy", "zz", "xy", "yz", "xz")
KINDS = {  # kind -> function of a simulator and the words; unit; least and most words, and what they are; components
    "contact_force": (lambda sim, *names: sim.contact_force(*names), "N", OF_PAIR, ("x", "y", "z")),
    "contact_torque": (lambda sim, *names: sim.contact_torque(*names), "N m", OF_PAIR, ("x", "y", "z")),
    "reaction": (lambda sim, name: sim.reactions(name).sum(axis=0), "N", OF_BODY, ("x", "y", "z")),
    "displacement": (_displacement, "m", OF_POINT, ("x", "y", "z")),
    "stress": (_stress, "Pa", OF_POINT, TENSOR),
    "max_pressure": (lambda sim, name: sim.contact_pressure(name).pressure.max(), "Pa", OF_BODY, ()),
}


# --- errors -----------------------------------------------------------------------------------------------------------


class LevelError(NamedTuple):
    """Error of a quantity. error: None if it cannot be told, and then the reason; order: as observed, None if assumed."""

    error: float | None
    order: float | None = None
    reason: str = ""


def error_of_levels(
    values: Sequence, sizes: Sequence[float], nominal: float, most: float = 2.0, negligible: float = 0.0
) -> LevelError:
    """Estimate the error of a quantity from its values on two or three levels: steps, load steps, mesh widths or tolerances.

    values: (levels,), or (levels, k) at k times, of which the last counts, and the others only for the order; those of the run
    come first. sizes: (levels,) of the steps, widths or tolerances over those of the run. nominal: order assumed of two levels;
    most: highest order that three show, since a higher one may be chance. negligible: difference that is rounding.
    """
    values, sizes = np.reshape(np.asarray(values, dtype=float), (len(sizes), -1)), np.asarray(sizes, dtype=float)
    if not np.isfinite(values[:, -1]).all():
        return LevelError(None, reason="it has no value on one of the levels")
    finest_first = np.argsort(sizes)
    values, sizes = values[finest_first][:, np.isfinite(values).all(axis=0)], sizes[finest_first]
    differences, near, order = np.diff(values, axis=0), sizes[1] / sizes[0], None
    largest = np.sqrt(np.mean(differences**2, axis=1))
    if len(sizes) > 2 and largest[0] > negligible:
        if np.sum(differences[0] * differences[1]) > 0.0:
            order = observed_order(largest[0], largest[1], most, near, sizes[2] / sizes[1])
        if order is None:
            return LevelError(
                None, reason=f"its values {_listed(values[:, -1])} on three levels show no order above {MIN_ORDER:g}"
            )
    assumed = nominal if order is None else order
    return LevelError(float(abs(differences[0, -1]) * error_over_difference(near, assumed) / sizes[0] ** assumed), order)


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.6g}" for value in values)


class Level(NamedTuple):
    """Twins that show one kind of error. sizes: over those of the run; None where the run is compared with a better method."""

    kind: str
    twins: Sequence["Twin"]
    sizes: Sequence[float] | None
    nominal: float
    most: float = 2.0


class Samples:
    """Values of quantities in a run and its twins, at each comparison."""

    def __init__(self, quantities: dict[str, Definition]):
        self._quantities = quantities
        self._time = 0.0  # of the last comparison [s]
        self._values: dict[tuple, list[float]] = {}  # by name and twin, None for the run; NaN where there is none
        self._reasons: dict[tuple, str] = {}  # why the last one is NaN

    def add(self, sim: "Simulator", twins: list["Twin"]) -> None:
        """Measure in the run and in those of its twins that have not failed."""
        self._time = sim.time
        for name, definition in self._quantities.items():
            for twin in (None, *(one for one in twins if not one.failed)):
                value, self._reasons[name, twin] = definition.measure(sim if twin is None else twin.sim)
                self._values.setdefault((name, twin), []).append(np.nan if value is None else value)

    def set_errors(self, found: dict[str, Quantity], levels: list[Level], time: float, rounding: float) -> None:
        """Set the errors of the quantities of a run that ended at `time` [s].

        levels: the solvers first; without them nothing is solved. rounding: of values, relative to the largest.
        """
        for name, quantity in found.items():
            quantity.solver = 0.0
            for level in levels:
                quantity_error = self._error(name, level, rounding, quantity.solver or 0.0)
                setattr(quantity, level.kind, quantity_error.error)
                if quantity_error.order is not None:
                    quantity.orders[level.kind] = quantity_error.order
                if quantity_error.reason:
                    quantity.notes.append(f"the error of {name!r} in {level.kind} is unknown: {quantity_error.reason}")
            if abs(self._time - time) > 1e-9 * time:
                quantity.notes.append(f"the errors of {name!r} are those at t = {self._time:.6g} s, where the twins meet the run")

    def _error(self, name: str, level: Level, rounding: float, solved: float) -> LevelError:
        """Return one kind of error. Differences below rounding, relative, or below the solvers' error show no order."""
        for twin in (None, *level.twins):
            where = "the run" if twin is None else f"the twin with {twin.what}"
            if reason := self._reasons.get((name, twin)) or (twin and twin.failed):
                return LevelError(None, reason=f"in {where}, {reason}")
        values = np.array([self._values[name, twin] for twin in (None, *level.twins)])
        if level.sizes is None:
            return LevelError(float(abs(values[1, -1] - values[0, -1])))
        negligible = max(rounding * float(np.nanmax(np.abs(values))), solved)
        return error_of_levels(values, (1.0, *level.sizes), level.nominal, level.most, negligible)
