"""CUDC's relatives do what their row of the paper's studies says: read off the running methods, not off their settings."""

import math

import pytest
import torch
from scipy.stats import norm

from cudc_bench import plugins
from cudc_bench.collectors.apt import APT
from cudc_bench.collectors.base import Sizes
from cudc_bench.collectors.cudc import CUDC, CUDCConfig
from cudc_bench.envs import DOMAINS
from cudc_bench.learning.networks import minimise
from cudc_bench.settings.config import as_dict, config_hash

from .helpers import batch_for, make

# Which of the three shares makes k grow, or that it is drawn, and the largest k: section 4 of the specification, whose other columns are
# those of the formulas in oracles.py.
TABLE = {
    **dict.fromkeys(["cudc-vary-icm", "cudc-vary-apt", "cudc-reward"], ("reward", 6)),
    "cudc-no-reach": ("error", 6),
    **dict.fromkeys(["cudc-uniform-k", "cudc-normal-k"], ("drawn", 6)),
    **dict.fromkeys(["cudc-no-vary", "cudc-kmax3"], (None, 3)),
    **{f"cudc-kmax{k}": ("weight", k) for k in range(4, 9)},
    **dict.fromkeys(
        ["cudc", "cudc-reach", "cudc-no-regularize", "cudc-no-entropy", "cudc-no-pe", "cudc-no-inverse", "cudc-one-setting", "cudc-live",
         "cudc-stopgrad", "cudc-momentum", "cudc-literal", "cudc-kmix"], ("weight", 6),
    ),
}  # fmt: skip
ALIASES = [("cudc-reach", "cudc-no-regularize"), ("cudc-no-vary", "cudc-kmax3"), ("cudc", "cudc-kmax6"), ("cudc", "cudc-stopgrad")]
THRESHOLDS = {"weight": "c_w", "reward": "c_r", "error": "c_e"}


def test_the_table_holds_every_relative():
    related = {name for name in plugins.names("collectors") if issubclass(plugins.load("collectors", name), CUDC)}
    assert related == set(TABLE)


@pytest.mark.parametrize("rule", THRESHOLDS)
@pytest.mark.parametrize("name", TABLE)
def test_what_makes_k_grow(name, rule):
    """One threshold is beyond every value, the others below: k grows if and only if the method looks at that one."""
    thresholds = dict.fromkeys(THRESHOLDS.values(), 0.0) | {THRESHOLDS[rule]: 1.0 if rule == "weight" else 1e9}
    grows, k_max = TABLE[name]
    # At this temperature every future is as likely as the others, and no w rounds to 1.
    c = make(name, threshold_dwell=0, temperature=1e6, **thresholds)
    seen = []
    for step in range(12):
        batch = batch_for(c, seed=step)
        seen.append(int(batch.horizon))
        c.update(batch)
    if grows == "drawn":
        assert len(set(seen)) > 1
    elif grows == rule:
        assert seen == [min(3 + step, k_max) for step in range(12)]
    else:
        assert seen == [3] * 12
    assert c.max_horizon == k_max


# Equality with what they come from


def copied(source, target, extra):
    """Give ``target`` the weights of ``source``; rows of the first layer that stand for k come last, and count nothing."""
    with torch.no_grad():
        for (name, new), old in zip(target.named_parameters(), source.parameters(), strict=True):
            if new.shape != old.shape:
                assert name.startswith("0.")
                new.zero_()
                new[:, : old.shape[1]] = old
                assert new.shape[1] == old.shape[1] + extra
            else:
                new.copy_(old)


@pytest.mark.parametrize(("base", "variant"), [("icm", "cudc-vary-icm"), ("apt", "cudc-vary-apt")])
def test_without_k_they_are_the_methods_that_they_extend(base, variant):
    plain, extended = make(base), make(variant, k_max=3)
    copied(plain.forward_model, extended.forward_model, 1)
    copied(plain.inverse_model, extended.inverse_model, 0)
    if base == "apt":
        copied(plain.encoder, extended.state_encoder, 0)
    for step in range(5):
        batches = [batch_for(c, seed=step) for c in (plain, extended)]
        losses = [c.auxiliary_loss(batch)[1] for c, batch in zip((plain, extended), batches, strict=True)]
        assert losses[1]["loss_step"].item() == 0  # one k alone is no question
        for name in ("loss_forward", "loss_inverse"):
            torch.testing.assert_close(losses[0][name], losses[1][name])
        rewards = [c.reward(batch) for c, batch in zip((plain, extended), batches, strict=True)]
        torch.testing.assert_close(rewards[0], rewards[1])


@pytest.mark.parametrize("pair", ALIASES)
def test_two_names_for_one_setting_share_everything(pair):
    first, second = (plugins.load("collectors", name) for name in pair)
    assert first is second
    hashes = {config_hash(as_dict(kind.configure(domain))) for kind in (first, second) for domain in ("walker",)}
    assert len(hashes) == 1


def test_other_names_are_other_settings():
    rest = set(TABLE) - {pair[1] for pair in ALIASES}
    hashes = {name: config_hash(as_dict(plugins.load("collectors", name).configure("walker"))) for name in rest}
    # The paper's bounds (0.2, 2) and (0.2, 1) are one for a weight of at most 1, but they are written differently.
    assert len(set(hashes.values())) == len(rest)


def test_one_setting_is_the_same_in_every_domain():
    found = [as_dict(plugins.load("collectors", "cudc-one-setting").configure(domain)) for domain in DOMAINS]
    assert found[0] == found[1] == found[2]
    assert {name: found[0][name] for name in ("alpha", "beta", "clip_low", "clip_high", "c_w")} == {
        "alpha": 1e-3, "beta": 1e-2, "clip_low": 0.2, "clip_high": 1.0, "c_w": 0.02,
    }  # fmt: skip
    for name in set(TABLE) - {"cudc-one-setting", "cudc-vary-icm", "cudc-vary-apt"}:
        for domain, values in CUDC.domain_values.items():
            config = plugins.load("collectors", name).configure(domain)
            assert {key: getattr(config, key) for key in values} == values


@pytest.mark.parametrize(
    ("name", "settings", "what"),
    [
        ("cudc", {"reach": False}, "regularize needs reach"),
        ("cudc", {"reach": False, "regularize": False}, "k_rule=weight needs reach"),
        ("cudc", {"action_encoder": False}, "inverse=features predicts"),
        ("cudc", {"entropy": False, "prediction_error": "none"}, "leave no reward"),
        ("cudc", {"k_rule": "reward"}, "c_r has no value"),
        ("cudc", {"k_rule": "error"}, "c_e has no value"),
        ("cudc", {"step_model": False, "inverse_k_batch": "mixed"}, "needs the step_model"),
        ("cudc-kmax4", {"horizon": 5}, "k_max=4 is below the first horizon 5"),
        ("cudc", {"neighbours": 33}, "33 neighbours cannot be found"),
    ],
)
def test_switches_that_do_not_fit_are_refused(name, settings, what):
    kind = plugins.load("collectors", name)
    with pytest.raises(ValueError, match=what):
        kind(Sizes("walker", 24, 6, 1000, 0, 2), kind.configure("walker", {"width": 8, "batch_size": 32}, settings), [1])


def test_switches_compose_beyond_the_named_settings():
    """A user may combine parts as no paper did."""
    settings = [
        {"encoder": "none", "state_target": "momentum"},
        {"encoder": "apt", "inverse": "none", "prediction_error": "log", "k_rule": "error", "c_e": 0.1},
        {"reach": False, "regularize": False, "k_rule": "reward", "c_r": 0.1, "state_target": "momentum"},
        {"inverse": "actions", "action_encoder": False, "weight_mode": "mean_normalised", "reward_after_update": True},
        {"inverse_k_batch": "mixed", "k_rule": "uniform", "state_target": "stopgrad"},
    ]
    for chosen in settings:
        c = make("cudc", (1, 2), **chosen)
        for step in range(3):
            metrics = c.update(batch_for(c, seed=step, measure=True))
        assert all(torch.isfinite(value).all() for value in metrics.values())


# The rules on made-up sequences


class Scripted(CUDC):
    """A CUDC whose reward and forward error are what the test says."""

    script = torch.zeros(8)

    def reward(self, batch):
        super().reward(batch)
        batch.cache.surprise = batch.cache.reward = self.script.expand(len(self.seeds), -1)
        return batch.cache.reward


def scripted(rule, **settings):
    config = {"width": 8, "batch_size": 8, "feature_dim": 8, "neighbours": 4, "threshold_dwell": 0, "k_rule": rule} | settings
    return Scripted(Sizes("walker", 24, 6, 1000, 4000, 8), CUDCConfig(**config), [1])


def drive(c, shares):
    ks = []
    for share in shares:
        c.script = torch.where(torch.arange(8) < round(share * 8), 0.4, 0.6)
        c.update(batch_for(c, size=8))
        ks.append(int(c.k[0]))
    return ks


@pytest.mark.parametrize("rule", ["reward", "error"])
def test_k_grows_with_the_share_below_the_threshold(rule):
    threshold = {THRESHOLDS[rule]: 0.5}
    shares = [0.5, 0.625, 0.25, 0.75, 1.0, 1.0, 1.0]
    assert drive(scripted(rule, **threshold), shares) == [3, 4, 4, 5, 6, 6, 6]
    assert drive(scripted(rule, k_max=8, **threshold), shares) == [3, 4, 4, 5, 6, 7, 8]
    assert drive(scripted(rule, c_k=0.7, **threshold), shares) == [3, 3, 3, 4, 5, 6, 6]
    assert drive(scripted(rule, patience=2, **threshold), shares) == [3, 3, 3, 3, 4, 4, 5]
    assert drive(scripted(rule, **{THRESHOLDS[rule]: 0.4}), shares) == [3] * 7  # below means below


@pytest.mark.parametrize("rule", ["reward", "error"])
def test_thresholds_of_pilots_come_with_a_dwell(rule):
    # 8 steps for each update: after the first three updates 24 steps have passed.
    c = scripted(rule, threshold_dwell=24, **{THRESHOLDS[rule]: 0.5})
    assert drive(c, [1] * 8) == [3, 3, 3, 4, 4, 4, 5, 5]
    (summary,) = c.summary()
    name = {"reward": "mean_reward", "error": "mean_error"}[rule]
    assert summary["k_increments"][0] == {"step": 4024, "old_k": 3, "new_k": 4, "p": 1.0, name: pytest.approx(0.4)}
    assert summary["k_schedule_suspect"] is True
    longer = scripted(rule, threshold_dwell=16, min_dwell=24, **{THRESHOLDS[rule]: 0.5})
    assert drive(longer, [1] * 8) == [3, 3, 3, 4, 4, 4, 5, 5]


def test_the_dwell_of_pilots_does_not_bind_the_rule_of_the_paper():
    c = make("cudc", c_w=1.0, temperature=1e6, threshold_dwell=10**9)
    c.update(batch_for(c))
    assert c.k.tolist() == [4]


def drawn(c, count):
    """k of many updates, without their cost."""
    ks = []
    for _ in range(count):
        c.k = c._drawn_horizon()
        ks.append(c.k.clone())
    return torch.stack(ks)


def test_uniform_k_is_uniform_and_each_member_has_its_own():
    c = make("cudc-uniform-k", (1, 2))
    ks = drawn(c, 4000)
    assert not torch.equal(ks[:, 0], ks[:, 1])
    for k in range(3, 7):
        # Four standard deviations of a binomial share.
        assert (ks[:, 0] == k).float().mean().item() == pytest.approx(0.25, abs=4 * math.sqrt(0.25 * 0.75 / 4000))
    assert set(ks.unique().tolist()) == {3, 4, 5, 6}


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_normal_k_has_a_rising_mean(share):
    c = make("cudc-normal-k", (1, 2), normal_steps=1_000_000)
    c.sizes = Sizes("walker", 24, 6, 1000, 0, 2)
    c.updates.fill_(round(share * 500_000) - 1)
    ks = drawn(c, 4000)[:, 0]
    mean = 3 + 3 * share
    for k in range(3, 7):
        low, high = (-math.inf if k == 3 else k - 0.5), (math.inf if k == 6 else k + 0.5)
        chance = norm.cdf(high - mean) - norm.cdf(low - mean)
        assert (ks == k).float().mean().item() == pytest.approx(chance, abs=4 * math.sqrt(chance * (1 - chance) / 4000) + 1e-3)
    assert 3 <= ks.min() <= ks.max() <= 6


@pytest.mark.parametrize("name", ["cudc-uniform-k", "cudc-normal-k"])
def test_the_first_update_of_a_drawn_k_has_three(name):
    assert make(name).horizon.tolist() == [3]


# Second ends


def test_one_k_in_a_batch_teaches_nothing_about_k_and_second_ends_do():
    """Where k can be read off the states, only mixed ends make the network read it instead of learning what k is now."""

    def moved(observation, k):
        return observation + 0.5 * k[..., None].float()

    def accuracy(name):
        c = make(name, learning_rate=3e-3, loss_weights=(0.0, 0.0, 1.0, 0.0))
        c.k = torch.tensor([6])
        generator = torch.Generator().manual_seed(0)
        for step in range(1200):
            batch = batch_for(c, seed=step)
            batch.next_observation = moved(batch.observation, batch.horizon[:, None])
            if batch.nearer_horizon is not None:
                batch.nearer_observation = moved(batch.observation, batch.nearer_horizon)
            minimise(c.auxiliary_loss(batch)[0], c.optimisers["belief"])
        k = torch.randint(3, 7, (1, 400), generator=generator)
        start = torch.randn(1, 400, 24, generator=generator)
        with torch.no_grad():
            logits = c.step_model(torch.cat([c.state_encoder(start), c.state_encoder(moved(start, k))], dim=-1))
        return (logits.argmax(-1) + 3 == k).float().mean().item()

    assert accuracy("cudc") < 0.35
    assert accuracy("cudc-kmix") > 0.6


# Controls


def test_apt_controls_have_apts_losses_and_the_horizon_that_they_say():
    six = make("apt-k6")
    assert isinstance(six, APT)
    assert six.horizon.tolist() == [6]
    assert six.max_horizon == 6
    c = make("apt-ksched", (1, 2), k_steps=(100, 130, 190))
    c.sizes = Sizes("walker", 24, 6, 1000, 40, 10)
    assert c.max_horizon == 6
    ks = []
    for step in range(18):
        batch = batch_for(c, seed=step)
        ks.append(batch.horizon.tolist())
        c.update(batch)
    # Update u belongs to step 40 + 10 u.
    expected = [3 + (step >= 100) + (step >= 130) + (step >= 190) for step in range(40, 220, 10)]
    assert ks == [[k, k] for k in expected]
    plain, scheduled = make("apt"), make("apt-ksched")
    for step in range(3):
        found = [c.update(batch_for(c, seed=step, measure=True)) for c in (plain, scheduled)]
        assert found[0].keys() == found[1].keys()
        assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())


def test_the_schedule_of_the_control_is_the_papers():
    assert plugins.load("collectors", "apt-ksched").configure("walker").k_steps == (450_000, 650_000, 1_050_000)
