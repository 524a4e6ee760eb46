"""One battery for every registered collector, third parties' included."""

import copy
import math

import pytest
import torch

from cudc_bench import plugins
from cudc_bench.collectors.base import Space
from cudc_bench.collectors.loop import CollectConfig, run_collection
from cudc_bench.envs import DOMAINS

from .helpers import batch_for, make

NAMES = plugins.names("collectors")
SPACES = {
    "walker": Space("walker", 24, 6, 1000, 4000, 2),
    "quadruped": Space("quadruped", 78, 12, 1000, 4000, 2),
    "jaco": Space("jaco", 42, 9, 250, 4000, 2),
}
every = pytest.mark.parametrize("name", NAMES)


class Memory:
    """Keeps what one member collects."""

    def __init__(self):
        self.episodes, self.rows, self.skills = [], [], []

    def add_episode(self, seed, observations, actions, infos):
        self.episodes.append((seed, observations.copy(), actions.copy(), infos["physics"].copy()))
        self.skills.append(infos["skill"].copy() if "skill" in infos else None)

    def add_diagnostics(self, row):
        self.rows.append(row)


def run(collector, steps=2300, seed_steps=1000, update_every=25):
    sinks = [Memory() for _ in collector.seeds]
    config = CollectConfig(steps=steps, seed_steps=seed_steps, update_every=update_every, measure_every=5)
    run_collection(collector, config, DOMAINS["walker"], sinks, lambda n: None)
    return sinks


def flat(value):
    """Every tensor inside a state dict, in order."""
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, dict):
        value = value.values()
    if isinstance(value, list | tuple) or not isinstance(value, str | int | float | bool | type(None)):
        return [tensor for item in value for tensor in flat(item)]
    return []


@every
@pytest.mark.parametrize("domain", SPACES)
@pytest.mark.parametrize("members", [1, 3])
def test_builds_updates_and_acts_in_every_domain(name, domain, members):
    space = SPACES[domain]
    collector = make(name, range(members), space)
    metrics = collector.update(batch_for(collector, measure=True))
    assert all(value.shape == (members,) and torch.isfinite(value).all() for value in metrics.values())
    assert bool(metrics) == collector.learns
    action = collector.act(torch.randn(members, space.observation))
    assert action.shape == (members, space.action)
    assert action.abs().max() <= 1
    assert collector.horizon.shape == (members,)
    assert collector.horizon.dtype == torch.int64
    assert 1 <= int(collector.horizon.max()) <= collector.max_horizon <= space.episode_length
    assert len(collector.summary()) == members


@every
def test_acts_deterministically_when_told_and_explores_otherwise(name):
    collector = make(name, (1, 2))
    observation = torch.randn(2, 24) * 5
    calm = collector.act(observation, explore=False)
    assert torch.equal(calm, collector.act(observation, explore=False))
    tries = torch.stack([collector.act(observation) for _ in range(20)])
    assert tries.abs().max() <= 1
    assert tries.std(0).min() > 0


@every
def test_a_restored_state_continues_identically(name):
    first = make(name, (1, 2))
    for step in range(3):
        first.update(batch_for(first, seed=step))
    state = copy.deepcopy(first.state_dict())
    second = make(name, (1, 2))
    second.load_state_dict(state)
    for step in range(3, 6):
        metrics = [c.update(batch_for(c, seed=step, measure=True)) for c in (first, second)]
        for key, value in metrics[0].items():
            assert torch.equal(value, metrics[1][key]), key
    observation = torch.randn(2, 24)
    assert torch.equal(first.act(observation), second.act(observation))
    for a, b in zip(flat(first.state_dict()), flat(second.state_dict()), strict=True):
        assert torch.equal(a, b)


@every
def test_members_learn_together_as_they_do_alone(name):
    together = make(name, (5, 6))
    alone = make(name, (6,))
    for step in range(10):
        batch = batch_for(together, seed=step)
        together.update(batch)
        own = [x[1:2] for x in (batch.observation, batch.action, batch.next_observation)]
        alone.update(type(batch)(*own, alone.horizon, skill=None if batch.skill is None else batch.skill[1:2]))
    observation = torch.randn(1, 24)
    pair = together.act(observation.expand(2, -1), explore=False)
    torch.testing.assert_close(pair[1:], alone.act(observation, explore=False), atol=1e-4, rtol=1e-4)
    if collector_learns(name):
        assert not torch.allclose(pair[0], pair[1])


def collector_learns(name):
    return plugins.load("collectors", name).learns


@every
def test_collected_together_equals_collected_alone(name):
    # One update before step 1,100; rounding has not had time to grow through the chaos of the simulation.
    pair = run(make(name, (5, 6)), steps=1100, update_every=90)
    alone = run(make(name, (6,)), steps=1100, update_every=90)[0]
    for together, single in zip(pair[1].episodes, alone.episodes, strict=True):
        assert together[0] == single[0]
        torch.testing.assert_close(torch.from_numpy(together[2]), torch.from_numpy(single[2]), atol=1e-3, rtol=0)
    first = pair[0].episodes[0][2] == pair[1].episodes[0][2]
    assert not first.all()


@every
def test_a_run_is_repeated_exactly(name):
    first, second = run(make(name))[0], run(make(name))[0]
    assert first.rows == second.rows
    for a, b in zip(first.episodes, second.episodes, strict=True):
        assert a[0] == b[0]
        assert all((x == y).all() for x, y in zip(a[1:], b[1:], strict=True))


@every
def test_ten_thousand_steps_make_ten_valid_episodes_without_any_reward(name, monkeypatch):
    def poisoned(quantities):
        raise AssertionError("a collector asked for the environment's reward")

    monkeypatch.setattr("cudc_bench.envs.walker.walker_rewards", poisoned)
    monkeypatch.setattr("cudc_bench.envs.walker.Walker.quantities", lambda self, out: out.fill(math.nan))
    seen = []
    collector = make(name)
    update = collector.update
    collector.update = lambda batch: (seen.append(batch.reward), update(batch))[1]
    sink = run(collector, steps=10_000, seed_steps=4_000, update_every=60)[0]
    assert len(sink.episodes) == 10
    for _, observations, actions, physics in sink.episodes:
        assert observations.shape == (1001, 24)
        assert actions.shape == (1000, 6)
        assert physics.shape == (1001, 18)
        assert all(torch.isfinite(torch.from_numpy(x)).all() for x in (observations, actions, physics))
        assert abs(actions).max() <= 1
    assert all(reward is None for reward in seen)
    assert bool(seen) == collector.learns
    # Exactly one update on every 60th step from the first after the random ones.
    assert len(seen) == (100 if collector.learns else 0)


@every
def test_poisoned_rewards_never_reach_an_update(name):
    collectors = [make(name), make(name)]
    for step in range(3):
        clean, poisoned = (batch_for(c, seed=step, measure=True) for c in collectors)
        poisoned.reward = torch.full(poisoned.action.shape[:2], math.nan)
        metrics = [c.update(batch) for c, batch in zip(collectors, (clean, poisoned), strict=True)]
        assert all(torch.equal(value, metrics[1][key]) for key, value in metrics[0].items())


@every
def test_a_last_short_episode_ends_the_dataset(name):
    sink = run(make(name), steps=1300)[0]
    assert [len(actions) for _, _, actions, _ in sink.episodes] == [1000, 300]


@every
def test_metrics_are_costly_only_when_measured(name):
    collector = make(name)
    assert collector.update(batch_for(collector)) == {}


@every
def test_skills_are_stored_as_the_actions_followed_them(name):
    collector = make(name)
    given, act = [], collector.act

    def remember(observation, explore=True):
        given.append(collector.skill.clone() if collector.skill_size else None)
        return act(observation, explore)

    collector.act = remember
    sink = run(collector, steps=1300, seed_steps=0, update_every=100)[0]
    if not collector.skill_size:
        assert sink.skills == [None, None]
        return
    lengths = [1000, 300]
    assert [skill.shape for skill in sink.skills] == [(length + 1, collector.skill_size) for length in lengths]
    for skill, start in zip(sink.skills, (0, 1000), strict=True):
        rows = torch.from_numpy(skill)
        assert torch.equal(rows[:-1], torch.cat(given[start : start + len(rows) - 1]))
        assert torch.equal(rows[-1], rows[-2])
        changes = (rows[1:-1] != rows[:-2]).any(1).nonzero()[:, 0] + 1
        every_steps = collector.skill_steps
        assert not every_steps or (changes % every_steps == 0).all()
        assert bool(len(changes)) == bool(every_steps)
    assert len(torch.from_numpy(sink.skills[0]).unique(dim=0)) > 1 or not collector.skill_steps


@every
def test_actions_and_values_depend_on_the_skill(name):
    collector = make(name)
    if not collector.skill_size:
        return
    batch = batch_for(collector)
    other = torch.roll(batch.skill, 1, dims=1)
    different = (other != batch.skill).any(-1)[0]
    with torch.no_grad():
        mean = [collector.actor(collector.with_skill(batch.observation, skill)) for skill in (batch.skill, other)]
        value = [collector.value(collector.critic, batch.observation, skill, batch.action) for skill in (batch.skill, other)]
    for first, second in (mean, value):
        assert (first != second).any(-1)[0][different].all()
        torch.testing.assert_close(first[0][~different], second[0][~different])
