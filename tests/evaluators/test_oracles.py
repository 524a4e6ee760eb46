"""Three updates of every registered offline algorithm equal those of an independent version of its formulas, in float64.

Compared after each of them: all metrics, every weight and slow copy, the gradient of everything that is trained and both of Adam's moments.
The critics' targets are no metric, but transitions are fewer than a layer is wide: no target can be another without another gradient.
``python -m tests.mutants`` shows what the comparison notices.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from cudc_bench import plugins
from cudc_bench.evaluators.zero_shot import Labelled
from cudc_bench.learning.replay import Batch
from tests.plain import Member, assert_same, doubles, perturb

from . import oracles
from .oracles import Transitions
from .zero_shot.oracles import ZERO_SHOT

ORACLES = oracles.ORACLES | ZERO_SHOT
SEEDS = (3, 4)
# All different, so that no axis is taken for another.
SIZE, OBSERVATION, ACTION = 12, 5, 3
SMALL = {"width": 16, "feature_width": 14, "z_dim": 4, "state_dim": 7}
SIZES = {"batch_size", "hidden_layers", "shared_embeddings", *SMALL}  # hyperparameters that are no part of a formula
OURS = [name for name in plugins.names("evaluators") if "cudc-bench" in plugins.package("evaluators", name)]
FUJIMOTO = {"target_actor": True, "policy_delay": 2, "maximise": "first", "actor_noise": False}
# Beside each algorithm as it comes: the settings that change a formula.
SWITCHES: list[tuple[str, dict[str, Any]]] = [
    *(("td3", {name: value}) for name, value in FUJIMOTO.items()),
    *((name, {"noise_std": 0.6}) for name in ("td3", "td3-fujimoto", "rebrac")),  # noise on both sides of its bound
    ("td3-bc", FUJIMOTO | {"alpha": 0.5}),
    ("crr", {"weight": "exp"}),
    ("crr", {"weight": "exp", "largest_weight": 2.0}),
    ("crr", {"weight": "identity", "value_samples": 4}),
    ("cql", {"lagrange": True}),
    ("cql", {"penalty_weight": 0.7, "penalty_samples": 2}),
    ("cql", {"squash_twice": False}),
    ("cql", {"sum_log_prob": True}),
    ("cql-fixed", {"lagrange": True, "penalty_target": 1.0}),
    ("iql", {"schedule_steps": 5}),
    ("iql", {"schedule_steps": 1}),  # the third step is beyond
    ("iql", {"expectile": 0.9, "beta": 10.0, "largest_weight": 5.0}),
    ("rebrac", {"policy_delay": 1, "actor_penalty": 0.3, "critic_penalty": 0.2}),
    ("rebrac", {"hidden_layers": 2}),
    ("fb", {"reduce": "mean"}),
    ("fb", {"shared_embeddings": False, "ortho": 0.3, "z_mix": 0.8}),
    ("fb-onestep", {"maximise": "min", "squash": True, "temperature": 2.0, "ortho": 1.0}),
    ("hilp", {"q_loss": True, "expectile": 0.9, "random_goals": 0.7, "feature_rate": 2.0}),
    ("td-jepa", {"state_ortho": 1.0, "task_ortho": 0.5, "target_tau": 0.05, "z_mix": 0.2}),
]
CASES = [*((name, {}) for name in OURS), *SWITCHES]


def title(case: tuple[str, dict[str, Any]]) -> str:
    name, settings = case
    return name + "".join(f" {key}={value}" for key, value in settings.items())


def stack(name: str, settings: dict[str, Any]) -> Any:
    """Two members whose weights are nothing special, and whose slow copies, at first exact, are far from what they copy."""
    kind = plugins.load("evaluators", name)
    learner = kind(OBSERVATION, ACTION, kind.configure(SMALL, settings), SEEDS)
    for network, module in learner.named_children():
        if network.startswith("target_"):
            online = dict(getattr(learner, network.removeprefix("target_")).named_parameters())
            assert all(torch.equal(copy, online[path]) and not copy.requires_grad for path, copy in module.named_parameters())
    perturb(learner, 0.3, seed=1)
    if name in EXTREMES:
        with torch.no_grad():
            EXTREMES[name]({name: list(module.parameters()) for name, module in learner.named_children()}, learner)
    return learner


def crr_extremes(weights: dict[str, list[torch.Tensor]], learner: Any) -> None:
    weights["critic"][-2].mul_(6.0)  # advantages beyond log 20


def cql_extremes(weights: dict[str, list[torch.Tensor]], learner: Any) -> None:
    weights["actor"][-1][..., ACTION] += 2.0  # the logarithms of deviations on both sides of their bounds, 2 and -10
    weights["actor"][-1][..., ACTION + 1] -= 10.0
    learner.log_multiplier[1] += math.log(1e6)


def iql_extremes(weights: dict[str, list[torch.Tensor]], learner: Any) -> None:
    weights["value"][-1].sub_(2.5)  # values on both sides of V, and advantages beyond log 100 / 3
    learner.log_std[..., 0] += 2.0  # deviations on both sides of their bounds, e^2 and e^-20, the latter in one member alone
    learner.log_std[1, ..., 1] -= 21.0


# So that both sides of every bound and every sign are met.
EXTREMES = {"crr": crr_extremes, "cql": cql_extremes, "cql-fixed": cql_extremes, "iql": iql_extremes}


def batch(seed: int, reads: frozenset[str]) -> tuple[Batch, list[Transitions]]:
    """A minibatch for the stack, and each member's part of it; what must not be read is NaN."""
    generator = torch.Generator().manual_seed(seed)
    members = len(SEEDS)
    drawn = {
        "s": torch.randn(members, SIZE, OBSERVATION, generator=generator),
        "a": torch.rand(members, SIZE, ACTION, generator=generator) * 2 - 1,
        "s_next": torch.randn(members, SIZE, OBSERVATION, generator=generator),
        # Far from what critics expect: beside a penalty of weight 1e6, whose part in the last bias cancels to nothing, errors stay visible.
        "r": 10.0 * torch.rand(members, SIZE, generator=generator),
        "a_next": torch.rand(members, SIZE, ACTION, generator=generator) * 2 - 1,
        "later": torch.randn(members, SIZE, OBSERVATION, generator=generator),
        "other": torch.randn(members, SIZE, OBSERVATION, generator=generator),
    }
    drawn["later"][:, :4], drawn["other"][:, 2:6] = drawn["s"][:, :4], drawn["s"][:, 2:6]  # goals that are reached
    drawn = {name: value if name in reads else torch.full_like(value, math.nan) for name, value in drawn.items()}
    of_members = [Transitions(**{name: value[e] for name, value in drawn.items()}) for e in range(members)]
    horizon = torch.ones(members, dtype=torch.int64)
    stacked = Batch(
        drawn["s"], drawn["a"], drawn["s_next"], horizon, drawn["r"], measure=True, next_action=drawn["a_next"],
        future_observation=drawn["later"], other_observation=drawn["other"],
    )  # fmt: skip
    return stacked, of_members


def check_infer(learner: Any, members: list[Member], infer: Any, v: Any) -> None:
    """Of two tasks, the second of which pays in few transitions."""
    stacked, of_members = batch(10, frozenset({"s", "a", "s_next"}))
    reward = torch.rand(len(members), 2, SIZE, generator=torch.Generator().manual_seed(10))
    reward[:, 1, 3:] = 0.0
    found = learner.infer(Labelled(stacked.observation, stacked.action, stacked.next_observation, reward))
    for e, member in enumerate(members):
        for task in (0, 1):
            assert_same(found[e, task], infer(member, of_members[e], reward[e, task], v).detach(), f"z of task {task}")


@pytest.mark.parametrize("case", CASES, ids=title)
def test_three_updates_equal_the_formulas(case: tuple[str, dict[str, Any]]) -> None:
    name, settings = case
    assert name in ORACLES, f"'{name}' has no oracle: write its update in tests/evaluators/oracles.py, on plain tensors, from its paper"
    oracle = ORACLES[name]
    with doubles():
        learner = stack(name, settings)
        # The oracle has its own defaults, and lacks no hyperparameter.
        values = {**oracle.values, **settings}
        assert values == {key: value for key, value in vars(learner.config).items() if key in settings or key not in SIZES}
        v = SimpleNamespace(**values)
        members = [Member(learner, e, oracle.trained, v.learning_rate) for e in range(len(SEEDS))]
        for n in (1, 2, 3):
            stacked, of_members = batch(n, oracle.reads)
            metrics = learner.update(stacked)
            assert all(found.shape == (len(SEEDS),) for found in metrics.values())
            for e, member in enumerate(members):
                expected = oracle.update(member, of_members[e], v, n)
                assert metrics.keys() == expected.keys()
                for key, found in metrics.items():
                    assert_same(found[e], expected[key].detach(), f"update {n}, member {e}: {key}")
                member.assert_equals(learner, f"update {n}")
        observation = torch.randn(len(SEEDS), 7, OBSERVATION, generator=torch.Generator().manual_seed(9))
        for e, member in enumerate(members):
            assert_same(learner.act(observation)[e], oracle.act(member, observation[e], v).detach(), "the evaluated action")
        if oracle.infer is not None:
            check_infer(learner, members, oracle.infer, v)
    branches = {what: set().union(*(member.branches[what] for member in members)) for what in members[0].branches}
    assert all(seen == {False, True} for seen in branches.values()), f"one side of a bound is never met: {branches}"
