"""A policy plays its final evaluation's episodes again, to the last bit of their returns."""

import sys

import pytest

import cudc_bench
from cudc_bench.envs import DOMAINS
from cudc_bench.envs.rewards import load_reward
from cudc_bench.errors import UsageError
from cudc_bench.evaluators.policies.rollout import play, recorded_seeds
from cudc_bench.evaluators.policies.stored import load_policy

from .runs import change, write_run

HOP = """
import numpy as np

def hop(measured):
    return np.tanh(measured["torso_height"]) / (0.1 + np.abs(measured["action"]).mean(-1)) + 0.001 * measured["physics"][:, 2]
"""


def nothing(n):
    """Nobody looks at the progress."""


@pytest.mark.parametrize(("domain", "task"), [("walker", "walk"), ("quadruped", "stand"), ("jaco", "reach_bottom_left")])
def test_an_episode_alone_is_what_it_was_among_others(domain, task, tmp_path):
    path, _ = write_run(tmp_path, domain=domain, task=task, played=5)
    policy = load_policy(path)
    final = policy.record.final.returns
    told = []
    played = play(told.append, policy=policy, seeds=recorded_seeds(policy.record, 3), recorded=final)
    assert [one.total for one in played] == final[:3]
    assert [one.recorded for one in played] == final[:3]
    facts = DOMAINS[domain]
    assert sum(told) == 3 * facts.episode_length
    assert all(one.states.shape == (facts.episode_length + 1, facts.physics_size) for one in played)
    # Episodes that the record has not, and those of other seeds.
    more = play(nothing, policy=policy, seeds=[recorded_seeds(policy.record, 6)[5], 3], recorded=[])
    assert all(one.recorded is None and one.total not in final for one in more)
    assert more[1].seed == 3


def test_the_whole_chain_gives_a_record_whose_episodes_come_again(smoke, tmp_path):
    (path,) = cudc_bench.evaluate(dataset_id="walker/walk/cudc-smoke-v0", profile="smoke", output=tmp_path / "results")
    policy = cudc_bench.load_policy(path)
    final = policy.record.final.returns
    played = play(nothing, policy=policy, seeds=recorded_seeds(policy.record, len(final)), recorded=final)
    assert [one.total for one in played] == final


def test_a_function_of_the_users_own_measures_where_the_user_names_it(tmp_path, monkeypatch):
    (tmp_path / "hops.py").write_text(HOP)
    monkeypatch.syspath_prepend(tmp_path)
    reward = load_reward("hops:hop", DOMAINS["walker"])
    path, _ = write_run(tmp_path, task="hop", played=3, reward=reward)
    policy = load_policy(path)
    (one,) = play(nothing, policy=policy, seeds=recorded_seeds(policy.record, 1), recorded=policy.record.final.returns, reward=reward)
    assert one.total == one.recorded == policy.record.final.returns[0]
    del sys.modules["hops"]
    (one,) = play(nothing, policy=policy, seeds=recorded_seeds(policy.record, 1), recorded=policy.record.final.returns)
    assert one.total is None
    assert one.recorded is None
    assert "hops" not in sys.modules


def test_a_task_that_the_domain_has_not_is_refused(tmp_path):
    path, _ = write_run(tmp_path)
    policy = load_policy(path)
    change(path, dataset=policy.record.dataset.model_dump() | {"task": "fly"})
    with pytest.raises(UsageError, match="unknown walker task 'fly'"):
        play(nothing, policy=load_policy(path), seeds=[1])
