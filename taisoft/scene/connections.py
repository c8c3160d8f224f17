"""Springs, tendons and attachments: forces between points of bodies, and between these and obstacles.

A point of a body is given by its rest position, in the coordinates of body.rest_positions, or as a node; a point of an obstacle
by its position at the start. Each function whose first argument is `self` is a method of `Scene`, whose class body lists them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from taisoft.errors import SceneError, reworded
from taisoft.scene import checks
from taisoft.scene.body import Body, Constraint
from taisoft.scene.connection_records import MAX_OUTSIDE, Attachment, Connection, Point, Spring, Tendon
from taisoft.scene.loads import either, value_or_path
from taisoft.scene.locate import locate
from taisoft.scene.obstacles import Obstacle
from taisoft.scene.rigid import RigidBody

if TYPE_CHECKING:
    from taisoft.scene.scene import Scene

SAME = 1e-9  # of the largest coordinate of their bodies: points that are closer coincide


def add_spring(
    self: "Scene", a, b, stiffness: float, rest_length: float | None = None, damping: float = 0.0, name: str | None = None
) -> Spring:
    """Connect two points by a spring and return it.

    a, b: each (name, point): the name of a body and the point's rest position (3,) [m] or a node id; or the name of an obstacle,
    with which the point moves, and its position at the start. stiffness [N/m]; rest_length [m], by default the points' distance
    at the start; damping [N s/m], of the rate of its length, or, of a spring of rest length 0, in all directions. name: unique;
    "spring0" and so on by default. Raises SceneError.
    """
    self._check_open("add_spring")
    name = _free_name(self, name, "spring")
    what = f"spring {name!r}"
    points = tuple(_point(self, end, f"{what}: {label}") for label, end in (("a", a), ("b", b)))
    _check_any_body(self, points, what)
    if points[0].owner == points[1].owner and coincide(self, *points):
        raise SceneError(f"{what}: a and b are the same point of body {points[0].owner!r}")
    return self._add("springs", Spring(name, points, stiffness, rest_length, damping))


def add_tendon(
    self: "Scene", points, force=None, name: str | None = None, *, length=None, stiffness: float | None = None
) -> Tendon:
    """Lead a tendon through points, along which it slides without friction and which it pulls together, and return it.

    points: at least two, each as in `add_spring`, consecutive ones distinct. Either force: its tension [N], not negative; or
    length: its whole length at rest [m], above 0. Both may be a path: callable t [s] -> value, called once here for t = 0, or
    `KeyFrames` with values. stiffness [N/m], of one of given length: its tension is stiffness times its extension, 0 where it
    is slack. Without a stiffness it is inextensible: its tension is that which keeps it from being longer. name: unique;
    "tendon0" and so on by default. Raises SceneError.
    """
    self._check_open("add_tendon")
    name = _free_name(self, name, "tendon")
    what = f"tendon {name!r}"
    if not isinstance(points, (list, tuple)) or len(points) < 2:
        raise SceneError(f"{what}: points must be a list of at least two")
    made = tuple(_point(self, end, f"{what}: point {k}") for k, end in enumerate(points))
    _check_any_body(self, made, what)
    _check_distinct(self, made, what)
    given, content = either(what, force=force, length=length)
    if stiffness is not None and given == "force":
        raise SceneError(f"{what}: stiffness is that of a tendon of given length: give a length instead of a force")
    tendon = Tendon(name, made, given, stiffness, **value_or_path(content, what, given, Tendon.shapes))
    check_tendon(tendon, tendon.path(0.0) if tendon.value is None else tendon.value, what)
    return self._add("tendons", tendon)


def attach(
    self: "Scene", a: str, where, b: str, stiffness: float | None = None, damping: float = 0.0, name: str | None = None
) -> Attachment:
    """Attach nodes of a body to where they lie in another body, or to an obstacle; return the attachment.

    a: name of the body; where: its nodes, as for `Body.fix`; b: name of another body, or of an obstacle. The chosen nodes must
    lie in or on body b at the start, or outside by at most a tenth of the height of a tet; anywhere if b is an obstacle.
    stiffness: None, they move with b exactly; else [N/m] of a spring of rest length 0 for each node, whose damping [N s/m] is
    given too. Bodies and obstacles that are attached exactly do not collide with each other. name: unique; "attachment0" and so
    on by default. Raises SceneError.
    """
    self._check_open("attach")
    name = _free_name(self, name, "attachment")
    what = f"attachment {name!r}"
    body = _owner(self, a, what)
    if not isinstance(body, Body):
        raise SceneError(f"{what}: {a!r} is an obstacle: give the body first")
    if isinstance(body, RigidBody) and stiffness is None:
        raise SceneError(f"{what}: {a!r} is rigid: attach the other body's nodes to it, or give a stiffness")
    if where is None:
        raise SceneError(f"{what}: no node is chosen")
    nodes = body.select_nodes(where, what)
    if b == a:
        raise SceneError(f"{what}: body {a!r} cannot be attached to itself")
    owner = _owner(self, b, what)
    attachment = Attachment(name, body.name, nodes, owner.name, stiffness, damping, where if callable(where) else None)
    if stiffness is None and damping > 0.0:
        raise SceneError(f"{what}: damping is that of springs: give a stiffness, too")
    if isinstance(owner, Body):
        locate_nodes(self, attachment)
    return self._add("attachments", attachment)


def check_connections(scene: "Scene") -> None:
    """Raise SceneError if a body or obstacle of a connection was removed, or another one in its place lies elsewhere."""
    for one in scene.connections:
        what = f"{type(one).__name__.lower()} {one.name!r}"
        found = [_owner(scene, owner, what) for owner in one.owners]
        if not isinstance(one, Attachment):
            for k, (point, owner) in enumerate(zip(one.points, found)):
                check_inside(owner, point.position, f"{what}: point {k}")
            if isinstance(one, Tendon):
                _check_distinct(scene, one.points, what)
        elif not isinstance(found[0], Body) or one.nodes.max() >= found[0].n_nodes:
            raise SceneError(f"{what}: {one.a!r} is no longer the body whose nodes are attached")
        elif isinstance(found[1], Body):
            locate_nodes(scene, one)
    check_exact(scene)


def check_exact(scene: "Scene") -> None:
    """Raise SceneError if an exactly attached node is constrained or attached twice, or bodies differ in damping."""
    taken: dict[str, set[int]] = {}
    for one in scene.exact_attachments:
        what, body, own = f"attachment {one.name!r}", scene.body(one.a), taken.setdefault(one.a, set())
        fixed = {node for constraint in body.constraints for node in constraint.nodes.tolist()}
        for rule, others in (("fixed or moved, too: leave it out there or here", fixed), ("attached already", own)):
            if both := sorted(others & set(one.nodes.tolist())):
                raise SceneError(f"{what}: node {both[0]} of body {one.a!r} is {rule}")
        own |= set(one.nodes.tolist())
        if one not in scene.dependent_attachments:
            continue
        if body.dilatation != "local":
            rule = f"nodes of body {one.a!r} cannot be attached exactly, since its dilatation is a mean"
            raise SceneError(f'{what}: {rule}: give the body dilatation="local", or the attachment a stiffness')
        for damping in ("mass_damping", "stiffness_damping"):  # a force on one body's node acts on the other's
            elastic = [owner for name in one.owners if not isinstance(owner := scene.body(name), RigidBody)]
            if len({getattr(owner.composition.first, damping) for owner in elastic}) > 1:
                raise SceneError(f"{what}: bodies {one.a!r} and {one.b!r} must have the same {damping}")


@dataclass(frozen=True, eq=False)
class CarriedPath:
    """Motion of nodes with an obstacle: t [s] -> displacement (k,3) [m]."""

    obstacle: Obstacle
    starts: np.ndarray  #: (k,3) [m], start positions

    def __call__(self, t: float) -> np.ndarray:
        return self.obstacle.points_at(t, self.obstacle.undisplaced(self.starts)) - self.starts


def constraint_of(scene: "Scene", attachment: Attachment) -> Constraint:
    """The constraint of nodes that are attached to an obstacle exactly."""
    body, obstacle = scene.body(attachment.a), scene.obstacle(attachment.b)
    starts = body.rest_positions[attachment.nodes] + body.position
    path = None if obstacle.path is None else CarriedPath(obstacle, starts)
    return Constraint(attachment.nodes, np.ones(3, dtype=bool), path, attachment.where)


def attached_pairs(scene: "Scene") -> np.ndarray:
    """Return which colliders are attached to each other exactly, (n,n) bool: these do not collide."""
    names = [one.name for one in scene.colliders]
    pairs = np.zeros((len(names), len(names)), dtype=bool)
    for one in scene.exact_attachments:
        a, b = names.index(one.a), names.index(one.b)
        pairs[a, b] = pairs[b, a] = True
    return pairs


def check_tendon(tendon: Tendon, value: float, what: str) -> None:
    """Raise SceneError for a negative tension [N] or a length [m] that is not above 0, whichever is given."""
    if not tendon.allows(value):
        rule = "above 0 m" if tendon.given == "length" else "at least 0 N"
        why = "" if tendon.given == "length" else ": a tendon cannot push"
        raise SceneError(f"{what}: {tendon.given} must be {rule}, not {float(value):g}{why}")


def start_of(scene: "Scene", point: Point) -> np.ndarray:
    """Position (3,) [m] of a point at the start."""
    owner = _owner(scene, point.owner, "point")
    return point.position + owner.position if isinstance(owner, Body) else point.position


def locate_nodes(scene: "Scene", attachment: Attachment) -> tuple[np.ndarray, np.ndarray]:
    """Nodes (k, 4 or 10) of body b and weights, which follow the points where the attached nodes lie. Raises SceneError."""
    a, b = scene.body(attachment.a), scene.body(attachment.b)
    points = a.rest_positions[attachment.nodes] + (a.position - b.position)
    nodes, weights, outside = locate(b, points)

    def label(k: int) -> str:
        return f"attachment {attachment.name!r}: node {attachment.nodes[k] - a.selectable.start} of body {a.name!r}"

    _check_outside(outside, label, b, attachment.reach)
    return nodes, weights


class End(NamedTuple):
    """Where a line of a connection ends or turns: at the sum of nodes (k,) of the scene times weights (k,), or at a point (3,)
    [m] that an obstacle has at the start."""

    nodes: np.ndarray = np.zeros(0, dtype=np.int64)
    weights: np.ndarray = np.zeros(0)
    point: np.ndarray = np.zeros(3)
    obstacle: Obstacle | None = None


def lines_of(scene: "Scene", connection: Connection) -> list[list[End]]:
    """Return the lines of a connection: one through the points of a spring or tendon, one for each node of an attachment."""
    if not isinstance(connection, Attachment):
        return [[_end(scene, point) for point in connection.points]]
    starts, a, b = scene.first_nodes, scene.body(connection.a), scene.collider(connection.b)
    if isinstance(b, Body):
        places = [End(starts[b.name] + nodes, weights) for nodes, weights in zip(*locate_nodes(scene, connection))]
    else:
        places = [End(point=point, obstacle=b) for point in a.rest_positions[connection.nodes] + a.position]
    return [[End(starts[a.name] + np.array([node]), np.ones(1)), place] for node, place in zip(connection.nodes, places)]


def _end(scene: "Scene", point: Point) -> End:
    owner = scene.collider(point.owner)
    if not isinstance(owner, Body):
        return End(point=point.position, obstacle=owner)
    nodes, weights, _ = locate(owner, point.position[None])
    return End(scene.first_nodes[owner.name] + nodes[0], weights[0])


def coincide(scene: "Scene", p: Point, q: Point) -> bool:
    """Return whether two points are at the same place at the start, within rounding."""
    own = [owner for name in (p.owner, q.owner) if isinstance(owner := scene.collider(name), Body)]
    size = max(float(np.abs(a).max()) for a in (p.position, q.position, *(body.rest_positions for body in own)))
    return bool(np.abs(start_of(scene, p) - start_of(scene, q)).max() <= SAME * size)


def _check_outside(outside: np.ndarray, label: Callable[[int], str], body: Body, reach: float = MAX_OUTSIDE) -> None:
    k = int(np.argmax(outside))
    if outside[k] > reach:
        raise SceneError(
            f"{label(k)} lies outside of body {body.name!r}, by {outside[k]:.2g} times {body.extent}: at most {reach:g} is "
            "allowed"
        )


def _point(scene: "Scene", end, what: str) -> Point:
    """Return the point that (name, position or node id) describes."""
    if not isinstance(end, (list, tuple)) or len(end) != 2:
        raise SceneError(f"{what} must be (name, point), the name of a body or obstacle and a position or a node id")
    owner = _owner(scene, end[0], what)
    is_node = isinstance(end[1], (int, np.integer)) and not isinstance(end[1], bool)
    if is_node and isinstance(owner, Body):
        rows = owner.selectable
        node = rows.start + checks.whole(end[1], f"{what}: the node", range(rows.stop - rows.start))
        return Point(owner.name, owner.rest_positions[node].copy())
    position = checks.vector(end[1], f"{what}: the point")
    check_inside(owner, position, f"{what}: the point")
    return Point(owner.name, position)


def check_inside(owner, position: np.ndarray, what: str) -> None:
    """Raise SceneError if a point (3,) [m] lies outside of a body at rest. what: the point, in messages."""
    if isinstance(owner, Body):
        _check_outside(locate(owner, position[None])[2], lambda _: what, owner)


def _owner(scene: "Scene", name: str, what: str):
    """Return a body or an obstacle. Raises SceneError."""
    with reworded(SceneError, f"{what}: ", without="scene: "):
        return scene.collider(name)


def _check_distinct(scene: "Scene", points: tuple[Point, ...], what: str) -> None:
    for k, (p, q) in enumerate(zip(points, points[1:])):
        if coincide(scene, p, q):
            raise SceneError(f"{what}: points {k} and {k + 1} coincide")


def _check_any_body(scene: "Scene", points: tuple[Point, ...], what: str) -> None:
    if not any(isinstance(scene.collider(point.owner), Body) for point in points):
        raise SceneError(f"{what}: at least one point must be of a body")


def _free_name(scene: "Scene", name: str | None, kind: str) -> str:
    """Return the name, or the first free default name; names are unique among all connections. Raises SceneError."""
    return checks.free_name(name, kind, [one.name for one in scene.connections])
