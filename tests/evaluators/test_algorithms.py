"""What algorithms come to, and how their networks start; test_oracles.py compares their formulas."""

import math

import pytest
import torch

from cudc_bench import plugins

from .helpers import batch_for, make

SIZE, ACTION = 32, 6


def test_names_and_what_they_are():
    names = {"bc", "cql", "cql-fixed", "crr", "iql", "rebrac", "td3", "td3-bc", "td3-fujimoto"}
    assert set(plugins.names("evaluators")) >= names
    for name in names:
        kind = plugins.load("evaluators", name)
        assert kind.summary
        assert kind.citation


def test_exorls_cql_cannot_act_beyond_tanh_one_and_the_fixed_one_can():
    largest = {}
    for name in ("cql", "cql-fixed"):
        agent = make(name)
        with torch.no_grad():
            agent.actor[-1].weight.mul_(1e3)
        largest[name] = agent.act(torch.randn(1, 200, 24)).abs().max().item()
    assert largest["cql"] == pytest.approx(math.tanh(1), abs=1e-4)
    assert largest["cql-fixed"] > 0.99


def test_iqls_value_is_an_expectile():
    """On one state with two actions of value 0 and 1, V is the expectile of a fair coin."""
    agent = make("iql", expectile=0.8, learning_rate=1e-2, discount=0.0)
    s = torch.ones(1, SIZE, 24)
    action = torch.where(torch.arange(SIZE) % 2 == 0, 1.0, -1.0)[None, :, None].expand(1, SIZE, ACTION)
    batch = batch_for(agent)
    batch.observation = batch.next_observation = s
    batch.action, batch.reward = action, (action[..., 0] + 1) / 2
    for _ in range(2500):
        agent.update(batch)
    # 0.8 (1 - v) = 0.2 v.
    assert agent.value(s).mean().item() == pytest.approx(0.8, abs=0.03)
    assert agent.act(s).mean().item() > 0.5


def test_rebracs_networks_are_the_authors():
    agent = plugins.load("evaluators", "rebrac")(24, 6, plugins.load("evaluators", "rebrac").configure(), [1])
    hidden = [p for p in agent.actor.parameters() if p.dim() == 3 and p.shape[1] > 1]
    assert [tuple(p.shape[1:]) for p in hidden] == [(24, 256), (256, 256), (256, 256), (256, 6)]
    assert 0.9 * 256**-0.5 < hidden[1].abs().max() <= 256**-0.5
    assert 0.9e-3 < hidden[-1].abs().max() <= 1e-3
    inner = [p for p in agent.critic.parameters() if p.dim() == 3 and p.shape[1] > 1]
    assert [tuple(p.shape) for p in inner] == [(2, 30, 256), (2, 256, 256), (2, 256, 256), (2, 256, 1)]
    assert 0.9 * 3e-3 < inner[-1].abs().max() <= 3e-3
    assert sum(p.shape[-1] == 256 and p.shape[1] == 1 and bool((p == 1).all()) for p in agent.critic.parameters()) == 3  # LayerNorms


def test_sizes_are_those_of_the_code_that_they_follow():
    """All other hyperparameters are written down again in oracles.py."""
    exorl = dict.fromkeys(("td3", "td3-bc", "bc", "crr", "cql", "cql-fixed", "td3-fujimoto"), (1024, 1024))
    for name, sizes in (exorl | {"iql": (256, 256), "rebrac": (1024, 256)}).items():
        config = plugins.load("evaluators", name).configure()
        assert (config.batch_size, config.width) == sizes
