"""`taisoft warm`: compiles the kernels of common scenes in advance, so that later runs find them in the disk cache.

Kernels depend on the fields of `Structure`, not on meshes or numbers, so a cube of 40 tets suffices for a body. The table
contains every demo's structure, which `tests/cli/test_cli_warm.py` checks.
"""

import contextlib
import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import numpy as np

import taisoft as ts
from taisoft import compile_message
from taisoft.backend.runtime import n_compiled
from taisoft.dynamics.schemes import EXPLICIT
from taisoft.errors import SimulationError
from taisoft.mesh.shapes import box_mesh, sheet_mesh
from taisoft.mesh.surface_mesh import SurfaceMesh
from taisoft.scene.key_frames import KeyFrames
from taisoft.scene.material import LAWS
from taisoft.scene.obstacles import Box, HalfSpace, MeshObstacle
from taisoft.scene.scene import Material, Scene
from taisoft.view.offscreen import Offscreen

IMPLICIT = ("implicit_euler", "bdf2")  # the common ones
STATIC = ""  # in place of an integrator
SIZE, UPPER = 0.1, 0.06  # [m] of the lowest cube and of the others
SPEED = 2.0  # [m/s] of falling bodies: fast enough that collisions retry steps
STEPS = {True: (1e-5, 200), False: (1e-2, 10)}  # explicit integrator: (dt [s], number of steps)
LONG_DT = 1.0  # [s]
STRONG_GRAVITY = (0.0, -500.0, 0.0)  # [m/s^2]
SQUEEZE = np.array([0.3, 1.0, 1.0])  # factor of positions
RANDOM_SPEED = 0.5  # of nodes, in smallest extents of the scene per step


def warm(arguments: Namespace) -> int:
    """Compile, print one line per structure, and return 0. By default simulations use f32, double structures and statics f64."""
    start, before = time.perf_counter(), n_compiled()
    with compile_message.silenced():
        for structure in dict.fromkeys(structures()):  # some laws and integrators have structures in common
            precision = arguments.precision or ("f64" if structure.double else "f32")
            _report(str(structure), simulate, structure, precision)
        for structure in static_structures():
            precision = arguments.precision or "f64"
            _report(f"statics in {precision}, {structure}", solve, structure, precision)
        _report("pictures", draw, Structure("implicit_euler", obstacles=PLANE), arguments.precision or "f32")
    print(f"{n_compiled() - before} kernels in {time.perf_counter() - start:.0f} s")
    return 0


def _report(title: str, compile_for: Callable, structure: "Structure", precision: str) -> None:
    start, before = time.perf_counter(), n_compiled()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # these scenes are not the user's
        compile_for(structure, precision)
    print(f"{title:<90} {n_compiled() - before:3d} kernels {time.perf_counter() - start:6.1f} s", flush=True)


def simulate(structure: "Structure", precision: str) -> None:
    """Take a few steps, and compute what a run with --out writes."""
    implicit = structure.integrator not in EXPLICIT
    dt, count = STEPS[not implicit]
    settings = {"integrator": structure.integrator, "self_collision": structure.self_collision, "precision": precision}
    with ts.Simulator(build(structure), dt=dt, **settings) as sim:
        while sim.step_count < count:
            sim.advance(count - sim.step_count)
        if implicit:
            sim._dynamics.stepper.compile_hard_steps()
            if not sim.touches:
                sim.dt = LONG_DT  # so long that stiffness dominates inertia
                sim.set_state(SQUEEZE * sim.positions())  # needs projected stiffness and a line search
                sim.step()
            x = sim.positions()
            size = RANDOM_SPEED * float(np.ptp(x, axis=0).min()) / sim.dt
            sim.set_state(velocities=size * np.random.default_rng(0).standard_normal(x.shape))
            with contextlib.suppress(SimulationError):  # a step that fails has compiled its kernels all the same
                sim.step()
        sim.energies()
        sim.stress()


def solve(structure: "Structure", precision: str) -> None:
    """Solve for the static state under a load large enough to need the line search."""
    scene = build(structure)
    scene.gravity = STRONG_GRAVITY
    ts.solve_static(scene, precision=precision)


def draw(structure: "Structure", precision: str) -> None:
    """Draw a picture with a shadow; its kernels depend on nothing but the precision."""
    scene = build(structure)
    with ts.Simulator(scene, dt=STEPS[False][0], integrator=structure.integrator, precision=precision) as sim:
        Offscreen(scene, (64, 36)).image(sim)


@dataclass(frozen=True)
class Structure:
    """Features that kernels are compiled for. obstacles: "half-space", "box" or "mesh"; orders: element order of each body.

    fixed, prescribed: some nodes are fixed, or follow a path; loaded: forces on nodes; pressed: a surface is under pressure;
    tied: a tendon pulls; attached: the second body to the first, exactly; rigid: the first body; skinned: the last body has a
    skin that is touched; by_tet: elasticity by tet; thin: tets so flat that strains are computed in f64; fine: a surface of more
    than 1,500 triangles, searched by parallel loops; double: a simulation in f64 unless --precision is given; self_collision:
    bodies touch themselves.
    """

    integrator: str
    law: str = "stable_neo_hookean"
    orders: tuple[int, ...] = (1,)
    obstacles: tuple[str, ...] = ()
    fixed: bool = False
    prescribed: bool = False
    loaded: bool = False
    pressed: bool = False
    tied: bool = False
    attached: bool = False
    rigid: bool = False
    skinned: bool = False
    by_tet: bool = False
    mean_dilatation: bool = False
    mass_damping: bool = False
    stiffness_damping: bool = False
    thin: bool = False
    fine: bool = False
    double: bool = False
    self_collision: bool = False
    contacts: bool = True  # whether contact forces are modelled

    def __str__(self) -> str:
        words = [name.replace("_", " ") for name in (self.law, self.integrator) if name]
        words += [f"orders {' '.join(map(str, self.orders))}"] if 2 in self.orders else []
        words += [f"{len(self.orders)} bodies"] if len(self.orders) > 1 else []
        words += self.obstacles
        on = [f.name for f in fields(self) if f.default is False and getattr(self, f.name)]
        return ", ".join(words + [name.replace("_", " ") for name in on])


PLANE, PLANE_AND_BOX, BOX, PAIR = ("half-space",), ("half-space", "box"), ("box",), (1, 1)


def structures() -> Iterator[Structure]:
    """Yield the table: first the features common to all laws, then those of the default law."""
    for law in LAWS:
        for integrator in (*EXPLICIT, *IMPLICIT):
            yield Structure(integrator, law, fixed=True)
        yield Structure("implicit_euler", law, fixed=True, mass_damping=True)
        yield Structure("implicit_euler", law, obstacles=PLANE)
        yield Structure("implicit_euler", law, orders=PAIR, fixed=True)
        yield Structure("symplectic_euler", law, obstacles=PLANE)
    for integrator in EXPLICIT:
        yield Structure(integrator)
        yield Structure(integrator, fixed=True, mass_damping=True)
        yield Structure(integrator, fixed=True, loaded=True)
        yield Structure(integrator, fixed=True, prescribed=True)
        yield Structure(integrator, obstacles=PLANE)
        yield Structure(integrator, orders=PAIR, fixed=True)
    for integrator in IMPLICIT:
        for damped in (False, True):
            yield Structure(integrator, fixed=True, mass_damping=damped)
            yield Structure(integrator, fixed=True, loaded=True, mass_damping=damped)
            yield Structure(integrator, fixed=True, prescribed=True, mass_damping=damped)
            yield Structure(integrator, obstacles=PLANE, mass_damping=damped)
            yield Structure(integrator, obstacles=PLANE_AND_BOX, mass_damping=damped)
            yield Structure(integrator, orders=PAIR, fixed=True, mass_damping=damped)
            yield Structure(integrator, orders=PAIR, obstacles=PLANE, mass_damping=damped)
            yield Structure(integrator, obstacles=BOX, mass_damping=damped)
        yield Structure(integrator, obstacles=("mesh",))
        yield Structure(integrator, fixed=True, prescribed=True, stiffness_damping=True)
        yield Structure(integrator, orders=(2,), fixed=True)
        yield Structure(integrator, orders=(2,), fixed=True, mass_damping=True)
        yield Structure(integrator, orders=(2,), fixed=True, thin=True, mass_damping=True)
        yield Structure(integrator, orders=(1, 2), fixed=True, mass_damping=True, contacts=False)
        yield Structure(integrator, orders=PAIR, fixed=True, thin=True, mass_damping=True)
    for integrator in ("symplectic_euler", "implicit_euler"):
        yield Structure(integrator, fixed=True, by_tet=True)
    yield Structure("implicit_euler", orders=(2,), fixed=True, loaded=True, by_tet=True, mass_damping=True)
    yield Structure("implicit_euler", fixed=True, pressed=True)
    yield Structure("implicit_euler", fixed=True, mean_dilatation=True)
    finger = {"orders": (2,), "fixed": True, "pressed": True, "by_tet": True}
    gripper = {"orders": (1, 2, 1), "rigid": True, "obstacles": PLANE, "prescribed": True, "tied": True, "attached": True}
    for features in (finger, gripper):
        yield Structure("implicit_euler", **features, mass_damping=True, double=True)
    for integrator in ("implicit_euler", "symplectic_euler"):
        yield Structure(integrator, rigid=True, law=LAWS[0], obstacles=PLANE)
    yield Structure("implicit_euler", orders=PAIR, rigid=True, obstacles=PLANE)
    foot = {"orders": PAIR, "rigid": True, "obstacles": PLANE, "prescribed": True, "loaded": True, "attached": True}
    yield Structure("implicit_euler", **foot, mass_damping=True)
    seesaw = {"orders": (1, 2), "obstacles": PLANE, "rigid": True, "skinned": True, "fine": True}
    yield Structure("implicit_euler", **seesaw, stiffness_damping=True)
    yield Structure("implicit_euler", LAWS[1], obstacles=BOX)
    yield Structure("implicit_euler", orders=(2,), obstacles=PLANE, fixed=True, mass_damping=True, self_collision=True)
    yield Structure("velocity_verlet", orders=PAIR)
    yield Structure("implicit_euler", obstacles=PLANE, fine=True)
    yield Structure("implicit_euler", obstacles=PLANE_AND_BOX, fine=True)
    yield Structure("implicit_euler", obstacles=BOX, thin=True, fine=True, mass_damping=True)


def static_structures() -> Iterator[Structure]:
    """Yield the structures for `solve_static`, which has no integrator and no contacts."""
    for law in LAWS:
        yield Structure(STATIC, law, fixed=True)
    yield Structure(STATIC, fixed=True, loaded=True)
    yield Structure(STATIC, fixed=True, prescribed=True)
    yield Structure(STATIC, orders=(2,), fixed=True)


def build(structure: Structure) -> Scene:
    """Build stacked cubes (the lowest may be a sheet) that fall on what is below; the lowest has the conditions and loads."""
    scene = Scene()
    scene.contact_forces = structure.contacts
    damping = {"mass_damping": float(structure.mass_damping), "stiffness_damping": 1e-3 * structure.stiffness_damping}
    poisson = 0.499 if structure.mean_dilatation else 0.3  # near incompressibility linear systems are solved in another way
    soft = Material(law=structure.law, young=1e5, poisson=poisson, density=1000.0, friction=0.5, **damping)
    mesh, gap = box_mesh((2, 2, 2), (SIZE, SIZE, SIZE)), 0.001 * SIZE
    bottom = gap
    if structure.thin or structure.fine:
        cells = 20 if structure.fine else 2
        mesh = sheet_mesh((cells, cells), (SIZE * cells, SIZE / 50 if structure.thin else SIZE, SIZE * cells))
    for k, order in enumerate(structure.orders):
        height = float(np.ptp(mesh.vertices[:, 1]))
        position, speed = (0.0, bottom + 0.5 * height, 0.0), SPEED if k > 0 or not structure.fixed else 0.0
        given = {"order": order, "dilatation": "mean" if structure.mean_dilatation else "local", "velocity": (0.0, -speed, 0.0)}
        if structure.rigid and k == 0:
            scene.add_rigid_body(mesh, name="body 0", position=position, velocity=given["velocity"])
        else:
            scene.add_body(mesh, soft, name=f"body {k}", position=position, **given)
        mesh, bottom = box_mesh((2, 2, 2), (UPPER, UPPER, UPPER)), bottom + height
        bottom += 0.0 if structure.attached and k == 0 else gap  # attached nodes lie in triangles: most depend on 6 nodes
    if structure.by_tet:
        scene.bodies[0].young = np.full(scene.bodies[0].mesh.n_tets, soft.young)
    if structure.skinned:
        inner = box_mesh((1, 1, 1), (0.9 * UPPER, 0.85 * UPPER, 0.8 * UPPER))  # whose vertices lie in no face of a tet
        scene.bodies[-1].embed(SurfaceMesh(inner.vertices, inner.surface), contact=True)
    _add_conditions(scene.bodies[0], structure)
    _add_connections(scene, structure)
    for name in structure.obstacles:
        scene.add_obstacle(_obstacle(name), name=name, friction=0.5)
    return scene


def _add_conditions(body, structure: Structure) -> None:
    """Fix, prescribe and load nodes on the body's sides, or a whole rigid body."""
    if structure.rigid:
        if structure.prescribed:
            body.move(KeyFrames([0.0, 1.0], [(0.0, 0.0, 0.0), (0.1 * SIZE, 0.0, 0.0)], release=True))
        if structure.loaded:
            body.add_force(None, (0.0, -1.0, 0.0))
        return
    side = float(np.abs(body.rest_positions[:, 0]).max()) - 1e-6
    if structure.fixed:
        body.fix(lambda X: X[:, 0] < -side)
    if structure.prescribed:
        body.move(lambda X: X[:, 0] > side, KeyFrames([0.0, 1.0], [(0.0, 0.0, 0.0), (0.1 * SIZE, 0.0, 0.0)], release=True))
    if structure.loaded:
        body.add_force(lambda X: X[:, 0] > side, (0.0, 1.0, 0.0))
    if structure.pressed:
        body.add_pressure(lambda c: c[:, 0] > side, KeyFrames([0.0, 1.0], values=(100.0, 1000.0)))


def _add_connections(scene: Scene, structure: Structure) -> None:
    """Attach the second body to the first, and lead a tendon up through the last of these."""
    name = scene.bodies[int(structure.attached)].name
    if structure.attached:
        low = scene.body(name).rest_positions[:, 1].min() + 1e-9
        scene.attach(name, lambda X: X[:, 1] < low, scene.bodies[0].name)
    if structure.tied:
        path = KeyFrames([0.0, 1.0], values=(0.0, 1.0))
        scene.add_tendon([(name, (0.0, height * SIZE, 0.0)) for height in (-0.2, 0.0, 0.2)], path)


def _obstacle(name: str):
    if name == "half-space":
        return HalfSpace((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    half = 0.2 * SIZE
    if name == "box":
        return Box((0.0, -half, 0.0), (half, half, half))
    cube = box_mesh((1, 1, 1), (2 * half, 2 * half, 2 * half), center=(0.0, -half, 0.0))
    return MeshObstacle(cube.vertices, cube.surface)
