"""Prints the project's speed as one table: ``python -m benchmarks [NAME …] [--json FILE]``, or ``make bench``."""

from __future__ import annotations

import argparse
import dataclasses
import json
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks.measure import Row
from cudc_bench.artefacts.provenance import commit, processor, versions
from cudc_bench.execution.parallel import cores

NAMES = ("environment", "relabel", "updates", "learners", "engines", "peers", "kernels", "precision", "shares", "growth", "whole", "cuda",
         "protocol", "checkpoints", "sampler", "datasets", "memory", "leaderboard", "suite")  # fmt: skip


def main(words: list[str] | None = None) -> list[Row]:
    """Run the named benchmarks, all by default, and return the table's rows.

    Args:
        words: of the command line, this process's own by default.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Measure speed as ratios in one run.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"what to measure: {', '.join(NAMES)}; all by default")
    parser.add_argument("--json", type=Path, help="also write the rows to this file")
    arguments = parser.parse_args(words)
    if unknown := set(arguments.names) - set(NAMES):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; allowed: {', '.join(NAMES)}")
    rows: list[Row] = []
    console = Console(width=160)
    try:
        for name in arguments.names or NAMES:
            console.print(f"measuring {name} …", highlight=False)
            for row in import_module(f"benchmarks.{name}").run():
                rows.append(row)
                console.print(f"  {row.what}: {row.measured}", markup=False, highlight=False)
                if arguments.json:
                    arguments.json.write_text(json.dumps(_found(rows), indent=1) + "\n")
    finally:
        # What was measured before somebody had no more time is worth as much as before.
        console.print(_table(rows))
    return rows


def _found(rows: list[Row]) -> dict[str, Any]:
    return {
        "processor": processor(), "card": _card(), "cores": cores(), "versions": versions(), "commit": commit()[0],
        "rows": [dataclasses.asdict(row) for row in rows],
    }  # fmt: skip


def _table(rows: list[Row]) -> Table:
    table = Table(title=f"{_card() or processor()}, {cores()} cores, {datetime.now(UTC):%Y-%m-%d}")
    for column in ("what", "measured", "against", "ratio", "target", "met"):
        table.add_column(column)
    for row in rows:
        cells = (row.what, row.measured, row.against, row.ratio, row.target, "yes" if row.met else "NO")
        table.add_row(*map(escape, cells))
    return table


def _card() -> str | None:
    import torch

    return torch.cuda.get_device_name() if torch.cuda.is_available() else None


if __name__ == "__main__":
    main()
