"""The options that every command spells the same way."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Annotated

import typer

from cudc_bench.errors import UsageError
from cudc_bench.files import check_folder as check_folder  # stages find it beside the checks of other options

DomainOption = Annotated[str, typer.Option("--domain", help="What is explored.")]
MethodOption = Annotated[str, typer.Option("--method", help="Collector, or several separated by commas.")]
TasksOption = Annotated[str, typer.Option("--tasks", "--task", help="Tasks separated by commas, or 'all'.")]
RewardOption = Annotated[str | None, typer.Option("--reward", help="Own reward function, as module:function, instead of --tasks.")]
AlgoOption = Annotated[str, typer.Option("--algo", help="Offline algorithm, or several separated by commas.")]
SeedsOption = Annotated[str, typer.Option("--seeds", "--seed", help="Seeds, such as 1 or 1-5 or 1,3.")]
ProfileOption = Annotated[
    str,
    typer.Option("--profile", envvar="CUDC_BENCH_PROFILE", help="Set of hyperparameters: paper, cpu, demo, smoke, or auto."),
]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="Override one hyperparameter: name=value. Repeatable.")]
PrecisionOption = Annotated[str | None, typer.Option("--precision", help="Of wide products in updates: float32, bf16, tf32 (CUDA).")]
DatasetIdOption = Annotated[str | None, typer.Option("--dataset-id", help="Id of the dataset, instead of the default one.")]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace what exists.")]
DeviceOption = Annotated[str, typer.Option("--device", help="cpu, cuda, or auto.")]
LogOption = Annotated[str | None, typer.Option("--log", help="Also log the run to tensorboard or wandb (extras of those names).")]
LogDirOption = Annotated[str, typer.Option("--log-dir", help="Folder of these logs.")]
WorkersOption = Annotated[int | None, typer.Option("--workers", help="Processes on a CPU; one for each core by default.")]
CheckpointEveryOption = Annotated[float, typer.Option("--checkpoint-every", min=0.0, help="Seconds between two checkpoints.")]
FreshOption = Annotated[bool, typer.Option("--fresh", help="Start over where a run was interrupted, instead of continuing it.")]

CHECKPOINT_EVERY = 60.0
LOG_DIR = "runs"  # TensorBoard's own habit

_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?")


def with_precision(settings: Mapping[str, str], precision: str | None) -> dict[str, str]:
    """The settings of ``--set``, and ``--precision`` among them where it was given.

    Raises:
        UsageError: both say it.
    """
    if precision is None:
        return dict(settings)
    if "precision" in settings:
        raise UsageError("--precision and --set precision say the same; give one of them.")
    return {**settings, "precision": precision}


def parse_seeds(text: str, option: str = "--seeds") -> tuple[int, ...]:
    """``"1-3,7"`` -> (1, 2, 3, 7), without repeats; ``option`` is for messages.

    Raises:
        UsageError: it is not a list of numbers and ranges, or has more than 1,000 seeds.
    """
    seeds: dict[int, None] = {}
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        if match is None or not part.isascii():
            raise UsageError(f"{option} cannot be '{text}'; give numbers and ranges, such as 1 or 1-5 or 1,3.")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first or last - first >= 1000:
            raise UsageError(f"{option} cannot have the range '{part.strip()}'; it must ascend, over at most 1,000 seeds.")
        seeds |= dict.fromkeys(range(first, last + 1))
        if len(seeds) > 1000:
            raise UsageError(f"{option} cannot have more than 1,000 seeds; split them over several runs.")
    return tuple(seeds)


def check_seeds(seeds: Sequence[int]) -> tuple[int, ...]:
    """Refuse seeds that cannot be used together.

    Raises:
        UsageError: there is none, one is negative, or one is given twice.
    """
    if not seeds:
        raise UsageError("no seed was given; give at least one.")
    for seed in seeds:
        if seed < 0:
            raise UsageError(f"a seed cannot be {seed}; it must be 0 or more.")
        if list(seeds).count(seed) > 1:
            raise UsageError(f"the seed {seed} was given twice; give it once.")
    return tuple(seeds)


def parse_names(text: str) -> tuple[str, ...]:
    """``"stand, walk"`` -> ("stand", "walk"), without repeats or empty parts."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def parse_tasks(text: str) -> tuple[str, ...] | None:
    """Names of tasks, or None for ``all``."""
    return None if text.strip() == "all" else parse_names(text)


def parse_sizes(text: str) -> tuple[int, ...]:
    """``"100000, 200_000"`` -> (100000, 200000).

    Raises:
        UsageError: it is not a list of positive whole numbers.
    """
    parts = parse_names(text)
    if not parts or not all(len(part) < 16 and re.fullmatch(r"[1-9][0-9]*(_[0-9]+)*", part) for part in parts):
        raise UsageError(f"--dataset-size cannot be '{text}'; give numbers of transitions, such as 100000,200000.")
    return tuple(int(part.replace("_", "")) for part in parts)


def format_seeds(seeds: Sequence[int]) -> str:
    """A short way to write some different seeds as ``--seeds``."""
    ordered = sorted(seeds)
    if len(ordered) > 2 and len(ordered) == ordered[-1] - ordered[0] + 1:
        return f"{ordered[0]}-{ordered[-1]}"
    return ",".join(map(str, ordered))
