"""Degenerate geometry: slivers in a mesh, obstacles thinner than a triangle."""

import re

import numpy as np

import taisoft as ts
from taisoft.cli.meshes import describe

from ..reference_cases.record import face, nearest
from .case import (
    EXPLICIT,
    IMPLICIT,
    MEASURED,
    OK,
    OLD_NORMALS,
    PROPOSED,
    REFUSED,
    Case,
    Must,
    Session,
    explicit,
    implicit,
    refusal,
)
from .shapes import COR, DOWN, SNH, box, not_finite, one_body

NAMED = "volume of the tet that the load report names as worst, over s times the mean"
LIMITS = {1.0: 2.22e-3, 1e-2: 2.68e-4, 1e-4: 2.67e-5}  # [s] for 1000 kg/m^3, by power iteration
DENSITY = 100.0  # [kg/m^3]
LENGTH = 0.5  # [m]


def sliver_mesh(s: float) -> ts.TetMesh:
    """A bar whose least volume of a tet is about s times the mean. Making it warns of its worst tets."""
    good = box((10, 2, 2), (LENGTH, 0.1, 0.1), (0.25, 0.05, 0.05))
    x = good.vertices.copy()
    x[nearest(x, (0.25, 0.05, 0.05))[0], 2] = 0.05 * (2.0 - s)
    return ts.TetMesh(x, good.tets)


def sliver_scene(law: str, s: float) -> ts.Scene:
    """The bar, clamped, under a tenth of gravity."""
    soft = {"law": law, "young": 1e5, "poisson": 0.4, "density": DENSITY, "mass_damping": 2.0}
    scene, bar = one_body("bar", sliver_mesh(s), (0.0, -0.981, 0.0), **soft)
    bar.fix(face(0, 0.0))
    return scene


def tip_path(session: Session, law: str, s: float, follow: bool = True) -> np.ndarray:
    """(k,3) [m] of the middle of the free end."""
    scene = sliver_scene(law, s)
    tip = face(0, LENGTH)(scene.bodies[0].rest_positions)
    with session.simulator(scene) as sim:
        return np.array(session.watch(sim, 200, lambda: sim.positions()[tip].mean(axis=0), follow=follow)[0])


def slivers(session: Session, law: str, s: float) -> dict[str, float]:
    """G1: the bar with slivers beside that without."""
    mesh = sliver_mesh(s)
    worst = int(re.search(r"\(tet (\d+)\)", dict(describe(mesh))["quality"])[1])
    numbers = {NAMED: mesh.volumes[worst] / (s * mesh.volumes.mean())}
    if session.variant.settings["integrator"] == EXPLICIT and s < 1.0:
        limit = LIMITS[s] * np.sqrt(DENSITY / 1000.0)
        message = refusal(lambda: session.simulator(sliver_scene(law, s)))
        if message:
            session.refuse(message)
        with session.simulator(sliver_scene(law, s), dt=0.5 * limit) as sim:
            estimate = sim.stable_dt
        return numbers | {"refused": "stability limit" in message, "estimated limit, off by": abs(estimate / limit - 1.0)}
    path, good = tip_path(session, law, s), tip_path(session, law, 1.0, follow=False)
    off = np.linalg.norm(path - good, axis=1) / LENGTH if len(path) == len(good) else np.array([np.nan])
    return numbers | {"tip off the bar's without slivers at the end, over L": off[-1], "the same, most": off.max()}


EDGE_HEIGHT, BASE = 0.1, 0.004  # [m] of a knife, whose edge lies at y = 0


def knife(x: float) -> ts.MeshObstacle:
    """A prism with its edge along z, 0.8 m long, at x [m]."""
    section = np.array([(x - 0.5 * BASE, -EDGE_HEIGHT), (x + 0.5 * BASE, -EDGE_HEIGHT), (x, 0.0)])
    vertices = np.array([(*p, z) for z in (-0.4, 0.4) for p in section])
    triangles = [(0, 2, 1), (3, 4, 5), (0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (2, 0, 3), (2, 3, 5)]
    return ts.MeshObstacle(vertices, triangles)


def depth_in_knife(points: np.ndarray, x: float) -> float:
    """How deep the deepest of the points (n,3) [m] lies in the knife at x; 0 where none does."""
    side = np.array([EDGE_HEIGHT, 0.5 * BASE]) / np.hypot(EDGE_HEIGHT, 0.5 * BASE)
    across = side[0] * np.abs(points[:, 0] - x) + side[1] * points[:, 1]  # signed distance from the nearer of both sides
    outside = np.maximum(across, -EDGE_HEIGHT - points[:, 1])
    return max(0.0, -float(outside.min()))


KNIVES = 0.1 * np.arange(-2, 3)  # [m] places of the knives along x


def on_knives() -> ts.Scene:
    """A mat of 0.6 m, 0.02 m above five knives."""
    mesh = box((15, 1, 15), (0.6, 0.02, 0.6))
    scene, _ = one_body("mat", mesh, DOWN, (0, 0.03, 0), law=SNH, young=2e4, poisson=0.4, friction=0.0)
    for k, x in enumerate(KNIVES):
        scene.add_obstacle(knife(x), name=f"knife {k}", friction=0.0)
    scene.add_obstacle(ts.HalfSpace((0, -0.11, 0), (0, 1, 0)), name="plane", friction=0.0)
    return scene


def knives(session: Session) -> dict[str, float]:
    """G2: a mat falls onto five knives."""
    scene = on_knives()
    surface = scene.bodies[0].mesh.surface

    def depth() -> float:
        x = sim.positions()
        points = np.concatenate([x, x[surface].mean(axis=1)])
        return max(depth_in_knife(points, place) for place in KNIVES)

    with session.simulator(scene) as sim:
        cut, deepest = session.watch(sim, 400, lambda: len(sim.intersecting_triangles()), depth)
        lost = not_finite(sim.positions())
    return {
        "deepest of vertices and triangles' middles in a knife [m]": max(deepest),
        "pairs of triangles that cut each other, most": max(cut),
        "numbers that are not finite at the end": lost,
        "inverted tets, most": session.largest("n_inverted"),
        "deepest of the contacts after any step [m]": session.largest("max_penetration"),
    }


SI = 2e-3 / np.sqrt(10.0)
BENDS = Must(OK, "a few flat tets change neither the bar nor how it bends, and an implicit step has a solution for them too")
TOO_LONG = Must(REFUSED, "this dt is 0.9 of the explicit limit without slivers, which these lower by 8 and by 83 times")
G1 = Case("G1", "slivers", slivers, size=LENGTH, quick=(f"s 0.0001, {SNH}, {EXPLICIT}",))
for law in (COR, SNH):
    for s in LIMITS:
        G1.add_variant(f"s {s:g}, {law}, {IMPLICIT}", implicit(0.01), BENDS, law=law, s=s)
    for s in LIMITS:
        must = TOO_LONG if s < 1.0 else BENDS
        G1.add_variant(f"s {s:g}, {law}, {EXPLICIT}", explicit(SI), must, reference=s == 1.0, law=law, s=s)
SLIVERS = {"integrator": EXPLICIT, "s": (1e-2, 1e-4)}
G1.add_limit(NAMED, 1.5, PROPOSED, note="the load report is that of `taisoft info`")
G1.add_limit("tip off the bar's without slivers at the end, over L", 0.02, PROPOSED, integrator=IMPLICIT)
G1.add_limit("refused", 1.0, MEASURED, at_least=True, **SLIVERS)
G1.add_limit("estimated limit, off by", 0.2, MEASURED, **SLIVERS)

HANGS = Must(OK, "the edges of the knives bear the mat, which hangs over them; the catalogue lets thin obstacles be refused")
G2 = Case("G2", "mat on knives", knives, size=0.6)
G2.add_variant(SNH, implicit(0.01), HANGS)
G2.add_limit(
    "deepest of the contacts after any step [m]",
    2e-3,
    PROPOSED,
    note="the catalogue asks for the depth of vertices and middles alone; a point in a knife, which is 4 mm thick, is "
    "never deeper than 2 mm",
)
G2.add_limit("deepest of vertices and triangles' middles in a knife [m]", 2e-3, PROPOSED)
G2.add_limit("numbers that are not finite at the end", 0.0, PROPOSED)
G2.add_shortfall(*OLD_NORMALS)

CASES = (G1, G2)
