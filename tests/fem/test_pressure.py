"""Follower pressure on surface triangles, on linear and quadratic tets:

* its force is -p times the gradient of the enclosed volume, computed independently; on a closed surface without resultant;
* its matrix is the derivative of the force on a closed surface, the symmetric part on an open one; Newton converges on both;
* a cube is compressed as the law predicts, a thick sphere inflated as Lamé and the radial balance of the law predict;
* the energy of a closed surface is conserved; on an open one the work counts as external;
* overlapping pressures add; paths, integrators, contacts, precisions, checkpoints, scene files, refinement, bad input.
"""

import numpy as np
import pytest
import scipy.optimize

import taisoft as ts
from taisoft.dynamics.schemes import EXPLICIT, IMPLICIT
from taisoft.errors import SceneError
from taisoft.fem.measure import measure
from taisoft.fem.node_graph import EVERYTHING
from taisoft.fem.pressure import triangle_nodes
from taisoft.fem.state import LOADS
from taisoft.fem.terms.pressure import gather_pressures
from taisoft.linear import block_csr
from taisoft.scene.fingerprint import scene_digest
from taisoft.scene.refine import refined, with_order
from tests.dynamics.scenes import COR, SNH, SVK, built, cube, rubber
from tests.fem.oracle_laws import pk1
from tests.fem.shells import inflated, inner_radius, lame, thick_sphere
from tests.scene.toml_scenes import there_and_back

P, TOP = 7e3, -4e3  # [Pa]


def everywhere(centroids: np.ndarray) -> np.ndarray:
    return np.ones(len(centroids), dtype=bool)


def on_top(centroids: np.ndarray) -> np.ndarray:
    return centroids[:, 1] > 0.44


def pressed(order: int, closed: bool = True, both: bool = False) -> ts.Scene:
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(cube((5, 0, 0)), rubber(), name="unloaded", order=3 - order)
    body = scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="body", order=order)
    if closed or both:
        body.add_pressure(everywhere, P)
    if not closed or both:
        body.add_pressure(on_top, TOP)
    return scene


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


@pytest.fixture(params=[1, 2])
def rig(request):
    with built(pressed(request.param, both=True), "f64") as made:
        rng = np.random.default_rng(4)
        made.x = made.layout.rest + 0.05 * rng.standard_normal(made.layout.rest.shape)
        made.out, made.body = made.vectors("out"), made.scene.bodies[1]
        made.rows = made.layout.nodes(1)
        yield made


def forces(rig, x: np.ndarray, amplitudes=(P, 0.0), model=None) -> np.ndarray:
    model = model or rig.model
    model.amplitudes.from_numpy(np.array(amplitudes))
    model.state.x.from_numpy(x)
    gather_pressures(model, rig.out)
    return rig.out.to_numpy()


def matrix(rig, x: np.ndarray, amplitudes, projected: bool = False) -> np.ndarray:
    """Of the pressures alone, in the second body."""
    parts = []
    rig.model.state.x.from_numpy(x)
    if not hasattr(rig, "matrix"):
        rig.matrix = block_csr.build_block_csr(rig.model, rig.arena, "pressed")
    for p in (np.array(amplitudes), np.zeros(2)):
        rig.model.amplitudes.from_numpy(p)
        block_csr.assemble(rig.model, rig.matrix, EVERYTHING, projected)
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


def test_an_open_surface_has_the_normals_of_its_triangles(rig):
    """Its resultant is p times the vector area, which only the border determines; its potential is not counted."""
    f = forces(rig, rig.x, (0.0, TOP))
    x, (_, top) = rig.x[rig.rows], rig.body.pressures
    edges = [np.roll(t, -k) for t in rig.body.mesh.surface[top.triangles] for k in range(3)]
    border = [(a, b) for a, b, _ in edges if not any((b, a) == (c, d) for c, d, _ in edges)]
    if rig.body.order == 1:
        area = sum(np.cross(x[a], x[b]) for a, b in border) / 2
        assert np.abs(f.sum(axis=0) + TOP * area).max() < 1e-12 * np.abs(f).max()
    flat = forces(rig, rig.layout.rest, (0.0, TOP))
    assert flat.sum(axis=0) == pytest.approx([0.0, -TOP * 1.0 * 1.1, 0.0], abs=1e-9) and flat[:, 1].min() >= -1e-9
    measure(rig.model)
    assert rig.model.state.scalars[LOADS] == 0.0


def test_matrix_is_the_derivative(rig):
    K, D = matrix(rig, rig.x, (P, 0.0)), derivative(rig, rig.x, (P, 0.0))
    scale = np.abs(D).max()
    assert scale > 100.0 and np.abs(D - D.T).max() < 1e-8 * scale  # closed: a second derivative
    assert np.abs(K - D).max() < 1e-8 * scale
    K, D = matrix(rig, rig.x, (0.0, TOP)), derivative(rig, rig.x, (0.0, TOP))
    assert np.abs(D - D.T).max() > 0.1 * np.abs(D).max()  # open
    assert np.abs(K - 0.5 * (D + D.T)).max() < 1e-8 * np.abs(D).max()
    assert not matrix(rig, rig.x, (P, TOP), projected=True).any()


def test_pressures_add(rig):
    both = forces(rig, rig.x, (P, TOP))
    assert np.abs(both - forces(rig, rig.x, (P, 0.0)) - forces(rig, rig.x, (0.0, TOP))).max() < 1e-12 * np.abs(both).max()


# --- statics ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law, order, p", [(SNH, 1, 2e4), (SNH, 2, -2e4), (SVK, 2, -2e4), (COR, 1, 2e4)])
def test_a_cube_is_in_a_hydrostatic_state(law, order, p):
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    body = scene.add_body(cube(cells=(2, 2, 2)), rubber(law), name="body", order=order)
    for axis, half in enumerate((0.5, 0.45, 0.55)):
        body.fix(lambda X, a=axis, h=half: X[:, a] < 1e-9 - h, axes="xyz"[axis])
    body.add_pressure(everywhere, p)
    found = ts.solve_static(scene, tolerance=1e-9)

    def excess(stretch: float) -> float:
        return pk1(law, stretch * np.eye(3)[None], 1e5, 0.3)[0, 0, 0] + p * stretch**2  # P = -p J F^-T

    stretch = scipy.optimize.brentq(excess, 0.7, 1.5, xtol=1e-12)
    start = body.rest_positions.min(axis=0)
    assert found.converged and found.load_steps == 1 and found.iterations <= 12
    assert np.abs(found.positions() - (start + stretch * (body.rest_positions - start))).max() < 1e-6
    assert abs(stretch - 1.0) > 0.05


def test_a_thick_sphere():
    errors = {}
    small, large = lame(1e5, 0.3, 1.0, 2.0, 100.0, 1.0), inflated(SNH, 1e5, 0.3, 1.0, 2.0, 2e4) - 1.0
    assert large > 0.2
    for across, layers in ((3, 2), (6, 3)):
        mesh = thick_sphere(1.0, 2.0, across, layers)
        for pressure, exact in ((100.0, small), (2e4, large)):
            radius, found = inner_radius(mesh, SNH, pressure)
            assert found.converged and found.load_steps == 1 and found.iterations <= 7
            errors[across, pressure] = abs((radius - 1.0) / exact - 1.0)
    assert errors[6, 100.0] < 0.005 and errors[6, 2e4] < 0.01
    assert all(errors[6, p] < 0.5 * errors[3, p] for p in (100.0, 2e4))


@pytest.mark.parametrize("order", [1, 2])
def test_newton_converges_with_an_open_surface(order):
    """A cantilever that a pressure on its top bends far down, where the force has turned with it."""
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    beam = scene.add_body(cube(cells=(8, 2, 2), size=(4.0, 0.5, 0.5)), rubber(), name="beam", order=order)
    beam.fix(lambda X: X[:, 0] < -1.99)
    beam.add_pressure(lambda c: c[:, 1] > 0.24, 60.0)
    found = ts.solve_static(scene)
    tip = found.positions()[beam.rest_positions[:, 0] > 1.99].mean(axis=0)
    assert found.converged and found.iterations < 40
    assert tip[1] < -0.4


# --- motion -----------------------------------------------------------------------------------------------------------


def free(pressure, order: int = 1, where=everywhere) -> ts.Scene:
    scene = ts.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(cube(cells=(2, 1, 1)), rubber(), name="body", order=order).add_pressure(where, pressure)
    return scene


@pytest.mark.parametrize("order", [1, 2])
def test_energy_of_a_closed_surface_is_conserved(order):
    with ts.Simulator(free(P, order), dt=2e-4, integrator="velocity_verlet", precision="f64") as sim:
        start, kinetic = sim.energies(), 0.0
        result = sim.run(0.04, on_step=None)
        now = sim.energies()
        kinetic = max(report.kinetic for report in result.step_reports)
        assert now.total + now.loads == pytest.approx(start.total + start.loads, abs=0.01 * kinetic)
        assert result.status == "ok" and kinetic > 1.0  # [J]
        x = sim.positions()
        assert np.abs(sim.scene.bodies[0].rest_positions.mean(axis=0) - x.mean(axis=0)).max() < 1e-3


@pytest.mark.parametrize("integrator", ["velocity_verlet", "bdf2"])
def test_work_on_an_open_surface_is_external(integrator):
    """Energy rises without a complaint, by the work of the force: Simpson's rule along the path."""
    scene = free(P, where=on_top)
    body = scene.bodies[0]
    with ts.Simulator(scene, dt=2e-4, integrator=integrator, precision="f64", newton_tolerance=1e-8) as sim:
        start = sim.energies()
        work, x, top = 0.0, sim.positions(), body.pressures[0].triangles
        corners = body.mesh.surface[top]
        for _ in range(100):
            sim.step()
            now = sim.positions()
            middle = 0.5 * (x + now)[corners]
            area = np.cross(middle[:, 1] - middle[:, 0], middle[:, 2] - middle[:, 0]) / 2
            work += float((-P * area * (now - x)[corners].mean(axis=1)).sum())
            x = now
        end = sim.energies()
        assert end.loads == 0.0 and end.total - start.total == pytest.approx(work, rel=0.03) and work > 10.0
        assert sim.run(0.02).status == "ok"


def ramp(t: float) -> float:
    return 1e6 * t


@pytest.mark.parametrize("order", [1, 2])
def test_explicit_and_implicit_steps_agree(order):
    ends = {}
    for integrator in (*EXPLICIT, "bdf2", "implicit_midpoint"):
        with ts.Simulator(free(ramp, order), dt=5e-5, integrator=integrator, precision="f64") as sim:
            while sim.step_count < 400:
                sim.advance(400 - sim.step_count)
            ends[integrator] = sim.positions() - sim.scene.bodies[0].rest_positions
    for integrator, found in ends.items():
        # the mass of quadratic tets is lumped in explicit steps and consistent in implicit ones
        wanted = ends["velocity_verlet" if order == 2 and integrator in EXPLICIT else "bdf2"]
        assert np.abs(wanted).max() > 0.008
        assert np.abs(found - wanted).max() < 0.03 * np.abs(wanted).max()


@pytest.mark.parametrize("integrator", [*EXPLICIT, *IMPLICIT])
def test_a_constant_path_is_a_constant(integrator):
    ends = []
    for pressure in (P, lambda t: P, ts.KeyFrames((0.0, 1.0), values=(P, P))):
        for precision in ("f32", "f64"):
            with ts.Simulator(free(pressure), dt=1e-3, integrator=integrator, precision=precision) as sim:
                for _ in range(5):
                    sim.step()
                ends.append(sim.positions())
    assert np.array_equal(ends[0], ends[2]) and np.array_equal(ends[0], ends[4])
    assert np.array_equal(ends[1], ends[3]) and np.array_equal(ends[1], ends[5])
    assert np.abs(ends[0] - ends[1]).max() < 1e-5 and not np.array_equal(ends[0], ends[1])


@pytest.mark.parametrize("integrator", ["symplectic_euler", "velocity_verlet", "implicit_euler", "linearly_implicit_euler"])
def test_batches_and_contacts(integrator):
    """A body under pressure falls on the ground as it would without, but smaller; its weight rests there."""
    scene = ts.Scene()
    body = scene.add_body(cube((0, 0.46, 0)), rubber(young=1e6), name="body", order=2)
    body.add_pressure(everywhere, 5e4)
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground")
    body.material = rubber(young=1e6, mass_damping=20.0)
    with ts.Simulator(scene, dt=2e-4 if integrator in EXPLICIT else 5e-3, integrator=integrator) as sim:
        sim.run(0.5)
        x = sim.positions()
        assert sim.contact_force("ground")[1] == pytest.approx(-9.81 * body.mass, rel=0.02)
        assert np.ptp(x, axis=0)[[0, 2]] == pytest.approx(np.array([1.0, 1.1]) * (1 - 5e4 * (1 - 2 * 0.3) / 1e6), rel=3e-3)


# --- changes, copies and bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["velocity_verlet", "bdf2"])
@pytest.mark.parametrize("replaced", [False, True])
def test_checkpoints_resume_bitwise(tmp_path, integrator, replaced):
    def steps(sim, n: int) -> None:
        for _ in range(n):
            sim.step()

    with ts.Simulator(free(ramp), dt=1e-3, integrator=integrator) as sim:
        steps(sim, 4)
        if replaced:
            sim.set_pressure("body", 0, 9e3)
        steps(sim, 1)
        sim.save_checkpoint(tmp_path / "c.npz")
        steps(sim, 4)
        wanted = sim.positions(), sim.energies().loads
    with ts.Simulator.load_checkpoint(tmp_path / "c.npz", free(ramp)) as sim:
        assert (sim.scene.bodies[0].pressures[0].path is None) == replaced
        steps(sim, 4)
        assert np.array_equal(sim.positions(), wanted[0]) and sim.energies().loads == wanted[1]
    with pytest.raises(SceneError, match="differs in body 'body': loads"):
        ts.Simulator.load_checkpoint(tmp_path / "c.npz", free(ts.KeyFrames((0,), values=(0,))))


def test_a_value_replaces_another():
    scene = free(0.0)
    with ts.Simulator(scene, dt=1e-3, integrator="symplectic_euler") as sim:
        sim.step()
        assert np.array_equal(sim.positions(), scene.bodies[0].rest_positions)
        sim.set_pressure("body", 0, P)
        sim.step()
        assert np.ptp(sim.positions(), axis=0)[0] < 1.0
        with pytest.raises(SceneError, match="body 'body': set_pressure: pressure 0 must be a number, not of shape .3,."):
            sim.set_pressure("body", 0, (0.0, 0.0, 1.0))
        with pytest.raises(SceneError, match="set_pressure: index must be"):
            sim.set_pressure("body", 1, 1.0)
        with pytest.raises(SceneError, match="call sim.set_pressure"):
            sim.scene.bodies[0].add_pressure(everywhere, 1.0)


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


def test_plan_and_digest():
    scenes = [free(P), free(2 * P), free(ramp), free(P, where=on_top), free(ts.KeyFrames((0,), values=(P,)))]
    scenes.append(free(ts.KeyFrames((0,), values=(2 * P,))))
    assert len({scene_digest(scene) for scene in scenes}) == 6
    with ts.Simulator(scenes[2], dt=1e-3) as sim:
        assert sim.plan.on["pressure"] and sim.plan.on["load_paths"] and not sim.plan.on["loads"]
        assert sim.plan.why("pressure") == "on body"
        assert {name for name in sim.field_bytes if name.startswith("pressure")} > {"pressure_stiffness_weight"}
    with ts.Simulator(scenes[0], dt=1e-3, integrator="symplectic_euler") as sim:
        assert not any(name.startswith("pressure_stiffness") for name in sim.field_bytes)


@pytest.mark.parametrize(
    "where, pressure, message",
    [
        ([0], (0, 1, 0), "add_pressure: pressure must be a number, not of shape .3,."),
        ([0], "high", "add_pressure: pressure must be a number, not 'high'"),
        ([0], np.nan, r"add_pressure: pressure is nan, not finite"),
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


def test_a_path_that_fails_later_stops_the_run():
    for integrator in ("velocity_verlet", "implicit_euler"):
        with ts.Simulator(free(lambda t: 1.0 if t < 0.0035 else np.inf), dt=1e-3, integrator=integrator) as sim:
            with pytest.raises(
                ts.SimulationError, match="body 'body': pressure 0: the path's pressure at t = 0.00[345] is inf, not finite"
            ):
                for _ in range(9):
                    sim.step()
            assert np.isfinite(sim.positions()).all()
