"""What an episode costs: environments of `ts.gym`, one by one and sixteen in processes, and MuJoCo's flex beside them.

taisoft bench gym [--quick] [--out [FILE.json]]

The first table is of a block of 400 tets that stands on the ground, with two tendons that do nothing. A step is 10 ms: an
implicit step, or twenty explicit ones in a batch. Functions are trivial, so that `step` less `sim.advance` is what the
environment adds; blocks of both are timed in turn. "vector" is gymnasium's AsyncVectorEnv of one process, from its start to the
end of the first `reset`, with the environment that it makes in its own process to read the spaces. The first step, with cached
kernels, is of the first environment of its kind in this process.

The second table is of works of `taisoft bench peers`, whose page has their errors: W1, a hanging beam of 540 tets, and W2, a
cube of 5,000 tets that drops on the ground. An environment's step is 50 ms. Of W1, both programs have St. Venant-Kirchhoff's
law and the fastest setting with an error of at most 1 %. Of W2, MuJoCo's errors remain above 4 %, which takes the setting here.
Several environments are processes of AsyncVectorEnv, each on one thread (TAISOFT_THREADS=1); rates are steps of single
environments a second, medians over rounds. MuJoCo's are environments of the same form. --quick: few steps, two processes, W1.
"""

import os
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np

import taisoft as ts
from taisoft.errors import TaisoftError

from .document import Document, Limit, begin, table
from .exact_path import SAMPLE
from .programs import mujoco_flex, own
from .programs.session import Setting, problem
from .runner import patched, progress, quick_options, without_warnings
from .works.evaluation import evaluate
from .works.references import MUJOCO, TAISOFT
from .works.scenes import WORKS, Work

BLOCK = 20  # consecutive steps that are timed together
STEP = 5  # samples of 10 ms in a step
PROCESSES, ROUNDS = 16, 3
F32 = {"precision": "f32", "arch": "cpu"}
SETTINGS = {  # work -> those compared
    "W1 12x3x3": (Setting(own.NAME, MUJOCO, "velocity_verlet", 3, F32), Setting("MuJoCo", MUJOCO, "euler_staggered", 2)),
    "W2": (
        Setting(own.NAME, TAISOFT, "velocity_verlet", 3, F32),
        Setting("MuJoCo", MUJOCO, "discrete", 4, {"passive": True, "radius": mujoco_flex.RADIUS}),
    ),
}
INTEGRATORS = {"implicit_euler": 1, "symplectic_euler": 20}  # with their steps in 10 ms
MOST_RESET, MOST_OVERHEAD = 1e-4, 0.05  # [s], and over a step


# --- a block of 400 tets --------------------------------------------------------------------------------------------------


def block() -> ts.Scene:
    """A block of 4 x 5 x 4 cells on the ground, with two tendons."""
    scene, size = ts.Scene(), np.array([0.1, 0.125, 0.1])
    material = ts.Material(young=1e5, poisson=0.4, density=1000.0, friction=0.8)
    scene.add_body(ts.box_mesh((4, 5, 4), size), material, name="block", position=(0, 0.5 * size[1] + 1e-4, 0))
    scene.add_ground(friction=0.8)
    for name, x in (("back", -0.05), ("front", 0.05)):
        scene.add_tendon([("block", (x, y, 0)) for y in (-0.06, 0.0, 0.06)], force=0.0, name=name)
    return scene


def nothing(sim, action) -> None:
    """An action without effect."""


def height(sim) -> tuple[float]:
    """An observation that costs nothing."""
    return (0.0,)


def zero(sim) -> float:
    """A reward that costs nothing."""
    return 0.0


def make_block(integrator: str) -> "ts.gym.Env":
    """The environment of the block."""
    steps = INTEGRATORS[integrator]
    given = {"frame_skip": steps, "solver": {"dt": 0.01 / steps, "integrator": integrator}, "render_mode": "rgb_array"}
    space = ts.gym.Box([("back", 0, 5, "N"), ("front", 0, 5, "N")])
    return ts.gym.Env(block, nothing, height, zero, action_space=space, **given)


def seconds_of(call: Callable[[], object], times: int = 1) -> float:
    """Wall seconds of calls."""
    start = time.perf_counter()
    for _ in range(times):
        call()
    return time.perf_counter() - start


def measure_block(integrator: str, times: int) -> dict:
    """Seconds of all that an episode consists of."""
    make = partial(make_block, integrator)
    start = time.perf_counter()
    with make() as env:
        found, step = {"make": time.perf_counter() - start}, partial(env.step, env.action_space.low)
        found |= {"first reset": seconds_of(env.reset), "first step": seconds_of(step)}
        seconds_of(step, 20)  # it lands
        advance = partial(env.sim.advance, env.frame_skip)
        pairs = [(seconds_of(step, BLOCK), seconds_of(advance, BLOCK)) for _ in range(times // BLOCK)]
        found["step"], found["advance"] = (np.median(pairs, axis=0) / BLOCK).tolist()
        for name, reset in (("reset", env.reset), ("sim.reset", env.sim.reset)):
            resets = []
            for _ in range(times // 10):
                env.sim.advance(1)
                resets.append(seconds_of(reset))
            found[name] = float(np.median(resets))
        env.render()
        found["picture"] = float(np.median([seconds_of(env.render) for _ in range(10)]))
    start = time.perf_counter()
    envs = vector([make])
    envs.reset()
    found["vector"] = time.perf_counter() - start
    envs.close()
    return found


def vector(makes: list[Callable]):
    """The environments in processes of one thread each."""
    from gymnasium.vector import AsyncVectorEnv

    with patched(os, "environ", os.environ | {"TAISOFT_THREADS": "1"}):
        return AsyncVectorEnv(makes, context="fork")


# --- works, beside MuJoCo ---------------------------------------------------------------------------------------------------


def tip(start: np.ndarray) -> np.ndarray:
    """The nodes (n,) bool that are observed: those at the right end."""
    return start[:, 0] > start[:, 0].max() - 1e-9


def make_own(work: Work, setting: Setting) -> "ts.gym.Env":
    """A work as an environment of taisoft."""
    at, space = tip(work.start), ts.gym.Box([("nothing", 0, 1, "")])
    solver = {"dt": setting.dt, "integrator": setting.method, **setting.options}
    given = (nothing, lambda sim: sim.positions()[at].mean(axis=0), zero)
    scene = own.make_scene(work, setting.model)
    return ts.gym.Env(scene, *given, action_space=space, frame_skip=STEP * setting.steps, solver=solver)


def make_flex(work: Work, setting: Setting):
    """The same of MuJoCo."""
    import gymnasium

    at, any_number = tip(work.start), partial(gymnasium.spaces.Box, -np.inf, np.inf)

    class FlexEnv(gymnasium.Env):
        """A session with the interface of gymnasium."""

        def __init__(self):
            self.session = mujoco_flex.Run(work, setting)
            self.session.mujoco.set_mju_user_warning(lambda message: None)
            self.action_space, self.observation_space = any_number((1,)), any_number((3,))

        def observed(self) -> np.ndarray:
            return self.session.positions()[at].mean(axis=0).astype(np.float32)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.session.reset()
            return self.observed(), {}

        def step(self, action):
            for _ in range(STEP):
                self.session.step()
            return self.observed(), 0.0, False, False, {}

    return FlexEnv()


PROGRAMS = {own.NAME: (own, make_own), mujoco_flex.NAME: (mujoco_flex, make_flex)}


def measure_work(work: Work, setting: Setting, processes: int, rounds: int) -> dict:
    """Error of a run of one second, and steps a second of one environment and of several, by round."""
    program, make = PROGRAMS[setting.program]
    found = {"work": work.key, "program": setting.program, "setting": str(setting), "dt": setting.dt, "processes": processes}
    session = program.Run(work, setting)
    positions, _ = session.run(follow=True)
    session.close()  # the evaluation needs a runtime in f64
    found["error"] = evaluate(work, setting.model, positions).error
    build, n = partial(make, work, setting), round(work.seconds / (STEP * SAMPLE))
    env, start = build(), time.perf_counter()
    envs = vector([build] * processes)
    found["start"] = time.perf_counter() - start
    one, all_of_them = [], []
    try:
        actions = np.zeros((processes, 1), np.float32)
        for _ in range(rounds + 1):
            env.reset()
            one.append(n / seconds_of(partial(env.step, actions[0]), n))
            envs.reset()
            all_of_them.append(processes * n / seconds_of(partial(envs.step, actions), n))
    finally:
        envs.close()
        env.close()
    return found | {"one": one[1:], "several": all_of_them[1:]}  # the first round compiles


# --- the page ---------------------------------------------------------------------------------------------------------------


def add_costs(document: Document, costs: dict[str, dict]) -> list[Limit]:
    """Add the table of costs; return the limits."""

    def ms(what: str) -> Callable:
        return lambda row: f"{1e3 * row[1][what]:.3g}"

    names = ("make", "vector", "first reset", "first step", "reset", "sim.reset", "step", "advance", "picture")
    columns = [("<[ms]", lambda row: row[0]), *((name, ms(name)) for name in names)]
    columns.append(("added to a step", lambda row: f"{overhead(row[1]):.1%}"))
    document.add("## A block of 400 tets\n\n" + table(costs.items(), columns))
    limits = [Limit(f"{name}: reset [ms]", 1e3 * c["reset"], 1e3 * MOST_RESET) for name, c in costs.items()]
    return limits + [Limit(f"{name}: added to a step", overhead(c), MOST_OVERHEAD) for name, c in costs.items()]


def overhead(cost: dict) -> float:
    """What the environment adds to a step, over the step."""
    return cost["step"] / cost["advance"] - 1.0


def add_works(document: Document, rows: list[dict], left_out: str) -> None:
    """Add the table of works."""

    def rate(what: str) -> Callable:
        return lambda row: f"{np.median(row[what]):,.0f} ({min(row[what]):,.0f} to {max(row[what]):,.0f})"

    columns = (
        ("<work", "{[work]}"),
        ("<program", "{[program]}"),
        ("<setting", "{[setting]}"),
        ("dt [ms]", lambda row: f"{1e3 * row['dt']:.3g}"),
        ("error", lambda row: f"{100 * row['error']:.2g} %"),
        ("steps/s of one", rate("one")),
        ("processes", "{[processes]}"),
        ("steps/s of all", rate("several")),
        ("their start [s]", lambda row: f"{row['start']:.2g}"),
    )
    document.add("## Steps a second\n\n" + table(rows, columns) + (f"\n\nMuJoCo is left out: {left_out}." if left_out else ""))


def main(argv=None) -> int:
    """Measure and print. Exit status: 0, or 1 if a limit is not met (not with --quick). Raises OutputError."""
    options = quick_options("gym", __doc__, argv, "few steps, two processes, W1 alone, no limits")
    quick, left_out = options.quick, problem(mujoco_flex)
    document, numbers = begin("What an episode costs", "arch cpu", packages=("taichi", "gymnasium", "mujoco-core", "numpy"))
    costs = {}
    for name in INTEGRATORS:
        progress(name)
        costs[name] = measure_block(name, BLOCK if quick else 1000)
    limits, rows = add_costs(document, costs), []
    for key in list(SETTINGS)[: 1 if quick else None]:
        work = next(work for work in WORKS if work.key == key)
        for setting in SETTINGS[key][: 1 if left_out else None]:
            progress(f"{key}, {setting.program}")
            try:
                with without_warnings():  # of tets that St. Venant-Kirchhoff's law folds
                    rows.append(measure_work(work, setting, 2 if quick else PROCESSES, 1 if quick else ROUNDS))
            except TaisoftError as error:
                document.add(f"{key}, {setting.program}: {error}")
    add_works(document, rows, left_out)
    return document.finish(options, numbers | {"costs": costs, "works": rows, "left_out": left_out}, () if quick else limits)


if __name__ == "__main__":
    sys.exit(main())
