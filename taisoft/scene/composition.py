"""What the tets of a body are made of: one material, or one for each region of the mesh, and numbers that replace theirs by tet.

Laws, Young's modulus, Poisson's ratio and density may differ from tet to tet. Friction, restitution and damping hold for the
whole body, so the materials of its regions must agree in them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from taisoft.errors import MeshError, SceneError, reworded, value_text
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene import checks
from taisoft.scene.fibres import directions
from taisoft.scene.law import FIBRE, HOOKE
from taisoft.scene.laws import LAWS
from taisoft.scene.material import FIBRE_NUMBERS, MODULI, Material, lame_parameters

OF_THE_BODY = ("friction", "restitution", "mass_damping", "stiffness_damping")


@dataclass(frozen=True, eq=False)
class Composition:
    """Materials and numbers of a body's tets; `compose` makes one of checked values. Arrays are read-only."""

    mesh: TetMesh
    materials: dict[int | None, Material]  # by region, ascending; under None if one holds for all tets
    by_tet: dict[str, np.ndarray]  # some of `tet_numbers`: (m,), which replace the numbers of the materials
    fibres: np.ndarray | None = None  # (m,3) unit vectors at rest, or 0 where the material has no fibres

    @property
    def has_regions(self) -> bool:
        """Whether each region has its own material."""
        return None not in self.materials

    @property
    def elastic_by_tet(self) -> bool:
        """Whether Young's modulus, Poisson's ratio, a parameter or a fibre direction of a law may differ from tet to tet."""
        return self.has_regions or bool(self.by_tet.keys() - {"density"}) or any("I4" in LAWS[one].arguments for one in self.laws)

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters of its laws; () if none has any."""
        return tuple(dict.fromkeys(name for material in self.materials.values() for name in material.parameters))

    @property
    def tet_numbers(self) -> tuple[str, ...]:
        """Names of the numbers that may differ from tet to tet."""
        laws = [LAWS[name] for name in self.laws]
        return (*dict.fromkeys(name for law in laws for name in law.numbers), "density")

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
        """Return one of `tet_numbers`, or `volume_floor`: a float if one holds for all tets by design, else (m,).

        A parameter is not a number in tets whose law does not have it.
        """
        if name in MODULI and self.parameters and self.elastic_by_tet:
            return self._moduli[MODULI.index(name)]
        if name in self.by_tet or not self.has_regions:
            return self.by_tet.get(name, getattr(self.first, name))
        values = np.array([getattr(material, name, np.nan) for material in self.materials.values()])[self._row]
        values.flags.writeable = False
        return values

    @property
    def has_volume_floor(self) -> bool:
        """Whether some tets stiffen against inversion."""
        return any(material.volume_floor > 0.0 for material in self.materials.values())

    @cached_property
    def _moduli(self) -> np.ndarray:
        """Young's modulus [Pa] and Poisson's ratio (2, m) at rest, where a law has parameters."""
        moduli = np.array([[getattr(one, name) for one in self.materials.values()] for name in MODULI])
        moduli = moduli[:, self._row] if self.has_regions else np.repeat(moduli, self.mesh.n_tets, axis=1)
        for row, name in zip(moduli, MODULI):
            row[:] = self.by_tet.get(name, row)
        for name in self.laws:
            law, tets = LAWS[name], self.tets_of_law(name)
            own = {one: np.broadcast_to(self.number(one), self.mesh.n_tets)[tets] for one in law.parameters}
            rows = np.unique(np.array(list(own.values())), axis=1, return_inverse=True) if own else None
            if rows is not None:
                moduli[:, tets] = np.array(law.moduli(dict(zip(own, rows[0]))))[:, rows[1].reshape(-1)]
        moduli.setflags(write=False)
        return moduli

    @cached_property
    def branches(self) -> np.ndarray:
        """Maxwell branches of the tets (m, n, 2): relaxation time [s] and fraction; 1 s and 0 for those that a region lacks."""
        of_material = [material.branches for material in self.materials.values()]
        table = np.tile((1.0, 0.0), (len(of_material), max(map(len, of_material)), 1))
        for row, branches in zip(table, of_material):
            row[: len(branches)] = np.reshape(branches, (-1, 2))
        return table[self._row] if self.has_regions else np.broadcast_to(table, (self.mesh.n_tets, *table.shape[1:]))

    @property
    def has_fibres(self) -> bool:
        """Whether some material has fibres."""
        return any(material.has_fibres for material in self.materials.values())

    def check_fibres(self, what: str) -> None:
        """Raise SceneError if the material of a tet has fibres, but they have no direction there. what: start of messages."""
        if self.has_fibres and self.fibres is None:
            raise SceneError(f"{what}: its material has fibres, so it needs their directions: give add_body fibres")
        if self.has_fibres:
            needs = np.any([np.broadcast_to(self.number(name), self.mesh.n_tets) for name in FIBRE_NUMBERS], axis=0)
            for law in self.laws:
                needs[self.tets_of_law(law)] |= "I4" in LAWS[law].arguments
            if (missing := needs & ~self.fibres.any(axis=1)).any():
                tet = int(np.argmax(missing))
                raise SceneError(f"{what}: fibres: the direction of tet {tet} is zero, but its material has fibres")

    @property
    def lame(self) -> tuple[float | np.ndarray, float | np.ndarray]:
        """Lamé's parameters (mu, lambda) at rest [Pa], each a float or (m,)."""
        return lame_parameters(self.number("young"), self.number("poisson"))

    @property
    def dilatation_modulus(self) -> float | np.ndarray:
        """The modulus of the volumetric part that mean dilatation averages [Pa]: lambda, or a parameter of the law."""
        if not self.parameters:
            return self.lame[1]
        modulus = np.broadcast_to(self.lame[1], self.mesh.n_tets).copy()
        for name in self.laws:
            law, tets = LAWS[name], self.tets_of_law(name)
            if law.modulus in law.parameters:
                modulus[tets] = np.broadcast_to(self.number(law.modulus), self.mesh.n_tets)[tets]
        return modulus if self.elastic_by_tet else float(modulus[0])

    @property
    def stiffnesses(self) -> dict[str, float | np.ndarray]:
        """Young's modulus, or the parameters of its laws in Pa: numbers to which stresses are proportional."""
        units = {name: one.unit for law in self.laws for name, one in LAWS[law].parameters.items()}
        return {name: self.number(name) for name in self.tet_numbers if name == "young" or units.get(name) == "Pa"}

    @property
    def has_dilatation(self) -> bool:
        """Whether the laws of all tets have a volumetric part that mean dilatation can average."""
        return all(LAWS[name].has_dilatation for name in self.laws)

    @cached_property
    def anisotropy(self) -> np.ndarray | None:
        """What the laws' second derivatives at rest (m,9,9) [Pa] have beyond Hooke's law with `lame`; None if none may have."""
        laws = [LAWS[name] for name in self.laws if not LAWS[name].is_isotropic]
        if not laws:
            return None
        found, eye = np.zeros((self.mesh.n_tets, 9, 9)), np.eye(9).reshape(3, 3, 9)
        mu, lam = (np.broadcast_to(one, self.mesh.n_tets)[:, None, None] for one in self.lame)
        symmetric = (eye + eye.swapaxes(0, 1)).reshape(9, 9)
        for law in laws:
            tets = self.tets_of_law(law.name)
            numbers = dict(zip(HOOKE, (mu[tets, 0, 0], lam[tets, 0, 0])))
            numbers |= {one: np.broadcast_to(self.number(one), self.mesh.n_tets)[tets] for one in law.parameters}
            hooke = mu[tets] * symmetric + lam[tets] * np.outer(np.eye(3), np.eye(3))
            found[tets] = law.rest_tangent(numbers, FIBRE if self.fibres is None else self.fibres[tets]) - hooke
        return found

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

        numbers: of a `Material`; `tet_numbers` may be (m,) unless a region is given. what: start of messages.
        Raises SceneError.
        """
        if region is not None:
            return self._changed_in(what, numbers, region)
        by_tet, everywhere = dict(self.by_tet), {}
        for name, value in numbers.items():
            if name in self.tet_numbers and (isinstance(value, (list, tuple)) or getattr(value, "ndim", 0)):
                by_tet[name] = self._tet_numbers(f"{what}: {name}", name, value)
            else:
                by_tet.pop(name, None)
                everywhere[name] = value
        materials = {
            key: _replaced(what, material, {n: v for n, v in everywhere.items() if not self._is_foreign(n, material)})
            for key, material in self.materials.items()
        }
        made = replace(self, materials=materials, by_tet=by_tet)
        made._check_moduli(what)
        return made

    def _is_foreign(self, name: str, material: Material) -> bool:
        """Whether a number belongs to another region's law, and not to this material's."""
        return name in self.tet_numbers and name not in (*LAWS[material.law].numbers, "density")

    def _check_moduli(self, what: str) -> None:
        """Raise SceneError if parameters by tet make a law unstable at rest."""
        if self.parameters and self.by_tet:
            with reworded(SceneError, f"{what}: "):
                _ = self._moduli

    def _tet_numbers(self, what: str, name: str, value) -> np.ndarray:
        """Return numbers (m,) of all tets, each of which a `Material` could have."""
        if self.has_regions and self.parameters and np.shape(value) == (self.mesh.n_tets,):  # it matters where a law has it
            has = np.array([not self._is_foreign(name, material) for material in self.materials.values()])[self._row]
            value = np.where(has, value, np.asarray(value)[has][0])
        array = checks.array(value, what, ((self.mesh.n_tets,),))
        if name == "poisson":
            _check_tets(what, array, ~((array > -1.0) & (array < 0.5)), "lie in the open interval (-1, 0.5)")
        elif name in ("young", "density"):
            unit = "Pa" if name == "young" else "kg/m^3"
            _check_tets(what, array, array < checks.SMALLEST, f"be greater than 0 {unit}")
        for law in (LAWS[one] for one in self.laws if name in LAWS[one].parameters):
            law.parameters[name].check_all(array, self.tets_of_law(law.name), what)
        array.setflags(write=False)
        return array

    def _changed_in(self, what: str, numbers: dict, region: int | str) -> "Composition":
        """Return a composition with other numbers in one region: of its material, or by tet where they are given so."""
        allowed = (*self.tet_numbers, "volume_floor", *FIBRE_NUMBERS) if self.has_regions else self.tet_numbers
        for name in numbers:
            if name not in allowed:
                raise SceneError(f"{what}: {name} is one number for the whole body; {', '.join(allowed)} can differ by region")
        with reworded(MeshError, f"{what}: ", raised=SceneError):
            key = self.mesh.region_id(region)
        for name in numbers:
            if self.has_regions and self._is_foreign(name, self.materials[key]):
                law = self.materials[key].law
                raise SceneError(f"{what}: law {law} of region {self.mesh.region_text(key)} has no number {name}")
        changed = _replaced(f"{what}: region {self.mesh.region_text(key)}", self.materials.get(key, self.first), numbers)
        by_tet = dict(self.by_tet)
        for name in numbers:
            if name in by_tet or not self.has_regions:
                by_tet[name] = np.where(self.mesh.regions == key, getattr(changed, name), self.number(name))
                by_tet[name].setflags(write=False)
        made = replace(self, materials=self.materials | ({key: changed} if self.has_regions else {}), by_tet=by_tet)
        made._check_moduli(what)
        return made


def compose(
    what: str, mesh: TetMesh, material: Material | Mapping, fibres=None, parameters: Mapping | None = None, **numbers
) -> Composition:
    """Return the composition of a body. what: start of messages; the others: of `Scene.add_body`. Raises SceneError."""
    if isinstance(material, Material):
        made = Composition(mesh, {None: material}, {})
    elif isinstance(material, Mapping):
        made = Composition(mesh, _by_region(what, mesh, material), {})
    else:
        kinds = "a Material, or a dict that gives each region one"
        raise SceneError(f"{what}: material must be {kinds}, not {type(material).__name__}")
    for one in made.materials.values():
        one.check_law(what)
    if not isinstance(parameters or {}, Mapping):
        raise SceneError(f"{what}: parameters must be a dict, not {value_text(parameters)}")
    for name in parameters or {}:
        checks.index(name, made.parameters, f"{what}: no parameter of its laws")
    if fibres is not None or (mesh.fibres is not None and made.has_fibres):
        if not made.has_fibres:
            raise SceneError(
                f"{what}: it has fibres, but {', '.join(FIBRE_NUMBERS)} of its material are 0, and its law has no I4"
            )
        made = replace(made, fibres=directions(what, mesh, mesh.fibres if fibres is None else fibres))
    made.check_fibres(what)
    return made.changed(what, {name: value for name, value in numbers.items() if value is not None} | dict(parameters or {}))


def _by_region(what: str, mesh: TetMesh, materials: Mapping) -> dict[int, Material]:
    """Return the material of each region by its id, ascending. materials: by name or id."""
    if mesh.regions is None:
        raise SceneError(f"{what}: materials are given by region, but its mesh has no regions")
    found: dict[int, Material] = {}
    for key, material in materials.items():
        with reworded(MeshError, f"{what}: material: ", raised=SceneError):
            region = mesh.region_id(key)
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
    with reworded(SceneError, f"{what}: ", without="material: "):  # of an argument
        return replace(material, **numbers) if numbers else material


def _check_tets(what: str, array: np.ndarray, bad: np.ndarray, rule: str) -> None:
    if bad.any():
        tet = int(np.argmax(bad))
        raise SceneError(f"{what} of tet {tet} must {rule}, not {array[tet]:g}")
