"""What people see while work is done: messages and progress bars on standard error, results on standard output."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

Advance = Callable[[int], None]


@cache
def console() -> Console:
    """The console for messages and bars (standard error)."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def say(message: str) -> None:
    """Print one line for people; text in it is never taken for markup."""
    console().print(message, markup=False, soft_wrap=True)


@contextmanager
def bars(tasks: list[tuple[str, int]], unit: str) -> Iterator[list[Advance]]:
    """Show one progress bar with its time left for each task.

    Args:
        tasks: description and total of each.
        unit: what is counted, such as ``"steps"``.

    Yields:
        For each task, a function that is told by how much it advanced.
    """
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    progress = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TextColumn(unit, markup=False),
        TimeElapsedColumn(),
        TextColumn("left", markup=False),
        TimeRemainingColumn(),
        console=console(),
    )
    with progress:
        numbers = [progress.add_task(description, total=total) for description, total in tasks]
        # The default binds each number now, not when the function is called.
        yield [lambda n, number=number: progress.advance(number, n) for number in numbers]  # type: ignore[misc]
