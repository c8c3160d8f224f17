"""Quantities of a run, such as a contact force, with errors from their values in runs of other steps, tolerances and meshes.

A quantity is a function of the simulator, or a text of a kind (KINDS), a dot and a component unless it is the default, and names:
    contact_force.x finger fruit, contact_torque.z press, reaction.y beam, max_pressure ball
    displacement.y beam 4 0.5 0.5, stress.xx beam 0 0.5 0.5: at a point of the body at rest, found anew in the mesh of each run
The default is the length of a vector, and the von Mises stress, of means over the tets at each vertex.

Three levels show an order, else it is assumed. In the mesh width, forces converge with order 1 where slip or corners rule and
with 2 in smooth contact: MESH_ORDER lies between, and is wrong by less than a factor of 2 either way. Weak: two levels may agree
by chance, as where a quantity is not monotone in the width.
"""

import shlex
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from taisoft.errors import SceneError, TaisoftError, reworded
from taisoft.estimation.order import error_over_difference, observed_order
from taisoft.output.nodal_fields import von_mises
from taisoft.records import Quantity, RunReport
from taisoft.scene import checks
from taisoft.scene.body import Body
from taisoft.scene.connections import check_inside
from taisoft.scene.locate import locate
from taisoft.scene.rigid import RigidBody

if TYPE_CHECKING:
    from taisoft.estimation.companions import Companion
    from taisoft.simulator import Simulator

MESH_ORDER = 1.5  # of quantities in the mesh width: see above


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
    made = {}
    for name, one in checks.check_solver(quantities=given or {})["quantities"].items():
        with reworded(SceneError, f"quantity {name!r}: "):
            made[name] = Definition(one) if callable(one) else _parsed(sim, one)
    return made


def measure_at_end(sim: "Simulator", measured: dict[str, Definition], report: RunReport) -> None:
    """Add quantities of the present state to the report of a run, which one without a value degrades."""
    for name, definition in measured.items():
        value, reason = definition.measure(sim)
        report.quantities[name] = Quantity(value=value, unit=definition.unit)
        if reason:
            report.quantities[name].notes.append(f"the value of {name!r} is unknown: {reason}")
            report.degrade(*report.quantities[name].notes)
        if unsolved := sum(not one.converged for one in report.step_reports):
            report.quantities[name].notes.append(f"steps of the run did not converge ({unsolved}): no error tells what that does")


def columns(sim: "Simulator", measured: dict[str, Definition]) -> dict[str, float]:
    """Return the present values of quantities by their headings in steps.csv, NaN without a value."""
    values = {f"quantity {name}" + (f" [{one.unit}]" if one.unit else ""): one.measure(sim)[0] for name, one in measured.items()}
    return {heading: np.nan if value is None else value for heading, value in values.items()}


# --- texts ------------------------------------------------------------------------------------------------------------


def _parsed(sim: "Simulator", text: str) -> Definition:
    """Return what a text means, measured once to check it. Raises SceneError."""
    try:
        kind, *words = shlex.split(text)
    except ValueError:  # an open quotation mark, or no word
        raise SceneError(f"{text!r} must begin with its kind, and quotation marks must be closed") from None
    kind, _, component = kind.partition(".")
    function, unit, (least, most, what), components = KINDS[checks.choice(kind, "its kind", tuple(KINDS))]
    if component:
        checks.choice(component, f"the component of {kind}", components or ("none",))
    if not least <= len(words) <= most:
        raise SceneError(f"{text!r} must name {kind} of {what}")
    if most == 2 and not sim.touches:
        raise SceneError("contact forces are not simulated here")
    arguments = words if most < 4 else [words[0], _point(sim.scene.body(words[0]), words[1:])]

    def value(sim: "Simulator") -> float:
        found = function(sim, *arguments)
        if len(component) == np.ndim(found):
            return found[tuple(map("xyz".index, component))] if component else found
        return von_mises(found) if np.ndim(found) == 2 else np.linalg.norm(found)

    value(sim)
    return Definition(value, unit)


def _point(body: Body, words: list[str]) -> np.ndarray:
    """Return a point (3,) [m] of a body at rest. Raises SceneError."""
    try:
        point = np.array([float(word) for word in words])
        check_inside(body, point, "the point")
    except ValueError:
        raise SceneError(f"{' '.join(words)!r} must be three finite numbers, a point of the body at rest [m]") from None
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


PAIR = (1, 2, "one thing that touches, or on one by another")  # least and most words after the kind, and what they are
BODY = (1, 1, "one body")
POINT = (4, 4, "a body and three coordinates of a point")
AXES, PLANES = ("x", "y", "z"), ("xx", "yy", "zz", "xy", "yz", "xz")
KINDS = {  # kind -> function of a simulator, names and point; unit; words; components
    "contact_force": (lambda sim, *names: sim.contact_force(*names), "N", PAIR, AXES),
    "contact_torque": (lambda sim, *names: sim.contact_torque(*names), "N m", PAIR, AXES),
    "reaction": (lambda sim, name: sim.reactions(name).sum(axis=0), "N", BODY, AXES),
    "displacement": (_displacement, "m", POINT, AXES),
    "stress": (_stress, "Pa", POINT, PLANES),
    "max_pressure": (lambda sim, name: sim.contact_pressure(name).pressure.max(), "Pa", BODY, ()),
}


# --- errors -----------------------------------------------------------------------------------------------------------


class LevelError(NamedTuple):
    """Error of a quantity. order: as observed, else None. reason: why the error is None, or the range of the values."""

    error: float | None
    order: float | None = None
    reason: str = ""


def error_of_levels(
    values: Sequence, sizes: Sequence[float], nominal: float, most: float = 2.0, negligible: float = 0.0
) -> LevelError:
    """Estimate the error of a quantity from its values on two or three levels: steps, load steps, mesh widths or tolerances.

    values: (levels,), or (levels, k) at k times, of which the last counts, and the others only for the order; those of the run
    come first. sizes: (levels,) of the steps, widths or tolerances over those of the run. nominal: order assumed of two levels;
    most: highest order that three show, since a higher one may be chance. negligible: difference that is rounding. Three levels
    that approach each other, but show no order, give the range of their values; of others the error is unknown.
    """
    values, sizes = np.reshape(np.asarray(values, dtype=float), (len(sizes), -1)), np.asarray(sizes, dtype=float)
    if not np.isfinite(values[:, -1]).all():
        return LevelError(None, reason="it has no value on one of the levels")
    finest_first = np.argsort(sizes)
    values, sizes = values[finest_first][:, np.isfinite(values).all(axis=0)], sizes[finest_first]
    differences, near, order = np.diff(values, axis=0), sizes[1] / sizes[0], None
    rms = np.sqrt(np.mean(differences**2, axis=1))
    if len(sizes) > 2 and rms[0] > negligible:
        for one in (differences, differences[:, -1:]):  # earlier ones may have parted, and be forgotten
            fine, coarse = np.sqrt(np.mean(one**2, axis=1))
            if order is None and np.sum(one[0] * one[1]) > 0.0:  # else not monotone
                order = observed_order(fine, coarse, most, near, sizes[2] / sizes[1])
        if order is None:
            listed = ", ".join(f"{value:.6g}" for value in values[:, -1])
            reason = f"its values on three levels, {listed}, show no order"
            return LevelError(float(np.ptp(values[:, -1])) if fine <= coarse else None, reason=reason)
    assumed = nominal if order is None else order
    return LevelError(float(abs(differences[0, -1]) * error_over_difference(near, assumed) / sizes[0] ** assumed), order)


class Samples:
    """Values of quantities in a run and its companions, at each comparison."""

    def __init__(self, quantities: dict[str, Definition]):
        self._quantities = quantities
        self._time = 0.0  # of the last comparison [s]
        self._values: dict[tuple, list[float]] = {}  # by name and companion, None for the run; NaN where there is none
        self._reasons: dict[tuple, str] = {}  # why the last one is NaN

    def add(self, sim: "Simulator", companions: list["Companion"]) -> None:
        """Measure in the run and in those of its companions that have not failed."""
        self._time = sim.time
        for name, definition in self._quantities.items():
            for one in (None, *(one for one in companions if not one.failed)):
                value, self._reasons[name, one] = definition.measure(sim if one is None else one.sim)
                self._values.setdefault((name, one), []).append(np.nan if value is None else value)

    def set_errors(self, found: dict[str, Quantity], levels: dict[str, tuple], time: float, rounding: float) -> None:
        """Set the errors of the quantities of a run that ended at `time` [s].

        levels: by kind of error, companions, and sizes, nominal and highest order as in `error_of_levels`, but sizes are None
        where the difference itself counts; solvers first. rounding: of values, relative to the largest.
        """
        for name, quantity in found.items():
            quantity.solver = 0.0  # where nothing is solved
            for kind, (companions, *how) in levels.items():
                error, order, reason = self._error(name, companions, *how, rounding, quantity.solver or 0.0)
                setattr(quantity, kind, error)
                quantity.orders |= {} if order is None else {kind: order}
                what = "unknown" if error is None else "the range of its values"
                quantity.notes += [f"the error of {name!r} in {kind} is {what}: {reason}"] if reason else []
                unsolved = [f"{one.what} ({one.unconverged} of {one.reports})" for one in companions if one.unconverged]
                quantity.notes += [f"steps of a companion did not converge: {', '.join(unsolved)}"] if unsolved else []
            if abs(self._time - time) > 1e-9 * time:
                quantity.notes.append(
                    f"the errors of {name!r} are those at t = {self._time:.6g} s, where companions meet the run"
                )

    def _error(
        self, name: str, companions: list, sizes: list | None, nominal: float, most: float, rounding: float, solved: float
    ):
        for one in (None, *companions):
            if reason := self._reasons.get((name, one)) or (one and one.failed):
                return LevelError(None, reason=f"in the {f'companion with {one.what}' if one else 'run'}, {reason}")
        values = np.array([self._values[name, one] for one in (None, *companions)])
        if sizes is None:
            return LevelError(float(abs(values[1, -1] - values[0, -1])))
        negligible = max(rounding * float(np.nanmax(np.abs(values))), solved)  # errors of the solvers show no order
        return error_of_levels(values, (1.0, *sizes), nominal, most, negligible)
