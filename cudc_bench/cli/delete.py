"""``cudc-bench delete``."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from cudc_bench.cli import completion
from cudc_bench.errors import RunError, UsageError

if TYPE_CHECKING:
    from cudc_bench.data.deletion import Deletion


def delete(
    dataset_ids: Annotated[
        list[str],
        typer.Argument(help="Datasets, such as walker/cudc-v0; also of interrupted commands.", autocompletion=completion.datasets),
    ],
    with_labelled: Annotated[bool, typer.Option("--with-labelled", help="Also the labelled datasets that link to them.")] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show what would go and what speaks of it, and delete nothing.")] = False,
    results: Annotated[str, typer.Option("--output", help="Folder of the records, which are kept.")] = "results",
) -> None:
    """Delete datasets, unless others need them or somebody is at work on them."""
    from cudc_bench.data.deletion import plan_deletion, remove
    from cudc_bench.execution.progress import echo
    from cudc_bench.files import check_folder
    from cudc_bench.text import size

    folder = check_folder(results, "the folder of the records", writable=False)
    plan = plan_deletion(dataset_ids, with_labelled, folder)
    if not (yes or dry_run) and not _can_ask():
        raise UsageError("nothing was deleted; give --yes to delete, or --dry-run to see what would go.")
    if dry_run:
        for line in _lines(plan):
            print(line)
        return
    if not yes:
        _ask(plan)
        # Somebody may have thought for long.
        if plan_deletion(dataset_ids, with_labelled, folder).datasets != plan.datasets:
            raise RunError("what is there has changed meanwhile: nothing was deleted; run the same command again.")
    else:
        for remark in plan.remarks:
            echo(f"note: {remark}")
    for one in plan.datasets:
        remove(one.id)
        print(one.id)
    echo(f"deleted {len(plan.datasets)}, {size(plan.bytes)}")


def _can_ask() -> bool:
    """Whether somebody sits at a terminal."""
    return sys.stdin.isatty() and sys.stderr.isatty()


def _lines(plan: Deletion) -> list[str]:
    from cudc_bench.text import size, visible

    lines = [visible(f"{one.id}: {one.what}, {size(one.bytes)}") for one in plan.datasets]
    return [*lines, *(f"note: {visible(remark)}" for remark in plan.remarks)]


def _ask(plan: Deletion) -> None:
    """Show what would go, and go on only if somebody agrees.

    Raises:
        RunError: nobody does.
    """
    from cudc_bench.text import size

    for line in _lines(plan):
        print(line, file=sys.stderr)
    strangers = sum(not one.ours for one in plan.datasets)
    theirs = f", {strangers} of them not made by cudc-bench," if strangers else ""
    count = f"{len(plan.datasets)} dataset{'' if len(plan.datasets) == 1 else 's'}{theirs} ({size(plan.bytes)})"
    if not typer.confirm(f"Delete {count}?", err=True):
        raise RunError("nothing was deleted.")
