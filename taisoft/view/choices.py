"""What can be chosen for pictures, the window and kept states: colours of bodies, layers, and plots over time.

Each is a row of a table here, from which options of the command line, scales, legends and menus follow. The command line reads
the tables before anything else, so nothing is imported here that takes time.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

ENERGIES, ERROR_KINDS = ("kinetic", "elastic", "gravity"), ("time", "space", "solver")  # of records


class Colour(NamedTuple):
    """A quantity at the nodes that bodies are coloured by.

    least_span: smallest span of the scale, for a scene at rest; value: (`NodalValues`, simulator) -> present values (n_nodes,);
    low: lower end of the scale; skips_zero: whether nodes without any do not count.
    """

    title: str
    unit: str = ""
    least_span: float = 1.0
    value: Callable | None = None
    low: float = 0.0
    skips_zero: bool = False


COLOURS = {
    "body": Colour("own colour"),
    "stress": Colour("von Mises stress", "Pa", 1.0, lambda values, sim: values.stress(sim)),
    "stretch": Colour("largest stretch", "", 1e-3, lambda values, sim: values.stretch(sim), low=1.0),
    "speed": Colour("speed", "m/s", 1e-3, lambda values, sim: values.speed(sim)),
    "pressure": Colour("contact pressure", "Pa", 1.0, lambda values, sim: values.touching(sim, "pressure"), skips_zero=True),
    "slip": Colour("accumulated slip", "m", 1e-12, lambda values, sim: values.touching(sim, "accumulated_slip"), skips_zero=True),
    "error": Colour("estimated error", "m", 1e-12, lambda _, sim: sim.nodal_errors()),
}


def nodal() -> tuple[str, ...]:
    """Return the names of the colours that have values at the nodes, which states can keep."""
    return tuple(name for name, colour in COLOURS.items() if colour.value is not None)


LAYERS = ("contacts", "tractions", "pressures", "connections", "fibres", "fixed_nodes", "wires")  # in this order they are drawn
IN_PICTURES = ("pressures", "connections", "fibres", "fixed_nodes")  # shown by default
IN_WINDOW = ("tractions", *IN_PICTURES)

BLUE, ORANGE, GREEN, DARK = (0.16, 0.42, 0.74), (0.87, 0.42, 0.13), (0.20, 0.56, 0.28), (0.30, 0.30, 0.36)  # sRGB
CURVE_COLOURS = (BLUE, ORANGE, GREEN, DARK)  # of a plot; by pair or body it shows as many


class Series(NamedTuple):
    """One curve of a plot. needs: "implicit" steps, "contact" forces, "error" estimates or ""; quantity: column of `History`."""

    name: str
    colour: tuple[float, float, float]
    needs: str
    quantity: str


class Plot(NamedTuple):
    """Curves that share an axis. log: whether it is logarithmic; many: whether its series stands for one of each pair or body."""

    title: str
    unit: str
    series: tuple[Series, ...]
    log: bool = False
    many: bool = False


_newton, _linear = partial(Series, "Newton", BLUE, "implicit"), partial(Series, "CG", GREEN, "implicit")
_contacts, _step = partial(Series, "contacts", ORANGE, "contact"), partial(Series, "step", BLUE, "")
_iterations = _newton("newton_iterations"), _linear("linear_iterations"), _contacts("contact_iterations")
_changes = tuple(Series(name, colour, "", name) for name, colour in zip((*ENERGIES, "total"), CURVE_COLOURS))
_errors = tuple(Series(kind, colour, "error", f"{kind}_error") for kind, colour in zip(ERROR_KINDS, CURVE_COLOURS))
PLOTS = {
    "energies": Plot("energy change", "J", _changes),
    "residuals": Plot("residuals", "", (_newton("newton_residual"), _contacts("contact_residual")), log=True),
    "iterations": Plot("iterations of a step", "", _iterations),
    "contacts": Plot("contacts", "", (_contacts("n_contacts"),)),
    "step_time": Plot("wall time of a step", "ms", (_step("step_time"),), log=True),
    "error": Plot("estimated error so far", "%", _errors, log=True),
    "forces": Plot("force by pair", "N", (_contacts("forces"),), many=True),
    "torques": Plot("torque by pair", "N m", (_contacts("torques"),), many=True),
    "kinetic": Plot("kinetic energy by body", "J", (_step("kinetic"),), many=True),
    "elastic": Plot("elastic energy by body", "J", (_step("elastic"),), many=True),
}
