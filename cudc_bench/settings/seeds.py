"""Seeds as people write them: lists and ranges."""

from __future__ import annotations

import re
from collections.abc import Sequence

from cudc_bench.errors import UsageError

MOST_SEEDS = 1_000
_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?")


def parse_seeds(text: str, option: str = "--seeds") -> tuple[int, ...]:
    """``"1-3,7"`` -> (1, 2, 3, 7), without repeats; ``option`` is for messages.

    Raises:
        UsageError: it is not a list of numbers and ranges, or has more than 1,000 seeds.
    """
    seeds: dict[int, None] = {}
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        if match is None or not part.isascii():
            raise UsageError(f"{option} cannot be '{text}'; give numbers and ranges, such as 1 or 1-5 or 1,3.")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first or last - first >= MOST_SEEDS:
            raise UsageError(f"{option} cannot have the range '{part.strip()}'; it must ascend, over at most {MOST_SEEDS:,} seeds.")
        seeds |= dict.fromkeys(range(first, last + 1))
        if len(seeds) > MOST_SEEDS:
            raise UsageError(f"{option} cannot have more than {MOST_SEEDS:,} seeds; split them over several runs.")
    return tuple(seeds)


def check_seeds(seeds: Sequence[int]) -> tuple[int, ...]:
    """Refuse seeds that cannot be used together.

    Raises:
        UsageError: there is none, one is negative, one is given twice, or there are more than 1,000.
    """
    if not seeds:
        raise UsageError("no seed was given; give at least one.")
    if len(seeds) > MOST_SEEDS:
        raise UsageError(f"{len(seeds):,} seeds were given; at most {MOST_SEEDS:,} can be, split them over several runs.")
    seen = set()
    for seed in seeds:
        if seed < 0:
            raise UsageError(f"a seed cannot be {seed}; it must be 0 or more.")
        if seed in seen:
            raise UsageError(f"the seed {seed} was given twice; give it once.")
        seen.add(seed)
    return tuple(seeds)


def format_seeds(seeds: Sequence[int]) -> str:
    """A short way to write some different seeds as ``--seeds``."""
    ordered = sorted(seeds)
    if len(ordered) > 2 and len(ordered) == ordered[-1] - ordered[0] + 1:
        return f"{ordered[0]}-{ordered[-1]}"
    return ",".join(map(str, ordered))
