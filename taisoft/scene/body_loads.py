"""Loads of a body as methods: each function whose first argument is `self` is one of `Body`, whose class body lists them."""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.attributes import thawed
from taisoft.errors import MeshError, SceneError, reworded
from taisoft.mesh import quadratic
from taisoft.mesh.solids import is_closed
from taisoft.scene import checks
from taisoft.scene.key_frames import KeyFrames
from taisoft.scene.loads import Activation, Cavity, NodalForce, Pressure, Traction, either, value_or_path

if TYPE_CHECKING:
    from taisoft.scene.body import Body


def add_traction(self: "Body", where, traction) -> Traction:
    """Apply a dead load per reference area to surface triangles.

    where: rows of mesh.surface, a bool mask (t,), or a callable that gets the triangles' centroids at rest (t,3)
    and returns such a mask. traction: (3,) [Pa], or its path: callable t [s] -> (3,), called once here for t = 0, or
    `KeyFrames`, whose translations are the values. Raises SceneError if no triangle is chosen or a number is not finite.
    """
    what = self._check_open("add_traction")
    triangles = _triangles(self, where, what)
    return self._add(self.tractions, Traction(triangles, **value_or_path(traction, what, "traction", Traction.shapes)))


def add_pressure(self: "Body", where, pressure) -> Pressure:
    """Apply a pressure that acts along the deformed inward normal of surface triangles, and on their deformed area.

    where: as for `add_traction`. pressure: [Pa], a number, negative for suction, or its path: callable t [s] -> number,
    called once here for t = 0, or `KeyFrames` with values. Pressures on the same triangle add. Raises SceneError if no
    triangle is chosen or a number is not finite.
    """
    what = self._check_open("add_pressure")
    triangles = _triangles(self, where, what)
    given = value_or_path(pressure, what, "pressure", Pressure.shapes)
    return self._add(self.pressures, Pressure(triangles, closed=is_closed(self.mesh.surface[triangles]), **given))


def add_force(self: "Body", where, force) -> NodalForce:
    """Apply a dead load to nodes: a total force distributed by lumped mass, or one force per node.

    where: as for `fix`; a node chosen twice counts once. force: (3,) the total, or (k,3) in the order of the chosen
    nodes [N], or its path, as for `add_traction`. Raises SceneError if no node is chosen or numbers are not finite.
    """
    what = self._check_open("add_force")
    nodes = self.select_nodes(where, what)
    given = value_or_path(force, what, "force", ((3,), (len(nodes), 3)))
    return self._add(self.forces, NodalForce(nodes, where=where if callable(where) else None, **given))


def add_cavity(self: "Body", where, pressure=None, volume=None, name: str | None = None) -> Cavity:
    """Fill a cavity with a fluid of given pressure, or with an incompressible fluid of given volume.

    where: its surface triangles, as for `add_traction`: closed, with normals into the cavity. pressure: [Pa] above the
    ambient pressure, as for `add_pressure`. volume: [m^3], above 0, a number or a path; the pressure then follows, in
    implicit Euler and BDF2 steps and in statics. name: unique in the scene; by default "NAME cavity 0" and so on, NAME the
    body's. A triangle belongs to one cavity at most. Raises SceneError.
    """
    what = self._check_open("add_cavity")
    given, content = either(what, pressure=pressure, volume=volume)
    own = [cavity.name for cavity in self.cavities]
    name = checks.free_name(name, f"{self.name} cavity ", own, f"{what}: name")
    triangles = _triangles(self, where, what)
    if not is_closed(self.mesh.surface[triangles]):
        raise SceneError(f"{what}: the chosen triangles have a border: they must enclose the cavity")
    for other in self.cavities:
        if len(shared := np.intersect1d(triangles, other.triangles)):
            raise SceneError(f"{what}: surface triangle {shared[0]} of cavity {name!r} belongs to cavity {other.name!r}")
    rest_volume = _enclosed(self, triangles)
    if rest_volume <= 0.0:
        raise SceneError(f"{what}: the normals of the chosen triangles point outward: they must point into the cavity")
    cavity = Cavity(name, triangles, given, rest_volume, **value_or_path(content, what, given, Cavity.shapes))
    check_volume(cavity, f"{what}: volume")
    return self._add(self.cavities, cavity)


def enclosed_volume(self: "Body", where) -> float:
    """Return the volume [m^3] at rest of the cavity with these surface triangles, chosen as for `add_cavity`."""
    return _enclosed(self, _triangles(self, where, f"{self._label()}: enclosed_volume"))


def _enclosed(body: "Body", triangles: np.ndarray) -> float:
    x = body.rest_positions[body.face_nodes(triangles)]
    x = x - x[0, 0]
    if not body.is_curved:
        return -float(np.linalg.det(x[:, :3]).sum()) / 6.0
    points = np.einsum("tax,aq->tqx", x, quadratic.triangle_rule(2)[1])
    return -float((points * quadratic.area_vectors(x)).sum()) / 3.0


def _triangles(body: "Body", where, what: str) -> np.ndarray:
    """Return the chosen rows of mesh.surface, by their centroids at rest."""
    centroids = body.mesh.vertices[body.mesh.surface].mean(axis=1)
    return checks.selection(where, centroids, what, "surface triangle")


def activate(self: "Body", activation, region: int | str | None = None) -> None:
    """Activate the fibres of the body, or those of one region of its mesh, given by name or id; it replaces what was given.

    activation: a number from 0 to 1, or its path: callable t [s] -> number, called once here for t = 0, or `KeyFrames` with
    values. Raises SceneError if the body has no fibres, or the region or the activation is invalid.
    """
    activate_fibres(self, activation, region, self._check_open("activate"))


def activate_fibres(body: "Body", activation, region: int | str | None, what: str) -> None:
    """As `activate`, also during a run. what: start of messages."""
    if body.fibres is None:
        raise SceneError(f"{what}: it has no fibres: give add_body fibres")
    given = value_or_path(activation, what, "activation", Activation.shapes)
    known = [given["value"] if given["value"] is not None else given["path"](0.0)]
    known += list(activation.values) if isinstance(activation, KeyFrames) else []
    for value in map(float, known):
        if not 0.0 <= value <= 1.0:
            raise SceneError(f"{what}: an activation must lie from 0 to 1, not {value:g}")
    with reworded(MeshError, f"{what}: ", raised=SceneError):
        key = None if region is None else body.mesh.region_id(region)
    with thawed(body):
        body.activations = tuple(
            Activation(**given, region=one.region) if key in (None, one.region) else one for one in body.activations
        )


def check_volume(cavity: Cavity, what: str) -> None:
    """Raise SceneError if a volume is not above 0; of a path, at t = 0."""
    start = cavity.value if cavity.path is None else cavity.path(0.0)
    if cavity.given == "volume" and float(start) <= 0.0:
        raise SceneError(f"{what} must be above 0, not {float(start):g}")
