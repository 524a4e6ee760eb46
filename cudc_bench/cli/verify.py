"""``cudc-bench verify``."""

from __future__ import annotations

from typing import Annotated

import typer

from cudc_bench.errors import UsageError


def verify(
    dataset_ids: Annotated[list[str], typer.Argument(help="Datasets, such as walker/cudc-v0.")],
    every: Annotated[bool, typer.Option("--all", help="Hold all transitions against the simulator, not a sample.")] = False,
    sample: Annotated[int | None, typer.Option("--sample", help="Transitions to simulate, in whole episodes; 20000 by default.")] = None,
) -> None:
    """Prove datasets: structure, fingerprint, rewards, and by simulation."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from cudc_bench.artefacts.manifest import read_manifest
    from cudc_bench.data.verification import SAMPLE
    from cudc_bench.data.verification import verify as run

    if every and sample is not None:
        raise UsageError("--all and --sample contradict each other; give one of them.")
    for one in dataset_ids:
        read_manifest(one)
    console = Console()
    for one in dict.fromkeys(dataset_ids):
        found = run(one, sample=None if every else SAMPLE if sample is None else sample)
        table = Table(title=f"{found.dataset_id} is what it says", title_justify="left", title_style="bold", show_header=False)
        for check in found.checks:
            table.add_row(Text("ok", style="green"), check.name, Text(check.detail))
        console.print(table)
