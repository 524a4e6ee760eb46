"""Pages of what ``compare`` left in the output folder: two datasets side by side. Nothing is measured or drawn for them."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

from cudc_bench.artefacts.provenance import command_line, is_own_command

from ..datasets.behind import Dataset
from ..datasets.pair import PairSummary, SideSummary
from .models import Heading, HtmlTable, Item, Page, Picture, Row, Section
from .parts import Parts, count, dataset_path, pair_path

_FILES = ("quality", "map", "density", "spectra")
_SHOWN = (
    ("film", "A few seconds of both", "Out of the middle of the first, the middle and the last episode; the first dataset is on the left."),
    ("map", "Where their states lie", "The share of each dataset's states in the cells of two quantities, and whose each cell is."),
    ("density", "What they are worth to tasks", "The density of the rewards of single steps."),
    ("spectra", "How their actions change", "How much of the actions' variance lies at which frequency: trembling is on the right."),
)


class Pairs(Parts):
    """Builds them, and leads to them."""

    def pair(self, pair: PairSummary) -> Page:
        """The page of two datasets."""
        tasks = list(dict.fromkeys(task for side in pair.sides for task in side.rewards))
        lines = [
            Row(self._name(side), (
                Item(side.method), count(side.seed), count(side.steps),
                *(Item(f"{side.rewards[task]:.3f}", side.rewards[task]) if task in side.rewards else Item() for task in tasks),
                Item(f"{side.fingerprint[:12]} …"),
            ))
            for side in pair.sides
        ]  # fmt: skip
        columns = (
            Heading("method", number=False), Heading("seed"), Heading("steps"), *map(Heading, tasks), Heading("fingerprint", number=False),
        )  # fmt: skip
        rewards = "; rewards that their states are worth, per step" if tasks else ""
        grid = HtmlTable(f"Both datasets{rewards}", "dataset", columns, tuple(lines))
        x, y = pair.quantities
        first = Section("What they are", grids=(grid,), lead=f"{pair.shared:.0%} of the states are in the same cells of {x} and {y}.")
        command = command_line(f"compare {pair.sides[0].id} {pair.sides[1].id}", {"--quantities": f"{x},{y}"}, {})
        sections = [first, *self._pictures(pair), Section("Files", downloads=self.downloads(pair.slug, _FILES))]
        if is_own_command(command):
            sections.append(Section("Make it again", code=(("", command),)))
        crumbs = (("Overview", "index.html"), ("Datasets", "datasets/index.html"))
        return Page(pair_path(pair), pair.title, crumbs, (), (), tuple(sections))

    def _pictures(self, pair: PairSummary) -> Iterable[Section]:
        there = self.site.files.get(pair.slug, ())
        for name, title, text in _SHOWN:
            file = next((f"{name}{kind}" for kind in (".mp4", ".gif", ".svg") if f"{name}{kind}" in there), None)
            if file is not None:
                yield Section(title, lead=text, pictures=(Picture(f"{pair.slug}/{file}", f"{title}: {pair.title}."),))

    def _name(self, side: SideSummary) -> Item:
        dataset = self._dataset(side)
        return Item(side.id, link=None if dataset is None else dataset_path(dataset))

    def _dataset(self, side: SideSummary) -> Dataset | None:
        """The very data, if it has a page; an id alone may have been of other data when they were compared."""
        return self._here.get((side.id, side.fingerprint))

    @cached_property
    def _here(self) -> dict[tuple[str, str], Dataset]:
        """Datasets with pages that are on this machine, by id and fingerprint."""
        places = [(self.site.local.get(one.slug), one) for one in self.site.datasets]
        return {(local.id, local.manifest.fingerprint): one for local, one in places if local is not None}

    def pairs_of(self, dataset: Dataset | None = None) -> list[Section]:
        """The comparisons, or those that a dataset is in, as a section; none where there are none."""
        found = [pair for pair in self.site.pairs if dataset is None or dataset in map(self._dataset, pair.sides)]
        return [Section("Side by side", lines=tuple(Item(pair.title, link=pair_path(pair)) for pair in found))] if found else []
