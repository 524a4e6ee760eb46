"""``relabel``: from one task-agnostic dataset to one labelled dataset for each task."""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from cudc_bench import plugins
from cudc_bench.data.reader import load_episodes
from cudc_bench.data.staging import publish, staging
from cudc_bench.data.writer import MAIN_FILE, write_metadata
from cudc_bench.envs import Domain, check_domain, check_tasks
from cudc_bench.errors import UsageError
from cudc_bench.ids import DatasetId, dataset_path, datasets_root, parse_id
from cudc_bench.manifest import Base, FieldHasher, Manifest, check_free, fingerprint, read_manifest
from cudc_bench.options import check_folder
from cudc_bench.progress import bars, say
from cudc_bench.provenance import command_line, commit, machine, versions

from .linked import write_linked

_ROWS = 20_000  # states between two updates of the progress bar


def relabel(
    dataset_id: str = "walker/cudc-v0",
    tasks: Sequence[str] | None = None,
    *,
    standalone: bool = False,
    overwrite: bool = False,
    check_only: bool = False,
) -> list[str]:
    """Compute the rewards of tasks from a dataset's physics states and write one Minari dataset for each task.

    Args:
        dataset_id: a task-agnostic dataset.
        tasks: of its domain; all of them unless given. One pass over the states serves all.
        standalone: copy the base's arrays instead of linking to them.
        overwrite: replace relabelled datasets that exist.
        check_only: stop before the work starts; wrong input has been refused by then.

    Returns:
        The ids of the relabelled datasets, such as ``walker/walk/cudc-v0``, in the domain's order of tasks.

    Raises:
        UsageError: wrong input; nothing has been written.
        RunError: the dataset is damaged or cannot be written.
    """
    base_id = parse_id(dataset_id)
    base = read_manifest(base_id)
    if base.task is not None:
        of = f" of '{base.base.id}'" if base.base else ""
        raise UsageError(f"'{base_id}' is already relabelled for {base.task}; relabel its base{of}.")
    if "infos/physics" not in base.fields:
        raise UsageError(f"'{base_id}' holds no physics states and cannot be relabelled.")
    facts = check_domain(base.domain)
    chosen = check_tasks(facts, tasks)
    if not chosen:
        raise UsageError(f"no task was given; allowed: {', '.join(facts.tasks)}.")
    ids = {task: base_id.for_task(task) for task in chosen}
    for one in ids.values():
        check_free(one, overwrite)
    check_folder(datasets_root(), "the dataset root")
    if check_only:
        return [str(one) for one in ids.values()]

    say(f"relabel {base_id} ({base.describe()}) for {', '.join(chosen)}")
    started = time.monotonic()
    flat = load_episodes(base_id, ("infos/physics", "actions"))
    states = flat.split("infos/physics")
    # Row 0 of an episode is its reset, which no action led to.
    reached = np.concatenate([episode[1:] for episode in states])
    rewards = _rewards(facts, reached, flat.arrays["actions"]).astype(np.float32)
    ends = np.cumsum(flat.lengths)[:-1]
    for task, one in ids.items():
        column = np.ascontiguousarray(rewards[:, facts.tasks.index(task)])
        _write(base, base_id, one, task, np.split(column, ends), standalone, started)
        say(f"wrote {one} (mean reward {column.mean():.3f}) to {dataset_path(one)}")
    return [str(one) for one in ids.values()]


def _rewards(domain: Domain, states: NDArray[np.float64], actions: NDArray[np.float32]) -> NDArray[np.float64]:
    relabeler = plugins.load("relabelers", domain.relabeler)(domain)
    parts = []
    with bars([("rewards", len(states))], "states") as (advance,):
        for start in range(0, len(states), _ROWS):
            rows = slice(start, start + _ROWS)
            parts.append(relabeler.rewards(states[rows], actions[rows]))
            advance(len(parts[-1]))
    return np.concatenate(parts)


def _write(
    base: Manifest, base_id: DatasetId, dataset_id: DatasetId, task: str, rewards: list[NDArray[np.float32]],
    standalone: bool, started: float,
) -> None:  # fmt: skip
    hasher = FieldHasher()
    for episode in rewards:
        hasher.update("rewards", episode)
    fields = base.fields | hasher.digests()
    head, dirty = commit()
    flags = ["--standalone"] if standalone else []
    manifest = base.model_copy(
        update={
            "task": task,
            "fields": fields,
            "fingerprint": fingerprint(fields),
            "base": Base(id=str(base_id), fingerprint=base.fingerprint, linked=not standalone),
            "versions": versions(),
            "commit": head,
            "dirty": dirty,
            "machine": machine("cpu", 1),
            "seconds": round(time.monotonic() - started, 1),
            "created": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": command_line(f"relabel {base_id}", {"--task": task}, {}, *flags),
        }
    )
    description = f"{base_id} with the rewards of {base.domain} {task}; reward t is that of the state which action t led to."
    with staging(dataset_id) as folder:
        source = dataset_path(base_id) / "data" / MAIN_FILE
        write_linked(source, folder / "data", dataset_path(dataset_id) / "data", rewards, standalone)
        write_metadata(folder / "data", manifest, str(dataset_id), description)
        publish(folder, dataset_id)
