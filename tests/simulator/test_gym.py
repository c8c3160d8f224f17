"""`ts.gym`: environments pass gymnasium's check, repeat bitwise by seed and actions, beside each other and in forked processes;
what breaks a rule is refused by name; a failed simulation ends the episode, and says why.
"""

import subprocess
import sys

import numpy as np
import pytest

import taisoft as ts
from tests.dynamics.scenes import SVK
from tests.simulator.scenes import DT, pair

gymnasium = pytest.importorskip("gymnasium")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AsyncVectorEnv  # noqa: E402

SOLVER = {"dt": DT, "integrator": "velocity_verlet", "precision": "f64"}
ACTIONS = np.random.default_rng(3).uniform(-9, 9, (4, 2)).astype(np.float32)


def build() -> ts.Scene:
    return pair(SVK, 0.5)


def tilt(sim, action) -> None:
    """Gravity to the sides."""
    sim.set_gravity((*action, 0.0))


def tip(sim):
    return sim.positions("flyer").mean(axis=0)


def rise(sim) -> float:
    return sim.velocities("flyer")[:, 1].mean()


def push(sim, rng) -> None:
    sim.set_state(velocities=sim.velocities() + rng.normal(size=3))


def make(**changes):
    sides = ts.gym.Box([("sideways", -10, 10, "m/s^2"), ("up", -10, 10, "m/s^2")])
    given = {"scene": build, "action": tilt, "observation": tip, "reward": rise, "start": push, "action_space": sides}
    return ts.gym.Env(**given | {"solver": SOLVER, "frame_skip": 3, "render_mode": "rgb_array", "size": (32, 24)} | changes)


@pytest.fixture(scope="module")
def shared_env():
    made = make()
    yield made
    made.close()
    made.close()


@pytest.fixture
def env(shared_env, monkeypatch):
    """In a new episode; what tests replace by `monkeypatch` is restored."""
    shared_env.reset(seed=1)
    return shared_env


def episode(env, seed: int) -> list:
    found = [env.reset(seed=seed)[0]]
    for action in ACTIONS:
        observation, reward, *_ = env.step(action)
        found += [observation, reward]
    return found


def same(a: list, b: list) -> bool:
    return all(np.array_equal(one, two) for one, two in zip(a, b, strict=True))


@pytest.mark.filterwarnings("ignore::UserWarning")  # what gymnasium recommends
def test_gymnasiums_check_passes(env):
    check_env(env)
    assert repr(env.action_space) == "Box(sideways: -10 to 10 m/s^2, up: -10 to 10 m/s^2)"
    assert env.observation_space == gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    assert env.metadata["render_fps"] == pytest.approx(1 / (3 * DT))


def test_a_step_applies_the_action_and_takes_frame_skip_steps(env):
    with ts.Simulator(build(), **SOLVER) as sim:
        sim.set_state(velocities=env.sim.velocities())
        sim.set_gravity((0.0, 5.0, 0.0))
        assert sim.advance(3).steps == 3
        expected = sim.positions(), rise(sim)
    observation, reward, terminated, truncated, info = env.step(np.array([0.0, 5.0]))
    assert env.sim.step_count == 3 and same(expected, (env.sim.positions(), reward))
    assert observation.dtype == np.float32 and np.array_equal(observation, tip(env.sim).astype(np.float32))
    assert not terminated and not truncated and info["time"] == env.sim.time == pytest.approx(3 * DT)
    assert info["degraded"] == info["n_contacts"] == 0 and not info["failed"] and info["problems"] == []


def test_seeds_repeat_bitwise_also_beside_another_environment(env):
    first, other = episode(env, 7), make()
    try:
        assert same(first, episode(env, 7)) and same(first, episode(other, 7)) and same(first, episode(env, 7))
        assert not same(first, episode(env, 8))
    finally:
        other.close()


def test_forked_environments_agree_with_those_of_their_parent(env):
    """Though Taichi runs in the parent."""
    envs = AsyncVectorEnv([make, make], context="fork")
    try:
        found = [envs.reset(seed=[7, 8])[0]]
        for action in ACTIONS:
            observation, reward, *_ = envs.step(np.stack([action, action]))
            found += [observation, reward]
    finally:
        envs.close()
    assert all(same([row[k] for row in found], episode(env, 7 + k)) for k in range(2))


def test_a_problem_counts_and_a_failure_terminates(env):
    x = env.sim.positions()
    x[12:] = x[12:] * [-0.9, 1.0, 1.0]  # the flyer is inverted
    env.sim.set_state(positions=x)
    *_, info = env.step(ACTIONS[0])
    assert info["degraded"] == 3 and info["problems"] and not info["failed"] and info["min_volume_ratio"] < 0.0
    good, v = env.sim.positions(), env.sim.velocities()
    v[14] = 1e200
    env.sim.set_state(velocities=v)
    observation, reward, terminated, truncated, info = env.step(ACTIONS[0])
    assert terminated and not truncated and info["failed"] and "body 'flyer', node 2" in info["problems"][-1]
    assert np.array_equal(good, env.sim.positions()) and np.isfinite(observation).all() and np.isfinite(reward)
    assert {"n_contacts", "max_penetration", "min_volume_ratio"} <= set(info)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(ACTIONS[0])
    assert env.reset(seed=1)[1]["degraded"] == 0


def test_after_a_reset_that_fails_no_episode_runs(env, monkeypatch):
    monkeypatch.setattr(env, "_start", lambda sim, rng: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        env.reset()
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(ACTIONS[0])


def test_integers_are_not_changed():
    counted = gymnasium.spaces.Box(0, 255, (1,), np.uint8)
    for value in (1.5, 300):
        with pytest.raises(ts.SceneError, match="an observation must be numbers of type uint8"):
            make(observation=lambda sim, value=value: [value], observation_space=counted)


def test_an_episode_ends_when_terminated_says_so():
    with make(terminated=lambda sim: sim.step_count > 3, frame_skip=2) as env:
        env.reset()
        assert [env.step(ACTIONS[0])[2] for _ in range(2)] == [False, True]


def test_pictures(env):
    picture = env.render()
    assert picture.shape == (24, 32, 3) and picture.dtype == np.uint8 and len(np.unique(picture)) > 10
    env.step(ACTIONS[0])
    assert not np.array_equal(picture, env.render())


@pytest.mark.parametrize(
    "action, text",
    [
        ([1.0], r"an action must have shape \(2,\), not \(1,\)"),
        ("left", r"an action must be numbers of type float32 and shape \(2,\), not 'left'"),
        ([0.0, 11.0], r"action: 1 \('up'\) is 11 m/s\^2, outside of -10 to 10 m/s\^2: gymnasium.wrappers.ClipAction"),
        ([np.nan, 0.0], r"action: 0 \('sideways'\) is nan"),
    ],
)
def test_actions_outside_of_the_space_are_refused_before_the_step(env, action, text):
    with pytest.raises(ts.SceneError, match=text):
        env.step(action)
    assert env.sim.step_count == 0


@pytest.mark.parametrize(
    "changes, error, text",
    [
        ({"reward": None}, ts.SceneError, "reward must be a function of the simulator, not None"),
        ({"action_space": 3}, ts.SceneError, "action_space must be a ts.gym.Box or another space of gymnasium, not 3"),
        ({"frame_skip": 0}, ts.SceneError, "frame_skip must be a whole number of at least 1, not 0"),
        ({"render_mode": "human"}, ts.SceneError, "render_mode must be one of rgb_array, not 'human'"),
        ({"view": [1.0, 2.0]}, ts.SceneError, r"view must have shape \(2, 3\), not \(2,\)"),
        ({"scene": dict}, ts.SceneError, "scene must be a Scene, not dict"),
        ({"scene": "hanging_bean"}, ts.SceneError, "did you mean hanging_beam"),
        ({"observation": lambda sim: [np.nan]}, ts.SceneError, "observation: number 0 is not finite at t = 0 s"),
        ({"observation": lambda sim: ["a"]}, ts.SceneError, "an observation must be numbers of type float32"),
    ],
)
def test_arguments_that_break_a_rule_are_refused(changes, error, text):
    with pytest.raises(error, match=text):
        make(**changes)


def test_numbers_that_are_not_finite_are_named(env):
    nan, height = make(reward=lambda sim: np.nan), ts.gym.Box([("height", 0, np.inf, "m")])
    with nan, pytest.raises(ts.SceneError, match=r"reward: it returned nan at t = 0.006 s, a finite number is needed"):
        nan.reset()
        nan.step(ACTIONS[0])
    with pytest.raises(ts.SceneError, match=r"an observation must have shape \(1,\), not \(3,\)"):
        make(observation_space=height)
    for row in (("x", 0, 1), ("x", 2, 1, "m"), ("x", "low", 1, "m")):
        with pytest.raises(ts.SceneError, match=r"row 0 of a ts.gym.Box must be \(name, low, high, unit\)"):
            ts.gym.Box([row])


def test_without_gymnasium_it_says_how_to_get_it():
    program = (
        "import sys; sys.modules['gymnasium'] = None\nimport taisoft\ntry: taisoft.gym\nexcept taisoft.SceneError as e: print(e)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "ts.gym needs the package gymnasium, which is missing: pip install 'taisoft[gym]'\n"
