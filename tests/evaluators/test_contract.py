"""The battery of evaluators/contract.py on every offline algorithm that trains on rewards, third parties' included."""

import pytest
import torch

from cudc_bench import plugins
from cudc_bench.evaluators.contract import EvaluatorContract
from cudc_bench.evaluators.td3 import TD3

from .helpers import LABELLED

# What the loop does is the same for all but cloning, which has no critic, those that want the next action, and those whose actor moves in
# every second update.
LOOP = ["bc", "iql", "rebrac", "td3", "td3-fujimoto"]
COSTLY = {
    "test_the_loop_evaluates_at_zero_at_every_interval_and_at_the_end": LOOP,
    "test_a_run_is_repeated_exactly": LOOP,
    # And CQL, which has optimisers of its own.
    "test_a_run_that_was_stopped_ends_as_if_it_had_not_been": [*LOOP, "cql"],
}


class TestEvaluators(EvaluatorContract):
    def pytest_generate_tests(self, metafunc):
        metafunc.parametrize("name", COSTLY.get(metafunc.function.__name__, LABELLED))


def test_what_runs_for_some_is_of_the_battery():
    assert set(COSTLY) <= set(dir(EvaluatorContract))


class Shares(TD3):
    """Its members see each other."""

    def actor_value(self, batch, mean):
        return super().actor_value(batch, mean) * super().actor_value(batch, mean).detach().mean()


class Normalises(TD3):
    """By the largest value of all members: Adam does not see how large a loss is."""

    def actor_value(self, batch, mean):
        value = super().actor_value(batch, mean)
        return value / value.detach().abs().max()


class Forgets(TD3):
    """Draws from a generator that no state holds."""

    def actor_value(self, batch, mean):
        return super().actor_value(batch, mean) * torch.rand(1)


class Overshoots(TD3):
    """Acts outside the bounds."""

    def act(self, observation):
        return 2 * super().act(observation)


@pytest.mark.parametrize(
    ("kind", "test", "arguments", "expected"),
    [
        (Shares, "test_members_learn_together_as_they_do_alone", (), "must come from that member's rows"),
        (Normalises, "test_members_learn_together_as_they_do_alone", (), "'actor_loss' in a stack of two than alone"),
        (Forgets, "test_a_restored_state_continues_identically", (), "must be a registered buffer"),
        (Forgets, "test_a_run_is_repeated_exactly", (), "all random numbers must come"),
        (Overshoots, "test_builds_updates_and_acts_in_every_domain", ("walker", 1), r"within \[-1, 1\]"),
        (Overshoots, "test_acts_deterministically_and_as_its_policy_does", (), "what is evaluated must be what is kept"),
    ],
)
def test_the_battery_notices_what_an_algorithm_must_not_do(kind, test, arguments, expected, monkeypatch):
    getattr(EvaluatorContract(), test)("td3", *arguments)
    monkeypatch.setattr(plugins, "load", lambda *names: kind)
    with pytest.raises(AssertionError, match=expected):
        getattr(EvaluatorContract(), test)("td3", *arguments)
