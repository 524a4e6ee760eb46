"""Pages of the runs behind each cell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from cudc_bench.artefacts.again import commands_from_nothing
from cudc_bench.artefacts.records import Record

from ..numbers.table import ENOUGH_SEEDS, Table
from ..numbers.words import short, span
from .models import MISSING, Heading, HtmlTable, Item, Page, Row, Section
from .parts import (
    ComparisonPage,
    Parts,
    brief,
    by_column,
    commit,
    count,
    dataset_path,
    domain_path,
    machine_text,
    number,
    origin,
    pm,
    reference_text,
    run_of,
    runs_path,
    task_path,
    version,
)


class Runs(Parts):
    """Builds them."""

    def runs_of(self, board: ComparisonPage, table: Table) -> Iterable[Page]:
        """A page for each task and method of a table."""
        for task in table.tasks:
            for method, records in by_column(table, task).items():
                records.sort(key=lambda one: (one.dataset.seed, one.seed, one.dataset.id))
                yield self._runs(board, table, task, method, records)

    def _runs(self, board: ComparisonPage, table: Table, task: str, method: str, records: Sequence[Record]) -> Page:
        ids = {id(record): f"run-{index}" for index, record in enumerate(records, 1)}
        sections = []
        for milestone in reversed(table.milestones):
            lines = []
            for record in records:
                found = record.evaluation(milestone)
                dataset = self.site.dataset_of[id(record)]
                numbers = [Item()] * 4
                if found is not None:
                    numbers = [number(found.mean), number(min(found.returns)), number(max(found.returns)), count(len(found.returns))]
                lines.append(Row(Item(f"seed {record.dataset.seed}", record.dataset.seed, f"#{ids[id(record)]}"), (
                    count(record.seed), *numbers, Item(dataset.name, link=dataset_path(dataset)),
                )))  # fmt: skip
            columns = (Heading("training seed"), Heading("mean return"), Heading("lowest"), Heading("highest"), Heading("episodes"),
                       Heading("dataset", number=False))  # fmt: skip
            cell = table.cells.get((milestone, task, method))
            result = "no result" if cell is None else f"{pm(cell.value, cell.std)} over {span([cell.n], 'seed')}"
            caption = f"{method} on {table.domain} {task} after {short(milestone)} gradient steps: {result}"
            grid = HtmlTable(caption, "collector seed", columns, tuple(lines))
            sections.append(Section(f"After {short(milestone)} gradient steps", grids=(grid,), id=f"at-{milestone}"))
        parts = tuple(self._run(table, record, ids[id(record)]) for record in records)
        sections.append(Section("Each run", parts=parts))
        # A hidden table has no pages of its own.
        above = () if any(table is one for one in board.hidden) else ((table.domain, domain_path(table)), (task, task_path(table, task)))
        crumbs = (*self.crumbs(board), *above)
        lead = (f"The runs behind {method} in the tables of {table.algorithm}, profile {brief(table.group)}.", *reference_text(table, task))
        preliminary = len({record.dataset.seed for record in records}) < ENOUGH_SEEDS
        badges = ("Preliminary: fewer than five seeds",) if preliminary else ()
        return Page(runs_path(table, task, method), f"{method} on {table.domain} {task}", crumbs, lead, badges, tuple(sections))

    def _run(self, table: Table, record: Record, anchor: str) -> Section:
        dataset = self.site.dataset_of[id(record)]
        facts = [
            ("dataset", Item(record.dataset.id, link=dataset_path(dataset))),
            ("fingerprint", Item(record.dataset.fingerprint)),
            (
                "final score",
                Item(
                    f"{record.conclusion.mean:.1f} after {short(record.final.step)} steps,"
                    f" {span([len(record.conclusion.returns)], 'episode')}"
                    + (f"; {record.final.mean:.1f} in the last of {len(record.finals)} evaluations" if record.late else "")
                ),
            ),
        ]
        for milestone in reversed(table.milestones):
            found = record.evaluation(milestone)
            if found is not None:
                facts.append((f"returns at {short(milestone)}", Item(", ".join(f"{value:.1f}" for value in found.returns))))
        facts += [
            ("training", Item(f"{record.seconds:,.0f} seconds, seed {record.seed}, hyperparameters {brief(record.hyperparameters_hash)}")),
            *_told(record),
            ("machine", Item(machine_text(record) or MISSING)),
            ("code", Item(f"cudc-bench {version(record, 'cudc-bench')}, {commit(record)}")),
            ("origin", Item(origin(record))),
            ("made", Item(record.created)),
        ]
        if place := self.site.place(record):
            facts.append(("record", Item(place, link=self.site.links.get(run_of(record)))))
        return Section(
            f"Collector seed {record.dataset.seed}, training seed {record.seed}", id=anchor, facts=tuple(facts), code=_again(record)
        )


def _told(record: Record) -> list[tuple[str, Item]]:
    """How a learner without rewards was told of the task."""
    told = record.zero_shot
    if told is None:
        return []
    source = "" if told.source is None else f" of {told.source.id}"
    which = f"{told.drawn:,} transitions{source}, {told.rewarded:.1%} of them with a reward; {told.rule}, of length {told.norm:.4g}"
    shared = f"{told.training}, of {told.training_seconds:,.0f} seconds and {span([told.records], 'record')}"
    return [("told of the task by", Item(which)), ("its training", Item(shared))]


def _again(record: Record) -> tuple[tuple[str, str], ...]:
    """The commands that make a record again from nothing, each with what it does; texts of a page have one line."""
    *before, last = commands_from_nothing(record)
    collects = f"Collects {'a part of ' if record.dataset.parts else ''}its dataset, where it is missing"
    what = {"collect": collects, "mix": "Mixes its parts", "tiers": "Trains online, and keeps the data", "relabel": "Labels it"}
    return (*((what[command.split()[1]], command) for command in before), ("Makes this record again", last))
