"""Records of springs, tendons and attachments, which `connections` makes.

A point of a body is given by its rest position, in the coordinates of body.rest_positions; one of an obstacle by its position at
the start.
"""

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from taisoft.attributes import checked, guarded_record
from taisoft.scene.checks import number
from taisoft.scene.loads import ScalarLoad

MAX_OUTSIDE = 0.1  # heights of a tet by which a point may lie outside a body: curved surfaces do not meet exactly
_ADD_ANOTHER = "call scene.remove and add another one before the Simulator is made"


@guarded_record("point", _ADD_ANOTHER)
class Point:
    """A point of a body or of an obstacle."""

    owner: str  #: name of the body or obstacle
    position: np.ndarray  #: (3,) [m], of a body at rest, of an obstacle in the scene


@guarded_record("spring", _ADD_ANOTHER)
class Spring:
    """A spring between two points, which pulls with stiffness times its extension, plus damping times its rate."""

    name: str
    points: tuple[Point, Point]
    stiffness: float = checked(number, minimum=0.0, unit="N/m")  #: [N/m]
    rest_length: float | None = checked(number, None, minimum=0.0, unit="m")  #: [m]; None: the points' distance at the start
    damping: float = checked(number, 0.0, minimum=0.0, unit="N s/m")  #: [N s/m]
    numbers: ClassVar = ("stiffness", "rest_length", "damping")  #: that may change

    @property
    def arguments(self) -> dict:
        """What `add_spring` was given."""
        own = {"stiffness": self.stiffness, "damping": self.damping, "rest_length": self.rest_length}
        return dict(zip("ab", self.points)) | own

    @property
    def owners(self) -> list[str]:
        """Names of the bodies and obstacles of its points."""
        return [point.owner for point in self.points]


@guarded_record("tendon", "call sim.set_tension(name, force) or sim.set_length(name, length) in a simulation")
class Tendon(ScalarLoad):
    """A line through points, along which it slides without friction, of given tension or of given length at rest.

    It only pulls. One of given length is slack where its points are closer. Its tension is otherwise its stiffness times its
    extension or, without a stiffness, that which keeps its length. Its value is a tension [N] or a length [m].
    """

    name: str
    points: tuple[Point, ...]
    given: str = "force"  #: "force" or "length": what its value is
    stiffness: float | None = checked(number, None, above=0.0, unit="N/m")  #: [N/m] of one of given length; None: inextensible
    damping: ClassVar[float] = 0.0  #: [N s/m]
    owners = Spring.owners
    numbers: ClassVar = ("force", "length", "stiffness")

    @property
    def arguments(self) -> dict:
        """What `add_tendon` was given."""
        return {"points": self.points, self.given: self.given_value, "stiffness": self.stiffness}

    def allows(self, value: float) -> bool:
        """Whether a tension [N] or a length [m], whichever is given, may have this value."""
        return value >= 0.0 if self.given == "force" else value > 0.0

    @property
    def is_elastic(self) -> bool:
        """Whether its tension follows from its extension."""
        return self.given == "length" and self.stiffness is not None

    @property
    def is_inextensible(self) -> bool:
        """Whether its tension is a Lagrange multiplier, which keeps its length."""
        return self.given == "length" and self.stiffness is None


@guarded_record("attachment", _ADD_ANOTHER)
class Attachment:
    """Nodes of a body, each kept where it lies in a body or obstacle, or pulled there by a spring of rest length 0."""

    name: str
    a: str
    nodes: np.ndarray  #: (k,) int64 node ids of body a
    b: str  #: name of a body or obstacle
    #: [N/m] of each node's spring; None: it moves with b exactly
    stiffness: float | None = checked(number, None, above=0.0, unit="N/m")
    damping: float = checked(number, 0.0, minimum=0.0, unit="N s/m")  #: of each node
    where: Callable | None = None  #: as in `Constraint`
    reach: float = MAX_OUTSIDE  #: heights of a tet by which the nodes may lie outside body b
    numbers: ClassVar = ("stiffness", "damping")

    @property
    def arguments(self) -> dict:
        """What `attach` was given, with ids instead of a function."""
        damping = None if self.stiffness is None else self.damping
        return {"a": self.a, "where": self.nodes, "b": self.b, "stiffness": self.stiffness, "damping": damping}

    @property
    def owners(self) -> list[str]:
        """Names of its body, and of what that is attached to."""
        return [self.a, self.b]


Connection = Spring | Tendon | Attachment
