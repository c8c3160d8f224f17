"""Robots coupled to soft bodies: order of the coupling's error, robots from packages, cost of a step.

taisoft bench robots [--quick] [--out [FILE.json]]

Coupling: a block rests on a plate of twice its mass, or a fifth, on a spring, and both sway. Period and amplitude (of the rise
from the lowest point to the next top) are compared with those of the closed form, and weak coupling with iterated at the same dt.
Packages: robots of `pybullet` and `dm-control`, where these are installed, move bit by bit as in MuJoCo alone while they touch
nothing; then a soft ball falls on one of their links. Cost: steps of the demo robot_gripper, and the part of MuJoCo and exchange.
Exit status: 0, or 1 if a limit is not met.
"""

import copy
import importlib.util
import sys
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from statistics import median

import numpy as np

import taisoft as ts
from taisoft.cli.scene_file import load_scene
from taisoft.machine import summarise

from .document import Limit, begin, exponent, table, timed_cells
from .runner import REST, Stopwatch, clock, progress, quick_options, warm_up, without_warnings

STIFFNESS, BLOCK, G = 400.0, 1.0, 9.81  # of the spring [N/m], mass of the block [kg]
HEAVY, LIGHT = 2.0, 0.2  # plates [kg]
ERRORS = tuple(product(("weak", "iterated"), ("period", "amplitude")))
DT, ITERATIONS = (0.008, 0.004, 0.002, 0.001), 30
PLATE = """<mujoco><option timestep="0.001"/><worldbody><body name="plate">
<joint name="lift" type="slide" axis="0 0 1" stiffness="{stiffness}"/><geom type="box" size=".2 .2 .02" mass="{mass}"/>
</body></worldbody></mujoco>"""
PACKAGES = {  # name -> package, file in it, whether it needs servos, link that a ball falls on
    "KUKA iiwa (URDF)": ("pybullet_data", "kuka_iiwa/model.urdf", True),
    "Franka Panda (URDF)": ("pybullet_data", "franka_panda/panda.urdf", True),
    "Kinova Jaco (MJCF)": ("dm_control", "third_party/kinova/jaco_arm.xml", False),
}
FREE_STEPS, BALL_STEPS, BALL = 20, 40, 0.05  # radius of the ball [m]


# --- coupling -----------------------------------------------------------------------------------------------------------


def sway(mass: float, dt: float, iterations: int, seconds: float) -> tuple[np.ndarray, int]:
    """Heights of the plate after each step [m], and how many steps did not agree."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "plate.xml"
        file.write_text(PLATE.format(mass=mass, stiffness=STIFFNESS))
        start = -G * (mass + 0.5 * BLOCK) / STIFFNESS  # the block never presses less than half its weight
        robot = ts.Robot.load(file, joints={"lift": start})
    scene = ts.Scene(up="z")
    steel = ts.Material(young=1e7, poisson=0.3, density=BLOCK / 1e-3, friction=0.8)
    scene.add_body(ts.box_mesh((1, 1, 1), (0.1, 0.1, 0.1)), steel, position=(0.0, 0.0, start + 0.07 + 1e-5))
    scene.add_robot(robot, iterations=iterations, friction=0.8)
    with ts.Simulator(scene, dt=dt, precision="f64") as sim:
        rows = [(sim.step().converged, sim.robot.joint["lift"]) for _ in range(round(seconds / dt))]
    return np.array([height for _, height in rows]), sum(not converged for converged, _ in rows)


def period_and_amplitude(heights: np.ndarray, dt: float, mass: float) -> tuple[float, float]:
    """Time between the first two falls through the middle [s], and half the way from the lowest to the next highest point [m]."""
    level = heights + G * (mass + BLOCK) / STIFFNESS
    falls = [k for k in range(1, len(level)) if level[k - 1] >= 0.0 > level[k]]
    times = [dt * (k + level[k - 1] / (level[k - 1] - level[k])) for k in falls]  # level[k] is at (k + 1) dt
    low = int(np.argmin(level[: falls[1]])) if len(falls) > 1 else 0
    return (times[1] - times[0], 0.5 * (level[low : falls[1]].max() - level[low])) if len(falls) > 1 else (np.nan, np.nan)


def coupling_row(mass: float, dt: float) -> dict:
    """Errors of both ways to couple at one dt, relative to the closed form."""
    period = 2.0 * np.pi * np.sqrt((mass + BLOCK) / STIFFNESS)
    exact, row, found = (period, 0.5 * G * BLOCK / STIFFNESS), {"mass": mass, "dt": dt}, []
    for name, iterations in (("weak", 1), ("iterated", ITERATIONS)):
        heights, failed = sway(mass, dt, iterations, 2.2 * period)
        found.append(heights)
        errors = [abs(a / b - 1.0) for a, b in zip(period_and_amplitude(heights, dt, mass), exact)]
        row[name] = {"period": errors[0], "amplitude": errors[1], "failed": failed}
    row["apart"] = float(np.abs(found[0] - found[1]).max() / exact[1])
    return row


def coupling_table(rows: list[dict]) -> str:
    """A row per plate and dt."""

    def cell(name: str, what: str):
        return lambda row: "unstable" if not row[name][what] < 1.0 else f"{row[name][what]:.2e}"

    columns = (
        ("plate [kg]", "{[mass]:g}"),
        ("dt [ms]", lambda row: f"{1e3 * row['dt']:g}"),
        *((f"{name}: error of the {what}", cell(name, what)) for name, what in ERRORS),
        ("between the two", lambda row: "-" if not row["apart"] < 1.0 else f"{row['apart']:.2e}"),
        ("steps that did not agree", lambda row: str(row["iterated"]["failed"])),
    )
    return table(rows, columns)


def orders(rows: list[dict]) -> dict[str, float]:
    """Exponents of dt of the errors with the heavy plate."""
    heavy = [row for row in rows if row["mass"] == HEAVY]
    dt = [row["dt"] for row in heavy]
    found = {f"{name}, {what}": exponent(dt, [row[name][what] for row in heavy])[0] for name, what in ERRORS}
    return found | {"between the two": exponent(dt, [row["apart"] for row in heavy])[0]}


# --- robots from packages -----------------------------------------------------------------------------------------------


def installed() -> Iterator[tuple[str, Path, bool]]:
    """Name, file and need of servos of each robot whose package is installed."""
    for name, (package, file, servo) in PACKAGES.items():
        if (spec := importlib.util.find_spec(package)) is not None and spec.submodule_search_locations:
            path = Path(spec.submodule_search_locations[0]) / file
            if path.is_file():
                yield name, path, servo


def free_and_hit(name: str, path: Path, servo: bool) -> dict:
    """Whether a robot moves as in MuJoCo alone, and how far wrenches are from the sums over contacts, relative to these."""
    import mujoco

    robot = ts.Robot.load(path, servo=(2000.0, 100.0) if servo else None)
    model = copy.copy(robot.model)
    data = robot.make_data(model)
    scene = ts.Scene(up="z")
    shapes = scene.add_robot(robot, friction=0.5).shapes
    surfaces = [(one, one.shape.surface()) for one in scene.obstacles]
    points = np.concatenate([one.points_at(0.0, surface[0]) for one, surface in surfaces if surface is not None])
    soft = ts.Material(young=1e5, poisson=0.3, density=500.0, friction=0.5)
    place = points[np.argmax(points[:, 2])] + (0.0, 0.0, BALL + 0.5 * G * (FREE_STEPS * 0.01) ** 2)
    scene.add_body(ts.ball_mesh(BALL, 4), soft, name="ball", position=place)
    with ts.Simulator(scene, dt=0.01) as sim:
        model.opt.timestep = 0.01 / np.ceil(0.01 / robot.model.opt.timestep - 1e-9)
        n, same, worst, free, pressed, seconds = round(0.01 / model.opt.timestep), True, 0.0, 0, 0, []
        for _ in range(FREE_STEPS + BALL_STEPS):
            start = clock()
            report = sim.step()
            seconds.append(clock() - start)
            contacts = sim.contacts()
            if not pressed and not contacts.impulse.any():
                mujoco.mj_step(model, data, n)
                same, free = same and np.array_equal(data.qpos, sim.robot.data.qpos), free + 1
            pressed += bool(contacts.impulse.any())
            if report.substeps > 1:  # contacts are those of the last of them
                continue
            for link in robot.links:
                own = [name for name, geom in shapes.items() if model.geom_bodyid[geom] == 1 + robot.links.index(link)]
                summed = -contacts.impulse[np.isin(contacts.body_b, own)].sum(axis=0) / sim.dt
                if (size := np.abs(summed).max(initial=0.0)) > 1e-3:  # [N]
                    worst = max(worst, float(np.abs(sim.robot.link_wrench(link).force - summed).max() / size))
    triangles = sum(len(one.shape.triangles) for one in scene.obstacles if isinstance(one.shape, ts.MeshObstacle))
    row = {"robot": name, "shapes": len(shapes), "triangles": triangles, "same": same, "free": free, "pressed": pressed}
    return row | {"worst": worst, "step": median(seconds)}


def package_table(rows: list[dict]) -> str:
    """A row per robot."""
    columns = (
        ("<robot", "{[robot]}"),
        ("shapes", "{[shapes]}"),
        ("triangles", "{[triangles]:,}"),
        ("free: as in MuJoCo alone", lambda row: "bit by bit" if row["same"] else "NO"),
        ("steps with contact", "{[pressed]}"),
        ("wrench off the sum over contacts", "{[worst]:.1e}"),
        ("step [ms]", lambda row: f"{1e3 * row['step']:.3g}"),
    )
    return table(rows, columns)


# --- cost ---------------------------------------------------------------------------------------------------------------


def gripper_cost(steps: int) -> dict[str, list[float]]:
    """Times of steps of the demo, and of what is not the bodies' in them [s]."""
    scene, solver = load_scene("robot_gripper")
    watch = Stopwatch()
    with ts.Simulator(scene, **{key: value for key, value in solver.items() if key not in ("seconds", "fps")}) as sim:
        warm_up(sim, 20)
        with watch.on([("bodies", sim._dynamics, "advance")]):
            parts = [watch.parts_of(sim.step) for _ in range(steps)]
    return {"step": [sum(one.values()) for one in parts], "of it MuJoCo and exchange": [one[REST] for one in parts]}


def cost_table(cost: dict[str, list[float]]) -> str:
    """Steps and exchange."""
    columns = (
        ("<", "{[0]}"),
        ("median [ms]", lambda row: timed_cells(row[1])[0]),
        ("spread", lambda row: timed_cells(row[1])[1]),
    )
    return table(cost.items(), columns)


def limits_of(found: dict[str, float], rows: list[dict], robots: list[dict]) -> list[Limit]:
    """Orders, agreement, bits and sums."""
    limits = [Limit("weak coupling: order of its difference to the iterated one", found["between the two"], 0.8, at_least=True)]
    limits += [Limit(f"order of the error: {name}", p, 0.8, at_least=True) for name, p in found.items() if "weak" in name]
    limits.append(Limit("iterated steps that did not agree", sum(row["iterated"]["failed"] for row in rows), 0))
    for row in robots:
        free = row["free"] if row["same"] else 0
        limits.append(Limit(f"{row['robot']}: wrench off the sum over contacts", row["worst"], 1e-6))
        limits.append(Limit(f"{row['robot']}: free steps as in MuJoCo alone", free, FREE_STEPS // 2, at_least=True))
        limits.append(Limit(f"{row['robot']}: steps with contact", row["pressed"], 1, at_least=True))
    return limits


def main(argv=None) -> int:
    """Measure and print. Raises OutputError if a file cannot be written, SceneError without MuJoCo."""
    options = quick_options("robots", __doc__, argv, "two dt, no robots from packages, no limits")
    document, numbers = begin("Robots", "arch cpu", packages=("taichi", "numpy", "mujoco-core", "pybullet", "dm-control"))
    rows, robots = [], []
    for mass in (HEAVY,) if options.quick else (HEAVY, LIGHT):
        for dt in DT[:2] if options.quick else DT:
            progress(f"coupling: {mass:g} kg, {1e3 * dt:g} ms")
            rows.append(coupling_row(mass, dt))
    found = orders(rows)
    document.add("## Coupling\n\n" + coupling_table(rows))
    document.add("Orders in dt with the heavy plate: " + ", ".join(f"{name} {p:.2f}" for name, p in found.items()) + ".")
    with without_warnings():  # of meshes that bound no solid
        for name, path, servo in () if options.quick else installed():
            progress(name)
            robots.append(free_and_hit(name, path, servo))
    if robots:
        document.add("## Robots from packages\n\n" + package_table(robots))
    cost = gripper_cost(20 if options.quick else 250)
    document.add("## Cost of a step of robot_gripper\n\n" + cost_table(cost))
    numbers |= {"coupling": rows, "orders": found, "robots": robots, "cost": {k: summarise(v) for k, v in cost.items()}}
    return document.finish(options, numbers, [] if options.quick else limits_of(found, rows, robots))


if __name__ == "__main__":
    sys.exit(main())
