"""What is said and checked of others' data alike, whichever format they came in."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from cudc_bench.artefacts.manifest import Manifest
from cudc_bench.envs import Domain

from .exorl import FileFault, Layout


def check_return(rewards: NDArray[Any], domain: Domain, task: str) -> None:
    """Refuse an episode's rewards (T,) that no policy can reach.

    Raises:
        FileFault: they sum to more than the domain's largest return.
    """
    if abs(total := float(rewards.sum(dtype="float64"))) > domain.max_return * (1 + 1e-6):
        raise FileFault(f"holds rewards that sum to {total:g}; those of {domain.name} {task} reach at most {domain.max_return:g}")


def about_arrays(layout: Layout, row: str) -> Iterator[str]:
    """What becomes of arrays that are not known here; each row of them belongs to a ``row``."""
    if layout.extras:
        yield f"kept beside the known arrays: {', '.join(f'infos/{name}' for name in layout.extras)}"
    if layout.ignored:
        yield f"ignored, since not numbers with a row for each {row}: {', '.join(layout.ignored)}"


def description(manifest: Manifest, layout: Layout, of: str, where: str) -> str:
    """Of an imported dataset, for its metadata.

    Args:
        manifest: its.
        layout: of what it was made from.
        of: what that was, as in ``3 episode files``.
        where: the rewards of a task were, as in ``in the files``.
    """
    assert manifest.imported is not None
    rewards = (
        f"The rewards are those of {manifest.task} {where}." if manifest.task
        else "The rewards are all 0. Relabel it for a task with cudc-bench." if layout.physics
        else "The rewards are all 0."
    )  # fmt: skip
    return (
        f"{manifest.domain} explored by {manifest.method}, imported from {of} of {manifest.imported.source}: not collected by cudc-bench; "
        f"hyperparameters and episode seeds are not known here. {rewards}"
        + ("" if layout.physics else " It holds no physics states and cannot be relabelled.")
    )
