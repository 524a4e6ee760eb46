"""The battery of evaluators/contract.py on every algorithm that trains without rewards, third parties' included."""

import pytest

from cudc_bench import plugins
from cudc_bench.evaluators.contract import ZeroShotContract
from cudc_bench.evaluators.fb import FB
from cudc_bench.evaluators.zero_shot import normalised

from ..helpers import ZERO_SHOT

LOOP = ["fb", "hilp"]
COSTLY = {
    "test_the_loop_evaluates_at_zero_at_every_interval_and_at_the_end": LOOP,
    "test_a_run_is_repeated_exactly": LOOP,
    "test_a_run_that_was_stopped_ends_as_if_it_had_not_been": LOOP,
}


class TestZeroShotLearners(ZeroShotContract):
    def pytest_generate_tests(self, metafunc):
        metafunc.parametrize("name", COSTLY.get(metafunc.function.__name__, ZERO_SHOT))


def test_what_runs_for_some_is_of_the_battery():
    assert set(COSTLY) <= set(dir(ZeroShotContract))


class Divides(FB):
    """By a length that may be zero."""

    def infer(self, labelled):
        z = super().infer(labelled)
        return z / z.norm(dim=-1, keepdim=True) * z.shape[-1] ** 0.5


class Mixes(FB):
    """A task with the other ones."""

    def infer(self, labelled):
        z = super().infer(labelled)
        return normalised(z + 0.3 * z.mean(1, keepdim=True))


class Shares(FB):
    """Its members infer together."""

    def infer(self, labelled):
        z = super().infer(labelled)
        return normalised(z + 0.3 * z.mean(0, keepdim=True))


class Looks(FB):
    """At the rewards while it trains."""

    def learn(self, batch, plan):
        if batch.reward is not None:
            batch.action = batch.action * batch.reward.mean()
        return super().learn(batch, plan)


class Ignores(FB):
    """What it is asked for."""

    def policy_for(self, z):
        return super().policy_for(z * 0.0)


@pytest.mark.parametrize(
    ("kind", "test", "expected"),
    [
        (Looks, "test_trains_without_rewards", "an update read rewards"),
        (Divides, "test_a_task_without_any_reward_is_the_zero_vector", "must be zero"),
        (Mixes, "test_a_task_follows_from_its_own_rewards_alone", "beside others"),
        (Shares, "test_members_infer_together_as_they_do_alone", "members must never see each other"),
        (Ignores, "test_a_tasks_policy_is_what_acts_for_it", "what is evaluated must be what is kept"),
    ],
)
def test_the_battery_notices_what_a_learner_must_not_do(kind, test, expected, monkeypatch):
    monkeypatch.setattr(plugins, "load", lambda *names: kind)
    with pytest.raises(AssertionError, match=expected):
        getattr(ZeroShotContract(), test)("fb")
