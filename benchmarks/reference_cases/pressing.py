"""Bodies pressed on each other and on rigid surfaces, in static load steps: forces, pressures, sticking zones.

The references come from closed forms, an axisymmetric and a plane code with normals at the end of the step, and mortar contact of
an independent code on the same tets. All bodies touch at the start. Meshes are graded towards the contact by sinh.
"""

from functools import partial

import numpy as np

import taisoft as ts
from taisoft.scene.body import Body
from taisoft.static import StaticResult

from .record import Case, Check, material, near, small
from .spheres import hold_planes

GRADING = 3.0
CONVERGED = 6304.0  # [N] force of `two_bodies` on ever finer meshes, of four of which the extrapolations agree to 0.2 %
DOWN, ALONG, LATE = 5, 60, 20  # load steps of ironing: pressing, sliding, and the last ones, which are averaged
AWAY = 1.0 - 1e-9


def graded(n: int) -> np.ndarray:
    """n + 1 numbers from 0 to 1, closest at 0."""
    return np.sinh(GRADING * np.linspace(0.0, 1.0, n + 1)) / np.sinh(GRADING)


def grid(*axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n,3) of the grid of these coordinates, and its tets, six a cell around the diagonal along which all grow."""
    cells = [len(axis) - 1 for axis in axes]
    tets = ts.box_mesh(cells, (1.0, 1.0, 1.0), pattern="six").tets
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), tets


def mirrored(tets: np.ndarray) -> np.ndarray:
    """The tets with the other orientation."""
    return tets[:, [0, 1, 3, 2]]


def quarter_ball(n: int) -> ts.TetMesh:
    """A quarter of half a ball of radius 1, x, z >= 0, pole down at the origin: n cells along x and z, 3n/4 along y."""
    p, tets = grid(graded(n), 1.0 - graded(3 * n // 4)[::-1], graded(n))
    X, D, Z = (p**2).T  # D grows from the equator, 0, to the pole
    x = p[:, 0] * np.sqrt(1 - D / 2 - Z / 2 + D * Z / 3)
    y = p[:, 1] * np.sqrt(1 - X / 2 - Z / 2 + X * Z / 3)
    z = p[:, 2] * np.sqrt(1 - X / 2 - D / 2 + X * D / 3)
    return ts.TetMesh(np.stack([x, 1.0 - y, z], axis=1), mirrored(tets))


def half_ball(n: int, up: bool = True) -> ts.TetMesh:
    """Half of half a ball, z >= 0: `quarter_ball` and its mirror image in x; or with the pole up at the origin."""
    quarter = quarter_ball(n)
    x = np.concatenate([quarter.vertices, quarter.vertices * (-1.0, 1.0, 1.0)])
    tets = np.concatenate([quarter.tets, mirrored(quarter.tets) + len(quarter.vertices)])
    _, first, number = np.unique(np.round(x, 9) + 0.0, axis=0, return_index=True, return_inverse=True)
    x, tets = x[first], number.reshape(-1)[tets]
    return ts.TetMesh(x, tets) if up else ts.TetMesh(x * (1.0, -1.0, 1.0), mirrored(tets))


def quarter_block(n: int, layers: int) -> ts.TetMesh:
    """A quarter of a block, x and z from 0 to 1, y from -1 to 0."""
    p, tets = grid(graded(n), graded(layers), graded(n))
    return ts.TetMesh(p * (1.0, -1.0, 1.0), mirrored(tets))


def reach(load: np.ndarray, r: np.ndarray) -> float:
    """Radius [m] within which Hertz's pressure has the moment of the loads (n,) at radii (n,)."""
    return float(np.sqrt(2.5 * (load * r**2).sum() / load.sum()))


def solved(made: ts.Scene, arch: str, unconverged: int = 0, **settings) -> tuple[StaticResult, Check]:
    """The static result, and the check that no more load steps did not converge than given."""
    found = ts.solve_static(made, arch=arch, **settings)
    bad, n = sum(not report.converged for report in found.step_reports), len(found.step_reports)
    iterations = np.median([report.newton_iterations for report in found.step_reports])
    what = f"unconverged load steps of {n}; Newton iterations in the median: {iterations:g}"
    return found, Check(what, bad, 0.0, bad, unconverged)


# --- a ball on a rigid plane ------------------------------------------------------------------------------------------


def nominal_pressure(ball: Body, found: StaticResult, reach: float) -> np.poly1d:
    """The square of the pressure over the area at rest [Pa^2], fitted within 0.8 of its reach [m] by a quadratic function of r^2.

    Hertz's is a linear one.
    """
    p, corners = found.contact_pressure("ball", by="triangle"), ball.rest_positions[ball.nodes.surface]
    rest = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    r2 = (corners.mean(axis=1)[:, [0, 2]] ** 2).sum(axis=1)
    on = (p.pressure > 0.0) & (r2 < (0.8 * reach) ** 2)
    return np.poly1d(np.polyfit(r2[on], (p.pressure * p.area / rest)[on] ** 2, 2, w=np.sqrt(rest[on])))


def ball_rough(n: int, order: int, mu: float, limits: dict, reference: dict, arch: str):
    """Half a ball whose equator comes down, in one load step: force, reach, profile of the pressure, radial friction."""
    value, made = reference["value"]["SNH"][f"mu{mu:g}"], ts.Scene(gravity=(0, 0, 0))
    curve = ts.Sphere((0, 1, 0), 1.0) if order == 2 else None
    ball = made.add_body(quarter_ball(n), material(reference, "SNH"), name="ball", order=order, curve=curve)
    hold_planes(ball, "xz")
    ball.move(lambda X: X[:, 1] > AWAY, lambda t: (0.0, -0.02 * t, 0.0), axes="y")
    made.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="plane")
    made.set_contact("ball", "plane", friction=mu)
    found, check = solved(made, arch)
    yield check
    force = 4.0 * found.contact_force("ball", "plane")
    yield near("force [N]", force[1], value["F"], limits.get("F"))
    p = found.contact_pressure("ball")
    X = ball.rest_positions[p.index]
    r, load = np.hypot(X[:, 0], X[:, 2]), p.force[:, 1]
    if mu == 0.0:
        yield near("reach of the pressure [m]", reach(load, r), value["a"], limits.get("a"))
        profile = {float(at): p0 for at, p0 in value["p"].items() if float(at) < 0.1}
        peak = max(profile.values())
        square = nominal_pressure(ball, found, value["a"])
        misses = [p0 - np.sqrt(square(at**2)) for at, p0 in profile.items()]
        yield small(
            "pressure at radii, rms over the largest", np.sqrt(np.mean(np.square(misses))) / peak, limits.get("p", np.inf)
        )
        return
    outward = (p.force[:, [0, 2]] * X[:, [0, 2]]).sum(axis=1) / np.maximum(r, 1e-12)
    yield near("radial friction [N]", 4.0 * abs(outward.sum()), value["T"], limits.get("T"))
    sticks = r[p.state == "stick"].max(initial=0.0)
    yield near("radius of the sticking zone [m]", sticks, value["stick"], limits.get("stick"))


# --- bodies on bodies and on planes -------------------------------------------------------------------------------------


def patch(n: int, order: int, limits: dict, reference: dict, arch: str):
    """Two blocks of different meshes, flush on each other under a uniform pressure: it must be uniform in between."""
    made, p = ts.Scene(gravity=(0, 0, 0)), 1e4
    for name, cells, y in (("low", (4 * n, 2 * n, 4 * n), 0.25), ("top", (5 * n, 3 * n, 5 * n), 0.75)):
        mesh = ts.box_mesh(cells, (1.0, 0.5, 1.0), (0.5, y, 0.5))
        body = made.add_body(mesh, material(reference, "SVK"), name=name, order=order)
        hold_planes(body, "xz")
    made.body("low").fix(lambda X: X[:, 1] < 1e-9, axes="y")
    body.add_traction(lambda C: C[:, 1] > AWAY, (0.0, -p, 0.0))
    found, check = solved(made, arch, contact_tolerance=1e-9)
    yield check
    for name in ("low", "top"):
        load = found.contact_pressure(name)
        on = load.pressure > 0.0
        mean = (load.pressure * load.area)[on].sum() / load.area[on].sum()
        rms = np.sqrt(np.mean((load.pressure[on] / mean - 1.0) ** 2))
        yield small(f"{name}: rms of the pressure about its mean", rms, limits["rms"])
    yield near("force [N]", found.contact_force("top", "low")[1], p, 1e-6)


def push_block(cells: tuple[int, int], order: int, limits: dict, reference: dict, arch: str):
    """A block under pressure, pushed by its left face over a rough plane: friction over normal force after each push."""
    value, made = reference["value"], ts.Scene(gravity=(0, 0, 0))
    thickness, mu, pushes = 4.0 / cells[0], 0.4, (0.002, 0.004, 0.006, 0.008, 0.010)
    mesh = ts.box_mesh((*cells, 1), (4.0, 1.0, thickness), (2.0, 0.5, 0.0))
    block = made.add_body(mesh, material(reference, "SNH"), name="block", order=order)
    block.fix(lambda X: np.ones(len(X), dtype=bool), axes="z")
    steps = np.arange(len(pushes) + 2.0)
    block.move(lambda X: X[:, 0] < 1e-9, lambda t: (np.interp(t, steps, (0.0, 0.0, *pushes)), 0.0, 0.0), axes="x")
    block.add_traction(lambda C: C[:, 1] > AWAY, lambda t: (0.0, -1e4 * min(t, 1.0), 0.0))
    made.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="plane")
    made.set_contact("block", "plane", friction=mu)
    found, check = solved(made, arch, time=steps[-1], steps=len(pushes) + 1)
    yield check
    for k, s in enumerate(pushes):
        force = found.contact_force("block", "plane", step=k + 1)
        ratio = f"{s:.3f}" if f"{s:.3f}" in value["T_over_N"] else f"{s:g}"
        yield near(f"T / N after {s:g} m", -force[0] / force[1], value["T_over_N"][ratio], limits.get("T"))
    yield near("normal force [N/m]", force[1] / thickness, value["N"], 1e-5)


def two_bodies(n: int, order: int, limits: dict, reference: dict, arch: str):
    """Half a ball on a block: force and how far the block gives way, of linear tets against the other code's on the same ones."""
    made, value = ts.Scene(gravity=(0, 0, 0)), reference["value"].get(f"n{n}") if order == 1 else {"F": CONVERGED}
    soft, curve = material(reference, "SVK"), ts.Sphere((0, 1, 0), 1.0) if order == 2 else None
    ball = made.add_body(quarter_ball(n), soft, name="ball", order=order, curve=curve)
    block = made.add_body(quarter_block(n + 2, 3 * n // 4), soft, name="block", order=order)
    hold_planes(ball, "xz")
    hold_planes(block, "xz")
    block.fix(lambda X: X[:, 1] < -AWAY, axes="y")
    ball.move(lambda X: X[:, 1] > AWAY, lambda t: (0.0, -0.04 * t, 0.0), axes="y")
    made.set_contact("ball", "block", friction=0.0)
    found, check = solved(made, arch)
    yield check
    yield near("force [N]", 4.0 * found.contact_force("ball", "block")[1], value["F"], limits.get("F"))
    if order == 2:
        return
    down = found.positions("block")[np.abs(block.rest_positions).max(axis=1) < 1e-12, 1][0]
    yield near("how far the block gives way [m]", -down, -value["uy_origin"], limits.get("u"))


def ironing(h: float, order: int, mu: float, limits: dict, reference: dict, arch: str):
    """A cylinder that is pressed into a block and slides along it without turning: steady forces."""
    value, made = reference["value"][f"mu{mu:g}"], ts.Scene(gravity=(0, 0, 0))
    mesh = ts.box_mesh((round(3.8 / h), round(1.0 / h), 1), (3.8, 1.0, h), (0.7, -0.5, 0.0))
    block = made.add_body(mesh, material(reference, "SNH"), name="block", order=order)
    block.fix(lambda X: np.ones(len(X), dtype=bool), axes="z")
    block.fix(lambda X: X[:, 1] < -AWAY, axes="xy")
    path = ts.KeyFrames([0.0, DOWN, DOWN + ALONG], [[0, 0, 0], [0, -0.1, 0], [1.2, -0.1, 0]])
    made.add_obstacle(ts.Capsule((0, 0.5, -1), (0, 0.5, 1), 0.5), name="iron", path=path)
    made.set_contact("block", "iron", friction=mu)
    found, check = solved(made, arch, 2, time=DOWN + ALONG, steps=DOWN + ALONG)  # vertices hang between two states
    yield check
    late = range(DOWN + ALONG - LATE, DOWN + ALONG)
    T, N, _ = np.mean([found.contact_force("block", "iron", step=step) for step in late], axis=0)
    yield near("normal force [N/m]", -N / h, value["N"], limits.get("N"))
    yield near("friction over normal force", -T / N, value["T_over_N"], limits.get("T"), scale=1.0)


NO_LIMITS: dict[str, float] = {}
CASES = (
    *(
        Case("ball_rough", "SNH", f"n = {n}, order {order}, mu {mu:g}", partial(ball_rough, n, order, mu, limits), fine)
        for n, order, mu, limits, fine in (
            (8, 1, 0.0, NO_LIMITS, False),
            (12, 1, 0.0, {"F": 0.05, "a": 0.03}, True),
            (16, 1, 0.0, {"F": 0.03, "a": 0.02}, True),
            (12, 1, 0.5, {"F": 0.05, "stick": 0.05}, True),
            (16, 1, 0.5, {"F": 0.03, "stick": 0.05}, True),
            (6, 2, 0.0, {"F": 0.015}, False),
            (8, 2, 0.0, {"F": 0.008}, True),
            (12, 2, 0.0, {"F": 0.003, "a": 0.015, "p": 0.02}, True),
            (8, 2, 0.5, {"F": 0.01}, True),
            (12, 2, 0.5, {"F": 0.005, "T": 0.015, "stick": 0.05}, True),
        )
    ),
    *(
        Case("contact_patch", "SVK", f"n = {n}, order {order}", partial(patch, n, order, {"rms": 0.02}), fine)
        for n, order, fine in ((1, 1, False), (2, 1, True), (1, 2, True), (2, 2, True))
    ),
    *(
        Case("push_block", "SNH", f"{nx}x{nx // 4}, order {order}", partial(push_block, (nx, nx // 4), order, limits), fine)
        for nx, order, limits, fine in (
            (20, 1, {"T": 0.04}, False),
            (40, 1, {"T": 0.02}, True),
            (20, 2, {"T": 0.015}, True),
            (40, 2, {"T": 0.01}, True),
        )
    ),
    *(
        Case("two_bodies", "SVK", f"n = {n}, order {order}", partial(two_bodies, n, order, {"F": 0.03}), (n, order) != (8, 1))
        for n, order in ((8, 1), (12, 1), (16, 1), (4, 2), (6, 2))
    ),
    *(
        Case("ironing", "SNH", f"h = {h:g}, order {order}, mu {mu:g}", partial(ironing, h, order, mu, {"T": 0.005}), True)
        for h, order, mu in ((0.1, 1, 0.3), (0.05, 1, 0.3), (0.1, 1, 0.0), (0.1, 2, 0.3))
    ),
)
