"""``relabel``: from one task-agnostic dataset to one labelled dataset for each task."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cudc_bench import plugins
from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, parse_id
from cudc_bench.artefacts.manifest import Base, Collected, FieldHasher, Manifest, RewardFunction, check_free, fingerprint, read_manifest
from cudc_bench.artefacts.provenance import command_line, origin, stamp
from cudc_bench.data.layout import MAIN_FILE
from cudc_bench.data.measure import Coverage, measure_coverage
from cudc_bench.data.metadata import write_metadata
from cudc_bench.data.reader import read_episodes
from cudc_bench.data.staging import checkpoints_path, publish, staging, tidy
from cudc_bench.envs import Domain, check_domain, check_tasks
from cudc_bench.envs.rewards import CustomReward, Measured, load_reward
from cudc_bench.errors import UsageError
from cudc_bench.execution import CHECKPOINT_EVERY, interrupts
from cudc_bench.execution.progress import bars, echo
from cudc_bench.files import check_folder, remove_empty, unwritable
from cudc_bench.runs.existing import dataset_stands

from .linked import write_linked


def relabel(
    dataset_id: str = "walker/cudc-v0",
    tasks: Sequence[str] | None = None,
    *,
    reward: str | Callable[[Measured], Any] | None = None,
    standalone: bool = False,
    overwrite: bool = False,
    check_only: bool = False,
) -> list[str]:
    """Compute the rewards of tasks from a dataset's physics states and write one Minari dataset for each task.

    A relabelled dataset that exists and is what this would make is kept. Rewards that an interrupted process had computed are used.

    Args:
        dataset_id: a task-agnostic dataset.
        tasks: of its domain; all of them unless given. One pass over the states serves all.
        reward: instead of tasks, an own reward function, ``"module:function"`` or itself, whose name becomes the task's; see
            ``cudc_bench.envs.rewards``.
        standalone: copy the base's arrays instead of linking to them.
        overwrite: replace relabelled datasets that exist.
        check_only: stop before the work starts; wrong input has been refused by then.

    Returns:
        The ids of the relabelled datasets, such as ``walker/walk/cudc-v0``, in the domain's order of tasks.

    Raises:
        UsageError: wrong input; nothing has been written.
        RunError: the dataset is damaged or cannot be written.
        Interrupted: the process was asked to leave; the rewards so far are kept.
    """
    wanted = _Wanted.checked(dataset_id, tasks, reward, standalone)
    left = {task: one for task, one in wanted.ids.items() if overwrite or not wanted.is_made(task)}
    for one in left.values():
        check_free(one, overwrite)
    check_folder(datasets_root(), "the dataset root")
    ids = [str(one) for one in wanted.ids.values()]
    if check_only:
        return ids

    for task, one in wanted.ids.items():
        if task not in left:
            tidy(one)
            echo(f"{one} was made from this very base: kept")
    if left:
        echo(f"relabel {wanted.base_id} ({wanted.base.describe()}) for {', '.join(left)}")
        _make(wanted, left, overwrite)
    return ids


@dataclass(frozen=True)
class _Wanted:
    """The labelled datasets that somebody asks for.

    Attributes:
        base_id, base, domain: what they are made from.
        custom: an own reward function instead of tasks.
        standalone: whether they hold the base's arrays, too.
        ids: theirs, by task.
    """

    base_id: DatasetId
    base: Manifest
    domain: Domain
    custom: CustomReward | None
    standalone: bool
    ids: dict[str, DatasetId]

    @classmethod
    def checked(
        cls, dataset_id: str, tasks: Sequence[str] | None, reward: str | Callable[[Measured], Any] | None, standalone: bool
    ) -> _Wanted:
        """The same as a user asks for it.

        Raises:
            UsageError: it cannot be.
        """
        base_id = parse_id(dataset_id)
        base = read_manifest(base_id)
        if base.task is not None:
            if base.tier is not None:
                raise UsageError(
                    f"'{base_id}' is of a training on {base.task}, whose rewards it has, and cannot be relabelled; to have data for every"
                    " task: cudc-bench collect."
                )
            if base.base is None:
                raise UsageError(f"'{base_id}' came with the rewards of {base.task} and has no base to relabel; import it without --task.")
            raise UsageError(f"'{base_id}' is already relabelled for {base.task}; relabel its base of '{base.base.id}'.")
        if "infos/physics" not in base.fields:
            hint = "; if the rewards in its files are a task's, import them with --task" if base.imported else ""
            raise UsageError(f"'{base_id}' holds no physics states and cannot be relabelled{hint}.")
        facts = check_domain(base.domain)
        custom = None if reward is None else load_reward(reward, facts)
        if custom is not None and tasks is not None:
            raise UsageError("--reward makes a task of its own; leave out --tasks.")
        chosen = check_tasks(facts, tasks) if custom is None else (custom.name,)
        if not chosen:
            raise UsageError(f"no task was given; allowed: {', '.join(facts.tasks)}.")
        return cls(base_id, base, facts, custom, standalone, {task: base_id.for_task(task) for task in chosen})

    @property
    def function(self) -> RewardFunction | None:
        """What manifests say of the own reward function."""
        return None if self.custom is None else RewardFunction(reference=self.custom.reference, sha256=self.custom.sha256)

    @property
    def origin(self) -> Base:
        """What manifests say of the base."""
        return Base(id=str(self.base_id), fingerprint=self.base.fingerprint, linked=not self.standalone)

    def is_made(self, task: str) -> bool:
        """Whether the dataset of a task exists and is what this would make."""
        wanted = (task, self.origin, self.function)
        return dataset_stands(self.ids[task], lambda there: (there.task, there.base, there.reward) == wanted)


def _make(wanted: _Wanted, left: dict[str, DatasetId], overwrite: bool) -> None:
    """Make the datasets of some tasks, with one pass over the states."""
    base_id, base = wanted.base_id, wanted.base
    started = time.monotonic()
    with ExitStack() as stack:
        for one in left.values():
            stack.callback(remove_empty, dataset_path(one).parent)  # a task without datasets, if this ends without one
        folders = {task: stack.enter_context(staging(one, resume=True)) for task, one in left.items()}
        if not overwrite and all(map(wanted.is_made, left)):
            return  # by another process, while this one was starting
        stack.enter_context(interrupts.leaving_gracefully())
        rewards = _rewards(base_id, base, wanted.domain, tuple(left), wanted.custom, checkpoints_path(next(iter(left.values()))))
        # The tasks' datasets share observations and actions.
        coverage = measure_coverage(dataset_path(base_id) / "data" / MAIN_FILE, base)
        for index, (task, one) in enumerate(left.items()):
            columns = [np.ascontiguousarray(episode[:, index]) for episode in rewards]
            try:
                _write(wanted, task, columns, started, coverage, folders[task] / "dataset")
            except OSError as error:
                raise unwritable(f"'{one}' below {dataset_path(one).parent}", error) from None
            mean = sum(float(column.sum(dtype=np.float64)) for column in columns) / base.steps
            echo(f"wrote {one} (mean reward {mean:.3f}) to {dataset_path(one)}")


def _rewards(
    base_id: DatasetId, base: Manifest, domain: Domain, tasks: tuple[str, ...], custom: CustomReward | None, kept: Path
) -> list[NDArray[np.float32]]:
    """Rewards (T, tasks) of each episode of a dataset, with memory for one episode beside them.

    Args:
        base_id, base, domain: of the dataset.
        tasks: in the order of the columns.
        custom: an own reward function instead.
        kept: where those that an interrupted process computed lie, and will lie.
    """
    relabeler = plugins.load("relabelers", domain.relabeler)(domain)
    columns = [domain.tasks.index(task) for task in tasks if task in domain.tasks]
    decisive = {"base": base.fingerprint, "tasks": list(tasks), "reward": None if custom is None else custom.sha256, **origin({})}
    found = _resume(kept, decisive)
    last = time.monotonic()
    with bars([("rewards", base.steps)], "states") as (advance,):
        # All of it, since what is made links to all of it or copies it.
        for index, episode in enumerate(read_episodes(base_id, tuple(base.fields), verify=True, domain=domain)):
            # Row 0 of an episode is its reset, which no action led to.
            states, actions = episode["infos/physics"][1:], episode["actions"]
            if index >= len(found):
                if custom is None:
                    rewards = relabeler.rewards(states, actions)[:, columns]
                else:
                    quantities = relabeler.quantities(states, actions)
                    rewards = custom(Measured(domain, quantities, states, actions, episode["observations"][1:]))[:, None]
                found.append(rewards.astype(np.float32))
            advance(len(actions))
            if interrupts.requested() or time.monotonic() - last > CHECKPOINT_EVERY:
                _keep(kept, decisive, found)
                last = time.monotonic()
            if interrupts.requested():
                raise interrupts.interrupted(f"relabelling {base_id} after {len(found):,} of {base.episodes:,} episodes")
    return found


def _keep(folder: Path, decisive: dict[str, Any], rewards: list[NDArray[np.float32]]) -> None:
    # Only a run that lasts needs them, and with them PyTorch.
    import torch

    from cudc_bench.execution.checkpoints import Checkpoints

    Checkpoints(folder, decisive).save(len(rewards), {"rewards": [torch.from_numpy(one) for one in rewards]})


def _resume(folder: Path, decisive: dict[str, Any]) -> list[NDArray[np.float32]]:
    found: list[NDArray[np.float32]] = []
    if folder.exists():
        from cudc_bench.execution.checkpoints import Checkpoints

        checkpoints = Checkpoints(folder, decisive)
        checkpoints.load(lambda _, state: found.extend(one.numpy() for one in state["rewards"]))
        if not found:
            checkpoints.remove()  # of other rewards, which are computed anew whenever somebody wants them
    return found


def _write(wanted: _Wanted, task: str, rewards: list[NDArray[np.float32]], started: float, coverage: Coverage, folder: Path) -> None:
    base_id, base, dataset_id, reward = wanted.base_id, wanted.base, wanted.ids[task], wanted.function
    hasher = FieldHasher()
    for episode in rewards:
        hasher.update("rewards", episode)
    fields = base.fields | hasher.digests()
    flags = ["--standalone"] if wanted.standalone else []
    options = {"--task": task} if reward is None else {"--reward": reward.reference}
    manifest = base.model_copy(
        update={
            "task": task,
            "fields": fields,
            "fingerprint": fingerprint(fields),
            "base": wanted.origin,
            "collected": Collected(versions=base.versions, machine=base.machine),
            "reward": reward,
            "command": command_line(f"relabel {base_id}", options, {}, *flags),
        }
        | stamp(time.monotonic() - started)
    )
    labels = f"{base.domain} {task}" if reward is None else f"the function {reward.reference}"
    description = f"{base_id} with the rewards of {labels}; reward t is that of the state which action t led to."
    shutil.rmtree(folder, ignore_errors=True)
    place = dataset_path(dataset_id) / "data"
    write_linked(dataset_path(base_id) / "data" / MAIN_FILE, folder / "data", place, rewards, wanted.standalone)
    write_metadata(folder / "data", manifest, str(dataset_id), description, coverage)
    publish(folder, dataset_id)
