"""The commands that make a record again where there is nothing yet: the collection and the labels of its dataset, then the training."""

from __future__ import annotations

from cudc_bench.artefacts.ids import default_id, parse_id
from cudc_bench.artefacts.provenance import command_line, is_own_command
from cudc_bench.artefacts.records import DatasetReference, Record
from cudc_bench.errors import UsageError


def base_id(dataset: DatasetReference) -> str | None:
    """The id of the dataset whose states another's are: ``walker/cudc-v0`` for ``walker/walk/cudc-v0``; None if its id is none."""
    try:
        one = parse_id(dataset.id)
    except UsageError:
        return None
    parts = one.namespace.split("/")
    if len(parts) > 1 and parts[-1] == dataset.task:
        return f"{'/'.join(parts[:-1])}/{one.name}-v{one.version}"
    return str(one)


def collect_command(dataset: DatasetReference) -> str | None:
    """What collects the states of a dataset again; None where no command could: it was imported, or its id tells of no base."""
    base = base_id(dataset)
    if dataset.source is not None or base is None:
        return None
    options = {"--domain": dataset.domain, "--method": dataset.method, "--seed": str(dataset.seed), "--profile": dataset.profile}
    try:
        usual = str(default_id(dataset.domain, dataset.method, dataset.seed, dataset.profile))
    except UsageError:
        usual = ""
    if usual != base:
        options["--dataset-id"] = base
    command = command_line("collect", options, dataset.overrides)
    return command if is_own_command(command) else None


def commands_from_nothing(record: Record) -> list[str]:
    """The commands that make a record again in an empty folder with an empty dataset root, in their order.

    One is enough where a training makes its own dataset by name. What an imported dataset was imported from is not known here.
    """
    data, collecting = record.dataset, collect_command(record.dataset)
    if "--dataset-id" not in record.command.split() or collecting is None:
        return [record.again]
    if record.zero_shot is not None:
        return [collecting, record.again]
    options = {"--task": data.task} if data.reward is None else {"--reward": data.reward.reference}
    labelling = command_line(f"relabel {base_id(data)}", options, {})
    return [collecting, labelling, record.again]
