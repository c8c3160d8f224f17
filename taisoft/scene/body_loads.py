"""Loads of a body as methods: each function whose first argument is `self` is one of `Body`, whose class body lists them."""

from typing import TYPE_CHECKING

import numpy as np

from taisoft.attributes import thawed
from taisoft.errors import MeshError, SceneError, reworded
from taisoft.mesh import quadratic
from taisoft.scene import checks
from taisoft.scene.key_frames import KeyFrames
from taisoft.scene.loads import LOAD_KINDS, Activation, BodyLoad, Cavity, NodalForce, Pressure, Traction, value_or_path

if TYPE_CHECKING:
    from taisoft.scene.body import Body


def add_load(self: "Body", kind: str, where, *value, **arguments) -> BodyLoad:
    """Apply a load of a kind that `taisoft.scene.loads` registers, and return it; the calls below do so for those shipped.

    where, value, arguments: as `of` of its class takes them. Raises SceneError.
    """
    checks.choice(kind, f"{self._label()}: add_load: kind", tuple(LOAD_KINDS))
    what = self._check_open(f"add_{kind}" if hasattr(self, f"add_{kind}") else "add_load")
    try:
        LOAD_KINDS[kind].signature.bind(self, what, where, *value, **arguments)
    except TypeError as error:
        raise SceneError(f"{what}: {kind}: {error}") from None
    if kind not in self._takes:
        raise SceneError(f"{self._label()}: {self._takes_rule}")
    order, load = list(LOAD_KINDS).index, LOAD_KINDS[kind].of(self, what, where, *value, **arguments)
    self._hold("loads", sorted((*self.loads, load), key=lambda one: order(one.kind)))
    return load


def add_traction(self: "Body", where, traction) -> Traction:
    """Apply a dead load per reference area to surface triangles.

    where: rows of mesh.surface, a bool mask (t,), or a callable that gets the triangles' centroids at rest (t,3)
    and returns such a mask. traction: (3,) [Pa], or its path: callable t [s] -> (3,), called once here for t = 0, or
    `KeyFrames`, whose translations are the values. Raises SceneError if no triangle is chosen or a number is not finite.
    """
    return self.add_load("traction", where, traction)


def add_pressure(self: "Body", where, pressure) -> Pressure:
    """Apply a pressure that acts along the deformed inward normal of surface triangles, and on their deformed area.

    where: as for `add_traction`. pressure: [Pa], a number, negative for suction, or its path: callable t [s] -> number,
    called once here for t = 0, or `KeyFrames` with values. Pressures on the same triangle add. Raises SceneError if no
    triangle is chosen or a number is not finite.
    """
    return self.add_load("pressure", where, pressure)


def add_force(self: "Body", where, force) -> NodalForce:
    """Apply a dead load to nodes: a total force distributed by lumped mass, or one force per node.

    where: as for `fix`; a node chosen twice counts once; None, of a rigid body: its centre of mass. On a rigid body's vertices a
    total force acts in equal parts. force: (3,) the total, or (k,3) in the order of the chosen nodes [N], or its path, as for
    `add_traction`. Raises SceneError if no node is chosen or numbers are not finite.
    """
    return self.add_load("force", where, force)


def add_cavity(self: "Body", where, pressure=None, volume=None, name: str | None = None) -> Cavity:
    """Fill a cavity with a fluid of given pressure, or with an incompressible fluid of given volume.

    where: its surface triangles, as for `add_traction`: closed, with normals into the cavity. pressure: [Pa] above the
    ambient pressure, as for `add_pressure`. volume: [m^3], above 0, a number or a path; the pressure then follows, in
    implicit Euler and BDF2 steps and in statics. name: unique in the scene; by default "NAME cavity 0" and so on, NAME the
    body's. A triangle belongs to one cavity at most. Raises SceneError.
    """
    return self.add_load("cavity", where, pressure, volume, name)


def enclosed_volume(self: "Body", where) -> float:
    """Return the volume [m^3] at rest of the cavity with these surface triangles, chosen as for `add_cavity`."""
    triangles = self.select_triangles(where, f"{self._label()}: enclosed_volume")
    x = self.rest_positions[self.face_nodes(triangles)]
    x = x - x[0, 0]
    if not self.is_curved:
        return -float(np.linalg.det(x[:, :3]).sum()) / 6.0
    points = np.einsum("tax,aq->tqx", x, quadratic.triangle_rule(2)[1])
    return -float((points * quadratic.area_vectors(x)).sum()) / 3.0


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
