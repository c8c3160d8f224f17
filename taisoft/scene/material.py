"""An elastic material: a law with its numbers, density, damping and surface parameters."""

from dataclasses import dataclass

import numpy as np

from taisoft.attributes import guarded_record
from taisoft.errors import SceneError
from taisoft.scene import checks

FIBRE_NUMBERS = ("fibre_stiffness", "fibre_exponent", "active_stress", "active_strain")  # see `fem.laws.fibres`
MIN_VOLUME_FLOOR = 1e-3  # smaller ones are the rounding of J = det F in f32
LAWS = ("st_venant_kirchhoff", "corotational", "stable_neo_hookean")


@guarded_record("material", "make another one by dataclasses.replace, or call sim.set_material(body, {name}=...) in a simulation")
@dataclass(frozen=True)
class Material:
    """An elastic material with damping and surface parameters. Raises SceneError for values outside the rules below."""

    law: str = "stable_neo_hookean"  #: "st_venant_kirchhoff", "corotational" or "stable_neo_hookean"
    young: float = 1e6  #: Young's modulus [Pa], > 0
    poisson: float = 0.3  #: Poisson's ratio, in the open interval (-1, 0.5)
    density: float = 1000.0  #: [kg/m^3], > 0
    friction: float = 0.5  #: Coulomb's coefficient, >= 0
    restitution: float = 0.0  #: ratio of the normal speeds after and before an impact, 0 to 1
    mass_damping: float = 0.0  #: [1/s], >= 0
    stiffness_damping: float = 0.0  #: [s], >= 0
    volume_floor: float = 0.0  #: J = det F below which the law stiffens against inversion, 0.001 to 1; 0 for none
    fibre_stiffness: float = 0.0  #: k1 [Pa] of fibres, >= 0; at small strains they add 4 k1 to the stiffness along them
    fibre_exponent: float = 0.0  #: k2 of their exponential stiffening, >= 0; 0: stress linear in Green's strain
    active_stress: float = 0.0  #: nominal tension [Pa] of fully activated fibres, >= 0
    active_strain: float = 0.0  #: shortening of fully activated fibres, 0 to below 1

    def __post_init__(self):
        checks.choice(self.law, "material: law", LAWS)
        limits = {
            "young": {"above": 0.0, "unit": "Pa"},
            "poisson": {},
            "density": {"above": 0.0, "unit": "kg/m^3"},
            "friction": {"minimum": 0.0},
            "restitution": {"minimum": 0.0, "maximum": 1.0},
            "mass_damping": {"minimum": 0.0, "unit": "1/s"},
            "stiffness_damping": {"minimum": 0.0, "unit": "s"},
            "volume_floor": {},
            **dict.fromkeys(FIBRE_NUMBERS, {"minimum": 0.0}),
        }
        numbers = {k: checks.number(getattr(self, k), f"material: {k}", **limit) for k, limit in limits.items()}
        checks.store(self, **numbers)
        if not -1.0 < self.poisson < 0.5:
            raise SceneError(f"material: poisson must lie in the open interval (-1, 0.5), not {self.poisson:g}")
        if self.active_strain >= 1.0:
            raise SceneError(f"material: active_strain must be below 1, not {self.active_strain:g}")
        if self.volume_floor != 0.0 and not MIN_VOLUME_FLOOR <= self.volume_floor < 1.0:
            rule = f"must be 0, for none, or at least {MIN_VOLUME_FLOOR:g} and below 1"
            raise SceneError(f"material: volume_floor {rule}, not {self.volume_floor:g}")

    @property
    def mu(self) -> float:
        """Lamé's second parameter, the shear modulus [Pa]."""
        return lame_parameters(self.young, self.poisson)[0]

    @property
    def lam(self) -> float:
        """Lamé's first parameter [Pa]."""
        return lame_parameters(self.young, self.poisson)[1]

    @property
    def has_fibres(self) -> bool:
        """Whether any number of its fibres is above 0."""
        return any(getattr(self, name) > 0.0 for name in FIBRE_NUMBERS)


def lame_parameters(young: float | np.ndarray, poisson: float | np.ndarray) -> tuple[float | np.ndarray, float | np.ndarray]:
    """Return Lamé's parameters (mu, lambda) [Pa], entry by entry."""
    mu = young / (2.0 * (1.0 + poisson))
    lam = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    return mu, lam
