"""The table of cudc-representations.md: ``python studies/cudc_representations.py [--from-csv]``.

Collects what is not there yet below the dataset root, which should be another than that of whole runs: they have the same ids. Writes
cudc-representations.csv beside this file. ``--from-csv`` starts from that, without any dataset.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path
from typing import Any

from cudc_state_target import collapses, last_quarter

import cudc_bench
from cudc_bench import plugins
from cudc_bench.artefacts.ids import default_id
from cudc_bench.artefacts.manifest import exists, read_manifest

STEPS = 60_000
TABLE = Path(__file__).with_name("cudc-representations.csv")
MEASURED = ("error_over_persistence", "effective_rank", "state_spread", "action_share", "entropy")
HEADS = ("error over persistence", "effective rank", "spread of z", "actions' share of distances", "entropy")


def settings_of_cudc() -> list[str]:
    """Names of CUDC and its variants, one for each class."""
    cudc = plugins.load("collectors", "cudc")
    found: dict[type, str] = {}
    for name in plugins.names("collectors"):
        kind = plugins.load("collectors", name)
        if issubclass(kind, cudc):
            found.setdefault(kind, name)
    return list(found.values())


def main(arguments: list[str]) -> None:
    """Collect, measure, and print the table."""
    if "--from-csv" in arguments:
        with TABLE.open() as file:
            rows: list[dict[str, Any]] = list(csv.DictReader(file))
    else:
        methods = settings_of_cudc()
        missing = [method for method in methods if not exists(default_id("walker", method, 1, "cpu"))]
        for method in missing:
            cudc_bench.collect(method, "walker", profile="cpu", settings={"steps": STEPS}, device="cpu")
        rows = [row_of(method) for method in methods]
        with TABLE.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    print(f"| method | {' | '.join(HEADS)} | k at the end | |")
    print(f"|---|{'---|' * len(HEADS)}---|---|")
    for row in rows:
        values = " | ".join(f"{float(row[name]):.2f}" if row[name] != "" else "" for name in MEASURED)
        print(f"| `{row['method']}` | {values} | {float(row['k']):.0f} | {'suspect' if collapses(row) else ''} |")


def row_of(method: str) -> dict[str, Any]:
    """One run; a measure that a setting has no use for is empty."""
    one = default_id("walker", method, 1, "cpu")
    manifest = read_manifest(one)
    if manifest.steps != STEPS:
        raise SystemExit(f"{one} has {manifest.steps:,} steps, not {STEPS:,}; use another dataset root")
    found = last_quarter(one, (*MEASURED, "k"))
    return (
        {"method": method, "feature_dim": manifest.hyperparameters["feature_dim"]}
        | {name: found.get(name, "") for name in (*MEASURED, "k")}
        | {"fingerprint": manifest.fingerprint, "commit": manifest.commit}
    )


if __name__ == "__main__":
    main(sys.argv[1:])
