"""An elastic material: a law with its numbers, density, damping and surface parameters."""

import dataclasses
import functools
from collections.abc import Mapping

import numpy as np

from taisoft.attributes import FrozenDict, checked, guarded_record
from taisoft.errors import SceneError, value_text
from taisoft.scene import checks
from taisoft.scene.checks import number
from taisoft.scene.law import Law
from taisoft.scene.laws import LAWS, registered

FIBRE_NUMBERS = ("fibre_stiffness", "fibre_exponent", "active_stress", "active_strain")  # see `fem.laws.fibres`
MAX_BRANCHES = 8
MIN_VOLUME_FLOOR = 1e-3  # smaller ones are the rounding of J = det F in f32
MODULI = ("young", "poisson")


def _takes_parameters(cls: type) -> type:
    """Let a material's law have numbers of its own, given by name or in a dict; young and poisson follow from them."""
    init, fields = cls.__init__, [one.name for one in dataclasses.fields(cls)]

    @functools.wraps(init)
    def __init__(self, *values, **given):
        named = dict(zip(fields, values)) | given
        law = LAWS.get(checks.choice(named.get("law", cls.law), "material: law", tuple(LAWS)))
        if len(values) <= len(fields) and law.parameters:
            own = {name: named.pop(name) for name in list(named) if name not in fields}
            values, given = (), _with_moduli(law, named, own)
        elif given.get("parameters"):
            raise SceneError(f"material: law {law.name} has no parameters: it takes young and poisson")
        init(self, *values, **given)

    cls.__init__ = __init__
    return cls


def _with_moduli(law: Law, named: dict, own: dict) -> dict:
    """Return the fields of a material whose law has parameters. named: fields given; own: parameters given by their names."""
    before = named.pop("parameters", None) or {}
    if not isinstance(before, Mapping):
        raise SceneError(f"material: parameters must be a dict, not {value_text(before)}")
    # `dataclasses.replace` gives all parameters, and the moduli that followed from them
    old = dict(zip(MODULI, law.moduli(before))) if before.keys() == law.parameters.keys() else {}
    for name in MODULI:
        if name in named and (name not in old or np.ndim(named[name]) or named[name] != old[name]):
            raise SceneError(f"material: {name} follows from the numbers of law {law.name}: {', '.join(law.parameters)}")
    parameters = FrozenDict(law.checked({**before, **own}, "material: "))
    parameters._refusal = SceneError("material: parameters cannot change: make another one by dataclasses.replace")
    return {**named, "parameters": parameters, **dict(zip(MODULI, law.moduli(parameters)))}


@_takes_parameters
@guarded_record(
    "material", "make another one by dataclasses.replace, or call sim.set_material(body, {name}=...) in a simulation", eq=True
)
class Material:
    """An elastic material with damping and surface parameters. Raises SceneError for values outside the rules below."""

    law: str = "stable_neo_hookean"  #: name of a law, such as "st_venant_kirchhoff", "corotational", "mooney_rivlin"
    young: float = checked(number, 1e6, above=0.0, unit="Pa")  #: Young's modulus [Pa], > 0
    poisson: float = checked(number, 0.3)  #: Poisson's ratio, in the open interval (-1, 0.5)
    density: float = checked(number, 1000.0, above=0.0, unit="kg/m^3")  #: [kg/m^3], > 0
    friction: float = checked(number, 0.5, minimum=0.0)  #: Coulomb's coefficient, >= 0
    restitution: float = checked(number, 0.0, minimum=0.0, maximum=1.0)  #: ratio of normal speeds after and before an impact
    mass_damping: float = checked(number, 0.0, minimum=0.0, unit="1/s")  #: [1/s], >= 0
    stiffness_damping: float = checked(number, 0.0, minimum=0.0, unit="s")  #: [s], >= 0
    volume_floor: float = checked(
        number, 0.0
    )  #: J = det F below which the law stiffens against inversion, 0.001 to 1; 0 for none
    branches: tuple[tuple[float, float], ...] = ()  #: Maxwell branches, at most 8: relaxation time [s], stiffness over mu
    fibre_stiffness: float = checked(
        number, 0.0, minimum=0.0
    )  #: k1 [Pa] of fibres, >= 0; at small strains they add 4 k1 to the stiffness along them
    fibre_exponent: float = checked(
        number, 0.0, minimum=0.0
    )  #: k2 of their exponential stiffening, >= 0; 0: stress linear in Green's strain
    active_stress: float = checked(number, 0.0, minimum=0.0)  #: nominal tension [Pa] of fully activated fibres, >= 0
    active_strain: float = checked(number, 0.0, minimum=0.0)  #: shortening of fully activated fibres, 0 to below 1
    parameters: Mapping[str, float] = dataclasses.field(default_factory=dict, hash=False)  #: numbers of a law that has its own

    def __post_init__(self):
        checks.store(self, branches=_branches(self.branches))
        if not -1.0 < self.poisson < 0.5:
            raise SceneError(f"material: poisson must lie in the open interval (-1, 0.5), not {self.poisson:g}")
        if self.active_strain >= 1.0:
            raise SceneError(f"material: active_strain must be below 1, not {self.active_strain:g}")
        if self.volume_floor != 0.0 and not MIN_VOLUME_FLOOR <= self.volume_floor < 1.0:
            rule = f"must be 0, for none, or at least {MIN_VOLUME_FLOOR:g} and below 1"
            raise SceneError(f"material: volume_floor {rule}, not {self.volume_floor:g}")

    def __getattr__(self, name: str) -> float:
        """Parameters of the law are attributes, too."""
        try:
            return self.__dict__["parameters"][name]
        except KeyError:
            raise AttributeError(f"material has no attribute {name!r}") from None

    def check_law(self, what: str) -> None:
        """Raise SceneError if the law is not registered, or has been anew since. what: start of messages."""
        law = registered(self.law, f"{what}: ")
        is_known = law.parameters.keys() == self.parameters.keys()
        if not is_known or (law.parameters and law.moduli(self.parameters) != (self.young, self.poisson)):
            raise SceneError(f"{what}: law {self.law!r} has been registered anew since its material was made: make that anew")

    @property
    def mu(self) -> float:
        """Lamé's second parameter, the shear modulus [Pa]; at rest, if the law has parameters."""
        return lame_parameters(self.young, self.poisson)[0]

    @property
    def lam(self) -> float:
        """Lamé's first parameter [Pa]."""
        return lame_parameters(self.young, self.poisson)[1]

    @property
    def has_fibres(self) -> bool:
        """Whether any number of its fibres is above 0, or its law depends on their stretch."""
        return "I4" in LAWS[self.law].arguments or any(getattr(self, name) > 0.0 for name in FIBRE_NUMBERS)


def _branches(given) -> tuple[tuple[float, float], ...]:
    rule = f"must be at most {MAX_BRANCHES} pairs (relaxation time, fraction)"
    if not isinstance(given, (list, tuple)) or len(given) > MAX_BRANCHES:
        raise SceneError(f"material: branches {rule}, not {value_text(given)}")
    for k, pair in enumerate(given):
        if not isinstance(pair, (list, tuple)) or len(pair) != 2:
            raise SceneError(f"material: branches {rule}, not {value_text(pair)} in branch {k}")

    def positive(value, name: str, branch: int, unit: str = "") -> float:
        return checks.number(value, f"material: {name} of branch {branch}", above=0.0, unit=unit)

    return tuple((positive(tau, "relaxation time", k, "s"), positive(g, "fraction", k)) for k, (tau, g) in enumerate(given))


def lame_parameters(young: float | np.ndarray, poisson: float | np.ndarray) -> tuple[float | np.ndarray, float | np.ndarray]:
    """Return Lamé's parameters (mu, lambda) [Pa], entry by entry."""
    mu = young / (2.0 * (1.0 + poisson))
    lam = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    return mu, lam
