"""Every domain as a Gymnasium environment: ids, sizes, ends, seeds; and simulators that live side by side."""

from __future__ import annotations

import importlib.util
import os
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable
from importlib.metadata import entry_points

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cudc_bench.envs import DOMAINS, env_id, make_simulators
from cudc_bench.envs.domains import DRIFT_TOLERANCE, STEP_TOLERANCE
from cudc_bench.envs.drawing import probe
from cudc_bench.envs.gym import SimulatorEnv
from cudc_bench.envs.simulator import MujocoSimulator, random_state
from cudc_bench.errors import UsageError

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

# Each mode of each takes a process that draws. A task changes the picture in nothing but Jaco's target.
DRAWN = {*map(env_id, DOMAINS), "cudc_bench/jaco-reach_top_left-v0"}


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
        check_env(gymnasium.make(one).unwrapped, skip_render_check=one not in DRAWN)
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


@pytest.mark.parametrize(
    "script",
    [
        "import sys, cudc_bench; light = 'gymnasium' not in sys.modules; import gymnasium",
        "import gymnasium, cudc_bench; light = True",
    ],
)
def test_importing_the_package_registers_the_ids_in_either_order(script: str, python: Callable) -> None:
    """And does not load Gymnasium, for which the command line would have to wait."""
    done = python(f"{script}; print(light, gymnasium.make('cudc_bench/walker-walk-v0').unwrapped.reset(seed=0)[0].shape)")
    assert done == (0, "True (24,)\n", "")


def test_gymnasium_can_import_the_package_itself(python: Callable) -> None:
    done = python("import gymnasium; print(gymnasium.make('cudc_bench:cudc_bench/jaco-v0').spec.max_episode_steps)")
    assert done == (0, "250\n", "")


def test_the_plug_in_group_of_gymnasium_names_what_registers() -> None:
    (point,) = entry_points(group="gymnasium.envs", name="cudc_bench")
    point.load()()
    assert set(IDS) <= set(gymnasium.registry)


def test_a_pickled_environment_is_the_same_one_anew() -> None:
    environment = gymnasium.make("cudc_bench/walker-walk-v0", width=64, camera="back")
    environment.reset(seed=1)
    copy = pickle.loads(pickle.dumps(environment))
    assert copy.spec == environment.spec
    action = np.full(6, 0.3, np.float32)
    found = []
    for one in (environment, copy):
        one.reset(seed=5)
        observation, reward, *_ = one.step(action)
        found.append((observation.tobytes(), reward))
    assert found[0] == found[1]
    assert found[0][1] > 0


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vectorised_environments_are_the_single_ones(mode: str) -> None:
    several = gymnasium.make_vec("cudc_bench/walker-walk-v0", num_envs=2, vectorization_mode=mode)
    try:
        several.reset(seed=7)
        observations, rewards, *_, info = several.step(np.full((2, 6), 0.3, np.float32))
    finally:
        several.close()
    for index in range(2):
        one = gymnasium.make("cudc_bench/walker-walk-v0")
        one.reset(seed=7 + index)
        observation, reward, *_, expected = one.step(np.full(6, 0.3, np.float32))
        assert observations[index].tobytes() == observation.tobytes()
        assert info["physics"][index].tobytes() == expected["physics"].tobytes()
        assert rewards[index] == reward


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (0.5, r"an action cannot have the shape \(\); walker takes 6 numbers in \[-1, 1\]: shape \(6,\)"),
        (np.zeros(1, np.float32), r"shape \(1,\)"),
        (np.zeros((1, 6), np.float32), r"shape \(1, 6\)"),
        (np.zeros(7), r"shape \(7,\)"),
        (["a"] * 6, "must be an array of numbers"),
        ([[1.0], [1.0, 2.0]], "must be an array of numbers"),
        (np.full(6, np.nan), "cannot hold nan"),
    ],
)
def test_what_is_no_action_is_refused_and_nothing_has_moved(action: object, message: str) -> None:
    environment = gymnasium.make("cudc_bench/walker-v0").unwrapped
    environment.reset(seed=0)
    assert isinstance(environment, SimulatorEnv)
    before = environment._state()
    with pytest.raises(UsageError, match=message):
        environment.step(action)  # type: ignore[arg-type]
    assert environment._state().tobytes() == before.tobytes()


def test_an_action_may_be_a_list() -> None:
    environment, results = gymnasium.make("cudc_bench/quadruped-v0").unwrapped, []
    for action in ([0.5] * 12, np.full(12, 0.5)):
        environment.reset(seed=0)
        results.append(environment.step(action)[0].tobytes())
    assert results[0] == results[1]


@pytest.mark.parametrize("name", FACTS)
def test_an_episode_can_be_taken_up_at_a_stored_state(name: str) -> None:
    domain, environment = DOMAINS[name], gymnasium.make(env_id(name))
    generator = np.random.default_rng(0)
    environment.reset(seed=0)
    actions = generator.uniform(-1, 1, (12, domain.action_size)).astype(np.float32)
    seen = [environment.step(action) for action in actions]
    observation, info = environment.reset(seed=1, options={"physics": seen[-2][4]["physics"]})
    assert info["physics"].tobytes() == seen[-2][4]["physics"].tobytes()
    determined = np.ones(domain.observation_size, np.bool_)
    for start, stop in domain.beyond_state:
        determined[start:stop] = False
    np.testing.assert_array_equal(observation[determined], seen[-2][0][determined])
    following = environment.step(actions[-1])[4]["physics"]
    # The arm in contact with the ground depends on what the solver remembers (0.17 at most, see envs/domains.py).
    tolerance = STEP_TOLERANCE if domain.drift_tolerance == DRIFT_TOLERANCE else 0.3
    assert (np.abs(following - seen[-1][4]["physics"]) <= tolerance * (1 + np.abs(following))).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"state": np.zeros(18)}, "unknown reset option 'state'; allowed: physics"),
        ({"physics": np.zeros(17)}, r"a stored state cannot have the shape \(17,\); walker has 18 numbers"),
        ({"physics": np.full(18, np.inf)}, "a stored state cannot hold inf"),
        ({"physics": np.full(18, 1e11)}, "numbers below 1e\\+10"),
    ],
)
def test_what_is_no_stored_state_is_refused(options: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        gymnasium.make("cudc_bench/walker-v0").reset(seed=0, options=options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"render_mode": "ansi"}, "unknown render mode 'ansi'; allowed: human, rgb_array"),
        ({"camera": "sid"}, "walker has no camera 'sid'.*Did you mean 'side'"),
        ({"width": 0}, "the width of frames is 16 to 4096 pixels, not 0"),
    ],
)
def test_what_cannot_be_drawn_is_refused_before_anything_is(arguments: dict, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        SimulatorEnv("walker", **arguments)


@pytest.fixture(scope="module")
def draws() -> None:
    if probe() is None:
        pytest.skip("nothing here can draw: neither EGL nor OSMesa is installed")


def test_frames_show_the_state_and_can_be_recorded(draws: None, tmp_path) -> None:
    environment = gymnasium.make("cudc_bench/walker-walk-v0", render_mode="rgb_array", width=96, height=64)
    assert environment.metadata["render_fps"] == 40  # control steps in a second
    recorded = environment
    if importlib.util.find_spec("moviepy") is not None:
        recorded = gymnasium.wrappers.RecordVideo(environment, str(tmp_path), disable_logger=True)
    recorded.reset(seed=0)
    first = environment.render()
    for _ in range(10):
        state = recorded.step(np.full(6, 0.5, np.float32))[4]["physics"]
    second = environment.render()
    assert first.shape == second.shape == (64, 96, 3)
    assert first.dtype == np.uint8
    assert (np.abs(first.astype(int) - second).max(-1) > 30).sum() > 40
    environment.reset(seed=3, options={"physics": state})
    assert (environment.render() == second).all()
    recorded.close()
    if recorded is not environment:
        assert [path.suffix for path in tmp_path.iterdir()] == [".mp4"]
    # What was drawn did not touch the episode.
    blind = gymnasium.make("cudc_bench/walker-walk-v0")
    blind.reset(seed=0)
    for _ in range(10):
        same = blind.step(np.full(6, 0.5, np.float32))[4]["physics"]
    assert same.tobytes() == state.tobytes()


def test_every_step_is_shown_in_a_window(draws: None, monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    environment = gymnasium.make("cudc_bench/walker-v0", render_mode="human", width=96, height=64)
    shown = []
    environment.reset(seed=0)
    for _ in range(2):
        environment.step(np.full(6, 0.5, np.float32))
        shown.append(pygame.surfarray.array3d(pygame.display.get_surface()))
    assert shown[0].shape == (96, 64, 3)
    assert (shown[0] != shown[1]).any()
    assert environment.render() is None
    environment.close()
    assert pygame.display.get_surface() is None


def test_without_pygame_a_window_is_refused_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cudc_bench.envs.window.find_spec", lambda name: None)
    with pytest.raises(UsageError, match="pip install pygame"):
        gymnasium.make("cudc_bench/walker-v0", render_mode="human")


def test_drawing_without_a_mode_is_remarked_upon() -> None:
    environment = gymnasium.make("cudc_bench/walker-v0").unwrapped
    environment.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert environment.render() is None
