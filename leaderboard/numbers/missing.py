"""What a leaderboard lacks for its comparisons to be complete, and the commands that would fill it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass, field

from cudc_bench.artefacts.provenance import command_line
from cudc_bench.artefacts.records import Record
from cudc_bench.settings.seeds import format_seeds
from cudc_bench.text import plain

from ..methods import canonical
from .columns import column, is_own
from .table import Table


@dataclass(frozen=True)
class Missing:
    """Runs that a table lacks: a method on some tasks with some collector seeds.

    Attributes:
        group, algorithm, domain, method, tasks, seeds: which.
        command: makes them; None where no single command can, since their datasets were collected with settings of their own or labelled
            by a user's function.
        study: the study that lacks them; None for the main tables.
    """

    group: str
    algorithm: str
    domain: str
    method: str
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    command: str | None
    study: str | None = None

    def __str__(self) -> str:
        study = f"{self.study}: " if self.study else ""
        way = f": {self.command}" if self.command else " (by the commands of its other records)"
        return (
            f"{study}{self.algorithm} on {self.method} in {self.domain}, profile {self.group}, {', '.join(self.tasks)},"
            f" seeds {format_seeds(self.seeds)}{way}"
        )


@dataclass(frozen=True)
class Wanted:
    """What a study needs of one method.

    Attributes:
        study: its name.
        group, algorithm, domain, method, tasks, seeds: what; ``method`` is the name to give to a command.
        used: only so many transitions.
        have: of (task, seed) what is there already, under whatever name.
        like: a record whose settings they should have.
    """

    study: str
    group: str
    algorithm: str
    domain: str
    method: str
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    used: int | None
    have: frozenset[tuple[str, int]] = field(repr=False)
    like: Record = field(repr=False)


def find_missing(tables: Iterable[Table], wanted: Iterable[Wanted] = ()) -> list[Missing]:
    """What the tables of each group and algorithm lack of each other's methods and collector seeds, and of their own tasks.

    A domain or task without any record is not asked for, and neither imported datasets nor what others handed in are:
    nobody can be told to make those.

    Args:
        tables: as ``build_tables`` returns them.
        wanted: what studies need, too; nothing is asked for twice.
    """
    together: dict[tuple[str, str], list[Table]] = defaultdict(list)
    for table in tables:
        together[table.group, table.algorithm].append(table)
    found = [one for same in together.values() for one in _of_group(same)]
    asked = {
        (one.group, one.algorithm, one.domain, canonical(one.method), task, seed)
        for one in found
        for task in one.tasks
        for seed in one.seeds
    }
    for one in wanted:
        group = plain(one.group)
        place = (group, one.algorithm, one.domain, canonical(one.method))
        have = one.have | {(task, seed) for task in one.tasks for seed in one.seeds if (*place, task, seed) in asked}
        for tasks, seeds in _holes(one.tasks, one.seeds, have):
            command = _command(one.like, one.domain, one.method, tasks, seeds, one.used)
            found.append(Missing(group, one.algorithm, one.domain, one.method, tasks, seeds, command, one.study))
            asked |= {(*place, task, seed) for task in tasks for seed in seeds}
    return found


def _of_group(tables: Sequence[Table]) -> list[Missing]:
    own = [one for table in tables for one in table.records if is_own(one)]
    collected = {column(record) for record in own}
    methods = dict.fromkeys(method for table in tables for method in table.methods if method in collected)
    seeds = sorted({record.dataset.seed for record in own})
    found = []
    for table in tables:
        have: dict[str, set[tuple[str, int]]] = defaultdict(set)
        for record in table.records:
            have[column(record)].add((record.dataset.task, record.dataset.seed))
        for method in methods:
            for which, lacks in _holes(table.tasks, seeds, have[method]):
                command = _command(own[0], table.domain, method, which, lacks, own[0].dataset.used)
                found.append(Missing(table.group, table.algorithm, table.domain, plain(method), which, lacks, command))
    return found


def _holes(tasks: Iterable[str], seeds: Sequence[int], have: Set[tuple[str, int]]) -> list[tuple[tuple[str, ...], tuple[int, ...]]]:
    """Tasks and seeds that are not there; tasks that lack the same seeds take one command."""
    lacking: dict[tuple[int, ...], list[str]] = defaultdict(list)
    for task in tasks:
        if lacks := tuple(seed for seed in seeds if (task, seed) not in have):
            lacking[lacks].append(task)
    return [(tuple(which), lacks) for lacks, which in lacking.items()]


def _command(like: Record, domain: str, method: str, tasks: Sequence[str], seeds: Sequence[int], used: int | None) -> str | None:
    dataset = like.dataset
    if dataset.overrides or dataset.reward is not None or dataset.profile != like.profile:
        return None
    options = {
        "--algo": like.algorithm, "--domain": domain, "--method": method, "--tasks": ",".join(tasks), "--seeds": format_seeds(seeds),
        "--profile": like.profile,
    }  # fmt: skip
    if used is not None:
        options["--dataset-size"] = str(used)
    return command_line("evaluate", options, like.settings)
