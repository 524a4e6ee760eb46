"""The fast Jaco arm against dm_control itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from dm_control import manipulation
from dm_control.suite.wrappers import action_scale
from dm_control.utils import rewards as dm_rewards
from hypothesis import given
from hypothesis import strategies as st

from cudc_bench.envs import DOMAINS
from cudc_bench.envs.jaco import Jaco, jaco_rewards

T = 250
CORNERS = {"top_left": (-0.09, 0.09), "top_right": (0.09, 0.09), "bottom_left": (-0.09, -0.09), "bottom_right": (0.09, -0.09)}


def original(seed: int) -> Any:
    """dm_control's own reaching task, whose target lies elsewhere and is observed, but touches nothing; it compiles for each episode."""
    return manipulation.load("reach_site_features", seed=seed)


def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
    """dm_control's observation in dm_control's order without the target, as stored."""
    return np.concatenate([np.ravel(value) for name, value in observation.items() if name != "target_position"]).astype(np.float32)


def reach_rewards(place: np.ndarray) -> list[float]:
    """ExORL's four rewards, one number at a time, from dm_control's own parts."""
    distances = [np.linalg.norm(place - np.array([*corner, 0.001])) for corner in CORNERS.values()]
    return [dm_rewards.tolerance(distance, bounds=(0, 0.05), margin=0.05) for distance in distances]


@pytest.mark.parametrize("seed", range(2))
def test_observations_states_and_rewards_are_dm_controls_bit_for_bit(seed: int) -> None:
    """Three whole episodes a seed, each reset from the generator that the one before left behind."""
    plain = original(seed)
    environment = action_scale.Wrapper(plain, -1.0, 1.0)
    ours, generator, actions = Jaco(), np.random.RandomState(seed), np.random.default_rng(seed)
    for rates in (None, actions.uniform(0.01, 0.2, 9), np.zeros(9)):
        step = environment.reset()
        ours.restart(generator)
        for t in range(T + 1):
            observation, state, quantities = np.full(42, np.nan, np.float32), np.full(18, np.nan), np.full(3, np.nan)
            ours.observe(observation)
            ours.state(state)
            ours.quantities(quantities)
            assert observation.tobytes() == flat(step.observation).tobytes(), t
            assert state.tobytes() == plain.physics.get_state().tobytes(), t
            # The tool centre point of dm_control's reward is what the observation calls the pinch site's position.
            place = plain.physics.bind(plain.task.hand.tool_center_point).xpos
            np.testing.assert_allclose(jaco_rewards(quantities), reach_rewards(place), rtol=0, atol=1e-15)
            if t < T:
                action = (actions.uniform(-1, 1, 9) if rates is None else np.sign(np.sin(rates * t))).astype(np.float32)
                ours.step(action)
                step = environment.step(action)
        assert step.last()
        assert step.discount == 1.0


@pytest.mark.parametrize("seed", [0, 7, 2**32 - 1])
def test_reset_with_a_seed_is_dm_controls_reset_with_that_seed(seed: int) -> None:
    environment = original(seed)
    step = environment.reset()
    ours, out, state = Jaco(), np.empty(42, np.float32), np.empty(18)
    ours.reset(5)
    for _ in range(20):
        ours.step(np.ones(9, np.float32))  # what was before a reset leaves no trace
    ours.reset(seed)
    ours.observe(out)
    ours.state(state)
    assert out.tobytes() == flat(step.observation).tobytes()
    assert state.tobytes() == environment.physics.get_state().tobytes()


def test_tasks_and_their_corners_are_in_one_order() -> None:
    assert DOMAINS["jaco"].tasks == tuple(f"reach_{corner}" for corner in CORNERS)
    for index, corner in enumerate(CORNERS.values()):
        rewards = jaco_rewards(np.array([*corner, 0.02]))
        assert rewards[index] == 1.0
        assert np.delete(rewards, index).max() < 0.01


@given(*[st.floats(-0.3, 0.3)] * 2, st.floats(-0.1, 0.6))
def test_rewards_are_dm_controls_for_any_place(x: float, y: float, z: float) -> None:
    place = np.array([x, y, z])
    found = jaco_rewards(place)
    np.testing.assert_allclose(found, reach_rewards(place), rtol=1e-13, atol=1e-15)
    batch = jaco_rewards(np.stack([np.zeros(3), place] * 9))
    assert batch[1::2].tolist() == [found.tolist()] * 9
