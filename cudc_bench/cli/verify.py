"""``cudc-bench verify``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from cudc_bench.cli import completion
from cudc_bench.cli.options import JsonOption
from cudc_bench.errors import RunError, UsageError

if TYPE_CHECKING:
    from cudc_bench.cli.documents import VerifiedDataset
    from cudc_bench.data.verification import Verification


def verify(
    dataset_ids: Annotated[
        list[str] | None,
        typer.Argument(help="Datasets, such as walker/cudc-v0; with --all alone, all.", autocompletion=completion.datasets),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Hold all transitions against the simulator, not a sample.")] = False,
    sample: Annotated[int | None, typer.Option("--sample", help="Transitions to simulate, in whole episodes; 20000 by default.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Draw the sample with this seed; drawn anew and printed by default.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Prove datasets: structure, fingerprint, rewards, and by simulation."""
    from cudc_bench.artefacts.manifest import read_manifest
    from cudc_bench.cli.documents import VerifiedDataset, VerifyDocument, print_json
    from cudc_bench.data.verification import SAMPLE, draw_seed
    from cudc_bench.data.verification import verify as run
    from cudc_bench.execution.progress import warn

    if every and (sample is not None or seed is not None):
        raise UsageError(f"--all and {'--seed' if sample is None else '--sample'} contradict each other; give one of them.")
    if not dataset_ids and not every:
        raise UsageError(
            "no dataset was named; name some, such as walker/cudc-v0, or give --all for all that there are (see cudc-bench list)."
        )
    wanted = list(dict.fromkeys(dataset_ids or _all_of_ours()))
    for one in dataset_ids or ():
        read_manifest(one)
    drawn = draw_seed() if seed is None else seed
    documents: list[VerifiedDataset] = []
    failed: list[RunError] = []
    for one in wanted:
        try:
            found = run(one, sample=None if every else SAMPLE if sample is None else sample, seed=drawn)
        except RunError as error:
            failed.append(error)
            documents.append(VerifiedDataset(id=one, ok=False, problem=str(error)))
        else:
            documents.append(_document(found))
            if not as_json:
                _show(found)
    if as_json:
        print_json(VerifyDocument(ok=not failed, datasets=documents))
    if len(failed) > 1:
        for failure in failed if not as_json else ():
            warn(str(failure))
        where = "in the document" if as_json else "above"
        raise RunError(f"{len(failed):,} of {len(wanted):,} datasets fail; what is wrong with each stands {where}.")
    if failed:
        raise failed[0]


def _document(found: Verification) -> VerifiedDataset:
    from cudc_bench.cli.documents import VerifiedCheck, VerifiedDataset

    checks = [VerifiedCheck(name=one.name, detail=one.detail) for one in found.checks]
    return VerifiedDataset(
        id=found.dataset_id, ok=True, fingerprint=found.fingerprint, checks=checks, proven=list(found.proven),
        unproven=list(found.unproven), seed=found.seed,
    )  # fmt: skip


def _all_of_ours() -> list[str]:
    """The ids of all datasets that this project made, damaged ones among them."""
    from cudc_bench.artefacts.ids import datasets_root, stored_ids
    from cudc_bench.artefacts.manifest import read_manifest

    found = []
    for one in stored_ids():
        try:
            read_manifest(one)
        except UsageError:
            continue
        except RunError:
            pass
        found.append(str(one))
    if not found:
        raise UsageError(f"there is no dataset of cudc-bench in {datasets_root()}; collect or import one.")
    return found


def _show(found: Verification) -> None:
    from rich.console import Console
    from rich.text import Text

    from cudc_bench.cli.tables import Cell, Column, Row, Table

    console = Console(highlight=False)
    columns = (Column(""), Column("", prose=True), Column("", prose=True))
    rows = tuple(Row((Cell("ok", "green"), Cell(check.name), Cell(check.detail))) for check in found.checks)
    console.print(Table(columns, rows, f"{found.dataset_id} passes all checks", shortens=False))
    console.print(Text(f"proven: {'; '.join(found.proven)}"))
    console.print(Text(f"not provable: {'; '.join(found.unproven)}"))
