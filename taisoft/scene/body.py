"""Describe an elastic body as plain data: mesh, materials, constraints, loads and contact geometry."""

import warnings
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from taisoft.attributes import Guarded, guarded_record, thawed
from taisoft.errors import SceneError, value_text
from taisoft.mesh import quadratic
from taisoft.mesh.nodes import Nodes, make_nodes
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.mesh.thickness import coarse_bending
from taisoft.scene import checks
from taisoft.scene.body_loads import activate, add_cavity, add_force, add_load, add_pressure, add_traction, enclosed_volume
from taisoft.scene.collision import CONTACT_MODES
from taisoft.scene.composition import Composition, compose
from taisoft.scene.curves import Curve, check_shape, middle_nodes
from taisoft.scene.key_frames import AT_REST, KeyFrames, NodePath
from taisoft.scene.loads import LOAD_KINDS, Activation, BodyLoad
from taisoft.scene.look import colour_or_none, opacity_of
from taisoft.scene.material import Material
from taisoft.scene.skins import Skin, embed

# Poisson's ratio from which linear tets lock: four cells high, a beam's sag is 8 % too small instead of 5 %, at 0.499 16 %
NEARLY_INCOMPRESSIBLE = 0.45
# of each tet's quadrature points, or averaged over patches of tets, or a quadratic tet; "auto": decided from order and numbers
DILATATIONS = ("auto", "local", "mean")
QUADRATURE_DEGREES = {1: (1,), 2: (2, 4)}  # by element order: degrees of polynomials integrated exactly, the default first
# other data depend on these
_SHAPE = ("name", "mesh", "order", "curve", "quadrature_degree", "dilatation", "given_dilatation", "nodes")
_DERIVED = ("rest_positions", "n_nodes", "is_curved", "volumes", "areas", "composition", "mass", "skin", "fibres")
_READ_ONLY = (*_SHAPE, *_DERIVED, "activations")
USE_A_COPY = "change a copy made by scene.snapshot() and make a new Simulator of it"
# attribute of a body -> kind of the loads that it lists
KIND_OF = {"tractions": "traction", "forces": "force", "pressures": "pressure", "cavities": "cavity"}
_SET = {kind: f"{load.set_by} for an existing one; otherwise {USE_A_COPY}" for kind, load in LOAD_KINDS.items()}


@guarded_record("constraint", "add another one by body.fix or body.move")
class Constraint:
    """Nodes prescribed along some axes: at their start position, or at that plus a time-dependent displacement."""

    nodes: np.ndarray  #: (k,) int64 node ids
    axes: np.ndarray  #: (3,) bool
    path: Callable | None = None  #: t [s] -> displacement (3,) or (k,3) [m], None once released; no path: the nodes stay
    where: Callable | None = None  #: the function that selected the nodes, if any: it can select again on another mesh


def tet_number(name: str, doc: str) -> property:
    """Return a property of a body for a number that may differ from tet to tet."""

    def assign(body: "Body", value) -> None:
        body._compose(body.composition.changed(body._label(), {name: value}))

    return property(lambda body: body.composition.number(name), assign, doc=doc)


def loads_of(name: str) -> property:
    """Return a property of a body for its loads of a kind. name: in KIND_OF."""
    doc = f"Its loads of kind {KIND_OF[name]!r}, in the order added."
    return property(lambda body: body._held(name, [one for one in body.loads if one.kind == KIND_OF[name]]), doc=doc)


class Body(Guarded):
    """One elastic body of a scene; made by `Scene.add_body`.

    name, mesh. material: a `Material`, or a read-only dict of one for each region, by its id. young, poisson, density: what
    the tets have, a float, or (m,) where it may differ from tet to tet; setting one replaces the material's. position: (3,)
    [m]; nodes start at rest_positions + position. velocity: (3,) or (n,3) [m/s], initial. order: 1 or 2, of the elements'
    shape functions; quadrature_degree: degree of polynomials integrated exactly. curve: what the edges of its surface follow at
    rest, see `Scene.add_body`; is_curved: whether some edge is curved. volumes: (m,) [m^3], areas: (t,) [m^2] of mesh.surface,
    both at rest with the curvature of the edges. dilatation: "local" or "mean", decided by `decided_dilatation` when the body is
    made and when its material or a number of it is set, but not during a run; given_dilatation: one of DILATATIONS. nodes:
    `Nodes`, the mesh's vertices, for order 2 its mid-edge nodes, and the vertices of a skin that is touched; methods choose among
    those of tets only. skin: `Skin` or None, see `embed`. fibres: (m,3) unit vectors at rest, read-only, or None; activations:
    of the fibres, an `Activation` for each region of the mesh, or one.
    colour: sRGB (3,) of its surface or skin in pictures, None for one of the palette; opacity: 1 hides what is behind.
    constraints: of `Constraint`; loads: of `BodyLoad`, by kind: tractions, forces, pressures, cavities, which are attributes of
    their own, too. These are tuples: methods add to them, and `remove` removes.
    collision: one of CONTACT_MODES. Only material, its numbers, position, velocity, collision, colour and opacity can be
    assigned; each is validated. `warn_locking` and `warn_bending` warn if tets of order 1 are far too stiff; `Scene.add_body`
    calls both.
    """

    _read_only = frozenset(_READ_ONLY)
    _instead = dict.fromkeys(_READ_ONLY, "add another body by scene.add_body") | {
        "contact_mode": "set body.collision",
        "composition": "set body.material",
        "mass": "set body.density",
        "skin": "call body.embed",
        "activations": "call body.activate",
        **{loads: f"call body.add_{kind} or body.remove" for loads, kind in KIND_OF.items()},
    }
    _contents = {
        "constraints": "call body.fix, body.move or body.remove",
        "loads": "call body.add_force, add_traction, add_pressure, add_cavity, add_load or remove",
    }
    _takes: ClassVar = LOAD_KINDS  # kinds of loads that may act on it
    _takes_rule: ClassVar[str] = ""  # of others
    extent: ClassVar[str] = "the height of the nearest tet"  # the unit of `distance_outside`
    _default_frozen = USE_A_COPY
    _instead_frozen = {
        "material": "call sim.set_material(body, young=...)",
        **{name: f"call sim.set_material(body, {name}=...)" for name in ("young", "poisson", "density")},
        **dict.fromkeys(("activate", "activations"), "call sim.set_activation(body, value)"),
        "position": "call sim.set_state(positions=..., body=...)",
        "velocity": "call sim.set_state(velocities=..., body=...)",
        **dict.fromkeys(("add_load", "loads"), f"call sim.set_load(body, kind, index, value), or {USE_A_COPY}"),
        **{f"add_{kind}": rule for kind, rule in _SET.items()},
        **{loads: _SET[kind] for loads, kind in KIND_OF.items()},
    }

    def __init__(
        self,
        name: str,
        mesh: TetMesh,
        material: Material | Mapping,
        position,
        velocity,
        order: int,
        quadrature_degree: int | None,
        collision: str,
        dilatation: str = "auto",
        fibres=None,
        curve: Curve | None = None,
        **numbers,
    ):
        """The arguments of `Scene.add_body`; numbers: young, poisson and density, if they replace the material's."""
        what = f"body {name!r}"
        self.name, self.mesh = name, checks.instance(mesh, f"{what}: mesh", TetMesh)
        self.composition = compose(what, mesh, material, fibres, **numbers)
        self.order = checks.whole(order, f"{what}: order", tuple(QUADRATURE_DEGREES))
        degrees = QUADRATURE_DEGREES[self.order]
        degree = degrees[0] if quadrature_degree is None else quadrature_degree
        self.quadrature_degree = checks.whole(degree, f"{what}: quadrature_degree of order {self.order}", degrees)
        self.given_dilatation = checks.choice(dilatation, f"{what}: dilatation", DILATATIONS)
        self.dilatation = self.decided_dilatation
        self.curve = curve
        self.nodes: Nodes = make_nodes(mesh, self.order, middle_nodes(what, mesh, self.order, curve))
        check_shape(what, self.nodes)
        self.position, self.velocity, self.collision = position, velocity, collision
        self.colour, self.opacity = None, 1.0
        self.constraints: tuple[Constraint, ...] = ()
        self.loads: tuple[BodyLoad, ...] = ()
        self.skin: Skin | None = None
        self.activations = self._inactive()
        self._seal(Body.__init__)

    def _label(self) -> str:
        return f"body {self.name!r}"

    def _check_velocity(self, value) -> np.ndarray:
        return checks.array(value, f"{self._label()}: velocity", ((3,), (self.n_nodes, 3)))

    def _check_collision(self, value) -> str:
        if value == "distance_field" and self.__dict__.get("nodes") is not None and self.nodes.embedded is not None:
            raise SceneError(f"{self._label()}: collision: an embedded surface has no distance field")
        return checks.choice(value, f"{self._label()}: collision", CONTACT_MODES)

    position = checks.attribute("position", checks.vector, "Initial translation (3,) [m].")
    velocity = checks.attribute("velocity", None, "Initial velocity (3,) or (n,3) [m/s].")
    collision = checks.attribute("collision", None, "Contact geometry, one of CONTACT_MODES.")
    colour = checks.attribute("colour", colour_or_none, 'sRGB (3,) in [0, 1], also set as "#rrggbb"; None: one of the palette.')
    opacity = checks.attribute("opacity", opacity_of, "Of its surface: 1 hides what is behind.")

    @property
    def rest_positions(self) -> np.ndarray:
        """Stress-free node positions (n,3) [m], read-only; the mesh's vertices come first."""
        return self.nodes.positions

    tractions, forces, pressures, cavities = map(loads_of, KIND_OF)

    @property
    def numbered_loads(self) -> list[tuple[str, int, BodyLoad]]:
        """Its loads, each with its kind and its number in that kind, as `Simulator.set_load` counts."""
        found, counts = [], dict.fromkeys(LOAD_KINDS, 0)
        for one in self.loads:
            found.append((one.kind, counts[one.kind], one))
            counts[one.kind] += 1
        return found

    @property
    def fibres(self) -> np.ndarray | None:
        """Unit vectors (m,3) of the fibres at rest, read-only, 0 in tets without; None if the body has none."""
        return self.composition.fibres

    @property
    def n_nodes(self) -> int:
        """Number of nodes."""
        return len(self.nodes.positions)

    @property
    def material(self) -> Material | Mapping[int, Material]:
        """Material, or {id of region: Material}, which is read-only.

        Setting it replaces all numbers; raises SceneError and warns if linear tets lock.
        """
        return MappingProxyType(self.composition.materials) if self.composition.has_regions else self.composition.first

    @material.setter
    def material(self, value: Material | Mapping) -> None:
        self._compose(compose(self._label(), self.mesh, value, self.fibres))

    def _compose(self, composition: Composition) -> None:
        composition.check_fibres(self._label())
        warns = self._sealed  # add_body and the simulator issue their own warnings
        with thawed(self):
            self.composition = composition
            self.dilatation = self.decided_dilatation
            self.activations = self.activations or self._inactive()
        if warns:
            self.warn_locking(stacklevel=4)

    def _inactive(self) -> tuple[Activation, ...]:
        regions = () if self.fibres is None else self.mesh.region_ids or (None,)
        return tuple(Activation(value=np.zeros(()), region=region) for region in regions)

    young = tet_number("young", "Young's modulus [Pa], a float or (m,).")
    poisson = tet_number("poisson", "Poisson's ratio, a float or (m,).")
    density = tet_number("density", "Density [kg/m^3], a float or (m,).")

    @property
    def decided_dilatation(self) -> str:
        """What is given; if that is "auto", "mean" for linear tets some of which have a Poisson's ratio of at least 0.45."""
        if self.given_dilatation != "auto":
            return self.given_dilatation
        locks = self.order == 1 and np.max(self.poisson) >= NEARLY_INCOMPRESSIBLE
        return "mean" if locks and self.composition.has_dilatation else "local"

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(np.sum(self.composition.number("density") * self.volumes))

    @property
    def is_curved(self) -> bool:
        """Whether some edge is curved at rest."""
        return self.nodes.curved is not None

    @property
    def volumes(self) -> np.ndarray:
        """Volumes (m,) [m^3] of the tets at rest, with the curvature of their edges."""
        if not self.is_curved:
            return self.mesh.volumes
        return quadratic.point_volumes(self.rest_positions[self.nodes.elements], quadratic.quadrature(4)).sum(axis=1)

    @property
    def areas(self) -> np.ndarray:
        """Areas (t,) [m^2] of the rows of mesh.surface at rest, with the curvature of their edges."""
        nodes = self.face_nodes(np.arange(len(self.mesh.surface)))
        return np.linalg.norm(quadratic.area_vectors(self.rest_positions[nodes]), axis=2).sum(axis=1)

    def face_nodes(self, triangles: np.ndarray) -> np.ndarray:
        """Return the nodes (k, 3 or 6) of rows (k,) of mesh.surface: corners, then the middles of their edges."""
        if self.order == 1:
            return self.mesh.surface[triangles]
        split = self.nodes.boundary.reshape(-1, 4, 3)[triangles]  # (a, ab, ca), (ab, b, bc), (ca, bc, c), ...
        return np.stack([split[:, 0, 0], split[:, 1, 1], split[:, 2, 2], split[:, 0, 1], split[:, 1, 2], split[:, 0, 2]], axis=1)

    def check(self) -> None:
        """Raise SceneError if in-place changes made the arrays of position or velocity invalid, or its law is another one now."""
        checks.vector(self.position, f"{self._label()}: position")
        self._check_velocity(self.velocity)
        for material in self.composition.materials.values():
            material.check_law(self._label())

    @property
    def contact_mode(self) -> str:
        """Resolved contact geometry: "proximity", also for "auto", or "distance_field"."""
        return "proximity" if self.collision == "auto" else self.collision

    def __repr__(self) -> str:
        kind = f"{self.mesh.n_tets} tets of order {self.order}"
        return f"Body({self.name!r}, {self.n_nodes} nodes, {kind}, {' and '.join(self.composition.laws)})"

    def warn_locking(self, stacklevel: int) -> None:
        """Warn if linear tets lock, or if changed numbers ask for another dilatation. stacklevel: 1 is the caller's line."""
        poisson, kept = float(np.max(self.poisson)), self.dilatation != self.decided_dilatation
        if self.order == 1 and self.dilatation == "local" and poisson >= NEARLY_INCOMPRESSIBLE:
            rule = f"is at least {NEARLY_INCOMPRESSIBLE}, where linear tets lock and bend too little"
            cure = "the default of a body that starts so" if kept else "the default"
            mean = f'dilatation="mean", {cure}, does not lock, and ' if self.composition.has_dilatation else ""
            rule += f": {mean}order=2 locks less"
        elif kept:
            rule = f"is below {NEARLY_INCOMPRESSIBLE}, and its dilatation stays the mean that a larger one at the start asked for"
        else:
            return
        warnings.warn(f"{self._label()}: poisson = {poisson:g} {rule}", UserWarning, stacklevel=stacklevel + 1)

    def warn_bending(self, stacklevel: int) -> None:
        """Warn if the body has too few linear tets through its thickness to bend correctly. stacklevel: as in `warn_locking`."""
        if self.order == 1 and (found := coarse_bending(self.mesh)) is not None:
            layers = max(1, round(found.layers))
            times = float(f"{found.stiffness:.1g}")  # only about one digit of the estimate is accurate
            warnings.warn(
                f"{self._label()}: about {layers} linear {'tet lies' if layers == 1 else 'tets lie'} through its thickness, "
                f"and it bends about {times:.0f} times too stiffly: order=2 bends correctly",
                UserWarning,
                stacklevel=stacklevel + 1,
            )

    def distance_outside(self, points: np.ndarray, heights: np.ndarray) -> np.ndarray:
        """Return how far points (p,3) [m] lie outside of the body at rest, given that in heights of the nearest tet (p,)."""
        return heights

    @property
    def selectable(self) -> slice:
        """Rows of the nodes that methods choose among: those of tets."""
        return slice(0, self.nodes.n_elastic)

    def select_nodes(self, where, what: str, repeats: bool = True) -> np.ndarray:
        """Return the chosen nodes (k,). where: as for `fix`, ids counted from the first selectable one; what: start of messages.

        Raises SceneError.
        """
        rows = self.selectable
        return rows.start + checks.selection(where, self.rest_positions[rows], what, "node", repeats=repeats)

    def select_triangles(self, where, what: str) -> np.ndarray:
        """Return the chosen rows (k,) of mesh.surface. where: as for `add_traction`; what: start of messages.

        Raises SceneError.
        """
        centroids = self.mesh.vertices[self.mesh.surface].mean(axis=1)
        return checks.selection(where, centroids, what, "surface triangle")

    add_load, add_traction, add_pressure, add_force, add_cavity = add_load, add_traction, add_pressure, add_force, add_cavity
    enclosed_volume, activate, embed = enclosed_volume, activate, embed

    def remove(self, *gone: Constraint | BodyLoad) -> None:
        """Remove constraints and loads. Raises SceneError for one that the body does not have."""
        self._remove(*gone)

    @property
    def riding_skin(self) -> Skin | None:
        """Its skin if that is shown but not touched."""
        return self.skin if self.skin is not None and not self.skin.contact else None

    def fix(self, where, axes: str = "xyz") -> Constraint:
        """Fix nodes at their start positions.

        where: node ids, a bool mask (n,), or a callable that gets the rest positions (n,3) and returns such a mask.
        axes: the fixed directions, such as "y" or "xz". Raises SceneError if no node is chosen or one is moved already.
        """
        what = self._check_open("fix")
        nodes = self.select_nodes(where, what)
        return self._add_constraint(Constraint(nodes, checks.axes(axes, what), None, where if callable(where) else None), what)

    def move(self, where, path: Callable | KeyFrames | None = None, axes: str = "xyz") -> Constraint:
        """Move nodes along a prescribed path, or hold them until `Simulator.set_displacement` moves them.

        where: as for `fix`, but without repeated ids. path: callable t [s] -> displacement from the start, (3,) or (k,3) [m] in
        the order of the chosen nodes, or None from the time of release; it is called once here, for t = 0. Or `KeyFrames`, whose
        pivot is in start coordinates. None: they stay until a command. axes: the prescribed directions. Raises SceneError if no
        node is chosen, one is fixed or moved already, or the path is invalid.
        """
        what = self._check_open("move")
        nodes = self.select_nodes(where, what, repeats=False)
        mask, path = checks.axes(axes, what), AT_REST if path is None else path
        if isinstance(path, KeyFrames):
            path = NodePath(path, self.rest_positions[nodes] + self.position)
        if not callable(path):
            raise SceneError(f"{what}: path must be a function of time, not {value_text(path)}")
        if checks.path_value(path, 0.0, what, "displacement", ((3,), (len(nodes), 3))) is None:
            raise SceneError(f"{what}: the path must give a displacement at t = 0, not None")
        return self._add_constraint(Constraint(nodes, mask, path, where if callable(where) else None), what)

    def _add_constraint(self, constraint: Constraint, what: str) -> Constraint:
        """Add a constraint. Raises SceneError if a node and axis is constrained already; only repeated fixes are allowed."""
        for earlier in self.constraints:
            if earlier.path is None and constraint.path is None:
                continue
            axes = np.flatnonzero(earlier.axes & constraint.axes)
            nodes = constraint.nodes[np.isin(constraint.nodes, earlier.nodes)]
            if len(axes) and len(nodes):
                verb = "fixed" if earlier.path is None else "moved"
                raise SceneError(f"{what}: node {nodes[0]} is already {verb} along {'xyz'[axes[0]]}")
        return self._add("constraints", constraint)
