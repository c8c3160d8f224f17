"""Rigid bodies: a surface carried by one stiff linear tet, whose four nodes have the body's mass, centre and moments of inertia.

Four equal point masses at c + S^(1/2) t_a, with S the covariance of the body's volume about its centre c and t_a the corners
(1,1,1), (1,-1,-1), (-1,1,-1), (-1,-1,1), have sum t_a = 0 and sum t_a t_a^T = 4 I, hence the body's mass, centre and second
moments. The lumped mass of a tet at these points is therefore exact for every affine motion, rigid ones among them. The vertices
of the surface are embedded: affine functions of the four nodes. In implicit steps elasticity keeps the tet nearly
rigid; explicit steps move it as rigid.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from taisoft.attributes import thawed
from taisoft.errors import SceneError
from taisoft.mesh import nodes as mesh_nodes
from taisoft.mesh.distances import are_inside, distances
from taisoft.mesh.quality import volume_moments
from taisoft.mesh.surface_mesh import SurfaceMesh, as_surface
from taisoft.mesh.tet_mesh import TetMesh
from taisoft.scene import checks
from taisoft.scene.body import Body, Constraint
from taisoft.scene.composition import Composition, compose
from taisoft.scene.key_frames import KeyFrames
from taisoft.scene.laws import LAWS
from taisoft.scene.material import Material
from taisoft.scene.obstacles import checked_pose

CORNERS = np.array([(1.0, 1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0), (-1.0, -1.0, 1.0)])  # t_a, a positive tet
FRAME = len(CORNERS)  # nodes of the tet, which come before the vertices of the surface
STRAIN = 1e-5  # largest strain by its own weight, by its spin and of the kinetic energy at the start, for which young is chosen
STIFFER = 1e3  # times the stiffest soft body's young at least, whose contact pressures seldom exceed a tenth of it
LEAST_GRAVITY = 9.81  # [m/s^2] for which young is chosen where there is less, for the sake of other forces
FLAT = 1e-9  # smallest over largest standard deviation of a volume that has a thickness
PAIRS_AT_ONCE = 100_000  # of points and triangles; bounds the memory, about 1 kB each
ADD_ANOTHER = "add another one by scene.add_rigid_body"
NO_LOADS = "a rigid body takes forces only, by add_force, and its surface is that of its mesh"


class RigidBody(Body):
    """A rigid body of a scene; made by `Scene.add_rigid_body`.

    Its nodes are the four of its tet, then the vertices of its surface in the order given; `select_nodes` and all methods that
    choose nodes count vertices from 0. shape: the mesh that was given; surface: its `SurfaceMesh`. centre: (3,) [m] of mass at
    rest; inertia: (3,3) [kg m^2] about it. given_young: [Pa], None if it is chosen.
    """

    extent = "its size"
    _takes, _takes_rule = ("force",), NO_LOADS
    _own = ("centre", "inertia", "shape", "surface", "given_young")
    _read_only = Body._read_only | frozenset(_own)
    _instead = Body._instead | dict.fromkeys((*_own, "material", "young", "density", "start_twist"), ADD_ANOTHER)

    def __init__(
        self,
        name: str,
        mesh: TetMesh | SurfaceMesh,
        density: float,
        position,
        velocity,
        angular_velocity,
        friction: float,
        restitution: float,
        young: float | None,
    ):
        """The arguments of `Scene.add_rigid_body`."""
        what = f"rigid body {name!r}"
        self.shape = as_surface(mesh)
        self.surface = checked_surface(self.shape, what)
        self._density = checks.number(density, f"{what}: density", above=0.0, unit="kg/m^3")
        volume, self.centre, covariance = volume_moments(self.surface.vertices, self.surface.triangles)
        deviations, axes = np.linalg.eigh(covariance)
        if not deviations[0] > FLAT**2 * deviations[-1]:
            raise SceneError(f"{what}: its surface encloses no volume in one direction: it must have a thickness")
        root = axes @ np.diag(np.sqrt(deviations)) @ axes.T
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a thin body has a thin tet
            frame = TetMesh(self.centre + CORNERS @ root, np.arange(FRAME)[None])
        self.inertia = self._density * volume * (np.trace(covariance) * np.eye(3) - covariance)
        # of the material, over that of the tet: both have the same mass and the same energy of a strain
        self._concentration = volume / float(frame.volumes.sum())
        self.given_young = None if young is None else checks.number(young, f"{what}: young", above=0.0, unit="Pa")
        self._young = self.given_young or self._young_for(LEAST_GRAVITY, 0.0)
        made = self._material("st_venant_kirchhoff", friction, restitution)
        super().__init__(name, frame, made, position, (0.0, 0.0, 0.0), 1, None, "proximity")
        local = np.linalg.solve(root, (self.surface.vertices - self.centre).T).T
        weights = sp.csr_matrix(0.25 * (1.0 + local @ CORNERS.T))
        with thawed(self):
            self.nodes = mesh_nodes.embed(self.nodes, self.surface.vertices, self.surface.triangles, weights)
        given = {"velocity": velocity, "angular_velocity": angular_velocity}
        linear, spin = (checks.vector(value, f"{what}: {key}") for key, value in given.items())
        self._given_twist = Twist(linear, spin)
        self.velocity = self._velocities(linear, spin) if spin.any() else linear
        self._seal(RigidBody.__init__)

    def _label(self) -> str:
        return f"rigid body {self.name!r}"

    def _check_velocity(self, value) -> np.ndarray:
        velocity = super()._check_velocity(value)
        if velocity.ndim == 2 and not np.array_equal(velocity, self._velocities(*self._given_twist)):
            raise SceneError(f"{self._label()}: velocity can only be set to (3,), without spin: else {ADD_ANOTHER}")
        return velocity

    velocity = checks.attribute("velocity", None, "Initial velocity [m/s]: (3,) without spin, else (n,3).")

    def _velocities(self, linear: np.ndarray, angular: np.ndarray) -> np.ndarray:
        return linear + np.cross(angular, self.rest_positions - self.centre)

    def _material(self, law: str, friction: float, restitution: float, damping: float = 0.0) -> Material:
        """Return the material of the tet. damping: of its stiffness [s]."""
        factor = self._concentration
        return Material(law, factor * self._young, 0.0, factor * self._density, friction, restitution, 0.0, damping)

    def _young_for(self, gravity: float, speed: float) -> float:
        """Young's modulus [Pa] with which weight by `gravity` [m/s^2] and impacts at `speed` [m/s] strain the body little."""
        size = float(np.ptp(self.surface.vertices, axis=0).max())
        return self._density * max(gravity * size, speed**2) / STRAIN

    def stiffen(self, gravity: np.ndarray, bodies: list[Body], attached: list[Body]) -> None:
        """Choose the law, the stiffness damping and, unless it was given, young for a scene.

        gravity: (3,) [m/s^2]. bodies: all of the scene, of which each may hit this one; attached: those with nodes attached to
        this one exactly, whose stiffness damping must be its own, since forces on these nodes act on its nodes. It damps no
        rigid motion.
        """
        old, soft = self.composition.first, [body for body in bodies if not isinstance(body, RigidBody)]
        classic = [law for body in soft for law in body.composition.laws if LAWS[law].is_classic]
        law = classic[0] if classic else old.law  # each further law is compiled
        damping = max((body.composition.first.stiffness_damping for body in attached), default=0.0)
        with thawed(self):
            if self.given_young is None:
                speed = max(float(np.linalg.norm(np.atleast_2d(body.velocity), axis=1).max()) for body in bodies)
                stiffest = max((float(np.max(body.young)) for body in soft), default=0.0)
                needed = self._young_for(max(float(np.linalg.norm(gravity)), LEAST_GRAVITY), speed)
                self._young = max(needed, STIFFER * stiffest)
            made = self._material(law, old.friction, old.restitution, damping)
            self.composition = compose(self._label(), self.mesh, made)

    @property
    def young(self) -> float:
        """Young's modulus [Pa] of the body, as if its volume were elastic; chosen by the Simulator unless it was given."""
        return self._young

    @property
    def lowest_frequency(self) -> float:
        """Lowest angular frequency [rad/s] of a strain of the body: that along its longest axis."""
        arms = self.mesh.vertices - self.centre
        return float(np.sqrt(self._young / self._density / np.linalg.eigvalsh(arms.T @ arms / FRAME)[-1]))

    @property
    def density(self) -> float:
        """Density [kg/m^3]."""
        return self._density

    @property
    def start_twist(self) -> "Twist":
        """Velocity [m/s] and angular velocity [rad/s] at the start."""
        return self._given_twist if self.velocity.ndim == 2 else Twist(self.velocity, np.zeros(3))

    @property
    def selectable(self) -> slice:
        """Rows of its surface's vertices among its nodes."""
        return slice(FRAME, self.n_nodes)

    def pose(self, x: np.ndarray) -> "Pose":
        """Return the pose of the body with nodes at x (n,3) [m], as `sim.pose` does."""
        rest, x = self.mesh.vertices - self.centre, x[:FRAME]
        centre = x.mean(axis=0)
        u, _, vt = np.linalg.svd(_gradient(rest, x - centre))
        return Pose(centre - self.centre - self.position, u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)

    def strain(self, x: np.ndarray) -> float:
        """Return the largest relative change of a length in the body with nodes at x (n,3) [m]."""
        x = x[:FRAME]
        F = _gradient(self.mesh.vertices - self.centre, x - x.mean(axis=0))
        return float(np.abs(np.linalg.svd(F, compute_uv=False) - 1.0).max())

    def twist(self, x: np.ndarray, v: np.ndarray) -> "Twist":
        """Return velocity and angular velocity of the body with nodes at x [m] and velocities v [m/s], (n,3) each: those of the
        rigid motion that has the same momentum and angular momentum."""
        x, v = x[:FRAME], v[:FRAME]
        arms, velocity = x - x.mean(axis=0), v.mean(axis=0)
        inertia = np.einsum("ai,ai->", arms, arms) * np.eye(3) - arms.T @ arms
        return Twist(velocity, np.linalg.solve(inertia, np.cross(arms, v).sum(axis=0)))

    def __repr__(self) -> str:
        return f"RigidBody({self.name!r}, {len(self.surface.vertices)} vertices, {self.mass:.4g} kg)"

    def select_nodes(self, where, what: str, repeats: bool = True) -> np.ndarray:
        """Return the nodes (k,) of chosen vertices of its surface. where: as for `Body.fix`; None: the nodes of its tet."""
        return np.arange(FRAME) if where is None else super().select_nodes(where, what, repeats)

    def distance_outside(self, points: np.ndarray, heights: np.ndarray) -> np.ndarray:
        """Return how far points (p,3) [m] lie outside of the surface at rest, over the body's size (p,)."""
        corners, size = self.surface.vertices[self.surface.triangles], float(np.ptp(self.surface.vertices, axis=0).max())
        outside = np.zeros(len(points))
        for rows in np.array_split(np.arange(len(points)), max(1, len(points) * len(corners) // PAIRS_AT_ONCE)):
            outside[rows] = np.where(are_inside(corners, points[rows]), 0.0, distances(corners, points[rows]) / size)
        return outside

    def fix(self, axes: str = "xyz", rotations: str | None = None) -> Constraint:
        """Fix the body in some directions.

        axes: the directions, such as "y" or "xz", that no point of it moves along; rotations: the axes that it then cannot turn
        about, which are all that would move a point along `axes`; None for just these. Raises SceneError for other rotations.
        """
        what = self._check_open("fix")
        mask = checks.axes(axes, what)
        held = "".join(axis for k, axis in enumerate("xyz") if np.delete(mask, k).any())
        if rotations is not None and (not isinstance(rotations, str) or sorted(rotations) != list(held)):
            raise SceneError(
                f"{what}: with axes {axes!r} the rotations must be {held!r}, not {rotations!r}: a point is held by "
                "scene.attach with a stiffness, and the body then turns about it"
            )
        return self._add_constraint(Constraint(np.arange(FRAME), mask), what)

    def move(self, path: Callable | KeyFrames | None = None, axes: str = "xyz") -> Constraint:
        """Move the body along a prescribed path, or hold it until `Simulator.set_pose` or `set_velocity` moves it.

        path: callable t [s] -> (translation (3,) [m], rotation (3,3) about the centre of mass), or None from the time of release;
        it is called once here, for t = 0. Or `KeyFrames`, whose pivot is in start coordinates, by default the centre of mass.
        None: it stays until a command. axes: the prescribed directions. Raises SceneError if it is fixed or moved already, or the
        path is invalid.
        """
        self._check_open("move")
        if not isinstance(path, KeyFrames) and callable(path):
            path = PosePath(path, self.mesh.vertices - self.centre, f"{self._label()}: the path")
        return super().move(None, path, axes)

    def _compose(self, composition: Composition) -> None:
        if self._sealed:
            raise SceneError(f"{self._label()}: its numbers follow from add_rigid_body: add another one")
        self.composition = composition

    def _refuse(self, *_, **__) -> None:
        raise SceneError(f"{self._label()}: {NO_LOADS}")

    enclosed_volume = embed = _refuse


class Pose(NamedTuple):
    """translation (3,) [m] of a rigid body's centre since the start; rotation (3,3) about the centre."""

    translation: np.ndarray
    rotation: np.ndarray


class Twist(NamedTuple):
    """velocity (3,) [m/s] of a rigid body's centre; angular_velocity (3,) [rad/s]."""

    velocity: np.ndarray
    angular_velocity: np.ndarray


@dataclass(frozen=True, eq=False)
class PosePath:
    """The path of a pose as one for nodes: t [s] -> displacements (k,3) [m], or None once they are released."""

    path: Callable  #: t [s] -> (translation (3,) [m], rotation (3,3)), or None
    arms: np.ndarray  #: (k,3) [m], nodes at the start relative to the centre
    what: str

    def pose(self, t: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return translation (3,) [m] and rotation (3,3), or None."""
        value = self.path(t)
        return None if value is None else checked_pose(value, t, self.what)

    def __call__(self, t: float) -> np.ndarray | None:
        pose = self.pose(t)
        if pose is None:
            return None
        translation, rotation = pose
        return self.arms @ rotation.T - self.arms + translation


def _gradient(rest: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Deformation gradient (3,3) of the affine map of points rest (4,3) to x (4,3), both relative to their mean."""
    return np.linalg.solve(rest.T @ rest, rest.T @ x).T


def checked_surface(mesh: TetMesh | SurfaceMesh, what: str) -> SurfaceMesh:
    """Return the closed surface of a solid. Raises SceneError."""
    if isinstance(mesh, TetMesh):
        used, triangles = np.unique(mesh.surface, return_inverse=True)
        texture = {"uvs": mesh.surface_uvs, "subsets": mesh.surface_subsets}
        return SurfaceMesh(mesh.vertices[used], triangles.reshape(-1, 3), **texture)
    if not isinstance(mesh, SurfaceMesh):
        raise SceneError(f"{what}: mesh must be a TetMesh or a SurfaceMesh, not {type(mesh).__name__}")
    faults = mesh.faults()
    if faults:
        raise SceneError(f"{what}: its surface does not bound a solid: {faults[0]}")
    return mesh
