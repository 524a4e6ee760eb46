"""The options that every command spells the same way."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated

import typer

from cudc_bench.cli import completion
from cudc_bench.errors import UsageError

DomainOption = Annotated[str, typer.Option("--domain", help="What is explored.", autocompletion=completion.domains)]
MethodOption = Annotated[
    str, typer.Option("--method", help="Collector, or several separated by commas.", autocompletion=completion.some_methods)
]
TasksOption = Annotated[
    str, typer.Option("--tasks", "--task", help="Tasks separated by commas, or 'all'.", autocompletion=completion.some_tasks)
]
RewardOption = Annotated[str | None, typer.Option("--reward", help="Own reward function, as module:function, instead of --tasks.")]
AlgoOption = Annotated[
    str, typer.Option("--algo", help="Offline algorithm, or several separated by commas.", autocompletion=completion.some_algos)
]
SeedsOption = Annotated[str, typer.Option("--seeds", "--seed", help="Seeds, such as 1 or 1-5 or 1,3.")]
ProfileOption = Annotated[
    str,
    typer.Option(
        "--profile",
        envvar="CUDC_BENCH_PROFILE",
        help="Set of hyperparameters: paper, cpu, demo, smoke, or auto.",
        autocompletion=completion.profiles,
    ),
]
SetOption = Annotated[list[str] | None, typer.Option("--set", help="Override one hyperparameter: name=value. Repeatable.")]
PrecisionOption = Annotated[
    str | None,
    typer.Option(
        "--precision",
        help="Of wide products in updates: float32, bf16, tf32 (CUDA).",
        autocompletion=completion.one_of("float32", "bf16", "tf32"),
    ),
]
DatasetIdOption = Annotated[
    str | None, typer.Option("--dataset-id", help="Id of the dataset, instead of the default one.", autocompletion=completion.datasets)
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace what exists.")]
DeviceOption = Annotated[str, typer.Option("--device", help="cpu, cuda, or auto.", autocompletion=completion.one_of("auto", "cpu", "cuda"))]
EngineOption = Annotated[
    str,
    typer.Option(
        "--engine",
        help="How updates are carried out: eager, compiled, or auto.",
        autocompletion=completion.one_of("auto", "eager", "compiled"),
    ),
]
LogOption = Annotated[
    str | None,
    typer.Option(
        "--log",
        help="Also log the run to tensorboard or wandb (extras of those names).",
        autocompletion=completion.one_of("tensorboard", "wandb"),
    ),
]
LogDirOption = Annotated[str, typer.Option("--log-dir", help="Folder of these logs.")]
WorkersOption = Annotated[int | None, typer.Option("--workers", help="Processes on a CPU; one for each core by default.")]
CheckpointEveryOption = Annotated[float, typer.Option("--checkpoint-every", min=0.0, help="Seconds between two checkpoints.")]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on standard output, for scripts.")]
FreshOption = Annotated[bool, typer.Option("--fresh", help="Start over where a run was interrupted, instead of continuing it.")]


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


def parse_names(text: str) -> tuple[str, ...]:
    """``"stand, walk"`` -> ("stand", "walk"), without repeats or empty parts."""
    return tuple(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))


def parse_tasks(text: str) -> tuple[str, ...] | None:
    """Names of tasks, or None for ``all``."""
    return None if text.strip() == "all" else parse_names(text)


def parse_sizes(text: str, option: str = "--dataset-size") -> tuple[int, ...]:
    """``"100000, 200_000"`` -> (100000, 200000).

    Raises:
        UsageError: it is not a list of positive whole numbers.
    """
    parts = parse_names(text)
    if not parts or not all(len(part) < 16 and re.fullmatch(r"[1-9][0-9]*(_[0-9]+)*", part) for part in parts):
        raise UsageError(f"{option} cannot be '{text}'; give numbers of transitions, such as 100000,200000.")
    return tuple(int(part.replace("_", "")) for part in parts)
