"""What the runs of cudc-state-target.md say by its criterion, steps (a) and (b): ``python studies/cudc_state_target.py``.

Reads manifests and diagnostics below the dataset root, writes cudc-state-target.csv beside this file, one line for each run that is made,
and prints the table and, once all are there, which readings are left. ``--from-csv`` starts from those lines, without any dataset.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

from cudc_bench.artefacts.ids import default_id
from cudc_bench.artefacts.k_schedule import k_schedule
from cudc_bench.artefacts.manifest import exists, read_manifest
from cudc_bench.data.diagnostics import diagnostics_path

READINGS, SEEDS = ("cudc-stopgrad", "cudc-momentum", "cudc-live"), range(1, 6)
LAST_QUARTER, LEAST_RANK = 0.75, 0.1
PAPER = {4: 0.45, 5: 0.65}  # shares of the run at which the paper's CUDC reached these k on Walker
CLEARLY = 0.1
TABLE = Path(__file__).with_name("cudc-state-target.csv")
MEASURED = ("error_over_persistence", "effective_rank", "state_spread", "p", "w_median")


def row_of(method: str, seed: int) -> dict[str, Any]:
    """One run: where its k grew, and the means of its diagnostics over the last quarter."""
    one = default_id("walker", method, seed)
    manifest = read_manifest(one)
    lines = [json.loads(line) for line in diagnostics_path(one).read_text().splitlines()]
    last = [line for line in lines if line["step"] > LAST_QUARTER * manifest.steps]
    means = {name: round(fmean(line[name] for line in last if name in line), 4) for name in MEASURED}
    grew = {growth.new_k: growth.step / manifest.steps for growth in k_schedule(manifest.diagnostics).growth}
    return (
        {"method": method, "seed": seed, "feature_dim": manifest.hyperparameters["feature_dim"]}
        | means
        | {f"k{k}": round(grew[k], 4) if k in grew else "" for k in (4, 5, 6)}
        | {"coverage_cells": lines[-1]["coverage_cells"], "fingerprint": manifest.fingerprint, "commit": manifest.commit}
    )


def collapses(row: dict[str, Any]) -> bool:
    """Step (a) of one run."""
    return float(row["error_over_persistence"]) >= 1 or float(row["effective_rank"]) < LEAST_RANK * float(row["feature_dim"])


def distance(row: dict[str, Any]) -> float:
    """Step (b) of one run: how far its k is from the paper's, with 1 for what was never reached."""
    return sum(abs(float(row[f"k{k}"] or 1) - share) for k, share in PAPER.items())


def main(arguments: list[str]) -> None:
    """Make the table and say what is left."""
    if "--from-csv" in arguments:
        with TABLE.open() as file:
            rows: list[dict[str, Any]] = list(csv.DictReader(file))
    else:
        made = [(method, seed) for method in READINGS for seed in SEEDS if exists(default_id("walker", method, seed))]
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


if __name__ == "__main__":
    main(sys.argv[1:])
