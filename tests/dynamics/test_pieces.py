"""Connected pieces count each by itself:

* bodies of masses from a milligram to a tonne fall together without turning, and gain exactly their weight's momentum;
* a body that tumbles keeps its angular momentum, whatever the tolerances; joined bodies fall as one;
* a light body beside a heavy one moves as it does alone, in statics, too; one that does not converge is named;
* in f32 a cube rests on one that is many times larger, wherever it is.
"""

import numpy as np
import pytest

import taisoft as ts
from taisoft.dynamics import implicit_stages
from taisoft.dynamics.schemes import EXPLICIT, INTEGRATORS
from taisoft.fem.reference import lumped_mass
from tests.dynamics.contact_scenes import material

G = 9.81  # [m/s^2]
MASSES = (1e-6, 1e-3, 1.0, 30.0, 1e3)  # [kg]


def falling(masses=MASSES, spin=(0.0, 0.0, 0.0), order=1, **numbers) -> ts.Scene:
    """Boxes apart in a row, as stiff as their weight asks for."""
    made = ts.Scene(gravity=(0, -G, 0))
    made.contact_forces = False
    for k, mass in enumerate(masses):
        size = (mass / 900) ** (1 / 3)
        mesh = ts.box_mesh((3, 1, 2), (1.2 * size, size, 0.75 * size))
        own = ts.Material(young=2e5 * size, density=1000.0, **numbers)
        body = made.add_body(mesh, own, name=str(k), position=(3.0 * k, 0, 0), order=order)
        body.velocity = np.cross(spin, body.rest_positions)
    return made


def turned(rest: np.ndarray, x: np.ndarray) -> float:
    """Rotation [rad] between two sets of points (n,3)."""
    u, _, v = np.linalg.svd((x - x.mean(axis=0)).T @ (rest - rest.mean(axis=0)))
    q = u @ v
    return float(np.linalg.norm([q[2, 1] - q[1, 2], q[0, 2] - q[2, 0], q[1, 0] - q[0, 1]])) / 2


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_bodies_of_all_masses_fall_without_turning(integrator, precision):
    f64 = precision == "f64"
    dt = 4e-4 if integrator in EXPLICIT else 1 / 60
    with ts.Simulator(falling(), dt=dt, integrator=integrator, precision=precision) as sim:
        rest = [sim.positions(str(k)) for k in range(len(MASSES))]
        result = sim.run(0.5, fps=None)
        assert result.status == "ok", result.problems
        for k, mass in enumerate(MASSES):
            assert turned(rest[k], sim.positions(str(k))) < (1e-9 if f64 else 3e-6)  # 1e-3 degrees in 3 s: 3e-6 in 0.5 s
            gained = sim.momentum(str(k)) / (mass * G * sim.time)
            assert np.abs(gained - (0, -1, 0)).max() < (1e-12 if f64 else 2e-7)  # g and masses are rounded in f32


def angular_momentum(sim: ts.Simulator, own: np.ndarray, name: str) -> np.ndarray:
    """Angular momentum [kg m^2/s] about the centre of mass. own (n,): lumped masses [kg]."""
    x, v = sim.positions(name), sim.velocities(name)
    return np.cross(x - own @ x / own.sum(), own[:, None] * v).sum(axis=0)


@pytest.mark.parametrize(
    "integrator, order", [("implicit_euler", 1), ("bdf2", 1), ("linearly_implicit_euler", 1), ("linearly_implicit_euler", 2)]
)
def test_the_angular_momentum_is_that_of_an_exact_solve(integrator, order):
    """Of a body that tumbles, under tolerances that hardly solve its steps."""
    name = "linear_tolerance" if integrator.startswith("linearly") else "newton_tolerance"
    made, found = falling(masses=(1.0,), spin=(3.0, 1.0, 2.0), order=order), []
    own = lumped_mass(made.bodies[0])
    for tolerance in (0.09, 1e-11):
        with ts.Simulator(made, dt=0.01, integrator=integrator, precision="f64", **{name: tolerance}) as sim:
            start = angular_momentum(sim, own, "0")
            for _ in range(20):
                sim.step()
            found.append(angular_momentum(sim, own, "0"))
    assert np.linalg.norm(found[0] - found[1]) < 1e-3 * np.linalg.norm(start), (found, start)


def test_a_compressed_body_is_not_spun_up():
    """Where compression outweighs inertia, the exact linearised step would turn a body ninety times as fast."""
    made = falling(masses=(1.0,), spin=(0.0, 1.0, 0.5))
    made.gravity, own = (0, 0, 0), lumped_mass(made.bodies[0])
    with ts.Simulator(made, dt=1 / 240, integrator="linearly_implicit_euler", precision="f64") as sim:
        sim.set_material("0", young=1e6)
        for part in (0.9, 0.85, 0.8):
            sim.reset()
            x = part * sim.positions("0")
            sim.set_state(positions=x, body="0")
            start = angular_momentum(sim, own, "0")
            sim.step()
            assert np.linalg.norm(angular_momentum(sim, own, "0")) < 4.0 * np.linalg.norm(start)


def test_joined_bodies_fall_as_one():
    """A spring, and a light body attached exactly to a heavy one, which a loose solve would let turn."""
    made = falling(masses=(1e-3, 1.0, 30.0))
    made.add_spring(("1", 0), ("2", 0), stiffness=50.0)
    light, heavy = made.bodies[0], made.bodies[1]
    light.position = heavy.position + (0.5 * (np.ptp(heavy.mesh.vertices[:, 0]) + np.ptp(light.mesh.vertices[:, 0])), 0, 0)
    made.attach("0", lambda X: X[:, 0] < X[:, 0].min() + 1e-6, "1")
    with ts.Simulator(made, dt=1 / 60, integrator="linearly_implicit_euler", precision="f32") as sim:
        result = sim.run(0.25, fps=None)
        assert result.status == "ok", result.problems
        gained = sim.momentum() / (31.001 * G * sim.time)
    assert np.abs(gained - (0, -1, 0)).max() < 1e-6


def hanging(length: float, beside: bool) -> ts.Scene:
    """A soft cantilever, alone or beside a block of a tonne that is held, too."""
    made, scale = ts.Scene(gravity=(0, -G, 0)), length / 0.4
    small = made.add_body(ts.box_mesh((6, 1, 1), (length, length / 4, length / 4)), ts.Material(young=1e5 * scale), name="small")
    small.position = (2, 0, 0)
    small.fix(lambda X: X[:, 0] < -0.4999 * length)
    if beside:
        block = made.add_body(ts.box_mesh((2, 2, 2), (1, 1, 1)), material(young=1e6), name="block")
        block.fix(lambda X: X[:, 1] < -0.49)
    return made


@pytest.mark.parametrize(
    "integrator, precision", [("linearly_implicit_euler", "f32"), ("implicit_euler", "f32"), ("bdf2", "f64")]
)
def test_a_light_body_moves_as_it_does_alone(integrator, precision):
    length, found = 4e-4, []
    for beside in (False, True):
        with ts.Simulator(hanging(length, beside), dt=1e-3, integrator=integrator, precision=precision) as sim:
            result = sim.run(0.03, fps=None)
            assert result.status == "ok", result.problems
            found.append(sim.positions("small") / length)
    assert np.abs(found[1] - found[0]).max() < 1e-4


def test_statics_of_a_light_body_beside_a_heavy_one():
    length = 4e-4
    alone, both = (ts.solve_static(hanging(length, beside)) for beside in (False, True))
    assert both.converged and np.abs(both.positions("small") - alone.positions("small")).max() < 1e-4 * length


def test_a_piece_that_does_not_converge_is_named(monkeypatch):
    monkeypatch.setattr(implicit_stages, "MAX_NEWTON", 1)
    made = falling(masses=(1e3, 1e-6))
    with ts.Simulator(made, dt=1 / 60, precision="f64") as sim:
        x = sim.positions("1")
        sim.set_state(positions=x.mean(axis=0) + 0.5 * (x - x.mean(axis=0)), body="1")
        report = sim.step()
    assert not report.converged and any("body '1'" in text for text in report.problems), report.problems


@pytest.mark.parametrize("far, ratio", [(0.0, 1.0), (0.0, 1e2), (0.0, 1e5), (1e3, 1e5)])
def test_a_small_cube_rests_on_a_large_one_in_f32(ratio, far):
    """In steps in which the slab, which settles, moves less than the cube is long."""
    size = 1.0 / ratio
    dt = 2e-3 * min(1.0, 1e3 / ratio)
    made = ts.Scene(gravity=(0, -G, 0))
    slab = made.add_body(ts.box_mesh((2, 1, 2), (1, 0.5, 1)), ts.Material(young=1e6), name="slab", position=(far, 0, 0))
    slab.fix(lambda X: X[:, 1] < -0.24)
    start = (far + 0.1, 0.25 + 0.5 * size, 0.13)
    made.add_body(ts.box_mesh((1, 1, 1), (size,) * 3), ts.Material(young=1e7 * size), name="cube", position=start)
    with ts.Simulator(made, dt=dt, precision="f32") as sim:
        result = sim.run(25 * dt, fps=None)
        assert result.status == "ok", result.problems
        x, v = sim.positions("cube"), sim.velocities("cube")
    assert np.abs(np.ptp(x, axis=0) / size - 1.0).max() < 0.05
    assert np.abs(v[:, [0, 2]]).max() < 0.05 and np.abs(x.mean(axis=0) - start)[[0, 2]].max() < 1e-3
