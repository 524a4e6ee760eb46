"""``cudc-bench relabel``."""

from __future__ import annotations

from typing import Annotated

import typer

from cudc_bench.errors import UsageError
from cudc_bench.options import (
    DomainOption,
    MethodOption,
    OverwriteOption,
    ProfileOption,
    SeedsOption,
    TasksOption,
    WorkersOption,
    parse_names,
    parse_seeds,
    parse_tasks,
)


def relabel(
    dataset_ids: Annotated[
        list[str] | None, typer.Argument(help="Task-agnostic datasets; by default those of --method and --seeds.")
    ] = None,
    domain: DomainOption = "walker",
    method: MethodOption = "cudc",
    tasks: TasksOption = "all",
    seeds: SeedsOption = "1",
    profile: ProfileOption = "auto",
    standalone: Annotated[bool, typer.Option("--standalone", help="Copy the base's data instead of linking to it.")] = False,
    overwrite: OverwriteOption = False,
    workers: WorkersOption = None,
) -> None:
    """Compute the rewards of tasks from stored physics states."""
    from cudc_bench.progress import say
    from cudc_bench.stages import ensure_collected

    from .api import relabel as run

    wanted = list(dataset_ids or [])
    for name in () if wanted else parse_names(method):
        wanted += ensure_collected(name, domain, parse_seeds(seeds), profile=profile, workers=workers)
    if not wanted:
        raise UsageError("no dataset was named; give an id such as walker/cudc-v0.")
    ids = [one for base in wanted for one in run(base, parse_tasks(tasks), standalone=standalone, overwrite=overwrite)]
    for one in ids:
        print(one)
    say("next: cudc-bench evaluate --algo td3")
