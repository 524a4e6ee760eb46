"""The fast Quadruped against dm_control itself."""

from __future__ import annotations

import numpy as np
import pytest
from dm_control import suite
from dm_control.suite import quadruped as dm_quadruped
from dm_control.suite.wrappers import action_scale
from dm_control.utils import rewards as dm_rewards
from hypothesis import given
from hypothesis import strategies as st

from cudc_bench.envs.quadruped import Quadruped, quadruped_rewards

T = 1000
NAMES = ("egocentric_state", "torso_velocity", "torso_upright", "imu", "force_torque")
INF = float("inf")


def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
    """dm_control's observation in dm_control's order, as stored."""
    return np.concatenate([np.ravel(observation[name]) for name in NAMES]).astype(np.float32)


def stand_reward(upright: float) -> float:
    """dm_control's factor of uprightness by itself, which is ExORL's stand."""
    return dm_rewards.tolerance(upright, bounds=(1.0, INF), sigmoid="linear", margin=2.0, value_at_margin=0)


def jump_reward(upright: float, height: float) -> float:
    """ExORL's jump, from dm_control's own parts."""
    return stand_reward(upright) * dm_rewards.tolerance(height, bounds=(1.0, INF), margin=1.0, value_at_margin=0.5, sigmoid="linear")


@pytest.mark.parametrize("seed", range(2))
def test_observations_states_and_rewards_are_dm_controls_bit_for_bit(seed: int) -> None:
    """Two episodes a seed, the second, a shorter one, reset from the generator that the first left behind."""
    plain = {task: suite.load("quadruped", task, task_kwargs={"random": seed}) for task in ("walk", "run")}
    environments = {task: action_scale.Wrapper(environment, -1.0, 1.0) for task, environment in plain.items()}
    ours, generator, actions = Quadruped(), np.random.RandomState(seed), np.random.default_rng(seed)
    rates = actions.uniform(0.05, 0.6, 12)
    spread = []
    for swinging in (False, True):
        steps = {task: environment.reset() for task, environment in environments.items()}
        ours.restart(generator)
        for t in range(T + 1):
            physics = plain["walk"].physics
            observation, state, quantities = np.full(78, np.nan, np.float32), np.full(57, np.nan), np.full(3, np.nan)
            ours.observe(observation)
            ours.state(state)
            ours.quantities(quantities)
            rewards = quadruped_rewards(quantities)
            for task, step in steps.items():
                assert observation.tobytes() == flat(step.observation).tobytes(), (task, t)
                assert state.tobytes() == plain[task].physics.state().tobytes(), (task, t)
            if t > 0:
                upright, height = float(physics.torso_upright()), float(physics.named.data.sensordata["center_of_mass"][2])
                expected = [stand_reward(upright), steps["walk"].reward, steps["run"].reward, jump_reward(upright, height)]
                assert rewards.tolist() == [float(value) for value in expected], t
                spread.append(rewards)
            if t < T:
                action = (np.sign(np.sin(rates * t)) if swinging else actions.uniform(-1, 1, 12)).astype(np.float32)
                ours.step(action)
                steps = {task: environment.step(action) for task, environment in environments.items()}
        assert all(step.last() and step.discount == 1.0 for step in steps.values())
    assert (np.ptp(np.stack(spread), axis=0) > 0.05).all(), "these episodes do not exercise the rewards"


@pytest.mark.parametrize("seed", [0, 7, 2**32 - 1])
def test_reset_with_a_seed_is_dm_controls_reset_with_that_seed(seed: int) -> None:
    environment = suite.load("quadruped", "walk", task_kwargs={"random": seed})
    step = environment.reset()
    ours, out, state = Quadruped(), np.empty(78, np.float32), np.empty(57)
    ours.reset(5)
    for _ in range(20):
        ours.step(np.ones(12, np.float32))  # what was before a reset leaves no trace
    ours.reset(seed)
    ours.observe(out)
    ours.state(state)
    assert out.tobytes() == flat(step.observation).tobytes()
    assert state.tobytes() == environment.physics.state().tobytes()


def test_an_episode_starts_where_nothing_touches_the_floor() -> None:
    ours, heights = Quadruped(), []
    for seed in range(20):
        ours.reset(seed)
        assert ours.data.ncon == 0
        heights.append(float(ours.data.qpos[2]))
    # Legs up or down: an arbitrary orientation needs an arbitrary height.
    assert max(heights) > 2 * min(heights) > 0


number = st.floats(-20, 20) | st.sampled_from([-1.0, 0.0, 0.25, 0.5, 1.0, 2.5, 5.0])


@given(st.floats(-1, 1), number, number)
def test_rewards_are_dm_controls_for_any_quantities(upright: float, speed: float, height: float) -> None:
    class Physics:
        """What dm_control's task asks of its physics."""

        def torso_upright(self) -> float:
            return upright

        def torso_velocity(self) -> list[float]:
            return [speed, 0.0, 0.0]

    moves = [dm_quadruped.Move(desired_speed=move).get_reward(Physics()) for move in (dm_quadruped._WALK_SPEED, dm_quadruped._RUN_SPEED)]
    found = quadruped_rewards(np.array([upright, speed, height]))
    assert found.tolist() == [stand_reward(upright), *moves, jump_reward(upright, height)]
    batch = quadruped_rewards(np.array([[0.1, 0.2, 0.3], [upright, speed, height]] * 9))
    assert batch[1::2].tolist() == [found.tolist()] * 9
