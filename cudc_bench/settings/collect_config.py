"""How much is collected and how often a method learns on the way: what a collection's run is told beside the method's own values."""

from __future__ import annotations

from dataclasses import dataclass, field

from cudc_bench.settings.config import ADDED_LATER, Config, NonNegativeInt, PositiveInt, Precision
from cudc_bench.settings.profiles import PAPER_STEPS


@dataclass(frozen=True)
class CollectConfig(Config):
    """How much is collected and how often the method learns (paper, appendix; URLB).

    Attributes:
        steps: environment steps, all of which form the dataset.
        seed_steps: steps of uniformly random actions before the first update.
        update_every: environment steps for each update.
        measure_every: updates between two lines of diagnostics, which is ``measure_every * update_every`` environment steps, whether the
            method learns or not.
        precision: of wide matrix products in updates: float32, bf16, or TF32 on CUDA.
    """

    steps: PositiveInt = PAPER_STEPS
    seed_steps: NonNegativeInt = 4_000
    update_every: PositiveInt = 2
    measure_every: PositiveInt = 1_000
    precision: Precision = field(default="float32", metadata=ADDED_LATER)
