"""Every registered collector equals its formulas: three updates from given weights against the step-by-step versions of ``oracles``.

Gradients are compared as they stand in Adam's moments, too, since Adam's step hardly depends on their scale. Both sides compute in float64:
there two right versions differ by rounding alone, and a wrong factor, axis, sign, copy or order shows in the first digits. That float32,
in which collectors run, gives the same within its own rounding is a test of its own.
"""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

from cudc_bench import plugins
from cudc_bench.collectors.contract import SPACES
from cudc_bench.learning.replay import Batch
from cudc_bench.settings.seeding import stream_seed
from tests.learning.precision import in_precision
from tests.plain import assert_same, doubles, noisy, perturb, trunk_mlp

from .helpers import batch_for, make
from .oracles import ORACLES, RELATIVES, Explorer, Found, Sample, beside, explore

# The sizes all differ, from each other and from those of Walker, so that no axis is taken for another.
SEEDS, SIZE, FEATURES, RATE = (1, 2), 20, 14, 1e-3
# How many steps beyond the smallest k lie between s and s', in each of three minibatches, for each of two members.
FURTHER = ((0, 2), (1, 0), (3, 2))
SMALL_SIZES: dict[str, dict[str, Any]] = {"proto": {"prototypes": 18, "queue_size": 36, "projection_hidden": 10}}
# Values that differ from a method's own, one dictionary for each further run. Those that name a threshold make k grow, but not each time.
GROWING = {"temperature": 20.0, "c_w": 0.959}
FURTHER_RUNS: dict[str, list[dict[str, Any]]] = {
    "icm": [
        {"reward_scale": 2.5, "discount": 0.9, "critic_tau": 0.2},
        {"td_discount": "gamma"},
        {"noise_std": 2.0, "noise_clip": 1.5},  # beyond the bounds of actions
    ],
    "apt": [{"neighbours": 5, "knn_exclude_self": True}],
    "apt-ksched": [{"k_steps": (4001, 4004, 4007)}],
    "be": [
        {"alpha": 1.0, "particle_weight": "distance"},
        {"alpha": 3.0, "neighbours": 5, "knn_exclude_self": True, "normalise_by": "running_mean", "distance_floor": 0.9},
    ],
    "proto": [{"temperature": 0.3, "neighbours": 5, "sinkhorn_iterations": 1, "encoder_tau": 0.3, "queue_size": 72}],
    "aps": [{"neighbours": 5, "knn_exclude_self": True, "distance_floor": 0.5, "task_dim": 4}],
    "rnd": [{"observation_clip": 0.8, "reward_scale": 2.0}],
    "disagreement": [{"models": 3}],
    "diayn": [{"skills": 5}],
    "smm": [
        {"discriminator_weight": -0.5, "kl_weight": 2.0, "novelty_weight": 0.3, "latent_weight": 3.0, "latent_dim": 7},
        {"vae_learning_rate": 3e-3, "discriminator_learning_rate": 2e-3, "skills": 3},
    ],
    "cic": [
        {"normalise_by": "std", "neighbours": 5, "knn_exclude_self": True, "temperature": 1.3, "distance_floor": 0.5, "skill_dim": 7},
    ],
    "moss": [
        {"normalise_by": "std", "neighbours": 5, "knn_exclude_self": True, "temperature": 1.3, "distance_floor": 0.5, "skill_dim": 7},
        {"skill_mode": "sign", "periods": 4.0},
    ],
    "ctec": [{"logsumexp_weight": 2.0, "embedding_dim": 5}],
    "metra": [
        {"skill_dim": 3, "slack": 0.7, "multiplier": 0.8, "horizon": 2},
        {"discrete": True, "skill_dim": 5, "multiplier": 4.0},
    ],
    "cudc": [
        {"state_target": "live", "knn_exclude_self": True, "neighbours": 5} | GROWING,
        {"state_target": "momentum", "momentum_tau": 0.3, "alpha": 2.0, "beta": 0.5, "loss_weights": (0.5, 2.0, 3.0, 0.1)},
        {"action_target": "live", "temperature": 3.0, "td_discount": "gamma", "keys": 50},
        {"weight_mode": "mean_normalised", "clip_low": 0.99, "clip_high": 1.01, "patience": 2} | GROWING | {"c_w": 0.98},
        {"reward_after_update": True, "min_dwell": 4} | GROWING,
        {"reward_after_update": True, "keys": 24},
        {"keys": 1024},
        {"min_dwell": 4, "updates": 10} | GROWING | {"c_w": 0.98},
        {"c_k": 0.7, "min_dwell": 1} | GROWING | {"c_w": 0.9715},
        {"horizon": 4, "w_init": "scaled_identity"},
    ],
    "cudc-vary-icm": [{"threshold_dwell": 0, "c_r": 1.9}, {"threshold_dwell": 4, "c_r": 2.0}, {"state_target": "momentum"}],
    "cudc-vary-apt": [{"threshold_dwell": 0, "c_r": 1.312}, {"threshold_dwell": 4, "c_r": 1.4}, {"state_target": "momentum"}],
    "cudc-reward": [{"threshold_dwell": 0, "c_r": 1.405}, {"threshold_dwell": 2, "c_r": 1.42}, {"state_target": "live"}],
    "cudc-no-reach": [
        {"threshold_dwell": 0, "c_e": 2.8},
        {"threshold_dwell": 2, "c_e": 2.9},
        {"state_target": "momentum"},
        {"state_target": "live"},
    ],
    "cudc-kmax4": [GROWING],
    "cudc-normal-k": [{"normal_steps": 6000, "normal_std": 0.5}, {"normal_steps": 10, "normal_std": 0.0, "seed_steps": 2}],
    "cudc-kmix": [{"state_target": "momentum"} | GROWING],
}
# Bookkeeping of the rule for k, compared as what comes of it: k, and the manifest's list of its increments.
BOOKKEEPING = {"updates", "k", "skill", "in_a_row", "last_change", "increments"}
# What is no number in a formula: sizes, with the values of the specification, and the switches between CUDC's relatives.
SIZES: dict[str, Any] = {"width": 1024, "batch_size": 1024, "feature_dim": 512, "horizon": 3}
SIZES_OF: dict[str, dict[str, Any]] = {
    "apt-k6": {"horizon": 6},
    "proto": {"feature_dim": 128, "projection_hidden": 512, "prototypes": 512},
    "aps": {"task_dim": 10, "skill_every": 5},
    "disagreement": {"models": 5},
    "diayn": {"skills": 16, "skill_every": 50},
    "smm": {"vae_hidden": 150, "skills": 4, "skill_every": 0},
    "cic": {"skill_dim": 64, "skill_every": 50},
    "moss": {"skill_dim": 32, "skill_every": 50, "periods": 2.0},
    "ctec": {"embedding_dim": 64},
    "metra": {"skill_dim": 4, "skill_every": 0, "horizon": 1, "multiplier": 30.0},
}
OF_CUDC = {"action_feature_dim": 64, "action_hidden": 64, "projection_hidden": 128, "projection_dim": 64, "w_init": "uniform"}
SWITCHES = {
    "k_max", "encoder", "action_encoder", "inverse", "step_model", "reach", "regularize", "entropy", "prediction_error", "k_rule",
    "inverse_k_batch",
}  # fmt: skip

SLOW_COPIES = {
    "target_critic": "critic", "slow_predictor": "predictor", "momentum_encoder": "state_encoder", "momentum_projection": "projection",
}  # fmt: skip
TWO_LAYERS = {"critic.hidden.weight": 2, "encoder.4.weight": 2}  # kept as one; each is orthogonal on its own

AGENT = set(inspect.signature(explore).parameters)
NAMES = [name for name in plugins.names("collectors") if "cudc-bench" in plugins.package("collectors", name) and name != "random"]
RUNS = [(name, settings) for name in NAMES for settings in [{}, *FURTHER_RUNS.get(name, [])]]


def title(run: tuple[str, dict[str, Any]]) -> str:
    name, settings = run
    return name + "".join(f" {key}={value}" for key, value in settings.items())


def of_a_run(name: str, settings: dict[str, Any]) -> dict[str, Any]:
    """The values of a run that differ from the method's own."""
    kind, common = plugins.load("collectors", name), dict(SMALL_SIZES.get(name, {}))
    if (threshold := kind.measured_by_pilot(kind.configure("walker"))) is not None:
        common[threshold] = 0.5
    return common | settings


def given(name: str, values: dict[str, Any], seed_steps: int = 4000, updates: int = 0) -> Any:
    """A collector whose every weight was moved: nothing is zero, one, or equal to its slow copy by construction."""
    sizes = replace(SPACES["walker"], seed_steps=seed_steps)
    collector = make(name, SEEDS, sizes, batch_size=SIZE, feature_dim=FEATURES, learning_rate=RATE, **values)
    perturb(collector, scale=0.1, seed=3)
    collector.updates.fill_(updates)
    return in_precision(collector, torch.float64)


def minibatch(collector: Any, update: int) -> Batch:
    """The update's minibatch, of which every second one is not measured. What a collector must not read is not a number."""
    batch = batch_for(collector, SIZE, seed=10 + update, measure=update % 2 == 0)
    first, last = collector.config.horizon, getattr(collector.config, "k_max", 1000)
    batch.horizon = torch.tensor([first + further % (last - first + 1) for further in FURTHER[update]])
    if collector.min_horizon is not None:
        batch.nearer_observation = batch.observation.flip(1) - batch.next_observation
        batch.nearer_horizon = collector.min_horizon + torch.arange(SIZE) % (batch.horizon[:, None] - collector.min_horizon + 1)
    if batch.skill is not None:
        batch.skill = batch.skill.double()
    if batch.other_observation is not None:
        batch.other_observation.fill_(torch.nan)
    batch.reward, batch.next_action = torch.full((len(SEEDS), SIZE), torch.nan), torch.full_like(batch.action, torch.nan)
    return batch


def sample(batch: Batch, e: int) -> Sample:
    parts = (batch.observation, batch.action, batch.next_observation, batch.horizon, batch.skill)
    s, a, s_next, k, skill = (None if part is None else part[e] for part in parts)
    later = (batch.nearer_observation, batch.nearer_horizon, batch.future_observation)
    return Sample(s, a, s_next, int(k), skill, *(None if part is None else part[e] for part in later))


def watch(collector: Any) -> dict[str, Tensor | None]:
    """What the collector's last update rewarded, and how it weighed the samples."""
    seen: dict[str, Tensor | None] = {}

    def keep(name: str) -> None:
        method = getattr(collector, name)

        def kept(batch: Batch) -> Tensor | None:
            seen[name] = method(batch)
            return seen[name]

        setattr(collector, name, kept)

    keep("reward")
    keep("sample_weight")
    return seen


def compare(collector: Any, seen: dict[str, Tensor | None], metrics: dict[str, Tensor], member: Explorer, found: Found) -> None:
    e, when = member.e, f"update {member.updates}"
    where = f"{when}, member {member.e}: "
    # From a difference of squares, a distance of 0 comes out as the root of float64's rounding.
    rewards = seen["reward"][e], found.reward.detach()
    torch.testing.assert_close(*rewards, rtol=1e-8, atol=5e-8, msg=lambda text: f"{where}the reward: {text}")
    assert (seen["sample_weight"] is None) == (found.weight is None)
    if found.weight is not None:
        assert_same(seen["sample_weight"][e], found.weight, where + "the samples' weight")
    if metrics:
        assert set(metrics) == set(found.metrics)
    for name, value in metrics.items():
        rel = 1e-6 if value.dtype == torch.float32 else 1e-8  # shares of a minibatch are counted in float32
        assert value[e].detach().item() == pytest.approx(float(torch.as_tensor(found.metrics[name]).detach()), rel=rel), where + name
    assert collector.horizon[e] == member.k, where + "k"
    assert int(collector.updates) == member.updates
    increments = [{key: pytest.approx(value, rel=1e-6 if key == "p" else 1e-8) for key, value in one.items()} for one in member.increments]
    assert collector.summary()[e].get("k_increments", []) == increments
    saved = collector.state_dict()["networks"]
    for name, value in collector.named_buffers():
        if name in saved and name not in BOOKKEEPING:
            expected = torch.as_tensor(member.kept[name], dtype=torch.float64)
            assert_same((value[e] if value.dim() else value).double(), expected, where + name)
    member.assert_equals(collector, when)


def oracle_of(name: str) -> Any:
    if name not in ORACLES:
        pytest.fail(f"the collector '{name}' is registered but has no oracle: write down its formulas in tests/collectors/oracles.py")
    return ORACLES[name]


@pytest.mark.parametrize("run", RUNS, ids=title)
def test_three_updates_equal_the_formulas(run: tuple[str, dict[str, Any]]) -> None:
    name, settings = run
    oracle, values = oracle_of(name), of_a_run(name, settings)
    times = {key: values.pop(key) for key in ("seed_steps", "updates") if key in values}
    own = {key: value for key, value in values.items() if key not in AGENT}
    agent = {key: value for key, value in values.items() if key in AGENT} | {"learning_rate": RATE}
    with doubles():
        collector = given(name, values, **times)
        assert collector.min_horizon == (3 if name == "cudc-kmix" else None)
        assert collector.horizon.tolist() == [settings.get("horizon", {"apt-k6": 6, "metra": 1}.get(name, 3))] * len(SEEDS)
        members = [Explorer(collector, e) for e in range(len(SEEDS))]
        seen = watch(collector)
        for update in range(len(FURTHER)):
            batch = minibatch(collector, update)
            metrics = collector.update(batch)
            assert bool(metrics) == batch.measure
            for member in members:
                found = explore(member, sample(batch, member.e), oracle, own, **agent)
                compare(collector, seen, metrics, member, found)
        if set(settings) & {"c_w", "c_r", "c_e"}:
            assert 0 < sum(len(member.increments) for member in members) < len(FURTHER) * len(SEEDS)
        # And then they act: the mean, and around it Gaussian noise that nothing cuts off but the bounds of actions.
        observation = torch.randn(len(SEEDS), collector.sizes.observation) * 3
        if collector.skill_size:
            collector.skill.copy_(batch.skill[:, 0])
        calm, noise = collector.act(observation, explore=False), collector.act(observation)
        for member in members:
            skill = batch.skill[member.e, :1] if collector.skill_size else None
            mean = torch.tanh(trunk_mlp(member.actor, beside(observation[member.e][None], skill)))[0].detach()
            assert_same(calm[member.e], mean, "what it would do")
            assert_same(noise[member.e], noisy(mean, member.normal(6, purpose="act"), values.get("noise_std", 0.2), 1e9), "what it does")


@pytest.mark.parametrize("name", NAMES)
def test_hyperparameters_are_those_of_the_formulas(name: str) -> None:
    """Every number of a method's configuration has a part in its formulas, or is a size; its default is the one that is written down."""
    config = vars(plugins.load("collectors", name).configure("walker"))
    written = {
        key: one.default
        for function in (oracle_of(name), explore)
        for key, one in inspect.signature(function).parameters.items()
        if key in config and one.default is not inspect.Parameter.empty
    }
    sizes = SIZES | (OF_CUDC if name in RELATIVES else {}) | SIZES_OF.get(name, {})
    written |= {key: value for key, value in sizes.items() if key in config}
    assert {key: value for key, value in config.items() if key not in SWITCHES or name not in RELATIVES} == written


def layers(name: str) -> dict[str, tuple[int, ...]]:
    """The sizes of every network, from its input to its output (spec 2 to 5)."""
    s, a, w, z = 24, 6, 16, FEATURES
    if name in RELATIVES:
        parts, found = RELATIVES[name], {}
        ks = parts.k_max - 2
        z_a = 64 if parts.phi_a else a
        if parts.encoder is None:
            z = s
        else:
            found["state_encoder"] = (s, w, z) if parts.encoder == "φ_s" else (s, z)
        if parts.phi_a:
            found["action_encoder"] = (a, 64, 64, 64)
        found["forward_model"] = (z + z_a + ks, w, z)
        if parts.inverse is not None:
            found["inverse_model"] = (2 * z + ks, w, 64) if parts.inverse == "features" else (2 * z, w, a)
        if parts.f_k:
            found["step_model"] = (2 * z, w, ks)
        if parts.reach:
            found |= {"projection": (z, 128, 64), "momentum_projection": (z, 128, 64), "similarity": (64, 64)}
        if parts.reach or name == "cudc-momentum":
            found["momentum_encoder"] = found["state_encoder"]
        skill, values = 0, 1
    else:
        apt = {"encoder": (s, z), "forward_model": (z + a, w, z), "inverse_model": (2 * z, w, a)}
        found = {
            "icm": {"forward_model": (s + a, w, s), "inverse_model": (2 * s, w, a)},
            **dict.fromkeys(["apt", "apt-k6", "apt-ksched", "be"], apt),
            "proto": {"predictor": (s, z), "slow_predictor": (s, z), "projector": (z, 10, z), "prototypes": (z, 18)},
            "aps": {"features": (s, w, w, 10)},
            "rnd": {"predictor": (s, w, w, z), "random_network": (s, w, w, z)},
            "disagreement": {"models": (s + a, w, s)},
            "diayn": {"discriminator": (s, w, w, 16)},
            "smm": {"encoder": (s + 4, 150, 150, 2 * 128), "decoder": (128, 150, 150, s + 4), "discriminator": (s, w, w, 4)},
            **{
                name: {"state_network": (s, w, w, d), "pair_network": (2 * d, w, w, d), "skill_network": (d, w, w, d)}
                for name, d in (("cic", 64), ("moss", 32))
            },
            "ctec": {"pair_encoder": (s + a, w, w, 64), "state_encoder": (s, w, w, 64)},
            "metra": {"state_network": (s, w, w, 4)},
        }[name]
        skill, values = {"aps": 10, "diayn": 16, "smm": 4, "cic": 64, "moss": 32, "metra": 4}.get(name, 0), 10 if name == "aps" else 1
    # Two heads side by side behind one trunk, the hidden layers of both together.
    critic = (s + skill + a, w, 2 * w, 2 * values)
    return found | {"actor": (s + skill, w, w, a), "critic": critic, "target_critic": critic}


@pytest.mark.parametrize("name", NAMES)
def test_networks_have_the_layers_of_the_specification(name: str) -> None:
    collector = make(name, SEEDS, batch_size=SIZE, feature_dim=FEATURES, **of_a_run(name, {}))
    found: dict[str, list[int]] = {}
    for label, weight in collector.named_parameters():
        inputs, outputs = weight.shape[1:]
        network = label.split(".")[0]
        if network == "prototypes":
            inputs, outputs = outputs, inputs
        if inputs > 1:  # neither a bias nor a scale
            sizes = found.setdefault(network, [inputs])
            assert inputs in {sizes[-1], 2 * sizes[-1]} if network.endswith("critic") else inputs == sizes[-1]
            sizes.append(outputs)
    assert {network: tuple(sizes) for network, sizes in found.items()} == layers(name)


def assert_orthogonal(weight: Tensor) -> None:
    """Columns, or rows where those are fewer, of length 1 at right angles."""
    tall = weight if len(weight) >= weight.shape[1] else weight.T
    torch.testing.assert_close(tall.T @ tall, torch.eye(tall.shape[1]), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_networks_start_orthogonal_and_slow_copies_exact(name: str) -> None:
    """Layers of gain 1 with biases 0, normalisations of scale 1 (spec 2), and three exceptions."""
    collector = make(name, SEEDS, batch_size=SIZE, feature_dim=FEATURES, **of_a_run(name, {}))
    weights = dict(collector.named_parameters())
    for label, weight in weights.items():
        network, kind = label.split(".")[0], label.split(".")[-1]
        if network in SLOW_COPIES:
            assert torch.equal(weight, weights[label.replace(network, SLOW_COPIES[network])])
            assert not weight.requires_grad
        elif network == "models":  # PyTorch's own start: uniform within 1 / √inputs
            assert 0 < weight.abs().max() <= (30 if ".0." in label else 16) ** -0.5
        elif network == "similarity":
            assert 0 <= weight.min() < 0.01
            assert 0.99 < weight.max() < 1
        elif network == "prototypes":
            torch.testing.assert_close(weight.detach().norm(dim=-1), torch.ones(weight.shape[:2]))
        elif network == "log_multiplier":
            torch.testing.assert_close(weight.detach().exp(), torch.full((len(SEEDS), 1, 1), 30.0))
        elif weight.shape[1] == 1:
            assert (weight == (kind == "weight")).all()
        elif label == "critic.out.weight":  # each head reads its own half
            for member in weight.detach():
                (first, none), (nothing, second) = (half.chunk(2, dim=1) for half in member.chunk(2))
                assert not none.any()
                assert not nothing.any()
                assert_orthogonal(first)
                assert_orthogonal(second)
        else:
            for member in weight.detach():
                for layer in member.chunk(TWO_LAYERS.get(label, 1), dim=1):
                    assert_orthogonal(layer)


@pytest.mark.parametrize("name", NAMES)
def test_float32_gives_the_same_within_its_rounding(name: str) -> None:
    """What is proved in float64 holds for what runs: no formula loses more digits than its sums and differences of squares must.

    Distances between neighbours are good to 1e-3 of the largest norm where they are small, and the scores of futures to 1e-5.
    """
    single, double = (given(name, of_a_run(name, {})) for _ in range(2))
    in_precision(single, torch.float32)
    found, expected = watch(single), watch(double)
    for collector, dtype in ((single, torch.float32), (double, torch.float64)):
        batch = minibatch(collector, 1)
        for part in ("observation", "action", "next_observation", "nearer_observation", "future_observation", "skill"):
            if (value := getattr(batch, part)) is not None:
                setattr(batch, part, value.to(dtype))
        collector.update(batch)
    for what, value in found.items():
        if value is not None:
            torch.testing.assert_close(value.double(), expected[what], rtol=1e-4, atol=1e-3 if what == "reward" else 1e-4)


def test_random_actions_are_uniform_and_nothing_is_learnt() -> None:
    collector = make("random", SEEDS)
    streams = [Generator().manual_seed(stream_seed(seed, "act")) for seed in SEEDS]
    assert collector.update(batch_for(collector)) == {}
    assert collector.act(torch.zeros(2, 24), explore=False).tolist() == [[0.0] * 6] * 2
    expected = torch.stack([2 * torch.rand(6, generator=stream) - 1 for stream in streams])
    torch.testing.assert_close(collector.act(torch.ones(2, 24)), expected)
