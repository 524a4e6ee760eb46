"""Trainings, their records, and the stacks that train side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import torch

from cudc_bench import plugins
from cudc_bench.artefacts.ids import default_id
from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.artefacts.provenance import command_line, commit, machine, origin, versions
from cudc_bench.artefacts.records import (
    CHECKPOINTS,
    Collection,
    DatasetReference,
    Evaluation,
    Record,
    TrainingMetrics,
    read_record,
    record_path,
)
from cudc_bench.envs import check_domain
from cudc_bench.errors import RunError
from cudc_bench.execution import CHECKPOINT_EVERY
from cudc_bench.execution.checkpoints import Checkpoints
from cudc_bench.execution.locks import locked
from cudc_bench.files import remove_empty_above
from cudc_bench.learning.engines import set_engine
from cudc_bench.runs.execution import Execution
from cudc_bench.runs.existing import result_stands
from cudc_bench.settings.config import config_hash
from cudc_bench.settings.evaluate_config import in_full

from .datasets import load_members
from .loop import Outcome, rehearse_evaluation
from .plans import Plan

SIDE_BY_SIDE = 4  # trainings on one core at most; see benchmarks/README.md


@dataclass(frozen=True)
class Run:
    """One training: an algorithm on a dataset, or on the first ``used`` transitions of it, with a seed, and where its record goes.

    Attributes:
        plan: the algorithm.
        dataset, manifest: the labelled dataset.
        used: how many of its transitions; None for all.
        seed: of the training.
        results: the folder of records.
    """

    plan: Plan
    dataset: str
    manifest: Manifest
    used: int | None
    seed: int
    results: Path

    @property
    def path(self) -> Path:
        """Of its record."""
        return record_path(self.results, self.dataset, self.plan.algo, self.manifest.seed, self.plan.profile, self.used, self.seed)

    @property
    def hidden(self) -> Path:
        """The folder of what it keeps while it works."""
        return self.results / CHECKPOINTS / self.path.relative_to(self.results).with_suffix("")

    @property
    def lock(self) -> Path:
        """Held by whoever makes its record."""
        return self.hidden.with_name(f"{self.hidden.name}.lock")

    def is_done(self) -> bool:
        """Whether this very run is recorded already.

        Raises:
            UsageError: another run stands in its place.
        """
        return is_recorded(self.path, self.plan, self.used, self.seed, lambda dataset: dataset.fingerprint == self.manifest.fingerprint)

    def is_untidy(self) -> bool:
        """Whether something is left of its work."""
        return self.lock.exists() or Stack(Execution(), [self]).checkpoints().folder.exists()

    def tidy(self) -> None:
        """Remove what a process left that was killed just after it had written the record; nothing if somebody is writing it again."""
        if self.is_untidy():
            Stack(Execution(), [self]).tidy()


@dataclass(frozen=True)
class Stack:
    """Runs that are trained side by side, and how."""

    execution: Execution
    runs: list[Run]

    @property
    def engine(self) -> str:
        """How their updates are to be carried out."""
        return self.execution.engine_for(self.plan.kind, self.plan.loop.gradient_steps)

    @property
    def plan(self) -> Plan:
        """Of all of them."""
        return self.runs[0].plan

    @property
    def results(self) -> Path:
        """The folder of records."""
        return self.runs[0].results

    @property
    def seeds(self) -> list[int]:
        """Of the trainings."""
        return [run.seed for run in self.runs]

    @property
    def name(self) -> str:
        """What they make, as messages say it."""
        return f"'{self.runs[0].path}'" if len(self.runs) == 1 else f"{len(self.runs)} records in {self.results}"

    @property
    def label(self) -> str:
        """What stands beside their progress bar."""
        names = [
            run.dataset
            + ("" if run.used is None else f" ({run.used:,})")
            + ("" if run.seed == run.manifest.seed else f" training seed {run.seed}")
            for run in self.runs
        ]
        tasks = [f"/{run.manifest.task}/" for run in self.runs]
        if len(bases := {name.replace(task, "/") for name, task in zip(names, tasks, strict=True)}) == 1 < len(names):
            return f"{self.plan.algo}: {bases.pop()} for {', '.join(task.strip('/') for task in tasks)}"
        return f"{self.plan.algo}: {' + '.join(names) if len(names) < 3 else f'{len(names)} datasets'}"

    def checkpoints(self, every: float = CHECKPOINT_EVERY) -> Checkpoints:
        """In a folder that is named by their records."""
        plan = self.plan
        decisive = {
            "algorithm": plan.algo, "hyperparameters": plan.values, "seeds": self.seeds, "used": self.runs[0].used,
            "datasets": {run.dataset: run.manifest.fingerprint for run in self.runs}, "device": self.execution.device,
            "engine": self.engine, **origin(plugins.package("evaluators", plan.algo)),
        }  # fmt: skip
        if len(self.runs) == 1:
            return Checkpoints(self.runs[0].hidden, decisive, every)
        places = [run.path.relative_to(self.results).with_suffix("").as_posix() for run in self.runs]
        return Checkpoints(self.results / CHECKPOINTS / f"stacks/{plan.algo}-{config_hash({'records': places})}", decisive, every)

    def rehearse(self, members: int) -> None:
        """See :class:`~cudc_bench.runs.memory.Rehearsing`."""
        plan, runs, seeds, device = self.plan, self.runs[:members], self.seeds[:members], self.execution.device
        facts = check_domain(runs[0].manifest.domain)
        agent = plan.kind(facts.observation_size, facts.action_size, plan.config, seeds, device)
        set_engine(agent, self.engine)
        rehearse_evaluation(agent, load_members([run.dataset for run in runs], seeds, device, runs[0].used), plan.loop)

    def is_interrupted(self) -> bool:
        """Whether these very runs have been begun together and not ended."""
        return self.checkpoints().folder.exists()

    def tidy(self) -> None:
        """Remove what a process left that was killed just after it had written the records; nothing if somebody is writing one again."""
        with suppress(RunError), ExitStack() as opened:
            for run in self.runs:
                opened.enter_context(locked(run.lock, ""))
            self.checkpoints().remove()
        for path in (self.checkpoints().folder, *(run.lock for run in self.runs)):
            remove_empty_above(path, self.results / CHECKPOINTS)


def stackable(runs: Sequence[Run]) -> list[list[Run]]:
    """Runs that one stack can train: the same algorithm, domain and number of transitions."""
    found: dict[tuple[str, str, int | None], list[Run]] = {}
    for run in runs:
        found.setdefault((run.plan.algo, run.manifest.domain, run.used), []).append(run)
    return list(found.values())


def is_recorded(path: Path, plan: Plan, used: int | None, seed: int, is_same: Callable[[DatasetReference], bool]) -> bool:
    """Whether a record is there, of this training on the same data.

    Raises:
        UsageError: another run stands in its place.
    """

    def is_of_it(record: Record) -> bool:
        made = (in_full(record.hyperparameters), record.dataset.used, record.seed)
        return made == (plan.values, used, seed) and is_same(record.dataset)

    return result_stands(path, read_record, is_of_it, lambda _: "records another run (other data or settings)")


def record_of(run: Run, outcome: Outcome, execution: Execution, engine: str, seconds: float, beside: int = 1) -> Record:
    """The record of a run.

    Args:
        run: which.
        outcome: what came out.
        execution: how it was to be trained.
        engine: how its updates were carried out.
        seconds: of work on it and on those beside it.
        beside: how many were trained side by side.
    """
    plan, manifest, dataset_id = run.plan, run.manifest, run.dataset
    values = plan.values
    head, dirty = commit()
    options = {"--algo": plan.algo, "--profile": plan.profile} | execution.options
    usual = default_id(manifest.domain, manifest.method, manifest.seed, manifest.profile).for_task(str(manifest.task))
    if dataset_id == str(usual) and not manifest.overrides and manifest.imported is None:
        # Written like this, the command also makes the datasets anew where they are missing.
        options |= {"--domain": manifest.domain, "--method": manifest.method, "--seed": str(manifest.seed)}
        if manifest.reward is None:
            options["--task"] = str(manifest.task)
    else:
        options["--dataset-id"] = dataset_id
    if manifest.reward is not None:
        options["--reward"] = manifest.reward.reference
    if run.used is not None:
        options["--dataset-size"] = str(run.used)
    if run.seed != manifest.seed:
        options["--training-seeds"] = str(run.seed)
    finals = [Evaluation(step=step, returns=returns) for step, returns in outcome.finals]
    made = manifest.collected
    collection = Collection(hyperparameters=manifest.hyperparameters, versions=made.versions, machine=made.machine) if made else None
    return Record(
        dataset=DatasetReference(
            id=dataset_id, fingerprint=manifest.fingerprint, domain=manifest.domain, task=str(manifest.task), method=manifest.method,
            seed=manifest.seed, steps=manifest.steps, profile=manifest.profile, overrides=manifest.overrides,
            reward=manifest.reward, source=None if manifest.imported is None else manifest.imported.source, used=run.used,
            collection=None if manifest.imported is not None else collection,
        ),
        algorithm=plan.algo,
        profile=plan.profile,
        overrides=plan.overrides,
        seed=run.seed,
        hyperparameters=values,
        hyperparameters_hash=config_hash(values),
        milestones=list(plan.loop.milestones),
        curve=[Evaluation(step=step, returns=returns) for step, returns in outcome.curve],
        final=finals[-1],
        late=finals[:-1],
        metrics=[TrainingMetrics(step=step, values=row) for step, row in outcome.metrics],
        seconds=round(seconds / beside, 1),
        versions=versions(),
        commit=head,
        dirty=dirty,
        machine=machine(execution.device, torch.get_num_threads(), engine) | ({} if beside == 1 else {"beside": beside}),
        command=command_line("evaluate", options, plan.overrides, "--overwrite"),
        created=datetime.now(UTC).isoformat(timespec="seconds"),
    )  # fmt: skip
