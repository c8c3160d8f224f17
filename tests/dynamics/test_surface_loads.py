"""Contact pressure, traction, state and slip of surfaces, and the columns of contacts that belong to them."""

import numpy as np
import pytest

import taisoft as ts
from taisoft.errors import SceneError

PRESSURE = 1e4  # [Pa]


def patch(order: int, top_first: bool = False) -> ts.Scene:
    """A block on another one of another mesh, under a uniform pressure: uniform in both."""
    scene, soft = ts.Scene(gravity=(0, 0, 0)), ts.Material("st_venant_kirchhoff", young=1e6, density=1e-3, friction=0.2)
    cells = {"low": (2, 1, 2), "top": (3, 2, 3)}
    for name in sorted(cells, reverse=top_first):
        y = 0.25 if name == "low" else 0.751
        body = scene.add_body(ts.box_mesh(cells[name], (1, 0.5, 1), (0.5, y, 0.5)), soft, name=name, order=order)
        for axis, k in (("x", 0), ("z", 2)):
            body.fix(lambda X, k=k: X[:, k] < 1e-9, axes=axis)
        if name == "low":
            body.fix(lambda X: X[:, 1] < 1e-9, axes="y")
        else:
            body.add_traction(lambda C: C[:, 1] > 1.0, (0, -PRESSURE, 0))
    return scene


@pytest.mark.parametrize("order", [1, 2])
def test_a_uniform_pressure_comes_out_uniform(order):
    for top_first in (False, True):  # which changes the sides of contacts, and nothing else
        with ts.Simulator(patch(order, top_first), dt=1.0, precision="f64") as sim:
            sim.run(3.0, fps=None)
            contacts = sim.contacts(areas=True)
            for name, sign in (("low", -1.0), ("top", 1.0)):
                area, force = np.prod(np.ptp(sim.positions(name), axis=0)[[0, 2]]), sim.contact_force(name)
                for by in ("node", "triangle"):
                    found = sim.contact_pressure(name, by)
                    on = found.pressure > 0.0
                    body = sim.scene.body(name)
                    nodes = found.index[on] if by == "node" else body.nodes.surface[found.index[on]]
                    assert np.ptp(body.rest_positions[nodes, 1]) == 0.0, "nothing presses on the sides of the block"
                    deviation = found.pressure[on] * area / abs(force[1]) - 1.0
                    assert np.sqrt(np.mean(deviation**2)) < 1e-4 and abs(force[1] - sign * PRESSURE) < 1e-5 * PRESSURE
                    assert np.allclose(found.force.sum(axis=0), force, atol=1e-9 * PRESSURE)
                    assert np.isclose(found.area[on].sum(), area) and np.isclose(
                        (found.pressure * found.area).sum(), abs(force[1])
                    )
                    assert np.allclose(found.normal[on], (0, -sign, 0), atol=1e-6) and set(found.state[on]) == {"stick"}
            assert np.isclose(np.nansum(contacts.tributary_area), area, rtol=1e-6)
            assert np.abs(contacts.tangential_impulse).max() < 1e-3 * PRESSURE
            on = contacts.state != "open"
            assert np.allclose(contacts.clearance[on], 0.0, atol=1e-3 * sim.contact_offset)
            assert np.allclose(contacts.gap - contacts.clearance, np.where(contacts.guard, 0.5, 1.0) * sim.contact_offset)


def on_ground(push: float, order: int = 1, turn: np.ndarray | None = None, mesh: tuple = (3, 2, 3)) -> ts.Scene:
    """A block at rest on the ground, pushed by so many times what friction holds. turn: of everything, (3,3)."""
    turn = np.eye(3) if turn is None else turn
    scene, box = ts.Scene(gravity=turn @ (0, -9.81, 0)), ts.box_mesh(mesh, (0.3, 0.1, 0.3), (0, 0.05, 0))
    box = ts.TetMesh(box.vertices @ turn.T, box.tets)
    soft = ts.Material(young=1e6, mass_damping=20.0)
    block = scene.add_body(box, soft, name="block", position=turn @ (0, 2.5e-4, 0), order=order)
    block.add_force(lambda X: X[:, 0] == X[:, 0], turn @ (push * 0.4 * 9.81 * block.mass, 0, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), turn @ (0, 1, 0)), name="ground")
    scene.set_contact("block", "ground", friction=0.4)
    return scene


@pytest.mark.gpu_path("f64")
@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize(("integrator", "dt", "seconds"), [("implicit_euler", 0.02, 0.6), ("symplectic_euler", 4e-4, 0.4)])
def test_a_block_sticks_below_the_threshold_and_slips_above(precision, integrator, dt, seconds):
    for push, expected in ((0.8, "stick"), (1.2, "slip")):
        with ts.Simulator(on_ground(push), dt=dt, integrator=integrator, precision=precision) as sim:
            sim.run(seconds, fps=None)
            contacts, found = sim.contacts(), sim.contact_pressure("block")
            pressed = contacts.state != "open"
            load, area = (contacts.impulse * contacts.normal).sum(axis=1), found.pressure * found.area
            as_expected = load[contacts.state == expected].sum() / load.sum(), area[found.state == expected].sum() / area.sum()
            assert pressed.sum() > 10 and min(as_expected) > (0.9 if "symplectic" in integrator else 1.0 - 1e-12)  # waves stick
            assert ((found.pressure > 0.0) == (found.state != "open")).all()
            ratio = np.linalg.norm(found.traction, axis=1)[found.pressure > 0.0] / found.pressure[found.pressure > 0.0]
            assert (ratio < 0.4 * (1 + 1e-3)).all()
            assert (found.slip[found.state == "open"] == 0.0).all() and (found.slip[found.state == "slip"] != 0.0).any(
                axis=1
            ).all()


@pytest.mark.parametrize("by", ["node", "triangle"])
def test_tractions_sum_to_the_friction(by):
    with ts.Simulator(on_ground(0.8), dt=1.0, integrator="static", precision="f64") as sim:
        sim.step()
        found, force = sim.contact_pressure("block", by), sim.contact_force("block", "ground")
        assert set(found.state) == {"open", "stick", "slip"}
        assert np.allclose(
            (found.traction * found.area[:, None]).sum(axis=0) * (1, 0, 1), force * (1, 0, 1), atol=1e-9 * force[1]
        )


def test_forces_at_rest_equal_the_weight():
    with ts.Simulator(on_ground(0.0), dt=0.02) as sim:
        report = sim.run(2.0, fps=None, details="pairs", about=(1.0, 0.0, 0.0)).step_reports[-1]
        weight = 9.81 * sim.scene.body("block").mass
        assert np.isclose(report.details["force y on block by ground [N]"], weight, rtol=1e-5)
        assert np.isclose((found := sim.contact_pressure("block")).pressure @ found.area, weight, rtol=1e-5)
        force, torque = sim.contact_force("block"), sim.contact_torque("block", about=(1.0, 0.0, 0.0))
        about_origin = sim.contact_torque("block", "ground", about=(0, 0, 0))
        assert np.allclose(torque, about_origin - np.cross((1.0, 0.0, 0.0), force))
        headings = [f"torque {axis} on block by ground about (1, 0, 0) [N m]" for axis in "xyz"]
        assert [report.details[heading] for heading in headings] == torque.tolist()
        assert sim.details("pairs", about=(1.0, 0.0, 0.0)) == report.details


def sliding(rate: float = 0.05) -> ts.Scene:
    """A stiff block that is moved over the ground at a rate [m/s]."""
    scene = ts.Scene()
    block = scene.add_body(ts.box_mesh((2, 1, 2), (0.2, 0.1, 0.2), (0, 0.05, 0)), ts.Material(young=1e6), name="block", order=2)
    block.move(lambda X: X[:, 1] > 0.09, lambda t: (rate * t, -1e-4 - 2e-4, 0))
    scene.add_obstacle(ts.HalfSpace((0, 0, 0), (0, 1, 0)), name="ground", friction=0.1)
    return scene


def test_slip_of_a_prescribed_motion_is_exact_and_kept(tmp_path):
    with ts.Simulator(sliding(), dt=0.02, precision="f64") as sim:
        sim.run(0.2, fps=None)
        before = sim.contact_pressure("block").accumulated_slip
        sim.save_checkpoint(tmp_path / "half.npz")
        sim.run(0.2, fps=None)
        found, triangles = sim.contact_pressure("block"), sim.contact_pressure("block", "triangle")
        on = found.state == "slip"
        assert on.sum() > 9 and np.allclose(found.slip[on], (0.05 * 0.02, 0, 0), rtol=1e-3, atol=2e-6)
        assert np.allclose((found.accumulated_slip - before)[on], 0.05 * 0.2, rtol=2e-3)
        assert np.allclose(triangles.accumulated_slip[triangles.state == "slip"].max(), found.accumulated_slip.max(), rtol=0.02)
        assert np.allclose(sim.contacts().slip[sim.contacts().state == "slip"], (0.001, 0, 0), rtol=1e-3, atol=2e-6)
        sim.set_state(velocities=0.0 * sim.velocities())
        assert (sim.contact_pressure("block").accumulated_slip == found.accumulated_slip).all()
        sim.reset()
        assert not sim.contact_pressure("block").accumulated_slip.any() and not sim.contact_pressure("block").pressure.any()
    with ts.Simulator.load_checkpoint(tmp_path / "half.npz", sliding()) as sim:
        assert (sim.contact_pressure("block").accumulated_slip == before).all() and (before > 0.0).any()
        sim.run(0.2, fps=None)
        again = sim.contact_pressure("block")
        assert (again.accumulated_slip == found.accumulated_slip).all() and (again.pressure == found.pressure).all()


def test_a_turned_scene_has_turned_fields():
    a, b = 0.7, -0.4
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    turn = turn @ [[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]]
    found = []
    for rotation in (np.eye(3), turn):
        with ts.Simulator(on_ground(1.2, turn=rotation), dt=0.02, precision="f64", newton_tolerance=1e-9) as sim:
            sim.run(0.2, fps=None)
            found.append(sim.contact_pressure("block"))
    plain, turned = found
    assert (plain.state == turned.state).all() and np.allclose(plain.pressure, turned.pressure, rtol=1e-4)
    for name in ("normal", "traction", "slip", "force"):
        size = np.abs(getattr(plain, name)).max()
        assert np.allclose(getattr(plain, name) @ turn.T, getattr(turned, name), atol=1e-4 * size), name
    assert np.allclose(plain.accumulated_slip, turned.accumulated_slip, rtol=1e-3)


def test_skins_and_rigid_bodies_have_their_own_nodes():
    scene, box = ts.Scene(), ts.box_mesh((2, 2, 2), (0.2, 0.2, 0.2), (0, 0.1, 0))
    soft = scene.add_body(box, ts.Material(young=1e6, mass_damping=30.0), name="soft", position=(0, 1e-4, 0))
    soft.embed(ts.SurfaceMesh(box.vertices * 0.99, box.surface), contact=True)
    scene.add_rigid_body(box, density=1000.0, name="rigid", position=(0.5, 1e-4, 0))
    scene.add_ground()
    with ts.Simulator(scene, dt=0.02) as sim:
        sim.run(0.6, fps=None)
        for name in ("soft", "rigid"):
            found, force = sim.contact_pressure(name), sim.contact_force(name)
            pressed = found.index[found.pressure > 0.0]
            assert len(pressed) == 9 and np.ptp(sim.positions(name)[pressed, 1]) < 1e-4
            assert np.allclose(found.force.sum(axis=0), force, atol=1e-6 * force[1]) and np.isclose(
                force[1], 9.81 * 8.0, rtol=1e-2
            )


def test_invalid_requests_are_refused():
    with ts.Simulator(on_ground(0.0), dt=0.02) as sim:
        assert len(sim.contact_pressure("block")) and not sim.contact_pressure("block").pressure.any()
        for call, message in (
            (lambda: sim.contact_pressure("ground"), "ground"),
            (lambda: sim.contact_pressure("block", by="face"), "by"),
            (lambda: sim.contact_torque("block", about=(0, 0)), "about must have shape"),
            (lambda: sim.details("pair"), "details"),
        ):
            with pytest.raises(SceneError, match=message):
                call()
        assert f"keep {sim.contact_offset:.3g} m apart" in sim.plan.why("contact_forces")
    with pytest.raises(SceneError, match="offset"):
        ts.CollisionSettings(offset=0.0)
    scene = ts.Scene()
    scene.add_body(ts.box_mesh((1, 1, 1), (1, 1, 1)), ts.Material(), name="alone")
    with ts.Simulator(scene, dt=0.01) as sim, pytest.raises(SceneError, match="contact forces are not simulated"):
        assert sim.contact_offset == 0.0
        sim.contact_pressure("alone")
