"""Describe a scene as plain data: elastic bodies, obstacles, connections, gravity, and contact parameters of pairs.

Every input is validated and converted to arrays when it is added, so an existing scene can be simulated.
"""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from taisoft.attributes import Guarded, thawed
from taisoft.display import drawn
from taisoft.errors import SceneError
from taisoft.mesh.placing import UP
from taisoft.mesh.surface_mesh import SurfaceMesh
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene import checks
from taisoft.scene.body import USE_A_COPY, Body, Constraint
from taisoft.scene.collision import CollisionSettings
from taisoft.scene.connection_records import Attachment, Connection, Spring, Tendon
from taisoft.scene.connections import add_spring, add_tendon, attach, attached_pairs, check_connections, constraint_of
from taisoft.scene.curves import Curve
from taisoft.scene.loads import Cavity
from taisoft.scene.look import Camera, background_of, check_follow, lights_of
from taisoft.scene.material import Material
from taisoft.scene.obstacles import HalfSpace, Obstacle, Shape, surface_numbers
from taisoft.scene.rigid import RigidBody
from taisoft.scene.robot import PlacedRobot, add_robot


class Scene(Guarded):
    """Input of a simulation: gravity, bodies, obstacles and connections. SI units, y or z up.

    springs, tendons, attachments: what connects points of bodies, see `add_spring`, `add_tendon` and `attach`. robots: see
    `add_robot`.

    contact_pairs: {frozenset of two names, or of one for a body with itself: (friction, restitution)}, each a number, or
    None for the default of `contact_numbers`; read-only, changed by `set_contact`. Bodies, obstacles and connections are tuples:
    methods add to them, and `remove` removes.

    background, lights, camera: how pictures show the scene; see `taisoft.scene.look`.
    A Simulator freezes the scene that it takes, see `freeze`.
    """

    _contents = {
        "bodies": "call scene.add_body or scene.remove",
        "obstacles": "call scene.add_obstacle or scene.remove",
        "springs": "call scene.add_spring or scene.remove",
        "tendons": "call scene.add_tendon or scene.remove",
        "attachments": "call scene.attach or scene.remove",
        "robots": "call scene.add_robot",
        "contact_pairs": "call scene.set_contact(name_a, name_b, friction=...)",
    }
    _default_frozen = USE_A_COPY
    _instead_frozen = {
        "gravity": "call sim.set_gravity(gravity)",
        "set_contact": "call sim.set_contact(name_a, name_b, friction=...)",
        "contact_pairs": "call sim.set_contact(name_a, name_b, friction=...)",
        **dict.fromkeys(("tendons", "add_tendon"), "call sim.set_tension(name, force) or sim.set_length(name, length)"),
    }

    def __init__(self, gravity=None, up: str | None = None):
        """gravity: (3,) [m/s^2], by default 9.81 downwards. up: axis that points up, "y" or "z"; by default "z" if gravity acts
        exactly along -z, else "y". Raises SceneError for other values."""
        x, y, z = np.zeros(3) if gravity is None else checks.vector(gravity, "scene: gravity")
        self.up = up if up is not None else "z" if x == y == 0.0 > z else "y"
        self.gravity = 0.0 - 9.81 * UP[self.up] if gravity is None else gravity
        self.bodies: tuple[Body, ...] = ()
        self.obstacles: tuple[Obstacle, ...] = ()
        self.springs: tuple[Spring, ...] = ()
        self.tendons: tuple[Tendon, ...] = ()
        self.attachments: tuple[Attachment, ...] = ()
        self.robots: tuple[PlacedRobot, ...] = ()
        self.contact_pairs: dict[frozenset[str], tuple[float | None, float | None]] = {}
        self.collision = CollisionSettings()
        self.allow_initial_overlap, self.contact_forces = False, True
        self.background = self.lights = self.camera = None
        self._start: Scene | None = None  # see `snapshot`
        self._seal(Scene.__init__)

    gravity = checks.attribute("gravity", checks.vector, "Acceleration of gravity (3,) [m/s^2].")
    up = checks.attribute(
        "up",
        partial(checks.choice, allowed=tuple(UP)),
        'Axis that points up, "y" or "z", in pictures, in USD and for `add_ground`; setting it turns nothing in the scene.',
    )
    collision = checks.attribute("collision", partial(checks.instance, kind=CollisionSettings), "Settings of the contact search.")
    allow_initial_overlap = checks.attribute(
        "allow_initial_overlap",
        checks.flag,
        "Whether initial overlap is allowed. Otherwise a Simulator refuses overlaps deeper than 1e-6 of the smaller size.",
    )
    contact_forces = checks.attribute(
        "contact_forces",
        checks.flag,
        "Whether contacts exert forces. Otherwise bodies pass through each other, and contacts are detected only on request.",
    )
    background = checks.attribute(
        "background",
        lambda value, _: background_of(value),
        'sRGB colours (2,3) at the top and the bottom of pictures, also set as one for both, or as "#rrggbb"; None: light grey.',
    )
    lights = checks.attribute(
        "lights",
        lambda value, _: lights_of(value),
        "Lights of pictures and USD, a tuple of `Light`, beside that of the sky; None: two that move with the camera.",
    )
    camera = checks.attribute(
        "camera",
        partial(checks.instance, kind=Camera, optional=True),
        "`Camera` of pictures, films and USD; None: one that frames the bodies and steps back from them.",
    )

    def pushes(self, self_collision: bool) -> bool:
        """Return whether contact forces can occur. self_collision: whether bodies collide with themselves."""
        if not self.contact_forces or self_collision or not self.exact_attachments:
            return self.contact_forces and (self_collision or len(self.colliders) > 1)
        return bool(np.triu(~attached_pairs(self), 1)[: len(self.bodies)].any())

    @property
    def colliders(self) -> list[Body | Obstacle]:
        """Bodies, then obstacles, each in the order added; collider indices in contacts refer to this list."""
        return [*self.bodies, *self.obstacles]

    def __repr__(self) -> str:
        names = "up='z', " * (self.up == "z") + f"bodies={[body.name for body in self.bodies]}"
        if self.obstacles:
            names += f", obstacles={[obstacle.name for obstacle in self.obstacles]}"
        return f"Scene(gravity={tuple(self.gravity.tolist())}, {names})"

    def _repr_html_(self) -> str | None:
        return drawn("scene_html", self)

    def snapshot(self, start: "Scene | None" = None) -> "Scene":
        """Return an independent, unfrozen copy of the scene and its bodies; meshes are shared.

        start: the scene that a run began with, if this one holds the run's present numbers: a Simulator of the copy then
        continues the run, and what it models follows from `start`.
        """
        copied = copy.copy(self)
        with thawed(copied):
            copied.bodies, copied._start = [copy.copy(body) for body in self.bodies], start
            copied.obstacles = [copy.copy(obstacle) for obstacle in self.obstacles]  # a simulation may replace their paths
            for obstacle in copied.obstacles if start is None else ():
                checks.store(obstacle, path=obstacle.given_path)
        begun = start or self.start
        for body in copied.rigid_bodies:
            attached = [begun.body(one.a) for one in begun.exact_attachments if one.b == body.name]
            body.stiffen(begun.gravity, begun.bodies, attached)
        return copied

    @property
    def rigid_bodies(self) -> list[RigidBody]:
        """The rigid ones among the bodies."""
        return [body for body in self.bodies if isinstance(body, RigidBody)]

    @property
    def start(self) -> "Scene":
        """The scene that the run began with, see `snapshot`; else this one."""
        return self._start or self

    def check(self) -> None:
        """Raise SceneError if in-place changes made an array, such as gravity, invalid."""
        checks.vector(self.gravity, "scene: gravity")
        for body in self.bodies:
            body.check()
        names: set[str] = set()
        for body in self.bodies:
            for cavity in body.cavities:
                if cavity.name in names:
                    raise SceneError(f"body {body.name!r}: cavity name {cavity.name!r} is taken; names must be unique")
                names.add(cavity.name)
        check_follow(self.camera, self.bodies)
        check_connections(self)

    @property
    def first_nodes(self) -> dict[str, int]:
        """The first node of each body, by its name, where nodes are counted through all bodies."""
        return dict(zip((body.name for body in self.bodies), np.cumsum([0, *(body.n_nodes for body in self.bodies)]).tolist()))

    @property
    def has_springs(self) -> bool:
        """Whether there are springs, tendons, or attachments by springs."""
        return bool(self.springs or self.tendons) or any(one.stiffness is not None for one in self.attachments)

    def moves(self, connection: Connection) -> bool:
        """Whether a connection has an end on an obstacle that moves along a path."""
        return any(one.name in connection.owners and one.path is not None for one in self.obstacles)

    def constraints(self, body: Body) -> list[Constraint]:
        """A body's constraints, and those of its nodes that are attached to obstacles exactly."""
        held = [one for one in self.exact_attachments if one.a == body.name and one not in self.dependent_attachments]
        return [*body.constraints, *(constraint_of(self, one) for one in held)]

    @property
    def dependent_attachments(self) -> list[Attachment]:
        """The exact ones to other bodies."""
        bodies = {body.name for body in self.bodies}
        return [one for one in self.exact_attachments if one.b in bodies]

    @property
    def exact_attachments(self) -> list[Attachment]:
        """The attachments without springs."""
        return [one for one in self.attachments if one.stiffness is None]

    @property
    def connections(self) -> list[Connection]:
        """Springs, then tendons, then attachments, each in the order added."""
        return [*self.springs, *self.tendons, *self.attachments]

    @property
    def loads(self) -> list:
        """The loads of all bodies, then the tendons: what has a value or a path."""
        return [*(load for body in self.bodies for load in (*body.loads, *body.activations)), *self.tendons]

    add_spring, add_tendon, attach, add_robot = add_spring, add_tendon, attach, add_robot

    def freeze(self) -> None:
        """Refuse all later changes of the scene and its bodies. A Simulator calls this when it takes the scene, since changes
        would have no effect. `snapshot` returns a copy that can change."""
        for one in (self, *self.bodies):
            one._freeze()

    def add_body(
        self,
        mesh: TetMesh,
        material: Material | Mapping[int | str, Material],
        name: str | None = None,
        position=(0.0, 0.0, 0.0),
        velocity=(0.0, 0.0, 0.0),
        order: int = 1,
        quadrature_degree: int | None = None,
        collision: str = "auto",
        young: float | np.ndarray | None = None,
        poisson: float | np.ndarray | None = None,
        density: float | np.ndarray | None = None,
        dilatation: str = "auto",
        parameters: Mapping[str, float | np.ndarray] | None = None,
        fibres=None,
        curve: Curve | None = None,
        colour=None,
        opacity: float = 1.0,
    ) -> Body:
        """Add a body and return it.

        mesh: its shape at rest. material: for all tets, or a dict that gives each of the mesh's regions, by name or id, its
        own; laws may differ, but friction, restitution and damping must be the same in all. young [Pa], poisson, density
        [kg/m^3], parameters: numbers that replace the material's, the last by name for laws that have parameters; one for the
        body, or (m,) with one for each tet. name: unique; "body0" and so on by default. position: (3,) [m], initial
        translation. velocity: (3,) for all nodes or (n,3) [m/s]. order: 1, linear tets, or 2, quadratic ones with nodes in the
        middle of every edge. quadrature_degree: None for the default; order 2 has four points (2) or fourteen (4). collision:
        contact geometry, "proximity", also for "auto", or "distance_field". dilatation: "mean", averaged over patches of a few
        linear tets, or each quadratic tet, so that a Poisson's ratio near 0.5 does not lock them; "local", of each quadrature
        point; or "auto": "mean" for linear tets if that ratio is at least 0.45 in some of them. It stays as decided when the
        ratio changes during a run.
        fibres: directions at rest of the fibres that numbers of the material describe: (3,), (m,3) by tet, or a function of the
        tets' centroids (m,3) that returns (m,3), of any length, 0 in tets without; by default those of the mesh.
        curve: for order 2, what the edges of its surface follow at rest: a Sphere, a Capsule, which is a cylinder between its
        ends, or a fine SurfaceMesh, in the coordinates of the mesh: the edges of faces whose corners all lie on it, within 1 % of
        an edge, follow it; "smooth", a smooth surface through the vertices, on which edges of more than 40 degrees stay sharp;
        or "straight". None: the mesh's mid-edge nodes, if it has any, else straight.
        colour: sRGB in pictures and USD, "#rrggbb" or (3,) in [0, 1]; None for one of the palette. opacity: 1 hides what is
        behind.
        Warns if tets of order 1 are far too stiff: if they lock, or in a thin body with so few tets through its thickness that
        it bends at most half as far as it should. Raises SceneError.
        """
        self._check_open("add_body")
        name = self._free_name(name, "body")
        numbers = {"young": young, "poisson": poisson, "density": density, "parameters": parameters}
        shape = order, quadrature_degree, collision, dilatation, fibres, curve
        body = Body(name, mesh, material, position, velocity, *shape, **numbers)
        body.colour, body.opacity = colour, opacity
        self._add("bodies", body)
        body.warn_locking(stacklevel=2)
        body.warn_bending(stacklevel=2)
        return body

    def add_rigid_body(
        self,
        mesh: TetMesh | SurfaceMesh,
        density: float = 1000.0,
        name: str | None = None,
        position=(0.0, 0.0, 0.0),
        velocity=(0.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 0.0),
        friction: float = 0.5,
        restitution: float = 0.0,
        young: float | None = None,
        colour=None,
        opacity: float = 1.0,
    ) -> RigidBody:
        """Add a rigid body and return it; it touches everything as other bodies do.

        mesh: its shape at rest, a closed surface or tets, of which only the surface counts. density: [kg/m^3]. name: unique;
        "rigid0" and so on by default. position: (3,) [m], initial translation. velocity: (3,) [m/s] of its centre;
        angular_velocity: (3,) [rad/s]. young: [Pa], how stiff it is; by default so stiff that its weight, its spin, impacts at
        the largest speed at the start and soft bodies hardly strain it, see `sim.rigid_strain`. colour, opacity: as for
        `add_body`. Raises SceneError.
        """
        self._check_open("add_rigid_body")
        name = self._free_name(name, "rigid")
        body = RigidBody(name, mesh, density, position, velocity, angular_velocity, friction, restitution, young)
        body.colour, body.opacity = colour, opacity
        return self._add("bodies", body)

    def add_obstacle(
        self,
        shape: Shape,
        name: str | None = None,
        friction: float = 0.5,
        restitution: float = 0.0,
        path: Callable | None = None,
        colour=None,
        opacity: float = 1.0,
    ) -> Obstacle:
        """Add an obstacle and return it.

        shape: HalfSpace, Sphere, Box, Capsule or MeshObstacle. name: unique; "obstacle0" and so on by default. path:
        callable t [s] -> (translation (3,) [m], rotation (3,3) about the shape's pivot), called once here for t = 0;
        or `KeyFrames`. colour, opacity: as for `add_body`. Raises SceneError.
        """
        self._check_open("add_obstacle")
        name = self._free_name(name, "obstacle")
        return self._add("obstacles", Obstacle(shape, name, friction, restitution, path, colour, opacity))

    def add_ground(
        self,
        height: float = 0.0,
        friction: float = 0.5,
        restitution: float = 0.0,
        name: str | None = "ground",
        colour=None,
        opacity: float = 1.0,
    ) -> Obstacle:
        """Add a half-space that is level and whose surface has this height [m] along `up`; return it. Raises SceneError."""
        point = checks.number(height, "ground: height", unit="m") * UP[self.up] + 0.0
        return self.add_obstacle(HalfSpace(point, UP[self.up]), name, friction, restitution, None, colour, opacity)

    def remove(self, *gone: Body | Obstacle | Connection) -> None:
        """Remove bodies, obstacles and connections, with what was set for their contacts.

        Raises SceneError for one that the scene does not have, for robots, and for their links.
        """
        for placed in self.robots:
            if any(one is placed or getattr(one, "name", None) in placed.shapes for one in gone):
                raise SceneError(f"scene: remove: robot {placed.name!r} and its links cannot be removed: make a scene without it")
        self._remove(*gone)
        names = {one.name for one in self.colliders}
        self._hold("contact_pairs", {pair: numbers for pair, numbers in self.contact_pairs.items() if pair <= names})

    def body(self, name: str) -> Body:
        """Return the body with this name. Raises SceneError if there is none."""
        return _find(self.bodies, name, "body")

    def cavity(self, name: str) -> tuple[Body, Cavity]:
        """Return the cavity with this name, and its body. Raises SceneError if there is none."""
        owned = [(body, cavity) for body in self.bodies for cavity in body.cavities]
        return owned[checks.index(name, [cavity.name for _, cavity in owned], "scene: no cavity")]

    def obstacle(self, name: str) -> Obstacle:
        """Return the obstacle with this name. Raises SceneError if there is none."""
        return _find(self.obstacles, name, "obstacle")

    def collider(self, name: str) -> Body | Obstacle:
        """Return the body or obstacle with this name. Raises SceneError if there is none."""
        return _find(self.colliders, name, "body or obstacle")

    def set_contact(self, name_a: str, name_b: str, friction: float | None = None, restitution: float | None = None) -> None:
        """Set friction and restitution of two bodies, a body and an obstacle, or a body and itself (its name twice).

        An omitted number is unchanged. Raises SceneError for unknown names, two obstacles, values outside the rules, or no
        number at all.
        """
        self._check_open("set_contact")
        pair = self._pair(name_a, name_b)
        what = f"scene: contact of {name_a!r} and {name_b!r}"
        if friction is None and restitution is None:
            raise SceneError(f"{what}: give friction or restitution")
        before = self.contact_pairs.get(pair, (None, None))
        given = surface_numbers(0.0 if friction is None else friction, 0.0 if restitution is None else restitution, what)
        is_given = (friction is not None, restitution is not None)
        numbers = tuple(new if use else old for new, use, old in zip(given, is_given, before))
        dict.__setitem__(self.contact_pairs, pair, numbers)

    @property
    def bounces(self) -> bool:
        """Whether any pair has a restitution above 0."""
        own = [self.surface_of(c.name).restitution for c in self.colliders]
        return any(e > 0.0 for e in own) or any(e for _, e in self.contact_pairs.values())

    def contact_numbers(self, name_a: str, name_b: str) -> tuple[float, float]:
        """Return (friction, restitution) of a pair: as set, else the geometric mean of frictions and the larger restitution."""
        friction, restitution = self.contact_pairs.get(self._pair(name_a, name_b), (None, None))
        a, b = self.surface_of(name_a), self.surface_of(name_b)
        return (
            math.sqrt(a.friction * b.friction) if friction is None else friction,
            max(a.restitution, b.restitution) if restitution is None else restitution,
        )

    def _pair(self, name_a: str, name_b: str) -> frozenset[str]:
        """Return the key of a pair that can collide. Raises SceneError for any other pair."""
        found = [self.collider(name) for name in (name_a, name_b)]
        if not any(isinstance(one, Body) for one in found):
            raise SceneError(f"scene: contact of {name_a!r} and {name_b!r}: one of the two must be a body")
        return frozenset((name_a, name_b))

    def surface_of(self, name: str) -> Material | Obstacle:
        """Return the record that holds a collider's own friction and restitution."""
        one = self.collider(name)
        return one.composition.first if isinstance(one, Body) else one

    def _free_name(self, name: str | None, kind: str) -> str:
        """Return the name, or the first free default name if it is None. Raises SceneError if it is taken."""
        return checks.free_name(name, kind, [one.name for one in self.colliders])


def _find(items: Sequence, name: str, kind: str) -> Body | Obstacle:
    """Return the item with this name. Raises SceneError with the closest name if there is none."""
    return items[checks.index(name, [item.name for item in items], f"scene: no {kind}")]
