"""Follower pressure on surface triangles, on linear and quadratic tets:

* its force is -p times the gradient of the enclosed volume, computed independently; on a closed surface without resultant;
* its matrix is the derivative of the force on a closed surface, the symmetric part on an open one;
* the energy of a closed surface is conserved; that of an open one is not counted (thick spheres: tests/references);
* overlapping pressures add; scene files, refinement, bad input.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError
from taisoft.fem.measure import measure
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.pressure import triangle_nodes
from taisoft.fem.state import LOADS
from taisoft.fem.terms.pressure import gather_pressures
from taisoft.linear import block_csr
from taisoft.scene.refine import refined, with_order
from tests.dynamics.companion import add_companion, simulator
from tests.dynamics.scenes import built, cube, rubber
from tests.scene.toml_scenes import there_and_back

P, TOP = 7e3, -4e3  # [Pa]


def everywhere(centroids: np.ndarray) -> np.ndarray:
    return np.ones(len(centroids), dtype=bool)


def on_top(centroids: np.ndarray) -> np.ndarray:
    return centroids[:, 1] > 0.44


def enclosed(body: ts.Body, triangles: np.ndarray, x: np.ndarray):
    """int x . (x_s cross x_t) / 3 over curved triangles by Gauss points, with the middles of edges as nodes on order 2."""
    t, w = np.polynomial.legendre.leggauss(5)
    s, r = (g.reshape(-1) for g in np.meshgrid(0.5 + 0.5 * t, 0.5 + 0.5 * t))
    a, b, weight = s, (1 - s) * r, np.outer(w, w).reshape(-1) / 4 * (1 - s)
    nodes = triangle_nodes(body, triangles)
    if body.order == 1:
        shape = [np.stack([1 - a - b, a, b]), np.stack([-1 + 0 * a, 1 + 0 * a, 0 * a]), np.stack([-1 + 0 * a, 0 * a, 1 + 0 * a])]
    else:
        c = 1 - a - b
        shape = [
            np.stack([c * (2 * c - 1), a * (2 * a - 1), b * (2 * b - 1), 4 * c * a, 4 * a * b, 4 * b * c]),
            np.stack([1 - 4 * c, 4 * a - 1, 0 * a, 4 * (c - a), 4 * b, -4 * b]),
            np.stack([1 - 4 * c, 0 * a, 4 * b - 1, -4 * a, 4 * a, 4 * (c - b)]),
        ]
    point, along_s, along_t = (np.einsum("nq,knx->kqx", N, x[nodes]) for N in shape)
    return (np.einsum("kqx,kqx->kq", point, np.cross(along_s, along_t)) / 3 * weight).sum()


def gradient(body: ts.Body, triangles: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Of `enclosed`, by complex steps; the force per pressure of a closed surface."""
    slopes = np.zeros_like(x)
    for n in np.ndindex(x.shape):
        shifted = x.astype(complex)
        shifted[n] += 1e-30j
        slopes[n] = enclosed(body, triangles, shifted).imag / 1e-30
    return slopes


@pytest.fixture(params=[1, 2], scope="module")
def rig(request):
    """A body under pressure on its whole surface and once more on its top, beside one of the other order."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(cube((5, 0, 0)), rubber(), name="unloaded", order=request.param)
    body = scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="body", order=request.param)
    body.add_pressure(everywhere, P)
    body.add_pressure(on_top, TOP)
    with built(add_companion(scene, varied=False), "f64") as made:
        rng = np.random.default_rng(4)
        made.x = made.layout.rest + 0.05 * rng.standard_normal(made.layout.rest.shape)
        made.out, made.body = made.vectors("out"), made.scene.bodies[1]
        made.rows, made.matrix = made.layout.nodes(1), block_csr.build_block_csr(made.model, made.arena, "pressed")
        yield made


def set_pressures(model, amplitudes) -> None:
    """Of the body's two pressures; the companion's loads stay."""
    values = model.amplitudes.to_numpy()
    values[:2] = amplitudes
    model.amplitudes.from_numpy(values)


def forces(rig, x: np.ndarray, amplitudes=(P, 0.0), model=None) -> np.ndarray:
    model = model or rig.model
    set_pressures(model, amplitudes)
    model.state.x.from_numpy(x)
    gather_pressures(model, rig.out)
    return rig.out.to_numpy()


def matrix(rig, x: np.ndarray, amplitudes, projected: bool = False) -> np.ndarray:
    """Of the pressures alone, in the second body."""
    parts = []
    rig.model.state.x.from_numpy(x)
    for p in (amplitudes, (0.0, 0.0)):
        set_pressures(rig.model, p)
        rig.matrix.value.fill(0.0)  # without elasticity
        rig.matrix.diagonal.fill(0.0)
        block_csr.to_system(rig.model, rig.matrix, rig.matrix, EVERYTHING, int(projected), 0.0, 0.5)
        parts.append(block_csr.to_scipy(rig.model, rig.matrix).toarray())
    own = slice(3 * rig.rows.start, 3 * rig.rows.stop)
    K = 4.0 * (parts[0] - parts[1])
    assert not np.delete(K, np.arange(own.start, own.stop), axis=0).any()
    return K[own, own]


def derivative(rig, x: np.ndarray, amplitudes) -> np.ndarray:
    """-df/dx of the second body; f is quadratic in x, so that differences are exact but for rounding."""
    n, h = 3 * (rig.rows.stop - rig.rows.start), 1e-3
    K = np.zeros((n, n))
    for k in range(n):
        step = np.zeros(x.size)
        step[3 * rig.rows.start + k] = h
        step = step.reshape(x.shape)
        change = forces(rig, x + step, amplitudes) - forces(rig, x - step, amplitudes)
        K[:, k] = -change[rig.rows].reshape(-1) / (2 * h)
    return K


# --- force and matrix -------------------------------------------------------------------------------------------------


def test_force_is_the_gradient_of_the_volume(rig):
    for model in (rig.model, rig.parallel):
        f = forces(rig, rig.x, model=model)
        wanted = -P * gradient(rig.body, np.arange(len(rig.body.mesh.surface)), rig.x[rig.rows])
        assert np.abs(f[rig.rows] - wanted).max() < 1e-12 * np.abs(wanted).max() and not f[: rig.rows.start].any()
    assert np.abs(f.sum(axis=0)).max() < 1e-12 * np.abs(f).max()
    assert np.abs(np.cross(rig.x, f).sum(axis=0)).max() < 1e-11 * np.abs(f).max()
    measure(rig.model)
    volume = enclosed(rig.body, np.arange(len(rig.body.mesh.surface)), rig.x[rig.rows])
    assert rig.model.state.scalars[LOADS] == pytest.approx(P * volume, rel=1e-12) and volume > 0.5
    both = forces(rig, rig.x, (P, TOP))
    assert np.abs(both - f - forces(rig, rig.x, (0.0, TOP))).max() < 1e-12 * np.abs(both).max()


def test_an_open_surface_has_the_normals_of_its_triangles(rig):
    """Its resultant is p times the vector area, which only the border determines; its potential is not counted."""
    f = forces(rig, rig.x, (0.0, TOP))
    x, (_, top) = rig.x[rig.rows], rig.body.pressures
    edges = [np.roll(t, -k) for t in rig.body.mesh.surface[top.triangles] for k in range(3)]
    border = [(a, b) for a, b, _ in edges if not any((b, a) == (c, d) for c, d, _ in edges)]
    if rig.body.order == 1:
        area = sum(np.cross(x[a], x[b]) for a, b in border) / 2
        assert np.abs(f.sum(axis=0) + TOP * area).max() < 1e-12 * np.abs(f).max()
    measure(rig.model)
    assert rig.model.state.scalars[LOADS] == 0.0
    flat = forces(rig, rig.layout.rest, (0.0, TOP))
    assert flat.sum(axis=0) == pytest.approx([0.0, -TOP * 1.0 * 1.1, 0.0], abs=1e-9) and flat[:, 1].min() >= -1e-9


def test_matrix_is_the_derivative(rig):
    K, D = matrix(rig, rig.x, (P, 0.0)), derivative(rig, rig.x, (P, 0.0))
    scale = np.abs(D).max()
    assert scale > 100.0 and np.abs(D - D.T).max() < 1e-8 * scale  # closed: a second derivative
    assert np.abs(K - D).max() < 1e-8 * scale
    K, D = matrix(rig, rig.x, (0.0, TOP)), derivative(rig, rig.x, (0.0, TOP))
    assert np.abs(D - D.T).max() > 0.1 * np.abs(D).max()  # open
    assert np.abs(K - 0.5 * (D + D.T)).max() < 1e-8 * np.abs(D).max()
    assert not matrix(rig, rig.x, (P, TOP), projected=True).any()


# --- motion -----------------------------------------------------------------------------------------------------------


def free(pressure, order: int = 1, where=everywhere) -> ts.Scene:
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.contact_forces = False
    scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="body", order=order).add_pressure(where, pressure)
    return scene


def test_energy_of_a_closed_surface_is_conserved():
    with simulator(add_companion(free(P)), "velocity_verlet", 2e-4) as sim:
        start = sim.energies()
        result = sim.run(0.04, on_step=None)
        now, kinetic = sim.energies(), max(report.kinetic for report in result.step_reports)
        assert now.total + now.loads == pytest.approx(start.total + start.loads, abs=0.01 * kinetic)
        assert result.status == "ok" and kinetic > 1.0  # [J]
        moved = sim.positions("body") - sim.scene.body("body").rest_positions
        assert np.abs(moved.mean(axis=0)).max() < 1e-3


def ramp(t: float) -> float:
    return 1e6 * t


# --- copies and bad input -----------------------------------------------------------------------------------------------


def test_scene_files_hold_pressures(tmp_path):
    scene = free(P)
    frames = ts.KeyFrames((0.0, 1 / 3), values=(0.0, 1 / 7), smooth=True)
    scene.bodies[0].add_pressure([3, 1], frames)
    there_and_back(tmp_path / "a.toml", scene, {"dt": 0.01})
    text = (tmp_path / "a.toml").read_text()
    assert "[[bodies.body.pressure]]" in text
    again = ts.read_scene(tmp_path / "a.toml")[0].bodies[0].pressures
    assert again[0].closed and not again[1].closed and again[1].path(0.1) == frames.value_at(0.1)
    (tmp_path / "b.toml").write_text(text.replace("pressure = 7000.0", "pressure = [0, 1, 0]"))
    with pytest.raises(SceneError, match=r"bodies.body.pressure.0..pressure must be a number"):
        ts.read_scene(tmp_path / "b.toml")


@pytest.mark.parametrize("change", [refined, lambda scene: with_order(scene, 2), lambda scene: with_order(scene, 1)])
def test_refined_scenes_keep_pressures(change):
    scene = free(P, order=2)
    mesh = scene.bodies[0].mesh
    scene.bodies[0].add_pressure(np.flatnonzero(on_top(mesh.vertices[mesh.surface].mean(axis=1))), ramp)
    body = change(scene).bodies[0]
    assert [p.closed for p in body.pressures] == [True, False] and body.pressures[1].path is ramp
    a, b, c = body.mesh.vertices[body.mesh.surface[body.pressures[1].triangles]].swapaxes(0, 1)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(1.1)


@pytest.mark.parametrize(
    "where, pressure, message",
    [
        ([0], "high", "add_pressure: pressure must be a number, not 'high'"),
        ([0], lambda t: (1, 2), "add_pressure: the path's pressure at t = 0 must be a number"),
        ([0], ts.KeyFrames((0,), [(0, 0, 0)]), "add_pressure: pressure: key frames need values here"),
        ([99], 1.0, "add_pressure: surface triangle 99 does not exist"),
        ([], 1.0, "add_pressure: no surface triangle is chosen"),
    ],
)
def test_bad_pressures_are_refused(where, pressure, message):
    body = ts.Scene().add_body(cube(), rubber(), name="body")
    with pytest.raises(SceneError, match=f"^body 'body': {message}"):
        body.add_pressure(where, pressure)
    assert body.pressures == []
