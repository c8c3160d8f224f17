"""Contact: friction on slopes, stacks, impacts, momentum, and a ball pressed on a plane.

Blocks are unit cubes of 2 x 2 x 2 cells. Sliding blocks have stiffness damping: a soft block that vibrates loses contact in
places and slides further than a rigid one. Contacts keep a contact offset; bodies that start on a plane first move up to it, by
about a millimetre.
"""

from dataclasses import replace
from functools import partial

import numpy as np

import taisoft as ts
from taisoft.fem.reference import lumped_masses
from taisoft.mesh.quality import mean_surface_edge

from .record import GRAVITY, Case, material, near, reported, rotation, small, submesh, worst

EXPLICIT, IMPLICIT = "symplectic_euler", "implicit_euler"
STEP = {EXPLICIT: 1e-3, IMPLICIT: 1e-2}  # [s] of blocks of 1e7 Pa
CONTACT_OFFSET = 2e-3  # of the mean surface edge
STICKS = 10.0  # friction of blocks that must not move
STILL, SLIP, STRAIGHT = 1e-5, 5e-3, 1e-4  # limits: [m], of a distance, sideways over distance
UP = (0.0, 1.0, 0.0)


def cube(cells: int = 2) -> ts.TetMesh:
    """A unit cube whose mesh is its own mirror image."""
    return ts.box_mesh((cells,) * 3, (1.0, 1.0, 1.0))


def standing(reference: dict) -> ts.Scene:
    """A unit cube on the plane y = 0; slopes are made by turning gravity."""
    s = ts.Scene(gravity=(0.0, -GRAVITY, 0.0))
    firm = replace(material(reference, "COR"), stiffness_damping=1e-3)
    s.add_body(cube(), firm, name="block", position=(0.0, 0.5, 0.0))
    add_plane(s, friction=0.5, restitution=0.0)
    return s


def add_plane(s: ts.Scene, **contact) -> None:
    """The plane y = 0, "plane". contact: numbers of its contact with the scene's first body, if not the default ones."""
    s.add_obstacle(ts.HalfSpace((0, 0, 0), UP), name="plane")
    if contact:
        s.set_contact(s.bodies[0].name, "plane", **contact)


def settled(sim: ts.Simulator, friction: float, angle: float = 0.0, held: bool = False) -> np.ndarray:
    """Let the block settle on a slope [rad], with more friction if `held`. Returns its positions (n,3) [m]."""
    sim.reset()
    sim.set_gravity((GRAVITY * np.sin(angle), -GRAVITY * np.cos(angle), 0.0))
    sim.set_contact("block", "plane", friction=STICKS if held else friction)
    sim.run(1.0, fps=None)
    sim.set_contact("block", "plane", friction=friction)
    return sim.positions()


# --- friction -----------------------------------------------------------------------------------------------------


def incline(integrator: str, reference: dict, arch: str):
    """A block on three slopes: it stays, or is accelerated straight down."""
    mu, dt = reference["value"]["mu"], STEP[integrator]
    with ts.Simulator(standing(reference), dt=dt, integrator=integrator, precision="f64", arch=arch) as sim:
        for case in reference["value"]["cases"]:
            what, slips = f"{case['alpha_deg']:g} degrees", case["state"] == "slip"
            start = settled(sim, mu, np.radians(case["alpha_deg"]), held=slips)
            reports = sim.run(0.5, fps=None).step_reports  # a released block shakes at first
            before = sim.velocities().mean(axis=0)
            reports += sim.run(0.5, fps=None).step_reports
            displacement = (sim.positions() - start).mean(axis=0)
            if slips:
                gain = (sim.velocities().mean(axis=0) - before) / 0.5
                yield near(f"{what}: acceleration [m/s^2]", gain[0], case["acceleration"], SLIP)
                yield small(f"{what}: sideways, over slip", displacement[2] / displacement[0], STRAIGHT)
            else:
                yield small(f"{what}: slip in 1 s [m]", np.linalg.norm(displacement[[0, 2]]), STILL)
            yield small(f"{what}: penetration [m]", max(report.max_penetration for report in reports), 1e-4)


def slide(integrator: str, reference: dict, arch: str):
    """A block that slides until friction stops it."""
    dt, value = STEP[integrator], reference["value"]
    along = np.array([np.cos(np.pi / 6), 0.0, np.sin(np.pi / 6)])
    with ts.Simulator(standing(reference), dt=dt, integrator=integrator, precision="f64", arch=arch) as sim:
        start = settled(sim, 0.4)
        sim.set_state(velocities=np.tile(3.0 * along, (len(start), 1)))
        begin, path, slow = sim.time, [], 0.0
        while sim.time < begin + 1.0:
            sim.step()
            path.append((sim.positions() - start).mean(axis=0))
            if sim.velocities().mean(axis=0) @ along > 0.1:
                slow = sim.time - begin
    path = np.array(path)
    yield near("stopping distance [m]", path[-1] @ along, value["symplectic_euler"][f"{dt:g}"], SLIP)
    yield near("time until 0.1 m/s [s]", slow, value["time"] * (1.0 - 0.1 / 3.0), 0.02)
    yield small("sideways, over distance", np.abs(path @ np.cross(along, UP)).max() / value["distance"], STRAIGHT)


def stack(reference: dict, arch: str):
    """Five cubes on each other at rest: the force at each interface.

    A column so high buckles under its own weight, and so does one of bonded cubes (Greenhill: 4.05 m for this material), at
    a rate of about 1/s. From a symmetric start it stays upright for the first seconds, in which damping brings it to rest.
    """
    s = ts.Scene(gravity=(0.0, -GRAVITY, 0.0))
    n = len(reference["value"])
    soft = replace(material(reference, "SNH"), mass_damping=10.0, friction=0.5)
    for k in range(n):
        s.add_body(cube(), soft, name=f"cube {k}", position=(0.0, 0.5 + 1.002 * k, 0.0))
    s.add_obstacle(ts.HalfSpace((0, 0, 0), UP), name="plane", friction=0.5)
    with ts.Simulator(s, dt=1 / 60, precision="f64", arch=arch) as sim:
        start = np.array([sim.positions(f"cube {k}").mean(axis=0) for k in range(n)])
        for _ in range(150):
            report = sim.step()
        c = sim.contacts()
        drift = np.array([sim.positions(f"cube {k}").mean(axis=0) for k in range(n)]) - start
        names = ["plane"] + [f"cube {k}" for k in range(n)]
        for k, expected in enumerate(reference["value"]):
            up = (c.body_a == names[k + 1]) & (c.body_b == names[k])
            down = (c.body_a == names[k]) & (c.body_b == names[k + 1])
            force = (c.impulse[up].sum(axis=0) - c.impulse[down].sum(axis=0)) / sim.dt
            yield near(f"force at interface {k + 1} [N]", force[1], expected, 1e-3)
    yield small("penetration [m]", report.max_penetration, 1e-3)
    yield small("drift in 2.5 s [m]", np.abs(drift[:, [0, 2]]).max(), 1e-3)


# --- impacts --------------------------------------------------------------------------------------------------------


def newton(integrator: str, reference: dict, arch: str):
    """A cube that falls flat on a plane: velocity of its base after the step in which it hits.

    Without restitution the base still moves to its contact offset: up to 0.0035 m/s here.
    """
    s = ts.Scene(gravity=(0.0, 0.0, 0.0))
    s.add_body(cube(), material(reference, "COR"), name="cube", position=(0, 0.501, 0), velocity=(0, -2.0, 0))
    add_plane(s)
    dt = {EXPLICIT: 2e-4, IMPLICIT: 1e-3}[integrator]
    with ts.Simulator(s, dt=dt, integrator=integrator, precision="f64", arch=arch) as sim:
        low = np.flatnonzero(sim.scene.body("cube").rest_positions[:, 1] < -0.49)
        for text, expected in reference["value"].items():
            sim.reset()
            sim.set_contact("cube", "plane", friction=0.0, restitution=float(text))
            while sim.contact_force("cube")[1] == 0.0 and sim.time < 0.005:
                sim.step()
            v = sim.velocities("cube")[low, 1]
            limit = 2e-3 if expected == 0.0 else 1e-6
            what = f"e = {text}: velocity of the base after the impact [m/s]"
            yield worst([near("", value, expected, limit, scale=2.0) for value in (v.min(), v.max())], what)


def bar(integrator: str, law: str, reference: dict, arch: str):
    """A bar that hits a wall end-on: mean force, duration and rebound."""
    value, dt = reference["value"], 2e-4
    mesh = ts.box_mesh((2, 20, 2), (0.1, 1.0, 0.1))
    s = ts.Scene(gravity=(0.0, 0.0, 0.0))
    position = (0, 0.5 + CONTACT_OFFSET * mean_surface_edge([(mesh.vertices, mesh.surface)]), 0)
    body = s.add_body(mesh, material(reference, law), name="bar", position=position, velocity=(0, -0.1, 0))
    add_plane(s, friction=0.0, restitution=0.0)
    with ts.Simulator(s, dt=dt, integrator=integrator, precision="f64", arch=arch) as sim:
        forces = []
        for _ in range(round(0.09 / dt)):
            sim.step()
            forces.append(-sim.contact_force("plane")[1])
        forces = np.array(forces)
        loaded = np.flatnonzero(forces > 0.05 * value["force"])
        v = sim.velocities("bar")
        mass = 0.1 * 0.1 * 1.0 * body.material.density
    impulse = forces.sum() * dt
    duration = (loaded[-1] + 1) * dt
    yield near("impulse [N s]", impulse, value["impulse"], 0.05)
    yield near("duration [s]", duration, value["duration"], 0.05)
    yield near("mean force [N]", impulse / duration, value["force"], 0.05)
    yield near("rebound velocity [m/s]", impulse / mass - 0.1, value["rebound_velocity"], 0.1)
    yield reported("vibration after the impact, over the speed", np.abs(v[:, 1] - v[:, 1].mean()).max() / 0.1)


def momentum(integrator: str, reference: dict, arch: str):
    """Two cubes that collide in free space: conservation of momentum."""
    s = ts.Scene(gravity=(0.0, 0.0, 0.0))
    soft = replace(material(reference, "SNH"), friction=0.4)
    s.add_body(cube(), soft, name="left", position=(-0.6, 0, 0), velocity=(1.0, 0, 0))
    other = ts.TetMesh(cube().vertices @ rotation((1.0, 1.0, 0.0), np.pi / 6).T, cube().tets)
    s.add_body(other, soft, name="right", position=(0.6, 0.1, 0.05), velocity=(-0.5, 0.2, 0))
    dt = {EXPLICIT: 1e-3, IMPLICIT: 1e-2}[integrator]
    tight = {} if integrator == EXPLICIT else {"newton_tolerance": 1e-10}
    with ts.Simulator(s, dt=dt, integrator=integrator, precision="f64", arch=arch, **tight) as sim:
        mass = lumped_masses(s)[:, None]

        def momenta():
            x, v = sim.positions(), sim.velocities()
            return (mass * v).sum(axis=0), np.cross(x, mass * v).sum(axis=0)

        first, hit = momenta(), 0.0
        for _ in range(round(0.6 / dt)):
            sim.step()
            hit = max(hit, np.linalg.norm(sim.contact_force("left")))
        last = momenta()
    total = reference["value"]["P_total"]
    size = np.linalg.norm(total)
    exact = integrator == EXPLICIT
    yield near("largest force of the hit is above 0 [N]", float(hit > 100.0), 1.0, 0.0)
    yield small("momentum before, over its value", np.linalg.norm(first[0] - total) / size, 1e-12)
    yield small("change of momentum, relative", np.linalg.norm(last[0] - first[0]) / size, 1e-11 if exact else 1e-7)
    turned = np.linalg.norm(last[1] - first[1]) / size
    # implicit Euler itself loses the angular momentum of what turns; explicit steps lose what the gap has for a lever
    what = "change of angular momentum, over P m"
    yield small(what, turned, 1e-3) if exact else reported(what, turned)


# --- a ball on a plane ------------------------------------------------------------------------------------------------


def hertz(cells: int, limit: float | None, reference: dict, arch: str):
    """Force against how far the equator has come down. Steps of 1 s are a thousand times the ball's own period: statics."""
    radius = reference["geometry"]["ball_radius"]
    whole = ts.ball_mesh(radius, cells)
    mesh = submesh(whole, whole.vertices[whole.tets].mean(axis=1)[:, 1] < 0.0)
    rows = [row for row in reference["value"]["SNH"] if row["d_over_R"] > 0.015]
    displacement = [0.0] + [row["d"] for row in rows]
    s = ts.Scene(gravity=(0.0, 0.0, 0.0))
    height = radius + CONTACT_OFFSET * mean_surface_edge([(mesh.vertices, mesh.surface)])
    ball = s.add_body(mesh, material(reference, "SNH"), name="ball", position=(0.0, height, 0.0))
    middle = np.flatnonzero(np.abs(mesh.vertices).max(axis=1) < 1e-9)
    flat = np.flatnonzero(np.abs(mesh.vertices[:, 1]) < 1e-9)
    ball.move(flat, lambda t: (0.0, -float(np.interp(t, np.arange(len(displacement)), displacement)), 0.0), axes="y")
    ball.fix(middle, axes="xz")
    add_plane(s, friction=0.0, restitution=0.0)
    with ts.Simulator(s, dt=0.5, precision="f64", arch=arch, newton_tolerance=1e-8) as sim:
        for row in rows:
            for _ in range(2):
                sim.step()
            c = sim.contacts()
            bears = np.linalg.norm(c.impulse, axis=1) > 0.0
            reach = np.linalg.norm(c.point[bears][:, [0, 2]], axis=1).max(initial=0.0)
            yield near(f"d = {row['d']:g} m: force [N]", -sim.contact_force("plane")[1], row["F"], limit)
            yield reported(f"d = {row['d']:g} m: radius of the nodes that bear", reach / row["a"] - 1.0)


BOTH = (IMPLICIT, EXPLICIT)
CASES = (
    *(Case("incline_stick_slip", "COR", f"2x2x2 {name}", partial(incline, name), fine=name == EXPLICIT) for name in BOTH),
    *(Case("slide_to_stop", "COR", f"2x2x2 {name}", partial(slide, name), fine=name == IMPLICIT) for name in BOTH),
    Case("stack_rest", "SNH", "2x2x2", stack),
    *(Case("newton_impact", "COR", f"2x2x2 {name}", partial(newton, name), fine=name == EXPLICIT) for name in BOTH),
    *(Case("bar_impact", "COR", f"2x20x2 {name}", partial(bar, name, "COR"), fine=name == EXPLICIT) for name in BOTH),
    *(Case("soft_soft_momentum", "SNH", f"2x2x2 {name}", partial(momentum, name), fine=name == IMPLICIT) for name in BOTH),
    Case("hertz_ball", "SNH", "half ball, 12 cells across", partial(hertz, 12, 0.1)),
    Case("hertz_ball", "SNH", "half ball, 20 cells across", partial(hertz, 20, 0.1), fine=True),
)
