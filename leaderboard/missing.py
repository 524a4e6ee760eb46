"""What a leaderboard lacks for its comparisons to be complete, and the commands that would fill it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from cudc_bench.envs.domains import DOMAINS
from cudc_bench.markup import plain
from cudc_bench.options import format_seeds
from cudc_bench.provenance import command_line
from cudc_bench.records import Record

from .load import column
from .table import Table


@dataclass(frozen=True)
class Missing:
    """Runs that a table lacks: a method on some tasks with some collector seeds.

    Attributes:
        group, algorithm, domain, method, tasks, seeds: which.
        command: makes them; None where no single command can, since their datasets were collected with settings of their own, cut short,
            or labelled by a user's function.
    """

    group: str
    algorithm: str
    domain: str
    method: str
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    command: str | None

    def __str__(self) -> str:
        way = f": {self.command}" if self.command else " (by the commands of its other records)"
        return (
            f"{self.algorithm} on {self.method} in {self.domain}, profile {self.group}, {', '.join(self.tasks)},"
            f" seeds {format_seeds(self.seeds)}{way}"
        )


def find_missing(tables: Iterable[Table]) -> list[Missing]:
    """What the tables of each group and algorithm lack of each other's methods and collector seeds, and of their domains' tasks.

    A domain without any record is not asked for, and neither imported datasets nor what others handed in are:
    nobody can be told to make those.

    Args:
        tables: as ``build_tables`` returns them.
    """
    together: dict[tuple[str, str], list[Table]] = defaultdict(list)
    for table in tables:
        together[table.group, table.algorithm].append(table)
    return [one for same in together.values() for one in _of_group(same)]


def _of_group(tables: Sequence[Table]) -> list[Missing]:
    own = [one for table in tables for one in table.records if one.dataset.source is None and one.submission is None]
    methods = dict.fromkeys(method for table in tables for method in table.methods if any(column(one) == method for one in own))
    seeds = sorted({record.dataset.seed for record in own})
    found = []
    for table in tables:
        tasks = DOMAINS[table.domain].tasks if table.domain in DOMAINS and own and own[0].dataset.reward is None else table.tasks
        have = {(column(record), record.dataset.task, record.dataset.seed) for record in table.records}
        for method in methods:
            # Tasks that lack the same seeds take one command.
            lacking: dict[tuple[int, ...], list[str]] = defaultdict(list)
            for task in tasks:
                if lacks := tuple(seed for seed in seeds if (method, task, seed) not in have):
                    lacking[lacks].append(task)
            for lacks, which in lacking.items():
                command = _command(own[0], table.domain, method, which, lacks)
                found.append(Missing(table.group, table.algorithm, table.domain, plain(method), tuple(which), lacks, command))
    return found


def _command(like: Record, domain: str, method: str, tasks: Sequence[str], seeds: Sequence[int]) -> str | None:
    dataset = like.dataset
    if dataset.overrides or dataset.used or dataset.reward is not None or dataset.profile != like.profile:
        return None
    options = {
        "--algo": like.algorithm, "--domain": domain, "--method": method, "--tasks": ",".join(tasks), "--seeds": format_seeds(seeds),
        "--profile": like.profile,
    }  # fmt: skip
    return command_line("evaluate", options, like.overrides)
