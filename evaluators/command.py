"""``cudc-bench evaluate`` and ``cudc-bench reference``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from cudc_bench.cli import completion
from cudc_bench.cli.options import (
    AlgoOption,
    CheckpointEveryOption,
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
    RewardOption,
    SeedsOption,
    SetOption,
    TasksOption,
    WorkersOption,
    parse_names,
    parse_sizes,
    parse_tasks,
    with_precision,
)
from cudc_bench.execution import CHECKPOINT_EVERY, LOG_DIR
from cudc_bench.settings.seeds import parse_seeds

OutputOption = Annotated[str, typer.Option("--output", help="Folder of the records.")]


def evaluate(
    algo: AlgoOption = "td3",
    domain: DomainOption = "walker",
    tasks: TasksOption = "all",
    method: MethodOption = "cudc",
    seeds: SeedsOption = "1",
    profile: ProfileOption = "auto",
    settings: SetOption = None,
    precision: PrecisionOption = None,
    training_seeds: Annotated[
        str | None, typer.Option("--training-seeds", help="Train on each dataset once with each of these; its own by default.")
    ] = None,
    steps: Annotated[int | None, typer.Option("--steps", min=1, max=10**10, help="Gradient steps, instead of the profile's.")] = None,
    dataset_id: Annotated[
        str | None,
        typer.Option("--dataset-id", help="Datasets separated by commas, instead of --method.", autocompletion=completion.some_datasets),
    ] = None,
    dataset_size: Annotated[
        str | None, typer.Option("--dataset-size", help="Only the first so many transitions; several by commas.")
    ] = None,
    reward: RewardOption = None,
    labels: Annotated[
        str | None,
        typer.Option("--labels", help="Transitions whose rewards learners without rewards are told, 10000 by default; several by commas."),
    ] = None,
    labels_from: Annotated[
        str | None,
        typer.Option("--labels-from", help="Draw these from another dataset than the one trained on.", autocompletion=completion.datasets),
    ] = None,
    output: OutputOption = "results",
    overwrite: OverwriteOption = False,
    device: DeviceOption = "auto",
    engine: EngineOption = "auto",
    workers: WorkersOption = None,
    log: LogOption = None,
    log_dir: LogDirOption = LOG_DIR,
    policy: Annotated[bool, typer.Option("--policy/--no-policy", help="Keep the trained policy beside its record.")] = True,
    checkpoint_every: CheckpointEveryOption = CHECKPOINT_EVERY,
    fresh: FreshOption = False,
) -> None:
    """Train offline algorithms on relabelled datasets and record its scores."""
    from cudc_bench.artefacts.provenance import command_line
    from cudc_bench.execution.progress import echo
    from cudc_bench.settings.config import parse_settings

    from .running.evaluate import evaluate as run

    given = with_precision(parse_settings(settings or []), precision)
    paths = run(
        parse_names(algo), domain, parse_tasks(tasks), parse_names(method), parse_seeds(seeds), profile=profile,
        settings=given, training_seeds=None if training_seeds is None else parse_seeds(training_seeds, "--training-seeds"), steps=steps,
        dataset_id=None if dataset_id is None else parse_names(dataset_id),
        dataset_sizes=None if dataset_size is None else parse_sizes(dataset_size), reward=reward,
        labels=None if labels is None else parse_sizes(labels, "--labels"), labels_from=labels_from, output=output, overwrite=overwrite,
        device=device, engine=engine, workers=workers, log=log, log_dir=log_dir, policies=policy,
        checkpoint_every=checkpoint_every, fresh=fresh,
    )  # fmt: skip
    for path in paths:
        print(path)
    for line in _scores(paths, output):
        echo(line)
    echo(f"next: {command_line('leaderboard', {}, {}, output)}")


def _scores(paths: Sequence[Path], output: str) -> Iterator[str]:
    """One line for each record: its score, its spread, and between what it lies where that was measured."""
    from statistics import pstdev

    from cudc_bench.artefacts.records import LABELS, read_record
    from cudc_bench.artefacts.references import read_references

    bounds, _ = read_references([Path(output)])
    for path in paths:
        record = read_record(path)
        data, episodes = record.dataset, record.conclusion
        within = bounds.get((record.profile, data.domain, data.task))
        name = f"{record.algorithm} on {record.labelled_id}" + ("" if data.used is None else f" (first {data.used:,})")
        if (told := record.zero_shot) is not None and told.labels != LABELS:
            name += f", {told.labels:,} labels"
        name += "" if record.seed == data.seed else f", training seed {record.seed}"
        score = f"{episodes.mean:.1f} ± {pstdev(episodes.returns):.1f} over {len(episodes.returns)} episodes"
        ends = "" if within is None else f"; random {within.floor:.1f}, trained online {within.ceiling:.1f}"
        yield f"{name}: {score}{ends}"


def reference(
    domain: DomainOption = "walker",
    tasks: TasksOption = "all",
    seeds: SeedsOption = "1-3",
    profile: ProfileOption = "auto",
    settings: SetOption = None,
    precision: PrecisionOption = None,
    output: OutputOption = "results",
    overwrite: OverwriteOption = False,
    device: DeviceOption = "auto",
    engine: EngineOption = "auto",
    workers: WorkersOption = None,
    log: LogOption = None,
    log_dir: LogDirOption = LOG_DIR,
    checkpoint_every: CheckpointEveryOption = CHECKPOINT_EVERY,
    fresh: FreshOption = False,
) -> None:
    """Measure random actions, and TD3 trained online on tasks: the floor and the ceiling that scores are normalised between."""
    from cudc_bench.artefacts.references import read_reference
    from cudc_bench.execution.progress import echo
    from cudc_bench.settings.config import parse_settings

    from .running.reference import make_references

    paths = make_references(
        domain, parse_tasks(tasks), parse_seeds(seeds), profile=profile, settings=with_precision(parse_settings(settings or []), precision),
        output=output, overwrite=overwrite, device=device, engine=engine, workers=workers, log=log, log_dir=log_dir,
        checkpoint_every=checkpoint_every, fresh=fresh,
    )  # fmt: skip
    for path in paths:
        print(path)
        found = read_reference(path)
        bounds = found.bounds
        echo(f"{found.task}: random {bounds.floor:.1f}, untrained {bounds.untrained:.1f}, trained online {bounds.ceiling:.1f}")
    echo(f"next: cudc-bench leaderboard {output}")


def tiers(
    domain: DomainOption = "walker",
    tasks: TasksOption = "all",
    seeds: SeedsOption = "1",
    steps: Annotated[
        int | None, typer.Option("--steps", min=1, help="Of expert and medium; as many as the training has by default.", show_default=False)
    ] = None,
    profile: ProfileOption = "auto",
    settings: SetOption = None,
    precision: PrecisionOption = None,
    overwrite: OverwriteOption = False,
    device: DeviceOption = "auto",
    engine: EngineOption = "auto",
    workers: WorkersOption = None,
    log: LogOption = None,
    log_dir: LogDirOption = LOG_DIR,
    checkpoint_every: CheckpointEveryOption = CHECKPOINT_EVERY,
    fresh: FreshOption = False,
) -> None:
    """Train TD3 online on tasks, and keep the datasets that D4RL has: expert, medium, medium-replay and replay."""
    from cudc_bench.cli.hints import evaluate_on
    from cudc_bench.execution.progress import echo
    from cudc_bench.settings.config import parse_settings

    from .running.tiers import make_tiers

    ids = make_tiers(
        domain, parse_tasks(tasks), parse_seeds(seeds), steps=steps, profile=profile,
        settings=with_precision(parse_settings(settings or []), precision), overwrite=overwrite, device=device, engine=engine,
        workers=workers, log=log, log_dir=log_dir, checkpoint_every=checkpoint_every, fresh=fresh,
    )  # fmt: skip
    for one in ids:
        print(one)
    echo(f"next: {evaluate_on(ids)}")
