"""Every domain as a Gymnasium environment: ids, sizes, ends, seeds; and simulators that live side by side."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cudc_bench.envs import DOMAINS, env_id, make_simulators
from cudc_bench.envs.simulator import MujocoSimulator, random_state

from ..waiting import PATIENCE

# Observations, actions, states, steps, largest return, seconds of a control step: spec of ExORL and dm_control.
FACTS = {
    "walker": (24, 6, 18, 1000, 1000.0, 0.025),
    "quadruped": (78, 12, 57, 1000, 1000.0, 0.02),
    "jaco": (42, 9, 18, 250, 250.0, 0.04),
}
TASKS = {
    "walker": ("stand", "walk", "run", "flip"),
    "quadruped": ("stand", "walk", "run", "jump"),
    "jaco": ("reach_top_left", "reach_top_right", "reach_bottom_left", "reach_bottom_right"),
}
IDS = {
    one: domain for domain, tasks in TASKS.items() for one in (f"cudc_bench/{domain}-v0", *(f"cudc_bench/{domain}-{t}-v0" for t in tasks))
}  # fmt: skip


def test_the_benchmark_has_three_domains_and_twelve_tasks() -> None:
    assert {name: domain.tasks for name, domain in DOMAINS.items()} == TASKS
    assert [env_id(name, task) for name, domain in DOMAINS.items() for task in (None, *domain.tasks)] == list(IDS)


@pytest.mark.parametrize("name", FACTS)
def test_sizes_are_those_of_the_model(name: str) -> None:
    domain = DOMAINS[name]
    sizes = (domain.observation_size, domain.action_size, domain.physics_size, domain.episode_length, domain.max_return)
    assert sizes == FACTS[name][:5]
    (simulator,) = make_simulators(name, 1)
    assert isinstance(simulator, MujocoSimulator)
    model = simulator.model
    assert (model.nu, model.nq + model.nv + model.na) == FACTS[name][1:3]
    assert model.opt.timestep * simulator.substeps == pytest.approx(FACTS[name][5])


@pytest.mark.parametrize("one", IDS)
def test_ids_are_registered_with_a_string_entry_point(one: str) -> None:
    spec = gymnasium.spec(one)
    assert spec.max_episode_steps == FACTS[IDS[one]][3]
    assert gymnasium.envs.registration.EnvSpec.from_json(spec.to_json()) == spec


@pytest.mark.parametrize("one", IDS)
def test_gymnasiums_checker_passes(one: str) -> None:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        check_env(gymnasium.make(one).unwrapped)
    # dm_control's observations are unbounded, on which Gymnasium always remarks.
    ours = [str(w.message) for w in found if "A Box observation space m" not in str(w.message)]
    assert ours == []


@pytest.mark.parametrize("one", IDS)
def test_sizes_and_time_limit(one: str) -> None:
    observations, actions, states, length, *_ = FACTS[IDS[one]]
    environment = gymnasium.make(one)
    observation, info = environment.reset(seed=0)
    assert observation.shape == environment.observation_space.shape == (observations,)
    assert observation.dtype == environment.observation_space.dtype == np.float32
    assert environment.action_space.shape == (actions,)
    assert (environment.action_space.low == -1).all()
    assert (environment.action_space.high == 1).all()
    assert info["physics"].shape == (states,)
    assert info["physics"].dtype == np.float64
    rates, rewards = np.random.default_rng(1).uniform(0.05, 0.6, actions), []
    for t in range(length):
        observation, reward, terminated, truncated, info = environment.step(np.sign(np.sin(rates * t)).astype(np.float32))
        rewards.append(reward)
        assert type(reward) is float
        assert not terminated
        assert truncated == (t == length - 1)
        assert observation in environment.observation_space
    if one in map(env_id, DOMAINS):
        assert set(rewards) == {0.0}
    else:
        assert 0 < sum(rewards) < length


@pytest.mark.parametrize("name", FACTS)
def test_simulators_made_together_do_not_touch_each_other(name: str) -> None:
    (alone,), (first, second) = make_simulators(name, 1), make_simulators(name, 2)
    generator = np.random.default_rng(0)
    alone.reset(3)
    first.reset(3)
    second.reset(4)
    for t in range(150):
        if t == 75:
            second.reset(5)  # an episode of its own
        action = generator.uniform(-1, 1, DOMAINS[name].action_size).astype(np.float32)
        alone.step(action)
        first.step(action)
        second.step(-action)
    expected, *others = (np.empty(DOMAINS[name].physics_size) for _ in range(3))
    for simulator, out in zip((alone, first, second), (expected, *others), strict=True):
        simulator.state(out)
    assert others[0].tobytes() == expected.tobytes()
    assert others[1].tobytes() != expected.tobytes()


@pytest.mark.parametrize("name", FACTS)
def test_actions_are_scaled_to_the_actuators_ranges(name: str) -> None:
    (simulator,) = make_simulators(name, 1)
    assert isinstance(simulator, MujocoSimulator)
    low, high = simulator.model.actuator_ctrlrange.T
    simulator.reset(0)
    for action, expected in ((-1.0, low), (1.0, high), (0.0, (low + high) / 2)):
        simulator.step(np.full(len(low), action, np.float32))
        np.testing.assert_allclose(simulator.data.ctrl, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", FACTS)
def test_a_state_that_is_set_is_the_state_and_its_observation(name: str) -> None:
    """Of the observation, what is a function of the state: the acceleration stage lags behind by a physics step."""
    hidden = {"walker": [], "quadruped": [*range(48, 51), *range(54, 78)], "jaco": [*range(12, 18)]}[name]
    (live, other), generator = make_simulators(name, 2), np.random.default_rng(0)
    live.reset(0)
    other.reset(1)
    states = [np.empty(DOMAINS[name].physics_size) for _ in range(2)]
    observations = [np.empty(DOMAINS[name].observation_size, np.float32) for _ in range(2)]
    differed = np.zeros(DOMAINS[name].observation_size, np.bool_)
    for _ in range(100):
        live.step(generator.uniform(-1, 1, DOMAINS[name].action_size).astype(np.float32))
        live.state(states[0])
        other.set_state(states[0])
        other.state(states[1])
        assert states[0].tobytes() == states[1].tobytes()
        live.observe(observations[0])
        other.observe(observations[1])
        differed |= observations[0] != observations[1]
    assert set(np.flatnonzero(differed)) <= set(hidden)
    assert differed.any() == bool(hidden)


@pytest.mark.parametrize("seed", [2**32, 2**40 + 1, 2**63 - 1])
def test_seeds_beyond_32_bits_are_accepted_and_deterministic(seed: int) -> None:
    environment = gymnasium.make("cudc_bench/walker-v0")
    first, info = environment.reset(seed=seed)
    environment.step(np.ones(6, np.float32))
    second, again = environment.reset(seed=seed)
    assert first.tobytes() == second.tobytes()
    assert info["physics"].tobytes() == again["physics"].tobytes()
    other, _ = environment.reset(seed=seed % 2**32)
    assert first.tobytes() != other.tobytes()


def test_a_small_seed_is_a_plain_random_state() -> None:
    assert random_state(2**32 - 1).uniform() == np.random.RandomState(2**32 - 1).uniform()


def test_resets_without_a_seed_continue_the_environments_own_stream() -> None:
    environment = gymnasium.make("cudc_bench/walker-v0")
    runs = []
    for _ in range(2):
        runs.append([environment.reset(seed=9)[0].tobytes(), *(environment.reset()[0].tobytes() for _ in range(3))])
    assert runs[0] == runs[1]
    assert len(set(runs[0])) == 4


@pytest.mark.parametrize("module", ["cudc_bench", "cudc_bench.envs"])
def test_import_without_a_display_is_silent_and_needs_no_gl(module: str, python: Callable) -> None:
    script = f"""
import sys
import {module}
import gymnasium, cudc_bench.envs
gymnasium.make("cudc_bench/walker-walk-v0").reset(seed=0)
import dm_control.suite
assert "mujoco" in sys.modules
print(sorted(name for name in sys.modules if name.split(".")[0] in ("glfw", "OpenGL")))
"""
    done = python(script, without=("DISPLAY", "MUJOCO_GL"))
    assert done == (0, "[]\n", "")


def test_variables_about_drawing_decide_nothing_where_nothing_draws() -> None:
    variables = {"MUJOCO_GL": "osmesa", "PYOPENGL_PLATFORM": "egl"}  # which never go together
    script = "import os, cudc_bench.envs.suite, gymnasium; gymnasium.make('cudc_bench/walker-walk-v0').reset(seed=1);"
    script += f"assert {{name: os.environ.get(name) for name in {list(variables)}}} == {variables}"
    done = subprocess.run([sys.executable, "-c", script], env=os.environ | variables, capture_output=True, text=True, timeout=PATIENCE)
    assert (done.returncode, done.stderr) == (0, "")
