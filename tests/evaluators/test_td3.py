"""TD3 on a problem whose answer is known and on a small Walker dataset, and the arena that evaluates it."""

import math

import numpy as np
import pytest
import torch

from cudc_bench.envs import DOMAINS, check_domain
from cudc_bench.errors import RunError
from cudc_bench.evaluators.running.loop import Arena, run_evaluation
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.evaluate_config import EvaluateConfig

from .helpers import make, random_walker_data


def test_learns_the_best_action_of_a_known_problem():
    # One state, reward 1 - (a - 0.4)²: the best action and its value, 1 / (1 - γ), are known.
    agent = make(seeds=(1, 2), observation=3, action=1, width=32, learning_rate=3e-3, discount=0.5, noise_std=0.05)
    state = torch.ones(2, 64, 3)
    for step in range(800):
        action = torch.rand(2, 64, 1, generator=torch.Generator().manual_seed(step)) * 2 - 1
        reward = 1 - (action[..., 0] - 0.4).square()
        agent.update(Batch(state, action, state, torch.ones(2, dtype=torch.int64), reward))
    best = agent.act(state[:, :1])
    torch.testing.assert_close(best, torch.full((2, 1, 1), 0.4), atol=0.1, rtol=0)
    torch.testing.assert_close(agent.critic(state[:, :1], best), torch.full((2, 1, 2), 2.0), atol=0.15, rtol=0)


class Still:
    """A policy that always does the same."""

    device = torch.device("cpu")

    def __init__(self, action):
        self.action = action

    def act(self, observation):
        return self.action.expand(*observation.shape[:2], -1)


# dm_control's own are slow: two episodes at once, or more threads than episodes.
@pytest.mark.parametrize(("domain", "many"), [("walker", (2, 3, 9)), ("dm_control/cheetah-run", (2, 9))])
def test_the_arena_returns_the_same_with_any_number_of_threads(domain, many):
    facts = check_domain(domain)
    still = Still(torch.linspace(-0.5, 0.5, facts.action_size))
    seeds = [[1, 2], [3, 4]]
    tasks = [facts.tasks[0], facts.tasks[-1]]
    alone, *shared = (Arena(facts, tasks, threads).returns(still, seeds) for threads in (1, *many))
    assert len(set(alone.ravel().tolist())) > 3
    for returns in shared:
        assert (returns == alone).all()


def test_a_simulator_that_diverges_in_another_thread_ends_the_evaluation():
    steps = []

    class Wild(Still):
        def act(self, observation):
            steps.append(1)
            if len(steps) == 5:
                arena._simulators[2].data.qvel[:] = 1e12
            return super().act(observation)

    arena = Arena(DOMAINS["walker"], ["walk"], 3)
    with pytest.raises(RunError, match="the walker simulation diverged"):
        arena.returns(Wild(torch.zeros(6)), [[1, 2, 3]])
    assert len(steps) == 5


def test_the_arena_returns_what_gymnasium_returns():
    import gymnasium

    action = torch.tensor([0.3, -0.2, 0.5, 0.1, -0.4, 0.2])
    arena = Arena(DOMAINS["walker"], ["stand", "flip"])
    found = arena.returns(Still(action), [[5, 6], [7, 8]])
    for row, task, seeds in zip(found, ("stand", "flip"), ((5, 6), (7, 8)), strict=True):
        env = gymnasium.make(f"cudc_bench/walker-{task}-v0")
        for value, seed in zip(row, seeds, strict=True):
            env.reset(seed=seed)
            total, truncated = 0.0, False
            while not truncated:
                _, reward, _, truncated, _ = env.step(action.numpy())
                total += reward
            assert value == pytest.approx(total, abs=1e-9)


def test_beats_a_random_policy_on_walker_stand():
    # 2,000 steps on 20 episodes of random actions; the mean return of random actions on stand is about 130.
    data = random_walker_data(20, "stand", (1,))
    random_return = float(data.rewards.sum()) / 20
    agent = make(seeds=(1,), width=64, batch_size=64)
    config = EvaluateConfig(gradient_steps=2000, evaluate_every=2000, evaluation_episodes=1, final_episodes=8, milestones=(2000,))
    (outcome,) = run_evaluation(agent, data, config, Arena(DOMAINS["walker"], ["stand"]), lambda n: None)
    assert all(math.isfinite(value) for _, row in outcome.metrics for value in row.values())
    assert np.mean(outcome.finals[-1][1]) > 1.2 * random_return
