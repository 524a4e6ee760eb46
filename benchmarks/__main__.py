"""Prints the project's speed as one table: ``python -m benchmarks [NAME …] [--json FILE]``, or ``make bench``."""

from __future__ import annotations

import argparse
import dataclasses
import json
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path

from rich.console import Console
from rich.table import Table

from benchmarks.measure import Row
from cudc_bench.artefacts.provenance import commit, processor, versions
from cudc_bench.execution.parallel import cores

NAMES = ("environment", "relabel", "updates", "learners", "engines", "kernels", "precision", "shares", "growth", "whole", "cuda",
         "protocol", "checkpoints", "sampler", "datasets", "memory", "leaderboard", "suite")  # fmt: skip


def main() -> None:
    """Run the named benchmarks, all by default."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure speed as ratios in one run.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"what to measure: {', '.join(NAMES)}; all by default")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(NAMES):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; allowed: {', '.join(NAMES)}")
    rows: list[Row] = []
    console = Console(width=160)
    for name in arguments.names or NAMES:
        console.print(f"measuring {name} …", highlight=False)
        rows += import_module(f"benchmarks.{name}").run()
    table = Table(title=f"{processor()}, {cores()} cores, {datetime.now(UTC):%Y-%m-%d}")
    for column in ("what", "measured", "against", "ratio", "target", "met"):
        table.add_column(column)
    for row in rows:
        table.add_row(row.what, row.measured, row.against, row.ratio, row.target, "yes" if row.met else "NO")
    console.print(table)
    if arguments.json:
        found = {"processor": processor(), "cores": cores(), "versions": versions(), "commit": commit()[0]}
        arguments.json.write_text(json.dumps(found | {"rows": [dataclasses.asdict(row) for row in rows]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
