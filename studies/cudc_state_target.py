"""What the runs of cudc-state-target.md say by its criterion: ``python studies/cudc_state_target.py [--from-csv] [RECORDS]``.

Reads manifests and diagnostics below the dataset root, writes cudc-state-target.csv beside this file, one line for each run that is made,
and prints the table of steps (a) and (b) and, once all runs are there, which readings are left. ``--from-csv`` starts from those lines,
without any dataset. With a folder of records, step (c) follows: the returns of those that are left.
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Iterable
from itertools import combinations
from pathlib import Path
from statistics import fmean
from typing import Any

from cudc_bench.artefacts.ids import DatasetId, default_id
from cudc_bench.artefacts.k_schedule import k_schedule
from cudc_bench.artefacts.manifest import exists, read_manifest
from cudc_bench.artefacts.records import read_record, record_path
from cudc_bench.data.diagnostics import diagnostics_path

READINGS, SEEDS = ("cudc-stopgrad", "cudc-momentum", "cudc-live"), range(1, 6)
LAST_QUARTER, LEAST_RANK = 0.75, 0.1
PAPER = {4: 0.45, 5: 0.65}  # shares of the run at which the paper's CUDC reached these k on Walker
CLEARLY = 0.1
TASKS, MILESTONE = ("stand", "walk", "run", "flip"), 50_000
SIGNIFICANT = 0.05
TABLE = Path(__file__).with_name("cudc-state-target.csv")
MEASURED = ("error_over_persistence", "effective_rank", "state_spread", "p", "w_median")


def last_quarter(one: DatasetId, names: Iterable[str]) -> dict[str, float]:
    """Means of diagnostics over the last quarter of a dataset's run; a measure that it has not is absent."""
    steps = read_manifest(one).steps
    lines = [json.loads(line) for line in diagnostics_path(one).read_text().splitlines()]
    values = {name: [line[name] for line in lines if line["step"] > LAST_QUARTER * steps and name in line] for name in names}
    return {name: round(fmean(found), 4) for name, found in values.items() if found}


def row_of(method: str, seed: int) -> dict[str, Any]:
    """One run: where its k grew, and the means of its diagnostics over the last quarter."""
    one = default_id("walker", method, seed, "cpu")
    manifest = read_manifest(one)
    grew = {growth.new_k: growth.step / manifest.steps for growth in k_schedule(manifest.diagnostics).growth}
    return (
        {"method": method, "seed": seed, "feature_dim": manifest.hyperparameters["feature_dim"]}
        | last_quarter(one, MEASURED)
        | {f"k{k}": round(grew[k], 4) if k in grew else "" for k in (4, 5, 6)}
        | {"coverage_cells": manifest.diagnostics["coverage_cells"], "fingerprint": manifest.fingerprint, "commit": manifest.commit}
    )


def collapses(row: dict[str, Any]) -> bool:
    """Step (a) of one run."""
    error, rank = row["error_over_persistence"], row["effective_rank"]
    return (error != "" and float(error) >= 1) or (rank != "" and float(rank) < LEAST_RANK * float(row["feature_dim"]))


def distance(row: dict[str, Any]) -> float:
    """Step (b) of one run: how far its k is from the paper's, with 1 for what was never reached."""
    return sum(abs(float(row[f"k{k}"] or 1) - share) for k, share in PAPER.items())


def scores_of(method: str, records: Path) -> list[list[float]]:
    """The score of each task, for each seed; seeds of which a task is missing are left out."""
    found = []
    for seed in SEEDS:
        one = default_id("walker", method, seed, "cpu")
        paths = [record_path(records, str(one.for_task(task)), "td3", seed, "cpu") for task in TASKS]
        if all(path.exists() for path in paths):
            scores = [read_record(path).score(MILESTONE) for path in paths]
            found.append([score for score in scores if score is not None])
    return found


def permutation_p(x: list[float], y: list[float]) -> float:
    """Two-sided p of a difference of means, over all ways to deal the seeds out to two methods."""
    together, size = [*x, *y], len(x)
    total = sum(together)
    differences = [abs(sum(chosen) / size - (total - sum(chosen)) / (len(together) - size)) for chosen in combinations(together, size)]
    observed = abs(fmean(x) - fmean(y))
    return sum(one >= observed - 1e-9 for one in differences) / len(differences)


def compare_returns(methods: list[str], records: Path) -> None:
    """Step (c): a reading leads if it is better than every other by a permutation test over seeds, after Holm."""
    found = {method: scores_of(method, records) for method in methods}
    print(f"\n| reading | runs | mean of four tasks, by seed | mean | {' | '.join(TASKS)} |")
    print(f"|---|---|---|---|{'---|' * len(TASKS)}")
    means = {}
    for method, scores in found.items():
        if not scores:
            print(f"| `{method}` | 0 |")
            continue
        means[method] = [fmean(one) for one in scores]
        tasks = " | ".join(f"{fmean(one[at] for one in scores):.0f}" for at in range(len(TASKS)))
        seeds = ", ".join(f"{one:.0f}" for one in means[method])
        print(f"| `{method}` | {len(scores)} | {seeds} | {fmean(means[method]):.1f} | {tasks} |")
    pairs = [(x, y, permutation_p(means[x], means[y])) for x, y in combinations(means, 2)]
    # Holm: of m tests the smallest p is multiplied by m, the next by m − 1, and none is below the one before.
    worst, adjusted = 0.0, {}
    for at, (x, y, p) in enumerate(sorted(pairs, key=lambda pair: pair[2])):
        worst = max(worst, min(1.0, p * (len(pairs) - at)))
        adjusted[x, y] = worst
        print(f"{x} - {y}: {fmean(means[x]) - fmean(means[y]):+.1f} points, p = {p:.3f}, after Holm {worst:.3f}")
    if any(len(scores) < len(SEEDS) for scores in found.values()):
        print("not all runs are made: no verdict")
        return
    adjusted |= {(y, x): p for (x, y), p in adjusted.items()}

    def beats(method: str, other: str) -> bool:
        return fmean(means[method]) > fmean(means[other]) and adjusted[method, other] < SIGNIFICANT

    leads = [method for method in means if all(beats(method, other) for other in means if other != method)]
    print(f"ahead by (c): {', '.join(leads) or 'none, so that the order decides: ' + methods[0]}")


def main(arguments: list[str]) -> None:
    """Make the table and say what is left."""
    if "--from-csv" in arguments:
        with TABLE.open() as file:
            rows: list[dict[str, Any]] = list(csv.DictReader(file))
    else:
        made = [(method, seed) for method in READINGS for seed in SEEDS if exists(default_id("walker", method, seed, "cpu"))]
        rows = [row_of(*one) for one in made]
        with TABLE.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    print("| reading | error over persistence, by seed | centred rank | (a) | k = 4 at | k = 5 at | distance |")
    print("|---|---|---|---|---|---|---|")
    left = {}
    for method in READINGS:
        own = [row for row in rows if row["method"] == method]
        if not own:
            continue
        passed, far = not any(map(collapses, own)), fmean(map(distance, own))
        if passed:
            left[method] = far
        errors = ", ".join(f"{float(row['error_over_persistence']):.3f}" for row in own)
        ranks = ", ".join(f"{float(row['effective_rank']):.0f}" for row in own)
        when = [", ".join(f"{float(row[k]):.0%}" if row[k] else "never" for row in own) for k in ("k4", "k5")]
        verdict = "collapses" if not passed else "passed" if len(own) == len(SEEDS) else f"{len(own)} of {len(SEEDS)} runs, all pass"
        print(f"| `{method}` | {errors} | {ranks} | {verdict} | {' | '.join(when)} | {far:.2f} |")
    if len(rows) < len(READINGS) * len(SEEDS):
        print(f"\n{len(rows)} of {len(READINGS) * len(SEEDS)} runs are made: no verdict")
        return
    ahead = [method for method in left if all(left[method] < far - CLEARLY for other, far in left.items() if other != method)]
    print(f"\nleft after (a): {', '.join(left) or 'none'}; after (b): {', '.join(ahead or left) or 'none'}")
    if folders := [Path(word) for word in arguments if not word.startswith("--")]:
        compare_returns(list(ahead or left), folders[0])


if __name__ == "__main__":
    main(sys.argv[1:])
