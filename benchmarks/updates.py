"""Time of one update at the paper's size, as a share of the machine's own float32 matrix-product peak."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.measure import Row, fastest, fastest_interleaved
from cudc_bench import plugins
from cudc_bench.collectors import variants
from cudc_bench.collectors.base import Sizes
from cudc_bench.collectors.ddpg import DDPG, DDPGConfig
from cudc_bench.evaluators.base import Evaluator
from cudc_bench.execution.parallel import cores
from cudc_bench.learning.cuda_graphs import Updater
from cudc_bench.learning.engines import graphs_for, set_engine
from cudc_bench.learning.networks import MemberRandom
from cudc_bench.learning.replay import Batch, Episodes

SPACE = Sizes("walker", 24, 6, 1000, 4000, 2)
SIZE = 1024


class PlainDDPG(DDPG):
    """The backbone alone, with a reward that costs nothing."""

    family = citation = "benchmark"

    def reward(self, batch: Batch) -> torch.Tensor:
        return batch.observation[..., 0]


def peak(size: int = 1024) -> float:
    """Floating-point operations a second of the best matrix product of the paper's width."""
    a, b, out = torch.randn(size, size), torch.randn(size, size), torch.empty(size, size)
    return 2 * size**3 / fastest(lambda: torch.mm(a, b, out=out), repeats=40, warm_up=5)


# At most so many times plain DDPG's time. By operations alone: 1.03, 1.4, 1.3, 1.45, 1.1, 1.05 and 1.9.
RATIOS = {"icm": 1.2, "rnd": 1.6, "aps": 1.4, "apt": 1.7, "proto": 1.4, "disagreement": 1.4, "cudc": 2.2}
SHARES = {"DDPG": 0.70, "cudc": 0.60, "td3": 0.70}


def batch_for(agent: Any, size: int = SIZE) -> Batch:
    """Random transitions of Walker's sizes, with all that a method may ask for."""
    observation, action, following, next_action = (torch.rand(1, size, width) * 2 - 1 for width in (24, 6, 24, 6))
    skill = None
    if getattr(agent, "skill_size", 0):
        skill = agent.next_skill(0)[:, None].expand(-1, size, -1).contiguous()
    horizon = torch.tensor([1 if isinstance(agent, Evaluator) else 3])
    return Batch(observation, action, following, horizon, torch.rand(1, size), skill=skill, next_action=next_action)


def drawing_updates(learner: Any, engine: str, episodes: int) -> Updater:
    """Updates as runs make them, minibatches drawn with them, from so many random episodes of each member on the learner's device."""
    members, device = len(learner.seeds), learner.device
    random = MemberRandom(list(range(members)), "replay", device)
    skill = getattr(learner, "skill_size", 0)
    data = Episodes(members, episodes, episodes * 1000, 24, 6, random, skill=skill, rewards=True)
    for member in range(members):
        for _ in range(episodes):
            skills = torch.randn(1000, skill) if skill else None
            data.add(member, torch.randn(1001, 24), torch.rand(1000, 6) * 2 - 1, skills, torch.rand(1000))
    one = torch.ones(members, dtype=torch.int64, device=device)

    def draw(measure: bool) -> Batch:
        horizon, following = getattr(learner, "horizon", one), getattr(learner, "wants_next_action", False)
        nearest = getattr(learner, "min_horizon", None)
        return data.sample(learner.config.batch_size, horizon, measure, nearest, following, learner.wants_future)

    set_engine(learner, engine)
    return Updater(learner, draw, random, graphs_for(learner, device))


def operations_of(update: Callable[[], object]) -> int:
    """Floating-point operations of the matrix products of one update, as torch counts them."""
    # Some move their actors in every second update only: two make one of each kind.
    for _ in range(2):
        update()
    with FlopCounterMode(display=False) as counter:
        for _ in range(2):
            update()
    return int(counter.get_total_flops()) // 2


def run() -> Iterator[Row]:
    """Plain DDPG, and every collector that learns, without the variants, which are other settings of these; at E=1."""
    # Of several names for one class the first is kept.
    kinds = {plugins.load("collectors", name): name for name in reversed(plugins.names("collectors"))}
    agents: dict[str, Any] = {"DDPG": PlainDDPG(SPACE, DDPGConfig(), [1])}
    for kind, name in reversed(kinds.items()):
        if kind.learns and kind.__module__ != variants.__name__:
            agents[name] = kind(SPACE, kind.configure("walker"), [1])
    yield from compare(agents, "update")


def compare(agents: dict[str, Any], what: str) -> Iterator[Row]:
    """The time of an update of each, against the first one's and the peak; torch counts the operations of matrix products."""
    torch.set_num_threads(cores())
    updates: dict[str, Callable[[], object]] = {}
    operations: dict[str, int] = {}
    for name, agent in agents.items():
        updates[name] = partial(agent.update, batch_for(agent, agent.config.batch_size))
        operations[name] = operations_of(updates[name])
    best_peak = peak()
    pairs: list[Callable[[], object]] = [partial(_twice, update) for update in updates.values()]
    times = {name: seconds / 2 for name, seconds in zip(updates, fastest_interleaved(pairs, rounds=8), strict=True)}
    best_peak = max(best_peak, peak())
    first = next(iter(times))
    for name, seconds in times.items():
        share, ratio = operations[name] / seconds / best_peak, seconds / times[first]
        limit, least = RATIOS.get(name), SHARES.get(name)
        targets = [*([] if limit is None else [f"≤ {limit}x"]), *([] if least is None else [f"≥ {least:.0%}"])]
        yield Row(
            f"{name} {what}, {agents[name].config.batch_size} x {agents[name].config.width}",
            f"{seconds * 1e3:.1f} ms, {operations[name] / 1e9:.1f} GFLOP, {operations[name] / seconds / 1e9:.0f} GFLOP/s",
            f"{first}; peak {best_peak / 1e9:.0f} GFLOP/s",
            f"{ratio:.2f}x; {share:.0%}",
            " ".join(targets),
            (limit is None or ratio <= limit) and (least is None or share >= least),
        )


def _twice(update: Callable[[], object]) -> None:
    update()
    update()
