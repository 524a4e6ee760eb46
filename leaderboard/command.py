"""``cudc-bench leaderboard``, ``submit``, ``diagnostics``, ``stats`` and ``compare``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cudc_bench.cli import completion
from cudc_bench.cli.options import JsonOption, OverwriteOption, parse_names
from cudc_bench.errors import UsageError

if TYPE_CHECKING:
    from rich.console import Group

    from .output.report import Report


def leaderboard(
    results: Annotated[list[str] | None, typer.Argument(help="Records, or folders of them.", show_default="results")] = None,
    output: Annotated[str, typer.Option("--output", help="Folder for tables and the site.")] = "report",
    profile: Annotated[str | None, typer.Option("--profile", help="Only this profile.", autocompletion=completion.some_profiles)] = None,
    domain: Annotated[str | None, typer.Option("--domain", help="Only this domain.", autocompletion=completion.domains)] = None,
    algo: Annotated[str | None, typer.Option("--algo", help="Only this offline algorithm.", autocompletion=completion.algos)] = None,
    datasets: Annotated[bool, typer.Option("--datasets/--no-datasets", help="Measure the datasets that are here; seconds each.")] = True,
    figures: Annotated[bool, typer.Option("--figures", help="Files of figures for papers, too: svg and pdf.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Turn run records into tables and a static site with their figures."""
    from cudc_bench.cli.documents import print_json
    from cudc_bench.execution.progress import echo, warn

    from . import api
    from .show.documents import of_leaderboard

    report = api.make_leaderboard(results or "results", output, profile, domain, algo, datasets, figures)
    files = [file for file in report.files if file.suffix != ".html"]
    if report.files:
        files.append(Path(output) / "index.html")
    if as_json:
        print_json(of_leaderboard(report.tables, report.overall, report.studies, report.missing, report.problems, files))
    else:
        print_tables(report)
    for problem in report.problems:
        warn(f"problem: {problem}")
    for missing in report.missing:
        echo(f"missing: {missing}")
    for file in () if as_json else files:
        typer.echo(file)


def print_tables(report: Report) -> None:
    """Print the tables, comparisons and studies of a leaderboard to the standard output, as wide as it is."""
    from rich.console import Console

    from .show import terminal

    screen = Console(highlight=False)
    for part in (
        *map(terminal.of_table, report.tables), *map(terminal.of_overall, report.overall), *map(terminal.of_study, report.studies),
    ):  # fmt: skip
        screen.print(part)
        screen.print()


def submit(
    records: Annotated[list[str], typer.Argument(help="Records that somebody handed in, or folders of them.")],
    by: Annotated[str, typer.Option("--by", help="A short name of whoever hands them in.")],
    url: Annotated[str | None, typer.Option("--url", help="Where more is to be found about them.")] = None,
    note: Annotated[str | None, typer.Option("--note", help="One line that goes with them.")] = None,
    output: Annotated[str, typer.Option("--output", help="Folder of our records.")] = "results",
    overwrite: OverwriteOption = False,
) -> None:
    """Check somebody else's records and add them to ours, marked as theirs."""
    from cudc_bench.execution.progress import echo, warn

    from .intake.submit import RefusedError
    from .intake.submit import submit as run

    try:
        received = run(records, by, url=url, note=note, output=output, overwrite=overwrite)
    except RefusedError as error:
        if len(error.problems) == 1:
            raise
        for problem in error.problems:
            warn(f"problem: {problem}")
        raise UsageError(f"nothing was added: there are {len(error.problems)} problems.") from None
    for remark in received.remarks:
        echo(f"note: {remark}")
    for file in received.files:
        typer.echo(file)
    echo(f"next: cudc-bench leaderboard {output}")


def diagnostics(
    dataset_ids: Annotated[
        list[str] | None,
        typer.Argument(help="Task-agnostic datasets; by default all that were collected.", autocompletion=completion.datasets),
    ] = None,
    output: Annotated[str, typer.Option("--output", help="Folder for figures.")] = "report",
    domain: Annotated[str | None, typer.Option("--domain", help="Only this domain.", autocompletion=completion.domains)] = None,
    method: Annotated[
        str | None,
        typer.Option("--method", help="Only this collector, or several separated by commas.", autocompletion=completion.some_methods),
    ] = None,
) -> None:
    """Draw how k and the losses of collectors went."""
    from .api import draw_diagnostics
    from .show.terminal import of_diagnostics

    report = draw_diagnostics(dataset_ids or None, output, domain, _methods(method))
    _show(map(of_diagnostics, report.comparisons), report.remarks, report.files)


def stats(
    dataset_ids: Annotated[
        list[str] | None, typer.Argument(help="Task-agnostic datasets; by default all there are.", autocompletion=completion.datasets)
    ] = None,
    output: Annotated[str, typer.Option("--output", help="Folder for tables and figures.")] = "report",
    domain: Annotated[str | None, typer.Option("--domain", help="Only this domain.", autocompletion=completion.domains)] = None,
    method: Annotated[
        str | None,
        typer.Option("--method", help="Only this collector, or several separated by commas.", autocompletion=completion.some_methods),
    ] = None,
    records: Annotated[
        list[str] | None,
        typer.Option("--records", help="Records and references, or folders of them. Repeatable.", show_default="results, if it is there"),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure datasets without training: rewards, coverage, entropy, what they have of experts, and which of these goes with scores."""
    from cudc_bench.cli.documents import print_json

    from .api import measure_quality
    from .show.documents import of_stats
    from .show.terminal import of_quality, of_study

    usual = ["results"] if Path("results").is_dir() else []
    report = measure_quality(dataset_ids or None, output, domain, _methods(method), usual if records is None else records)
    if as_json:
        print_json(of_stats(report.tables, report.predictions, report.remarks, report.files))
    parts = [*map(of_quality, report.tables), *(of_study(one.study) for one in report.predictions)]
    _show(() if as_json else parts, report.remarks, () if as_json else report.files)


def compare(
    first: Annotated[str, typer.Argument(help="A dataset with physics states.", autocompletion=completion.datasets)],
    second: Annotated[str, typer.Argument(help="Another of the same domain.", autocompletion=completion.datasets)],
    output: Annotated[str, typer.Option("--output", help="Folder for tables, figures and the film.")] = "report",
    quantities: Annotated[str | None, typer.Option("--quantities", help="Two of the domain's, for the map, by a comma.")] = None,
    seconds: Annotated[float, typer.Option("--seconds", help="Of each scene of the film; 0 for none.")] = 4.0,
) -> None:
    """Put two datasets side by side: states, rewards, actions, and a film of both."""
    from .api import compare_datasets
    from .show.terminal import of_pair

    report = compare_datasets(first, second, output, None if quantities is None else parse_names(quantities), seconds)
    _show([of_pair(report.pair)], report.remarks, report.files)


def _methods(text: str | None) -> tuple[str, ...] | None:
    names = None if text is None else parse_names(text)
    if names == ():
        raise UsageError("--method is empty; leave it out for all.")
    return names


def _show(parts: Iterable[Group], remarks: Iterable[str], files: Iterable[Path]) -> None:
    from rich.console import Console

    from cudc_bench.execution.progress import echo

    screen = Console(highlight=False)
    for part in parts:
        screen.print(part)
        screen.print()
    for remark in remarks:
        echo(f"note: {remark}")
    for file in files:
        typer.echo(file)
