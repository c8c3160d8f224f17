"""The comparison with MuJoCo is fair: it solves the same equations.

* Its masses, elastic forces and fixed nodes are those of the exact path's beam;
* its path converges to the exact one, with first order (Euler, discrete) or better (staggered start, RK4);
* invalid step sizes and names are refused, and a diverged run is an error;
* the stored step sizes are the largest stable ones (checked on the smallest mesh).
"""

import numpy as np
import pytest

from benchmarks.exact_path import FallingBeam
from taisoft.errors import SceneError, SimulationError

mujoco = pytest.importorskip("mujoco", minversion="4.0")

from benchmarks.programs.mujoco_flex import STABLE_STEPS, Run, run_mujoco  # noqa: E402
from benchmarks.programs.session import Setting  # noqa: E402
from benchmarks.works.references import MUJOCO  # noqa: E402
from benchmarks.works.scenes import hanging_beam  # noqa: E402

CELLS = (12, 3, 3)


def test_masses_and_elastic_forces_are_those_of_the_beam():
    beam = FallingBeam(CELLS)
    model = Run(hanging_beam(CELLS), Setting("MuJoCo", MUJOCO, "euler", 10)).model
    data = mujoco.MjData(model)
    u = 0.02 * np.random.default_rng(2).standard_normal(beam.vertices.shape) * beam.free[:, None]
    data.qpos[:] = u[beam.free].ravel()
    mujoco.mj_forward(model, data)
    assert model.nv == 3 * beam.free.sum()
    assert np.allclose(model.body_mass[1:], beam.mass[beam.free], rtol=1e-14)
    expected = beam.elastic_force(u.T).T[beam.free].ravel()
    assert np.abs(expected).max() > 1e3  # [N]: the elements are deformed
    assert np.abs(data.qfrc_passive - expected).max() < 1e-10 * np.abs(expected).max()
    expected_acceleration = beam.acceleration(u.T).T[beam.free].ravel()
    assert np.abs(data.qacc - expected_acceleration).max() < 1e-10 * np.abs(expected_acceleration).max()


@pytest.mark.parametrize(
    "integrator, dt, order, largest",
    [("euler", 2.5e-3, 1, 2e-3), ("euler_staggered", 2.5e-3, 2, 5e-5), ("discrete", 2.5e-3, 1, 5e-3), ("rk4", 5e-3, 4, 1e-5)],
)
def test_the_error_converges_with_the_order_of_the_integrator(integrator, dt, order, largest):
    coarse, fine = (run_mujoco(CELLS, integrator, h, seconds=0.7)["error"] for h in (dt, dt / 2))
    assert coarse < largest
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.25)


def test_a_result_holds_path_and_times():
    r = run_mujoco(CELLS, "discrete", 0.01, seconds=0.2)
    assert r["path"].shape == (21, 3) and np.allclose(r["t"], np.arange(21) * 0.01)
    assert np.allclose(r["path"][0], [2, 0, 0])
    assert r["seconds_per_simulated_second"] > 0.0 and r["compile_seconds"] > 0.0


def test_invalid_arguments_are_refused():
    with pytest.raises(SceneError, match="dt must divide the 0.01 s between two samples, not 0.003 s"):
        run_mujoco(CELLS, "euler", 0.003)
    with pytest.raises(SceneError, match="integrator must be one of .*, not 'implicitfast'"):
        run_mujoco(CELLS, "implicitfast", 0.001)
    with pytest.raises(SceneError, match="seconds must be a multiple of 0.01 s up to 1.0 s, not 2 s"):
        run_mujoco(CELLS, "euler", 0.001, seconds=2)


@pytest.mark.parametrize("integrator, steps", list(zip(("euler", "rk4"), STABLE_STEPS[CELLS])))
def test_the_stored_steps_are_the_largest_stable_ones(integrator, steps, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_mujoco(CELLS, integrator, 0.01 / steps)["error"] < 0.01
    with pytest.raises(SimulationError, match=f"MuJoCo's {integrator} with dt = .* diverges on the mesh"):
        run_mujoco(CELLS, integrator, 0.01 / (steps - 1))
    assert list(tmp_path.iterdir()) == []  # MuJoCo writes no log of warnings
