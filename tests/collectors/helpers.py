"""Small stacks for tests."""

import torch

from cudc_bench import plugins
from cudc_bench.collectors.base import Space
from cudc_bench.config import build
from cudc_bench.networks import MemberRandom
from cudc_bench.replay import Batch

SMALL = {"width": 16, "batch_size": 32, "feature_dim": 12, "learning_rate": 1e-3}


def make(name="cudc", seeds=(1,), space=None, **settings):
    """A registered collector at a small size."""
    kind = plugins.load("collectors", name)
    space = space or Space("walker", 24, 6, 1000, 4000, 2)
    return kind(space, build(kind.config_class, SMALL, settings), list(seeds))


def batch_for(collector, size=32, seed=0, measure=False):
    """Random transitions of a collector's sizes; every member gets other ones, member e those of ``seed + e``."""
    parts = []
    for member in range(len(collector.seeds)):
        generator = torch.Generator().manual_seed(seed + 1000 * member)
        parts.append(
            (
                torch.randn(size, collector.space.observation, generator=generator),
                torch.rand(size, collector.space.action, generator=generator) * 2 - 1,
                torch.randn(size, collector.space.observation, generator=generator),
            )
        )
    observation, action, following = (torch.stack(values) for values in zip(*parts, strict=True))
    batch = Batch(observation, action, following, collector.horizon, measure=measure)
    if collector.skill_size:
        rows = [[seed + 1000 * member + 100_000 * row for row in range(size)] for member in range(len(collector.seeds))]
        batch.skill = torch.stack([collector.draw_skills(MemberRandom(seeds, "rows")) for seeds in rows])
    return batch
