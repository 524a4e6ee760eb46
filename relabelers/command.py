"""``cudc-bench relabel``."""

from __future__ import annotations

from typing import Annotated

import typer

from cudc_bench.cli import completion
from cudc_bench.cli.options import (
    DomainOption,
    MethodOption,
    OverwriteOption,
    ProfileOption,
    RewardOption,
    SeedsOption,
    TasksOption,
    WorkersOption,
    parse_names,
    parse_tasks,
)
from cudc_bench.errors import UsageError
from cudc_bench.execution import interrupts
from cudc_bench.settings.seeds import parse_seeds


@interrupts.leaving_gracefully()  # also between two datasets
def relabel(
    dataset_ids: Annotated[
        list[str] | None,
        typer.Argument(help="Task-agnostic datasets; by default those of --method and --seeds.", autocompletion=completion.datasets),
    ] = None,
    domain: DomainOption = "walker",
    method: MethodOption = "cudc",
    tasks: TasksOption = "all",
    reward: RewardOption = None,
    seeds: SeedsOption = "1",
    profile: ProfileOption = "auto",
    standalone: Annotated[bool, typer.Option("--standalone", help="Copy the base's data instead of linking to it.")] = False,
    overwrite: OverwriteOption = False,
    workers: WorkersOption = None,
) -> None:
    """Compute the rewards of tasks from stored physics states."""
    from cudc_bench.artefacts.manifest import check_free, exists
    from cudc_bench.cli.hints import evaluate_on
    from cudc_bench.envs import check_domain, check_tasks
    from cudc_bench.envs.rewards import load_reward
    from cudc_bench.execution.parallel import worker_count
    from cudc_bench.execution.progress import echo
    from cudc_bench.settings.profiles import resolve_profile
    from cudc_bench.stages import check_collected, ensure_collected

    from .api import relabel as run

    chosen, wanted = parse_tasks(tasks), list(dataset_ids or [])
    methods, numbers = parse_names(method), parse_seeds(seeds)
    # Also what is of no use beside ids of datasets: whoever gives it wrongly expects something of it.
    check_domain(domain)
    resolve_profile(profile)
    worker_count(workers, 1)
    if not wanted:
        for name in methods:
            for base in check_collected(name, domain, numbers, profile=profile):
                facts = check_domain(domain)
                for task in check_tasks(facts, chosen) if reward is None else (load_reward(reward, facts).name,):
                    # Whether a relabelled dataset fits its base is known once there is one.
                    if not exists(base):
                        check_free(base.for_task(task), overwrite)
        for name in methods:
            wanted += ensure_collected(name, domain, numbers, profile=profile, workers=workers)
    if not wanted:
        raise UsageError("no dataset was named; give an id such as walker/cudc-v0.")
    ids: list[str] = []
    # All datasets are checked before any work starts, the last one before the first.
    for check_only in (True, False):
        ids = [
            one
            for base in wanted
            for one in run(base, chosen, reward=reward, standalone=standalone, overwrite=overwrite, check_only=check_only)
        ]
    for one in ids:
        print(one)
    echo(f"next: {evaluate_on(ids, reward=reward) if reward else evaluate_on([str(one) for one in wanted], chosen)}")
