"""The fast Walker against dm_control itself."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
from dm_control import suite
from dm_control.rl.control import PhysicsError
from dm_control.suite import walker as dm_walker
from dm_control.utils import rewards as dm_rewards
from hypothesis import given
from hypothesis import strategies as st

from cudc_bench.envs.simulator import DivergedError
from cudc_bench.envs.walker import Walker, walker_rewards

T = 1000
INF = float("inf")

Policy = Callable[[int], np.ndarray]


def uniform(seed: int) -> Policy:
    """Independent uniform actions."""
    generator = np.random.default_rng(seed)
    return lambda t: generator.uniform(-1, 1, 6).astype(np.float32)


def swinging(seed: int) -> Policy:
    """Full-range oscillations: they tumble, and so reach speeds and spins that uniform noise does not."""
    rates = np.random.default_rng(seed).uniform(0.05, 0.6, 6)
    return lambda t: np.sign(np.sin(rates * t)).astype(np.float32)


def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
    """dm_control's observation in dm_control's order, as stored."""
    return np.concatenate([np.ravel(observation[name]) for name in ("orientations", "height", "velocity")]).astype(np.float32)


def flip_reward(height: float, upright: float, spin: float) -> float:
    """ExORL's flip, one number at a time, from dm_control's own parts."""
    standing = dm_rewards.tolerance(height, bounds=(1.2, INF), margin=0.6)
    stand = (3 * standing + (1 + upright) / 2) / 4
    gain = dm_rewards.tolerance(spin, bounds=(5.0, INF), margin=5.0, value_at_margin=0, sigmoid="linear")
    return stand * (5 * gain + 1) / 6


def observed(simulator: Walker) -> np.ndarray:
    out = np.full(24, np.nan, np.float32)
    simulator.observe(out)
    return out


def state(simulator: Walker) -> np.ndarray:
    out = np.full(18, np.nan)
    simulator.state(out)
    return out


def measured(simulator: Walker) -> np.ndarray:
    out = np.full(4, np.nan)
    simulator.quantities(out)
    return out


@pytest.mark.parametrize("seed", range(2))
def test_observations_states_and_rewards_are_dm_controls_bit_for_bit(seed: int) -> None:
    """Two whole episodes a seed, the second reset from the generator that the first left behind."""
    environments = {task: suite.load("walker", task, task_kwargs={"random": seed}) for task in ("stand", "walk", "run")}
    ours, generator = Walker(), np.random.RandomState(seed)
    for policy in (uniform(seed), swinging(seed)):
        steps = {task: environment.reset() for task, environment in environments.items()}
        ours.restart(generator)
        theirs: dict[str, list[np.ndarray]] = {"observations": [], "states": [], "rewards": []}
        found: dict[str, list[np.ndarray]] = {"observations": [], "states": [], "rewards": []}
        for t in range(T + 1):
            physics = environments["walk"].physics
            theirs["observations"].append(np.stack([flat(step.observation) for step in steps.values()]))
            theirs["states"].append(np.stack([environment.physics.state() for environment in environments.values()]))
            found["observations"].append(np.stack([observed(ours)] * 3))
            found["states"].append(np.stack([state(ours)] * 3))
            if t > 0:
                spin = physics.named.data.subtree_angmom["torso"][1]
                flip = flip_reward(float(physics.torso_height()), float(physics.torso_upright()), float(spin))
                theirs["rewards"].append(np.array([*(step.reward for step in steps.values()), flip]))
                found["rewards"].append(walker_rewards(measured(ours)))
            if t < T:
                action = policy(t)
                ours.step(action)
                steps = {task: environment.step(action) for task, environment in environments.items()}
        assert all(step.last() and step.discount == 1.0 for step in steps.values())
        for name in theirs:
            a, b = np.stack(theirs[name]), np.stack(found[name])
            assert a.dtype == b.dtype
            assert a.tobytes() == b.tobytes(), f"{name} differ by up to {np.abs(a - b).max()}"
        spread = np.ptp(np.stack(theirs["rewards"]), axis=0)
        assert (spread > 0.05).all(), "these episodes do not exercise the rewards"


@pytest.mark.parametrize("seed", [0, 7, 2**32 - 1])
def test_reset_with_a_seed_is_dm_controls_reset_with_that_seed(seed: int) -> None:
    environment = suite.load("walker", "walk", task_kwargs={"random": seed})
    step = environment.reset()
    ours = Walker()
    ours.reset(5)
    for t in range(20):
        ours.step(uniform(t)(t))  # what was before a reset leaves no trace
    ours.reset(seed)
    assert observed(ours).tobytes() == flat(step.observation).tobytes()
    assert state(ours).tobytes() == environment.physics.state().tobytes()


# In both directions of every bound and margin: height around 1.2 - 0.6, speeds around 1 and 8, spin around 5.
number = st.floats(-20, 20) | st.sampled_from([-5.0, 0.0, 0.5, 0.6, 1.0, 1.2, 4.0, 5.0, 8.0, 10.0])


@given(number, st.floats(-1, 1), number, number)
def test_rewards_are_dm_controls_for_any_quantities(height: float, upright: float, speed: float, spin: float) -> None:
    class Physics:
        """What dm_control's task asks of its physics."""

        def torso_height(self) -> float:
            return height

        def torso_upright(self) -> float:
            return upright

        def horizontal_velocity(self) -> float:
            return speed

    moves = (0, dm_walker._WALK_SPEED, dm_walker._RUN_SPEED)
    expected = [dm_walker.PlanarWalker(move_speed=move).get_reward(Physics()) for move in moves]
    found = walker_rewards(np.array([height, upright, speed, spin]))
    assert found.tolist() == [*expected, flip_reward(height, upright, spin)]
    # In a batch, and whatever stands beside it, a row gets the same rewards.
    batch = walker_rewards(np.array([[0.1, 0.2, 0.3, 0.4], [height, upright, speed, spin]] * 9))
    assert batch[1::2].tolist() == [found.tolist()] * 9


def test_shimmys_walker_is_the_same_environment() -> None:
    import shimmy

    gymnasium.register_envs(shimmy)
    theirs, ours = gymnasium.make("dm_control/walker-walk-v0"), gymnasium.make("cudc_bench/walker-walk-v0")
    theirs.action_space.seed(0)
    expected, _ = theirs.reset(seed=11)
    found, _ = ours.reset(seed=11)
    truncated, total = False, 0.0
    for t in range(T):
        assert found.tobytes() == flat(expected).tobytes()
        assert not truncated
        action = theirs.action_space.sample().astype(np.float32)
        expected, reward, *_ = theirs.step(action)
        found, ours_reward, terminated, truncated, _ = ours.step(action)
        assert ours_reward == reward
        assert not terminated
        assert truncated == (t + 1 == T)
        total += ours_reward
    assert total > 0


@pytest.mark.parametrize("array", ["qpos", "qvel"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12])
def test_divergence_is_an_error_and_not_a_silent_reset(array: str, value: float) -> None:
    oracle = suite.load("walker", "walk", task_kwargs={"random": 0})
    oracle.reset()
    getattr(oracle.physics.data, array)[3] = value
    with pytest.raises(PhysicsError):
        oracle.step(np.zeros(6))

    ours = Walker()
    ours.reset(0)
    getattr(ours.data, array)[3] = value
    with pytest.raises(DivergedError, match="walker simulation diverged"):
        ours.step(np.zeros(6, np.float32))
    # The next episode is a healthy one.
    fresh = Walker()
    for simulator in (ours, fresh):
        simulator.reset(1)
        simulator.step(np.ones(6, np.float32))
    assert state(ours).tobytes() == state(fresh).tobytes()


def test_an_action_that_is_not_a_number_is_an_error() -> None:
    ours = Walker()
    ours.reset(0)
    with pytest.raises(DivergedError):
        ours.step(np.full(6, np.nan, np.float32))
