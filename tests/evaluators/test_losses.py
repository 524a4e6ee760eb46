"""Every algorithm's losses against an independent NumPy version of its formulas, on random weights."""

import math

import numpy as np
import pytest
import torch
from scipy.special import logsumexp
from scipy.stats import norm

from cudc_bench import plugins

from .helpers import batch_for, make
from .test_td3 import layers, policy, values

SIZE, ACTION = 32, 6


def numpy(batch):
    found = (batch.observation, batch.action, batch.next_observation, batch.reward, batch.next_action)
    return [x[0].numpy().astype(np.float64) for x in found]


def warmed(name, **settings):
    """An agent after a few updates, so that slow copies differ from what they copy, and a batch that it has not seen."""
    agent = make(name, **settings)
    for step in range(5):
        agent.update(batch_for(agent, seed=step))
    return agent, batch_for(agent, seed=9, measure=True)


def noise_ahead(agent, *draws):
    """What the agent's stream will give for these draws, ("normal" or "uniform", shape), without moving it."""
    random = agent.random["noise"]
    state = random.state_dict()
    found = [getattr(random, kind)(*shape)[0].numpy().astype(np.float64) for kind, shape in draws]
    random.load_state_dict(state)
    return found


def noisy(mean, noise, std=0.2, clip=0.3):
    return np.clip(mean + np.clip(noise * std, -clip, clip), -1 + 1e-6, 1 - 1e-6)


def normal_noise(agent, times=1):
    return ("normal", (times * SIZE, ACTION))


def smaller(critic, s, a):
    return values(critic, s, a).min(-1)


def test_names_and_what_they_are():
    names = {"bc", "cql", "cql-fixed", "crr", "iql", "rebrac", "td3", "td3-bc", "td3-fujimoto"}
    assert set(plugins.names("evaluators")) >= names
    for name in names:
        kind = plugins.load("evaluators", name)
        assert kind.summary
        assert kind.citation


# TD3 and what is made of it


def test_td3s_noise_enters_target_and_actor():
    agent, batch = warmed("td3")
    s, a, following, r, _ = numpy(batch)
    first, second = noise_ahead(agent, normal_noise(agent), normal_noise(agent))
    y = r + 0.99 * smaller(agent.target_critic, following, noisy(policy(agent, following), first))
    critic_loss = ((values(agent.critic, s, a) - y[:, None]) ** 2).mean(0).sum()
    own = noisy(policy(agent, s), second)
    metrics = agent.update(batch)
    assert metrics["critic_loss"].item() == pytest.approx(critic_loss, rel=1e-4)
    # The actor is judged by the critics after their step.
    assert metrics["actor_loss"].item() == pytest.approx(-smaller(agent.critic, s, own).mean(), rel=1e-4)


def test_fujimotos_td3_delays_and_has_a_target_actor():
    agent = make("td3-fujimoto")
    for step in range(5):
        agent.update(batch_for(agent, seed=step))
    # Five updates of the critics, two of the actor.
    steps = {name: next(iter(optimiser.state.values()))["step"].item() for name, optimiser in agent.optimisers.items()}
    assert steps == {"critic": 5, "actor": 2}
    batch = batch_for(agent, seed=9, measure=True)
    s, a, following, r, _ = numpy(batch)
    (noise,) = noise_ahead(agent, normal_noise(agent))
    slow = np.tanh(layers([p.detach().numpy()[0] for p in agent.target_actor.parameters()], following))
    assert not np.allclose(slow, policy(agent, following))
    y = r + 0.99 * smaller(agent.target_critic, following, noisy(slow, noise, clip=0.5))
    critic_loss = ((values(agent.critic, s, a) - y[:, None]) ** 2).mean(0).sum()
    own, old_actor, old_critic = (
        policy(agent, s),
        *([p.clone() for p in net.parameters()] for net in (agent.target_actor, agent.target_critic)),
    )
    metrics = agent.update(batch)
    assert metrics["critic_loss"].item() == pytest.approx(critic_loss, rel=1e-4)
    assert metrics["actor_loss"].item() == pytest.approx(-values(agent.critic, s, own)[:, 0].mean(), rel=1e-4)
    for before, online, slow_copy in ((old_actor, agent.actor, agent.target_actor), (old_critic, agent.critic, agent.target_critic)):
        for was, now, copy in zip(before, online.parameters(), slow_copy.parameters(), strict=True):
            torch.testing.assert_close(copy, 0.99 * was + 0.01 * now)
    # Between two updates of the actor neither it nor a slow copy moves.
    still = [p.clone() for net in (agent.actor, agent.target_actor, agent.target_critic) for p in net.parameters()]
    assert "actor_loss" not in agent.update(batch_for(agent, seed=10, measure=True))
    assert all(torch.equal(was, now) for was, now in zip(
        still, (p for net in (agent.actor, agent.target_actor, agent.target_critic) for p in net.parameters()), strict=True
    ))  # fmt: skip


@pytest.mark.parametrize("alpha", [2.5, 0.5])
def test_td3_bc_weighs_value_against_distance(alpha):
    agent, batch = warmed("td3-bc", alpha=alpha)
    s, a, _, _, _ = numpy(batch)
    _, second = noise_ahead(agent, normal_noise(agent), normal_noise(agent))
    mean = policy(agent, s)
    metrics = agent.update(batch)
    q = smaller(agent.critic, s, noisy(mean, second))
    expected = -alpha / np.abs(q).mean() * q.mean() + ((mean - a) ** 2).mean()
    assert metrics["actor_loss"].item() == pytest.approx(expected, rel=1e-4)
    assert metrics["bc_loss"].item() == pytest.approx(((mean - a) ** 2).mean(), rel=1e-4)


def test_the_scale_of_td3_bc_takes_no_gradient():
    agent, batch = warmed("td3-bc", noise_std=0.0)
    loss, _ = agent.actor_loss(batch)
    q = agent.critic(batch.observation, agent.actor(batch.observation)).amin(-1)
    other = -2.5 / q.abs().mean().item() * q.mean() + (agent.actor(batch.observation) - batch.action).square().mean()
    found = [torch.autograd.grad(one.sum(), list(agent.actor.parameters()), retain_graph=True) for one in (loss, other)]
    for one, two in zip(*found, strict=True):
        torch.testing.assert_close(one, two, atol=1e-6, rtol=1e-4)


def test_bc_maximises_the_likelihood_of_the_data():
    agent, batch = warmed("bc")
    s, a, _, _, _ = numpy(batch)
    expected = -norm.logpdf(a, policy(agent, s), 0.2).sum(-1).mean()
    batch.reward = torch.full_like(batch.reward, math.nan)
    assert agent.update(batch)["actor_loss"].item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("weight", ["indicator", "exp", "identity"])
def test_crr_clones_by_advantage(weight):
    agent, batch = warmed("crr", weight=weight, largest_weight=1.01, value_samples=4)
    s, a, following, r, _ = numpy(batch)
    first, second = noise_ahead(agent, normal_noise(agent), normal_noise(agent, 4))
    y = r + 0.99 * smaller(agent.target_critic, following, noisy(policy(agent, following), first))
    critic_loss = ((values(agent.critic, s, a) - y[:, None]) ** 2).mean(0).sum()
    mean = policy(agent, s)
    metrics = agent.update(batch)
    assert metrics["critic_loss"].item() == pytest.approx(critic_loss, rel=1e-4)
    drawn = [smaller(agent.critic, s, noisy(mean, noise)) for noise in second.reshape(4, SIZE, ACTION)]
    advantage = smaller(agent.critic, s, a) - np.mean(drawn, 0)
    weights = {"indicator": (advantage > 0) * 1.0, "exp": np.minimum(np.exp(advantage), 1.01), "identity": advantage}[weight]
    expected = -(weights * norm.logpdf(a, mean, 0.2).sum(-1)).mean()
    assert 0 < (advantage > 0).mean() < 1
    assert metrics["actor_loss"].item() == pytest.approx(expected, rel=1e-3, abs=1e-3)
    assert metrics["advantage"].item() == pytest.approx(advantage.mean(), rel=1e-3, abs=1e-5)


# CQL


def squashed(agent, s, noise, twice):
    """Action and log-density in each dimension, by change of variables."""
    out = layers([p.detach().numpy()[0] for p in agent.actor.parameters()], s)
    mean, log_std = out[:, :ACTION], np.clip(out[:, ACTION:], -10, 2)
    mean = np.tanh(mean) if twice else mean
    x = mean + np.exp(log_std) * noise
    return np.tanh(x), norm.logpdf(x, mean, np.exp(log_std)) - np.log(1 - np.tanh(x) ** 2)


@pytest.mark.parametrize("lagrange", [False, True])
@pytest.mark.parametrize("name", ["cql", "cql-fixed"])
def test_cql(name, lagrange):
    twice = name == "cql"
    agent, batch = warmed(name, lagrange=lagrange, penalty_target=0.1, penalty_weight=0.7)
    s, a, following, r, _ = numpy(batch)
    n = 3
    target_noise, uniform, own_noise, next_noise, actor_noise = noise_ahead(
        agent, normal_noise(agent), ("uniform", (n * SIZE, ACTION)), normal_noise(agent, n), normal_noise(agent, n), normal_noise(agent)
    )
    y = r + 0.99 * smaller(agent.target_critic, following, squashed(agent, following, target_noise, twice)[0])
    judged = [values(agent.critic, s, a)]
    judged += [values(agent.critic, s, u * 2 - 1) for u in uniform.reshape(n, SIZE, ACTION)]
    judged += [values(agent.critic, s, squashed(agent, s, x, twice)[0]) for x in own_noise.reshape(n, SIZE, ACTION)]
    judged += [values(agent.critic, s, squashed(agent, following, x, twice)[0]) for x in next_noise.reshape(n, SIZE, ACTION)]
    assert len(judged) == 10
    penalty = (logsumexp(judged, axis=0) - judged[0]).mean(0).sum()
    multiplier = agent.log_multiplier.item()
    temperature = agent.log_temperature.item()
    action, log_prob = squashed(agent, s, actor_noise, twice)
    log_prob = log_prob if twice else log_prob.sum(-1, keepdims=True)
    metrics = agent.update(batch)
    assert metrics["penalty"].item() == pytest.approx(penalty, rel=1e-4)
    # The multiplier's and the temperature's own steps come first; Adam's first direction is the sign of their gradients.
    weight = math.exp(agent.log_multiplier.item()) if lagrange else 0.7
    critic_loss = ((judged[0] - y[:, None]) ** 2).mean(0).sum() + weight * penalty
    assert metrics["critic_loss"].item() == pytest.approx(critic_loss, rel=1e-4)
    assert (agent.log_multiplier.item() > multiplier) == (lagrange and penalty > 0.1)
    assert (agent.log_multiplier.item() == multiplier) == (not lagrange)
    assert (agent.log_temperature.item() < temperature) == (log_prob.mean() - ACTION < 0)
    expected = (math.exp(agent.log_temperature.item()) * log_prob - smaller(agent.critic, s, action)[:, None]).mean()
    assert metrics["actor_loss"].item() == pytest.approx(expected, rel=1e-3, abs=1e-4)
    assert metrics["entropy"].item() == pytest.approx(-log_prob.mean(), rel=1e-3)


def test_exorls_cql_cannot_act_beyond_tanh_one_and_the_fixed_one_can():
    largest = {}
    for name in ("cql", "cql-fixed"):
        agent = make(name)
        with torch.no_grad():
            agent.actor[-1].weight.mul_(1e3)
        largest[name] = agent.act(torch.randn(1, 200, 24)).abs().max().item()
    assert largest["cql"] == pytest.approx(math.tanh(1), abs=1e-4)
    assert largest["cql-fixed"] > 0.99


def test_cqls_mean_action_is_what_its_policy_gives():
    for name in ("cql", "cql-fixed"):
        agent = make(name)
        observation = torch.randn(1, 7, 24)
        out = layers([p.detach().numpy()[0] for p in agent.actor.parameters()], observation[0].numpy().astype(np.float64))[:, :ACTION]
        expected = np.tanh(np.tanh(out)) if name == "cql" else np.tanh(out)
        np.testing.assert_allclose(agent.act(observation)[0].numpy(), expected, atol=1e-5)
        assert torch.equal(agent.policy(observation), agent.act(observation))


# IQL and ReBRAC


def plain_layers(parameters, x, norm=False):
    """Linear and ReLU, and LayerNorm where there is one, repeatedly; linear at the end."""
    p = [parameter.astype(np.float64) for parameter in parameters]
    while len(p) > 2:
        x = np.maximum(x @ p[0] + p[1], 0)
        del p[:2]
        if norm:
            x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * p[0] + p[1]
            del p[:2]
    return x @ p[0] + p[1]


def of(module, member=0):
    return [p.detach().numpy()[member] for p in module.parameters()]


def twins(critic, s, a, norm=False):
    both = [[p.detach().numpy()[twin] for p in critic.parameters()] for twin in range(2)]
    return np.concatenate([plain_layers(p, np.concatenate([s, a], -1), norm) for p in both], -1)


def test_iql():
    agent, batch = warmed("iql", schedule_steps=20, beta=3.0, largest_weight=1.02)
    s, a, following, r, _ = numpy(batch)
    with torch.no_grad():  # so that advantages have both signs
        agent.value[-1].bias.sub_(0.17)
    v, v_next = (plain_layers(of(agent.value), x)[:, 0] for x in (s, following))
    advantage = twins(agent.target_critic, s, a).min(-1) - v
    assert 0 < (advantage < 0).mean() < 1
    value_loss = (np.abs(0.7 - (advantage < 0)) * advantage**2).mean()
    q = twins(agent.critic, s, a)
    critic_loss = ((q - (r + 0.99 * v_next)[:, None]) ** 2).mean()
    std = np.exp(agent.log_std.detach().numpy()[0])
    mean = np.tanh(plain_layers(of(agent.actor), s))
    weight = np.minimum(np.exp(3.0 * advantage), 1.02)
    actor_loss = -(weight * norm.logpdf(a, mean, std).sum(-1)).mean()
    old = [p.clone() for p in agent.target_critic.parameters()]
    metrics = agent.update(batch)
    for name, value in (("value_loss", value_loss), ("critic_loss", critic_loss), ("actor_loss", actor_loss), ("q", q.mean())):
        assert metrics[name].item() == pytest.approx(value, rel=1e-4), name
    assert metrics["weight"].item() == pytest.approx(weight.mean(), rel=1e-4)
    # The sixth of 20 steps on the cosine.
    (group,) = agent.optimisers["actor"].param_groups
    assert group["lr"] == pytest.approx(1e-3 * 0.5 * (1 + math.cos(math.pi * 5 / 20)))
    assert agent.optimisers["critic"].param_groups[0]["lr"] == 1e-3
    for before, online, target in zip(old, agent.critic.parameters(), agent.target_critic.parameters(), strict=True):
        torch.testing.assert_close(target, 0.995 * before + 0.005 * online)


def test_iqls_actor_stops_learning_at_the_end_of_its_schedule():
    agent = make("iql", schedule_steps=3)
    for step in range(3):
        agent.update(batch_for(agent, seed=step))
    before = [p.clone() for p in agent.actor.parameters()]
    agent.update(batch_for(agent, seed=4))
    assert all(torch.equal(was, now) for was, now in zip(before, agent.actor.parameters(), strict=True))


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


def test_rebrac():
    agent = make("rebrac", actor_penalty=0.3, critic_penalty=0.2)
    for step in range(5):
        agent.update(batch_for(agent, seed=step))
    steps = {name: next(iter(optimiser.state.values()))["step"].item() for name, optimiser in agent.optimisers.items()}
    assert steps == {"critic": 5, "actor": 2}
    batch = batch_for(agent, seed=9, measure=True)
    s, a, following, r, next_action = numpy(batch)
    (noise,) = noise_ahead(agent, normal_noise(agent))
    next_own = noisy(np.tanh(plain_layers(of(agent.target_actor), following)), noise, clip=0.5)
    distance = ((next_own - next_action) ** 2).sum(-1)
    y = r + 0.99 * (twins(agent.target_critic, following, next_own, True).min(-1) - 0.2 * distance)
    critic_loss = ((twins(agent.critic, s, a, True) - y[:, None]) ** 2).mean(0).sum()
    own = np.tanh(plain_layers(of(agent.actor), s))
    metrics = agent.update(batch)
    assert metrics["critic_loss"].item() == pytest.approx(critic_loss, rel=1e-4)
    q = twins(agent.critic, s, own, True).min(-1)
    expected = (0.3 * ((own - a) ** 2).sum(-1) - q / np.abs(q).mean()).mean()
    assert metrics["actor_loss"].item() == pytest.approx(expected, rel=1e-4, abs=1e-5)


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


def test_configurations_are_those_of_the_code_that_they_follow():
    def values_of(name):
        return vars(plugins.load("evaluators", name).configure())

    exorl = {"batch_size": 1024, "width": 1024, "learning_rate": 1e-4}
    for name in ("td3", "td3-bc", "bc", "crr", "cql", "cql-fixed", "td3-fujimoto"):
        assert {key: values_of(name)[key] for key in exorl} == exorl
    assert values_of("td3-bc")["alpha"] == 2.5
    crr, iql, rebrac = (values_of(name) for name in ("crr", "iql", "rebrac"))
    assert (crr["weight"], crr["value_samples"], crr["largest_weight"]) == ("indicator", 10, 20.0)
    cql = values_of("cql")
    assert (cql["penalty_weight"], cql["penalty_samples"], cql["lagrange"], cql["penalty_target"]) == (0.01, 3, False, 5.0)
    assert {key: iql[key] for key in ("batch_size", "width", "learning_rate", "critic_tau", "expectile", "beta", "largest_weight")} == {
        "batch_size": 256, "width": 256, "learning_rate": 3e-4, "critic_tau": 0.005, "expectile": 0.7, "beta": 3.0, "largest_weight": 100.0,
    }  # fmt: skip
    assert {key: rebrac[key] for key in ("batch_size", "width", "learning_rate", "critic_tau", "noise_clip", "policy_delay")} == {
        "batch_size": 1024, "width": 256, "learning_rate": 1e-3, "critic_tau": 0.005, "noise_clip": 0.5, "policy_delay": 2,
    }  # fmt: skip
