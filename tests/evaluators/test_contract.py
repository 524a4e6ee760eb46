"""One battery for every registered offline algorithm, third parties' included."""

import copy

import pytest
import torch

from cudc_bench import plugins
from cudc_bench.envs import DOMAINS
from cudc_bench.evaluators.loop import Arena, EvaluateConfig, run_evaluation

from .helpers import batch_for, make, random_walker_data

every = pytest.mark.parametrize("name", plugins.names("evaluators"))


@every
@pytest.mark.parametrize(("observation", "action"), [(24, 6), (78, 12), (42, 9)])
@pytest.mark.parametrize("members", [1, 3])
def test_builds_updates_and_acts(name, observation, action, members):
    agent = make(name, range(members), observation, action)
    metrics = agent.update(batch_for(agent, observation, action, measure=True))
    assert metrics
    assert all(value.shape == (members,) and torch.isfinite(value).all() for value in metrics.values())
    assert agent.update(batch_for(agent, observation, action)) == {}
    actions = agent.act(torch.randn(members, 5, observation) * 3)
    assert actions.shape == (members, 5, action)
    assert actions.abs().max() <= 1


@every
def test_acts_deterministically(name):
    agent = make(name)
    observation = torch.randn(1, 4, 24)
    assert torch.equal(agent.act(observation), agent.act(observation))


@every
def test_a_restored_state_continues_identically(name):
    first = make(name, (1, 2))
    for step in range(3):
        first.update(batch_for(first, seed=step))
    second = make(name, (1, 2))
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    for step in range(3, 6):
        metrics = [agent.update(batch_for(agent, seed=step, measure=True)) for agent in (first, second)]
        assert all(torch.equal(value, metrics[1][key]) for key, value in metrics[0].items())
    observation = torch.randn(2, 4, 24)
    assert torch.equal(first.act(observation), second.act(observation))


@every
def test_members_learn_together_as_they_do_alone(name):
    together, alone = make(name, (5, 6)), make(name, (6,))
    for step in range(10):
        batch = batch_for(together, seed=step)
        together.update(batch)
        own = (batch.observation[1:], batch.action[1:], batch.next_observation[1:], batch.horizon[1:], batch.reward[1:])
        alone.update(type(batch)(*own))
    observation = torch.randn(1, 4, 24)
    pair = together.act(observation.expand(2, -1, -1))
    torch.testing.assert_close(pair[1:], alone.act(observation), atol=1e-4, rtol=1e-4)
    assert not torch.allclose(pair[0], pair[1])


@every
def test_the_loop_evaluates_at_zero_at_every_interval_and_at_the_end(name):
    agent = make(name, (1, 2))
    config = EvaluateConfig(gradient_steps=25, evaluate_every=10, evaluation_episodes=2, final_episodes=3, milestones=(10, 25))
    data = random_walker_data(1, "stand", (1, 2))
    told = []
    outcomes = run_evaluation(agent, data, config, Arena(DOMAINS["walker"], ["stand", "walk"]), told.append)
    assert sum(told) == 25
    for outcome in outcomes:
        assert [step for step, _ in outcome.curve] == [0, 10, 20, 25]
        assert all(len(returns) == 2 for _, returns in outcome.curve)
        assert len(outcome.final) == 3
        assert [step for step, _ in outcome.metrics] == [10, 20, 25]
    # Standing is part of walking: at the same states the walk's reward is never larger.
    assert outcomes[0].curve != outcomes[1].curve


@every
def test_a_run_is_repeated_exactly(name):
    config = EvaluateConfig(gradient_steps=20, evaluate_every=10, evaluation_episodes=1, final_episodes=1, milestones=(10, 20))
    data = [random_walker_data(1, "stand", (3,)) for _ in range(2)]
    first, second = (run_evaluation(make(name, (3,)), d, config, Arena(DOMAINS["walker"], ["stand"]), lambda n: None) for d in data)
    assert first == second
