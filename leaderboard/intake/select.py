"""Which of the stored datasets a command is about: those that were named, or all that it can use."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from cudc_bench.artefacts.ids import datasets_root, parse_id, stored_ids
from cudc_bench.artefacts.manifest import Manifest, read_manifest
from cudc_bench.errors import RunError, UsageError, nearest
from cudc_bench.text import plain

Chosen = list[tuple[str, Manifest]]


def select(
    dataset_ids: str | Sequence[str] | None,
    domain: str | None,
    methods: Sequence[str] | None,
    *,
    others: Callable[[Manifest], bool],
    refuse: Callable[[str, Manifest], None],
    lacks: Callable[[str, Manifest], str | None],
    verb: str,
) -> tuple[Chosen, list[str]]:
    """Datasets with their manifests, and a line for each that was left out.

    Args:
        dataset_ids: by name; all below the dataset root unless given.
        domain, methods: only datasets of that domain, of these methods.
        others: which stored ones are of no concern, and are passed over.
        refuse: raises UsageError for one that was named and cannot be used.
        lacks: what a stored one lacks to be used, such as ``"there is no file x"``.
        verb: of all stored ones together, for the message where there is none: ``"has diagnostics"``.

    Raises:
        UsageError: there is no such dataset, or none that can be used.
    """
    found: Chosen = []
    remarks: list[str] = []
    if dataset_ids is not None:
        for one in dict.fromkeys([dataset_ids] if isinstance(dataset_ids, str) else dataset_ids):
            manifest = read_manifest(parse_id(one))
            refuse(one, manifest)
            found.append((one, manifest))
        if not found:
            raise UsageError("no dataset was named; give an id such as walker/cudc-v0.")
    else:
        for one in map(str, stored_ids()):
            try:
                manifest = read_manifest(one)
            except UsageError:
                continue  # somebody else's
            except RunError as error:
                remarks.append(plain(str(error)))
                continue
            if others(manifest):
                continue
            if (why := lacks(one, manifest)) is None:
                found.append((one, manifest))
            else:
                remarks.append(f"{one} is left out: {why}.")
        if not found:
            why = f" Left out: {len(remarks)}, such as: {remarks[0]}" if remarks else ""
            raise UsageError(f"no dataset in {datasets_root()} {verb}; make one with: cudc-bench collect.{why}")
    found = list(only(found, "dataset", "domain", domain, lambda one: one[1].domain))
    if methods is not None:
        of_methods = [pair for method in methods for pair in only(found, "dataset", "method", method, lambda one: one[1].method)]
        found = list(dict(of_methods).items())
    return found, remarks


T = TypeVar("T")


def only(found: Sequence[T], kind: str, what: str, wanted: str | None, key: Callable[[T], str]) -> tuple[T, ...]:
    """Those of some things of a kind whose ``key`` is wanted; all of them if None is.

    Raises:
        UsageError: there is none; the message lists what there is.
    """
    kept = tuple(one for one in found if wanted is None or key(one) == wanted)
    if wanted is not None and not kept:
        exist = sorted({key(one) for one in found})
        raise UsageError(f"no {kind} has the {what} '{wanted}'; there are: {', '.join(exist)}.{nearest(wanted, exist)}")
    return kept
