"""The commands that make a record again where there is nothing yet: the collection and the labels of its dataset, then the training."""

from __future__ import annotations

from cudc_bench.artefacts.ids import default_id, parse_id
from cudc_bench.artefacts.manifest import PartOrigin
from cudc_bench.artefacts.provenance import command_line, is_own_command
from cudc_bench.artefacts.records import DatasetReference, Record
from cudc_bench.artefacts.tiers import TIERS
from cudc_bench.errors import UsageError
from cudc_bench.settings.profiles import PAPER_STEPS, PROFILES


def base_id(dataset: DatasetReference) -> str | None:
    """The id of the dataset whose states another's are: ``walker/cudc-v0`` for ``walker/walk/cudc-v0``; None if its id is none."""
    try:
        one = parse_id(dataset.id)
    except UsageError:
        return None
    parts = one.namespace.split("/")
    if dataset.method in TIERS:
        return str(one)
    if len(parts) > 1 and parts[-1] == dataset.task:
        return f"{'/'.join(parts[:-1])}/{one.name}-v{one.version}"
    return str(one)


def collect_commands(dataset: DatasetReference) -> list[str]:
    """What collects the states of a dataset again, or the parts of a mixture, and mixes them.

    None where no command could: it was imported, or a part of it, or its id tells of no base.
    """
    base = base_id(dataset)
    if dataset.source is not None or base is None or any(part.source for part in dataset.parts):
        return []
    if dataset.method in TIERS:
        options = {"--domain": dataset.domain, "--task": dataset.task, "--seed": str(dataset.seed), "--profile": dataset.profile}
        options |= {"--steps": str(dataset.overrides["data_steps"])} if "data_steps" in dataset.overrides else {}
        overrides = {name: value for name, value in dataset.overrides.items() if name != "data_steps"}
        found = [command_line("tiers", options, overrides)]
    elif not dataset.parts:
        found = [_collect(dataset.domain, dataset, base)]
    else:
        found = [_collect(dataset.domain, part, part.id) for part in dataset.parts]
        options = {"--steps": str(mixture_steps(dataset)), "--seed": str(dataset.seed), "--dataset-id": base}
        found.append(command_line(f"mix {' '.join(part.id for part in dataset.parts)}", options, {}))
    return found if all(map(is_own_command, found)) else []


def mixture_steps(dataset: DatasetReference) -> int:
    """The steps that a mixture was asked for, of which it has as many as whole episodes in equal parts can be."""
    usual = PROFILES[dataset.profile].collect.get("steps", PAPER_STEPS) if dataset.profile in PROFILES else dataset.steps
    steps = dataset.overrides.get("steps", usual)
    return steps if isinstance(steps, int) else usual


def _collect(domain: str, dataset: DatasetReference | PartOrigin, dataset_id: str) -> str:
    options = {"--domain": domain, "--method": dataset.method, "--seed": str(dataset.seed), "--profile": dataset.profile}
    try:
        usual = str(default_id(domain, dataset.method, dataset.seed, dataset.profile))
    except UsageError:
        usual = ""
    if usual != dataset_id:
        options["--dataset-id"] = dataset_id
    return command_line("collect", options, dataset.overrides)


def commands_from_nothing(record: Record) -> list[str]:
    """The commands that make a record again in an empty folder with an empty dataset root, in their order.

    One is enough where a training makes its own dataset by name. What an imported dataset, or a part of a mixture, was imported from is not
    known here.
    """
    data, collecting = record.dataset, collect_commands(record.dataset)
    if "--dataset-id" not in record.command.split() or not collecting:
        return [record.again]
    if record.zero_shot is not None or data.method in TIERS:
        return [*collecting, record.again]
    options = {"--task": data.task} if data.reward is None else {"--reward": data.reward.reference}
    labelling = command_line(f"relabel {base_id(data)}", options, {})
    return [*collecting, labelling, record.again]
