"""The battery of collectors/contract.py on every collector that is registered here, third parties' included.

What takes a simulation, seconds each, runs once for each shape of control flow: twenty names are CUDC or APT with other values, and differ
in losses, rewards and bounds that the tests without a simulation run for all.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch

from cudc_bench import plugins
from cudc_bench.collectors import contract
from cudc_bench.collectors.contract import CollectorContract
from cudc_bench.collectors.cudc import CUDC
from cudc_bench.collectors.rnd import RND

# Two names for one class need the battery once.
NAMES = list({plugins.load("collectors", name): name for name in reversed(plugins.names("collectors"))}.values())
# Asked many questions, in every process that collects these tests.
make = cache(contract.make)


def flow(name: str) -> Hashable:
    """All by which a collector takes another way through the loop: who acts, how k and skills change, what is drawn beside the batch."""
    collector = make(name)
    kind, config = type(collector), collector.config
    grows = collector.max_horizon > int(collector.horizon.max())
    skills = bool(collector.skill_size) and ("steps" if collector.skill_steps else "episodes")
    rule = getattr(config, "k_rule", None) if grows else None
    return (
        kind.act,
        kind.next_skill,
        kind.learns,
        skills,
        grows,
        rule,
        kind.measured_by_pilot(config),
        collector.min_horizon is None,
        kind.wants_future,
    )


def code(name: str) -> Hashable:
    """Where a collector's state comes from: the class that last wrote any code, not only values, and its flow."""
    kind = plugins.load("collectors", name)
    written = next(one for one in kind.__mro__ if any(callable(value) or isinstance(value, property) for value in vars(one).values()))
    return written, flow(name)


def one_each(of: Callable[[str], Hashable]) -> list[str]:
    """The first name of each kind, those before others that have no values of their own."""
    found: dict[Hashable, str] = {}
    for name in sorted(NAMES, key=lambda one: (bool(plugins.load("collectors", one).values), one)):
        found.setdefault(of(name), name)
    return list(found.values())


def encoder(name: str) -> Hashable:
    """What shapes a collector's representation."""
    collector = make(name)
    switches = ("encoder", "action_encoder", "inverse", "step_model", "reach", "state_target", "action_target", "inverse_k_batch")
    return getattr(collector, "auxiliary_loss", None) and type(collector).auxiliary_loss, *(
        getattr(collector.config, one, None) for one in switches
    )


COSTLY = {
    "test_a_run_that_was_interrupted_ends_as_if_it_had_not_been": one_each(code),
    "test_collected_together_equals_collected_alone": one_each(flow),
    "test_skills_are_stored_as_the_actions_followed_them": one_each(lambda name: code(name) if make(name).skill_size else flow(name)),
    "test_steps_make_valid_episodes_the_last_of_them_short_without_any_reward": one_each(flow),
    "test_the_representation_does_not_collapse": one_each(encoder),
    "test_what_is_measured_for_diagnostics_never_reaches_the_method": one_each(flow),
}


class TestCollectors(CollectorContract):
    def pytest_generate_tests(self, metafunc: Any) -> None:
        metafunc.parametrize("name", COSTLY.get(metafunc.function.__name__, NAMES))


def test_what_runs_once_for_several_runs_for_every_method_and_every_rule_for_k() -> None:
    assert set(COSTLY) <= set(dir(CollectorContract))
    methods = {
        "aps", "apt", "be", "cic", "ctec", "cudc", "diayn", "disagreement", "icm", "metra", "moss", "proto", "random", "rnd", "smm",
        "apt-ksched",
    }  # fmt: skip
    assert methods <= set(COSTLY["test_a_run_that_was_interrupted_ends_as_if_it_had_not_been"])
    for test, names in COSTLY.items():
        if names == one_each(encoder):
            assert test == "test_the_representation_does_not_collapse"
            continue  # which no rule for k shapes
        configs = [make(name).config for name in names]
        assert {one.k_rule for one in configs if hasattr(one, "k_rule")} == {"weight", "reward", "error", "uniform", "normal"}
        assert {"random", "cudc", "cudc-reward", "cudc-kmix"} <= set(names)


class Peeks(RND):
    """Takes the environment's reward where there is one."""

    def reward(self, batch):
        return super().reward(batch) if batch.reward is None else batch.reward


class Shares(RND):
    """Its members see each other."""

    def reward(self, batch):
        return super().reward(batch).mean(0, keepdim=True).expand(len(self.seeds), -1)


class Normalises(RND):
    """By the largest reward of all members: its critic's optimiser hides most of the difference, and plain data the rest."""

    def reward(self, batch):
        reward = super().reward(batch)
        return reward / reward.max()


class Remembers(RND):
    """In an attribute that no state holds."""

    seen = 0.0

    def reward(self, batch):
        self.seen = self.seen + 0.1
        return super().reward(batch) * self.seen


class Forgets(RND):
    """Draws from a generator that no state holds."""

    def reward(self, batch):
        return super().reward(batch) + torch.rand(len(self.seeds), 1)


class Shrinks(CUDC):
    """Nothing keeps its features apart."""

    values: ClassVar[Mapping[str, Any]] = {
        "reach": False, "regularize": False, "inverse": "none", "step_model": False, "k_max": 3, "state_target": "live",
    }  # fmt: skip


class Overshoots(RND):
    """Acts outside the bounds."""

    def act(self, observation, explore=True):
        return super().act(observation, explore) + 2


class Invents(RND):
    """A category that no list has."""

    category = "secret"


@pytest.mark.parametrize(
    ("kind", "test", "arguments", "expected"),
    [
        (Peeks, "test_poisoned_rewards_never_reach_an_update", (), "a collector explores without any reward"),
        (Shares, "test_members_learn_together_as_they_do_alone", (), "must come from that member's rows"),
        (Normalises, "test_members_learn_together_as_they_do_alone", (), "'reward' in a stack of two than alone"),
        (Remembers, "test_a_restored_state_continues_identically", (), "must be a registered buffer"),
        (Forgets, "test_a_restored_state_continues_identically", (), "all random numbers must come"),
        (Forgets, "test_a_run_that_was_interrupted_ends_as_if_it_had_not_been", (Path,), "must be a registered buffer"),
        (Shrinks, "test_the_representation_does_not_collapse", (), "as much as at the start|directions"),
        (Invents, "test_says_what_it_is", (), "category is 'secret'; allowed: knowledge, data, competence, other"),
        (Overshoots, "test_acts_deterministically_when_told_and_explores_otherwise", (), r"within \[-1, 1\]"),
        (Overshoots, "test_builds_updates_and_acts_in_every_domain", ("walker", 1), r"within \[-1, 1\]"),
    ],
)
def test_the_battery_notices_what_a_method_must_not_do(kind, test, arguments, expected, monkeypatch, tmp_path):
    def run(folder):
        folder.mkdir()
        getattr(CollectorContract(), test)("rnd", *(folder if one is Path else one for one in arguments))

    run(tmp_path / "right")
    monkeypatch.setattr(plugins, "load", lambda *names: kind)
    with pytest.raises(AssertionError, match=expected):
        run(tmp_path / "wrong")
