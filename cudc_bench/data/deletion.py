"""Removes datasets: out of sight at once by one rename, and never from under what needs them.

A labelled dataset that links to its base is of no use without it, so that a base goes only with all of these, and after them. Whoever is
at work on a dataset, labels it or trains on it holds a lock, and keeps it from being removed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from cudc_bench.artefacts.ids import DatasetId, dataset_path, datasets_root, parse_id, stored_ids
from cudc_bench.artefacts.manifest import exists, read_manifest
from cudc_bench.artefacts.records import CHECKPOINTS, SUITE_FOLDER, record_files
from cudc_bench.data.staging import building_path, staging, unfinished, writer_of
from cudc_bench.errors import CudcBenchError, HeldError, RunError, UsageError, nearest
from cudc_bench.execution.interrupted import RUN, run_there
from cudc_bench.execution.locks import held_by
from cudc_bench.files import bytes_below, walk

_REMOVED = "removed"  # in the hidden folder beside a dataset, where it waits for its end


@dataclass(frozen=True)
class Doomed:
    """A dataset that is to be removed.

    Attributes:
        id: which.
        what: it is, in a few words.
        bytes: of its files.
        ours: whether this project made it.
    """

    id: DatasetId
    what: str
    bytes: int
    ours: bool


@dataclass(frozen=True)
class Deletion:
    """What is to be removed, and what that means for others.

    Attributes:
        datasets: in the order in which they go: what links to a base before it.
        remarks: one line for each thing that stays and speaks of them.
    """

    datasets: tuple[Doomed, ...]
    remarks: tuple[str, ...] = field(default=())

    @property
    def bytes(self) -> int:
        """Of all of them."""
        return sum(one.bytes for one in self.datasets)


def plan_deletion(dataset_ids: Iterable[str], with_labelled: bool, results: Path) -> Deletion:
    """What removing some datasets comes to; nothing is removed yet.

    Args:
        dataset_ids: of datasets, ours or not, or of what an interrupted command left of one.
        with_labelled: also the labelled datasets that link to them.
        results: the folder of records; trainings and records there are looked at.

    Raises:
        UsageError: there is no such dataset, or others link to it; the message names them.
        HeldError: somebody is at work on one of them.
    """
    named = [parse_id(one) for one in dict.fromkeys(dataset_ids)]
    for one in named:
        if not (exists(one) or building_path(one).exists()):
            raise UsageError(f"there is no dataset '{one}' in {datasets_root()}.{nearest(str(one), map(str, stored_ids()))}")
    linked, copies = _labelled_from(named)
    left = {base: [one for one in found if one not in named] for base, found in linked.items()}
    if not with_labelled:
        for base, found in left.items():
            if found:
                raise UsageError(
                    f"'{base}' is what {_listed(found)} {'links' if len(found) == 1 else 'link'} to; name {_them(found)}, too, or give"
                    " --with-labelled."
                )
    # Whatever links to something goes before it, so that nothing is ever there that leads nowhere.
    first = dict.fromkeys(one for found in linked.values() for one in found)
    doomed = [*first, *(one for one in named if one not in first)]
    _check_free(doomed, results)
    return Deletion(tuple(map(_doomed, doomed)), tuple(_remarks(doomed, copies, results)))


def remove(dataset_id: DatasetId) -> None:
    """Remove a dataset, or what an interrupted command left of one; of a symbolic link the link alone.

    Raises:
        HeldError: somebody is at work on it.
        RunError: it cannot be removed.
    """
    place = dataset_path(dataset_id)
    with staging(dataset_id) as folder:
        if exists(dataset_id) or place.is_symlink():
            place.rename(folder / _REMOVED)  # out of sight at once


def finish_removal(dataset_id: DatasetId) -> None:
    """Remove what a process left that was killed while it removed a dataset."""
    if (building_path(dataset_id) / _REMOVED).exists():
        with suppress(RunError), staging(dataset_id):
            pass


def _labelled_from(bases: Sequence[DatasetId]) -> tuple[dict[DatasetId, list[DatasetId]], list[DatasetId]]:
    """The labelled datasets that link to each of some bases, and those that hold copies of one: labelled ones and mixtures."""
    linked: dict[DatasetId, list[DatasetId]] = {base: [] for base in bases}
    copies: list[DatasetId] = []
    for one in stored_ids():
        try:
            manifest = read_manifest(one)
        except UsageError:
            continue  # somebody else's
        except RunError:
            # Damaged. By its name it may belong to a base, which is then kept rather than lost.
            for base in bases:
                if _is_labelled(one, base):
                    linked[base].append(one)
            continue
        there, parts = manifest.base, () if manifest.mixture is None or manifest.base is not None else manifest.mixture.parts
        for base in bases:
            if there is not None and there.id == str(base):
                (linked[base] if there.linked else copies).append(one)
        if any(part.id == str(base) for part in parts for base in bases):
            copies.append(one)
    return linked, copies


def _is_labelled(one: DatasetId, base: DatasetId) -> bool:
    """Whether an id is that of a base labelled for some task."""
    return one.namespace.rpartition("/")[0] == base.namespace and (one.name, one.version) == (base.name, base.version)


def _check_free(doomed: Sequence[DatasetId], results: Path) -> None:
    suite = held_by(results / SUITE_FOLDER / "lock")
    for one in doomed:
        if (holder := writer_of(one)) is not None:
            raise HeldError(f"{holder} is writing '{one}'; wait for it to end.")
        for lock in sorted((results / CHECKPOINTS).glob(f"*/{one}/*.lock")):
            if (holder := held_by(lock)) is not None:
                raise HeldError(f"{holder} is training on '{one}'; wait for it to end, or stop it.")
        if suite is not None and (results / SUITE_FOLDER / "datasets" / f"{one}.json").exists():
            raise HeldError(f"{suite} is running a suite that made '{one}'; wait for it to end, or stop it.")
    for other, holder in unfinished():
        for one in doomed:
            if holder is not None and _is_labelled(other, one):
                raise HeldError(f"{holder} is labelling '{one}' as '{other}'; wait for it to end, or stop it.")


def _doomed(one: DatasetId) -> Doomed:
    place = dataset_path(one)
    if place.is_symlink():
        return Doomed(one, f"a symbolic link to {place.resolve()}, which stays", 0, ours=True)
    size = bytes_below(place) + bytes_below(building_path(one))
    if not place.exists():
        return Doomed(one, "what an interrupted command left of it", size, ours=True)
    try:
        manifest = read_manifest(one)
    except UsageError:
        return Doomed(one, "not made by cudc-bench", size, ours=False)
    except CudcBenchError:
        return Doomed(one, "damaged", size, ours=True)
    labelled = f", labelled for {manifest.task}" if manifest.task else ""
    begun = ", and what an interrupted command left beside it" if building_path(one).exists() else ""
    return Doomed(one, f"{manifest.describe()}{labelled}{begun}", size, ours=True)


def _remarks(doomed: Sequence[DatasetId], copies: Sequence[DatasetId], results: Path) -> list[str]:
    """What stays and speaks of datasets that will be gone."""
    found = []
    if stay := [one for one in copies if one not in doomed]:
        hold = "holds a copy of its own, and stays" if len(stay) == 1 else "hold copies of their own, and stay"
        found.append(f"{_listed(stay)} {hold}")
    names = {tuple(str(one).split("/")) for one in doomed}
    lengths = {len(name) for name in names}
    records = [path for path in record_files(results) if any(path.parent.parts[-length:] in names for length in lengths)]
    if records:
        made = "was made of them, and stays" if len(records) == 1 else "were made of them, and stay"
        found.append(f"{_count(len(records), 'record')} in {results} {made}")
    ids = set(map(str, doomed))
    begun = 0
    for place, _, files in walk(results / CHECKPOINTS):
        if RUN in files:
            datasets = (run_there(place) or {}).get("datasets")
            begun += isinstance(datasets, dict) and bool(ids & datasets.keys())
    if begun:
        found.append(f"{_count(begun, 'interrupted training')} in {results} can go on only when the same data are there again")
    return found


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def _listed(ids: Sequence[DatasetId]) -> str:
    return ", ".join(f"'{one}'" for one in ids)


def _them(ids: Sequence[DatasetId]) -> str:
    return "it" if len(ids) == 1 else "them"
