"""What the tets of a body are made of: one material, or one for each region of the mesh, and numbers that replace theirs by tet.

Laws, Young's modulus, Poisson's ratio and density may differ from tet to tet. Friction, restitution and damping hold for the
whole body, so the materials of its regions must agree in them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from taisoft.errors import MeshError, SceneError, value_text
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene import checks
from taisoft.scene.fibres import directions
from taisoft.scene.material import FIBRE_NUMBERS, LAWS, Material, lame_parameters

BY_TET = ("young", "poisson", "density")  # numbers that may differ from tet to tet
OF_THE_BODY = ("friction", "restitution", "mass_damping", "stiffness_damping")


@dataclass(frozen=True, eq=False)
class Composition:
    """Materials and numbers of a body's tets; `compose` makes one of checked values. Arrays are read-only."""

    mesh: TetMesh
    materials: dict[int | None, Material]  # by region, ascending; under None if one holds for all tets
    by_tet: dict[str, np.ndarray]  # some of BY_TET: (m,), which replace the numbers of the materials
    fibres: np.ndarray | None = None  # (m,3) unit vectors at rest, or 0 where the material has no fibres

    @property
    def has_regions(self) -> bool:
        """Whether each region has its own material."""
        return None not in self.materials

    @property
    def elastic_by_tet(self) -> bool:
        """Whether Young's modulus or Poisson's ratio may differ from tet to tet."""
        return self.has_regions or "young" in self.by_tet or "poisson" in self.by_tet

    @property
    def first(self) -> Material:
        """The material of the first region, or of the whole body, whose OF_THE_BODY hold for all tets."""
        return next(iter(self.materials.values()))

    @property
    def laws(self) -> tuple[str, ...]:
        """The laws of the body, in the order of LAWS."""
        used = {material.law for material in self.materials.values()}
        return tuple(law for law in LAWS if law in used)

    @cached_property
    def _row(self) -> np.ndarray:
        """Row (m,) among the materials of each tet of a body with regions."""
        return np.searchsorted(list(self.materials), self.mesh.regions)

    def number(self, name: str) -> float | np.ndarray:
        """Return one of BY_TET, or `volume_floor`: a float if one holds for all tets by design, else (m,)."""
        if name in self.by_tet or not self.has_regions:
            return self.by_tet.get(name, getattr(self.first, name))
        values = np.array([getattr(material, name) for material in self.materials.values()])[self._row]
        values.flags.writeable = False
        return values

    @property
    def has_volume_floor(self) -> bool:
        """Whether some tets stiffen against inversion."""
        return any(material.volume_floor > 0.0 for material in self.materials.values())

    @property
    def has_fibres(self) -> bool:
        """Whether some material has fibres."""
        return any(material.has_fibres for material in self.materials.values())

    def check_fibres(self, what: str) -> None:
        """Raise SceneError if the material of a tet has fibres, but they have no direction there. what: start of messages."""
        if self.has_fibres and self.fibres is None:
            raise SceneError(f"{what}: its material has fibres, so it needs their directions: give add_body fibres")
        if self.has_fibres:
            numbers = [np.broadcast_to(self.number(name), self.mesh.n_tets) for name in FIBRE_NUMBERS]
            if (missing := np.any(numbers, axis=0) & ~self.fibres.any(axis=1)).any():
                tet = int(np.argmax(missing))
                raise SceneError(f"{what}: fibres: the direction of tet {tet} is zero, but its material has fibres")

    @property
    def lame(self) -> tuple[float | np.ndarray, float | np.ndarray]:
        """Lamé's parameters (mu, lambda) [Pa], each a float or (m,)."""
        return lame_parameters(self.number("young"), self.number("poisson"))

    @cached_property
    def lowest_wave_speed(self) -> float:
        """The smallest sqrt(young / density) of a tet [m/s]."""
        return float(np.sqrt(np.min(self.number("young") / self.number("density"))))

    def tets_of_law(self, law: str) -> np.ndarray:
        """Return the tets (k,) that follow a law, ascending."""
        if not self.has_regions:
            return np.arange(self.mesh.n_tets if law == self.first.law else 0)
        return np.flatnonzero(np.array([material.law == law for material in self.materials.values()])[self._row])

    def law_of_tet(self, tet: int) -> str:
        """Return the law that a tet follows."""
        return (self.materials[int(self.mesh.regions[tet])] if self.has_regions else self.first).law

    def changed(self, what: str, numbers: dict, region: int | str | None = None) -> "Composition":
        """Return a composition with other numbers of all tets, or of one region's.

        numbers: of a `Material`; those of BY_TET may be (m,) unless a region is given. what: start of messages.
        Raises SceneError.
        """
        if region is not None:
            return self._changed_in(what, numbers, region)
        by_tet, everywhere = dict(self.by_tet), {}
        for name, value in numbers.items():
            if name in BY_TET and (isinstance(value, (list, tuple)) or getattr(value, "ndim", 0)):
                by_tet[name] = _tet_numbers(f"{what}: {name}", name, value, self.mesh.n_tets)
            else:
                by_tet.pop(name, None)
                everywhere[name] = value
        materials = {key: _replaced(what, material, everywhere) for key, material in self.materials.items()}
        return replace(self, materials=materials, by_tet=by_tet)

    def _changed_in(self, what: str, numbers: dict, region: int | str) -> "Composition":
        """Return a composition with other numbers in one region: of its material, or by tet where they are given so."""
        allowed = (*BY_TET, "volume_floor", *FIBRE_NUMBERS) if self.has_regions else BY_TET
        for name in numbers:
            if name not in allowed:
                raise SceneError(f"{what}: {name} is one number for the whole body; {', '.join(allowed)} can differ by region")
        try:
            key = self.mesh.region_id(region)
        except MeshError as error:
            raise SceneError(f"{what}: {error}") from None
        changed = _replaced(f"{what}: region {self.mesh.region_text(key)}", self.materials.get(key, self.first), numbers)
        by_tet = dict(self.by_tet)
        for name in numbers:
            if name in by_tet or not self.has_regions:
                by_tet[name] = np.where(self.mesh.regions == key, getattr(changed, name), self.number(name))
                by_tet[name].setflags(write=False)
        return replace(self, materials=self.materials | ({key: changed} if self.has_regions else {}), by_tet=by_tet)


def compose(what: str, mesh: TetMesh, material: Material | Mapping, fibres=None, **numbers) -> Composition:
    """Return the composition of a body. what: start of messages; the others: of `Scene.add_body`. Raises SceneError."""
    if isinstance(material, Material):
        made = Composition(mesh, {None: material}, {})
    elif isinstance(material, Mapping):
        made = Composition(mesh, _by_region(what, mesh, material), {})
    else:
        kinds = "a Material, or a dict that gives each region one"
        raise SceneError(f"{what}: material must be {kinds}, not {type(material).__name__}")
    if fibres is not None or (mesh.fibres is not None and made.has_fibres):
        if not made.has_fibres:
            raise SceneError(f"{what}: it has fibres, but {', '.join(FIBRE_NUMBERS)} of its material are 0")
        made = replace(made, fibres=directions(what, mesh, mesh.fibres if fibres is None else fibres))
    made.check_fibres(what)
    return made.changed(what, {name: value for name, value in numbers.items() if value is not None})


def _by_region(what: str, mesh: TetMesh, materials: Mapping) -> dict[int, Material]:
    """Return the material of each region by its id, ascending. materials: by name or id."""
    if mesh.regions is None:
        raise SceneError(f"{what}: materials are given by region, but its mesh has no regions")
    found: dict[int, Material] = {}
    for key, material in materials.items():
        try:
            region = mesh.region_id(key)
        except MeshError as error:
            raise SceneError(f"{what}: material: {error}") from None
        if not isinstance(material, Material):
            raise SceneError(
                f"{what}: the material of region {value_text(key)} must be a Material, not {type(material).__name__}"
            )
        if region in found:
            raise SceneError(f"{what}: region {mesh.region_text(region)} is given two materials, by its name and by its id")
        found[region] = material
    for region in mesh.region_ids:
        if region not in found:
            raise SceneError(f"{what}: region {mesh.region_text(region)} has no material; every region needs one")
    found = dict(sorted(found.items()))
    first, *others = found
    for name in OF_THE_BODY:
        for region in others:
            a, b = getattr(found[first], name), getattr(found[region], name)
            if a != b:
                one, other = mesh.region_text(first), mesh.region_text(region)
                rule = "but it is one number for the whole body"
                raise SceneError(f"{what}: {name} is {a:g} in region {one} and {b:g} in region {other}, {rule}")
    return found


def _replaced(what: str, material: Material, numbers: dict) -> Material:
    try:
        return replace(material, **numbers) if numbers else material
    except SceneError as error:  # of an argument
        raise SceneError(f"{what}: {str(error).removeprefix('material: ')}") from None


def _tet_numbers(what: str, name: str, value, n_tets: int) -> np.ndarray:
    """Return numbers (m,) of all tets, each of which a `Material` could have."""
    array = checks.array(value, what, ((n_tets,),))
    if name == "poisson":
        bad, rule = ~((array > -1.0) & (array < 0.5)), "lie in the open interval (-1, 0.5)"
    else:
        bad, rule = array < checks.SMALLEST, f"be greater than 0 {'Pa' if name == 'young' else 'kg/m^3'}"
    if bad.any():
        tet = int(np.argmax(bad))
        raise SceneError(f"{what} of tet {tet} must {rule}, not {array[tet]:g}")
    array.setflags(write=False)
    return array
