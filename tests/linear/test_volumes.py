"""Nearly incompressible bodies with mean dilatation, in f64: the preconditioner solves the system, in iterations that do not grow
with lambda, and that others share its fields; a curved step keeps the dilatations that its direction leads to, to second order.
"""

import math

import numpy as np

import taisoft as ts
from taisoft.dynamics.constraints import solve_constrained
from taisoft.linear import block_csr, pcg
from taisoft.linear.volumes import prepare_volumes, restore_volumes, save_volumes
from tests.dynamics.scenes import dynamics, rubber

BETA = 1 / 60  # [s]


def beam(poisson: float) -> ts.Scene:
    scene = ts.Scene()
    body = scene.add_body(ts.box_mesh((8, 2, 2), (4, 1, 1)), rubber(poisson=poisson), dilatation="mean", name="body")
    body.fix(lambda X: X[:, 0] < -1.9)
    return scene


def stepped(scene: ts.Scene):
    return dynamics(scene, dt=BETA, precision="f64", integrator="implicit_euler")


def test_the_preconditioner_solves_the_system_in_few_iterations_whatever_lambda():
    iterations = []
    for poisson in (0.47, 0.499, 0.49999):
        with stepped(beam(poisson)) as made:
            made.stepper.advance(1, BETA)
            system, m = made.stepper.solver, made.model
            system.form_matrix()
            A, w, free = system.matrix, system.work.pcg, m.free.to_numpy().reshape(-1) > 0
            rhs = np.random.default_rng(0).standard_normal(len(free)) * free
            w.rhs.from_numpy(rhs.reshape(-1, 3))
            volumes = system.linear_solver.volumes()
            prepare_volumes(m, A, w, volumes, BETA**2)
            found = pcg.solve(m, A, volumes, w, 1e-10, 1000)
            K = block_csr.to_bsr(m, A).toarray()[free][:, free]
            exact, y = np.linalg.solve(K, rhs[free]), w.y.to_numpy().reshape(-1)
            assert found.converged and np.abs(y[free] - exact).max() < 1e-7 * np.abs(exact).max() and not y[~free].any()
            iterations.append(found.iterations)
            if poisson == 0.47:
                m.state.x.from_numpy(m.state.x.to_numpy() + 0.1 * np.random.default_rng(1).standard_normal((len(free) // 3, 3)))
                other = block_csr.build_block_csr(m, made.arena, "other")
                block_csr.assemble(m, other, True)
                values = np.linalg.eigvalsh(block_csr.to_bsr(m, other).toarray())
                assert values[0] > -1e-12 * values[-1]
            stopped = pcg.solve(m, A, volumes, w, 1e-10, 3)
            assert stopped.iterations == 3 and not stopped.converged
            A.diagonal.host[:, [0, 5, 10]] -= 1e5 * BETA**2
            prepare_volumes(m, A, w, volumes, BETA**2)
            found = pcg.solve(m, A, volumes, w, 1e-10, 1000)
            assert found.negative and np.sum(w.y.to_numpy().reshape(-1) * rhs) > 0.0
    assert max(iterations) < 1.2 * min(iterations) < 100


def test_bordered_solves_leave_the_preconditioner_as_it_was():
    """A tendon of given length is solved for by block Jacobi, on the same matrix."""
    scene = beam(0.499)
    scene.add_tendon([("body", (-1.9, 0.0, 0.0)), ("body", (1.9, 0.0, 0.0))], length=3.7)
    with stepped(scene) as made:
        made.stepper.advance(1, BETA)
        system = made.stepper.solver
        system.form_matrix()
        found = []
        for _ in range(2):
            system.work.pcg.rhs.from_numpy(np.random.default_rng(0).standard_normal((made.model.n_nodes, 3)))
            found.append((system.solve_linear(1e-8), system.work.pcg.y.to_numpy()))
            system.multipliers.measure()
            assert system.multipliers.penalised and solve_constrained(system, 1e-8).converged
        assert found[0][0] == found[1][0] and found[0][0].converged and np.array_equal(found[0][1], found[1][1])


def test_steps_keep_the_volumes_to_second_order():
    """A curved step ends at the dilatations that its direction leads to in first order, but for a small fraction of the second:
    the patches are stiff, not rigid."""
    with stepped(beam(0.499)) as made:
        made.stepper.advance(1, BETA)
        system, m = made.stepper.solver, made.model
        s, w, free, x = system.linear_solver.volumes(), system.work, m.free.to_numpy(), m.state.x.to_numpy()
        spin = free * np.cross([0.0, 0.3, 0.4], x - [-2, 0, 0]) + free * 0.02 * np.sin(x[:, [1, 2, 0]])
        system.form_matrix()
        system.linear_solver.prepare(BETA)
        errors = []
        for length in (1.0, 0.5):
            m.state.x.from_numpy(x)
            system.evaluate()
            w.pcg.y.from_numpy(length * spin)
            assert system.step_with_volumes(math.inf) is not None
            moved, curved, target = m.state.x.to_numpy(), m.mean.dilatation.to_numpy(), s.target.to_numpy()
            assert np.allclose(m.state.v.to_numpy(), (moved - w.x_hat.to_numpy()) / BETA)
            assert np.array_equal(moved[free == 0], x[free == 0])
            m.state.x.from_numpy(x + BETA * length * spin)
            system.evaluate()
            errors.append((np.abs(curved - target).max(), np.abs(m.mean.dilatation.to_numpy() - target).max()))
        (curved, straight), (curved_half, straight_half) = errors
        assert 3.5 < straight / straight_half < 4.5 and curved < 0.05 * straight and curved_half < 0.05 * straight_half
        m.state.x.from_numpy(x)
        system.evaluate()
        assert system.step_with_volumes(0.0) is None and np.array_equal(m.state.x.to_numpy(), x)
        kept = m.mean.dilatation.to_numpy()
        save_volumes(m, s)
        moved = x + 1e-3 * spin * x[:, [2, 0, 1]]
        m.state.x.from_numpy(moved)
        system.evaluate()
        apart = np.abs(m.mean.dilatation.to_numpy() - kept).max()
        restore_volumes(m, s, w.x_hat, BETA)
        system.evaluate()
        assert np.abs(m.mean.dilatation.to_numpy() - kept).max() < 0.1 * apart and np.abs(m.state.x.to_numpy() - x).max() > 1e-6
