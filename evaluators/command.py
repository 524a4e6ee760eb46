"""``cudc-bench evaluate``."""

from __future__ import annotations

from typing import Annotated

import typer

from cudc_bench.options import (
    LOG_DIR,
    AlgoOption,
    DatasetIdOption,
    DeviceOption,
    DomainOption,
    LogDirOption,
    LogOption,
    MethodOption,
    OverwriteOption,
    ProfileOption,
    RewardOption,
    SeedsOption,
    SetOption,
    TasksOption,
    WorkersOption,
    parse_names,
    parse_seeds,
    parse_tasks,
)


def evaluate(
    algo: AlgoOption = "td3",
    domain: DomainOption = "walker",
    tasks: TasksOption = "all",
    method: MethodOption = "cudc",
    seeds: SeedsOption = "1",
    profile: ProfileOption = "auto",
    settings: SetOption = None,
    dataset_id: DatasetIdOption = None,
    reward: RewardOption = None,
    output: Annotated[str, typer.Option("--output", help="Folder of the records.")] = "results",
    overwrite: OverwriteOption = False,
    device: DeviceOption = "auto",
    workers: WorkersOption = None,
    log: LogOption = None,
    log_dir: LogDirOption = LOG_DIR,
) -> None:
    """Train an offline algorithm on relabelled datasets and record its scores."""
    from cudc_bench.config import parse_settings
    from cudc_bench.progress import say

    from .api import evaluate as run

    paths = run(
        algo, domain, parse_tasks(tasks), parse_names(method), parse_seeds(seeds), profile=profile,
        settings=parse_settings(settings or []), dataset_id=dataset_id, reward=reward, output=output, overwrite=overwrite, device=device,
        workers=workers, log=log, log_dir=log_dir,
    )  # fmt: skip
    for path in paths:
        print(path)
    say(f"next: cudc-bench leaderboard {output}")
