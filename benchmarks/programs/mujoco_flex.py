"""MuJoCo's flex on the falling beam of exact_path.py: same vertices, tets, law and lumped masses, undamped, no contact.

A flex of dim 3 with elasticity is St. Venant-Kirchhoff on linear tets. Before version 4.0 it used twice the first Lamé
parameter, so older versions are refused. Every free node is a body of the node's mass with three slide joints, every
fixed node belongs to the world. All that this scene does not need is switched off.

Elasticity is integrated in two ways (MuJoCo's own names); `implicit` and `implicitfast` refuse a flex with elasticity:
* explicitly by `Euler` (v first, then x with the new v) and `RK4`. Euler's path is of first order in dt only because of
  its start: begun with the velocity of half a step before, v = -a(0) dt/2, the same steps are leapfrog, of second
  order. That costs a user one line and is listed as "euler_staggered";
* implicitly by `discrete`: (M + dt^2 K) a = f - dt K v, one linear solve a step, K kept positive. Here, without
  constraints, the same iterative solve runs whichever of its solvers is named (equal paths and times were measured).

`python -m benchmarks.programs.mujoco_flex` prints the table. Its step sizes divide the 10 ms between two samples; those of
`euler` and `rk4` are the largest such ones that stay stable for the whole second.
"""

import argparse
import contextlib
import time
import warnings

import numpy as np

from taisoft.errors import SceneError, SimulationError
from taisoft.timing import load_average, machine, summarise, versions

from ..exact_path import DENSITY, FOLDING_STARTS, GRAVITY, MESHES, POISSON, SAMPLE, SECONDS, SIZE, YOUNG, FallingBeam, load_exact

INTEGRATORS = ("euler", "euler_staggered", "rk4", "discrete")
# For each mesh the smallest number of steps within 10 ms that is stable for 1 s, (Euler, RK4): one step fewer diverges.
STABLE_STEPS = {(12, 3, 3): (2, 2), (24, 6, 6): (5, 3), (48, 12, 12): (11, 7)}
IMPLICIT_STEPS = (1, 2, 4, 10)  # dt = 10, 5, 2.5, 1 ms
# Relative tolerance of the implicit step's linear solve. From 1e-8 (MuJoCo's default) to 1e-4 the error of the path
# changes by less than 1e-3 of itself at dt = 10 ms, and 1e-4 is a sixth to a third faster; 1e-3 begins to show.
TOLERANCE = 1e-4
SWITCHED_OFF = (
    "CONSTRAINT EQUALITY FRICTIONLOSS LIMIT CONTACT DAMPER CLAMPCTRL WARMSTART ACTUATION REFSAFE SENSOR MIDPHASE "
    "EULERDAMP AUTORESET ISLAND"
).split()
FALSE_ALARM = "flex 'beam' is not rigid and has no equality constraints or passive forces"  # it counts no elasticity


def run_mujoco(
    cells, integrator: str, dt: float, seconds: float = SECONDS, *, tolerance: float = TOLERANCE, repeats: int = 1
) -> dict:
    """Let the beam fall for `seconds` [s] in steps of `dt` [s]; both within the stored second, dt a divisor of 10 ms.

    cells: a mesh of exact_path.MESHES. integrator: one of INTEGRATORS. tolerance: of the linear solve of "discrete".
    repeats: whole runs that are timed; the path is the first one's.
    Returns a dict: path (k,3) [m] of the tip every 10 ms, t (k,) [s], error (see ExactPath.error), error_unfolded
    (the same up to t = 0.8 s), seconds_per_step (median over the 10 ms pieces), step_timing (the Timing it comes from),
    seconds_per_simulated_second (median over the repeats), compile_seconds, load (1 minute; before, after), settings.
    Raises SceneError for arguments outside these rules, SimulationError where the run diverges.
    """
    mujoco = import_mujoco()
    steps = _steps_per_sample(dt, seconds, integrator)
    exact, beam = load_exact(cells), FallingBeam(cells)
    load_before, start = load_average(), time.perf_counter()
    model = build_model(mujoco, beam, integrator, dt, tolerance)
    compile_seconds = time.perf_counter() - start
    pieces, totals, path = [], [], None
    for _ in range(repeats):
        run_path, run_pieces = _simulate(mujoco, model, beam, integrator, steps, round(seconds / SAMPLE))
        path = run_path if path is None else path
        pieces.append(run_pieces / steps)
        totals.append(run_pieces.sum() / seconds)
    times = np.arange(len(path)) * SAMPLE
    step_timing = summarise(np.concatenate(pieces))
    return {
        "path": path,
        "t": times,
        "error": exact.error(times, path),
        "error_unfolded": exact.error(times, path, until=FOLDING_STARTS),
        "seconds_per_step": step_timing.median,
        "step_timing": step_timing,
        "seconds_per_simulated_second": float(np.median(totals)),
        "compile_seconds": compile_seconds,
        "load": (load_before, load_average()),
        "settings": _settings(mujoco, model, integrator),
    }


def build_model(mujoco, beam: FallingBeam, integrator: str, dt: float, tolerance: float = TOLERANCE):
    """MuJoCo's model of the beam; degrees of freedom 3 i, 3 i + 1, 3 i + 2 are x, y, z of the i-th free node."""
    spec = mujoco.MjSpec()
    spec.option.timestep = dt
    spec.option.gravity = (0.0, -GRAVITY, 0.0)
    spec.option.tolerance = tolerance
    spec.option.solver = mujoco.mjtSolver.mjSOL_CG
    names = {"rk4": "RK4", "discrete": "DISCRETE"}
    spec.option.integrator = getattr(mujoco.mjtIntegrator, "mjINT_" + names.get(integrator, "EULER"))
    spec.option.disableflags = sum(int(getattr(mujoco.mjtDisableBit, "mjDSBL_" + name)) for name in SWITCHED_OFF)
    add_flex(mujoco, spec, "beam", beam.vertices, beam.tets, beam.mass, beam.free, YOUNG, contype=0, conaffinity=0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=FALSE_ALARM)
        return spec.compile()


def add_flex(mujoco, spec, name: str, vertices, tets, mass, free, young: float, **contact) -> None:
    """A flex named so, of vertices (n,3) [m], tets (m,4), mass (n,) [kg], free (n,) bool and young [Pa].

    A body of its mass with three slides for every free node, and the flex on them. contact: arguments of add_flex.
    """
    owners = []
    for node, (position, kg, is_free) in enumerate(zip(vertices, mass, free)):
        owners.append(f"{name} {node}" if is_free else "world")
        if is_free:
            # A body must have an inertia; without a rotation it plays no part.
            inertial = {"mass": kg, "inertia": [kg * 1e-3] * 3, "explicitinertial": True}
            body = spec.worldbody.add_body(name=owners[-1], pos=position, **inertial)
            for axis in np.eye(3):
                body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    flex = spec.add_flex(name=name, dim=3, young=young, poisson=POISSON, damping=0.0, **contact)
    flex.selfcollide = mujoco.mjtFlexSelf.mjFLEXSELF_NONE
    flex.vertbody = owners
    flex.vert = np.where(free[:, None], 0.0, vertices).ravel()  # in the frame of the owner
    flex.elem = tets.ravel().astype(int)


def _simulate(mujoco, model, beam: FallingBeam, integrator: str, steps: int, samples: int):
    """Path of the tip (samples + 1, 3) [m] and the wall time of each piece of `steps` steps (samples,) [s]."""
    data = mujoco.MjData(model)
    if integrator == "euler_staggered":
        data.qvel[1::3] = GRAVITY * model.opt.timestep / 2  # -a(0) dt/2: at rest gravity alone accelerates
    rank = np.cumsum(beam.free) - 1
    tip = (3 * rank[beam.tip, None] + np.arange(3)).ravel()
    path = np.tile(beam.vertices[beam.tip].mean(axis=0), (samples + 1, 1))
    pieces = np.empty(samples)
    with quiet_warnings(mujoco):
        for k in range(samples):
            start = time.perf_counter()
            mujoco.mj_step(model, data, nstep=steps)
            pieces[k] = time.perf_counter() - start
            path[k + 1] += data.qpos[tip].reshape(-1, 3).mean(axis=0)
            if any(warning.number for warning in data.warning) or not np.isfinite(path[k + 1]).all():
                raise SimulationError(
                    f"MuJoCo's {integrator} with dt = {model.opt.timestep:g} s diverges on the mesh {beam.cells} "
                    f"before t = {(k + 1) * SAMPLE:.2f} s"
                )
    return path, pieces


def _settings(mujoco, model, integrator: str) -> dict:
    """Everything that decides the result, in MuJoCo's own words."""
    settings = {
        "mujoco": mujoco.__version__,
        "integrator": mujoco.mjtIntegrator(model.opt.integrator).name,
        "start": "v = -a dt/2" if integrator == "euler_staggered" else "v = 0",
        "timestep": float(model.opt.timestep),
        "disabled": SWITCHED_OFF,
        "flex": {"dim": 3, "young": YOUNG, "poisson": POISSON, "damping": 0.0, "density": DENSITY, "size": SIZE},
        "precision": "float64",
        "threads": 1,
    }
    if integrator == "discrete":
        settings |= {
            "solver": mujoco.mjtSolver(model.opt.solver).name,
            "tolerance": float(model.opt.tolerance),
            "iterations": int(model.opt.iterations),
        }
    return settings


def _steps_per_sample(dt: float, seconds: float, integrator: str) -> int:
    if integrator not in INTEGRATORS:
        raise SceneError(f"integrator must be one of {', '.join(INTEGRATORS)}, not {integrator!r}")
    steps = round(SAMPLE / dt) if dt > 0 else 0
    if steps < 1 or abs(steps * dt - SAMPLE) > 1e-9 * SAMPLE:
        raise SceneError(f"dt must divide the {SAMPLE} s between two samples, not {dt} s")
    samples = round(seconds / SAMPLE)
    if not 1 <= samples <= round(SECONDS / SAMPLE) or abs(samples * SAMPLE - seconds) > 1e-9:
        raise SceneError(f"seconds must be a multiple of {SAMPLE} s up to {SECONDS} s, not {seconds} s")
    return steps


def import_mujoco():
    try:
        import mujoco
    except ImportError:
        raise SimulationError("the comparison with MuJoCo needs the package mujoco, version 4.0 or later") from None
    if int(mujoco.__version__.split(".")[0]) < 4:
        raise SimulationError(
            f"mujoco {mujoco.__version__} doubles the first Lamé parameter of a 3D flex: version 4.0 or later is needed"
        )
    return mujoco


@contextlib.contextmanager
def quiet_warnings(mujoco):
    """Warnings are read from the data afterwards: keep MuJoCo from printing them and from writing a log file."""
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(None)


def table_rows(cells):
    """(integrator, number of steps in 10 ms) of the table's rows for the mesh `cells`."""
    euler, rk4 = STABLE_STEPS[tuple(cells)]
    explicit = [(name, n) for name in ("euler", "euler_staggered") for n in (euler, 2 * euler)] + [("rk4", rk4)]
    return explicit + [("discrete", n) for n in IMPLICIT_STEPS]


HEADER = "  tets  integrator      dt [ms]  us/step   least  spread  s/sim. s     error   (0.8 s)  build [s]  load"


def _row(tets: int, integrator: str, dt: float, r: dict) -> str:
    step, load = r["step_timing"], "/".join("?" if x is None else f"{x:.1f}" for x in r["load"])
    return (
        f"{tets:6d}  {integrator:16s} {1e3 * dt:6.3f} {1e6 * step.median:8.1f} {1e6 * step.minimum:7.1f} "
        f"{step.spread:7.1%} {r['seconds_per_simulated_second']:9.4f} {r['error']:9.4%} {r['error_unfolded']:9.4%} "
        f"{r['compile_seconds']:10.2f}  {load}"
    )


def main(arguments=None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--meshes", type=int, default=len(MESHES), help="how many of the meshes, smallest first")
    parser.add_argument("--repeats", type=int, default=3, help="whole runs timed per row; one above 10,000 tets")
    options = parser.parse_args(arguments)
    print(machine(), versions("mujoco", "numpy"), sep="\n")
    print("error: largest distance of the tip to the exact path up to 1 s, and up to 0.8 s, over its excursion")
    print(HEADER)
    for cells in MESHES[: options.meshes]:
        tets = 5 * int(np.prod(cells))
        for integrator, n in table_rows(cells):
            result = run_mujoco(cells, integrator, SAMPLE / n, repeats=options.repeats if tets < 10_000 else 1)
            print(_row(tets, integrator, SAMPLE / n, result), flush=True)


if __name__ == "__main__":
    main()
