"""Profiles are complete and the same for every method; ``paper`` is what the dataclasses say."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch

from cudc_bench import plugins
from cudc_bench.collectors.base import Sizes
from cudc_bench.envs import DOMAINS
from cudc_bench.errors import UsageError
from cudc_bench.settings.collect_config import CollectConfig
from cudc_bench.settings.config import as_dict, build, config_hash, field_names
from cudc_bench.settings.evaluate_config import EvaluateConfig, check_milestones
from cudc_bench.settings.profiles import PROFILES, Profile, resolve_device, resolve_profile, schedules

COLLECTORS = {name: plugins.load("collectors", name) for name in plugins.names("collectors")}
EVALUATORS = {name: plugins.load("evaluators", name) for name in plugins.names("evaluators")}


@pytest.fixture(params=PROFILES)
def profile(request: pytest.FixtureRequest) -> Profile:
    return PROFILES[request.param]


@pytest.mark.parametrize(("cuda", "name", "device"), [(True, "paper", "cuda"), (False, "cpu", "cpu")])
def test_auto_depends_on_cuda(cuda: bool, name: str, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    assert resolve_profile("auto") is PROFILES[name]
    assert resolve_device("auto") == device
    assert resolve_device("cpu") == "cpu"


def test_cuda_where_there_is_none_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(UsageError, match="device 'cuda' is not available here"):
        resolve_device("cuda")


def test_unknown_names_are_refused() -> None:
    with pytest.raises(UsageError, match=r"unknown profile 'smoek'; allowed: auto, cpu, demo, paper, smoke\. Did you mean 'smoke'\?"):
        resolve_profile("smoek")
    with pytest.raises(UsageError, match=r"unknown device 'gpu'; allowed: auto, cpu, cuda\."):
        resolve_device("gpu")


def test_names_are_those_by_which_they_are_found(profile: Profile) -> None:
    assert resolve_profile(profile.name) is profile
    assert set(PROFILES) == {"paper", "cpu", "demo", "smoke"}
    assert profile.purpose
    assert "\n" not in profile.purpose


@pytest.mark.parametrize("name", COLLECTORS)
def test_every_profile_builds_every_collector(profile: Profile, name: str) -> None:
    kind = COLLECTORS[name]
    loop = build(CollectConfig, profile.collect)
    for domain in DOMAINS.values():
        config = kind.configure(domain.name, profile.collect)
        if (threshold := kind.measured_by_pilot(config)) is not None:
            config = kind.configure(domain.name, profile.collect, {threshold: 0.5})
        assert len(config_hash(as_dict(loop, config))) == 16
        if profile.name == "paper":
            continue  # its networks take seconds to build
        sizes = Sizes(domain.name, domain.observation_size, domain.action_size, domain.episode_length, loop.seed_steps, loop.update_every)
        assert kind(sizes, config, [1]).max_horizon <= domain.episode_length
    assert loop.steps >= loop.seed_steps + domain.episode_length, "nothing is learnt"


@pytest.mark.parametrize("name", EVALUATORS)
def test_every_profile_builds_every_evaluator(profile: Profile, name: str) -> None:
    kind = EVALUATORS[name]
    loop, config = build(EvaluateConfig, profile.evaluate), build(kind.config_class, profile.evaluate)
    assert len(config_hash(as_dict(loop, config))) == 16
    check_milestones(loop)
    assert loop.milestones[-1] == loop.gradient_steps
    for domain in () if profile.name == "paper" else DOMAINS.values():
        assert kind(domain.observation_size, domain.action_size, config, [1]).seeds == (1,)


@pytest.mark.parametrize("side", ["collect", "evaluate"])
def test_every_value_of_a_profile_belongs_to_something(profile: Profile, side: str) -> None:
    """A misspelt name would be passed over in silence."""
    loop, kinds = {"collect": (CollectConfig, COLLECTORS), "evaluate": (EvaluateConfig, EVALUATORS)}[side]
    known = {name for config in (loop, *(kind.config_class for kind in kinds.values())) for name in field_names(config)}
    assert set(getattr(profile, side)) <= known


def test_paper_changes_nothing() -> None:
    paper = PROFILES["paper"]
    assert (dict(paper.collect), dict(paper.evaluate)) == ({}, {})
    for config in (CollectConfig, EvaluateConfig, *(kind.config_class for kind in (*COLLECTORS.values(), *EVALUATORS.values()))):
        assert build(config, paper.collect, paper.evaluate) == config()


def test_the_defaults_are_the_papers() -> None:
    """Section 1 of the paper's protocol and its table of hyperparameters."""
    expected: dict[type, dict[str, Any]] = {
        CollectConfig: {"steps": 1_000_000, "seed_steps": 4_000, "update_every": 2},
        EvaluateConfig: {
            "gradient_steps": 500_000, "evaluate_every": 10_000, "evaluation_episodes": 10, "final_episodes": 50,
            "milestones": (100_000, 500_000),
        },
        COLLECTORS["cudc"].config_class: {
            "batch_size": 1024, "width": 1024, "learning_rate": 1e-4, "discount": 0.99, "critic_tau": 0.01, "noise_std": 0.2,
            "noise_clip": 0.3, "horizon": 3, "k_max": 6, "feature_dim": 512, "neighbours": 12, "alpha": 1e-3, "beta": 1e-2, "clip_low": 0.2,
            "clip_high": 2.0, "c_w": 0.02, "c_k": 0.5,
        },
        EVALUATORS["td3"].config_class: {"batch_size": 1024, "width": 1024, "learning_rate": 1e-4, "discount": 0.99, "critic_tau": 0.01},
    }  # fmt: skip
    for config, values in expected.items():
        found = dataclasses.asdict(config())
        assert {name: found[name] for name in values} == values


@pytest.mark.parametrize(("name", "share"), [("paper", 1.0), ("cpu", 0.4), ("demo", 0.1), ("smoke", 0.003)])
def test_schedules_that_count_steps_follow_the_length_of_a_profiles_runs(name: str, share: float) -> None:
    values = PROFILES[name].collect
    cudc, control = COLLECTORS["cudc"], COLLECTORS["apt-ksched"]
    assert schedules(cudc.config_class, values) == {"threshold_dwell": 150_000 * share, "normal_steps": 1_000_000 * share}
    assert control.configure("walker", values).k_steps == pytest.approx([450_000 * share, 650_000 * share, 1_050_000 * share])
    # A run of another length keeps its profile's, as it keeps all that its settings do not name.
    assert cudc.configure("walker", values, {"steps": 7}).normal_steps == 1_000_000 * share
    assert cudc.configure("walker", values, {"normal_steps": 7}).normal_steps == 7
    assert schedules(COLLECTORS["icm"].config_class, values) == {}


def test_smaller_profiles_treat_every_method_alike() -> None:
    """Values that a profile changes are the same for all methods that have them, whatever their own defaults."""
    for one in PROFILES.values():
        for side, kinds in (("collect", COLLECTORS), ("evaluate", EVALUATORS)):
            for name, value in getattr(one, side).items():
                configs = [build(kind.config_class, getattr(one, side)) for kind in kinds.values()]
                assert {getattr(config, name) for config in configs if hasattr(config, name)} <= {value}
