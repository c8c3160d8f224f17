"""The contact patch test, and a pressure that varies: blocks of different meshes, pressed on each other.

Blocks of 1 x 0.5 x 1 m along an axis, with planes of symmetry, under a dead pressure on the last one's top. A uniform pressure
must leave uniform stresses; both blocks spread alike, so friction has nothing to do. One of 1 + 0.9 cos(pi x) cos(pi z) is
compared with matching quadratic meshes: root mean square of the difference in the axial stress over tets beside the interface.
"""

from functools import partial

import numpy as np
from scipy.optimize import fsolve

import taisoft as ts
from taisoft.mesh.quality import mean_surface_edge

from .record import LAWS, Case, label, reported, small

LAW, YOUNG, POISSON, PRESSURE, HEIGHT, STEPS = LAWS["SVK"], 1e6, 0.3, 1e4, 0.5, 2
STRESS, DISPLACEMENT, NODAL = 1e-5, 1e-5, 1e-4  # limits: of the pressure; of the loaded face's displacement; of the pressure
BODY, MESH, RIGID = "body", "mesh obstacle", "rigid body"  # what the first block is
FINE = (8, 4, 8)  # cells of the quadratic reference
SAMPLES = 40  # points of a tet at which it is evaluated


def stretches() -> np.ndarray:
    """Lateral and axial stretch under a uniform pressure."""

    def residual(s):
        stress = ts.evaluate_law(LAW, np.diag([s[0], s[1], s[0]])[None], young=YOUNG, poisson=POISSON)[1][0]
        return stress[1, 1] / PRESSURE + 1.0, stress[0, 0] / PRESSURE

    return fsolve(residual, [1 + POISSON * PRESSURE / YOUNG, 1 - PRESSURE / YOUNG], xtol=1e-13)


def block(cells, k: int, axis: int, moved: bool) -> ts.TetMesh:
    """Block k of a stack along an axis; moved: inner points at random, those of faces within these."""
    mesh = ts.box_mesh(cells, (1, HEIGHT, 1), (0.5, (k + 0.5) * HEIGHT, 0.5))
    x, inside = mesh.vertices.copy(), []
    for q, (low, high) in enumerate(((0, 1), (k * HEIGHT, (k + 1) * HEIGHT), (0, 1))):
        inside.append((x[:, q] > low + 1e-9) & (x[:, q] < high - 1e-9))
    if moved:
        x += np.random.default_rng(k).uniform(-0.2, 0.2, x.shape) / cells * [1, HEIGHT, 1] * np.transpose(inside)
    return ts.TetMesh(np.roll(x, axis - 1, axis=1), mesh.tets)


def stack(
    cells, order: int, friction: float = 0.0, axis: int = 1, moved: bool = False, base: str = BODY
) -> tuple[ts.Scene, float]:
    """A stack of blocks at the contact offset from each other, without its load, and that offset [m]."""
    meshes = [block(np.array(c), k, axis, moved) for k, c in enumerate(cells)]
    soft = meshes if base == BODY else meshes[1:]
    offset = 2e-3 * min(mean_surface_edge([(mesh.vertices, mesh.surface)]) for mesh in soft) / order
    scene = ts.Scene(gravity=(0, 0, 0))
    material = ts.Material(LAW, young=YOUNG, poisson=POISSON, density=1e-3, friction=friction)
    for k, mesh in enumerate(meshes):
        is_base, name = k == 0 and base != BODY, f"block {k}"
        if is_base:  # wider than what spreads on it
            mesh = ts.TetMesh(mesh.vertices * [1.5, 1, 1.5] - [0.25, 0, 0.25], mesh.tets)
        if is_base and base == MESH:
            scene.add_obstacle(ts.MeshObstacle(mesh.vertices, mesh.surface), name=name, friction=friction)
        elif is_base:
            scene.add_rigid_body(mesh, name=name, friction=friction).move(lambda t: (np.zeros(3), np.eye(3)))
        else:
            body = scene.add_body(mesh, material, name=name, order=order, position=np.roll([0, k * offset, 0], axis - 1))
            for q in range(3) if k == 0 else {0, 1, 2} - {axis}:
                body.fix(lambda X, q=q: X[:, q] < 1e-9, axes="xyz"[q])
    return scene, offset


def uniform(cells, options: dict, reference: dict, arch: str):
    """The patch test."""
    scene, offset = stack(cells, **options)
    axis, base, (lateral, axial) = options.get("axis", 1), options.get("base", BODY), stretches()
    bottom, top = HEIGHT if base != BODY else 0.0, len(cells) * HEIGHT
    load = np.roll([0, -PRESSURE, 0], axis - 1)
    scene.bodies[-1].add_traction(lambda C: C[:, axis] > top - 1e-9, lambda t: min(1.0, t / STEPS) * load)
    with ts.Simulator(scene, dt=1.0, precision="f64", arch=arch, contact_tolerance=1e-9) as sim:
        failed = sum(not sim.step().converged for _ in range(STEPS + 1))
        yield small("steps that did not converge", failed, 0.0)
        stress_error = displacement_error = 0.0
        for body in scene.bodies[base == RIGID :]:
            k = int(body.name[-1])
            stress = np.roll(sim.stress(body.name), (1 - axis, 1 - axis), axis=(1, 2))
            stress[:, 1, 1] += PRESSURE / lateral**2
            stress_error = max(stress_error, np.abs(stress).max())
            expected = np.roll(body.rest_positions, 1 - axis, axis=1) * [lateral, axial, lateral]
            expected[:, 1] += bottom + k * offset - axial * bottom
            displacement_error = max(
                displacement_error, np.abs(np.roll(sim.positions(body.name), 1 - axis, axis=1) - expected).max()
            )
        yield small("greatest error of stress, over the pressure", stress_error / PRESSURE, STRESS)
        moved = (1 - axial) * (top - bottom)
        yield small("of displacement, over that of the loaded face", displacement_error / moved, DISPLACEMENT)
        c = sim.contacts()
        nodal = c.pressure[c.kind == "mortar"] * lateral**2 / PRESSURE
        yield small("of the pressures at nodes, over the pressure", np.abs(nodal - 1.0).max(), NODAL)


def consistent_forces(body) -> np.ndarray:
    """Forces (n_nodes,3) [N] of the varying pressure on the top of the last block."""
    points, weights = np.polynomial.legendre.leggauss(6)
    u, v = np.meshgrid(*[(points + 1) / 2] * 2, indexing="ij")
    bary = np.stack([1 - u, u * (1 - v), u * v], axis=-1).reshape(-1, 3)
    weights = (np.outer(weights, weights) / 4 * 2 * u).reshape(-1)
    shapes, x, force = bary, body.rest_positions, np.zeros((body.n_nodes, 3))
    rows = body.nodes.surface
    if body.order == 2:
        a, b, c = bary.T
        shapes = np.stack([a * (2 * a - 1), b * (2 * b - 1), c * (2 * c - 1), 4 * a * b, 4 * b * c, 4 * c * a], axis=1)
        rows = np.hstack([np.stack([rows[k::4, k] for k in range(3)], axis=1), rows[3::4]])
    for nodes in rows[(x[rows[:, :3]][:, :, 1] > 2 * HEIGHT - 1e-9).all(axis=1)]:
        corners = x[nodes[:3]]
        area, at = 0.5 * np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])), bary @ corners
        pressure = PRESSURE * (1 + 0.9 * np.cos(np.pi * at[:, 0]) * np.cos(np.pi * at[:, 2]))
        np.add.at(force[:, 1], nodes, -area * (weights * pressure) @ shapes)
    return force


def varying_stress(cells, order: int, arch: str) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Vertices, tets and axial stresses of both blocks under the varying pressure."""
    scene, _ = stack(cells, order)
    force = consistent_forces(scene.bodies[-1])
    loaded = np.flatnonzero(force.any(axis=1))
    scene.bodies[-1].add_force(loaded, lambda t: min(1.0, t / STEPS) * force[loaded])
    with ts.Simulator(scene, dt=1.0, precision="f64", arch=arch) as sim:
        for _ in range(STEPS + 1):
            sim.step()
        return [(body.rest_positions, body.mesh.tets, sim.stress(body.name)[:, 1, 1]) for body in scene.bodies]


def varying(cells, order: int, reference: dict, arch: str):
    """A pressure that varies, against the reference's mean over each tet."""
    bary, error, size = np.random.default_rng(0).dirichlet((1,) * 4, SAMPLES), 0.0, 0.0
    for own, fine in zip(varying_stress(cells, order, arch), varying_stress((FINE, FINE), 2, arch)):
        x, tets, stress = own
        beside = tets[(np.abs(x[tets][:, :, 1] - HEIGHT) < 1e-9).any(axis=1)]
        stress = stress[(np.abs(x[tets][:, :, 1] - HEIGHT) < 1e-9).any(axis=1)]
        corners = fine[0][fine[1]]
        inverse = np.linalg.inv((corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1))
        for tet, sigma in zip(x[beside], stress):
            local = np.einsum("eij,pej->pei", inverse, (bary @ tet)[:, None] - corners[:, 0])
            within = np.minimum(local.min(axis=2), 1.0 - local.sum(axis=2)).argmax(axis=1)
            exact, volume = fine[2][within].mean(), abs(np.linalg.det(tet[1:] - tet[0]))
            error, size = error + volume * (sigma - exact) ** 2, size + volume * exact**2
    yield reported("error of the stress beside the interface, root mean square", np.sqrt(error / size))


PATCHES = (
    ([(4, 2, 4), (5, 3, 5)], {"order": 1, "friction": 0.2}, False),
    ([(3, 2, 3), (4, 2, 2)], {"order": 1, "axis": 0, "moved": True}, False),
    ([(2, 1, 2), (3, 2, 3)], {"order": 2, "axis": 2, "friction": 0.2}, False),
    ([(3, 1, 3), (4, 2, 4), (2, 1, 3)], {"order": 1}, False),
    ([(3, 2, 2), (4, 2, 4)], {"order": 1, "base": MESH}, False),
    ([(3, 2, 2), (4, 2, 4)], {"order": 2, "base": RIGID}, False),
    ([(8, 4, 8), (10, 6, 10)], {"order": 1}, True),
    ([(8, 4, 8), (10, 6, 10)], {"order": 1, "friction": 0.2, "moved": True}, True),
    ([(4, 2, 4), (5, 3, 5)], {"order": 2, "friction": 0.2}, True),
)


def name_of(cells, options: dict) -> str:
    """What tells a case apart."""
    return " on ".join(label(c) for c in cells[::-1]) + "".join(
        f", {key}" if value is True else f", {key} {value}" for key, value in options.items()
    )


CASES = (
    *(Case("contact_patch", "SVK", name_of(c, o), partial(uniform, c, o), fine, closed_form=True) for c, o, fine in PATCHES),
    *(
        Case("pressure_varies", "SVK", name_of(cells, {"order": order}), partial(varying, cells, order), True, closed_form=True)
        for cells in ([(4, 2, 4), (5, 3, 5)], [(8, 4, 8), (10, 6, 10)])
        for order in (1, 2)
    ),
)
