"""CUDC's relatives do what their row of the paper's studies says: read off the running methods, not off their settings."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch.nn import functional as F

from cudc_bench import plugins
from cudc_bench.collectors.apt import APT
from cudc_bench.collectors.base import Space
from cudc_bench.collectors.cudc import CUDC, CUDCConfig
from cudc_bench.config import as_dict, config_hash
from cudc_bench.envs import DOMAINS
from cudc_bench.networks import minimise

from .helpers import batch_for, make

ALL = {"forward", "inverse", "step", "reach"}
CODED = ALL - {"reach"}
# Losses; state encoder's first layer and what the inverse model gives; points of the entropy; how the forward error is rewarded; which of
# the three shares makes k grow, or how it is drawn; whether samples are weighted; the largest k. Section 4 of the specification.
TABLE = {
    "cudc": (ALL, "hidden", "features", "states and actions", "linear", "weight", True, 6),
    "cudc-vary-icm": (CODED, "raw", "actions", None, "log", "reward", False, 6),
    "cudc-vary-apt": (CODED, "trunk", "actions", "states", None, "reward", False, 6),
    "cudc-reward": (CODED, "trunk", "actions", "states and actions", "linear", "reward", False, 6),
    "cudc-reach": (ALL, "hidden", "features", "states and actions", "linear", "weight", False, 6),
    "cudc-no-entropy": (ALL, "hidden", "features", None, "linear", "weight", True, 6),
    "cudc-no-pe": (ALL, "hidden", "features", "states and actions", None, "weight", True, 6),
    "cudc-no-regularize": (ALL, "hidden", "features", "states and actions", "linear", "weight", False, 6),
    "cudc-no-vary": (ALL, "hidden", "features", "states and actions", "linear", None, True, 3),
    "cudc-no-reach": (CODED, "hidden", "features", "states and actions", "linear", "error", False, 6),
    "cudc-no-inverse": ({"forward", "reach"}, "hidden", None, "states and actions", "linear", "weight", True, 6),
    "cudc-uniform-k": (ALL, "hidden", "features", "states and actions", "linear", "drawn", True, 6),
    "cudc-normal-k": (ALL, "hidden", "features", "states and actions", "linear", "drawn", True, 6),
    **{f"cudc-kmax{k}": (ALL, "hidden", "features", "states and actions", "linear", "weight" if k > 3 else None, True, k)
       for k in range(3, 9)},
    "cudc-one-setting": (ALL, "hidden", "features", "states and actions", "linear", "weight", True, 6),
    **{f"cudc-{target}": (ALL, "hidden", "features", "states and actions", "linear", "weight", True, 6)
       for target in ("live", "stopgrad", "momentum")},
    "cudc-literal": (ALL, "hidden", "features", "states and actions", "linear", "weight", True, 6),
    "cudc-kmix": (ALL, "hidden", "features", "states and actions", "linear", "weight", True, 6),
}  # fmt: skip
ALIASES = [("cudc-reach", "cudc-no-regularize"), ("cudc-no-vary", "cudc-kmax3"), ("cudc", "cudc-kmax6"), ("cudc", "cudc-live")]
THRESHOLDS = {"weight": "c_w", "reward": "c_r", "error": "c_e"}


def test_the_table_holds_every_relative():
    related = {name for name in plugins.names("collectors") if issubclass(plugins.load("collectors", name), CUDC)}
    assert related == set(TABLE)


@pytest.fixture(params=TABLE)
def row(request):
    names = ("losses", "encoder", "inverse", "points", "error", "grows", "weighted", "k_max")
    return SimpleNamespace(name=request.param, **dict(zip(names, TABLE[request.param], strict=True)))


def numpy(tensor):
    return tensor.detach().numpy()[0].astype(np.float64)


def watch(c, batch):
    """One update; its metrics, the reward and weight that the critic and actor were given, and what the belief saw."""
    seen = {}

    def keep(name, function):
        def kept(*arguments):
            seen[name] = function(*arguments)
            return seen[name]

        return kept

    c._update_critic = keep("metrics", lambda b, r, w: seen.update(reward=r, weight=w) or type(c)._update_critic(c, b, r, w))
    c._update_actor = keep("actor", lambda b, w: seen.update(actor_weight=w) or type(c)._update_actor(c, b, w))
    before = {name: p.clone() for name, p in c.named_parameters()}
    metrics = c.update(batch)
    moved = {name.split(".")[0] for name, p in c.named_parameters() if not torch.equal(before[name], p)}
    return metrics, seen, moved


def test_losses_and_what_they_train(row):
    c = make(row.name)
    metrics, _, moved = watch(c, batch_for(c, measure=True))
    assert {name.removeprefix("loss_") for name in metrics if name.startswith("loss_")} == row.losses
    trained = {
        "state_encoder": row.encoder != "raw",
        "action_encoder": row.encoder != "raw" and row.points != "states",
        "forward_model": True,
        "inverse_model": "inverse" in row.losses,
        "step_model": "step" in row.losses and row.k_max > 3,  # one k alone is no question
        **dict.fromkeys(["projection", "similarity", "momentum_encoder", "momentum_projection"], "reach" in row.losses),
        **dict.fromkeys(["actor", "critic", "target_critic"], True),
    }
    assert moved == {name for name, there in trained.items() if there}


def test_the_loss_is_the_sum_of_its_parts_and_each_part_has_its_weight(row):
    weights = {"forward": 1.0, "inverse": 10.0, "step": 100.0, "reach": 1000.0}
    for chosen in ((1.0, 1.0, 1.0, 1.0), tuple(weights.values())):
        c = make(row.name, loss_weights=chosen)
        total, losses = c.belief_loss(batch_for(c))
        expected = sum(w * losses[f"loss_{name}"] for w, name in zip(chosen, weights, strict=True) if name in row.losses)
        torch.testing.assert_close(total.detach(), expected)


def test_encoder_and_inverse_model(row):
    c = make(row.name)
    batch = batch_for(c)
    f = c.features(batch)
    s, a = batch.observation.shape[-1], batch.action.shape[-1]
    if row.encoder == "raw":
        assert torch.equal(f["z"], batch.observation)
        assert torch.equal(f["z_next"], batch.next_observation)
    else:
        linear = [p for p in c.state_encoder.parameters() if p.dim() == 3 and p.shape[1] > 1]
        assert [tuple(p.shape[1:]) for p in linear] == ([(s, 12)] if row.encoder == "trunk" else [(s, 16), (16, 12)])
        assert f["z"].abs().max() <= 1
    size = f["z"].shape[-1]
    if row.inverse is None:
        assert "inverse" not in f
        assert not hasattr(c, "inverse_model")
        return
    # The paper's inverse model predicts action features and is told k; ICM's and APT's predicts actions and is not.
    first = next(c.inverse_model.parameters())
    target = f["action"] if row.inverse == "features" else batch.action
    assert first.shape[1] == 2 * size + (c.horizons if row.inverse == "features" else 0)
    assert f["inverse"].shape[-1] == (64 if row.inverse == "features" else a)
    assert (f["inverse"].abs().max() <= 1) or row.inverse == "features"
    _, losses = c.belief_loss(batch)
    torch.testing.assert_close(losses["loss_inverse"], (target - f["inverse"]).norm(dim=-1).mean(1).detach())


def test_reward(row):
    c = make(row.name)
    batch = batch_for(c, measure=True)
    after = row.name in {"cudc-vary-icm", "cudc-vary-apt"}  # ICM and APT reward what the updated networks say
    f = c.features(batch)
    _, seen, _ = watch(c, batch)
    if after:
        now = c.features(batch)
        assert not torch.equal(now["predicted"], f["predicted"])
        f = now
    z, action, z_next, predicted = (numpy(f[name]) for name in ("z", "action", "z_next", "predicted"))
    error = np.linalg.norm(z_next - predicted, axis=-1)
    expected = {"linear": c.config.alpha * error, "log": np.log1p(error), None: 0.0}[row.error] + np.zeros(len(z))
    if row.points is not None:
        points = z if row.points == "states" else np.concatenate([z, action], -1)
        distances = np.sort(np.linalg.norm(points[:, None] - points[None], axis=-1), axis=-1)
        expected += np.log1p(distances[:, : c.config.neighbours].mean(-1))
    if row.name not in {"cudc-vary-icm", "cudc-vary-apt"}:
        expected += 0.01
    np.testing.assert_allclose(numpy(seen["reward"]), expected, rtol=1e-4, atol=1e-5)


def test_weights_of_critic_and_actor(row):
    c = make(row.name, clip_low=0.9, clip_high=0.98)
    batch = batch_for(c, measure=True)
    f = c.features(batch)
    metrics, seen, _ = watch(c, batch)
    assert seen["weight"] is seen["actor_weight"]
    if not row.weighted:
        assert seen["weight"] is None
        assert "w_clipped" not in metrics
        return
    w = 1 - np.exp(numpy(f["log_reachable"]))
    np.testing.assert_allclose(numpy(seen["weight"]), np.clip(w, 0.9, 0.98), rtol=1e-4)
    assert metrics["w_clipped"].item() == pytest.approx((w < 0.9).mean())
    for name, share in (("w_q10", 0.1), ("w_q25", 0.25), ("w_median", 0.5), ("w_q75", 0.75), ("w_q90", 0.9)):
        assert metrics[name].item() == pytest.approx(np.quantile(w, share), abs=1e-5)


@pytest.mark.parametrize("rule", THRESHOLDS)
def test_what_makes_k_grow(row, rule):
    """One threshold is beyond every value, the others below: k grows if and only if the method looks at that one."""
    thresholds = dict.fromkeys(THRESHOLDS.values(), 0.0) | {THRESHOLDS[rule]: 1.0 if rule == "weight" else 1e9}
    # At this temperature every future is as likely as the others, and no w rounds to 1.
    c = make(row.name, threshold_dwell=0, temperature=1e6, **thresholds)
    seen = []
    for step in range(12):
        batch = batch_for(c, seed=step)
        seen.append(int(batch.horizon))
        c.update(batch)
    if row.grows == "drawn":
        assert len(set(seen)) > 1
    elif row.grows == rule:
        assert seen == [min(3 + step, row.k_max) for step in range(12)]
    else:
        assert seen == [3] * 12
    assert c.max_horizon == row.k_max


def test_the_forward_model_is_told_k(row):
    if row.k_max == 3:
        return  # there is nothing to tell
    c = make(row.name)
    batch = batch_for(c)
    found = []
    for k in range(3, row.k_max + 1):
        batch.horizon = torch.tensor([k])
        found.append(c.features(batch)["predicted"])
    assert all(not torch.equal(a, b) for i, a in enumerate(found) for b in found[:i])


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
        losses = [c.belief_loss(batch)[1] for c, batch in zip((plain, extended), batches, strict=True)]
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


def test_literal_lets_gradients_through_the_action_target():
    c = make("cudc-literal", loss_weights=(0.0, 1.0, 0.0, 0.0))
    loss, _ = c.belief_loss(batch_for(c))
    loss.sum().backward()
    assert sum(p.grad.abs().sum() for p in c.action_encoder.parameters()) > 0


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
        kind(Space("walker", 24, 6, 1000, 0, 2), kind.configure("walker", {"width": 8, "batch_size": 32}, settings), [1])


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
        batch.kept["surprise"] = batch.kept["reward"] = self.script.expand(len(self.seeds), -1)
        return batch.kept["reward"]


def scripted(rule, **settings):
    config = {"width": 8, "batch_size": 8, "feature_dim": 8, "neighbours": 4, "threshold_dwell": 0, "k_rule": rule} | settings
    return Scripted(Space("walker", 24, 6, 1000, 4000, 8), CUDCConfig(**config), [1])


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
    c.space = Space("walker", 24, 6, 1000, 0, 2)
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


def test_kmix_learns_k_from_second_ends():
    c = make("cudc-kmix")
    c.k = torch.tensor([6])
    batch = batch_for(c)
    assert set(batch.nearer_horizon.unique().tolist()) == {3, 4, 5, 6}
    f = c.features(batch)
    _, losses = c.belief_loss(batch)
    z_nearer = c.state_encoder(batch.nearer_observation)
    logits = c.step_model(torch.cat([f["z"], z_nearer], dim=-1))
    torch.testing.assert_close(losses["loss_step"][0], F.cross_entropy(logits[0], batch.nearer_horizon[0] - 3))
    plain = make("cudc")
    plain.k = torch.tensor([6])
    plain.load_state_dict(c.state_dict())
    ours = plain.belief_loss(batch_for(plain))[1]
    for name in ("loss_forward", "loss_inverse", "loss_reach"):
        torch.testing.assert_close(losses[name], ours[name])
    assert not torch.equal(losses["loss_step"], ours["loss_step"])


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
            minimise(c.belief_loss(batch)[0], c.optimisers["belief"])
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
    c.space = Space("walker", 24, 6, 1000, 40, 10)
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
