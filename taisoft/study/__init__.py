"""Studies: one scene over a grid of settings, each run in its own process; speed against error.

This file holds what is requested: the axes of the grid and the request. It imports nothing heavy, because the command line
reads its options from here.
"""

from dataclasses import dataclass, field, fields


def _axis(meaning: str, **default):
    return field(metadata={"meaning": meaning}, **default)


@dataclass(frozen=True)
class Setting:
    """One combination; its fields are the axes of the grid, with their meaning on the command line.

    order: None for the scene's; refine: number of mesh refinements; the rest: arguments of Simulator.
    """

    dt: float = _axis("steps [s]")
    integrator: str = _axis("names, such as bdf2")
    order: int | None = _axis("of the elements of all bodies, 1 or 2", default=None)
    refine: int = _axis("how many times every tet is divided into eight", default=0)
    precision: str = _axis("f32, f64", default="f32")
    newton_tolerance: float | None = _axis("relative, or none: adaptive", default=None)
    linear_tolerance: float | None = _axis("of conjugate gradients, relative, or none", default=None)
    contact_solver: str = _axis("auto or a solver", default="auto")
    contact_tolerance: float | None = _axis("relative, or none", default=None)
    arch: str = _axis("cpu, cuda", default="cpu")

    @property
    def mesh(self) -> tuple[int, int | None]:
        """(refine, order)."""
        return self.refine, self.order


DEFAULTS = {axis.name: axis.default for axis in fields(Setting)}  # MISSING for dt and integrator
AXES = tuple(DEFAULTS)


def simulator_arguments(setting: dict) -> dict:
    """Return a setting without its mesh."""
    return {key: value for key, value in setting.items() if key not in ("refine", "order")}


def mesh_name(setting: dict) -> str:
    """Return a short name of a setting's mesh."""
    return f"refine {setting['refine']}" + ("" if setting["order"] is None else f", order {setting['order']}")


def describe(setting: dict) -> str:
    """Return a short description of a setting: integrator, dt, precision, and the rest if not default."""
    words = [setting["integrator"], f"dt = {setting['dt']:.4g} s", setting["precision"]]
    rest = [key for key in AXES if key not in ("dt", "integrator", "precision")]
    words += [f"{key} {setting[key]}" for key in rest if setting[key] != DEFAULTS[key]]
    return ", ".join(words)


@dataclass
class Request:
    """Request for a study. axes: name -> values, only the axes given; by: the error used, "max" or "rms"."""

    scene: str
    axes: dict[str, list] = field(default_factory=dict)
    allow_outside: bool = False
    seconds: float | None = None
    reference_dt: float | None = None
    reference_integrator: str | None = None
    reference_refine: int = 0
    repeats: int = 3
    tolerance: float = 0.01
    by: str = "max"
