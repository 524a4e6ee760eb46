"""Whether scores differ less between datasets when they are the mean of three evaluations: ``python studies/final_score.py [RECORDS]``.

Compares, on the same runs, the variance over a method's datasets of the score after the last step with that of the last evaluation alone,
pooled over methods and tasks, and resamples datasets within each method for an interval.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from cudc_bench.artefacts.records import read_record

RESAMPLES = 10_000


def main(records: Path) -> None:
    """Read the records that have several last evaluations, and print the comparison."""
    # By setting, algorithm, domain and method, then by task and seed: the score, and the last evaluation alone.
    found: dict[tuple[str, ...], dict[str, dict[int, tuple[float, float]]]] = defaultdict(lambda: defaultdict(dict))
    for path in sorted(records.rglob("*-seed*.json")):
        record = read_record(path)
        if record.late and record.seed == record.dataset.seed:
            score = record.score(record.final.step)
            assert score is not None
            block = (record.group, record.algorithm, record.dataset.domain, record.dataset.method)
            found[block][record.dataset.task][record.seed] = score, record.final.mean
    arrays = []
    for tasks in found.values():
        seeds = sorted(set.intersection(*(set(of) for of in tasks.values())))
        if len(seeds) > 1:
            arrays.append(np.array([[of[seed] for seed in seeds] for of in tasks.values()]))  # (tasks, seeds, 2)
    random = np.random.default_rng(0)

    def change(drawn: list[np.ndarray]) -> float:
        score, last = sum(one.var(axis=1, ddof=1).sum(axis=0) for one in drawn)
        return float(score / last - 1)

    resampled = []
    for _ in range(RESAMPLES):
        resampled.append(change([one[:, random.integers(0, one.shape[1], one.shape[1])] for one in arrays]))
    low, high = np.percentile(resampled, [2.5, 97.5])
    runs = sum(one.shape[0] * one.shape[1] for one in arrays)
    methods = ", ".join(method for *_, method in found)
    print(f"{runs} runs of {methods}: variance between datasets {change(arrays):+.0%} [{low:+.0%}, {high:+.0%}]")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else Path("results"))
