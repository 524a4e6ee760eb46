"""What datasets are measured by that need more than themselves: a task's floor and ceiling, its expert's states, and its replay.

TQ and SACo are those of Schweighofer et al. 2022, "A Dataset Perspective on Offline Reinforcement Learning" (CoLLAs, arXiv 2111.04714).
SACo departs from theirs in what a state-action pair is. They count the different ones, of continuous ones after binning each dimension
by a hundred; of 24 to 78 dimensions nearly all are different then, in any dataset. Here a pair is the cell of the domain's behaviour
descriptors that the state lies in, and one of 64 directions of the action (:func:`~.visited.directions`). Their reference is the replay of
the online training that the dataset is of; here it is that of TD3 on the task.

Experts and replays are those of ``cudc-bench tiers``, floors and ceilings those of the leaderboard. All of them belong to one profile; a
table of datasets that were collected with other settings, or imported, has none, as tables of returns have none (see
:func:`~..numbers.scale.serving`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from cudc_bench.artefacts.ids import stored_ids
from cudc_bench.artefacts.manifest import Manifest, read_manifest
from cudc_bench.artefacts.provenance import command_line
from cudc_bench.artefacts.references import Bounds
from cudc_bench.envs import Domain, check_domain
from cudc_bench.errors import CudcBenchError
from cudc_bench.execution.progress import bars
from cudc_bench.settings.profiles import PROFILES
from cudc_bench.text import plain

from .quality import Quality, QualityTable, TaskMeasures
from .visited import Visited, precision, read_visited, recall

_EXPERT, _REPLAY = "expert", "replay"
_Stored = Iterable[tuple[str, Manifest]]


@dataclass(frozen=True)
class Yardsticks:
    """What the datasets of a domain and profile are measured by, of each task that has it.

    Attributes:
        bounds: floor and ceiling.
        experts: what each seed's expert has visited.
        replays: what each seed's replay has.
    """

    bounds: Mapping[str, Bounds]
    experts: Mapping[str, Sequence[Visited]]
    replays: Mapping[str, Sequence[Visited]]

    def has(self, task: str) -> bool:
        """Whether there is anything to measure by."""
        return task in self.bounds or task in self.experts or task in self.replays

    def measures(self, one: Quality, task: str, domain: Domain) -> TaskMeasures:
        """What a dataset has of a task.

        Its mean return is that of episodes of full length: their mean reward per step, times the length, so that one that was cut short
        says as much as another. Of several replays the mean number of pairs counts, of several experts all states.
        """
        bounds, experts, replays = self.bounds.get(task), self.experts.get(task), self.replays.get(task)
        pairs = None if replays is None else fmean(replay.pairs for replay in replays)
        return TaskMeasures(
            trajectory_quality=None if bounds is None else bounds.normalise(one.rewards[task].mean * domain.episode_length),
            coverage_ratio=None if not pairs or one.visited is None else one.visited.pairs / pairs,
            expert_recall=None if experts is None or one.visited is None else recall(one.visited, experts),
            expert_precision=None if experts is None or one.visited is None else precision(one.visited, experts),
        )


def measure_beside(
    tables: Sequence[QualityTable], references: Mapping[tuple[str, str, str], Bounds]
) -> tuple[list[QualityTable], list[str]]:
    """The same tables with what their datasets have of each task, and a line for each measure that something is missing for.

    Args:
        tables: with what their datasets have visited.
        references: by profile, domain and task.

    Raises:
        RunError: a dataset of an expert or a replay is damaged.
    """
    tiers = [(one, manifest) for one, manifest in _stored() if manifest.tier is not None and manifest.tier.kind in (_EXPERT, _REPLAY)]
    found, remarks = [], []
    for table in tables:
        domain = check_domain(table.domain)
        if table.group not in PROFILES:
            why = "these datasets were collected with other settings than a profile's, or not here"
            remarks.append(f"{table.slug}: no TQ, SACo, recall or precision: {why}.")
            found.append(table)
            continue
        own = [(one, manifest) for one, manifest in tiers if (manifest.domain, manifest.profile) == (domain.name, table.group)]
        yardsticks = _yardsticks(table, domain, references, own)
        tasks = [task for task in table.tasks if yardsticks.has(task)]
        datasets = [replace(one, tasks={task: yardsticks.measures(one, task, domain) for task in tasks}) for one in table.datasets]
        found.append(replace(table, datasets=tuple(datasets)))
        remarks += _lacking(table, domain, yardsticks)
    return found, remarks


def _stored() -> _Stored:
    for one in map(str, stored_ids()):
        try:
            yield one, read_manifest(one)
        except CudcBenchError:
            continue  # somebody else's, or damaged: nothing that is measured by


def _yardsticks(table: QualityTable, domain: Domain, references: Mapping[tuple[str, str, str], Bounds], tiers: _Stored) -> Yardsticks:
    known = {one.id: one.visited for one in table.datasets if one.visited is not None}
    # Other settings make another training; how many steps the expert acted for is none of it.
    usual = [(one, manifest) for one, manifest in tiers if domain.descriptors and not manifest.overrides.keys() - {"data_steps"}]
    unread = [(one, manifest) for one, manifest in usual if one not in known]
    with bars([(f"states of {one}", manifest.steps) for one, manifest in unread], "states") as advances:
        for (one, manifest), advance in zip(unread, advances, strict=True):
            known[one] = read_visited(one, manifest, domain, advance)
    visited: dict[str, dict[str, list[Visited]]] = {_EXPERT: defaultdict(list), _REPLAY: defaultdict(list)}
    for one, manifest in usual:
        assert manifest.tier is not None
        visited[manifest.tier.kind][str(manifest.task)].append(known[one])
    bounds = {task: references[key] for task in table.tasks if (key := (table.group, domain.name, task)) in references}
    return Yardsticks(bounds, visited[_EXPERT], visited[_REPLAY])


def _lacking(table: QualityTable, domain: Domain, there: Yardsticks) -> list[str]:
    """What is not measured, why, and the command that makes what is missing."""
    remarks = []
    for what, kind, having, command in (
        ("TQ", "reference", there.bounds, "reference"),
        ("recall and precision", "expert's dataset", there.experts, "tiers"),
        ("SACo", "replay", there.replays, "tiers"),
    ):
        if command == "tiers" and not domain.descriptors:
            remarks.append(f"{table.slug}: no {what}: {plain(domain.name)} has no behaviour descriptors.")
        elif lacking := [task for task in table.tasks if task not in having]:
            options = {"--domain": domain.name, "--tasks": ",".join(lacking), "--profile": table.group}
            remarks.append(
                f"{table.slug}: no {what} of {', '.join(lacking)}: there is no {kind}; make it with: {command_line(command, options, {})}"
            )
    return remarks
