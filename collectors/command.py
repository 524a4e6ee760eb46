"""``cudc-bench collect``, ``pilot``, ``import-exorl``, ``import-minari`` and ``mix``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cudc_bench.cli import completion
from cudc_bench.cli.options import (
    CheckpointEveryOption,
    DatasetIdOption,
    DeviceOption,
    DomainOption,
    EngineOption,
    FreshOption,
    LogDirOption,
    LogOption,
    MethodOption,
    OverwriteOption,
    PrecisionOption,
    ProfileOption,
    SeedsOption,
    SetOption,
    TasksOption,
    WorkersOption,
    parse_names,
    with_precision,
)
from cudc_bench.errors import UsageError
from cudc_bench.execution import CHECKPOINT_EVERY, LOG_DIR, interrupts
from cudc_bench.settings.seeds import parse_seeds


@interrupts.leaving_gracefully()  # also between two methods
def collect(
    method: MethodOption = "cudc",
    domain: DomainOption = "walker",
    seeds: SeedsOption = "1",
    profile: ProfileOption = "auto",
    settings: SetOption = None,
    precision: PrecisionOption = None,
    dataset_id: DatasetIdOption = None,
    overwrite: OverwriteOption = False,
    device: DeviceOption = "auto",
    engine: EngineOption = "auto",
    workers: WorkersOption = None,
    log: LogOption = None,
    log_dir: LogDirOption = LOG_DIR,
    checkpoint_every: CheckpointEveryOption = CHECKPOINT_EVERY,
    fresh: FreshOption = False,
) -> None:
    """Explore a domain without rewards and write Minari datasets."""
    from cudc_bench import plugins
    from cudc_bench.envs import check_domain
    from cudc_bench.execution.progress import echo
    from cudc_bench.settings.config import parse_settings

    from .running.collect import collect as run

    methods = [plugins.check_name("collectors", name) for name in parse_names(method)]
    if not methods:
        raise UsageError("--method is empty; see cudc-bench list.")
    if dataset_id is not None and len(methods) > 1:
        raise UsageError("--dataset-id names one dataset, but there are several methods; leave it out.")
    given = with_precision(parse_settings(settings or []), precision)
    ids: list[str] = []
    # All input is checked before any work starts, the last method's before the first one's.
    for check_only in (True, False):
        ids = [
            one
            for name in methods
            for one in run(
                name, domain, parse_seeds(seeds), profile=profile, settings=given, dataset_id=dataset_id,
                overwrite=overwrite, device=device, engine=engine, workers=workers, log=log, log_dir=log_dir,
                checkpoint_every=checkpoint_every, fresh=fresh, check_only=check_only,
            )
        ]  # fmt: skip
    for one in ids:
        print(one)
    relabel = f": cudc-bench relabel {ids[0]}, or" if check_domain(domain).tasks else ","
    echo(f"next{relabel} in Python: minari.load_dataset('{ids[0]}')")


def pilot(
    method: Annotated[
        str, typer.Option("--method", help="Collectors that need a threshold, or 'all' such.", autocompletion=completion.some_methods)
    ] = "all",
    domain: DomainOption = "walker",
    profile: ProfileOption = "auto",
    settings: SetOption = None,
    precision: PrecisionOption = None,
    device: DeviceOption = "auto",
    engine: EngineOption = "auto",
    workers: WorkersOption = None,
    checkpoint_every: CheckpointEveryOption = CHECKPOINT_EVERY,
    fresh: FreshOption = False,
) -> None:
    """Measure the thresholds that some variants of CUDC need."""
    from cudc_bench.settings.config import parse_settings

    from .running.pilot import pilot as run
    from .running.thresholds import thresholds_path

    names = None if method.strip() == "all" else parse_names(method)
    if names == ():
        raise UsageError("--method is empty; leave it out for all that need a threshold.")
    run(
        names, domain, profile=profile, settings=with_precision(parse_settings(settings or []), precision), device=device, engine=engine,
        workers=workers, checkpoint_every=checkpoint_every, fresh=fresh,
    )  # fmt: skip
    print(thresholds_path())


def import_exorl(
    directory: Annotated[Path, typer.Argument(help="Folder of the .npz files of one collection.")],
    method: MethodOption,
    domain: DomainOption = "walker",
    task: TasksOption = "",
    steps: Annotated[int | None, typer.Option("--steps", help="Only the first so many steps.")] = None,
    seed: SeedsOption = "1",
    source: Annotated[str, typer.Option("--source", help="Who collected the files, as tables name it.")] = "ExORL",
    dataset_id: DatasetIdOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Turn episode files of ExORL or URLB into a Minari dataset."""
    from .importing.import_exorl import import_exorl as run

    one_method, one_task, one_seed = _single(method, task, seed, "all files belong to one collection")
    _imported(
        run(
            directory,
            one_method,
            domain,
            task=one_task,
            steps=steps,
            seed=one_seed,
            source=source,
            dataset_id=dataset_id,
            overwrite=overwrite,
        )
    )


def import_minari(
    dataset: Annotated[str, typer.Argument(help="Id of the Minari dataset, such as walker/mine-v0.", autocompletion=completion.datasets)],
    method: MethodOption,
    domain: Annotated[
        str | None,
        typer.Option(
            "--domain",
            help="A domain; what the dataset's environment says unless given.",
            show_default=False,
            autocompletion=completion.domains,
        ),
    ] = None,
    task: TasksOption = "",
    seed: SeedsOption = "1",
    source: Annotated[str, typer.Option("--source", help="Who collected it, as tables name it.")] = "Minari",
    dataset_id: DatasetIdOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Turn what Minari's DataCollector or combine made into a dataset that everything here takes."""
    from .importing.import_minari import import_minari as run

    one_method, one_task, one_seed = _single(method, task, seed, "a dataset is one collection")
    _imported(run(dataset, one_method, domain, task=one_task, seed=one_seed, source=source, dataset_id=dataset_id, overwrite=overwrite))


def mix(
    dataset_ids: Annotated[
        list[str],
        typer.Argument(help="Task-agnostic datasets of one domain, such as walker/cudc-v0.", autocompletion=completion.datasets),
    ],
    steps: Annotated[
        int | None,
        typer.Option("--steps", min=1, help="At most so many in all; those of the smallest dataset by default.", show_default=False),
    ] = None,
    seed: SeedsOption = "1",
    dataset_id: DatasetIdOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Make one dataset of equal parts of several, by whole episodes."""
    from .importing.mix import mix as run

    seeds = parse_seeds(seed)
    if len(seeds) > 1 and dataset_id is not None:
        raise UsageError(f"--dataset-id names one dataset, but there are {len(seeds)} seeds; leave it out.")
    for one in seeds:
        _imported(run(dataset_ids, steps, one, dataset_id=dataset_id, overwrite=overwrite))


def _single(method: str, task: str, seed: str, why: str) -> tuple[str, str | None, int]:
    """The one method, task if any, and seed of what is imported."""
    methods, tasks, seeds = parse_names(method), parse_names(task), parse_seeds(seed)
    for name, values, most in (("--method", methods, "one"), ("--task", tasks, "at most one"), ("--seed", seeds, "one")):
        if len(values) > 1 or not (values or most != "one"):
            raise UsageError(f"{name} takes {most} here, since {why}; import others separately.")
    return methods[0], tasks[0] if tasks else None, seeds[0]


def _imported(one: str) -> None:
    """Say which dataset came to be, and what can be done with it."""
    from cudc_bench.artefacts.manifest import read_manifest
    from cudc_bench.cli.hints import evaluate_on
    from cudc_bench.execution.progress import echo

    print(one)
    manifest = read_manifest(one)
    if manifest.task is not None:
        echo(f"next: {evaluate_on([one])}")
    elif "infos/physics" in manifest.fields:
        echo(f"next: cudc-bench relabel {one}, then {evaluate_on([one])}")
    else:
        echo(f"next, in Python: minari.load_dataset('{one}')")
