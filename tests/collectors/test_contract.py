"""The battery of collectors/contract.py on every collector that is registered here, third parties' included."""

from pathlib import Path

import pytest
import torch

from cudc_bench import plugins
from cudc_bench.collectors.contract import CollectorContract
from cudc_bench.collectors.rnd import RND

# Two names for one class need the battery once.
NAMES = list({plugins.load("collectors", name): name for name in reversed(plugins.names("collectors"))}.values())


class TestCollectors(CollectorContract):
    @pytest.fixture(params=NAMES)
    def name(self, request):
        return request.param


class Peeks(RND):
    """Takes the environment's reward where there is one."""

    def reward(self, batch):
        return super().reward(batch) if batch.reward is None else batch.reward


class Shares(RND):
    """Its members see each other."""

    def reward(self, batch):
        return super().reward(batch).mean(0, keepdim=True).expand(len(self.seeds), -1)


class Forgets(RND):
    """Draws from a generator that no state holds."""

    def reward(self, batch):
        return super().reward(batch) + torch.rand(len(self.seeds), 1)


class Overshoots(RND):
    """Acts outside the bounds."""

    def act(self, observation, explore=True):
        return super().act(observation, explore) + 2


@pytest.mark.parametrize(
    ("kind", "test", "arguments"),
    [
        (Peeks, "test_poisoned_rewards_never_reach_an_update", ()),
        (Shares, "test_members_learn_together_as_they_do_alone", ()),
        (Forgets, "test_a_restored_state_continues_identically", ()),
        (Forgets, "test_a_run_that_was_interrupted_ends_as_if_it_had_not_been", (Path,)),
        (Overshoots, "test_acts_deterministically_when_told_and_explores_otherwise", ()),
        (Overshoots, "test_builds_updates_and_acts_in_every_domain", ("walker", 1)),
    ],
)
def test_the_battery_notices_what_a_method_must_not_do(kind, test, arguments, monkeypatch, tmp_path):
    def run(folder):
        folder.mkdir()
        getattr(CollectorContract(), test)("rnd", *(folder if one is Path else one for one in arguments))

    run(tmp_path / "right")
    monkeypatch.setattr(plugins, "load", lambda *names: kind)
    with pytest.raises(AssertionError):
        run(tmp_path / "wrong")
