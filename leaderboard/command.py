"""``cudc-bench leaderboard``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def leaderboard(
    results: Annotated[list[Path] | None, typer.Argument(help="Records, or folders of them.", show_default="results")] = None,
    output: Annotated[Path, typer.Option("--output", help="Folder for tables and figures.")] = Path("report"),
    profile: Annotated[str | None, typer.Option("--profile", help="Only this profile.")] = None,
    domain: Annotated[str | None, typer.Option("--domain", help="Only this domain.")] = None,
    algo: Annotated[str | None, typer.Option("--algo", help="Only this offline algorithm.")] = None,
) -> None:
    """Turn run records into tables and learning curves."""
    from rich.console import Console

    from cudc_bench.progress import say

    from . import api
    from .render import to_rich

    report = api.make_leaderboard(results or "results", output, profile, domain, algo)
    screen = Console(highlight=False)
    for table in report.tables:
        screen.print(to_rich(table))
        screen.print()
    for problem in report.problems:
        say(f"problem: {problem}")
    for file in report.files:
        typer.echo(file)
