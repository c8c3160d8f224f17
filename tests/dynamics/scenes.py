"""Small scenes for tests of the core, and the arrays of a scene without a simulator around them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import taichi as ti

import taisoft as ts
from taisoft.backend.arrays import FieldArena
from taisoft.backend.runtime import Runtime
from taisoft.dynamics.dynamics import Dynamics
from taisoft.fem.build import build_model
from taisoft.fem.model import Layout, Model
from taisoft.scene.plan import make_plan
from taisoft.settings import check_settings, plan_of
from tests.backend.lanes import opened
from tests.fem.oracle import Oracle
from tests.fem.oracle_elements import mesh_nodes

SVK, COR, SNH = "st_venant_kirchhoff", "corotational", "stable_neo_hookean"


def rubber(law: str = SNH, **numbers) -> ts.Material:
    """A soft material: 1e5 Pa, waves of about 12 m/s, so that steps of a millisecond are small for meshes of 1 m."""
    return ts.Material(law=law, **{"young": 1e5, "poisson": 0.3, "density": 1000.0, **numbers})


def cube(center=(0.0, 0.0, 0.0), cells=(1, 1, 1), size=(1.0, 0.9, 1.1), pattern="five") -> ts.TetMesh:
    """A box that is no cube, of 5 or 6 tets a cell."""
    return ts.box_mesh(cells, size, center, pattern)


def halved(mesh: ts.TetMesh) -> ts.TetMesh:
    """The mesh with two regions: 3, called "left", of the tets whose centroid has x < 0, and 7."""
    ids = np.where(mesh.vertices[mesh.tets].mean(axis=1)[:, 0] < 0.0, 3, 7)
    return ts.TetMesh(mesh.vertices, mesh.tets, regions=ids, region_names={3: "left"})


def rows_of(sim: ts.Simulator, name: str) -> slice:
    """Rows of a body's nodes among those of all bodies."""
    bodies = sim.scene.bodies
    k = [body.name for body in bodies].index(name)
    first = sum(body.n_nodes for body in bodies[:k])
    return slice(first, first + bodies[k].n_nodes)


@contextmanager
def dynamics(scene: ts.Scene, **settings) -> Iterator[Dynamics]:
    """What a Simulator of these settings would step, without a Simulator."""
    checked = check_settings(scene, **settings)
    plan = plan_of(scene, checked.integrator, checked.self_collision, checked.draggable)
    made = Dynamics(scene.snapshot(), checked, plan)
    try:
        yield made
    finally:
        made.close()


def set_state(made: Dynamics, x: np.ndarray | None = None, v: np.ndarray | None = None) -> None:
    """Set positions [m] or velocities [m/s] of all nodes, as `Simulator.set_state` does."""
    now = made.state.state()
    made.state.set_state(now[0] if x is None else x, now[1] if v is None else v)
    made.state_changed()


def element(order: int, quadrature_degree: int | None = None) -> dict:
    """Arguments of `add_body`; the degree counts for order 2 only."""
    return {"order": order, "quadrature_degree": quadrature_degree if order == 2 else None}


def spin(mesh: ts.TetMesh, order: int) -> np.ndarray:
    """Random velocities (n,3) of a body's nodes [m/s]."""
    return np.random.default_rng(8).standard_normal(mesh_nodes(mesh, order)[0].shape)


def block_scene(ground: bool = False) -> ts.Scene:
    """One cube, far above a ground if there is one."""
    scene = ts.Scene()
    scene.add_body(cube(), rubber(), name="block")
    if ground:
        scene.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)))
    return scene


def mixed_scene(laws=(SNH, SVK, COR, SVK), mass_damping: float = 0.0, order: int | str = 1) -> ts.Scene:
    """Four bodies whose order is not that of the laws, of 10, 5, 6 and 5 tets: none fills its last lanes.

    Each has another material, and is held and loaded in another way; the first and the third are damped. They do not touch.
    order: 1, 2, or "both": 2, 1, 2, 1.
    """
    orders = (2, 1, 2, 1) if order == "both" else (order,) * 4
    scene = ts.Scene(gravity=(0.3, -9.81, 0.7))
    scene.contact_forces = False
    damped, mesh = rubber(laws[0], mass_damping=mass_damping), cube(cells=(2, 1, 1))
    beam = scene.add_body(mesh, damped, name="beam", position=(0.5, 0, 0), **element(orders[0], 2))
    beam.fix(lambda X: X[:, 0] < -0.49)
    beam.add_traction(lambda X: X[:, 0] > 0.49, (300.0, 2000.0, -500.0))
    softer = rubber(laws[1], young=7e4, poisson=0.2)
    block = scene.add_body(cube((3, 0, 0)), softer, name="block", velocity=(0.5, 0, -0.3), **element(orders[1]))
    block.fix([0, 1], axes="x")
    block.fix([1, 2], axes="yz")
    block.add_force([5, 6, 7], (30.0, -10.0, 20.0))
    lighter, mesh = rubber(laws[2], density=800.0, mass_damping=mass_damping), cube((6, 0, 0), pattern="six")
    tower = scene.add_body(mesh, lighter, name="tower", **element(orders[2], 4))
    tower.fix(lambda X: X[:, 1] < -0.44)
    mesh = cube((9, 0, 0))
    flying = {"velocity": spin(mesh, orders[3]), **element(orders[3])}
    scene.add_body(mesh, rubber(laws[3], density=1500.0), name="flyer", **flying)
    return scene


RELEASE = 0.0095  # [s] when the driven scene's first prescribed nodes are released


def driven_scene(
    law: str = SNH, mass_damping: float = 0.0, stiffness_damping: float = 0.0, order: int | str = 1, connected: bool = False
) -> ts.Scene:
    """A beam that is fixed, moved and loaded in every way there is, and a flyer; vertices 8..11 are the beam's right end.

    Two nodes are moved along x and y until they are released, one along z by a path of its own, and their other axes are
    free. damping: of the beam; the flyer has a third of its mass damping. order: 1, 2, or "both": 2 for the beam.
    connected: with springs and a tendon, within the beam and between the two.
    """
    orders = (2, 1) if order == "both" else (order,) * 2
    scene = ts.Scene(gravity=(0.3, -9.81, 0.7))
    scene.contact_forces = False
    damping = {"mass_damping": mass_damping, "stiffness_damping": stiffness_damping}
    beam = scene.add_body(
        cube(cells=(2, 1, 1)), rubber(law, **damping), name="beam", velocity=(0.4, 0.1, -0.2), **element(orders[0])
    )
    beam.fix([0, 1])
    beam.fix([2, 3], axes="x")
    beam.move([9, 8], lambda t: None if t > RELEASE else (0.05 * np.sin(60 * t), -2 * t, 0.0), axes="xy")
    beam.move([11], lambda t: np.array([[9.0, 9.0, 40 * t**2]]), axes="z")
    beam.add_traction(lambda X: X[:, 1] > 0.44, (300.0, 2000.0, -500.0))
    beam.add_force([4, 6, 10], (30.0, -10.0, 60.0))
    mesh = cube((3, 0, 0))
    flying = {"velocity": spin(mesh, orders[1]), **element(orders[1])}
    scene.add_body(mesh, rubber(law, young=7e4, mass_damping=mass_damping / 3), name="flyer", **flying)
    if connected:
        scene.add_spring(("beam", (0.3, 0.1, -0.2)), ("flyer", (2.7, 0.0, 0.1)), 400.0, rest_length=1.0)
        scene.add_spring(("beam", (-0.3, 0.0, 0.1)), ("beam", (0.4, 0.3, 0.4)), 300.0, rest_length=2.0)
        scene.add_spring(("beam", 5), ("flyer", 2), 50.0, rest_length=0.0)
        scene.add_tendon([("beam", (0.2, 0.2, 0.2)), ("flyer", (2.8, -0.1, 0.0)), ("beam", (0.0, -0.4, 0.1))], 70.0)
    return scene


def connected_scene(order: int = 1, damping: float = 0.0) -> ts.Scene:
    """Two bodies, the second away from the origin and partly inside the first, with connections of every kind.

    There are a compressed and a stretched spring, one between points of one tet, one between bodies at one place, a tendon that
    passes each body twice and two obstacles in sequence, an elastic one along the same points and a slack one, and an attachment
    of each kind. damping: of the springs and attachments [N s/m].
    """
    scene = ts.Scene(gravity=(0, 0, 0))
    scene.contact_forces = False
    scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="a", order=order)
    # its first four nodes lie inside a
    scene.add_body(
        cube(center=(0.7, 0.1, 0.0), size=(0.8, 0.5, 0.6)), rubber(young=6e4), name="b", position=(0.05, 0, 0.1), order=order
    )
    scene.add_obstacle(ts.Sphere((0, 3, 0), 0.2), name="pin")
    scene.add_obstacle(ts.HalfSpace((0, -9, 0), (0, 1, 0)), name="wall")
    scene.add_spring(("a", (-0.4, 0.1, 0.2)), ("b", (0.9, 0.2, -0.1)), 300.0, rest_length=2.0, damping=damping, name="pushes")
    scene.add_spring(("b", (0.6, 0.0, 0.1)), ("a", 3), 500.0, rest_length=0.2, damping=damping, name="pulls")
    scene.add_spring(("a", (0.02, 0.03, 0.01)), ("a", (0.05, -0.02, 0.04)), 200.0, rest_length=0.02, name="within a tet")
    scene.add_spring(("a", (0.45, 0.1, 0.2)), ("b", (0.4, 0.1, 0.1)), 250.0, damping=damping, name="at one place")
    pins = [("pin", (0.1, 2.8, 0.0)), ("wall", (0.0, -9.0, 1.0))]
    line = [("b", (0.7, 0.3, 0.1)), ("a", 1), *pins, ("a", (0.3, -0.3, -0.4)), ("b", 6)]
    scene.attach("a", [0, 2], "pin", 150.0, damping, name="to an obstacle")
    scene.add_tendon(line, 40.0, name="line")
    scene.add_tendon(line, length=16.0, stiffness=30.0, name="elastic")
    scene.add_tendon(line[-2:], length=3.0, stiffness=1e3, name="slack")
    scene.attach("b", [0, 1, 2, 3], "a", 120.0, damping, name="to a body")
    return scene


@dataclass
class Rig:
    """A scene's arrays, and its oracle. parallel: the model whose loops run on several threads. machine: the runtime."""

    scene: ts.Scene
    machine: Runtime
    arena: FieldArena
    model: Model
    parallel: Model
    layout: Layout
    oracle: Oracle

    def vectors(self, name: str, data=None):
        """A field of 3-vectors at the nodes."""
        return self.arena.vectors(name, self.model.real, self.model.n_nodes, data)

    @property
    def eps(self) -> float:
        """Rounding of everything but positions."""
        return self.machine.eps


def use_threads(monkeypatch, several: bool = True) -> list[bool]:
    """Divide loops over any mesh into chunks, and run them on several threads, or on one. Return the answers given."""
    answers: list[bool] = []
    monkeypatch.setattr("taisoft.fem.build.CHUNKED_FROM", 0)
    monkeypatch.setattr("taisoft.fem.chunks.MIN_SHIFT", 2)
    monkeypatch.setattr("taisoft.dynamics.stage_system.SHARED_FROM", 0)
    monkeypatch.setattr("taisoft.backend.parallel.pays", lambda seconds: answers.append(several) or several)
    return answers


@contextmanager
def built(scene: ts.Scene, precision: str, chunks: int = 7, arch: str = "cpu") -> Iterator[Rig]:
    """The arrays of a scene; the parallel model adds its sums up in `chunks` parts."""
    with opened(precision, arch) as machine:
        arena = FieldArena()
        try:
            on = make_plan(scene, explicit=False, multistep=False).on
            model, layout = build_model(scene, machine, arena, on)
            partial = arena.field("partial_parallel", ti.f64, (chunks, model.state.partial.shape[1]))
            parallel = replace(model, serial=False, chunks=chunks, state=replace(model.state, partial=partial))
            yield Rig(scene, machine, arena, model, parallel, layout, Oracle(scene))
        finally:
            arena.release()
